"""An estimate as plain data: the object that `estimate --json` prints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.summary import Quantity, summarise
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.scene_text import scene_document
from tactile_bayes.report.supposed_text import supposed_document
from tactile_bayes.size.posterior import EXTREMES, SIZES, SizePosterior

SCHEMA = "tactile-bayes/estimate/1"
ANOTHER_EXAM = "another_exam"
"""Prefix of the sizes' quantities if another exam of the mass may come out apart, see `SizePosterior.another_exam`."""
WIDTHS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd")


def estimate_quantities(estimate: Estimate, tactile_map: TactileMap, *, probability: float) -> dict[str, Quantity]:
    """Summaries of all quantities that an estimate has draws of, by name; empty without an estimate."""
    if estimate.map_posterior is None or estimate.draws is None:
        return {}
    posterior = estimate.map_posterior
    draws: dict[str, FloatArray] = {name: getattr(posterior, name) for name in WIDTHS}
    draws |= {"centre_mm.x": posterior.x_mm, "centre_mm.y": posterior.y_mm}
    if tactile_map.patient_from_plane is not None:
        on_plane = np.stack([posterior.x_mm, posterior.y_mm, np.zeros_like(posterior.x_mm)], axis=-1)
        in_patient = apply(tactile_map.patient_from_plane, on_plane)
        draws |= {"centre_patient_mm.x": in_patient[..., 0], "centre_patient_mm.y": in_patient[..., 1]}
    if estimate.diagnostics is not None and estimate.diagnostics.noise.rotated:
        draws["angle_deg"] = np.degrees(posterior.angle_rad)
    labels, worth = estimate.draws.labels, estimate.draws.effective_draws
    found = {
        name: summarise(d, probability=probability, effective_draws=worth, replicates=labels)
        for name, d in draws.items()
    }
    if estimate.size is not None:
        found |= {name: estimate.size.summarise(name, probability=probability) for name in SIZES}
        another = estimate.size.another_exam
        if another is not None:
            of_another = {name: another.summarise(name, probability=probability) for name in EXTREMES}
            found |= {f"{ANOTHER_EXAM}.{name}": quantity for name, quantity in of_another.items()}
    return found


def estimate_document(
    estimate: Estimate,
    tactile_map: TactileMap,
    *,
    probability: float,
    prior: BumpPrior,
    provenance: Provenance,
    quantities: Mapping[str, Quantity] | None = None,
) -> dict[str, Any]:
    """JSON object of one map, see data_schema/estimate.schema.json; `quantities` if already summarised."""
    if quantities is None:
        quantities = estimate_quantities(estimate, tactile_map, probability=probability)

    def one(name: str) -> dict[str, float | str] | None:
        return quantities[name].as_dict() if name in quantities else None

    def point(name: str) -> dict[str, Any] | None:
        return {axis: one(f"{name}.{axis}") for axis in "xy"} if f"{name}.x" in quantities else None

    share = estimate.size.variance_share if estimate.size is not None else None
    detection = estimate.detection
    return {
        "schema": SCHEMA,
        "status": estimate.status,
        "reason": estimate.reason,
        "reason_code": estimate.code,
        "advice": estimate.advice,
        **{name: one(name) for name in (*SIZES, *WIDTHS)},
        ANOTHER_EXAM: another_exam(estimate.size, quantities),
        "supposing": supposed_document(estimate.size, quantities.get("max_size_mm")),
        "centre_mm": point("centre_mm"),
        "centre_patient_mm": point("centre_patient_mm"),
        "angle_deg": one("angle_deg"),
        "detected_probability": None if detection is None else _round(detection.probability),
        "variance_share": None if share is None else {k: _round(v) for k, v in share.items()},
        "scene": None if estimate.scene is None else scene_document(estimate.scene),
        "prior_sensitivity": None if estimate.sensitivity is None else _rounded(estimate.sensitivity.as_dict()),
        "diagnostics": _diagnostics(estimate),
        "candidates": [
            {"x_mm": _round(c.centre_mm[0]), "y_mm": _round(c.centre_mm[1]), "fault": c.fault}
            for c in estimate.candidates
        ],
        "other_rises": [rise.as_dict() for rise in estimate.other_rises],
        "left_out": list(estimate.left_out),
        "prior": prior.as_dict(),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def another_exam(size: SizePosterior | None, quantities: Mapping[str, Quantity]) -> dict[str, Any] | None:
    """The spread between exams of a mass as a share of its size, and both sizes with it; None where it is not told."""
    if size is None or size.another_exam is None:
        return None
    sizes = {name: quantities[f"{ANOTHER_EXAM}.{name}"].as_dict() for name in EXTREMES}
    return {"between_map_sd": _round(size.another_exam.figures["between_map_sd"]), **sizes}


def _round(value: float) -> float:
    return float(f"{value:.9g}")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    return _round(value) if isinstance(value, float) else value


def _diagnostics(estimate: Estimate) -> dict[str, Any]:
    """Diagnostics for the JSON; a figure that is not finite is null."""
    found: dict[str, Any] = {} if estimate.diagnostics is None else estimate.diagnostics.as_dict()
    if estimate.detection is not None:
        found["log_bayes_factor"] = estimate.detection.log_bayes_factor
    if estimate.size is not None:
        found["invalid_draws"] = estimate.size.invalid
        found |= estimate.size.figures
    return {
        name: (_round(value) if math.isfinite(value) else None) if isinstance(value, float) else value
        for name, value in found.items()
    }
