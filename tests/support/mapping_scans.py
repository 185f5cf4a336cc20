"""Scans with known answers for the tests of mapping: a field on a plane, read without noise by a flat head."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.geometry import apply, quaternion_from_rotation, rigid, rotation_from_quaternion
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

GAIN_KPA = 2.0**-11  # 65536 counts reach 32 kPa: counts carry pressures to 0.0005 kPa
LEVEL_KPA = 8.0
Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def gaussian(*, amplitude: float = 0.5, sigma_x: float = 6.0, sigma_y: float = 6.0, x: float = 0.0, y: float = 0.0):
    """A field of 1 with a bump."""
    return lambda u, v: 1 + amplitude * np.exp(-(((u - x) / sigma_x) ** 2 + ((v - y) / sigma_y) ** 2) / 2)


def uniform(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A field without a lump."""
    return np.ones(np.broadcast(u, v).shape)


def flat_head(*, rows: int = 8, columns: int = 8, pitch_mm: float = 2.0, lever_mm=(0.0, 0.0, 0.0)) -> HeadGeometry:
    """A head whose taxels lie in one plane, centred on its origin."""
    x = (np.arange(rows) - (rows - 1) / 2) * pitch_mm
    y = (np.arange(columns) - (columns - 1) / 2) * pitch_mm
    surface = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((rows, columns))], axis=-1)
    return HeadGeometry(surface, pitch_mm, rigid(np.eye(3), np.array(lever_mm, dtype=float)))


def rotation(yaw_deg: float, *, about=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Rotation by an angle about an axis (Rodrigues)."""
    axis = np.asarray(about, dtype=float) / np.linalg.norm(about)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = np.radians(yaw_deg)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def make_scan(
    centres_mm: np.ndarray,
    *,
    field: Field = uniform,
    head: HeadGeometry | None = None,
    levels_kpa: np.ndarray | float = LEVEL_KPA,
    yaw_deg: np.ndarray | float = 0.0,
    interval_s: float = 0.01,
    landmarks: Landmarks | None = None,
) -> Scan:
    """Read `field` at every taxel while the head's origin visits (n, 2) centres, one frame and one pose each.

    Frames and poses share their times, so interpolation is exact.
    """
    head = head or flat_head()
    n = len(centres_mm)
    turns = {float(yaw): rotation(float(yaw)) for yaw in np.unique(yaw_deg)}
    from_head = np.zeros((n, 4, 4)) + np.eye(4)
    from_head[:, :3, :3] = [turns[float(yaw)] for yaw in np.broadcast_to(yaw_deg, n)]
    from_head[:, :2, 3] = centres_mm
    points = np.stack([apply(one, head.surface_mm) for one in from_head])
    values = field(points[..., 0], points[..., 1])
    pressure = values * np.broadcast_to(levels_kpa, n)[:, None, None]
    tracker = from_head @ head.scanhead_from_tracker
    time = 100.0 + interval_s * np.arange(n)
    return Scan(
        PressureFrames(time, np.rint(pressure / GAIN_KPA).astype(np.uint16)),
        TrackerPoses(
            time,
            tracker[:, :3, 3],
            quaternion_from_rotation(tracker[:, :3, :3]),
        ),
        head,
        ElementCalibration(np.full(head.shape, GAIN_KPA), np.zeros(head.shape), saturation_count=65535),
        landmarks=landmarks,
    )


def even_centres(*, pitch_mm: float = 2.0, points: int = 8) -> np.ndarray:
    """Centres that put points x points readings evenly into each square of the head's pitch."""
    offset = ((np.arange(points) + 0.5) / points - 0.5) * pitch_mm
    return np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)


def strokes(*, reach_mm: float = 15.0, lines: int = 4, spacing_mm: float = 5.0, per_line: int = 30) -> np.ndarray:
    """Strokes side by side, as an examiner makes them."""
    x = np.linspace(-reach_mm, reach_mm, per_line)
    y = (np.arange(lines) - (lines - 1) / 2) * spacing_mm
    return np.concatenate([np.stack([x[:: (-1) ** i], np.full(per_line, v)], axis=1) for i, v in enumerate(y)])


def moved(scan: Scan, transform: np.ndarray) -> Scan:
    """The whole scan, landmarks included, after a rigid motion of the tracker's base."""
    q = quaternion_from_rotation(transform[:3, :3] @ rotation_from_quaternion(scan.poses.quaternion_wxyz))
    poses = TrackerPoses(scan.poses.time_s, apply(transform, scan.poses.position_mm), q)
    marks = scan.landmarks
    if marks is not None:
        marks = Landmarks(apply(transform, marks.sternal_notch_mm), apply(transform, marks.xiphoid_mm))
    return replace(scan, poses=poses, landmarks=marks)


def part(scan: Scan, frames: slice) -> Scan:
    """Some of the frames with all of the poses."""
    return replace(scan, frames=PressureFrames(scan.frames.time_s[frames], scan.frames.counts[frames]))


def with_counts(scan: Scan, counts: np.ndarray) -> Scan:
    """The scan with other readings."""
    return replace(scan, frames=PressureFrames(scan.frames.time_s, counts))


def shared_scan(path) -> Scan:
    """One of the simulated scans in the shared data folder."""
    with np.load(path, allow_pickle=False) as archive:
        held = {name: archive[name] for name in archive.files}
    return Scan(
        PressureFrames(held["frame_time_s"], held["counts"]),
        TrackerPoses(held["pose_time_s"], held["position_mm"], held["quaternion_wxyz"]),
        HeadGeometry(held["head_surface_mm"], float(held["pitch_mm"]), held["array_from_tracker"]),
        ElementCalibration(held["gain_kpa_per_count"], held["offset_kpa"]),
        Landmarks(held["landmarks_mm"][0], held["landmarks_mm"][1]),
    )
