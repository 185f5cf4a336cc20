"""`tradeoff estimate`: the ladder's rows, its advice, and what it says of a map without a lump."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from posterior_maps import bump_map, correlated_field, grid_map

from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.report.tradeoff_estimate import advice, draw_tradeoff, tradeoff_document, tradeoff_text
from tactile_bayes.studies import estimate_tradeoff as tradeoff
from tactile_bayes.studies.estimate_tradeoff import Measured, Tradeoff, measure

Run = Callable[..., "CompletedProcess[str]"]


def errors() -> np.ndarray:
    rng = np.random.default_rng(3)
    return 0.005 * rng.standard_normal((51, 51)) + 0.01 * correlated_field(rng, 51, length_cells=4.0)


@cache
def report() -> Tradeoff:
    ticks = itertools.count()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff, "STEPS", (150,))
        patch.setattr(tradeoff, "REFERENCE_POINTS", 4096)
        patch.setattr(tradeoff, "FIELDS", (8, 18, 24))
        found = measure(
            bump_map(noise=errors()), radius_mm=20.0, prior=BumpPrior(), clock=lambda: float(next(ticks)), runs=2
        )
    assert isinstance(found, Tradeoff)
    return found


def test_every_method_is_measured() -> None:
    rows = report().measured
    assert [one.method for one in rows] == ["optimise", "laplace", *["importance"] * 4, "ensemble"]
    assert all(not one.failed and one.cpu_s == 1.0 for one in rows)
    by = {(one.method, one.setting): one for one in rows}
    fine, coarse = by["importance", "--accuracy-sd 0.01"], by["importance", "--accuracy-sd 0.05"]
    assert fine.evaluations > coarse.evaluations > 0
    assert fine.error_sd < 0.04
    assert by["laplace", ""].error_sd < 0.3
    # least squares with judged errors is another model: it is not the field's posterior
    assert by["optimise", ""].error_sd > 2 * fine.error_sd


def test_finer_noise_fields_move_the_ends_less_and_less() -> None:
    coarse, default, finest = report().fields
    assert coarse.change_sd > 0.3 > default.change_sd > finest.change_sd == 0.0
    assert coarse.change_mm == pytest.approx(coarse.change_sd * np.mean(report().sd_mm), rel=0.5)


def test_errors_in_mm_are_those_in_sd_times_the_sd() -> None:
    found = report()
    for one in found.measured:
        if one.method == "importance":
            assert one.error_mm == pytest.approx(one.error_sd * np.mean(found.sd_mm), rel=0.6)


def row(method: str, setting: str, cpu: float, error: float) -> Measured:
    return Measured(method, setting, cpu, 1000.0, error, error)


def test_the_advice_is_the_cheapest_within_the_tolerance() -> None:
    rows = (
        row("laplace", "", 0.01, 0.2),
        row("importance", "--accuracy-sd 0.02", 0.1, 0.02),
        row("ensemble", "600 steps", 2.0, 0.03),
    )
    found = Tradeoff(rows, 0.003, 0.2, (0.1, 0.1), 4)
    assert "--method importance --accuracy-sd 0.02: the cheapest" in advice(found, tolerance_sd=0.05)
    assert "--method laplace: " in advice(found, tolerance_sd=0.5)
    assert "nothing here is within 0.001 SD" in advice(found, tolerance_sd=0.001)
    failed = replace(rows[1], failed="not converged", error_sd=float("nan"))
    assert "--method ensemble (600 steps)" in advice(
        replace(found, measured=(rows[0], failed, rows[2])), tolerance_sd=0.05
    )


def test_it_can_be_read_printed_and_drawn(tmp_path: Path) -> None:
    text = tradeoff_text(report(), tolerance_sd=0.05)
    assert text.count("importance") >= 4
    assert "Advice: --method" in text
    document = json.loads(json.dumps(tradeoff_document(report(), tolerance_sd=0.05)))
    assert len(document["measured"]) == len(report().measured)
    for name in ("a.png", "b.png"):
        draw_tradeoff(report(), tmp_path / name, tolerance_sd=0.05)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_without_a_bump_there_is_nothing_to_compare() -> None:
    found = measure(grid_map(np.ones((31, 31))), radius_mm=20.0, prior=BumpPrior(), clock=lambda: 0.0)
    assert found == "nothing rises above the background"


@pytest.mark.slow
def test_the_command_runs(run_cli: Run, tmp_path: Path) -> None:
    write_map(tmp_path / "m.nc", bump_map(noise=errors()), provenance=Provenance("map", {}))
    done = run_cli("tradeoff", "estimate", "m.nc", "--runs", "1", "--figure", "f.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Advice" in done.stdout
    assert (tmp_path / "f.png").stat().st_size > 1000


def test_the_command_says_why_not(run_cli: Run, tmp_path: Path) -> None:
    write_map(tmp_path / "m.nc", grid_map(np.ones((31, 31))), provenance=Provenance("map", {}))
    done = run_cli("tradeoff", "estimate", "m.nc", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (6, "Nothing to compare: nothing rises above the background.\n")
