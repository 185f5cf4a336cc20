"""A reader given a file of another kind says which kind it is and what to run; a mistyped command is guessed at."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from tactile_bayes.cli import cli
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.reading import kind_of
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.size_json import read_size_calibration


def _npz(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, values=np.ones((3, 3)))


WRONG: dict[str, tuple[Callable[[Path], object], Callable[[Path], object], str]] = {
    "a scan as a map": (
        lambda path: path.write_bytes(b"\x89MCAP0\r\n" + b"\0" * 20),
        read_map,
        "is a scan, not a map or posterior (netCDF); build its map first: `tactile-bayes map",
    ),
    "arrays as a scan": (_npz, read_scan, "is an archive (.npz or a spreadsheet), not a scan; bring it in first"),
    "a map as a scan": (
        lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 20),
        read_scan,
        "give the scan that the map was built from",
    ),
    "an image as a map": (lambda path: path.write_bytes(b"\x89PNG\r\n"), read_map, "import"),
    "an estimate as a map": (
        lambda path: path.write_text(json.dumps({"schema": "tactile-bayes/estimate/1"})),
        read_map,
        "is an estimate (JSON), not a map",
    ),
    "an estimate as a calibration": (
        lambda path: path.write_text(json.dumps({"schema": "tactile-bayes/estimate/1", "status": "estimate"})),
        read_size_calibration,
        "is an estimate (JSON), not a size calibration (JSON)",
    ),
    "a pooled estimate as an estimate": (
        lambda path: path.write_text(json.dumps({"schema": "tactile-bayes/pooled/1"})),
        partial(read_record, kind=EstimateReport, way_out=""),
        "is a pooled estimate (JSON), not an estimate (JSON); give the maps that were pooled",
    ),
    "a map as a calibration": (
        lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n"),
        read_size_calibration,
        "is a map or posterior (netCDF), not a JSON file",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_file_of_another_kind_is_named(case: str, tmp_path: Path) -> None:
    make, read, message = WRONG[case]
    path = tmp_path / "exam.bin"
    make(path)
    with pytest.raises(BadDataError) as caught:
        read(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_damaged_file_of_the_right_kind_is_not_called_another(tmp_path: Path) -> None:
    path = tmp_path / "map.nc"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 20)
    with pytest.raises(BadDataError, match="not a readable netCDF file"):
        read_map(path)


def test_a_file_that_cannot_be_opened_or_recognised_has_no_kind(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("palpation notes")
    assert kind_of(tmp_path / "notes.txt") == ""
    assert kind_of(tmp_path / "absent") == ""


def test_a_mistyped_command_is_guessed_at_and_a_strange_one_is_not() -> None:
    assert "did you mean estimate?" in CliRunner().invoke(cli, ["estimat"]).output
    strange = CliRunner().invoke(cli, ["xyzzy"])
    assert strange.exit_code == 2
    assert "did you mean" not in strange.output
