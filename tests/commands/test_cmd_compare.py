"""`compare` as a user runs it: growth, no change, refusals with their reason, figures, and the same from Python."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from posterior_maps import bump_map
from published_schemas import check_document
from scipy.special import ndtri
from settings_files import settings

import tactile_bayes as tb
from tactile_bayes.api.comparing import compare_answers
from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.estimate import number_groups
from tactile_bayes.declarations import from_plain, replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import rigid
from tactile_bayes.options import CompareOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import CompareReport, compare_summary, growths, verdict
from tactile_bayes.report.pages import signed
from tactile_bayes.size.visits import Change

FAST = ("--method", "laplace")
MASS = (-70.0, 80.0)


def write(
    path: Path,
    *,
    sigma: float,
    seed: int,
    amplitude: float = 0.3,
    place: tuple[float, float] | None = MASS,
    **session: str,
) -> None:
    """A map of a bump whose middle lies at a place of the patient; None for a map without landmarks."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal((51, 51))
    shape = {"x": 0.0, "y": 0.0, "sigma_x": sigma or 4.0, "sigma_y": sigma or 4.0}
    made = bump_map(noise=noise, amplitude=amplitude if sigma else 0.0, **shape)
    if place is not None:
        angle = 0.3 * seed  # the head was held another way each time
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        made = replace(made, patient_from_plane=rigid(turn, np.array([*place, 0.0])))
    scans = [{"sha256": f"{seed:064x}", **session}] if session else []
    write_map(path, made, provenance=Provenance("test", {}, scans=scans))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("compare")
    for i in range(2):
        write(place / f"a{i}.nc", sigma=4.0, seed=i, subject="p1", side="left")
        write(place / f"same{i}.nc", sigma=4.0, seed=10 + i)
        write(place / f"grown{i}.nc", sigma=4.4, amplitude=0.55, seed=20 + i, subject="p1")
        write(place / f"bare{i}.nc", sigma=4.0, seed=30 + i, place=None)
    write(place / "far.nc", sigma=4.0, seed=40, place=(MASS[0] + 30.0, MASS[1]))
    write(place / "other.nc", sigma=4.0, seed=41, subject="p2")
    write(place / "right.nc", sigma=4.0, seed=42, side="right")
    write(place / "empty.nc", sigma=0.0, seed=43)
    return place


def run(folder: Path, *words: object):
    return run_here("compare", *words, *FAST, cwd=folder)


@pytest.fixture(scope="module")
def grown(folder: Path) -> dict:
    done = run(folder, "a0.nc", "a1.nc", "--with", "grown0.nc", "grown1.nc", "--days", 100, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    check_document(document, "compare.schema.json")
    return document


def test_a_bump_that_became_higher_and_a_little_wider_has_grown(grown: dict) -> None:
    """As a lump of one body does: the amplitude goes by 1.8, as d squared, and the width by 1.1."""
    (change,) = grown["changes"]
    assert change["verdict"] == "grown"
    assert 20 < change["percent"]["median"] < 50
    assert change["probability_grown"] > 0.995
    rate = change["growth_rate"]["percent_per_day"]
    assert rate["median"] == pytest.approx(3 * change["log_ratio"]["median"], rel=1e-6)
    doubling = change["growth_rate"]["doubling_days"]["median"]
    assert doubling == pytest.approx(np.log(2) / (rate["median"] / 100), rel=1e-6)
    assert [one["distance_mm"] for one in grown["places"]] == [pytest.approx(0.0, abs=1.0)]
    assert [len(one["maps"]) for one in grown["visits"]] == [2, 2]
    assert grown["provenance"]["settings"]["size_calibration"] == "solid-mean (shipped)"
    assert [scan.get("side") for scan in grown["provenance"]["scans"]] == ["left", "left", None, None]


def test_the_change_is_known_better_than_from_two_separate_estimates(folder: Path, grown: dict) -> None:
    variance = 0.0
    for maps in (("a0.nc", "a1.nc"), ("grown0.nc", "grown1.nc")):
        alone = json.loads(run_here("estimate", *maps, "--pool", "--json", *FAST, cwd=folder).stdout)["max_size_mm"]
        variance += (alone["sd"] / alone["mean"]) ** 2
    assert grown["changes"][0]["log_ratio"]["sd"] < 0.7 * np.sqrt(variance)


def test_the_same_bump_shows_no_change_and_says_what_would_not_have_been_seen(folder: Path) -> None:
    done = run(folder, "a0.nc", "a1.nc", "--with", "same0.nc", "same1.nc")
    assert done.returncode == 0, done.stderr
    assert "No change shown; a growth of less than " in done.stdout
    assert " can stay unseen; larger ones too, if exams differ as those of patients did." in done.stdout
    assert "The mass has" not in done.stdout
    lines = done.stdout.splitlines()
    assert len(lines) <= 12
    assert lines[-1] == RESEARCH_USE


@pytest.mark.long
@pytest.mark.parametrize(
    ("later", "words"),
    [
        ("far.nc", "the masses of visits 1 and 2 lie 30 mm apart"),
        ("other.nc", "the scans name different patients: p1 (visit 1), p2 (visit 2)"),
        ("right.nc", "the scans name different sides: left (visit 1), right (visit 2)"),
        ("bare0.nc", "no landmarks show where the mass of visit 2 lies"),
        ("empty.nc", "a lump was found on 0 of 1 maps of visit 2"),
        ("empty.nc", "Visit 2: no lump found on"),
    ],
)
def test_visits_that_are_not_shown_to_be_of_one_mass_are_refused_with_the_reason(
    folder: Path, later: str, words: str
) -> None:
    done = run(folder, "a0.nc", "--with", later)
    assert done.returncode == 6
    assert words in done.stdout
    assert "Change of the diameter" not in done.stdout
    assert done.stdout.splitlines()[-1] == RESEARCH_USE
    document = json.loads(run(folder, "a0.nc", "--with", later, "--json").stdout)
    check_document(document, "compare.schema.json")
    assert document["status"] == ("no_estimate" if later == "empty.nc" else "not_one_mass")
    assert document["changes"] == []


@pytest.mark.parametrize("later", ["far.nc", "bare0.nc"])
def test_a_user_may_say_that_it_is_one_mass_and_the_report_says_who_said_so(folder: Path, later: str) -> None:
    done = run(folder, "a0.nc", "--with", later, "--same-mass")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("CAUTION: ")
    assert "because you say so" in done.stdout.splitlines()[0]


@pytest.mark.parametrize("later", ["other.nc", "right.nc"])
def test_nobody_may_say_it_against_the_scans(folder: Path, later: str) -> None:
    assert run(folder, "a0.nc", "--with", later, "--same-mass").returncode == 6


def test_a_looser_registration_allows_more_distance(folder: Path) -> None:
    assert run(folder, "a0.nc", "--with", "far.nc", "--registration-mm", 15).returncode == 0


def test_three_visits_have_a_trend_and_dates_do_as_well_as_days(folder: Path) -> None:
    visits = ("a0.nc", "--with", "same0.nc", "--with", "grown0.nc", "grown1.nc")
    dated = json.loads(run(folder, *visits, "--dates", "2026-01-01,2026-01-31,2026-04-11", "--json").stdout)
    days = json.loads(run(folder, *visits, "--days", 30, "--days", 100, "--json").stdout)
    assert dated["trend"] == days["trend"]
    assert dated["trend"]["visits"] == 3
    assert dated["trend"]["percent_per_day"]["low"] > 0
    assert len(dated["changes"]) == 2
    assert "Trend over 3 visits in 100 days" in run(folder, *visits, "--days", 30, "--days", 100, "-v").stdout


def test_a_stated_spread_between_exams_widens_the_change_and_leaves_one_interval(folder: Path, grown: dict) -> None:
    stated = settings(folder, between_map_sd=0.15)
    done = run(folder, "a0.nc", "a1.nc", "--with", "grown0.nc", "grown1.nc", *stated, "--json")
    (change,) = json.loads(done.stdout)["changes"]
    learned = grown["changes"][0]["log_ratio"]["sd"]
    most = np.hypot(0.15, learned)  # 0.15 sqrt(2 / 2 maps) on top of the rest, were it not for the amplitudes
    assert 0.75 * most < change["log_ratio"]["sd"] < 1.02 * most
    assert change["log_ratio"]["sd"] > 1.5 * learned
    assert change["another_exam"] is None
    assert grown["changes"][0]["another_exam"]["between_map_sd"] > 0.05


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("a0.nc", "--with", "a0.nc"), 2, "a0.nc is given twice"),
        (("a0.nc", "--with"), 2, "--with names no map"),
        (("a0.nc",), 2, "Missing option '--with'"),
        (("a0.nc", "--with", "same0.nc", "--days", 3, "--days", 9), 2, "times are given for 2 later visits"),
        (("a0.nc", "--with", "same0.nc", "--days", -3), 2, "each later than the one before"),
        (("a0.nc", "--with", "same0.nc", "--days", 20260301), 2, "0, 20260301, a century and more; give days since"),
        (
            ("a0.nc", *" ".join(f"--with no{i}.nc" for i in range(10)).split()),
            2,
            "11 visits are given; compare 2 to 10",
        ),
        (("a0.nc", "--with", "same0.nc", "--dates", "2026-01-01,soon"), 2, "'soon' is no date"),
        (("a0.nc", "--with", "same0.nc", "--days", 3, "--dates", "2026-01-01,2026-02-01"), 2, "give one of them"),
        (("a0.nc", "--with", "same0.nc", "--size-calibration", "none"), 2, "needs a size calibration"),
        (("a0.nc", "--with", "same0.nc", "--pdf", "g.pdf"), 2, "--pdf prints the page that --output names"),
        (("a0.nc", "--with", "no.nc"), 3, "no.nc"),
    ],
)
def test_visits_that_cannot_be_compared_are_one_clear_line(folder: Path, words: tuple, code: int, told: str) -> None:
    done = run(folder, *words)
    assert done.returncode == code
    assert told in done.stderr
    assert done.stdout == ""


def test_maps_that_no_calibration_fits_alone_have_no_change(folder: Path) -> None:
    done = run(folder, "a0.nc", "--with", "same0.nc", *settings(folder, fit_radius_mm=12.0))
    assert done.returncode == 6
    assert "Not compared: map 1: the shipped calibration does not fit: fit radius 12 mm" in done.stdout


def test_a_posterior_is_refused_and_its_map_is_asked_for(folder: Path) -> None:
    run_here("estimate", "a0.nc", "-o", "post.nc", "--force", *FAST, cwd=folder)
    done = run(folder, "a1.nc", "--with", "post.nc")
    assert done.returncode == 3
    assert "post.nc: is a posterior, not a map; give the map that it was estimated from" in done.stderr


@pytest.mark.long
def test_a_scan_is_no_second_visit_and_no_second_exam(folder: Path) -> None:
    write(folder / "again.nc", sigma=4.0, seed=0, subject="p1", side="left")
    made = read_map(folder / "again.nc")
    finer = replace(made, mean=made.mean + 0.001)  # the same scan, mapped another way
    scans = [{"sha256": f"{0:064x}", "subject": "p1", "side": "left"}]
    write_map(folder / "again.nc", finer, provenance=Provenance("test", {}, scans=scans), force=True)
    for words in (("a0.nc", "--with", "again.nc"), ("a0.nc", "again.nc", "--with", "grown0.nc")):
        done = run(folder, *words)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert "again.nc and a0.nc are of one scan; give one map of each scan" in done.stderr
    pooled = run_here("estimate", "--pool", "a0.nc", "again.nc", *FAST, cwd=folder)
    told = "CAUTION: map 2: a map of the same scan as map 1 is no repeat: the interval is too narrow."
    assert told in pooled.stdout
    assert "no repeat" not in run_here("estimate", "--pool", "a0.nc", "a1.nc", *FAST, cwd=folder).stdout
    run_here("report", "a0.nc", "again.nc", "-o", "again.html", cwd=folder)
    page = (folder / "again.html").read_text()
    assert "CAUTION: map 2: a map of the same scan as map 1 is no repeat: the interval is too narrow." in page


@pytest.mark.parametrize(("percent", "text"), [(-0.3, "0"), (0.4, "0"), (-1.2, "-1"), (12.6, "+13")])
def test_a_change_of_nothing_has_no_sign(percent: float, text: str) -> None:
    assert signed(percent) == text


@pytest.mark.long
@pytest.mark.parametrize("later", ["grown0.nc", "bare0.nc"])
def test_the_figure_is_written_once_and_not_over_another(folder: Path, later: str) -> None:
    words = ("a0.nc", "--with", later, "--same-mass", "--figure", f"{later}.png")
    assert run(folder, *words).returncode == 0
    first = (folder / f"{later}.png").read_bytes()
    refused = run(folder, *words)
    assert refused.returncode == 2
    assert "--force" in refused.stderr
    assert run(folder, *words, "--force").returncode == 0
    assert (folder / f"{later}.png").read_bytes() == first


def test_files_after_with_are_one_visit() -> None:
    assert number_groups(["a", "--with", "b", "c", "--json", "--with=d"]) == [
        "a", "--with", "1", "b", "--with", "1", "c", "--json", "--with", "2", "d"
    ]  # fmt: skip
    for words in (["a", "--with"], ["--with", "--json"], ["a", "--with", "--with", "b"]):
        with pytest.raises(UsageError):
            number_groups(words)
    assert number_groups(["a", "--with"], strict=False) == ["a"]


def test_the_order_of_a_visits_maps_leaves_no_trace(folder: Path, grown: dict) -> None:
    done = run(folder, "a1.nc", "a0.nc", "--with", "grown1.nc", "grown0.nc", "--days", 100, "--json")
    assert json.loads(done.stdout)["changes"] == grown["changes"]


def test_python_compares_as_the_command_line_does(folder: Path, grown: dict) -> None:
    first = [folder / "a0.nc", tb.estimate(folder / "a1.nc", method="laplace")]
    found = tb.compare(first, [folder / f"grown{i}.nc" for i in range(2)], days=[100], method="laplace")
    assert found.document["changes"] == grown["changes"]
    assert found.growth == "grown"
    assert found.change_percent is not None
    assert found.change_percent.median == pytest.approx(grown["changes"][0]["percent"]["median"])
    assert [one.median for one in found.sizes_mm] == [
        pytest.approx(one["max_size_mm"]["median"]) for one in grown["visits"]
    ]
    assert found.probability_grown(0.2) == pytest.approx(grown["changes"][0]["grown_by"][0]["probability"])
    assert found.plot().axes
    assert "grown" in repr(found)
    assert RESEARCH_USE in found._repr_html_()


def test_python_names_why_nothing_is_compared(folder: Path) -> None:
    found = tb.compare(folder / "a0.nc", folder / "far.nc", method="laplace")
    assert (found.status, found.growth, found.change_percent, found.sizes_mm) == ("not_one_mass", None, None, ())
    assert "30 mm apart" in found.why
    assert found.why in repr(found)
    with pytest.raises(UsageError, match="given twice"):
        tb.compare(folder / "a0.nc", folder / "a0.nc", method="laplace")


def test_help_tells_the_options_groups() -> None:
    from tactile_bayes.commands.estimate import compare_command as command

    text = command.get_help(click.Context(command))
    assert "--with VISIT2.nc..." in text


def change_of(in_sds: float, sd: float = 0.1) -> Change:
    """A normal change of ln d, some of its SDs from none."""
    score = ndtri((np.arange(4000) + 0.5) / 4000)
    mean = np.full(4000, in_sds * sd)
    return Change(mean + sd * score, mean, np.full(4000, sd), np.repeat(np.arange(8), 500))


@pytest.mark.parametrize(
    ("in_sds", "called"),
    [
        (1.98, "grown"),
        (1.94, "no_change_shown"),
        (0.0, "no_change_shown"),
        (-1.94, "no_change_shown"),
        (-1.98, "shrunk"),
    ],
)
def test_a_change_is_called_one_where_its_interval_leaves_out_none(in_sds: float, called: str) -> None:
    assert verdict(change_of(in_sds)) == called


def test_what_is_shown_is_beyond_the_smallest_detectable_change_and_what_is_not_lies_within() -> None:
    for in_sds in np.linspace(-3.0, 3.0, 25):
        change = change_of(float(in_sds))
        growth, shrinkage = change.smallest_detectable(0.95)
        share = float(np.expm1(change.log_summary(0.95).median))
        assert (verdict(change) == "grown") == (share > growth)
        assert (verdict(change) == "shrunk") == (share < -shrinkage)


def with_change(grown: dict, **figures: object) -> CompareReport:
    (change,) = grown["changes"]
    return from_plain(CompareReport, {**grown, "changes": [{**change, **figures}]})


def reworded(grown: dict, **figures: object) -> str:
    return compare_summary(with_change(grown, **figures))


def summary(document: dict) -> str:
    return compare_summary(from_plain(CompareReport, document))


def test_growth_and_shrinkage_are_worded_alike_in_one_verdict(grown: dict) -> None:
    unlikely = {"probability_grown": 0.004, "grown_by": [{"percent": 20.0, "probability": 0.0001}]}
    shrunk = reworded(grown, verdict="shrunk", **unlikely)
    assert "Probability that it has shrunk: 0.996; that it has grown by more than 20 %: below 0.001." in shrunk
    for text, word in ((summary(grown), "grown"), (shrunk, "shrunk")):
        assert f"The mass has {word}." in text
        assert "No change shown" not in text
        assert "can stay unseen" not in text


def test_a_wider_spread_between_exams_adds_no_second_verdict(grown: dict) -> None:
    another = {**grown["changes"][0]["another_exam"], "probability_grown": 0.9}
    text = reworded(grown, another_exam=another)
    assert "probability that it has grown: 0.900." in text
    assert text.count("The mass has") == 1
    assert "no change shown" not in text.lower()
    assert "The mass has grown." in text


def test_a_change_that_exams_of_patients_would_not_show_says_on_what_it_rests(grown: dict) -> None:
    wide = grown["changes"][0]["another_exam"]
    around_0 = {**wide, "percent": {**wide["percent"], "low": -1.0}}
    words = "grown, if exams repeat as simulated ones do; if they differ as those of patients did, no change is shown"
    assert f"The mass has {words}." in reworded(grown, another_exam=around_0)
    for another, outcome in ((around_0, words), (wide, "grown"), (None, "grown")):
        (row,) = growths("P1", "1", "12", with_change(grown, another_exam=another), "")
        assert row.outcome == outcome


def test_the_verdict_and_what_it_rests_on_are_by_95_percent_whatever_interval_is_asked_for(grown: dict) -> None:
    percent, wide = (
        one["percent"] | {"probability": 0.5} for one in (grown["changes"][0], grown["changes"][0]["another_exam"])
    )
    for chance, more in ((0.968, ", if exams repeat as simulated ones do;"), (0.98, ".\n")):
        another = {"between_map_sd": 0.1, "percent": wide | {"low": 1.0}, "probability_grown": chance}
        text = reworded(grown, percent=percent, another_exam=another)
        assert text.startswith(f"By the 95 % interval: the mass has grown{more}")


@pytest.mark.long
def test_of_several_masses_the_one_that_is_compared_is_named(folder: Path) -> None:
    settings = Settings(method="laplace")
    first, later = (tb.estimate(folder / name, method="laplace").answer for name in ("a0.nc", "grown0.nc"))
    (mass,) = first.report.masses
    both = replace(first.report, masses=(mass, replace(mass, number=2, reported=False)))
    visits, names = [[replace(first, report=both)], [later]], [["a"], ["b"]]
    (told,) = [
        one.sentence()
        for one in compare_answers(visits, settings, CompareOptions(), names=names).report.findings
        if one.kind == "several_masses"
    ]
    assert told.startswith("visit 1: the map shows 2 masses, and the one at (")
    by_table = compare_answers(visits, settings, CompareOptions(), names=names, numbers=["1", "2"]).report
    assert "several_masses" not in [one.kind for one in by_table.findings]
