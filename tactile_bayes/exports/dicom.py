"""An exam as DICOM files: each map's values and picture, and the report of the estimate."""

from __future__ import annotations

from collections.abc import Sequence

from tactile_bayes.errors import BadDataError
from tactile_bayes.exports.dicom_file import dicom_bytes, study_of
from tactile_bayes.exports.dicom_map import frame_of_reference, parametric_map
from tactile_bayes.exports.dicom_picture import secondary_capture
from tactile_bayes.exports.dicom_report import structured_report
from tactile_bayes.exports.exam import EstimateFile, MapFile
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.identity import Identity

VALUES, PICTURE, REPORT = "map", "picture", "report"


def dicom_names(maps: int, *, estimated: bool) -> list[str]:
    """File names that an export may write."""
    numbers = [""] if maps == 1 else [f"_{i}" for i in range(1, maps + 1)]
    names = [f"{stem}{number}.dcm" for stem in (VALUES, PICTURE) for number in numbers]
    return [*names, *([f"{REPORT}.dcm"] if estimated else [])]


def dicom_files(maps: Sequence[MapFile], estimate: EstimateFile | None, *, identity: Identity) -> dict[str, bytes]:
    """Bytes of the files by their names.

    Maps whose place in the patient is not known have a picture and no values: a Parametric Map must have a place.

    Raises
    ------
    BadDataError
        When a map holds no data.
    UsageError
        When the date and time of the exam are not given, or the extra is not installed.
    """
    required("highdicom")
    for one in maps:
        if not one.tactile_map.covered.any():
            raise BadDataError("holds no data", way_out="map a scan with frames in the window", path=str(one.path))
    study = study_of(identity, maps)
    names = iter(dicom_names(len(maps), estimated=estimate is not None))
    objects = {}
    for number, one in enumerate(maps, start=1):
        name = next(names)
        if frame_of_reference(one) is not None:
            objects[name] = parametric_map(one, study=study, number=number)
    for number, one in enumerate(maps, start=1):
        objects[next(names)] = secondary_capture(one, estimate, study=study, number=number)
    if estimate is not None:
        objects[next(names)] = structured_report(estimate, maps, evidence=list(objects.values()), study=study)
    return {name: dicom_bytes(dataset) for name, dataset in objects.items()}
