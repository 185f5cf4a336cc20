"""Settings of `estimate`, shared by the command line, Python and batches."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

from tactile_bayes.errors import UsageError, check_choice
from tactile_bayes.presets import INTERVAL, METHODS, NOISE, SCENES, Background, Method, Noise, Rotation, SceneAsked
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.size.calibration import Calibration
    from tactile_bayes.size.repeatability import Repeatability

GIVEN: Final = "given in Python"
"""Name of a calibration that is in no file."""
FROM_FILE: Final = (
    "background",
    "fit_radius_mm",
    "rotation",
    "max_steps",
    "noise",
    "between_map_sd",
    "accuracy_mm",
    "checkpoint",
    "field_cosines",
)
"""Settings that the command line takes from a settings file only, besides the priors."""

_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "method": METHODS,
    "noise": NOISE,
    "scene": SCENES,
    "background": get_args(Background),
    "rotation": get_args(Rotation),
}


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
        if not 0.0 < self.interval < 1.0:
            raise UsageError(f"interval is {self.interval:g}; give a probability between 0 and 1")
        if self.between_map_sd is not None and self.repeatability is not None:
            raise UsageError("between_map_sd states the spread that the repeatability has learned; give one of them")
        if self.repeatability is not None and self.calibration == "none":
            raise UsageError("a repeatability is for sizes; leave it out, or name a size calibration")
        if self.seed < 0:
            raise UsageError(f"seed is {self.seed}; give a whole number from 0 on")

    @property
    def calibration_name(self) -> str | None:
        """The calibration's name or path; None where none was named."""
        return self.calibration if self.calibration is None or isinstance(self.calibration, str) else GIVEN


def refuse_checkpoint(settings: Settings) -> None:
    """Refuse a checkpoint where several maps are estimated: they would all go on from one.

    Raises
    ------
    UsageError
    """
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one map; give one map, or leave checkpoint out of the settings")
