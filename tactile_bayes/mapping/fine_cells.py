"""Notice for maps with many more cells than a fit needs."""

from __future__ import annotations

import math
from typing import Final

from tactile_bayes.mapping.tactile_map import TactileMap

MANY_CELLS: Final = 20_000
"""In a window: 0.25 mm in the default one, up to five times the time of 1 mm (record 0074)."""


def many_cells(tactile_map: TactileMap, radius_mm: float) -> str | None:
    """Notice for a window of `MANY_CELLS` or more: what it costs, and which cells would do; else None.

    Parameters
    ----------
    tactile_map
        What is to be fitted.
    radius_mm
        Of the window. The cells are those of a covered disc, or all that the map has where these are fewer.

    Returns
    -------
    str or None
        None where a window holds fewer.
    """
    cell = tactile_map.recipe.cell_mm
    cells = min(int(tactile_map.covered.sum()), int(math.pi * radius_mm**2 / cell**2))
    if cells < MANY_CELLS:
        return None
    from tactile_bayes.mapping.advice import advise_cell  # only here: an ordinary estimate needs none of its imports

    advice = advise_cell(tactile_map)
    enough = "cells of half a bump's sigma measure it as well"
    if advice is not None and advice.coarsest_mm > cell:
        enough = f"cells of up to {math.floor(10 * advice.coarsest_mm) / 10:g} mm measure the highest bump as well"
    return (
        f"about {round(cells, -2):,} cells of {cell:g} mm are fitted, which takes a while (measured: 126,000 cells "
        f"20 s of CPU, 1,260 cells 1.4 s); {enough}: give `map` a larger --cell-mm, or reduce the image before `import`"
    )
