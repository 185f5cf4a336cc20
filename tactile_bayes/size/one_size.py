r"""Whether maps can be of one size, and their masses at one place: tests of heterogeneity.

Map i gives :math:`g_i = m + E_i`, :math:`E_i \sim N(0, s_i^2 + \tau^2)`, as in `pooling`. Given tau, Cochran's
:math:`Q = \sum w_i (g_i - \bar g)^2` with :math:`w_i = 1 / (s_i^2 + \tau^2)` follows :math:`\chi^2_{k-1}`; the
probability of a Q as large or larger is averaged over what is known of tau before these maps. It is not learned from
them: two maps that contradict each other would make any difference likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import REGISTRATION_MM
from tactile_bayes.size.between_maps import BetweenMaps

if TYPE_CHECKING:
    from tactile_bayes.size.same_mass import Place

LEAST_PROBABILITY: Final = 0.01
"""Below it maps are not of one size, or of one place: one pool in a hundred is refused though it is."""
EXAM_SD: Final = 0.05
"""SD of ln d between exams of one mass, where a site does not tell it: of the exams of two simulators (record 0129)."""


def spread_tested(known: BetweenMaps | None) -> BetweenMaps:
    """The spread between exams that a test supposes: the site's or a stated one, else `EXAM_SD`."""
    return BetweenMaps(EXAM_SD, 0.0) if known is None else known


def one_size_probability(centre: FloatArray, noise: FloatArray, between: BetweenMaps) -> float:
    """Probability that maps of one mass come out as far apart in size or farther.

    Parameters
    ----------
    centre, noise : (k,) arrays
        Mean and variance of each map's log size.
    between
        What is known of the spread between exams besides these maps.

    Notes
    -----
    Cochran (1954), Biometrics 10, 101; DerSimonian and Laird (1986), Controlled Clinical Trials 7, 177.
    """
    if len(centre) < 2:
        return 1.0
    tau, prior = between.grid, between.density(np.zeros(1), np.zeros(1))
    weight = 1.0 / (noise[:, None] + tau**2)
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    q = np.sum(weight * (centre[:, None] - mean) ** 2, axis=0)
    return float(prior @ _above(q, len(centre) - 1))


def one_size_of(log_sizes: Sequence[FloatArray], known: BetweenMaps | None) -> float:
    """`one_size_probability` of maps by the draws of each one's log size."""
    centre, noise = (np.array([of(one) for one in log_sizes]) for of in (np.nanmean, np.nanvar))
    return one_size_probability(centre, noise, spread_tested(known))


def one_place_probability(places: Sequence[Place], *, registration_mm: float = REGISTRATION_MM) -> float:
    r"""Probability that the places of one mass come out as far apart or farther.

    Parameters
    ----------
    places
        Of the maps, by landmarks.
    registration_mm
        SD each way of the distance of one mass between two exams, by posture and landmarks.

    Notes
    -----
    As `one_size_probability` in the plane, with :math:`S_i = C_i + s^2 I / 2`: for two places it is
    `same_mass.apart`'s probability.
    """
    if len(places) < 2:
        return 1.0
    centres = np.stack([one.centre_mm for one in places])
    weights = np.linalg.inv(np.stack([one.covariance_mm2 + 0.5 * registration_mm**2 * np.eye(2) for one in places]))
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("kij,kj->i", weights, centres))
    q = float(np.einsum("ki,kij,kj->", centres - mean, weights, centres - mean))
    return float(_above(np.array(q), 2 * (len(places) - 1)))


def _above(q: FloatArray, degrees: int) -> FloatArray:
    """Probability that a chi-squared variable is above q."""
    from scipy.special import gammaincc

    return np.asarray(gammaincc(0.5 * degrees, 0.5 * q))
