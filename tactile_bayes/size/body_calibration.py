r"""Size calibrations learned over a population of bodies: what their forms share.

With :math:`u = \ln a - \alpha_0` and :math:`v = p - p_0`, where p is the log of the geometric mean of the two widths,

.. math:: \ln d = g(u, v; \beta) + B + E

g is the form: a polynomial (`log_quadratic`), Eq 6 (`population_eq6`) or a Gaussian process (`fat_process`). B differs
from body to body by what a map does not show (seat, stiffness, moduli): :math:`N(0, s^2)`, with ln s a polynomial in u
and v, or with that spread and the skewness of `hidden.HiddenTerms`. E differs from exam to exam of one body.

A ball under the oblong head gives an oval map; its half log axis ratio :math:`q_0` is a quadratic in u and v, and only
what exceeds it says that a lump is not round.

Where the depth F of the fat under the head is known, the coefficients are those at that depth, `fat_depth.FatTerms`.
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
from tactile_bayes.size.fat_depth import FatTerms
from tactile_bayes.size.hidden import HiddenTerms, RoundLumps
from tactile_bayes.size.polynomials import monomials
from tactile_bayes.size.site_shift import SiteShift

UNLIKE = "is unlike the bodies of the table"
SPREAD_PARAMETERS = ("log_body_sd", "body_sd_slope", "log_exam_sd")
MOST_LEVERAGE = 1.0
"""A map is outside the table where its leverage exceeds this multiple of the table's largest."""
FARTHEST_LEVERAGE = 3.0
"""Beyond this multiple there is no size."""
UNLIKE_SD = 0.1
"""SD of ln d by which a body may differ because its map or its head profile is unlike the table's (record 0123)."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyCalibration:
    """A calibration over a population; its subclasses give the form.

    Parameters
    ----------
    centre
        alpha_0 and p_0.
    mean, covariance : (k + s + 1,), (k + s + 1, k + s + 1) arrays
        Posterior of the k coefficients, the s of ln SD(B) and ln SD(E), taken as normal.
    round_lumps
        What a ball's map looks like.
    information_inverse : (c, c) array
        Inverse of X^T X over the table, X its maps' c `features`: gives the leverage of a new map.
    most_leverage
        Largest in the table.
    domain
        Ranges of ``amplitude``, ``sigma_mm`` (geometric mean) and ``d_mm`` in the table.
    recipe
        How the table's maps were built and fitted.
    hidden
        What B is made of.
    fit
        Figures of the fit.
    source
        In words: what the table was made of.
    bodies
        Ranges of the table's lumps and bodies, by their columns; empty in files of earlier versions.
    with_fat
        The same for maps that tell how deep the fat under the head is; None where the table did not.
    fat_mm
        Depth F that this calibration is for; None where it is for any.
    fat_note
        Why the depth is not used though the calibration could; empty otherwise.
    places_note
        The same of the figures by place.
    any_depth
        Of a calibration for one depth, that for any.
    other_sd
        SD of ln d by which a body may differ because it is none of the table's kind; part of SD(B).
    map_factor
        How many times the variance of ln d that a map's posterior gives counts. Figures by place are taken at the bump
        that the map shows and move against its noise, so sizes by them vary less; without them it is more.
    site
        Correction by a site's own phantoms; `pooling` adds it, no method of this class does.
    """

    centre: tuple[float, float]
    mean: FloatArray
    covariance: FloatArray
    round_lumps: RoundLumps
    information_inverse: FloatArray
    most_leverage: float
    domain: Mapping[str, tuple[float, float]]
    recipe: Recipe
    hidden: HiddenTerms | None = None
    fit: Mapping[str, float] = field(default_factory=dict)
    source: str = ""
    bodies: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    with_fat: FatTerms | None = None
    fat_mm: float | None = None
    fat_note: str = ""
    places_note: str = ""
    any_depth: BodyCalibration | None = None
    other_sd: float = 0.0
    map_factor: float = 1.0
    site: SiteShift | None = None

    def __post_init__(self) -> None:
        k = self.coefficients + len(self.spread_powers) + 1
        if self.mean.shape != (k,) or self.covariance.shape != (k, k):
            raise BadDataError(
                f"mean and covariance have shapes {self.mean.shape} and {self.covariance.shape}",
                way_out=f"they must be ({k},) and ({k}, {k})",
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.covariance).all()):
            raise BadDataError("a coefficient is not finite", way_out="learn the calibration anew")
        if np.linalg.eigvalsh(self.covariance)[0] < -1e-9 * np.trace(self.covariance):
            raise BadDataError("the covariance has a negative eigenvalue", way_out="learn the calibration anew")

    def at_fat(self, profiles: Sequence[tuple[float, ...] | None]) -> BodyCalibration:
        """The calibration for a mass whose maps have these `presets.HEAD_PROFILE`, None for a map without one.

        Where they tell no depth it is this one, with the reason in `fat_note`; wider where the profiles are of another
        body than the table's.
        """
        fat = self.with_fat
        if fat is None:
            return self
        if all(one is None for one in profiles):
            return replace(self, with_fat=None, fat_note="the map has no pressure profile of the head")
        log_depth, why_not = fat.log_depth(profiles)
        if log_depth is None:
            return replace(self, with_fat=None, fat_note=why_not).for_another_kind()
        found: BodyCalibration = fat.at(self, log_depth, profiles)
        return found

    @property
    def knows_places(self) -> bool:
        """Whether it is for one mass's figures by place."""
        return False

    def at_places(self, by_place: Sequence[tuple[float, ...] | None]) -> BodyCalibration:  # noqa: ARG002
        """The calibration for a mass whose maps have these `presets.BY_PLACE`: this one, if it has no use for them."""
        return self

    def unlike_places(self, by_place: tuple[float, ...] | None) -> bool:  # noqa: ARG002
        """Whether the figures by place are far from those of balls; asked before `at_places`."""
        return False

    def fitting(self, amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None = None) -> BodyCalibration:
        """This calibration, or the one for any depth where no body of the table looks like the map at this depth.

        What was learned at one depth says nothing beyond its table: a cubic was wrong there by up to a factor of 11.
        """
        sigma_mm = mean_width_mm(sigma_x_mm, sigma_y_mm)
        if self.any_depth is None or self.leverage(amplitude, sigma_mm) <= MOST_LEVERAGE:
            return self
        what = f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm over {self.fat_mm:.3g} mm of fat"
        return replace(self.any_depth, fat_note=f"{what} {UNLIKE}").for_another_kind()

    def for_another_kind(self) -> BodyCalibration:
        """This calibration with room for a body unlike any of the table's: intervals without it held 38 of 48."""
        return replace(self, other_sd=float(np.hypot(self.other_sd, UNLIKE_SD)))

    @property
    def between_exams(self) -> BetweenMaps:
        """How ln d differs between exams of one body of the table."""
        return BetweenMaps(float(np.exp(self.mean[-1])))

    @property
    def spread_powers(self) -> tuple[tuple[int, int], ...]:
        """Powers of u and v in ln SD(B)."""
        return ((0, 0), (1, 0))

    @property
    def unknowns(self) -> dict[str, float]:
        """Share of the variance between bodies that knowing each property alone would take away."""
        return {} if self.hidden is None else {name: self.hidden.share(name) for name in self.hidden.names}

    @property
    def is_skewed(self) -> bool:
        """Whether B is longer above than below."""
        return self.hidden is not None and self.hidden.skewness > 0.0

    @property
    def coefficients(self) -> int:
        """How many the form has."""
        raise NotImplementedError

    @property
    def form_name(self) -> str:
        """The form, for people."""
        raise NotImplementedError

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., k) derivatives of ln d by the coefficients."""
        raise NotImplementedError

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., c) features of a map, in which its leverage and what it leads one to expect of a body are linear."""
        raise NotImplementedError

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients; NaN where the form has no size."""
        raise NotImplementedError

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: how much longer an axis is for a wider map."""
        raise NotImplementedError

    def round_excess(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) q0, the half log axis ratio of a ball's map."""
        u, v = np.asarray(log_amplitude - self.centre[0]), np.asarray(log_width - self.centre[1])
        return self.round_lumps.excess(u, v)

    def body_and_error(
        self, terms: FloatArray, log_amplitude: FloatArray, log_width: FloatArray, score: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Standard deviation of B, and what the coefficients' error does to ln d given it.

        Parameters
        ----------
        terms : (n, k) array
            `terms` of the maps.
        log_amplitude, log_width : (n,) arrays
        score : (n,) array
            Standard normal scores of the uncertain ln SD(B).

        Returns
        -------
        body_sd, shift, variance : (n,) arrays
            Given `body_sd`, ln d is off by a normal error with mean `shift` and this variance: all parameters are
            jointly normal.
        """
        x = monomials((log_amplitude - self.centre[0], log_width - self.centre[1]), self.spread_powers)
        k, spread = self.coefficients, self.covariance
        sd = np.sqrt(np.maximum(np.sum(x @ spread[k:-1, k:-1] * x, axis=-1), 0.0))
        body_sd = np.exp(x @ self.mean[k:-1] + sd * score)
        together = np.sum(terms @ spread[:k, k:-1] * x, axis=-1)
        slope = np.divide(together, sd, out=np.zeros_like(sd), where=sd > 0)
        whole = np.sum(terms @ spread[:k, :k] * terms, axis=-1)
        return np.hypot(body_sd, self.other_sd), slope * score, np.maximum(whole - slope**2, 0.0)

    def own_sd(self, body_sd: FloatArray) -> FloatArray:
        """(n,) SD(B) without `other_sd`, of which nothing that is known of a body tells anything."""
        return np.asarray(np.sqrt(np.maximum(body_sd**2 - self.other_sd**2, 0.0)))

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
        notes += [omissions.by_place(self.places_note)] if self.places_note else []
        return [*notes, omissions.bodies(self.bodies)] if self.bodies else notes

    def _unlike(self, amplitude: float, sigma_mm: float) -> str:
        return (
            f"amplitude {amplitude:.3g} with sigma {sigma_mm:.3g} mm, a pair unlike those of the table "
            f"(leverage {self.leverage(amplitude, sigma_mm):.1f} times the limit)"
        )


def mean_width_mm(sigma_x_mm: float, sigma_y_mm: float | None) -> float:
    """The geometric mean of two widths; one alone stands for both."""
    return float(np.sqrt(sigma_x_mm * (sigma_x_mm if sigma_y_mm is None else sigma_y_mm)))
