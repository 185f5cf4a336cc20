"""Change of the skin's compliance by a lump that is no ball: a body condensed onto a hull, with the lump inside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.lump_shape import LumpShape
from tactile_bayes.forward.solid.axisymmetric import (
    CondensedLump,
    CondensedMode,
    Tissue,
    condense_lump,
    condense_twist,
    orders_needed,
    skin_spline,
)
from tactile_bayes.forward.solid.frames import RANK_TOLERANCE, REACH_MM, STEP_MM, square_mean
from tactile_bayes.forward.solid.inclusion import Harmonic, Inclusion, Rings, families
from tactile_bayes.forward.solid.mesh import LEAST_CAP, LumpGeometry, MeshSize, lump_mesh
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM

# Half heights of hulls that are tried, in those of the lump, and their room about it.
_HEIGHTS: Final = (1.06, 1.1, 1.15, 1.2, 1.3, 1.4, 1.55)
_ROOM: Final = 1.06
# Skin over a hull, as a share of its half height: what `LumpGeometry` asks for and a little more.
_COVER: Final = 1.025
# Fewest and most Fourier orders of a shape that is not axisymmetric.
_LEAST_ORDERS: Final = 8
_MOST_ORDERS: Final = 10
# Errors of 0.5 % against finer ones. The tissue that the hull replaces needs elements near the hull as short as those
# around the lump: with the 3 rings of a ball, a hull close to the skin was off by 20 %.
SHAPE_MESH: Final = MeshSize(arc=16, core=6)


@dataclass(frozen=True, slots=True, eq=False)
class SkinFunctions:
    """Functions on the skin that share some angular forms.

    Parameters
    ----------
    forms
    tables : (t, f, k) array
        Each of f forms' share of k functions, at distances every 0.05 mm, in mm (kPa mm^2)^(-1/2).
    sign : (k,) array
        -1 where the lump stiffens.
    """

    forms: tuple[Harmonic, ...]
    tables: FloatArray
    sign: FloatArray

    def at(self, distance_mm: FloatArray, angle_rad: FloatArray) -> FloatArray:
        """(n, k) values."""
        place = distance_mm / STEP_MM
        below = np.minimum(place.astype(np.int64), len(self.tables) - 2)
        share = np.clip(place - below, 0.0, 1.0)[:, None]
        phase = [(np.sin if form.odd else np.cos)(form.order * angle_rad) for form in self.forms]
        angular = np.stack(phase, axis=-1)
        # two matrix products per point instead of tables interpolated form by form
        below_part = (angular * (1.0 - share))[:, None] @ self.tables[below]
        above_part = (angular * share)[:, None] @ self.tables[below + 1]
        return np.asarray((below_part + above_part)[:, 0])


@dataclass(frozen=True, slots=True, eq=False)
class ShapePerturbation:
    r"""Low-rank change of the skin's compliance by a lump of any form.

    Parameters
    ----------
    parts
        Functions by family of forms.
    turn_rad
        From the scene's x axis to the lump's first.

    Notes
    -----
    :math:`\Delta C(x, y) = \sum_k s_k f_k(x) f_k(y)` with :math:`f_k = \sum_m a_{km}(r) \cos m\theta +
    b_{km}(r) \sin m\theta`.
    """

    parts: tuple[SkinFunctions, ...]
    turn_rad: float = 0.0

    def vectors(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, k) values at points about the axis, and (k,) signs: the change is ``values diag(signs) values^T``."""
        distance, angle = np.hypot(x_mm, y_mm), np.arctan2(y_mm, x_mm) - self.turn_rad
        values = np.concatenate([part.at(distance, angle) for part in self.parts], axis=1)
        return values, np.concatenate([part.sign for part in self.parts])

    def turned(self, angle_rad: float) -> ShapePerturbation:
        """The same lump, turned about the vertical from x towards y."""
        return ShapePerturbation(self.parts, self.turn_rad + angle_rad)


@dataclass(frozen=True, slots=True, eq=False)
class ShapedLump:
    """The body around a hull, condensed, and the lump inside; made by `shaped_lump`.

    Parameters
    ----------
    around
        The body around the hull, with the tissue that the hull replaces.
    twist
        The same for twisting about the vertical.
    inclusion
    tissue
    families
        Angular forms of the displacements, see `inclusion.families`.
    """

    around: CondensedLump
    twist: CondensedMode
    inclusion: Inclusion
    tissue: Tissue
    families: tuple[tuple[Harmonic, ...], ...]

    def matrices(self, lump_kpa: float) -> tuple[FloatArray, ...]:
        """For each family, the (s f, s f) change of the sinking at the s skin nodes, form by form; symmetric.

        The formula of `CondensedMode.perturbation`, with all orders coupled through the stiffness inside the hull.
        """
        if not lump_kpa > 0:
            raise BadDataError(f"the lump's modulus is {lump_kpa} kPa", way_out="it must be above 0")
        return tuple(self._matrix(lump_kpa, forms) for forms in self.families)

    def _matrix(self, lump_kpa: float, forms: tuple[Harmonic, ...]) -> FloatArray:
        from scipy.linalg import block_diag

        modes = [self.twist if form.twist else self.around.modes[form.order] for form in forms]
        stiffness = self.inclusion.condensed(lump_kpa, self.tissue, forms, symmetric=len(self.families) > 1)
        flexibility = block_diag(*[mode.flexibility for mode in modes])
        change = stiffness - block_diag(*[mode.original_stiffness for mode in modes])
        before = [
            np.linalg.solve(np.eye(len(mode.flexibility)) + mode.flexibility @ mode.original_stiffness, mode.skin.T)
            for mode in modes
        ]
        forces = np.linalg.solve(np.eye(len(stiffness)) + stiffness @ flexibility, change @ block_diag(*before))
        scale = np.repeat([form.measure for form in forms], len(self.around.radius_mm)) ** -0.5
        matrix = -block_diag(*[mode.skin for mode in modes]) @ forces * np.outer(scale, scale)
        return np.asarray((matrix + matrix.T) / 2)

    def perturbation(
        self, lump_kpa: float, *, square_mm: float = HEAD_PITCH_MM, tolerance: float = RANK_TOLERANCE
    ) -> ShapePerturbation:
        """Leading functions of the change, averaged over squares; see `frames.skin_perturbation`."""
        solved = [np.linalg.eigh(matrix) for matrix in self.matrices(lump_kpa)]
        least = tolerance * max(float(np.abs(value).max()) for value, _ in solved)
        radius, last = self.around.radius_mm, float(self.around.radius_mm[-1])
        r: FloatArray = np.arange(int(np.ceil(min(REACH_MM, last) / STEP_MM)) + 1, dtype=np.float64) * STEP_MM
        parts = []
        for forms, (value, vector) in zip(self.families, solved, strict=True):
            kept = np.abs(value) > least
            function = (vector[:, kept] * np.sqrt(np.abs(value[kept]))).reshape(len(forms), len(radius), -1)
            tables = [
                square_mean(
                    skin_spline(radius, f, order=form.order), r, order=form.order, square_mm=square_mm, last_mm=last
                )
                for form, f in zip(forms, function, strict=True)
            ]
            parts.append(SkinFunctions(forms, np.stack(tables, axis=1), np.sign(value[kept])))
        return ShapePerturbation(tuple(parts))


def shaped_lump(
    shape: LumpShape,
    tissue: Tissue,
    *,
    depth_mm: float,
    fat_mm: float,
    thickness_mm: float,
    size: MeshSize | None = None,
    rings: Rings | None = None,
    orders: int | None = None,
    hull: LumpGeometry | None = None,
) -> ShapedLump:
    """Condense the body around a shape.

    Parameters
    ----------
    depth_mm
        Of the shape's centre below the skin.
    fat_mm, thickness_mm
        Depths of the boundary between fat and gland, and of the base.
    size, rings, orders
        Of the mesh; None for the defaults, whose errors docs/decisions/0100 states.
    hull
        A vertical spheroid about the shape's centre that holds the shape; None for the closest found.

    Raises
    ------
    BadDataError
        When no hull fits between skin and base.
    """
    hull = hull or hull_of(shape, depth_mm=depth_mm, fat_mm=fat_mm, thickness_mm=thickness_mm)
    count = orders or min(max(orders_needed(hull), _LEAST_ORDERS), _MOST_ORDERS)
    size = size or SHAPE_MESH
    around = condense_lump(hull, tissue, size=size, orders=count)
    inclusion = Inclusion(lump_mesh(hull, size), hull.depth_mm, hull.boundary_mm(), shape.radius_mm, rings or Rings())
    twist = condense_twist(hull, tissue, size=size)
    return ShapedLump(around, twist, inclusion, tissue, families(count, symmetric=shape.symmetric))


def hull_of(shape: LumpShape, *, depth_mm: float, fat_mm: float, thickness_mm: float) -> LumpGeometry:
    """The smallest of some vertical spheroids that hold a shape with a little room.

    Raises
    ------
    BadDataError
        When none fits between skin and base.
    """
    points = shape.points_mm()
    across, down = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    half = shape.half_height_mm
    found = []
    for height in np.array(_HEIGHTS) * half:
        room = min(depth_mm, thickness_mm - depth_mm) > _COVER * height
        if room and abs(abs(fat_mm - depth_mm) / height - 1.0) >= LEAST_CAP:
            radius = _ROOM * float((across / np.sqrt(1.0 - (down / height) ** 2)).max())
            found.append((radius**2 * height, radius, float(height)))
    if not found:
        least = _COVER * _HEIGHTS[0] * half
        raise BadDataError(
            f"the lump reaches {half:.4g} mm above and below its centre, which lies {depth_mm:g} mm deep",
            way_out=f"its centre must lie {least:.4g} mm or more from skin and chest wall",
        )
    _, radius, height = min(found)
    return LumpGeometry(radius, height, depth_mm, fat_mm, thickness_mm)
