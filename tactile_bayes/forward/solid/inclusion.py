r"""Stiffness of a hull with a lump of any star-shaped form inside, condensed onto the hull in coupled Fourier orders.

The hull is the spheroid of an axisymmetric mesh; the body outside is condensed order by order in `axisymmetric`.
Inside, nodes lie on rays from the centre: rings of elements fill the lump and the shell between lump and hull. The
nodes move with the angle theta, so that element edges follow the lump's boundary in every half-plane; displacements are
biquadratic there and a Fourier series in theta at fixed mesh coordinates, whose orders the moving mesh couples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.forward.solid.axisymmetric import Tissue, lagrange_points, order_unknowns
from tactile_bayes.forward.solid.mesh import IntArray, LumpMesh
from tactile_bayes.geometry import FloatArray

Radius = Callable[[FloatArray], FloatArray]
# Step of the central difference of nodes by the angle, rad: errors of 1e-8 of the radius.
_STEP_RAD: Final = 1e-4
# A node of the hull is on the layers' boundary within this.
_ON_BOUNDARY_MM: Final = 1e-6
# Elements follow the boundary of the layers where it cuts the lump nearer to its centre than this share of its half
# height; beyond it the wedge between boundary and lump would be too thin.
_MOST_CUT: Final = 0.93
_HALVINGS: Final = 50
# Quadrature points in theta beyond twice the highest order, for the moving mesh.
_SPARE_ANGLES: Final = 10


@dataclass(frozen=True, slots=True)
class Harmonic:
    r"""One angular form of the displacements.

    Even: :math:`u_r, u_z \sim \cos m\theta, u_\theta \sim \sin m\theta`; odd: sin, sin and -cos, the even form turned
    by a quarter of a period, so that both have the same axisymmetric stiffness.
    """

    order: int
    odd: bool = False

    @property
    def twist(self) -> bool:
        """Whether this is the twist about the vertical, u_theta alone."""
        return self.odd and self.order == 0

    @property
    def measure(self) -> float:
        """Integral of the squared form over the circle."""
        return 2.0 * np.pi if self.order == 0 else np.pi

    def values(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(t, 3) values for (u_r, u_theta, u_z), and their derivatives."""
        m = self.order
        c, s = np.cos(m * theta), np.sin(m * theta)
        if self.odd:
            return np.stack([s, -c, s], axis=-1), m * np.stack([c, s, c], axis=-1)
        return np.stack([c, s, c], axis=-1), m * np.stack([-s, c, -s], axis=-1)


def families(orders: int, *, symmetric: bool) -> tuple[tuple[Harmonic, ...], ...]:
    """All forms below an order, in groups that do not act on each other.

    A plane of symmetry keeps the even forms from the odd ones. The odd form of order 0 is a twist about the vertical.
    """
    even = tuple(Harmonic(m) for m in range(orders))
    odd = tuple(Harmonic(m, odd=True) for m in range(orders))
    return (even, odd) if symmetric else (even + odd,)


@dataclass(frozen=True, slots=True)
class Rings:
    """Rings of elements in the lump and in the shell around it."""

    lump: int = 1
    shell: int = 2


@dataclass(frozen=True, slots=True, eq=False)
class Inclusion:
    """A lump in its hull.

    Parameters
    ----------
    mesh
        Of the hull and the body around it.
    centre_mm
        Depth of the lump's centre, from which its radius is measured.
    boundary_mm
        Depth of the boundary between fat and gland.
    radius
        (...,) radii along (..., 3) unit vectors, smaller than the hull's in every direction.
    rings
    """

    mesh: LumpMesh
    centre_mm: float
    boundary_mm: float
    radius: Radius
    rings: Rings = Rings()

    def condensed(
        self, lump_kpa: float, tissue: Tissue, forms: Sequence[Harmonic], *, symmetric: bool = False
    ) -> FloatArray:
        """(n, n) stiffness on the hull, forms after each other, each with the unknowns of `CondensedMode` of its order.

        Scaled by the forms' measures, so that an axisymmetric inside gives the modes' stiffness on the diagonal. With a
        plane of symmetry, and forms of one family, half the circle is enough.
        """
        highest = max(form.order for form in forms)
        count = (2 * highest + _SPARE_ANGLES) * (1 if symmetric else 2)
        span = np.pi if symmetric else 2.0 * np.pi
        theta: FloatArray = (np.arange(count, dtype=np.float64) + 0.5) * (span / count)
        stations = _Stations.of(forms, theta, 2.0 * np.pi / count)
        node = self._nodes(theta)
        turn = (self._nodes(theta + _STEP_RAD) - self._nodes(theta - _STEP_RAD)) / (2.0 * _STEP_RAD)
        unknowns = _lines(self.mesh, forms, node.shape[1])
        carried = np.zeros((0, 0))
        for ring in range(self.rings.lump + self.rings.shell):
            rows = slice(2 * ring, 2 * ring + 3)
            kpa = lump_kpa if ring < self.rings.lump else None
            moduli = _Moduli(kpa, tissue, self.boundary_mm)
            carried = _eliminated(node[:, rows], turn[:, rows], unknowns[rows], stations, moduli, carried)
        return carried

    def _nodes(self, theta: FloatArray) -> FloatArray:
        """(t, lines, arc, 2) nodes (r, z) from the centre to the hull."""
        hull = self.mesh.node_mm[self.mesh.arc] - np.array([0.0, self.centre_mm])
        angle = self._angles(hull, theta)
        meridian = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        # on the axis exactly: it has no angle theta
        meridian[:, [0, -1]] = [[0.0, -1.0], [0.0, 1.0]]
        lump = self._radius(angle, theta)[..., None] * meridian
        inner = np.linspace(0.0, 1.0, 2 * self.rings.lump + 1)[None, :, None, None]
        outer = np.linspace(0.0, 1.0, 2 * self.rings.shell + 1)[None, 1:, None, None]
        node = np.concatenate([inner * lump[:, None], (1.0 - outer) * lump[:, None] + outer * hull], axis=1)
        node[..., 1] += self.centre_mm
        return node

    def _radius(self, angle: FloatArray, theta: FloatArray) -> FloatArray:
        """(t, arc) radii of the lump at (t, arc) angles from the downward vertical."""
        r, turn = np.sin(angle), theta[:, None]
        return self.radius(np.stack([r * np.cos(turn), r * np.sin(turn), np.cos(angle)], axis=-1))

    def _angles(self, hull: FloatArray, theta: FloatArray) -> FloatArray:
        """(t, arc) angles from the downward vertical of the nodes on the lump.

        Those of the hull's nodes; where the layers' boundary crosses the lump, stretched so that the hull's node at
        that depth belongs to a node of the lump at that depth too, and element edges follow the boundary between them.
        """
        plain = np.arctan2(hull[:, 0], hull[:, 1])
        depth = self.boundary_mm - self.centre_mm
        cut = int(np.argmin(np.abs(hull[:, 1] - depth)))
        ends = self.radius(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
        if abs(hull[cut, 1] - depth) > _ON_BOUNDARY_MM or not -_MOST_CUT * ends[1] < depth < _MOST_CUT * ends[0]:
            return np.broadcast_to(plain, (len(theta), len(plain)))
        low, high = np.zeros((len(theta), 1)), np.full((len(theta), 1), np.pi)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            below = self._radius(middle, theta) * np.cos(middle) > depth
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        at = plain[cut]
        lower, upper = plain * (low / at), np.pi - (np.pi - plain) * ((np.pi - low) / (np.pi - at))
        return np.asarray(np.where(plain <= at, lower, upper))


@dataclass(frozen=True, slots=True, eq=False)
class _Stations:
    """Quadrature angles, with (t, k, 3) values of the scaled forms and their derivatives, and the weight of an angle.

    `swells` are the forms with a volume change: all but the twist.
    """

    value: FloatArray
    slope: FloatArray
    weight: float
    swells: IntArray

    @classmethod
    def of(cls, forms: Sequence[Harmonic], theta: FloatArray, weight: float) -> _Stations:
        pairs = [form.values(theta) for form in forms]
        scale = np.array([form.measure for form in forms]) ** -0.5
        value, slope = (np.stack([pair[i] for pair in pairs], axis=1) * scale[:, None] for i in (0, 1))
        return cls(value, slope, weight, np.array([i for i, form in enumerate(forms) if not form.twist]))


@dataclass(frozen=True, slots=True)
class _Moduli:
    """Young's modulus in an element: of the lump, or of fat and gland by depth."""

    lump_kpa: float | None
    tissue: Tissue
    boundary_mm: float

    def at(self, z_mm: FloatArray) -> FloatArray:
        if self.lump_kpa is not None:
            return np.full(z_mm.shape, self.lump_kpa)
        fat = self.tissue.fat_kpa
        return np.where(z_mm > self.boundary_mm, fat * self.tissue.gland_ratio, fat)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """(k, arc, 3) index (-1: fixed) and sign of a line's unknowns, and their number."""

    number: IntArray
    sign: FloatArray
    count: int


def _lines(mesh: LumpMesh, forms: Sequence[Harmonic], lines: int) -> list[_Line]:
    """Unknowns of each line from the centre to the hull; on the axis as `order_unknowns` has it."""
    rim = _hull_line(mesh, forms)
    # the centre is the axis node of the arc's first pole, on every ray
    pole = rim.number[:, :1]
    kept = np.unique(pole[pole >= 0])
    at_centre = np.where(pole >= 0, np.searchsorted(kept, pole), -1)
    shape = rim.number.shape
    centre = _Line(np.broadcast_to(at_centre, shape), np.broadcast_to(rim.sign[:, :1], shape), len(kept))
    return [centre, *[rim] * (lines - 1)]


def _hull_line(mesh: LumpMesh, forms: Sequence[Harmonic]) -> _Line:
    numbers, signs, start = [], [], 0
    for form in forms:
        number, sign = order_unknowns(mesh, form.order, twist=form.twist)
        on_arc = number[mesh.arc]
        boundary = np.unique(on_arc[on_arc >= 0])
        numbers.append(np.where(on_arc >= 0, start + np.searchsorted(boundary, on_arc), -1))
        signs.append(sign[mesh.arc])
        start += len(boundary)
    return _Line(np.stack(numbers), np.stack(signs), start)


def _eliminated(
    node: FloatArray,
    turn: FloatArray,
    lines: Sequence[_Line],
    stations: _Stations,
    moduli: _Moduli,
    carried: FloatArray,
) -> FloatArray:
    """Stiffness on a ring's outer line, with all inside it condensed (Guyan 1965: exact in statics).

    Parameters
    ----------
    node, turn : (t, 3, arc, 2) arrays
        The ring's nodes and their derivatives by theta.
    carried : (n, n) array
        Condensed stiffness on its inner line; empty for the innermost ring.
    """
    starts = np.cumsum([0, *[line.count for line in lines]])
    total = np.zeros((starts[-1], starts[-1]))
    total[: len(carried), : len(carried)] = carried
    number = np.stack([np.where(n.number >= 0, n.number + s, -1) for n, s in zip(lines, starts, strict=False)])
    sign = np.stack([line.sign for line in lines])
    for first in range(0, node.shape[2] - 2, 2):
        at = slice(first, first + 3)
        local = _element(node[:, :, at], turn[:, :, at], stations, moduli)
        # (line, k, arc, component) to (k, node, component)
        index, factor = (a[:, :, at].transpose(1, 0, 2, 3).ravel() for a in (number, sign))
        free = np.flatnonzero(index >= 0)
        local = local[np.ix_(free, free)] * np.outer(factor[free], factor[free])
        unknown: IntArray = index[free].astype(np.int64)
        np.add.at(total, (unknown[:, None], unknown[None, :]), local)
    from scipy.linalg import cholesky, solve_triangular

    cut = starts[2]
    factor = cholesky(total[:cut, :cut], lower=True, check_finite=False)
    across = solve_triangular(factor, total[:cut, cut:], lower=True, check_finite=False)
    condensed = total[cut:, cut:] - across.T @ across
    return np.asarray((condensed + condensed.T) / 2)


def _element(node: FloatArray, turn: FloatArray, stations: _Stations, moduli: _Moduli) -> FloatArray:
    """(27 k, 27 k) stiffness of an element with (t, 3, 3, 2) nodes; unknowns by form, node and component.

    As `axisymmetric.element_stiffness`: the volume change is projected on functions linear in (r, z), here times the
    same Fourier forms as the displacements.
    """
    nu = moduli.tissue.nu
    shear, bulk = 0.5 / (1.0 + nu), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    shape, local, weight = lagrange_points()
    node, turn = node.reshape(len(node), 9, 2), turn.reshape(len(turn), 9, 2)
    jacobian = np.einsum("qnk,tnx->tqxk", local, node)
    gradient = np.einsum("qnk,tqkx->tqnx", local, np.linalg.inv(jacobian))
    point, moved = (np.einsum("qn,tnx->tqx", shape, a) for a in (node, turn))
    measure = stations.weight * np.abs(np.linalg.det(jacobian)) * weight * point[..., 0]
    stiff = measure * moduli.at(point[..., 1])
    strain = _strain(shape, gradient, point[..., 0], moved, stations)
    size = strain.shape[-1]
    volume = strain[:, :, :3].sum(axis=2).reshape(-1, size)
    strain *= np.sqrt(np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0]) * shear * stiff[..., None])[..., None]
    flat = strain.reshape(-1, size)
    kept = _projected(volume, point, measure.ravel(), stations) * np.sqrt(bulk * stiff.reshape(-1, 1))
    return np.asarray(flat.T @ flat + kept.T @ kept)


def _projected(volume: FloatArray, point: FloatArray, measure: FloatArray, stations: _Stations) -> FloatArray:
    """(t * 9, n) volume changes of unit unknowns, projected on functions linear in (r, z) times the forms of u_z."""
    offset = point - point.mean(axis=1, keepdims=True)
    linear = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=-1)
    forms = stations.value[:, stations.swells, 2]
    basis = np.einsum("tqp,tk->tqpk", linear, forms).reshape(len(measure), -1)
    weighted = basis * measure[:, None]
    return np.asarray(basis @ np.linalg.solve(basis.T @ weighted, weighted.T @ volume))


def _strain(
    shape: FloatArray, gradient: FloatArray, r_mm: FloatArray, moved: FloatArray, stations: _Stations
) -> FloatArray:
    """(t, 9, 6, 27 k) strains (rr, tt, zz, rz, rt, zt) of unit unknowns.

    A derivative by theta at a fixed place is that at fixed mesh coordinates less what the moving nodes do.
    """
    t, q = r_mm.shape
    k = stations.value.shape[1]
    value, slope = stations.value[:, None, :, None], stations.slope[:, None, :, None]
    dr, dz = gradient[:, :, None, :, 0], gradient[:, :, None, :, 1]
    drift = (gradient * moved[:, :, None]).sum(axis=-1)[:, :, None]
    here = shape[None, :, None]
    over_r = 1.0 / r_mm[:, :, None, None]
    by_r, by_z, plain, by_angle = [], [], [], []
    for c in range(3):
        f, g = value[..., c], slope[..., c]
        by_r.append(dr * f)
        by_z.append(dz * f)
        plain.append(here * f * over_r)
        by_angle.append((here * g - drift * f) * over_r)
    strain = np.zeros((t, q, 6, k, 9, 3))
    strain[:, :, 0, ..., 0] = by_r[0]
    strain[:, :, 1, ..., 0] = plain[0]
    strain[:, :, 1, ..., 1] = by_angle[1]
    strain[:, :, 2, ..., 2] = by_z[2]
    strain[:, :, 3, ..., 0] = by_z[0]
    strain[:, :, 3, ..., 2] = by_r[2]
    strain[:, :, 4, ..., 0] = by_angle[0]
    strain[:, :, 4, ..., 1] = by_r[1] - plain[1]
    strain[:, :, 5, ..., 1] = by_z[1]
    strain[:, :, 5, ..., 2] = by_angle[2]
    return strain.reshape(t, q, 6, 27 * k)
