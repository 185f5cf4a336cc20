"""Whether a bump is a Gaussian: flatter and sharper ones are told, Gaussians are not, and widths keep their meaning.

Truth is the formula that the maps are made by, exp(-h^e) with h = u^2 / 2.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from posterior_maps import correlated_field, grid_map

from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.fit import (
    FieldFit,
    Structure,
    _departure,
    add_departure,
    exponent_covariance,
    tangent_columns,
)
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.report.estimate_document import scene_lines

AXIS = np.arange(-26.0, 27.0)
SIGMA = (4.5, 5.5)
NOISE = 0.01


def bump(exponent: float, *, amplitude: float = 0.3, x: float = 0.7, y: float = -0.4) -> np.ndarray:
    """(ny, nx) of a bump whose h is raised to an exponent; 5 by 5 points a cell."""
    fine = (AXIS[:, None] + np.linspace(-0.4, 0.4, 5)).ravel()
    h = 0.5 * (((fine - x) / SIGMA[0]) ** 2 + ((fine[:, None] - y) / SIGMA[1]) ** 2)
    n = len(AXIS)
    return amplitude * np.exp(-(h**exponent)).reshape(n, 5, n, 5).mean(axis=(1, 3))


@cache
def estimated(exponent: float, seed: int = 0, *, noise: float = NOISE) -> Estimate:
    rng = np.random.default_rng(seed)
    errors = noise * (rng.standard_normal((len(AXIS), len(AXIS))) + correlated_field(rng, len(AXIS), length_cells=3.0))
    options = SamplerSettings(method="laplace", background="free", rotation="off", noise="field")
    found = estimate_map(grid_map(1 + bump(exponent) + errors), calibration=None, options=options, rng=rng)
    assert found.status == "estimate"
    return found


def answer(found: Estimate) -> Structure:
    assert found.scene is not None
    return next(one for one in found.scene.structures if one.name == "departure")


def fit_of(found: Estimate) -> FieldFit:
    assert found.scene is not None
    return found.scene.fit


def sd(fit: FieldFit, name: str) -> float:
    i = fit.scene.names.index(name)
    return float(np.sqrt(fit.covariance[i, i]))


@pytest.mark.parametrize(("exponent", "word"), [(1.25, "flatter"), (0.8, "sharper")])
def test_a_flatter_and_a_sharper_bump_are_told_and_modelled(exponent: float, word: str) -> None:
    found = answer(estimated(exponent))
    assert found.supported
    assert found.used
    assert word in found.place
    said = float(found.place.split("about ")[1].split()[0])
    assert said == pytest.approx(2 * exponent, abs=0.25)


@pytest.mark.long
def test_gaussians_are_left_alone() -> None:
    """The negative control of the test above; at odds of 3 one false alarm in six has a chance below 1 %."""
    answers = [answer(estimated(1.0, seed)) for seed in range(6)]
    assert not any(one.used for one in answers)
    assert np.median([one.odds for one in answers]) < 0.5


def test_the_widths_are_those_of_the_nearest_gaussian_either_way() -> None:
    for seed in range(3):
        found = answer(estimated(1.25, seed))
        assert found.change_sigma_x_sd is not None
        assert found.change_sigma_y_sd is not None
        assert max(abs(found.change_sigma_x_sd), abs(found.change_sigma_y_sd)) < 1.0
    # the formula's own width is 4.5, the nearest Gaussian's 4.35
    assert np.median(estimated(1.25).map_posterior.sigma_x_mm) < 4.5  # type: ignore[union-attr]


def test_what_the_column_takes_is_no_longer_noise() -> None:
    """With an error-free bump the field holds the misfit only: less of it is left with the column."""
    found = estimated(1.25, noise=0.002)
    assert found.scene is not None
    with_it, without = fit_of(found), found.scene.plain
    assert with_it.target.problem.departure is not None
    assert without.target.problem.departure is None
    assert sd(with_it, "u") < 0.6 * sd(without, "u")


def test_the_column_leaves_the_widths_alone_on_average_over_the_noise_fields() -> None:
    fit = fit_of(estimated(1.0))
    column, known = _departure(fit), tangent_columns(fit)
    v = len(known)
    columns = np.concatenate([known, column[None]])
    products = fit.target.products_by_field(columns, columns)
    shared = np.linalg.solve(products[:, :v, :v], products[:, :v, v:])[:, :, 0]
    assert np.abs(fit.target.field_weights(fit.mode) @ shared).max() < 1e-6
    # the control: under one field alone it shares something with them
    assert np.abs(shared).max() > 1e-3


def test_the_widths_of_a_bump_that_is_no_gaussian_are_as_uncertain_as_the_noise_field() -> None:
    found = estimated(1.5)
    fit, drawn = fit_of(found), found.map_posterior
    assert drawn is not None
    u = fit.scene.names.index("u")
    variance = exponent_covariance(fit)[u, u]
    assert np.sqrt(variance) > 0.3 * sd(fit, "u")
    assert np.var(np.log(drawn.sigma_x_mm)) == pytest.approx(variance + fit.covariance[u, u], rel=0.1)
    # the control: of a Gaussian the nearest Gaussian is the same under any field
    assert not exponent_covariance(fit_of(estimated(1.0))).any()


def test_a_bump_with_a_neighbour_is_not_asked() -> None:
    rng = np.random.default_rng(2)
    errors = 0.005 * rng.standard_normal((len(AXIS), len(AXIS)))
    both = 1 + bump(1.0, x=-5.0) + bump(1.0, x=11.0) + errors
    options = SamplerSettings(method="laplace", background="free", noise="field")
    found = estimate_map(grid_map(both), calibration=None, options=options, rng=rng)
    assert found.scene is not None
    assert found.scene.fit.scene.extra == "second lump"
    assert not any(one.name == "departure" for one in found.scene.structures)
    assert add_departure(found.scene) is found.scene


def test_the_report_says_whether_the_bump_departs_from_a_gaussian() -> None:
    told, plain = estimated(1.25), estimated(1.0)
    assert told.scene is not None
    assert plain.scene is not None
    assert any("a departure from a Gaussian (flatter in the middle" in line for line in scene_lines(told.scene))
    assert any(line.startswith("Not in the model") and "a departure" in line for line in scene_lines(plain.scene))
