"""An estimate's JSON that somebody edited: sizes that cannot be a lump's are one line, whoever reads the file."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from in_process import run_here
from repeated_exams import estimate_document

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.estimate_json import MOST_MM, checked_report
from tactile_bayes.files.reports import REPORTS
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.svg import size_ruler

FIELDS = ("kind", "text", "remedy", "on_paper", "about")

Document = dict[str, Any]
Edit = Callable[[Document], object]


def both(edit: Edit) -> Edit:
    """The same edit of the document and of its reported mass."""

    def apply(document: Document) -> None:
        for one in (document, *(mass for mass in document["masses"] if mass["reported"])):
            edit(one)

    return apply


def largest(**values: float) -> Edit:
    return both(lambda one: one["max_size_mm"].update(values))


def swapped(document: Document) -> None:
    size = document["max_size_mm"]
    largest(low=size["high"], high=size["low"])(document)


def exchanged(document: Document) -> None:
    """The largest size for the smallest, where they are not one number."""
    both(lambda one: one["min_size_mm"].update(median=17.0, low=15.0, high=19.0))(document)


EDITS: dict[str, tuple[Edit, str]] = {
    "ends exchanged": (swapped, r"^exam.json: max_size_mm has low 16\.\d+ and high 12\.\d+; ends of an interval rise"),
    "a median outside": (largest(median=40.0), "max_size_mm has median 40 outside its interval of 12"),
    "sizes exchanged": (exchanged, "min_size_mm is 17 mm and max_size_mm 14"),
    "below zero": (largest(low=-3.0), "max_size_mm has low -3"),
    "no size at all": (largest(low=0.0, median=0.0, high=0.0), "max_size_mm has low 0 and high 0"),
    "no lump's": (largest(high=1e300), "high 1e\\+300; ends of an interval rise from above 0 to at most 500 mm"),
    "of another mass": (
        lambda one: one["max_size_mm"].update(median=15.0),
        "masses.0..max_size_mm is not the document's",
    ),
    "another exam's": (
        both(lambda one: one["another_exam"]["max_size_mm"].update(low=99.0)),
        "another_exam.max_size_mm has low 99",
    ),
    "a missing end": (both(lambda one: one["max_size_mm"].pop("low")), "max_size_mm has no low; add it"),
    "words": (both(lambda one: one["max_size_mm"].update(median="15")), "max_size_mm.median is '15'; give a number"),
    "one size alone": (both(lambda one: one.update(min_size_mm=None)), "max_size_mm and min_size_mm are not both"),
    "no place": (lambda one: one.update(centre_mm={"x": None, "y": None}), "centre_mm.x is None; give a table"),
    "no estimate": (lambda one: one.update(status="no_estimate"), "status is 'no_estimate', and there is a max_size"),
    "a mass twice": (lambda one: one["masses"].append(copy.deepcopy(one["masses"][0])), "masses are numbered 1, 1"),
    "two reported": (
        lambda one: one["masses"].append({**copy.deepcopy(one["masses"][0]), "number": 2}),
        "2 masses are the reported one",
    ),
    "settings of nothing": (
        lambda one: one["provenance"].update(settings=None),
        "settings is None; give a table",
    ),
    "inputs of nothing": (
        lambda one: one["provenance"].update(inputs=[None]),
        r"inputs\[0\] is None; give a table",
    ),
    "findings of letters": (lambda one: one.update(findings="abc"), "findings is 'abc'; give a list"),
    "a finding of no kind": (
        lambda one: one.update(findings=[dict.fromkeys(FIELDS, "x") | {"severity": "check"}]),
        "finding of unknown kind 'x'",
    ),
    "a verdict of its own": (
        lambda one: one.update(verdict="doubtful"),
        "verdict is 'doubtful', and its",
    ),
}


def edited(edit: Edit) -> Document:
    document = copy.deepcopy(estimate_document())
    edit(document)
    return document


def check(document: Document) -> None:
    checked_report(document, REPORTS[document["schema"]], path=Path("exam.json"))


def test_a_printed_estimate_is_accepted() -> None:
    check(estimate_document())


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_is_named_in_one_line(name: str) -> None:
    edit, told = EDITS[name]
    with pytest.raises(BadDataError, match=told) as caught:
        check(edited(edit))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("exam.json: ")


@pytest.mark.parametrize("name", ["ends exchanged", "no lump's", "no place", "settings of nothing"])
def test_exports_and_the_page_refuse_it_and_write_nothing(tmp_path: Path, name: str) -> None:
    (tmp_path / "exam.json").write_text(json.dumps(edited(EDITS[name][0])))
    for words in (
        ("export", "--to", "csv", "-o", "out"),
        ("export", "--to", "fhir", "-o", "out"),
        ("report", "-o", "out"),
    ):
        done = run_here(words[0], "exam.json", *words[1:], cwd=tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["exam.json"]


def test_a_file_that_begins_with_a_mark_is_read_without_it(tmp_path: Path) -> None:
    exported = []
    for mark in ("", "\ufeff"):
        (tmp_path / "exam.json").write_text(mark + json.dumps(estimate_document()))
        done = run_here("export", "exam.json", "--to", "csv", "-o", f"out{mark and 'mark'}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        exported.append(done.stdout.replace("outmark", "out"))
    assert exported[0] == exported[1]


@pytest.mark.parametrize("high", [3.0, 17.6, MOST_MM, 3e4, 1e12])
def test_the_scale_of_sizes_has_few_numbers_whatever_it_reaches(high: float) -> None:
    """A posterior's own size may be far above what a file may say; the scale once had a number for every metre."""
    size = Quantity(median=high / 1.5, mean=high / 1.5, sd=1.0, low=high / 2, high=high, probability=0.95, kind="eti")
    scale = size_ruler([("this exam", size)])
    assert 2 <= scale.count("<text") <= 12
