"""Meshes of half a body with a lump, in a plane and round an axis, and the elements of both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.tissue import Body, Layers
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray

# --- Nine-node quadrilaterals of half a body, graded and with every material boundary on element edges.
#
# Rays run from a point in the lump to its boundary and on to a box; beyond the box are rows and columns. Where rays
# meet in a point (in the lump, or where a resting lump touches the gland) quadrilaterals collapse to triangles.


class Mesh(Record, eq=False):
    """Half a section of a body with its lump; places are the distance from the lump's axis and the depth in mm."""

    nodes: FloatArray  #: (n, 2) array.
    elements: IndexArray
    """(e, 9) int array: Node numbers in tensor order: ``elements[:, 3 * i + j]`` is the node at step i of the first
    local direction and step j of the second."""
    gland: BoolArray  #: (e,) bool array: True for elements below the fat-gland boundary.
    lump: BoolArray  #: (e,) bool array: True for elements in the lump.

    @property
    def rim(self) -> IndexArray:
        """Nodes on the lump's boundary from its highest point to its lowest, as many in all meshes of a body."""
        rim = np.intersect1d(self.elements[self.lump], self.elements[~self.lump])
        return rim[np.argsort(self.nodes[rim, 1])]

    @property
    def skin(self) -> IndexArray:
        """Nodes on the skin, by increasing distance from the axis."""
        skin = np.flatnonzero(np.abs(self.nodes[:, 1]) < 1e-7)
        return skin[np.argsort(self.nodes[skin, 0])]

    @property
    def edges(self) -> tuple[BoolArray, BoolArray, BoolArray]:
        """(n,) masks of the nodes on the lump's axis, at the mesh's end, and on the chest wall."""
        x, z = self.nodes.T
        return x < 1e-9 * self.nodes.max(), x == x.max(), z == z.max()


def _mesh(
    arcs: Sequence[FloatArray],
    rims: Sequence[FloatArray],
    lattices: Iterable[FloatArray],
    *,
    middle_mm: float,
    boundary_mm: float,
    shares: tuple[FloatArray, FloatArray],
    scale_mm: float,
) -> Mesh:
    """Mesh from a point of the lump's axis to the arcs of its boundary, on to the rims of the box, and the lattices.

    Coinciding points become one node, elements without area are dropped. `shares` divide the rays around the lump and
    inside it.
    """
    outside, inside = shares
    blocks: list[tuple[FloatArray, bool]] = []
    for arc, rim in zip(arcs, rims, strict=True):
        blocks.append((_blend(arc, rim, outside), False))
        blocks.append((_blend(np.broadcast_to([0.0, middle_mm], arc.shape), arc, inside), True))
    blocks += [(lattice, False) for lattice in lattices]
    points = np.concatenate([block.reshape(-1, 2) for block, _ in blocks])
    key = np.round(points / (1e-8 * scale_mm)).astype(np.int64)  # points that coincide
    _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    elements, lump, start = [], [], 0
    for block, in_lump in blocks:
        n, m, _ = block.shape
        index = number.reshape(-1)[start : start + n * m].reshape(n, m)
        start += n * m
        parts = [index[i : n - 2 + i : 2, j : m - 2 + j : 2].reshape(-1) for i in range(3) for j in range(3)]
        elements.append(np.stack(parts, axis=1))
        lump.append(np.full(len(parts[0]), in_lump))
    element, nodes = np.concatenate(elements), points[first]
    corners = nodes[element[:, [0, 2, 8, 6]]]
    x, z = corners[..., 0], corners[..., 1]
    area = 0.5 * np.abs(np.sum(x * np.roll(z, -1, axis=1) - z * np.roll(x, -1, axis=1), axis=1))
    proper = area > 1e-12 * scale_mm**2
    used_nodes, numbers = np.unique(element[proper], return_inverse=True)
    gland = corners[proper, :, 1].mean(axis=1) > boundary_mm
    return Mesh(nodes[used_nodes], numbers.reshape(-1, 9), gland, np.concatenate(lump)[proper])


def _grid(x_mm: FloatArray, z_mm: FloatArray) -> FloatArray:
    """(len(x), len(z), 2) points."""
    return np.stack(np.meshgrid(x_mm, z_mm, indexing="ij"), axis=-1)


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
    """Nodes of `least` or more elements, from `start` to `stop`, whose lengths grow from about `first` by `grade`."""
    length = stop - start
    count = max(least, int(np.ceil(np.log1p((grade - 1.0) * length / first) / np.log(grade))))
    line = start + length * _graded_share(count, grade)
    line[0], line[-1] = start, stop
    return line


# --- The mesh of a body in a plane with a circular lump.
#
# Under a lump that stands clear of the gland the box ends on the boundary of the two.

_BOX = 0.75  #: Half width of the box about the lump, and its reach above and below the centre, in diameters.
_LEAST_ABOVE = 0.35  #: Least height of rows above the box, in diameters; for less the box reaches to the skin.
REACH_MM = 72.0  #: Outermost position of the head.
_BEYOND = 3.0  #: Length of the body beyond that, in thicknesses.
# Elements per unit of fineness: along the arc below the skin (where the bump's shape is made), from there down to the
# fat-gland boundary, on either part below it, and along the rays outside and inside the lump.
_TOP, _UP, _DOWN, _OUT, _IN = 8, 4, 2, 2, 2
# Elements beyond the box grow by this factor from one to the next at fineness 1, by its square root at 2.
_GROWTH = 2.2


def body_mesh(body: Body, *, fineness: int, layered: bool) -> Mesh:
    """Mesh of the body on x >= 0 with its lump; twice the fineness is half the element size everywhere.

    If `layered`, the fat-gland boundary runs along element edges through the lump; else the rays in it meet in its
    centre. Around the lump both are the same mesh.
    """
    h, d, layers, clear = body.centre_mm, body.d_mm, body.layers, body.seat > 1.0
    half, top = _BOX * d, h - _BOX * d if h > (_BOX + _LEAST_ABOVE) * d else 0.0
    under = h + 0.5 * d
    bottom = layers.fat_mm if clear else under + min((_BOX - 0.5) * d, 0.5 * (layers.thickness_mm - under))
    middle, n_down = (0.5 * (top + layers.fat_mm), _UP) if clear else (layers.fat_mm, _DOWN)
    # lines of nodes, with the elements' middles: up and down the box's side, along its lid and floor, above and below
    up = np.linspace(top, middle, 2 * _UP * fineness + 1)
    down = np.linspace(middle, bottom, 2 * n_down * fineness + 1)
    lid = _projected(half, h - top, _TOP * fineness)
    floor = np.linspace(0.0, half, 2 * _DOWN * fineness + 1)
    if clear:
        floor = _projected(half, bottom - h, _UP * fineness)
    first, grade = 2 * float(up[1] - up[0]), _GROWTH ** (1.0 / fineness)
    # rows between the skin and the box; the skin alone where the box reaches it
    above = np.linspace(0.0, top, 2 * fineness * int(np.ceil(min(2 * top / d, 6.0))) + 1)
    below = _graded_line(bottom, layers.thickness_mm, first=first, grade=grade, least=fineness)
    end = REACH_MM + _BEYOND * layers.thickness_mm
    across = _graded_line(half, end, first=first, grade=grade, least=fineness)

    side = np.concatenate([up[:-1], down])
    x = np.concatenate([lid[:-1], np.full(len(side) - 1, half), floor[::-1]])
    z = np.concatenate([np.full(len(lid) - 1, top), side[:-1], np.full(len(floor), bottom)])
    rim = np.stack([x, z], axis=1)
    if clear:
        angle = np.arctan2(x, h - z)
    else:
        corner, boundary = np.arctan2(half, h - top), 0.5 * np.pi + np.arcsin(body.seat)
        ends, counts = [0.0, corner, boundary, np.pi], [len(lid), len(up), len(down) + len(floor) - 1]
        parts = [np.linspace(a, b, n)[:-1] for (a, b), n in zip(pairwise(ends), counts, strict=True)]
        angle = np.concatenate([*parts, [np.pi]])
    arc = np.stack([body.radius_mm * np.sin(angle), h - body.radius_mm * np.cos(angle)], axis=1)
    lattices = [_grid(across, np.concatenate([above[:-1], side[:-1], below])), _grid(floor, below)]
    lattices += [_grid(lid, above)] if len(above) > 1 else []
    return _mesh(
        [arc],
        [rim],
        lattices,
        middle_mm=layers.fat_mm if layered else h,
        boundary_mm=layers.fat_mm,
        shares=(np.linspace(0.0, 1.0, 2 * _OUT * fineness + 1), np.linspace(0.0, 1.0, 2 * _IN * fineness + 1)),
        scale_mm=d,
    )


def _projected(half_width_mm: float, distance_mm: float, count: int) -> FloatArray:
    """Points of the box's lid or floor by central projection of equal angles: closest together over the centre."""
    corner = np.arctan2(half_width_mm, distance_mm)
    return np.asarray(distance_mm * np.tan(np.linspace(0.0, corner, 2 * count + 1)))


# --- The mesh of a layered body with a spheroid on its vertical axis, in the (r, z) half-plane.

LEAST_CAP: Final = 0.04  #: Least distance of a layer boundary from touching the spheroid, in vertical half axes.


class LumpGeometry(Record):
    """A spheroid on the vertical axis of a body of two layers on a rigid base."""

    radius_mm: float
    half_height_mm: float  #: `radius_mm`, `half_height_mm`: Half axes of the spheroid, across and along the vertical.
    depth_mm: float  #: Of its centre below the skin.
    layers: Layers  #: The body without it.

    def __post_init__(self) -> None:
        """Raise `BadDataError` for what the mesh cannot resolve; bodies and scenes refuse all else."""
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
    """Fineness of a mesh."""

    arc: int = 18  #: Elements along the half circle of the lump.
    rings: int = 6
    core: int = 3  #: `rings`, `core`: Rings of elements outside and inside it.
    grade: float = 1.45  #: Ratio of neighbouring elements beyond the box.
    reach_mm: float = 300.0  #: Least radius of the mesh.


def lump_mesh(geometry: LumpGeometry, size: MeshSize | None = None) -> Mesh:
    """Mesh of a lump in its body, fine near it and coarse far away."""
    size = size or MeshSize()
    g, boundary = geometry, geometry.boundary_mm()
    cut = abs(boundary - g.depth_mm) < g.half_height_mm
    arcs, rims = _fan(g, boundary, cut=cut, elements=size.arc)
    return _mesh(
        arcs,
        rims,
        _beyond_box(rims, g, boundary, size),
        middle_mm=boundary if cut else g.depth_mm,
        boundary_mm=boundary,
        shares=(_graded_share(size.rings, 1.25), np.linspace(0.0, 1.0, 2 * size.core + 1)),
        scale_mm=10.0,
    )


def _fan(g: LumpGeometry, boundary: float, *, cut: bool, elements: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Nodes on the lump and on the box about it, sector by sector from the top pole to the bottom pole.

    Sectors end at the box's corners, and at the layer boundary where it cuts the lump.
    """
    # the box
    margin = 1.3 * max(g.radius_mm, g.half_height_mm)
    high, low = g.depth_mm - g.half_height_mm, g.depth_mm + g.half_height_mm
    top, bottom = boundary if boundary < high else 0.0, low + margin
    if low < boundary < bottom + 0.5 * margin:
        bottom = boundary
    if bottom > g.layers.thickness_mm - 0.5 * margin:
        bottom = g.layers.thickness_mm
    corner_r = max(g.radius_mm + margin, 0.8 * (g.depth_mm - top))
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
    bridge = max(high - top, 0.1 * g.half_height_mm)
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


def _beyond_box(rims: list[FloatArray], g: LumpGeometry, boundary: float, size: MeshSize) -> Iterator[FloatArray]:
    """Lattices outside, below and above the box with these `rims`, from the top to the bottom."""
    lid, *sides, floor = rims
    (corner_r, top), bottom = lid[-1].tolist(), float(floor[0, 1])
    side = np.concatenate([sides[0][:1, 1], *(part[1:, 1] for part in sides)])
    reach = max(size.reach_mm, 2.0 * corner_r, 4.0 * g.depth_mm)
    right = _graded_line(corner_r, reach, first=float(corner_r - lid[-3, 0]), grade=size.grade)
    below = _down_from(bottom, g.layers.thickness_mm, boundary, first=float(side[-1] - side[-3]), grade=size.grade)
    above = _down_from(0.0, top, boundary, first=float(side[2] - side[0]), grade=1.0 + 1e-9)
    for r, z in ((right, above), (right, side), (right, below), (floor[::-1, 0], below), (lid[:, 0], above)):
        # split at the layer boundary
        for a, b in pairwise([0, *np.flatnonzero(z == boundary), len(z) - 1]):
            if b > a:
                yield _grid(r, z[a : b + 1])


def _down_from(start: float, stop: float, boundary: float, *, first: float, grade: float) -> FloatArray:
    """Nodes down a line, one of them at the layer boundary; empty for a line without length."""
    if not stop > start:
        return np.zeros(0)
    if not start < boundary < stop:
        return _graded_line(start, stop, first=first, grade=grade)
    upper = _graded_line(start, boundary, first=first, grade=grade)
    lower = _graded_line(boundary, stop, first=float(upper[-1] - upper[-3]), grade=grade)
    return np.concatenate([upper, lower[1:]])


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


class PartStiffness(Record, eq=False):
    """Stiffness of a part of a mesh."""

    matrix: csc_array  #: Symmetric, sparse.
    unknowns: IndexArray  #: Number of the unknown of each row, rising.

    @classmethod
    def of(
        cls, elements: IndexArray, stiffness: FloatArray, number: IndexArray, sign: FloatArray | None = None
    ) -> PartStiffness:
        """Assemble (e, k, k) stiffnesses of elements.

        `number` has the (n, c) unknowns of the nodes' displacements, -1 for none, and `sign` their signs.
        """
        unknown = number[elements].reshape(len(elements), -1)
        if sign is not None:
            signs = sign[elements].reshape(len(elements), -1)
            stiffness = stiffness * (signs[:, :, None] * signs[:, None, :])
        unknowns = np.unique(unknown[unknown >= 0])
        place = np.where(unknown >= 0, np.searchsorted(unknowns, unknown), -1)
        row, column = np.broadcast_arrays(place[:, :, None], place[:, None, :])
        free = (row >= 0) & (column >= 0)
        shape = 2 * (len(unknowns),)
        return cls(coo_array((stiffness[free], (row[free], column[free])), shape=shape).tocsc(), unknowns)

    def without(self, fixed: IndexArray) -> PartStiffness:
        """The stiffness with some unknowns fixed at 0."""
        free = ~np.isin(self.unknowns, fixed)
        return PartStiffness(self.matrix[free][:, free], self.unknowns[free])

    def hole_flexibility(self, rim: IndexArray, skin: IndexArray) -> tuple[FloatArray, FloatArray]:
        """(b, b) displacements of the lump's boundary and (s, b) of the skin, for unit forces on an empty boundary.

        `rim` and `skin` are unknowns; those that are not in the part are 0 and take no force.
        """
        boundary = np.searchsorted(self.unknowns, rim[np.isin(rim, self.unknowns)])
        force = np.zeros((len(self.unknowns), len(boundary)))
        force[boundary, np.arange(len(boundary))] = 1.0
        displacement = _solve(self.matrix, force)
        displacement[boundary] = 0.5 * (displacement[boundary] + displacement[boundary].T)
        sinking = np.zeros((len(skin), len(boundary)))
        moves = np.isin(skin, self.unknowns)
        sinking[moves] = displacement[np.searchsorted(self.unknowns, skin[moves])]
        return displacement[boundary], sinking

    def condensed_on(self, rim: IndexArray) -> FloatArray:
        """(b, b) stiffness of the lump condensed onto its boundary (Guyan 1965: exact in statics)."""
        boundary = np.searchsorted(self.unknowns, rim[np.isin(rim, self.unknowns)])
        inner = np.flatnonzero(~np.isin(self.unknowns, rim))
        coupling = self.matrix[inner][:, boundary].toarray()
        condensed = self.matrix[boundary][:, boundary].toarray()
        condensed -= coupling.T @ _solve(self.matrix[inner][:, inner], coupling)
        return np.asarray(0.5 * (condensed + condensed.T))


def _solve(matrix: csc_array, right: FloatArray) -> FloatArray:
    """Solution of a symmetric positive definite system for many right-hand sides, by one factorisation."""
    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(right))


class CondensedHole(Record, eq=False):
    r"""A body with a hole where the lump is, condensed onto the hole's boundary and the skin.

    With the flexibility F of the surroundings and the stiffness S of the filling, the boundary moves by
    :math:`(I + F S)^{-1} F f`. The difference of two fillings is one product, exact to rounding however small:

    .. math:: -F_s (I + S_1 F)^{-1} (S_1 - S_0) (I + F S_0)^{-1} F_s^T
    """

    flexibility: FloatArray  #: F, (b, b) array: Displacements on the empty boundary for unit forces there.
    skin: FloatArray  #: F_s, (s, b) array: Sinking of the skin for the same forces.
    unit_stiffness: FloatArray  #: (b, b) array: The lump, condensed on its boundary, for a modulus of 1 kPa.
    original_stiffness: FloatArray  #: S_0, (b, b) array: The tissue that the lump replaces.

    def change(self, lump_kpa: float) -> FloatArray:
        """(s, s) change of the skin's compliance when tissue is replaced by a lump of modulus `lump_kpa`; symmetric."""
        stiffness, identity = lump_kpa * self.unit_stiffness, np.eye(len(self.flexibility))
        before = np.linalg.solve(identity + self.flexibility @ self.original_stiffness, self.skin.T)
        difference = (stiffness - self.original_stiffness) @ before
        forces = np.linalg.solve(identity + stiffness @ self.flexibility, difference)
        change = self.skin @ forces
        return np.asarray(-0.5 * (change + change.T))
