"""The inner loops' two engines, numpy and compiled, which give the same bits, and the choice of one."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, Final, Protocol

import numpy as np

from tactile_bayes.errors import UsageError, check_choice
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping import loops
from tactile_bayes.mapping.cells import LIMIT_STEPS, READINGS_PER_CALL, VALUE_STEP, CellSums
from tactile_bayes.mapping.project import Projection
from tactile_bayes.mapping.readout import BoolArray, Readout
from tactile_bayes.presets import PRESSURE_RANGE_KPA
from tactile_bayes.scan import CountArray

ENGINES: Final = ("auto", "numpy", "fast")
# Starting the compiler costs 1 s of CPU or more, and each reading saves 5 ns or so (`make bench-map`).
WORTH_COMPILING_READINGS = 250_000_000
_FAST_FRAMES = 4096


class Engine(Protocol):
    """Interface of an engine."""

    def chunk_frames(self, taxels: int) -> int:
        """Number of frames that one call should have."""
        ...

    def levels(self, readout: Readout, counts: CountArray) -> tuple[FloatArray, FloatArray]:
        """Level in kPa and valid share of (f, k) counts; see `Readout.levels`."""
        ...

    def add(
        self, sums: CellSums, readout: Readout, counts: CountArray, *, projection: Projection, level: FloatArray
    ) -> None:
        """Add (f, k) counts, each over its frame's `level`, to the cells where `projection` puts them."""
        ...


class NumpyEngine:
    """The core path: whole-array operations on chunks that stay in the processor's cache."""

    def __init__(self) -> None:
        # Pressures of the last chunk whose levels were asked for: most often it is added next.
        self._last: tuple[CountArray, FloatArray, BoolArray | None] | None = None

    def chunk_frames(self, taxels: int) -> int:
        """Frames per call whose sums are exact."""
        return max(1, min(128, READINGS_PER_CALL // max(1, taxels)))

    def levels(self, readout: Readout, counts: CountArray) -> tuple[FloatArray, FloatArray]:
        """Level in kPa and valid share of each frame."""
        pressure, valid = readout.pressure_kpa(counts)
        self._last = (counts, pressure, valid)
        return readout.levels(pressure, valid)

    def add(
        self, sums: CellSums, readout: Readout, counts: CountArray, *, projection: Projection, level: FloatArray
    ) -> None:
        """Scatter with `numpy.bincount`."""
        if not counts.size:
            return
        last, self._last = self._last, None
        known = last is not None and last[0] is counts
        steps, valid = (last[1], last[2]) if known and last is not None else readout.pressure_kpa(counts)
        steps *= (1.0 / VALUE_STEP / level)[:, None]
        np.rint(steps, out=steps)
        first, shape = projection.block()
        flat = projection.flat(first, shape)
        bounded = _bounded(readout, level)
        if valid is None:
            sums.add_steps(first, shape, flat, steps, bounded=bounded)
        elif valid.any():
            sums.add_steps(first, shape, flat[valid], steps[valid], bounded=bounded)


class LoopEngine:
    """One fused loop per frame.

    Parameters
    ----------
    levels_loop, scatter_loop
        `tactile_bayes.mapping.loops`, compiled or as they are.
    """

    def __init__(self, levels_loop: Callable[..., Any], scatter_loop: Callable[..., Any]) -> None:
        self._levels, self._scatter = levels_loop, scatter_loop

    def chunk_frames(self, taxels: int) -> int:
        """Frames per call: many against the cost of a call, few enough for the packed sums."""
        return max(1, min(_FAST_FRAMES, 2**21 // max(1, taxels)))

    def levels(self, readout: Readout, counts: CountArray) -> tuple[FloatArray, FloatArray]:
        """Level in kPa and valid share of each frame."""
        total, number = np.zeros(len(counts)), np.zeros(len(counts), dtype=np.int64)
        self._levels(counts, *_calibration(readout), total, number)
        level = np.full(len(counts), np.nan)
        np.divide(total, number, out=level, where=number > 0)
        return level, number / readout.size

    def add(
        self, sums: CellSums, readout: Readout, counts: CountArray, *, projection: Projection, level: FloatArray
    ) -> None:
        """Scatter reading by reading."""
        if not counts.size:
            return
        first, shape = projection.block()
        place = projection.moved(-np.array(first[::-1], dtype=np.float64))
        cells = np.zeros((shape[0] * shape[1] + 1, 2), dtype=np.int64)
        clipped, negative = self._scatter(
            counts,
            *_calibration(readout),
            1.0 / VALUE_STEP / level,
            LIMIT_STEPS,
            readout.plain_count if _bounded(readout, level) else -1,
            place.taxels.place_mm,
            place.matrix,
            np.int32(shape[1]),
            cells,
        )
        sums.clipped += int(clipped)
        sums.negative += int(negative)
        packed, square = cells[:-1, 0].reshape(shape), cells[:-1, 1].reshape(shape)
        count = (packed + (1 << (loops.PACK_BITS - 1))) >> loops.PACK_BITS
        sums.add_block(first, count, packed - (count << loops.PACK_BITS), square)


def _calibration(readout: Readout) -> tuple[FloatArray, FloatArray, int, float]:
    return readout.gain_kpa, readout.offset_kpa, readout.full_count, PRESSURE_RANGE_KPA[1]


def _bounded(readout: Readout, level: FloatArray) -> bool:
    """Whether no valid reading over its frame's level can be negative or exceed what cells hold.

    Valid readings lie below the sensor's range; then nobody has to look at each.
    """
    return readout.never_negative and PRESSURE_RANGE_KPA[1] / VALUE_STEP < LIMIT_STEPS * float(level.min())


def fast_is_installed() -> bool:
    """Whether the extra ``[fast]`` is installed."""
    return find_spec("numba") is not None


@cache
def compiled_engine() -> Engine:
    """The loops compiled by numba; the machine code is cached on disk beside them where possible."""
    import numba

    # The sum of a frame may be taken in any order, because it has no rounding; nothing else may.
    levels = numba.njit(nogil=True, cache=True, fastmath={"reassoc", "nsz"})(loops.levels_loop)
    scatter = numba.njit(nogil=True, cache=True)(loops.scatter_loop)
    return LoopEngine(levels, scatter)


def choose_engine(name: str, *, readings: int) -> Engine:
    """Choose the engine called `name`; ``"auto"`` compiles when the job is long enough to repay it.

    Parameters
    ----------
    readings
        How many the job will read, all passes together.

    Raises
    ------
    UsageError
        When ``"fast"`` is asked for and not installed.
    """
    check_choice("engine", name, ENGINES)
    if name == "fast" and not fast_is_installed():
        raise UsageError("the fast engine is not installed; pip install 'tactile-bayes[fast]', or use numpy")
    if name == "fast" or (name == "auto" and readings >= WORTH_COMPILING_READINGS and fast_is_installed()):
        return compiled_engine()
    return NumpyEngine()
