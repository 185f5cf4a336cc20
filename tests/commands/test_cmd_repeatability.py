"""`calibrate repeatability` and `--repeatability`: learned from a campaign's folder, used by one map and by several."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from published_schemas import check_document
from repeated_exams import shape, write_done, write_exam, write_repeats

import tactile_bayes as tb
from tactile_bayes.files.size_json import size_calibration_path

FAST = ("--method", "laplace")
DEMO = Path(tb.__file__).parent / "demo"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the demo's map, repeats of ten masses with a spread of 8 %, and what was learned from them."""
    folder = tmp_path_factory.mktemp("site")
    write_repeats(folder / "out", 10)
    run_here("map", DEMO / "scan.mcap", "-o", "map.nc", cwd=folder)
    done = run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "said.txt").write_text(done.stdout)
    return folder


@pytest.mark.long
def test_a_repeatability_is_learned_from_a_campaigns_folder(site: Path) -> None:
    document = json.loads((site / "site.json").read_text())
    assert document["low"] < 0.08 < document["high"]
    assert (document["masses"], document["maps"]) == (10, 30)
    assert document["calibration"] | {"sha256": ""} == {"name": "solid", "sha256": "", "normalise": "gain"}
    assert document["half_width"]["with_it"] > document["half_width"]["as_estimated"]
    assert [one["role"] for one in document["provenance"]["inputs"]][:2] == ["size_calibration", "draws_1"]
    said = (site / "said.txt").read_text()
    assert f"Exams of one mass differ by {100 * document['median']:.1f} % at this site (95 %: " in said
    assert "Learned from 10 masses and 30 exams, sized by solid (frames normalised by gain)." in said
    assert "; the narrower one of its own report is +-" in said
    assert said.endswith("Research use only: not a diagnostic device.\n")
    assert (site / "site.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.long
def test_show_describes_the_file(site: Path) -> None:
    shown = run_here("show", "site.json", cwd=site).stdout
    assert "spread between exams of one mass at a site" in shown
    assert "at this site, by 10 masses and 30 exams" in shown
    assert "draws_1" not in shown


@pytest.mark.long
def test_an_estimate_by_it_has_one_interval_and_says_whose(site: Path) -> None:
    told = run_here("estimate", "map.nc", *FAST, "--repeatability", "site.json", cwd=site)
    assert told.returncode == 0, told.stderr
    assert "if exams differ by" not in told.stdout
    assert "at this site, by 10 masses and 30 exams" in told.stdout
    full = run_here("estimate", "map.nc", *FAST, "--repeatability", "site.json", "-v", cwd=site)
    assert "The interval is for any exam of the mass: exams of one mass differ by" in full.stdout
    as_json = run_here("estimate", "map.nc", *FAST, "--repeatability", "site.json", "--json", cwd=site)
    document = json.loads(as_json.stdout)
    learned = json.loads((site / "site.json").read_text())
    assert document["another_exam"] is None
    assert document["diagnostics"]["between_map_sd"] == pytest.approx(learned["between_map_sd"], rel=0.03)
    assert document["provenance"]["settings"]["repeatability"]["masses"] == 10
    assert "repeatability" in [one["role"] for one in document["provenance"]["inputs"]]
    plain = json.loads(run_here("estimate", "map.nc", *FAST, "--json", cwd=site).stdout)
    assert "repeatability" not in plain["provenance"]["settings"]
    assert document["max_size_mm"]["sd"] > plain["max_size_mm"]["sd"]
    assert document["max_size_mm"]["median"] == pytest.approx(plain["max_size_mm"]["median"], rel=0.02)


@pytest.mark.long
def test_a_pooled_size_has_it_as_the_prior_of_its_maps(site: Path, tmp_path: Path) -> None:
    shutil.copy(site / "map.nc", tmp_path)
    shutil.copy(site / "site.json", tmp_path)
    run_here("simulate", DEMO / "scene.toml", "--seed", 2, "-o", "two.mcap", cwd=tmp_path)
    run_here("map", "two.mcap", "-o", "two.nc", cwd=tmp_path)
    words = ("estimate", "map.nc", "two.nc", "--pool", *FAST, "--repeatability", "site.json")
    document = json.loads(run_here(*words, "--json", cwd=tmp_path).stdout)
    assert document["another_exam"] is None
    assert document["repeatability"].endswith("by 10 masses and 30 exams")
    assert document["provenance"]["settings"]["repeatability"]["maps"] == 30
    told = run_here(*words, cwd=tmp_path).stdout
    assert "at this site, by 10 masses and 30 exams" in told
    found = tb.pool([tmp_path / "map.nc", tmp_path / "two.nc"], method="laplace", repeatability=tmp_path / "site.json")
    assert found.document["max_size_mm"] == document["max_size_mm"]


@pytest.mark.long
def test_a_comparison_is_at_the_sites_repeatability(site: Path, tmp_path: Path) -> None:
    """With one exam a visit the sizes' variance has twice that of an exam, which sites of 8 and 2 % give; the
    amplitudes' change, a second witness, takes a part of it away."""
    for name in ("map.nc", "site.json"):
        shutil.copy(site / name, tmp_path)
    run_here("simulate", DEMO / "scene.toml", "--seed", 2, "-o", "two.mcap", cwd=tmp_path)
    run_here("map", "two.mcap", "-o", "two.nc", cwd=tmp_path)
    write_repeats(tmp_path / "alike", 10, spread=0.02)
    run_here("calibrate", "repeatability", "alike", "-o", "alike.json", cwd=tmp_path)
    words = ("compare", "map.nc", "--with", "two.nc", *FAST)
    found, spread = {}, {}
    for name in ("site", "alike"):
        done = run_here(*words, "--repeatability", f"{name}.json", "--json", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        document = json.loads(done.stdout)
        check_document(document, "compare.schema.json")
        spread[name] = json.loads((tmp_path / f"{name}.json").read_text())["between_map_sd"]
        assert document["between_map_sd"] == pytest.approx(spread[name], rel=0.1)
        assert document["provenance"]["settings"]["repeatability"]["masses"] == 10
        assert "repeatability" in [one["role"] for one in document["provenance"]["inputs"]]
        (found[name],) = document["changes"]
        assert found[name]["another_exam"] is None
    least = {name: np.log1p(one["smallest_detectable_percent"]["growth"] / 100) / 1.96 for name, one in found.items()}
    apart = 2 * (spread["site"] ** 2 - spread["alike"] ** 2)
    assert 0.5 * apart < least["site"] ** 2 - least["alike"] ** 2 < apart
    plain = run_here(*words, cwd=tmp_path).stdout
    assert "If exams of one mass differ by" in plain
    told = run_here(*words, "--repeatability", "site.json", cwd=tmp_path).stdout
    assert "at this site, by 10 masses and 30 exams; the figures above are for such exams." in told
    assert "If exams of one mass differ by" not in told
    by_python = tb.compare(tmp_path / "map.nc", tmp_path / "two.nc", method="laplace", repeatability=site / "site.json")
    assert by_python.document["changes"][0] == found["site"]
    refused = run_here(*words, "--repeatability", "site.json", "--size-calibration", "eq6", cwd=tmp_path)
    assert (refused.returncode, refused.stderr.count("\n")) == (3, 1)
    assert "the repeatability is of sizes by solid" in refused.stderr


@pytest.mark.long
def test_python_learns_and_uses_a_repeatability(site: Path, tmp_path: Path) -> None:
    found = tb.calibrate_repeatability(site / "out", path=tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (site / "site.json").read_bytes()
    by_object = tb.estimate(site / "map.nc", method="laplace", repeatability=found)
    by_path = tb.estimate(site / "map.nc", method="laplace", repeatability=site / "site.json")
    assert by_object.max_size_another_exam_mm is None
    assert by_object.max_size_mm.interval(0.95) == by_path.max_size_mm.interval(0.95)


def test_too_few_masses_are_refused_with_the_reason(tmp_path: Path) -> None:
    write_repeats(tmp_path / "out", 2)
    done = run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "2 masses have repeated exams with sizes; give at least 3: one or two masses do not tell" in done.stderr
    assert not (tmp_path / "site.json").exists()


def test_exams_of_one_scan_and_without_a_size_are_no_repeats_and_visits_are_apart(tmp_path: Path) -> None:
    out = write_repeats(tmp_path / "out", 3, maps=2)
    path, rng = size_calibration_path("solid"), np.random.default_rng(1)
    far = shape(np.log(9.0), sd=0.01, rng=rng)
    write_exam(out / "exams" / "01.v1.m1.r3", far, path, name="01.v1.m1.r1")  # the scan of exam 1 again
    write_exam(out / "exams" / "02.v1.m1.r3", far, path, name="x", sized=False)
    write_exam(out / "exams" / "03.v2.m1.r1", far, path, name="y")  # another visit: the lump may have grown
    rows = [f"0{mass},1,1,{replicate}" for mass in (1, 2, 3) for replicate in (1, 2)]
    write_done(out, rows)
    run_here("calibrate", "repeatability", "out", "-o", "without.json", cwd=tmp_path)
    write_done(out, [*rows, "01,1,1,3", "02,1,1,3", "03,2,1,1"])
    done = run_here("calibrate", "repeatability", "out", "-o", "with.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    left_out = ["01.v1.m1.r3: of the same scan as 01.v1.m1.r1", "02.v1.m1.r3: it has no size (no calibration)"]
    assert f"Took no part: {'; '.join(left_out)}." in done.stdout
    without, given = (json.loads((tmp_path / name).read_text()) for name in ("without.json", "with.json"))
    assert given["left_out"] == left_out
    assert {**given, "left_out": []} == without


def test_a_mass_that_lies_apart_and_few_masses_are_cautions(tmp_path: Path) -> None:
    out = write_repeats(tmp_path / "out", 4, spread=0.03)
    path, rng = size_calibration_path("solid"), np.random.default_rng(1)
    write_exam(out / "exams" / "02.v1.m1.r4", shape(np.log(12.0), sd=0.01, rng=rng), path, name="x")
    rows = [f"0{mass},1,1,{replicate}" for mass in (1, 2, 3, 4) for replicate in (1, 2, 3)]
    write_done(out, [*rows, "02,1,1,4"])
    said = run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=tmp_path).stdout
    assert said.startswith(
        "CAUTION: exams lie further apart than the other masses lead one to expect; look at the maps"
    )
    assert ": 02.v1.m1 (probability by chance " in said
    assert "CAUTION: 4 masses are few" in said


def refusal(site: Path, *words: object) -> tuple[int, str]:
    done = run_here("estimate", "map.nc", *FAST, "--repeatability", "site.json", *words, cwd=site)
    assert done.stderr.count("\n") == 1, done.stderr
    return done.returncode, done.stderr


@pytest.mark.long
def test_another_calibration_normalisation_or_a_stated_spread_is_refused(site: Path) -> None:
    code, told = refusal(site, "--size-calibration", "eq6")
    assert code == 3
    assert "of sizes by solid (frames normalised by gain), and this size is by eq6 (frames normalised by gain)" in told
    (site / "spread.toml").write_text("between_map_sd = 0.1\n")
    code, told = refusal(site, "--settings", "spread.toml")
    assert code == 2
    assert "between_map_sd states the spread that the repeatability has learned; give one of them" in told
    code, told = refusal(site, "--size-calibration", "none")
    assert code == 2
    run_here("map", DEMO / "scan.mcap", "-o", "mean.nc", "--normalise", "mean", cwd=site)
    done = run_here("estimate", "mean.nc", *FAST, "--repeatability", "site.json", cwd=site)
    assert done.returncode == 3
    assert "and this size is by solid-mean (frames normalised by mean)" in done.stderr


@pytest.mark.long
def test_a_file_of_another_kind_and_a_calibration_that_did_not_size_are_refused(site: Path, tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"schema": "tactile-bayes/plan/1"}')
    done = run_here("estimate", site / "map.nc", "--repeatability", "x.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "is a trial plan (JSON), not a site's repeatability (JSON)" in done.stderr
    words = ("calibrate", "repeatability", site / "out", "-o", "new.json")
    done = run_here(*words, "--size-calibration", "eq6", cwd=tmp_path)
    assert done.returncode == 3
    assert "eq6 is not the calibration that the exams were sized by" in done.stderr
    done = run_here("calibrate", "repeatability", tmp_path, "-o", "new.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "holds no exams_done.csv; give a folder of `campaign run`" in done.stderr
    done = run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=site)
    assert done.returncode == 2


def test_exams_by_several_calibrations_are_refused(tmp_path: Path) -> None:
    out = write_repeats(tmp_path / "out", 3)
    path = out / "exams" / "02.v1.m1.r2" / "estimate.json"
    path.write_text(path.read_text().replace("solid (shipped)", "eq6").replace('"sha256": "', '"sha256": "0', 1))
    done = run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "the exams were sized by 2 calibrations (01.v1.m1.r1 by solid, 02.v1.m1.r2 by eq6)" in done.stderr


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        ("patient,visit,mass\n01,v1,m1\n", "exams_done.csv: has no column 'replicate'; run the campaign again"),
        ("patient,visit,mass,replicate\n../x,1,1,1\n", "exams_done.csv: names an exam '../x.v1.m1.r1'; run the"),
        ("patient,visit,mass,replicate\n1,1,1,1\n1,1,1,1\n", "exams_done.csv: names the exam 1.v1.m1.r1 twice; run"),
        ("patient,visit,mass,replicate\n0\0" + "1,1,1,1\n", r"names an exam '0\x001.v1.m1.r1'; run the campaign again"),
        ("patient,visit,mass,replicate\n01,1,1,1\n01,1,1,2\n", "exams/01.v1.m1.r1/estimate.json: cannot be read"),
    ],
    ids=["a column less", "out of the folder", "a row twice", "a NUL", "without its exams"],
)
def test_a_damaged_table_of_exams_is_refused_in_one_line(tmp_path: Path, table: str, fault: str) -> None:
    (tmp_path / "exams_done.csv").write_text(table)
    done = run_here("calibrate", "repeatability", ".", "-o", "site.json", cwd=tmp_path)
    assert done.returncode == 3
    assert fault in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "site.json").exists()
