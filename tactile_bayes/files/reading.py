"""Reading of files within limits, the kind of a file, and files in object stores."""

from __future__ import annotations

import codecs
import contextlib
import errno
import hashlib
import io
import os
import re
import stat
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Final

from tactile_bayes.errors import BadDataError, TactileBayesError, UsageError, in_file

# --- Safe reading of files: regular files only, up to a size limit; a decoder's errors become one line.
#
# Limits are judged before memory is taken. Each is multiplied by the environment variable ``TACTILE_BAYES_LIMITS``
# (a number, 1 where it is not set), so that a sound file that is too large for them can still be read.
# docs/exit-codes.md lists them.

LIMITS_VARIABLE: Final = "TACTILE_BAYES_LIMITS"
TOML_BYTES: Final = 10**6
JSON_BYTES: Final = 16 * 10**6
TABLE_BYTES: Final = 32 * 10**6
IMAGE_BYTES: Final = 128 * 10**6
NETCDF_BYTES: Final = 256 * 10**6
CELLS: Final = 2**24
_UTF_32: Final = (b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff")
_UTF_16: Final = (b"\xff\xfe", b"\xfe\xff")
_UNPACKED_BYTES: Final = 64 * 10**6
_UNPACKED_TIMES: Final = 32

_KINDS: Final = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_input(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; a directory, a FIFO, a socket or a device is refused, never waited on."""
    with readable(path):
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    kind = special_kind(os.fstat(descriptor).st_mode)
    if kind:
        os.close(descriptor)
        raise BadDataError(f"is {kind}", way_out="give a regular file", path=str(path))
    return os.fdopen(descriptor, "rb")


def first_bytes(path: Path, number: int) -> bytes:
    """First bytes of a regular file, up to `number`."""
    with open_input(path) as file:
        return file.read(number)


def beginning(start: bytes) -> str:
    """Words on the first bytes of a file of another kind."""
    return f"it starts with {start!r}" if start else "it is empty"


def is_json(start: bytes) -> bool:
    """True for the first bytes of a JSON object or list."""
    return start.removeprefix(codecs.BOM_UTF8).lstrip().startswith((b"{", b"["))


def special_kind(mode: int) -> str:
    """Kind of a path that is no regular file ("a FIFO"), by its mode; empty for a regular file."""
    return next((words for test, words in _KINDS if test(mode)), "")


def read_bytes(path: Path, *, most: int) -> bytes:
    """All bytes of a regular file of up to `most` bytes (times ``TACTILE_BAYES_LIMITS``)."""
    with open_input(path) as file, in_file(path), readable(path):
        check_limit(os.fstat(file.fileno()).st_size, most, what="it has {} bytes")
        return file.read()


def read_text(path: Path, *, most: int, way_out: str) -> str:
    """A file's UTF-8 text; see `read_bytes` for limits and errors, and `decoded`."""
    return decoded(read_bytes(path, most=most), path=path, way_out=way_out)


def other_encoding(data: bytes) -> str:
    """Encoding of text that is not UTF-8, by its mark or, in UTF-16 without one, by the zeros in it; else empty."""
    if data.startswith(_UTF_32):
        return "UTF-32"
    if data.startswith(_UTF_16):
        return "UTF-16"
    start = data[:64]
    half = len(start) // 2
    zeros = max(start[0::2].count(0), start[1::2].count(0))
    return "UTF-16 (without a byte order mark)" if half and zeros > half / 2 and start.count(0) == zeros else ""


def decoded(
    data: bytes, *, path: Path, way_out: str, as_utf8: str = "save it as UTF-8", may_be: Sequence[str] = ()
) -> str:
    """Text of bytes in UTF-8, with or without a byte order mark, or in what it `may_be`; others are named by line."""
    other = other_encoding(data)
    if other and other not in may_be:
        raise BadDataError(f"is {other} text", way_out=as_utf8, path=str(path))
    try:
        return data.decode(other or "utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        what = f"line {line}: byte 0x{data[error.start]:02x} is not {other or 'UTF-8'} text"
        raise BadDataError(what, way_out=way_out if b"\0" in data else as_utf8, path=str(path)) from None


def check_limit(size: int, most: int, *, what: str) -> None:
    """Refuse a declared size over `most` times ``TACTILE_BAYES_LIMITS``, in words such as ``"mean has {} cells"``."""
    allowed = most * limit_factor()
    if size > allowed:
        over = f"{what.format(f'{size:,}')}, over the limit of {int(allowed):,}"
        raise BadDataError(over, way_out=f"if the file is sound, set {LIMITS_VARIABLE}={-(-size // most)}")


def unpacked_limit(file_bytes: int) -> int:
    """Largest number of bytes that a packed file may unpack to, before ``TACTILE_BAYES_LIMITS``."""
    return max(_UNPACKED_BYTES, _UNPACKED_TIMES * file_bytes)


def limit_factor() -> float:
    """Factor on every limit, from ``TACTILE_BAYES_LIMITS``."""
    text = os.environ.get(LIMITS_VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0 < factor < float("inf"):
        raise UsageError(f"{LIMITS_VARIABLE} is {text!r}; give a number above 0, or unset it")
    return factor


COPY_AGAIN: Final = "copy the file again"


@contextlib.contextmanager
def decoding(what: str, *, way_out: str = COPY_AGAIN) -> Iterator[None]:
    """Turn any error of a decoder on damaged bytes into a `BadDataError` with the text `what`: ``"cannot be decoded"``.

    Only calls into decoders of other packages belong inside: each of them has error classes of its own, and damaged
    bytes bring out others as well.
    """
    try:
        yield
    except (TactileBayesError, MemoryError):
        raise
    except Exception as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise BadDataError(f"{what} ({why})", way_out=way_out) from None


_WAYS_OUT: Final = {
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP), "check the path"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), "ask for the right to read it"),
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "close other programs: too many files are open"),
}


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn an `OSError` on reading a file into a `BadDataError`."""
    try:
        yield
    except OSError as error:
        way_out = _WAYS_OUT.get(error.errno or 0, "copy it to another disk and read it there")
        raise BadDataError(f"cannot be read ({error.strerror or error})", way_out=way_out, path=str(path)) from None


# --- Kind of a file by its first bytes; a reader given another kind names the command to run instead.

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
HDF5_MAGIC: Final = b"\x89HDF\r\n\x1a\n"
ZIP_MAGIC: Final = b"PK\x03\x04"
SCAN, MAP, ARCHIVE = "a scan", "a map or posterior (netCDF)", "an archive (.npz or a spreadsheet)"
_IMAGE, _NETCDF_3 = "an image", "a netCDF-3 file"
_ESTIMATE, _POOLED = "an estimate (JSON)", "a pooled estimate (JSON)"
_BEGINNINGS = {
    MCAP_MAGIC: SCAN,
    HDF5_MAGIC: MAP,
    ZIP_MAGIC: ARCHIVE,
    **dict.fromkeys((b"\x89PNG", b"II*\x00", b"MM\x00*", b"P5"), _IMAGE),
    b"%PDF": "a PDF",
    b"PAR1": "a Parquet file",
    **dict.fromkeys((b"#ROSBAG", b"SQLite format 3"), "a ROS bag or another database"),
    b"\x93NUMPY": "an array of numpy (.npy)",
    b"MATLAB 5.0 MAT-file": "a .mat",
    **dict.fromkeys((b"CDF\x01", b"CDF\x02", b"CDF\x05"), _NETCDF_3),
}
_SCHEMA = re.compile(rb'"schema"\s*:\s*"tactile-bayes/([a-z0-9-]+)/')
_DOCUMENTS = {
    "estimate": _ESTIMATE,
    "pooled": _POOLED,
    "size-calibration": "a size calibration (JSON)",
    "site-calibration": "a size calibration corrected by phantoms (JSON)",
    "repeatability": "a site's repeatability (JSON)",
    "validate": "a trial report (JSON)",
    "plan": "a trial plan (JSON)",
}
_WAYS = {
    (SCAN, MAP): "build its map first: `tactile-bayes map {path} -o MAP.nc`",
    (ARCHIVE, SCAN): "bring it in first: `tactile-bayes import {path} -o SCAN.mcap`",
    (ARCHIVE, MAP): "bring it in first: `tactile-bayes import --help` says how",
    (_IMAGE, MAP): "bring it in first: `tactile-bayes import {path} --as map -o MAP.nc`",
    (_NETCDF_3, MAP): "convert it to netCDF-4, for example `nccopy -k nc4 {path} NEW.nc`",
    (MAP, SCAN): "give the scan that the map was built from",
    (_POOLED, _ESTIMATE): "give the maps that were pooled",
}
_LOOKED_AT = 4096


def kind_of(path: Path) -> str:
    """Kind of a file in words; empty when its first bytes do not show it."""
    try:
        start = first_bytes(path, _LOOKED_AT)
    except (BadDataError, OSError):
        return ""
    for beginning, kind in _BEGINNINGS.items():
        if start.startswith(beginning):
            return kind
    schema = _SCHEMA.search(start)
    return schema_kind(schema[0].decode().split('"')[-1]) if schema else ""


def schema_kind(schema: object) -> str:
    """Kind of a document in words by its ``schema``, such as ``tactile-bayes/estimate/1``; empty for others."""
    match str(schema).split("/"):
        case "tactile-bayes", name, *_:
            return _DOCUMENTS.get(name, f"a {name.replace('-', ' ')} (JSON)")
    return ""


def wrong_kind(path: Path, expected: str, *, what: str, way_out: str) -> BadDataError:
    """Error for a file of another kind than `expected` (in the words of `kind_of`); names the kind where it is known.

    `what` and `way_out` are the fault and the remedy where it is not, or where the file is of the expected kind and
    damaged.
    """
    kind = kind_of(path)
    if not kind or kind == expected:
        return BadDataError(what, way_out=way_out, path=str(path))
    return of_another_kind(path, kind, expected, way_out=way_out)


def of_another_kind(path: Path, kind: str, expected: str, *, way_out: str) -> BadDataError:
    """Error for a file of a `kind` other than `expected`, with the way from one to the other where there is one."""
    remedy = _WAYS.get((kind, expected), way_out).format(path=path)
    return BadDataError(f"is {kind}, not {expected}", way_out=remedy, path=str(path))


# --- Files in object stores by their addresses, through fsspec; who may read and write is the environment's matter.
#
# Nothing here is imported, and no network is used, unless somebody names such an address. Credentials come from
# where the store's own tools look for them (for `s3://` the AWS variables and files) and are in no message, file or
# log.

SCHEMES: Final = ("s3", "gs", "abfs")
"""Kinds of stores; `s3` is tried in the tests, each of the others needs its own package beside fsspec."""
_ADDRESS: Final = re.compile(rf"({'|'.join(SCHEMES)})://[^/\s@:]+(/[^\x00-\x1f\x7f]*)?")


def is_address(name: str) -> bool:
    """True when a name is the address of a file or folder in an object store, as ``s3://bucket/scan.mcap``."""
    return name.startswith(tuple(f"{scheme}://" for scheme in SCHEMES))


def check_address(address: str) -> str:
    """Address without a slash at its end; it must have a bucket and no user or password."""
    if not _ADDRESS.fullmatch(address):
        what = "the address of the object store is not as s3://bucket/folder"
        raise UsageError(f"{what}; no user, port or password in it")
    return address.rstrip("/")


def version_of(address: str) -> str:
    """Size, tag and time of a stored file, without reading it."""
    with _reading_store(address) as store:
        known = store.info(address)
    named = {key.lower(): known[key] for key in known}
    tag = named.get("etag") or named.get("md5hash") or named.get("content_md5")
    return f"{known.get('size')} {tag} {named.get('lastmodified') or named.get('updated')}"


def sha256_of(address: str) -> str:
    """Hex digest of a file's bytes, read as a stream; see `version_of` for the errors."""
    with _reading_store(address) as store, store.open(address, "rb") as file:
        return str(hashlib.file_digest(file, "sha256").hexdigest())


@contextlib.contextmanager
def downloaded(address: str) -> Iterator[Path]:
    """Temporary local copy of a stored file, for the length of the block; see `version_of` for the errors."""
    with tempfile.TemporaryDirectory(prefix="tactile-bayes-") as folder:
        path = Path(folder) / PurePosixPath(address).name
        with _reading_store(address) as store:
            store.get_file(address, str(path))
        yield path


def upload(path: Path, address: str) -> None:
    """Copy a local file into a store; it appears there whole or not at all."""
    try:
        _store(address).put_file(str(path), address)
    except Exception as error:
        raise UsageError(f"{address} cannot be written ({_reason(error)}); check address and credentials") from None


def files_below(address: str, *endings: str) -> Iterator[str]:
    """Addresses of all files below a folder with one of the `endings`, sorted; see `version_of` for the errors."""
    scheme = address.split("://", 1)[0]
    with _reading_store(address) as store:
        names = sorted(store.find(address))
    for name in names:
        if name.lower().endswith(endings):
            yield f"{scheme}://{name.split('://')[-1]}"


def _store(address: str) -> Any:
    """fsspec's file system of an address."""
    scheme = address.split("://", 1)[0]
    try:
        import fsspec

        # a listing that another process changed must not answer for it
        return fsspec.filesystem(scheme, use_listings_cache=False)
    except ImportError:
        raise UsageError(
            f"{scheme}:// needs a package that is not installed; for s3:// pip install 'tactile-bayes[cloud]', for "
            "others the package that fsspec names"
        ) from None


@contextlib.contextmanager
def _reading_store(address: str) -> Iterator[Any]:
    """The store of an address; a missing or closed file fails its exam, a fault of the store is a `UsageError`."""
    try:
        yield _store(address)
    except UsageError:
        raise
    except (FileNotFoundError, PermissionError, IsADirectoryError) as error:
        way_out = "check address and credentials"
        raise BadDataError(f"cannot be read ({_reason(error)})", way_out=way_out, path=address) from None
    except Exception as error:
        way_out = "check network and credentials, then run again"
        raise UsageError(f"{address} cannot be read ({_reason(error)}); {way_out}") from None


def _reason(error: Exception) -> str:
    """Text of a store's error in one line, without the query of a signed address."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, PermissionError):
        return "access denied"
    return re.sub(r"\?\S+", "?...", " ".join(str(error).split()))[:200] or type(error).__name__
