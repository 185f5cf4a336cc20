"""Strokes over a body, and the lag between tracker and head that they show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.mapping import convention
from tactile_bayes.mapping.accumulate import Source
from tactile_bayes.mapping.latency import ShiftFit

# --- Registration of single strokes: shifts along x that put a lump that moves with the head back in one place.

KNOWN_SD_MM = 0.5  #: A stroke's shift counts as known when its standard error is below this.
# Shifts are taken to scatter by this (SD) before the scan is looked at; none is taken to be longer than twice that.
EXPECTED_MM = 4.0
# By this (SD) strokes over still lumps of the solid model differ, beyond noise: the frames are not the map's alone.
MISFIT_MM = 0.06
_ROUNDS = 4
_MOST_NUMBERS = 3e7  #: Frames are thinned out until all strokes' designs together have no more numbers than this.


class StrokeShift(Record):
    """Shift of one stroke against all others."""

    start: int
    stop: int
    """`start`, `stop`: Among the used frames of its scan."""
    scan: int  #: Number of the scan, from 0.
    direction: int  #: +1 where the head moved along +x of the plane, else -1.
    shift_mm: float = 0.0
    sd_mm: float = np.inf
    """`shift_mm`, `sd_mm`: Along x of the plane, and its standard error."""
    known: bool = False  #: True where the stroke crossed a lump or an edge that fixes a shift; else the shift is 0.


def find_strokes(sources: Sequence[Source]) -> list[StrokeShift]:
    """Find runs of the scans' used frames in one direction along x; a turn belongs to the run before it."""
    return [
        StrokeShift(start, stop, number, way)
        for number, source in enumerate(sources)
        for start, stop, way in convention.strokes_along(source.projection.shift[:, 0] * source.projection.cell_mm)
    ]


def stroke_count(sources: Sequence[Source]) -> int:
    """How many strokes the head made along x; runs less than half as long as the longest are turns or corrections."""
    reach = [
        float(np.ptp(sources[one.scan].projection.shift[one.start : one.stop, 0])) for one in find_strokes(sources)
    ]
    longest = max(reach, default=0.0)
    return sum(one >= longest / 2 for one in reach)


def register_strokes(sources: Sequence[Source]) -> tuple[list[Source], list[StrokeShift]]:
    """Estimate each stroke's shift along x against the others, and shift its frames back.

    Shifts are about their mean, so the map stays where it is. `BadDataError` when there are fewer than two strokes, or
    fewer than two crossed a lump or an edge that fixes a shift.

    The regression of `tactile_bayes.mapping.latency` with one unknown per stroke, a few rounds. Along y nothing is
    shifted: each line lies at another y, so other columns of the head pass the lump, and their different readings look
    like a shift of half a millimetre (record 0097). Standard errors are those of the regression, widened for errors
    shared by neighbouring frames and for the part of the slopes that is noise; their floor is 0.06 mm.
    """
    strokes = find_strokes(sources)
    if len(strokes) < 2:
        raise BadDataError(
            f"the scan has {len(strokes)} stroke over {convention.LEAST_REACH_MM:g} mm", way_out="scan back and forth"
        )
    numbers = [len(one.frames) * 5e-3 / convention.POOL_S * one.selection.readout.size / 4 for one in sources]
    every = [max(1, int(np.ceil(len(strokes) * readings / _MOST_NUMBERS))) for readings in numbers]
    parts, shifts = _parts(sources, strokes, every), np.zeros(len(strokes))
    for _ in range(_ROUNDS):
        round_ = _Round.of(parts, shifts)
        shifts = np.clip(shifts + round_.step(shifts), -2 * EXPECTED_MM, 2 * EXPECTED_MM)
    known, errors = round_.errors()
    if known.sum() < 2:
        raise BadDataError(_lack(known, round_), way_out="scan back and forth over a lump, or leave out the option")
    shifts = np.where(known, shifts - shifts[known].mean(), 0.0)
    shifted = [
        replace(one, shift_mm=float(shift), sd_mm=float(error), known=bool(sure))
        for one, shift, error, sure in zip(strokes, shifts, errors, known, strict=True)
    ]
    return [_moved(source, [one for one in shifted if one.scan == n]) for n, source in enumerate(sources)], shifted


def _lack(known: BoolArray, last: _Round) -> str:
    """The scan's deficiency, in one line."""
    best = float(last.own_errors().min())
    told = f"the best is known to +-{best:.1f} mm" if np.isfinite(best) else "no slope stands out of the noise"
    fixed = f"crossed a lump or an edge that fixes a shift to {KNOWN_SD_MM:g} mm"
    return f"{int(known.sum())} of {len(known)} strokes {fixed} ({told})"


def mobility(strokes: Sequence[StrokeShift]) -> tuple[float, float]:
    """Distance by which the lump follows the head, mm, and its standard error; NaN without strokes both ways.

    Half the difference between the mean shifts of strokes towards +x and towards -x. A tracker's latency left in the
    poses gives the same picture: v tau.
    """
    ways = [[one for one in strokes if one.known and one.direction == way] for way in (1, -1)]
    if not all(ways):
        return float("nan"), float("nan")
    means = [np.mean([one.shift_mm for one in way]) for way in ways]
    # The spread between strokes of one way says more than the errors of single ones, where there are several.
    errors = [
        max(
            float(np.std([one.shift_mm for one in way], ddof=1)) if len(way) > 1 else 0.0,
            float(np.mean([one.sd_mm for one in way])),
        )
        / np.sqrt(len(way))
        for way in ways
    ]
    return float(means[0] - means[1]) / 2, float(np.hypot(*errors)) / 2


class _Part(Record, eq=False):
    """One scan's averaged frames."""

    coarse: convention.CoarseFrames  #: Of every so many-th stretch of the used frames.
    places_mm: FloatArray  #: (m, k, 2) array.
    stroke: IndexArray
    block: IndexArray
    """`stroke`, `block` (m,) int arrays: Among the strokes of all scans, and which frames share errors."""

    def along_x(self, values: FloatArray) -> FloatArray:
        """(m, k, 2) moves along x, of each stroke by its value, one for each of all strokes."""
        moves = np.zeros_like(self.places_mm)
        moves[:, :, 0] = values[self.stroke, None]
        return moves

    def shifted_mm(self, shifts_mm: FloatArray) -> FloatArray:
        """(m, k, 2) places with each stroke moved back by its shift."""
        return np.asarray(self.places_mm - self.along_x(shifts_mm))


def _parts(sources: Sequence[Source], strokes: Sequence[StrokeShift], every: Sequence[int]) -> list[_Part]:
    """The scans with a used frame, averaged over every so many-th stretch."""
    parts = []
    for number, source in enumerate(sources):
        if not len(source.frames):
            continue
        time_s = source.selection.scan.frames.time_s
        kept = convention.every_stretch(time_s[source.frames], every[number])
        coarse = convention.CoarseFrames.of(source.selection, source.frames[kept])
        mine = [n for n, one in enumerate(strokes) if one.scan == number]
        stroke = np.searchsorted([strokes[n].start for n in mine], kept[coarse.first], side="right") - 1 + mine[0]
        parts.append(_Part(coarse, coarse.places_mm(source.projection.part(kept)), stroke, coarse.blocks(time_s)))
    return parts


class _Round(Record, eq=False):
    """The regression at some shifts."""

    normal: FloatArray  #: (K, K) array: Product of the strokes' designs over the variance of what is left.
    score: FloatArray  #: (K,) array: Their product with what is left, over the same.
    widened: FloatArray  #: (K,) array: By how much standard errors exceed those of independent errors and exact slopes.

    @classmethod
    def of(cls, parts: Sequence[_Part], shifts_mm: FloatArray) -> _Round:
        fit = ShiftFit.of([part.coarse for part in parts], [part.shifted_mm(shifts_mm) for part in parts])
        frame = fit.frame_numbers()
        block = convention.numbered_on([part.block for part in parts])
        even = (block % 2 == 0)[frame]
        halves = [fit.of_some(keep) for keep in (even, ~even)]
        columns, told = [], []
        for unit in np.eye(len(shifts_mm)):
            moves = [part.shifted_mm(unit) - part.places_mm for part in parts]
            columns.append(fit.design(moves))
            raw, one, other = (some.raw_design(moves) for some in (fit, *halves))
            told.append(float(one @ other) / max(float(raw @ raw), 1e-300))
        design = np.array(columns)
        normal, left = design @ design.T, float(fit.data.var())
        best = np.linalg.lstsq(normal, design @ fit.data, rcond=1e-9)[0]
        shared = _shared(design, fit.data - best @ design, block[frame])
        share = np.clip(told, 0.0, 1.0)
        widened = np.sqrt(max(1.0, shared)) / np.where(share > 0, share, np.nan)
        return cls(normal / left, design @ fit.data / left, np.nan_to_num(widened, nan=np.inf))

    def step(self, shifts_mm: FloatArray) -> FloatArray:
        """(K,) by how much further the strokes are shifted; shifts that nothing tells are drawn to 0."""
        precision = self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2
        pull = self.score - shifts_mm / EXPECTED_MM**2
        return np.asarray(np.linalg.solve(precision, pull))

    def own_errors(self) -> FloatArray:
        """(K,) standard error of each stroke's shift if all the others' were known."""
        return np.asarray(self.widened / np.sqrt(np.maximum(np.diag(self.normal), 1e-300)))

    def errors(self) -> tuple[BoolArray, FloatArray]:
        """(K,) strokes whose shift about the known strokes' mean is known, and the (K,) standard errors."""
        covariance = np.linalg.inv(self.normal + np.eye(len(self.normal)) / EXPECTED_MM**2)
        known, errors = self.own_errors() < KNOWN_SD_MM, np.full(len(self.normal), np.inf)
        for _ in range(2):
            if known.sum() < 2:
                return known, errors
            about = np.eye(len(known)) - known / known.sum()
            errors = np.hypot(np.sqrt(np.diag(about @ covariance @ about.T)) * self.widened, MISFIT_MM)
            known = known & (errors < KNOWN_SD_MM)
        return known, errors


def _shared(design: FloatArray, left: FloatArray, block: IndexArray) -> float:
    """By how much errors shared within blocks widen the variance of the designs' coefficients, over all of them."""
    scores = np.array([np.bincount(block, column * left) for column in design])
    free = max(1.0, scores.shape[1] - len(design))
    widening = float(np.sum(scores**2) / (left.var() * np.sum(design**2)))
    return float(widening * scores.shape[1] / free)


def _moved(source: Source, strokes: list[StrokeShift]) -> Source:
    """Source with its strokes moved back by their shifts."""
    shift = np.zeros_like(source.projection.shift)
    for one in strokes:
        shift[one.start : one.stop, 0] = -one.shift_mm
    whole = np.rint(shift / source.projection.cell_mm * 2.0**30) / 2.0**30  # on the grid that keeps cells exact
    return replace(source, projection=source.projection.moved(whole))


# --- How far apart strokes in opposite directions see the lump: one that is dragged along, or poses that come late.
#
# Either puts the lump's image ahead in one direction and behind in the other, and the map, which holds both, is too
# wide. One unknown of the regression in `mapping.latency.ShiftFit`, in one round: enough for a warning.
# `register_strokes` finds each stroke's shift.

MOST_FRAMES = 160  #: Averaged frames that are used, spread evenly: more would cost as much as the map itself.


def stroke_lag_figures(sources: Sequence[Source]) -> dict[str, float]:
    """Figures ``stroke_lag_mm`` and ``stroke_lag_sd_mm``: half the way between where strokes to +x and to -x see a
    lump.

    Above 0 the lump is ahead of its mean place in the direction of the stroke, as if dragged along; a pose that is late
    by t against the frames gives -v t. Empty where strokes went one way only, or nothing in the map has a slope. One
    linear step from no shift, so a figure above 1 mm is rough. The standard error holds errors that frames share over
    0.2 s.
    """
    every = convention.thinning(
        (source.selection.scan.frames.time_s[source.frames] for source in sources), most=MOST_FRAMES
    )
    strokes = find_strokes(sources)
    parts, ways = _parts(sources, strokes, [every] * len(sources)), np.array([one.direction for one in strokes])
    if len({way for part in parts for way in ways[part.stroke].tolist()}) < 2:
        return {}
    fit = ShiftFit.of([part.coarse for part in parts], [part.places_mm for part in parts])
    design = fit.design([part.along_x(ways) for part in parts])
    whole = float(design @ design)
    if not whole > 0:
        return {}
    # a lump that is ahead of its place is seen at places that are behind theirs
    lag = -float(design @ fit.data) / whole
    block = convention.numbered_on([part.block for part in parts])[fit.frame_numbers()]
    scores = np.bincount(block, design * (fit.data + lag * design))
    return {"stroke_lag_mm": lag, "stroke_lag_sd_mm": float(np.sqrt(np.sum(scores**2))) / whole}
