"""Other people's grids and images as maps: read right, or refused in one line that names the fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.grids import read_grid
from tactile_bayes.posterior.bump import window_cells

Arrays = dict[str, Any]


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
