"""The validations can be run, and the tables of the documents are those that they kept."""

from __future__ import annotations

import argparse
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.mapping.map import broken_assumptions
from validation import agreement_coverage
from validation.__main__ import NAMES
from validation.common import RESULTS, Table, percent, pickled, share
from validation.tables import PAGES, names_in, written

ROOT = Path(__file__).resolve().parent.parent
TEXTS = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "guides").glob("*.md"), *ROOT.glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_of_a_page_are_the_kept_ones(page: Path) -> None:
    assert page.read_text(encoding="utf-8") == written(page), "run `python -m validation tables`"


def test_every_kept_table_has_its_place() -> None:
    assert {name for page in PAGES for name in names_in(page)} == {path.stem for path in RESULTS.glob("*.csv")}


@pytest.mark.parametrize("name", NAMES)
def test_a_validation_tells_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        import_module(f"validation.{name}").main(["--help"])
    assert end.value.code == 0
    assert f"python -m validation {name}" in capsys.readouterr().out


def test_limits_and_lines_are_judged_by_three_kinds_of_intervals() -> None:
    """It read figures by names that a report no longer had, and ended in an error."""
    design, error = next(iter(agreement_coverage.DESIGNS)), next(iter(agreement_coverage.ERRORS))
    one = agreement_coverage._trial(design, error, np.random.default_rng(1))
    corrected, jackknife, customary = agreement_coverage._three(one)
    assert set(corrected) == set(jackknife) == set(agreement_coverage.WANTED)
    assert {"ols_slope", "limit_low_mm"} <= set(customary) < set(corrected)


def test_figures_in_texts_of_the_program_are_the_kept_ones() -> None:
    """Sizes on convex skin were said to move by 7 %, exams of a simulated body to differ by 5 % and, on pages, by 3."""
    kept = dict(re.findall(r'"convex skin, radius (\d+) mm","[^"]+",([\d.]+) %', (RESULTS / "stress.csv").read_text()))
    (skin,) = broken_assumptions({"skin_curvature_per_m": 10.0, "skin_curvature_sd_per_m": 1.0})
    assert f"moved by {float(kept['150']):.0f} and {float(kept['75']):.0f} %" in skin.text
    solid = size_calibration_path("solid")
    assert solid is not None
    exams = read_size_calibration(solid).between_exams.sd
    assert f"({exams:.3f} if solid)" in (ROOT / "docs" / "columns-and-keys.md").read_text(encoding="utf-8")
    for page in ("how-a-size-comes-about.md", "guides/python.md", "accuracy.md"):
        assert f" {100 * exams:.1f} %" in (ROOT / "docs" / page).read_text(encoding="utf-8").replace("\n", " ")


def missing(text: str) -> list[str]:
    """Commands of a text that the checkout does not have; those of finished research name the commit that had them."""
    found = []
    for one in re.finditer(r"python -m (validation [a-z_]+|benchmarks\.[a-z_]+)|python (tests/\w+/[a-z_]+\.py)", text):
        path = one[2] or re.sub(r"[ .]", "/", one[1]) + ".py"
        if not (ROOT / path).exists() and "at commit" not in text[one.end() : one.end() + 160]:
            found.append(path)
    return found


def test_figures_of_the_documents_keep_a_command_that_exists() -> None:
    assert missing("`python -m benchmarks.gone` at commit 1201e82") == []
    assert missing("`python -m validation nothing`, `python tests/fuzz/none.py`") == [  # the control
        "validation/nothing.py",
        "tests/fuzz/none.py",
    ]
    assert {path.name: missing(path.read_text(encoding="utf-8")) for path in TEXTS} == {p.name: [] for p in TEXTS}


class _Parsed(Exception):  # noqa: N818 (no error: the command's words were taken)
    pass


def test_commands_of_the_pages_are_taken_as_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    parse = argparse.ArgumentParser.parse_known_args

    def parsed(self: argparse.ArgumentParser, words: list[str], _: object = None) -> None:
        raise _Parsed(parse(self, words)[1])

    for way in ("parse_args", "parse_known_args"):
        monkeypatch.setattr(argparse.ArgumentParser, way, parsed)
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    commands = [re.sub(r"\s+", " ", one) for one in re.findall(r"`python -m validation ([^`]+)`", text)]
    assert len(commands) > 10
    for name, *words in map(str.split, commands):
        with pytest.raises(_Parsed) as left:
            import_module(f"validation.{name}").main(words)
        assert left.value.args == ([],)
    with pytest.raises(SystemExit):  # the control: a scan's folder is asked for
        import_module("validation.known_scans").main([])


def test_shares_have_their_exact_intervals() -> None:
    """Clopper and Pearson (1934): 1 - 0.025^(1/n) beside none of n."""
    assert share([False] * 10) == f"0.000 [0.000, {1 - 0.025**0.1:.3f}]"
    assert percent(21, 58) == "36 % (24 to 50)"
    assert share([]) == "-"


def test_a_table_is_kept_as_it_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr("validation.common.RESULTS", tmp_path)
    table = Table("one", "what", "")
    table.add("a, b", "")
    table.keep()
    assert capsys.readouterr().out == "\n| what | |\n|---|---|\n| a, b | |\n"
    assert (tmp_path / "one.csv").read_text() == 'what,\n"a, b",\n'


def test_a_kept_result_is_not_computed_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "one.pickle"
    assert pickled(path, lambda: 7) == 7
    assert pickled(path, lambda: pytest.fail("made again")) == 7
    assert [one.name for one in path.parent.iterdir()] == ["one.pickle"]
