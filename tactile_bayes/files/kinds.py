"""Kind of a file by its first bytes; a reader given another kind names the command to run instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.reading import open_input

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
HDF5_MAGIC: Final = b"\x89HDF\r\n\x1a\n"
ZIP_MAGIC: Final = b"PK\x03\x04"
_BEGINNINGS = {
    MCAP_MAGIC: "a scan",
    HDF5_MAGIC: "a map or posterior (netCDF)",
    ZIP_MAGIC: "an archive (.npz or a spreadsheet)",
    b"\x89PNG": "an image",
    b"II*\x00": "an image",
    b"MM\x00*": "an image",
    b"P5": "an image",
    b"%PDF": "a PDF",
}
_SCHEMA = re.compile(rb'"schema"\s*:\s*"tactile-bayes/([a-z0-9-]+)/')
_KINDS = {
    "estimate": "an estimate (JSON)",
    "pooled": "a pooled estimate (JSON)",
    "size-calibration": "a size calibration (JSON)",
    "site-calibration": "a size calibration corrected by phantoms (JSON)",
    "repeatability": "a site's repeatability (JSON)",
    "validate": "a trial report (JSON)",
    "plan": "a trial plan (JSON)",
}
_WAYS = {
    ("a scan", "a map or posterior (netCDF)"): "build its map first: `tactile-bayes map {path} -o MAP.nc`",
    ("an archive (.npz or a spreadsheet)", "a scan"): "bring it in first: `tactile-bayes import {path} -o SCAN.mcap`",
    (
        "an archive (.npz or a spreadsheet)",
        "a map or posterior (netCDF)",
    ): "bring it in first: `tactile-bayes import --help` says how",
    ("an image", "a map or posterior (netCDF)"): "bring it in first: `tactile-bayes import {path} --as map -o MAP.nc`",
    ("a map or posterior (netCDF)", "a scan"): "give the scan that the map was built from",
}
_LOOKED_AT = 4096


def kind_of(path: Path) -> str:
    """Kind of a file in words; empty when its first bytes do not show it."""
    try:
        with open_input(path) as file:
            start = file.read(_LOOKED_AT)
    except (BadDataError, OSError):
        return ""
    for beginning, kind in _BEGINNINGS.items():
        if start.startswith(beginning):
            return kind
    schema = _SCHEMA.search(start)
    return schema_kind(schema[0].decode().split('"')[-1]) if schema else ""


def schema_kind(schema: object) -> str:
    """Kind of a document by its schema, in words; empty for a schema that is not this program's.

    Parameters
    ----------
    schema
        The value of the document's ``schema``, such as ``tactile-bayes/estimate/1``.
    """
    parts = schema.split("/") if isinstance(schema, str) else []
    if len(parts) < 2 or parts[0] != "tactile-bayes":
        return ""
    return _KINDS.get(parts[1], f"a {parts[1].replace('-', ' ')} (JSON)")


def not_a(path: Path, wanted: str, *, what: str, way_out: str) -> BadDataError:
    """Error for a file of another kind than the reader's; names the kind where it is known.

    Parameters
    ----------
    path
        The file.
    wanted
        What the reader reads, as `kind_of` would call it.
    what, way_out
        The fault and the remedy where the file's kind is unknown, or is the wanted one and damaged.
    """
    found = kind_of(path)
    if not found or found == wanted:
        return BadDataError(what, way_out=way_out, path=str(path))
    remedy = _WAYS.get((found, wanted), way_out).format(path=path)
    return BadDataError(f"is {found}, not {wanted}", way_out=remedy, path=str(path))
