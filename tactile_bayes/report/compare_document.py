"""A comparison of visits as plain data: the object that `compare --json` prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import verdict as verdict_of
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.inference.summary import nine_digits
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.visits import VOLUME, Trend, doubling_days, straight_line

if TYPE_CHECKING:
    from tactile_bayes.size.site import Repeatability
    from tactile_bayes.size.visits import Apart, Change, Compared, JointSizes

SCHEMA: Final = "tactile-bayes/compare/1"
SHOWN: Final = 0.95
"""Probability of the interval that leaves out no change where a growth, or a shrinkage, is called one."""


def compare_document(
    compared: Compared,
    visits: Sequence[Sequence[Mapping[str, Any]]],
    names: Sequence[Sequence[str]],
    *,
    days: Sequence[float] | None,
    grown_by: Sequence[float],
    probability: float,
    provenance: Provenance,
    repeatability: Repeatability | None = None,
) -> dict[str, Any]:
    """JSON object of a comparison, see data_schema/compare.schema.json.

    Parameters
    ----------
    visits, names
        What `estimate` says of each visit's maps, and the maps' names.
    days
        Time of each visit; None where it is not known.
    grown_by
        Shares of the diameter.
    repeatability
        Of the site, where the comparison used one.
    """
    joint = compared.joint
    changes: list[dict[str, Any]] = []
    if joint is not None:
        changes = [
            _change(joint, compared.another, later, days=days, grown_by=grown_by, probability=probability)
            for later in range(1, len(visits))
        ]
    used = None if joint is None else joint.calibrations[0]
    return {
        "schema": SCHEMA,
        "status": compared.status,
        "verdict": verdict_of(compared.findings, answered=joint is not None),
        "findings": [one.as_dict() for one in compared.findings],
        "reason": compared.reason,
        "advice": compared.advice,
        "visits": [
            _visit(i, visits[i], names[i], joint, day=None if days is None else days[i], probability=probability)
            for i in range(len(visits))
        ],
        "places": [_apart(number, one) for number, one in enumerate(compared.apart, start=2)],
        "changes": changes,
        "trend": None if joint is None or days is None or len(visits) < 3 else _trend(joint, days, probability),
        "between_map_sd": None if joint is None else nine_digits(joint.between_map_sd),
        **({} if repeatability is None else {"repeatability": repeatability.words()}),
        "left_out": [] if used is None else used.omissions(),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def _visit(
    index: int,
    documents: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    joint: JointSizes | None,
    *,
    day: float | None,
    probability: float,
) -> dict[str, Any]:
    fat_mm = None if joint is None else joint.calibrations[index].fat_mm
    return {
        "visit": index + 1,
        "day": day,
        "max_size_mm": None if joint is None else joint.size_mm(index, probability).as_dict(),
        "fat_mm": None if fat_mm is None else nine_digits(fat_mm),
        "maps": [
            {"map": name, **{key: one.get(key) for key in ("status", "reason", "detected_probability")}}
            for name, one in zip(names, documents, strict=True)
        ],
    }


def _apart(visit: int, found: Apart | None) -> dict[str, Any]:
    """How far a visit's mass lies from the first's."""
    if found is None:
        return {"visit": visit, "distance_mm": None, "sd_mm": None, "shift_mm": None, "probability": None}
    return {
        "visit": visit,
        "distance_mm": nine_digits(found.distance_mm),
        "sd_mm": nine_digits(found.sd_mm),
        "shift_mm": [nine_digits(value) for value in found.shift_mm],
        "probability": nine_digits(found.probability),
    }


def _change(
    joint: JointSizes,
    another: JointSizes | None,
    later: int,
    *,
    days: Sequence[float] | None,
    grown_by: Sequence[float],
    probability: float,
) -> dict[str, Any]:
    """Change from the first visit to a later one."""
    change = joint.change(0, later)
    growth, shrinkage = (nine_digits(100.0 * share) for share in change.smallest_detectable(SHOWN))
    return {
        "earlier": 1,
        "later": later + 1,
        "verdict": verdict(change),
        "log_ratio": change.log_summary(probability).as_dict(),
        "percent": change.percent(probability).as_dict(),
        "probability_grown": nine_digits(change.probability_above(0.0)),
        "grown_by": [
            {"percent": nine_digits(100.0 * share), "probability": nine_digits(change.probability_above(share))}
            for share in grown_by
        ],
        "smallest_detectable_percent": {"growth": growth, "shrinkage": shrinkage},
        "growth_rate": None if days is None else _rate(change, days[later] - days[0], probability),
        "another_exam": None if another is None else _another(another, later, probability),
    }


def verdict(change: Change) -> str:
    """``"grown"`` or ``"shrunk"`` where the 95 % interval leaves out no change, else ``"no_change_shown"``."""
    q = change.log_summary(SHOWN)
    if q.low > 0.0:
        return "grown"
    return "shrunk" if q.high < 0.0 else "no_change_shown"


def _another(another: JointSizes, later: int, probability: float) -> dict[str, Any]:
    """The change if exams of one mass differ as the paper's maps do."""
    change = another.change(0, later)
    return {
        "between_map_sd": nine_digits(another.between_map_sd),
        "percent": change.percent(probability).as_dict(),
        "probability_grown": nine_digits(change.probability_above(0.0)),
    }


def _rate(change: Change, days: float, probability: float) -> dict[str, Any]:
    """Specific growth rate of the volume between two visits."""
    q = change.log_summary(probability)
    median, low, high = (VOLUME * one / days for one in (q.median, q.low, q.high))
    return _rates(days, median, (low, high), probability=probability)


def _rates(days: float, median: float, ends: tuple[float, float], *, probability: float) -> dict[str, Any]:
    """A growth rate in percent of the volume per day, and the doubling times at its median and its ends."""
    low, high = ends
    times = {"median": doubling_days(median), "shortest": doubling_days(high), "longest": doubling_days(low)}
    return {
        "days": days,
        "percent_per_day": {
            "median": nine_digits(100.0 * median),
            "low": nine_digits(100.0 * low),
            "high": nine_digits(100.0 * high),
            "probability": probability,
        },
        "doubling_days": {name: None if one is None else nine_digits(one) for name, one in times.items()},
    }


def _trend(joint: JointSizes, days: Sequence[float], probability: float) -> dict[str, Any]:
    """Straight line of ln d over all visits."""
    line: Trend = straight_line(*joint.moments, days)
    half = float(normal_quantile(np.array(0.5 + probability / 2))) * line.sd
    ends = VOLUME * (line.per_day - half), VOLUME * (line.per_day + half)
    departure = None if line.departure is None else nine_digits(line.departure)
    rates = _rates(days[-1] - days[0], VOLUME * line.per_day, ends, probability=probability)
    return {"visits": len(days), **rates, "straight_line_probability": departure}
