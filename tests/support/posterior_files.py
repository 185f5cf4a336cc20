"""Files for the commands that estimate: maps with and without a lump, and a size calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plain_calibration import RECIPE
from posterior_maps import bump_map

from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.size_json import write_size_calibration
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.terms import Recipe

MADE = Provenance("test", {})


def write_maps(folder: Path) -> None:
    """``a.nc`` and ``b.nc`` with a lump, ``empty.nc`` without, ``broken.nc`` that is none."""
    rng = np.random.default_rng(91)
    for name, amplitude in (("a", 0.3), ("b", 0.5), ("empty", 0.0)):
        noise = 0.02 * rng.standard_normal((51, 51))
        write_map(folder / f"{name}.nc", bump_map(noise=noise, amplitude=amplitude), provenance=MADE)
    (folder / "broken.nc").write_bytes(b"\x89HDF\r\n\x1a\n and no more")


def write_calibration(path: Path, recipe: Recipe | None = None) -> None:
    """A calibration of 100 draws about m 1.6, b 1 mm, e 0.6, f -0.35."""
    spread = np.exp(0.05 * np.random.default_rng(92).standard_normal((100, 6)))
    domain = {"amplitude": (0.05, 0.8), "sigma_mm": (2.0, 9.0), "d_mm": (5.0, 25.0)}
    axis = AxisCalibration(np.array([[1.6, 1.0, 0.6, -0.35, 0.1, 0.2]]) * spread, 0.3, domain, {"r2": 0.9})
    write_size_calibration(path, SizeCalibration(axis, axis, 0.8, recipe or RECIPE), provenance=MADE)
