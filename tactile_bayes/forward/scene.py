"""Scene of a simulation (body, lumps, exam), and the simulated instrument that records it with its truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final

import numpy as np

from tactile_bayes import presets
from tactile_bayes.declarations import Meta, Record, as_dict, check_record, described, field, replace
from tactile_bayes.errors import BadDataError, require
from tactile_bayes.forward.tissue import Diameter, Layers, Place, Rib, SceneBody, SolidLump, check_solid, fat_thickness
from tactile_bayes.geometry import (
    BoolArray,
    FloatArray,
    apply,
    inverse,
    patient_from_base,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
)
from tactile_bayes.presets import HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS, HEADS, SHOULDER_MM, SHOULDERS_INSIDE
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

# --- The head's cross-section.


class HeadSection(Record):
    """The head's cross-section: an arc with rounded shoulders.

    The paper has "nearly a section of a circular cylinder" of 24 mm (section 2.1); radius and shoulders are assumed
    (record 0075).
    """

    width_mm: float = HEAD_ROWS * HEAD_PITCH_MM  #: Width of the sensing part.
    radius_mm: float = HEAD_RADIUS_MM  #: Radius of the arc; infinity for a flat head.
    shoulder_mm: float = SHOULDER_MM  #: Radius of the round between arc and side, tangent to both; 0 for a sharp edge.
    shoulders: str = SHOULDERS_INSIDE
    """``"shoulders-inside"``: the rounds are cut into the sensing width, which is the whole face.
    ``"shoulders-outside"``: the arc spans the sensing width, and the rounds lie around it, press and sense nothing."""

    def __post_init__(self) -> None:
        require(0 < self.width_mm < np.inf, "width_mm of the head", self.width_mm, "be above 0, in mm")
        half = f"{self.half_width_mm:g} mm, half the head's width"
        require(self.radius_mm > self.half_width_mm, "radius_mm of the head", self.radius_mm, f"be above {half}")
        if self.shoulders not in HEADS:
            what = f"shoulders of the head is {self.shoulders!r}"
            raise BadDataError(what, way_out=f"it must be {' or '.join(HEADS)}")
        shoulder, name = self.shoulder_mm, "shoulder_mm of the head"
        fits = self.shoulders != SHOULDERS_INSIDE or 0 <= shoulder <= self.half_width_mm
        require(fits, name, shoulder, f"be between 0 and {half}")
        rule = f"be between 0 and below radius_mm, {self.radius_mm:g} mm"
        require(0 <= shoulder < self.radius_mm, name, shoulder, rule)

    @property
    def half_width_mm(self) -> float:
        """Half of the sensing width: w of Eq 1."""
        return 0.5 * self.width_mm

    @property
    def half_face_mm(self) -> float:
        """Half the width of the rigid face: the sensing width, plus the shoulders where they lie outside it."""
        if self.shoulders == SHOULDERS_INSIDE:
            return self.half_width_mm
        return self.half_width_mm + self.shoulder_mm * (1 - self.half_width_mm / self.radius_mm)

    def profile_mm(self, s_mm: FloatArray) -> FloatArray:
        """Height of the head's face above its lowest point, at distances `s_mm` from its centre within the face."""
        s = np.abs(np.asarray(s_mm, dtype=np.float64))
        r, inner = self.shoulder_mm, self.half_face_mm - self.shoulder_mm
        if np.isinf(self.radius_mm):
            return np.where(s <= inner, 0.0, r - _circle(r, s - inner))
        big = self.radius_mm
        centre = float(_circle(big - r, np.array(inner)))
        tangent = inner * big / (big - r)
        return np.where(s <= tangent, big - _circle(big, s), big - centre - _circle(r, s - inner))

    def cell_profile_mm(self, cell_mm: float) -> FloatArray:
        """(n,) profile averaged over the cells of width `cell_mm` of the face, from left to right.

        Cells around the sensing width belong to the face when their centres lie on a shoulder.
        """
        points, weights = np.polynomial.legendre.leggauss(6)
        count = len(self.sensing_cells(cell_mm))
        centres = cell_mm * (np.arange(count) - 0.5 * (count - 1))
        return np.asarray(self.profile_mm(centres[:, None] + 0.5 * cell_mm * points) @ (0.5 * weights))

    def sensing_cells(self, cell_mm: float) -> BoolArray:
        """(n,) mask of the cells of the face, from left to right, that sense pressure; the others only press."""
        count = round(self.width_mm / cell_mm)
        fits = count >= 2 and abs(count * cell_mm - self.width_mm) <= 1e-9 * self.width_mm
        require(fits, "cell_mm", cell_mm, f"divide the head's width of {self.width_mm:g} mm")
        around = max(0, int(np.ceil((self.half_face_mm - self.half_width_mm) / cell_mm - 0.5 - 1e-9)))
        return np.pad(np.ones(count, dtype=bool), around)


def _circle(radius: float, x: FloatArray) -> FloatArray:
    """Height of a circle about 0 at `x`; 0 beyond it."""
    return np.sqrt(np.maximum(radius**2 - np.asarray(x) ** 2, 0.0))


# --- Input of a simulated scan: lumps, strokes, head, noise and tracker, each validated on creation.
#
# Frames: a scene has its own `plane` frame. Its origin is the centre of the strokes, x runs across the head (along
# the strokes), y along the head, z into the tissue. Lumps and landmarks are given in it; with landmarks, the
# `patient` frame follows from them as for a real scan.

Degrees = Annotated[float, Meta(ge=-360, le=360)]
Rotation = tuple[Degrees, Degrees, Degrees]  #: Rotation vector.
Coordinate = Annotated[float, Meta(ge=-2000, le=2000)]
Point = tuple[Coordinate, Coordinate, Coordinate]
LeverMm = Annotated[float, Meta(ge=-1000, le=1000)]
BaseMm = Annotated[float, Meta(ge=-100_000, le=100_000)]
TaxelIndex = Annotated[int, Meta(ge=0, le=255)]
Taxel = tuple[TaxelIndex, TaxelIndex]

FLAT_MM: Final = 100_000.0
"""Radius that stands for a flat head, the largest of a scene: over 24 mm it rises by 0.7 um."""


class Background(Record):
    """Mean pressure under the head away from lumps, over time."""

    mean_kpa: Annotated[float, Meta(gt=0, le=34)] = 9.5  #: Level once contact is made, kPa.
    drift_kpa: Annotated[float, Meta(ge=0, le=34)] = 0.5  #: Amplitude of a sine on top of it, kPa; below mean_kpa.
    drift_period_s: Annotated[float, Meta(gt=0, le=600)] = 3.0  #: Its period, s.
    ramp_s: Annotated[float, Meta(ge=0, le=60)] = 0.2  #: Time to press down at the start, s.
    load_sharing: bool = False
    """true: constant force, each frame keeps its mean and the background falls beside a lump."""


class Lump(Record):
    """A Gaussian rise of the normalised pressure (the paper's Eq 5, elliptical and rotated)."""

    x_mm: Place = 0.0
    y_mm: Place = 0.0
    amplitude: Annotated[float, Meta(ge=-1, le=20)] = 0.3  #: Height above a background of 1.
    sigma_x_mm: Annotated[float, Meta(ge=0.1, le=200)] = 5.0  #: Standard deviation along the lump's first axis, mm.
    sigma_y_mm: Annotated[float, Meta(ge=0.1, le=200)] = 5.0  #: Standard deviation along its second axis, mm.
    angle_deg: Annotated[float, Meta(ge=-360, le=360)] = 0.0
    """From the plane's x axis to the lump's first axis, positive towards y, degrees."""
    d_mm: Diameter | None = None


class Strokes(Record):
    """Path of the head: back and forth across, line after line along."""

    lines: Annotated[int, Meta(ge=1, le=200)] = 5  #: Parallel lines.
    spacing_mm: Annotated[float, Meta(ge=0, le=100)] = 6.0  #: Distance between lines, mm.
    half_length_mm: Annotated[float, Meta(ge=0, le=500)] = 34.0  #: Reach of each line either side of the middle, mm.
    wander_mm: Annotated[float, Meta(ge=0, le=50)] = 0.5  #: Amplitude of the slow departure from the line, mm.
    tilt_deg: Annotated[float, Meta(ge=0, le=30)] = 2.0  #: Amplitude of the head's rocking, degrees.
    yaw_deg: Annotated[float, Meta(ge=-90, le=90)] = 0.0
    """Turn of the head about the normal, away from square to the strokes, degrees."""


Rows = Annotated[int, described("Taxels across the head.", ge=1, le=256)]
Columns = Annotated[int, described("Taxels along the head.", ge=1, le=256)]
Pitch = Annotated[float, described("Distance between neighbouring taxels, mm.", gt=0, lt=100)]


class Head(Record):
    """A section of a circular cylinder, its edges rounded off."""

    rows: Rows = presets.HEAD_ROWS
    columns: Columns = presets.HEAD_COLUMNS
    pitch_mm: Pitch = presets.HEAD_PITCH_MM
    radius_mm: Annotated[float, Meta(gt=0, le=100_000)] = presets.HEAD_RADIUS_MM
    """Radius of the face, mm; above half the width."""
    shoulder_mm: Annotated[float, Meta(ge=0, le=100)] = 0.0  #: Radius of its rounded edges, mm; 0 for none.
    rim_mm: Annotated[float, Meta(ge=0, le=100)] = 3.0
    """Radius of the rounded edge around the taxels, mm, which presses but feels nothing (solid model); in two
    dimensions the edge lies within the array, unless simulate --head shoulders-outside.
    """

    def surface_mm(self) -> FloatArray:
        """(rows, columns, 3) taxel centres in `scanhead`: origin at the apex, z into the tissue, so z <= 0."""
        x = np.asarray((np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_mm, dtype=np.float64)
        y = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch_mm
        z = np.sqrt(self.radius_mm**2 - x**2) - self.radius_mm
        if self.shoulder_mm > 0:
            into = np.clip(np.abs(x) - (self.rows * self.pitch_mm / 2 - self.shoulder_mm), 0.0, None)
            z = z + np.sqrt(self.shoulder_mm**2 - into**2) - self.shoulder_mm
        xx, yy = np.meshgrid(x, y, indexing="ij")
        return np.stack([xx, yy, np.broadcast_to(z[:, None], xx.shape)], axis=-1)

    @property
    def shoulders(self) -> str:
        """One of `presets.HEADS`: place of the shoulders in three dimensions."""
        return presets.SHOULDERS_INSIDE if self.shoulder_mm > 0 else presets.SHOULDERS_OUTSIDE

    def with_shoulders(self, shoulders: str) -> Head:
        """Copy of the head with its shoulders placed by one of `presets.HEADS`."""
        edge = self.section(shoulders).shoulder_mm
        inside = shoulders == presets.SHOULDERS_INSIDE
        return replace(self, shoulder_mm=edge if inside else 0.0, rim_mm=0.0 if inside else edge)

    def section(self, shoulders: str) -> HeadSection:
        """Section across the head, with shoulders of this head's radius placed by one of `presets.HEADS`."""
        edge = self.shoulder_mm if self.shoulder_mm > 0 else self.rim_mm
        return HeadSection(self.rows * self.pitch_mm, self.radius_mm, edge, shoulders)


class Noise(Record):
    """Standard deviations of all random errors."""

    element_kpa: Annotated[float, Meta(ge=0, le=34)] = 0.2  #: Of each reading, kPa.
    tracker_mm: Annotated[float, Meta(ge=0, le=50)] = 0.4  #: Of each position, per axis, mm.
    tracker_deg: Annotated[float, Meta(ge=0, le=30)] = 0.2  #: Of each rotation, per axis, degrees.
    gain_spread: Annotated[float, Meta(ge=0, le=0.2)] = 0.03
    """Between the true gains of the taxels, as a share; the calibration knows it."""
    gain_share: Annotated[float, Meta(ge=0, le=0.2)] = 0.01  #: Error of the calibration, as a share of the gain.


class Tracker(Record):
    """Place of the tracker's base, and the sensor's pose in the handle; rotations are vectors."""

    latency_ms: Annotated[float, Meta(ge=0, le=1000)] = 0.0  #: By how much a pose's stamp is late, ms.
    base_rotation_deg: Rotation = (165.0, 25.0, -20.0)  #: Rotation vector of base from plane, degrees.
    base_offset_mm: tuple[BaseMm, BaseMm, BaseMm] = (175.0, -112.0, 133.0)  #: The plane's origin in base, mm.
    lever_rotation_deg: Rotation = (0.0, 3.0, -90.0)  #: Rotation vector of scanhead from tracker, degrees.
    lever_offset_mm: tuple[LeverMm, LeverMm, LeverMm] = (0.0, 10.0, -55.0)  #: The tracker's sensor in scanhead, mm.

    def base_from_plane(self) -> FloatArray:
        """(4, 4) transform."""
        return _rigid(self.base_rotation_deg, self.base_offset_mm)

    def scanhead_from_tracker(self) -> FloatArray:
        """(4, 4) lever arm."""
        return _rigid(self.lever_rotation_deg, self.lever_offset_mm)


class Taxels(Record):
    """Faulty elements as (row, column): dead ones read 0, saturated ones full scale."""

    dead: tuple[Taxel, ...] = ()  #: Read 0 throughout.
    saturated: tuple[Taxel, ...] = ()  #: Read full scale throughout.


class SceneLandmarks(Record):
    """Landmarks in the scene's `plane`."""

    touched: bool = True  #: false leaves them out of the scan.
    xiphoid_mm: Point = (-60.0, -90.0, 0.0)  #: Xiphoid, mm.
    sternal_notch_mm: Point = (-60.0, 90.0, 0.0)  #: Sternal notch, mm.
    nipple_mm: Point | None = None  #: Nipple, mm; left out where it is not touched.


class Timing(Record):
    """Length and rates of a scan."""

    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1  #: Seed of the random numbers; --seed replaces it.
    duration_s: Annotated[float, Meta(gt=0, le=600)] = 7.0  #: Duration of the scan, s.
    frame_rate_hz: Annotated[float, Meta(gt=0, le=2000)] = 200.0  #: Pressure frames per second.
    pose_rate_hz: Annotated[float, Meta(gt=0, le=2000)] = 120.0  #: Tracker poses per second.


class Scene(Timing):
    """All input of `simulate` except the random numbers.

    What lies below the skin is given either as Gaussian bumps (`lumps`) or as tissue (`body`, `solid_lumps`, `ribs`).
    """

    background: Background = field(default_factory=Background)
    lumps: tuple[Lump, ...] = ()
    body: SceneBody | None = None
    solid_lumps: tuple[SolidLump, ...] = ()
    ribs: tuple[Rib, ...] = ()
    strokes: Strokes = field(default_factory=Strokes)
    head: Head = field(default_factory=Head)
    noise: Noise = field(default_factory=Noise)
    tracker: Tracker = field(default_factory=Tracker)
    taxels: Taxels = field(default_factory=Taxels)
    landmarks: SceneLandmarks = field(default_factory=SceneLandmarks)

    def __post_init__(self) -> None:
        """Check each part by its declaration, then the rules that involve several."""
        check_record(Timing(self.seed, self.duration_s, self.frame_rate_hz, self.pose_rate_hz), "scene")
        for name in ("background", "strokes", "head", "noise", "tracker", "taxels", "landmarks"):
            check_record(getattr(self, name), name)
        for i, lump in enumerate(self.lumps):
            check_record(lump, f"lump[{i}]")
        self._check_head()
        self._check_level()
        if self.lumps and self.solid_lumps:
            raise BadDataError(
                "some lumps are bumps (amplitude, sigma) and some are tissue (depth_ratio)",
                way_out="describe all lumps of a scene in one way",
            )
        if self.lumps and self.ribs:
            way_out = "give the lump depth_ratio, or leave out the rib"
            raise BadDataError("lump[0] is a bump and rib[0] is tissue", way_out=way_out)
        check_solid(self.body or SceneBody(), self.solid_lumps, self.ribs)

    @property
    def fidelity(self) -> str:
        """The model the scene is written for: ``"solid"`` when it gives tissue, else ``"empirical-gaussian"``."""
        tissue = self.solid_lumps or self.ribs or (self.body is not None and not self.lumps)
        return "solid" if tissue else "empirical-gaussian"

    @property
    def layers(self) -> Layers:
        """The body without lumps."""
        body = self.body or SceneBody()
        fat_mm = fat_thickness(body, self.solid_lumps)
        return Layers(fat_mm, body.thickness_mm, body.fat_kpa, body.gland_ratio, body.nu)

    def _check_head(self) -> None:
        head, half = self.head, self.head.rows * self.head.pitch_mm / 2
        require(head.radius_mm > half, "head.radius_mm", head.radius_mm, f"exceed the half width of {half:g} mm")
        require(head.shoulder_mm <= half, "head.shoulder_mm", head.shoulder_mm, f"lie in 0 to {half:g} mm")
        rule = f"lie in 0 to below radius_mm, {head.radius_mm:g} mm"
        require(head.rim_mm < head.radius_mm, "head.rim_mm", head.rim_mm, rule)
        for kind in ("dead", "saturated"):
            for row, column in getattr(self.taxels, kind):
                if not (row < head.rows and column < head.columns):
                    raise BadDataError(
                        f"taxels.{kind} names [{row}, {column}]",
                        way_out=f"rows are 0 to {head.rows - 1}, columns 0 to {head.columns - 1}",
                    )

    def _check_level(self) -> None:
        drift, mean = self.background.drift_kpa, self.background.mean_kpa
        require(drift < mean, "background.drift_kpa", drift, f"stay below mean_kpa, {mean:g} kPa")
        touched = self.landmarks.touched
        if touched and np.allclose(self.landmarks.xiphoid_mm, self.landmarks.sternal_notch_mm, atol=1.0):
            raise BadDataError(
                f"landmarks.xiphoid_mm and sternal_notch_mm are both {list(self.landmarks.xiphoid_mm)}",
                way_out="place them apart, or set landmarks.touched = false",
            )


def normalised_pressure(lumps: tuple[Lump, ...], x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    r"""Pressure over its background at points of the scene's `plane`.

    .. math:: p = 1 + \sum_k a_k \exp\left(-\tfrac12 \delta_k^T \Sigma_k^{-1} \delta_k\right)

    Wellman & Howe (1999) Eq 7, rotated, with a background of 1.
    """
    pressure = np.ones(np.broadcast_shapes(x_mm.shape, y_mm.shape))
    for lump in lumps:
        angle = np.radians(lump.angle_deg)
        dx, dy = x_mm - lump.x_mm, y_mm - lump.y_mm
        u = (np.cos(angle) * dx + np.sin(angle) * dy) / lump.sigma_x_mm
        v = (np.cos(angle) * dy - np.sin(angle) * dx) / lump.sigma_y_mm
        pressure += lump.amplitude * np.exp(-0.5 * (u * u + v * v))
    return pressure


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """(..., 3, 3) rotations about (..., 3) vectors by their length, in rad."""
    half = np.linalg.norm(vector_rad, axis=-1, keepdims=True) / 2
    # sinc, so that no rotation at all needs no special case
    quaternion = np.concatenate([np.cos(half), vector_rad / 2 * np.sinc(half / np.pi)], axis=-1)
    return rotation_from_quaternion(quaternion)


def _rigid(rotation_deg: Rotation, offset_mm: tuple[float, float, float]) -> FloatArray:
    return rigid(rotation_from_vector(np.radians(np.array(rotation_deg))), np.array(offset_mm))


# --- Truth of a simulated scan of tissue.


def tissue_truth(scene: Scene) -> dict[str, Any]:
    """Body and lumps as plain data; the balls of a rib are no lumps."""
    body, fat = scene.body or SceneBody(), scene.layers.fat_mm
    return {
        "lumps": [
            as_dict(lump)
            | {
                "height_mm": lump.vertical_mm,
                "seat": (fat - lump.depth_mm) / (lump.vertical_mm / 2),
                "depth_mm": lump.depth_mm,
                "lump_kpa": lump.stiffness_ratio * body.fat_kpa,
            }
            for lump in scene.solid_lumps
        ],
        "ribs": [as_dict(rib) | {"ball_x_mm": [ball.x_mm for ball in rib.balls()]} for rib in scene.ribs],
        "body": as_dict(body) | {"fat_mm": fat},
        "background": as_dict(scene.background),
    }


# --- The simulated instrument: strokes, gains, noise, converter and tracker, for every forward model.

FULL_SCALE_COUNT: Final = 4095  # 12-bit converter
TRUTH_SCHEMA: Final = "tactile-bayes/truth/1"
# How deep the apex sits below the undisturbed skin; only the offset of the mapping plane shows it.
_INDENTATION_MM: Final = 5.0
# The slow departures from a straight stroke, each with its own rhythm so that they do not repeat together.
_WOBBLE_HZ: Final = {"x": 0.31, "y": 0.43, "z": 0.23, "roll": 0.37, "pitch": 0.29, "yaw": 0.19}
_CHUNK: Final = 512


# (n, rows, columns) pressures in kPa, without noise, at (n,) times from 0.
PressureAt = Callable[[FloatArray], FloatArray]
# (n,) depths in mm of the head's apex below the undisturbed skin at such times.
DepthAt = Callable[[FloatArray], FloatArray]


class SimulatedScan(Record, eq=False):
    """A simulated scan with its truth."""

    scan: Scan  #: As an instrument would have recorded it.
    truth: Mapping[str, Any]
    """Plain data for JSON: the lumps in the scene's `plane`, in `patient` and in `base`, the transforms, the latency
    and the level."""

    def __repr__(self) -> str:
        return f"<SimulatedScan of {self.scan!r}, with its truth>"


def record(
    scene: Scene,
    *,
    pressure: PressureAt,
    truth: Mapping[str, Any],
    rng: np.random.Generator,
    depth: DepthAt | None = None,
) -> SimulatedScan:
    """Simulate the recording of a scan from the pressures on the head, up to 512 frames at a time, in order.

    The scene's tissue is not used. `truth` is the tissue's part of the truth, with `lumps` a list of mappings with
    `x_mm` and `y_mm`. Without a `depth` the head wanders about 5 mm.
    """
    gain_rng, element_rng, tracker_rng = rng.spawn(3)
    true_gain, calibration = _calibration(scene, rng=gain_rng)
    scan = Scan(
        frames=_frames(scene, pressure, true_gain, rng=element_rng),
        poses=_poses(scene, depth, rng=tracker_rng),
        head=HeadGeometry(scene.head.surface_mm(), scene.head.pitch_mm, scene.tracker.scanhead_from_tracker()),
        element_calibration=calibration,
        landmarks=_landmarks(scene),
        session={"source": "simulated", "side": "phantom", "posture": "phantom"},
    )
    return SimulatedScan(scan, _complete_truth(scene, truth))


def frame_times(scene: Scene) -> FloatArray:
    """(n,) times of the scene's frames, s."""
    return _times(scene.duration_s, scene.frame_rate_hz)


def _times(duration_s: float, rate_hz: float) -> FloatArray:
    """Multiples of a period from 0, rounded to whole nanoseconds as in a scan file."""
    k = np.arange(max(1, int(np.floor(duration_s * rate_hz + 1e-9))))
    return np.asarray(np.rint(k / rate_hz * 1e9) / 1e9, dtype=np.float64)


def head_poses(scene: Scene, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) rotations and (n, 3) origins, mm, of the head at times from 0.

    ``p_plane = rotation @ p_scanhead + origin``.
    """
    x, y = _stroke(scene.strokes, time_s / scene.duration_s)
    phase = {name: 2 * np.pi * hz * time_s for name, hz in _WOBBLE_HZ.items()}
    wander, tilt = scene.strokes.wander_mm, np.radians(scene.strokes.tilt_deg)
    origin = np.stack(
        [
            x + wander * np.sin(phase["x"]),
            y + wander * np.sin(phase["y"] + 1.0),
            _INDENTATION_MM + 0.5 * wander * np.sin(phase["z"] + 2.0),
        ],
        axis=-1,
    )
    # half the yaw: turning about the normal smears a lump's widths, rocking hardly does
    turn = np.stack([np.sin(phase["roll"]), np.sin(phase["pitch"] + 0.5), 0.5 * np.sin(phase["yaw"] + 1.5)], axis=-1)
    yaw = rotation_from_vector(np.array([0.0, 0.0, np.radians(scene.strokes.yaw_deg)]))
    return yaw @ rotation_from_vector(tilt * turn), origin


def _stroke(strokes: Strokes, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position (x, y) in mm after a share 0 to 1 of the scan: constant speed on lines, rounded turns between them."""
    u = np.clip(share, 0.0, 1.0) * strokes.lines
    soft = 0.97  # 1 would be a triangle wave with a jolt at each turn
    x = strokes.half_length_mm * np.arcsin(soft * np.sin(np.pi * (u - 0.5))) / np.arcsin(soft)
    line = np.clip(np.floor(u + 0.1), 0, strokes.lines - 1)  # steps over within a tenth of a line either side of a turn
    step = np.clip((u + 0.1 - line) / 0.2, 0.0, 1.0)
    eased = np.where(line > 0, step * step * (3 - 2 * step), 1.0)
    y = (line - 1 + eased - (strokes.lines - 1) / 2) * strokes.spacing_mm
    return x, y


def level_kpa(background: Background, time_s: FloatArray) -> FloatArray:
    """(n,) background pressure in kPa at times from 0."""
    level = background.mean_kpa + background.drift_kpa * np.sin(2 * np.pi * time_s / background.drift_period_s)
    ramp = np.clip(time_s / background.ramp_s, 0.0, 1.0) if background.ramp_s > 0 else 1.0
    return np.asarray(level * ramp, dtype=np.float64)


def _frames(scene: Scene, pressure: PressureAt, true_gain: FloatArray, *, rng: np.random.Generator) -> PressureFrames:
    time = frame_times(scene)
    chunks = []
    for start in range(0, len(time), _CHUNK):
        exact = pressure(time[start : start + _CHUNK])
        noisy = exact + scene.noise.element_kpa * rng.standard_normal(exact.shape)
        chunks.append(np.clip(np.rint(noisy / true_gain), 0, FULL_SCALE_COUNT).astype(np.uint16))
    counts = np.concatenate(chunks)
    for faulty, reading in ((scene.taxels.dead, 0), (scene.taxels.saturated, FULL_SCALE_COUNT)):
        for row, column in faulty:
            counts[:, row, column] = reading
    return PressureFrames(time, counts)


def _calibration(scene: Scene, *, rng: np.random.Generator) -> tuple[FloatArray, ElementCalibration]:
    """True gains, and the calibration that a bladder would give."""
    shape = (scene.head.rows, scene.head.columns)
    nominal = presets.PRESSURE_RANGE_KPA[1] / FULL_SCALE_COUNT
    # beyond four standard deviations a gain could be negative at the widest spread allowed
    spread, error = np.clip(rng.standard_normal((2, *shape)), -4.0, 4.0)
    true_gain = nominal * (1 + scene.noise.gain_spread * spread)
    measured = true_gain * (1 + scene.noise.gain_share * error)
    return true_gain, ElementCalibration(measured, np.zeros(shape), saturation_count=FULL_SCALE_COUNT)


def _poses(scene: Scene, depth: DepthAt | None, *, rng: np.random.Generator) -> TrackerPoses:
    time = _times(scene.duration_s, scene.pose_rate_hz)
    rotation, origin = head_poses(scene, time)
    if depth is not None:
        origin[:, 2] = depth(time)
    lever, base = scene.tracker.scanhead_from_tracker(), scene.tracker.base_from_plane()
    position = apply(base, origin + rotation @ lever[:3, 3])
    attitude = base[:3, :3] @ rotation @ lever[:3, :3]
    shift, turn = rng.standard_normal((2, len(time), 3))
    position = position + scene.noise.tracker_mm * shift
    attitude = attitude @ rotation_from_vector(np.radians(scene.noise.tracker_deg) * turn)
    quaternion = quaternion_from_rotation(attitude)
    late = np.rint((time + scene.tracker.latency_ms / 1000) * 1e9) / 1e9
    return TrackerPoses(late, position, quaternion)


def _landmarks(scene: Scene) -> Landmarks | None:
    if not scene.landmarks.touched:
        return None
    base, nipple = scene.tracker.base_from_plane(), scene.landmarks.nipple_mm
    return Landmarks(
        sternal_notch_mm=apply(base, np.array(scene.landmarks.sternal_notch_mm)),
        xiphoid_mm=apply(base, np.array(scene.landmarks.xiphoid_mm)),
        nipple_mm=None if nipple is None else apply(base, np.array(nipple)),
    )


def _complete_truth(scene: Scene, tissue: Mapping[str, Any]) -> dict[str, Any]:
    """Truth of a scan as plain data, with the `tissue`'s part of it."""
    base_from_plane = scene.tracker.base_from_plane()
    landmarks = _landmarks(scene)
    patient_from_plane = None
    if landmarks is not None:
        normal = base_from_plane[:3, 2]
        patient = patient_from_base(landmarks.sternal_notch_mm, landmarks.xiphoid_mm, normal=normal)
        patient_from_plane = patient @ base_from_plane

    def placed(lump: Mapping[str, Any]) -> dict[str, Any]:
        point = np.array([lump["x_mm"], lump["y_mm"], 0.0])
        patient = None if patient_from_plane is None else apply(patient_from_plane, point).tolist()
        return {**lump, "base_mm": apply(base_from_plane, point).tolist(), "patient_mm": patient}

    return {
        "schema": TRUTH_SCHEMA,
        **tissue,
        "lumps": [placed(lump) for lump in tissue["lumps"]],
        "background": as_dict(scene.background),
        "noise": as_dict(scene.noise),
        "latency_ms": scene.tracker.latency_ms,
        "plane_from_base": inverse(base_from_plane).tolist(),
        "patient_from_plane": None if patient_from_plane is None else patient_from_plane.tolist(),
        "dead": [list(taxel) for taxel in scene.taxels.dead],
        "saturated": [list(taxel) for taxel in scene.taxels.saturated],
    }
