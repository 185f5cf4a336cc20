"""Figures of one modality against printed numbers, hand arithmetic and defined extremes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest

from tactile_bayes.declarations import to_plain
from tactile_bayes.files.documents import dump_json
from tactile_bayes.trial import accuracy
from tactile_bayes.trial import accuracy as origin_line
from tactile_bayes.trial import replicates as spread
from tactile_bayes.trial.accuracy import mape_ratios, paired_comparisons
from tactile_bayes.trial.figures import JACKKNIFE, UndefinedError
from tactile_bayes.trial.readings import ModalitySizes, Reading, Trial
from tactile_bayes.trial.summary import FAMILIES, TrialReport, modality_report, summarise

# R's data set `cars` (Ezekiel, 1930): speed in mph and stopping distance in ft.
CARS = """
4 2 4 10 7 4 7 22 8 16 9 10 10 18 10 26 10 34 11 17 11 28 12 14 12 20 12 24 12 28 13 26 13 34 13 34 13 46 14 26 14 36
14 60 14 80 15 20 15 26 15 54 16 32 16 40 17 32 17 40 17 50 18 42 18 56 18 76 18 84 19 36 19 46 19 68 20 32 20 48 20 52
20 56 20 64 22 66 23 54 24 70 24 92 24 93 24 120 25 85
"""
CARS_SPEED, CARS_DIST = np.array(CARS.split(), dtype=float).reshape(50, 2).T


def sizes(ex_vivo_mm: Sequence[float], *replicates_mm: Sequence[float], name: str = "tactile") -> ModalitySizes:
    """One mass a patient; an empty list of replicates is a mass that was not found."""
    return ModalitySizes(
        name=name,
        patient=np.arange(len(ex_vivo_mm)),
        ex_vivo_mm=np.array(ex_vivo_mm, dtype=float),
        size_mm=np.array([np.mean(group) if len(group) else 0.0 for group in replicates_mm]),
        replicates_mm=tuple(np.array(group, dtype=float) for group in replicates_mm),
    )


def single(ex_vivo_mm: Sequence[float], size_mm: Sequence[float], *, name: str = "tactile") -> ModalitySizes:
    """One mass a patient, one replicate a mass; size 0 is a mass that was not found."""
    return sizes(ex_vivo_mm, *([y] if y else [] for y in size_mm), name=name)


def test_r_squared_of_cars_as_r_prints_it() -> None:
    cars = single(CARS_SPEED.tolist(), CARS_DIST.tolist())
    assert origin_line.slope(cars) == pytest.approx(2.909132, abs=5e-7)  # lm(dist ~ 0 + speed)
    assert origin_line.CORRELATIONS["r2_uncentred"](cars) == pytest.approx(0.8962893, abs=5e-8)
    assert origin_line.CORRELATIONS["r2_centred"](cars) == pytest.approx(0.6018997, abs=5e-8)
    assert origin_line.CORRELATIONS["r2_pearson"](cars) == pytest.approx(0.6510794, abs=5e-8)  # lm(dist ~ speed)


def test_r_squared_below_zero_as_microsoft_prints_it() -> None:
    """Microsoft's article 829249 on LINEST: x = 1, 2, 3 and y = 11, 12, 13 gave -20.4286 before it was mended."""
    case = single([1, 2, 3], [11, 12, 13])
    assert origin_line.CORRELATIONS["r2_centred"](case) == pytest.approx(-20.4286, abs=5e-5)
    assert origin_line.CORRELATIONS["r2_pearson"](case) == pytest.approx(1.0)


def test_percent_and_mm_errors_agree_with_hand_calculation() -> None:
    case = sizes([10, 20, 40], [12, 14], [10], [])  # errors +30 %, -50 %, not found; 3, 10, 40 mm
    assert accuracy.mape_percent(case) == pytest.approx((30 + 50 + 100) / 3)
    assert accuracy.mape_percent(case.only_detected()) == pytest.approx(40)
    assert accuracy.mae_mm(case) == pytest.approx(53 / 3)
    assert accuracy.mae_mm(case.only_detected()) == pytest.approx(6.5)
    figures = accuracy.accuracy_figures(case, intervals=JACKKNIFE)
    assert figures["bias_percent"].value == pytest.approx(100 * (math.sqrt(1.3 * 0.5) - 1))


def test_bias_cancels_twice_with_half() -> None:
    figures = accuracy.accuracy_figures(single([10, 10], [20, 5]), intervals=JACKKNIFE)
    assert figures["bias_percent"].value == pytest.approx(0, abs=1e-12)


def test_within_mass_sd_agrees_with_hand_calculation() -> None:
    case = sizes([10, 10, 10, 10], [9, 11], [8, 10, 12], [7], [])  # SD sqrt 2 about 10, SD 2 about 10
    assert spread.SPREAD["within_mass_sd_mm"](case.only_replicated()) == pytest.approx((math.sqrt(2) + 2) / 2)
    assert spread.SPREAD["within_mass_sd_rms_mm"](case.only_replicated()) == pytest.approx(
        math.sqrt((2 * 1 + 4 * 2) / 3)
    )
    assert spread.SPREAD["within_mass_cv_percent"](case.only_replicated()) == pytest.approx(10 * (math.sqrt(2) + 2) / 2)
    assert spread.SPREAD["within_mass_cv_rms_percent"](case.only_replicated()) == pytest.approx(10 * math.sqrt(10 / 3))


def test_spread_recovers_the_standard_deviation_that_made_it() -> None:
    """The root mean square is right at three replicates; the mean of SDs is low by c4(3) = 0.8862."""
    rng = np.random.default_rng(5)
    case = sizes([20] * 4000, *rng.normal(20, 2.6, (4000, 3)))
    assert spread.SPREAD["within_mass_sd_rms_mm"](case) == pytest.approx(2.6, rel=0.02)
    assert spread.SPREAD["within_mass_sd_mm"](case) == pytest.approx(2.6 * 0.8862, rel=0.02)


def paper_readings() -> tuple[list[Reading], dict[tuple[str, str], float]]:
    """25 masses with errors of alternating sign whose means are the paper's 17, 34 and 47 %, one miss each by
    ultrasound and by examination (a miss is 100 %, so the other 24 make up 25 x 34 - 100 and 25 x 47 - 100)."""
    ex_vivo = {(f"P{min(i, 24):02d}", "2" if i == 25 else "1"): 8.0 + i for i in range(1, 26)}
    readings = []
    for index, (key, e) in enumerate(ex_vivo.items()):
        for modality, error, missed in (
            ("tactile", 0.17, False),
            ("ultrasound", (25 * 0.34 - 1) / 24, index == 9),
            ("cbe", (25 * 0.47 - 1) / 24, index == 3),
        ):
            size = None if missed else e * (1 + (-1) ** index * error)
            readings.append(Reading(key, modality, 1, "not_detected" if missed else "detected", size))
    return readings, ex_vivo


def test_the_papers_errors_and_the_ratio_as_measured() -> None:
    report = summarise(Trial(*paper_readings()))
    errors = {name: one.mape_percent for name, one in report.modalities.items()}
    assert errors == pytest.approx({"tactile": 17, "cbe": 47, "ultrasound": 34})
    assert report.modalities["ultrasound"].mape_detected_percent == pytest.approx(31.25)
    ultrasound = report.mape_ratio_to_tactile["ultrasound"]
    assert ultrasound.ratio == pytest.approx(2.0)  # "more than twice" is exactly twice
    assert ultrasound.ratio_detected == pytest.approx(1.84, abs=0.005)
    assert (report.counts.patients, report.counts.masses) == (24, 25)
    assert report.modalities["cbe"].detected == 24


def test_uncentred_r_squared_cannot_be_the_papers() -> None:
    """At slope 0.90 and MAPE 34 %, 1 - SSE0 / sum y^2 never comes near the printed 0.14; the centred one does."""
    rng = np.random.default_rng(0)
    centred, uncentred = [], []
    for _ in range(200):
        e = np.exp(rng.normal(2.8, 0.35, 25))
        case = single(e, e * np.exp(rng.normal(-0.1, 0.42, 25)))
        centred.append(origin_line.CORRELATIONS["r2_centred"](case))
        uncentred.append(origin_line.CORRELATIONS["r2_uncentred"](case))
    assert min(centred) < 0.14 < 0.5 < min(uncentred)


EXTREMES = {
    # name: (ex vivo, sizes), {figure: value}; None is undefined with a reason
    "one mass": (
        ([10], [12]),
        {"mape_percent": 20, "slope_through_origin": 1.2, "r2_centred": None, "pearson_r": None},
    ),
    "one mass not found": (([10], [0]), {"mape_percent": 100, "bias_percent": None, "slope_through_origin": 0}),
    "none found": (
        ([10, 20], [0, 0]),
        {"mape_percent": 100, "mape_detected_percent": None, "mae_mm": 15, "r2_centred": None, "r2_uncentred": None},
    ),
    "equal ex vivo": (([10, 10, 10], [9, 10, 11]), {"r2_centred": 0, "r2_pearson": None, "slope_through_origin": 1}),
    "equal sizes": (([5, 10, 15], [7, 7, 7]), {"r2_centred": None, "r2_pearson": None}),
    "perfect": (([5, 10, 15], [5, 10, 15]), {"mape_percent": 0, "bias_percent": 0, "r2_centred": 1, "pearson_r": 1}),
    "upside down": (([5, 10, 15], [15, 10, 5]), {"r2_pearson": 1, "pearson_r": -1}),
    "largest numbers": (([1e308, 2e307], [1e308, 1e308]), {"mae_mm": None, "slope_through_origin": 1.2 / 1.04}),
    "smallest numbers": (([5e-324, 1e-320], [1e-300, 1e308]), {"mape_percent": None, "bias_percent": None}),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_have_defined_answers(name: str) -> None:
    (ex_vivo, size), expected = EXTREMES[name]
    report = modality_report(single(ex_vivo, size), Trial([], {}), intervals=JACKKNIFE)
    for key, value in expected.items():
        if value is None:
            assert report.figure(key).value is None
            assert report.figure(key).reason
        else:
            assert report.figure(key).value == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("name", EXTREMES)
def test_no_extreme_puts_nan_in_json(name: str) -> None:
    (ex_vivo, size), _ = EXTREMES[name]
    keys = [(f"P{i}", "1") for i in range(len(ex_vivo))]
    status = ["detected" if y else "not_detected" for y in size]
    readings = [
        Reading(key, modality, 1, s, y or None)
        for key, s, y in zip(keys, status, size, strict=True)
        for modality in ("tactile", "cbe")
    ]
    document = to_plain(summarise(Trial(readings, dict(zip(keys, ex_vivo, strict=True)))))
    for one in json.loads(dump_json(document))["modalities"].values():
        reasoned = {key for key, value in one.items() if value is None}
        assert reasoned - {"detected_interval"} == set(one["reasons"])


def test_a_modality_never_done_has_counts_and_reasons() -> None:
    report = summarise(Trial([Reading(("P1", "1"), "cbe", 1, "not_done")], {("P1", "1"): 10.0, ("P2", "1"): 9.0}))
    cbe = report.modalities["cbe"]
    assert (cbe.n, cbe.detected, cbe.masses_not_done, cbe.masses_without_reading) == (0, 0, 1, 1)
    assert cbe.detected_interval is None
    figures = {name for family in FAMILIES for name in family(single([], []), intervals=JACKKNIFE)}
    assert all(cbe.figure(name).value is None and cbe.figure(name).reason for name in figures)
    assert report.counts.masses_without_any_reading == 1
    assert dump_json(to_plain(report))


def test_ratio_to_an_error_of_zero_is_undefined() -> None:
    perfect, off = single([5, 10], [5, 10]), single([5, 10], [6, 12], name="cbe")
    ratio = mape_ratios({"tactile": perfect, "cbe": off}, intervals=JACKKNIFE)["cbe"]
    assert ratio.ratio is None
    assert ratio.reasons["ratio"] == "the error of tactile is 0"


@pytest.mark.long
def test_equal_readings_of_the_true_size_have_no_error() -> None:
    """The sum of three equal readings, divided by three, may differ from them in the last bit."""
    key = ("P1", "1")
    for size in np.arange(10.1, 30, 0.1).tolist():
        readings = [Reading(key, "tactile", k, "detected", size) for k in range(1, 8)]
        off = [Reading(key, "cbe", 1, "detected", 2 * size)]
        assert summarise(Trial([*readings, *off], {key: size})).mape_ratio_to_tactile["cbe"].ratio is None


def test_ratio_to_an_error_of_one_patient_alone_says_whose() -> None:
    """Without that patient the error is 0, with all it is not."""
    ten = [10.0] * 9
    sizes = {"tactile": single(ten, [11.0] * 9), "cbe": single(ten, [*[10.0] * 8, 12.0], name="cbe")}
    (pair,) = paired_comparisons(sizes, intervals=JACKKNIFE)
    assert pair.reasons["ratio_interval"] == "the error of cbe is 0 without one patient"


def test_without_tactile_there_is_no_ratio() -> None:
    report: TrialReport = summarise(Trial([Reading(("P1", "1"), "cbe", 1, "detected", 9.0)], {("P1", "1"): 10.0}))
    assert report.mape_ratio_to_tactile == {}


def test_statistics_of_nothing_are_undefined() -> None:
    nothing = single([], [])
    for statistic in (accuracy.mape_percent, accuracy.mae_mm, origin_line.slope, spread.SPREAD["within_mass_sd_mm"]):
        with pytest.raises(UndefinedError):
            statistic(nothing)
