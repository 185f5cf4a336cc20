"""Reader of the NIST StRD nonlinear regression data sets Gauss1 to Gauss3 (Rust, 1996; US Government work)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

DATASETS = ("Gauss1", "Gauss2", "Gauss3")


@dataclass(frozen=True)
class Certified:
    """One data set: data, the two starts, certified parameters, their standard deviations and the residual's."""

    x: np.ndarray
    y: np.ndarray
    starts: np.ndarray
    theta: np.ndarray
    sd: np.ndarray
    residual_sd: float

    def predict(self, theta: np.ndarray) -> np.ndarray:
        """(m, 250) predictions: two Gaussians on a decaying exponential."""
        b = [theta[:, i, None] for i in range(8)]
        first = b[2] * np.exp(-(((self.x - b[3]) / b[4]) ** 2))
        return b[0] * np.exp(-b[1] * self.x) + first + b[5] * np.exp(-(((self.x - b[6]) / b[7]) ** 2))


@cache
def read(folder: Path, name: str) -> Certified:
    """Read NAME.dat: parameters and certified values in lines 41 to 53, data from line 61 on."""
    lines = (folder / "nist" / f"{name}.dat").read_text().splitlines()
    rows = [re.match(r"\s*b\d+ =\s+(.*)", line) for line in lines[:60]]
    table = np.array([[float(v) for v in row[1].split()] for row in rows if row])
    residual = next(float(line.split(":")[1]) for line in lines if line.startswith("Residual Standard Deviation"))
    data = np.array([[float(v) for v in line.split()] for line in lines[60:] if line.strip()])
    assert table.shape == (8, 4)
    assert data.shape == (250, 2)
    return Certified(data[:, 1], data[:, 0], table[:, :2].T, table[:, 2], table[:, 3], residual)
