"""Meshes of a box with a lump, plane and solid, and the elements of both."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.tissue import Body, Layers
from tactile_bayes.geometry import FloatArray

# --- Quadrilateral meshes of half the body, graded and with every material boundary on element edges.
#
# All meshes are of nine-node quadrilaterals on x >= 0 (the body is symmetric about the lump's axis); z is depth.
# Around the lump runs a ring of rays from its circle to a box; beyond the box, rows and columns. Where rays meet in
# a point (the centre of the disc, the point where a resting lump touches the gland) quadrilaterals collapse to
# triangles. Under a lump that stands clear of the gland the box ends on the boundary of the two.

IndexArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]

_BOX = 0.75  #: Half width of the box about the lump, and how far it reaches above and below the centre, in diameters.
_LEAST_ABOVE = 0.35  #: A box whose top would leave less than this many diameters of rows above it goes to the skin.
# Beyond the outermost head position (72 mm) the body goes on for this many thicknesses.
_BEYOND = 3.0
REACH_MM = 72.0
# Elements per unit of fineness: along the arc below the skin (where the bump's shape is made), from there down to the
# fat-gland boundary, on either part below it, and along the rays outside and inside the lump.
_TOP, _UP, _DOWN, _OUT, _IN = 8, 4, 2, 2, 2
# Elements beyond the box grow by this factor from one to the next at fineness 1, by its square root at 2.
_GROWTH = 2.2


class QuadMesh(Record, eq=False):
    """Nine-node quadrilaterals."""

    nodes: FloatArray  #: (n, 2) array: x and depth z in mm.
    elements: IndexArray
    """(m, 9) int array: Node numbers in tensor order: ``elements[:, 3 * i + j]`` is the node at step i of the first
    local direction and step j of the second."""
    gland: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    """(m,) bool array: Whether the element lies below the fat-gland boundary."""


def body_mesh(body: Body, *, fineness: int) -> QuadMesh:
    """The body on x >= 0 with a hole where the lump is; twice the fineness is half the element size everywhere."""
    box = _Box.around(body, fineness)
    ring = _blend(_circle(body, box.angles_rad()), box.outline(), np.linspace(0.0, 1.0, 2 * _OUT * fineness + 1))
    across = _graded(
        box.half_width_mm,
        REACH_MM + _BEYOND * body.layers.thickness_mm,
        2 * float(box.side_up_mm[1] - box.side_up_mm[0]),
        fineness,
    )
    rows = np.concatenate([box.above_mm[:-1], box.side_mm[:-1], box.below_mm])
    blocks = [ring, _grid(across, rows), _grid(box.bottom_x_mm, box.below_mm)]
    if len(box.above_mm) > 1:
        blocks.append(_grid(box.top_x_mm, box.above_mm))
    return _join(blocks, body)


def disc_mesh(body: Body, *, fineness: int, layered: bool) -> QuadMesh:
    """The lump on x >= 0 with the same nodes on its circle as `body_mesh`.

    Layered, the fat-gland boundary runs along element edges through the disc; else the rays meet in its centre.
    """
    circle = _circle(body, _Box.around(body, fineness).angles_rad())
    depth = body.layers.fat_mm if layered else body.centre_mm
    middle = np.broadcast_to([0.0, depth], circle.shape)
    block = _blend(middle, circle, np.linspace(0.0, 1.0, 2 * _IN * fineness + 1))
    return _join([block], body)


class _Box(Record, eq=False):
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
        """The box of a lump; of one clear of the gland it ends on their boundary, so that its side lies in fat."""
        h, d, layers, clear = body.centre_mm, body.d_mm, body.layers, body.seat > 1.0
        top = h - _BOX * d if h > (_BOX + _LEAST_ABOVE) * d else 0.0
        under = h + 0.5 * d
        bottom = layers.fat_mm if clear else under + min((_BOX - 0.5) * d, 0.5 * (layers.thickness_mm - under))
        middle, down = (0.5 * (top + layers.fat_mm), _UP) if clear else (layers.fat_mm, _DOWN)
        side_up = np.linspace(top, middle, 2 * _UP * fineness + 1)
        floor = np.linspace(0.0, _BOX * d, 2 * _DOWN * fineness + 1)
        return cls(
            body,
            _BOX * d,
            # rows between the skin and the box; the skin alone where the box reaches it
            np.linspace(0.0, top, 2 * fineness * int(np.ceil(min(2 * top / d, 6.0))) + 1),
            side_up,
            np.linspace(middle, bottom, 2 * down * fineness + 1),
            _graded(bottom, layers.thickness_mm, 2 * float(side_up[1] - side_up[0]), fineness),
            _projected(_BOX * d, h - top, _TOP * fineness),
            _projected(_BOX * d, bottom - h, _UP * fineness) if clear else floor,
        )

    @property
    def side_mm(self) -> FloatArray:
        """Depths along the whole side."""
        return np.concatenate([self.side_up_mm[:-1], self.side_down_mm])

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


def _grid(x_mm: FloatArray, z_mm: FloatArray) -> FloatArray:
    """(len(x), len(z), 2) points."""
    return np.stack(np.meshgrid(x_mm, z_mm, indexing="ij"), axis=-1)


def _graded(begin_mm: float, end_mm: float, first_mm: float, fineness: int) -> FloatArray:
    """Corners and midpoints of elements that grow from `first_mm`, by a factor that shrinks with the fineness."""
    return _graded_line(begin_mm, end_mm, first=first_mm, grade=_GROWTH ** (1.0 / fineness), least=fineness)


def _join(blocks: Sequence[FloatArray], body: Body) -> QuadMesh:
    """Merge blocks into one mesh; coinciding points become one node, elements without area are dropped."""
    nodes, elements = _numbered(blocks, body.d_mm)
    corners = nodes[elements[:, [0, 2, 8, 6]]]
    x, z = corners[..., 0], corners[..., 1]
    area = 0.5 * np.abs(np.sum(x * np.roll(z, -1, axis=1) - z * np.roll(x, -1, axis=1), axis=1))
    kept = area > 1e-10 * body.d_mm**2
    used, numbers = np.unique(elements[kept], return_inverse=True)
    return QuadMesh(nodes[used], numbers.reshape(-1, 9), corners[kept, :, 1].mean(axis=1) > body.layers.fat_mm)


def _numbered(blocks: Sequence[FloatArray], scale_mm: float) -> tuple[FloatArray, IndexArray]:
    """Nodes, and (k, 9) their numbers in the elements of all (n, m, 2) blocks of points, n and m odd, in order."""
    points = np.concatenate([block.reshape(-1, 2) for block in blocks])
    key = np.round(points / (1e-8 * scale_mm)).astype(np.int64)  # points that coincide
    _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    elements, start = [], 0
    for n, m, _ in (block.shape for block in blocks):
        index = number.reshape(-1)[start : start + n * m].reshape(n, m)
        start += n * m
        parts = [index[i : n - 2 + i : 2, j : m - 2 + j : 2].reshape(-1) for i in range(3) for j in range(3)]
        elements.append(np.stack(parts, axis=1))
    return points[first], np.concatenate(elements)


# --- Meshes of a layered body with a spheroid on its vertical axis: nine-node quadrilaterals in the (r, z) half-plane.
#
# Element edges follow the spheroid, the boundary of the layers and the base. About the lump the mesh is a fan of
# rays to a box; beyond the box it is a graded lattice. z runs down from the skin.

IntArray = NDArray[np.int64]
EXTERIOR_FAT, EXTERIOR_GLAND, INTERIOR_FAT, INTERIOR_GLAND = range(4)
# A layer boundary nearer than this to touching the spheroid (as a share of its vertical half axis) is moved away.
LEAST_CAP: Final = 0.04


class LumpGeometry(Record):
    """A spheroid on the vertical axis of a body of two layers on a rigid base."""

    radius_mm: float
    half_height_mm: float
    """`radius_mm`, `half_height_mm`: Half axes of the spheroid, across and along the vertical."""
    depth_mm: float  #: Of its centre below the skin.
    layers: Layers  #: The body without it.

    def __post_init__(self) -> None:
        """Refuse what the mesh cannot resolve; bodies and scenes have refused all else."""
        bottom = self.depth_mm + self.half_height_mm
        if bottom > self.layers.thickness_mm - 0.02 * self.half_height_mm:
            raise BadDataError(
                f"the lump reaches {bottom:.4g} mm deep, the base lies at {self.layers.thickness_mm:g} mm",
                way_out="give a thicker body or a shallower lump",
            )

    def boundary_mm(self) -> float:
        """Depth of the layer boundary, moved by up to 4 % of the half height where it nearly touches the lump."""
        offset = (self.layers.fat_mm - self.depth_mm) / self.half_height_mm
        gap = abs(offset) - 1.0
        if abs(gap) >= LEAST_CAP:
            return self.layers.fat_mm
        moved = np.sign(offset) * (1.0 + (LEAST_CAP if gap >= 0 else -LEAST_CAP))
        return float(self.depth_mm + moved * self.half_height_mm)


class MeshSize(Record):
    """How fine a mesh is."""

    arc: int = 18  #: Elements along the half circle of the lump.
    rings: int = 6
    core: int = 3
    """`rings`, `core`: Rings of elements outside and inside it."""
    grade: float = 1.45  #: Ratio of neighbouring elements beyond the box.
    reach_mm: float = 300.0  #: Least radius of the mesh.


class LumpMesh(Record, eq=False):
    """Nodes and elements of a mesh."""

    node_mm: FloatArray  #: (n, 2) array: (r, z) of each node.
    element: IntArray  #: (e, 9) int array: Nodes of each element, row by row of its three by three lattice.
    region: IntArray  #: (e,) int array: `EXTERIOR_FAT` and so on.
    arc: IntArray  #: (a,) int array: Nodes on the lump's boundary from the top pole to the bottom pole.
    surface: IntArray  #: (s,) int array: Nodes on the skin by increasing r.


def lump_mesh(geometry: LumpGeometry, size: MeshSize | None = None) -> LumpMesh:
    """Mesh a lump in its body; the module describes the layout."""
    size = size or MeshSize()
    g, boundary = geometry, geometry.boundary_mm()
    cut = abs(boundary - g.depth_mm) < g.half_height_mm
    centre, core = np.array([0.0, boundary if cut else g.depth_mm]), np.linspace(0.0, 1.0, 2 * size.core + 1)
    arcs, rims = _fan(g, boundary, cut=cut, elements=size.arc)
    patches: list[tuple[FloatArray, int]] = []
    for arc, rim in zip(arcs, rims, strict=True):
        middle, fat = float(rim[len(rim) // 2, 1]), float(arc[len(arc) // 2, 1]) < boundary
        patches.append((_blend(arc, rim, _graded_share(size.rings, 1.25)), int(middle > boundary)))
        inside = _blend(np.broadcast_to(centre, arc.shape), arc, core)
        patches.append((inside, INTERIOR_FAT if fat else INTERIOR_GLAND))
    return _merge(patches + _beyond_box(rims, g, boundary, size))


def _box(g: LumpGeometry, boundary: float) -> tuple[float, float, float]:
    """Radius, top and bottom of the box that the fan of rays fills."""
    margin = 1.3 * max(g.radius_mm, g.half_height_mm)
    high, low = g.depth_mm - g.half_height_mm, g.depth_mm + g.half_height_mm
    top, bottom = 0.0, low + margin
    if boundary < high:
        top = boundary
    if low < boundary < bottom + 0.5 * margin:
        bottom = boundary
    if bottom > g.layers.thickness_mm - 0.5 * margin:
        bottom = g.layers.thickness_mm
    return max(g.radius_mm + margin, 0.8 * (g.depth_mm - top)), top, bottom


def _fan(g: LumpGeometry, boundary: float, *, cut: bool, elements: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Nodes on the lump and on the box about it, sector by sector from the top pole to the bottom pole.

    Sectors end at the box's corners, and at the layer boundary where it cuts the lump.
    """
    corner_r, top, bottom = _box(g, boundary)
    upper = float(np.arctan2(corner_r, g.depth_mm - top))
    lower = float(np.pi - np.arctan2(corner_r, bottom - g.depth_mm))
    breaks, depths = [0.0, upper, lower, np.pi], [top, bottom]
    if cut:
        at = float(np.arccos((g.depth_mm - boundary) / g.half_height_mm))
        breaks = [0.0, min(upper, 0.6 * at), at, max(lower, np.pi - 0.6 * (np.pi - at)), np.pi]
        depths = [top, boundary, bottom]
    share = np.diff(breaks) / np.pi * elements
    counts = [max(2 if 0 < i < len(share) - 1 else 1, round(float(s))) for i, s in enumerate(share)]
    # a thin bridge of tissue above the lump needs elements as short as it is thick
    bridge = max(g.depth_mm - g.half_height_mm - top, 0.1 * g.half_height_mm)
    shortest = g.depth_mm * np.tan(breaks[1] / counts[0])
    counts[0] = max(counts[0], round(counts[0] * min(shortest / bridge, 2.0)))

    arcs = []
    for (begin, end), n in zip(pairwise(breaks), counts, strict=True):
        angle = np.linspace(begin, end, 2 * n + 1)
        sine = np.sin(angle)
        sine[np.abs(sine) < 1e-14] = 0.0
        arcs.append(np.stack([g.radius_mm * sine, g.depth_mm - g.half_height_mm * np.cos(angle)], axis=-1))

    def lid(z: float, angle: float, n: int) -> FloatArray:
        """From the axis to the corner, the nodes closest together over the lump."""
        share = np.tan(np.linspace(0.0, angle, 2 * n + 1)) / np.tan(angle)
        share[-1] = 1.0
        return np.stack([corner_r * share, np.full_like(share, z)], axis=-1)

    sides = [np.linspace(a, b, 2 * n + 1) for (a, b), n in zip(pairwise(depths), counts[1:-1], strict=True)]
    rims = [np.stack([np.full_like(z, corner_r), z], axis=-1) for z in sides]
    floor = lid(bottom, np.pi - breaks[-2], counts[-1])
    return arcs, [lid(top, breaks[1], counts[0]), *rims, floor[::-1]]


def _graded_share(count: int, ratio: float) -> FloatArray:
    """(2 count + 1,) shares 0 to 1 whose elements grow by `ratio`, each with its mid-side node in the middle."""
    ends = np.concatenate([[0.0], np.cumsum(ratio ** np.arange(count))])
    ends /= ends[-1]
    share = np.empty(2 * count + 1)
    share[::2], share[1::2] = ends, 0.5 * (ends[1:] + ends[:-1])
    return share


def _blend(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """(len(share), len(start), 2) lattice between two lines of nodes, exact at both."""
    s = share[:, None, None]
    return np.asarray((1.0 - s) * start + s * end)


def _graded_line(start: float, stop: float, *, first: float, grade: float, least: int = 1) -> FloatArray:
    """Nodes of elements, `least` or more, whose length grows from about `first` by at most `grade` until `stop`."""
    length = stop - start
    count = max(least, int(np.ceil(np.log1p((grade - 1.0) * length / first) / np.log(grade))))
    line = start + length * _graded_share(count, grade)
    line[0], line[-1] = start, stop
    return line


def _beyond_box(
    rims: list[FloatArray], g: LumpGeometry, boundary: float, size: MeshSize
) -> list[tuple[FloatArray, int]]:
    """The lattices outside, below and above the box, whose sides from the top to the bottom are given."""
    lid, *sides, floor = rims
    (corner_r, top), bottom = lid[-1].tolist(), float(floor[0, 1])
    side = np.concatenate([sides[0][:1, 1], *(part[1:, 1] for part in sides)])
    reach = max(size.reach_mm, 2.0 * corner_r, 4.0 * g.depth_mm)
    right = _graded_line(corner_r, reach, first=float(corner_r - lid[-3, 0]), grade=size.grade)
    below = _down_from(bottom, g.layers.thickness_mm, boundary, first=float(side[-1] - side[-3]), grade=size.grade)
    above = _down_from(0.0, top, boundary, first=float(side[2] - side[0]), grade=1.0 + 1e-9)
    patches: list[tuple[FloatArray, int]] = []
    for r, z in ((right, above), (right, side), (right, below), (floor[::-1, 0], below), (lid[:, 0], above)):
        # split at the layer boundary
        for a, b in pairwise([0, *np.flatnonzero(z == boundary), len(z) - 1]):
            if b > a:
                part = z[a : b + 1]
                patches.append((_grid(r, part), int(part[len(part) // 2] > boundary)))
    return patches


def _down_from(start: float, stop: float, boundary: float, *, first: float, grade: float) -> FloatArray:
    """Nodes down a line, one of them at the layer boundary; empty when the line has no length."""
    if not stop > start:
        return np.zeros(0)
    if not start < boundary < stop:
        return _graded_line(start, stop, first=first, grade=grade)
    upper = _graded_line(start, boundary, first=first, grade=grade)
    lower = _graded_line(boundary, stop, first=float(upper[-1] - upper[-3]), grade=grade)
    return np.concatenate([upper, lower[1:]])


def _merge(patches: list[tuple[FloatArray, int]]) -> LumpMesh:
    node, element = _numbered([lattice for lattice, _ in patches], 10.0)
    region_of = np.repeat(
        [region for _, region in patches], [(len(one) // 2) * (one.shape[1] // 2) for one, _ in patches]
    )
    surface = np.flatnonzero(np.abs(node[:, 1]) < 1e-7)
    inside, outside = (element[mask] for mask in (region_of >= INTERIOR_FAT, region_of < INTERIOR_FAT))
    arc = np.intersect1d(inside, outside)
    return LumpMesh(
        node_mm=node,
        element=element,
        region=region_of,
        arc=arc[np.argsort(node[arc, 1])],
        surface=surface[np.argsort(node[surface, 0])],
    )


# --- Nine-node elements, for sections and for bodies round an axis: shape functions, stiffness, condensation.
#
# The volume change of an element is projected on linear functions of position (the pair Q2-P1, discontinuous), which
# satisfies the inf-sup condition and so does not lock up to the incompressible limit (Brezzi & Fortin 1991, sec. VI.3;
# Hughes 1980 for the projection). The pressure is eliminated in the element: the matrix is positive definite.


def lagrange_points() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Biquadratic shape functions (9 points, 9 nodes), local gradients (9, 9, 2) and weights (9,) at Gauss points."""
    x, w = np.polynomial.legendre.leggauss(3)
    value = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], axis=-1)
    slope = np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1)
    shape = np.einsum("ai,bj->abij", value, value).reshape(9, 9)
    across, along = np.einsum("ai,bj->abij", slope, value), np.einsum("ai,bj->abij", value, slope)
    return shape, np.stack([across, along], axis=-1).reshape(9, 9, 2), np.outer(w, w).ravel()


def quadrature(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gradients (e, 9 points, 9 nodes, 2), points (e, 9, 2) and area weights (e, 9) of elements by (e, 9, 2) nodes."""
    shape, local, cell = lagrange_points()
    jacobian = np.einsum("qnk,enx->eqxk", local, corners)
    gradient = np.einsum("qnk,eqkx->eqnx", local, np.linalg.inv(jacobian))
    return gradient, np.einsum("qn,enx->eqx", shape, corners), np.abs(np.linalg.det(jacobian)) * cell


def stiffness_factor(
    strain: FloatArray, point: FloatArray, weight: FloatArray, *, normal: int, poisson: float
) -> FloatArray:
    r"""(..., e, n, k) factors A of the elements' stiffness :math:`A^T A` for a modulus of 1 kPa.

    .. math:: K = \int 2\mu\,\varepsilon(v):\varepsilon(u) + \lambda\,\Pi(\nabla\cdot v)\,\Pi(\nabla\cdot u)

    from the (..., e, 9, s, k) strains of unit unknowns, of which the first `normal` are normal and the rest shears;
    :math:`\Pi` is the projection on linear functions of position.
    """
    shear, bulk = 0.5 / (1.0 + poisson), poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    measure = np.where(np.arange(strain.shape[-2]) < normal, 2.0, 1.0) * shear
    scaled = strain * np.sqrt(measure[:, None] * weight[:, :, None, None])
    scaled = scaled.reshape(*scaled.shape[:-3], -1, strain.shape[-1])
    total = weight.sum(axis=1)[:, None, None]
    middle = np.sum(weight[..., None] * point, axis=1, keepdims=True) / total
    spread = np.sqrt(np.sum(weight[..., None] * (point - middle) ** 2, axis=1, keepdims=True) / total)
    linear = np.concatenate([np.ones_like(point[..., :1]), (point - middle) / spread], axis=-1)
    mass = np.einsum("eq,eqa,eqb->eab", weight, linear, linear)
    volume = np.einsum("eq,eqa,...eqk->...eak", weight, linear, strain[..., :normal, :].sum(axis=-2))
    root = np.linalg.cholesky(np.linalg.inv(mass)).transpose(0, 2, 1)
    return np.concatenate([scaled, np.sqrt(bulk) * (root @ volume)], axis=-2)


def gathered(blocks: FloatArray, unknown: IndexArray, size: int) -> csc_array:
    """Sparse matrix of the elements' (e, k, k) blocks by their (e, k) unknowns; those of -1 are fixed."""
    row, column = np.broadcast_arrays(unknown[:, :, None], unknown[:, None, :])
    kept = (row >= 0) & (column >= 0)
    return coo_array((blocks[kept], (row[kept], column[kept])), shape=(size, size)).tocsc()


def solved(matrix: csc_array, sides: FloatArray) -> FloatArray:
    """Solution of a symmetric positive definite system for many right-hand sides: one factorisation."""
    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(sides))


def moved(matrix: csc_array, on: IndexArray) -> FloatArray:
    """(n, b) displacements by a unit force on each of the unknowns `on`; symmetric between those."""
    force = np.zeros((matrix.shape[0], len(on)))
    force[on, np.arange(len(on))] = 1.0
    found = solved(matrix, force)
    found[on] = 0.5 * (found[on] + found[on].T)
    return found


def condensed(matrix: csc_array, on: IndexArray, inner: IndexArray) -> FloatArray:
    """Stiffness condensed onto the unknowns `on`, the inner ones free (Guyan 1965: exact in statics)."""
    coupling = matrix[inner][:, on].toarray()
    kept = matrix[on][:, on].toarray() - coupling.T @ solved(matrix[inner][:, inner], coupling)
    return np.asarray(0.5 * (kept + kept.T))


class CondensedHole(Record, eq=False):
    r"""A body with a hole where the lump is, condensed onto the hole's boundary and the skin.

    With the flexibility F of the surroundings and the stiffness S of what fills the hole, the boundary moves by
    :math:`(I + F S)^{-1} F f`. The difference of two such answers is written as one product, so that it is exact to
    rounding however small it is, and vanishes for equal stiffness:

    .. math:: -F_s (I + S_1 F)^{-1} (S_1 - S_0) (I + F S_0)^{-1} F_s^T
    """

    flexibility: FloatArray  #: F, (b, b) array: displacements on the boundary for unit forces there, nothing inside.
    skin: FloatArray  #: F_s, (s, b) array: Sinking of the skin for the same forces.
    unit_stiffness: FloatArray  #: (b, b) array: The lump, condensed on its boundary, for a modulus of 1 kPa.
    original_stiffness: FloatArray  #: S_0, (b, b) array: The tissue that the lump replaces.

    def change(self, lump_kpa: float) -> FloatArray:
        """(s, s) change of the skin's compliance when tissue is replaced by a lump of modulus `lump_kpa`; symmetric."""
        inside, identity = lump_kpa * self.unit_stiffness, np.eye(len(self.flexibility))
        before = np.linalg.solve(identity + self.flexibility @ self.original_stiffness, self.skin.T)
        forces = np.linalg.solve(identity + inside @ self.flexibility, (inside - self.original_stiffness) @ before)
        change = self.skin @ forces
        return np.asarray(-0.5 * (change + change.T))
