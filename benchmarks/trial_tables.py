"""Synthetic trials of any size as CSV, for the benchmarks of `validate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SEED = 1999


def write_trial(folder: Path, masses: int, *, maps: int = 3) -> tuple[Path, Path]:
    """`masses` masses of as many patients less one in 25: `maps` tactile maps, one ultrasound, one examination each."""
    rng = np.random.default_rng([SEED, masses])
    truth = 16 * np.exp(rng.normal(0, 0.38, masses))
    rows = ["patient,mass,modality,replicate,size_mm,status,reader,synthetic"]
    excision = ["patient,mass,ex_vivo_mm,sd_mm,synthetic"]
    for i, e in enumerate(truth):
        key = f"P{i - (i % 25 == 24):06d},{1 + (i % 25 == 24)}"
        excision.append(f"{key},{e:.2f},{0.05 * e:.3f},true")
        shared = rng.normal(0, 0.18)
        for replicate in range(1, maps + 1):
            size = e * np.exp(shared + rng.normal(0, 0.15))
            rows.append(f"{key},tactile,{replicate},{size:.2f},detected,{'AB'[i % 2]},true")
        for name, sd in (("ultrasound", 0.4), ("cbe", 0.42)):
            missed = rng.random() < 0.04
            size = e * np.exp(rng.normal(0, sd))
            rows.append(f"{key},{name},1," + (",not_detected,,true" if missed else f"{size:.2f},detected,,true"))
    paths = folder / f"trial_{masses}.csv", folder / f"excision_{masses}.csv"
    for path, lines in zip(paths, (rows, excision), strict=True):
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return paths
