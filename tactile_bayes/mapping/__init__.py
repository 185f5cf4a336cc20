"""From a scan to a tactile map (paper steps i to iii)."""

from tactile_bayes.mapping.accumulator import Instrument, MapAccumulator, MapGrid
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap

__all__ = ["Instrument", "MapAccumulator", "MapGrid", "MapRecipe", "TactileMap", "build_map"]
