r"""Array, lever arm and rotations of a scan, held against other arrangements by how well its frames agree.

Where frames overlap, they feel one breast. Read in a wrong arrangement (rows backwards, a lever arm upside down,
quaternions in another order) they contradict each other. Each arrangement of `CORRECTIONS` is judged by how well frames
of other times predict a reading. Errors last for a while, so that a stretch of 0.2 s counts as one normal error of
unknown spread s: n stretches give one arrangement :math:`(s_2/s_1)^n` times the likelihood of another, and the odds are
that over the number of arrangements tried. Each correction has to earn `LIKELY_ODDS`.

A breast in which nothing stands out looks alike in all of them: then nothing is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import product
from math import exp, log
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.findings import Finding, finding, finding_lines
from tactile_bayes.geometry import FloatArray, apply, inverse, principal_axes
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.cells import FramePoses, poses_at
from tactile_bayes.mapping.convention import CoarseFrames
from tactile_bayes.mapping.latency import COMPARED, Cells, map_fit
from tactile_bayes.mapping.plausibility import SURE_ODDS, scan_doubts
from tactile_bayes.mapping.select import SelectedFrames, TaxelFault, scan_findings, select_frames
from tactile_bayes.presets import CORRECTIONS, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import ElementCalibration, HeadGeometry, PressureFrames, Scan, TrackerPoses

_ORDERS: Final = ("rows-reversed", "columns-reversed", "half-turn", "quarter-turn", "quarter-turn-back")
_ARRAY: Final = ((), *((name,) for name in _ORDERS))
_FRAMES: Final = ((), ("transposed",))
_LEVER: Final = ((), ("lever-inverse",), ("lever-none",))
_ROTATIONS: Final = tuple(convention.CONVENTIONS.values())

Corrections = tuple[str, ...]
Trial = tuple[Corrections, float]  #: Corrections, and by how many ms poses are later.

MOST_CHANGES: Final = 3
LIKELY_ODDS: Final = 10.0  #: From these odds on another arrangement is a caution, and the one stated counts as shown.
LEAST_EXPLAINED: Final = 0.3
"""Share of what varies over the skin that frames of other times predict in another arrangement, to be likely."""
CLOCK_MS: Final = (30, 60, 100, 150, 200, 300, 400, 500)
"""Times by which poses are tried to be late, and early; the best is found to 10 ms."""
LEAST_AGREEMENT: Final = 0.9
MOST_EXPLAINED: Final = 0.25
MOST_LASTING: Final = 0.5
LEAST_CONTRADICTION: Final = 0.02
"""Frames that explain less than `MOST_EXPLAINED`, with larger errors that last longer, contradict each other."""
LEAST_LASTING: Final = 0.15  #: Below it there is nothing but noise to compare.
_ROUNDING: Final = 1e-12  #: What varies no more, in readings over their frames' means, does not vary.
MOST_FRAMES: Final = 250
_ROUGH_FRAMES, _ROUGH_TOLERANCE, _ROUGH_BY = 60, 0.5, 0.15
"""What so many frames, fitted so far, gain is at most 0.05 too little where it matters (67 scans): 0.15 are allowed."""
_LEAST_BLOCKS: Final = 8
_CLOCK_STEPS_MS: Final = (-40, -30, -20, -10, 10, 20, 30, 40)
_OWN_LATENCY_MS: Final = (-20, -10, 10, 20)
"""Latencies that trackers have of their own, which poses that are late or early have to be likelier than."""
_BESIDE_MS: Final = (-100, 100)
"""And clocks beside the best: right scans of faint patterns agree better and better the farther a clock is off."""
LEAST_SWAY_MM, LEAST_SWAY_GAIN = 4.0, 0.25
"""Of a body that moved, against one that lies still and one that the strokes drag along: of 842 right scans one gains
0.19 by as much, all others 0.13 at most; breathing by 10 mm gains 0.31 to 1.0 where it shows (record 0136)."""
_SWAYS_HZ: Final = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
_SWAYS_TRIED, _SWAY_STEPS = 4, 5
_LEAST_SWAY_START: Final = 0.03
"""Of the squared errors, what the first step must take off for more: it does in 22 of 88 right scans whose errors last,
and in all of 32 that breathe."""
_LEAST_SWAY_GAINS: Final = {1: 0.04, 2: 0.1}
"""Gain after one and two steps, for more: 25 scans of bodies that breathe and come to `LEAST_SWAY_GAIN` have 0.067 and
0.14 at least by then."""
_SWAY_NUMBERS: Final = 5  # that are fitted: a rate, and cosine and sine along two axes
_LEAST_OTHERS: Final = 2  #: Readings of other times that predict one.
NOTHING_SHOWN: Final = "too little stands out to show that array, lever arm and quaternions are as stated"
NOT_CHECKED: Final = finding(
    "arrangement_unknown",
    "how the sensor array and the tracker are mounted was never checked, and this scan does not show it",
    "scan a phantom with a lump once, run `tactile-bayes check PHANTOM.mcap -o HEAD.json`, and give --head-geometry "
    "HEAD.json from then on",
    "scan a phantom with a lump once and have it checked",
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
        wxyz = convention.corrected_quaternions(poses.quaternion_wxyz, [name])
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

    corrections: Corrections  #: What was corrected; empty for the scan as it is stated.
    spread: float  #: Root mean square of these errors, of the frames' mean pressure.
    explained: float  #: Share of the variance over the skin that is predicted.
    lasting: float
    """Correlation of a taxel's errors from one frame to the next: noise has little, contradictions last."""
    agreement: float
    """Inner product of the mean normal of the face and the normal of all places: a head slides along its face."""
    late_ms: float = 0.0  #: By how much poses are later than stated; below 0 earlier.
    sway_mm: float = 0.0
    sways_a_minute: float = 0.0
    """`sway_mm`, `sways_a_minute`: How far and how often the body moved to and fro."""

    @property
    def in_words(self) -> str:
        """What is wrong if this one is right."""
        if self.sway_mm:
            often = f"{self.sways_a_minute:.0f} times a minute"
            return f"the body moved to and fro by {self.sway_mm:.0f} mm, {often}, as breathing moves it"
        if self.late_ms:
            way = "late" if self.late_ms > 0 else "early"
            return f"the poses' times are {abs(self.late_ms):.0f} ms too {way} against the frames'"
        return " and ".join(CORRECTIONS[name] for name in self.corrections) or "all is as it is stated"

    @property
    def plausible(self) -> bool:
        """True where the head slides along its face, and frames predict what varies."""
        return self.agreement >= LEAST_AGREEMENT and self.explained >= LEAST_EXPLAINED

    @property
    def contradicting(self) -> bool:
        """True where frames contradict each other by more than a head's response leaves."""
        return self.explained < MOST_EXPLAINED and self.lasting > MOST_LASTING and self.spread > LEAST_CONTRADICTION

    @property
    def changes(self) -> int:
        """How many things of the scan as it is stated are wrong if this one is right."""
        return len(self.corrections) + bool(self.late_ms)

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
    log_odds: float  #: For `best` against `stated`; 0 where they are the same.
    excluded: Mapping[str, float]  #: Log odds for what is stated against each correction alone.
    contradicting: bool = False  #: True where frames contradict each other whatever is corrected.
    asked_ms: float = 0.0  #: Latency that the poses were stated to have.
    doubts: tuple[Finding, ...] = ()
    """What was noted of the scan, and what in it is unlike an exam, where it was looked for."""

    @property
    def refused(self) -> bool:
        """True where another arrangement wins clearly; another clock can be stated to `map`."""
        return self.log_odds >= log(SURE_ODDS) and bool(self.best.corrections)

    @property
    def not_shown(self) -> tuple[str, ...]:
        """Corrections that these frames neither ask for nor exclude."""
        return tuple(name for name, odds in self.excluded.items() if odds < log(LIKELY_ODDS))

    @property
    def says_nothing(self) -> bool:
        """True where the frames do not exclude each other order of the array."""
        return self.best is self.stated and any(name in self.not_shown for name in _ORDERS)

    @property
    def too_short(self) -> bool:
        """True where the scan has too few frames to compare any."""
        return not self.excluded

    @property
    def _told(self) -> tuple[str, Finding | None]:
        """What the frames agree with, in one sentence, and what speaks against the scan as it is stated, with what to
        check, or to state to `map`, or to correct."""
        best, stated = (f"{100 * one.spread:.1f} %" for one in (self.best, self.stated))
        if self.too_short:
            return TOO_SHORT, None
        if self.says_nothing and not self.contradicting:
            return NOTHING_SHOWN, None
        if self.contradicting:
            words = f"frames contradict each other by {best} where they overlap, in every arrangement tried"
            return words, finding(
                "frames_contradict",
                "strokes over one place do not agree on what they felt there; size and place may be wrong",
                "check the lever arm, both clocks, and that the breast lay still",
                "make sure that the breast lies still, and have the tracker's mounting and its clock checked",
            )
        if self.best is self.stated:
            return f"array, lever arm and quaternions are as stated: overlapping frames agree to {stated}", None
        odds = f"(odds {odds_words(self.log_odds)}): overlapping frames agree to {best} if so, to {stated} as stated"
        words = f"{self.best.in_words} {odds}"
        if self.best.late_ms:
            return words, finding(
                "late_poses",
                "the tracker's times do not fit those of the sensor array; size and place may be wrong",
                f"map it with --latency-ms {self.asked_ms + self.best.late_ms:.0f}",
                "have the scan mapped again with the tracker's delay",
            )
        if self.best.sway_mm:
            return words, finding(
                "frames_contradict",
                "the body moved to and fro during the scan, as breathing moves it; size and place may be wrong",
                "record with a reference tool on the body (--reference), or have the breath held",
                "have the scan taken again with the breath held",
            )
        return words, finding(
            "wrong_arrangement",
            "the sensor array or the tracker seems not to be mounted as stated; size and place may be wrong",
            convention.import_again(self.best.corrections),
            "have it checked how the array and the tracker are mounted",
        )

    @property
    def words(self) -> str:
        """What the frames agree with, in one sentence."""
        return self._told[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against a map made of the scan as it is stated."""
        words, found = self._told
        if found is None:
            return (NOT_CHECKED,) if self.says_nothing else ()
        return (replace(found, remedy=f"{words}; {found.remedy}"),)

    def findings_of(self, scan: Scan) -> tuple[Finding, ...]:
        """The same; that nothing is shown is no finding where the scan's head was checked by another scan."""
        return tuple(one for one in self.findings if one is not NOT_CHECKED or not scan.head.checked_on)

    @property
    def remedy(self) -> str:
        """What to check or, where another arrangement is better, to state to `map` or to correct by `import`."""
        return (self._told[1] or NOT_CHECKED).remedy if self.findings else ""

    def lines(self) -> list[str]:
        """The answer in full: what the frames agree with, what they exclude, what they leave open, and what to do."""
        lines = [*finding_lines(self.doubts), self.words, *([self.remedy] if self.findings else [])]
        if self.best is self.stated and not self.says_nothing:
            surest = sorted(self.excluded.items(), key=lambda pair: -min(pair[1], log(1e6)))
            odds = {name: odds_words(found) for name, found in surest if name not in self.not_shown}
            for words in dict.fromkeys(odds.values()):
                lines.append(f"excluded (odds {words}): {', '.join(name for name in odds if odds[name] == words)}")
            lines += [f"not excluded: {CORRECTIONS[name]}" for name in self.not_shown]
        return lines


def odds_words(log_odds: float) -> str:
    """Odds to a power of ten; beyond a million to one the figure means nothing."""
    tens = int(log_odds / log(10))
    return "above 10^6" if tens >= 6 else f"10^{tens}" if tens >= 3 else f"{exp(log_odds):.0f}"


def check_arrangement(selection: SelectedFrames, *, latency_ms: float = 0.0, thorough: bool = True) -> ArrangementCheck:
    """Compare arrangements of up to `MOST_CHANGES` corrections, or of one where that or none fits, unless `thorough`.

    The best is the likeliest that is plausible, with `LIKELY_ODDS` against each of its corrections; where none is
    better than the one stated, a body that moved is tried.
    """
    overlap = _Overlap.of(selection, latency_ms)
    if overlap is None:
        return _TOO_SHORT
    # what to try, the fewest corrections first; of a lever arm that is none, none of the lever arm
    lever = _LEVER[:1] if np.allclose(selection.scan.head.scanhead_from_tracker, np.eye(4)) else _LEVER
    every: list[Corrections] = [sum(parts, ()) for parts in product(_ARRAY, _FRAMES, lever, _ROTATIONS)]
    others = sorted((one for one in every if 0 < len(one) <= MOST_CHANGES), key=len)
    single = [one for one in others if len(one) == 1]
    stated = overlap.still[0]
    if _lasting(overlap.array.varying) < LEAST_LASTING:
        return ArrangementCheck(stated, stated, 0.0, {one[0]: 0.0 for one in single})
    trials: list[Trial] = [(one, 0.0) for one in single]
    trials += [((), float(sign * ms)) for ms in CLOCK_MS for sign in (1, -1)]
    rough = None if thorough else _Overlap.of(selection, latency_ms, rough=True)
    if rough is not None:
        close, excluded = _screened(rough, trials, stretches=overlap.stretches)
        check = _compared(overlap, [stated, *(overlap.judged(*one) for one in close)], tried=len(trials) + 1)
        if check.best is stated and not check.contradicting:
            return _still(overlap, replace(check, excluded={**excluded, **check.excluded}))
    judged = [stated, *(overlap.judged(*one) for one in trials)]
    check = _compared(overlap, judged, tried=len(judged))
    if thorough or check.contradicting or check.best.corrections:
        judged += map(overlap.judged, others[len(single) :])
        check = _compared(overlap, judged, tried=len(judged))
    return check if check.best is not stated else _still(overlap, check)


def _screened(rough: _Overlap, trials: Sequence[Trial], *, stretches: int) -> tuple[list[Trial], dict[str, float]]:
    """The trials that a quarter of the frames does not rule out, and log odds against the corrections that it does.

    Ruled out is what gains too little to be the best by far, and of the array's orders what is excluded too.
    """
    stated, close, excluded = rough.still[0], [], {}
    for trial in trials:
        gain = rough.judged(*trial).gain_over(stated)
        odds = -stretches * gain - log(len(trials) + 1)
        if stretches * (gain + _ROUGH_BY) >= log(LIKELY_ODDS) or (trial[0] in _ARRAY[1:] and odds < log(LIKELY_ODDS)):
            close.append(trial)
        elif trial[0]:
            excluded[trial[0][0]] = odds
    return close, excluded


def _compared(overlap: _Overlap, judged: Sequence[Arrangement], *, tried: int) -> ArrangementCheck:
    """The best of the arrangements judged, of so many tried, against the first, which is stated."""
    stated, stretches = judged[0], overlap.stretches
    likely = [one for one in judged if one is stated or one.plausible]
    best = max(likely, key=lambda one: stretches * one.gain_over(stated) - log(LIKELY_ODDS) * one.changes)
    against, beside = stated, np.inf
    if best.late_ms:
        near = [overlap.judged((), best.late_ms + step) for step in _CLOCK_STEPS_MS]
        best = max([best, *near], key=lambda one: one.gain_over(stated))
        own = [overlap.judged((), ms) for ms in _OWN_LATENCY_MS]
        against = max([stated, *own], key=lambda one: one.gain_over(stated))
        beside = min(best.gain_over(overlap.judged((), best.late_ms + ms)) for ms in _BESIDE_MS)
    excluded = {
        one.corrections[0]: stretches * stated.gain_over(one) - log(tried)
        for one in judged
        if len(one.corrections) == 1
    }
    log_odds = stretches * best.gain_over(against) - log(tried)
    if best is stated or min(log_odds, stretches * beside - log(tried)) < log(LIKELY_ODDS):
        return ArrangementCheck(stated, stated, 0.0, excluded, stated.contradicting)
    return ArrangementCheck(stated, best, log_odds, excluded, asked_ms=overlap.latency_ms)


def _still(overlap: _Overlap, check: ArrangementCheck) -> ArrangementCheck:
    """The check, or that the body moved where frames agree better then."""
    stated, stretches = check.stated, overlap.stretches
    if stated.lasting < MOST_LASTING:
        return check
    moved = overlap.swaying()
    if moved is None or moved.sway_mm < LEAST_SWAY_MM or moved.gain_over(stated) < LEAST_SWAY_GAIN:
        return check
    gain = min(moved.gain_over(stated), moved.gain_over(overlap.dragged()))
    log_odds = stretches * gain - _SWAY_NUMBERS
    if gain < LEAST_SWAY_GAIN or log_odds < log(LIKELY_ODDS):
        return check
    return replace(check, best=moved, log_odds=log_odds, contradicting=False)


def check_scan(
    scan: Scan, *, pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA, thorough: bool = True
) -> ArrangementCheck:
    """Check a scan as it is recorded, with its frames within the window.

    A scan without a frame that can be used is a `BadDataError`.
    """
    selection = select_frames(scan, pressure_window_kpa=pressure_window_kpa)
    doubts = (*scan_findings(scan), *scan_doubts(selection, pressure_window_kpa=pressure_window_kpa))
    return replace(check_arrangement(selection, thorough=thorough), doubts=doubts)


_NOT_JUDGED: Final = Arrangement((), spread=0.0, explained=0.0, lasting=0.0, agreement=0.0)
_TOO_SHORT: Final = ArrangementCheck(_NOT_JUDGED, _NOT_JUDGED, 0.0, {})


def _lasting(values: FloatArray) -> float:
    """Correlation of (m, k) values from one averaged frame to the next."""
    square = float(np.sum(values**2))
    return float(np.sum(values[1:] * values[:-1])) / square if square > _ROUNDING**2 * values.size else 0.0


def _moves(course: FloatArray, slope: FloatArray, error: FloatArray) -> tuple[float, FloatArray]:
    """How much less the squared (n,) errors are for moves with each of (m, a) courses, and these (a, 2) moves, mm, from
    the map's (n, 2) slopes there.
    """
    slope, error = slope.reshape(len(course), -1, 2), error.reshape(len(course), -1)
    of_frame, right = slope.swapaxes(1, 2) @ slope, (error[:, None] @ slope)[:, 0]
    normal = np.einsum("ma,mb,mij->aibj", course, course, of_frame).reshape(course.shape[1] * 2, -1)
    pull = (course.T @ right).reshape(-1)
    moves = np.linalg.lstsq(normal, pull, rcond=None)[0]
    return float(pull @ moves), moves.reshape(-1, 2)


_Fit = tuple[Arrangement, Cells, FloatArray, FloatArray]


class _Overlap(Record, eq=False, dict=True):
    """Averaged frames of a scan, and what is needed to place them."""

    selection: SelectedFrames  #: Of a scan with distinct poses.
    latency_ms: float
    array: CoarseFrames  #: As it is stated.
    rough: bool  #: True for fewer frames, whose map is fitted less closely.
    paths: dict[Corrections, FramePoses] = field(default_factory=dict)
    """Mean pose of the tracker at each averaged frame, for the corrections of rotations asked so far."""

    @classmethod
    def of(cls, stated: SelectedFrames, latency_ms: float, *, rough: bool = False) -> _Overlap | None:
        selection = replace(stated, scan=replace(stated.scan, poses=stated.fresh))
        used, all_s = np.flatnonzero(stated.used), stated.scan.frames.time_s
        if not len(used):
            return None
        every = convention.thinning([all_s[used]], most=_ROUGH_FRAMES if rough else MOST_FRAMES)
        found = cls(
            selection, latency_ms, CoarseFrames.of(selection, used[convention.every_stretch(all_s[used], every)]), rough
        )
        return found if found.stretches >= _LEAST_BLOCKS else None

    @property
    def stretches(self) -> int:
        """Stretches of 0.2 s that hold frames."""
        return int(self.array.block.max()) + 1

    @cached_property
    def transposed(self) -> CoarseFrames:
        """The array read in the other order."""
        bad = np.argwhere(~_rearranged(self.selection.good_taxels, "transposed")).tolist()
        faults = tuple(TaxelFault(row, column, "left out") for row, column in bad)
        scan = corrected(self.selection.scan, ["transposed"])
        return CoarseFrames.of(replace(self.selection, scan=scan, faults=faults), self.array.frames)

    @cached_property
    def stated_places(self) -> tuple[FloatArray, float]:
        """As `_places_mm` has them without corrections: a body that moves is held against them many times."""
        return self._places_mm(())

    @cached_property
    def still(self) -> _Fit:
        """What is stated, of a body that lies still, as `_fitted` has it."""
        return self._fitted(())

    def judged(self, corrections: Corrections, late_ms: float = 0.0) -> Arrangement:
        """Predict each averaged reading by those of other times in its cell, with poses that are later by so much."""
        if not late_ms:
            return self._fitted(corrections)[0]
        other = replace(self, latency_ms=self.latency_ms + late_ms, paths={})
        return replace(other.judged(corrections), late_ms=late_ms)

    def swaying(self) -> Arrangement | None:
        """What is stated, of a body that moves to and fro along its skin at the best rate.

        None where the first step takes off little.
        """
        array, (_, cells, levelled, error) = self.array, self.still
        time_s = convention.block_means(self.selection.scan.frames.time_s[array.frames, None], array.first)
        slope = cells.gradient(levelled)
        waves = {rate: np.hstack([np.cos(turn := 2 * np.pi * rate * time_s), np.sin(turn)]) for rate in _SWAYS_HZ}
        gains = {rate: _moves(wave, slope, error)[0] for rate, wave in waves.items()}
        if max(gains.values()) < _LEAST_SWAY_START * float(error @ error):
            return None
        found = []
        for rate in sorted(gains, key=gains.__getitem__)[-_SWAYS_TRIED:]:
            made, sway = self._moving(waves[rate], least=_LEAST_SWAY_GAINS)
            found.append(replace(made, sway_mm=2 * float(np.linalg.norm(sway, 2)), sways_a_minute=60 * rate))
        return min(found, key=lambda one: one.spread)

    def dragged(self) -> Arrangement:
        """What is stated, of a body that the strokes drag along.

        What a head feels follows its strokes by up to a fifth of their way, and where strokes are as slow as breaths
        the body seems to move.
        """
        path = self.stated_places[0].mean(axis=1)
        strokes = (path - path.mean(axis=0)) @ principal_axes(path)[:, [-1]]
        return self._moving(strokes, least={})[0]

    def _moving(self, course: FloatArray, *, least: Mapping[int, float]) -> tuple[Arrangement, FloatArray]:
        """What is stated, of a body that moves with (m, a) courses, by Gauss-Newton steps; and its (a, 2) moves, mm.

        It is given up after a step, by its number, that has gained less than `least`.
        """
        moves, (made, cells, levelled, error) = np.zeros((course.shape[1], 2)), self.still
        for step in range(1, _SWAY_STEPS + 1):
            moves += _moves(course, cells.gradient(levelled), error)[1]
            made, cells, levelled, error = self._fitted((), (course @ moves)[:, None])
            if made.gain_over(self.still[0]) < least.get(step, -np.inf):
                break
        return made, moves

    def _fitted(self, corrections: Corrections, moves_mm: FloatArray | float = 0.0) -> _Fit:
        """The arrangement judged with places moved by (m, 1, 2), the cells, levelled readings, and their errors."""
        array = self.transposed if "transposed" in corrections else self.array
        places, agreement = self._places_mm(corrections) if corrections else self.stated_places
        varying, cells = array.varying, Cells.of([places + moves_mm])
        values, block = varying.reshape(-1), np.repeat(array.block, varying.shape[1])
        tolerance = _ROUGH_TOLERANCE if self.rough else COMPARED
        rest, levelled = map_fit([array], values, cells, tolerance=tolerance, within=not self.rough)
        # by another clock the first or last frames have no pose: kept at one place they would seem to agree
        placed = np.repeat(self._path(corrections).known.astype(np.float64), varying.shape[1])
        cell = cells.number
        together = block * (int(cell.max()) + 1) + cell  # readings of one block in one cell
        total, count = np.bincount(cell, placed * rest), np.bincount(cell, placed)
        others = count[cell] - np.bincount(together, placed)[together]
        predicted = total[cell] - np.bincount(together, placed * rest)[together]
        error = placed * values  # of what no others predict
        known = (placed > 0) & (others >= _LEAST_OTHERS)
        error[known] = rest[known] - predicted[known] / others[known]
        total_square, variance = float(error @ error), float(placed @ values**2)
        made = Arrangement(
            corrections,
            spread=float(np.sqrt(total_square / max(float(placed.sum()), 1.0))),
            explained=1 - total_square / variance if variance else 0.0,
            lasting=_lasting(error.reshape(varying.shape)),
            agreement=agreement,
        )
        return made, cells, levelled, error

    def _places_mm(self, corrections: Corrections) -> tuple[FloatArray, float]:
        """(m, k, 2) places of the averaged readings on the plane in which they lie, and how the face agrees with it."""
        array, scan = self.transposed if "transposed" in corrections else self.array, self.selection.scan
        surface = scan.head.surface_mm
        for name in set(corrections) & {"rows-reversed", "columns-reversed", "half-turn"}:
            surface = np.stack([_rearranged(surface[..., i], name) for i in range(3)], axis=-1)
        mounted = corrected(scan, (name for name in corrections if name.startswith(("lever", "quarter"))))
        tracker_from_head = inverse(mounted.head.scanhead_from_tracker)
        on_tracker = array.weight.T @ apply(tracker_from_head, surface.reshape(-1, 3)[array.taxels])
        middle, path = on_tracker.mean(axis=0), self._path(corrections)
        centre, around = path.places_mm(middle), on_tracker - middle
        spread = len(around) * np.cov(centre.T, bias=True) + np.mean(
            path.rotation @ (around.T @ around) @ path.rotation.swapaxes(1, 2), axis=0
        )
        axes = np.linalg.eigh(spread)[1]
        plane, normal = axes[:, [2, 1]].T, axes[:, 0]
        place = (centre @ plane.T)[:, :, None] + plane @ path.rotation @ around.T
        agreement = abs(float(normal @ (path.rotation @ tracker_from_head[:3, 2]).mean(axis=0)))
        return place.swapaxes(1, 2), agreement

    def _path(self, corrections: Corrections) -> FramePoses:
        """Mean poses of the tracker at the averaged frames; known where all lie between its first and its last."""
        rotations = tuple(name for name in corrections if name in _ROTATIONS[-1])
        if rotations not in self.paths:
            scan, first = corrected(self.selection.scan, rotations), self.array.first
            time_s = scan.frames.time_s[self.array.frames]
            poses = poses_at(scan.poses, time_s, latency_ms=self.latency_ms, max_gap_ms=np.inf)
            means = convention.block_means(poses.rotation.reshape(-1, 9), first).reshape(-1, 3, 3)
            known = np.logical_and.reduceat(poses.known, first)
            self.paths[rotations] = FramePoses(convention.block_means(poses.position_mm, first), means, known)
        return self.paths[rotations]
