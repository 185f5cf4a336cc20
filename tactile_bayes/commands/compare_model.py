"""`compare-model`: a scan's frames and map against a forward model of a scene (section 2.3 of the paper)."""

from __future__ import annotations

from pathlib import Path

import click

from tactile_bayes.commands.options import FORCE, JSON, METAVAR, PRESSURE_WINDOW, FigurePath, FilePath, head_option
from tactile_bayes.presets import CELL_MM

_FILE = FilePath()
_FIDELITIES = ("solid", "plane-strain", "empirical", "empirical-gaussian")


@click.command("compare-model")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@click.argument("scene", metavar="SCENE.toml", type=_FILE)
@click.option(
    "--fidelity",
    "fidelities",
    type=click.Choice(_FIDELITIES),
    multiple=True,
    help="Model of the tissue; may be repeated. Default: the one the scene is written for.",
)
@head_option("Default: as for `simulate`.")
@click.option(
    "--at",
    type=(float, float),
    metavar="X Y",
    help="The lump's place on the scan's map, mm. Default: the highest bump that can be one; 0 0 for a scene of none.",
)
@click.option("--every", type=click.IntRange(min=1), default=1, show_default=True, help="Compare one frame in so many.")
@click.option("--cell-mm", type=float, default=CELL_MM, show_default=True, help="Side of the map's cells, mm.")
@PRESSURE_WINDOW
@click.option("--latency-ms", type=float, default=0.0, show_default=True, help="Delay of the tracker's time stamps.")
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw frames, maps and what the model leaves.")
@JSON
@FORCE
def command(
    *,
    scan: Path,
    scene: Path,
    fidelities: tuple[str, ...],
    head: str | None,
    at: tuple[float, float] | None,
    every: int,
    cell_mm: float,
    pressure_window_kpa: tuple[float, float],
    latency_ms: float,
    figure: Path | None,
    as_json: bool,
    force: bool,
) -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper).

    The model's head stands where the scan's did and presses with the same mean, frame by frame; the scene's first lump
    is put where the scan's map has one, and its strokes, noise and tracker are not used. Printed are the mean squared
    differences of frames and maps, as shares of the model's sum of squares, and the bump of Eq 7 on both maps: the
    first kind hides a bump under the level it stands on. The empirical model holds for lumps of 10 mm and more down to
    h/d 1, and warns outside.

    Example: tactile-bayes compare-model scan.mcap scene.toml --fidelity plane-strain --fidelity empirical
    """
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.documents import dump_json
    from tactile_bayes.files.provenance import hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.files.scene_toml import read_scene
    from tactile_bayes.findings import finding_lines
    from tactile_bayes.forward.line import outside_range
    from tactile_bayes.mapping.select import scan_findings
    from tactile_bayes.presets import RESEARCH_USE
    from tactile_bayes.report.paper_head import comparison_document, comparison_figure, comparison_text
    from tactile_bayes.studies.model_comparison import compare_model, measured_frames

    if figure is not None:
        refuse_existing(figure, force=force)
    body = read_scene(scene)
    loaded = read_scan(scan)
    if at is None and not (body.solid_lumps or body.lumps):
        at = (0.0, 0.0)  # no lump to look for: the middle of the strokes
    measured = measured_frames(
        loaded,
        every=every,
        cell_mm=cell_mm,
        pressure_window_kpa=pressure_window_kpa,
        latency_ms=latency_ms,
        place_mm=at,
    )
    found = []
    for fidelity in dict.fromkeys(fidelities or (body.fidelity,)):
        warnings = [outside_range(one.d_mm, one.depth_ratio) for one in body.solid_lumps if fidelity == "empirical"]
        for warning in filter(None, warnings):
            click.echo(warning, err=True)
        with progress_bar(f"frames, {fidelity}") as progress:
            found.append(compare_model(measured, body, fidelity=fidelity, head=head, progress=progress))
    if figure is not None:
        comparison_figure(measured, found, figure, title=f"{scan.stem} against {scene.stem}", force=force)
    if as_json:
        click.echo(
            dump_json(comparison_document(measured, found, inputs=hash_inputs(scan=scan, scene=scene))), nl=False
        )
        return
    for line in finding_lines(scan_findings(loaded)):
        click.echo(line, err=True)
    click.echo(comparison_text(measured, found))
    click.echo(RESEARCH_USE)
