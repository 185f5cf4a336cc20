"""Which cells are fitted, and where a lump is looked for."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_map, bump_values, grid_map

from tactile_bayes.posterior.bump import (
    candidate_centres,
    covered_share,
    smoothed_excess,
    trusted_cells,
    typical_level,
    value_scale,
    window_cells,
)


def test_a_window_holds_the_cells_of_its_disc() -> None:
    tactile_map = bump_map(half_mm=10)
    cells = window_cells(tactile_map, (2.0, -1.0), radius_mm=5.0)
    u, v = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    inside = (u - 2) ** 2 + (v + 1) ** 2 <= 25
    assert len(cells) == inside.sum()
    np.testing.assert_array_equal(cells.value, tactile_map.mean[inside])
    np.testing.assert_array_equal(tactile_map.mean[cells.row, cells.column], cells.value)
    np.testing.assert_array_equal(cells.x_mm, u[inside])
    np.testing.assert_array_equal(cells.y_mm, v[inside])


def test_cells_with_a_handful_of_readings_are_not_trusted() -> None:
    count = np.full((5, 5), 40)
    count[0, 0], count[0, 1], count[0, 2] = 3, 4, 0
    kept = trusted_cells(grid_map(np.ones((5, 5)), count=count))
    assert not kept[0, 0]
    assert kept[0, 1]
    assert not kept[0, 2]
    assert kept.sum() == 23


def test_a_disc_at_the_rim_is_half_covered() -> None:
    tactile_map = bump_map(half_mm=20)
    assert covered_share(tactile_map, (0.0, 0.0), radius_mm=9.0) == pytest.approx(1.0, abs=0.02)
    assert covered_share(tactile_map, (20.5, 0.0), radius_mm=9.0) == pytest.approx(0.5, abs=0.06)
    assert covered_share(tactile_map, (20.5, 20.5), radius_mm=9.0) == pytest.approx(0.25, abs=0.06)


def test_level_and_scale_are_what_normalising_defines_or_the_map_shows() -> None:
    values = 5 + 3 * (bump_values(amplitude=1.0) - 1)
    assert typical_level(grid_map(values)) == 1.0
    assert value_scale(grid_map(values)) == 1.0
    free = grid_map(values, background=None, normalise="none")
    assert typical_level(free) == pytest.approx(np.median(values))
    assert value_scale(free) == pytest.approx(values.max() - np.median(values))
    assert value_scale(grid_map(np.full((4, 4), 7.0), background=None)) == 1.0


def test_candidates_come_highest_first_and_apart() -> None:
    values = bump_values(x=-12, y=0, amplitude=0.2) + bump_values(x=12, y=3, amplitude=0.4) - 1
    found = candidate_centres(grid_map(values))
    assert found[:2] == [(12.0, 3.0), (-12.0, 0.0)]
    assert len(candidate_centres(grid_map(values), limit=1)) == 1


def test_nothing_that_rises_is_no_candidate() -> None:
    assert candidate_centres(grid_map(np.ones((9, 9)))) == []
    assert candidate_centres(bump_map(amplitude=-0.3)) != [(1.0, -1.0)]
    assert candidate_centres(grid_map(np.full((9, 9), 0.9))) == []


def test_smoothing_keeps_a_level_and_knows_no_cell_without_data() -> None:
    values = np.full((30, 30), 1.25)
    values[:, 20:] = np.nan
    excess = smoothed_excess(grid_map(values))
    np.testing.assert_allclose(excess[:, :20], 0.25, rtol=1e-12)
    assert np.isneginf(excess[:, 20:]).all()


def test_a_rim_of_high_places_does_not_crowd_out_a_lump_inside() -> None:
    """On deep fat the head's rim presses hardest: a score of maxima round the map, each higher than the lump."""
    axis = np.arange(-40.0, 41.0)
    x, y = np.meshgrid(axis, axis)
    values = 1.0 + 0.1 * np.exp(-((x - 3.0) ** 2 + (y + 2.0) ** 2) / (2 * 5.0**2))
    for place in np.arange(-36.0, 37.0, 9.0):
        for u, v in ((place, -40.0), (place, 40.0), (-40.0, place), (40.0, place)):
            values += 0.3 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.0**2))
    tactile_map = grid_map(values)
    found = candidate_centres(tactile_map)
    assert (3.0, -2.0) in found
    assert sum(max(abs(u), abs(v)) > 35 for u, v in found) == 8
    # by height alone the first sixteen are all of the rim
    by_height = candidate_centres(tactile_map, rim_limit=16)
    assert (3.0, -2.0) not in by_height[:16]
    assert by_height[:8] == found[:8]
