"""Extremes as a table: what a whole report says of trials with almost nothing, too much or the same in them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from published_schemas import check_document
from scipy import stats

from tactile_bayes.declarations import check_record, to_plain
from tactile_bayes.files.documents import dump_json
from tactile_bayes.report.trial import trial_text
from tactile_bayes.report.trial_html import trial_html
from tactile_bayes.trial.lines import weighted_deming
from tactile_bayes.trial.readings import Reading, Trial
from tactile_bayes.trial.summary import TrialReport, summarise

E = [8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0]


def trial(e: list[float], *replicates: list[float | None], patients: list[str] | None = None) -> Trial:
    """Masses with replicates; None is a replicate that found nothing."""
    keys = [(patients[i] if patients else f"P{i:02d}", str(i)) for i in range(len(e))]
    readings = [
        Reading(key, "tactile", number, "not_detected" if size is None else "detected", size)
        for key, group in zip(keys, replicates, strict=True)
        for number, size in enumerate(group, start=1)
    ]
    return Trial(readings, dict(zip(keys, e, strict=True)))


def report(e: list[float], *replicates: list[float | None]) -> TrialReport:
    return summarise(trial(e, *replicates))


def noisy(scale: float = 1.0) -> Trial:
    rng = np.random.default_rng(0)
    groups = [[scale * x * math.exp(rng.normal(0, 0.2)) for _ in range(3)] for x in E]
    return trial([scale * x for x in E], *groups)


TRIALS = {
    "as it should be": noisy,
    "scaled by 1e-6": lambda: noisy(1e-6),
    "scaled by 1e12": lambda: noisy(1e12),
    "slope 0": lambda: trial(E, *([15.0] for _ in E)),
    "negative correlation": lambda: trial(E, *([34.0 - x] for x in E)),
    "ties": lambda: trial([10.0] * 5 + [20.0] * 5, *([10.0], [12.0]) * 5),
    "one patient": lambda: trial(E, *([1.1 * x + i % 2] for i, x in enumerate(E)), patients=["P"] * 10),
    "one mass": lambda: trial([10.0], [12.0, 13.0]),
    "all undetected": lambda: trial(E, *([None, None] for _ in E)),
    "all identical": lambda: trial([10.0] * 10, *([10.0, 10.0] for _ in E)),
    "perfect": lambda: trial(E, *([x, x] for x in E)),
    "one replicate": lambda: trial(E, *([x + 1 + (i % 3)] for i, x in enumerate(E))),
}


PROVENANCE = {"program": "x", "version": "1", "command": "validate", "settings": {}, "seed": 0, "inputs": []}


def sections(name: str) -> dict:
    whole = json.loads(dump_json(to_plain(summarise(TRIALS[name]()), digits=12)))
    return whole["modalities"]["tactile"]


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", TRIALS)
def test_every_report_is_valid_and_can_be_shown(name: str) -> None:
    of = TRIALS[name]()
    made = summarise(of, provenance=PROVENANCE)
    check_record(made)
    document = json.loads(dump_json(to_plain(made, digits=12)))
    check_document(document, "validate.schema.json")
    assert "nan" not in trial_text(made).replace("nant", "")
    assert trial_html(made, of, text="").endswith("</html>\n")


def test_a_printed_page_cuts_no_table_and_a_narrow_one_scrolls_by_keys() -> None:
    """On A4 the last column of errors was cut off, and the one before it in the middle."""
    made = noisy()
    page = trial_html(summarise(made, provenance=PROVENANCE), made, text="")
    printed = page.split("@media print{", 1)[1].split("</style>", 1)[0]
    assert ".wide{overflow:visible}" in printed
    assert "table{font-size:7.5pt}" in printed
    assert page.count('<div class="wide" tabindex="0">') == page.count("<table")


@pytest.mark.parametrize("name", TRIALS)
def test_whatever_is_missing_has_its_reason(name: str) -> None:
    for part in (sections(name), sections(name)["method_comparison"], sections(name)["replicates"]):
        missing = {key for key, value in part.items() if value is None}
        free = {"detected_interval", "variance_components", "concordance_parts"}
        assert missing - free == set(part["reasons"]) - free


@pytest.mark.parametrize("scale", ["scaled by 1e-6", "scaled by 1e12"])
def test_units_change_no_ratio(scale: str) -> None:
    plain, scaled = sections("as it should be"), sections(scale)
    factor = 1e-6 if scale.endswith("-6") else 1e12
    for key in ("mape_percent", "weighted_mape_percent", "bias_percent", "slope_through_origin", "r2_centred"):
        assert scaled[key] == pytest.approx(plain[key], rel=1e-9), key
        if f"{key}_interval" in plain:
            assert scaled[f"{key}_interval"] == pytest.approx(plain[f"{key}_interval"], rel=1e-7), key
    for key in ("ols_slope", "deming_slope", "passing_bablok_slope", "concordance"):
        assert scaled["method_comparison"][key] == pytest.approx(plain["method_comparison"][key], rel=1e-7), key
    assert scaled["method_comparison"]["limits"]["mm"]["high"] == pytest.approx(
        factor * plain["method_comparison"]["limits"]["mm"]["high"]
    )
    assert scaled["replicates"]["icc"] == pytest.approx(plain["replicates"]["icc"], rel=1e-7)


DEFINED = {
    # trial: (section, {figure: value}); None is undefined
    "slope 0": (
        "method_comparison",
        {"ols_slope": 0, "deming_slope": 0, "passing_bablok_slope": 0, "concordance": None},
    ),
    "negative correlation": (
        "method_comparison",
        {
            "ols_slope": -1,
            "deming_slope": -1,
            "weighted_deming_slope": -1,
            "passing_bablok_slope": -1,
            "concordance": -1,
        },
    ),
    "all undetected": ("method_comparison", {"masses": 0, "ols_slope": None, "difference_mean_mm": None}),
    "all identical": (
        "method_comparison",
        {"ols_slope": None, "passing_bablok_slope": None, "difference_mean_mm": 0, "difference_sd_mm": 0},
    ),
    "perfect": (
        "method_comparison",
        {"ols_slope": 1, "deming_slope": 1, "weighted_deming_slope": 1, "passing_bablok_slope": 1, "concordance": 1},
    ),
    "one mass": (
        "method_comparison",
        {"masses": 1, "ols_slope": None, "difference_mean_mm": 2.5, "difference_sd_mm": None},
    ),
    "one replicate": ("replicates", {"within_mass_log_sd": None, "icc": None, "repeatability_low_percent": None}),
    "one patient": ("method_comparison", {"ols_slope_interval": None, "deming_slope_interval": None}),
}


@pytest.mark.parametrize("name", DEFINED)
def test_extremes_have_defined_answers(name: str) -> None:
    section, expected = DEFINED[name]
    part = sections(name)[section]
    for key, value in expected.items():
        assert part[key] == (None if value is None else pytest.approx(value, abs=1e-9)), key


def test_all_undetected_count_as_the_whole_error() -> None:
    assert sections("all undetected")["mape_percent"] == 100
    assert sections("all undetected")["detected"] == 0


def test_ties_have_one_answer_whatever_their_order() -> None:
    """Mean sizes 10.8 and 11.2 at 10 and 20 mm: slope 0.04."""
    forward = sections("ties")["method_comparison"]
    backward = report([20.0] * 5 + [10.0] * 5, *([12.0], [10.0]) * 5).modalities["tactile"].method_comparison
    assert forward["ols_slope"] == pytest.approx(0.04)
    assert backward.ols_slope == pytest.approx(0.04)
    assert forward["passing_bablok_slope"] == backward.passing_bablok_slope


def test_customary_intervals_of_weighted_deming_leave_out_one_mass_at_a_time() -> None:
    """Pseudo-values about the whole fit, their SD over root n, Student's t with n - 2 (Linnet 1990)."""
    made = trial(E, *([x * f] for x, f in zip(E, (1.1, 0.9, 1.2, 1.0, 0.8, 1.05, 1.15, 0.95, 1.3, 1.0), strict=True)))
    methods = summarise(made).modalities["tactile"].method_comparison
    x, y = np.array(E), made.sizes()["tactile"].size_mm
    whole = weighted_deming(x, y).slope
    pseudo = [10 * whole - 9 * weighted_deming(np.delete(x, i), np.delete(y, i)).slope for i in range(10)]
    reach = stats.t.ppf(0.975, 8) * np.std(pseudo, ddof=1) / math.sqrt(10)
    assert methods.analytic_intervals["weighted_deming_slope"] == pytest.approx((whole - reach, whole + reach))
