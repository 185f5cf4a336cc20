"""Lin's concordance correlation: precision and accuracy about the line of identity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tactile_bayes.trial.jackknife import UndefinedError
from tactile_bayes.trial.lines import all_equal
from tactile_bayes.trial.readings import FloatArray


@dataclass(frozen=True, slots=True)
class Concordance:
    """Concordance coefficient and its parts.

    Attributes
    ----------
    coefficient
        Lin's, -1 to 1: `pearson_r` times `bias_correction`.
    bias_correction
        C_b, above 0 to 1: 1 when means and standard deviations agree.
    scale_shift
        SD of y over that of x.
    location_shift
        Mean of y less that of x, over the geometric mean of the SDs (divisor n).
    interval
        By Fisher's z; None for fewer than 4 pairs or a perfect or uncorrelated sample.
    """

    coefficient: float
    pearson_r: float
    bias_correction: float
    scale_shift: float
    location_shift: float
    interval: tuple[float, float] | None


def concordance(x: FloatArray, y: FloatArray, *, confidence: float = 0.95) -> Concordance:
    r"""Concordance of y with x, as if the pairs were independent.

    Notes
    -----
    .. math:: \rho_c = \frac{2 s_{xy}}{s_x^2 + s_y^2 + (\bar y - \bar x)^2}

    with divisor n throughout: Lin (1989), Biometrics 45, 255; the variance as corrected in Lin (2000), Biometrics 56,
    324, with n - 2.

    Raises
    ------
    UndefinedError
        When x or y does not vary.
    """
    n = len(x)
    if n < 2 or all_equal(x) or all_equal(y):
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
        interval=_fisher(rho, r, shift, n, confidence),
    )


def _fisher(rho: float, r: float, shift: float, n: int, confidence: float) -> tuple[float, float] | None:
    from scipy.special import ndtri

    if n < 4 or r == 0 or abs(rho) >= 1:
        return None
    spread = (1 - r**2) * rho**2 * (1 - rho**2) / r**2 + 2 * rho**3 * (1 - rho) * shift**2 / r
    variance = (spread - 0.5 * rho**4 * shift**4 / r**2) / (n - 2)
    if variance <= 0:
        return None
    reach = float(ndtri(0.5 + 0.5 * confidence)) * math.sqrt(variance) / (1 - rho**2)
    return math.tanh(math.atanh(rho) - reach), math.tanh(math.atanh(rho) + reach)
