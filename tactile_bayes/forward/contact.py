"""Contact of a rigid head with a body's skin, for a line of taxels and in the solid."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrs

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.geometry import BoolArray, FloatArray

# --- Frictionless contact of a rigid head with an elastic surface, under a given force.
#
# Pressure is constant over each cell of the face, which is a taxel or a part of one. With C the compliance of the
# cells, g the head's profile and :math:`\delta` the depth it is pushed to, the pressures are the one solution of
#
# .. math:: p \ge 0, \quad w = Cp + g - \delta \ge 0, \quad p \cdot w = 0, \quad \textstyle\sum p\,\Delta x = F,
#
# a small convex quadratic programme (Johnson 1985, section 5.8). Where shoulders lie around the sensing cells, F is
# the force on the sensing cells alone (decision record 0025).

_TOLERANCE: Final = 1e-11  #: Share of the mean pressure, or of the depth, beyond which a sign is wrong.
_MOST_STEPS: Final = 2000
_PATIENCE: Final = 4  #: Steps without fewer wrong signs after which one taxel at a time is changed.


class Contact(Record, eq=False):
    """Solution of a contact."""

    pressure_kpa: FloatArray  #: (n,) array: Pressure of each taxel; 0 where it does not touch.
    gap_mm: FloatArray  #: (n,) array: Gap between each taxel and the skin; 0 where it touches.
    depth_mm: float  #: Depth of the head's point of `height_mm` 0 below the undisturbed skin.
    touching: BoolArray  #: (n,) array of bool.


class FactoredCompliance(Record, eq=False):
    """Cholesky factor of a compliance that serves one frame, for which inverting it takes longer than the contact."""

    lower: FloatArray  #: (n, n) array.

    @classmethod
    def of(cls, compliance: FloatArray) -> FactoredCompliance:
        """Factorise a compliance: (n, n) in mm / kPa, symmetric positive definite."""
        try:
            return cls(np.asarray(np.linalg.cholesky(compliance)))
        except np.linalg.LinAlgError:
            what = "the compliance is not positive definite"
            raise BadDataError(what, way_out="give a body with positive stiffness") from None

    def times(self, right: FloatArray) -> FloatArray:
        """Product of the stiffness with an (n, c) array."""
        return np.asarray(dpotrs(self.lower.T, right)[0])

    def columns(self, chosen: NDArray[np.intp]) -> FloatArray:
        """(n, c) columns of the stiffness."""
        return self.times(np.eye(len(self.lower))[:, chosen])


class ContactStiffness(Record, eq=False):
    r"""Inverse of a compliance that is a fixed matrix less a low-rank change."""

    plain: FloatArray  #: (n, n) array: Inverse of the compliance without the change, kPa / mm.
    factor: FloatArray  #: (n, k) array.
    core: FloatArray  #: (k, k) array: The stiffness is ``plain + factor @ core @ factor.T``.

    @classmethod
    def of(cls, compliance: FloatArray) -> ContactStiffness:
        """Invert a plain compliance: (n, n) in mm / kPa, symmetric positive definite."""
        FactoredCompliance.of(compliance)  # refuses what is not positive definite
        empty = np.zeros((len(compliance), 0))
        inverse = np.linalg.inv(compliance)
        return cls((inverse + inverse.T) / 2, empty, np.zeros((0, 0)))

    def changed(self, vectors: FloatArray, signs: FloatArray) -> ContactStiffness:
        """Stiffness after ``vectors @ diag(signs) @ vectors.T`` is added to the compliance, with signs of 1 or -1.

        :math:`(C + V s V^T)^{-1} = H - H V (s + V^T H V)^{-1} V^T H` (Woodbury); V is (n, k) in mm^(1/2) kPa^(-1/2).
        The sum is positive definite if the bracket has as many negative eigenvalues as s (Sylvester's law of inertia).
        """
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


def solve_contact(
    stiffness: ContactStiffness | FactoredCompliance,
    height_mm: FloatArray,
    *,
    mean_kpa: float,
    counted: BoolArray | None = None,
    touching: BoolArray | None = None,
) -> Contact:
    r"""Contact of a head whose mean pressure over the `counted` squares, touching or not, is `mean_kpa`.

    A square touches when the head has come down by its `height_mm`, whose minimum may be any number. `counted` are the
    taxels of a head with a rim, None for all; `touching`, a neighbouring frame's, is the start.

    With H the stiffness and I the squares off the skin, :math:`p = H(\delta - g + w)`, :math:`p_I = 0`, and
    :math:`w = 0` elsewhere. Wrong signs are changed by block principal pivoting, or one at a time where blocks fail
    (Judice & Pires 1994).
    """
    count = len(height_mm)
    if not mean_kpa > 0:
        if mean_kpa < 0:
            raise BadDataError(f"mean_kpa is {mean_kpa}", way_out="a head can press, not pull: give 0 or more")
        lowest = float(height_mm.min())
        return Contact(np.zeros(count), height_mm - lowest, lowest, np.zeros(count, dtype=bool))
    share = np.full(count, 1.0 / count) if counted is None else counted / np.count_nonzero(counted)
    # one column for a unit of depth, one for the head's shape
    held = stiffness.times(np.stack([np.ones(count), -height_mm], axis=-1))
    guess = touching if touching is not None and (touching & (share > 0)).any() else np.ones(count, dtype=bool)
    fewest, patience = count + 1, _PATIENCE

    def solved(touching: BoolArray) -> tuple[Contact, BoolArray]:
        """Contact of exactly the `touching` squares, and a mask of the wrong signs of pressure or gap."""
        off = np.flatnonzero(~touching)
        pressure, gap = held, np.zeros((count, 2))
        if len(off):
            columns = stiffness.columns(off)
            gap[off] = -np.linalg.solve(columns[off], held[off])
            pressure = held + columns @ gap[off]
            pressure[off] = 0.0
        by_depth, by_shape = share @ pressure
        depth = (mean_kpa - by_shape) / by_depth
        kpa, mm = (depth * both[:, 0] + both[:, 1] for both in (pressure, gap))
        wrong = np.where(touching, kpa < -_TOLERANCE * mean_kpa, mm < -_TOLERANCE * max(abs(depth), 1e-300))
        return Contact(kpa, mm, float(depth), touching), wrong

    for _ in range(_MOST_STEPS):
        contact, wrong = solved(guess)
        wrong_count = int(np.count_nonzero(wrong))
        if wrong_count == 0:
            return contact
        patience = _PATIENCE if wrong_count < fewest else patience - 1
        fewest = min(fewest, wrong_count)
        guess = guess ^ (wrong if patience > 0 else np.arange(count) == np.flatnonzero(wrong)[-1])
        if not (guess & (share > 0)).any():
            guess[int(np.argmin(np.where(share > 0, height_mm, np.inf)))] = True
    figures = {"wrong_signs": float(fewest)}
    raise NotConvergedError("the contact between head and skin did not converge", diagnostics=figures)
