"""A size calibration learned over a population of bodies as text for people."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.presets import HELD, RESEARCH_USE
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.calibration import Calibration
from tactile_bayes.size.fat_depth import FatTerms
from tactile_bayes.size.fat_process import FatProcess
from tactile_bayes.size.log_quadratic import QUADRATIC
from tactile_bayes.size.population_eq6 import PopulationEq6

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
    """Coefficients, spreads, what the unknowns cost, and the errors on masses left out."""
    fit = calibration.fit
    body_sd, slope, exam_sd = calibration.mean[calibration.coefficients :]
    lines = [
        *(_eq6_lines(calibration) if isinstance(calibration, PopulationEq6) else _quadratic_lines(calibration)),
        f"between bodies, SD of ln d {np.exp(body_sd):.3f} (times e^({slope:+.2f} u)), "
        f"between exams of a body {np.exp(exam_sd):.3f}",
        unknowns_text(calibration.unknowns),
        f"{fit.get('bodies', 0):.0f} bodies, {fit.get('maps', 0):.0f} maps; {_left_out_text(fit)}",
    ]
    for name, unit in (("amplitude", ""), ("sigma_mm", " mm"), ("d_mm", " mm")):
        low, high = calibration.domain[name]
        lines.append(f"range of {name.removesuffix('_mm')}: {low:.3g} to {high:.3g}{unit}")
    lines += _bodies_lines(calibration.bodies)
    lines.append(f"recipe: {calibration.recipe}")
    lines.append(f"for maps made with {calibration.recipe.map_command}")
    if calibration.with_fat is not None:
        lines += _fat_lines(calibration, calibration.with_fat)
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _bodies_lines(bodies: Mapping[str, tuple[float, float]]) -> list[str]:
    """Ranges of the bodies in one line; none where a file of an earlier version does not name them."""
    parts = [f"{BODY_NAMES.get(name, name)} {low:.3g} to {high:.3g}" for name, (low, high) in bodies.items()]
    return [f"bodies: {', '.join(parts)}"] if parts else []


def _quadratic_lines(calibration: BodyCalibration) -> list[str]:
    """The coefficients of the quadratic."""
    (alpha, p), sd = calibration.centre, np.sqrt(np.diag(calibration.covariance))
    terms = ("", "u", "v", "u^2", "u v", "v^2")
    assert len(terms) == len(QUADRATIC)
    return [
        f"ln d in mm, posterior mean +- SD, with u = ln a {-alpha:+.3f}, v = ln sigma {-p:+.3f} (geometric mean width)",
        *(f"{term or 'constant':>10} {calibration.mean[i]:8.3f} +- {sd[i]:.3f}" for i, term in enumerate(terms)),
    ]


def _eq6_lines(calibration: PopulationEq6) -> list[str]:
    """The constants of Eq 6."""
    (alpha, _), sd = calibration.centre, np.sqrt(np.diag(calibration.covariance))
    constants = constants_text(calibration.constants())
    return [
        f"Eq 6: d = m sigma / (e a^f) + b, sigma the geometric mean width: {constants}",
        f"posterior SD: m/e {100 * sd[0]:.1f} %, f {sd[1]:.3f}, b {sd[2]:.2f} mm; u = ln a {-alpha:+.3f}",
    ]


def constants_text(constants: Mapping[str, float]) -> str:
    """m, b, e and f in words."""
    return "m {m:.2f}, b {b_mm:+.2f} mm, e {e:.3f}, f {f:.3f}".format(**constants)


def _left_out_text(fit: Mapping[str, float]) -> str:
    held = ""
    if "left_out_held_percent" in fit:
        held = f", {fit['left_out_held_percent']:.0f} % in their {100 * HELD:g} % interval"
    return (
        "cross-validated by body: "
        f"mean absolute error {fit.get('left_out_mae_percent', float('nan')):.1f} %, "
        f"bias {fit.get('left_out_bias_percent', float('nan')):+.1f} %{held}"
    )


def _fat_lines(calibration: BodyCalibration, fat: FatTerms) -> list[str]:
    """What knowing the depth of the fat, from the pressure over the head, does to all that."""
    low, high = fat.fat_mm
    how = "a cubic in u, v and its log"
    if isinstance(calibration, PopulationEq6):
        how = "m and f by its logarithm and v"
    elif isinstance(fat, FatProcess):
        how = "a Gaussian process in u, v and the pressure profile; ln SD between bodies a quadratic"
    lines = [
        f"for maps that give the depth of the fat, {low:.3g} to {high:.3g} mm, "
        f"to {100 * fat.depth.log_sd:.1f} %: {how}",
        f"between bodies, SD of ln d {fat.fit.get('body_sd', float('nan')):.3f}, "
        f"between exams of a body {fat.fit.get('exam_sd', float('nan')):.3f}; {_left_out_text(fat.fit)}",
    ]
    if isinstance(fat, FatProcess) and fat.with_places is not None:
        lines.append(f"for maps that also keep frames with the lump: {_left_out_text(fat.with_places.fit)}")
    return lines


def calibration_line(name: str, calibration: Calibration, *, sigma_mm: float) -> str:
    """Which calibration gave the size of a map with this mean width, and what it cannot know."""
    line = f"Sizes by the {name}"
    if isinstance(calibration, BodyCalibration):
        head = "" if calibration.recipe.head is None else f"; for a head of {calibration.recipe.head}"
        line += f" ({calibration.source}{head}); "
        if isinstance(calibration, PopulationEq6):
            line += f"Eq 6 for this map: {constants_text(calibration.constants(sigma_mm))}; "
        line += (
            f"{fat_text(calibration.fat_mm, by_place=calibration.knows_places)}{unknowns_text(calibration.unknowns)}"
        )
    return line


def fat_text(fat_mm: float | None, *, by_place: bool) -> str:
    """What the frames told for the sizes, as the beginning of `unknowns_text`; empty where nothing of it is used."""
    if fat_mm is None:
        return ""
    more = "how the lump feels under each part of the head is used; " if by_place else ""
    return f"fat under the head {fat_mm:.1f} mm deep, from the pressure profile away from the lump; {more}"


def unknowns_text(unknowns: Mapping[str, float]) -> str:
    """Share of the variance between bodies that knowing each property would remove, largest first."""
    ranked = sorted(unknowns.items(), key=lambda pair: -pair[1])
    parts = [f"{UNKNOWN_NAMES.get(name, name)} {100 * share:.0f} %" for name, share in ranked if share >= 0.005]
    return "share of the variance between bodies that knowing one property removes: " + (", ".join(parts) or "none")
