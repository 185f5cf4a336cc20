"""The index of a campaign: a row for each mass of a patient, over all its visits."""

from __future__ import annotations

import base64
import hashlib
import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final
from urllib.parse import quote

from tactile_bayes.declarations import Record, field
from tactile_bayes.findings import SEVERITIES, Finding, finding_lines
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.pages import TEMPLATES, Growth, page
from tactile_bayes.report.svg import THUMB_ENDS, THUMB_SCALE, colour_steps

STATUSES: Final = ("failed", "without a size", "sized")
"""How an exam or a mass ended, those to be looked at first before the others."""
FAILED, UNSIZED, SIZED = STATUSES


class ExamEntry(Record, eq=False):
    """One exam of a visit."""

    words: str  #: Such as ``visit 1, exam 2``.
    reason: str = ""  #: Why there is no size; empty where there is one.
    size: Quantity | None = None  #: Largest size, mm, with the interval that leads; None without one.
    findings: tuple[Finding, ...] = ()  #: What speaks against the exam.
    thumbnail: bytes | str | None = None
    """SVG of the map, or the name of its file from the page's folder; None without one."""
    page: str = ""  #: The exam's page from the index's folder; empty without one.
    links: Mapping[str, str] = field(default_factory=dict)  #: Other files of the exam, by the words of their links.
    failed: bool = False  #: Whether a step failed, for the reason.

    @property
    def status(self) -> str:
        """One of `STATUSES`."""
        return FAILED if self.failed else UNSIZED if self.size is None else SIZED

    @property
    def source(self) -> str:
        """Address of the picture; empty without one."""
        if self.thumbnail is None or isinstance(self.thumbnail, str):
            return quote(self.thumbnail or "")
        return f"data:image/svg+xml;base64,{base64.b64encode(self.thumbnail).decode('ascii')}"


class VisitEntry(Record, eq=False):
    """One visit of a mass with its exams."""

    words: str  #: Code and date.
    exams: tuple[ExamEntry, ...]
    size: Quantity | None = None
    """Largest size, mm, with the interval that leads, of all exams together where they were pooled; None without."""
    pooled: int = 0  #: How many exams the size is pooled from; 0 where it is one exam's.
    why: str = ""  #: Why there is no size; empty where there is one.


class MassEntry(Record, eq=False):
    """One mass of a patient."""

    patient: str
    mass: str
    visits: tuple[VisitEntry, ...]  #: In order of time.
    side: str = ""
    growth: Growth | None = None  #: From the first visit to the last; None with one visit.

    @property
    def name(self) -> str:
        return f"{self.patient} {self.mass}"

    @property
    def last(self) -> VisitEntry:
        return self.visits[-1]

    @property
    def exams(self) -> list[ExamEntry]:
        return [exam for visit in self.visits for exam in visit.exams]

    @property
    def status(self) -> str:
        """One of `STATUSES`, by the last visit; failed if all of its exams are."""
        if self.last.size is not None:
            return SIZED
        return FAILED if all(exam.failed for exam in self.last.exams) else UNSIZED

    @property
    def remarks(self) -> Iterator[tuple[str, str]]:
        """Severity and text of each finding, once, those of the comparison last; those not of all exams name theirs."""
        every = self.exams
        known = {finding.text for exam in every for finding in exam.findings}
        compared = [] if self.growth is None else [one for one in self.growth.findings if one.text not in known]
        for severity in SEVERITIES:
            of: dict[str, list[str]] = {}
            for exam in every:
                for text in finding_lines(exam.findings, severity, paper=True):
                    of.setdefault(text, []).append(exam.words)
            for text, exams in of.items():
                yield severity, text if len(exams) == len(every) else f"{text} ({'; '.join(exams)})"
            yield from ((severity, text) for text in finding_lines(compared, severity, paper=True))
        for exam in every:
            if exam.failed:
                yield "caution", f"{exam.words}: {exam.reason}"

    @property
    def badness(self) -> tuple[int, int, int, float]:
        """Sort key: masses to be looked at first come first."""
        failed = sum(exam.failed for exam in self.exams)
        doubts = sum(10 if one.severity == "caution" else 1 for exam in self.exams for one in exam.findings)
        return STATUSES.index(self.status), -failed, -doubts, -self.width

    @property
    def width(self) -> float:
        """Width of the last size's interval in parts of the size; 0 without one."""
        size = self.last.size
        return 0.0 if size is None else (size.high - size.low) / size.median


WORST_FIRST: Final = (
    "First come masses whose exams failed, then those without a size at the last visit, then those with failed exams, "
    "then those with most cautions and checks, then those with the widest interval for their size."
)


def worst(rows: Iterable[MassEntry], most: int) -> list[MassEntry]:
    """Up to `most` rows, those to be looked at first before the others; see `WORST_FIRST`."""
    return heapq.nsmallest(most, rows, key=lambda row: (row.badness, row.name))


def campaign_html(rows: Sequence[MassEntry], *, lines: Sequence[str], links: Mapping[str, str]) -> str:
    """Full page of the rows in their order; only thumbnails beside it are loaded, and its one script filters and sorts.

    `lines`: the summary in sentences; `links`: files beside the page by the words of their links.
    """
    script = "\n" + (TEMPLATES / "campaign.js").read_text(encoding="utf-8")
    apart = any(isinstance(exam.thumbnail, str) for row in rows for exam in row.exams)
    return page(
        "campaign",
        title="Masses of a campaign",
        images="'self' file:" if apart else "data:",
        script_sha256=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        script=script,
        lines=lines,
        order=WORST_FIRST,
        beside=links,
        counts={status: sum(row.status == status for row in rows) for status in STATUSES},
        rows=rows,
        growing=any(row.growth is not None for row in rows),
        scale=THUMB_SCALE,
        colours=colour_steps(THUMB_ENDS, "of the level beside the lump; all maps", more=True),
    )
