"""Conversion of counts to pressures in whole multiples of a tiny step, so that sums have no rounding error."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import PRESSURE_RANGE_KPA
from tactile_bayes.scan import CountArray, ElementCalibration

BoolArray = NDArray[np.bool_]

# Gains and offsets are rounded to this (kPa): 6e-11. Counts below 2^16 times such a gain, plus such an offset, and the
# sum of a thousand of them fit float64 exactly, so a frame's level does not depend on who adds it up and how.
PRESSURE_STEP_KPA = 2.0**-34


@dataclass(frozen=True, slots=True, eq=False)
class Readout:
    """The taxels used, and the conversion of their counts to pressures.

    Parameters
    ----------
    taxels : (k,) int array
        Flat indices of the used taxels, rising.
    size
        Taxels of the whole array.
    gain_kpa, offset_kpa : (k,) arrays
        On the grid of `PRESSURE_STEP_KPA`.
    full_count
        Readings at or above it carry no pressure.
    plain_count
        Up to it no taxel is saturated; -1 where that holds for no count.
    never_negative
        Whether no count gives a pressure below 0.
    """

    taxels: NDArray[np.intp]
    size: int
    gain_kpa: FloatArray
    offset_kpa: FloatArray
    full_count: int
    plain_count: int = field(init=False)
    never_negative: bool = field(init=False)
    _ones: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        used = self.gain_kpa > 0
        room = (PRESSURE_RANGE_KPA[1] - self.offset_kpa[used]) / self.gain_kpa[used]
        plain = min(float(room.min(initial=np.inf)) - 1, self.full_count - 1, 65535)
        sound = bool((self.offset_kpa < PRESSURE_RANGE_KPA[1]).all())
        object.__setattr__(self, "plain_count", int(max(plain, -1)) if sound else -1)
        object.__setattr__(self, "_ones", np.ones(len(self.taxels)))
        object.__setattr__(self, "never_negative", bool(self.offset_kpa.min(initial=0.0) >= 0))

    @classmethod
    def of(cls, calibration: ElementCalibration, good: BoolArray) -> Readout:
        """Prepare for the good taxels of an array."""
        gain, offset = (
            np.rint(values[good] / PRESSURE_STEP_KPA) * PRESSURE_STEP_KPA
            for values in (calibration.gain_kpa_per_count, calibration.offset_kpa)
        )
        return cls(np.flatnonzero(good), good.size, gain, offset, calibration.saturation_count)

    def counts(self, counts: CountArray) -> CountArray:
        """(f, k) contiguous counts of the used taxels from (f, rows, columns)."""
        flat = counts.reshape(len(counts), -1)
        return np.ascontiguousarray(flat if len(self.taxels) == self.size else flat[:, self.taxels])

    def pressure_kpa(self, counts: CountArray) -> tuple[FloatArray, BoolArray | None]:
        """Pressures (f, k) of (f, k) counts, and which of them are valid; None where all are.

        A saturated reading (full count, or the sensor's 34 kPa) is invalid.
        """
        pressure = np.multiply(counts, self.gain_kpa, dtype=np.float64)
        pressure += self.offset_kpa
        if not counts.size or int(counts.max()) <= self.plain_count:
            return pressure, None
        valid = (counts < self.full_count) & (pressure < PRESSURE_RANGE_KPA[1])
        return pressure, None if valid.all() else valid

    def levels(self, pressure: FloatArray, valid: BoolArray | None) -> tuple[FloatArray, FloatArray]:
        """Mean over the valid taxels (n,), NaN without any, and the share of the whole array that is valid (n,)."""
        # Sums of whole steps: any order of adding gives the same bits, so a matrix product may do it.
        if valid is None and len(self.taxels):
            share = np.full(len(pressure), len(self.taxels) / self.size)
            return pressure @ self._ones / len(self.taxels), share
        valid = np.ones(pressure.shape, dtype=bool) if valid is None else valid
        number = valid.sum(axis=1)
        total = np.where(valid, pressure, 0.0) @ self._ones
        level = np.full(len(total), np.nan)
        np.divide(total, number, out=level, where=number > 0)
        return level, number / self.size
