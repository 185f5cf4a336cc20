"""Nothing is solved twice: what sampling has worked out serves the draws, and they are the same draws."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_map, find_bump

from tactile_bayes.declarations import replace
from tactile_bayes.inference.draws import Solution, SolutionCache
from tactile_bayes.posterior.bump import Bump, cell_mean_gaussian, covariance_from_log_widths, window_cells
from tactile_bayes.posterior.draw import SamplerSettings, draw_parameters
from tactile_bayes.posterior.fit import FieldFit
from tests.posterior.correlated.test_marginal import cells_of, fitted, noise


class Counting:
    """The conditional solution, and at how many points it was asked for."""

    def __init__(self, fit: FieldFit) -> None:
        self.points, self._fit = 0, fit

    def __call__(self, theta: np.ndarray) -> Solution:
        self.points += len(theta)
        return self._fit.target.conditional(theta)


def drawn(method: str) -> tuple[Counting, list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """What was solved for the draws; amplitude, level and noise with a memory, without, and by other random numbers."""
    fit = fitted(cells_of(noise(5, field=0.01)))
    counting = Counting(fit)
    solved = SolutionCache(counting)
    draws, _ = draw_parameters(fit, SamplerSettings(method=method), rng=np.random.default_rng(1), solved=solved)
    kept = fit.target.draw_linear(draws.flat, np.random.default_rng(2), solve=solved)
    anew = fit.target.conditional
    again, other = (fit.target.draw_linear(draws.flat, np.random.default_rng(seed), solve=anew) for seed in (2, 3))
    return counting, list(kept), list(again), list(other)


def test_draws_from_kept_solutions_are_those_solved_anew() -> None:
    counting, kept, again, other = drawn("importance")
    assert counting.points == 0
    for one, two, three in zip(kept, again, other, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9)
        assert not np.allclose(one, three, rtol=1e-4), "other random numbers would pass too"


def test_draws_from_elsewhere_are_solved() -> None:
    counting, kept, again, _ = drawn("laplace")
    assert counting.points == 4000
    np.testing.assert_allclose(kept[0], again[0], rtol=1e-9)


def test_a_memory_is_of_its_own_points_only() -> None:
    """A point that differs in any coordinate, or shares its first one with another, is solved."""
    asked: list[int] = []

    def solve(theta: np.ndarray) -> Solution:
        asked.append(len(theta))
        return (theta.sum(axis=1),)

    points = np.random.default_rng(0).standard_normal((50, 3))
    solved = SolutionCache(solve)
    np.testing.assert_array_equal(solved(points)[0], points.sum(axis=1))
    solved.add(points[:20], (np.arange(20.0),))
    solved.add(points[20:], (np.arange(20.0, 50.0),))
    np.testing.assert_array_equal(solved(points[[7, 31, 7, 0]])[0], [7.0, 31.0, 7.0, 0.0])
    assert asked == [50]
    near = points[[7]] + [0.0, 0.0, 1e-12]
    assert solved(near)[0] == pytest.approx(near.sum())
    beyond = points.max(axis=0, keepdims=True) + 1.0
    assert solved(beyond)[0] == pytest.approx(beyond.sum())
    assert asked == [50, 1, 1]


def test_independent_errors_keep_their_sums_of_squares() -> None:
    fit = find_bump(bump_map(noise=noise(3)), SamplerSettings(rotation="off"))[-1].fit
    assert fit is not None
    target = fit.target
    solved = SolutionCache(lambda theta: (np.full(len(theta), np.nan),))
    theta = fit.theta + 0.01 * np.random.default_rng(1).standard_normal((70, len(fit.theta)))
    np.testing.assert_array_equal(target(theta, solved), target(theta))
    np.testing.assert_allclose(solved(theta[::-1])[0], target.excess(theta)[::-1], rtol=1e-9)


@pytest.mark.parametrize("covered", ["all", "half"])
def test_rows_and_columns_make_the_cells_of_a_straight_bump(covered: str) -> None:
    cells = window_cells(bump_map(), (3.0, -2.0), radius_mm=12.0)
    if covered == "half":
        keep = (cells.x_mm < 5.0) & (cells.y_mm > -9.0) & (np.arange(len(cells)) % 7 > 0)
        names = ("x_mm", "y_mm", "value", "variance", "count", "row", "column")
        cells = replace(cells, **{name: getattr(cells, name)[keep] for name in names})
    rng, bump = np.random.default_rng(0), Bump()
    columns = [rng.uniform(0.2, 1.0, 30), *rng.normal(0.0, 3.0, (2, 30)), rng.uniform(0.0, 2.3, 30)]
    theta = np.column_stack([*columns, rng.normal(0.0, 0.3, 30)])
    x, y = cells.x_mm - theta[:, 1, None], cells.y_mm - theta[:, 2, None]
    shape = covariance_from_log_widths(*bump.shape_parameters(theta))
    exact = cell_mean_gaussian(x, y, covariance_mm2=shape, cell_mm=cells.cell_mm)
    np.testing.assert_allclose(bump.unit_bump(theta, cells), exact, atol=1e-14)
    at_centres = cell_mean_gaussian(x, y, covariance_mm2=shape, cell_mm=0.0)
    assert np.abs(bump.unit_bump(theta, cells) - at_centres).max() > 1e-3
