"""The face of a rigid head that can touch the skin: the taxels and the rounded rim around them.

A flat end without a rim would press like a punch, with a singular pressure along its edge that no taxel array shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.contact import Head
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import SHOULDERS_OUTSIDE


@dataclass(frozen=True, slots=True, eq=False)
class HeadFace:
    """Squares of the face on the taxels' pitch, with the rows and columns of the rim.

    Parameters
    ----------
    surface_mm : (rows, columns, 3) array
        Centres in `scanhead`: origin at the apex of the face, z into the tissue.
    sensing : (rows, columns) bool array
        True for taxels, False for the rim.
    pitch_mm
        Side of a square.
    """

    surface_mm: FloatArray
    sensing: NDArray[np.bool_]
    pitch_mm: float

    @property
    def taxels(self) -> tuple[int, int]:
        """Rows and columns of the array itself."""
        return int(self.sensing.any(axis=1).sum()), int(self.sensing.any(axis=0).sum())

    def taxel_frame(self, pressure_kpa: FloatArray) -> FloatArray:
        """(rows, columns) of the array from the (n,) pressures of the whole face."""
        return pressure_kpa[self.sensing.ravel()].reshape(self.taxels)


def head_face(taxel_mm: FloatArray, *, pitch_mm: float, radius_mm: float, rim_mm: float = 0.0) -> HeadFace:
    r"""Add a rounded rim to the taxels of a head.

    Parameters
    ----------
    taxel_mm : (rows, columns, 3) array
        Taxel centres in `scanhead`.
    pitch_mm
        Distance of neighbours.
    radius_mm
        Of the arc across the face.
    rim_mm
        Radius of the quarter round that leaves the face at the edge of the taxels, tangent to it; 0 for none.

    Notes
    -----
    Across the head the face is the section `contact.Head` with its shoulders outside: the rim is tangent to the arc at
    the array's edge. Along the head the rim is tangent to a line.
    Squares whose centres lie on the rim are added.
    """
    rows, columns = taxel_mm.shape[:2]
    if not 0 <= rim_mm < radius_mm:
        raise BadDataError(f"rim_mm is {rim_mm:g}", way_out=f"it must lie in 0 to below radius_mm, {radius_mm:g} mm")
    half_x, half_y = rows * pitch_mm / 2, columns * pitch_mm / 2
    section = Head(2 * half_x, radius_mm, rim_mm, SHOULDERS_OUTSIDE)
    more_x = _squares(half_x, section.half_face_mm, pitch_mm)
    more_y = _squares(half_y, half_y + rim_mm, pitch_mm)
    x = (np.arange(rows + 2 * more_x) - (rows + 2 * more_x - 1) / 2) * pitch_mm
    y = (np.arange(columns + 2 * more_y) - (columns + 2 * more_y - 1) / 2) * pitch_mm
    across = -section.profile_mm(x)
    along = np.sqrt(np.maximum(rim_mm**2 - np.clip(np.abs(y) - half_y, 0.0, None) ** 2, 0.0)) - rim_mm
    surface = np.stack(np.broadcast_arrays(x[:, None], y[None, :], across[:, None] + along[None, :]), axis=-1).copy()
    sensing = np.zeros(surface.shape[:2], dtype=bool)
    sensing[more_x : more_x + rows, more_y : more_y + columns] = True
    surface[sensing] = taxel_mm.reshape(-1, 3)
    return HeadFace(surface, sensing, pitch_mm)


def _squares(half_mm: float, reach_mm: float, pitch_mm: float) -> int:
    """Number of squares beyond `half_mm` whose centres are nearer than `reach_mm`."""
    return max(0, int(np.ceil((reach_mm - half_mm) / pitch_mm - 0.5 - 1e-9)))
