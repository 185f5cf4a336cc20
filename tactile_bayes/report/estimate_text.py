"""An estimate as a short table a clinician can read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from tactile_bayes.findings import finding_lines
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.summary import Quantity
from tactile_bayes.mapping.clock_face import ClockPosition
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.lump.diagnostics import Diagnostics
from tactile_bayes.posterior.lump_probability import SHARE_WITH_LUMP
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.lump_place import place_line
from tactile_bayes.report.masses_document import MassDocument, mass_lines, masses_document, numbered, others
from tactile_bayes.report.narrowing import width_lines
from tactile_bayes.report.quantities import ANOTHER_EXAM, estimate_quantities, leading_size
from tactile_bayes.report.scene_text import prior_line, scene_lines, sensitivity_line
from tactile_bayes.report.size_text import (
    SIZE_DECIMALS,
    decimals,
    ends_text,
    exams_label,
    shape_text,
    site_interval_text,
    table_head,
    table_row,
    two_intervals_text,
)
from tactile_bayes.report.smallest_text import smallest_text
from tactile_bayes.report.supposed_text import supposed_document, supposed_lines
from tactile_bayes.size.draws import EXTREMES, SIZES

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
LEAST_SHARE = 0.005
"""Of the width variance, below which the tracker's share is not worth a line."""


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
    masses: Sequence[MassDocument] | None = None,
    place: ClockPosition | None = None,
) -> str:
    """Full report of one map: sizes with intervals, sources of uncertainty, omissions.

    `quantities`, `masses` (see `masses_document`) and the lump's `place` about the nipple where they are at hand.
    """
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)
    if masses is None:
        masses = masses_document(
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
        *_scene(estimate, masses),
        *finding_lines(estimate.findings, "check"),
        *passed_over(estimate),
        *_left_out(estimate),
    ]
    lines += [] if prior is None else [prior_line(prior, field=estimate.scene is not None)]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def no_estimate_line(reason: str) -> str:
    """First line of a report without an estimate."""
    return f"{reason[0].upper()}{reason[1:]}." if reason.startswith("no lump found") else f"No estimate: {reason}."


def smallest_lines(estimate: Estimate) -> list[str]:
    """What a map without a lump would have shown, as one line; empty where nobody has asked."""
    return [] if estimate.smallest is None else [f"{smallest_text(estimate.smallest.as_dict())}."]


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


def _findings(estimate: Estimate, quantities: Mapping[str, Quantity], masses: Sequence[MassDocument]) -> list[str]:
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
        supposed, places = supposed_document(estimate.size, largest), size_decimals([largest])
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
    return [*lines, method_line(estimate.draws, quantities), *_chains_of_sizes(found)]


def tracker_share(estimate: Estimate) -> str:
    """Share of the width variance from tracker position error, in words; empty where negligible."""
    share = None if estimate.diagnostics is None else estimate.diagnostics.noise.places_share
    if share is None or share < LEAST_SHARE:
        return ""
    return f"{100 * share:.0f} % of the width variance is tracker position error"


def _chains_of_sizes(found: Diagnostics | None) -> list[str]:
    """Of chains: R-hat, effective draws and Monte-Carlo error of each size's median."""
    lines = []
    for name, label in (("max_size_mm", "largest size"), ("min_size_mm", "smallest size")):
        one = {} if found is None else found.convergence.get(name, {})
        if one:
            ess = min(one["ess_bulk"], one["ess_tail"])
            lines.append(
                f"Chains of the {label}: R-hat {one['rhat']:.3f}, {ess:.0f} effective draws, "
                f"Monte-Carlo error of the median {one['mcse_median']:.2g} mm."
            )
    return lines


def method_line(draws: ParameterDraws, quantities: Mapping[str, Quantity]) -> str:
    """Method, Monte-Carlo error of the printed interval ends, and the method's diagnostics."""
    parts = [_ends("sizes", EXTREMES, quantities)] if "max_size_mm" in quantities else []
    parts.append(_ends("widths", ("sigma_x_mm", "sigma_y_mm"), quantities))
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


def _ends(what: str, names: tuple[str, ...], quantities: Mapping[str, Quantity]) -> str:
    worst = max((quantities[name] for name in names), key=lambda one: one.mc_error)
    return ends_text(what, worst.mc_error, worst.sd)


def _scene(estimate: Estimate, masses: Sequence[MassDocument]) -> list[str]:
    """Lines on the structures in the window, and on the influence of the prior."""
    lines = [] if estimate.scene is None else [*scene_lines(estimate.scene), *_elsewhere(masses)]
    prior = "" if estimate.sensitivity is None else sensitivity_line(estimate.sensitivity)
    return [*lines, prior] if prior else lines


def _elsewhere(masses: Sequence[MassDocument]) -> list[str]:
    """A line on what the odds of a second lump do not speak of; empty where there is one mass."""
    numbers = " and ".join(str(one["number"]) for one in others(masses))
    return [f"These odds are of this window alone: mass {numbers} of the map is above."] if numbers else []


def passed_over(estimate: Estimate) -> list[str]:
    """Places passed over, with reasons; long lists are shortened."""
    faulty = [candidate for candidate in estimate.candidates if candidate.fault]
    lines = [f"Passed over near ({c.centre_mm[0]:.0f}, {c.centre_mm[1]:.0f}) mm: {c.fault}." for c in faulty]
    more = len(lines) - MOST_PASSED_OVER
    return [*lines[:MOST_PASSED_OVER], f"Passed over {more} lower bumps."] if more > 0 else lines


def _left_out(estimate: Estimate) -> list[str]:
    return [f"Left out: {'; '.join(estimate.left_out)}."] if estimate.left_out else []
