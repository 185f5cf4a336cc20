"""Groups of a posterior for ArviZ."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.forward.gaussian import principal_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import quantiles_of
from tactile_bayes.posterior.fit import FieldFit
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.selection import fitted_values, pointwise_log_likelihood
from tactile_bayes.size.draws import BumpDraws
from tactile_bayes.size.pooling import Calibration, SizePriors, draw_sizes

# --- Fitted values of an estimate's window beside its data: level, tilt, bump and what lies beside it, without noise.


class FittedCells(Record, eq=False):
    """Cells of a fit window."""

    x_mm: FloatArray
    y_mm: FloatArray
    """`x_mm`, `y_mm` (n,) arrays: Their centres in `plane`."""
    value: FloatArray
    fit: FloatArray
    """`value`, `fit` (n,) arrays: The map's values, and the model's at the posterior's middle."""

    @property
    def residual(self) -> FloatArray:
        """(n,) values less the fit: the map's noise, correlated between cells, and what the model lacks."""
        return self.value - self.fit


def fitted_cells(estimate: Estimate) -> FittedCells | None:
    """Data and fit of an estimate's window; None without an estimate.

    Under a noise field the shape is the median of the draws, and what is linear (level, tilt, amplitudes) the
    generalised least-squares solution under the likeliest field; under independent errors it is the least-squares fit.
    """
    if estimate.fit is None or estimate.draws is None:
        return None
    if estimate.scene is None:
        cells = estimate.fit.cells
        fit = np.asarray(estimate.fit.bump.predict(estimate.fit.theta[None], cells)[0], dtype=np.float64)
        return FittedCells(cells.x_mm, cells.y_mm, cells.value, fit)
    target = estimate.scene.fit.target
    cells = target.window.cells
    return FittedCells(
        cells.x_mm, cells.y_mm, cells.value, fitted_values(target, np.median(estimate.draws.flat, axis=0))
    )


# --- What goes beside a posterior's draws in a file that arviz opens: statistics, likelihood, data and prior.
#
# Groups and names are those of the InferenceData schema of ArviZ (Kumar et al. 2019, JOSS 4:1143).

PRIOR_DRAWS = 2000
LIKELIHOOD_DRAWS = 400
"""Evenly thinned: a value for each cell and draw takes a second and 4 MB for 400 of them."""
LEAST_SIZED = 100
"""Fewer prior draws within the calibration's range say nothing of a size."""


class DrawGroup(Record, eq=False):
    """Arrays of one group with the names of their axes, and what is to be said of it."""

    arrays: Mapping[str, tuple[tuple[str, ...], FloatArray]]
    """Names of the axes, and values."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Text by name."""


def inference_groups(
    estimate: Estimate,
    *,
    calibration: Calibration | None,
    size_priors: SizePriors,
    rng: np.random.Generator,
) -> dict[str, DrawGroup]:
    """The groups that an estimate has besides ``posterior``; empty without an estimate.

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
    statistics = _statistics(estimate, fit)
    if statistics is not None:
        groups["sample_stats"] = statistics
    if fit is None:
        return groups
    groups["prior"] = _prior(fit, calibration, size_priors, rng)
    if estimate.draws.method == "ensemble":
        groups["log_likelihood"] = _log_likelihood(estimate.draws.theta, fit)
    return groups


def _statistics(estimate: Estimate, fit: FieldFit | None) -> DrawGroup | None:
    draws = estimate.draws
    assert draws is not None
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
    some = _thinned(theta, LIKELIHOOD_DRAWS)
    values = pointwise_log_likelihood(fit.target, some.reshape(-1, some.shape[2])).reshape(*some.shape[:2], -1)
    note = (
        "log density of each cell's value given all the other cells (leave-one-out predictive, Buerkner, Gabry & "
        "Vehtari 2021), for evenly thinned draws: under correlated errors a likelihood is no product over cells"
    )
    return DrawGroup({"value": (("chain", "draw", "cell"), values)}, {"definition": note})


def _thinned(theta: FloatArray, number: int) -> FloatArray:
    """About so many of (chain, draw, p) draws, evenly, as many of each chain."""
    chains, draws, _ = theta.shape
    return theta[:, :: max(1, -(-chains * draws // number))]


def _prior(
    fit: FieldFit, calibration: Calibration | None, size_priors: SizePriors, rng: np.random.Generator
) -> DrawGroup:
    """Draws of what has a proper prior, and the sizes that these imply where the calibration holds."""
    problem, turned = fit.target.problem, fit.scene.shape == "rotated"
    prior, middle = problem.prior, problem.window.middle
    # more than needed: those wider than the window allows are left out
    number = 4 * PRIOR_DRAWS
    p = np.log(prior.width_median_mm) + prior.log_width_sd * rng.standard_normal(number)
    q = np.zeros(number) if fit.scene.shape == "round" else prior.log_ratio_sd * rng.standard_normal(number)
    r = prior.log_ratio_sd * rng.standard_normal(number) if turned else np.zeros(number)
    kept = np.flatnonzero(p + np.hypot(q, r) <= np.log(problem.widest_mm))[:PRIOR_DRAWS]
    sigma_x, sigma_y, angle = principal_widths(p[kept], q[kept], r[kept])
    amplitude = fit.target.amplitude_sd * rng.standard_normal(len(kept))
    away, direction = problem.radius_mm * np.sqrt(rng.uniform(size=len(kept))), rng.uniform(0, 2 * np.pi, len(kept))
    values = {"amplitude": amplitude, "sigma_x_mm": sigma_x, "sigma_y_mm": sigma_y, "angle_rad": angle}
    values |= {"x_mm": middle[0] + away * np.cos(direction), "y_mm": middle[1] + away * np.sin(direction)}
    notes = {"left_out": "level, tilt and noise scale have improper priors"}
    if calibration is not None:
        inside = [
            not calibration.extrapolation_faults(a, x, y) if a > 0 else False
            for a, x, y in zip(amplitude.tolist(), sigma_x.tolist(), sigma_y.tolist(), strict=True)
        ]
        share = float(np.mean(inside))
        notes["sizes"] = f"of the {100 * share:.0f} % of draws within the calibration's range, at evenly spaced ranks"
        if sum(inside) >= LEAST_SIZED:
            a, x, y, turn = (one[inside][None] for one in (amplitude, sigma_x, sigma_y, angle))
            size = draw_sizes(BumpDraws(a, x, y, turn), calibration=calibration, priors=size_priors, rng=rng)
            ranks = (np.arange(len(kept)) + 0.5) / len(kept)
            for name in ("max_size_mm", "min_size_mm"):
                known = np.sort(getattr(size, name).ravel())
                values[name] = rng.permutation(quantiles_of(known[np.isfinite(known)], ranks))
    return DrawGroup({name: (("chain", "draw"), one[None]) for name, one in values.items()}, notes)
