"""`study` as a user runs it: small grids, interruption, faults, and what reads its table."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tactile_bayes.errors import EXIT_BAD_DATA, EXIT_USAGE

Run = Callable[..., "CompletedProcess[str]"]
GRID = "d_mm,depth_ratio,stiffness_ratio\n" + "".join(f"{d},{h},100\n" for d in (10, 15, 20) for h in (0.8, 1, 1.2))
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def folder(run_cli: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small study."""
    path = tmp_path_factory.mktemp("study")
    (path / "grid.csv").write_text(GRID)
    done = run_cli("study", "--grid", "grid.csv", "-o", "study.csv", "--fineness", 1, cwd=path)
    assert done.returncode == 0, done.stderr
    (path / "stdout.txt").write_text(done.stdout)
    return path


def test_a_grid_becomes_a_table_and_a_summary(folder: Path) -> None:
    rows = list(csv.DictReader((folder / "study.csv").read_text().splitlines()))
    assert [(row["d_mm"], row["depth_ratio"]) for row in rows[:2]] == [("10", "0.8"), ("10", "1")]
    assert {row["seat"] for row in rows} == {"centred"}
    assert {row["detectable"] for row in rows} == {"true"}
    recipe = {"normalise": "mean", "background": "fixed", "fit_radius_mm": "48", "noise": "independent"}
    assert recipe.items() <= rows[0].items()
    assert "flat_field" not in rows[0]  # a matter of the solid model
    said = (folder / "stdout.txt").read_text()
    assert "9 cases, 0 not detectable" in said
    assert "centred, E2/E1 = 100: d = " in said
    assert "Research use only" in said
    assert not (folder / "study.csv.unfinished").exists()


def test_without_an_output_the_table_is_printed_alone(folder: Path, run_cli: Run) -> None:
    done = run_cli("study", "--grid", "grid.csv", "--fineness", 1, cwd=folder)
    assert done.stdout == (folder / "study.csv").read_text()
    assert "9 cases" in done.stderr


@pytest.mark.slow
def test_processes_make_no_difference(folder: Path, run_cli: Run) -> None:
    done = run_cli("study", "--grid", "grid.csv", "--fineness", 1, "--workers", 2, cwd=folder)
    assert done.stdout == (folder / "study.csv").read_text()


def test_the_table_is_one_that_calibrate_reads(folder: Path) -> None:
    from tactile_bayes.api.size_calibration import size_table
    from tactile_bayes.files.tables import read_table

    table = read_table(folder / "study.csv", "size_table.table.json")
    assert table.columns["detectable"] == [True] * 9
    learned_from = size_table(table)
    assert learned_from.width_change_x is not None
    assert learned_from.width_change_x[1] == 1.0


@pytest.mark.slow
def test_a_calibration_is_learned_from_the_table(folder: Path, run_cli: Run) -> None:
    done = run_cli("calibrate", "size", "study.csv", "-o", "size.json", "--fit-radius-mm", 48, cwd=folder)
    assert done.returncode == 0, done.stderr


def test_a_grid_may_say_its_seats(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text(
        "seat,d_mm,depth_ratio,stiffness_ratio\nresting,10,1,100\n0.5,10,1,100\n,10,1,100\n"
    )
    done = run_cli("study", "--grid", "g.csv", "--seat", "0.25", "--fineness", 1, cwd=tmp_path)
    rows = list(csv.DictReader(done.stdout.splitlines()))
    assert [row["seat"] for row in rows] == ["resting", "0.5", "0.25"]
    assert float(rows[0]["amplitude"]) > float(rows[1]["amplitude"]) > float(rows[2]["amplitude"])


@pytest.mark.long
def test_an_interrupted_study_goes_on_where_it_stopped(folder: Path, run_cli: Run, tmp_path: Path) -> None:
    """The store of a killed run: two geometries, and a third half written."""
    from tactile_bayes.actions.study import study_settings
    from tactile_bayes.batch import open_store
    from tactile_bayes.options import SectionOptions, StudyOptions

    settings = study_settings(StudyOptions(fineness=1), SectionOptions())
    (tmp_path / "grid.csv").write_text(GRID)
    store = tmp_path / "study.csv.unfinished"
    marked = {"seat": "centred", "d_mm": 10.0, "depth_ratio": 0.8, "stiffness_ratio": 100.0}
    marked |= {"amplitude": 0.123, "sigma_x_mm": 4.5, "fit_rms": 0.01, "detectable": True}
    with open_store(store, settings=settings.as_dict()) as kept:
        kept.add("seat 0, d 10 mm, h/d 0.8, E2/E1 100", [marked])
    with store.open("a") as file:
        file.write('{"key": "seat 0, d 10 mm, h/d 1, E2')
    done = run_cli("study", "--grid", "grid.csv", "-o", "study.csv", "--fineness", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    resumed = (tmp_path / "study.csv").read_text().splitlines()
    assert resumed[1] == "centred,10,0.8,100,0.123,4.5,0.01,true,,,,,,,"  # what the store had was not computed again
    assert resumed[2:] == (folder / "study.csv").read_text().splitlines()[2:]
    assert not store.exists()


def test_a_store_of_other_settings_is_refused(run_cli: Run, tmp_path: Path) -> None:
    from tactile_bayes.batch import open_store

    (tmp_path / "grid.csv").write_text(GRID)
    with open_store(tmp_path / "study.csv.unfinished", settings={"poisson": 0.3}):
        pass
    done = run_cli("study", "--grid", "grid.csv", "-o", "study.csv", cwd=tmp_path)
    assert done.returncode == EXIT_USAGE
    assert "other settings" in done.stderr


FAULTS: dict[str, tuple[tuple[object, ...], int, list[str]]] = {
    "seat": (("--seat", "sitting"), EXIT_BAD_DATA, ["seat is 'sitting'", "centred, resting or a number from 0 to 2"]),
    "no grid": (("--grid", "none.csv"), EXIT_BAD_DATA, ["none.csv"]),
    "sharp": (("--shoulder-mm", 13), EXIT_BAD_DATA, ["shoulder_mm of the head is 13", "between 0 and 12 mm"]),
    "flat": (("--head-radius-mm", 5), EXIT_BAD_DATA, ["radius_mm of the head is 5", "above 12 mm"]),
    "liquid": (("--poisson", 0.5), EXIT_BAD_DATA, ["poisson is 0.5", "below 0.5"]),
    "thin": (("--thickness-mm", 20), EXIT_BAD_DATA, ["thickness_mm is 20", "lowest point"]),
    "exists": (("-o", "there.csv"), EXIT_USAGE, ["there.csv exists", "--force"]),
    "free": (("--background", "free"), EXIT_USAGE, ["--background free is for --model solid"]),
    "flat field": (("--flat-field",), EXIT_USAGE, ["--flat-field is for --model solid"]),
    "no model": (("--model", "clay"), EXIT_USAGE, ["clay"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_an_impossible_study_is_one_line(name: str, run_cli: Run, tmp_path: Path) -> None:
    words, code, said = FAULTS[name]
    (tmp_path / "there.csv").write_text("")
    done = run_cli("study", *words, cwd=tmp_path)
    assert done.returncode == code
    assert all(text in done.stderr for text in said), done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("d_mm,depth_ratio,stiffness_ratio\n10,0.5,100\n", ["depth_ratio is 0.5", "at least 0.52"]),
        ("d_mm,depth_ratio,stiffness_ratio\n10,1,0\n", ["line 2", "stiffness_ratio", "above 0"]),
        ("d_mm,depth_ratio,stiffness_ratio\n10,1,8\n10,1,8\n", ["g.csv", "appears twice"]),
        ("d_mm,depth_ratio\n10,1\n", ["stiffness_ratio", "is missing"]),
        ("d_mm\n10\n", ["depth_ratio: is missing", "and stiffness_ratio: "]),
        ("d_cm,depth_ratio,stiffness_ratio\n1,1,8\n", ["convert it to d_mm"]),
        ("seat,d_mm,depth_ratio,stiffness_ratio\nhigh,10,1,8\n", ["seat is 'high'"]),
    ],
)
def test_a_grid_with_a_fault_is_refused_before_any_work(
    text: str, said: list[str], run_cli: Run, tmp_path: Path
) -> None:
    (tmp_path / "g.csv").write_text(text)
    done = run_cli("study", "--grid", "g.csv", "-o", "out.csv", cwd=tmp_path)
    assert done.returncode == EXIT_BAD_DATA
    assert all(word in done.stderr for word in said), done.stderr
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.slow
def test_four_figures_are_drawn(folder: Path, run_cli: Run) -> None:
    words = ("study", "--grid", "grid.csv", "--fineness", 1, "--figures", "figures")
    done = run_cli(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    for number in (5, 6, 7, 8):
        assert (folder / "figures" / f"figure_{number}.png").read_bytes().startswith(PNG)
    assert (folder / "figures" / "four_lumps.png").read_bytes().startswith(PNG)
    assert "figure 5b: " in done.stderr
    again = run_cli(*words, cwd=folder)
    assert again.returncode == EXIT_USAGE
    assert "figure_5.png exists" in again.stderr


@pytest.mark.long
def test_a_figure_is_the_same_bytes_each_time(tmp_path: Path) -> None:
    from tactile_bayes.report.study import figure_8
    from tactile_bayes.studies.paper import StudyRow

    rows = [
        StudyRow("centred", d, h, 100.0, 0.3 / h**3, d * h / 4, 0.01, True) for d in (5.0, 15.0) for h in (0.6, 1.0)
    ]
    for name in ("one.png", "two.png"):
        figure_8(rows, tmp_path / name)
    figure_8([], tmp_path / "none.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
