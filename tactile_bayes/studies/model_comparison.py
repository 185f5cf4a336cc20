"""A scan against a forward model of a scene: the same poses and mean pressures, frame by frame and as maps.

Section 2.3 of the paper compares rubber models with its forward models so: frames within 15 %, maps within 2.6 %. It
does not define its mean squared difference; here it is the sum of squared differences over the sum of squares of the
model (docs/decisions/0007).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.plane import fit_shape, lump_pressure
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import felt_at_poses
from tactile_bayes.geometry import FloatArray, inverse
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.select import SelectedFrames, select_frames
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import BumpFit, fit_bump, fitted_candidates
from tactile_bayes.presets import CELL_MM, FIT_RADIUS_MM, PRESSURE_WINDOW_KPA
from tactile_bayes.scans import ElementCalibration, PressureFrames, Scan
from tactile_bayes.studies.paper_tables import mean_squared_difference

Progress = Callable[[int, int], None]
NEAR_MM = 40.0  #: Maps are compared within this distance of the lump.
# Readings of a model travel as whole numbers, this many a kPa: up to the 34 kPa at which a taxel saturates.
_COUNTS_PER_KPA = 1900.0


class MeasuredFrames(Record, eq=False):
    """The frames of a scan that are compared."""

    scan: Scan  #: These frames alone, at one pose a frame as before.
    pressure_kpa: FloatArray  #: (n, rows, columns) array: NaN for taxels that are left out.
    rotation: FloatArray
    origin_mm: FloatArray
    """`rotation`, `origin_mm` (n, 3, 3), (n, 3) arrays: Of the head in the map's plane."""
    level_kpa: FloatArray  #: (n,) array: Mean over the valid taxels.
    tactile_map: TactileMap  #: Of these frames.
    place_mm: tuple[float, float]  #: The lump on the map: where the scene's first lump is put.
    lump: BumpFit | None  #: The bump of Eq 7 there; None where none was fitted.


class ModelComparison(Record, eq=False):
    """How far one model is from the measured frames and map; differences as shares of the model's sum of squares."""

    fidelity: str  #: Which of `forward.simulate.FIDELITIES`.
    pressure_kpa: FloatArray  #: (n, rows, columns) array: The model's frames.
    tactile_map: TactileMap  #: Of the model's frames, on the cells of the measured map.
    frames_all: float
    frames_centre: float
    frames_near: float
    """`frames_all`, `frames_centre`, `frames_near`: Mean over the frames of each frame's difference: of all taxels;
    along the head's centre line; and the latter in frames whose centre lies within 12 mm of the lump."""
    rms_kpa: float  #: Root mean square difference of a taxel.
    map_all: float
    map_centre: float
    map_strict: float
    """`map_all`, `map_centre`, `map_strict`: Of the map within 40 mm of the lump, of its centre line across the lump,
    and of the map relative to map - 1."""
    lump: BumpFit | None  #: The bump of Eq 7 on the model's map; None where none was fitted.


def measured_frames(
    scan: Scan,
    *,
    every: int = 1,
    cell_mm: float = CELL_MM,
    pressure_window_kpa: tuple[float, float] = PRESSURE_WINDOW_KPA,
    latency_ms: float = 0.0,
    place_mm: tuple[float, float] | None = None,
) -> MeasuredFrames:
    """Every n-th frame of a scan that a map takes, their poses in its plane, and the place of the lump.

    Settings are as in `mapping.build.build_map`; without a place it is the highest bump that can be a lump.
    """
    selected = select_frames(scan, pressure_window_kpa=pressure_window_kpa, latency_ms=latency_ms)
    used = np.flatnonzero(selected.used)[::every]
    part = replace(scan, frames=PressureFrames(scan.frames.time_s[used], scan.frames.counts[used]))
    made = build_map(
        part, cell_mm=cell_mm, pressure_window_kpa=pressure_window_kpa, latency_ms=latency_ms, normalise="mean"
    )
    assert made.plane_from_base is not None
    rotation, origin = _poses_in_plane(selected, used, made.plane_from_base)
    pressure = scan.element_calibration.to_kpa(scan.frames.counts[used])
    pressure[:, ~selected.good_taxels] = np.nan
    lump = _bump(made, place_mm)
    if place_mm is None:
        if lump is None:
            raise BadDataError("no lump is found on the scan's map", way_out="say where it is: --at X Y")
        place_mm = float(lump.theta[1]), float(lump.theta[2])
    return MeasuredFrames(part, pressure, rotation, origin, selected.level_kpa[used], made, place_mm, lump)


def compare_model(
    measured: MeasuredFrames, scene: Scene, *, fidelity: str, head: str | None = None, progress: Progress | None = None
) -> ModelComparison:
    """One model of a scene, with its first lump put where the measured one is, against measured frames."""
    _check_array(measured.scan, scene)
    lump = scene.solid_lumps[0] if scene.solid_lumps else scene.lumps[0] if scene.lumps else None
    at = measured.place_mm if lump is None else (lump.x_mm, lump.y_mm)
    origin = measured.origin_mm.copy()
    origin[:, :2] += np.subtract(at, measured.place_mm)
    pressure = felt_at_poses(
        scene, measured.rotation, origin, mean_kpa=measured.level_kpa, fidelity=fidelity, head=head, progress=progress
    )
    made = _model_map(measured, pressure)
    model, seen = pressure.reshape(len(pressure), -1), measured.pressure_kpa.reshape(len(pressure), -1)
    line, line_seen = centre_line(pressure), centre_line(measured.pressure_kpa)
    near = np.hypot(*(measured.origin_mm[:, :2] - measured.place_mm).T) <= 12.0
    frames = _shares(line_seen, line)
    cells = _map_cells(measured, made)
    ours, theirs = measured.tactile_map.mean[cells], made.mean[cells]
    row = cells & _centre_row(measured)[:, None]
    return ModelComparison(
        fidelity,
        pressure,
        made,
        float(np.mean(_shares(seen, model))),
        float(np.mean(frames)),
        float(np.mean(frames[near])) if near.any() else float("nan"),
        float(np.sqrt(np.nanmean((seen - model) ** 2))),
        mean_squared_difference(ours, theirs),
        mean_squared_difference(measured.tactile_map.mean[row], made.mean[row]),
        float(np.sum((ours - theirs) ** 2) / np.sum((theirs - 1.0) ** 2)),
        _bump(made, measured.place_mm),
    )


def centre_line(pressure_kpa: FloatArray) -> FloatArray:
    """(n, rows) pressure across the head along its centre line: the mean of the two middle columns."""
    middle = pressure_kpa.shape[2] // 2
    return np.asarray(pressure_kpa[:, :, middle - 1 : middle + 1].mean(axis=2))


def centre_row(measured: MeasuredFrames, tactile_map: TactileMap) -> tuple[FloatArray, FloatArray]:
    """Places from the lump (k,) and the map there (k,), along the rows of cells within 1.5 mm of its centre."""
    rows = tactile_map.mean[_centre_row(measured)]
    read = np.isfinite(rows).any(axis=0)
    return tactile_map.x_mm[read] - measured.place_mm[0], np.asarray(np.nanmean(rows[:, read], axis=0))


def line_bump(measured: MeasuredFrames, tactile_map: TactileMap) -> tuple[float, float]:
    """Amplitude and sigma (mm) of Eq 5, level 1, on the map's centre line within `FIT_RADIUS_MM` of the lump."""
    x, mean = centre_row(measured, tactile_map)
    near = np.abs(x) <= FIT_RADIUS_MM

    def bump(log_width: float) -> FloatArray:
        return lump_pressure(x[near], height_kpa=1.0, width_mm=float(np.exp(log_width)))

    ends = np.log([0.5 * tactile_map.recipe.cell_mm, FIT_RADIUS_MM])
    found = fit_shape(bump, mean[near] - 1.0, grid=np.linspace(ends[0], ends[1], 60))
    return found.height, float(np.exp(found.parameter))


def residual_map(measured: MeasuredFrames, comparison: ModelComparison) -> FloatArray:
    """(ny, nx) measured less modelled map; NaN where either has no readings."""
    return np.asarray(measured.tactile_map.mean - comparison.tactile_map.mean)


def residual_slope(measured: MeasuredFrames, comparison: ModelComparison) -> tuple[float, float, float]:
    """Slope of the residual map along x and y, per 10 mm, and the root mean square that it leaves.

    A slope is a tilt of the real head against the modelled one: the map's plane is not quite that of the skin.
    """
    made = measured.tactile_map
    cells = _map_cells(measured, comparison.tactile_map)
    y, x = np.nonzero(cells)
    design = np.stack([np.ones(len(x)), made.x_mm[x] / 10.0, made.y_mm[y] / 10.0], axis=1)
    residual = residual_map(measured, comparison)[cells]
    found = np.linalg.lstsq(design, residual, rcond=None)[0]
    return float(found[1]), float(found[2]), float(np.sqrt(np.mean((residual - design @ found) ** 2)))


def _poses_in_plane(
    selected: SelectedFrames, used: NDArray[np.intp], plane_from_base: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) and origins (n, 3) of the head's face in the plane."""
    tracker_from_head = inverse(selected.scan.head.scanhead_from_tracker)
    rotation = selected.poses.rotation[used]
    origin = selected.poses.position_mm[used] + rotation @ tracker_from_head[:3, 3]
    turn = plane_from_base[:3, :3]
    return turn @ rotation @ tracker_from_head[:3, :3], origin @ turn.T + plane_from_base[:3, 3]


def _model_map(measured: MeasuredFrames, pressure_kpa: FloatArray) -> TactileMap:
    """The map of the model's frames by the road of the measured ones; taxels left out there are left out here."""
    counts = np.clip(np.rint(pressure_kpa * _COUNTS_PER_KPA), 0, np.iinfo(np.uint16).max - 1).astype(np.uint16)
    bad = np.isnan(measured.pressure_kpa).all(axis=0)
    gain = np.where(bad, 0.0, 1.0 / _COUNTS_PER_KPA)
    gains = ElementCalibration(gain, np.zeros_like(gain), saturation_count=np.iinfo(np.uint16).max)
    scan = replace(measured.scan, frames=PressureFrames(measured.scan.frames.time_s, counts), element_calibration=gains)
    recipe = measured.tactile_map.recipe
    low, high = recipe.pressure_window_kpa or PRESSURE_WINDOW_KPA
    # The model's level is the measured one's to rounding: no frame may fall out at the window's ends.
    return build_map(
        scan,
        cell_mm=recipe.cell_mm,
        pressure_window_kpa=(0.99 * low, 1.01 * high),
        latency_ms=recipe.latency_ms,
        normalise="mean",
        as_stated=True,
    )


def _map_cells(measured: MeasuredFrames, made: TactileMap) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(ny, nx) cells within `NEAR_MM` of the lump that both maps cover."""
    mine = measured.tactile_map
    if mine.mean.shape != made.mean.shape or not np.allclose(mine.x_mm, made.x_mm):
        raise BadDataError(
            f"the maps have {mine.mean.shape} and {made.mean.shape} cells", way_out="some frames of the model are bad"
        )
    far = np.hypot(mine.x_mm[None, :] - measured.place_mm[0], mine.y_mm[:, None] - measured.place_mm[1])
    return np.asarray(mine.covered & made.covered & (far <= NEAR_MM))


def _centre_row(measured: MeasuredFrames) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    cell = measured.tactile_map.recipe.cell_mm
    return np.asarray(np.abs(measured.tactile_map.y_mm - measured.place_mm[1]) <= max(1.5, 0.51 * cell))


def _shares(seen: FloatArray, model: FloatArray) -> FloatArray:
    """(n,) difference of each frame as a share of the model's sum of squares, over the taxels that are valid."""
    valid = np.isfinite(seen)
    gap = np.where(valid, seen - model, 0.0)
    return np.asarray((gap**2).sum(axis=1) / (np.where(valid, model, 0.0) ** 2).sum(axis=1))


def _bump(made: TactileMap, place_mm: tuple[float, float] | None) -> BumpFit | None:
    """Eq 7 with a background of 1: at a place, or at the highest bump that can be a lump."""
    options = SamplerSettings()
    if place_mm is not None:
        return fit_bump(made, place_mm, options=options)[0]
    return next((one.fit for one in fitted_candidates(made, options) if one.fit is not None and not one.fault), None)


def _check_array(scan: Scan, scene: Scene) -> None:
    wanted, given = scan.head.shape, (scene.head.rows, scene.head.columns)
    if wanted != given or abs(scan.head.pitch_mm - scene.head.pitch_mm) > 1e-6:
        raise BadDataError(
            f"the scene's head has {given[0]} x {given[1]} taxels {scene.head.pitch_mm:g} mm apart, the scan's "
            f"{wanted[0]} x {wanted[1]} taxels {scan.head.pitch_mm:g} mm apart",
            way_out="give the scan's head in [head] of the scene",
        )
