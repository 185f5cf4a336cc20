"""Sinking of a layered body's skin under normal loads: its exact Green's function, and means over taxels.

The body is a stack of elastic layers, bonded to each other, on a rigid base to which the lowest is bonded, or with a
half-space as its lowest layer. z runs into the body; a displacement is positive downwards, a pressure into the skin.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import j0

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import POISSON
from tactile_bayes.geometry import FloatArray

# Beyond this wave number times the top layer's thickness the layers below have no effect: exp(-2 x 18) = 2e-16.
_DEEPEST: Final = 18.0
# Gauss points per panel, and panels per decade of wave numbers; the remainder is smooth on a logarithmic scale.
_POINTS: Final = 24
# Below this thickness in wave lengths the layer matrices lose digits, and the integrand is as good as constant.
_LEAST: Final = 1e-3


class LayeredBody(Record):
    """Flat isotropic layers from the skin down."""

    modulus_kpa: tuple[float, ...]
    """Young's modulus of each layer."""
    thickness_mm: tuple[float, ...]
    """Of each layer on a rigid base; one entry fewer than `modulus_kpa` when the last is a half-space."""
    nu: float = POISSON
    """Poisson's ratio of all, above -1 and up to 0.5 (incompressible)."""

    def __post_init__(self) -> None:
        if len(self.modulus_kpa) - len(self.thickness_mm) not in (0, 1) or not self.modulus_kpa:
            raise BadDataError(
                f"{len(self.modulus_kpa)} moduli for {len(self.thickness_mm)} thicknesses",
                way_out="give as many (rigid base), or one modulus more (half-space)",
            )
        for name in ("modulus_kpa", "thickness_mm"):
            for i, value in enumerate(getattr(self, name)):
                if not (value > 0 and np.isfinite(value)):
                    raise BadDataError(f"{name}[{i}] is {value}", way_out="it must be above 0")
        if not -1 < self.nu <= 0.5:
            raise BadDataError(f"nu is {self.nu}", way_out="it must lie above -1 and at most 0.5")

    @property
    def on_rigid_base(self) -> bool:
        """Whether the lowest layer is bonded to a rigid base rather than being a half-space."""
        return len(self.modulus_kpa) == len(self.thickness_mm)


def surface_flexibility(wave_number: FloatArray, body: LayeredBody) -> FloatArray:
    r"""Sinking of the skin under a pressure that varies as J0(k r), in mm per kPa.

    Parameters
    ----------
    wave_number : (n,) array
        k in 1/mm, above 0.

    Returns
    -------
    (n,) array
        :math:`2(1-\nu^2)/(E k)` for a half-space.
    """
    return np.asarray(skin_flexibility(wave_number, body)[:, 1, 1], dtype=np.float64)


def skin_flexibility(wave_number: FloatArray, body: LayeredBody) -> FloatArray:
    r"""Displacements of the skin under shear and pressure of one wave number, in mm per kPa.

    Parameters
    ----------
    wave_number : (n,) array
        k in 1/mm, above 0.

    Returns
    -------
    (n, 2, 2) array
        From the factors of a radial shear traction :math:`J_1(kr)` and a pressure :math:`J_0(kr)` to those of the
        radial displacement and the sinking. Entry (1, 0), sinking under shear, is :math:`-(1-2\nu)(1+\nu)/(E k)` for a
        half-space.

    Notes
    -----
    For one k the fields are :math:`u_r = U(z) J_1(kr)`, :math:`u_z = W(z) J_0(kr)`, which obey the equations of plane
    strain with a wave of number k. Each layer is replaced by its exact stiffness between the displacements of its two
    faces (the static limit of Kausel & Roesset 1981), and the stiffness felt at a face is carried upwards. All
    exponentials decay, so no k overflows, and nothing is singular at nu = 0.5.
    """
    k = np.asarray(wave_number, dtype=np.float64)
    below: FloatArray | None = None
    layers = list(zip(body.modulus_kpa, body.thickness_mm, strict=False))
    if not body.on_rigid_base:
        below = _half_space_stiffness(k, body.modulus_kpa[-1], body.nu)
    for modulus, thickness in reversed(layers):
        stiffness = _layer_stiffness(k, modulus, thickness, body.nu)
        upper, across = stiffness[:, :2, :2], stiffness[:, :2, 2:]
        if below is None:
            below = np.asarray(upper, dtype=np.float64)
        else:
            lower = stiffness[:, 2:, 2:] + below
            below = np.asarray(upper - across @ np.linalg.solve(lower, stiffness[:, 2:, :2]), dtype=np.float64)
    assert below is not None
    return np.asarray(np.linalg.inv(below), dtype=np.float64)


def _waves(depth: FloatArray, nu: float) -> tuple[FloatArray, FloatArray]:
    """Displacements (U, W) and tractions (tau, sigma) / (2 mu k) of the two waves that decay with `depth` = k z.

    Returns two (n, 2, 2) arrays: component by wave. The first wave is a harmonic gradient, the second its
    Papkovich-Neuber partner (Johnson 1985, ch. 2 and 3: the half-space under a normal load is a sum of both).
    """
    decay = np.exp(-depth)
    one, kappa = np.ones_like(depth), 3.0 - 4.0 * nu
    displacement = np.array([[one, depth], [one, depth + kappa]]) * decay
    traction = -np.array([[one, depth + (1.0 - 2.0 * nu)], [one, depth + 2.0 * (1.0 - nu)]]) * decay
    return np.moveaxis(displacement, -1, 0), np.moveaxis(traction, -1, 0)


def _half_space_stiffness(k: FloatArray, modulus_kpa: float, nu: float) -> FloatArray:
    """(n, 2, 2) tractions on the face of a half-space for unit displacements of it."""
    displacement, traction = _waves(np.zeros_like(k), nu)
    scale = (modulus_kpa / (1.0 + nu)) * k
    stiffness: FloatArray = -scale[:, None, None] * traction @ np.linalg.inv(displacement)
    return stiffness


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


def layering_compliance(r_mm: FloatArray, body: LayeredBody) -> FloatArray:
    r"""Sinking at distances r from a unit normal force, less that of a half-space of the top layer, in mm / (kPa mm^2).

    Parameters
    ----------
    r_mm : (n,) array
        Not negative. The result is smooth through r = 0.

    Notes
    -----
    .. math:: \frac{1}{2\pi}\int_0^\infty \left[F(k) - \frac{2(1-\nu^2)}{E_1 k}\right] J_0(kr)\, k\, dk

    by Gauss-Legendre panels. The bracket decays as :math:`\exp(-2kH)` with the top layer's thickness H, so what is
    singular at r = 0 is left to the closed forms for the half-space.
    """
    r = np.asarray(r_mm, dtype=np.float64)
    if not body.thickness_mm:
        return np.zeros_like(r)
    k, weight = _wave_numbers(body, reach_mm=float(r.max(initial=0.0)))
    # Lower wave numbers than the layer matrices can stand take the limit: F is constant over a rigid base, F k is over
    # a half-space.
    safe = np.maximum(k, _LEAST / sum(body.thickness_mm))
    top = 2.0 * (1.0 - body.nu**2) / body.modulus_kpa[0]
    bracket = surface_flexibility(safe, body) * (k if body.on_rigid_base else safe) - top
    return np.asarray(j0(np.multiply.outer(r, k)) @ (weight * bracket) / (2.0 * np.pi))


def _wave_numbers(body: LayeredBody, *, reach_mm: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre points and weights over wave numbers, fine enough for J0 at `reach_mm`."""
    top = _DEEPEST / body.thickness_mm[0]
    slowest = 0.05 / sum(body.thickness_mm)
    edges = np.concatenate([[0.0], np.geomspace(slowest, top, 1 + int(np.ceil(4 * np.log10(top / slowest))))])
    most = 10.0 / max(reach_mm, 1.0)  # rad of J0 in a panel: ten, for 24 points
    parts = [np.linspace(a, b, 1 + int(np.ceil((b - a) / most)))[:-1] for a, b in pairwise(edges)]
    edges = np.concatenate([*parts, edges[-1:]])
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    half = np.diff(edges)[:, None] / 2
    k = (edges[:-1, None] + half * (1.0 + node)).ravel()
    return k, (half * weight).ravel()


def square_compliance(
    dx_mm: FloatArray, dy_mm: FloatArray, *, side_mm: float, modulus_kpa: float, nu: float
) -> FloatArray:
    r"""Sinking of a half-space at (dx, dy) from the centre of a square under unit pressure, in mm / kPa.

    Notes
    -----
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


def taxel_compliance(body: LayeredBody, *, rows: int, columns: int, pitch_mm: float) -> FloatArray:
    """Mean sinking of every taxel under unit pressure on every other, in mm / kPa.

    Returns
    -------
    (rows * columns, rows * columns) array
        Symmetric positive definite; taxels in row-major order. Both the load and the displacement are averaged over
        the square of a taxel (Galerkin), the self term included.
    """
    node, weight = np.polynomial.legendre.leggauss(6)
    shift = node * pitch_mm / 2
    dx: FloatArray = np.arange(rows, dtype=np.float64) * pitch_mm
    dy: FloatArray = np.arange(columns, dtype=np.float64) * pitch_mm
    x = dx[:, None, None, None] + shift[:, None]
    y = dy[None, :, None, None] + shift[None, :]
    share = np.multiply.outer(weight, weight) / 4
    half_space = square_compliance(x, y, side_mm=pitch_mm, modulus_kpa=body.modulus_kpa[0], nu=body.nu)
    by_offset = np.einsum("rcij,ij->rc", half_space, share)
    r = np.linspace(0.0, np.hypot(dx[-1] + 2 * pitch_mm, dy[-1] + 2 * pitch_mm), 400)
    smooth = CubicSpline(r, layering_compliance(r, body), bc_type=("clamped", "not-a-knot"))
    by_offset += pitch_mm**2 * _mean_over_two_squares(smooth, dx, dy, pitch_mm)
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.asarray(
        by_offset[np.abs(row[:, None] - row[None, :]), np.abs(column[:, None] - column[None, :])], dtype=np.float64
    )


def _mean_over_two_squares(
    function: Callable[[FloatArray], FloatArray], dx: FloatArray, dy: FloatArray, side: float
) -> FloatArray:
    """(rows, columns) mean of a smooth function of distance over a load square and a displacement square.

    The difference of two points of a square has a triangular density along each axis; three Gauss points are exact
    for its first five moments.
    """
    # Gauss rule of the density 1 - |s| on (-1, 1): nodes 0 and +-sqrt(2/5), from its moments 1, 1/6 and 1/15.
    node = side * np.sqrt(0.4) * np.array([-1.0, 0.0, 1.0])
    weight = np.array([5.0, 14.0, 5.0]) / 24.0
    x = dx[:, None, None, None] + node[:, None]
    y = dy[None, :, None, None] + node[None, :]
    return np.asarray(np.einsum("rcij,i,j->rc", function(np.hypot(x, y)), weight, weight))
