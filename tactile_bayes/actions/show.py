"""`show`: what a file holds, and what a scan is in a few lines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.identify import describe
from tactile_bayes.files.size_json import SHIPPED, size_calibration_path
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.select import intervals, missing_records
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.scans import Scan
from tactile_bayes.shell import padded, shown_columns


def show_action(file: Path, as_json: bool) -> None:
    """Show what a file holds: schema, shape, units, quality, provenance."""
    shipped = size_calibration_path(file.name) if str(file) in SHIPPED and not file.exists() else None
    found = describe(shipped or file)
    click.echo(dump_json(found) if as_json else "\n".join([*shown(found), RESEARCH_USE, ""]), nl=False)


_MOST_NUMBERS = 30  #: Of a list that is shown whole.


def shown(found: dict[str, Any], indent: str = "") -> Iterator[str]:
    """Description of a file, one fact per line."""
    width = max(map(shown_columns, found), default=0)
    for name, value in found.items():
        if isinstance(value, dict) and value:
            yield f"{indent}{name}"
            yield from shown(value, indent + "  ")
        else:
            yield f"{indent}{padded(name, width)}  {_plain(value)}"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        leaves = list(_leaves(value))
        if len(leaves) > _MOST_NUMBERS and all(isinstance(one, int | float) for one in leaves):
            return f"{len(leaves)} numbers, {min(leaves):.6g} to {max(leaves):.6g}"
        return ", ".join(_plain(item) for item in value) if value else "none"
    if isinstance(value, dict):
        return "none" if not value else "; ".join(f"{k} {_plain(v)}" for k, v in value.items())
    return "none" if value is None else str(value)


def _leaves(value: list[Any]) -> Iterator[Any]:
    for item in value:
        yield from _leaves(item) if isinstance(item, list) else [item]


def describe_scan(scan: Scan) -> list[str]:
    """Summary of a scan in a few lines."""
    times, poses = scan.frames.time_s, scan.poses
    span = float(times[-1] - times[0]) if len(times) else 0.0
    saturated = int((scan.frames.counts >= scan.element_calibration.saturation_count).sum())
    duplicates = int((np.diff(poses.time_s) == 0).sum())
    marks = [] if scan.landmarks is None else [name.replace("_", " ") for name in scan.landmarks.points()]
    return [
        f"{len(times)} frames of {scan.head.shape[0]} x {scan.head.shape[1]} taxels in {span:.3f} s, {_rate(times)}",
        f"{len(poses)} poses, {_rate(poses.time_s)}",
        f"dropped frames {missing_records(times)}, dropped poses {missing_records(poses.time_s)}, "
        f"duplicate pose stamps {duplicates}, saturated readings {saturated}",
        f"landmarks: {' and '.join(', '.join(marks).rsplit(', ', 1)) or 'not touched'}",
    ]


def _rate(times: FloatArray) -> str:
    steps, usual = intervals([times])
    return f"{1 / usual:.1f} Hz" if len(steps) else "no rate"
