"""An estimate as plain data: the object that `estimate --json` prints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import verdict
from tactile_bayes.inference.summary import Quantity, nine_digits
from tactile_bayes.mapping.clock_face import ClockPosition
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.masses_document import masses_document
from tactile_bayes.report.quantities import ANOTHER_EXAM, WIDTHS, another_exam, estimate_quantities
from tactile_bayes.report.scene_text import scene_document
from tactile_bayes.report.supposed_text import supposed_document
from tactile_bayes.report.touching import touching_masses
from tactile_bayes.size.draws import SIZES, SizePosterior

SCHEMA = "tactile-bayes/estimate/1"


def estimate_document(
    estimate: Estimate,
    tactile_map: TactileMap,
    *,
    probability: float,
    prior: BumpPrior,
    provenance: Provenance,
    quantities: Mapping[str, Quantity] | None = None,
    place: ClockPosition | None = None,
) -> dict[str, Any]:
    """JSON object of one map, see data_schema/estimate.schema.json; `quantities` if already summarised."""
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)

    def one(name: str) -> dict[str, float | str] | None:
        return quantities[name].as_dict() if name in quantities else None

    def point(name: str) -> dict[str, Any] | None:
        return {axis: one(f"{name}.{axis}") for axis in "xy"} if f"{name}.x" in quantities else None

    about = estimate.about_mm
    share = estimate.size.variance_share if estimate.size is not None else None
    masses = masses_document(
        estimate.masses,
        tactile_map,
        probability=probability,
        quantities=quantities,
        reason=estimate.reason,
        scans=provenance.scans,
    )
    return {
        "schema": SCHEMA,
        "status": estimate.status,
        "verdict": verdict(estimate.findings, answered=estimate.size is not None),
        "findings": [one.as_dict() for one in estimate.findings],
        "reason": estimate.reason,
        "reason_code": estimate.code,
        "advice": estimate.advice,
        "on_paper": estimate.on_paper,
        "about_mm": None if about is None else {"x": nine_digits(about[0]), "y": nine_digits(about[1])},
        "smallest_lump": None if estimate.smallest is None else estimate.smallest.as_dict(),
        **{name: one(name) for name in (*SIZES, *WIDTHS)},
        ANOTHER_EXAM: another_exam(estimate.size, quantities),
        "supposing": supposed_document(estimate.size, quantities.get("max_size_mm")),
        "centre_mm": point("centre_mm"),
        "centre_patient_mm": point("centre_patient_mm"),
        "position": None if place is None else place.as_dict(probability),
        "angle_deg": one("angle_deg"),
        "detected_probability": None if estimate.probability is None else nine_digits(estimate.probability),
        "variance_share": None if share is None else {k: nine_digits(v) for k, v in share.items()},
        "scene": None if estimate.scene is None else scene_document(estimate.scene),
        "prior_sensitivity": None if estimate.sensitivity is None else rounded(estimate.sensitivity.as_dict()),
        "diagnostics": _diagnostics(estimate),
        "candidates": [
            {"x_mm": nine_digits(c.centre_mm[0]), "y_mm": nine_digits(c.centre_mm[1]), "fault": c.fault}
            for c in estimate.candidates
        ],
        "other_rises": [rise.as_dict() for rise in estimate.other_rises],
        "masses": masses,
        "touching": touching_masses(masses),
        "left_out": list(estimate.left_out),
        "prior": prior.as_dict(),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def rounded(value: Any) -> Any:
    """Plain data with its numbers rounded to nine significant digits."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return nine_digits(value) if isinstance(value, float) else value


def _diagnostics(estimate: Estimate) -> dict[str, Any]:
    """Diagnostics for the JSON; a figure that is not finite is null."""
    found: dict[str, Any] = {} if estimate.diagnostics is None else estimate.diagnostics.as_dict()
    if estimate.detection is not None:
        found["log_bayes_factor"] = estimate.detection.log_bayes_factor
    return _finite(found) | ({} if estimate.size is None else size_diagnostics(estimate.size))


def size_diagnostics(size: SizePosterior) -> dict[str, Any]:
    """What the diagnostics say of a size; a figure that is not finite is null."""
    return _finite({"invalid_draws": size.invalid, **size.figures})


def _finite(found: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: (nine_digits(value) if math.isfinite(value) else None) if isinstance(value, float) else value
        for name, value in found.items()
    }
