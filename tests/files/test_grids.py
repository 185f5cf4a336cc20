"""Other people's grids and images as maps: read right, or refused in one line that names the fault."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_files import read_grid
from PIL import Image
from scipy.io import savemat
from scipy.ndimage import gaussian_filter

import tactile_bayes
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.arrays_layout import GridOptions
from tactile_bayes.files.grids import import_grid, open_grid
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.posterior.bump import window_cells
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map

Arrays = dict[str, Any]
DEMO = Path(tactile_bayes.__file__).parent / "demo" / "scan.mcap"


@given(ny=st.integers(1, 6), nx=st.integers(1, 6), h=st.floats(0.01, 10), seed=st.integers(0, 99))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_grid_keeps_its_values_and_is_centred(tmp_path: Path, ny: int, nx: int, h: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean = rng.normal(1.0, 0.1, (ny, nx))
    mean[rng.random((ny, nx)) < 0.2] = np.nan
    mean[0, 0] = 1.0
    np.savez(tmp_path / "g.npz", mean=mean, spacing_mm=h)
    grid = read_grid(tmp_path / "g.npz", normalise="mean", cell_mm=h)
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
    ({"x": np.ones((5, 2, 2))}, {"spacing_mm": 1.0}, BadDataError, r"no array of rows and columns.*x \(5, 2, 2\)"),
    ({"x": ONES, "z": ONES}, {"spacing_mm": 1.0}, BadDataError, r"several arrays.*x \(2, 2\), z.*--array NAME"),
    ({"x": ONES}, {"spacing_mm": 1.0, "array": "y"}, BadDataError, "no array of rows and columns called 'y'"),
    ({"x": ONES}, {"spacing_mm": 1.0, "level": 1.0, "normalise": "mean"}, UsageError, "--level is for values"),
    ({"x": -ONES}, {"spacing_mm": 1.0, "level": "fit"}, BadDataError, "the level is -1; subtract"),
    ({"mean": ONES}, {}, UsageError, "--spacing-mm"),
    ({"mean": ONES, "spacing_mm": [1.0, 2.0]}, {}, BadDataError, "1 by 2.*square"),
    ({"mean": ONES, "spacing_mm": 1.0}, {"spacing_mm": 2.0}, UsageError, "the file says"),
    ({"mean": ONES}, {"spacing_mm": -1.0}, BadDataError, "spacing is -1"),
    ({"mean": ONES}, {"spacing_mm": float("nan")}, UsageError, "spacing_mm is nan; give a number"),
    ({"mean": ONES}, {"spacing_mm": 0.001}, BadDataError, "spacing is 0.001 mm; looks like metres"),
    ({"mean": 9000 * ONES}, {"spacing_mm": 1.0, "units": "kPa"}, BadDataError, "9000 kPa; looks like Pa"),
    ({"mean": np.ones(4)}, {"spacing_mm": 1.0}, BadDataError, r"shape \(4,\)"),
    ({"mean": ONES * 1e-160}, {"spacing_mm": 1.0, "level": "fit"}, BadDataError, "largest value is 1e-160; give read"),
    (
        {"mean": np.ones((1, 1))},
        {"spacing_mm": 1.0, "cell_mm": 2.0, "level": "fit"},
        BadDataError,
        "no 2 x 2 cells of 1 mm have data in half of them; give a smaller --cell-mm, or a larger grid",
    ),
    ({"mean": ONES * np.inf}, {"spacing_mm": 1.0}, BadDataError, "infinite"),
    ({"mean": ONES * np.nan}, {"spacing_mm": 1.0}, BadDataError, "no cell holds data"),
    ({"mean": ONES * 1j}, {"spacing_mm": 1.0}, BadDataError, "complex"),
    ({"mean": ONES, "count": -ONES}, {"spacing_mm": 1.0}, BadDataError, "count is -1"),
    ({"mean": ONES, "count": ONES / 2}, {"spacing_mm": 1.0}, BadDataError, "count is 0.5"),
    ({"mean": ONES, "count": ONES * 1e30}, {"spacing_mm": 1.0}, BadDataError, r"count is 1e\+30 at \(0, 0\)"),
    ({"mean": ONES, "count": ONES.astype(str)}, {"spacing_mm": 1.0}, BadDataError, "count is <U.*give real numbers"),
    ({"mean": ONES, "x": np.ones((0, 0)), "y": np.ones((0, 0))}, {}, UsageError, "a grid needs --spacing-mm"),
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
        ("g.csv", b"x,y\n1,a\n", "row 2, column 2 holds 'a'; if it means no value, give --no-value a"),
        ("g.csv", b"top,1,2\nend,3,4\n", "column 1 holds 'top'; leave out the column of names"),
        ("g.csv", b"a,b\nc,d\n", "holds 'a' and no number"),
        ("g.csv", b"", "is empty"),
        ("g.csv", b"\xff\xfe\x00", "not UTF-16 text"),
        ("g.csv", b"1,2\n\xb5,4\n", "line 2: byte 0xb5 is not UTF-8 text"),
        ("g.csv", b"Frame 1\n1,2\n3,4\nFrame 2\n1,2\n3,4\n", "has 'Frame 2' after row 3; give one grid.*are a scan"),
        ("g.csv", b"1,2\nB,4\n5,B\n", r"row 2, column 1 holds 'B' \(and 1 more do\); if it means no value"),
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
        grid = read_grid(path, spacing_mm=0.01, cell_mm=0.01)
        assert grid.mean.size > 10_000
        assert np.nanmax(grid.mean) > 5 * np.nanmedian(grid.mean)


# --- Tables as instruments and programs write them.

TEKSCAN = """\
DATA_TYPE FRAME
VERSION Hugemat 7.60
FILENAME C:\\Data\\exam 1.fsx
SENSOR_TYPE 5051
ROWS 2
COLS 3
ROW_SPACING 1.27 mm
COL_SPACING 1.27 mm
SENSEL_AREA 1.6129 mm2
NOISE_THRESHOLD 3
SECONDS_PER_FRAME 0.01
TIME 12/03/2024 10:21:44.120
UNITS kPa
START_FRAME 1
END_FRAME 1
ASCII_DATA @@

Frame 1
1.5,B,3
4,5,6

@@
"""
"""Tekscan's ASCII export as its readers on the web expect it: ``KEY value`` lines, ``ASCII_DATA @@``, frames."""


def test_an_export_of_tekscan_is_a_map_with_its_spacing_and_unit(tmp_path: Path) -> None:
    (tmp_path / "exam.asf").write_text(TEKSCAN)
    grid = read_grid(tmp_path / "exam.asf")
    np.testing.assert_array_equal(grid.mean, [[1.5, np.nan, 3.0], [4.0, 5.0, 6.0]])
    assert (grid.recipe.cell_mm, grid.recipe.units) == (1.27, "kPa")
    (tmp_path / "exam.asf").write_text(TEKSCAN.replace("COL_SPACING 1.27 mm", "COL_SPACING 0.1 in"))
    with pytest.raises(BadDataError, match=r"its cells are 2\.54 by 1\.27 mm; resample"):
        read_grid(tmp_path / "exam.asf")
    (tmp_path / "exam.asf").write_text(TEKSCAN.replace("\n\n@@", "\nFrame 2\n1,2,3\n4,5,6\n@@"))
    with pytest.raises(BadDataError, match="has 'Frame 2' after row 20; give one grid"):
        read_grid(tmp_path / "exam.asf")


@pytest.mark.parametrize(
    ("content", "note"),
    [
        ("0.9 2 1.234\n1 2 3\n", ""),
        ("  0.9   2   1.234  \n  1.0   2   3\n", ""),
        ("0,9 2,0 1,234\n1,0 2,0 3,0\n", ""),
        ("0.9,2,1.234,\n1,2,3,\n", "every row ends with a separator"),
        ("0.9;2;1.234;\r\n1;2;3;\r\n", "every row ends with a separator"),
        ("left,middle,right\n0.9,2,1.234\n1,2,3\n", "text before the numbers was left out: 'left middle right'"),
        ("# made by mat 3\n# kPa\n0.9 2 1.234\n1 2 3\n", "'# made by mat 3' (and 1 more)"),
        ("Mat,3,\nUnits,kPa\n\n0.9,2,1.234\n1,2,3\n\nmean,1.6\n", ""),
        ('"0,9";"2";"1,234"\n"1";"2";"3"\n', ""),
        ('"0,9","2","1,234"\n"1","2","3"\n', ""),
        ("0.9,2,1.234\r1,2,3\r", ""),
        ('"0.9","2","1.234"\n"1","2","3"\n', ""),
        ("Mat 3; kPa\n0.9,2,1.234\n1,2,3\n", "'Mat 3; kPa'"),
        (",9;2;1,234\n1;2;3\n", ""),
        ("0.9,2,1.234\n\x0c1,2,3\n", ""),
        ('"0.9", "2", "1.234"\n"1", "2", "3"\n', ""),
        ('"0.9" "2" "1.234"\n"1" "2" "3"\n', ""),
        ("Mat\t3\n0.9,2,1.234\n1,2,3\n", "text before"),
        ("seats 1,024\n0,9 2,0 1,234\n1,0 2,0 3,0\n", "'seats 1,024'"),
    ],
)
def test_one_table_in_many_dresses_is_one_grid(tmp_path: Path, content: str, note: str) -> None:
    (tmp_path / "g.csv").write_text(content)
    grid = open_grid(tmp_path / "g.csv")
    np.testing.assert_array_equal(grid.arrays["mean"], [[0.9, 2.0, 1.234], [1.0, 2.0, 3.0]])
    assert note in " ".join(grid.notes)


def test_frames_in_rows_are_no_map(tmp_path: Path) -> None:
    """They became a map of 3 by 51 m, or so."""
    np.savetxt(tmp_path / "frames.csv", np.ones((200, 416)), delimiter=",")
    with pytest.raises(BadDataError, match=r"200 x 416 cells of 1\.5 mm are 0\.624 m long; one frame a row.*as a scan"):
        read_grid(tmp_path / "frames.csv", spacing_mm=1.5)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("time,P1,P2\n0.00,1,2\n0.01,1,2\n", "its first column is called 'time'.*import them as a scan"),
        ("".join(f"{i / 100:.2f},{i % 3},{i % 2}\n" for i in range(10)), "column 1 runs in equal steps"),
        (",".join(f"{1.5 * i}" for i in range(9)) + "\n1,2,3,1,2,3,1,2,2\n", "row 1 runs in equal steps"),
        ("FRAME,1\n1,2\n3,4\nFRAME,2\n1,2\n3,4\n", "has 'FRAME' after row 3"),
        ("row;1;2\n1;1,5;2\n2;4;5\n", "leave out the labels of rows and columns"),
        ("1_0,2\n3,4\n", "row 1, column 1 holds '1_0'"),
    ],
)
def test_frames_and_labels_in_a_table_are_named(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "g.csv").write_text(content)
    with pytest.raises(BadDataError, match=words):
        read_grid(tmp_path / "g.csv", spacing_mm=1.0)


def test_a_plane_of_a_simulation_is_a_map(tmp_path: Path) -> None:
    """Every row and column runs in equal steps, which labels alone do not."""
    y, x = np.mgrid[:12, :14]
    np.savetxt(tmp_path / "g.csv", 2 + 0.1 * x + 0.2 * y, delimiter=",", fmt="%.3f")
    assert read_grid(tmp_path / "g.csv", spacing_mm=1.0).covered.all()


def test_a_list_of_places_and_values_is_no_map(tmp_path: Path) -> None:
    y, x = np.mgrid[:4, :5]
    table = np.stack([x.ravel(), y.ravel(), np.ones(20)], axis=1)
    np.savetxt(tmp_path / "list.csv", table, delimiter=",", header="x_mm,y_mm,kPa", comments="")
    with pytest.raises(BadDataError, match=r"a list of 20 values with their places, on 5 by 4.*pivot"):
        read_grid(tmp_path / "list.csv", spacing_mm=1.0)


# --- Cells without a value.


def lump() -> Any:
    """A map of 61 by 71 cells about 1, with a bump of 0.35 and smooth noise."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:61, :71]
    noise = gaussian_filter(rng.normal(size=(61, 71)), 1.0)
    return 1 + 0.35 * np.exp(-((x - 35) ** 2 + (y - 30) ** 2) / (2 * 5.2**2)) + 0.01 * noise / noise.std()


MARKS: list[tuple[str, Any, float, str]] = [
    ("dead column", np.s_[:, 33], 0.0, "0 in column 34 stands apart"),
    ("zeros after a crop", np.s_[:3], 0.0, r"0 in 3 rows \(1 to 3\)"),
    ("fill value", np.s_[5:8, 5:8], 1e20, r"1e\+20 in 9 cells \(row 6, column 6"),
    ("fill value of float32", np.s_[5:8, 5:8], float(np.float32(1e20)), r"1e\+20 in 9 cells"),
    ("-9999", np.s_[5, 5:8], -9999.0, "-9999 in 3 cells"),
    ("9999", np.s_[50:, 60:], 9999.0, "9999 in 121 cells"),
    ("-1", np.s_[:, :2], -1.0, r"-1 in 2 columns \(1 to 2\)"),
    ("no sensel", np.s_[:, 70], 2.55, "2.55 in column 71"),
    ("one cell", np.s_[20, 60], 255.0, "255 in row 21, column 61"),
    ("stuck column", np.s_[:, 50], 1.3, "1.3 in column 51"),
]


@pytest.mark.parametrize(("cells", "number", "words"), [row[1:] for row in MARKS], ids=[row[0] for row in MARKS])
def test_numbers_that_stand_for_no_value_are_asked_about_and_then_left_out(
    tmp_path: Path, cells: Any, number: float, words: str
) -> None:
    whole = lump()
    spoiled = whole.copy()
    spoiled[cells] = number
    np.savez(tmp_path / "g.npz", mean=spoiled, spacing_mm=1.0)
    with pytest.raises(BadDataError, match=words) as caught:
        read_grid(tmp_path / "g.npz", normalise="gain")
    assert f"give --no-value {number:.12g}" in caught.value.way_out
    stated = read_grid(tmp_path / "g.npz", normalise="gain", no_value=[f"{number:.12g}"])
    without = np.zeros_like(whole, dtype=bool)
    without[cells] = True
    np.testing.assert_array_equal(stated.mean, np.where(without, np.nan, whole))
    assert not stated.count[without].any()
    if abs(number) < 1e12:
        assert read_grid(tmp_path / "g.npz", normalise="gain", no_value=["none"]).covered.all()


def test_a_dead_line_that_is_noisy_is_named(tmp_path: Path) -> None:
    spoiled = lump()
    spoiled[:, 20] = np.random.default_rng(1).normal(0, 0.003, 61)
    np.savez(tmp_path / "g.npz", mean=spoiled, spacing_mm=1.0)
    with pytest.raises(BadDataError, match=r"column 21 differs from those beside it by .*leave its cells empty"):
        read_grid(tmp_path / "g.npz", normalise="gain")
    spoiled[:, 20] = np.nan
    np.savez(tmp_path / "g.npz", mean=spoiled, spacing_mm=1.0)
    read_grid(tmp_path / "g.npz", normalise="gain")


@pytest.mark.long_repeats
@pytest.mark.parametrize("cell_mm", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("normalise", ["gain", "none"])
def test_nothing_stands_apart_in_a_map_of_a_scan(tmp_path: Path, cell_mm: float, normalise: str) -> None:
    made = build_map([read_scan(DEMO)], cell_mm=cell_mm, normalise=normalise)
    np.savez(tmp_path / "g.npz", mean=np.where(made.covered, made.mean, np.nan), spacing_mm=cell_mm)
    read_grid(tmp_path / "g.npz", normalise=normalise)


def test_counts_and_marks_go_together(tmp_path: Path) -> None:
    spoiled = lump()
    spoiled[0, :9] = -9999
    np.savez(tmp_path / "g.npz", mean=spoiled, count=np.full(spoiled.shape, 40), spacing_mm=1.0)
    grid = read_grid(tmp_path / "g.npz", normalise="gain", no_value=["-9999"])
    assert grid.count.sum() == 40 * (spoiled.size - 9)


def test_a_word_for_no_value_is_stated(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("1,2,n/a\n-,4,NaN\n5,6,7\n")
    with pytest.raises(BadDataError, match="row 1, column 3 holds 'n/a'; if it means no value, give --no-value n/a"):
        read_grid(tmp_path / "g.csv", spacing_mm=1.0)
    grid = read_grid(tmp_path / "g.csv", spacing_mm=1.0, no_value=["n/a", "-"])
    np.testing.assert_array_equal(grid.mean, [[1, 2, np.nan], [np.nan, 4, np.nan], [5, 6, 7]])


# --- One array of a file, and its level.


def files_of_arrays(folder: Path, values: Any) -> dict[str, Path]:
    """One array in each kind of file that other programs write, packed and with missing cells where they have them."""
    with warnings.catch_warnings(action="ignore"):
        xarray = pytest.importorskip("xarray")
    np.save(folder / "a.npy", values)
    np.savez(folder / "a.npz", P=values, seconds=np.arange(3))
    savemat(folder / "a.mat", {"exam": {"P": values, "name": "phantom"}})
    with h5py.File(folder / "a.h5", "w") as file:
        file["exam/P"] = values.astype(">f8")  # the highest byte first, and in a group
        file["x"] = np.arange(values.shape[1])
    data = xarray.Dataset({"P": (("y", "x"), values)})
    fill = {"P": {"_FillValue": -9999.0}}
    data.to_netcdf(folder / "a.nc", engine="netcdf4", encoding=fill)
    data.to_netcdf(folder / "a.cdf", engine="scipy", format="NETCDF3_CLASSIC", encoding=fill)
    packing = {"P": {"dtype": "i2", "_FillValue": -32768, "scale_factor": 1 / 1024, "add_offset": 8.0}}
    data.to_netcdf(folder / "packed.nc", engine="netcdf4", encoding=packing)
    return {path.name: path for path in sorted(folder.iterdir())}


def test_one_array_is_one_map_in_every_kind_of_file(tmp_path: Path) -> None:
    values = np.round(8.4 * lump() * 1024) / 1024
    values[:3, :7] = np.nan
    files = files_of_arrays(tmp_path, values)
    assert len(files) == 7
    for path in files.values():
        np.testing.assert_array_equal(read_grid(path, spacing_mm=1.0, units="kPa").mean, values, err_msg=path.name)


Y, X = np.arange(61.0) - 30, np.arange(71.0) - 35
AXES: dict[str, dict[str, Any]] = {
    "y falls": {"mean": lump()[::-1], "y": Y[::-1], "x": X},
    "both fall": {"mean": lump()[::-1, ::-1], "y": Y[::-1], "x": X[::-1]},
    "x from row to row": {"mean": lump().T, "y": Y, "x": X},
    "x from row to row, y falls": {"mean": lump()[::-1].T, "y": Y[::-1], "x": X},
    "a place of each cell": {"mean": lump()[:, ::-1], "x": np.meshgrid(X[::-1], Y)[0], "y": np.meshgrid(X, Y)[1]},
    "the same, turned": {"mean": lump().T, "x": np.meshgrid(X, Y)[0].T, "y": np.meshgrid(X, Y)[1].T},
}


@pytest.mark.parametrize("arrays", AXES.values(), ids=AXES)
def test_a_grid_lies_as_its_places_say(tmp_path: Path, arrays: dict[str, Any]) -> None:
    np.savez(tmp_path / "grid.npz", **arrays)
    found, notes = import_grid(tmp_path / "grid.npz", GridOptions(spacing_mm=1.0, normalise="gain"))
    np.testing.assert_array_equal(found.mean, lump())
    assert "x runs in steps of 1" in notes
    savemat(tmp_path / "grid.mat", {"exam": arrays})  # lines have two axes, and a group
    found, notes = import_grid(tmp_path / "grid.mat", GridOptions(spacing_mm=1.0, normalise="gain"))
    np.testing.assert_array_equal(found.mean, lump())
    for twice in (["x", "y"], ["y"]):  # with cells of 2 mm, and of 1 by 2 mm
        np.savez(tmp_path / "grid.npz", **{**arrays, **{name: 2 * arrays[name] for name in twice}})
        with pytest.raises(BadDataError, match="is 1 mm, and the places of the cells run in steps of 2; give --spac"):
            import_grid(tmp_path / "grid.npz", GridOptions(spacing_mm=1.0, normalise="gain"))
    np.savez(tmp_path / "grid.npz", **{**arrays, "x": arrays["x"] ** 3})
    with pytest.raises(BadDataError, match="x runs in unequal steps"):
        import_grid(tmp_path / "grid.npz", GridOptions(spacing_mm=1.0, normalise="gain"))


def test_the_steps_of_an_import_are_reported(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", lump())
    told: list[tuple[int, int]] = []
    import_grid(
        tmp_path / "a.npy",
        GridOptions(spacing_mm=1.0, normalise="gain"),
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(1, 3), (2, 3)]


def test_a_level_in_another_unit_and_words_of_spreadsheets_have_their_way_out(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "grid.csv", lump(), delimiter=",")
    with pytest.raises(BadDataError, match=r"the median value is 1.*, not near the level of 1000; give the level in"):
        import_grid(tmp_path / "grid.csv", GridOptions(spacing_mm=1.0, level=1000.0))
    for word in ("#DIV/0!", "1.#QNAN"):
        (tmp_path / "sheet.csv").write_text(f"1,{word},1\n1,1.1,1\n1,1,1\n")
        with pytest.raises(BadDataError, match=f"--no-value {word}"):
            import_grid(tmp_path / "sheet.csv", GridOptions(spacing_mm=1.0))


@pytest.mark.parametrize("factor", [1.0, 8.4, 1200.0])
@pytest.mark.parametrize("slope", [0.0, 0.002])
def test_a_level_is_fitted_beside_the_lump(tmp_path: Path, factor: float, slope: float) -> None:
    """To 0.5 %, where the map's median is off by 1.5 % on a slope; stated, it is divided by as it is."""
    values = factor * lump() * (1 + slope * (np.arange(71) - 35))
    np.save(tmp_path / "a.npy", values)
    fitted = read_grid(tmp_path / "a.npy", spacing_mm=1.0, units="counts", level="fit")
    assert np.nanmax(values / fitted.mean) == pytest.approx(factor, rel=5e-3)
    assert (fitted.recipe.normalise, fitted.background, fitted.recipe.units) == ("gain", 1.0, "")
    (found,) = fitted.findings
    assert found.kind == "level_fitted"
    assert f"divided by {np.nanmax(values / fitted.mean):.4g} counts" in found.text
    stated = read_grid(tmp_path / "a.npy", spacing_mm=1.0, level=factor)
    np.testing.assert_allclose(stated.mean, values / factor)
    assert not stated.findings


def test_where_nothing_rises_the_level_is_the_median(tmp_path: Path) -> None:
    values = 8.4 + 0.05 * np.random.default_rng(3).normal(size=(41, 41))
    np.save(tmp_path / "a.npy", values)
    assert read_grid(tmp_path / "a.npy", spacing_mm=1.0, level="fit").mean.mean() == pytest.approx(1.0, abs=0.01)


# --- Pixels.


def test_fine_cells_are_averaged_where_they_lie(tmp_path: Path) -> None:
    """A plane stays the plane: 43 by 57 cells of 0.2 mm become 1 mm, the last ones where half of them are known."""
    y, x = (np.arange(n) * 0.2 - (n - 1) * 0.1 for n in (43, 57))
    values = 5 + 0.1 * x + 0.2 * y[:, None]
    values[:3, :5] = np.nan
    np.save(tmp_path / "a.npy", values)
    grid, notes = import_grid(tmp_path / "a.npy", GridOptions(spacing_mm=0.2))
    assert grid.mean.shape == (9, 12)
    assert grid.recipe.cell_mm == 1.0
    assert notes == ["5 x 5 cells of 0.2 mm were averaged into one of 1 mm"]
    assert not grid.covered[0, 0]  # 10 of 25 cells
    inner = grid.mean[1:8, 1:11]
    np.testing.assert_allclose(inner, 5 + 0.1 * grid.x_mm[1:11] + 0.2 * grid.y_mm[1:8, None], atol=1e-12)
    assert not grid.covered[:, 11].any()  # 2 of 5 columns
    assert grid.covered[8, 1:11].all()  # 3 of 5 rows
    kept = read_grid(tmp_path / "a.npy", spacing_mm=0.2, cell_mm=0.2)
    np.testing.assert_array_equal(kept.mean, values)
    assert read_grid(tmp_path / "a.npy", spacing_mm=0.5).mean.shape == values.shape
    with pytest.raises(UsageError, match=r"--cell-mm is 0\.1, and the grid's cells are 0\.2 mm"):
        read_grid(tmp_path / "a.npy", spacing_mm=0.2, cell_mm=0.1)


def test_counts_and_variances_of_fine_cells_are_those_of_all_readings(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    readings = [[rng.normal(1 + 0.1 * i, 0.2, 3 + i + j) for j in range(2)] for i in range(2)]
    arrays = {
        "mean": np.array([[one.mean() for one in row] for row in readings]),
        "variance": np.array([[one.var() for one in row] for row in readings]),
        "count": np.array([[len(one) for one in row] for row in readings]),
    }
    np.savez(tmp_path / "a.npz", **arrays, spacing_mm=0.4)
    grid = read_grid(tmp_path / "a.npz", normalise="gain", cell_mm=0.8)
    whole = np.concatenate([one for row in readings for one in row])
    assert grid.count.tolist() == [[len(whole)]]
    assert grid.mean[0, 0] == pytest.approx(whole.mean())
    assert grid.variance[0, 0] == pytest.approx(whole.var())


@pytest.mark.long
def test_an_image_of_a_million_pixels_is_sized_where_its_lump_is(tmp_path: Path) -> None:
    """With errors that neighbouring pixels share its grain was taken for a lump, and 300 by 300 took minutes."""
    y, x = np.mgrid[:1000, :1000] * 0.1 - 49.95
    noise = gaussian_filter(np.random.default_rng(0).normal(size=x.shape), 5)
    values = 1 + 0.35 * np.exp(-((x - 3) ** 2 + (y + 2) ** 2) / (2 * 5.2**2)) + 0.01 * noise / noise.std()
    Image.fromarray((20_000 * values).astype(np.uint16)).save(tmp_path / "a.png")
    grid = read_grid(tmp_path / "a.png", spacing_mm=0.1, level="fit")
    assert grid.mean.size == 10_000
    found = estimate_map(
        grid, calibration=None, options=SamplerSettings(method="optimise"), rng=np.random.default_rng(1)
    )
    assert found.fit is not None
    assert found.fit.theta[1:3] == pytest.approx([3, -2], abs=0.1)
    assert found.fit.widths()[:2] == pytest.approx([5.2, 5.2], rel=0.05)


def test_a_signalling_nan_of_32_bits_is_a_gap_like_another() -> None:
    """numpy warns where one is converted, and a warning fails a test."""
    values = np.ones((30, 30), dtype=np.float32)
    values.view(np.uint32)[3, 4] = 0x7F800001
    made = tactile_bayes.map_of(values, spacing_mm=1.0)
    assert np.count_nonzero(~made.tactile_map.covered) == 1


@pytest.mark.parametrize(("end", "stated"), [(1.0, {"normalise": "gain"}), (255.0, {"level": "fit"})])
def test_values_stretched_to_a_range_have_no_level_and_give_no_size(end: float, stated: dict[str, str]) -> None:
    """A map of 13 mm was sized at 20.5 mm, or said to hold no lump."""
    values = tactile_bayes.demo_map().tactile_map.mean
    stretched = end * ((values - np.nanmin(values)) / (np.nanmax(values) - np.nanmin(values)))
    with pytest.raises(BadDataError, match=f"values go from 0 to {end:g}, as those stretched to a range do.*measured"):
        tactile_bayes.map_of(stretched, spacing_mm=1.0, **stated)
    assert tactile_bayes.map_of(stretched, spacing_mm=1.0).tactile_map.background is None  # widths alone


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.csv"
    path.write_text("1,0000,1,0123\n1,0200,1,0456\n")
    with pytest.raises(BadDataError, match="holds '0456' between commas, as of a number with a decimal comma; sep"):
        tactile_bayes.map_of(path, spacing_mm=1.0)
    path.write_text("001,012,120\n003,040,009\n")  # of a fixed width
    assert tactile_bayes.map_of(path, spacing_mm=1.0).tactile_map.mean.max() == 120
