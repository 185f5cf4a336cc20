r"""Prediction for the next mass: a Bayesian model of each modality's errors, with error in the ex-vivo sizes.

For mass i of patient g with true log size :math:`\xi_i`, centred at the mean of the trial,

.. math::
   \ln e_i &= \xi_i + \epsilon_i, \quad \epsilon_i \sim N(0, c_i^2) \\
   \ln y_{ij} &= \xi_i + \beta + (\gamma - 1)\,\xi_i + u_g + b_i + w_{ij}

with bias :math:`\beta`, slope :math:`\gamma` on the logarithm, patient effects :math:`u_g \sim N(0, \rho^2)`, mass
effects :math:`b_i \sim N(0, \tau^2)` and replicate noise :math:`w_{ij} \sim N(0, \omega^2)`. The effects are
integrated out exactly: what is left is a multivariate normal per patient. Masses not detected enter by their share.

The expected error depends on the root mean square r of bias, slope error and total SD,

.. math:: r^2 = \beta^2 + (\gamma - 1)^2 s_\xi^2 + \rho^2 + \tau^2 + \omega^2,

so the prior is on r and on the shares of its parts: separate priors on the parts favour a large sum (record 0078). It
is uniform in ln r where r is well above the caliper's own error.
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


class ModalityErrors(Record):
    """Posterior of one modality's errors."""

    masses: Count
    patients: Count
    mape_percent: Middle  #: Expected error of the next mass, misses included.
    mape_detected_percent: Middle  #: Expected error of a mass that is detected.
    bias_percent: Middle
    log_slope: Middle  #: Slope of ln size.
    total_sd: Middle
    patient_sd: Middle
    mass_sd: Middle
    replicate_sd: Middle
    miss_share: Middle


class IntervalKind(Record):
    """Kind and probability of the intervals: equal-tailed."""

    kind: Literal["eti"]
    probability: float


class Posterior(Record, eq=False):
    """Posterior of one modality's errors: (n,) draws of each figure, and their summary."""

    summary: ModalityErrors
    draws: dict[str, FloatArray]
    diagnostics: dict[str, float]


class NextMass(Record):
    """Posteriors of all modalities, and for each pair the probability that the first errs less on the next mass."""

    modalities: dict[str, ModalityErrors]
    interval: IntervalKind
    probability_less_error: dict[str, float]
    left_out: dict[str, str]  #: Modalities without a model, and why.
    diagnostics: dict[str, dict[str, float]]

    def lines(self) -> list[str]:
        """Text lines of the report."""
        lines = ["Bayesian errors-in-variables model, beside the table above and not instead of it:"]
        for name, summary in self.modalities.items():
            error, if_detected = summary.mape_percent.shown(".1f"), summary.mape_detected_percent.shown(".1f")
            lines.append(
                f"{name}: next mass: expected error of one reading {error} %, if it is found {if_detected} %; "
                f"bias {summary.bias_percent.shown('+.1f')} %, slope of ln size {summary.log_slope.shown('.2f')}"
            )
        lines += [f"probability that {pair}: {p:.3f}" for pair, p in self.probability_less_error.items()]
        return [*lines, *(f"{name}: no model: {reason}" for name, reason in self.left_out.items())]


def draw(
    log_density: LogDensity, centre: FloatArray, covariance: FloatArray, *, rng: np.random.Generator
) -> ParameterDraws:
    """Draw from a log density by importance sampling about its mode, or by MCMC where that cannot be trusted.

    The density maps (m, p) arrays to (m,); `centre` and `covariance` guess the mode and the covariance about it.
    `NotConvergedError` where MCMC does not converge either.
    """
    try:
        mode, about, _ = mode_and_covariance(log_density, centre, scale=np.sqrt(np.diag(covariance)))
        return importance(log_density, mode, about, rng=rng, options=ImportanceOptions(ACCURACY_SD))
    except NotConvergedError:
        return ensemble(log_density, centre, covariance, rng=rng)


def next_mass(trial: Trial, *, sample: Sampler = draw, rng: np.random.Generator) -> NextMass:
    """Fit the model to each modality and compare them.

    The expected error is that of one reading of a mass with a size like the trial's, of a new patient. Modalities are
    fitted one by one, so the probability that one errs less takes their errors as independent.
    """
    posteriors, left_out = fit_modalities(trial, sample=sample, rng=rng)
    probabilities = {}
    for first, second in combinations(posteriors, 2):  # P(A < B) for independent draws, over all pairs of them
        a, b = (posteriors[name].draws["mape_percent"] for name in (first, second))
        below = float(np.mean(np.searchsorted(np.sort(a), b)) / len(a))
        probabilities[f"{first} errs less than {second}"] = rounded(below)
    return NextMass(
        {name: first.summary for name, first in posteriors.items()},
        IntervalKind("eti", INTERVAL),
        probabilities,
        left_out,
        {name: first.diagnostics for name, first in posteriors.items()},
    )


def fit_modalities(
    trial: Trial, *, sample: Sampler, rng: np.random.Generator
) -> tuple[dict[str, Posterior], dict[str, str]]:
    """Posterior of each modality by name, and the reason for each modality without one."""
    caliper = {
        number: (trial.ex_vivo_sd_mm.get(key) or CALIPER * trial.ex_vivo_mm[key]) / trial.ex_vivo_mm[key]
        for key, number in mass_numbers(trial.ex_vivo_mm).items()
    }
    posteriors: dict[str, Posterior] = {}
    left_out: dict[str, str] = {}
    for name, sizes in trial.sizes().items():
        detected = sizes.only_detected()
        if len(detected.patients) < MIN_PATIENTS:
            left_out[name] = f"needs at least {MIN_PATIENTS} patients with a mass found (has {len(detected.patients)})"
            continue
        try:
            posteriors[name] = _posterior(sizes, caliper, sample=sample, rng=rng)
        except NotConvergedError as error:
            left_out[name] = str(error).partition(";")[0]
    return posteriors, left_out


def _posterior(
    sizes: ModalitySizes, caliper: Mapping[int, float], *, sample: Sampler, rng: np.random.Generator
) -> Posterior:
    detected = sizes.only_detected()
    model = LogModel(detected, np.array([caliper[int(mass)] for mass in detected.mass]))
    centre, covariance = model.start()
    draws = sample(model.log_density, centre, covariance, rng=rng)
    theta = np.asarray(draws.theta).reshape(-1, len(centre))
    missed = len(sizes.size_mm) - len(detected.size_mm)
    misses = rng.beta(missed + PRIOR_MISS, len(detected.size_mm) + PRIOR_MISS, len(theta))
    error_of_detected = expected_error_percent(model, theta)
    sds = np.sqrt(np.array(variances(theta)))
    probabilities = [0.5, 0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2]
    figures = {
        "mape_percent": (1 - misses) * error_of_detected + 100 * misses,
        "mape_detected_percent": error_of_detected,
        "bias_percent": 100 * np.expm1(theta[:, 0]),
        "log_slope": theta[:, 1],
        "total_sd": np.exp(theta[:, 2]),
        "patient_sd": sds[0],
        "mass_sd": sds[1],
        "replicate_sd": sds[2],
        "miss_share": misses,
    }
    summaries = {
        name: Middle(*map(rounded, np.quantile(values, probabilities).tolist())) for name, values in figures.items()
    }
    summary = ModalityErrors(masses=len(detected.size_mm), patients=len(detected.patients), **summaries)
    return Posterior(summary, figures, {name: rounded(float(value)) for name, value in draws.diagnostics.items()})


class LogModel:
    """Likelihood and prior of one modality, from `detected` masses and the (n,) relative SD of each ex-vivo size.

    Of the replicates it needs each mass's mean and number, and the pooled sum of squares.
    """

    def __init__(self, detected: ModalitySizes, caliper: FloatArray) -> None:
        self.log_e = np.log(detected.ex_vivo_mm)
        self.centre = float(self.log_e.mean())
        self.spread = max(float(self.log_e.std(ddof=1)), 1e-3)
        self._x = self.log_e - self.centre
        self._caliper2 = caliper**2
        self.caliper = math.sqrt(float(np.mean(self._caliper2)))
        logs = [np.log(group) for group in detected.replicates_mm]
        self._number = np.array([len(group) for group in logs], dtype=np.float64)
        self._y = np.array([group.mean() for group in logs]) - self.centre
        self._within = float(sum(np.sum((group - group.mean()) ** 2) for group in logs))
        self._freedom = float(np.sum(self._number - 1))
        _, self._patient = np.unique(detected.patient, return_inverse=True)
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
        # the true log size given the ex-vivo one: normal about a value shrunk towards the mean
        prior2 = max(self.spread**2 - float(np.mean(self._caliper2)), 0.25 * self.spread**2)
        shrinkage = prior2 / (prior2 + self._caliper2)
        mean = bias[:, None] + slope[:, None] * shrinkage * self._x
        variance = slope[:, None] ** 2 * shrinkage * self._caliper2 + tau2[:, None]
        variance = variance + omega2[:, None] / self._number
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
    slope_error = slope - 1
    square = bias**2 + (slope_error * spread) ** 2 + _total_variance(log_total) + caliper**2
    prior = log_total - 1.5 * np.log(square) - 0.5 * ((bias / PRIOR_BIAS) ** 2 + (slope_error / PRIOR_SLOPE) ** 2)
    for logit in logits:
        prior = prior + log_expit(logit) + log_expit(-logit)
    outside = (log_total < -12) | (log_total > math.log(MOST_TOTAL_SD))
    return np.asarray(np.where(outside, -np.inf, prior))


def expected_error_percent(model: LogModel, theta: FloatArray) -> FloatArray:
    r"""(n,) mean of :math:`100 |y/\xi - 1|` for one reading of a new mass that is found.

    On the logarithm the error is normal; its size-dependent mean is averaged over normal sizes like the trial's.
    """
    nodes, weight = np.polynomial.hermite_e.hermegauss(15)
    sd = np.exp(theta[:, 2])[:, None]
    mean = theta[:, :1] + (theta[:, 1:2] - 1) * model.spread * nodes[None, :]
    folded = np.exp(mean + sd**2 / 2) * erf((mean / sd + sd) / math.sqrt(2)) - erf(mean / sd / math.sqrt(2))
    return np.asarray(100 * (folded @ weight / weight.sum()))


def _total_variance(log_sd: FloatArray) -> FloatArray:
    """Total variance of ln size, clipped against overflow far outside the prior."""
    return np.asarray(np.exp(2 * np.clip(log_sd, -14, 5)))
