"""A mixture of Gaussians fitted to weighted points: the second round of importance sampling where one was not enough.

Incremental mixture importance sampling: a Gaussian goes where the largest weight is, as wide as the points about it,
and its points join the others. It finds a second mode, a curved ridge or a skewed flank, where one Gaussian has too
little.

References
----------
Raftery & Bao (2010), Biometrics 66:1162, section 3; Hesterberg (1995), Technometrics 37:185 (defensive mixtures).
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.laplace import LogDensity
from tactile_bayes.inference.pareto import smooth_weights
from tactile_bayes.inference.proposal import Gaussians, Proposal

ADDED = 256
"""Points of each Gaussian added, and points that its width is taken from."""
MOST_ADDED = 32
ENOUGH = 0.75
"""Share of effective points at which no more Gaussians are added, if the weights' tail is light as well."""
LIGHT_TAIL = 0.3
"""Pareto shape of weights that more points will hardly show to be heavier."""
LEAST_VARIANCE = 1e-6
"""Of a Gaussian in any direction, over that of all the points: points may lie in a plane."""


def fitted_gaussians(
    log_density: LogDensity,
    first: Proposal,
    theta: FloatArray,
    log_target: FloatArray,
    *,
    rng: np.random.Generator,
) -> tuple[Gaussians, int]:
    """Gaussians whose mixture resembles a density, from points of another proposal.

    Parameters
    ----------
    log_density
        Vectorised: (m, p) to (m,).
    first
        The proposal that the points come from.
    theta, log_target : (n, p), (n,) arrays
        The points, and the log density there.

    Returns
    -------
    gaussians
        The first of them is a defensive one: mean and covariance of all the weighted points.
    evaluations
        Densities asked for.
    """
    # a point's share: over all the proposals, their number of points times their density there
    n, log_share = len(theta), first.log_density(theta) + np.log(len(theta))
    weight, _ = smooth_weights(log_target - log_share)
    mean = weight @ theta
    whole = _covariance(theta, weight, mean)
    found = Gaussians.one(mean, whole)
    means, covariances = [mean], [whole]
    for number in range(MOST_ADDED):
        weight, shape = smooth_weights(log_target - log_share)
        if 1.0 / np.sum(weight**2) > ENOUGH * len(theta) and shape <= LIGHT_TAIL:
            break
        centre = theta[np.argmax(log_target - log_share)]
        added = Gaussians.one(centre, _covariance_about(theta, weight, centre, whole))
        points = centre + rng.standard_normal((ADDED, len(centre))) @ np.linalg.cholesky(added.covariance[0]).T
        log_share = np.logaddexp(log_share, np.log(ADDED) + added.log_density(theta))
        means.append(centre)
        covariances.append(added.covariance[0])
        earlier = Gaussians(np.full(number + 1, 1.0 / (number + 1)), np.array(means[1:]), np.array(covariances[1:]))
        there = np.log(ADDED * (number + 1)) + earlier.log_density(points)
        log_share = np.concatenate([log_share, np.logaddexp(np.log(n) + first.log_density(points), there)])
        theta, log_target = np.concatenate([theta, points]), np.concatenate([log_target, log_density(points)])
        size = np.array([n, *[ADDED] * (number + 1)], dtype=np.float64)
        found = Gaussians(size / size.sum(), np.array(means), np.array(covariances))
    return found, ADDED * (len(found) - 1)


def _covariance(theta: FloatArray, weight: FloatArray, centre: FloatArray) -> FloatArray:
    off = theta - centre
    return np.asarray((weight[:, None] * off).T @ off)


def _covariance_about(theta: FloatArray, weight: FloatArray, centre: FloatArray, whole: FloatArray) -> FloatArray:
    """Covariance of the nearest points about one, weighted half by their weights and half alike."""
    z = np.linalg.solve(np.linalg.cholesky(whole), (theta - centre).T)
    near = np.argsort(np.sum(z**2, axis=0), kind="stable")[:ADDED]
    mixed = weight[near] + 1.0 / len(theta)
    return _covariance(theta[near], mixed / mixed.sum(), centre) + LEAST_VARIANCE * whole
