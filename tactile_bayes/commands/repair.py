"""`repair`: close a scan file that was cut off."""

from __future__ import annotations

from pathlib import Path

import click

from tactile_bayes.commands.options import FORCE, FilePath
from tactile_bayes.presets import RESEARCH_USE


@click.command("repair")
@click.argument("scan", metavar="SCAN.mcap", type=FilePath())
@click.option(
    "-o",
    "--output",
    metavar="OUT.mcap",
    type=FilePath(writes="MCAP"),
    help="Write to this file instead of replacing SCAN.mcap.",
)
@FORCE
def command(*, scan: Path, output: Path | None, force: bool) -> None:
    """Repair a scan that was cut off or damaged: keep what is intact, report what is lost.

    The file is replaced when the new one is whole, unless -o is given. A file that is whole already is left alone.

    Example: tactile-bayes repair scan.mcap
    """
    from tactile_bayes.commands.import_ import describe_scan
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan_report, read_truth, write_scan
    from tactile_bayes.files.scan_recording import refuse_recording

    if output is not None:
        refuse_existing(output, force=force)
    if output is None:
        refuse_recording(scan)
    file = read_scan_report(scan)
    if file.complete and output is None:
        click.echo(f"{scan}: is whole, nothing to repair")
        return
    made = {"was": dict(file.provenance), "lost": list(file.lost)}
    provenance = Provenance("repair", made, inputs=hash_inputs(scan=scan))
    target = output or scan
    write_scan(target, file.scan, provenance=provenance, truth=read_truth(scan), force=force or output is None)
    lines = [f"{target}: scan", *describe_scan(file.scan), *(f"lost: {line}" for line in file.lost), RESEARCH_USE]
    for line in lines:
        click.echo(line)
