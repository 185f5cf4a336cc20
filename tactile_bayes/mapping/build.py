"""From a scan to a map (paper steps i to iii): the passes in order, and the map's quality."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, check_number
from tactile_bayes.findings import Finding, by_severity
from tactile_bayes.geometry import BoolArray, FloatArray, Plane, apply, inverse, patient_from_plane
from tactile_bayes.mapping import accumulate, latency, select
from tactile_bayes.mapping.arrangement import check_arrangement
from tactile_bayes.mapping.cells import MAX_POSE_GAP_MS, CellSums, HeadMoments, head_moments
from tactile_bayes.mapping.convention import check_convention, convention_findings, convention_way_out
from tactile_bayes.mapping.map import FEW_READINGS, MapRecipe, TactileMap, broken_assumptions, handling_findings, smooth
from tactile_bayes.mapping.plausibility import exam_figures, exam_findings, map_findings, with_cause
from tactile_bayes.mapping.profile import evenness_figures, head_profile_figures, motion, pose_noise_figures
from tactile_bayes.mapping.select import SelectedFrames
from tactile_bayes.options import MapOptions
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.scans import HeadShape, Scan

# --- Frames near the mass, to which the paper fits its plane.

# The mass is looked for in cells of this side: its place matters to a few mm.
_CELL_MM = 2.0
_WIDER = 1.5


def find_mass(selections: Sequence[SelectedFrames], plane: Plane) -> FloatArray:
    """(2,) place of the highest point of the smoothed map on `plane`, mm."""
    sources = accumulate.sources_of(selections, plane_from_base=plane.plane_from_base, cell_mm=_CELL_MM)
    levels = [source.selection.level_kpa[source.selection.used] for source in sources]
    sums = accumulate.add_all(sources, levels, cell_mm=_CELL_MM).trimmed()
    count, total = smooth(sums.count), smooth(sums.total)
    mean = np.divide(total, count, out=np.full_like(total, -np.inf), where=count >= FEW_READINGS)
    row, column = np.unravel_index(int(mean.argmax()), mean.shape)
    return np.array([sums.x_mm()[column], sums.y_mm()[row]])


def local_plane(
    selections: Sequence[SelectedFrames], plane: Plane, *, radius_mm: float | None
) -> tuple[Plane, dict[str, float]]:
    """Best-fit plane of the frames whose array is centred within `radius_mm` of the mass, and its figures.

    None takes half the diagonal of the array, within which an array reaches the mass, and widens it while those frames
    span no plane. A given radius without frames, or whose frames span no plane, is a `BadDataError`.
    """
    mass, distances = find_mass(selections, plane), []
    for part in selections:
        head = part.scan.head
        middle = apply(inverse(head.scanhead_from_tracker), head.surface_mm.reshape(-1, 3).mean(axis=0))
        centre = apply(plane.plane_from_base, part.poses.places_mm(middle))
        distances.append(np.linalg.norm(centre[:, :2] - mass, axis=1))
    radius = radius_mm or max(
        float(np.hypot(*np.ptp(part.scan.head.surface_mm[..., :2].reshape(-1, 2), axis=0))) / 2 for part in selections
    )
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
            radius *= _WIDER


def _moments(selections: Sequence[SelectedFrames], frames: Sequence[BoolArray]) -> HeadMoments:
    """Of the (n,) frames chosen of each scan."""
    pairs = zip(selections, frames, strict=True)
    return sum((head_moments(part.scan.head, part.poses.part(some)) for part, some in pairs), HeadMoments())


# --- Figures of a map's report: motion of the head, coverage of the cells.


def plane_figures(selections: Sequence[SelectedFrames], plane: Plane) -> dict[str, float]:
    """Motion of the head on the plane (tilt, yaw, reach of the strokes), and how well the plane is determined.

    ``plane_condition`` is the longest over the second spread of the taxel centres: large for strokes along a line.
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
    """Coverage of the cells, and unusual readings in them."""
    hit = sums.count > 0
    return {
        "coverage": float((sums.count >= FEW_READINGS).mean()),
        "median_count": float(np.median(sums.count[hit])),
        "few_cells": float(np.count_nonzero(hit & (sums.count < FEW_READINGS))),
        "clipped_values": float(sums.clipped),
        "negative_readings": float(sums.negative),
    }


def stroke_figures(strokes: Sequence[latency.StrokeShift]) -> dict[str, float]:
    """Shift of each stroke, and the mobility that they add up to."""
    if not strokes:
        return {}
    moved, sd = latency.mobility(strokes)
    figures = {
        "strokes": float(len(strokes)),
        "strokes_known": float(sum(one.known for one in strokes)),
        "mobility_mm": moved,
        "mobility_sd_mm": sd,
    }
    for number, one in enumerate(strokes, start=1):
        if one.known:
            figures |= {f"stroke_{number}_shift_x_mm": one.shift_mm, f"stroke_{number}_sd_x_mm": one.sd_mm}
    return {name: value for name, value in figures.items() if np.isfinite(value)}


# --- Building of a tactile map from scans.

# Landmarks of one examination further apart than this (mm) mean that the patient or the tracker was moved.
MAX_LANDMARK_SHIFT_MM = 20.0

# Scans that differ in one of these session facts are not of one examination.
_SHARED_FACTS = ("subject", "side", "posture")


def build_map(
    scans: Scan | Sequence[Scan],
    *,
    max_pose_gap_ms: float = MAX_POSE_GAP_MS,
    progress: Progress = no_progress,
    **options: Any,
) -> TactileMap:
    """Build the tactile map of one scan, or of several scans of one examination on a common plane.

    Between scans the tracker's base and the patient must not have moved. Frames between two distinct poses further
    apart than `max_pose_gap_ms` are left out; `options` are those of `options.MapOptions`. Wellman & Howe (1999),
    section 2.2: (i) fit the plane, (ii) drop frames outside the pressure range and divide the rest by their mean, (iii)
    project and average. All sums are over whole numbers: the order of frames and scans does not change a bit of the
    map.
    """
    how = MapOptions(**options)
    check_number("max_pose_gap_ms", max_pose_gap_ms, 0, open_ends=True)
    given = [scans] if isinstance(scans, Scan) else list(scans)
    parts = [select.every_nth(scan, how.every) for scan in given]
    _check_same_examination(parts)
    figures: dict[str, float] = {} if how.every == 1 else {"frames_every": float(how.every)}
    late_ms = 0.0 if isinstance(how.latency_ms, str) else float(how.latency_ms)
    selections = _selected(parts, how, late_ms, max_pose_gap_ms)
    figures |= exam_figures(selections)
    of_scans = _numbered([select.scan_findings(scan) for scan in given])
    try:
        return _built(of_scans, selections, how, figures, late_ms=late_ms, gap_ms=max_pose_gap_ms, progress=progress)
    except BadDataError as error:
        raise with_cause(error, (*of_scans, *exam_findings(figures))) from None


def _built(
    of_scans: tuple[Finding, ...],
    selections: list[SelectedFrames],
    how: MapOptions,
    figures: dict[str, float],
    *,
    late_ms: float,
    gap_ms: float,
    progress: Progress,
) -> TactileMap:
    """The map from the frames that are used, whose `figures` it adds to."""
    findings = of_scans + _of_arrangement(selections, late_ms, figures, refuse=not how.as_stated)
    figures |= head_profile_figures(selections)
    if how.flat_field:
        used = [part for part in selections if part.used.any()]
        flats = [accumulate.flat_field(part) for part in used]
        figures["flat_field_frames"] = float(sum(frames for _, frames in flats))
        figures["flat_field_sd"] = float(np.mean([response.std() for response, _ in flats]))
        even = [accumulate.divided(part.scan, response) for (response, _), part in zip(flats, used, strict=True)]
        selections = _selected(even, how, late_ms, gap_ms)
    if how.latency_ms == "auto":
        found = latency.estimate_latency(
            selections, plane=_plane(selections), cell_mm=how.cell_mm, max_pose_gap_ms=gap_ms
        )
        figures |= {"latency_sd_ms": found.sd_ms, "latency_bound_ms": found.bound_ms}
        late_ms, figures["latency_frames"] = found.latency_ms, float(found.frames)
        selections = _selected([part.scan for part in selections], how, late_ms, gap_ms)
    figures |= check_convention(selections)
    plane = _plane(selections)
    if how.plane_radius_mm != "all":
        radius = None if how.plane_radius_mm == "auto" else how.plane_radius_mm
        plane, near = local_plane(selections, plane, radius_mm=radius)
        figures.update(near)
    sources = accumulate.sources_of(selections, plane_from_base=plane.plane_from_base, cell_mm=how.cell_mm)
    if how.register_strokes:
        sources, strokes = latency.register_strokes(sources)
        figures.update(stroke_figures(strokes))
    done = accumulate.accumulate(sources, cell_mm=how.cell_mm, normalise=how.normalise, progress=progress)
    figures.update(accumulate.shared_frame_figures(sources, done.levels, done.sums))
    figures |= evenness_figures(selections, plane) | latency.stroke_lag_figures(sources)
    figures["stroke_count"] = float(latency.stroke_count(sources))
    low, high = map(float, how.pressure_window_kpa)
    recipe = MapRecipe(
        "scan", how.normalise, float(how.cell_mm), (low, high), late_ms, how.flat_field, how.register_strokes
    )
    return _as_map(done, selections, plane, recipe, figures, findings=findings)


def _of_arrangement(
    selections: list[SelectedFrames], late_ms: float, figures: dict[str, float], *, refuse: bool
) -> tuple[Finding, ...]:
    """Findings on how each scan is arranged; where another arrangement than the one stated is sure, it is refused."""
    findings = []
    for number, one in enumerate(selections, start=1):
        check = check_arrangement(one, latency_ms=late_ms, thorough=False)
        if refuse and check.refused:
            which = f"scan {number}: " if len(selections) > 1 else ""
            raise BadDataError(f"{which}{check.words}", way_out=f"{check.remedy}, or map it with --as-stated")
        if not check.too_short:
            figures["arrangement_log_odds"] = max(check.log_odds, figures.get("arrangement_log_odds", 0.0))
        findings.append(check.findings_of(one.scan))
    return findings[0] if all(one == findings[0] for one in findings) else _numbered(findings)


def _numbered(findings: list[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    """Findings of each scan, by its number where there are several."""
    if len(findings) == 1:
        return findings[0]
    return tuple(one.labelled(f"scan {number}") for number, some in enumerate(findings, start=1) for one in some)


def _selected(scans: list[Scan], how: MapOptions, late_ms: float, gap_ms: float) -> list[SelectedFrames]:
    """Select the used frames of every scan; an error if none is left in any of them."""
    window = how.pressure_window_kpa
    selections = [
        select.select_frames(scan, pressure_window_kpa=window, latency_ms=late_ms, max_pose_gap_ms=gap_ms)
        for scan in scans
    ]
    select.refuse_without_frames(selections, pressure_window_kpa=window)
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
    if not scans:
        raise BadDataError("no scan was given", way_out="give at least one")
    for name in (*_SHARED_FACTS, "reference"):
        absent = {name: "the tracker's own frame"} if name == "reference" else {}  # poses are in another frame then
        facts = [absent | dict(scan.session) for scan in scans]
        values = sorted({one[name] for one in facts if name in one})
        if len(values) > 1:
            raise BadDataError(
                f"the scans differ in {name} ({', '.join(values)})", way_out="build one map per examination"
            )


def _as_map(
    done: accumulate.Accumulated,
    selections: list[SelectedFrames],
    plane: Plane,
    recipe: MapRecipe,
    figures: dict[str, float],
    *,
    findings: tuple[Finding, ...],
) -> TactileMap:
    sums, scans = done.sums.trimmed(), [part.scan for part in selections]
    patient, nipple, spread = _landmarks(scans, plane)
    parts = [(f"scan {number} " if len(scans) > 1 else "", part) for number, part in enumerate(selections, start=1)]
    quality = {
        **select.frame_figures(selections),
        **select.timing_figures(scans),
        **plane_figures(selections, plane),
        **pose_noise_figures(selections, plane, cell_mm=recipe.cell_mm),
        **cell_figures(sums),
        **spread,
        **figures,
        "gain_passes": float(done.passes),
        "gain_last_change": done.last_change,
        "gain_unsettled": float(not done.last_change <= accumulate.GAIN_TOLERANCE),
    }
    tactile_map = TactileMap(
        mean=sums.mean() / done.scale,
        variance=sums.variance() / done.scale**2,
        count=sums.count,
        x_mm=sums.x_mm(),
        y_mm=sums.y_mm(),
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
    of_map = (*convention_findings(quality, findings), *broken_assumptions(quality), *handling_findings(quality))
    return replace(tactile_map, findings=by_severity((*map_findings(tactile_map), *of_map, *findings)))


def _head(scans: list[Scan]) -> HeadShape:
    """Shape of the scans' head; an error where they are of different ones."""
    first, *others = [HeadShape.of(scan.head.surface_mm, scan.head.pitch_mm) for scan in scans]
    for number, other in enumerate(others, start=2):
        if first.differences(other):
            raise BadDataError(
                f"scan {number} was made by another head ({other}) than scan 1 ({first})",
                way_out="build one map per head",
            )
    return first


def _landmarks(scans: list[Scan], plane: Plane) -> tuple[FloatArray | None, FloatArray | None, dict[str, float]]:
    """Patient frame and nipple in the plane, from the mean landmarks of the scans, and the distance between repeats."""
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
    """Mean of points, and the largest distance from it."""
    points = np.stack(points_mm)
    mean = np.sort(points, axis=0).mean(axis=0)  # sorted, so that the order of the scans leaves no trace
    return mean, float(np.linalg.norm(points - mean, axis=1).max())
