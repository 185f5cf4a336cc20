"""What a trial is doubted, refused or left without an interval for: units, commas, intervals, options without use."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from published_schemas import check_document

import tactile_bayes
from tactile_bayes.commands.trial import plan_command, validate_command
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.report.trial import trial_text
from tactile_bayes.trial.figures import Figure, Intervals, UndefinedError
from tactile_bayes.trial.lines import deming
from tactile_bayes.trial.method_comparison import errors_are_proportional
from tactile_bayes.trial.readings import ModalitySizes, Reading, Trial, unit_doubts
from tactile_bayes.trial.summary import TrialReport, summarise

DEMO = Path(tactile_bayes.__file__).parent / "demo"
TRIAL, EXCISION = DEMO / "trial.csv", DEMO / "excision.csv"
SMALL = ("--patients", 8, "--maps", 1, "--trials", 50)
PILOT = ("--pilot", TRIAL, "--excision", EXCISION)


def run(command, *args: object) -> Result:
    return CliRunner().invoke(command, [str(arg) for arg in args])


def report(masses: list[tuple[float, list[float]]], name: str = "cbe") -> TrialReport:
    """A mass and a patient for each ex-vivo size with its readings."""
    ex_vivo = {(f"P{i:02d}", "1"): e for i, (e, _) in enumerate(masses)}
    readings = [
        Reading(key, name, number, "detected", size)
        for key, (_, sizes) in zip(ex_vivo, masses, strict=True)
        for number, size in enumerate(sizes, start=1)
    ]
    return summarise(Trial(readings, ex_vivo), intervals=Intervals(0.95, method="corrected"))


def test_replicates_of_one_patient_alone_give_a_figure_and_no_interval() -> None:
    """Ten equal pairs, one off by 0.1 mm, one of 20 and 28 mm: the SD rests on the last, and its upper end overflowed.

    By hand: SD of ln size sqrt((ln(1.005)^2 + ln(1.4)^2) / 2 / 12) = 0.0687; exp(1.96 sqrt(2) 0.0687) = 1.2097.
    """
    pairs = [(10.0 + i, [11.0 + i, 11.0 + i]) for i in range(10)]
    made = report([*pairs, (20.0, [20.0, 20.1]), (24.0, [20.0, 28.0])])
    figure = made.modalities["cbe"].replicates.figure("repeatability_high_percent")
    assert figure.value == pytest.approx(20.97, abs=0.01)
    assert figure.interval is None
    assert "rests on one or two patients" in figure.interval_reason
    assert "e+" not in trial_text(made, methods=True)


def test_ends_that_overflow_leave_no_interval() -> None:
    made = Figure(1.0, interval=(0.5, 1000.0), has_interval=True).mapped(math.exp)
    assert made.interval is None
    assert "double precision" in made.interval_reason


@pytest.mark.parametrize("scale", [1e-120, 1e-5, 1e120])
def test_any_scale_has_a_report(scale: float) -> None:
    """Numpy's warnings are errors here."""
    rng = np.random.default_rng(0)
    made = report([(scale * e, [scale * e * f for f in rng.lognormal(0, 0.2, 2)]) for e in rng.uniform(8, 30, 12)])
    assert made.modalities["cbe"].mape_percent_interval is not None
    assert any("are they in mm?" in doubt for doubt in made.doubts)


def sizes(ratio: float, n: int = 12) -> ModalitySizes:
    e = np.linspace(10.0, 30.0, n)
    return ModalitySizes("cbe", np.arange(n), e, ratio * e, tuple((ratio * e)[:, None]))


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (0.09, "cbe sizes in cm"),
        (11.0, "ex-vivo sizes in cm"),
        (0.04, "cbe sizes in inches"),
        (24.0, "in inches"),
        (1.0, "all 12 cbe sizes are the ex-vivo sizes: were they copied from there?"),
    ],
)
def test_a_median_ratio_near_a_unit_and_a_copied_column_are_doubted(ratio: float, words: str) -> None:
    one = sizes(ratio)
    assert any(words in doubt for doubt in unit_doubts({"cbe": one}, one.ex_vivo_mm))


def test_some_sizes_in_another_unit_are_doubted() -> None:
    """Two of twelve masses read in cm leave the median as it is."""
    one = sizes(1.1)
    one.size_mm[[2, 5]] /= 10
    doubts = unit_doubts({"cbe": one}, one.ex_vivo_mm)
    assert doubts == ["2 of 12 cbe sizes about 1/10 of the ex-vivo size: is the cbe size there in cm?"]


@pytest.mark.parametrize("ratio", [0.4, 1.01, 3.0])
def test_other_ratios_are_not_doubted(ratio: float) -> None:
    one = sizes(ratio)
    assert unit_doubts({"cbe": one}, one.ex_vivo_mm) == []


@pytest.mark.parametrize(
    ("masses", "pairs"),
    [
        ([("7", "1"), ("007", "1"), ("007", "2")], ["patients 7 and 007"]),
        ([("P1", "1"), ("p1", "1"), ("Q", "a"), ("Q", "A")], ["patients P1 and p1", "masses of Q, a and A"]),
        ([("P1", "1"), ("P1", "2"), ("P01", "1"), ("Q1", "01")], []),  # zeros within a code may mean something
    ],
)
def test_codes_that_may_be_of_one_patient_or_mass_are_doubted(masses: list[tuple[str, str]], pairs: list[str]) -> None:
    """Two patients for one make intervals too narrow; `campaign run` refuses such codes."""
    ex_vivo_mm = {key: 12.0 + i for i, key in enumerate(masses)}
    readings = [Reading(key, "tactile", 1, "detected", size_mm=13.0) for key in masses]
    assert Trial(readings, ex_vivo_mm).doubts() == [
        f"{one} differ by capitals or leading zeros alone: are they one?" for one in pairs
    ]


@pytest.mark.long
def test_a_doubt_and_a_protocols_title_reach_page_json_and_stderr(tmp_path: Path) -> None:
    rows = [line.split(",") for line in TRIAL.read_text().splitlines()]
    rows = [[*row[:4], str(float(row[4]) / 10), *row[5:]] if row[2] == "cbe" and row[4] else row for row in rows]
    (tmp_path / "t.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    (tmp_path / "p.toml").write_text('title = "Primary: <MAPE>"\n')
    options = ("--protocol", tmp_path / "p.toml", "--html", tmp_path / "r.html", "--json")
    printed = run(validate_command, tmp_path / "t.csv", "--excision", EXCISION, *options)
    document, page = json.loads(printed.stdout), (tmp_path / "r.html").read_text()
    check_document(document, "validate.schema.json")
    assert any("are the cbe sizes in cm?" in doubt for doubt in document["doubts"])
    assert "are the cbe sizes in cm?" in printed.stderr
    assert page.count("are the cbe sizes in cm?") == 2  # marked at the top, and in the text report at the end
    assert document["title"] == "Primary: <MAPE>"
    assert "Primary: &lt;MAPE&gt;" in page


def test_the_demo_is_not_doubted() -> None:
    assert json.loads(run(validate_command, TRIAL, "--excision", EXCISION, "--json").stdout)["doubts"] == []


def with_first_row(folder: Path, **cells: str) -> tuple[object, ...]:
    header, first, *rest = TRIAL.read_text().splitlines()
    row = dict(zip(header.split(","), first.split(","), strict=True)) | cells
    (folder / "t.csv").write_text("\n".join([header, ",".join(row.values()), *rest]) + "\n")
    return folder / "t.csv", "--excision", EXCISION


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"size_mm": "99"}, "line 2, column size_mm: is 99, outside its own interval"),
        ({"size_mm": '"1,200"'}, "write 1200 or 1.200, whichever is meant"),
        ({"size_mm": '"12,5"'}, "has a decimal comma; write 12.5"),
        ({"modality": "Tactile"}, "write tactile, in small letters"),
        ({"size_mm": '"0,125"'}, "has a decimal comma; write 0.125"),
    ],
)
def test_a_cell_that_contradicts_itself_is_named(tmp_path: Path, cells: dict[str, str], words: str) -> None:
    error = run(validate_command, *with_first_row(tmp_path, **cells)).exception
    assert isinstance(error, BadDataError)
    assert words in str(error)


def test_a_spreadsheet_is_told_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "t.xlsx").write_bytes(b"PK\x03\x04\x14\x00\xe2\x28")
    error = run(validate_command, tmp_path / "t.xlsx", "--excision", EXCISION).exception
    assert "is a spreadsheet" in str(error)
    assert "export the sheet as CSV UTF-8" in str(error)


def test_deming_has_no_slope_without_covariance_up_to_rounding() -> None:
    """By symmetry the products cancel; without rounding they would be 0, with it the slope was 4e16."""
    x = np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3]) + 10
    y = np.array([1.1, 3.3, 1.1, 9.9, 7.7, 9.9]) + 0.1
    with pytest.raises(UndefinedError, match="vertical or every direction"):
        deming(x, y)
    assert deming(y, x).slope == pytest.approx(0, abs=1e-12)
    assert deming(x, y + 1e-6 * x).slope > 1e3  # a real covariance, however small, is kept


def test_errors_that_grow_with_size_are_seen_and_constant_ones_are_not() -> None:
    rng = np.random.default_rng(3)
    seen = {"proportional": 0, "constant": 0}
    for _ in range(200):
        e = 16 * np.exp(rng.normal(0, 0.38, 25))
        seen["proportional"] += errors_are_proportional(e, e * np.exp(rng.normal(0, 0.2, 25)))
        seen["constant"] += errors_are_proportional(e, e + rng.normal(0, 2.0, 25))
    assert seen["proportional"] > 120
    assert seen["constant"] < 20


FLOATS = ("--tactile-bias", "--mass-sd", "--map-sd", "--other-bias", "--other-sd", "--other-miss")


@pytest.mark.parametrize("value", ["nan", "inf", "1000"])
@pytest.mark.parametrize("option", FLOATS)
def test_plan_takes_no_number_that_is_none(option: str, value: str) -> None:
    result = run(plan_command, *SMALL, option, value)
    assert result.exit_code == 2
    assert option in result.output


@pytest.mark.parametrize("value", ["nan", "inf", "0", "1e308"])
def test_validate_takes_no_such_error_ratio(tmp_path: Path, value: str) -> None:
    result = run(validate_command, TRIAL, "--excision", EXCISION, "--error-ratio", value)
    assert result.exit_code == 2
    assert "--error-ratio" in result.output
    (tmp_path / "p.toml").write_text(f"[analysis]\nerror_ratio = {value}\n")
    error = run(validate_command, TRIAL, "--excision", EXCISION, "--protocol", tmp_path / "p.toml").exception
    assert isinstance(error, BadDataError)
    assert "error_ratio" in str(error)


@pytest.mark.long
def test_a_whole_number_written_as_a_float_is_one(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text('[analysis]\nintervals = "bca"\nresamples = 200.0\n')
    result = run(validate_command, TRIAL, "--excision", EXCISION, "--protocol", tmp_path / "p.toml", "--json")
    assert json.loads(result.stdout)["provenance"]["settings"]["resamples"] == 200


@pytest.mark.parametrize("options", [("--excision", EXCISION), ("--against", "cbe"), (*PILOT, "--against", "tactile")])
def test_plan_ignores_no_option(options: tuple[object, ...]) -> None:
    error = run(plan_command, *SMALL, *options).exception
    assert isinstance(error, UsageError)
    assert str(options[-2]) in str(error)


def test_an_option_beside_a_pilot_is_used_and_told() -> None:
    printed = run(plan_command, *SMALL, *PILOT, "--mass-sd", "0.3")
    assert "Given by options: mass sd 0.3; the others are the pilot's." in printed.stdout
    document = json.loads(run(plan_command, *SMALL, *PILOT, "--mass-sd", "0.3", "--json").stdout)
    assert document["errors"]["mass_sd"] == 0.3
    assert document["errors_from"]["mass_sd"] == "option"
    assert document["errors_from"]["map_sd"] == "pilot"


def test_a_pilot_without_replicates_asks_for_the_sd_of_maps(tmp_path: Path) -> None:
    kept = [line for line in TRIAL.read_text().splitlines() if ",tactile," not in line or ",tactile,1," in line]
    (tmp_path / "t.csv").write_text("\n".join(kept) + "\n")
    pilot = ("--pilot", tmp_path / "t.csv", "--excision", EXCISION)
    assert "give it with --map-sd" in str(run(plan_command, *SMALL, *pilot).exception)
    errors = json.loads(run(plan_command, *SMALL, *pilot, "--map-sd", "0.15", "--json").stdout)["errors"]
    assert errors["map_sd"] == 0.15
    assert 0 < errors["mass_sd"] < 0.25
