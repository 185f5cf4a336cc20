"""CSV for REDCap: data and dictionary by the rules that REDCap's own help gives for uploads."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest
from export_files import exported
from in_process import run_here

from tactile_bayes.exports.redcap import COMPLETE

# REDCap's help: 18 columns; names of lower-case letters, digits and underscores that begin with a letter, at most 26
# characters advised; field types; validation types; a choice is "CODE, LABEL", parted by " | ".
NAME = re.compile(r"[a-z](?:[a-z0-9]|_(?!_))*[a-z0-9]")
VALIDATION = {
    "": re.compile(r".*", re.DOTALL),
    "number": re.compile(r"[-+]?[0-9]*\.?[0-9]+([eE][-+]?[0-9]+)?"),
    "integer": re.compile(r"[-+]?\b\d+\b"),
    "date_ymd": re.compile(r"\d{4}-\d{2}-\d{2}"),
}


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def tables(exam: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Records of three estimates, and the dictionary."""
    folder = tmp_path_factory.mktemp("redcap")
    words = ("map.json", "empty.json", "phantom_post.nc", "--study-date", "2026-11-24T10:30")
    exported(exam, *words, "--to", "csv", "-o", folder / "d.csv", "--dictionary", folder / "dict.csv")
    return rows_of(folder / "d.csv"), rows_of(folder / "dict.csv")


def test_the_dictionary_keeps_redcaps_rules(tables: Any) -> None:
    _, fields = tables
    assert len(fields[0]) == 18
    names = [one["Variable / Field Name"] for one in fields]
    assert names[0] == "record_id"
    assert len(set(names)) == len(names)
    for one in fields:
        name = one["Variable / Field Name"]
        assert NAME.fullmatch(name), name
        assert len(name) <= 26
        assert NAME.fullmatch(one["Form Name"])
        assert one["Field Type"] in ("text", "notes", "radio")
        assert one["Field Label"]
        kind = one["Text Validation Type OR Show Slider Number"]
        assert kind in VALIDATION
        assert not kind or one["Field Type"] == "text"
        assert bool(one["Choices, Calculations, OR Slider Labels"]) == (one["Field Type"] == "radio")


def test_every_value_is_one_that_the_dictionary_allows(tables: Any) -> None:
    records, fields = tables
    names = [one["Variable / Field Name"] for one in fields]
    assert list(records[0]) == [*names, COMPLETE]
    assert len({one["record_id"] for one in records}) == len(records) == 3
    for record in records:
        assert record[COMPLETE] in ("0", "1", "2")
        for field in fields:
            value = record[field["Variable / Field Name"]]
            if not value:
                continue
            kind = field["Text Validation Type OR Show Slider Number"]
            assert VALIDATION[kind].fullmatch(value), (field, value)
            if field["Text Validation Min"]:
                assert float(field["Text Validation Min"]) <= float(value) <= float(field["Text Validation Max"])
            if field["Field Type"] == "radio":
                choices = field["Choices, Calculations, OR Slider Labels"].split(" | ")
                assert value in [choice.split(", ")[0] for choice in choices]


def test_sizes_are_read_back_equal(tables: Any, estimate: dict[str, Any], exam: Path) -> None:
    first, empty, draws = tables[0]
    for name in ("max", "min"):
        size = estimate["another_exam"][f"{name}_size_mm"]
        assert [float(first[f"tb_{name}{end}_mm"]) for end in ("", "_low", "_high")] == [
            size["median"],
            size["low"],
            size["high"],
        ]
    assert (first["tb_status"], first["tb_side"], first["tb_visit"], first["tb_exam_date"]) == (
        "1",
        "1",
        "2",
        "2026-11-24",
    )
    assert float(first["tb_right_mm"]) == estimate["masses"][0]["centre_patient_mm"]["x"]
    assert empty["tb_status"] == "3"
    assert empty["tb_max_mm"] == empty["tb_max_low_mm"] == ""
    assert empty["tb_reason"] == json.loads((exam / "empty.json").read_text())["reason"]
    phantom = json.loads((exam / "phantom.json").read_text())
    assert float(draws["tb_max_high_mm"]) == pytest.approx(phantom["another_exam"]["max_size_mm"]["high"])
    assert draws["tb_side"] == "3"
    assert float(draws["tb_lump_prob"]) == phantom["detected_probability"]


def test_a_record_is_named_by_content_or_by_what_was_told(tables: Any, exam: Path, tmp_path: Path) -> None:
    assert all(re.fullmatch(r"tb-[0-9a-f]{16}", one["record_id"]) for one in tables[0])
    assert "S01" not in str(tables[0])
    exported(exam, "map.json", "--to", "csv", "--patient-id-from-scan", "-o", tmp_path / "a.csv")
    assert rows_of(tmp_path / "a.csv")[0]["record_id"] == "S01-left-2-1"
    exported(exam, "map.json", "--to", "csv", "--patient-id", "K7", "-o", tmp_path / "b.csv")
    assert rows_of(tmp_path / "b.csv")[0]["record_id"] == "K7-left-2-1"


@pytest.mark.parametrize(
    ("facts", "stated", "fault"),
    [
        (
            {"subject": "S02"},
            ("--patient-id", "K7"),
            "K7 cannot be patients S01, S02 of the scans; export each by itself",
        ),
        ({"visit": "3"}, ("--study-date", "2026-11-24"), "2026-11-24 cannot be the date of visits 2, 3 of patient S01"),
        ({}, ("--patient-id-from-scan",), "pool exams of one visit (estimate --pool), or give a scan's visit"),
    ],
)
def test_estimates_of_several_are_not_one_persons_one_days_or_one_record(
    facts: dict[str, str], stated: tuple[str, ...], fault: str, estimate: dict[str, Any], tmp_path: Path
) -> None:
    for name, own in {"a": {}, "b": facts}.items():
        scans = [{"sha256": "0" * 64, "subject": "S01", "visit": "2", **own}]
        made = estimate["provenance"] | {"scans": scans, "inputs": [{"role": "map", "sha256": name * 64}]}
        (tmp_path / name).write_text(json.dumps(estimate | {"provenance": made}))
    done = run_here("export", "a", "b", "--to", "csv", "-o", "out.csv", *stated, cwd=tmp_path)
    assert done.returncode == 2
    assert fault in done.stderr
    assert not (tmp_path / "out.csv").exists()


def test_no_cell_is_a_formula_or_breaks_the_line(estimate: dict[str, Any], tmp_path: Path) -> None:
    scans = [{"sha256": "0" * 64, "visit": "-1", "mass": "=1"}]
    hostile = estimate | {"provenance": estimate["provenance"] | {"scans": scans, "version": "=cmd|' /C calc'!A0"}}
    (tmp_path / "h.json").write_text(json.dumps(hostile))
    exported(tmp_path, "h.json", "--to", "csv", "-o", tmp_path / "h.csv")
    (row,) = rows_of(tmp_path / "h.csv")
    assert row["tb_version"].startswith("'=")
    assert row["tb_mass"] == "'=1"
    assert row["tb_visit"] == "-1"
    assert len((tmp_path / "h.csv").read_text().splitlines()) == 2
