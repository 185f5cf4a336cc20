"""`check`, and `import --correct` and `map --as-stated` after it, as a user runs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from campaign_files import arrays_of
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.mapping.convention import corrected


@pytest.fixture(scope="module")
def backwards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with arrays of the packaged scan, whose columns run backwards."""
    folder, scan = tmp_path_factory.mktemp("backwards"), tb.demo_scan()
    np.savez(folder / "exam.npz", **arrays_of(corrected(scan, ["columns-reversed"])))
    return folder


@pytest.mark.long
def test_the_first_scan_says_what_is_wrong_and_how_to_mend_it(backwards):
    said = run_here("import", "exam.npz", "-o", "exam.mcap", cwd=backwards)
    assert said.returncode == 0
    assert "; the array's columns run backwards (odds" in said.stdout

    refused = run_here("map", "exam.mcap", "-o", "exam.nc", cwd=backwards)
    assert refused.returncode == 3
    assert "--correct columns-reversed (if the tracker's axes are left-handed" in refused.stderr
    assert "else left and right change places), or map it with --as-stated" in refused.stderr
    assert not (backwards / "exam.nc").exists()

    checked = run_here("check", "exam.mcap", cwd=backwards)
    assert checked.returncode == 3
    assert "import the scan again with --correct columns-reversed" in checked.stdout

    mended = run_here("import", "exam.npz", "-o", "right.mcap", "--correct", "columns-reversed", cwd=backwards)
    assert "array, lever arm and quaternions are as stated" in mended.stdout
    assert np.array_equal(tb.read_scan(backwards / "right.mcap").frames.counts, tb.demo_scan().frames.counts)


@pytest.mark.long
def test_a_scan_can_be_mapped_as_it_is_stated(backwards):
    run_here("import", "exam.npz", "-o", "again.mcap", cwd=backwards)
    assert run_here("map", "again.mcap", "-o", "again.nc", "--as-stated", cwd=backwards).returncode == 0


def test_check_lists_what_is_excluded(tmp_path):
    demo = Path(tb.__file__).parent / "demo" / "scan.mcap"
    checked = run_here("check", demo, cwd=tmp_path)
    assert checked.returncode == 0
    assert "excluded (odds above 10^6): scalar-last" in checked.stdout
    assert "Research use only" in checked.stdout


def test_a_map_has_nothing_to_correct(tmp_path):
    (tmp_path / "g.csv").write_text("1,1.1\n1,1.2\n")
    words = ("g.csv", "-o", "g.nc", "--spacing-mm", "1", "--correct", "transposed")
    refused = run_here("import", *words, cwd=tmp_path)
    assert refused.returncode == 2
    assert "--correct: for scans only; leave out or give --as scan" in refused.stderr


def test_a_scan_in_another_unit_of_length_is_told_by_how_far_it_moved(tmp_path):
    arrays = arrays_of(tb.demo_scan())
    for factor, told in ((100.0, "no breast is so large"), (0.1, "no breast is so small")):
        np.savez(tmp_path / "scan.npz", **arrays | {"position_mm": factor * arrays["position_mm"]})
        said = run_here("import", "scan.npz", "-o", "scan.mcap", "--force", cwd=tmp_path)
        assert f"{told}; check their unit" in said.stdout
    assert "the unit of the positions" in said.stdout  # these frames contradict each other


def test_a_lever_arm_in_cm_is_told_and_none_at_all_is_not(tmp_path):
    arrays = arrays_of(tb.demo_scan())
    lever = arrays["array_from_tracker"].copy()
    for factor, told in ((1.0, False), (0.1, True), (0.0, False)):
        arrays["array_from_tracker"] = lever * np.array([[1.0, 1, 1, factor]] * 3 + [[1.0] * 4])
        assert ("To check: the sensor lies 5.59 mm" in run_import(arrays, tmp_path)) is told


def test_a_scan_whose_rotations_are_all_the_same_is_told(tmp_path):
    arrays = arrays_of(tb.demo_scan())
    assert "without turning" not in run_import(arrays, tmp_path)
    arrays["quaternion_wxyz"] = np.tile([1.0, 0, 0, 0], (len(arrays["pose_time_s"]), 1))
    assert "mm without turning\n" in run_import(arrays, tmp_path)


def run_import(arrays, folder):
    np.savez(folder / "scan.npz", **arrays)
    return run_here("import", "scan.npz", "-o", "scan.mcap", "--force", cwd=folder).stdout


def test_a_scan_of_which_no_map_can_be_made_is_imported(tmp_path):
    scan = tb.demo_scan()
    counts = np.full_like(scan.frames.counts, 4095)
    np.savez(tmp_path / "full.npz", **arrays_of(scan) | {"counts": counts})
    said = run_here("import", "full.npz", "-o", "full.mcap", cwd=tmp_path)
    assert said.returncode == 0
    assert "no map can be made of it: none of the 416 taxels works" in said.stdout
