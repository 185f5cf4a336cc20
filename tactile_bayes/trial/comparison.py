"""One modality's error over another's."""

from __future__ import annotations

from collections.abc import Mapping

from tactile_bayes.trial.accuracy import mape_percent
from tactile_bayes.trial.figures import Figure, finite, jackknifed
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import ModalitySizes

REFERENCE = "tactile"


def mape_ratios(sizes: Mapping[str, ModalitySizes], *, confidence: float) -> dict[str, dict[str, Figure]]:
    """Percent error of each other modality over the tactile one's; empty without a tactile one.

    `ratio` counts masses not found as 100 % error; `ratio_detected` takes each modality over the masses it found.
    """
    reference = sizes.get(REFERENCE)
    if reference is None:
        return {}
    return {
        name: {
            "ratio": mape_ratio(one, reference, confidence=confidence),
            "ratio_detected": mape_ratio(one.only_detected(), reference.only_detected(), confidence=confidence),
        }
        for name, one in sizes.items()
        if name != REFERENCE
    }


def mape_ratio(sizes: ModalitySizes, reference: ModalitySizes, *, confidence: float) -> Figure:
    """The plain quotient of two percent errors, as measured.

    The interval leaves each patient out of both at once, so that patients hard for both do not widen it.
    """

    def compute(left_out: int | None) -> float:
        one, other = (sizes, reference) if left_out is None else (sizes.without(left_out), reference.without(left_out))
        below = finite(mape_percent, other)
        if below == 0:
            raise UndefinedError(f"the error of {other.name} is 0")
        return finite(mape_percent, one) / below

    patients = sorted({*sizes.patients.tolist(), *reference.patients.tolist()})
    return jackknifed(compute, patients, scale="log", confidence=confidence)
