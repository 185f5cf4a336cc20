"""Two visits and more compared: whether they are of one mass, and the change of its size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, UsageError
from tactile_bayes.findings import Finding, by_weight
from tactile_bayes.pipeline.comparing import Comparing
from tactile_bayes.pipeline.one_map import Answer, size_priors
from tactile_bayes.pipeline.pooled import common_calibration
from tactile_bayes.pipeline.repeatability import check_repeatability, repeatability_digest, repeatability_setting
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.report.compare_figure import DrawnMap
    from tactile_bayes.size.bodies import BodyCalibration
    from tactile_bayes.size.draws import ShapeDraws
    from tactile_bayes.size.pooling import SizePriors
    from tactile_bayes.size.spread import BetweenMaps
    from tactile_bayes.size.visits import Apart, Compared, JointSizes


@dataclass(frozen=True, slots=True, eq=False)
class ComparedOutcome:
    """A comparison with its JSON object."""

    compared: Compared
    document: dict[str, Any]

    @property
    def exit_code(self) -> int:
        """0 for a comparison, else 6."""
        return EXIT_DONE if self.compared.joint is not None else EXIT_NO_ESTIMATE


def compare_answers(
    visits: Sequence[Sequence[Answer]],
    settings: Settings,
    *,
    comparing: Comparing,
    names: Sequence[Sequence[str]],
    inputs: Mapping[str, Path],
) -> ComparedOutcome:
    """Compare the visits of one mass.

    Parameters
    ----------
    visits
        Answers for the maps of each visit, in order of time; none of them an error.
    names
        Of the maps, for the report.
    inputs
        Files that the maps came from, by role, for the provenance.

    Raises
    ------
    BadDataError
        When the maps were normalised in several ways, one was made with another head than the calibration's, or the
        site's repeatability is of sizes by another calibration.
    UsageError
        When there are fewer than two visits, two maps are of one scan, days do not fit, or the calibration cannot pool
        maps.
    """
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.report.compare_document import compare_document

    if len(visits) < 2 or not all(visits):
        raise UsageError("a comparison needs two visits of a map or more each: `compare VISIT1.nc --with VISIT2.nc`")
    comparing.check_visits(len(visits))
    if settings.calibration == "none":
        raise UsageError("a comparison needs a size calibration; leave out --size-calibration none")
    every = list(chain.from_iterable(visits))
    path, calibration = common_calibration(every, settings, names=list(chain.from_iterable(names)))
    _refuse_repeated(visits, list(chain.from_iterable(names)))
    digests = hash_inputs(**inputs, **({"size_calibration": path} if path else {})) | repeatability_digest(settings)
    check_repeatability(settings, calibration, digests)
    compared = _compared(visits, calibration, settings, comparing)
    compared = replace(compared, findings=by_weight((*compared.findings, *_of_visits(visits))))
    scans = [scan for one in visits for scan in _scans(one)]
    provenance = Provenance("compare", _recorded(settings, comparing), digests, seed=settings.seed, scans=scans)
    document = compare_document(
        compared,
        [[answer.document or {} for answer in one] for one in visits],
        names,
        days=comparing.days,
        grown_by=comparing.grown_by,
        probability=settings.interval,
        provenance=provenance,
        repeatability=settings.repeatability,
    )
    return ComparedOutcome(compared, document)


def drawn_maps(maps: Sequence[Sequence[TactileMap]], visits: Sequence[Sequence[Answer]]) -> list[list[DrawnMap]]:
    """The maps of each visit with the places of their lumps, for the figure."""
    from tactile_bayes.report.compare_figure import DrawnMap

    def place(answer: Answer) -> tuple[float, float] | None:
        centre = None if answer.document is None or answer.shape is None else answer.document["centre_mm"]
        return None if centre is None else (centre["x"]["median"], centre["y"]["median"])

    return [
        [DrawnMap(one, place(answer)) for one, answer in zip(some, answers, strict=True)]
        for some, answers in zip(maps, visits, strict=True)
    ]


def _compared(
    visits: Sequence[Sequence[Answer]], calibration: BodyCalibration, settings: Settings, comparing: Comparing
) -> Compared:
    from tactile_bayes.size.visits import Compared, contradictions

    found = [[answer for answer in maps if answer.shape is not None] for maps in visits]
    missing = [
        f"a lump was found on {len(some)} of {len(maps)} maps of visit {number}"
        for number, (some, maps) in enumerate(zip(found, visits, strict=True), start=1)
        if not some or 2 * len(some) < len(maps)
    ]
    contradicted = contradictions([_scans(one) for one in visits])
    if contradicted:
        advice = "compare exams of one mass; where a code is wrong, correct it in the scans' session and map them again"
        return Compared("not_one_mass", "; ".join(contradicted), advice)
    if missing:
        return Compared("no_estimate", "; ".join(missing), "scan the mass again, or leave that visit out")
    refused, apart, doubts = _by_place(found, comparing)
    if refused is not None:
        return refused
    return _sized(found, calibration, settings, apart=apart, doubts=doubts)


def _by_place(
    visits: Sequence[Sequence[Answer]], comparing: Comparing
) -> tuple[Compared | None, tuple[Apart | None, ...], list[Finding]]:
    """Refusal where the places do not show one mass, the distances from the first visit, and what else speaks of it."""
    from tactile_bayes.pipeline.one_mass import place_of
    from tactile_bayes.size.spread import LEAST_PROBABILITY
    from tactile_bayes.size.visits import Compared, Place, apart, one_place_probability

    of_maps = [[place for answer in maps if (place := place_of(answer.document)) is not None] for maps in visits]
    places = [Place.mean_of(one) for one in of_maps]
    found = tuple(
        None if first is None or later is None else apart(first, later, registration_mm=comparing.registration_mm)
        for first, later in ((places[0], later) for later in places[1:])
    )
    doubts = [
        f"the masses of visits 1 and {number} lie {one.words}"
        for number, one in enumerate(found, start=2)
        if one is not None and one.doubtful
    ]
    doubts += [
        f"the masses on the maps of visit {number} lie too far apart for one"
        for number, maps in enumerate(of_maps, start=1)
        if one_place_probability(maps, registration_mm=comparing.registration_mm) < LEAST_PROBABILITY
    ]
    unknown = [str(number) for number, place in enumerate(places, start=1) if place is None]
    if not comparing.same_mass and doubts:
        advice = "compare exams of one mass; if it is one, --same-mass says so (a wider posture: --registration-mm)"
        return Compared("not_one_mass", "; ".join(doubts), advice, found), (), []
    if not comparing.same_mass and unknown:
        reason = f"no landmarks show where the mass of visit {' and '.join(unknown)} lies in the patient"
        return Compared("not_one_mass", reason, "touch both landmarks, or say --same-mass", found), (), []
    doubts += [f"no landmarks show where the mass of visit {number} lies" for number in unknown]
    return None, found, [Finding("taken_as_one", f"{text}; taken as one mass because you say so") for text in doubts]


def _sized(
    visits: Sequence[Sequence[Answer]],
    calibration: BodyCalibration,
    settings: Settings,
    *,
    apart: tuple[Apart | None, ...],
    doubts: Sequence[Finding],
) -> Compared:
    """Sizes of visits that are of one mass, or why there are none."""
    import numpy as np

    from tactile_bayes.size.pooling import MOST_INVALID
    from tactile_bayes.size.visits import Compared, joint_sizes, visit_calibrations

    # one order whatever the caller's, so that the order of a visit's maps leaves no trace
    shapes: list[list[ShapeDraws]] = [
        sorted((answer.shape for answer in maps if answer.shape is not None), key=lambda one: one.order)
        for maps in visits
    ]
    fitted = visit_calibrations(shapes, calibration)
    far = _by_visit(shapes, [one.too_far for one in fitted])
    if far:
        return Compared("no_estimate", f"outside the calibration's range: {'; '.join(far)}", "", apart)
    priors = size_priors(settings)
    words = sorted(answer.fingerprint for maps in visits for answer in maps)

    def joint(between: BetweenMaps | None) -> JointSizes:
        rng = np.random.default_rng([settings.seed, *words])
        return joint_sizes(shapes, calibration=calibration, priors=priors, rng=rng, between=between)

    sizes = joint(None)
    if np.isnan(sizes.log_size).mean() > MOST_INVALID:
        return Compared("no_estimate", "too many draws have no positive size", "", apart)
    outside = _by_visit(shapes, [one.outside for one in fitted])
    findings = [
        *doubts,
        *(Finding("outside_calibration", f"outside the calibration's range: {text}") for text in outside),
        *_fat_apart(shapes, calibration),
        *_sizes_apart(shapes, fitted, priors),
    ]
    another = None if priors.another_exam is None else joint(priors.another_exam)
    return Compared("compared", "", "", apart, tuple(findings), sizes, another)


def _by_visit(
    shapes: Sequence[Sequence[ShapeDraws]], texts: Sequence[Callable[[float, float], list[str]]]
) -> list[str]:
    """What is to be said of the middles of the maps, once for each visit."""
    found = [
        f"visit {number}: {text}"
        for number, (maps, texts_of) in enumerate(zip(shapes, texts, strict=True), start=1)
        for one in maps
        for text in texts_of(*one.middle)
    ]
    return list(dict.fromkeys(found))


def _sizes_apart(
    shapes: Sequence[Sequence[ShapeDraws]], fitted: Sequence[BodyCalibration], priors: SizePriors
) -> list[Finding]:
    """Cautions where the maps of one visit are not of one size."""
    from tactile_bayes.report.pooled import disagreement
    from tactile_bayes.size.pooling import log_sizes
    from tactile_bayes.size.spread import LEAST_PROBABILITY, one_size_of

    found = []
    for number, (maps, at) in enumerate(zip(shapes, fitted, strict=True), start=1):
        chance = one_size_of(log_sizes(at, maps), priors.between_maps)
        if chance < LEAST_PROBABILITY:
            found.append(disagreement("its maps show different sizes", chance).at(f"visit {number}"))
    return found


def _fat_apart(shapes: Sequence[Sequence[ShapeDraws]], calibration: BodyCalibration) -> list[Finding]:
    """Caution where the maps differ too much in the depth of fat to be of one breast."""
    from tactile_bayes.report.pooled import fat_apart

    fat = calibration.depth
    depths = None if fat is None else fat.apart([one.profile for maps in shapes for one in maps])
    return [] if depths is None else [fat_apart(depths)]


def _of_visits(visits: Sequence[Sequence[Answer]]) -> list[Finding]:
    """What speaks against the maps of each visit; a size alone outside its calibration is judged anew."""
    return [
        one.at(f"visit {number}" if len(maps) == 1 else f"visit {number}, map {i}")
        for number, maps in enumerate(visits, start=1)
        for i, answer in enumerate(maps, start=1)
        for one in answer.findings
        if one.kind != "outside_calibration"
    ]


def _refuse_repeated(visits: Sequence[Sequence[Answer]], names: Sequence[str]) -> None:
    """Refuse two maps of one scan: they are no two exams, and less apart than those would be."""
    from tactile_bayes.files.provenance import repeated_scans

    for index, earlier in repeated_scans([_scans([one]) for one in chain.from_iterable(visits)]).items():
        raise UsageError(f"{names[index]} and {names[earlier]} are of one scan; give one map of each scan")


def _scans(answers: Sequence[Answer]) -> list[Mapping[str, str]]:
    from tactile_bayes.files.provenance import scans_of

    return [scan for one in answers if one.document is not None for scan in scans_of(one.document["provenance"])]


def _recorded(settings: Settings, comparing: Comparing) -> dict[str, Any]:
    """Settings for the provenance."""
    return {
        "size_calibration": settings.calibration_name,
        "method": settings.method,
        "interval": settings.interval,
        "scene": settings.scene,
        "between_map_sd": settings.between_map_sd,
        **repeatability_setting(settings),
        "days": None if comparing.days is None else list(comparing.days),
        "grown_by": list(comparing.grown_by),
        "same_mass": comparing.same_mass,
        "registration_mm": comparing.registration_mm,
    }
