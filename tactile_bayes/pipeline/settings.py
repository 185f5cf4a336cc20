"""The settings of one `estimate`, whoever calls it: command line, Python, several maps at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactile_bayes.presets import INTERVAL
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.size.calibration import Calibration

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


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of one `estimate`; picklable, so that a worker process can have them.

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
    known
        Properties of the body, by the names of `HiddenTerms`.
    prior
        Values of `BumpPrior` that differ from its defaults.
    checkpoint
        Where MCMC keeps its state.
    settings_file
        Where some of these were read from, for the provenance.
    """

    calibration: str | Calibration | None = None
    method: str = "importance"
    seed: int = 1
    interval: float = INTERVAL
    background: str | None = None
    fit_radius_mm: float | None = None
    rotation: str = "auto"
    centre_mm: tuple[float, float] | None = None
    max_steps: int | None = None
    noise: str | None = None
    accuracy_sd: float | None = None
    between_map_sd: float | None = None
    known: tuple[tuple[str, float], ...] = ()
    scene: str = "auto"
    accuracy_mm: float | None = None
    prior: Mapping[str, float] | None = None
    checkpoint: Path | None = None
    field_cosines: int | None = None
    settings_file: Path | None = None

    @property
    def calibration_name(self) -> str | None:
        """The calibration's name or path; None where none was named."""
        return self.calibration if self.calibration is None or isinstance(self.calibration, str) else GIVEN
