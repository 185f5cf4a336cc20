"""Some of a map's frames, kept with it: what the map averages over, how a lump feels under each part of the head.

Averaged over 20 ms and over 2 x 2 taxels they hold nearly all that a scan of some ten seconds tells of a lump, in 100
kB (docs/decisions/0106).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass

POOL_TAXELS = 2
"""Blocks are of so many taxels by so many."""
STEP = 2e-4
"""Pressures over their frame's mean are whole multiples of this, so that a file can hold them in 16 bits."""
MOST_STEPS = 2**16 - 1


@dataclass(frozen=True, slots=True, eq=False)
class FrameSample:
    """Averaged frames of a map.

    Parameters
    ----------
    pressure : (m, k) array
        Of blocks of taxels, over the mean of the frame.
    plane_from_head : (m, 2, 4) array
        Rows x and y of the transform from `scanhead` to `plane`, mm.
    place_mm : (k, 3) array
        Centres of the blocks in `scanhead`.
    """

    pressure: FloatArray
    plane_from_head: FloatArray
    place_mm: FloatArray

    def __post_init__(self) -> None:
        m, k = len(self.pressure), len(self.place_mm)
        shapes = {"pressure": (m, k), "plane_from_head": (m, 2, 4), "place_mm": (k, 3)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise BadDataError(
                    f"the frames' {name} is no finite array of shape {shape}", way_out="map the scan anew"
                )
        if not (self.pressure.size and self.pressure.mean(axis=1).min() > 0):
            raise BadDataError("a frame's mean pressure is not above 0", way_out="map the scan anew")

    def __len__(self) -> int:
        return len(self.pressure)

    @property
    def steps(self) -> NDArray[np.uint16]:
        """(m, k) pressures in multiples of `STEP`."""
        return np.rint(self.pressure / STEP).astype(np.uint16)

    def places_mm(self) -> FloatArray:
        """(m, k, 2) places of the blocks on the plane."""
        turn, shift = self.plane_from_head[:, :, :3], self.plane_from_head[:, :, 3]
        return np.asarray(np.einsum("mij,kj->mki", turn, self.place_mm) + shift[:, None])

    def under_head_mm(self, place_mm: tuple[float, float]) -> FloatArray:
        """(m, 2) place of a point of the plane under each frame's head, across and along it."""
        turn, shift = self.plane_from_head[:, :, :2], self.plane_from_head[:, :, 3]
        return np.asarray(np.einsum("mij,mi->mj", turn, np.array(place_mm) - shift))
