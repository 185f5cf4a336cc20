"""The result of a comparison of visits, before it is put in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tactile_bayes.findings import Finding
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.size.change import JointSizes
    from tactile_bayes.size.same_mass import Apart


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Whether visits are of one mass, and its sizes.

    Parameters
    ----------
    status
        ``"compared"``, ``"not_one_mass"`` or ``"no_estimate"``.
    reason, advice
        Why there is no comparison, and what would help; empty where there is one.
    apart
        How far the mass of each later visit lies from the first's; None where landmarks do not show it.
    findings
        What speaks against the comparison.
    joint, another
        Sizes with the calibration's or the site's spread between exams, and with the paper's.
    """

    status: str
    reason: str = ""
    advice: str = ""
    apart: tuple[Apart | None, ...] = ()
    findings: tuple[Finding, ...] = ()
    joint: JointSizes | None = None
    another: JointSizes | None = None
