"""Learning of Eq 6 from a study or phantoms, and its cross-validation by geometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.special import ndtri, stdtrit

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble
from tactile_bayes.inference.modes import mode_and_covariance
from tactile_bayes.presets import LEAST_HARD_RATIO
from tactile_bayes.progress import Progress
from tactile_bayes.size.eq6 import AxisCalibration, LeftOutErrors, SizeCalibration
from tactile_bayes.size.learn.regression import rows_of, value_ranges
from tactile_bayes.size.terms import Recipe, monomials, powers

# --- Bayesian regression of Eq 6 from a table of known lumps: m, b, e, f and the residual scatter, jointly.
#
# On the log scale, with :math:`a_0, \sigma_0` the table's geometric means,
#
# .. math::
#     \ln d_i &= \ln\!\left[M\,(\sigma_i/\sigma_0)\,(a_i/a_0)^{-f} + b\right] + \epsilon_i,
#         \quad \epsilon_i \sim N(0,\, s\,(a_i/a_0)^{-g}) \\
#     \ln(\sigma_i / \sigma_i^{(1)}) &= \ln e + f \ln a_i + \eta_i, \quad \eta_i \sim N(0, t)
#
# where :math:`\sigma_i^{(1)}` is the width of the same lump at one diameter depth (Delta sigma is a ratio), and
# :math:`m = M\,e\,a_0^{f}/\sigma_0`. Without depths in the table the second line is missing and only m/e is
# determined: e is then 1 by convention.

DRAWS_KEPT = 1000
# Steps of the search, about one posterior deviation each, of ln M, b, f, ln s, g, ln e, ln t.
_SCALE = (0.05, 0.5, 0.03, 0.1, 0.1, 0.05, 0.1)


class StudyCases(Record, eq=False):
    """The study case of each row of a table: seat, h/d, E2/E1, and what else the table tells of every row."""

    seat: tuple[str | None, ...]
    depth_ratio: FloatArray
    stiffness_ratio: FloatArray
    others: Mapping[str, FloatArray] = field(default_factory=dict)

    def lumps(self, d_mm: FloatArray) -> list[tuple[object, ...]]:
        """Key of each row's lump, shared by rows that differ in depth only."""
        others = [values.tolist() for values in self.others.values()]
        return list(zip(self.seat, d_mm.tolist(), self.stiffness_ratio.tolist(), *others, strict=True))


class SizeTable(Record, eq=False):
    """Table of a study or a set of phantoms, one of n rows per lump: its diameter, and the fit of its map."""

    d_mm: FloatArray
    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray | None
    width_change_x: FloatArray | None = None
    width_change_y: FloatArray | None = None
    """Width over the width of the same lump at one diameter depth; NaN where the table has no such row."""
    cases: StudyCases | None = None  #: Cases of a study; None for other tables.
    depth_ratio: FloatArray | None = None  #: h/d; None where the table does not say.


class AxisRows(Record, eq=False):
    """The n rows with positive amplitudes for the regression of one axis, as in `SizeTable`."""

    d_mm: FloatArray
    amplitude: FloatArray
    sigma_mm: FloatArray
    width_change: FloatArray | None
    depth_ratio: FloatArray | None = None

    @property
    def centre(self) -> tuple[float, float]:
        """Geometric means of amplitude and width."""
        return float(np.exp(np.log(self.amplitude).mean())), float(np.exp(np.log(self.sigma_mm).mean()))

    def calibration(self, draws: FloatArray) -> AxisCalibration:
        """Draws of Eq 6's coefficients with the ranges of these rows."""
        values = {"amplitude": self.amplitude, "sigma_mm": self.sigma_mm, "d_mm": self.d_mm}
        return AxisCalibration(draws, self.centre[0], value_ranges(values))


def width_changes(sigma_mm: FloatArray, *, depth_ratio: FloatArray, group: Sequence[tuple[object, ...]]) -> FloatArray:
    """Delta sigma: each width over that of its group's row at one diameter depth; NaN without such a row."""
    reference = {key: s for key, s, h in zip(group, sigma_mm, depth_ratio, strict=True) if abs(h - 1.0) < 1e-9}
    return np.array([s / reference.get(key, np.nan) for key, s in zip(group, sigma_mm, strict=True)])


def learn_size_calibration(
    table: SizeTable, *, recipe: Recipe, rng: np.random.Generator, progress: Progress | None = None
) -> SizeCalibration:
    """Learn Eq 6 from a table of at least eight rows with positive amplitude; `BadDataError` when they do not vary."""
    return _learn_axes(table, recipe, lambda data: _learn_axis(data, rng=rng, progress=progress))


def axis_rows(table: SizeTable) -> list[AxisRows]:
    """Rows with positive amplitude for the regression of each axis: across the head, and along it where widths are."""
    rising = table.amplitude > 0
    if rising.sum() < 8:
        what = f"{int(rising.sum())} rows with a positive amplitude"
        raise BadDataError(what, way_out="Eq 6 has 4 coefficients: give at least 8")
    if np.ptp(table.d_mm[rising]) <= 0:
        raise BadDataError("all rows have one diameter", way_out="a calibration needs lumps of several sizes")
    if any(s is not None and np.ptp(s[rising]) <= 0 for s in (table.sigma_x_mm, table.sigma_y_mm)):
        raise BadDataError("all rows have one width", way_out="m and b need maps of several widths to be told apart")
    usable = rows_of(table, rising)
    widths = (usable.sigma_x_mm, usable.width_change_x), (usable.sigma_y_mm, usable.width_change_y)
    return [
        AxisRows(usable.d_mm, usable.amplitude, sigma, change, usable.depth_ratio)
        for sigma, change in widths
        if sigma is not None
    ]


def _learn_axes(table: SizeTable, recipe: Recipe, learn: Callable[[AxisRows], AxisCalibration]) -> SizeCalibration:
    """Calibration of the axes across and along the head; both alike where the table has one width."""
    rows = axis_rows(table)
    axes = [learn(data) for data in rows]
    if len(axes) == 1:
        return SizeCalibration(axes[0], axes[0], 1.0, recipe, axes=("both",))
    standard = [
        log_error(axis.size_mm(data.sigma_mm, data.amplitude), data.d_mm) / axis.scatter(data.amplitude)
        for axis, data in zip(axes, rows, strict=True)
    ]
    x, y = axes
    return SizeCalibration(x, y, float(np.clip(np.corrcoef(standard[0], standard[1])[0, 1], -1, 1)), recipe)


def log_error(size_mm: FloatArray, d_mm: FloatArray) -> FloatArray:
    """ln(true / predicted) of sizes; one below a tenth of the true size, or negative, counts as a tenth."""
    return np.asarray(np.log(d_mm / np.maximum(size_mm, 0.1 * d_mm)))


def axis_at_mode(data: AxisRows) -> AxisCalibration:
    """Eq 6 at the mode of its posterior: a single draw, a hundred times faster than a thousand draws."""
    data, mode, _ = _mode(data)
    return data.calibration(_coefficients(mode[None], data))


def _mode(data: AxisRows) -> tuple[AxisRows, FloatArray, FloatArray]:
    """The rows with posterior mode and covariance; without width changes where these are too few to estimate e."""
    a0, s0 = data.centre
    ratio = np.log(data.d_mm) - np.log(data.sigma_mm / s0)
    f = -float(np.polyfit(np.log(data.amplitude / a0), ratio, 1)[0]) if np.ptp(data.amplitude) > 0 else 0.0
    start = np.array([np.log(np.median(data.d_mm)), 0.0, np.clip(f, -1.0, 1.0), np.log(0.25), 0.0, -0.2, np.log(0.3)])
    scale = np.array(_SCALE)
    if data.width_change is None or np.isfinite(data.width_change).sum() < 4:
        data = AxisRows(data.d_mm, data.amplitude, data.sigma_mm, None)
        scale, start = scale[:5], start[:5]
    mode, covariance, _ = mode_and_covariance(partial(_log_density, data=data), start, scale=scale)
    return data, mode, covariance


def _learn_axis(data: AxisRows, *, rng: np.random.Generator, progress: Progress | None) -> AxisCalibration:
    data, mode, covariance = _mode(data)
    options, density = EnsembleOptions(keep=DRAWS_KEPT, max_steps=20_000, block=300), partial(_log_density, data=data)
    draws = ensemble(density, mode, covariance, rng=rng, options=options, progress=progress)
    axis = data.calibration(_coefficients(draws.flat, data))
    mixing = {name: draws.diagnostics[name] for name in ("rhat", "ess_tail")}
    return replace(axis, fit={**agreement(axis, data), "e_identified": float(data.width_change is not None), **mixing})


def agreement(axis: AxisCalibration, data: AxisRows) -> dict[str, float]:
    """Number of rows, r2 of ln d and mean absolute error in percent of the mean coefficients."""
    predicted = axis.size_mm(data.sigma_mm, data.amplitude)
    error = log_error(predicted, data.d_mm)
    return {
        "rows": float(len(data.d_mm)),
        "r2": float(1.0 - np.sum(error**2) / np.sum((np.log(data.d_mm) - np.log(data.d_mm).mean()) ** 2)),
        "mae_percent": float(100 * np.mean(np.abs(predicted / data.d_mm - 1.0))),
    }


def _log_density(theta: FloatArray, data: AxisRows) -> FloatArray:
    """(m,) log posterior of (m, 5 or 7) vectors ``(ln M, b, f, ln s, g[, ln e, ln t])``.

    Priors: ln M ~ N(ln 15 mm, 1.5), b ~ N(0, 20 mm), f ~ N(-0.3, 0.5), ln s ~ N(ln 0.2, 1), g ~ N(0, 0.5),
    ln e ~ N(0, 1), ln t ~ N(ln 0.2, 1): wide beside what a dozen rows determine.
    """
    a0, s0 = data.centre
    log_a = np.log(data.amplitude / a0)
    size = np.exp(theta[:, :1] + np.log(data.sigma_mm / s0) - theta[:, 2:3] * log_a) + theta[:, 1:2]
    log_scatter = theta[:, 3:4] - theta[:, 4:5] * log_a
    with np.errstate(invalid="ignore", divide="ignore"):
        error = (np.log(data.d_mm) - np.log(np.where(size > 0, size, np.nan))) / np.exp(log_scatter)
    total = np.sum(-0.5 * error**2 - log_scatter, axis=1)
    centres, widths = [np.log(15.0), 0.0, -0.3, np.log(0.2), 0.0], [1.5, 20.0, 0.5, 1.0, 0.5]
    if data.width_change is not None:
        known = np.isfinite(data.width_change)
        log_change = theta[:, 5:6] + theta[:, 2:3] * np.log(data.amplitude[known])
        eta = (np.log(data.width_change[known]) - log_change) / np.exp(theta[:, 6:7])
        total = total + np.sum(-0.5 * eta**2 - theta[:, 6:7], axis=1)
        centres, widths = [*centres, 0.0, np.log(0.2)], [*widths, 1.0, 1.0]
    total = total - 0.5 * np.sum(((theta - centres) / widths) ** 2, axis=1)
    return np.where(np.isfinite(total), total, -np.inf)


def _coefficients(theta: FloatArray, data: AxisRows) -> FloatArray:
    """(n, 6) m, b, e, f, scatter, slope from draws of the regression's parameters."""
    a0, s0 = data.centre
    e = np.exp(theta[:, 5]) if theta.shape[1] > 5 else np.ones(len(theta))
    f = theta[:, 2]
    m = np.exp(theta[:, 0]) * e * a0**f / s0
    return np.stack([m, theta[:, 1], e, f, np.exp(theta[:, 3]), theta[:, 4]], axis=1)


LEAST_DIAMETERS = 3  #: Two diameters always lie on a line, and leave nothing to resample.
_SLOPES = np.linspace(-1.0, 2.0, 301)
_WAY_OUT = "give depth_ratio and at least 3 diameters at depth_ratio 1, or use --fit joint"


class OtherFit(Record):
    """Fit of the same rows by the other of the two methods, joint or two-stage."""

    name: str
    coefficients: tuple[tuple[float, ...], ...]  #: m, b (mm), e, f of each axis.
    difference: tuple[float, ...]
    """Mean absolute difference of the two fits' sizes over the rows, as a share of the true size, of each axis."""


def learn_two_stage(table: SizeTable, *, recipe: Recipe, rng: np.random.Generator) -> SizeCalibration:
    r"""Learn Eq 6 in the two stages of the paper's section 2.4, with a bootstrap for its uncertainty.

    Stage one is least squares of :math:`d` on :math:`\sigma` in the rows at one diameter depth, stage two of
    :math:`\ln\Delta\sigma` on :math:`\ln a` in all rows whose lump has a row at one diameter depth:

    .. math:: d = m\,\sigma + b \; (h/d = 1), \qquad \ln\Delta\sigma = \ln e + f \ln a.

    The joint posterior takes m and b from all rows instead, on the scale of ln d, where a row counts the less the
    fainter its map is. Both agree where Eq 6 holds; decision record 0098 gives how far they part where it does not.
    `BadDataError` when rows are too few, do not vary, have no depths, or not three diameters at h/d 1.
    """
    return _learn_axes(table, recipe, lambda data: _learn_in_two_stages(data, rng))


def axis_in_two_stages(data: AxisRows) -> AxisCalibration:
    """Eq 6 fitted in two stages to the rows themselves: a single draw, as `axis_at_mode` of the joint posterior."""
    return data.calibration(_two_stages(data, np.ones((1, len(data.d_mm)))))


def other_fit(calibration: SizeCalibration, table: SizeTable) -> OtherFit | None:
    """Fit the same table the other way; None where that fit does not exist, as without depths."""
    name = "joint" if calibration.in_two_stages else "two-stage"
    fit = axis_at_mode if name == "joint" else axis_in_two_stages
    rows = axis_rows(table)
    try:
        others = [fit(data) for data in rows]
    except BadDataError:
        return None
    differences = []
    for axis, other, data in zip((calibration.x, calibration.y), others, rows, strict=False):
        ours, theirs = (one.size_mm(data.sigma_mm, data.amplitude) for one in (axis, other))
        differences.append(float(np.mean(np.abs(ours - theirs) / data.d_mm)))
    return OtherFit(name, tuple(tuple(one.draws[0, :4].tolist()) for one in others), tuple(differences))


def _learn_in_two_stages(data: AxisRows, rng: np.random.Generator) -> AxisCalibration:
    fitted = axis_in_two_stages(data)
    draws = _two_stages(data, _resampled(data, rng))
    _widen_for_few_clusters(draws, diameters=len(np.unique(data.d_mm)))
    # the estimate is the fit to the table itself, not the mean over its resamples
    scaled = [2, 4]
    draws[:, scaled] *= fitted.draws[0, scaled] / draws[:, scaled].mean(axis=0)
    shifted = [0, 1, 3, 5]
    draws[:, shifted] += fitted.draws[0, shifted] - draws[:, shifted].mean(axis=0)
    axis = data.calibration(draws)
    level, known = _stage_rows(data)
    rows = {"level_rows": float(level.sum()), "width_change_rows": float(known.sum())}
    return replace(axis, fit={**agreement(axis, data), "e_identified": 1.0, "two_stage": 1.0, **rows})


def _widen_for_few_clusters(draws: FloatArray, *, diameters: int) -> None:
    """Widen the draws of m, b, ln e and f about their means, for few clusters.

    Resamples of g clusters vary by (g - 1) / g too little, and normal intervals of few clusters hold too seldom. A
    Student t with g - 1 degrees of freedom mends that (Cameron & Miller 2015, J. Human Resources 50:317, section VI).
    """
    g = diameters
    factor = np.sqrt(g / (g - 1)) * stdtrit(g - 1, 0.95) / ndtri(0.95)
    draws[:, 2] = np.log(draws[:, 2])
    middle = draws[:, :4].mean(axis=0)
    draws[:, :4] = middle + factor * (draws[:, :4] - middle)
    draws[:, 2] = np.exp(draws[:, 2])


def _stage_rows(data: AxisRows) -> tuple[BoolArray, BoolArray]:
    """Masks of the rows of stage one (h/d = 1) and of stage two (known width changes)."""
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
    """(draws, rows) bootstrap counts of the rows, resampled by diameter.

    Cluster bootstrap (Davison & Hinkley 1997, section 3.8). The depths of a lump share the width that their changes
    refer to, and lumps of one diameter that differ in stiffness have almost one map. Resamples with fewer than three
    diameters at one diameter depth (two, where the table has three) are drawn anew: a line through two neighbours may
    have any slope.
    """
    level, _ = _stage_rows(data)
    names, group = np.unique(data.d_mm, return_inverse=True)
    usable = np.isin(names, data.d_mm[level])
    least = min(LEAST_DIAMETERS, int(usable.sum()) - 1)
    drawn: list[FloatArray] = []
    while len(drawn) < DRAWS_KEPT:
        counts = np.bincount(rng.integers(0, len(names), len(names)), minlength=len(names)).astype(np.float64)
        if np.sum((counts > 0) & usable) >= least:
            drawn.append(counts)
    return np.array(drawn)[:, group]


def _two_stages(data: AxisRows, counts: FloatArray) -> FloatArray:
    """(k, 6) coefficients of (k, rows) resamples, with s and g of ln d about them by maximum likelihood on a grid."""
    level, known = _stage_rows(data)
    assert data.width_change is not None
    m, b = _line(data.sigma_mm[level], data.d_mm[level], counts[:, level])
    f, log_e = _line(np.log(data.amplitude[known]), np.log(data.width_change[known]), counts[:, known])
    zeros = np.zeros_like(m)
    coefficients = np.stack([m, b, np.exp(log_e), f, zeros, zeros], axis=1)
    axis = data.calibration(coefficients)
    error = log_error(axis.size_mm(data.sigma_mm, data.amplitude, draws=coefficients[:, None, :]), data.d_mm)
    log_a = np.log(data.amplitude / data.centre[0])
    share = counts / counts.sum(axis=1, keepdims=True)
    variance = (share * error**2) @ np.exp(2.0 * np.outer(log_a, _SLOPES))
    best = np.argmin(0.5 * np.log(variance) - np.outer(share @ log_a, _SLOPES), axis=1)
    coefficients[:, 4] = np.sqrt(np.maximum(variance[np.arange(len(best)), best], 1e-12))
    coefficients[:, 5] = _SLOPES[best]
    return coefficients


def _line(x: FloatArray, y: FloatArray, counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) slope and intercept of least squares of y on x with (k, n) weights."""
    total = counts.sum(axis=1)
    x_mean, y_mean = counts @ x / total, counts @ y / total
    dx = x - x_mean[:, None]
    slope = np.sum(counts * dx * (y - y_mean[:, None]), axis=1) / np.sum(counts * dx**2, axis=1)
    return slope, y_mean - slope * x_mean


# --- Cross-validation of a size calibration's form over the geometries of a study.

LEAST_GEOMETRIES = 8  #: A quadratic has six coefficients, and one geometry is missing from each fit.

FitAxis = Callable[[AxisRows], AxisCalibration]
"""Eq 6 from the rows of one axis: `axis_at_mode` or `axis_in_two_stages`."""


def cross_validate(
    table: SizeTable, *, least_stiffness_ratio: float = 0.0, fit: FitAxis = axis_at_mode
) -> LeftOutErrors | None:
    """Cross-validated errors of Eq 6 and of a log-quadratic, leaving out each geometry in turn.

    None unless the table has `StudyCases` in at least eight geometries. Softer lumps take no part; a least ratio of 0
    is `LEAST_HARD_RATIO`. Without one of the geometries Eq 6 may have no mode (`NotConvergedError`), or the two-stage
    fit too few diameters (`BadDataError`).

    A geometry is one seat, diameter and h/d. All stiffnesses of it go out together: they differ so little that one
    would tell the others' size. Where a lump's case at one diameter depth is out, so are the width changes against it.
    By both widths the size of Eq 6 is the geometric mean of those by each; the quadratic, of least squares, takes the
    geometric mean of the widths.
    """
    least, cases = least_stiffness_ratio or LEAST_HARD_RATIO, table.cases
    if cases is None:
        return None
    hard = (cases.stiffness_ratio >= least) & (table.amplitude > 0)
    table, cases = rows_of(table, hard), rows_of(cases, hard)
    geometry = geometry_numbers(table.d_mm, cases)
    number = int(geometry.max(initial=-1)) + 1
    if number < LEAST_GEOMETRIES:
        return None
    widths = {"x": table.sigma_x_mm} if table.sigma_y_mm is None else {"x": table.sigma_x_mm, "y": table.sigma_y_mm}
    both = np.exp(np.mean([np.log(sigma) for sigma in widths.values()], axis=0))
    eq6, quadratic = ({name: np.empty(len(geometry)) for name in (*widths, "both")} for _ in range(2))
    for out in (geometry == i for i in range(number)):  # the sizes of each geometry, predicted from the others
        for name, sigma in (widths | {"both": both}).items():
            quadratic[name][out] = _predict_by_quadratic(table, sigma, ~out)[out]
            if name in widths:
                eq6[name][out] = _predict_by_eq6(table, cases, sigma, ~out, fit)[out]
    eq6["both"] = np.exp(np.mean([np.log(np.maximum(eq6[name], 1e-3)) for name in widths], axis=0))
    errors = [
        {
            name: float(np.mean(np.abs(size / table.d_mm - 1.0)))
            for name, size in sizes.items()
            if len(widths) > 1 or name == "both"
        }
        for sizes in (eq6, quadratic)
    ]
    return LeftOutErrors(len(geometry), number, least, *errors)


def geometry_numbers(d_mm: FloatArray, cases: StudyCases) -> IndexArray:
    """(n,) index of each row's geometry: one seat, diameter and h/d."""
    names = list(zip(cases.seat, d_mm.tolist(), cases.depth_ratio.tolist(), strict=True))
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.intp)


def _predict_by_eq6(
    table: SizeTable, cases: StudyCases, sigma_mm: FloatArray, training: BoolArray, fit: FitAxis
) -> FloatArray:
    """(n,) sizes in mm by Eq 6 fitted to the training rows."""
    d_mm, depth = table.d_mm[training], cases.depth_ratio[training]
    change = width_changes(sigma_mm[training], depth_ratio=depth, group=rows_of(cases, training).lumps(d_mm))
    try:
        axis = fit(AxisRows(d_mm, table.amplitude[training], sigma_mm[training], change, depth))
    except NotConvergedError:
        out = int(np.flatnonzero(~training)[0])
        where = f"{cases.seat[out]}, d {table.d_mm[out]:g} mm, h/d {cases.depth_ratio[out]:g}"
        raise NotConvergedError(f"Eq 6 has no mode without the geometry {where}") from None
    return axis.size_mm(sigma_mm, table.amplitude)


def _predict_by_quadratic(table: SizeTable, sigma_mm: FloatArray, training: BoolArray) -> FloatArray:
    """(n,) sizes in mm by least squares of ln d on a quadratic in ln a and ln sigma, in the training rows."""
    u, v = np.log(table.amplitude), np.log(sigma_mm)
    terms = monomials((u - u.mean(), v - v.mean()), powers(2))
    coefficients = np.linalg.lstsq(terms[training], np.log(table.d_mm[training]), rcond=None)[0]
    return np.asarray(np.exp(terms @ coefficients))
