"""How visits are compared: options of `compare`, shared by the command line and Python."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date

from tactile_bayes.errors import UsageError, check_number
from tactile_bayes.presets import REGISTRATION_MM
from tactile_bayes.records import dataclass

GROWN_BY = (0.2,)
"""Shares of the diameter that a growth's probability is told for; 20 % is the step of RECIST 1.1."""


@dataclass(frozen=True, slots=True)
class Comparing:
    """How visits are compared.

    Parameters
    ----------
    days
        Time of each visit in days, the first at 0; None where it is not known.
    grown_by
        Shares of the diameter by which it may have grown or more.
    same_mass
        Whether somebody says that the visits are of one mass, where their places do not show it.
    registration_mm
        SD each way of a mass's place between two visits.

    Raises
    ------
    UsageError
        When a value cannot be one.
    """

    days: tuple[float, ...] | None = None
    grown_by: tuple[float, ...] = GROWN_BY
    same_mass: bool = False
    registration_mm: float = REGISTRATION_MM

    def __post_init__(self) -> None:
        for share in self.grown_by:
            check_number("a share of grown_by", share, -1, 10, open_ends=True)
        for day in self.days or ():
            check_number("a day of days", day)
        check_number("registration_mm", self.registration_mm, 0, open_ends=True)

    def check_visits(self, visits: int) -> None:
        """Refuse days that are no times of so many visits.

        Raises
        ------
        UsageError
        """
        if self.days is None:
            return
        if len(self.days) != visits:
            given, later = len(self.days) - 1, visits - 1
            raise UsageError(f"times are given for {given} later visits, and there are {later}; give one for each")
        if any(after <= before for before, after in zip(self.days, self.days[1:], strict=False)):
            listed = ", ".join(f"{day:g}" for day in self.days)
            raise UsageError(f"the visits' days are {listed}; give them in order, each later than the one before")


def times_of(days: Sequence[float] | None, dates: Sequence[str] | None) -> tuple[float, ...] | None:
    """Time of each visit in days, the first at 0, from the days of the later ones or from all dates; None for neither.

    Raises
    ------
    UsageError
        When both are given, or something is no date.
    """
    if days is not None and dates is not None:
        raise UsageError("days and dates both say when the visits were; give one of them")
    if dates is not None:
        return days_of_dates(dates)
    return None if days is None else (0.0, *days)


def days_of_dates(dates: Sequence[str]) -> tuple[float, ...]:
    """Days from the first of some dates, such as 2026-03-01.

    Raises
    ------
    UsageError
        Naming what is no date.
    """
    found = []
    for text in dates:
        try:
            found.append(date.fromisoformat(str(text).strip()))
        except ValueError:
            raise UsageError(f"{str(text).strip()!r} is no date; give year-month-day, such as 2026-03-01") from None
    return tuple(float((one - found[0]).days) for one in found)
