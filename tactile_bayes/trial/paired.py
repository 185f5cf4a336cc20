"""Paired comparison of two modalities: difference and ratio of errors, and a permutation test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tactile_bayes.trial.accuracy import mape_percent
from tactile_bayes.trial.comparison import Pair, on_common_masses
from tactile_bayes.trial.figures import Figure, figure, resampled
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import ratio

# Up to so many patients every pattern of signs is tried; beyond, this many random ones.
MOST_EXACT = 14
FLIPS = 9_999
_AT_ONCE = 111


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Percent errors of `first` against `second` on their common masses; a mass not found counts as size 0.

    Attributes
    ----------
    difference_percent, ratio
        Mean error of the first less, or over, that of the second.
    p_value
        Two-sided, of the sign-flip test by patient; None where no patient differs.
    p_holm
        The same, corrected for all pairs of this trial.
    """

    first: str
    second: str
    masses: int
    patients: int
    first_percent: float | None
    second_percent: float | None
    difference_percent: Figure
    ratio: Figure
    p_value: float | None
    p_holm: float | None = None


def paired_comparisons(
    sizes: Mapping[str, ModalitySizes], *, confidence: float, seed: int = 0
) -> list[PairedComparison]:
    """Compare every pair of modalities on their common masses, with Holm's correction of p values."""
    pairs = [
        _compare(sizes[one], sizes[other], confidence=confidence, seed=seed) for one, other in combinations(sizes, 2)
    ]
    corrected = holm([pair.p_value for pair in pairs])
    return [replace(pair, p_holm=p) for pair, p in zip(pairs, corrected, strict=True)]


def least_p(patients: int) -> float:
    """Smallest two-sided p value that a sign-flip test of so many patients can give: 2 of 2^n patterns."""
    return min(1.0, 2.0 ** (1 - patients))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Correct p values for their number, leaving None out: Holm (1979), Scand. J. Statist. 6, 65."""
    known = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        corrected[index] = largest
    return corrected


def sign_flip(by_patient: FloatArray, *, seed: int, flips: int = FLIPS) -> float | None:
    """Two-sided p value of a sum of patients' differences, by a permutation test that flips their signs.

    Parameters
    ----------
    by_patient : (g,) array
        Sum over each patient's masses of the difference of absolute errors.
    seed
        Of the random patterns, when there are too many to try all.
    flips
        How many random patterns.

    Notes
    -----
    Exact when all patterns are tried; with random ones the observed pattern is counted in (Phipson & Smyth 2010, Stat.
    Appl. Genet. Mol. Biol. 9, 39). Valid when, under the null hypothesis, exchanging the two modalities of a patient
    changes no probability.
    """
    differences = by_patient[by_patient != 0]
    if len(differences) == 0:
        return None
    # the same sum in another order differs in rounding; a hair's breadth is equal
    observed = abs(float(differences.sum())) * (1 - 1e-9)
    if len(differences) <= MOST_EXACT:
        patterns = (np.arange(2 ** len(differences))[:, None] >> np.arange(len(differences))) & 1
        return float(np.mean(np.abs((1 - 2 * patterns) @ differences) >= observed))
    rng = np.random.default_rng([seed, len(differences)])
    beyond = 1
    for start in range(0, flips, _AT_ONCE):
        signs = 1 - 2 * rng.integers(0, 2, (min(_AT_ONCE, flips - start), len(differences)), dtype=np.int8)
        beyond += int(np.sum(np.abs(signs @ differences) >= observed))
    return beyond / (flips + 1)


def _compare(one: ModalitySizes, other: ModalitySizes, *, confidence: float, seed: int) -> PairedComparison:
    first, second = on_common_masses(one, other)
    difference = resampled(Pair(first, second, _difference), scale="linear", confidence=confidence)
    quotient = resampled(Pair(first, second, ratio), scale="log", confidence=confidence)
    patients = first.patients
    with np.errstate(all="ignore"):
        off = np.abs(first.size_mm / first.ex_vivo_mm - 1) - np.abs(second.size_mm / second.ex_vivo_mm - 1)
    sums = np.zeros(len(patients))
    np.add.at(sums, np.searchsorted(patients, first.patient), off)
    return PairedComparison(
        first=one.name,
        second=other.name,
        masses=len(first.size_mm),
        patients=len(patients),
        first_percent=figure(mape_percent, first).value,
        second_percent=figure(mape_percent, second).value,
        difference_percent=difference,
        ratio=quotient,
        p_value=sign_flip(sums, seed=seed) if len(patients) and np.all(np.isfinite(sums)) else None,
    )


def _difference(one: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray(one - other)
