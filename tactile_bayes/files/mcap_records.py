"""MCAP, record by record and chunk by chunk."""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reading import MCAP_MAGIC, check_limit, not_a, open_input, unpacked_limit, unreadable

# --- Decompression of MCAP chunks within the declared and the total size limit.

_MOST_WINDOW: Final = 2**27


class Unpacker:
    """Unpacks chunks and counts the bytes that come out, against a limit that grows with the size of the file."""

    def __init__(self, file_bytes: int) -> None:
        self._most = unpacked_limit(file_bytes)
        self._unpacked = 0

    def count(self, number: int) -> None:
        """Add to the number of unpacked bytes."""
        self._unpacked += number
        check_limit(self._unpacked, self._most, what="it unpacks to {} bytes or more")

    def unpack(self, chunk: Any) -> bytes:
        """The records of a chunk; a damaged one raises exceptions of many kinds, which `damage` says in words."""
        data = self._decompress(chunk)
        if len(data) != chunk.uncompressed_size:
            raise ValueError(f"it holds {len(data)} bytes and declares {chunk.uncompressed_size}")
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise ValueError("its checksum does not match")
        return data

    def _decompress(self, chunk: Any) -> bytes:
        """The unpacked bytes, at most one more than the chunk declares."""
        most = chunk.uncompressed_size
        match chunk.compression:
            case "":
                return bytes(chunk.data)
            case "zstd":
                return self._zstd(chunk.data, most)
            case "lz4":
                import lz4.frame

                self.count(most)
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most + 1))
        raise ValueError(f"it is compressed by {chunk.compression[:20]!r}, which this program does not know")

    def _zstd(self, data: bytes, most: int) -> bytes:
        declared = zstandard.frame_content_size(data)  # -1 where the frame does not say
        if declared not in (-1, most):
            raise ValueError(f"its frame unpacks to {declared} bytes and it declares {most}")
        self.count(most)
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW)
        return decompressor.decompress(data, max_output_size=most) if most else b""


def damage(error: Exception) -> str:
    """Describe what is wrong with a chunk or a record, in a few words."""
    if type(error) is ValueError:
        return str(error)
    if type(error).__module__.startswith(("zstandard", "zstd", "lz4")):
        return "it cannot be decompressed"
    return f"its records make no sense: {' '.join(str(error).split())[:100] or type(error).__name__}"


# --- All records of an MCAP file, finished or not: intact chunks are kept and losses reported.

_RECORD: Final = struct.Struct("<BQ")  # opcode, length
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHECKSUM: Final = struct.Struct("<I")
# a schema or channel is an object each: it counts so many bytes, however short it is written
_DESCRIPTION_BYTES: Final = 1000
_KINDS: Final = {
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
}


class Messages:
    """Times of messages, and bodies if `keep`, without a Python object per message.

    Where a file has them in another order than that of time, which the MCAP specification allows, they are given by
    their log times.
    """

    def __init__(self, *, keep: bool = True) -> None:
        self._times = array("Q")
        self._logged = array("Q")
        self._ends = array("Q")
        self._data = bytearray()
        self.keep = keep

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time_ns: int, logged_ns: int, body: memoryview) -> None:
        """Add one message with its publish and log times."""
        self._times.append(time_ns)
        self._logged.append(logged_ns)
        if self.keep:
            self._data += body
            self._ends.append(len(self._data))

    def extend(self, other: Messages) -> None:
        """Add all messages of another channel."""
        start = len(self._data)
        self._times += other._times
        self._logged += other._logged
        self._data += other._data
        self._ends.extend(start + end for end in other._ends)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        return min(self._logged), max(self._logged)

    @property
    def times_ns(self) -> NDArray[np.uint64]:
        """Publish times in ns."""
        return np.array(self._times, dtype=np.uint64)[self._order()]

    def bodies(self) -> Iterator[bytes]:
        """The messages' bytes, one by one."""
        starts = [0, *self._ends[:-1]]
        with memoryview(self._data) as data:
            for i in self._order().tolist() if self._ends else ():
                yield bytes(data[starts[i] : self._ends[i]])

    def _order(self) -> NDArray[np.intp]:
        times = np.array(self._times, dtype=np.uint64)
        if (times[1:] >= times[:-1]).all():
            return np.arange(len(times))
        return np.argsort(np.array(self._logged, dtype=np.uint64), kind="stable")


@dataclass(slots=True)
class McapRecords:
    """Content of a file, as far as it could be read."""

    keep: Collection[str] | None = None
    """Topics whose messages are kept; of others only the times are. None keeps all."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    by_channel: dict[int, Messages] = field(default_factory=dict)  #: Messages by channel id.
    chunks: int = 0  #: Chunks met.
    last_ns: int = 0  #: Host time at which the last intact chunk, or message outside chunks, ends.
    all_data: bool = False  #: Every message was met, whatever follows.
    finished: bool = False  #: The file was closed properly.
    damaged: bool = False  #: A checksum failed or a record made no sense before the end.
    lost: list[str] = field(default_factory=list)  #: One line a loss.

    def messages(self, topic: str, *, schema: str, name: str | None = None) -> Messages:
        """Messages of a topic (and of channels with that `name` in their metadata). A channel of another type is an
        error.
        """
        found = Messages()
        for number, channel in self.channels.items():
            if channel.topic != topic or (name is not None and channel.metadata.get("name") != name):
                continue
            kind = self.schemas.get(channel.schema_id, "messages without a schema")
            if kind != schema:
                raise BadDataError(f"{topic} holds {kind}", way_out=f"its channel must have the schema {schema}")
            held = self.by_channel.get(number, Messages())
            if not len(found):
                found = held
            elif len(held):
                _refuse_overlap(topic, found.span_ns, held.span_ns, named=name is not None)
                found.extend(held)
        return found

    def topic_counts(self) -> dict[str, int]:
        """Number of messages per topic."""
        counts: Counter[str] = Counter()
        for number, channel in self.channels.items():
            counts[channel.topic] += len(self.by_channel.get(number, ()))
        return dict(sorted(counts.items()))

    def channel_messages(self, number: int) -> Messages:
        """Messages of a channel; bodies of unknown channels are kept until the channel is defined."""
        found = self.by_channel.get(number)
        if found is None:
            channel = self.channels.get(number)
            keep = self.keep is None or channel is None or channel.topic in self.keep
            found = self.by_channel[number] = Messages(keep=keep)
        return found


def _refuse_overlap(topic: str, one: tuple[int, int], other: tuple[int, int], *, named: bool) -> None:
    """Refuse two channels of one topic at the same time: one after the other are one recording."""
    if not named and one[0] <= other[1] and other[0] <= one[1]:
        what = f"{topic} has messages on two channels at the same time, as of two heads or two trackers"
        raise BadDataError(what, way_out="keep one of the channels, or one topic for each")


def read_records(path: Path, *, keep: Collection[str] | None = None) -> McapRecords:
    """Read a file from front to back, with or without its index; of topics not in `keep` only the times, None keeps
    all.
    """
    records = McapRecords(keep=keep)
    with open_input(path) as stream:
        try:
            _check_magic(stream, path)
            size = stream.seek(0, io.SEEK_END)
            stream.seek(len(MCAP_MAGIC))
            _collect(records, stream, size=size)
        except OSError as error:
            raise unreadable(path, error) from None
        except BadDataError as error:
            raise error.at(path) from None
    return records


def _check_magic(stream: IO[bytes], path: Path) -> None:
    start = stream.read(len(MCAP_MAGIC))
    if start == MCAP_MAGIC:
        return
    if MCAP_MAGIC.startswith(start):
        what = "is empty" if not start else f"is cut off in its header ({len(start)} bytes)"
    else:
        what = f"is not an MCAP file (it starts with {start!r})"
    raise not_a(path, "a scan", what=what, way_out="give a scan from `record`, `import` or `simulate`")


def _collect(records: McapRecords, stream: IO[bytes], *, size: int) -> None:
    """Fill `records` up to the end of the file or the first unreadable record."""
    unpacker = Unpacker(size)
    checksum = zlib.crc32(MCAP_MAGIC)
    while True:
        start = stream.tell()
        head = stream.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (1, 0)
        if opcode == 0 or length > size:
            _tell_damage(records, start, size=size)
            return
        body = stream.read(length)
        if len(head) < _RECORD.size or len(body) < length:
            _tell_cut(records, size=size)
            return
        if opcode == Opcode.DATA_END:
            _end_data(records, body, checksum)
        if opcode == Opcode.FOOTER:
            records.finished = stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC
            if not records.finished:
                _tell_cut(records, size=size)
            return
        if not records.all_data:
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
        if opcode == Opcode.MESSAGE:
            _take_message(records, body, start=start)
        elif opcode in _KINDS:
            _take(records, opcode, body, start=start, unpacker=unpacker)


def _end_data(records: McapRecords, body: bytes, checksum: int) -> None:
    """Compare the checksum over the whole data section, where there is one."""
    declared = _CHECKSUM.unpack_from(body)[0] if len(body) >= _CHECKSUM.size else 0
    if declared not in (0, checksum):
        if not records.damaged:  # a damaged chunk was told already; otherwise it is a description
            records.lost.append("a record outside the chunks changed (the checksum of the whole does not match)")
        records.damaged = True
    records.all_data = True


def _tell_cut(records: McapRecords, *, size: int) -> None:
    if records.all_data:
        records.lost.append("the end of the file is missing; all messages are there")
    else:
        records.lost.append(f"cut off at byte {size}: everything after {records.last_ns / 1e9:.3f} s is lost")


def _tell_damage(records: McapRecords, position: int, *, size: int) -> None:
    if records.all_data:
        records.lost.append("the end of the file is damaged; all messages are there")
        return
    records.damaged = True
    records.lost.append(f"unreadable from byte {position} of {size} on (no record begins there)")


def _take(records: McapRecords, opcode: int, body: bytes, *, start: int, unpacker: Unpacker) -> None:
    """Keep one record from outside the chunks, or note that it is invalid."""
    try:
        record = _KINDS[Opcode(opcode)].read(ReadDataStream(io.BytesIO(body)))
    except Exception as error:  # struct.error, EndOfFile, UnicodeDecodeError...
        records.damaged = True
        records.lost.append(f"the record at byte {start} makes no sense ({damage(error)})")
        return
    if isinstance(record, Chunk):
        records.chunks += 1
        _take_chunk(records, record, unpacker)
    else:
        _describe(records, record)


def _take_message(records: McapRecords, body: bytes, *, start: int) -> None:
    """Keep a message that is in no chunk, as writers leave it that do not index their files."""
    if len(body) < _MESSAGE.size:
        records.damaged = True
        records.lost.append(f"the record at byte {start} makes no sense (a message is shorter than its head)")
        return
    channel, _, logged_ns, publish_ns = _MESSAGE.unpack_from(body)
    records.last_ns = max(records.last_ns, logged_ns)
    with memoryview(body) as view:
        records.channel_messages(channel).add(publish_ns, logged_ns, view[_MESSAGE.size :])


def _describe(records: McapRecords, record: Any) -> None:
    match record:
        case Metadata():
            records.metadata[record.name] = dict(record.metadata)
        case Attachment():
            records.attachments[record.name] = record.data
        case Schema():
            records.schemas[record.id] = record.name
        case Channel():
            records.channels[record.id] = record


def _take_chunk(records: McapRecords, chunk: Any, unpacker: Unpacker) -> None:
    """Keep all messages of a chunk; none when it is damaged."""
    try:
        data = unpacker.unpack(chunk)
        descriptions, spans = _split(data, unpacker)
    except BadDataError:  # over a limit
        raise
    except Exception as error:  # each decompressor has an error class of its own, and so have records
        start, end = chunk.message_start_time / 1e9, chunk.message_end_time / 1e9
        records.lost.append(f"chunk {records.chunks}, {start:.3f} to {end:.3f} s: {damage(error)}")
        records.damaged = True
        return
    records.last_ns = max(records.last_ns, chunk.message_end_time)
    for record in descriptions:
        _describe(records, record)
    with memoryview(data) as view:
        for channel, time_ns, logged_ns, start, end in spans:
            records.channel_messages(channel).add(time_ns, logged_ns, view[start:end])


def _split(data: bytes, unpacker: Unpacker) -> tuple[list[Any], list[tuple[int, int, int, int, int]]]:
    """Schemas and channels of a chunk, and its messages: channel, publish and log time, start, end."""
    descriptions, spans = [], []
    offset = 0
    while offset < len(data):
        opcode, size = _RECORD.unpack_from(data, offset)
        start = offset + _RECORD.size
        offset = start + size
        if offset > len(data):
            raise ValueError("a record ends beyond it")
        if opcode == Opcode.MESSAGE:
            if size < _MESSAGE.size:
                raise ValueError("a message is shorter than its head")
            channel, _, logged_ns, publish_ns = _MESSAGE.unpack_from(data, start)
            spans.append((channel, publish_ns, logged_ns, start + _MESSAGE.size, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            unpacker.count(_DESCRIPTION_BYTES)
            descriptions.append(_KINDS[Opcode(opcode)].read(ReadDataStream(io.BytesIO(data[start:offset]))))
    return descriptions, spans
