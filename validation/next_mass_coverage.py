"""How often `validate --bayes` holds the error of the next mass: ``python -m validation next_mass_coverage``.

Prints the table of docs/coverage.md. Each trial is simulated from the model with log-normal errors and fitted as the
command fits it; ranks of the true error among the draws give the share held at each probability.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import tactile_bayes.trial.next_mass as model
from tactile_bayes.geometry import FloatArray
from tactile_bayes.trial.readings import MassKey, Reading, Trial
from validation.common import Table, parser, share
from validation.simulated_trials import ErrorModel

LEVELS = (0.5, 0.8, 0.95)
BIAS, CALIPER = 0.05, 0.05
LogPrior = Callable[..., FloatArray]


@dataclass(frozen=True, slots=True)
class Design:
    """Patients with as many masses each, readings of each mass, SDs of ln size, and the share missed."""

    patients: int
    masses: int
    readings: int
    patient_sd: float
    mass_sd: float
    reading_sd: float
    miss: float = 0.0

    @property
    def truth(self) -> ErrorModel:
        """Errors of a single reading."""
        return ErrorModel(BIAS, math.hypot(self.mass_sd, self.reading_sd), patient_sd=self.patient_sd, miss=self.miss)


DESIGNS = {
    "24 patients, three maps": Design(24, 1, 3, 0.0, 0.18, 0.15),
    "24 patients, one in 25 missed": Design(24, 1, 3, 0.0, 0.18, 0.15, miss=0.04),
    "24 patients, one reading, no miss": Design(24, 1, 1, 0.0, 0.36, 0.15),
    "12 patients, two masses each": Design(12, 2, 3, 0.15, 0.10, 0.15),
    "10 patients, three maps": Design(10, 1, 3, 0.0, 0.18, 0.15),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each design."""
    words = parser(__name__, __doc__)
    words.add_argument("--trials", type=int, default=400)
    words.add_argument("--seed", type=int, default=1999)
    words.add_argument("--old-prior", action="store_true", help="control: half-normal priors on the three SDs")
    words.add_argument("--keep", action="store_true", help="keep the table for docs/coverage.md")
    given = words.parse_args(arguments)
    if given.old_prior:
        model.log_prior = half_normal_log_prior
    heads = [f"{level:.0%} covers" for level in LEVELS]
    table = Table("next-mass", "design", "true error %", "median of medians %", *heads, "error if found, 95 % covers")
    for name, design in DESIGNS.items():
        found = list(ranks(design, trials=given.trials, seed=given.seed))
        shares = [_held([one[0] for one in found], level) for level in LEVELS]
        shares.append(_held([one[1] for one in found], 0.95))
        medians = np.median([one[2] for one in found])
        table.add(name, f"{design.truth.true_mape_percent:.1f}", f"{medians:.1f}", *shares)
    if given.keep:
        table.keep()


def ranks(
    design: Design, *, trials: int, seed: int, sample: model.Sampler = model.draw
) -> Iterator[tuple[float, float, float]]:
    """Rank of the true error, with and without misses, in (0, 1), and the median, of each trial that can be fitted."""
    truth = design.truth.true_mape_percent
    of_found = 100 * (truth / 100 - design.miss) / (1 - design.miss)
    for trial in range(trials):
        readings, ex_vivo_mm = simulate(design, np.random.default_rng([seed, trial]))
        rng = np.random.default_rng([seed, trial, 1])
        found = model.fit_modalities(Trial(readings, ex_vivo_mm), sample=sample, rng=rng)[0].get("tactile")
        if found is not None:
            yield (
                float(np.mean(found.draws["mape_percent"] < truth)),
                float(np.mean(found.draws["mape_detected_percent"] < of_found)),
                found.summary.mape_percent.median,
            )


def simulate(design: Design, rng: np.random.Generator) -> tuple[list[Reading], dict[MassKey, float]]:
    """The readings of one trial, and the ex-vivo sizes with the caliper's error."""
    readings, ex_vivo_mm = [], {}
    for patient in range(design.patients):
        shared = rng.normal(0, design.patient_sd)
        for mass in range(design.masses):
            key, size = (f"P{patient:03d}", str(mass)), rng.normal(2.8, 0.4)
            ex_vivo_mm[key] = math.exp(size + rng.normal(0, CALIPER))
            own, missed = size + BIAS + shared + rng.normal(0, design.mass_sd), rng.random() < design.miss
            for number in range(1, design.readings + 1):
                size_mm = math.exp(own + rng.normal(0, design.reading_sd))
                status = "not_detected" if missed else "detected"
                readings.append(Reading(key, "tactile", number, status, None if missed else size_mm))
    return readings, ex_vivo_mm


def half_normal_log_prior(theta: FloatArray, *, spread: float, caliper: float) -> FloatArray:
    """The prior before record 0078, in today's parameters: SDs of 0.5 on each of the three SDs."""
    del spread, caliper
    bias, slope, log_total, of_readings, of_patients = theta.T
    parts = np.maximum(np.array(model.variances(theta)), 1e-300)
    q, r = (1 / (1 + np.exp(-np.clip(one, -30, 30))) for one in (of_readings, of_patients))
    jacobian = 6 * log_total + 2 * np.log1p(-q) + np.log(q) + np.log(r) + np.log1p(-r)
    prior = -0.5 * ((bias / 0.5) ** 2 + ((slope - 1) / 0.5) ** 2) - 0.5 * parts.sum(axis=0) / 0.25
    inside = (log_total > -12) & (log_total < math.log(model.MOST_TOTAL_SD))
    return np.asarray(np.where(inside, prior + jacobian - 0.5 * np.sum(np.log(parts), axis=0), -np.inf))


def _held(found: list[float], level: float) -> str:
    return share([abs(one - 0.5) < level / 2 for one in found])
