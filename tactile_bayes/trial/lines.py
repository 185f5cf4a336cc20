"""Straight lines between two methods: least squares, Deming and weighted Deming regression.

x is the reference and y the method under test. The Deming lines take `error_ratio`, the variance of the error of x over
that of y, as Linnet (1990) does; 1 is orthogonal regression, and 0 and infinity are the two least-squares lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.readings import FloatArray

MAX_ITERATIONS = 30
THRESHOLD = 1e-6
# Differences below this share of the numbers themselves are rounding, as between averages of equal replicates.
EQUAL = 1e-12


@dataclass(frozen=True, slots=True)
class Line:
    """y = intercept + slope x, fitted to n pairs.

    Attributes
    ----------
    intercept_se, slope_se
        Analytic standard errors, as if the pairs were independent; None where there is no formula.
    """

    intercept: float
    slope: float
    n: int
    intercept_se: float | None = None
    slope_se: float | None = None

    def intervals(self, *, confidence: float) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Analytic intervals of intercept and slope, by Student's t with n - 2 degrees of freedom."""
        if self.intercept_se is None or self.slope_se is None:
            return None
        t = student(self.n - 2, confidence=confidence)
        return _about(self.intercept, t * self.intercept_se), _about(self.slope, t * self.slope_se)


def least_squares(x: FloatArray, y: FloatArray, *, weights: FloatArray | None = None) -> Line:
    """Fit by least vertical squares, weighted when asked (1/x^2 for a constant relative error).

    Raises
    ------
    UndefinedError
        With fewer than two different x.
    """
    _need_pairs(x, 2)
    w = np.ones_like(x) if weights is None else weights
    mean_x, mean_y, u, _, p = _moments(x, y, w)
    if u == 0:
        raise UndefinedError("all reference values are equal, so no line is determined")
    slope = p / u
    residuals = y - mean_y - slope * (x - mean_x)
    if len(x) < 3:
        return Line(mean_y - slope * mean_x, slope, len(x))
    slope_se = math.sqrt(float(w @ residuals**2) / (len(x) - 2) / u)
    intercept_se = slope_se * math.sqrt(float(w @ x**2 / w.sum()))
    return Line(mean_y - slope * mean_x, slope, len(x), intercept_se, slope_se)


def deming(x: FloatArray, y: FloatArray, *, error_ratio: float = 1.0) -> Line:
    r"""Fit a Deming line: both methods err, each with a constant SD.

    Notes
    -----
    With sums of squares u, q of x, y and of products p, and the error ratio :math:`\lambda`,

    .. math:: b = \frac{\lambda q - u + \sqrt{(u - \lambda q)^2 + 4 \lambda p^2}}{2 \lambda p}

    Linnet (1990), Stat. Med. 9, 1463. The analytic standard error of the slope,
    :math:`b \sqrt{(1 - r^2)/r^2/(n - 2)}`, is that of Strike (1991), Statistical Methods in Laboratory Medicine.

    Raises
    ------
    UndefinedError
        Without spread, or where every direction fits equally well.
    """
    _need_ratio(error_ratio)
    _need_pairs(x, 2)
    mean_x, mean_y, u, q, p = _moments(x, y, np.ones_like(x))
    slope = deming_slope(u, q, p, error_ratio)
    intercept = mean_y - slope * mean_x
    if len(x) < 3 or slope == 0:
        return Line(intercept, slope, len(x))
    r2 = min(1.0, p * p / (u * q))
    slope_se = abs(slope) * math.sqrt((1 - r2) / r2 / (len(x) - 2))
    return Line(intercept, slope, len(x), slope_se * math.sqrt(float(np.mean(x**2))), slope_se)


def weighted_deming(
    x: FloatArray,
    y: FloatArray,
    *,
    error_ratio: float = 1.0,
    max_iterations: int = MAX_ITERATIONS,
    threshold: float = THRESHOLD,
) -> Line:
    r"""Fit a Deming line whose errors grow in proportion to size: weights 1 over the squared fitted size.

    Parameters
    ----------
    x, y : (n,) arrays, above 0
    max_iterations, threshold
        Iterate from the unweighted line until intercept and slope both change by less than `threshold`, in their own
        units, or for so many rounds; the last round counts either way.

    Notes
    -----
    The fitted size is the mean of the two coordinates of the foot, :math:`(\hat x + \lambda \hat y) / (1 + \lambda)`:
    Linnet (1990), and (1993) Clin. Chem. 39, 424. There is no analytic standard error; the jackknife is customary.

    Raises
    ------
    UndefinedError
        When a size is not above 0.
    """
    if not (np.all(x > 0) and np.all(y > 0)):
        raise UndefinedError("weights by size need every size above 0")
    line = deming(x, y, error_ratio=error_ratio)
    intercept, slope = line.intercept, line.slope
    for _ in range(max_iterations):
        weights = _by_size(x, y, intercept, slope, error_ratio)
        mean_x, mean_y, u, q, p = _moments(x, y, weights)
        before = intercept, slope
        slope = deming_slope(u, q, p, error_ratio)
        intercept = mean_y - slope * mean_x
        if abs(slope - before[1]) < threshold and abs(intercept - before[0]) < threshold:
            break
    return Line(intercept, slope, len(x))


def jackknife_errors(
    fit: Callable[[FloatArray, FloatArray], Line], x: FloatArray, y: FloatArray
) -> tuple[float, float]:
    """Standard errors of intercept and slope from leaving out one pair at a time, as laboratory programs report.

    Linnet (1990), (1993): the SD of the pseudo-values over root n; their interval takes Student's t with n - 2 degrees
    of freedom. It is right for independent pairs; masses of one patient are not, so reports use patients instead.
    """
    lines = [fit(np.delete(x, i), np.delete(y, i)) for i in range(len(x))]
    scale = (len(x) - 1) / math.sqrt(len(x))
    intercepts, slopes = np.array([line.intercept for line in lines]), np.array([line.slope for line in lines])
    return scale * float(intercepts.std(ddof=1)), scale * float(slopes.std(ddof=1))


def deming_slope(u: float, q: float, p: float, error_ratio: float) -> float:
    """Deming's slope from sums of squares and products of x and y, by the formula without cancellation.

    Raises
    ------
    UndefinedError
        Where the products are 0 up to rounding and y varies at least as much as x, so that the line is vertical.
    """
    if abs(p) <= EQUAL * math.sqrt(u * q):
        p = 0.0
    d = error_ratio * q - u
    root = math.hypot(d, 2 * math.sqrt(error_ratio) * p)
    if d < 0:
        return 2 * p / (root - d)
    if p == 0:
        raise UndefinedError("the line is vertical or every direction fits equally well")
    return (d + root) / (2 * error_ratio * p)


def all_equal(values: FloatArray) -> bool:
    """Whether (n,) values, n > 0, differ by rounding only."""
    return bool(np.ptp(values) <= EQUAL * np.abs(values).max())


def centred(values: FloatArray, mean: float) -> FloatArray:
    """(n,) values less their mean; zeros where they differ by rounding only."""
    off = values - mean
    return np.zeros_like(off) if all_equal(values) else off


def student(freedom: float, *, confidence: float) -> float:
    """Quantile of Student's t for a two-sided interval."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * confidence))


def _by_size(x: FloatArray, y: FloatArray, intercept: float, slope: float, error_ratio: float) -> FloatArray:
    """1 over the squared size at each pair by the line."""
    off = y - intercept - slope * x
    share = off / (1 + error_ratio * slope**2)
    size = (x + error_ratio * slope * share + error_ratio * (y - share)) / (1 + error_ratio)
    if np.any(size == 0):
        raise UndefinedError("the line gives one pair the size 0, which has no weight")
    return np.asarray(size**-2.0)


def _moments(x: FloatArray, y: FloatArray, w: FloatArray) -> tuple[float, float, float, float, float]:
    """Weighted means of x and y, and sums of squares and products about them."""
    total = w.sum()
    mean_x, mean_y = float(w @ x / total), float(w @ y / total)
    dx, dy = centred(x, mean_x), centred(y, mean_y)
    return mean_x, mean_y, float(w @ dx**2), float(w @ dy**2), float(w @ (dx * dy))


def _need_pairs(x: FloatArray, least: int) -> None:
    if len(x) < least:
        raise UndefinedError(f"a line needs at least {least} masses (found {len(x)})")


def _need_ratio(error_ratio: float) -> None:
    if not 0 < error_ratio < math.inf:
        raise ValueError(f"error_ratio is {error_ratio}; give a variance of x over that of y, above 0")


def _about(value: float, reach: float) -> tuple[float, float]:
    return value - reach, value + reach
