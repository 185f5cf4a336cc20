"""`simulate`: make a scan with known truth from a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.commands.options import FORCE, SESSION, FilePath, head_option

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from tactile_bayes.forward.scene import Lump
    from tactile_bayes.forward.tissue import Rib, SolidLump


@click.command("simulate")
@click.argument("scene", type=FilePath())
@click.option("-o", "--output", required=True, type=FilePath(writes="MCAP"), help="Scan file to write (.mcap).")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the random numbers, in place of the scene's.")
@click.option(
    "--fidelity",
    type=click.Choice(["empirical-gaussian", "empirical", "plane-strain", "solid"]),
    help="Model of the tissue. Default: the one the scene is written for.",
)
@head_option(
    "Default: as the scene's [head] gives them for solid, shoulders-inside for plane-strain and empirical. "
    "empirical-gaussian has none."
)
@SESSION
@FORCE
def command(
    *,
    scene: Path,
    output: Path,
    seed: int | None,
    fidelity: str | None,
    head: str | None,
    session_file: Path | None,
    force: bool,
) -> None:
    """Make a scan with known truth from SCENE, a TOML file.

    Lumps given as bumps (amplitude, sigma) take the empirical-gaussian model; lumps of tissue (d_mm, depth_ratio,
    stiffness_ratio, seat) and ribs in a [body] take the solid one: every frame is a contact problem in three
    dimensions. Cheaper for one lump: plane-strain solves the contact in two dimensions, empirical takes Eqs 1 to 4 of
    the paper, which hold for lumps of 10 mm and more down to h/d 1 (deeper, a warning: the map loses the lump). To
    both a lump is a cylinder along y, and a frame's profile across the head is repeated along it.

    The truth goes into the scan file beside the data; no other command reads it. On one machine and its libraries
    the same scene and seed give the same bytes.
    """
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.presets import RESEARCH_USE

    refuse_existing(output, force=force)
    for line in _run(scene, output, session_file, seed=seed, fidelity=fidelity, head=head, force=force):
        click.echo(line)
    click.echo(RESEARCH_USE)


def _run(
    scene_path: Path,
    output: Path,
    session_file: Path | None,
    *,
    seed: int | None,
    fidelity: str | None,
    head: str | None,
    force: bool,
) -> list[str]:
    import numpy as np

    from tactile_bayes.commands.import_ import describe_scan
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.files.documents import with_session
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import write_scan
    from tactile_bayes.files.scene_toml import read_scene
    from tactile_bayes.forward.line import outside_range
    from tactile_bayes.forward.simulate import simulate

    scene = read_scene(scene_path)
    for lump in scene.solid_lumps if fidelity == "empirical" else ():
        if warning := outside_range(lump.d_mm, lump.depth_ratio):
            click.echo(warning, err=True)
    used = scene.seed if seed is None else seed
    with progress_bar("frames") as progress:
        simulated = simulate(scene, rng=np.random.default_rng(used), fidelity=fidelity, head=head, progress=progress)
    files = {"scene": scene_path} | ({"session": session_file} if session_file else {})
    provenance = Provenance("simulate", {"model": simulated.truth["model"]}, inputs=hash_inputs(**files), seed=used)
    scan = with_session(simulated.scan, session_file)
    write_scan(output, scan, provenance=provenance, truth=simulated.truth, force=force)
    lumps = [*map(_bump_line, scene.lumps), *map(_tissue_line, scene.solid_lumps)]
    found = [*(lumps or ["no lump"]), *map(_rib_line, scene.ribs)]
    return [
        f"{output}: scan, seed {used}",
        *describe_scan(simulated.scan),
        f"model {_model(simulated.truth)}",
        *([f"head: {simulated.truth['head']}"] if "head" in simulated.truth else []),
        *found,
    ]


def _model(truth: Mapping[str, Any]) -> str:
    shape = truth.get("shape")
    return str(truth["model"]) + (f": {shape}" if shape else "")


def _rib_line(rib: Rib) -> str:
    where = f"{rib.depth_mm:g} mm deep, {rib.spacing_mm:g} mm apart along x"
    return f"rib at y {rib.y_mm:g} mm: {len(rib.balls())} balls of {rib.d_mm:g} mm, {where}"


def _bump_line(lump: Lump) -> str:
    declared = "" if lump.d_mm is None else f", d {lump.d_mm:g} mm"
    widths = f"sigma {lump.sigma_x_mm:g} x {lump.sigma_y_mm:g} mm"
    return f"lump at {lump.x_mm:g}, {lump.y_mm:g} mm: amplitude {lump.amplitude:g}, {widths}{declared}"


def _tissue_line(lump: SolidLump) -> str:
    size = f"d {lump.d_mm:g} mm"
    size += "" if lump.height_mm is None else f", {lump.height_mm:g} mm high"
    where = f"h/d {lump.depth_ratio:g}"
    return f"lump at {lump.x_mm:g}, {lump.y_mm:g} mm: {size}, {where}, {lump.stiffness_ratio:g} times as stiff as fat"
