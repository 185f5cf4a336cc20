"""Other people's arrays, grids and images: read right, or refused in one line that names the fault."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.imports import read_arrays, read_grid
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.posterior.bump import window_cells

Arrays = dict[str, Any]


@pytest.fixture
def good() -> Arrays:
    scan = simulate(Scene(duration_s=0.1), rng=np.random.default_rng(0)).scan
    assert scan.landmarks is not None
    return {
        "counts": scan.frames.counts.copy(),
        "frame_time_s": scan.frames.time_s.copy(),
        "position_mm": scan.poses.position_mm.copy(),
        "quaternion_wxyz": scan.poses.quaternion_wxyz.copy(),
        "pose_time_s": scan.poses.time_s.copy(),
        "gain_kpa_per_count": scan.element_calibration.gain_kpa_per_count.copy(),
        "offset_kpa": scan.element_calibration.offset_kpa.copy(),
        "pitch_mm": 1.5,
        "landmarks_mm": np.stack([scan.landmarks.sternal_notch_mm, scan.landmarks.xiphoid_mm]),
        "array_from_tracker": scan.head.scanhead_from_tracker.copy(),
        "head_surface_mm": scan.head.surface_mm.copy(),
    }


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
    ("float counts", put("counts", lambda c: c.astype(float)), "counts is float64"),
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
    ("pitch", put("pitch_mm", lambda _: 2.5), "head_surface_mm has elements 1.5.*pitch_mm is 2.5"),
    ("head in m", put("head_surface_mm", lambda s: s / 1000), "head_surface_mm.*metres or inches, give mm"),
    ("head in inches", put("head_surface_mm", lambda s: s / 25.4), "head_surface_mm.*metres or inches, give mm"),
    ("path in m", put("position_mm", lambda p: p / 1000), "position_mm.*metres or inches, give mm"),
    ("landmarks in m", put("landmarks_mm", lambda p: p / 1000), "landmarks_mm.*metres or inches, give mm"),
    ("gain in Pa", put("gain_kpa_per_count", lambda g: g * 1000), "gain_kpa_per_count.*Pa or MPa"),
    ("time in ms", put("frame_time_s", lambda t: t * 1000), "frame_time_s steps by 5.*milliseconds"),
    ("two clocks", put("pose_time_s", lambda t: t + 100), "do not overlap"),
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
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
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
    with pytest.raises(BadDataError, match=r"single \.npy"):
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


@given(ny=st.integers(1, 6), nx=st.integers(1, 6), h=st.floats(0.01, 10), seed=st.integers(0, 99))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_grid_keeps_its_values_and_is_centred(tmp_path: Path, ny: int, nx: int, h: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean = rng.normal(1.0, 0.1, (ny, nx))
    mean[rng.random((ny, nx)) < 0.2] = np.nan
    mean[0, 0] = 1.0
    np.savez(tmp_path / "g.npz", mean=mean, spacing_mm=h)
    grid = read_grid(tmp_path / "g.npz", normalise="mean")
    np.testing.assert_array_equal(grid.mean, mean)
    np.testing.assert_array_equal(grid.count, np.isfinite(mean))
    assert (grid.variance[grid.count > 0] == 0).all()
    np.testing.assert_allclose(grid.x_mm + grid.x_mm[::-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(grid.y_mm), h)
    assert grid.recipe.source == "grid"
    assert (grid.background, grid.frame_count, grid.plane_from_base) == (1.0, 0, None)


def test_one_grid_in_every_format_is_one_map(tmp_path: Path) -> None:
    mean = np.arange(12.0).reshape(3, 4)
    np.savez(tmp_path / "g.npz", mean=mean)
    np.savetxt(tmp_path / "g.csv", mean, delimiter=",")
    for suffix in ("tif", "pgm", "png"):
        Image.fromarray(mean.astype(np.uint8)).save(tmp_path / f"g.{suffix}")
    for path in sorted(tmp_path.iterdir()):
        grid = read_grid(path, spacing_mm=2.0)
        np.testing.assert_array_equal(grid.mean, mean)  # row 0 stays row 0, the lowest y, images too
        assert grid.background is None
        np.testing.assert_array_equal(grid.x_mm, [-3.0, -1.0, 1.0, 3.0])


def test_count_and_variance_come_along(tmp_path: Path) -> None:
    count = np.array([[3, 0], [1, 2]])
    np.savez(tmp_path / "g.npz", mean=np.ones((2, 2)), count=count, variance=np.full((2, 2), 0.5), spacing_mm=1.0)
    grid = read_grid(tmp_path / "g.npz")
    np.testing.assert_array_equal(grid.count, count)
    np.testing.assert_array_equal(np.isnan(grid.mean), count == 0)
    assert grid.variance[0, 0] == 0.5


def test_a_variance_is_unknown_where_a_cell_has_one_reading(tmp_path: Path) -> None:
    """As numpy's `var(ddof=1)` leaves it; anywhere else a variance of NaN is a fault."""
    count, variance = np.array([[1, 2], [3, 0]]), np.array([[np.nan, 0.5], [0.25, np.nan]])
    np.savez(tmp_path / "g.npz", mean=np.ones((2, 2)), count=count, variance=variance, spacing_mm=1.0)
    grid = read_grid(tmp_path / "g.npz")
    np.testing.assert_array_equal(grid.variance, variance)
    cells = window_cells(grid, (0.0, 0.0), radius_mm=5.0)
    assert cells.reading_variance == pytest.approx((0.5 * 2 + 0.25 * 3) / 5)
    np.savez(tmp_path / "bad.npz", mean=np.ones((2, 2)), count=count + 1, variance=variance, spacing_mm=1.0)
    with pytest.raises(BadDataError, match=r"variance is nan at \(0, 0\), where count is 2.*0 or 1"):
        read_grid(tmp_path / "bad.npz")


def test_an_empty_field_is_a_cell_without_data(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("1,,3\n4,5,nan\n")
    grid = read_grid(tmp_path / "g.csv", spacing_mm=1.0)
    np.testing.assert_array_equal(grid.count, [[1, 0, 1], [1, 1, 0]])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("semicolons.csv", "\ufeff0,9;;1,234\r\n1;2;3\r\n".encode()),
        ("points.csv", b"0.9;;1.234\n1;2;3\n"),
        ("tabs.tsv", b"0,9\t\t1,234\n1\t2\t3\n"),
        ("unicode.txt", "0.9\t\t1.234\r\n1\t2\t3\r\n".encode("utf-16")),
        ("plain.csv", b"\n0.9,,1.234\n1,2,3\n\n\n"),
    ],
)
def test_tables_as_spreadsheets_save_them_are_one_grid(tmp_path: Path, name: str, content: bytes) -> None:
    """A spreadsheet saves by the country: semicolons and decimal commas, tabs, UTF-16, a byte order mark."""
    (tmp_path / name).write_bytes(content)
    np.testing.assert_array_equal(
        read_grid(tmp_path / name, spacing_mm=1.0).mean, [[0.9, np.nan, 1.234], [1.0, 2.0, 3.0]]
    )


def test_a_row_without_data_keeps_its_place(tmp_path: Path) -> None:
    """It was dropped, and the rows after it moved up by a cell."""
    (tmp_path / "g.csv").write_text("1,2\n,\n3,4\n")
    grid = read_grid(tmp_path / "g.csv", spacing_mm=1.0)
    np.testing.assert_array_equal(grid.mean, [[1.0, 2.0], [np.nan, np.nan], [3.0, 4.0]])


ONES = np.ones((2, 2))
GRID_FAULTS: list[tuple[Arrays, dict[str, Any], type[Exception], str]] = [
    ({"x": ONES}, {"spacing_mm": 1.0}, BadDataError, "lacks mean"),
    ({"mean": ONES}, {}, UsageError, "--spacing-mm"),
    ({"mean": ONES, "spacing_mm": [1.0, 2.0]}, {}, BadDataError, "1 by 2.*square"),
    ({"mean": ONES, "spacing_mm": 1.0}, {"spacing_mm": 2.0}, UsageError, "the file says"),
    ({"mean": ONES}, {"spacing_mm": -1.0}, BadDataError, "spacing is -1"),
    ({"mean": ONES}, {"spacing_mm": float("nan")}, BadDataError, "spacing is nan"),
    ({"mean": ONES}, {"spacing_mm": 0.001}, BadDataError, "spacing is 0.001 mm; looks like metres"),
    ({"mean": 9000 * ONES}, {"spacing_mm": 1.0, "units": "kPa"}, BadDataError, "9000 kPa; looks like Pa"),
    ({"mean": np.ones(4)}, {"spacing_mm": 1.0}, BadDataError, r"shape \(4,\)"),
    ({"mean": ONES * np.inf}, {"spacing_mm": 1.0}, BadDataError, "infinite"),
    ({"mean": ONES * np.nan}, {"spacing_mm": 1.0}, BadDataError, "no cell holds data"),
    ({"mean": ONES * 1j}, {"spacing_mm": 1.0}, BadDataError, "complex"),
    ({"mean": ONES, "count": -ONES}, {"spacing_mm": 1.0}, BadDataError, "count is -1"),
    ({"mean": ONES, "count": ONES / 2}, {"spacing_mm": 1.0}, BadDataError, "count is 0.5"),
    ({"mean": ONES * np.nan, "count": ONES}, {"spacing_mm": 1.0}, BadDataError, "mean is NaN at"),
    ({"mean": ONES, "variance": -ONES}, {"spacing_mm": 1.0}, BadDataError, "variance is -1"),
    ({"mean": ONES, "variance": np.ones(2)}, {"spacing_mm": 1.0}, BadDataError, "variance has shape"),
    ({"mean": 100 * ONES}, {"spacing_mm": 1.0, "normalise": "mean"}, BadDataError, "not near 1"),
]


@pytest.mark.parametrize(("arrays", "options", "error", "words"), GRID_FAULTS, ids=[row[3] for row in GRID_FAULTS])
def test_every_fault_of_a_grid_is_one_line(
    tmp_path: Path, arrays: Arrays, options: dict[str, Any], error: type[Exception], words: str
) -> None:
    np.savez(tmp_path / "g.npz", **arrays)
    with pytest.raises(error, match=words) as caught:
        read_grid(tmp_path / "g.npz", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("g.csv", b"1,2\n3\n", "row 2 has 1 fields"),
        ("g.csv", b"x,y\n1,2\n", "row 1, column 1 holds 'x'"),
        ("g.csv", b"", "is empty"),
        ("g.csv", b"\xff\xfe\x00", "not UTF-16 text"),
        ("g.csv", b"1,2\n\xb5,4\n", "line 2: byte 0xb5 is not UTF-8 text"),
        ("g.csv", b"Pressure mat,,,\nUnits,kPa\n1,2,3,4\n", "row 1, column 1 holds 'Pressure mat'"),
        ("g.csv", b"1,2\n3,4\n\n5,6\n7,8\n", "blank line after row 2; give one grid"),
        ("g.csv", b",0,1,2\n0,9,9,9\n1,9,9,9\n2,9,9,9\n", r"row 1 and column 1 count 0, 1, 2.*header=False"),
        ("g.csv", b",-1.5,0,1.5\n4,9,9,9\n2,9,9,9\n0,9,9,9\n", "row 1 and column 1 count -1.5, 0, 1.5"),
        ("g.csv", b"1,2,3,4,5,6,7,8\n9,9,9,9,9,9,9,9\n", "row 1 count 1, 2, 3"),
        ("g.csv", b"".join(b"%d,9\n" % i for i in range(9)), "column 1 count 0, 1, 2"),
        ("g.tsv", b"1,234\t2,345\n", r"'1,234', which is 1234 or 1.234; write numbers without commas"),
        ("g.csv", b"1;2,5;3\n1;2.5.1;3\n", "row 2, column 2 holds '2.5.1'"),
        ("g.tif", b"II*\x00junk", "is not an image|cannot be decoded"),
        ("g.pgm", b"P5 4 4 255\n12", "is not an image|cannot be decoded"),
        ("g.docx", b"", "suffix"),
    ],
)
def test_every_fault_of_a_table_or_image_is_one_line(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadDataError, match=words):
        read_grid(tmp_path / name, spacing_mm=1.0)


def test_a_colour_image_is_refused_and_grey_saved_as_colour_is_not(tmp_path: Path) -> None:
    colour = np.zeros((3, 4, 3), dtype=np.uint8)
    Image.fromarray(colour + np.uint8(7)).save(tmp_path / "grey.png")
    assert (read_grid(tmp_path / "grey.png", spacing_mm=1.0).mean == 7).all()
    colour[1, 1, 0] = 200
    Image.fromarray(colour).save(tmp_path / "colour.png")
    with pytest.raises(BadDataError, match="colour image"):
        read_grid(tmp_path / "colour.png", spacing_mm=1.0)


def test_the_laser_beam_images_become_maps(shared_data: Path) -> None:
    for path in sorted((shared_data / "laserbeam").iterdir()):
        grid = read_grid(path, spacing_mm=0.01)
        assert grid.mean.size > 10_000
        assert np.nanmax(grid.mean) > 5 * np.nanmedian(grid.mean)
