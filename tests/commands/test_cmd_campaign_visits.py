"""`campaign run` with several visits of a mass: the trial is of the last one, growth stands beside it."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from campaign_files import FAST, rows_of
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from posterior_maps import bump_values, correlated_field, grid_map

from tactile_bayes.campaigns.exams import masses_with_visits, stated_days, visit_dates
from tactile_bayes.declarations import replace
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.tables import read_table

HEAD = "file,patient,visit,mass,replicate,date,side"
WIDTHS = {"P1": (4.6, 6.2), "P2": (5.0, 5.0)}
"""Sigma of the bump at each visit, mm: one mass grows, and is felt higher, one stays."""


def written(path: Path, *, sigma: float, seed: int, landmarks: bool = True) -> None:
    rng = np.random.default_rng(seed)
    shape = {"x": 2.0, "y": -3.0, "sigma_x": sigma, "sigma_y": sigma, "amplitude": 0.3 * (sigma / 5.0) ** 2}
    values = bump_values(half_mm=35.0, **shape, level=1.0)
    values = values + 0.004 * correlated_field(rng, len(values), length_cells=3.0)
    tactile_map = grid_map(values + 0.004 * rng.standard_normal(values.shape), normalise="gain")
    turn = np.eye(4)
    turn[:2, 3] = 60.0, 90.0
    made = Provenance("import", {})
    write_map(path, replace(tactile_map, patient_from_plane=turn if landmarks else None), provenance=made)


def rows(visits: tuple[str, str] = ("1", "2"), dates: tuple[str, str] = ("2026-01-10", "2026-04-10")) -> list[str]:
    return [
        f"{patient}-{visit}-{exam}.nc,{patient},{visits[visit]},1,{exam},{dates[visit]},left"
        for patient in WIDTHS for visit in (0, 1) for exam in (1, 2)
    ]  # fmt: skip


def campaign(folder: Path, lines: list[str], *more: object):  # type: ignore[no-untyped-def]
    (folder / "exams.csv").write_text("\n".join((HEAD, *lines)) + "\n")
    return run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, *more, cwd=folder)


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("visits")
    for p, (patient, widths) in enumerate(WIDTHS.items()):
        for visit, sigma in enumerate(widths):
            for exam in (1, 2):
                written(folder / f"{patient}-{visit}-{exam}.nc", sigma=sigma, seed=100 * p + 10 * visit + exam)
    (folder / "ex.csv").write_text("patient,mass,ex_vivo_mm,date\nP1,1,20,2026-04-12\nP2,1,15,2026-04-12\n")
    return folder


@pytest.fixture(scope="module")
def done(maps: Path) -> tuple[Path, str]:
    made = campaign(maps, rows(), "--excision", "ex.csv")
    assert made.returncode == 0, made.stderr
    return maps / "out", made.stdout


@pytest.mark.long
def test_the_report_is_of_the_last_visit_and_says_so(done: tuple[Path, str]) -> None:
    out, told = done
    assert "4 visits of 2 masses pooled, each by itself: 4 sized, 0 without a size" in told
    assert "2 masses were read at several visits: the last one before excision is analysed" in told
    assert "readings left out: 6 of earlier visits" in told
    report = json.loads((out / "report.json").read_text())
    trial = rows_of(out / "trial.csv")
    tactile = [row for row in trial if row["modality"] == "tactile"]
    assert report["counts"]["readings"] == 6
    assert report["modalities"]["tactile"]["readings"] == 4
    assert report["modalities"]["tactile"]["within_mass_cv_percent"] < 5.0
    grown = {row["visit"]: float(row["size_mm"]) for row in tactile if row["patient"] == "P1"}
    assert grown["2"] > 1.2 * grown["1"]  # the growth that would be in it


@pytest.mark.long
def test_growth_is_compared_by_itself_and_stands_beside_the_report(done: tuple[Path, str]) -> None:
    out, told = done
    assert "growth of 2 masses with several visits: 1 grown, 1 no change shown (growth.csv)" in told
    table = rows_of(out / "growth.csv")
    assert [(row["patient"], row["verdict"], row["days"]) for row in table] == [
        ("P1", "grown", "90.0"), ("P2", "no_change_shown", "90.0"),
    ]  # fmt: skip
    assert len(read_table(out / "growth.csv", "growth.table.json")) == 2
    assert [*table[0]] == [one["name"] for one in load_schema("growth.table.json")["fields"]]
    for page in ("index.html", "report.html"):
        text = (out / page).read_text()
        assert "no change shown" in text
        assert 'href="growth/P1.m1/growth.html"' in text
    growth = (out / "growth" / "P1.m1" / "growth.html").read_text()
    assert '<p class="finding">The mass has grown.</p>' in growth
    assert "Visit 2, 2026-04-10" in growth


@pytest.mark.long
def test_growth_is_what_compare_gives_of_the_maps(done: tuple[Path, str], maps: Path) -> None:
    out, _ = done
    exams = [f"out/exams/P1.v{v}.m1.r{r}/map.nc" for v in (1, 2) for r in (1, 2)]
    options = ("--days", "90", *FAST, "--json")
    told = json.loads(run_here("compare", *exams[:2], "--with", *exams[2:], *options, cwd=maps).stdout)
    ours = json.loads((out / "growth" / "P1.m1" / "compare.json").read_text())
    assert ours["changes"] == told["changes"]
    assert ours["trend"] == told["trend"]


@pytest.mark.long
def test_a_second_run_does_nothing_and_another_date_compares_again(done: tuple[Path, str], maps: Path) -> None:
    assert done[0].exists()
    again = campaign(maps, rows(), "--excision", "ex.csv").stdout
    assert "0 steps run" in again
    later = campaign(maps, rows(dates=("2026-01-10", "2026-04-11")), "--excision", "ex.csv").stdout
    assert "6 steps run" in later  # the pages of the exams at that date too
    assert "compare run: P1.m1, P2.m1" in later
    assert "several days" not in later
    mixed = campaign(maps, [rows()[0].replace("-10,", "-12,"), *rows()[1:]]).stdout
    assert "exams of one visit on several days, the last of which counts: P1.v1.m1" in mixed


@pytest.mark.long
def test_visits_without_an_order_and_an_excision_before_all_are_refused_before_any_work(maps: Path) -> None:
    undated = [line.replace("2026-01-10", "").replace("2026-04-10", "") for line in rows(("pre", "post"))]
    named = campaign(maps, undated)
    assert named.returncode == 3
    assert "line 4, column visit: pre and post of one mass do not say which was first" in named.stderr
    (maps / "early.csv").write_text("patient,mass,ex_vivo_mm,date\nP1,1,20,2025-12-01\n")
    early = campaign(maps, rows(), "--excision", "early.csv")
    assert early.returncode == 3
    assert "table of exams, line 2, column date: visit 1 is after excision on" in early.stderr


def test_visits_keep_their_order_and_days_when_the_exam_that_states_one_failed() -> None:
    stated = {("post", 1): date(2026, 4, 10), ("pre", 1): None, ("pre", 2): date(2026, 1, 10)}
    exams = [Exam("a.nc", Path("a.nc"), "P1", visit, "1", number, day) for (visit, number), day in stated.items()]
    (visits,) = masses_with_visits(exams[:2], stated_days(exams)).values()
    days = visit_dates(visits, stated_days(exams))
    assert [*days.items()] == [("pre", date(2026, 1, 10)), ("post", date(2026, 4, 10))]


@pytest.mark.long
def test_one_visit_has_no_growth_landmarks_are_not_needed_and_findings_have_the_tables_codes(tmp_path: Path) -> None:
    for visit, sigma in enumerate(WIDTHS["P1"]):
        written(tmp_path / f"P1-{visit}-1.nc", sigma=sigma, seed=visit, landmarks=False)
    lines = [line for line in rows(("pre", "post")) if line.startswith("P1") and "-1.nc" in line]
    one = campaign(tmp_path, lines[:1]).stdout
    assert "growth" not in one
    assert not (tmp_path / "out" / "growth.csv").exists()
    (tmp_path / "ex.csv").write_text("patient,mass,ex_vivo_mm,date\nP1,1,20,2026-02-01\n")
    failed = "gone.nc,P1,pre,1,1,2026-01-10,left"  # the exam that alone says when its visit was
    undated = lines[0].replace(",1,1,2026-01-10", ",1,2,")
    both = campaign(tmp_path, [failed, undated, lines[1]], "--excision", "ex.csv").stdout
    assert "1 grown (growth.csv)" in both
    assert "visits after excision, left out of the report and in growth.csv with a caution: P1.vpost.m1" in both
    (row,) = rows_of(tmp_path / "out" / "growth.csv")
    pooled = [row["date"] for row in rows_of(tmp_path / "out" / "trial.csv") if row["modality"] == "tactile-pooled"]
    assert pooled == ["2026-04-10", "2026-01-10"]
    assert (row["earlier_visit"], row["later_visit"], row["days"]) == ("pre", "post", "90.0")
    assert "CAUTION: no landmarks show where the mass of visit 1 (coded pre) lies" in row["findings"]
    excised = "visit 2 (coded post) of 2026-04-10 is after the excision (2026-02-01)"
    assert row["findings"].startswith(f"CAUTION: {excised}")
    (page,) = (tmp_path / "out" / "growth").rglob("growth.html")
    assert excised in page.read_text()
    campaign(tmp_path, lines[:1])  # files that this run would not make go
    assert not (tmp_path / "out" / "growth").exists()
