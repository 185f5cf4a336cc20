"""Frames added to the cells of a map, in chunks that stay in the processor's cache."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import (
    LIMIT_STEPS,
    READINGS_PER_CALL,
    VALUE_STEP,
    BoolArray,
    CellSums,
    Projection,
    Readout,
)
from tactile_bayes.presets import PRESSURE_RANGE_KPA


def chunk_frames(taxels: int) -> int:
    """Frames per call whose sums are exact."""
    return max(1, min(128, READINGS_PER_CALL // max(1, taxels)))


def add_frames(
    sums: CellSums,
    readout: Readout,
    pressure_kpa: FloatArray,
    valid: BoolArray | None,
    *,
    projection: Projection,
    level: FloatArray,
) -> None:
    """Add the valid ones of (f, k) pressures, each over its frame's `level`, to the cells where `projection` puts them.

    `pressure_kpa` and `valid` are as of `Readout.pressure_kpa`; the pressures are overwritten.
    """
    if not pressure_kpa.size:
        return
    steps = pressure_kpa
    steps *= (1.0 / VALUE_STEP / level)[:, None]
    np.rint(steps, out=steps)
    first, shape = projection.block()
    flat = projection.flat(first, shape)
    bounded = _bounded(readout, level)
    if valid is None:
        sums.add_steps(first, shape, flat, steps, bounded=bounded)
    elif valid.any():
        sums.add_steps(first, shape, flat[valid], steps[valid], bounded=bounded)


def _bounded(readout: Readout, level: FloatArray) -> bool:
    """Whether no valid reading over its frame's level can be negative or exceed what cells hold.

    Valid readings lie below the sensor's range; then nobody has to look at each.
    """
    return readout.never_negative and PRESSURE_RANGE_KPA[1] / VALUE_STEP < LIMIT_STEPS * float(level.min())
