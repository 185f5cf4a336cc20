"""A map as a DICOM Parametric Map: float values, with their place in the patient where it is known."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from tactile_bayes.exports.codes import BREAST, PRESSURE, RELATIVE_PRESSURE
from tactile_bayes.exports.dicom_file import Study, add_study, coded, declare_scheme, item, laterality
from tactile_bayes.exports.exam import MapFile
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.place import ImagePlane, image_plane, lps_from_plane
from tactile_bayes.exports.uids import content_uid
from tactile_bayes.findings import finding_lines
from tactile_bayes.presets import RESEARCH_USE

PARAMETRIC_MAP: Final = "1.2.840.10008.5.1.4.1.1.30"
SERIES: Final = 1
POSTURES: Final = ("supine", "oblique", "sitting")
"""Of a person; a phantom has no patient's coordinates."""
_IMAGE_TYPE: Final = ["DERIVED", "PRIMARY", "VOLUME", "QUANTITY"]


def frame_of_reference(source: MapFile) -> str | None:
    """Identifier of the map's own coordinates in the patient; None where they are not known.

    They are known with landmarks, in a posture of a person. They are the map's own: no other image shares them, not
    even another map of the exam, because the third axis follows the normal of the scanned skin.
    """
    if source.tactile_map.patient_from_plane is None or source.facts.get("posture") not in POSTURES:
        return None
    return content_uid("frame of reference", source.digest)


def parametric_map(source: MapFile, *, study: Study, number: int) -> Any:
    """The map's means as a Parametric Map of one frame that faces the viewer as the program's pictures do.

    Cells without data are NaN, which is also the padding value. A Parametric Map must lie in a frame of reference, so a
    map without a place in the patient cannot be one.

    Parameters
    ----------
    number
        Of the instance in its series, from 1.

    Raises
    ------
    ValueError
        When the map's place in the patient is not known, see `frame_of_reference`.
    """
    reference = frame_of_reference(source)
    transform = lps_from_plane(source.tactile_map)
    if reference is None or transform is None:
        raise ValueError("the map's place in the patient is not known")
    plane = image_plane(source.tactile_map, transform)
    dataset = required("pydicom").Dataset()
    add_study(dataset, study, source.facts)
    if dataset.Laterality:
        del dataset.Laterality  # the frame has it, and it must not be said twice
    declare_scheme(dataset)
    dataset.SOPClassUID = PARAMETRIC_MAP
    dataset.SOPInstanceUID = study.uid("parametric map", source.digest)
    dataset.Modality = "OT"
    dataset.SeriesInstanceUID = study.uid("series of parametric maps")
    dataset.SeriesNumber, dataset.InstanceNumber = SERIES, number
    dataset.SeriesDescription = f"Tactile map. {RESEARCH_USE}"
    dataset.FrameOfReferenceUID = reference
    dataset.PositionReferenceIndicator = "XIPHOID"
    _add_pixels(dataset, plane)
    _add_content(dataset, source)
    _add_dimension(dataset, study, source)
    dataset.SharedFunctionalGroupsSequence = [_shared_groups(source, plane)]
    dataset.PerFrameFunctionalGroupsSequence = [_frame_groups(plane)]
    return dataset


def _add_pixels(dataset: Any, plane: ImagePlane) -> None:
    values = plane.values.astype("<f4")
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    dataset.NumberOfFrames = 1
    dataset.Rows, dataset.Columns = values.shape
    dataset.BitsAllocated = 32
    dataset.FloatPixelPaddingValue = dataset.FloatPixelPaddingRangeLimit = float("nan")
    dataset.FloatPixelData = values.tobytes()


def _add_content(dataset: Any, source: MapFile) -> None:
    dataset.ImageType = _IMAGE_TYPE
    dataset.ContentLabel = "TACTILE_MAP"
    dataset.ContentDescription = source.tactile_map.recipe.value_words[:64]
    dataset.ContentCreatorName = ""
    dataset.ContentQualification = "RESEARCH"
    dataset.BurnedInAnnotation = "NO"
    dataset.RecognizableVisualFeatures = "NO"
    dataset.LossyImageCompression = "00"
    dataset.PresentationLUTShape = "IDENTITY"
    dataset.AcquisitionContextSequence = []
    told = [RESEARCH_USE, *finding_lines(source.tactile_map.findings, paper=True)]
    dataset.ImageComments = f"{' '.join(told)} SHA-256 of the map: {source.digest}"


def _add_dimension(dataset: Any, study: Study, source: MapFile) -> None:
    """One dimension, the place in a stack of one frame."""
    pydicom = required("pydicom")
    organization = study.uid("dimension", source.digest)
    dataset.DimensionOrganizationSequence = [item(DimensionOrganizationUID=organization)]
    dataset.DimensionIndexSequence = [
        item(
            DimensionOrganizationUID=organization,
            DimensionIndexPointer=pydicom.tag.Tag("InStackPositionNumber"),
            FunctionalGroupPointer=pydicom.tag.Tag("FrameContentSequence"),
        )
    ]


def _shared_groups(source: MapFile, plane: ImagePlane) -> Any:
    highdicom = required("highdicom")
    cell = source.tactile_map.recipe.cell_mm
    cosines = [_cosine(value) for value in (*plane.row_direction, *plane.column_direction)]
    groups = item(
        PixelMeasuresSequence=highdicom.PixelMeasuresSequence((cell, cell), cell),
        RealWorldValueMappingSequence=[_value_mapping(source)],
        ParametricMapFrameTypeSequence=[item(FrameType=_IMAGE_TYPE)],
        PixelValueTransformationSequence=[item(RescaleIntercept=0, RescaleSlope=1, RescaleType="US")],
        FrameVOILUTSequence=[_window(plane)],
        PlaneOrientationSequence=[item(ImageOrientationPatient=cosines)],
    )
    side = laterality(source.facts)
    if side:
        region = item(CodeValue=BREAST.value, CodingSchemeDesignator=BREAST.scheme, CodeMeaning=BREAST.meaning)
        groups.FrameAnatomySequence = [item(FrameLaterality=side, AnatomicRegionSequence=[region])]
    return groups


def _frame_groups(plane: ImagePlane) -> Any:
    content = item(StackID="1", InStackPositionNumber=1, DimensionIndexValues=[1])
    position = item(ImagePositionPatient=[_decimal(value) for value in plane.corner_mm])
    return item(FrameContentSequence=[content], PlanePositionSequence=[position])


def _value_mapping(source: MapFile) -> Any:
    """What the stored values are: themselves, in the map's unit."""
    highdicom, pydicom = required("highdicom"), required("pydicom")
    recipe, values = source.tactile_map.recipe, source.tactile_map.mean[source.tactile_map.covered]
    relative = recipe.value_unit == "1"
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
        quantity_definition=coded(RELATIVE_PRESSURE if relative else PRESSURE) if recipe.source == "scan" else None,
    )


def _window(plane: ImagePlane) -> Any:
    """Window over all values."""
    low, high = float(np.nanmin(plane.values)), float(np.nanmax(plane.values))
    width = max(high - low, 1e-6)
    return item(WindowCenter=_decimal((low + high) / 2), WindowWidth=_decimal(width), VOILUTFunction="LINEAR_EXACT")


def _decimal(value: float) -> str:
    """A number as DICOM's decimal string of at most 16 characters."""
    for digits in range(12, 5, -1):
        text = f"{value + 0.0:.{digits}g}"
        if len(text) <= 16:
            return text
    return f"{value:.5g}"


def _cosine(value: float) -> str:
    """A direction cosine; what is rounding of zero is zero."""
    return _decimal(0.0 if abs(value) < 1e-12 else value)
