r"""A rigid, frictionless head on a compliant surface: pressure only where it touches, and a given force.

With C the compliance of the surface cells, g the head's profile and :math:`\delta` the depth it is pushed to, the
pressures are the one solution of

.. math:: p \ge 0, \quad w = Cp + g - \delta \ge 0, \quad p \cdot w = 0, \quad \textstyle\sum p\,\Delta x = F,

a small convex quadratic programme (Johnson 1985, section 5.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

SHOULDER_MM = 3.0
_MOST_ROUNDS = 40


@dataclass(frozen=True, slots=True)
class Head:
    """The head's cross-section: an arc with rounded shoulders.

    Parameters
    ----------
    width_mm
        From side to side.
    radius_mm
        Of the arc; infinity for a flat head.
    shoulder_mm
        Radius of the round between arc and side, tangent to both; 0 for a sharp edge.

    Notes
    -----
    The paper has "nearly a section of a circular cylinder" of 24 mm (section 2.1); radius and shoulders are assumed.
    """

    width_mm: float = HEAD_ROWS * HEAD_PITCH_MM
    radius_mm: float = HEAD_RADIUS_MM
    shoulder_mm: float = SHOULDER_MM

    def __post_init__(self) -> None:
        if not 0 < self.width_mm < np.inf:
            raise BadDataError(f"width_mm of the head is {self.width_mm:g}", way_out="it must be above 0, in mm")
        if not self.radius_mm > self.half_width_mm:
            raise BadDataError(
                f"radius_mm of the head is {self.radius_mm:g}",
                way_out=f"it must be above {self.half_width_mm:g} mm, half the head's width",
            )
        if not 0 <= self.shoulder_mm <= self.half_width_mm:
            raise BadDataError(
                f"shoulder_mm of the head is {self.shoulder_mm:g}",
                way_out=f"it must be between 0 and {self.half_width_mm:g} mm, half the head's width",
            )

    @property
    def half_width_mm(self) -> float:
        """w of Eq 1."""
        return 0.5 * self.width_mm

    def profile_mm(self, s_mm: FloatArray) -> FloatArray:
        """Height of the head's face above its lowest point, at distances `s_mm` from its centre within the width."""
        s = np.abs(np.asarray(s_mm, dtype=np.float64))
        r, inner = self.shoulder_mm, self.half_width_mm - self.shoulder_mm
        if np.isinf(self.radius_mm):
            return np.where(s <= inner, 0.0, r - _circle(r, s - inner))
        big = self.radius_mm
        centre = float(_circle(big - r, np.array(inner)))
        tangent = inner * big / (big - r)
        return np.where(s <= tangent, big - _circle(big, s), big - centre - _circle(r, s - inner))

    def cell_profile_mm(self, cell_mm: float) -> FloatArray:
        """(n,) profile averaged over the cells of width `cell_mm` under the head, from left to right."""
        count = round(self.width_mm / cell_mm)
        if count < 2 or abs(count * cell_mm - self.width_mm) > 1e-9 * self.width_mm:
            raise BadDataError(
                f"cell_mm is {cell_mm:g}", way_out=f"it must divide the head's width of {self.width_mm:g} mm"
            )
        points, weights = np.polynomial.legendre.leggauss(6)
        centres = cell_mm * (np.arange(count) - 0.5 * (count - 1))
        return np.asarray(self.profile_mm(centres[:, None] + 0.5 * cell_mm * points) @ (0.5 * weights))


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The solution at m positions over n cells.

    Parameters
    ----------
    pressure_kpa, gap_mm : (m, n) arrays
        At each cell one is 0 and the other is not negative.
    depth_mm : (m,) array
        How deep the head's lowest point is pushed.
    rounds
        In which cells changed between touching and not touching, the last (without a change) included.
    """

    pressure_kpa: FloatArray
    gap_mm: FloatArray
    depth_mm: FloatArray
    rounds: int


def solve_contact(
    compliance: FloatArray, profile_mm: FloatArray, *, total_kpa: float | FloatArray, touching: BoolArray | None = None
) -> Contact:
    """Press a rigid profile on a surface, at many positions at once.

    Parameters
    ----------
    compliance : (m, n, n) array of mm per kPa
        Symmetric and positive definite, one matrix a position.
    profile_mm : (n,) array
        Head's face above its lowest point.
    total_kpa
        Sum of the cells' pressures: force per unit length over the width of a cell. Above 0; one, or (m,) of them.
    touching : (n,) or (m, n) bool array, optional
        A first guess of the cells in contact.

    Notes
    -----
    Cells that would pull are let go and cells that would overlap are taken in, all at once, until none changes (the
    primal-dual active set method; Hintermueller, Ito & Kunisch 2003). A position at which that does not end is solved
    cell by cell, which always ends.
    """
    m, n = compliance.shape[:2]
    total = np.broadcast_to(np.asarray(total_kpa, dtype=np.float64), (m,))
    if not (np.isfinite(total).all() and (total > 0).all()):
        raise BadDataError(f"the head's force is {total.min():g}", way_out="it must be above 0")
    active = np.ones((m, n), dtype=bool) if touching is None else np.broadcast_to(touching, (m, n)).copy()
    pressure, gap, depth = np.zeros((m, n)), np.zeros((m, n)), np.zeros(m)
    open_ = np.arange(m)
    rounds = 0
    while len(open_) and rounds < _MOST_ROUNDS:
        rounds += 1
        p, w, d = _given_contact(compliance[open_], profile_mm, active[open_], total[open_])
        new = (active[open_] & (p > 0)) | (~active[open_] & (w < -_tolerance(profile_mm, d)))
        pressure[open_], gap[open_], depth[open_] = p, w, d
        changed = (new != active[open_]).any(axis=1)
        active[open_] = new
        open_ = open_[changed]
    for i in open_:
        pressure[i], gap[i], depth[i] = _cell_by_cell(compliance[i], profile_mm, float(total[i]))
    return Contact(np.maximum(pressure, 0.0), np.maximum(gap, 0.0), depth, rounds)


def _tolerance(profile_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Overlap (m, 1) that is only rounding, of the lengths at play."""
    return np.asarray(1e-13 * (np.abs(depth_mm) + float(np.abs(profile_mm).max())))[:, None]


def _given_contact(
    compliance: FloatArray, profile: FloatArray, active: BoolArray, total: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pressures (0 off `active`), gaps (0 on it) and depths when the touching cells are known."""
    n = len(profile)
    system = np.where(active[:, :, None] & active[:, None, :], compliance, 0.0)
    index = np.arange(n)
    system[:, index, index] += ~active
    sides = np.stack([np.where(active, -profile, 0.0), active.astype(np.float64)], axis=-1)
    solved = np.linalg.solve(system, sides)
    rest, unit = solved[..., 0], solved[..., 1]
    depth = (total - rest.sum(axis=1)) / np.maximum(unit.sum(axis=1), 1e-300)
    pressure = np.where(active, rest + depth[:, None] * unit, 0.0)
    gap = np.einsum("mij,mj->mi", compliance, pressure) + profile - depth[:, None]
    return pressure, np.where(active, 0.0, gap), depth


def _cell_by_cell(compliance: FloatArray, profile: FloatArray, total: float) -> tuple[FloatArray, FloatArray, float]:
    """The same by moving one cell at a time along a path on which the energy only falls (Lawson & Hanson 1974)."""
    n = len(profile)
    active, pressure = np.ones(n, dtype=bool), np.full(n, total / n)
    for _ in range(20 * n):
        p, w, d = (part[0] for part in _given_contact(compliance[None], profile, active[None], total))
        if (p[active] > 0).all():
            pressure = p
            worst = int(np.argmin(w))
            if w[worst] >= -float(_tolerance(profile, np.array([d]))[0, 0]):
                return p, w, float(d)
            active[worst] = True
            continue
        pulls = active & (p <= 0)
        step = float(np.min(pressure[pulls] / (pressure[pulls] - p[pulls])))
        pressure = np.where(active, pressure + step * (p - pressure), 0.0)
        active &= ~(pulls & (pressure <= 1e-14 * total))
    raise NotConvergedError(f"the contact of {n} cells did not settle; check that the compliance is positive definite")


def _circle(radius: float, x: FloatArray) -> FloatArray:
    """Height of a circle about 0 at `x`; 0 beyond it."""
    return np.sqrt(np.maximum(radius**2 - np.asarray(x) ** 2, 0.0))
