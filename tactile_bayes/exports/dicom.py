"""DICOM of an exam: maps and a structured report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from tactile_bayes import __version__
from tactile_bayes.errors import BadDataError
from tactile_bayes.exports import exam as codes
from tactile_bayes.exports.exam import (
    Code,
    EstimateFile,
    Identity,
    MapFile,
    SizedMass,
    content_uid,
    required,
    verdict_words,
)
from tactile_bayes.exports.images import (
    MANUFACTURER,
    MODEL,
    PARAMETRIC_MAP,
    Study,
    add_study,
    coded,
    declare_scheme,
    dicom_bytes,
    frame_of_reference,
    lps_from_plane,
    on_plane,
    parametric_map,
    secondary_capture,
    study_of,
)
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE

# --- An estimate as a DICOM Comprehensive 3D SR by TID 1500: one measurement group per mass.

SERIES: Final = 3
_MM: Final = Code("mm", "UCUM", "millimeter")
_PERCENT: Final = Code("%", "UCUM", "percent")


def structured_report(estimate: EstimateFile, maps: Sequence[MapFile], *, evidence: Sequence[Any], study: Study) -> Any:
    """The estimate as a structured report, preliminary and unverified.

    A size is the median; the ends of its interval, with its probability, are properties of that measurement. A mass
    without a size is a group with a finding and the reason, and no number.

    `maps`: that the estimate was made from; `evidence`: the DICOM objects of the maps.
    """
    sr = required("highdicom").sr
    report = sr.MeasurementReport(
        observation_context=_observer(),
        procedure_reported=coded(codes.EXAM),
        imaging_measurements=[_group(estimate, one, maps, evidence) for one in estimate.masses],
        title=coded(codes.REPORT_TITLE),
    )
    digests = [f"SHA-256 of the estimate: {estimate.digest}", *(f"SHA-256 of a map: {one}" for one in estimate.maps)]
    for text in (RESEARCH_USE, verdict_words(estimate), *estimate.lines, *digests):
        report[0].ContentSequence.append(_comment(text))
    dataset = sr.Comprehensive3DSR(
        evidence=evidence,
        content=report[0],
        series_instance_uid=study.uid("series of reports"),
        series_number=SERIES,
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


def _observer() -> Any:
    """The program as the observer."""
    sr, codes_of = required("highdicom").sr, required("pydicom").sr.codedict.codes
    device = sr.DeviceObserverIdentifyingAttributes(
        uid=content_uid("device", MODEL, __version__),
        name=MODEL,
        manufacturer_name=MANUFACTURER,
        model_name=f"{MODEL} {__version__}",
    )
    context = sr.ObserverContext(observer_type=codes_of.DCM.Device, observer_identifying_attributes=device)
    return sr.ObservationContext(observer_device_context=context)


def _group(estimate: EstimateFile, finding: SizedMass, maps: Sequence[MapFile], evidence: Sequence[Any]) -> Any:
    """Measurement group of a mass, at its place in the patient where that is known."""
    sr = required("highdicom").sr
    what = {
        "tracking_identifier": sr.TrackingIdentifier(
            uid=content_uid("mass", estimate.digest, str(finding.number)), identifier=f"mass {finding.number}"
        ),
        "finding_type": None if finding.largest is None else coded(codes.BREAST_LUMP),
        "method": coded(codes.METHOD),
        "algorithm_id": sr.AlgorithmIdentification(
            name=MODEL, version=estimate.version or __version__, parameters=[estimate.method_words]
        ),
        "finding_sites": _sites(estimate, maps),
        "measurements": list(_measurements(finding, evidence)),
        "qualitative_evaluations": [sr.QualitativeEvaluation(coded(codes.OUTCOME), coded(finding.outcome))],
    }
    region = _region(finding, maps)
    if region is None:
        group = sr.MeasurementsAndQualitativeEvaluations(**what)
    else:
        group = sr.PlanarROIMeasurementsAndQualitativeEvaluations(**what, referenced_region=region)
    for text in (finding.reason, finding.alike_exams):
        if text:
            group[0].ContentSequence.append(_comment(text))
    return group


def _sites(estimate: EstimateFile, maps: Sequence[MapFile]) -> list[Any] | None:
    """The breast with its side; None for a phantom or an unknown side."""
    said = {one.facts.get("side") for one in maps} or {estimate.facts.get("side")}
    side = said.pop() if len(said) == 1 else None
    if side not in codes.SIDES:
        return None
    site = required("highdicom").sr.FindingSite
    return [site(anatomic_location=coded(codes.BREAST), laterality=coded(codes.SIDES[side]))]


def _region(finding: SizedMass, maps: Sequence[MapFile]) -> Any | None:
    """The lump's centre as a point in the map's frame of reference; of one map whose place is known."""
    if len(maps) != 1 or finding.centre_mm is None:
        return None
    reference, transform = frame_of_reference(maps[0]), lps_from_plane(maps[0].tactile_map)
    if reference is None or transform is None:
        return None
    centre = on_plane(transform, finding.centre_mm)
    return required("highdicom").sr.ImageRegion3D("POINT", np.array([centre]), reference)


def _measurements(finding: SizedMass, evidence: Sequence[Any]) -> Iterator[Any]:
    """Sizes and certainty, with references to the maps' values, or to their pictures where there are no values."""
    sr = required("highdicom").sr
    values = [one for one in evidence if one.SOPClassUID == PARAMETRIC_MAP]
    images = [sr.SourceImageForMeasurement(one.SOPClassUID, one.SOPInstanceUID) for one in values or evidence]
    for name, size in ((codes.LONG_AXIS, finding.largest), (codes.SHORT_AXIS, finding.smallest)):
        if size is not None:
            yield _size(name, size, images)
    if finding.probability is not None:
        percent = float(f"{100 * finding.probability:.9g}")
        yield sr.Measurement(coded(codes.CERTAINTY), percent, coded(_PERCENT), referenced_images=images)


def _size(name: Code, size: Quantity, images: Sequence[Any]) -> Any:
    """A size's median, with its interval as properties of the number."""
    sr = required("highdicom").sr
    measurement = sr.Measurement(
        coded(name), size.median, coded(_MM), derivation=coded(codes.MEDIAN), referenced_images=images
    )
    for concept, value, unit in (
        (codes.UPPER_RANGE, size.high - size.median, _MM),
        (codes.LOWER_RANGE, size.median - size.low, _MM),
        (codes.INTERVAL_LOW, size.low, _MM),
        (codes.INTERVAL_HIGH, size.high, _MM),
        (codes.INTERVAL_PROBABILITY, 100 * size.probability, _PERCENT),
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
    sr = required("highdicom").sr
    relation = sr.RelationshipTypeValues.CONTAINS
    return sr.TextContentItem(name=coded(codes.COMMENT), value=text, relationship_type=relation)


# --- An exam as DICOM files: each map's values and picture, and the report of the estimate.

VALUES, PICTURE, REPORT = "map", "picture", "report"


def dicom_files(maps: Sequence[MapFile], estimate: EstimateFile | None, *, identity: Identity) -> dict[str, bytes]:
    """Bytes of the files by their names.

    Maps whose place in the patient is not known have a picture and no values: a Parametric Map must have a place.
    """
    required("highdicom")
    for one in maps:
        if not one.tactile_map.covered.any():
            raise BadDataError("holds no data", way_out="map a scan with frames in the window", path=str(one.path))
    study = study_of(identity, maps)
    numbered = [(f"_{i}" if len(maps) > 1 else "", i, one) for i, one in enumerate(maps, start=1)]
    objects = {
        f"{VALUES}{suffix}.dcm": parametric_map(one, study=study, number=number)
        for suffix, number, one in numbered
        if frame_of_reference(one) is not None
    }
    for suffix, number, one in numbered:
        objects[f"{PICTURE}{suffix}.dcm"] = secondary_capture(one, estimate, study=study, number=number)
    if estimate is not None:
        evidence = list(objects.values())
        objects[f"{REPORT}.dcm"] = structured_report(estimate, maps, evidence=evidence, study=study)
    return {name: dicom_bytes(dataset) for name, dataset in objects.items()}
