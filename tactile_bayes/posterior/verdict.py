"""Lump or not: its probability, the reasons for giving no size, and the smallest lump that a map would have shown."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, floor, lgamma, log, log1p, pi
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import CANNOT_SHOW, Abstention, UsageError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap, orientation_of
from tactile_bayes.mapping.plausibility import against_no_lump
from tactile_bayes.options import PRIORS, BumpPrior
from tactile_bayes.posterior.bump import (
    RIM_MM,
    RIM_SHARE,
    Detection,
    covered_share,
    map_ends,
    on_map,
    smoothed_excess,
    trusted_cells,
    value_scale,
    window_cells,
)
from tactile_bayes.posterior.draw import DETECTED, ModalBump, SamplerSettings
from tactile_bayes.posterior.marginal import CollapsedTarget, Scene
from tactile_bayes.posterior.white import (
    AT_RIM,
    FEW_CELLS,
    LEAST_COVERED_SHARE,
    LEAST_WIDTH_IN_CELLS,
    MOST_AXIS_RATIO,
    NARROW,
    Candidate,
)
from tactile_bayes.posterior.window import Problem, Window, independent_variance
from tactile_bayes.presets import FIT_RADIUS_MM

# --- Probability that a rise of a map is a lump, calibrated on simulated exams with and without one.

SHARE_WITH_LUMP: Final = 0.5  #: Half of the simulated exams hold a lump: the prior probability behind the answer.
COEFFICIENTS: Final = (1.14, 0.8, -2.36, -4.3, -2.32, -2.47)
"""Intercept and those of `WeighedRise.features`; printed by ``python -m validation lump_probability learn``, 0127."""
ENDS: Final = (0.05, 0.99)
"""Least and largest probability: the simulated exams resolve none nearer to 0 or 1. Of the 40 least likely rises there,
2 lie within 10 mm of a lump that the map does not show."""
LIKELY: Final = 0.5  #: A rise with a lower probability is no lump by the verdict, whatever its evidence.
UNPROVEN: Final = 0.49  #: Largest probability of a rise without the evidence for a size, so that it is no lump.
MOST_EVIDENCE: Final = 50.0
WIDE_MM: Final = 8.0
NO_EVIDENCE: Final = "no lump by the evidence"


class WeighedRise(Record, eq=False):
    """A rise with the odds of a bump there, and the probability that it is a lump."""

    detection: Detection  #: Evidence for a bump against smooth errors, and a ridge where one rises.
    centre_mm: tuple[float, float]  #: Centre of the bump.
    features: tuple[float, ...]
    """Log of 1 plus the log Bayes factor, log of the axis ratio, excess of the log width over that of `WIDE_MM`, share
    of the bump that the map does not cover, and 1 where the candidate has a fault."""
    candidate: Candidate | None = None  #: The candidate of the search.

    @property
    def axis_ratio(self) -> float:
        """Axis ratio of the bump, at most e^2."""
        return exp(self.features[1])

    @property
    def chance(self) -> float:
        """Probability of a lump, where half of the exams hold one, with or without the evidence for a size.

        The evidence is against smooth errors only; the other features tell rims, ridges, ribs, creases and uneven fat.
        """
        score = COEFFICIENTS[0] + float(np.dot(COEFFICIENTS[1:], self.features))
        return float(np.clip(1.0 / (1.0 + exp(-score)), *ENDS))

    @property
    def probability(self) -> float:
        """The `chance`; at most `UNPROVEN` without the evidence."""
        return self.chance if self.detection.probability >= DETECTED else min(self.chance, UNPROVEN)


def weigh(
    tactile_map: TactileMap, detection: Detection, bump: ModalBump, candidate: Candidate | None = None
) -> WeighedRise:
    """The rise of a bump with its odds and features; `candidate` is that of the search."""
    centre_mm, (narrow, wide) = (bump.x_mm, bump.y_mm), sorted((bump.sigma_x_mm, bump.sigma_y_mm))
    evidence = log1p(float(np.clip(detection.log_bayes_factor, 0.0, MOST_EVIDENCE)))
    too_wide = max(log(wide / WIDE_MM), 0.0)
    open_share = 1.0 - covered_share(tactile_map, centre_mm, radius_mm=1.5 * wide)
    fault = "" if candidate is None else candidate.fault
    faulty = float(bool(fault) and not fault.startswith(NO_EVIDENCE))
    features = (evidence, min(log(wide / narrow), 2.0), min(too_wide, 2.0), open_share, faulty)
    return WeighedRise(detection, centre_mm, features, candidate)


# --- Reasons for giving no size: codes and sentences, with what would help.

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
STROKES_IN_WIDTHS = 2.0
"""Distance from the bump's centre, in widths, that strokes should reach, so that its flank shows on every side."""
WIDE_IN_RADII = 0.4
ENCLOSED_IN_WIDTHS = 1.6
"""Distance in widths that the map must reach on every side of a bump wide for its window: all 46 lumps wider than 8 mm
in 800 simulated exams were enclosed so."""
HIGH_AT_RIM: Final = 0.2
"""Height, in the map's scale, from which a rise cut by the rim is told in place of "no lump", and the share of it that
the map must show: the probability, learned from lumps on the map, is below 0.5 for half of a lump. Of 38 empty bodies
none rises there by more than 0.13."""
HIGH_SEEN: Final = 0.4
"""Height that the map itself shows at its rim, from which a rise needs no bump that fits it: the head's rim, which
presses hardest over deep fat, makes 0.37 at most in 155 right exams without ribs or uneven fat."""
SEEN_IN_SDS: Final = 4.0
"""The same over the robust SD of the cells: 17 lumps beyond the rim had 5.2 and more, a map of noise 1.9."""
LEAST_SEEN = 0.25  #: Least share of a sector's breadth that must be covered for it to reach as far.
LEAST_READ = 0.25
"""Least share of the map's median count in the cells of a bump: 134 lumps had 1.8 and more, a spot of noise 0.16."""
COARSEST_MM = 4.0  #: Largest cells that can show a lump of 10 mm close to the skin, whose sigma is 2 mm.
HOPELESS = 2.0
"""Factor beyond a limit of the widths at the mode that decides without draws: chains for a stripe took 30 s."""
MOST_PRIOR_SHARE = 0.5
"""Ratio of the posterior's to the prior's SD of a log width above which the prior, not the map, gives the interval."""
SIDES = {"-x": (-1.0, 0.0), "+x": (1.0, 0.0), "-y": (0.0, -1.0), "+y": (0.0, 1.0)}


def searched_area(tactile_map: TactileMap, centre_mm: tuple[float, float] | None) -> str:
    """Text of the area searched for a lump: a given centre, which must lie on the map, or all covered cells."""
    if centre_mm is None:
        area = float(trusted_cells(tactile_map).sum()) * tactile_map.recipe.cell_mm**2 / 100.0
        return f"on the {f'{area:.0f}' if area >= 10 else f'{area:.2g}'} cm2 that the map covers"
    if not on_map(tactile_map, *centre_mm):
        ends = map_ends(tactile_map).items()
        reach = " and ".join(f"{name} from {low:g} to {high:g} mm" for name, (low, high) in ends)
        place = f"centre_mm ({centre_mm[0]:g}, {centre_mm[1]:g})"
        raise UsageError(f"{place} lies off the map, which has {reach}; give a place on it")
    return _near_text(centre_mm)


def no_verdict(tactile_map: TactileMap) -> Abstention | None:
    """Reason why a map without a rise does not exclude a lump; None where it would have shown one."""
    cell = tactile_map.recipe.cell_mm
    if not tactile_map.covered.any():
        return cannot_show("the map has no covered cell", "map a scan that covers the place", SCAN_AGAIN)
    if cell > COARSEST_MM:
        advice = "map the scan again with smaller cells (they have 1 mm by default)"
        return cannot_show(f"its cells of {cell:g} mm are too large", advice, SMALLER_CELLS_ON_PAPER)
    findings = against_no_lump(tactile_map)
    if not findings:
        return None
    first, remedies = findings[0], dict.fromkeys(one.remedy for one in findings if one.remedy)
    on_paper = dict.fromkeys(finding.on_paper for finding in findings if finding.on_paper)
    return cannot_show(first.text, "; ".join(remedies), "; ".join(on_paper))


def own_priors(prior: BumpPrior) -> list[str]:
    """Names of the priors that are not the default ones."""
    default = BumpPrior()
    return [name for name in PRIORS if getattr(prior, name) != getattr(default, name)]


def hiding_settings(options: SamplerSettings) -> Abstention | None:
    """Reason why a fit with priors of one's own, or in a small window, excludes no lump; None with neither."""
    own = own_priors(options)
    own += ["fit_radius_mm"] if options.fit_radius_mm < 0.4 * FIT_RADIUS_MM else []
    if not own:
        return None
    why = f"lumps are not detected reliably with {', '.join(f'{name} = {getattr(options, name):g}' for name in own)}"
    return cannot_show(why, f"leave {' and '.join(own)} out of the settings", "have it estimated anew without them")


def cannot_show(why: str, advice: str, on_paper: str) -> Abstention:
    """Abstention for data that cannot show whether there is a lump, and the remedy."""
    return Abstention(CANNOT_SHOW, f"the data cannot show whether there is a lump: {why}", advice, on_paper)


def shows_no_lump(smallest: SmallestLumps) -> Abstention | None:
    """Reason why a map excludes no lump, where its errors hide the largest one at every place and depth; else None."""
    if np.isfinite(smallest.d_mm).any():
        return None
    largest_mm = largest_tried_mm(float(smallest.depths_mm.max()))
    why = f"not even one of {largest_mm:g} mm would rise above the map's errors"
    return cannot_show(why, MORE_LINES, MORE_LINES_ON_PAPER)


def chance_text(probability: float, digits: int = 2) -> str:
    """Text of a probability to so many digits: "0.32", "below 0.01" or "above 0.99"."""
    least = 10.0**-digits
    if least <= probability <= 1.0 - least:
        return f"{probability:.{digits}f}"
    return f"below {least:g}" if probability < least else f"above {1.0 - least:g}"


def no_bump_reason(
    tactile_map: TactileMap, candidates: Sequence[Candidate], likeliest: WeighedRise | None, *, where: str
) -> Abstention:
    """Reason when no candidate can be measured, from the likeliest: no lump, or one that the map covers too little."""
    if likeliest is not None and (candidate := likeliest.candidate) is not None:
        if likeliest.probability >= LIKELY:
            return _unmeasured(tactile_map, candidate)
        if likeliest.detection.log_bayes_factor > 0:
            rise = f"what rises {_near_text(candidate.centre_mm)} is a ridge"
            ridge = _reason_for_fault(tactile_map, candidate, f"no lump found {where}: {rise}")
            if ridge.code == "ridge":
                return ridge
    first = candidates[0]
    if likeliest is None and first.fault.startswith(FEW_CELLS):
        if tactile_map.recipe.cell_mm > COARSEST_MM and (why := no_verdict(tactile_map)) is not None:
            return why
        shortfall = coverage_shortfall(tactile_map, first.centre_mm, reach_mm=10.0)
        advice = stroke_advice(shortfall) or "cover the place with more strokes"
        return Abstention("window", f"nothing can be measured {where}: {first.fault}", advice, advice, first.centre_mm)
    rises = f"none of the {len(candidates)} places that rise is one" if len(candidates) > 1 else first.fault
    return Abstention("undetected", f"no lump found {where}: {rises}", FEEL_AGAIN, FEEL_AGAIN_ON_PAPER)


def cut_by_rim(tactile_map: TactileMap, candidates: Sequence[Candidate]) -> Abstention | None:
    """Reason why a map excludes no lump, where its rim cuts a rise as high as lumps are; None without one."""
    for one in candidates:
        fit = one.fit
        high = fit is not None and min(fit.theta[0] / fit.bump.scale, fit.covered_share) >= HIGH_AT_RIM
        seen = _seen_at_rim(tactile_map, one.centre_mm)
        if one.fault.startswith(AT_RIM) and (high or seen):
            if (why := _unmeasured(tactile_map, one)).code == "window":
                return why
        elif seen and fit is None:
            reason = f"the map's rim cuts the rise {_near_text(one.centre_mm)}"
            return Abstention("window", reason, BEYOND_IT, BEYOND_IT, one.centre_mm)
    return None


def _seen_at_rim(tactile_map: TactileMap, place_mm: tuple[float, float]) -> bool:
    """True where a normalised map itself shows a high rise at a place of its rim."""
    inside = covered_share(tactile_map, place_mm, radius_mm=RIM_MM) >= RIM_SHARE
    if inside or tactile_map.background is None:
        return False
    excess = smoothed_excess(tactile_map)
    column, row = np.abs(tactile_map.x_mm - place_mm[0]).argmin(), np.abs(tactile_map.y_mm - place_mm[1]).argmin()
    sd = 1.4826 * np.median(np.abs(excess[np.isfinite(excess)]))
    return bool(excess[row, column] >= max(HIGH_SEEN, SEEN_IN_SDS * sd))


def _unmeasured(tactile_map: TactileMap, candidate: Candidate) -> Abstention:
    reason = f"the rise {_near_text(candidate.centre_mm)} cannot be measured: {candidate.fault}"
    return _reason_for_fault(tactile_map, candidate, reason)


def _near_text(place_mm: tuple[float, float]) -> str:
    return f"near ({place_mm[0]:.1f}, {place_mm[1]:.1f}) mm"


def _reason_for_fault(tactile_map: TactileMap, candidate: Candidate, reason: str) -> Abstention:
    """Abstention with the code and the remedies of a candidate's fault."""
    fit, centre_mm = candidate.fit, candidate.centre_mm
    if fit is None:
        advice = stroke_advice(coverage_shortfall(tactile_map, centre_mm, reach_mm=10.0))
        return Abstention("window" if advice else "undetected", reason, advice, advice, centre_mm)
    narrow, wide = sorted(fit.widths()[:2])
    if not fit.theta[0] > 0:
        return Abstention("undetected", reason, about_mm=centre_mm)
    if wide / narrow > MOST_AXIS_RATIO:
        return Abstention("ridge", reason, FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, centre_mm)
    if narrow < LEAST_WIDTH_IN_CELLS * fit.cells.cell_mm:
        return _coarse(reason, narrow, centre_mm)
    off_map = covered_share(tactile_map, fit.centre_mm, radius_mm=0.0) == 0  # from there every side falls short
    place_mm = centre_mm if off_map else fit.centre_mm
    extend = stroke_advice(coverage_shortfall(tactile_map, place_mm, reach_mm=STROKES_IN_WIDTHS * wide))
    if not extend and candidate.fault.startswith(AT_RIM):
        extend = BEYOND_IT  # under correlated errors the rise is wider than least squares made it
    if extend:
        return Abstention("window", reason, extend, extend, centre_mm)
    return Abstention("window", reason, LARGER_WINDOW, LARGER_WINDOW_ON_PAPER, centre_mm)


def _coarse(reason: str, narrow_mm: float, centre_mm: tuple[float, float] | None = None) -> Abstention:
    """Abstention with the remedies for a rise that the cells do not resolve."""
    advice = f"map again with --cell-mm {max(0.1, narrow_mm / 0.75):.1g}"
    return Abstention("unresolved", reason, advice, SMALLER_CELLS_ON_PAPER, centre_mm)


def coverage_shortfall(tactile_map: TactileMap, centre_mm: tuple[float, float], *, reach_mm: float) -> dict[str, float]:
    """Distance in mm by which coverage falls short of `reach_mm` from a centre, per side, where at least a cell.

    Sides are named as on the map's picture: "the patient's left (-x)" with landmarks. A side is a sector of 90 degrees
    about its direction, and ends where less than `LEAST_SEEN` of its breadth is covered.
    """
    cell, mask = tactile_map.recipe.cell_mm, trusted_cells(tactile_map)
    dx, dy = tactile_map.x_mm - centre_mm[0], tactile_map.y_mm[:, None] - centre_mm[1]
    rings_mm = (np.arange(np.ceil(reach_mm / cell)) + 0.5) * cell
    least = np.maximum(LEAST_SEEN * 2 * np.arange(1, len(rings_mm)), 1)  # next to the corner one cell is enough
    shortfall, view = {}, orientation_of(tactile_map)
    for axis, (x, y) in SIDES.items():
        along, across = dx * x + dy * y, np.abs(dx * y - dy * x)
        ring = np.digitize(along[(across <= along) & mask], rings_mm)
        covered = np.bincount(ring, minlength=len(rings_mm))[1 : len(rings_mm)]
        open_rings = np.flatnonzero(covered < least)
        short = reach_mm - rings_mm[open_rings[0]] if len(open_rings) else 0.0
        if short >= cell:
            shortfall[view.side_words(axis)] = float(short)
    return shortfall


def rim_fault(tactile_map: TactileMap, bump: ModalBump, *, radius_mm: float) -> str:
    """Fault of a bump mostly beyond the map's rim, within a single cell, or of few readings; empty if none."""
    (narrow, wide), cell = sorted((bump.sigma_x_mm, bump.sigma_y_mm)), tactile_map.recipe.cell_mm
    centre_mm = bump.x_mm, bump.y_mm
    share = covered_share(tactile_map, centre_mm, radius_mm=1.5 * wide)
    if share < LEAST_COVERED_SHARE:
        return f"{AT_RIM} ({100 * share:.0f} % of the bump is covered, with a sigma of {wide:.3g} mm)"
    shortfall = coverage_shortfall(tactile_map, centre_mm, reach_mm=ENCLOSED_IN_WIDTHS * wide)
    if wide > WIDE_IN_RADII * radius_mm and shortfall:
        side, millimetres = max(shortfall.items(), key=lambda one: one[1])
        return f"{AT_RIM} (with a sigma of {wide:.3g} mm its flank to {side} is {millimetres:.0f} mm short)"
    if narrow < LEAST_WIDTH_IN_CELLS * cell:
        return NARROW.format(narrow, cell)
    typical = float(np.median(tactile_map.count[tactile_map.covered]))
    cells = window_cells(tactile_map, centre_mm, radius_mm=max(1.5 * wide, cell))
    typical_here = float(np.median(cells.count))
    if typical_here >= LEAST_READ * typical:
        return ""
    return f"{AT_RIM} (its cells hold {typical_here:g} readings, where {typical:g} are typical)"


def stroke_advice(shortfall: dict[str, float]) -> str:
    """Advice on the sides where the strokes end too early, the worst first; empty when none does."""
    parts = [f"{mm:.0f} mm to {side}" for side, mm in sorted(shortfall.items(), key=lambda one: -one[1]) if mm >= 0.5]
    return f"extend the strokes {' and '.join(parts[:2])}" if parts else ""


def undetected_reason(weighed: WeighedRise, *, where: str) -> Abstention:
    """Reason when noise, or a rib-like ridge, explains the map as well as a lump."""
    centre_mm, detection = weighed.centre_mm, weighed.detection
    rise = f"no lump found {where}: what rises {_near_text(centre_mm)} is"
    if detection.ridge:
        return Abstention("ridge", f"{rise} rather {detection.ridge}", FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, centre_mm)
    if detection.probability < DETECTED:
        reason = f"no lump found {where}: errors of the map explain what rises as well as a lump does"
        return Abstention("undetected", reason, FEEL_AGAIN, FEEL_AGAIN_ON_PAPER)
    if weighed.axis_ratio > MOST_AXIS_RATIO:
        return Abstention("ridge", f"{rise} a ridge, not a lump", FEEL_A_RIB, FEEL_A_RIB_ON_PAPER, centre_mm)
    reason = f"{rise} wider or less covered than a lump: uneven fat, a rib and the map's rim look so"
    return Abstention("undetected", reason, FEEL_AGAIN, FEEL_AGAIN_ON_PAPER, centre_mm)


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
    """Reason for widths beyond the cells' or a ridge's limit by a factor of `margin`; else None."""
    wide, narrow = max(x, y), min(x, y)
    if narrow * margin < LEAST_WIDTH_IN_CELLS * cell_mm:
        return _coarse(NARROW.format(narrow, cell_mm), narrow)
    if wide / narrow > MOST_AXIS_RATIO * margin:
        reason = f"what rises is a ridge, not a lump (sigma {wide:.3g} by {narrow:.3g} mm)"
        return Abstention("ridge", reason, FEEL_A_RIB, FEEL_A_RIB_ON_PAPER)
    return None


# --- Smallest lump that a map without one would have shown, by place and depth.
#
# A lump of a given size and depth makes a bump of known mean amplitude and width, with a spread over stiffnesses and
# bodies. The amplitude that has the evidence of a lump at a place follows from the map's coverage, readings and errors
# there; simulated lumps give the margin above it that most detected ones had.

PROBABILITY: Final = 0.95
DEPTHS_IN_FAT: Final = (0.5, 0.75, 1.0)
"""Depths of the lump's centre below the skin, over that of the fat: in it, and on its lower edge. In the gland a lump
that is no stiffer does not show."""
SIZES_MM: Final = np.arange(4.0, 30.5, 0.5)
LEAST_DEPTH_RATIO: Final = 0.56  #: Least simulated depth of a ball's centre, over its diameter.
USUAL_FAT_MM: Final = 15.0  #: Depth of fat where it is unknown.
LOG_AMPLITUDE: Final = (-2.61, 3.393, -3.27, 1.003, 0.251, -0.049, -0.983)
LOG_SIGMA: Final = (1.865, -0.168, 0.988, -0.155)
"""Coefficients of `lump_features`, and of its first four: ``python -m validation smallest_lump learn`` prints them."""
LOG_FACTOR: Final = 10.0
MARGIN: Final = 0.5
"""ln of the expected amplitude over that which `LOG_FACTOR` needs, above which 19 of 20 simulated lumps were detected:
it allows for stiffness, body, noise and the search (decision 0127)."""
MOST_PLACES: Final = 20
WIDTHS_MM: Final = np.geomspace(2.0, 12.0, 6)
AMPLITUDES: Final = np.geomspace(1e-3, 10.0, 120)
LEAST_CELLS, LEAST_SHARE, NEAR_MM = 100, 0.6, 7.5


class SmallestLumps(Record, eq=False):
    """Diameters in mm of the smallest ball that a map would have shown with `PROBABILITY`."""

    places_mm: FloatArray  #: (n, 2) array: In `plane`.
    depths_mm: FloatArray  #: (k,) array: Depths of the ball's centre below the skin.
    d_mm: FloatArray
    """(n, k) array: At each place for each depth; inf where not even the largest ball would have shown."""
    spacing_mm: float  #: Between the places.


def smallest_lumps(tactile_map: TactileMap, *, fat_mm: float | None = None) -> SmallestLumps:
    """Smallest ball that a map would have shown at places over its covered area, on fat of `fat_mm` (None: unknown)."""
    places, spacing = _places(tactile_map)
    needed = np.array([needed_amplitudes(tactile_map, (float(x), float(y))) for x, y in places])
    fat = USUAL_FAT_MM if fat_mm is None else fat_mm
    depths = np.round(fat * np.array(DEPTHS_IN_FAT))
    columns = [_smallest_shown(needed, float(depth), max(fat, float(depth))) for depth in depths]
    return SmallestLumps(places, depths, np.stack(columns, axis=1), spacing)


def _places(tactile_map: TactileMap) -> tuple[FloatArray, float]:
    """At most about `MOST_PLACES` covered places on a grid, and its spacing."""
    mask, cell = trusted_cells(tactile_map), tactile_map.recipe.cell_mm
    spacing = float(np.sqrt(mask.sum() * cell**2 / MOST_PLACES))
    rows, columns = np.nonzero(mask)
    x, y = tactile_map.x_mm[columns], tactile_map.y_mm[rows]
    middle = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
    numbers = (int(np.ptp(one) / spacing / 2) for one in (x, y))
    across, along = (centre + spacing * np.arange(-n, n + 1) for centre, n in zip(middle, numbers, strict=True))
    grid = [(a, b) for b in along for a in across]
    kept = [centre for centre in grid if covered_share(tactile_map, centre, radius_mm=NEAR_MM) >= LEAST_SHARE]
    return np.array(kept or [middle]), spacing


def largest_tried_mm(depth_mm: float) -> float:
    """Diameter of the largest ball that is tried with its middle at a depth."""
    return float(min(SIZES_MM[-1], floor(2 * depth_mm / LEAST_DEPTH_RATIO) / 2))


def _smallest_shown(needed: FloatArray, depth_mm: float, fat_mm: float) -> FloatArray:
    """(n,) least of `SIZES_MM` that shows at each place; inf where none does."""
    features = lump_features(SIZES_MM, depth_mm, fat_mm)
    log_a = features @ np.array(LOG_AMPLITUDE)
    log_sigma = np.clip(features[:, : len(LOG_SIGMA)] @ np.array(LOG_SIGMA), *np.log(WIDTHS_MM[[0, -1]]))
    fits = depth_mm >= LEAST_DEPTH_RATIO * SIZES_MM
    sizes = np.full(len(needed), np.inf)
    for i, row in enumerate(needed):
        threshold = np.interp(log_sigma, np.log(WIDTHS_MM), np.log(np.minimum(row, 1e9)))
        is_shown = (log_a - threshold >= MARGIN) & fits
        # the least size above which all sizes are shown
        hidden = np.flatnonzero(~is_shown & fits)
        first = 0 if not len(hidden) else int(hidden[-1]) + 1
        if first < fits.sum():
            sizes[i] = SIZES_MM[first]
    return sizes


def lump_features(d_mm: FloatArray, depth_mm: FloatArray | float, fat_mm: FloatArray | float) -> FloatArray:
    """(n, 7) features of balls in fat: log size, log depth and seat out of the gland, with products."""
    depth = np.broadcast_to(depth_mm, d_mm.shape)
    d, h, seat = np.log(d_mm / 10.0), np.log(depth / 15.0), np.tanh(2.0 * (fat_mm - depth) / d_mm)
    return np.stack([np.ones_like(d), d, h, seat, d * h, d**2, h**2], axis=-1)


def needed_amplitudes(tactile_map: TactileMap, centre_mm: tuple[float, float]) -> FloatArray:
    """(widths,) amplitude at which a bump of each of `WIDTHS_MM` at a place reaches `LOG_FACTOR`; inf if none.

    The factor is against the window's level, tilt and errors, without the correction for the search.
    """
    cells = window_cells(tactile_map, centre_mm, radius_mm=FIT_RADIUS_MM)
    if len(cells) < LEAST_CELLS:
        return np.full(len(WIDTHS_MM), np.inf)
    window = Window(cells, independent_variance(cells))
    problem = Problem(window, BumpPrior(), FIT_RADIUS_MM, value_scale(tactile_map))
    target = CollapsedTarget(problem, Scene("round"))
    target.select_lengths()
    theta = np.array([[log(width), *centre_mm] for width in WIDTHS_MM])
    _, _, power, _, _ = target.conditional(theta)
    amplitudes = AMPLITUDES * value_scale(tactile_map)
    factor = _log_factors(target, power[:, :, 0, 0], amplitudes)
    return np.array([np.interp(LOG_FACTOR, row, amplitudes, left=amplitudes[0], right=np.inf) for row in factor])


def _log_factors(target: CollapsedTarget, power: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """(widths, amplitudes) log Bayes factors of bumps put into the window, from their (widths, fields) powers."""
    null_dof, dof, sd = target.dof + 1, target.dof, target.amplitude_sd
    rest = np.concatenate([np.maximum(field.rest(), 0.0) + field.floor for field in target.fields])[:, None]
    base = np.concatenate([one.log_prior - 0.5 * one.log_det for one in target.fields])[:, None]
    p = power[:, :, None]
    null = base + lgamma(null_dof / 2) - 0.5 * null_dof * np.log(pi * (rest + p * amplitudes**2))
    variance = sd**2 + rest / dof / p
    lump = base + lgamma(dof / 2) - 0.5 * dof * np.log(pi * rest)
    lump = lump - 0.5 * (np.log(p) + np.log(2 * pi * variance) + amplitudes**2 / variance)
    return np.asarray(np.logaddexp.reduce(lump, axis=1) - np.logaddexp.reduce(null, axis=1))
