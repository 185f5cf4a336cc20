"""Parts that size calibrations are made of: recipe and range of their maps, the depth of fat, what Eq 6 leaves,
what no map shows, a site's correction.

Bodies simulated beyond the ranges of a table decide what follows outside (docs/decisions/0069): not far outside,
intervals hold and the size is given with a caution; farther out nothing is known of them, and there is no size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import accumulate
from typing import Annotated, Final, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Meta, Record, described, field
from tactile_bayes.errors import Abstention, BadDataError
from tactile_bayes.findings import LEADS
from tactile_bayes.geometry import BoolArray, FloatArray, Matrix, Vector
from tactile_bayes.presets import HEAD_PROFILE, INTERVAL, Background, Noise
from tactile_bayes.scans import HeadShape

LEARN_ANEW: Final = "learn the calibration anew"
_RANGES: Final = ("amplitude", "sigma_mm", "d_mm")
Normalise = Literal["mean", "gain", "none"]
Range = tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]]
Domain = Annotated[Mapping[str, Range], described("Ranges in the table.", extra_json_schema={"required": [*_RANGES]})]
"""Ranges of amplitude, sigma_mm (geometric mean) and d_mm."""
Share = Annotated[float, Meta(ge=0)]
Above0 = Annotated[float, Meta(gt=0)]
FARTHEST: Final = {"amplitude": 2.0, "sigma_mm": 1.2}
"""Sizes are given up to this multiple of the largest value in the table, and down to its smallest over it."""
UNLIKE_LEARNED: Final = "unlike the lumps that sizes were learned from"
UNLIKE_ON_PAPER: Final = f"nothing by this exam: the lump is {UNLIKE_LEARNED}"
ONE_WIDTH: Final = "a difference between the head's axes: the calibration has one width"
SPREAD: Final = "spread between maps of one mass (15 % in the paper): this is one map"
LOGGED: Final = ("depth_mm", "stiffness_ratio", "fat_kpa", "gland_ratio")
"""Properties that vary and enter by their logarithm, but for those that enter by their inverse."""
INVERTED: Final = ("stiffness_ratio",)
"""Properties by whose inverse a size goes: 50 times as stiff as fat and 100 times are both nearly rigid."""
MOST_SHARE: Final = 0.9
"""Share of B's variance that all properties together tell at most.

In the second moments it comes out above 1, because SD(B) is learned apart from them (record 0118).
"""


def check_shapes(record: object, *, finite: bool = True, **shapes: tuple[int, ...]) -> None:
    """Refuse arrays of a record, by name, that have another shape or hold a number that is not finite."""
    for name, shape in shapes.items():
        values = getattr(record, name)
        if values.shape != shape or (finite and not np.isfinite(values).all()):
            actual, expected = ("x".join(map(str, one)) for one in (values.shape, shape))
            raise BadDataError(f"{name} has {actual} numbers for {expected} finite ones", way_out=LEARN_ANEW)


def check_domain(domain: Domain) -> None:
    """Refuse ranges without amplitude, sigma_mm or d_mm."""
    if missing := [name for name in sorted(_RANGES) if name not in domain]:
        raise BadDataError(f"domain has no {missing[0]}", way_out=LEARN_ANEW)


def powers(order: int) -> tuple[tuple[int, int], ...]:
    """Powers of two variables up to an order in all, lower orders first: 1, u, v, u2, uv, v2, u3..."""
    return tuple((total - j, j) for total in range(order + 1) for j in range(total + 1))


def monomials(values: Sequence[FloatArray], exponents: Sequence[tuple[int, ...]]) -> FloatArray:
    """(..., terms) products of the (...) values' powers."""
    highest = max(max(power) for power in exponents)
    raised = []
    for value in values:
        base = np.asarray(value, dtype=np.float64)
        raised.append(list(accumulate([np.ones_like(base), *[base] * highest], np.multiply)))
    products = np.stack([raised[0][power[0]] for power in exponents], axis=-1)
    for i in range(1, len(values)):
        products *= np.stack([raised[i][power[i]] for power in exponents], axis=-1)
    return products


class Recipe(Record):
    """How a table's maps were built and fitted; a patient's map must agree."""

    normalise: Normalise  #: As the option of `map`.
    background: Background  #: Whether the fit had a level of its own.
    radius_mm: Annotated[float, Meta(gt=0)]  #: Of the fitted window.
    declared: bool  #: true: stated for a table made elsewhere; false: the program made the maps.
    noise: Noise = "independent"  #: independent: least squares; field: correlated noise.
    flat_field: bool | None = None  #: Whether the head's own response was taken off; null where nobody says.
    head: HeadShape | None = None  #: Head that the maps were made with; null where nobody says.

    @property
    def _settings(self) -> dict[str, str]:
        """The known settings in words, by name."""
        radius = f"{self.radius_mm:g} mm"
        words = {
            "normalise": self.normalise, "background": self.background, "fit radius": radius, "noise": self.noise
        }  # fmt: skip
        return words if self.flat_field is None else words | {"flat field": "on" if self.flat_field else "off"}

    def differences(self, other: Recipe) -> list[str]:
        """Differences from another recipe in words; empty without any. Unknown settings do not differ."""
        other_settings = other._settings
        pairs = [(name, mine, other_settings.get(name, mine)) for name, mine in self._settings.items()]
        texts = [f"{name} {theirs} (the calibration: {mine})" for name, mine, theirs in pairs if theirs != mine]
        return texts + self.head_differences(other.head)

    def head_differences(self, head: HeadShape | None) -> list[str]:
        """Differences of a map's head from the calibration's, in words; none where one of them is unknown."""
        return [] if self.head is None or head is None else self.head.differences(head)

    @property
    def map_command(self) -> str:
        """The command that makes maps of this recipe from a scan."""
        return f"`map --normalise {self.normalise}{' --flat-field' if self.flat_field else ''}`"

    def __str__(self) -> str:
        """The recipe in one line."""
        parts = [f"{name} {value}" for name, value in self._settings.items()]
        return ", ".join(parts if self.head is None else [*parts, f"head {self.head}"])


def calibration_words(kind: type, of: str, recipe: Recipe, domain: Domain, cautions: Sequence[str]) -> str:
    """A calibration in a line for notebooks: cautions, what it was learned from, range of sizes and recipe."""
    low, high = domain["d_mm"]
    texts = [*(f"{LEADS['caution']}{text}." for text in cautions), f"{of} of {low:.3g} to {high:.3g} mm; {recipe}"]
    return f"<{kind.__name__} {' '.join(texts)}>"


class RoundLumps(Record, eq=False):
    """Half log axis ratio of a ball's map, and how far maps are from it."""

    coefficients: Vector  #: Of the powers of the spread.
    body_sd: Annotated[float, Meta(ge=0)]  #: Between bodies.
    exam_sd: Annotated[float, Meta(ge=0)]  #: Between exams of a body.
    map_factor: Annotated[float, Meta(ge=0)]
    """Variance over that of a map's posterior: deep and faint lumps are off by more."""

    def variance(self, of_maps: FloatArray, *, maps: int = 1) -> FloatArray:
        """Variance of the mean excess over some maps of a mass, whose posteriors give its mean this variance."""
        return np.asarray(self.body_sd**2 + self.exam_sd**2 / maps + self.map_factor * of_maps)


class HiddenTerms(Record, eq=False, omit_defaults=True):
    """Properties of a body that no map shows, jointly normal with its departure B given the map.

    Each is centred on its expectation given the map, which is linear in the map's features.
    """

    names: Annotated[tuple[str, ...], Meta(min_length=1)]
    expected: Matrix  #: Coefficients of a map's features in what is expected of each.
    covariance: Matrix  #: About that.
    with_body: Vector  #: Covariance with B over its SD.
    body_variance: Annotated[float, Meta(gt=0)]  #: Of B in the units of with_body.
    inverted: tuple[str, ...] = ()  #: Properties that enter by their inverse.
    most_sd: Annotated[float, Meta(gt=0)] = float("inf")
    """SD of B beyond which they explain no more: there the map is unlike."""

    def __post_init__(self) -> None:
        k = len(self.names)
        # a table that Eq 6 follows exactly gives terms that are not finite
        check_shapes(self, finite=False, expected=(k, self.expected.shape[-1]), covariance=(k, k), with_body=(k,))

    def share(self, *names: str) -> float:
        """Share of B's variance removed by knowing these properties, at most `MOST_SHARE`."""
        at = [self.names.index(name) for name in names]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at])
        return float(np.clip(gain @ self.with_body[at] / self.body_variance, 0.0, MOST_SHARE))

    def expected_departure(self, known: Mapping[str, float], features: FloatArray) -> FloatArray:
        """(...,) mean of B over its SD, given known properties, for (..., c) features of the map."""
        at = [self.names.index(name) for name in known]
        gain = np.linalg.solve(self.covariance[np.ix_(at, at)], self.with_body[at]) / np.sqrt(self.body_variance)
        values = np.array([self._transformed(name, value) for name, value in known.items()])
        return np.asarray((values - features @ self.expected[at].T) @ gain)

    def score(self, name: str, value: float, features: FloatArray) -> float:
        """Distance of a value from its expectation given a map's (c,) features, in SDs."""
        at = self.names.index(name)
        off = self._transformed(name, value) - features @ self.expected[at]
        return float(abs(off) / np.sqrt(self.covariance[at, at]))

    def _transformed(self, name: str, value: float) -> float:
        if name in self.inverted:
            return 1.0 / value
        return float(np.log(value)) if name in LOGGED else value


class SiteShift(Record, eq=False):
    r"""Correction of a calibration over bodies by a site's own lumps of known size, its posterior taken as normal.

    .. math:: \ln d = g(\text{map}) + c_0 + c_1 (p - p_0) + B + E

    with p the log of the map's mean width in mm and :math:`p_0` that of the calibration's table; g, B and E are the
    calibration's. `size.learn.site` learns :math:`c_0` and :math:`c_1`: how a site's array, head and technique differ
    from the simulation.
    """

    centre: float = field(name="centre_log_width")  #: p_0.
    mean: Vector  #: Of c0 and c1.
    covariance: Matrix
    phantoms: Annotated[int, Meta(ge=3)]  #: Distinct lumps.
    maps: Annotated[int, Meta(ge=3)]
    base: str  #: Name of the calibration that is corrected.
    uses_fat: bool  #: Whether the phantoms were sized with the depth of fat; if not, no size with this is.
    fit: Mapping[str, float]  #: log_width: mean p of the phantoms; spread_factor; sd_before and sd_after: RMS of ln d.
    cautions: tuple[str, ...] = ()  #: Why it should be looked at.
    left_out: tuple[str, ...] = ()  #: Phantoms that took no part, and why.
    parameters: tuple[Literal["c0"], Literal["c1"]] = ("c0", "c1")

    def __post_init__(self) -> None:
        check_shapes(self, mean=(2,), covariance=(2, 2))
        if not np.isfinite(self.centre) or np.linalg.eigvalsh(self.covariance)[0] < -1e-12:
            raise BadDataError("the site's correction is not finite or has no covariance", way_out="learn it anew")

    def log_shift(self, log_width: FloatArray) -> FloatArray:
        """(...,) mean shift of ln d for maps with this p."""
        return np.asarray(self.mean[0] + self.mean[1] * (log_width - self.centre))

    def variance(self, log_width: FloatArray) -> FloatArray:
        """(...,) variance of that shift."""
        v, c = log_width - self.centre, self.covariance
        return np.asarray(c[0, 0] + 2.0 * v * c[0, 1] + v**2 * c[1, 1])

    def percent(self, log_width: float) -> tuple[float, float, float]:
        """Median of the shift at p in percent of d, and the ends of its equal-tailed interval of `INTERVAL`."""
        p = np.array(log_width)
        z = float(ndtri(0.5 + INTERVAL / 2))
        middle, half = float(self.log_shift(p)), float(np.sqrt(self.variance(p))) * z
        low, high = (float(100 * np.expm1(end)) for end in (middle - half, middle + half))
        return float(100 * np.expm1(middle)), low, high

    @property
    def phantoms_log_width(self) -> float:
        """Mean p of the phantoms, where the shift is known best; p_0 where the file does not say."""
        return float(self.fit.get("log_width", self.centre))


def outside_domain(domain: Domain, amplitude: float, sigma_mm: float, *, far: bool = False) -> list[str]:
    """Quantities outside their ranges in a table, or so `far` outside that no size is given, in words."""
    texts = []
    for name, value, unit in (("amplitude", amplitude, ""), ("sigma_mm", sigma_mm, " mm")):
        (low, high), factor = domain[name], FARTHEST[name] if far else 1.0
        if not low / factor <= value <= high * factor:
            texts.append(f"{name.removesuffix('_mm')} {value:.3g}{unit} (table: {low:.3g} to {high:.3g}{unit})")
    return texts


def within_reach(domain: Domain, amplitude: FloatArray, sigma_mm: FloatArray) -> BoolArray:
    """(...) True where amplitude and width are not so far outside their ranges that no size is given."""
    inside = np.ones(np.shape(amplitude), dtype=np.bool_)
    for name, values in (("amplitude", amplitude), ("sigma_mm", sigma_mm)):
        (low, high), factor = domain[name], FARTHEST[name]
        inside &= (low / factor <= values) & (values <= high * factor)
    return inside


LONGEST: Final = 2.0
"""Axis ratio of a size from which it is a caution: balls come out with 1.2 at most, lumps of 2:1 are off by 18 %."""


def beyond_lumps(domain: Domain, largest_mm: float, axis_ratio: float) -> list[str]:
    """Texts on a size beyond the lumps of a table, which are balls; empty within."""
    (low, high), texts = domain["d_mm"], []
    if largest_mm < low or largest_mm > high:
        texts.append(f"largest size {largest_mm:.3g} mm (the table's lumps: {low:.3g} to {high:.3g} mm)")
    if axis_ratio >= LONGEST:
        texts.append(f"{axis_ratio:.1f} times as long as wide: a scar, a fold of skin or a rib's end looks so")
    return texts


def extrapolated(far: Sequence[str]) -> Abstention:
    """Reason for no size: the map is too far outside the calibration's table to know the size's error."""
    advice = (
        "learn a calibration whose table holds such lumps (`population`, `calibrate size`), or give "
        "--size-calibration none for amplitude and widths"
    )
    reason = f"too {UNLIKE_LEARNED} for a size: {'; '.join(far)}"
    return Abstention("extrapolated", reason, advice, UNLIKE_ON_PAPER)


def unknown_head(calibration_head: object) -> str:
    """Note on an unknown head as a source of error that the size leaves out."""
    return f"whether the map's head is the calibration's ({calibration_head}): the map does not name its head"


def untabled_bodies(ranges: Mapping[str, tuple[float, float]]) -> str:
    """Note on bodies outside the calibration's `ranges`, by column, as a source of error that the size leaves out."""
    words = {
        "stiffness_ratio": "lumps {:.3g} to {:.3g} times as stiff as fat",
        "gland_ratio": "gland {:.3g} to {:.3g} times",
        "fat_kpa": "fat of {:.3g} to {:.3g} kPa",
    }
    parts = [text.format(*ranges[name]) for name, text in words.items() if name in ranges]
    return (
        f"bodies unlike the calibration's ({', '.join(parts)}, even layers, tissue that does not stiffen where it is "
        "pressed), whose sizes may lie outside the interval"
    )


# --- The depth F of the fat-gland boundary under the head: from the head's pressure profile, or what a map leaves of
# it.
#
# Amplitude and width alone leave the lump's seat open: how far it stands out of the gland. Where no lump lies, the
# pressure over the head depends on F, so the profile tells it, by a quadratic learned over the same bodies; its
# error is part of what the calibration was learned with. Without a profile ln F is normal about what amplitude and
# width lead one to expect of it, and sizes are averaged over that.

MOST_LEVERAGE: Final = 1.0
"""A map, or a head's profile, is unlike the table's where its leverage exceeds this multiple of the largest there."""
NODES = np.sqrt(2.0) * np.array([-2.0201828704560856, -0.9585724646138185, 0.0, 0.9585724646138185, 2.0201828704560856])
WEIGHTS = np.array([0.011257411327720688, 0.22207592200561263, 8.0 / 15.0, 0.22207592200561263, 0.011257411327720688])
"""Gauss-Hermite rule of five points for a standard normal (Abramowitz & Stegun 1964, table 25.10)."""


def head_profile(quality: Mapping[str, float]) -> tuple[float, ...] | None:
    """Read `HEAD_PROFILE` from a map's figures; None for a map without one, such as an imported grid."""
    values = tuple(float(quality.get(name, np.nan)) for name in HEAD_PROFILE)
    return values if np.isfinite(values).all() else None


class FatDepth(Record, eq=False):
    """Regression of the ln of the depth of the fat-gland boundary in mm on the head's pressure profile."""

    centre: Vector  #: Of the profile.
    scale: Vector  #: Of the profile.
    coefficients: Vector  #: Of 1, the scaled profile, and its products.
    information_inverse: Matrix  #: For the leverage of a new profile.
    most_leverage: Above0  #: Largest in the table.
    log_sd: Share  #: How far single exams of the table lie from the truth.
    fat_mm: Range  #: Range of the depth in the table.
    expected: Vector  #: Of a full quadratic in u and v: w without a profile.
    expected_sd: Share  #: Of w about that.
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

    def without_profile(self, u: FloatArray, v: FloatArray, *, centre: float) -> FloatArray:
        """(5, ...) w at the rule's `NODES`, within the table's range, for w_0 in `centre`."""
        low, high = np.log(self.fat_mm) - centre
        expected = np.clip(monomials((u, v), powers(2)) @ self.expected, low, high)
        return np.asarray(expected + self.expected_sd * NODES.reshape(-1, *([1] * expected.ndim)))

    def from_maps(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float | None, str]:
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

    def disagreement_mm(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float, float] | None:
        """Least and largest F in mm, where maps differ too much to be of one body.

        None where they agree to three SDs of a difference between two exams, or where fewer than two tell it.
        """
        log_depth = self._log_depths(profiles)
        if len(log_depth) < 2 or np.ptp(log_depth) <= 3.0 * np.sqrt(2.0) * self.log_sd:
            return None
        return float(np.exp(log_depth.min())), float(np.exp(log_depth.max()))

    def _log_depths(self, profiles: Sequence[tuple[float, ...] | None]) -> FloatArray:
        """(n,) ln F of the profiles that resemble the table's."""
        known = np.array([profile for profile in profiles if profile is not None], dtype=np.float64)
        known = known.reshape(-1, len(self.centre))
        x = self.terms(known)
        leverage = np.einsum("...i,ij,...j->...", x, self.information_inverse, x) / self.most_leverage
        return self.log_depth(known[leverage <= MOST_LEVERAGE])


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

    points: Matrix  #: u, v and w of the points.
    lengths: Vector  #: Length of the kernel along each.
    scale: Annotated[float, Meta(gt=0)]  #: SD of the process before any data.

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

    mean: Vector  #: Of the weights.
    covariance_factor: tuple[tuple[float, ...], ...]  #: Rows of the Cholesky factor of the weights' covariance.

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
