"""`show`: the facts of a file, and the summary of a scan."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from tactile_bayes.declarations import as_dict
from tactile_bayes.errors import BadDataError, in_file
from tactile_bayes.files import scan_mcap
from tactile_bayes.files.documents import dump_json, load_json, load_schema, parse_json
from tactile_bayes.files.map_nc import read_map_and_header
from tactile_bayes.files.netcdf import Group, open_netcdf
from tactile_bayes.files.reading import HDF5_MAGIC, MCAP_MAGIC, first_bytes, is_json
from tactile_bayes.files.size_json import SHIPPED, read_repeatability, read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import header_of, read_table
from tactile_bayes.findings import finding_lines, findings_in
from tactile_bayes.mapping.select import Span, missing_records, with_times
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.scans import LANDMARK_NAMES, HeadGeometry
from tactile_bayes.shell import padded, text_width
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.pooling import Calibration


def show_action(file: Path, as_json: bool) -> None:
    """Show what a file holds: schema, shape, units, quality, provenance."""
    shipped = size_calibration_path(file.name) if str(file) in SHIPPED and not file.exists() else None
    facts = describe(shipped or file)
    lines = ["\\n".join(line.splitlines()) for line in fact_lines(facts)]  # a fact must not look like several
    click.echo(dump_json(facts) if as_json else "\n".join([*lines, RESEARCH_USE, ""]), nl=False)


_MOST_NUMBERS = 30  #: Longer lists of numbers are shown by their range.


def fact_lines(facts: dict[str, Any], indent: str = "") -> Iterator[str]:
    """Facts of a file, one per line, those of tables indented."""
    width = max(map(text_width, facts), default=0)
    for name, value in facts.items():
        if isinstance(value, dict) and value:
            yield f"{indent}{name}"
            yield from fact_lines(value, indent + "  ")
        else:
            yield f"{indent}{padded(name, width)}  {_value_text(value)}"


def _value_text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        leaves = list(_leaves(list(value)))
        if len(leaves) > _MOST_NUMBERS and all(isinstance(leaf, int | float) for leaf in leaves):
            return f"{len(leaves)} numbers, {min(leaves):.6g} to {max(leaves):.6g}"
        return ", ".join(_value_text(item) for item in value) if value else "none"
    if isinstance(value, dict):
        return "none" if not value else "; ".join(f"{k} {_value_text(v)}" for k, v in value.items())
    return "none" if value is None else str(value)


def _leaves(value: list[Any]) -> Iterator[Any]:
    for item in value:
        yield from _leaves(item) if isinstance(item, list) else [item]


# --- Kind of a file, by its first bytes, and its facts.

_UNITS = {"sigma": "mm", "d": "mm", "amplitude": "1 is the background"}
_ACCOUNT = (
    *("frames_lost", "head_dropped", "poses_repeated", "poses_flagged", "flagged_why", "poses_missing", "missing_why"),
    *("other_tools", "overrun_bytes", "ended_by", "fault"),
)
_TABLES = ("trial", "excision", "exams_done", "failures", "growth", "exams", "population", "size_table", "phantom_maps")


def describe(path: Path) -> dict[str, Any]:
    """Describe a file of ours: ``schema``, ``kind``, and shape, units, quality and provenance as the kind has them."""
    head = first_bytes(path, 4096)
    if head.startswith(MCAP_MAGIC):
        return _scan(path)
    if head.startswith(HDF5_MAGIC):
        with open_netcdf(path, way_out="it may be cut short; make it again") as netcdf:
            group = netcdf.group("posterior")
            if group is not None and "schema" in group.attributes():
                return _posterior(group)
        return _map(path)
    if is_json(head) and path.suffix.lower() != ".toml":  # a table of TOML begins as a list does
        return _json(path)
    return _table(path)


def _posterior(group: Group) -> dict[str, Any]:
    attributes = group.attributes()
    return {
        "schema": attributes["schema"],
        "kind": "posterior",
        "method": attributes.get("method", ""),
        "chains": group.dimension("chain"),
        "draws": group.dimension("draw"),
        "variables": [name for name in group.variables() if name not in ("chain", "draw")],
        "units": {"_mm": "mm", "_rad": "rad", "others": "as the map: 1 is the background"},
        **_verdict_facts(parse_json(attributes.get("estimate", "{}"))),
        "diagnostics": parse_json(attributes.get("diagnostics", "{}")),
        "provenance": parse_json(attributes.get("provenance", "{}")),
    }


def _verdict_facts(document: Any) -> dict[str, Any]:
    """Verdict of an estimate and its findings in sentences; empty for a document without findings."""
    if not isinstance(document, dict) or "findings" not in document:
        return {}
    return {"verdict": document.get("verdict"), "findings": finding_lines(findings_in(document["findings"]))}


def _map(path: Path) -> dict[str, Any]:
    tactile_map, header = read_map_and_header(path)
    ny, nx = tactile_map.mean.shape
    unit = tactile_map.recipe.value_unit
    return {
        "schema": header.schema,
        "kind": "map",
        "shape": {"ny": ny, "nx": nx},
        "extent_mm": {"x": nx * tactile_map.recipe.cell_mm, "y": ny * tactile_map.recipe.cell_mm},
        "units": {"x": "mm", "y": "mm", "mean": "1 is the background" if unit == "1" else unit or "unknown"},
        "covered_cells": int(tactile_map.covered.sum()),
        "background": tactile_map.background,
        "frames": tactile_map.frame_count,
        "patient_frame": tactile_map.patient_from_plane is not None,
        **({} if tactile_map.nipple_mm is None else {"nipple_mm": tactile_map.nipple_mm.tolist()}),
        "findings": finding_lines(tactile_map.findings),
        "recipe": as_dict(tactile_map.recipe),
        **({} if tactile_map.head is None else {"head": as_dict(tactile_map.head)}),
        "quality": dict(tactile_map.quality),
        "masked_taxels": list(tactile_map.masked_taxels),
        "provenance": header.provenance,
    }


def _json(path: Path) -> dict[str, Any]:
    document: Any = load_json(path, way_out="give one of this program's files")
    if isinstance(document, list) and document and isinstance(document[0], dict):
        told = {str(number): facts for number, one in enumerate(document, 1) if (facts := _verdict_facts(one))}
        return {"schema": document[0].get("schema"), "kind": "list", "length": len(document), "of_each": told}
    schema = document.get("schema") if isinstance(document, dict) else None
    if not isinstance(schema, str) or not schema.startswith("tactile-bayes/"):
        raise _foreign(path)
    if schema.startswith("tactile-bayes/size-calibration/"):
        return _described(read_size_calibration(path), document)
    if schema.startswith("tactile-bayes/site-calibration/"):
        return _site_calibration(path, document)
    if schema.startswith("tactile-bayes/repeatability/"):
        return _repeatability(path, document)
    facts = {name: value for name, value in document.items() if name not in ("schema", "modalities")}
    return {"schema": schema, "kind": schema.split("/")[1], **facts, **_verdict_facts(document)}


def _site_calibration(path: Path, document: dict[str, Any]) -> dict[str, Any]:
    calibration = read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    assert calibration.site is not None
    site = calibration.site
    middle, low, high = site.percent(site.phantoms_log_width)
    names = ("base", "phantoms", "maps", "mean", "covariance", "uses_fat", "fit", "cautions", "left_out")
    facts = {name: document["site"][name] for name in names}
    return {
        "schema": document["schema"],
        "kind": "size calibration corrected by phantoms",
        "correction": {"percent": middle, "percent_interval": [low, high], **facts},
        "base": _described(calibration, document["base"]),
        "provenance": document["provenance"],
    }


def _repeatability(path: Path, document: dict[str, Any]) -> dict[str, Any]:
    repeatability = read_repeatability(path)
    provenance = dict(document["provenance"])
    inputs = provenance.get("inputs")
    if isinstance(inputs, list):  # without the draws of each exam, of which there may be many
        provenance["inputs"] = [
            one for one in inputs if not (isinstance(one, dict) and str(one.get("role")).startswith("draws_"))
        ]
    names = ("between_map_sd", "log_sd", "median", "low", "high", "probability", "masses", "maps", "calibration")
    return {
        "schema": document["schema"],
        "kind": "spread between exams of one mass at a site",
        "in_words": repeatability.words(),
        **{name: document[name] for name in (*names, "half_width") if name in document},
        "units": {"between_map_sd, median, low, high, half_width": "share of the size"},
        "repeats": {one["name"]: f"{len(one['exams'])} exams" for one in document["repeats"]},
        "outlying": document["outlying"],
        "left_out": document["left_out"],
        "provenance": provenance,
    }


def _described(calibration: Calibration, document: dict[str, Any]) -> dict[str, Any]:
    """Facts of a calibration's document, without its long arrays."""
    if isinstance(calibration, BodyCalibration):
        names = ("form", "source", "bodies", "recipe", "centre", "constants", "domain", "fit", "provenance")
        return {
            "schema": document["schema"],
            "kind": "size calibration",
            "head": str(calibration.recipe.head),
            "units": _UNITS,
            **{name: document[name] for name in names},
            "variance_taken_away_by_knowing": calibration.unknowns,
            "residual_points": 0 if calibration.residual is None else len(calibration.residual.points),
            "fat_mm": None if calibration.depth is None else list(calibration.depth.fat_mm),
            "other_sd": calibration.other_sd,
            "other_source": calibration.spread.other_source,
        }
    of_axis = ("mean", "domain", "fit", "reference_amplitude")
    return {
        "schema": document["schema"],
        "kind": "size calibration",
        "form": document["form"],
        "axes": document["axes"],
        "recipe": document["recipe"],
        "draws": len(calibration.x.draws),
        "units": _UNITS,
        "residual_correlation": document["residual_correlation"],
        **{axis: {name: document[axis][name] for name in of_axis} for axis in ("x", "y")},
        "provenance": document["provenance"],
    }


def _table(path: Path) -> dict[str, Any]:
    """Describe a CSV table whose header fits one of the schemas."""
    header = header_of(path)
    for name in _TABLES:
        schema = load_schema(f"{name}.table.json")
        required = {f["name"] for f in schema["fields"] if f.get("constraints", {}).get("required")}
        if header and required <= set(header):
            table = read_table(path, f"{name}.table.json", may_be_empty=True)
            filled = [n for n, values in table.columns.items() if any(v is not None for v in values)]
            kind = f"table: {name.replace('_', ' ')}"
            return {"schema": schema["$id"], "kind": kind, "rows": len(table), "columns": filled}
    raise _foreign(path)


def _foreign(path: Path) -> BadDataError:
    return BadDataError(
        "is empty" if not path.stat().st_size else "is no scan, map, table or report that `show` can describe",
        way_out="bring arrays, grids and images in with `tactile-bayes import`; settings and scenes are plain text",
        path=str(path),
    )


def _scan(path: Path) -> dict[str, Any]:
    """Summarise frames, poses, duration, losses, session and provenance; memory grows by one time per message.

    The content of the messages is not read, so faults in it are not reported.
    """
    records = scan_mcap.scan_records(path, keep=())
    with in_file(path):
        head = scan_mcap.read_attachment(records, HeadGeometry, "head.json")
        time_s = scan_mcap.message_times(records.messages("/pressure", schema="foxglove.Grid"), topic="/pressure")
        pose_s = scan_mcap.message_times(records.messages("/pose", schema="foxglove.PoseInFrame"), topic="/pose")
        touches = {
            name: len(records.messages("/landmark", schema="foxglove.PoseInFrame", name=name))
            for name in (*LANDMARK_NAMES, scan_mcap.NIPPLE)
        }
        findings = with_times(scan_mcap.file_findings(records), Span.of(time_s), Span.of(pose_s))
        provenance = scan_mcap.provenance_of(records)
    span_s = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    account = records.metadata.get("recording", {})  # of the recorder, where it wrote the file
    recording = {name: account[name] for name in _ACCOUNT if account.get(name)}
    logs = [number for number, channel in records.channels.items() if channel.topic == "/log"]
    return {
        "schema": scan_mcap.SCAN_SCHEMA,
        "kind": "scan",
        "complete": records.finished and not records.lost,
        "findings": finding_lines(findings),
        "frames": len(time_s),
        "taxels": list(head.shape),
        "poses": len(pose_s),
        "duration_s": span_s,
        "frame_rate_hz": (len(time_s) - 1) / span_s if span_s > 0 else None,
        "frames_missing": missing_records(time_s),
        "notes": sum(len(records.by_channel.get(number, ())) for number in logs),
        **({"recording": recording} if recording else {}),
        "landmarks": all(touches[name] for name in LANDMARK_NAMES),
        "nipple": touches[scan_mcap.NIPPLE] > 0,
        "units": {"counts": "raw, 0 to saturation", "pressure": "kPa", "position": "mm", "time": "s"},
        "session": dict(records.metadata.get("session", {})),
        "provenance": provenance,
    }
