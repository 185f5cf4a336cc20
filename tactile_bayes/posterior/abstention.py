"""Reasons why a map gives no number, as codes and sentences, with what would help."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.errors import CANNOT_SHOW, Abstention, UsageError
from tactile_bayes.geometry import BoolArray, FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import orientation_of
from tactile_bayes.mapping.plausibility import against_no_lump
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import covered_share, map_ends, on_map, trusted, window_cells
from tactile_bayes.posterior.draw import DETECTED
from tactile_bayes.posterior.lump_probability import LIKELY, Weighed
from tactile_bayes.posterior.white import AT_RIM, LEAST_COVERED_SHARE, LEAST_WIDTH_IN_CELLS, MOST_AXIS_RATIO, Candidate

FEEL_AGAIN = "if a lump is felt, go over the place again, more slowly or with more lines, and map all scans together"
FEEL_AGAIN_ON_PAPER = "if a lump is felt, scan its place again, more slowly or with more strokes"
FEEL_A_RIB = "feel whether it is a rib; if a lump is felt, name its place with --centre-mm X Y"
FEEL_A_RIB_ON_PAPER = "feel at the cross on the picture whether it is a rib; if a lump is felt, scan its place again"
SMALLER_CELLS_ON_PAPER = "have the scan mapped again with smaller cells"
SCAN_AGAIN = "scan again: nothing of the area was read"
LARGER_WINDOW = "fit a larger window (fit_radius_mm in --settings FILE.toml) with a calibration learned so"
BEYOND_IT = "extend the strokes beyond it"
LARGER_WINDOW_ON_PAPER = "nothing by this exam: the rise is wider than the program measures"
MORE_LINES = "scan again, more slowly or with more lines, and map all scans together"
MORE_LINES_ON_PAPER = "scan the place again, more slowly or with more strokes"
NEEDED_IN_WIDTHS = 2.0
"""Widths of the bump beyond its centre that strokes should reach, so that its flank shows on every side."""
WIDE_IN_RADII = 0.4
ENCLOSED_IN_WIDTHS = 1.6
"""How far the map must reach on every side of a bump wide for its window: a rise to the edge looks like half.

Of 800 simulated exams 46 showed a lump wider than 8 mm, all of them enclosed so; the end of strokes made one more rise.
"""
LEAST_SEEN = 0.25
"""Share of a side's breadth that must be covered for the side to reach as far."""
LEAST_READ = 0.25
"""Least share of the map's typical number of readings in a cell, for a bump's cells: 134 lumps had 1.8 and more.

One empty scan of 45 had a spot of 0.16 at its corner, in cells of 3 readings for 29.
"""
COARSEST_MM = 4.0
"""Cells above this say nothing of a lump that they do not show: one of 10 mm close to the skin has a sigma of 2 mm."""
HOPELESS = 2.0
"""Widths at the mode so many times beyond a limit decide without draws: chains for a stripe of readings took 30 s."""
MOST_PRIOR_SHARE = 0.5
"""Above this ratio of the posterior's to the prior's SD of a log width the prior, not the map, gives the interval."""
SIDES = {"-x": (-1.0, 0.0), "+x": (1.0, 0.0), "-y": (0.0, -1.0), "+y": (0.0, 1.0)}


def searched(tactile_map: TactileMap, centre_mm: tuple[float, float] | None) -> str:
    """The area searched for a lump, in words: the place given, which must lie on the map, or all that is covered."""
    if centre_mm is None:
        area = float(trusted(tactile_map).sum()) * tactile_map.recipe.cell_mm**2 / 100.0
        return f"on the {f'{area:.0f}' if area >= 10 else f'{area:.2g}'} cm2 that the map covers"
    if not on_map(tactile_map, *centre_mm):
        reach = " and ".join(
            f"{name} from {low:g} to {high:g} mm" for name, (low, high) in map_ends(tactile_map).items()
        )
        place = f"centre_mm ({centre_mm[0]:g}, {centre_mm[1]:g})"
        raise UsageError(f"{place} lies off the map, which has {reach}; give a place on it")
    return f"near ({centre_mm[0]:.1f}, {centre_mm[1]:.1f}) mm"


def no_verdict(tactile_map: TactileMap) -> Abstention | None:
    """Reason why a map that shows no lump does not say that there is none; None where one would show."""
    cell = tactile_map.recipe.cell_mm
    if not tactile_map.covered.any():
        return cannot_show("the map has no covered cell", "map a scan that covers the place", SCAN_AGAIN)
    if cell > COARSEST_MM:
        advice = "map the scan again with smaller cells (they have 1 mm by default)"
        return cannot_show(f"its cells of {cell:g} mm are too large", advice, SMALLER_CELLS_ON_PAPER)
    against = against_no_lump(tactile_map)
    if not against:
        return None
    first, remedies = against[0], dict.fromkeys(one.remedy for one in against if one.remedy)
    on_paper = dict.fromkeys(one.on_paper for one in against if one.on_paper)
    return cannot_show(first.text, "; ".join(remedies), "; ".join(on_paper))


def cannot_show(why: str, advice: str = "", on_paper: str = "") -> Abstention:
    """Data that cannot show whether there is a lump, and what would help."""
    return Abstention(CANNOT_SHOW, f"the data cannot show whether there is a lump: {why}", advice, on_paper)


def chance_text(probability: float) -> str:
    """Format a probability with no more digits than it is worth."""
    return "below 0.01" if probability < 0.01 else "above 0.99" if probability > 0.99 else f"{probability:.2f}"


def no_bump(
    tactile_map: TactileMap, candidates: Sequence[Candidate], likeliest: Weighed | None, *, where: str
) -> Abstention:
    """Reason when no candidate can be measured: no lump, or one that the map covers too poorly.

    `likeliest` is the candidate that is most likely a lump all the same, see `estimate.best_chance`.
    """
    candidate = None if likeliest is None else likeliest.candidate
    if candidate is not None and likeliest is not None and likeliest.probability >= LIKELY:
        reason = f"the rise {_place(candidate)} cannot be measured: {candidate.fault}"
        return _for_fault(tactile_map, candidate, reason)
    first = candidates[0]
    if likeliest is None and "covered cells" in first.fault:
        short = missing_strokes(tactile_map, first.centre_mm, reach_mm=10.0)
        advice = extend_advice(short) or "cover the place with more strokes"
        return Abstention("window", f"no lump found {where}: {first.fault}", advice, advice, first.centre_mm)
    if candidate is not None and likeliest is not None and likeliest.detection.log_bayes_factor > 0:
        why = _for_fault(tactile_map, candidate, f"no lump found {where}: what rises {_place(candidate)} is a ridge")
        if why.code == "ridge":
            return why
    rises = f"none of the {len(candidates)} places that rise is one" if len(candidates) > 1 else first.fault
    return Abstention("undetected", f"no lump found {where}: {rises}", FEEL_AGAIN, FEEL_AGAIN_ON_PAPER)


def _place(candidate: Candidate) -> str:
    return f"near ({candidate.centre_mm[0]:.1f}, {candidate.centre_mm[1]:.1f}) mm"


def _for_fault(tactile_map: TactileMap, candidate: Candidate, reason: str) -> Abstention:
    """The reason with the code and the remedies of a candidate's fault."""
    fit, at = candidate.fit, candidate.centre_mm
    if fit is None:
        advice = extend_advice(missing_strokes(tactile_map, at, reach_mm=10.0))
        return Abstention("window" if advice else "undetected", reason, advice, advice, at)
    sigma_x, sigma_y, _ = fit.widths()
    wide, narrow = max(sigma_x, sigma_y), min(sigma_x, sigma_y)
    if not fit.theta[0] > 0:
        return Abstention("undetected", reason, about_mm=at)
    if wide / max(narrow, 1e-9) > MOST_AXIS_RATIO:
        return Abstention("ridge", reason, FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, at)
    if narrow < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return _coarse(reason, narrow, at)
    centre = (float(fit.theta[1]), float(fit.theta[2]))
    extend = extend_advice(missing_strokes(tactile_map, centre, reach_mm=NEEDED_IN_WIDTHS * wide))
    if not extend and candidate.fault.startswith(AT_RIM):
        extend = BEYOND_IT  # under correlated errors the rise is wider than least squares made it
    if extend:
        return Abstention("window", reason, extend, extend, at)
    return Abstention("window", reason, LARGER_WINDOW, LARGER_WINDOW_ON_PAPER, at)


def _coarse(reason: str, narrow_mm: float, at: tuple[float, float] | None = None) -> Abstention:
    """The reason, with the remedies for a rise that the cells do not resolve."""
    advice = f"map again with --cell-mm {max(0.1, narrow_mm / 0.75):.1g}"
    return Abstention("unresolved", reason, advice, SMALLER_CELLS_ON_PAPER, at)


def missing_strokes(tactile_map: TactileMap, centre_mm: tuple[float, float], *, reach_mm: float) -> dict[str, float]:
    """Distance in mm by which coverage falls short of `reach_mm` from a centre, per side, where at least a cell.

    The sides are named as a viewer of the map's picture sees them: "the patient's left (-x)" with landmarks.

    A side is a quarter turn about its direction. It ends where less than `LEAST_SEEN` of its breadth is covered: a
    flank of which a corner is missing is still seen.
    """
    cell = tactile_map.recipe.cell_mm
    mask = trusted(tactile_map)
    dx = tactile_map.x_mm[None, :] - centre_mm[0]
    dy = tactile_map.y_mm[:, None] - centre_mm[1]
    short, view = {}, orientation_of(tactile_map)
    for axis, (x, y) in SIDES.items():
        along, across = dx * x + dy * y, np.abs(dx * y - dy * x)
        sector = across <= along
        reached = _reached(along[sector], mask[sector], cell, reach_mm)
        if reach_mm - reached >= cell:
            short[view.side_words(axis)] = reach_mm - reached
    return short


def _reached(along: FloatArray, covered: BoolArray, cell: float, reach: float) -> float:
    """Distance that a quarter-turn sector is covered, mm; next to its corner one covered cell is enough."""
    for step in range(1, int(np.ceil(reach / cell))):
        here = (along >= (step - 0.5) * cell) & (along < (step + 0.5) * cell)
        if covered[here].sum() < (LEAST_SEEN * 2 * step if step > 1 else 1):
            return max(step - 0.5, 0.0) * cell
    return reach


def rim_fault(
    tactile_map: TactileMap, centre_mm: tuple[float, float], widths_mm: tuple[float, float], *, radius_mm: float
) -> str:
    """Fault of a bump mostly beyond the map's rim, within a single cell, or of few readings; empty if none."""
    wide, narrow, cell = max(widths_mm), min(widths_mm), tactile_map.recipe.cell_mm
    share = covered_share(tactile_map, centre_mm, radius_mm=1.5 * wide)
    if share < LEAST_COVERED_SHARE:
        return f"{AT_RIM} ({100 * share:.0f} % of the bump is covered, with a sigma of {wide:.3g} mm)"
    wide_rise = wide > WIDE_IN_RADII * radius_mm
    short = missing_strokes(tactile_map, centre_mm, reach_mm=ENCLOSED_IN_WIDTHS * wide)
    if wide_rise and short:
        side, millimetres = max(short.items(), key=lambda one: one[1])
        return f"{AT_RIM} (with a sigma of {wide:.3g} mm its flank to {side} is {millimetres:.0f} mm short)"
    if narrow < LEAST_WIDTH_IN_CELLS * cell:
        return f"narrower than a cell (sigma {narrow:.2g} mm on {cell:g} mm cells): not resolved"
    typical = float(np.median(tactile_map.count[tactile_map.covered]))
    cells = window_cells(tactile_map, centre_mm, radius_mm=max(1.5 * wide, cell))
    here = float(np.median(cells.count)) if len(cells) else 0.0
    if here >= LEAST_READ * typical:
        return ""
    return f"{AT_RIM} (its cells hold {here:g} readings, where {typical:g} are typical)"


def extend_advice(short: dict[str, float]) -> str:
    """Advice on the sides where the strokes end too early, the worst first; empty when none does."""
    parts = [f"{mm:.0f} mm to {side}" for side, mm in sorted(short.items(), key=lambda one: -one[1]) if mm >= 0.5]
    return f"extend the strokes {' and '.join(parts[:2])}" if parts else ""


def undetected(weighed: Weighed, *, where: str) -> Abstention:
    """Reason when noise, or a rib-like ridge, explains the map as well as a lump."""
    at, detection = weighed.centre_mm, weighed.detection
    if detection.ridge:
        reason = f"no lump found {where}: what rises near ({at[0]:.1f}, {at[1]:.1f}) mm is rather {detection.ridge}"
        return Abstention("ridge", reason, FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, at)
    if detection.probability < DETECTED:
        reason = f"no lump found {where}: errors of the map explain what rises as well as a lump does"
        return Abstention("undetected", reason, FEEL_AGAIN, FEEL_AGAIN_ON_PAPER)
    rise = f"no lump found {where}: what rises near ({at[0]:.1f}, {at[1]:.1f}) mm is"
    if weighed.axis_ratio > MOST_AXIS_RATIO:
        return Abstention("ridge", f"{rise} a ridge, not a lump", FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, at)
    reason = f"{rise} wider or less covered than a lump: uneven fat, a rib and the map's rim look so"
    return Abstention("undetected", reason, FEEL_AGAIN, FEEL_AGAIN_ON_PAPER, at)


def shape_fault(sigma_x: FloatArray, sigma_y: FloatArray, *, cell_mm: float, prior: BumpPrior) -> Abstention | None:
    """Reason against a size from draws of the widths: below the cells, a ridge, or as wide as the prior; else None."""
    fault = width_fault(float(np.median(sigma_x)), float(np.median(sigma_y)), cell_mm=cell_mm, margin=1.0)
    if fault is not None:
        return fault
    sd = max(float(np.std(np.log(sigma_x))), float(np.std(np.log(sigma_y))))
    share = sd / float(np.hypot(prior.log_width_sd, prior.log_ratio_sd))
    if share > MOST_PRIOR_SHARE:
        reason = (
            f"the map hardly shows how wide the lump is: the SD of its widths is {share:.2f} of what it is without a "
            f"map (at most {MOST_PRIOR_SHARE:g})"
        )
        return Abstention("prior", reason, MORE_LINES, MORE_LINES_ON_PAPER)
    return None


def width_fault(x: float, y: float, *, cell_mm: float, margin: float) -> Abstention | None:
    """Reason for widths beyond the cells' or a ridge's limit by a factor of `margin`; else None.

    At the mode `HOPELESS` times the limit is enough: then no draws are needed.
    """
    wide, narrow = max(x, y), min(x, y)
    if narrow * margin < LEAST_WIDTH_IN_CELLS * cell_mm:
        reason = f"narrower than a cell (sigma {narrow:.2g} mm on {cell_mm:g} mm cells): not resolved"
        return _coarse(reason, narrow)
    if wide / narrow > MOST_AXIS_RATIO * margin:
        reason = f"what rises is a ridge, not a lump (sigma {wide:.3g} by {narrow:.3g} mm)"
        return Abstention("ridge", reason, FEEL_A_RIB, FEEL_A_RIB_ON_PAPER)
    return None
