"""The synthetic trial in the shape of the paper's that the package ships as `demo/trial.csv` and `demo/excision.csv`.

To make them anew, write the texts of `trial_csv()` and `excision_csv()` to those files; every row says synthetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

SEED = 1999
MASSES = 25
TWO_MASSES = 7  # the one patient of 24 who has two
NOT_PALPABLE = 4
NOT_VISIBLE = 16

# Ex-vivo sizes: log-normal about 16 mm, so that the mean is near the 17.3 mm that the paper's 2.6 mm at 15 % implies.
MEDIAN_MM = 16.0
SIZE_LOG_SD = 0.38
SMALLEST_MM, LARGEST_MM = 6.0, 45.0

# Errors on the logarithm of size. They were chosen by hand to resemble the paper's errors and are no one's findings.
WITHIN_MASS_LOG_SD = 0.15
MAP_LOG_SD, MAP_LOG_BIAS = 0.20, 0.02
ULTRASOUND_LOG_SD, ULTRASOUND_LOG_BIAS = 0.40, -0.08
CBE_LOG_SD, CBE_LOG_BIAS = 0.42, 0.15
CALIPER_SHARE = 0.05

_HEADER = "patient,mass,modality,replicate,size_mm,status,low_mm,high_mm,probability,reader,synthetic"


@dataclass(frozen=True, slots=True)
class _Mass:
    patient: str
    mass: str
    size_mm: float
    second_mm: float


def trial_csv(seed: int = SEED) -> str:
    """Readings as CSV: three to five tactile maps with 95 % intervals, one ultrasound and one examination per mass."""
    rng = np.random.default_rng([seed, 1])
    rows = [_HEADER]
    for index, mass in enumerate(_masses(seed), start=1):
        rows.extend(_tactile_rows(mass, rng))
        missed = index == NOT_VISIBLE
        rows.append(_single_row(mass, "ultrasound", rng, (ULTRASOUND_LOG_BIAS, ULTRASOUND_LOG_SD), missed=missed))
        missed = index == NOT_PALPABLE
        rows.append(_single_row(mass, "cbe", rng, (CBE_LOG_BIAS, CBE_LOG_SD), missed=missed))
    return "\n".join(rows) + "\n"


def excision_csv(seed: int = SEED) -> str:
    """Sizes after excision as CSV, with the caliper's +-5 % as a standard deviation."""
    rows = ["patient,mass,ex_vivo_mm,ex_vivo_second_mm,sd_mm,synthetic"]
    for mass in _masses(seed):
        sd_mm = CALIPER_SHARE * mass.size_mm
        rows.append(f"{mass.patient},{mass.mass},{mass.size_mm:.1f},{mass.second_mm:.1f},{sd_mm:.2f},true")
    return "\n".join(rows) + "\n"


def _masses(seed: int) -> Iterator[_Mass]:
    rng = np.random.default_rng([seed, 0])
    for index in range(1, MASSES + 1):
        patient = index if index <= TWO_MASSES else index - 1
        size_mm = float(np.clip(MEDIAN_MM * math.exp(rng.normal(0, SIZE_LOG_SD)), SMALLEST_MM, LARGEST_MM))
        second_mm = size_mm * float(rng.uniform(0.65, 1.0))
        yield _Mass(f"S{patient:02d}", "2" if index == TWO_MASSES + 1 else "1", size_mm, second_mm)


def _tactile_rows(mass: _Mass, rng: np.random.Generator) -> Iterator[str]:
    reach = 1.96 * math.hypot(WITHIN_MASS_LOG_SD, MAP_LOG_SD)
    shared = rng.normal(MAP_LOG_BIAS, MAP_LOG_SD)
    reader = rng.choice(["A", "B"])
    for replicate in range(1, int(rng.integers(3, 6)) + 1):
        size_mm = mass.size_mm * math.exp(shared + rng.normal(0, WITHIN_MASS_LOG_SD))
        low_mm, high_mm = size_mm * math.exp(-reach), size_mm * math.exp(reach)
        cells = f"{size_mm:.1f},detected,{low_mm:.1f},{high_mm:.1f},0.95,{reader},true"
        yield f"{mass.patient},{mass.mass},tactile,{replicate},{cells}"


def _single_row(
    mass: _Mass, modality: str, rng: np.random.Generator, error: tuple[float, float], *, missed: bool
) -> str:
    size_mm = mass.size_mm * math.exp(rng.normal(*error))
    cells = ",not_detected" if missed else f"{size_mm:.1f},detected"
    return f"{mass.patient},{mass.mass},{modality},1,{cells},,,,,true"
