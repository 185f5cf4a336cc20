"""One call from scans to a tactile map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Plane, apply, inverse, patient_from_base
from tactile_bayes.mapping.accumulate import Accumulated, Progress, accumulate, no_progress, sources_of
from tactile_bayes.mapping.engine import choose_engine
from tactile_bayes.mapping.frames import SelectedFrames, refuse_without_frames, select_frames
from tactile_bayes.mapping.plane import HeadMoments, head_moments
from tactile_bayes.mapping.poses import MAX_POSE_GAP_MS
from tactile_bayes.mapping.project import yaw_deg
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap
from tactile_bayes.presets import CELL_MM, NORMALISE, PRESSURE_WINDOW_KPA
from tactile_bayes.scan import Scan

# A cell with this many readings or more counts as covered in the report.
COVERED_READINGS = 10
# Landmarks of one examination further apart than this (mm) mean that the patient or the tracker was moved.
MAX_LANDMARK_SHIFT_MM = 20.0

# Scans that differ in one of these session facts are not of one examination.
_SHARED_FACTS = ("subject", "side", "posture")


def build_map(
    scans: Scan | Sequence[Scan],
    *,
    cell_mm: float = CELL_MM,
    pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA,
    normalise: str = "mean",
    latency_ms: float = 0.0,
    max_pose_gap_ms: float = MAX_POSE_GAP_MS,
    engine: str = "auto",
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
        By how much a pose's stamp is late against the frames.
    max_pose_gap_ms
        Frames between two distinct poses further apart than this are left out.
    engine
        ``"numpy"``, ``"fast"`` (compiled; needs the extra ``[fast]``) or ``"auto"``: the same map, bit for bit.
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
    parts = [scans] if isinstance(scans, Scan) else list(scans)
    _check_options(cell_mm, pressure_window_kpa, normalise, latency_ms)
    _check_same_examination(parts)
    loops = choose_engine(engine, readings=sum(scan.frames.counts.size for scan in parts))
    selections = [
        select_frames(
            scan,
            pressure_window_kpa=pressure_window_kpa,
            latency_ms=latency_ms,
            max_pose_gap_ms=max_pose_gap_ms,
            engine=loops,
        )
        for scan in parts
    ]
    refuse_without_frames(selections, pressure_window_kpa=pressure_window_kpa)
    moments = HeadMoments.none()
    for part in selections:
        moments = moments + head_moments(part.scan.head, part.used_poses)
    plane = moments.plane()
    sources = sources_of(selections, plane_from_base=plane.plane_from_base, cell_mm=cell_mm)
    done = accumulate(sources, cell_mm=cell_mm, normalise=normalise, engine=loops, progress=progress)
    recipe = MapRecipe("scan", normalise, float(cell_mm), _window(pressure_window_kpa), float(latency_ms))
    return _as_map(done, selections, plane, recipe)


def _window(window: tuple[float, float]) -> tuple[float, float]:
    return (float(window[0]), float(window[1]))


def _check_same_examination(scans: list[Scan]) -> None:
    if not scans:
        raise BadDataError("no scan was given", way_out="give at least one")
    for name in _SHARED_FACTS:
        values = sorted({scan.session[name] for scan in scans if name in scan.session})
        if len(values) > 1:
            raise BadDataError(
                f"the scans differ in {name} ({', '.join(values)})", way_out="make one map an examination"
            )


def _check_options(cell_mm: float, window: tuple[float, float], normalise: str, latency_ms: float) -> None:
    if not (np.isfinite(cell_mm) and cell_mm > 0):
        raise BadDataError(f"cell_mm is {cell_mm}", way_out="it must be positive, in mm")
    if not (np.isfinite(window).all() and 0 <= window[0] < window[1]):
        raise BadDataError(f"pressure_window_kpa is {window}", way_out="give two rising pressures, in kPa")
    if normalise not in NORMALISE:
        raise BadDataError(f"normalise is {normalise!r}", way_out=f"choose one of {', '.join(NORMALISE)}")
    if normalise != "none" and not window[0] > 0:
        raise BadDataError(f"pressure_window_kpa starts at {window[0]:g}", way_out="frames are divided by their mean")
    if not np.isfinite(latency_ms):
        raise BadDataError(f"latency_ms is {latency_ms}", way_out="give a finite time in ms")


def _as_map(done: Accumulated, selections: list[SelectedFrames], plane: Plane, recipe: MapRecipe) -> TactileMap:
    sums = done.sums.trimmed()
    quality = {
        **_frame_figures(selections),
        **_plane_figures(selections, plane),
        "coverage": float((sums.count >= COVERED_READINGS).mean()),
        "median_count": float(np.median(sums.count[sums.count > 0])),
        "clipped_values": float(sums.clipped),
        "negative_readings": float(sums.negative),
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
        patient_from_plane=_patient_from_plane([part.scan for part in selections], plane),
        background=None if recipe.normalise == "none" else 1.0,
        frame_count=int(quality["frames_used"]),
        quality=quality,
        masked_taxels=_masked(selections),
    )


def _masked(selections: list[SelectedFrames]) -> tuple[str, ...]:
    """Each taxel that is left out, named with its scan where there are several."""
    several = len(selections) > 1
    return tuple(
        f"scan {number} {fault}" if several else str(fault)
        for number, part in enumerate(selections, start=1)
        for fault in part.faults
    )


def _frame_figures(selections: list[SelectedFrames]) -> dict[str, float]:
    """Frames used and left out, summed over the scans."""
    figures = {
        "scans": len(selections),
        "frames_total": sum(len(part.used) for part in selections),
        "frames_used": sum(int(part.used.sum()) for part in selections),
        "dropped_no_pose": sum(part.dropped_no_pose for part in selections),
        "dropped_elements": sum(part.dropped_elements for part in selections),
        "dropped_low": sum(int(part.low.sum()) for part in selections),
        "dropped_high": sum(int(part.high.sum()) for part in selections),
        "masked_taxels": sum(len(part.faults) for part in selections),
    }
    levels = np.concatenate([part.level_kpa[part.used] for part in selections])
    return {
        **{name: float(value) for name, value in figures.items()},
        "saturated_readings": float(sum(_saturated(part) for part in selections)),
        "mean_pressure_kpa": float(levels.mean()),
    }


def _saturated(part: SelectedFrames) -> int:
    """Readings of good taxels in used frames that were at full scale."""
    good = int(part.good_taxels.sum())
    taxels = part.good_taxels.size
    return int(np.rint((good - part.valid_share[part.used] * taxels).sum()))


def _plane_figures(selections: list[SelectedFrames], plane: Plane) -> dict[str, float]:
    """How the head moved on the plane: tilt, yaw and the reach of the strokes."""
    transform = plane.plane_from_base
    normals, yaws, centres = [], [], []
    for part in selections:
        rotation, tracker_from_head = part.poses.rotation[part.used], inverse(part.scan.head.scanhead_from_tracker)
        normals.append((rotation * tracker_from_head[:3, 2]).sum(axis=2).sum(axis=0))
        yaws.append(yaw_deg(part.scan.head, rotation, plane_from_base=transform))
        apex = part.poses.position_mm[part.used] + (rotation * tracker_from_head[:3, 3]).sum(axis=2)
        centres.append(apply(transform, apex))
    normal = np.sum(normals, axis=0)
    tilt = np.arctan2(np.linalg.norm(np.cross(transform[2, :3], normal)), transform[2, :3] @ normal)
    span = np.ptp(np.concatenate(centres), axis=0)
    return {
        "plane_rms_mm": plane.rms_mm,
        "tilt_deg": float(np.degrees(tilt)),
        "yaw_sd_deg": float(np.concatenate(yaws).std()),
        "span_x_mm": float(span[0]),
        "span_y_mm": float(span[1]),
    }


def _patient_from_plane(scans: list[Scan], plane: Plane) -> FloatArray | None:
    """Patient frame from the landmarks, averaged over the scans that have them."""
    touched = [scan.landmarks for scan in scans if scan.landmarks is not None]
    if not touched:
        return None
    pairs = np.stack([[marks.sternal_notch_mm, marks.xiphoid_mm] for marks in touched])
    mean = np.sort(pairs, axis=0).mean(axis=0)  # sorted, so that the order of the scans leaves no trace
    shift = float(np.linalg.norm(pairs - mean, axis=2).max())
    if shift > MAX_LANDMARK_SHIFT_MM:
        raise BadDataError(
            f"the scans' landmarks lie up to {shift:.0f} mm from their mean",
            way_out="the patient or the tracker moved between them: make one map a scan",
        )
    base = patient_from_base(mean[0], mean[1], normal=plane.plane_from_base[2, :3])
    transform: FloatArray = base @ inverse(plane.plane_from_base)
    return transform
