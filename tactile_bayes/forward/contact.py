r"""Frictionless contact of a rigid head with an elastic surface, under a given force.

With C the compliance of the surface cells, g the head's profile and :math:`\delta` the depth it is pushed to, the
pressures are the one solution of

.. math:: p \ge 0, \quad w = Cp + g - \delta \ge 0, \quad p \cdot w = 0, \quad \textstyle\sum p\,\Delta x = F,

a small convex quadratic programme (Johnson 1985, section 5.8). Where shoulders lie around the sensing cells, F is the
force on the sensing cells alone (decision record 0025).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS, HEADS, SHOULDERS_INSIDE

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

SHOULDER_MM = 3.0
_MOST_ROUNDS = 40


@dataclass(frozen=True, slots=True)
class Head:
    """The head's cross-section: an arc with rounded shoulders.

    Parameters
    ----------
    width_mm
        Of the sensing part.
    radius_mm
        Of the arc; infinity for a flat head.
    shoulder_mm
        Radius of the round between arc and side, tangent to both; 0 for a sharp edge.
    shoulders
        ``"shoulders-inside"``: the rounds are cut into the sensing width, which is the whole face.
        ``"shoulders-outside"``: the arc spans the sensing width, and the rounds lie around it, press and sense nothing.

    Notes
    -----
    The paper has "nearly a section of a circular cylinder" of 24 mm (section 2.1); radius and shoulders are assumed.
    Where the shoulders lie decides how many faint lumps show: decision record 0075.
    """

    width_mm: float = HEAD_ROWS * HEAD_PITCH_MM
    radius_mm: float = HEAD_RADIUS_MM
    shoulder_mm: float = SHOULDER_MM
    shoulders: str = SHOULDERS_INSIDE

    def __post_init__(self) -> None:
        if not 0 < self.width_mm < np.inf:
            raise BadDataError(f"width_mm of the head is {self.width_mm:g}", way_out="it must be above 0, in mm")
        if not self.radius_mm > self.half_width_mm:
            raise BadDataError(
                f"radius_mm of the head is {self.radius_mm:g}",
                way_out=f"it must be above {self.half_width_mm:g} mm, half the head's width",
            )
        self._check_shoulders()

    def _check_shoulders(self) -> None:
        if self.shoulders not in HEADS:
            raise BadDataError(
                f"shoulders of the head is {self.shoulders!r}", way_out=f"it must be {' or '.join(HEADS)}"
            )
        inside = self.shoulders == SHOULDERS_INSIDE
        if inside and not 0 <= self.shoulder_mm <= self.half_width_mm:
            raise BadDataError(
                f"shoulder_mm of the head is {self.shoulder_mm:g}",
                way_out=f"it must be between 0 and {self.half_width_mm:g} mm, half the head's width",
            )
        if not 0 <= self.shoulder_mm < self.radius_mm:
            raise BadDataError(
                f"shoulder_mm of the head is {self.shoulder_mm:g}",
                way_out=f"it must be between 0 and below radius_mm, {self.radius_mm:g} mm",
            )

    @property
    def half_width_mm(self) -> float:
        """Half of the sensing width: w of Eq 1."""
        return 0.5 * self.width_mm

    @property
    def half_face_mm(self) -> float:
        """Half the width of the rigid face: the sensing width, plus the shoulders where they lie outside it."""
        if self.shoulders == SHOULDERS_INSIDE:
            return self.half_width_mm
        return self.half_width_mm + self.shoulder_mm * (1 - self.half_width_mm / self.radius_mm)

    def profile_mm(self, s_mm: FloatArray) -> FloatArray:
        """Height of the head's face above its lowest point, at distances `s_mm` from its centre within the face."""
        s = np.abs(np.asarray(s_mm, dtype=np.float64))
        r, inner = self.shoulder_mm, self.half_face_mm - self.shoulder_mm
        if np.isinf(self.radius_mm):
            return np.where(s <= inner, 0.0, r - _circle(r, s - inner))
        big = self.radius_mm
        centre = float(_circle(big - r, np.array(inner)))
        tangent = inner * big / (big - r)
        return np.where(s <= tangent, big - _circle(big, s), big - centre - _circle(r, s - inner))

    def cell_profile_mm(self, cell_mm: float) -> FloatArray:
        """(n,) profile averaged over the cells of width `cell_mm` of the face, from left to right.

        Cells around the sensing width belong to the face when their centres lie on a shoulder.
        """
        points, weights = np.polynomial.legendre.leggauss(6)
        count = len(self.sensing_cells(cell_mm))
        centres = cell_mm * (np.arange(count) - 0.5 * (count - 1))
        return np.asarray(self.profile_mm(centres[:, None] + 0.5 * cell_mm * points) @ (0.5 * weights))

    def sensing_cells(self, cell_mm: float) -> BoolArray:
        """(n,) whether each cell of the face, from left to right, senses pressure or only presses."""
        count = round(self.width_mm / cell_mm)
        if count < 2 or abs(count * cell_mm - self.width_mm) > 1e-9 * self.width_mm:
            raise BadDataError(
                f"cell_mm is {cell_mm:g}", way_out=f"it must divide the head's width of {self.width_mm:g} mm"
            )
        around = max(0, int(np.ceil((self.half_face_mm - self.half_width_mm) / cell_mm - 0.5 - 1e-9)))
        return np.pad(np.ones(count, dtype=bool), around)


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Solutions of the contact at m positions over n cells.

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
    compliance: FloatArray,
    profile_mm: FloatArray,
    *,
    total_kpa: float | FloatArray,
    touching: BoolArray | None = None,
    counted: BoolArray | None = None,
) -> Contact:
    """Solve the contact of a rigid profile with a surface at many positions at once.

    Parameters
    ----------
    compliance : (m, n, n) array of mm per kPa
        Symmetric and positive definite, one matrix a position.
    profile_mm : (n,) array
        Head's face above its lowest point.
    total_kpa
        Sum of the counted cells' pressures: force per unit length over the width of a cell. Above 0; one, or (m,).
    touching : (n,) or (m, n) bool array, optional
        A first guess of the cells in contact.
    counted : (n,) bool array, optional
        Cells whose pressures add up to `total_kpa`, the sensing ones; by default all.

    Raises
    ------
    NotConvergedError
        When a contact is not found.

    Notes
    -----
    Cells that would pull are let go and cells that would overlap are taken in, all at once, until none changes (the
    primal-dual active set method; Hintermueller, Ito & Kunisch 2003). A position at which that does not end is solved
    cell by cell, which always ends where all cells are counted.
    """
    m, n = compliance.shape[:2]
    share = np.ones(n) if counted is None else counted.astype(np.float64)
    total = np.broadcast_to(np.asarray(total_kpa, dtype=np.float64), (m,))
    if not (np.isfinite(total).all() and (total > 0).all()):
        raise BadDataError(f"the head's force is {total.min():g}", way_out="it must be above 0")
    active = np.ones((m, n), dtype=bool) if touching is None else np.broadcast_to(touching, (m, n)).copy()
    pressure, gap, depth = np.zeros((m, n)), np.zeros((m, n)), np.zeros(m)
    open_ = np.arange(m)
    rounds = 0
    while len(open_) and rounds < _MOST_ROUNDS:
        rounds += 1
        p, w, d = _given_contact(compliance[open_], profile_mm, active[open_], total[open_], share)
        new = (active[open_] & (p > 0)) | (~active[open_] & (w < -_tolerance(profile_mm, d)))
        pressure[open_], gap[open_], depth[open_] = p, w, d
        changed = (new != active[open_]).any(axis=1)
        active[open_] = new
        open_ = open_[changed]
    for i in open_:
        pressure[i], gap[i], depth[i] = _cell_by_cell(compliance[i], profile_mm, float(total[i]), share)
    return Contact(np.maximum(pressure, 0.0), np.maximum(gap, 0.0), depth, rounds)


def _tolerance(profile_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """(m, 1) overlap that counts as rounding error, from the lengths involved."""
    return np.asarray(1e-13 * (np.abs(depth_mm) + float(np.abs(profile_mm).max())))[:, None]


def _given_contact(
    compliance: FloatArray, profile: FloatArray, active: BoolArray, total: float | FloatArray, share: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pressures (0 off `active`), gaps (0 on it) and depths when the touching cells are known."""
    n = len(profile)
    system = np.where(active[:, :, None] & active[:, None, :], compliance, 0.0)
    index = np.arange(n)
    system[:, index, index] += ~active
    sides = np.stack([np.where(active, -profile, 0.0), active.astype(np.float64)], axis=-1)
    solved = np.linalg.solve(system, sides)
    rest, unit = solved[..., 0], solved[..., 1]
    depth = (total - (rest * share).sum(axis=1)) / np.maximum((unit * share).sum(axis=1), 1e-300)
    pressure = np.where(active, rest + depth[:, None] * unit, 0.0)
    gap = np.einsum("mij,mj->mi", compliance, pressure) + profile - depth[:, None]
    return pressure, np.where(active, 0.0, gap), depth


def _cell_by_cell(
    compliance: FloatArray, profile: FloatArray, total: float, share: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Solve one position by an active-set method that moves one cell at a time (Lawson & Hanson 1974)."""
    n = len(profile)
    active, pressure = np.ones(n, dtype=bool), np.full(n, total / share.sum())
    for _ in range(20 * n):
        p, w, d = (part[0] for part in _given_contact(compliance[None], profile, active[None], total, share))
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
