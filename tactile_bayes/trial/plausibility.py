"""Plausibility of a trial's units: impossible sizes, and modalities that differ from excision tenfold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# Largest extents of palpable masses lie well inside; beyond, a size is more likely in another unit or misplaced.
SMALLEST_MM, LARGEST_MM = 2.0, 150.0
UNITS = {"cm": 10.0, "inches": 25.4, "m": 1000.0}
# A median ratio within this factor of a unit is doubted. No modality is wrong sixfold in the median.
NEAR = 1.6


def unit_doubts(sizes: Mapping[str, ModalitySizes], ex_vivo_mm: FloatArray) -> list[str]:
    """One sentence for each column that seems to be in another unit than mm; empty if none does.

    Parameters
    ----------
    sizes
        What each modality read.
    ex_vivo_mm
        (n,) array of all excised masses.
    """
    doubts = [] if (doubt := _outside("ex-vivo sizes", ex_vivo_mm)) is None else [doubt]
    for name, one in sizes.items():
        doubts += _modality_doubts(name, one.only_detected())
    return doubts


def _modality_doubts(name: str, detected: ModalitySizes) -> Iterator[str]:
    if len(detected.size_mm) == 0:
        return
    outside = _outside(f"{name} sizes", np.concatenate(detected.replicates_mm))
    if outside is not None:
        yield outside
    with np.errstate(over="ignore", under="ignore"):
        ratio = float(np.median(detected.size_mm / detected.ex_vivo_mm))
    found = f"{name} sizes are {ratio:.3g} times the ex-vivo sizes in the median"
    for unit, factor in UNITS.items():
        if factor / NEAR < ratio < factor * NEAR:
            yield f"{found}: are the ex-vivo sizes in {unit}?"
        elif factor / NEAR < 1 / max(ratio, 1e-300) < factor * NEAR:
            yield f"{found}: are the {name} sizes in {unit}?"


def _outside(what: str, values_mm: FloatArray) -> str | None:
    outside = (values_mm < SMALLEST_MM) | (values_mm > LARGEST_MM)
    if not outside.any():
        return None
    return (
        f"{int(outside.sum())} of {len(values_mm)} {what} lie outside {SMALLEST_MM:g} to {LARGEST_MM:g} mm "
        f"(from {values_mm.min():.3g} to {values_mm.max():.3g}): are they in mm?"
    )
