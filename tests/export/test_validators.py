"""Other people's validators find no error in the DICOM files: dicom3tools' dciodvfy and dcmtk's tools.

They are programs of the system (Debian: dicom3tools, dcmtk); without them these tests are skipped.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from export_files import WHEN, WHO, exported

pytest.importorskip("highdicom")
pydicom = pytest.importorskip("pydicom")

EXAMS = {
    "with a lump": ("map.nc", "map.json", *WHO),
    "of nobody": ("map.nc", "map.json", "--study-date", WHEN),
    "without a lump": ("empty.nc", "empty.json", "--study-date", WHEN),
    "a phantom": ("phantom.nc", "phantom.json", "--study-date", WHEN),
    "no landmarks": ("bare.nc", "--study-date", f"{WHEN}+01:00"),
    "draws": ("map.nc", "map_post.nc", "--patient-name", "Мария^<b>", "--study-date", WHEN),
}


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def said(*words: object) -> str:
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False, errors="replace")
    return done.stdout + done.stderr


@pytest.fixture(scope="module", params=EXAMS)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not any(map(shutil.which, ("dciodvfy", "dcmftest"))):
        pytest.skip("no validator is installed")
    exam = request.getfixturevalue("exam")
    out = tmp_path_factory.mktemp("dicom") / "out"
    exported(exam, *EXAMS[request.param], "--to", "dicom", "-o", out)
    return out


@pytest.fixture
def written(made: Path, tmp_path: Path) -> list[Path]:
    """Files of an export, to be changed."""
    return sorted(shutil.copytree(made, tmp_path / "out").iterdir())


@pytest.mark.long_repeats
def test_dciodvfy_reports_no_error(written: list[Path]) -> None:
    for path in written:
        lines = said(tool("dciodvfy"), path).splitlines()
        assert any(name in lines for name in ("ParametricMap", "SCImage", "Comprehensive3DSR")), lines
        assert [line for line in lines if line.startswith(("Error", "Abort"))] == []


@pytest.mark.long_repeats
def test_dciodvfy_reports_a_missing_attribute(written: list[Path]) -> None:
    """The negative control: a type 1 attribute is taken away."""
    dataset = pydicom.dcmread(written[-1])
    del dataset.SeriesInstanceUID
    dataset.save_as(written[-1])
    assert "Error" in said(tool("dciodvfy"), written[-1])


@pytest.mark.long_repeats
def test_dcmtk_reads_them(written: list[Path]) -> None:
    for path in written:
        assert said(tool("dcmftest"), path).startswith("yes:")
        dumped = subprocess.run([tool("dcmdump"), "-q", path], capture_output=True, check=False)
        assert (dumped.returncode, dumped.stderr) == (0, b"")
    reports = [path for path in written if path.stem == "report"]
    for path in reports:
        dumped = subprocess.run([tool("dsrdump"), "-q", path], capture_output=True, check=False)
        assert (dumped.returncode, dumped.stderr) == (0, b"")
        assert b"Imaging Measurement Report" in dumped.stdout
