"""Tests of uniform ranks, for simulation-based calibration.

References
----------
Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Saeilynoja, Buerkner & Vehtari (2022), Statistics
and Computing 32:32 (simultaneous bands of the ECDF).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray

PROBABILITIES = (0.5, 0.9)
BAND = 0.95
BAND_SIMULATIONS = 4000
LEAST_IN_BIN = 5
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]


@dataclass(frozen=True, slots=True)
class Coverage:
    """Share of truths that a central interval of nominal probability covered, with its binomial standard error."""

    probability: float
    covered: float
    error: float


@dataclass(frozen=True, slots=True)
class RankTest:
    """Results of the tests on one parameter's ranks.

    Parameters
    ----------
    name
        Of the parameter.
    n
        Ranks.
    chi2_p
        P value of equal numbers in bins of ranks.
    ecdf_p
        Share of uniform samples whose ECDF strays at least as far, anywhere.
    mean_rank, spread
        Mean of (rank + 1/2) / (draws + 1), 0.5 when calibrated; and its SD over that of a uniform one: above 1 the
        posterior is too narrow, below 1 too wide.
    coverage
        Of central intervals.
    """

    name: str
    n: int
    chi2_p: float
    ecdf_p: float
    mean_rank: float
    spread: float
    coverage: tuple[Coverage, ...]

    @property
    def inside(self) -> bool:
        """Whether the ECDF stays inside its simultaneous band."""
        return self.ecdf_p > 1.0 - BAND


def rank_test(name: str, ranks: IntArray, *, draws: int, strays: FloatArray | None = None) -> RankTest:
    """Run all tests on one parameter's ranks.

    Parameters
    ----------
    ranks : (n,) array
        Each from 0 to `draws`.
    strays
        From `uniform_strays`, where it is at hand.
    """
    known = uniform_strays(len(ranks), draws) if strays is None else strays
    # equally likely strays of discrete counts differ by rounding
    as_far = float(np.mean(known <= stray(ecdf_counts(ranks[None], draws), len(ranks))[0] * (1.0 + 1e-9)))
    share = (ranks + 0.5) / (draws + 1)
    uniform_sd = np.sqrt((1.0 - 1.0 / (draws + 1) ** 2) / 12.0)
    return RankTest(
        name=name,
        n=len(ranks),
        chi2_p=chi2_p(ranks, draws),
        ecdf_p=as_far,
        mean_rank=float(share.mean()),
        spread=float(np.sqrt(np.mean((share - 0.5) ** 2)) / uniform_sd),
        coverage=tuple(coverage(ranks, draws, probability) for probability in PROBABILITIES),
    )


def chi2_p(ranks: IntArray, draws: int) -> float:
    """P value of the counts in equal bins of ranks: at most 20 bins, each with `LEAST_IN_BIN` or more expected."""
    from scipy.stats import chi2

    bins = [b for b in range(2, 21) if (draws + 1) % b == 0 and len(ranks) >= LEAST_IN_BIN * b]
    if not bins:
        return 1.0
    number = np.bincount(ranks * bins[-1] // (draws + 1), minlength=bins[-1])
    expected = len(ranks) / bins[-1]
    return float(chi2.sf(np.sum((number - expected) ** 2) / expected, bins[-1] - 1))


def coverage(ranks: IntArray, draws: int, probability: float) -> Coverage:
    """Share of truths in the central interval between two draws that holds exactly the nominal share of ranks.

    Raises
    ------
    ValueError
        When no central interval between draws has that probability.
    """
    tail = (1.0 - probability) / 2.0 * (draws + 1)
    if abs(tail - round(tail)) > 1e-9:
        raise ValueError(f"{draws} draws have no central interval of probability {probability:g}")
    held = (ranks >= round(tail)) & (ranks <= draws - round(tail))
    return Coverage(probability, float(held.mean()), float(np.sqrt(probability * (1.0 - probability) / len(ranks))))


def ecdf_counts(ranks: IntArray, draws: int) -> IntArray:
    """(m, draws) number of (m, n) ranks below 1, 2 ... `draws`."""
    below = ranks[..., None] < np.arange(1, draws + 1)
    return np.asarray(below.sum(axis=-2))


def stray(counts: IntArray, n: int) -> FloatArray:
    """(m,) smallest two-sided binomial tail of (m, draws) counts of n ranks: small where an ECDF departs somewhere."""
    from scipy.stats import binom

    at = np.arange(1, counts.shape[-1] + 1) / (counts.shape[-1] + 1)
    number = np.arange(n + 1)[:, None]
    tails = 2.0 * np.minimum(binom.cdf(number, n, at), binom.sf(number - 1, n, at))
    return np.asarray(np.min(tails[counts, np.arange(len(at))], axis=-1))


def uniform_strays(n: int, draws: int) -> FloatArray:
    """(BAND_SIMULATIONS,) `stray` of n simulated uniform ranks, with a seed of their own."""
    rng = np.random.default_rng([n, draws])
    number = rng.multinomial(n, np.full(draws + 1, 1.0 / (draws + 1)), size=BAND_SIMULATIONS)
    return stray(np.cumsum(number, axis=1)[:, :-1], n)


def ecdf_band(n: int, draws: int) -> tuple[FloatArray, FloatArray]:
    """(draws,) simultaneous band: lowest and highest share of n uniform ranks below 1, 2 ...

    Each point's binomial limits are as wide as makes the whole path stay inside with probability `BAND`.
    """
    from scipy.stats import binom

    level = float(np.quantile(uniform_strays(n, draws), 1.0 - BAND))
    at = np.arange(1, draws + 1) / (draws + 1)
    return np.asarray(binom.ppf(level / 2.0, n, at) / n), np.asarray(binom.isf(level / 2.0, n, at) / n)
