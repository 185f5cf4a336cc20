"""`simulate`: a scan with known truth from a scene."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("simulate")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="Scan file to write (.mcap).")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the random numbers, in place of the scene's.")
@click.option("--force", is_flag=True, help="Overwrite the output.")
def command(*, scene: Path, output: Path, seed: int | None, force: bool) -> None:
    """Make a scan with known truth from SCENE, a TOML file.

    The truth goes into the scan file beside the data; no other command reads it. The same scene and seed give the
    same bytes.
    """
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.presets import RESEARCH_USE

    refuse_existing(output, force=force)
    for line in _run(scene, output, seed=seed, force=force):
        click.echo(line)
    click.echo(RESEARCH_USE)


def _run(scene_path: Path, output: Path, *, seed: int | None, force: bool) -> list[str]:
    import numpy as np

    from tactile_bayes.commands.import_ import describe_scan
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import write_scan
    from tactile_bayes.files.scene_toml import read_scene
    from tactile_bayes.forward.simulate import simulate

    scene = read_scene(scene_path)
    used = scene.seed if seed is None else seed
    simulated = simulate(scene, rng=np.random.default_rng(used))
    provenance = Provenance("simulate", {"model": "gaussian"}, inputs=hash_inputs(scene=scene_path), seed=used)
    write_scan(output, simulated.scan, provenance=provenance, truth=simulated.truth, force=force)
    lumps = [
        f"lump at {lump.x_mm:g}, {lump.y_mm:g} mm: amplitude {lump.amplitude:g}, "
        f"sigma {lump.sigma_x_mm:g} x {lump.sigma_y_mm:g} mm" + ("" if lump.d_mm is None else f", d {lump.d_mm:g} mm")
        for lump in scene.lumps
    ]
    return [f"{output}: scan, seed {used}", *describe_scan(simulated.scan), *(lumps or ["no lump"])]
