"""Campaigns that are killed, a trial with accidents, and maps written beside a profiler: minutes each (`make slow`)."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("psutil")

import campaign_kills
import campaign_overhead
import campaign_trial
import netcdf_layout

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("what", ["local", "repeats"])
def test_a_campaign_that_is_killed_again_and_again_ends_in_the_same_bytes(what: str, tmp_path: Path) -> None:
    tally = campaign_kills.main(tmp_path, what=what, kills=6, seed=114, port=0)
    assert tally.kills == 6
    assert tally.sound, tally


def test_a_trial_with_accidents_goes_from_its_scans_to_the_report(tmp_path: Path) -> None:
    campaign_trial.make(tmp_path)
    campaign_trial.check(tmp_path)


def test_what_a_scheduler_spends_on_a_task_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    campaign_overhead.tasks(1000)
    assert "scheduler: " in capsys.readouterr().out


def test_a_map_has_the_same_bytes_however_long_its_frames_are_held() -> None:
    assert len(netcdf_layout.layouts(100, threads=1)) == 1
