"""Reasons for giving no number: a sentence, a code for programs, and what would help."""

from __future__ import annotations

from tactile_bayes.records import dataclass

CODES = ("empty", "undetected", "ridge", "coarse", "unresolved", "window", "prior", "extrapolated", "method")
NO_LUMP = ("empty", "undetected", "ridge")
"""Codes of maps that show no lump; the others show one that cannot be measured."""


@dataclass(frozen=True, slots=True)
class Abstention:
    """The reason for giving no number.

    Parameters
    ----------
    code
        One of `CODES`.
    reason
        With the figure and the limit.
    advice
        What would fix it, at the command line; empty when nothing would.
    on_paper
        The same for a reader of the exam's page, who has no command line.
    about_mm
        The place on the map that the reason is about; None where it is about no one place.
    """

    code: str
    reason: str
    advice: str = ""
    on_paper: str = ""
    about_mm: tuple[float, float] | None = None
