"""An estimate as a FHIR R4 Bundle: a DiagnosticReport with an Observation for each size of each mass."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any, Final

from tactile_bayes import __version__
from tactile_bayes.errors import BadDataError, one_line
from tactile_bayes.exports import exam
from tactile_bayes.files.documents import dump_json
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE

UCUM: Final = "http://unitsofmeasure.org"
CONFIDENCE_INTERVAL: Final = "http://hl7.org/fhir/StructureDefinition/quantity-confidenceInterval"
ABSENT: Final = "http://terminology.hl7.org/CodeSystem/data-absent-reason"
_CATEGORY: Final = "http://terminology.hl7.org/CodeSystem/observation-category"
_GENDERS: Final = {"F": "female", "M": "male", "O": "other"}
_IDENTIFIERS: Final = "http://terminology.hl7.org/CodeSystem/v2-0203"


def bundle_json(estimate: exam.EstimateFile, identity: exam.Identity) -> str:
    """The Bundle as JSON, checked by the models of fhir.resources."""
    bundle = bundle_of(estimate, identity)
    # R4B has all resources used here as R4 has them; the package's R4 ended with its version 6
    models = exam.import_extra("fhir.resources.R4B.bundle")
    try:
        models.Bundle.model_validate(bundle)
    except ValueError as error:
        raise BadDataError(f"cannot be written as FHIR: {one_line(error)}", path=str(estimate.path)) from None
    return dump_json(bundle)


def bundle_of(estimate: exam.EstimateFile, identity: exam.Identity) -> dict[str, Any]:
    """The Bundle as plain data: patient (if any is named), device, observations, report."""
    parts = _Resources(estimate, identity)
    observations = [observation for finding in estimate.masses for observation in parts.observations(finding)]
    patient = [parts.patient()] if parts.patient_url else []
    resources = [*patient, parts.device(), *observations, parts.report(observations)]
    entries = [{"fullUrl": f"urn:uuid:{resource['id']}", "resource": resource} for resource in resources]
    identifier = {"system": "urn:ietf:rfc:3986", "value": parts.url("bundle")}
    head = {"resourceType": "Bundle", "id": parts.id("bundle"), "identifier": identifier, "type": "collection"}
    return {**head, "entry": entries}


class _Resources:
    """One estimate of one patient, whose resources refer to each other by identifiers from their content."""

    def __init__(self, estimate: exam.EstimateFile, identity: exam.Identity) -> None:
        self.estimate, self.identity = estimate, identity
        self.key = (__version__, estimate.digest, *(f"{k}={v}" for k, v in sorted(identity.given.items())))
        person = {"patient_id", "issuer", "patient_name", "birth_date", "sex"}
        self.patient_url = self.url("patient") if person & identity.given.keys() else ""

    def id(self, role: str) -> str:
        """Logical identifier of a resource."""
        return str(exam.content_uuid(role, *self.key))

    def url(self, role: str) -> str:
        """Reference to a resource of the bundle."""
        return f"urn:uuid:{self.id(role)}"

    def patient(self) -> dict[str, Any]:
        identity = self.identity
        resource: dict[str, Any] = {"resourceType": "Patient", "id": self.id("patient")}
        if identity.patient_id:
            issuer = {"assigner": {"display": identity.issuer}} if identity.issuer else {}
            resource["identifier"] = [{"value": identity.patient_id} | issuer]
        if name := _human_name(identity.patient_name):
            resource["name"] = [name]
        if identity.sex:
            resource["gender"] = _GENDERS[identity.sex]
        if identity.birth_date:
            resource["birthDate"] = identity.birth_date
        return resource

    def device(self) -> dict[str, Any]:
        return {
            "resourceType": "Device",
            "id": self.id("device"),
            "deviceName": [{"name": "tactile-bayes", "type": "model-name"}],
            "version": [{"value": __version__}],
            "note": [{"text": RESEARCH_USE}],
        }

    def _common(self) -> dict[str, Any]:
        """Fields that the report and the observations share."""
        fields: dict[str, Any] = {"status": "preliminary"}  # nobody has verified the program's result
        if self.patient_url:
            fields["subject"] = {"reference": self.patient_url}
        if self.identity.study:
            fields["effectiveDateTime"] = self.identity.study.fhir
        return fields

    def observations(self, finding: exam.ExportedMass) -> Iterator[dict[str, Any]]:
        """Largest and smallest size of a mass, and the probability of a lump."""
        n = finding.number
        sizes = (("largest", exam.LONG_AXIS, finding.largest), ("smallest", exam.SHORT_AXIS, finding.smallest))
        for word, code, size in sizes:
            text = f"{word.capitalize()} size of the lump"
            value = _size(size) if size is not None else _absent(finding)
            yield self._observation(f"{word} {n}", _concept(code, text=text), finding) | value
        if finding.probability is not None:
            percent = _quantity(float(f"{100 * finding.probability:.9g}"), "%", "%")
            concept = _concept(exam.CERTAINTY, text="Probability of a lump")
            yield self._observation(f"probability {n}", concept, finding) | {"valueQuantity": percent}

    def _observation(self, role: str, code: dict[str, Any], finding: exam.ExportedMass) -> dict[str, Any]:
        site = exam.BREASTS.get(self.estimate.facts.get("side", ""))
        notes = [RESEARCH_USE, self.estimate.verdict_line, *self.estimate.lines]
        notes += [finding.narrower] if finding.narrower else []
        if len(self.estimate.masses) > 1:
            place = f", {finding.place}" if finding.place else ""
            notes.append(f"Mass {finding.number} of {len(self.estimate.masses)}{place}")
        return {
            "resourceType": "Observation",
            "id": self.id(role),
            **self._common(),
            "category": [{"coding": [{"system": _CATEGORY, "code": "imaging", "display": "Imaging"}]}],
            "code": code,
            **({"bodySite": _concept(site)} if site else {}),
            "method": _concept(exam.METHOD, text=self.estimate.method_words),
            "device": {"reference": self.url("device")},
            "note": [{"text": text} for text in notes],
        }

    def report(self, observations: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """The report, with its text for people."""
        lines = list(_lines(self.estimate))
        number = self.identity.accession
        kind = {"system": _IDENTIFIERS, "code": "ACSN", "display": "Accession ID"}
        order = {"identifier": {"type": {"coding": [kind]}, "value": number}}
        division = "".join(f"<p>{escape(line)}</p>" for line in lines)
        return {
            "resourceType": "DiagnosticReport",
            "id": self.id("report"),
            "text": {"status": "generated", "div": f'<div xmlns="http://www.w3.org/1999/xhtml">{division}</div>'},
            "identifier": [{"system": "urn:ietf:rfc:3986", "value": self.url("report")}],
            **({"basedOn": [order]} if number else {}),
            **self._common(),
            "code": _concept(exam.EXAM),
            "result": [{"reference": f"urn:uuid:{observation['id']}"} for observation in observations],
            "conclusion": " ".join(lines),
            "conclusionCode": [_concept(mass.outcome) for mass in self.estimate.masses],
        }


def _lines(estimate: exam.EstimateFile) -> Iterator[str]:
    """Sentences of the report: verdict, findings, then the masses."""
    yield estimate.verdict_line
    yield from estimate.lines
    several = len(estimate.masses) > 1
    for one in estimate.masses:
        mass = f"Mass {one.number}: " if several else ""
        place = f", {one.place}" if several and one.place else ""
        if one.largest is None or one.smallest is None:
            yield f"{mass}{one.outcome.meaning}{place}. Reason: {one.reason or one.code}."
            continue
        yield f"{mass}Largest size {exam.size_words(one.largest)}{place}."
        yield f"{mass}Smallest size {exam.size_words(one.smallest)}."
        if one.narrower:
            yield f"{mass}{one.narrower}."
    yield RESEARCH_USE


def _concept(code: exam.Code, *, text: str = "") -> dict[str, Any]:
    coding = {"system": exam.FHIR_SYSTEMS[code.scheme], "code": code.value, "display": code.meaning}
    return {"coding": [coding], "text": text or code.meaning}


def _quantity(value: float, unit: str, code: str) -> dict[str, Any]:
    return {"value": value, "unit": unit, "system": UCUM, "code": code}


def _size(size: Quantity) -> dict[str, Any]:
    """The median as the value, with its interval by HL7's extension and, for readers without it, as components."""
    low, high = (_quantity(end, "mm", "mm") for end in (size.low, size.high))
    percent = float(f"{100 * size.probability:.9g}")
    parts = [
        {"url": "confidence", "valueDecimal": percent},
        {"url": "interval", "valueRange": {"low": low, "high": high}},
    ]
    extension = [{"url": CONFIDENCE_INTERVAL, "extension": parts}]
    probability = _quantity(percent, "%", "%")
    components = ((exam.INTERVAL_LOW, low), (exam.INTERVAL_HIGH, high), (exam.INTERVAL_PROBABILITY, probability))
    return {
        "valueQuantity": {"extension": extension, **_quantity(size.median, "mm", "mm")},
        "component": [{"code": _concept(code), "valueQuantity": value} for code, value in components],
    }


def _absent(finding: exam.ExportedMass) -> dict[str, Any]:
    """FHIR's reason for an absent value."""
    unknown = finding.outcome is not exam.NOT_DETECTED
    code = ("unknown", "Unknown") if unknown else ("not-applicable", "Not Applicable")
    coding = {"system": ABSENT, "code": code[0], "display": code[1]}
    return {"dataAbsentReason": {"coding": [coding], "text": finding.reason or finding.outcome.meaning}}


def _human_name(name: str) -> dict[str, Any]:
    """FHIR's form of a DICOM name, FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX, from its first group that is not empty."""
    group = next((one for one in name.split("=") if one.strip("^ ")), "")
    family, given, middle, prefix, suffix = (*group.split("^"), "", "", "", "", "")[:5]
    human_name: dict[str, Any] = {"family": family} if family else {}
    for key, parts in (("given", (given, middle)), ("prefix", (prefix,)), ("suffix", (suffix,))):
        if any(parts):
            human_name[key] = [word for word in parts if word]
    return human_name
