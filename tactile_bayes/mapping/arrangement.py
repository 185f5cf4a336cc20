r"""Array, lever arm and rotations of a scan, held against other arrangements by how well its frames agree.

Where frames overlap, they feel one breast. Read in a wrong arrangement (rows backwards, a lever arm upside down,
quaternions in another order) they contradict each other. Each arrangement of `CORRECTIONS` is judged by how well frames
of other times predict a reading. Errors last for a while, so that a stretch of 0.2 s counts as one normal error of
unknown spread s: n stretches give one arrangement :math:`(s_2/s_1)^n` times the likelihood of another, and the odds are
that over the number of arrangements tried. Each correction has to earn `LIKELY_ODDS`.

A breast in which nothing stands out looks alike in all of them: then nothing is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import product
from math import exp, log
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.findings import Finding, finding_lines
from tactile_bayes.geometry import FloatArray, IndexArray, apply, inverse
from tactile_bayes.mapping.cells import poses_at
from tactile_bayes.mapping.convention import (
    CONVENTIONS,
    CoarseFrames,
    block_means,
    corrected_quaternions,
    every_stretch,
    import_again,
    thinning,
)
from tactile_bayes.mapping.latency import Cells, Nuisance
from tactile_bayes.mapping.plausibility import SURE_ODDS, selection_doubts
from tactile_bayes.mapping.select import SelectedFrames, TaxelFault, select_frames
from tactile_bayes.presets import CORRECTIONS, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import ElementCalibration, HeadGeometry, PressureFrames, Scan, TrackerPoses

_ARRAY: Final = (
    (),
    ("rows-reversed",),
    ("columns-reversed",),
    ("half-turn",),
    ("quarter-turn",),
    ("quarter-turn-back",),
)
_FRAMES: Final = ((), ("transposed",))
_LEVER: Final = ((), ("lever-inverse",), ("lever-none",))
_ROTATIONS: Final = tuple(CONVENTIONS.values())

Corrections = tuple[str, ...]

MOST_CHANGES: Final = 3
LIKELY_ODDS: Final = 10.0
"""From these odds on another arrangement is a caution, and the one stated counts as shown."""
LEAST_EXPLAINED: Final = 0.7
"""Share of what varies over the skin that frames of other times predict in the right arrangement: 0.79 to 0.97 in 26
scans by another simulator."""
LEAST_GAIN: Final = 0.3
LEAST_GAINS: Final = {"inverse-rotation": 0.15, "quarter-turn": 0.45, "quarter-turn-back": 0.45}
"""Of a correction: a mistake's beside a clear lump gains 0.5 to 1.2, 0.15 to 0.5 where the rotation was the inverse.
Over empty bodies, whose frames bend as the head rolls, a turn of the array gained up to 0.4."""
CLOCK_MS: Final = (30, 60, 100, 150, 200, 300, 400, 500)
"""Times by which poses are tried to be late, and early; the best is found to 10 ms."""
LEAST_CLOCK_GAIN: Final = 0.15
"""Of another clock: 26 right scans gain 0.02 at most, 100 ms gain 0.2 to 1.0 beside a clear lump."""
CLOCK_EXPLAINED, CLOCK_LASTING = 0.9, 0.75
"""Frames that explain less, or whose errors last longer, may have another clock; the others are not asked."""
LEAST_AGREEMENT: Final = 0.9
MOST_EXPLAINED: Final = 0.55
MOST_LASTING: Final = 0.5
"""`MOST_EXPLAINED`, `MOST_LASTING`: Frames that explain less, with errors that last longer, contradict each other."""
LEAST_LASTING: Final = 0.15
"""Below it there is nothing but noise to compare."""
MOST_FRAMES: Final = 250
_LEAST_BLOCKS: Final = 8
_CLOCK_STEPS_MS: Final = (-40, -30, -20, -10, 10, 20, 30, 40)
_LEAST_OTHERS: Final = 2
"""Readings of other times that predict one."""
NOTHING_SHOWN: Final = "too little stands out to show that array, lever arm and quaternions are as stated"
NOT_CHECKED: Final = Finding(
    "arrangement_unknown",
    "how the sensor array and the tracker are mounted was never checked, and this scan does not show it",
    "scan a phantom with a lump once, run `tactile-bayes check PHANTOM.mcap -o HEAD.json`, and give --head-geometry "
    "HEAD.json from then on",
    "scan a phantom with a lump once and have it checked",
)
_CONTRADICTING: Final = "strokes over one place do not agree on what they felt there; size and place may be wrong"
_LATE: Final = "the tracker's times do not fit those of the sensor array; size and place may be wrong"
_MOUNTED: Final = (
    "the sensor array or the tracker seems to be mounted otherwise than is stated; size and place may be wrong"
)
TOO_SHORT: Final = "too few frames to compare arrangements"
_QUARTER: Final = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def corrected(scan: Scan, corrections: Iterable[str]) -> Scan:
    """The scan as it is once the named `CORRECTIONS` are made; readings keep their own calibration."""
    for name in corrections:
        scan = _corrected(scan, name)
    return scan


def _corrected(scan: Scan, name: str) -> Scan:
    head, poses = scan.head, scan.poses
    lever = head.scanhead_from_tracker
    levers = {
        "lever-inverse": inverse(lever),
        "lever-none": np.eye(4),
        "quarter-turn": _QUARTER @ lever,
        "quarter-turn-back": _QUARTER.T @ lever,
    }
    if name in levers:
        return replace(scan, head=HeadGeometry(head.surface_mm, head.pitch_mm, levers[name]))
    if name in _ROTATIONS[-1]:
        wxyz = corrected_quaternions(poses.quaternion_wxyz, [name])
        return replace(scan, poses=TrackerPoses(poses.time_s, poses.position_mm, wxyz))
    calibration = scan.element_calibration
    gain, offset = (_rearranged(one, name) for one in (calibration.gain_kpa_per_count, calibration.offset_kpa))
    return replace(
        scan,
        frames=PressureFrames(scan.frames.time_s, _rearranged(scan.frames.counts, name)),
        element_calibration=ElementCalibration(gain, offset, calibration.saturation_count),
    )


def _rearranged(array: Any, name: str) -> Any:
    """(..., rows, columns) values of taxels in the order that a correction gives them."""
    if name == "transposed":
        rows, columns = array.shape[-2:]
        return np.ascontiguousarray(array.reshape(*array.shape[:-2], columns, rows).swapaxes(-1, -2))
    axes = {"rows-reversed": (-2,), "columns-reversed": (-1,), "half-turn": (-2, -1)}[name]
    return np.ascontiguousarray(np.flip(array, axes))


class Arrangement(Record, eq=False):
    """One arrangement, and how well frames predict each other in it."""

    corrections: Corrections
    """What was corrected; empty for the scan as it is stated."""
    spread: float
    """Root mean square of these errors, of the frames' mean pressure."""
    explained: float
    """Share of the variance over the skin that is predicted."""
    lasting: float
    """Correlation of a taxel's errors from one frame to the next: noise has little, contradictions last."""
    agreement: float
    """Inner product of the mean normal of the face and the normal of all places: a head slides along its face."""
    late_ms: float = 0.0  #: By how much poses are later than stated; below 0 earlier.

    @property
    def in_words(self) -> str:
        """What is wrong if this one is right."""
        if self.late_ms:
            way = "late" if self.late_ms > 0 else "early"
            return f"the poses' times are {abs(self.late_ms):.0f} ms too {way} against the frames'"
        return " and ".join(CORRECTIONS[name] for name in self.corrections) or "all is as it is stated"

    @property
    def plausible(self) -> bool:
        """True where the head slides along its face, and frames predict what varies."""
        return self.agreement >= LEAST_AGREEMENT and self.explained >= LEAST_EXPLAINED

    @property
    def changes(self) -> int:
        """How many things of the scan as it is stated are wrong if this one is right."""
        return len(self.corrections) + bool(self.late_ms)

    @property
    def least_gain(self) -> float:
        """What the corrections have to gain in each stretch."""
        of_clock = LEAST_CLOCK_GAIN if self.late_ms else 0.0
        return of_clock + sum(LEAST_GAINS.get(name, LEAST_GAIN) for name in self.corrections)

    def gain_over(self, other: Arrangement) -> float:
        """Natural log of the likelihood ratio to another one in each stretch.

        By the errors, and by what they leave unexplained: the smaller counts, for what frames and taxels take off
        differs between arrangements.
        """
        errors = (other.spread + 1e-12) / (self.spread + 1e-12)
        unexplained = (1 - other.explained + 1e-12) / (1 - self.explained + 1e-12)
        return min(log(errors), log(unexplained) / 2)


class ArrangementCheck(Record, eq=False):
    """The arrangement stated, and the simplest that its frames agree with."""

    stated: Arrangement
    best: Arrangement
    log_odds: float
    """For `best` against `stated`; 0 where they are the same."""
    excluded: Mapping[str, float]
    """Log odds for what is stated against each correction alone."""
    contradicting: bool = False
    """True where frames contradict each other whatever is corrected."""
    asked_ms: float = 0.0  #: Latency that the poses were stated to have.
    doubts: tuple[Finding, ...] = ()
    """What in the scan is unlike an exam, where it was looked for; see `plausibility.scan_doubts`."""

    @property
    def refused(self) -> bool:
        """True where another arrangement wins clearly; another clock can be stated to `map`."""
        return self.log_odds >= log(SURE_ODDS) and not self.best.late_ms

    @property
    def not_shown(self) -> tuple[str, ...]:
        """Corrections that these frames neither ask for nor exclude."""
        return tuple(name for name, odds in self.excluded.items() if odds < log(LIKELY_ODDS))

    @property
    def says_nothing(self) -> bool:
        """True where the frames do not exclude each other order of the array."""
        return self.best is self.stated and any(name in self.not_shown for (name,) in _ARRAY[1:])

    @property
    def words(self) -> str:
        """What the frames agree with, in one sentence."""
        if self.contradicting:
            return (
                f"frames contradict each other by {_percent(self.best)} where they overlap, in every arrangement tried"
            )
        if self.best is not self.stated:
            return (
                f"{self.best.in_words} (odds {odds_words(self.log_odds)}): overlapping frames agree to "
                f"{_percent(self.best)} if so, to {_percent(self.stated)} as stated"
            )
        if self.says_nothing:
            return NOTHING_SHOWN
        return f"array, lever arm and quaternions are as stated: overlapping frames agree to {_percent(self.stated)}"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against a map made of the scan as it is stated."""
        if self.contradicting:
            on_paper = "make sure that the breast lies still, and have the tracker's mounting and its clock checked"
            return (Finding("frames_contradict", _CONTRADICTING, f"{self.words}; {self.remedy}", on_paper),)
        if self.best.late_ms:
            on_paper = "have the scan mapped again with the tracker's delay"
            return (Finding("late_poses", _LATE, f"{self.words}; {self.remedy}", on_paper),)
        if self.best is not self.stated:
            on_paper = "have it checked how the array and the tracker are mounted"
            return (Finding("wrong_arrangement", _MOUNTED, f"{self.words}; {self.remedy}", on_paper),)
        if self.says_nothing:
            return (NOT_CHECKED,)
        return ()

    def findings_of(self, scan: Scan) -> tuple[Finding, ...]:
        """The same; that nothing is shown is no finding where the scan's head was checked by another scan."""
        return tuple(one for one in self.findings if one is not NOT_CHECKED or not scan.head.checked_on)

    @property
    def remedy(self) -> str:
        """What to check or, where another arrangement is better, to state to `map` or to correct by `import`."""
        if self.contradicting:
            return "check the lever arm, both clocks, and that the breast lay still"
        if self.says_nothing:
            return NOT_CHECKED.remedy
        if self.best.late_ms:
            return f"map it with --latency-ms {self.asked_ms + self.best.late_ms:.0f}"
        return import_again(self.best.corrections)

    def lines(self) -> list[str]:
        """The answer in full: what the frames agree with, what they exclude, what they leave open, and what to do."""
        lines = [*finding_lines(self.doubts), self.words, *([self.remedy] if self.findings else [])]
        if self.best is self.stated and not self.says_nothing:
            odds = {name: odds_words(self.excluded[name]) for name in self.excluded if name not in self.not_shown}
            for words in dict.fromkeys(odds.values()):
                lines.append(f"excluded (odds {words}): {', '.join(name for name in odds if odds[name] == words)}")
            lines += [f"not excluded: {CORRECTIONS[name]}" for name in self.not_shown]
        return lines


def _percent(one: Arrangement) -> str:
    return f"{100 * one.spread:.1f} %"


def odds_words(log_odds: float) -> str:
    """Odds to a power of ten; beyond a million to one the figure means nothing."""
    tens = int(log_odds / log(10))
    return "above 10^6" if tens >= 6 else f"10^{tens}" if tens >= 3 else f"{exp(log_odds):.0f}"


def check_arrangement(
    selection: SelectedFrames, *, latency_ms: float = 0.0, most_changes: int = MOST_CHANGES
) -> ArrangementCheck | None:
    """Compare arrangements of up to `most_changes` corrections; None for a scan too short to compare any.

    The best is the likeliest that is plausible and gains enough, with `LIKELY_ODDS` against each of its corrections.
    """
    overlap = _Overlap.of(selection, latency_ms)
    if overlap is None:
        return None
    first, *others = _arrangements(selection.scan, most_changes)
    stated = overlap.judged(first)
    if stated.lasting < LEAST_LASTING:
        return ArrangementCheck(stated, stated, 0.0, {one[0]: 0.0 for one in others if len(one) == 1})
    tried = [stated, *map(overlap.judged, others)]
    if stated.explained < CLOCK_EXPLAINED or stated.lasting > CLOCK_LASTING:
        tried += [overlap.late(sign * ms) for ms in CLOCK_MS for sign in (1, -1)]
    stretches = int(overlap.block.max()) + 1
    likely = [one for one in tried if one is stated or (one.plausible and one.gain_over(stated) >= one.least_gain)]
    best = max(likely, key=lambda one: stretches * one.gain_over(stated) - log(LIKELY_ODDS) * one.changes)
    if best.late_ms:
        near = [overlap.late(best.late_ms + step) for step in _CLOCK_STEPS_MS]
        best = max([best, *near], key=lambda one: one.gain_over(stated))
    excluded = {
        one.corrections[0]: stretches * stated.gain_over(one) - log(len(tried))
        for one in tried
        if len(one.corrections) == 1
    }
    log_odds = stretches * best.gain_over(stated) - log(len(tried))
    contradicting = best.explained < MOST_EXPLAINED and best.lasting > MOST_LASTING
    if best is stated or log_odds < log(LIKELY_ODDS):
        return ArrangementCheck(stated, stated, 0.0, excluded, contradicting)
    return ArrangementCheck(stated, best, log_odds, excluded, asked_ms=latency_ms)


def check_briefly(selection: SelectedFrames, *, latency_ms: float = 0.0) -> ArrangementCheck | None:
    """As `check_arrangement`, which goes beyond single corrections only where one of them or none fits."""
    check = check_arrangement(selection, latency_ms=latency_ms, most_changes=1)
    if check is None or check.best.late_ms or (check.best is check.stated and not check.contradicting):
        return check
    return check_arrangement(selection, latency_ms=latency_ms)


def check_scan(
    scan: Scan, *, pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA, thorough: bool = True
) -> ArrangementCheck | None:
    """Check a scan as it is recorded, with its frames within the window: thoroughly or `check_briefly`.

    A scan without a frame that can be used is a `BadDataError`.
    """
    selection = select_frames(scan, pressure_window_kpa=pressure_window_kpa)
    doubts = selection_doubts(selection, pressure_window_kpa=pressure_window_kpa)
    check = check_arrangement(selection) if thorough else check_briefly(selection)
    return None if check is None else replace(check, doubts=doubts)


def _arrangements(scan: Scan, most_changes: int) -> list[Corrections]:
    """All corrections to try, the fewest first; of a lever arm that is none, none of the lever arm."""
    lever = _LEVER[:1] if np.allclose(scan.head.scanhead_from_tracker, np.eye(4)) else _LEVER
    every = [sum(parts, ()) for parts in product(_ARRAY, _FRAMES, lever, _ROTATIONS)]
    return sorted((one for one in every if len(one) <= most_changes), key=len)


class _Overlap(Record, eq=False):
    """Averaged frames of a scan, as they are and with the array transposed, and what is needed to place them."""

    scan: Scan
    frames: IndexArray
    latency_ms: float
    coarse: tuple[CoarseFrames, CoarseFrames]
    taxels: tuple[IndexArray, IndexArray]
    """Flat indices of the good ones, for each of `coarse`."""
    block: IndexArray
    """(m,) stretch of 0.2 s that each averaged frame lies in."""
    paths: dict[Corrections, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    """Mean rotation and place of the tracker at each averaged frame, for the corrections of rotations asked so far."""

    @classmethod
    def of(cls, stated: SelectedFrames, latency_ms: float) -> _Overlap | None:
        scan, used = stated.scan, np.flatnonzero(stated.used)
        if not len(used):
            return None
        time_s = scan.frames.time_s[used]
        frames = used[every_stretch(time_s, thinning([time_s], most=MOST_FRAMES))]
        bad = np.argwhere(~_rearranged(stated.good_taxels, "transposed")).tolist()
        faults = tuple(TaxelFault(row, column, "left out") for row, column in bad)
        other = replace(stated, scan=corrected(scan, ["transposed"]), faults=faults)
        coarse = (CoarseFrames.of(stated, frames), CoarseFrames.of(other, frames))
        block = coarse[0].blocks(scan.frames.time_s)
        if int(block.max()) + 1 < _LEAST_BLOCKS:
            return None
        taxels = (np.flatnonzero(stated.good_taxels), np.flatnonzero(other.good_taxels))
        return cls(scan, frames, latency_ms, coarse, taxels, block)

    def late(self, late_ms: float) -> Arrangement:
        """What is stated, with poses that are later by so much."""
        return replace(replace(self, latency_ms=self.latency_ms + late_ms, paths={}).judged(()), late_ms=late_ms)

    def judged(self, corrections: Corrections) -> Arrangement:
        """Predict each averaged reading by those of other times in its cell of the plane."""
        coarse = self.coarse["transposed" in corrections]
        places, agreement = self._places_mm(corrections)
        cells = Cells.of([places])
        nuisance = Nuisance.of([coarse], cells.number)
        values = nuisance.levelled(coarse.pressure.reshape(-1), cells)
        values -= values.mean()
        block = self.block[nuisance.frame]
        size = int(cells.number.max()) + 1
        together = block * size + cells.number  # readings of one block in one cell
        total, count = np.bincount(cells.number, values), np.bincount(cells.number)
        others = count[cells.number] - np.bincount(together)[together]
        predicted = total[cells.number] - np.bincount(together, values)[together]
        error = values - np.divide(predicted, others, out=np.zeros_like(predicted), where=others >= _LEAST_OTHERS)
        by_frame = error.reshape(coarse.pressure.shape)
        total_square, variance = float(error @ error), float(values @ values)
        return Arrangement(
            corrections,
            spread=float(np.sqrt(total_square / len(error))),
            explained=1 - total_square / variance if variance else 0.0,
            lasting=float(np.sum(by_frame[1:] * by_frame[:-1])) / total_square if total_square else 0.0,
            agreement=agreement,
        )

    def _places_mm(self, corrections: Corrections) -> tuple[FloatArray, float]:
        """(m, k, 2) places of the averaged readings on the plane in which they lie, and how the face agrees with it."""
        transposed = "transposed" in corrections
        coarse, surface = self.coarse[transposed], self.scan.head.surface_mm
        for name in set(corrections) & {"rows-reversed", "columns-reversed", "half-turn"}:
            surface = np.stack([_rearranged(surface[..., i], name) for i in range(3)], axis=-1)
        mounted = corrected(self.scan, (name for name in corrections if name.startswith(("lever", "quarter"))))
        tracker_from_head = inverse(mounted.head.scanhead_from_tracker)
        on_tracker = apply(tracker_from_head, surface.reshape(-1, 3)[self.taxels[transposed]])
        rotation, centre = self._path(tuple(name for name in corrections if name in _ROTATIONS[-1]))
        place = centre[:, None] + (rotation @ (coarse.weight.T @ on_tracker).T).transpose(0, 2, 1)
        axes = np.linalg.eigh(np.cov(place.reshape(-1, 3).T))[1]
        agreement = abs(float(axes[:, 0] @ (rotation @ tracker_from_head[:3, 2]).mean(axis=0)))
        return np.asarray(place @ axes[:, [2, 1]]), agreement

    def _path(self, rotations: Corrections) -> tuple[FloatArray, FloatArray]:
        """(m, 3, 3) mean rotations and (m, 3) mean places of the tracker at the averaged frames."""
        if rotations not in self.paths:
            scan, first = corrected(self.scan, rotations), self.coarse[0].first
            poses = poses_at(scan.poses, scan.frames.time_s[self.frames], latency_ms=self.latency_ms)
            means = block_means(poses.rotation.reshape(-1, 9), first).reshape(-1, 3, 3)
            self.paths[rotations] = means, block_means(poses.position_mm, first)
        return self.paths[rotations]
