"""The table reader: what it accepts, and one line for each fault it refuses."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.actions.show import describe
from tactile_bayes.errors import EXIT_BAD_DATA, BadDataError
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.tables import csv_separator, read_table

TRIAL = "trial.table.json"
EXCISION = "excision.table.json"
SIZES = "size_table.table.json"
HEADER = "patient,mass,modality,replicate,size_mm,status\n"
ROW = "P1,1,tactile,1,12.5,detected\n"


def write(folder: Path, text: str | bytes, *, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_reads_types_blanks_and_lines(tmp_path: Path) -> None:
    text = (
        HEADER.strip()
        + ",low_mm,synthetic\n"
        + "007,1,cbe,2,,not_detected,,\n\nP1,a b,tactile,1,12.5,detected,1e1,TRUE\n"
    )
    table = read_table(write(tmp_path, text), TRIAL)
    assert len(table) == 2
    assert table.columns["patient"] == ["007", "P1"]  # a code stays text
    assert table.columns["replicate"] == [2, 1]
    assert table.columns["size_mm"] == [None, 12.5]
    assert table.columns["low_mm"] == [None, 10.0]
    assert table.columns["synthetic"] == [None, True]
    assert table.columns["reader"] == [None, None]  # left out of the file
    assert table.line_numbers == [2, 4]


@pytest.mark.parametrize("prefix", [b"", b"\xef\xbb\xbf"], ids=["plain", "utf-8 mark"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_spreadsheets_write_marks_and_line_ends(tmp_path: Path, prefix: bytes, end: str) -> None:
    path = write(tmp_path, prefix + (HEADER + ROW).replace("\n", end).encode())
    assert read_table(path, TRIAL).columns["size_mm"] == [12.5]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_spreadsheet_of_another_country_is_read(tmp_path: Path, separator: str) -> None:
    """Semicolons or tabs, decimal commas, a byte order mark, and the blank columns right of a table."""
    rows = (HEADER.strip(), "P1,1,tactile,1,12!5,detected", "P2,1,tactile,1,9,detected")
    text = "".join(f"{row},,\n" for row in rows).replace(",", separator)
    table = read_table(write(tmp_path, "\ufeff" + text.replace("!", ",").replace("\n", "\r\n")), TRIAL)
    assert table.columns["size_mm"] == [12.5, 9.0]
    assert table.columns["status"] == ["detected", "detected"]
    assert describe(table.path)["kind"] == "table: trial"


@pytest.mark.parametrize(
    ("text", "separator"),
    [
        ("a,b\n1,2\n", ","),
        ("a;b\n1,5;2\n", ";"),
        ("size (cm, largest, pathology);patient\n1,5;P1\n", ";"),
        ('"size (cm, largest)";patient\n"1,5";P1\n', ";"),
        ("note; free,patient\nx,P1\n", ","),
        ("a\tb\n1,5\t2\n", "\t"),
        ("patient\nP1\n", ","),
        ("a,b,c\n1,2\n", ","),
        ("a;b", ";"),
        ("", ","),
    ],
)
def test_the_separator_is_told_by_two_lines(text: str, separator: str) -> None:
    assert csv_separator(text) == separator


def test_size_table_needs_three_columns(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "d_mm,amplitude,sigma_x_mm\n15,-0.1,8\n"), SIZES)
    assert table.columns["amplitude"] == [-0.1]
    assert table.columns["sigma_y_mm"] == [None]


FAULTS = {
    "empty file": (b"", ["is empty", "patient"]),
    "only blank lines": ("\n\n", ["is empty"]),
    "header only": (HEADER, ["no rows"]),
    "utf-16": ((HEADER + ROW).encode("utf-16"), ["UTF-16", "CSV UTF-8"]),
    "latin-1": ((HEADER + "P\xe9,1,tactile,1,1,detected\n").encode("latin-1"), ["line 2", "0xe9", "CSV UTF-8"]),
    "semicolons, a point and a comma": (
        (HEADER + ROW + "P2,1,tactile,1,9!5,detected\n").replace(",", ";").replace("!", ","),
        ["line 2", "'12.5' has a point", "one way"],
    ),
    "semicolons and thousands": (
        (HEADER + "P1,1,tactile,1,1!234,detected\n").replace(",", ";").replace("!", ","),
        ["write 1234 or 1.234"],
    ),
    "semicolons and a cell too many": ((HEADER + ROW).replace(",", ";").strip() + ";7\n", ["line 2", "7 cells"]),
    "a report": ('{\n  "schema": "tactile-bayes/validate/1"}', ["is JSON, not CSV"]),
    "open quote": (HEADER + 'P1,1,"tactile,1,12.5,detected\n', ["line 2", "not CSV", "quotes"]),
    "ragged short": (HEADER + "P1,1,tactile,1,12.5\n", ["line 2", "5 cells under 6 columns"]),
    "bare decimal comma": (HEADER + "P1,1,tactile,1,12,5,detected\n", ["line 2", "7 cells", "12.5, not 12,5"]),
    "quoted decimal comma": (HEADER + 'P1,1,tactile,1,"12,5",detected\n', ["column size_mm", "write 12.5"]),
    "unknown column": (HEADER.replace("modality", "modalty") + ROW, ["modalty", "did you mean modality?"]),
    "capital column": (HEADER.replace("patient", "Patient") + ROW, ["Patient", "did you mean patient?"]),
    "blank in column": (HEADER.replace(",mass", ", mass") + ROW, ["' mass'", "did you mean mass?"]),
    "size in cm": (HEADER.replace("size_mm", "size_cm") + ROW, ["size_cm", "size_mm", "multiply by 10"]),
    "size without unit": (HEADER.replace("size_mm", "size") + ROW, ["did you mean size_mm, in millimetres?"]),
    "strange column": (HEADER.strip() + ",zzz\n" + ROW, ["zzz", "remove it"]),
    "nameless column": (
        HEADER.strip() + ",\n" + ROW.strip() + ",x\n",
        ["column ''", "remove it", "--columns MAP.toml"],
    ),
    "missing column": (HEADER.replace(",status", "") + "P1,1,tactile,1,12.5\n", ["status", "is missing"]),
    "missing size column": (HEADER.replace(",size_mm", "") + "P1,1,cbe,1,not_done\n", ["size_mm", "is missing"]),
    "column twice": (HEADER.strip() + ",mass\n", ["mass", "more than once"]),
    "word for a number": (HEADER + "P1,1,tactile,1,large,detected\n", ["size_mm", "'large'", "not a number"]),
    "number with unit": (HEADER + "P1,1,tactile,1,12 mm,detected\n", ["'12 mm'", "digits only in mm"]),
    "underscore": (HEADER + "P1,1,tactile,1,1_2,detected\n", ["'1_2'", "not a number"]),
    "other digits": (HEADER + "P1,1,tactile,1,\u0661\u0662,detected\n", ["not a number"]),
    "nan": (HEADER + "P1,1,tactile,1,NaN,detected\n", ["'NaN'", "finite", "blank"]),
    "minus infinity": (HEADER + "P1,1,tactile,1,-inf,detected\n", ["'-inf'", "finite"]),
    "overflow": (HEADER + "P1,1,tactile,1,1e999,detected\n", ["'1e999'", "finite"]),
    "zero": (HEADER + "P1,1,tactile,1,0,detected\n", ["size_mm", "is 0", "not_detected"]),
    "minus zero": (HEADER + "P1,1,tactile,1,-0.0,not_detected\n", ["is 0", "not_detected"]),
    "negative": (HEADER + "P1,1,tactile,1,-3,detected\n", ["size_mm", "'-3'", "above 0"]),
    "replicate 0": (HEADER + "P1,1,tactile,0,3,detected\n", ["replicate", "at least 1"]),
    "replicate 1.5": (HEADER + "P1,1,tactile,1.5,3,detected\n", ["replicate", "whole number"]),
    "unknown status": (HEADER + "P1,1,tactile,1,3,Detected\n", ["status", "did you mean detected?", "not_done"]),
    "capital modality": (HEADER + "P1,1,CBE,1,3,detected\n", ["modality", "'CBE'", "write cbe"]),
    "blank patient": (HEADER + ",1,tactile,1,3,detected\n", ["patient", "is blank"]),
    "padded cell": (HEADER + "P1 ,1,tactile,1,3,detected\n", ["patient", "'P1 '", "remove"]),
    "line end in cell": (HEADER + '"P\n1",1,tactile,1,3,detected\n', ["line 2", "'P\\n1'", "unprintable"]),
    "escape code": (HEADER + "P\x1b[31m,1,tactile,1,3,detected\n", ["'P\\x1b[31m'", "unprintable"]),
    "probability in percent": (
        HEADER.strip() + ",probability\n" + ROW.strip() + ",95\n",
        ["probability", "'95'", "below 1", "0.95"],
    ),
    "neither true nor false": (HEADER.strip() + ",synthetic\n" + ROW.strip() + ",perhaps\n", ["true or false"]),
    "key twice": (HEADER + ROW + "P2,1,tactile,1,9,detected\n" + ROW, ["line 4", "'P1'", "line 2 already"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_one_line_that_says_where_and_what_to_do(tmp_path: Path, fault: str) -> None:
    text, words = FAULTS[fault]
    path = write(tmp_path, text)
    with pytest.raises(BadDataError) as caught:
        read_table(path, TRIAL)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert "\x1b" not in message
    assert caught.value.way_out
    assert caught.value.exit_code == EXIT_BAD_DATA
    for word in words:
        assert word in message


def test_missing_file_and_folder_are_bad_data(tmp_path: Path) -> None:
    for path, words in ((tmp_path / "none.csv", "cannot be read"), (tmp_path, "is a directory; give a regular file")):
        with pytest.raises(BadDataError, match=words):
            read_table(path, TRIAL)


def test_the_first_fault_in_reading_order_is_reported(tmp_path: Path) -> None:
    path = write(tmp_path, HEADER + ROW + "P2,1,tactile,1,x,detected\nP3,1,tactile,1,y,detected\n")
    with pytest.raises(BadDataError, match=r"line 3, column size_mm: 'x'"):
        read_table(path, TRIAL)


FINITE = st.floats(allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=0, exclude_min=True, allow_nan=False, allow_infinity=False)


@given(rows=st.lists(st.tuples(POSITIVE, FINITE, POSITIVE), min_size=1, max_size=5))
def test_any_valid_number_round_trips(tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]) -> None:
    out = io.StringIO(newline="")
    csv.writer(out).writerows([("d_mm", "amplitude", "sigma_x_mm"), *rows])
    table = read_table(write(tmp_path_factory.mktemp("tables"), out.getvalue()), SIZES)
    names = ("d_mm", "amplitude", "sigma_x_mm")
    assert list(zip(*(table.columns[name] for name in names), strict=True)) == rows


@given(text=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, text: bytes) -> None:
    for body in (text, HEADER.encode() + text):
        try:
            read_table(write(tmp_path_factory.mktemp("tables"), body), TRIAL)
        except BadDataError as error:
            assert "\n" not in str(error)  # noqa: PT017 - success is an answer too


@pytest.mark.parametrize("name", [TRIAL, EXCISION, SIZES])
def test_schemas_use_only_what_the_reader_enforces(name: str) -> None:
    schema = load_schema(name)
    enforced = {"required", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "enum", "pattern"}
    names = [field["name"] for field in schema["fields"]]
    assert len(set(names)) == len(names)
    for field in schema["fields"]:
        assert set(field.get("constraints", {})) <= enforced
        assert field["type"] in {"string", "number", "integer", "boolean", "date"}
        assert field["description"].endswith(".")
    assert set(schema.get("primaryKey", [])) <= set(names)
    assert json.dumps(schema).isascii()
