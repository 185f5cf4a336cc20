"""Figures that count a missed mass as size 0, with intervals that allow for misses not yet observed.

Where one mass in 25 is missed, a trial of 25 has none, one or two misses, and each moves the mean error by some 3
points. Leaving out or redrawing patients sees only the misses that occurred: without any, the interval allows for none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tactile_bayes.trial.bootstrap import method_of
from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import Scale, effective_number
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic

Ends = tuple[float, float]


def figure_with_misses(
    statistic: SumStatistic,
    sizes: ModalitySizes,
    *,
    scale: Scale,
    confidence: float,
    weight: Callable[[ModalitySizes], FloatArray],
    missed: Callable[[ModalitySizes], float],
) -> Figure:
    r"""Weighted mean over masses, found and missed, with an interval over patients.

    Parameters
    ----------
    statistic
        The mean.
    weight
        (n,) weights of the mean.
    missed
        What the mean would be if every mass were missed.

    Notes
    -----
    The mean is :math:`(1 - p) a + p b` with the missed share p of the weights, a over masses found and b if all were
    missed. The corrected interval recovers the variances of a and p from their own intervals (Zou & Donner 2008, Stat.
    Med. 27, 1693): a's is the jackknife's, p's that of Jeffreys' prior for the effective number of patients. Other
    methods treat a miss as one more size.
    """
    plain = figure(statistic, sizes, scale=scale, confidence=confidence, leverage=weight)
    if method_of(confidence) != "corrected" or plain.value is None:
        return plain
    found = figure(statistic, sizes.only_detected(), scale=scale, confidence=confidence, leverage=weight)
    if found.value is None or found.interval is None:
        return plain
    weights = weight(sizes)
    share = float(weights[~sizes.detected].sum() / weights.sum())
    low, high = share_interval(share, effective_number(weights, sizes.patient), confidence=float(confidence))
    step = missed(sizes) - found.value
    by_share = sorted((step * (low - share), step * (high - share)))
    by_found = ((1 - share) * (end - found.value) for end in found.interval)
    below, above = (math.hypot(one, other) for one, other in zip(by_found, by_share, strict=True))
    return replace(plain, interval=(plain.value - below, plain.value + above), interval_reason="")


def share_interval(share: float, number: float, *, confidence: float) -> Ends:
    """Equal-tailed interval of a proportion with Jeffreys' prior; it contains the observed share (Brown et al. 2001).

    Parameters
    ----------
    share, number
        Share observed, and of how many trials, which need not be a whole number.
    """
    from scipy.special import betaincinv

    tail, a, b = 0.5 * (1 - confidence), share * number + 0.5, (1 - share) * number + 0.5
    return min(share, float(betaincinv(a, b, tail))), max(share, float(betaincinv(a, b, 1 - tail)))


def alike(sizes: ModalitySizes) -> FloatArray:
    """Equal weights of 1."""
    return np.ones_like(sizes.ex_vivo_mm)


def by_size(sizes: ModalitySizes) -> FloatArray:
    """Weights by ex-vivo size, over the largest."""
    return np.asarray(sizes.ex_vivo_mm / sizes.ex_vivo_mm.max())


def by_square(sizes: ModalitySizes) -> FloatArray:
    """Weights by squared ex-vivo size, over the largest."""
    return by_size(sizes) ** 2
