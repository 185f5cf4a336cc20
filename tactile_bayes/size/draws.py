"""Draws of a map's amplitude and shape, of the lump's elongation, and of sizes, which differ between maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy.special import chdtrc, ndtri

from tactile_bayes.declarations import Record, field, replace
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, Quantity, even_replicates, rows_by_label, summarise

EXTREMES: Final = ("max_size_mm", "min_size_mm")
SIZES: Final = (*EXTREMES, "d_x_mm", "d_y_mm")  #: Names of the sizes that a posterior has, in the order of reports.
SHOWN, SHOWN_POWER = 0.083, 1.5
"""Share of a lump's half log axis ratio that its map shows: factor, and power of d in map widths (record 0107)."""
SHOWN_CV: Final = 0.2  #: Coefficient of variation of that between lumps.
OVAL_SD: Final = 0.4
"""SD of the log mean diameter by which an oval lump is off the calibration for balls, over its half log axis ratio."""


class BumpDraws(Record, eq=False):
    """Joint draws of one map's bump (Eq 7), arrays of one shape: the widths are along the ellipse's own axes."""

    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray
    angle_rad: FloatArray
    labels: Labels | None = None  #: (n,) labels of the draws' independent replicates, as `ParameterDraws.labels`.
    oblique: tuple[float, float] | None = None
    """Mean and SD of r, the half log axis ratio 45 degrees from the map's x axis, where the draws have none and it was
    measured beside them; None otherwise."""
    irregular: bool = False  #: True where the bump is less regular than a ball's, see `correlated.outline`.

    def flat(self) -> BumpDraws:
        """The same draws in one row."""
        return replace(self, **{name: getattr(self, name).ravel() for name in BUMP})

    def median(self) -> BumpDraws:
        """A single draw: the medians."""
        return replace(self, **{name: np.full(1, np.median(getattr(self, name))) for name in BUMP}, labels=None)


BUMP: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_rad")


class ShapeDraws(Record, eq=False):
    """Joint draws of one map's amplitude and shape, each (n,).

    ln a; p, the log of the geometric mean width in mm; half the log axis ratio along the map's x axis (`q`) and 45
    degrees from it (`r`).
    """

    log_amplitude: FloatArray
    log_width: FloatArray
    q: FloatArray
    r: FloatArray
    turn_rad: float = 0.0  #: From the axes that the maps of a mass share to this map's.
    profile: tuple[float, ...] | None = None  #: `presets.HEAD_PROFILE` of the map; None where it has none.
    labels: Labels | None = None
    oblique: tuple[float, float] | None = None
    irregular: bool = False  #: Like the two above as of `BumpDraws`.

    @property
    def replicates(self) -> Labels:
        """(n,) label of the independent replicate of each draw."""
        return even_replicates(len(self.q)) if self.labels is None else self.labels

    @property
    def order(self) -> tuple[float, ...]:
        """Sort key of maps before pooling."""
        return tuple(float(np.nansum(v)) for v in (self.log_width, self.log_amplitude, self.q, self.r))

    @classmethod
    def of(cls, bump: BumpDraws, *, turn_rad: float = 0.0, profile: tuple[float, ...] | None = None) -> ShapeDraws:
        """Convert draws of Eq 7; a draw whose amplitude is not positive becomes NaN."""
        with np.errstate(invalid="ignore", divide="ignore"):
            log_a = np.log(np.where(bump.amplitude > 0, bump.amplitude, np.nan)).ravel()
        half, angle = 0.5 * np.log(bump.sigma_x_mm / bump.sigma_y_mm).ravel(), bump.angle_rad.ravel()
        p = 0.5 * np.log(bump.sigma_x_mm * bump.sigma_y_mm).ravel()
        q, r = half * np.cos(2 * angle), half * np.sin(2 * angle)
        return cls(log_a, p, q, r, turn_rad, profile, bump.labels, bump.oblique, bump.irregular)

    @property
    def middle(self) -> tuple[float, float]:
        """Medians of the amplitude and of the geometric mean width, mm."""
        amplitude, sigma_mm = (float(np.exp(np.nanmedian(v))) for v in (self.log_amplitude, self.log_width))
        return amplitude, sigma_mm

    def rows(self, index: Labels) -> ShapeDraws:
        """Subset of the draws, treated as independent."""
        drawn = {name: getattr(self, name)[index] for name in ("log_amplitude", "log_width", "q", "r")}
        return replace(self, **drawn, labels=None)


def first_axis(q: FloatArray, r: FloatArray) -> FloatArray:
    """(2,) direction in (q, r) of the ellipse's axis that all draws call x.

    Of the mean ellipse's axes it is the one nearer to x: near 45 degrees each draw's own nearest axis would be now the
    longer and now the shorter. Where the draws do not tell the axes it is x itself.
    """
    both = np.stack([np.ravel(q), np.ravel(r)])
    both = both[:, np.isfinite(both).all(axis=0)]
    mean = both.mean(axis=1) if both.size else np.zeros(2)
    length = float(np.hypot(*mean))
    if not length**2 > float(both.var(axis=1).sum()):
        return np.array([1.0, 0.0])
    return mean / length if mean[0] >= 0 else -mean / length


def matched_draws(
    maps: Sequence[ShapeDraws], number: int | None, rng: np.random.Generator
) -> tuple[Sequence[ShapeDraws], Labels]:
    """Equally many draws of each map, matched by replicate, with their labels; a single map keeps its own."""
    if number is None and len(maps) == 1:
        return maps, maps[0].replicates
    replicates = even_replicates(len(maps[0].q) if number is None else number)
    return [m.rows(rows_by_label(m.replicates, replicates, rng)) for m in maps], replicates


class ShapePrior(Record):
    """Prior of a lump's half log axis ratio, as a vector along and 45 degrees from the head's x axis.

    `oval_sd` is of each component of a lump that is not round: 0.15 is an axis ratio of 1.35 (the paper's Figure 9:
    16 by 12 mm, 0.14).
    """

    oval_probability: float = 0.3
    oval_sd: float = 0.2


class Elongation(Record, eq=False):
    """Posterior of a lump's half log axis ratio: oval with a probability, then normal; else round.

    A ball's map is oval under an oblong head; only a larger axis ratio is evidence.
    """

    probability: float
    mean: FloatArray
    covariance: FloatArray

    def at(self, points: FloatArray) -> FloatArray:
        """(n, 2) draws from (n, 3) uniform points: the first decides between oval and round, which is (0, 0)."""
        values, vectors = np.linalg.eigh(self.covariance)
        normal = ndtri(points[:, 1:]) @ (vectors * np.sqrt(np.clip(values, 0.0, None))).T
        return np.where(points[:, :1] < self.probability, self.mean + normal, 0.0)

    @property
    def magnitude(self) -> float:
        """Posterior mean half log axis ratio of an oval lump."""
        return float(np.hypot(*self.mean))


def shown_share(log_size: FloatArray, log_width: FloatArray) -> float:
    """Share of a lump's half log axis ratio that its map shows, from (n,) draws of ln d and of the log mean width."""
    return SHOWN * float(np.exp(SHOWN_POWER * np.nanmean(log_size - log_width)))


def elongation(excess: FloatArray, covariance: FloatArray, *, shown: float, prior: ShapePrior) -> Elongation:
    """Compare a round lump with an oval one, by the (2,) half log axis ratio of the map beyond a ball's.

    Its covariance is of the map's noise and of balls about their own curve; for `shown` see `shown_share`. Conjugate
    normal model; the odds are the ratio of the two marginal densities at the measured excess. The share is known to
    `SHOWN_CV` only, which matters to an oval lump alone: to first order it adds to the noise along the excess.
    """
    measured, noise = excess / shown, covariance / shown**2
    wide = noise + prior.oval_sd**2 * np.eye(2)
    log_odds = normal_log_density(measured, wide) - normal_log_density(measured, noise)
    log_odds += np.log(prior.oval_probability) - np.log1p(-prior.oval_probability)
    probability = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700, 700))))
    wide = wide + SHOWN_CV**2 * np.outer(measured, measured)
    gain = prior.oval_sd**2 * np.linalg.inv(wide)
    return Elongation(probability, gain @ measured, prior.oval_sd**2 * (np.eye(2) - gain))


def log_ratio_rotation(angle_rad: float) -> FloatArray:
    """(2, 2) matrix T that takes a half log axis ratio h to rotated axes as h @ T: half a turn changes nothing."""
    c, s = np.cos(2 * angle_rad), np.sin(2 * angle_rad)
    return np.array([[c, s], [-s, c]])


def normal_log_density(x: FloatArray, covariance: FloatArray) -> float:
    """Log density of a normal about 0, but for a constant."""
    _, log_det = np.linalg.slogdet(covariance)
    return float(-0.5 * (x @ np.linalg.solve(covariance, x) + log_det))


class Supposition(Record):
    """The size under a supposed value of one more property of the body, by the names of `HiddenTerms`."""

    name: str
    value: float
    log_shift: float  #: Shift of the median of ln d.
    sds: tuple[float, float]  #: SDs of ln d without and with it.

    @property
    def sd_ratio(self) -> float:
        """SD of ln d with it, over that without."""
        return self.sds[1] / self.sds[0] if self.sds[0] > 0 else 1.0

    @property
    def change(self) -> float:
        """Change of the size, as a share."""
        return float(np.expm1(self.log_shift))

    def moved(self, size: Quantity) -> tuple[float, float, float]:
        """Median and interval's ends of a size under this supposition."""
        median, ratio = float(size.median * np.exp(self.log_shift)), self.sd_ratio
        low, high = (float(median * (end / size.median) ** ratio) for end in (size.low, size.high))
        return median, low, high


def _finite_median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


class SizePosterior(Record, eq=False):
    """Draws of the lump's size: (chain, draw) diameters along the axes nearest to the head's x and y, mm.

    An invalid draw, whose amplitude or diameter is not positive, is NaN.
    """

    d_x_mm: FloatArray
    d_y_mm: FloatArray
    variance_share: dict[str, float]  #: Percent of the variance of ln(max size) by source; they sum to 100.
    invalid: int
    replicates: Labels
    """(chain * draw,) label of the independent replicate of each draw: their spread is the Monte-Carlo error."""
    figures: Mapping[str, float] = field(default_factory=dict)
    """Further figures: the probability of a lump that is not round, the spread between maps..."""
    another_exam: SizePosterior | None = None
    """The same if exams of a mass differ as much as in the paper's trial; None without a second interval."""
    supposing: Mapping[str, Supposition] = field(default_factory=dict)
    """Sizes under suppositions on the body, by the names of `bodies.SUPPOSED`."""
    known_sds: float = 0.0  #: How far what is known of the body moves ln d, in SDs that it has without.

    @property
    def max_size_mm(self) -> FloatArray:
        """(chain, draw) larger diameter of each draw. For a round lump its median lies above the true diameter."""
        return np.maximum(self.d_x_mm, self.d_y_mm)

    @property
    def min_size_mm(self) -> FloatArray:
        """(chain, draw) smaller diameter of each draw."""
        return np.minimum(self.d_x_mm, self.d_y_mm)

    @property
    def median_mm(self) -> float:
        """Median of the largest diameter over the draws that gave one; NaN where none did."""
        return _finite_median(self.max_size_mm)

    @property
    def axis_ratio(self) -> float:
        """Median ratio of the larger diameter to the smaller; NaN where no draw gave a size."""
        return _finite_median(self.max_size_mm / self.min_size_mm)

    @property
    def leading(self) -> SizePosterior:
        """The sizes that reports lead with, as `files.reports.Sized.leading`."""
        return self if self.another_exam is None else self.another_exam

    def reshaped(self, shape: tuple[int, ...]) -> SizePosterior:
        """The same draws as arrays of another shape, (chain, draw)."""
        another = None if self.another_exam is None else self.another_exam.reshaped(shape)
        d_x_mm, d_y_mm = self.d_x_mm.reshape(shape), self.d_y_mm.reshape(shape)
        return replace(self, d_x_mm=d_x_mm, d_y_mm=d_y_mm, another_exam=another)

    def summarise(self, name: str, *, probability: float) -> Quantity:
        """Summary of one of `SIZES`, with the Monte-Carlo error of its interval."""
        return summarise(getattr(self, name), probability=probability, replicates=self.replicates)


def shares(variances: Mapping[str, float]) -> dict[str, float]:
    """Percent of the sum of some variances."""
    total = float(sum(variances.values()))
    return {name: float(100.0 * value / total) if total > 0 else 0.0 for name, value in variances.items()}


# --- Spread of the sizes of one mass between its maps: prior, posterior, outlying maps, and tests of one size.
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
    return float(between.density() @ cochran_probability(centre, noise, between.grid))


def one_size_by_draws(log_sizes: Sequence[FloatArray], known: BetweenMaps | None) -> float:
    """`one_size_probability` of maps by the draws of each one's log size."""
    centre, noise = (np.array([of(size) for size in log_sizes]) for of in (np.nanmean, np.nanvar))
    return one_size_probability(centre, noise, known)


def cochran_probability(centre: FloatArray, noise: FloatArray, grid: FloatArray) -> FloatArray:
    """(n,) probability of Cochran's Q as large or larger, for each tau of a grid."""
    weight = 1.0 / (noise[:, None] + grid**2)
    mean = np.sum(weight * centre[:, None], axis=0) / weight.sum(axis=0)
    q = np.sum(weight * (centre[:, None] - mean) ** 2, axis=0)
    return np.asarray(chdtrc(len(centre) - 1, q))
