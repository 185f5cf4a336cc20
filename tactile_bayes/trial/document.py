"""A trial report as plain data, ready for JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactile_bayes.trial.figures import Figure
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
    "intervals": "leave-one-patient-out jackknife with Student's t; shares: Clopper-Pearson",
}


def as_document(report: TrialReport) -> dict[str, Any]:
    """The report as plain data for JSON; numbers carry 12 digits, so that summation order shows in no byte."""
    return {
        "interval_probability": report.confidence,
        "counts": {
            "patients": report.patients,
            "masses": report.masses,
            "masses_without_any_reading": report.masses_without_any_reading,
            "readings": report.readings,
            "synthetic_readings": report.synthetic_readings,
        },
        "modalities": {name: _modality_document(one) for name, one in report.modalities.items()},
        "mape_ratio_to_tactile": {name: _figures_document(one) for name, one in report.ratios.items()},
        "conventions": CONVENTIONS,
    }


def _modality_document(report: ModalityReport) -> dict[str, Any]:
    return {
        "n": report.n,
        "detected": report.detected,
        "detected_interval": _rounded_ends(report.detected_interval),
        "patients": report.patients,
        "readings": report.readings,
        "readings_detected": report.readings_detected,
        "masses_not_done": report.masses_not_done,
        "masses_without_reading": report.masses_without_reading,
        **_figures_document(report.figures),
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
    }


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
