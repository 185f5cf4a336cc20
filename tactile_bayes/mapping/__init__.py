"""From a scan to a tactile map (paper steps i to iii)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile_bayes.mapping.accumulate import Instrument, MapAccumulator, MapGrid
    from tactile_bayes.mapping.build import build_map
    from tactile_bayes.mapping.map import MapRecipe, TactileMap

__all__ = ["Instrument", "MapAccumulator", "MapGrid", "MapRecipe", "TactileMap", "build_map"]

_HOME = {
    "Instrument": "growing",
    "MapAccumulator": "growing",
    "MapGrid": "growing",
    "MapRecipe": "map",
    "TactileMap": "map",
    "build_map": "build",
}


def __getattr__(name: str) -> object:
    """Import a name's module on first use: an estimate needs the map, not the code that builds one."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
