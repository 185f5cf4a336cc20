r"""Effects of seat, soft lumps, thickness and head on Eq 6's size, from a study that varies them.

To first order about Eq 6 as it is learned, :math:`\theta`, with residuals :math:`r_i` of ln d,

.. math:: r_i = J_i\,\delta\theta + z_i^T\gamma + \epsilon_i, \quad
          J_i = \partial \ln d_i / \partial(\ln m, b, f),

by least squares weighted with the learned scatter. m, b and f may move, because what varies changes amplitude and width
as well; :math:`\gamma` is what is left to say when the map is known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import LEAST_HARD_RATIO
from tactile_bayes.size.eq6 import AxisCalibration
from tactile_bayes.size.learn.eq6 import AxisRows, SizeTable, StudyCases, axis_at_mode

LEAST_ROWS = 12
TRANSFORMS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "seat": lambda seat: seat,
    "stiffness_ratio": lambda ratio: np.asarray(np.minimum(np.log(ratio / LEAST_HARD_RATIO), 0.0)),
    "thickness_mm": lambda thickness: np.asarray(np.log(thickness)),
    "head_radius_mm": lambda radius: np.asarray(np.log(radius)),
}
"""How each enters: the seat as it is, the others by their logarithm; lumps are alike in stiffness from E2/E1 = 8 on."""


@dataclass(frozen=True, slots=True)
class SizeTerm:
    """Effect of one property on the size at equal amplitude and width.

    Parameters
    ----------
    name
        As in `TRANSFORMS`.
    coefficient, standard_error
        Of the transformed property in ln d, with all of them in; the error allows for what cases of one d and h/d
        share.
    low, high
        Range in the table; the stiffness' ends at 8.
    share
        Of the residual variance of ln d, what goes when this alone is known.
    """

    name: str
    coefficient: float
    standard_error: float
    low: float
    high: float
    share: float

    @property
    def change(self) -> float:
        """Change of d from `low` to `high`, as a share."""
        ends = TRANSFORMS[self.name](np.array([self.low, self.high]))
        return float(np.expm1(self.coefficient * (ends[1] - ends[0])))


@dataclass(frozen=True, slots=True)
class SizeTerms:
    """Effects for one axis of the head.

    Parameters
    ----------
    terms
        Of what varies in the table.
    scatter, scatter_left
        Residual standard deviation of ln d without them and with all, at the table's middle amplitude.
    """

    terms: tuple[SizeTerm, ...]
    scatter: float
    scatter_left: float


def size_terms(table: SizeTable) -> dict[str, SizeTerms]:
    """Effects by axis: ``"x"`` across the head, ``"y"`` along it; empty where nothing varies or rows are few."""
    rising = table.amplitude > 0
    if table.cases is None or rising.sum() < LEAST_ROWS:
        return {}
    cases, d_mm, amplitude = table.cases.rows(rising), table.d_mm[rising], table.amplitude[rising]
    varied = _varied(cases)
    if not varied:
        return {}
    widths = {"x": (table.sigma_x_mm, table.width_change_x), "y": (table.sigma_y_mm, table.width_change_y)}
    lump = np.unique(np.stack([d_mm, cases.depth_ratio]), axis=1, return_inverse=True)[1].ravel()
    found = {}
    for name, (sigma, change) in widths.items():
        if sigma is not None:
            rows = AxisRows(d_mm, amplitude, sigma[rising], None if change is None else change[rising])
            try:
                found[name] = _terms(rows, axis_at_mode(rows), varied, lump)
            except NotConvergedError:
                continue
    return found


def _varied(cases: StudyCases) -> dict[str, FloatArray]:
    """Properties that vary enough between rows, as columns."""
    told = {**cases.others, "stiffness_ratio": cases.stiffness_ratio}
    if "seat_number" in told:
        told["seat"] = told["seat_number"]
    return {name: told[name] for name, how in TRANSFORMS.items() if name in told and np.ptp(how(told[name])) > 1e-9}


def _terms(
    rows: AxisRows,
    axis: AxisCalibration,
    varied: Mapping[str, FloatArray],
    lump: np.ndarray[tuple[int], np.dtype[np.intp]],
) -> SizeTerms:
    size = axis.size_mm(rows.sigma_mm, rows.amplitude)
    weight = (rows.amplitude / axis.reference_amplitude) ** axis.draws[0, 5]
    slopes = _slopes(axis, rows, size) * weight[:, None]
    residual = np.log(rows.d_mm / size) * weight
    terms = np.stack([TRANSFORMS[name](values) for name, values in varied.items()], axis=1) * weight[:, None]
    without = _left(slopes, residual)
    design = np.concatenate([slopes, terms], axis=1)
    coefficients = np.linalg.lstsq(design, residual, rcond=None)[0]
    left = residual - design @ coefficients
    errors = np.sqrt(np.diag(_covariance(design, left, lump)))
    made = []
    for i, (name, values) in enumerate(varied.items()):
        alone = _left(np.concatenate([slopes, terms[:, i : i + 1]], axis=1), residual)
        high = min(float(values.max()), LEAST_HARD_RATIO) if name == "stiffness_ratio" else float(values.max())
        made.append(
            SizeTerm(
                name,
                float(coefficients[slopes.shape[1] + i]),
                float(errors[slopes.shape[1] + i]),
                float(values.min()),
                high,
                1.0 - float(np.mean(alone**2) / np.mean(without**2)),
            )
        )
    return SizeTerms(tuple(made), float(np.sqrt(np.mean(without**2))), float(np.sqrt(np.mean(left**2))))


def _slopes(axis: AxisCalibration, rows: AxisRows, size_mm: FloatArray) -> FloatArray:
    """(n, 3) derivatives of ln d by Eq 6 for ln m, b and f."""
    steep = 1.0 - axis.draws[0, 1] / size_mm
    return np.stack([steep, 1.0 / size_mm, -steep * np.log(rows.amplitude / axis.reference_amplitude)], axis=1)


def _left(design: FloatArray, values: FloatArray) -> FloatArray:
    return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])


def _covariance(design: FloatArray, left: FloatArray, lump: np.ndarray[tuple[int], np.dtype[np.intp]]) -> FloatArray:
    """Covariance of the coefficients, with any correlation of residuals within a lump.

    Notes
    -----
    Liang & Zeger (1986), with the usual factor for few groups.
    """
    groups = int(lump.max()) + 1
    inverse = np.linalg.pinv(design.T @ design)
    scores = np.zeros((groups, design.shape[1]))
    np.add.at(scores, lump, design * left[:, None])
    n, p = design.shape
    factor = groups / max(groups - 1, 1) * (n - 1) / max(n - p, 1)
    return np.asarray(factor * inverse @ (scores.T @ scores) @ inverse)
