"""Statistics that depend on masses only through sums, so that resampling patients is cheap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes


@dataclass(frozen=True, slots=True)
class SumStatistic:
    """A figure computed from the sums of a few terms over the masses.

    Parameters
    ----------
    terms
        (n, k) array of what each mass adds; raises `UndefinedError` where the masses leave the figure undefined.
    finish
        The figure from the (..., k) sums, for all leading axes at once; NaN where it does not exist.
    undefined
        The reason when `finish` gives NaN.
    """

    terms: Callable[[ModalitySizes], FloatArray]
    finish: Callable[[FloatArray], FloatArray]
    undefined: str = "the masses do not determine it"

    def __call__(self, sizes: ModalitySizes) -> float:
        """Compute the statistic of these masses."""
        value = float(self.finish(self.terms(sizes).sum(axis=0)))
        if np.isnan(value):
            raise UndefinedError(self.undefined)
        return value

    def left_out(self, sizes: ModalitySizes, patients: npt.NDArray[np.int64]) -> FloatArray:
        """(g,) statistic without each patient in turn; a patient without a mass changes nothing."""
        terms = self.terms(sizes)
        return self.finish(terms.sum(axis=0) - self.by_patient(terms, sizes, patients))

    def redrawn(self, sizes: ModalitySizes, patients: npt.NDArray[np.int64], draws: FloatArray) -> FloatArray:
        """(b,) statistic for each row of (b, g) `draws`: how often each patient was drawn."""
        return self.finish(draws @ self.by_patient(self.terms(sizes), sizes, patients))

    @staticmethod
    def by_patient(terms: FloatArray, sizes: ModalitySizes, patients: npt.NDArray[np.int64]) -> FloatArray:
        """(g, k) sums of the terms within each patient."""
        sums = np.zeros((len(patients), terms.shape[1]))
        np.add.at(sums, np.searchsorted(patients, sizes.patient), terms)
        return sums


def columns(*values: FloatArray | float) -> FloatArray:
    """(n, k) array of k columns, each of length n or one number for all rows."""
    return np.stack(np.broadcast_arrays(*values), axis=-1).astype(np.float64)


def ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    """`above` over `below`, NaN where `below` is 0."""
    with np.errstate(all="ignore"):
        quotient: FloatArray = np.where(below == 0, np.nan, above / np.where(below == 0, 1.0, below))
    return quotient
