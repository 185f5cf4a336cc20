"""`show`: describe a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from tactile_bayes.commands.options import JSON, FilePath
from tactile_bayes.presets import RESEARCH_USE


@click.command("show")
@click.argument("file", type=FilePath())
@JSON
def command(file: Path, as_json: bool) -> None:
    """Show what a file holds: schema, shape, units, quality, provenance.

    Knows scans, maps, posteriors, size calibrations, reports and the tables of trials and phantoms. Calibrations that
    come with the program are known by their names where no file is called so: solid, solid-mean, eq6, plane-strain.

    Example: tactile-bayes show map.nc
    """
    from tactile_bayes.files.documents import dump_json
    from tactile_bayes.files.identify import describe
    from tactile_bayes.files.shipped import SHIPPED, size_calibration_path

    shipped = size_calibration_path(file.name) if str(file) in SHIPPED and not file.exists() else None
    found = describe(shipped or file)
    if as_json:
        click.echo(dump_json(found), nl=False)
        return
    click.echo(shown(found))
    click.echo(RESEARCH_USE)


def shown(found: dict[str, Any]) -> str:
    """Description of a file, one fact per line."""
    return "\n".join(_lines(found))


def _lines(found: dict[str, Any], indent: str = "") -> Iterator[str]:
    """Nested facts as lines."""
    width = max((len(name) for name in found), default=0)
    for name, value in found.items():
        if isinstance(value, dict) and value:
            yield f"{indent}{name}"
            yield from _lines(value, indent + "  ")
        else:
            yield f"{indent}{name.ljust(width)}  {_plain(value)}"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_plain(item) for item in value) if value else "none"
    if isinstance(value, dict):
        return "none" if not value else "; ".join(f"{k} {_plain(v)}" for k, v in value.items())
    return "none" if value is None else str(value)
