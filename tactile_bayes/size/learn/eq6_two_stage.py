r"""Eq 6 in the two stages of the paper's section 2.4, with a bootstrap for its uncertainty.

Stage one is least squares of :math:`d` on :math:`\sigma` in the rows at one diameter depth, stage two of
:math:`\ln\Delta\sigma` on :math:`\ln a` in all rows whose lump has a row at one diameter depth:

.. math:: d = m\,\sigma + b \; (h/d = 1), \qquad \ln\Delta\sigma = \ln e + f \ln a.

The joint posterior of `size.learn.eq6` takes m and b from all rows instead, on the scale of ln d, where a row counts
the less the fainter its map is. Both agree where Eq 6 holds; decision record 0098 gives how far they part where it does
not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.eq6 import AxisCalibration, Recipe, SizeCalibration
from tactile_bayes.size.learn.eq6 import (
    DRAWS_KEPT,
    AxisRows,
    SizeTable,
    agreement,
    axis_at_mode,
    axis_rows,
    both_axes,
    domain_of,
    log_error,
)

LEAST_DIAMETERS = 3
"""Two diameters always lie on a line, and leave nothing to resample."""
_SLOPES = np.linspace(-1.0, 2.0, 301)
_WAY_OUT = "give depth_ratio and at least 3 diameters at depth_ratio 1, or use --fit joint"


@dataclass(frozen=True, slots=True)
class OtherFit:
    """What the other of the two fits makes of the same rows.

    Parameters
    ----------
    name
        ``"joint"`` or ``"two-stage"``.
    coefficients
        m, b (mm), e, f of each axis.
    difference
        Mean absolute difference of the two fits' sizes over the rows, as a share of the true size, of each axis.
    """

    name: str
    coefficients: tuple[tuple[float, float, float, float], ...]
    difference: tuple[float, ...]


def learn_two_stage(table: SizeTable, *, recipe: Recipe, rng: np.random.Generator) -> SizeCalibration:
    """Learn Eq 6 in two stages from a table.

    Parameters
    ----------
    table
        At least eight rows with positive amplitude, with h/d, and three diameters at h/d 1.
    recipe
        How the table's maps were made.

    Raises
    ------
    BadDataError
        When rows are too few, do not vary, or have no depths.
    """
    x, y = axis_rows(table)
    return both_axes((_learn(x, rng), x), None if y is None else (_learn(y, rng), y), recipe=recipe)


def axis_in_two_stages(data: AxisRows) -> AxisCalibration:
    """Eq 6 fitted in two stages to the rows themselves: a single draw, as `axis_at_mode` of the joint posterior.

    Raises
    ------
    BadDataError
        When the rows do not give three diameters at one diameter depth.
    """
    ones = np.ones((1, len(data.d_mm)))
    coefficients = _coefficients(data, ones)
    return AxisCalibration(_with_scatter(coefficients, data, ones), data.centre[0], domain_of(data))


def other_fit(calibration: SizeCalibration, table: SizeTable) -> OtherFit | None:
    """Fit the same table the other way; None where that fit does not exist, as without depths."""
    name = "joint" if is_two_stage(calibration) else "two-stage"
    fit = axis_at_mode if name == "joint" else axis_in_two_stages
    pairs = [(axis, data) for axis, data in zip((calibration.x, calibration.y), axis_rows(table), strict=True) if data]
    try:
        others = [fit(data) for _, data in pairs]
    except BadDataError:
        return None
    differences = []
    for (axis, data), other in zip(pairs, others, strict=True):
        ours, theirs = (one.size_mm(data.sigma_mm, data.amplitude) for one in (axis, other))
        differences.append(float(np.mean(np.abs(ours - theirs) / data.d_mm)))
    coefficients = []
    for one in others:
        m, b, e, f = (float(value) for value in one.draws[0, :4])
        coefficients.append((m, b, e, f))
    return OtherFit(name, tuple(coefficients), tuple(differences))


def is_two_stage(calibration: SizeCalibration) -> bool:
    """Whether a calibration was learned in two stages."""
    return calibration.x.fit.get("two_stage", 0.0) == 1.0


def _learn(data: AxisRows, rng: np.random.Generator) -> AxisCalibration:
    fitted = axis_in_two_stages(data)
    counts = _resampled(data, rng)
    draws = _with_scatter(_coefficients(data, counts), data, counts)
    _stretch(draws, diameters=len(np.unique(data.d_mm)))
    # the estimate is the fit to the table itself, not the mean over its resamples
    scaled = [2, 4]
    draws[:, scaled] *= fitted.draws[0, scaled] / draws[:, scaled].mean(axis=0)
    shifted = [0, 1, 3, 5]
    draws[:, shifted] += fitted.draws[0, shifted] - draws[:, shifted].mean(axis=0)
    axis = AxisCalibration(draws, data.centre[0], domain_of(data))
    level, known = _stages(data)
    figures = {
        **agreement(axis, data),
        "e_identified": 1.0,
        "two_stage": 1.0,
        "level_rows": float(level.sum()),
        "width_change_rows": float(known.sum()),
    }
    return AxisCalibration(draws, data.centre[0], domain_of(data), figures)


def _stretch(draws: FloatArray, *, diameters: int) -> None:
    """Widen the draws of m, b, ln e and f about their means, as few clusters ask for.

    Notes
    -----
    Resamples of g clusters vary by (g - 1) / g too little, and normal intervals of few clusters hold too seldom. A
    Student t with g - 1 degrees of freedom mends that (Cameron & Miller 2015, J. Human Resources 50:317, section VI).
    """
    g = diameters
    factor = np.sqrt(g / (g - 1)) * stdtrit(g - 1, 0.95) / ndtri(0.95)
    draws[:, 2] = np.log(draws[:, 2])
    middle = draws[:, :4].mean(axis=0)
    draws[:, :4] = middle + factor * (draws[:, :4] - middle)
    draws[:, 2] = np.exp(draws[:, 2])


_Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]


def _stages(data: AxisRows) -> tuple[_Mask, _Mask]:
    """Rows of either stage."""
    if data.depth_ratio is None or data.width_change is None:
        raise BadDataError("the table has no depth_ratio, and the two-stage fit needs it", way_out=_WAY_OUT)
    level, known = np.abs(data.depth_ratio - 1.0) < 1e-9, np.isfinite(data.width_change)
    diameters = len(np.unique(data.d_mm[level]))
    if diameters < LEAST_DIAMETERS:
        raise BadDataError(f"{diameters} diameters at depth_ratio 1 are too few for two stages", way_out=_WAY_OUT)
    if np.ptp(data.sigma_mm[level]) <= 0 or np.ptp(data.amplitude[known]) <= 0:
        raise BadDataError("the rows at depth_ratio 1 or the amplitudes do not vary", way_out="use --fit joint")
    return level, known


def _resampled(data: AxisRows, rng: np.random.Generator) -> FloatArray:
    """(draws, rows) how often each row is drawn: all rows of one diameter together.

    Notes
    -----
    Resamples with fewer than three diameters at one diameter depth (two, where the table has three) are drawn anew: a
    line through two neighbours may have any slope.
    Cluster bootstrap (Davison & Hinkley 1997, section 3.8). The depths of a lump share the width that their changes
    refer to, and lumps of one diameter that differ in stiffness have almost one map.
    """
    level, _ = _stages(data)
    names, group = np.unique(data.d_mm, return_inverse=True)
    usable = np.isin(names, data.d_mm[level])
    least = min(LEAST_DIAMETERS, int(usable.sum()) - 1)
    drawn: list[FloatArray] = []
    while len(drawn) < DRAWS_KEPT:
        counts = np.bincount(rng.integers(0, len(names), len(names)), minlength=len(names)).astype(np.float64)
        if np.sum((counts > 0) & usable) >= least:
            drawn.append(counts)
    return np.array(drawn)[:, group]


def _coefficients(data: AxisRows, counts: FloatArray) -> FloatArray:
    """(k, 4) m, b, e, f of (k, rows) resamples."""
    level, known = _stages(data)
    assert data.width_change is not None
    m, b = _line(data.sigma_mm[level], data.d_mm[level], counts[:, level])
    f, log_e = _line(np.log(data.amplitude[known]), np.log(data.width_change[known]), counts[:, known])
    return np.stack([m, b, np.exp(log_e), f], axis=1)


def _line(x: FloatArray, y: FloatArray, counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) slope and intercept of least squares of y on x with (k, n) weights."""
    total = counts.sum(axis=1)
    x_mean, y_mean = counts @ x / total, counts @ y / total
    dx = x - x_mean[:, None]
    slope = np.sum(counts * dx * (y - y_mean[:, None]), axis=1) / np.sum(counts * dx**2, axis=1)
    return slope, y_mean - slope * x_mean


def _with_scatter(coefficients: FloatArray, data: AxisRows, counts: FloatArray) -> FloatArray:
    """(k, 6) coefficients with scatter s and slope g of ln d about them, by maximum likelihood on a grid of g."""
    axis = AxisCalibration(np.zeros((1, 6)), data.centre[0], {})
    padded = np.pad(coefficients, ((0, 0), (0, 2)))[:, None, :]
    error = log_error(axis.size_mm(data.sigma_mm, data.amplitude, draws=padded), data.d_mm)
    log_a = np.log(data.amplitude / data.centre[0])
    share = counts / counts.sum(axis=1, keepdims=True)
    variance = (share * error**2) @ np.exp(2.0 * np.outer(log_a, _SLOPES))
    best = np.argmin(0.5 * np.log(variance) - np.outer(share @ log_a, _SLOPES), axis=1)
    s = np.sqrt(np.maximum(variance[np.arange(len(best)), best], 1e-12))
    return np.column_stack([coefficients, s, _SLOPES[best]])
