"""A recording that is written again with another session is one exam wherever maps are taken for independent ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_files import rows_of, thinned, write, write_table
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.campaigns import run as campaigns
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.map_nc import read_map_and_scans, write_map
from tactile_bayes.files.provenance import Provenance, recordings
from tactile_bayes.scans import PressureFrames

FAST = ("--method", "laplace")
TOLD = "a map of the same scan as {} is no repeat: the interval is too narrow."


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of two recordings: the first twice, in files with other sessions; the second once."""
    place = tmp_path_factory.mktemp("recordings")
    for name, start, examiner in (("a", 0, "E1"), ("again", 0, "E2"), ("b", 1, "E2")):
        write(place / f"{name}.mcap", thinned(start, 4, subject="07", side="right", examiner=examiner))
        done = run_here("map", f"{name}.mcap", "-o", f"{name}.nc", cwd=place)
        assert done.returncode == 0, done.stderr
    return place


def facts(path: Path) -> dict[str, str]:
    (found,) = read_map_and_scans(path)[1]
    return found


def test_the_frames_digest_is_of_the_readings_alone() -> None:
    scan = thinned(0, 4)
    frames = scan.frames
    later = PressureFrames(frames.time_s + 3.0, frames.counts)
    assert replace(scan, session={"visit": "2"}).frames.sha256 == later.sha256 == frames.sha256
    counts = frames.counts.copy()
    counts[5, 3, 2] ^= 1
    assert PressureFrames(frames.time_s, counts).sha256 != frames.sha256
    turned = PressureFrames(frames.time_s, np.swapaxes(frames.counts, 1, 2))
    assert turned.sha256 != frames.sha256


def told_of(pooled: dict[str, Any]) -> list[tuple[str, str]]:
    return [(one["about"], one["text"]) for one in pooled["findings"] if one["kind"] == "same_scan"]


@pytest.mark.long
def test_a_map_keeps_the_digests_of_file_and_frames(folder: Path) -> None:
    first, again, other = (facts(folder / f"{name}.nc") for name in ("a", "again", "b"))
    assert first["sha256"] != again["sha256"]
    assert first["frames_sha256"] == again["frames_sha256"] == thinned(0, 4).frames.sha256
    assert first["frames_sha256"] != other["frames_sha256"]


@pytest.mark.long
def test_compare_refuses_it_and_pooling_and_the_page_caution(folder: Path, tmp_path: Path) -> None:
    done = run_here("compare", "a.nc", "--with", "again.nc", *FAST, cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "again.nc and a.nc are of one scan; give one map of each scan" in done.stderr
    assert run_here("compare", "a.nc", "--with", "b.nc", *FAST, cwd=folder).returncode == 0
    pooled = run_here("estimate", "--pool", "a.nc", "b.nc", "again.nc", *FAST, cwd=folder)
    assert f"CAUTION: map 3: {TOLD.format('map 1')}" in pooled.stdout
    assert pooled.stdout.count("no repeat") == 1
    run_here("report", "a.nc", "again.nc", "-o", tmp_path / "page.html", cwd=folder)
    assert f"CAUTION: map 2: {TOLD.format('map 1')}" in (tmp_path / "page.html").read_text()


@pytest.mark.long
def test_python_knows_it_also_of_scans_that_are_in_no_file() -> None:
    first = tb.build_map(thinned(0, 4, side="right", examiner="E1"))
    again = tb.build_map(thinned(0, 4, side="right", examiner="E2"), cell_mm=1.2)
    assert first.scans[0]["side"] == "right"
    assert "sha256" not in first.scans[0]
    document = tb.pool([first, again], method="laplace").document
    assert told_of(document) == [("map 2", TOLD.format("map 1").rstrip("."))]
    with pytest.raises(UsageError, match="are of one scan"):
        tb.compare(first, again, method="laplace")


@pytest.mark.long
def test_maps_of_earlier_versions_are_told_apart_by_their_files(folder: Path, tmp_path: Path) -> None:
    for name in ("a", "again"):
        made, _ = read_map_and_scans(folder / f"{name}.nc")
        scans = [{"sha256": facts(folder / f"{name}.nc")["sha256"]}]
        write_map(tmp_path / f"{name}.nc", made, provenance=Provenance("test", {}, scans=scans))
    shutil.copy(folder / "a.nc", tmp_path / "new.nc")
    pooled = run_here("estimate", "--pool", "a.nc", "again.nc", "new.nc", *FAST, "--json", cwd=tmp_path)
    told = told_of(json.loads(pooled.stdout))
    assert told == [("map 3", TOLD.format("map 1").rstrip("."))]  # "again" cannot be known, "new" has a file in common


def test_exams_of_a_recording_share_it_and_others_do_not() -> None:
    one: dict[str, Any] = {"sha256": "f", "frames_sha256": "g", "side": "right"}
    assert set(recordings([one])) & set(recordings([{"frames_sha256": "g"}]))
    assert not set(recordings([one])) & set(recordings([{"sha256": "g", "frames_sha256": "f", "side": "right"}]))
    assert list(recordings([{"side": "right"}])) == []


@pytest.mark.long
@pytest.mark.parametrize("block", [1, 64])
def test_a_campaign_takes_neither_exam_of_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    """Whichever block the second comes in: exams of other patients are in other blocks."""
    monkeypatch.setattr(campaigns, "_BLOCK", block)
    write(tmp_path / "a.mcap", thinned(0, 4, subject="07", side="right"))
    write(tmp_path / "b.mcap", thinned(1, 4, subject="07", side="right"))
    write(tmp_path / "again.mcap", thinned(0, 4, subject="09", side="right"))
    rows = [("a.mcap", "07", 1, "right"), ("b.mcap", "07", 2, "right"), ("again.mcap", "09", 1, "right")]
    write_table(tmp_path / "exams.csv", rows)
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=tmp_path)
    assert "3 exams: 1 sized, 0 without a size, 2 failed" in done.stdout
    told = {row["patient"]: row for row in rows_of(tmp_path / "out" / "failures.csv")}
    assert told["07"]["reason"].startswith(
        "holds the same recording as 09.v1.m1.r1 (again.mcap); give each exam its own"
    )
    assert told["09"]["reason"].startswith("holds the same recording as 07.v1.m1.r1 (a.mcap)")
    pooled = json.loads((tmp_path / "out" / "masses" / "07.v1.m1" / "pooled.json").read_text())
    assert [one["map"] for one in pooled["maps"]] == ["07.v1.m1.r2"]
    planned = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, "--dry-run", cwd=tmp_path)
    assert "map: 0 to do, 3 done" in planned.stdout
    assert "estimate: 0 to do" in planned.stdout
    assert "pool: 0 to do, 1 done" in planned.stdout
