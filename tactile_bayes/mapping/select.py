"""Frames that go into a map: faulty taxels, regularity and overlap of the times, and the pressure gate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding, counted, finding
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.mapping import cells
from tactile_bayes.presets import KPA_PER_UNIT, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import PressureFrames, Scan, TrackerPoses

# --- Detection of faulty taxels over a whole scan.

DEAD_SHARE = 0.1  #: Share of its row's and column's level below which a taxel is dead (its cable picks up noise only).
HOT_RATIO = 2.0  #: Multiple of its row's and column's level above which a taxel is hot.
# Multiple of the usual flicker, and its size in kPa, above which a taxel is hot.
FLICKER_RATIO = 10.0
FLICKER_KPA = 1.0
SATURATED_SHARE = 0.1  #: Share of saturated frames above which a taxel is left out of all.
MIN_FRAMES = 10  #: Fewest frames from which a taxel can be called stuck.
STILL_SHARE = 0.5  #: Share of repeated counts above which a taxel is stuck, where most have less than half of that.
# Share of the blocks of so many frames, of those in which most taxels change, through which a taxel keeps its count.
LOST_SHARE = 0.05
_BLOCK = 32
CONTACT_KPA = 1.0  #: Level below which the head is in the air, and a low reading is no fault.
_CHUNK = 512


class TaxelFault(NamedTuple):
    """One taxel that is left out, and why: ``"dead"``, ``"stuck"``, ``"hot"`` or ``"saturated"``."""

    row: int
    column: int
    fault: str

    def __str__(self) -> str:
        return f"row {self.row} column {self.column} {self.fault}"


def find_faults(scan: Scan) -> tuple[TaxelFault, ...]:
    """Taxels to leave out of every frame of a scan, in row order.

    - dead: gain 0; one count throughout and next to no level; or a level below a tenth of its row's and column's median
    - stuck: one count throughout while most change; a count repeated in over half of the frames while most hardly ever
      do so; or a count kept for long stretches in which nine in ten change
    - hot: over twice the level of its row and column, or ten times the usual flicker
    - saturated: full scale in over a tenth of the frames

    Levels are compared along the row *and* the column: an edge that bears less is no fault.
    """
    if not len(scan.frames):
        return ()
    mean, flicker, still, lost, saturated = _element_levels(scan)
    lowest, highest = scan.frames.counts.min(axis=0), scan.frames.counts.max(axis=0)
    usual = float(np.median(mean))
    row, column = np.median(mean, axis=1)[:, None], np.median(mean, axis=0)[None, :]
    low, high = np.minimum(row, column), np.maximum(row, column)
    constant = (highest == lowest) & (len(scan.frames) >= MIN_FRAMES)
    moving = bool(np.median(highest - lowest) > 0)
    empty = constant & ((highest == 0) | (mean <= DEAD_SHARE * usual))
    weak = (mean < DEAD_SHARE * low) & (low > CONTACT_KPA)
    flickers = (flicker > FLICKER_RATIO * np.median(flicker)) & (flicker > FLICKER_KPA)
    faults = np.full(mean.shape, "", dtype="<U9")
    faults[((mean > HOT_RATIO * high) & (mean > usual + CONTACT_KPA)) | flickers] = "hot"
    sticks = (still > STILL_SHARE) | (lost > LOST_SHARE)
    sticks &= bool(np.median(still) < STILL_SHARE / 2)
    faults[(constant & moving) | (sticks & (len(scan.frames) >= MIN_FRAMES))] = "stuck"
    faults[saturated > SATURATED_SHARE] = "saturated"
    faults[(scan.element_calibration.gain_kpa_per_count == 0) | empty | weak] = "dead"
    faulty = np.argwhere(faults != "").tolist()
    return tuple(TaxelFault(row, column, str(faults[row, column])) for row, column in faulty)


def _kinds(faults: Iterable[TaxelFault]) -> str:
    return ", ".join(sorted({fault.fault for fault in faults}))


def _element_levels(scan: Scan) -> tuple[FloatArray, ...]:
    """Each taxel's mean and flicker in kPa, and shares of frames: still, lost and saturated."""
    counts, calibration = scan.frames.counts, scan.element_calibration
    steps, still, lost, saturated = np.zeros((4, *counts.shape[1:]))
    moving, highest, last = 0, counts.max(axis=0), counts[:1].astype(np.float64)
    for part in chunks(len(counts), _CHUNK):
        chunk = counts[part].astype(np.float64)
        change = np.abs(np.diff(chunk, axis=0, prepend=last))
        steps += change.sum(axis=0)  # not squared: one spike is no flicker
        unchanged = change == 0
        still += unchanged.sum(axis=0)
        constant = unchanged[: len(chunk) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, *last.shape[1:]).all(axis=1)
        most_move = constant.mean(axis=(1, 2)) < 0.1
        # a taxel that stays at its highest count is saturated
        lost += (constant & (chunk[: len(constant) * _BLOCK : _BLOCK] < highest))[most_move].sum(axis=0)
        moving += int(most_move.sum())
        saturated += (chunk >= calibration.saturation_count).sum(axis=0)
        last = chunk[-1:]
    n = len(counts)
    return (
        calibration.linear_kpa(counts.mean(axis=0)),
        calibration.gain_kpa_per_count * (steps / max(n - 1, 1)),
        (still - 1) / max(n - 1, 1),  # the first frame was compared with itself
        lost / max(moving, 1),
        saturated / n,
    )


# --- Regularity of frames and poses: rates, jitter, repeats, gaps and missing records.

_GAP_INTERVALS = 1.5  #: Multiple of the usual interval above which frames are missing in it.


def timing_figures(scans: Sequence[Scan]) -> dict[str, float]:
    """Figures for a map's report, over all scans; rates of scans with less than two records are left out.

    ``frame_rate_hz``, ``frame_jitter_ms`` (spread of the intervals without gaps), ``frames_missing``,
    ``frames_repeated`` (two of one time), ``pose_rate_hz`` and ``pose_jitter_ms`` of distinct poses, ``pose_repeats``
    (samples sent again) and ``pose_gap_ms`` (the longest between distinct poses).
    """
    fresh = [cells.distinct_poses(scan.poses) for scan in scans]
    frames, poses = [scan.frames.time_s for scan in scans], [one.time_s for one in fresh]
    return {
        **_regularity("frame", frames),
        **_regularity("pose", poses),
        "frames_missing": float(sum(missing_records(time) for time in frames)),
        "frames_repeated": float(sum(int((np.diff(time) == 0).sum()) for time in frames)),
        "pose_repeats": float(sum(len(scan.poses) - len(one) for scan, one in zip(scans, fresh, strict=True))),
        "pose_gap_ms": 1000.0 * max((float(np.diff(time).max(initial=0.0)) for time in poses), default=0.0),
    }


def intervals(times: list[FloatArray]) -> tuple[FloatArray, float]:
    """Intervals above 0 between records, and their median; NaN without any."""
    steps = np.concatenate([np.diff(time) for time in times])
    steps = steps[steps > 0]
    return steps, float(np.median(steps)) if len(steps) else float("nan")


def _regularity(name: str, times: list[FloatArray]) -> dict[str, float]:
    """Rate, and standard deviation of the intervals that contain no gap."""
    steps, usual = intervals(times)
    if not len(steps):
        return {}
    regular = steps[steps < _GAP_INTERVALS * usual]
    return {f"{name}_rate_hz": 1.0 / usual, f"{name}_jitter_ms": 1000.0 * float(regular.std())}


RATE_HZ: Final = (5.0, 2000.0)  #: Rate of frames.
_CLOCKS: Final = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"), (1 / 60, "minutes"))


def rate_doubt(rate_hz: float) -> tuple[str, str] | None:
    """Sentence and remedy for frames at a rate that no array gives; None for another."""
    low, high = RATE_HZ
    if low <= round(rate_hz, 6) <= high:
        return None
    units = [name for factor, name in _CLOCKS if low <= rate_hz * factor <= high]
    remedy = f"are the times in {units[0]}? they must be in s" if units else "check the frames' times, which are in s"
    return f"frames come at {rate_hz:.3g} Hz, and arrays give {low:g} to {high:g}", remedy


def missing_records(time_s: FloatArray) -> int:
    """Number of frames, or poses, that are missing in the gaps."""
    steps, usual = intervals([time_s])
    return int(np.rint(steps[steps >= _GAP_INTERVALS * usual] / usual - 1).sum())


# --- A scan with part of its frames: every n-th, or those of its first seconds.


def every_nth(scan: Scan, every: int) -> Scan:
    """The scan with every `every`-th frame from the first on; all poses stay."""
    return scan if every == 1 else _with_frames(scan, slice(None, None, every))


def first_seconds(scan: Scan, duration_s: float) -> Scan:
    """The scan with the frames of its first `duration_s` seconds (above 0; it has some); all poses stay."""
    time_s = scan.frames.time_s
    return _with_frames(scan, slice(0, int(np.searchsorted(time_s, time_s[0] + duration_s, side="right"))))


def _with_frames(scan: Scan, chosen: slice) -> Scan:
    frames = PressureFrames(scan.frames.time_s[chosen], np.ascontiguousarray(scan.frames.counts[chosen]))
    return replace(scan, frames=frames)


# --- Overlap in time of a scan's poses and frames, and cautions where it is poor.

TOLERATED_S: Final = 0.1  #: Shorter mismatches and gaps cost a few frames at most.
_SAME_S: Final = 0.05  #: Times agree that differ by less.
_LONG_INTERVALS: Final = 5.0  #: Multiple of the mean interval above which frames are missing.


@dataclass(slots=True)
class Span:
    """Range of the times at which a device's records were measured."""

    number: int = 0  #: Records so far.
    first_s: float = 0.0
    last_s: float = 0.0
    gap_s: float = 0.0
    gap_at_s: float = 0.0
    """`gap_s`, `gap_at_s`: Longest interval between two records, and its beginning."""

    def add(self, time_s: float) -> None:
        """Add the next record's time, which must not be below the one before."""
        if not self.number:
            self.first_s = time_s
        elif time_s - self.last_s > self.gap_s:
            self.gap_s, self.gap_at_s = time_s - self.last_s, self.last_s
        self.number, self.last_s = self.number + 1, time_s

    @classmethod
    def of(cls, time_s: FloatArray) -> Span:
        """Span of (n,) times that never fall."""
        span = cls()
        for moment_s in time_s.tolist():
            span.add(moment_s)
        return span


# Fastest motion of a hand, and the most that a tracker's noise adds to a step.
_HAND_MM_PER_S: Final = 5_000.0
_NOISE_MM: Final = 30.0
_OPPOSITE_SHARE: Final = 0.2  #: Poses are opposite whose sum is shorter than this share of the step between them.


@dataclass(slots=True)
class Jumps:
    """Steps between successive poses that no hand makes."""

    number: int = 0
    longest_mm: float = 0.0
    opposite: int = 0  #: Those to the opposite side of the tracker's origin.
    _last_s: float = 0.0
    _last_mm: tuple[float, float, float] | None = None

    def add(self, time_s: float, position_mm: tuple[float, float, float]) -> None:
        """Add the next pose."""
        last, passed_s = self._last_mm, time_s - self._last_s
        self._last_s, self._last_mm = time_s, position_mm
        if last is None:
            return
        step_mm = math.dist(last, position_mm)
        if step_mm > _NOISE_MM + _HAND_MM_PER_S * passed_s:
            self.number, self.longest_mm = self.number + 1, max(self.longest_mm, step_mm)
            sum_mm = math.hypot(*(a + b for a, b in zip(last, position_mm, strict=True)))
            self.opposite += sum_mm < _OPPOSITE_SHARE * step_mm

    @classmethod
    def of(cls, poses: TrackerPoses) -> Jumps:
        """Jumps of a scan's poses."""
        jumps = cls()
        for time_s, place_mm in zip(poses.time_s.tolist(), poses.position_mm.tolist(), strict=True):
            jumps.add(time_s, place_mm)
        return jumps

    @property
    def crossed(self) -> bool:
        """True where most steps are to the opposite side."""
        return 2 * self.opposite > self.number

    def cautions(self) -> list[str]:
        """A line on their number, length and cause; empty without jumps."""
        if not self.number:
            return []
        cause = "two tools in one stream, damaged records, or metal near an electromagnetic tracker"
        if self.crossed:
            cause = "the sensor crossed into the hemisphere that the tracker is not set to"
        times = "once" if self.number == 1 else f"{self.number:,} times"
        return [f"the poses jump {times}, by up to {self.longest_mm:.0f} mm, faster than a hand: {cause}"]


_LEFT_OUT: Final = (
    "if the map has a hole at the lump, record again, the head plugged in and its tool in the tracker's sight",
    "if the map has a hole at the lump, have the scan taken again",
)
"""Remedies of times without frames or poses."""


def disjoint(frames: Span, poses: Span) -> bool:
    """True where no frame was measured between the first pose and the last."""
    if not frames.number or not poses.number:
        return True
    return poses.last_s < frames.first_s or poses.first_s > frames.last_s


def overlap_cautions(frames: Span, poses: Span) -> list[str]:
    """Cautions about the times, a line each; empty where every frame has poses around it, or one of both is empty."""
    cautions, usual_s = [], (frames.last_s - frames.first_s) / max(1, frames.number - 1)
    if frames.gap_s > max(TOLERATED_S, _LONG_INTERVALS * usual_s):
        cautions.append(f"no frame for {frames.gap_s:.2f} s from {frames.gap_at_s:.2f} s on (longest gap)")
    if not frames.number or not poses.number:
        return cautions
    if disjoint(frames, poses):
        when = f"{poses.first_s:.2f} to {poses.last_s:.2f} s, frames {frames.first_s:.2f} to {frames.last_s:.2f} s"
        return [*cautions, f"no frame has a pose: poses cover {when}"]
    late_s, early_s = poses.first_s - frames.first_s, frames.last_s - poses.last_s
    if late_s > TOLERATED_S:
        cautions.append(f"poses start {late_s:.1f} s after the frames")
    if early_s > TOLERATED_S:
        cautions.append(f"poses end {early_s:.1f} s before the frames")
    if poses.gap_s > TOLERATED_S:
        cautions.append(f"no pose for {poses.gap_s:.2f} s from {poses.gap_at_s:.2f} s on (longest gap)")
    return cautions


_USUAL_LEVER_MM: Final = (10.0, 300.0)  #: From the face of a head that a hand holds to the tracker's sensor.


def scan_findings(scan: Scan) -> tuple[Finding, ...]:
    """Findings of a scan's recorder, and on its times and poses; what the recorder noted too is given once."""
    frames, poses = Span.of(scan.frames.time_s), Span.of(scan.poses.time_s)
    noted = (*with_times(scan.findings, frames, poses), *_clock_steps(frames, poses))
    jumps = Jumps.of(scan.poses)
    remedy = "set the tracker's hemisphere to the patient's side, and scan again" if jumps.crossed else ""
    jumped = [finding("poses_jump", text, remedy, remedy) for text in jumps.cautions()]
    told = {one.text for one in jumped}
    noted = tuple(one for one in noted if one.text not in told)
    frozen = (finding("times_apart", text, *_LEFT_OUT) for text in _frozen_cautions(scan.poses))
    lever = float(np.linalg.norm(scan.head.scanhead_from_tracker[:3, 3]))
    if lever <= 1e-3 or _USUAL_LEVER_MM[0] <= lever <= _USUAL_LEVER_MM[1]:
        return (*noted, *frozen, *jumped)
    text = f"the tracker's sensor lies {lever:.3g} mm from the head"
    return (*noted, *frozen, *jumped, finding("unusual_scan", text, "check that the lever arm is in mm"))


def _clock_steps(frames: Span, poses: Span) -> Iterator[Finding]:
    """A caution where only one device's times have a gap, and it lasts longer than the other by just that gap."""
    remedy = "import them again without that step, or record with --clock arrival"
    for one, other, whose in ((frames, poses, "frames"), (poses, frames, "poses")):
        longer_s = one.last_s - one.first_s - (other.last_s - other.first_s)
        together = abs(one.first_s - other.first_s) < _SAME_S and abs(longer_s - one.gap_s) < _SAME_S
        if together and other.gap_s <= TOLERATED_S < one.gap_s:
            text = (
                f"the {whose}' clock seems to step by {one.gap_s:.1f} s at {one.gap_at_s:.2f} s: the rest is misplaced"
            )
            yield finding("frames_contradict", text, remedy, "have the scan taken again")


def _frozen_cautions(poses: TrackerPoses) -> list[str]:
    """A line on the times in which the tracker repeated a place or a rotation while the head moved on; or none."""
    fresh = cells.distinct_poses(poses)
    if not len(fresh):
        return []
    ends = np.append(np.searchsorted(poses.time_s, fresh.time_s[1:]), len(poses)) - 1
    repeated_s = poses.time_s[ends] - fresh.time_s
    long = (repeated_s > TOLERATED_S) & np.append(cells.leaps(fresh), True)
    if not long.any():
        return []
    longest = int(np.argmax(np.where(long, repeated_s, 0.0)))
    number = f" (longest of {long.sum()})" if long.sum() > 1 else ""
    when = f"for {repeated_s[longest]:.2f} s from {fresh.time_s[longest]:.2f} s on{number}"
    return [f"the tracker repeated one place or rotation {when}: frames of that time are left out"]


def with_times(findings: Sequence[Finding], frames: Span, poses: Span) -> tuple[Finding, ...]:
    """`findings` of a scan's file followed by those on its times, each once."""
    cautions = overlap_cautions(frames, poses)
    others = [one for one in findings if one.text not in cautions]
    return (*others, *(finding("times_apart", text, *_LEFT_OUT) for text in cautions))


# --- Selection of the frames that go into a map, and the reasons for leaving others out (paper step ii, the gate).

VALID_SHARE = 0.9  #: Share of valid taxels below which a frame is left out.
LEAST_FRAMES = 30  #: Fewest used frames of an exam.


class SelectedFrames(Record, eq=False, dict=True):
    """A scan with the selection of its frames."""

    scan: Scan  #: As recorded.
    faults: tuple[TaxelFault, ...]  #: Taxels left out of every frame.
    fresh: TrackerPoses  #: The tracker's poses without repeats.
    poses: cells.FramePoses  #: Pose of the tracker at each frame.
    level_kpa: FloatArray  #: (n,) array: Mean over the valid taxels; NaN where there is none.
    valid_share: FloatArray  #: (n,) array: Share of the taxels of the array that are good and not saturated.
    low: BoolArray
    high: BoolArray
    """`low`, `high` (n,) bool arrays: Frames whose level is below or above the window, among those with a pose and
    enough valid taxels."""
    used: BoolArray  #: (n,) bool array: Frames that go into the map.

    @property
    def good_taxels(self) -> BoolArray:
        """(rows, columns) True for taxels that are not left out."""
        return good_taxels(self.scan.head.shape, self.faults)

    @cached_property
    def readout(self) -> cells.Readout:
        """Conversion of the good taxels' counts."""
        return cells.Readout.of(self.scan.element_calibration, self.good_taxels)

    def pressure_kpa(self, frames: slice | IndexArray) -> tuple[FloatArray, BoolArray | None]:
        """(f, k) pressures of the good taxels, and a mask of the valid ones, see `Readout.pressure_kpa`."""
        return self.readout.pressure_kpa(self.readout.counts(self.scan.frames.counts[frames]))

    def projector(self, *, plane_from_base: FloatArray, cell_mm: float) -> cells.Projector:
        """Projector of the good taxels onto a plane."""
        good = self.good_taxels
        return cells.Projector(self.scan.head, plane_from_base=plane_from_base, taxels=good, cell_mm=cell_mm)


def good_taxels(shape: tuple[int, int], faults: Iterable[TaxelFault]) -> BoolArray:
    """(rows, columns) True for taxels without a fault."""
    good = np.ones(shape, dtype=bool)
    for fault in faults:
        good[fault.row, fault.column] = False
    return good


def chunks(frames: int, size: int) -> Iterator[slice]:
    """Slices of at most `size` frames."""
    for start in range(0, frames, size):
        yield slice(start, min(start + size, frames))


def select_frames(
    scan: Scan,
    *,
    pressure_window_kpa: tuple[float, float],
    latency_ms: float = 0.0,
    max_pose_gap_ms: float = cells.MAX_POSE_GAP_MS,
) -> SelectedFrames:
    """Select the frames with a pose, nine valid taxels in ten, and a mean over these in the window, its ends included.

    A head without a working taxel is a `BadDataError`.
    """
    faults, taxels = find_faults(scan), scan.head.shape[0] * scan.head.shape[1]
    if len(faults) == taxels:
        look = "check the array's cable and its calibration"
        if 2 * sum(one.fault == "saturated" for one in faults) > taxels:
            look = "press less hard, or import it with the array's own --saturation"
        way_out = _counts_question([scan]) or look
        raise BadDataError(f"none of the {taxels} taxels works ({_kinds(faults)})", way_out=way_out)
    fresh = cells.distinct_poses(scan.poses)
    poses = cells.poses_at(fresh, scan.frames.time_s, latency_ms=latency_ms, max_gap_ms=max_pose_gap_ms)
    readout = cells.Readout.of(scan.element_calibration, good_taxels(scan.head.shape, faults))
    level, share = np.full(len(scan.frames), np.nan), np.zeros(len(scan.frames))
    for part in chunks(len(scan.frames), cells.chunk_frames(readout.size)):
        level[part], share[part] = readout.levels(*readout.pressure_kpa(readout.counts(scan.frames.counts[part])))
    low, high, used = gate(poses.known, level, share, pressure_window_kpa=pressure_window_kpa)
    return SelectedFrames(scan, faults, fresh, poses, level, share, low, high, used)


def gate(
    known: BoolArray, level_kpa: FloatArray, valid_share: FloatArray, *, pressure_window_kpa: tuple[float, float]
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """(n,) masks of the frames below the window, above it and within it, its ends included."""
    candidate = known & (valid_share >= VALID_SHARE)
    low, high = candidate & (level_kpa < pressure_window_kpa[0]), candidate & (level_kpa > pressure_window_kpa[1])
    return low, high, candidate ^ (low | high)


def refuse_without_frames(selections: list[SelectedFrames], *, pressure_window_kpa: tuple[float, float]) -> None:
    """Raise `BadDataError` where no scan has a used frame, with the reason and a way out."""
    if any(selection.used.any() for selection in selections):
        return
    total = sum(len(selection.scan.frames) for selection in selections)
    if not total:
        raise BadDataError("the scan holds no frame", way_out="give another; `tactile-bayes show` says what it holds")
    known = sum(int(selection.poses.known.sum()) for selection in selections)
    if 10 * known < total:
        raise _without_poses(selections, f"{known} of {total} frames have" if known else "no frame has")
    gated = sum(int((selection.low | selection.high).sum()) for selection in selections)
    if not gated:
        best = max(selections, key=lambda part: float(part.valid_share.max()))
        share, taxels = f"{100 * best.valid_share.max():.1f} %", best.good_taxels.size
        faulty = f"; {len(best.faults)} of {taxels} taxels are {_kinds(best.faults)} throughout" if best.faults else ""
        raise BadDataError(
            f"no frame has {100 * VALID_SHARE:g} % of its taxels valid (the best has {share}{faulty})",
            way_out=_counts_question([part.scan for part in selections])
            or "repair the array, or press less hard if taxels are saturated",
        )
    raise _outside_window(selections, pressure_window_kpa)


def _without_poses(selections: list[SelectedFrames], which_have: str) -> BadDataError:
    first = selections[0]
    frames, poses, fresh = first.scan.frames.time_s, first.scan.poses.time_s, first.fresh.time_s
    if not len(poses):
        return BadDataError("the scan holds no tracker pose", way_out="import it with poses, or check the tracker")
    if len(poses) > 1 and len(fresh) == 1:
        what = f"the tracker's {len(poses)} poses are of one place: it froze"
        return BadDataError(what, way_out="check the tracker, and scan again")
    what = (
        f"{which_have} a tracker pose (frames {frames[0]:.3f} to {frames[-1]:.3f} s, {len(poses)} poses "
        f"{poses[0]:.3f} to {poses[-1]:.3f} s"
    )
    apart_ms = 1000 * intervals([fresh])[1]
    if apart_ms > cells.MAX_POSE_GAP_MS:
        what += f", {apart_ms:.0f} ms apart: between them the head's place is not known)"
        return BadDataError(what, way_out="set the tracker to 50 poses a second or more")
    doubt = rate_doubt(1 / intervals([frames])[1]) if len(frames) > 1 else None
    both = "check that both run on one clock, and that the tracker saw its sensor"
    way_out = doubt[1] if doubt else f"{_short([first])}{both}"
    return BadDataError(f"{what})", way_out=way_out)


def _short(selections: Sequence[SelectedFrames]) -> str:
    """Beginning of a way out, where scans have too few frames."""
    frames = sum(len(part.scan.frames) for part in selections)
    return f"the scan has {counted(frames, 'frame')} only: record for longer; " if frames < LEAST_FRAMES else ""


def _outside_window(selections: list[SelectedFrames], window: tuple[float, float]) -> BadDataError:
    levels = np.concatenate([part.level_kpa[part.low | part.high] for part in selections])
    low, middle, high = np.quantile(levels, [0.05, 0.5, 0.95])
    session = selections[0].scan.session
    imported = session.get("source") == "imported"  # a recorder knows its unit
    question = unit_question(float(middle), session.get("frames_unit", "kPa"), window) if imported else ""
    more = "" if question else _counts_question([part.scan for part in selections])
    press = f"press {'harder' if middle < window[0] else 'less hard'}, or "
    return BadDataError(
        f"no frame's mean lies within {window[0]:g} to {window[1]:g} kPa ({len(levels)} frames, means "
        f"{levels.min():.2f} to {levels.max():.2f} kPa, median {middle:.2f}{f': {question}' if question else ''})",
        way_out=("import it again with the right --unit; " if question else _short(selections) + press)
        + f"a window of {np.floor(low * 10) / 10:g} to {np.ceil(high * 10) / 10:g} kPa (--pressure-window-kpa) would "
        "keep nine in ten" + (f", but {more}" if more else ""),
    )


def unit_question(mean_kpa: float, stated: str, window: tuple[float, float]) -> str:
    """Question for the unit where a mean is outside the window but would be inside in another unit; else empty."""
    if window[0] <= mean_kpa <= window[1]:
        return ""
    number = mean_kpa / KPA_PER_UNIT.get(stated, 1.0)
    fitting = [unit for unit, kpa in KPA_PER_UNIT.items() if window[0] <= number * kpa <= window[1]]
    return f"are these {' or '.join(fitting)}?" if fitting else ""


_SAMPLE_FRAMES = 200


def _counts_question(scans: Iterable[Scan]) -> str:
    """Question whether counts are shifted, already pressures or in another unit, where they would fit an exam then."""
    scan = max(scans, key=lambda one: len(one.frames))
    counts, calibration = scan.frames.counts[:: max(1, len(scan.frames) // _SAMPLE_FRAMES)], scan.element_calibration
    above, highest = float((counts >= calibration.saturation_count).mean()), int(counts.max())
    step = int(np.gcd.reduce(counts.ravel()))
    if above > SATURATED_SHARE and highest > calibration.saturation_count:
        shifted = f", all of them multiples of {step}: fewer bits, left-aligned? divide them" if step > 1 else ""
        return (
            f"{100 * above:.0f} % of the counts are not below saturation_count {calibration.saturation_count} (highest "
            f"{highest}{shifted}); give counts and saturation_count as the converter has them"
        )
    middle = float(np.median(counts))
    if PRESSURE_WINDOW_KPA[0] <= middle <= PRESSURE_WINDOW_KPA[1]:
        return f"are the counts kPa already (median {middle:g})? then gain_kpa_per_count is 1 and offset_kpa 0"
    level = float(np.median(calibration.linear_kpa(counts)))
    question = unit_question(level, "kPa", PRESSURE_WINDOW_KPA)
    return f"{question} gain_kpa_per_count and offset_kpa must give kPa (median {level:.4g})" if question else ""


# --- Figures of frames used and left out.


def frame_figures(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """Frames used and left out, summed over the scans."""
    figures = {
        "scans": len(selections),
        "frames_total": sum(len(part.used) for part in selections),
        "frames_used": sum(int(part.used.sum()) for part in selections),
        "dropped_no_pose": sum(int((~part.poses.known).sum()) for part in selections),
        "dropped_elements": sum(
            int((part.poses.known & ~(part.valid_share >= VALID_SHARE)).sum()) for part in selections
        ),
        "dropped_low": sum(int(part.low.sum()) for part in selections),
        "dropped_high": sum(int(part.high.sum()) for part in selections),
        "masked_taxels": sum(len(part.faults) for part in selections),
        "saturated_readings": sum(  # of good taxels in used frames
            int(np.rint((part.good_taxels.sum() - part.valid_share[part.used] * part.good_taxels.size).sum()))
            for part in selections
        ),
    }
    levels = np.concatenate([part.level_kpa[part.used] for part in selections])
    ungated = np.concatenate([part.level_kpa[part.used | part.low | part.high] for part in selections])
    low, high = np.quantile(ungated, [0.05, 0.95])
    return {
        **{name: float(value) for name, value in figures.items()},
        "mean_pressure_kpa": float(levels.mean()),
        "level_p05_kpa": float(low),
        "level_p95_kpa": float(high),
    }
