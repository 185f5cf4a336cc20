"""`tradeoff forward`: error in amplitude, width and size against CPU time, for one lump and every forward model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.options import FORCE, JSON, METAVAR, FigurePath, FilePath, FiniteRange, head_option

if TYPE_CHECKING:
    from tactile_bayes.report.forward_tradeoff import TradeoffReport
    from tactile_bayes.studies.tradeoffs import LumpCase, Measured, SizeRule

_FILE = FilePath()
LEARNED = "learned"


@click.command("forward")
@click.argument("scene", required=False, metavar="[SCENE.toml]", type=_FILE)
@click.option(
    "--size-calibration",
    metavar="solid-mean|plane-strain|learned|SIZE.json",
    help="Calibration for the sizes: a shipped one, your own file, or Eq 6 learned in this run. Default: each "
    "model's own.",
)
@head_option(
    "Default: shoulders-inside for plane-strain and the empirical model, as the scene's [head] gives them for solid."
)
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw error in size against time.")
@click.option(
    "--tolerance-percent",
    type=FiniteRange(min=0.0, min_open=True),
    default=0.5,
    show_default=True,
    help="Error in size below which more accuracy is not worth its cost.",
)
@click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Number of runs; the shortest time counts.",
)
@JSON
@FORCE
def command(
    *,
    scene: Path | None,
    size_calibration: str | None,
    head: str | None,
    figure: Path | None,
    tolerance_percent: float,
    runs: int,
    as_json: bool,
    force: bool,
) -> None:
    """Measure error in amplitude, width and size against CPU time, for the lump of a scene.

    The empirical model (which holds for lumps of 10 mm and more down to h/d 1, and warns outside), plane strain at
    several cells and the solid model at several meshes, ranks and rims compute the
    map of one lump, here and now; each model's finest setting is the reference of its others. Without SCENE.toml: a
    hard ball of 15 mm at h/d 1, its centre on the gland.

    Sizes come from the calibration that `estimate` uses, and the cylinder's from `plane-strain`. These maps have no
    noise and a background of 1, so a size may be off; what counts is how it changes, which is given in mm and percent.
    With --size-calibration learned Eq 6 is learned, in most of a minute, from each model's own lumps in the same body
    and under the same head; the calibrations that come with the program are of the default heads.

    Example: tactile-bayes tradeoff forward --figure tradeoff.png
    """
    import json

    from tactile_bayes.commands.options import also_read
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.presets import RESEARCH_USE
    from tactile_bayes.report.forward_tradeoff import tradeoff_document, tradeoff_text

    if figure is not None:
        refuse_existing(figure, force=force)
    if size_calibration not in (None, "learned"):
        also_read(size_calibration_path(size_calibration))
    report = run_tradeoff(_case(scene, head), size_calibration, tolerance=tolerance_percent / 100, runs=runs)
    try:
        if figure is not None:
            from tactile_bayes.report.forward_tradeoff import draw_tradeoff

            draw_tradeoff(report, figure, force=force)
    finally:  # what was measured is not lost with the figure
        click.echo(json.dumps(tradeoff_document(report), indent=2) if as_json else tradeoff_text(report))
    if as_json:
        return
    if figure is not None:
        click.echo(f"the figure is in {figure}")
    click.echo(RESEARCH_USE)


def _case(path: Path | None, head: str | None) -> LumpCase:
    from tactile_bayes.errors import BadDataError
    from tactile_bayes.files.scene_toml import read_scene
    from tactile_bayes.forward.scene import Scene
    from tactile_bayes.forward.tissue import SceneBody, SolidLump
    from tactile_bayes.studies.tradeoffs import case_of

    if path is None:
        return case_of(Scene(body=SceneBody(), solid_lumps=(SolidLump(seat=0.0),)), head=head)
    try:
        return case_of(read_scene(path), head=head)
    except BadDataError as error:
        raise error.at(path) from None


def run_tradeoff(case: LumpCase, calibration: str | None, *, tolerance: float, runs: int) -> TradeoffReport:
    """Learn Eq 6 or read the calibrations, then measure all settings."""
    import time

    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.study import fit_line
    from tactile_bayes.report.forward_tradeoff import TradeoffReport
    from tactile_bayes.studies.paper_solid import fit_raster
    from tactile_bayes.studies.tradeoffs import PLANE, SOLID
    from tactile_bayes.studies.tradeoffs import forward_settings as settings_of
    from tactile_bayes.studies.tradeoffs import measure_forward as measure

    # a raster's frames are divided by their means
    own = {PLANE: "plane-strain", SOLID: "solid-mean"}
    rules = {model: _rule(case, model, calibration or own[model]) for model in (PLANE, SOLID)}
    found: list[Measured] = []
    settings = settings_of(case)
    measure(case, settings[0], fit=fit_line, raster_fit=fit_raster, clock=time.process_time)  # imports cost nothing
    measure(case, settings[-1], fit=fit_line, raster_fit=fit_raster, clock=time.process_time)
    with progress_bar("settings") as progress:
        for number, setting in enumerate(settings, start=1):
            clock: Callable[[], float] = time.process_time
            found.append(measure(case, setting, fit=fit_line, raster_fit=fit_raster, clock=clock, runs=runs))
            progress(number, len(settings))
    return TradeoffReport(case, tuple(found), rules, tolerance)


def _rule(case: LumpCase, model: str, name: str) -> SizeRule:
    """Rule from a model's widths to sizes: a calibration by name or path, or one learned here."""
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.commands.study import fit_line
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.files.size_json import read_size_calibration
    from tactile_bayes.studies.paper_solid import fit_raster
    from tactile_bayes.studies.tradeoffs import calibrated_rule, learned_rule, teach

    if name == LEARNED:
        with progress_bar(f"lumps for Eq 6, {model}") as progress:
            return learned_rule(teach(case, model, fit=fit_line, raster_fit=fit_raster, progress=progress))
    path = size_calibration_path(name)
    if path is None:
        raise UsageError(f"--size-calibration {name} gives no sizes; name a calibration, or say {LEARNED}")
    return calibrated_rule(read_size_calibration(path), name=path.name)
