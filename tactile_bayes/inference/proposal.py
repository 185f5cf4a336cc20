"""The density that importance sampling draws from: one Gaussian or a mixture of several, their tails bent outwards."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """A mixture of Gaussians.

    Parameters
    ----------
    weight : (h,) array
        Sum 1.
    mean, covariance : (h, p), (h, p, p) arrays
    """

    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def one(cls, mean: FloatArray, covariance: FloatArray) -> Gaussians:
        """A single Gaussian."""
        return cls(np.ones(1), mean[None], covariance[None])

    def __len__(self) -> int:
        return len(self.weight)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(m,) log density at (m, p) points, normalised."""
        parts = []
        for weight, mean, covariance in zip(self.weight, self.mean, self.covariance, strict=True):
            z = np.linalg.solve(np.linalg.cholesky(covariance), (theta - mean).T)
            volume = float(np.linalg.slogdet(2.0 * np.pi * covariance)[1])
            parts.append(np.log(weight) - 0.5 * np.sum(z**2, axis=0) - 0.5 * volume)
        return np.asarray(np.logaddexp.reduce(parts, axis=0))

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """(p,) mean and (p, p) covariance of the whole."""
        mean = self.weight @ self.mean
        off = self.mean - mean
        return mean, np.asarray(
            np.einsum("h,hpq->pq", self.weight, self.covariance) + (self.weight[:, None] * off).T @ off
        )

    def given(self, last: FloatArray) -> Gaussians:
        """The mixture of the first parameters, the last ones known: (j,) values."""
        k = self.mean.shape[1] - len(last)
        across = np.linalg.solve(self.covariance[:, k:, k:], self.covariance[:, k:, :k])
        mean = self.mean[:, :k] + np.einsum("hj,hjk->hk", last - self.mean[:, k:], across)
        covariance = self.covariance[:, :k, :k] - self.covariance[:, :k, k:] @ across
        at_last = [
            Gaussians.one(mean[k:], covariance[k:, k:]).log_density(last[None])[0]
            for mean, covariance in zip(self.mean, self.covariance, strict=True)
        ]
        log_weight = np.log(self.weight) + at_last
        return Gaussians(np.exp(log_weight - np.logaddexp.reduce(log_weight)), mean, covariance)

    def widest(self, covariance: FloatArray) -> float:
        """Largest variance of any of them in any direction, over that of `covariance` in the same direction."""
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        return float(np.linalg.eigvalsh(whiten @ self.covariance @ whiten.T).max())


class Proposal:
    """Bent Gaussians: normal coordinates z become sinh(b z) / b, normal in the middle and log-normal outside.

    Parameters
    ----------
    gaussians
        What is bent.
    stretch
        The bend b.
    """

    def __init__(self, gaussians: Gaussians, stretch: float) -> None:
        self._gaussians, self._stretch = gaussians, stretch
        self._roots = np.linalg.cholesky(gaussians.covariance)
        self._log_det = np.log(np.diagonal(self._roots, axis1=1, axis2=2)).sum(axis=1)

    @property
    def dimension(self) -> int:
        """Uniform coordinates that a point takes: one for each parameter, and the last one to choose a Gaussian."""
        return int(self._gaussians.mean.shape[1]) + (len(self._gaussians) > 1)

    def points(self, uniform: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (..., p) and their log densities (...) for (..., dimension) uniform coordinates."""
        mean, b = self._gaussians.mean, self._stretch
        p = mean.shape[1]
        z = normal_quantile(uniform[..., :p])
        bent = np.sinh(b * z) / b
        if len(mean) == 1:
            return mean[0] + bent @ self._roots[0].T, self._log_bent(z) - self._log_det[0]
        chosen = np.searchsorted(np.cumsum(self._gaussians.weight)[:-1], uniform[..., p])
        theta = np.empty_like(bent)
        for h, root in enumerate(self._roots):
            theta[chosen == h] = mean[h] + bent[chosen == h] @ root.T
        return theta, self.log_density(theta)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """(...) log density at (..., p) points."""
        total = np.full(theta.shape[:-1], -np.inf)
        for h, root in enumerate(self._roots):
            bent = (theta - self._gaussians.mean[h]) @ np.linalg.inv(root).T
            z = np.arcsinh(self._stretch * bent) / self._stretch
            total = np.logaddexp(total, np.log(self._gaussians.weight[h]) + self._log_bent(z) - self._log_det[h])
        return total

    def _log_bent(self, z: FloatArray) -> FloatArray:
        parts = -0.5 * z**2 - np.log(np.cosh(self._stretch * z)) - 0.5 * np.log(2 * np.pi)
        return np.asarray(parts.sum(axis=-1))
