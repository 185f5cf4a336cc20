"""Contents of an export: the patient's identity, maps and estimates from their files, and the standards' codes."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import importlib
import json
import logging
import re
import uuid
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from tactile_bayes.declarations import Record, as_dict, names_of, replace, short_repr
from tactile_bayes.errors import CANNOT_SHOW, NO_LUMP, BadDataError, TactileBayesError, UsageError
from tactile_bayes.files import reading
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.documents import load_json, parse_json, parse_record
from tactile_bayes.files.estimate_json import checked_report
from tactile_bayes.files.map_nc import read_map_and_scans
from tactile_bayes.files.posterior_nc import posterior_attributes
from tactile_bayes.files.provenance import EXAM_FACTS, scans_of
from tactile_bayes.files.reports import REPORTS, EstimateReport, MassReport, PooledReport, centre_of
from tactile_bayes.findings import capitalised, counted, finding_lines
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import IdentityOptions
from tactile_bayes.report.estimate_document import at_place, from_xiphoid
from tactile_bayes.report.estimate_text import exams_label

# --- Unique identifiers that follow from content: equal content, equal identifier, on every machine.

_ROOT: Final = uuid.UUID("5d0f8a6c-54d1-5c0e-9a2b-3f5a3c1c9d47")
"""Name space of this program's identifiers; it must never change."""


def content_uuid(role: str, *parts: str) -> uuid.UUID:
    """UUID of version 5 (RFC 9562) of a role and of the parts that identify the content, such as digests."""
    return uuid.uuid5(_ROOT, "\x1f".join((role, *parts)))


def content_uid(role: str, *parts: str) -> str:
    """DICOM unique identifier: ``2.25.`` and the number of `content_uuid` (PS3.5 B.2); at most 44 characters."""
    return f"2.25.{content_uuid(role, *parts).int}"


# --- Coded concepts of the exports, with where each comes from.
#
# Codes of SNOMED CT and of DICOM are those that PS3.16 of the DICOM standard lists (the context groups are named
# beside them). Concepts that no list has are in this program's own coding scheme, which every file declares.


class Code(NamedTuple):
    """A concept: value, coding scheme by its DICOM designator, meaning in words."""

    value: str
    scheme: str
    meaning: str


OWN_SCHEME: Final = "99TACTILEBAYES"
OWN_SCHEME_NAME: Final = "Concepts of tactile_bayes that no published list has"
OWN_SCHEME_UID: Final = content_uid("coding scheme", "1")
FHIR_SYSTEMS: Final = {
    "SCT": "http://snomed.info/sct",
    "DCM": "http://dicom.nema.org/resources/ontology/DCM",
    OWN_SCHEME: f"urn:oid:{OWN_SCHEME_UID}",
}
"""Scheme -> code system of FHIR (PS3.16 chapter 8; SNOMED CT's of HL7's terminology page)."""

# CID 7469 Generic Intensity and Size Measurements
LONG_AXIS: Final = Code("103339001", "SCT", "Long axis")
SHORT_AXIS: Final = Code("103340004", "SCT", "Short axis")
MEDIAN: Final = Code("373099004", "SCT", "Median")  #: CID 7464 General Region of Interest Measurement Modifiers
# CID 225 Measurement Uncertainty
UPPER_RANGE: Final = Code("371886008", "SCT", "+, range of upper measurement uncertainty")
LOWER_RANGE: Final = Code("371885007", "SCT", "-, range of lower measurement uncertainty")
BREAST_LUMP: Final = Code("89164003", "SCT", "Breast lump")  #: CID 6055 Breast Clinical Finding or Indicated Problem
# CID 4031 Common Anatomic Regions, CID 6022 Side, CID 244 Laterality
BREAST: Final = Code("76752008", "SCT", "Breast")
SIDES: Final = {"left": Code("7771000", "SCT", "Left"), "right": Code("24028007", "SCT", "Right")}
BREASTS: Final = {"left": Code("80248007", "SCT", "Left breast"), "right": Code("73056007", "SCT", "Right breast")}
# TID 4015 and CID 6048: 0 to 100 %, by a device
CERTAINTY: Final = Code("111012", "DCM", "Certainty of Finding")
COMMENT: Final = Code("121106", "DCM", "Comment")
REPORT_TITLE: Final = Code("126000", "DCM", "Imaging Measurement Report")

EXAM: Final = Code("tactile-imaging", OWN_SCHEME, "Tactile imaging of the breast")
METHOD: Final = Code("tactile-size", OWN_SCHEME, "Size of a lump from a tactile map by a calibration")
RELATIVE_PRESSURE: Final = Code("rel-pressure", OWN_SCHEME, "Pressure over the level beside a lump")
PRESSURE: Final = Code("mean-pressure", OWN_SCHEME, "Mean pressure of the readings in a cell")
INTERVAL_LOW: Final = Code("interval-low", OWN_SCHEME, "Lower end of the credible interval")
INTERVAL_HIGH: Final = Code("interval-high", OWN_SCHEME, "Upper end of the credible interval")
INTERVAL_PROBABILITY: Final = Code("interval-prob", OWN_SCHEME, "Probability of the credible interval")
OUTCOME: Final = Code("outcome", OWN_SCHEME, "Outcome of the estimate")
NOT_DETECTED: Final = Code("no-lump-shown", OWN_SCHEME, "The map shows no lump that can be measured")
NO_VERDICT: Final = Code("no-verdict", OWN_SCHEME, "The data cannot show whether there is a lump")
NOT_SIZED: Final = Code("not-sized", OWN_SCHEME, "A lump may be there, without a size")
SIZED: Final = Code("sized", OWN_SCHEME, "Lump with a size")


# --- Packages that only exports need, each imported when its format is asked for.

EXTRAS: Final = {"pydicom": "dicom", "highdicom": "dicom", "fhir.resources": "fhir", "nrrd": "slicer"}
"""Package -> the extra of this program that installs it."""


def import_extra(module: str) -> Any:
    """Import a module of an optional package, for example ``highdicom.sr``."""
    package = next(name for name in EXTRAS if module == name or module.startswith(f"{name}."))
    try:
        return importlib.import_module(module)
    except ImportError:
        way_out = f"install it with pip install 'tactile-bayes[{EXTRAS[package]}]'"
        raise UsageError(f"this needs the package {package}; {way_out}") from None


# --- Inputs of an export: the file of a map, and the file of an estimate with its masses.

_WAY_OUT: Final = "give a map (.nc), a posterior (.nc), or the JSON of `estimate --json`"
_MOST_TEXT: Final = 2000
Facts = Mapping[str, str]


class MapFile(Record, eq=False):
    """A map, the digest of its file, and facts of the exam from its scans."""

    path: Path
    digest: str  #: SHA-256 of the file.
    tactile_map: TactileMap
    facts: Facts  #: Facts of the exam on which all of its scans agree; see `EXAM_FACTS`.


class ExportedMass(Record, eq=False):
    """One mass of an estimate: its size, or why it has none."""

    number: int  #: From 1, in the order of the estimate.
    largest: Quantity | None
    smallest: Quantity | None
    """`largest`, `smallest`: Sizes in mm with the leading intervals; None without a size."""
    code: str = ""  #: Reason code of an estimate without a size; empty with a size.
    reason: str = ""  #: Why there is no size; empty with a size.
    probability: float | None = None  #: Probability that there is a lump; None where the file has none.
    centre_mm: tuple[float, float] | None = None
    centre_patient_mm: tuple[float, float] | None = None
    """`centre_mm`, `centre_patient_mm`: Medians of x and y in `plane` and `patient`; None where the file has none."""
    narrower: str = ""
    """The narrower interval, for exams that differ less, in words; empty where there is one interval."""

    @property
    def place(self) -> str:
        """Where it lies, in words: from the xiphoid, else on the map; empty where the file has no place."""
        if self.centre_patient_mm is not None:
            return from_xiphoid(*self.centre_patient_mm)
        return "" if self.centre_mm is None else f"{at_place(*self.centre_mm)} on the map"

    @property
    def outcome(self) -> Code:
        """Concept of the outcome: sized, a lump without a size, no lump, or no verdict."""
        if self.largest is not None:
            return SIZED
        if self.code == CANNOT_SHOW:
            return NO_VERDICT
        return NOT_DETECTED if self.code in NO_LUMP else NOT_SIZED


class EstimateFile(Record, eq=False):
    """An estimate of one map, a pooled estimate of several, or either with its draws."""

    path: Path
    kind: str
    """``"estimate"``, ``"pooled"`` or ``"posterior"``."""
    digest: str  #: SHA-256 of the estimate's content.
    report: EstimateReport | PooledReport
    masses: tuple[ExportedMass, ...]
    maps: tuple[str, ...]  #: SHA-256 of the maps that it was made from; empty where the file has none.
    facts: Facts

    @property
    def sized(self) -> bool:
        return any(mass.largest is not None for mass in self.masses)

    @property
    def verdict_line(self) -> str:
        return f"Verdict: {self.report.verdict.replace('_', ' ')}."

    @property
    def lines(self) -> list[str]:
        """Findings, in sentences for paper."""
        return [plain_line(line) for line in finding_lines(self.report.findings, paper=True)]

    @property
    def method_words(self) -> str:
        """Method and calibration in a phrase."""
        settings = self.report.origin.settings
        calibration = settings.get("size_calibration") or settings.get("calibration") or "as shipped"
        return plain_line(f"method {settings.get('method') or 'unknown'}, size calibration {calibration}")

    @property
    def version(self) -> str:
        """Version of the program that made it; empty where the file has none."""
        return plain_line(str(self.report.provenance.get("version") or ""))


def plain_line(text: str) -> str:
    """A text from a file as one line of printable characters, of bounded length."""
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
    return line if len(line) <= _MOST_TEXT else f"{line[:_MOST_TEXT]}..."


def read_exam(path: Path) -> MapFile | list[EstimateFile]:
    """Read a map, or the estimates in a JSON file or a posterior."""
    head = reading.first_bytes(path, 8)
    if head.startswith(reading.HDF5_MAGIC):
        attributes = posterior_attributes(path, way_out=_WAY_OUT)
        if attributes is not None:
            if "estimate" not in attributes:
                fault, way_out = "holds draws without their estimate", "write it again with `estimate -o`"
                raise BadDataError(fault, way_out=way_out, path=str(path))
            estimate = parse_estimate(parse_json(attributes["estimate"], name="estimate"), path)
            return [replace(estimate, kind="posterior", digest=sha256(path))]
        tactile_map, scans = read_map_and_scans(path)
        return MapFile(path, sha256(path), tactile_map, shared_facts(scans))
    if not reading.is_json(head):
        kind = reading.kind_of(path) or ("none of these" if head else "empty")
        raise BadDataError(f"is {kind}", way_out=_WAY_OUT, path=str(path))
    document = load_json(path, way_out=_WAY_OUT)
    listed = document if isinstance(document, list) else [document]
    if not listed:
        raise BadDataError("is an empty list", way_out=_WAY_OUT, path=str(path))
    return [parse_estimate(one, path) for one in listed]


def shared_facts(scans: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Facts of the exam on which all scans agree."""
    first, *others = [*scans] or [{}]
    alike = (name for name in EXAM_FACTS if name in first and all(scan.get(name) == first[name] for scan in others))
    return {name: first[name] for name in alike}


def parse_estimate(document: object, path: Path) -> EstimateFile:
    """An estimate from its JSON object; messages name it by `path`."""
    schema = document.get("schema") if isinstance(document, dict) else None
    if not isinstance(schema, str) or schema not in REPORTS:
        raise BadDataError(f"is {reading.schema_kind(schema) or 'no estimate'}", way_out=_WAY_OUT, path=str(path))
    report = checked_report(document, REPORTS[schema], path=path)
    return EstimateFile(
        path,
        schema.split("/")[1],
        hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest(),
        report,
        masses_of(report),
        tuple(one.sha256 for one in report.origin.inputs if one.role.startswith("map")),
        shared_facts(scans_of(report.provenance)),
    )


def masses_of(report: EstimateReport | PooledReport) -> tuple[ExportedMass, ...]:
    """The masses that an estimate lists, or its only one, each with the leading sizes."""
    spread = report.figures.get("between_map_sd")
    listed = report.masses if isinstance(report, EstimateReport) else ()
    if listed and not any(mass.reported for mass in listed):  # of a place without a lump: theirs is not its size
        elsewhere = f"{report.reason}; the map shows {counted(len(listed), 'mass')} elsewhere"
        report, listed = replace(report, reason=elsewhere), ()
    return tuple(_exported_mass(mass, spread) for mass in listed or (report,))


def _exported_mass(mass: EstimateReport | PooledReport | MassReport, spread: float | None) -> ExportedMass:
    number = mass.number if isinstance(mass, MassReport) else 1
    leading, size = mass.leading, mass.max_size_mm
    sizes, narrower, code, reason = (leading.max_size_mm, leading.min_size_mm), "", "", ""
    if size is None:
        code, reason = (not isinstance(mass, PooledReport) and mass.reason_code) or "no size", plain_line(mass.reason)
    elif leading is not mass:
        narrower = f"{capitalised(exams_label(spread))}: largest size {size_words(size)}"
    if isinstance(mass, PooledReport):
        return ExportedMass(number, *sizes, code, reason, narrower=narrower)
    centres = centre_of(mass.centre_mm), centre_of(mass.centre_patient_mm)
    return ExportedMass(number, *sizes, code, reason, mass.detected_probability, *centres, narrower)


def size_words(size: Quantity) -> str:
    """A size with its interval, in words."""
    ends = f"{size.low:.1f} to {size.high:.1f} mm"
    return f"{size.median:.1f} mm, {100 * size.probability:g} % credible interval {ends}"


def check_pairs(maps: Sequence[MapFile], estimates: Sequence[EstimateFile]) -> None:
    """Refuse an estimate that was not made from the given maps, or not from all of them."""
    for estimate in estimates:
        for one in maps:
            remedy = f"`tactile-bayes estimate {one.path} --json`"
            if not estimate.maps:
                raise UsageError(f"{estimate.path} does not say which map it is of; estimate the file: {remedy}")
            if one.digest not in estimate.maps:
                fault = f"{estimate.path} is not an estimate of {one.path} (the SHA-256 of its map differs)"
                raise UsageError(f"{fault}; make it again: {remedy}")
        missing = len(set(estimate.maps) - {one.digest for one in maps})
        if maps and missing:
            fault = f"{estimate.path} is of {len(estimate.maps)} maps, and {missing} of them are not given"
            raise UsageError(f"{fault}; give all")


# --- Identity of patient and study, as the user or a worklist gives it, checked against what the formats can hold.

_MOMENT: Final = re.compile(
    r"(\d{4})-(\d{2})-(\d{2})(?:[T ](\d{2}):(\d{2})(?::(\d{2}))?(Z|[+-]\d{2}:\d{2})?)?", re.ASCII
)
_UID: Final = re.compile(r"(0|[1-9]\d*)(\.(0|[1-9]\d*))+", re.ASCII)
_NAMES: Final = ("patient_name", "referring_physician")
_REPLACED: Final = "\ufffd"  #: Programs put it for a letter that they could not read; no name or code has it.


class Moment(Record):
    """A date, with the time of day and its zone where they are known."""

    date: str  #: ``YYYYMMDD``.
    time: str = ""  #: ``HHMM`` or ``HHMMSS``; empty where unknown.
    zone: str = ""  #: ``+HHMM`` or ``-HHMM``; empty where unknown.

    @classmethod
    def parse(cls, text: str, *, name: str, date_only: bool = False) -> Moment:
        """Read ``YYYY-MM-DD``, or ``YYYY-MM-DDTHH:MM[:SS]`` with an optional ``Z`` or ``+HH:MM``; errors say `name`."""
        match = _MOMENT.fullmatch(text)
        with_time = " or YYYY-MM-DDTHH:MM, with +HH:MM for the time zone if you know it"
        way_out = "give YYYY-MM-DD" + ("" if date_only else with_time)
        if match is None or (date_only and match[4]):
            raise UsageError(f"{name} is {short_repr(text)}; {way_out}")
        year, month, day, hour, minute, second, zone = match.groups()
        try:
            datetime.datetime(int(year), int(month), int(day), int(hour or 0), int(minute or 0), int(second or 0))
        except ValueError as error:
            raise UsageError(f"{name} is {short_repr(text)}: {error}; {way_out}") from None
        zone = "+00:00" if zone == "Z" else zone or ""
        if zone and not (int(zone[1:3]) <= 14 and int(zone[4:]) < 60):
            raise UsageError(f"{name} is {short_repr(text)}: no time zone is {zone} from UTC; {way_out}")
        return cls(f"{year}{month}{day}", f"{hour or ''}{minute or ''}{second or ''}", zone.replace(":", ""))

    @property
    def iso_date(self) -> str:
        return f"{self.date[:4]}-{self.date[4:6]}-{self.date[6:]}"

    @property
    def fhir(self) -> str:
        """Date and time for FHIR, which takes a time of day only with its zone and seconds; otherwise the date."""
        if not (self.time and self.zone):
            return self.iso_date
        seconds = self.time[4:] or "00"
        return f"{self.iso_date}T{self.time[:2]}:{self.time[2:4]}:{seconds}{self.zone[:3]}:{self.zone[3:]}"


class Identity(IdentityOptions):
    """Identity of patient and study, checked against what the formats can hold; empty where nobody gave it."""

    def __post_init__(self) -> None:
        for name in names_of(self):
            value = getattr(self, name)
            if _REPLACED in value:
                way_out = "a letter was lost on its way (U+FFFD); give it as it is written"
                raise UsageError(f"{name} is {short_repr(value)}: {way_out}")
            if not value.isprintable() or "\\" in value:
                way_out = "leave out backslashes, line ends and other characters that cannot be printed"
                raise UsageError(f"{name} is {short_repr(value)}; {way_out}")
            if value != value.strip():
                raise UsageError(f"{name} is {short_repr(value)}; leave out the blanks around it")
        for name in _NAMES:
            groups = getattr(self, name).split("=")
            if len(groups) > 3 or any(len(group) > 64 or group.count("^") > 4 for group in groups):
                way_out = "give FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX, at most 64 characters"
                raise UsageError(f"{name} is {short_repr(getattr(self, name))}; {way_out}")
        super().__post_init__()
        if self.study_uid and not _UID.fullmatch(self.study_uid):
            way_out = "give numbers with points between, at most 64 characters"
            raise UsageError(f"study_uid is {short_repr(self.study_uid)}; {way_out}")
        for name in ("birth_date", "study_date", "content_date"):
            if text := getattr(self, name):
                Moment.parse(text, name=name, date_only=name == "birth_date")

    @property
    def given(self) -> dict[str, str]:
        return {name: value for name in names_of(self) if (value := getattr(self, name))}

    @property
    def study(self) -> Moment | None:
        """Date and time of the exam."""
        return Moment.parse(self.study_date, name="study_date") if self.study_date else None

    @property
    def content(self) -> Moment | None:
        """Date and time when the content was made; by default those of the exam."""
        return Moment.parse(self.content_date, name="content_date") if self.content_date else self.study


# --- Identity from a worklist: a modality worklist item of DICOM (a file, or DICOM JSON), or plain keys in JSON.

_ONE_ITEM: Final = (
    "give one worklist item: the answer of a modality worklist (.dcm), or JSON with patient_id and others"
)
_MOST_BYTES: Final = 10**6
# DICOM attributes of the parts of an identity; scheduled dates are no dates of an exam.
DICOM_KEYWORDS: Final = {
    "patient_id": "PatientID",
    "patient_name": "PatientName",
    "sex": "PatientSex",
    "issuer": "IssuerOfPatientID",
    "accession": "AccessionNumber",
    "referring_physician": "ReferringPhysicianName",
    "study_description": "RequestedProcedureDescription",
    "study_id": "RequestedProcedureID",
    "study_uid": "StudyInstanceUID",
}
_TAG: Final = re.compile(r"[0-9A-Fa-f]{8}")


def merged_identity(worklist: Path | None, options: Mapping[str, Any]) -> Identity:
    """Identity from a worklist, where there is one, completed by the options; a contradiction is a `UsageError`."""
    identity = Identity() if worklist is None else read_worklist(worklist)
    for name, value in options.items():
        listed = getattr(identity, name)
        if listed and listed != value:
            both = f"{short_repr(value)} by the option and {short_repr(listed)} in the worklist"
            raise UsageError(f"{name} is {both}; leave one out")
    return replace(identity, **options)


def read_worklist(path: Path) -> Identity:
    """Read an identity from a worklist file."""
    data = reading.read_bytes(path, most=_MOST_BYTES)
    if not reading.other_encoding(data) and not reading.is_json(data):
        pydicom = import_extra("pydicom")
        with _decoding(path, "is neither JSON nor a DICOM file"):
            item = pydicom.dcmread(path, stop_before_pixels=True)
            _check_letters(item, pydicom.charset.python_encoding, path)
        return _identity_from_dicom(item, path)
    document = load_json(path, way_out=_ONE_ITEM)
    if isinstance(document, list):
        if len(document) != 1:
            raise BadDataError(f"holds {len(document)} worklist items", way_out="give one", path=str(path))
        document = document[0]
    if not isinstance(document, dict):
        raise BadDataError("is no worklist item", way_out=_ONE_ITEM, path=str(path))
    if document and all(_TAG.fullmatch(key) for key in document):
        with _decoding(path, "is no DICOM JSON"):
            item = import_extra("pydicom").Dataset.from_json(document)
        return _identity_from_dicom(item, path)
    return _checked_identity(as_dict(parse_record(document, IdentityOptions, path=path)), path)


def _checked_identity(values: Mapping[str, Any], path: Path) -> Identity:
    if not any(values.values()):
        raise BadDataError("says nothing of a patient or study", way_out=_ONE_ITEM, path=str(path))
    try:
        return Identity(**{name: value for name, value in values.items() if value})
    except UsageError as error:
        raise BadDataError(str(error), path=str(path)) from None


@contextlib.contextmanager
def _decoding(path: Path, fault: str) -> Iterator[None]:
    """Turn any error of a broken file into a `BadDataError`; the library's warnings and log are not shown."""
    log = logging.getLogger("pydicom")
    level = log.level
    log.setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except TactileBayesError:
            raise
        except Exception as error:  # pydicom's faults are of many kinds
            raise BadDataError(f"{fault} ({type(error).__name__})", way_out=_ONE_ITEM, path=str(path)) from None
        finally:
            log.setLevel(level)


def _check_letters(item: Any, charsets: Collection[str], path: Path) -> None:
    """Refuse letters beyond ASCII where no known character set is declared (PS3.5, 6.1): any guess is another name."""
    declared = item.get("SpecificCharacterSet")
    names = [declared] if isinstance(declared, str) else list(declared or [])
    if names and all(name in charsets for name in names):
        return
    for keyword in (*DICOM_KEYWORDS.values(), "PatientBirthDate"):
        value = getattr(item.get_item(keyword), "value", b"")
        if isinstance(value, bytes) and not value.isascii():
            byte = next(one for one in value if one > 127)
            named = f"the character set {short_repr(str(names[0]))}, which is none" if names else "no character set"
            fault = f"{keyword} holds the byte 0x{byte:02x}, and the item declares {named}"
            way_out = "declare SpecificCharacterSet in it (ISO_IR 192 for UTF-8), or give the name by options"
            raise BadDataError(fault, way_out=way_out, path=str(path))


def _identity_from_dicom(dataset: Any, path: Path) -> Identity:
    with _decoding(path, "holds what cannot be read"):
        values = {name: str(dataset.get(keyword) or "").strip() for name, keyword in DICOM_KEYWORDS.items()}
        birth = str(dataset.get("PatientBirthDate") or "").strip()
    if birth:
        values["birth_date"] = f"{birth[:4]}-{birth[4:6]}-{birth[6:]}" if len(birth) == 8 else birth
    return _checked_identity(values, path)


# --- Place of a map in the coordinate system of DICOM and 3D Slicer: L, P, S in mm from the xiphoid.
#
# The program's `patient` frame has x to the patient's right, y from the xiphoid to the sternal notch and z into the
# body. L, P, S are -x, z, y. Two landmarks and the normal of the scanned skin define it, no scanner: its origin is
# the xiphoid, and its turn about the long axis of the body follows the skin, so that on the side of the breast P
# leans towards it.

LPS_FROM_PATIENT: Final[FloatArray] = np.array(
    [[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def lps_from_plane(tactile_map: TactileMap) -> FloatArray | None:
    """(4, 4) transform from the map's plane to L, P, S in mm; None without landmarks."""
    if tactile_map.patient_from_plane is None:
        return None
    return np.asarray(LPS_FROM_PATIENT @ tactile_map.patient_from_plane)


def lps_point(transform: FloatArray, point_mm: tuple[float, float]) -> FloatArray:
    """(3,) place of a point of the map's plane."""
    return apply(transform, np.array([*point_mm, 0.0]))
