"""The simulated instrument: strokes, gains, noise, converter and tracker, for every forward model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, as_dict
from tactile_bayes.forward.scene import Background, Scene, Strokes, rotation_from_vector
from tactile_bayes.geometry import FloatArray, apply, inverse, patient_from_base, quaternion_from_rotation
from tactile_bayes.presets import PRESSURE_RANGE_KPA
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

FULL_SCALE_COUNT: Final = 4095  # 12-bit converter
TRUTH_SCHEMA: Final = "tactile-bayes/truth/1"
# How deep the apex sits below the undisturbed skin; only the offset of the mapping plane shows it.
_INDENTATION_MM: Final = 5.0
# The slow departures from a straight stroke, each with its own rhythm so that they do not repeat together.
_WOBBLE_HZ: Final = {"x": 0.31, "y": 0.43, "z": 0.23, "roll": 0.37, "pitch": 0.29, "yaw": 0.19}
_CHUNK: Final = 512


# Pressures in kPa, (n, rows, columns), that the taxels feel at (n,) times from 0, before any noise.
Felt = Callable[[FloatArray], FloatArray]
# Depth in mm of the head's apex below the undisturbed skin, (n,), at such times.
Depth = Callable[[FloatArray], FloatArray]


class SimulatedScan(Record, eq=False):
    """A simulated scan with its truth."""

    scan: Scan  #: As an instrument would have recorded it.
    truth: Mapping[str, Any]
    """Plain data for JSON: the lumps in the scene's `plane`, in `patient` and in `base`, the transforms, the latency
    and the level."""

    def __repr__(self) -> str:
        return f"<SimulatedScan of {self.scan!r}, with its truth>"


def record(
    scene: Scene, *, felt: Felt, truth: Mapping[str, Any], rng: np.random.Generator, depth: Depth | None = None
) -> SimulatedScan:
    """Simulate the recording of a scan from the pressures on the head, of which `felt` gives up to 512 frames at once,
    in order.

    What lies below the skin of `scene` is not used; `truth` is what the model of the tissue adds to the truth, where
    `lumps` is a list of mappings with `x_mm` and `y_mm`. `rng` is split into independent streams, so that a longer scan
    of the same seed keeps its gains and calibration. Without a `depth` the head wanders about 5 mm.
    """
    gain_rng, element_rng, tracker_rng = rng.spawn(3)
    true_gain, calibration = _calibration(scene, rng=gain_rng)
    scan = Scan(
        frames=_frames(scene, felt, true_gain, rng=element_rng),
        poses=_poses(scene, depth, rng=tracker_rng),
        head=HeadGeometry(scene.head.surface_mm(), scene.head.pitch_mm, scene.tracker.scanhead_from_tracker()),
        element_calibration=calibration,
        landmarks=_landmarks(scene),
        session={"source": "simulated", "side": "phantom", "posture": "phantom"},
    )
    return SimulatedScan(scan, _truth(scene, truth))


def frame_times(scene: Scene) -> FloatArray:
    """(n,) times of the scene's frames, s."""
    return _times(scene.duration_s, scene.frame_rate_hz)


def _times(duration_s: float, rate_hz: float) -> FloatArray:
    """Multiples of a period from 0, rounded to whole nanoseconds as in a scan file."""
    k = np.arange(max(1, int(np.floor(duration_s * rate_hz + 1e-9))))
    return np.asarray(np.rint(k / rate_hz * 1e9) / 1e9, dtype=np.float64)


def head_positions(scene: Scene, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """True pose of the head in the scene's `plane` at times from 0: ``p_plane = rotation @ p_scanhead + origin`` with
    (n, 3, 3) rotations and (n, 3) origins in mm."""
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
    # Yaw stays at half: turning about the normal smears a lump's widths, rocking hardly does.
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


def _frames(scene: Scene, felt: Felt, true_gain: FloatArray, *, rng: np.random.Generator) -> PressureFrames:
    time = frame_times(scene)
    chunks = []
    for start in range(0, len(time), _CHUNK):
        pressure = felt(time[start : start + _CHUNK])
        pressure = pressure + scene.noise.element_kpa * rng.standard_normal(pressure.shape)
        chunks.append(np.clip(np.rint(pressure / true_gain), 0, FULL_SCALE_COUNT).astype(np.uint16))
    counts = np.concatenate(chunks)
    for faulty, reading in ((scene.taxels.dead, 0), (scene.taxels.saturated, FULL_SCALE_COUNT)):
        for row, column in faulty:
            counts[:, row, column] = reading
    return PressureFrames(time, counts)


def _calibration(scene: Scene, *, rng: np.random.Generator) -> tuple[FloatArray, ElementCalibration]:
    """True gains, and the calibration that a bladder would give."""
    shape = (scene.head.rows, scene.head.columns)
    nominal = PRESSURE_RANGE_KPA[1] / FULL_SCALE_COUNT
    # Four standard deviations out, a gain could turn negative at the widest spread allowed.
    spread, error = np.clip(rng.standard_normal((2, *shape)), -4.0, 4.0)
    true_gain = nominal * (1 + scene.noise.gain_spread * spread)
    measured = true_gain * (1 + scene.noise.gain_share * error)
    return true_gain, ElementCalibration(measured, np.zeros(shape), saturation_count=FULL_SCALE_COUNT)


def _poses(scene: Scene, depth: Depth | None, *, rng: np.random.Generator) -> TrackerPoses:
    time = _times(scene.duration_s, scene.pose_rate_hz)
    rotation, origin = head_positions(scene, time)
    if depth is not None:
        origin[:, 2] = depth(time)
    lever, base = scene.tracker.scanhead_from_tracker(), scene.tracker.base_from_plane()
    position = apply(base, origin + rotation @ lever[:3, 3])
    attitude = base[:3, :3] @ rotation @ lever[:3, :3]
    shift, turn = rng.standard_normal((2, len(time), 3))
    position = position + scene.noise.tracker_mm * shift
    attitude = attitude @ rotation_from_vector(np.radians(scene.noise.tracker_deg) * turn)
    quaternion = np.array([quaternion_from_rotation(one) for one in attitude])
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


def _truth(scene: Scene, model: Mapping[str, Any]) -> dict[str, Any]:
    """The truth of a scan as plain data; `model` adds the tissue, beginning with the lumps."""
    base_from_plane = scene.tracker.base_from_plane()
    landmarks = _landmarks(scene)
    patient_from_plane = None
    if landmarks is not None:
        normal = base_from_plane[:3, 2]
        patient = patient_from_base(landmarks.sternal_notch_mm, landmarks.xiphoid_mm, normal=normal)
        patient_from_plane = patient @ base_from_plane
    return {
        "schema": TRUTH_SCHEMA,
        **model,
        "lumps": [_lump_truth(lump, base_from_plane, patient_from_plane) for lump in model["lumps"]],
        "background": as_dict(scene.background),
        "noise": as_dict(scene.noise),
        "latency_ms": scene.tracker.latency_ms,
        "plane_from_base": inverse(base_from_plane).tolist(),
        "patient_from_plane": None if patient_from_plane is None else patient_from_plane.tolist(),
        "dead": [list(taxel) for taxel in scene.taxels.dead],
        "saturated": [list(taxel) for taxel in scene.taxels.saturated],
    }


def _lump_truth(
    given: Mapping[str, Any], base_from_plane: FloatArray, patient_from_plane: FloatArray | None
) -> dict[str, Any]:
    point = np.array([given["x_mm"], given["y_mm"], 0.0])
    patient = None if patient_from_plane is None else apply(patient_from_plane, point).tolist()
    return {**given, "base_mm": apply(base_from_plane, point).tolist(), "patient_mm": patient}
