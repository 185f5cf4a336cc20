"""Figures of a map's report: frames used and left out, motion of the head, coverage of the cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import Plane, apply, inverse
from tactile_bayes.mapping.cells import CellSums
from tactile_bayes.mapping.frames import SelectedFrames
from tactile_bayes.mapping.project import yaw_deg
from tactile_bayes.mapping.strokes import StrokeShift, mobility
from tactile_bayes.mapping.tactile_map import FEW_READINGS


def frame_figures(selections: Sequence[SelectedFrames]) -> dict[str, float]:
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
        "saturated_readings": sum(_saturated(part) for part in selections),
    }
    levels = np.concatenate([part.level_kpa[part.used] for part in selections])
    felt = np.concatenate([part.level_kpa[part.used | part.low | part.high] for part in selections])
    low, high = np.quantile(felt, [0.05, 0.95])
    return {
        **{name: float(value) for name, value in figures.items()},
        "mean_pressure_kpa": float(levels.mean()),
        "level_p05_kpa": float(low),
        "level_p95_kpa": float(high),
    }


def _saturated(part: SelectedFrames) -> int:
    """Number of full-scale readings of good taxels in used frames."""
    good = int(part.good_taxels.sum())
    return int(np.rint((good - part.valid_share[part.used] * part.good_taxels.size).sum()))


def plane_figures(selections: Sequence[SelectedFrames], plane: Plane) -> dict[str, float]:
    """Motion of the head on the plane (tilt, yaw, reach of the strokes), and how well the plane is determined.

    ``plane_condition`` is the longest over the second spread of the taxel centres: large for strokes along a line.
    """
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
        "plane_condition": float(plane.spread_mm[0] / plane.spread_mm[1]),
        "tilt_deg": float(np.degrees(tilt)),
        "yaw_sd_deg": float(np.concatenate(yaws).std()),
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


def stroke_figures(strokes: Sequence[StrokeShift]) -> dict[str, float]:
    """Shift of each stroke, and the mobility that they add up to."""
    if not strokes:
        return {}
    moved, sd = mobility(strokes)
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
