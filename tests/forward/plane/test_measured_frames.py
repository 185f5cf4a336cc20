"""Fig 6a with a user's own frames: a model's frame read back, one with a known error, and faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

from tactile_bayes.actions.study import read_measured_frames
from tactile_bayes.errors import BadDataError
from tactile_bayes.presets import HEAD_PITCH_MM
from tactile_bayes.studies.model_comparison import MeasuredFrame, compare_frames
from tactile_bayes.studies.paper import StudySettings

COARSE = StudySettings(fineness=1)
LUMP = {"d_mm": 12.5, "depth_ratio": 0.825, "seat": 0.0}


@pytest.fixture(scope="module")
def own() -> list[MeasuredFrame]:
    """The elastic model's own frames at two places, as taxels see them."""
    surface = COARSE.surface(COARSE.body(12.5, 0.825, seat=0.0))
    frames = COARSE.frames(surface, 100.0).as_taxels(HEAD_PITCH_MM)
    return [MeasuredFrame(x, frames.s_mm, frames.at(x)) for x in (0.0, 6.0)]


def test_a_models_own_frame_has_no_difference_and_a_known_error_is_found(own: list[MeasuredFrame]) -> None:
    found = compare_frames(own, settings=COARSE, **LUMP)
    assert max(one.differences[0] for one in found) < 1e-12
    assert min(one.differences[1] for one in found) > 0.01
    wrong = np.where(np.arange(16) % 2, 1.1, 0.9)  # a tenth up and down by turns, the mean being kept
    spoiled = [MeasuredFrame(one.x_c_mm, one.s_mm, one.pressure_kpa * wrong) for one in own]
    (centred, _) = compare_frames(spoiled, settings=COARSE, **LUMP)
    assert centred.differences[0] == pytest.approx(0.01, rel=0.01)


def test_another_lump_is_not_the_measured_one(own: list[MeasuredFrame]) -> None:
    (found, _) = compare_frames(own, settings=COARSE, d_mm=18.75, depth_ratio=1.2, seat=0.0)
    assert found.differences[0] > 0.02


def test_a_table_becomes_frames_and_their_faults_are_named(tmp_path: Path) -> None:
    path = tmp_path / "f.csv"
    path.write_text("x_c_mm,s_mm,pressure_kpa\n" + "".join(f"{x},{s},{9 + s}\n" for x in (0, 6) for s in range(-2, 3)))
    frames = read_measured_frames(path)
    assert [frame.x_c_mm for frame in frames] == [0.0, 6.0]
    np.testing.assert_array_equal(frames[0].pressure_kpa, [7, 8, 9, 10, 11])
    path.write_text("s_mm,pressure_kpa\n0,9\n1,9\n")
    with pytest.raises(BadDataError, match=r"f\.csv: the frame at x_c_mm 0 has 2 taxels"):
        read_measured_frames(path)
    with pytest.raises(BadDataError, match="s_mm must lie within 12 mm"):
        compare_frames([MeasuredFrame(0.0, np.arange(14.0), np.ones(14))], settings=COARSE, **LUMP)


def test_frames_without_figures_are_refused(tmp_path: Path) -> None:
    (tmp_path / "f.csv").write_text("s_mm,pressure_kpa\n0,9\n1,9\n2,9\n3,9\n")
    done = run_here("study", "--measured-frames", "f.csv", cwd=tmp_path)
    assert done.returncode == 2
    assert "give --figures DIR" in done.stderr
    done = run_here("study", "--phantom", 15, 1, "--figures", "figures", "--model", "solid", cwd=tmp_path)
    assert done.returncode == 2
    assert "--phantom is for --figures of the plane-strain model" in done.stderr
    assert not (tmp_path / "figures").exists()
