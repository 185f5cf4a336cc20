"""Repeatability as a ratio, and components of the scatter of sizes: masses, readers and maps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tactile_bayes.trial.figures import Figure, figure
from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.sums import SumStatistic, columns, ratio
from tactile_bayes.trial.variance_components import Components, components

# Two readings of one mass differ by less than this many within-mass SDs in 95 % of pairs.
_PAIR = 1.959963984540054 * math.sqrt(2)


def figures(sizes: ModalitySizes, *, confidence: float) -> dict[str, Figure]:
    """Figures of replicates in log size, over masses with two or more.

    `repeatability_low_percent` and `repeatability_high_percent` bound the change between two readings of one mass in
    95 % of pairs; they are not symmetric, for +50 % and -33 % are the same step up and down.
    """
    replicated = sizes.only_replicated()
    log_sd = figure(log_sd_within, replicated, scale="log", confidence=confidence)
    return {
        "within_mass_log_sd": log_sd,
        "repeatability_low_percent": _swapped(log_sd.mapped(lambda sd: 100 * math.expm1(-_PAIR * sd))),
        "repeatability_high_percent": log_sd.mapped(lambda sd: 100 * math.expm1(_PAIR * sd)),
        "icc": figure(icc, replicated, scale="fisher", confidence=confidence),
    }


def _swapped(one: Figure) -> Figure:
    """Figure whose ends are swapped, because it falls as its source rises."""
    from dataclasses import replace

    return one if one.interval is None else replace(one, interval=(one.interval[1], one.interval[0]))


def _logs(sizes: ModalitySizes) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Number, mean and sum of squares about the mean of each mass's log sizes."""
    if not sizes.replicates_mm:
        raise UndefinedError("no mass has two detected replicates")
    number = np.array([len(group) for group in sizes.replicates_mm], dtype=np.float64)
    logs = np.log(np.concatenate(sizes.replicates_mm))
    start = np.concatenate([[0], np.cumsum(number)[:-1]]).astype(np.int64)
    mean = np.add.reduceat(logs, start) / number
    squares = np.add.reduceat((logs - np.repeat(mean, number.astype(np.int64))) ** 2, start)
    return number, mean, squares


def _log_terms(sizes: ModalitySizes) -> FloatArray:
    number, mean, squares = _logs(sizes)
    centred = mean - mean.mean()
    return columns(1.0, number, number**2, number * centred, number * centred**2, squares)


def _log_sd(sums: FloatArray) -> FloatArray:
    return np.sqrt(ratio(sums[..., 5], sums[..., 1] - sums[..., 0]))


def _icc(sums: FloatArray) -> FloatArray:
    masses, number, number2, first, second, within = np.moveaxis(sums, -1, 0)
    mean_within = ratio(within, number - masses)
    mean_between = ratio(second - ratio(first**2, number), masses - 1)
    usual = ratio(number - ratio(number2, number), masses - 1)
    return ratio(mean_between - mean_within, mean_between + (usual - 1) * mean_within)


log_sd_within = SumStatistic(_log_terms, _log_sd)
icc = SumStatistic(_log_terms, _icc, undefined="one mass, or no scatter at all, has no correlation within masses")


def reader_components(
    log_sizes: Sequence[float], masses: Sequence[object], readers: Sequence[str | None]
) -> Components | None:
    """Variances of log size between masses, between readers and between maps, by REML.

    Readings without a reader are left out when any has one. None where nothing was replicated.
    """
    known = [index for index, reader in enumerate(readers) if reader]
    chosen = known if known else range(len(log_sizes))
    values = np.array([log_sizes[i] for i in chosen])
    mass = _numbered([masses[i] for i in chosen])
    if len(values) - len(set(mass.tolist())) < 2 or len(set(mass.tolist())) < 2:
        return None
    reader = _numbered([readers[i] for i in chosen]) if known else np.zeros(len(values), dtype=np.int64)
    return components(values, mass, reader)


def _numbered(names: Sequence[object]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    number = {name: index for index, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.int64)
