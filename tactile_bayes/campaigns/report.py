"""A campaign's tables, index page and trial report, beside the folders of its exams."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from tactile_bayes.api.trials import analyse, load_trial, read_excision, settings_by
from tactile_bayes.campaigns.exams import MassPlace, masses_with_visits, unnamed_masses, visit_dates, visits_by_mass
from tactile_bayes.campaigns.run import FEW, Campaign
from tactile_bayes.campaigns.steps import CampaignSettings
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import CANNOT_SHOW, BadDataError, UsageError
from tactile_bayes.files import manifest_csv as layout
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.files.reading import IMAGE_BYTES, read_bytes
from tactile_bayes.files.reports import EstimateReport, PooledReport, centre_of
from tactile_bayes.files.tables import Table
from tactile_bayes.findings import Finding, by_severity, capitalised, counted, finding_lines, first_of, verdict
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.campaign_page import ExamEntry, MassEntry, VisitEntry, campaign_html, worst
from tactile_bayes.report.compare import CompareReport, growths
from tactile_bayes.report.exam_words import reason_on_paper
from tactile_bayes.report.pages import Growth, growth_line
from tactile_bayes.trial.readings import at_excision, day_of, same_code

# --- Tables: exams done, failures, and the trial table that `validate` takes.

TACTILE, POOLED_MODALITY = "tactile", "tactile-pooled"
_SIZES: Final = {"size_mm": "median", "sd_mm": "sd", "low_mm": "low", "high_mm": "high", "probability": "probability"}

Pooled = Mapping[str, PooledReport]  #: Each pooled mass, by its name.


class ExamRow(Record, eq=False):
    """One exam as the tables and the index show it: of its report this alone stays in memory."""

    exam: Exam  #: Of exams.csv.
    status: str
    """As the trial table has it: an exam without an estimate looked for the mass in vain, others were not done."""
    reason: str = ""  #: Why there is no size; empty where there is one.
    on_paper: str = ""  #: The same as the exam's page says it.
    failed: bool = False  #: Whether a step failed, for the reason.
    size: Quantity | None = None  #: Largest size with the interval of the tables; None without one.
    leading: Quantity | None = None  #: The same with the interval that pages lead with.
    smallest_mm: float | None = None
    detected_probability: float | None = None
    centre_mm: tuple[float, float] | None = None
    masses: tuple[MassPlace, ...] = ()  #: All masses of its map.
    scans: tuple[Mapping[str, str], ...] = ()
    synthetic: bool | None = None
    """`scans`, `synthetic`: Of the file: digests and facts, whether it is simulated (None: unknown)."""
    findings: tuple[Finding, ...] = ()  #: Findings on its estimate, on the pooled size of its mass, and on the table.

    @classmethod
    def of(cls, exam: Exam, report: EstimateReport, **facts: Any) -> ExamRow:
        """An exam with its estimate, by the campaign's repeatability where it has one; `facts` are of its file."""
        size, smallest = report.max_size_mm, report.min_size_mm
        return cls(
            exam,
            _status(report),
            "" if size is not None else report.reason,
            "" if size is not None else reason_on_paper(report),
            size=size,
            leading=report.leading.max_size_mm,
            smallest_mm=None if smallest is None else smallest.median,
            detected_probability=report.detected_probability,
            centre_mm=centre_of(report.centre_mm),
            masses=tuple((mass.centre_mm, mass.reported) for mass in report.masses),
            findings=report.findings,
            **facts,
        )


def _status(report: EstimateReport | PooledReport) -> str:
    if report.max_size_mm is not None:
        return "detected"
    silent = isinstance(report, EstimateReport) and report.reason_code == CANNOT_SHOW
    return "not_detected" if report.status == "no_estimate" and not silent else "not_done"


def exam_rows(campaign: Campaign, pooled: Pooled) -> list[ExamRow]:
    """Every exam of the table, in its order; `pooled` are the masses by their names."""
    pooled_of, rows = _pooled_findings(pooled.values()), [_exam_row(campaign, exam) for exam in campaign.exams]
    of_scan: dict[Path, list[ExamRow]] = defaultdict(list)
    for row in rows:
        if not row.failed:
            of_scan[row.exam.path].append(row)
    unnamed_of = {path: unnamed_masses([row.masses for row in some]) for path, some in of_scan.items()}
    for index, row in enumerate(rows):
        if not row.failed:
            findings = (*row.findings, *pooled_of.get(row.exam.name, ()), *unnamed_of[row.exam.path])
            rows[index] = replace(row, findings=by_severity(findings))
    return rows


def _pooled_findings(pooled: Iterable[PooledReport]) -> dict[str, tuple[Finding, ...]]:
    """Findings of pooled sizes by the exam that they are about, or by all exams of the mass."""
    return {
        name: tuple(
            replace(one, about="")
            for one in report.findings
            if one.about in ("", f"map {number}") and one.kind != "several_masses"  # its row says which mass it is of
        )
        for report in pooled
        for number, name in enumerate((one.map for one in report.maps), start=1)
    }


def _exam_row(campaign: Campaign, exam: Exam) -> ExamRow:
    fault = campaign.faults.get(exam.name)
    mapped = campaign.result("map", exam.name)
    facts: dict[str, Any] = {"scans": tuple(mapped.get("scans", ())), "synthetic": mapped.get("synthetic")}
    if fault is not None and fault.step not in ("figures", "page"):
        reason = f"{fault.step} failed: {fault.reason}"
        return ExamRow(exam, "not_done", reason, reason, failed=True, **facts)
    by_site = layout.SIZED in campaign.files("size", exam.name)
    place = campaign.folder / layout.EXAMS / exam.name / (layout.SIZED if by_site else layout.ESTIMATE)
    return ExamRow.of(exam, read_record(place, EstimateReport), **facts)


def pooled_reports(campaign: Campaign) -> Pooled:
    """Each pooled mass, by its name."""
    folder = campaign.folder / layout.MASSES
    return {name: read_record(folder / name / layout.POOLED, PooledReport) for name in campaign.keys["pool"]}


def done_line(row: ExamRow) -> dict[str, object]:
    """An exam in ``exams_done.csv``: with an estimate, or with the reason for none."""
    x_mm, y_mm = row.centre_mm or (None, None)
    return {
        **_exam_cells(row.exam),
        "folder": f"{layout.EXAMS}/{row.exam.name}",
        "scan_sha256": " ".join(scan["sha256"] for scan in row.scans if "sha256" in scan),
        "status": row.status,
        "reason": row.reason,
        **_quantity_cells(row.size, _SIZES),
        "smallest_mm": row.smallest_mm,
        "detected_probability": row.detected_probability,
        "centre_x_mm": x_mm,
        "centre_y_mm": y_mm,
        "verdict": verdict(row.findings, answered=row.size is not None),
        "findings": " ".join(finding_lines(row.findings)),
        "synthetic": row.synthetic,
    }


def _exam_cells(exam: Exam) -> dict[str, object]:
    """Cells that name an exam, by the tables' columns."""
    return {name: getattr(exam, name) for name in ("patient", "visit", "mass", "replicate", "side", "reader", "file")}


def _quantity_cells(quantity: Quantity | None, names: Mapping[str, str]) -> dict[str, object]:
    """Cells of a quantity's figures, by their columns; none without a quantity."""
    return {} if quantity is None else {column: getattr(quantity, name) for column, name in names.items()}


def failure_lines(campaign: Campaign, rows: Sequence[ExamRow]) -> list[dict[str, object]]:
    """``failures.csv``: exams, and masses that could not be pooled or compared, with the step and the reason."""
    cells = {row.exam.name: _exam_cells(row.exam) for row in rows}
    cells |= {row.exam.of_mass: {**_exam_cells(row.exam), "replicate": None, "file": None} for row in rows}
    blank = {"visit": None, "replicate": None, "file": None}
    cells |= {row.exam.of_visits: {**_exam_cells(row.exam), **blank} for row in rows}
    faults = ((name, campaign.faults[name]) for name in cells if name in campaign.faults)
    return [cells[name] | {"step": fault.step, "reason": fault.reason} for name, fault in faults]


def trial_lines(
    campaign: Campaign, rows: Sequence[ExamRow], pooled: Pooled, masses: Collection[tuple[str, str]] | None
) -> list[dict[str, object]]:
    """``trial.csv``: every exam as a reading of ``tactile``, every pooled visit as one of ``tactile-pooled``.

    `masses` have a size after excision: the others are left out. None takes all. Numbers run over the visits of a mass.
    """
    in_trial = [row for row in rows if masses is None or (row.exam.patient, row.exam.mass) in masses]
    readings = [_trial_reading(row, TACTILE, reader=row.exam.reader) for row in in_trial]
    visits: dict[str, list[ExamRow]] = defaultdict(list)
    for row in in_trial if pooled else ():
        visits[row.exam.of_mass].append(row)
    pooled_rows = (_pooled_row(campaign, some, pooled.get(name)) for name, some in visits.items())
    readings += [_trial_reading(row, POOLED_MODALITY) for row in pooled_rows]
    count: Counter[tuple[object, ...]] = Counter()
    for reading in readings:
        key = (reading["patient"], reading["mass"], reading["modality"])
        count[key] += 1
        reading["replicate"] = count[key]
    return readings


def _pooled_row(campaign: Campaign, rows: Sequence[ExamRow], report: PooledReport | None) -> ExamRow:
    """A mass at a visit, by all of its exams, the last day of which counts."""
    exam = replace(rows[-1].exam, day=campaign.days.get(rows[-1].exam.of_mass))
    known = [row.synthetic for row in rows if row.synthetic is not None]  # a failed exam does not say
    synthetic = any(known) if known else None
    if report is None:
        fault = campaign.faults.get(exam.of_mass)
        reason = "every exam failed" if fault is None else f"{fault.step} failed: {fault.reason}"
        return ExamRow(exam, "not_done", reason, synthetic=synthetic)
    silent = all(row.status == "not_done" for row in rows)
    status = "not_done" if silent and report.max_size_mm is None else _status(report)
    return ExamRow(exam, status, report.reason, size=report.max_size_mm, synthetic=synthetic)


def _trial_reading(row: ExamRow, modality: str, *, reader: str | None = None) -> dict[str, object]:
    return {
        **_exam_cells(row.exam),
        "modality": modality,
        "status": row.status,
        **_quantity_cells(row.size, _SIZES),
        "reader": reader,
        "date": row.exam.day,
        "reason": (row.reason or None) if row.status != "detected" else None,
        "synthetic": row.synthetic,
    }


def growth_rows(campaign: Campaign) -> list[Growth]:
    """Change of each mass with several visits, in order of the masses."""
    compared, rows = campaign.keys["compare"], list[Growth]()
    for name, visits in masses_with_visits(campaign.exams, campaign.days).items():
        codes, exam = [*visits], next(iter(visits.values()))[0]
        place = f"{layout.GROWTH}/{name}"
        if name in compared:
            report = read_record(campaign.folder / place / layout.COMPARED, CompareReport)
            compared_visits = [*campaign.growing[name]]
            rows += growths(exam.patient, exam.mass, compared_visits, report, f"{place}/{layout.GROWTH_PAGE}")
        else:
            fault = campaign.faults.get(name)
            reason = "exams of fewer than two visits came through" if fault is None else fault.reason
            rows.append(Growth(exam.patient, exam.mass, codes[0], codes[-1], "failed", campaign.not_compared or reason))
    return rows


def grown_line(row: Growth) -> dict[str, object]:
    """A later visit of a mass in ``growth.csv``."""
    first, later = (q.median for q in row.sizes_mm) if row.sizes_mm else (None, None)
    names = {"change_percent": "median", "low_percent": "low", "high_percent": "high", "probability": "probability"}
    return {
        "patient": row.patient,
        "mass": row.mass,
        "earlier_visit": row.earlier,
        "later_visit": row.later,
        "days": row.days,
        "status": row.status,
        "reason": row.reason,
        "earlier_mm": first,
        "later_mm": later,
        **_quantity_cells(row.percent, names),
        "verdict": row.verdict,
        "findings": " ".join(finding_lines(row.findings)),
    }


# --- Tables, index and report as files.

REPORT, PAGE, INDEX = "report.json", "report.html", "index.html"
WRITTEN: Final = (layout.DONE, layout.FAILURES, layout.TRIAL, layout.GROWN, REPORT, PAGE, INDEX, layout.REPEATABILITY)
"""Files beside the exams."""
_MOST_INLINE: Final = 300  #: With more exams the index names its thumbnails' files instead of holding them.
_MOST_ROWS: Final = 5_000  #: More masses than a browser shows at ease.
_LINKS: Final = (layout.MAP_FIGURE, layout.SIZE_FIGURE, layout.SIZED_FIGURE)


class Written(Record):
    """Summary of the written files, in words."""

    counts: str  #: How the exams ended.
    masses: tuple[str, ...]  #: What became of masses with several exams or visits, a line each.
    doubts: tuple[str, ...]  #: What is to be looked at, a line each.
    report: str  #: The trial report as text; empty where there is none.


def write_outputs(campaign: Campaign, *, unlisted: Sequence[str] = ()) -> Written:
    """Write tables, the index and, where excision sizes are given, the trial's report.

    `unlisted` are folders of exams that the table does not list.
    """
    folder, pooled, by_trial = campaign.folder, pooled_reports(campaign), campaign.settings.excision is not None
    rows, growth, masses = exam_rows(campaign, pooled), growth_rows(campaign), set(campaign.excised_on)
    tables = {
        layout.DONE: [done_line(row) for row in rows if not row.failed],
        layout.FAILURES: failure_lines(campaign, rows),
        layout.TRIAL: trial_lines(campaign, rows, pooled, masses if by_trial else None),
        **({layout.GROWN: [grown_line(one) for one in growth]} if growth else {}),
    }
    for name, lines in tables.items():
        columns = [column for column in layout.columns_of(Path(name).stem) if column != "posterior"]
        write_text(folder / name, layout.table_text(lines, columns), force=True)
    report, fault = _write_report(folder, campaign.settings, growth) if by_trial else ("", "")
    if not tables[layout.TRIAL]:
        fault = "no exam is of a mass with a size after excision"
    for name in (*(() if report else (REPORT, PAGE)), *(() if growth else (layout.GROWN,))):
        (folder / name).unlink(missing_ok=True)
    links = {name: name for name in tables}
    links |= {"trial report": PAGE} if report else {}
    links |= {layout.REPEATABILITY: layout.REPEATABILITY} if campaign.repeatability else {}
    sized, failed = sum(row.size is not None for row in rows), sum(row.failed for row in rows)
    counts = f"{sized} sized, {len(rows) - sized - failed} without a size, {failed} failed"
    write_text(folder / INDEX, index_html(campaign, rows, pooled, growth, counts=counts, links=links), force=True)
    examined = {(row.exam.patient, row.exam.mass) for row in rows}
    left_out = sorted(examined - masses) if by_trial else []
    doubts = {
        "no size after excision, left out of trial.csv": [" ".join(mass) for mass in left_out],
        "sizes after excision of masses without an exam": [" ".join(mass) for mass in sorted(masses - examined)],
        "exams with a caution, see their findings": _names_with_finding(rows, "caution", "name"),
        "masses whose exams disagree, without a pooled size": _names_with_finding(rows, "maps_disagree", "of_mass"),
        "exams with a mass that no row names, see their findings": _names_with_finding(rows, "unnamed_mass", "name"),
        **_dated_doubts(campaign.exams, campaign.excised_on),
        "folders of exams that the table does not list": unlisted,
    }
    doubtful = [f"{words}: {first_of(names, FEW)}" for words, names in doubts.items() if names]
    together = _pooled_words(campaign, pooled), repeatability_words(campaign), growth_line(growth, layout.GROWN)
    return Written(
        counts,
        tuple(filter(None, together)),
        (*doubtful, *([f"no trial report: {fault}"] if fault else [])),
        report,
    )


def _dated_doubts(exams: Sequence[Exam], excised_on: Mapping[tuple[str, str], date | None]) -> dict[str, list[str]]:
    """Visits of masses with exams of several days, and those after excision, by what is told of them."""
    last_day = {exam.of_mass: excised_on.get((exam.patient, exam.mass)) or date.max for exam in exams}
    days_of = defaultdict[str, set[date]](set)
    for exam in exams:
        if day := exam.day or day_of(exam.visit):
            days_of[exam.of_mass].add(day)
    return {
        "exams of one visit on several days, the last of which counts": [
            name for name, days in days_of.items() if len(days) > 1
        ],
        "visits after excision, left out of the report and in growth.csv with a caution": [
            name for name, days in days_of.items() if max(days) > last_day[name]
        ],
    }


def _pooled_words(campaign: Campaign, pooled: Pooled) -> str:
    """How many masses were pooled, and how many of them have a size; else why none was."""
    if not pooled:
        return f"no mass pooled: {campaign.not_pooled}" if campaign.not_pooled else ""
    masses = len({exam.of_visits for exam in campaign.exams if exam.of_mass in pooled})
    what = f"{counted(masses, 'mass')} pooled, each at one visit"
    if masses < len(pooled):
        what = f"{len(pooled)} visits of {counted(masses, 'mass')} pooled, each by itself"
    sized = sum(one.max_size_mm is not None for one in pooled.values())
    return f"{what}: {sized} sized, {len(pooled) - sized} without a size"


def _names_with_finding(rows: Sequence[ExamRow], sought: str, name: str) -> list[str]:
    """Names of the exams, or of their masses, with a finding of the kind or severity, each once."""
    exams = (row.exam for row in rows if any(sought in (one.kind, one.severity) for one in row.findings))
    return list(dict.fromkeys(getattr(exam, name) for exam in exams))


def check_inputs(exams: Sequence[Exam], settings: CampaignSettings) -> dict[tuple[str, str], date | None]:
    """Read the table of excision sizes and the protocol, so that a fault in them costs no work.

    Returns the days of excision, None where a row has none, by patient and mass in the order of the rows. Their codes
    must be spelled as those of the exams; others may be there. A mass that was excised before every exam is refused.
    """
    if settings.excision is None:
        purposes = {"columns": "is the layout of the excision table", "protocol": "is for the trial's report"}
        for option, purpose in purposes.items():
            if getattr(settings, option) is not None:
                raise UsageError(f"--{option} {purpose}; give --excision too")
        return {}
    settings_by(settings.protocol)
    table = read_excision(settings.excision, settings.columns)
    _check_spelling(table, exams)
    patients, masses, days = (table.columns[name] for name in ("patient", "mass", "date"))
    excised_on = dict(zip(zip(patients, masses, strict=True), days, strict=True))

    def fault(row: int, column: str, words: str, /, *, way_out: str) -> BadDataError:
        where = f"table of exams, line {exams[row].line}, column {column}"
        return BadDataError(f"{where}: {words}", way_out=way_out)

    at_excision([exam.as_reading for exam in exams], excised_on, fault=fault)
    return excised_on


def _check_spelling(table: Table, exams: Iterable[Exam]) -> None:
    """Refuse a row that is of a mass of the exams by `same_code`: the mass would be left out of the trial."""
    known = {(same_code(exam.patient), same_code(exam.mass)): exam for exam in exams}
    for row, (patient, mass) in enumerate(zip(table.columns["patient"], table.columns["mass"], strict=True)):
        exam = known.get((same_code(patient), same_code(mass)))
        if exam is None:
            continue
        for column, code, spelled in (("patient", patient, exam.patient), ("mass", mass, exam.mass)):
            if code != spelled:
                words = f"{code!r} is {spelled!r} in the table of exams (line {exam.line})"
                raise table.error(row, column, words, way_out="write it one way in both tables")


def _write_report(folder: Path, settings: CampaignSettings, growth: Sequence[Growth]) -> tuple[str, str]:
    """Write the files of `validate` for the trial table; returns the report's text, and the fault if there is none."""
    title, trial_settings = settings_by(settings.protocol)
    assert settings.excision is not None
    try:
        inputs = load_trial(folder / layout.TRIAL, settings.excision, settings.columns, tidy_trial=True)
        analysis = analyse(inputs, trial_settings, protocol=settings.protocol, title=title)
    except BadDataError as error:
        return "", error.what
    analysis.write_json(folder / REPORT, force=True)
    analysis.write_html(folder / PAGE, growth=growth, force=True)
    return analysis.text_with(methods=False), ""


def index_html(
    campaign: Campaign,
    rows: Sequence[ExamRow],
    pooled: Pooled,
    growth: Sequence[Growth],
    *,
    counts: str,
    links: dict[str, str],
) -> str:
    """The index: a row for each mass, in the order of the table."""
    changes = {(one.patient, one.mass): one for one in growth}  # the last one of each mass: to its last visit
    row_of, masses = {row.exam.name: row for row in rows}, []
    for visits in visits_by_mass(campaign.exams, campaign.days).values():
        dates, entries = visit_dates(visits, campaign.days), []
        for code, of_visit in visits.items():
            some = [row_of[exam.name] for exam in of_visit]
            exams = tuple(_exam_entry(campaign, row, inline=len(rows) <= _MOST_INLINE) for row in some)
            entries.append(_visit_entry(dates[code], some, exams, pooled.get(of_visit[0].of_mass)))
        first = next(iter(visits.values()))[0]
        change = changes.get((first.patient, first.mass))
        masses.append(MassEntry(first.patient, first.mass, tuple(entries), first.side or "", change))
    shown = worst(masses, _MOST_ROWS)
    patients = len({row.patient for row in masses})
    of_patients = f"{counted(len(masses), 'mass')} of {counted(patients, 'patient')}"
    lines = [f"{of_patients}; {counted(len(rows), 'exam')}: {counts}."]
    if len(shown) < len(masses):
        tables = f"{layout.DONE} and {layout.FAILURES}"
        lines.append(f"Here are the {len(shown)} to be looked at first; all are in {tables}.")
    lines += [repeatability_words(campaign)] if campaign.repeatability else []
    return campaign_html(shown, lines=lines, links=links)


def _visit_entry(
    day: date | None, rows: Sequence[ExamRow], exams: tuple[ExamEntry, ...], report: PooledReport | None
) -> VisitEntry:
    """A visit with its size: the pooled one where there is one, else that of its one exam; without one the reason."""
    code = rows[0].exam.visit
    words = code if day is None or day.isoformat() == code else f"{code}, {day.isoformat()}"
    reasons, pooled = list(filter(None, dict.fromkeys(row.on_paper for row in rows))), 0
    if report is None:
        size = exams[0].size if len(exams) == 1 else None
    else:
        size = report.leading.max_size_mm
        if len(rows) > 1:
            pooled = sum(one.status == "estimate" for one in report.maps)
            reasons.insert(0, report.reason)
    return VisitEntry(words, exams, size, pooled, "" if size else "; ".join(reasons) or "not pooled")


def _exam_entry(campaign: Campaign, row: ExamRow, *, inline: bool) -> ExamEntry:
    exam, folder = row.exam, f"{layout.EXAMS}/{row.exam.name}"
    kept_steps = () if row.failed else ("map", "estimate", "figures", "size", "page")
    made = {name for step in kept_steps for name in campaign.files(step, exam.name)}
    picture: bytes | str | None = f"{folder}/{layout.THUMBNAIL}" if layout.THUMBNAIL in made else None
    if inline and isinstance(picture, str):
        picture = read_bytes(campaign.folder / picture, most=IMAGE_BYTES)
    reader = f", {exam.reader}" if exam.reader else ""
    return ExamEntry(
        f"visit {exam.visit}, exam {exam.replicate}{reader}",
        row.on_paper,
        row.leading,
        row.findings,
        picture,
        f"{folder}/{layout.EXAM_PAGE}" if layout.EXAM_PAGE in made else "",
        {name: f"{folder}/{name}" for name in _LINKS if name in made},
        failed=row.failed,
    )


def repeatability_words(campaign: Campaign) -> str:
    """The learned spread between exams, which sizes use; else why it was not learned, where it might have been."""
    repeatability = campaign.repeatability
    if repeatability is None:
        also = "intervals in the tables are for exams as alike as simulated ones"
        return f"spread between exams not learned: {campaign.not_learned}; {also}" if campaign.not_learned else ""
    words = repeatability.words()
    return f"{capitalised(words)}; every size is by this spread, learned from the repeats ({layout.REPEATABILITY})."
