"""Side and landmarks that disagree: one function decides, and every report, file and page says it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_map

import tactile_bayes as tb
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import rigid
from tactile_bayes.report.lump_place import side_caution

FAST = ("--method", "laplace")
WORDS = (
    "the scan says left breast, and the landmarks put the lump 60 mm to the patient's right of the xiphoid: side or "
    "landmarks are wrong"
)


@pytest.mark.parametrize(
    ("side", "place", "told"),
    [
        ("left", (60.0, 90.0), WORDS),
        ("right", (-31.4, 90.0), WORDS.replace("left", "RIGHT").replace("right of", "left of").replace("60", "31")),
        ("left", (-60.0, 90.0), ""),
        ("right", (60.0, 90.0), ""),
        ("left", (19.9, 90.0), ""),
        ("left", (20.1, 90.0), WORDS.replace("60", "20")),
        ("", (60.0, 90.0), ""),
        ("phantom", (60.0, 90.0), ""),
        ("left", None, ""),
    ],
)
def test_it_is_told_where_both_are_known_and_disagree(side: str, place: tuple[float, float] | None, told: str) -> None:
    assert side_caution(side, place) == told.replace("RIGHT", "right")


def write(path: Path, *, seed: int, side: str, visit: str = "1") -> None:
    """A map whose lump lies 60 mm to the patient's right of the xiphoid."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal((51, 51))
    made = bump_map(noise=noise, amplitude=0.3, x=0.0, y=0.0, sigma_x=4.0, sigma_y=4.0)
    made = replace(made, patient_from_plane=rigid(np.eye(3), np.array([60.0, 90.0, 0.0])))
    scans = [{"sha256": f"{seed:064x}", "side": side, "posture": "supine", "visit": visit}]
    write_map(path, made, provenance=Provenance("test", {}, scans=scans))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("side")
    write(place / "left.nc", seed=1, side="left")
    write(place / "left2.nc", seed=2, side="left", visit="2")
    write(place / "right.nc", seed=3, side="right")
    for name in ("left", "right"):
        done = run_here("estimate", f"{name}.nc", *FAST, "--json", "-o", f"{name}_post.nc", cwd=place)
        (place / f"{name}.json").write_text(done.stdout)
    return place


def of_estimate(folder: Path, *words: object) -> Any:
    return json.loads(run_here("estimate", *words, *FAST, "--json", cwd=folder).stdout)


def test_the_text_the_full_text_and_the_json_of_an_estimate_say_it(folder: Path) -> None:
    assert of_estimate(folder, "left.nc")["side_caution"] == WORDS
    assert of_estimate(folder, "right.nc")["side_caution"] == ""
    for more in ((), ("-v",)):
        told = run_here("estimate", "left.nc", *FAST, *more, cwd=folder).stdout
        assert told.startswith(f"CAUTION: {WORDS}")
        assert "landmarks" not in run_here("estimate", "right.nc", *FAST, *more, cwd=folder).stdout
    assert tb.estimate(folder / "left.nc", method="laplace").answer.text.startswith(f"CAUTION: {WORDS}")


def test_a_pooled_size_and_a_comparison_say_it_of_each_map(folder: Path) -> None:
    pooled = of_estimate(folder, "--pool", "left.nc", "left2.nc")
    assert [one["broken_assumptions"] for one in pooled["maps"]] == [[WORDS], [WORDS]]
    assert f"CAUTION: left.nc: {WORDS}" in run_here("estimate", "--pool", "left.nc", "left2.nc", cwd=folder).stdout
    done = run_here("compare", "left.nc", "--with", "left2.nc", *FAST, cwd=folder)
    assert f"visit 1: {WORDS}" in done.stdout, done.stderr


def test_exports_and_the_page_say_it(folder: Path, tmp_path: Path) -> None:
    for name, told in (("left", True), ("right", False)):
        for number, file in enumerate((f"{name}.json", f"{name}_post.nc")):
            out = tmp_path / f"{name}{number}.csv"
            assert run_here("export", folder / file, "--to", "csv", "-o", out, cwd=folder).returncode == 0
            with out.open(newline="") as lines:
                (row,) = csv.DictReader(lines)
            assert (WORDS in row["tb_caution"]) is told
        for files in ((f"{name}.nc",), (f"{name}.nc", f"{name}.json"), (f"{name}_post.nc",)):
            page = tmp_path / f"{len(files)}{files[0]}.html"
            done = run_here("report", *files, "-o", page, cwd=folder)
            assert done.returncode == 0, done.stderr
            assert (page.read_text().count("landmarks put the lump") == 1) is told


def test_an_estimate_of_an_earlier_version_is_judged_by_its_place(folder: Path, tmp_path: Path) -> None:
    document = json.loads((folder / "left.json").read_text())
    del document["side_caution"]
    (tmp_path / "old.json").write_text(json.dumps(document))
    run_here("report", "old.json", "-o", "old.html", cwd=tmp_path)
    assert "landmarks put the lump 60 mm" in (tmp_path / "old.html").read_text()


def test_a_campaign_lists_it_among_the_cautions(folder: Path, tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / f"{name}.nc").write_bytes((folder / f"{name}.nc").read_bytes())
    (tmp_path / "exams.csv").write_text(
        "file,patient,visit,mass,replicate,side\nleft.nc,1,1,1,1,left\nright.nc,2,1,1,1,right\n"
    )
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=tmp_path)
    with (tmp_path / "out" / "exams_done.csv").open(newline="") as lines:
        told = {row["patient"]: row["cautions"] for row in csv.DictReader(lines)}
    assert WORDS in told["1"], done.stderr
    assert "landmarks" not in told["2"]
