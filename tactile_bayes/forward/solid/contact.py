"""Frictionless contact of a rigid head with an elastic body under a given force: pressures on the taxels.

Pressure is constant over each taxel. A taxel bears pressure where it touches, and is free where there is a gap:
``p >= 0``, ``gap >= 0``, ``p gap = 0``. The depth to which the head sinks is what makes the pressures add up to the
force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.geometry import FloatArray

BoolArray = NDArray[np.bool_]
# Pressures and gaps beyond this share of the mean pressure and of the depth count as of the wrong sign.
_TOLERANCE: Final = 1e-11
_MOST_STEPS: Final = 2000
# Steps in which the number of wrong signs may fail to fall before one taxel at a time is changed.
_PATIENCE: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The solved contact of a head.

    Parameters
    ----------
    pressure_kpa : (n,) array
        Of each taxel; 0 where it does not touch.
    gap_mm : (n,) array
        Between each taxel and the skin; 0 where it touches.
    depth_mm
        Of the head's highest point of `height_mm` 0 below the undisturbed skin.
    touching : (n,) array of bool
    """

    pressure_kpa: FloatArray
    gap_mm: FloatArray
    depth_mm: float
    touching: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class ContactStiffness:
    r"""Inverse of a compliance that is a fixed matrix less a low-rank change.

    Parameters
    ----------
    plain : (n, n) array
        Inverse of the compliance without the change, kPa / mm.
    factor : (n, k) array
    core : (k, k) array
        The stiffness is ``plain + factor @ core @ factor.T``.
    """

    plain: FloatArray
    factor: FloatArray
    core: FloatArray

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
        r"""Stiffness after ``vectors @ diag(signs) @ vectors.T`` is added to the compliance.

        Parameters
        ----------
        vectors : (n, k) array
            In mm^(1/2) kPa^(-1/2).
        signs : (k,) array
            1 or -1.

        Notes
        -----
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
        product: FloatArray = self.plain @ right + self.factor @ (self.core @ (self.factor.T @ right))
        return product

    def columns(self, chosen: NDArray[np.intp]) -> FloatArray:
        """(n, c) columns of the stiffness."""
        picked: FloatArray = self.plain[:, chosen] + self.factor @ (self.core @ self.factor[chosen].T)
        return picked


def press(
    stiffness: ContactStiffness,
    height_mm: FloatArray,
    *,
    mean_kpa: float,
    counted: BoolArray | None = None,
    touching: BoolArray | None = None,
) -> Contact:
    r"""Press a head on the body until its mean pressure is `mean_kpa`.

    Parameters
    ----------
    stiffness
        Of the skin under the taxels.
    height_mm : (n,) array
        How far each taxel lies above the head's reference point before it touches; its minimum may be any number.
    mean_kpa
        Force over the area of the counted squares, touching or not.
    counted : (n,) bool array
        Squares whose force is meant: the taxels of a head that also has a rim. None for all.
    touching
        Where to start; a neighbouring frame's saves steps.

    Notes
    -----
    With H the stiffness and I the taxels off the skin, :math:`p = H(\delta - g + w)`, :math:`p_I = 0` and
    :math:`w = 0` elsewhere: a system as large as the part of the head that does not touch. Signs are put right by block
    principal pivoting, with one taxel at a time where blocks fail (Judice & Pires 1994), which ends because the matrix
    is positive definite.
    """
    count = len(height_mm)
    if not mean_kpa > 0:
        if mean_kpa < 0:
            raise BadDataError(f"mean_kpa is {mean_kpa}", way_out="a head can press, not pull: give 0 or more")
        lowest = float(height_mm.min())
        return Contact(np.zeros(count), height_mm - lowest, lowest, np.zeros(count, dtype=bool))
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
) -> tuple[Contact, BoolArray]:
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
    return Contact(kpa, mm, float(depth), touching), wrong
