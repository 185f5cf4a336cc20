"""Profile of the head's pressure beside lumps, its change over the scan, and the tracker position error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray, Plane, apply, inverse, rotation_from_quaternion
from tactile_bayes.mapping.convention import directions_along
from tactile_bayes.mapping.select import SelectedFrames, chunks
from tactile_bayes.presets import HEAD_PROFILE, POSE_NOISE

# --- Random choice of frames by the smallest hashes of their levels: it depends on the set of frames alone, not on
# their order or portions (record 0085).

NO_LIMIT = np.uint64(2**64 - 1)
_ROUNDS = ((np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)), (np.uint64(27), np.uint64(0x94D049BB133111EB)))
_LAST_SHIFT = np.uint64(31)


def frame_marks(level_kpa: FloatArray) -> NDArray[np.uint64]:
    """(f,) hashes of the frames' exact mean levels, by SplitMix64's mixing function.

    Steele, Lea & Flood (2014), Fast splittable pseudorandom number generators.
    """
    mark = np.ascontiguousarray(level_kpa).view(np.uint64)
    for shift, factor in _ROUNDS:
        mark = (mark ^ (mark >> shift)) * factor
    return mark ^ (mark >> _LAST_SHIFT)


def marks_limit(marks: NDArray[np.uint64], most: int) -> np.uint64:
    """Limit below which at most `most` marks lie; a growing set needs only the marks below its earlier limits."""
    if len(marks) <= most:
        return NO_LIMIT
    return np.uint64(np.partition(marks, most)[most])


# --- Pressure profile of the head away from lumps, which depends on the depth of the soft layer below it.
#
# A curved head on a thin soft layer presses hardest in its middle, on a deep one at its rim (Wellman & Howe 1999,
# Eq 1: the width of the homogeneous profile goes with the thickness of the tissue).

MOST_FRAMES = 2048  #: Frames that are read, chosen by their marks: all of a scan of 10 s at 200 Hz.
_CHUNK = 128
_STEP = 2.0**-32  #: The figures are means of whole multiples of this.
# A frame is lump-free when its residual about a smooth profile is within this factor of the tenth percentile; there
# must be this many of them.
SMOOTH_FACTOR = 1.1
LEAST_FRAMES = 50
# Orders across and along the head, those of `HEAD_PROFILE` first. Odd and mixed ones absorb the head's tilt. The fourth
# across depends on the head's very rim: two simulations with one body differ in it by half its range.
_ORDERS = ((2, 0), (0, 2), (0, 4), (0, 0), (4, 0), (1, 0), (0, 1), (1, 1), (2, 2))
SKEW = _ORDERS.index((1, 0))  #: Index of the coefficient of first order across the head.
_HIGHEST = 4
_COLUMNS = len(_ORDERS) + 1


def head_profile_figures(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """The map's figures `HEAD_PROFILE`, and ``head_profile_frames``; none where too few frames are lump-free."""
    marked = [_marked(part) for part in selections]
    limit = marks_limit(np.concatenate([marks for _, marks in marked]), MOST_FRAMES)
    pairs = zip(selections, marked, strict=True)
    return profile_figures(np.concatenate([_read(part, frames[marks < limit]) for part, (frames, marks) in pairs]))


def _marked(part: SelectedFrames) -> tuple[IndexArray, NDArray[np.uint64]]:
    """Complete used frames of a scan, in the order of time, and their marks."""
    frames = np.flatnonzero(part.used & _complete(part.level_kpa, part.valid_share, part.good_taxels))
    return frames, frame_marks(part.level_kpa[frames])


def _complete(level_kpa: FloatArray, valid_share: FloatArray, good: BoolArray) -> BoolArray:
    """(n,) mask of the frames with all good taxels valid and a mean above 0."""
    return np.asarray((valid_share == np.count_nonzero(good) / good.size) & (level_kpa > 0))


def profile_figures(rows: FloatArray) -> dict[str, float]:
    """Means over the lump-free frames, from the (f, 10) rows of `ProfileReader` in any order; none for rows of NaN."""
    if len(rows) < LEAST_FRAMES:
        return {}
    smooth = rows[_lump_free(rows), : len(HEAD_PROFILE)]
    if len(smooth) < LEAST_FRAMES:
        return {}
    # sums of whole steps have the same bits in any order
    mean = np.ones(len(smooth)) @ np.rint(smooth / _STEP) * (_STEP / len(smooth))
    return {
        **{name: float(value) for name, value in zip(HEAD_PROFILE, mean, strict=True)},
        "head_profile_frames": float(len(smooth)),
    }


def _lump_free(rows: FloatArray) -> BoolArray:
    """(f,) mask of the frames without a lump or a rib's edge, by the residuals about their smooth profiles."""
    return np.asarray(rows[:, -1] <= SMOOTH_FACTOR * np.quantile(rows[:, -1], 0.1))


def _read(part: SelectedFrames, frames: IndexArray) -> FloatArray:
    """(f, 10) rows of frames, read in chunks that fit the processor's cache."""
    reader, rows = ProfileReader.of(part.good_taxels), np.empty((len(frames), _COLUMNS))
    for chunk in chunks(len(frames), _CHUNK):
        rows[chunk] = reader.read(part.pressure_kpa(frames[chunk])[0], part.level_kpa[frames[chunk]])
    return rows


class GrowingProfile:
    """Profiles of at most `MOST_FRAMES` frames of a growing scan, the same in any portions and order."""

    def __init__(self, good: BoolArray) -> None:
        self._good, self._reader, self._limit = good, ProfileReader.of(good), NO_LIMIT
        self._marks, self._rows = np.zeros(0, dtype=np.uint64), np.zeros((0, _COLUMNS))

    def add(self, pressure_kpa: FloatArray, level_kpa: FloatArray, valid_share: FloatArray) -> None:
        """Add frames: (f, k) pressures of the used taxels, (f,) means in kPa, (f,) valid shares of all taxels."""
        marks = frame_marks(level_kpa)
        chosen = (marks < self._limit) & _complete(level_kpa, valid_share, self._good)
        self._marks = np.concatenate([self._marks, marks[chosen]])
        self._rows = np.concatenate([self._rows, self._reader.read(pressure_kpa[chosen], level_kpa[chosen])])
        if len(self._marks) > 2 * MOST_FRAMES:
            self._thin_out()

    def figures(self) -> dict[str, float]:
        """`profile_figures` of the frames so far."""
        self._thin_out()
        return profile_figures(self._rows)

    def _thin_out(self) -> None:
        self._limit = min(self._limit, marks_limit(self._marks, MOST_FRAMES))
        below = self._marks < self._limit
        self._marks, self._rows = self._marks[below], self._rows[below]


class ProfileReader(Record, eq=False):
    """Least-squares fit of smooth pressure profiles to frames."""

    solve: FloatArray
    """(9, taxels) array: Matrix from readings at the good taxels to coefficients of Legendre polynomials; no taxel
    where too few rows or columns have a good one to distinguish the polynomials."""
    gram: FloatArray  #: (9, 9) array: Inner products of the polynomials.

    @classmethod
    def of(cls, good: BoolArray) -> ProfileReader:
        """Reader for the good taxels of an array, True in (rows, columns)."""
        # at the taxels' centres, the array's ends at -1 and 1
        across, along = (_legendre((2.0 * np.arange(n) + 1.0) / n - 1.0) for n in good.shape)
        terms = np.stack([np.outer(across[i], along[j])[good] for i, j in _ORDERS], axis=1)
        if min(np.count_nonzero(good.any(axis=1)), np.count_nonzero(good.any(axis=0))) <= _HIGHEST:
            terms = terms[:0]
        return cls(np.ascontiguousarray(np.linalg.pinv(terms)), terms.T @ terms)

    def read(self, pressure_kpa: FloatArray, level_kpa: FloatArray) -> FloatArray:
        """(f, 10) coefficients of frames, those of `HEAD_PROFILE` first, and RMS residuals, all over the frames' means.

        From (f, taxels) pressures, all valid, and (f,) means above 0; NaN where the array has too few rows or columns.
        A frame's bits do not depend on the frames read with it.
        """
        terms = len(_ORDERS)
        if not self.solve.size:
            return np.full((len(pressure_kpa), terms + 1), np.nan)
        # one product of matrix and vector per frame: the rounding of a product of all depends on their number
        coefficients = np.matmul(self.solve, pressure_kpa[:, :, None])[:, :, 0]
        # the residual's square by Pythagoras: the residual itself would cost as much as the map
        fitted = np.matmul(self.gram, coefficients[:, :, None])[:, :, 0]
        square = np.einsum("ft,ft->f", pressure_kpa, pressure_kpa) - np.einsum("fi,fi->f", coefficients, fitted)
        residual = np.sqrt(np.maximum(square, 0.0) / self.solve.shape[1])
        rows = np.empty((len(coefficients), terms + 1))
        rows[:, :-1], rows[:, -1] = coefficients, residual
        rows /= level_kpa[:, None]
        return rows


def _legendre(x: FloatArray) -> list[FloatArray]:
    """Legendre polynomials up to `_HIGHEST` by their recurrence: importing those of numpy takes longer than a scan."""
    values = [np.ones_like(x), x]
    for n in range(2, _HIGHEST + 1):
        values.append((values[n - 1] * x * (2 * n - 1) - values[n - 2] * (n - 1)) / n)
    return values


# --- Figures of evenness: change of the head's profile with place and direction of the stroke (record 0103).
#
# Away from lumps the profile depends on the layers below the head (`HEAD_PROFILE`): it changes with the place where
# their depth does, and is skewed along the stroke where the skin is dragged along. An examiner keeps the head square to
# the skin, so its normal turns by the skin's curvature.

SPAN_MM = 30.0  #: Distance over which a change of the profile is stated.
# Standard errors come from leaving out every tenth stretch of this many seconds: neighbouring frames share errors.
_STRETCH_S = 0.5
_GROUPS = 10
_LEAST_SPREAD_MM = 3.0  #: Least motion (SD, mm) in a direction for a change along it.
# Columns of the regression.
_X, _Y, _DIRECTION = 1, 2, 3


def evenness_figures(selections: Sequence[SelectedFrames], plane: Plane) -> dict[str, float]:
    """Figures of the map's evenness; those of the profile with ``_sd``, and missing for few lump-free frames.

    ``skin_curvature_per_m`` is the turn of the head's normal over its motion, rad per m, above 0 on convex skin;
    ``profile_change`` the largest change of `head_profile_x2` over `SPAN_MM`; ``stroke_skew`` half the difference of
    the first-order coefficient between strokes towards +x and -x, missing where all went one way.
    """
    parts = [part for part in selections if part.used.any()]
    motions = [motion(part, plane) for part in parts]
    profiles = [_profiles(part, *motion) for part, motion in zip(parts, motions, strict=True)]
    rows, designs, groups = (np.concatenate(arrays) for arrays in zip(*profiles, strict=True))
    place = np.concatenate([place_mm[:, :2] - place_mm[:, :2].mean(axis=0) for place_mm, _ in motions])
    normal = np.concatenate([axes[:, :2, 2] - axes[:, :2, 2].mean(axis=0) for _, axes in motions])
    figures, moved = {}, float(np.sum(place**2))
    if moved > len(place) * _LEAST_SPREAD_MM**2:  # over the directions in which the head moved, weighted by how far
        figures["skin_curvature_per_m"] = -1000.0 * float(np.sum(place * normal)) / moved
    return figures | _profile_changes(rows, designs, groups)


def motion(part: SelectedFrames, plane: Plane) -> tuple[FloatArray, FloatArray]:
    """(n, 3) places of the head on the plane and (n, 3, 3) directions of its axes at the used frames of a scan."""
    poses, tracker_from_head = part.poses.part(part.used), inverse(part.scan.head.scanhead_from_tracker)
    place = apply(plane.plane_from_base, poses.places_mm(tracker_from_head[:3, 3]))
    axes = np.einsum("ij,njk,kl->nil", plane.plane_from_base[:3, :3], poses.rotation, tracker_from_head[:3, :3])
    return place, axes


def _profiles(
    part: SelectedFrames, place_mm: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """(f, 10) profiles of complete frames, the (f, 7) terms of their regression, and (f,) groups for the jackknife."""
    frames, marks = _marked(part)
    chosen = frames[marks < marks_limit(marks, MOST_FRAMES)]
    among_used = np.searchsorted(np.flatnonzero(part.used), chosen)
    direction, level = directions_along(place_mm[:, 0])[among_used, None], np.log(part.level_kpa[chosen])[:, None]
    place = place_mm[among_used, :2] / SPAN_MM
    design = np.hstack([np.ones_like(direction), place, direction, level, axes[among_used, 2, :2]])
    stretch = np.floor(part.scan.frames.time_s[chosen] / _STRETCH_S).astype(np.int64) % _GROUPS
    return _read(part, chosen), design, stretch


def _profile_changes(rows: FloatArray, design: FloatArray, group: NDArray[np.int64]) -> dict[str, float]:
    """Changes of the profile with place and stroke, by least squares over the lump-free frames."""
    if len(rows) < LEAST_FRAMES:
        return {}
    free = _lump_free(rows)
    if np.count_nonzero(free) < LEAST_FRAMES:
        return {}
    rows, design, group = rows[free], design[free], group[free]
    design = design - design.mean(axis=0) * (np.arange(design.shape[1]) > 0)
    if min(np.std(design[:, _X]), np.std(design[:, _Y])) * SPAN_MM < _LEAST_SPREAD_MM:
        return {}
    columns = [0, *np.flatnonzero(np.std(design, axis=0) > 0).tolist()]
    coefficients, errors = _regression(design[:, columns], rows[:, :-1], group)
    slope, slope_error = (values[[columns.index(_X), columns.index(_Y)], 0] for values in (coefficients, errors))
    change = float(np.hypot(*slope))
    figures = {
        "profile_change": change,
        "profile_change_sd": float(np.sqrt(np.sum((slope * slope_error) ** 2)) / change) if change > 0 else 0.0,
    }
    if _DIRECTION in columns:
        skew = columns.index(_DIRECTION), SKEW
        figures |= {"stroke_skew": float(coefficients[skew]), "stroke_skew_sd": float(errors[skew])}
    return figures


def _regression(design: FloatArray, rows: FloatArray, group: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """(c, k) coefficients of (n, k) rows on an (n, c) design, and their standard errors by a grouped jackknife."""
    normal = np.stack([design[group == g].T @ design[group == g] for g in range(_GROUPS)])
    right = np.stack([design[group == g].T @ rows[group == g] for g in range(_GROUPS)])
    filled = np.flatnonzero(normal[:, 0, 0] > 0)
    coefficients = _least_squares(normal.sum(axis=0), right.sum(axis=0))
    left_out = np.stack([_least_squares(normal.sum(axis=0) - normal[g], right.sum(axis=0) - right[g]) for g in filled])
    error = np.sqrt((len(filled) - 1) / len(filled) * np.sum((left_out - left_out.mean(axis=0)) ** 2, axis=0))
    return coefficients, np.asarray(error)


def _least_squares(normal: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-10)[0])


# --- Tracker position error from frame to frame, estimated from the poses; it blurs the map.
#
# A bump of width sigma is mapped with sigma^2 + s^2, s the SD of a frame's place along that axis. Errors that
# neighbouring poses share cannot be distinguished from the head's motion and are not in the figures.

LEAST_POSES = 50
MOST_MM = 1.5  #: Largest SD that is a tracker's noise: above it the head itself jumps.
KEPT = 0.9  #: Share of the departures that count, the smallest: at turning points the head itself leaves the path.
# A normal distribution's mean square within its inner nine tenths, over its variance: 1 - 2 c phi(c) / 0.9.
_INNER_SQUARE = 0.6230155


def pose_noise_figures(selections: Sequence[SelectedFrames], plane: Plane, *, cell_mm: float) -> dict[str, float]:
    """Figures `POSE_NOISE` of the used frames, by the poses' departures from cubics through their four neighbours.

    Empty where the tracker gave too few poses, or the head jumps.
    """
    scans = [noise for part in selections if (noise := _place_noise(part, plane)) is not None]
    if not scans:
        return {}
    variances, frames, independent = (np.array(values) for values in zip(*scans, strict=True))
    variance = np.average(variances, axis=0, weights=frames)
    if variance.max() > MOST_MM**2:
        return {}
    head = selections[0].scan.head
    sides = [taxels * head.pitch_mm for taxels in head.shape]
    figures = [*np.sqrt(variance), *sides, (head.pitch_mm / cell_mm) ** 2 * independent.sum() / frames.sum()]
    return {name: float(f"{value:.4g}") for name, value in zip(POSE_NOISE, figures, strict=True)}


def _place_noise(part: SelectedFrames, plane: Plane) -> tuple[FloatArray, int, float] | None:
    """(2,) variance of a used frame's place along the plane's axes, mm^2, and numbers of used and of effective frames.

    Frames between two poses share their errors. None where a scan has too few poses.
    """
    frames_s = part.scan.frames.time_s[part.used]
    poses = part.fresh
    if len(poses) < LEAST_POSES or not len(frames_s):
        return None
    lever = inverse(part.scan.head.scanhead_from_tracker)[:3, 3]
    apex = poses.position_mm + rotation_from_quaternion(poses.quaternion_wxyz) @ lever
    departure, weight = _departures(poses.time_s, apply(plane.plane_from_base, apex)[:, :2])
    square = np.sort(departure**2 / weight[:, None], axis=0)
    noise = square[: int(KEPT * len(square))].mean(axis=0) / _INNER_SQUARE
    factor, independent = _interpolation(frames_s, poses.time_s)
    return noise * factor, len(frames_s), independent


def _departures(time_s: FloatArray, place_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n - 4, 2) departures of positions from a cubic through four neighbours, and their variance over a position's."""
    n = len(time_s) - 4
    near = [time_s[k : k + n] - time_s[2 : 2 + n] for k in (0, 1, 3, 4)]
    departure, variance = place_mm[2 : 2 + n].copy(), np.ones(n)
    for i, k in enumerate((0, 1, 3, 4)):
        share = np.ones(n)
        for j, other in enumerate(near):
            if j != i:
                share *= other / (other - near[i])
        departure -= share[:, None] * place_mm[k : k + n]
        variance += share**2
    return departure, variance


def _interpolation(frames_s: FloatArray, poses_s: FloatArray) -> tuple[float, float]:
    """Mean variance of linear interpolation between independent poses at the frames, over a pose's.

    And the number of independent frames of that variance whose mean has the variance of these frames' mean.
    """
    place = np.interp(frames_s, poses_s, np.arange(len(poses_s)))
    before = np.minimum(place.astype(np.int64), len(poses_s) - 2)
    share = place - before
    factor = float(np.mean(share**2 + (1.0 - share) ** 2))
    weight = np.bincount(before, 1.0 - share, len(poses_s)) + np.bincount(before + 1, share, len(poses_s))
    return factor, float(len(frames_s) ** 2 * factor / np.sum(weight**2))
