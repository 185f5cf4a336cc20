"""`sbc` as a user runs it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from in_process import run_here

from tactile_bayes.actions import study as command
from tactile_bayes.report.laboratory import sbc_document, sbc_text
from tactile_bayes.studies.sbc import PARAMETERS, MapRanks, Truth

TRUTH = Truth(1.2, 6.0, 4.5, 1.3, -0.8, 6.0, 3.0, 0.02)


def quick(index: int, *, method: str, seed: int, cosines: int) -> MapRanks:
    """In place of a simulated map: ranks as calibrated as can be; every tenth map gives none."""
    if index % 10 == 9:
        return MapRanks(index, TRUTH, None, "undetected")
    del cosines
    return MapRanks(index, TRUTH, tuple((index * 37 + k * 11 + seed) % 100 for k in range(5)), method)


@pytest.mark.long
def test_a_run_of_six_maps_prints_the_ranks_and_writes_table_and_figure(tmp_path: Path) -> None:
    words = ("sbc", "--maps", 6, "--method", "laplace", "-o", "s.csv", "--figure", "s.png")
    done = run_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "6 maps from the model's own prior" in done.stdout
    assert "maps/s" in done.stdout
    assert "conditional on detection" in done.stdout
    assert all(name in done.stdout for name in PARAMETERS)
    assert done.stdout.rstrip().endswith("Research use only: not a diagnostic device.")
    table = (tmp_path / "s.csv").read_text().splitlines()
    assert len(table) == 7
    assert table[0].startswith("map,amplitude,sigma_x_mm")
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "s.csv.unfinished").exists()
    again = run_here(*words, cwd=tmp_path)
    assert again.returncode != 0
    assert "s.csv" in again.stderr


def test_an_interrupted_run_goes_on_and_gives_the_same_table(tmp_path: Path, monkeypatch) -> None:
    calls: list[int] = []

    def stopping(index: int, *, method: str, seed: int, cosines: int) -> MapRanks:
        calls.append(index)
        if index == 3 and calls.count(3) == 1:
            raise KeyboardInterrupt
        return quick(index, method=method, seed=seed, cosines=cosines)

    monkeypatch.setattr(command, "shipped_ranks", stopping)
    words = ("sbc", "--maps", 12, "-o", "s.csv")
    assert run_here(*words, cwd=tmp_path).returncode == 130
    assert not (tmp_path / "s.csv").exists()
    other = run_here(*words, "--seed", 3, cwd=tmp_path)
    assert other.returncode == 2
    assert "other settings" in other.stderr
    assert run_here(*words, cwd=tmp_path).returncode == 0
    assert calls == [0, 1, 2, 3, *range(3, 12)]
    first = (tmp_path / "s.csv").read_bytes()
    assert run_here(*words, "--force", cwd=tmp_path).returncode == 0
    assert (tmp_path / "s.csv").read_bytes() == first


def test_the_json_has_ranks_and_maps_without_an_estimate(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(command, "shipped_ranks", quick)
    done = run_here("sbc", "--maps", 100, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["schema"] == "tactile-bayes/sbc/1"
    assert found["abstained"] == {"undetected": 10}
    assert found["drawn_by"] == {"importance": 90}
    assert found["p_together"] > 0.05
    assert [one["name"] for one in found["parameters"]] == list(PARAMETERS)
    assert all(one["verdict"] == "ok" for one in found["parameters"])


def test_a_posterior_that_fails_is_said_to_fail_and_the_exit_code_stays(tmp_path: Path, monkeypatch) -> None:
    def narrow(index: int, *, method: str, seed: int, cosines: int) -> MapRanks:
        del seed, cosines
        end = (0, 99)[index % 2]
        return MapRanks(index, TRUTH, (index, end, index, index, index), method)

    monkeypatch.setattr(command, "shipped_ranks", narrow)
    done = run_here("sbc", "--maps", 100, "--figure", "s.png", cwd=tmp_path)
    assert done.returncode == 0
    assert "FAILS for sigma_x_mm:" in done.stdout
    assert "too narrow" in done.stdout
    assert "that is no chance" in done.stdout


def test_maps_that_all_abstain_leave_nothing_to_rank(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(command, "shipped_ranks", lambda i, **_: MapRanks(i, TRUTH, None, "window"))
    done = run_here("sbc", "--maps", 3, "--figure", "s.png", "-o", "s.csv", cwd=tmp_path)
    assert done.returncode == 0
    assert "no estimate on 3 (window 3)" in done.stdout
    assert "nothing to rank" in done.stdout
    assert [row["outcome"] for row in csv.DictReader((tmp_path / "s.csv").read_text().splitlines())] == ["window"] * 3


def test_ctrl_c_reports_the_maps_that_are_done_where_nothing_keeps_them(tmp_path: Path, monkeypatch) -> None:
    def interrupted(index: int, *, method: str, seed: int, cosines: int) -> MapRanks:
        if index == 2:
            raise KeyboardInterrupt
        return quick(index, method=method, seed=seed, cosines=cosines)

    monkeypatch.setattr(command, "shipped_ranks", interrupted)
    done = run_here("sbc", "--maps", 5, "--json", cwd=tmp_path)
    assert done.returncode == 130
    assert json.loads(done.stdout)["maps"] == 2
    assert "interrupted: 2 of 5 done" in done.stderr
    kept = run_here("sbc", "--maps", 5, "-o", "s.csv", cwd=tmp_path)
    assert (kept.returncode, kept.stdout) == (130, "")
    assert "interrupted: 2 of 5 done; s.csv.unfinished keeps them, run again to go on" in kept.stderr


def test_a_map_that_fails_is_named_and_the_others_count(tmp_path: Path, monkeypatch) -> None:
    def failing(index: int, *, method: str, seed: int, cosines: int) -> MapRanks:
        if index == 1:
            raise ValueError("no such thing")
        return quick(index, method=method, seed=seed, cosines=cosines)

    monkeypatch.setattr(command, "shipped_ranks", failing)
    done = run_here("sbc", "--maps", 3, "-o", "s.csv", cwd=tmp_path)
    assert "could not be estimated: map 1: ValueError: no such thing" in done.stderr
    assert "error: 1 of 3 maps are missing from this report" in done.stderr
    assert done.returncode == 1
    assert (tmp_path / "s.csv.unfinished").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--maps", "0"], "--maps"),
        (["--method", "optimise"], "--method"),
        (["--seed", "-1"], "--seed"),
        (["--maps", "2", "-o", "nowhere/s.csv"], "nowhere"),
    ],
)
def test_bad_input_gets_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    done = run_here("sbc", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr.strip().splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("number", "words"), [(20, "bands. So few maps (18) show gross faults alone; give more"), (60, "bands.")]
)
def test_few_maps_are_said_to_show_little(number: int, words: str) -> None:
    """After one map it read that all ranks stay in their bands."""
    maps = [quick(index, method="laplace", seed=1, cosines=18) for index in range(number)]
    first = sbc_text(sbc_document(maps, method="laplace", seed=1, maps_per_s=None)).splitlines()[0]
    assert first.startswith(f"All ranks stay in their simultaneous 95 % {words}")
    assert ("few" in first) == (number == 20)
