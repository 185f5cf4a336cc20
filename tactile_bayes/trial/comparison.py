"""Ratio of one modality's error to another's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.accuracy import mape_percent
from tactile_bayes.trial.figures import Figure, Sample, resampled
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import ratio

REFERENCE = "tactile"


@dataclass(frozen=True, slots=True)
class ModalityRatio:
    """Percent error of one modality over the tactile one's on common masses.

    Attributes
    ----------
    ratio
        On the `masses` that both looked for, a mass not found counting 100 %.
    ratio_detected
        On the `masses_detected` that both found.
    """

    masses: int
    ratio: Figure
    masses_detected: int
    ratio_detected: Figure


def mape_ratios(sizes: Mapping[str, ModalitySizes], *, confidence: float) -> dict[str, ModalityRatio]:
    """Ratio of every other modality to the tactile one; empty without a tactile one."""
    reference = sizes.get(REFERENCE)
    if reference is None:
        return {}
    return {
        name: _modality_ratio(one, reference, confidence=confidence) for name, one in sizes.items() if name != REFERENCE
    }


def _modality_ratio(sizes: ModalitySizes, reference: ModalitySizes, *, confidence: float) -> ModalityRatio:
    looked_for = on_common_masses(sizes, reference)
    found = on_common_masses(sizes.only_detected(), reference.only_detected())
    return ModalityRatio(
        masses=len(looked_for[0].size_mm),
        ratio=mape_ratio(*looked_for, confidence=confidence),
        masses_detected=len(found[0].size_mm),
        ratio_detected=mape_ratio(*found, confidence=confidence),
    )


def on_common_masses(one: ModalitySizes, other: ModalitySizes) -> tuple[ModalitySizes, ModalitySizes]:
    """Both modalities, limited to their common masses, in the same order."""
    _, of_one, of_other = np.intersect1d(one.mass, other.mass, return_indices=True)
    return one.take(of_one), other.take(of_other)


def mape_ratio(sizes: ModalitySizes, reference: ModalitySizes, *, confidence: float) -> Figure:
    """Quotient of two percent errors.

    The interval leaves each patient out of both at once, so that patients hard for both do not widen it.
    """
    return resampled(Pair(sizes, reference, _quotient), scale="log", confidence=confidence)


@dataclass(frozen=True, slots=True)
class Pair:
    """A statistic of two modalities' percent errors, which can be resampled by patients."""

    sizes: ModalitySizes
    reference: ModalitySizes
    combine: Callable[[FloatArray, FloatArray], FloatArray]

    @property
    def patients(self) -> npt.NDArray[np.int64]:
        """Patients with a mass in either modality."""
        return np.union1d(self.sizes.patients, self.reference.patients)

    def _samples(self) -> tuple[Sample, Sample]:
        among = self.patients
        return Sample(mape_percent, self.sizes, among), Sample(mape_percent, self.reference, among)

    def value(self) -> float:
        """The statistic from all patients."""
        one, other = (sample.value() for sample in self._samples())
        return self._combined(np.array(one), np.array(other)).item()

    def left_out(self) -> FloatArray:
        """(g,) statistic without each patient."""
        one, other = (sample.left_out() for sample in self._samples())
        return self._combined(one, other)

    def redrawn(self, draws: FloatArray) -> FloatArray:
        """(b,) statistic from patients drawn anew."""
        one, other = (sample.redrawn(draws) for sample in self._samples())
        return self.combine(one, other)

    def _combined(self, one: FloatArray, other: FloatArray) -> FloatArray:
        values = self.combine(one, other)
        if np.any(np.isnan(values)):
            raise UndefinedError(f"the error of {self.reference.name} is 0")
        return values


def _quotient(one: FloatArray, other: FloatArray) -> FloatArray:
    return ratio(one, other)
