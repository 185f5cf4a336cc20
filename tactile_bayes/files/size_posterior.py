"""Sizes from what `estimate` wrote: its JSON, or the draws in its netCDF."""

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


def read_stated_size(path: Path) -> StatedSize:
    """The largest size that an estimate states.

    Raises
    ------
    BadDataError
        When the file is neither `estimate --json` of one map or one mass nor a posterior, or holds no size.
    """
    with open_input(path) as file:
        head = file.read(8)
    if head.lstrip().startswith((b"{", b"[")):
        return _from_json(path)
    if head.startswith(b"\x89HDF"):
        return _from_netcdf(path)
    way_out = "give what `estimate` wrote with --json or -o"
    raise BadDataError("is neither JSON nor netCDF", way_out=way_out, path=str(path))


def fill_from_posteriors(
    columns: Mapping[str, list[Any]], folder: Path, *, fault: Callable[..., BadDataError]
) -> tuple[dict[str, list[Any]], list[Path]]:
    """The columns of a trial table with sizes and intervals from the files in its ``posterior`` column.

    Parameters
    ----------
    folder
        Relative paths start here: the folder of the table.
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
        path = folder / name
        _check_blank(filled, row, fault=fault)
        stated = read_stated_size(path)
        _check_status(filled["status"][row], stated, row, fault=fault)
        for column in ("size_mm", "low_mm", "high_mm", "probability"):
            filled[column][row] = getattr(stated, column)
        paths.append(path)
    return filled, paths


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
    if status != "detected" and stated.size_mm is not None:
        way_out = "give status detected, or leave posterior blank"
        raise fault(
            row, "posterior", f"names an estimate with a size while status is {status or 'blank'}", way_out=way_out
        )


def _from_json(path: Path) -> StatedSize:
    document: Any = load_json(path, way_out="give `estimate --json`")
    if isinstance(document, list):
        if len(document) != 1:
            what = f"holds {len(document)} estimates"
            raise BadDataError(what, way_out="write each map's estimate to a file of its own", path=str(path))
        document = document[0]
    pooled = isinstance(document, dict) and str(document.get("schema", "")).startswith("tactile-bayes/pooled/")
    check_document(document, "pooled.schema.json" if pooled else "estimate.schema.json", path=path)
    size = document["max_size_mm"]
    if size is None:
        return StatedSize()
    return StatedSize(size["median"], size["low"], size["high"], size["probability"])


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
