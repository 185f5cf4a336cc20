"""Calibrations in words."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.findings import first_of
from tactile_bayes.posterior.verdict import chance_text
from tactile_bayes.presets import HELD_OUT_PROBABILITY, INTERVAL, RESEARCH_USE
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import PAPER_SPREAD
from tactile_bayes.size.eq6 import COEFFICIENTS, AxisCalibration, LeftOutErrors, SizeCalibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import SiteShift

if TYPE_CHECKING:
    from tactile_bayes.files.size_json import RepeatabilityFile
    from tactile_bayes.size.learn.eq6 import OtherFit

# --- A site's correction of a size calibration as text for people.


def site_words(site: SiteShift, log_width: float | None = None) -> str:
    """The corrected calibration's name, the number of phantoms, and the correction with its interval.

    `log_width`: ln of the mean width in mm of the map in question; that of the phantoms where left out.
    """
    middle, low, high = site.percent(site.phantoms_log_width if log_width is None else log_width)
    by = f"{site.phantoms} phantoms of this site"
    return f"{site.base}, corrected by {by}: {round(middle):+d} % ({100 * INTERVAL:g} %: {round(low)} to {round(high)})"


def site_calibration_text(calibration: BodyCalibration) -> str:
    """Text of a site's correction: cautions, shift, slope, and the scatter that it leaves."""
    site = calibration.site
    assert site is not None
    (shift, slope), fit = site.mean, site.fit
    shift_sd, slope_sd = (float(site.covariance[i, i]) ** 0.5 for i in range(2))
    lines = [f"CAUTION: {text}" for text in site.cautions] + [
        f"{site_words(site)}, for maps as wide as theirs",
        f"added to ln d: {shift:+.3f} +- {shift_sd:.3f}, and {slope:+.3f} +- {slope_sd:.3f} times "
        f"(ln sigma {-site.centre:+.3f}), posterior mean +- SD",
    ]
    if fit:
        lines.append(
            f"ln d of the phantoms about the calibration, root mean square: {fit['sd_before']:.3f}, "
            f"corrected {fit['sd_after']:.3f}; their spread is {fit['spread_factor']:.1f} times the expected one"
        )
    maps = "" if site.maps == site.phantoms else f" ({site.maps} maps)"
    lines.append(f"{site.phantoms} phantoms{maps}; the depth of fat is {'' if site.uses_fat else 'not '}used")
    lines += [f"left out: {text}" for text in site.left_out]
    lines.append(f"recipe: {calibration.recipe}")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


# --- A site's repeatability as text for people.

_MOST_NAMED: Final = 5
FEW: Final = 5  #: Masses below which the report says that they are few.


def repeatability_text(site: RepeatabilityFile) -> str:
    """Text of a site's repeatability, learned from repeated exams."""
    median, low, high = (100 * one for one in (site.median, site.low, site.high))
    apart = [
        f"{repeat.name} (probability by chance {chance_text(repeat.by_chance, 4)})"
        for repeat in site.repeats
        if repeat.name in site.outlying
    ]
    lead = "CAUTION: exams lie further apart than the other masses lead one to expect; look at the maps of"
    lines = _names_lines(lead, apart)
    if site.masses < FEW:
        lines.append(f"CAUTION: {site.masses} masses are few; the interval of the spread is wide.")
    lines += [
        f"Exams of one mass differ by {median:.1f} % at this site (95 %: {low:.1f} to {high:.1f}): SD of ln d beyond "
        "the errors that each map has anyway.",
        f"Learned from {site.masses} masses and {site.maps} exams, sized by {site.calibration.name} "
        f"(frames normalised by {site.calibration.normalise}). Maps of one mass in the paper differed by "
        f"{100 * PAPER_SPREAD:.0f} %.",
    ]
    if (half := site.half_width) is not None:
        ends = f"about +-{100 * half.with_it:.0f} % of the size with it"
        own = f"the narrower one of its own report is +-{100 * half.as_estimated:.0f} %"
        lines.append(f"The 95 % interval of one exam: {ends}; {own}.")
    lines += _names_lines("Took no part", site.left_out)
    lines.append("Use it: tactile-bayes estimate MAP.nc --repeatability SITE.json")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _names_lines(lead: str, texts: Sequence[str]) -> list[str]:
    return [f"{lead}: {first_of(texts, _MOST_NAMED, '; ')}."] if texts else []


# --- A size calibration learned over a population of bodies as text for people.

UNKNOWN_NAMES = {
    "depth_mm": "depth",
    "stiffness_ratio": "the lump's stiffness",
    "seat": "seat",
    "fat_kpa": "modulus of fat",
    "gland_ratio": "modulus of gland",
    "thickness_mm": "thickness of the tissue",
}

BODY_NAMES = {
    "d_mm": "d (mm)",
    "depth_ratio": "h/d",
    "stiffness_ratio": "E2/E1",
    "seat": "seat",
    "fat_kpa": "fat (kPa)",
    "gland_ratio": "gland over fat",
    "thickness_mm": "thickness (mm)",
}


def body_calibration_text(calibration: BodyCalibration) -> str:
    """Text of a calibration over bodies: constants, spreads, cost of the unknowns, cross-validated errors, ranges."""
    fit, held = defaultdict(lambda: float("nan"), {"bodies": 0.0, "maps": 0.0} | dict(calibration.fit)), ""
    if "left_out_held_percent" in fit:
        held = f", {fit['left_out_held_percent']:.0f} % in their {100 * HELD_OUT_PROBABILITY:g} % interval"
    others = []
    if source := calibration.spread.other_source:
        others.append(
            f"bodies of another origin: SD of ln d {calibration.other_sd:.3f} more (below {fit['other_sd_most']:.3f} "
            f"with 95 % probability), by {source}: mean absolute error {fit['other_mae_percent']:.1f} %, bias "
            f"{fit['other_bias_percent']:+.1f} %, SD of standardised errors {fit['other_standard_sd']:.2f}"
        )
    lines = [
        *_eq6_lines(calibration),
        f"between bodies, SD of ln d {fit['body_sd']:.3f} (median; it changes with amplitude, width and depth), "
        f"between exams of a body {fit['exam_sd']:.3f}",
        *others,
        unknowns_text(calibration.unknowns),
        f"{fit['bodies']:.0f} bodies, {fit['maps']:.0f} maps; cross-validated by body: mean absolute error "
        f"{fit['left_out_mae_percent']:.1f} %, bias {fit['left_out_bias_percent']:+.1f} %{held}",
        *(f"{name}: {ends}" for name, ends in _ranges(calibration.domain)),
    ]
    bodies = [f"{BODY_NAMES.get(name, name)} {a:.3g} to {b:.3g}" for name, (a, b) in calibration.bodies.items()]
    lines += [f"bodies: {', '.join(bodies)}"] if bodies else []
    lines.append(f"recipe: {calibration.recipe}")
    lines.append(f"for maps made with {calibration.recipe.map_command}")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _eq6_lines(calibration: BodyCalibration) -> list[str]:
    """Constants of Eq 6, at several depths of fat where maps show the depth, and its residual."""
    alpha, p = calibration.centre.log_amplitude, calibration.centre.log_width
    sigma = f"sigma the geometric mean width, here {np.exp(p):.2g} mm"
    if calibration.depth is None:
        sd = np.sqrt(np.diag(calibration.eq6.covariance))
        return [
            f"Eq 6: d = m sigma / (e a^f) + b, {sigma}: {constants_text(calibration.constants())}",
            f"posterior SD: m/e {100 * sd[0]:.1f} %, f {sd[1]:.3f}, b {sd[2]:.2f} mm; u = ln a {-alpha:+.3f}",
        ]
    low, high = calibration.depth.fat_mm
    depths = [one for one in (6.0, 12.0, 24.0) if low <= one <= high]
    lines = [f"Eq 6: d = m sigma / (e a^f) + b, {sigma}; m, e and f change with the depth of the fat and with sigma"]
    lines += [f"  fat {depth:.3g} mm: {constants_text(calibration.constants(fat_mm=depth))}" for depth in depths]
    lines.append(f"the pressure over the head tells the depth of the fat to {100 * calibration.depth.log_sd:.1f} %")
    if calibration.residual is not None:
        count = len(calibration.residual.points)
        lines.append(f"what Eq 6 leaves: a Gaussian process in ln a, ln sigma and ln of the depth, of {count} points")
    return lines


def constants_text(constants: Mapping[str, float]) -> str:
    """m, b, e and f in words."""
    return "m {m:.2f}, b {b_mm:+.2f} mm, e {e:.3f}, f {f:.3f}".format(**constants)


def calibration_line(name: str, calibration: Calibration, *, sigma_mm: float) -> str:
    """The calibration that sized a map of this mean width, with its constants and unknowns."""
    line = f"Sizes by the {name}"
    if isinstance(calibration, BodyCalibration):
        head = "" if calibration.recipe.head is None else f"; for a head of {calibration.recipe.head}"
        line += f" ({calibration.source}{head}); "
        beside = "" if calibration.residual is None else " and its residual"
        line += f"Eq 6 for this map: {constants_text(calibration.constants(sigma_mm))}{beside}; "
        line += unknowns_text(calibration.unknowns, calibration.fat_mm)
    return line


def unknowns_text(unknowns: Mapping[str, float], fat_mm: float | None = None) -> str:
    """Depth of the fat that sizes use, and the variance that knowing each property would remove, largest first."""
    ranked = sorted(unknowns.items(), key=lambda pair: -pair[1])
    parts = [f"{UNKNOWN_NAMES.get(name, name)} {100 * share:.0f} %" for name, share in ranked if share >= 0.005]
    depth = f"fat under the head {fat_mm:.1f} mm deep, from the pressure profile away from the lump; " if fat_mm else ""
    return (
        f"{depth}share of the variance between bodies that knowing one property removes: {', '.join(parts) or 'none'}"
    )


# --- A size calibration as text for people.

LABELS = {
    "m": "m",
    "b_mm": "b, mm",
    "e": "e",
    "f": "f",
    "scatter": "residual SD of ln d",
    "scatter_slope": "  its slope with ln a",
}


def calibration_text(
    calibration: SizeCalibration, *, not_left_out: str = "", other_fit: OtherFit | None = None, table_rows: int = 0
) -> str:
    """Text of a size calibration: fit, domain and r2 of each axis, and recipe.

    `not_left_out`: why the table's geometries could not be left out in turn, where that is so; `other_fit`: what the
    other of the two fits makes of the same rows; `table_rows`: of the table, those left out too.
    """
    method = "two-stage fit as printed +- SD of a bootstrap" if calibration.in_two_stages else "posterior mean +- SD"
    lines = [] if calibration.left_out is None else _left_out_lines(calibration.left_out)
    lines.append(f"Eq 6: d = m sigma / (e a^f) + b, {method}")
    both = calibration.axes == ("both",)
    axes = [("both axes", calibration.x)] if both else [("across, x", calibration.x), ("along, y", calibration.y)]
    columns = [[name, *_column(axis)] for name, axis in axes]
    heads = ["", *(LABELS[name] for name in COEFFICIENTS), "r2 of ln d", "mean absolute error", "rows"]
    heads += [name for name, _ in _ranges(calibration.x.domain)]
    for head, *cells in zip(heads, *columns, strict=True):
        lines.append(f"{head:24}" + "".join(f"{cell:>22}" for cell in cells))
    if (rows := int(calibration.x.fit.get("rows", 0))) < table_rows:
        why = "no positive amplitude, not detectable, or softer than asked for"
        lines.append(f"left out: {table_rows - rows} of the table's {table_rows} rows ({why})")
    lines.append(f"residual SD is given at amplitude {calibration.x.reference_amplitude:.3g}; fainter maps tell less")
    if not both:
        lines.append(f"correlation of the two residuals {calibration.residual_correlation:.2f}")
    if not calibration.x.fit.get("e_identified"):
        lines.append("the table has no depths: only m/e is determined, e is 1 by convention")
    if other_fit is not None:
        words = {"two-stage": "two-stage fit as printed", "joint": "joint fit of all rows"}[other_fit.name]
        fits = [f"m {m:.2f}, b {b:.2f} mm, e {e:.3f}, f {f:.3f}" for m, b, e, f in other_fit.coefficients]
        differences = " and ".join(f"{100 * share:.0f} %" for share in other_fit.difference)
        lines.append(f"{words}: {'; along '.join(fits)}; sizes differ by {differences} of d on average")
    if not_left_out:
        lines.append(f"leave one geometry out: not known, {not_left_out}")
    recipe = calibration.recipe
    method = "declared" if recipe.declared else "as the maps were made here"
    lines.append(f"recipe ({method}): {recipe}")
    lines.append(f"for maps made with {recipe.map_command}, on which `estimate` fits by this recipe itself")
    lines += [f"CAUTION: {text}" for text in calibration.cautions]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _left_out_lines(errors: LeftOutErrors) -> list[str]:
    """Cross-validated mean absolute error of both forms, by both widths and by each."""
    names = {"both": "", "x": "by the width across alone, ", "y": "by the width along alone, "}
    parts = [
        f"{words}Eq 6 {100 * errors.eq6[widths]:.1f} %, log-quadratic {100 * errors.log_quadratic[widths]:.1f} %"
        for widths, words in names.items()
        if widths in errors.eq6
    ]
    which = f"{errors.cases} cases of E2/E1 >= {errors.least_stiffness_ratio:g}"
    return [f"leave one geometry out: {parts[0]} of d ({errors.geometries} geometries, {which})", *parts[1:]]


def _column(axis: AxisCalibration) -> Iterator[str]:
    """Cells of one axis: coefficients, how well they fit, and ranges."""
    for draws in axis.draws[:, : len(COEFFICIENTS)].T:
        yield f"{draws.mean():.3f} +- {draws.std():.3f}"
    yield f"{axis.fit.get('r2', float('nan')):.2f}"
    yield f"{axis.fit.get('mae_percent', float('nan')):.0f} %"
    yield f"{axis.fit.get('rows', 0):.0f}"
    yield from (ends for _, ends in _ranges(axis.domain))


def _ranges(domain: Mapping[str, tuple[float, float]]) -> Iterator[tuple[str, str]]:
    """Names and ends of the ranges that a calibration holds for."""
    for name, unit in (("amplitude", ""), ("sigma_mm", " mm"), ("d_mm", " mm")):
        low, high = domain[name]
        yield f"range of {name.removesuffix('_mm')}", f"{low:.3g} to {high:.3g}{unit}"
