"""A trial in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from tactile_bayes.declarations import UNSET, replace
from tactile_bayes.findings import counted
from tactile_bayes.shell import padded, text_width
from tactile_bayes.trial.accuracy import REFERENCE, ModalityRatio, PairedComparison, least_p
from tactile_bayes.trial.figures import MIN_PATIENTS, Ends, Figure
from tactile_bayes.trial.planning import Design, Needed, PlanReport
from tactile_bayes.trial.summary import ModalityReport, TrialReport

DIGITS: Final = 12  #: Of the numbers of `validate`'s file, so that the order of summation changes no byte.

# --- Text of a trial plan: one line per design, then the benefit of more maps.

_NO_MASS_SD: Final = (
    "The pilot's masses differ no more than maps of one mass do, so its mass sd is taken as 0: with few masses that is "
    "chance; see what --mass-sd 0.1 makes of the plan."
)


def plan_text(plan: PlanReport) -> str:
    """Full text of a plan, ending with the research-use line."""
    by_option = [name for name, source in plan.errors_from.items() if source == "option"]
    piloted = "pilot" in plan.errors_from.values() and by_option
    lines = [
        *map(needed_sentence, plan.needed),
        f"Assumed errors of ln size: {_errors(plan, plan.errors)}",
        *([f"Given by options: {_errors(plan, by_option)}; the others are the pilot's."] if piloted else []),
        *([_NO_MASS_SD] if plan.errors["mass_sd"] == 0 and plan.errors_from["mass_sd"] == "pilot" else []),
        "",
        "                                     mean error, %     interval, factor",
        "patients  maps  power                 tactile  other   tactile   ratio",
        *(_design_line(design) for design in plan.designs),
        "",
        *(
            f"{gain.patients} patients, from {gain.from_maps} to {gain.to_maps} maps: power {gain.power_gain:+.3f}, "
            f"tactile error {gain.tactile_percent_change:+.1f} points"
            for gain in plan.gains
        ),
        "Power: tactile error smaller and p < 0.05, in brackets the simulation's own 95 % interval.",
        "Intervals of the tactile error and of the ratio of errors: median factor from lower to upper end.",
        plan.research_use,
    ]
    return "\n".join(lines) + "\n"


def needed_sentence(one: Needed) -> str:
    """Number of patients needed for a target."""
    aim = "power" if one.aim == "power" else "an interval of the tactile error of factor"
    maps = f"{counted(one.maps, 'map')} of each mass"
    ends = one.patients_interval
    range_words = "" if ends is None else f" (by the simulation's own error {ends[0]:.0f} to {ends[1]:.0f})"
    least = " (the least that a plan may have)" if one.patients == MIN_PATIENTS else range_words
    return f"needed: {one.patients} patients with {maps} for {aim} {one.target:g}{least}"


def _errors(plan: PlanReport, names: Iterable[str]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {plan.errors[name]:.3g}" for name in names)


def _design_line(one: Design) -> str:
    power = f"{one.power:.3f} [{one.power_interval[0]:.3f}, {one.power_interval[1]:.3f}]"
    widths = [f"x {width:.2f}" if width else "-" for width in (one.tactile_width_ratio, one.ratio_width_ratio)]
    return (
        f"{one.patients:>8}  {one.maps:>4}  {power:<20}  {one.tactile_percent:>7.1f}  {one.other_percent:>5.1f}  "
        f"{widths[0]:>8}  {widths[1]:>6}"
    )


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
    for name, one in report.modalities.items():
        lines = list(_modality_lines(name, one))
        yield from lines or [f"{name}: no lines or limits: too few masses were found, or their sizes do not differ"]
    if growing := growing_line(report):
        yield growing
    yield from map(_pair_line, report.paired_comparisons)


def _modality_lines(name: str, report: ModalityReport) -> Iterator[str]:
    methods = report.method_comparison
    for key, words in _LINES.items():
        slope, intercept = methods.figure(f"{key}_slope"), methods.figure(f"{key}_intercept_mm")
        if slope.value is not None:
            ratio = f", error ratio {methods.error_ratio:g}" if "deming" in key else ""
            yield f"{name}: {words}{ratio}: slope {shown(slope, '.2f')}, intercept {shown(intercept, '.1f')} mm"
    if methods.concordance is not None:
        yield f"{name}: concordance {shown(methods.figure('concordance'), '.2f')}"
    for words, bias, low, high in limit_rows(report):
        yield f"{name}: limits of agreement {words}: bias {bias}, {low} to {high}"
    repeated, parts = report.replicates, report.replicates.variance_components
    if repeated.repeatability_high_percent is not None:
        low = shown(repeated.figure("repeatability_low_percent"), ".0f")
        high = shown(repeated.figure("repeatability_high_percent"), "+.0f")
        yield f"{name}: two readings of one mass differ by {low} to {high} % at most in 95 % of pairs"
        if parts is not None:
            readers = "" if parts.reader is None else f", readers {100 * parts.reader**0.5:.0f}"
            named = "" if parts.n == report.readings_detected else f" (the {parts.n} readings that name a reader)"
            yield (
                f"{name}: SD of ln size, %: masses {100 * parts.mass**0.5:.0f}{readers}, maps "
                f"{100 * parts.map**0.5:.0f}{named}; ICC {shown(repeated.figure('icc'), '.2f')}"
            )
    if report.calibration is not None:
        calibration = report.calibration
        all_state = calibration.n == report.readings_detected
        of = "" if all_state else f" of {calibration.n} of {report.readings_detected} readings"
        yield (
            f"{name}: stated uncertainty{of}: CRPS {number(calibration.crps_mm, '.2f')} mm, "
            f"interval score {number(calibration.interval_score_mm, '.1f')} mm; {calibration.advice}"
        )


def limit_rows(report: ModalityReport) -> Iterator[tuple[str, str, str, str]]:
    """Limits of agreement, of the ratio, then in mm: the scale in words, bias, lower and upper limit."""
    methods = report.method_comparison
    for unit, one in sorted(methods.limits.items()):
        low, high = methods.figure(f"limit_low_{unit}"), methods.figure(f"limit_high_{unit}")
        if unit == "mm":
            yield "in mm", f"{one.bias:.3g}", shown(low, ".3g"), shown(high, ".3g")
        else:
            low, high = low.mapped(math.exp), high.mapped(math.exp)
            yield "of size / ex vivo", f"{math.exp(one.bias):.2f}", shown(low, ".2f"), shown(high, ".2f")


def growing_line(report: TrialReport) -> str | None:
    """Modalities whose limits in mm must not be used, and why; None where errors do not grow with size."""
    names = [name for name, one in report.modalities.items() if one.method_comparison.errors_grow_with_size]
    if not names:
        return None
    return (
        f"Errors grow with size ({', '.join(names)}): limits in mm are too wide for small masses, too narrow for large "
        "ones; use the ratio's."
    )


def _pair_line(pair: PairedComparison) -> str:
    head = f"{pair.first} - {pair.second} on {counted(pair.masses, 'common mass')}: "
    if pair.difference_percent is None:
        return head + f"no comparison: {pair.reasons['difference_percent']}"
    test = "" if pair.p_value is None or pair.p_holm is None else f"; p {pair.p_value:.4f}, p Holm {pair.p_holm:.4f}"
    difference, ratio = shown(pair.figure("difference_percent"), "+.1f"), shown(pair.figure("ratio"), ".2f")
    return head + f"MAPE {difference} points, ratio {ratio}{test}"


def shown(figure: Figure, spec: str) -> str:
    """Value with its interval in brackets."""
    if figure.value is None or figure.interval is None:
        return number(figure.value, spec)
    low, high = (number(end, spec) for end in figure.interval)
    return f"{number(figure.value, spec)} [{low}, {high}]"


def number(value: float | None, spec: str) -> str:
    """A number, without the sign of what rounds to 0, or a dash for none."""
    return "-" if value is None else format(value, spec.replace(".", "z."))


# --- Text report of a trial: a sentence for each comparison, a table that fits 80 columns; then methods.

_FIRST = {
    "mape_percent": ("error %", ".1f"),
    "mae_mm": ("error mm", ".1f"),
    "bias_percent": ("bias %", "+.1f"),
    "slope_through_origin": ("slope", ".2f"),
}
_DETECTED = {
    "mape_detected_percent": ("error % found", ".1f"),
    "slope_through_origin_detected": ("slope found", ".2f"),
    "r2_centred": ("r2", ".2f"),
    "r2_centred_detected": ("r2 found", ".2f"),
}
SPELLED: Final = {"cbe": "clinical breast examination (cbe)"}  #: Modalities that tables abbreviate, in words.
MOST_LABEL: Final = 11  #: Letters of a modality's name up to which its figures stand beside it.
MORE: Final = "More (lines, limits of agreement, repeatability, pairs, r2): validate -v."


def trial_text(report: TrialReport, *, notes: Sequence[str] = (), methods: bool = False) -> str:
    """The report in a screen, or the full one where `methods`; the research-use line comes last.

    `notes` say in words which readings take no part, and where intervals come from.
    """
    counts, made = report.counts, ""
    if counts.synthetic_readings:
        share = "all" if counts.synthetic_readings == counts.readings else f"{counts.synthetic_readings} of them"
        made = f" ({share} synthetic: made by a generator, not measured)"
    lines = [
        f"Sizes against excision: {counted(counts.masses, 'mass')} of {counted(counts.patients, 'patient')}, "
        f"{counted(counts.readings, 'reading')}{made}",
        *notes,
        *(f"Doubtful: {doubt}" for doubt in report.doubts),
        *comparison_sentences(report),
        "",
        *figure_table(report, _FIRST),
        "",
        *_notes(report),
        *(["", *_methods(report)] if methods else []),
        *([] if report.next_mass is UNSET else report.next_mass.lines()),
        *([] if methods else [MORE]),
        report.research_use,
    ]
    return "\n".join(lines) + "\n"


def comparison_sentences(report: TrialReport) -> list[str]:
    """A sentence for each modality that the tactile one is compared with; for every pair where it has no reading."""
    pairs = report.paired_comparisons
    led = [pair for pair in pairs if REFERENCE in (pair.first, pair.second)] or pairs
    return [_comparison_sentence(pair, f"{100 * report.interval_probability:g} %") for pair in led]


def _comparison_sentence(pair: PairedComparison, percent: str) -> str:
    quotient, first, second = pair.figure("ratio"), pair.first, pair.second
    if second == REFERENCE:
        first, second = second, first
        quotient = quotient.mapped(lambda ratio: 1 / ratio) if quotient.value else replace(quotient, value=None)
    other, masses = SPELLED.get(second, second), counted(pair.masses, "mass")
    if quotient.value is None:
        return f"{first} and {other} are not compared on {masses}: {quotient.reason or 'an error is 0'}"
    interval = f"no interval: {quotient.interval_reason}"
    if quotient.interval is not None:
        interval = f"{percent} {_between(quotient.interval, '.2f')}"
    p = "" if pair.p_holm is None else f", p {_short_p(pair.p_holm)}"
    return f"{first} errs {quotient.value:.2f} times as much as {other}, {interval}{p}, {masses}"


def _short_p(p: float) -> str:
    return "< .001" if p < 0.001 else f"{p:.2f}".lstrip("0") if p >= 0.0995 else f"{p:.2g}".lstrip("0")


def figure_table(report: TrialReport, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    """A table of figures by modality, each above its interval, in up to 80 columns."""
    rows: list[tuple[str, ...]] = [("", "found", *(words for words, _ in columns.values()))]
    for name, one in report.modalities.items():
        label = name if len(name) <= MOST_LABEL else ""
        if not label:
            rows.append((name,))
        figures = [(one.figure(key), spec) for key, (_, spec) in columns.items()]
        rows.append((label, f"{one.detected} of {one.n}", *(number(figure.value, spec) for figure, spec in figures)))
        share_ends = one.detected_interval
        share = "" if share_ends is None else f"{_between((100 * share_ends[0], 100 * share_ends[1]), '.0f')} %"
        rows.append(("", share, *(_between(figure.interval, spec) for figure, spec in figures)))
    widths = [max(map(text_width, column)) for column in zip(*(row for row in rows if len(row) > 1), strict=True)]
    lines = ["  ".join(padded(cell, width) for cell, width in zip(row, widths, strict=False)).rstrip() for row in rows]
    return [line for line in lines if line]


def _between(ends: Ends | None, spec: str) -> str:
    return "" if ends is None else f"{number(ends[0], spec)} to {number(ends[1], spec)}"


def _methods(report: TrialReport) -> Iterator[str]:
    """Lines that `validate -v` adds."""
    yield from figure_table(report, _DETECTED)
    yield ""
    for name, one in report.modalities.items():
        if one.within_mass_sd_mm is not None:
            sd, cv, rms = (
                shown(one.figure(f"within_mass_{key}"), spec)
                for key, spec in (("sd_mm", ".2g"), ("cv_percent", ".1f"), ("cv_rms_percent", ".1f"))
            )
            by = f"{counted(one.readings_detected, 'reading')} of {counted(one.detected, 'mass')}"
            yield f"{name}: within one mass, by {by}: mean SD {sd} mm, {cv} % (root mean square {rms} %)"
        yield from _reasons(name, one, [key for key in one.reasons if key.removesuffix("_interval") not in _FIRST])
    for name, quotient in report.mape_ratio_to_tactile.items():
        yield ratio_line(name, quotient)
    yield from method_lines(report)
    percent = f"{100 * report.interval_probability:g} %"
    yield f"In brackets: {percent} intervals. MAPE: mean absolute percentage error. ICC: intraclass correlation."
    yield (
        "CRPS: continuous ranked probability score. r2: centred, 1 - SSE0/SST (sums of squares about the line through "
        "0 and about the mean), below 0 where the line fails."
    )


def _notes(report: TrialReport) -> Iterator[str]:
    percent = f"{100 * report.interval_probability:g} %"
    for name, one in report.modalities.items():
        if one.masses_not_done or one.masses_without_reading:
            left_out = f"{one.masses_not_done} not done, {one.masses_without_reading} without a row"
            yield f"{name}: masses left out: {left_out}"
        for caution in one.cautions:
            yield f"{name}: {caution}"
        for stated in one.coverage:
            low, high = stated.fraction_interval
            yield (
                f"{name}: {100 * stated.probability:g} % intervals cover {stated.covered} of {stated.n} "
                f"({100 * stated.fraction:.0f} %, {percent} interval {100 * low:.0f} to {100 * high:.0f} %) "
                f"on {counted(stated.masses, 'mass')}"
            )
        yield from _reasons(name, one, [key for key in one.reasons if key.removesuffix("_interval") in _FIRST])
    yield from general_cautions(report)
    yield (
        f"Errors: mean absolute error, in percent of the size after excision and in mm, with its {percent} interval "
        "below; a mass not found counts as size 0, an error of 100 %."
    )
    yield "Bias: geometric mean over the masses found. Slope: of the line through 0 of sizes on those after excision."
    if tested := sum(pair.p_holm is not None for pair in report.paired_comparisons):
        pairs = f", corrected for {tested} pairs by Holm" if tested > 1 else ""
        yield f"p: sign-flip test by patient on the masses that both looked for{pairs}."


def general_cautions(report: TrialReport) -> Iterator[str]:
    """Sentences on masses that nobody read, and on patients too few for a test."""
    if report.counts.masses_without_any_reading:
        yield f"{counted(report.counts.masses_without_any_reading, 'excised mass')} without any reading, left out."
    patients = max((pair.patients for pair in report.paired_comparisons if pair.p_value is not None), default=0)
    if patients and (least := least_p(patients)) >= 0.05:  # no difference between modalities could give less
        yield f"With {counted(patients, 'patient')} p cannot be below {least:.2g}: the test says nothing here."


def ratio_line(name: str, one: ModalityRatio) -> str:
    """Ratio of errors, with the number of masses it is over."""
    if one.masses == 0:
        return f"{name}: no MAPE ratio: no mass was looked for by both this modality and the tactile one"
    masses = counted(one.masses, "common mass")
    if one.ratio is None:
        return f"{name}: no MAPE ratio on {masses}: {one.reasons['ratio']}"
    ratio, of_found = shown(one.figure("ratio"), ".2f"), "none on those that both found"
    if one.ratio_detected is not None:
        of_found = f"{shown(one.figure('ratio_detected'), '.2f')} times on the {one.masses_detected} that both found"
    return f"{name}: MAPE {ratio} times the tactile one's on {masses}; {of_found}"


def _reasons(name: str, report: ModalityReport, keys: Sequence[str]) -> Iterator[str]:
    """Reasons for missing figures and intervals; those of missing replicates stand in the JSON only."""
    owed = {key: report.reasons[key] for key in keys if not key.startswith(("within_mass", "calibration"))}
    figures = {key: why for key, why in owed.items() if not key.endswith("_interval")}
    intervals = {key.removesuffix("_interval"): why for key, why in owed.items() if key.endswith("_interval")}
    intervals = {key: why for key, why in intervals.items() if key not in figures}
    words = {key: text for key, (text, _) in (_FIRST | _DETECTED).items()}
    for lead, missing in (("", figures), ("interval of ", intervals)):
        for reason in dict.fromkeys(missing.values()):
            affected = ", ".join(words.get(key, key.replace("_", " ")) for key, why in missing.items() if why == reason)
            yield f"{name}: no {lead}{affected}: {reason}"
