"""Exact intervals of a proportion k of n."""

from __future__ import annotations


def clopper_pearson(k: float, n: float, *, confidence: float) -> tuple[float, float]:
    r"""Exact two-sided interval of a binomial proportion.

    Parameters
    ----------
    k, n
        Successes of trials, 0 <= k <= n, n > 0. Fractions are allowed, for effective numbers of trials.
    confidence
        Probability that the interval covers the proportion, at least.

    Returns
    -------
    Low and high end, in [0, 1].

    Notes
    -----
    The ends are quantiles of Beta(k, n-k+1) and Beta(k+1, n-k). Clopper & Pearson (1934), Biometrika 26, 404.
    """
    from scipy.special import betaincinv

    if not 0 <= k <= n or n <= 0:
        raise ValueError(f"need 0 <= k <= n and n > 0 (found k = {k}, n = {n})")
    tail = 0.5 * (1 - confidence)
    low = 0.0 if k <= 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k >= n else float(betaincinv(k + 1, n - k, 1 - tail))
    return low, high
