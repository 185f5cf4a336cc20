"""Estimation under independent errors: rotation and draws from a least-squares fit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import assert_never

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.cache import Solved
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.lump.diagnostics import NoiseFigures
from tactile_bayes.posterior.lump.posterior import MapPosterior
from tactile_bayes.posterior.options import ROTATION_ODDS, EstimateOptions, FitOptions
from tactile_bayes.posterior.white.fit import BumpFit, rotation_odds
from tactile_bayes.posterior.white.residuals import level_offset
from tactile_bayes.posterior.white.target import Target

Progress = Callable[[int, int], None]


def chosen_rotation(
    tactile_map: TactileMap, fit: BumpFit, *, options: FitOptions, prior: BumpPrior
) -> tuple[BumpFit, float | None]:
    """The fit, rotated where the odds favour it, and those odds; None where rotation was not tested."""
    if options.rotation != "auto":
        return fit, None
    odds, turned = rotation_odds(tactile_map, fit, options=options, prior=prior)
    return (turned, odds) if turned is not None and odds > ROTATION_ODDS else (fit, odds)


def draw_independent(
    fit: BumpFit, options: EstimateOptions, *, rng: np.random.Generator, progress: Progress | None
) -> tuple[ParameterDraws, MapPosterior]:
    """Draw by the requested method, and name the joint draws."""
    target = fit.target(options.prior)
    solved = Solved(lambda theta: (target.excess(theta),))
    draws = _draw(fit, target, solved, options, rng=rng, progress=progress)
    theta = draws.theta
    sigma_x, sigma_y, angle = fit.bump.widths(theta)
    # two of the methods are linear about the mode: for them the exact figure would cost more than all the rest
    exact = draws.method in ("ensemble", "importance")
    excess = solved(draws.flat)[0] if exact else fit.linear_excess(draws.flat)
    return draws, MapPosterior(
        amplitude=theta[..., 0],
        sigma_x_mm=sigma_x,
        sigma_y_mm=sigma_y,
        x_mm=theta[..., 1],
        y_mm=theta[..., 2],
        angle_rad=angle,
        background=fit.bump.level(theta),
        noise_sd=target.draw_noise_sd(excess, rng).reshape(theta.shape[:2]),
    )


def _draw(
    fit: BumpFit,
    target: Target,
    solved: Solved,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> ParameterDraws:
    match options.method:
        case "optimise":
            from tactile_bayes.inference.optimise import optimise

            return optimise(fit.theta, fit.covariance, dof=fit.errors.dof, rng=rng)
        case "laplace":
            from tactile_bayes.inference.laplace import laplace

            scale = np.sqrt(np.diag(fit.covariance))
            return laplace(target, fit.theta, scale=scale, dof=fit.errors.dof, rng=rng)
        case "importance":
            from tactile_bayes.inference.importance import importance, importance_options

            mode, covariance = _mode(fit, target)
            density = partial(target.solved_density, solved=solved)
            try:
                return importance(density, mode, covariance, rng=rng, options=importance_options(options.accuracy_sd))
            except NotConvergedError:  # its weights cannot be trusted here; chains need none
                return _chains(target, mode, covariance, options, rng=rng, progress=progress)
        case "ensemble":
            return _chains(target, *_mode(fit, target), options, rng=rng, progress=progress)
    assert_never(options.method)


def _mode(fit: BumpFit, target: Target) -> tuple[FloatArray, FloatArray]:
    """The posterior's mode and covariance, from least squares."""
    from tactile_bayes.inference.laplace import mode_and_covariance

    mode, covariance, _ = mode_and_covariance(target, fit.theta, scale=np.sqrt(np.diag(fit.covariance)))
    return mode, covariance


def _chains(
    target: Target,
    mode: FloatArray,
    covariance: FloatArray,
    options: EstimateOptions,
    *,
    rng: np.random.Generator,
    progress: Progress | None,
) -> ParameterDraws:
    from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble

    settings = EnsembleOptions() if options.max_steps is None else EnsembleOptions(max_steps=options.max_steps)
    return ensemble(target, mode, covariance, rng=rng, options=settings, progress=progress)


def judged_noise(fit: BumpFit, odds: float | None) -> NoiseFigures:
    """Figures of the errors, for the report."""
    figures = {"noise_inflation": fit.errors.inflation, "noise_dof": fit.errors.dof}
    offset = level_offset(fit.fit.residual, weight=fit.weight)
    return NoiseFigures("independent", fit.bump.rotated, odds, figures, level_offset=offset)
