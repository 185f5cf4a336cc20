"""A map that grows while a scan is recorded, and the server that shows it to a browser."""

from __future__ import annotations

import fcntl
import hmac
import ipaddress
import json
import math
import os
import secrets
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import BoolArray, FloatArray, Plane, apply, patient_from_plane
from tactile_bayes.hardware.ports import PIPE_BYTES
from tactile_bayes.hardware.readings import PoseReading
from tactile_bayes.hardware.recorder import Observer, RecordingReport
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.cells import FramePoses, HeadMoments, distinct_poses, head_moments, poses_at
from tactile_bayes.mapping.map import TactileMap, orientation_of
from tactile_bayes.presets import PRESSURE_WINDOW_KPA
from tactile_bayes.scans import CountArray, ElementCalibration, HeadGeometry, TrackerPoses

# --- Feed of a recording to its live view, through a pipe on which the recorder never waits.
#
# A message is the sizes of its parts, JSON, and a frame's counts. A message that does not fit into the pipe is dropped
# whole: the view misses it, the file does not.

_SIZES: Final = struct.Struct("<II")
_REPORTED: Final = ("frames", "frames_lost", "poses", "duration_s", "unseen")  #: Fields of the recorder's report.

FeedMessage = tuple[Any, ...]
"""``"frame"``, device time, host time, counts; ``"pose"``, device time, place, quaternion; ``"landmark"``, name, place;
or ``"report"`` and some fields of the report."""


class Feed(Observer):
    """The recorder's end of the feed, a pipe; it observes the recording."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        os.set_blocking(pipe, False)
        with suppress(OSError, AttributeError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    def frame(self, counts: CountArray, device_ns: int) -> None:
        self._send("frame", device_ns, time.monotonic_ns(), counts.shape, counts=counts.astype("<u2").tobytes())

    def pose(self, pose: PoseReading, device_ns: int) -> None:
        self._send("pose", device_ns, pose.position_mm, pose.quaternion_wxyz)

    def landmark(self, name: str, position_mm: FloatArray) -> None:
        """Send a landmark, touched or read from a file."""
        self._send("landmark", name, position_mm.tolist())

    def report(self, report: RecordingReport) -> None:
        """Send the report so far, with the landmark that was touched last."""
        summary = {name: getattr(report, name) for name in _REPORTED}
        self._send("report", summary | {"touched": "".join(report.landmarks[-1:])})

    def _send(self, *message: Any, counts: bytes = b"") -> None:
        text = json.dumps(message).encode()
        data = _SIZES.pack(len(text), len(counts)) + text + counts
        with suppress(BlockingIOError, BrokenPipeError):  # it is full, or the view was closed; the recording goes on
            if len(data) <= select.PIPE_BUF:  # a longer one could be cut in two
                os.write(self._pipe, data)

    def close(self) -> None:
        """Close the feed; the view ends after reading the rest of the pipe."""
        os.close(self._pipe)


def read_feed(pipe: int, every_s: float) -> Iterator[list[FeedMessage]]:
    """Messages of a `Feed` since the last time, in lists: frames mapped one by one cost eight times as much."""
    os.set_blocking(pipe, False)
    ended = False
    while not ended:
        time.sleep(every_s)
        data, messages, index = b"", list[FeedMessage](), 0
        with suppress(BlockingIOError):
            while piece := os.read(pipe, PIPE_BYTES):
                data += piece
            ended = True
        while index < len(data):  # a whole number of messages, as each went in at once
            text, size = _SIZES.unpack_from(data, index)
            start = index + _SIZES.size + text
            index = start + size
            message = json.loads(data[start - text : start])
            if message[0] == "frame":
                message[-1] = np.frombuffer(data[start:index], dtype="<u2").reshape(message[-1])
            messages.append(tuple(message))
        yield messages


# --- The growing map and the pressure during a recording, for a live view.

# Numbers of used frames at which the plane is fitted again: the first frames lie on a line.
REFIT_AT: Final = (100, 200, 400, 800, 1600)
_KEPT_POSES: Final = 400
_PATIENCE_NS: Final = 150_000_000


class LiveState(Record, eq=False):
    """State of a recording that the live view draws."""

    tactile_map: TactileMap | None = None
    """Map so far, with the patient's axes once both landmarks are known; None before there is one."""
    pressure_kpa: float = float("nan")  #: Mean of the last frame; NaN before the first.
    frames: int = 0
    frames_lost: int = 0
    poses: int = 0
    unseen: str = ""
    """`frames`, `frames_lost`, `poses`, `unseen`: From the recorder's report; `unseen` is why no pose comes now."""
    duration_s: float = 0.0  #: Time recorded so far.
    used_share: float = 0.0  #: Share of the frames that the map uses.
    latency_ms: float = 0.0  #: Age of the youngest frame in this state.
    landmarks: tuple[str, ...] = ()  #: Names of the landmarks that were touched or read from a file.
    touched: str = ""  #: The landmark touched last, with its position and whether the head was still, in words.
    size: str = ""  #: The current estimate in words.
    lump_base_mm: FloatArray | None = None
    """(3,) array or None: Centre of the estimated lump in `base`: the map's plane changes while the map grows."""

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
        """Counts so far, in words; a missing pose comes first."""
        unseen, tactile_map = f"NO POSE ({self.unseen}); " if self.unseen else "", self.tactile_map
        covered_mm2 = 0.0 if tactile_map is None else float(tactile_map.covered.sum()) * tactile_map.recipe.cell_mm**2
        return (
            f"{unseen}{self.duration_s:.1f} s, {self.frames} frames, {self.frames_lost} lost, {self.poses} poses, "
            f"{covered_mm2 / 100:.1f} cm² covered"
        )

    @property
    def landmark_words(self) -> str:
        """Names of the known landmarks and the last touch, in words; empty without landmarks."""
        names = ", ".join(name.replace("_", " ") for name in self.landmarks)
        return f"landmarks: {names}" + (f"; {self.touched}" if self.touched else "") if names else ""

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
    """`_frames`, `_poses`: Frames not mapped yet, and the last poses, each with its device time."""
    _report: dict[str, Any] = field(default_factory=dict)
    _landmarks: dict[str, FloatArray] = field(default_factory=dict)
    _map: MapAccumulator | None = None
    _mapped: list[tuple[CountArray, FramePoses, BoolArray]] = field(default_factory=list)
    """Frames in the map, their poses, and which were used; kept as long as the plane may change."""
    _refits: int = 0
    _pressure_kpa: float = float("nan")
    _host_ns: int = 0

    def take(self, messages: Iterable[FeedMessage]) -> None:
        """Add frames, poses and landmarks; frames wait for the tracker's next pose."""
        youngest = None
        for message in messages:
            match message:
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
        frame_poses = poses_at(distinct_poses(poses), np.array([device_ns / 1e9 for device_ns, _ in ready]))
        if self._map is None:
            if not frame_poses.known.any():
                return
            self._map = self._empty_map(head_moments(self.head, frame_poses).plane())
        counts = np.stack([counts for _, counts in ready])
        used = self._map.add(counts, frame_poses)
        if self._refits < len(REFIT_AT):
            self._mapped.append((counts, frame_poses, used))
            self._refit()

    def _empty_map(self, plane: Plane) -> MapAccumulator:
        return MapAccumulator(self.head, self.calibration, plane_from_base=plane.plane_from_base)

    def _refit(self) -> None:
        """Map all frames again on their best-fit plane, when their number has reached the next of `REFIT_AT`."""
        if sum(int(used.sum()) for _, _, used in self._mapped) < REFIT_AT[self._refits]:
            return
        self._refits += 1
        moments = sum((head_moments(self.head, poses.part(used)) for _, poses, used in self._mapped), HeadMoments())
        with suppress(BadDataError):  # still too nearly a line: the plane under the head will do until the next time
            self._map = self._empty_map(moments.plane())
            for counts, poses, _ in self._mapped:
                self._map.add(counts, poses)
        if self._refits == len(REFIT_AT):
            self._mapped.clear()

    def _snapshot(self) -> TactileMap | None:
        """The map so far, with the patient's axes where they are known."""
        if self._map is None or not self._map.figures["frames_used"]:
            return None
        tactile_map = self._map.snapshot()
        notch, xiphoid = map(self._landmarks.get, ("sternal_notch", "xiphoid"))
        if notch is None or xiphoid is None:
            return tactile_map
        with suppress(BadDataError):  # two landmarks in one place give no axes
            axes = patient_from_plane(notch, xiphoid, self._map.plane_from_base)
            return replace(tactile_map, patient_from_plane=axes)
        return tactile_map

    def state(self, *, size: str = "", lump_base_mm: FloatArray | None = None) -> LiveState:
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


# --- Server of the live view to a browser on this computer: one page, one websocket, a secret in the address.
#
# The page loads nothing from anywhere else. The websocket takes only pages of its own origin, so that no other site
# that is open in the browser can look on.

_PAGE: Final = Path(__file__).with_name("live_page.html")
OPEN_S: Final = 4.0  #: How long a page may take to send its request: the view's process waits for all of them.
CLOSE_S: Final = 0.5
MOST_OPEN: Final = 24  #: Connections at a time, more than anybody's open pages.
WAIT_S: Final = 0.1
SHED_S: Final = 0.01
_SECURITY: Final = (
    "default-src 'none'; connect-src 'self' ws://{host}; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
    "frame-ancestors 'none'; base-uri 'none'"
)


def parse_address(text: str) -> tuple[str, int]:
    """Parse the HOST:PORT of a server that only this computer can reach: the data are a patient's."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise UsageError(f"--serve {text!r} is not HOST:PORT; give 127.0.0.1:0 for any free port")
    host = "127.0.0.1" if host in ("localhost", "") else host.strip("[]")
    try:
        loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        fault = f"--serve {text} can be reached from other computers; give 127.0.0.1:PORT and use an SSH tunnel"
        raise UsageError(fault)
    return host, int(port)


class _LimitedListener(socket.socket):
    """A listening socket with at most `MOST_OPEN` connections, which survives failures to accept one.

    A server of websockets ends for good when a connection cannot be accepted, for example without file descriptors.
    Beyond the limit the oldest connection that is no page is closed, so that a page with the secret always gets in.
    """

    def __init__(self, host: str, port: int, pages: Callable[[], set[socket.socket]]) -> None:
        super().__init__(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self._open: list[socket.socket] = []
        self._pages = pages
        self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.bind((host, port))
        self.listen()

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; raises OSError only where this socket was closed."""
        while True:
            self._wait()
            self._open = [one for one in self._open if one.fileno() >= 0]
            if len(self._open) >= MOST_OPEN:
                pages = self._pages()
                for one in [one for one in self._open if one not in pages][:1]:
                    with suppress(OSError):
                        one.shutdown(socket.SHUT_RDWR)  # its thread closes it
                time.sleep(SHED_S)
                continue
            with suppress(OSError):  # its other end has gone, or the system has nothing left
                connection, address = super().accept()
                self._open.append(connection)
                return connection, address
            time.sleep(SHED_S)

    def _wait(self) -> None:
        while self.fileno() >= 0:
            with suppress(ValueError):  # it was closed meanwhile
                if select.select([self], [], [], WAIT_S)[0]:
                    return
        raise OSError("closed")


class LiveServer:
    """Sends states to the pages whose address has the server's random secret; port 0 takes a free port."""

    def __init__(self, host: str, port: int) -> None:
        try:
            import websockets.sync.server
        except ImportError:
            raise UsageError("--serve needs the package websockets; pip install 'tactile-bayes[live]'") from None
        self._token = secrets.token_urlsafe(24)
        self._changed = threading.Condition()
        self._text, self._number, self._ended = "", 0, False
        self._pages: set[Any] = set()
        try:
            self._closed = websockets.exceptions.ConnectionClosed
            self._server = websockets.sync.server.serve(
                self._send_states,
                sock=_LimitedListener(host, port, self._sockets),
                process_request=self._answer_request,
                compression=None,
                open_timeout=OPEN_S,
                close_timeout=CLOSE_S,
            )
        except OSError as error:
            raise UsageError(f"--serve {host}:{port}: {error.strerror}; give another port, 0 for any") from None
        name, number = self._server.socket.getsockname()[:2]
        self._authority = f"[{name}]:{number}" if ":" in name else f"{name}:{number}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        """Address to open in a browser."""
        return f"http://{self._authority}/?token={self._token}"

    def show(self, state: LiveState) -> None:
        text = json.dumps(page_state(state), allow_nan=False)
        with self._changed:
            self._text, self._number = text, self._number + 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the pages' connections and stop the server; pages that do not read are cut off."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        closing = threading.Thread(target=self._server.shutdown, daemon=True)
        closing.start()
        closing.join(CLOSE_S)
        for page in self._sockets():
            with suppress(OSError):
                page.shutdown(socket.SHUT_RDWR)
        closing.join(CLOSE_S)

    def _sockets(self) -> set[socket.socket]:
        with self._changed:
            return {page.socket for page in self._pages}

    def _answer_request(self, connection: Any, request: Any) -> Any:
        """Answer with the page or a refusal; None accepts a websocket."""
        path, _, query = request.path.partition("?")
        token = parse_qs(query).get("token", [""])[0]
        if not hmac.compare_digest(token.encode(), self._token.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, "give the whole address that `record` printed\n")
        if request.headers.get_all("Host") != [self._authority]:
            return connection.respond(HTTPStatus.FORBIDDEN, "not under this name\n")
        if path == "/live":
            if request.headers.get_all("Origin") != [f"http://{self._authority}"]:
                return connection.respond(HTTPStatus.FORBIDDEN, "not from another site\n")
            return None
        if path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "nothing here\n")
        nonce = secrets.token_urlsafe(16)
        page = _PAGE.read_text(encoding="utf-8").replace("NONCE", nonce)
        response = connection.respond(HTTPStatus.OK, page)
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        response.headers["Content-Security-Policy"] = _SECURITY.format(host=self._authority, nonce=nonce)
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cache-Control"] = "no-store"
        return response

    def _send_states(self, connection: Any) -> None:
        """Send each new state until the page closes or the recording ends."""
        number_sent = 0
        with self._changed:
            self._pages.add(connection)
        try:
            while True:
                with self._changed:
                    while self._number == number_sent and not self._ended:
                        self._changed.wait()
                    text, number_sent, over = self._text, self._number, self._ended
                if over:
                    return
                connection.send(text)
        except self._closed:
            return
        finally:
            with self._changed:
                self._pages.discard(connection)


def page_state(state: LiveState) -> dict[str, Any]:
    """A state as plain data for the page."""
    has_pressure = math.isfinite(state.pressure_kpa)
    return {
        "tone": state.tone,
        "pressure_kpa": round(state.pressure_kpa, 2) if has_pressure else None,
        "window_kpa": list(PRESSURE_WINDOW_KPA),
        "figures": state.account_words,
        "size": state.size_words,
        "map": _map_state(state),
    }


def _map_state(state: LiveState) -> dict[str, Any] | None:
    """The map's picture row by row from its top left corner, and the overlays in cells from that corner."""
    tactile_map = state.tactile_map
    if tactile_map is None:
        return None
    view = orientation_of(tactile_map)
    levels = view.screen(grey_levels(tactile_map.mean))
    rows, columns = levels.shape
    cells = [None if math.isnan(level) else round(255 * level) for level in levels.ravel().tolist()]
    limits = colour_limits(tactile_map.mean)
    return {
        "rows": rows,
        "columns": columns,
        "levels": cells,
        "cell_mm": tactile_map.recipe.cell_mm,
        "edges": dict(view.edges),
        "words": view.words,
        "notch": None if view.notch is None else [round(part, 4) for part in view.notch],
        "lump": None if state.lump_mm is None else [round(part, 2) for part in view.place(tactile_map, state.lump_mm)],
        "limits": None if limits is None else [float(f"{end:.3g}") for end in limits],
        "values": tactile_map.recipe.value_words,
    }
