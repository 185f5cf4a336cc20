"""Lines between two methods: least squares, Deming and Passing-Bablok; and Lin's concordance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.special import ndtri, stdtrit

from tactile_bayes.declarations import Record
from tactile_bayes.trial.figures import Ends, UndefinedError, ratio
from tactile_bayes.trial.readings import FloatArray

# Smaller differences, as a share of the numbers, are rounding: those between averages of equal replicates. Laboratory
# programs take them as ties, too.
EQUAL = 1e-12


class Line(Record):
    """y = intercept + slope x, fitted to n pairs."""

    intercept: float
    slope: float
    n: int
    intercept_se: float | None = None
    slope_se: float | None = None
    """`intercept_se`, `slope_se`: Analytic standard errors, as if the pairs were independent; None where there is no
    formula."""
    stated: tuple[Ends, Ends] | None = None
    """Intervals of intercept and slope where the fit gives them in place of standard errors; infinite for few pairs."""

    def intervals(self, *, confidence: float) -> tuple[Ends, Ends] | None:
        """Analytic intervals of intercept and slope: by Student's t with n - 2 degrees of freedom, or `stated`."""
        if self.intercept_se is None or self.slope_se is None:
            return self.stated
        t = student(self.n - 2, confidence=confidence)
        a, of_a, b, of_b = self.intercept, t * self.intercept_se, self.slope, t * self.slope_se
        return (a - of_a, a + of_a), (b - of_b, b + of_b)


# --- Passing and Bablok's line: the shifted median of the slopes of all pairs of masses.
#
# Conventions, those that laboratories' programs share: the slope of a vertical pair is +90 degrees when Kendall's
# tau is 0 or more and -90 degrees otherwise; coincident pairs are left out; a slope of exactly -1 (+1 for a falling
# line) counts half in the shift; means of two middle slopes are taken between angles.


def passing_bablok(x: FloatArray, y: FloatArray, *, confidence: float = 0.95) -> Line:
    """Fit y on x without assuming a distribution or knowing which method errs more.

    Undefined with fewer than two different points, of more than `MOST_MASSES`, when the middle slope is vertical, or
    when so many slopes are steeper than 45 degrees against the line that the shifted median lies beyond the last.

    Passing & Bablok (1983), J. Clin. Chem. Clin. Biochem. 21, 709, for a line that rises; the mirror image for one that
    falls. The intercept is the median of y - slope x. Slope ends are order statistics at the shifted median -+
    :math:`z\\sqrt{n(n-1)(2n+5)/18}/2`, intercept ends the medians for the two slope ends. When either slope end lies
    beyond the ordered slopes, both ends of both intervals are infinite.
    """
    _require_two_masses(x)
    if len(x) > MOST_MASSES:
        raise UndefinedError(f"the pairs of more than {MOST_MASSES:,} masses are not listed")
    angles, rising = _pair_angles(x, y)
    if not len(angles):
        raise UndefinedError("all points coincide, so no line is determined")
    # angles steeper than 45 degrees against the line, and those at it
    against = -math.pi / 4 if rising else math.pi / 4
    below, not_above = (int(np.searchsorted(angles, against, side=side)) for side in ("left", "right"))
    shift = below + not_above if rising else below + not_above - 2 * len(angles)  # twice that of the median's rank
    if (len(angles) + shift) // 2 + 1 > len(angles) or len(angles) + shift < 1:
        raise UndefinedError("the shifted median lies beyond the slopes: the points neither rise nor fall")
    slope = _slope_at_rank(angles, len(angles) + shift)
    if not abs(slope) < 1e15:
        raise UndefinedError("the middle slope is vertical")
    # slope ends beyond the slopes themselves, or among those of -1 (+1 for a falling line), say nothing of the line
    n = len(x)
    reach = math.floor(float(ndtri(0.5 + 0.5 * confidence)) * math.sqrt(n * (n - 1) * (2 * n + 5) / 18) + 0.5)
    low, high = len(angles) - reach + shift, len(angles) + reach + shift
    slopes = intercepts = (-math.inf, math.inf)
    if (low + 1) // 2 >= 2 * (not_above - below) + 1 and (high + 1) // 2 <= len(angles) - (high % 2 == 0):
        slopes = _slope_at_rank(angles, low), _slope_at_rank(angles, high)
        if all(abs(end) < 1e15 for end in slopes):
            intercepts = float(np.median(y - slopes[1] * x)), float(np.median(y - slopes[0] * x))
    return Line(float(np.median(y - slope * x)), slope, n, stated=(intercepts, slopes))


MOST_MASSES = 10_000  #: Most with a line by Passing and Bablok; their pairs take 0.4 GB.
_AT_ONCE = 256  #: Masses whose pairs with all earlier ones are listed at a time: 10,000 masses have 50 million pairs.


def _pair_angles(x: FloatArray, y: FloatArray) -> tuple[FloatArray, bool]:
    """Ascending angles of all pairs of points that do not coincide, and True if Kendall's tau is 0 or more."""
    angles, tau, number = list[FloatArray](), 0.0, np.arange(len(x))
    for start in range(0, len(x), _AT_ONCE):
        later, earlier = np.nonzero(number[start : start + _AT_ONCE, None] > number)
        later += start
        dx, dy = _difference(x[later], x[earlier]), _difference(y[later], y[earlier])
        tau += float(np.sign(x[later] - x[earlier]) @ np.sign(y[later] - y[earlier]))
        distinct = (dx != 0) | (dy != 0)
        dx, dy = dx[distinct], dy[distinct]
        angles.append(np.where(dx == 0, np.nan, np.arctan(dy / np.where(dx == 0, 1.0, dx))))
    ordered = np.concatenate(angles)
    ordered[np.isnan(ordered)] = math.pi / 2 if tau >= 0 else -math.pi / 2
    at_45 = np.abs(np.abs(ordered) - math.pi / 4) < EQUAL  # but for rounding: 13.3 - 12.1 is not 1.2
    ordered[at_45] = np.copysign(math.pi / 4, ordered[at_45])
    ordered.sort()
    return ordered, tau >= 0


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """a - b, 0 where it is rounding."""
    difference = a - b
    return np.where(np.abs(difference) < EQUAL * (np.abs(a) + np.abs(b)) / 2, 0.0, difference)


def _slope_at_rank(angles: FloatArray, twice_rank: int) -> float:
    """The slope at rank (twice + 1) / 2, counted from 1: one ordered angle, or the middle of two."""
    rank = (twice_rank + 1) // 2
    first = float(angles[rank - 1])
    return math.tan(first if twice_rank % 2 else (first + float(angles[rank])) / 2)


# --- Straight lines between two methods: least squares, Deming and weighted Deming regression.
#
# x is the reference and y the method under test. The Deming lines take `error_ratio`, the variance of the error of
# x over that of y, as Linnet (1990) does; 1 is orthogonal regression, and 0 and infinity are the two least-squares
# lines.


def least_squares(x: FloatArray, y: FloatArray) -> Line:
    """Fit by least vertical squares; undefined with fewer than two different x."""
    _require_two_masses(x)
    mean_x, mean_y, u, _, p = _weighted_moments(x, y, np.ones_like(x))
    if u == 0:
        raise UndefinedError("all reference values are equal, so no line is determined")
    slope = p / u
    residuals = y - mean_y - slope * (x - mean_x)
    if len(x) < 3:
        return Line(mean_y - slope * mean_x, slope, len(x))
    slope_se = math.sqrt(float(residuals @ residuals) / (len(x) - 2) / u)
    intercept_se = slope_se * math.sqrt(float(np.mean(x**2)))
    return Line(mean_y - slope * mean_x, slope, len(x), intercept_se, slope_se)


def deming(x: FloatArray, y: FloatArray, *, error_ratio: float = 1.0) -> Line:
    r"""Fit a Deming line: both methods err, each with a constant SD.

    Undefined without spread, or where every direction fits equally well.

    With sums of squares u, q of x, y and of products p, and the error ratio :math:`\lambda`,

    .. math:: b = \frac{\lambda q - u + \sqrt{(u - \lambda q)^2 + 4 \lambda p^2}}{2 \lambda p}

    Linnet (1990), Stat. Med. 9, 1463. The analytic standard error of the slope,
    :math:`b \sqrt{(1 - r^2)/r^2/(n - 2)}`, is that of Strike (1991), Statistical Methods in Laboratory Medicine.
    """
    if not 0 < error_ratio < math.inf:
        raise ValueError(f"error_ratio is {error_ratio}; give a variance of x over that of y, above 0")
    _require_two_masses(x)
    mean_x, mean_y, u, q, p = _weighted_moments(x, y, np.ones_like(x))
    slope = deming_slope(u, q, p, error_ratio)
    intercept = mean_y - slope * mean_x
    if len(x) < 3 or slope == 0:
        return Line(intercept, slope, len(x))
    r2 = min(1.0, p * p / (u * q))
    slope_se = abs(slope) * math.sqrt((1 - r2) / r2 / (len(x) - 2))
    return Line(intercept, slope, len(x), slope_se * math.sqrt(float(np.mean(x**2))), slope_se)


def weighted_deming(
    x: FloatArray, y: FloatArray, *, error_ratio: float = 1.0, max_iterations: int = 30, threshold: float = 1e-6
) -> Line:
    r"""Fit a Deming line whose errors grow in proportion to size: weights 1 over the squared fitted size.

    Iterated from the unweighted line until intercept and slope both change by less than `threshold`, in their own
    units, or for `max_iterations`.

    The fitted size is the mean of the two coordinates of the foot, :math:`(\hat x + \lambda \hat y) / (1 + \lambda)`:
    Linnet (1990), and (1993) Clin. Chem. 39, 424. There is no analytic standard error; the jackknife is customary.
    """
    line = deming(x, y, error_ratio=error_ratio)
    intercept, slope = line.intercept, line.slope
    for _ in range(max_iterations):
        weights = _size_weights(x, y, intercept, slope, error_ratio)
        mean_x, mean_y, u, q, p = _weighted_moments(x, y, weights)
        previous = intercept, slope
        slope = deming_slope(u, q, p, error_ratio)
        intercept = mean_y - slope * mean_x
        if abs(slope - previous[1]) < threshold and abs(intercept - previous[0]) < threshold:
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


def deming_slopes(u: FloatArray, q: FloatArray, p: FloatArray, *, error_ratio: float) -> FloatArray:
    """Deming's slope from sums of squares and products of x and y, by the formula without cancellation.

    NaN where the products are 0 up to rounding and y varies at least as much as x, so that the line is vertical.
    """
    p = np.where(np.abs(p) <= EQUAL * np.sqrt(u * q), 0.0, p)
    d = error_ratio * q - u
    root = np.hypot(d, 2 * np.sqrt(error_ratio) * p)
    return np.where(d < 0, ratio(2 * p, root - d), ratio(d + root, 2 * error_ratio * p))


def deming_slope(u: float, q: float, p: float, error_ratio: float) -> float:
    """`deming_slopes` of one sample, in floats for speed; undefined where the line is vertical."""
    d, p = error_ratio * q - u, 0.0 if abs(p) <= EQUAL * math.sqrt(u * q) else p
    root = math.hypot(d, 2 * math.sqrt(error_ratio) * p)
    if d < 0:
        return 2 * p / (root - d)
    if p == 0:
        raise UndefinedError("the line is vertical or every direction fits equally well")
    return (d + root) / (2 * error_ratio * p)


def all_equal(values: FloatArray) -> bool:
    """True if (n,) values, n > 0, differ by rounding only."""
    low, high = values.min(), values.max()
    return bool(high - low <= EQUAL * max(abs(low), abs(high)))


def centred(values: FloatArray, mean: float) -> FloatArray:
    """(n,) values less their mean; zeros where they differ by rounding only."""
    off = values - mean
    return np.zeros_like(off) if all_equal(values) else off


def student(freedom: float, *, confidence: float) -> float:
    """Quantile of Student's t for a two-sided interval."""
    return float(stdtrit(freedom, 0.5 + 0.5 * confidence))


def _size_weights(x: FloatArray, y: FloatArray, intercept: float, slope: float, error_ratio: float) -> FloatArray:
    """1 over the squared size at each pair by the line."""
    residual = y - intercept - slope * x
    y_correction = residual / (1 + error_ratio * slope**2)
    size = (x + error_ratio * slope * y_correction + error_ratio * (y - y_correction)) / (1 + error_ratio)
    if np.any(size == 0):
        raise UndefinedError("the line gives one pair the size 0, which has no weight")
    return np.asarray(size**-2.0)


def _weighted_moments(x: FloatArray, y: FloatArray, w: FloatArray) -> tuple[float, float, float, float, float]:
    """Weighted means of x and y, and sums of squares and products about them."""
    total = w.sum()
    mean_x, mean_y = float(w @ x / total), float(w @ y / total)
    dx, dy = centred(x, mean_x), centred(y, mean_y)
    return mean_x, mean_y, float(w @ dx**2), float(w @ dy**2), float(w @ (dx * dy))


def _require_two_masses(x: FloatArray) -> None:
    if len(x) < 2:
        raise UndefinedError(f"a line needs at least 2 masses (found {len(x)})")


# --- Lin's concordance correlation: precision and accuracy about the line of identity.


class Concordance(Record):
    """Concordance coefficient and its parts."""

    coefficient: float  #: Lin's, -1 to 1: `pearson_r` times `bias_correction`.
    pearson_r: float
    bias_correction: float  #: C_b, above 0 to 1: 1 when means and standard deviations agree.
    scale_shift: float  #: SD of y over that of x.
    location_shift: float  #: Mean of y less that of x, over the geometric mean of the SDs (divisor n).
    interval: tuple[float, float] | None
    """By Fisher's z; None for fewer than 4 pairs or a perfect or uncorrelated sample."""


def concordance(x: FloatArray, y: FloatArray, *, confidence: float = 0.95) -> Concordance:
    r"""Concordance of y with x, as if the pairs were independent.

    Undefined when x or y does not vary.

    .. math:: \rho_c = \frac{2 s_{xy}}{s_x^2 + s_y^2 + (\bar y - \bar x)^2}

    with divisor n throughout: Lin (1989), Biometrics 45, 255; the variance as corrected in Lin (2000), Biometrics 56,
    324, with n - 2.
    """
    n = len(x)
    if all_equal(x) or all_equal(y):
        raise UndefinedError("concordance needs sizes and ex-vivo sizes that vary")
    sx2, sy2 = float(np.var(x)), float(np.var(y))
    sxy = float(np.mean((x - x.mean()) * (y - y.mean())))
    r = min(1.0, max(-1.0, sxy / math.sqrt(sx2 * sy2)))
    rho = 2 * sxy / (sx2 + sy2 + float(y.mean() - x.mean()) ** 2)
    shift = float(y.mean() - x.mean()) / (sx2 * sy2) ** 0.25
    scale = math.sqrt(sy2 / sx2)
    return Concordance(
        coefficient=rho,
        pearson_r=r,
        bias_correction=2 / (scale + 1 / scale + shift**2),
        scale_shift=scale,
        location_shift=shift,
        interval=_fisher_interval(rho, r, shift, n, confidence),
    )


def _fisher_interval(rho: float, r: float, shift: float, n: int, confidence: float) -> tuple[float, float] | None:
    if n < 4 or r == 0 or abs(rho) >= 1:
        return None
    spread = (1 - r**2) * rho**2 * (1 - rho**2) / r**2 + 2 * rho**3 * (1 - rho) * shift**2 / r
    variance = (spread - 0.5 * rho**4 * shift**4 / r**2) / (n - 2)
    if variance <= 0:
        return None
    reach = float(ndtri(0.5 + 0.5 * confidence)) * math.sqrt(variance) / (1 - rho**2)
    return math.tanh(math.atanh(rho) - reach), math.tanh(math.atanh(rho) + reach)
