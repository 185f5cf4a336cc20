"""Building of a tactile map from scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError, UsageError, check_choice, check_number
from tactile_bayes.findings import Finding, by_weight
from tactile_bayes.geometry import FloatArray, Plane, apply, patient_from_plane
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.mapping.accumulate import Accumulated, accumulate
from tactile_bayes.mapping.assumptions import broken_assumptions, handling_findings
from tactile_bayes.mapping.convention import check_convention, convention_findings, hint
from tactile_bayes.mapping.evenness import evenness_figures
from tactile_bayes.mapping.flat_field import flat_field as find_flat_field
from tactile_bayes.mapping.frames import SelectedFrames, refuse_without_frames, select_frames
from tactile_bayes.mapping.head_profile import head_profile_figures
from tactile_bayes.mapping.latency import estimate_latency
from tactile_bayes.mapping.neighbourhood import local_plane
from tactile_bayes.mapping.overlap import scan_findings
from tactile_bayes.mapping.plane import HeadMoments, head_moments
from tactile_bayes.mapping.pose_noise import pose_noise_figures
from tactile_bayes.mapping.poses import MAX_POSE_GAP_MS
from tactile_bayes.mapping.quality import cell_figures, frame_figures, plane_figures, stroke_figures
from tactile_bayes.mapping.shared_frames import shared_frame_figures
from tactile_bayes.mapping.source import Progress, no_progress, sources_of
from tactile_bayes.mapping.stroke_lag import stroke_lag_figures
from tactile_bayes.mapping.strokes import register_strokes as find_shifts
from tactile_bayes.mapping.strokes import stroke_count
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap
from tactile_bayes.mapping.thinning import every_nth
from tactile_bayes.mapping.timing import timing_figures
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, NORMALISE, PRESSURE_WINDOW_KPA
from tactile_bayes.scan import Scan

# Landmarks of one examination further apart than this (mm) mean that the patient or the tracker was moved.
MAX_LANDMARK_SHIFT_MM = 20.0

# Scans that differ in one of these session facts are not of one examination.
_SHARED_FACTS = ("subject", "side", "posture")


def build_map(
    scans: Scan | Sequence[Scan],
    *,
    cell_mm: float = CELL_MM,
    pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA,
    normalise: str = DEFAULT_NORMALISE,
    latency_ms: float | str = 0.0,
    max_pose_gap_ms: float = MAX_POSE_GAP_MS,
    plane_radius_mm: float | str | None = None,
    flat_field: bool = False,
    register_strokes: bool = False,
    every: int = 1,
    progress: Progress = no_progress,
) -> TactileMap:
    """Build the tactile map of one scan, or of several scans of one examination on a common plane.

    Parameters
    ----------
    scans
        With the tracker's base and the patient unmoved between them.
    cell_mm
        Side of the square cells.
    pressure_window_kpa
        Frames whose mean lies outside are left out.
    normalise
        ``"mean"`` (the paper), ``"gain"`` or ``"none"``; see `tactile_bayes.mapping.accumulate.accumulate`.
    latency_ms
        By how much a pose's stamp is late against the frames; ``"auto"`` finds it from the scans.
    max_pose_gap_ms
        Frames between two distinct poses further apart than this are left out.
    plane_radius_mm
        Fit the plane to the frames within this distance of the mass, ``"auto"`` to those whose array can reach it;
        None to all frames used.
    flat_field
        Take off the head's own response, found from the frames that saw no lump.
    register_strokes
        Shift the strokes onto each other before they are averaged, for a lump that follows the head.
    every
        Use one frame of every so many: quicker, and noisier.
    progress
        Called with frames done and frames in all, anew in each pass over the scans.

    Raises
    ------
    BadDataError
        When no frame is left, no taxel works, the taxels span no plane, or the scans do not belong together.

    Notes
    -----
    Wellman & Howe (1999), section 2.2: (i) fit the plane, (ii) drop frames outside the pressure range and divide the
    rest by their mean, (iii) project and average. All sums are over whole numbers: the order of frames and scans does
    not change a bit of the map.
    """
    _check_options(cell_mm, pressure_window_kpa, normalise, latency_ms, plane_radius_mm, max_pose_gap_ms, every)
    given = [scans] if isinstance(scans, Scan) else list(scans)
    parts = [every_nth(scan, every) for scan in given]
    if latency_ms == "auto" and register_strokes:
        raise UsageError(
            "a lump that follows the head mimics a latency; with register_strokes give latency_ms a number"
        )
    _check_same_examination(parts)
    rules = _Rules(_window(pressure_window_kpa), max_pose_gap_ms)
    figures: dict[str, float] = {} if every == 1 else {"frames_every": float(every)}
    late_ms = 0.0 if isinstance(latency_ms, str) else float(latency_ms)
    selections = rules.select(parts, late_ms)
    figures |= head_profile_figures(selections)
    if flat_field:
        selections = _flattened(selections, rules, late_ms, figures)
    if isinstance(latency_ms, str):
        late_ms = _latency(selections, rules, cell_mm, figures)
        selections = rules.select([part.scan for part in selections], late_ms)
    figures |= check_convention(selections)
    plane = _plane(selections)
    if plane_radius_mm is not None:
        radius = None if isinstance(plane_radius_mm, str) else plane_radius_mm
        plane, near = local_plane(selections, plane, radius_mm=radius)
        figures.update(near)
    sources = sources_of(selections, plane_from_base=plane.plane_from_base, cell_mm=cell_mm)
    if register_strokes:
        sources, strokes = find_shifts(sources)
        figures.update(stroke_figures(strokes))
    done = accumulate(sources, cell_mm=cell_mm, normalise=normalise, progress=progress)
    figures.update(shared_frame_figures(sources, done.levels, done.sums))
    figures |= evenness_figures(selections, plane) | stroke_lag_figures(sources)
    figures["stroke_count"] = float(stroke_count(sources))
    recipe = MapRecipe("scan", normalise, float(cell_mm), rules.window_kpa, late_ms, flat_field, register_strokes)
    return _as_map(done, selections, plane, recipe, figures, findings=_of_scans(given))


def _of_scans(scans: list[Scan]) -> tuple[Finding, ...]:
    """What speaks against each scan, by its number where there are several."""
    several = len(scans) > 1
    return tuple(
        one.at(f"scan {number}") if several else one
        for number, scan in enumerate(scans, start=1)
        for one in scan_findings(scan)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rules:
    """Rules for using frames, independent of the latency."""

    window_kpa: tuple[float, float]
    max_pose_gap_ms: float

    def select(self, scans: list[Scan], late_ms: float) -> list[SelectedFrames]:
        """Select the used frames of every scan; an error if none is left in any of them."""
        found = [
            select_frames(
                scan,
                pressure_window_kpa=self.window_kpa,
                latency_ms=late_ms,
                max_pose_gap_ms=self.max_pose_gap_ms,
            )
            for scan in scans
        ]
        refuse_without_frames(found, pressure_window_kpa=self.window_kpa)
        return found


def _flattened(
    selections: list[SelectedFrames], rules: _Rules, late_ms: float, figures: dict[str, float]
) -> list[SelectedFrames]:
    """Divide the head's own response out of the scans and select frames anew; drops scans without a used frame."""
    used = [part for part in selections if part.used.any()]
    flats = [find_flat_field(part) for part in used]
    figures["flat_field_frames"] = float(sum(flat.frames for flat in flats))
    figures["flat_field_sd"] = float(np.mean([flat.spread for flat in flats]))
    return rules.select([flat.applied(part.scan) for flat, part in zip(flats, used, strict=True)], late_ms)


def _latency(selections: list[SelectedFrames], rules: _Rules, cell_mm: float, figures: dict[str, float]) -> float:
    found = estimate_latency(
        selections,
        plane=_plane(selections),
        cell_mm=cell_mm,
        max_pose_gap_ms=rules.max_pose_gap_ms,
    )
    figures |= {
        "latency_sd_ms": found.sd_ms,
        "latency_bound_ms": found.bound_ms,
        "latency_frames": float(found.frames),
    }
    return found.latency_ms


def _plane(selections: list[SelectedFrames]) -> Plane:
    """Best-fit plane of all frames used; an error names the rotation convention that would fit."""
    moments = HeadMoments.none()
    for part in selections:
        moments = moments + head_moments(part.scan.head, part.used_poses)
    try:
        return moments.plane()
    except BadDataError as error:
        if "quaternion order" not in error.way_out:
            raise
        raise BadDataError(error.what, way_out=hint(selections)) from None


def _window(window: tuple[float, float]) -> tuple[float, float]:
    return (float(window[0]), float(window[1]))


def _check_same_examination(scans: list[Scan]) -> None:
    if not scans:
        raise BadDataError("no scan was given", way_out="give at least one")
    for name in _SHARED_FACTS:
        values = sorted({scan.session[name] for scan in scans if name in scan.session})
        if len(values) > 1:
            raise BadDataError(
                f"the scans differ in {name} ({', '.join(values)})", way_out="build one map per examination"
            )


def _check_options(
    cell_mm: float,
    window: tuple[float, float],
    normalise: str,
    latency_ms: float | str,
    plane_radius_mm: float | str | None,
    max_pose_gap_ms: float,
    every: int,
) -> None:
    check_number("cell_mm", cell_mm, 0.01, 50)
    if isinstance(window, str) or np.shape(window) != (2,):
        raise UsageError(f"pressure_window_kpa is {window!r}; give two rising pressures, in kPa")
    for end in window:
        check_number("an end of pressure_window_kpa", end, 0)
    if not window[0] < window[1]:
        raise UsageError(f"pressure_window_kpa is {window}; give two rising pressures, in kPa")
    check_choice("normalise", normalise, NORMALISE)
    if normalise != "none" and not window[0] > 0:
        raise UsageError("pressure_window_kpa starts at 0; frames are divided by their mean, give more")
    if latency_ms != "auto":
        check_number("latency_ms", latency_ms, -10_000, 10_000)
    if plane_radius_mm not in (None, "auto"):
        check_number("plane_radius_mm", plane_radius_mm, 0, open_ends=True)
    check_number("max_pose_gap_ms", max_pose_gap_ms, 0, open_ends=True)
    check_number("every", every, 1, whole=True)


def _as_map(
    done: Accumulated,
    selections: list[SelectedFrames],
    plane: Plane,
    recipe: MapRecipe,
    figures: dict[str, float],
    *,
    findings: tuple[Finding, ...],
) -> TactileMap:
    sums, scans = done.sums.trimmed(), [part.scan for part in selections]
    patient, nipple, spread = _landmarks(scans, plane)
    quality = {
        **frame_figures(selections),
        **timing_figures(scans),
        **plane_figures(selections, plane),
        **pose_noise_figures(selections, plane, cell_mm=recipe.cell_mm),
        **cell_figures(sums),
        **spread,
        **figures,
        "gain_passes": float(done.passes),
        "gain_last_change": done.last_change,
        "gain_unsettled": float(not done.settled),
    }
    return TactileMap(
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
        masked_taxels=_masked(selections),
        head=_head(scans),
        findings=by_weight(
            (*convention_findings(quality), *broken_assumptions(quality), *handling_findings(quality), *findings)
        ),
    )


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


def _masked(selections: list[SelectedFrames]) -> tuple[str, ...]:
    """List the taxels left out, with their scan's name where there are several."""
    several = len(selections) > 1
    return tuple(
        f"scan {number} {fault}" if several else str(fault)
        for number, part in enumerate(selections, start=1)
        for fault in part.faults
    )


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
    found = np.stack(points_mm)
    mean = np.sort(found, axis=0).mean(axis=0)  # sorted, so that the order of the scans leaves no trace
    return mean, float(np.linalg.norm(found - mean, axis=1).max())
