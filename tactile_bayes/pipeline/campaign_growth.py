"""Growth between the visits of a campaign's masses: who is compared, and the table of what came of it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import date
from typing import TYPE_CHECKING

from tactile_bayes.files.campaign_names import COMPARED, GROWTH
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.manifest_csv import Exam, table_text
from tactile_bayes.files.schema import load_schema
from tactile_bayes.findings import finding_lines
from tactile_bayes.report.growth import Growth, of_document
from tactile_bayes.trial.visits import day_of, in_order

if TYPE_CHECKING:
    from tactile_bayes.pipeline.campaign import Campaign

Visits = dict[str, list[Exam]]
"""Exams of one mass by the code of the visit, in order of time."""


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


def growth_rows(campaign: Campaign) -> list[Growth]:
    """What `compare` says of each mass with several visits, in order of the masses."""
    compared, rows = campaign.found.results["compare"], []
    for name, visits in grown_masses(campaign.exams).items():
        codes, exam = [*visits], next(iter(visits.values()))[0]
        link = f"{GROWTH}/{name}/{COMPARED}"
        document = load_json(campaign.folder / link) if name in compared else None
        if isinstance(document, dict):
            sized = [
                code for code, exams in visits.items() if any(one.name in compared_names(document) for one in exams)
            ]
            rows += of_document(exam.patient, exam.mass, sized, document, link)
        else:
            fault = campaign.found.faults.get(name)
            reason = "exams of fewer than two visits came through" if fault is None else fault.reason
            rows.append(Growth(exam.patient, exam.mass, codes[0], codes[-1], "failed", campaign.not_compared or reason))
    return rows


def compared_names(document: Mapping[str, object]) -> set[str]:
    """Names of the exams that a comparison is of."""
    visits = document["visits"]
    assert isinstance(visits, list)
    return {one["map"] for visit in visits for one in visit["maps"]}


def growth_text(rows: Sequence[Growth]) -> str:
    """``growth.csv``: a row for each later visit of a mass."""
    return table_text([_line(row) for row in rows], [one["name"] for one in load_schema("growth.table.json")["fields"]])


def _line(row: Growth) -> dict[str, object]:
    first, later = (q["median"] for q in row.sizes_mm) if row.sizes_mm else (None, None)
    ends = {} if row.percent is None else row.percent
    return {
        "patient": row.patient,
        "mass": row.mass,
        "earlier_visit": row.earlier,
        "later_visit": row.later,
        "days": row.days,
        "status": row.status,
        "reason": row.reason or None,
        "earlier_mm": first,
        "later_mm": later,
        "change_percent": ends.get("median"),
        "low_percent": ends.get("low"),
        "high_percent": ends.get("high"),
        "probability": ends.get("probability"),
        "verdict": row.verdict or None,
        "findings": " ".join(finding_lines(row.findings)) or None,
    }
