"""What other programs see in a map's file by the CF conventions,."""

from __future__ import annotations

import shutil
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
import pytest
from map_files import PROVENANCE, assert_same, plain_map

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.mapping.map import MapRecipe, TactileMap

ENGINES = ("netcdf4", "h5netcdf")


def gapped_map() -> TactileMap:
    """`plain_map` with a cell without data, one of a single reading, and half cells."""
    plain = plain_map()
    mean, variance, count = plain.mean.copy(), plain.variance.copy(), plain.count.copy()
    mean[0, 0], variance[0, 0], count[0, 0] = np.nan, np.nan, 0
    variance[1, 2], count[1, 2] = np.nan, 1
    return replace(
        plain, mean=mean, variance=variance, count=count, x_mm=plain.x_mm / 2, y_mm=plain.y_mm / 2,
        recipe=replace(plain.recipe, cell_mm=0.5),
    )  # fmt: skip


@pytest.fixture
def written(tmp_path: Path) -> Path:
    write_map(tmp_path / "map.nc", gapped_map(), provenance=PROVENANCE)
    return tmp_path / "map.nc"


@pytest.fixture(scope="module")
def xarray() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("xarray")


def test_x_and_y_are_coordinate_variables_with_units_and_axis(written: Path) -> None:
    expected = gapped_map()
    with netCDF4.Dataset(written) as file:
        assert file.Conventions == "CF-1.11"
        assert set(file.dimensions) == {"y", "x", "row", "column"}
        for name, values, of in (("x", expected.x_mm, "across"), ("y", expected.y_mm, "along")):
            assert file[name].dimensions == (name,)
            assert file[name].__dict__ == {
                "units": "mm", "axis": name.upper(), "long_name": f"cell centres {of} the head"
            }  # fmt: skip
            np.testing.assert_array_equal(file[name][:], values)
        assert not {"x_mm", "y_mm"} & set(file.variables)
    with h5py.File(written) as file:
        for axis, name in enumerate(("y", "x")):
            assert file[name].is_scale
            assert all(file[cells].dims[axis][0] == file[name] for cells in ("mean", "variance", "count"))


def test_cells_without_data_are_masked_by_the_fill_value(written: Path) -> None:
    expected = gapped_map()
    with netCDF4.Dataset(written) as file:
        for name in ("mean", "variance"):
            values = getattr(expected, name)
            assert np.isnan(file[name]._FillValue)
            np.testing.assert_array_equal(np.ma.getmaskarray(file[name][:]), np.isnan(values))
            np.testing.assert_array_equal(file[name][:].filled(np.nan), values)
        assert "_FillValue" not in file["count"].ncattrs()
        assert file["count"].standard_name == "number_of_observations"
        named = " ".join(file[name].ancillary_variables for name in ("mean", "variance")).split()
        assert set(named) <= set(file.variables)


@pytest.mark.parametrize(
    ("recipe", "units", "conventions"),
    [
        (MapRecipe("scan", "mean", 0.5), ("1", "1"), "CF-1.11"),
        (MapRecipe("scan", "none", 0.5), ("kPa", "kPa2"), "CF-1.11"),
        (MapRecipe("grid", "none", 0.5, units="mbar"), ("mbar", "mbar2"), "CF-1.11"),
        (MapRecipe("grid", "none", 0.5, units="a.u."), ("a.u.", "(a.u.)2"), None),
        (MapRecipe("grid", "none", 0.5), (None, None), None),
    ],
    ids=["divided", "kPa", "mbar", "a user's words", "unknown"],
)
def test_a_file_claims_the_conventions_where_its_units_follow_them(
    recipe: MapRecipe, units: tuple[str | None, ...], conventions: str | None, tmp_path: Path
) -> None:
    write_map(tmp_path / "map.nc", replace(gapped_map(), recipe=recipe), provenance=PROVENANCE)
    with netCDF4.Dataset(tmp_path / "map.nc") as file:
        assert tuple(file[name].__dict__.get("units") for name in ("mean", "variance")) == units
        assert file.__dict__.get("Conventions") == conventions
    assert read_map(tmp_path / "map.nc").recipe == recipe


@pytest.mark.parametrize("engine", ENGINES)
def test_xarray_selects_cells_by_place(written: Path, engine: str, xarray: Any) -> None:
    expected = gapped_map()
    with xarray.open_dataset(written, engine=engine) as cells:
        assert cells["mean"].dims == ("y", "x")
        assert set(cells["mean"].coords) == {"y", "x"}
        assert cells["mean"].sel(x=0.6, y=1.1, method="nearest").item() == expected.mean[4, 4]
        np.testing.assert_array_equal(cells.sel(x=-0.5)["count"], expected.count[:, 2])
        np.testing.assert_array_equal(cells["variance"].sel(x=slice(0, 1)), expected.variance[:, 3:6])


def test_xarray_draws_the_map_over_its_coordinates(written: Path, xarray: Any) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with xarray.open_dataset(written) as cells:
        drawn = cells["mean"].plot()
    try:
        labels = (drawn.axes.get_xlabel(), drawn.axes.get_ylabel())
        assert [label.replace("\n", " ") for label in labels] == [
            "cell centres across the head [mm]", "cell centres along the head [mm]"
        ]  # fmt: skip
        assert drawn.axes.get_xlim() == (-1.75, 2.25)
    finally:
        plt.close(drawn.figure)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_copy_that_xarray_wrote_is_the_same_map(written: Path, engine: str, xarray: Any) -> None:
    with xarray.open_dataset(written, engine=engine) as cells:
        cells.load().to_netcdf(written.with_name("copy.nc"), engine=engine)
    assert_same(read_map(written.with_name("copy.nc")), gapped_map())


@pytest.mark.skipif(shutil.which("ncdump") is None, reason="ncdump is not installed")
def test_ncdump_lists_the_coordinates(written: Path) -> None:
    listed = subprocess.run(["ncdump", "-h", written], capture_output=True, text=True, check=True).stdout
    assert "double x(x)" in listed
    assert "double y(y)" in listed


HAS_NCDF4 = ["Rscript", "-e", "quit(status = !requireNamespace('ncdf4', quietly = TRUE))"]


@pytest.mark.skipif(
    shutil.which("Rscript") is None or subprocess.run(HAS_NCDF4, capture_output=True, check=False).returncode != 0,
    reason="R with ncdf4 is not installed",
)
def test_r_sees_the_coordinates_of_a_dimension(written: Path) -> None:
    script = f'nc <- ncdf4::nc_open("{written}"); cat(nc$dim$x$vals, nc$dim$x$units)'
    said = subprocess.run(["Rscript", "-e", script], capture_output=True, text=True, check=True).stdout
    assert said.split() == [f"{value:g}" for value in gapped_map().x_mm] + ["mm"]


def _renamed(**names: str) -> Callable[[Any], None]:
    return lambda file: [file.renameVariable(old, new) for old, new in names.items()]


def _longer(file: Any) -> None:
    """Cells on an axis of another length than that of their centres."""
    file.renameVariable("count", "once")
    file.createDimension("z", 9)
    file.createVariable("count", "i8", ("y", "z"))[:] = 1


# change -> message
FORMS: dict[str, tuple[Callable[[Any], None], str]] = {
    "without an axis": (_renamed(x="across"), "variable x is missing"),
    "cells on another axis": (_longer, r"variable count has dimensions \('y', 'z'\), not \('y', 'x'\)"),
    "off its lattice": (lambda file: file["x"].__setitem__(0, -9.5), "variable x steps by 0.5 to 8.5 mm"),
    "without findings": (lambda file: file.delncattr("findings"), "header has no findings"),
    "of another schema": (
        lambda file: file.setncattr("schema", "tactile-bayes/map/1"),
        "schema is 'tactile-bayes/map/1'",
    ),
}


@pytest.mark.parametrize("case", FORMS)
def test_a_file_of_another_form_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    change, message = FORMS[case]
    path = tmp_path / "map.nc"
    write_map(path, gapped_map(), provenance=PROVENANCE)
    with netCDF4.Dataset(path, "a") as file:
        change(file)
    with pytest.raises(BadDataError, match=message) as refusal:
        read_map(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert str(refusal.value).endswith("; give a map this program wrote, or make it again with `tactile-bayes map`")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("values", "scale", "message"),
    [
        (np.arange(7) / 2 - 1.5, True, r"mean has shape \(6, 8\); it must be \(6, 7\)"),
        (np.arange(8) / 2 - 1.5, False, r"variable x has dimensions \('',\), not \('x',\)"),
        (np.arange(8), True, "variable x is int64, not float64"),
        (np.zeros((8, 2)), True, "dimension x is missing"),
    ],
    ids=["too short", "no dimension scale", "whole numbers", "two dimensions"],
)
def test_an_axis_that_is_none_is_refused(values: Any, scale: bool, message: str, written: Path) -> None:
    with h5py.File(written, "a") as file:
        for name in ("mean", "variance", "count"):
            file[name].dims[1].detach_scale(file["x"])
        del file["x"]
        file["x"] = values
        if scale:
            file["x"].make_scale("x")
            for name in ("mean", "variance", "count"):
                file[name].dims[1].attach_scale(file["x"])
    with pytest.raises(BadDataError, match=message) as refusal:
        read_map(written)
    assert "\n" not in str(refusal.value)
