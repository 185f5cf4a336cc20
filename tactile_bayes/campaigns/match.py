"""Which exams and estimates belong to one mass, and the order of its visits."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.api.estimating import estimate_file
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import Abstention, BadDataError
from tactile_bayes.files.manifest_csv import Exam, natural
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.reports import EstimateReport, Place
from tactile_bayes.findings import Finding
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import on_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import no_verdict
from tactile_bayes.trial.readings import day_of, in_order

# --- Matching of a campaign's exams to masses that the table names by place in another exam of the same breast.
#
# A row with a place (`centre_x_mm`, `centre_y_mm`, on its own map) says where a mass lies. Other exams of the
# breast, at any visit, are matched to it: of the masses that their map lists, the one within a stated distance in
# patient axes, or in the maps' own axes where a scan has no landmarks.

SAME_MM: Final = 6.0
"""Centres on one map nearer than this are of one mass: candidates of a search are so far apart."""
OWN_AXES: Final = Finding(
    "own_axes", "its mass was matched by place in the maps' own axes, because a scan has no landmarks"
)


class NamedPlace(Record):
    """Where an exam of the breast has a mass, as the table says."""

    mass: str
    exam: str
    """`mass`, `exam`: Their codes and names."""
    path: Path  #: Of that exam's map.
    centre_mm: tuple[float, float]  #: On that map.


class Match(Record):
    """Which mass of a map is an exam's, by where other exams have the breast's masses."""

    mass: str  #: Code of the exam's mass, which one of the places is of.
    places: tuple[NamedPlace, ...]
    most_mm: float  #: Within this distance of its place a mass of the map is it.


class Breasts:
    """Exams of each breast, so that those of a large table are found without a walk through it."""

    def __init__(self, exams: Sequence[Exam]) -> None:
        self._exams: dict[tuple[str, str | None], list[Exam]] = defaultdict(list)
        for exam in exams:
            self._exams[exam.patient, exam.side].append(exam)

    def named(self, exam: Exam, of: Container[str] | None = None) -> list[Exam]:
        """For an exam without a place those that name one: for each mass of the breast one, of its visit if possible.

        Empty where the exam has a place, or no exam names one of its mass; `of` holds the names of those that count.
        """
        if exam.centre_mm is not None:
            return []
        breast = [one for one in self._exams[exam.patient, exam.side] if of is None or one.name in of]
        found: dict[str, Exam] = {}
        for one in sorted(breast, key=lambda one: (one.visit != exam.visit, natural(one.visit), one.replicate)):
            if one.centre_mm is not None:
                found.setdefault(one.mass, one)
        return list(found.values()) if exam.mass in found else []


def matched(path: Path, settings: Settings, match: Match) -> SizeEstimate:
    """Estimate the mass of a map that lies nearest to where another exam has it.

    Without a mass there the estimate is of the place, and says why it has no size.

    At fault (`BadDataError`) are several masses of the map that may be the one, and a place off the map.
    """
    mass, most_mm = match.mass, match.most_mm
    outcome = estimate_file(path, settings)
    tactile_map, masses = outcome.tactile_map, outcome.estimate.masses
    wanted = places_on(tactile_map, match.places)
    near = [one for one in masses if nearest(wanted, (one.x_mm, one.y_mm), most_mm) == mass]
    if len(near) > 1:
        told = " and ".join(f"({one.x_mm:.1f}, {one.y_mm:.1f}) mm" for one in near)
        way_out = "give the row its centre_x_mm and centre_y_mm, or a smaller --match-mm"
        raise BadDataError(f"shows masses at {told} within {most_mm:g} mm of mass {mass}'s place", way_out=way_out)
    if near and near[0].reported:
        return outcome
    if near:
        return estimate_file(path, replace(settings, centre_mm=(near[0].x_mm, near[0].y_mm)))
    place = wanted[mass]
    if not on_map(tactile_map, *place):
        told = f"mass {mass} would lie at ({place[0]:.1f}, {place[1]:.1f}) mm, off the map"
        raise BadDataError(told, way_out="check the landmarks, or give the row its centre_x_mm and centre_y_mm")
    looked = estimate_file(path, replace(settings, centre_mm=place))
    found = looked.estimate
    here = next((one for one in found.masses if one.reported), None)
    if found.status != "estimate" or here is None or np.hypot(here.x_mm - place[0], here.y_mm - place[1]) <= most_mm:
        return looked
    reason = f"no lump found within {most_mm:g} mm of mass {mass}'s place, ({place[0]:.1f}, {place[1]:.1f}) mm"
    why = no_verdict(tactile_map) or Abstention("undetected", reason)
    none = Estimate(
        "no_estimate",
        why.reason,
        candidates=found.candidates,
        code=why.code,
        masses=tuple(replace(one, reported=False) for one in found.masses),
        findings=looked.tactile_map.findings,
    )
    return replace(looked, estimate=none)


def places_on(tactile_map: TactileMap, places: Sequence[NamedPlace]) -> dict[str, tuple[float, float]]:
    """Where masses lie on a map, by their code: x and y in patient axes are kept; as they are without landmarks."""
    found, here = {}, tactile_map.patient_from_plane
    for one in places:
        there = read_map(one.path).patient_from_plane
        found[one.mass] = one.centre_mm
        if there is not None and here is not None:
            x_y = (there @ np.array([*one.centre_mm, 0.0, 1.0]))[:2]
            x, y = np.linalg.solve(here[:2, :2], x_y - here[:2, 3])
            found[one.mass] = (float(x), float(y))
    return found


def nearest(wanted: Mapping[str, tuple[float, float]], place: tuple[float, float], most_mm: float) -> str:
    """Code of the mass whose place is nearest, and within the distance; empty where none is."""
    away = {mass: float(np.hypot(x - place[0], y - place[1])) for mass, (x, y) in wanted.items()}
    first = min(away, key=lambda mass: away[mass])
    return first if away[first] <= most_mm else ""


def in_own_axes(tactile_map: TactileMap, places: Sequence[NamedPlace]) -> bool:
    """Whether places are compared in the maps' own axes."""
    return any(one.patient_from_plane is None for one in (tactile_map, *(read_map(place.path) for place in places)))


def unnamed(reports: Sequence[EstimateReport]) -> list[Finding]:
    """Masses of one scan that no row names; the reports are those of all rows of the scan."""
    centres = [one.centre_mm for report in reports for one in report.masses if one.reported]
    found: list[Place] = []
    for at in (one.centre_mm for one in reports[0].masses):
        if all(np.hypot(at.x - one.x, at.y - one.y) > SAME_MM for one in [*centres, *found]):
            found.append(at)
    return [
        Finding("unnamed_mass", f"a mass at ({at.x:.1f}, {at.y:.1f}) mm on the map is named by no row") for at in found
    ]


# --- Visits of a campaign's masses, which are compared for growth.

Visits = dict[str, list[Exam]]  #: Exams of one mass by the code of the visit, in order of time.


def grown_masses(exams: Sequence[Exam]) -> dict[str, Visits]:
    """Masses with exams at several visits, by their names; `read_manifest` refuses visits whose order is not known."""
    found: dict[str, Visits] = defaultdict(lambda: defaultdict(list))
    for exam in exams:
        found[exam.of_visits][exam.visit].append(exam)
    several = {name: visits for name, visits in found.items() if len(visits) > 1}
    return {
        name: {visit: visits[visit] for visit in in_order(visit_dates(visits)) or visits}
        for name, visits in several.items()
    }


def visit_dates(visits: Mapping[str, Sequence[Exam]]) -> dict[str, date | None]:
    """Latest date of each visit's exams; None where none has one."""
    return {
        visit: max((exam.day for exam in exams if exam.day is not None), default=day_of(visit))
        for visit, exams in visits.items()
    }


def days_of(visits: Mapping[str, Sequence[Exam]]) -> tuple[float, ...] | None:
    """Days of the visits from the first; None where one of them has no date."""
    days = list(visit_dates(visits).values())
    first = days[0]
    known = [float((day - first).days) for day in days if day is not None and first is not None]
    return tuple(known) if len(known) == len(days) else None
