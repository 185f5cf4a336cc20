"""Spread of replicates of one mass."""

from __future__ import annotations

import numpy as np

from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic, columns, ratio


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Within-mass standard deviation in mm and in percent of the mass's mean, over masses with two or more replicates.

    Without a suffix: the mean of the standard deviations, as the paper prints (15 %, 2.6 mm). With ``_rms``: the root
    of the mean variance, which is not low for few replicates as a mean of standard deviations is.
    """
    replicated = sizes.only_replicated()
    statistics = {
        "within_mass_sd_mm": mean_sd_mm,
        "within_mass_sd_rms_mm": rms_sd_mm,
        "within_mass_cv_percent": mean_cv_percent,
        "within_mass_cv_rms_percent": rms_cv_percent,
    }
    return {
        name: figure(statistic, replicated, scale="log", confidence=confidence)
        for name, statistic in statistics.items()
    }


def _terms(sizes: ModalitySizes) -> FloatArray:
    """SD, SD over mean, variance and squared SD over mean by degrees of freedom, those, and 1, of each mass."""
    if not sizes.replicates_mm:
        raise UndefinedError("no mass has two detected replicates")
    sds, freedom = _moments(sizes)
    cvs = sds / sizes.size_mm
    return columns(sds, cvs, freedom * sds**2, freedom * cvs**2, freedom, 1.0)


def _moments(sizes: ModalitySizes) -> tuple[FloatArray, FloatArray]:
    """Standard deviation (divisor n - 1) and degrees of freedom of each mass's replicates."""
    number = np.array([len(group) for group in sizes.replicates_mm])
    start = np.concatenate([[0], np.cumsum(number)[:-1]])
    values = np.concatenate(sizes.replicates_mm)
    off = values - np.repeat(np.add.reduceat(values, start) / number, number)
    freedom = number - 1.0
    return np.sqrt(np.add.reduceat(off**2, start) / freedom), freedom


# Mean over masses of the standard deviation of the replicates, in mm.
mean_sd_mm = SumStatistic(_terms, lambda sums: ratio(sums[..., 0], sums[..., 5]))

# Root of the mean variance over masses, weighted by degrees of freedom, in mm: the within-subject standard deviation
# of a one-way analysis of variance (Bland & Altman 1996, BMJ 312, 1654).
rms_sd_mm = SumStatistic(_terms, lambda sums: np.sqrt(ratio(sums[..., 2], sums[..., 4])))

# Mean over masses of standard deviation over mean, in percent.
mean_cv_percent = SumStatistic(_terms, lambda sums: 100 * ratio(sums[..., 1], sums[..., 5]))

# Root mean square of standard deviation over mean, weighted by degrees of freedom, in percent.
rms_cv_percent = SumStatistic(_terms, lambda sums: 100 * np.sqrt(ratio(sums[..., 3], sums[..., 4])))
