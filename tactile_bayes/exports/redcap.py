"""Estimates as the CSV that a REDCap project imports, and the data dictionary that makes such a project."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Final, Literal, NamedTuple

from tactile_bayes.declarations import short_repr
from tactile_bayes.errors import UsageError
from tactile_bayes.exports.exam import EstimateFile, ExportedMass, Identity, content_uuid
from tactile_bayes.files.tables import csv_text
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE

FORM: Final = "tactile_exam"
DICTIONARY_HEADER: Final = (
    "Variable / Field Name", "Form Name", "Section Header", "Field Type", "Field Label",
    "Choices, Calculations, OR Slider Labels", "Field Note", "Text Validation Type OR Show Slider Number",
    "Text Validation Min", "Text Validation Max", "Identifier?", "Branching Logic (Show field only if...)",
    "Required Field?", "Custom Alignment", "Question Number (surveys only)", "Matrix Group Name", "Matrix Ranking?",
    "Field Annotation",
)  # fmt: skip
"""The 18 columns of a data dictionary, as a REDCap project downloads its own."""
_RECORD: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", re.ASCII)
_STATUSES: Final = {
    "sized": "size",
    "not-sized": "no size",
    "no-lump-shown": "no lump that can be measured",
    "no-verdict": "the data cannot show one",
}
"""Answers of the status, by the value of `SizedMass.outcome`."""
COMPLETE: Final = f"{FORM}_complete"
"""The form's own status, which REDCap adds to every form: 0 incomplete, 1 unverified, 2 complete."""


class RecordRow(NamedTuple):
    """A mass of an estimate and the identity, from which a record is made."""

    record_id: str
    estimate: EstimateFile
    mass: ExportedMass
    identity: Identity

    def fact(self, name: str) -> str:
        """A fact of the exam from its scans; empty where they have none."""
        return self.estimate.facts.get(name, "")

    def of_size(self, which: Literal["largest", "smallest"], part: str) -> float | None:
        """A part of a size's summary; None without a size."""
        size: Quantity | None = getattr(self.mass, which)
        return None if size is None else getattr(size, part)

    def from_xiphoid(self, axis: int) -> float | None:
        """A coordinate of the lump in the patient's axes; None where it is not known."""
        return None if self.mass.centre_patient_mm is None else self.mass.centre_patient_mm[axis]


class Field(NamedTuple):
    """One variable of the form: name, label, value of a record, and the range of a number."""

    name: str
    label: str
    value: Callable[[RecordRow], str | float | None]
    note: str = ""
    validation: str = ""
    least: str = ""
    most: str = ""
    choices: Sequence[str] = ()  #: Answers that the value may be; their codes are 1, 2, 3...


_MM: Final = ("mm", "number", "0", "500")
_FROM_XIPHOID: Final = ("mm", "number", "-500", "500")
_SHARE: Final = ("", "number", "0", "1")
_SOURCES: Final = ("one map", "several maps of one mass")
_VERDICTS: Final = ("sound", "doubtful", "no answer")
_POSTURES: Final = ("supine", "oblique", "sitting", "phantom")
FIELDS: Final = (
    Field("record_id", "Record ID", lambda r: r.record_id),
    Field("tb_status", "Outcome", lambda r: _STATUSES[r.mass.outcome.value], choices=tuple(_STATUSES.values())),
    Field("tb_reason", "Why there is no size", lambda r: r.mass.reason),
    Field("tb_exam_date", "Date of the exam", lambda r: getattr(r.identity.study, "iso_date", ""), "", "date_ymd"),
    Field("tb_side", "Breast", lambda r: r.fact("side"), choices=("left", "right", "phantom")),
    Field("tb_posture", "Posture", lambda r: r.fact("posture"), choices=_POSTURES),
    Field("tb_visit", "Visit (code)", lambda r: r.fact("visit")),
    Field("tb_mass", "Mass (code)", lambda r: r.fact("mass")),
    Field("tb_mass_number", "Mass within the estimate", lambda r: r.mass.number, "", "integer", "1", "99"),
    Field("tb_examiner", "Examiner (code)", lambda r: r.fact("examiner")),
    Field("tb_source", "Estimated from", lambda r: _SOURCES[len(r.estimate.maps) > 1], choices=_SOURCES),
    Field("tb_maps", "Maps", lambda r: len(r.estimate.maps), "", "integer", "0", "999"),
    Field("tb_max_mm", "Largest size, median", lambda r: r.of_size("largest", "median"), *_MM),
    Field("tb_max_low_mm", "Largest size, lower end of the interval", lambda r: r.of_size("largest", "low"), *_MM),
    Field("tb_max_high_mm", "Largest size, upper end of the interval", lambda r: r.of_size("largest", "high"), *_MM),
    Field("tb_min_mm", "Smallest size, median", lambda r: r.of_size("smallest", "median"), *_MM),
    Field("tb_min_low_mm", "Smallest size, lower end of the interval", lambda r: r.of_size("smallest", "low"), *_MM),
    Field("tb_min_high_mm", "Smallest size, upper end of the interval", lambda r: r.of_size("smallest", "high"), *_MM),
    Field("tb_interval_prob", "Probability of the intervals", lambda r: r.of_size("largest", "probability"), *_SHARE),
    Field("tb_lump_prob", "Probability of a lump", lambda r: r.mass.probability, *_SHARE),
    Field("tb_right_mm", "Lump from the xiphoid to the patient's right", lambda r: r.from_xiphoid(0), *_FROM_XIPHOID),
    Field("tb_up_mm", "Lump from the xiphoid to the sternal notch", lambda r: r.from_xiphoid(1), *_FROM_XIPHOID),
    Field("tb_verdict", "Verdict", lambda r: r.estimate.report.verdict.replace("_", " "), choices=_VERDICTS),
    Field("tb_findings", "What speaks against the result", lambda r: " ".join(r.estimate.lines)),
    Field("tb_method", "Method and calibration", lambda r: r.estimate.method_words),
    Field("tb_version", "Version of tactile-bayes", lambda r: r.estimate.version),
    Field("tb_map_sha256", "SHA-256 of the map", lambda r: next(iter(r.estimate.maps), ""), "the first of several"),
    Field("tb_estimate_sha256", "SHA-256 of the estimate", lambda r: r.estimate.digest),
    Field("tb_research_use", "Use", lambda _: RESEARCH_USE, RESEARCH_USE),
)


def dictionary_csv() -> str:
    """The data dictionary of the form, for a new project or to append to one."""
    rows = []
    for field in FIELDS:
        choices = " | ".join(f"{code}, {answer}" for code, answer in enumerate(field.choices, start=1))
        kind = "radio" if choices else "notes" if field.name in ("tb_reason", "tb_findings") else "text"
        row = [field.name, FORM, "", kind, field.label, choices, field.note, field.validation, field.least, field.most]
        rows.append(row + [""] * (len(DICTIONARY_HEADER) - len(row)))
    return csv_text(DICTIONARY_HEADER, rows)


def records_csv(estimates: Sequence[EstimateFile], identity: Identity, *, id_from_scan: bool) -> str:
    """CSV with one record per mass of each estimate.

    Record IDs begin with the identity's `patient_id`, or with the scans' subject codes where `id_from_scan` is true;
    without either they derive from the estimates' content. One patient or one date for the scans of several is refused.
    """
    facts_of = [estimate.facts for estimate in estimates]
    patients = sorted({facts["subject"] for facts in facts_of if "subject" in facts})
    if identity.patient_id and len(patients) > 1:
        fault = f"{identity.patient_id} cannot be patients {', '.join(patients)} of the scans"
        raise UsageError(f"{fault}; export each by itself, or give --patient-id-from-scan")
    for patient in patients if identity.study_date else ():
        visits = sorted({facts["visit"] for facts in facts_of if facts.get("subject") == patient and "visit" in facts})
        if len(visits) > 1:
            fault = f"{identity.study_date} cannot be the date of visits {', '.join(visits)} of patient {patient}"
            raise UsageError(f"{fault}; export each by itself")
    rows = dict[str, RecordRow]()
    for estimate in estimates:
        for mass in estimate.masses:
            name = _record_id(estimate, mass, identity, id_from_scan=id_from_scan)
            if name in rows:
                both = f"{estimate.path} and {rows[name].estimate.path} would both be record {name}"
                way_out = "pool exams of one visit (estimate --pool), or give a scan's visit and mass in its session"
                raise UsageError(f"{both}; {way_out}")
            rows[name] = RecordRow(name, estimate, mass, identity)
    cells = ([*(_cell(field, row) for field in FIELDS), "1"] for row in rows.values())
    return csv_text([*(one.name for one in FIELDS), COMPLETE], cells)


def _record_id(estimate: EstimateFile, finding: ExportedMass, identity: Identity, *, id_from_scan: bool) -> str:
    facts = estimate.facts
    patient = identity.patient_id
    if id_from_scan and not patient:
        if "subject" not in facts:
            way_out = "give --patient-id, or leave out --patient-id-from-scan"
            raise UsageError(f"{estimate.path} names no subject; {way_out}")
        patient = facts["subject"]
    several = [str(finding.number)] if len(estimate.masses) > 1 else []
    if not patient:
        return "-".join(["tb", content_uuid("record", estimate.digest).hex[:16], *several])
    parts = [patient, *(facts[name] for name in ("side", "visit", "mass") if name in facts), *several]
    name = "-".join(parts)
    if not _RECORD.fullmatch(name):
        way_out = "use letters, digits, points and dashes, at most 100"
        raise UsageError(f"the record ID {short_repr(name)} is none that REDCap takes; {way_out}")
    return name


def _cell(field: Field, row: RecordRow) -> str:
    """A value as a cell of one line that no spreadsheet takes for a formula; an answer as its code."""
    value = field.value(row)
    if field.choices:
        return str(field.choices.index(value) + 1) if value in field.choices else ""
    if isinstance(value, float):
        value = f"{value:.9g}" if abs(value) >= 1e-4 else f"{value:.9f}".rstrip("0").rstrip(".")
    line = " ".join(str("" if value is None else value).split())
    number = re.fullmatch(r"-[0-9]*\.?[0-9]+(e[+-]?[0-9]+)?", line)
    return f"'{line}" if line[:1] in ("=", "@", "+", "-") and not number else line
