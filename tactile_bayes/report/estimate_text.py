"""An estimate in words."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from tactile_bayes.declarations import from_plain
from tactile_bayes.files.reports import EstimateReport, MassReport, PooledReport, SmallestLump
from tactile_bayes.findings import capitalised, counted, finding_lines, finding_summary, first_of
from tactile_bayes.inference.draws import ParameterDraws, Quantity
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import SHARE_WITH_LUMP, chance_text, largest_tried_mm
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report import estimate_document
from tactile_bayes.size.draws import EXTREMES, SIZES

# --- The smallest lump that a map without one would have shown, in a sentence.


def smallest_text(smallest: SmallestLump) -> str:
    """Diameters that would have shown, by depth, where the map is best and where it is worst; without a full stop."""
    ends = zip(smallest.depths_mm, smallest.best_mm, smallest.worst_mm, strict=True)
    ranges = []
    for depth, best, worst in ends:
        more = f"more than {largest_tried_mm(depth):g}"
        across = " to ".join(dict.fromkeys(more if one is None else f"{one:.3g}" for one in (best, worst)))
        ranges.append(f"{across} mm at a depth of {depth:g} mm")
    of_100 = f"{100 * smallest.probability:g} times of 100"
    return (
        f"In this map a round lump would have been seen ({of_100}) from these diameters on, by where it lies: "
        f"{'; '.join(ranges)} (of its middle)"
    )


# --- Sentences about a size, shared by the reports of one map and of several.

SIZE_DECIMALS = 1
"""At most, whatever the Monte-Carlo error: sizes are compared with excisions, which are measured in mm."""
SOURCES = {
    "map": "the map",
    "between_maps": "spread between maps of one mass",
    "calibration": "the calibration's coefficients",
    "residual": "the scatter about Eq 6",
    "body": "properties of the body that no map shows",
    "site": "the correction by the site's phantoms",
    "shape": "whether the lump is round or oval",
}


def spread_percent(spread: float) -> str:
    """A spread between exams in percent, to a tenth: whole ones made 2 and 3 of what is 2.5 on all maps."""
    return f"{100 * spread:.1f}".removesuffix(".0") + " %"


def exams_label(spread: float | None) -> str:
    """The spread between exams that an interval supposes; `spread` is a share of the size, None for no spread."""
    return f"if exams differ by {spread_percent(spread)}" if spread is not None else "if exams do not differ"


def two_intervals_text(this: float | None, another: float) -> str:
    """Both spreads that the intervals of a size suppose; `this`: of the narrower one, None for no spread."""
    alike = "no spread" if this is None else spread_percent(this)
    return (
        f"The intervals of the sizes suppose that exams of one mass differ by {100 * another:.0f} %, as those of "
        f"patients did in the paper; the narrower one supposes {alike}, as those of simulated bodies do: what exams "
        "that repeat so well can buy. `calibrate repeatability` learns a site's own spread; then there is one interval."
    )


def site_interval_text(repeatability: str) -> str:
    """The spread that the interval of a size supposes at a site of known repeatability (`Repeatability.words`)."""
    return f"The interval is for any exam of the mass: {repeatability}."


def decimals(mc_error: float, *, most: int = 3) -> int:
    """Decimal places that the Monte-Carlo error of an interval's end supports."""
    if not mc_error > 0:
        return most
    return min(most, max(0, -math.floor(math.log10(2.0 * mc_error))))


def ends_text(name: str, mc_error: float, sd: float) -> str:
    """Monte-Carlo error of the ends of intervals, in SDs and mm."""
    return f"{name} {mc_error / sd:.3f} SD ({mc_error:.2g} mm)" if sd > 0 else f"{name} {mc_error:.2g} mm"


def shape_text(figures: Mapping[str, float]) -> str:
    """The lump's outline, round or oval, with its probability and its effect on the largest size."""
    lead = "Irregular outline. " if figures.get("irregular_outline") else ""
    probability = figures["oval_probability"]
    longer = 100 * math.expm1(figures["oval_half_log_ratio"])
    if probability < 0.005:
        text = "Sized as round; an oval lump is improbable (below 0.005)."
    elif probability < 0.5:
        text = f"Sized as round; an oval lump (probability {probability:.2f}) would be {longer:.0f} % longer."
    else:
        text = f"Oval (probability {probability:.2f}): {longer:.0f} % longer than a round lump of the same mean size."
    return lead + text


# --- Sources of a size interval's width, remedies, and the pieces of short reports.

MOST_LINES = 12  #: Of a short report.
MORE = "More (all quantities, places looked at, odds, priors, omissions): estimate -v."
"""The end of a short report's last line but one."""
NARROWED_BY = {
    "map": "a slower scan with more strokes over the lump",
    "between_maps": "more exams of this mass, pooled (estimate --pool); the site's spread (calibrate repeatability)",
    "calibration": "a size calibration learned from more lumps",
    "residual": "a size calibration learned with this head and bodies like this one",
    "site": "more phantoms of known size, depth, seat and stiffness (calibrate size --correct)",
    "body": "knowing the lump's depth, seat or stiffness (estimate --known)",
}
WORTH_NARROWING = 10.0  #: Percent of the variance from which a source is worth a way to narrow it.

ON_PAPER = {
    "map": "how clearly this map shows the lump",
    "between_maps": "differences between exams of one lump",
    "calibration": "the number of lumps that sizes were learned from",
    "residual": "differences between lumps of one size",
    "body": "what no map shows of the body and the lump",
    "site": "the number of phantoms measured here",
    "shape": "whether the lump is round or oval",
}
"""`SOURCES` and `NARROWED_BY` for a reader who has no command line."""
NARROWED_ON_PAPER = {
    "between_maps": "more exams of this lump, taken together; repeat exams of some patients here",
    "site": "more phantoms of known size measured here",
    "body": "knowing how deep the lump lies or how stiff it is",
}


def width_lines(variance_share: Mapping[str, float] | None, *, paper: bool = False) -> list[str]:
    """Sources of a size's variance, largest first, and ways to narrow the interval.

    `variance_share`: percent of the variance of the largest size, by source; None without a size.
    """
    sources, narrowed = (ON_PAPER, NARROWED_BY | NARROWED_ON_PAPER) if paper else (SOURCES, NARROWED_BY)
    ranked = sorted((variance_share or {}).items(), key=lambda pair: -pair[1])
    parts = [f"{share:.0f} % {sources.get(name, name)}" for name, share in ranked if share >= 0.5]
    ways = [narrowed[name] for name, share in ranked if share >= WORTH_NARROWING and name in narrowed]
    lines = [f"What makes the interval wide: {', '.join(parts)}."] if parts else []
    return [*lines, f"What would narrow it: {'; '.join(ways)}."] if ways else lines


# --- An estimate as a short table a clinician can read.

ANOTHER_LARGEST = "another_exam.max_size_mm"
ANOTHER_SMALLEST = "another_exam.min_size_mm"
ROWS = (
    (ANOTHER_LARGEST, "largest size", "mm"),
    (ANOTHER_SMALLEST, "smallest size", "mm"),
    ("max_size_mm", "largest size", "mm"),
    ("min_size_mm", "smallest size", "mm"),
    ("d_x_mm", "size across the head, d_x", "mm"),
    ("d_y_mm", "size along the head, d_y", "mm"),
    ("amplitude", "amplitude", ""),
    ("sigma_x_mm", "map width sigma_x", "mm"),
    ("sigma_y_mm", "map width sigma_y", "mm"),
    ("angle_deg", "angle from x to sigma_x", "deg"),
    ("centre_mm.x", "centre on the map, x", "mm"),
    ("centre_mm.y", "centre on the map, y", "mm"),
    ("centre_patient_mm.x", "patient's right of xiphoid, x", "mm"),
    ("centre_patient_mm.y", "centre above the xiphoid, y", "mm"),
)
_NAMES = tuple(name for name, _, _ in ROWS)
MOST_PASSED_OVER = 4
LEAST_SHARE = 0.005  #: Of the width variance, below which the tracker's share is not worth a line.


def estimate_text(estimate: Estimate, report: EstimateReport) -> str:
    """Full report of one map: sizes with intervals, sources of uncertainty, omissions; `report` is the estimate's."""
    if estimate.status == "no_estimate":
        lines = [*finding_lines(report.findings), *_no_estimate_lines(report)]
        lines += [*estimate_document.mass_lines(report.masses), *passed_over_lines(estimate)]
        return "\n".join([*lines, RESEARCH_USE]) + "\n"
    lines = [*finding_lines(report.findings, "caution"), *size_table(report), "", *_no_size_lines(report)]
    if report.position is not None:
        lines.append(estimate_document.place_line(report.position))
    lines += _detail_lines(estimate, report)
    if estimate.scene is not None:
        lines += estimate_document.scene_lines(estimate.scene)
        if beside := ", ".join(str(mass.number) for mass in estimate_document.other_masses(report.masses)):
            lines.append(f"These odds are of this window alone; other masses of the map ({beside}) are above.")
    if estimate.sensitivity is not None:
        lines.append(estimate_document.sensitivity_line(estimate.sensitivity))
    lines += [*finding_lines(report.findings, "check"), *passed_over_lines(estimate)]
    lines += [f"Left out: {'; '.join(report.left_out)}."] if report.left_out else []
    lines.append(estimate_document.prior_line(from_plain(BumpPrior, report.prior), field=estimate.scene is not None))
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def no_estimate_line(reason: str) -> str:
    """First line of a report without an estimate."""
    whole_sentence = reason.startswith(("no lump found", "the data cannot show"))
    return f"{capitalised(reason)}." if whole_sentence else f"No estimate: {reason}."


def _no_estimate_lines(report: EstimateReport) -> list[str]:
    """Why there is no estimate, what a map without a lump would have shown, and what would help.

    Where a finding is the reason, its own line above has it and its remedy.
    """
    smallest = [] if report.smallest_lump is None else [f"{smallest_text(report.smallest_lump)}."]
    for finding in report.findings:
        if report.reason.endswith(f": {finding.text}"):
            return [no_estimate_line(report.reason.removesuffix(f": {finding.text}")), *smallest]
    return [no_estimate_line(report.reason), *smallest, *_advice_lines(report)]


def _no_size_lines(report: EstimateReport) -> list[str]:
    """Why there is no size, and what would help; empty where there is one."""
    return [f"No size: {report.reason}.", *_advice_lines(report)] if report.reason else []


def _advice_lines(report: EstimateReport) -> list[str]:
    return [f"What would help: {report.advice}."] if report.advice else []


def _quantities(report: EstimateReport | PooledReport) -> dict[str, Quantity]:
    """Quantities of `ROWS` that the report has, by name."""
    quantities: dict[str, Any] = {}
    for path, _, _ in ROWS:
        holder, _, name = path.rpartition(".")
        held = getattr(report, holder, None) if holder else report
        quantities[path] = getattr(held, name, None)
    return {name: quantity for name, quantity in quantities.items() if quantity is not None}


def size_decimals(sizes: Iterable[Quantity]) -> int:
    """Decimal places for all sizes of a report, from the least certain one."""
    return min((decimals(size.mc_error, most=SIZE_DECIMALS) for size in sizes), default=SIZE_DECIMALS)


def size_table(report: EstimateReport | PooledReport, shown: Collection[str] = _NAMES) -> list[str]:
    """Table with a row per quantity; all sizes have the digits that the least certain one supports.

    Where sizes have two intervals that for exams of patients leads, and the narrower one of the largest size follows,
    with the spread of the exams that it is for.
    """
    quantities = {name: quantity for name, quantity in _quantities(report).items() if name in shown}
    probability = next(iter(quantities.values())).probability
    rows = [f"{'':28}{'median':>9}   {100 * probability:g} % interval (equal-tailed)"]
    of_sizes = size_decimals([quantities[name] for name in SIZES if name in quantities])
    for name, label, unit in ROWS:
        if name not in quantities or (name == "min_size_mm" and ANOTHER_SMALLEST in quantities):
            continue
        if name == "max_size_mm" and ANOTHER_LARGEST in quantities:
            label = exams_label(report.figures.get("between_map_sd"))
        q = quantities[name]
        places = of_sizes if name in (*SIZES, ANOTHER_LARGEST, ANOTHER_SMALLEST) else decimals(q.mc_error)
        interval = f"{q.low:.{places}f} to {q.high:.{places}f} {unit}".rstrip()
        rows.append(f"{label:28}{q.median:>9.{places}f}   {interval}")
    return rows


def _detail_lines(estimate: Estimate, report: EstimateReport) -> list[str]:
    lines, figures, largest, draws = [], report.diagnostics, report.max_size_mm, estimate.draws
    assert draws is not None  # as with every estimate
    if report.detected_probability is not None:
        which = f"{number}. " if (number := estimate_document.reported_number_words(report.masses)) else ""
        prior = f"where {100 * SHARE_WITH_LUMP:g} % of exams hold one"
        lines.append(f"{which}Probability of a lump: {chance_text(report.detected_probability)}, {prior}.")
    lines += estimate_document.mass_lines(report.masses)
    if largest is not None:
        if report.another_exam is not None:
            lines.append(two_intervals_text(figures.get("between_map_sd"), report.another_exam.between_map_sd))
        lines += width_lines(report.leading.variance_share)
        if "repeatability" in figures:
            lines.append(site_interval_text(figures["repeatability"]))
        lines += estimate_document.supposed_lines(report.supposing, largest.median, places=size_decimals([largest]))
        if "oval_probability" in figures:
            lines.append(shape_text(figures))
        texts = (figures.get("size_calibration"), report.known_words.capitalize(), *invalid_draws(report))
        lines += [f"{text}." for text in texts if text]
    if share := tracker_share(figures):
        lines.append(f"{share}.")
    lines += [f"Passed over: {text}." for text in figures.get("passed_over", ())]
    lines.append(method_line(draws, _quantities(report)))
    for name, label in (("max_size_mm", "largest size"), ("min_size_mm", "smallest size")):
        if one := figures.get("convergence", {}).get(name):
            ess = min(one["ess_bulk"], one["ess_tail"])
            lines.append(
                f"Chains of the {label}: R-hat {one['rhat']:.3f}, {ess:.0f} effective draws, "
                f"Monte-Carlo error of the median {one['mcse_median']:.2g} mm."
            )
    return lines


def invalid_draws(report: EstimateReport) -> list[str]:
    """A phrase that counts the draws without a size; empty where all have one."""
    number = report.diagnostics.get("invalid_draws")
    return [f"{number} draws gave no size and were left out"] if number else []


def tracker_share(diagnostics: Mapping[str, Any]) -> str:
    """Share of the width variance from tracker position error, in words; empty where negligible."""
    share = diagnostics.get("places_share") or 0.0
    return f"{100 * share:.0f} % of the width variance is tracker position error" if share >= LEAST_SHARE else ""


def method_line(draws: ParameterDraws, quantities: Mapping[str, Quantity]) -> str:
    """Method, Monte-Carlo error of the printed interval ends, and the method's diagnostics."""
    parts = []
    for kind, names in (("sizes", EXTREMES), ("widths", WIDTHS)):
        if names[0] in quantities:
            worst = max((quantities[name] for name in names), key=lambda one: one.mc_error)
            parts.append(ends_text(kind, worst.mc_error, worst.sd))
    ends = "Monte-Carlo error of the interval ends: " + ", ".join(parts)
    measure = convergence_text(draws) or f"{len(draws.flat)} independent draws"
    if draws.method == "ensemble":
        measure += f", {min(draws.diagnostics['ess_bulk'], draws.diagnostics['ess_tail']):.0f} effective draws"
    return f"Method {draws.method}: {ends}; {measure}."


def convergence_text(draws: ParameterDraws) -> str:
    """The method's convergence measure; empty for independent draws."""
    if draws.method == "ensemble":
        return f"R-hat {draws.diagnostics['rhat']:.3f}"
    return f"Pareto shape {draws.diagnostics['pareto_k']:.2f}" if draws.method == "importance" else ""


def passed_over_lines(estimate: Estimate) -> list[str]:
    """Places passed over, with reasons; long lists are shortened."""
    faulty = [candidate for candidate in estimate.candidates if candidate.fault]
    lines = [f"Passed over near ({c.centre_mm[0]:.0f}, {c.centre_mm[1]:.0f}) mm: {c.fault}." for c in faulty]
    more = len(lines) - MOST_PASSED_OVER
    return [*lines[:MOST_PASSED_OVER], f"Passed over {counted(more, 'lower bump')}."] if more > 0 else lines


# --- An estimate in at most 12 lines: the size, what makes its interval wide, what would narrow it, its quality.

WIDTHS = ("sigma_x_mm", "sigma_y_mm")
MOST_MASSES = 3  #: Masses besides the reported one that have a line.


def estimate_summary(estimate: Estimate, report: EstimateReport) -> str:
    """Report of one map in at most `MOST_LINES` lines; `estimate_text` gives the rest."""
    body = finding_summary(report.findings, "caution")
    checks = finding_summary(report.findings, "check", most=2)
    if estimate.status == "no_estimate":
        body += [*_no_estimate_lines(report), *_mass_lines(report.masses, room=MOST_MASSES), *checks]
    else:
        body = _estimate_lines(estimate, report, body, checks)
    if estimate.scene is not None:
        model = [estimate_document.scene_line(estimate.scene)]
    else:
        model = [f"Left out: {first_of(report.left_out, 2, '; ')}."] if report.left_out else []
    return "\n".join([*body, " ".join([*model, MORE]), RESEARCH_USE]) + "\n"


def _estimate_lines(estimate: Estimate, report: EstimateReport, cautions: list[str], checks: list[str]) -> list[str]:
    """Lines of a short report between its cautions and its last lines; sources of width give way to masses."""
    quantities, largest = _quantities(report), report.max_size_mm
    shown = EXTREMES if largest is not None else WIDTHS
    lines = [*cautions, *size_table(report, (*shown, ANOTHER_LARGEST, ANOTHER_SMALLEST)), _lump_line(report)]
    after = _no_size_lines(report)
    last = _quality_line(estimate, report, [quantities[name] for name in shown]) + checks
    room = MOST_LINES - 2 - len(lines) - len(after) - len(last)
    beside = _mass_lines(report.masses, room=min(MOST_MASSES, room))
    widths = width_lines(report.leading.variance_share)
    lines = [*lines, *beside, *after, *widths[: max(room - len(beside), 0)], *last]
    if largest is None or len(lines) >= MOST_LINES - 2:
        return lines
    return [*lines, *estimate_document.supposed_line(report.supposing, largest.median, places=size_decimals([largest]))]


def _lump_line(report: EstimateReport) -> str:
    """Probability of a lump, and its place; of several masses, which one it is."""
    chance, number = report.detected_probability, estimate_document.reported_number_words(report.masses)
    parts = [] if chance is None else [f"Probability of a lump {chance_text(chance)}"]
    if report.amplitude is not None:
        parts.append(f"amplitude {report.amplitude.median:.2g}")
    if report.position is not None:
        parts.append(report.position.text)
    elif report.centre_patient_mm is not None:
        parts.append(estimate_document.from_xiphoid(*report.centre_patient_mm.median))
    if report.centre_mm is not None:
        parts.append(f"{estimate_document.at_place(*report.centre_mm.median)} on the map")
    text = ", ".join(parts)
    return f"{number}: {text[0].lower()}{text[1:]}." if number else f"{text}."


def _mass_lines(masses: Sequence[MassReport], *, room: int) -> list[str]:
    """At most `room` lines on the masses besides the reported one, at least one; the last counts those left out."""
    lines = estimate_document.mass_lines(masses)
    shown = lines[: max(room, 1)]
    if left := len(lines) - len(shown):
        shown[-1] = f"{shown[-1].rstrip('.')}; and {counted(left, 'more mass')}."
    return shown


def _quality_line(estimate: Estimate, report: EstimateReport, shown: Sequence[Quantity]) -> list[str]:
    """Monte-Carlo error of the interval ends, convergence measure, tracker's share, draws without a size."""
    draws = estimate.draws
    assert draws is not None  # as with every estimate
    worst = max(shown, key=lambda one: one.mc_error / one.sd if one.sd > 0 else 0.0)
    ends = f"interval ends to {worst.mc_error / worst.sd:.3f} SD" if worst.sd > 0 else "interval ends exact"
    parts = [
        f"sizes by the {estimate.sized_by}" if estimate.sized_by else "",
        report.known_words if estimate.sized_by else "",
        f"method {draws.method}, {ends}",
        report.diagnostics.get("repeatability", ""),
        convergence_text(draws),
        tracker_share(report.diagnostics),
        *invalid_draws(report),
    ]
    return [f"Quality: {'; '.join(filter(None, parts))}."]
