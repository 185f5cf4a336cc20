"""Trade-offs measured, printed and drawn."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import click

from tactile_bayes.api.estimating import estimate_file, estimate_inputs
from tactile_bayes.api.pooled import pool_estimates
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.commands.options import make_settings, protect_inputs
from tactile_bayes.declarations import replace, to_plain
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, UsageError, in_file
from tactile_bayes.files.atomic import first_duplicate
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.forward.plane import outside_range
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.report.paper_head import finite
from tactile_bayes.report.tradeoff import DIGITS, Varied, draw_tradeoffs, tradeoff_file, tradeoff_text
from tactile_bayes.shell import own_process, progress_bar
from tactile_bayes.size.pooling import PooledEstimate
from tactile_bayes.studies import paper, tradeoffs
from tactile_bayes.studies.estimate_tradeoff import (
    SIZE,
    Clock,
    PooledRow,
    SizeAnswer,
    StudyRun,
    Tradeoff,
    answer_without_number,
    intervals,
    measure,
)


def pooled_rows(paths: Sequence[Path], settings: Settings, *, clock: Clock) -> tuple[PooledRow, ...]:
    """The size by the first map of one mass, by the first two, and so on."""
    rows, estimates, estimating_s = [], list[SizeEstimate](), 0.0
    for number, path in enumerate(paths, start=1):
        begun = clock()
        estimates.append(estimate_file(path, settings))
        assert estimates[-1].answer.report is not None  # made here: its time is the estimate's, not the pooling's
        estimating_s += clock() - begun
        begun = clock()
        pool = pool_estimates(estimates, settings, names=[one.stem for one in paths[:number]])
        estimates = list(pool.maps)
        pooling_s = clock() - begun
        rows.append(PooledRow(number, estimating_s + pooling_s, *_pooled_answer(pool.pooled, settings)))
    return tuple(rows)


def _pooled_answer(pooled: PooledEstimate, settings: Settings) -> tuple[SizeAnswer, float | None]:
    """The size of this exam, and half the width of the interval of another one."""
    if pooled.size is None:
        return answer_without_number(pooled.reason), None
    size = {SIZE: pooled.size.summarise(SIZE, probability=settings.interval)}
    answer = SizeAnswer("", None, settings.method, intervals(size), pooled.size.variance_share)
    if pooled.size.another_exam is None:
        return answer, None
    another = pooled.size.another_exam.summarise(SIZE, probability=settings.interval)
    return answer, 0.5 * (another.high - another.low)


TIMES = 2


def fresh_cpu_s(words: Sequence[str]) -> float:
    """Least CPU seconds of a command in a fresh process, its start included."""
    spent = []
    for _ in range(TIMES):
        before = os.times()
        subprocess.run(
            own_process("tactile_bayes", *words),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        after = os.times()
        spent.append(after.children_user - before.children_user + after.children_system - before.children_system)
    return min(spent)


def forecast(seconds: float) -> None:
    """Print on stderr the CPU seconds to go."""
    click.echo(f"about {max(round(seconds), 1)} s of CPU to go", err=True)


def _show(
    by_title: Mapping[str, Tradeoff],
    *,
    varied: Varied,
    figure: Path | None,
    as_json: bool,
    force: bool,
    provenance: Sequence[Provenance],
) -> int:
    """Draw and print trade-offs by their titles, each with its provenance; return the exit code."""
    try:
        if figure is not None:
            draw_tradeoffs(by_title, figure, force=force)
    finally:  # a figure that cannot be written loses no result
        if as_json:
            documents = [
                to_plain(tradeoff_file(tradeoff, varied=varied, provenance=record.as_dict()), digits=DIGITS)
                for tradeoff, record in zip(by_title.values(), provenance, strict=True)
            ]
            click.echo(dump_json(documents[0] if len(documents) == 1 else documents), nl=False)
        else:
            click.echo(tradeoff_text(by_title))
    return EXIT_DONE if all(one.reference.answer for one in by_title.values()) else EXIT_NO_ESTIMATE


LEARNED = "learned"


def tradeoff_forward_action(
    *,
    scene: Path | None,
    size_calibration: str | None,
    head: str | None,
    figure: Path | None,
    tolerance_percent: float,
    runs: int,
    as_json: bool,
    force: bool,
) -> int:
    """Measure error in amplitude, width and size against CPU time, for the lump of a scene."""
    if size_calibration not in (None, LEARNED):
        protect_inputs(size_calibration_path(size_calibration))
    with in_file(scene or ""):
        drawn = Scene(body=SceneBody(), solid_lumps=(SolidLump(seat=0.0),)) if scene is None else read_scene(scene)
        case = tradeoffs.lump_case(drawn, head=head)
    inputs = hash_inputs(scene=scene)
    # a raster's frames are divided by their means
    default_rules = {tradeoffs.PLANE: "plane-strain", tradeoffs.SOLID: "solid-mean"}
    rules = {model: _rule(case, model, size_calibration or name) for model, name in default_rules.items()}
    share = tolerance_percent / 100
    by_model = {}
    for model, rule in rules.items():
        with progress_bar(f"settings, {model}") as progress:
            work = StudyRun(time.process_time, share, runs, progress=progress)
            by_model[model] = tradeoffs.measure_forward(case, model, rule, share=share, work=work)
    plane = by_model[tradeoffs.PLANE]
    notes = (*plane.notes, tradeoffs.dimensions_note(case, plane, by_model[tradeoffs.SOLID], rules))
    warning = outside_range(case.d_mm, case.depth_ratio)
    by_model[tradeoffs.PLANE] = replace(plane, notes=(*notes, f"{warning}.") if warning else notes)
    lump = {name: getattr(case, name) for name in ("d_mm", "depth_ratio", "stiffness_ratio", "seat")}
    words = f"lump of {case.d_mm:g} mm, h/d {case.depth_ratio:g}, {case.stiffness_ratio:g} times as stiff as fat"
    by_title, provenance = {}, []
    for model, tradeoff in by_model.items():
        shoulders, rule = case.settings(model).head.shoulders, rules[model]
        by_title[f"{model}: {words}, {paper.seat_name(case.seat)}; head: {shoulders}"] = tradeoff
        settings = {"model": model, **lump, "head": shoulders, "size_calibration": size_calibration}
        settings |= {"sizes_by": rule.source, "sd_ln_d": finite(rule.scatter)}
        settings |= {"tolerance_percent": tolerance_percent, "runs": runs}
        provenance.append(Provenance("tradeoff forward", settings, inputs))
    return _show(by_title, varied="forward", figure=figure, as_json=as_json, force=force, provenance=provenance)


def _rule(case: tradeoffs.LumpCase, model: str, name: str) -> tradeoffs.SizeRule:
    """Rule from a model's widths to sizes: a calibration by name or path, or one learned here."""
    if name == LEARNED:
        with progress_bar(f"lumps for Eq 6, {model}") as progress:
            return tradeoffs.learned_rule(tradeoffs.training_rows(case, model, progress=progress))
    path = size_calibration_path(name)
    if path is None:
        raise UsageError(f"--size-calibration {name} gives no sizes; name a calibration, or say {LEARNED}")
    return tradeoffs.calibrated_rule(read_size_calibration(path), name=path.name)


def tradeoff_estimate_action(
    maps: tuple[Path, ...],
    size_calibration: str | None,
    centre_mm: tuple[float, float] | None,
    settings_file: Path | None,
    tolerance_mm: float,
    runs: int,
    figure: Path | None,
    seed: int,
    as_json: bool,
    force: bool,
) -> int:
    """Measure what each setting of `estimate` costs on a map, and how far its size interval is off."""
    if twice := first_duplicate(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    settings = make_settings(
        settings_file=settings_file, size_calibration=size_calibration, centre_mm=centre_mm, seed=seed
    )
    if len(maps) > 1 and centre_mm is not None:
        raise UsageError("--centre-mm is a place on one map; give one map")
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one estimate, and this command makes many; leave checkpoint out")
    with progress_bar("settings") as progress:
        work = StudyRun(time.process_time, tolerance_mm, runs, forecast, progress, settings.seed, settings.interval)
        tactile_map = read_map(maps[0])
        inputs = hash_inputs(**{f"map_{number}": path for number, path in enumerate(maps, start=1)})
        with in_file(maps[0]):
            calibration, sampler = estimate_inputs(settings, tactile_map)
            tradeoff = measure(tactile_map, calibration=calibration, options=sampler, work=work)
        if len(maps) > 1:
            tradeoff = replace(tradeoff, pooled=pooled_rows(maps, settings, clock=time.process_time))
    words = ["estimate", str(maps[0])]  # the command of the default row
    words += [] if size_calibration is None else ["--size-calibration", size_calibration]
    words += [] if centre_mm is None else ["--centre-mm", *map(repr, centre_mm)]
    words += [] if settings_file is None else ["--settings", str(settings_file)]
    shared = {"start of the program and reading the map": max(fresh_cpu_s(words) - tradeoff.default.seconds, 0.0)}
    tradeoff = replace(tradeoff, shared_cpu_s=shared)
    options = {"size_calibration": size_calibration, "tolerance_mm": tolerance_mm, "runs": runs}
    provenance = [Provenance("tradeoff estimate", options, inputs, seed=seed)]
    by_title = {f"{maps[0].stem}: what more time for `estimate` buys": tradeoff}
    return _show(by_title, varied="estimate", figure=figure, as_json=as_json, force=force, provenance=provenance)


def tradeoff_map_action(
    scan: Path, tolerance_mm: float, runs: int, figure: Path | None, seed: int, as_json: bool, force: bool
) -> int:
    """Measure what each setting of `map` costs on a scan, and how far it moves the size interval."""
    read_scan(scan)  # the second call is timed: the first one imports
    begun = time.process_time()
    loaded = read_scan(scan)
    read_s = time.process_time() - begun
    inputs = hash_inputs(scan=scan)
    settings = Settings(seed=seed)
    with progress_bar("settings") as progress:
        work = StudyRun(time.process_time, tolerance_mm, runs, forecast, progress, seed, settings.interval)
        tradeoff = tradeoffs.measure_map(loaded, inputs=partial(estimate_inputs, settings), work=work)
    tradeoff = replace(tradeoff, shared_cpu_s={"reading the scan": read_s})
    options = {"tolerance_mm": tolerance_mm, "runs": runs}
    provenance = [Provenance("tradeoff map", options, inputs, seed=seed)]
    by_title = {f"{scan.stem}: what finer cells and more frames buy": tradeoff}
    return _show(by_title, varied="map", figure=figure, as_json=as_json, force=force, provenance=provenance)
