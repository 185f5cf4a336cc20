"""Sizes of several maps pooled, with a site's repeatability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Final, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, paired_points, stratified_quantiles
from tactile_bayes.size.bodies import BodyCalibration, known_body, suppositions
from tactile_bayes.size.draws import (
    LEAST_PROBABILITY,
    OVAL_SD,
    BetweenMaps,
    BumpDraws,
    Elongation,
    ShapeDraws,
    ShapePrior,
    SizePosterior,
    elongation,
    first_axis,
    log_ratio_rotation,
    matched_draws,
    one_size_probability,
    outlying_maps,
    shares,
    shown_share,
)
from tactile_bayes.size.eq6 import SizeCalibration, push_sizes
from tactile_bayes.size.terms import extrapolated

# --- Sizes from the maps of one mass, one or several.
#
# Map i gives :math:`g_i = \ln d - B + E_i`, the log size by the calibration's form, with E as in `draws`. The prior of
# tau is about the spread that the calibration's exams show; a second interval's, about that of the paper's maps. B,
# what no map shows of a body, is common to all maps of a mass and does not average out.

Calibration = SizeCalibration | BodyCalibration
"""A calibration from a study or phantoms, or over a population; both have the same methods."""
POOLED_DRAWS = 8192
DIMENSIONS = 6
"""Coordinates of the points: ln d given all else, tau, the spread of B, oval or round, and an oval's two components."""
_SCORE = 2  #: Coordinate of the spread of B.
MOST_INVALID = 0.05
DISAGREE: Final = "maps_disagree"  #: Status of maps that are not of one size, or not of one mass.
IRREGULAR_SD = 0.15  #: SD of ln d by which the mean diameter of a lump with an irregular outline is off (record 0107).


class SizePriors(Record):
    """Assumptions about a mass's size besides the calibration."""

    between_maps: BetweenMaps | None = None
    """Spread between the maps at hand; None takes what the calibration's exams show."""
    another_exam: BetweenMaps | None = field(default_factory=BetweenMaps)
    """Spread that exams of one mass may have beyond simulated ones: the second interval's. None leaves that out."""
    shape: ShapePrior = field(default_factory=ShapePrior)
    known: Mapping[str, float] = field(default_factory=dict)
    """Properties of the body that somebody knows, by the names of `HiddenTerms`."""

    @property
    def spread_of_others(self) -> BetweenMaps:
        """Prior of the spread between a mass's other maps, with which each map is compared."""
        learned = self.between_maps is not None and self.between_maps.log_sd > 0  # else it is stated
        return self.another_exam or (self.between_maps if learned else None) or BetweenMaps()


def draw_sizes(
    bump: BumpDraws, *, calibration: Calibration, priors: SizePriors, rng: np.random.Generator
) -> SizePosterior:
    """Draw sizes from the (chain, draw) joint draws of one map."""
    if isinstance(calibration, SizeCalibration):  # which has the interval of another exam alone of the priors
        another = priors.another_exam or priors.between_maps
        return push_sizes(bump, calibration=calibration, rng=rng, another_exam=another)
    size = pooled_size([ShapeDraws.of(bump)], calibration=calibration, priors=priors, rng=rng)
    return size.reshaped(bump.amplitude.shape)


def log_sizes(calibration: BodyCalibration, maps: Sequence[ShapeDraws]) -> list[FloatArray]:
    """(n,) ln d of each map's draws without B and E, with the site's correction where there is one."""
    return [calibration.corrected_log_size(one.log_amplitude, one.log_width) for one in maps]


class AveragedMaps(Record, eq=False):
    """Maps of a mass averaged for each of n spreads between them: (n,) values, (n, t) terms, and (k, n) weights."""

    weight: FloatArray
    mean: FloatArray
    variance: FloatArray  #: By the spread between maps.
    terms: FloatArray
    log_amplitude: FloatArray
    log_width: FloatArray


class MassMaps(Record, eq=False):
    """Draws of the k maps of a mass: (k, n) log sizes, (k,) means and variances of each, (k, n, t) terms."""

    maps: Sequence[ShapeDraws]
    by_map: FloatArray
    centre: FloatArray
    noise: FloatArray
    terms: FloatArray

    @classmethod
    def of(cls, maps: Sequence[ShapeDraws], calibration: BodyCalibration) -> MassMaps:
        """From the maps' draws, by a calibration."""
        by_map = np.stack(log_sizes(calibration, maps))
        terms = np.stack([calibration.terms(one.log_amplitude, one.log_width) for one in maps])
        return cls(maps, by_map, np.nanmean(by_map, axis=1), np.nanvar(by_map, axis=1), terms)

    def averaged(self, tau: FloatArray) -> AveragedMaps:
        """Average the maps with the weights that (n,) spreads between them give."""
        weight = 1.0 / (self.noise[:, None] + tau**2 + 1e-12)
        weight /= weight.sum(axis=0)
        log_a, p = (np.stack([getattr(one, name) for one in self.maps]) for name in ("log_amplitude", "log_width"))
        return AveragedMaps(
            weight,
            np.sum(weight * self.by_map, axis=0),
            np.sum(weight**2, axis=0) * tau**2,
            np.einsum("kn,knt->nt", weight, self.terms),
            np.sum(weight * log_a, axis=0),
            np.sum(weight * p, axis=0),
        )


def lump_shape(
    calibration: BodyCalibration, maps: Sequence[ShapeDraws], sizes: Sequence[FloatArray], prior: ShapePrior
) -> tuple[Elongation, float]:
    """Posterior of the lump's elongation in the maps' common axes, and the share of it that the maps show."""
    excess, covariance, shown = np.zeros(2), np.zeros((2, 2)), 0.0
    k = len(maps)
    for shape, size in zip(maps, sizes, strict=True):
        mean, spread = _axis_ratio(shape)
        mean[0] -= float(np.nanmean(calibration.round_excess(shape.log_amplitude, shape.log_width)))
        turn = log_ratio_rotation(-shape.turn_rad)
        excess += mean @ turn / k
        covariance += turn.T @ spread @ turn / k**2
        shown += shown_share(size, shape.log_width) / k
    balls = calibration.round_lumps
    total = balls.map_factor * covariance + (balls.variance(np.zeros(()), maps=k) + 1e-12) * np.eye(2)
    return elongation(excess, total, shown=shown, prior=prior), shown


def _axis_ratio(shape: ShapeDraws) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of q and r; an r that was not measured has mean 0 and twice q's SD."""
    both = np.stack([shape.q, shape.r], axis=-1)
    both = both[np.isfinite(both).all(axis=1)]
    mean, covariance = both.mean(axis=0), np.cov(both.T)
    if not covariance[1, 1] > 0:
        mean[1], sd = shape.oblique or (0.0, 2.0 * float(np.sqrt(covariance[0, 0])))
        covariance[1, 1] = sd**2
    return mean, covariance


def pooled_size(
    maps: Sequence[ShapeDraws],
    *,
    calibration: BodyCalibration,
    priors: SizePriors,
    rng: np.random.Generator,
    number: int | None = None,
) -> SizePosterior:
    """Size of a mass from its maps on which the lump was found, by the calibration at their depth of fat.

    In (`number`,) draws; None keeps those of a single map one by one. `figures` holds ``between_map_sd`` (root mean
    square), ``oval_probability``, ``oval_half_log_ratio``, ``irregular_outline`` (1 where at least half of the maps
    have one) and, for several maps, ``weight_1``...

    Given tau and B, what the maps leave open of ln d is a sum of normals, so it is one normal. It, tau, the spread of B
    and the lump's shape are the coordinates of low-discrepancy points, paired with the draws of the maps in order of
    their log size; the draws then get the quantiles of the mixture of all these normals.
    """
    calibration = calibration.at_fat([one.profile for one in maps])
    matched, replicates = matched_draws(maps, number, rng)
    log_size = log_sizes(calibration, maps)
    centre, noise = (np.array([moment(one) for one in log_size]) for moment in (np.nanmean, np.nanvar))
    drawn = replace(MassMaps.of(matched, calibration), centre=centre, noise=noise)
    oval, shown = lump_shape(calibration, maps, log_size, priors.shape)
    points = paired_points(drawn.by_map.mean(axis=0), replicates, DIMENSIONS, rng)
    figures = {
        "oval_probability": oval.probability,
        "oval_half_log_ratio": oval.magnitude,
        "shown_share": shown,
        "irregular_outline": float(2 * sum(one.irregular for one in maps) >= len(maps)),
    }
    turned = np.concatenate([np.stack([one.q, one.r], axis=-1) @ log_ratio_rotation(-one.turn_rad) for one in matched])
    axis = first_axis(*turned.T)
    pool = _Pool(drawn, points, oval.at(points[:, 3:]), axis, replicates, calibration, priors.known, figures)
    size = pool.size(priors.between_maps or calibration.between_exams)
    middle = [float(np.mean([np.nanmean(getattr(m, n)) for m in matched])) for n in ("log_amplitude", "log_width")]
    variance = float(np.nanvar(np.log(size.max_size_mm)))
    supposed, moved = suppositions(calibration, priors.known, (middle[0], middle[1]), variance=variance)
    another = None if priors.another_exam is None else pool.size(priors.another_exam)
    return replace(size, another_exam=another, supposing=supposed, known_sds=moved)


class _Pool(Record, eq=False, dict=True):
    """Draws of the maps of a mass before a spread between maps is added, with (n, `DIMENSIONS`) points."""

    drawn: MassMaps
    points: FloatArray
    half: FloatArray  #: (n, 2) half the log axis ratio of the lump, in two components.
    first_axis: FloatArray
    replicates: Labels
    calibration: BodyCalibration
    known: Mapping[str, float]
    figures: Mapping[str, float]

    def size(self, between: BetweenMaps) -> SizePosterior:
        """Sizes under a prior of the spread between maps."""
        tau = between.at(self.points[:, 1], (self.drawn.centre, self.drawn.noise))
        maps = self.drawn.averaged(tau)
        known, variances = self._beyond_maps(maps)
        longer = np.hypot(self.half[:, 0], self.half[:, 1])
        mean = maps.mean + known + longer
        sd = np.sqrt(sum(variances.values()) + (OVAL_SD * longer) ** 2)
        log_largest, log_smallest = self._smoothed(mean, sd, longer)
        wide = self.half @ self.first_axis >= 0
        share = {"map": float(np.nanvar(maps.mean)), **{name: float(np.nanmean(v)) for name, v in variances.items()}}
        weights = {f"weight_{i + 1}": float(one.mean()) for i, one in enumerate(maps.weight)}
        return SizePosterior(
            np.exp(np.where(wide, log_largest, log_smallest)),
            np.exp(np.where(wide, log_smallest, log_largest)),
            shares(share | {"shape": float(np.var(longer) + OVAL_SD**2 * np.mean(longer**2))}),
            int((~np.isfinite(mean)).sum()),
            self.replicates,
            {
                "between_map_sd": float(np.sqrt(np.mean(tau**2))),
                **self.figures,
                **(weights if len(weights) > 1 else {}),
            },
        )

    @cached_property
    def _of_one(self) -> tuple[FloatArray, FloatArray]:
        """SD(B) and the coefficients' variance of the only map, which no spread between maps moves."""
        return self._errors(self.drawn.averaged(np.zeros(len(self.points))))

    def _errors(self, maps: AveragedMaps) -> tuple[FloatArray, FloatArray]:
        body_sd = self.calibration.body_sd(maps.log_amplitude, maps.log_width, ndtri(self.points[:, _SCORE]))
        return body_sd, self.calibration.coefficient_variance(maps.terms)

    def _beyond_maps(self, maps: AveragedMaps) -> tuple[FloatArray, dict[str, FloatArray]]:
        """(n,) mean of ln d beyond the maps' own, and its variances by source."""
        body_sd, error = self._of_one if len(maps.weight) == 1 else self._errors(maps)
        # what is known of a body explains the spread of the population's bodies, and nothing of other kinds
        table_sd, site = self.calibration.table_sd(body_sd), self.calibration.site
        expected, unexplained = known_body(self.calibration, self.known, maps.log_amplitude, maps.log_width, table_sd)
        form_sd = IRREGULAR_SD * self.figures["irregular_outline"]
        return expected, {
            "between_maps": maps.variance,
            "calibration": error,
            "body": unexplained + self.calibration.other_sd**2 + form_sd**2,
            **({} if site is None else {"site": site.variance(maps.log_width)}),
        }

    def _smoothed(self, mean: FloatArray, sd: FloatArray, longer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Logs of both sizes as stratified quantiles, apart for round and oval draws: a round lump has one size."""
        z = ndtri(self.points[:, 0])
        largest = stratified_quantiles(mean + sd * z, mean, sd, 2 * self.replicates + (longer > 0))
        smallest, o = largest.copy(), longer > 0
        shorter = 2.0 * longer[o]
        smallest[o] = stratified_quantiles(largest[o] - shorter, mean[o] - shorter, sd[o], self.replicates[o])
        return largest, smallest


class PooledEstimate(Record, eq=False):
    """Result of pooling the maps of one mass."""

    status: Literal["estimate", "no_estimate", "maps_disagree"]
    reason: str  #: As of `Estimate`; also ``maps_disagree``, where the maps are not of one size, or not of one mass.
    size: SizePosterior | None = None
    centres: Mapping[int, float] = field(default_factory=dict)
    """ln d by each map alone, by its place in the list; maps without a lump are missing."""
    outlying: tuple[int, ...] = ()  #: Places of the maps that lie apart from the rest.
    outside: tuple[str, ...] = ()  #: How maps lie outside the calibration's table, in words.
    calibration: BodyCalibration | None = None  #: The one used: for the depth of fat that the maps tell, where they do.
    fat_apart_mm: tuple[float, float] | None = None
    """Least and largest depth of fat by single maps, where they can hardly be of one body; None otherwise."""
    one_size: float | None = None
    one_size_apart: float | None = None
    """Probability that maps of one mass come out as far apart in size or farther, by the spread of
    `one_size_probability` and, where a second interval is told, by the paper's maps; None without several maps."""
    one_place: float | None = None  #: Likewise for the places of their masses in the patient; None without landmarks.
    findings: tuple[Finding, ...] = ()  #: Findings against the size, cautions first.


def pool_maps(
    shapes: Sequence[ShapeDraws | None],
    *,
    calibration: BodyCalibration,
    priors: SizePriors,
    rng: np.random.Generator,
    silent: int = 0,
) -> PooledEstimate:
    """Pool the maps of a mass to one size; None stands for a map on which no lump was found.

    When fewer than half of the maps show the lump, but for `silent` ones that cannot, there is no size: those that do
    may be the noise's. Maps that are not of one size have none in common.
    """
    found_on = sum(shape is not None for shape in shapes)
    few = f"a lump was found on {found_on} of {len(shapes)} maps"
    if 2 * found_on < len(shapes) - silent or not found_on:
        return PooledEstimate("no_estimate", few)
    # sorted, so that the draws do not depend on the caller's order
    pairs = sorted(((shape, i) for i, shape in enumerate(shapes) if shape is not None), key=lambda one: one[0].order)
    in_order, places = [shape for shape, _ in pairs], [i for _, i in pairs]
    depth, at_depth = calibration.depth, calibration.for_maps(in_order)
    fat_apart_mm = None if depth is None else depth.disagreement_mm([one.profile for one in in_order])
    named = sorted(zip(places, [one.middle for one in in_order], strict=True))
    far = [f"map {i + 1}: {text}" for i, middle in named for text in at_depth.outside(*middle, far=True)]
    if far:
        return PooledEstimate("no_estimate", extrapolated(far).reason)
    sizes = log_sizes(at_depth, in_order)
    centres = {i: float(np.nanmean(one)) for i, one in zip(places, sizes, strict=True)}
    centre, noise = np.array(list(centres.values())), np.array([np.nanvar(one) for one in sizes])
    outlying = tuple(sorted(places[i] for i in outlying_maps(centre, noise, priors.spread_of_others)))
    another = None if priors.between_maps is not None or len(in_order) < 2 else priors.another_exam
    pooled = PooledEstimate(
        DISAGREE,
        "the maps show different sizes",
        centres=centres,
        outlying=outlying,
        calibration=at_depth,
        fat_apart_mm=fat_apart_mm,
        one_size=None if len(in_order) < 2 else one_size_probability(centre, noise, priors.between_maps),
        one_size_apart=None if another is None else one_size_probability(centre, noise, another),
    )
    if pooled.one_size is not None and pooled.one_size < LEAST_PROBABILITY:
        return pooled
    size = pooled_size(in_order, calibration=at_depth, priors=priors, rng=rng, number=POOLED_DRAWS)
    if size.invalid > MOST_INVALID * size.d_x_mm.size:
        return PooledEstimate("no_estimate", f"no positive size in {size.invalid} of {size.d_x_mm.size} draws")
    outside = [f"map {i + 1}: {text}" for i, middle in named for text in at_depth.outside(*middle)]
    outside += at_depth.beyond_lumps(size)
    reason = "" if found_on == len(shapes) else few
    if found_on > 1:
        map_numbers = {i: number for number, i in enumerate(sorted(places), start=1)}
        weights = {f"weight_{map_numbers[i]}": size.figures[f"weight_{j}"] for j, i in enumerate(places, start=1)}
        size = replace(size, figures={**size.figures, **weights})
    return replace(pooled, status="estimate", reason=reason, size=size, outside=tuple(outside))


# --- A site's repeatability: how far sizes of one mass lie apart between its exams, learned from repeated exams there.

PROBABILITY: Final = 0.95  #: Probability of the interval of a learned spread.


class Repeatability(Record):
    """Spread of ln d between exams of one mass at a site, beyond the maps' own errors.

    `sd` and `log_sd` are as of `BetweenMaps`: root mean square of the posterior, and the log-SD of the log-normal that
    has the same mean of tau^2 and of tau^4; median, low and high are the posterior's, with its interval of
    `PROBABILITY`. `sha256` is of the file that it was read from, empty where it is in none.
    """

    sd: float
    log_sd: float
    median: float
    low: float
    high: float
    masses: int
    maps: int
    calibration: str = ""
    calibration_sha256: str = ""
    normalise: str = ""
    outlying: tuple[str, ...] = ()
    sha256: str = ""

    def __post_init__(self) -> None:
        if not (0.0 < self.low <= self.median <= self.high):
            what = f"the spread has the median {self.median:g} and the interval {self.low:g} to {self.high:g}"
            raise BadDataError(what, way_out="learn it again: `calibrate repeatability`")

    @property
    def between_maps(self) -> BetweenMaps:
        """The spread as a prior of a mass's maps."""
        return BetweenMaps(self.sd, self.log_sd)

    def as_dict(self) -> dict[str, float]:
        """The part that a size depends on, as plain data."""
        return {"between_map_sd": self.sd, "log_sd": self.log_sd, "masses": self.masses, "maps": self.maps}

    def words(self) -> str:
        """The spread with its interval, and what it was learned from."""
        spread = f"{_percent(self.median)} % (95 %: {_percent(self.low)} to {_percent(self.high)})"
        return f"exams of one mass differ by {spread} at this site, by {self.masses} masses and {self.maps} exams"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}" if share < 0.0995 else f"{100 * share:.0f}"


def log_size_alone(calibration: BodyCalibration, shape: ShapeDraws) -> tuple[float, float]:
    """Mean and variance of ln d by a map alone, without B."""
    (log_size,) = log_sizes(calibration.for_maps([shape]), [shape])
    return float(np.nanmean(log_size)), float(np.nanvar(log_size))


def size_alone(
    shape: ShapeDraws, *, calibration: BodyCalibration, priors: SizePriors, rng: np.random.Generator
) -> SizePosterior:
    """Size by a map alone from its draws for pooling, draw by draw as `estimate_map` gives it."""
    return pooled_size([shape], calibration=calibration.for_maps([shape]), priors=priors, rng=rng)
