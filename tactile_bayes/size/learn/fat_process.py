r"""Learning of the Gaussian process over a population's maps, see `size.fat_process` and `process_fit`."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import ndtri

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import BY_PLACE, HELD
from tactile_bayes.size.fat_depth import POWERS
from tactile_bayes.size.fat_process import FatProcess, PlaceTable
from tactile_bayes.size.learn.fat_depth import LEAST_BODIES, FatTable
from tactile_bayes.size.learn.hidden import hidden_terms
from tactile_bayes.size.learn.process_fit import Fitted, ProcessRows, fit_process, left_out_density
from tactile_bayes.size.learn.regression import ExamSpread, PopulationTable, error_figures, leverages
from tactile_bayes.size.polynomials import monomials

INSIDE: Final = 0.99
"""Share of the table's maps that count as inside it: its largest leverage is an outlier's, ten times what is left."""
INSIDE_BY_PLACE: Final = 0.95
"""The same for the figures by place: beside a rib that the map does not show, they and sizes by them are wrong."""
OTHER_SD: Final = 0.025
"""Of bodies unlike the population's: another tissue, neighbours, a lump higher or flatter than it is wide, which no map
shows (record 0123)."""


def learn_fat_process(table: PopulationTable, *, other_sd: float = OTHER_SD) -> FatProcess | None:
    """Learn the calibration from maps with a profile; None for too few bodies.

    Where enough of the maps have figures by place too, a second process knows these.

    Parameters
    ----------
    other_sd
        See `FatProcess`: the table cannot tell it.

    Raises
    ------
    NotConvergedError
        When the coefficients of ln SD(B) have no mode.
    """
    found = FatTable.of(table)
    if found is None:
        return None
    return replace(_learned(found, None, other_sd), with_places=_with_places(found, other_sd))


def _with_places(found: FatTable, other_sd: float) -> FatProcess | None:
    """The process that knows the figures by place, in the scales of the whole table; None for too few bodies."""
    if found.maps.by_place is None:
        return None
    kept = np.isfinite(found.maps.by_place.sum(axis=1))
    maps = found.maps.rows(kept)
    if maps.by_place is None or len(np.unique(maps.body)) < LEAST_BODIES:
        return None
    return _learned(replace(found, maps=maps, log_depth=found.log_depth[kept]), place_table(maps.by_place), other_sd)


def place_table(by_place: FloatArray) -> PlaceTable:
    """Median and robust scale of (n, 6) figures, and how far they reach."""
    low, middle, high = np.quantile(by_place, [0.25, 0.5, 0.75], axis=0)
    scale = (high - low) / 1.35
    inverse, leverage = leverages(np.insert((by_place - middle) / scale, 0, 1.0, axis=1))
    return PlaceTable(middle, scale, inverse, float(np.quantile(leverage, INSIDE_BY_PLACE)))


def _learned(found: FatTable, places: PlaceTable | None, other_sd: float) -> FatProcess:
    rows, fitted, exam = fit_process(found.maps, ProcessRows.of(found, places))
    features = monomials(found.values, POWERS)
    mean = np.concatenate([fitted.mean, fitted.log_spread, [exam.log_sd]])
    error, variance = fitted.left_out(rows.data.mean_log_d)
    left_out = {"body": -error, "body_sd": np.exp(rows.spread @ fitted.log_spread), "variance": variance}
    by_place = None if places is None else rows.x[:, -len(BY_PLACE) :]
    return FatProcess(
        **found.fields(features, inside=INSIDE),
        mean=mean,
        covariance=_covariance(rows, fitted, exam),
        hidden=hidden_terms(found.maps, rows.data, **left_out, features=features, by_place=by_place),
        fit=_figures(found.maps, rows, fitted, exam),
        kernel=fitted.kernel,
        other_sd=other_sd,
        map_factor=exam.map_factor,
        places=places,
    )


def _covariance(rows: ProcessRows, fitted: Fitted, exam: ExamSpread) -> FloatArray:
    """Of coefficients, ln SD(B) and ln SD(E): the second by curvature, kernel kept."""
    from tactile_bayes.inference.laplace import mode_and_covariance

    k, s = len(fitted.mean), len(fitted.log_spread)
    density = left_out_density(rows, fitted, exam_sd=exam.sd)

    def many(spreads: FloatArray) -> FloatArray:
        return np.array([density(one) for one in spreads])

    _, of_spread, _ = mode_and_covariance(many, fitted.log_spread, scale=np.full(s, 0.05))
    whole = np.zeros((k + s + 1, k + s + 1))
    whole[:k, :k], whole[k:-1, k:-1], whole[-1, -1] = fitted.covariance, of_spread, exam.variance
    return whole


def _figures(table: PopulationTable, rows: ProcessRows, fitted: Fitted, exam: ExamSpread) -> dict[str, float]:
    """Number of rows, spreads, and errors cross-validated by body with the kernel kept."""
    error, variance = fitted.left_out(rows.data.mean_log_d)
    spreads = {"body_sd": float(np.exp(np.median(rows.spread @ fitted.log_spread))), "exam_sd": exam.sd}
    share_held = float(np.mean(np.abs(error) <= ndtri(0.5 + HELD / 2) * np.sqrt(variance)))
    return error_figures(table, rows.data, spreads, error, share_held)
