"""`estimate` with the calibration that comes with the program, `--pool` and `--known`, as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from posterior_files import MADE, write_calibration, write_maps
from posterior_maps import bump_map, correlated_field, grid_map
from published_schemas import check_document
from settings_files import settings

from tactile_bayes.declarations import from_plain, replace
from tactile_bayes.files.estimate_json import read_stated_size
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.reports import PooledReport
from tactile_bayes.files.size_json import SHIPPED, read_size_calibration, size_calibration_path
from tactile_bayes.report.pooled import pooled_text

FAST = ("--method", "laplace")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("pool")
    write_maps(place)
    write_calibration(place / "eq6.json")
    rng = np.random.default_rng(5)
    for i in range(4):
        noise = 0.01 * rng.standard_normal((51, 51))
        # the fourth is of another, far larger mass
        sigma = (4.0, 4.0) if i < 3 else (9.0, 9.0)
        tactile_map = bump_map(noise=noise, amplitude=0.3, sigma_x=sigma[0], sigma_y=sigma[1])
        write_map(place / f"mass{i + 1}.nc", tactile_map, provenance=MADE)
        if i == 0:
            solved = replace(tactile_map, recipe=replace(tactile_map.recipe, normalise="gain"))
            write_map(place / "gain1.nc", solved, provenance=MADE)
    flat = grid_map(np.ones((41, 41)) + 0.01 * rng.standard_normal((41, 41)), background=None, normalise="none")
    write_map(place / "plain.nc", flat, provenance=MADE)
    return place


@pytest.fixture(scope="module")
def pooled(folder: Path) -> dict:
    done = run_here(
        "estimate", "mass1.nc", "mass2.nc", "mass3.nc", "--pool", "--json", "-o", "post.nc", "--figure", "size.png",
        *FAST, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", SHIPPED)
def test_each_shipped_calibration_opens_and_says_what_it_was_made_of(name: str) -> None:
    path = size_calibration_path(name)
    assert path is not None
    document = json.loads(path.read_text())
    read_size_calibration(path)  # trusted: what comes with the program is held against its schema here
    schemas = {"population": "size_population", "eq6": "size_calibration"}
    check_document(document, f"{schemas[document['form']]}.schema.json")
    assert document["provenance"]["command"].startswith("calibrate size")
    assert document["provenance"]["inputs"]


def test_without_a_word_the_shipped_calibration_is_used_and_named(folder: Path) -> None:
    done = run_here("estimate", "mass1.nc", *FAST, cwd=folder)
    assert done.returncode == 0
    assert "largest size" in done.stdout
    assert "shipped calibration solid-mean" in done.stdout
    document = json.loads(run_here("estimate", "mass1.nc", *FAST, "--json", cwd=folder).stdout)
    assert document["provenance"]["settings"]["size_calibration"] == "solid-mean (shipped)"
    assert document["max_size_mm"]["median"] > 0


def test_maps_normalised_each_way_have_a_calibration_and_are_not_pooled_together(folder: Path) -> None:
    done = run_here("estimate", "gain1.nc", *FAST, "--json", cwd=folder)
    settings = json.loads(done.stdout)["provenance"]["settings"]
    assert settings["size_calibration"] == "solid (shipped)"
    refused = run_here("estimate", "gain1.nc", *FAST, "--size-calibration", "solid-mean", cwd=folder)
    assert refused.returncode == 3
    assert "normalise gain (the calibration: mean)" in refused.stderr
    mixed = run_here("estimate", "gain1.nc", "mass1.nc", "mass2.nc", "--pool", *FAST, cwd=folder)
    assert mixed.returncode == 3
    assert "normalised in several ways (gain, mean); give maps made by one recipe" in mixed.stderr


@pytest.mark.long
def test_a_finer_noise_field_is_recorded_and_hardly_moves_a_clear_lump(folder: Path) -> None:
    """On a map whose noise has a field: where it is white, 18 and 24 cosines differ by a processor's rounding only."""
    noise = 0.02 * correlated_field(np.random.default_rng(5), 51, length_cells=2.0)
    write_map(folder / "rough.nc", bump_map(noise=noise, amplitude=0.3, sigma_x=4.0, sigma_y=4.0), provenance=MADE)
    finer = json.loads(
        run_here("estimate", "rough.nc", *FAST, *settings(folder, field_cosines=24), "--json", cwd=folder).stdout
    )
    default = json.loads(run_here("estimate", "rough.nc", *FAST, "--json", cwd=folder).stdout)
    assert [one["provenance"]["settings"]["field_cosines"] for one in (default, finer)] == ["auto", 24]
    assert [one["diagnostics"]["field_cosines"] for one in (default, finer)] == [18, 24]
    off = finer["sigma_x_mm"]["median"] - default["sigma_x_mm"]["median"]
    assert 1e-4 < abs(off) / default["sigma_x_mm"]["sd"] < 0.3
    for wrong in (5, "fine"):
        refused = run_here("estimate", "mass1.nc", *settings(folder, field_cosines=wrong), cwd=folder)
        assert refused.returncode == 3
        assert "field_cosines" in refused.stderr


def test_none_gives_widths_and_a_map_made_otherwise_says_why_it_has_no_size(folder: Path) -> None:
    done = run_here("estimate", "mass1.nc", *FAST, "--size-calibration", "none", cwd=folder)
    assert "largest size" not in done.stdout
    assert "no size calibration was given" in done.stdout
    other = run_here("estimate", "mass1.nc", *FAST, *settings(folder, fit_radius_mm=15), cwd=folder)
    assert "the shipped calibration does not fit: fit radius 15 mm" in other.stdout
    given = (*settings(folder, fit_radius_mm=15), "--size-calibration", "solid-mean")
    asked = run_here("estimate", "mass1.nc", *FAST, *given, cwd=folder)
    assert asked.returncode == 3
    assert "another recipe" in asked.stderr


def test_a_pooled_mass_keeps_its_schema_and_its_maps(pooled: dict, folder: Path) -> None:
    check_document(pooled, "pooled.schema.json")
    assert pooled["provenance"]["settings"]["calibration"] == "solid-mean (shipped)"
    assert [one["map"] for one in pooled["maps"]] == ["mass1.nc", "mass2.nc", "mass3.nc"]
    alone = json.loads(run_here("estimate", "mass1.nc", *FAST, "--json", cwd=folder).stdout)
    size, another = pooled["max_size_mm"], pooled["another_exam"]["max_size_mm"]
    of_one = alone["another_exam"]["max_size_mm"]
    assert size["low"] < size["median"] < size["high"]
    assert another["low"] < size["low"]
    assert size["high"] < another["high"]
    assert another["high"] - another["low"] < 0.8 * (of_one["high"] - of_one["low"])
    assert sum(pooled["variance_share"].values()) == pytest.approx(100.0)
    assert (folder / "size.png").read_bytes().startswith(b"\x89PNG")


def test_maps_that_do_not_tell_the_depth_of_the_fat_are_pooled_without_and_say_so(pooled: dict) -> None:
    """The bumps of these maps lie on an even pressure, which no body has."""
    assert pooled["fat_mm"] is None
    head, fat, bodies = pooled["left_out"]
    assert "the map does not name its head" in head
    assert fat.startswith("the depth of the fat")
    assert bodies.startswith("bodies unlike the calibration's (lumps 6 to 100 times as stiff as fat")
    report = from_plain(PooledReport, pooled)
    assert f"Left out: {head}; the depth of the fat" in pooled_text(report)
    assert "Fat under the head 12.3 mm deep" in pooled_text(replace(report, fat_mm=12.3, left_out=()))


def test_validate_reads_a_pooled_mass_from_json_and_from_draws(pooled: dict, folder: Path) -> None:
    (folder / "pooled.json").write_text(json.dumps(pooled))
    from_json, from_draws = (read_stated_size(folder / name) for name in ("pooled.json", "post.nc"))
    assert from_json.median == pytest.approx(pooled["max_size_mm"]["median"])
    assert from_draws.median == pytest.approx(from_json.median, rel=1e-6)
    assert from_draws.low == pytest.approx(from_json.low, rel=1e-6)


def test_the_order_of_the_maps_leaves_the_size(pooled: dict, folder: Path) -> None:
    turned = run_here("estimate", "mass3.nc", "mass1.nc", "mass2.nc", "--pool", "--json", *FAST, cwd=folder)
    other = json.loads(turned.stdout)["max_size_mm"]
    sd = pooled["max_size_mm"]["sd"]
    for end in ("median", "low", "high"):
        assert other[end] == pytest.approx(pooled["max_size_mm"][end], abs=0.1 * sd)


def test_a_map_of_another_mass_is_named_and_there_is_no_common_size(folder: Path) -> None:
    done = run_here("estimate", "mass1.nc", "mass2.nc", "mass3.nc", "mass4.nc", "--pool", *FAST, cwd=folder)
    assert done.returncode == 6
    assert "No common size: the maps show different sizes" in done.stdout
    told = "To check: map 4: lies apart from the others: look at this map."
    assert told in done.stdout
    whole = run_here("estimate", "mass1.nc", "mass2.nc", "mass3.nc", "mass4.nc", "--pool", "-v", *FAST, cwd=folder)
    assert whole.stdout.count("lies apart") == whole.stdout.count(told) == 1
    assert "\n4. mass4.nc: " in whole.stdout


@pytest.mark.long
def test_a_mass_seen_on_too_few_maps_gets_no_size(folder: Path) -> None:
    done = run_here("estimate", "a.nc", "empty.nc", "plain.nc", "--pool", *FAST, cwd=folder)
    assert done.returncode in (3, 6)
    some = run_here("estimate", "empty.nc", "--pool", *FAST, cwd=folder)
    assert some.returncode == 6
    assert "No estimate: a lump was found on 0 of 1 maps" in some.stdout


@pytest.mark.long
def test_a_known_seat_moves_the_size(folder: Path) -> None:
    def median(*more: str) -> float:
        done = run_here("estimate", "mass1.nc", *FAST, *settings(folder, between_map_sd=0), "--json", *more, cwd=folder)
        return json.loads(done.stdout)["max_size_mm"]["median"]

    assert median("--known", "seat", "0") > 1.03 * median() > 1.06 * median("--known", "seat", "1.2")


def test_maps_that_no_calibration_fits_alone_are_not_pooled_to_a_size(folder: Path) -> None:
    """The pool's calibration was looked up by the normalisation alone: two such maps got a size, each alone none."""
    done = run_here(
        "estimate", "mass1.nc", "mass2.nc", "--pool", *settings(folder, fit_radius_mm=12.0), *FAST, cwd=folder
    )
    assert done.returncode == 6
    assert "No estimate: map 1: the shipped calibration does not fit: fit radius 12 mm" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["mass1.nc", "--known", "weather", "1"], 2, "no property weather; known are depth_mm"),
        (["mass1.nc", "--known", "depth_mm", "0"], 2, "depth_mm is 0"),
        pytest.param(["mass1.nc", "--known", "seat", "-1"], 2, "seat is -1", marks=pytest.mark.long),
        (["mass1.nc", "--known", "seat", "99"], 2, "seat is 99; give a number from 0 to 2.39"),
        (["mass1.nc", "--known", "thickness_mm", "1e300"], 2, "thickness_mm is 1e+300; give a number from 20.0286 to"),
        (["mass1.nc", "--known", "stiffness_ratio", "2"], 2, "stiffness_ratio is 2; give a number from 3"),
        pytest.param(
            ["mass1.nc", "--known", "depth_mm", "110"],
            2,
            "110; give a number from 1.401 to 107.9",
            marks=pytest.mark.long,
        ),
        (["mass1.nc", "mass2.nc", "--pool", "--size-calibration", "none"], 2, "--pool needs a size calibration"),
        (["mass1.nc", "mass2.nc", "--pool", "--size-calibration", "eq6.json"], 2, "use solid"),
        (["mass1.nc", "mass2.nc", "--pool", "--map-figure", "x.png"], 2, "--map-figure"),
        (["mass1.nc", "broken.nc", "--pool"], 3, "broken.nc"),
    ],
)
def test_mistakes_end_in_one_line(folder: Path, arguments: list[str], code: int, words: str) -> None:
    done = run_here("estimate", *arguments, *FAST, cwd=folder)
    assert (done.returncode, done.stdout) == (code, "")
    assert words in done.stderr
