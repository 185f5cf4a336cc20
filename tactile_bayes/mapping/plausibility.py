"""Comparison of scans and maps with what an exam's data can be, and with what a map needs to show a lump (record 0137).

Figures of the readings, clocks, places and landmarks go into a map's quality, where they can be judged later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding, finding
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, principal_axes
from tactile_bayes.mapping.map import FEW_READINGS, TactileMap, block_sums
from tactile_bayes.mapping.select import (
    LEAST_FRAMES,
    SelectedFrames,
    chunks,
    frame_figures,
    rate_doubt,
    refuse_without_frames,
    timing_figures,
)
from tactile_bayes.scans import HeadShape, Landmarks

LEAST_USED_SHARE: Final = 0.05  #: Least share of the frames that are used; and `LEAST_FRAMES` in all.
LEAST_AREA: Final = 1.5  #: Area of a map in areas of the array: a head that stood still covers its own and its noise.
MOST_SPAN_MM: Final = 600.0  #: Range of the places along one axis: a chest is narrower.
IMPOSSIBLE_MM: Final = 3000.0
SIDE_MM: Final = (5.0, 200.0)  #: Sides of an array.
MOST_RATIO: Final = 1.1  #: Ratio of the distance between taxels to the pitch, or the inverse; 1.07 on a small sphere.
MOST_ZIGZAG_MM: Final = 3.0  #: Median distance of a pose from the middle of the two beside it.
FROZEN_S, MOST_FROZEN = 0.3, 0.1  #: Duration of repeats from which an array is frozen, and share of such frames.
MOST_FLICKER: Final = 0.7  #: `_flicker` is 0.2 at most in 466 right scans, and 1 in noise.
_REPEAT_TAXELS: Final = 0.01  #: Share of the taxels that may change in a frame that repeats the last one.
MOST_REPEATED: Final = 0.4  #: Share of frames that repeat the one before: half where each frame is there twice.
PLATEAU: Final = 30
TAXEL_PLATEAU: Final = 10
"""Readings at the highest count, of the array and of one taxel, that are a plateau if those of the three counts below
it are fewer: 66 right scans have up to 5 of one taxel."""
MOST_SATURATED, MOST_DROPPED = 0.02, 0.2
"""Share of the readings at full scale, and of the frames left out for saturated or faulty taxels."""
MOST_CUT: Final = 0.02
"""Share of the readings at the lowest count, where that lies far below the rest: in 50 right scans 0.001 at most."""
LEAST_OF_BESIDE: Final = 0.75  #: Of a row or column, over the mean of those beside it: 0.95 in 66 right scans.
COARSEST_COUNT: Final = 0.1  #: One count over the mean pressure: a lump's rise is a few tenths of it.
WRAPPED: Final = 2000  #: Readings this near to 65,536 are below 0, or no value.
LANDMARKS_MM: Final = (80.0, 350.0)  #: Distance from the sternal notch to the xiphoid.
MOST_REACH_MM: Final = 500.0  #: Distance from the xiphoid to the head.
LEAST_GAP, LEAST_RANGE = 0.4, 12.0
"""Least empty share of the values' range, and least range in quartile distances, of cells far outside the rest."""
_MOST_LEVELS: Final = 9.0  #: Values are clipped to this many levels: fill values would hide the rest.
LEAST_GRID_CM2: Final = 4.0  #: Area of a grid whose head is not known.
DIP_MM, LEAST_DIP, DIP_OVER_RISE = 6.0, 0.15, 1.5
"""Side of the squares whose means dip, least dip in levels, and its least ratio to the rise, where readings fall as
pressure rises: right maps dip by less than they rise, or by 0.1."""
_CHUNK: Final = 4096
_SAMPLE_FRAMES: Final = 500


# --- Figures of scans.


def exam_figures(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """Figures of the readings, poses and landmarks of scans, by which `exam_findings` judges them."""
    figures: dict[str, float] = {"plateau_readings": 0.0, "wrapped_readings": 0.0}
    for part in selections:
        places, counts, repeats = part.poses.position_mm[part.used], part.scan.frames.counts, _repeats(part)
        spread = float(np.ptp(places, axis=0).max()) if len(places) else 0.0
        if spread > IMPOSSIBLE_MM:  # a map of them would not fit in memory
            way_out = "positions are in mm; leave out poses that stand for a tool out of sight"
            raise BadDataError(f"the places of the head spread over {spread:,.0f} mm", way_out=way_out)
        readings, count = _plateau(part, np.flatnonzero(part.used & ~repeats))
        figures["plateau_readings"] += readings
        if readings:
            figures["plateau_count"] = float(count)
        # readings just below 65,536 where none lies below them, down to half of it
        wrapped = float((counts >= 65536 - WRAPPED).sum())
        if wrapped and not ((counts >= 32768) & (counts < 65536 - WRAPPED)).any():
            figures["wrapped_readings"] += wrapped
        for name, value in (*_repeat_shares(part, repeats), *_flicker(part), *_geometry(part)):
            figures[name] = max(value, figures.get(name, 0.0))
    return figures


def _plateau(part: SelectedFrames, frames: IndexArray) -> tuple[int, int]:
    """Number of readings in a plateau at the highest count, of the array or of taxels, and the count; 0 without one.

    It is sought in a sample of the frames, and its readings are counted in all.
    """
    if not len(frames):
        return 0, 0
    good = np.flatnonzero(part.good_taxels)
    counts = part.scan.frames.counts.reshape(len(part.used), -1)
    end = part.scan.element_calibration.saturation_count
    sample = counts[frames[:: max(1, len(frames) // _SAMPLE_FRAMES)]][:, good]
    histogram = np.bincount(sample.ravel())
    histogram[end:] = 0
    present = np.flatnonzero(histogram)
    if len(present) < 4:
        return 0, 0
    highest, step = int(present[-1]), int(np.gcd.reduce(np.diff(present)))
    if histogram[highest] >= PLATEAU and histogram[highest] > histogram[present[-4:-1]].sum():
        return int((counts[np.ix_(frames, good)] == highest).sum()), highest
    top = sample.max(axis=0)
    at_top, near_top = (sample == top).sum(axis=0), (sample + np.uint16(3 * step) >= top).sum(axis=0)
    clipped = (at_top >= TAXEL_PLATEAU) & (2 * at_top > near_top) & (top < end)
    if not clipped.any():
        return 0, 0
    return int((counts[np.ix_(frames, good[clipped])] == top[clipped]).sum()), int(np.median(top[clipped]))


def _repeats(part: SelectedFrames) -> BoolArray:
    """(n,) True for frames that repeat the one before."""
    counts = part.scan.frames.counts
    repeats = np.zeros(len(counts), dtype=bool)
    for chunk in chunks(len(counts) - 1, _CHUNK):
        repeats[1:][chunk] = (counts[1:][chunk] != counts[:-1][chunk]).mean(axis=(1, 2)) <= _REPEAT_TAXELS
    return repeats


def _repeat_shares(part: SelectedFrames, repeats: BoolArray) -> Iterator[tuple[str, float]]:
    """Share of used frames that repeat the one before, and of those in runs of `FROZEN_S`."""
    time_s, used = part.scan.frames.time_s, int(part.used.sum())
    if len(time_s) < 2 or not used:
        return
    yield "repeated_share", float((repeats & part.used).sum()) / used
    edges = np.flatnonzero(np.diff(repeats, prepend=False, append=False))
    frozen = np.zeros(len(time_s), dtype=bool)
    for first, last in edges.reshape(-1, 2).tolist():
        if time_s[last - 1] - time_s[first - 1] >= FROZEN_S:
            frozen[first:last] = True
    yield "frozen_share", float((frozen & part.used).sum()) / used


def _flicker(part: SelectedFrames) -> Iterator[tuple[str, float]]:
    """Variance between neighbouring frames over that among all, of means or of the pattern about them: the smaller.

    Both are 1 in noise. A hand's pressure changes steadily; on a bench the mean is constant, but the pattern is too.
    """
    used = np.flatnonzero(part.used)
    if len(used) < LEAST_FRAMES:
        return
    level = part.level_kpa[used]
    sample = np.unique(np.linspace(0, len(used) - 2, _SAMPLE_FRAMES).astype(int))
    frames = np.stack([used[sample], used[sample + 1]])
    pressure = part.scan.element_calibration.linear_kpa(part.scan.frames.counts[frames])
    first, second = pressure - pressure.mean(axis=(-2, -1), keepdims=True)
    if level.std() and first.any():
        pattern = np.mean((second - first) ** 2) / np.mean(first**2)
        yield "frame_flicker", float(min(np.mean(np.diff(level) ** 2) / np.var(level), pattern)) / 2


def _geometry(part: SelectedFrames) -> Iterator[tuple[str, float]]:
    """Figures of the poses' zigzag, the array's length over its pitch, the landmarks' distances, and a count's size."""
    head, level, path_mm = part.scan.head, part.level_kpa[part.used], part.fresh.position_mm
    if len(path_mm) >= 3:
        off_mm = path_mm[1:-1] - (path_mm[2:] + path_mm[:-2]) / 2
        yield "pose_zigzag_mm", float(np.median(np.linalg.norm(off_mm, axis=1)))
    if head.shape[1] > 1:
        length = float(np.linalg.norm(np.diff(head.surface_mm, axis=1), axis=2).sum(axis=1).mean())
        yield "surface_over_pitch", length / (head.pitch_mm * (head.shape[1] - 1))
    if not len(level):
        return
    marks: Landmarks | None = part.scan.landmarks
    if marks is not None:
        yield "landmark_distance_mm", float(np.linalg.norm(marks.sternal_notch_mm - marks.xiphoid_mm))
        places = part.poses.position_mm[part.used]
        yield "landmark_reach_mm", float(np.linalg.norm(places - marks.xiphoid_mm, axis=1).min())
    sample = part.scan.frames.counts[np.flatnonzero(part.used)[:: max(1, len(level) // 50)]]
    present, working = np.unique(sample), sample[:, part.good_taxels]
    readings, times = np.unique(working, return_counts=True)
    lowest = int(times[0])
    far_below = 2 * int(readings[0]) < float(np.median(working))
    if far_below and lowest > max(int(times[1:4].sum()), MOST_CUT * working.size):
        yield "cut_share", lowest / working.size
    yield from _weakest_lines(part, sample)
    step = int(np.gcd.reduce(np.diff(present.astype(np.int64))))
    gain = float(np.median(part.scan.element_calibration.gain_kpa_per_count[part.good_taxels]))
    yield "count_share", step * gain / float(np.median(level))


def _weakest_lines(part: SelectedFrames, sample: NDArray[np.uint16]) -> Iterator[tuple[str, float]]:
    """Least reading of a row, and of a column, over the mean of those beside it, where below `LEAST_OF_BESIDE`."""
    good, mean_kpa = part.good_taxels, part.scan.element_calibration.linear_kpa(sample.mean(axis=0))
    for across, name in ((1, "row"), (0, "column")):
        level = (good * mean_kpa).sum(axis=across) / good.sum(axis=across).clip(1)
        line, beside = level[1:-1], (level[:-2] + level[2:]) / 2
        share = np.divide(line, beside, out=np.ones_like(line), where=(line > 0) & (beside > 0))  # 0: all is left out
        if len(share) and share.min() < LEAST_OF_BESIDE:
            yield f"weakest_{name}_share", float(share.min())


def scan_doubts(selection: SelectedFrames, *, pressure_window_kpa: tuple[float, float]) -> tuple[Finding, ...]:
    """Findings on a scan's readings, clocks, poses and landmarks; `BadDataError` without a frame that can be used."""
    refuse_without_frames([selection], pressure_window_kpa=pressure_window_kpa)
    figures = frame_figures([selection]) | timing_figures([selection.scan]) | exam_figures([selection])
    geometry, places = selection.scan.head, selection.poses.position_mm[selection.used]
    head = HeadShape.of(geometry.surface_mm, geometry.pitch_mm)
    # the largest area that an array can pass over by moving so far along and across its path
    (width, length), (_, *reach_mm) = head.sides_mm, np.ptp(places @ principal_axes(places), axis=0)
    area_mm2 = float(max((width + a) * (length + b) for a, b in (reach_mm, reach_mm[::-1])))
    enough = figures["frames_used"] >= LEAST_FRAMES
    still = _findings("unlike_an_exam", _at_rest(area_mm2, head, "the frames cover") if enough else ())
    return (*still, *exam_findings(figures, head))


# --- Findings.


def exam_findings(quality: Mapping[str, float], head: HeadShape | None = None) -> tuple[Finding, ...]:
    """Findings from the figures of scans, or of a map, against what an exam can be; missing figures give none."""
    return _findings("unlike_an_exam", _unlike(quality, head)) + _findings("unusual_scan", _unusual(quality))


def map_findings(tactile_map: TactileMap) -> tuple[Finding, ...]:
    """Findings from a map's figures and cells; those of the cells are for imported grids as well."""
    cells = _findings("unlike_an_exam", _cell_doubts(tactile_map))
    return exam_findings(tactile_map.quality, tactile_map.head) + cells


def _findings(kind: str, doubts: Iterable[tuple[str, str]]) -> tuple[Finding, ...]:
    """Findings of sentences with remedies, each the examiner's own or for those who look after the devices."""
    clinical = "have the sensor, the tracker and the recording checked"
    return tuple(
        finding(kind, text, remedy, remedy if not remedy or remedy.startswith(("press ", "scan ")) else clinical)
        for text, remedy in doubts
    )


def _unlike(quality: Mapping[str, float], head: HeadShape | None) -> Iterator[tuple[str, str]]:
    """Sentence and remedy for each condition under which a map without a lump says nothing."""
    total, used = quality.get("frames_total", 0.0), quality.get("frames_used", 0.0)
    if total and (used < LEAST_FRAMES or used < LEAST_USED_SHARE * total):
        why = [f"{quality[name]:.0f} {words}" for name, words in WHY_NOT.items() if quality.get(name)]
        left_out = f" ({', '.join(why)})" if why else ""
        most = max(WHY_NOT, key=lambda name: quality.get(name, 0.0))
        longer = "use more frames" if "frames_every" in quality else "scan for longer"
        remedy = _REMEDIES[most] if 2 * quality.get(most, 0.0) > total else longer
        yield f"only {used:.0f} of {total:.0f} frames are used{left_out}", remedy
    if "frame_rate_hz" in quality and (doubt := rate_doubt(quality["frame_rate_hz"] * quality.get("frames_every", 1))):
        yield doubt
    elif total > 1 and "frames_missing" in quality and "frame_rate_hz" not in quality:  # a live map tells no times
        yield "all frames have one time: the array's clock stands still", "record the frames' times"
    if total and quality.get("dropped_elements", 0.0) > MOST_DROPPED * total:
        share = 100 * quality["dropped_elements"] / total
        text = f"{share:.0f} % of the frames were left out for taxels at full scale, as over a lump, or faulty ones"
        yield text, "press less hard, or repair the array"
    if (zigzag := quality.get("pose_zigzag_mm", 0.0)) > MOST_ZIGZAG_MM:
        yield f"the poses jump to and fro: they lie {zigzag:.1f} mm beside the middle of their neighbours", _ONE_TOOL
    if quality.get("frame_flicker", 0.0) > MOST_FLICKER:
        text = (
            "each frame differs from the one before as noise does: what a hand does and a head feels changes steadily"
        )
        yield text, "check the array's cable and supply, and that the times are the frames' own"
    if quality.get("frozen_share", 0.0) > MOST_FROZEN:
        share = 100 * quality["frozen_share"]
        yield f"in {share:.0f} % of the frames the readings stand still while time goes on", "check the array's link"
    if quality.get("plateau_readings"):
        text = (
            f"{quality['plateau_readings']:,.0f} readings stand at the highest count, {quality['plateau_count']:,.0f}, "
            "and few just below it: the array saturates there, which the scan does not say"
        )
        yield text, "state it at its import: --saturation, in the unit of its frames"
    if "cut_share" in quality:
        share = 100 * quality["cut_share"]
        text = (
            f"{share:.0f} % of the readings stand at the lowest count, and few just above it: the array cuts off light "
            "pressures, or the head's edge was off the skin; the size may be wrong"
        )
        yield text, "press the whole head on the skin, or record without a threshold"
    if quality.get("count_share", 0.0) > COARSEST_COUNT:
        text = f"one count is {100 * quality['count_share']:.0f} % of the mean pressure: readings are too coarse"
        yield text, "check whether counts were rounded or are pressures already"
    if head is not None and not SIDE_MM[0] <= min(head.sides_mm) <= max(head.sides_mm) <= SIDE_MM[1]:
        sides = "{:.3g} x {:.3g}".format(*head.sides_mm)
        yield f"the array is {sides} mm: no scan head is", "check that pitch and surface are in mm"
    ratio = quality.get("surface_over_pitch", 1.0)
    if not 1 / MOST_RATIO <= ratio <= MOST_RATIO:
        text = f"the taxels lie {ratio:.3g} times as far apart as the pitch says"
        yield text, "check that pitch and surface are in mm, and which axis is which"
    spans = [quality[name] for name in ("span_x_mm", "span_y_mm") if name in quality]
    if spans and max(spans) > MOST_SPAN_MM:
        yield f"the places spread over {max(spans):,.0f} mm: no breast does", "check that they are in mm and none jumps"


_ONE_TOOL: Final = "record one tool of the tracker (docs/trackers.md), or leave the other poses out"
WHY_NOT: Final = {
    "dropped_low": "pressed too lightly",
    "dropped_high": "pressed too hard",
    "dropped_no_pose": "without a tracker pose",
    "dropped_elements": "with too few valid taxels",
}
"""Why frames are left out of a map, by the figure that counts them."""
_REMEDIES: Final = {
    "dropped_low": "press harder",
    "dropped_high": "press less hard",
    "dropped_no_pose": "check the tracker and its times",
    "dropped_elements": "press less hard, or repair the array",
}
"""What to do about frames that are left out, by the same figure."""


def _unusual(quality: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    """Sentence and remedy for what is off, but hides no lump."""
    if wrapped := quality.get("wrapped_readings"):
        text = f"{wrapped:,.0f} readings stand just below 65,536 and count as saturated: they are below 0 or no value"
        yield text, "check the offset that was subtracted, and what stands for no reading"
    if quality.get("repeated_share", 0.0) > MOST_REPEATED and quality.get("frozen_share", 0.0) <= MOST_FROZEN:
        share = 100 * quality["repeated_share"]
        yield f"{share:.0f} % of the frames repeat the one before: the array is slower than its clock says", ""
    for name in ("row", "column"):
        if weakest := quality.get(f"weakest_{name}_share"):
            what = f"one of the array's {name}s reads {100 * weakest:.0f} % of what the {name}s beside it read"
            yield f"{what}: the size may be wrong", "have the array calibrated"
    apart, reach = quality.get("landmark_distance_mm"), quality.get("landmark_reach_mm", 0.0)
    in_base = "check that landmarks are in the tracker's base frame, in mm"
    if apart is not None and not LANDMARKS_MM[0] <= apart <= LANDMARKS_MM[1]:
        adults = "{:g} to {:g} in adults".format(*LANDMARKS_MM)
        text = f"sternal notch and xiphoid lie {apart:.0f} mm apart, {adults}: places on the breast may be wrong"
        yield text, in_base
    elif reach > MOST_REACH_MM:
        yield f"the head came no nearer to the xiphoid than {reach:.0f} mm: places on the breast may be wrong", in_base


def _cell_doubts(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Sentence and remedy for a map's area and for cells that no tissue explains."""
    covered = tactile_map.covered
    if not covered.any():
        return
    area, head = _area_mm2(tactile_map), tactile_map.head
    if head is not None and tactile_map.frame_count >= LEAST_FRAMES:
        yield from _at_rest(area, head, "the map covers")
    saturated, frames = tactile_map.quality.get("saturated_readings", 0.0), tactile_map.frame_count
    readings = frames * (1 if head is None else head.rows * head.columns)
    if saturated > MOST_SATURATED * readings:
        share = 100 * saturated / readings
        text = f"{share:.1f} % of the readings were at full scale and left out, where a lump would press"
        yield text, "press less hard"
    if head is None and area < LEAST_GRID_CM2 * 100:
        text = f"the grid covers {area / 100:.2g} cm2: a lump and what lies beside it need more"
        yield text, "scan with strokes side by side"
    depth, height = _extremes(tactile_map)
    if depth > LEAST_DIP and depth > DIP_OVER_RISE * height:
        text = (
            f"the map dips by {100 * depth:.0f} % of its level and rises by {100 * height:.0f} %: what is harder than "
            "the tissue about it, as lumps are, presses harder"
        )
        yield text, "check whether the readings fall where pressure rises, and leave out what lies off the tissue"
    count = tactile_map.count[covered]
    yield from _value_doubts(tactile_map.mean[covered][count >= FEW_READINGS * float(tactile_map.counts_known)])


def _area_mm2(tactile_map: TactileMap) -> float:
    """Area that a map covers; cells much finer than the taxels' pitch are covered sparsely, and count by the mm."""
    cell = tactile_map.recipe.cell_mm
    side = max(1, round(1.0 / cell))
    return float(np.count_nonzero(block_sums(tactile_map.covered.astype(np.float64), side))) * (side * cell) ** 2


def _extremes(tactile_map: TactileMap) -> tuple[float, float]:
    """Depth below and height above the map's median, in medians, of means over covered squares of `DIP_MM`.

    Both also about a trend of second degree: a slope has no dips.
    """
    side = min(max(1, round(DIP_MM / tactile_map.recipe.cell_mm)), *tactile_map.mean.shape)

    def sums(values: FloatArray) -> FloatArray:
        total = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        return np.asarray(total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side])

    covered = sums(tactile_map.covered.astype(np.float64))
    full = covered > 0.9 * side**2
    level = float(np.median(tactile_map.mean[tactile_map.covered]))
    if not full.any() or not level > 0:
        return 0.0, 0.0
    relative = np.clip(np.where(tactile_map.covered, tactile_map.mean / level, 0.0), -_MOST_LEVELS, _MOST_LEVELS)
    means = sums(relative)[full] / covered[full]
    y, x = np.nonzero(full) / np.max(full.shape, initial=1)
    trend = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    flat = means - trend @ np.linalg.lstsq(trend, means)[0]
    both = np.stack([means - 1.0, flat - np.median(flat)])
    return -float(both.min(axis=1).max()), float(both.max())


def _at_rest(area_mm2: float, head: HeadShape, covers: str) -> Iterator[tuple[str, str]]:
    """Sentence and remedy for an area that is hardly larger than the array."""
    if area_mm2 < LEAST_AREA * head.sides_mm[0] * head.sides_mm[1]:
        array = "{:.0f} x {:.0f} mm".format(*head.sides_mm)
        text = f"{covers} {area_mm2 / 100:.2g} cm2, hardly more than the array itself ({array}): the head stood still"
        yield text, "scan with strokes side by side; if it did move, check the poses and their unit"


def _value_doubts(values: FloatArray) -> Iterator[tuple[str, str]]:
    """Sentence and remedy for values far outside the rest, and for a plateau at the highest."""
    if len(values) < 2:
        return
    ordered = np.sort(values)
    if ordered[0] == ordered[-1]:
        yield f"all {len(ordered)} cells hold {ordered[0]:.4g}: nothing was felt", "check what was saved"
        return
    steps, low, high = np.diff(ordered), *np.quantile(ordered, [0.25, 0.75])
    span, widest = float(ordered[-1] - ordered[0]), int(np.argmax(steps))
    if steps[widest] > LEAST_GAP * span and span > LEAST_RANGE * float(high - low):
        ends, rest = sorted((ordered[: widest + 1], ordered[widest + 1 :]), key=len)
        values_there = f"{ends[0]:.4g}" if ends[0] == ends[-1] else f"{ends[0]:.4g} to {ends[-1]:.4g}"
        text = (
            f"{len(ends)} of {len(ordered)} cells lie far outside the rest ({values_there}; the others {rest[0]:.4g} "
            f"to {rest[-1]:.4g}): dead lines, or values that stand for none"
        )
        yield text, "mark them as missing"
    levels: NDArray[np.int64] = np.unique(ordered, return_counts=True)[1]
    at_top, near = int(levels[-1]), int(levels[-4:-1].sum())  # at the highest, and at the three distinct ones below it
    if PLATEAU <= at_top < len(ordered) / 2 and at_top > near > 0:
        text = (
            f"{at_top} cells stand at the highest value, {ordered[-1]:.4g}, and few just below it: it was clipped there"
        )
        yield text, "take it again without clipping"


BLOCKING: Final = frozenset({"unlike_an_exam", "frames_contradict", "poses_jump"})
"""Kinds of findings under which a map without a lump does not say that there is none (record 0137)."""
SURE_ODDS: Final = 1e4  #: Odds from which another arrangement is refused, and stands against "no lump".


def against_no_lump(tactile_map: TactileMap) -> list[Finding]:
    """Findings from a map's figures and cells, and those it was made with, that stand against "there is no lump"."""
    sure = tactile_map.quality.get("arrangement_log_odds", 0.0) >= log(SURE_ODDS)
    kinds = BLOCKING | {"wrong_arrangement", "late_poses"} if sure else BLOCKING
    return [one for one in (*map_findings(tactile_map), *tactile_map.findings) if one.kind in kinds]


def with_cause(error: BadDataError, findings: Iterable[Finding]) -> BadDataError:
    """Error of a map that cannot be made, with the first finding unlike an exam in its scans as the likely cause."""
    causes = [one for one in findings if one.kind in ("poses_jump", "unlike_an_exam", "late_poses")]
    if not causes:
        return error
    return BadDataError(f"{error.what}, where {causes[0].text}", way_out=causes[0].remedy or _ONE_TOOL)
