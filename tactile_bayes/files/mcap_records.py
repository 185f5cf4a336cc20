"""Reading of MCAP files, record by record; damaged and unfinished ones too."""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from numpy.typing import NDArray

from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files.reading import MCAP_MAGIC, SCAN, check_limit, open_input, readable, unpacked_limit, wrong_kind

# --- Decompression of MCAP chunks within the declared and the total size limit.

_MOST_WINDOW: Final = 2**27


def decompress_chunk(chunk: Any, *, count: Callable[[int], None]) -> bytes:
    """Decompressed records of a chunk; `count` gets their size first, and no more than one byte beyond it is made.

    A damaged chunk raises exceptions of many kinds, which `describe_damage` puts into words.
    """
    packing, data, most = chunk.compression, bytes(chunk.data), chunk.uncompressed_size
    if packing == "zstd":
        declared = zstandard.frame_content_size(data)  # -1 where the frame does not say
        if declared not in (-1, most):
            raise ValueError(f"its frame unpacks to {declared} bytes and it declares {most}")
        count(most)
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW)
        data = decompressor.decompress(data, max_output_size=most) if most else b""
    elif packing == "lz4":
        import lz4.frame

        count(most)
        data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1))
    elif packing != "":
        raise ValueError(f"it is compressed by {packing[:20]!r}, which this program does not know")
    if len(data) != most:
        raise ValueError(f"it holds {len(data)} bytes and declares {most}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("its checksum does not match")
    return data


def describe_damage(error: Exception) -> str:
    """Fault of a chunk or a record, in a few words."""
    if type(error) is ValueError:
        return str(error)
    if type(error).__module__.startswith(("zstandard", "zstd", "lz4")):
        return "it cannot be decompressed"
    return f"its records make no sense: {' '.join(str(error).split())[:100] or type(error).__name__}"


# --- All records of an MCAP file, finished or not: intact chunks are kept and losses reported.

_RECORD: Final = struct.Struct("<BQ")  # opcode, length
_LONGEST: Final = 2**32  #: No record is longer; one that is longer than its file was cut off.
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHECKSUM: Final = struct.Struct("<I")
# a schema or channel is an object each: it counts so many bytes, however short it is written
_DESCRIPTION_BYTES: Final = 1000
_DESCRIPTIONS: Final = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
_KINDS: Final = {Opcode.CHUNK: Chunk, Opcode.METADATA: Metadata, Opcode.ATTACHMENT: Attachment, **_DESCRIPTIONS}


class Messages:
    """Times of messages, and their bodies with `keep`, in a few buffers: no Python object per message.

    Where a file has them in another order than that of time, which the MCAP specification allows, they are given by
    their log times.
    """

    def __init__(self, *, keep: bool = True) -> None:
        self._times = array("Q")
        self.logged = array("Q")
        self._ends = array("Q")
        self._data = bytearray()
        self.keep = keep

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time_ns: int, logged_ns: int, body: memoryview) -> None:
        self._times.append(time_ns)
        self.logged.append(logged_ns)
        if self.keep:
            self._data += body
            self._ends.append(len(self._data))

    def extend(self, other: Messages) -> None:
        start = len(self._data)
        self._times += other._times
        self.logged += other.logged
        self._data += other._data
        self._ends.extend(start + end for end in other._ends)

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
        return np.argsort(np.array(self.logged, dtype=np.uint64), kind="stable")


@dataclass(slots=True)
class McapRecords:
    """Content of an MCAP file, as far as it could be read."""

    keep: Collection[str]  #: Topics whose messages are kept; of others only the times are.
    most_bytes: int  #: Limit of what its chunks unpack to.
    unpacked_bytes: int = 0
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
        """Messages of a topic, or of its channels with this `name` in their metadata; another type is an error."""
        messages = Messages()
        for number, channel in self.channels.items():
            if channel.topic != topic or (name is not None and channel.metadata.get("name") != name):
                continue
            kind = self.schemas.get(channel.schema_id, "messages without a schema")
            if kind != schema:
                raise BadDataError(f"{topic} holds {kind}", way_out=f"its channel must have the schema {schema}")
            more = self.by_channel.get(number, Messages())
            if not len(messages):
                messages = more
            elif len(more):
                (a, b), (c, d) = ((min(one.logged), max(one.logged)) for one in (messages, more))
                if name is None and a <= d and c <= b:  # one after the other they are one recording
                    what = f"{topic} has messages on two channels at the same time, as of two heads or two trackers"
                    raise BadDataError(what, way_out="keep one of the channels, or one topic for each")
                messages.extend(more)
        return messages

    def count(self, unpacked_bytes: int) -> None:
        """Add to the unpacked bytes; more than the limit in all is refused."""
        self.unpacked_bytes += unpacked_bytes
        check_limit(self.unpacked_bytes, self.most_bytes, what="it unpacks to {} bytes or more")

    def add_loss(self, what: str, *, damaged: bool = True) -> None:
        self.lost.append(what)
        self.damaged |= damaged

    def add(self, record: Any, data: memoryview) -> None:
        """Add a record of `_parse_record`; of a message it has the place in `data`."""
        match record:
            case number, published_ns, logged_ns, start, end:
                if number not in self.by_channel:  # bodies of an unknown channel are kept until it is defined
                    channel = self.channels.get(number)
                    keep = channel is None or channel.topic in self.keep
                    self.by_channel[number] = Messages(keep=keep)
                self.by_channel[number].add(published_ns, logged_ns, data[start:end])
            case Metadata():
                self.metadata[record.name] = dict(record.metadata)
            case Attachment():
                self.attachments[record.name] = record.data
            case Schema():
                self.schemas[record.id] = record.name
            case Channel():
                self.channels[record.id] = record


def read_records(path: Path, *, keep: Collection[str]) -> McapRecords:
    """Read a file from front to back, with or without its index; of topics not in `keep` only the times."""
    with open_input(path) as stream, in_file(path), readable(path):
        _check_magic(stream, path)
        size = stream.seek(0, io.SEEK_END)
        records = McapRecords(keep, unpacked_limit(size))
        stream.seek(len(MCAP_MAGIC))
        _collect(records, stream, size=size)
    return records


def _check_magic(stream: IO[bytes], path: Path) -> None:
    start = stream.read(len(MCAP_MAGIC))
    if start == MCAP_MAGIC:
        return
    if MCAP_MAGIC.startswith(start):
        what = "is empty" if not start else f"is cut off in its header ({len(start)} bytes)"
    else:
        what = f"is not an MCAP file (it starts with {start!r})"
    raise wrong_kind(path, SCAN, what=what, way_out="give a scan from `record`, `import` or `simulate`")


def _collect(records: McapRecords, stream: IO[bytes], *, size: int) -> None:
    """Fill `records` up to the end of the file or the first unreadable record."""
    checksum = zlib.crc32(MCAP_MAGIC)
    while True:
        start = stream.tell()
        head = stream.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (1, 0)
        if opcode == 0 or length > max(size, _LONGEST):
            if records.all_data:
                records.add_loss("the end of the file is damaged; all messages are there", damaged=False)
            else:
                records.add_loss(f"unreadable from byte {start} of {size} on (no record begins there)")
            return
        body = stream.read(min(length, size))
        complete = len(head) == _RECORD.size and len(body) == length
        if complete and opcode == Opcode.DATA_END:
            declared = _CHECKSUM.unpack_from(body)[0] if length >= _CHECKSUM.size else 0
            if declared not in (0, checksum) and not records.damaged:  # a damaged chunk was told already
                records.add_loss("a record outside the chunks changed (the checksum of the whole does not match)")
            records.all_data = True
        if complete and opcode == Opcode.FOOTER:
            complete = records.finished = stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC
            if complete:
                if (end := stream.tell()) < size and stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
                    records.add_loss(f"another file was joined to it at byte {end} of {size}: it is not read")
                return
        if not complete:
            loss = f"cut off at byte {size}: everything after {records.last_ns / 1e9:.3f} s is lost"
            loss_of_end = "the end of the file is missing; all messages are there"
            records.add_loss(loss_of_end if records.all_data else loss, damaged=False)
            return
        if not records.all_data:
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
        try:
            record = _parse_record(opcode, body)
        except Exception as error:  # struct.error, EndOfFile, UnicodeDecodeError...
            records.add_loss(f"the record at byte {start} makes no sense ({describe_damage(error)})")
            continue
        if isinstance(record, Chunk):
            records.chunks += 1
            _add_chunk(records, record)
        elif record is not None:
            if opcode == Opcode.MESSAGE:  # in no chunk, as writers leave it that do not index their files
                records.last_ns = max(records.last_ns, record[2])
            records.add(record, memoryview(body))


def _parse_record(opcode: int, data: bytes, start: int = 0, end: int | None = None) -> Any:
    """A record; of a message channel, publish time, log time, and start and end of its body; None for other records."""
    end = len(data) if end is None else end
    if opcode == Opcode.MESSAGE:
        if end - start < _MESSAGE.size:
            raise ValueError("a message is shorter than its head")
        channel, _, logged_ns, published_ns = _MESSAGE.unpack_from(data, start)
        return channel, published_ns, logged_ns, start + _MESSAGE.size, end
    return _KINDS[Opcode(opcode)].read(ReadDataStream(io.BytesIO(data[start:end]))) if opcode in _KINDS else None


def _add_chunk(records: McapRecords, chunk: Any) -> None:
    """Add the records of a chunk; of a damaged one none, which is a loss."""
    try:
        data = decompress_chunk(chunk, count=records.count)
        contents = list(_records_of_chunk(data, records))
    except BadDataError:  # over a limit
        raise
    except Exception as error:  # each decompressor has an error class of its own, and so have records
        start, end = chunk.message_start_time / 1e9, chunk.message_end_time / 1e9
        records.add_loss(f"chunk {records.chunks}, {start:.3f} to {end:.3f} s: {describe_damage(error)}")
        return
    records.last_ns = max(records.last_ns, chunk.message_end_time)
    for record in contents:
        records.add(record, memoryview(data))


def _records_of_chunk(data: bytes, records: McapRecords) -> Iterator[Any]:
    """Schemas, channels and messages of a chunk, as `_parse_record` gives them."""
    offset = 0
    while offset < len(data):
        opcode, size = _RECORD.unpack_from(data, offset)
        start = offset + _RECORD.size
        offset = start + size
        if offset > len(data):
            raise ValueError("a record ends beyond it")
        if opcode in _DESCRIPTIONS:
            records.count(_DESCRIPTION_BYTES)
        if opcode == Opcode.MESSAGE or opcode in _DESCRIPTIONS:
            yield _parse_record(opcode, data, start, offset)
