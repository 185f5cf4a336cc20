"""What the command line offers, Python offers too: options of `export`, `compare` and `report`, and what they write."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.cli import cli
from tactile_bayes.declarations import names_of
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.exports.run import IDENTITY_FIELDS
from tactile_bayes.options import PlanErrors
from tactile_bayes.report import pages as printed

DEMO = Path(tb.__file__).parent / "demo"
FAST = {"method": "laplace"}
BY_PYTHON = {"as_json": "document", "verbose": "full_text", "figure": "plot", "output": "page"}
"""Options of the command line that are members of what Python returns."""
FIGURES = ("trace", "rank", "corner")
"""Options of `diagnose` that are kinds of its plots."""


def options(command: str) -> set[str]:
    found = cli.get_command(click.Context(cli), command)
    assert found is not None
    return {str(one.name) for one in found.params} - {"help", "settings_file"}  # Python has each setting by its name


def keywords(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters)


def test_every_option_of_export_is_a_keyword() -> None:
    assert options("export") - {"output"} <= keywords(tb.export) | set(IDENTITY_FIELDS["dicom"])


def test_every_option_of_compare_is_a_keyword_or_a_member() -> None:
    missing = options("compare") - keywords(tb.compare) - keywords(tb.estimate) - keywords(tb.Comparison.page)
    assert missing - {"later", "force"} == set(BY_PYTHON)
    for member in BY_PYTHON.values():
        assert hasattr(tb.Comparison, member)


def test_every_option_of_report_is_a_keyword() -> None:
    assert options("report") - keywords(tb.exam_report) - keywords(tb.estimate) == {"output"}
    for kind in (tb.SizeEstimate, tb.PooledSize):
        assert keywords(tb.exam_report) - keywords(tb.estimate) - {"files"} <= keywords(kind.report)


def test_every_option_of_campaign_plan_and_diagnose_is_a_keyword_or_a_member() -> None:
    run = cli.get_command(click.Context(cli), "campaign").get_command(click.Context(cli), "run")  # type: ignore[union-attr]
    assert {str(one.name) for one in run.params} - {"settings_file"} <= keywords(tb.campaign) | keywords(tb.estimate)
    assert options("plan") - keywords(tb.plan) - set(names_of(PlanErrors)) == {"as_json", "output", "figure", "force"}
    assert hasattr(tb.TrialPlan, "document")
    assert hasattr(tb.TrialPlan, "write_json")
    assert options("diagnose") - keywords(tb.diagnose) - keywords(tb.Diagnosis.plot) == {"as_json", *FIGURES}
    assert hasattr(tb.Diagnosis, "document")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps of two exams of the demo's breast, and the estimate of one."""
    made = tmp_path_factory.mktemp("options")
    run_here("simulate", DEMO / "scene.toml", "--seed", 2, "-o", "two.mcap", cwd=made)
    for scan, name in ((DEMO / "scan.mcap", "map.nc"), ("two.mcap", "two.nc")):
        assert run_here("map", scan, "-o", name, cwd=made).returncode == 0
    done = run_here("estimate", "map.nc", "--json", "-o", "post.nc", cwd=made)
    (made / "map.json").write_text(done.stdout)
    return made


@pytest.mark.long
@pytest.mark.parametrize(
    "files", [("map.nc",), ("map.nc", "two.nc"), ("map.nc", "map.json"), ("post.nc",), ("post.nc", "map.nc")]
)
def test_a_page_from_files_is_the_command_lines(folder: Path, tmp_path: Path, files: tuple[str, ...]) -> None:
    words = ("--title", "Visit 2", "--name", "A. B.", "--date", "2026-03-01")
    done = run_here("report", *files, "-o", tmp_path / "cli.html", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    told = {"title": "Visit 2", "name": "A. B.", "day": "2026-03-01"}
    line = tb.exam_report([folder / name for name in files], tmp_path / "python.html", **told)
    assert (tmp_path / "python.html").read_bytes() == (tmp_path / "cli.html").read_bytes()
    assert f"cli.html: {line}\n" in done.stdout


@pytest.mark.long
def test_a_page_of_what_python_holds_is_that_of_its_files(folder: Path, tmp_path: Path) -> None:
    one, two = (tb.estimate(folder / name) for name in ("map.nc", "two.nc"))
    tb.exam_report([folder / "map.nc", folder / "two.nc"], tmp_path / "wanted.html")
    tb.exam_report([one, tb.read_map(folder / "two.nc")], tmp_path / "mixed.html")
    tb.exam_report(tb.pool([one, two]), tmp_path / "pooled.html")
    tb.pool([one, two]).report(tmp_path / "method.html")
    wanted = (tmp_path / "wanted.html").read_text()
    assert "The 2 maps of this mass" in wanted
    for name in ("mixed", "pooled", "method"):
        assert (tmp_path / f"{name}.html").read_text() == wanted


@pytest.mark.long
@pytest.mark.parametrize(
    ("files", "given", "told"),
    [
        ([], {}, "nothing was given to report"),
        ("map.nc", {"title": "x" * 61}, "title is of 61 letters"),
        ("map.nc", {"name": "a\nb"}, "name is of 3 letters or not printable"),
        ("map.nc", {"day": "tomorrow"}, "date 'tomorrow' is no date"),
        ("map.nc", {"day": "2026-02-30"}, "is no date"),
        ("map.nc", {"pdf": "./page.html"}, "page and PDF at once"),
        ("map.json", {"interval": 0.9}, "leave out interval"),
        (["map.nc", "map.nc"], {}, "given twice"),
        (["map.nc", "two.nc"], {"checkpoint": "c.npz"}, "a checkpoint is of one map"),
    ],
)
def test_what_cannot_be_a_page_is_refused_and_nothing_is_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, files: Any, given: dict[str, Any], told: str
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    with pytest.raises(UsageError, match=told):
        tb.exam_report(files, "page.html", **given)
    assert sorted(folder.iterdir()) == before


@pytest.mark.long
def test_a_page_that_cannot_be_printed_leaves_neither_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_page: str) -> bytes:
        raise UsageError("the browser did not print the page")

    monkeypatch.setattr(printed, "find_printer", lambda: broken)
    with pytest.raises(UsageError, match="did not print"):
        tb.exam_report(folder / "post.nc", tmp_path / "page.html", pdf=tmp_path / "page.pdf")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(printed, "find_printer", lambda: lambda page: page.encode()[:9])
    tb.exam_report(folder / "post.nc", tmp_path / "page.html", pdf=tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes() == b"<!doctype"
    assert printed.PageFiles(tmp_path / "new.html").pdf is None


@pytest.mark.long
def test_dates_of_a_comparison_are_days_and_the_full_text_is_the_command_lines(folder: Path) -> None:
    first, later = (tb.estimate(folder / name, **FAST) for name in ("map.nc", "two.nc"))
    dated = tb.compare(first, later, dates=["2026-01-01", "2026-01-31"], **FAST)
    assert dated.document["changes"] == tb.compare(first, later, days=[30], **FAST).document["changes"]
    rate = dated.document["changes"][0]["growth_rate"]
    assert rate["days"] == 30
    words = ("compare", "map.nc", "--with", "two.nc", "--method", "laplace", "--dates", "2026-01-01,2026-01-31")
    full = run_here(*words, "-v", cwd=folder).stdout
    names = {"map (": "map.nc (", "two (": "two.nc ("}
    assert dated.full_text.splitlines()[0] == full.splitlines()[0], names
    assert len(dated.full_text.splitlines()) > len(dated.text.splitlines())
    told = json.loads(run_here(*words, "--json", cwd=folder).stdout)
    assert told["changes"] == dated.document["changes"]


@pytest.mark.long
def test_days_that_do_not_fit_and_a_checkpoint_are_refused_before_maps_are_read(folder: Path) -> None:
    never = folder / "not-there.nc"
    for given, told in (
        ({"days": [3], "dates": ["2026-01-01", "2026-01-31"]}, "give one of them"),
        ({"days": [3, 9]}, "times are given for 2 later visits"),
        ({"dates": ["2026-01-01", "soon"]}, "'soon' is no date"),
        ({"checkpoint": "c.npz"}, "a checkpoint is of one map"),
    ):
        with pytest.raises(UsageError, match=told):
            tb.compare(never, never, **given)
    with pytest.raises(UsageError, match="a checkpoint is of one map"):
        tb.pool([never], checkpoint="c.npz")
    with pytest.raises(BadDataError):
        tb.compare(never, never)
