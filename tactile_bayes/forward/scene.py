"""A scene: a body, a lump and an exam to simulate, and the truth of its scan."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.contact import Head as Section
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump, check_solid, fat_thickness
from tactile_bayes.geometry import FloatArray, rigid, rotation_from_quaternion
from tactile_bayes.presets import (
    HEAD_COLUMNS,
    HEAD_PITCH_MM,
    HEAD_RADIUS_MM,
    HEAD_ROWS,
    SHOULDERS_INSIDE,
    SHOULDERS_OUTSIDE,
)

# --- Input of a simulated scan: lumps, strokes, head, noise and tracker, each validated on creation.
#
# Frames: a scene has its own `plane` frame. Its origin is the centre of the strokes, x runs across the head (along
# the strokes), y along the head, z into the tissue. Lumps and landmarks are given in it; with landmarks, the
# `patient` frame follows from them as for a real scan. `data_schema/scene.schema.json` holds the same names,
# defaults and ranges.

Point = tuple[float, float, float]
Taxel = tuple[int, int]

FLAT_MM: Final = 100_000.0
"""Radius that stands for a flat head, the largest of a scene: over 24 mm it rises by 0.7 um."""


@dataclass(frozen=True, slots=True)
class Background:
    """Mean pressure under the head away from lumps, over time.

    Parameters
    ----------
    mean_kpa
        Level once contact is made.
    drift_kpa, drift_period_s
        A sine on top of it.
    ramp_s
        Time to press down at the start; 0 for full contact from the first frame.
    load_sharing
        True: the head bears a given force, so each frame is divided to keep its mean at the level, and the background
        falls beside a lump. False: the background stays where it is.
    """

    mean_kpa: float = 9.5
    drift_kpa: float = 0.5
    drift_period_s: float = 3.0
    ramp_s: float = 0.2
    load_sharing: bool = False


@dataclass(frozen=True, slots=True)
class Lump:
    """A Gaussian rise of the normalised pressure (the paper's Eq 5, elliptical and rotated).

    Parameters
    ----------
    x_mm, y_mm
        Centre in the scene's `plane`.
    amplitude
        Above a background of 1; may be negative.
    sigma_x_mm, sigma_y_mm
        Standard deviations along the lump's own axes.
    angle_deg
        From the plane's x axis to the lump's, positive towards y.
    d_mm
        True diameter, where one is declared. It is kept as truth; nothing is computed from it.
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    amplitude: float = 0.3
    sigma_x_mm: float = 5.0
    sigma_y_mm: float = 5.0
    angle_deg: float = 0.0
    d_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Strokes:
    """Path of the head: back and forth across, line after line along.

    Parameters
    ----------
    lines, spacing_mm, half_length_mm
        Parallel lines, their distance, and how far each reaches either side of the middle.
    wander_mm, tilt_deg
        Amplitudes of the slow departure from the line and of the head's rocking.
    yaw_deg
        By how much the head is turned about the normal, away from square to the strokes.
    """

    lines: int = 5
    spacing_mm: float = 6.0
    half_length_mm: float = 34.0
    wander_mm: float = 0.5
    tilt_deg: float = 2.0
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Head:
    """A section of a circular cylinder, its edges rounded off.

    `shoulder_mm` is the radius of shoulders cut into the array. Where it is 0, `rim_mm` is the radius of the rounded
    edge *around* the taxels, which presses but senses nothing; in two dimensions it is cut into the array unless asked.
    """

    rows: int = HEAD_ROWS
    columns: int = HEAD_COLUMNS
    pitch_mm: float = HEAD_PITCH_MM
    radius_mm: float = HEAD_RADIUS_MM
    shoulder_mm: float = 0.0
    rim_mm: float = 3.0

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
        """Which of `presets.HEADS` this is in three dimensions."""
        return SHOULDERS_INSIDE if self.shoulder_mm > 0 else SHOULDERS_OUTSIDE

    def with_shoulders(self, shoulders: str) -> Head:
        """Copy of the head with its shoulders placed as `shoulders` says, one of `presets.HEADS`."""
        edge = self.section(shoulders).shoulder_mm
        inside = shoulders == SHOULDERS_INSIDE
        return replace(self, shoulder_mm=edge if inside else 0.0, rim_mm=0.0 if inside else edge)

    def section(self, shoulders: str) -> Section:
        """Section across the head, with shoulders of this head's radius placed as `shoulders` says.

        Raises
        ------
        BadDataError
            When `shoulders` is not one of `presets.HEADS`, or the radius does not fit there.
        """
        edge = self.shoulder_mm if self.shoulder_mm > 0 else self.rim_mm
        return Section(self.rows * self.pitch_mm, self.radius_mm, edge, shoulders)


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of all random errors.

    Parameters
    ----------
    element_kpa
        Of each reading.
    tracker_mm, tracker_deg
        Of each pose, per axis.
    gain_spread
        Between the true gains of the taxels; the calibration knows them.
    gain_share
        Error of the calibration, as a share of the true gain.
    """

    element_kpa: float = 0.2
    tracker_mm: float = 0.4
    tracker_deg: float = 0.2
    gain_spread: float = 0.03
    gain_share: float = 0.01


@dataclass(frozen=True, slots=True)
class Tracker:
    """Place of the tracker's base, and the sensor's pose in the handle.

    Parameters
    ----------
    latency_ms
        By how much the stamp of a pose is late.
    base_rotation_deg, base_offset_mm
        `base` from the scene's `plane`: a rotation vector and a shift.
    lever_rotation_deg, lever_offset_mm
        `scanhead` from the tracker's sensor.
    """

    latency_ms: float = 0.0
    base_rotation_deg: Point = (165.0, 25.0, -20.0)
    base_offset_mm: Point = (175.0, -112.0, 133.0)
    lever_rotation_deg: Point = (0.0, 3.0, -90.0)
    lever_offset_mm: Point = (0.0, 10.0, -55.0)

    def base_from_plane(self) -> FloatArray:
        """(4, 4) transform."""
        return _rigid(self.base_rotation_deg, self.base_offset_mm)

    def scanhead_from_tracker(self) -> FloatArray:
        """(4, 4) lever arm."""
        return _rigid(self.lever_rotation_deg, self.lever_offset_mm)


@dataclass(frozen=True, slots=True)
class Taxels:
    """Faulty elements as (row, column): dead ones read 0, saturated ones full scale."""

    dead: tuple[Taxel, ...] = ()
    saturated: tuple[Taxel, ...] = ()


@dataclass(frozen=True, slots=True)
class SceneLandmarks:
    """Landmarks in the scene's `plane`; `touched` false leaves them out of the scan, None the nipple alone."""

    touched: bool = True
    xiphoid_mm: Point = (-60.0, -90.0, 0.0)
    sternal_notch_mm: Point = (-60.0, 90.0, 0.0)
    nipple_mm: Point | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """All input of `simulate` except the random numbers.

    What lies below the skin is given either as Gaussian bumps (`lumps`) or as tissue (`body`, `solid_lumps`, `ribs`).
    """

    seed: int = 1
    duration_s: float = 7.0
    frame_rate_hz: float = 200.0
    pose_rate_hz: float = 120.0
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
        """Check the rules that involve several values; ranges of single values are in `scene.schema.json`."""
        for name in ("duration_s", "frame_rate_hz", "pose_rate_hz"):
            _above_zero(f"scene.{name}", getattr(self, name))
        for i, lump in enumerate(self.lumps):
            for name in ("sigma_x_mm", "sigma_y_mm"):
                _above_zero(f"lump[{i}].{name}", getattr(lump, name))
        for noise in fields(self.noise):
            if not getattr(self.noise, noise.name) >= 0:
                raise BadDataError(f"noise.{noise.name} is {getattr(self.noise, noise.name)}", way_out="give 0 or more")
        self._check_head()
        self._check_level()
        if self.lumps and self.solid_lumps:
            raise BadDataError(
                "some lumps are bumps (amplitude, sigma) and some are tissue (depth_ratio)",
                way_out="describe all lumps of a scene in one way",
            )
        if self.lumps and self.ribs:
            raise BadDataError(
                "lump[0] is a bump and rib[0] is tissue", way_out="give the lump depth_ratio, or leave out the rib"
            )
        check_solid(self.body or SceneBody(), self.solid_lumps, self.ribs)

    @property
    def fidelity(self) -> str:
        """The model the scene is written for: ``"solid"`` when it gives tissue, else ``"empirical-gaussian"``."""
        tissue = self.solid_lumps or self.ribs or (self.body is not None and not self.lumps)
        return "solid" if tissue else "empirical-gaussian"

    @property
    def stiff_balls(self) -> tuple[SolidLump, ...]:
        """The lumps of tissue and the balls of the ribs."""
        return (*self.solid_lumps, *(ball for rib in self.ribs for ball in rib.balls()))

    def _check_head(self) -> None:
        half = self.head.rows * self.head.pitch_mm / 2
        if not self.head.radius_mm > half:
            raise BadDataError(
                f"head.radius_mm is {self.head.radius_mm:g}", way_out=f"it must exceed the half width of {half:g} mm"
            )
        if not 0 <= self.head.shoulder_mm <= half:
            raise BadDataError(
                f"head.shoulder_mm is {self.head.shoulder_mm:g}", way_out=f"it must lie in 0 to {half:g} mm"
            )
        if not 0 <= self.head.rim_mm < self.head.radius_mm:
            raise BadDataError(
                f"head.rim_mm is {self.head.rim_mm:g}",
                way_out=f"it must lie in 0 to below radius_mm, {self.head.radius_mm:g} mm",
            )
        for kind in ("dead", "saturated"):
            for row, column in getattr(self.taxels, kind):
                if not (0 <= row < self.head.rows and 0 <= column < self.head.columns):
                    raise BadDataError(
                        f"taxels.{kind} names [{row}, {column}]",
                        way_out=f"rows are 0 to {self.head.rows - 1}, columns 0 to {self.head.columns - 1}",
                    )

    def _check_level(self) -> None:
        _above_zero("background.mean_kpa", self.background.mean_kpa)
        if abs(self.background.drift_kpa) >= self.background.mean_kpa:
            raise BadDataError(
                f"background.drift_kpa is {self.background.drift_kpa:g}",
                way_out=f"it must stay below mean_kpa, {self.background.mean_kpa:g} kPa",
            )
        touched = self.landmarks.touched
        if touched and np.allclose(self.landmarks.xiphoid_mm, self.landmarks.sternal_notch_mm, atol=1.0):
            raise BadDataError(
                f"landmarks.xiphoid_mm and sternal_notch_mm are both {list(self.landmarks.xiphoid_mm)}",
                way_out="place them apart, or set landmarks.touched = false",
            )


def normalised_pressure(lumps: tuple[Lump, ...], x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    r"""Pressure over its background at points of the scene's `plane`.

    Notes
    -----
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


def _rigid(rotation_deg: Point, offset_mm: Point) -> FloatArray:
    return rigid(rotation_from_vector(np.radians(np.array(rotation_deg))), np.array(offset_mm))


def _above_zero(name: str, value: float) -> None:
    if not value > 0:
        raise BadDataError(f"{name} is {value}", way_out="it must be above 0")


# --- Truth of a simulated scan of tissue.


def tissue_truth(scene: Scene) -> dict[str, Any]:
    """The body and its lumps as plain data; the balls of a rib do not count as lumps."""
    body = scene.body or SceneBody()
    fat = fat_thickness(body, scene.solid_lumps)
    return {
        "lumps": [_lump_truth(lump, body, fat) for lump in scene.solid_lumps],
        "ribs": [asdict(rib) | {"ball_x_mm": [ball.x_mm for ball in rib.balls()]} for rib in scene.ribs],
        "body": asdict(body) | {"fat_mm": fat},
        "background": asdict(scene.background),
    }


def refuse_bumps(scene: Scene, model: str) -> None:
    """Raise BadDataError where a scene gives bumps to a `model` that needs tissue."""
    if scene.lumps:
        raise BadDataError(
            "lump[0] gives no depth_ratio",
            way_out=f"the {model} model needs d_mm and depth_ratio; or use --fidelity empirical-gaussian",
        )


def _lump_truth(lump: SolidLump, body: SceneBody, fat_mm: float) -> dict[str, Any]:
    seat = (fat_mm - lump.depth_mm) / (lump.vertical_mm / 2)
    return asdict(lump) | {
        "height_mm": lump.vertical_mm,
        "seat": seat,
        "depth_mm": lump.depth_mm,
        "lump_kpa": lump.stiffness_ratio * body.fat_kpa,
    }
