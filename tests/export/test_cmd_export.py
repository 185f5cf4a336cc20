"""`export` as a user runs it: what fits what, one line where it does not, and files of their owner alone."""

from __future__ import annotations

import json
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any, get_args

import pytest
from export_files import WHEN, WHO, exported
from in_process import run_here

Run = Callable[..., "CompletedProcess[str]"]
DATED = ("--study-date", WHEN)

REFUSED = {
    "a map to fhir": (("map.nc", "--to", "fhir"), "give what `tactile-bayes estimate map.nc --json` prints"),
    "a map to csv": (("map.nc", "--to", "csv"), "csv files hold sizes, and map.nc is a map"),
    "a map too many": (("map.nc", "map.json", "--to", "fhir"), "leave out map.nc"),
    "an estimate to nrrd": (("map.json", "--to", "nrrd"), "map.json is none"),
    "two maps to nrrd": (("map.nc", "empty.nc", "--to", "nrrd"), "holds one map"),
    "no landmarks": (("bare.nc", "--to", "nrrd"), "has no landmarks"),
    "an estimate alone": (("map.json", "--to", "dicom", *DATED), "export MAP.nc map.json --to dicom"),
    "a wrong pair": (("map.nc", "empty.json", "--to", "dicom", *DATED), "is not an estimate of map.nc"),
    "maps without an estimate": (("map.nc", "empty.nc", "--to", "dicom", *DATED), "several exams"),
    "two estimates": (("map.json", "empty.json", "--to", "fhir"), "csv takes several"),
    "a copy": (("map.json", "copy.json", "--to", "csv"), "copy.json holds what map.json holds; give each once"),
    "twice": (("map.json", "map.json", "--to", "csv"), "map.json is given twice; give each once"),
    "its draws too": (("map.json", "map_post.nc", "--to", "csv"), "map.json and map_post.nc are estimates of one exam"),
    "no date": (("map.nc", "--to", "dicom"), "--study-date YYYY-MM-DDTHH:MM"),
    "no time": (("map.nc", "--to", "dicom", "--study-date", "2026-11-24"), "--study-date 2026-11-24THH:MM"),
    "a name in a csv": (("map.json", "--to", "csv", "--patient-name", "Doe"), "--patient-name has no place in csv"),
    "an id in nrrd": (("map.nc", "--to", "nrrd", "--patient-id", "1"), "nothing of a patient or study"),
    "a subject in nrrd": (("map.nc", "--to", "nrrd", "--patient-id-from-scan"), "no patient"),
    "no subject": (("phantom.json", "--to", "fhir", "--patient-id-from-scan"), "--patient-id instead"),
    "another kind": (("size.json", "--to", "csv"), "is a size calibration (JSON)"),
    "an odd schema": (("odd.json", "--to", "csv"), "is no estimate"),
    "an empty file": (("nothing.json", "--to", "csv"), "is empty"),
    "a folder": ((".", "--to", "csv"), "is a directory"),
    "no kind at all": (("notes.txt", "--to", "csv"), "is none of these"),
    "no file": (("--to", "fhir"), "no file was given"),
    "a dictionary elsewhere": (("map.json", "--to", "fhir", "--dictionary", "d.csv"), "with --to csv"),
    "a record id": (("map.json", "--to", "csv", "--patient-id", "a b"), "none that REDCap takes"),
}


@pytest.fixture(scope="module")
def folder(exam: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("cmd") / "exam"
    shutil.copytree(exam, place)
    shutil.copy(place / "map.json", place / "copy.json")
    (place / "notes.txt").write_text("hello\n")
    (place / "odd.json").write_text('{"schema": ["tactile-bayes/estimate/1"]}')
    (place / "nothing.json").write_text("")
    return place


@pytest.mark.long
@pytest.mark.parametrize("case", REFUSED)
def test_an_export_that_does_not_fit_is_one_line(case: str, folder: Path, tmp_path: Path) -> None:
    for package in ("highdicom", "nrrd", "fhir.resources"):
        pytest.importorskip(package)
    words, told = REFUSED[case]
    done = run_here("export", *words, "-o", tmp_path / "out", cwd=folder)
    assert done.returncode in (2, 3)
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@pytest.mark.parametrize("key", ["settings", "inputs", "scans", "version"])
@pytest.mark.parametrize("value", [None, 7, [1], {"a": {"b": 1}}, "\x01\u202e\\<b>" * 400])
def test_an_odd_provenance_is_no_fault_or_one_line(key: str, value: Any, estimate: Any, tmp_path: Path) -> None:
    """Scans and version have no schema: anything may stand there but control characters. Settings are an object, inputs
    name files."""
    odd = estimate | {"provenance": estimate["provenance"] | {key: value}}
    (tmp_path / "e.json").write_text(json.dumps(odd))
    taken = (key in ("scans", "version") and not isinstance(value, str)) or (
        key == "settings" and isinstance(value, dict)
    )
    for to in ("csv", "fhir"):
        if to == "fhir":
            pytest.importorskip("fhir.resources")
        done = run_here("export", "e.json", "--to", to, "-o", tmp_path / f"out.{to}", cwd=tmp_path)
        if not taken:
            assert (done.returncode, done.stderr.count("\n")) == (3, 1)
            assert f"provenance.{key}" in done.stderr
            continue
        assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.parametrize("value", [None, 7, [1], {"a": {"b": 1}}, "\x01\u202e\\<b>" * 400])
def test_findings_that_are_none_are_refused_and_not_dropped(value: Any, estimate: Any, tmp_path: Path) -> None:
    odd = estimate | {"findings": value}
    (tmp_path / "e.json").write_text(json.dumps(odd))
    done = run_here("export", "e.json", "--to", "csv", "-o", "out.csv", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "findings" in done.stderr


@pytest.mark.long
def test_an_estimate_of_no_file_is_refused_beside_a_map(estimate: dict[str, Any], folder: Path, tmp_path: Path) -> None:
    document = estimate | {"provenance": estimate["provenance"] | {"inputs": []}}
    (tmp_path / "e.json").write_text(json.dumps(document))
    words = (folder / "map.nc", "e.json", "--to", "dicom", *DATED, "-o", "out")
    done = run_here("export", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert "does not say which map it is of" in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("to", "package", "extra", "words"),
    [
        ("dicom", "highdicom", "dicom", ("map.nc", *DATED)),
        ("fhir", "fhir.resources", "fhir", ("map.json",)),
        ("nrrd", "nrrd", "slicer", ("map.nc",)),
    ],
)
def test_a_missing_extra_is_named_with_its_command(
    to: str, package: str, extra: str, words: tuple[str, ...], folder: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    done = run_here("export", *words, "--to", to, "-o", tmp_path / "out", cwd=folder)
    assert (done.returncode, done.stderr) == (
        2,
        f"error: this needs the package {package}; install it with pip install 'tactile-bayes[{extra}]'\n",
    )


def test_every_format_says_which_parts_of_an_identity_it_holds() -> None:
    from tactile_bayes.declarations import names_of
    from tactile_bayes.exports import run
    from tactile_bayes.options import IdentityOptions
    from tactile_bayes.presets import ExportFormat

    assert tuple(run.IDENTITY_FIELDS) == get_args(ExportFormat)
    assert names_of(IdentityOptions) == run.IDENTITY_FIELDS["dicom"]


def test_the_guide_lists_the_codes_of_the_own_scheme() -> None:
    from tactile_bayes.exports import exam as codes
    from tests.conftest import ROOT

    own = [one for one in vars(codes).values() if isinstance(one, codes.Code) and one.scheme == codes.OWN_SCHEME]
    guide = (ROOT / "docs" / "guides" / "export.md").read_text(encoding="utf-8")
    assert len(own) >= 11
    assert [f"| `{one.value}` | {one.meaning} |" in guide for one in own] == [True] * len(own)


@pytest.mark.long
def test_a_csv_needs_no_extra(run_python: Run, folder: Path, tmp_path: Path) -> None:
    code = (
        "import sys\nfrom tactile_bayes.cli import cli\n"
        "cli.main(sys.argv[1:], standalone_mode=False)\nprint(*sys.modules)"
    )
    done = run_python("-c", code, "export", "map.json", "--to", "csv", "-o", tmp_path / "a.csv", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert not {"pydicom", "highdicom", "nrrd", "matplotlib", "scipy.stats"} & set(done.stdout.split())


@pytest.mark.long
def test_files_are_their_owners_and_not_overwritten(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("highdicom")
    words = ("map.nc", "map.json", "--to", "dicom", *WHO, "-o", tmp_path / "out")
    exported(folder, *words)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "out").iterdir()} == {0o600}
    again = run_here("export", *words, cwd=folder)
    assert again.returncode == 2
    assert "exists; choose another name or give --force" in again.stderr
    exported(folder, *words, "--force")


def test_a_name_without_its_parts_a_time_without_its_zone_and_a_folder_called_dcm_are_told(
    folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("fhir.resources")
    words = ("map.json", "--to", "fhir", "--patient-name", "Jane Doe", "--study-date", "2026-11-24T10:30")
    noted = run_here("export", *words, "-o", tmp_path / "f.json", cwd=folder).stderr
    assert "'Jane Doe' is written as a family name; give FAMILY^GIVEN where it is not" in noted
    assert "FHIR takes a time of day only with its zone" in noted
    whole = (*words[:-3], "Doe^Jane", "--study-date", "2026-11-24T10:30+01:00", "-o", tmp_path / "g.json")
    assert run_here("export", *whole, cwd=folder).stderr.count("note:") == noted.count("note:") - 2
    refused = run_here("export", "map.nc", "--to", "dicom", *DATED, "-o", tmp_path / "out.dcm", cwd=folder)
    assert "out.dcm is to be a folder of several files; leave out the ending .dcm" in refused.stderr


@pytest.mark.long
def test_a_folder_with_another_exports_report_is_refused(folder: Path, tmp_path: Path) -> None:
    """Without its report the second exam must not lie beside the first one's."""
    pytest.importorskip("highdicom")
    out = tmp_path / "out"
    exported(folder, "map.nc", "map.json", "--to", "dicom", *DATED, "-o", out)
    done = run_here("export", "map.nc", "--to", "dicom", *DATED, "-o", out, "--force", cwd=folder)
    assert done.returncode == 2
    assert "holds report.dcm of another export" in done.stderr


@pytest.mark.long
def test_a_fresh_python_reads_each_back_without_this_program(run_python: Run, folder: Path, tmp_path: Path) -> None:
    for package in ("highdicom", "nrrd", "fhir.resources"):
        pytest.importorskip(package)
    exported(folder, "map.nc", "map.json", "--to", "dicom", *WHO, "-o", tmp_path / "d")
    exported(folder, "map.json", "--to", "fhir", "-o", tmp_path / "f.json")
    exported(folder, "map.nc", "--to", "nrrd", "-o", tmp_path / "n.nrrd")
    exported(folder, "map.json", "--to", "csv", "-o", tmp_path / "c.csv")
    code = """
import csv, json, sys, pydicom, nrrd
report = pydicom.dcmread("d/report.dcm")
def numbers(item):
    for one in item.get("ContentSequence", ()):
        if one.ValueType == "NUM" and one.ConceptNameCodeSequence[0].CodeMeaning == "Long axis":
            yield float(one.MeasuredValueSequence[0].NumericValue)
        yield from numbers(one)
bundle = json.load(open("f.json"))
observed = next(e["resource"] for e in bundle["entry"] if e["resource"]["resourceType"] == "Observation")
row = next(csv.DictReader(open("c.csv")))
values, _ = nrrd.read("n.nrrd")
pixels = pydicom.dcmread("d/map.dcm").pixel_array
assert sorted(values[values == values]) == sorted(pixels[pixels == pixels])
assert not [name for name in sys.modules if name.startswith("tactile_bayes")]
print(*numbers(report), observed["valueQuantity"]["value"], row["tb_max_mm"])
"""
    done = run_python("-W", "ignore", "-c", code, cwd=tmp_path, env={"PYTHONPATH": ""})
    assert done.returncode == 0, done.stderr
    wanted = json.loads((folder / "map.json").read_text())["another_exam"]["max_size_mm"]["median"]
    assert [float(word) for word in done.stdout.split()] == [wanted] * 3
