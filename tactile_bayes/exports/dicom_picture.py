"""The map's figure as a DICOM Secondary Capture, which every viewer shows."""

from __future__ import annotations

from typing import Any, Final

from tactile_bayes.exports.dicom_file import EXPLICIT_LITTLE_ENDIAN, MANUFACTURER, Study, add_study
from tactile_bayes.exports.exam import EstimateFile, MapFile
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.picture import map_picture
from tactile_bayes.presets import RESEARCH_USE

SERIES: Final = 2


def secondary_capture(source: MapFile, estimate: EstimateFile | None, *, study: Study, number: int) -> Any:
    """The figure as a Secondary Capture in red, green and blue.

    Parameters
    ----------
    number
        Of the instance in its series, from 1.
    """
    highdicom = required("highdicom")
    digest = "" if estimate is None else estimate.digest
    dataset = highdicom.sc.SCImage(
        pixel_array=map_picture(source, estimate),
        photometric_interpretation="RGB",
        bits_allocated=8,
        coordinate_system="PATIENT",
        patient_orientation=("L", "F"),
        study_instance_uid=study.study_uid,
        series_instance_uid=study.uid("series of pictures"),
        series_number=SERIES,
        sop_instance_uid=study.uid("picture", source.digest, digest),
        instance_number=number,
        manufacturer=MANUFACTURER,
        transfer_syntax_uid=EXPLICIT_LITTLE_ENDIAN,
        series_description=f"Map figure. {RESEARCH_USE}",
        content_date=study.content.date,
        content_time=study.content.time,
    )
    add_study(dataset, study, source.facts)
    if source.tactile_map.patient_from_plane is None:
        dataset.PatientOrientation = ""
    dataset.BurnedInAnnotation = "NO"  # nothing in it says who the patient is, nor when the exam was
    dataset.RecognizableVisualFeatures = "NO"
    dataset.ImageComments = f"{RESEARCH_USE} SHA-256 of the map: {source.digest}"
    return dataset
