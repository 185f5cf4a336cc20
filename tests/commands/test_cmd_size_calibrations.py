"""Which calibration fits which map, as a user meets it: sizes, refusals that name the way out, and cautions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.api.size_calibration import table_cautions
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path, write_size_calibration

DEMO = Path(tb.__file__).parent / "demo"
TRUE_MM = 15.0  # the scene of the demo


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of the demo's scan, with one gain per frame and of frames divided by their means; the phantoms' Eq 6."""
    path = tmp_path_factory.mktemp("calibrations")
    for name, words in (("gain.nc", ()), ("mean.nc", ("--normalise", "mean"))):
        assert run_here("map", DEMO / "scan.mcap", "-o", name, *words, cwd=path).returncode == 0
    return path


def test_eq6_sizes_a_default_map_and_prints_its_constants(folder: Path) -> None:
    words = ("estimate", "gain.nc", "--size-calibration", "eq6", "--method", "laplace")
    done = run_here(*words, "--json", cwd=folder)
    size = json.loads(done.stdout)["max_size_mm"]
    assert size["low"] < TRUE_MM < size["high"]
    assert size["median"] == pytest.approx(TRUE_MM, rel=0.2)
    told = run_here(*words, "-v", cwd=folder).stdout
    assert "Eq 6 for this map: m " in told
    assert "fat under the head" in told
    assert "CAUTION" not in told


def test_eq6_pools_maps_and_python_has_it_by_name(folder: Path) -> None:
    done = run_here("estimate", "gain.nc", "--pool", "--size-calibration", "eq6", "--json", cwd=folder)
    pooled = json.loads(done.stdout)["max_size_mm"]["median"]
    found = tb.estimate(folder / "gain.nc", size_calibration="eq6")
    assert found.max_size_mm is not None
    assert pooled == pytest.approx(found.max_size_mm.median, rel=0.02)


@pytest.mark.parametrize(
    ("tactile_map", "calibration", "command"),
    [
        ("gain.nc", "plane-strain", "map --normalise mean"),
        ("mean.nc", "eq6", "map --normalise gain"),
    ],
)
def test_a_map_made_otherwise_is_refused_with_the_command_that_makes_it(folder, tactile_map, calibration, command):
    done = run_here("estimate", tactile_map, "--size-calibration", calibration, cwd=folder)
    assert done.returncode == 3
    assert f"make the map again with `{command}`" in done.stderr


@pytest.mark.long
def test_a_calibration_of_cylinders_of_one_seat_says_so_first(folder: Path) -> None:
    words = ("estimate", "mean.nc", "--method", "laplace", "--size-calibration")
    first = run_here(*words, "plane-strain", cwd=folder).stdout.splitlines()[0]
    assert first.startswith("CAUTION: ")
    assert "one seat (centred)" in first
    assert "balls come out 40 to 110 % too large" in first
    # the control: a calibration over all seats has no such line
    assert not run_here(*words, "solid-mean", cwd=folder).stdout.startswith("CAUTION")


def test_lumps_of_one_kind_are_remembered_and_lumps_that_differ_are_not() -> None:
    mixed = {"seat": ["centred", "resting"], "sigma_y_mm": [3.0, 4.0], "stiffness_ratio": [8.0, 100.0]}
    mixed |= {"d_mm": [5.0, 25.0]}
    assert table_cautions(mixed) == ()
    assert "if its diameters are in cm" in table_cautions(mixed | {"d_mm": [0.5, 2.5]})[0]
    assert "one seat (centred)" in table_cautions(mixed | {"seat": ["centred"] * 2})[0]
    assert "one width" in table_cautions(mixed | {"sigma_y_mm": [None, None]})[0]
    soft = mixed | {"stiffness_ratio": [2.0, 100.0]}
    assert "soft lumps" in table_cautions(soft)[0]
    assert table_cautions(soft, least_stiffness_ratio=8.0) == ()
    unknown = {name: [None, None] for name in mixed} | {"sigma_y_mm": [3.0, 4.0], "d_mm": [5.0, 25.0]}
    assert table_cautions(unknown) == ()


def test_a_table_of_which_no_lump_is_left_says_why(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("d_mm,amplitude,sigma_x_mm,stiffness_ratio\n10,0.4,3.4,20\n")
    words = ("calibrate", "size", "t.csv", "-o", "s.json", "--least-stiffness-ratio", 100)
    refused = run_here(*words, cwd=tmp_path)
    assert refused.returncode == 3
    assert "softer than 100; give others, or a lower --least-stiffness-ratio" in refused.stderr


def test_a_file_keeps_its_cautions(tmp_path: Path) -> None:
    shipped = read_size_calibration(size_calibration_path("plane-strain") or Path())
    columns = {"seat": ["centred"], "sigma_y_mm": [None], "stiffness_ratio": [8.0], "d_mm": [10.0]}
    assert shipped.cautions == table_cautions(columns)
    write_size_calibration(tmp_path / "again.json", shipped, provenance=Provenance("test", {}, {}))
    assert read_size_calibration(tmp_path / "again.json").cautions == shipped.cautions


def test_optimise_says_why_it_has_no_size_on_a_default_map(folder: Path) -> None:
    done = run_here("estimate", "gain.nc", "--method", "optimise", cwd=folder)
    assert done.returncode == 0
    assert "No size: optimise is the paper's least squares" in done.stdout
    assert "--method laplace --size-calibration eq6" in done.stdout
    asked = run_here("estimate", "gain.nc", "--method", "optimise", "--size-calibration", "eq6", cwd=folder)
    assert asked.returncode == 2
    assert "a calibration learned by least squares" in asked.stderr


@pytest.mark.slow
@pytest.mark.parametrize("calibration", ["solid", "eq6", "solid-mean", "plane-strain", "phantoms"])
def test_the_shared_scan_without_a_lump_is_sized_by_no_calibration(shared_data: Path, tmp_path: Path, calibration: str):
    used = calibration
    if calibration == "phantoms":
        used = "phantoms.json"
        assert run_here("calibrate", "size", shared_data / "phantoms.csv", "-o", used, cwd=tmp_path).returncode == 0
    path = size_calibration_path(used)
    assert path is not None
    normalise = read_size_calibration(tmp_path / path).recipe.normalise
    assert run_here("import", shared_data / "scans" / "s08_no_mass.npz", "-o", "s.mcap", cwd=tmp_path).returncode == 0
    assert run_here("map", "s.mcap", "-o", "m.nc", "--normalise", normalise, cwd=tmp_path).returncode == 0
    done = run_here("estimate", "m.nc", "--size-calibration", used, "--json", cwd=tmp_path)
    assert done.returncode == 6
    assert json.loads(done.stdout)["max_size_mm"] is None
