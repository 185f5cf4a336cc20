"""Log posterior density of a least-squares model, with the noise scale integrated out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.cache import Solved
from tactile_bayes.inference.least_squares import ModelFunction
from tactile_bayes.posterior.lump.bump import block_size
from tactile_bayes.posterior.white.residuals import ErrorModel
from tactile_bayes.records import dataclass

LogPrior = Callable[[FloatArray], FloatArray]


def flat_prior(theta: FloatArray) -> FloatArray:
    """(m,) zeros: the improper flat prior of certified regression data sets."""
    return np.zeros(theta.shape[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    r"""Posterior density of a model's parameters, up to a constant.

    Parameters
    ----------
    predict
        (m, p) parameter vectors to (m, k) predictions.
    data, weight : (k,) arrays
        Weights are inverse variances up to a common factor.
    log_prior
        (m, p) to (m,).
    errors
        Size, correlation and degrees of freedom of the noise.
    sse_min
        Weighted sum of squares at the least-squares estimate.

    Notes
    -----
    With independent errors and the Jeffreys prior on their scale the noise integrates out to
    :math:`\mathrm{SSE}(\theta)^{-k/2}`. Correlated errors divide the log-likelihood by the inflation c and leave
    :math:`\nu` effective degrees of freedom:
    :math:`[1 + \Delta\mathrm{SSE} / (c\,\nu s^2)]^{-(\nu + p)/2}`, which is the former for c = 1 and nu = k - p.
    """

    predict: ModelFunction
    data: FloatArray
    weight: FloatArray
    log_prior: LogPrior
    errors: ErrorModel
    sse_min: float
    dimension: int

    def excess(self, theta: FloatArray) -> FloatArray:
        """(m,) rise of the weighted sum of squares above its minimum, divided by the inflation."""
        size = block_size(len(self.data))
        sse = np.concatenate([self._sse(theta[i : i + size]) for i in range(0, len(theta), size)])
        rise = np.clip(sse - self.sse_min, 0.0, None) / self.errors.inflation
        return np.where(np.isfinite(rise), rise, np.inf)

    def _sse(self, theta: FloatArray) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):
            off = self.data - self.predict(theta)
            off *= off
            return np.asarray(off @ self.weight)

    def __call__(self, theta: FloatArray) -> FloatArray:
        """(m,) log density of (m, p) parameter vectors; -inf where the model overflows."""
        return self._at(theta, self.excess(theta))

    def solved_density(self, theta: FloatArray, solved: Solved) -> FloatArray:
        """As the density, storing the `excess` at these points in `solved` for `draw_noise_sd`."""
        excess = self.excess(theta)
        solved.add(theta, (excess,))
        return self._at(theta, excess)

    def _at(self, theta: FloatArray, excess: FloatArray) -> FloatArray:
        variance = self.errors.dof * self.errors.noise_sd**2
        exponent = 0.5 * (self.errors.dof + self.dimension)
        likelihood = -exponent * np.log1p(excess / variance)
        total = likelihood + self.log_prior(theta)
        return np.where(np.isfinite(total), total, -np.inf)

    def draw_noise_sd(self, excess: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(m,) draws of the noise scale given `excess` (m,): a scaled inverse chi, exact under this model."""
        chi2 = rng.chisquare(self.errors.dof + self.dimension, size=len(excess))
        return np.sqrt((self.errors.dof * self.errors.noise_sd**2 + excess) / chi2)
