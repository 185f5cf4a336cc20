"""A campaign from its table of exams to the trial's report: checks, run, files and summary."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tactile_bayes.api.arguments import PathLike, TextResult, path_of, required_path, takes
from tactile_bayes.api.estimates import settings_of
from tactile_bayes.api.settings import Settings
from tactile_bayes.batch import open_executor
from tactile_bayes.campaigns import report
from tactile_bayes.campaigns.inputs import open_campaign, remove_stale_files
from tactile_bayes.campaigns.run import FEW, Bar, Campaign, no_bar
from tactile_bayes.campaigns.steps import CampaignSettings
from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import refuse_same
from tactile_bayes.files.manifest_csv import JOURNAL, Exam, read_manifest
from tactile_bayes.files.reading import check_address, upload
from tactile_bayes.files.size_json import NONE, size_calibration_path
from tactile_bayes.findings import counted, first_lines
from tactile_bayes.options import CampaignOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.pooling import Repeatability


class CampaignResult(TextResult, eq=False):
    """Outcome of a campaign, or its plan."""

    campaign: Campaign
    folder: Path
    written: report.Written | None  #: What was written; None where nothing was run.

    @property
    def text(self) -> str:
        """Text that ``campaign run`` prints."""
        lines = self._planned() if self.written is None else self._done(self.written)
        report_text = "" if self.written is None else self.written.report  # which ends with the words of research
        return "\n".join([*lines, report_text or f"{RESEARCH_USE}\n"])

    @property
    def failed(self) -> tuple[str, ...]:
        """A line for each of the first exams or masses that failed, and one that counts the others."""
        lines = [f"{name}: {fault.step}: {fault.reason}" for name, fault in self.campaign.faults.items()]
        return tuple(first_lines(lines, FEW, ", see failures.csv"))

    def _planned(self) -> Iterator[str]:
        plan = self.campaign
        for step, todo in plan.todo.items():
            named = f" ({', '.join(plan.names[step])})" if _all_named(plan, step) and plan.kept[step] else ""
            yield f"{step}: {todo} to do{named}, {plan.kept[step]} done"
        faults = [f"{name}: {fault.step} failed: {fault.reason}" for name, fault in plan.faults.items()]
        yield from first_lines(faults, FEW, " failed")
        yield "Nothing was run."

    def _done(self, written: report.Written) -> Iterator[str]:
        run = self.campaign
        yield f"{self.folder}: {counted(len(run.exams), 'exam')}: {written.counts}"
        yield from written.masses
        yield f"to look at: {self.folder / report.INDEX}, a row for each mass with the pages of its exams"
        yield f"{counted(run.todo.total(), 'step')} run, {run.kept.total()} kept from earlier runs"
        for step, todo in run.todo.items():
            more = "" if _all_named(run, step) else f" and {todo - len(run.names[step])} more"
            if todo and any(run.kept.values()):
                yield f"{step} run: {', '.join(run.names[step])}{more}"
        yield from written.doubts

    def __repr__(self) -> str:
        counts = "nothing was run" if self.written is None else self.written.counts
        return f"<CampaignResult of {counted(len(self.campaign.exams), 'exam')}: {counts}>"


@takes(CampaignOptions, Settings, without=["settings_file", "repeatability"])
def campaign(
    exams: PathLike,
    output: PathLike,
    *,
    repeatability: PathLike | Repeatability | None = None,
    bar: Bar | None = None,
    **options: Any,
) -> CampaignResult:
    """Map, estimate and pool the exams of a table, and report the trial; goes on where it was interrupted.

    Parameters
    ----------
    exams
        The table, as ``campaign init`` writes it.
    output
        Folder for all files.
    repeatability
        Spread between exams of one mass: a file, what `calibrate_repeatability` returns, or ``"none"``. By default it
        is learned from the repeats, where 5 masses have them.
    bar
        Gives, for what is counted, a context with a callback for those done and wanted.
    **options
        As of `tactile_bayes.options.CampaignOptions` and of `estimate`.

    Raises
    ------
    BadDataError
        When a table or the protocol is not what it must be; an exam's own fault is a row of ``failures.csv``.
    UsageError
        When settings contradict each other, or the folder is another's.
    """
    ours = {name: options.pop(name) for name in names_of(CampaignOptions) if name in options}
    ours |= {name: path_of(ours[name]) for name in ("excision", "columns", "protocol") if name in ours}
    spread = {} if repeatability in (None, NONE) else {"repeatability": repeatability}
    return run_campaign(
        required_path(exams, "exams"),
        required_path(output, "output"),
        CampaignSettings(**ours, estimate=settings_of(options | spread), own_repeatability=repeatability is None),
        read=[Path(one) for one in spread.values() if isinstance(one, str | os.PathLike)],
        bar=bar,
    )


def run_campaign(
    exams: Path, output: Path, settings: CampaignSettings, *, read: Iterable[Path], bar: Bar | None
) -> CampaignResult:
    """Check all inputs, run what is missing, and write what is beside the exams; `read` are further inputs."""
    if settings.copy_to is not None:
        settings = replace(settings, copy_to=check_address(settings.copy_to))
    table = read_manifest(exams)
    _check_folder(table, output, settings)
    names = {settings.of(exam).calibration_name for exam in table} - {None}
    calibrations = (size_calibration_path(str(name)) for name in names)
    inputs = [exams, settings.excision, settings.columns, settings.protocol, *read, *calibrations]
    refuse_same((output / name for name in report.WRITTEN), inputs)
    excised_on = report.check_inputs(table, settings)
    with (
        open_campaign(output, dry=settings.dry_run) as store,
        open_executor(workers=settings.workers, cluster=None if settings.dry_run else settings.scheduler) as executor,
    ):
        place = Path(os.path.abspath(output))  # noqa: PTH100 (links stay links)
        run = Campaign(table, place, settings, store, executor, excised_on, dry=settings.dry_run, bar=bar or no_bar)
        run.run()
        if settings.dry_run:
            return CampaignResult(run, output, None)
        left = remove_stale_files(place, table, run.files, unread=run.unread)
        written = report.write_outputs(run, unlisted=left)
        for name in (*report.WRITTEN, JOURNAL):  # the journal last: with it the copy is whole
            if settings.copy_to and (place / name).exists():
                upload(place / name, f"{settings.copy_to}/{name}")
    return CampaignResult(run, output, written)


def _check_folder(table: Sequence[Exam], output: Path, settings: CampaignSettings) -> None:
    """Refuse exams inside the output folder, an output folder that is a file, and a checkpoint for many maps."""
    if output.exists() and not output.is_dir():
        raise UsageError(f"{output} is a file; give the name of a folder")
    if settings.estimate.checkpoint is not None:
        raise UsageError("a checkpoint is for one map; leave it out of the settings file")
    folder = Path(os.path.realpath(output))
    local = [exam for exam in table if not exam.address]
    inside = next((exam.file for exam in local if Path(os.path.realpath(exam.path)).is_relative_to(folder)), None)
    if inside is not None:
        raise UsageError(f"{inside} lies in the output folder {output}; choose another folder")


def _all_named(run: Campaign, step: str) -> bool:
    """True if a step is due and the names kept are those of all exams or masses that need it."""
    return 0 < run.todo[step] == len(run.names[step])
