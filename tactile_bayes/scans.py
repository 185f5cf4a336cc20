"""A scan as it was recorded: the head's shape, frames and poses with their clocks."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Meta, Record, field, set_fields
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray, check_rigid
from tactile_bayes.presets import HEAD_COLUMNS, HEAD_PITCH_MM, HEAD_RADIUS_MM, HEAD_ROWS, PRESSURE_RANGE_KPA

# --- Shape of a head's sensing face in a few numbers, by which a size calibration is matched to maps.

FLAT_RADIUS_MM: Final = 10_000.0  #: An arc of this radius or more counts as flat: over 40 mm it rises by 0.02 mm.
# Largest departures of a head from a calibration's; docs/decisions/0101 has their effect on sizes.
PITCH_SHARE: Final = 0.03
SIDE_SHARE: Final = 0.08
RISE_MM: Final = 0.3
UNEVEN_MM: Final = 0.1

Count = Annotated[int, Meta(ge=1)]


class HeadShape(Record):
    """Grid and curvature of a scan head's taxels."""

    rows: Count  #: Taxels across the head.
    columns: Count  #: Taxels along the head.
    pitch_mm: Annotated[float, Meta(gt=0)]  #: Distance between neighbours, mm.
    radius_mm: float | None
    """Radius of the arc across the head, mm; null where it is flat, negative where it is hollow."""
    radius_along_mm: float | None = None  #: The same along the head.
    uneven_mm: Annotated[float, Meta(ge=0)] = 0.0  #: Root mean square departure of the taxels from these arcs, mm.
    rim_mm: Annotated[float, Meta(ge=0)] | None = None
    """Radius of the edge around the taxels, which presses and senses nothing; null where unknown."""

    def __post_init__(self) -> None:
        for name in ("radius_mm", "radius_along_mm"):
            if getattr(self, name) == 0:
                raise BadDataError(f"{name} is 0", way_out="give another radius; null is flat")

    @classmethod
    def of(cls, surface_mm: FloatArray, pitch_mm: float, *, rim_mm: float | None = None) -> HeadShape:
        """Shape of a head from its (rows, columns, 3) taxel centres, mm: origin at the apex, z into the tissue.

        Least squares of :math:`z = c + s_x x + s_y y - (x^2 + z^2)/(2 R_x) - y^2/(2 R_y)`, which holds to the digit for
        a cylinder, a sphere and a plane, tilted or not.
        """
        x, y, z = (surface_mm[..., i].ravel() for i in range(3))
        terms = np.stack([np.ones_like(x), x, y, -(x * x + z * z) / 2, -(y * y) / 2], axis=1)
        coefficients = np.linalg.lstsq(terms, z, rcond=None)[0]
        uneven = float(np.sqrt(np.mean((terms @ coefficients - z) ** 2)))
        rows, columns, _ = surface_mm.shape
        across, along = (_radius(float(curvature)) for curvature in coefficients[3:])
        return cls(rows, columns, round(float(pitch_mm), 4), across, along, round(uneven, 3) + 0.0, rim_mm)

    def differences(self, other: HeadShape) -> list[str]:
        """Departures of another head that are too large for a calibration of this one, in words; empty without any."""
        pairs = []
        if not _near(self.pitch_mm, other.pitch_mm, PITCH_SHARE):
            pairs.append(("pitch", f"{self.pitch_mm:g} mm", f"{other.pitch_mm:g} mm"))
        sides = zip(self.sides_mm, other.sides_mm, strict=True)
        if not all(_near(ours, theirs, SIDE_SHARE) for ours, theirs in sides):
            pairs.append(("array", self._array(), other._array()))
        curved = zip(("across", "along"), self._curvatures(), other._curvatures(), self.sides_mm, strict=True)
        for axis, ours, theirs, side in curved:
            if abs(ours - theirs) * side**2 / 8 > RISE_MM:
                pairs.append((f"face {axis} the head", _arc(ours), _arc(theirs)))
        if abs(self.uneven_mm - other.uneven_mm) > UNEVEN_MM:
            pairs.append(("taxels", f"{self.uneven_mm:g} mm off its arcs", f"{other.uneven_mm:g} mm off its arcs"))
        return [f"{name} {theirs} (the calibration: {ours})" for name, ours, theirs in pairs]

    @property
    def sides_mm(self) -> tuple[float, float]:
        """Width across and length along the head of the sensing area."""
        return (self.rows * self.pitch_mm, self.columns * self.pitch_mm)

    def _array(self) -> str:
        width, length = self.sides_mm
        return f"{self.rows} x {self.columns} taxels ({width:g} x {length:g} mm)"

    def _curvatures(self) -> tuple[float, float]:
        """Across and along, 1/mm."""
        across, along = (0.0 if radius is None else 1.0 / radius for radius in (self.radius_mm, self.radius_along_mm))
        return across, along

    def __str__(self) -> str:
        parts = [f"{self.rows} x {self.columns} taxels", f"{self.pitch_mm:g} mm apart"]
        across, along = self._curvatures()
        parts.append(_arc(across) if across else "flat")
        parts += [f"{_arc(along)} along it"] if along else []
        parts += [f"{self.uneven_mm:g} mm off its arcs"] if self.uneven_mm >= UNEVEN_MM else []
        parts += [f"rim {self.rim_mm:g} mm"] if self.rim_mm is not None else []
        return ", ".join(parts)


DEFAULT_HEAD: Final = HeadShape(HEAD_ROWS, HEAD_COLUMNS, HEAD_PITCH_MM, HEAD_RADIUS_MM)
"""That of the paper and of the shipped calibrations."""


def _radius(curvature: float) -> float | None:
    return None if abs(curvature) * FLAT_RADIUS_MM <= 1 else round(1 / curvature, 2)


def _near(ours: float, theirs: float, share: float) -> bool:
    return abs(theirs / ours - 1) <= share + 1e-9


def _arc(curvature: float) -> str:
    return f"on an arc of {1 / curvature:.3g} mm" if curvature else "flat"


# --- One examination's data: pressure frames, tracker poses, head and landmarks.
#
# A live device, a log and a simulation all yield these types. Arrays are kept as read-only views.

CountArray = NDArray[np.uint16]


def _check_finite(array: FloatArray, *, name: str, shape: tuple[int | None, ...]) -> FloatArray:
    """The array as read-only float64, after a check of its shape (None is any length) and finiteness."""
    values = np.asarray(array, dtype=np.float64)
    if values.ndim != len(shape) or any(
        side not in (None, length) for side, length in zip(shape, values.shape, strict=True)
    ):
        sides = ", ".join("n" if side is None else str(side) for side in shape)
        raise BadDataError(f"{name} has shape {values.shape}", way_out=f"it must be ({sides})")
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        what = f"{name} has {len(bad)} values that are not finite (first at {index}: {values[index]})"
        raise BadDataError(what, way_out="mask or repair them before import")
    view = values.view()
    view.flags.writeable = False
    return view


def _check_times(time_s: FloatArray, *, name: str) -> FloatArray:
    values = _check_finite(time_s, name=name, shape=(None,))
    back = np.flatnonzero(np.diff(values) < 0)
    if len(back):
        i = int(back[0]) + 1
        what = f"{name} runs backwards at index {i} ({values[i]:.6f} after {values[i - 1]:.6f})"
        raise BadDataError(what, way_out="sort by time; where a clock began anew, cut the scan there")
    if len(values) and values[0] < 0:
        raise BadDataError(f"{name} starts at {values[0]:.6f} s", way_out="times must not be negative")
    return values


_LEVER_MM: Final = (1.0, 1000.0)  #: From the tracker's sensor to the head, where they are two things.


def check_pitch(surface_mm: FloatArray, pitch_mm: float) -> None:
    """Raise `BadDataError` for taxels whose distance is not the pitch."""
    for axis, direction in ((0, "across"), (1, "along")):
        spacing = np.linalg.norm(np.diff(surface_mm, axis=axis), axis=-1)
        if spacing.size and not 0.8 * pitch_mm <= (apart := float(np.median(spacing))) <= 1.25 * pitch_mm:
            what = f"the taxels lie {apart:.4g} mm apart {direction} the head, pitch_mm is {pitch_mm:.4g}"
            raise BadDataError(what, way_out="give both in mm, for the same head")


class HeadGeometry(Record, eq=False):
    """Positions of the taxels, and how the tracker is mounted."""

    surface_mm: FloatArray
    """(rows, columns, 3) array: Taxel centres in `scanhead`: origin at the apex of the face, z into the tissue, axis 0
    across the head (x), axis 1 along it (y)."""
    pitch_mm: float  #: Distance between neighbouring taxels.
    scanhead_from_tracker: FloatArray
    """(4, 4) array: The lever arm: ``p_scanhead = scanhead_from_tracker @ p_tracker``."""
    checked_on: str = ""  #: Day on which a scan showed that this is right, as YEAR-MONTH-DAY; empty where none did.

    def __post_init__(self) -> None:
        surface = _check_finite(self.surface_mm, name="surface_mm", shape=(None, None, 3))
        if not 0 < self.pitch_mm < 100:
            raise BadDataError(f"pitch_mm is {self.pitch_mm}", way_out="it must be positive, in mm")
        transform = _check_finite(self.scanhead_from_tracker, name="scanhead_from_tracker", shape=(4, 4))
        check_rigid(transform, name="scanhead_from_tracker")
        lever = float(np.linalg.norm(transform[:3, 3]))
        if 1e-3 < lever < _LEVER_MM[0] or lever > _LEVER_MM[1]:
            what = f"the lever arm puts the tracker's sensor {lever:.4g} mm from the head"
            raise BadDataError(what, way_out=f"looks like {'metres' if lever < 1 else 'micrometres'}, give mm")
        set_fields(self, surface_mm=surface, scanhead_from_tracker=transform)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows across the head and columns along it."""
        return (self.surface_mm.shape[0], self.surface_mm.shape[1])


class ElementCalibration(Record, eq=False):
    """Bladder calibration of each taxel: pressure in kPa = gain x counts + offset, (rows, columns) arrays."""

    gain_kpa_per_count: FloatArray
    offset_kpa: FloatArray
    saturation_count: int = 4095  #: Readings at or above it are saturated and carry no pressure.

    def __post_init__(self) -> None:
        gain = _check_finite(self.gain_kpa_per_count, name="gain_kpa_per_count", shape=(None, None))
        offset = _check_finite(self.offset_kpa, name="offset_kpa", shape=gain.shape)
        if (gain < 0).any():
            index = tuple(int(i) for i in np.argwhere(gain < 0)[0])
            what = f"gain_kpa_per_count is negative at {index} ({gain[index]:.4g})"
            raise BadDataError(what, way_out="correct it, or calibrate anew")
        set_fields(self, gain_kpa_per_count=gain, offset_kpa=offset)

    def linear_kpa(self, counts: CountArray | FloatArray) -> FloatArray:
        """Gain x (..., rows, columns) counts + offset, of saturated readings too."""
        return np.asarray(self.gain_kpa_per_count * counts + self.offset_kpa)

    def to_kpa(self, counts: CountArray) -> FloatArray:
        """Pressure in kPa of (n, rows, columns) counts; NaN where a reading is saturated (count or 34 kPa)."""
        pressure = self.linear_kpa(counts)
        pressure[(counts >= self.saturation_count) | (pressure >= PRESSURE_RANGE_KPA[1])] = np.nan
        return pressure


class PressureFrames(Record, eq=False):
    """Raw frames of the array."""

    time_s: FloatArray  #: (n,) array: Device time of each frame; never runs backwards.
    counts: CountArray  #: (n, rows, columns) uint16 array.

    def __post_init__(self) -> None:
        time = _check_times(self.time_s, name="frame_time_s")
        whole = self.counts.dtype == np.uint16 and self.counts.ndim == 3 and 0 not in self.counts.shape[1:]
        if not whole or len(self.counts) != len(time):
            what = f"counts is {self.counts.dtype} of shape {self.counts.shape} for {len(time)} frame times"
            raise BadDataError(what, way_out="it must be uint16 (n, rows, columns), one frame per time")
        view = self.counts.view()
        view.flags.writeable = False
        set_fields(self, time_s=time, counts=view)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def sha256(self) -> str:
        """Digest of the readings alone: a recording has the same one with any session or calibration."""
        digest = hashlib.sha256(np.array(self.counts.shape, dtype="<i8").tobytes())
        digest.update(np.ascontiguousarray(self.counts, dtype="<u2").data)
        return digest.hexdigest()


class TrackerPoses(Record, eq=False):
    """Poses of the tracker's sensor in `base`: (m, 3) positions and (m, 4) quaternions."""

    time_s: FloatArray  #: (m,) array: Device time on the frames' clock.
    position_mm: FloatArray
    quaternion_wxyz: FloatArray  #: Scalar first; ``p_base = position + R(q) p_tracker``. Signs are free.

    def __post_init__(self) -> None:
        time = _check_times(self.time_s, name="pose_time_s")
        position = _check_finite(self.position_mm, name="position_mm", shape=(len(time), 3))
        quaternion = _check_finite(self.quaternion_wxyz, name="quaternion_wxyz", shape=(len(time), 4))
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(quaternion, axis=1)
        off = np.flatnonzero(np.abs(norm - 1.0) > 1e-2)
        if len(off):
            i = int(off[0])
            what = f"quaternion_wxyz has norm {norm[i]:.4g} at index {i} ({len(off)} in all depart from 1 by over 1 %)"
            raise BadDataError(what, way_out="give unit quaternions, scalar first")
        set_fields(self, time_s=time, position_mm=position, quaternion_wxyz=quaternion)

    def __len__(self) -> int:
        return len(self.time_s)


LANDMARK_NAMES: Final = ("sternal_notch", "xiphoid")  #: Without one of them a map has no axes of the patient.


class Landmarks(Record, eq=False):
    """Points touched just before the scan, (3,) in `base`, mm."""

    sternal_notch_mm: FloatArray
    xiphoid_mm: FloatArray
    spread_mm: float | None = None
    """Largest distance of an earlier touch from the last one, where a landmark was touched again; else None."""
    nipple_mm: FloatArray | None = None  #: None where it was not touched: a lump then has no place by the clock.

    def __post_init__(self) -> None:
        if self.spread_mm is not None and not 0 <= self.spread_mm < np.inf:
            raise BadDataError(f"spread_mm is {self.spread_mm}", way_out="give a distance of 0 mm or more")
        for name in ("sternal_notch_mm", "xiphoid_mm", "nipple_mm"):
            if getattr(self, name) is not None:
                set_fields(self, **{name: _check_finite(getattr(self, name), name=name, shape=(3,))})

    def points(self) -> dict[str, FloatArray]:
        """(3,) points in `base` by name: ``sternal_notch``, ``xiphoid``, and ``nipple`` where it was touched."""
        named = {"sternal_notch": self.sternal_notch_mm, "xiphoid": self.xiphoid_mm}
        return named if self.nipple_mm is None else {**named, "nipple": self.nipple_mm}


class Scan(Record, eq=False):
    """All data of one scan."""

    frames: PressureFrames
    poses: TrackerPoses
    head: HeadGeometry
    element_calibration: ElementCalibration
    landmarks: Landmarks | None = None  #: None when they were not touched: the map then has no patient frame.
    session: Mapping[str, str] = field(default_factory=dict)
    """Plain text facts (device ids, side, posture...); no names."""
    findings: tuple[Finding, ...] = ()  #: Losses of its file and notes of its recorder.

    def __post_init__(self) -> None:
        taxels = self.frames.counts.shape[1:]
        for name, shape in (
            ("head.surface_mm", self.head.shape),
            ("gain_kpa_per_count", self.element_calibration.gain_kpa_per_count.shape),
        ):
            if shape != taxels:
                raise BadDataError(f"{name} is for {shape} taxels, counts have {taxels}", way_out="use one head's data")

    def __repr__(self) -> str:
        n, rows, columns = self.frames.counts.shape
        marks = "landmarks" if self.landmarks is not None else "no landmarks"
        return f"<Scan {n} frames of {rows} x {columns} taxels, {len(self.poses.time_s)} poses, {marks}>"

    def pressure_kpa(self, start: int = 0, stop: int | None = None) -> FloatArray:
        """Calibrated frames `start` to `stop`: (n, rows, columns) kPa, NaN where saturated."""
        return self.element_calibration.to_kpa(self.frames.counts[start:stop])
