"""Other people's arrays: read right, or refused in one line that names the fault."""

from __future__ import annotations

import io
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_files import arrays_of

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.arrays_layout import ArrayMap
from tactile_bayes.files.imports import import_arrays, read_arrays
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate

Arrays = dict[str, Any]


@pytest.fixture
def good() -> Arrays:
    scan = simulate(Scene(duration_s=0.1), rng=np.random.default_rng(0)).scan
    assert scan.landmarks is not None
    marks = np.stack([scan.landmarks.sternal_notch_mm, scan.landmarks.xiphoid_mm])
    return deepcopy(arrays_of(scan)) | {"landmarks_mm": marks}


def test_good_arrays_become_the_scan(good: Arrays, tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", **good)
    scan = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(scan.frames.counts, good["counts"])
    np.testing.assert_array_equal(scan.poses.quaternion_wxyz, good["quaternion_wxyz"])
    np.testing.assert_array_equal(scan.head.scanhead_from_tracker, good["array_from_tracker"])
    assert scan.landmarks is not None
    np.testing.assert_array_equal(scan.landmarks.xiphoid_mm, good["landmarks_mm"][1])
    assert scan.element_calibration.saturation_count == 4095


def test_landmarks_may_be_left_out_and_saturation_given(good: Arrays, tmp_path: Path) -> None:
    del good["landmarks_mm"]
    np.savez(tmp_path / "a.npz", **good, saturation_count=1023)
    scan = read_arrays(tmp_path / "a.npz")
    assert scan.landmarks is None
    assert scan.element_calibration.saturation_count == 1023
    stated, _ = import_arrays(tmp_path / "a.npz", ArrayMap(saturation=1000.2))
    assert stated.element_calibration.saturation_count == 1001


def drop(name: str) -> Callable[[Arrays], None]:
    return lambda a: a.pop(name)


def put(name: str, change: Callable[[Any], Any]) -> Callable[[Arrays], None]:
    return lambda a: a.update({name: change(a[name])})


def spoil(name: str, index: Any, value: float) -> Callable[[Arrays], None]:
    return lambda a: a[name].__setitem__(index, value)


# Fault, what the one line must say. One row a fault.
FAULTS: list[tuple[str, Callable[[Arrays], object], str]] = [
    ("missing", drop("array_from_tracker"), "lacks array_from_tracker"),
    ("shape", put("counts", lambda c: c[:, 0]), r"counts has shape \(20, 26\)"),
    ("length", put("frame_time_s", lambda t: t[:-1]), r"frame_time_s has shape \(19,\).*n = 20 as in counts"),
    ("empty", lambda a: a.update(position_mm=a["position_mm"][:0]), r"position_mm is empty"),
    (
        "fractions",
        put("counts", lambda c: c + 0.5),
        "counts holds .*which is no raw reading.*--unit kPa .options of `import`: list",
    ),
    ("counts high", put("counts", lambda c: c.astype(np.int64) + 65535), "counts holds"),
    ("counts low", put("counts", lambda c: c.astype(np.int64) - 5000), "counts holds -"),
    ("text", put("offset_kpa", lambda o: o.astype(str)), "offset_kpa is <U"),
    ("complex", put("offset_kpa", lambda o: o.astype(complex)), "offset_kpa is complex128"),
    ("quaternion", put("quaternion_wxyz", lambda q: 2 * q), "quaternion_wxyz has norm 2 at index 0"),
    ("zero quaternion", spoil("quaternion_wxyz", 3, 0.0), "norm 0 at index 3"),
    ("time back", spoil("pose_time_s", 4, 0.0), "pose_time_s runs backwards at index 4"),
    ("gain NaN", spoil("gain_kpa_per_count", (2, 3), np.nan), r"gain_kpa_per_count.*\(2, 3\)"),
    ("position 1e300", spoil("position_mm", (5, 1), 1e300), r"position_mm holds 1e\+300; give mm, kPa and s"),
    ("pitch NaN", put("pitch_mm", lambda _: np.nan), "pitch_mm holds 1 values that are not finite"),
    ("object", put("offset_kpa", lambda o: o.astype(object)), "offset_kpa holds Python objects"),
    ("not rigid", put("array_from_tracker", lambda t: 1.1 * t), "array_from_tracker is not a rigid"),
    ("mirrored", put("array_from_tracker", lambda t: t @ np.diag([1, 1, -1.0, 1])), "array_from_tracker is not"),
    ("pitch", put("pitch_mm", lambda _: 2.5), "taxels lie 1.5.*pitch_mm is 2.5"),
    ("head in m", put("head_surface_mm", lambda s: s / 1000), "head_surface_mm.*metres or inches, give mm"),
    ("head in inches", put("head_surface_mm", lambda s: s / 25.4), "head_surface_mm.*metres or inches, give mm"),
    ("path in m", put("position_mm", lambda p: p / 1000), "position_mm.*metres or inches, give mm"),
    ("landmarks in m", put("landmarks_mm", lambda p: p / 1000), "landmarks_mm.*metres or inches, give mm"),
    ("gain in Pa", put("gain_kpa_per_count", lambda g: g * 1000), "gain_kpa_per_count.*Pa or MPa"),
    ("time in ms", put("frame_time_s", lambda t: t * 1000), "frame_time_s steps by 5.*milliseconds"),
    ("two clocks", put("pose_time_s", lambda t: t + 100), r"do not overlap.*poses' times .options"),
    ("time zones", put("pose_time_s", lambda t: t + 7200), "do not overlap.*is it -7200, of a time zone"),
    ("a date and none", put("pose_time_s", lambda t: t + 3600e5), r"do not overlap.*poses' times( .options.*)?$"),
    (
        "whole seconds",
        put("frame_time_s", lambda t: np.floor(t + 0.93)),
        "repeats the time before 18 times of 20.*--rate",
    ),
]


@pytest.mark.parametrize(("fault", "spoiled", "words"), FAULTS, ids=[row[0] for row in FAULTS])
def test_every_fault_is_one_line(
    good: Arrays, tmp_path: Path, fault: str, spoiled: Callable[[Arrays], object], words: str
) -> None:
    del fault
    spoiled(good)
    path = tmp_path / "bad.npz"
    np.savez(path, **good)
    with pytest.raises(BadDataError, match=words) as caught:
        read_arrays(path)
    line = str(caught.value)
    assert line.startswith(str(path))
    assert "\n" not in line
    assert caught.value.way_out
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "not an .npz"), (b"hello, world", "not an .npz"), (b"\x80\x04pickle", "not an .npz")],
)
def test_a_file_that_is_no_archive_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(BadDataError, match=words):
        read_arrays(path)


def test_a_cut_or_changed_archive_is_refused(good: Arrays, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **good)
    data, path = buffer.getvalue(), tmp_path / "x.npz"
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(BadDataError, match="cut off"):
        read_arrays(path)
    changed = bytearray(data)
    changed[len(data) // 4] ^= 0xFF
    path.write_bytes(changed)
    with pytest.raises(BadDataError, match=r"damaged|whole"):
        read_arrays(path)
    np.save(tmp_path / "one.npy", good["counts"])
    with pytest.raises(BadDataError, match=r"lacks frame_time_s .*--rate-hz"):
        read_arrays(tmp_path / "one.npy")
    with pytest.raises(BadDataError, match="cannot be read"):
        read_arrays(tmp_path / "none.npz")


def test_a_grid_given_as_a_scan_points_to_maps(tmp_path: Path) -> None:
    np.savez(tmp_path / "g.npz", mean=np.ones((3, 3)))
    with pytest.raises(BadDataError, match="--as map"):
        read_arrays(tmp_path / "g.npz")


def test_the_shared_scans_are_read(shared_data: Path) -> None:
    for path in sorted((shared_data / "scans").glob("*.npz"))[:2]:
        scan = read_arrays(path)
        assert scan.frames.counts.shape == (1400, 16, 26)
        assert 5 < np.nanmedian(scan.pressure_kpa(700, 800)) < 14
