"""The benchmarks run and say against whom they measured; what they find is no test's business."""

from __future__ import annotations

import json

import pytest

from benchmarks.cold_start import CASES, DEMO, MEASURED_ELSEWHERE, PEERS
from benchmarks.forward import HARD, ReusedBody
from benchmarks.last import LAST, MARGIN, Comparison, read_figures
from benchmarks.measure import CommandFailedError, run_once
from benchmarks.run import main
from tactile_bayes.cli import COMMANDS
from tactile_bayes.presets import MEAN_KPA


def test_one_case_is_measured_against_its_peer(tmp_path, capsys):
    assert main(["--only", "help", "--runs", "1", "--json", str(tmp_path / "out.json")]) == 0
    document = json.loads((tmp_path / "out.json").read_text())
    (case,) = document["cases"]
    peer = document["peers"]["python"]
    assert case["peer"] == "python"
    assert case["cpu_ratio"] == pytest.approx(case["cpu_s"] / peer["cpu_s"], rel=0.1)
    assert case["memory_ratio"] == pytest.approx(case["peak_mb"] / peer["peak_mb"], rel=0.1)
    assert "x CPU" in capsys.readouterr().out


def test_every_command_has_a_case():
    measured = {case.words[0] for case in CASES} - {"--help"}
    assert measured | set(MEASURED_ELSEWHERE) == set(COMMANDS)
    assert not measured & set(MEASURED_ELSEWHERE)
    assert {case.peer for case in CASES} <= set(PEERS)


def test_the_data_of_every_case_exist():
    paths = [word for case in CASES for word in case.words if word.startswith(str(DEMO))]
    assert paths
    assert [path for path in paths if not DEMO.joinpath(path).is_file()] == []


def test_a_command_that_fails_is_not_measured(tmp_path):
    with pytest.raises(CommandFailedError, match="exit code 3: gone"):
        run_once(("-c", "import sys; print('gone', file=sys.stderr); sys.exit(3)"), folder=tmp_path)


def test_a_ratio_that_got_worse_is_flagged_and_others_are_not(tmp_path):
    first = Comparison("map", tmp_path / "last.csv")
    assert first.add("path", 1.0) == ""
    first.add("memory", 2.0)
    assert "--keep" in first.report()
    first.keep()
    second = Comparison("map", tmp_path / "last.csv")
    assert second.add("path", 1.01 + MARGIN) == " (last 1.00, WORSE)"
    assert second.add("memory", 2.0 + 1.9 * MARGIN) == " (last 2.00)"
    assert second.add("new", 9.0) == ""
    assert second.worse() == ["path"]
    assert second.report() == "1 of 2 ratios are more than 20 % above the last kept ones: path"
    assert Comparison("other", tmp_path / "last.csv").add("path", 9.0) == ""
    second.keep()
    assert {one.name: one.ratio for one in read_figures(tmp_path / "last.csv")} == {
        "path": 1.21,
        "memory": 2.38,
        "new": 9.0,
    }


def test_a_peer_of_the_plane_model_presses_a_body_with_fewer_nodes_than_cells():
    """`make bench-forward` ended in a traceback: the compliance of its cells is singular."""
    assert ReusedBody(HARD).press(10.0).mean() == pytest.approx(MEAN_KPA)


def test_make_bench_compares_with_the_last_kept_ratios(tmp_path, capsys):
    table = tmp_path / "last.csv"
    words = ["--only", "help", "--runs", "1", "--last", str(table)]
    assert main([*words, "--keep"]) == 0
    kept = read_figures(table)
    assert [one.name for one in kept] == ["help, CPU", "help, memory"]
    table.write_text(table.read_text().replace(str(kept[0].ratio), "0.01"))
    capsys.readouterr()
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "(last 0.01, WORSE)" in printed
    assert "1 of 2 ratios are more than 20 % above the last kept ones: help, CPU" in printed


def test_the_table_holds_ratios_of_the_commands_and_of_maps():
    kept = read_figures(LAST)
    assert {one.bench for one in kept} == {"commands", "map"}
    assert all(one.ratio > 0 and one.date and one.kernel and one.python for one in kept)
