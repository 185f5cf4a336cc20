"""The command `plan`: what it prints and writes, its pilot, and its refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas
import pytest
from click.testing import CliRunner, Result
from published_schemas import check_document

import tactile_bayes as tb
from tactile_bayes.commands.trial import plan_command as command
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.presets import RESEARCH_USE

DEMO = Path(tb.__file__).parent / "demo"
SMALL = ("--patients", 12, "--maps", 1, "--maps", 3, "--trials", 50)


def plan(*args: object) -> Result:
    return CliRunner().invoke(command, [str(arg) for arg in args])


def test_the_same_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    printed = plan(*SMALL, "--json", "-o", tmp_path / "a.json")
    again = plan(*SMALL, "--json", "--workers", 0)
    assert (printed.exit_code, again.exit_code) == (0, 0), printed.output
    assert printed.stdout_bytes == again.stdout_bytes == (tmp_path / "a.json").read_bytes()
    document = json.loads(printed.stdout)
    check_document(document, "plan.schema.json")
    assert [(one["patients"], one["maps"]) for one in document["designs"]] == [(12, 1), (12, 3)]
    assert [(one["from_maps"], one["to_maps"]) for one in document["gains"]] == [(1, 3)]
    assert document["research_use"] == RESEARCH_USE


def test_the_text_names_designs_and_gains() -> None:
    lines = plan(*SMALL).stdout.splitlines()
    assert any("12 patients, from 1 to 3 maps" in line for line in lines)
    assert lines[-1] == RESEARCH_USE
    assert max(map(len, lines)) < 150


def test_a_pilot_gives_the_errors() -> None:
    pilot = ("--pilot", DEMO / "trial.csv", "--excision", DEMO / "excision.csv")
    errors = json.loads(plan(*SMALL, *pilot, "--json").stdout)["errors"]
    assert errors["map_sd"] == pytest.approx(0.15, rel=0.1)  # what the generator of the demo drew
    assert errors["other_miss"] == pytest.approx(1 / 25)


def test_refusals_name_the_way_out() -> None:
    assert isinstance(plan(*SMALL, "--pilot", DEMO / "trial.csv").exception, UsageError)
    pilot = ("--pilot", DEMO / "trial.csv", "--excision", DEMO / "excision.csv")
    error = plan(*SMALL, *pilot, "--against", "mri").exception
    assert isinstance(error, BadDataError)
    assert "choose one with --against" in str(error)
    assert plan("--patients", 7).exit_code == 2


def test_python_plans_as_the_command_does(tmp_path: Path) -> None:
    tables = {"pilot": DEMO / "trial.csv", "excision": DEMO / "excision.csv"}
    words = [word for name, path in tables.items() for word in (f"--{name}", path)]
    told = plan(*SMALL, *words, "--map-sd", 0.2, "--json", "-o", tmp_path / "a.json")
    given = {"patients": [12], "maps": (3, 1), "trials": 50, "map_sd": 0.2}
    found = tb.plan(**given, **tables)
    assert found.document == json.loads(told.stdout)
    found.write_json(tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()
    assert found.text == plan(*SMALL, *words, "--map-sd", 0.2).stdout
    frames = {name: pandas.read_csv(path) for name, path in tables.items()}
    assert {**tb.plan(**given, **frames).document, "provenance": 0} == {**found.document, "provenance": 0}


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"patients": [7]}, "patients is 7; give a whole number from 8"),
        ({"maps": 3}, "maps is 3; give a list of whole numbers"),
        ({"trials": 49}, "trials is 49"),
        ({"map_sd": -1.0}, "map_sd is -1"),
        ({"against": "mri"}, "against says how a pilot is read"),
        ({"pilot": DEMO / "trial.csv"}, "pilot needs excision"),
    ],
)
def test_python_refuses_with_its_own_words(given: dict[str, Any], fault: str) -> None:
    with pytest.raises(UsageError, match=fault):
        tb.plan(**given)
