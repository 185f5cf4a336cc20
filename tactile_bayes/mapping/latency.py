"""How late the tracker is against the array, found from the scan itself: the right delay makes the map sharpest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.cells import VALUE_STEP
from tactile_bayes.mapping.frames import SelectedFrames, chunks
from tactile_bayes.mapping.poses import FramePoses, poses_at
from tactile_bayes.mapping.project import Projection, Projector
from tactile_bayes.mapping.readout import Readout

RANGE_MS = (-50.0, 100.0)
# A latency known no better than this is called undetermined (ms).
MOST_SD_MS = 2.0
# So is one whose minimum stands out by less than this many of its own standard errors.
LEAST_SHARPNESS = 2.0
# Frames looked at: more would add minutes and no accuracy that matters.
MOST_FRAMES = 24_000
_COARSE_STEP_MS, _FINE_STEP_MS, _FINE_STEPS = 10.0, 4.0, 4
_COARSE_EVERY = 4
_BLOCKS = 10
_CHUNK = 128


@dataclass(frozen=True, slots=True)
class LatencyEstimate:
    """By how much the stamps of the poses are late.

    Parameters
    ----------
    latency_ms, sd_ms
        The delay that makes the variance within cells least, and its standard error.
    sharpness
        Curvature of that variance at its minimum, over its own standard error.
    frames
        Frames it was found from.
    """

    latency_ms: float
    sd_ms: float
    sharpness: float
    frames: int


def estimate_latency(
    selections: Sequence[SelectedFrames], *, plane_from_base: FloatArray, cell_mm: float, max_pose_gap_ms: float
) -> LatencyEstimate:
    """Latency at which the readings within a cell agree best.

    Parameters
    ----------
    selections
        The scans, selected with any latency.
    plane_from_base, cell_mm
        The cells; a latency hardly moves the plane.
    max_pose_gap_ms
        As for the map.

    Raises
    ------
    BadDataError
        When the scan does not determine it: without a lump, or without strokes there and back, every delay fits.

    Notes
    -----
    Strokes there and back at speed v show a lump 2 v tau apart, which adds (v tau)^2 times the squared slope to the
    variance within cells: a parabola in tau. Its standard error comes from leaving out a tenth of the scan at a time
    (jackknife). A lump that moves with the head by delta looks like a latency of -delta / v: the excess over what a
    phantom shows on the same instrument is a measure of mobility.
    """
    parts = [
        _Part.of(one, plane_from_base=plane_from_base, cell_mm=cell_mm, gap_ms=max_pose_gap_ms) for one in selections
    ]
    coarse = np.arange(RANGE_MS[0], RANGE_MS[1] + 1e-9, _COARSE_STEP_MS)
    rough = _variances(parts, coarse, every=_COARSE_EVERY).sum(axis=0)
    middle = float(coarse[int(np.argmin(rough))])
    if not RANGE_MS[0] < middle < RANGE_MS[1]:
        raise _undetermined(f"the map grows sharper up to the end of the range, {middle:g} ms")
    for _ in range(3):
        fine = np.asarray(middle + _FINE_STEP_MS * np.arange(-_FINE_STEPS, _FINE_STEPS + 1), dtype=np.float64)
        found = _minimum(fine, _variances(parts, fine, every=1))
        if abs(found.latency_ms - middle) <= _FINE_STEP_MS * _FINE_STEPS / 2:
            break
        middle = float(np.clip(found.latency_ms, middle - 16, middle + 16))
    frames = sum(len(part.frames) for part in parts)
    if not (found.sharpness > LEAST_SHARPNESS and found.sd_ms < MOST_SD_MS):
        raise _undetermined(f"{found.latency_ms:.1f} +- {found.sd_ms:.1f} ms from {frames} frames")
    return LatencyEstimate(found.latency_ms, found.sd_ms, found.sharpness, frames)


def _undetermined(why: str) -> BadDataError:
    return BadDataError(
        f"the scan does not determine the tracker's latency ({why})",
        way_out="scan a phantom lump there and back for 60 s, or give the number of the instrument",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One scan's frames whose pose is known at every latency looked at."""

    selection: SelectedFrames
    readout: Readout
    projector: Projector
    frames: np.ndarray[tuple[int], np.dtype[np.intp]]
    gap_ms: float

    @classmethod
    def of(cls, selection: SelectedFrames, *, plane_from_base: FloatArray, cell_mm: float, gap_ms: float) -> _Part:
        good, scan = selection.good_taxels, selection.scan
        projector = Projector(scan.head, plane_from_base=plane_from_base, taxels=good, cell_mm=cell_mm)
        used = selection.used.copy()
        for edge in RANGE_MS:
            used &= _poses(selection, edge, gap_ms).known
        frames = np.flatnonzero(used)[:MOST_FRAMES]
        return cls(selection, Readout.of(scan.element_calibration, good), projector, frames, gap_ms)

    def at(self, latency_ms: float, frames: np.ndarray[tuple[int], np.dtype[np.intp]]) -> Projection:
        return self.projector.at(_poses(self.selection, latency_ms, self.gap_ms).part(frames))

    def values(self, frames: np.ndarray[tuple[int], np.dtype[np.intp]]) -> FloatArray:
        """(f, k) pressures over the frame's mean; the few saturated readings count as the mean itself."""
        pressure, valid = self.readout.pressure_kpa(self.readout.counts(self.selection.scan.frames.counts[frames]))
        pressure /= self.selection.level_kpa[frames, None]
        return pressure if valid is None else np.where(valid, pressure, 1.0)


def _poses(selection: SelectedFrames, latency_ms: float, gap_ms: float) -> FramePoses:
    scan = selection.scan
    return poses_at(scan.poses, scan.frames.time_s, latency_ms=latency_ms, max_gap_ms=gap_ms)


def _variances(parts: Sequence[_Part], latencies_ms: FloatArray, *, every: int) -> FloatArray:
    """(blocks + 1, latencies) variance within cells: of all frames but one block each, and last of all frames.

    The sum of all squares does not hang on the latency: only what the cells' means explain has to be found.
    """
    chosen = [part.frames[::every] for part in parts]
    if not sum(len(frames) for frames in chosen):
        raise _undetermined("no frame has a pose at every delay")
    layouts = [[part.at(tau, frames) for tau in latencies_ms] for part, frames in zip(parts, chosen, strict=True)]
    blocks = [one.block() for layout in layouts for one in layout if len(one)]
    first = (min(f[0] for f, _ in blocks), min(f[1] for f, _ in blocks))
    shape = (max(f[0] + s[0] for f, s in blocks) - first[0], max(f[1] + s[1] for f, s in blocks) - first[1])
    cells = shape[0] * shape[1]
    count, total = np.zeros((2, _BLOCKS, len(latencies_ms), cells))
    square, readings = np.zeros(_BLOCKS), np.zeros(_BLOCKS)
    length, start = sum(len(frames) for frames in chosen), 0
    for part, frames, layout in zip(parts, chosen, layouts, strict=True):
        for piece in chunks(len(frames), _CHUNK):
            block = min(_BLOCKS - 1, _BLOCKS * start // length)
            value = (np.rint(part.values(frames[piece]) / VALUE_STEP) * VALUE_STEP - 1.0).ravel()
            square[block] += value @ value
            readings[block] += value.size
            for index, projection in enumerate(layout):
                flat = projection.part(piece).flat(first, shape).ravel()
                count[block, index] += np.bincount(flat, minlength=cells)
                total[block, index] += np.bincount(flat, value, cells)
            start += len(frames[piece])
    return np.array([_within(count, total, square, readings, without=block) for block in (*range(_BLOCKS), None)])


def _within(
    count: FloatArray, total: FloatArray, square: FloatArray, readings: FloatArray, *, without: int | None
) -> FloatArray:
    """(latencies,) variance about the cells' means over all blocks but one."""
    kept = np.arange(_BLOCKS) != (-1 if without is None else without)
    n, t = count[kept].sum(axis=0), total[kept].sum(axis=0)
    explained = np.divide(t * t, n, out=np.zeros_like(t), where=n > 0).sum(axis=1)
    variance: FloatArray = (square[kept].sum() - explained) / (readings[kept].sum() - (n > 0).sum(axis=1))
    return variance


def _minimum(latencies_ms: FloatArray, variances: FloatArray) -> LatencyEstimate:
    """Vertex of the parabola through the variances, its standard error, and how sharp it is."""
    centre = float(latencies_ms.mean())
    curvature, slope, _ = np.polyfit(latencies_ms - centre, variances.T, 2)
    vertex = centre - slope / (2 * np.where(curvature == 0, np.inf, curvature))
    spread = np.sqrt((_BLOCKS - 1) / _BLOCKS * ((vertex[:-1] - vertex[:-1].mean()) ** 2).sum())
    about = np.sqrt((_BLOCKS - 1) / _BLOCKS * ((curvature[:-1] - curvature[:-1].mean()) ** 2).sum())
    return LatencyEstimate(float(vertex[-1]), float(spread), float(curvature[-1] / max(about, 1e-300)), 0)
