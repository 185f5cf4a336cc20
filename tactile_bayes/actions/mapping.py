"""`map`: from scans to a tactile map."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import click

from tactile_bayes.declarations import EXACT, to_plain
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import first_duplicate, refuse_existing, refuse_same, sha256
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance, repeated_scans, scan_facts
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.options import MapOptions
from tactile_bayes.report.figure_file import exam_title
from tactile_bayes.report.map import map_figure, map_summary, map_text
from tactile_bayes.shell import progress_bar


def map_action(
    scans: tuple[Path, ...], output: Path | None, figure: Path | None, force: bool, verbose: bool, **options: Any
) -> None:
    """Build a tactile map from one scan, or one common map from several scans of the same examination."""
    if twice := first_duplicate(scans):
        raise UsageError(f"{twice} is given twice; its frames would count twice: give each scan once")
    if output is None:
        first = scans[0]
        output = first.parent / ("map.nc" if first.stem == "scan" else f"{first.stem}.nc")
        if first_duplicate([*scans, output]) is not None:
            read_scan(output)  # a map given in place of a scan is named as such
        refuse_same([output], scans)
        if output.exists() and not force:
            raise UsageError(f"{output} exists; name another with -o, or give --force")
        refuse_existing(output, force=force)
    settings = to_plain(MapOptions(**options), digits=EXACT)
    times = [("begun", time.perf_counter())]
    loaded = [read_scan(path) for path in scans]
    facts = [scan_facts(scan, sha256(path)) for scan, path in zip(loaded, scans, strict=True)]
    inputs = {f"scan_{number}": fact["sha256"] for number, fact in enumerate(facts, start=1)}
    provenance = Provenance("map", settings, inputs, scans=facts)
    for later, earlier in repeated_scans([[facts] for facts in provenance.scans]).items():
        raise UsageError(f"{scans[later]} holds the recording of {scans[earlier]}; give each recording once")
    times.append(("read", time.perf_counter()))
    with progress_bar("frames") as progress:
        tactile_map = build_map(loaded, **options, progress=progress)
    times.append(("map", time.perf_counter()))
    write_map(output, tactile_map, provenance=provenance, force=force)
    try:
        if figure:
            title = f"Tactile map: {exam_title(output.stem, provenance.scans)}"
            map_figure(tactile_map, figure, title=title, force=force)
        times.append(("write", time.perf_counter()))
    finally:  # a figure that cannot be written loses no text
        text = map_text(tactile_map) if verbose else map_summary(tactile_map, written=str(output))
        click.echo(text, nl=False)
        if verbose:
            for (_, before), (step, after) in pairwise(times):
                click.echo(f"{step}: {after - before:.3f} s", err=True)
