"""A campaign's folder of repeated exams without scans: draws of shapes whose ln d has a known spread."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import tactile_bayes as tb
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.npz import write_shape
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws

MAP_SD = 0.02
DRAWS = 400


def shape(log_width: float, amplitude: float = 0.3, *, sd: float, rng: np.random.Generator) -> ShapeDraws:
    """Draws of a round bump whose log width has a normal posterior."""
    width, zero = log_width + sd * rng.standard_normal(DRAWS), np.zeros(DRAWS)
    return ShapeDraws(np.full(DRAWS, np.log(amplitude)), width, zero, zero)


@cache
def estimate_document() -> dict[str, Any]:
    """A real estimate's JSON object, without its sizes by name."""
    found = tb.estimate(tb.demo_map(), method="laplace").answer.document
    assert found is not None
    return found


def write_repeats(
    folder: Path, masses: int, *, maps: int = 3, spread: float = 0.08, seed: int = 5, calibration: str = "solid"
) -> Path:
    """Write exams of masses 01, 02... whose ln d has this spread beside the maps' own error of `MAP_SD`."""
    path = size_calibration_path(calibration)
    assert path is not None
    used = read_size_calibration(path)
    assert isinstance(used, BodyCalibration)
    slope = float(used.width_slope(np.log(np.array(0.3)), np.log(np.array(6.5))))
    rng, rows = np.random.default_rng(seed), []
    for mass in range(1, masses + 1):
        centre = np.log(rng.uniform(6.0, 7.0))
        for replicate in range(1, maps + 1):
            off = np.hypot(spread, MAP_SD) * rng.standard_normal() / slope
            exam = f"{mass:02}.v1.m1.r{replicate}"
            write_exam(folder / "exams" / exam, shape(centre + off, sd=MAP_SD / slope, rng=rng), path, name=exam)
            rows.append(f"{mass:02},1,1,{replicate}")
    write_done(folder, rows)
    return folder


def write_done(folder: Path, rows: Sequence[str]) -> None:
    """Write ``exams_done.csv`` with patient, visit, mass and replicate."""
    (folder / "exams_done.csv").write_text("\n".join(["patient,visit,mass,replicate", *rows]) + "\n")


def write_exam(folder: Path, draws: ShapeDraws, calibration: Path, *, name: str, sized: bool = True) -> None:
    """What an estimate leaves in an exam's folder, as far as learning reads it."""
    folder.mkdir(parents=True)
    write_shape(folder / "shape.npz", draws)
    size = {"median": 14.5, "mean": 14.6, "sd": 1.5, "low": 12.0, "high": 18.0, "mc_error": 0.01}
    document = estimate_document() | {
        "max_size_mm": {**size, "probability": 0.95, "kind": "eti"} if sized else None,
        "provenance": {
            "settings": {"size_calibration": f"{calibration.stem} (shipped)"},
            "inputs": [{"role": "size_calibration", "sha256": sha256(calibration)}],
            "scans": [{"sha256": name}],
        },
    }
    (folder / "estimate.json").write_text(json.dumps(document))
