"""`validate` beyond the plain table: wide tables, estimates, protocols, intervals, the page and the paper's check."""

from __future__ import annotations

import hashlib
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import tactile_bayes
from tactile_bayes.commands.trial import validate_command as command
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.presets import RESEARCH_USE

DEMO = Path(tactile_bayes.__file__).parent / "demo"
TRIAL, EXCISION = DEMO / "trial.csv", DEMO / "excision.csv"


def validate(*args: object) -> Result:
    return CliRunner().invoke(command, [str(arg) for arg in args])


def document(*args: object) -> dict:
    result = validate(*args, "--json")
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(result.stdout)


def refusal(*args: object) -> str:
    error = validate(*args).exception
    assert isinstance(error, BadDataError | UsageError), error
    assert "\n" not in str(error)
    return str(error)


WIDE = (
    "record_id,ex_mm,us_cm,map1,map2,map1_low,map1_high\nP1,10,1.2,11,12,9,14\nP2,20,NV,19,,15,24\nP3,15,,16,14,12,20\n"
)
MAPPING = """
patient = "record_id"
not_detected = ["NV"]
[excision]
size = "ex_mm"
[[reading]]
modality = "ultrasound"
size = "us_cm"
unit = "cm"
[[reading]]
modality = "tactile"
size = "map1"
low = "map1_low"
high = "map1_high"
probability = 0.9
[[reading]]
modality = "tactile"
replicate = 2
size = "map2"
"""


def wide(folder: Path, table: str = WIDE, mapping: str = MAPPING) -> tuple[object, ...]:
    (folder / "wide.csv").write_text(table)
    (folder / "map.toml").write_text(mapping)
    return folder / "wide.csv", "--excision", folder / "wide.csv", "--columns", folder / "map.toml"


def test_a_wide_table_is_read_by_its_mapping(tmp_path: Path) -> None:
    found = document(*wide(tmp_path))["modalities"]
    assert (found["ultrasound"]["n"], found["ultrasound"]["detected"], found["ultrasound"]["masses_not_done"]) == (
        2,
        1,
        1,
    )
    assert found["ultrasound"]["mape_detected_percent"] == pytest.approx(20)  # 1.2 cm of 10 mm
    assert found["tactile"]["readings"] == 5
    assert document(*wide(tmp_path))["counts"]["readings"] == 7  # a blank cell is none
    assert found["tactile"]["coverage"][0]["probability"] == 0.9


@pytest.mark.parametrize(
    ("table", "mapping", "words"),
    [
        (WIDE.replace("1.2", "0"), MAPPING, 'line 2, column us_cm: is 0; does 0 mean that the mass was not found'),
        (WIDE.replace("1.2", "ND"), MAPPING, 'us_cm: is ND; does ND mean that the mass was not found? then add '
         'not_detected = ["ND"] to the mapping; that it was not looked for? not_done = ["ND"]'),
        (WIDE.replace("P1,10", "P1,0"), MAPPING, "is 0; was the mass not measured? then leave the cell blank"),
        (WIDE.replace("1.2", "-1.2"), MAPPING, "line 2, column us_cm: is -1.2; a size is above 0"),
        (WIDE.replace("10,1.2", ",1.2").replace("20,NV", ",NV").replace("15,,", ",,"), MAPPING, "ex_mm: holds no size"),
        (WIDE.replace("1.2", "about 1"), MAPPING, "line 2, column us_cm: 'about 1' is not a number"),
        (WIDE.replace("1.2", "<1"), MAPPING, "'<1' is a bound, not a number; give the number measured"),
        (WIDE.replace("1.2", "1.2%"), MAPPING, "'1.2%' has a percent sign; write the number that is meant without it"),
        (WIDE.replace("9,14", "9,"), MAPPING, "line 2, column map1_high: is blank while the interval's other cells are "
         "not; an interval needs map1_low, map1_high and probability, or all three blank"),
        (WIDE.replace("9,14", "14,9"), MAPPING, "column map1_low: is 14, above map1_high 9; exchange or correct them"),
        (WIDE.replace("P2,20", "P1,20"), MAPPING, "line 3, column record_id: 'P1' + '1' stands on line 2 already"),
        (WIDE.replace("P1,10", "P1,"), MAPPING, "line 2, column record_id: 'P1' + '1' has no size in"),
        (WIDE.replace("9,14", "-9,14"), MAPPING, "line 2, column map1_low: '-9' is not at least 0"),
        (WIDE.replace("NV", "0"), MAPPING.replace('"ex_mm"', '"ex_mm"\nsecond = "us_cm"'),
         "column us_cm: is 0; was it not measured? then leave the cell blank"),
        (WIDE.replace("P2", "P1"), MAPPING, "stands on line 2 already"),
        (WIDE.replace("P2", ""), MAPPING, "line 3"),
        (WIDE, MAPPING.replace("map2", "map3"), "column map3: is missing"),
        (WIDE, MAPPING.replace("map2", "map1"), "map.toml: column map1 is named 2 times; give each reading its own"),
        (WIDE, MAPPING.replace("replicate = 2", ""), "map.toml: replicate 1 of tactile is named 2 times"),
        (WIDE, MAPPING.replace("not_detected", 'not_done = ["NV"]\nnot_detected', 1),
         "map.toml: NV stands in not_detected and in not_done; leave it in one of them"),
        (WIDE, MAPPING.replace("probability = 0.9", ""), "without probability"),
        (WIDE, MAPPING + "colour = 1\n", "map.toml"),
        (WIDE, "patient = [", "see A wide table in docs/guides/validate.md"),
    ],
)  # fmt: skip
def test_a_wide_tables_faults_are_named(tmp_path: Path, table: str, mapping: str, words: str) -> None:
    assert words in refusal(*wide(tmp_path, table, mapping))


def estimates(folder: Path, size: dict | None) -> Path:
    quantity = dict.fromkeys(
        ("min_size_mm", "d_x_mm", "d_y_mm", "amplitude", "sigma_x_mm", "sigma_y_mm", "centre_mm", "angle_deg",
         "background", "noise_sd", "detected_probability", "variance_share")
    )  # fmt: skip
    made = {"schema": "tactile-bayes/estimate/1", "status": "estimate" if size else "no_estimate", "reason": "",
            "verdict": "sound" if size else "no_answer", "findings": [],
            "max_size_mm": size, **quantity, "diagnostics": {}, "candidates": [], "masses": [], "left_out": [],
            "prior": {}, "research_use": "x", "provenance": {}}  # fmt: skip
    path = folder / "estimate.json"
    path.write_text(json.dumps(made))
    return path


SIZE = {"median": 12.0, "mean": 12.1, "sd": 1.0, "low": 10.0, "high": 14.0, "probability": 0.9, "kind": "eti"}


def with_posterior(folder: Path, cells: str) -> tuple[object, ...]:
    (folder / "t.csv").write_text(
        f"patient,mass,modality,replicate,size_mm,status,posterior\nP1,1,tactile,1,{cells}\nP2,1,tactile,1,9,detected,\n"
    )
    (folder / "e.csv").write_text("patient,mass,ex_vivo_mm\nP1,1,10\nP2,1,9\n")
    return folder / "t.csv", "--excision", folder / "e.csv"


def test_an_estimates_size_and_interval_are_read_directly(tmp_path: Path) -> None:
    path = estimates(tmp_path, SIZE)
    found = document(*with_posterior(tmp_path, ",detected,estimate.json"))
    tactile = found["modalities"]["tactile"]
    assert tactile["mape_percent"] == pytest.approx(10)
    assert (tactile["coverage"][0]["probability"], tactile["coverage"][0]["covered"]) == (0.9, 1)
    roles = {one["role"]: one["sha256"] for one in found["provenance"]["inputs"]}
    assert roles["posterior_1"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (
        "narrower than the interval that `estimate` leads with"
        in validate(*with_posterior(tmp_path, ",detected,estimate.json")).stdout
    )


def test_a_posteriors_draws_are_read_directly(tmp_path: Path) -> None:
    import netCDF4

    draws = np.random.default_rng(0).lognormal(math.log(12), 0.1, (2, 500))
    with netCDF4.Dataset(tmp_path / "p.nc", "w") as dataset:
        group = dataset.createGroup("posterior")
        for name, length in (("chain", 2), ("draw", 500)):
            group.createDimension(name, length)
        group.createVariable("max_size_mm", "f8", ("chain", "draw"))[:] = draws
    tactile = document(*with_posterior(tmp_path, ",detected,p.nc"))["modalities"]["tactile"]
    assert tactile["mape_percent"] == pytest.approx(100 * (np.median(draws) / 10 - 1) / 2)
    assert tactile["coverage"][0]["probability"] == 0.95


@pytest.mark.parametrize(
    ("size", "cells", "words"),
    [
        (SIZE, "12,detected,estimate.json", "line 2, column size_mm: is 12 beside a posterior"),
        (SIZE, ",not_detected,estimate.json", "with a size while status is not_detected"),
        (None, ",detected,estimate.json", "without a size while status is detected"),
        (None, ",,estimate.json", "is blank beside a posterior that names an estimate without a size"),
        (SIZE, ",detected,estimate.json#2", "holds one estimate, no list"),
        (SIZE, ",detected,gone.json", "cannot be read"),
        (SIZE, ",detected,t.csv", "neither JSON nor netCDF"),
        (
            SIZE,
            ",detected,estimate.json\nP1,1,tactile,2,,detected,./estimate.json",
            "line 3, column posterior: names the estimate of line 2",
        ),
    ],
)
def test_a_posterior_that_contradicts_its_row_is_refused(tmp_path: Path, size: dict, cells: str, words: str) -> None:
    estimates(tmp_path, size)
    assert words in refusal(*with_posterior(tmp_path, cells))


def test_an_estimate_of_another_patient_of_the_trial_is_refused(tmp_path: Path) -> None:
    """Exchanged files gave each patient the other's size; codes that the trial does not have say nothing."""
    one = json.loads(estimates(tmp_path, SIZE).read_text())
    for subject in ("P2", "P1", "X7"):
        made = one | {"provenance": {"scans": [{"subject": subject}]}}
        (tmp_path / f"{subject}.json").write_text(json.dumps(made))
    words = "line 2, column posterior: names an estimate of patient P2; give one of this row's mass"
    assert words in refusal(*with_posterior(tmp_path, ",detected,P2.json"))
    for subject in ("P1", "X7"):
        assert document(*with_posterior(tmp_path, f",detected,{subject}.json"))["counts"]["readings"] == 2


def test_an_estimate_of_a_batch_is_named_by_its_number(tmp_path: Path) -> None:
    one = json.loads(estimates(tmp_path, SIZE).read_text())
    other = json.loads(estimates(tmp_path, SIZE | {"median": 13.0}).read_text())
    (tmp_path / "batch.json").write_text(json.dumps([one, other]))
    tactile = document(*with_posterior(tmp_path, ",detected,batch.json#2"))["modalities"]["tactile"]
    assert tactile["mape_percent"] == pytest.approx(15)
    for cell in ("batch.json", "batch.json#3", "batch.json#0"):
        words = refusal(*with_posterior(tmp_path, f",detected,{cell}"))
        assert "name one as batch.json#1 to batch.json#2" in words


def test_a_map_without_an_estimate_is_a_mass_not_found(tmp_path: Path) -> None:
    estimates(tmp_path, None)
    tactile = document(*with_posterior(tmp_path, ",not_detected,estimate.json"))["modalities"]["tactile"]
    assert (tactile["n"], tactile["detected"]) == (2, 1)


def test_a_protocol_fixes_the_analysis_and_its_hash_is_reported(tmp_path: Path) -> None:
    protocol = tmp_path / "protocol.toml"
    protocol.write_text(
        'title = "Primary: MAPE, tactile against ultrasound"\n[analysis]\nintervals = "jackknife"\nresamples = 200\n'
    )
    found = document(TRIAL, "--excision", EXCISION, "--protocol", protocol)
    assert found["provenance"]["settings"]["intervals"] == "jackknife"
    roles = {one["role"]: one["sha256"] for one in found["provenance"]["inputs"]}
    assert roles["protocol"] == hashlib.sha256(protocol.read_bytes()).hexdigest()
    words = refusal(TRIAL, "--excision", EXCISION, "--protocol", protocol, "--intervals", "bca")
    assert "--intervals bca contradicts" in words
    protocol.write_text("[analysis]\nlevel = 3\n")
    assert "protocol.toml" in refusal(TRIAL, "--excision", EXCISION, "--protocol", protocol)


@pytest.mark.long
def test_other_intervals_change_intervals_and_no_figure() -> None:
    plain = document(TRIAL, "--excision", EXCISION, "--intervals", "jackknife")["modalities"]["tactile"]
    options = ("--intervals", "bca", "--resamples", 300)
    other = document(TRIAL, "--excision", EXCISION, *options)["modalities"]["tactile"]
    assert other["mape_percent"] == plain["mape_percent"]
    assert other["mape_percent_interval"] != plain["mape_percent_interval"]
    assert other["mape_percent_interval"] == pytest.approx(plain["mape_percent_interval"], rel=0.15)


def test_the_second_table_is_printed_when_asked_for() -> None:
    plain, more = validate(TRIAL, "--excision", EXCISION), validate(TRIAL, "--excision", EXCISION, "--methods")
    shorter = set(plain.stdout.splitlines())
    assert {line for line in shorter if not line.startswith("More (")} < set(more.stdout.splitlines())
    assert more.stdout == validate(TRIAL, "--excision", EXCISION, "-v").stdout
    for words in (
        "Passing-Bablok: slope",
        "limits of agreement of size / ex vivo",
        "limits of agreement in mm",
        "p Holm",
        "ICC",
        "CRPS",
    ):
        assert words in more.stdout
        assert words not in plain.stdout


@pytest.mark.long
def test_the_page_needs_nothing_else_and_is_the_same_every_time(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        assert validate(TRIAL, "--excision", EXCISION, "--html", tmp_path / name).exit_code == 0
    page = (tmp_path / "a.html").read_text()
    assert page == (tmp_path / "b.html").read_text()
    assert not re.search(r"https?://|<script|<link|src=\"(?!data:)|url\(|@import", page)
    assert page.count("data:image/svg+xml;base64,") == 3
    assert hashlib.sha256(TRIAL.read_bytes()).hexdigest() in page
    for words in ("synthetic", "Passing-Bablok", "p Holm", "ICC", "mean error, %", RESEARCH_USE):
        assert words in page
    plain = tmp_path / "plain.html"
    assert validate(TRIAL, "--excision", EXCISION, "--intervals", "jackknife", "--html", plain).exit_code == 0
    assert "intervals of MAPE hold less often than they say" in plain.read_text()
    assert "exists" in refusal(TRIAL, "--excision", EXCISION, "--html", tmp_path / "a.html")


def test_the_page_has_every_mass_with_its_residuals_and_no_patient(tmp_path: Path) -> None:
    rows = [
        ("Jane", 1, "tactile", 12.0),
        ("Jane", 1, "tactile", 14.0),
        ("Ann", 1, "tactile", 9.0),
        ("Ann", 1, "us", 30),
    ]
    trial, *words = small(tmp_path, rows, [("Jane", 1, 10.0), ("Ann", 1, 12.0), ("Eve", 1, 20.0)])
    trial.write_text(trial.read_text() + "Jane,1,us,1,,not_detected\n")
    trial.write_text(trial.read_text().replace("Jane,1,tactile,1,14", "Jane,1,tactile,2,14"))
    assert validate(trial, *words, "--html", tmp_path / "r.html").exit_code == 0
    page = (tmp_path / "r.html").read_text()
    table = page.split("<h2>Masses</h2>")[1].split("</table>")[0]
    cells = [re.findall(r"<td>\s*(.*?)\s*</td>", row, re.DOTALL) for row in table.split("<tr>")[2:]]
    plain = [[" ".join(re.sub("<[^>]+>", " ", cell).split()) for cell in row] for row in cells]
    assert plain == [
        ["1", "10.0", "13.0 [+3.0 mm, +30 %]", "not found"],
        ["2", "12.0", "9.0 [-3.0 mm, -25 %]", "30.0 [+18.0 mm, +150 %]"],
        ["3", "20.0", "-", "-"],
    ]
    assert "Jane" not in page


def test_a_print_needs_the_page_and_is_written_with_it_or_not_at_all(tmp_path: Path) -> None:
    asked = (TRIAL, "--excision", EXCISION, "--pdf", tmp_path / "r.pdf")
    assert "give --html REPORT.html too" in refusal(*asked)
    assert "choose another name" in refusal(*asked[:-1], tmp_path / "r.html", "--html", tmp_path / "r.html")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tactile_bayes.report.pages.find_printer", lambda: lambda text: b"%PDF of " + text[:9].encode())
        assert validate(*asked, "--html", tmp_path / "r.html").exit_code == 0
    assert (tmp_path / "r.pdf").read_bytes() == b"%PDF of <!doctype"
    assert (tmp_path / "r.html").exists()


def test_the_page_stands_what_has_almost_nothing(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(
        "patient,mass,modality,replicate,size_mm,status\nP1,1,cbe,1,,not_detected\nP1,1,<b>,1,9,detected\n".replace(
            "<b>", "mri"
        )
    )
    (tmp_path / "e.csv").write_text("patient,mass,ex_vivo_mm\nP1,1,10\nP2,1,9\n")
    result = validate(tmp_path / "t.csv", "--excision", tmp_path / "e.csv", "--html", tmp_path / "r.html")
    assert result.exit_code == 0, result.exception
    assert "masses left out: 0 not done, 1 without a row." in (tmp_path / "r.html").read_text()
    assert "nan" not in (tmp_path / "r.html").read_text().replace("nance", "").lower().split("base64")[0]


def test_figures_of_repeats_say_the_readings_they_are_of(tmp_path: Path) -> None:
    rows = ["A,10", "B,11", ",12", "A,20", "B,21", ",23"]
    cells = [f"P{i // 3},1,tactile,{i},detected,{row}" for i, row in enumerate(rows, start=3)]
    (tmp_path / "t.csv").write_text("\n".join(["patient,mass,modality,replicate,status,reader,size_mm", *cells]) + "\n")
    (tmp_path / "e.csv").write_text("patient,mass,ex_vivo_mm\nP1,1,10\nP2,1,19\n")
    text = validate(tmp_path / "t.csv", "--excision", tmp_path / "e.csv", "-v").stdout
    assert "within one mass, by 6 readings of 2 masses: mean SD" in text
    assert "(the 4 readings that name a reader); ICC" in text


def paper_trial(folder: Path) -> tuple[object, ...]:
    """Sizes whose percent errors average 17, 34 and 47 and whose lines through zero have slopes 1.04, 0.90 and 1.26.

    Of the 25 masses every second errs up by p, the others down by q (one missed by each of two modalities): the mean
    error and the slope are two linear equations for p and q.
    """
    e = 8.0 + np.arange(1, 26)
    rows, up = ["patient,mass,modality,replicate,size_mm,status"], np.arange(25) % 2 == 0
    for name, mape, slope, missed in (
        ("tactile", 0.17, 1.04, None),
        ("ultrasound", 0.34, 0.90, 9),
        ("cbe", 0.47, 1.26, 3),
    ):
        found = np.arange(25) != missed
        plus, minus = e[up & found], e[~up & found]
        target = [25 * mape - (missed is not None), slope * e @ e - e[found] @ e[found]]
        p, q = np.linalg.solve([[len(plus), len(minus)], [plus @ plus, -(minus @ minus)]], target)
        assert p > 0
        assert 0 < q < 1
        for i, size in enumerate(e * np.where(up, 1 + p, 1 - q)):
            cells = f"{size:.12g},detected" if found[i] else ",not_detected"
            rows.append(f"P{min(i, 23):02d},{1 + (i == 24)},{name},1,{cells}")
    (folder / "t.csv").write_text("\n".join(rows) + "\n")
    keys = [f"P{min(i, 23):02d},{1 + (i == 24)},{size:g}" for i, size in enumerate(e)]
    (folder / "e.csv").write_text("patient,mass,ex_vivo_mm\n" + "\n".join(keys) + "\n")
    return folder / "t.csv", "--excision", folder / "e.csv"


def test_the_papers_figures_give_a_ratio_of_two_and_not_more(tmp_path: Path) -> None:
    found = document(*paper_trial(tmp_path))
    modalities = found["modalities"]
    for name, mape, slope in (("tactile", 17, 1.04), ("ultrasound", 34, 0.90), ("cbe", 47, 1.26)):
        assert modalities[name]["mape_percent"] == pytest.approx(mape)
        assert modalities[name]["slope_through_origin"] == pytest.approx(slope)
    ratio = found["mape_ratio_to_tactile"]["ultrasound"]
    assert ratio["ratio"] == pytest.approx(2.0)
    assert ratio["ratio_detected"] == pytest.approx(1.84, abs=0.02)
    assert (ratio["masses"], ratio["masses_detected"]) == (25, 24)
    text = validate(*paper_trial(tmp_path), "-v").stdout
    assert re.search(r"ultrasound: MAPE 2\.00 \[.*\] times the tactile one's on 25 common masses; 1\.8\d \[", text)
    assert "more than twice" not in text


@pytest.mark.slow
def test_the_model_of_the_next_mass_is_reported(tmp_path: Path) -> None:
    page = tmp_path / "r.html"
    found = document(TRIAL, "--excision", EXCISION, "--bayes", "--html", page)["next_mass"]
    assert "Probability that tactile errs less than ultrasound" in page.read_text()
    assert found["probability_less_error"]["tactile errs less than ultrasound"] > 0.9
    # weighted draws: 0.7 is where they stop being trusted (Vehtari et al. 2024)
    assert all(one["pareto_k"] < 0.7 and one["end_error_sd"] < 0.1 for one in found["diagnostics"].values())
    low, high = (found["modalities"]["tactile"]["mape_percent"][key] for key in ("low", "high"))
    assert 5 < low < high < 40


def small(folder: Path, rows: list[tuple[str, int, str, float]], sizes: list[tuple[str, int, float]]) -> tuple:
    """Words for a trial of so many detected readings (patient, mass, modality, size) and excised masses."""
    lines = [f"{patient},{mass},{name},1,{size},detected" for patient, mass, name, size in rows]
    (folder / "trial.csv").write_text("\n".join(["patient,mass,modality,replicate,size_mm,status", *lines]) + "\n")
    excised = [f"{patient},{mass},{size}" for patient, mass, size in sizes]
    (folder / "excision.csv").write_text("\n".join(["patient,mass,ex_vivo_mm", *excised]) + "\n")
    return folder / "trial.csv", "--excision", folder / "excision.csv"


def test_masses_of_one_patient_are_no_new_trials_of_whether_masses_are_found(tmp_path: Path) -> None:
    """Clopper-Pearson for n of n: the low end is 0.025^(1/n) (R: binom.test(5, 5)$conf.int is 0.478 to 1)."""
    e = [12.0, 19.0, 16.0, 15.0, 10.0]
    for patients, number in (("AAAAA", 1.0), ("ABCDE", 5.0), ("AABBC", 25 / 9)):
        rows = [(one, i, "tactile", x + 0.5) for i, (one, x) in enumerate(zip(patients, e, strict=True), 1)]
        words = small(tmp_path, rows, [(one, i, x) for i, (one, x) in enumerate(zip(patients, e, strict=True), 1)])
        low, high = document(*words)["modalities"]["tactile"]["detected_interval"]
        assert (low, high) == (pytest.approx(0.025 ** (1 / number), abs=1e-6), 1.0)


def test_every_figure_of_the_text_stands_in_the_row_of_what_it_is_of() -> None:
    lines = validate(TRIAL, "--excision", EXCISION, "-v").stdout.splitlines()
    found = document(TRIAL, "--excision", EXCISION)
    for pair in found["paired_comparisons"]:
        (line,) = (
            one for one in lines if one.startswith(f"{pair['first']} - {pair['second']} on {pair['masses']} com")
        )
        assert f": MAPE {pair['difference_percent']:+.1f} [" in line
        assert f" points, ratio {pair['ratio']:.2f} [" in line
        assert line.endswith(f"; p {pair['p_value']:.4f}, p Holm {pair['p_holm']:.4f}")
    assert any(line.endswith("looked for, corrected for 3 pairs by Holm.") for line in lines)
    for name, one in found["modalities"].items():
        assert any(
            line.startswith(f"{name}: concordance {one['method_comparison']['concordance']:.2f} [") for line in lines
        )
    repeats = found["modalities"]["tactile"]["replicates"]
    low, high = repeats["repeatability_low_percent"], repeats["repeatability_high_percent"]
    (line,) = (line for line in lines if "two readings of one mass differ by" in line)
    assert re.fullmatch(rf"tactile: .* by {low:.0f} \[.*\] to \+{high:.0f} \[.*\] % at most in 95 % of pairs", line)
    for name, one in found["mape_ratio_to_tactile"].items():
        (line,) = (line for line in lines if line.startswith(f"{name}: MAPE "))
        assert line.startswith(f"{name}: MAPE {one['ratio']:.2f} [")
        assert f" common masses; {one['ratio_detected']:.2f} [" in line
        assert line.endswith(f" times on the {one['masses_detected']} that both found")


def test_intervals_that_few_misses_make_too_narrow_have_a_caution() -> None:
    words = (
        "1 of 25 masses missed: intervals of MAPE hold less often than they say; --intervals corrected allows for it"
    )
    plain = validate(TRIAL, "--excision", EXCISION, "--intervals", "jackknife").stdout.splitlines()
    assert [line for line in plain if "less often" in line] == [
        f"{name}: only {words}" for name in ("cbe", "ultrasound")
    ]
    assert "less often" not in validate(TRIAL, "--excision", EXCISION).stdout  # the control: corrected by default


def test_a_p_value_that_few_patients_cannot_make_small_says_so(tmp_path: Path) -> None:
    """The sign-flip test of n patients has 2^n patterns: p is 2/2^n at least, 0.25 of three and 0.03 of six."""
    for n, told in ((3, True), (6, False)):
        names = "ABCDEF"[:n]
        e = [(one, 1, 10.0 + i) for i, one in enumerate(names)]
        rows = [(one, 1, "tactile", x + 0.5) for one, _, x in e] + [(one, 1, "us", x + 4.0) for one, _, x in e]
        page = tmp_path / f"{n}.html"
        text = validate(*small(tmp_path, rows, e), "--methods", "--html", page).output
        sentence = "With 3 patients p cannot be below 0.25: the test says nothing here."
        assert ((sentence in text), (sentence in page.read_text())) == (told, told), text
        assert re.search(r"; p 0\.\d+, p Holm", text)


def test_a_ratio_over_no_error_and_lines_through_one_mass_are_reasons(tmp_path: Path) -> None:
    e = [("A", 1, 12.0), ("B", 1, 19.0), ("C", 1, 16.0)]
    exact = [(one, 1, name, x) for one, _, x in e for name in ("tactile", "us")]
    text = validate(*small(tmp_path, exact, e), "-v").output
    assert "tactile and us are not compared on 3 masses: the error of us is 0" in text
    assert "us: no MAPE ratio on 3 common masses: " in text
    assert "- times" not in text
    level = small(tmp_path, [(one, 1, "tactile", 15.0) for one in "ABC"], e)
    assert "tactile: Passing-Bablok: slope 0.00, intercept 15.0 mm" in validate(*level, "-v").output
    missed = small(tmp_path, [(one, 1, "us", 15.0) for one in "ABC"], e)
    with missed[0].open("a") as file:
        file.writelines(f"{one},1,tactile,1,,not_detected\n" for one in "ABC")
    assert "on 3 common masses; none on those that both found" in validate(*missed, "-v").output
    one = validate(*small(tmp_path, [("A", 1, "tactile", 10.0), ("A", 1, "us", 15.0)], e[:1]), "--methods").output
    assert "tactile - us on 1 common mass: " in one
    assert "tactile: no lines or limits: too few masses were found, or their sizes do not differ" in one


def test_exchanged_tables_and_readings_without_excision_are_told_apart(tmp_path: Path) -> None:
    assert "this is a trial's table of readings: give the one with the columns patient, mass, ex_vivo_mm" in refusal(
        EXCISION, "--excision", TRIAL
    )
    assert "this is a trial's table of sizes after excision" in refusal(EXCISION, "--excision", EXCISION)
    words = small(tmp_path, [("A", 1, "tactile", 10.0), ("B", 1, "tactile", 12.0)], [("A", 1, 11.0)])
    assert "or leave its readings out" in refusal(*words)
    with words[2].open("a") as file:
        file.write("   \nB,1,\n")
    assert "line 4, column ex_vivo_mm: is blank; was the mass not measured? then leave its row out" in refusal(*words)
    for table, contents in ((TRIAL, "readings"), (EXCISION, "sizes after excision")):
        with pytest.raises(
            BadDataError, match=f"this is a trial's table of {contents}: give the one with the columns "
        ):
            tactile_bayes.calibrate_size(table)
    assert "the first line names the columns, which are patient, mass, modality" in refusal(
        TRIAL.with_name("phantoms.csv"), "--excision", EXCISION
    )
