"""Scans and populations simulated."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from tactile_bayes.batch import fault_lines, open_executor, open_store_beside, run_batch, store_path
from tactile_bayes.declarations import as_dict, names_of, replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import read_session, read_toml_record
from tactile_bayes.files.instrument import read_scene, read_simulated_head
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.files.tables import csv_text
from tactile_bayes.forward.plane import outside_range
from tactile_bayes.forward.scene import Head, Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.options import PopulationOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.map import describe_scan
from tactile_bayes.shell import progress_bar
from tactile_bayes.studies.population import BodiesFile, ExamRow, Population


def simulate_action(
    *,
    scene: Path,
    output: Path,
    seed: int | None,
    fidelity: str | None,
    head: str | None,
    session_file: Path | None,
    force: bool,
) -> None:
    """Make a scan with known truth from SCENE, a TOML file."""
    stated = read_scene(scene)
    session = read_session(session_file)
    inputs = hash_inputs(scene=scene, session=session_file)
    for lump in stated.solid_lumps if fidelity == "empirical" else ():
        if warning := outside_range(lump.d_mm, lump.depth_ratio):
            click.echo(warning, err=True)
    seed = stated.seed if seed is None else seed
    with progress_bar("frames") as progress:
        simulated = simulate(stated, rng=np.random.default_rng(seed), fidelity=fidelity, head=head, progress=progress)
    truth = simulated.truth
    scan = replace(simulated.scan, session={**simulated.scan.session, **session})
    provenance = Provenance("simulate", {"model": truth["model"]}, inputs, seed=seed)
    write_scan(output, scan, provenance=provenance, truth=truth, force=force)
    shape = f": {truth['shape']}" if truth.get("shape") else ""
    lines = [f"{output}: scan, seed {seed}", *describe_scan(scan), f"model {truth['model']}{shape}"]
    lines += [f"head: {truth['head']}"] if "head" in truth else []
    for line in (*lines, *_scene_lines(stated), RESEARCH_USE):
        click.echo(line)


def _scene_lines(scene: Scene) -> Iterator[str]:
    """The lumps and ribs of a scene, one a line."""
    for lump in scene.lumps:
        declared = "" if lump.d_mm is None else f", d {lump.d_mm:g} mm"
        widths = f"sigma {lump.sigma_x_mm:g} x {lump.sigma_y_mm:g} mm"
        yield f"lump at {lump.x_mm:g}, {lump.y_mm:g} mm: amplitude {lump.amplitude:g}, {widths}{declared}"
    for ball in scene.solid_lumps:
        size = f"d {ball.d_mm:g} mm" + ("" if ball.height_mm is None else f", {ball.height_mm:g} mm high")
        where = f"h/d {ball.depth_ratio:g}, {ball.stiffness_ratio:g} times as stiff as fat"
        yield f"lump at {ball.x_mm:g}, {ball.y_mm:g} mm: {size}, {where}"
    if not (scene.lumps or scene.solid_lumps):
        yield "no lump"
    for rib in scene.ribs:
        where = f"{rib.depth_mm:g} mm deep, {rib.spacing_mm:g} mm apart along x"
        yield f"rib at y {rib.y_mm:g} mm: {len(rib.balls())} balls of {rib.d_mm:g} mm, {where}"


def population_action(
    output: Path,
    head: Path | None,
    bodies_file: Path | None,
    workers: int,
    scheduler: str | None,
    force: bool,
    **options: Any,
) -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from."""
    way_out = "see bodies.schema.json"
    ranges = BodiesFile() if bodies_file is None else read_toml_record(bodies_file, BodiesFile, way_out=way_out)
    sample = PopulationOptions(**options)
    # results are stored by number, and the number of the first centred body is one of the store's settings
    population = Population(
        scans=sample.scans,
        seed=sample.seed,
        first_centred=sample.masses if sample.centred else None,
        normalise=tuple(dict.fromkeys(sample.normalise)),
        bodies=ranges.bodies,
        exams=ranges.exams,
        head=read_simulated_head(head) if head else Head(),
    )
    with (
        open_executor(workers=workers, cluster=scheduler) as executor,
        open_store_beside(output, list[ExamRow], settings=as_dict(population)) as store,
        progress_bar("masses") as progress,
    ):
        masses = range(sample.masses + sample.centred)
        outcomes = run_batch(population.rows, masses, key=str, executor=executor, store=store, progress=progress)
    rows = [row for outcome in outcomes for row in outcome.value or []]
    write_text(output, population_csv(rows), force=force)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be simulated: mass {line}", err=True)
    if not failed:
        store_path(output).unlink(missing_ok=True)
    detected = sum(row.detected for row in rows)
    done = len(outcomes) - len(failed)
    click.echo(f"{output}: {done} masses, {len(rows)} exams, a lump found in {detected}, seed {sample.seed}")
    click.echo(RESEARCH_USE)
    if failed:
        missing = f"{len(failed)} of {len(outcomes)} masses are missing"
        raise TactileBayesError(f"{missing}; {store_path(output)} keeps the others: run again")


def population_csv(rows: list[ExamRow]) -> str:
    """CSV of the rows, with the header of `data_schema/population.table.json`."""
    return csv_text(names_of(ExamRow), (as_dict(row).values() for row in rows), digits=8)
