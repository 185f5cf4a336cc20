"""What a campaign writes beside the exams: tables, the index, and the trial's report."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Final

from tactile_bayes import __version__
from tactile_bayes.api.trials import analyse, load_trial, read_excision
from tactile_bayes.campaigns.match import growth_rows, growth_text, visit_dates
from tactile_bayes.campaigns.run import Campaign
from tactile_bayes.campaigns.tables import Row, done_text, exam_rows, failures_text, pooled_reports, trial_text
from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import read_protocol
from tactile_bayes.files.manifest_csv import (
    DONE,
    EXAM_PAGE,
    EXAMS,
    FAILURES,
    GROWN,
    JOURNAL,
    MAP_FIGURE,
    REPEATABILITY,
    SIZE_FIGURE,
    SIZED_FIGURE,
    THUMBNAIL,
    TRIAL,
    Exam,
)
from tactile_bayes.files.reading import IMAGE_BYTES, put, read_bytes
from tactile_bayes.files.reports import PooledReport
from tactile_bayes.files.tables import Table
from tactile_bayes.findings import capital
from tactile_bayes.options import TrialSettings
from tactile_bayes.report.campaign_page import (
    FAILED,
    SIZED,
    UNSIZED,
    ExamEntry,
    MassRow,
    VisitEntry,
    campaign_html,
    worst,
)
from tactile_bayes.report.compare import Growth, growth_line
from tactile_bayes.trial.readings import at_excision, in_order

REPORT, PAGE, INDEX = "report.json", "report.html", "index.html"
WRITTEN: Final = (DONE, FAILURES, TRIAL, GROWN, REPORT, PAGE, INDEX, REPEATABILITY)
"""Files beside the exams."""
_MOST_INLINE: Final = 300
"""With more exams the index names its thumbnails' files instead of holding them."""
_MOST_ROWS: Final = 5_000  #: More masses than a browser shows at ease.
_LINKS: Final = (MAP_FIGURE, SIZE_FIGURE, SIZED_FIGURE)


class Excision(Record):
    """Where the sizes after excision are."""

    path: Path  #: Of the table.
    columns: Path | None = None  #: The mapping of a wide table; None for a tidy one.

    def table(self) -> Table:
        """Read and check the table."""
        return read_excision(self.path, self.columns)

    def masses(self) -> set[tuple[str, str]]:
        """Patient and mass of each row."""
        columns = self.table().columns
        return set(zip(columns["patient"], columns["mass"], strict=True))


class Written(Record):
    """What was written, in numbers and words."""

    sized: int
    unsized: int
    failed: int
    """`sized`, `unsized`, `failed`: Exams by how they ended."""
    pooled: int  #: Masses at a visit that were pooled.
    left_out: tuple[str, ...] = ()  #: Masses without a size after excision, as ``patient mass``.
    report: str = ""  #: The trial report as text; empty where there is none.
    no_report: str = ""  #: Why there is none, where excision sizes were given.
    unnamed: tuple[str, ...] = ()  #: Exams whose map shows a mass that no row names.
    growth: str = ""
    """What became of masses with several visits, in a sentence; empty where there are none."""
    disagreeing: tuple[str, ...] = ()
    """Masses at a visit whose exams are not of one size or place."""


def write_outputs(campaign: Campaign, excision: Excision | None, protocol: Path | None = None) -> Written:
    """Write tables, the index and, where excision sizes are given, the trial's report."""
    folder, rows, growth = campaign.folder, exam_rows(campaign), growth_rows(campaign)
    masses = None if excision is None else excision.masses()
    tables = {DONE: done_text(rows), FAILURES: failures_text(campaign, rows), TRIAL: trial_text(campaign, rows, masses)}
    tables |= {GROWN: growth_text(growth)} if growth else {}
    for name, text in tables.items():
        write_text(folder / name, text, force=True)
    report, fault = ("", "") if excision is None else _write_report(folder, excision, protocol, growth)
    for name in (*(() if report else (REPORT, PAGE)), *(() if growth else (GROWN,))):
        (folder / name).unlink(missing_ok=True)
    links = {name: name for name in tables}
    links |= {"trial report": PAGE} if report else {}
    links |= {REPEATABILITY: REPEATABILITY} if campaign.repeatability else {}
    counts = _counts(rows)
    write_text(folder / INDEX, _page(campaign, rows, counts, links, growth), force=True)
    left_out = set() if masses is None else {(row.exam.patient, row.exam.mass) for row in rows} - masses
    return Written(
        *counts,
        pooled=len(campaign.found.results["pool"]),
        left_out=tuple(f"{patient} {mass}" for patient, mass in sorted(left_out)),
        report=report,
        no_report=fault,
        unnamed=tuple(row.exam.name for row in rows if row.has("unnamed_mass")),
        growth=growth_line(growth, GROWN),
        disagreeing=tuple(dict.fromkeys(row.exam.of_mass for row in rows if row.has("maps_disagree"))),
    )


def copy_outputs(folder: Path, address: str) -> None:
    """Copy what lies beside the exams into the object store, and last the journal: with it the copy is whole."""
    for name in (*WRITTEN, JOURNAL):
        if (folder / name).exists():
            put(folder / name, f"{address}/{name}")


def check_inputs(exams: Sequence[Exam], excision: Excision | None, protocol: Path | None) -> None:
    """Read the table of excision sizes and the protocol, so that a fault in them costs no work.

    Codes of patients and masses must be spelled as those of the exams; other patients and masses may be there.
    """
    if protocol is not None and excision is None:
        raise UsageError("--protocol is for the trial's report; give --excision too")
    if excision is not None:
        _check_spelling(excision, exams)
        _check_dates(excision, exams)
    if protocol is not None:
        _trial_settings(protocol)


def _check_spelling(excision: Excision, exams: Iterable[Exam]) -> None:
    """Refuse a row that is of a mass of the exams but for capitals: the mass would be left out of the trial."""
    table = excision.table()
    known = {(exam.patient.casefold(), exam.mass.casefold()): exam for exam in exams}
    for row, (patient, mass) in enumerate(zip(table.columns["patient"], table.columns["mass"], strict=True)):
        exam = known.get((patient.casefold(), mass.casefold()))
        if exam is None:
            continue
        for column, code, spelled in (("patient", patient, exam.patient), ("mass", mass, exam.mass)):
            if code != spelled:
                what = f"{code!r} is {spelled!r} in the table of exams (line {exam.line})"
                raise table.error(row, column, what, way_out="write it one way in both tables")


def _check_dates(excision: Excision, exams: Sequence[Exam]) -> None:
    """Refuse a mass that was excised before every exam."""
    columns = excision.table().columns
    keys = zip(columns["patient"], columns["mass"], strict=True)

    def fault(row: int, column: str, what: str, /, *, way_out: str) -> BadDataError:
        return BadDataError(f"table of exams, line {exams[row].line}, column {column}: {what}", way_out=way_out)

    excised_on = dict(zip(keys, columns["date"], strict=True))
    at_excision([exam.as_reading for exam in exams], excised_on, fault=fault)


def _trial_settings(protocol: Path | None) -> tuple[TrialSettings, str | None]:
    """Settings that a protocol fixes, the others by default, and its title."""
    if protocol is None:
        return TrialSettings(), None
    title, fixed = read_protocol(protocol)
    return TrialSettings(**fixed), title


def _counts(rows: Sequence[Row]) -> tuple[int, int, int]:
    sized = sum(row.size is not None for row in rows)
    failed = sum(row.report is None for row in rows)
    return sized, len(rows) - sized - failed, failed


def _write_report(folder: Path, excision: Excision, protocol: Path | None, growth: Sequence[Growth]) -> tuple[str, str]:
    """Write what `validate` writes for the trial table; returns its text, or why there is none."""
    settings, title = _trial_settings(protocol)
    try:
        inputs = load_trial(folder / TRIAL, excision.path, excision.columns, tidy_trial=True)
        found = analyse(inputs, settings, protocol=protocol, title=title)
    except BadDataError as error:
        return "", error.what
    found.write_json(folder / REPORT, force=True)
    found.write_html(folder / PAGE, growth=growth, force=True)
    return found.told(methods=False), ""


def _page(
    campaign: Campaign,
    rows: Sequence[Row],
    counts: tuple[int, int, int],
    links: Mapping[str, str],
    growth: Sequence[Growth],
) -> str:
    inline = len(rows) <= _MOST_INLINE
    masses = list(_masses(campaign, rows, growth, inline=inline))
    shown = worst(masses, _MOST_ROWS)
    patients = len({row.patient for row in masses})
    lines = [f"{len(masses)} masses of {patients} patients; {len(rows)} exams: {counts_words(*counts)}."]
    if len(shown) < len(masses):
        lines.append(f"Here are the {len(shown)} to be looked at first; all are in {DONE} and {FAILURES}.")
    lines += [repeatability_words(campaign)] if campaign.repeatability else []
    return campaign_html(shown, lines=lines, links=links, version=__version__)


def _masses(campaign: Campaign, rows: Sequence[Row], growth: Sequence[Growth], *, inline: bool) -> Iterator[MassRow]:
    """A row of the index for each mass, in the order of the table."""
    pooled = pooled_reports(campaign)
    changes = {(one.patient, one.mass): one for one in growth}  # the last one of each mass: to its last visit
    masses: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        masses[row.exam.of_visits][row.exam.visit].append(row)
    for visits in masses.values():
        dates = visit_dates({code: [row.exam for row in some] for code, some in visits.items()})
        ordered = in_order(dates) or list(visits)
        first = visits[ordered[0]][0].exam
        yield MassRow(
            first.patient,
            first.mass,
            tuple(_visit(campaign, code, dates[code], visits[code], pooled, inline=inline) for code in ordered),
            first.side or "",
            changes.get((first.patient, first.mass)),
        )


def _visit(
    campaign: Campaign,
    code: str,
    day: date | None,
    rows: Sequence[Row],
    pooled: Mapping[str, PooledReport],
    *,
    inline: bool,
) -> VisitEntry:
    """A visit with its size: the pooled one where there is one, else that of its one exam."""
    exams = tuple(_exam(campaign, row, inline=inline) for row in rows)
    words = code if day is None or day.isoformat() == code else f"{code}, {day.isoformat()}"
    report = pooled.get(rows[0].exam.of_mass)
    if report is not None:
        size = report.leading.max_size_mm
        used = sum(one.status == "estimate" for one in report.maps)
        return VisitEntry(words, exams, size, used if len(rows) > 1 else 0, "" if size else report.reason)
    size = exams[0].size if len(exams) == 1 else None
    reasons = dict.fromkeys(row.reason for row in rows)
    return VisitEntry(words, exams, size, why="" if size else "; ".join(filter(None, reasons)) or "not pooled")


def _exam(campaign: Campaign, row: Row, *, inline: bool) -> ExamEntry:
    exam, folder = row.exam, f"{EXAMS}/{row.exam.name}"
    made = {
        name
        for step in ("map", "estimate", "figures", "size", "page")
        for name in (campaign.found.of(step, exam.name) or {"files": ()})["files"]
        if row.report is not None
    }
    picture: bytes | str | None = f"{folder}/{THUMBNAIL}" if THUMBNAIL in made else None
    if inline and isinstance(picture, str):
        picture = read_bytes(campaign.folder / picture, most=IMAGE_BYTES)
    size = None if row.report is None else row.report.leading.max_size_mm
    reader = f", {exam.reader}" if exam.reader else ""
    return ExamEntry(
        f"visit {exam.visit}, exam {exam.replicate}{reader}",
        FAILED if row.report is None else UNSIZED if size is None else SIZED,
        row.reason,
        size,
        row.findings,
        picture,
        f"{folder}/{EXAM_PAGE}" if EXAM_PAGE in made else "",
        {name: f"{folder}/{name}" for name in _LINKS if name in made},
    )


def repeatability_words(campaign: Campaign) -> str:
    """What the repeats say of the site, and that the sizes are by it; why they do not where they might have."""
    found = campaign.repeatability
    if found is None:
        return f"spread between exams not learned: {campaign.not_learned}" if campaign.not_learned else ""
    words = found.words()
    return f"{capital(words)}; every size is by this spread, learned from the repeats ({REPEATABILITY})."


def counts_words(sized: int, unsized: int, failed: int) -> str:
    """How the exams ended, in words."""
    return f"{sized} sized, {unsized} without a size, {failed} failed"
