"""Selection of the frames that go into a map, and the reasons for leaving others out (paper step ii, the gate)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.elements import TaxelFault, find_faults
from tactile_bayes.mapping.poses import MAX_POSE_GAP_MS, FramePoses, poses_at
from tactile_bayes.mapping.readout import Readout
from tactile_bayes.mapping.scatter import chunk_frames
from tactile_bayes.scan import Scan

BoolArray = NDArray[np.bool_]

# A frame with a smaller share of valid taxels than this is dropped.
VALID_SHARE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class SelectedFrames:
    """A scan with the selection of its frames.

    Parameters
    ----------
    scan
        As recorded.
    faults
        Taxels left out of every frame.
    poses
        Pose of the tracker at each frame.
    level_kpa : (n,) array
        Mean over the valid taxels; NaN where there is none.
    valid_share : (n,) array
        Share of the taxels of the array that are good and not saturated.
    low, high : (n,) bool arrays
        Frames whose level is below or above the window, among those with a pose and enough valid taxels.
    used : (n,) bool array
        Frames that go into the map.
    """

    scan: Scan
    faults: tuple[TaxelFault, ...]
    poses: FramePoses
    level_kpa: FloatArray
    valid_share: FloatArray
    low: BoolArray
    high: BoolArray
    used: BoolArray

    @property
    def dropped_no_pose(self) -> int:
        """Frames without a pose from the tracker."""
        return int((~self.poses.known).sum())

    @property
    def dropped_elements(self) -> int:
        """Frames with a pose and too few valid taxels."""
        return int((self.poses.known & ~(self.valid_share >= VALID_SHARE)).sum())

    @property
    def good_taxels(self) -> BoolArray:
        """(rows, columns) True for taxels that are not left out."""
        return good_taxels(self.scan, self.faults)

    @property
    def used_poses(self) -> FramePoses:
        """Poses of the frames that go into the map."""
        return FramePoses(self.poses.position_mm, self.poses.rotation, self.used)


def good_taxels(scan: Scan, faults: tuple[TaxelFault, ...]) -> BoolArray:
    """(rows, columns) True for taxels without a fault."""
    good = np.ones(scan.head.shape, dtype=bool)
    for fault in faults:
        good[fault.row, fault.column] = False
    return good


def chunks(frames: int, size: int) -> Iterator[slice]:
    """Split into stretches of `size` frames."""
    for start in range(0, frames, size):
        yield slice(start, min(start + size, frames))


def select_frames(
    scan: Scan,
    *,
    pressure_window_kpa: tuple[float, float],
    latency_ms: float = 0.0,
    max_pose_gap_ms: float = MAX_POSE_GAP_MS,
) -> SelectedFrames:
    """Decide for every frame of a scan whether it is used.

    A frame is used when the tracker knew where it was, nine taxels in ten are valid, and the mean over the valid ones
    lies in the window, its ends included.

    Raises
    ------
    BadDataError
        When no taxel works.
    """
    faults = find_faults(scan)
    _refuse_dead(scan, faults)
    poses = poses_at(scan.poses, scan.frames.time_s, latency_ms=latency_ms, max_gap_ms=max_pose_gap_ms)
    level, share = _levels(scan, good_taxels(scan, faults))
    low, high, used = gate(poses.known, level, share, pressure_window_kpa=pressure_window_kpa)
    return SelectedFrames(scan, faults, poses, level, share, low, high, used)


def gate(
    known: BoolArray, level_kpa: FloatArray, valid_share: FloatArray, *, pressure_window_kpa: tuple[float, float]
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Frames below the window, above it and within, ends of the window included."""
    candidate = known & (valid_share >= VALID_SHARE)
    low, high = candidate & (level_kpa < pressure_window_kpa[0]), candidate & (level_kpa > pressure_window_kpa[1])
    return low, high, candidate ^ (low | high)


def _levels(scan: Scan, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Mean over the valid taxels and share of valid taxels of each frame."""
    readout = Readout.of(scan.element_calibration, good)
    level, share = np.full(len(scan.frames), np.nan), np.zeros(len(scan.frames))
    for part in chunks(len(scan.frames), chunk_frames(good.size)):
        counts = readout.counts(scan.frames.counts[part])
        level[part], share[part] = readout.levels(*readout.pressure_kpa(counts))
    return level, share


def _refuse_dead(scan: Scan, faults: tuple[TaxelFault, ...]) -> None:
    taxels = scan.head.shape[0] * scan.head.shape[1]
    if len(faults) < taxels or not taxels:
        return
    kinds = {fault.fault for fault in faults}
    raise BadDataError(
        f"none of the {taxels} taxels works ({', '.join(sorted(kinds))})",
        way_out="check the array's cable and its calibration",
    )


def refuse_without_frames(selections: list[SelectedFrames], *, pressure_window_kpa: tuple[float, float]) -> None:
    """Raise `BadDataError` when no scan has a frame left, naming the step that took them and a remedy."""
    if any(selection.used.any() for selection in selections):
        return
    total = sum(len(selection.scan.frames) for selection in selections)
    if not total:
        raise BadDataError("the scan holds no frame", way_out="record it again")
    known = sum(int(selection.poses.known.sum()) for selection in selections)
    if not known:
        raise _without_poses(selections)
    gated = sum(int((selection.low | selection.high).sum()) for selection in selections)
    if not gated:
        share = max(float(selection.valid_share.max()) for selection in selections)
        raise BadDataError(
            f"no frame has {100 * VALID_SHARE:g} % of its taxels valid (the best has {100 * share:.1f} %)",
            way_out="repair the array, or press less hard if taxels are saturated",
        )
    raise _outside_window(selections, pressure_window_kpa)


def _without_poses(selections: list[SelectedFrames]) -> BadDataError:
    frames, poses = selections[0].scan.frames.time_s, selections[0].scan.poses.time_s
    if not len(poses):
        return BadDataError("the scan holds no tracker pose", way_out="check that the tracker was recorded")
    return BadDataError(
        f"no frame has a tracker pose (frames {frames[0]:.3f} to {frames[-1]:.3f} s, {len(poses)} poses "
        f"{poses[0]:.3f} to {poses[-1]:.3f} s)",
        way_out="check that both run on one clock and that the tracker did not freeze",
    )


def _outside_window(selections: list[SelectedFrames], window: tuple[float, float]) -> BadDataError:
    levels = np.concatenate([part.level_kpa[part.low | part.high] for part in selections])
    low, middle, high = np.quantile(levels, [0.05, 0.5, 0.95])
    return BadDataError(
        f"no frame's mean lies within {window[0]:g} to {window[1]:g} kPa ({len(levels)} frames, means "
        f"{levels.min():.2f} to {levels.max():.2f} kPa, median {middle:.2f})",
        way_out=f"a window of {np.floor(low * 10) / 10:g} to {np.ceil(high * 10) / 10:g} kPa would keep nine in ten",
    )
