"""Sizes from the output of `estimate`: its JSON, or the draws in its netCDF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.netcdf import open_netcdf
from tactile_bayes.files.reading import open_input
from tactile_bayes.files.schema import check_document

PROBABILITY = 0.95


@dataclass(frozen=True, slots=True)
class StatedSize:
    """Largest size in mm with its interval; None throughout where there was no estimate."""

    size_mm: float | None = None
    low_mm: float | None = None
    high_mm: float | None = None
    probability: float | None = None


def read_stated_size(path: Path, number: int | None = None) -> StatedSize:
    """The largest size that an estimate states.

    Parameters
    ----------
    number
        Which estimate of a list, from 1; a list of one needs none.

    Raises
    ------
    BadDataError
        When the file is neither `estimate --json` of one map or one mass nor a posterior, or holds no size.
    """
    with open_input(path) as file:
        head = file.read(8)
    if head.lstrip().startswith((b"{", b"[")):
        return _from_json(path, number)
    if number is not None:
        raise BadDataError("is no list of estimates", way_out=f"leave out #{number}", path=str(path))
    if head.startswith(b"\x89HDF"):
        return _from_netcdf(path)
    way_out = "give what `estimate` wrote with --json or -o"
    raise BadDataError("is neither JSON nor netCDF", way_out=way_out, path=str(path))


def fill_from_posteriors(
    columns: Mapping[str, list[Any]], folder: Path, *, fault: Callable[..., BadDataError]
) -> tuple[dict[str, list[Any]], list[Path]]:
    """Fill sizes and intervals in a trial table from the files in its ``posterior`` column.

    Parameters
    ----------
    folder
        Relative paths start here: the folder of the table. ``batch.json#3`` is the third of a list.
    fault
        Makes the error for a cell, as `Table.error` does.

    Returns
    -------
    New columns, and the files that were read, in order.
    """
    filled = {name: list(values) for name, values in columns.items()}
    paths = []
    for row, name in enumerate(filled.get("posterior", [])):
        if not name:
            continue
        path, number = _split_number(folder, name)
        _check_blank(filled, row, fault=fault)
        stated = read_stated_size(path, number)
        _check_status(filled["status"][row], stated, row, fault=fault)
        for column in ("size_mm", "low_mm", "high_mm", "probability"):
            filled[column][row] = getattr(stated, column)
        paths.append(path)
    return filled, list(dict.fromkeys(paths))


def _split_number(folder: Path, name: str) -> tuple[Path, int | None]:
    """Split a cell that ends in #NUMBER into the file and the number of the estimate in it."""
    stem, mark, number = name.rpartition("#")
    if mark and number.isascii() and number.isdigit() and len(number) < 10 and not (folder / name).exists():
        return folder / stem, int(number)
    return folder / name, None


def _check_blank(columns: Mapping[str, list[Any]], row: int, *, fault: Callable[..., BadDataError]) -> None:
    for column in ("size_mm", "low_mm", "high_mm", "probability", "sd_mm"):
        if columns[column][row] is not None:
            raise fault(
                row,
                column,
                f"is {columns[column][row]:g} beside a posterior",
                way_out="leave it blank: the file says it",
            )


def _check_status(status: str | None, stated: StatedSize, row: int, *, fault: Callable[..., BadDataError]) -> None:
    if status == "detected" and stated.size_mm is None:
        way_out = "give status not_detected, or not_done"
        raise fault(row, "posterior", "names an estimate without a size while status is detected", way_out=way_out)
    if status is None and stated.size_mm is None:
        what = "is blank beside a posterior that names an estimate without a size"
        raise fault(row, "status", what, way_out="give status not_detected (the mass was looked for), or not_done")
    if status != "detected" and stated.size_mm is not None:
        way_out = "give status detected, or leave posterior blank"
        raise fault(
            row, "posterior", f"names an estimate with a size while status is {status or 'blank'}", way_out=way_out
        )


def _from_json(path: Path, number: int | None) -> StatedSize:
    document: Any = load_json(path, way_out="give `estimate --json`")
    if isinstance(document, list):
        document = document[_index(path, len(document), number)]
    elif number is not None:
        raise BadDataError("holds one estimate, no list", way_out=f"leave out #{number}", path=str(path))
    pooled = isinstance(document, dict) and str(document.get("schema", "")).startswith("tactile-bayes/pooled/")
    check_document(document, "pooled.schema.json" if pooled else "estimate.schema.json", path=path)
    size = document["max_size_mm"]
    if size is None:
        return StatedSize()
    return StatedSize(size["median"], size["low"], size["high"], size["probability"])


def _index(path: Path, length: int, number: int | None) -> int:
    """Index of the wanted estimate in a list of estimates."""
    if number is None and length == 1:
        return 0
    if number is None or not 1 <= number <= length:
        wanted = "" if number is None else f" and none with the number {number}"
        way_out = f"name one as {path.name}#1 to {path.name}#{length}, in the order of the maps"
        raise BadDataError(f"holds {length} estimates{wanted}", way_out=way_out, path=str(path))
    return number - 1


def _from_netcdf(path: Path) -> StatedSize:
    with open_netcdf(path, way_out="give what `estimate` wrote with --json or -o") as file:
        group = file.group("posterior")
        values = None if group is None else group.array("max_size_mm", kind="f8", dimensions=("chain", "draw"))
    values = np.zeros(0) if values is None else values.ravel()[np.isfinite(values.ravel()) & (values.ravel() > 0)]
    if len(values) < 2:
        way_out = "estimate with --size-calibration, so that the posterior holds sizes"
        raise BadDataError("holds no draws of max_size_mm", way_out=way_out, path=str(path))
    low, median, high = np.quantile(values, [0.5 - PROBABILITY / 2, 0.5, 0.5 + PROBABILITY / 2])
    return StatedSize(float(median), float(low), float(high), PROBABILITY)
