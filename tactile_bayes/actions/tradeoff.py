"""Trade-offs measured, printed and drawn."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import click

from tactile_bayes.api.estimating import estimate_file, estimate_inputs
from tactile_bayes.api.pooled import pool_estimates
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.commands.options import also_read, settings_of
from tactile_bayes.declarations import replace, to_plain
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, UsageError, in_file
from tactile_bayes.files.atomic import given_twice
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.laboratory import TradeoffReport, draw_tradeoff, tradeoff_document, tradeoff_text
from tactile_bayes.report.tradeoff import DIGITS, draw_ladder, ladder_file, ladder_text
from tactile_bayes.shell import progress_bar
from tactile_bayes.size.pooling import PooledEstimate
from tactile_bayes.studies import tradeoffs
from tactile_bayes.studies.estimate_tradeoff import SIZE, Clock, Ladder, PooledRow, SizeAnswer, Work, measure


def pooled_rows(paths: Sequence[Path], settings: Settings, *, clock: Clock) -> tuple[PooledRow, ...]:
    """The size by the first map of one mass, by the first two, and so on."""
    rows, found, spent = [], list[SizeEstimate](), 0.0
    for number, path in enumerate(paths, start=1):
        begun = clock()
        found.append(estimate_file(path, settings))
        assert found[-1].answer.report is not None  # made here: its time is the estimate's, not the pooling's
        spent += clock() - begun
        begun = clock()
        together = pool_estimates(found, settings, names=[one.stem for one in paths[:number]])
        found = list(together.maps)
        pooling = clock() - begun
        rows.append(PooledRow(number, spent + pooling, *_pooled_answer(together.pooled, settings)))
    return tuple(rows)


def _pooled_answer(pooled: PooledEstimate, settings: Settings) -> tuple[SizeAnswer, float]:
    """The size of this exam, and half the width of the interval of another one."""
    if pooled.size is None:
        return SizeAnswer(pooled.reason), float("nan")
    found = {SIZE: pooled.size.summarise(SIZE, probability=settings.interval)}
    answer = SizeAnswer("", None, found, settings.method, pooled.size.variance_share)
    if pooled.size.another_exam is None:
        return answer, float("nan")
    another = pooled.size.another_exam.summarise(SIZE, probability=settings.interval)
    return answer, 0.5 * (another.high - another.low)


TIMES = 2


def fresh_cpu_s(words: Sequence[str]) -> float | None:
    """Least CPU seconds of a command in a fresh process, as its user waits for it; None where nobody tells them."""
    spent = []
    for _ in range(TIMES):
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "tactile_bayes", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        after = os.times()
        spent.append(after.children_user - before.children_user + after.children_system - before.children_system)
    least = min(spent)
    return least if least > 0 else None


def forecast(seconds: float) -> None:
    """Say on stderr how long it will take."""
    click.echo(f"about {max(round(seconds), 1)} s of CPU to go", err=True)


def show(
    ladder: Ladder,
    *,
    varied: Literal["estimate", "map"],
    title: str,
    figure: Path | None,
    as_json: bool,
    force: bool,
    provenance: Mapping[str, Any],
) -> int:
    """Draw and print; the exit code."""
    try:
        if figure is not None:
            draw_ladder(ladder, figure, title=title, force=force)
    finally:  # what was measured is not lost with the figure
        if as_json:
            found = ladder_file(ladder, varied=varied, provenance=provenance)
            click.echo(dump_json(to_plain(found, digits=DIGITS)), nl=False)
        else:
            click.echo(ladder_text(ladder))
    return EXIT_NO_ESTIMATE if ladder.reference.answer is None else EXIT_DONE


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
) -> None:
    """Measure error in amplitude, width and size against CPU time, for the lump of a scene."""
    if size_calibration not in (None, "learned"):
        also_read(size_calibration_path(size_calibration))
    with in_file(scene or ""):
        drawn = Scene(body=SceneBody(), solid_lumps=(SolidLump(seat=0.0),)) if scene is None else read_scene(scene)
        case = tradeoffs.case_of(drawn, head=head)
    report = run_tradeoff(case, size_calibration, tolerance=tolerance_percent / 100, runs=runs)
    try:
        if figure is not None:
            draw_tradeoff(report, figure, force=force)
    finally:  # what was measured is not lost with the figure
        click.echo(json.dumps(tradeoff_document(report), indent=2) if as_json else tradeoff_text(report))
    if as_json:
        return
    if figure is not None:
        click.echo(f"the figure is in {figure}")
    click.echo(RESEARCH_USE)


def run_tradeoff(case: tradeoffs.LumpCase, calibration: str | None, *, tolerance: float, runs: int) -> TradeoffReport:
    """Learn Eq 6 or read the calibrations, then measure all settings."""
    # a raster's frames are divided by their means
    own = {tradeoffs.PLANE: "plane-strain", tradeoffs.SOLID: "solid-mean"}
    rules = {model: _rule(case, model, calibration or own[model]) for model in (tradeoffs.PLANE, tradeoffs.SOLID)}
    found: list[tradeoffs.Measured] = []
    settings = tradeoffs.forward_settings(case)
    measure = partial(tradeoffs.measure_forward, case, clock=time.process_time)
    measure(settings[0])  # imports cost nothing afterwards
    measure(settings[-1])
    with progress_bar("settings") as progress:
        for number, setting in enumerate(settings, start=1):
            found.append(measure(setting, runs=runs))
            progress(number, len(settings))
    return TradeoffReport(case, tuple(found), rules, tolerance)


def _rule(case: tradeoffs.LumpCase, model: str, name: str) -> tradeoffs.SizeRule:
    """Rule from a model's widths to sizes: a calibration by name or path, or one learned here."""
    if name == LEARNED:
        with progress_bar(f"lumps for Eq 6, {model}") as progress:
            return tradeoffs.learned_rule(tradeoffs.teach(case, model, progress=progress))
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
    if twice := given_twice(maps):
        raise UsageError(f"{twice} is given twice; give each map once")
    settings = settings_of(
        settings_file=settings_file, size_calibration=size_calibration, centre_mm=centre_mm, seed=seed
    )
    if len(maps) > 1 and centre_mm is not None:
        raise UsageError("--centre-mm is a place on one map; give one map")
    if settings.checkpoint is not None:
        raise UsageError("a checkpoint is of one estimate, and this command makes many; leave checkpoint out")
    with progress_bar("settings") as progress:
        work = Work(time.process_time, tolerance_mm, runs, forecast, progress, settings.seed, settings.interval)
        tactile_map = read_map(maps[0])
        with in_file(maps[0]):
            calibration, options = estimate_inputs(settings, tactile_map)
            ladder = measure(tactile_map, calibration=calibration, options=options, work=work)
        if len(maps) > 1:
            ladder = replace(ladder, pooled=pooled_rows(maps, settings, clock=time.process_time))
    said = [] if size_calibration is None else ["--size-calibration", size_calibration]
    said += [] if centre_mm is None else ["--centre-mm", *map(repr, centre_mm)]
    said += [] if settings_file is None else ["--settings", str(settings_file)]
    cold = fresh_cpu_s(["estimate", str(maps[0]), *said])  # the same as the default row
    if cold is not None:
        shared = {"start of the program and reading the map": max(cold - ladder.default.seconds, 0.0)}
        ladder = replace(ladder, shared_cpu_s=shared)
    inputs = hash_inputs(**{f"map_{number}": path for number, path in enumerate(maps, start=1)})
    kept = {"size_calibration": size_calibration, "tolerance_mm": tolerance_mm, "runs": runs}
    provenance = Provenance("tradeoff estimate", kept, inputs, seed=seed).as_dict()
    title = f"{maps[0].stem}: what more time for `estimate` buys"
    return show(
        ladder, varied="estimate", title=title, figure=figure, as_json=as_json, force=force, provenance=provenance
    )


def tradeoff_map_action(
    scan: Path, tolerance_mm: float, runs: int, figure: Path | None, seed: int, as_json: bool, force: bool
) -> int:
    """Measure what each setting of `map` costs on a scan, and how far it moves the size interval."""
    read_scan(scan)  # imports and first calls cost nothing afterwards
    begun = time.process_time()
    loaded = read_scan(scan)
    read_s = time.process_time() - begun
    settings = Settings(seed=seed)
    with progress_bar("settings") as progress:
        work = Work(time.process_time, tolerance_mm, runs, forecast, progress, seed, settings.interval)
        ladder = tradeoffs.measure_map(loaded, inputs=partial(estimate_inputs, settings), work=work)
    ladder = replace(ladder, shared_cpu_s={"reading the scan": read_s})
    kept = {"tolerance_mm": tolerance_mm, "runs": runs}
    provenance = Provenance("tradeoff map", kept, hash_inputs(scan=scan), seed=seed).as_dict()
    title = f"{scan.stem}: what finer cells and more frames buy"
    return show(ladder, varied="map", title=title, figure=figure, as_json=as_json, force=force, provenance=provenance)
