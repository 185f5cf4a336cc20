"""Map of one or several scans (paper steps i to iii): the steps in order, and the map's quality."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, check_number
from tactile_bayes.findings import Finding, by_severity, counted, finding
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane, apply, inverse, patient_from_plane
from tactile_bayes.mapping import accumulate, latency, select
from tactile_bayes.mapping.arrangement import check_arrangement
from tactile_bayes.mapping.cells import MAX_POSE_GAP_MS, CellSums, HeadMoments, head_moments
from tactile_bayes.mapping.convention import check_convention, convention_findings, convention_way_out
from tactile_bayes.mapping.map import (
    FEW_READINGS,
    LEAST_STROKES,
    MapRecipe,
    TactileMap,
    broken_assumptions,
    handling_findings,
    side_findings,
    smooth,
)
from tactile_bayes.mapping.plausibility import exam_figures, exam_findings, map_findings, with_cause
from tactile_bayes.mapping.profile import evenness_figures, head_profile_figures, motion, pose_noise_figures
from tactile_bayes.mapping.select import SelectedFrames
from tactile_bayes.options import MapOptions
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.scans import HeadShape, Scan

# --- Frames near the lump, to which the paper fits its plane.

_CELL_MM = 2.0  #: Side of the cells for the search: a few mm are close enough.
_END_FRAMES = 100  #: Of a third of a scan that are looked at, up to twice as many.
_CLEAR_RISE, _LESS_BELOW = 0.2, 0.8
"""A rise above which parts have to feel each other's, and its least share: at least 0.92 in right scans by another
simulator, by their thirds, halves or every second stroke; below 0.8 in 60 of 69 after a drift of 10 mm."""
_WIDENING = 1.5  #: Factor by which a radius grows whose frames span no plane.


class _Parts(Record):
    """Parts of the frames that may have moved against each other, and when they are told to have."""

    words: str
    least_rise: float  #: Least of their highest rises, over the median of the smoothed map.
    none_below: float  #: Share of the other part's highest rise below which a part has no rise there.
    remedy: str
    on_paper: str


_SCANS = _Parts(
    "two scans", 0.1, 1 / 2, "build one map per scan, and pool them: estimate --pool", "have each scan mapped by itself"
)
_AT_REST = "scan again, patient and tracker at rest"
_ENDS = _Parts("the scan's first and last third", 0.15, 1 / 3, _AT_REST, _AT_REST)
"""By its thirds 1 of 58 right scans on skin of 75 mm radius is told and 3 of 58 on 50 mm, and 48 of 104 whose tracker
moved by 10 or 20 mm at once, along or across the head."""


def _rises(selections: Sequence[SelectedFrames], plane: Plane) -> tuple[CellSums, FloatArray]:
    """Sums of scans in cells of `_CELL_MM` on `plane`, and their smoothed mean over its median, less 1; NaN for few."""
    sources = accumulate.frame_sources(selections, plane_from_base=plane.plane_from_base, cell_mm=_CELL_MM)
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    sums = accumulate.add_all(sources, levels, cell_mm=_CELL_MM).trimmed()
    count, total = smooth(sums.count), smooth(sums.total)
    least = min(FEW_READINGS, float(count.max()))
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count >= least)
    return sums, mean / np.nanmedian(mean) - 1.0


def _highest(sums: CellSums, rises: FloatArray) -> IndexArray:
    """(2,) row and column on the lattice of the highest rise."""
    return np.add(sums.first, np.unravel_index(int(np.nanargmax(rises)), rises.shape))


def _well_read(sums: CellSums, rises: FloatArray) -> FloatArray:
    """Rises in the half of the cells with most readings; at a border, where only the head's rim was, they mislead."""
    count = smooth(sums.count)
    return np.where(count >= np.median(count[np.isfinite(rises)]), rises, np.nan)


def _rise_at(sums: CellSums, rises: FloatArray, cell: IndexArray) -> float:
    """Rise in a cell of the lattice; NaN off the map."""
    row, column = (cell - sums.first).tolist()
    on_map = 0 <= row < rises.shape[0] and 0 <= column < rises.shape[1]
    return float(rises[row, column]) if on_map else float("nan")


def _moved(parts: Sequence[SelectedFrames], plane: Plane, told: _Parts) -> tuple[Finding, ...]:
    """Caution where two parts have their highest rises each where the other has none, or less of a clear one.

    One lump would be mapped twice, or wider than it is. Lower rises say nothing: beside lumps patterns go with strokes.
    """
    maps = [_rises([part], plane) for part in parts if part.used.sum() >= select.LEAST_FRAMES]
    for one, other in combinations(maps, 2):
        cell, other_cell = (_highest(sums, _well_read(sums, rises)) for sums, rises in (one, other))
        rise, other_rise = _rise_at(*one, cell), _rise_at(*other, other_cell)
        lower, below = min(rise, other_rise), told.none_below
        if lower <= told.least_rise:
            continue
        share = np.max([_rise_at(*other, cell) / other_rise, _rise_at(*one, other_cell) / rise])
        if share < (_LESS_BELOW if lower > _CLEAR_RISE else below):
            apart = _CELL_MM * float(np.linalg.norm(cell - other_cell))
            feels, taken = ("none", "for two") if share < below else ("less", "to be larger than it is")
            text = (
                f"{told.words} feel the highest rise {apart:.0f} mm apart, each where the other feels {feels}: patient "
                f"or tracker moved between them, and one lump may be taken {taken}"
            )
            return (finding("frames_contradict", text, told.remedy, told.on_paper),)
    return ()


def _landmarks_moved(selections: Sequence[SelectedFrames]) -> tuple[Finding, ...]:
    """Caution where both landmarks of two scans lie apart the same way: over a faint lump nothing else tells."""
    touched = [part.scan.landmarks for part in selections if part.scan.landmarks is not None]
    middles = [(marks.sternal_notch_mm + marks.xiphoid_mm) / 2 for marks in touched]
    apart = max((float(np.linalg.norm(one - other)) for one, other in combinations(middles, 2)), default=0.0)
    if apart <= LANDMARKS_MOVED_MM:
        return ()
    text = (
        f"the landmarks of two scans lie {apart:.0f} mm apart on average: patient or tracker moved between them, and "
        "one lump may be missed or taken for two"
    )
    return (finding("frames_contradict", text, _SCANS.remedy, _SCANS.on_paper),)


def _ends(selection: SelectedFrames) -> list[SelectedFrames]:
    """The first and the last third of a scan's used frames."""
    every = np.arange(len(selection.used))
    thirds = np.array_split(np.flatnonzero(selection.used), 3)
    chosen = [frames[:: max(1, len(frames) // _END_FRAMES)] for frames in thirds[::2]]
    return [replace(selection, used=np.isin(every, frames)) for frames in chosen]


def _moved_within(selection: SelectedFrames, plane: Plane) -> tuple[Finding, ...]:
    """`_moved` by the scan's thirds, unless a head that presses unevenly, as on convex skin, explains their rises."""
    moved = _moved(_ends(selection), plane, _ENDS)
    if not moved:
        return ()
    try:
        response, _ = accumulate.flat_field(selection)
    except BadDataError:
        return moved
    even = replace(selection, scan=accumulate.divided(selection.scan, response))
    return _moved(_ends(even), plane, _ENDS)


def local_plane(
    selections: Sequence[SelectedFrames], plane: Plane, *, radius_mm: float | None
) -> tuple[Plane, dict[str, float]]:
    """Best-fit plane of the frames whose array is centred within `radius_mm` of the highest point, and its figures.

    None takes half the diagonal of the array, within which it reaches the point, and widens it while the frames span no
    plane. A stated radius without frames, or whose frames span no plane, is a `BadDataError`.
    """
    highest_mm = _highest(*_rises(selections, plane))[::-1] * _CELL_MM
    distances, reaches = [], []
    for part in selections:
        head = part.scan.head
        middle = apply(inverse(head.scanhead_from_tracker), head.surface_mm.reshape(-1, 3).mean(axis=0))
        centre = apply(plane.plane_from_base, part.poses.places_mm(middle))
        distances.append(np.linalg.norm(centre[:, :2] - highest_mm, axis=1))
        reaches.append(float(np.hypot(*np.ptp(head.surface_mm[..., :2].reshape(-1, 2), axis=0))) / 2)
    radius = radius_mm or max(reaches)
    while True:
        near = [part.used & (distance <= radius) for part, distance in zip(selections, distances, strict=True)]
        moments = _moments(selections, near)
        try:
            if not moments.count:
                what = f"no frame lies within {radius:g} mm of the mass"
                raise BadDataError(what, way_out="give a larger --plane-radius-mm")
            return moments.plane(), {"plane_radius_mm": float(radius), "plane_frames": float(moments.count)}
        except BadDataError:
            if radius_mm is not None or radius > 500.0:
                raise
            radius *= _WIDENING


def _moments(selections: Sequence[SelectedFrames], masks: Sequence[BoolArray]) -> HeadMoments:
    """Moments over the frames of each scan that its (n,) mask chooses."""
    pairs = zip(selections, masks, strict=True)
    return sum((head_moments(part.scan.head, part.poses.part(mask)) for part, mask in pairs), HeadMoments())


# --- Figures of a map's report: motion of the head, coverage of the cells.


def plane_figures(selections: Sequence[SelectedFrames], plane: Plane) -> dict[str, float]:
    """Figures of the head's motion on the plane (tilt, yaw, reach of the strokes) and of the plane's fit.

    ``plane_condition`` is the ratio of the two largest spreads of the taxel centres, large for strokes along a line.
    """
    place_mm, axes = map(np.concatenate, zip(*(motion(part, plane) for part in selections), strict=True))
    x, y, z = axes[:, :, 2].sum(axis=0)
    span = np.ptp(place_mm, axis=0)
    return {
        "plane_rms_mm": plane.rms_mm,
        "plane_condition": float(plane.spread_mm[0] / plane.spread_mm[1]),
        "tilt_deg": float(np.degrees(np.arctan2(np.hypot(x, y), z))),
        "yaw_sd_deg": float(np.degrees(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])).std()),
        "span_x_mm": float(span[0]),
        "span_y_mm": float(span[1]),
    }


def cell_figures(sums: CellSums) -> dict[str, float]:
    """Figures of the cells' coverage, and numbers of unusual readings."""
    filled = sums.count > 0
    return {
        "coverage": float((sums.count >= FEW_READINGS).mean()),
        "median_count": float(np.median(sums.count[filled])),
        "few_cells": float(np.count_nonzero(filled & (sums.count < FEW_READINGS))),
        "clipped_values": float(sums.clipped),
        "negative_readings": float(sums.negative),
    }


def stroke_figures(strokes: Sequence[latency.StrokeShift]) -> dict[str, float]:
    """Figures of each stroke's shift, and of the lump's mobility."""
    mobility_mm, sd_mm = latency.mobility(strokes)
    figures = {
        "strokes": float(len(strokes)),
        "strokes_known": float(sum(stroke.known for stroke in strokes)),
        "mobility_mm": mobility_mm,
        "mobility_sd_mm": sd_mm,
    }
    for number, stroke in enumerate(strokes, start=1):
        if stroke.known:
            figures |= {f"stroke_{number}_shift_x_mm": stroke.shift_mm, f"stroke_{number}_sd_x_mm": stroke.sd_mm}
    return {name: value for name, value in figures.items() if np.isfinite(value)}


# --- Building of a tactile map from scans.

MAX_LANDMARK_SHIFT_MM = 20.0  #: Landmarks of one examination lie nearer to their mean, or patient or tracker moved.
LANDMARKS_MOVED_MM = 10.0
"""Distance between the middles of two scans' landmarks that tells a motion: 99 % of touches by 3 mm (SD) lie nearer."""
_SHARED_FACTS = ("subject", "side", "visit", "posture")  #: Facts of the session that scans of one exam have in common.


def build_map(
    scans: Scan | Sequence[Scan],
    *,
    max_pose_gap_ms: float = MAX_POSE_GAP_MS,
    progress: Progress = no_progress,
    **options: Any,
) -> TactileMap:
    """Tactile map of one scan, or of several scans of one examination on a common plane.

    Between scans the tracker's base and the patient must not have moved. Frames between two distinct poses further
    apart than `max_pose_gap_ms` are left out; `options` are those of `options.MapOptions`. Wellman & Howe (1999),
    section 2.2: (i) fit the plane, (ii) drop frames outside the pressure range and divide the rest by their mean, (iii)
    project and average. The order of frames and scans does not change a bit of the map (record 0017).
    """
    settings = MapOptions(**options)
    check_number("max_pose_gap_ms", max_pose_gap_ms, 0, open_ends=True)
    every_frame = [scans] if isinstance(scans, Scan) else list(scans)
    thinned = [select.every_nth(scan, settings.every) for scan in every_frame]
    _check_same_examination(thinned)
    figures: dict[str, float] = {} if settings.every == 1 else {"frames_every": float(settings.every)}
    late_ms = 0.0 if isinstance(settings.latency_ms, str) else float(settings.latency_ms)
    selections = _select(thinned, settings, late_ms, max_pose_gap_ms)
    figures |= exam_figures(selections)
    findings = _numbered([select.scan_findings(scan) for scan in every_frame])
    try:
        findings += _arrangement_findings(selections, late_ms, figures, refuse=not settings.as_stated)
        return _build(findings, selections, settings, figures, late_ms, max_pose_gap_ms, progress)
    except BadDataError as error:
        raise with_cause(error, (*findings, *exam_findings(figures))) from None


def _build(
    findings: tuple[Finding, ...],
    selections: list[SelectedFrames],
    settings: MapOptions,
    figures: dict[str, float],
    late_ms: float,
    gap_ms: float,
    progress: Progress,
) -> TactileMap:
    """Map of the selected frames; adds its figures to `figures`."""
    figures |= head_profile_figures(selections)
    if settings.flat_field:
        selections = _select(_flattened(selections, figures), settings, late_ms, gap_ms)
    if settings.latency_ms == "auto":
        estimate = latency.estimate_latency(
            selections, plane=_plane(selections), cell_mm=settings.cell_mm, max_pose_gap_ms=gap_ms
        )
        figures |= {"latency_sd_ms": estimate.sd_ms, "latency_bound_ms": estimate.bound_ms}
        late_ms, figures["latency_frames"] = estimate.latency_ms, float(estimate.frames)
        selections = _select([part.scan for part in selections], settings, late_ms, gap_ms)
    figures |= check_convention(selections)
    plane = _plane(selections)
    if settings.plane_radius_mm != "all":
        radius = None if settings.plane_radius_mm == "auto" else settings.plane_radius_mm
        plane, radius_figures = local_plane(selections, plane, radius_mm=radius)
        figures |= radius_figures
    if not any(one.kind == "frames_contradict" for one in findings):
        findings += _numbered([_moved_within(part, plane) for part in selections])
    if len(selections) > 1:
        findings += _moved(selections, plane, _SCANS) or _landmarks_moved(selections)
    sources = accumulate.frame_sources(selections, plane_from_base=plane.plane_from_base, cell_mm=settings.cell_mm)
    if settings.register_strokes:
        sources, strokes = latency.register_strokes(sources)
        figures |= stroke_figures(strokes)
    cells = accumulate.accumulate(sources, cell_mm=settings.cell_mm, normalise=settings.normalise, progress=progress)
    figures |= accumulate.shared_frame_figures(sources, cells.levels, cells.sums)
    figures |= evenness_figures(selections, plane) | latency.stroke_lag_figures(sources)
    figures["stroke_count"] = float(strokes_across := latency.stroke_count(sources))
    lengthwise = latency.stroke_count(sources, axis=1) if strokes_across < LEAST_STROKES else 0
    low, high = map(float, settings.pressure_window_kpa)
    recipe = MapRecipe(
        "scan",
        settings.normalise,
        float(settings.cell_mm),
        (low, high),
        late_ms,
        settings.flat_field,
        settings.register_strokes,
    )
    return _as_map(cells, selections, plane, recipe, figures, findings=findings, strokes_lengthwise=lengthwise)


def _flattened(selections: list[SelectedFrames], figures: dict[str, float]) -> list[Scan]:
    """Scans with used frames, divided by the response of their taxels to an even pressure; adds to `figures`."""
    used = [part for part in selections if part.used.any()]
    flats = [accumulate.flat_field(part) for part in used]
    figures["flat_field_frames"] = float(sum(frames for _, frames in flats))
    figures["flat_field_sd"] = float(np.mean([response.std() for response, _ in flats]))
    return [accumulate.divided(part.scan, response) for (response, _), part in zip(flats, used, strict=True)]


def _arrangement_findings(
    selections: list[SelectedFrames], late_ms: float, figures: dict[str, float], *, refuse: bool
) -> tuple[Finding, ...]:
    """Findings on each scan's arrangement; `BadDataError` if `refuse` and another arrangement is sure."""
    findings = []
    for number, selection in enumerate(selections, start=1):
        check = check_arrangement(selection, latency_ms=late_ms, thorough=False)
        if refuse and check.refused:
            which = f"scan {number}: " if len(selections) > 1 else ""
            raise BadDataError(f"{which}{check.words}", way_out=f"{check.remedy}, or map it with --as-stated")
        if not check.too_short:
            figures["arrangement_log_odds"] = max(check.log_odds, figures.get("arrangement_log_odds", 0.0))
        findings.append(check.findings_of(selection.scan))
    return findings[0] if all(one == findings[0] for one in findings) else _numbered(findings)


def _numbered(findings: list[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    """Findings of all scans, each with its scan's number where there are several."""
    if len(findings) == 1:
        return findings[0]
    return tuple(one.labelled(f"scan {number}") for number, ones in enumerate(findings, start=1) for one in ones)


def _select(scans: list[Scan], settings: MapOptions, late_ms: float, gap_ms: float) -> list[SelectedFrames]:
    """Select the used frames of every scan; an error if none is left in any of them."""
    window = settings.pressure_window_kpa
    selections = [
        select.select_frames(scan, pressure_window_kpa=window, latency_ms=late_ms, max_pose_gap_ms=gap_ms)
        for scan in scans
    ]
    try:
        select.refuse_without_frames(selections, pressure_window_kpa=window)
    except BadDataError as error:
        count = sum(len(scan.frames) for scan in scans)
        if settings.every > 1 and count < select.LEAST_FRAMES:
            what = f"one frame of every {settings.every} leaves {counted(count, 'frame')}, none of which can be used"
            raise BadDataError(what, way_out="give a smaller --every") from None
        if late_ms and not any(part.poses.known.any() for part in selections):
            what = f"{error.what} less a latency of {late_ms:g} ms"
            raise BadDataError(what, way_out=f"give another --latency-ms, or {error.way_out}") from None
        raise
    return selections


def _plane(selections: list[SelectedFrames]) -> Plane:
    """Best-fit plane of all frames used; an error names the rotation convention that would fit."""
    try:
        return _moments(selections, [part.used for part in selections]).plane()
    except BadDataError as error:
        if "quaternion order" not in error.way_out:
            raise
        raise BadDataError(error.what, way_out=convention_way_out(selections)) from None


def _check_same_examination(scans: list[Scan]) -> None:
    """Raise `BadDataError` for no scan, and for scans whose sessions differ."""
    if not scans:
        raise BadDataError("no scan was given", way_out="give at least one")
    for name in (*_SHARED_FACTS, "reference"):
        absent = {name: "the tracker's own frame"} if name == "reference" else {}  # poses are in another frame then
        facts = [absent | dict(scan.session) for scan in scans]
        values = sorted({fact[name] for fact in facts if name in fact})
        if len(values) > 1:
            what = f"the scans differ in {name} ({', '.join(values)})"
            raise BadDataError(what, way_out="build one map per examination")


def _as_map(
    cells: accumulate.Accumulated,
    selections: list[SelectedFrames],
    plane: Plane,
    recipe: MapRecipe,
    figures: dict[str, float],
    *,
    findings: tuple[Finding, ...],
    strokes_lengthwise: int,
) -> TactileMap:
    sums, scans = cells.sums.trimmed(), [part.scan for part in selections]
    patient, nipple, spread = _landmarks(scans, plane)
    side = next(filter(None, (scan.session.get("side", "") for scan in scans)), "")
    centre = None if patient is None else patient[:2, 3].tolist()  # the plane's origin is the middle of the frames
    nipple_place = None if patient is None or nipple is None else apply(patient, nipple).tolist()
    parts = [(f"scan {number} " if len(scans) > 1 else "", part) for number, part in enumerate(selections, start=1)]
    quality = {
        **select.frame_figures(selections),
        **select.timing_figures(scans),
        **plane_figures(selections, plane),
        **pose_noise_figures(selections, plane, cell_mm=recipe.cell_mm),
        **cell_figures(sums),
        **spread,
        **figures,
        "gain_passes": float(cells.passes),
        "gain_last_change": cells.last_change,
        "gain_unsettled": float(not cells.last_change <= accumulate.GAIN_TOLERANCE),
    }
    tactile_map = TactileMap(
        **sums.map_arrays(cells.scale),
        recipe=recipe,
        plane_from_base=plane.plane_from_base,
        patient_from_plane=patient,
        nipple_mm=nipple,
        background=None if recipe.normalise == "none" else 1.0,
        frame_count=int(quality["frames_used"]),
        quality=quality,
        masked_taxels=tuple(f"{which}{fault}" for which, part in parts for fault in part.faults),
        head=_head(scans),
    )
    quality_findings = (
        *(side_findings(side, centre, "the scanned place") or side_findings(side, nipple_place, "the nipple")),
        *convention_findings(quality, findings),
        *broken_assumptions(quality, strokes_lengthwise=strokes_lengthwise),
        *handling_findings(quality),
    )
    return replace(tactile_map, findings=by_severity((*map_findings(tactile_map), *quality_findings, *findings)))


def _head(scans: list[Scan]) -> HeadShape:
    """Shape of the scans' head; `BadDataError` where they are of different ones."""
    first, *others = [HeadShape.of(scan.head.surface_mm, scan.head.pitch_mm) for scan in scans]
    for number, other in enumerate(others, start=2):
        if first.differences(other):
            raise BadDataError(
                f"scan {number} was made by another head ({other}) than scan 1 ({first})",
                way_out="build one map per head",
            )
    return first


def _landmarks(scans: list[Scan], plane: Plane) -> tuple[FloatArray | None, FloatArray | None, dict[str, float]]:
    """Patient frame and nipple in the plane, by the scans' mean landmarks, and the figure of the repeats' distance."""
    touched = [scan.landmarks for scan in scans if scan.landmarks is not None]
    if not touched:
        return None, None, {}
    nipples = [marks.nipple_mm for marks in touched if marks.nipple_mm is not None]
    notch, notch_shift = _mean_point([marks.sternal_notch_mm for marks in touched])
    xiphoid, xiphoid_shift = _mean_point([marks.xiphoid_mm for marks in touched])
    nipple, nipple_shift = _mean_point(nipples) if nipples else (None, 0.0)
    shift = max(notch_shift, xiphoid_shift, nipple_shift)
    if shift > MAX_LANDMARK_SHIFT_MM:
        raise BadDataError(
            f"the scans' landmarks lie up to {shift:.0f} mm from their mean",
            way_out="the patient or the tracker moved between them: build one map per scan",
        )
    transform = patient_from_plane(notch, xiphoid, plane.plane_from_base)
    repeats = [marks.spread_mm for marks in touched if marks.spread_mm is not None]
    repeats += [shift] if len(touched) > 1 else []
    on_plane = None if nipple is None else apply(plane.plane_from_base, nipple)
    return transform, on_plane, {"landmark_spread_mm": max(repeats)} if repeats else {}


def _mean_point(points_mm: list[FloatArray]) -> tuple[FloatArray, float]:
    """Mean of points, and their largest distance from it."""
    points = np.stack(points_mm)
    mean = np.sort(points, axis=0).mean(axis=0)  # sorted, so that the order of the scans leaves no trace
    return mean, float(np.linalg.norm(points - mean, axis=1).max())
