"""Summaries of an estimate's draws, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.inference.summary import Quantity, nine_digits, summarise
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.size.draws import EXTREMES, SIZES, SizePosterior

ANOTHER_EXAM = "another_exam"
"""Prefix of the sizes' quantities if another exam of the mass may come out apart, see `SizePosterior.another_exam`."""
WIDTHS = ("amplitude", "sigma_x_mm", "sigma_y_mm", "background", "noise_sd")


def leading(told: Mapping[str, Any]) -> Mapping[str, Any]:
    """What holds the sizes that lead, of an estimate's JSON object or one of its masses (record 0130).

    Until a site's repeatability is known these are the sizes for exams as far apart as patients' (`another_exam`); with
    it, or a stated spread, there is one interval.
    """
    another = told.get(ANOTHER_EXAM)
    return told if another is None else another


def leading_size(size: SizePosterior) -> SizePosterior:
    """The posterior of a size that leads; see `leading`."""
    return size if size.another_exam is None else size.another_exam


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


def xiphoid_mm(quantities: Mapping[str, Quantity]) -> tuple[float, float] | None:
    """Place of the lump, mm from the xiphoid to the patient's right and up; None without landmarks or a lump."""
    if "centre_patient_mm.x" not in quantities:
        return None
    return quantities["centre_patient_mm.x"].median, quantities["centre_patient_mm.y"].median


def another_exam(size: SizePosterior | None, quantities: Mapping[str, Quantity]) -> dict[str, Any] | None:
    """The spread between exams of a mass as a share of its size, and both sizes with it; None where it is not told."""
    if size is None or size.another_exam is None:
        return None
    sizes = {name: quantities[f"{ANOTHER_EXAM}.{name}"].as_dict() for name in EXTREMES}
    share = {name: nine_digits(value) for name, value in size.another_exam.variance_share.items()}
    spread = nine_digits(size.another_exam.figures["between_map_sd"])
    return {"between_map_sd": spread, **sizes, "variance_share": share}
