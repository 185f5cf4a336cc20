"""An estimate as a document: its masses and scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tactile_bayes.declarations import as_dict
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import verdict
from tactile_bayes.geometry import apply
from tactile_bayes.inference.draws import Quantity, nine_digits
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import ClockPosition
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.field import LENGTHS_MM, SHARES
from tactile_bayes.posterior.result import Estimate, Mass, Sensitivity
from tactile_bayes.posterior.selection import SceneChoice, Structure
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.quantities import (
    ANOTHER_EXAM,
    WIDTHS,
    another_exam,
    estimate_quantities,
    leading,
    lump_place,
    together_words,
    touching_masses,
)
from tactile_bayes.size.draws import SIZES, SizePosterior

# --- Sentences and plain data about the scene in the fit window.

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
        "odds": _six_digits(one.odds),
        "odds_are_a_bound": one.bound,
        "supported": one.supported,
        "used": one.used,
        "change_sigma_x_sd": _six_digits(one.change_x_sd),
        "change_sigma_y_sd": _six_digits(one.change_y_sd),
        "place": one.place,
    }


def _six_digits(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.6g}")


# --- How large a lump would be if it were soft, hard, centred on the gland's surface or resting on it: data and text.

LEAST_CHANGE = 0.02
"""Of the size, from which a pair of suppositions is worth a line."""
PAIRS = (
    ("the lump soft", "soft", "hard", " ({:g} times as stiff as fat)", " ({:g} times)"),
    ("it centred on the gland's surface", "centred", "resting", "", " on the gland"),
)
"""Of suppositions, with the words of the first, and what follows each, a value in it."""


def supposed_document(size: SizePosterior | None, largest: Quantity | None) -> dict[str, Any] | None:
    """The property that is supposed, its value, and the largest size with it, by name; None without a size."""
    if size is None or largest is None:
        return None
    ends = {"median": largest.median, "low": largest.low, "high": largest.high}
    return {
        label: {
            "property": one.name,
            "value": one.value,
            "max_size_mm": {
                **{name: nine_digits(one.moved(end, median_mm=largest.median)) for name, end in ends.items()},
                "probability": largest.probability,
            },
        }
        for label, one in size.supposing.items()
    }


def supposed_lines(supposed: Mapping[str, Any] | None, median_mm: float, *, places: int) -> list[str]:
    """A line for each pair of suppositions that moves the largest size."""
    found = []
    for words, first, second, *follow in PAIRS:
        pair = _pair(supposed, median_mm, (first, second))
        if pair:
            values = [after.format(one["value"]) for after, one in zip(follow, pair, strict=True)]
            sizes = [_size(one["max_size_mm"], places) for one in pair]
            found.append(f"Were {words}{values[0]}: {sizes[0]}; {second}{values[1]}: {sizes[1]}.")
    return found


def supposed_line(supposed: Mapping[str, Any] | None, median_mm: float, *, places: int) -> list[str]:
    """A soft lump's size and a hard one's in a few words, for a short report; empty where they hardly differ.

    A lump softer than the calibration's may lie above the interval, and nothing on its map says so: the line does.
    """
    pair = _pair(supposed, median_mm, ("soft", "hard"))
    if not pair:
        return []
    (soft, soft_ratio), (hard, hard_ratio) = ((one["max_size_mm"]["median"], one["value"]) for one in pair)
    words = (
        f"No map shows stiffness: were the lump soft ({soft_ratio:g} times fat), {soft:.{places}f} mm; "
        f"hard ({hard_ratio:g} times), {hard:.{places}f} mm"
    )
    return [f"{words}; softer still, larger." if soft > hard else f"{words}."]


def _pair(supposed: Mapping[str, Any] | None, median_mm: float, names: tuple[str, str]) -> list[Mapping[str, Any]]:
    """Two suppositions, where one of them at least moves the largest size; empty otherwise."""
    pair = [] if supposed is None else [supposed[name] for name in names if name in supposed]
    moves = any(abs(one["max_size_mm"]["median"] / median_mm - 1) >= LEAST_CHANGE for one in pair)
    return pair if moves and len(pair) == 2 else []


def _size(size: Mapping[str, float], places: int) -> str:
    return "{median:.{0}f} mm ({low:.{0}f} to {high:.{0}f})".format(places, **size)


# --- The masses of a map as plain data, and in sentences.

MassDocument = Mapping[str, Any]


def masses_document(
    masses: Sequence[Mass],
    tactile_map: TactileMap,
    *,
    probability: float,
    quantities: Mapping[str, Quantity],
    reason: str,
    scans: Sequence[Mapping[str, str]] = (),
) -> list[dict[str, Any]]:
    """JSON objects of a map's masses, numbered in their order; see data_schema/estimate.schema.json.

    Parameters
    ----------
    quantities, reason
        Of the reported mass, as the estimate has them.
    scans
        The scans at the beginning, which say which breast it is.
    """
    found = []
    for number, mass in enumerate(masses, start=1):
        own = quantities if mass.reported else estimate_quantities(mass.estimate, tactile_map, probability=probability)
        place = lump_place(mass.estimate.map_posterior, tactile_map, scans)
        why = reason if mass.reported else mass.estimate.reason
        position = None if place is None else place.as_dict(probability)
        found.append({"number": number, **_mass(mass, tactile_map, own, why), "position": position})
    return found


def _mass(mass: Mass, tactile_map: TactileMap, quantities: Mapping[str, Quantity], reason: str) -> dict[str, Any]:
    estimate = mass.estimate

    def one(name: str) -> dict[str, Any] | None:
        return quantities[name].as_dict() if name in quantities else None

    patient = patient_mm(tactile_map, mass.x_mm, mass.y_mm)
    return {
        "reported": mass.reported,
        "centre_mm": {"x": nine_digits(mass.x_mm), "y": nine_digits(mass.y_mm)},
        "centre_patient_mm": None if patient is None else {"x": nine_digits(patient[0]), "y": nine_digits(patient[1])},
        "detected_probability": nine_digits(mass.probability),
        "amplitude": one("amplitude"),
        **{name: one(name) for name in SIZES},
        "angle_deg": one("angle_deg"),
        ANOTHER_EXAM: another_exam(estimate.size, quantities),
        "reason": reason if estimate.size is None else "",
        "reason_code": estimate.code,
        "advice": estimate.advice,
    }


def patient_mm(tactile_map: TactileMap, x_mm: float, y_mm: float) -> tuple[float, float] | None:
    """A place on the map in mm from the xiphoid, to the patient's right and up; None without landmarks."""
    if tactile_map.patient_from_plane is None:
        return None
    x, y, _ = apply(tactile_map.patient_from_plane, np.array([x_mm, y_mm, 0.0]))
    return float(x), float(y)


def others(masses: Sequence[MassDocument]) -> list[MassDocument]:
    """The masses besides the reported one."""
    return [one for one in masses if not one["reported"]]


def mass_lines(masses: Sequence[MassDocument]) -> list[str]:
    """One line per mass besides the reported one: place, size or why there is none, probability."""
    here = next((one for one in masses if one["reported"]), None)
    return [f"Mass {one['number']} {mass_words(one, here)}." for one in others(masses)]


def mass_words(mass: MassDocument, here: MassDocument | None) -> str:
    """A mass's place, its distance from the reported one, its size or why it has none, and its probability."""
    x, y = (mass["centre_mm"][axis] for axis in "xy")
    place = f"at ({x:.1f}, {y:.1f}) mm"
    if here is not None:
        away = np.hypot(x - here["centre_mm"]["x"], y - here["centre_mm"]["y"])
        place += f", {away:.0f} mm from mass {here['number']}"
    if mass.get("position") is not None:
        place += f" ({mass['position']['text']})"
    size = leading(mass)["max_size_mm"]
    if size is None:
        told = f"no size: {mass['reason']}"
    else:
        share = f"{100 * size['probability']:g} %"
        told = f"largest size {size['median']:.1f} mm ({share} interval {size['low']:.1f} to {size['high']:.1f} mm)"
    if here is not None:
        for pair in touching_masses([here, mass]):
            told += f"; may be one lump with mass {here['number']}, {together_words(pair)}"
    return f"{place}: {told}; probability of a lump {chance_text(mass['detected_probability'])}"


def numbered(masses: Sequence[MassDocument]) -> str:
    """Which of the masses is reported, in words; empty where it is the only one."""
    here = next((one for one in masses if one["reported"]), None)
    return "" if here is None or len(masses) == 1 else f"Mass {here['number']} of {len(masses)}"


# --- An estimate as plain data: the object that `estimate --json` prints.

SCHEMA = "tactile-bayes/estimate/1"


def estimate_document(
    estimate: Estimate,
    tactile_map: TactileMap,
    *,
    probability: float,
    prior: BumpPrior,
    provenance: Provenance,
    quantities: Mapping[str, Quantity] | None = None,
    place: ClockPosition | None = None,
) -> dict[str, Any]:
    """JSON object of one map, see data_schema/estimate.schema.json; `quantities` if already summarised."""
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)

    def one(name: str) -> dict[str, float | str] | None:
        return quantities[name].as_dict() if name in quantities else None

    def point(name: str) -> dict[str, Any] | None:
        return {axis: one(f"{name}.{axis}") for axis in "xy"} if f"{name}.x" in quantities else None

    about = estimate.about_mm
    share = estimate.size.variance_share if estimate.size is not None else None
    masses = masses_document(
        estimate.masses,
        tactile_map,
        probability=probability,
        quantities=quantities,
        reason=estimate.reason,
        scans=provenance.scans,
    )
    return {
        "schema": SCHEMA,
        "status": estimate.status,
        "verdict": verdict(estimate.findings, answered=estimate.size is not None),
        "findings": [one.as_dict() for one in estimate.findings],
        "reason": estimate.reason,
        "reason_code": estimate.code,
        "advice": estimate.advice,
        "on_paper": estimate.on_paper,
        "about_mm": None if about is None else {"x": nine_digits(about[0]), "y": nine_digits(about[1])},
        "smallest_lump": None if estimate.smallest is None else estimate.smallest.as_dict(),
        **{name: one(name) for name in (*SIZES, *WIDTHS)},
        ANOTHER_EXAM: another_exam(estimate.size, quantities),
        "supposing": supposed_document(estimate.size, quantities.get("max_size_mm")),
        "centre_mm": point("centre_mm"),
        "centre_patient_mm": point("centre_patient_mm"),
        "position": None if place is None else place.as_dict(probability),
        "angle_deg": one("angle_deg"),
        "detected_probability": None if estimate.probability is None else nine_digits(estimate.probability),
        "variance_share": None if share is None else {k: nine_digits(v) for k, v in share.items()},
        "scene": None if estimate.scene is None else scene_document(estimate.scene),
        "prior_sensitivity": None if estimate.sensitivity is None else rounded(estimate.sensitivity.as_dict()),
        "diagnostics": _diagnostics(estimate),
        "candidates": [
            {"x_mm": nine_digits(c.centre_mm[0]), "y_mm": nine_digits(c.centre_mm[1]), "fault": c.fault}
            for c in estimate.candidates
        ],
        "other_rises": [rise.as_dict() for rise in estimate.other_rises],
        "masses": masses,
        "touching": touching_masses(masses),
        "left_out": list(estimate.left_out),
        "prior": as_dict(prior),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def rounded(value: Any) -> Any:
    """Plain data with its numbers rounded to nine significant digits."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return nine_digits(value) if isinstance(value, float) else value


def _diagnostics(estimate: Estimate) -> dict[str, Any]:
    """Diagnostics for the JSON; a figure that is not finite is null."""
    found: dict[str, Any] = {} if estimate.diagnostics is None else estimate.diagnostics.as_dict()
    if estimate.detection is not None:
        found["log_bayes_factor"] = estimate.detection.log_bayes_factor
    return _finite(found) | ({} if estimate.size is None else size_diagnostics(estimate.size))


def size_diagnostics(size: SizePosterior) -> dict[str, Any]:
    """What the diagnostics say of a size; a figure that is not finite is null."""
    return _finite({"invalid_draws": size.invalid, **size.figures})


def _finite(found: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: (nine_digits(value) if math.isfinite(value) else None) if isinstance(value, float) else value
        for name, value in found.items()
    }
