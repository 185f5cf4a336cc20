"""Identity: from options and worklists alone, kept within what the formats hold, never mixed."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.exports.exam import Identity, Moment, merged_identity, read_worklist


@pytest.mark.parametrize(
    ("text", "date", "time", "zone", "fhir"),
    [
        ("2026-11-24", "20261124", "", "", "2026-11-24"),
        ("2026-11-24T10:30", "20261124", "1030", "", "2026-11-24"),
        ("2026-11-24 10:30:15", "20261124", "103015", "", "2026-11-24"),
        ("2026-11-24T10:30+01:00", "20261124", "1030", "+0100", "2026-11-24T10:30:00+01:00"),
        ("2026-02-28T23:59:59Z", "20260228", "235959", "+0000", "2026-02-28T23:59:59+00:00"),
    ],
)
def test_a_date_with_time_and_zone_is_parsed(text: str, date: str, time: str, zone: str, fhir: str) -> None:
    moment = Moment.parse(text, name="study_date")
    assert (moment.date, moment.time, moment.zone, moment.fhir) == (date, time, zone, fhir)


@pytest.mark.parametrize(
    "text", ["24.11.2026", "2026-02-30", "2026-11-24T25:00", "2026-11-24T10:30+25:00", "٢٠٢٦-11-24"]
)
def test_an_impossible_date_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"study_date is .*YYYY-MM-DD"):
        Moment.parse(text, name="study_date")


@pytest.mark.parametrize(
    ("name", "value", "way_out"), [("birth_date", "1970-13-01", "give YYYY-MM-DD"), ("sex", "X", "give one of F, M, O")]
)
def test_the_way_out_is_one_that_the_field_takes(name: str, value: str, way_out: str) -> None:
    """A date of birth was to be given with a time, which it may not have; the list of sexes ended in nothing."""
    with pytest.raises(UsageError) as caught:
        Identity(**{name: value})
    assert str(caught.value).endswith(way_out)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("patient_id", "A\\B"),
        ("patient_id", "A\nB"),
        ("patient_id", " A"),
        ("patient_id", "A" * 65),
        ("patient_id", "A\x1b(B"),
        ("patient_id", "\u202eA"),
        ("patient_name", "Doe\\Jane"),
        ("patient_name", "D" * 65),
        ("patient_name", "a^b^c^d^e^f"),
        ("patient_name", "a=b=c=d"),
        ("accession", "1" * 17),
        ("sex", "female"),
        ("birth_date", "1970"),
        ("birth_date", "1970-01-01T10:00"),
        ("study_uid", "1.2.03"),
        ("study_uid", "1." * 40 + "1"),
        ("study_uid", "abc"),
    ],
)
def test_an_identity_that_dicom_cannot_hold_is_refused_by_name(name: str, value: str) -> None:
    with pytest.raises(UsageError, match=name) as caught:
        Identity(**{name: value})
    assert len(str(caught.value).splitlines()) == 1


def test_an_option_that_contradicts_the_worklist_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.json"
    path.write_text(json.dumps({"patient_id": "A"}))
    assert merged_identity(path, {"patient_id": "A", "sex": "F"}).sex == "F"
    with pytest.raises(UsageError, match="'B' by the option and 'A' in the worklist"):
        merged_identity(path, {"patient_id": "B"})


def test_a_worklist_of_plain_keys_is_read_and_checked(tmp_path: Path) -> None:
    path = tmp_path / "w.json"
    path.write_text(json.dumps({"patient_id": "A", "patient_name": "Doe^Jane", "sex": ""}))
    assert read_worklist(path).given == {"patient_id": "A", "patient_name": "Doe^Jane"}
    for text, what in (
        ('{"patientid": "A"}', "did you mean patient_id"),
        ('{"patient_id": 7}', "patient_id"),
        ('{"patient_id": "A\\nB"}', "cannot be printed"),
        ("[]", "0 worklist items"),
        ("{}", "says nothing of a patient or study; give one worklist item"),
        ('[{"patient_id": ""}]', "says nothing of a patient or study"),
        ("[1]", "no worklist item"),
        ('{"patient_id"', "JSON"),
    ):
        path.write_text(text)
        with pytest.raises(BadDataError, match=what):
            read_worklist(path)


def worklist_item() -> object:
    pydicom = pytest.importorskip("pydicom")
    one = pydicom.Dataset()
    one.SpecificCharacterSet = "ISO_IR 192"
    one.PatientName, one.PatientID, one.PatientBirthDate, one.PatientSex = "Müller^Ana", "W-1", "19600102", "F"
    one.AccessionNumber, one.StudyInstanceUID, one.IssuerOfPatientID = "ACC9", "1.2.840.99", "HOSP"
    one.RequestedProcedureDescription, one.RequestedProcedureID = "Breast, tactile", "RP1"
    one.ReferringPhysicianName = ""
    step = pydicom.Dataset()
    step.ScheduledProcedureStepStartDate = "20261124"
    one.ScheduledProcedureStepSequence = [step]
    return one


WANTED = {
    "patient_id": "W-1",
    "patient_name": "Müller^Ana",
    "birth_date": "1960-01-02",
    "sex": "F",
    "issuer": "HOSP",
    "accession": "ACC9",
    "study_id": "RP1",
    "study_description": "Breast, tactile",
    "study_uid": "1.2.840.99",
}


def test_a_modality_worklist_item(tmp_path: Path) -> None:
    pydicom = pytest.importorskip("pydicom")
    one = worklist_item()
    one.file_meta = pydicom.dataset.FileMetaDataset()  # type: ignore[attr-defined]
    one.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1"  # type: ignore[attr-defined]
    one.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.31"  # type: ignore[attr-defined]
    one.file_meta.MediaStorageSOPInstanceUID = "1.2.3"  # type: ignore[attr-defined]
    path = tmp_path / "item.dcm"
    one.save_as(path, enforce_file_format=True)  # type: ignore[attr-defined]
    found = read_worklist(path)
    assert found.given == WANTED
    assert found.study is None, "a scheduled date is not the date of the exam"


def test_a_worklist_item_is_read_from_dicom_json(tmp_path: Path) -> None:
    path = tmp_path / "item.json"
    path.write_text(worklist_item().to_json())  # type: ignore[attr-defined]
    assert read_worklist(path).given == WANTED
    path.write_text(f"[{path.read_text()}]")
    assert read_worklist(path).given == WANTED


@pytest.mark.parametrize("data", [b"", b"no dicom at all", b"\0" * 128 + b"DICM" + b"\xff" * 40])
def test_a_broken_file_is_one_line(data: bytes, tmp_path: Path) -> None:
    pytest.importorskip("pydicom")
    path = tmp_path / "item.dcm"
    path.write_bytes(data)
    with pytest.raises(BadDataError, match=r"item\.dcm") as caught:
        read_worklist(path)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("declared", "written", "name"),
    [
        ("ISO_IR 192", "Müller".encode(), "Müller"),
        ("ISO_IR 100", "Müller".encode("latin-1"), "Müller"),
        ("ISO_IR 144", "Иван".encode("iso8859-5"), "Иван"),
        ("", b"Muller", "Muller"),
        ("", "Müller".encode(), "PatientName holds the byte 0xc3, and the item declares no character set"),
        ("", "Müller".encode("latin-1"), "PatientName holds the byte 0xfc, and the item declares no character set"),
        ("", "Иван".encode("iso8859-5"), "declares no character set; declare SpecificCharacterSet"),
        ("ISO_IR 999", "Müller".encode("latin-1"), "the character set 'ISO_IR 999', which is none"),
        ("ISO_IR 192", "Müller".encode("latin-1"), "a letter was lost on its way"),
    ],
)
def test_a_name_is_of_the_declared_character_set_or_refused(
    declared: str, written: bytes, name: str, tmp_path: Path
) -> None:
    """Bytes of an undeclared set were read as Latin-1, and another name was exported."""
    pydicom = pytest.importorskip("pydicom")
    one = pydicom.Dataset()
    if declared:
        one.SpecificCharacterSet = declared
    one.PatientID, one.PatientName = "W-1", "XXXXXXXX"
    one.file_meta = pydicom.dataset.FileMetaDataset()
    one.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1"
    one.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.31"
    one.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    path = tmp_path / "item.dcm"
    with warnings.catch_warnings(action="ignore"):
        one.save_as(path, enforce_file_format=True)
    path.write_bytes(path.read_bytes().replace(b"XXXXXXXX", written.ljust(8)))
    if " " not in name:
        assert read_worklist(path).patient_name == name
        return
    with pytest.raises(BadDataError, match=name):
        read_worklist(path)


def test_json_of_a_worklist_is_utf_8_or_named(tmp_path: Path) -> None:
    path = tmp_path / "item.json"
    text = json.dumps({"patient_id": "W-1", "patient_name": "Müller"}, ensure_ascii=False)
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert read_worklist(path).patient_name == "Müller"
    path.write_bytes(text.encode("utf-16"))
    with pytest.raises(BadDataError, match="is UTF-16 text; save it as UTF-8"):
        read_worklist(path)
    path.write_text(text.replace("ü", "\ufffd"))
    with pytest.raises(BadDataError, match=r"a letter was lost on its way \(U\+FFFD\)"):
        read_worklist(path)
