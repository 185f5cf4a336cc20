"""A word beforehand about maps with far more cells than a fit needs."""

from __future__ import annotations

import numpy as np
from posterior_maps import bump_map, grid_map

from tactile_bayes.mapping.map import MANY_CELLS, many_cells


def test_a_map_of_very_fine_cells_is_told_with_cells_that_would_do() -> None:
    line = many_cells(bump_map(cell_mm=0.2, half_mm=30.0), 20.0)
    assert line is not None
    assert "\n" not in line
    assert line.startswith("about 31,400 cells of 0.2 mm are fitted")
    coarsest = float(line.partition("cells of up to ")[2].split()[0])
    assert 0.4 * 4.5 < coarsest <= 0.5 * 4.5 * 1.15  # half the narrower sigma, which the map tells to 15 %
    assert "--cell-mm" in line


def test_ordinary_maps_are_not_told_anything() -> None:
    assert many_cells(bump_map(), 20.0) is None
    assert many_cells(bump_map(cell_mm=0.5), 20.0) is None
    assert many_cells(bump_map(cell_mm=0.2), 12.0) is None  # what counts is the window's cells, not the map's


def test_where_nothing_stands_out_no_width_is_named() -> None:
    side = int(np.sqrt(MANY_CELLS)) + 1
    rng = np.random.default_rng(0)
    line = many_cells(grid_map(1.0 + 0.02 * rng.standard_normal((side, side)), cell_mm=0.1), 20.0)
    assert line is not None
    assert "half a bump's sigma" in line
    assert many_cells(grid_map(np.full((side - 2, side - 2), 1.0), cell_mm=0.1), 20.0) is None
