"""The scan head: its frames on the wire, its driver, its calibration on a bladder, and the sense of its rotation."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, DeviceError
from tactile_bayes.geometry import FloatArray, rotation_from_quaternion
from tactile_bayes.hardware import readings
from tactile_bayes.scans import CountArray, ElementCalibration

# --- The open framing of scan heads: COBS between zero bytes, version, type, sequence, device time, checksum.
#
# A packet is ``version u8, type u8, sequence u32, device time u64 in microseconds, payload, CRC-32 u32``,
# little-endian. On the wire it is COBS-encoded, with a zero byte before and after it, so that a damaged delimiter
# costs nothing more than the packet it belongs to. The byte layout for firmware authors is in
# docs/scan-head-protocol.md.

VERSION: Final = 1
HEADER: Final = struct.Struct("<BBIQ")
CRC_BYTES: Final = 4
# CRC-32 of any data followed by its own CRC-32, little-endian, is this number.
_RESIDUE: Final = zlib.crc32(zlib.crc32(b"").to_bytes(CRC_BYTES, "little"))
# The longest packet a head may send. More bytes without a zero are line noise, and are dropped.
MAX_PACKET_BYTES: Final = 16 * 1024
_LONGEST: Final = MAX_PACKET_BYTES + MAX_PACKET_BYTES // 254 + 1


class Packet(NamedTuple):
    """One valid packet."""

    kind: int
    sequence: int  #: Counts the packets of this kind, modulo 2^32.
    device_us: int  #: The device's clock in microseconds, modulo 2^64.
    payload: bytes


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing (Cheshire & Baker 1999): the same data without a zero byte.

    Every zero becomes the distance to the next one; runs of 254 bytes without a zero get a code of their own.
    """
    runs = [block[i : i + 254] for block in data.split(b"\0") for i in range(0, len(block) + 1, 254)]
    if len(runs) > 1 and not runs[-1] and data[-1:] != b"\0":
        del runs[-1]  # a full run at the end says by itself where it ends
    return b"".join(bytes([len(run) + 1]) + run for run in runs)


def cobs_decode(data: bytes) -> bytes | None:
    """Undo `cobs_encode`; None for an invalid code. Most of it is to put back the zeros that codes stand for."""
    out = bytearray(data)
    index, end = 0, len(data)
    full = []  # codes of 255: no zero was there, the byte goes
    while index < end:
        code = data[index]
        if code == 0:
            return None
        out[index] = 0
        index += code
        if code == 255:
            full.append(index)
    if index != end or not end:
        return None
    for index in reversed(full):
        if index < end:
            del out[index]
    return bytes(out[1:])


def encode_packet(kind: int, payload: bytes, *, sequence: int = 0, device_us: int = 0) -> bytes:
    """Encode one packet for the wire, with a zero byte before and after it; counters wrap as in firmware."""
    body = HEADER.pack(VERSION, kind, sequence % 2**32, device_us % 2**64) + payload
    if len(body) + CRC_BYTES > MAX_PACKET_BYTES:
        raise BadDataError(f"a payload of {len(payload)} bytes", way_out=f"a packet holds {MAX_PACKET_BYTES}")
    return b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")) + b"\0"


class PacketParser(readings.Parser):
    """Parser of packets; skips and counts garbage: failed checksums, invalid codes, noise."""

    def packets(self, data: bytes) -> list[Packet]:
        """Parse `data`; return the packets completed by it."""
        parts = filter(None, self._parts(data, b"\0", _LONGEST))
        return [packet for part in parts if (packet := self._decode(part)) is not None]

    def _decode(self, part: bytes) -> Packet | None:
        body = cobs_decode(part) if len(part) <= _LONGEST else None
        if body is None or len(body) < HEADER.size + CRC_BYTES or zlib.crc32(body) != _RESIDUE:
            self.garbage_bytes += len(part)
            return None
        version, kind, sequence, device_us = HEADER.unpack_from(body)
        if version != VERSION:
            self.fault = f"it sent packets of version {version} of the framing, this program reads {VERSION}"
            return None
        return Packet(kind, sequence, device_us, body[HEADER.size : -CRC_BYTES])


# --- Packets of the scan head, and of a tracker in the same framing; kinds from 128 on go from the host to the device.

HELLO: Final = 1
FRAME: Final = 2
END: Final = 3
POSE: Final = 4
ASK: Final = 128
START: Final = 129
STOP: Final = 130

BITS_PER_BYTE_8N1: Final = 10
DEFAULT_BAUD: Final = 2_000_000
_HELLO: Final = struct.Struct("<BBHI")  # rows, columns, saturation count, frames per 1000 s
_END: Final = struct.Struct("<II")  # sent, dropped
_POSE: Final = struct.Struct("<H7d")  # ns beyond the header's microseconds, x y z mm, w x y z
_MAX_ID: Final = 64
# The counter of frames has restarted when more seem to be missing: a silent device ends a recording long before.
MOST_LOST: Final = 100_000


def encode_hello(hello: readings.HelloReading) -> bytes:
    """Encode a device's identity: rows and columns (0 for a tracker), saturation count, rate, name."""
    numbers = _HELLO.pack(hello.rows, hello.columns, hello.saturation_count, round(hello.rate_hz * 1000))
    return encode_packet(HELLO, numbers + hello.device_id.encode()[:_MAX_ID])


def encode_frame(counts: CountArray, *, sequence: int, device_us: int) -> bytes:
    """Encode one (rows, columns) frame row by row."""
    return encode_packet(FRAME, counts.astype("<u2").tobytes(), sequence=sequence, device_us=device_us)


def encode_end(sent: int, dropped: int) -> bytes:
    """Encode the end of sending, with the numbers of records sent and dropped."""
    return encode_packet(END, _END.pack(sent, dropped))


def encode_pose(pose: readings.ToolReading, *, sequence: int) -> bytes:
    """Encode a pose without rounding: doubles in mm, and the nanoseconds that the header's microseconds leave out.

    The tool's name follows; then, after a zero byte, the reason for a missing pose or the pose's flags.
    """
    if isinstance(pose, readings.PoseReading):
        device_us, rest_ns = divmod(pose.device_ns or 0, 1000)
        payload, why = _POSE.pack(rest_ns, *pose.position_mm, *pose.quaternion_wxyz), ", ".join(pose.flags)
    else:
        device_us, payload, why = 0, _POSE.pack(0, *(7 * [math.nan])), pose.why
    payload += pose.tool.encode()[:_MAX_ID] + (b"\0" + why.encode()[:_MAX_ID] if why else b"")
    return encode_packet(POSE, payload, sequence=sequence, device_us=device_us)


def encode_command(kind: int, *, every: int = 1) -> bytes:
    """Encode `ASK`, `START` (send every n-th frame) or `STOP`."""
    payload = struct.pack("<B", every) if kind == START else b""
    return encode_packet(kind, payload)


class HeadParser(PacketParser):
    """Parser of a device in the open framing, head or tracker."""

    def __init__(self, hello: readings.HelloReading | None = None, *, every: int = 1) -> None:
        self.hello = hello
        self._every = every
        self._expected: int | None = None

    def feed(self, data: bytes) -> list[readings.Reading]:
        return [reading for packet in self.packets(data) if (reading := self._read(packet)) is not None]

    def _read(self, packet: Packet) -> readings.Reading | None:
        if packet.kind in (FRAME, POSE, HELLO):
            return {FRAME: self._frame, POSE: self._pose, HELLO: self._hello}[packet.kind](packet)
        if packet.kind == END and len(packet.payload) >= _END.size:
            return readings.EndReading(*_END.unpack_from(packet.payload))
        self.fault = f"it sent a packet of kind {packet.kind} with {len(packet.payload)} bytes"
        return None

    def _frame(self, packet: Packet) -> readings.FrameReading | None:
        shape = (self.hello.rows, self.hello.columns) if self.hello else None
        if shape is None or len(packet.payload) != 2 * shape[0] * shape[1]:
            self.fault = f"it sent a FRAME of {len(packet.payload)} bytes" + ("" if shape else " before its HELLO")
            return None
        sequence = packet.sequence // self._every
        gap = 0 if self._expected is None else (sequence - self._expected) % 2**32
        self._expected, restarted = sequence + 1, gap > MOST_LOST
        counts = np.frombuffer(packet.payload, dtype="<u2").reshape(shape)
        return readings.FrameReading(counts, packet.device_us * 1000, 0 if restarted else gap, restarted)

    def _pose(self, packet: Packet) -> readings.ToolReading | None:
        tool, _, why = readings.printable(packet.payload[_POSE.size :]).partition("\0")
        if len(packet.payload) < _POSE.size or max(len(tool), len(why)) > _MAX_ID:
            self.fault = f"it sent a POSE of {len(packet.payload)} bytes"
            return None
        rest_ns, x, y, z, qw, qx, qy, qz = _POSE.unpack_from(packet.payload)
        if why and math.isnan(x):
            return readings.MissingReading(why, tool)
        if not readings.plausible((x, y, z), (qw, qx, qy, qz)) or rest_ns > 999:
            self.fault = f"it sent a POSE that can be none, {x:g} {y:g} {z:g} mm, {qw:g} {qx:g} {qy:g} {qz:g}"
            return None
        flags = (why,) if why else ()
        return readings.PoseReading((x, y, z), (qw, qx, qy, qz), packet.device_us * 1000 + rest_ns, flags, tool)

    def _hello(self, packet: Packet) -> readings.HelloReading | None:
        if len(packet.payload) < _HELLO.size:
            self.fault = f"it sent a HELLO of {len(packet.payload)} bytes"
            return None
        rows, columns, saturation, millihertz = _HELLO.unpack_from(packet.payload)
        name = readings.printable(packet.payload[_HELLO.size :])
        if self.hello is not None and (name, rows, columns) != self.hello[:3]:
            first = self.hello.device_id
            self.fault = f"it sent a HELLO of {name!r} with {rows} x {columns} taxels beside that of {first!r}"
            return None
        self.hello = readings.HelloReading(name, rows, columns, saturation, millihertz / 1000)
        return self.hello


def needed_baud(taxels: int, *, rate_hz: float) -> int:
    """Line rate in baud for frames at their largest: header, checksum, stuffing, a zero byte at each end."""
    body = HEADER.size + 2 * taxels + CRC_BYTES
    return round((body + body // 254 + 1 + 2) * rate_hz * BITS_PER_BYTE_8N1)


def check_link_rate(hello: readings.HelloReading, *, baud: int, every: int = 1, port: str = "head") -> None:
    """Refuse a line that is too slow for every n-th frame of the head; the error says which rate or `every` fits."""
    need = needed_baud(hello.rows * hello.columns, rate_hz=hello.rate_hz / every)
    if need <= baud:
        return
    fits = int(np.ceil(needed_baud(hello.rows * hello.columns, rate_hz=hello.rate_hz) / baud))
    raise DeviceError(
        f"{port}: {hello.rows} x {hello.columns} taxels at {hello.rate_hz / every:g} Hz need {need / 1e6:.2f} Mbaud, "
        f"the line has {baud / 1e6:g}; raise it with --head-baud, or give --every {fits}"
    )


# --- Calibration of an array by a pressure bladder: steps of uniform pressure give each taxel's gain and offset.

# A taxel whose counts rise by less than this share of the median taxel's is dead, by more than this many times hot.
DEAD_SHARE: Final = 0.1
HOT_RATIO: Final = 2.5
FALL_SHARE: Final = 0.1  #: Readings of a higher step lie lower by less than this share of their range.
MIN_FRAMES: Final = 10
STEPS_FOR_CURVATURE: Final = 4  #: With fewer steps a curvature fits the noise.


class BladderStep(Record, eq=False):
    """Mean counts of the array under one known pressure."""

    pressure_kpa: float  #: Pressure of the bladder.
    counts: FloatArray  #: (rows, columns) array: Mean over the frames.
    saturated: NDArray[np.bool_]  #: (rows, columns) bool array: Taxels that reached full scale in any frame.

    @classmethod
    def from_frames(cls, pressure_kpa: float, frames: CountArray, *, saturation_count: int) -> BladderStep:
        """Average the frames of a step."""
        if not np.isfinite(pressure_kpa) or pressure_kpa < 0:
            raise BadDataError(f"a step of {pressure_kpa} kPa", way_out="give the bladder's pressure, 0 or more")
        if len(frames) < MIN_FRAMES:
            what = f"the step of {pressure_kpa:g} kPa has {len(frames)} frames"
            raise BadDataError(what, way_out=f"record {MIN_FRAMES} or more")
        saturated: NDArray[np.bool_] = np.asarray((frames >= saturation_count).any(axis=0))
        return cls(float(pressure_kpa), frames.mean(axis=0), saturated)


class ArrayFit(Record, eq=False):
    """Calibration of an array, fitted taxel by taxel."""

    calibration: ElementCalibration
    """Pressure = gain x counts + offset, which is what maps use; gain 0 for dead and hot taxels."""
    curvature_kpa_per_count2: FloatArray
    """(rows, columns) array: Curvature of a parabola through the same steps; 0 where there are too few. Maps do not
    use it; it shows how far the straight line is off.
    """
    dead: tuple[tuple[int, int], ...]
    hot: tuple[tuple[int, int], ...]  #: `dead`, `hot`: (row, column) of taxels that hardly answer, or far too much.
    nonuniformity: FloatArray
    """(steps,) array: SD of the calibrated pressure over the good taxels, as a share of the step's (NaN at 0)."""
    curved_nonuniformity: FloatArray  #: (steps,) array: The same with the parabolas.
    pressure_kpa: FloatArray  #: (steps,) array: Rising.


def fit_array(steps: Sequence[BladderStep], *, saturation_count: int) -> ArrayFit:
    """Fit a line (and a parabola) of pressure on counts for each taxel by least squares, without saturated steps."""
    ordered = sorted(steps, key=lambda step: step.pressure_kpa)
    pressure = np.array([step.pressure_kpa for step in ordered])
    if len(np.unique(pressure)) < 2:
        raise BadDataError("there are fewer than two different pressures", way_out="give two steps or more")
    counts = np.array([step.counts for step in ordered])
    valid = ~np.array([step.saturated for step in ordered])
    dead, hot = _odd_taxels(pressure, counts, valid)
    good = ~(dead | hot)
    use = valid & good
    levels = np.median(counts[:, good], axis=1)
    falls = np.diff(levels) < -FALL_SHARE * np.ptp(levels)
    if falls.any():
        first = int(falls.argmax())
        what = f"the array reads less at {pressure[first + 1]:g} kPa than at {pressure[first]:g}"
        raise BadDataError(what, way_out="check which step was recorded under which pressure")
    line = _polynomials(pressure, counts, use, degree=1)
    curve = _polynomials(pressure, counts, use, degree=2 if len(steps) >= STEPS_FOR_CURVATURE else 1)
    return ArrayFit(
        calibration=ElementCalibration(line[1], line[0], saturation_count=saturation_count),
        curvature_kpa_per_count2=curve[2],
        dead=_taxels_in(dead),
        hot=_taxels_in(hot),
        nonuniformity=_nonuniformity(line, pressure, counts, use),
        curved_nonuniformity=_nonuniformity(curve, pressure, counts, use),
        pressure_kpa=pressure,
    )


def _odd_taxels(
    pressure: FloatArray, counts: FloatArray, valid: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of dead and of hot taxels, by the slope of their counts on pressure."""
    weight = valid.astype(np.float64)
    number = np.maximum(weight.sum(axis=0), 1)
    x = pressure[:, None, None] - (weight * pressure[:, None, None]).sum(axis=0) / number
    spread = (weight * x * x).sum(axis=0)
    rise = (weight * x * counts).sum(axis=0) / np.where(spread > 0, spread, 1.0)
    enough = (valid.sum(axis=0) >= 2) & (spread > 0)
    if not enough.any() or not (typical := float(np.median(rise[enough]))) > 0:
        raise BadDataError("the array does not answer to pressure", way_out="check its cable and the bladder")
    dead = ~(rise > DEAD_SHARE * typical) & enough
    hot = (rise > HOT_RATIO * typical) | ~enough  # saturated in all steps but one
    return dead, hot & ~dead


def _polynomials(pressure: FloatArray, counts: FloatArray, use: NDArray[np.bool_], *, degree: int) -> FloatArray:
    """(3, rows, columns) coefficients of pressure in counts, lowest order first; zero with fewer than two steps."""
    result = np.zeros((3, *counts.shape[1:]))
    for row, column in np.argwhere(use.sum(axis=0) >= 2):
        chosen = use[:, row, column]
        order = min(degree, int(chosen.sum()) - 1)
        c, scale = counts[chosen, row, column], float(counts[chosen, row, column].max()) or 1.0
        matrix = np.vander(c / scale, order + 1, increasing=True)
        fitted = np.linalg.lstsq(matrix, pressure[chosen], rcond=None)[0]
        result[: order + 1, row, column] = fitted / scale ** np.arange(order + 1)
    return result


def _nonuniformity(
    coefficients: FloatArray, pressure: FloatArray, counts: FloatArray, use: NDArray[np.bool_]
) -> FloatArray:
    powers = np.arange(len(coefficients))[:, None, None]
    shares = np.full(len(pressure), np.nan)
    for i, (step, chosen) in enumerate(zip(counts, use, strict=True)):
        if pressure[i] > 0 and chosen.sum() > 1:
            kpa = (coefficients * step**powers).sum(axis=0)[chosen]
            shares[i] = float(kpa.std(ddof=1)) / pressure[i]
    return shares


def _taxels_in(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    return tuple((int(row), int(column)) for row, column in np.argwhere(mask))


# --- Test of a tracker's rotation convention (sensor to base, or inverse) by turning it about a fixed point.

LEAST_TURN_DEG: Final = 20.0
CLEAR: Final = 3.0  #: The wrong sense must fit this many times worse than the right one.


class RotationSense(Record):
    """Fit of a fixed point under each sense of rotation, and the angle by which the sensor was turned."""

    as_given_mm: float
    inverted_mm: float  #: `as_given_mm`, `inverted_mm`: Root mean square distance of the point from its mean.
    turn_deg: float  #: Largest rotation between two poses.

    def __str__(self) -> str:
        figures = f"the point stays within {self.as_given_mm:.2f} mm as given, {self.inverted_mm:.2f} mm inverted"
        if self.inverted_mm > CLEAR * self.as_given_mm:
            return f"{figures}: record as it is"
        if self.as_given_mm > CLEAR * self.inverted_mm:
            return f"{figures}: record with --invert-rotation"
        return f"{figures}: not clear; hold the point fixed and turn further, about two axes"


def rotation_sense(position_mm: FloatArray, quaternion_wxyz: FloatArray) -> RotationSense:
    """Fit a point that is fixed both in `base` and on the sensor, with the (n, 4) rotations as given and inverted.

    The point is at t on the sensor and at c in `base` with ``p + R t = c`` for every pose: six unknowns, least squares.
    Both fit a sensor that was hardly turned, which is refused.
    """
    if len(position_mm) < 10:
        raise BadDataError(f"{len(position_mm)} poses are too few", way_out="turn the sensor for some seconds")
    rotation = rotation_from_quaternion(quaternion_wxyz)
    traces = np.einsum("nij,ij->n", rotation, rotation[0])
    turn_deg = float(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max()))
    if turn_deg < LEAST_TURN_DEG:
        what = f"the sensor was turned by {turn_deg:.0f} degrees only"
        raise BadDataError(what, way_out=f"turn it by {LEAST_TURN_DEG:g} or more")
    as_given, inverted = (_fixed_point_rms_mm(position_mm, one) for one in (rotation, rotation.transpose(0, 2, 1)))
    return RotationSense(as_given, inverted, turn_deg)


def _fixed_point_rms_mm(position_mm: FloatArray, rotation: FloatArray) -> float:
    minus = np.broadcast_to(-np.eye(3), rotation.shape)
    matrix = np.concatenate([rotation, minus], axis=2).reshape(-1, 6)
    target = -position_mm.reshape(-1)
    solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
    rest = (matrix @ solution - target).reshape(-1, 3)
    return float(np.sqrt((rest**2).sum(axis=1).mean()))
