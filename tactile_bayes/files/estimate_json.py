"""Checks of an estimate's JSON object beyond its schema: sizes that can be one lump's, in their order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.schema import check_document
from tactile_bayes.findings import findings_in, verdict

SCHEMAS: Final = {"tactile-bayes/estimate/1": "estimate.schema.json", "tactile-bayes/pooled/1": "pooled.schema.json"}
"""Schemas of what ``estimate`` prints as JSON, by their ids."""
MOST_MM: Final = 500.0
"""Sizes above it are no lump's."""
_SIZES: Final = ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm")
_WAY_OUT: Final = "give the JSON as `estimate --json` printed it"


def check_estimate(document: Mapping[str, Any], schema_name: str, *, path: Path) -> None:
    """Check what ``estimate --json`` printed for one map, or for several: its fields, and its sizes against each other.

    Raises
    ------
    BadDataError
        Naming the file, the field, its value and the rule it breaks.
    """
    check_document(document, schema_name, path=path)
    try:
        _check_sizes(document)
        _check_verdict(document)
    except BadDataError as error:
        raise error.at(path) from None


def _check_sizes(document: Mapping[str, Any]) -> None:
    if document["status"] != "estimate" and document["max_size_mm"] is not None:
        raise BadDataError(f"status is {document['status']!r}, and there is a max_size_mm", way_out=_WAY_OUT)
    for where, holder in _holders(document):
        for name in _SIZES:
            if holder.get(name) is not None:
                _check_size(f"{where}{name}", holder[name])
        largest, smallest = holder["max_size_mm"], holder["min_size_mm"]
        if (largest is None) != (smallest is None):
            raise BadDataError(f"{where}max_size_mm and min_size_mm are not both there", way_out=_WAY_OUT)
        if largest is not None and smallest["median"] > largest["median"]:
            what = f"{where}min_size_mm is {smallest['median']:g} mm and max_size_mm {largest['median']:g} mm"
            raise BadDataError(what, way_out=_WAY_OUT)
    _check_masses(document)


def _check_verdict(document: Mapping[str, Any]) -> None:
    made = verdict(findings_in(document["findings"]), answered=document["max_size_mm"] is not None)
    if document["verdict"] != made:
        what = f"verdict is {document['verdict']!r}, and its findings make it {made!r}"
        raise BadDataError(what, way_out=_WAY_OUT)


def _holders(document: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Whatever holds sizes, with its place in the document."""
    listed = document.get("masses") or ()
    for where, one in [("", document), *((f"masses[{i}].", mass) for i, mass in enumerate(listed))]:
        yield where, one
        if one.get("another_exam") is not None:
            yield f"{where}another_exam.", one["another_exam"]


def _check_size(where: str, size: Mapping[str, Any]) -> None:
    low, median, high = (size[name] for name in ("low", "median", "high"))
    if not 0 < low <= high <= MOST_MM:
        what = f"{where} has low {low:g} and high {high:g}"
        raise BadDataError(what, way_out=f"ends of an interval rise from above 0 to at most {MOST_MM:g} mm; {_WAY_OUT}")
    if size["kind"] == "eti" and not low <= median <= high:
        what = f"{where} has median {median:g} outside its interval of {low:g} to {high:g} mm"
        raise BadDataError(what, way_out=_WAY_OUT)
    if not 0 < median <= MOST_MM:
        raise BadDataError(f"{where} has median {median:g}", way_out=_WAY_OUT)


def _check_masses(document: Mapping[str, Any]) -> None:
    """Each mass has its own number, one at most is the reported one, and that has the document's sizes."""
    listed = document.get("masses") or ()
    numbers = [one["number"] for one in listed]
    if len(set(numbers)) < len(numbers):
        raise BadDataError(f"masses are numbered {', '.join(map(str, numbers[:9]))}", way_out=_WAY_OUT)
    reported = [i for i, one in enumerate(listed) if one["reported"]]
    if len(reported) > 1:
        raise BadDataError(f"{len(reported)} masses are the reported one", way_out=_WAY_OUT)
    for i in reported:
        for name in ("max_size_mm", "min_size_mm"):
            if listed[i][name] != document[name]:
                raise BadDataError(f"masses[{i}].{name} is not the document's, of the same mass", way_out=_WAY_OUT)
