"""Quadrilateral meshes of half the body, graded and with every material boundary on element edges.

All meshes are of nine-node quadrilaterals on x >= 0 (the body is symmetric about the lump's axis); z is depth. Around
the lump runs a ring of rays from its circle to a box; beyond the box, rows and columns. Where rays meet in a point
(the centre of the disc, the point where a resting lump touches the gland) quadrilaterals collapse to triangles. Under a
lump that stands clear of the gland the box ends on the boundary of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.forward.body import Body
from tactile_bayes.geometry import FloatArray

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]

# Half width of the box about the lump, and how far it reaches above and below the centre, in diameters.
_BOX = 0.75
# A box whose top would leave less than this many diameters of rows above it goes to the skin.
_LEAST_ABOVE = 0.35
# Beyond the outermost head position (72 mm) the body goes on for this many thicknesses.
_BEYOND = 3.0
REACH_MM = 72.0
# Elements per unit of fineness: along the arc below the skin (where the bump's shape is made), from there down to the
# fat-gland boundary, on either part below it, and along the rays outside and inside the lump.
_TOP, _UP, _DOWN, _OUT, _IN = 8, 4, 2, 2, 2
# Elements beyond the box grow by this factor from one to the next at fineness 1, by its square root at 2.
_GROWTH = 2.2


@dataclass(frozen=True, slots=True, eq=False)
class QuadMesh:
    """Nine-node quadrilaterals.

    Parameters
    ----------
    nodes : (n, 2) array
        x and depth z in mm.
    elements : (m, 9) int array
        Node numbers in tensor order: ``elements[:, 3 * i + j]`` is the node at step i of the first local direction and
        step j of the second.
    gland : (m,) bool array
        Whether the element lies below the fat-gland boundary.
    """

    nodes: FloatArray
    elements: IntArray
    gland: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


def body_mesh(body: Body, *, fineness: int) -> QuadMesh:
    """The body on x >= 0 with a hole where the lump is.

    Parameters
    ----------
    fineness
        Elements along each part of the box; twice the fineness is half the element size everywhere.
    """
    box = _Box.around(body, fineness)
    ring = _rays(_circle(body, box.angles_rad()), box.outline(), np.linspace(0.0, 1.0, 2 * _OUT * fineness + 1))
    across = _graded(box.half_width_mm, REACH_MM + _BEYOND * body.layers.thickness_mm, box.row_mm, fineness)
    rows = np.concatenate([box.above_mm[:-1], box.side_mm[:-1], box.below_mm])
    blocks = [ring, _grid(across, rows), _grid(box.bottom_x_mm, box.below_mm)]
    if len(box.above_mm) > 1:
        blocks.append(_grid(box.top_x_mm, box.above_mm))
    return _join(blocks, boundary_mm=body.layers.fat_mm, scale_mm=body.d_mm)


def disc_mesh(body: Body, *, fineness: int, layered: bool) -> QuadMesh:
    """The lump on x >= 0 with the same nodes on its circle as `body_mesh`.

    Parameters
    ----------
    layered
        Whether the fat-gland boundary runs along element edges through the disc; else the rays meet in its centre.
    """
    circle = _circle(body, _Box.around(body, fineness).angles_rad())
    depth = body.layers.fat_mm if layered else body.centre_mm
    middle = np.broadcast_to([0.0, depth], circle.shape)
    block = _rays(middle, circle, np.linspace(0.0, 1.0, 2 * _IN * fineness + 1))
    return _join([block], boundary_mm=body.layers.fat_mm, scale_mm=body.d_mm)


def rectangle_mesh(x_mm: FloatArray, z_mm: FloatArray) -> QuadMesh:
    """A grid of quadrilaterals with corners at `x_mm` and `z_mm`, all of them fat: for bodies without a lump."""
    return _join([_grid(_with_middles(x_mm), _with_middles(z_mm))], boundary_mm=np.inf, scale_mm=1.0)


def joined(meshes: Sequence[QuadMesh], *, scale_mm: float) -> QuadMesh:
    """Merge several meshes into one; nodes nearer than 1e-8 of `scale_mm` become one."""
    offsets = np.cumsum([0] + [len(mesh.nodes) for mesh in meshes])
    points, number = _merged(np.concatenate([mesh.nodes for mesh in meshes]), scale_mm)
    elements = [number[mesh.elements + offset] for mesh, offset in zip(meshes, offsets, strict=False)]
    return QuadMesh(points, np.concatenate(elements), np.concatenate([mesh.gland for mesh in meshes]))


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    """The rectangle about the lump and the rows above and below it; positions include the elements' middles."""

    body: Body
    half_width_mm: float
    above_mm: FloatArray
    side_up_mm: FloatArray
    side_down_mm: FloatArray
    below_mm: FloatArray
    top_x_mm: FloatArray
    bottom_x_mm: FloatArray

    @classmethod
    def around(cls, body: Body, fineness: int) -> _Box:
        h, d, layers = body.centre_mm, body.d_mm, body.layers
        top = h - _BOX * d if h > (_BOX + _LEAST_ABOVE) * d else 0.0
        if body.seat > 1.0:
            return cls._above_gland(body, top, fineness)
        bottom = h + 0.5 * d + min((_BOX - 0.5) * d, 0.5 * (layers.thickness_mm - h - 0.5 * d))
        side_up = np.linspace(top, layers.fat_mm, 2 * _UP * fineness + 1)
        row = 2 * float(side_up[1] - side_up[0])
        return cls(
            body,
            _BOX * d,
            _rows_above(top, d, fineness),
            side_up,
            np.linspace(layers.fat_mm, bottom, 2 * _DOWN * fineness + 1),
            _graded(bottom, layers.thickness_mm, row, fineness),
            _projected(_BOX * d, h - top, _TOP * fineness),
            np.linspace(0.0, _BOX * d, 2 * _DOWN * fineness + 1),
        )

    @classmethod
    def _above_gland(cls, body: Body, top: float, fineness: int) -> _Box:
        """Box of a lump clear of the gland: it ends at the fat-gland boundary, so that its side lies in fat."""
        h, d, layers = body.centre_mm, body.d_mm, body.layers
        half = 0.5 * (top + layers.fat_mm)
        side_up = np.linspace(top, half, 2 * _UP * fineness + 1)
        return cls(
            body,
            _BOX * d,
            _rows_above(top, d, fineness),
            side_up,
            np.linspace(half, layers.fat_mm, 2 * _UP * fineness + 1),
            _graded(layers.fat_mm, layers.thickness_mm, 2 * float(side_up[1] - side_up[0]), fineness),
            _projected(_BOX * d, h - top, _TOP * fineness),
            _projected(_BOX * d, layers.fat_mm - h, _UP * fineness),
        )

    @property
    def side_mm(self) -> FloatArray:
        """Depths along the whole side."""
        return np.concatenate([self.side_up_mm[:-1], self.side_down_mm])

    @property
    def row_mm(self) -> float:
        """Height of an element beside the box."""
        return 2 * float(self.side_up_mm[1] - self.side_up_mm[0])

    def outline(self) -> FloatArray:
        """(k, 2) points from above the lump along top, side and bottom to below it."""
        w = self.half_width_mm
        top = np.stack([self.top_x_mm, np.full_like(self.top_x_mm, self.above_mm[-1])], axis=1)
        side = np.stack([np.full_like(self.side_mm, w), self.side_mm], axis=1)
        bottom = np.stack([self.bottom_x_mm[::-1], np.full_like(self.bottom_x_mm, self.side_mm[-1])], axis=1)
        return np.concatenate([top[:-1], side[:-1], bottom])

    def angles_rad(self) -> FloatArray:
        """(k,) angles from the lump's highest point, one for each point of the outline."""
        if self.body.seat > 1.0:
            outline = self.outline()
            return np.asarray(np.arctan2(outline[:, 0], self.body.centre_mm - outline[:, 1]))
        corner = np.arctan2(self.half_width_mm, self.body.centre_mm - self.above_mm[-1])
        boundary = 0.5 * np.pi + np.arcsin(self.body.seat)
        n_top, n_up = len(self.top_x_mm), len(self.side_up_mm)
        n_down = len(self.side_down_mm) + len(self.bottom_x_mm) - 1
        parts = [
            np.linspace(0.0, corner, n_top)[:-1],
            np.linspace(corner, boundary, n_up)[:-1],
            np.linspace(boundary, np.pi, n_down),
        ]
        return np.concatenate(parts)


def _rows_above(top_mm: float, d_mm: float, fineness: int) -> FloatArray:
    """Rows between the skin and the box; the skin alone where the box reaches it."""
    if top_mm <= 0:
        return np.zeros(1)
    return np.linspace(0.0, top_mm, 2 * fineness * int(np.ceil(min(2 * top_mm / d_mm, 6.0))) + 1)


def _projected(half_width_mm: float, distance_mm: float, count: int) -> FloatArray:
    """Points of the box's lid or floor by central projection of equal angles.

    Rays so leave the circle at right angles where the line is near, and stand close together where it is nearest.
    """
    corner = np.arctan2(half_width_mm, distance_mm)
    return np.asarray(distance_mm * np.tan(np.linspace(0.0, corner, 2 * count + 1)))


def _circle(body: Body, angles_rad: FloatArray) -> FloatArray:
    """(k, 2) points of the lump's boundary."""
    r = body.radius_mm
    return np.stack([r * np.sin(angles_rad), body.centre_mm - r * np.cos(angles_rad)], axis=1)


def _rays(inner: FloatArray, outer: FloatArray, shares: FloatArray) -> FloatArray:
    """(k, len(shares), 2) points on the straight lines between two outlines."""
    return np.asarray(inner[:, None, :] + shares[None, :, None] * (outer - inner)[:, None, :])


def _grid(x_mm: FloatArray, z_mm: FloatArray) -> FloatArray:
    """(len(x), len(z), 2) points."""
    return np.stack(np.meshgrid(x_mm, z_mm, indexing="ij"), axis=-1)


def _graded(begin_mm: float, end_mm: float, first_mm: float, fineness: int) -> FloatArray:
    """Corners and midpoints of elements that grow from `first_mm`, by a factor that shrinks with the fineness."""
    growth = _GROWTH ** (1.0 / fineness)
    length = end_mm - begin_mm
    count = int(np.ceil(np.log1p(length / first_mm * (growth - 1.0)) / np.log(growth)))
    sizes = growth ** np.arange(max(count, fineness))
    corners = begin_mm + length * np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])
    return _with_middles(corners)


def _with_middles(corners: FloatArray) -> FloatArray:
    """Corners, with the midpoint of each pair between them."""
    points = np.empty(2 * len(corners) - 1)
    points[::2] = corners
    points[1::2] = 0.5 * (corners[1:] + corners[:-1])
    return points


def _join(blocks: Sequence[FloatArray], *, boundary_mm: float, scale_mm: float) -> QuadMesh:
    """Merge blocks into one mesh; coinciding points become one node, elements without area are dropped."""
    nodes, number = _merged(np.concatenate([block.reshape(-1, 2) for block in blocks]), scale_mm)
    offsets = np.cumsum([0] + [block.shape[0] * block.shape[1] for block in blocks])
    elements = np.concatenate(
        [_elements(block.shape[0], block.shape[1]) + offset for block, offset in zip(blocks, offsets, strict=False)]
    )
    elements = number[elements]
    corners = nodes[elements[:, [0, 2, 8, 6]]]
    x, z = corners[..., 0], corners[..., 1]
    area = 0.5 * np.abs(np.sum(x * np.roll(z, -1, axis=1) - z * np.roll(x, -1, axis=1), axis=1))
    kept = area > 1e-10 * scale_mm**2
    gland = corners[..., 1].mean(axis=1) > boundary_mm
    return _compact(nodes, elements[kept], gland[kept])


def _merged(points: FloatArray, scale_mm: float) -> tuple[FloatArray, IntArray]:
    """Distinct points, and the index of each given point among them."""
    key = np.round(points / (1e-8 * scale_mm)).astype(np.int64)
    _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return points[first], np.asarray(number.reshape(-1), dtype=np.intp)


def _elements(n: int, m: int) -> IntArray:
    """(k, 9) point numbers of the elements of an n by m block of points (both odd)."""
    index = np.arange(n * m).reshape(n, m)
    parts = [index[i : n - 2 + i : 2, j : m - 2 + j : 2].reshape(-1) for i in range(3) for j in range(3)]
    return np.stack(parts, axis=1)


def _compact(nodes: FloatArray, elements: IntArray, gland: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> QuadMesh:
    """Remove the nodes that belong to no element."""
    used, numbers = np.unique(elements, return_inverse=True)
    return QuadMesh(nodes[used], numbers.reshape(elements.shape), gland)
