"""Rows and sentences of reports, of numbers that are known: no figure stands in another's row, and none is left out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_reports import estimate_report, pooled_report
from posterior_maps import bump_map

from tactile_bayes.campaigns.report import repeatability_words
from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import (
    AnotherExam,
    EstimateReport,
    Interval,
    MassReport,
    OtherRise,
    Place,
    Point,
    PooledMap,
)
from tactile_bayes.findings import finding
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.posterior.fit import SceneChoice, Structure
from tactile_bayes.posterior.marginal import Scene
from tactile_bayes.posterior.result import Sensitivity
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report import pooled as pooled_report_module
from tactile_bayes.report.compare import Doubling, GrowthRate, Rate, Visit, VisitMap, _rate_words, _visit_line
from tactile_bayes.report.estimate_document import (
    mass_lines,
    odds_text,
    scene_line,
    scene_lines,
    sensitivity_line,
)
from tactile_bayes.report.estimate_text import _lump_line, decimals, size_table
from tactile_bayes.report.exam_words import ShownExam, _scan_rows, exam_map, size_sentences
from tactile_bayes.report.map import _notes
from tactile_bayes.report.pooled import pooled_findings, pooled_text
from tactile_bayes.report.trial import ratio_line
from tactile_bayes.trial.accuracy import ModalityRatio


def around(median: float, half: float) -> Quantity:
    ends = {"low": median - half, "high": median + half}
    return Quantity(median=median, mean=median, sd=half / 2, mc_error=0.01, probability=0.95, kind="eti", **ends)


def sized(**more: Any) -> EstimateReport:
    """Sizes with two intervals: 20 and 11 mm for exams of patients, 21 and 12 mm for exams that are alike."""
    another = AnotherExam(0.15, around(20.0, 5.0), around(11.0, 4.0), {})
    sizes = {"max_size_mm": around(21.0, 2.0), "min_size_mm": around(12.0, 1.0)}
    told = {"diagnostics": {"between_map_sd": 0.025}, "status": "estimate"}
    return estimate_report(**sizes | told | {"another_exam": another} | more)


def test_the_table_has_each_interval_in_the_row_of_what_it_supposes() -> None:
    rows = [" ".join(row.split()) for row in size_table(sized(amplitude=around(0.4, 0.1)))]
    assert rows == [
        "median 95 % interval (equal-tailed)",
        "largest size 20.0 15.0 to 25.0 mm",
        "smallest size 11.0 7.0 to 15.0 mm",
        "if exams differ by 2.5 % 21.0 19.0 to 23.0 mm",
        "amplitude 0.40 0.30 to 0.50",
    ]
    plain = [" ".join(row.split()) for row in size_table(sized(another_exam=None))]
    assert plain[1:] == ["largest size 21.0 19.0 to 23.0 mm", "smallest size 12.0 11.0 to 13.0 mm"]


@pytest.mark.parametrize("error", [0.004, 0.04, 0.2, 0.4])
def test_the_last_decimal_is_of_the_size_of_the_monte_carlo_error(error: float) -> None:
    unit = 10.0 ** -decimals(error)
    assert unit <= 2.0 * error < 10.0 * unit
    assert (decimals(0.0), decimals(1e-9), decimals(0.004, most=1), decimals(30.0)) == (3, 3, 1, 0)


def test_a_page_has_both_intervals_and_the_smallest_size_of_the_one_that_leads() -> None:
    exam = ShownExam((exam_map(bump_map(), sized(), side="left"),), None, ())
    told = " ".join(size_sentences(exam, around(20.0, 5.0)))
    assert "between 15.0 and 25.0 mm, if exams of a lump differ by 15 %, as those of patients did" in told
    assert "differed by 2.5 % only, as those of simulated bodies do, it would lie between 19.0 and 23.0 mm" in told
    assert "The smallest diameter is about 11.0 mm (95 %: 7.0 to 15.0 mm)." in told
    alike = replace(exam.maps[0], report=sized(diagnostics={}))
    assert "If exams of one lump did not differ, " in " ".join(
        size_sentences(replace(exam, maps=(alike,)), around(20.0, 5.0))
    )


@pytest.mark.parametrize(
    ("figures", "settings", "more", "words"),
    [
        ({"between_map_sd": 0.04}, {}, {}, "; exams of a lump are taken to differ by 4 %, learned from these maps"),
        ({"between_map_sd": 0.04}, {"between_map_sd": 0.04}, {}, " by 4 %, as was stated"),
        ({"between_map_sd": 0.04}, {}, {"repeatability": "2 to 6 %"}, "4 %, by these maps and this site's other exams"),
        ({}, {}, {}, "between 15.0 and 25.0 mm."),
    ],
    ids=["by the maps", "stated", "by the site", "none"],
)
def test_a_page_of_several_maps_says_where_the_spread_of_its_interval_is_from(
    figures: dict[str, float], settings: dict[str, Any], more: dict[str, Any], words: str
) -> None:
    own = exam_map(bump_map(), sized(), side="left")
    sizes = {"max_size_mm": around(20.0, 5.0), "min_size_mm": around(11.0, 4.0)}
    told = {"figures": figures, "provenance": {"settings": settings, "inputs": []}, "status": "estimate", "maps": ()}
    pooled = pooled_report(**sizes | told | more)
    first, second, *_ = size_sentences(ShownExam((own, own), pooled, ()), around(20.0, 5.0))
    assert first == "The largest diameter is about 20.0 mm (the middle of its probable values)."
    assert second.startswith("With a probability of 95 % it lies between 15.0 and 25.0 mm")
    assert second.rstrip(".").endswith(words.rstrip("."))


def test_a_page_and_a_map_say_why_frames_and_taxels_are_left_out() -> None:
    left_out = {"dropped_low": 1.0, "dropped_high": 2.0, "dropped_no_pose": 3.0, "dropped_elements": 4.0}
    pressed = {"mean_pressure_kpa": 9.5, "level_p05_kpa": 6.25, "level_p95_kpa": 12.5}
    counted = replace(bump_map(), quality={"frames_total": 60.0, "frames_used": 50.0} | left_out | pressed)
    counted = replace(counted, recipe=replace(counted.recipe, pressure_window_kpa=(5.0, 14.0)))
    masked = replace(counted, masked_taxels=("(3, 7)", "(4, 0)"))
    rows = dict(_scan_rows(masked))
    assert rows["sensor frames"] == (
        "50 of 60 used; left out: 1 pressed too lightly, 2 pressed too hard, 3 without the tracker's position, "
        "4 with too few working sensor points"
    )
    assert rows["sensor points"] == "2 left out as faulty"
    assert rows["pressure"] == "mean 9.5 kPa, nine frames in ten 6.2 to 12.5 kPa (wanted 5 to 14 kPa)"
    assert rows["landmarks"] == "none touched"
    touched = replace(masked, patient_from_plane=np.eye(4), quality=masked.quality | {"landmark_spread_mm": 3.4})
    assert dict(_scan_rows(touched))["landmarks"] == "sternal notch, xiphoid; no nipple; repeats within 3.4 mm"
    assert "no gaps inside" in rows["covered"]
    assert "taxels left out: (3, 7); (4, 0)" in _notes(masked)
    assert not any("left out" in one for one in _notes(counted))


def test_the_short_report_says_where_the_lump_lies_in_the_best_axes_there_are() -> None:
    place = {"centre_mm": Point(around(-9.8, 1.0), around(2.0, 1.0)), "detected_probability": 0.97}
    assert _lump_line(sized(**place)) == "Probability of a lump 0.97, at (-9.8, 2.0) mm on the map."
    patient = {"centre_patient_mm": Point(around(50.0, 1.0), around(-12.0, 1.0))}
    assert "50" in _lump_line(sized(**place | patient))


@pytest.mark.parametrize(
    ("size", "reason", "outcome"),
    [
        (around(8.0, 1.0), "", "largest size 8.0 mm (95 % interval 7.0 to 9.0 mm)"),
        (None, "its centre lies off the map", "no size: its centre lies off the map"),
    ],
)
def test_a_mass_besides_has_its_size_or_the_reason_for_none(size: Quantity | None, reason: str, outcome: str) -> None:
    nothing = dict.fromkeys(("centre_patient_mm", "amplitude", "d_x_mm", "d_y_mm", "angle_deg", "another_exam"))
    first, second = (
        MassReport(
            number=number,
            reported=number == 1,
            centre_mm=Place(x, 0.0),
            max_size_mm=size,
            min_size_mm=size,
            detected_probability=0.97,
            reason=reason,
            reason_code="",
            advice="",
            **nothing,
        )
        for number, x in ((1, 0.0), (2, 40.0))
    )
    (line,) = mass_lines((first, second))
    assert line.startswith("Mass 2 at (40.0, 0.0) mm, 40 mm from mass 1")
    assert line.endswith(f": {outcome}; probability of a lump 0.97.")


def test_odds_have_no_more_digits_than_they_are_worth() -> None:
    told = [odds_text(Structure("tilt", odds, False, False)) for odds in (0.001, 0.5, 12.3, 5000.0)]
    assert told == ["below 0.01 to 1", "0.5 to 1", "12 to 1", "above 1000 to 1"]
    assert odds_text(Structure("rib", 0.2, False, False, odds_are_a_bound=True)) == "at most 0.2 to 1"


def scene(structures: tuple[Structure, ...]) -> SceneChoice:
    """A straight ellipse with the tests of other structures."""
    fit: Any = SimpleNamespace(scene=Scene("ellipse"), target=SimpleNamespace(problem=SimpleNamespace(radius_mm=20.0)))
    return SceneChoice(fit, fit, structures)


def test_the_scene_names_what_the_map_supports_and_what_it_does_not() -> None:
    ellipse = Structure("ellipse", 5.0, True, True, False, 0.1, -0.2)
    tilt = Structure("tilt", 0.2, False, True, False, 0.3, 0.0)
    rib = Structure("rib", 2000.0, True, True, False, 1.5, -0.5, "along 90 deg")
    second = Structure("second lump", 0.004, False, False, odds_are_a_bound=True)
    choice = scene((ellipse, tilt, rib, second))
    assert choice.supported == "ellipse"
    assert scene((replace(ellipse, supported=False), tilt, rib)).supported == "round"
    assert scene_line(choice) == (
        "The map supports an ellipse along the head's axes and a rib in this window; not needed: a second lump within "
        "20 mm."
    )
    lines = scene_lines(choice)
    assert lines[0].startswith("Scene in the fit window of 20 mm about the lump: an ellipse along the head's axes and ")
    assert "a rib in this window along 90 deg, the simplest that the map supports." in lines[0]
    assert lines[1] == (
        "A rib in this window is in the model (odds above 1000 to 1): without it sigma_x would change by +1.5 SD and "
        "sigma_y would change by -0.5 SD."
    )
    assert "Also in the model: a sloping level (odds 0.2 to 1): without it sigma_x would change by +0.3 SD." in lines
    assert lines[-1] == "Not in the model: a second lump in this window (odds below 0.01 to 1)."


def test_a_result_that_hardly_follows_the_prior_is_told_by_how_little() -> None:
    still = Sensitivity(median={"max_size_mm": 0.001}, ends={"max_size_mm": -0.002}, pareto_k=0.1)
    assert "twice as wide would move the largest size by less than 0.005 SD" in sensitivity_line(still)
    moved = sensitivity_line(replace(still, median={"max_size_mm": -0.3}, ends={"max_size_mm": 0.4}))
    assert "the median of the largest size by -0.30 SD and its interval's ends by up to +0.40 SD" in moved


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (Doubling(None, None, None), ""),
        (Doubling(None, 90.0, None), ", doubling in no less than 90 days"),
        (Doubling(120.0, 90.0, 200.0), ", doubling in 120 days (90 to 200)"),
    ],
)
def test_a_growth_rate_has_the_doubling_time_that_its_interval_holds(times: Doubling, words: str) -> None:
    rate = GrowthRate(100.0, Rate(0.5, -0.1, 1.1, 0.95), times)
    assert _rate_words(rate) == f"+0.50 % of the volume a day (-0.10 to +1.10 %){words}"


def test_a_visit_has_its_day_maps_and_size() -> None:
    one = VisitMap("a.nc", "estimate", "", 1.0)
    none = replace(one, status="no_estimate")
    visit = Visit(2, 91.0, around(14.0, 2.0), None, (one, none))
    assert _visit_line(visit) == "Visit 2 (1 of 2 maps, day 91): largest size 14.0 mm (12.0 to 16.0, 95 % interval)"
    assert _visit_line(replace(visit, max_size_mm=None, maps=(none,))) == "Visit 2 (1 map, day 91): no size"


def test_a_mass_without_a_common_size_has_the_size_of_each_map_and_the_reason() -> None:
    first = PooledMap(
        map="a.nc",
        mass=(1, 2),
        status="estimate",
        reason="",
        detected_probability=0.97,
        max_size_mm=Interval(14.0, 12.0, 16.0, 0.95),
        outlying=False,
    )
    second = replace(first, map="b.nc", mass=(), status="no_estimate", reason="an odd map", max_size_mm=None)
    lines = pooled_text(pooled_report(reason="too few maps", maps=(first, second))).splitlines()
    assert lines == [
        "1. a.nc: 14.0 (12.0 to 16.0) mm alone, if exams repeat as simulated ones do  (mass 1 of 2 on this map)",
        "2. b.nc: no estimate (an odd map)",
        "No estimate: too few maps.",
        RESEARCH_USE,
    ]


def test_every_caution_on_maps_of_one_mass_is_told_with_its_map(monkeypatch: pytest.MonkeyPatch) -> None:
    own = finding("coarse_cells", "coarse"), finding("outside_calibration", "of the size alone")
    rise = OtherRise(
        x_mm=3.0, y_mm=4.0, amplitude=0.2, sigma_x_mm=5.0, sigma_y_mm=5.0, distance_mm=None, probability=0.99
    )
    reports = [sized(findings=own), sized(other_rises=(rise,))]
    monkeypatch.setattr(pooled_report_module, "maps_lying_apart", lambda _: {1: "30 mm from the others"})
    monkeypatch.setattr(pooled_report_module, "repeated_scans", lambda _: {1: 0})
    chances = {"one_place": 0.002, "one_size": 0.3, "one_size_apart": 0.6}
    made = {"fat_apart_mm": (10.0, 20.0), "outside": ["so wide"], "outlying": [1]}
    pooled: Any = SimpleNamespace(status="maps_disagree", reason="the masses lie apart", **chances | made)
    told = list(pooled_findings(pooled, reports))
    assert [(one.kind, one.about) for one in told] == [
        ("maps_disagree", ""),
        ("coarse_cells", "map 1"),
        ("another_mass", "map 2"),
        ("same_scan", "map 2"),
        ("fat_apart", ""),
        ("outside_calibration", ""),
        ("outlying", "map 2"),
        ("several_masses", "map 2"),
    ]
    assert "so far apart with a probability of 0.002" in told[0].text
    assert "10.0 mm deep on one map and 20.0 mm on another" in told[4].text
    assert told[7].text == "another rise stands at (3.0, 4.0) mm"
    pooled.one_place = 0.4  # at one place, of two sizes
    (first, *_) = pooled_findings(pooled, reports)
    assert "with a probability of 0.300 (0.600 if exams differ as those of patients did)" in first.text


def test_a_modality_without_common_masses_has_no_ratio_and_says_why() -> None:
    none = ModalityRatio(0, 0, None, None, None, None, {})
    assert ratio_line("us", none) == (
        "us: no MAPE ratio: no mass was looked for by both this modality and the tactile one"
    )


def test_a_campaign_without_a_learned_spread_says_what_its_intervals_suppose() -> None:
    campaign: Any = SimpleNamespace(repeatability=None, not_learned="2 masses have repeats, 5 are needed")
    assert repeatability_words(campaign) == (
        "spread between exams not learned: 2 masses have repeats, 5 are needed; intervals in the tables are for exams "
        "as alike as simulated ones"
    )
    campaign.not_learned = ""
    assert repeatability_words(campaign) == ""
