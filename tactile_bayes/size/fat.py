"""The depth of fat, the residual over it, and the spread of bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Annotated, Final

import numpy as np
from scipy.special import gammaincc

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Matrix, Vector
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.size.terms import LEARN_ANEW, Above0, Range, Share, check_shapes, monomials, powers

# --- The depth F of the fat-gland boundary under the head: from the head's pressure profile, or what a map leaves of
# it.
#
# Amplitude and width alone leave the lump's seat open: how far it stands out of the gland. Where no lump lies, the
# pressure over the head depends on F, so the profile tells it, by a quadratic learned over the same bodies; its
# error is part of what the calibration was learned with. Without a profile ln F is normal about what amplitude and
# width lead one to expect of it, and sizes are averaged over that.

MOST_LEVERAGE: Final = 1.0
"""A profile is unlike the table's where its leverage exceeds this multiple of the table's largest."""
NODES = np.sqrt(2.0) * np.array([-2.0201828704560856, -0.9585724646138185, 0.0, 0.9585724646138185, 2.0201828704560856])
WEIGHTS = np.array([0.011257411327720688, 0.22207592200561263, 8.0 / 15.0, 0.22207592200561263, 0.011257411327720688])
"""Gauss-Hermite rule of five points for a standard normal (Abramowitz & Stegun 1964, table 25.10)."""


def head_profile(quality: Mapping[str, float]) -> tuple[float, ...] | None:
    """Read `HEAD_PROFILE` from a map's figures; None for a map without one, such as an imported grid."""
    values = tuple(float(quality.get(name, np.nan)) for name in HEAD_PROFILE)
    return values if np.isfinite(values).all() else None


class FatDepth(Record, eq=False):
    """Regression of the ln of the depth of the fat-gland boundary in mm on the head's pressure profile."""

    centre: Annotated[Vector, Meta(description="Of the profile.")]
    scale: Annotated[Vector, Meta(description="Of the profile.")]
    coefficients: Annotated[Vector, Meta(description="Of 1, the scaled profile, and its products.")]
    information_inverse: Annotated[Matrix, Meta(description="For the leverage of a new profile.")]
    most_leverage: Annotated[Above0, Meta(description="Largest in the table.")]
    log_sd: Annotated[Share, Meta(description="How far single exams of the table lie from the truth.")]
    fat_mm: Annotated[Range, Meta(description="Range of the depth in the table.")]
    expected: Annotated[Vector, Meta(description="Of a full quadratic in u and v: w without a profile.")]
    expected_sd: Annotated[Share, Meta(description="Of w about that.")]
    profile: tuple[str, ...] = HEAD_PROFILE

    def __post_init__(self) -> None:
        check_shapes(self, centre=(3,), scale=(3,), coefficients=(10,), information_inverse=(10, 10), expected=(6,))
        if self.profile != HEAD_PROFILE:
            raise BadDataError(f"profile is {', '.join(self.profile)}", way_out=f"give {', '.join(HEAD_PROFILE)}")
        if not (self.scale > 0).all():
            raise BadDataError("a scale of the profile is not above 0", way_out=LEARN_ANEW)

    def terms(self, profile: FloatArray) -> FloatArray:
        """(..., 10) terms of (..., 3) profiles."""
        return profile_terms((profile - self.centre) / self.scale)

    def log_depth(self, profile: FloatArray) -> FloatArray:
        """(...) ln F, F in mm, of (..., 3) profiles."""
        return np.asarray(self.terms(profile) @ self.coefficients)

    def unlike(self, profile: FloatArray) -> FloatArray:
        """(...) leverage over the table's largest; above 1 the profile lies outside the table."""
        x = self.terms(profile)
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.information_inverse, x) / self.most_leverage)

    def without_profile(self, u: FloatArray, v: FloatArray, *, centre: float) -> FloatArray:
        """(5, ...) w at the rule's `NODES`, within the table's range, for w_0 in `centre`."""
        low, high = np.log(self.fat_mm) - centre
        expected = np.clip(monomials((u, v), powers(2)) @ self.expected, low, high)
        return np.asarray(expected + self.expected_sd * NODES.reshape(-1, *([1] * expected.ndim)))

    def of_mass(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float | None, str]:
        """F of a mass in mm from its maps' profiles, of which one is known, or the reason why there is none.

        Profiles unlike the table's are left out; those of one mass are averaged, for its exams share the body.
        """
        like = self._log_depths(profiles)
        if not len(like):
            return None, "the head's pressure profile is unlike any of the calibration's"
        fat_mm, (low, high) = float(np.exp(like.mean())), self.fat_mm
        if not low <= fat_mm <= high:
            return None, f"the fat under the head is {fat_mm:.3g} mm deep (table: {low:.3g} to {high:.3g} mm)"
        return fat_mm, ""

    def apart(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float, float] | None:
        """Least and largest F in mm, where maps differ too much to be of one body.

        None where they agree to three SDs of a difference between two exams, or where fewer than two tell it.
        """
        log_depth = self._log_depths(profiles)
        if len(log_depth) < 2 or np.ptp(log_depth) <= 3.0 * np.sqrt(2.0) * self.log_sd:
            return None
        return float(np.exp(log_depth.min())), float(np.exp(log_depth.max()))

    def _log_depths(self, profiles: Sequence[tuple[float, ...] | None]) -> FloatArray:
        """(n,) ln F of the profiles that resemble the table's."""
        known = np.array([one for one in profiles if one is not None], dtype=np.float64)
        known = known.reshape(-1, len(self.centre))
        return self.log_depth(known[self.unlike(known) <= MOST_LEVERAGE])


def profile_terms(z: FloatArray) -> FloatArray:
    """(..., 10) terms of a full quadratic in (..., 3) values."""
    i, j = np.triu_indices(z.shape[-1])
    return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], axis=-1)


# --- What Eq 6 leaves of a population's sizes, as a Gaussian process about it.
#
# .. math:: h \sim GP(0, k), \quad k(x, x') = s_h^2 \exp\Big(-\tfrac12 \sum_i (x_i - x_i')^2 / l_i^2\Big), \quad
#           x = (u, v, w)
#
# by a subset of regressors (Quinonero-Candela & Rasmussen 2005, sec. 3): with the points U and :math:`K_{UU} = L
# L^T`, :math:`h(x) = s_h\, k(x, U) L^{-T} c`, the weights c being standard normal a priori. Far from all points h
# is 0 and the size is that of Eq 6.

_NUGGET = 1e-6


class Kernel(Record, eq=False, dict=True):
    """Squared exponential kernel between values of u, v and w, and the functions that it gives by its points."""

    points: Annotated[Matrix, Meta(description="u, v and w of the points.")]
    lengths: Annotated[Vector, Meta(description="Length of the kernel along each.")]
    scale: Annotated[float, Meta(gt=0, description="SD of the process before any data.")]

    def __post_init__(self) -> None:
        check_shapes(self, points=(len(self.points), 3), lengths=(3,))
        if not (self.lengths > 0).all():
            raise BadDataError("a length of the residual is not above 0", way_out=LEARN_ANEW)

    @cached_property
    def whitening(self) -> FloatArray:
        """(m, m) s_h L^{-T}, from k(x, U) to the functions."""
        factor = np.linalg.cholesky(self.correlation(self.points) + _NUGGET * np.eye(len(self.points)))
        return np.asarray(self.scale * np.linalg.inv(factor).T)

    def correlation(self, x: FloatArray) -> FloatArray:
        """(..., m) k(x, U) over s_h^2 for (..., 3) values."""
        x, points = x / self.lengths, self.points / self.lengths
        exponent = np.asarray(x @ points.T)
        exponent -= 0.5 * np.sum(points**2, axis=-1)
        exponent -= 0.5 * np.sum(x**2, axis=-1, keepdims=True)
        return np.asarray(np.exp(exponent, out=exponent))

    def functions(self, x: FloatArray) -> FloatArray:
        """(..., m) functions of (..., 3) values, whose weights are standard normal a priori."""
        return np.asarray(self.correlation(x) @ self.whitening)


class Residual(Kernel, eq=False, dict=True):
    """Gaussian process in u, v and w that is added to ln d, with the posterior of its weights."""

    mean: Annotated[Vector, Meta(description="Of the weights.")]
    covariance_factor: Annotated[
        tuple[tuple[float, ...], ...], Meta(description="Rows of the Cholesky factor of the weights' covariance.")
    ]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shapes(self, mean=(len(self.points),))
        wrong = [i + 1 for i, row in enumerate(self.covariance_factor) if len(row) != i + 1]
        if wrong or len(self.covariance_factor) != len(self.points):
            what = f"row {wrong[0]} has" if wrong else f"{len(self.covariance_factor)} rows have"
            raise BadDataError(f"covariance_factor: {what} another length than the points ask for", way_out=LEARN_ANEW)

    @cached_property
    def covariance(self) -> FloatArray:
        """(m, m) of the weights."""
        factor = np.zeros((len(self.points),) * 2)
        for i, row in enumerate(self.covariance_factor):
            factor[i, : i + 1] = row
        return factor @ factor.T

    def at(self, x: FloatArray) -> FloatArray:
        """(...,) mean of h at (..., 3) values."""
        return np.asarray(self.correlation(x) @ (self.whitening @ self.mean))


# --- How far sizes of one mass lie apart between its maps: prior, posterior, outlying maps, and tests of one size.
#
# Map i gives :math:`g_i = m + E_i`, :math:`E_i \sim N(0, s_i^2 + \tau^2)`, s its own noise. One map says nothing of
# tau, so there the prior speaks; several maps tell it by their restricted likelihood. Given tau, Cochran's :math:`Q
# = \sum w_i (g_i - \bar g)^2` with :math:`w_i = 1 / (s_i^2 + \tau^2)` follows :math:`\chi^2_{k-1}`; the probability
# of a Q as large or larger is averaged over what is known of tau before these maps. It is not learned from them:
# two maps that contradict each other would make any difference likely.

PAPER_SPREAD: Final = 0.15
"""Wellman & Howe (1999), section 4: SD of the sizes of one mass over its maps, as a share of the size."""
OUTLYING: Final = 3.0
LEAST_PROBABILITY: Final = 0.01
"""Below it maps are not of one size, or of one place: one pool in a hundred is refused though it is."""
EXAM_SD: Final = 0.05
"""SD of ln d between exams of one mass, where a site does not tell it: of the exams of two simulators (record 0129)."""
_GRID = np.geomspace(1e-3, 1.5, 240)


class BetweenMaps(Record):
    """Log-normal prior of tau, the standard deviation of ln d between maps of one mass.

    `sd` is the root of the mean of tau^2: what the variance of a single map's log size has of it; 0 leaves the term
    out. A `log_sd` of 0 takes `sd` as known.
    """

    sd: float = PAPER_SPREAD
    log_sd: float = 0.6

    @property
    def median(self) -> float:
        """Median of tau: below `sd`, because a log-normal is skewed."""
        return float(self.sd * np.exp(-(self.log_sd**2)))

    @property
    def grid(self) -> FloatArray:
        """Grid of tau values."""
        return np.array([self.sd]) if self.sd <= 0 or self.log_sd <= 0 else _GRID

    def density(self, *visits: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Posterior weights on `grid`, from (k,) means and variances of the log sizes by the maps of each visit."""
        grid = self.grid
        if len(grid) == 1:
            return np.ones(1)
        log = -0.5 * (np.log(grid / self.median) / self.log_sd) ** 2
        log += sum(restricted_log_likelihood(centre, noise, grid) for centre, noise in visits)
        density = np.exp(log - log.max())  # even steps in ln tau, in which the prior is normal
        return np.asarray(density / density.sum())

    def at(self, points: FloatArray, *visits: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(n,) draws of tau from its posterior by uniform points."""
        edges = np.cumsum(self.density(*visits))
        return np.asarray(self.grid[np.minimum(np.searchsorted(edges, points), len(self.grid) - 1)])


def restricted_log_likelihood(centre: FloatArray, noise: FloatArray, grid: FloatArray) -> FloatArray:
    """(n,) log-likelihood of each tau of a grid, from (k,) means and variances of a mass's maps, its mean left open."""
    variance = noise[:, None] + grid**2
    weight = 1.0 / variance
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    log = -0.5 * np.sum(np.log(variance) + weight * (centre[:, None] - mean) ** 2, axis=0)
    return np.asarray(log - 0.5 * np.log(weight.sum(axis=0)))


def outlying_maps(centre: FloatArray, noise: FloatArray, prior: BetweenMaps) -> tuple[int, ...]:
    """Indices of maps more than three standard deviations from what the others predict.

    The spread between maps is taken from the others alone, so that an outlier cannot hide itself by widening it.
    """
    if len(centre) < 3:
        return ()
    outlying = []
    for i in range(len(centre)):
        others = np.delete(centre, i), np.delete(noise, i)
        tau2 = float(prior.density(others) @ prior.grid**2)
        weight = 1.0 / (others[1] + tau2)
        expected, variance = float(weight @ others[0] / weight.sum()), float(1.0 / weight.sum() + noise[i] + tau2)
        if abs(centre[i] - expected) > OUTLYING * np.sqrt(variance):
            outlying.append(i)
    return tuple(outlying)


def one_size_probability(centre: FloatArray, noise: FloatArray, known: BetweenMaps | None) -> float:
    """Probability that maps of one mass come out as far apart in size or farther, from their (k,) means and variances.

    By the site's spread between exams or a stated one, else by `EXAM_SD`.
    Cochran (1954), Biometrics 10, 101; DerSimonian and Laird (1986), Controlled Clinical Trials 7, 177.
    """
    if len(centre) < 2:
        return 1.0
    between = BetweenMaps(EXAM_SD, 0.0) if known is None else known
    return float(between.density() @ apart_by_chance(centre, noise, between.grid))


def one_size_of(log_sizes: Sequence[FloatArray], known: BetweenMaps | None) -> float:
    """`one_size_probability` of maps by the draws of each one's log size."""
    centre, noise = (np.array([of(one) for one in log_sizes]) for of in (np.nanmean, np.nanvar))
    return one_size_probability(centre, noise, known)


def apart_by_chance(centre: FloatArray, noise: FloatArray, grid: FloatArray) -> FloatArray:
    """(n,) probability of a Q as large or larger, for each tau of a grid."""
    weight = 1.0 / (noise[:, None] + grid**2)
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    q = np.sum(weight * (centre[:, None] - mean) ** 2, axis=0)
    return above_chi_square(q, len(centre) - 1)


def above_chi_square(q: FloatArray, degrees: int) -> FloatArray:
    """(...,) probability that a chi-squared variable is above q."""
    return np.asarray(gammaincc(0.5 * degrees, 0.5 * q))
