r"""A size calibration learned over a population of bodies.

With u, v and w as in `eq6`,

.. math:: \ln d = \ln\text{Eq 6}(u, v, w) + h(u, v, w) + B + E

Eq 6 has constants that depend on the depth of the fat. h is its residual (`Residual`); a calibration by Eq 6
alone has none. B differs from body to body by what a map does not show (seat, stiffness, moduli): ln SD(B) is a full
quadratic in u, v and w. E differs from exam to exam of one body. A body of another origin than the table's departs by
more, `other_sd`.

w comes from the head's pressure profile. Without one, all of this is averaged over the depths of fat that go with the
map, and their spread is part of B.

A ball under the oblong head gives an oval map; its half log axis ratio :math:`q_0` is a quadratic in u, v and w, and
only what exceeds it says that a lump is not round.

No map shows how stiff a lump is, and without frames none shows its seat: sizes are drawn to the middle of the
calibration's bodies. What is known of a body, or supposed of it, says on which side a size errs, and by how much.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import numpy as np

from tactile_bayes.declarations import Meta, Record, replace
from tactile_bayes.errors import BadDataError, UsageError, check_number, suggestion
from tactile_bayes.geometry import BoolArray, FloatArray, Matrix, Vector
from tactile_bayes.size import terms
from tactile_bayes.size.draws import BetweenMaps, ShapeDraws, SizePosterior, Supposition
from tactile_bayes.size.eq6 import Eq6Law, Power, Powers, eq6_coefficients, eq6_log_size, eq6_terms
from tactile_bayes.size.terms import SiteShift

NO_PROFILE: Final = "the phantoms that correct the calibration have no pressure profile of the head"
FARTHEST_LEVERAGE: Final = 3.0  #: Beyond this multiple there is no size.
UNLIKE_SD: Final = 0.1
"""SD of ln d by which a body may differ because its map or its head profile is unlike the table's (record 0123)."""
QUADRATIC: Final[Powers] = tuple((i, j, k) for k in range(3) for i, j in terms.powers(2 - k))
"""Powers of u, v and w in a full quadratic; the first six are those without w."""
CUBIC: Final[Powers] = (*QUADRATIC, *((i, j, k) for k in range(4) for i, j in terms.powers(3 - k) if i + j + k == 3))
SUPPOSED: Final[Mapping[str, tuple[str, float]]] = {
    "soft": ("stiffness_ratio", 11.0),
    "hard": ("stiffness_ratio", 70.0),
    "centred": ("seat", 0.0),
    "resting": ("seat", 1.0),
}
"""A property and its value by name: lumps of 8 to 15 and 50 to 100 times the stiffness of fat, centred on the gland's
surface and resting on it."""
BEYOND: Final = 2.0
"""A known value so many times outside the calibration's bodies is refused, for they say nothing of it; but a lump may
be of any stiffness above theirs, which is nearly rigid already."""
LIKELY_SDS: Final = 2.5  #: A value farther than this from what the map leads one to expect is not supposed.
_STEP = 1e-4


class Centre(Record):
    """u = ln a - log_amplitude; v = ln of the geometric mean width in mm - log_width; w = ln F in mm - log_fat."""

    log_amplitude: float
    log_width: float
    log_fat: float


class Spread(Record, eq=False):
    """SDs of ln d: between bodies, its ln linear in powers of u, v and w; between exams; of other bodies."""

    powers: tuple[Power, ...]
    mean: Vector
    covariance: Matrix
    log_exam_sd: float  #: ln SD between exams of a body.
    log_exam_sd_variance: terms.Share
    other_sd: Annotated[float, Meta(ge=0)]  #: By which bodies of another origin depart.
    other_source: str  #: Where it comes from.

    def __post_init__(self) -> None:
        s = len(self.powers)
        terms.check_shapes(self, mean=(s,), covariance=(s, s))
        if not np.isfinite([self.log_exam_sd, self.log_exam_sd_variance, self.other_sd]).all():
            raise BadDataError("a spread between exams or bodies is not finite", way_out=terms.LEARN_ANEW)


class BodyLaw(Record, eq=False, kw_only=True):
    """Law learned over a population: Eq 6 by the depth of the fat, its residual, and what a map does not show."""

    source: str  #: What the table was made of.
    bodies: Mapping[str, tuple[float, float]]  #: Ranges of its lumps and bodies, by its columns.
    recipe: terms.Recipe
    centre: Centre
    eq6: Eq6Law
    residual: terms.Residual | None  #: null for Eq 6 alone.
    spread: Spread
    round_lumps: terms.RoundLumps
    depth: terms.FatDepth | None  #: null where the table's maps did not tell it.
    feature_powers: tuple[Power, ...]  #: Of u, v and w in the features of a map.
    information_inverse: Matrix  #: For the leverage of a map, over its features.
    most_leverage: terms.Above0  #: Of maps inside the table.
    domain: terms.Domain
    hidden: terms.HiddenTerms | None  #: What B is made of.
    hidden_any: terms.HiddenTerms | None  #: The same where the depth is not known.
    fit: Mapping[str, float]  #: Figures of the fit.

    def __post_init__(self) -> None:
        s, c = len(self.spread.powers), len(self.feature_powers)
        terms.check_domain(self.domain)
        terms.check_shapes(self, information_inverse=(c, c))
        terms.check_shapes(self.round_lumps, coefficients=(s,))
        for hidden in (self.hidden, self.hidden_any):
            if hidden is not None and hidden.expected.shape[1] != c:
                raise BadDataError("hidden has arrays of other sizes than its names", way_out=terms.LEARN_ANEW)
        by_depth = any(one[2] for one in (*self.eq6.powers, *self.spread.powers, *self.feature_powers))
        if self.depth is None and (by_depth or self.residual is not None):
            raise BadDataError("depth is missing, on which other parts depend", way_out=terms.LEARN_ANEW)


class BodyCalibration(BodyLaw, eq=False, kw_only=True):
    """A calibration over a population, for any mass or one whose depth of fat is known."""

    fat_mm: float | None = None  #: Depth F of the mass that this calibration is for; None where it is not known.
    fat_note: str = ""  #: Why the depth is not used though the calibration could; empty otherwise.
    unlike: tuple[float, float] | None = None  #: Amplitude and mean width in mm of the map that `fat_note` is of.
    site: SiteShift | None = None  #: Correction by a site's own phantoms.

    def __repr__(self) -> str:
        corrected = "" if self.site is None else f", corrected by {self.site.phantoms} phantoms"
        cautions = () if self.site is None else self.site.cautions
        lumps = f"{self.source}{corrected}, lumps"
        return terms.calibration_words(type(self), lumps, self.recipe, self.domain, cautions)

    def at_fat(self, profiles: Sequence[tuple[float, ...] | None]) -> BodyCalibration:
        """The calibration for a mass whose maps have these `presets.HEAD_PROFILE`, None for a map without one.

        Where they tell no depth it is averaged over depths, with the reason in `fat_note`; wider where the profiles
        are of another body than the table's.
        """
        if self.depth is None or self.fat_mm is not None or self.fat_note:
            return self
        if self.site is not None and not self.site.uses_fat:
            return self._without_depth(NO_PROFILE)
        if all(profile is None for profile in profiles):
            return self._without_depth("the map has no pressure profile of the head")
        fat_mm, why_not = self.depth.from_maps(profiles)
        if fat_mm is None:
            return self._without_depth(why_not).widened_for_atypical_body()
        return replace(self, fat_mm=fat_mm)

    def at_depth_or_fallback(
        self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None
    ) -> BodyCalibration:
        """This calibration, or the one for any depth where no body of the table looks like the map at this depth."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        if self.fat_mm is None or self.leverage(amplitude, sigma_mm) <= terms.MOST_LEVERAGE:
            return self
        why = f"{_pair(amplitude, sigma_mm)} over {self.fat_mm:.3g} mm of fat is unlike the bodies of the table"
        return replace(self._without_depth(why).widened_for_atypical_body(), unlike=(amplitude, sigma_mm))

    def for_maps(self, maps: Sequence[ShapeDraws]) -> BodyCalibration:
        """The calibration at the depth of fat estimated from a mass's maps, if all lie in its table there."""
        calibration = self.at_fat([one.profile for one in maps])
        for one in maps:
            calibration = calibration.at_depth_or_fallback(*one.middle)
        return calibration

    def widened_for_atypical_body(self) -> BodyCalibration:
        """This calibration with a wider spread for a body unlike the table's: intervals without it covered 38 of 48."""
        return self.with_other_sd(float(np.hypot(self.other_sd, UNLIKE_SD)))

    def with_other_sd(self, other_sd: float, **source: str) -> BodyCalibration:
        """This calibration with another `other_sd`."""
        return replace(self, spread=replace(self.spread, other_sd=other_sd, **source))

    @property
    def other_sd(self) -> float:
        """SD of ln d by which bodies of another origin than the table's depart; part of SD(B)."""
        return self.spread.other_sd

    @property
    def between_exams(self) -> BetweenMaps:
        """How ln d differs between exams of one body of the table."""
        return BetweenMaps(float(np.exp(self.spread.log_exam_sd)))

    @property
    def unknowns(self) -> dict[str, float]:
        """Share of the variance between bodies that each property alone would explain."""
        return {} if self.hidden is None else {name: self.hidden.share(name) for name in self.hidden.names}

    def constants(self, sigma_mm: float | None = None, *, fat_mm: float | None = None) -> dict[str, float]:
        """m, b in mm, e and f of Eq 6 as it is printed, at the mean of the posterior.

        For a map's mean width, else the table's middle, and a depth of fat, else the mass's or the table's middle.
        """
        v = np.array(0.0 if sigma_mm is None else np.log(sigma_mm) - self.centre.log_width)
        fat_mm = fat_mm or self.fat_mm
        w = np.array(0.0 if fat_mm is None or self.depth is None else np.log(fat_mm) - self.centre.log_fat)
        mu, f, b = (float(coefficient) for coefficient in eq6_coefficients(self.eq6.mean, self.eq6.powers, v, w))
        log_e = -f * self.eq6.log_amplitude_one_deep
        log_m = mu - self.centre.log_width + f * self.centre.log_amplitude + log_e
        return {"m": float(np.exp(log_m)), "b_mm": b, "e": float(np.exp(log_e)), "f": f}

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., k + m) derivatives of ln d by the coefficients; NaN where Eq 6 has no positive size."""
        values = self._values(log_amplitude, log_width)
        derivatives = eq6_terms(*values, self.eq6.mean, self.eq6.powers)
        if self.residual is not None:
            functions = self.residual.functions(np.stack(np.broadcast_arrays(*values), axis=-1))
            derivatives = np.concatenate([derivatives, functions], axis=-1)
        return self._averaged(derivatives)

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., c) features of maps: regressors of the hidden properties, and basis of the leverage."""
        return self._averaged(self._monomials(log_amplitude, log_width, self.feature_powers))

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients; NaN where Eq 6 has no positive size."""
        return self._averaged(self._log_sizes(log_amplitude, log_width))

    def corrected_log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) the same with the site's correction where there is one."""
        size = self.log_size(log_amplitude, log_width)
        return size if self.site is None else size + self.site.log_shift(log_width)

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer a lump is for a wider map."""
        high, low = (self.log_size(log_amplitude, log_width + step) for step in (_STEP, -_STEP))
        return np.asarray((high - low) / (2 * _STEP))

    def round_excess(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) q0, the half log axis ratio of a ball's map."""
        x = self._monomials(log_amplitude, log_width, self.spread.powers)
        return np.asarray(self._averaged(x) @ self.round_lumps.coefficients)

    def body_sd(self, log_amplitude: FloatArray, log_width: FloatArray, score: FloatArray) -> FloatArray:
        """(n,) SD(B) of maps, with `other_sd` and the spread of depths of fat that are not known.

        `score` holds (n,) standard normal scores of the uncertain ln SD(B).
        """
        x = self._monomials(log_amplitude, log_width, self.spread.powers)
        sd = np.sqrt(np.maximum(np.sum(x @ self.spread.covariance * x, axis=-1), 0.0))
        variance = self._averaged(np.exp(2.0 * (x @ self.spread.mean + sd * score)))
        if self._marginalised:
            sizes = self._log_sizes(log_amplitude, log_width)
            variance = variance + self._averaged((sizes - self._averaged(sizes)) ** 2)
        return np.sqrt(variance + self.other_sd**2)

    def table_sd(self, body_sd: FloatArray) -> FloatArray:
        """(n,) SD(B) without `other_sd`, which no known property explains."""
        return np.asarray(np.sqrt(np.maximum(body_sd**2 - self.other_sd**2, 0.0)))

    @property
    def coefficient_covariance(self) -> FloatArray:
        """(k + m, k + m) of Eq 6's coefficients and the residual's weights, which are independent."""
        if self.residual is None:
            return self.eq6.covariance
        zeros = np.zeros((len(self.eq6.mean), len(self.residual.mean)))
        return np.block([[self.eq6.covariance, zeros], [zeros.T, self.residual.covariance]])

    def coefficient_variance(self, terms: FloatArray) -> FloatArray:
        """(n,) variance of ln d by the coefficients' error, for (n, k + m) terms."""
        return np.asarray(np.maximum(np.sum(terms @ self.coefficient_covariance * terms, axis=-1), 0.0))

    def leverage(self, amplitude: FloatArray | float, sigma_mm: FloatArray | float) -> FloatArray:
        """(...,) leverage of maps, which rise, over the largest in the table."""
        x = self.features(np.log(amplitude), np.log(sigma_mm))
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.information_inverse, x) / self.most_leverage)

    def outside(
        self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None, *, far: bool = False
    ) -> list[str]:
        """Texts on a map outside the table, or so `far` outside that there is no size.

        They name the amplitude or width outside its range, or else the pair, unlike those of the table.
        """
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        texts = terms.outside_domain(self.domain, amplitude, sigma_mm, far=far)
        most = FARTHEST_LEVERAGE if far else terms.MOST_LEVERAGE
        if not texts and (leverage := self.leverage(amplitude, sigma_mm)) > most:
            pair = _pair(amplitude, sigma_mm)
            texts = [f"{pair}, a pair unlike those of the table (leverage {leverage:.1f} times the limit)"]
        if not far and self.unlike == (amplitude, sigma_mm):
            texts.append(f"{self.fat_note}, so that depth is not used")
        return texts

    def within_reach(self, amplitude: FloatArray, sigma_x_mm: FloatArray, sigma_y_mm: FloatArray) -> BoolArray:
        """(n,) True for maps near enough to the table for a size."""
        sigma_mm = np.sqrt(sigma_x_mm * sigma_y_mm)
        inside = terms.within_reach(self.domain, amplitude, sigma_mm)
        inside[inside] = self.leverage(amplitude[inside], sigma_mm[inside]) <= FARTHEST_LEVERAGE
        return inside

    def beyond_lumps(self, size: SizePosterior) -> list[str]:
        """Texts on a size beyond the table's lumps; empty within."""
        return terms.beyond_lumps(self.domain, size.median_mm, size.axis_ratio)

    def omissions(self) -> list[str]:
        """Sources of error that a size does not contain, in words."""
        notes = []
        if self.fat_note:
            text = f"the depth of the fat, which would narrow the size: {self.fat_note}"
            wider = f"; for such a body the interval allows {100 * self.other_sd:.0f} % (SD) more"
            notes.append(text + (wider if self.other_sd else ""))
        return [*notes, terms.untabled_bodies(self.bodies)] if self.bodies else notes

    def _without_depth(self, why: str) -> BodyCalibration:
        return replace(self, fat_mm=None, fat_note=why, hidden=self.hidden_any)

    @property
    def _marginalised(self) -> bool:
        """True where sizes are marginalised over the depth of fat."""
        return self.depth is not None and self.fat_mm is None

    def _values(self, log_amplitude: FloatArray, log_width: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """u, v and w; w has one axis more before the others where sizes are averaged over depths of fat."""
        w0 = self.centre.log_fat
        u, v = np.asarray(log_amplitude - self.centre.log_amplitude), np.asarray(log_width - self.centre.log_width)
        if self.depth is None:
            return u, v, np.zeros_like(u)
        if self.fat_mm is None:
            return u, v, self.depth.without_profile(u, v, centre=w0)
        return u, v, np.full_like(u, np.log(self.fat_mm) - w0)

    def _averaged(self, values: FloatArray) -> FloatArray:
        """Average values over the depths of fat, where these are unknown."""
        return np.asarray(np.tensordot(terms.WEIGHTS, values, 1)) if self._marginalised else values

    def _monomials(self, log_amplitude: FloatArray, log_width: FloatArray, exponents: Powers) -> FloatArray:
        return terms.monomials(np.broadcast_arrays(*self._values(log_amplitude, log_width)), exponents)

    def _log_sizes(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        values = self._values(log_amplitude, log_width)
        sizes = eq6_log_size(*values, self.eq6.mean, self.eq6.powers)
        if self.residual is None:
            return sizes
        return sizes + self.residual.at(np.stack(np.broadcast_arrays(*values), axis=-1))


def mean_width_mm(sigma_x_mm: float, sigma_y_mm: float | None) -> float:
    """The geometric mean of two widths; one alone stands for both."""
    return float(np.sqrt(sigma_x_mm * (sigma_x_mm if sigma_y_mm is None else sigma_y_mm)))


def _pair(amplitude: float, sigma_mm: float) -> str:
    return f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm"


def known_body(
    calibration: BodyCalibration,
    known: Mapping[str, float],
    log_amplitude: FloatArray,
    log_width: FloatArray,
    table_sd: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(n,) mean and variance of B given known properties, for ln a and p of maps, and `BodyCalibration.table_sd`."""
    hidden = calibration.hidden
    if not known:
        return np.zeros(len(log_width)), table_sd**2
    names = () if hidden is None else hidden.names
    for name, value in known.items():
        if name not in names:
            raise UsageError(f"the calibration has no property {name}; {suggestion(name, names or ('none',))}")
        check_number(f"known {name}", value, 0, open_ends=name != "seat")
        columns = ("d_mm", "depth_ratio") if name == "depth_mm" else (name,)
        if all(column in calibration.bodies for column in columns):
            low, high = np.prod([calibration.bodies[one] for one in columns], axis=0).tolist()
            most = None if hidden is not None and name in hidden.inverted else high * BEYOND
            check_number(f"known {name}", value, low / BEYOND, most)
    assert hidden is not None
    expected = hidden.expected_departure(known, calibration.features(log_amplitude, log_width))
    explained_sd = np.minimum(table_sd, hidden.most_sd)
    return expected * explained_sd, table_sd**2 - hidden.share(*known) * explained_sd**2


def suppositions(
    calibration: BodyCalibration, known: Mapping[str, float], middle: tuple[float, float], *, variance: float
) -> tuple[dict[str, Supposition], float]:
    """Those of `SUPPOSED` that the calibration's bodies hold, that the map leaves open and that nobody knows, by name.

    For the mean ln a and p of the maps, and the variance of ln d as it is. Also how far what is known moves ln d, in
    SDs that it has without.
    """
    hidden, supposed = calibration.hidden, dict[str, Supposition]()
    if hidden is None:
        return {}, 0.0
    middle_map = np.array([middle[0]]), np.array([middle[1]])
    table_sd = calibration.table_sd(calibration.body_sd(*middle_map, np.zeros(1)))
    expected, spread = known_body(calibration, known, *middle_map, table_sd)
    moved = float(np.abs(expected[0]) / np.sqrt(variance + table_sd[0] ** 2 - spread[0]))
    features = calibration.features(*middle_map)[0]
    for label, (name, value) in SUPPOSED.items():
        low, high = calibration.bodies.get(name, (value, value))
        if name not in hidden.names or name in known or not low <= value <= high:
            continue
        if hidden.score(name, value, features) <= LIKELY_SDS:
            shifted, left = known_body(calibration, {**known, name: value}, *middle_map, table_sd)
            remaining = float(np.clip(variance - float((spread - left)[0]), 0.0, variance))
            sds = float(np.sqrt(variance)), float(np.sqrt(remaining))
            supposed[label] = Supposition(name, value, float((shifted - expected)[0]), sds)
    return supposed, moved
