"""`demo` as a user runs it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

Run = Callable[..., "CompletedProcess[str]"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def shown(run_cli: Run, place: Path) -> CompletedProcess[str]:
    return run_cli("demo", "-o", "out", "--method", "laplace", cwd=place)


def test_it_shows_the_way_through_and_ends_with_the_truth(shown: CompletedProcess[str]) -> None:
    assert shown.returncode == 0, shown.stderr
    for name in ("map", "calibrate size", "estimate", "validate"):
        assert f"$ tactile-bayes {name} " in shown.stdout
    assert "The scan was simulated about a lump of 15 mm." in shown.stdout
    assert shown.stdout.rstrip().endswith("Research use only: not a diagnostic device.")
    assert shown.stderr == ""


def test_the_interval_holds_the_truth(shown: CompletedProcess[str]) -> None:
    line = next(line for line in shown.stdout.splitlines() if line.startswith("largest size"))
    low, _, high = line.split()[-4:-1]
    assert float(low) < 15.0 < float(high)


def test_it_leaves_every_file_behind_for_its_owner_only(shown: CompletedProcess[str], place: Path) -> None:
    assert shown.returncode == 0
    files = {path.name: path for path in (place / "out").iterdir()}
    made = {"scan.mcap", "phantoms.csv", "trial.csv", "excision.csv", "map.nc", "size.json", "posterior.nc"}
    assert made | {"size.png", "map.png", "trial.json"} <= set(files)
    assert {path.stat().st_mode & 0o777 for path in files.values()} == {0o600}


def test_the_printed_commands_do_it_by_hand(run_cli: Run, shown: CompletedProcess[str], place: Path) -> None:
    """Each as printed, with --force, gives the same bytes again."""
    before = {path.name: path.read_bytes() for path in (place / "out").iterdir()}
    typed = [line.removeprefix("$ tactile-bayes ") for line in shown.stdout.splitlines() if line.startswith("$ ")]
    assert len(typed) == 4
    for line in typed:
        done = run_cli(*line.split(), "--force", cwd=place)
        assert done.returncode == 0, done.stderr
    assert {path.name: path.read_bytes() for path in (place / "out").iterdir()} == before


def test_another_demo_does_not_overwrite_the_first(run_cli: Run, shown: CompletedProcess[str], place: Path) -> None:
    assert shown.returncode == 0
    done = run_cli("demo", "-o", "out", cwd=place)
    assert done.returncode == 2
    assert "--force" in done.stderr
