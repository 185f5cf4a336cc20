"""Replicates: variance components and spread within a mass."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from tactile_bayes.declarations import Record
from tactile_bayes.inference.modes import finite_differences, stencil
from tactile_bayes.trial.figures import (
    Count,
    Ends,
    Figure,
    Figures,
    Intervals,
    Reasons,
    SumStatistic,
    UndefinedError,
    columns,
    figure,
    ratio,
)
from tactile_bayes.trial.readings import FloatArray, ModalitySizes, Reading

# --- Variances of masses, readers and maps from unbalanced readings, by restricted maximum likelihood.

Index = npt.NDArray[np.int64]


class Components(Record):
    """Variances of the model y = mean + mass + reader + map, each independent and normal.

    `reader` is None where only one reader read, so that its variance is part of the mean.
    """

    mass: float
    reader: float | None
    map: float
    n: Count
    masses: Count
    readers: Count


class ReplicateFigures(Figures):
    """Spread between the readings of one mass, on ln size, and variance components."""

    within_mass_log_sd: float | None
    within_mass_log_sd_interval: Ends | None
    repeatability_low_percent: float | None  #: Change between two readings of one mass: lower end in 95 % of pairs.
    repeatability_low_percent_interval: Ends | None
    repeatability_high_percent: float | None  #: Change between two readings of one mass: upper end in 95 % of pairs.
    repeatability_high_percent_interval: Ends | None
    icc: float | None  #: Intraclass correlation.
    icc_interval: Ends | None
    reasons: Reasons
    variance_components: Components | None  #: REML variances of ln size.


def components(y: FloatArray, mass: Index, reader: Index) -> Components:
    """Estimate the variances by REML.

    Masses and readers are numbered from 0 without gaps.

    Patterson & Thompson (1971), Biometrika 58, 545. The criterion, -2 log restricted likelihood less a constant, is
    profiled over the residual variance and searched in the ratios of SDs to the residual SD, in which it is even, so
    that a variance of 0 is no edge (Bates et al. 2015, J. Stat. Softw. 67(1)).
    """
    readers, freedom = int(reader.max()) + 1, len(y) - 1
    terms_at = _criterion_terms(y - y.mean(), mass, reader)

    def criterion(ratios: FloatArray) -> float:
        log_det, squares = terms_at(ratios)
        return log_det + freedom * math.log(max(squares, 1e-300))

    start = np.array([1.0, 0.3] if readers > 1 else [1.0])
    minima = [_minimise(criterion, start * factor) for factor in (1.0, 0.2, 5.0)]
    ratios = np.abs(min(minima, key=criterion))
    residual = max(0.0, terms_at(ratios)[1]) / freedom
    variances = np.where(ratios < 1e-6, 0.0, ratios**2 * residual)  # 0 where the search ended at its lower limit
    return Components(
        mass=float(variances[0]),
        reader=float(variances[1]) if readers > 1 else None,
        map=residual,
        n=len(y),
        masses=int(mass.max()) + 1,
        readers=readers,
    )


def _criterion_terms(y: FloatArray, mass: Index, reader: Index) -> Callable[[FloatArray], tuple[float, float]]:
    """Function of the ratios of SDs: log determinant and generalised residual sum of squares, at residual variance 1.

    Masses are eliminated one by one, which leaves a system of the readers' size.
    """
    terms = np.zeros((len(y), int(reader.max()) + 2))  # the fixed mean, then the readers
    terms[:, 0] = terms[np.arange(len(y)), reader + 1] = 1.0
    cross = np.zeros((int(mass.max()) + 1, terms.shape[1]))  # of each mass, the sum of its terms
    np.add.at(cross, mass, terms)
    count, total = cross[:, 0], np.bincount(mass, weights=y)
    products, projected, about_mean = terms.T @ terms, terms.T @ y, float(y @ y)

    def terms_at(ratios: FloatArray) -> tuple[float, float]:
        scale = np.full(terms.shape[1], ratios[1] if len(ratios) > 1 else 0.0)
        scale[0] = 1.0
        shrink = ratios[0] ** 2 / (1 + ratios[0] ** 2 * count)
        right = scale * (projected - cross.T @ (shrink * total))
        system = (products - (cross * shrink[:, None]).T @ cross) * np.outer(scale, scale)
        system[1:, 1:] += np.eye(len(scale) - 1)
        squares = about_mean - float(shrink @ total**2) - float(np.linalg.solve(system, right) @ right)
        log_det = np.linalg.slogdet(system)[1] + np.sum(np.log1p(ratios[0] ** 2 * count))
        return float(log_det), squares

    return terms_at


def _minimise(function: Callable[[FloatArray], float], theta: FloatArray) -> FloatArray:
    """Local minimum by Newton's method with finite differences; steps are halved until they do not go up."""
    for _ in range(60):
        step = 1e-4 * np.maximum(np.abs(theta), 1e-2)
        values = np.array([function(point) for point in stencil(theta, step=step)])
        slope, bend = finite_differences(values, step=step)
        curvature, axes = np.linalg.eigh(bend)
        move = -axes @ ((axes.T @ slope) / np.maximum(np.abs(curvature), 1e-6))
        move *= min(1.0, 3 * max(1.0, float(np.abs(theta).max())) / max(float(np.abs(move).max()), 1e-300))
        for _ in range(40):
            if function(theta + move) <= values[0]:
                break
            move /= 2
        else:
            return theta
        theta = theta + move
        if np.abs(move).max() < 1e-9 * max(1.0, float(np.abs(theta).max())):
            break
    return theta


# --- Spread of replicates of one mass.


def spread_figures(sizes: ModalitySizes, *, intervals: Intervals) -> dict[str, Figure]:
    """Within-mass standard deviation in mm and in percent of the mass's mean, over masses with two or more replicates.

    Without a suffix: the mean of the standard deviations, as the paper prints (15 %, 2.6 mm). With ``_rms``: the root
    of the mean variance, which is not low for few replicates as a mean of standard deviations is.
    """
    replicated = sizes.only_replicated()
    return {name: figure(statistic, replicated, scale="log", intervals=intervals) for name, statistic in SPREAD.items()}


def _terms(sizes: ModalitySizes) -> FloatArray:
    """(n, 6) SD, SD over mean, both squared times degrees of freedom, degrees of freedom, and 1, of each mass."""
    number, _, squares = _moments(sizes, lambda size_mm: size_mm)
    freedom = number - 1.0
    sds = np.sqrt(squares / freedom)
    cvs = sds / sizes.size_mm
    return columns(sds, cvs, freedom * sds**2, freedom * cvs**2, freedom, 1.0)


def _moments(
    sizes: ModalitySizes, scale: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Number, mean and sum of squares about the mean of each mass's replicates on a scale."""
    if not sizes.replicates_mm:
        raise UndefinedError("no mass has two detected replicates")
    number = np.array([len(group) for group in sizes.replicates_mm])
    start = np.concatenate([[0], np.cumsum(number)[:-1]])
    values = scale(np.concatenate(sizes.replicates_mm))
    mean = np.add.reduceat(values, start) / number
    return number.astype(np.float64), mean, np.add.reduceat((values - np.repeat(mean, number)) ** 2, start)


SPREAD = {
    # mean over masses of the standard deviation of the replicates, in mm
    "within_mass_sd_mm": SumStatistic(_terms, lambda sums: ratio(sums[..., 0], sums[..., 5])),
    # root of the mean variance over masses, weighted by degrees of freedom, in mm: the within-subject standard
    # deviation of a one-way analysis of variance (Bland & Altman 1996, BMJ 312, 1654)
    "within_mass_sd_rms_mm": SumStatistic(_terms, lambda sums: np.sqrt(ratio(sums[..., 2], sums[..., 4]))),
    # mean over masses of standard deviation over mean, in percent
    "within_mass_cv_percent": SumStatistic(_terms, lambda sums: 100 * ratio(sums[..., 1], sums[..., 5])),
    # root mean square of standard deviation over mean, weighted by degrees of freedom, in percent
    "within_mass_cv_rms_percent": SumStatistic(_terms, lambda sums: 100 * np.sqrt(ratio(sums[..., 3], sums[..., 4]))),
}


# --- Repeatability as a ratio, and components of the scatter of sizes: masses, readers and maps.

# Two readings of one mass differ by less than this many within-mass SDs in 95 % of pairs.
REPEATABILITY_SDS = 1.959963984540054 * math.sqrt(2)


def replicate_figures(sizes: ModalitySizes, *, intervals: Intervals) -> dict[str, Figure]:
    """Figures of replicates in log size, over masses with two or more.

    `repeatability_low_percent` and `repeatability_high_percent` bound the change between two readings of one mass in
    95 % of pairs; they are not symmetric, for +50 % and -33 % are the same step up and down.
    """
    replicated = sizes.only_replicated()
    log_sd = figure(log_sd_within, replicated, scale="log", intervals=intervals)
    return {
        "within_mass_log_sd": log_sd,
        "repeatability_low_percent": log_sd.mapped(lambda sd: 100 * math.expm1(-REPEATABILITY_SDS * sd)),
        "repeatability_high_percent": log_sd.mapped(lambda sd: 100 * math.expm1(REPEATABILITY_SDS * sd)),
        "icc": figure(icc, replicated, scale="fisher", intervals=intervals),
    }


def _log_terms(sizes: ModalitySizes) -> FloatArray:
    """(n, 6) 1, m, m^2, m times the centred mean of logs, m times its square, and sum of squares, for m replicates."""
    number, mean, squares = _moments(sizes, np.log)
    centred = mean - mean.mean()
    return columns(1.0, number, number**2, number * centred, number * centred**2, squares)


def _icc(sums: FloatArray) -> FloatArray:
    """Intraclass correlation of a one-way analysis of variance with unequal numbers of replicates."""
    masses, number, number2, first, second, within = sums.T
    mean_within = ratio(within, number - masses)
    mean_between = ratio(second - ratio(first**2, number), masses - 1)
    mean_number = ratio(number - ratio(number2, number), masses - 1)
    return ratio(mean_between - mean_within, mean_between + (mean_number - 1) * mean_within)


log_sd_within = SumStatistic(_log_terms, lambda sums: np.sqrt(ratio(sums[..., 5], sums[..., 1] - sums[..., 0])))
icc = SumStatistic(_log_terms, _icc, undefined="one mass, or no scatter at all, has no correlation within masses")


def reader_components(readings: Sequence[Reading]) -> Components | None:
    """REML variances of log size between masses, readers and maps, from readings with a size.

    Readings without a reader are left out when any has one. None with fewer than 2 masses or 2 replicates.
    """
    chosen = [reading for reading in readings if reading.reader] or readings
    mass, reader = _codes([one.key for one in chosen]), _codes([one.reader for one in chosen])
    masses = len(set(mass.tolist()))
    if len(chosen) - masses < 2 or masses < 2:
        return None
    sizes = np.array([one.size_mm for one in chosen], dtype=np.float64)
    return components(np.log(sizes), mass, reader)


def _codes(names: Sequence[object]) -> Index:
    """Numbers of names from 0 in order of first appearance."""
    number = {name: index for index, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.int64)
