"""A window of very many cells is predicted a few vectors at a time: the same numbers, in little memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from posterior_maps import bump_map

from tactile_bayes.declarations import replace
from tactile_bayes.posterior.bump import BLOCK, LEAST_BLOCK, Bump, ErrorModel, FitCells, block_size, window_cells
from tactile_bayes.posterior.white import Target


@pytest.fixture(scope="module")
def fine() -> FitCells:
    """31,416 cells of 0.2 mm."""
    return window_cells(bump_map(cell_mm=0.2), (1.3, -0.8), radius_mm=20.0)


def vectors(bump: Bump, many: int) -> np.ndarray:
    at = {"amplitude": 0.3, "x_mm": 1.3, "y_mm": -0.8, "p": 1.6, "q": 0.1, "background": 1.0}
    rng = np.random.default_rng(4)
    return np.array([at.get(name, 0.05) for name in bump.names]) + 0.05 * rng.standard_normal((many, len(bump.names)))


def test_windows_of_ordinary_maps_are_in_whole_blocks() -> None:
    """Their numbers depend on it to the last bit: 0.4 mm in the default window, 1 mm in one of 48 mm."""
    assert {block_size(cells) for cells in (0, 20, 1_264, 7_238, 7_856)} == {BLOCK}
    assert BLOCK > block_size(31_416) > block_size(125_676) == block_size(10**8) == LEAST_BLOCK


@pytest.mark.parametrize("rotated", [False, True])
def test_a_prediction_does_not_depend_on_those_beside_it(fine: FitCells, rotated: bool) -> None:
    bump = Bump(rotated=rotated, background=None)
    theta = vectors(bump, 19)
    together = bump.predict(theta, fine)
    for i in (0, 7, 18):
        np.testing.assert_array_equal(together[i], bump.predict(theta[i : i + 1], fine)[0])
    expected = bump.level(theta)[:, None] + theta[:, :1] * bump.unit_bump(theta, fine)
    np.testing.assert_array_equal(together, expected)


def test_a_window_is_not_taken_for_another(fine: FitCells) -> None:
    """What is kept of a window belongs to it: a part of it, and then all of it, give their own cells."""
    bump = Bump()
    theta, whole = vectors(bump, 3), bump.predict(vectors(bump, 3), fine)
    keep = fine.x_mm > 0.0
    names = ("x_mm", "y_mm", "value", "variance", "count", "row", "column")
    part = replace(fine, **{name: getattr(fine, name)[keep] for name in names})
    np.testing.assert_array_equal(bump.predict(theta, part), whole[:, keep])
    np.testing.assert_array_equal(bump.predict(theta, fine), whole)


def test_a_density_of_many_vectors_takes_little_memory(fine: FitCells) -> None:
    bump = Bump()
    target = Target(
        lambda theta: bump.predict(theta, fine),
        fine.value,
        np.ones(len(fine)),
        lambda theta: np.zeros(len(theta)),
        ErrorModel(0.02, 1.0, 100.0),
        0.0,
        len(bump.names),
    )
    theta = vectors(bump, 128)
    target.excess(theta[:1])
    tracemalloc.start()
    excess = target.excess(theta)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 32 * len(fine) * 8 * 4  # blocks of 64 took twice that
    one_by_one = [float(target.excess(vector[None])[0]) for vector in theta[::16]]
    np.testing.assert_allclose(excess[::16], one_by_one, rtol=1e-12)
