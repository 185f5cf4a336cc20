"""An estimate's result, with its sensitivity to priors, its fitted values and its groups for ArviZ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from math import lgamma, log, pi
from typing import Any, Literal

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws, quantiles_of, weighted_quantiles_of
from tactile_bayes.inference.ensemble import DrawGroup
from tactile_bayes.inference.importance import smooth_weights
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import Detection, FitCells, principal_widths
from tactile_bayes.posterior.draw import MapPosterior, ModalBump
from tactile_bayes.posterior.fit import FieldFit, SceneChoice
from tactile_bayes.posterior.marginal import CollapsedTarget
from tactile_bayes.posterior.verdict import SmallestLumps, WeighedRise
from tactile_bayes.posterior.white import BumpFit, Candidate
from tactile_bayes.size.draws import BumpDraws, SizePosterior
from tactile_bayes.size.pooling import Calibration, SizePriors, draw_sizes

# --- Prior sensitivity: the draws reweighted under a width prior twice as wide.

WIDER = 2.0
TAIL = 0.025


class Sensitivity(Record):
    """Effect of doubling the width prior's SD, in posterior SDs."""

    median: Mapping[str, float]  #: Shift of the median by quantity.
    ends: Mapping[str, float]  #: The larger shift of the two ends of the 95 % interval.
    pareto_k: float  #: Shape of the weights; above 0.7 the shifts are not to be trusted.


def prior_sensitivity(
    sigma_x: FloatArray, sigma_y: FloatArray, quantities: Mapping[str, FloatArray], prior: BumpPrior
) -> Sensitivity:
    """Shifts of quantities under a width prior twice as wide, by reweighting the draws.

    Quantities are draws in the order of the widths; NaN draws are left out.
    """
    p = 0.5 * np.log(sigma_x * sigma_y).ravel()
    z = (p - np.log(prior.width_median_mm)) / prior.log_width_sd
    weight, shape = smooth_weights(0.5 * z**2 * (1.0 - WIDER**-2))
    medians, ends = {}, {}
    for name, draws in quantities.items():
        values = draws.ravel()
        is_finite = np.isfinite(values)
        sd = float(values[is_finite].std()) or 1.0
        probabilities = np.array([0.5, TAIL, 1.0 - TAIL])
        order = np.argsort(values[is_finite])
        ordered, weights = values[is_finite][order], weight[is_finite][order]
        plain = weighted_quantiles_of(ordered, np.ones(len(order)), probabilities)
        shift = (weighted_quantiles_of(ordered, weights, probabilities) - plain) / sd
        medians[name], ends[name] = float(shift[0]), float(shift[1:][np.argmax(np.abs(shift[1:]))])
    return Sensitivity(medians, ends, shape)


# --- The answer for one map: an estimate, or the reason why there is none.

Status = Literal["estimate", "no_estimate"]


class Rise(ModalBump):
    """Another rise on the map: its bump at the mode."""

    distance_mm: float | None  #: From the lump that was measured; None where there is none.
    probability: float  #: That it is a lump, as `Detection` has it.


class Estimate(Record, eq=False):
    """The answer for one map."""

    status: Status
    reason: str  #: Why there is no estimate, or what is missing from one, if anything.
    detection: Detection | None = None  #: None when no bump could be tested.
    fit: BumpFit | None = None
    draws: ParameterDraws | None = None
    map_posterior: MapPosterior | None = None
    """`fit`, `draws`, `map_posterior`: None without an estimate."""
    size: SizePosterior | None = None  #: None also without a size calibration.
    candidates: tuple[Candidate, ...] = ()  #: All places tried.
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the fit, the noise and the method as the JSON has them: R-hat, effective draws and Monte-Carlo errors
    of chains in ``convergence``; empty where nothing was drawn."""
    sized_by: str = ""  #: Name of the calibration that gave the size, in words.
    left_out: tuple[str, ...] = ()  #: Sources of error that the estimate does not contain, in words.
    code: str = ""
    advice: str = ""
    on_paper: str = ""
    about_mm: tuple[float, float] | None = None
    """`code`, `advice`, `on_paper`, `about_mm`: Of the `Abstention`, without an estimate."""
    weighed: WeighedRise | None = None  #: The answer's lump, or the rise that is likeliest one.
    smallest: SmallestLumps | None = None
    """On a map without a lump: the smallest that it would have shown; None where that was not computed."""
    scene: SceneChoice | None = None  #: Under a noise field: the chosen scene, with the tests of its structures.
    sensitivity: Sensitivity | None = None  #: Sensitivity to the prior of the widths.
    other_rises: tuple[Rise, ...] = ()  #: The masses besides the reported one; empty where none were searched.
    bump: ModalBump | None = None  #: Bump at the mode of the answer's lump, sized or not; None without one.
    masses: tuple[Mass, ...] = ()  #: All masses of the map, see `masses.with_masses`; empty where none were searched.
    findings: tuple[Finding, ...] = ()  #: Findings against the answer, cautions first.

    @property
    def probability(self) -> float | None:
        """Probability that the lump of the answer, or the likeliest rise, is one; None where nothing was weighed."""
        return None if self.weighed is None else self.weighed.probability

    @property
    def measured(self) -> ModalBump | None:
        """The bump at the posterior medians; None where nothing was drawn."""
        return None if self.map_posterior is None else self.map_posterior.middle

    @property
    def lump(self) -> ModalBump | None:
        """The bump of the answer's lump: at the posterior medians where it was drawn, else at the mode."""
        return self.measured or self.bump


class Mass(Record, eq=False):
    """One of the masses on a map."""

    x_mm: float
    y_mm: float  #: Its centre in `plane`: the posterior median, or where the fit has it.
    probability: float  #: That it is a lump; of a second lump in another's window, by its odds.
    estimate: Estimate  #: Its own: draws and size, or why there is none.
    reported: bool = False  #: The map's `Estimate` is this mass's.

    @property
    def bump(self) -> ModalBump:
        """Its bump at the mode."""
        assert self.estimate.bump is not None
        return self.estimate.bump

    @property
    def largest_mm(self) -> float | None:
        """Median of the largest diameter; None without a size."""
        size = self.estimate.size
        return None if size is None else size.median_mm


# --- Density of a window's cells under correlated errors: the density of each given the others.
#
# A likelihood with correlated errors is no product over cells. A cell's factor is replaced by the density of its value
# given all the others, with level, tilt, amplitudes and the noise scale integrated out as in `marginal`. For one
# field, with :math:`Q = C^{-1} - C^{-1} X (X^T C^{-1} X)^{-1} X^T C^{-1}`,
#
# .. math::
#     y_i \mid y_{-i}, \theta \sim t_{\nu - 1}\Bigl(y_i - (Qy)_i / Q_{ii},\; S_{-i} / ((\nu - 1)\, Q_{ii})\Bigr),
#     \qquad S_{-i} = y^T Q y - (Qy)_i^2 / Q_{ii}.
#
# Fields are mixed with their evidence without the cell. The sum over cells is not the log likelihood of the map.
#
# References
# ----------
# Buerkner, Gabry & Vehtari (2021), Computational Statistics 36:1243 (non-factorised models).

LEAST_SHARE = 1e-6  #: Fields with a smaller share of the evidence at a draw are left out.


def pointwise_log_likelihood(target: CollapsedTarget, theta: FloatArray) -> FloatArray:
    """(m, n) log density of each cell's value given the other cells, at (m, p) draws of the scene's parameters."""
    evidence = target.by_field(theta)
    log_share = evidence - np.logaddexp.reduce(evidence, axis=1)[:, None]
    window, fixed_columns = target.window, target.linear.plain[:-1]
    templates = [window.of_cells(template) for template in target.scene.templates(theta, window)]
    inverse_likelihood = np.full((len(theta), len(window.cells)), -np.inf)
    for h, precision in enumerate(_precisions(target)):
        for m in np.flatnonzero(log_share[:, h] > log(LEAST_SHARE)):
            regressors = np.stack([*fixed_columns, *(one[m] for one in templates)])
            log_density = _leave_one_out_density(precision, regressors, window.cells.value)
            # p(field | the others) is its share over the cell's density under it
            inverse_likelihood[m] = np.logaddexp(inverse_likelihood[m], log_share[m, h] - log_density)
    return -inverse_likelihood


def _precisions(target: CollapsedTarget) -> Iterator[_Precision]:
    """The precision of each field and share, in the order of `CollapsedTarget.by_field`."""
    window = target.window
    # a row per cell: its inner products with the cosines
    unit = window.on_grid(np.eye(len(window.cells)))
    cosines = window.project(unit, np.zeros((1, *window.weight.shape))).low
    for columns in target.fields:
        low = cosines @ columns.field.turn
        for index in range(len(columns.shares)):
            yield _Precision(1.0 / window.variance, low, columns.weight[:, index])


class _Precision:
    """Inverse covariance of the cells under one field and share, up to the noise scale."""

    def __init__(self, weight: FloatArray, low: FloatArray, taken: FloatArray) -> None:
        self._weight, self._low, self._taken = weight, low, taken
        self.diagonal = weight - np.square(low) @ taken

    def times(self, rows: FloatArray) -> FloatArray:
        """(v, n) products with (v, n) vectors."""
        return np.asarray(rows * self._weight - ((rows @ self._low) * self._taken) @ self._low.T)


def _leave_one_out_density(precision: _Precision, regressors: FloatArray, value: FloatArray) -> FloatArray:
    """(n,) log density of each value given the others, for (v, n) columns with free coefficients."""
    # centred, so that a large level costs no digits of the bump
    centred = value - value.mean()
    weighted = precision.times(np.concatenate([regressors, centred[None]]))
    across, data = weighted[:-1], weighted[-1]
    inverse = np.linalg.inv(across @ regressors.T)
    residual = data - (inverse @ (across @ centred)) @ across
    power = precision.diagonal - np.einsum("vn,vw,wn->n", across, inverse, across)
    dof = len(value) - len(regressors) - 1
    squares = float(residual @ centred) - residual**2 / power
    scale = squares / (dof * power)
    constant = lgamma((dof + 1) / 2) - lgamma(dof / 2) - 0.5 * log(dof * pi)
    log_kernel = np.log1p((residual / power) ** 2 / (dof * scale))
    return np.asarray(constant - 0.5 * np.log(scale) - 0.5 * (dof + 1) * log_kernel)


# --- Fitted values of an estimate's window: level, tilt, bump and neighbour, without noise.


class FittedCells(Record, eq=False):
    """Cells of a fit window."""

    cells: FitCells
    fit: FloatArray  #: (n,) array: The model's values at the posterior medians.
    shared: FloatArray | None = None
    """(n,) array: Expected noise field, which neighbouring cells share; None for independent noise. It contains all
    that is broad, also of the lump: within the head's reach most maps lie 1 to 6 % of the amplitude above the level."""

    @property
    def residual(self) -> FloatArray:
        """(n,) values less the fit and the noise field: independent noise."""
        left = self.cells.value - self.fit
        return left if self.shared is None else left - self.shared


def fitted_cells(estimate: Estimate) -> FittedCells | None:
    """Data and fit of an estimate's window; None without an estimate.

    Under a noise field the shape is the median of the draws, and what is linear (level, tilt, amplitudes) the
    generalised least-squares solution under the likeliest field; under independent errors it is the least-squares fit.
    """
    if estimate.fit is None or estimate.draws is None:
        return None
    if estimate.scene is None:
        cells = estimate.fit.cells
        return FittedCells(cells, estimate.fit.bump.predict(estimate.fit.theta[None], cells)[0])
    target, theta = estimate.scene.fit.target, np.median(estimate.draws.flat, axis=0)[None]
    window, value = target.window, target.window.cells.value
    templates = [window.of_cells(template)[0] for template in target.scene.templates(theta, window)]
    regressors = np.stack([*target.linear.plain[:-1], *templates])
    precision = next(islice(_precisions(target), int(np.argmax(target.by_field(theta)[0])), None))
    middle, across = value.mean(), precision.times(regressors)
    coefficients = np.linalg.solve(across @ regressors.T, across @ (value - middle))
    fit = np.asarray(middle + coefficients @ regressors)
    residual = value - fit
    # the field's expectation given the data: the part of what is left that neighbouring cells share
    return FittedCells(window.cells, fit, residual - precision.times(residual[None])[0] * window.variance)


# --- Groups beside ``posterior`` in a file for arviz: sampler statistics, likelihood, data and prior.
#
# Groups and names are those of the InferenceData schema of ArviZ (Kumar et al. 2019, JOSS 4:1143).

PRIOR_DRAWS = 2000
LIKELIHOOD_DRAWS = 400  #: Draws with a log likelihood, evenly thinned: 400 take a second and 4 MB.
LEAST_SIZED = 100  #: Least number of prior draws within the calibration's range for a prior of sizes.


def inference_groups(
    estimate: Estimate, *, calibration: Calibration | None, size_priors: SizePriors, rng: np.random.Generator
) -> dict[str, DrawGroup]:
    """Groups of an estimate besides ``posterior``; empty without an estimate.

    ``sample_stats``, ``log_likelihood`` (of chains under a noise field), ``observed_data`` and ``prior`` (under a noise
    field); the prior's sizes are drawn by the `calibration` and `size_priors` of the posterior's.
    """
    if estimate.draws is None or estimate.fit is None:
        return {}
    cells = estimate.fit.cells
    places = {"x_mm": cells.x_mm, "y_mm": cells.y_mm, "readings": cells.count}
    observed = {name: (("cell",), values) for name, values in {"value": cells.value, **places}.items()}
    groups = {"observed_data": DrawGroup(observed, {"value": "mean of the readings of each cell of the fit window"})}
    fit = None if estimate.scene is None else estimate.scene.fit
    if (statistics := _statistics(estimate.draws, fit)) is not None:
        groups["sample_stats"] = statistics
    if fit is None:
        return groups
    groups["prior"] = _prior(fit, calibration, size_priors, rng)
    if estimate.draws.method == "ensemble":
        groups["log_likelihood"] = _log_likelihood(estimate.draws.theta, fit)
    return groups


def _statistics(draws: ParameterDraws, fit: FieldFit | None) -> DrawGroup | None:
    """The sampler's statistics of each draw, with notes; None where there are none."""
    statistics = dict(draws.statistics)
    if draws.method == "laplace" and fit is not None:
        statistics["lp"] = fit.target(draws.flat).reshape(draws.theta.shape[:2])
        log_proposal = fit.mixture.log_density(draws.flat).reshape(draws.theta.shape[:2])
        statistics["log_weight"] = statistics["lp"] - log_proposal - fit.mixture.log_evidence
    if not statistics:
        return None
    notes = {
        "lp": "log posterior density of the shape parameters, all that is linear integrated out, before tracker "
        "position error is added to the draw",
        "log_weight": "of the point that the draw was taken from, mean weight 1; draws have equal weights",
    }
    notes |= {f"sampler_{name}": f"{value:.9g}" for name, value in draws.diagnostics.items()}
    return DrawGroup({name: (("chain", "draw"), values) for name, values in statistics.items()}, notes)


def _log_likelihood(theta: FloatArray, fit: FieldFit) -> DrawGroup:
    """Log likelihood of some of the draws, evenly thinned, as many of each chain."""
    thinned = theta[:, :: max(1, -(-theta.shape[0] * theta.shape[1] // LIKELIHOOD_DRAWS))]
    values = pointwise_log_likelihood(fit.target, thinned.reshape(-1, thinned.shape[2])).reshape(*thinned.shape[:2], -1)
    note = (
        "log density of each cell's value given all the other cells (leave-one-out predictive, Buerkner, Gabry & "
        "Vehtari 2021), for evenly thinned draws: under correlated errors a likelihood is no product over cells"
    )
    return DrawGroup({"value": (("chain", "draw", "cell"), values)}, {"definition": note})


def _prior(
    fit: FieldFit, calibration: Calibration | None, size_priors: SizePriors, rng: np.random.Generator
) -> DrawGroup:
    """Draws of the parameters with a proper prior, and their sizes within the calibration's range."""
    problem, rotated = fit.target.problem, fit.scene.shape == "rotated"
    prior, middle = problem.prior, problem.window.middle
    # more than needed, since widths beyond the window's limit are left out
    number = 4 * PRIOR_DRAWS
    p = np.log(prior.width_median_mm) + prior.log_width_sd * rng.standard_normal(number)
    q = np.zeros(number) if fit.scene.shape == "round" else prior.log_ratio_sd * rng.standard_normal(number)
    r = prior.log_ratio_sd * rng.standard_normal(number) if rotated else np.zeros(number)
    allowed = np.flatnonzero(p + np.hypot(q, r) <= np.log(problem.widest_mm))[:PRIOR_DRAWS]
    sigma_x, sigma_y, angle = principal_widths(p[allowed], q[allowed], r[allowed])
    amplitude = fit.target.amplitude_sd * rng.standard_normal(len(allowed))
    distance = problem.radius_mm * np.sqrt(rng.uniform(size=len(allowed)))
    direction = rng.uniform(0, 2 * np.pi, len(allowed))
    values = {"amplitude": amplitude, "sigma_x_mm": sigma_x, "sigma_y_mm": sigma_y, "angle_rad": angle}
    values |= {"x_mm": middle[0] + distance * np.cos(direction), "y_mm": middle[1] + distance * np.sin(direction)}
    notes = {"left_out": "level, tilt and noise scale have improper priors"}
    if calibration is not None:
        inside = calibration.within_reach(amplitude, sigma_x, sigma_y)
        share = float(np.mean(inside))
        notes["sizes"] = f"of the {100 * share:.0f} % of draws within the calibration's range, at evenly spaced ranks"
        if inside.sum() >= LEAST_SIZED:
            a, x, y, turn = (one[inside][None] for one in (amplitude, sigma_x, sigma_y, angle))
            size = draw_sizes(BumpDraws(a, x, y, turn), calibration=calibration, priors=size_priors, rng=rng)
            ranks = (np.arange(len(allowed)) + 0.5) / len(allowed)
            for name in ("max_size_mm", "min_size_mm"):
                sizes = np.sort(getattr(size, name).ravel())
                values[name] = rng.permutation(quantiles_of(sizes[np.isfinite(sizes)], ranks))
    return DrawGroup({name: (("chain", "draw"), one[None]) for name, one in values.items()}, notes)
