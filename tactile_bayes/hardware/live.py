"""A map that grows while a scan is recorded."""

from __future__ import annotations

import fcntl
import json
import os
import select
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import BoolArray, FloatArray, Plane, apply, patient_from_plane
from tactile_bayes.hardware.ports import PIPE_BYTES
from tactile_bayes.hardware.readings import CountArray, PoseReading
from tactile_bayes.hardware.recorder import Observer, Report
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.cells import FramePoses, HeadMoments, distinct_poses, head_moments, poses_at
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.presets import PRESSURE_WINDOW_KPA
from tactile_bayes.scans import ElementCalibration, HeadGeometry, TrackerPoses

# --- Feed of a recording to its live view, through a pipe on which the recorder never waits.
#
# A message is the sizes of its parts, JSON, and a frame's counts. It goes in whole or, when it does not fit, not at
# all: then the view misses it while the file does not.

_SIZES: Final = struct.Struct("<II")
_TOLD: Final = ("frames", "frames_lost", "poses", "duration_s", "unseen")  #: Of the recorder's account.


Seen = tuple[Any, ...]
"""``"frame"``, device time, host time, counts; ``"pose"``, device time, place, quaternion; ``"landmark"``, name, place;
or ``"report"`` and some of the account."""


class Feed(Observer):
    """The recorder's end of the feed, a pipe; it observes the recording."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self.missed = 0
        os.set_blocking(pipe, False)
        with suppress(OSError, AttributeError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    def frame(self, counts: CountArray, device_ns: int) -> None:
        """Send a recorded frame."""
        self._send("frame", device_ns, time.monotonic_ns(), counts.shape, counts=counts.astype("<u2").tobytes())

    def pose(self, pose: PoseReading, device_ns: int) -> None:
        """Send a recorded pose."""
        self._send("pose", device_ns, pose.position_mm, pose.quaternion_wxyz)

    def landmark(self, name: str, position_mm: FloatArray) -> None:
        """Send a landmark, touched or read from a file."""
        self._send("landmark", name, position_mm.tolist())

    def told(self, report: Report) -> None:
        """Send the account so far, with the landmark that was touched last."""
        told = {name: getattr(report, name) for name in _TOLD}
        self._send("report", told | {"touched": "".join(report.landmarks[-1:])})

    def _send(self, *told: Any, counts: bytes = b"") -> None:
        text = json.dumps(told).encode()
        message = _SIZES.pack(len(text), len(counts)) + text + counts
        with suppress(BlockingIOError, BrokenPipeError):  # it is full, or the view was closed; the recording goes on
            if len(message) <= select.PIPE_BUF:  # else it could go in by halves
                os.write(self._pipe, message)
                return
        self.missed += 1

    def close(self) -> None:
        """Close the feed; the view ends after reading the rest of the pipe."""
        os.close(self._pipe)


def fed(pipe: int, every_s: float) -> Iterator[list[Seen]]:
    """What a `Feed` has sent, time after time until the recorder has gone.

    Messages are not given one by one: frames taken so cost eight times as much.
    """
    os.set_blocking(pipe, False)
    ended = False
    while not ended:
        time.sleep(every_s)
        data = b""
        with suppress(BlockingIOError):
            while piece := os.read(pipe, PIPE_BYTES):
                data += piece
            ended = True
        yield list(_messages(data))


def _messages(data: bytes) -> Iterator[Seen]:
    """A whole number of messages, as each went in at once."""
    place = 0
    while place < len(data):
        text, size = _SIZES.unpack_from(data, place)
        start = place + _SIZES.size + text
        place = start + size
        told = json.loads(data[start - text : start])
        if told[0] == "frame":
            told[-1] = np.frombuffer(data[start:place], dtype="<u2").reshape(told[-1])
        yield tuple(told)


# --- The growing map and the pressure during a recording, for a live view.

# Frames used after which the plane is fitted anew: the first ones lie on a line.
REFIT_AT: Final = (100, 200, 400, 800, 1600)
LANDMARKS: Final = ("sternal_notch", "xiphoid")
_KEPT_POSES: Final = 400
_PATIENCE_NS: Final = 150_000_000


class LiveState(Record, eq=False):
    """Data of one drawing of the live view."""

    tactile_map: TactileMap | None = None
    """So far, with the patient's axes once both landmarks are known; None before there is one."""
    pressure_kpa: float = float("nan")  #: Mean of the last frame; NaN before the first.
    frames: int = 0
    frames_lost: int = 0
    poses: int = 0
    unseen: str = ""
    """`frames`, `frames_lost`, `poses`, `unseen`: By the recorder's account; `unseen` is why there is no pose now."""
    duration_s: float = 0.0  #: Recorded so far.
    used_share: float = 0.0  #: Of the frames that the map has used.
    latency_ms: float = 0.0  #: From the recorder to this state, of its youngest frame.
    landmarks: tuple[str, ...] = ()  #: Names of those touched or read from a file.
    touched: str = ""  #: The last one that was touched, with its place and whether the head was still, in words.
    size: str = ""  #: The current estimate in words.
    lump_base_mm: FloatArray | None = None
    """(3,) array or None: Where the estimate's lump lies, in `base`: the plane changes while the map grows."""

    @property
    def size_words(self) -> str:
        """The estimate in words, or why there is none yet."""
        if self.size:
            return self.size
        if self.tactile_map is not None:
            return "no size yet: the first estimate is being computed"
        if not self.frames:
            return "no size yet: no frames have come"
        if not self.poses:
            return "no size yet: the tracker has sent no pose"
        low, high = PRESSURE_WINDOW_KPA
        return f"no size yet: no frame with a pose was pressed at {low:g} to {high:g} kPa"

    @property
    def account_words(self) -> str:
        """Numbers so far; a tool that is not seen comes first."""
        unseen, made = f"NO POSE ({self.unseen}); " if self.unseen else "", self.tactile_map
        covered_mm2 = 0.0 if made is None else float(made.covered.sum()) * made.recipe.cell_mm**2
        return (
            f"{unseen}{self.duration_s:.1f} s, {self.frames} frames, {self.frames_lost} lost, {self.poses} poses, "
            f"{covered_mm2 / 100:.1f} cm² covered"
        )

    @property
    def landmark_words(self) -> str:
        """Which landmarks are known, and the last touch in words; empty while there are none."""
        known = ", ".join(name.replace("_", " ") for name in self.landmarks)
        return f"landmarks: {known}" + (f"; {self.touched}" if self.touched else "") if known else ""

    @property
    def pressure_words(self) -> str:
        """Mean pressure of the last frame in words; empty without a frame."""
        return f"{self.pressure_kpa:.1f} kPa" if np.isfinite(self.pressure_kpa) else ""

    @property
    def lump_mm(self) -> tuple[float, float] | None:
        """Centre of the estimated lump on the present map's plane."""
        if self.lump_base_mm is None or self.tactile_map is None or self.tactile_map.plane_from_base is None:
            return None
        x, y, _ = apply(self.tactile_map.plane_from_base, self.lump_base_mm).tolist()
        return x, y

    @property
    def tone(self) -> str:
        """Tone for the pressure: ``low``, ``in``, ``high``, or ``off`` before the first frame."""
        if not np.isfinite(self.pressure_kpa):
            return "off"
        low, high = PRESSURE_WINDOW_KPA
        return "low" if self.pressure_kpa < low else "high" if self.pressure_kpa > high else "in"


@dataclass(slots=True)
class LiveMap:
    """Builds a map from a `Feed`."""

    head: HeadGeometry
    calibration: ElementCalibration
    _frames: list[tuple[int, CountArray]] = field(default_factory=list)
    _poses: list[tuple[int, Sequence[float], Sequence[float]]] = field(default_factory=list)
    """`_frames`, `_poses`: Those not mapped yet, and the last ones, each with its device time."""
    _report: dict[str, Any] = field(default_factory=dict)
    _landmarks: dict[str, FloatArray] = field(default_factory=dict)
    _map: MapAccumulator | None = None
    _fed: list[tuple[CountArray, FramePoses, BoolArray]] = field(default_factory=list)
    """Frames and poses that the map was given, and which it used, as long as its plane may change."""
    _refits: int = 0
    _pressure_kpa: float = float("nan")
    _host_ns: int = 0

    def take(self, seen: Iterable[Seen]) -> None:
        """Add frames, poses and landmarks; frames wait for the tracker's next pose."""
        youngest = None
        for one in seen:
            match one:
                case "frame", device_ns, host_ns, counts:
                    self._frames.append((device_ns, counts))
                    youngest, self._host_ns = counts, host_ns
                case "pose", *pose:
                    self._poses.append(tuple(pose))
                case "landmark", name, position_mm:
                    self._landmarks[name] = np.array(position_mm)
                case _, report:
                    self._report = report
        if youngest is not None:
            pressure = self.calibration.to_kpa(youngest[None])
            self._pressure_kpa = float(np.nanmean(pressure)) if np.isfinite(pressure).any() else float("nan")
        self._map_ready_frames()
        del self._poses[:-_KEPT_POSES]

    def _map_ready_frames(self) -> None:
        if not self._frames or len(self._poses) < 2:
            del self._frames[:-_KEPT_POSES]
            return
        times_ns, places, turns = zip(*self._poses, strict=True)
        overdue_ns = self._frames[-1][0] - _PATIENCE_NS
        ready = [one for one in self._frames if one[0] <= max(times_ns[-1], overdue_ns)]
        if not ready:
            return
        del self._frames[: len(ready)]
        poses = TrackerPoses(np.array([max(0, ns) / 1e9 for ns in times_ns]), np.array(places), np.array(turns))
        found = poses_at(distinct_poses(poses), np.array([device_ns / 1e9 for device_ns, _ in ready]))
        if self._map is None:
            if not found.known.any():
                return
            self._map = self._map_on(head_moments(self.head, found).plane())
        counts = np.stack([counts for _, counts in ready])
        used = self._map.add(counts, found)
        if self._refits < len(REFIT_AT):
            self._fed.append((counts, found, used))
            self._refit()

    def _map_on(self, plane: Plane) -> MapAccumulator:
        return MapAccumulator(self.head, self.calibration, plane_from_base=plane.plane_from_base)

    def _refit(self) -> None:
        """Move the map to the best-fit plane of the frames used so far, from time to time."""
        if sum(int(used.sum()) for _, _, used in self._fed) < REFIT_AT[self._refits]:
            return
        self._refits += 1
        moments = sum((head_moments(self.head, poses.part(used)) for _, poses, used in self._fed), HeadMoments())
        with suppress(BadDataError):  # still too nearly a line: the plane under the head will do until the next time
            self._map = self._map_on(moments.plane())
            for counts, poses, _ in self._fed:
                self._map.add(counts, poses)
        if self._refits == len(REFIT_AT):
            self._fed.clear()

    def _snapshot(self) -> TactileMap | None:
        """The map so far, with the patient's axes if known."""
        if self._map is None or not self._map.figures["frames_used"]:
            return None
        found = self._map.snapshot()
        if found.plane_from_base is None or not all(name in self._landmarks for name in LANDMARKS):
            return found
        notch, xiphoid = (self._landmarks[name] for name in LANDMARKS)
        with suppress(BadDataError):  # two landmarks in one place give no axes
            return replace(found, patient_from_plane=patient_from_plane(notch, xiphoid, found.plane_from_base))
        return found

    def state(self, *, size: str = "", lump_base_mm: FloatArray | None = None) -> LiveState:
        """The present state for the view."""
        figures = self._map.figures if self._map else {"frames_used": 0.0, "frames_total": 0.0}
        return LiveState(
            tactile_map=self._snapshot(),
            pressure_kpa=self._pressure_kpa,
            **self._report,
            used_share=figures["frames_used"] / max(1.0, figures["frames_total"]),
            latency_ms=(time.monotonic_ns() - self._host_ns) / 1e6 if self._host_ns else 0.0,
            landmarks=tuple(self._landmarks),
            size=size,
            lump_base_mm=lump_base_mm,
        )


def colour_limits(values: FloatArray) -> tuple[float, float] | None:
    """The 2 % and 98 % quantiles of the finite values, the ends of the colour scale; None without values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low, high = np.quantile(finite, [0.02, 0.98]).tolist()
    return low, high


def grey_levels(values: FloatArray) -> FloatArray:
    """Scale map values to 0..1 between their `colour_limits`; NaN stays."""
    limits = colour_limits(values)
    if limits is None:
        return np.full(values.shape, np.nan)
    low, high = limits
    if high == low:
        return np.where(np.isfinite(values), 0.5, np.nan)
    return np.asarray(np.clip((values - low) / (high - low), 0.0, 1.0))
