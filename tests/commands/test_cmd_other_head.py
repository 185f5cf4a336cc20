"""Maps and calibrations of heads other than the paper's, as a user meets them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from in_process import run_here
from map_files import assert_same
from posterior_files import MADE
from posterior_maps import bump_map

from tactile_bayes.actions import simulation as population
from tactile_bayes.api.size_calibration import table_recipe
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.files.tables import Sheet, Table, read_table
from tactile_bayes.forward.scene import Head, Lump, Scene, Strokes
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.mapping.build import build_map
from tactile_bayes.options import LearnOptions
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape
from tactile_bayes.studies.population import ExamRow, head_columns

FLAT = Head(rows=12, columns=12, pitch_mm=2.0, radius_mm=100_000.0)
FINGER = Head(rows=10, columns=10, pitch_mm=1.5, radius_mm=20.0)
FAST = ("--method", "laplace")


def shape_of(head: Head) -> HeadShape:
    return HeadShape.of(head.surface_mm(), head.pitch_mm)


def row(body: int, exam: int, head: Head) -> ExamRow:
    """A row whose size follows the map: ln d = 2.6 + 0.3 ln a + ln sigma - 1.4."""
    rng = np.random.default_rng([0, body])
    log_a, log_s, seat = rng.normal(-1, 0.8), rng.normal(1.4, 0.4), rng.uniform(0, 1.2)
    d = float(np.exp(2.6 + 0.3 * log_a + log_s - 1.4 + rng.normal(0, 0.05)))
    shape = (float(np.exp(log_a)), float(np.exp(log_s)), float(np.exp(log_s)))
    made = ExamRow(body, exam, d, 1.0, 30.0, float(seat), 5.0, 10.0, 60.0, 9.5, True, *shape, 1e-4, 0, 0, 1e-4, 0, 1e-4)
    return replace(made, normalise="gain", **head_columns(head))


def write_table(path: Path, heads: Callable[[int], Head]) -> None:
    path.write_text(
        population.population_csv([row(body, exam, heads(body)) for body in range(40) for exam in range(2)])
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("heads")
    noise = 0.005 * np.random.default_rng(5).standard_normal((51, 51))
    plain = bump_map(noise=noise, amplitude=0.3, sigma_x=4.0, sigma_y=4.0)
    plain = replace(plain, recipe=replace(plain.recipe, normalise="gain"))
    for name, head in (("old", None), ("paper", DEFAULT_HEAD), ("flat", shape_of(FLAT)), ("finger", shape_of(FINGER))):
        write_map(place / f"{name}.nc", replace(plain, head=head), provenance=MADE)
    write_table(place / "flat.csv", lambda _: FLAT)
    write_table(place / "paper.csv", lambda _: Head())
    write_table(place / "mixed.csv", lambda body: FLAT if body < 20 else FINGER)
    done = run_here("calibrate", "size", "flat.csv", "-o", "eq6.json", cwd=place)
    assert done.returncode == 0, done.stderr
    assert "head 12 x 12 taxels, 2 mm apart, flat, rim 3 mm" in done.stdout
    return place


@pytest.mark.parametrize("head", [FLAT, FINGER, Head()])
def test_a_map_names_the_head_that_made_it(tmp_path: Path, head: Head) -> None:
    scene = Scene(duration_s=2.0, lumps=(Lump(),), head=head, strokes=Strokes(lines=2, half_length_mm=15.0))
    made = build_map(simulate(scene, rng=np.random.default_rng(1)).scan)
    assert made.head == shape_of(head)
    write_map(tmp_path / "map.nc", made, provenance=MADE)
    assert_same(read_map(tmp_path / "map.nc"), made)
    shown = run_here("show", "map.nc", "--json", cwd=tmp_path)
    assert json.loads(shown.stdout)["head"]["rows"] == head.rows


def test_scans_of_two_heads_are_no_map() -> None:
    strokes = Strokes(lines=2, half_length_mm=15.0)
    scans = [
        simulate(Scene(duration_s=2.0, head=head, strokes=strokes), rng=np.random.default_rng(1)).scan
        for head in (FLAT, FINGER)
    ]
    with pytest.raises(BadDataError, match="scan 2 was made by another head"):
        build_map(scans)


@pytest.mark.parametrize("text", ['{"rows": 0, "columns": 3}', '{"legs": 4}', "3", "{"])
def test_a_map_with_a_head_that_is_none_is_refused(folder: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "map.nc").write_bytes((folder / "flat.nc").read_bytes())
    with h5py.File(tmp_path / "map.nc", "r+") as file:
        file.attrs["head"] = text
    done = run_here("estimate", "map.nc", cwd=tmp_path)
    assert done.returncode == 3
    assert "attribute head" in done.stderr or "header.head" in done.stderr


def test_a_calibration_knows_its_head_and_bodies_from_the_table(folder: Path) -> None:
    found = read_size_calibration(folder / "eq6.json")
    assert found.recipe.head == replace(shape_of(FLAT), rim_mm=3.0)
    assert found.bodies["fat_kpa"] == (5.0, 5.0)
    assert 0 <= found.bodies["seat"][0] < found.bodies["seat"][1] <= 1.2
    shown = run_here("show", "eq6.json", cwd=folder).stdout
    assert "12 x 12 taxels, 2 mm apart, flat" in shown
    assert "thickness_mm" in shown


def test_a_table_of_the_papers_head_teaches_for_it_and_one_that_names_none_teaches_nothing(
    folder: Path, tmp_path: Path
) -> None:
    run_here("calibrate", "size", folder / "paper.csv", "-o", "paper.json", cwd=tmp_path)
    assert read_size_calibration(tmp_path / "paper.json").recipe.head == replace(DEFAULT_HEAD, rim_mm=3.0)
    columns, *rows = ((line.split(",")) for line in (folder / "paper.csv").read_text().splitlines())
    at = columns.index("head_rows")
    blank = [",".join([*cells[:at], "", *cells[at + 1 :]]) for cells in rows]
    (tmp_path / "none.csv").write_text("\n".join([",".join(columns), *blank]) + "\n")
    done = run_here("calibrate", "size", "none.csv", "-o", "none.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "head_rows" in done.stderr


def test_a_table_of_two_heads_teaches_nothing(folder: Path, tmp_path: Path) -> None:
    done = run_here("calibrate", "size", folder / "mixed.csv", "-o", "m.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "several heads" in done.stderr
    assert not (tmp_path / "m.json").exists()


@pytest.mark.parametrize(
    ("name", "calibration"),
    [("flat", "solid"), ("finger", "solid"), ("flat", "eq6"), ("paper", "eq6.json")],
)
def test_a_calibration_for_another_head_is_refused_with_the_way_to_the_right_one(
    folder: Path, name: str, calibration: str
) -> None:
    done = run_here("estimate", f"{name}.nc", "--size-calibration", calibration, *FAST, cwd=folder)
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1
    assert "(the calibration: " in done.stderr
    assert "tactile-bayes population --head HEAD.json" in done.stderr
    assert "tactile-bayes calibrate size" in done.stderr
    assert ("give --size-calibration solid or eq6, which are for this head" in done.stderr) == (name == "paper")


@pytest.mark.parametrize(("name", "calibration"), [("flat", "eq6.json"), ("paper", "solid")])
def test_a_calibration_for_this_head_gives_a_size(folder: Path, name: str, calibration: str) -> None:
    done = run_here("estimate", f"{name}.nc", "--size-calibration", calibration, *FAST, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["max_size_mm"] is not None
    assert not any("name its head" in text for text in document["left_out"])


def test_without_a_named_calibration_another_head_has_widths_only(folder: Path) -> None:
    done = run_here("estimate", "flat.nc", *FAST, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["max_size_mm"] is None
    assert document["sigma_x_mm"] is not None
    assert "12 x 12 taxels" in document["reason"]
    assert "population --head" in document["advice"]


def test_a_map_that_names_no_head_is_sized_and_the_report_says_so(folder: Path) -> None:
    old, named = (
        json.loads(run_here("estimate", f"{name}.nc", *FAST, "--json", cwd=folder).stdout) for name in ("old", "paper")
    )
    assert old["max_size_mm"] == named["max_size_mm"]
    assert any("the map does not name its head" in text for text in old["left_out"])


def test_maps_of_another_head_are_not_pooled(folder: Path) -> None:
    done = run_here("estimate", "flat.nc", "finger.nc", "--pool", *FAST, cwd=folder)
    assert done.returncode == 3
    assert "the calibration is for another head" in done.stderr
    pooled = run_here("estimate", "old.nc", "paper.nc", "--pool", *FAST, "--json", cwd=folder)
    assert pooled.returncode == 0, pooled.stderr
    assert any("the map does not name its head" in text for text in json.loads(pooled.stdout)["left_out"])


def lumps(columns: str, *cells: str) -> Table:
    text = "".join(
        f"{line}\n" for line in (f"d_mm,amplitude,sigma_x_mm{columns}", *(f"10,0.3,4{one}" for one in cells))
    )
    return read_table(Sheet(Path("lumps.csv"), text), "size_table.table.json")


def test_a_table_of_phantoms_may_name_its_head() -> None:
    asked = LearnOptions()
    named = ",head_rows,head_columns,head_pitch_mm,head_radius_mm"
    assert table_recipe(lumps("", ""), asked).head is None
    assert table_recipe(lumps(named, ",12,12,2,", ",12,12,2,"), asked).head == HeadShape(12, 12, 2.0, None)
    assert table_recipe(lumps(named, ",16,26,1.5,35"), asked).head == DEFAULT_HEAD
    with pytest.raises(BadDataError, match="names a head without head_pitch_mm"):
        table_recipe(lumps(named, ",12,12,,"), asked)
    with pytest.raises(BadDataError, match="head_rows differs between rows"):
        table_recipe(lumps(named, ",12,12,2,", ",16,12,2,"), asked)


@pytest.mark.slow
def test_bodies_under_another_head_are_simulated(tmp_path: Path) -> None:
    (tmp_path / "head.json").write_text(
        json.dumps({"schema": "tactile-bayes/head/1", "pitch_mm": 2, "rows": 8, "columns": 8, "radius_mm": None})
    )
    (tmp_path / "bodies.toml").write_text("[bodies]\nd_mm = [12, 12]\ndepth_ratio = [0.7, 0.7]\n")
    given = ("--head", "head.json", "--bodies", "bodies.toml", "--masses", "2", "--scans", "1", "--workers", "1")
    done = run_here("population", *given, "-o", "t.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    header, *rows = [line.split(",") for line in (tmp_path / "t.csv").read_text().splitlines()]
    found = [dict(zip(header, cells, strict=True)) for cells in rows]
    assert [(one["d_mm"], one["head_rows"], one["head_pitch_mm"], one["head_radius_mm"]) for one in found] == [
        ("12", "8", "2", "")
    ] * 2


@pytest.mark.parametrize(
    ("option", "text", "words"),
    [("--head", '{"schema": "tactile-bayes/head/1", "rows": 3}', "pitch_mm"), ("--bodies", "d = 3", "d is not known")],
)
def test_a_population_refuses_what_is_no_head_and_no_bodies(tmp_path: Path, option: str, text: str, words: str) -> None:
    (tmp_path / "file").write_text(text)
    done = run_here("population", option, "file", "--masses", "1", "-o", "t.csv", cwd=tmp_path)
    assert done.returncode == 3
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "t.csv").exists()
