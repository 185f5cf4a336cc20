"""The command `validate`: what it prints and writes, and the line and exit code of each refusal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from click.testing import CliRunner, Result
from published_schemas import check_document
from synthetic_trial import excision_csv, trial_csv

import tactile_bayes
from tactile_bayes.commands.trial import validate_command as command
from tactile_bayes.errors import EXIT_BAD_DATA, EXIT_USAGE, BadDataError, UsageError
from tactile_bayes.presets import RESEARCH_USE

DEMO = Path(tactile_bayes.__file__).parent / "demo"
TRIAL, EXCISION = DEMO / "trial.csv", DEMO / "excision.csv"


def validate(*args: object) -> Result:
    return CliRunner().invoke(command, [str(arg) for arg in args])


def test_shipped_trial_is_what_its_generator_makes() -> None:
    assert TRIAL.read_bytes() == trial_csv().encode()
    assert EXCISION.read_bytes() == excision_csv().encode()


def test_shipped_trial_has_the_papers_shape() -> None:
    document = json.loads(validate(TRIAL, "--excision", EXCISION, "--json").stdout)
    counts = document["counts"]
    assert (counts["patients"], counts["masses"]) == (24, 25)
    assert counts["synthetic_readings"] == counts["readings"]
    modalities = document["modalities"]
    assert {name: (one["n"], one["detected"]) for name, one in modalities.items()} == {
        "tactile": (25, 25),
        "ultrasound": (25, 24),
        "cbe": (25, 24),
    }
    assert 3 * 25 <= modalities["tactile"]["readings"] <= 5 * 25


def test_json_printed_and_written_are_the_same_bytes_every_time(tmp_path: Path) -> None:
    printed = validate(TRIAL, "--excision", EXCISION, "--json", "-o", tmp_path / "a.json")
    again = validate(TRIAL, "--excision", EXCISION, "-o", tmp_path / "b.json")
    assert (printed.exit_code, again.exit_code) == (0, 0)
    assert printed.stdout_bytes == (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    document = json.loads(printed.stdout)
    check_document(document, "validate.schema.json")
    assert document["schema"] == "tactile-bayes/validate/1"
    assert document["research_use"] == RESEARCH_USE
    assert [one["role"] for one in document["provenance"]["inputs"]] == ["trial", "excision"]
    assert "S01" not in printed.stdout  # no patient, however coded
    assert str(DEMO) not in printed.stdout


def test_text_names_units_ratios_and_ends_with_the_research_line() -> None:
    lines = validate(TRIAL, "--excision", EXCISION).stdout.splitlines()
    text = "\n".join(lines)
    assert "25 masses of 24 patients" in lines[0]
    assert "synthetic" in lines[0]
    for words in ("error %", "error mm", "intervals cover", "clinical breast examination (cbe)"):
        assert words in text
    assert lines[-1] == RESEARCH_USE
    assert "MAPE" not in text


def test_a_sentence_compares_the_tactile_error_with_each_other_one() -> None:
    """The paired comparison's ratio, interval and Holm's p, whichever of the two the table names first."""
    text = validate(TRIAL, "--excision", EXCISION).stdout
    assert "tactile errs 0.45 times as much as ultrasound, 95 % 0.26 to 0.78, p .028, 25 masses\n" in text
    pairs = json.loads(validate(TRIAL, "--excision", EXCISION, "--json").stdout)["paired_comparisons"]
    one = next(pair for pair in pairs if {pair["first"], pair["second"]} == {"tactile", "ultrasound"})
    assert (round(one["ratio"], 2), [round(end, 2) for end in one["ratio_interval"]]) == (0.45, [0.26, 0.78])
    assert round(one["p_holm"], 3) == 0.028


def test_the_comparison_is_the_inverse_where_the_other_modality_comes_first(tmp_path: Path) -> None:
    """Errors of 10 % against 40 % in every one of eight masses: a quarter; then masses that differ, in both orders."""
    keys = [f"P{i},1" for i in range(8)]
    for spread, told in ((0, "no interval: the figure is the same"), (0.02, "95 % 0.")):
        sentences = set()
        for order in (("mri", "tactile"), ("tactile", "mri")):
            errors = {name: 0.4 if name == "mri" else 0.1 for name in order}
            rows = [
                f"{key},{name},1,{10 * (1 + errors[name] + spread * (i % 3)):g},detected\n"
                for name in order
                for i, key in enumerate(keys)
            ]
            text = validate(*split(*small(tmp_path, "".join(rows), "".join(f"{key},10\n" for key in keys)))).stdout
            sentences |= {line for line in text.splitlines() if line.startswith("tactile errs")}
        (sentence,) = sentences
        assert sentence.startswith(f"tactile errs {0.25 if not spread else 0.28} times as much as mri, {told}")
        assert sentence.endswith(", p .0078, 8 masses")


def test_without_a_tactile_reading_every_pair_is_compared(tmp_path: Path) -> None:
    rows = "P1,1,mri,1,12,detected\nP1,1,us,1,11,detected\nP2,1,mri,1,22,detected\nP2,1,us,1,25,detected\n"
    text = validate(*split(*small(tmp_path, rows))).stdout
    assert "mri errs 0.86 times as much as us, no interval: an interval needs at least 8 patients (found 2)" in text


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", ["us", "clinical_breast_examination"])
def test_the_table_fits_80_columns(name: str, tmp_path: Path) -> None:
    text = validate(TRIAL, "--excision", EXCISION).stdout
    trial, ex = tmp_path / "t.csv", EXCISION
    trial.write_text(TRIAL.read_text().replace(",cbe,", f",{name},"))
    for one in (text, validate(trial, "--excision", ex).stdout):
        table = one.split("\n\n")[1]
        assert "25 of 25" in table
        assert max(map(len, table.splitlines())) <= 80


def small(folder: Path, rows: str, excision: str = "P1,1,10\nP2,1,20\n") -> tuple[Path, Path]:
    trial, ex = folder / "trial.csv", folder / "ex.csv"
    trial.write_text("patient,mass,modality,replicate,size_mm,status\n" + rows)
    ex.write_text("patient,mass,ex_vivo_mm\n" + excision)
    return trial, ex


def split(trial: Path, ex: Path) -> tuple[object, ...]:
    return trial, "--excision", ex


def test_few_patients_get_no_interval_and_are_told_why(tmp_path: Path) -> None:
    trial, ex = small(tmp_path, "P1,1,cbe,1,12,detected\nP2,1,cbe,1,,not_detected\n")
    text = validate(trial, "--excision", ex).stdout
    assert "cbe: no interval of error %, error mm, slope: an interval needs at least 8 patients (found 2)" in text
    assert "cbe: no interval of bias %: an interval needs at least 8 patients (found 1)" in text
    assert "synthetic" not in text
    one = json.loads(validate(trial, "--excision", ex, "--json").stdout)["modalities"]["cbe"]
    assert one["mape_percent"] == pytest.approx(60)
    assert one["mape_percent_interval"] is None
    assert "8 patients" in one["reasons"]["mape_percent_interval"]
    assert one["r2_centred_detected"] is None


def test_masses_without_readings_are_counted_not_refused(tmp_path: Path) -> None:
    withdrawn = "P9,1,cbe,1,,\n"
    rows = f"P1,1,cbe,1,12,detected\nP2,1,cbe,1,,not_done\n{withdrawn}"
    tables = split(*small(tmp_path, rows, "P1,1,10\nP2,1,20\nP3,1,9\n"))
    text = validate(*tables, "--html", tmp_path / "page.html").stdout
    assert "3 masses of 3 patients" in text
    for output in (text, (tmp_path / "page.html").read_text()):
        assert "1 excised mass without any reading, left out." in output
    assert "1 not done, 1 without a row" in text


def refusal(*args: object) -> Exception:
    result = validate(*args)
    assert isinstance(result.exception, Exception)
    assert "\n" not in str(result.exception)
    return result.exception


def test_faults_between_tables_name_file_line_and_way_out(tmp_path: Path) -> None:
    trial, ex = small(tmp_path, "P1,1,cbe,1,12,detected\nP9,1,cbe,1,12,detected\n")
    error = refusal(trial, "--excision", ex)
    assert isinstance(error, BadDataError)
    assert str(error).startswith(f"{trial}: line 3, column patient + mass: 'P9' + '1' has no size in {ex}")
    trial, ex = small(tmp_path, "P1,1,cbe,1,,detected\n")
    assert "line 2, column size_mm: is blank while status is detected" in str(refusal(trial, "--excision", ex))
    ex.write_text("patient,mass,ex_vivo_mm,ex_vivo_second_mm\nP1,1,10,10\nP2,1,12,20\n")
    exchanged = "line 3, column ex_vivo_second_mm: is 20, above ex_vivo_mm 12, which is the largest extent; exchange"
    assert exchanged in str(refusal(trial, "--excision", ex))


def test_an_existing_output_is_kept_without_force(tmp_path: Path) -> None:
    output = tmp_path / "report.json"
    output.write_text("mine")
    assert isinstance(refusal(TRIAL, "--excision", EXCISION, "-o", output), UsageError)
    assert output.read_text() == "mine"
    assert validate(TRIAL, "--excision", EXCISION, "-o", output, "--force").exit_code == 0
    check_document(json.loads(output.read_text()), "validate.schema.json")


def test_an_input_is_never_overwritten(tmp_path: Path) -> None:
    trial, ex = small(tmp_path, "P1,1,cbe,1,12,detected\n")
    before = ex.read_bytes()
    trial, ex = (one.rename(tmp_path / one.stem) for one in (trial, ex))  # JSON is not written to a .csv at all
    for output in (trial, ex):
        assert "is an input" in str(refusal(trial, "--excision", ex, "-o", output, "--force"))
    assert ex.read_bytes() == before


Run = Callable[..., CompletedProcess[str]]


def test_exit_codes_and_single_lines_of_the_program(tmp_path: Path, run_cli: Run) -> None:
    trial, ex = small(tmp_path, "P1,1,cbe,1,0,detected\n")
    bad = run_cli("validate", trial, "--excision", ex)
    assert (bad.returncode, bad.stdout) == (EXIT_BAD_DATA, "")
    assert bad.stderr.count("\n") == 1
    assert "does 0 mean that the mass was not found?" in bad.stderr
    assert run_cli("validate", trial).returncode == EXIT_USAGE
    good = run_cli("validate", TRIAL, "--excision", EXCISION)
    assert (good.returncode, good.stderr) == (0, "")


@pytest.mark.long
def test_validate_needs_no_slow_library(run_python: Run) -> None:
    code = (
        "import sys\nfrom tactile_bayes.commands.trial import validate_command\n"
        "assert 'numpy' not in sys.modules\n"
        f"validate_command(['{TRIAL}', '--excision', '{EXCISION}', '--json'], standalone_mode=False)\n"
        "print({'scipy.stats', 'pandas', 'matplotlib'} & set(sys.modules), file=sys.stderr)"
    )
    done = run_python("-c", code)
    assert (done.returncode, done.stderr) == (0, "set()\n")
