"""An estimate in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from tactile_bayes.files.reports import MassReport, SmallestLump
from tactile_bayes.findings import capital, finding_lines, finding_summary
from tactile_bayes.inference.draws import ParameterDraws, Quantity
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import ClockPosition
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.lump_probability import SHARE_WITH_LUMP
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_document import (
    mass_lines,
    mass_reports,
    numbered,
    others,
    prior_line,
    scene_line,
    scene_lines,
    sensitivity_line,
    smallest_lump,
    supposed_line,
    supposed_lines,
    suppositions,
)
from tactile_bayes.report.quantities import (
    ANOTHER_EXAM,
    estimate_quantities,
    from_xiphoid,
    leading_size,
    place_line,
    xiphoid_mm,
)
from tactile_bayes.size.draws import EXTREMES, SIZES

# --- The smallest lump that a map without one would have shown, in a sentence.


def smallest_text(smallest: SmallestLump) -> str:
    """What would have shown, by depth, where the map is best and where it is worst; without a full stop."""
    ends = zip(smallest.depths_mm, smallest.best_mm, smallest.worst_mm, strict=True)
    told = []
    for depth, best, worst in ends:
        if best is None:
            across = "more than 30 mm"
        elif worst is None:
            across = f"{best:.3g} to more than 30 mm"
        else:
            across = f"{best:.3g} mm" if best == worst else f"{best:.3g} to {worst:.3g} mm"
        told.append(f"{across} at a depth of {depth:g} mm")
    of_100 = f"{100 * smallest.probability:g} times of 100"
    return (
        f"In this map a round lump would have been seen ({of_100}) from these diameters on, by where it lies: "
        f"{'; '.join(told)} (of its middle)"
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


def exams_label(spread: float | None) -> str:
    """What an interval supposes: how far exams of one mass are apart, as a share of its size; None for not at all."""
    return f"if exams differ by {100 * spread:.0f} %" if spread is not None else "if exams do not differ"


def two_intervals_text(this: float | None, another: float) -> str:
    """What the intervals of a size suppose, the leading one first; `this` is None for no spread between exams."""
    alike = "no spread" if this is None else f"{100 * this:.0f} %"
    return (
        f"The intervals of the sizes suppose that exams of one mass differ by {100 * another:.0f} %, as those of "
        f"patients did in the paper; the narrower one supposes {alike}, as those of simulated bodies do: what exams "
        "that repeat so well can buy. `calibrate repeatability` learns a site's own spread; then there is one interval."
    )


def site_interval_text(repeatability: str) -> str:
    """What the interval of a size supposes where the site's repeatability is known, from `Repeatability.words`."""
    return f"The interval is for any exam of the mass: {repeatability}."


def decimals(mc_error: float, *, most: int = 3) -> int:
    """Decimal places that the Monte-Carlo error of an interval's end supports."""
    if not mc_error > 0:
        return most
    return min(most, max(0, -math.floor(math.log10(2.0 * mc_error))))


def table_head(probability: float) -> str:
    """The first line of a table of medians and intervals."""
    return f"{'':28}{'median':>9}   {100 * probability:g} % interval (equal-tailed)"


def table_row(label: str, median: float, ends: tuple[float, float], *, unit: str, places: int) -> str:
    """Row of that table: label, median and interval with a number of decimal places."""
    interval = f"{ends[0]:.{places}f} to {ends[1]:.{places}f} {unit}".rstrip()
    return f"{label:28}{median:>9.{places}f}   {interval}"


def ends_text(name: str, mc_error: float, sd: float) -> str:
    """Monte-Carlo error of the ends of intervals, in SDs and mm."""
    return f"{name} {mc_error / sd:.3f} SD ({mc_error:.2g} mm)" if sd > 0 else f"{name} {mc_error:.2g} mm"


def shape_text(figures: Mapping[str, float]) -> str:
    """Whether the lump is sized as round or oval, and the difference that makes to the largest size."""
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


def width_lines(variance_share: Mapping[str, float], *, paper: bool = False) -> list[str]:
    """Sources of a size's variance, largest first, and ways to narrow the interval.

    `variance_share`: percent of the variance of the largest size, by source.
    """
    sources, narrowed = (ON_PAPER, NARROWED_BY | NARROWED_ON_PAPER) if paper else (SOURCES, NARROWED_BY)
    ranked = sorted(variance_share.items(), key=lambda pair: -pair[1])
    parts = [f"{share:.0f} % {sources.get(name, name)}" for name, share in ranked if share >= 0.5]
    ways = [narrowed[name] for name, share in ranked if share >= WORTH_NARROWING and name in narrowed]
    lines = [f"What makes the interval wide: {', '.join(parts)}."] if parts else []
    return [*lines, f"What would narrow it: {'; '.join(ways)}."] if ways else lines


def joined(texts: Sequence[str], *, most: int, lead: str) -> list[str]:
    """Join the first texts in one line after `lead`, and count the others; empty for no text."""
    if not texts:
        return []
    more = f" (and {len(texts) - most} more)" if len(texts) > most else ""
    return [f"{lead}{'; '.join(texts[:most])}{more}."]


# --- An estimate as a short table a clinician can read.

ANOTHER_LARGEST = f"{ANOTHER_EXAM}.max_size_mm"
ANOTHER_SMALLEST = f"{ANOTHER_EXAM}.min_size_mm"
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
    ("angle_deg", "angle of the ellipse", "deg"),
    ("centre_mm.x", "centre on the map, x", "mm"),
    ("centre_mm.y", "centre on the map, y", "mm"),
    ("centre_patient_mm.x", "patient's right of xiphoid, x", "mm"),
    ("centre_patient_mm.y", "centre above the xiphoid, y", "mm"),
)
MOST_PASSED_OVER = 4
LEAST_SHARE = 0.005  #: Of the width variance, below which the tracker's share is not worth a line.


def size_decimals(sizes: Iterable[Quantity]) -> int:
    """Decimal places for all sizes of a report, from the least certain one."""
    return min((decimals(one.mc_error, most=SIZE_DECIMALS) for one in sizes), default=SIZE_DECIMALS)


def estimate_text(
    estimate: Estimate,
    tactile_map: TactileMap,
    *,
    probability: float,
    prior: BumpPrior | None = None,
    quantities: Mapping[str, Quantity] | None = None,
    masses: Sequence[MassReport] | None = None,
    place: ClockPosition | None = None,
) -> str:
    """Full report of one map: sizes with intervals, sources of uncertainty, omissions.

    `quantities`, `masses` (see `mass_reports`) and the lump's `place` about the nipple where they are at hand.
    """
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)
    if masses is None:
        masses = mass_reports(
            estimate.masses, tactile_map, probability=probability, quantities=quantities, reason=estimate.reason
        )
    if estimate.status == "no_estimate":
        first = [*finding_lines(estimate.findings), no_estimate_line(estimate.reason), *smallest_lines(estimate)]
        first += advice_lines(estimate)
        return "\n".join([*first, *mass_lines(masses), *passed_over(estimate), RESEARCH_USE]) + "\n"
    table = size_table(quantities, probability, alike=alike_spread(estimate))
    lines = [*finding_lines(estimate.findings, "caution"), *table, ""]
    if estimate.reason:
        lines += [f"No size: {estimate.reason}.", *advice_lines(estimate)]
    lines += [] if place is None else [place_line(place, probability)]
    lines += [
        *_findings(estimate, quantities, masses),
        *([] if estimate.scene is None else scene_lines(estimate.scene)),
    ]
    beside = " and ".join(str(one.number) for one in others(masses))
    if estimate.scene is not None and beside:
        lines.append(f"These odds are of this window alone: mass {beside} of the map is above.")
    if estimate.sensitivity is not None and (by_prior := sensitivity_line(estimate.sensitivity)):
        lines.append(by_prior)
    lines += [*finding_lines(estimate.findings, "check"), *passed_over(estimate)]
    lines += [f"Left out: {'; '.join(estimate.left_out)}."] if estimate.left_out else []
    lines += [] if prior is None else [prior_line(prior, field=estimate.scene is not None)]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def no_estimate_line(reason: str) -> str:
    """First line of a report without an estimate."""
    told = reason.startswith(("no lump found", "the data cannot show"))
    return f"{capital(reason)}." if told else f"No estimate: {reason}."


def smallest_lines(estimate: Estimate) -> list[str]:
    """What a map without a lump would have shown, as one line; empty where nobody has asked."""
    return [] if estimate.smallest is None else [f"{smallest_text(smallest_lump(estimate.smallest))}."]


def advice_lines(estimate: Estimate) -> list[str]:
    """Advice towards an estimate or a size, as one line; empty without advice."""
    return [f"What would help: {estimate.advice}."] if estimate.advice else []


def size_table(quantities: Mapping[str, Quantity], probability: float, *, alike: float | None = None) -> list[str]:
    """Table with a row per quantity; all sizes have the digits that the least certain one supports.

    Where sizes have two intervals that for exams of patients leads, and the narrower one of the largest size follows,
    for exams whose spread `alike` is, a share of the size.
    """
    rows = [table_head(probability)]
    of_sizes = size_decimals([quantities[name] for name in SIZES if name in quantities])
    for name, label, unit in ROWS:
        if name == "max_size_mm" and ANOTHER_LARGEST in quantities:
            label = exams_label(alike)
        if name in quantities and not (name == "min_size_mm" and ANOTHER_SMALLEST in quantities):
            q = quantities[name]
            sizes = (*SIZES, ANOTHER_LARGEST, ANOTHER_SMALLEST)
            places = of_sizes if name in sizes else decimals(q.mc_error)
            rows.append(table_row(label, q.median, (q.low, q.high), unit=unit, places=places))
    return rows


def alike_spread(estimate: Estimate) -> float | None:
    """The spread between exams of the narrower interval, a share of the size; None where it has none."""
    return None if estimate.size is None else estimate.size.figures.get("between_map_sd")


def _findings(estimate: Estimate, quantities: Mapping[str, Quantity], masses: Sequence[MassReport]) -> list[str]:
    lines, found = [], estimate.diagnostics
    if estimate.probability is not None:
        which = f"{number}. " if (number := numbered(masses)) else ""
        prior = f"where {100 * SHARE_WITH_LUMP:g} % of exams hold one"
        lines.append(f"{which}Probability of a lump: {chance_text(estimate.probability)}, {prior}.")
    lines += mass_lines(masses)
    if estimate.size is not None:
        another = estimate.size.another_exam
        if another is not None:
            lines.append(two_intervals_text(alike_spread(estimate), another.figures["between_map_sd"]))
        lines += width_lines(leading_size(estimate.size).variance_share)
        if found is not None and found.repeatability:
            lines.append(site_interval_text(found.repeatability))
        largest = quantities["max_size_mm"]
        supposed, places = suppositions(estimate.size, largest), size_decimals([largest])
        lines += supposed_lines(supposed, largest.median, places=places)
        if "oval_probability" in estimate.size.figures:
            lines.append(shape_text(estimate.size.figures))
        if found is not None and found.size_calibration:
            lines.append(f"{found.size_calibration}.")
        if estimate.size.invalid:
            lines.append(f"{estimate.size.invalid} draws gave no size and were left out.")
    if share := tracker_share(estimate):
        lines.append(f"{share}.")
    lines += [f"Passed over: {text}." for text in (() if found is None else found.noise.passed_over)]
    if estimate.draws is None:
        return lines
    lines.append(method_line(estimate.draws, quantities))
    for name, label in (("max_size_mm", "largest size"), ("min_size_mm", "smallest size")):
        if one := {} if found is None else found.convergence.get(name, {}):
            ess = min(one["ess_bulk"], one["ess_tail"])
            lines.append(
                f"Chains of the {label}: R-hat {one['rhat']:.3f}, {ess:.0f} effective draws, "
                f"Monte-Carlo error of the median {one['mcse_median']:.2g} mm."
            )
    return lines


def tracker_share(estimate: Estimate) -> str:
    """Share of the width variance from tracker position error, in words; empty where negligible."""
    share = None if estimate.diagnostics is None else estimate.diagnostics.noise.places_share
    if share is None or share < LEAST_SHARE:
        return ""
    return f"{100 * share:.0f} % of the width variance is tracker position error"


def method_line(draws: ParameterDraws, quantities: Mapping[str, Quantity]) -> str:
    """Method, Monte-Carlo error of the printed interval ends, and the method's diagnostics."""
    parts = []
    for what, names in (("sizes", EXTREMES), ("widths", WIDTHS)):
        if names[0] in quantities:
            worst = max((quantities[name] for name in names), key=lambda one: one.mc_error)
            parts.append(ends_text(what, worst.mc_error, worst.sd))
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


def passed_over(estimate: Estimate) -> list[str]:
    """Places passed over, with reasons; long lists are shortened."""
    faulty = [candidate for candidate in estimate.candidates if candidate.fault]
    lines = [f"Passed over near ({c.centre_mm[0]:.0f}, {c.centre_mm[1]:.0f}) mm: {c.fault}." for c in faulty]
    more = len(lines) - MOST_PASSED_OVER
    return [*lines[:MOST_PASSED_OVER], f"Passed over {more} lower bumps."] if more > 0 else lines


# --- An estimate in at most 12 lines: the size, what makes its interval wide, what would narrow it, its quality.

WIDTHS = ("sigma_x_mm", "sigma_y_mm")
MOST_CAUTIONS = 3
MOST_CHECKS = 2
MOST_MASSES = 3  #: Masses besides the reported one that have a line.


def estimate_summary(
    estimate: Estimate,
    quantities: Mapping[str, Quantity],
    *,
    probability: float,
    masses: Sequence[MassReport] = (),
    place: ClockPosition | None = None,
) -> str:
    """Report of one map in at most `MOST_LINES` lines; `estimate_text` gives the rest.

    `quantities`: as `estimate_quantities` gives them; empty without an estimate; `probability`: of the intervals;
    `masses`: as `mass_reports` gives them; `place`: of the lump about the nipple, where it is known.
    """
    if estimate.status == "no_estimate":
        body = finding_summary(estimate.findings, "caution", most=MOST_CAUTIONS)
        body += [no_estimate_line(estimate.reason), *smallest_lines(estimate), *advice_lines(estimate)]
        body += [*_masses(masses, room=MOST_MASSES), *finding_summary(estimate.findings, "check", most=MOST_CHECKS)]
    else:
        body = _something(estimate, quantities, probability, masses, place)
    if estimate.scene is not None:
        model = [scene_line(estimate.scene)]
    else:
        model = joined(estimate.left_out, most=2, lead="Left out: ")
    return "\n".join([*body, " ".join([*model, MORE]), RESEARCH_USE]) + "\n"


def _something(
    estimate: Estimate,
    quantities: Mapping[str, Quantity],
    probability: float,
    masses: Sequence[MassReport],
    place: ClockPosition | None,
) -> list[str]:
    """The body of a report with an estimate; what makes the interval wide gives way to masses."""
    lines = finding_summary(estimate.findings, "caution", most=MOST_CAUTIONS)
    shown = [name for name in EXTREMES if name in quantities] or [name for name in WIDTHS if name in quantities]
    table = shown if ANOTHER_LARGEST not in quantities else [*shown, ANOTHER_LARGEST, ANOTHER_SMALLEST]
    lines += size_table({name: quantities[name] for name in table}, probability, alike=alike_spread(estimate))
    lines += _lump(estimate, quantities, numbered(masses), place)
    after = [f"No size: {estimate.reason}.", *advice_lines(estimate)] if estimate.reason else []
    last = [*_quality(estimate, {name: quantities[name] for name in shown})]
    last += finding_summary(estimate.findings, "check", most=MOST_CHECKS)
    room = MOST_LINES - 2 - len(lines) - len(after) - len(last)
    beside = _masses(masses, room=min(MOST_MASSES, room))
    widths = [] if estimate.size is None else width_lines(leading_size(estimate.size).variance_share)
    lines = [*lines, *beside, *after, *widths[: max(room - len(beside), 0)], *last]
    largest = quantities.get("max_size_mm")
    if largest is None or len(lines) >= MOST_LINES - 2:
        return lines
    supposed = suppositions(estimate.size, largest)
    return [*lines, *supposed_line(supposed, largest.median, places=size_decimals([largest]))]


def _lump(
    estimate: Estimate, quantities: Mapping[str, Quantity], number: str, place: ClockPosition | None
) -> list[str]:
    """Probability of a lump, and its place; `number` says which of several masses it is."""
    parts = [] if estimate.probability is None else [f"Probability of a lump {chance_text(estimate.probability)}"]
    if "amplitude" in quantities:
        parts.append(f"amplitude {quantities['amplitude'].median:.2g}")
    if place is not None:
        parts.append(place.text())
    elif (centre := xiphoid_mm(quantities)) is not None:
        parts.append(from_xiphoid(*centre))
    if "centre_mm.x" in quantities:
        parts.append("at ({:.1f}, {:.1f}) mm on the map".format(*(quantities[f"centre_mm.{a}"].median for a in "xy")))
    text = ", ".join(parts)
    return [f"{number}: {text[0].lower()}{text[1:]}." if number else f"{text}."] if parts else []


def _masses(masses: Sequence[MassReport], *, room: int) -> list[str]:
    """At most `room` lines on the masses besides the reported one, at least one; the last counts those left out."""
    lines = mass_lines(masses)
    shown = lines[: max(room, 1)]
    if left := len(lines) - len(shown):
        shown[-1] = f"{shown[-1].rstrip('.')}; and {left} more {'mass' if left == 1 else 'masses'}."
    return shown


def _quality(estimate: Estimate, shown: Mapping[str, Quantity]) -> list[str]:
    """Monte-Carlo error of the interval ends, convergence measure, tracker's share, draws without a size."""
    if estimate.draws is None or not shown:
        return []
    worst = max(shown.values(), key=lambda one: one.mc_error / one.sd if one.sd > 0 else 0.0)
    ends = f"interval ends to {worst.mc_error / worst.sd:.3f} SD" if worst.sd > 0 else "interval ends exact"
    parts = [f"method {estimate.draws.method}, {ends}"]
    if estimate.diagnostics is not None and estimate.diagnostics.calibration:
        parts.insert(0, f"sizes by the {estimate.diagnostics.calibration}")
    if estimate.diagnostics is not None and estimate.diagnostics.repeatability:
        parts.append(estimate.diagnostics.repeatability)
    if measure := convergence_text(estimate.draws):
        parts.append(measure)
    if share := tracker_share(estimate):
        parts.append(share)
    if estimate.size is not None and estimate.size.invalid:
        parts.append(f"{estimate.size.invalid} draws gave no size and were left out")
    return [f"Quality: {'; '.join(parts)}."]
