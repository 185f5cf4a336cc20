"""Exports of makers' programs come in by the command of the guide, as they are written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from engineers_arrays import write_head
from in_process import run_here
from makers_exports import EXPORTS, KPA, KPA_PER_COUNT, POSES, SCAN, TIME, TURNED, reskin, toolbox
from scipy.spatial.transform import Rotation

from tactile_bayes.files.scan_mcap import read_scan


def files(folder: Path) -> None:
    """Head, calibration, and in npz what a sample does not hold."""
    write_head(SCAN, folder / "head.json")
    calibration = {
        "schema": "tactile-bayes/array-calibration/1",
        "head_id": "S15",
        "date": "2026-11-26",
        "gain_kpa_per_count": np.full((16, 26), KPA_PER_COUNT).tolist(),
        "offset_kpa": np.zeros((16, 26)).tolist(),
        "saturation_count": 1023,
    }
    (folder / "singletact.json").write_text(json.dumps(calibration))
    poses = np.column_stack([POSES.time_s, POSES.position_mm, POSES.quaternion_wxyz])
    np.savetxt(folder / "poses.csv", poses, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    np.savez(folder / "frames.npz", frames=KPA, frame_time_s=TIME)


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_comes_in_by_the_command_of_the_guide(tmp_path: Path, name: str) -> None:
    export = EXPORTS[name]
    files(tmp_path)
    file = f"export{export.suffix}"
    data = export.text if isinstance(export.text, bytes) else export.text.encode("utf-8-sig")
    (tmp_path / file).write_bytes(data)
    words = [file, "--poses", "poses.csv"]
    if export.poses:
        words = ["frames.npz", "--poses", file, "--unit", "kPa"]
    elif isinstance(export.text, bytes):
        words = [file]
    done = run_here("import", *words, "--head-geometry", "head.json", *export.options, "-o", "exam.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert export.told in done.stdout
    found = read_scan(tmp_path / "exam.mcap")
    kpa = found.element_calibration.to_kpa(found.frames.counts)
    np.testing.assert_allclose(kpa, KPA, atol=export.within)
    np.testing.assert_allclose(found.frames.time_s - found.frames.time_s[0], TIME - TIME[0], atol=1e-3)
    kept = list(export.kept)
    if isinstance(export.text, bytes):
        kept = list(np.searchsorted(POSES.time_s, TIME).clip(0, len(POSES.time_s) - 1))
    np.testing.assert_allclose(found.poses.position_mm, POSES.position_mm[kept], atol=2e-3)
    apart = TURNED[kept].inv() * Rotation.from_quat(found.poses.quaternion_wxyz, scalar_first=True)
    assert apart.magnitude().max() < 1e-4


def test_two_tools_of_ndi_are_listed_by_the_names_of_their_ports(tmp_path: Path) -> None:
    files(tmp_path)
    (tmp_path / "two.csv").write_text(toolbox(2))
    words = ("frames.npz", "--poses", "two.csv", "--unit", "kPa", "--head-geometry", "head.json", "-o", "exam.mcap")
    done = run_here("import", *words, cwd=tmp_path)
    assert done.returncode == 3
    assert "1 (Port 0x01: Probe 1 s/n:3E4C8800), 2 (Port 0x02: Probe 2 s/n:3E4C8801)" in done.stderr


def test_a_field_of_magnetometers_is_no_pressure(tmp_path: Path) -> None:
    """ReSkin: pressures are what its user's own calibration makes of the fields."""
    files(tmp_path)
    (tmp_path / "reskin.csv").write_text(reskin())
    words = ("--frame-shape", "4", "5", "--rate-hz", "200", "--unit", "kPa", "--poses", "poses.csv", "-o", "exam.mcap")
    done = run_here("import", "reskin.csv", *words, cwd=tmp_path)
    assert done.returncode == 3
    assert "reskin.csv: is a log of magnetic fields by line 1 (T0, Bx0, By0, Bz0); make pressures" in done.stderr
