r"""Figures of how even a scan's surroundings were: the head's profile from place to place and stroke to stroke.

Where no lump is felt, the profile of the head depends on the layers below it (`tactile_bayes.mapping.head_profile`). A
profile that changes with the head's place means layers whose depth changes; one that is skewed along the stroke, to
the other side in strokes the other way, means that the skin is dragged along. How the head's normal turns as it moves
is the curvature of the skin, to which an examiner keeps the head square.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray, Plane, apply, inverse
from tactile_bayes.mapping.coarse_frames import stroke_starts
from tactile_bayes.mapping.frames import SelectedFrames
from tactile_bayes.mapping.head_profile import LEAST_FRAMES, SKEW, ProfileReader, lump_free, profile_frames
from tactile_bayes.mapping.readout import Readout

SPAN_MM = 30.0
"""Distance over which a change of the profile is stated."""
# Neighbouring frames share errors: standard errors come from leaving out every tenth stretch of this many seconds.
_STRETCH_S = 0.5
_GROUPS = 10
# A direction that the head moved in by less than this (SD, mm) tells no change.
_LEAST_SPREAD_MM = 3.0
# Columns of the regression.
_X, _Y, _WAY = 1, 2, 3


def evenness_figures(selections: Sequence[SelectedFrames], plane: Plane) -> dict[str, float]:
    """Figures of the map's evenness, with standard errors where they come from a regression.

    Returns
    -------
    dict
        ``skin_curvature_per_m``: by how much the head's normal turned outwards as it moved outwards, rad per m; above 0
        on convex skin. ``profile_change``, ``profile_change_sd``: change of `head_profile_x2` over `SPAN_MM` in the
        direction in which it changes most. ``stroke_skew``, ``stroke_skew_sd``: first-order coefficient of the
        profile along the strokes, half the difference between strokes towards +x and towards -x; not given where all
        strokes went one way. The last four are missing where too few frames are free of a lump or the head hardly
        moved.
    """
    parts = [_Frames.of(part, plane) for part in selections if part.used.any()]
    figures = _curvature(parts)
    rows, designs, groups = [], [], []
    for part in parts:
        some_rows, some_designs, some_groups = part.profiles()
        rows.append(some_rows)
        designs.append(some_designs)
        groups.append(some_groups)
    return figures | _profile_changes(np.concatenate(rows), np.concatenate(designs), np.concatenate(groups))


class _Frames:
    """Where the head was in the used frames of a scan: places and normals on the plane, and the strokes' directions."""

    def __init__(self, part: SelectedFrames, place_mm: FloatArray, axes: FloatArray) -> None:
        self.part, self.place_mm, self.axes = part, place_mm, axes
        self.way = _ways(place_mm[:, 0])

    @classmethod
    def of(cls, part: SelectedFrames, plane: Plane) -> _Frames:
        rotation, tracker_from_head = part.poses.rotation[part.used], inverse(part.scan.head.scanhead_from_tracker)
        apex = part.poses.position_mm[part.used] + (rotation * tracker_from_head[:3, 3]).sum(axis=2)
        axes = np.einsum("ij,njk,kl->nil", plane.plane_from_base[:3, :3], rotation, tracker_from_head[:3, :3])
        return cls(part, apply(plane.plane_from_base, apex), axes)

    def profiles(self) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        """(f, 10) profiles of the readable frames, the (f, 7) terms of their regression, and (f,) stretches of time."""
        part = self.part
        chosen = profile_frames(part)
        reader = ProfileReader.of(part.good_taxels)
        among = np.searchsorted(np.flatnonzero(part.used), chosen)
        level = part.level_kpa[chosen]
        readout = Readout.of(part.scan.element_calibration, part.good_taxels)
        pressure = readout.pressure_kpa(readout.counts(part.scan.frames.counts[chosen]))[0]
        place = self.place_mm[among, :2] / SPAN_MM
        tilt = self.axes[among, 2, :2]
        one = np.ones((len(chosen), 1))
        design = np.hstack([one, place, self.way[among, None], np.log(level)[:, None], tilt])
        stretch = np.floor(part.scan.frames.time_s[chosen] / _STRETCH_S).astype(np.int64) % _GROUPS
        return reader.whole(pressure, level), design, stretch


def _ways(x_mm: FloatArray) -> FloatArray:
    """(n,) 1 in strokes towards +x, -1 in others."""
    way, starts = np.ones(len(x_mm)), stroke_starts(x_mm)
    for start, stop in pairwise(starts):
        way[start:stop] = 1.0 if x_mm[min(stop, len(x_mm) - 1)] >= x_mm[start] else -1.0
    return way


def _curvature(parts: Sequence[_Frames]) -> dict[str, float]:
    """Mean over the directions in which the head moved, weighted by how far."""
    place = np.concatenate([part.place_mm[:, :2] - part.place_mm[:, :2].mean(axis=0) for part in parts])
    normal = np.concatenate([part.axes[:, :2, 2] - part.axes[:, :2, 2].mean(axis=0) for part in parts])
    moved = float(np.sum(place**2))
    if not moved > len(place) * _LEAST_SPREAD_MM**2:
        return {}
    return {"skin_curvature_per_m": -1000.0 * float(np.sum(place * normal)) / moved}


def _profile_changes(rows: FloatArray, design: FloatArray, group: NDArray[np.int64]) -> dict[str, float]:
    """Changes of the profile with place and stroke, by least squares over the lump-free frames."""
    if len(rows) < LEAST_FRAMES:
        return {}
    free = lump_free(rows[:, -1])
    if np.count_nonzero(free) < LEAST_FRAMES:
        return {}
    rows, design, group = (
        rows[free],
        design[free] - design[free].mean(axis=0) * (np.arange(design.shape[1]) > 0),
        group[free],
    )
    if min(np.std(design[:, _X]), np.std(design[:, _Y])) * SPAN_MM < _LEAST_SPREAD_MM:
        return {}
    both_ways = np.std(design[:, _WAY]) > 0
    kept = np.flatnonzero(np.std(design, axis=0) > 0)
    columns = np.concatenate([[0], kept])
    found, errors = _regression(design[:, columns], rows[:, :-1], group)
    at = {int(column): i for i, column in enumerate(columns)}
    slope, slope_error = (values[[at[_X], at[_Y]], 0] for values in (found, errors))
    change = float(np.hypot(*slope))
    figures = {
        "profile_change": change,
        "profile_change_sd": float(np.sqrt(np.sum((slope * slope_error) ** 2)) / change) if change > 0 else 0.0,
    }
    if both_ways:
        figures |= {"stroke_skew": float(found[at[_WAY], SKEW]), "stroke_skew_sd": float(errors[at[_WAY], SKEW])}
    return figures


def _regression(design: FloatArray, rows: FloatArray, group: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """(c, k) coefficients of (n, k) rows on an (n, c) design, and their standard errors by a grouped jackknife."""
    normal = np.stack([design[group == g].T @ design[group == g] for g in range(_GROUPS)])
    right = np.stack([design[group == g].T @ rows[group == g] for g in range(_GROUPS)])
    used = np.flatnonzero(normal[:, 0, 0] > 0)
    whole = _solved(normal.sum(axis=0), right.sum(axis=0))
    without = np.stack([_solved(normal.sum(axis=0) - normal[g], right.sum(axis=0) - right[g]) for g in used])
    error = np.sqrt((len(used) - 1) / len(used) * np.sum((without - without.mean(axis=0)) ** 2, axis=0))
    return whole, np.asarray(error)


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-10)[0])
