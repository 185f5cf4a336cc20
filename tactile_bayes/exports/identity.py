"""Who was examined and on whose order: given on the command line or by a worklist."""

from __future__ import annotations

import contextlib
import datetime
import logging
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes.declarations import Record, as_dict, names_of, replace
from tactile_bayes.errors import BadDataError, TactileBayesError, UsageError
from tactile_bayes.exports.exam import required
from tactile_bayes.files.documents import load_json, parse_record
from tactile_bayes.files.reading import is_json, other_encoding, read_bytes
from tactile_bayes.options import IdentityOptions

# --- Who was examined, and when: only what the user or a worklist says, checked against what the formats can hold.

_MOMENT: Final = re.compile(
    r"(\d{4})-(\d{2})-(\d{2})(?:[T ](\d{2}):(\d{2})(?::(\d{2}))?(Z|[+-]\d{2}:\d{2})?)?", re.ASCII
)
_UID: Final = re.compile(r"(0|[1-9]\d*)(\.(0|[1-9]\d*))+", re.ASCII)
_NAMES: Final = ("patient_name", "referring_physician")
_REPLACED: Final = "\ufffd"
"""Stands where a program could not read a letter: no name or code holds it."""


class Moment(Record):
    """A date, with the time of day and its zone where they are known."""

    date: str  #: ``YYYYMMDD``.
    time: str = ""  #: ``HHMM`` or ``HHMMSS``; empty where unknown.
    zone: str = ""  #: ``+HHMM`` or ``-HHMM``; empty where unknown.

    @classmethod
    def of(cls, text: str, *, name: str) -> Moment:
        """Read ``YYYY-MM-DD``, or ``YYYY-MM-DDTHH:MM[:SS]`` with ``Z`` or ``+HH:MM`` behind it if it is known."""
        found = _MOMENT.fullmatch(text)
        way_out = "give YYYY-MM-DD or YYYY-MM-DDTHH:MM, with +HH:MM for the time zone if you know it"
        if found is None:
            raise UsageError(f"{name} is {_short(text)}; {way_out}")
        year, month, day, hour, minute, second, zone = found.groups()
        try:
            datetime.datetime(int(year), int(month), int(day), int(hour or 0), int(minute or 0), int(second or 0))
        except ValueError as error:
            raise UsageError(f"{name} is {_short(text)}: {error}; {way_out}") from None
        zone = "+00:00" if zone == "Z" else zone or ""
        if zone and not (int(zone[1:3]) <= 14 and int(zone[4:]) < 60):
            raise UsageError(f"{name} is {_short(text)}: no time zone is {zone} from UTC; {way_out}")
        return cls(f"{year}{month}{day}", f"{hour or ''}{minute or ''}{second or ''}", zone.replace(":", ""))

    @property
    def iso_date(self) -> str:
        """``YYYY-MM-DD``."""
        return f"{self.date[:4]}-{self.date[4:6]}-{self.date[6:]}"

    @property
    def fhir(self) -> str:
        """Date and time of FHIR, which takes a time of day only with its zone and its seconds; otherwise the date."""
        if not (self.time and self.zone):
            return self.iso_date
        seconds = self.time[4:] or "00"
        return f"{self.iso_date}T{self.time[:2]}:{self.time[2:4]}:{seconds}{self.zone[:3]}:{self.zone[3:]}"


class Identity(IdentityOptions):
    """Identity of patient and study that the formats can hold; empty where nobody gave it."""

    def __post_init__(self) -> None:
        for name in names_of(self):
            _check_text(name, getattr(self, name))
        for name in _NAMES:
            groups = getattr(self, name).split("=")
            if len(groups) > 3 or any(len(group) > 64 or group.count("^") > 4 for group in groups):
                way_out = "give FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX, at most 64 characters"
                raise UsageError(f"{name} is {_short(getattr(self, name))}; {way_out}")
        super().__post_init__()
        if self.study_uid and not _UID.fullmatch(self.study_uid):
            raise UsageError(
                f"study_uid is {_short(self.study_uid)}; give numbers with points between, at most 64 characters"
            )
        for name in ("birth_date", "study_date", "content_date"):
            if text := getattr(self, name):
                moment = Moment.of(text, name=name)
                if name == "birth_date" and moment.time:
                    raise UsageError(f"birth_date is {_short(text)}; give YYYY-MM-DD")

    @property
    def given(self) -> dict[str, str]:
        """What was given, by name."""
        return {name: value for name in names_of(self) if (value := getattr(self, name))}

    @property
    def study(self) -> Moment | None:
        """When the exam was."""
        return Moment.of(self.study_date, name="study_date") if self.study_date else None

    @property
    def content(self) -> Moment | None:
        """When the content was made: by default when the exam was."""
        return Moment.of(self.content_date, name="content_date") if self.content_date else self.study

    def with_options(self, options: Mapping[str, str]) -> Identity:
        """The identity with what the command line gives besides."""
        for name, value in options.items():
            known = getattr(self, name)
            if known and known != value:
                raise UsageError(
                    f"{name} is {_short(value)} by the option and {_short(known)} in the worklist; leave one out"
                )
        return replace(self, **dict(options))


def _check_text(name: str, value: str) -> None:
    if _REPLACED in value:
        raise UsageError(f"{name} is {_short(value)}: a letter was lost on its way (U+FFFD); give it as it is written")
    if not value.isprintable() or "\\" in value:
        raise UsageError(
            f"{name} is {_short(value)}; leave out backslashes, line ends and other characters that cannot be printed"
        )
    if value != value.strip():
        raise UsageError(f"{name} is {_short(value)}; leave out the blanks around it")


def _short(value: str) -> str:
    return repr(value if len(value) <= 60 else value[:57] + "...")


# --- Identity from a worklist: a modality worklist item of DICOM (a file, or DICOM JSON), or plain keys in JSON.

_WAY_OUT: Final = "give one worklist item: the answer of a modality worklist (.dcm), or JSON with patient_id and others"
_MOST_BYTES: Final = 10**6
# What a worklist item says, by the attributes of DICOM; scheduled dates are no dates of an exam.
_ATTRIBUTES: Final = {
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


def identity_of(worklist: Path | None, given: Mapping[str, Any]) -> Identity:
    """The identity that a worklist gives, where there is one, with what is given besides."""
    return Identity(**given) if worklist is None else read_worklist(worklist).with_options(given)


def read_worklist(path: Path) -> Identity:
    """Read the identity that a worklist file gives."""
    data = read_bytes(path, most=_MOST_BYTES)
    if not other_encoding(data) and not is_json(data):
        pydicom = required("pydicom")
        with _decoding(path, "is neither JSON nor a DICOM file"):
            item = pydicom.dcmread(path, stop_before_pixels=True)
            _check_letters(item, pydicom.charset.python_encoding, path)
        return _of_dicom(item, path)
    document = load_json(path, way_out=_WAY_OUT)
    if isinstance(document, list):
        if len(document) != 1:
            raise BadDataError(f"holds {len(document)} worklist items", way_out="give one", path=str(path))
        document = document[0]
    if not isinstance(document, dict):
        raise BadDataError("is no worklist item", way_out=_WAY_OUT, path=str(path))
    if document and all(_TAG.fullmatch(key) for key in document):
        with _decoding(path, "is no DICOM JSON"):
            item = required("pydicom").Dataset.from_json(document)
        return _of_dicom(item, path)
    return _identity(as_dict(parse_record(document, IdentityOptions, path=path)), path)


def _identity(found: Mapping[str, Any], path: Path) -> Identity:
    try:
        return Identity(**{name: value for name, value in found.items() if value})
    except UsageError as error:
        raise BadDataError(str(error), path=str(path)) from None


@contextlib.contextmanager
def _decoding(path: Path, what: str) -> Iterator[None]:
    """Whatever a broken file ends in is one line; the library's warnings and its log are not shown."""
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
            raise BadDataError(f"{what} ({type(error).__name__})", way_out=_WAY_OUT, path=str(path)) from None
        finally:
            log.setLevel(level)


def _check_letters(item: Any, known: Collection[str], path: Path) -> None:
    """Refuse letters beyond ASCII where no known character set is declared (PS3.5, 6.1): any guess is another name."""
    declared = item.get("SpecificCharacterSet")
    names = [declared] if isinstance(declared, str) else list(declared or [])
    if names and all(name in known for name in names):
        return
    for keyword in (*_ATTRIBUTES.values(), "PatientBirthDate"):
        value = getattr(item.get_item(keyword), "value", b"")
        if isinstance(value, bytes) and not value.isascii():
            byte = next(one for one in value if one > 127)
            said = f"the character set {_short(str(names[0]))}, which is none" if names else "no character set"
            what = f"{keyword} holds the byte 0x{byte:02x}, and the item declares {said}"
            way_out = "declare SpecificCharacterSet in it (ISO_IR 192 for UTF-8), or give the name by options"
            raise BadDataError(what, way_out=way_out, path=str(path))


def _of_dicom(dataset: Any, path: Path) -> Identity:
    with _decoding(path, "holds what cannot be read"):
        found = {name: str(dataset.get(keyword) or "").strip() for name, keyword in _ATTRIBUTES.items()}
        birth = str(dataset.get("PatientBirthDate") or "").strip()
    if birth:
        found["birth_date"] = f"{birth[:4]}-{birth[4:6]}-{birth[6:]}" if len(birth) == 8 else birth
    if not any(found.values()):
        raise BadDataError("says nothing of a patient or study", way_out=_WAY_OUT, path=str(path))
    return _identity(found, path)
