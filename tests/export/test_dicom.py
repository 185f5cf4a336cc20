"""DICOM of an exam, read back by pydicom and highdicom: values, places, sizes with their intervals, identity."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_files import WHEN, WHO, exported, scan_map, turned

from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance

pydicom = pytest.importorskip("pydicom")
hd = pytest.importorskip("highdicom")

DATED = ("--to", "dicom", "--study-date", WHEN)


@pytest.fixture(scope="module")
def files(exam: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The files of ``map.nc`` and its estimate, by their stems."""
    folder = tmp_path_factory.mktemp("dicom") / "out"
    exported(exam, "map.json", "map.nc", "--to", "dicom", *WHO, "-o", folder)
    return {path.stem: pydicom.dcmread(path) for path in sorted(folder.iterdir())}


def report_of(exam: Path, folder: Path, *words: object) -> Any:
    exported(exam, *words, *DATED, "-o", folder)
    return pydicom.dcmread(folder / "report.dcm")


def items(dataset: Any, value_type: str) -> Iterator[Any]:
    """All content items of a type, in order."""
    for one in dataset.get("ContentSequence", ()):
        if one.ValueType == value_type:
            yield one
        yield from items(one, value_type)


def number(one: Any) -> float:
    return float(one.MeasuredValueSequence[0].NumericValue)


def concept(one: Any) -> str:
    return str(one.ConceptNameCodeSequence[0].CodeValue)


@pytest.mark.long
def test_there_are_values_a_picture_and_a_report_of_one_study(files: dict[str, Any]) -> None:
    assert set(files) == {"map", "picture", "report"}
    assert len({one.StudyInstanceUID for one in files.values()}) == 1
    assert len({one.SeriesInstanceUID for one in files.values()}) == 3
    assert len({one.SOPInstanceUID for one in files.values()}) == 3
    assert [one.SOPClassUID.name for one in files.values()] == [
        "Parametric Map Storage",
        "Secondary Capture Image Storage",
        "Comprehensive 3D SR Storage",
    ]


@pytest.mark.long
def test_identity_is_as_given_and_what_nobody_gave_is_empty(files: dict[str, Any], exam: Path, tmp_path: Path) -> None:
    for one in files.values():
        assert (one.PatientID, one.PatientName, one.PatientBirthDate) == ("P-77", "Doe^Jane", "19700203")
        assert (one.PatientSex, one.AccessionNumber, one.StudyDate, one.StudyTime) == ("F", "A123", "20261124", "1030")
        assert "InstanceCreationDate" not in one
        assert one.ReferringPhysicianName == one.StudyID == ""
    nobody = report_of(exam, tmp_path / "out", "map.nc", "map.json")
    assert nobody.PatientID == nobody.PatientName == nobody.PatientBirthDate == nobody.PatientSex == ""
    assert "S01" not in str(nobody), "the scan's subject is no patient ID unless told"


@contextmanager
def image_of(path: Path) -> Iterator[Any]:
    """An image as highdicom reads it.

    It is looked up by a database in memory that highdicom does not close: from Python 3.13 on that is a warning, which
    comes whenever the garbage is collected, so in some other test.
    """
    image = hd.imread(path)
    with closing(image._db_con):
        yield image


@pytest.mark.long
@pytest.mark.parametrize("degrees", [0.0, 80.0, 200.0, 280.0])
def test_values_lie_at_their_places_in_the_patient(degrees: float, tmp_path: Path) -> None:
    """highdicom's affine of the image against the program's transforms, for all four quarter turns of the picture."""
    one = scan_map(patient_from_plane=turned(degrees))
    scans = ({"sha256": "a" * 64, "side": "right", "posture": "sitting"},)
    write_map(tmp_path / "m.nc", one, provenance=Provenance("test", {}, scans=scans))
    exported(tmp_path, "m.nc", *DATED, "-o", tmp_path / "out")
    with image_of(tmp_path / "out" / "map.dcm") as image:
        volume = image.get_volume(apply_real_world_transform=False)
    assert image.SharedFunctionalGroupsSequence[0].FrameAnatomySequence[0].FrameLaterality == "R"
    assert one.patient_from_plane is not None
    for row, column in ((0, 50), (23, 26), (50, 50), (10, 7)):
        in_patient = one.patient_from_plane @ [one.x_mm[column], one.y_mm[row], 0.0, 1.0]
        lps = np.array([-in_patient[0], in_patient[2], in_patient[1]])
        index = np.rint(volume.map_reference_to_indices(lps[None])[0]).astype(int)
        assert volume.map_indices_to_reference(index[None])[0] == pytest.approx(lps, abs=1e-6)
        assert volume.array[tuple(index)] == np.float32(one.mean[row, column])
    orientation = image.SharedFunctionalGroupsSequence[0].PlaneOrientationSequence[0].ImageOrientationPatient
    assert orientation[0] > 0.6, "columns run to the patient's left"
    assert orientation[5] < -0.6, "rows run to the feet"


@pytest.mark.long
def test_all_values_are_read_back_and_gaps_are_padding(files: dict[str, Any], exam: Path) -> None:
    one = read_map(exam / "map.nc")
    values = files["map"].pixel_array
    assert values.dtype == np.float32
    assert np.array_equal(np.sort(values[~np.isnan(values)]), np.sort(one.mean[one.covered].astype(np.float32)))
    assert np.isnan(values).sum() == (~one.covered).sum() == 12
    assert np.isnan(files["map"].FloatPixelPaddingValue)


@pytest.mark.long
def test_sizes_and_intervals_are_read_back_equal(files: dict[str, Any], estimate: dict[str, Any]) -> None:
    report = hd.sr.srread(pydicom.filebase.DicomBytesIO(written(files["report"])))
    (group,) = report.content.get_planar_roi_measurement_groups()
    axes = {"103339001": "max_size_mm", "103340004": "min_size_mm"}
    sizes = {one.name.value: one for one in group.get_measurements() if one.name.value in axes}
    assert set(sizes) == set(axes)
    for code, name in axes.items():
        size, found = estimate["another_exam"][name], sizes[code]
        assert (found.value, found.unit.value) == (size["median"], "mm")
        assert found.derivation.value == "373099004", "a median"
        properties = {concept(one): number(one) for one in items(found[0], "NUM")}
        assert properties["interval-low"] == size["low"]
        assert properties["interval-high"] == size["high"]
        assert properties["interval-prob"] == 100 * size["probability"]
        assert properties["371886008"] == pytest.approx(size["high"] - size["median"])
        assert properties["371885007"] == pytest.approx(size["median"] - size["low"])
    certainty = next(one for one in group.get_measurements() if one.name.value == "111012")
    assert certainty.value == pytest.approx(100 * estimate["detected_probability"])
    (site,) = group.finding_sites
    assert (site.value.value, site.laterality.meaning) == ("76752008", "Left")
    assert group.method.value == "tactile-size"


def written(dataset: Any) -> bytes:
    buffer = pydicom.filebase.DicomBytesIO()
    dataset.save_as(buffer, enforce_file_format=True)
    return bytes(buffer.getvalue())


@pytest.mark.long
def test_the_lump_is_a_point_in_the_maps_frame_of_reference(files: dict[str, Any], estimate: dict[str, Any]) -> None:
    (point,) = items(files["report"], "SCOORD3D")
    assert point.ReferencedFrameOfReferenceUID == files["map"].FrameOfReferenceUID
    left, _, superior = point.GraphicData
    patient = estimate["centre_patient_mm"]
    assert left == pytest.approx(-patient["x"]["median"], abs=0.02)
    assert superior == pytest.approx(patient["y"]["median"], abs=0.02)


@pytest.mark.long
def test_own_codes_are_declared_and_research_use_is_said(files: dict[str, Any]) -> None:
    (scheme,) = files["report"].CodingSchemeIdentificationSequence
    assert scheme.CodingSchemeDesignator == "99TACTILEBAYES"
    texts = [one.TextValue for one in items(files["report"], "TEXT")]
    assert "Research use only: not a diagnostic device." in texts
    assert files["report"].VerificationFlag == "UNVERIFIED"
    assert files["report"].PreliminaryFlag == "PRELIMINARY"
    assert files["map"].ContentQualification == "RESEARCH"


@pytest.mark.long
def test_no_lump_is_a_report_without_sizes(exam: Path, tmp_path: Path) -> None:
    report = report_of(exam, tmp_path / "out", "empty.nc", "empty.json")
    assert {concept(one) for one in items(report, "NUM")} <= {"111012"}
    coded = {concept(one): one.ConceptCodeSequence[0].CodeValue for one in items(report, "CODE")}
    assert coded["outcome"] == "no-lump-shown"
    assert "89164003" not in coded.values(), "no breast lump"
    reason = json.loads((exam / "empty.json").read_text())["reason"]
    assert reason in [one.TextValue for one in items(report, "TEXT")]


@pytest.mark.parametrize(("name", "why"), [("phantom", "no posture of a person"), ("bare", "no landmarks")])
def test_a_map_without_a_place_in_a_patient_is_a_picture(name: str, why: str, exam: Path, tmp_path: Path) -> None:
    done = exported(exam, f"{name}.nc", *DATED, "-o", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["picture.dcm"]
    assert why in done.stderr
    picture = pydicom.dcmread(tmp_path / "out" / "picture.dcm")
    assert picture.pixel_array.shape == (picture.Rows, picture.Columns, 3)
    assert picture.Laterality == ("L" if name == "bare" else "")


def test_a_posterior_gives_the_sizes_of_its_estimate(exam: Path, estimate: dict[str, Any], tmp_path: Path) -> None:
    report = report_of(exam, tmp_path / "out", "map.nc", "map_post.nc")
    sizes = {concept(one): number(one) for one in items(report, "NUM") if concept(one) in ("103339001", "103340004")}
    assert sizes == {
        "103339001": pytest.approx(estimate["another_exam"]["max_size_mm"]["median"]),
        "103340004": pytest.approx(estimate["another_exam"]["min_size_mm"]["median"]),
    }


@pytest.mark.long
def test_identifiers_and_bytes_follow_from_content_and_identity(exam: Path, tmp_path: Path) -> None:
    """Other content must not have the same identifier, and the same content must not have another."""
    folders = {"one": (), "two": (), "other": ("--patient-id", "B"), "told": ("--study-uid", "1.2.3")}
    for name, words in folders.items():
        exported(exam, "map.nc", "map.json", *DATED, *words, "-o", tmp_path / name)
    read = {name: pydicom.dcmread(tmp_path / name / "report.dcm") for name in folders}
    for stem in ("map", "picture", "report"):
        assert (tmp_path / "one" / f"{stem}.dcm").read_bytes() == (tmp_path / "two" / f"{stem}.dcm").read_bytes()
    assert read["one"].SOPInstanceUID != read["other"].SOPInstanceUID
    assert read["one"].StudyInstanceUID != read["other"].StudyInstanceUID
    assert read["told"].StudyInstanceUID == "1.2.3"
    assert all(one.SOPInstanceUID.is_valid and one.SOPInstanceUID.startswith("2.25.") for one in read.values())


def test_names_in_any_script_are_kept_and_broken_ones_refused(exam: Path, tmp_path: Path) -> None:
    name = "Müller^Ана^<b>=山田^太郎"
    exported(exam, "map.nc", *DATED, "--patient-name", name, "-o", tmp_path / "out")
    assert pydicom.dcmread(tmp_path / "out" / "map.dcm").PatientName == name
