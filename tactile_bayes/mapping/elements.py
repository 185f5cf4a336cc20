"""Detection of faulty taxels over a whole scan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.scan import Scan

# A taxel that reads this share of its row's and column's level, or less, is dead (its cable picks up noise only).
DEAD_SHARE = 0.1
# One that reads this many times its row's and column's level is hot; so is one that flickers this much more than most.
HOT_RATIO = 2.0
FLICKER_RATIO = 10.0
FLICKER_KPA = 1.0
# One that is saturated in a larger share of the frames is left out of all of them.
SATURATED_SHARE = 0.1
# Fewer frames than this say nothing about what never changes.
MIN_FRAMES = 10
# One that repeats its last count in a larger share of the frames, where most do so in less than half of that, is stuck.
STILL_SHARE = 0.5
# Below this level (kPa) the head is in the air, and a low reading is no fault.
CONTACT_KPA = 1.0
_CHUNK = 512


class TaxelFault(NamedTuple):
    """One taxel that is left out, and why: ``"dead"``, ``"stuck"``, ``"hot"`` or ``"saturated"``."""

    row: int
    column: int
    fault: str

    def __str__(self) -> str:
        return f"row {self.row} column {self.column} {self.fault}"


class _Levels(NamedTuple):
    """Statistics of each taxel's counts over a scan; (rows, columns) arrays."""

    lowest: NDArray[np.uint16]
    highest: NDArray[np.uint16]
    mean_kpa: FloatArray
    flicker_kpa: FloatArray
    still_share: FloatArray
    saturated_share: FloatArray


def find_faults(scan: Scan) -> tuple[TaxelFault, ...]:
    """Find the taxels to leave out of every frame of `scan`, in row order.

    - dead: gain 0, or never anything but one count while the level is next to nothing, or a level below a tenth of
      both its row's and its column's median;
    - stuck: one count throughout, while most taxels change; or one that repeats its last count in over half of the
      frames, while most hardly ever do (it sticks for a time and comes back);
    - hot: over twice the level of its row and column, or flickering over ten times as much as most;
    - saturated: full scale in over a tenth of the frames.

    A level is compared along the row *and* the column, so that an edge that bears less is no fault.
    """
    if not len(scan.frames):
        return ()
    levels = _levels(scan)
    faults = _classify(scan, levels)
    return tuple(
        TaxelFault(int(row), int(column), str(faults[row, column])) for row, column in np.argwhere(faults != "")
    )


def _classify(scan: Scan, levels: _Levels) -> NDArray[np.str_]:
    """(rows, columns) fault of each taxel, "" for a good one."""
    mean = levels.mean_kpa
    usual = float(np.median(mean))
    low, high = _neighbour_levels(mean)
    constant = (levels.highest == levels.lowest) & (len(scan.frames) >= MIN_FRAMES)
    moving = bool(np.median(levels.highest - levels.lowest) > 0)
    empty = constant & ((levels.highest == 0) | (mean <= DEAD_SHARE * usual))
    weak = (mean < DEAD_SHARE * low) & (low > CONTACT_KPA)
    flicker = (levels.flicker_kpa > FLICKER_RATIO * np.median(levels.flicker_kpa)) & (levels.flicker_kpa > FLICKER_KPA)
    faults = np.full(mean.shape, "", dtype="<U9")
    faults[((mean > HOT_RATIO * high) & (mean > usual + CONTACT_KPA)) | flicker] = "hot"
    sticks = (levels.still_share > STILL_SHARE) & bool(np.median(levels.still_share) < STILL_SHARE / 2)
    faults[(constant & moving) | (sticks & (len(scan.frames) >= MIN_FRAMES))] = "stuck"
    faults[levels.saturated_share > SATURATED_SHARE] = "saturated"
    faults[(scan.element_calibration.gain_kpa_per_count == 0) | empty | weak] = "dead"
    return faults


def _neighbour_levels(mean_kpa: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The lower and the higher of each taxel's row median and column median."""
    rows = np.median(mean_kpa, axis=1)[:, None]
    columns = np.median(mean_kpa, axis=0)[None, :]
    return np.minimum(rows, columns), np.maximum(rows, columns)


def _levels(scan: Scan) -> _Levels:
    """Compute the statistics in one pass over the counts."""
    counts, calibration = scan.frames.counts, scan.element_calibration
    total = np.zeros(counts.shape[1:])
    steps, still = np.zeros(counts.shape[1:]), np.zeros(counts.shape[1:])
    saturated = np.zeros(counts.shape[1:], dtype=np.int64)
    last = counts[:1].astype(np.float64)
    for start in range(0, len(counts), _CHUNK):
        chunk = counts[start : start + _CHUNK].astype(np.float64)
        total += chunk.sum(axis=0)
        change = np.abs(np.diff(chunk, axis=0, prepend=last))
        steps += change.sum(axis=0)  # not squared: one spike is no flicker
        still += (change == 0).sum(axis=0)
        saturated += (chunk >= calibration.saturation_count).sum(axis=0)
        last = chunk[-1:]
    n = len(counts)
    return _Levels(
        counts.min(axis=0),
        counts.max(axis=0),
        calibration.gain_kpa_per_count * (total / n) + calibration.offset_kpa,
        calibration.gain_kpa_per_count * (steps / max(n - 1, 1)),
        (still - 1) / max(n - 1, 1),  # the first frame was compared with itself
        saturated / n,
    )
