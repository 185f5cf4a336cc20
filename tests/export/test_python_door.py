"""`tb.export`: the files that `tactile-bayes export` writes, from paths and from what Python holds."""

from __future__ import annotations

import csv
import errno
import os
import shutil
from pathlib import Path

import pytest
from export_files import WHEN, exported

import tactile_bayes as tb
from tactile_bayes.errors import UsageError

DATED = {"study_date": WHEN}


@pytest.fixture
def folder(exam: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An exam's files, where Python runs."""
    for name in ("map.nc", "map.json", "map_post.nc", "empty.nc", "size.json"):
        shutil.copy(exam / name, tmp_path)
    (tmp_path / "old.csv").write_text("mine")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_door_stays_a_function_when_the_package_of_the_formats_is_loaded() -> None:
    import tactile_bayes.exports.run

    assert callable(tb.export)
    assert tactile_bayes.exports.run.IDENTITY_FIELDS


@pytest.mark.long
def test_paths_and_objects_give_the_bytes_of_the_command_line(folder: Path) -> None:
    pytest.importorskip("highdicom")
    exported(folder, "map.nc", "map.json", "--to", "dicom", "--study-date", WHEN, "-o", "by_cli")
    wanted = files(folder / "by_cli")
    assert len(wanted) == 3
    done = tb.export([folder / "map.nc", folder / "map.json"], folder / "by_path", to="dicom", **DATED)
    assert files(folder / "by_path") == wanted
    assert [path.name for path in done.paths] == list(wanted)
    assert "the patient ID is empty" in done.notes[0]
    found = tb.estimate("map.nc", size_calibration="size.json", method="laplace")
    tb.export(found, folder / "by_object", to="dicom", **DATED)
    assert files(folder / "by_object") == wanted
    tb.export([tb.read_map(folder / "map.nc"), found], folder / "both", to="dicom", **DATED)
    assert files(folder / "both") == wanted


def test_a_posterior_is_exported_as_its_estimate_is(folder: Path) -> None:
    """Place, probability and outcome are in the file besides the draws; an earlier one has sizes alone."""
    for name in ("map_post.nc", "map.json"):
        tb.export(name, f"{name}.csv", to="csv", patient_id="P1")
    lines = [(folder / f"{name}.csv").read_text().splitlines() for name in ("map_post.nc", "map.json")]
    rows = [next(csv.DictReader(one)) for one in lines]
    differ = {name for name, value in rows[0].items() if rows[1][name] != value}
    assert differ == {"tb_estimate_sha256"}


def test_csv_of_a_map_that_is_in_no_file(tmp_path: Path) -> None:
    found = tb.estimate(tb.demo_map(), method="laplace")
    done = tb.export(found, tmp_path / "records.csv", to="csv", patient_id="P1")
    assert done.paths == (tmp_path / "records.csv",)
    assert (tmp_path / "records.csv").read_text().splitlines()[1].startswith("P1")
    with pytest.raises(UsageError, match="exists"):
        tb.export(found, tmp_path / "records.csv", to="csv", patient_id="P1")


@pytest.mark.long
def test_a_map_in_memory_and_its_estimate_go_together_and_another_is_refused(folder: Path) -> None:
    pytest.importorskip("highdicom")
    made = tb.build_map(tb.demo_scan())
    found = tb.estimate(made, method="laplace")
    tb.export([made, found], folder / "a", to="dicom", **DATED)
    tb.export(found, folder / "b", to="dicom", **DATED)
    assert files(folder / "a") == files(folder / "b")
    with pytest.raises(UsageError, match="is not an estimate of"):
        tb.export([folder / "empty.nc", found], folder / "c", to="dicom", **DATED)


def test_an_impossible_export_is_refused(folder: Path) -> None:
    with pytest.raises(UsageError, match="give one of dicom, fhir, nrrd, csv"):
        tb.export(folder / "map.json", folder / "x", to="pdf")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="no keyword 'patient'"):
        tb.export(folder / "map.json", folder / "x", to="csv", patient="P1")
    with pytest.raises(UsageError, match="has no place in csv"):
        tb.export(folder / "map.json", folder / "x", to="csv", patient_name="Doe")
    with pytest.raises(UsageError, match="int is nothing to export"):
        tb.export([3], folder / "x", to="csv")
    with pytest.raises(UsageError, match="no file was given to export"):
        tb.export([], folder / "x", to="csv")
    assert not (folder / "x").exists()


def test_the_dictionary_is_the_command_lines_alone_and_with_records(folder: Path) -> None:
    exported(folder, "--to", "csv", "--dictionary", "dict.csv")
    wanted = (folder / "dict.csv").read_bytes()
    for given in ({}, {"files": None}):
        done = tb.export(**given, to="csv", dictionary=folder / "alone.csv", force=True)
        assert (done.paths, done.notes) == ((folder / "alone.csv",), ())
        assert (folder / "alone.csv").read_bytes() == wanted
    done = tb.export("map.json", "records.csv", to="csv", dictionary="both.csv", patient_id="P1")
    assert [path.name for path in done.paths] == ["records.csv", "both.csv"]
    assert (folder / "both.csv").read_bytes() == wanted
    assert (folder / "records.csv").read_text().splitlines()[1].startswith("P1")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"to": "csv"}, "no file was given to export"),
        ({"files": "map.json", "to": "csv"}, "nowhere to write to"),
        (
            {"files": "map.json", "path": "r.csv", "to": "fhir", "dictionary": "d.csv"},
            "give it with to=.csv.",
        ),
        ({"files": "map.json", "path": "r.csv", "to": "csv", "dictionary": "./r.csv"}, "records and dictionary"),
        ({"path": "r.csv", "to": "csv", "dictionary": "d.csv"}, "no file was given to export to r.csv"),
        ({"files": "map.json", "path": "r.csv", "to": "csv", "dictionary": "old.csv"}, "old.csv exists"),
    ],
)
def test_a_dictionary_that_does_not_fit_is_refused_before_anything_is_written(
    folder: Path, given: dict[str, str], told: str
) -> None:
    before = files(folder)
    with pytest.raises(UsageError, match=told):
        tb.export(**given)
    assert files(folder) == before


@pytest.mark.long
def test_a_folder_of_files_is_written_whole_or_not_at_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("highdicom")
    write = Path.write_bytes

    def refusing(path: Path, data: bytes) -> int:
        if "report" in path.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    before = files(folder)
    monkeypatch.setattr(Path, "write_bytes", refusing)
    with pytest.raises(UsageError, match=r"No space left on device.*make room"):
        tb.export(["map.nc", "map.json"], "exam", to="dicom", **DATED)
    assert files(folder) == before
    monkeypatch.setattr(Path, "write_bytes", write)
    assert len(tb.export(["map.nc", "map.json"], "exam", to="dicom", **DATED).paths) == 3
