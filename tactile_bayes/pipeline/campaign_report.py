"""What a campaign writes beside the exams: tables, the contact sheet, and the trial's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tactile_bayes import __version__
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.pipeline.campaign import Campaign
from tactile_bayes.pipeline.campaign_folder import EXAMS
from tactile_bayes.pipeline.campaign_steps import ESTIMATE, MAP, MAP_FIGURE, SIZE_FIGURE, THUMBNAIL
from tactile_bayes.pipeline.campaign_tables import DONE, FAILURES, TRIAL, Row, exam_rows, write_tables
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.pipeline.trial import TrialSettings
    from tactile_bayes.report.campaign_html import Card

REPORT, PAGE, INDEX = "report.json", "report.html", "index.html"
WRITTEN: Final = (DONE, FAILURES, TRIAL, REPORT, PAGE, INDEX)
"""Files beside the exams."""
_LINKS: Final = {"map.png": MAP_FIGURE, "size.png": SIZE_FIGURE, "estimate.json": ESTIMATE, "map.nc": MAP}


@dataclass(frozen=True, slots=True)
class Written:
    """What was written, in numbers and words.

    Parameters
    ----------
    sized, unsized, failed
        Exams by how they ended.
    pooled
        Masses at a visit that were pooled.
    left_out
        Masses without a size after excision, as ``patient mass``.
    report
        The trial report as text; empty where there is none.
    no_report
        Why there is none, where excision sizes were given.
    unnamed
        Exams whose map shows a mass that no row names.
    """

    sized: int
    unsized: int
    failed: int
    pooled: int
    left_out: tuple[str, ...] = ()
    report: str = ""
    no_report: str = field(default="")
    unnamed: tuple[str, ...] = ()


def write_outputs(campaign: Campaign, excision: Path | None, protocol: Path | None = None) -> Written:
    """Write tables, contact sheet and, where excision sizes are given, the trial's report.

    Raises
    ------
    UsageError
        When the disk does not take a file; what is done is kept.
    BadDataError
        When the table of excision sizes or the protocol is at fault.
    """
    from tactile_bayes.files.atomic import write_text

    rows = exam_rows(campaign)
    masses = None if excision is None else excised(excision)
    write_tables(campaign, rows, masses, campaign.folder)
    counts = _counts(rows)
    report, fault = "", ""
    if excision is not None:
        report, fault = _write_report(campaign.folder, excision, protocol)
    if not report:
        for name in (REPORT, PAGE):
            (campaign.folder / name).unlink(missing_ok=True)
    links = {name: name for name in (DONE, FAILURES, TRIAL)} | ({"trial report": PAGE} if report else {})
    page = _page(campaign, rows, counts, links)
    write_text(campaign.folder / INDEX, page, force=True)
    known = {(row.exam.patient, row.exam.mass) for row in rows}
    left_out = sorted(known - masses) if masses is not None else []
    names = tuple(f"{patient} {mass}" for patient, mass in left_out)
    unnamed = tuple(row.exam.name for row in rows if row.unnamed)
    return Written(*counts, len(campaign.found.results["pool"]), names, report, fault, unnamed)


def check_inputs(excision: Path | None, protocol: Path | None) -> None:
    """Read the table of excision sizes and the protocol, so that a fault in them costs no work.

    Raises
    ------
    UsageError
        When there is a protocol and no table of excision sizes.
    BadDataError
        Naming the file, the line or key, and the way out.
    """
    if protocol is not None and excision is None:
        raise UsageError("--protocol is for the trial's report; give --excision too")
    if excision is not None:
        excised(excision)
    if protocol is not None:
        _trial_settings(protocol)


def _trial_settings(protocol: Path | None) -> tuple[TrialSettings, str | None]:
    """Settings that a protocol fixes, the others by default, and its title."""
    from tactile_bayes.files.protocol import read_protocol
    from tactile_bayes.pipeline.trial import TrialSettings

    if protocol is None:
        return TrialSettings(), None
    read, default = read_protocol(protocol), TrialSettings()
    # TOML and its schema take 1000.0 for a whole number
    fixed = {name: type(getattr(default, name))(value) for name, value in read.analysis.items()}
    return TrialSettings(**fixed), read.title


def excised(excision: Path) -> set[tuple[str, str]]:
    """Patient and mass of each row of a table of excision sizes."""
    from tactile_bayes.files.tables import read_table

    columns = read_table(excision, "excision.table.json").columns
    return set(zip(columns["patient"], columns["mass"], strict=True))


def _counts(rows: Sequence[Row]) -> tuple[int, int, int]:
    sized = sum(row.size is not None for row in rows)
    failed = sum(row.document is None for row in rows)
    return sized, len(rows) - sized - failed, failed


def _write_report(folder: Path, excision: Path, protocol: Path | None) -> tuple[str, str]:
    """Write what `validate` writes for the trial table; returns its text, or why there is none."""
    from tactile_bayes.files.atomic import write_text
    from tactile_bayes.files.schema import check_document, dump_json
    from tactile_bayes.pipeline.trial import analyse
    from tactile_bayes.pipeline.trial_inputs import load_trial
    from tactile_bayes.report.trial_html import trial_html
    from tactile_bayes.report.trial_text import trial_text

    settings, title = _trial_settings(protocol)
    try:
        inputs = load_trial(folder / TRIAL, excision, None)
        outcome = analyse(inputs, settings, protocol=protocol, title=title)
    except BadDataError as error:
        return "", error.what
    check_document(outcome.document, "validate.schema.json", path=folder / REPORT)
    more = [] if outcome.next_mass is None else outcome.next_mass.lines()
    full = trial_text(outcome.report, methods=True, checks=outcome.checks, more=more)
    write_text(folder / REPORT, dump_json(outcome.document), force=True)
    write_text(folder / PAGE, trial_html(outcome.report, outcome.document, text=full), force=True)
    return trial_text(outcome.report, methods=False, checks=outcome.checks, more=more), ""


def _page(campaign: Campaign, rows: Sequence[Row], counts: tuple[int, int, int], links: Mapping[str, str]) -> str:
    from tactile_bayes.report.campaign_html import campaign_html

    cards = [_card(campaign, row) for row in rows]
    masses = len(campaign.found.results["pool"])
    lines = [f"{len(rows)} exams: {counts_words(*counts)}."] + ([f"{masses} masses pooled."] if masses else [])
    return campaign_html(cards, lines=lines, links=links, version=__version__)


def counts_words(sized: int, unsized: int, failed: int) -> str:
    """How the exams ended, in words."""
    return f"{sized} sized, {unsized} without a size, {failed} failed"


def _card(campaign: Campaign, row: Row) -> Card:
    from tactile_bayes.files.reading import IMAGE_BYTES, read_bytes
    from tactile_bayes.report.campaign_html import FAILED, SIZED, UNSIZED, Card

    exam, folder = row.exam, campaign.folder / EXAMS / row.exam.name
    made = {
        name
        for step in ("map", "estimate", "figures")
        for name in (campaign.found.of(step, exam.name) or {"files": ()})["files"]
        if row.document is not None
    }
    facts = [f"patient {exam.patient}", f"visit {exam.visit}", f"mass {exam.mass}", f"exam {exam.replicate}"]
    facts += [fact for fact in (exam.side, exam.reader and f"reader {exam.reader}", exam.file) if fact]
    return Card(
        name=exam.name,
        status=FAILED if row.document is None else UNSIZED if row.size is None else SIZED,
        facts=tuple(facts),
        reason=row.reason,
        size=row.size,
        cautions=tuple(row.cautions),
        checks=tuple(row.checks),
        thumbnail=read_bytes(folder / THUMBNAIL, most=IMAGE_BYTES) if THUMBNAIL in made else None,
        links={words: f"{EXAMS}/{exam.name}/{name}" for words, name in _LINKS.items() if name in made},
    )
