r"""Non-Gaussian lumps: an extra regressor for the profile's exponent, used when the Bayes factor exceeds 3.

The column is how :math:`\exp(-h^e)` with :math:`h = u^2/2`, u in widths, changes with its exponent e at the Gaussian's
1: :math:`-h \ln h\, e^{-h}`. What it has in common with a change of amplitude, widths, centre, level and tilt is taken
off under the noise fields, so it leaves the widths those of the nearest Gaussian, as they are without it (White 1982,
Econometrica 50:1). But without it the misfit of the bump counts as noise, and intervals hold too often. Which Gaussian
is nearest depends on the noise field, so that the widths are as uncertain as it is (record 0066).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_bayes.forward.gaussian import covariance_from_log_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.linear import FLOOR
from tactile_bayes.posterior.correlated.selection import (
    LEAST_ODDS,
    SceneChoice,
    Structure,
    change_in_sd,
    fit_or_none,
    odds,
)
from tactile_bayes.posterior.correlated.tangent import tangent_columns

EXPONENT_SD = 0.25
"""Prior SD of e - 1, about 0."""
SETTLINGS = 2
"""Fits with the column: the first still has the column as orthogonal under the noise that held the misfit."""


def ask_departure(choice: SceneChoice) -> SceneChoice:
    """Test whether the bump is a Gaussian; add the regressor where the evidence supports it.

    A bump with something beside it is not asked: what is left of the neighbour would answer.
    """
    fit = choice.fit
    if fit.scene.extra or fit.scene.shape == "ridge":
        return choice
    column, exponent, log_odds = _departure(fit)
    answer = Structure("departure", odds(log_odds), bool(log_odds > np.log(LEAST_ODDS)), False)
    if answer.supported:
        found = _fitted(fit, column)
        if found is not None:
            x, y = change_in_sd(found, fit.mode)
            answer = replace(answer, used=True, change_x_sd=x, change_y_sd=y, place=_likeness(exponent))
            fit = found
    return replace(choice, fit=fit, structures=(*choice.structures, answer))


def _fitted(fit: FieldFit, column: FloatArray) -> FieldFit | None:
    """Refit with the regressor, made orthogonal on average over the new noise fields; None where there is no mode."""
    found: FieldFit | None = fit
    for left in reversed(range(SETTLINGS)):
        assert found is not None
        found = fit_or_none(replace(fit.target.problem, departure=column[None]), fit.scene, found.mode)
        if found is None or not left:
            break
        column = _departure(found)[0]
    return found


def exponent_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the scene's parameters from the unknown noise field, of a bump with the regressor.

    A bump that is no Gaussian has other nearest widths under each noise field, by the exponent times what the raw
    column shares with a change of them. Draws have the mean over the fields; this is the spread about it.
    """
    found = np.zeros((len(fit.mode), len(fit.mode)))
    if fit.target.problem.departure is None:
        return found
    shared, exponent, _ = _regression(fit)
    weight, p = fit.target.field_weights(fit.mode), len(fit.scene.alone().names)
    moved = exponent * (shared - weight @ shared)[:, 1 : p + 1]
    found[:p, :p] = (weight[:, None] * moved).T @ moved
    return found


def _departure(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """Regressor at a fit's mode, e - 1 by least squares under the likeliest noise, and the log odds against 0."""
    shared, exponent, log_odds = _regression(fit)
    mean = fit.target.field_weights(fit.mode) @ shared
    column = _raw_column(fit) - mean @ tangent_columns(fit)
    return column / np.abs(column).max(), exponent, log_odds


def _regression(fit: FieldFit) -> tuple[FloatArray, float, float]:
    """(h, v) parts of the raw column in the tangent columns under each field; e - 1 and its log odds as above."""
    cells = fit.target.window.cells
    known, raw = tangent_columns(fit), _raw_column(fit)
    value = cells.value - cells.value.mean()
    columns = np.concatenate([known, raw[None], value[None]])
    by_field = fit.target.products_by_field(columns, columns)
    v = len(known)
    shared = np.linalg.solve(by_field[:, :v, :v], by_field[:, :v, v:])
    best = int(np.argmax(fit.target.field_weights(fit.mode)))
    products = by_field[best]
    left = products[v:, v:] - products[v:, :v] @ shared[best]
    exponent = float(left[0, 1] / left[0, 0])
    dof = max(len(cells) - v - 1, 1)
    amplitude = fit.target.amplitude_at(fit.mode)
    squares = max(float(left[1, 1] - exponent * left[0, 1]), FLOOR * float(products[-1, -1]))
    variance = squares / dof / float(left[0, 0]) / amplitude**2
    return np.asarray(shared[:, :, 0]), exponent / amplitude, _log_odds(exponent / amplitude, variance)


def _log_odds(exponent: float, variance: float) -> float:
    """Log Bayes factor against 0 (Savage-Dickey) for a normal likelihood and the normal prior."""
    prior = EXPONENT_SD**2
    return float(0.5 * (exponent**2 / variance * prior / (prior + variance) - np.log1p(prior / variance)))


def _raw_column(fit: FieldFit) -> FloatArray:
    """(n,) derivative of the bump by its exponent, at the cells' centres."""
    scene, mode, cells = fit.scene, fit.mode, fit.target.window.cells
    p, q, r = scene.widths(mode)
    away = np.stack([cells.x_mm - scene.column(mode, "x"), cells.y_mm - scene.column(mode, "y")], axis=-1)
    covariance = covariance_from_log_widths(p, q, r)
    h = 0.5 * np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    return np.asarray(-h * np.log(np.maximum(h, 1e-12)) * np.exp(-h))


def _likeness(exponent: float) -> str:
    """Description of a bump with this e - 1."""
    return f"({'flatter' if exponent > 0 else 'sharper'} in the middle, exponent about {2 * (1 + exponent):.1f} for 2)"
