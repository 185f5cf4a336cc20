"""Map files: any map comes back as it was, equal maps are equal bytes, and every fault is one line."""

from __future__ import annotations

import json
import math
import shutil
import stat
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from map_files import PROVENANCE, assert_same, plain_map
from mapping_scans import rotation

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.map_nc import SCHEMA, read_map, read_map_and_header, write_map
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.map import MapRecipe, TactileMap

FINITE = st.floats(-1e12, 1e12)  # larger ones are refused where a file is read
MODERATE = st.floats(-1e6, 1e6)
CHARACTERS = st.characters(exclude_categories=["Cs", "Cc", "Cf", "Zl", "Zp"])  # those that reading refuses


@st.composite
def transforms(draw) -> np.ndarray | None:
    if draw(st.booleans()):
        return None
    turn = rotation(draw(st.floats(-180, 180)), about=draw(st.sampled_from([(0, 0, 1), (1, 2, 3)])))
    return rigid(turn, np.array([draw(MODERATE) for _ in range(3)]))


@st.composite
def maps(draw) -> TactileMap:
    """Any map, the odd ones included: no cell, one cell, no data, huge and tiny values."""
    shape = (draw(st.integers(0, 5)), draw(st.integers(0, 5)))
    count = draw(arrays(np.int64, shape, elements=st.integers(0, 2**62)))
    mean, variance = (draw(arrays(np.float64, shape, elements=FINITE)) for _ in range(2))
    cell = draw(st.floats(1e-3, 1e3))
    return TactileMap(
        mean=np.where(count > 0, mean, np.nan),
        variance=np.where(count > 0, variance, np.nan),
        count=count,
        x_mm=(draw(st.integers(-99, 99)) + np.arange(shape[1])) * cell,
        y_mm=(draw(st.integers(-99, 99)) + np.arange(shape[0])) * cell,
        recipe=MapRecipe(
            draw(st.sampled_from(["scan", "grid"])),
            draw(st.sampled_from(["mean", "gain", "none"])),
            cell,
            draw(st.none() | st.tuples(MODERATE, MODERATE)),
            draw(MODERATE),
        ),
        plane_from_base=draw(transforms()),
        patient_from_plane=draw(transforms()),
        background=draw(st.none() | FINITE),
        frame_count=draw(st.integers(0, 2**40)),
        quality=draw(st.dictionaries(st.text(CHARACTERS, max_size=9), FINITE, max_size=4)),
        masked_taxels=tuple(draw(st.lists(st.text(CHARACTERS, max_size=30), max_size=4))),
    )


@given(tactile_map=maps())
def test_any_map_comes_back_bit_for_bit(tactile_map, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.nc"
    write_map(path, tactile_map, provenance=PROVENANCE)
    assert_same(read_map(path), tactile_map)


def test_equal_maps_are_equal_bytes_for_the_owner_only(tmp_path):
    for name in ("a.nc", "b.nc"):
        write_map(tmp_path / name, plain_map(), provenance=PROVENANCE)
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()
    assert stat.S_IMODE((tmp_path / "a.nc").stat().st_mode) == 0o600
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.nc", "b.nc"]


def test_bytes_do_not_depend_on_when_a_reference_goes(tmp_path, monkeypatch):
    # HDF5 gives chunks their place when an array is closed; a profiler that holds the writer's frames delays that
    write_map(tmp_path / "a.nc", plain_map(), provenance=PROVENANCE)
    held = []

    def held_array(group, *names, **options):
        held.append(create(group, *names, **options))
        return held[-1]

    create = h5py.Group.create_dataset
    monkeypatch.setattr(h5py.Group, "create_dataset", held_array)
    write_map(tmp_path / "b.nc", plain_map(), provenance=PROVENANCE)
    assert len(held) > 5
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


def test_an_existing_file_stays_without_force(tmp_path):
    path = tmp_path / "map.nc"
    path.write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        write_map(path, plain_map(), provenance=PROVENANCE)
    assert path.read_text() == "mine"
    write_map(path, plain_map(), provenance=PROVENANCE, force=True)
    assert_same(read_map(path), plain_map())


def test_unknown_figures_come_back_as_nan(tmp_path):
    write_map(tmp_path / "map.nc", replace(plain_map(), quality={"tilt_deg": math.nan}), provenance=PROVENANCE)
    assert math.isnan(read_map(tmp_path / "map.nc").quality["tilt_deg"])


def test_the_header_says_what_the_file_is(tmp_path):
    write_map(tmp_path / "map.nc", plain_map(), provenance=PROVENANCE)
    _, header = read_map_and_header(tmp_path / "map.nc")
    assert header.schema == SCHEMA
    assert header.recipe == plain_map().recipe
    assert header.provenance == json.loads(json.dumps(PROVENANCE.as_dict()))


def test_other_programs_see_units_and_axes(tmp_path):
    write_map(tmp_path / "map.nc", replace(plain_map(), recipe=MapRecipe("scan", "none", 1.0)), provenance=PROVENANCE)
    with netCDF4.Dataset(tmp_path / "map.nc") as file:
        assert file["mean"].dimensions == ("y", "x")
        assert {name: file[name].units for name in ("mean", "variance", "count", "x")} == {
            "mean": "kPa", "variance": "kPa2", "count": "1", "x": "mm"
        }  # fmt: skip


def test_a_map_off_its_lattice_is_not_written(tmp_path):
    with pytest.raises(BadDataError, match="x_mm steps by 2 to 2 mm"):
        write_map(tmp_path / "map.nc", replace(plain_map(), x_mm=2.0 * np.arange(8)), provenance=PROVENANCE)
    assert not list(tmp_path.iterdir())


def test_an_axis_of_one_huge_value_is_off_its_lattice(tmp_path):
    """Its rounding would be as large as the cells, and the estimate ended in a singular matrix."""
    with pytest.raises(BadDataError, match="x_mm steps by 0 to 0 mm"):
        write_map(tmp_path / "map.nc", replace(plain_map(), x_mm=np.full(8, -1e9)), provenance=PROVENANCE)


def _edit(change):
    """Change an open file."""

    def apply(path: Path) -> None:
        with netCDF4.Dataset(path, "a") as file:
            change(file)

    return apply


def _recipe(**fields):
    def change(file) -> None:
        file.setncattr("recipe", json.dumps(json.loads(file.recipe) | fields))

    return _edit(change)


def _cut(share: float):
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def _flip(path: Path) -> None:
    """One bit in each packed variable."""
    data = bytearray(path.read_bytes())
    for start in range(len(data) - 20):
        if data[start : start + 2] == b"\x78\x5e":
            data[start + 12] ^= 1
    path.write_bytes(bytes(data))


UPRIGHT = rigid(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
FAULTS = {
    "text": (lambda path: path.write_text("mean,count\n"), "not a readable netCDF file"),
    "empty": (lambda path: path.write_bytes(b""), "not a readable netCDF file"),
    "cut short": (_cut(0.5), "not a readable netCDF file"),
    "no file": (Path.unlink, "cannot be read .*check the path"),
    "a directory": (lambda path: (path.unlink(), path.mkdir()), "is a directory"),
    "another file": (_edit(lambda file: file.delncattr("schema")), "header has no schema; give a map"),
    "a later schema": (
        _edit(lambda file: file.setncattr("schema", "tactile-bayes/map/9")),
        "schema is 'tactile",
    ),
    "no mean": (_edit(lambda file: file.renameVariable("mean", "average")), "variable mean is missing"),
    "no dimension": (
        _edit(lambda file: (file.renameDimension("y", "rows"), file.renameVariable("y", "rows"))),
        "dimension y is missing",
    ),
    "a coordinate of another dimension": (
        _edit(lambda file: file.renameDimension("y", "rows")),
        r"variable y has dimensions \('rows',\), not \('y',\)",
    ),
    "broken JSON": (_edit(lambda file: file.setncattr("quality", "{")), "attribute quality is not JSON"),
    "quality in words": (
        _edit(lambda file: file.setncattr("quality", '{"a": "b"}')),
        "header.quality.a is 'b'; give",
    ),
    "quality a list": (_edit(lambda file: file.setncattr("quality", "[]")), r"header.quality is \[\]"),
    "infinite background": (
        _edit(lambda file: file.setncattr("background", "Infinity")),
        "attribute background is inf",
    ),
    "no cell": (_recipe(cell_mm=0), "recipe.cell_mm is 0"),
    "unknown recipe": (_recipe(normalise="median"), "recipe.normalise is 'median'"),
    "half a window": (_recipe(pressure_window_kpa=[5]), r"recipe.pressure_window_kpa is \[5\]"),
    "another cell": (_recipe(cell_mm=2.0), "steps by 1 to 1 mm, not by the cell of 2 mm"),
    "negative count": (_edit(lambda file: file["count"].__setitem__((0, 0), -1)), "count holds -1"),
    "infinite mean": (_edit(lambda file: file["mean"].__setitem__((0, 0), np.inf)), "infinite values"),
    "an axis of NaN": (
        _edit(lambda file: file["x"].__setitem__(0, np.nan)),
        "variable x holds values that are not finite",
    ),
    "landmarks through the plane": (
        lambda path: write_map(
            path, replace(plain_map(), patient_from_plane=UPRIGHT), provenance=PROVENANCE, force=True
        ),
        "patient_from_plane has sternal notch and xiphoid on a line through the plane",
    ),
    "no rotation": (_edit(lambda file: file["plane_from_base"].__setitem__((0, 0), 2.0)), "not a rigid transform"),
    "a flipped bit": (_flip, "not a readable netCDF file"),
}


@pytest.mark.parametrize(("spoil", "message"), FAULTS.values(), ids=FAULTS)
def test_a_file_with_a_fault_is_refused_in_one_line_that_names_it(spoil, message, tmp_path):
    path = tmp_path / "map.nc"
    write_map(path, plain_map(), provenance=PROVENANCE)
    spoil(path)
    with pytest.raises(BadDataError, match=message) as refusal:
        read_map(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


def _foreign(path: Path, kind: str = "f8", dimensions=("y", "x"), size: int = 3) -> None:
    """A map with another variable in the place of `count`."""
    source = path.with_name("source.nc")
    write_map(source, plain_map(), provenance=PROVENANCE)
    with netCDF4.Dataset(source) as old, netCDF4.Dataset(path, "w") as new:
        new.setncatts(old.__dict__)
        for name in old.dimensions:
            new.createDimension(name, size if name in ("y", "x") else 4)
        for name, variable in old.variables.items():
            new.createVariable(name, kind if name == "count" else variable.dtype,
                               dimensions if name == "count" else variable.dimensions)  # fmt: skip
            if name != "count" and size == 3:
                new[name][:] = np.arange(size) if name in ("x", "y") else 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "f8"}, "count is float64, not int64"),
        ({"kind": "i8", "dimensions": ("x", "y")}, "count has dimensions"),
        ({"kind": "i8", "size": 5000}, "has 25,000,000 cells, over"),
    ],
)
def test_variables_of_another_kind_are_refused_before_they_are_read(options, message, tmp_path):
    path = tmp_path / "map.nc"
    _foreign(path, **options)
    with pytest.raises(BadDataError, match=message):
        read_map(path)


def test_a_damaged_copy_leaves_the_original_readable(tmp_path):
    write_map(tmp_path / "map.nc", plain_map(), provenance=PROVENANCE)
    shutil.copy(tmp_path / "map.nc", tmp_path / "copy.nc")
    _cut(0.9)(tmp_path / "copy.nc")
    with pytest.raises(BadDataError):
        read_map(tmp_path / "copy.nc")
    assert_same(read_map(tmp_path / "map.nc"), plain_map())
