"""Settings of `estimate` and of `compare`, each with its default and range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

from tactile_bayes.errors import UsageError, check_choice, check_number, meant
from tactile_bayes.presets import (
    INTERVAL,
    METHODS,
    MOST_FIELD_COSINES,
    NOISE,
    REGISTRATION_MM,
    SCENES,
    Background,
    Method,
    Noise,
    Rotation,
    SceneAsked,
)
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.size.pooling import Calibration
    from tactile_bayes.size.site import Repeatability


# --- Settings of `estimate`, shared by the command line, Python and batches.

GIVEN: Final = "given in Python"
"""Name of a calibration that is in no file."""

_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "method": METHODS,
    "noise": NOISE,
    "scene": SCENES,
    "background": get_args(Background),
    "rotation": get_args(Rotation),
}


_RANGES: Final[Mapping[str, tuple[float, float | None, str]]] = {
    "seed": (0, None, "whole"),
    "interval": (0, 1, "open"),
    "fit_radius_mm": (0, None, "open"),
    "max_steps": (150, None, "whole"),
    "accuracy_sd": (0.001, 0.5, ""),
    "between_map_sd": (0, 2, ""),
    "accuracy_mm": (0.0001, 10, ""),
    "field_cosines": (6, MOST_FIELD_COSINES, "whole"),
}
"""Ranges of settings, as `settings.schema.json` and the command line have them; open: without the ends."""
_MOST_PRIOR: Final[Mapping[str, float]] = {
    "amplitude_sd": 1000,
    "width_median_mm": 100,
    "log_width_sd": 10,
    "log_ratio_sd": 5,
    "tilt_sd": 1000,
}
"""Largest value of each field of `BumpPrior`; all are above 0."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of `estimate`; picklable, so that worker processes can receive them.

    Parameters
    ----------
    calibration
        Name or path, or the calibration itself; None takes the shipped one, if it fits.
    method
        One of `presets.METHODS`.
    seed
        Of the random numbers.
    interval
        Probability of the intervals.
    background, fit_radius_mm, rotation, centre_mm, noise, field_cosines
        As `FitOptions`; None takes what the calibration's maps were fitted with.
    max_steps, accuracy_sd, scene, accuracy_mm
        As `EstimateOptions`.
    between_map_sd
        SD of ln size between maps of one mass, taken as known; None learns it.
    repeatability
        Spread between exams of one mass as this site's repeated exams show it; sizes then have one interval.
    known
        Properties of the body, by the names of `HiddenTerms`.
    prior
        Values of `BumpPrior` that differ from its defaults.
    checkpoint
        Where MCMC keeps its state.
    settings_file
        Where some of these were read from, for the provenance.

    Raises
    ------
    UsageError
        When a setting has a value that it cannot have.
    """

    calibration: str | Calibration | None = None
    method: Method = "importance"
    seed: int = 1
    interval: float = INTERVAL
    background: Background | None = None
    fit_radius_mm: float | None = None
    rotation: Rotation = "auto"
    centre_mm: tuple[float, float] | None = None
    max_steps: int | None = None
    noise: Noise | None = None
    accuracy_sd: float | None = None
    between_map_sd: float | None = None
    repeatability: Repeatability | None = None
    known: tuple[tuple[str, float], ...] = ()
    scene: SceneAsked = "auto"
    accuracy_mm: float | None = None
    prior: Mapping[str, float] | None = None
    checkpoint: Path | None = None
    field_cosines: int | None = None
    settings_file: Path | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value is not None or name not in ("background", "noise"):
                check_choice(name, value, choices)
        for name, (least, most, how) in _RANGES.items():
            value = getattr(self, name)
            if value is not None or name in ("seed", "interval"):
                check_number(name, value, least, most, whole=how == "whole", open_ends=how == "open")
        for part in () if self.centre_mm is None else _pair("centre_mm", self.centre_mm):
            check_number("a coordinate of centre_mm", part)
        for name, value in self.known:
            check_number(f"known {name}", value)
        _check_prior(self.prior or {})
        if self.between_map_sd is not None and self.repeatability is not None:
            raise UsageError("between_map_sd states the spread that the repeatability has learned; give one of them")
        if self.repeatability is not None and self.calibration == "none":
            raise UsageError("a repeatability is for sizes; leave it out, or name a size calibration")

    @property
    def calibration_name(self) -> str | None:
        """The calibration's name or path; None where none was named."""
        return self.calibration if self.calibration is None or isinstance(self.calibration, str) else GIVEN


def _pair(name: str, value: object) -> tuple[object, object]:
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise UsageError(f"{name} is {value!r}; give two numbers")
    return value[0], value[1]


def _check_prior(prior: Mapping[str, float]) -> None:
    for name, value in prior.items():
        if name not in _MOST_PRIOR:
            raise UsageError(f"no prior is called {name!r}; {meant(str(name), _MOST_PRIOR)}")
        check_number(f"prior {name}", value, 0, _MOST_PRIOR[name], open_ends=True)


def refuse_checkpoint(settings: Settings) -> None:
    """Refuse a checkpoint where several maps are estimated: they would all go on from one.

    Raises
    ------
    UsageError
    """
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one map; give one map, or leave checkpoint out of the settings")


# --- How visits are compared: options of `compare`, shared by the command line and Python.

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
