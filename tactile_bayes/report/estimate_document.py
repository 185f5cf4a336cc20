"""The report of one map made: its scene, suppositions and masses, with sentences of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, cast

import numpy as np

from tactile_bayes.declarations import as_dict, rounded
from tactile_bayes.files import reports
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import EstimateReport, MassReport
from tactile_bayes.findings import Finding, capitalised, finding, verdict
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.draws import Quantity, summarise
from tactile_bayes.mapping.clock import ClockPosition, Position, clock_position, clock_text
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.draw import MapPosterior
from tactile_bayes.posterior.fit import SceneChoice, Structure
from tactile_bayes.posterior.result import WIDER, Estimate, Sensitivity
from tactile_bayes.posterior.verdict import PROBABILITY, SmallestLumps, chance_text
from tactile_bayes.posterior.window import LENGTHS_MM, SHARES
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.draws import EXTREMES, SIZES, SizePosterior

# --- Summaries of an estimate's draws, by name.

WIDTHS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd")


def estimate_quantities(estimate: Estimate, tactile_map: TactileMap, *, probability: float) -> dict[str, Quantity]:
    """Summaries of all quantities that an estimate has draws of, by name; empty without an estimate."""
    if estimate.map_posterior is None or estimate.draws is None:
        return {}
    posterior = estimate.map_posterior
    draws: dict[str, FloatArray] = {name: getattr(posterior, name) for name in WIDTHS}
    draws |= {"centre_mm.x": posterior.x_mm, "centre_mm.y": posterior.y_mm}
    if tactile_map.patient_from_plane is not None:
        on_plane = np.stack([posterior.x_mm, posterior.y_mm, np.zeros_like(posterior.x_mm)], axis=-1)
        in_patient = apply(tactile_map.patient_from_plane, on_plane)
        draws |= {"centre_patient_mm.x": in_patient[..., 0], "centre_patient_mm.y": in_patient[..., 1]}
    if estimate.diagnostics.get("rotated"):
        draws["angle_deg"] = np.degrees(posterior.angle_rad)
    labels, effective = estimate.draws.labels, estimate.draws.effective_draws
    quantities = {
        name: summarise(d, probability=probability, effective_draws=effective, replicates=labels)
        for name, d in draws.items()
    }
    if estimate.size is not None:
        quantities |= {name: estimate.size.summarise(name, probability=probability) for name in SIZES}
    return quantities


def another_exam(size: SizePosterior | None, *, probability: float) -> reports.AnotherExam | None:
    """Sizes with the paper's spread between exams, and that spread as a share of the size; None without it."""
    another = None if size is None else size.another_exam
    if another is None:
        return None
    largest, smallest = (another.summarise(name, probability=probability) for name in EXTREMES)
    return reports.AnotherExam(another.figures["between_map_sd"], largest, smallest, dict(another.variance_share))


# --- Place of a lump in the breast, by clock and distance from the nipple, of an estimate and in words.


def side_of(scans: Sequence[Mapping[str, str]]) -> str:
    """The breast's side in `Provenance.scans`; empty where the scans do not agree."""
    sides = {scan.get("side", "") for scan in scans}
    return sides.pop() if len(sides) == 1 else ""


def lump_place(
    posterior: MapPosterior | None, tactile_map: TactileMap, scans: Sequence[Mapping[str, str]]
) -> ClockPosition | None:
    """Place of the measured lump about the nipple; None without a lump, landmarks, a nipple or a breast's side."""
    if posterior is None:
        return None
    x_mm, y_mm = posterior.x_mm.ravel(), posterior.y_mm.ravel()
    centre = float(np.median(x_mm)), float(np.median(y_mm))
    return clock_position(tactile_map, centre, side=side_of(scans), covariance_mm2=np.cov(x_mm, y_mm))


def place_line(place: Position) -> str:
    """The place with its intervals, as a line of a full report."""
    hours, distance = place.clock_hours, place.distance_mm
    clock = ""
    if hours.low is not None and hours.high is not None:
        clock = f" {clock_text(hours.low)} to {clock_text(hours.high)} o'clock and"
    ends = f"{distance.low:.0f} to {distance.high:.0f} mm"
    return f"Place: {place.text}; {100 * distance.probability:g} % interval{clock} {ends}."


def at_place(x_mm: float, y_mm: float) -> str:
    """A place on the map, to a tenth of a mm and without a zero below 0."""
    return f"at ({round(x_mm, 1) + 0.0:.1f}, {round(y_mm, 1) + 0.0:.1f}) mm"


def from_xiphoid(x_mm: float, y_mm: float) -> str:
    """A place in the patient's axes, in words."""
    across = f"{abs(x_mm):.0f} mm to the patient's {'right' if x_mm >= 0 else 'left'}"
    return f"{across} of the xiphoid and {abs(y_mm):.0f} mm {'above' if y_mm >= 0 else 'below'} it"


# --- Masses of a map that may be one lump: whether they touch, and how long they are together.

SizedMass = tuple[int, tuple[float, float], Sequence[Quantity]]
"""Number, x and y in mm, and the largest size: as `max_size_mm`, and with the interval that reports lead with."""


def sized_masses(masses: Sequence[MassReport]) -> list[SizedMass]:
    """Those of the masses that have a size."""
    return [
        (mass.number, mass.centre_mm.median, (mass.max_size_mm, mass.leading.max_size_mm))
        for mass in masses
        if mass.max_size_mm is not None and mass.leading.max_size_mm is not None
    ]


def touching_masses(masses: Sequence[SizedMass]) -> dict[reports.Touching, str]:
    """Pairs of sized masses whose outlines may touch, each with its length in words, as reports lead with it.

    A pair touches where the upper ends of its radii reach over the distance of the centres.
    """
    pairs = {}
    for (first, centre, sizes), (second, beside, others) in combinations(masses, 2):
        apart_mm = math.dist(centre, beside)
        if apart_mm <= (sizes[0].high + others[0].high) / 2:
            length, leading = (_together(apart_mm, *pair) for pair in zip(sizes, others, strict=True))
            words = f"together {leading.median:.1f} mm long ({leading.low:.1f} to {leading.high:.1f})"
            pairs[reports.Touching((first, second), apart_mm, length)] = words
    return pairs


def _together(apart_mm: float, one: Quantity, other: Quantity) -> reports.Interval:
    """Length over two masses in one body: errors go together, so its ends are made of the same ends of both sizes."""
    ends = zip((one.median, one.low, one.high), (other.median, other.low, other.high), strict=True)
    # one may lie within the other's outline
    median, low, high = (max(apart_mm + (a + b) / 2, a, b) for a, b in ends)
    return reports.Interval(median, low, high, one.probability)


def touching_findings(masses: Sequence[SizedMass]) -> list[Finding]:
    """A finding for each pair of masses that may be one lump."""
    return [
        finding("touching", "masses {} and {} may be one lump: {}".format(*pair.masses, words))
        for pair, words in touching_masses(masses).items()
    ]


# --- The scene in the fit window.

STRUCTURE_WORDS = {
    "ellipse": "an ellipse, not a circle",
    "rotated": "a rotated ellipse",
    "tilt": "a sloping level",
    "second lump": "a second lump in this window",
    "rib": "a rib in this window",
    "departure": "a departure from a Gaussian",
}
SHAPE_WORDS = {"round": "a round bump", "ellipse": "an ellipse along the head's axes", "rotated": "a rotated ellipse"}
LEAST_SHIFT_SD = 0.005  #: A shift by a wider prior below this is not given in figures.
LEAST_CHANGE_SD = 0.05  #: A change of a width by one more structure below this rounds to none.


def scene_lines(choice: SceneChoice) -> list[str]:
    """Scene of the fit window with odds: structures supported, other structures kept, and those left out."""

    def odds(one: Structure) -> str:
        return f"(odds {odds_text(one)}){_width_changes(one, 'without' if one.used else 'with')}"

    named = _named_structures(choice)
    names = [SHAPE_WORDS[choice.supported], *(f"{STRUCTURE_WORDS[one.name]} {one.place}".rstrip() for one in named)]
    window = f"the fit window of {choice.fit.target.problem.radius_mm:g} mm about the lump"
    lines = [f"Scene in {window}: {' and '.join(names)}, the simplest that the map supports."]
    lines += [f"{capitalised(STRUCTURE_WORDS[one.name])} is in the model {odds(one)}." for one in named]
    unnamed = [one for one in choice.structures if one.used and not one.supported and not one.place]
    lines += [f"Also in the model: {STRUCTURE_WORDS[one.name]} {odds(one)}." for one in unnamed]
    out = [f"{STRUCTURE_WORDS[one.name]} {odds(one)}" for one in choice.structures if not one.used]
    return [*lines, f"Not in the model: {'; '.join(out)}."] if out else lines


def scene_line(choice: SceneChoice) -> str:
    """Scene of the fit window in one line: structures supported, and those not needed."""
    names = [SHAPE_WORDS[choice.supported], *(STRUCTURE_WORDS[one.name] for one in _named_structures(choice))]
    near = f" within {choice.fit.target.problem.radius_mm:g} mm"
    out = [STRUCTURE_WORDS[one.name].replace(" in this window", near) for one in choice.structures if not one.used]
    return f"The map supports {' and '.join(names)}" + (f"; not needed: {', '.join(out)}." if out else ".")


def _named_structures(choice: SceneChoice) -> list[Structure]:
    """Structures to name beside the bump: in the model because the map supports them."""
    return [one for one in choice.structures if one.used and (one.place or (one.name == "tilt" and one.supported))]


def odds_text(one: Structure) -> str:
    """Format a Bayes factor with no more digits than it is worth."""
    if one.odds < 0.01:
        return "below 0.01 to 1"
    if one.odds > 1000:
        return "above 1000 to 1"
    return f"{'at most ' if one.odds_are_a_bound else ''}{one.odds:.2g} to 1"


def _width_changes(one: Structure, word: str) -> str:
    if one.change_sigma_x_sd is None or one.change_sigma_y_sd is None:
        return ""
    changes = {"sigma_x": one.change_sigma_x_sd, "sigma_y": one.change_sigma_y_sd}
    parts = [f"{name} would change by {by:+.1f} SD" for name, by in changes.items() if abs(by) >= LEAST_CHANGE_SD]
    return f": {word} it {' and '.join(parts) or 'the widths would not change'}"


def sensitivity_line(sensitivity: Sensitivity) -> str:
    """Sensitivity of the result to the prior of the widths."""
    names = {"max_size_mm": "the largest size", "sigma_x_mm": "sigma_x", "sigma_y_mm": "sigma_y"}
    name = next(name for name in names if name in sensitivity.median)
    median, ends = sensitivity.median[name], sensitivity.ends[name]
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


def scene_report(choice: SceneChoice) -> reports.SceneReport:
    """The scene, as files have it."""
    scene = choice.fit.scene
    return reports.SceneReport(
        supported=cast("reports.Shape", choice.supported),
        shape=cast("reports.Shape", scene.shape),
        tilt=scene.tilt,
        beside=scene.extra or None,
        structures=tuple(reports.StructureReport(**_finite(as_dict(one), 6)) for one in choice.structures),
    )


# --- How large a lump would be if it were soft, hard, centred on the gland's surface or resting on it: data and text.

LEAST_CHANGE = 0.02  #: Of the size, from which a pair of suppositions is worth a line.
SUPPOSED_PAIRS = (
    ("the lump soft", "soft", "hard", " ({:g} times as stiff as fat)", " ({:g} times)"),
    ("it centred on the gland's surface", "centred", "resting", "", " on the gland"),
)
"""Words of the first supposition, names of both, and words after each with its value."""

Suppositions = Mapping[str, reports.Supposed]


def suppositions(size: SizePosterior | None, largest: Quantity | None) -> dict[str, reports.Supposed] | None:
    """Each supposed property with its value and the largest size given it, by name; None without a size."""
    if size is None or largest is None:
        return None
    return {
        label: reports.Supposed(one.name, one.value, reports.SizeInterval(*one.moved(largest), largest.probability))
        for label, one in size.supposing.items()
    }


def supposed_lines(supposed: Suppositions | None, median_mm: float, *, places: int) -> list[str]:
    """A line for each pair of suppositions that moves the largest size."""
    lines = []
    for words, first, second, *follow in SUPPOSED_PAIRS:
        pair = _moving_pair(supposed, median_mm, (first, second))
        if pair:
            values = [after.format(one.value) for after, one in zip(follow, pair, strict=True)]
            sizes = [size_words(one.max_size_mm, places) for one in pair]
            lines.append(f"Were {words}{values[0]}: {sizes[0]}; {second}{values[1]}: {sizes[1]}.")
    return lines


def supposed_line(supposed: Suppositions | None, median_mm: float, *, places: int) -> list[str]:
    """A soft lump's size and a hard one's in a few words, for a short report; empty where they hardly differ.

    A lump softer than the calibration's may lie above the interval, and nothing on its map says so: the line does.
    """
    pair = _moving_pair(supposed, median_mm, ("soft", "hard"))
    if not pair:
        return []
    (soft, soft_ratio), (hard, hard_ratio) = ((one.max_size_mm.median, one.value) for one in pair)
    words = (
        f"No map shows stiffness: were the lump soft ({soft_ratio:g} times fat), {soft:.{places}f} mm; "
        f"hard ({hard_ratio:g} times), {hard:.{places}f} mm"
    )
    return [f"{words}; softer still, larger." if soft > hard else f"{words}."]


def _moving_pair(supposed: Suppositions | None, median_mm: float, names: tuple[str, str]) -> list[reports.Supposed]:
    """Both suppositions of these names if one of them moves the largest size, else none."""
    pair = [] if supposed is None else [supposed[name] for name in names if name in supposed]
    moves = any(abs(one.max_size_mm.median / median_mm - 1) >= LEAST_CHANGE for one in pair)
    return pair if moves and len(pair) == 2 else []


def share_words(size: Quantity | reports.Interval) -> str:
    """The probability of an interval, such as 95 %."""
    return f"{100 * size.probability:g} %"


def size_words(size: Quantity | reports.Interval, places: int = 1) -> str:
    """A size with its interval in brackets."""
    return f"{size.median:.{places}f} mm ({size.low:.{places}f} to {size.high:.{places}f})"


# --- The masses of a map, and sentences on them.


def _mass_reports(
    estimate: Estimate,
    tactile_map: TactileMap,
    quantities: Mapping[str, Quantity],
    *,
    probability: float,
    scans: Sequence[Mapping[str, str]],
) -> tuple[MassReport, ...]:
    """A map's masses, numbered in their order; `quantities` are those of the reported mass."""
    mass_reports = []
    for number, mass in enumerate(estimate.masses, start=1):
        alone = mass.estimate
        summaries = quantities if mass.reported else estimate_quantities(alone, tactile_map, probability=probability)
        place = lump_place(alone.map_posterior, tactile_map, scans)
        patient = patient_mm(tactile_map, mass.x_mm, mass.y_mm)
        why = estimate.reason if mass.reported else alone.reason
        mass_reports.append(
            MassReport(
                number=number,
                reported=mass.reported,
                centre_mm=reports.Place(mass.x_mm, mass.y_mm),
                centre_patient_mm=None if patient is None else reports.Place(*patient),
                detected_probability=mass.probability,
                **{name: summaries.get(name) for name in ("amplitude", *SIZES, "angle_deg")},
                another_exam=another_exam(alone.size, probability=probability),
                reason=why if alone.size is None else "",
                reason_code=cast("reports.ReasonCode", alone.code),
                advice=alone.advice,
                position=None if place is None else place.as_position(probability),
            )
        )
    return tuple(mass_reports)


def patient_mm(tactile_map: TactileMap, x_mm: float, y_mm: float) -> tuple[float, float] | None:
    """A place on the map in mm from the xiphoid, to the patient's right and up; None without landmarks."""
    if tactile_map.patient_from_plane is None:
        return None
    x, y, _ = apply(tactile_map.patient_from_plane, np.array([x_mm, y_mm, 0.0]))
    return float(x), float(y)


def other_masses(masses: Sequence[MassReport]) -> list[MassReport]:
    """The masses besides the reported one."""
    return [mass for mass in masses if not mass.reported]


def mass_lines(masses: Sequence[MassReport]) -> list[str]:
    """One line per mass besides the reported one: place, size or why there is none, probability."""
    reported = next((one for one in masses if one.reported), None)
    return [f"Mass {mass.number} {mass_words(mass, reported)}." for mass in other_masses(masses)]


def mass_words(mass: MassReport, reported: MassReport | None) -> str:
    """A mass's place, its distance from the reported one, its size or why it has none, and its probability."""
    x, y = mass.centre_mm.x, mass.centre_mm.y
    place = at_place(x, y)
    if reported is not None:
        away = np.hypot(x - reported.centre_mm.x, y - reported.centre_mm.y)
        place += f", {away:.0f} mm from mass {reported.number}"
    if mass.position is not None:
        place += f" ({mass.position.text})"
    size = mass.leading.max_size_mm
    if size is None:
        outcome = f"no size: {mass.reason}"
    else:
        ends = f"{share_words(size)} interval {size.low:.1f} to {size.high:.1f} mm"
        outcome = f"largest size {size.median:.1f} mm ({ends})"
    if reported is not None:
        for words in touching_masses(sized_masses([reported, mass])).values():
            outcome += f"; may be one lump with mass {reported.number}, {words}"
    return f"{place}: {outcome}; probability of a lump {chance_text(mass.detected_probability)}"


def reported_number_words(masses: Sequence[MassReport]) -> str:
    """Number of the reported mass, such as "Mass 1 of 2"; empty where it is the only one."""
    reported = next((one for one in masses if one.reported), None)
    return "" if reported is None or len(masses) == 1 else f"Mass {reported.number} of {len(masses)}"


# --- The report of a map: what `estimate --json` prints.


def estimate_report(
    estimate: Estimate, tactile_map: TactileMap, *, probability: float, prior: BumpPrior, provenance: Provenance
) -> EstimateReport:
    """Report of one map."""
    quantities = estimate_quantities(estimate, tactile_map, probability=probability)
    place = lump_place(estimate.map_posterior, tactile_map, provenance.scans)

    def point(name: str) -> reports.Point | None:
        x, y = f"{name}.x", f"{name}.y"
        return reports.Point(quantities[x], quantities[y]) if x in quantities else None

    about, size, moved = estimate.about_mm, estimate.size, estimate.sensitivity
    masses = _mass_reports(estimate, tactile_map, quantities, probability=probability, scans=provenance.scans)
    diagnostics = dict(estimate.diagnostics)
    if estimate.detection is not None:
        diagnostics["log_bayes_factor"] = estimate.detection.log_bayes_factor
    return EstimateReport(
        schema=reports.ESTIMATE,
        status=estimate.status,
        verdict=verdict(estimate.findings, answered=size is not None),
        findings=estimate.findings,
        reason=estimate.reason,
        reason_code=cast("reports.ReasonCode", estimate.code),
        advice=estimate.advice,
        on_paper=estimate.on_paper,
        about_mm=None if about is None else reports.Place(*about),
        smallest_lump=None if estimate.smallest is None else smallest_lump(estimate.smallest),
        **{name: quantities.get(name) for name in (*SIZES, *WIDTHS, "angle_deg")},
        another_exam=another_exam(size, probability=probability),
        supposing=suppositions(size, quantities.get("max_size_mm")),
        centre_mm=point("centre_mm"),
        centre_patient_mm=point("centre_patient_mm"),
        position=None if place is None else place.as_position(probability),
        detected_probability=estimate.probability,
        variance_share=None if size is None else dict(size.variance_share),
        scene=None if estimate.scene is None else scene_report(estimate.scene),
        prior_sensitivity=None if moved is None else reports.PriorSensitivity(WIDER, {**moved.median}, {**moved.ends}),
        diagnostics=_finite(diagnostics) | ({} if size is None else size_diagnostics(size)),
        candidates=tuple(reports.PassedOver(*one.centre_mm, one.fault) for one in estimate.candidates),
        other_rises=tuple(rounded(reports.OtherRise(**as_dict(rise)), 6) for rise in estimate.other_rises),
        masses=masses,
        touching=tuple(touching_masses(sized_masses(masses))),
        left_out=tuple(estimate.left_out),
        prior=as_dict(prior),
        research_use=RESEARCH_USE,
        provenance=provenance.as_dict(),
    ).rounded


def smallest_lump(smallest: SmallestLumps) -> reports.SmallestLump:
    """Smallest lumps that a map without one would have shown, as files have them."""

    def row(diameters: FloatArray) -> Any:
        return tuple(float(d) if math.isfinite(d) else None for d in diameters)

    places = [
        reports.SmallestAt(round(float(x), 3), round(float(y), 3), row(d))
        for (x, y), d in zip(smallest.places_mm, smallest.d_mm, strict=True)
    ]
    depths: Any = tuple(round(float(depth), 1) for depth in smallest.depths_mm)
    best, worst = row(smallest.d_mm.min(axis=0)), row(smallest.d_mm.max(axis=0))
    return reports.SmallestLump(PROBABILITY, depths, best, worst, round(smallest.spacing_mm, 3), tuple(places))


def size_diagnostics(size: SizePosterior) -> dict[str, Any]:
    """Diagnostics of a size; a figure that is not finite is null."""
    return _finite({"invalid_draws": size.invalid, **size.figures})


def _finite(values: Mapping[str, Any], digits: int = 9) -> dict[str, Any]:
    return {
        name: (rounded(value, digits) if math.isfinite(value) else None) if isinstance(value, float) else value
        for name, value in values.items()
    }
