"""Names of the size calibrations that come with the program."""

from __future__ import annotations

from pathlib import Path

import pytest
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.errors import UsageError
from tactile_bayes.files.size_json import SHIPPED, size_calibration_path


@pytest.mark.parametrize("name", SHIPPED)
def test_each_name_is_a_file_of_the_program(name: str) -> None:
    path = size_calibration_path(name)
    assert path is not None
    assert path.is_file()


def test_a_name_that_was_typed_wrong_is_answered_with_the_names() -> None:
    with pytest.raises(UsageError, match=r"'sold'; give solid, eq6, solid-mean, plane-strain or a file"):
        size_calibration_path("sold")


def test_a_file_may_lack_a_suffix_and_a_missing_one_is_told_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "site").write_text("{}")
    for name in ("site", "site.json", "folder/site"):
        assert size_calibration_path(name) == Path(name)


def test_the_command_line_tells_it_in_one_line(tmp_path: Path) -> None:
    tb.demo_map().save(tmp_path / "map.nc")
    done = run_here("estimate", "map.nc", "--size-calibration", "sold", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "give solid, eq6, solid-mean, plane-strain or a file" in done.stderr
