r"""Learning of a site's own figures: the shift from its phantoms, and the spread from its repeated exams.

Phantom i with known properties :math:`k_i` (depth, seat, stiffness, as far as they are stated) has, over its n_i maps,

.. math:: y_i = \overline{\ln d_i - g_{ij}} - E[B_i \mid k_i] = c_0 + c_1 (p_i - p_0) + s_i M + B_i + E_i

:math:`B_i \sim N(0, (k r_i b_i)^2)`: of the calibration's spread between bodies b_i the share that known properties
leave. M, standard normal, is what phantoms of one set have in common and nobody stated, and what the linear
expectation of B gets wrong for all of them: it belongs to them, not to the site. :math:`E_i` is the spread between
exams over n_i, times k, beside the maps' own noise. k is the phantoms' spread over the calibration's. Given k all is
linear and normal, so c_0 and c_1 have a posterior in closed form; k is summed over a grid, and the mixture is handed on
as a normal of its mean and covariance.

Spread between exams of one mass: exam j of mass i gives :math:`g_{ij} = \mu_i + E_{ij} + e_{ij}`, with
:math:`E_{ij} \sim N(0, \tau^2)` between exams and :math:`e_{ij} \sim N(0, v_{ij})` the map's own error. Nothing is
supposed of :math:`\mu_i`: the mass's size, and all that its body does to every map of it, cancel. The restricted
likelihood of tau is the product over masses of that of one mass, `restricted_log_likelihood`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, names_of, replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws, cochran_probability, restricted_log_likelihood
from tactile_bayes.size.pooling import PROBABILITY, Repeatability, log_sizes
from tactile_bayes.size.terms import SiteShift

LEAST_PHANTOMS = 3
SHARED = ("seat", "stiffness_ratio", "fat_kpa", "gland_ratio", "thickness_mm")
"""Properties that phantoms of one set may have in common: those made alike, or of one block of material."""
LACK = 0.5
"""Share of what all properties leave of B that phantoms of a set have in common: B is not linear in its properties, and
two sets of the same sizes in two seats differ by 7 to 11 % (record 0102)."""
_GRID = np.geomspace(0.1, 10.0, 81)
FAR = 3.0  #: Standard deviations of the prior beyond which a shift is named.
APART = 3.5  #: The same of the prediction for a phantom.
SLOPE_OPEN, ALIKE = 0.8, 0.2
"""A slope is open where it keeps this share of the prior's SD, and the SD of the phantoms' ln sigma is below this."""
MOST_SPREAD = 2.0


class SitePrior(Record):
    """Prior of a site's shift, as standard deviations; see docs/decisions/0102 for the figures."""

    shift_sd: float = 0.15  #: SD of c_0: how far off all sizes of a site may be, in ln d.
    slope_sd: float = 0.10  #: SD of c_1: how much more wide maps than narrow ones.
    spread_log_sd: float = 0.5  #: SD of ln k, about 0.

    @property
    def sd(self) -> FloatArray:
        """(2,) of c_0 and c_1."""
        return np.array([self.shift_sd, self.slope_sd])


PRIOR: Final = SitePrior()


class PhantomMap(Record, eq=False):
    """One map of a phantom: draws, or a single point; maps of one phantom share its name and diameter."""

    phantom: str
    d_mm: float
    shape: ShapeDraws
    known: Mapping[str, float]  #: The phantom's properties, by the names of `HiddenTerms`.


class PhantomResiduals(Record, eq=False):
    """Residuals of n phantoms under a calibration, each (n,)."""

    residual: FloatArray  #: y.
    width: FloatArray  #: p - p_0, mean over the maps.
    spread_variance: FloatArray  #: Variance of B and E, before the factor k^2.
    map_variance: FloatArray  #: Variance of the maps' own noise.
    common: FloatArray  #: s: loading of what the phantoms share.

    @property
    def design(self) -> FloatArray:
        """(n, 3) derivatives of y by c_0, c_1 and M."""
        return np.stack([np.ones_like(self.width), self.width, self.common], axis=1)


class ShiftPosterior(Record, eq=False):
    """Posterior of c_0, c_1 and M, and posterior means of k and k^2."""

    mean: FloatArray
    covariance: FloatArray
    spread: float
    spread_square: float


def shift_posterior(data: PhantomResiduals, prior: SitePrior = PRIOR) -> ShiftPosterior:
    """Posterior of a site's shift given the residuals of its phantoms under the calibration."""
    x, y, precision = data.design, data.residual, np.diag(1.0 / np.append(prior.sd, 1.0) ** 2)
    weight = 1.0 / (_GRID[:, None] ** 2 * data.spread_variance + data.map_variance)
    squares = (x[:, :, None] * x[:, None, :]).reshape(len(x), -1)
    information = (weight @ squares).reshape(-1, *precision.shape) + precision
    projected = weight @ (x * y[:, None])
    covariance = np.linalg.inv(information)
    mean = (covariance @ projected[..., None])[..., 0]
    log = 0.5 * (np.log(weight).sum(axis=1) - np.linalg.slogdet(information)[1] - weight @ y**2)
    log += 0.5 * np.sum(projected * mean, axis=1) - 0.5 * (np.log(_GRID) / prior.spread_log_sd) ** 2
    share = np.exp(log - log.max())  # even steps in ln k, in which the prior is normal
    share /= share.sum()
    centre = share @ mean
    deviation = mean - centre
    covariance_total = np.tensordot(share, covariance, 1) + (share * deviation.T) @ deviation
    return ShiftPosterior(centre, covariance_total, float(share @ _GRID), float(share @ _GRID**2))


def correct_calibration(
    calibration: BodyCalibration, maps: Sequence[PhantomMap], *, base: str, left_out: Sequence[str] = ()
) -> BodyCalibration:
    """The calibration, called `base` in reports, with a site's correction.

    It takes at least `LEAST_PHANTOMS` phantoms in the calibration's range, made and fitted by its recipe; `left_out`
    says in words which phantoms were left out before. A calibration that is corrected already is a
    `BadDataError`.
    """
    if calibration.site is not None:
        raise BadDataError(f"{base} is corrected already", way_out="give the calibration that it corrects")
    groups: dict[str, list[PhantomMap]] = {}
    for one in maps:
        groups.setdefault(one.phantom, []).append(one)
    rows: dict[str, tuple[float, ...]] = {}
    with_fat, out = 0, list(left_out)
    for name, group in groups.items():
        rises = all(np.isfinite(one.shape.log_amplitude).any() for one in group)
        applied = calibration.for_maps([one.shape for one in group]) if rises else calibration
        if why := _misfit(applied, group) if rises else "a map does not rise above its background":
            out.append(f"{name}: {why}")
            continue
        rows[name] = _row(applied, group)
        with_fat += applied.fat_mm is not None or calibration.depth is None
    if len(rows) < LEAST_PHANTOMS:
        why = f" ({'; '.join(out)})" if out else ""
        raise BadDataError(
            f"{len(rows)} phantom{'' if len(rows) == 1 else 's'} in the range of {base}{why}",
            way_out=f"a correction needs at least {LEAST_PHANTOMS} distinct phantoms; 5 to 20 are better",
        )
    data = PhantomResiduals(*np.array(list(rows.values())).T)
    posterior = shift_posterior(data)
    left = data.residual - data.design[:, :2] @ posterior.mean[:2]
    site = SiteShift(
        centre=calibration.centre.log_width,
        mean=posterior.mean[:2],
        covariance=posterior.covariance[:2, :2],
        phantoms=len(rows),
        maps=sum(len(groups[name]) for name in rows),
        base=base,
        uses_fat=2 * with_fat > len(rows),
        fit={
            "log_width": float(data.width.mean() + calibration.centre.log_width),
            "spread_factor": posterior.spread,
            "sd_before": float(np.sqrt(np.mean(data.residual**2))),
            "sd_after": float(np.sqrt(np.mean(left**2))),
        },
        cautions=_cautions(calibration, {name: groups[name][0].known for name in rows}, data, posterior),
        left_out=tuple(out),
    )
    return replace(calibration, site=site)


def _misfit(applied: BodyCalibration, maps: Sequence[PhantomMap]) -> str:
    """Reason why a phantom is left out; empty where it is used."""
    applied = replace(applied, unlike=None)  # beyond the depth's range it is sized without the depth, as any map is
    for one in maps:
        if outside := applied.outside(*one.shape.middle):
            return "; ".join(outside)
    return ""


def _row(applied: BodyCalibration, maps: Sequence[PhantomMap]) -> tuple[float, ...]:
    """Residual of a phantom under the calibration, as the columns of `PhantomResiduals`."""
    log_size = log_sizes(applied, [one.shape for one in maps])
    log_a = np.array([np.nanmean(one.shape.log_amplitude) for one in maps])
    log_width = np.array([np.nanmean(one.shape.log_width) for one in maps])
    left = np.array([np.log(m.d_mm) - np.nanmean(size) for m, size in zip(maps, log_size, strict=True)])
    body_sd = applied.body_sd(log_a, log_width, np.zeros(len(maps))).mean()
    table_sd = float(applied.table_sd(body_sd))
    expected, alone, together = _known(applied, maps[0].known, (float(log_a.mean()), float(log_width.mean())), table_sd)
    n = len(maps)
    exam = applied.between_exams.sd**2 / n
    noise = float(np.mean([np.nanvar(size) for size in log_size])) / n
    width = float(log_width.mean()) - applied.centre.log_width
    variance = alone + applied.other_sd**2 + exam
    return float(left.mean()) - expected, width, variance, noise, float(np.sqrt(together))


def _known(
    calibration: BodyCalibration, known: Mapping[str, float], middle: tuple[float, float], table_sd: float
) -> tuple[float, float, float]:
    """E[B] given known properties, and the variance of B that is the phantom's own and that its set shares.

    `middle` is ln a and p of its maps; `table_sd` is SD(B) there.
    """
    hidden = calibration.hidden
    if hidden is None:
        return 0.0, table_sd**2, 0.0
    explained_sd = min(table_sd, hidden.most_sd)
    stated = {name: value for name, value in known.items() if name in hidden.names}
    shared = [name for name in SHARED if name in hidden.names and name not in stated]
    by_stated = explained_sd**2 * hidden.share(*stated) if stated else 0.0
    by_both = explained_sd**2 * hidden.share(*stated, *shared) if stated or shared else 0.0
    lack = LACK * (table_sd**2 - explained_sd**2 * hidden.share(*hidden.names))
    individual, common = table_sd**2 - by_both - lack, by_both - by_stated + lack
    if not stated:
        return 0.0, individual, common
    features = calibration.features(np.array(middle[0]), np.array(middle[1]))
    return explained_sd * float(hidden.expected_departure(stated, features)), individual, common


def _cautions(
    calibration: BodyCalibration,
    known: Mapping[str, Mapping[str, float]],
    data: PhantomResiduals,
    posterior: ShiftPosterior,
) -> tuple[str, ...]:
    """Cautions on a correction, from the phantoms' known properties by name."""
    lines = []
    without = sum("depth_mm" not in one for one in known.values())
    if without and calibration.hidden is not None and "depth_mm" in calibration.hidden.names:
        lines.append(
            f"{without} of {len(known)} phantoms have no depth_ratio: where they lie deeper or shallower than lumps of "
            "the calibration, this passes for the site's; state depth_ratio, seat and stiffness_ratio"
        )
    for value, sd, what in zip(posterior.mean[:2], PRIOR.sd, ("shift", "slope with ln sigma"), strict=True):
        if abs(value) > FAR * sd:
            lines.append(
                f"the {what} of {value:+.2f} in ln d is {abs(value) / sd:.1f} times what sites are expected to differ "
                "by: check the sizes' unit, the recipe of the maps and the head"
            )
    if data.width.std() < ALIKE and np.sqrt(posterior.covariance[1, 1]) > SLOPE_OPEN * PRIOR.slope_sd:
        lines.append(
            "the phantoms' maps are too alike in width to tell whether the shift changes with it: "
            "add smaller and larger phantoms"
        )
    if posterior.spread > MOST_SPREAD:
        lines.append(
            f"the phantoms scatter {posterior.spread:.1f} times as much as the calibration expects: "
            "check their sizes, depths, seats and stiffness"
        )
    for i, name in enumerate(known):  # those that lie far from what the others predict
        rest = PhantomResiduals(*(np.delete(getattr(data, column), i) for column in names_of(PhantomResiduals)))
        others, x = shift_posterior(rest), data.design[i]
        variance = x @ others.covariance @ x + others.spread_square * data.spread_variance[i] + data.map_variance[i]
        score = float((data.residual[i] - x @ others.mean) / np.sqrt(variance))
        if abs(score) > APART:
            lines.append(f"{name} lies {abs(score):.1f} SDs from what the other phantoms predict: look at its map")
    return tuple(lines)


FEWEST_MASSES: Final = 3
PRIOR_MEDIAN: Final = 0.08
"""Prior median of tau: between the spread of simulated exams (5 %) and that of the paper's maps (15 %)."""
PRIOR_LOG_SD: Final = 1.0  #: 95 % of the prior lies between 1.1 and 57 %.
FALSE_ALARMS: Final = 0.05  #: Share of sites with nothing wrong at which some mass is named as outlying.
GRID: Final = np.geomspace(1e-3, 1.5, 600)


class RepeatedExams(Record, eq=False):
    """Exams of one mass at one visit: (k,) mean and variance of ln d by each map alone."""

    name: str  #: Name of the mass at this visit.
    mass: str  #: Name of the mass at any visit.
    centre: FloatArray
    noise: FloatArray


class LearnedSpread(Record, eq=False):
    """Spread from repeated exams: posterior weights on `GRID`, and their summary."""

    density: FloatArray
    by_chance: tuple[float, ...]
    """Probability, by the other masses, of exams as far apart as those of each mass and visit."""
    repeatability: Repeatability


def learn_repeatability(repeats: Sequence[RepeatedExams], *, fewest: int = FEWEST_MASSES) -> LearnedSpread:
    """Learn the spread between exams of one mass, from `fewest` masses or more with two exams or more at each visit.

    Those of one mass are left out together when its exams are compared with the others'.
    """
    masses = sorted({one.mass for one in repeats})
    if len(masses) < fewest:
        what = f"{len(masses)} {'mass has' if len(masses) == 1 else 'masses have'} repeated exams with sizes"
        way_out = f"give at least {fewest}: one or two masses do not tell an unusual mass from a site's spread"
        raise BadDataError(what, way_out=way_out)
    by_exams = np.stack([restricted_log_likelihood(one.centre, one.noise, GRID) for one in repeats])
    density = _density(by_exams.sum(axis=0))
    by_chance = []
    for one in repeats:
        others = [row for row, other in zip(by_exams, repeats, strict=True) if other.mass != one.mass]
        chances = cochran_probability(one.centre, one.noise, GRID)
        by_chance.append(float(_density(np.sum(others, axis=0)) @ chances))
    limit = FALSE_ALARMS / len(repeats)
    outlying = tuple(one.name for one, chance in zip(repeats, by_chance, strict=True) if chance < limit)
    maps = sum(len(one.centre) for one in repeats)
    return LearnedSpread(density, tuple(by_chance), _summary(density, len(masses), maps, outlying))


def _density(log_likelihood: FloatArray) -> FloatArray:
    """(n,) posterior weights on the grid, whose steps in ln tau are even."""
    log = log_likelihood - 0.5 * (np.log(GRID / PRIOR_MEDIAN) / PRIOR_LOG_SD) ** 2
    density = np.exp(log - log.max())
    return np.asarray(density / density.sum())


def _summary(density: FloatArray, masses: int, maps: int, outlying: tuple[str, ...]) -> Repeatability:
    """Quantiles, and the log-normal with the same means of tau^2 and tau^4: a map's size has tau in its variance."""
    square, fourth = float(density @ GRID**2), float(density @ GRID**4)
    tails = 0.5 * (1.0 - PROBABILITY)
    low, median, high = np.interp((tails, 0.5, 1.0 - tails), np.cumsum(density) - 0.5 * density, GRID).tolist()
    log_sd = float(np.sqrt(max(np.log(fourth / square**2), 0.0) / 4.0))
    return Repeatability(float(np.sqrt(square)), log_sd, median, low, high, masses, maps, outlying=outlying)
