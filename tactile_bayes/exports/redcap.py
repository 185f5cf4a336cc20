"""Estimates as the CSV that a REDCap project imports, and the data dictionary that makes such a project."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from tactile_bayes.errors import UsageError
from tactile_bayes.exports.exam import EstimateFile, Identity, SizedMass, content_uuid
from tactile_bayes.files.tables import csv_text
from tactile_bayes.presets import RESEARCH_USE

FORM: Final = "tactile_exam"
DICTIONARY_HEADER: Final = (
    "Variable / Field Name",
    "Form Name",
    "Section Header",
    "Field Type",
    "Field Label",
    "Choices, Calculations, OR Slider Labels",
    "Field Note",
    "Text Validation Type OR Show Slider Number",
    "Text Validation Min",
    "Text Validation Max",
    "Identifier?",
    "Branching Logic (Show field only if...)",
    "Required Field?",
    "Custom Alignment",
    "Question Number (surveys only)",
    "Matrix Group Name",
    "Matrix Ranking?",
    "Field Annotation",
)
"""The 18 columns of a data dictionary, as a REDCap project downloads its own."""
_RECORD: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", re.ASCII)
_CHOICES: Final = {
    "tb_status": ("size", "no size", "no lump that can be measured", "the data cannot show one"),
    "tb_verdict": ("sound", "doubtful", "no answer"),
    "tb_side": ("left", "right", "phantom"),
    "tb_posture": ("supine", "oblique", "sitting", "phantom"),
    "tb_source": ("one map", "several maps of one mass"),
}
"""Answers of the fields that have some; their codes are 1, 2, 3..."""
_STATUSES: Final = ("sized", "not-sized", "no-lump-shown", "no-verdict")
"""Values of `SizedMass.outcome`, in the order of those answers."""


class Field(NamedTuple):
    """One variable of the form: its name, label, and number's range where it is one."""

    name: str
    label: str
    note: str = ""
    validation: str = ""
    least: str = ""
    most: str = ""


_MM: Final = ("mm", "number", "0", "500")
FIELDS: Final = (
    Field("record_id", "Record ID"),
    Field("tb_status", "Outcome"),
    Field("tb_reason", "Why there is no size"),
    Field("tb_exam_date", "Date of the exam", "", "date_ymd"),
    Field("tb_side", "Breast"),
    Field("tb_posture", "Posture"),
    Field("tb_visit", "Visit (code)"),
    Field("tb_mass", "Mass (code)"),
    Field("tb_mass_number", "Mass within the estimate", "", "integer", "1", "99"),
    Field("tb_examiner", "Examiner (code)"),
    Field("tb_source", "Estimated from"),
    Field("tb_maps", "Maps", "", "integer", "0", "999"),
    Field("tb_max_mm", "Largest size, median", *_MM),
    Field("tb_max_low_mm", "Largest size, lower end of the interval", *_MM),
    Field("tb_max_high_mm", "Largest size, upper end of the interval", *_MM),
    Field("tb_min_mm", "Smallest size, median", *_MM),
    Field("tb_min_low_mm", "Smallest size, lower end of the interval", *_MM),
    Field("tb_min_high_mm", "Smallest size, upper end of the interval", *_MM),
    Field("tb_interval_prob", "Probability of the intervals", "", "number", "0", "1"),
    Field("tb_lump_prob", "Probability of a lump", "", "number", "0", "1"),
    Field("tb_right_mm", "Lump from the xiphoid to the patient's right", "mm", "number", "-500", "500"),
    Field("tb_up_mm", "Lump from the xiphoid to the sternal notch", "mm", "number", "-500", "500"),
    Field("tb_verdict", "Verdict"),
    Field("tb_findings", "What speaks against the result"),
    Field("tb_method", "Method and calibration"),
    Field("tb_version", "Version of tactile-bayes"),
    Field("tb_map_sha256", "SHA-256 of the map", "the first of several"),
    Field("tb_estimate_sha256", "SHA-256 of the estimate"),
    Field("tb_research_use", "Use", RESEARCH_USE),
)
COMPLETE: Final = f"{FORM}_complete"
"""The form's own status, which REDCap adds to every form: 0 incomplete, 1 unverified, 2 complete."""


def dictionary_csv() -> str:
    """The data dictionary of the form, for a new project or to append to one."""
    rows = []
    for name, label, note, validation, least, most in FIELDS:
        choices = " | ".join(f"{code}, {words}" for code, words in enumerate(_CHOICES.get(name, ()), start=1))
        kind = "radio" if choices else "notes" if name in ("tb_reason", "tb_findings") else "text"
        row = [name, FORM, "", kind, label, choices, note, validation, least, most]
        rows.append(row + [""] * (len(DICTIONARY_HEADER) - len(row)))
    return csv_text(DICTIONARY_HEADER, rows)


def records_csv(estimates: Sequence[EstimateFile], identity: Identity, *, id_from_scan: bool) -> str:
    """One record per mass of each estimate.

    `identity`: its `patient_id` begins the record IDs; without one they follow from the estimates' content;
    `id_from_scan`: take the subject codes of the scans for patient IDs.
    """
    rows, seen = [], dict[str, EstimateFile]()
    for estimate in estimates:
        for finding in estimate.masses:
            name = _record_id(estimate, finding, identity, id_from_scan=id_from_scan)
            if name in seen:
                both = f"{estimate.path} and {seen[name].path} would both be record {name}"
                way_out = "give a scan's visit and mass in its session, or export them into two files"
                raise UsageError(f"{both}; {way_out}")
            seen[name] = estimate
            rows.append({"record_id": name, COMPLETE: "1"} | _row(estimate, finding, identity))
    header = [*(one.name for one in FIELDS), COMPLETE]
    return csv_text(header, ([row.get(name) for name in header] for row in rows))


def _record_id(estimate: EstimateFile, finding: SizedMass, identity: Identity, *, id_from_scan: bool) -> str:
    facts = estimate.facts
    patient = identity.patient_id
    if id_from_scan and not patient:
        if "subject" not in facts:
            raise UsageError(
                f"{estimate.path} names no subject; give --patient-id, or leave out --patient-id-from-scan"
            )
        patient = facts["subject"]
    several = [str(finding.number)] if len(estimate.masses) > 1 else []
    if not patient:
        return "-".join(["tb", content_uuid("record", estimate.digest).hex[:16], *several])
    parts = [patient, *(facts[name] for name in ("side", "visit", "mass") if name in facts), *several]
    name = "-".join(parts)
    if not _RECORD.fullmatch(name):
        shown = name if len(name) <= 60 else f"{name[:57]}..."
        raise UsageError(
            f"the record ID {shown!r} is none that REDCap takes; use letters, digits, points and dashes, at most 100"
        )
    return name


def _row(estimate: EstimateFile, finding: SizedMass, identity: Identity) -> dict[str, str]:
    facts = estimate.facts
    row = {
        "tb_status": str(_STATUSES.index(finding.outcome.value) + 1),
        "tb_reason": finding.reason,
        "tb_exam_date": identity.study.iso_date if identity.study else "",
        "tb_side": _choice("tb_side", facts.get("side")),
        "tb_posture": _choice("tb_posture", facts.get("posture")),
        "tb_visit": facts.get("visit", ""),
        "tb_mass": facts.get("mass", ""),
        "tb_mass_number": str(finding.number),
        "tb_examiner": facts.get("examiner", ""),
        "tb_source": "2" if len(estimate.maps) > 1 else "1",
        "tb_maps": str(len(estimate.maps)),
        "tb_lump_prob": _number(finding.probability),
        "tb_verdict": _choice("tb_verdict", estimate.report.verdict.replace("_", " ")),
        "tb_findings": " ".join(estimate.lines),
        "tb_method": estimate.method_words,
        "tb_version": estimate.version,
        "tb_map_sha256": next(iter(estimate.maps), ""),
        "tb_estimate_sha256": estimate.digest,
        "tb_research_use": RESEARCH_USE,
    }
    for name, size in (("max", finding.largest), ("min", finding.smallest)):
        if size is not None:
            row |= {f"tb_{name}_mm": _number(size.median), "tb_interval_prob": _number(size.probability)}
            row |= {f"tb_{name}_low_mm": _number(size.low), f"tb_{name}_high_mm": _number(size.high)}
    if finding.centre_patient_mm is not None:
        row |= dict(zip(("tb_right_mm", "tb_up_mm"), map(_number, finding.centre_patient_mm), strict=True))
    return {name: _plain(value) for name, value in row.items()}


def _choice(name: str, word: str | None) -> str:
    return str(_CHOICES[name].index(word) + 1) if word in _CHOICES[name] else ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.9g}" if abs(value) >= 1e-4 else f"{value:.9f}".rstrip("0").rstrip(".")


def _plain(text: str) -> str:
    """A cell in one line that no spreadsheet takes for a formula."""
    line = " ".join(text.split())
    number = re.fullmatch(r"-[0-9]*\.?[0-9]+(e[+-]?[0-9]+)?", line)
    return f"'{line}" if line[:1] in ("=", "@", "+", "-") and not number else line
