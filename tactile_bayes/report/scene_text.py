"""Sentences and plain data about the scene in the fit window."""

from __future__ import annotations

import math
from typing import Any

from tactile_bayes.posterior.correlated.noise import LENGTHS_MM, SHARES
from tactile_bayes.posterior.correlated.selection import SceneChoice, Structure
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.sensitivity import Sensitivity

ASKED = {
    "ellipse": "an ellipse, not a circle",
    "rotated": "a rotated ellipse",
    "tilt": "a sloping level",
    "second lump": "a second lump in this window",
    "rib": "a rib in this window",
    "departure": "a departure from a Gaussian",
}
BUMP = {"round": "a round bump", "ellipse": "an ellipse along the head's axes", "rotated": "a rotated ellipse"}
LEAST_SHIFT_SD = 0.005
"""A shift by a wider prior below this is not given in figures."""
LEAST_CHANGE_SD = 0.05
"""A change of a width by one more structure below this rounds to none."""


def scene_lines(choice: SceneChoice) -> list[str]:
    """Scene of the fit window with odds: structures supported, other structures kept, and those left out."""
    used = _named(choice)
    names = [BUMP[choice.supported], *(f"{ASKED[one.name]} {one.place}".rstrip() for one in used)]
    window = f"the fit window of {choice.fit.target.problem.radius_mm:g} mm about the lump"
    lines = [f"Scene in {window}: {' and '.join(names)}, the simplest that the map supports."]
    for one in used:
        lines.append(f"{_sentence(ASKED[one.name])} is in the model (odds {odds_text(one)}){_change(one, 'without')}.")
    kept = [one for one in choice.structures if one.used and not one.supported and not one.place]
    lines += [f"Also in the model: {ASKED[one.name]} (odds {odds_text(one)}){_change(one, 'without')}." for one in kept]
    out = [
        f"{ASKED[one.name]} (odds {odds_text(one)}){_change(one, 'with')}" for one in choice.structures if not one.used
    ]
    return [*lines, f"Not in the model: {'; '.join(out)}."] if out else lines


def scene_line(choice: SceneChoice) -> str:
    """Scene of the fit window in one line: structures supported, and those not needed."""
    used = _named(choice)
    names = [BUMP[choice.supported], *(ASKED[one.name] for one in used)]
    near = f" within {choice.fit.target.problem.radius_mm:g} mm"
    out = [ASKED[one.name].replace(" in this window", near) for one in choice.structures if not one.used]
    return f"The map supports {' and '.join(names)}" + (f"; not needed: {', '.join(out)}." if out else ".")


def _named(choice: SceneChoice) -> list[Structure]:
    """Structures to name beside the bump: in the model because the map supports them."""
    return [one for one in choice.structures if one.used and (one.place or (one.name == "tilt" and one.supported))]


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def odds_text(one: Structure) -> str:
    """Format a Bayes factor with no more digits than it is worth."""
    if one.odds < 0.01:
        return "below 0.01 to 1"
    if one.odds > 1000:
        return "above 1000 to 1"
    return f"{'at most ' if one.bound else ''}{one.odds:.2g} to 1"


def _change(one: Structure, word: str) -> str:
    if one.change_x_sd is None or one.change_y_sd is None:
        return ""
    changes = {"sigma_x": one.change_x_sd, "sigma_y": one.change_y_sd}
    told = [f"{name} would change by {by:+.1f} SD" for name, by in changes.items() if abs(by) >= LEAST_CHANGE_SD]
    return f": {word} it {' and '.join(told) or 'the widths would not change'}"


def sensitivity_line(found: Sensitivity) -> str:
    """Sensitivity of the result to the prior of the widths."""
    names = {"max_size_mm": "the largest size", "sigma_x_mm": "sigma_x", "sigma_y_mm": "sigma_y"}
    name = next((name for name in names if name in found.median), None)
    if name is None:
        return ""
    median, ends = found.median[name], found.ends[name]
    if max(abs(median), abs(ends)) < LEAST_SHIFT_SD:
        return f"A width prior twice as wide would move {names[name]} by less than {LEAST_SHIFT_SD:g} SD."
    return (
        f"A width prior twice as wide would move the median of {names[name]} by {round(median, 2) + 0.0:+.2f} SD "
        f"and its interval's ends by up to {round(ends, 2) + 0.0:+.2f} SD."
    )


def prior_line(prior: BumpPrior, *, field: bool) -> str:
    """All priors of the map's posterior."""
    parts = [
        f"amplitude normal about 0 with SD {prior.amplitude_sd:g} of the map's scale",
        f"mean width log-normal about {prior.width_median_mm:g} mm with SD {prior.log_width_sd:g} of its log",
        f"half the log axis ratio normal with SD {prior.log_ratio_sd:g}",
        "centre uniform in the window",
        "noise scale 1/tau",
    ]
    if field:
        parts += [
            "level and tilt flat",
            f"the odds of a tilt with SD {prior.tilt_sd:g} of the map's scale over half a window",
            f"correlation length {', '.join(f'{length:g}' for length in LENGTHS_MM)} mm equally likely",
            f"share of the field {len(SHARES)} values from 0 to {SHARES[-1]:g} equally likely",
        ]
    return f"Priors: {'; '.join(parts)}."


def scene_document(choice: SceneChoice) -> dict[str, Any]:
    """Scene as plain data for the JSON."""
    scene = choice.fit.scene
    return {
        "supported": choice.supported,
        "shape": scene.shape,
        "tilt": scene.tilt,
        "beside": scene.extra or None,
        "structures": [_structure(one) for one in choice.structures],
    }


def _structure(one: Structure) -> dict[str, Any]:
    return {
        "name": one.name,
        "odds": _finite(one.odds),
        "odds_are_a_bound": one.bound,
        "supported": one.supported,
        "used": one.used,
        "change_sigma_x_sd": _finite(one.change_x_sd),
        "change_sigma_y_sd": _finite(one.change_y_sd),
        "place": one.place,
    }


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.6g}")
