"""Files made to hurt: each is refused in one line, within little memory, and nothing waits for a FIFO or a device."""

from __future__ import annotations

import json
import os
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import hostile
import numpy as np
import pytest
from map_files import read_grid

from tactile_bayes.actions.show import describe
from tactile_bayes.api.settings import read_settings
from tactile_bayes.batch import open_store
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.arrays_layout import Stated
from tactile_bayes.files.column_map import read_mapping, read_wide
from tactile_bayes.files.documents import parse_toml, read_protocol
from tactile_bayes.files.estimate_json import read_stated_size
from tactile_bayes.files.imports import read_arrays
from tactile_bayes.files.instrument import read_landmarks, read_scene
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.npz import CheckpointFile
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.files.scan_text import read_poses
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.tables import read_table
from tactile_bayes.inference.ensemble import ChainState

PACKAGE = Path(__file__).resolve().parents[2] / "tactile_bayes"
SCAN = PACKAGE / "demo" / "scan.mcap"
MOST_BYTES = 300 * 10**6
Read = Callable[[Path], object]


def _grid(path: Path) -> object:
    return read_grid(path, spacing_mm=1.0)


@pytest.fixture
def little_memory():
    """What this process may take is little more than it has: who allocates a bomb fails here, not on the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def _mcap_bomb() -> bytes:
    """Chunks of a megabyte that are packed to almost nothing, together over the limit."""
    record = struct.pack("<BQ", 0x20, 10**6) + bytes(10**6)
    return hostile.mcap_with(SCAN.read_bytes(), *[hostile.mcap_chunk(record)] * 400)


BOMBS: dict[str, tuple[str, Callable[[], bytes], Read, str]] = {
    "an MCAP of packed zeros": (".mcap", _mcap_bomb, read_scan, "unpacks to .* bytes or more, over the limit"),
    "an npz of packed zeros": (
        ".npz",
        lambda: hostile.npz_of({"mean": hostile.npy("(10000, 10000)", bytes(2 * 10**8))}),
        _grid,
        "its arrays unpack to .* over the limit of .*TACTILE_BAYES_LIMITS=",
    ),
    "an npz that declares 10^12 values": (".npz", hostile.full_npz, _grid, r"mean declares 8,000,000,000,000 bytes"),
    "an image of 20,000 x 20,000": (".png", lambda: hostile.png(20_000, 20_000), _grid, "400,000,000 pixels, over"),
    "an encrypted npz": (".npz", hostile.encrypted_npz, _grid, "mean is encrypted"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", BOMBS)
def test_a_bomb_is_refused_before_memory_is_taken(case: str, tmp_path: Path, request) -> None:
    suffix, make, read, message = BOMBS[case]
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes(make())
    request.getfixturevalue("little_memory")
    with pytest.raises(BadDataError, match=message) as refusal:
        read(path)
    assert "\n" not in str(refusal.value)


def test_an_image_chunk_that_claims_4_gb_takes_what_is_there(tmp_path: Path, request) -> None:
    path = tmp_path / "image.png"
    there, claimed = (struct.pack(">I", number) + b"IDAT" for number in (12, 2**32 - 1))
    path.write_bytes(hostile.png(8, 8).replace(there, claimed))
    assert claimed in path.read_bytes()
    request.getfixturevalue("little_memory")
    assert read_grid(path, spacing_mm=1.0).mean.shape == (8, 8)


@pytest.mark.long
def test_a_packed_chunk_of_a_map_gives_no_more_than_it_declares(plain: Path, request) -> None:
    hostile.deflate_bomb(plain, megabytes=500)
    request.getfixturevalue("little_memory")
    with pytest.raises(BadDataError, match="unpacks to more than it declares"):
        read_map(plain)


MAP_CHUNKS: dict[str, tuple[Callable[[Path], None], str]] = {
    "of one byte": (lambda path: hostile.write_chunk(path, b"x"), "unpacks to less than it declares"),
    "of nothing but a checksum": (lambda path: hostile.write_chunk(path, bytes(4)), "unpacks to less"),
    "of a tenth of its values": (
        lambda path: hostile.write_chunk(path, zlib.compress(bytes(48)) + bytes(4), skipped=0b100),
        "unpacks to less than it declares",
    ),
    "of a tenth of its values, not packed": (
        lambda path: hostile.write_chunk(path, bytes(48), skipped=0b111),
        "unpacks to less than it declares",
    ),
    "of one byte, by the index": (lambda path: hostile.claim_chunk(path, 1), "unpacks to less than it declares"),
    "of 2.7 GB, by the index": (lambda path: hostile.claim_chunk(path, 27 * 10**8), "takes 2,700,000,000 bytes, over"),
}


@pytest.mark.parametrize("case", MAP_CHUNKS)
def test_a_chunk_that_holds_other_than_it_declares_is_refused(case: str, plain: Path, request) -> None:
    spoil, message = MAP_CHUNKS[case]
    spoil(plain)
    request.getfixturevalue("little_memory")
    with pytest.raises(BadDataError, match=f"a chunk of variable mean {message}") as refusal:
        read_map(plain)
    assert "\n" not in str(refusal.value)


def test_a_chunk_that_is_not_packed_is_read(plain: Path) -> None:
    before = read_map(plain)
    hostile.write_chunk(plain, before.mean.tobytes(), skipped=0b111)
    np.testing.assert_array_equal(read_map(plain).mean, before.mean)


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """A small map."""
    np.savez(tmp_path / "g.npz", mean=1 + np.random.default_rng(1).normal(0, 0.01, (9, 7)), spacing_mm=np.array(1.0))
    write_map(tmp_path / "map.nc", read_grid(tmp_path / "g.npz", normalise="mean"), provenance=Provenance("test", {}))
    return tmp_path / "map.nc"


def test_a_limit_can_be_raised_and_says_how(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "prior.toml"
    path.write_text("#" * 1_500_000)
    with pytest.raises(BadDataError, match=r"1,500,000 bytes, over the limit of 1,000,000; .*TACTILE_BAYES_LIMITS=2"):
        read_settings(path)
    monkeypatch.setenv("TACTILE_BAYES_LIMITS", "2")
    read_settings(path)
    monkeypatch.setenv("TACTILE_BAYES_LIMITS", "much")
    with pytest.raises(UsageError, match="'much'; give a number above 0"):
        read_settings(path)


TOML_READERS = (read_settings, read_scene, read_protocol, read_mapping)
JSON_READERS = (read_size_calibration, read_stated_size, describe)
TEXTS: dict[str, tuple[str, tuple[Read, ...], str]] = {
    "deep JSON": ('{"schema": ' + hostile.deep_json() + "}", JSON_READERS, "recursion|nested"),
    "a number of 5,000 digits": ('{"schema": ' + "9" * 5000 + "}", JSON_READERS, "not JSON|not a JSON file"),
    "infinity": ('{"schema": "tactile-bayes/estimate/1", "x": [1e999]}', JSON_READERS, r"x\[0\] is inf; give a finite"),
    "a whole number that no double holds": (
        '{"schema": "tactile-bayes/size-calibration/1", "x": [' + "9" * 400 + "]}",
        JSON_READERS,
        r"x\[0\] is a whole number of 400 digits; give a finite number of at most 1.8e\+308",
    ),
    "half a character": (
        '{"schema": "tactile-bayes/estimate/1", "x": "\\ud800"}',
        JSON_READERS,
        "x holds a broken character",
    ),
    "NUL": ('{"schema": "tactile-bayes/estimate/1", "x": "a\\u0000b"}', JSON_READERS, r"x holds the character U\+0000"),
    "NUL in TOML": ('checkpoint = "a\\u0000b"', TOML_READERS, r"checkpoint holds the character U\+0000"),
    "a key of 20,000 parts": (hostile.dotted_toml(), TOML_READERS, "line 1: a key of more than 16 parts"),
    "deep TOML": ("x = " + hostile.deep_json(), TOML_READERS, "is not TOML"),
    "TOML of 400 digits": ("[analysis]\nseed = " + "9" * 400, TOML_READERS, "seed is a whole number of 400 digits"),
    "TOML of 5,000 digits": ("x = " + "9" * 5000, TOML_READERS, "is not TOML"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", TEXTS)
def test_text_that_breaks_parsers_is_one_line(case: str, tmp_path: Path) -> None:
    text, readers, message = TEXTS[case]
    path = tmp_path / "text"
    path.write_text(text)
    for read in readers:
        with pytest.raises(BadDataError, match=message) as refusal:
            read(path)
        assert "\n" not in str(refusal.value)


def test_a_key_of_a_few_parts_is_no_long_one() -> None:
    assert parse_toml("[a.b]\nc.'d e'.f = 1\nx = '1.2.3.4'\n", way_out="")["a"]["b"]["c"]["d e"]["f"] == 1


@pytest.mark.parametrize(
    "place",
    [("eq6", "covariance"), ("hidden", "expected"), ("hidden", "covariance"), ("spread", "covariance"),
     ("residual", "covariance_factor"), ("residual", "points"), ("depth", "information_inverse")],
    ids=".".join,
)  # fmt: skip
def test_a_calibration_with_a_short_row_is_one_line(place: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "size.json"
    path.write_text(hostile.ragged_calibration(PACKAGE / "calibrations" / "solid.json", *place))
    with pytest.raises(BadDataError, match=place[-1]):
        read_size_calibration(path)


def test_a_header_without_end_is_told_in_short(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text('patient = "record_id"\n[[reading]]\nmodality = "palpation"\nsize = "ex"\n')
    (tmp_path / "wide.csv").write_text("[" * 5000 + ",ex\n1,2\n")
    mapping = read_mapping(tmp_path / "map.toml")
    with pytest.raises(BadDataError, match="record_id: is missing") as error:
        read_wide(tmp_path / "wide.csv", mapping, mapping.reading)
    assert len(str(error.value)) < 2000


CHUNKS: dict[str, tuple[bytes, str]] = {
    "a record cut short": (struct.pack("<BQ", 5, 1000) + b"ab", "a record ends beyond it"),
    "a head cut short": (b"\x05\x01", "its records make no sense"),
    "a message without its head": (struct.pack("<BQ", 5, 3) + b"abc", "shorter than its head"),
    "a channel that is no text": (
        struct.pack("<BQHHI", 4, 12, 9, 0, 4) + b"\xff\xfe\xff\xfe",
        "its records make no sense",
    ),
}


@pytest.mark.parametrize("case", CHUNKS)
def test_a_chunk_that_makes_no_sense_is_told_and_the_others_are_kept(case: str, tmp_path: Path) -> None:
    data, message = CHUNKS[case]
    records = hostile.mcap_records(SCAN.read_bytes())
    own = [body for opcode, body in records if opcode == 6]
    path = tmp_path / "scan.mcap"
    path.write_bytes(hostile.mcap_with(SCAN.read_bytes(), *own, hostile.mcap_chunk(data)))
    file = read_scan_report(path)
    assert file.damaged
    assert message in file.lost[0]
    assert np.array_equal(file.scan.frames.counts, read_scan(SCAN).frames.counts)
    assert describe(path)["findings"] == [f"To check: {line}." for line in file.lost]


def test_a_chunk_of_unknown_packing_is_not_taken_for_a_plain_one(tmp_path: Path) -> None:
    own = [body for opcode, body in hostile.mcap_records(SCAN.read_bytes()) if opcode == 6]
    path = tmp_path / "scan.mcap"
    path.write_bytes(hostile.mcap_with(SCAN.read_bytes(), *own, hostile.mcap_chunk(b"", packing=b"rot13")))
    assert "compressed by 'rot13', which this program does not know" in read_scan_report(path).lost[0]


def _fifo(path: Path) -> None:
    os.mkfifo(path)


READERS: tuple[tuple[str, Read], ...] = (
    (".mcap", read_scan),
    (".npz", read_arrays),
    (".mat", read_arrays),
    (".h5", read_arrays),
    (".csv", read_arrays),
    (".mha", read_arrays),
    (".csv", lambda path: read_poses(path, Stated())),
    (".npz", _grid),
    (".csv", _grid),
    (".png", _grid),
    (".csv", lambda path: read_table(path, "trial.table.json")),
    (".nc", read_map),
    (".json", read_size_calibration),
    (".json", read_stated_size),
    (".toml", read_settings),
    (".toml", read_scene),
    (".x", describe),
    (".npz", lambda path: CheckpointFile(path).load("key")),
)


@pytest.mark.parametrize(("suffix", "read"), READERS)
@pytest.mark.parametrize(
    ("make", "kind"),
    [(_fifo, "FIFO"), (Path.mkdir, "directory"), (lambda path: path.symlink_to("/dev/zero"), "device")],
    ids=["FIFO", "directory", "device"],
)
def test_what_is_no_regular_file_is_refused_at_once(make, kind, suffix: str, read: Read, tmp_path: Path) -> None:
    path = tmp_path / f"input{suffix}"
    make(path)
    with pytest.raises(BadDataError, match=f"is a {kind}; (give a regular file|name another file)"):
        read(path)


def test_a_store_line_with_another_number_is_not_taken_for_a_result(tmp_path: Path) -> None:
    path = tmp_path / "store"
    with open_store(path, settings={}) as store:
        store.add("a", 12.5)
        store.add("b", 13.5)
    path.write_bytes(path.read_bytes().replace(b"13.5", b"18.5"))
    with pytest.raises(BadDataError, match="line 3 is damaged"), open_store(path, settings={}):
        pass
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(UsageError, match="no regular file"), open_store(fifo, settings={}):
        pass


def test_a_checkpoint_with_another_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.npz"
    arrays = {"chain": np.zeros((1, 2, 3, 4)), "log_density": np.zeros((1, 3)), "accepted": np.zeros(1)}
    state = ChainState(**arrays, twister=np.zeros((1, 624), np.uint32), cursor=np.zeros((1, 3)))
    CheckpointFile(path).save("key", state)
    assert CheckpointFile(path).load("key") is not None
    with np.load(path) as saved:
        changed = dict(saved) | {"accepted": np.ones(1)}
    with path.open("wb") as file:
        np.savez(file, **changed)
    with pytest.raises(BadDataError, match="checksum does not match"):
        CheckpointFile(path).load("key")


def test_a_heap_that_the_library_would_never_leave_is_refused(plain: Path) -> None:
    data = bytearray(plain.read_bytes())
    at = data.index(b"GCOL") + 16
    while (size := struct.unpack_from("<HHIQ", data, at))[0]:
        at += 16 + -(-size[3] // 8) * 8
    data[at + 8 : at + 16] = bytes(8)
    plain.write_bytes(data)
    with pytest.raises(BadDataError, match="a damaged heap"):
        read_map(plain)


def test_a_map_whose_values_are_elsewhere_is_refused(plain: Path) -> None:
    import h5py

    with h5py.File(plain, "r+") as file:
        del file["variance"]
        file["variance"] = h5py.ExternalLink("/etc/other.nc", "/mean")
    with pytest.raises(BadDataError, match="variable variance is missing"):
        read_map(plain)


def test_a_report_with_control_characters_is_refused_without_obeying_it(tmp_path: Path, run_cli) -> None:
    text = {"schema": "tactile-bayes/estimate/1", "note": "\x1b]0;owned\x07\u202e\r", "\x9b2J": 1}
    (tmp_path / "r.json").write_text(json.dumps(text))
    done = run_cli("show", "r.json", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert r"\x1b]0;owned\x07\u202e\r" in done.stderr
    (tmp_path / "bad\x07.toml").write_text("x")
    refused = run_cli("simulate", "bad\x07.toml", "-o", "x.mcap", cwd=tmp_path)
    assert refused.returncode == 3
    assert r"bad\x07.toml" in refused.stderr
    assert "\x07" not in done.stdout + done.stderr + refused.stderr


def test_an_error_repeats_little_of_what_a_file_says(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.json"
    path.write_text(json.dumps({"schema": "tactile-bayes/landmarks/" + "9" * 5000}))
    with pytest.raises(BadDataError, match=r"schema is 'tactile-bayes/landmarks/9+") as refusal:
        read_landmarks(path)
    assert len(str(refusal.value)) < 1000 + len(str(path))
