"""Pressing a head on a body: the contact problem, for a line of taxels and in the solid."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, NotConvergedError, require
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS, HEADS, SHOULDER_MM, SHOULDERS_INSIDE

# --- Frictionless contact of a rigid head with an elastic surface, under a given force.
#
# With C the compliance of the surface cells, g the head's profile and :math:`\delta` the depth it is pushed to, the
# pressures are the one solution of
#
# .. math:: p \ge 0, \quad w = Cp + g - \delta \ge 0, \quad p \cdot w = 0, \quad \textstyle\sum p\,\Delta x = F,
#
# a small convex quadratic programme (Johnson 1985, section 5.8). Where shoulders lie around the sensing cells, F is
# the force on the sensing cells alone (decision record 0025).

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]

_MOST_ROUNDS = 40


class Head(Record):
    """The head's cross-section: an arc with rounded shoulders.

    The paper has "nearly a section of a circular cylinder" of 24 mm (section 2.1); radius and shoulders are assumed.
    Where the shoulders lie decides how many faint lumps show: decision record 0075.
    """

    width_mm: float = HEAD_ROWS * HEAD_PITCH_MM  #: Of the sensing part.
    radius_mm: float = HEAD_RADIUS_MM  #: Of the arc; infinity for a flat head.
    shoulder_mm: float = SHOULDER_MM
    """Radius of the round between arc and side, tangent to both; 0 for a sharp edge."""
    shoulders: str = SHOULDERS_INSIDE
    """``"shoulders-inside"``: the rounds are cut into the sensing width, which is the whole face.
    ``"shoulders-outside"``: the arc spans the sensing width, and the rounds lie around it, press and sense nothing."""

    def __post_init__(self) -> None:
        require(0 < self.width_mm < np.inf, "width_mm of the head", self.width_mm, "be above 0, in mm")
        half = f"{self.half_width_mm:g} mm, half the head's width"
        require(self.radius_mm > self.half_width_mm, "radius_mm of the head", self.radius_mm, f"be above {half}")
        if self.shoulders not in HEADS:
            raise BadDataError(
                f"shoulders of the head is {self.shoulders!r}", way_out=f"it must be {' or '.join(HEADS)}"
            )
        shoulder, name = self.shoulder_mm, "shoulder_mm of the head"
        fits = self.shoulders != SHOULDERS_INSIDE or 0 <= shoulder <= self.half_width_mm
        require(fits, name, shoulder, f"be between 0 and {half}")
        rule = f"be between 0 and below radius_mm, {self.radius_mm:g} mm"
        require(0 <= shoulder < self.radius_mm, name, shoulder, rule)

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


class Contact(Record, eq=False):
    """Solutions of the contact at m positions over n cells."""

    pressure_kpa: FloatArray
    gap_mm: FloatArray
    """`pressure_kpa`, `gap_mm` (m, n) arrays: At each cell one is 0 and the other is not negative."""
    depth_mm: FloatArray  #: (m,) array: How deep the head's lowest point is pushed.
    rounds: int
    """In which cells changed between touching and not touching, the last (without a change) included."""


def solve_contact(
    compliance: FloatArray,
    profile_mm: FloatArray,
    *,
    total_kpa: float | FloatArray,
    touching: BoolArray | None = None,
    counted: BoolArray | None = None,
) -> Contact:
    """Solve the contact of a rigid profile (mm above its lowest point) with a surface at m positions at once.

    The compliance is (m, n, n) mm per kPa, symmetric and positive definite. `total_kpa`, above 0, is the sum of the
    `counted` (sensing; by default all) cells' pressures: force per unit length over the width of a cell. `touching` is
    a first guess, (n,) or (m, n).

    Cells that would pull are let go and cells that would overlap are taken in, all at once, until none changes (the
    primal-dual active set method; Hintermueller, Ito & Kunisch 2003). A position at which that does not end is solved
    cell by cell, which always ends where all cells are counted; else a NotConvergedError.
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


# --- Frictionless contact of a rigid head with an elastic body under a given force: pressures on the taxels.
#
# Pressure is constant over each taxel. A taxel bears pressure where it touches, and is free where there is a gap:
# ``p >= 0``, ``gap >= 0``, ``p gap = 0``. The depth to which the head sinks is what makes the pressures add up to
# the force.

# Pressures and gaps beyond this share of the mean pressure and of the depth count as of the wrong sign.
_TOLERANCE: Final = 1e-11
_MOST_STEPS: Final = 2000
# Steps in which the number of wrong signs may fail to fall before one taxel at a time is changed.
_PATIENCE: Final = 4


class SolidContact(Record, eq=False):
    """The solved contact of a head."""

    pressure_kpa: FloatArray  #: (n,) array: Of each taxel; 0 where it does not touch.
    gap_mm: FloatArray  #: (n,) array: Between each taxel and the skin; 0 where it touches.
    depth_mm: float  #: Of the head's highest point of `height_mm` 0 below the undisturbed skin.
    touching: BoolArray  #: (n,) array of bool.


class ContactStiffness(Record, eq=False):
    r"""Inverse of a compliance that is a fixed matrix less a low-rank change."""

    plain: FloatArray  #: (n, n) array: Inverse of the compliance without the change, kPa / mm.
    factor: FloatArray  #: (n, k) array.
    core: FloatArray  #: (k, k) array: The stiffness is ``plain + factor @ core @ factor.T``.

    @classmethod
    def of(cls, compliance: FloatArray) -> ContactStiffness:
        """Invert a plain compliance: (n, n) in mm / kPa, symmetric positive definite."""
        try:
            np.linalg.cholesky(compliance)
        except np.linalg.LinAlgError:
            raise BadDataError(
                "the compliance is not positive definite", way_out="give a body with positive stiffness"
            ) from None
        empty = np.zeros((len(compliance), 0))
        inverse = np.linalg.inv(compliance)
        return cls((inverse + inverse.T) / 2, empty, np.zeros((0, 0)))

    def changed(self, vectors: FloatArray, signs: FloatArray) -> ContactStiffness:
        """Stiffness after ``vectors @ diag(signs) @ vectors.T`` is added to the compliance: (n, k) in mm^(1/2)
        kPa^(-1/2), and signs of 1 or -1.

        :math:`(C + V s V^T)^{-1} = H - H V (s + V^T H V)^{-1} V^T H` (Woodbury). The sum is positive definite when the
        bracket has as many negative eigenvalues as s (Sylvester's law of inertia).
        """
        if self.factor.shape[1]:
            raise BadDataError("this stiffness was changed already", way_out="gather all changes in one")
        factor = self.plain @ vectors
        bracket = np.diag(signs) + vectors.T @ factor
        if np.count_nonzero(np.linalg.eigvalsh(bracket) < 0) != np.count_nonzero(signs < 0):
            raise BadDataError(
                "the lumps lie too close together for this model",
                way_out="move them apart: the effects of several lumps are added as if each were alone",
            )
        return ContactStiffness(self.plain, factor, np.asarray(-np.linalg.inv(bracket), dtype=np.float64))

    def times(self, right: FloatArray) -> FloatArray:
        """Product of the stiffness with an (n, c) array."""
        return np.asarray(self.plain @ right + self.factor @ (self.core @ (self.factor.T @ right)))

    def columns(self, chosen: NDArray[np.intp]) -> FloatArray:
        """(n, c) columns of the stiffness."""
        return np.asarray(self.plain[:, chosen] + self.factor @ (self.core @ self.factor[chosen].T))


def press(
    stiffness: ContactStiffness,
    height_mm: FloatArray,
    *,
    mean_kpa: float,
    counted: BoolArray | None = None,
    touching: BoolArray | None = None,
) -> SolidContact:
    r"""Press a head on the body until the force over the area of the counted squares, touching or not, is `mean_kpa`.

    Each taxel touches when the head has come down by its `height_mm`, of which the minimum may be any number. `counted`
    are the taxels of a head that also has a rim, None for all; `touching` is where to start: a neighbouring frame's
    saves steps.

    With H the stiffness and I the taxels off the skin, :math:`p = H(\delta - g + w)`, :math:`p_I = 0` and :math:`w = 0`
    elsewhere: a system as large as the part of the head that does not touch. Signs are put right by block principal
    pivoting, with one taxel at a time where blocks fail (Judice & Pires 1994), which ends because the matrix is
    positive definite.
    """
    count = len(height_mm)
    if not mean_kpa > 0:
        if mean_kpa < 0:
            raise BadDataError(f"mean_kpa is {mean_kpa}", way_out="a head can press, not pull: give 0 or more")
        lowest = float(height_mm.min())
        return SolidContact(np.zeros(count), height_mm - lowest, lowest, np.zeros(count, dtype=bool))
    share = np.full(count, 1.0 / count) if counted is None else counted / np.count_nonzero(counted)
    level, shaped = stiffness.times(np.stack([np.ones(count), height_mm], axis=-1)).T
    start = touching is not None and (touching & (share > 0)).any()
    now = touching.copy() if start and touching is not None else np.ones(count, dtype=bool)
    fewest, patience = count + 1, _PATIENCE
    for _ in range(_MOST_STEPS):
        contact, wrong = _solve(stiffness, level, shaped, now, share=share, mean_kpa=mean_kpa)
        bad = int(np.count_nonzero(wrong))
        if bad == 0:
            return contact
        if bad < fewest:
            fewest, patience = bad, _PATIENCE
        else:
            patience -= 1
        if patience > 0:
            now = now ^ wrong
        else:
            now = now.copy()
            last = int(np.flatnonzero(wrong)[-1])
            now[last] = not now[last]
        if not (now & (share > 0)).any():
            now[int(np.argmin(np.where(share > 0, height_mm, np.inf)))] = True
    raise NotConvergedError(
        "the contact between head and skin did not converge", diagnostics={"wrong_signs": float(fewest)}
    )


def _solve(
    stiffness: ContactStiffness,
    level: FloatArray,
    shaped: FloatArray,
    touching: BoolArray,
    *,
    share: FloatArray,
    mean_kpa: float,
) -> tuple[SolidContact, BoolArray]:
    """Solve the contact for exactly the `touching` squares, and find where pressure or gap has the wrong sign."""
    off = np.flatnonzero(~touching)
    # one column for a unit of depth, one for the head's shape
    pressure = np.stack([level, -shaped], axis=-1)
    gap = np.zeros((len(level), 2))
    if len(off):
        columns = stiffness.columns(off)
        gap[off] = -np.linalg.solve(columns[off], pressure[off])
        pressure = pressure + columns @ gap[off]
        pressure[off] = 0.0
    by_depth, by_shape = share @ pressure
    depth = (mean_kpa - by_shape) / by_depth
    kpa = depth * pressure[:, 0] + pressure[:, 1]
    mm = depth * gap[:, 0] + gap[:, 1]
    wrong = np.where(touching, kpa < -_TOLERANCE * mean_kpa, mm < -_TOLERANCE * max(abs(depth), 1e-300))
    return SolidContact(kpa, mm, float(depth), touching), wrong
