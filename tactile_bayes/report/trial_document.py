"""Trial report as plain data for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from tactile_bayes.trial.check_intervals import IntervalCheck
from tactile_bayes.trial.comparison import ModalityRatio
from tactile_bayes.trial.figures import Figure
from tactile_bayes.trial.method_comparison import MethodComparison
from tactile_bayes.trial.paired import PairedComparison
from tactile_bayes.trial.summary import ModalityReport, TrialReport

CONVENTIONS: dict[str, str] = {
    "masses": "sizes are averaged over the detected replicates of a mass first; a mass counts once",
    "detected": "a mass found in at least one replicate",
    "not_detected": "counted as size 0 (100 % error) in figures without '_detected', as in Wellman & Howe (1999)",
    "not_done": "left out and counted",
    "bias_percent": "100 (geometric mean of size / ex vivo - 1), over detected masses only",
    "slope_through_origin": "sizes on ex-vivo sizes without an intercept",
    "r2_centred": "1 - SSE0 / SST, the headline; below 0 when the mean would do better",
    "r2_uncentred": "1 - SSE0 / sum of squared sizes",
    "r2_pearson": "squared correlation",
    "within_mass": "mean over masses of the SD of replicates; '_rms': root of the mean variance by degrees of freedom",
    "weighted_mape_percent": "sum of absolute errors over the sum of ex-vivo sizes, in percent",
    "median_error_percent": "median absolute error in percent of the ex-vivo size",
    "method_comparison": "detected masses only; x is the ex-vivo size, differences are size - ex vivo; "
    "'analytic_intervals' take masses as independent, the others are over patients",
    "error_ratio": "variance of the ex-vivo error over that of the modality's, for the two Deming lines",
    "passing_bablok": "shifted median of slopes, middle slopes averaged as angles",
    "limits": "of agreement, for single readings, 95 % of differences; 'log_ratio' as ln(size / ex vivo); their "
    "intervals take masses as independent and differences as normal, those of 'limit_low_mm' etc. are over patients",
    "mape_ratio_to_tactile": "on the masses that both looked for, or that both found",
    "repeatability": "change between two readings of one mass in 95 % of pairs, by the within-mass SD of ln size",
    "calibration": "stated intervals as normal on ln size, the caliper's error added in quadrature",
    "paired_comparisons": "masses that both modalities looked for; not detected counts as size 0; sign-flip test by "
    "patient, p_holm corrected for all pairs",
    "intervals": "over patients, as the setting 'intervals' says: 'corrected' and 'jackknife' leave one patient out "
    "and take Student's t, 'corrected' allowing for misses not seen and few influential patients; shares: "
    "Clopper-Pearson",
}


def as_document(report: TrialReport) -> dict[str, Any]:
    """Trial report as plain data; numbers have 12 digits, so that the order of summation changes no byte."""
    return {
        "interval_probability": report.confidence,
        "counts": {
            "patients": report.patients,
            "masses": report.masses,
            "masses_without_any_reading": report.masses_without_any_reading,
            "readings": report.readings,
            "synthetic_readings": report.synthetic_readings,
            "masses_of_several_visits": report.other_visits.masses,
            "readings_of_earlier_visits": report.other_visits.earlier,
            "readings_after_excision": report.other_visits.later,
        },
        "modalities": {name: _modality_document(one) for name, one in report.modalities.items()},
        "mape_ratio_to_tactile": {name: _ratio_document(one) for name, one in report.ratios.items()},
        "paired_comparisons": [_paired_document(one) for one in report.paired],
        "doubts": list(report.doubts),
        "conventions": CONVENTIONS,
    }


def checks_document(checks: Mapping[str, IntervalCheck]) -> dict[str, Any]:
    """Simulated coverage of the intervals of `mape_percent`, by modality."""
    return {
        name: {
            "trials": one.trials,
            "covered": one.covered,
            "share": _rounded(one.share),
            "share_interval": _rounded_ends(one.interval),
            "above": one.low_misses,
            "below": one.high_misses,
            "undefined": one.undefined,
            "median_width_ratio": _plain(one.median_width_ratio),
            "model": _plain(one.model),
            "true_mape_percent": _rounded(one.model.true_mape_percent),
        }
        for name, one in checks.items()
    }


def _modality_document(report: ModalityReport) -> dict[str, Any]:
    document = _figures_document(report.figures)
    if report.calibration is None:
        document["reasons"]["calibration"] = "no reading states an interval or a standard deviation"
    return {
        "n": report.n,
        "detected": report.detected,
        "detected_interval": _rounded_ends(report.detected_interval),
        "patients": report.patients,
        "readings": report.readings,
        "readings_detected": report.readings_detected,
        "masses_not_done": report.masses_not_done,
        "masses_without_reading": report.masses_without_reading,
        **document,
        "coverage": [
            {
                "probability": one.probability,
                "n": one.n,
                "covered": one.covered,
                "masses": one.masses,
                "fraction": _rounded(one.fraction),
                "fraction_interval": _rounded_ends(one.interval),
            }
            for one in report.coverage
        ],
        "method_comparison": _methods_document(report.methods),
        "replicates": {**_figures_document(report.replicates), "variance_components": _plain(report.components)},
        "calibration": _plain(report.calibration),
        "cautions": list(report.cautions),
    }


def _methods_document(methods: MethodComparison) -> dict[str, Any]:
    return {
        "masses": methods.n,
        "error_ratio": methods.error_ratio,
        **_figures_document(methods.figures),
        "analytic_intervals": {name: _rounded_ends(ends) for name, ends in methods.analytic.items()},
        "limits": {name: _plain(one) for name, one in methods.limits.items()},
        "trends": {name: _plain(one) for name, one in methods.trends.items()},
        "concordance_parts": _plain(methods.concordance),
        "errors_grow_with_size": methods.errors_grow,
    }


def _ratio_document(one: ModalityRatio) -> dict[str, Any]:
    figures = {"ratio": one.ratio, "ratio_detected": one.ratio_detected}
    return {"masses": one.masses, "masses_detected": one.masses_detected, **_figures_document(figures)}


def _paired_document(one: PairedComparison) -> dict[str, Any]:
    figures = {"difference_percent": one.difference_percent, "ratio": one.ratio}
    plain = {name: getattr(one, name) for name in ("first", "second", "masses", "patients")}
    numbers = {name: _plain(getattr(one, name)) for name in ("first_percent", "second_percent", "p_value", "p_holm")}
    return {**plain, **numbers, **_figures_document(figures)}


def _plain(value: object) -> Any:
    """Convert dataclasses, tuples and numbers to JSON values; what is not finite becomes null."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return _rounded(value) if math.isfinite(value) else None
    return value


def _figures_document(figures: Mapping[str, Figure]) -> dict[str, Any]:
    document: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for name, one in figures.items():
        document[name] = None if one.value is None else _rounded(one.value)
        if one.value is None:
            reasons[name] = one.reason
        if one.has_interval:
            document[f"{name}_interval"] = _rounded_ends(one.interval)
            if one.interval is None:
                reasons[f"{name}_interval"] = one.interval_reason
    return {**document, "reasons": reasons}


def _rounded(value: float) -> float:
    return float(f"{value:.12g}")


def _rounded_ends(ends: tuple[float, float] | None) -> list[float] | None:
    return None if ends is None else [_rounded(ends[0]), _rounded(ends[1])]
