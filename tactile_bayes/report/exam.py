"""What the page of an exam shows: its maps, the masses on them, and what the scans say of the exam."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tactile_bayes.mapping.clock_face import ClockPosition, clock_position
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.report.masses_document import patient_mm
from tactile_bayes.report.quantities import leading
from tactile_bayes.size.pooling import DISAGREE

Quantity = Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class ExamMass:
    """One mass on a map.

    Parameters
    ----------
    number
        On the map, from 1.
    centre_mm
        x and y in `plane`.
    axes_mm, angle_deg
        Diameters of the ellipse along its own axes, and the angle from x to the first; None without a size.
    largest, smallest
        Largest and smallest size with the intervals that lead, as the estimate's JSON has them; None without.
    probability
        That it is a lump; None where it is not told.
    place
        About the nipple; None where that is not known.
    patient_mm
        From the xiphoid to the patient's right and up; None without landmarks.
    why
        Why there is no size; empty where there is one.
    """

    number: int
    centre_mm: tuple[float, float]
    axes_mm: tuple[float, float] | None = None
    angle_deg: float = 0.0
    largest: Quantity | None = None
    smallest: Quantity | None = None
    probability: float | None = None
    place: ClockPosition | None = None
    patient_mm: tuple[float, float] | None = None
    why: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ExamMap:
    """One map of an exam, with the estimate's JSON object and its masses, the reported one first.

    `tactile_map` is None where only the estimate is at hand.
    """

    tactile_map: TactileMap | None
    document: Mapping[str, Any]
    masses: tuple[ExamMass, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Exam:
    """What one page shows.

    Parameters
    ----------
    maps
        Several are repeats of one mass.
    pooled
        The JSON object of the size from all maps; None with one map.
    scans
        The scans at the beginning, as `Provenance.scans` has them.
    title, name, day
        Given for the page; empty where they were not.
    """

    maps: tuple[ExamMap, ...]
    pooled: Mapping[str, Any] | None = None
    scans: Sequence[Mapping[str, str]] = ()
    title: str = ""
    name: str = ""
    day: str = ""

    @property
    def main(self) -> ExamMap:
        """The map that is drawn large: the first on which there is a mass, else the first."""
        return next((one for one in self.maps if one.masses), self.maps[0])

    @property
    def main_number(self) -> int:
        """Its number among the maps, from 1."""
        return next(number for number, one in enumerate(self.maps, start=1) if one is self.main)

    @property
    def drawn(self) -> ExamMap:
        """The map that is drawn large; of several maps its first mass has the pooled size, in its own shape."""
        if self.pooled is None or self.pooled["max_size_mm"] is None or not self.main.masses:
            return self.main
        first, *others = self.main.masses
        if first.axes_mm is None or first.largest is None:
            return self.main
        size = leading(self.pooled)["max_size_mm"]
        along, across = (axis * size["median"] / first.largest["median"] for axis in first.axes_mm)
        return replace(self.main, masses=(replace(first, axes_mm=(along, across), largest=size), *others))

    @property
    def document(self) -> Mapping[str, Any]:
        """The JSON object of the size that the page reports: the pooled one of several maps."""
        return self.main.document if self.pooled is None else self.pooled

    @property
    def disagrees(self) -> bool:
        """Whether the maps are not of one size, or not of one mass."""
        return self.pooled is not None and self.pooled["status"] == DISAGREE

    @property
    def figures(self) -> Mapping[str, Any]:
        """Figures of the size: spread between exams, whether the lump is oval."""
        found: Mapping[str, Any] = self.document["diagnostics" if self.pooled is None else "figures"]
        return found


def exam_map(tactile_map: TactileMap | None, document: Mapping[str, Any], *, side: str) -> ExamMap:
    """A map with its masses, from what `estimate --json` says of it.

    Parameters
    ----------
    side
        Which breast, as the scans have it.
    """
    return ExamMap(tactile_map, document, tuple(_masses(tactile_map, document, side)))


def _masses(tactile_map: TactileMap | None, document: Mapping[str, Any], side: str) -> Iterator[ExamMass]:
    """The reported mass first, then the others in the JSON's order."""
    listed = document["masses"]
    if document["centre_mm"] is not None:
        number = next((one["number"] for one in listed if one["reported"]), 1)
        yield _reported(number, tactile_map, document, side)
    for one in listed:
        if not one["reported"]:
            yield _listed(one, tactile_map, side)


def _reported(number: int, tactile_map: TactileMap | None, document: Mapping[str, Any], side: str) -> ExamMass:
    point, angle = document["centre_mm"], document["angle_deg"]
    sized = document["max_size_mm"] is not None
    leads = leading(document)
    return _placed(
        number,
        (point["x"]["median"], point["y"]["median"]),
        tactile_map,
        side,
        told=document,
        centre_sd_mm=(point["x"]["sd"], point["y"]["sd"]),
        axes_mm=(document["d_x_mm"]["median"], document["d_y_mm"]["median"]) if sized else None,
        angle_deg=0.0 if angle is None else angle["median"],
        largest=leads["max_size_mm"],
        smallest=leads["min_size_mm"],
        probability=document["detected_probability"],
        why="" if sized else document["reason"],
    )


def _listed(one: Mapping[str, Any], tactile_map: TactileMap | None, side: str) -> ExamMass:
    """A mass besides the reported one."""
    leads, angle = leading(one), one["angle_deg"]
    largest, along, across = leads["max_size_mm"], one["d_x_mm"], one["d_y_mm"]
    return _placed(
        one["number"],
        (one["centre_mm"]["x"], one["centre_mm"]["y"]),
        tactile_map,
        side,
        told=one,
        axes_mm=None if largest is None else (along["median"], across["median"]),
        angle_deg=0.0 if angle is None else angle["median"],
        largest=largest,
        smallest=leads["min_size_mm"],
        probability=one["detected_probability"],
        why=one["reason"],
    )


def _placed(
    number: int,
    centre_mm: tuple[float, float],
    tactile_map: TactileMap | None,
    side: str,
    *,
    told: Mapping[str, Any] | None = None,
    centre_sd_mm: tuple[float, float] = (0.0, 0.0),
    **facts: Any,
) -> ExamMass:
    """A mass with its place: by the map, or as its estimate has `told` it where that is all there is."""
    if tactile_map is None:
        said = told or {}
        place = ClockPosition.of_dict(said.get("position"))
        return ExamMass(number, centre_mm, place=place, patient_mm=_point(said.get("centre_patient_mm")), **facts)
    covariance = np.diag(np.square(centre_sd_mm))
    place = clock_position(tactile_map, centre_mm, side=side, covariance_mm2=covariance)
    return ExamMass(number, centre_mm, place=place, patient_mm=patient_mm(tactile_map, *centre_mm), **facts)


def _point(point: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """x and y in mm of an estimate's JSON; of a quantity its median."""
    if point is None:
        return None
    x, y = (point[axis]["median"] if isinstance(point[axis], Mapping) else point[axis] for axis in "xy")
    return float(x), float(y)
