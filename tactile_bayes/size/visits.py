r"""A mass at several visits: whether it is one, the joint posterior of its sizes, their change and its rate.

As in `pooling`, map i of visit v gives :math:`g_{vi} = \ln d_v - B_v + E_{vi}`. The E of a visit's maps average out.
The coefficients of the calibration and a site's correction are the same at all visits, and B is to the degree that
`SharedBody` says: in :math:`\ln d_w - \ln d_v` all three cancel but for what a lump of another size changes of them.
The lump is taken to keep its form, so that largest and smallest size change by one factor.

Places are in the patient's frame, x and y in mm from the xiphoid (`geometry.patient_from_base`). Between visits one
mass comes out apart by :math:`\delta \sim N(0, S)`, :math:`S = C_1 + C_2 + s^2 I`: C of the maps' centres, s of the
posture and of touching the landmarks. The probability that one mass comes out as far apart or farther is
:math:`\exp(-\tfrac12 \delta^T S^{-1} \delta)`.

The specific growth rate of the volume is :math:`3\, d(\ln d)/dt`, and the doubling time ln 2 over it (Mehrara et al.
2007, Cancer Research 67:3970). The rate is the better figure: it is zero, not infinite, for a mass that stays, and its
interval is about as wide on both sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np
from scipy.special import chdtrc, ndtri

from tactile_bayes.declarations import Record
from tactile_bayes.findings import Finding
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference import draws
from tactile_bayes.presets import REGISTRATION_MM
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import BetweenMaps, ShapeDraws, matched_draws, normal_log_density
from tactile_bayes.size.pooling import POOLED_DRAWS, AveragedMaps, MassMaps, SizePriors, log_sizes, lump_shape

DIMENSIONS: Final = 6
"""Coordinates of the points: the spread between exams, that of B, three for the lump's shape, and the exponent of
`AmplitudeLaw`."""
LEAST_SAME: Final = 0.02  #: One mass in fifty is refused though it is the same.
CODES: Final = {"subject": "patients", "side": "sides", "mass": "masses"}
"""Facts of which one mass has only one, and their names for people."""
VOLUME: Final = 3.0  #: d ln V / d ln d of a lump that keeps its form.


class PatientPlace(Record, eq=False):
    """Place of a mass at one visit in the patient's frame; what posture and landmarks add is no part of it."""

    centre_mm: FloatArray
    covariance_mm2: FloatArray  #: Of the maps' centres.

    @classmethod
    def mean_of(cls, places: Sequence[PatientPlace]) -> PatientPlace | None:
        """Mean place of a visit's maps; None for none."""
        if not places:
            return None
        centre = np.mean([place.centre_mm for place in places], axis=0)
        covariance = np.sum([one.covariance_mm2 for one in places], axis=0) / len(places) ** 2
        return cls(centre, covariance)


class PlaceShift(Record):
    """Shift of a mass's place between two visits."""

    shift_mm: tuple[float, float]  #: From the earlier visit's place to the later one's.
    sd_mm: float  #: SD of the distance of one mass between visits, in the direction of the shift.
    probability: float  #: That one mass comes out as far apart or farther.

    @property
    def distance_mm(self) -> float:
        """Length of the shift."""
        return float(np.hypot(*self.shift_mm))

    @property
    def doubtful(self) -> bool:
        """True where one mass would come out so far apart in less than `LEAST_SAME`."""
        return self.probability < LEAST_SAME


def place_shift(earlier: PatientPlace, later: PatientPlace, *, registration_mm: float = REGISTRATION_MM) -> PlaceShift:
    """Compare the places of two visits; `registration_mm` is s, the SD each way of one mass's place between two."""
    shift = later.centre_mm - earlier.centre_mm
    spread = earlier.covariance_mm2 + later.covariance_mm2 + registration_mm**2 * np.eye(2)
    length = float(np.hypot(*shift))
    along = shift / length if length > 0 else np.array([1.0, 0.0])
    probability = float(np.exp(-0.5 * shift @ np.linalg.solve(spread, shift)))
    return PlaceShift((float(shift[0]), float(shift[1])), float(np.sqrt(along @ spread @ along)), probability)


def contradictions(visits: Mapping[str, Sequence[Mapping[str, str]]]) -> list[str]:
    """Contradictions between the exam facts that the scans of all visits give, in words; `visits`: by number."""
    texts = []
    for key, plural in CODES.items():
        first_visit: dict[str, str] = {}
        for number, scans in visits.items():
            for scan in scans:
                if scan.get(key):
                    first_visit.setdefault(scan[key], number)
        if len(first_visit) > 1:
            names = ", ".join(f"{value} (visit {number})" for value, number in first_visit.items())
            texts.append(f"the scans name different {plural}: {names}")
    return texts


def one_place_probability(places: Sequence[PatientPlace], *, registration_mm: float = REGISTRATION_MM) -> float:
    r"""Probability that the places of one mass come out as far apart or farther.

    As `one_size_probability` in the plane, with :math:`S_i = C_i + s^2 I / 2`; for two places as `place_shift`.
    """
    if len(places) < 2:
        return 1.0
    centres = np.stack([place.centre_mm for place in places])
    weights = np.linalg.inv(np.stack([one.covariance_mm2 + 0.5 * registration_mm**2 * np.eye(2) for one in places]))
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("kij,kj->i", weights, centres))
    q = float(np.einsum("ki,kij,kj->", centres - mean, weights, centres - mean))
    return float(chdtrc(2 * (len(places) - 1), q))


class SharedBody(Record):
    r"""Law of the correlation of B between visits of one body.

    B is a function of properties that stay (stiffness, moduli) and of some that change as a lump grows (seat, depth
    over size). At visits v and w, B over its SD has the correlation

    .. math:: \rho_{vw} = (1 - f)\, \exp\Big(-\tfrac12 (g_v - g_w)^2 / \lambda^2\Big)

    where g is the log size by the maps. f is the share of B's variance that another posture draws anew though the lump
    is the same; the rest of a change in B grows with the square of the growth, as of any smooth function.
    """

    redrawn: float  #: f, 0 to 1.
    length: float  #: Lambda, above 0.

    def correlation(self, log_size: FloatArray) -> FloatArray:
        """(v, v) correlation matrix of visits whose maps give these (v,) log sizes."""
        growth = (log_size[:, None] - log_size) / self.length
        correlation = (1.0 - self.redrawn) * np.exp(-0.5 * growth**2)
        np.fill_diagonal(correlation, 1.0)
        return np.asarray(correlation)


SHARED_BODY: Final = SharedBody(0.11, 0.48)
"""Learned from simulated visits, see record 0132: ``python -m validation visits law``."""
SHARED_WITHOUT_DEPTH: Final = SharedBody(0.19, 0.39)
"""Without a depth of fat: most of B is then that depth, which stays as the lump grows."""
STRANGERS: Final = SharedBody(1.0, 1.0)  #: Nothing shared: visits as independent estimates.


class AmplitudeLaw(Record):
    r"""How the amplitude of one mass goes with its size d and with a posture.

    Between bodies an amplitude depends on the depth and the stiffness of a lump. From visit to visit these stay, and

    .. math:: \Delta \ln a = \alpha\, \Delta \ln d - \beta\, \Delta \ln s + \epsilon

    with s the factor by which a posture multiplies every depth, also that of the fat, F. Where a lump grows to is not
    known: alpha is log-uniform from `least`, where the face next to the skin keeps its depth, to `most`, where the far
    face does.
    """

    least: float
    most: float
    posture: float  #: Beta.
    posture_sd: float  #: Of ln s.
    fat_sd: float  #: Of ln F between exams of one posture.
    exam_factor: float  #: SD of ln a between exams, beside the maps' noise, over that of ln d.
    otherwise: float  #: Probability that something else changes the amplitude, with an SD of 1 in ln a.

    @property
    def exponents(self) -> FloatArray:
        """Values of alpha, equally probable before the maps."""
        return np.geomspace(self.least, self.most, 15)

    def at_common_depth(
        self, parts: Sequence[AveragedMaps], fitted: Sequence[BodyCalibration]
    ) -> tuple[FloatArray, FloatArray]:
        """(v, n) ln a corrected to the mean depth of fat, and its (v,) remaining variances by posture and exams."""
        log_amplitude = np.stack([part.log_amplitude for part in parts])
        exams = self.exam_factor**2 * np.array([np.mean(one.variance) for one in parts])
        trust, posture = np.zeros(len(parts)), self.posture_sd**2
        depths = [one.fat_mm for one in fitted if one.fat_mm is not None]
        if len(depths) == len(fitted):
            trust = posture / (posture + self.fat_sd**2 / np.array([len(one.weight) for one in parts]))
            log_fat = np.log(depths)
            log_amplitude += (self.posture * trust * (log_fat - log_fat.mean()))[:, None]
        return log_amplitude, exams + self.posture**2 * posture * (1.0 - trust)


AMPLITUDE_LAW: Final = AmplitudeLaw(1.0, 6.2, 3.5, 0.04, 0.02, 3.6, 0.1)
"""From the bodies of the calibration's table, see record 0134: ``python -m validation visits amplitude``."""


class Change(Record, eq=False):
    """Change of a mass between two visits."""

    log_ratio: FloatArray  #: (n,) draws of ln of the later size over the earlier one.
    mean: FloatArray
    sd: FloatArray  #: (n,) of the normal that each draw comes from.
    replicates: draws.Labels  #: (n,) label of the independent replicate of each draw.

    def probability_above(self, share: float) -> float:
        """Probability that the size grew by more than this share of it (0.2: by more than 20 %)."""
        return float(np.mean(draws.normal_cdf((self.mean - np.log1p(share)) / self.sd)))

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

    def percent(self, probability: float) -> draws.Quantity:
        """Summary of the change of the diameter in percent."""
        return draws.summarise(100.0 * np.expm1(self.log_ratio), probability=probability, replicates=self.replicates)

    def log_summary(self, probability: float) -> draws.Quantity:
        """Summary of the log ratio."""
        return draws.summarise(self.log_ratio, probability=probability, replicates=self.replicates)


class JointSizes(Record, eq=False):
    """Joint posterior of the sizes of one mass at v visits."""

    log_size: FloatArray  #: (v, n) draws of ln of the largest size in mm.
    mean: FloatArray
    covariance: FloatArray  #: (v, n) and (n, v, v) of the normals that the draws come from.
    replicates: draws.Labels
    between_map_sd: float  #: Spread between exams of a visit, root mean square.
    correlation: FloatArray  #: (v, v) of B between the visits.
    calibrations: tuple[BodyCalibration, ...]  #: One per visit: at the depth of fat that its maps give.

    def change(self, earlier: int, later: int) -> Change:
        """Change from one visit to another."""
        c = self.covariance
        sd = np.sqrt(np.maximum(c[:, later, later] + c[:, earlier, earlier] - 2.0 * c[:, later, earlier], 1e-18))
        mean = self.mean[later] - self.mean[earlier]
        drawn = draws.stratified_quantiles(self.log_size[later] - self.log_size[earlier], mean, sd, self.replicates)
        return Change(drawn, mean, sd, self.replicates)

    def size_mm(self, visit: int, probability: float) -> draws.Quantity:
        """Summary of the largest size at a visit."""
        return draws.summarise(np.exp(self.log_size[visit]), probability=probability, replicates=self.replicates)

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
    amplitudes: AmplitudeLaw | None = AMPLITUDE_LAW,
    number: int = POOLED_DRAWS,
) -> JointSizes:
    """Joint posterior of a mass's sizes at several visits, from the maps of each on which the lump was found.

    The calibration is used at the depth of fat that each visit's maps tell; known properties of the body are
    ignored. `between` is a spread between exams in place of the priors', `law` how far B is the same at the visits, by
    default `SHARED_BODY`, or `SHARED_WITHOUT_DEPTH` where maps tell no depth. None for `amplitudes` leaves them out.
    """
    fits = visit_calibrations(visits, calibration)
    between = between or priors.between_maps or calibration.between_exams
    flat = [one for maps in visits for one in maps]
    matched, replicates = matched_draws(flat, number, rng)
    ends = np.cumsum([len(maps) for maps in visits])
    spans = zip(visits, ends, fits, strict=True)
    parts = [MassMaps.of(matched[end - len(maps) : end], fit) for maps, end, fit in spans]
    middle = np.mean([one.by_map.mean(axis=0) for one in parts], axis=0)
    points = draws.paired_points(middle, replicates, DIMENSIONS, rng)
    tau = between.at(points[:, 0], *[(one.centre, one.noise) for one in parts])  # one for all visits
    sizes = [size for maps, fit in zip(visits, fits, strict=True) for size in log_sizes(fit, maps)]
    oval, _ = lump_shape(fits[0], flat, sizes, priors.shape)
    half = oval.at(points[:, 2:5])
    averaged = [part.averaged(tau) for part in parts]
    if law is None:
        law = SHARED_WITHOUT_DEPTH if fits[0].fat_mm is None else SHARED_BODY
    correlation = law.correlation(np.array([float(np.nanmean(one.mean)) for one in averaged]))
    covariance = _covariance(averaged, fits, correlation, ndtri(points[:, 1]))
    mean = np.stack([one.mean for one in averaged]) + np.hypot(half[:, 0], half[:, 1])
    if amplitudes is not None:
        left, noise = amplitudes.at_common_depth(averaged, fits)
        mean, covariance = _with_amplitudes(mean, covariance, left, noise, amplitudes, points[:, 5])
    drawn = _draw_sizes(mean, covariance, rng.standard_normal((len(replicates), len(visits))), replicates)
    spread = float(np.sqrt(np.mean(tau**2)))
    return JointSizes(drawn, mean, covariance, replicates, spread, correlation, tuple(fits))


def visit_calibrations(visits: Sequence[Sequence[ShapeDraws]], calibration: BodyCalibration) -> list[BodyCalibration]:
    """The calibration at the depth of fat estimated from each visit's maps.

    Posture changes that depth by some per cent, and the lump's own with it: at one depth for all visits that would
    count as a change of size. Where one visit gives no depth, none is used: B with a depth is another quantity than B
    without.
    """
    fitted = [calibration.for_maps(maps) for maps in visits]
    without = [one for one in fitted if one.fat_mm is None]
    return [without[0]] * len(fitted) if without else fitted


def _covariance(
    parts: Sequence[AveragedMaps], fitted: Sequence[BodyCalibration], correlation: FloatArray, score: FloatArray
) -> FloatArray:
    """(n, v, v) covariance of ln d at the visits given each draw of the maps."""
    terms, exams, widths = (
        np.stack([getattr(part, name) for part in parts], axis=1) for name in ("terms", "variance", "log_width")
    )
    pairs = zip(parts, fitted, strict=True)
    bodies = np.stack([at.body_sd(one.log_amplitude, one.log_width, score) for one, at in pairs], axis=1)
    covariance = bodies[:, :, None] * correlation * bodies[:, None, :]
    covariance = covariance + (terms @ fitted[0].coefficient_covariance) @ np.swapaxes(terms, 1, 2)
    covariance[:, range(len(parts)), range(len(parts))] += exams
    if (site := fitted[0].site) is not None:
        widths = widths - site.centre
        about = np.stack([np.ones_like(widths), widths], axis=-1)
        covariance = covariance + (about @ site.covariance) @ np.swapaxes(about, 1, 2)
    return np.asarray(covariance)


def _with_amplitudes(
    mean: FloatArray,
    covariance: FloatArray,
    log_amplitude: FloatArray,
    noise: FloatArray,
    law: AmplitudeLaw,
    points: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(v, n) means and (n, v, v) covariances of ln d given how the amplitudes changed.

    By an exponent alpha, ln a - alpha ln d is one at all visits but for its (v,) noise. Sizes and amplitudes are of the
    same draws of the maps, and each draw is corrected by its departure from that (Matheron's rule). The exponent of
    each draw, or that there is none, is from the posterior, by (n,) uniform points.
    """
    v, exponents = len(mean), law.exponents
    contrasts = np.diff(np.eye(v), axis=0)
    departs = contrasts @ (log_amplitude - exponents[:, None, None] * mean)
    finite = np.isfinite(departs).all(axis=(0, 1))
    within, noise_covariance = covariance[finite].mean(axis=0) @ contrasts.T, contrasts * noise @ contrasts.T
    gains, scores = [], []
    for alpha, one in zip(exponents, departs[:, :, finite], strict=True):
        of_draws = np.cov(mean[:, finite], one)[:, v:]
        spread = of_draws[v:] + alpha**2 * contrasts @ within + noise_covariance
        gains.append((of_draws[:v] - alpha * within) @ np.linalg.inv(spread))
        scores.append(normal_log_density(one.mean(axis=1), spread))
    changed = (contrasts @ log_amplitude)[:, finite].mean(axis=1)
    scores.append(normal_log_density(changed, contrasts @ contrasts.T))
    prior = np.append(np.full(len(exponents), (1.0 - law.otherwise) / len(exponents)), law.otherwise)
    weight = np.cumsum(prior * np.exp(np.array(scores) - max(scores)))
    index = np.searchsorted(weight[:-1] / weight[-1], points)
    exponents, departs = np.append(exponents, 0.0), np.concatenate([departs, np.zeros_like(departs[:1])])
    gains.append(np.zeros_like(gains[0]))
    gain = np.stack(gains)[index]
    moved = np.einsum("nvc,nc->vn", gain, departs[index, :, np.arange(len(points))])
    projection = np.eye(v) + exponents[index, None, None] * gain @ contrasts
    corrected = projection @ covariance @ np.swapaxes(projection, 1, 2)
    return mean - moved, corrected + gain @ noise_covariance @ np.swapaxes(gain, 1, 2)


def _draw_sizes(mean: FloatArray, covariance: FloatArray, z: FloatArray, replicates: draws.Labels) -> FloatArray:
    """(v, n) draws of ln d, each visit's with the evenly spaced quantiles of its mixture of normals."""
    v = len(mean)
    finite = np.isfinite(covariance).all(axis=(1, 2))
    root = np.full_like(covariance, np.nan)
    root[finite] = np.linalg.cholesky(covariance[finite] + 1e-12 * np.eye(v))
    raw = mean + np.einsum("nvw,nw->vn", root, z)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    return np.stack([draws.stratified_quantiles(raw[i], mean[i], sd[i], replicates) for i in range(v)])


class Trend(Record):
    """Straight line of ln d over time: its level at the middle of the times, its slope and the slope's SD."""

    level: float
    per_day: float
    sd: float
    departure: float | None
    """Probability that sizes on a straight line come out as far from one or farther; None for two visits."""


def straight_line(log_size: FloatArray, covariance: FloatArray, days: Sequence[float]) -> Trend:
    """Fit ln d of several visits by generalised least squares, flat priors; what they share cancels in the slope."""
    columns = np.stack([np.ones(len(days)), np.array(days) - np.mean(days)], axis=1)
    weighted = np.linalg.solve(covariance, columns)
    spread = np.linalg.inv(columns.T @ weighted)
    line = spread @ (weighted.T @ log_size)
    left = log_size - columns @ line
    square, dof = left @ np.linalg.solve(covariance, left), len(days) - 2
    departure = float(chdtrc(dof, square)) if dof > 0 else None
    return Trend(float(line[0]), float(line[1]), float(np.sqrt(spread[1, 1])), departure)


class VisitComparison(Record, eq=False):
    """Comparison of visits and its sizes."""

    status: Literal["compared", "not_one_mass", "no_estimate"]
    reason: str = ""
    advice: str = ""  #: Why there is no comparison, and what would help; empty where there is one.
    shifts: tuple[PlaceShift | None, ...] = ()
    """How far the mass of each later visit lies from the first's; None where landmarks do not show it."""
    findings: tuple[Finding, ...] = ()  #: Findings against the comparison.
    joint: JointSizes | None = None
    another: JointSizes | None = None
    """Sizes with the calibration's or the site's spread between exams, and with the paper's."""
    on_paper: str = ""  #: `advice` without options of the command line; empty where it names none.
