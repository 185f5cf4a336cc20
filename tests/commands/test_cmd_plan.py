"""The command `plan`: what it prints and writes, its pilot, and its refusals."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pandas
import pytest
from click.testing import CliRunner, Result
from published_schemas import check_document
from scipy.stats import t

import tactile_bayes as tb
from tactile_bayes.commands.trial import plan_command as command
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.presets import RESEARCH_USE
from validation.simulated_trials import ErrorModel

DEMO = Path(tb.__file__).parent / "demo"
SMALL = ("--patients", 12, "--maps", 1, "--maps", 3, "--trials", 50)


def plan(*args: object) -> Result:
    return CliRunner().invoke(command, [str(arg) for arg in args])


def test_the_same_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    printed = plan(*SMALL, "--json", "-o", tmp_path / "a.json")
    again = plan(*SMALL, "--json", "--workers", 0)
    assert (printed.exit_code, again.exit_code) == (0, 0), printed.output
    assert printed.stdout_bytes == again.stdout_bytes == (tmp_path / "a.json").read_bytes()
    document = json.loads(printed.stdout)
    check_document(document, "plan.schema.json")
    assert [(one["patients"], one["maps"]) for one in document["designs"]] == [(12, 1), (12, 3)]
    assert [(one["from_maps"], one["to_maps"]) for one in document["gains"]] == [(1, 3)]
    assert document["research_use"] == RESEARCH_USE


def test_the_text_names_designs_and_gains() -> None:
    lines = plan(*SMALL).stdout.splitlines()
    assert any("12 patients, from 1 to 3 maps" in line for line in lines)
    assert lines[-1] == RESEARCH_USE
    table = [line for line in lines if line.startswith(" ")]
    assert len(table) == 3
    assert max(map(len, table)) <= 80


def moments(bias: float, sd: float, miss: float = 0.0) -> tuple[float, float]:
    """Mean and SD of |e^X - 1| for a normal X, in closed form; a miss counts as 1."""
    mean = ErrorModel(bias, sd, miss=miss).true_mape_percent / 100
    square = math.exp(2 * bias + 2 * sd**2) - 2 * math.exp(bias + sd**2 / 2) + 1
    return mean, math.sqrt((1 - miss) * square + miss - mean**2)


@pytest.mark.long
def test_power_answers_with_the_patients_of_the_normal_approximation() -> None:
    """N = ((z_0.975 + z_0.9) / delta)^2, the paired test's sample size, from closed moments (1.960 + 1.282)."""
    (tactile, sd), (other, other_sd) = moments(0.02, math.hypot(0.18, 0.15)), moments(-0.08, 0.40, miss=0.04)
    delta = (other - tactile) / math.hypot(sd, other_sd)
    approximate = ((1.95996 + 1.28155) / delta) ** 2
    result = plan("--power", 0.9, "--maps", 1, "--trials", 400)
    (found,) = json.loads(plan("--power", 0.9, "--maps", 1, "--trials", 400, "--json").stdout)["needed"]
    assert found["patients"] == pytest.approx(approximate, rel=0.1)
    low, high = found["patients_interval"]
    assert low < found["patients"] < high < 1.2 * low
    assert result.stdout.startswith(
        f"needed: {found['patients']} patients with 1 map of each mass for power 0.9 (by the"
    )


@pytest.mark.long
def test_precision_answers_with_the_patients_of_the_delta_method() -> None:
    """The ends lie t standard errors of the logarithm apart: factor = exp(2 t cv / sqrt(N)) at the answer."""
    mean, sd = moments(0.02, math.hypot(0.18, 0.15))
    given = ("--precision", 1.6, "--maps", 1, "--trials", 200, "--json")
    (found,) = json.loads(plan(*given).stdout)["needed"]
    n = found["patients"]
    assert math.exp(2 * t.ppf(0.975, n - 1) * sd / mean / math.sqrt(n)) == pytest.approx(1.6, rel=0.05)
    assert found["patients_interval"] is None


@pytest.mark.long
def test_more_maps_need_fewer_patients_and_a_figure_draws_it(tmp_path: Path) -> None:
    words = ("--power", 0.8, "--maps", 1, "--maps", 5, "--trials", 200)
    result = plan(*words, "--json", "--figure", tmp_path / "a.svg", "-o", tmp_path / "a.json")
    document = json.loads(result.stdout)
    check_document(document, "plan.schema.json")
    one, five = document["needed"]
    assert (one["maps"], five["maps"]) == (1, 5)
    assert one["patients"] > five["patients"] >= 8
    assert document["provenance"]["settings"]["power"] == 0.8
    assert "<svg" in (tmp_path / "a.svg").read_text()
    found = tb.plan(power=0.8, maps=[1, 5], trials=200)
    assert found.document == document


@pytest.mark.long
def test_few_patients_suffice_and_none_do() -> None:
    easy = plan("--power", 0.9, "--mass-sd", 0.01, "--map-sd", 0.01, "--trials", 50).stdout
    assert easy.startswith(
        "needed: 8 patients with 3 maps of each mass for power 0.9 (the least that a plan may have)\n"
    )
    hard = plan("--power", 0.9, "--mass-sd", 0.5, "--trials", 50).exception
    assert "the tactile errors assumed are not the smaller ones" in str(hard)
    far = plan("--power", 0.9, "--mass-sd", 0.33, "--maps", 1, "--other-miss", 0, "--trials", 50).exception
    assert "10000 patients do not reach power 0.9 (maps of each mass: 1)" in str(far)


def test_a_pilot_gives_the_errors() -> None:
    pilot = ("--pilot", DEMO / "trial.csv", "--excision", DEMO / "excision.csv")
    errors = json.loads(plan(*SMALL, *pilot, "--json").stdout)["errors"]
    assert errors["map_sd"] == pytest.approx(0.15, rel=0.1)  # what the generator of the demo drew
    assert errors["other_miss"] == pytest.approx(1 / 25)


def test_masses_that_the_pilots_maps_missed_are_missed_in_the_plan(tmp_path: Path) -> None:
    """A third missed: the tactile error is a third of 100 % and two thirds of that of the masses found."""
    lines = (DEMO / "trial.csv").read_text().splitlines()
    missed = {f"S{i:02d}" for i in range(1, 9)}
    blind = [
        ",".join([*line.split(",")[:4], "", "not_detected", "", "", "", *line.split(",")[9:]])
        if line.split(",")[0] in missed and ",tactile," in line
        else line
        for line in lines
    ]
    (tmp_path / "trial.csv").write_text("\n".join(blind) + "\n")
    tables = {"pilot": tmp_path / "trial.csv", "excision": DEMO / "excision.csv"}
    share = 9 / 25  # of these eight patients one has two masses
    planned = tb.plan(**tables, patients=[24], maps=[3], trials=50)
    found = tb.plan(**tables, patients=[24], maps=[3], trials=50, tactile_miss=0)
    assert planned.report.errors["tactile_miss"] == pytest.approx(share)
    (design,), (control,) = planned.report.designs, found.report.designs
    assert design.tactile_percent == pytest.approx(100 * share + (1 - share) * control.tactile_percent, abs=2)
    assert design.power == 0
    assert control.power > 0.7
    with pytest.raises(BadDataError, match="are not the smaller ones"):
        tb.plan(**tables, power=0.8, trials=50)


def test_masses_that_scatter_no_more_than_their_maps_are_told(tmp_path: Path) -> None:
    """The SD between masses is the root of a difference of variances, which chance makes negative."""
    readings, sizes = ["patient,mass,modality,replicate,size_mm,status"], ["patient,mass,ex_vivo_mm"]
    for i in range(4):
        readings += [f"P{i},1,tactile,{n},{size},detected" for n, size in ((1, 9), (2, 11.1))]
        readings.append(f"P{i},1,ultrasound,1,{8 + i},detected")
        sizes.append(f"P{i},1,10")
    for name, lines in (("trial", readings), ("excision", sizes)):
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    pilot = ("--pilot", tmp_path / "trial.csv", "--excision", tmp_path / "excision.csv")
    assert "its mass sd is taken as 0" in plan(*SMALL, *pilot).stdout
    assert "its mass sd is taken as 0" not in plan(*SMALL, *pilot, "--mass-sd", 0).stdout


def test_a_pilot_of_single_readings_needs_the_sd_of_maps(tmp_path: Path) -> None:
    """Without repeats the SD within masses cannot be told from that between them."""
    once = [line for line in (DEMO / "trial.csv").read_text().splitlines() if not re.search(r",tactile,[^1],", line)]
    (tmp_path / "trial.csv").write_text("\n".join(once) + "\n")
    pilot = ("--pilot", tmp_path / "trial.csv", "--excision", DEMO / "excision.csv")
    error = plan(*SMALL, *pilot).exception
    assert isinstance(error, BadDataError)
    assert "no mass with two tactile readings, so the SD of single maps is unknown; give it with --map-sd" in str(error)
    given = json.loads(plan(*SMALL, *pilot, "--map-sd", 0.15, "--json").stdout)["errors"]
    assert given["map_sd"] == 0.15


def test_refusals_name_the_way_out() -> None:
    assert isinstance(plan(*SMALL, "--pilot", DEMO / "trial.csv").exception, UsageError)
    pilot = ("--pilot", DEMO / "trial.csv", "--excision", DEMO / "excision.csv")
    error = plan(*SMALL, *pilot, "--against", "mri").exception
    assert isinstance(error, BadDataError)
    assert "choose one with --against" in str(error)
    assert plan("--patients", 7).exit_code == 2
    assert "leave out --patients" in str(plan("--patients", 12, "--power", 0.9).exception)
    exact = plan("--precision", 2, "--tactile-bias", 0, "--mass-sd", 0, "--map-sd", 0).exception
    assert "do not scatter, so their interval has no width; change the errors assumed" in str(exact)
    assert "for 90 % give 0.9" in plan("--power", "90%").output
    assert "for 4 % give 0.04" in plan("--other-miss", "4").output
    for no_percent in ("-0.1", "1.5%%", "nan", "400"):
        assert "% give" not in plan("--other-miss", no_percent).output


def test_python_plans_as_the_command_does(tmp_path: Path) -> None:
    tables = {"pilot": DEMO / "trial.csv", "excision": DEMO / "excision.csv"}
    words = [word for name, path in tables.items() for word in (f"--{name}", path)]
    told = plan(*SMALL, *words, "--map-sd", 0.2, "--json", "-o", tmp_path / "a.json")
    given = {"patients": [12], "maps": (3, 1), "trials": 50, "map_sd": 0.2}
    found = tb.plan(**given, **tables)
    assert found.document == json.loads(told.stdout)
    found.write_json(tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()
    assert found.text == plan(*SMALL, *words, "--map-sd", 0.2).stdout
    frames = {name: pandas.read_csv(path) for name, path in tables.items()}
    assert {**tb.plan(**given, **frames).document, "provenance": 0} == {**found.document, "provenance": 0}
    frames["excision"] = frames["excision"].assign(
        ex_vivo_mm=frames["excision"].ex_vivo_mm / 10, ex_vivo_second_mm=None
    )
    assert tb.plan(**given, **frames).text.startswith("Doubtful: 14 of 25 ex-vivo sizes outside 2 to 150 mm")


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"patients": [7]}, r"patients\[0\] is 7; give a whole number from 8"),
        ({"maps": 3}, "maps is 3; give a list of whole numbers"),
        ({"trials": 49}, "trials is 49"),
        ({"power": 90}, "power is 90; give a number from 0.5 to 0.99"),
        ({"patients": [12], "precision": 2.0}, "leave out patients"),
        ({"map_sd": -1.0}, "map_sd is -1"),
        ({"against": "mri"}, "against says how a pilot is read"),
        ({"pilot": DEMO / "trial.csv"}, "pilot needs excision"),
    ],
)
def test_python_refuses_with_its_own_words(given: dict[str, Any], fault: str) -> None:
    with pytest.raises(UsageError, match=fault):
        tb.plan(**given)
