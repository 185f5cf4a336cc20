r"""Joint posterior of a mass's size at several visits, and of its change between them.

As in `pooling`, map i of visit v gives :math:`g_{vi} = \ln d_v - B_v + E_{vi}`. The E of a visit's maps average out.
The coefficients of the calibration and a site's correction are the same at all visits, and B is to the degree that
`SharedBody` says: in :math:`\ln d_w - \ln d_v` all three cancel but for what a lump of another size changes of them.
The lump is taken to keep its form, so that largest and smallest size change by one factor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.errors import UsageError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels
from tactile_bayes.inference.normal import normal_cdf, normal_quantile
from tactile_bayes.inference.paired import evened, paired_points
from tactile_bayes.inference.summary import Quantity, summarise
from tactile_bayes.records import dataclass
from tactile_bayes.size.between_maps import BetweenMaps
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.map_sizes import log_sizes, lump_shape, map_terms
from tactile_bayes.size.pooling import POOLED_DRAWS, SizePriors
from tactile_bayes.size.shape_draws import ShapeDraws, matched_draws
from tactile_bayes.size.shared_body import SHARED_BODY, SHARED_WITHOUT_DEPTH, SharedBody

MOST_VISITS = 10
DIMENSIONS = 5
"""Of the points: the spread between exams, that of B, and three for the lump's shape."""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Change of a mass between two visits.

    Parameters
    ----------
    log_ratio : (n,) array
        Draws of ln of the later size over the earlier one.
    mean, sd : (n,) arrays
        Of the normal that each draw comes from.
    replicates : (n,) array
        Label of the independent replicate of each draw.
    """

    log_ratio: FloatArray
    mean: FloatArray
    sd: FloatArray
    replicates: Labels

    def probability_above(self, share: float) -> float:
        """Probability that the size grew by more than this share of it (0.2: by more than 20 %)."""
        return float(np.mean(normal_cdf((self.mean - np.log1p(share)) / self.sd)))

    @property
    def log_sd(self) -> float:
        """Posterior SD of the log ratio."""
        return float(np.sqrt(np.mean(self.sd**2) + np.var(self.mean)))

    def smallest_detectable(self, probability: float) -> tuple[float, float]:
        """Least growth and least shrinkage, as shares, whose interval of this probability would leave out no change.

        From the arms of this change's own interval, so a change beyond them is one that the interval shows. Half of all
        changes of just this size are shown.
        """
        q = self.log_summary(probability)
        return float(np.expm1(q.median - q.low)), float(-np.expm1(q.median - q.high))

    def percent(self, probability: float) -> Quantity:
        """Summary of the change of the diameter in percent."""
        return summarise(100.0 * np.expm1(self.log_ratio), probability=probability, replicates=self.replicates)

    def log_summary(self, probability: float) -> Quantity:
        """Summary of the log ratio."""
        return summarise(self.log_ratio, probability=probability, replicates=self.replicates)


@dataclass(frozen=True, slots=True, eq=False)
class JointSizes:
    """Joint posterior of the sizes of one mass at v visits.

    Parameters
    ----------
    log_size : (v, n) array
        Draws of ln of the largest size in mm.
    mean : (v, n) array
        Means of the normals that the draws come from.
    covariance : (n, v, v) array
        Their covariances.
    replicates : (n,) array
    between_map_sd
        Spread between exams of a visit, root mean square.
    correlation : (v, v) array
        Of B between the visits.
    calibrations
        Of each visit: at the depth of fat that its maps tell.
    """

    log_size: FloatArray
    mean: FloatArray
    covariance: FloatArray
    replicates: Labels
    between_map_sd: float
    correlation: FloatArray
    calibrations: tuple[BodyCalibration, ...]

    def change(self, earlier: int, later: int) -> Change:
        """Change from one visit to another."""
        c = self.covariance
        sd = np.sqrt(np.maximum(c[:, later, later] + c[:, earlier, earlier] - 2.0 * c[:, later, earlier], 1e-18))
        mean = self.mean[later] - self.mean[earlier]
        drawn = evened(self.log_size[later] - self.log_size[earlier], mean, sd, self.replicates)
        return Change(drawn, mean, sd, self.replicates)

    def size_mm(self, visit: int, probability: float) -> Quantity:
        """Summary of the largest size at a visit."""
        return summarise(np.exp(self.log_size[visit]), probability=probability, replicates=self.replicates)

    @property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """(v,) mean and (v, v) covariance of ln of the largest size."""
        finite = np.isfinite(self.mean).all(axis=0)
        return self.mean[:, finite].mean(axis=1), self.covariance[finite].mean(axis=0) + np.cov(self.mean[:, finite])


def joint_sizes(
    visits: Sequence[Sequence[ShapeDraws]],
    *,
    calibration: BodyCalibration,
    priors: SizePriors,
    rng: np.random.Generator,
    between: BetweenMaps | None = None,
    law: SharedBody | None = None,
    number: int = POOLED_DRAWS,
) -> JointSizes:
    """Joint posterior of a mass's sizes at several visits.

    Parameters
    ----------
    visits
        Maps of each visit on which the lump was found, at least one each.
    calibration
        For any depth of fat; that at the depth that each visit's maps tell is used.
    priors
        Of the lump's shape and of the spread between the exams of a visit; properties that somebody knows take no part.
    between
        Spread between exams in place of the priors'.
    law
        How far B is the same at the visits; None for `SHARED_BODY`, or `SHARED_WITHOUT_DEPTH` where maps tell no depth.

    Raises
    ------
    UsageError
        When there are fewer than two visits, more than `MOST_VISITS`, or one has no map.
    """
    _check(visits)
    fitted = visit_calibrations(visits, calibration)
    between = between or priors.between_maps or calibration.between_exams
    flat = [one for maps in visits for one in maps]
    used, replicates = matched_draws(flat, number, rng)
    parts, start = [], 0
    for maps, at in zip(visits, fitted, strict=True):
        parts.append(_Visit.of(used[start : start + len(maps)], at))
        start += len(maps)
    middle = np.mean([one.by_map.mean(axis=0) for one in parts], axis=0)
    points = paired_points(middle, replicates, DIMENSIONS, rng)
    tau = _shared_tau(between, parts, points[:, 0])
    sizes = [one for maps, at in zip(visits, fitted, strict=True) for one in log_sizes(at, maps)]
    oval, _ = lump_shape(fitted[0], flat, sizes, priors.shape)
    half = oval.at(points[:, 2:5])
    found = [one.weighted(tau) for one in parts]
    if law is None:
        law = SHARED_WITHOUT_DEPTH if fitted[0].fat_mm is None else SHARED_BODY
    correlation = law.correlation(np.array([float(np.nanmean(one.mean)) for one in found]))
    covariance = _covariance(found, fitted, correlation, normal_quantile(points[:, 1]))
    mean = np.stack([one.mean for one in found]) + np.hypot(half[:, 0], half[:, 1])
    drawn = _drawn(mean, covariance, rng.standard_normal((len(replicates), len(visits))), replicates)
    spread = float(np.sqrt(np.mean(tau**2)))
    return JointSizes(drawn, mean, covariance, replicates, spread, correlation, tuple(fitted))


def visit_calibrations(visits: Sequence[Sequence[ShapeDraws]], calibration: BodyCalibration) -> list[BodyCalibration]:
    """The calibration at the depth of fat that each visit's maps tell.

    Posture changes that depth by some per cent, and the lump's own with it: at one depth for all visits that would
    count as a change of size. Where a visit tells none, none is used: what the maps hide would be something else with
    it than without.
    """
    fitted = []
    for maps in visits:
        at_depth = calibration.at_fat([one.profile for one in maps])
        for one in maps:
            at_depth = at_depth.fitting(*one.middle)
        fitted.append(at_depth)
    without = [one for one in fitted if one.fat_mm is None]
    return [without[0]] * len(fitted) if without else fitted


@dataclass(frozen=True, slots=True, eq=False)
class _Weighted:
    """Maps of a visit averaged for each tau: (n,) mean and variance between exams, (n, k) terms, ln a and p."""

    mean: FloatArray
    exam_variance: FloatArray
    terms: FloatArray
    log_amplitude: FloatArray
    log_width: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Visit:
    """Draws of the k maps of a visit: (k, n) log sizes, (k,) centres and variances, (k, n, t) terms."""

    maps: Sequence[ShapeDraws]
    by_map: FloatArray
    centre: FloatArray
    noise: FloatArray
    terms: FloatArray

    @classmethod
    def of(cls, maps: Sequence[ShapeDraws], calibration: BodyCalibration) -> _Visit:
        by_map, terms = np.stack(log_sizes(calibration, maps)), map_terms(calibration, maps)
        return cls(maps, by_map, np.nanmean(by_map, axis=1), np.nanvar(by_map, axis=1), terms)

    def weighted(self, tau: FloatArray) -> _Weighted:
        """Average the maps with the weights that (n,) spreads between exams give them."""
        weight = 1.0 / (self.noise[:, None] + tau**2 + 1e-12)
        weight /= weight.sum(axis=0)
        log_a, p = (np.stack([getattr(one, name) for one in self.maps]) for name in ("log_amplitude", "log_width"))
        return _Weighted(
            np.sum(weight * self.by_map, axis=0),
            np.sum(weight**2, axis=0) * tau**2,
            np.einsum("kn,knt->nt", weight, self.terms),
            np.sum(weight * log_a, axis=0),
            np.sum(weight * p, axis=0),
        )


def _check(visits: Sequence[Sequence[ShapeDraws]]) -> None:
    if not 2 <= len(visits) <= MOST_VISITS:
        raise UsageError(f"{len(visits)} visits are given; compare 2 to {MOST_VISITS}")
    if not all(visits):
        raise UsageError("a visit has no map with a lump; leave it out")


def _shared_tau(between: BetweenMaps, parts: Sequence[_Visit], points: FloatArray) -> FloatArray:
    """(n,) draws of the spread between exams of a visit, which the maps of all visits tell together."""
    prior = between.density(np.zeros(1), np.zeros(1))
    density = prior.copy()
    for one in parts:
        density *= between.density(one.centre, one.noise) / np.maximum(prior, 1e-300)
    edges = np.cumsum(density / density.sum())
    return np.asarray(between.grid[np.minimum(np.searchsorted(edges, points), len(edges) - 1)])


def _covariance(
    parts: Sequence[_Weighted], fitted: Sequence[BodyCalibration], correlation: FloatArray, score: FloatArray
) -> FloatArray:
    """(n, v, v) covariance of ln d at the visits given each draw of the maps."""
    k, site = fitted[0].coefficients, fitted[0].site
    bodies = np.stack(
        [at.body_sd(one.log_amplitude, one.log_width, score) for one, at in zip(parts, fitted, strict=True)], axis=1
    )
    terms = np.stack([one.terms for one in parts], axis=1)
    found = bodies[:, :, None] * correlation * bodies[:, None, :]
    found = found + (terms @ fitted[0].covariance[:k, :k]) @ np.swapaxes(terms, 1, 2)
    exams = np.stack([one.exam_variance for one in parts], axis=1)
    found[:, range(len(parts)), range(len(parts))] += exams
    if site is not None:
        about = np.stack(
            [np.stack([np.ones_like(p), p - site.centre], axis=-1) for p in (one.log_width for one in parts)]
        )
        about = np.swapaxes(about, 0, 1)
        found = found + (about @ site.covariance) @ np.swapaxes(about, 1, 2)
    return np.asarray(found)


def _drawn(mean: FloatArray, covariance: FloatArray, z: FloatArray, replicates: Labels) -> FloatArray:
    """(v, n) draws of ln d, each visit's with the evenly spaced quantiles of its mixture of normals."""
    v = len(mean)
    finite = np.isfinite(covariance).all(axis=(1, 2))
    root = np.full_like(covariance, np.nan)
    root[finite] = np.linalg.cholesky(covariance[finite] + 1e-12 * np.eye(v))
    raw = mean + np.einsum("nvw,nw->vn", root, z)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    return np.stack([evened(raw[i], mean[i], sd[i], replicates) for i in range(v)])
