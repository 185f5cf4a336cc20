"""A log-quadratic size calibration as text for people."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tactile_bayes.presets import HELD, RESEARCH_USE
from tactile_bayes.size.calibration import Calibration
from tactile_bayes.size.fat_depth import FatCubic
from tactile_bayes.size.log_quadratic import QUADRATIC, LogQuadratic

UNKNOWN_NAMES = {
    "depth_mm": "depth",
    "stiffness_ratio": "the lump's stiffness",
    "seat": "seat",
    "fat_kpa": "modulus of fat",
    "gland_ratio": "modulus of gland",
    "thickness_mm": "thickness of the tissue",
}


def log_quadratic_text(calibration: LogQuadratic) -> str:
    """Coefficients, spreads, what the unknowns cost, and the errors on masses left out."""
    fit, (alpha, p) = calibration.fit, calibration.centre
    sd = np.sqrt(np.diag(calibration.covariance))
    terms = ("", "u", "v", "u^2", "u v", "v^2")
    lines = [
        f"ln d in mm, posterior mean +- SD, with u = ln a {-alpha:+.3f}, v = ln sigma {-p:+.3f} (geometric mean width)",
        *(f"{term or 'constant':>10} {calibration.mean[i]:8.3f} +- {sd[i]:.3f}" for i, term in enumerate(terms)),
        f"between bodies, SD of ln d {np.exp(calibration.mean[6]):.3f} (times e^({calibration.mean[7]:+.2f} u)), "
        f"between exams of a body {np.exp(calibration.mean[8]):.3f}",
        unknowns_text(calibration.unknowns),
        f"{fit.get('bodies', 0):.0f} bodies, {fit.get('maps', 0):.0f} maps; {_left_out_text(fit)}",
    ]
    for name, unit in (("amplitude", ""), ("sigma_mm", " mm"), ("d_mm", " mm")):
        low, high = calibration.domain[name]
        lines.append(f"range of {name.removesuffix('_mm')}: {low:.3g} to {high:.3g}{unit}")
    lines.append(f"recipe: {calibration.recipe}")
    if calibration.fat_cubic is not None:
        lines += _fat_lines(calibration.fat_cubic)
    assert len(terms) == len(QUADRATIC)
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _left_out_text(fit: Mapping[str, float]) -> str:
    held = ""
    if "left_out_held_percent" in fit:
        held = f", {fit['left_out_held_percent']:.0f} % in their {100 * HELD:g} % interval"
    return (
        "cross-validated by body: "
        f"mean absolute error {fit.get('left_out_mae_percent', float('nan')):.1f} %, "
        f"bias {fit.get('left_out_bias_percent', float('nan')):+.1f} %{held}"
    )


def _fat_lines(cubic: FatCubic) -> list[str]:
    """What knowing the depth of the fat, from the pressure over the head, does to all that."""
    low, high = cubic.fat_mm
    fit = cubic.fit
    return [
        f"for maps that give the depth of the fat, {low:.3g} to {high:.3g} mm, to {100 * cubic.depth.log_sd:.1f} %: "
        "ln d as a cubic in u, v and its logarithm",
        f"between bodies, SD of ln d {fit.get('body_sd', float('nan')):.3f}, "
        f"between exams of a body {fit.get('exam_sd', float('nan')):.3f}; {_left_out_text(fit)}",
    ]


def calibration_line(name: str, calibration: Calibration, *, shipped: bool) -> str:
    """Which calibration gave the size, and what it cannot know."""
    line = f"Sizes by the {'shipped calibration ' if shipped else 'calibration '}{name}"
    if isinstance(calibration, LogQuadratic):
        line += f" ({calibration.source}); {fat_text(calibration.fat_mm)}{unknowns_text(calibration.unknowns)}"
    return line


def fat_text(fat_mm: float | None) -> str:
    """The depth of fat that the sizes are for, as the beginning of `unknowns_text`; nothing where it is not used."""
    if fat_mm is None:
        return ""
    return f"fat under the head {fat_mm:.1f} mm deep, from the pressure profile away from the lump; "


def unknowns_text(unknowns: Mapping[str, float]) -> str:
    """The share of the variance between bodies that knowing each property would remove, largest first."""
    ranked = sorted(unknowns.items(), key=lambda pair: -pair[1])
    parts = [f"{UNKNOWN_NAMES.get(name, name)} {100 * share:.0f} %" for name, share in ranked if share >= 0.005]
    return "share of the variance between bodies that knowing one property removes: " + (", ".join(parts) or "none")
