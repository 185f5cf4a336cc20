"""Images as their files say they are. The files are written here by their descriptions: TIFF 6.0 (Adobe, 1992), PNG
(ISO/IEC 15948) and PGM (netpbm), so that no library's habits are on both sides."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import read_grid

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.images import read_image
from tactile_bayes.files.named_arrays import Grid

A = np.arange(12).reshape(3, 4)
_TYPES = {3: "H", 4: "I"}


def tiff(*pages: Mapping[str, Any], order: str = "<") -> bytes:
    """A TIFF of uncompressed pages: ``data`` (planes), bits, kind, photometric, samples, planar, and more tags."""
    out, link = bytearray((b"II*\x00" if order == "<" else b"MM\x00*") + bytes(4)), 4
    for page in pages:
        planes: list[bytes] = page["data"] if isinstance(page["data"], list) else [page["data"]]
        starts = []
        for plane in planes:
            starts.append(len(out))
            out += plane + b"\x00" * (len(plane) % 2)
        samples, (height, width) = page.get("samples", 1), page.get("shape", (3, 4))
        tags: dict[int, tuple[int, Any]] = {
            256: (4, [width]),
            257: (4, [height]),
            258: (3, [page.get("bits", 8)] * samples),
            259: (3, [1]),
            262: (3, [page.get("photometric", 1)]),
            273: (4, starts),
            277: (3, [samples]),
            278: (4, [height]),
            279: (4, [len(plane) for plane in planes]),
            284: (3, [page.get("planar", 1)]),
            339: (3, [page.get("kind", 1)] * samples),
            **page.get("tags", {}),
        }
        entries = b""
        for tag, (kind, values) in sorted(tags.items()):
            if kind == 2:
                raw, count = values.encode() + b"\x00", len(values) + 1
            elif kind == 5:
                raw, count = b"".join(struct.pack(f"{order}II", *one) for one in values), len(values)
            else:
                raw, count = struct.pack(f"{order}{len(values)}{_TYPES[kind]}", *values), len(values)
            if len(raw) > 4:
                out += b"\x00" * (len(out) % 2)
                raw, out = struct.pack(f"{order}I", len(out)), out + raw
            entries += struct.pack(f"{order}HHI", tag, kind, count) + raw.ljust(4, b"\x00")
        out += b"\x00" * (len(out) % 2)
        struct.pack_into(f"{order}I", out, link, len(out))
        out += struct.pack(f"{order}H", len(tags)) + entries
        link = len(out)
        out += bytes(4)
    return bytes(out)


def png(rows: Sequence[bytes], *, bits: int, colour: int = 0, chunks: Mapping[bytes, bytes] | None = None) -> bytes:
    """A PNG of 4 by 3 pixels with the given bits a sample and colour type."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, bits, colour, 0, 0, 0))
    more = b"".join(chunk(name, data) for name, data in (chunks or {}).items())
    body = chunk(b"IDAT", zlib.compress(b"".join(b"\x00" + row for row in rows)))
    return b"\x89PNG\r\n\x1a\n" + head + more + body + chunk(b"IEND", b"")


def packed(values: np.ndarray[Any, Any], bits: int) -> list[bytes]:
    """Rows of samples of fewer or more bits than a byte has, first sample in the highest bits."""
    rows = []
    for row in values:
        text = "".join(f"{int(value):0{bits}b}" for value in row)
        text += "0" * (-len(text) % 8)
        rows.append(int(text, 2).to_bytes(len(text) // 8, "big"))
    return rows


def interleaved(*channels: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.stack(channels, axis=-1).reshape(3, -1)


def picture(tmp_path: Path, data: bytes) -> Grid:
    path = tmp_path / ("g.pgm" if data[:1] == b"P" else "g.png" if data[:1] == b"\x89" else "g.tif")
    path.write_bytes(data)
    return read_image(path)


FULL = np.full((3, 4), 255)
READ: dict[str, tuple[bytes, Any]] = {
    "8 bits": (tiff({"data": (A * 20).astype("u1").tobytes()}), A * 20),
    "8 bits, white is zero": (tiff({"data": (A * 20).astype("u1").tobytes(), "photometric": 0}), 255 - A * 20),
    "16 bits, white is zero": (
        tiff({"data": (A * 20).astype("<u2").tobytes(), "bits": 16, "photometric": 0}),
        65535 - A * 20,
    ),
    "4 bits": (tiff({"data": b"".join(packed(A, 4)), "bits": 4}), A),
    "4 bits, white is zero": (tiff({"data": b"".join(packed(A, 4)), "bits": 4, "photometric": 0}), 15 - A),
    "12 bits": (tiff({"data": b"".join(packed(A * 300, 12)), "bits": 12}), A * 300),
    "16 bits, highest byte first": (tiff({"data": (A * 20).astype(">u2").tobytes(), "bits": 16}, order=">"), A * 20),
    "signed 8 bits": (tiff({"data": (A * 10 - 50).astype("i1").tobytes(), "kind": 2}), A * 10 - 50),
    "signed 16 bits": (tiff({"data": (A * 10 - 50).astype("<i2").tobytes(), "bits": 16, "kind": 2}), A * 10 - 50),
    "32 bits": (tiff({"data": (A + 4 * 10**9).astype("<u4").tobytes(), "bits": 32}), A + 4 * 10**9),
    "floating point": (tiff({"data": (A / 7).astype("<f4").tobytes(), "bits": 32, "kind": 3}), (A / 7).astype("f4")),
    "floating point with a signalling NaN": (
        tiff({"data": A.astype("<f4").tobytes()[:-4] + b"\x01\x00\x80\x7f", "bits": 32, "kind": 3}),
        np.where(A == 11, np.nan, A),
    ),
    "planes of equal colours": (
        tiff({"data": [A.astype("u1").tobytes()] * 3, "photometric": 2, "samples": 3, "planar": 2}),
        A,
    ),
    "grey as YCbCr": (
        tiff(
            {
                "data": interleaved(A, FULL // 2 + 1, FULL // 2 + 1).astype("u1").tobytes(),
                "photometric": 6,
                "samples": 3,
                "tags": {530: (3, [1, 1])},
            }
        ),
        A,
    ),
    "upside down": (tiff({"data": A.astype("u1").tobytes(), "tags": {274: (3, [4])}}), A[::-1]),
    "on its side": (tiff({"data": A.astype("<u2").tobytes(), "bits": 16, "tags": {274: (3, [6])}}), A[::-1].T),
    "a thumbnail first": (
        tiff({"data": bytes(4), "shape": (2, 2), "tags": {254: (4, [1])}}, {"data": A.astype("u1").tobytes()}),
        A,
    ),
    "GDAL_NODATA": (
        tiff({"data": A.astype("<u2").tobytes(), "bits": 16, "tags": {42113: (2, "7")}}),
        np.where(A == 7, np.nan, A),
    ),
    "GDAL_NODATA, white is zero": (
        tiff({"data": A.astype("u1").tobytes(), "photometric": 0, "tags": {42113: (2, "7")}}),
        np.where(A == 7, np.nan, 255 - A),
    ),
    "PNG of no resolution": (png(packed(A, 8), bits=8, chunks={b"pHYs": struct.pack(">IIB", 0, 0, 1)}), A),
    "PNG of 2 bits": (png(packed(A % 4, 2), bits=2), A % 4),
    "PNG of 4 bits": (png(packed(A, 4), bits=4), A),
    "PNG of 16 bits": (png(packed(A * 999, 16), bits=16), A * 999),
    "PNG with gAMA and sBIT": (
        png(packed(A, 8), bits=8, chunks={b"gAMA": struct.pack(">I", 45455), b"sBIT": b"\x04"}),
        A,
    ),
    "PNG with tRNS": (png(packed(A, 8), bits=8, chunks={b"tRNS": b"\x00\x05"}), np.where(A == 5, np.nan, A)),
    "PNG with alpha": (
        png(packed(interleaved(A, 255 * (A > 2)), 8), bits=8, colour=4),
        np.where(A > 2, A, np.nan),
    ),
    "PNG of a grey palette": (
        png(packed(A, 8), bits=8, colour=3, chunks={b"PLTE": bytes(v for i in range(12) for v in 3 * (3 * i,))}),
        3 * A,
    ),
    "PNG turned by Exif": (
        png(
            packed(A, 8),
            bits=8,
            chunks={b"eXIf": b"II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x03" + bytes(7)},
        ),
        A[::-1, ::-1],
    ),
    "PGM up to 100": (b"P5 4 3 100\n" + (A * 9).astype("u1").tobytes(), A * 9),
    "PGM up to 1023": (b"P5\n# a comment\n4 3\n1023\n" + (A * 90).astype(">u2").tobytes(), A * 90),
    "PGM in plain text": (b"P2 4 3 4095\n" + " ".join(map(str, (A * 300).ravel())).encode(), A * 300),
}


@pytest.mark.parametrize(("data", "values"), READ.values(), ids=READ)
def test_values_are_those_in_the_file(tmp_path: Path, data: bytes, values: Any) -> None:
    np.testing.assert_array_equal(picture(tmp_path, data).arrays["mean"], values)


REFUSED: dict[str, tuple[bytes, str]] = {
    "half floats": (
        tiff({"data": A.astype("<f2").tobytes(), "bits": 16, "kind": 3}),
        r"floating-point samples of 16 bits.*or its numbers as \.npy",
    ),
    "doubles": (tiff({"data": A.astype("<f8").tobytes(), "bits": 64, "kind": 3}), "floating-point samples of 64 bits"),
    "floats, white is zero": (
        tiff({"data": A.astype("<f4").tobytes(), "bits": 32, "kind": 3, "photometric": 0}),
        "white as zero",
    ),
    "colours of 16 bits": (
        tiff({"data": interleaved(A, A, A).astype("<u2").tobytes(), "bits": 16, "photometric": 2, "samples": 3}),
        "unsigned samples of 16 bits, 3 a pixel",
    ),
    "planes of 16 bits": (
        tiff({"data": [A.astype("<u2").tobytes()] * 3, "bits": 16, "photometric": 2, "samples": 3, "planar": 2}),
        "one plane after the other",
    ),
    "black and white": (tiff({"data": b"".join(packed(A % 2, 1)), "bits": 1}), "1 bit a pixel"),
    "two pages": (tiff(*[{"data": A.astype("u1").tobytes()}] * 2), "holds 2 images"),
    "GDAL_NODATA of words": (
        tiff({"data": A.astype("u1").tobytes(), "tags": {42113: (2, "none")}}),
        "GDAL_NODATA is 'none'; it must be a number",
    ),
    "PNG with alpha, 16 bits": (png(packed(interleaved(A, FULL), 16), bits=16, colour=4), "of which 8 would be read"),
    "PNG half transparent": (
        png(packed(interleaved(A, A), 8), bits=8, colour=4),
        "pixels that are transparent in part",
    ),
    "a JPEG": (b"\xff\xd8\xff\xe0" + bytes(30), "is a JPEG, whose values are changed"),
    "PGM over its maximum": (b"P5 4 3 5\n" + A.astype("u1").tobytes(), "holds the value 11, and its maximum is 5"),
    "PGM cut off": (b"P5 4 3 255\n" + bytes(5), "5 of 12 pixels"),
    "two PGM": (2 * (b"P5 4 3 255\n" + A.astype("u1").tobytes()), "several images"),
    "pixels that are not square": (
        tiff({"data": A.astype("u1").tobytes(), "tags": {282: (5, [(300, 1)]), 283: (5, [(150, 1)]), 296: (3, [1])}}),
        "0.5 times as wide as high",
    ),
    "PNG of pixels that are not square": (
        png(packed(A, 8), bits=8, chunks={b"pHYs": struct.pack(">IIB", 2, 1, 0)}),
        "0.5 times as wide as high",
    ),
}


@pytest.mark.parametrize(("data", "words"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_read_as_it_is_is_refused_with_what_was_found(tmp_path: Path, data: bytes, words: str) -> None:
    with pytest.raises(BadDataError, match=words):
        picture(tmp_path, data)


def test_an_inverted_or_turned_image_is_reported(tmp_path: Path) -> None:
    data = tiff({"data": A.astype("<u2").tobytes(), "bits": 16, "photometric": 0, "tags": {274: (3, [3])}})
    found = picture(tmp_path, data)
    assert any("zero is white" in note for note in found.notes)
    assert any("orientation (3)" in note for note in found.notes)


@pytest.mark.parametrize(
    ("tags", "mm"),
    [
        ({282: (5, [(254, 1)]), 283: (5, [(254, 1)]), 296: (3, [2])}, 0.1),
        ({282: (5, [(100, 1)]), 283: (5, [(100, 1)]), 296: (3, [3])}, 0.1),
        ({282: (5, [(2, 1)]), 283: (5, [(2, 1)]), 296: (3, [1]), 270: (2, "ImageJ=1.53t\nunit=mm\n")}, 0.5),
    ],
)
def test_a_resolution_is_read_and_told_where_the_stated_spacing_differs(
    tmp_path: Path, tags: dict[int, Any], mm: float
) -> None:
    found = picture(tmp_path, tiff({"data": A.astype("u1").tobytes(), "tags": tags}))
    assert found.resolution_mm == pytest.approx((mm, mm))
    with pytest.raises(UsageError, match=rf"needs --spacing-mm.*its resolution says {mm:g} mm a pixel"):
        read_grid(tmp_path / "g.tif")
    assert read_grid(tmp_path / "g.tif", spacing_mm=1.0).recipe.cell_mm == 1.0
