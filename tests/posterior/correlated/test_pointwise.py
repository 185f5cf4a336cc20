"""The pointwise log likelihood under correlated errors, against regressions with each cell left out one by one."""

from __future__ import annotations

import numpy as np
from posterior_maps import bump_map, correlated_field
from scipy.stats import t

from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import search
from tactile_bayes.posterior.fit import FieldFit
from tactile_bayes.posterior.marginal import CollapsedTarget
from tactile_bayes.posterior.result import pointwise_log_likelihood
from tactile_bayes.posterior.window import linear_columns


def fit() -> FieldFit:
    rng = np.random.default_rng(3)
    noise = 0.02 * rng.standard_normal((51, 51)) + 0.02 * correlated_field(rng, 51, length_cells=4.0)
    _, seen = search(bump_map(noise=noise), SamplerSettings(background="free", fit_radius_mm=8.0, noise="field"))
    assert seen is not None
    assert seen.scene is not None
    return seen.scene.plain


def with_one_field(target: CollapsedTarget, index: int) -> CollapsedTarget:
    """The target with one field and share; the others are not in the mixture."""
    one = target.of_scene(target.scene)
    every = [(columns, h) for columns in target.fields for h in range(len(columns.shares))]
    columns, h = every[index]
    one._fields = [one.linear.columns(columns.field, columns.shares[h : h + 1])]
    return one


def covariance(target: CollapsedTarget) -> np.ndarray:
    """(n, n) of the cells under the target's one field, from its precision."""
    window, (columns,) = target.window, target.fields
    unit = window.on_grid(np.eye(len(window.cells)))
    low = window.project(unit, np.zeros((1, *window.weight.shape))).low @ columns.field.turn
    return np.linalg.inv(np.diag(1.0 / window.variance) - (low * columns.weight[:, 0]) @ low.T)


def without(cell: int, value: np.ndarray, x: np.ndarray, c: np.ndarray) -> float:
    """Log density of one value by generalised least squares on the others, level and bump with flat priors."""
    rest = np.arange(len(value)) != cell
    inverse = np.linalg.inv(c[np.ix_(rest, rest)])
    spread = np.linalg.inv(x[rest].T @ inverse @ x[rest])
    beta = spread @ x[rest].T @ inverse @ value[rest]
    residual = value[rest] - x[rest] @ beta
    dof = rest.sum() - x.shape[1]
    weights = c[cell, rest] @ inverse
    mean = x[cell] @ beta + weights @ residual
    gap = x[cell] - weights @ x[rest]
    factor = c[cell, cell] - weights @ c[rest, cell] + gap @ spread @ gap
    scale = np.sqrt(residual @ inverse @ residual / dof * factor)
    return float(t(dof, loc=mean, scale=scale).logpdf(value[cell]))


def test_each_cell_is_predicted_as_by_a_regression_without_it() -> None:
    found = fit()
    target = with_one_field(found.target, -1)
    window, theta = target.window, found.mode[None]
    bump = window.of_cells(target.scene.templates(theta, window)[0])[0]
    x = np.column_stack([*linear_columns(window.cells, tilt=target.scene.tilt), bump])
    c = covariance(target)
    cells = range(0, len(window.cells), 9)
    expected = [without(i, window.cells.value, x, c) for i in cells]
    ours = pointwise_log_likelihood(target, theta)[0]
    np.testing.assert_allclose(ours[list(cells)], expected, atol=1e-6)
    apart = [without(i, window.cells.value, x, np.diag(window.variance)) for i in cells]
    assert np.abs(ours[list(cells)] - apart).max() > 0.1  # the control: independent errors predict otherwise


def test_fields_are_mixed_with_their_evidence_without_the_cell() -> None:
    found = fit()
    theta = found.mode[None]
    evidence = found.target.by_field(theta)[0]
    assert len(evidence) > 1
    share = np.exp(evidence - np.logaddexp.reduce(evidence))
    each = np.stack([pointwise_log_likelihood(with_one_field(found.target, h), theta)[0] for h in range(len(share))])
    # p(y_i | rest) = 1 / sum_h p(h | all) / p(y_i | rest, h), by Bayes' rule for the fields
    expected = -np.log(share @ np.exp(-each))
    np.testing.assert_allclose(pointwise_log_likelihood(found.target, theta)[0], expected, atol=1e-4)
