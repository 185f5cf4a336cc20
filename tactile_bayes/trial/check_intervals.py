"""Coverage of the chosen intervals in simulated trials with this trial's size and errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tactile_bayes.trial.accuracy import mape_figure
from tactile_bayes.trial.jackknife import MIN_PATIENTS
from tactile_bayes.trial.proportion import clopper_pearson
from tactile_bayes.trial.readings import FloatArray, ModalitySizes


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Errors of one modality in log size: normal, partly shared by the masses of a patient.

    Attributes
    ----------
    bias, patient_sd, mass_sd
        Mean of ln(size / ex vivo), and SDs of the patient's and of the mass's own part.
    miss
        Probability that a mass is not found.
    """

    bias: float
    mass_sd: float
    patient_sd: float = 0.0
    miss: float = 0.0

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
    """Coverage of the percent error's intervals in simulated trials.

    Attributes
    ----------
    covered, low_misses, high_misses
        Trials whose interval holds the true error, lies above it, or lies below it.
    undefined
        Trials without an interval; not counted in `trials`.
    median_width_ratio
        Median of the upper over the lower end.
    """

    model: ErrorModel
    trials: int
    covered: int
    low_misses: int
    high_misses: int
    undefined: int
    median_width_ratio: float
    interval: tuple[float, float] = field(default=(0.0, 1.0))

    @property
    def share(self) -> float:
        """Share of trials whose interval covered the true error."""
        return self.covered / self.trials


def observed_errors(sizes: ModalitySizes) -> ErrorModel | None:
    """Error model of a trial: mean and SD of log ratios of found masses, share of missed masses."""
    found = sizes.only_detected()
    if len(found.size_mm) < 3:
        return None
    logs = np.log(found.size_mm) - np.log(found.ex_vivo_mm)
    return ErrorModel(float(logs.mean()), float(logs.std(ddof=1)), miss=1 - len(logs) / len(sizes.size_mm))


def simulate(
    patient: np.ndarray[tuple[int], np.dtype[np.int64]],
    ex_vivo_mm: FloatArray,
    model: ErrorModel,
    *,
    rng: np.random.Generator,
    name: str = "tactile",
) -> ModalitySizes:
    """Simulate one trial of these patients and masses with errors from the model."""
    n = len(ex_vivo_mm)
    _, index = np.unique(patient, return_inverse=True)
    shared = rng.normal(0, model.patient_sd, index.max() + 1)[index] if model.patient_sd else 0.0
    size = ex_vivo_mm * np.exp(model.bias + shared + rng.normal(0, model.mass_sd, n))
    size[rng.random(n) < model.miss] = 0.0
    none = np.zeros(0)
    return ModalitySizes(name, patient, ex_vivo_mm, size, (none,) * n)


def check_intervals(
    sizes: ModalitySizes, model: ErrorModel, *, confidence: float, trials: int, seed: int
) -> IntervalCheck | None:
    """Count how often intervals of the percent error, by the method in `confidence`, cover the true one.

    Parameters
    ----------
    sizes
        Gives the patients and the ex-vivo sizes, which stay as they are.
    model
        Of the errors; `observed_errors` gives those of the trial.

    Returns
    -------
    None below `MIN_PATIENTS` patients, where no intervals are given.
    """
    if len(sizes.patients) < MIN_PATIENTS:
        return None
    truth = model.true_mape_percent
    ends = np.array(list(_ends(sizes, model, confidence=confidence, trials=trials, seed=seed)))
    defined = ends[np.isfinite(ends[:, 0])]
    if len(defined) == 0:
        return None
    below, above = int(np.sum(defined[:, 1] < truth)), int(np.sum(defined[:, 0] > truth))
    covered = len(defined) - below - above
    return IntervalCheck(
        model=model,
        trials=len(defined),
        covered=covered,
        low_misses=above,
        high_misses=below,
        undefined=trials - len(defined),
        median_width_ratio=float(np.median(defined[:, 1] / np.maximum(defined[:, 0], 1e-300))),
        interval=clopper_pearson(covered, len(defined), confidence=0.95),
    )


def check_all(
    sizes: Mapping[str, ModalitySizes], *, confidence: float, trials: int, seed: int
) -> dict[str, IntervalCheck]:
    """Run `check_intervals` for every modality with errors to simulate."""
    checks = {
        name: check_intervals(one, model, confidence=confidence, trials=trials, seed=seed)
        for name, one in sizes.items()
        if (model := observed_errors(one)) is not None
    }
    return {name: check for name, check in checks.items() if check is not None}


def _ends(
    sizes: ModalitySizes, model: ErrorModel, *, confidence: float, trials: int, seed: int
) -> list[tuple[float, float]]:
    rng = np.random.default_rng([seed, len(sizes.size_mm)])
    ends = []
    for _ in range(trials):
        one = simulate(sizes.patient, sizes.ex_vivo_mm, model, rng=rng)
        found = mape_figure(one, confidence=confidence).interval
        ends.append(found or (math.nan, math.nan))
    return ends
