"""DICOM of an exam: maps as values and as pictures, and a structured report."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes import __version__
from tactile_bayes.declarations import Record, replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.exports import exam
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.findings import finding_lines
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import TactileMap, orientation_of
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import no_estimate_line
from tactile_bayes.report.figure_file import plain_matplotlib
from tactile_bayes.report.map import map_figure

# --- Patient, study, equipment and identifiers, which the DICOM objects of one export share, and their bytes.

MANUFACTURER: Final = "tactile_bayes (research software)"
MODEL: Final = "tactile-bayes"
EXPLICIT_LITTLE_ENDIAN: Final = "1.2.840.10008.1.2.1"
# Times of writing, which highdicom takes from the clock; all may be left out.
_OF_THE_CLOCK: Final = (
    "InstanceCreationDate",
    "InstanceCreationTime",
    "DateOfSecondaryCapture",
    "TimeOfSecondaryCapture",
    "ContributionDateTime",
)


class Study(Record, eq=False):
    """Patient and study of one export."""

    identity: exam.Identity  #: As given; its `patient_id` may come from the scan.
    moment: exam.Moment
    content: exam.Moment
    """`moment`, `content`: Date and time of the exam, and of the making of the content, with the time of day."""
    study_uid: str  #: As given, or derived from the content of the maps.
    key: tuple[str, ...]  #: Parts that the identifiers of all objects derive from, besides their content.

    def uid(self, role: str, *parts: str) -> str:
        """Identifier of an object or a series, derived from the study and from the content."""
        return exam.content_uid(role, self.study_uid, *self.key, *parts)


def make_study(identity: exam.Identity, maps: Sequence[exam.MapFile]) -> Study:
    """Study of the maps of one exam."""
    moment, content = identity.study, identity.content
    if moment is None or content is None:
        way_out = "give --study-date YYYY-MM-DDTHH:MM, or a --worklist with study_date"
        raise UsageError(f"DICOM needs to know when the exam was; {way_out}")
    for name, one in (("study-date", moment), ("content-date", content)):
        if not one.time:
            raise UsageError(f"DICOM needs the time of day; give --{name} {one.iso_date}THH:MM")
    identity_lines = [f"{name}={value}" for name, value in sorted(identity.given.items())]
    digests = sorted(one.digest for one in maps)
    # equal for all exports of one exam, whatever else is exported with it
    of_exam = ("patient_id=", "issuer=", "accession=", "study_date=")
    person = [line for line in identity_lines if line.startswith(of_exam)]
    study_uid = identity.study_uid or exam.content_uid("study", *digests, *person)
    return Study(identity, moment, content, study_uid, (__version__, *identity_lines))


def add_study(dataset: Any, study: Study, source: exam.MapFile | None = None) -> None:
    """Write the modules of patient, study and equipment into a dataset; parts that nobody gave stay empty.

    With `source`, the map of an image, also the breast and its side; a phantom has neither.
    """
    identity = study.identity
    dataset.SpecificCharacterSet = "ISO_IR 192"  # UTF-8
    keywords = {**exam.DICOM_KEYWORDS, "study_description": "StudyDescription", "study_id": "StudyID"}
    for name, keyword in keywords.items():
        if (value := getattr(identity, name)) or name not in ("issuer", "study_description"):
            setattr(dataset, keyword, value)
    dataset.PatientBirthDate = identity.birth_date.replace("-", "")
    dataset.StudyInstanceUID = study.study_uid
    dataset.StudyDate, dataset.StudyTime = study.moment.date, study.moment.time
    dataset.ContentDate, dataset.ContentTime = study.content.date, study.content.time
    if study.moment.zone:
        dataset.TimezoneOffsetFromUTC = study.moment.zone
    dataset.Manufacturer = MANUFACTURER
    dataset.ManufacturerModelName = MODEL
    dataset.DeviceSerialNumber = "unknown"  # the standard wants one, and nobody gave it
    dataset.SoftwareVersions = __version__
    if source is not None:
        dataset.Laterality = laterality(source.facts)
        if dataset.Laterality:
            dataset.BodyPartExamined = "BREAST"
        dataset.BurnedInAnnotation = "NO"  # nothing in it says who the patient is, nor when the exam was
        dataset.RecognizableVisualFeatures = "NO"


def coded(code: exam.Code) -> Any:
    """Convert a concept to highdicom's class."""
    return exam.import_extra("highdicom").sr.CodedConcept(code.value, code.scheme, code.meaning)


def item(**attributes: Any) -> Any:
    """A dataset of these attributes, for a sequence."""
    dataset = exam.import_extra("pydicom").Dataset()
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
            CodingSchemeDesignator=exam.OWN_SCHEME,
            CodingSchemeUID=exam.OWN_SCHEME_UID,
            CodingSchemeName=exam.OWN_SCHEME_NAME,
            CodingSchemeResponsibleOrganization=MODEL,
        )
    ]


def dicom_bytes(dataset: Any) -> bytes:
    """Bytes of a dataset as a DICOM part 10 file; nothing in them depends on the clock."""
    pydicom = exam.import_extra("pydicom")
    for one in (dataset, *dataset.get("ContributingEquipmentSequence", ())):
        for name in _OF_THE_CLOCK:
            if name in one:
                delattr(one, name)
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    meta.TransferSyntaxUID = EXPLICIT_LITTLE_ENDIAN
    meta.ImplementationClassUID = exam.content_uid("implementation", MODEL)
    meta.ImplementationVersionName = "TACTILE_BAYES"
    plain = pydicom.Dataset(dataset)
    plain.file_meta = meta
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pydicom.dcmwrite(buffer, plain, enforce_file_format=True, implicit_vr=False, little_endian=True)
    return buffer.getvalue()


# --- The map's figure as pixels, with the estimate where there is one.

_MOST_NOTE: Final = 400  #: Characters that fit above the figure.


def map_picture(source: exam.MapFile, estimate: exam.EstimateFile | None) -> NDArray[np.uint8]:
    """(rows, columns, 3) red, green and blue of the map's figure; with the ellipse of an estimate of this map alone.

    No file name is in it, because those may hold patients' names.
    """
    report = None if estimate is None or estimate.kind != "estimate" else estimate.report
    alone = replace(report, masses=()) if isinstance(report, EstimateReport) else None
    unsized = [] if estimate is None or estimate.sized else [mass.reason for mass in estimate.masses]
    side = source.facts.get("side")
    with plain_matplotlib() as library:
        figure = map_figure(
            source.tactile_map,
            None,
            report=alone,
            title="Tactile map" + (f" of the {side} breast" if side in ("left", "right") else ""),
            note=no_estimate_line(unsized[0][:_MOST_NOTE]) if unsized else "",
            findings=None if estimate is None else estimate.report.findings,
        )
        canvas = library.backends.backend_agg.FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())
    return np.ascontiguousarray(pixels[:, :, :3])


# --- The map's figure as a DICOM Secondary Capture, which every viewer shows.


def secondary_capture(source: exam.MapFile, estimate: exam.EstimateFile | None, *, study: Study, number: int) -> Any:
    """The figure as a Secondary Capture in red, green and blue; `number` is that of the instance in its series."""
    highdicom = exam.import_extra("highdicom")
    dataset = highdicom.sc.SCImage(
        pixel_array=map_picture(source, estimate),
        photometric_interpretation="RGB",
        bits_allocated=8,
        coordinate_system="PATIENT",
        patient_orientation=("L", "F"),
        study_instance_uid=study.study_uid,
        series_instance_uid=study.uid("series of pictures"),
        series_number=2,
        sop_instance_uid=study.uid("picture", source.digest, "" if estimate is None else estimate.digest),
        instance_number=number,
        manufacturer=MANUFACTURER,
        transfer_syntax_uid=EXPLICIT_LITTLE_ENDIAN,
        series_description=f"Map figure. {RESEARCH_USE}",
        content_date=study.content.date,
        content_time=study.content.time,
    )
    add_study(dataset, study, source)
    if source.tactile_map.patient_from_plane is None:
        dataset.PatientOrientation = ""
    dataset.ImageComments = f"{RESEARCH_USE} SHA-256 of the map: {source.digest}"
    return dataset


# --- A map as an image.


def image_plane(tactile_map: TactileMap, transform: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A map's means as the rows of an image, oriented as in every picture of the program.

    `transform` (4, 4) places the map's plane. Returns (rows, columns) values, row 0 on top and NaN without data; (2, 3)
    unit vectors in L, P, S along a row and down a column; and the (3,) centre of the first value of the first row, mm.
    """
    view = orientation_of(tactile_map)
    values = np.where(tactile_map.covered, tactile_map.mean, np.nan)
    axes = {"x": (tactile_map.x_mm, transform[:3, 0]), "y": (tactile_map.y_mm, transform[:3, 1])}
    corner, directions = dict[str, float](), list[FloatArray]()
    for towards, sign in ((view.right, 1.0), (view.up, -1.0)):
        centres, axis = axes[towards[1]]
        step = sign if towards[0] == "+" else -sign
        corner[towards[1]] = float(centres[0] if step > 0 else centres[-1])
        directions.append(step * axis)
    first_centre = exam.lps_point(transform, (corner["x"], corner["y"]))
    return np.ascontiguousarray(view.screen(values)), np.array(directions), first_centre


# --- A map as a DICOM Parametric Map: float values, with their place in the patient where it is known.

PARAMETRIC_MAP: Final = "1.2.840.10008.5.1.4.1.1.30"
POSTURES: Final = ("supine", "oblique", "sitting")  #: Of a person; a phantom has no patient's coordinates.
_IMAGE_TYPE: Final = ["DERIVED", "PRIMARY", "VOLUME", "QUANTITY"]


def lps_of_map(source: exam.MapFile) -> FloatArray | None:
    """(4, 4) from the map's plane to L, P, S in mm; None without landmarks, or without a posture of a person."""
    return exam.lps_from_plane(source.tactile_map) if source.facts.get("posture") in POSTURES else None


def frame_of_reference(source: exam.MapFile) -> str:
    """Identifier of the map's own coordinates: those of another map of the exam differ, because the third axis follows
    the normal of the scanned skin."""
    return exam.content_uid("frame of reference", source.digest)


def parametric_map(source: exam.MapFile, transform: FloatArray, *, study: Study, number: int) -> Any:
    """The map's means as a Parametric Map of one frame that faces the viewer as the program's pictures do.

    Cells without data are NaN, which is also the padding value. `number` is that of the instance in its series.
    """
    values, directions, corner_mm = image_plane(source.tactile_map, transform)
    pydicom = exam.import_extra("pydicom")
    dataset = pydicom.Dataset()
    add_study(dataset, study, source)
    if dataset.Laterality:
        del dataset.Laterality  # the frame has it, and it must not stand twice
    declare_scheme(dataset)
    dataset.SOPClassUID = PARAMETRIC_MAP
    dataset.SOPInstanceUID = study.uid("parametric map", source.digest)
    dataset.Modality = "OT"
    dataset.SeriesInstanceUID = study.uid("series of parametric maps")
    dataset.SeriesNumber, dataset.InstanceNumber = 1, number
    dataset.SeriesDescription = f"Tactile map. {RESEARCH_USE}"
    dataset.FrameOfReferenceUID = frame_of_reference(source)
    dataset.PositionReferenceIndicator = "XIPHOID"
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.NumberOfFrames = 1
    dataset.Rows, dataset.Columns = values.shape
    dataset.BitsAllocated = 32
    dataset.FloatPixelPaddingValue = dataset.FloatPixelPaddingRangeLimit = float("nan")
    dataset.FloatPixelData = values.astype("<f4").tobytes()
    dataset.ImageType = _IMAGE_TYPE
    dataset.ContentLabel = "TACTILE_MAP"
    dataset.ContentDescription = source.tactile_map.recipe.value_words[:64]
    dataset.ContentCreatorName = ""
    dataset.ContentQualification = "RESEARCH"
    dataset.LossyImageCompression = "00"
    dataset.PresentationLUTShape = "IDENTITY"
    dataset.AcquisitionContextSequence = []
    comments = [RESEARCH_USE, *finding_lines(source.tactile_map.findings, paper=True)]
    dataset.ImageComments = f"{' '.join(comments)} SHA-256 of the map: {source.digest}"
    dataset.SharedFunctionalGroupsSequence = [_shared_groups(source, values, directions)]
    # one dimension, the place in a stack of one frame
    organization = study.uid("dimension", source.digest)
    pointers = {
        "DimensionIndexPointer": pydicom.tag.Tag("InStackPositionNumber"),
        "FunctionalGroupPointer": pydicom.tag.Tag("FrameContentSequence"),
    }
    dataset.DimensionOrganizationSequence = [item(DimensionOrganizationUID=organization)]
    dataset.DimensionIndexSequence = [item(DimensionOrganizationUID=organization, **pointers)]
    content = item(StackID="1", InStackPositionNumber=1, DimensionIndexValues=[1])
    position = item(ImagePositionPatient=[_decimal(value) for value in corner_mm])
    frame = item(FrameContentSequence=[content], PlanePositionSequence=[position])
    dataset.PerFrameFunctionalGroupsSequence = [frame]
    return dataset


def _shared_groups(source: exam.MapFile, values: FloatArray, directions: FloatArray) -> Any:
    highdicom = exam.import_extra("highdicom")
    cell = source.tactile_map.recipe.cell_mm
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    turn = [_decimal(0.0 if abs(direction) < 1e-12 else direction) for direction in directions.ravel()]
    window = {"WindowCenter": _decimal((low + high) / 2), "WindowWidth": _decimal(max(high - low, 1e-6))}
    groups = item(
        PixelMeasuresSequence=highdicom.PixelMeasuresSequence((cell, cell), cell),
        RealWorldValueMappingSequence=[_value_mapping(source)],
        ParametricMapFrameTypeSequence=[item(FrameType=_IMAGE_TYPE)],
        PixelValueTransformationSequence=[item(RescaleIntercept=0, RescaleSlope=1, RescaleType="US")],
        FrameVOILUTSequence=[item(**window, VOILUTFunction="LINEAR_EXACT")],
        PlaneOrientationSequence=[item(ImageOrientationPatient=turn)],
    )
    side = laterality(source.facts)
    if side:
        groups.FrameAnatomySequence = [item(FrameLaterality=side, AnatomicRegionSequence=[coded(exam.BREAST)])]
    return groups


def _value_mapping(source: exam.MapFile) -> Any:
    """Mapping of the stored values to themselves, in the map's unit."""
    highdicom, pydicom = exam.import_extra("highdicom"), exam.import_extra("pydicom")
    recipe, values = source.tactile_map.recipe, source.tactile_map.mean[source.tactile_map.covered]
    quantity = exam.RELATIVE_PRESSURE if recipe.value_unit == "1" else exam.PRESSURE
    kilopascal = pydicom.sr.coding.Code("kPa", "UCUM", "kilopascal")
    unit = kilopascal if recipe.value_unit == "kPa" else pydicom.sr.codedict.codes.UCUM.NoUnits
    ends = np.array([values.min(), values.max()], "<f4").astype(float)
    return highdicom.pm.RealWorldValueMapping(
        lut_label="TACTILE",
        lut_explanation=recipe.value_words[:64],
        unit=unit,
        value_range=(float(ends[0]), float(ends[1])),
        slope=1.0,
        intercept=0.0,
        quantity_definition=coded(quantity) if recipe.source == "scan" else None,
    )


def _decimal(value: float) -> str:
    """A number as DICOM's decimal string of at most 16 characters."""
    texts = (f"{value + 0.0:.{digits}g}" for digits in range(12, 5, -1))
    return next(text for text in texts if len(text) <= 16)


# --- An estimate as a DICOM Comprehensive 3D SR by TID 1500: one measurement group per mass.

_MM: Final = exam.Code("mm", "UCUM", "millimeter")
_PERCENT: Final = exam.Code("%", "UCUM", "percent")


def structured_report(
    estimate: exam.EstimateFile, maps: Sequence[exam.MapFile], *, evidence: Sequence[Any], study: Study
) -> Any:
    """The estimate as a structured report, preliminary and unverified.

    A size is the median; the ends of its interval, with its probability, are properties of that measurement. A mass
    without a size is a group with a finding and the reason, and no number. `evidence`: DICOM objects of the maps.
    """
    sr, codes_of = exam.import_extra("highdicom").sr, exam.import_extra("pydicom").sr.codedict.codes
    program = sr.DeviceObserverIdentifyingAttributes(
        uid=exam.content_uid("device", MODEL, __version__),
        name=MODEL,
        manufacturer_name=MANUFACTURER,
        model_name=f"{MODEL} {__version__}",
    )
    observer = sr.ObserverContext(observer_type=codes_of.DCM.Device, observer_identifying_attributes=program)
    report = sr.MeasurementReport(
        observation_context=sr.ObservationContext(observer_device_context=observer),
        procedure_reported=coded(exam.EXAM),
        imaging_measurements=[_group(estimate, mass, maps, evidence) for mass in estimate.masses],
        title=coded(exam.REPORT_TITLE),
    )
    digests = [f"SHA-256 of the estimate: {estimate.digest}", *(f"SHA-256 of a map: {one}" for one in estimate.maps)]
    for text in (RESEARCH_USE, estimate.verdict_line, *estimate.lines, *digests):
        report[0].ContentSequence.append(_comment(text))
    dataset = sr.Comprehensive3DSR(
        evidence=evidence,
        content=report[0],
        series_instance_uid=study.uid("series of reports"),
        series_number=3,
        sop_instance_uid=study.uid("report", estimate.digest, *sorted(one.digest for one in maps)),
        instance_number=1,
        manufacturer=MANUFACTURER,
        is_complete=True,
        is_final=False,
        is_verified=False,
        series_description=f"Size report. {RESEARCH_USE}",
    )
    add_study(dataset, study)
    declare_scheme(dataset)
    return dataset


def _group(
    estimate: exam.EstimateFile, finding: exam.ExportedMass, maps: Sequence[exam.MapFile], evidence: Sequence[Any]
) -> Any:
    """Measurement group of a mass, with its position in the patient where that is known."""
    sr = exam.import_extra("highdicom").sr
    content = {
        "tracking_identifier": sr.TrackingIdentifier(
            uid=exam.content_uid("mass", estimate.digest, str(finding.number)), identifier=f"mass {finding.number}"
        ),
        "finding_type": None if finding.largest is None else coded(exam.BREAST_LUMP),
        "method": coded(exam.METHOD),
        "algorithm_id": sr.AlgorithmIdentification(
            name=MODEL, version=estimate.version or __version__, parameters=[estimate.method_words]
        ),
        "finding_sites": _sites(maps),
        "measurements": list(_measurements(finding, evidence)),
        "qualitative_evaluations": [sr.QualitativeEvaluation(coded(exam.OUTCOME), coded(finding.outcome))],
    }
    region = _region(finding, maps)
    if region is None:
        group = sr.MeasurementsAndQualitativeEvaluations(**content)
    else:
        group = sr.PlanarROIMeasurementsAndQualitativeEvaluations(**content, referenced_region=region)
    for text in (finding.reason, finding.narrower):
        if text:
            group[0].ContentSequence.append(_comment(text))
    return group


def _sites(maps: Sequence[exam.MapFile]) -> list[Any] | None:
    """The breast with its side; None for a phantom or an unknown side."""
    sides = {one.facts.get("side") for one in maps}
    side = sides.pop() if len(sides) == 1 else None
    if side not in exam.SIDES:
        return None
    site = exam.import_extra("highdicom").sr.FindingSite
    return [site(anatomic_location=coded(exam.BREAST), laterality=coded(exam.SIDES[side]))]


def _region(finding: exam.ExportedMass, maps: Sequence[exam.MapFile]) -> Any | None:
    """The lump's centre as a point in the map's frame of reference; None for several maps or an unknown position."""
    transform = lps_of_map(maps[0]) if len(maps) == 1 else None
    if transform is None or finding.centre_mm is None:
        return None
    centre = exam.lps_point(transform, finding.centre_mm)
    return exam.import_extra("highdicom").sr.ImageRegion3D("POINT", np.array([centre]), frame_of_reference(maps[0]))


def _measurements(finding: exam.ExportedMass, evidence: Sequence[Any]) -> Iterator[Any]:
    """Sizes and certainty, with references to the maps' values, or to their pictures where no values are exported."""
    sr = exam.import_extra("highdicom").sr
    values = [one for one in evidence if one.SOPClassUID == PARAMETRIC_MAP]
    images = [sr.SourceImageForMeasurement(value.SOPClassUID, value.SOPInstanceUID) for value in values or evidence]
    for name, size in ((exam.LONG_AXIS, finding.largest), (exam.SHORT_AXIS, finding.smallest)):
        if size is not None:
            yield _sized(name, size, images)
    if finding.probability is not None:
        percent = float(f"{100 * finding.probability:.9g}")
        yield sr.Measurement(coded(exam.CERTAINTY), percent, coded(_PERCENT), referenced_images=images)


def _sized(name: exam.Code, size: Quantity, images: Sequence[Any]) -> Any:
    """A size's median, with its interval as properties of that measurement."""
    sr = exam.import_extra("highdicom").sr
    measurement = sr.Measurement(
        coded(name), size.median, coded(_MM), derivation=coded(exam.MEDIAN), referenced_images=images
    )
    for concept, value, unit in (
        (exam.UPPER_RANGE, size.high - size.median, _MM),
        (exam.LOWER_RANGE, size.median - size.low, _MM),
        (exam.INTERVAL_LOW, size.low, _MM),
        (exam.INTERVAL_HIGH, size.high, _MM),
        (exam.INTERVAL_PROBABILITY, 100 * size.probability, _PERCENT),
    ):
        number = sr.NumContentItem(
            name=coded(concept),
            value=float(f"{value:.9g}"),
            unit=coded(unit),
            relationship_type=sr.RelationshipTypeValues.HAS_PROPERTIES,
        )
        measurement[0].ContentSequence.append(number)
    return measurement


def _comment(text: str) -> Any:
    sr = exam.import_extra("highdicom").sr
    relation = sr.RelationshipTypeValues.CONTAINS
    return sr.TextContentItem(name=coded(exam.COMMENT), value=text, relationship_type=relation)


# --- An exam as DICOM files: each map's values and picture, and the report of the estimate.

VALUES: Final = "map"


def dicom_files(
    maps: Sequence[exam.MapFile], estimate: exam.EstimateFile | None, *, identity: exam.Identity
) -> dict[str, bytes]:
    """Bytes of the files by their names.

    A map whose position in the patient is unknown has a picture and no values: a Parametric Map must have a position.
    """
    exam.import_extra("highdicom")
    for one in maps:
        if not one.tactile_map.covered.any():
            raise BadDataError("holds no data", way_out="map a scan with frames in the window", path=str(one.path))
    study = make_study(identity, maps)
    numbered = [(f"_{i}" if len(maps) > 1 else "", i, one) for i, one in enumerate(maps, start=1)]
    objects = {
        f"{VALUES}{suffix}.dcm": parametric_map(one, transform, study=study, number=number)
        for suffix, number, one in numbered
        if (transform := lps_of_map(one)) is not None
    }
    for suffix, number, one in numbered:
        objects[f"picture{suffix}.dcm"] = secondary_capture(one, estimate, study=study, number=number)
    if estimate is not None:
        objects["report.dcm"] = structured_report(estimate, maps, evidence=list(objects.values()), study=study)
    return {name: dicom_bytes(dataset) for name, dataset in objects.items()}
