r"""Comparison of a scan's stated arrangement (array, lever arm, rotations, clock) with others, by how frames agree.

Frames that overlap feel one breast; in a wrong arrangement they contradict each other (record 0136). With a prediction
error of spread s in each of n stretches of 0.2 s, the likelihood ratio of two arrangements is :math:`(s_2/s_1)^n`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import product
from math import exp, log
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.findings import Finding, finding, finding_lines
from tactile_bayes.geometry import FloatArray, apply, inverse, principal_axes
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.cells import FramePoses, poses_at
from tactile_bayes.mapping.convention import CoarseFrames, corrected, reordered
from tactile_bayes.mapping.latency import COMPARED_TOLERANCE, Cells, map_fit
from tactile_bayes.mapping.plausibility import SURE_ODDS, scan_doubts
from tactile_bayes.mapping.select import SelectedFrames, TaxelFault, scan_findings, select_frames
from tactile_bayes.presets import CORRECTIONS, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import Scan

_ARRAY_ORDERS: Final = ("rows-reversed", "columns-reversed", "half-turn", "quarter-turn", "quarter-turn-back")
_ARRAY: Final = ((), *((name,) for name in _ARRAY_ORDERS))
_FRAMES: Final = ((), ("transposed",))
_LEVER: Final = ((), ("lever-inverse",), ("lever-none",))
_ROTATIONS: Final = tuple(convention.CONVENTIONS.values())

Corrections = tuple[str, ...]
Trial = tuple[Corrections, float]  #: Corrections, and by how many ms poses are later.

MOST_CHANGES: Final = 3
LIKELY_ODDS: Final = 10.0  #: Odds for another arrangement that make a caution, and for the stated one that exclude it.
LEAST_EXPLAINED: Final = 0.3
"""Least share of the variance over the skin that frames of other times predict in a plausible arrangement."""
CLOCK_MS: Final = (30, 60, 100, 150, 200, 300, 400, 500)
"""Delays of the poses that are tried, either way; the best is refined to 10 ms."""
LEAST_AGREEMENT: Final = 0.9
MOST_EXPLAINED: Final = 0.25
MOST_LASTING: Final = 0.5
LEAST_CONTRADICTION: Final = 0.02
"""Frames contradict each other that explain less than `MOST_EXPLAINED`, with a correlation of successive errors above
`MOST_LASTING` and a spread above `LEAST_CONTRADICTION`."""
LEAST_LASTING: Final = 0.15  #: Readings that correlate less from frame to frame are noise: there is nothing to compare.
_ROUNDING: Final = 1e-12  #: Readings over their frames' means that vary less than this do not vary.
MOST_FRAMES: Final = 250
_ROUGH_FRAMES, _ROUGH_TOLERANCE, _ROUGH_MARGIN = 60, 0.5, 0.15
"""Frames and tolerance of the rough fit, and the margin for its gains: they were at most 0.05 too low in 67 scans."""
_LEAST_BLOCKS: Final = 8
_CLOCK_STEPS_MS: Final = (-40, -30, -20, -10, 10, 20, 30, 40)
_TRACKER_LATENCIES_MS: Final = (-20, -10, 10, 20)
"""Usual latencies of trackers: another clock must be likelier than all of them."""
_CLOCKS_BESIDE_MS: Final = (-100, 100)
"""Distances of two clocks that the best must beat: on faint patterns right scans agree better the farther off it is."""
LEAST_SWAY_MM, LEAST_SWAY_GAIN = 4.0, 0.25
"""Least motion of a body that moved, and its least gain over one that lies still and one that the strokes drag along:
one of 842 right scans gains 0.19, all others 0.13 at most; breathing by 10 mm gains 0.31 to 1.0 (record 0136)."""
_SWAYS_HZ: Final = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
_SWAYS_TRIED, _SWAY_STEPS = 4, 5
LEAST_LEVER_MM, LEAST_LEVER_GAIN = 8.0, 0.12
"""Least error of a lever arm that is named, and its least gain over the stated one and over a body that the strokes
drag along: one of 66 right scans by another simulator gains 0.04, all others 0.02 at most."""
_LEAST_SWAY_FIRST_STEP: Final = 0.03
"""Least share of the squared errors that the first step removes, or no more are made: 22 of 88 right scans whose errors
last reach it, and all of 32 that breathe."""
_LEAST_SWAY_GAINS: Final = {1: 0.04, 2: 0.1}
"""Least gain after one and two steps, or no more are made: 25 scans of breathing bodies that reach `LEAST_SWAY_GAIN`
have at least 0.067 and 0.14 by then."""
_BREATHED: Final = (
    "the body moved to and fro during the scan, as breathing moves it; size and place may be wrong",
    "record with a reference tool on the body (--reference), or have the breath held",
    "have the scan taken again with the breath held",
)
_DRIFTED: Final = (
    "the body moved or the tracker drifted during the scan; size and place may be wrong",
    "let the tracker warm up and keep metal away, have the breath held, or record with a reference tool (--reference)",
    "have the scan taken again with the tracker warmed up and the breath held",
)
_SWAY_PARAMETERS: Final = 5  #: A rate, and cosine and sine along two axes.
_LEVER_PARAMETERS: Final = 2  #: Along two axes.
_LEAST_OTHERS: Final = 2  #: Fewest readings of other times that predict one.
NOTHING_SHOWN: Final = "too little stands out to show that array, lever arm and quaternions are as stated"
NOT_CHECKED: Final = finding(
    "arrangement_unknown",
    "how the sensor array and the tracker are mounted was never checked, and this scan does not show it",
    "scan a phantom with a lump once, run `tactile-bayes check PHANTOM.mcap -o HEAD.json`, and give --head-geometry "
    "HEAD.json from then on",
    "scan a phantom with a lump once and have it checked",
)
TOO_SHORT: Final = "too few frames to compare arrangements"


class Arrangement(Record, eq=False):
    """One arrangement, and how well frames of other times predict a reading in it."""

    corrections: Corrections  #: Corrections made; empty for the scan as it is stated.
    spread: float  #: Root mean square of the prediction errors, over the frame's mean pressure.
    explained: float  #: Share of the variance over the skin that is predicted.
    lasting: float
    """Correlation of a taxel's errors from one frame to the next: small for noise, large for contradictions."""
    agreement: float
    """Inner product of the face's mean normal and the normal of all places: a head slides along its face."""
    late_ms: float = 0.0  #: Delay of the poses beside the stated one; below 0 they are early.
    sway_mm: float = 0.0
    sways_a_minute: float = 0.0
    """`sway_mm`, `sways_a_minute`: Distance and rate of the body's motion to and fro."""
    lever_mm: float = 0.0  #: How far the lever arm's end lies from where it is stated.
    poses: tuple[str, ...] = ()  #: How the poses are made, if otherwise than as stated, and what to do then.

    @property
    def in_words(self) -> str:
        """Sentence on the mistake that was made if this arrangement is the right one."""
        if self.sway_mm:
            often = f"{self.sways_a_minute:.0f} times a minute"
            cause = "a tracker that drifts or slow breathing moves" if self.slow else "breathing moves"
            return f"the body moved to and fro by {self.sway_mm:.0f} mm, {often}, as {cause} it"
        if self.lever_mm:
            return f"the head lies about {self.lever_mm:.0f} mm from where the lever arm puts it"
        if self.late_ms:
            way = "late" if self.late_ms > 0 else "early"
            return f"the poses' times are {abs(self.late_ms):.0f} ms too {way} against the frames'"
        mistakes = self.poses[:1] or [CORRECTIONS[name] for name in self.corrections]
        return " and ".join(mistakes) or "all is as it is stated"

    @property
    def slow(self) -> bool:
        """True for the slowest motion tried, which a steady drift of the tracker resembles most."""
        return self.sways_a_minute <= 60 * _SWAYS_HZ[0]

    @property
    def plausible(self) -> bool:
        """True where the head slides along its face and frames predict each other."""
        return self.agreement >= LEAST_AGREEMENT and self.explained >= LEAST_EXPLAINED

    @property
    def contradicting(self) -> bool:
        """True where frames differ by more than the response of a head explains."""
        return self.explained < MOST_EXPLAINED and self.lasting > MOST_LASTING and self.spread > LEAST_CONTRADICTION

    @property
    def changes(self) -> int:
        """Number of mistakes that were made if this arrangement is the right one."""
        return len(self.corrections) + bool(self.late_ms)

    def gain_over(self, other: Arrangement) -> float:
        """Natural log of the likelihood ratio to `other` per stretch, by errors or by unexplained variance.

        The smaller counts: frames and taxels absorb another part of the variance in each arrangement.
        """
        error_ratio = (other.spread + 1e-12) / (self.spread + 1e-12)
        unexplained_ratio = (1 - other.explained + 1e-12) / (1 - self.explained + 1e-12)
        return min(log(error_ratio), log(unexplained_ratio) / 2)


class ArrangementCheck(Record, eq=False):
    """The stated arrangement, and the simplest with which the frames agree."""

    stated: Arrangement
    best: Arrangement
    log_odds: float  #: For `best` against `stated`; 0 where they are the same.
    excluded: Mapping[str, float]  #: Log odds for the stated arrangement against each correction alone.
    contradicting: bool = False  #: True where frames contradict each other in every arrangement tried.
    stated_latency_ms: float = 0.0
    doubts: tuple[Finding, ...] = ()  #: Findings of the recorder and on what is unlike an exam; empty where not sought.

    @property
    def refused(self) -> bool:
        """True where `map` refuses the scan: another arrangement is sure. Another clock can be stated to it."""
        return self.log_odds >= log(SURE_ODDS) and bool(self.best.corrections or self.best.poses)

    @property
    def not_shown(self) -> tuple[str, ...]:
        """Corrections for and against which the frames say too little."""
        return tuple(name for name, odds in self.excluded.items() if odds < log(LIKELY_ODDS))

    @property
    def inconclusive(self) -> bool:
        """True where the frames leave open in which order the array is read."""
        return self.best is self.stated and any(name in self.not_shown for name in _ARRAY_ORDERS)

    @property
    def too_short(self) -> bool:
        """True where the scan has too few frames to compare arrangements."""
        return not self.excluded

    @property
    def _verdict(self) -> tuple[str, Finding | None]:
        """Sentence on the arrangement that the frames agree with, and the finding against the stated one, if any."""
        best, stated = (f"{100 * one.spread:.1f} %" for one in (self.best, self.stated))
        if self.too_short:
            return TOO_SHORT, None
        if self.inconclusive and not self.contradicting:
            return NOTHING_SHOWN, None
        if self.contradicting:
            words = f"frames contradict each other by {best} where they overlap, in every arrangement tried"
            return words, finding(
                "frames_contradict",
                "strokes over one place do not agree on what they felt there; size and place may be wrong",
                "check the lever arm, the unit of the positions, both clocks, and that the breast lay still",
                "make sure that the breast lies still, and have the tracker's mounting and its clock checked",
            )
        if self.best is self.stated:
            return f"array, lever arm and quaternions are as stated: overlapping frames agree to {stated}", None
        odds = f"(odds {odds_words(self.log_odds)}): overlapping frames agree to {best} if so, to {stated} as stated"
        words = f"{self.best.in_words} {odds}"
        if self.best.late_ms:
            averaged = "; late frames may be averaged over time, which smears the lump: turn that off at the array"
            return words, finding(
                "late_poses",
                "the tracker's times do not fit those of the sensor array; size and place may be wrong",
                f"map it with --latency-ms {self.stated_latency_ms + self.best.late_ms:.0f}"
                + (averaged if self.best.late_ms < 0 else ""),
                "have the scan mapped again with the tracker's delay",
            )
        if self.best.sway_mm:
            return words, finding("frames_contradict", *(_DRIFTED if self.best.slow else _BREATHED))
        if self.best.lever_mm:
            remedy = "measure the lever arm again; where it is right, the body moved: have the breath held"
        else:
            remedy = self.best.poses[1] if self.best.poses else convention.import_again(self.best.corrections)
        return words, finding(
            "wrong_arrangement",
            "the sensor array or the tracker seems not to be mounted as stated; size and place may be wrong",
            remedy,
            "have it checked how the array and the tracker are mounted",
        )

    @property
    def words(self) -> str:
        """Sentence on the arrangement that the frames agree with."""
        return self._verdict[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings against a map made of the scan as it is stated."""
        words, against = self._verdict
        if against is None:
            return (NOT_CHECKED,) if self.inconclusive else ()
        return (replace(against, remedy=f"{words}; {against.remedy}"),)

    def findings_of(self, scan: Scan) -> tuple[Finding, ...]:
        """`findings` without `NOT_CHECKED` where another scan has shown how the scan's head is mounted."""
        return tuple(one for one in self.findings if one is not NOT_CHECKED or not scan.head.checked_on)

    @property
    def remedy(self) -> str:
        """Remedy of the finding: to check something, to state it to `map`, or to correct it by `import`."""
        return (self._verdict[1] or NOT_CHECKED).remedy if self.findings else ""

    def lines(self) -> list[str]:
        """Lines of the report: doubts, the arrangement that fits, the remedy, and the corrections excluded or not."""
        lines = [*finding_lines(self.doubts), self.words, *([self.remedy] if self.findings else [])]
        if self.best is self.stated and not self.inconclusive:
            surest = sorted(self.excluded.items(), key=lambda pair: -min(pair[1], log(1e6)))
            odds = {name: odds_words(log_odds) for name, log_odds in surest if name not in self.not_shown}
            for words in dict.fromkeys(odds.values()):
                lines.append(f"excluded (odds {words}): {', '.join(name for name in odds if odds[name] == words)}")
            lines += [f"not excluded: {CORRECTIONS[name]}" for name in self.not_shown]
        return lines

    def __repr__(self) -> str:
        against = finding_lines((*self.doubts, *self.findings), paper=True)
        return f"<ArrangementCheck {' '.join([*against, self.words])}>"


def odds_words(log_odds: float) -> str:
    """Odds as a number or a power of ten; above a million the figure has no meaning of its own."""
    tens = int(log_odds / log(10))
    return "above 10^6" if tens >= 6 else f"10^{tens}" if tens >= 3 else f"{exp(log_odds):.0f}"


def check_arrangement(
    selection: SelectedFrames, *, latency_ms: float = 0.0, thorough: bool = True, other_poses: bool = False
) -> ArrangementCheck:
    """Compare the stated arrangement with all of up to `MOST_CHANGES` corrections, and with a body that moved.

    Unless `thorough`, several corrections are tried only where none alone fits. The best is the likeliest plausible
    arrangement, each of whose corrections must gain `LIKELY_ODDS`. Poses of another kind are tried with `other_poses`,
    and where something speaks against the stated arrangement.
    """
    overlap = _Overlap.of(selection, latency_ms)
    if overlap is None:
        return _TOO_SHORT
    check = _with_corrections(selection, overlap, thorough=thorough)
    doubted = check.best is not check.stated or check.contradicting or check.stated.agreement < convention.NEARLY_WHOLE
    return _with_other_poses(overlap, check) if doubted or other_poses else check


def _with_other_poses(overlap: _Overlap, check: ArrangementCheck) -> ArrangementCheck:
    """The check, with poses of another kind as the best arrangement where the frames agree with that alone."""
    rough = _Overlap.of(overlap.selection, overlap.latency_ms, rough=True) or overlap
    roughly = [replace(rough, paths={(): path}).judge(()) for _, path in convention.other_paths(rough.path(()))]
    closest = max(range(len(roughly)), key=lambda number: roughly[number].gain_over(rough.stated_fit[0]))
    words, path = list(convention.other_paths(overlap.path(())))[closest]
    other = replace(replace(overlap, paths={(): path}).judge(()), poses=words)
    odds, to_best = (overlap.stretches * other.gain_over(one) - log(len(roughly)) for one in (check.stated, check.best))
    if not other.plausible or odds < log(LIKELY_ODDS) or to_best < log(LIKELY_ODDS) * (1 - check.best.changes):
        return check
    return replace(check, best=other, log_odds=odds, contradicting=False)


def _with_corrections(selection: SelectedFrames, overlap: _Overlap, *, thorough: bool) -> ArrangementCheck:
    """The stated arrangement against corrections of it, other clocks, and a body that moved."""
    # an identity has no other lever arm to try
    lever = _LEVER[:1] if np.allclose(selection.scan.head.scanhead_from_tracker, np.eye(4)) else _LEVER
    combinations: list[Corrections] = [sum(parts, ()) for parts in product(_ARRAY, _FRAMES, lever, _ROTATIONS)]
    others = sorted((combination for combination in combinations if 0 < len(combination) <= MOST_CHANGES), key=len)
    single = [other for other in others if len(other) == 1]
    stated = overlap.stated_fit[0]
    if _successive_correlation(overlap.array.varying) < LEAST_LASTING:
        return ArrangementCheck(stated, stated, 0.0, {one[0]: 0.0 for one in single})
    trials: list[Trial] = [(one, 0.0) for one in single]
    trials += [((), float(sign * ms)) for ms in CLOCK_MS for sign in (1, -1)]
    rough = None if thorough else _Overlap.of(selection, overlap.latency_ms, rough=True)
    if rough is not None:
        close, excluded = _screened(rough, trials, stretches=overlap.stretches)
        check = _compared(overlap, [stated, *(overlap.judge(*one) for one in close)], tried=len(trials) + 1)
        if check.best is stated and not check.contradicting:
            return _with_sway(overlap, replace(check, excluded={**excluded, **check.excluded}))
    judged = [stated, *(overlap.judge(*trial) for trial in trials)]
    check = _compared(overlap, judged, tried=len(judged))
    if thorough or check.contradicting or check.best.corrections:
        judged += map(overlap.judge, others[len(single) :])
        check = _compared(overlap, judged, tried=len(judged))
    return check if check.best is not stated else _with_sway(overlap, check)


def _screened(rough: _Overlap, trials: Sequence[Trial], *, stretches: int) -> tuple[list[Trial], dict[str, float]]:
    """Trials that a rough fit does not rule out, and the log odds against the corrections that it does.

    A trial is ruled out whose gain is too low by `_ROUGH_MARGIN`; an order of the array must be excluded as well.
    """
    stated, close, excluded = rough.stated_fit[0], [], {}
    for trial in trials:
        gain = rough.judge(*trial).gain_over(stated)
        odds = -stretches * gain - log(len(trials) + 1)
        may_fit = stretches * (gain + _ROUGH_MARGIN) >= log(LIKELY_ODDS)
        if may_fit or (trial[0] in _ARRAY[1:] and odds < log(LIKELY_ODDS)):
            close.append(trial)
        elif trial[0]:
            excluded[trial[0][0]] = odds
    return close, excluded


def _compared(overlap: _Overlap, judged: Sequence[Arrangement], *, tried: int) -> ArrangementCheck:
    """Comparison of the best arrangement with the first, the stated one; the odds are divided by the number `tried`."""
    stated, stretches = judged[0], overlap.stretches
    likely = [one for one in judged if one is stated or one.plausible]
    best = max(likely, key=lambda one: stretches * one.gain_over(stated) - log(LIKELY_ODDS) * one.changes)
    against, beside = stated, np.inf
    if best.late_ms:
        near = [overlap.judge((), best.late_ms + step) for step in _CLOCK_STEPS_MS]
        best = max([best, *near], key=lambda one: one.gain_over(stated))
        usual = [overlap.judge((), ms) for ms in _TRACKER_LATENCIES_MS]
        against = max([stated, *usual], key=lambda one: one.gain_over(stated))
        beside = min(best.gain_over(overlap.judge((), best.late_ms + ms)) for ms in _CLOCKS_BESIDE_MS)
    excluded = {
        one.corrections[0]: stretches * stated.gain_over(one) - log(tried)
        for one in judged
        if len(one.corrections) == 1
    }
    log_odds = stretches * best.gain_over(against) - log(tried)
    if min(log_odds, stretches * beside - log(tried)) < log(LIKELY_ODDS):
        return ArrangementCheck(stated, stated, 0.0, excluded, stated.contradicting)
    return ArrangementCheck(stated, best, log_odds, excluded, stated_latency_ms=overlap.latency_ms)


def _with_sway(overlap: _Overlap, check: ArrangementCheck) -> ArrangementCheck:
    """The check, with a body that moved or another lever arm as the best arrangement where frames agree with that."""
    stated = check.stated
    if stated.lasting < MOST_LASTING:
        return check
    tried = (
        (overlap.fit_sway(), LEAST_SWAY_GAIN, _SWAY_PARAMETERS),
        (overlap.fit_turn(), LEAST_LEVER_GAIN, _LEVER_PARAMETERS),
    )
    for moved, least, parameters in tried:
        if moved is None or moved.gain_over(stated) < least:
            continue
        gain = min(moved.gain_over(stated), moved.gain_over(overlap.fit_drag()))
        log_odds = overlap.stretches * gain - parameters
        if gain >= least and log_odds >= max(check.log_odds, log(LIKELY_ODDS)):
            check = replace(check, best=moved, log_odds=log_odds, contradicting=False)
    return check


def check_scan(
    scan: Scan, *, pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA, thorough: bool = True
) -> ArrangementCheck:
    """Check a scan as recorded, by its frames within the window; `BadDataError` where there is none."""
    selection = select_frames(scan, pressure_window_kpa=pressure_window_kpa)
    doubts = (*scan_findings(scan), *scan_doubts(selection, pressure_window_kpa=pressure_window_kpa))
    check = check_arrangement(selection, thorough=thorough, other_poses=True)
    if not check.refused:
        convention.check_convention([selection])  # as map does, which refuses the scan
    return replace(check, doubts=doubts)


_NOT_JUDGED: Final = Arrangement((), spread=0.0, explained=0.0, lasting=0.0, agreement=0.0)
_TOO_SHORT: Final = ArrangementCheck(_NOT_JUDGED, _NOT_JUDGED, 0.0, {})


def _successive_correlation(values: FloatArray) -> float:
    """Correlation of (m, k) values between successive averaged frames."""
    square = float(np.sum(values**2))
    return float(np.sum(values[1:] * values[:-1])) / square if square > _ROUNDING**2 * values.size else 0.0


def _gauss_newton_step(course: FloatArray, slope: FloatArray, error: FloatArray) -> tuple[float, FloatArray]:
    """Decrease of the squared (n,) errors by a motion along (m, a) time courses, and its (a, 2) amplitudes in mm.

    Linear in the map's (n, 2) slopes.
    """
    slope, error = slope.reshape(len(course), -1, 2), error.reshape(len(course), -1)
    frame_normal, frame_gradient = slope.swapaxes(1, 2) @ slope, (error[:, None] @ slope)[:, 0]
    normal = np.einsum("ma,mb,mij->aibj", course, course, frame_normal).reshape(course.shape[1] * 2, -1)
    gradient = (course.T @ frame_gradient).reshape(-1)
    amplitudes = np.linalg.lstsq(normal, gradient, rcond=None)[0]
    return float(gradient @ amplitudes), amplitudes.reshape(-1, 2)


_Fit = tuple[Arrangement, Cells, FloatArray, FloatArray]


class _Overlap(Record, eq=False, dict=True):
    """Averaged frames of a scan, which overlap, and their fit in any arrangement."""

    selection: SelectedFrames  #: Of a scan with distinct poses.
    latency_ms: float
    array: CoarseFrames  #: Read as stated.
    rough: bool  #: True for fewer frames and a coarser tolerance.
    paths: dict[Corrections, FramePoses] = field(default_factory=dict)
    """Cache: mean pose of the tracker at each averaged frame, by corrections of the rotations."""

    @classmethod
    def of(cls, stated: SelectedFrames, latency_ms: float, *, rough: bool = False) -> _Overlap | None:
        """Average the used frames; None where they are too few to compare arrangements."""
        selection = replace(stated, scan=replace(stated.scan, poses=stated.fresh))
        frames, time_s = np.flatnonzero(stated.used), stated.scan.frames.time_s
        if not len(frames):
            return None
        every = convention.thinning([time_s[frames]], most=_ROUGH_FRAMES if rough else MOST_FRAMES)
        frames = frames[convention.every_stretch(time_s[frames], every)]
        overlap = cls(selection, latency_ms, CoarseFrames.of(selection, frames), rough)
        return overlap if overlap.stretches >= _LEAST_BLOCKS else None

    @property
    def stretches(self) -> int:
        """Number of stretches of 0.2 s with frames."""
        return int(self.array.block.max()) + 1

    @cached_property
    def transposed(self) -> CoarseFrames:
        """The frames with rows and columns of the array read in the other order."""
        bad = np.argwhere(~reordered(self.selection.good_taxels, "transposed")).tolist()
        faults = tuple(TaxelFault(row, column, "left out") for row, column in bad)
        scan = corrected(self.selection.scan, ["transposed"])
        return CoarseFrames.of(replace(self.selection, scan=scan, faults=faults), self.array.frames)

    @cached_property
    def stated_placement(self) -> tuple[FloatArray, float]:
        """`_placement` without corrections."""
        return self._placement(())

    @cached_property
    def stated_fit(self) -> _Fit:
        """`_fit` of the stated arrangement and a body that lies still."""
        return self._fit(())

    def judge(self, corrections: Corrections, late_ms: float = 0.0) -> Arrangement:
        """Arrangement with corrections and poses later by `late_ms`, judged by how well its frames agree."""
        if not late_ms:
            return self._fit(corrections)[0]
        delayed = replace(self, latency_ms=self.latency_ms + late_ms, paths={})
        return replace(delayed.judge(corrections), late_ms=late_ms)

    def fit_sway(self) -> Arrangement | None:
        """Stated arrangement of a body that moves to and fro at the best rate; None where it hardly moves."""
        array, (_, cells, levelled, error) = self.array, self.stated_fit
        time_s = convention.block_means(self.selection.scan.frames.time_s[array.frames, None], array.first)
        slope = cells.gradient(levelled)
        waves = {rate: np.hstack([np.cos(turn := 2 * np.pi * rate * time_s), np.sin(turn)]) for rate in _SWAYS_HZ}
        gains = {rate: _gauss_newton_step(wave, slope, error)[0] for rate, wave in waves.items()}
        if max(gains.values()) < _LEAST_SWAY_FIRST_STEP * float(error @ error):
            return None
        fits = []
        for rate in sorted(gains, key=gains.__getitem__)[-_SWAYS_TRIED:]:
            fit, amplitudes = self._fit_motion(waves[rate], least=_LEAST_SWAY_GAINS)
            fits.append(replace(fit, sway_mm=2 * float(np.linalg.norm(amplitudes, 2)), sways_a_minute=60 * rate))
        best = min(fits, key=lambda one: one.spread)
        return best if best.sway_mm >= LEAST_SWAY_MM else None

    def fit_turn(self) -> Arrangement | None:
        """Stated arrangement with another lever arm, whose end swings as the head turns; None where it gains little."""
        places, (_, cells, levelled, error) = self.stated_placement[0], self.stated_fit
        along = places[:, -1] - places[:, 0]  # turns with the head
        turn = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))[:, None]
        turn -= turn.mean()
        first = _gauss_newton_step(turn, cells.gradient(levelled), error)[0]
        if first < _LEAST_SWAY_FIRST_STEP * float(error @ error):
            return None
        fit, lever_mm = self._fit_motion(turn, least=_LEAST_SWAY_GAINS)
        fit = replace(fit, lever_mm=float(np.linalg.norm(lever_mm)))
        return fit if fit.lever_mm >= LEAST_LEVER_MM else None

    def fit_drag(self) -> Arrangement:
        """Stated arrangement of a body that the strokes drag along: slow strokes make it look like breathing."""
        path = self.stated_placement[0].mean(axis=1)
        strokes = (path - path.mean(axis=0)) @ principal_axes(path)[:, [-1]]
        return self._fit_motion(strokes, least={})[0]

    def _fit_motion(self, course: FloatArray, *, least: Mapping[int, float]) -> tuple[Arrangement, FloatArray]:
        """Stated arrangement of a body that moves along (m, a) time courses, and the (a, 2) amplitudes, mm.

        Gauss-Newton steps; they end after step n where it has gained less than ``least[n]``.
        """
        amplitudes, (arrangement, cells, levelled, error) = np.zeros((course.shape[1], 2)), self.stated_fit
        for step in range(1, _SWAY_STEPS + 1):
            amplitudes += _gauss_newton_step(course, cells.gradient(levelled), error)[1]
            arrangement, cells, levelled, error = self._fit((), (course @ amplitudes)[:, None])
            if arrangement.gain_over(self.stated_fit[0]) < least.get(step, -np.inf):
                break
        return arrangement, amplitudes

    def _fit(self, corrections: Corrections, moves_mm: FloatArray | float = 0.0) -> _Fit:
        """Arrangement with places moved by (m, 1, 2), its cells, the levelled readings and their prediction errors."""
        array = self.transposed if "transposed" in corrections else self.array
        places, agreement = self._placement(corrections) if corrections else self.stated_placement
        varying, cells = array.varying, Cells.of([places + moves_mm])
        values, block = varying.reshape(-1), np.repeat(array.block, varying.shape[1])
        tolerance = _ROUGH_TOLERANCE if self.rough else COMPARED_TOLERANCE
        rest, levelled = map_fit([array], values, cells, tolerance=tolerance, within=not self.rough)
        # by another clock the first or last frames have no pose: all at one place they would seem to agree
        weight = np.repeat(self.path(corrections).known.astype(np.float64), varying.shape[1])
        cell = cells.number
        cell_block = block * (int(cell.max()) + 1) + cell
        total, count = np.bincount(cell, weight * rest), np.bincount(cell, weight)
        other_count = count[cell] - np.bincount(cell_block, weight)[cell_block]
        other_total = total[cell] - np.bincount(cell_block, weight * rest)[cell_block]
        error = weight * values  # where no other readings predict one, it is all error
        predicted = (weight > 0) & (other_count >= _LEAST_OTHERS)
        error[predicted] = rest[predicted] - other_total[predicted] / other_count[predicted]
        total_square, variance = float(error @ error), float(weight @ values**2)
        arrangement = Arrangement(
            corrections,
            spread=float(np.sqrt(total_square / max(float(weight.sum()), 1.0))),
            explained=1 - total_square / variance if variance else 0.0,
            lasting=_successive_correlation(error.reshape(varying.shape)),
            agreement=agreement,
        )
        return arrangement, cells, levelled, error

    def _placement(self, corrections: Corrections) -> tuple[FloatArray, float]:
        """(m, k, 2) places of the averaged readings on their best-fit plane, and the face's `agreement` with it."""
        array, scan = self.transposed if "transposed" in corrections else self.array, self.selection.scan
        surface = scan.head.surface_mm
        for name in set(corrections) & {"rows-reversed", "columns-reversed", "half-turn"}:
            surface = np.stack([reordered(surface[..., i], name) for i in range(3)], axis=-1)
        mounted = corrected(scan, (name for name in corrections if name.startswith(("lever", "quarter"))))
        tracker_from_head = inverse(mounted.head.scanhead_from_tracker)
        taxels = array.weight.T @ apply(tracker_from_head, surface.reshape(-1, 3)[array.taxels])
        middle, path = taxels.mean(axis=0), self.path(corrections)
        centre, offsets = path.places_mm(middle), taxels - middle
        spread = path.rotation @ (offsets.T @ offsets) @ path.rotation.swapaxes(1, 2)
        scatter = len(offsets) * np.cov(centre.T, bias=True) + spread.mean(axis=0)
        axes = np.linalg.eigh(scatter)[1]
        plane, normal = axes[:, [2, 1]].T, axes[:, 0]
        place = (centre @ plane.T)[:, :, None] + plane @ path.rotation @ offsets.T
        agreement = abs(float(normal @ (path.rotation @ tracker_from_head[:3, 2]).mean(axis=0)))
        return place.swapaxes(1, 2), agreement

    def path(self, corrections: Corrections) -> FramePoses:
        """Mean poses of the tracker at the averaged frames; known where all of these lie within its times."""
        rotations = tuple(name for name in corrections if name in _ROTATIONS[-1])
        if rotations not in self.paths:
            scan, first = corrected(self.selection.scan, rotations), self.array.first
            time_s = scan.frames.time_s[self.array.frames]
            poses = poses_at(scan.poses, time_s, latency_ms=self.latency_ms, max_gap_ms=np.inf)
            means = convention.block_means(poses.rotation.reshape(-1, 9), first).reshape(-1, 3, 3)
            known = np.logical_and.reduceat(poses.known, first)
            self.paths[rotations] = FramePoses(convention.block_means(poses.position_mm, first), means, known)
        return self.paths[rotations]
