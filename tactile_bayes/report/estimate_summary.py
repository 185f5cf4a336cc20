"""An estimate in at most 12 lines: the size, what makes its interval wide, what would narrow it, its quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tactile_bayes.findings import finding_summary
from tactile_bayes.inference.summary import Quantity
from tactile_bayes.mapping.clock_face import ClockPosition
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import (
    ANOTHER_LARGEST,
    ANOTHER_SMALLEST,
    advice_lines,
    alike_spread,
    convergence_text,
    no_estimate_line,
    size_decimals,
    size_table,
    smallest_lines,
    tracker_share,
)
from tactile_bayes.report.lump_place import from_xiphoid
from tactile_bayes.report.masses_document import MassDocument, mass_lines, numbered
from tactile_bayes.report.narrowing import MORE, MOST_LINES, joined, width_lines
from tactile_bayes.report.quantities import leading_size, xiphoid_mm
from tactile_bayes.report.scene_text import scene_line
from tactile_bayes.report.supposed_text import supposed_document, supposed_line
from tactile_bayes.size.draws import EXTREMES

WIDTHS = ("sigma_x_mm", "sigma_y_mm")
MOST_CAUTIONS = 3
MOST_CHECKS = 2
MOST_MASSES = 3
"""Masses besides the reported one that have a line."""


def estimate_summary(
    estimate: Estimate,
    quantities: Mapping[str, Quantity],
    *,
    probability: float,
    masses: Sequence[MassDocument] = (),
    place: ClockPosition | None = None,
) -> str:
    """Report of one map in at most `MOST_LINES` lines; `estimate_text` gives the rest.

    Parameters
    ----------
    quantities
        As `estimate_quantities` gives them; empty without an estimate.
    probability
        Of the intervals.
    masses
        As `masses_document` gives them.
    place
        Of the lump about the nipple, where it is known.
    """
    if estimate.status == "no_estimate":
        body = finding_summary(estimate.findings, "caution", most=MOST_CAUTIONS)
        body += [no_estimate_line(estimate.reason), *smallest_lines(estimate), *advice_lines(estimate)]
        body += [*_masses(masses, room=MOST_MASSES), *finding_summary(estimate.findings, "check", most=MOST_CHECKS)]
    else:
        body = _something(estimate, quantities, probability, masses, place)
    return "\n".join([*body, f"{_model(estimate)}{MORE}", RESEARCH_USE]) + "\n"


def _something(
    estimate: Estimate,
    quantities: Mapping[str, Quantity],
    probability: float,
    masses: Sequence[MassDocument],
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
    return [*lines, *_supposed(estimate, quantities)] if len(lines) < MOST_LINES - 2 else lines


def _supposed(estimate: Estimate, quantities: Mapping[str, Quantity]) -> list[str]:
    """How large a soft lump and a hard one would be, where that matters."""
    largest = quantities.get("max_size_mm")
    if largest is None:
        return []
    supposed = supposed_document(estimate.size, largest)
    return supposed_line(supposed, largest.median, places=size_decimals([largest]))


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


def _masses(masses: Sequence[MassDocument], *, room: int) -> list[str]:
    """At most `room` lines on the masses besides the reported one, at least one; the last counts those left out."""
    lines = mass_lines(masses)
    shown = lines[: max(room, 1)]
    if left := len(lines) - len(shown):
        shown[-1] = f"{shown[-1].rstrip('.')}; and {left} more {'mass' if left == 1 else 'masses'}."
    return shown


def _model(estimate: Estimate) -> str:
    """Model and omissions, as the beginning of a line."""
    if estimate.scene is not None:
        return f"{scene_line(estimate.scene)} "
    return "".join(f"{line} " for line in joined(estimate.left_out, most=2, lead="Left out: "))


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
