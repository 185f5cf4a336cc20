"""`report` as a user runs it: maps, or a map and its estimate's JSON, to one page."""

from __future__ import annotations

import json
import shutil
from html import unescape
from pathlib import Path

import h5py
import numpy as np
import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from repeated_exams import write_repeats

from tactile_bayes.commands import estimate as command
from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.report import pages as printed

DEMO = Path(__file__).resolve().parents[2] / "tactile_bayes" / "demo" / "scan.mcap"


def write_repeat(folder: Path, name: str, *, seed: int, **facts: str) -> None:
    """The demo's map with a little noise of its own, and what its scan says of the exam."""
    plain = read_map(folder / "map.nc")
    noise = 0.002 * np.random.default_rng(seed).standard_normal(plain.mean.shape)
    scans = [{"sha256": f"{seed:064x}", **facts}]
    write_map(folder / name, replace(plain, mean=plain.mean + noise), provenance=Provenance("map", {}, scans=scans))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("report")
    assert run_here("map", DEMO, "-o", "map.nc", cwd=place).returncode == 0
    write_repeat(place, "a.nc", seed=1, subject="P1", side="left")
    write_repeat(place, "b.nc", seed=2, subject="P1", side="left")
    write_repeat(place, "other.nc", seed=3, subject="P2", side="left")
    (place / "a.json").write_text(run_here("estimate", "a.nc", "--json", "-o", "post.nc", cwd=place).stdout)
    (place / "list.json").write_text(f"[{(place / 'a.json').read_text()},{(place / 'a.json').read_text()}]")
    run_here("estimate", "--pool", "a.nc", "b.nc", "-o", "both.nc", cwd=place)
    shutil.copy(place / "post.nc", place / "old.nc")
    with h5py.File(place / "old.nc", "r+") as file:
        del file["posterior"].attrs["estimate"]
    return place


@pytest.mark.long
def test_a_map_becomes_a_private_page_that_is_not_overwritten(folder: Path) -> None:
    done = run_here("report", "map.nc", "-o", "map.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("map.html: Lump of about 14.3 mm, 95 % interval ")
    page = folder / "map.html"
    assert page.stat().st_mode & 0o777 == 0o600
    before = page.read_bytes()
    again = run_here("report", "map.nc", "-o", "map.html", cwd=folder)
    assert again.returncode == 2
    assert "exists" in again.stderr
    assert run_here("report", "map.nc", "-o", "map.html", "--force", cwd=folder).returncode == 0
    assert page.read_bytes() == before


@pytest.mark.long
def test_the_json_of_an_estimate_gives_the_same_page_without_estimating(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_here("report", "a.nc", "-o", "alone.html", cwd=folder).returncode == 0

    monkeypatch.setattr("tactile_bayes.api.estimates.estimate_file", None)
    done = run_here("report", "a.json", "a.nc", "-o", "both.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "both.html").read_bytes() == (folder / "alone.html").read_bytes()


@pytest.mark.long
def test_a_posterior_gives_the_page_of_its_estimate(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_bayes.api.estimates.estimate_file", None)
    run_here("report", "a.json", "a.nc", "-o", "by_json.html", cwd=folder)
    done = run_here("report", "a.nc", "post.nc", "-o", "by_posterior.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "by_posterior.html").read_bytes() == (folder / "by_json.html").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("estimate", ["post.nc", "a.json"])
def test_an_estimate_without_its_map_has_a_page_that_says_what_it_lacks(folder: Path, estimate: str) -> None:
    words = ("report", estimate, "-o", "no_map.html", "--force")
    done = run_here(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "note: without its map the page has no picture and no coverage; give MAP.nc too\n"
    page, with_map = (folder / "no_map.html").read_text(), folder / "with_map.html"
    run_here("report", "a.nc", "a.json", "-o", "with_map.html", "--force", cwd=folder)
    lines = with_map.read_text().splitlines()
    told = [
        line for line in lines if "diameter is about" in line or ("of the xiphoid and" in line and "<tr>" not in line)
    ]
    assert len(told) == 3
    assert all(line in page for line in told)
    assert "The map is not at hand: this page shows no picture of it" in page
    for absent in ('class="map"', ">covered</th>", ">pressure</th>", 'class="bar"'):
        assert absent not in page
        assert absent in with_map.read_text()
    for text in ("sensor calibration", "size calibration", "Research use only"):
        assert text in page


@pytest.mark.long
def test_the_page_says_whose_spread_between_exams_the_interval_supposes(folder: Path) -> None:
    (folder / "own.toml").write_text("between_map_sd = 0.07\n")
    run_here("report", "a.nc", "--settings", "own.toml", "-o", "stated.html", cwd=folder)
    stated = (folder / "stated.html").read_text()
    assert "exams of a lump are taken to differ by 7 %, as was stated." in stated
    assert "simulated bodies do" not in stated
    write_repeats(folder / "out", 10)
    run_here("calibrate", "repeatability", "out", "-o", "site.json", cwd=folder)
    done = run_here("report", "a.nc", "--repeatability", "site.json", "-o", "site.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "at this site, by 10 masses and 30 exams." in (folder / "site.html").read_text()
    run_here("report", "a.nc", "b.nc", "--repeatability", "site.json", "-o", "sites.html", cwd=folder)
    assert "by these maps and this site's other exams" in unescape((folder / "sites.html").read_text())
    assert "simulated bodies do" in run_page(folder)


def run_page(folder: Path) -> str:
    """The page of the map alone, with two intervals."""
    run_here("report", "a.nc", "-o", "plain.html", "--force", cwd=folder)
    return (folder / "plain.html").read_text()


@pytest.mark.long
def test_repeats_are_pooled_and_shown_small(folder: Path) -> None:
    done = run_here("report", "a.nc", "b.nc", "-o", "two.html", cwd=folder)
    assert done.returncode == 0, done.stderr
    page = (folder / "two.html").read_text()
    assert page.count("<figure>") == 2
    assert "The 2 maps of this mass" in page
    assert "as these maps suggest" in page
    document = json.loads(run_here("estimate", "--pool", "a.nc", "b.nc", "--json", cwd=folder).stdout)
    size = document["another_exam"]["max_size_mm"]  # the interval that leads
    assert f"{size['low']:.1f} to {size['high']:.1f} mm" in page


@pytest.mark.long
def test_a_session_in_a_file_that_was_made_by_hand_cannot_hurt_the_page(folder: Path) -> None:
    hostile = "</p><script>alert(1)</script>" + "x" * 10_000
    write_repeat(folder, "hostile.nc", seed=4, subject=hostile, side="left", posture=hostile, visit="<img src=x>")
    assert run_here("report", "hostile.nc", "-o", "hostile.html", cwd=folder).returncode == 0
    page = (folder / "hostile.html").read_text()
    assert "<script" not in page
    assert "<img" not in page
    assert "x" * 100 not in page


REFUSED = [
    (("a.json", "b.nc"), 3, "a.json: is not the estimate of b.nc; give the map it names"),
    (("post.nc", "b.nc"), 3, "post.nc: is not the estimate of b.nc; give the map it names"),
    (("a.nc", "b.nc", "a.json"), 2, "an estimate goes with one map"),
    (("post.nc", "a.json"), 2, "an estimate goes with one map"),
    (("both.nc",), 3, "both.nc: holds a size pooled from several maps; give the maps"),
    (("old.nc",), 3, "old.nc: holds draws without their estimate; give its map"),
    (("list.json",), 3, "list.json: holds 2 estimates in a list, and a page takes one; give the maps"),
    (("a.nc", "a.nc"), 2, "a.nc is given twice; give each file once"),
    (("a.nc", "other.nc"), 3, "the maps differ in subject (P1, P2); give the maps of one mass"),
    (("a.nc", "a.json", "--size-calibration", "eq6"), 2, "an estimate has settings of its own; leave out --size"),
    (("a.nc", "post.nc", "--interval", "0.95"), 2, "an estimate has settings of its own; leave out --interval"),
    (("post.nc", "--settings", "a.json"), 2, "an estimate has settings of its own; leave out --settings"),
    (("a.nc", "--date", "1.3.2026"), 2, "date '1.3.2026' is no date; give it as YEAR-MONTH-DAY"),
    (("a.nc", "--title", "x" * 61), 2, "title is of 61 letters or not printable; give up to 60 letters"),
    (("a.nc", "--name", "a\nb"), 2, "name is of 3 letters or not printable"),
    (("a.nc", "--pdf", "bad.html"), 2, "two outputs of this command"),
]


@pytest.mark.long
@pytest.mark.parametrize(("words", "code", "message"), REFUSED)
def test_inputs_that_make_no_page_are_one_clear_line(
    folder: Path, words: tuple[str, ...], code: int, message: str
) -> None:
    done = run_here("report", *words, "-o", "bad.html", cwd=folder)
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (folder / "bad.html").exists()


@pytest.mark.long
def test_without_a_printer_pdf_is_refused_before_any_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(printed.shutil, "which", lambda _: None)
    monkeypatch.setattr(printed, "find_spec", lambda _: None)
    done = run_here("report", "a.nc", "-o", "no.html", "--pdf", "no.pdf", cwd=folder)
    assert done.returncode == 2
    assert "--pdf needs Chromium or WeasyPrint and finds neither; install Chromium or `pip install" in done.stderr
    assert not (folder / "no.html").exists()


@pytest.mark.long
def test_a_browser_that_fails_is_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(printed.shutil, "which", lambda name: "/bin/false" if name == "chromium" else None)
    done = run_here("report", "a.nc", "-o", "failed.html", "--pdf", "failed.pdf", cwd=folder)
    assert done.returncode == 2
    assert "/bin/false did not print the page (it said nothing); print it from your browser" in done.stderr
    assert not (folder / "failed.pdf").exists()


@pytest.mark.long
def test_the_printed_file_is_private_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_bayes.report.pages.find_printer", lambda: lambda page: b"%PDF-" + page[:9].encode())
    assert run_here("report", "a.nc", "-o", "p.html", "--pdf", "p.pdf", cwd=folder).returncode == 0
    assert (folder / "p.pdf").read_bytes() == b"%PDF-<!doctype"
    assert (folder / "p.pdf").stat().st_mode & 0o777 == 0o600


def test_the_command_is_documented() -> None:
    assert "prints to one side of A4" in (command.report_command.help or "")
