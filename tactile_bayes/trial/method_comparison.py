"""Lines, concordance and limits of agreement of one modality against excision, with intervals over patients."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal, TypeVar

import numpy as np

from tactile_bayes.declarations import UNSET, Meta, UnsetType
from tactile_bayes.trial import limits as bland_altman
from tactile_bayes.trial.figures import (
    Count,
    Ends,
    Figure,
    Figures,
    Reasons,
    Scale,
    Statistic,
    SumStatistic,
    UndefinedError,
    columns,
    fields_of,
    figure,
    method_of,
    ratio,
)
from tactile_bayes.trial.limits import Limits, Trend
from tactile_bayes.trial.lines import (
    Concordance,
    Line,
    PassingBablok,
    centred,
    concordance,
    deming,
    deming_slopes,
    jackknife_errors,
    least_squares,
    passing_bablok,
    weighted_deming,
)
from tactile_bayes.trial.readings import FloatArray, ModalitySizes

# Lines that are not sums are fitted anew without each patient; beyond so many masses that takes too long.
MOST_REFITTED = 300
# Sizes beyond these have squares that double precision does not hold.
_SMALLEST, _LARGEST = 1e-100, 1e100

_T = TypeVar("_T")


Unit = Literal["mm", "log_ratio"]
Against = Literal["on_ex_vivo", "on_mean"]
_Refitted = Ends | None | UnsetType
"""The interval of a figure that has none where there are more than `MOST_REFITTED` masses."""
_LimitMm = Annotated[
    float, Meta(description="Limit of agreement in mm for single readings; the interval is over patients.")
]
_LimitLog = Annotated[
    float,
    Meta(description="Limit of agreement in ln(size / ex vivo) for single readings; the interval is over patients."),
]


class MethodComparison(Figures, kw_only=True):
    """Detected masses as measurements: lines, concordance, limits of agreement, with intervals over patients."""

    masses: Count
    error_ratio: Annotated[float, Meta(gt=0, description="Variance of the ex-vivo error over that of the modality's.")]
    ols_intercept_mm: float | None
    ols_intercept_mm_interval: Ends | None
    ols_slope: float | None
    ols_slope_interval: Ends | None
    deming_intercept_mm: float | None
    deming_intercept_mm_interval: Ends | None
    deming_slope: float | None
    deming_slope_interval: Ends | None
    weighted_deming_intercept_mm: float | None
    weighted_deming_intercept_mm_interval: _Refitted = UNSET
    passing_bablok_intercept_mm: float | None
    passing_bablok_intercept_mm_interval: _Refitted = UNSET
    weighted_deming_slope: float | None
    weighted_deming_slope_interval: _Refitted = UNSET
    passing_bablok_slope: float | None
    passing_bablok_slope_interval: _Refitted = UNSET
    concordance: float | None
    concordance_interval: Ends | None
    difference_mean_mm: float | None
    difference_mean_mm_interval: Ends | None
    difference_sd_mm: float | None
    difference_sd_mm_interval: Ends | None
    limit_low_mm: _LimitMm | None
    limit_low_mm_interval: Ends | None
    limit_high_mm: _LimitMm | None
    limit_high_mm_interval: Ends | None
    limit_low_log_ratio: _LimitLog | None
    limit_low_log_ratio_interval: Ends | None
    limit_high_log_ratio: _LimitLog | None
    limit_high_log_ratio_interval: Ends | None
    reasons: Reasons
    analytic_intervals: Annotated[dict[str, Ends | None], Meta(description="As if masses were independent.")]
    limits: Annotated[
        dict[Unit, Limits],
        Meta(description="Of differences and of logarithms of ratios; of single readings, replicates allowed for."),
    ]
    trends: Annotated[
        dict[Against, Trend], Meta(description="Slope of the differences on the ex-vivo size, and on the mean of both.")
    ]
    concordance_parts: Concordance | None
    errors_grow_with_size: Annotated[
        bool, Meta(description="Errors are likelier proportional to size than constant: limits in mm suit no one size.")
    ]


def compare_methods(sizes: ModalitySizes, *, confidence: float, error_ratio: float = 1.0) -> MethodComparison:
    """Compare one modality's detected sizes with excision."""
    found = sizes.only_detected()
    x, y = found.ex_vivo_mm, found.size_mm
    robust = _Fit(partial(passing_bablok, confidence=float(confidence)))
    figures = _figures(found, confidence=confidence, error_ratio=error_ratio, robust=robust)
    judged, level = len(x) >= 2 and _squarable(x, y), float(confidence)
    return MethodComparison(
        masses=len(x),
        error_ratio=error_ratio,
        **fields_of(figures),
        analytic_intervals=_analytic(found, robust, confidence=level, error_ratio=error_ratio) if judged else {},
        limits=_limits(found, confidence=level) if judged else {},
        trends=_trends(x, y, confidence=level) if judged else {},
        concordance_parts=_or_none(lambda: concordance(x, y, confidence=level)) if judged else None,
        errors_grow_with_size=judged and bland_altman.errors_are_proportional(x, y),
    )


def _figures(found: ModalitySizes, *, confidence: float, error_ratio: float, robust: _Fit) -> dict[str, Figure]:
    figures: dict[str, Figure] = {}
    slope: Scale = "slope" if method_of(confidence) == "corrected" else "linear"
    for name, statistic, scale in _statistics(error_ratio, robust, slope):
        wanted = scale if isinstance(statistic, SumStatistic) or len(found.size_mm) <= MOST_REFITTED else None
        figures[name] = figure(statistic, found, scale=wanted, confidence=confidence, leverage=_squared_distance)
    return figures | bland_altman.figures(found, confidence=confidence)


def _squared_distance(sizes: ModalitySizes) -> FloatArray:
    """(n,) contribution of each ex-vivo size to their variance, the leverage of a mass on a slope."""
    share = sizes.ex_vivo_mm / sizes.ex_vivo_mm.max()
    return np.asarray((share - share.mean()) ** 2)


def _statistics(error_ratio: float, robust: _Fit, slope: Scale) -> list[tuple[str, Statistic, Scale]]:
    """All figures with their names and the scales of their intervals."""
    demings = partial(_deming_slope, error_ratio=error_ratio)
    fits = (("weighted_deming", _Fit(partial(weighted_deming, error_ratio=error_ratio))), ("passing_bablok", robust))
    return [
        ("ols_intercept_mm", SumStatistic(_terms, _intercept_with(_ols_slope), _NO_LINE), "linear"),
        ("ols_slope", SumStatistic(_terms, _ols_slope, _NO_LINE), slope),
        ("deming_intercept_mm", SumStatistic(_terms, _intercept_with(demings), _NO_LINE), "linear"),
        ("deming_slope", SumStatistic(_terms, demings, _NO_LINE), slope),
        *((f"{name}_intercept_mm", fit.part("intercept"), "linear") for name, fit in fits),
        *((f"{name}_slope", fit.part("slope"), slope) for name, fit in fits),
        ("concordance", SumStatistic(_terms, _concordance, "concordance needs sizes that vary"), "fisher"),
        ("difference_mean_mm", SumStatistic(_terms, _bias), "linear"),
        ("difference_sd_mm", SumStatistic(_terms, _sd, "one mass has no spread"), "log"),
    ]


_NO_LINE = "the ex-vivo sizes or the sizes do not vary, so no line is determined"


def _terms(sizes: ModalitySizes) -> FloatArray:
    """1, x, y, x', y', x'x', x'y', y'y' with ' about the means."""
    x, y = sizes.ex_vivo_mm, sizes.size_mm
    if len(x) == 0:
        raise UndefinedError("no mass was detected")
    _need_squares(x, y)
    dx, dy = centred(x, x.mean()), centred(y, y.mean())
    return columns(1.0, x, y, dx, dy, dx * dx, dx * dy, dy * dy)


def _squares(sums: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of squares of x, of y and of products about the means of the masses summed."""
    n, a, b = sums[..., 0], sums[..., 3], sums[..., 4]
    return sums[..., 5] - a * a / n, sums[..., 7] - b * b / n, sums[..., 6] - a * b / n


def _ols_slope(sums: FloatArray) -> FloatArray:
    u, _, p = _squares(sums)
    return ratio(p, u)


def _deming_slope(sums: FloatArray, *, error_ratio: float) -> FloatArray:
    return deming_slopes(*_squares(sums), error_ratio=error_ratio)


def _intercept_with(slope: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    def intercept(sums: FloatArray) -> FloatArray:
        n = sums[..., 0]
        return np.asarray(ratio(sums[..., 2], n) - slope(sums) * ratio(sums[..., 1], n))

    return intercept


def _concordance(sums: FloatArray) -> FloatArray:
    u, q, p = _squares(sums)
    bias = _bias(sums)
    return np.where((u == 0) | (q == 0), np.nan, ratio(2 * p, u + q + sums[..., 0] * bias**2))


def _bias(sums: FloatArray) -> FloatArray:
    return ratio(sums[..., 2] - sums[..., 1], sums[..., 0])


def _sd(sums: FloatArray) -> FloatArray:
    u, q, p = _squares(sums)
    return np.sqrt(np.maximum(ratio(u + q - 2 * p, sums[..., 0] - 1), 0.0))


class _Fit:
    """A line that several figures share, fitted once to the same masses."""

    def __init__(self, fit: Callable[[FloatArray, FloatArray], Line | PassingBablok]) -> None:
        self._fit = fit
        self._last: tuple[ModalitySizes, Line | PassingBablok] | None = None

    def __call__(self, sizes: ModalitySizes) -> Line | PassingBablok:
        if self._last is None or self._last[0] is not sizes:
            _need_squares(sizes.ex_vivo_mm, sizes.size_mm)
            self._last = sizes, self._fit(sizes.ex_vivo_mm, sizes.size_mm)
        return self._last[1]

    def part(self, name: str) -> Statistic:
        """One number of the line as a statistic."""
        return lambda sizes: float(getattr(self(sizes), name))


def _need_squares(x: FloatArray, y: FloatArray) -> None:
    if len(x) and not _squarable(x, y):
        raise UndefinedError("the sizes are too large or too small for double precision")


def _squarable(x: FloatArray, y: FloatArray) -> bool:
    both = np.concatenate([x, y])
    return bool(both.min() > _SMALLEST and both.max() < _LARGEST)


def _analytic(found: ModalitySizes, robust: _Fit, *, confidence: float, error_ratio: float) -> dict[str, Ends | None]:
    x, y = found.ex_vivo_mm, found.size_mm
    weighted = partial(weighted_deming, error_ratio=error_ratio)
    fits: dict[str, Callable[[], Line]] = {
        "ols": lambda: least_squares(x, y),
        "deming": lambda: deming(x, y, error_ratio=error_ratio),
        "weighted_deming": lambda: _with_errors(weighted(x, y), weighted, x, y),
    }
    ends: dict[str, Ends | None] = {}
    for name, fit in fits.items():
        plain = _or_none(fit)
        two = None if plain is None else plain.intervals(confidence=confidence)
        ends[f"{name}_intercept_mm"], ends[f"{name}_slope"] = two or (None, None)
    line = _or_none(lambda: robust(found))
    if isinstance(line, PassingBablok):
        for name, both in (("intercept_mm", line.intercept_interval), ("slope", line.slope_interval)):
            ends[f"passing_bablok_{name}"] = both if np.all(np.isfinite(both)) else None
    agreement = _or_none(lambda: concordance(x, y, confidence=confidence))
    ends["concordance"] = None if agreement is None else agreement.interval
    return ends


def _with_errors(line: Line, fit: Callable[[FloatArray, FloatArray], Line], x: FloatArray, y: FloatArray) -> Line:
    """The line with errors from leaving out one mass at a time, which is usual where no formula exists."""
    if not 3 < len(x) <= MOST_REFITTED:
        return line
    return Line(line.intercept, line.slope, line.n, *jackknife_errors(fit, x, y))


def _limits(found: ModalitySizes, *, confidence: float) -> dict[Unit, Limits]:
    scales: dict[Unit, Callable[[FloatArray], FloatArray]] = {"mm": np.asarray, "log_ratio": np.log}
    x, y, groups = found.ex_vivo_mm, found.size_mm, found.replicates_mm
    if all(len(group) == 1 for group in groups):
        return {unit: bland_altman.limits(on(y) - on(x), confidence=confidence) for unit, on in scales.items()}
    return {
        unit: bland_altman.limits_unlinked(
            [on(e) for e in x[:, None]], [on(one) for one in groups], confidence=confidence
        )
        for unit, on in scales.items()
    }


def _trends(x: FloatArray, y: FloatArray, *, confidence: float) -> dict[Against, Trend]:
    against: dict[Against, FloatArray] = {"on_ex_vivo": x, "on_mean": (x + y) / 2}
    judge = partial(bland_altman.trend, y - x, confidence=confidence)
    found = {name: _or_none(partial(judge, sizes)) for name, sizes in against.items()}
    return {name: one for name, one in found.items() if one is not None}


def _or_none(compute: Callable[[], _T]) -> _T | None:
    try:
        return compute()
    except UndefinedError:
        return None
