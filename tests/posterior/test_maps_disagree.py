"""Maps that contradict each other have no pooled size: in every output both sizes, and how improbable that is."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from posterior_maps import bump_values, correlated_field, grid_map
from searched_once import searched_once  # noqa: F401 - all tests of this file use it
from settings_files import settings

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance

FAST = ("--method", "laplace")
SIGMAS = {"a": 4.6, "b": 7.6, "c": 4.7}
"""Width of the bump on each map, mm: b is of a lump of 1.7 times the size."""


def written(path: Path, sigma: float, *, x: float = 2.0, visit: str = "", seed: int = 1) -> None:
    rng = np.random.default_rng(seed)
    values = bump_values(half_mm=35.0, x=x, y=-3.0, sigma_x=sigma, sigma_y=sigma, amplitude=0.3, level=1.0)
    values = values + 0.004 * correlated_field(rng, len(values), length_cells=3.0)
    tactile_map = grid_map(values + 0.004 * rng.standard_normal(values.shape), normalise="gain")
    turn = np.eye(4)
    turn[:2, 3] = 60.0, 90.0
    scans = [{"sha256": f"{seed:064x}", "visit": visit}] if visit else []
    write_map(path, replace(tactile_map, patient_from_plane=turn), provenance=Provenance("map", {}, scans=scans))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("maps")
    for name, sigma in SIGMAS.items():
        written(place / f"{name}.nc", sigma, seed=ord(name))
    written(place / "far.nc", SIGMAS["a"], x=-18.0, seed=9)
    return place


def pooled(folder: Path, *words: object) -> dict:
    return json.loads(run_here("estimate", *words, "--pool", "--json", *FAST, cwd=folder).stdout)


def test_two_sizes_are_listed_as_estimate_gives_them_and_none_is_pooled(folder: Path) -> None:
    done = run_here("estimate", "a.nc", "b.nc", "--pool", *FAST, cwd=folder)
    assert done.returncode == 6
    alone = [json.loads(run_here("estimate", f"{n}.nc", "--json", *FAST, cwd=folder).stdout) for n in "ab"]
    sizes = [one["max_size_mm"] for one in alone]
    both = ", ".join(f"{q['median']:.1f} ({q['low']:.1f} to {q['high']:.1f})" for q in sizes)
    assert f"alone sized at {both} mm, if exams repeat as simulated ones do." in done.stdout
    assert done.stdout.startswith("CAUTION: the maps show different sizes, ")
    assert "with a probability of below 0.001" in done.stdout
    assert "largest size" not in done.stdout
    document = pooled(folder, "a.nc", "b.nc")
    assert (document["status"], document["verdict"]) == ("maps_disagree", "no_answer")
    assert document["max_size_mm"] is None
    assert document["one_size_probability"] < 0.001
    assert [one["max_size_mm"]["median"] for one in document["maps"]] == [q["median"] for q in sizes]


def test_maps_that_agree_are_pooled_and_a_wider_stated_spread_takes_those_that_do_not(folder: Path) -> None:
    """The controls."""
    agree = pooled(folder, "a.nc", "c.nc")
    assert (agree["status"], agree["findings"]) == ("estimate", [])
    assert agree["one_size_probability"] > 0.3
    wide = pooled(folder, "a.nc", "b.nc", *settings(folder, between_map_sd=0.25))
    assert wide["status"] == "estimate"
    assert wide["one_size_probability"] > 0.05


def test_masses_at_two_places_are_not_pooled_though_their_sizes_agree(folder: Path) -> None:
    document = pooled(folder, "a.nc", "far.nc")
    assert document["status"] == "maps_disagree"
    assert document["reason"] == "by the landmarks the masses of the maps lie up to 20 mm apart"
    assert document["one_place_probability"] < 0.01
    assert pooled(folder, "a.nc", "c.nc")["one_place_probability"] > 0.9  # the control


def test_maps_of_two_visits_are_refused_with_the_command_that_takes_them(folder: Path) -> None:
    written(folder / "v1.nc", 4.6, visit="1", seed=11)
    written(folder / "v2.nc", 4.6, visit="2", seed=12)
    done = run_here("estimate", "v1.nc", "v2.nc", "--pool", *FAST, cwd=folder)
    assert done.returncode == 3
    assert "the maps differ in visit (1, 2)" in done.stderr
    assert "`compare` takes several visits" in done.stderr


def test_visits_that_scans_number_are_compared_in_that_order_or_by_their_dates(folder: Path) -> None:
    """Given the other way round a growth would be a shrinkage; the controls have the right order, or dates."""
    written(folder / "w1.nc", 4.6, visit="2", seed=13)
    written(folder / "w2.nc", 4.6, visit="10", seed=14)
    done = run_here("compare", "w2.nc", "--with", "w1.nc", *FAST, cwd=folder)
    assert done.returncode == 2
    assert "in the scans visit 1 is coded 10, visit 2 is coded 2; give visits in order of time" in done.stderr
    dated = ("w2.nc", "--with", "w1.nc", "--dates", "2026-01-01,2026-02-01")
    for words in (("w1.nc", "--with", "w2.nc"), dated):
        assert run_here("compare", *words, *FAST, cwd=folder).returncode == 0


def test_python_and_the_page_tell_both_sizes(folder: Path, tmp_path: Path) -> None:
    result = tb.pool([folder / "a.nc", folder / "b.nc"], method="laplace")
    assert result.document["status"] == "maps_disagree"
    assert result.why.startswith("the maps show different sizes, ")
    tb.exam_report([folder / "a.nc", folder / "b.nc"], tmp_path / "page.html", method="laplace")
    text = (tmp_path / "page.html").read_text()
    assert '<p class="finding">The maps show different sizes, ' in text
    assert text.count("alone the largest diameter is about") == 2
    assert "size of all maps" not in text


def test_an_export_of_maps_that_disagree_holds_no_size_and_says_why(folder: Path) -> None:
    done = run_here("estimate", "a.nc", "b.nc", "--pool", "--json", *FAST, cwd=folder)
    (folder / "pooled.json").write_text(done.stdout)
    for kind in ("csv", "fhir"):
        made = run_here("export", "pooled.json", "--to", kind, "--patient-id", "P1", "-o", kind, cwd=folder)
        assert made.returncode == 0, made.stderr
        assert "the maps show different sizes, " in (folder / kind).read_text()
    assert "valueQuantity" not in (folder / "fhir").read_text()


def test_a_campaign_leaves_the_pooled_size_out_and_its_cards_say_why(folder: Path) -> None:
    rows = ["file,patient,visit,mass,replicate", "a.nc,P1,1,1,1", "b.nc,P1,1,1,2", "c.nc,P2,1,1,1"]
    (folder / "exams.csv").write_text("\n".join(rows) + "\n")
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "masses whose exams disagree, without a pooled size: P1.v1.m1" in done.stdout
    with (folder / "out" / "trial.csv").open(newline="") as file:
        trial = {(row["patient"], row["modality"]): row for row in csv.DictReader(file)}
    assert trial["P1", "tactile-pooled"]["status"] == "not_done"  # it was found: it does not count as missed
    assert trial["P1", "tactile-pooled"]["reason"].startswith("the maps show different sizes, ")
    assert trial["P2", "tactile-pooled"]["status"] == "detected"
    page = (folder / "out" / "index.html").read_text()
    assert page.count("CAUTION: the maps show different sizes") == 1
    assert "<div>the maps show different sizes, " in page  # in place of the size


def test_compare_warns_where_the_maps_of_one_visit_disagree(folder: Path) -> None:
    done = run_here("compare", "a.nc", "b.nc", "--with", "c.nc", *FAST, cwd=folder)
    assert "CAUTION: visit 1: its maps show different sizes; one mass gives maps so far apart" in done.stdout
    control = run_here("compare", "a.nc", "c.nc", "--with", "b.nc", *FAST, cwd=folder)
    assert "its maps show different sizes" not in control.stdout


@pytest.mark.long
def test_maps_that_cannot_show_a_lump_do_not_read_as_maps_without_one(tmp_path: Path) -> None:
    """Cells of 10 mm; the control is the same level in cells of 1 mm."""
    rng = np.random.default_rng(4)
    for name, cells, side in (("c1", 9, 10.0), ("c2", 9, 10.0), ("f1", 61, 1.0), ("f2", 61, 1.0)):
        values = 1.0 + 0.01 * rng.standard_normal((cells, cells))
        tactile_map = grid_map(values, cell_mm=side, normalise="gain")
        write_map(tmp_path / f"{name}.nc", tactile_map, provenance=Provenance("map", {}))
    coarse, fine = pooled(tmp_path, "c1.nc", "c2.nc"), pooled(tmp_path, "f1.nc", "f2.nc")
    assert coarse["reason"] == "map 1: the data cannot show whether there is a lump: its cells of 10 mm are too large"
    assert fine["reason"] == "a lump was found on 0 of 2 maps"
