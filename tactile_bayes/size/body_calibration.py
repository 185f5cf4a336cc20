r"""A size calibration learned over a population of bodies.

With u, v and w as in `eq6_terms`,

.. math:: \ln d = \ln\text{Eq 6}(u, v, w) + h(u, v, w) + B + E

Eq 6 has constants that depend on the depth of the fat. h is what it leaves (`residual`); a calibration by Eq 6
alone has none. B differs from body to body by what a map does not show (seat, stiffness, moduli): ln SD(B) is a full
quadratic in u, v and w. E differs from exam to exam of one body. A body of another origin than the table's departs by
more, `other_sd`.

w comes from the head's pressure profile. Without one, all of this is averaged over the depths of fat that go with the
map, and their spread is part of B.

A ball under the oblong head gives an oval map; its half log axis ratio :math:`q_0` is a quadratic in u, v and w, and
only what exceeds it says that a lump is not round.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size import omissions
from tactile_bayes.size.between_maps import BetweenMaps
from tactile_bayes.size.calibration_range import beyond_lumps, outside_domain, too_far
from tactile_bayes.size.eq6 import Recipe
from tactile_bayes.size.eq6_terms import BY_DEPTH, PLAIN, Powers, eq6_coefficients, eq6_log_size, eq6_terms
from tactile_bayes.size.fat_depth import WEIGHTS, FatDepth
from tactile_bayes.size.hidden import HiddenTerms, RoundLumps
from tactile_bayes.size.polynomials import monomials, powers
from tactile_bayes.size.residual import Residual
from tactile_bayes.size.site_shift import NO_PROFILE, SiteShift

UNLIKE = "is unlike the bodies of the table"
MOST_LEVERAGE = 1.0
"""A map is outside the table where its leverage exceeds this multiple of the table's largest."""
FARTHEST_LEVERAGE = 3.0
"""Beyond this multiple there is no size."""
UNLIKE_SD = 0.1
"""SD of ln d by which a body may differ because its map or its head profile is unlike the table's (record 0123)."""
QUADRATIC = tuple((i, j, k) for k in range(3) for i, j in powers(2 - k))
"""Powers of u, v and w in a full quadratic; the first six are those without w."""
FEATURES = (*QUADRATIC, *((i, j, k) for k in range(4) for i, j in powers(3 - k) if i + j + k == 3))
"""The same of a full cubic."""
_STEP = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BodyCalibration:
    """A calibration over a population; made by `learn_population`.

    Parameters
    ----------
    centre
        alpha_0, p_0 and w_0.
    mean, covariance : (k + m + s + 1,), (k + m + s + 1, k + m + s + 1) arrays
        Posterior of the k coefficients of Eq 6, the m weights of the residual, the s of ln SD(B) and ln SD(E), taken
        as normal; SD(B) and SD(E) are independent of what stands before them.
    round_lumps
        What a ball's map looks like, in the first s `features`.
    information_inverse : (c, c) array
        Inverse of X^T X over the table, X its maps' c `features`: gives the leverage of a new map.
    most_leverage
        Of maps inside the table.
    domain
        Ranges of ``amplitude``, ``sigma_mm`` (geometric mean) and ``d_mm`` in the table.
    recipe
        How the table's maps were built and fitted.
    depth
        Depth of the fat; None where the table's maps did not tell it.
    residual
        None for Eq 6 alone.
    log_amplitude_one_deep
        ln of the amplitude of lumps one diameter deep.
    hidden, hidden_any
        What B is made of, and the same of what it is where the depth of the fat is not known.
    other_sd
        SD of ln d by which bodies of another origin than the table's depart; part of SD(B).
    other_source
        In words: what it was learned from.
    fit
        Figures of the fit.
    source
        In words: what the table was made of.
    bodies
        Ranges of the table's lumps and bodies, by their columns.
    fat_mm
        Depth F of the mass that this calibration is for; None where it is not known.
    fat_note
        Why the depth is not used though the calibration could; empty otherwise.
    site
        Correction by a site's own phantoms; `pooling` adds it, no method of this class does.
    """

    centre: tuple[float, float, float]
    mean: FloatArray
    covariance: FloatArray
    round_lumps: RoundLumps
    information_inverse: FloatArray
    most_leverage: float
    domain: Mapping[str, tuple[float, float]]
    recipe: Recipe
    depth: FatDepth | None = None
    residual: Residual | None = None
    log_amplitude_one_deep: float = 0.0
    hidden: HiddenTerms | None = None
    hidden_any: HiddenTerms | None = None
    other_sd: float = 0.0
    other_source: str = ""
    fit: Mapping[str, float] = field(default_factory=dict)
    source: str = ""
    bodies: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fat_mm: float | None = None
    fat_note: str = ""
    site: SiteShift | None = None

    def __post_init__(self) -> None:
        s, c = len(self.spread_powers), len(self.feature_powers)
        k = self.coefficients + s + 1
        shapes = {"mean": (k,), "covariance": (k, k), "information_inverse": (c, c)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise BadDataError(f"{name} is no finite array of shape {shape}", way_out="learn the calibration anew")
        if self.round_lumps.coefficients.shape != (s,):
            raise BadDataError(f"round_lumps has not {s} coefficients", way_out="learn the calibration anew")
        if self.residual is not None and (self.depth is None or self.residual.points.shape[1] != len(self.centre)):
            raise BadDataError("the residual has no points of u, v and w", way_out="learn the calibration anew")

    def at_fat(self, profiles: Sequence[tuple[float, ...] | None]) -> BodyCalibration:
        """The calibration for a mass whose maps have these `presets.HEAD_PROFILE`, None for a map without one.

        Where they tell no depth it is averaged over depths, with the reason in `fat_note`; wider where the profiles
        are of another body than the table's.
        """
        if self.depth is None or self.fat_mm is not None or self.fat_note:
            return self
        if self.site is not None and not self.site.uses_fat:
            return self._at_any_depth(NO_PROFILE)
        if all(one is None for one in profiles):
            return self._at_any_depth("the map has no pressure profile of the head")
        fat_mm, why_not = self.depth.of_mass(profiles)
        if fat_mm is None:
            return self._at_any_depth(why_not).for_another_kind()
        return replace(self, fat_mm=fat_mm)

    def fitting(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> BodyCalibration:
        """This calibration, or the one for any depth where no body of the table looks like the map at this depth."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        if self.fat_mm is None or self.leverage(amplitude, sigma_mm) <= MOST_LEVERAGE:
            return self
        what = f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm over {self.fat_mm:.3g} mm of fat"
        return self._at_any_depth(f"{what} {UNLIKE}").for_another_kind()

    def for_another_kind(self) -> BodyCalibration:
        """This calibration with room for a body unlike any of the table's: intervals without it held 38 of 48."""
        return replace(self, other_sd=float(np.hypot(self.other_sd, UNLIKE_SD)))

    @property
    def between_exams(self) -> BetweenMaps:
        """How ln d differs between exams of one body of the table."""
        return BetweenMaps(float(np.exp(self.mean[-1])))

    @property
    def unknowns(self) -> dict[str, float]:
        """Share of the variance between bodies that knowing each property alone would take away."""
        return {} if self.hidden is None else {name: self.hidden.share(name) for name in self.hidden.names}

    @property
    def eq6_powers(self) -> Powers:
        """What the coefficients of Eq 6 belong to."""
        return PLAIN if self.depth is None else BY_DEPTH

    @property
    def spread_powers(self) -> tuple[tuple[int, int, int], ...]:
        """Powers of u, v and w in ln SD(B)."""
        return QUADRATIC[:6] if self.depth is None else QUADRATIC

    @property
    def feature_powers(self) -> tuple[tuple[int, int, int], ...]:
        """The same of the features of a map: those of `spread_powers` are the first."""
        return QUADRATIC[:6] if self.depth is None else FEATURES

    @property
    def coefficients(self) -> int:
        """Of Eq 6 and the residual together."""
        return len(self.eq6_powers) + (0 if self.residual is None else len(self.residual.points))

    @property
    def form_name(self) -> str:
        """The form, for people."""
        return "Eq 6" if self.residual is None else "Eq 6 and its residual"

    def constants(self, sigma_mm: float | None = None, *, fat_mm: float | None = None) -> dict[str, float]:
        """m, b in mm, e and f of Eq 6 as it is printed, at the mean of the posterior.

        Parameters
        ----------
        sigma_mm
            Mean width of the map; the table's middle where left out.
        fat_mm
            Depth of fat; the mass's where left out, or else the table's middle.
        """
        alpha, p0, w0 = self.centre
        v = np.array(0.0 if sigma_mm is None else np.log(sigma_mm) - p0)
        fat_mm = fat_mm or self.fat_mm
        w = np.array(0.0 if fat_mm is None or self.depth is None else np.log(fat_mm) - w0)
        mu, f, b = (float(one) for one in eq6_coefficients(self._eq6, self.eq6_powers, v, w))
        log_e = -f * self.log_amplitude_one_deep
        return {"m": float(np.exp(mu - p0 + f * alpha + log_e)), "b_mm": b, "e": float(np.exp(log_e)), "f": f}

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., k + m) derivatives of ln d by the coefficients; NaN where Eq 6 has no positive size."""
        values = self._values(log_amplitude, log_width)
        found = eq6_terms(*values, self._eq6, self.eq6_powers)
        if self.residual is not None:
            functions = self.residual.functions(np.stack(np.broadcast_arrays(*values), axis=-1))
            found = np.concatenate([found, functions], axis=-1)
        return self._averaged(found)

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., c) features, in which a map's leverage and what it leads one to expect of a body are linear."""
        values = np.broadcast_arrays(*self._values(log_amplitude, log_width))
        return self._averaged(monomials(values, self.feature_powers))

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients; NaN where Eq 6 has no positive size."""
        return self._averaged(self._log_sizes(log_amplitude, log_width))

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer a lump is for a wider map."""
        high, low = (self.log_size(log_amplitude, log_width + step) for step in (_STEP, -_STEP))
        return np.asarray((high - low) / (2 * _STEP))

    def round_excess(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) q0, the half log axis ratio of a ball's map."""
        return np.asarray(self._averaged(self._spread_terms(log_amplitude, log_width)) @ self.round_lumps.coefficients)

    def body_sd(self, log_amplitude: FloatArray, log_width: FloatArray, score: FloatArray) -> FloatArray:
        """(n,) SD(B) of maps, with `other_sd` and the spread of depths of fat that are not known.

        Parameters
        ----------
        log_amplitude, log_width : (n,) arrays
        score : (n,) array
            Standard normal scores of the uncertain ln SD(B).
        """
        x, k = self._spread_terms(log_amplitude, log_width), self.coefficients
        sd = np.sqrt(np.maximum(np.sum(x @ self.covariance[k:-1, k:-1] * x, axis=-1), 0.0))
        variance = self._averaged(np.exp(2.0 * (x @ self.mean[k:-1] + sd * score)))
        if self._averages:
            sizes = self._log_sizes(log_amplitude, log_width)
            variance = variance + self._averaged((sizes - self._averaged(sizes)) ** 2)
        return np.sqrt(variance + self.other_sd**2)

    def own_sd(self, body_sd: FloatArray) -> FloatArray:
        """(n,) SD(B) without `other_sd`, of which nothing that is known of a body tells anything."""
        return np.asarray(np.sqrt(np.maximum(body_sd**2 - self.other_sd**2, 0.0)))

    def coefficient_variance(self, terms: FloatArray) -> FloatArray:
        """(n,) variance of ln d by the coefficients' error, for (n, k + m) terms."""
        k = self.coefficients
        return np.asarray(np.maximum(np.sum(terms @ self.covariance[:k, :k] * terms, axis=-1), 0.0))

    def leverage(self, amplitude: float, sigma_mm: float) -> float:
        """Leverage of a map over the largest in the table; infinite without a rise."""
        if not (amplitude > 0 and sigma_mm > 0):
            return float("inf")
        x = self.features(np.log(np.array(amplitude)), np.log(np.array(sigma_mm)))
        return float(x @ self.information_inverse @ x) / self.most_leverage

    def outside(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> list[str]:
        """In what a map lies outside the table, in words; empty when it lies inside."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        found = outside_domain(self.domain, amplitude, sigma_mm)
        if not found and self.leverage(amplitude, sigma_mm) > MOST_LEVERAGE:
            found.append(self._unlike(amplitude, sigma_mm))
        if self.fat_note.endswith(UNLIKE):
            found.append(f"{self.fat_note}, so that depth is not used")
        return found

    def too_far(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> list[str]:
        """In what a map lies so far outside the table that there is no size, in words."""
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        found = too_far(self.domain, amplitude, sigma_mm)
        if not found and self.leverage(amplitude, sigma_mm) > FARTHEST_LEVERAGE:
            found.append(self._unlike(amplitude, sigma_mm))
        return found

    def beyond_lumps(self, largest_mm: float) -> list[str]:
        """In what a size lies beyond the table's lumps, in words; empty when it lies within."""
        return beyond_lumps(self.domain, largest_mm)

    def omissions(self) -> list[str]:
        """What a size does not contain, in words."""
        notes = [omissions.fat_depth(self.fat_note, other_sd=self.other_sd)] if self.fat_note else []
        return [*notes, omissions.bodies(self.bodies)] if self.bodies else notes

    def _at_any_depth(self, why: str) -> BodyCalibration:
        return replace(self, fat_mm=None, fat_note=why, hidden=self.hidden_any)

    @property
    def _eq6(self) -> FloatArray:
        return self.mean[: len(self.eq6_powers)]

    @property
    def _averages(self) -> bool:
        """Whether sizes are averaged over depths of fat."""
        return self.depth is not None and self.fat_mm is None

    def _values(self, log_amplitude: FloatArray, log_width: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """u, v and w; w has one axis more before the others where sizes are averaged over depths of fat."""
        alpha, p0, w0 = self.centre
        u, v = np.asarray(log_amplitude - alpha), np.asarray(log_width - p0)
        if self.depth is None:
            return u, v, np.zeros_like(u)
        if self.fat_mm is None:
            return u, v, self.depth.without_profile(u, v, centre=w0)
        return u, v, np.full_like(u, np.log(self.fat_mm) - w0)

    def _averaged(self, values: FloatArray) -> FloatArray:
        """Over the depths of fat where these are not known."""
        return np.asarray(np.tensordot(WEIGHTS, values, 1)) if self._averages else values

    def _spread_terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        values = np.broadcast_arrays(*self._values(log_amplitude, log_width))
        return monomials(values, self.spread_powers)

    def _log_sizes(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        values = self._values(log_amplitude, log_width)
        found = eq6_log_size(*values, self._eq6, self.eq6_powers)
        if self.residual is None:
            return found
        weights = self.residual.whitening @ self.mean[len(self.eq6_powers) : self.coefficients]
        return found + self.residual.correlation(np.stack(np.broadcast_arrays(*values), axis=-1)) @ weights

    def _unlike(self, amplitude: float, sigma_mm: float) -> str:
        return (
            f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm, a pair unlike those of the table "
            f"(leverage {self.leverage(amplitude, sigma_mm):.1f} times the limit)"
        )


def mean_width_mm(sigma_x_mm: float, sigma_y_mm: float | None) -> float:
    """The geometric mean of two widths; one alone stands for both."""
    return float(np.sqrt(sigma_x_mm * (sigma_x_mm if sigma_y_mm is None else sigma_y_mm)))


def block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """One square matrix of several along its diagonal."""
    size = sum(len(one) for one in blocks)
    whole, at = np.zeros((size, size)), 0
    for one in blocks:
        whole[at : at + len(one), at : at + len(one)] = one
        at += len(one)
    return whole
