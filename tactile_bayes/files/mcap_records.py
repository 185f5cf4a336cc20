"""All records of an MCAP file, finished or not: every intact chunk is kept and every loss is told."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import unreadable
from tactile_bayes.files.kinds import not_a

_MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD: Final = struct.Struct("<BQ")  # opcode, length
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(slots=True)
class McapRecords:
    """What a file held, as far as it could be read.

    Parameters
    ----------
    bodies
        By channel id, (publish time in ns, message bytes) in file order.
    chunks, last_ns
        Chunks met, and the host time at which the last intact one ends.
    all_data
        Every message was met, whatever follows.
    finished
        The file was closed properly.
    damaged
        A checksum failed or a record made no sense before the end.
    lost
        One line a loss.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    bodies: dict[int, list[tuple[int, bytes]]] = field(default_factory=dict)
    chunks: int = 0
    last_ns: int = 0
    all_data: bool = False
    finished: bool = False
    damaged: bool = False
    lost: list[str] = field(default_factory=list)

    def messages(self, topic: str, *, schema: str, name: str | None = None) -> list[tuple[int, bytes]]:
        """Messages of a topic (and of the channel with that `name` in its metadata) as (publish time, bytes).

        Raises
        ------
        BadDataError
            When a channel of the topic holds another type.
        """
        found = []
        for number, channel in self.channels.items():
            if channel.topic != topic or (name is not None and channel.metadata.get("name") != name):
                continue
            kind = self.schemas.get(channel.schema_id, "no schema")
            if kind != schema:
                raise BadDataError(f"{topic} holds {kind}", way_out=f"it must hold {schema}")
            found += self.bodies.get(number, [])
        return found

    def topic_counts(self) -> dict[str, int]:
        """Messages by topic."""
        counts: Counter[str] = Counter()
        for number, channel in self.channels.items():
            counts[channel.topic] += len(self.bodies.get(number, []))
        return dict(sorted(counts.items()))


def read_records(path: Path) -> McapRecords:
    """Read a file from front to back, with or without its index.

    Raises
    ------
    BadDataError
        When the file cannot be opened or is no MCAP file.
    """
    records = McapRecords()
    try:
        with path.open("rb") as stream:
            _check_magic(stream, path)
            size = stream.seek(0, io.SEEK_END)
            stream.seek(0)
            _collect(records, stream, size=size)
    except OSError as error:
        raise unreadable(path, error) from None
    return records


def _check_magic(stream: IO[bytes], path: Path) -> None:
    start = stream.read(len(_MAGIC))
    if start == _MAGIC:
        return
    if _MAGIC.startswith(start):
        what = "is empty" if not start else f"is cut off in its header ({len(start)} bytes)"
    else:
        what = f"is not an MCAP file (it starts with {start!r})"
    raise not_a(path, "a scan", what=what, way_out="give a scan from `record`, `import` or `simulate`")


def _collect(records: McapRecords, stream: IO[bytes], *, size: int) -> None:
    """Fill `records` up to the end of the file or the first record that cannot be read."""
    iterator = _records_of(stream, size=size, from_start=True)
    while True:
        try:
            record = next(iterator, None)
        except CRCValidationError:
            # The checksum over everything. A damaged chunk was told already; otherwise it is a description.
            if not records.damaged:
                records.lost.append("a record outside the chunks changed (the checksum of the whole does not match)")
            records.damaged = records.all_data = True
            iterator = _records_of(stream, size=size, from_start=False)
        except (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError) as error:
            _tell_end(records, stream.tell(), size=size, error=error)
            return
        else:
            if record is None:
                records.finished = True  # the reader stops only after a footer and the closing magic
                return
            _take(records, record)


def _records_of(stream: IO[bytes], *, size: int, from_start: bool) -> Iterator[Any]:
    """Records from here on; without the opening magic, the whole has no checksum to fail again."""
    reader = StreamReader(
        stream, skip_magic=not from_start, emit_chunks=True, validate_crcs=from_start, record_size_limit=size
    )
    return iter(reader.records)


def _tell_end(records: McapRecords, position: int, *, size: int, error: Exception) -> None:
    if records.all_data:
        records.lost.append("the end of the file is missing; all messages are there")
    elif position >= size:
        records.lost.append(f"cut off at byte {size}: everything after {records.last_ns / 1e9:.3f} s is lost")
    else:
        records.damaged = True
        why = str(error) or type(error).__name__
        records.lost.append(f"unreadable from byte {position} of {size} on ({why})")


def _take(records: McapRecords, record: Any) -> None:
    match record:
        case Chunk():
            records.chunks += 1
            _take_chunk(records, record)
        case Metadata():
            records.metadata[record.name] = dict(record.metadata)
        case Attachment():
            records.attachments[record.name] = record.data
        case Schema():
            records.schemas[record.id] = record.name
        case Channel():
            records.channels[record.id] = record
        case DataEnd():
            records.all_data = True


def _take_chunk(records: McapRecords, chunk: Any) -> None:
    """Keep a chunk's messages, or none of them when its checksum fails."""
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(length)
    except Exception as error:  # each decompressor has an error class of its own
        start, end = chunk.message_start_time / 1e9, chunk.message_end_time / 1e9
        why = "its checksum does not match" if isinstance(error, CRCValidationError) else "it cannot be decompressed"
        records.lost.append(f"chunk {records.chunks}, {start:.3f} to {end:.3f} s: {why}")
        records.damaged = True
        return
    records.last_ns = max(records.last_ns, chunk.message_end_time)
    offset = 0
    while offset < len(data):
        opcode, size = _RECORD.unpack_from(data, offset)
        start = offset + _RECORD.size
        offset = start + size
        if opcode == Opcode.MESSAGE:
            channel, _, _, publish_ns = _MESSAGE.unpack_from(data, start)
            records.bodies.setdefault(channel, []).append((publish_ns, data[start + _MESSAGE.size : offset]))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            _take(records, kind.read(ReadDataStream(io.BytesIO(data[start:offset]))))
