"""Why there is no number, in a word that programs can read, and what would change that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.cells import trusted
from tactile_bayes.posterior.detection import Detection
from tactile_bayes.posterior.fit import LEAST_WIDTH_IN_CELLS, MOST_AXIS_RATIO, Candidate
from tactile_bayes.records import dataclass

BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
CODES = ("empty", "undetected", "unresolved", "window", "prior", "extrapolated", "method")
NEEDED_IN_WIDTHS = 2.0
"""Widths of the bump beyond its centre that strokes should reach, so that its flank shows on every side."""
LEAST_SEEN = 0.25
"""Share of a side's breadth that must be covered for the side to reach as far."""
MOST_PRIOR_SHARE = 0.5
"""Above this ratio of the posterior's to the prior's SD of a log width the prior, not the map, gives the interval."""
SIDES = {
    "the left (-x)": (-1.0, 0.0),
    "the right (+x)": (1.0, 0.0),
    "the feet (-y)": (0.0, -1.0),
    "the head (+y)": (0.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class Abstention:
    """No number.

    Parameters
    ----------
    code
        One of `CODES`.
    reason
        With the figure and the limit.
    advice
        What would fix it; empty when nothing would.
    """

    code: str
    reason: str
    advice: str = ""


def no_bump(tactile_map: TactileMap, candidates: Sequence[Candidate]) -> Abstention:
    """None of the candidates can be measured: the highest one's fault decides."""
    first = candidates[0]
    where = f"near ({first.centre_mm[0]:.1f}, {first.centre_mm[1]:.1f}) mm"
    reason = f"no bump can be measured ({len(candidates)} looked at); the highest, {where}: {first.fault}"
    code, advice = fault_code(tactile_map, first)
    return Abstention(code, reason, advice)


def fault_code(tactile_map: TactileMap, candidate: Candidate) -> tuple[str, str]:
    """The word for a candidate's fault, and what would fix it."""
    fit = candidate.fit
    if fit is None:
        short = missing_strokes(tactile_map, candidate.centre_mm, reach_mm=10.0)
        return ("window", extend_advice(short)) if short else ("undetected", "")
    sigma_x, sigma_y, _ = fit.widths()
    wide, narrow = max(sigma_x, sigma_y), min(sigma_x, sigma_y)
    if not fit.theta[0] > 0:
        return "undetected", ""
    if narrow < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return "unresolved", f"map again with --cell-mm {max(0.1, narrow / 0.75):.1g} or press more lightly"
    centre = (float(fit.theta[1]), float(fit.theta[2]))
    short = missing_strokes(tactile_map, centre, reach_mm=NEEDED_IN_WIDTHS * wide)
    if wide / narrow > MOST_AXIS_RATIO:
        return "unresolved", "feel whether it is a rib; name the lump's place with --centre-mm"
    return "window", extend_advice(short) or "fit a larger window (--fit-radius-mm) with a calibration learned so"


def missing_strokes(tactile_map: TactileMap, centre_mm: tuple[float, float], *, reach_mm: float) -> dict[str, float]:
    """By how many mm the map falls short of `reach_mm` from a centre, on each side where it does by a cell or more.

    A side is a quarter turn about its direction. It ends where less than `LEAST_SEEN` of its breadth is covered: a
    flank of which a corner is missing is still seen.
    """
    cell = tactile_map.recipe.cell_mm
    mask = trusted(tactile_map)
    dx = tactile_map.x_mm[None, :] - centre_mm[0]
    dy = tactile_map.y_mm[:, None] - centre_mm[1]
    short = {}
    for name, (x, y) in SIDES.items():
        along, across = dx * x + dy * y, np.abs(dx * y - dy * x)
        sector = across <= along
        reached = _reached(along[sector], mask[sector], cell, reach_mm)
        if reach_mm - reached >= cell:
            short[name] = reach_mm - reached
    return short


def _reached(along: FloatArray, covered: BoolArray, cell: float, reach: float) -> float:
    """How far a sector of a quarter turn is covered, mm; its innermost two cells have hardly a breadth."""
    for step in range(1, int(np.ceil(reach / cell))):
        here = (along >= (step - 0.5) * cell) & (along < (step + 0.5) * cell)
        if covered[here].sum() < (LEAST_SEEN * 2 * step if step > 1 else 1):
            return max(step - 0.5, 0.0) * cell
    return reach


def extend_advice(short: dict[str, float]) -> str:
    """The sides on which the strokes end too early, the worst first; empty when none does."""
    parts = [f"{mm:.0f} mm to {side}" for side, mm in sorted(short.items(), key=lambda one: -one[1]) if mm >= 0.5]
    return f"extend the strokes {' and '.join(parts[:2])}" if parts else ""


def undetected(detection: Detection, least: float) -> Abstention:
    """No lump that the noise, or a ridge as a rib makes, would not explain as well."""
    figures = f"(probability {detection.probability:.2g}, needed {least:g})"
    if detection.ridge:
        reason = f"no lump detected: {detection.ridge}, explains what rises {figures}"
        return Abstention("undetected", reason, "feel whether it is a rib; name a lump's place with --centre-mm")
    again = "go over the place again, more slowly or with more lines, and map all scans together"
    return Abstention("undetected", f"no lump detected {figures}", again)


def shape_fault(sigma_x: FloatArray, sigma_y: FloatArray, *, cell_mm: float, prior: BumpPrior) -> Abstention | None:
    """What draws of the widths say against a size: too narrow for the cells, a ridge, or the prior's own width."""
    x, y = float(np.median(sigma_x)), float(np.median(sigma_y))
    wide, narrow = max(x, y), min(x, y)
    if narrow < LEAST_WIDTH_IN_CELLS * cell_mm:
        reason = f"narrower than a cell (sigma {narrow:.2g} mm on {cell_mm:g} mm cells): not resolved"
        return Abstention("unresolved", reason, f"map again with --cell-mm {max(0.1, narrow / 0.75):.1g}")
    if wide / narrow > MOST_AXIS_RATIO:
        reason = f"a ridge, not a lump (sigma {wide:.3g} by {narrow:.3g} mm)"
        return Abstention("unresolved", reason, "feel whether it is a rib; name the lump's place with --centre-mm")
    share = prior_share(sigma_x, sigma_y, prior)
    if share > MOST_PRIOR_SHARE:
        reason = (
            f"the map hardly tells the widths: their posterior SD is {share:.2f} of the prior's "
            f"(at most {MOST_PRIOR_SHARE:g})"
        )
        return Abstention("prior", reason, "scan again, more slowly or with more lines, and map all scans together")
    return None


def extrapolated(far: Sequence[str]) -> Abstention:
    """The map lies so far outside the calibration's table that nothing is known of the size's error."""
    advice = (
        "learn a calibration whose table holds such lumps (`population`, `calibrate size`), or give "
        "--size-calibration none for amplitude and widths"
    )
    return Abstention("extrapolated", f"too far outside the calibration's range for a size: {'; '.join(far)}", advice)


def prior_share(sigma_x: FloatArray, sigma_y: FloatArray, prior: BumpPrior) -> float:
    """Posterior over prior SD of the less certain log width."""
    sd = max(float(np.std(np.log(sigma_x))), float(np.std(np.log(sigma_y))))
    return sd / float(np.hypot(prior.log_width_sd, prior.log_ratio_sd))
