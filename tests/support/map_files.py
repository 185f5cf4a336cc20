"""A small map for the tests of its file, a map of another program's grid, and what makes two maps the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.files.arrays_layout import GridOptions
from tactile_bayes.files.grids import import_grid
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.mapping.map import MapRecipe, TactileMap

PROVENANCE = Provenance("map", {"cell_mm": 1.0}, {"scan_1": "0" * 64})


def plain_map(ny: int = 6, nx: int = 8) -> TactileMap:
    rng = np.random.default_rng(5)
    return TactileMap(
        rng.random((ny, nx)), rng.random((ny, nx)), np.full((ny, nx), 9), np.arange(nx) - 3.0, np.arange(ny) - 2.0,
        MapRecipe("scan", "mean", 1.0, (5.0, 14.0), 4.0), plane_from_base=np.eye(4), quality={"frames_used": 7.0},
    )  # fmt: skip


def read_grid(path: Path, **asked: Any) -> TactileMap:
    """The map of a grid; `asked` are fields of `GridOptions`."""
    return import_grid(path, GridOptions(**asked))[0]


def assert_same(one: TactileMap, two: TactileMap) -> None:
    for name in ("mean", "variance", "count", "x_mm", "y_mm", "plane_from_base", "patient_from_plane"):
        a, b = getattr(one, name), getattr(two, name)
        if a is None or b is None:
            assert a is b, name
        else:
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), name
    for name in ("recipe", "background", "frame_count", "quality", "masked_taxels", "head"):
        assert getattr(one, name) == getattr(two, name), name
