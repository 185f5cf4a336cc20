"""Change of the skin's compliance by a spheroidal lump in a layered body: finite elements in Fourier modes.

The body is axisymmetric about the vertical axis through the lump, so a load of angular order m gives displacements of
order m: ``u_r, u_z ~ cos(m theta)`` and ``u_theta ~ sin(m theta)``, and each order is a two-dimensional problem. The
body around the lump is condensed once onto the lump's boundary and the skin; a lump of any stiffness is then a small
dense matrix on that boundary.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import FAT_KPA, GLAND_RATIO, POISSON
from tactile_bayes.forward.mesh import (
    EXTERIOR_GLAND,
    INTERIOR_FAT,
    INTERIOR_GLAND,
    IntArray,
    LumpGeometry,
    LumpMesh,
    MeshSize,
    lump_mesh,
)
from tactile_bayes.geometry import FloatArray

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline
    from scipy.sparse import csc_array

# Orders m are left out from where their share of the perturbation has fallen to this.
_LEAST_SHARE: Final = 1e-4


class Tissue(Record):
    """Moduli of the two layers, fat over gland, with one Poisson's ratio below 0.5 for both and the lump."""

    fat_kpa: float = FAT_KPA
    gland_ratio: float = GLAND_RATIO
    nu: float = POISSON

    def __post_init__(self) -> None:
        for name in ("fat_kpa", "gland_ratio"):
            if not getattr(self, name) > 0:
                raise BadDataError(f"{name} is {getattr(self, name)}", way_out="it must be above 0")
        if not 0 <= self.nu < 0.5:
            raise BadDataError(f"nu is {self.nu}", way_out="it must lie in 0 to below 0.5")


class ModePerturbation(Record, eq=False):
    """Perturbation of Fourier order m."""

    order: int
    """m."""
    matrix: FloatArray
    """(s, s) array: Symmetric: sinking in mm at skin node i for a unit force in kPa mm^2 at skin node j, per cos(m
    dtheta).
    """


class CondensedMode(Record, eq=False):
    """One Fourier order of the body around the lump, condensed onto the lump's boundary."""

    order: int
    """m."""
    flexibility: FloatArray
    """(b, b) array: Displacements on the boundary for unit forces there, with nothing inside; mm per kPa mm^2."""
    skin: FloatArray
    """(s, b) array: Sinking of the skin for the same forces."""
    unit_stiffness: FloatArray
    """(b, b) array: The lump, condensed on its boundary, for a modulus of 1 kPa."""
    original_stiffness: FloatArray
    """(b, b) array: The tissue that the lump replaces."""

    def perturbation(self, lump_kpa: float) -> ModePerturbation:
        r"""Change of the skin's compliance when tissue is replaced by a lump of modulus `lump_kpa`.

        Notes
        -----
        With the flexibility F of the surroundings and the stiffness S inside, the boundary moves by
        :math:`(I + F S)^{-1} F f`. The difference of two such answers is written as one product, so that it is exact
        to rounding however small it is, and vanishes for equal stiffness:

        .. math:: -F_s (I + S_1 F)^{-1} (S_1 - S_0) (I + F S_0)^{-1} F_s^T
        """
        inside = lump_kpa * self.unit_stiffness
        identity = np.eye(len(inside))
        before = np.linalg.solve(identity + self.flexibility @ self.original_stiffness, self.skin.T)
        forces = np.linalg.solve(identity + inside @ self.flexibility, (inside - self.original_stiffness) @ before)
        share = 1.0 / (2.0 * np.pi) if self.order == 0 else 1.0 / np.pi
        matrix = -share * (self.skin @ forces)
        return ModePerturbation(self.order, (matrix + matrix.T) / 2)


class CondensedLump(Record, eq=False):
    """All Fourier orders of one geometry; the perturbation for a stiffness takes milliseconds."""

    radius_mm: FloatArray
    """(s,) array: Skin nodes, by increasing distance from the lump's axis, the axis itself left out."""
    modes: tuple[CondensedMode, ...]
    """Orders 0, 1, ..."""

    def perturbation(self, lump_kpa: float) -> tuple[ModePerturbation, ...]:
        """Perturbations of all orders, for a lump of modulus `lump_kpa`."""
        if not lump_kpa > 0:
            raise BadDataError(f"the lump's modulus is {lump_kpa} kPa", way_out="it must be above 0")
        return tuple(mode.perturbation(lump_kpa) for mode in self.modes)


def condense_lump(
    geometry: LumpGeometry, tissue: Tissue, *, size: MeshSize | None = None, orders: int | None = None
) -> CondensedLump:
    """Condense the body around a lump onto the lump's boundary and the skin.

    Parameters
    ----------
    geometry, tissue
        Where the lump lies, in what.
    size
        Of the mesh; None for the default, which a test holds to 1 % in amplitude and 0.5 % in width.
    orders
        How many Fourier orders; None takes as many as the lump's depth asks for (see `orders_needed`).
    """
    mesh = lump_mesh(geometry, size)
    elements = element_stiffness(mesh, nu=tissue.nu)
    fat, gland = tissue.fat_kpa, tissue.fat_kpa * tissue.gland_ratio
    modulus = np.where((mesh.region == EXTERIOR_GLAND) | (mesh.region == INTERIOR_GLAND), gland, fat)
    count = orders_needed(geometry) if orders is None else orders
    modes = [_condense(mesh, elements, modulus, order) for order in range(count)]
    return CondensedLump(mesh.node_mm[_skin(mesh), 0], tuple(modes))


def orders_needed(geometry: LumpGeometry) -> int:
    r"""Fourier orders that carry all but 1e-4 of the perturbation.

    Notes
    -----
    A force at distance rho from the centre is felt by a sphere of radius a as multipoles falling as :math:`(a/\rho)^l`,
    and its order m starts at l = m with :math:`(\sin\varphi)^m`; a force on the skin has
    :math:`\sin\varphi = r/\rho`, so :math:`(a r/\rho^2)^{2m} \le (a/2h)^{2m}` for force and displacement together.
    """
    share = max(geometry.radius_mm, geometry.half_height_mm) / (2.0 * geometry.depth_mm)
    return 2 + int(np.ceil(np.log(_LEAST_SHARE) / (2.0 * np.log(min(share, 0.6)))))


def skin_spline(radius_mm: FloatArray, values: FloatArray, *, order: int) -> CubicSpline[np.float64]:
    r"""Spline of (s, c) values at the skin nodes through the axis: even in r for even orders, odd for odd ones."""
    parity = -1.0 if order % 2 else 1.0
    mirrored = np.concatenate([parity * values[::-1], values])
    return CubicSpline(np.concatenate([-radius_mm[::-1], radius_mm]), mirrored)


def element_stiffness(mesh: LumpMesh, *, nu: float) -> FloatArray:
    r"""Stiffness of every element for a modulus of 1 kPa, as a polynomial in the order m.

    Returns
    -------
    (3, e, 27, 27) array
        :math:`K = K_0 + m K_1 + m^2 K_2`, without the factor of the integral over the angle. Unknowns: (u_r, u_theta,
        u_z) of each of the nine nodes.

    Notes
    -----
    Biquadratic displacements with the volume change projected on linear functions of (r, z) in each element: the pair
    Q2-P1, which satisfies the inf-sup condition and so does not lock (Brezzi & Fortin 1991, sec. VI.3; Hughes 1980
    for the projection).
    """
    shape, gradient, point, weight = _quadrature(mesh)
    strain = _strains(shape, gradient, point[..., 0])
    shear, bulk = 0.5 / (1.0 + nu), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    measure = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0]) * shear
    scaled = strain * np.sqrt(measure[:, None] * weight[:, :, None, None])
    flat = scaled.reshape(2, len(weight), -1, 27)
    terms = _polynomial(flat)
    centre = point.mean(axis=1, keepdims=True)
    pressure = np.concatenate([np.ones_like(point[..., :1]), point - centre], axis=-1)
    mass = np.einsum("eq,eqa,eqb->eab", weight, pressure, pressure)
    volume = np.einsum("eq,eqa,meqk->meak", weight, pressure, strain[..., :3, :].sum(axis=-2))
    root = np.linalg.cholesky(np.linalg.inv(mass)).transpose(0, 2, 1)
    return np.asarray(terms + bulk * _polynomial(root @ volume))


def _polynomial(factor: FloatArray) -> FloatArray:
    """(3, e, k, k) coefficients of ``(A + m B)^T (A + m B)`` for the (2, e, n, k) factors A and B."""
    a, b = factor
    cross = a.transpose(0, 2, 1) @ b
    return np.stack([a.transpose(0, 2, 1) @ a, cross + cross.transpose(0, 2, 1), b.transpose(0, 2, 1) @ b])


def _quadrature(mesh: LumpMesh) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Shape functions (9 points, 9 nodes), gradients (e, 9, 9, 2), points (e, 9, 2) and r dr dz weights (e, 9)."""
    shape, local, cell = lagrange_points()
    node = mesh.node_mm[mesh.element]
    jacobian = np.einsum("qnk,enx->eqxk", local, node)
    point = np.einsum("qn,enx->eqx", shape, node)
    gradient = np.einsum("qnk,eqkx->eqnx", local, np.linalg.inv(jacobian))
    weight = np.abs(np.linalg.det(jacobian)) * cell * point[..., 0]
    return shape, gradient, point, weight


def lagrange_points() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Biquadratic shape functions (9 points, 9 nodes), local gradients (9, 9, 2) and weights (9,) at Gauss points."""
    x, w = np.polynomial.legendre.leggauss(3)
    value = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], axis=-1)
    slope = np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1)
    shape = np.einsum("ai,bj->abij", value, value).reshape(9, 9)
    across, along = np.einsum("ai,bj->abij", slope, value), np.einsum("ai,bj->abij", value, slope)
    slopes = np.stack([across, along], axis=-1).reshape(9, 9, 2)
    return shape, slopes, np.outer(w, w).ravel()


def _strains(shape: FloatArray, gradient: FloatArray, r_mm: FloatArray) -> FloatArray:
    """(2, e, 9, 6, 27) strains (rr, tt, zz, rz, rt, zt) of unit unknowns: the part without m, and the factor of m."""
    strain = np.zeros((2, *r_mm.shape, 6, 9, 3))
    plain, order = strain
    over_r = shape / r_mm[..., None]
    plain[..., 0, :, 0] = gradient[..., 0]
    plain[..., 1, :, 0] = over_r
    order[..., 1, :, 1] = over_r
    plain[..., 2, :, 2] = gradient[..., 1]
    plain[..., 3, :, 0] = gradient[..., 1]
    plain[..., 3, :, 2] = gradient[..., 0]
    order[..., 4, :, 0] = -over_r
    plain[..., 4, :, 1] = gradient[..., 0] - over_r
    plain[..., 5, :, 1] = gradient[..., 1]
    order[..., 5, :, 2] = -over_r
    return strain.reshape(2, *r_mm.shape, 6, 27)


def _skin(mesh: LumpMesh) -> IntArray:
    """Nodes of the skin off the axis and off the outer rim.

    On the axis the ring that a node stands for has no length, and the displacement there is off by several per cent
    where its neighbours' are off by a few in a thousand: symmetry gives the axis better.
    """
    return mesh.surface[1:-1]


def order_unknowns(mesh: LumpMesh, order: int) -> tuple[IntArray, FloatArray]:
    """Index (-1: fixed) and sign of the reduced unknown for each of the (n, 3) displacements of one order.

    The base and the far rim do not move. On the axis, displacements must be single-valued: order 0 keeps u_z, order 1
    a sideways motion with u_theta = -u_r, higher orders nothing. Order 0 has no torsion.
    """
    r, z = mesh.node_mm.T
    free = np.ones((len(r), 3), dtype=bool)
    free[(z == z.max()) | (r == r.max())] = False
    axis = r == 0
    if order == 0:
        free[:, 1] = False
        free[axis, 0] = False
    elif order == 1:
        free[axis, 2] = False
    else:
        free[axis] = False
    sign = np.ones((len(r), 3))
    tied = axis & free[:, 0] if order == 1 else np.zeros(len(r), dtype=bool)
    free[tied, 1] = False
    number = np.full((len(r), 3), -1, dtype=np.int64)
    number[free] = np.arange(np.count_nonzero(free))
    number[tied, 1], sign[tied, 1] = number[tied, 0], -1.0
    return number, sign


def _condense(mesh: LumpMesh, elements: FloatArray, modulus_kpa: FloatArray, order: int) -> CondensedMode:
    number, sign = order_unknowns(mesh, order)
    inside = mesh.region >= INTERIOR_FAT
    stiffness = elements[0] + order * elements[1] + order**2 * elements[2]
    boundary = np.unique(number[mesh.arc])
    boundary = boundary[boundary >= 0]

    outer, used = _assemble(mesh, stiffness, modulus_kpa, ~inside, number, sign)
    factor = splu(outer, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    at = np.searchsorted(used, boundary)
    unit = np.zeros((len(used), len(at)))
    unit[at, np.arange(len(at))] = 1.0
    moved = factor.solve(unit)
    sinking = number[_skin(mesh), 2]
    skin = moved[np.searchsorted(used, sinking)]
    flexibility = moved[at]

    unit_kpa = np.ones_like(modulus_kpa)
    lump = _condensed_core(mesh, stiffness, unit_kpa, inside, number, sign, boundary)
    within = modulus_kpa[inside]
    if (within == within[0]).all():
        original = within[0] * lump
    else:
        original = _condensed_core(mesh, stiffness, modulus_kpa, inside, number, sign, boundary)
    return CondensedMode(order, (flexibility + flexibility.T) / 2, skin, lump, original)


def _assemble(
    mesh: LumpMesh,
    stiffness: FloatArray,
    modulus_kpa: FloatArray,
    chosen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    number: IntArray,
    sign: FloatArray,
) -> tuple[csc_array, IntArray]:
    """Sparse stiffness of the chosen elements, and the indices of its unknowns."""
    element = mesh.element[chosen]
    unknown = number[element].reshape(len(element), 27)
    signs = sign[element].reshape(len(element), 27)
    data = stiffness[chosen] * (modulus_kpa[chosen, None, None] * signs[:, :, None] * signs[:, None, :])
    row, column = np.broadcast_arrays(unknown[:, :, None], unknown[:, None, :])
    kept = (row >= 0) & (column >= 0)
    used = np.unique(unknown[unknown >= 0])
    place = np.searchsorted(used, np.stack([row[kept], column[kept]]))
    matrix = coo_array((data[kept], (place[0], place[1])), shape=(len(used), len(used)))
    return matrix.tocsc(), used


def _condensed_core(
    mesh: LumpMesh,
    stiffness: FloatArray,
    modulus_kpa: FloatArray,
    inside: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    number: IntArray,
    sign: FloatArray,
    boundary: IntArray,
) -> FloatArray:
    """Stiffness of the lump's inside, condensed onto its boundary (Guyan 1965: exact in statics)."""
    matrix, used = _assemble(mesh, stiffness, modulus_kpa, inside, number, sign)
    dense = matrix.toarray()
    on = np.isin(used, boundary)
    across = dense[np.ix_(~on, on)]
    condensed = dense[np.ix_(on, on)] - across.T @ np.linalg.solve(dense[np.ix_(~on, ~on)], across)
    return np.asarray((condensed + condensed.T) / 2)
