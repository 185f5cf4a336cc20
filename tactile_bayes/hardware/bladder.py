"""Calibration of a scan head on a bladder, and the sense of its rotation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, rotation_from_quaternion
from tactile_bayes.hardware.readings import CountArray
from tactile_bayes.scans import ElementCalibration

# --- Calibration of an array by a pressure bladder: steps of uniform pressure give each taxel's gain and offset.

# A taxel whose counts rise by less than this share of the median taxel's is dead, by more than this many times hot.
DEAD_SHARE: Final = 0.1
HOT_RATIO: Final = 2.5
MIN_FRAMES: Final = 10
# With fewer steps a curvature fits the noise.
STEPS_FOR_CURVATURE: Final = 4


class BladderStep(Record, eq=False):
    """Mean counts of the array under one known pressure."""

    pressure_kpa: float  #: Of the bladder.
    counts: FloatArray  #: (rows, columns) array: Mean over the frames.
    saturated: NDArray[np.bool_]
    """(rows, columns) bool array: Taxels that reached full scale in any frame."""

    @classmethod
    def of(cls, pressure_kpa: float, frames: CountArray, *, saturation_count: int) -> BladderStep:
        """Average the frames of a step."""
        if not np.isfinite(pressure_kpa) or pressure_kpa < 0:
            raise BadDataError(f"a step of {pressure_kpa} kPa", way_out="give the bladder's pressure, 0 or more")
        if len(frames) < MIN_FRAMES:
            raise BadDataError(
                f"the step of {pressure_kpa:g} kPa has {len(frames)} frames", way_out=f"record {MIN_FRAMES} or more"
            )
        saturated: NDArray[np.bool_] = np.asarray((frames >= saturation_count).any(axis=0))
        return cls(float(pressure_kpa), frames.mean(axis=0), saturated)


class ArrayFit(Record, eq=False):
    """The fit of each taxel."""

    calibration: ElementCalibration
    """Pressure = gain x counts + offset, which is what maps use; gain 0 for dead and hot taxels."""
    curvature_kpa_per_count2: FloatArray
    """(rows, columns) array: Of a parabola through the same steps; 0 where there are too few. Maps do not use it: it
    tells how far the straight line is from enough.
    """
    dead: tuple[tuple[int, int], ...]
    hot: tuple[tuple[int, int], ...]
    """`dead`, `hot`: (row, column) of taxels that hardly answer, or far too much."""
    nonuniformity: FloatArray
    """(steps,) array: Standard deviation over the good taxels of the calibrated pressure, as a share of the step's (NaN
    at 0).
    """
    curved_nonuniformity: FloatArray  #: (steps,) array: The same with the parabolas.
    pressure_kpa: FloatArray  #: (steps,) array: Rising.


def fit_array(steps: Sequence[BladderStep], *, saturation_count: int) -> ArrayFit:
    """Fit a line (and a parabola) of pressure on counts for each taxel by least squares.

    Steps at which a taxel is saturated are left out for it.
    """
    ordered = sorted(steps, key=lambda step: step.pressure_kpa)
    pressure = np.array([step.pressure_kpa for step in ordered])
    if len(np.unique(pressure)) < 2:
        raise BadDataError("there are fewer than two different pressures", way_out="give two steps or more")
    counts = np.array([step.counts for step in ordered])
    valid = ~np.array([step.saturated for step in ordered])
    dead, hot = _odd_taxels(pressure, counts, valid)
    good = ~(dead | hot)
    line = _polynomials(pressure, counts, valid & good, degree=1)
    curve = _polynomials(pressure, counts, valid & good, degree=2) if len(steps) >= STEPS_FOR_CURVATURE else None
    gain, offset = line[1], line[0]
    if (gain[good] < 0).any():
        row, column = (int(i) for i in np.argwhere(good & (gain < 0))[0])
        raise BadDataError(
            f"row {row} column {column} reads less under more pressure", way_out="check the steps' pressures"
        )
    return ArrayFit(
        calibration=ElementCalibration(gain, offset, saturation_count=saturation_count),
        curvature_kpa_per_count2=np.zeros(gain.shape) if curve is None else curve[2],
        dead=_places(dead),
        hot=_places(hot),
        nonuniformity=_nonuniformity(line, pressure, counts, valid & good),
        curved_nonuniformity=_nonuniformity(line if curve is None else curve, pressure, counts, valid & good),
        pressure_kpa=pressure,
    )


def _odd_taxels(
    pressure: FloatArray, counts: FloatArray, valid: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Dead taxels and hot taxels, by the rise of their counts."""
    weight = valid.astype(np.float64)
    number = np.maximum(weight.sum(axis=0), 1)
    x = pressure[:, None, None] - (weight * pressure[:, None, None]).sum(axis=0) / number
    spread = (weight * x * x).sum(axis=0)
    rise = (weight * x * counts).sum(axis=0) / np.where(spread > 0, spread, 1.0)
    enough = (valid.sum(axis=0) >= 2) & (spread > 0)
    if not enough.any() or not (typical := float(np.median(rise[enough]))) > 0:
        raise BadDataError("the array does not answer to pressure", way_out="check its cable and the bladder")
    dead = ~(rise > DEAD_SHARE * typical) & enough
    hot = (rise > HOT_RATIO * typical) | ~enough  # saturated in all steps but one
    return dead, hot & ~dead


def _polynomials(pressure: FloatArray, counts: FloatArray, use: NDArray[np.bool_], *, degree: int) -> FloatArray:
    """(degree + 1, rows, columns) coefficients of pressure in counts, lowest first; zero where nothing is used."""
    result = np.zeros((degree + 1, *counts.shape[1:]))
    for row, column in np.argwhere(use.sum(axis=0) >= 2):
        chosen = use[:, row, column]
        order = min(degree, int(chosen.sum()) - 1)
        c, scale = counts[chosen, row, column], float(counts[chosen, row, column].max()) or 1.0
        matrix = np.vander(c / scale, order + 1, increasing=True)
        fitted = np.linalg.lstsq(matrix, pressure[chosen], rcond=None)[0]
        result[: order + 1, row, column] = fitted / scale ** np.arange(order + 1)
    return result


def _nonuniformity(
    coefficients: FloatArray, pressure: FloatArray, counts: FloatArray, use: NDArray[np.bool_]
) -> FloatArray:
    powers = np.arange(len(coefficients))[:, None, None]
    found = np.full(len(pressure), np.nan)
    for i, (step, chosen) in enumerate(zip(counts, use, strict=True)):
        if pressure[i] > 0 and chosen.sum() > 1:
            kpa = (coefficients * step**powers).sum(axis=0)[chosen]
            found[i] = float(kpa.std(ddof=1)) / pressure[i]
    return found


def _places(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    return tuple((int(row), int(column)) for row, column in np.argwhere(mask))


# --- Test of a tracker's rotation convention (sensor to base, or inverse) by turning it about a fixed point.

LEAST_TURN_DEG: Final = 20.0
# How many times worse the wrong sense must fit before the right one is believed.
CLEAR: Final = 3.0


class RotationSense(Record):
    """Fit of a fixed point under each sense of rotation, and the angle that the sensor was turned by."""

    as_given_mm: float
    inverted_mm: float
    """`as_given_mm`, `inverted_mm`: Root mean square distance of the point from its mean."""
    turn_deg: float  #: Largest rotation between two poses.

    def __str__(self) -> str:
        figures = f"the point stays within {self.as_given_mm:.2f} mm as given, {self.inverted_mm:.2f} mm inverted"
        if self.inverted_mm > CLEAR * self.as_given_mm:
            return f"{figures}: record as it is"
        if self.as_given_mm > CLEAR * self.inverted_mm:
            return f"{figures}: record with --invert-rotation"
        return f"{figures}: not clear; hold the point fixed and turn further, about two axes"


def rotation_sense(position_mm: FloatArray, quaternion_wxyz: FloatArray) -> RotationSense:
    """Fit a point that is fixed both in `base` and on the sensor, with the (n, 4) rotations as given and inverted.

    The point is at t on the sensor and at c in `base` with ``p + R t = c`` for every pose: six unknowns, least squares.
    Both fit a sensor that was hardly turned, which is refused.
    """
    if len(position_mm) < 10:
        raise BadDataError(f"{len(position_mm)} poses are too few", way_out="turn the sensor for some seconds")
    rotation = rotation_from_quaternion(quaternion_wxyz)
    traces = np.einsum("nij,ij->n", rotation, rotation[0])
    turn = float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max()))
    if turn < LEAST_TURN_DEG:
        raise BadDataError(
            f"the sensor was turned by {turn:.0f} degrees only", way_out=f"turn it by {LEAST_TURN_DEG:g} or more"
        )
    inverse = rotation.transpose(0, 2, 1)
    return RotationSense(_spread_mm(position_mm, rotation), _spread_mm(position_mm, inverse), turn)


def _spread_mm(position_mm: FloatArray, rotation: FloatArray) -> float:
    minus = np.broadcast_to(-np.eye(3), rotation.shape)
    matrix = np.concatenate([rotation, minus], axis=2).reshape(-1, 6)
    wanted = -position_mm.reshape(-1)
    solution = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    rest = (matrix @ solution - wanted).reshape(-1, 3)
    return float(np.sqrt((rest**2).sum(axis=1).mean()))
