"""`tradeoff estimate`: its reference, what it finds wrong, and what it says of maps at the extremes."""

from __future__ import annotations

import itertools
import json
import math
import re
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from posterior_maps import bump_values, correlated_field, grid_map
from published_schemas import check_document

from tactile_bayes.api.estimating import estimate_inputs
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace, to_plain
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.inference import importance as importance_module
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.report.tradeoff import advice, draw_tradeoffs, settings_text, tradeoff_file, tradeoff_text
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import Recipe
from tactile_bayes.studies import estimate_tradeoff as study
from tactile_bayes.studies.estimate_tradeoff import (
    SIZE,
    MapEstimator,
    MeasuredSetting,
    PooledRow,
    Setting,
    StudyRun,
    Tradeoff,
    answer_without_number,
    distances,
    make_reference,
    measure,
    measure_setting,
)

Run = Callable[..., "CompletedProcess[str]"]


def field_map(*, seed: int = 3, half_mm: float = 25.0, **bump: float) -> TactileMap:
    """A bump under errors that correlate over 4 mm, as a scan's do."""
    rng, n = np.random.default_rng(seed), 2 * round(half_mm) + 1
    errors = 0.005 * rng.standard_normal((n, n)) + 0.01 * correlated_field(rng, n, length_cells=4.0)
    return grid_map(bump_values(half_mm=half_mm, **bump) + errors, normalise="gain")


def inputs_of(tactile_map: TactileMap) -> tuple[Calibration | None, SamplerSettings]:
    calibration, options = estimate_inputs(Settings(), tactile_map)
    return calibration, options


def estimator_of(tactile_map: TactileMap, calibration: Calibration | None = None) -> MapEstimator:
    return MapEstimator(tactile_map, calibration or inputs_of(tactile_map)[0], StudyRun(time.process_time, 0.2))


def measured_on(tactile_map: TactileMap, **chosen: object) -> Tradeoff:
    """A trade-off of few settings, each run once, under a clock that ticks once a look."""
    ticks = itertools.count()
    calibration, options = inputs_of(tactile_map)
    with pytest.MonkeyPatch.context() as patch:
        few = {"FIELDS": (8, 20), "RADII_MM": (8.0,), "ACCURACIES_SD": (0.01,), "CHAIN_ACCURACIES_SD": ()} | chosen
        few |= {"LONG_RUNS": (("importance", 0.02),), "LAPLACE_DRAWS": (400,)}
        for name, value in few.items():
            patch.setattr(study, name, value)
        return measure(
            tactile_map,
            calibration=calibration,
            options=options,
            work=StudyRun(lambda: float(next(ticks)), 0.2, 1),
        )


@cache
def measured() -> Tradeoff:
    return measured_on(field_map())


def row(label: str) -> MeasuredSetting:
    (found,) = (one for one in measured().rows if one.label == label)
    return found


def exact_eq6() -> SizeCalibration:
    """Eq 6 without uncertainty: d = 2 sigma + 1 along both axes."""
    draws = np.tile([2.0, 1.0, 1.0, 0.0, 1e-9, 0.0], (16, 1))
    axis = AxisCalibration(draws, 0.3, {"amplitude": (0.01, 3.0), "sigma_mm": (1.0, 20.0), "d_mm": (1.0, 60.0)})
    return SizeCalibration(axis, axis, 0.0, Recipe("mean", "fixed", 20.0, declared=True))


@pytest.mark.long
def test_the_reference_has_the_interval_that_theory_gives(monkeypatch: pytest.MonkeyPatch):
    """Least squares of a Gaussian in white noise: SD(ln sigma) = sqrt(2/pi) s h / (a sqrt(sigma_x sigma_y)), from the
    Fisher information integrated by hand; Eq 6 without uncertainty makes a size of 2 sigma + 1 of it."""
    monkeypatch.setattr(study, "LONG_RUNS", (("importance", 0.02),))
    rng, s, a, wide, narrow = np.random.default_rng(5), 0.005, 0.3, 6.0, 3.0
    values = bump_values(amplitude=a, sigma_x=wide, sigma_y=narrow) + s * rng.standard_normal((51, 51))
    options = SamplerSettings(rotation="off")
    found = estimator_of(grid_map(values), exact_eq6()).reference(options)
    assert found.answer is not None
    size = found.answer.quantities[SIZE]
    half = 1.96 * 2 * wide * math.sqrt(2 / math.pi) * s / (a * math.sqrt(wide * narrow))
    assert found.answer.half_width_mm == pytest.approx(half, rel=0.12)
    assert size.median == pytest.approx(2 * wide + 1, abs=2 * half)
    assert found.mc_error_mm < 0.05 * half


@pytest.mark.slow
def test_the_reference_agrees_with_markov_chains():
    """Chains are another algorithm: their ends lie within their Monte-Carlo error of the reference's.

    That error is itself an estimate from few replicates, so that a fiftieth of the SD passes in any case.
    """
    found = row("--method ensemble")
    assert found.answer.method == "ensemble"
    assert measured().reference.answer.method == "importance"
    size = found.answer.quantities[SIZE]
    assert measured().reference.mc_error_mm < 0.005 * (size.high - size.low)  # what it was asked for
    assert found.ends_off_mm < max(
        4 * np.hypot(size.mc_error, measured().reference.mc_error_mm), 0.005 * (size.high - size.low)
    )


@pytest.mark.slow
def test_chains_are_the_reference_where_weights_cannot_be_trusted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(study, "LONG_RUNS", (("importance", 0.001), ("ensemble", 0.1)))
    monkeypatch.setattr(importance_module, "HEAVY_POINTS", 1)
    monkeypatch.setattr(importance_module, "TRUSTED_SHAPE", -5.0)
    given = field_map(half_mm=18.0, amplitude=0.2)
    found = estimator_of(given).reference(inputs_of(given)[1])
    assert found.words.startswith("MCMC")
    assert found.answer is not None
    assert found.answer.method == "ensemble"


@pytest.mark.long
def test_wrong_settings_come_out_as_wrong():
    """The negative control: a noise field too coarse for the errors, and a window that holds nothing but the bump."""
    right = [row(label) for label in ("--method importance", "--method laplace", "--accuracy-sd 0.01")]
    assert row("field_cosines 8").ends_off_mm > 3 * max(one.ends_off_mm for one in right)
    assert row("fit_radius_mm 8").answer.reported is None
    assert measured().cheapest_sufficient() in right
    said = " ".join(advice(measured()))
    assert re.search(rf"more than 0.2 mm: .*field_cosines 8 {row('field_cosines 8').ends_off_mm:.1f} mm\.", said)
    assert "No size by fit_radius_mm 8." in said


@pytest.mark.long
def test_an_answer_is_compared_with_one_of_its_kind_only():
    some = row("--method laplace").answer
    assert distances([some], some)[1] == 0.0
    assert distances([some], None)[1] is None
    assert distances([answer_without_number("no lump", 0.1)], some)[1] is None
    widths = replace(some, quantities={name: q for name, q in some.quantities.items() if name != SIZE})
    assert distances([widths], some)[1] is None


def made(
    label: str, seconds: float, off: float | None, *, default: bool = False, usable: bool = True
) -> MeasuredSetting:
    """A row as if it had been measured."""
    some = row("--method importance")
    return replace(some, label=label, cpu_s={"estimate": seconds}, ends_off_mm=off, default=default, usable=usable)


@pytest.mark.long
def test_the_frontier_and_what_is_enough():
    rows = (
        made("default", 1.0, 0.05, default=True),
        made("quick", 0.3, 0.15),
        made("quick and wrong", 0.1, 2.0),
        made("slow", 5.0, 0.01),
        made("slow and no better", 6.0, 0.03),
        made("another model", 0.01, 0.1, usable=False),
    )
    found = Tradeoff(rows, measured().reference, 0.2)
    assert [one.label for one in found.frontier()] == ["another model", "default", "slow"]
    assert found.cheapest_sufficient().label == "quick"
    hardly_quicker = replace(found, rows=(rows[0], made("quick", 0.9, 0.15)))
    assert hardly_quicker.cheapest_sufficient().label == "default"
    strict = replace(found, tolerance_mm=0.001)
    assert strict.cheapest_sufficient() is None
    assert "no setting has its interval ends within 0.001 mm" in advice(strict)[0]


@pytest.mark.long
def test_least_time_counts_and_a_slow_setting_is_run_twice():
    spent = iter([5.0, 4.0, 1.0])
    some = row("--method laplace").answer
    found = measure_setting(
        Setting("a", "b", None), lambda *_: ({"estimate": next(spent)}, some), make_reference("", some, 0.0), runs=3
    )
    assert (found.seconds, found.runs) == (4.0, 2)


@pytest.mark.long
def test_it_can_be_read_printed_and_drawn(tmp_path: Path):
    pooled = (
        PooledRow(1, 0.2, row("--method laplace").answer, 5.0),
        PooledRow(2, 0.4, answer_without_number("1 of 2"), None),
    )
    found = replace(measured(), pooled=pooled, shared_cpu_s={"start": 0.2})
    text = tradeoff_text({"a map": found})
    assert "* --method importance" in text
    assert "5.00 if exams differ as in the paper" in text
    assert text.splitlines()[-1] == "Research use only: not a diagnostic device."
    assert sum(line.startswith("Advice: ") for line in text.splitlines()) == 1
    document = json.loads(json.dumps(to_plain(tradeoff_file(found, varied="estimate", provenance={}))))
    check_document(document, "tradeoff.schema.json")
    assert [one["default"] for one in document["settings"]].count(True) == 1
    for name in ("a.png", "b.png"):
        draw_tradeoffs({"a map": found}, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def flat(rows: int, columns: int) -> TactileMap:
    """A map on which nothing rises; one of a single value would be no map of a breast."""
    return grid_map(np.where(np.arange(columns) < columns // 2, 0.999, 1.0) * np.ones((rows, 1)), normalise="gain")


NO_SIZE = {
    "empty": (lambda: flat(31, 31), "nothing rises above the background"),
    "faint": (lambda: field_map(half_mm=13.0, amplitude=0.01), "no lump found|probability"),
    "one cell wide": (lambda: field_map(half_mm=10.0, amplitude=0.5, sigma_x=0.4, sigma_y=0.4), "cell|no lump found"),
    "no cell": (lambda: grid_map(np.full((9, 9), np.nan), normalise="gain"), "no covered cell"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", NO_SIZE)
def test_without_a_size_it_says_what_each_setting_answers(case: str, tmp_path: Path):
    make, why = NO_SIZE[case]
    found = measured_on(make(), FIELDS=(), RADII_MM=(10.0,))
    assert found.reference.answer is None
    text = settings_text(found)
    assert "Advice: " in text
    default = next(line for line in text.splitlines() if line.startswith("* --method importance"))
    assert re.search(why, default), default
    check_document(to_plain(tradeoff_file(found, varied="estimate", provenance={})), "tradeoff.schema.json")
    draw_tradeoffs({case: found}, tmp_path / "f.png")


@pytest.mark.long
def test_a_row_says_that_chains_took_over():
    taken_over = replace(row("--method importance"), answer=row("--method ensemble").answer)
    said = settings_text(replace(measured(), rows=(taken_over, row("--method ensemble"))))
    assert said.count("(by MCMC: importance sampling failed)") == 1


@pytest.mark.long
def test_beside_chains_other_models_are_tried_by_laplace():
    settings = study.settings_of(SamplerSettings(background="free", noise="field"), level_known=True)
    chains, weights = row("--method ensemble").answer, row("--method importance").answer
    assert study.relevant_settings(settings, weights) == settings
    tried = study.relevant_settings(settings, chains)
    assert [one.axis for one in tried] == [one.axis for one in settings]
    others = [one for one in tried if one.axis in (study.FIELD, study.WINDOW)]
    assert {one.options.method for one in others} == {"laplace"}
    assert all(one.label.endswith(", laplace") and not one.options.step_up for one in others)
    assert sum(one.weight for one in tried) < 0.2 * sum(one.weight for one in settings)
    silent = study.relevant_settings(settings, answer_without_number("no lump", 0.1))
    assert {one.axis for one in silent} == {study.METHOD, study.FIELD, study.WINDOW}


@pytest.mark.long
def test_settings_that_disagree_are_not_believed():
    none = replace(made("none", 1.0, None, default=True), answer=answer_without_number("no lump", 0.9))
    some = replace(made("some", 1.0, None), answer=replace(row("--method laplace").answer, detected_probability=0.96))
    said = advice(Tradeoff((none, some), make_reference("none: no lump", None, 1.0), 0.2))
    assert said == [
        "Advice: the default gives no size, 1 of 2 settings do (some) (probability of one 0.900 to 0.960): the map is "
        "at the limit of what can be sized. Believe none of them; scan the place again."
    ]


def test_a_large_map_costs_what_its_window_costs():
    """200 x 200 cells: the fit has no more cells than the window, and the size is that of the bump alone."""
    small, large = field_map(half_mm=25.0), field_map(half_mm=100.0)
    assert large.mean.shape == (201, 201)
    answers = [estimator_of(one).run(inputs_of(one)[1], 0)[1] for one in (small, large)]
    sizes = [one.quantities[SIZE] for one in answers]
    assert sizes[1].median == pytest.approx(sizes[0].median, rel=0.1)


@pytest.mark.parametrize("case", [pytest.param("cells without data", marks=pytest.mark.slow), "one reading a cell"])
def test_poor_maps_are_measured_too(case: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(study, "LONG_RUNS", (("importance", 0.02),))
    given = field_map(half_mm=20.0)
    if case == "cells without data":
        hidden = np.random.default_rng(0).random(given.mean.shape) < 0.2
        given = grid_map(np.where(hidden, np.nan, given.mean), normalise="gain")
    else:
        given = grid_map(given.mean, normalise="gain", count=1)
    reference = estimator_of(given).reference(inputs_of(given)[1])
    assert reference.answer is not None
    assert reference.answer.quantities[SIZE].median == pytest.approx(13.6, rel=0.15)


@pytest.mark.long
def test_the_command_says_how_long_it_takes_and_pools(tmp_path: Path, run_cli: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(study, "FIELDS", (8, 12))
    write_map(tmp_path / "empty.nc", flat(25, 25), provenance=Provenance("map", {}))
    done = run_cli("tradeoff", "estimate", "empty.nc", "--runs", "1", "--figure", "f.png", cwd=tmp_path)
    assert done.returncode == 6
    assert "s of CPU to go" in done.stderr
    assert "no setting gives a size" in done.stdout
    assert (tmp_path / "f.png").stat().st_size > 1000
    write_map(tmp_path / "other.nc", flat(23, 25), provenance=Provenance("map", {}))
    both = run_cli("tradeoff", "estimate", "empty.nc", "other.nc", "--runs", "1", cwd=tmp_path)
    assert (both.returncode, "a lump was found on 0 of 2 maps" in both.stdout) == (6, True)
    twice = run_cli("tradeoff", "estimate", "empty.nc", "empty.nc", cwd=tmp_path)
    assert (twice.returncode, twice.stdout) == (2, "")
    (tmp_path / "s.toml").write_text('checkpoint = "c.npz"\n')
    kept = run_cli("tradeoff", "estimate", "empty.nc", "--settings", "s.toml", cwd=tmp_path)
    assert (kept.returncode, "leave checkpoint out" in kept.stderr) == (2, True)


@pytest.mark.long
def test_more_maps_of_one_mass_narrow_the_interval(tmp_path: Path):
    from tactile_bayes.actions.tradeoff import pooled_rows

    paths = []
    for seed in (1, 2, 3):
        paths.append(tmp_path / f"{seed}.nc")
        write_map(paths[-1], field_map(seed=seed, half_mm=20.0), provenance=Provenance("map", {}))
    quick = Settings(method="laplace")
    rows = pooled_rows(paths, quick, clock=time.process_time)
    assert [one.maps for one in rows] == [1, 2, 3]
    spread = pooled_rows(paths, replace(quick, between_map_sd=0.15), clock=time.process_time)
    one, three = (found.answer.half_width_mm / found.answer.reported.median for found in (spread[0], spread[2]))
    assert three < 0.9 * one
    assert rows[2].another_half_width_mm < 0.85 * rows[0].another_half_width_mm
    assert rows[2].cpu_s > rows[0].cpu_s


@pytest.mark.slow
def test_the_whole_command_runs(run_cli: Run, tmp_path: Path):
    write_map(tmp_path / "m.nc", field_map(), provenance=Provenance("map", {}))
    done = run_cli("tradeoff", "estimate", "m.nc", "--runs", "1", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["reference"]["mc_error_mm"] < 0.05
    assert document["shared_cpu_s"]
