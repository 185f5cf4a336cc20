"""The two inner loops of map building, written so that a compiler can take them as they are."""

from __future__ import annotations

from typing import Any

import numpy as np

# Count and sum travel as one number: up to 2^21 readings of at most 2^18 steps sum to less than 2^39.
PACK_BITS = 40

# Arrays and numbers of the kinds named in the docstrings; a compiler infers them from the call.
_Any = Any


def levels_loop(counts: _Any, gain: _Any, offset: _Any, full: _Any, top: _Any, total: _Any, number: _Any) -> None:
    """Sum and number of the valid pressures of each frame.

    Parameters
    ----------
    counts : (f, k) uint16
    gain, offset : (k,) float64
        On the grid of `tactile_bayes.mapping.readout.PRESSURE_STEP_KPA`, so that the order of adding is free.
    full, top
        Count and pressure from which a reading is saturated.
    total : (f,) float64, number : (f,) int64
        Filled in.
    """
    for f in range(counts.shape[0]):
        row, sum_kpa, saturated = counts[f], 0.0, np.int64(0)
        for k in range(counts.shape[1]):
            pressure = row[k] * gain[k] + offset[k]
            saturated += np.int32(row[k] >= full) | np.int32(pressure >= top)
            sum_kpa += pressure
        if saturated:  # seldom: not in the loop above, which then runs eight taxels at a time
            for k in range(counts.shape[1]):
                pressure = row[k] * gain[k] + offset[k]
                sum_kpa -= pressure if row[k] >= full or pressure >= top else 0.0
        total[f] = sum_kpa
        number[f] = counts.shape[1] - saturated


def scatter_loop(
    counts: _Any,
    gain: _Any,
    offset: _Any,
    full: _Any,
    top: _Any,
    scale: _Any,
    limit: _Any,
    plain: _Any,
    taxels: _Any,
    matrix: _Any,
    columns: _Any,
    cells: _Any,
) -> tuple[int, int]:
    """Add every valid reading to its cell; return how many were clipped and how many were below 0.

    Parameters
    ----------
    counts, gain, offset, full, top
        See `levels_loop`.
    scale : (f,) float64
        Steps a kPa, frame by frame.
    limit
        Largest value in steps.
    plain
        Frames without a count above it are known to be valid, not negative and within the limit.
    taxels, matrix
        See `tactile_bayes.mapping.project.Projection`; the shift is counted from the block's first cell.
    columns : int32
        Columns of the block.
    cells : (rows x columns + 1, 2) int64
        Count x 2^`PACK_BITS` + sum, and sum of squares, of each cell. Invalid readings go to the last row.
    """
    index, steps = np.empty(counts.shape[1], np.uint32), np.empty(counts.shape[1], np.int32)
    one = np.int64(1) << np.int64(PACK_BITS)
    nowhere, clipped, negative = np.uint32(cells.shape[0] - 1), 0, 0
    for f in range(counts.shape[0]):
        row = counts[f]
        across, along = matrix[f, 0], matrix[f, 1]
        for k in range(counts.shape[1]):
            x, y, z = taxels[0, k], taxels[1, k], taxels[2, k]
            u = across[0] * x + across[1] * y + across[2] * z + across[3]
            v = along[0] * x + along[1] * y + along[2] * z + along[3]
            index[k] = np.uint32(np.int32(v) * columns + np.int32(u))
        highest = row[0]
        for k in range(counts.shape[1]):
            highest = max(highest, row[k])
        if highest <= plain:
            for k in range(counts.shape[1]):
                steps[k] = np.int32(np.rint((row[k] * gain[k] + offset[k]) * scale[f]))
        else:
            for k in range(counts.shape[1]):
                pressure = row[k] * gain[k] + offset[k]
                value = np.rint(pressure * scale[f])
                good = row[k] < full and pressure < top
                index[k] = index[k] if good else nowhere
                clipped += 1 if good and abs(value) > limit else 0
                negative += 1 if good and value < 0 else 0
                steps[k] = np.int32(min(max(value, -limit), limit))
        for k in range(counts.shape[1]):
            i, step = index[k], np.int64(steps[k])
            cells[i, 0] += one + step
            cells[i, 1] += step * step
    return clipped, negative
