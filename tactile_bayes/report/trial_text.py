"""Text report of a trial: one table with units, then its omissions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.trial_methods_text import method_lines, shown
from tactile_bayes.trial.check_intervals import IntervalCheck
from tactile_bayes.trial.comparison import ModalityRatio
from tactile_bayes.trial.figures import Figure
from tactile_bayes.trial.summary import ModalityReport, TrialReport

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
