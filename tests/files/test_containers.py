"""Files by the promise of their format, not by the habits of one writer: MCAP, netCDF, JSON, text by its encoding."""

from __future__ import annotations

import codecs
import errno
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import tactile_bayes
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.column_map import read_mapping, read_wide, read_wide_excision
from tactile_bayes.files.documents import load_json, load_toml
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.files.tables import read_table
from tactile_bayes.mapping.build import build_map
from tactile_bayes.scans import Scan

DEMO = Path(tactile_bayes.__file__).parent / "demo" / "scan.mcap"


def rewritten(
    path: Path, arrange: Any = list, *, chunked: bool = True, second: bool = False, bare: bool = False
) -> Path:
    """The demo's scan by the reference writer: other places of messages, without chunks, on a second channel..."""
    with DEMO.open("rb") as stream, path.open("wb") as out:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        writer = Writer(out, use_chunking=chunked, compression=CompressionType.LZ4)
        writer.start(profile="", library="another")
        for kept in reader.iter_metadata():
            writer.add_metadata(kept.name, kept.metadata)
        for part in reader.iter_attachments():
            writer.add_attachment(part.create_time, part.log_time, part.name, part.media_type, part.data)
        writer.add_attachment(0, 0, "notes.txt", "text/plain", b"of another program")
        schemas = {
            key: writer.register_schema(one.name, one.encoding, one.data) for key, one in summary.schemas.items()
        }
        channels = {}
        for key, one in summary.channels.items():
            kind = 0 if bare and one.topic == "/pressure" else schemas[one.schema_id]
            channels[key] = [writer.register_channel(one.topic, one.message_encoding, kind, one.metadata)]
            if second and one.topic == "/pressure":
                channels[key].append(writer.register_channel(one.topic, one.message_encoding, kind, one.metadata))
        camera = writer.register_channel("/camera", "json", 0)
        writer.add_message(camera, 1, b"{}", 1)
        messages = [(message, channel) for _, channel, message in reader.iter_messages(log_time_order=False)]
        for number, (message, channel) in enumerate(arrange(messages)):
            chosen = channels[channel.id][number % len(channels[channel.id])]
            writer.add_message(chosen, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
    return path


def shuffled(messages: list[Any]) -> list[Any]:
    return random.Random(1).sample(messages, len(messages))


def by_topic(messages: list[Any]) -> list[Any]:
    return sorted(messages, key=lambda one: one[1].topic)


@pytest.fixture(scope="module")
def demo() -> Scan:
    return read_scan(DEMO)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("arrange", [list, shuffled, by_topic])
def test_the_order_of_messages_and_chunks_are_the_writers_matter(
    demo: Scan, tmp_path: Path, arrange: Any, chunked: bool
) -> None:
    file = read_scan_report(rewritten(tmp_path / "a.mcap", arrange, chunked=chunked))
    assert file.complete
    np.testing.assert_array_equal(file.scan.frames.counts, demo.frames.counts)
    np.testing.assert_array_equal(file.scan.frames.time_s, demo.frames.time_s)
    np.testing.assert_array_equal(file.scan.poses.quaternion_wxyz, demo.poses.quaternion_wxyz)


def test_what_is_whole_of_an_unchunked_file_is_kept(demo: Scan, tmp_path: Path) -> None:
    data = rewritten(tmp_path / "a.mcap", chunked=False).read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: len(data) // 2])
    file = read_scan_report(tmp_path / "b.mcap")
    assert not file.complete
    number = len(file.scan.frames)
    assert 300 < number < 400
    np.testing.assert_array_equal(file.scan.frames.counts, demo.frames.counts[:number])


def test_two_channels_at_the_same_time_are_no_scan(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match=r"/pressure has messages on two channels at the same time.*keep one"):
        read_scan(rewritten(tmp_path / "a.mcap", second=True))


def test_a_channel_that_was_registered_again_goes_on(demo: Scan, tmp_path: Path) -> None:
    """As after a restart of the writer: the second channel begins where the first ends."""

    def first_then_second(messages: list[Any]) -> list[Any]:
        frames = [one for one in messages if one[1].topic == "/pressure"]
        others = [one for one in messages if one[1].topic != "/pressure"]
        mixed = [one for pair in zip(frames[:350], frames[350:], strict=True) for one in pair]
        return mixed + others  # even places go to the first channel, odd ones to the second

    found = read_scan(rewritten(tmp_path / "a.mcap", first_then_second, second=True))
    np.testing.assert_array_equal(found.frames.counts, demo.frames.counts)


def test_a_channel_without_a_schema_is_named(tmp_path: Path) -> None:
    words = "/pressure holds messages without a schema; its channel must have the schema foxglove.Grid"
    with pytest.raises(BadDataError, match=words):
        read_scan(rewritten(tmp_path / "a.mcap", bare=True))


# --- netCDF.


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_a_map_that_xarray_wrote_again_is_the_map(demo: Scan, tmp_path: Path, engine: str) -> None:
    with warnings.catch_warnings(action="ignore"):
        xarray = pytest.importorskip("xarray")
    made = build_map([demo], cell_mm=2.0)
    write_map(tmp_path / "map.nc", made, provenance=Provenance("map", {}))
    tree = xarray.open_datatree(tmp_path / "map.nc", engine=engine)
    tree.to_netcdf(tmp_path / "again.nc", engine=engine)
    np.testing.assert_array_equal(read_map(tmp_path / "again.nc").mean, made.mean)
    with xarray.open_dataset(tmp_path / "map.nc", engine=engine) as opened:
        opened.load().to_netcdf(tmp_path / "3.nc", format="NETCDF3_64BIT", engine="scipy")
    with pytest.raises(BadDataError, match=r"is a netCDF-3 file.*nccopy -k nc4"):
        read_map(tmp_path / "3.nc")


# --- Text.

TEXT = '{"patient": "Größe"}'
ENCODED = {
    "UTF-16 text": TEXT.encode("utf-16"),
    "UTF-16 \\(without a byte order mark\\) text": TEXT.encode("utf-16-le"),
    "UTF-32 text": TEXT.encode("utf-32"),
    "byte 0xf6 is not UTF-8 text; save it as": TEXT.encode("latin-1"),
    "byte 0xf4 is not UTF-8": bytes(9) + b"\xf4",
}


@pytest.mark.parametrize("data", [TEXT.encode(), codecs.BOM_UTF8 + TEXT.encode()])
def test_utf_8_is_read_with_and_without_its_mark(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.json").write_bytes(data)
    assert load_json(tmp_path / "a.json") == {"patient": "Größe"}
    (tmp_path / "a.toml").write_bytes(data.replace(b"{", b"").replace(b"}", b"").replace(b'"patient":', b"patient ="))
    assert load_toml(tmp_path / "a.toml", way_out="") == {"patient": "Größe"}


@pytest.mark.parametrize(("words", "data"), ENCODED.items())
def test_text_of_another_encoding_is_named(tmp_path: Path, words: str, data: bytes) -> None:
    (tmp_path / "a").write_bytes(data)
    for read in (lambda path: load_json(path), lambda path: load_toml(path, way_out="x")):
        with pytest.raises(BadDataError, match=words):
            read(tmp_path / "a")
    with pytest.raises(BadDataError, match=words):
        read_table(tmp_path / "a", "trial.table.json")


COMPOSED, APART = "M\u00fcller", "Mu\u0308ller"  # one name as one character, and as two
MAPPING = f"""
patient = "Kennung {APART}"
[[reading]]
modality = "ultrasound"
size = "Gr\u00f6\u00dfe"
[excision]
size = "Pr\u00e4parat"
"""


def test_a_name_spelled_in_two_ways_is_one_column_and_one_patient(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(MAPPING)
    text = f"Kennung {COMPOSED},Gro\u0308\u00dfe,Pra\u0308parat\n{APART},12,13\n"
    (tmp_path / "wide.csv").write_text(text)
    mapping = read_mapping(tmp_path / "map.toml")
    assert mapping.reading is not None
    assert mapping.excision is not None
    for table in (
        read_wide(tmp_path / "wide.csv", mapping, mapping.reading),
        read_wide_excision(tmp_path / "wide.csv", mapping, mapping.excision),
    ):
        assert table.columns["patient"] == [COMPOSED]
    (tmp_path / "twice.csv").write_text(f"{text}{COMPOSED},12,13\n")
    with pytest.raises(BadDataError, match="stands on line 2 already"):
        read_wide(tmp_path / "twice.csv", mapping, mapping.reading)
    row = "1,ultrasound,1,detected,12"
    (tmp_path / "tidy.csv").write_text(
        f"patient,mass,modality,replicate,status,size_mm\n{COMPOSED},{row}\n{APART},{row}\n"
    )
    with pytest.raises(BadDataError, match="stands on line 2 already"):
        read_table(tmp_path / "tidy.csv", "trial.table.json")


# --- A way out is that of what was found.


def test_a_copy_without_its_attachments_is_not_to_be_scanned_again(tmp_path: Path) -> None:
    with DEMO.open("rb") as stream, (tmp_path / "a.mcap").open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out)
        writer.start(profile="", library="another")
        for kept in reader.iter_metadata():
            writer.add_metadata(kept.name, kept.metadata)
        writer.finish()
    with pytest.raises(BadDataError, match=r"holds no head\.json; attach it again: the program that wrote this copy"):
        read_scan(tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("number", "way_out"),
    [
        (errno.ENOENT, "check the path"),
        (errno.EACCES, "ask for the right to read it"),
        (errno.EMFILE, "close other programs"),
        (errno.EIO, "copy it to another disk"),
    ],
)
def test_a_file_that_cannot_be_opened_has_the_way_out_of_its_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, way_out: str
) -> None:
    def refuse(*_: object, **__: object) -> int:
        raise OSError(number, "no")

    monkeypatch.setattr("tactile_bayes.files.reading.os.open", refuse)
    with pytest.raises(BadDataError, match=way_out):
        load_json(tmp_path / "a.json")
