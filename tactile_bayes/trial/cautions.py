"""Cautions about a modality's intervals, where the data meet a caution's condition."""

from __future__ import annotations

from tactile_bayes.trial.bootstrap import method_of
from tactile_bayes.trial.readings import ModalitySizes

# Up to so many misses, each moves the mean error by more than an uncorrected interval allows for.
FEW_MISSES = 3


def cautions(sizes: ModalitySizes, *, confidence: float) -> tuple[str, ...]:
    """Cautions about this modality's intervals; docs/coverage.md has the measured shares."""
    missed = len(sizes.size_mm) - int(sizes.detected.sum())
    if not 0 < missed <= FEW_MISSES or method_of(confidence) == "corrected":
        return ()
    return (
        f"only {missed} of {len(sizes.size_mm)} masses missed: intervals of MAPE hold less often than they say; "
        "--intervals corrected allows for it",
    )
