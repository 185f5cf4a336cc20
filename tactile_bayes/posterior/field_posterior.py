"""The posterior of a bump under correlated errors: shape by one of the methods, the rest drawn exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.forward.gaussian import principal_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.cells import FitCells
from tactile_bayes.posterior.collapsed import CollapsedTarget
from tactile_bayes.posterior.draws import ParameterDraws
from tactile_bayes.posterior.fit import WIDEST_IN_RADII, BumpFit, FitOptions
from tactile_bayes.posterior.importance import importance, importance_options
from tactile_bayes.posterior.laplace import laplace, mode_and_covariance

START_SCALE = np.array([0.06, 0.06, 0.3, 0.3, 0.06])
MOST_SETTLINGS = 6


@dataclass(frozen=True, slots=True, eq=False)
class FieldFit:
    """Mode of a collapsed posterior.

    Parameters
    ----------
    target
        Its density, with the noise fields that matter there.
    mode, covariance : (p,), (p, p) arrays
        Of ``(u, v, x, y[, r])``, see `CollapsedTarget`.
    """

    target: CollapsedTarget
    mode: FloatArray
    covariance: FloatArray

    @property
    def rotated(self) -> bool:
        """Whether the ellipse may turn."""
        return self.target.rotated

    @property
    def dof(self) -> float:
        """Degrees of freedom of the noise scale."""
        return float(len(self.target.data) - self.target.columns)


def fit_field(
    cells: FitCells,
    start: FloatArray,
    *,
    prior: BumpPrior,
    rotated: bool,
    widest_mm: float,
    radius_mm: float,
) -> FieldFit:
    """Find the mode; the fields that matter and the mode are settled in turn, because each depends on the other.

    Parameters
    ----------
    start : (5,) array
        ``(u, v, x, y, r)``, for example from least squares.

    Raises
    ------
    NotConvergedError
        When there is no mode.
    """
    target = CollapsedTarget(cells, prior=prior, level=None, rotated=rotated, widest_mm=widest_mm, radius_mm=radius_mm)
    scale = START_SCALE[: target.dimension]
    target.settle_fields(start[: target.dimension])
    mode, covariance, _ = mode_and_covariance(target, start[: target.dimension], scale=scale)
    for _ in range(MOST_SETTLINGS):
        if not target.settle_fields(mode):
            break
        mode, covariance, _ = mode_and_covariance(target, mode, scale=scale)
    if not np.isfinite(target(mode[None])[0]):
        raise NotConvergedError("the posterior has no density at the fitted bump: there is no rise under this noise")
    return FieldFit(target, mode, covariance)


def choose_field_fit(
    least_squares: BumpFit, prior: BumpPrior, options: FitOptions, *, least_odds: float
) -> tuple[FieldFit, float | None]:
    """Fit from the least-squares bump, turned only where the map favours it by `least_odds` (or as the options say).

    Returns
    -------
    fit
    odds
        Of a turned ellipse against one along the head's axes; None when the options decided.
    """
    p, q, r = (float(v) for v in least_squares.bump.shape_parameters(least_squares.theta))
    start = np.array([p + q, p - q, least_squares.theta[1], least_squares.theta[2], r])

    def fit(rotated: bool) -> FieldFit:
        return fit_field(
            least_squares.cells,
            start,
            prior=prior,
            rotated=rotated,
            widest_mm=WIDEST_IN_RADII * options.radius_mm,
            radius_mm=options.radius_mm,
        )

    if options.rotation != "auto":
        return fit(options.rotation == "on"), None
    turned = fit(True)
    odds = rotation_odds(turned, prior)
    return (turned, odds) if odds > least_odds else (fit(False), odds)


def rotation_odds(turned: FieldFit, prior: BumpPrior) -> float:
    """Bayes factor of a turned ellipse against one along the head's axes: the Savage-Dickey ratio at r = 0."""
    r, sd = float(turned.mode[4]), float(np.sqrt(turned.covariance[4, 4]))
    return float(np.exp(np.clip(np.log(sd / prior.log_ratio_sd) + 0.5 * (r / sd) ** 2, -700, 700)))


def draw_field(
    fit: FieldFit,
    method: str,
    *,
    rng: np.random.Generator,
    accuracy_sd: float | None = None,
    max_steps: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ParameterDraws:
    """Draws of the shape by ``"laplace"``, ``"importance"`` or ``"ensemble"``."""
    if method == "laplace":
        return laplace(fit.target, fit.mode, scale=np.sqrt(np.diag(fit.covariance)), dof=fit.dof, rng=rng)
    if method == "importance":
        return importance(fit.target, fit.mode, fit.covariance, rng=rng, options=importance_options(accuracy_sd))
    from dataclasses import replace

    from tactile_bayes.posterior.ensemble import EnsembleOptions, ensemble

    settings = EnsembleOptions() if max_steps is None else replace(EnsembleOptions(), max_steps=max_steps)
    return ensemble(fit.target, fit.mode, fit.covariance, rng=rng, options=settings, progress=progress)


def shape_draws(fit: FieldFit, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sigma_x_mm, sigma_y_mm and angle_rad of (..., p) draws."""
    return principal_widths(*fit.target.shape(theta))
