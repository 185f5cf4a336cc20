"""The nipple through every file that may hold it, and through none where it was not touched."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from campaign_files import arrays_of
from in_process import run_here
from map_files import PROVENANCE, plain_map
from mapping_scans import make_scan, strokes

from tactile_bayes.actions.show import describe
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.instrument import read_landmarks
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.scans import Landmarks, Scan

NOTCH, XIPHOID, NIPPLE = (np.array(p) for p in ([0.0, 200.0, 0.0], [0.0, 0.0, 0.0], [-80.0, 60.0, -3.0]))


def scan_of(*, nipple: bool) -> Scan:
    marks = Landmarks(NOTCH, XIPHOID, nipple_mm=NIPPLE if nipple else None)
    return make_scan(strokes(lines=3), landmarks=marks)


@pytest.mark.parametrize("nipple", [True, False])
def test_a_scan_file_keeps_the_nipple(tmp_path: Path, nipple: bool) -> None:
    path = tmp_path / "scan.mcap"
    write_scan(path, scan_of(nipple=nipple), provenance=PROVENANCE)
    marks = read_scan(path).landmarks
    assert marks is not None
    assert list(marks.points()) == ["sternal_notch", "xiphoid"] + ["nipple"] * nipple
    np.testing.assert_array_equal(marks.sternal_notch_mm, NOTCH)
    if nipple:
        np.testing.assert_array_equal(marks.nipple_mm, NIPPLE)
    assert describe(path)["nipple"] is nipple
    assert (b"nipple" in path.read_bytes()) is nipple  # no channel without a touch: old scans keep their bytes


def test_import_takes_the_nipple_and_says_so(tmp_path: Path) -> None:
    marks = np.stack([NOTCH, XIPHOID])
    np.savez(tmp_path / "scan.npz", **arrays_of(scan_of(nipple=False)), landmarks_mm=marks, nipple_mm=NIPPLE)
    done = run_here("import", "scan.npz", "-o", "scan.mcap", cwd=tmp_path)
    assert "landmarks: sternal notch, xiphoid and nipple" in done.stdout
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.mcap").landmarks.nipple_mm, NIPPLE)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"nipple_mm": NIPPLE}, "nipple_mm is without landmarks_mm; give notch and xiphoid too"),
        (
            {"nipple_mm": np.array([1.0, 2.0, 0.0]), "landmarks_mm": np.stack([NOTCH, XIPHOID])},
            "nipple_mm is 2.236 from a point of landmarks_mm; looks like metres or inches, give mm",
        ),
    ],
)
def test_a_nipple_that_cannot_be_one_is_refused(tmp_path: Path, more: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "scan.npz", **arrays_of(scan_of(nipple=False)) | more)
    done = run_here("import", "scan.npz", "-o", "scan.mcap", cwd=tmp_path)
    assert done.returncode == 3
    assert message in done.stderr


def test_a_map_file_keeps_the_nipple_and_refuses_a_damaged_one(tmp_path: Path) -> None:
    path, plain = tmp_path / "map.nc", plain_map()
    write_map(path, replace(plain, nipple_mm=NIPPLE), provenance=PROVENANCE)
    np.testing.assert_array_equal(read_map(path).nipple_mm, NIPPLE)
    assert read_map(path).fingerprint == plain.fingerprint  # the answer's random numbers stay
    write_map(path, plain, provenance=PROVENANCE, force=True)
    assert read_map(path).nipple_mm is None
    assert b"nipple" not in path.read_bytes()
    write_map(path, replace(plain, nipple_mm=NIPPLE[:2]), provenance=PROVENANCE, force=True)
    with pytest.raises(BadDataError, match=r"header.nipple_mm is \[-80.0, 60.0\]"):
        read_map(path)


def test_a_landmarks_file_may_have_a_nipple(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.json"
    document = {"schema": "tactile-bayes/landmarks/1", "sternal_notch_mm": [0, 200, 0], "xiphoid_mm": [0, 0, 0]}
    path.write_text(json.dumps(document))
    assert read_landmarks(path).nipple_mm is None
    path.write_text(json.dumps({**document, "nipple_mm": [-80, 60, -3]}))
    np.testing.assert_array_equal(read_landmarks(path).nipple_mm, NIPPLE)
    path.write_text(json.dumps({**document, "nipple_mm": [1, 2]}))
    with pytest.raises(BadDataError, match=r"nipple_mm is \[1, 2\]; give a list of 3"):
        read_landmarks(path)


SCENE = """
[scene]
duration_s = 3.0
frame_rate_hz = 100.0
[[lump]]
amplitude = 0.4
sigma_x_mm = 6.0
sigma_y_mm = 6.0
[landmarks]
nipple_mm = [-20.0, -15.0, 0.0]
"""
SESSION = 'subject = "P1"\nside = "left"\nposture = "supine"\n'


def test_a_simulated_nipple_gives_the_lump_a_place_by_the_clock(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "session.toml").write_text(SESSION)
    words = ("simulate", "scene.toml", "--session", "session.toml", "-o", "scan.mcap")
    assert run_here(*words, cwd=tmp_path).returncode == 0
    assert run_here("map", "scan.mcap", "-o", "map.nc", cwd=tmp_path).returncode == 0
    asked = ("estimate", "map.nc", "--size-calibration", "none", "--method", "laplace")
    found = json.loads(run_here(*asked, "--json", cwd=tmp_path).stdout)["position"]
    # the scene's x runs to the patient's right (x = y cross z), so the lump lies to the nipple's right and above it
    assert found["side"] == "left"
    assert found["quadrant"] == "upper inner"
    assert found["distance_mm"]["median"] == pytest.approx(25.0, abs=1.0)
    assert found["clock_hours"]["median"] == pytest.approx(12 - np.degrees(np.arctan2(20, 15)) / 30, abs=0.1)
    text = run_here(*asked, "-v", cwd=tmp_path).stdout
    assert f"Place: {found['text']}; 95 % interval " in text
    assert found["text"] in run_here(*asked, cwd=tmp_path).stdout
