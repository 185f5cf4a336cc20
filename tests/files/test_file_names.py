"""Names of files: one file under several names, and a name that promises another format than the one written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from in_process import run_here
from repeated_exams import estimate_document

import tactile_bayes as tb
from tactile_bayes.errors import UsageError
from tactile_bayes.exports.run import Outputs
from tactile_bayes.files.atomic import Format, check_suffix, first_duplicate, same_file
from tactile_bayes.report.pages import PageFiles

NAMES: dict[str, Callable[[Path, Path], object]] = {
    "a symbolic link": lambda name, file: name.symlink_to(file),
    "a hard link": lambda name, file: name.hardlink_to(file),
}


@pytest.mark.parametrize("kind", NAMES)
def test_a_link_is_the_file_that_it_leads_to(kind: str, tmp_path: Path) -> None:
    file, name, other = tmp_path / "file", tmp_path / "name", tmp_path / "other"
    file.write_text("1")
    other.write_text("1")
    NAMES[kind](name, file)
    assert same_file(file, name)
    assert not same_file(file, other)
    assert first_duplicate([file, other, name]) == name
    assert first_duplicate([file, other]) is None


def test_a_file_that_does_not_exist_is_known_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dangling").symlink_to("new")
    assert same_file(Path("new"), tmp_path / "new")
    assert same_file(Path("new"), Path("dangling"))
    assert not same_file(Path("new"), Path("newer"))
    assert not same_file(Path("x" * 300), Path("y" * 300))


@pytest.mark.parametrize("kind", NAMES)
def test_two_outputs_of_one_file_are_refused_in_every_command(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactile_bayes.report.pages.find_printer", lambda: str.encode)
    (tmp_path / "one").write_text("old")
    NAMES[kind](tmp_path / "two", tmp_path / "one")
    with pytest.raises(UsageError, match="records and dictionary"):
        Outputs(tmp_path / "one", tmp_path / "two", to="csv", force=True).check(files=True)
    with pytest.raises(UsageError, match="page and PDF at once"):
        PageFiles(tmp_path / "one", tmp_path / "two", force=True)


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("map.nc", "netCDF"),
        ("map.h5", "netCDF"),  # which it is, too
        ("map", "netCDF"),
        ("map.2026-11-24", "netCDF"),
        ("map.old", "netCDF"),
        ("plan.txt", "JSON"),
        ("page.HTM", "HTML"),
    ],
)
def test_a_fitting_an_unknown_and_no_suffix_are_taken(name: str, written: Format) -> None:
    check_suffix(Path(name), written)


WRITERS = {
    "map": (("map", "s.mcap", "-o", "y.csv"), "netCDF", "y.nc"),
    "estimate": (("estimate", "m.nc", "-o", "y.JSON"), "netCDF", "y.nc"),
    "import a map": (("import", "g.csv", "-o", "y.mcap", "--as", "map"), "netCDF", "y.nc"),
    "import a scan": (("import", "s.npz", "-o", "y.png"), "MCAP", "y.mcap"),
    "simulate": (("simulate", "s.toml", "-o", "y.nc"), "MCAP", "y.mcap"),
    "record": (("record", "--head", "/dev/nothing", "-o", "y.csv"), "MCAP", "y.mcap"),
    "replay": (("replay", "s.mcap", "-o", "y.csv"), "MCAP", "y.mcap"),
    "repair": (("repair", "s.mcap", "-o", "y.nc"), "MCAP", "y.mcap"),
    "plan": (("plan", "-o", "y.csv"), "JSON", "y.json"),
    "validate": (("validate", "t.csv", "--excision", "e.csv", "-o", "y.html"), "JSON", "y.json"),
    "validate a page": (("validate", "t.csv", "--excision", "e.csv", "--html", "y.pdf"), "HTML", "y.html"),
    "calibrate size": (("calibrate", "size", "t.csv", "-o", "y.csv"), "JSON", "y.json"),
    "calibrate array": (("calibrate", "array", "--step", "0", "s.mcap", "-o", "y.csv"), "JSON", "y.json"),
    "calibrate repeatability": (("calibrate", "repeatability", "t.csv", "-o", "y.csv"), "JSON", "y.json"),
    "campaign init": (("campaign", "init", ".", "-o", "y.xlsx"), "CSV", "y.csv"),
    "study": (("study", "-o", "y.xlsx"), "CSV", "y.csv"),
    "population": (("population", "-o", "y.json"), "CSV", "y.csv"),
    "sbc": (("sbc", "-o", "y.json"), "CSV", "y.csv"),
    "report": (("report", "exam.json", "-o", "y.pdf"), "HTML", "y.html"),
    "report a PDF": (("report", "exam.json", "-o", "p.html", "--pdf", "y.html"), "PDF", "y.pdf"),
    "export": (("export", "exam.json", "--to", "csv", "-o", "y.json"), "CSV", "y.csv"),
    "export a dictionary": (("export", "--to", "csv", "--dictionary", "y.json"), "CSV", "y.csv"),
}


@pytest.mark.parametrize("case", WRITERS)
def test_a_name_that_promises_another_format_is_refused_before_any_work(case: str, tmp_path: Path) -> None:
    """`map -o y.csv` wrote netCDF under that name without a word."""
    words, written, fitting = WRITERS[case]
    (tmp_path / "exam.json").write_text(json.dumps(estimate_document()))
    done = run_here(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert f"and {written} is written; name it {fitting}" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["exam.json"]


def test_python_refuses_the_suffix_of_another_format(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"has the suffix '\.csv', and netCDF is written; name it map\.nc"):
        tb.demo_map().save(tmp_path / "map.csv")
    assert list(tmp_path.iterdir()) == []
