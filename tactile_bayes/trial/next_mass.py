r"""Prediction for the next mass: a Bayesian model of each modality's errors, with error in the ex-vivo sizes.

For mass i of patient g with true log size :math:`\xi_i`, centred at the mean of the trial,

.. math::
   \ln e_i &= \xi_i + \epsilon_i, \quad \epsilon_i \sim N(0, c_i^2) \\
   \ln y_{ij} &= \xi_i + \beta + (\gamma - 1)\,\xi_i + u_g + b_i + w_{ij}

with bias :math:`\beta`, slope :math:`\gamma` on the logarithm, patient effects :math:`u_g \sim N(0, \rho^2)`, mass
effects :math:`b_i \sim N(0, \tau^2)` and replicate noise :math:`w_{ij} \sim N(0, \omega^2)`. The effects are
integrated out exactly: all that is left is normal, patient by patient. Masses not found enter through their share.

The expected error depends on the root mean square r of bias, slope error and total SD,

.. math:: r^2 = \beta^2 + (\gamma - 1)^2 s_\xi^2 + \rho^2 + \tau^2 + \omega^2,

so the prior is put on it and on how it splits, not on the parts: separate priors favour a larger sum than any of them
says (record 0078). It is uniform in ln r, as far as the caliper's own error lets r be seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.special import erf, expit, log_expit

from tactile_bayes.declarations import Record, rounded
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.ensemble import ensemble
from tactile_bayes.inference.importance import ImportanceOptions, importance
from tactile_bayes.inference.modes import LogDensity, mode_and_covariance
from tactile_bayes.presets import INTERVAL
from tactile_bayes.trial.figures import MIN_PATIENTS, Count
from tactile_bayes.trial.readings import FloatArray, ModalitySizes, Trial, mass_numbers

# Largest total SD of ln size; normal prior SDs of bias and slope - 1.
MOST_TOTAL_SD = 5.0
PRIOR_BIAS, PRIOR_SLOPE = 0.5, 0.5
# Caliper error as a share of the size, where the table gives none: +-5 % in Wellman & Howe (1999), figure 10.
CALIPER = 0.05
# Both parameters of the beta prior of the share of masses missed. With 1/3 the posterior's median is near the share
# observed, also when that is 0 (Kerman 2011, Electron. J. Statist. 5, 1450).
PRIOR_MISS = 1 / 3


ACCURACY_SD = 0.03  #: Monte-Carlo error of interval ends, in posterior SDs.
Sampler = Callable[..., ParameterDraws]  #: Draws from a log density, as `draw` does.


class Middle(Record):
    """Median and ends of the equal-tailed interval of a figure."""

    median: float
    low: float
    high: float

    def shown(self, spec: str) -> str:
        """The median with its interval in brackets."""
        return f"{self.median:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"


class NextOfModality(Record):
    """Posterior of one modality's errors."""

    masses: Count
    patients: Count
    mape_percent: Middle  #: Expected error of the next mass, misses included.
    mape_detected_percent: Middle  #: Expected error of one that is found.
    bias_percent: Middle
    log_slope: Middle  #: Slope of ln size.
    total_sd: Middle
    patient_sd: Middle
    mass_sd: Middle
    replicate_sd: Middle
    miss_share: Middle


class IntervalKind(Record):
    """How intervals are made."""

    kind: Literal["eti"]
    probability: float


class Posterior(Record, eq=False):
    """Posterior of one modality: (n,) draws of each of its figures."""

    summary: NextOfModality
    draws: dict[str, FloatArray]
    diagnostics: dict[str, float]


class NextMass(Record):
    """Posteriors of all modalities, and for every pair the probability that the first errs less on the next mass."""

    modalities: dict[str, NextOfModality]
    interval: IntervalKind
    probability_less_error: dict[str, float]
    left_out: dict[str, str]  #: Modalities without a model, and why.
    diagnostics: dict[str, dict[str, float]]

    def lines(self) -> list[str]:
        """Text lines of the report."""
        lines = ["Bayesian errors-in-variables model, beside the table above and not instead of it:"]
        for name, one in self.modalities.items():
            error, found = one.mape_percent.shown(".1f"), one.mape_detected_percent.shown(".1f")
            lines.append(
                f"{name}: next mass: expected error {error} %, if it is found {found} %; "
                f"bias {one.bias_percent.shown('+.1f')} %, slope of ln size {one.log_slope.shown('.2f')}"
            )
        lines += [f"probability that {pair}: {p:.3f}" for pair, p in self.probability_less_error.items()]
        return [*lines, *(f"{name}: no model: {reason}" for name, reason in self.left_out.items())]


def draw(
    log_density: LogDensity, centre: FloatArray, covariance: FloatArray, *, rng: np.random.Generator
) -> ParameterDraws:
    """Draw from a log density by importance sampling about its mode, or by MCMC where that cannot be trusted.

    The density takes (m, p) arrays to (m,); `centre` and `covariance` guess the mode and the covariance about it. Where
    MCMC, too, does not reach its criteria, `NotConvergedError` says so.
    """
    try:
        mode, about, _ = mode_and_covariance(log_density, centre, scale=np.sqrt(np.diag(covariance)))
        return importance(log_density, mode, about, rng=rng, options=ImportanceOptions(ACCURACY_SD))
    except NotConvergedError:
        return ensemble(log_density, centre, covariance, rng=rng)


def next_mass(trial: Trial, *, sample: Sampler = draw, rng: np.random.Generator) -> NextMass:
    """Fit the model to each modality and compare them.

    The expected error is that of one reading of a mass drawn from the sizes of this trial, of a new patient. Modalities
    are fitted one by one, so that the probability that one errs less takes their errors as independent.
    """
    posteriors, left_out = posteriors_of(trial, sample=sample, rng=rng)
    compared = {}
    for one, other in combinations(posteriors, 2):  # P(A < B) for independent draws, over all pairs of them
        a, b = (posteriors[name].draws["mape_percent"] for name in (one, other))
        below = float(np.mean(np.searchsorted(np.sort(a), b)) / len(a))
        compared[f"{one} errs less than {other}"] = rounded(below)
    return NextMass(
        {name: one.summary for name, one in posteriors.items()},
        IntervalKind("eti", INTERVAL),
        compared,
        left_out,
        {name: one.diagnostics for name, one in posteriors.items()},
    )


def posteriors_of(
    trial: Trial, *, sample: Sampler, rng: np.random.Generator
) -> tuple[dict[str, Posterior], dict[str, str]]:
    """The model of each modality by its name, and why others have none; as `next_mass`."""
    caliper = {
        number: (trial.ex_vivo_sd_mm.get(key) or CALIPER * trial.ex_vivo_mm[key]) / trial.ex_vivo_mm[key]
        for key, number in mass_numbers(trial.ex_vivo_mm).items()
    }
    posteriors: dict[str, Posterior] = {}
    left_out: dict[str, str] = {}
    for name, one in trial.sizes().items():
        found = one.only_detected()
        if len(found.patients) < MIN_PATIENTS:
            left_out[name] = f"needs at least {MIN_PATIENTS} patients with a mass found (has {len(found.patients)})"
            continue
        posteriors[name] = _fit(one, caliper, sample=sample, rng=rng)
    return posteriors, left_out


def _fit(sizes: ModalitySizes, caliper: Mapping[int, float], *, sample: Sampler, rng: np.random.Generator) -> Posterior:
    found = sizes.only_detected()
    model = LogModel(found, np.array([caliper[int(mass)] for mass in found.mass]))
    centre, covariance = model.start()
    drawn = sample(model.log_density, centre, covariance, rng=rng)
    theta = np.asarray(drawn.theta).reshape(-1, len(centre))
    missed = len(sizes.size_mm) - len(found.size_mm)
    misses = rng.beta(missed + PRIOR_MISS, len(found.size_mm) + PRIOR_MISS, len(theta))
    of_found = expected_error_percent(model, theta)
    sds = np.sqrt(np.array(variances(theta)))
    tails = [0.5, 0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2]
    figures = {
        "mape_percent": (1 - misses) * of_found + 100 * misses,
        "mape_detected_percent": of_found,
        "bias_percent": 100 * np.expm1(theta[:, 0]),
        "log_slope": theta[:, 1],
        "total_sd": np.exp(theta[:, 2]),
        "patient_sd": sds[0],
        "mass_sd": sds[1],
        "replicate_sd": sds[2],
        "miss_share": misses,
    }
    middles = {name: Middle(*map(rounded, np.quantile(values, tails).tolist())) for name, values in figures.items()}
    summary = NextOfModality(masses=len(found.size_mm), patients=len(found.patients), **middles)
    return Posterior(summary, figures, {name: rounded(float(value)) for name, value in drawn.diagnostics.items()})


class LogModel:
    """Likelihood and prior of one modality; masses with equal numbers of replicates need only their means.

    `found` are the detected masses, `caliper` the (n,) relative SD of each ex-vivo size.
    """

    def __init__(self, found: ModalitySizes, caliper: FloatArray) -> None:
        self.log_e = np.log(found.ex_vivo_mm)
        self.centre = float(self.log_e.mean())
        self.spread = max(float(self.log_e.std(ddof=1)), 1e-3)
        self._x = self.log_e - self.centre
        self._caliper2 = caliper**2
        self.caliper = math.sqrt(float(np.mean(self._caliper2)))
        logs = [np.log(group) for group in found.replicates_mm]
        self._number = np.array([len(group) for group in logs], dtype=np.float64)
        self._y = np.array([group.mean() for group in logs]) - self.centre
        self._within = float(sum(np.sum((group - group.mean()) ** 2) for group in logs))
        self._freedom = float(np.sum(self._number - 1))
        _, self._patient = np.unique(found.patient, return_inverse=True)
        self._patients = int(self._patient.max()) + 1

    def start(self) -> tuple[FloatArray, FloatArray]:
        """Starting values of the mode, and the covariance about it."""
        off = self._y - self._x
        residual = max(float(off.std()), 0.02)
        within2 = max(self._within / self._freedom, 1e-4) if self._freedom else residual**2
        total2 = residual**2 + within2 * (1 - float(np.mean(1 / self._number)))
        share = min(max(within2 / total2, 0.05), 0.95) if self._freedom else 0.5
        centre = np.array([off.mean(), 1.0, 0.5 * math.log(total2), math.log(share / (1 - share)), 0.0])
        n = len(off)
        spreads = [residual / math.sqrt(n), residual / self.spread / math.sqrt(n), 0.8 / math.sqrt(n)]
        return centre, np.diag(np.array([*spreads, 0.5 if self._freedom else 1.5, 1.5]) ** 2)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) unnormalised log posterior of (m, 5) rows, see `variances`."""
        bias, slope = theta.T[:2]
        rho2, tau2, omega2 = variances(theta)
        # the true size given the ex-vivo one: normal about a shrunken value
        prior2 = max(self.spread**2 - float(np.mean(self._caliper2)), 0.25 * self.spread**2)
        keep = prior2 / (prior2 + self._caliper2)
        mean = bias[:, None] + slope[:, None] * keep * self._x
        variance = slope[:, None] ** 2 * keep * self._caliper2 + tau2[:, None] + omega2[:, None] / self._number[None, :]
        off = (self._y - mean) / variance
        log_like = -0.5 * np.sum((self._y - mean) * off + np.log(variance), axis=1)
        log_like += self._patients_part(rho2, off, 1 / variance)
        log_like -= 0.5 * (self._within / omega2 + self._freedom * np.log(omega2))
        return np.asarray(log_like + log_prior(theta, spread=self.spread, caliper=self.caliper))

    def _patients_part(self, rho2: FloatArray, off: FloatArray, precision: FloatArray) -> FloatArray:
        """Log-likelihood contribution of the shared patient effect (Woodbury, patient by patient)."""
        sums = np.zeros((2, len(rho2), self._patients))
        for row, values in enumerate((off, precision)):
            np.add.at(sums[row].T, self._patient, values.T)
        within = 1 + rho2[:, None] * sums[1]
        return np.asarray(0.5 * np.sum(rho2[:, None] * sums[0] ** 2 / within - np.log(within), axis=1))


def variances(theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variances of ln size: between patients, between masses of a patient, between readings of a mass.

    `theta` has (m, 5) rows: bias, slope, logarithm of the total SD, logit of the share of the total variance that
    single readings have, logit of the patients' share of the rest.
    """
    total2 = _total_variance(theta[:, 2])
    # at least 1e-12 of the variance is the readings' own, so that no logarithm of 0 is taken
    of_readings, of_patients = np.clip(expit(theta[:, 3]), 1e-12, 1.0), expit(theta[:, 4])
    rest = total2 * expit(-theta[:, 3])
    return rest * of_patients, rest * (1 - of_patients), total2 * of_readings


def log_prior(theta: FloatArray, *, spread: float, caliper: float) -> FloatArray:
    r"""(m,) unnormalised log prior, with the Jacobians of logarithms and logits.

    For `theta` see `variances`. `spread` is the SD of ln ex-vivo size over the masses, `caliper` the root mean square
    of the calipers' relative SDs.

    :math:`(r^2 + c^2)^{-3/2}` in bias, slope error and total SD, which is uniform in ln r for r well above the
    caliper's c: given the SD, bias and slope error are bivariate Cauchy with the SD as scale (Zellner & Siow 1980), and
    the SD has Jeffreys' prior. Both shares of the variance are uniform. Normal priors keep bias and slope finite.
    """
    bias, slope, log_total, *logits = theta.T
    off = slope - 1
    square = bias**2 + (off * spread) ** 2 + _total_variance(log_total) + caliper**2
    prior = log_total - 1.5 * np.log(square) - 0.5 * ((bias / PRIOR_BIAS) ** 2 + (off / PRIOR_SLOPE) ** 2)
    for one in logits:
        prior = prior + log_expit(one) + log_expit(-one)
    outside = (log_total < -12) | (log_total > math.log(MOST_TOTAL_SD))
    return np.asarray(np.where(outside, -np.inf, prior))


def expected_error_percent(model: LogModel, theta: FloatArray) -> FloatArray:
    r"""(n,) mean of :math:`100 |y/\xi - 1|` for one reading of a new mass that is found.

    On the logarithm the error is normal; its size-dependent mean is averaged over normal sizes like the trial's.
    """
    at, weight = np.polynomial.hermite_e.hermegauss(15)
    sd = np.exp(theta[:, 2])[:, None]
    mean = theta[:, :1] + (theta[:, 1:2] - 1) * model.spread * at[None, :]
    folded = np.exp(mean + sd**2 / 2) * erf((mean / sd + sd) / math.sqrt(2)) - erf(mean / sd / math.sqrt(2))
    return np.asarray(100 * (folded @ weight / weight.sum()))


def _total_variance(log_sd: FloatArray) -> FloatArray:
    """Variance of ln size, clipped against overflow where the prior excludes it anyway."""
    return np.asarray(np.exp(2 * np.clip(log_sd, -14, 5)))
