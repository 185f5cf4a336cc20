"""The paper's study and tables, a head's pressure, a scan beside its model, the posterior checked: run and printed."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from functools import partial
from operator import attrgetter
from pathlib import Path
from time import monotonic
from typing import Any

import click
import numpy as np

from tactile_bayes.batch import (
    BatchInterrupted,
    Outcome,
    fault_lines,
    open_executor,
    open_store_beside,
    run_batch,
    store_path,
)
from tactile_bayes.declarations import names_of
from tactile_bayes.errors import TactileBayesError, UsageError, in_file
from tactile_bayes.files.atomic import refuse_existing, write_text
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.files.provenance import hash_inputs
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.size_json import DEFAULT, read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import csv_text, read_table
from tactile_bayes.findings import finding_lines
from tactile_bayes.forward.plane import outside_range
from tactile_bayes.forward.scene import Head, HeadSection
from tactile_bayes.forward.tissue import parse_seat
from tactile_bayes.mapping.select import scan_findings
from tactile_bayes.options import CaseOptions, FieldCosines, SbcOptions, SectionOptions, StudyOptions
from tactile_bayes.presets import HEADS, RESEARCH_USE, SHOULDERS_INSIDE, SHOULDERS_OUTSIDE, Method
from tactile_bayes.report import laboratory, paper_head
from tactile_bayes.report.study import frames_text, lookalikes_text, study_figures, study_table, study_text
from tactile_bayes.shell import progress_bar
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.studies import paper, sbc
from tactile_bayes.studies.model_comparison import (
    NEAREST_HEADS,
    PHANTOMS,
    TRIED_HEADS,
    MeasuredFrame,
    compare_frames,
    compare_heads,
    compare_model,
    measured_frames,
    phantom_scenes,
    table_scenes,
)
from tactile_bayes.studies.paper_solid import SolidSettings


def read_measured_frames(path: Path) -> list[MeasuredFrame]:
    """Frames of a table, one for each position of the head, in the order in which they first appear."""
    columns = read_table(path, "measured_frames.table.json").columns
    x_c = np.array([0.0 if x is None else x for x in columns["x_c_mm"]])
    s, pressure = np.array(columns["s_mm"]), np.array(columns["pressure_kpa"])
    with in_file(path):
        return [MeasuredFrame(x, s[x_c == x], pressure[x_c == x]) for x in dict.fromkeys(x_c.tolist())]


def prepare_figures(folder: Path, *, model: str, force: bool) -> list[Path]:
    """Paths of figures 5 to 8, in two dimensions of the frames of four lumps too; an error if one exists."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be made a directory ({error.strerror}); choose another name") from None
    names = [f"figure_{number}" for number in (5, 6, 7, 8)] + ["four_lumps"] * (model == "plane-strain")
    paths = [folder / f"{name}.png" for name in names]
    refuse_existing(*paths, force=force)
    return paths


RECIPE = ("normalise", "background", "fit_radius_mm", "noise", "flat_field")
"""Columns on how a table's maps were made and fitted; `calibrate size` refuses options that contradict them."""


def study_action(
    *,
    output: Path | None,
    figures: Path | None,
    measured_frames: Path | None,
    phantom: tuple[float, float] | None,
    workers: int,
    scheduler: str | None,
    force: bool,
    **options: Any,
) -> None:
    """Run the forward study of section 2.4: amplitude and width of the map over sizes, depths and stiffnesses."""
    section = {name: options.pop(name) for name in names_of(SectionOptions)}
    study = StudyOptions(**options)
    seat, model = parse_seat(study.seat), study.model
    settings = study_settings(study, SectionOptions(**section))
    if (measured_frames or phantom) and (figures is None or model != "plane-strain"):
        option = "--measured-frames" if measured_frames else "--phantom"
        raise UsageError(f"{option} is for --figures of the plane-strain model; give --figures DIR")
    frames = [] if measured_frames is None else read_measured_frames(measured_frames)
    geometries = paper.paper_grid(seat) if study.grid == "paper" else read_grid(Path(study.grid), seat=seat)
    paths = [] if figures is None else prepare_figures(figures, model=model, force=force)
    with open_executor(workers=workers, cluster=scheduler) as executor:
        rows = run_study(geometries, settings=settings, executor=executor, output=output)
    if output is None:
        click.echo(study_table(rows) if sys.stdout.isatty() else study_csv(rows), nl=False)
    else:
        write_text(output, study_csv(rows), force=force)
        store_path(output).unlink(missing_ok=True)
    click.echo(study_text(rows), err=output is None)
    lines = [RESEARCH_USE]
    if paths:
        lump = phantom or PHANTOMS["phantom 12.5 mm"]  # without a phantom and its frames figure 6 shows the paper's
        flat = settings if isinstance(settings, paper.StudySettings) else None
        compared = compare_frames(frames, *lump, seat=seat, settings=flat) if frames and flat else []
        lookalikes = study_figures(rows, settings, paths, seat=seat, phantom=lump, measured=compared, force=force)
        four = " and the frames of four lumps" if flat else ""
        lines = [f"figures 5 to 8{four} are in {figures}", RESEARCH_USE]
        lines = [lookalikes_text(lookalikes), *frames_text(compared), *lines] if flat else lines
    for line in lines:
        click.echo(line, err=output is None)


def study_settings(study: StudyOptions, section: SectionOptions) -> paper.StudySettings | SolidSettings:
    """Make the settings of the study of a model."""
    default = SHOULDERS_INSIDE if study.model == "plane-strain" else SHOULDERS_OUTSIDE
    head = _section_head(section, study.head or default)
    case = {name: getattr(study, name) for name in names_of(CaseOptions)}
    if study.model == "plane-strain":
        if study.background == "free" or study.flat_field:
            option = "--background free" if study.background == "free" else "--flat-field"
            raise UsageError(f"{option} is for --model solid: in two dimensions Eq 5 is fitted with a background of 1")
        return paper.StudySettings(head=head, **case)
    array = Head(radius_mm=section.head_radius_mm, rim_mm=section.shoulder_mm).with_shoulders(head.shoulders)
    solid: dict[str, Any] = {"background": study.background or "free", "flat_field": study.flat_field is not False}
    return SolidSettings(head=array, **case, **solid)


def _section_head(section: SectionOptions, shoulders: str | None) -> HeadSection:
    """The head of a cross-section; its shoulders lie inside the sensing width by default."""
    shoulders = shoulders or SHOULDERS_INSIDE
    return HeadSection(radius_mm=section.head_radius_mm, shoulder_mm=section.shoulder_mm, shoulders=shoulders)


def read_grid(path: Path, *, seat: float) -> list[paper.Geometry]:
    """Read the cases of a table; `seat` is the default of rows without one."""
    table = read_table(path, "study_grid.table.json")
    seats = [seat if text is None else parse_seat(text) for text in table.columns["seat"]]
    names = ("d_mm", "depth_ratio", "stiffness_ratio")
    with in_file(path):
        return paper.group_cases(zip(seats, *(table.columns[name] for name in names), strict=True))


def run_study(
    geometries: list[paper.Geometry],
    *,
    settings: paper.StudySettings | SolidSettings,
    executor: Executor,
    output: Path | None = None,
) -> list[paper.StudyRow]:
    """Compute all rows, in order of the geometries; finished ones are stored beside `output`."""
    for geometry in geometries:
        settings.body(geometry.d_mm, geometry.depth_ratio, seat=geometry.seat)
    with (
        open_store_beside(output, list[paper.StudyRow], settings=settings.as_dict()) as store,
        progress_bar("geometries") as progress,
    ):
        try:
            outcomes = run_batch(
                settings.rows, geometries, key=attrgetter("key"), executor=executor, store=store, progress=progress
            )
        except BatchInterrupted as interrupt:
            if output is None:  # no later run can resume
                click.echo(study_csv(_rows(interrupt.outcomes)), nl=False)
            raise
    failed = [outcome for outcome in outcomes if not outcome.ok]
    if failed:
        if output is None:
            click.echo(study_csv(_rows(outcomes)), nl=False)
        fault = f"{len(failed)} of {len(outcomes)} geometries failed, the first ({failed[0].key}): {failed[0].error}"
        raise TactileBayesError(fault)
    return _rows(outcomes)


def _rows(outcomes: Iterable[Outcome[list[paper.StudyRow]]]) -> list[paper.StudyRow]:
    return [row for outcome in outcomes for row in outcome.value or []]


def study_csv(rows: list[paper.StudyRow]) -> str:
    """CSV of the study for `calibrate size`; columns of the solid model only where a row has them."""
    names = ["seat", "d_mm", "depth_ratio", "stiffness_ratio", "amplitude", "sigma_x_mm"]
    if any(row.sigma_y_mm is not None for row in rows):
        names.append("sigma_y_mm")
    names += ["fit_rms", "detectable", "thickness_mm", "head_radius_mm"]
    names += [name for name in ("head", *RECIPE) if any(getattr(row, name) is not None for row in rows)]
    return csv_text(names, ([getattr(row, name) for name in names] for row in rows), digits=6)


def tables_action(*, seat: str, head: str | None, search: bool, workers: int, as_json: bool, **section: float) -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures."""
    seat_value = parse_seat(seat)
    stated = _section_head(SectionOptions(**section), head)
    nearest = NEAREST_HEADS.get(seat_value)
    heads = list(dict.fromkeys([stated, *([nearest] if nearest else []), *(TRIED_HEADS if search else ())]))
    lumps, phantoms = run_tables(seat_value, heads=heads, workers=workers)
    if as_json:
        click.echo(json.dumps(laboratory.tables_document(lumps, phantoms, seat=seat_value), indent=2))
        return
    beside = lumps[nearest] if nearest and nearest != stated else None
    click.echo(laboratory.tables_text(lumps[stated], phantoms[stated], head=stated, nearest=nearest, beside=beside))
    if search:
        click.echo(laboratory.heads_text(lumps))
    click.echo(RESEARCH_USE)


def run_tables(
    seat: float, *, heads: Sequence[HeadSection], workers: int
) -> tuple[laboratory.ByHead, laboratory.ByHead]:
    """Agreement of both models over the cases of the tables, and over the phantoms, under each head."""
    lumps, phantoms = table_scenes(seat), phantom_scenes(seat)
    work = partial(compare_heads, settings=paper.StudySettings(), heads=heads)
    with open_executor(workers=workers) as executor, progress_bar("lumps") as progress:
        outcomes = run_batch(work, lumps + phantoms, key=lambda scene: scene.name, executor=executor, progress=progress)
    for outcome in outcomes:
        if outcome.value is None:
            raise TactileBayesError(f"{outcome.key}: {outcome.error}")
    by_head = dict(zip(heads, zip(*(outcome.value or [] for outcome in outcomes), strict=True), strict=True))
    count = len(lumps)
    return {head: r[:count] for head, r in by_head.items()}, {head: r[count:] for head, r in by_head.items()}


def head_uniformity_action(
    *, head_radius_mm: float, shoulder_mm: float, head: str | None, as_json: bool, **tissue: Any
) -> None:
    """Compute how evenly one head presses on homogeneous tissue."""
    body = paper.HomogeneousTissue(**tissue)
    section = SectionOptions(head_radius_mm=head_radius_mm, shoulder_mm=shoulder_mm)
    uniformity, limit = paper.uniformity(_section_head(section, head), body), body.limit_percent / 100
    if as_json:
        click.echo(json.dumps(paper_head.uniformity_document(uniformity, body, limit=limit), indent=2))
    else:
        click.echo(f"{paper_head.uniformity_text(uniformity, body, limit=limit)}\n{RESEARCH_USE}")


def head_design_action(*, head: str | None, figure: Path | None, as_json: bool, force: bool, **tissue: Any) -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper)."""
    body = paper.HomogeneousTissue(**tissue)
    limit = body.limit_percent / 100
    candidates = paper.search_heads(body, kinds=HEADS if head is None else (head,))
    if as_json:
        click.echo(json.dumps(paper_head.design_document(candidates, body, limit=limit), indent=2))
    else:
        click.echo(f"{paper_head.design_text(candidates, body, limit=limit)}\n{RESEARCH_USE}")
    if figure is not None:
        paper_head.design_figure(candidates, body, limit=limit, path=figure, force=force)
    if paper.narrowest(candidates, limit=limit) is None:
        best = paper.most_even(candidates)
        raise UsageError(
            f"no head keeps the pressure within {body.limit_percent:g} % of its mean: the most even one, "
            f"{paper_head.head_words(best.head)}, reaches {100 * best.worst:.1f} %; give a larger --limit-percent, "
            "narrower ranges or another --thickness-mm"
        )


def compare_model_action(
    *,
    scan: Path,
    scene: Path,
    fidelities: tuple[str, ...],
    head: str | None,
    at: tuple[float, float] | None,
    figure: Path | None,
    as_json: bool,
    force: bool,
    **options: Any,
) -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper)."""
    body = read_scene(scene)
    loaded = read_scan(scan)
    inputs = hash_inputs(scan=scan, scene=scene)
    if at is None and not (body.solid_lumps or body.lumps):
        at = (0.0, 0.0)  # no lump to look for: the middle of the strokes
    measured = measured_frames(loaded, place_mm=at, **options)
    comparisons = []
    for fidelity in dict.fromkeys(fidelities or (body.fidelity,)):
        warnings = [outside_range(lump.d_mm, lump.depth_ratio) for lump in body.solid_lumps if fidelity == "empirical"]
        for warning in filter(None, warnings):
            click.echo(warning, err=True)
        with progress_bar(f"frames, {fidelity}") as progress:
            comparisons.append(compare_model(measured, body, fidelity=fidelity, head=head, progress=progress))
    if as_json:
        click.echo(dump_json(paper_head.comparison_document(measured, comparisons, inputs=inputs)), nl=False)
    else:
        for line in finding_lines(scan_findings(loaded)):
            click.echo(line, err=True)
        click.echo(f"{paper_head.comparison_text(measured, comparisons)}\n{RESEARCH_USE}")
    if figure is not None:
        title = f"{scan.stem} against {scene.stem}"
        paper_head.comparison_figure(measured, comparisons, figure, title=title, force=force)


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
    run, begun = SbcOptions(**options), monotonic()
    settings: dict[str, Any] = {"method": run.method, "seed": run.seed, "cosines": run.field_cosines}

    def report(ranks: list[sbc.MapRanks], speed: float | None) -> None:
        document = laboratory.sbc_document(ranks, maps_per_s=speed, **settings)
        click.echo(dump_json(document) if as_json else laboratory.sbc_text(document), nl=False)

    try:
        with (
            open_executor(workers=workers, cluster=scheduler) as executor,
            open_store_beside(output, sbc.MapRanks, settings=sbc.settings(size=DEFAULT, **settings)) as store,
            progress_bar("maps") as progress,
        ):
            made = max(run.maps - (0 if store is None else len(store)), 0)  # by this run
            work = partial(shipped_ranks, **settings)
            outcomes = run_batch(work, range(run.maps), key=str, executor=executor, store=store, progress=progress)
    except BatchInterrupted as interrupt:
        if output is None:  # no later run can resume
            report([one.value for one in interrupt.outcomes if one.value is not None], None)
        raise
    speed = made / (monotonic() - begun) if made else None
    ranks = [outcome.value for outcome in outcomes if outcome.value is not None]
    if output is not None:
        write_text(output, laboratory.table_text(ranks), force=force)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    for line in fault_lines(failed):
        click.echo(f"could not be estimated: map {line}", err=True)
    if output is not None and not failed:
        store_path(output).unlink(missing_ok=True)
    try:
        if figure is not None:
            laboratory.sbc_figure(ranks, figure, force=force)
    finally:  # a figure that cannot be written loses no result
        report(ranks, speed)
    if failed:
        raise TactileBayesError(f"{len(failed)} of {len(outcomes)} maps are missing from this report")


def shipped_ranks(index: int, *, method: Method, seed: int, cosines: FieldCosines) -> sbc.MapRanks:
    """Ranks of one map by the shipped calibration, which each process reads once."""
    path = size_calibration_path(DEFAULT)
    calibration = None if path is None else read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    return sbc.ranks_of_map(index, method=method, seed=seed, calibration=calibration, cosines=cosines)
