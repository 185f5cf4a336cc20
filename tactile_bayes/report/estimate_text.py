"""An estimate as a short table a clinician can read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.summary import Quantity
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_document import SIZES, estimate_quantities
from tactile_bayes.report.narrowing import width_lines
from tactile_bayes.report.rise_text import rise_lines
from tactile_bayes.report.scene_text import prior_line, scene_lines, sensitivity_line
from tactile_bayes.report.size_text import SIZE_DECIMALS, decimals, ends_text, range_cautions, shape_text

ROWS = (
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
    ("centre_patient_mm.x", "centre right of the xiphoid, x", "mm"),
    ("centre_patient_mm.y", "centre above the xiphoid, y", "mm"),
)
NEAR_LEVEL = 0.02
"""An offset of the background of this size and more is mentioned."""
MOST_PASSED_OVER = 4
LEAST_SHARE = 0.005
"""Of the width variance, below which the tracker's share is not worth a line."""


def size_decimals(sizes: Iterable[Quantity]) -> int:
    """Decimal places of all sizes of a report, as the least certain one supports."""
    return min((decimals(one.mc_error, most=SIZE_DECIMALS) for one in sizes), default=SIZE_DECIMALS)


def estimate_text(
    estimate: Estimate,
    tactile_map: TactileMap,
    *,
    probability: float,
    prior: BumpPrior | None = None,
    quantities: Mapping[str, Quantity] | None = None,
) -> str:
    """The report of one map: what was found with its interval, where the uncertainty comes from, what was left out.

    `quantities` where they are at hand.
    """
    if estimate.status == "no_estimate":
        first = [no_estimate_line(estimate.reason), *_advice(estimate)]
        return "\n".join([*first, *rise_lines(estimate.other_rises), *passed_over(estimate), RESEARCH_USE]) + "\n"
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)
    lines = [*_cautions(estimate), *size_table(quantities, probability), ""]
    if estimate.reason:
        lines += [f"No size: {estimate.reason}.", *_advice(estimate)]
    lines += [
        *_findings(estimate, quantities),
        *_scene(estimate),
        *warnings(estimate),
        *passed_over(estimate),
        *_left_out(estimate),
    ]
    lines += [] if prior is None else [prior_line(prior, field=estimate.scene is not None)]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def no_estimate_line(reason: str) -> str:
    """What a report without an estimate begins with; that there is no lump is said first."""
    return f"{reason[0].upper()}{reason[1:]}." if reason.startswith("no lump found") else f"No estimate: {reason}."


def _advice(estimate: Estimate) -> list[str]:
    return [f"What would help: {estimate.advice}."] if estimate.advice else []


def size_table(quantities: Mapping[str, Quantity], probability: float) -> list[str]:
    """A head and a row for each quantity; all sizes with the digits that the least certain one supports."""
    head = f"{'':28}{'median':>9}   {100 * probability:g} % interval (equal-tailed)"
    rows = [head]
    of_sizes = size_decimals([quantities[name] for name in SIZES if name in quantities])
    for name, label, unit in ROWS:
        if name in quantities:
            q = quantities[name]
            places = of_sizes if name in SIZES else decimals(q.mc_error)
            interval = f"{q.low:.{places}f} to {q.high:.{places}f} {unit}".rstrip()
            rows.append(f"{label:28}{q.median:>9.{places}f}   {interval}")
    return rows


def _findings(estimate: Estimate, quantities: Mapping[str, Quantity]) -> list[str]:
    lines, found = [], estimate.diagnostics
    if estimate.detection is not None:
        lines.append(f"Probability of a lump: {estimate.detection.probability:.3f}.")
    lines += rise_lines(estimate.other_rises)
    if estimate.size is not None:
        lines += width_lines(estimate.size.variance_share)
        if "oval_probability" in estimate.size.figures:
            lines.append(shape_text(estimate.size.figures))
        if found is not None and found.size_calibration:
            lines.append(f"{found.size_calibration}.")
        if estimate.size.invalid:
            lines.append(f"{estimate.size.invalid} draws gave no size and were left out.")
    if share := tracker_share(estimate):
        lines.append(f"{share}.")
    lines += [f"Passed over: {text}." for text in (() if found is None else found.noise.passed_over)]
    return [*lines, method_line(estimate.draws, quantities)] if estimate.draws is not None else lines


def tracker_share(estimate: Estimate) -> str:
    """How much of the width variance is tracker position error, in words; empty where it is too little for a word."""
    share = None if estimate.diagnostics is None else estimate.diagnostics.noise.places_share
    if share is None or share < LEAST_SHARE:
        return ""
    return f"{100 * share:.0f} % of the width variance is tracker position error"


def method_line(draws: ParameterDraws, quantities: Mapping[str, Quantity]) -> str:
    """The method, the Monte-Carlo error of the intervals' ends as they are printed, and the method's diagnostics."""
    parts = [_ends("sizes", ("max_size_mm", "min_size_mm"), quantities)] if "max_size_mm" in quantities else []
    parts.append(_ends("widths", ("sigma_x_mm", "sigma_y_mm"), quantities))
    ends = "Monte-Carlo error of the interval ends: " + ", ".join(parts)
    found = draws.diagnostics
    if draws.method == "ensemble":
        ess = min(found["ess_bulk"], found["ess_tail"])
        return f"Method ensemble: {ends}; R-hat {found['rhat']:.3f}, {ess:.0f} effective draws."
    if draws.method == "importance":
        return f"Method importance: {ends}; Pareto shape {found['pareto_k']:.2f}."
    return f"Method {draws.method}: {ends}; {len(draws.flat)} independent draws."


def _ends(what: str, names: tuple[str, ...], quantities: Mapping[str, Quantity]) -> str:
    worst = max((quantities[name] for name in names), key=lambda one: one.mc_error)
    return ends_text(what, worst.mc_error, worst.sd)


def _scene(estimate: Estimate) -> list[str]:
    """What the window holds, and how far the prior matters."""
    lines = [] if estimate.scene is None else scene_lines(estimate.scene)
    prior = "" if estimate.sensitivity is None else sensitivity_line(estimate.sensitivity)
    return [*lines, prior] if prior else lines


def _cautions(estimate: Estimate) -> list[str]:
    """What must be read before any number: that the map lies outside the calibration's range."""
    return [] if estimate.diagnostics is None else range_cautions(estimate.diagnostics.outside_calibration)


def warnings(estimate: Estimate) -> list[str]:
    """What makes the size less certain than its interval says: coarse cells, a level about the lump that is off."""
    found, lines = estimate.diagnostics, []
    if found is not None and found.coarse_cells:
        lines.append("The cells are coarse for this width: map again with a smaller --cell-mm.")
    offset = None if found is None else found.noise.level_offset
    if offset is not None and abs(offset) >= NEAR_LEVEL:
        lines.append(
            f"The level about the bump is {offset:+.3f} off the fixed background: something else bears on the head "
            "(a rib, a second mass), or the lump is large for it; the size is less certain than the interval says."
        )
    return lines


def passed_over(estimate: Estimate) -> list[str]:
    """The places passed over and why; the many of an empty map are counted."""
    faulty = [candidate for candidate in estimate.candidates if candidate.fault]
    lines = [f"Passed over near ({c.centre_mm[0]:.0f}, {c.centre_mm[1]:.0f}) mm: {c.fault}." for c in faulty]
    more = len(lines) - MOST_PASSED_OVER
    return [*lines[:MOST_PASSED_OVER], f"Passed over {more} lower bumps."] if more > 0 else lines


def _left_out(estimate: Estimate) -> list[str]:
    return [f"Left out: {'; '.join(estimate.left_out)}."] if estimate.left_out else []
