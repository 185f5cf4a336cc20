"""`demo` as a user runs it."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from in_process import run_here

from tactile_bayes.actions.exam import _how_to_type
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.forward.tissue import SolidLump

Run = Callable[..., "CompletedProcess[str]"]
TRUE_MM = 15.0
MAP, OUTPUT = ["my demo/map.nc"], ["-o", "my demo/posterior_eq6.nc", "--force"]
STEPS = ["map", "estimate", "estimate", "validate"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("a demo")


@pytest.fixture(scope="module")
def shown(run_cli: Run, place: Path) -> CompletedProcess[str]:
    return run_cli("demo", "-o", "my demo", "--method", "laplace", cwd=place)


def typed(shown: CompletedProcess[str]) -> list[list[str]]:
    """The commands that the demo prints, as a shell splits them."""
    return [shlex.split(line)[2:] for line in shown.stdout.splitlines() if line.startswith("$ tactile-bayes ")]


@pytest.mark.long
def test_the_demo_shows_the_default_first_and_ends_with_truth_and_results(shown: CompletedProcess[str]) -> None:
    assert shown.returncode == 0, shown.stderr
    assert [words[0] for words in typed(shown)] == STEPS
    first_map, first_estimate = typed(shown)[:2]
    assert "--normalise" not in first_map
    assert "--size-calibration" not in first_estimate
    assert typed(shown)[2][1:] == [*MAP, "--size-calibration", "eq6", "--method", "ensemble", *OUTPUT]
    assert "Eq 6 lies -" in shown.stdout
    summary = shown.stdout.partition("Largest size of the lump")[2]
    assert re.search(rf"^true +{TRUE_MM:.1f}$", summary, flags=re.MULTILINE)
    assert shown.stdout.rstrip().endswith("Research use only: not a diagnostic device.")
    assert shown.stderr == ""


@pytest.mark.long
@pytest.mark.parametrize("road", ["estimate, the default", "the paper's Eq 6"])
def test_the_interval_covers_the_truth_and_says_so(shown: CompletedProcess[str], road: str) -> None:
    (line,) = [line for line in shown.stdout.splitlines() if line.startswith(road)]
    figures = [float(number) for number in re.findall(r"\d+\.\d", line)]
    assert len(figures) == 3
    assert figures[1] < TRUE_MM < figures[2]
    assert line.endswith("covers the true size")


@pytest.mark.long
@pytest.mark.usefixtures("shown")
def test_the_scan_is_of_a_body_that_the_calibration_has_seen(run_cli: Run, place: Path) -> None:
    """The README's two commands on the packaged scan: within 20 % of the truth, and nothing outside the range."""
    scene = read_scene(place / "my demo" / "scene.toml")
    assert scene.solid_lumps == (SolidLump(d_mm=TRUE_MM, stiffness_ratio=30.0, seat=0.0),)
    assert run_cli("map", "my demo/scan.mcap", "-o", "by hand.nc", cwd=place).returncode == 0
    done = run_cli("estimate", "by hand.nc", "--json", cwd=place)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["max_size_mm"]["median"] == pytest.approx(TRUE_MM, rel=0.2)
    assert (found["verdict"], found["findings"]) == ("sound", [])


@pytest.mark.long
def test_the_demo_leaves_every_file_for_its_owner_only(shown: CompletedProcess[str], place: Path) -> None:
    assert shown.returncode == 0
    files = {path.name: path for path in (place / "my demo").iterdir()}
    made = {"scan.mcap", "phantoms.csv", "trial.csv", "excision.csv", "map.nc", "posterior.nc", "posterior_eq6.nc"}
    assert made | {"size.png", "map.png", "trial.json", "trial.html"} <= set(files)
    assert {path.stat().st_mode & 0o777 for path in files.values()} == {0o600}


@pytest.mark.slow
def test_the_printed_commands_do_it_by_hand(run_cli: Run, shown: CompletedProcess[str], place: Path) -> None:
    """Each as printed, in a folder whose name has a space, works and gives the same bytes again."""
    before = {path.name: path.read_bytes() for path in (place / "my demo").iterdir()}
    for words in typed(shown):
        done = run_cli(*words, cwd=place)
        assert done.returncode == 0, done.stderr
    assert {path.name: path.read_bytes() for path in (place / "my demo").iterdir()} == before


@pytest.mark.parametrize(
    ("found", "started", "words"),
    [
        ("/usr/bin/tactile-bayes", "/usr/bin/tactile-bayes", ""),
        (None, ".venv/bin/tactile-bayes", "type .venv/bin/tactile-bayes for it"),
        (None, "/somewhere/tactile_bayes/__main__.py", "-m tactile_bayes for it"),
    ],
)
def test_the_demo_says_what_to_type_where_the_program_is_not_on_the_path(
    monkeypatch: pytest.MonkeyPatch, found: str | None, started: str, words: str
) -> None:
    monkeypatch.setattr("sys.argv", [started, "demo"])
    monkeypatch.setattr("shutil.which", lambda _: found)
    said = _how_to_type()
    assert words in said
    assert bool(said) == bool(words)


@pytest.mark.parametrize(("output", "words"), [("mine/a", "mine/a is a file"), ("mine", "mine is not empty")])
def test_a_demo_leaves_what_is_there_alone(tmp_path: Path, output: str, words: str) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a").write_text("mine")
    refused = run_here("demo", "-o", output, cwd=tmp_path)
    assert refused.returncode == 2
    assert f"{words}; choose another name" in refused.stderr
    assert [one.read_text() for one in (tmp_path / "mine").iterdir()] == ["mine"]


@pytest.mark.long
def test_another_demo_does_not_overwrite_the_first(run_cli: Run, shown: CompletedProcess[str], place: Path) -> None:
    assert shown.returncode == 0
    done = run_cli("demo", "-o", "my demo", cwd=place)
    assert done.returncode == 2
    assert "--force" in done.stderr
