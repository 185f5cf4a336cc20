"""Compliance of a layered body's skin: its exact Green's function, and its change by a lump on a vertical axis."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import j0

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.mesh import (
    CondensedHole,
    LumpGeometry,
    Mesh,
    MeshSize,
    PartStiffness,
    lagrange_points,
    lump_mesh,
    quadrature,
    stiffness_factor,
)
from tactile_bayes.forward.tissue import Layers
from tactile_bayes.geometry import FloatArray, IndexArray

# --- Sinking of a layered body's skin under normal loads: its exact Green's function, and means over taxels.
#
# The layers are bonded to each other and to the rigid base. z runs into the body; a displacement is positive downwards,
# a pressure into the skin.

# Largest wave number times the top layer's thickness: beyond it layers below have no effect, exp(-2 x 18) = 2e-16.
_LARGEST: Final = 18.0
_POINTS: Final = 24  #: Gauss points per panel.
# Least wave number times thickness: below it the layer matrices lose digits, and the integrand is as good as constant.
_LEAST: Final = 1e-3


def skin_flexibility(wave_number: FloatArray, layers: Layers) -> FloatArray:
    r"""Displacements of the skin under shear and pressure of one wave number k (1/mm, above 0), in mm per kPa.

    The (n, 2, 2) array takes the factors of a radial shear traction :math:`J_1(kr)` and a pressure :math:`J_0(kr)` to
    those of the radial displacement and the sinking. For a half-space entry (1, 1), sinking under pressure, is
    :math:`2(1-\nu^2)/(E k)`, and entry (1, 0), sinking under shear, :math:`-(1-2\nu)(1+\nu)/(E k)`.

    The fields :math:`u_r = U(z) J_1(kr)`, :math:`u_z = W(z) J_0(kr)` obey the equations of plane strain. Each layer is
    its exact stiffness between its two faces (the static limit of Kausel & Roesset 1981), condensed upwards. All
    exponentials decay, so no k overflows, and nothing is singular at nu = 0.5.
    """
    k, fat_mm = np.asarray(wave_number, dtype=np.float64), layers.fat_mm
    gland_kpa, gland_mm = layers.fat_kpa * layers.gland_ratio, layers.thickness_mm - fat_mm
    gland = _layer_stiffness(k, gland_kpa, gland_mm, layers.poisson)[:, :2, :2]  # its lower face does not move
    fat = _layer_stiffness(k, layers.fat_kpa, fat_mm, layers.poisson)
    coupling, lower = fat[:, :2, 2:], fat[:, 2:, 2:] + gland
    skin_stiffness = fat[:, :2, :2] - coupling @ np.linalg.solve(lower, fat[:, 2:, :2])
    return np.asarray(np.linalg.inv(skin_stiffness), dtype=np.float64)


def _waves(depth: FloatArray, nu: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2, 2) displacements (U, W) and tractions (tau, sigma) / (2 mu k), by wave, of the two that decay with k z.

    The first is a harmonic gradient, the second its Papkovich-Neuber partner (Johnson 1985, ch. 2 and 3).
    """
    decay = np.exp(-depth)
    one, kappa = np.ones_like(depth), 3.0 - 4.0 * nu
    displacement = np.array([[one, depth], [one, depth + kappa]]) * decay
    traction = -np.array([[one, depth + (1.0 - 2.0 * nu)], [one, depth + 2.0 * (1.0 - nu)]]) * decay
    return np.moveaxis(displacement, -1, 0), np.moveaxis(traction, -1, 0)


def _layer_stiffness(k: FloatArray, modulus_kpa: float, thickness_mm: float, nu: float) -> FloatArray:
    """(n, 4, 4) outward tractions on both faces of a layer for displacements (U, W) of the upper, then the lower."""
    near_u, near_t = _waves(np.zeros_like(k), nu)
    far_u, far_t = _waves(k * thickness_mm, nu)
    mirror_u, mirror_t = np.array([[1.0], [-1.0]]), np.array([[-1.0], [1.0]])  # waves that decay upwards
    displacement = np.block([[near_u, mirror_u * far_u], [far_u, mirror_u * near_u]])
    traction = np.block([[-near_t, -mirror_t * far_t], [far_t, mirror_t * near_t]])
    scale = (modulus_kpa / (1.0 + nu)) * k
    # K = T D^-1, by solving with the transposes
    stiffness = np.linalg.solve(displacement.transpose(0, 2, 1), traction.transpose(0, 2, 1)).transpose(0, 2, 1)
    return np.asarray(scale[:, None, None] * stiffness)


def layering_compliance(r_mm: FloatArray, layers: Layers) -> FloatArray:
    r"""Sinking at distances r from a unit normal force, less that of a half-space of the top layer, in mm / (kPa mm^2).

    .. math:: \frac{1}{2\pi}\int_0^\infty \left[F(k) - \frac{2(1-\nu^2)}{E_1 k}\right] J_0(kr)\, k\, dk

    by Gauss-Legendre panels. The bracket decays as :math:`\exp(-2kH)` with the top layer's thickness H: the difference
    is smooth through r = 0.
    """
    r = np.asarray(r_mm, dtype=np.float64)
    k, weight = _wave_numbers(layers, reach_mm=float(r.max(initial=0.0)))
    # below the least wave number of the layer matrices F is as good as constant
    safe = np.maximum(k, _LEAST / layers.thickness_mm)
    top = 2.0 * (1.0 - layers.poisson**2) / layers.fat_kpa
    bracket = skin_flexibility(safe, layers)[:, 1, 1] * k - top
    return np.asarray(j0(np.multiply.outer(r, k)) @ (weight * bracket) / (2.0 * np.pi))


def _wave_numbers(layers: Layers, *, reach_mm: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre points and weights over wave numbers, fine enough for J0 at `reach_mm`."""
    largest, least = _LARGEST / layers.fat_mm, 0.05 / layers.thickness_mm
    panels = int(np.ceil(4 * np.log10(largest / least)))  # four per decade
    edges = np.concatenate([[0.0], np.geomspace(least, largest, 1 + panels)])
    widest = 10.0 / max(reach_mm, 1.0)  # ten rad of J0, for 24 points
    parts = [np.linspace(a, b, 1 + int(np.ceil((b - a) / widest)))[:-1] for a, b in pairwise(edges)]
    edges = np.concatenate([*parts, edges[-1:]])
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    half = np.diff(edges)[:, None] / 2
    k = (edges[:-1, None] + half * (1.0 + node)).ravel()
    return k, (half * weight).ravel()


def square_compliance(
    dx_mm: FloatArray, dy_mm: FloatArray, *, side_mm: float, modulus_kpa: float, nu: float
) -> FloatArray:
    r"""Sinking of a half-space at (dx, dy) from the centre of a square under unit pressure, in mm / kPa.

    .. math:: \frac{1-\nu^2}{\pi E} \sum_{\pm\pm} \pm\left[x \sinh^{-1}\frac{y}{|x|} + y \sinh^{-1}\frac{x}{|y|}\right]

    over the corners (Love 1929; Johnson 1985, eq. 3.25).
    """
    total = np.zeros(np.broadcast_shapes(np.shape(dx_mm), np.shape(dy_mm)))
    for sign_x in (1, -1):
        for sign_y in (1, -1):
            x, y = dx_mm + sign_x * side_mm / 2, dy_mm + sign_y * side_mm / 2
            total += sign_x * sign_y * (_corner(x, y) + _corner(y, x))
    return total * (1.0 - nu**2) / (np.pi * modulus_kpa)


def _corner(x: FloatArray, y: FloatArray) -> FloatArray:
    """x asinh(y / |x|), with its limit 0 at x = 0."""
    size = np.abs(x)
    safe = np.where(size > 0, size, 1.0)
    return np.asarray(np.where(size > 0, x * np.arcsinh(y / safe), 0.0))


def taxel_compliance(layers: Layers, *, rows: int, columns: int, pitch_mm: float) -> FloatArray:
    """Mean sinking of every taxel under unit pressure on every other, in mm / kPa, symmetric and positive definite.

    Taxels are in row-major order; load and displacement are averaged over the square of a taxel (Galerkin).
    """
    node, weight = np.polynomial.legendre.leggauss(6)
    shift = node * pitch_mm / 2
    dx: FloatArray = np.arange(rows, dtype=np.float64) * pitch_mm
    dy: FloatArray = np.arange(columns, dtype=np.float64) * pitch_mm
    x = dx[:, None, None, None] + shift[:, None]
    y = dy[None, :, None, None] + shift[None, :]
    share = np.multiply.outer(weight, weight) / 4
    half_space = square_compliance(x, y, side_mm=pitch_mm, modulus_kpa=layers.fat_kpa, nu=layers.poisson)
    by_offset = np.einsum("rcij,ij->rc", half_space, share)
    r = np.linspace(0.0, np.hypot(dx[-1] + 2 * pitch_mm, dy[-1] + 2 * pitch_mm), 400)
    smooth = CubicSpline(r, layering_compliance(r, layers), bc_type=("clamped", "not-a-knot"))
    # The difference of two points of a square has a triangular density along each axis; the three Gauss points of
    # 1 - |s| on (-1, 1) are 0 and +-sqrt(2/5), from its moments 1, 1/6 and 1/15, and exact for its first five.
    offset, weight = pitch_mm * np.sqrt(0.4) * np.array([-1.0, 0.0, 1.0]), np.array([5.0, 14.0, 5.0]) / 24.0
    layering = smooth(np.hypot(dx[:, None, None, None] + offset[:, None], dy[None, :, None, None] + offset[None, :]))
    by_offset += pitch_mm**2 * np.einsum("rcij,i,j->rc", layering, weight, weight)
    places = np.divmod(np.arange(rows * columns), columns)
    rows_apart, columns_apart = (np.abs(np.subtract.outer(one, one)) for one in places)
    return np.asarray(by_offset[rows_apart, columns_apart], dtype=np.float64)


# --- Change of the skin's compliance by a spheroidal lump in a layered body: finite elements in Fourier modes.
#
# The body is axisymmetric about the vertical axis through the lump, so a load of angular order m gives
# displacements of order m: ``u_r, u_z ~ cos(m theta)`` and ``u_theta ~ sin(m theta)``, and each order is a
# two-dimensional problem. The body around the lump is condensed once onto the lump's boundary and the skin; a lump
# of any stiffness is then a small dense matrix on that boundary.

_LEAST_SHARE: Final = 1e-4  #: Least share of the perturbation for an order m that counts.


class CondensedLump(Record, eq=False):
    """Fourier orders of one geometry, condensed; the perturbation for a stiffness takes milliseconds."""

    radius_mm: FloatArray  #: (s,) array: Distances of the skin nodes from the lump's axis, rising, without the axis.
    modes: tuple[CondensedHole, ...]  #: Orders 0, 1, ...: forces in kPa mm^2, displacements in mm.

    def perturbation(self, lump_kpa: float) -> list[FloatArray]:
        """(s, s) perturbation of each order m for a lump of modulus `lump_kpa`, symmetric.

        Sinking in mm at skin node i for a unit force in kPa mm^2 at skin node j, per cos(m dtheta).
        """
        if not lump_kpa > 0:
            raise BadDataError(f"the lump's modulus is {lump_kpa} kPa", way_out="it must be above 0")
        return [(0.5 if m == 0 else 1.0) / np.pi * mode.change(lump_kpa) for m, mode in enumerate(self.modes)]


def condense_lump(geometry: LumpGeometry, *, size: MeshSize | None = None, orders: int | None = None) -> CondensedLump:
    """Body around a lump, condensed onto the lump's boundary and the skin; by default in `orders_needed` orders.

    A test checks the default mesh to 1 % in amplitude and 0.5 % in width.
    """
    mesh, layers = lump_mesh(geometry, size), geometry.layers
    stiffness = element_stiffness(mesh, nu=layers.poisson)
    modulus = np.where(mesh.gland, layers.fat_kpa * layers.gland_ratio, layers.fat_kpa)
    lump = mesh.lump
    one_tissue = (modulus[lump] == modulus[lump][0]).all()
    # without the rim, which does not move, and the axis, where a node's ring has no length and its displacement errs by
    # several per cent, its neighbours' by a few in a thousand
    skin = mesh.skin[1:-1]
    modes = []
    for order in range(orders_needed(geometry) if orders is None else orders):
        k = stiffness[0] + order * stiffness[1] + order**2 * stiffness[2]
        number, sign = order_unknowns(mesh, order)
        rim, scaled = np.unique(number[mesh.rim]), k * modulus[:, None, None]
        outside = PartStiffness.of(mesh.elements[~lump], scaled[~lump], number, sign)
        flexibility, sinking = outside.hole_flexibility(rim, number[skin, 2])
        unit = PartStiffness.of(mesh.elements[lump], k[lump], number, sign).condensed_on(rim)
        original = modulus[lump][0] * unit
        if not one_tissue:
            original = PartStiffness.of(mesh.elements[lump], scaled[lump], number, sign).condensed_on(rim)
        modes.append(CondensedHole(flexibility, sinking, unit, original))
    return CondensedLump(mesh.nodes[skin, 0], tuple(modes))


def orders_needed(geometry: LumpGeometry) -> int:
    r"""Number of Fourier orders with all but 1e-4 of the perturbation.

    A force at distance rho acts on a sphere of radius a by multipoles that fall as :math:`(a/\rho)^l`, its order m from
    l = m on as :math:`(\sin\varphi)^m = (r/\rho)^m`: for force and displacement together as
    :math:`(a r/\rho^2)^{2m} \le (a/2h)^{2m}`.
    """
    share = max(geometry.radius_mm, geometry.half_height_mm) / (2.0 * geometry.depth_mm)
    return 2 + int(np.ceil(np.log(_LEAST_SHARE) / (2.0 * np.log(min(share, 0.6)))))


def skin_spline(radius_mm: FloatArray, values: FloatArray, *, order: int) -> CubicSpline[np.float64]:
    r"""Spline of (s, c) values at the skin nodes through the axis: even in r for even orders, odd for odd ones."""
    parity = -1.0 if order % 2 else 1.0
    mirrored = np.concatenate([parity * values[::-1], values])
    return CubicSpline(np.concatenate([-radius_mm[::-1], radius_mm]), mirrored)


def element_stiffness(mesh: Mesh, *, nu: float) -> FloatArray:
    """(3, e, 27, 27) stiffness of every element for 1 kPa, :math:`K = K_0 + m K_1 + m^2 K_2` in the order m.

    Without the factor of the integral over the angle; unknowns are (u_r, u_theta, u_z) of each of the nine nodes.
    """
    gradient, point, area = quadrature(mesh.nodes[mesh.elements])
    r = point[..., 0]
    strain = np.zeros((2, *r.shape, 6, 9, 3))  # rr, tt, zz, rz, rt, zt: the part without m, and the factor of m
    plain, order = strain
    over_r = lagrange_points()[0] / r[..., None]
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
    # K = (A + m B)^T (A + m B)
    a, b = stiffness_factor(strain.reshape(2, *r.shape, 6, 27), point, area * r, normal=3, poisson=nu)
    cross = a.transpose(0, 2, 1) @ b
    return np.stack([a.transpose(0, 2, 1) @ a, cross + cross.transpose(0, 2, 1), b.transpose(0, 2, 1) @ b])


def order_unknowns(mesh: Mesh, order: int) -> tuple[IndexArray, FloatArray]:
    """Index (-1: fixed) and sign of the unknown for each of the (n, 3) displacements of one order.

    The base and the far rim do not move. On the axis, displacements must be single-valued: order 0 keeps u_z, order 1
    a sideways motion with u_theta = -u_r, higher orders nothing. Order 0 has no torsion.
    """
    axis, end, base = mesh.edges
    free = np.repeat(~(base | end)[:, None], 3, axis=1)
    if order == 0:
        free[:, 1] = False
        free[axis, 0] = False
    elif order == 1:
        free[axis, 2] = False
    else:
        free[axis] = False
    tied = axis & free[:, 0] if order == 1 else np.zeros_like(axis)
    free[tied, 1] = False
    number, sign = np.full(free.shape, -1), np.ones(free.shape)
    number[free] = np.arange(np.count_nonzero(free))
    number[tied, 1], sign[tied, 1] = number[tied, 0], -1.0
    return number, sign
