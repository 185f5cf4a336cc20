"""Sums in cells: exact, and the same whatever the order and the parts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.errors import BadDataError
from tactile_bayes.mapping.cells import MAX_CELLS, READINGS_PER_CALL, VALUE_LIMIT, VALUE_STEP, CellSums


def readings(seed: int, n: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 9, n), rng.normal(3, 5, n), rng.lognormal(0, 0.7, n)


def cell_index(position_mm: np.ndarray, cell_mm: float) -> np.ndarray:
    return np.floor(position_mm / cell_mm + 0.5).astype(np.int64)


def add(sums: CellSums, x: np.ndarray, y: np.ndarray, value: np.ndarray) -> None:
    """Add readings at positions, all of which lie in one block of cells."""
    row, column = cell_index(y, sums.cell_mm), cell_index(x, sums.cell_mm)
    first = (int(row.min()), int(column.min()))
    shape = (int(row.max()) - first[0] + 1, int(column.max()) - first[1] + 1)
    sums.add_steps(first, shape, (row - first[0]) * shape[1] + column - first[1], np.rint(value / VALUE_STEP))


def summed(x, y, value, *, cell_mm=1.0, parts=1) -> CellSums:
    sums = CellSums(cell_mm)
    for piece in np.array_split(np.arange(len(x)), parts):
        if len(piece):
            add(sums, x[piece], y[piece], value[piece])
    return sums.trimmed()


def same(one: CellSums, two: CellSums) -> bool:
    return (
        one.first == two.first
        and one.clipped == two.clipped
        and all(np.array_equal(getattr(one, name), getattr(two, name)) for name in ("count", "total", "square"))
    )


@given(seed=st.integers(0, 999), parts=st.integers(1, 40), cell_mm=st.sampled_from([0.5, 1.0, 2.7]))
def test_any_order_and_any_parts_give_the_same_bits(seed, parts, cell_mm):
    x, y, value = readings(seed)
    order = np.random.default_rng(seed + 1).permutation(len(x))
    assert same(
        summed(x, y, value, cell_mm=cell_mm),
        summed(x[order], y[order], value[order], cell_mm=cell_mm, parts=parts),
    )


def test_sums_of_floats_would_show_their_order():
    """The control to the test above: without whole numbers it fails."""
    x, _, value = readings(0)
    cell, order = cell_index(x, 1.0) - int(np.floor(x.min())), np.random.default_rng(1).permutation(len(x))
    assert not np.array_equal(np.bincount(cell, value), np.bincount(cell[order], value[order]))


def test_mean_and_variance_are_those_of_the_readings_to_the_step():
    x, y, value = readings(3)
    sums = summed(x, y, value, cell_mm=4.0)
    mean, variance = sums.mean(), sums.variance()
    for row, column in np.argwhere(sums.count > 0):
        here = (cell_index(x, 4.0) == column + sums.first[1]) & (cell_index(y, 4.0) == row + sums.first[0])
        assert sums.count[row, column] == here.sum()
        assert mean[row, column] == pytest.approx(value[here].mean(), abs=VALUE_STEP / 2)
        assert variance[row, column] == pytest.approx(value[here].var(), abs=2 * VALUE_STEP * value.max())
    assert np.isnan(mean[sums.count == 0]).all()
    assert np.isnan(variance[sums.count == 0]).all()


def test_cells_are_centred_on_multiples_of_their_side():
    sums = summed(np.array([-0.49, 0.49, 0.51]), np.zeros(3), np.ones(3))
    assert sums.x_mm().tolist() == [0.0, 1.0]
    assert sums.count.tolist() == [[2, 1]]


def test_values_beyond_the_range_are_clipped_and_counted():
    sums = summed(np.zeros(3), np.zeros(3), np.array([1.0, 1e9, -1e9]))
    assert sums.clipped == 2
    assert sums.mean()[0, 0] == pytest.approx(1 / 3, abs=VALUE_STEP)


def test_a_full_call_of_extreme_values_sums_exactly():
    value = np.full(READINGS_PER_CALL, VALUE_LIMIT)
    sums = summed(np.zeros(len(value)), np.zeros(len(value)), value)
    assert sums.square[0, 0] == READINGS_PER_CALL * int(VALUE_LIMIT / VALUE_STEP) ** 2
    assert sums.variance()[0, 0] == 0.0


@pytest.mark.parametrize("far_mm", [1e9, 3e3])
def test_a_vast_map_is_refused_before_memory_is_asked_for(far_mm):
    sums = CellSums(1.0)
    with pytest.raises(BadDataError, match=f"at most {MAX_CELLS} fit"):
        add(sums, np.array([0.0, far_mm]), np.array([0.0, far_mm]), np.ones(2))


def test_nothing_added_is_an_empty_map():
    assert CellSums(1.0).trimmed().count.shape == (0, 0)
