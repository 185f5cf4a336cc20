"""Second table of a trial report: repeatability, calibration and comparison of the measuring methods."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tactile_bayes.trial.figures import Figure
from tactile_bayes.trial.paired import PairedComparison, least_p
from tactile_bayes.trial.summary import ModalityReport, TrialReport

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


@dataclass(frozen=True, slots=True)
class LimitRow:
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
