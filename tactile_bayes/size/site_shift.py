r"""Correction of a calibration over bodies by a site's own lumps of known size.

With p the log of the map's mean width in mm and :math:`p_0` that of the calibration's table,

.. math:: \ln d = g(\text{map}) + c_0 + c_1 (p - p_0) + B + E

g, B and E are the calibration's. :math:`c_0` and :math:`c_1` tell how a site's array, head and technique differ from
the simulation that the calibration was learned from; `size.learn.site_shift` learns them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.presets import INTERVAL
from tactile_bayes.records import dataclass

PARAMETERS = ("c0", "c1")
NO_PROFILE = "the phantoms that correct the calibration have no pressure profile of the head"


@dataclass(frozen=True, slots=True, eq=False)
class SiteShift:
    """Posterior of a site's shift, taken as normal.

    Parameters
    ----------
    centre
        p_0.
    mean, covariance : (2,), (2, 2) arrays
        Of `PARAMETERS`.
    phantoms, maps
        Distinct lumps, and their maps, that it was learned from.
    base
        Name of the calibration that is corrected.
    uses_fat
        Whether the phantoms were sized with the depth of fat; if not, no size with this correction is.
    fit
        Figures of the fit: ``log_width`` (mean p of the phantoms), ``spread_factor``, ``sd_before`` and ``sd_after``.
    cautions
        Why the correction should be looked at, in words.
    left_out
        Phantoms that took no part and why, in words.
    """

    centre: float
    mean: FloatArray
    covariance: FloatArray
    phantoms: int
    maps: int
    base: str = ""
    uses_fat: bool = True
    fit: Mapping[str, float] = field(default_factory=dict)
    cautions: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        k = len(PARAMETERS)
        if self.mean.shape != (k,) or self.covariance.shape != (k, k):
            raise BadDataError(
                f"the site's mean and covariance have shapes {self.mean.shape} and {self.covariance.shape}",
                way_out=f"they must be ({k},) and ({k}, {k})",
            )
        numbers = np.concatenate([[self.centre], self.mean, self.covariance.ravel()])
        if not np.isfinite(numbers).all() or np.linalg.eigvalsh(self.covariance)[0] < -1e-12:
            raise BadDataError("the site's correction is not finite or has no covariance", way_out="learn it anew")

    def log_shift(self, log_width: FloatArray) -> FloatArray:
        """(...,) mean of what is added to ln d for maps with this p."""
        return np.asarray(self.mean[0] + self.mean[1] * (log_width - self.centre))

    def variance(self, log_width: FloatArray) -> FloatArray:
        """(...,) variance of the same."""
        v, c = log_width - self.centre, self.covariance
        return np.asarray(c[0, 0] + 2.0 * v * c[0, 1] + v**2 * c[1, 1])

    def percent(self, log_width: float, *, probability: float = INTERVAL) -> tuple[float, float, float]:
        """Median of the shift at p in percent of d, and the ends of its equal-tailed interval."""
        p = np.array(log_width)
        z = float(normal_quantile(np.array(0.5 + probability / 2)))
        middle, half = float(self.log_shift(p)), float(np.sqrt(self.variance(p))) * z
        low, high = (float(100 * np.expm1(end)) for end in (middle - half, middle + half))
        return float(100 * np.expm1(middle)), low, high

    @property
    def phantoms_log_width(self) -> float:
        """Mean p of the phantoms, where the shift is known best; p_0 where the file does not say."""
        return float(self.fit.get("log_width", self.centre))


def site_log_shift(site: SiteShift | None, log_width: FloatArray) -> FloatArray:
    """(...,) what a site adds to ln d; zero without a correction."""
    return np.zeros_like(log_width) if site is None else site.log_shift(log_width)


def site_variance(site: SiteShift | None, log_width: FloatArray) -> dict[str, FloatArray]:
    """(...,) what a site's uncertainty adds to the variance of ln d, by source; empty without a correction."""
    return {} if site is None else {"site": site.variance(log_width)}
