"""Trials with a trial's size and errors: how often intervals of the percent error cover the true one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.accuracy import mape_figure
from tactile_bayes.trial.figures import MIN_PATIENTS, Intervals, clopper_pearson
from tactile_bayes.trial.readings import FloatArray, ModalitySizes


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Errors of one modality in log size: normal, partly shared by the masses of a patient."""

    bias: float  #: Mean of ln(size / ex vivo).
    mass_sd: float  #: SD of the mass's own part.
    patient_sd: float = 0.0  #: SD of the part that a patient's masses share.
    miss: float = 0.0  #: Probability that a mass is not found.

    @property
    def true_mape_percent(self) -> float:
        r"""Expected percent error; a miss counts as 100 %.

        .. math:: E|e^X - 1| = e^{b + s^2/2}(2\Phi(b/s + s) - 1) - (2\Phi(b/s) - 1)
        """
        s = math.hypot(self.mass_sd, self.patient_sd)
        if s == 0:
            return 100 * ((1 - self.miss) * abs(math.expm1(self.bias)) + self.miss)
        found = math.exp(self.bias + s * s / 2) * math.erf((self.bias / s + s) / math.sqrt(2))
        return 100 * ((1 - self.miss) * (found - math.erf(self.bias / s / math.sqrt(2))) + self.miss)


@dataclass(frozen=True, slots=True)
class IntervalCheck:
    """Coverage of the percent error's intervals in simulated trials."""

    trials: int  #: Simulated trials with an interval.
    covered: int  #: Trials whose interval holds the true error.
    share: float
    share_interval: tuple[float, float]
    above: int  #: Trials whose interval lies above the true error.
    below: int  #: Trials whose interval lies below it.
    undefined: int  #: Trials without an interval.


def simulate(
    patient: npt.NDArray[np.int64], ex_vivo_mm: FloatArray, model: ErrorModel, *, rng: np.random.Generator
) -> ModalitySizes:
    """Simulate one trial of these patients and masses with errors from the model."""
    n = len(ex_vivo_mm)
    _, index = np.unique(patient, return_inverse=True)
    shared = rng.normal(0, model.patient_sd, index.max() + 1)[index] if model.patient_sd else 0.0
    size = ex_vivo_mm * np.exp(model.bias + shared + rng.normal(0, model.mass_sd, n))
    size[rng.random(n) < model.miss] = 0.0
    return ModalitySizes("tactile", patient, ex_vivo_mm, size, (np.zeros(0),) * n)


def check_intervals(
    sizes: ModalitySizes, model: ErrorModel, *, intervals: Intervals, trials: int, seed: int
) -> IntervalCheck | None:
    """Count how often intervals of the percent error, by their method, cover the true one.

    Patients and ex-vivo sizes stay as they are. None below `MIN_PATIENTS` patients, where no intervals are given.
    """
    if len(sizes.patients) < MIN_PATIENTS:
        return None
    truth, rng = model.true_mape_percent, np.random.default_rng([seed, len(sizes.size_mm)])
    made = (simulate(sizes.patient, sizes.ex_vivo_mm, model, rng=rng) for _ in range(trials))
    ends = np.array([mape_figure(one, intervals=intervals).interval or (math.nan, math.nan) for one in made])
    defined = ends[np.isfinite(ends[:, 0])]
    if len(defined) == 0:
        return None
    below, above = int(np.sum(defined[:, 1] < truth)), int(np.sum(defined[:, 0] > truth))
    covered = len(defined) - below - above
    return IntervalCheck(
        trials=len(defined),
        covered=covered,
        share=covered / len(defined),
        share_interval=clopper_pearson(covered, len(defined), confidence=0.95),
        above=above,
        below=below,
        undefined=trials - len(defined),
    )
