"""Identity from a worklist: a modality worklist item of DICOM (a file, or DICOM JSON), or plain keys in JSON."""

from __future__ import annotations

import contextlib
import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, TactileBayesError, UsageError
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.identity import Identity
from tactile_bayes.files.documents import load_json
from tactile_bayes.files.keys import refuse_unknown
from tactile_bayes.files.reading import read_bytes
from tactile_bayes.files.schema import check_document, load_schema

SCHEMA: Final = "worklist.schema.json"
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


def identity_of(worklist: Path | None, given: Mapping[str, str]) -> Identity:
    """The identity that a worklist gives, where there is one, with what is given besides.

    Raises
    ------
    BadDataError
        As of `read_worklist`.
    UsageError
        When both say something else.
    """
    return Identity(**given) if worklist is None else read_worklist(worklist).with_options(given)


def read_worklist(path: Path) -> Identity:
    """Read the identity that a worklist file gives.

    Raises
    ------
    BadDataError
        When the file is no worklist item, or holds what cannot be an identity.
    UsageError
        When it is DICOM and the extra is not installed.
    """
    data = read_bytes(path, most=_MOST_BYTES)
    if not data.lstrip().startswith((b"{", b"[")):
        return _identity(_of_dicom(_read_dicom(path), path), path)
    document = load_json(path, way_out=_WAY_OUT)
    if isinstance(document, list):
        if len(document) != 1:
            raise BadDataError(f"holds {len(document)} worklist items", way_out="give one", path=str(path))
        document = document[0]
    if not isinstance(document, dict):
        raise BadDataError("is no worklist item", way_out=_WAY_OUT, path=str(path))
    if document and all(_TAG.fullmatch(key) for key in document):
        return _identity(_of_dicom(_from_dicom_json(document, path), path), path)
    refuse_unknown(document, load_schema(SCHEMA)["properties"], path=path)
    check_document(document, SCHEMA, path=path)
    return _identity({name: value for name, value in document.items() if value}, path)


def _identity(given: dict[str, str], path: Path) -> Identity:
    try:
        return Identity(**given)
    except UsageError as error:
        raise BadDataError(str(error), path=str(path)) from None


def _read_dicom(path: Path) -> Any:
    pydicom = required("pydicom")
    with _decoding(path, "is neither JSON nor a DICOM file"):
        return pydicom.dcmread(path, stop_before_pixels=True)


def _from_dicom_json(document: dict[str, Any], path: Path) -> Any:
    pydicom = required("pydicom")
    with _decoding(path, "is no DICOM JSON"):
        return pydicom.Dataset.from_json(document)


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


def _of_dicom(dataset: Any, path: Path) -> dict[str, str]:
    """Identity by the names of `Identity`; attributes that are empty are left out."""
    with _decoding(path, "holds what cannot be read"):
        found = {name: str(dataset.get(keyword) or "").strip() for name, keyword in _ATTRIBUTES.items()}
        birth = str(dataset.get("PatientBirthDate") or "").strip()
    if birth:
        found["birth_date"] = f"{birth[:4]}-{birth[4:6]}-{birth[6:]}" if len(birth) == 8 else birth
    found = {name: value for name, value in found.items() if value}
    if not found:
        raise BadDataError("says nothing of a patient or study", way_out=_WAY_OUT, path=str(path))
    return found
