"""What the DICOM objects of one export share: patient, study, equipment, identifiers, and their bytes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Final

from tactile_bayes import __version__
from tactile_bayes.errors import UsageError
from tactile_bayes.exports.codes import OWN_SCHEME, OWN_SCHEME_NAME, OWN_SCHEME_UID, Code
from tactile_bayes.exports.exam import MapFile
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.identity import Identity, Moment
from tactile_bayes.exports.uids import content_uid
from tactile_bayes.records import dataclass

MANUFACTURER: Final = "tactile_bayes (research software)"
MODEL: Final = "tactile-bayes"
UTF_8: Final = "ISO_IR 192"
EXPLICIT_LITTLE_ENDIAN: Final = "1.2.840.10008.1.2.1"
# What highdicom writes by the clock; all may be left out.
_OF_THE_CLOCK: Final = (
    "InstanceCreationDate",
    "InstanceCreationTime",
    "DateOfSecondaryCapture",
    "TimeOfSecondaryCapture",
    "ContributionDateTime",
)
# Written where the standard wants a serial number and nobody gave one.
NO_SERIAL_NUMBER: Final = "unknown"


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Patient and study of one export.

    Parameters
    ----------
    identity
        As given; its `patient_id` may come from the scan.
    moment, content
        When the exam was and when the content was made, with the time of day.
    study_uid
        As given, or by the content of the maps.
    key
        What identifiers of the objects follow from, besides their own content.
    """

    identity: Identity
    moment: Moment
    content: Moment
    study_uid: str
    key: tuple[str, ...]

    def uid(self, role: str, *parts: str) -> str:
        """Identifier of an object, or of its series, by the study and the object's content."""
        return content_uid(role, self.study_uid, *self.key, *parts)


def study_of(identity: Identity, maps: Sequence[MapFile]) -> Study:
    """The study that maps of one exam belong to.

    Raises
    ------
    UsageError
        When the date and time that DICOM wants are not given.
    """
    moment, content = identity.study, identity.content
    if moment is None or content is None:
        raise UsageError(
            "DICOM needs to know when the exam was; give --study-date YYYY-MM-DDTHH:MM, or a --worklist with study_date"
        )
    for name, one in (("study-date", moment), ("content-date", content)):
        if not one.time:
            raise UsageError(f"DICOM needs the time of day; give --{name} {one.iso_date}THH:MM")
    given = [f"{name}={value}" for name, value in sorted(identity.given.items())]
    digests = sorted(one.digest for one in maps)
    # equal for all exports of one exam, whatever else is exported with it
    person = [line for line in given if line.startswith(("patient_id=", "issuer=", "accession=", "study_date="))]
    study_uid = identity.study_uid or content_uid("study", *digests, *person)
    return Study(identity, moment, content, study_uid, (__version__, *given))


def add_study(dataset: Any, study: Study, facts: Mapping[str, str] | None = None) -> None:
    """Write the modules of patient, study and equipment into a dataset; what nobody gave stays empty.

    Parameters
    ----------
    facts
        Of an image's exam, for the breast and its side; neither is written of a phantom.
    """
    identity = study.identity
    dataset.SpecificCharacterSet = UTF_8
    dataset.PatientName = identity.patient_name
    dataset.PatientID = identity.patient_id
    if identity.issuer:
        dataset.IssuerOfPatientID = identity.issuer
    dataset.PatientBirthDate = identity.birth_date.replace("-", "")
    dataset.PatientSex = identity.sex
    dataset.StudyInstanceUID = study.study_uid
    dataset.StudyDate, dataset.StudyTime = study.moment.date, study.moment.time
    dataset.ContentDate, dataset.ContentTime = study.content.date, study.content.time
    if study.moment.zone:
        dataset.TimezoneOffsetFromUTC = study.moment.zone
    dataset.AccessionNumber = identity.accession
    dataset.StudyID = identity.study_id
    dataset.ReferringPhysicianName = identity.referring_physician
    if identity.study_description:
        dataset.StudyDescription = identity.study_description
    dataset.Manufacturer = MANUFACTURER
    dataset.ManufacturerModelName = MODEL
    dataset.DeviceSerialNumber = NO_SERIAL_NUMBER
    dataset.SoftwareVersions = __version__
    if facts is not None:
        dataset.Laterality = laterality(facts)
        if dataset.Laterality:
            dataset.BodyPartExamined = "BREAST"


def coded(code: Code) -> Any:
    """A concept as highdicom has it."""
    return required("highdicom").sr.CodedConcept(code.value, code.scheme, code.meaning)


def item(**attributes: Any) -> Any:
    """A dataset of these attributes, for a sequence."""
    dataset = required("pydicom").Dataset()
    for name, value in attributes.items():
        setattr(dataset, name, value)
    return dataset


def laterality(facts: Mapping[str, str]) -> str:
    """``L`` or ``R`` by the scan's session; empty for a phantom or an unknown side."""
    side = facts.get("side", "")
    return side[0].upper() if side in ("left", "right") else ""


def declare_scheme(dataset: Any) -> None:
    """Declare this program's own coding scheme, as a file must that uses one."""
    dataset.CodingSchemeIdentificationSequence = [
        item(
            CodingSchemeDesignator=OWN_SCHEME,
            CodingSchemeUID=OWN_SCHEME_UID,
            CodingSchemeName=OWN_SCHEME_NAME,
            CodingSchemeResponsibleOrganization=MODEL,
        )
    ]


def dicom_bytes(dataset: Any) -> bytes:
    """The dataset as a file of DICOM's part 10; nothing in it depends on the clock."""
    pydicom = required("pydicom")
    for one in (dataset, *dataset.get("ContributingEquipmentSequence", ())):
        for name in _OF_THE_CLOCK:
            if name in one:
                delattr(one, name)
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    meta.TransferSyntaxUID = EXPLICIT_LITTLE_ENDIAN
    meta.ImplementationClassUID = content_uid("implementation", MODEL)
    meta.ImplementationVersionName = "TACTILE_BAYES"
    plain = pydicom.Dataset(dataset)
    plain.file_meta = meta
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pydicom.dcmwrite(buffer, plain, enforce_file_format=True, implicit_vr=False, little_endian=True)
    return buffer.getvalue()
