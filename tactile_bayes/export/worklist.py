"""Identity from a worklist: a modality worklist item of DICOM (a file, or DICOM JSON), or plain keys in JSON."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, Final

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.export.extras import required
from tactile_bayes.export.identity import Identity
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
        return _identity(_of_dicom(_read_dicom(path)), path)
    document = load_json(path, way_out=_WAY_OUT)
    if isinstance(document, list):
        if len(document) != 1:
            raise BadDataError(f"holds {len(document)} worklist items", way_out="give one", path=str(path))
        document = document[0]
    if not isinstance(document, dict):
        raise BadDataError("is no worklist item", way_out=_WAY_OUT, path=str(path))
    if document and all(_TAG.fullmatch(key) for key in document):
        return _identity(_of_dicom(_from_dicom_json(document, path)), path)
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return pydicom.dcmread(path, stop_before_pixels=True)
        except Exception as error:  # a broken file ends in errors of many kinds
            what = f"is neither JSON nor a DICOM file ({type(error).__name__})"
            raise BadDataError(what, way_out=_WAY_OUT, path=str(path)) from None


def _from_dicom_json(document: dict[str, Any], path: Path) -> Any:
    pydicom = required("pydicom")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return pydicom.Dataset.from_json(document)
        except Exception as error:
            what = f"is no DICOM JSON ({type(error).__name__})"
            raise BadDataError(what, way_out=_WAY_OUT, path=str(path)) from None


def _of_dicom(dataset: Any) -> dict[str, str]:
    """Identity by the names of `Identity`; attributes that are empty are left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {name: str(dataset.get(keyword) or "").strip() for name, keyword in _ATTRIBUTES.items()}
        birth = str(dataset.get("PatientBirthDate") or "").strip()
    if birth:
        found["birth_date"] = f"{birth[:4]}-{birth[4:6]}-{birth[6:]}" if len(birth) == 8 else birth
    return {name: value for name, value in found.items() if value}
