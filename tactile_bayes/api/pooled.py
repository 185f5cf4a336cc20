"""The maps of one mass: estimated again at its common place, and pooled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.estimating import Answer, size_priors
from tactile_bayes.api.repeatability import check_repeatability, repeatability_digest
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.provenance import Provenance, hash_inputs, scans_of
from tactile_bayes.files.size_json import default_for, read_size_calibration, size_calibration_path
from tactile_bayes.options import PRIORS
from tactile_bayes.posterior.estimate import way_to_head
from tactile_bayes.presets import MATCH_MM
from tactile_bayes.report.pooled import pooled_document
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.fat import LEAST_PROBABILITY
from tactile_bayes.size.pooling import DISAGREE, PooledEstimate, pool_maps
from tactile_bayes.size.visits import Place as PatientPlace
from tactile_bayes.size.visits import one_place_probability

if TYPE_CHECKING:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.size.bodies import BodyCalibration
    from tactile_bayes.size.pooling import PooledEstimate
    from tactile_bayes.size.visits import Place


# --- Which mass of each map is the one that is pooled: by its place in the patient.
#
# A report is about the surest mass of its map, so of two maps of one breast each may report another one. With
# landmarks the masses of all maps have places in patient axes, and the one that most maps show is pooled.

Document = Mapping[str, Any]
MapPlace = tuple[float, float]


class _Mass(Record):
    """A mass of one map: its places in the patient and on the map, mm, and what ranks it."""

    patient_mm: MapPlace
    map_mm: MapPlace
    sized: bool
    reported: bool
    amplitude: float

    def away_mm(self, other: _Mass) -> float:
        return float(np.hypot(*np.subtract(self.patient_mm, other.patient_mm)))


def of_one_mass(answers: Sequence[Answer], again: Callable[[int, MapPlace], Answer]) -> list[Answer]:
    """Answers for the mass that most maps show; a map whose report is about another one is estimated at its place.

    Parameters
    ----------
    again
        Takes the number of a map in the list and a place on it, and gives the answer there.
    """
    found = list(answers)
    for i, place in elsewhere([one.document for one in answers]).items():
        found[i] = again(i, place)
    return found


def elsewhere(documents: Sequence[Document | None]) -> dict[int, MapPlace]:
    """Maps that report another mass than the common one, with the place of that one on each, mm.

    Empty where a map with a lump has no landmarks, or no two maps show a mass at one place.
    """
    maps = _masses(documents)
    common = None if maps is None else _common(maps)
    if maps is None or common is None:
        return {}
    there = {i: _nearest(masses, common) for i, masses in maps.items()}
    return {i: one.map_mm for i, one in there.items() if one is not None and not one.reported}


def apart_from_others(documents: Sequence[Document | None]) -> dict[int, str]:
    """Maps whose reported mass lies elsewhere than the common one, in words; empty without landmarks."""
    maps = _masses(documents)
    if maps is None:
        return {}
    reported = {i: [one for one in masses if one.reported] for i, masses in maps.items()}
    found = [one for masses in reported.values() for one in masses]
    common = _common(reported) or max(found, key=lambda one: one.amplitude, default=None)
    away = {i: one.away_mm(common) for i, masses in reported.items() for one in masses if common is not None}
    words = "its mass lies {:.0f} mm from that of the other maps and may be another one"
    return {i: words.format(mm) for i, mm in away.items() if mm > MATCH_MM}


def one_place(documents: Sequence[Document | None]) -> bool | None:
    """Whether the reported masses of all maps lie at one place; None where that cannot be told."""
    maps = _masses(documents)
    if maps is None or len(maps) < 2:
        return None
    return not apart_from_others(documents)


def _masses(documents: Sequence[Document | None]) -> dict[int, list[_Mass]] | None:
    """Masses of the maps with a lump, by the map's place in the list; None where one has no place in the patient."""
    found: dict[int, list[_Mass]] = {}
    for i, document in enumerate(documents):
        listed = [] if document is None else document.get("masses", [])
        if any(one.get("centre_patient_mm") is None for one in listed):
            return None
        if listed:
            found[i] = [_mass(one) for one in listed]
    return found


def _mass(document: Document) -> _Mass:
    patient, here, amplitude = document["centre_patient_mm"], document["centre_mm"], document["amplitude"]
    return _Mass(
        (patient["x"], patient["y"]), (here["x"], here["y"]), document["max_size_mm"] is not None,
        document["reported"], 0.0 if amplitude is None else amplitude["median"],
    )  # fmt: skip


def _common(maps: Mapping[int, Sequence[_Mass]]) -> _Mass | None:
    """A mass at the place where most maps show one, sized by most, then reported by most; None where all are apart."""
    best = max((one for masses in maps.values() for one in masses), key=lambda one: _worth(maps, one), default=None)
    return best if best is not None and _worth(maps, best)[0] > 1 else None


def _worth(maps: Mapping[int, Sequence[_Mass]], common: _Mass) -> tuple[int, int, int, float]:
    """On how many maps a mass is found, sized and reported, and the median of its amplitudes."""
    there = [one for one in (_nearest(masses, common) for masses in maps.values()) if one is not None]
    amplitude = float(np.median([one.amplitude for one in there]))
    return len(there), sum(one.sized for one in there), sum(one.reported for one in there), amplitude


def _nearest(masses: Sequence[_Mass], common: _Mass) -> _Mass | None:
    """The mass nearest to a place, if it lies within `MATCH_MM` of it."""
    near = min(masses, key=common.away_mm, default=None)
    return near if near is not None and near.away_mm(common) <= MATCH_MM else None


def place_of(document: Document | None) -> PatientPlace | None:
    """Where a map's reported mass lies in the patient; None without a lump or landmarks."""
    centre = None if document is None else document["centre_patient_mm"]
    if centre is None:
        return None
    x, y = centre["x"], centre["y"]
    return PatientPlace(np.array([x["median"], y["median"]]), np.diag([x["sd"] ** 2, y["sd"] ** 2]))


# --- One size from several maps of one mass.


class PooledOutcome(Record, eq=False):
    """Size of one mass, with its JSON object and provenance."""

    pooled: PooledEstimate
    document: dict[str, Any]
    provenance: Provenance


def pool_answers(
    answers: Sequence[Answer], settings: Settings, *, names: Sequence[str], inputs: Mapping[str, Path]
) -> PooledOutcome:
    """Pool the maps of one mass.

    Parameters
    ----------
    answers
        Of each map; none of them an error.
    names
        Of the maps, for the report.
    inputs
        Files that the maps came from, by role, for the provenance.

    Raises
    ------
    BadDataError
        When the maps were normalised in several ways, one was made with another head than the calibration's, or their
        scans name different patients, sides, masses or visits.
    UsageError
        When the calibration cannot pool maps.
    """
    documents = [answer.document for answer in answers if answer.document is not None]
    scans = [scan for document in documents for scan in scans_of(document["provenance"])]
    check_one_mass(scans)
    path, calibration = common_calibration(answers, settings, names=names)
    digests = hash_inputs(**inputs, **({"size_calibration": path} if path else {})) | repeatability_digest(settings)
    check_repeatability(settings, calibration, digests)
    # the maps' values in sorted order are part of the seed: their order on the command line leaves no trace
    words = sorted(answer.fingerprint for answer in answers)
    places = [place for one in answers if one.shape is not None and (place := place_of(one.document)) is not None]
    chance = one_place_probability(places) if len(places) > 1 else None
    pooled = (
        _too_far(answers)
        or _none_can_show(documents)
        or _apart(places, chance)
        or pool_maps(
            [answer.shape for answer in answers],
            calibration=calibration,
            priors=size_priors(settings),
            rng=np.random.default_rng([settings.seed, *words]),
        )
    )
    pooled = replace(pooled, one_place=chance)
    if pooled.status == DISAGREE and pooled.one_size is not None:
        pooled = replace(pooled, reason=f"{pooled.reason}, {_sizes(documents)}")
    provenance = Provenance("estimate --pool", _recorded(settings), digests, seed=settings.seed, scans=scans)
    document = pooled_document(
        pooled,
        list(names),
        documents,
        calibration,
        probability=settings.interval,
        provenance=provenance,
        repeatability=settings.repeatability,
        apart=apart_from_others(documents),
        one_place=one_place(documents),
    )
    return PooledOutcome(pooled, document, provenance)


def _too_far(answers: Sequence[Answer]) -> PooledEstimate | None:
    """Reason for no size where a map is too far outside the calibration's range; else None."""
    for i, answer in enumerate(answers):
        if answer.document is not None and answer.document["reason_code"] == "extrapolated":
            return PooledEstimate("no_estimate", f"map {i + 1}: {answer.document['reason']}")
    return None


def _none_can_show(documents: Sequence[Mapping[str, Any]]) -> PooledEstimate | None:
    """Reason for no size where the cells of all maps are too large to show a lump; else None."""
    if any(one["reason_code"] != "coarse" for one in documents):
        return None
    return PooledEstimate("no_estimate", "the maps cannot show whether there is a lump: their cells are too large")


def _apart(places: Sequence[Place], chance: float | None) -> PooledEstimate | None:
    """Reason for no size where landmarks show that the maps are of several masses; else None."""
    if chance is None or chance >= LEAST_PROBABILITY:
        return None
    most = max(float(np.hypot(*(a.centre_mm - b.centre_mm))) for a, b in combinations(places, 2))
    return PooledEstimate(DISAGREE, f"by the landmarks the masses of the maps lie up to {most:.0f} mm apart")


def _sizes(documents: Sequence[Mapping[str, Any]]) -> str:
    """The maps' own sizes in words."""
    found = [f"{one['max_size_mm']['median']:.1f}" for one in documents if one["max_size_mm"] is not None]
    return f"{', '.join(found[:-1])} and {found[-1]} mm" if len(found) > 1 else f"{', '.join(found)} mm"


def check_one_mass(scans: Sequence[Mapping[str, str]]) -> None:
    """Refuse scans that say they are of different masses, or of one mass at different visits.

    Raises
    ------
    BadDataError
        Naming what they differ in.
    """
    for name in ("subject", "side", "mass", "visit"):
        values = sorted({scan[name].casefold(): scan[name] for scan in scans if scan.get(name)}.values())
        if len(values) > 1:
            visits = "; `compare` takes several visits" if name == "visit" else ""
            way_out = f"give the maps of one mass at one visit, and others by themselves{visits}"
            raise BadDataError(f"the maps differ in {name} ({', '.join(values)})", way_out=way_out)


def _shipped_for(answers: Sequence[Answer]) -> str:
    """Shipped calibration for maps that are all normalised alike."""
    ways = sorted({answer.normalise for answer in answers})
    if len(ways) > 1:
        raise BadDataError(
            f"the maps were normalised in several ways ({', '.join(ways)})",
            way_out="pool maps made by one recipe: make the others again with `map`",
        )
    return default_for(ways[0])


def _calibration(answers: Sequence[Answer], settings: Settings) -> tuple[Path | None, BodyCalibration]:
    """The calibration that pools, and its file if it is in one."""
    path, calibration = None, settings.size_calibration
    if calibration is None or isinstance(calibration, str):
        path = size_calibration_path(calibration or _shipped_for(answers))
        if path is None:
            raise UsageError("--pool needs a size calibration; leave out --size-calibration none")
        calibration = read_size_calibration(path)
    if not isinstance(calibration, BodyCalibration):
        what = path or settings.calibration_name
        raise UsageError(
            f"--pool needs a calibration learned over bodies; {what} is of a study or phantoms: use solid or eq6"
        )
    return path, calibration


def _check_heads(answers: Sequence[Answer], calibration: BodyCalibration, names: Sequence[str]) -> None:
    """Refuse a map that was made with another head than the calibration's."""
    for answer, name in zip(answers, names, strict=True):
        differs = calibration.recipe.head_differences(answer.head)
        if differs:
            what = f"{name}: the calibration is for another head: {'; '.join(differs)}"
            raise BadDataError(what, way_out=way_to_head(answer.head))


def _recorded(settings: Settings) -> dict[str, Any]:
    """Settings by the keys that pooled files have: `calibration`, and the priors together."""
    plain = settings.recorded()
    prior = {name: plain.pop(name) for name in PRIORS}
    return {"calibration": plain.pop("size_calibration"), **plain, "prior": prior}


def common_calibration(
    answers: Sequence[Answer], settings: Settings, *, names: Sequence[str]
) -> tuple[Path | None, BodyCalibration]:
    """The calibration that sizes all these maps together, and its file if it is in one.

    Raises
    ------
    BadDataError
        When the maps were normalised in several ways, or one was made with another head than the calibration's.
    UsageError
        When the calibration cannot pool maps.
    """
    path, calibration = _calibration(answers, settings)
    _check_heads(answers, calibration, names)
    return path, calibration
