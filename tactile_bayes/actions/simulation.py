"""Scans and populations simulated, and the posterior checked on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tactile_bayes.actions.exam import describe_scan
from tactile_bayes.batch import BatchInterrupted, Outcome, fault_lines, open_executor, run_batch
from tactile_bayes.batch_store import BatchStore, open_store
from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.declarations import as_dict, names_of
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.atomic import refuse_existing, write_text
from tactile_bayes.files.documents import dump_json, read_toml_record, with_session
from tactile_bayes.files.instrument_json import read_simulated_head
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.files.scene_toml import read_scene
from tactile_bayes.files.size_json import DEFAULT, read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import csv_text
from tactile_bayes.forward.line import outside_range
from tactile_bayes.forward.scene import Head, Lump
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import Rib, SolidLump
from tactile_bayes.options import FieldCosines, PopulationOptions, SbcOptions
from tactile_bayes.presets import DEFAULT_NORMALISE, RESEARCH_USE, Method
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.studies.population import (
    BodiesFile,
    BodyPrior,
    ExamPrior,
    MassRow,
    as_settings,
    draw_mass,
    measure_mass,
)
from tactile_bayes.studies.population import centred as on_the_boundary

if TYPE_CHECKING:
    from tactile_bayes.studies.sbc import MapRanks


# --- `simulate`: make a scan with known truth from a scene.


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


# --- `population`: simulate, map and fit exams of varied bodies: the table for a size calibration.


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
    refuse_existing(output, force=force)
    simulated = read_simulated_head(head) if head else Head()
    drawn = BodiesFile()
    if bodies_file:
        drawn = read_toml_record(bodies_file, BodiesFile, way_out="see bodies.schema.json")
    bodies, exams = drawn.bodies, drawn.exams
    asked = PopulationOptions(**options)
    ways = tuple(dict.fromkeys(asked.normalise))
    # results are kept by number: where the centred ones begin decides what a number is
    settings = {
        "scans": asked.scans,
        "seed": asked.seed,
        "first_centred": asked.masses if asked.centred else None,
        "normalise": list(ways),
        **as_settings(bodies, exams),
        "head": as_dict(simulated),
    }
    kept = output.with_name(f"{output.name}.unfinished")
    with (
        open_executor(workers=workers, cluster=scheduler) as executor,
        open_store(kept, settings=settings, encode=_encode, decode=_decode) as store,
        progress_bar("masses") as progress,
    ):
        outcomes = run_batch(
            partial(
                rows_of_mass,
                scans=asked.scans,
                seed=asked.seed,
                first_centred=asked.masses,
                normalise=ways,
                bodies=bodies,
                exams=exams,
                head=simulated,
            ),
            range(asked.masses + asked.centred),
            key=str,
            executor=executor,
            store=store,
            progress=progress,
        )
    rows = [row for outcome in outcomes for row in outcome.value or []]
    write_text(output, table_text(rows), force=force)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be simulated: mass {line}", err=True)
    if not failed:
        kept.unlink(missing_ok=True)
    found = sum(row.detected for row in rows)
    done = len(outcomes) - len(failed)
    click.echo(f"{output}: {done} masses, {len(rows)} exams, a lump found in {found}, seed {asked.seed}")
    click.echo(RESEARCH_USE)
    if failed:
        raise TactileBayesError(
            f"{len(failed)} of {len(outcomes)} masses are missing; {kept} keeps the others: run again"
        )


def rows_of_mass(
    index: int,
    *,
    scans: int,
    seed: int,
    first_centred: int,
    normalise: Sequence[str] = (DEFAULT_NORMALISE,),
    bodies: BodyPrior | None = None,
    exams: ExamPrior | None = None,
    head: Head | None = None,
) -> list[MassRow]:
    """Rows of one mass, in any process; from mass `first_centred` on the lumps are centred on the gland's surface."""
    prior = bodies or BodyPrior()
    prior = on_the_boundary(prior) if index >= first_centred else prior
    scenes = draw_mass(index, scans=scans, seed=seed, bodies=prior, exams=exams, head=head)
    return measure_mass(
        scenes,
        body=index,
        scan=lambda scene: simulate(scene, rng=np.random.default_rng(scene.seed)).scan,
        normalise=normalise,
    )


def _encode(rows: list[MassRow]) -> list[dict[str, Any]]:
    return [as_dict(row) for row in rows]


def _decode(rows: list[dict[str, Any]]) -> list[MassRow]:
    return [MassRow(**row) for row in rows]


def table_text(rows: list[MassRow]) -> str:
    """CSV of the rows, with the header of `data_schema/population.table.json`."""
    return csv_text(names_of(MassRow), (as_dict(row).values() for row in rows), digits=8)


# --- `sbc`: simulation-based calibration of a map's posterior.


def sbc_action(
    workers: int,
    scheduler: str | None,
    output: Path | None,
    figure: Path | None,
    as_json: bool,
    force: bool,
    **options: Any,
) -> None:
    """Check the posterior against itself: simulation-based calibration and coverage."""
    from tactile_bayes.report.laboratory import sbc_document, sbc_figure, sbc_text, table_text

    for path in (output, figure):
        if path is not None:
            refuse_existing(path, force=force)
    asked, begun = SbcOptions(**options), monotonic()
    how: dict[str, Any] = {"method": asked.method, "seed": asked.seed, "cosines": asked.field_cosines}

    def report(found: list[MapRanks], speed: float | None) -> None:
        document = sbc_document(found, maps_per_s=speed, **how)
        click.echo(dump_json(document) if as_json else sbc_text(document), nl=False)

    try:
        outcomes, made = _run_sbc(asked.maps, how, workers=workers, scheduler=scheduler, output=output)
    except BatchInterrupted as stop:
        if output is None:  # else the next run goes on
            report([one.value for one in stop.outcomes if one.value is not None], None)
        raise
    speed = made / (monotonic() - begun) if made else None
    found = [outcome.value for outcome in outcomes if outcome.value is not None]
    if output is not None:
        write_text(output, table_text(found), force=force)
    failed = _finish(outcomes, output)
    try:
        if figure is not None:
            sbc_figure(found, figure, force=force)
    finally:  # what was computed is not lost with the figure
        report(found, speed)
    if failed:
        raise TactileBayesError(f"{failed} of {len(outcomes)} maps are missing from this report")


def _run_sbc(
    maps: int,
    how: Mapping[str, Any],
    *,
    workers: int,
    scheduler: str | None,
    output: Path | None,
) -> tuple[list[Outcome[MapRanks]], int]:
    """Outcomes of all maps, and the number that this run made."""
    from tactile_bayes.studies.sbc import settings

    with (
        open_executor(workers=workers, cluster=scheduler) as executor,
        _open_kept(output, settings(size=DEFAULT, **how)) as store,
        progress_bar("maps") as progress,
    ):
        had = 0 if store is None else len(store.values)
        outcomes = run_batch(
            partial(ranks_of_map, **how),
            range(maps),
            key=str,
            executor=executor,
            store=store,
            progress=progress,
        )
    return outcomes, max(maps - had, 0)


def ranks_of_map(index: int, *, method: Method, seed: int, cosines: FieldCosines) -> MapRanks:
    """Ranks of one map, in any process."""
    from tactile_bayes.studies import sbc

    return sbc.ranks_of_map(index, method=method, seed=seed, calibration=_shipped(), cosines=cosines)


@cache
def _shipped() -> BodyCalibration:
    path = size_calibration_path(DEFAULT)
    calibration = None if path is None else read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    return calibration


def _kept(output: Path) -> Path:
    return output.with_name(f"{output.name}.unfinished")


@contextmanager
def _open_kept(output: Path | None, settings: dict[str, Any]) -> Iterator[BatchStore | None]:
    """Open the store of results beside the output; None without an output."""
    if output is None:
        yield None
        return
    with open_store(_kept(output), settings=settings, encode=as_dict, decode=_decode_ranks) as store:
        yield store


def _finish(outcomes: list[Outcome[MapRanks]], output: Path | None) -> int:
    """Report maps that failed; if none did, remove the stored results."""
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be estimated: map {line}", err=True)
    if output is not None and not failed:
        _kept(output).unlink(missing_ok=True)
    return len(failed)


def _decode_ranks(value: dict[str, Any]) -> MapRanks:
    from tactile_bayes.studies.sbc import MapRanks, Truth

    ranks = None if value["ranks"] is None else tuple(value["ranks"])
    return MapRanks(value["index"], Truth(**value["truth"]), ranks, value["outcome"], value["probability"])
