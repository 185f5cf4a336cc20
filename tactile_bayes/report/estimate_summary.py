"""An estimate in at most 12 lines: the size, what makes its interval wide, what would narrow it, its quality."""

from __future__ import annotations

from collections.abc import Mapping

from tactile_bayes.inference.summary import Quantity
from tactile_bayes.posterior.result import Estimate, Rise
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import (
    ANOTHER_LARGEST,
    advice_lines,
    convergence_text,
    exam_spread,
    no_estimate_line,
    size_decimals,
    size_table,
    tracker_share,
    warnings,
)
from tactile_bayes.report.narrowing import MORE, MOST_LINES, joined, width_lines
from tactile_bayes.report.rise_text import away_text
from tactile_bayes.report.scene_text import scene_line
from tactile_bayes.report.supposed_text import supposed_document, supposed_line
from tactile_bayes.size.posterior import EXTREMES

WIDTHS = ("sigma_x_mm", "sigma_y_mm")
MOST_CAUTIONS = 3
MOST_RISES = 3


def estimate_summary(estimate: Estimate, quantities: Mapping[str, Quantity], *, probability: float) -> str:
    """Report of one map in at most `MOST_LINES` lines; `estimate_text` gives the rest.

    Parameters
    ----------
    quantities
        As `estimate_quantities` gives them; empty without an estimate.
    probability
        Of the intervals.
    """
    body = _nothing(estimate) if estimate.status == "no_estimate" else _something(estimate, quantities, probability)
    return "\n".join([*body, f"{_model(estimate)}{MORE}", RESEARCH_USE]) + "\n"


def _nothing(estimate: Estimate) -> list[str]:
    return [no_estimate_line(estimate.reason), *advice_lines(estimate), *_rises(estimate.other_rises)]


def _something(estimate: Estimate, quantities: Mapping[str, Quantity], probability: float) -> list[str]:
    lines = _cautions(estimate)
    shown = [name for name in EXTREMES if name in quantities] or [name for name in WIDTHS if name in quantities]
    table = shown if ANOTHER_LARGEST not in quantities else [*shown, ANOTHER_LARGEST]
    lines += size_table({name: quantities[name] for name in table}, probability, exam_spread=exam_spread(estimate))
    lines += _lump(estimate, quantities)
    lines += _rises(estimate.other_rises)
    if estimate.reason:
        lines += [f"No size: {estimate.reason}.", *advice_lines(estimate)]
    if estimate.size is not None:
        lines += width_lines(estimate.size.variance_share)
    lines += _quality(estimate, {name: quantities[name] for name in shown})
    doubts = [text.rstrip(".") for text in warnings(estimate)]
    lines += joined(doubts, most=2, lead="Check: ")
    return [*lines, *_supposed(estimate, quantities)] if len(lines) < MOST_LINES - 2 else lines


def _supposed(estimate: Estimate, quantities: Mapping[str, Quantity]) -> list[str]:
    """How large a soft lump and a hard one would be, where that matters."""
    largest = quantities.get("max_size_mm")
    if largest is None:
        return []
    supposed = supposed_document(estimate.size, largest)
    return supposed_line(supposed, largest.median, places=size_decimals([largest]))


def _cautions(estimate: Estimate) -> list[str]:
    """One line on broken assumptions and on a map outside the calibration's range; none without either."""
    found = estimate.diagnostics
    if found is None:
        return []
    outside = joined(found.outside_calibration, most=MOST_CAUTIONS, lead="outside the calibration's range: ")
    texts = [*found.broken_assumptions, *(line.rstrip(".") for line in outside)]
    return joined(texts, most=MOST_CAUTIONS, lead="CAUTION: ")


def _lump(estimate: Estimate, quantities: Mapping[str, Quantity]) -> list[str]:
    """Probability of a lump, and its place."""
    parts = [] if estimate.detection is None else [f"Probability of a lump {estimate.detection.probability:.3f}"]
    if "amplitude" in quantities:
        parts.append(f"amplitude {quantities['amplitude'].median:.2g}")
    if "centre_patient_mm.x" in quantities:
        x, y = (quantities[f"centre_patient_mm.{axis}"].median for axis in "xy")
        parts.append(
            f"{abs(x):.0f} mm {'right' if x >= 0 else 'left'} of the xiphoid and "
            f"{abs(y):.0f} mm {'above' if y >= 0 else 'below'} it"
        )
    if "centre_mm.x" in quantities:
        parts.append("at ({:.1f}, {:.1f}) mm on the map".format(*(quantities[f"centre_mm.{a}"].median for a in "xy")))
    return [f"{', '.join(parts)}."] if parts else []


def _rises(rises: tuple[Rise, ...]) -> list[str]:
    places = [
        f"({rise.x_mm:.1f}, {rise.y_mm:.1f}) mm{away_text(rise)} (probability of a lump {rise.probability:.3f})"
        for rise in rises
    ]
    lead = "Another rise (measure it by estimate --centre-mm X Y): "
    return joined(
        places, most=MOST_RISES, lead=lead if len(places) == 1 else lead.replace("Another rise", "Other rises")
    )


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
    if measure := convergence_text(estimate.draws):
        parts.append(measure)
    if share := tracker_share(estimate):
        parts.append(share)
    if estimate.size is not None and estimate.size.invalid:
        parts.append(f"{estimate.size.invalid} draws gave no size and were left out")
    return [f"Quality: {'; '.join(parts)}."]
