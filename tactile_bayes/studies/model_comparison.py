"""Forward models compared: the empirical with the elastic one (Tables 1 and 2), and each with measured frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tactile_bayes import presets
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward import plane
from tactile_bayes.forward.scene import HeadSection, Scene
from tactile_bayes.forward.simulate import felt_at_poses
from tactile_bayes.geometry import FloatArray, inverse
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.select import select_frames
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import BumpFit, fit_bump, fitted_candidates
from tactile_bayes.progress import Progress, no_progress
from tactile_bayes.scans import ElementCalibration, PressureFrames, Scan
from tactile_bayes.studies.paper import HARD_RATIO, PAPER_DIAMETERS_MM, MapFit, StudySettings, centre_line, fit_line

# --- Tables 1 and 2 of the paper and the phantoms of its section 2.3: the empirical model against the elastic one.
#
# The paper prints a mean squared difference without its definition. Here it is
#
# .. math:: \mathrm{MSD}(u, v) = \sum_i (u_i - v_i)^2 / \sum_i v_i^2
#
# with v the elastic model; for maps also relative to the pressure that the lump adds, :math:`\sum_i (v_i - 1)^2`.
# The background of 1 dominates the first (decision record 0007), not the second.

TABLE_DIAMETERS_MM = PAPER_DIAMETERS_MM
TABLE_DEPTH_RATIOS = (0.6, 1.8)
PRINTED_FRAMES = {0.6: (4.1, 4.3, 4.1, 4.1, 4.2), 1.8: (4.1, 4.2, 4.2, 4.0, 4.1)}
"""Table 1 in percent, by h/d, over the diameters."""
PRINTED_MAPS = {0.6: (2.4, 2.7, 2.5, 2.3, 2.2), 1.8: (2.3, 2.5, 2.4, 2.5, 2.6)}  #: Table 2 in percent.
DEFINITION = (
    "MSD = sum of squared differences over the sum of squares of the elastic model; the paper does not define its own. "
    "Strict: the same over the sum of squares of (map - 1), what the lump adds."
)
OTHER_DEFINITIONS: dict[str, Callable[[FloatArray, FloatArray], float]] = {
    "root of the same": lambda u, v: float(np.sqrt(np.sum((u - v) ** 2) / np.sum(v**2))),
    "mean square over the largest's": lambda u, v: float(np.mean((u - v) ** 2) / v.max() ** 2),
    "root mean square over the largest": lambda u, v: float(np.sqrt(np.mean((u - v) ** 2)) / v.max()),
    "mean absolute over the mean": lambda u, v: float(np.mean(np.abs(u - v)) / np.mean(v)),
    "over the squares about the mean": lambda u, v: float(np.sum((u - v) ** 2) / np.sum((v - v.mean()) ** 2)),
}
"""Other meanings of a mean squared difference: tried because the printed tables are not met."""
PHANTOMS = {
    "phantom 12.5 mm": (12.5, 0.825),
    "phantom 15.5 mm": (15.5, 1.0),
    "phantom 15.5 mm deep": (15.5, 1.4),
    "phantom 18.75 mm": (18.75, 1.2),
}
"""The silicone models of section 2.3: diameter in mm and h/d, with a rigid lump."""
TRIED_HEADS = tuple(
    HeadSection(radius_mm=radius, shoulder_mm=shoulder, shoulders=kind)
    for radius in (13.0, 16.0, 20.0, 25.0, 35.0, 70.0)
    for kind, shoulder in (
        (presets.SHOULDERS_INSIDE, 3.0),
        (presets.SHOULDERS_OUTSIDE, 3.0),
        (presets.SHOULDERS_OUTSIDE, 15.0),
    )
    if shoulder < radius
)
"""Heads that the tables are computed for with ``tables --heads``."""
NEAREST_HEADS = {
    0.0: HeadSection(radius_mm=13.0, shoulder_mm=3.0, shoulders=presets.SHOULDERS_INSIDE),
    1.0: HeadSection(radius_mm=70.0, shoulder_mm=3.0, shoulders=presets.SHOULDERS_OUTSIDE),
}
"""By seat: of `TRIED_HEADS` the one whose tables lie nearest to the printed ones (`table_distance`; record 0096)."""


class TableScene(Record):
    """A lump for which both models are compared."""

    name: str  #: Name in messages.
    d_mm: float
    depth_ratio: float
    seat: float  #: These as in `tissue.Body`.
    stiffness_ratio: float = HARD_RATIO  #: E2/E1.


class Agreement(Record):
    """Differences of the empirical model from the elastic one, as shares, not percent."""

    scene: TableScene  #: The lump compared.
    centred_frame: float
    all_frames: float
    map: float
    map_strict: float
    """`centred_frame`, `all_frames`, `map`, `map_strict`: Mean squared differences: of the frame centred on the lump
    (Table 1), of all frames of the map, of the map within the fit's radius (Table 2), and of the map relative to map -
    1."""
    elastic: MapFit
    empirical: MapFit
    """`elastic`, `empirical`: Eq 5 fitted to both maps."""
    normalised_frame: float  #: As `centred_frame`, of frames divided by their means.
    others: tuple[tuple[float, float, float], ...]
    """Differences by each of `OTHER_DEFINITIONS`: of the frame centred on the lump, of that frame divided by its mean,
    and of the map."""


def table_scenes(seat: float) -> list[TableScene]:
    """The ten cases of Tables 1 and 2, row by row."""
    return [TableScene(f"d {d:g} mm, h/d {h:g}", d, h, seat) for h in TABLE_DEPTH_RATIOS for d in TABLE_DIAMETERS_MM]


def phantom_scenes(seat: float) -> list[TableScene]:
    """The four phantoms of section 2.3."""
    return [TableScene(name, d, h, seat) for name, (d, h) in PHANTOMS.items()]


def scene_frames(
    scene: TableScene, settings: StudySettings, *, surface: plane.SurfaceCompliance | None = None
) -> tuple[plane.LineFrames, plane.LineFrames]:
    """Frames of the elastic and the empirical model at the same positions; the latter is fitted to the taxels' frames
    far from the lump and over it.

    `surface` is the scene's body condensed onto its skin, by default computed here.
    """
    if surface is None:
        surface = settings.surface(settings.body(scene.d_mm, scene.depth_ratio, seat=scene.seat))
    elastic = settings.frames(surface, scene.stiffness_ratio)
    model = settings.empirical(scene.d_mm, surface.body.layers, elastic)
    return elastic, model.frames(elastic.x_c_mm, elastic.s_mm)


def compare(scene: TableScene, *, settings: StudySettings, surface: plane.SurfaceCompliance | None = None) -> Agreement:
    """Compare both models of one scene; `surface` as in `scene_frames`."""
    elastic, empirical = scene_frames(scene, settings, surface=surface)
    elastic_map, empirical_map = plane.build_line(elastic), plane.build_line(empirical)
    inside = np.abs(elastic_map.x_mm) <= settings.fit_radius_mm
    ours, theirs = empirical_map.mean[inside], elastic_map.mean[inside]
    empirical_taxels, elastic_taxels = (one.as_taxels(presets.HEAD_PITCH_MM) for one in (empirical, elastic))
    frames = empirical_taxels.at(0.0), elastic_taxels.at(0.0)
    shares = frames[0] / frames[0].mean(), frames[1] / frames[1].mean()
    return Agreement(
        scene,
        mean_squared_difference(*frames),
        mean_squared_difference(empirical_taxels.pressure_kpa, elastic_taxels.pressure_kpa),
        mean_squared_difference(ours, theirs),
        float(np.sum((ours - theirs) ** 2) / np.sum((theirs - 1.0) ** 2)),
        fit_line(elastic_map, settings.fit_radius_mm),
        fit_line(empirical_map, settings.fit_radius_mm),
        mean_squared_difference(*shares),
        tuple((by(*frames), by(*shares), by(ours, theirs)) for by in OTHER_DEFINITIONS.values()),
    )


def compare_heads(scene: TableScene, *, settings: StudySettings, heads: Sequence[HeadSection]) -> list[Agreement]:
    """Compare both models of one scene under each of several heads; the body is condensed once."""
    widest = max(heads, key=lambda head: head.half_face_mm)
    body = settings.body(scene.d_mm, scene.depth_ratio, seat=scene.seat)
    surface = replace(settings, head=widest).surface(body)
    return [compare(scene, settings=replace(settings, head=head), surface=surface) for head in heads]


def table_distance(agreements: Sequence[Agreement]) -> float:
    """Root mean square difference from the printed cells of Tables 1 and 2, in percentage points."""
    gaps = []
    for agreement in agreements:
        column = TABLE_DIAMETERS_MM.index(agreement.scene.d_mm)
        gaps.append(100 * agreement.centred_frame - PRINTED_FRAMES[agreement.scene.depth_ratio][column])
        gaps.append(100 * agreement.map - PRINTED_MAPS[agreement.scene.depth_ratio][column])
    return float(np.sqrt(np.mean(np.square(gaps))))


def mean_squared_difference(values: FloatArray, reference: FloatArray) -> float:
    """Sum of squared differences over the reference's sum of squares."""
    return float(np.sum((values - reference) ** 2) / np.sum(reference**2))


# --- Frames measured along a head's centre line beside both models of the same lump (Fig 6a of the paper).

LEAST_TAXELS = 4


class MeasuredFrame(Record, eq=False):
    """One frame along the centre line of the head."""

    x_c_mm: float  #: Position of the head's centre from the lump's axis.
    s_mm: FloatArray  #: (n,) array: Positions of the taxels from the head's centre.
    pressure_kpa: FloatArray  #: (n,) array: Pressures of the taxels.

    def __post_init__(self) -> None:
        if len(self.s_mm) < LEAST_TAXELS or not self.pressure_kpa.mean() > 0:
            raise BadDataError(
                f"the frame at x_c_mm {self.x_c_mm:g} has {len(self.s_mm)} taxels with a mean of "
                f"{self.pressure_kpa.mean():.3g} kPa",
                way_out=f"give at least {LEAST_TAXELS} taxels, some of them above 0 kPa",
            )


class FrameAgreement(Record, eq=False):
    """A measured frame and both models at its position and mean pressure."""

    measured: MeasuredFrame
    elastic_kpa: FloatArray
    empirical_kpa: FloatArray
    """`elastic_kpa`, `empirical_kpa` (n,) arrays: The models at the same taxels."""

    @property
    def differences(self) -> tuple[float, float]:
        """Mean squared differences from the elastic and the empirical model, as shares of their sums of squares."""
        models = self.elastic_kpa, self.empirical_kpa
        elastic, empirical = (mean_squared_difference(self.measured.pressure_kpa, one) for one in models)
        return elastic, empirical


def compare_frames(
    frames: Sequence[MeasuredFrame], d_mm: float, depth_ratio: float, *, seat: float, settings: StudySettings
) -> list[FrameAgreement]:
    """Compare both models of a hard lump with measured frames, at their positions and mean pressures.

    The empirical model is fitted at the settings' mean pressure and scaled to the frame's. `BadDataError` for a taxel
    outside the head, or a head beyond the study's positions.
    """
    half, most = settings.head.half_width_mm, max(abs(end) for end in settings.positions_mm[:2])
    for frame in frames:
        if np.abs(frame.s_mm).max() > half or abs(frame.x_c_mm) > most:
            raise BadDataError(
                f"the frame at x_c_mm {frame.x_c_mm:g} has a taxel at s_mm {np.abs(frame.s_mm).max():g}",
                way_out=f"s_mm must lie within {half:g} mm and x_c_mm within {most:g} mm",
            )
    surface = settings.surface(settings.body(d_mm, depth_ratio, seat=seat))
    head, nominal = settings.head, settings.mean_kpa
    model = settings.empirical(d_mm, surface.body.layers, settings.over(surface))
    places = np.array([frame.x_c_mm for frame in frames])
    means = np.array([frame.pressure_kpa.mean() for frame in frames])
    solved = plane.press(surface, HARD_RATIO, places, head=head, mean_kpa=means).as_taxels(presets.HEAD_PITCH_MM)
    agreements = []
    for frame, elastic, mean in zip(frames, solved.pressure_kpa, means, strict=True):
        empirical = mean / nominal * model.surface_pressure(frame.s_mm, np.full(len(frame.s_mm), frame.x_c_mm))
        agreements.append(FrameAgreement(frame, np.interp(frame.s_mm, solved.s_mm, elastic), empirical))
    return agreements


# --- A scan against a forward model of a scene: the same poses and mean pressures, frame by frame and as maps.
#
# Section 2.3 of the paper compares rubber models with its forward models in this way: frames within 15 %, maps within
# 2.6 %. Mean squared differences are defined as above (docs/decisions/0007).

NEAR_MM = 40.0  #: Maps are compared within this distance of the lump.
# A model's readings are stored as whole numbers, in counts per kPa: up to the 34 kPa at which a taxel saturates.
_COUNTS_PER_KPA = 1900.0


class MeasuredScan(Record, eq=False):
    """The frames of a scan that are compared."""

    scan: Scan  #: The scan with these frames only.
    pressure_kpa: FloatArray  #: (n, rows, columns) array: NaN for taxels that are left out.
    rotation: FloatArray
    origin_mm: FloatArray
    """`rotation`, `origin_mm` (n, 3, 3), (n, 3) arrays: Poses of the head in the map's plane."""
    level_kpa: FloatArray  #: (n,) array: Mean over the valid taxels.
    tactile_map: TactileMap  #: Map of these frames.
    place_mm: tuple[float, float]  #: Position of the lump on the map; the scene's first lump is put there.
    lump: BumpFit | None  #: The bump of Eq 7 there; None where none was fitted.

    @property
    def figures(self) -> dict[str, float]:
        """The bumps on the map, see `_bumps`."""
        return _bumps(self, self.tactile_map, self.lump)


class ModelComparison(Record, eq=False):
    """Difference of one model from the measured frames and map."""

    fidelity: str  #: Which of `forward.simulate.FIDELITIES`.
    pressure_kpa: FloatArray  #: (n, rows, columns) array: The model's frames.
    tactile_map: TactileMap  #: Of the model's frames, on the cells of the measured map.
    figures: Mapping[str, float]  #: See `compare_model`.


def measured_frames(
    scan: Scan,
    *,
    every: int = 1,
    cell_mm: float = presets.CELL_MM,
    pressure_window_kpa: tuple[float, float] = presets.PRESSURE_WINDOW_KPA,
    latency_ms: float = 0.0,
    place_mm: tuple[float, float] | None = None,
) -> MeasuredScan:
    """Every n-th of the frames that a map uses, their poses in its plane, and the position of the lump.

    Settings are as in `mapping.build.build_map`. Without `place_mm` the lump is the highest bump that can be one.
    """
    selected = select_frames(scan, pressure_window_kpa=pressure_window_kpa, latency_ms=latency_ms)
    used = np.flatnonzero(selected.used)[::every]
    part = replace(scan, frames=PressureFrames(scan.frames.time_s[used], scan.frames.counts[used]))
    tactile_map = build_map(
        part, cell_mm=cell_mm, pressure_window_kpa=pressure_window_kpa, latency_ms=latency_ms, normalise="mean"
    )
    assert tactile_map.plane_from_base is not None
    tracker_from_head, plane_rotation = inverse(scan.head.scanhead_from_tracker), tactile_map.plane_from_base[:3, :3]
    on_base = selected.poses.rotation[used]
    origin = selected.poses.position_mm[used] + on_base @ tracker_from_head[:3, 3]
    origin = origin @ plane_rotation.T + tactile_map.plane_from_base[:3, 3]
    rotation = plane_rotation @ on_base @ tracker_from_head[:3, :3]
    pressure = scan.element_calibration.to_kpa(scan.frames.counts[used])
    pressure[:, ~selected.good_taxels] = np.nan
    lump = _bump(tactile_map, place_mm)
    if place_mm is None:
        if lump is None:
            raise BadDataError("no lump is found on the scan's map", way_out="say where it is: --at X Y")
        place_mm = float(lump.theta[1]), float(lump.theta[2])
    return MeasuredScan(part, pressure, rotation, origin, selected.level_kpa[used], tactile_map, place_mm, lump)


@np.errstate(divide="ignore")  # without a lump the model's map is 1 everywhere, and `map_strict` infinite
def compare_model(
    measured: MeasuredScan, scene: Scene, *, fidelity: str, head: str | None = None, progress: Progress = no_progress
) -> ModelComparison:
    """Compare measured frames with one model of a scene, whose first lump is put where the measured one is.

    Figures are differences as shares of the model's sum of squares. ``frames_...``: the mean over the frames, of all
    taxels, along the head's centre line, and along it in frames within 12 mm of the lump. ``map_...``: of the map
    within 40 mm of the lump, along its centre line across the lump, and relative to map - 1. Besides these the root
    mean square difference of a taxel (``rms_kpa``), the bumps on the model's map, and the residual map's slope.
    """
    _check_array(measured.scan, scene)
    lump = scene.solid_lumps[0] if scene.solid_lumps else scene.lumps[0] if scene.lumps else None
    lump_mm = measured.place_mm if lump is None else (lump.x_mm, lump.y_mm)
    origin = measured.origin_mm.copy()
    origin[:, :2] += np.subtract(lump_mm, measured.place_mm)
    pressure = felt_at_poses(
        scene, measured.rotation, origin, mean_kpa=measured.level_kpa, fidelity=fidelity, head=head, progress=progress
    )
    model_map = _model_map(measured, pressure)
    model_taxels, taxels = pressure.reshape(len(pressure), -1), measured.pressure_kpa.reshape(len(pressure), -1)
    model_line, measured_line = centre_line(pressure), centre_line(measured.pressure_kpa)
    near = np.hypot(*(measured.origin_mm[:, :2] - measured.place_mm).T) <= 12.0
    frames = _shares(measured_line, model_line)
    cells = _map_cells(measured, model_map)
    ours, theirs = measured.tactile_map.mean[cells], model_map.mean[cells]
    row = cells & _centre_row(measured)[:, None]
    figures = {
        "frames_all": np.mean(_shares(taxels, model_taxels)),
        "frames_centre": np.mean(frames),
        "frames_near": np.mean(frames[near]) if near.any() else np.nan,
        "map_all": mean_squared_difference(ours, theirs),
        "map_centre": mean_squared_difference(measured.tactile_map.mean[row], model_map.mean[row]),
        "map_strict": np.sum((ours - theirs) ** 2) / np.sum((theirs - 1.0) ** 2),
        "rms_kpa": np.sqrt(np.nanmean((taxels - model_taxels) ** 2)),
        **_bumps(measured, model_map, _bump(model_map, measured.place_mm)),
        **residual_slope(measured, model_map),
    }
    return ModelComparison(fidelity, pressure, model_map, {name: float(value) for name, value in figures.items()})


def _bumps(measured: MeasuredScan, tactile_map: TactileMap, lump: BumpFit | None) -> dict[str, float]:
    """Parameters of Eq 7 on a map, NaN where no bump was fitted, and of Eq 5 on its centre line."""
    theta, widths = ((np.nan,), (np.nan,) * 3) if lump is None else (lump.theta, lump.widths())
    figures = dict(zip(("amplitude", "sigma_x_mm", "sigma_y_mm"), (float(theta[0]), *widths[:2]), strict=True))
    return figures | dict(zip(("line_amplitude", "line_sigma_mm"), line_bump(measured, tactile_map), strict=True))


def centre_row(measured: MeasuredScan, tactile_map: TactileMap) -> tuple[FloatArray, FloatArray]:
    """Distances from the lump (k,) and the map there (k,), along the rows of cells within 1.5 mm of its centre."""
    rows = tactile_map.mean[_centre_row(measured)]
    read = np.isfinite(rows).any(axis=0)
    return tactile_map.x_mm[read] - measured.place_mm[0], np.asarray(np.nanmean(rows[:, read], axis=0))


def line_bump(measured: MeasuredScan, tactile_map: TactileMap) -> tuple[float, float]:
    """Amplitude and sigma (mm) of Eq 5, level 1, on the map's centre line within `FIT_RADIUS_MM` of the lump."""
    x, mean = centre_row(measured, tactile_map)
    near = np.abs(x) <= presets.FIT_RADIUS_MM
    widths_mm = 0.5 * tactile_map.recipe.cell_mm, presets.FIT_RADIUS_MM
    return plane.fit_lump_pressure(x[near], mean[near] - 1.0, widths_mm=widths_mm)


def residual_slope(measured: MeasuredScan, model_map: TactileMap) -> dict[str, float]:
    """Slope along x and y of the measured map less the model's, and the root mean square residual beside it.

    A slope is a tilt of the real head against the modelled one: the map's plane is not quite that of the skin.
    """
    cells = _map_cells(measured, model_map)
    y, x = np.nonzero(cells)
    design = np.stack([np.ones(len(x)), model_map.x_mm[x] / 10.0, model_map.y_mm[y] / 10.0], axis=1)
    residual = (measured.tactile_map.mean - model_map.mean)[cells]
    coefficients = np.linalg.lstsq(design, residual, rcond=None)[0]
    rms = float(np.sqrt(np.mean((residual - design @ coefficients) ** 2)))
    return {
        "slope_x_per_10mm": float(coefficients[1]),
        "slope_y_per_10mm": float(coefficients[2]),
        "rms_beside_slope": rms,
    }


def _model_map(measured: MeasuredScan, pressure_kpa: FloatArray) -> TactileMap:
    """Build the map of the model's frames as that of the measured ones, without the same taxels."""
    counts = np.clip(np.rint(pressure_kpa * _COUNTS_PER_KPA), 0, np.iinfo(np.uint16).max - 1).astype(np.uint16)
    bad = np.isnan(measured.pressure_kpa).all(axis=0)
    gain = np.where(bad, 0.0, 1.0 / _COUNTS_PER_KPA)
    gains = ElementCalibration(gain, np.zeros_like(gain), saturation_count=np.iinfo(np.uint16).max)
    scan = replace(measured.scan, frames=PressureFrames(measured.scan.frames.time_s, counts), element_calibration=gains)
    recipe = measured.tactile_map.recipe
    low, high = recipe.pressure_window_kpa or presets.PRESSURE_WINDOW_KPA
    # No frame may fall out at the window's ends: Eqs 1 to 4 keep the mean that they are given to a fifth only.
    return build_map(
        scan,
        cell_mm=recipe.cell_mm,
        pressure_window_kpa=(0.5 * low, 2.0 * high),
        latency_ms=recipe.latency_ms,
        normalise="mean",
        as_stated=True,
    )


def _map_cells(measured: MeasuredScan, model_map: TactileMap) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(ny, nx) cells within `NEAR_MM` of the lump that both maps cover."""
    measured_map = measured.tactile_map
    if measured_map.mean.shape != model_map.mean.shape or not np.allclose(measured_map.x_mm, model_map.x_mm):
        raise BadDataError(
            f"the maps have {measured_map.mean.shape} and {model_map.mean.shape} cells",
            way_out="some frames of the model are bad",
        )
    x, y = measured_map.x_mm - measured.place_mm[0], measured_map.y_mm - measured.place_mm[1]
    return np.asarray(measured_map.covered & model_map.covered & (np.hypot(x, y[:, None]) <= NEAR_MM))


def _centre_row(measured: MeasuredScan) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    cell = measured.tactile_map.recipe.cell_mm
    return np.asarray(np.abs(measured.tactile_map.y_mm - measured.place_mm[1]) <= max(1.5, 0.51 * cell))


def _shares(measured: FloatArray, model: FloatArray) -> FloatArray:
    """(n,) difference of each frame as a share of the model's sum of squares, over the taxels that are valid."""
    valid = np.isfinite(measured)
    gap = np.where(valid, measured - model, 0.0)
    return np.asarray((gap**2).sum(axis=1) / (np.where(valid, model, 0.0) ** 2).sum(axis=1))


def _bump(tactile_map: TactileMap, place_mm: tuple[float, float] | None) -> BumpFit | None:
    """Eq 7 with a background of 1: at a place, or at the highest bump that can be a lump."""
    options = SamplerSettings()
    if place_mm is not None:
        return fit_bump(tactile_map, place_mm, options=options)[0]
    lumps = (one.fit for one in fitted_candidates(tactile_map, options) if one.fit is not None and not one.fault)
    return next(lumps, None)


def _check_array(scan: Scan, scene: Scene) -> None:
    scan_head, scene_head = scan.head, scene.head
    scan_shape, scene_shape = scan_head.shape, (scene_head.rows, scene_head.columns)
    if scan_shape != scene_shape or abs(scan_head.pitch_mm - scene_head.pitch_mm) > 1e-6:
        raise BadDataError(
            f"the scene's head has {scene_shape[0]} x {scene_shape[1]} taxels {scene_head.pitch_mm:g} mm apart, "
            f"the scan's {scan_shape[0]} x {scan_shape[1]} taxels {scan_head.pitch_mm:g} mm apart",
            way_out="give the scan's head in [head] of the scene",
        )
