"""The benchmarks run and say against whom they measured; what they find is no test's business."""

from __future__ import annotations

import json

import pytest

from benchmarks.cold_start import CASES, DEMO, MEASURED_ELSEWHERE, PEERS
from benchmarks.measure import CommandFailedError, run_once
from benchmarks.run import main
from tactile_bayes.cli import COMMANDS


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


def test_the_cases_find_their_data():
    paths = [word for case in CASES for word in case.words if word.startswith(str(DEMO))]
    assert paths
    assert [path for path in paths if not DEMO.joinpath(path).is_file()] == []


def test_a_command_that_fails_is_not_measured(tmp_path):
    with pytest.raises(CommandFailedError, match="exit code 3: gone"):
        run_once(("-c", "import sys; print('gone', file=sys.stderr); sys.exit(3)"), folder=tmp_path)
