"""FHIR of an exam: sizes with their intervals read back equal, valid by fhir.resources and by HL7's R4 schema."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from export_files import exported

from tactile_bayes.declarations import as_dict, from_plain, replace
from tactile_bayes.exports.exam import Identity, masses_of, parse_estimate
from tactile_bayes.exports.fhir import bundle_of
from tactile_bayes.files.reports import EstimateReport, Place
from tactile_bayes.findings import finding

bundles = pytest.importorskip("fhir.resources.R4B.bundle")

WHO = (
    *("--patient-id", "P-77", "--patient-name", "Doe^Jane^<b>&", "--birth-date", "1970-02-03", "--sex", "F"),
    *("--accession", "A123", "--issuer", "Our hospital", "--study-date", "2026-11-24T10:30+01:00"),
)
R4_SCHEMA = os.environ.get("FHIR_R4_SCHEMA", "")
"""HL7's fhir.schema.json of R4 (4.0.1), which is 3 MB and not in this checkout."""


def bundle(exam: Path, output: Path, *words: object) -> dict[str, Any]:
    exported(exam, *words, "--to", "fhir", "-o", output)
    document: dict[str, Any] = json.loads(output.read_text(encoding="utf-8"))
    return document


def resources(document: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [one["resource"] for one in document["entry"] if one["resource"]["resourceType"] == kind]


@pytest.fixture(scope="module")
def sized(exam: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return bundle(exam, tmp_path_factory.mktemp("fhir") / "b.json", "map.json", *WHO)


def test_sizes_and_intervals_are_read_back_equal(sized: dict[str, Any], estimate: dict[str, Any]) -> None:
    read = bundles.Bundle.model_validate(sized)
    found = {
        one.resource.code.coding[0].code: one.resource for one in read.entry if "Observation" in str(type(one.resource))
    }
    for code, name in (("103339001", "max_size_mm"), ("103340004", "min_size_mm")):
        size, one = estimate["another_exam"][name], found[code]  # the interval that leads
        assert float(one.valueQuantity.value) == size["median"]
        assert (one.valueQuantity.system, one.valueQuantity.code) == ("http://unitsofmeasure.org", "mm")
        parts = {part.code.coding[0].code: float(part.valueQuantity.value) for part in one.component}
        wanted = {"interval-low": size["low"], "interval-high": size["high"]}
        assert parts == wanted | {"interval-prob": 100 * size["probability"]}
        (extension,) = one.valueQuantity.extension
        confidence, interval = extension.extension
        assert extension.url == "http://hl7.org/fhir/StructureDefinition/quantity-confidenceInterval"
        assert float(confidence.valueDecimal) == 100 * size["probability"]
        ends = interval.valueRange
        assert (float(ends.low.value), float(ends.high.value)) == (size["low"], size["high"])
        assert one.bodySite.coding[0].code == "80248007", "left breast"
        assert one.status == "preliminary"


def test_patient_and_order_are_those_of_the_worklist(sized: dict[str, Any]) -> None:
    (patient,) = resources(sized, "Patient")
    assert patient["identifier"] == [{"value": "P-77", "assigner": {"display": "Our hospital"}}]
    assert patient["name"] == [{"family": "Doe", "given": ["Jane", "<b>&"]}]
    assert (patient["gender"], patient["birthDate"]) == ("female", "1970-02-03")
    (report,) = resources(sized, "DiagnosticReport")
    assert report["effectiveDateTime"] == "2026-11-24T10:30:00+01:00"
    assert report["basedOn"][0]["identifier"]["value"] == "A123"
    observed = resources(sized, "Observation")
    assert [one["reference"] for one in report["result"]] == [f"urn:uuid:{one['id']}" for one in observed]
    assert {one["subject"]["reference"] for one in (*observed, report)} == {f"urn:uuid:{patient['id']}"}
    assert "Research use only" in report["conclusion"]
    assert "95 % credible interval" in report["conclusion"]


def test_no_patient_is_written_where_none_was_named(exam: Path, tmp_path: Path) -> None:
    document = bundle(exam, tmp_path / "b.json", "map.json")
    assert resources(document, "Patient") == []
    text = json.dumps(document)
    assert "subject" not in text
    assert "S01" not in text
    assert "effective" not in text
    told = bundle(exam, tmp_path / "c.json", "map.json", "--patient-id-from-scan")
    assert resources(told, "Patient")[0]["identifier"] == [{"value": "S01"}]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("^", None),
        ("=山田^太郎", {"family": "山田", "given": ["太郎"]}),
        ("Doe^J^M^Dr^II", None),
        ("^Jane", {"given": ["Jane"]}),
    ],
)
def test_names_of_dicom(name: str, wanted: dict[str, Any] | None, exam: Path, tmp_path: Path) -> None:
    words = ("map.json", "--patient-id", "1", "--patient-name", name)
    (patient,) = resources(bundle(exam, tmp_path / "b.json", *words), "Patient")
    if name.startswith("Doe"):
        wanted = {"family": "Doe", "given": ["J", "M"], "prefix": ["Dr"], "suffix": ["II"]}
    assert patient.get("name") == (None if wanted is None else [wanted])


def test_no_lump_is_an_absent_value_with_the_reason(exam: Path, tmp_path: Path) -> None:
    document = bundle(exam, tmp_path / "b.json", "empty.json")
    reason = json.loads((exam / "empty.json").read_text())["reason"]
    sizes = [one for one in resources(document, "Observation") if one["code"]["coding"][0]["code"].startswith("10334")]
    for one in [*sizes, resources(document, "Observation")[0]]:
        assert "valueQuantity" not in one
        assert "component" not in one
        assert one["dataAbsentReason"]["text"] == reason
        assert one["dataAbsentReason"]["coding"][0]["code"] == "not-applicable"
    (report,) = resources(document, "DiagnosticReport")
    assert report["conclusionCode"][0]["coding"][0]["code"] == "no-lump-shown"


def test_cells_too_large_are_no_verdict_on_the_breast(exam: Path, tmp_path: Path) -> None:
    """The control is `test_no_lump_is_an_absent_value_with_the_reason`."""
    coarse = json.loads((exam / "empty.json").read_text()) | {"reason_code": "cannot_show"}
    (exam / "coarse.json").write_text(json.dumps(coarse))
    (report,) = resources(bundle(exam, tmp_path / "b.json", "coarse.json"), "DiagnosticReport")
    assert report["conclusionCode"][0]["coding"][0]["code"] == "no-verdict"


def test_markup_in_words_stays_words(estimate: dict[str, Any], tmp_path: Path) -> None:
    hostile = estimate | {
        "verdict": "doubtful",
        "findings": [as_dict(finding("side", "<script>alert(1)</script>"))],
    }
    (tmp_path / "h.json").write_text(json.dumps(hostile))
    (report,) = resources(bundle(tmp_path, tmp_path / "b.json", "h.json"), "DiagnosticReport")
    assert "&lt;script&gt;" in report["text"]["div"]
    assert "<script" not in report["text"]["div"]
    assert "CAUTION: <script>alert(1)</script>" in report["conclusion"]


def test_every_mass_of_an_estimate_has_its_observations(estimate: dict[str, Any]) -> None:
    """By the list of masses in newer estimates: places are plain numbers there."""
    report = from_plain(EstimateReport, estimate)
    place = Place(1.0, 2.0)
    first = replace(report.masses[0], centre_mm=place, centre_patient_mm=place)
    nothing = dict.fromkeys(("max_size_mm", "min_size_mm", "another_exam", "centre_patient_mm"))
    second = replace(first, number=2, reason="too near the rim", reason_code="window", **nothing)
    found = masses_of(replace(report, masses=(first, second)))
    assert [mass.number for mass in found] == [1, 2]
    assert found[0].centre_patient_mm == (1.0, 2.0)
    assert [mass.outcome.value for mass in found] == ["sized", "not-sized"]
    assert found[1].reason == "too near the rim"
    both = bundle_of(replace(parse_estimate(estimate, Path("e.json")), masses=found), Identity())
    (told,) = resources(both, "DiagnosticReport")
    where = "1 mm to the patient's right of the xiphoid and 2 mm above it"
    assert f" mm, {where}. Mass 1: Smallest size " in told["conclusion"]
    assert {"text": f"Mass 1 of 2, {where}"} in resources(both, "Observation")[0]["note"]
    gone = {"status": "no_estimate", "reason": "no lump found near (9, 9) mm", "reason_code": "undetected"}
    empty = replace(report, **gone, **nothing, masses=(replace(first, reported=False),))
    (place_alone,) = masses_of(empty)
    assert (place_alone.outcome.value, place_alone.largest) == ("no-lump-shown", None)
    assert place_alone.reason == "no lump found near (9, 9) mm; the map shows 1 mass elsewhere"


@pytest.mark.skipif(not R4_SCHEMA, reason="FHIR_R4_SCHEMA does not name HL7's fhir.schema.json")
@pytest.mark.parametrize("words", [("map.json", *WHO), ("empty.json",), ("map_post.nc",), ("phantom.json",)])
def test_hl7s_r4_schema_takes_it(words: tuple[str, ...], exam: Path, tmp_path: Path) -> None:
    import fastjsonschema

    schema = json.loads(Path(R4_SCHEMA).read_text(encoding="utf-8"))
    assert re.search(r"/4\.0", schema["id"])
    kinds = ("Patient", "Device", "Observation", "DiagnosticReport")  # all 148 would take gigabytes to compile
    schema["definitions"]["ResourceList"] = {"oneOf": [{"$ref": f"#/definitions/{kind}"} for kind in kinds]}
    rules = {"$schema": schema["$schema"], "definitions": schema["definitions"], "$ref": "#/definitions/Bundle"}
    check = fastjsonschema.compile(rules)
    document = bundle(exam, tmp_path / "b.json", *words)
    check(document)
    resources(document, "Observation")[0]["status"] = "guessed"
    with pytest.raises(fastjsonschema.JsonSchemaException):
        check(document)
