"""Reasons for giving no number: a sentence, a code for programs, and what would help."""

from __future__ import annotations

from tactile_bayes.records import dataclass

CODES = ("empty", "undetected", "coarse", "unresolved", "window", "prior", "extrapolated", "method")


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
        What would fix it; empty when nothing would.
    """

    code: str
    reason: str
    advice: str = ""
