"""Tables of a campaign: exams done, failures, and the trial table that `validate` takes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from tactile_bayes.campaigns.match import unnamed
from tactile_bayes.campaigns.run import Campaign
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import CANNOT_SHOW
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.manifest_csv import (
    ESTIMATE,
    EXAMS,
    MASSES,
    POOLED,
    SIZED,
    Exam,
    columns_of,
    table_text,
)
from tactile_bayes.files.reports import EstimateReport, PooledReport, centre_of
from tactile_bayes.findings import Finding, Verdict, by_weight, finding_lines, verdict
from tactile_bayes.inference.draws import Quantity

TACTILE, POOLED_MODALITY = "tactile", "tactile-pooled"
_TRIAL_COLUMNS: Final = (
    "patient", "mass", "modality", "replicate", "size_mm", "status", "sd_mm", "low_mm", "high_mm", "probability",
    "reader", "visit", "date", "reason", "synthetic",
)  # fmt: skip


_OF_AN_ESTIMATE: Final = (
    "smallest_lump", "d_x_mm", "d_y_mm", "amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd",
    "supposing", "centre_patient_mm", "position", "angle_deg", "variance_share", "scene",
    "prior_sensitivity",
)  # fmt: skip
_OF_A_MASS: Final = ("amplitude", "max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm", "angle_deg", "another_exam")
"""`_OF_AN_ESTIMATE`, `_OF_A_MASS`: What no table shows."""


class Row(Record, eq=False):
    """One exam as the tables and the index show it."""

    exam: Exam  #: Of exams.csv.
    report: EstimateReport | None
    """The estimate, by the campaign's repeatability where it has one; None where a step failed."""
    step: str = ""
    fault: str = ""
    """`step`, `fault`: Which step failed and why; empty where none did."""
    scans: tuple[Mapping[str, str], ...] = ()
    synthetic: bool | None = None
    """`scans`, `synthetic`: Of the file: digests and facts, whether it is simulated (None: unknown)."""
    findings: tuple[Finding, ...] = ()
    """What speaks against the exam: of its estimate, of the pooled size of its mass, of the table."""

    @property
    def size(self) -> Quantity | None:
        """Largest size with the interval of the tables; None without one."""
        return None if self.report is None else self.report.max_size_mm

    @property
    def reason(self) -> str:
        """Why there is no size; empty where there is one."""
        if self.report is None:
            return f"{self.step} failed: {self.fault}"
        return "" if self.size is not None else self.report.reason

    @property
    def status(self) -> str:
        """As the trial table has it: an exam without an estimate looked for the mass in vain, others were not done."""
        return _status(self.report)

    def has(self, kind: str) -> bool:
        """Whether a finding of the kind speaks against it."""
        return any(one.kind == kind for one in self.findings)

    @property
    def verdict(self) -> Verdict:
        """Sound, doubtful or no answer."""
        return verdict(self.findings, answered=self.size is not None)


def _status(report: EstimateReport | PooledReport | None) -> str:
    if report is None:
        return "not_done"
    if report.max_size_mm is not None:
        return "detected"
    silent = isinstance(report, EstimateReport) and report.reason_code == CANNOT_SHOW
    return "not_detected" if report.status == "no_estimate" and not silent else "not_done"


def exam_rows(campaign: Campaign) -> list[Row]:
    """Every exam of the table, in its order."""
    together = _of_pooled(campaign)
    rows = [_row(campaign, exam, together.get(exam.name, ())) for exam in campaign.exams]
    of_scan: dict[Path, list[EstimateReport]] = defaultdict(list)
    for row in rows:
        if row.report is not None:
            of_scan[row.exam.path].append(row.report)
    return [
        row
        if row.report is None
        else replace(row, findings=by_weight((*row.findings, *unnamed(of_scan[row.exam.path]))))
        for row in rows
    ]


def _of_pooled(campaign: Campaign) -> dict[str, tuple[Finding, ...]]:
    """What the pooled size of its mass says against each exam, such as that its lump lies elsewhere."""
    return {
        name: tuple(
            replace(one, about="")
            for one in report.findings
            if (one.about == f"map {number}" and one.kind != "several_masses")  # its row says which mass it is of
            or one.kind == "maps_disagree"
        )
        for report in pooled_reports(campaign).values()
        for number, name in enumerate((one.map for one in report.maps), start=1)
    }


def _row(campaign: Campaign, exam: Exam, together: tuple[Finding, ...]) -> Row:
    fault = campaign.found.faults.get(exam.name)
    mapped = campaign.found.of("map", exam.name) or {}
    facts: dict[str, Any] = {"scans": tuple(mapped.get("scans", ())), "synthetic": mapped.get("synthetic")}
    if fault is not None and fault.step not in ("figures", "page"):
        return Row(exam, None, fault.step, fault.reason, **facts)
    by_site = SIZED in (campaign.found.of("size", exam.name) or {"files": ()})["files"]
    report = read_record(campaign.folder / EXAMS / exam.name / (SIZED if by_site else ESTIMATE), EstimateReport)
    return Row(exam, _shortened(report), findings=(*report.findings, *together), **facts)


def _shortened(report: EstimateReport) -> EstimateReport:
    """The report with what tables and pages show: the rest of it is a hundred times as much."""
    masses = tuple(replace(one, **dict.fromkeys(_OF_A_MASS)) for one in report.masses)
    rest: dict[str, Any] = {"candidates": (), "other_rises": (), "touching": (), "left_out": (), "prior": {}}
    return replace(report, masses=masses, diagnostics={}, provenance={}, **dict.fromkeys(_OF_AN_ESTIMATE), **rest)


def pooled_reports(campaign: Campaign) -> dict[str, PooledReport]:
    """Each pooled mass, by its name."""
    folder = campaign.folder / MASSES
    return {name: read_record(folder / name / POOLED, PooledReport) for name in campaign.found.results["pool"]}


def done_text(rows: Sequence[Row]) -> str:
    """``exams_done.csv``: exams with an estimate, or with the reason for none."""
    return table_text([_done(row) for row in rows if row.report is not None], columns_of("exams_done"))


def _done(row: Row) -> dict[str, object]:
    report = row.report
    assert report is not None
    x_mm, y_mm = centre_of(report.centre_mm) or (None, None)
    smallest = report.min_size_mm
    return {
        **_names(row.exam),
        "side": row.exam.side,
        "reader": row.exam.reader,
        "folder": f"{EXAMS}/{row.exam.name}",
        "scan_sha256": " ".join(scan["sha256"] for scan in row.scans if "sha256" in scan) or None,
        "status": row.status,
        "reason": row.reason or None,
        **_sizes(row.size),
        "smallest_mm": None if smallest is None else smallest.median,
        "detected_probability": report.detected_probability,
        "centre_x_mm": x_mm,
        "centre_y_mm": y_mm,
        "verdict": row.verdict,
        "findings": " ".join(finding_lines(row.findings)) or None,
        "synthetic": row.synthetic,
    }


def _names(exam: Exam) -> dict[str, object]:
    return {name: getattr(exam, name) for name in ("patient", "visit", "mass", "replicate", "file")}


def _sizes(size: Quantity | None) -> dict[str, object]:
    if size is None:
        return {}
    names = {"size_mm": "median", "sd_mm": "sd", "low_mm": "low", "high_mm": "high", "probability": "probability"}
    return {column: getattr(size, name) for column, name in names.items()}


def failures_text(campaign: Campaign, rows: Sequence[Row]) -> str:
    """``failures.csv``: exams, and masses that could not be pooled or compared, with the step and the reason."""
    failed = {row.exam.name: _names(row.exam) for row in rows}
    failed |= {row.exam.of_mass: {**_names(row.exam), "replicate": None, "file": None} for row in rows}
    blank = {"visit": None, "replicate": None, "file": None}
    failed |= {row.exam.of_visits: {**_names(row.exam), **blank} for row in rows}
    found = campaign.found.faults
    lines = [
        failed[name] | {"step": found[name].step, "reason": found[name].reason} for name in failed if name in found
    ]
    return table_text(lines, columns_of("failures"))


def trial_text(campaign: Campaign, rows: Sequence[Row], masses: Collection[tuple[str, str]] | None) -> str:
    """``trial.csv``: every exam as a reading of ``tactile``, every pooled visit as one of ``tactile-pooled``.

    `masses` have a size after excision: the others are left out. None takes all.
    """
    taken = [row for row in rows if masses is None or (row.exam.patient, row.exam.mass) in masses]
    count: dict[tuple[str, str], int] = {}
    readings = [_reading(row.exam, TACTILE, count, row.report, reason=row.reason, of=row) for row in taken]
    count = {}
    visits = {row.exam.of_mass: row for row in taken}
    simulated: dict[str, bool] = {}
    for row in taken:  # a failed exam does not say
        if row.synthetic is not None:
            simulated[row.exam.of_mass] = row.synthetic or simulated.get(row.exam.of_mass, False)
    pooled = pooled_reports(campaign)
    for name, row in visits.items() if campaign.found.results["pool"] else ():
        report = pooled.get(name)
        reason = _unpooled(campaign, name) if report is None else report.reason
        readings.append(_reading(row.exam, POOLED_MODALITY, count, report, reason=reason))
        readings[-1] |= {"synthetic": simulated.get(name)}
    return table_text(readings, _TRIAL_COLUMNS)


def _unpooled(campaign: Campaign, name: str) -> str:
    """Why a mass was not pooled."""
    fault = campaign.found.faults.get(name)
    return "every exam failed" if fault is None else f"{fault.step} failed: {fault.reason}"


def _reading(
    exam: Exam,
    modality: str,
    count: dict[tuple[str, str], int],
    report: EstimateReport | PooledReport | None,
    *,
    reason: str,
    of: Row | None = None,
) -> dict[str, object]:
    """A reading; its number runs over the visits of the mass."""
    mass = (exam.patient, exam.mass)
    count[mass] = count.get(mass, 0) + 1
    status = _status(report)
    return {
        "patient": exam.patient,
        "mass": exam.mass,
        "modality": modality,
        "replicate": count[mass],
        "status": status,
        **_sizes(None if report is None else report.max_size_mm),
        "reader": None if of is None else exam.reader,
        "visit": exam.visit,
        "date": exam.day,
        "reason": (reason or None) if status != "detected" else None,
        "synthetic": None if of is None else of.synthetic,
    }
