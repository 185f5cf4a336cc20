"""A trial in words and as a document."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from tactile_bayes.declarations import Record, names_of
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.trial.accuracy import ModalityRatio, PairedComparison, least_p
from tactile_bayes.trial.figures import Figure
from tactile_bayes.trial.method_comparison import MethodComparison
from tactile_bayes.trial.planning import IntervalCheck
from tactile_bayes.trial.summary import ModalityReport, TrialReport

# --- Text of a trial plan: one line per design, then the benefit of more maps.


def plan_text(document: Mapping[str, Any]) -> str:
    """Full text of a plan, ending with the research-use line."""
    lines = [
        f"Assumed errors of ln size: {_errors(document, document['errors'])}",
        *_origins(document),
        "",
        "patients  maps  power                tactile MAPE %  other MAPE %  tactile interval  ratio interval",
        *(_design_line(one) for one in document["designs"]),
        "",
        *_gain_lines(document),
        "power: tactile error smaller and p < 0.05, in brackets the simulation's own 95 % interval.",
        "intervals: median factor from lower to upper end.",
        str(document["research_use"]),
    ]
    return "\n".join(lines) + "\n"


def _errors(document: Mapping[str, Any], names: Iterable[str]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {document['errors'][name]:.3g}" for name in names)


def _origins(document: Mapping[str, Any]) -> Iterator[str]:
    """Source of each assumed error when there is a pilot: the pilot or an option."""
    sources: Mapping[str, str] = document["errors_from"]
    given = [name for name, source in sources.items() if source == "option"]
    if "pilot" in sources.values() and given:
        yield f"Given by options: {_errors(document, given)}; the others are the pilot's."


def _design_line(one: Mapping[str, Any]) -> str:
    low, high = one["power_interval"]
    power = f"{one['power']:.3f} [{low:.3f}, {high:.3f}]"
    widths = [f"x {one[key]:.2f}" if one[key] else "-" for key in ("tactile_width_ratio", "ratio_width_ratio")]
    return (
        f"{one['patients']:>8}  {one['maps']:>4}  {power:<19}  {one['tactile_percent']:>14.1f}  "
        f"{one['other_percent']:>12.1f}  {widths[0]:>16}  {widths[1]:>14}"
    )


def _gain_lines(document: Mapping[str, Any]) -> Iterator[str]:
    for one in document["gains"]:
        yield (
            f"{one['patients']} patients, from {one['from_maps']} to {one['to_maps']} maps: power "
            f"{one['power_gain']:+.3f}, tactile MAPE {one['tactile_percent_change']:+.1f} points"
        )


# --- Trial report as plain data for JSON.

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
    """Convert records, tuples and numbers to JSON values; what is not finite becomes null."""
    if isinstance(value, Record):
        return {name: _plain(getattr(value, name)) for name in names_of(value)}
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


# --- Second table of a trial report: repeatability, calibration and comparison of the measuring methods.

_LINES = {
    "ols": "least squares",
    "deming": "Deming",
    "weighted_deming": "weighted Deming",
    "passing_bablok": "Passing-Bablok",
}


def method_lines(report: TrialReport) -> Iterator[str]:
    """Text lines, none longer than 150 characters."""
    yield "Detected masses as measurements (size on ex vivo; differences are size - ex vivo):"
    for one in report.modalities.values():
        lines = list(_modality_lines(one))
        yield from lines or [f"{one.name}: no lines or limits: too few masses were found, or their sizes do not differ"]
    growing = growing_line(report)
    if growing:
        yield growing
    for pair in report.paired:
        yield _pair_line(pair)
    if report.paired:
        yield "p: sign-flip test by patient on the masses both looked for; p Holm: corrected for all pairs."
        yield from _least_p_lines(report.paired)


def _modality_lines(report: ModalityReport) -> Iterator[str]:
    figures, name = report.methods.figures, report.name
    for key, words in _LINES.items():
        slope, intercept = figures[f"{key}_slope"], figures[f"{key}_intercept_mm"]
        if slope.value is not None:
            ratio = f", error ratio {report.methods.error_ratio:g}" if "deming" in key else ""
            yield f"{name}: {words}{ratio}: slope {shown(slope, '.2f')}, intercept {shown(intercept, '.1f')} mm"
    if figures["concordance"].value is not None:
        yield f"{name}: concordance {shown(figures['concordance'], '.2f')}"
    yield from _limits_lines(report)
    yield from _replicate_lines(report)
    if report.calibration is not None:
        found = report.calibration
        yield (
            f"{name}: stated uncertainty: CRPS {found.crps_mm:.2f} mm, "
            f"interval score {found.interval_score_mm:.1f} mm; {found.advice}"
        )


def _limits_lines(report: ModalityReport) -> Iterator[str]:
    for row in limit_rows(report):
        yield f"{report.name}: limits of agreement {row.words}: bias {row.bias}, {row.low} to {row.high}"


class LimitRow(Record):
    """Limits of agreement on one scale, formatted."""

    words: str
    bias: str
    low: str
    high: str


def limit_rows(report: ModalityReport) -> Iterator[LimitRow]:
    """Limits of the ratio, then in mm."""
    figures = report.methods.figures
    for unit in ("log_ratio", "mm"):
        one = report.methods.limits.get(unit)
        if one is None:
            continue
        low, high = figures[f"limit_low_{unit}"], figures[f"limit_high_{unit}"]
        if unit == "mm":
            yield LimitRow("in mm", f"{one.bias:.3g}", shown(low, ".3g"), shown(high, ".3g"))
            continue
        low, high = low.mapped(math.exp), high.mapped(math.exp)
        yield LimitRow("of size / ex vivo", f"{math.exp(one.bias):.2f}", shown(low, ".2f"), shown(high, ".2f"))


def growing_line(report: TrialReport) -> str | None:
    """Modalities whose limits in mm must not be used, and why; None where errors do not grow with size."""
    names = [one.name for one in report.modalities.values() if one.methods.errors_grow]
    if not names:
        return None
    return (
        f"Errors grow with size ({', '.join(names)}): limits in mm are too wide for small masses, too narrow for large "
        "ones; use the ratio's."
    )


def _replicate_lines(report: ModalityReport) -> Iterator[str]:
    figures = report.replicates
    if figures["repeatability_high_percent"].value is None:
        return
    low, high = shown(figures["repeatability_low_percent"], ".0f"), shown(figures["repeatability_high_percent"], "+.0f")
    yield f"{report.name}: two readings of one mass differ by {low} to {high} % at most in 95 % of pairs"
    parts = report.components
    if parts is not None:
        readers = "" if parts.reader is None else f", readers {100 * parts.reader**0.5:.0f}"
        icc = shown(figures["icc"], ".2f")
        yield (
            f"{report.name}: SD of ln size, %: masses {100 * parts.mass**0.5:.0f}{readers}, maps "
            f"{100 * parts.map**0.5:.0f}; ICC {icc}"
        )


def _pair_line(pair: PairedComparison) -> str:
    head = f"{pair.first} - {pair.second} on {pair.masses} common masses: "
    if pair.difference_percent.value is None:
        return head + f"no comparison: {pair.difference_percent.reason}"
    test = "" if pair.p_value is None or pair.p_holm is None else f"; p {pair.p_value:.4f}, p Holm {pair.p_holm:.4f}"
    difference = shown(pair.difference_percent, "+.1f")
    return head + f"MAPE {difference} points, ratio {shown(pair.ratio, '.2f')}{test}"


def _least_p_lines(pairs: Sequence[PairedComparison]) -> Iterator[str]:
    """A line where a pair has so few patients that no difference between modalities could give p < 0.05."""
    tested = [pair.patients for pair in pairs if pair.p_value is not None]
    if tested and (least := least_p(max(tested))) >= 0.05:
        few = f"{max(tested)} patient{'' if max(tested) == 1 else 's'}"
        yield f"With {few} p cannot be below {least:.2g}: the test says nothing here."


def shown(figure: Figure, spec: str) -> str:
    """Value with its interval in brackets."""
    if figure.value is None:
        return "-"
    return f"{figure.value:{spec}}{_ends(figure.interval, spec)}"


def _ends(interval: tuple[float, float] | None, spec: str = ".3g") -> str:
    return "" if interval is None else f" [{interval[0]:{spec}}, {interval[1]:{spec}}]"


# --- Text report of a trial: one table with units, then its omissions.

_HEADINGS = ("", "found", "MAPE %", "MAPE % found", "MAE mm", "bias % found", "slope", "r2", "r2 found")


def trial_text(
    report: TrialReport,
    *,
    methods: bool = False,
    checks: Mapping[str, IntervalCheck] | None = None,
    more: Sequence[str] = (),
) -> str:
    """Full report, with the second table when `methods`; the research-use line comes last."""
    lines = [
        f"Sizes against excision: {_plural(report.masses, 'mass')} of {_plural(report.patients, 'patient')}, "
        f"{_plural(report.readings, 'reading')}{_synthetic(report)}",
        *report.other_visits.lines(),
        *(f"Doubtful: {doubt}" for doubt in report.doubts),
        "",
        *_aligned([_HEADINGS, *(_row(one) for one in report.modalities.values())]),
        "",
        *_notes(report),
        *(["", *method_lines(report)] if methods else []),
        *(_check_line(name, one) for name, one in (checks or {}).items()),
        *more,
        RESEARCH_USE,
    ]
    return "\n".join(lines) + "\n"


def _check_line(name: str, check: IntervalCheck) -> str:
    low, high = check.interval
    return (
        f"{name}: in {check.trials} simulated trials of this size {check.share:.1%} [{low:.1%}, {high:.1%}] of the "
        f"MAPE intervals covered the true one; {check.low_misses} were above it, {check.high_misses} below"
    )


def _row(report: ModalityReport) -> tuple[str, ...]:
    figures = report.figures
    return (
        report.name,
        _found(report),
        shown(figures["mape_percent"], ".1f"),
        shown(figures["mape_detected_percent"], ".1f"),
        shown(figures["mae_mm"], ".3g"),
        shown(figures["bias_percent"], "+.1f"),
        shown(figures["slope_through_origin"], ".2f"),
        shown(figures["r2_centred"], ".2f"),
        shown(figures["r2_centred_detected"], ".2f"),
    )


def _notes(report: TrialReport) -> Iterator[str]:
    percent = f"{100 * report.confidence:g} %"
    for one in report.modalities.values():
        yield from _modality_notes(one, percent=percent)
    for name, quotient in report.ratios.items():
        yield ratio_line(name, quotient)
    if report.masses_without_any_reading:
        yield f"{_plural(report.masses_without_any_reading, 'excised mass')} without any reading, left out"
    yield f"In brackets: {percent} intervals. MAPE: mean absolute error in percent of the ex-vivo size."
    yield "A mass not found counts as size 0 (100 % error), except in columns that say 'found'."
    yield "slope: line through 0 of sizes on ex-vivo sizes. r2: centred, 1 - SSE0/SST, below 0 where it fails."


def ratio_line(name: str, one: ModalityRatio) -> str:
    """Ratio of errors, with the number of masses it is over."""
    if one.masses == 0:
        return f"{name}: no MAPE ratio: no mass was looked for by both this modality and the tactile one"
    if one.ratio.value is None:
        return f"{name}: no MAPE ratio on {_plural(one.masses, 'common mass')}: {one.ratio.reason}"
    line = f"{name}: MAPE {shown(one.ratio, '.2f')} times the tactile one's on {_plural(one.masses, 'common mass')}"
    return f"{line}; {shown(one.ratio_detected, '.2f')} times on the {one.masses_detected} that both found"


def _modality_notes(report: ModalityReport, *, percent: str) -> Iterator[str]:
    name, figures = report.name, report.figures
    if report.masses_not_done or report.masses_without_reading:
        left_out = f"{report.masses_not_done} not done, {report.masses_without_reading} without a row"
        yield f"{name}: masses left out: {left_out}"
    if figures["within_mass_sd_mm"].value is not None:
        sd, cv = shown(figures["within_mass_sd_mm"], ".2g"), shown(figures["within_mass_cv_percent"], ".1f")
        rms = shown(figures["within_mass_cv_rms_percent"], ".1f")
        yield f"{name}: within one mass, mean SD {sd} mm, {cv} % (root mean square {rms} %)"
    for caution in report.cautions:
        yield f"{name}: {caution}"
    for one in report.coverage:
        low, high = one.interval
        yield (
            f"{name}: {100 * one.probability:g} % intervals cover {one.covered} of {one.n} "
            f"({one.fraction:.0%}, {percent} interval {low:.0%} to {high:.0%}) on {_plural(one.masses, 'mass')}"
        )
    yield from _reasons(name, figures)


def _reasons(name: str, figures: Mapping[str, Figure]) -> Iterator[str]:
    """Reasons for missing figures and intervals; missing replicates are named in the JSON only."""
    owed = {key: one for key, one in figures.items() if not key.startswith("within_mass")}
    for reason in dict.fromkeys(one.reason for one in owed.values() if one.reason):
        affected = ", ".join(key for key, one in owed.items() if one.reason == reason)
        yield f"{name}: no {affected}: {reason}"
    for reason in dict.fromkeys(one.interval_reason for one in owed.values() if one.value is not None):
        if reason:
            yield f"{name}: no interval of some figures: {reason}"


def _found(report: ModalityReport) -> str:
    share = f"{report.detected}/{report.n}"
    if report.detected_interval is None:
        return share
    low, high = report.detected_interval
    return f"{share} [{100 * low:.0f}, {100 * high:.0f} %]"


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _synthetic(report: TrialReport) -> str:
    if not report.synthetic_readings:
        return ""
    share = "all" if report.synthetic_readings == report.readings else f"{report.synthetic_readings} of them"
    return f" ({share} synthetic: made by a generator, not measured)"


def _plural(count: int, noun: str) -> str:
    plural = f"{noun}es" if noun.endswith("s") else f"{noun}s"
    return f"{count} {noun if count == 1 else plural}"
