"""Grey images: a pixel means what the file's tags and header say, not what a viewer shows."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.named_arrays import Grid
from tactile_bayes.files.reading import CELLS, IMAGE_BYTES, beginning, check_limit, decoding, read_bytes
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.presets import MM_PER_UNIT

_WAY_OUT: Final = "save it as grey TIFF (8, 16 or 32 bits), PNG or PGM, or its numbers as .npy"
_KINDS: Final = {1: "unsigned", 2: "signed", 3: "floating-point"}
# Tags of TIFF 6.0 (1992), and that of GDAL for the value of pixels without data.
_SUBFILE, _BITS, _PHOTOMETRIC, _DESCRIPTION, _SAMPLES = 254, 258, 262, 270, 277
_JPEG: Final = b"\xff\xd8\xff"
_X_RESOLUTION, _Y_RESOLUTION, _PLANAR, _RESOLUTION_UNIT, _FORMAT, _NO_DATA = 282, 283, 284, 296, 339, 42113
_ORIENTATION: Final = 274
_MM: Final = {**MM_PER_UNIT, "micron": 1e-3, "\u00b5m": 1e-3}
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _PALETTE = 0, 1, 3
# Samples a pixel, bits and kind of the sample, that the decoder gives back as the file has them.
_DECODED: Final = {(1, bits, 1) for bits in (2, 4, 8, 12, 16, 32)} | {(1, 8, 2), (1, 16, 2), (1, 32, 2), (1, 32, 3)}
_DECODED_OF_MANY: Final = {(samples, 8, 1) for samples in (2, 3, 4)}
_GREY_HEADER: Final = re.compile(rb"P([25])" + 3 * rb"(?:\s|#[^\n\r]*[\n\r])+(\d{1,9})" + rb"\s")


def read_image(path: Path) -> Grid:
    """Read a grey TIFF, PNG or PGM as the file numbers its pixels, more is brighter, NaN where it says "no value".

    Colours, several images and samples that would be changed are refused; what a viewer would not show is noted.
    """
    data = read_bytes(path, most=IMAGE_BYTES)  # from memory: a chunk cannot claim more than there is
    return _decode_graymap(data) if data[:1] == b"P" else _decode_tiff_or_png(data)


def _decode_graymap(data: bytes) -> Grid:
    """Grid of a PGM (netpbm's ``P2`` or ``P5``): values from 0 to its maximum, unscaled."""
    header = _GREY_HEADER.match(data)
    if header is None:
        raise BadDataError(f"is not an image of grey values ({beginning(data[:2])})", way_out=_WAY_OUT)
    width, height, top = (int(header[i]) for i in (2, 3, 4))
    check_limit(width * height, CELLS, what="it has {} pixels")
    body = data[header.end() :]
    if header[1] == b"2":
        with decoding("cannot be decoded", way_out=_WAY_OUT):
            values = np.array(re.sub(rb"#[^\n\r]*", b"", body).split(), dtype=np.int64)
        rest = 0
    else:
        kind = np.dtype("u1" if top < 256 else ">u2")
        rest = len(body) - width * height * kind.itemsize
        values = np.frombuffer(body, kind, count=min(width * height, len(body) // kind.itemsize))
    if rest > 0 and body[-rest:].lstrip().startswith(b"P"):
        raise BadDataError("holds several images", way_out="give one")
    if len(values) != width * height or not len(values):
        raise BadDataError(f"cannot be decoded ({len(values)} of {width * height} pixels)", way_out="copy it again")
    if not 0 < top < 65536 or values.max() > top:
        raise BadDataError(f"holds the value {values.max()}, and its maximum is {top}", way_out="copy it again")
    return Grid({"mean": values.reshape(height, width).astype(np.float64)})


def _decode_tiff_or_png(data: bytes) -> Grid:
    """Grid of a TIFF or PNG by Pillow; `_values_of_file` undoes its scaling and inverting."""
    from PIL import Image, ImageOps, TiffImagePlugin, UnidentifiedImageError

    with (
        decoding("cannot be decoded", way_out=_WAY_OUT),
        warnings.catch_warnings(action="ignore"),  # damage is told by the errors
    ):
        Image.MAX_IMAGE_PIXELS = None  # the limit below is the one that can be raised
        try:
            image = Image.open(io.BytesIO(data), formats=("TIFF", "PNG"))
        except UnidentifiedImageError:
            jpeg = "is a JPEG, whose values are changed where it saves space"
            what = jpeg if data[:3] == _JPEG else "is not an image"
            if data[:4] in (b"II*\x00", b"MM\x00*"):  # a TIFF that Pillow has no mode for
                directory: Any = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
                stream = io.BytesIO(data)
                stream.seek(directory.next)
                directory.load(stream)
                what = f"holds {_describe_samples(directory)}, which cannot be read" if _BITS in directory else what
            raise BadDataError(what, way_out=_WAY_OUT) from None
        check_limit(image.width * image.height, CELLS, what="it has {} pixels")
        _choose_page(image)
        tags = getattr(image, "tag_v2", None)
        described = _png_facts(data, image.info) if tags is None else _tiff_facts(tags)
        turned = int(image.getexif().get(_ORIENTATION, 1))
        lossy = "values are near those that were saved: it is compressed as a JPEG is"
        notes = [lossy] if image.info.get("compression") == "jpeg" else []
        image.load()
        ImageOps.exif_transpose(image, in_place=True)  # what its own reader has not done already
        mode, pixels = image.mode, np.asarray(image.convert("RGBA") if image.mode == "P" else image)
    notes += [f"turned as its orientation ({turned}) says"] if turned != 1 else []
    return _values_of_file(*_grey_channel(pixels, mode), described, notes)


def _choose_page(image: Any) -> None:
    """Seek the only image of full size; the others are smaller copies of it."""
    pages = getattr(image, "n_frames", 1)
    if pages == 1:
        return
    full_size_pages = []
    for page in range(pages if hasattr(image, "tag_v2") else 0):
        image.seek(page)
        if not int(image.tag_v2.get(_SUBFILE, 0)) & 1:
            full_size_pages.append(page)
    if len(full_size_pages) != 1:
        raise BadDataError(f"holds {len(full_size_pages) or pages} images", way_out="give one")
    image.seek(full_size_pages[0])


def _grey_channel(pixels: np.ndarray[Any, Any], mode: str) -> tuple[np.ndarray[Any, Any], BoolArray]:
    """Grey channel of an image, and a mask of the pixels that its alpha makes transparent."""
    if mode == "1":
        raise BadDataError("has 1 bit a pixel: black or white", way_out=_WAY_OUT)
    without = np.zeros(pixels.shape[:2], dtype=bool)
    if pixels.ndim == 2:
        return pixels, without
    alpha = pixels[..., -1] if pixels.shape[-1] in (2, 4) else None
    colours = pixels if alpha is None else pixels[..., :-1]
    if mode == "YCbCr" and (colours[..., 1:] == 128).all():
        colours = colours[..., :1]
    elif mode in ("YCbCr", "CMYK", "LAB") or not (colours == colours[..., :1]).all():
        raise BadDataError(f"is a colour image (mode {mode})", way_out="save one channel of intensities")
    if alpha is not None:
        if between := int(((alpha != 0) & (alpha != 255)).sum()):
            way_out = "save it without alpha, or with 0 where there is no value and 255 elsewhere"
            raise BadDataError(f"has {between} pixels that are transparent in part", way_out=way_out)
        without = alpha == 0
    return colours[..., 0], without


class _SampleFacts(Record):
    """Description of a file's samples."""

    bits: int = 8
    kind: int = 1  #: A key of `_KINDS`.
    white_is_zero: bool = False
    no_value: float | None = None  #: Number that stands for no value, in the file's own scale.
    spacing_mm: tuple[float, float] | None = None


def _values_of_file(values: np.ndarray[Any, Any], without: BoolArray, facts: _SampleFacts, notes: list[str]) -> Grid:
    """Grid of the file's own numbers, from those that Pillow scales and inverts; NaN where a pixel has no value."""
    top = 2.0**facts.bits - 1
    if facts.kind == 2 and facts.bits == 8:
        values = values.astype(np.uint8).view(np.int8)
    elif facts.kind == 1 and facts.bits == 32:
        values = values.view(np.uint32)
    with np.errstate(invalid="ignore"):  # a NaN of 32 bits may be a signalling one
        raw: FloatArray = np.asarray(values, dtype=np.float64)
    if facts.bits < 8:  # stretched to 0..255
        raw = raw * (top / 255)
    if facts.white_is_zero:
        raw = top - raw if facts.bits <= 8 else raw  # turned round already
        notes.append("its zero is white: values are turned round, so that more is brighter")
    if (no_value := facts.no_value) is not None:
        without = without | (raw == np.float64(no_value)) | (raw == np.float64(np.float32(no_value)))
        notes.append(f"{no_value:g} is no value in it, as the file says")
    values = np.where(without, np.nan, top - raw if facts.white_is_zero else raw)
    return Grid({"mean": values}, resolution_mm=facts.spacing_mm, notes=tuple(notes))


def _png_facts(data: bytes, info: Mapping[Any, Any]) -> _SampleFacts:
    """Facts of a PNG: IHDR has bits and colour type (ISO/IEC 15948, 11.2.2). gAMA and sBIT change no stored value."""
    bits, colour = data[24], data[25]
    if bits == 16 and colour != 0:
        what = "holds 16 bits a sample with colours or alpha, of which 8 would be read"
        raise BadDataError(what, way_out="save it as grey with 16 bits, without alpha")
    no_value = info.get("transparency")
    dots, aspect = info.get("dpi"), info.get("aspect")
    spacing = None if not dots or not all(dots) else (25.4 / float(dots[0]), 25.4 / float(dots[1]))
    if aspect and all(aspect):
        _check_square(float(aspect[1]), float(aspect[0]))
    if colour == 3:
        return _SampleFacts(spacing_mm=spacing)
    return _SampleFacts(bits, no_value=float(no_value) if isinstance(no_value, int) else None, spacing_mm=spacing)


def _tiff_facts(tags: Mapping[int, Any]) -> _SampleFacts:
    """Facts of a TIFF that can be read as it is; any other is refused with what it holds."""
    bits, kind, samples = _sample(tags)
    photometric = int(tags.get(_PHOTOMETRIC, _BLACK_IS_ZERO))
    grey = (_BLACK_IS_ZERO, _PALETTE, *([_WHITE_IS_ZERO] if kind == 1 else []))
    one = (samples, bits, kind) in _DECODED and photometric in grey
    if not (one or (samples, bits, kind) in _DECODED_OF_MANY or (samples, bits) == (1, 1)):
        raise BadDataError(f"holds {_describe_samples(tags)}, which cannot be read as they are", way_out=_WAY_OUT)
    try:
        no_value = float(str(tags[_NO_DATA]).strip("\x00 ")) if _NO_DATA in tags else None
    except ValueError:
        raise BadDataError(f"GDAL_NODATA is {str(tags[_NO_DATA])[:20]!r}", way_out="it must be a number") from None
    if samples > 1 or photometric == _PALETTE:
        return _SampleFacts(spacing_mm=_tiff_spacing(tags))
    return _SampleFacts(bits, kind, photometric == _WHITE_IS_ZERO, no_value, _tiff_spacing(tags))


def _sample(tags: Mapping[int, Any]) -> tuple[int, int, int]:
    """Bits and kind of the samples, and samples per pixel; bits and kind are 0 where they differ."""
    bits, kinds = ({int(v) for v in np.atleast_1d(tags.get(tag, 1))} for tag in (_BITS, _FORMAT))
    return (bits.pop() if len(bits) == 1 else 0), (kinds.pop() if len(kinds) == 1 else 0), int(tags.get(_SAMPLES, 1))


def _describe_samples(tags: Mapping[int, Any]) -> str:
    """Samples of a TIFF in words."""
    bits, kind, samples = _sample(tags)
    words = f"{_KINDS.get(kind, 'other')} samples of {bits} bits" if bits else "samples of several lengths"
    words += f", {samples} a pixel" if samples > 1 else ""
    words += ", one plane after the other" if samples > 1 and int(tags.get(_PLANAR, 1)) == 2 else ""
    return words + (", white as zero" if int(tags.get(_PHOTOMETRIC, 1)) == _WHITE_IS_ZERO else "")


def _tiff_spacing(tags: Mapping[int, Any]) -> tuple[float, float] | None:
    """Sides of a pixel by the resolution: in inches, in cm, or in the unit that ImageJ writes into the description."""
    pixels_per_unit = [float(tags.get(tag, 0) or 0) for tag in (_X_RESOLUTION, _Y_RESOLUTION)]
    if not all(np.isfinite(pixels_per_unit)) or min(pixels_per_unit) <= 0:
        return None
    unit = {2: "inch", 3: "cm"}.get(int(tags.get(_RESOLUTION_UNIT, 2)))
    if named := re.search(r"^unit=(\S+)", str(tags.get(_DESCRIPTION, "")), re.MULTILINE):
        unit = named[1].replace("\\u00B5", "\u00b5")
    if unit not in _MM:
        _check_square(1 / pixels_per_unit[0], 1 / pixels_per_unit[1])
        return None
    return _MM[unit] / pixels_per_unit[0], _MM[unit] / pixels_per_unit[1]


def _check_square(width: float, height: float) -> None:
    if abs(width / height - 1) > 1e-3:
        what = f"its pixels are {width / height:.4g} times as wide as high"
        raise BadDataError(what, way_out="resample to square pixels")
