"""How far replicates of one mass lie from one another."""

from __future__ import annotations

import math

import numpy as np

from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes


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


def mean_sd_mm(sizes: ModalitySizes) -> float:
    """Mean over masses of the standard deviation of the replicates (divisor n - 1), in mm."""
    sds, _, _ = _moments(sizes)
    return float(sds.mean())


def rms_sd_mm(sizes: ModalitySizes) -> float:
    """Root of the mean variance over masses, weighted by degrees of freedom, in mm.

    Bland & Altman (1996), BMJ 312, 1654: the within-subject standard deviation of a one-way analysis of variance.
    """
    sds, _, freedom = _moments(sizes)
    return math.sqrt(float(np.average(sds**2, weights=freedom)))


def mean_cv_percent(sizes: ModalitySizes) -> float:
    """Mean over masses of standard deviation over mean, in percent."""
    sds, means, _ = _moments(sizes)
    return 100 * float(np.mean(sds / means))


def rms_cv_percent(sizes: ModalitySizes) -> float:
    """Root mean square of standard deviation over mean, weighted by degrees of freedom, in percent."""
    sds, means, freedom = _moments(sizes)
    return 100 * math.sqrt(float(np.average((sds / means) ** 2, weights=freedom)))


def _moments(sizes: ModalitySizes) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviation, mean and degrees of freedom of each mass's replicates."""
    if not sizes.replicates_mm:
        raise UndefinedError("no mass has two detected replicates")
    sds = np.array([group.std(ddof=1) for group in sizes.replicates_mm])
    freedom = np.array([float(len(group) - 1) for group in sizes.replicates_mm])
    return sds, sizes.size_mm, freedom
