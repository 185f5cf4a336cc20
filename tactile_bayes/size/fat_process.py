r"""Size calibration as a Gaussian process in amplitude, width and what the frames tell.

With :math:`x = (u, v, z_1, z_2, z_3)`, z the standardised profile of the head, and u, v, w as in `fat_depth`,

.. math:: \ln d = \beta_0 + \beta_1 u + \beta_2 v + \beta_3 w + h(x) + B + E, \quad
          h \sim GP(0, k), \quad k(x, x') = s_h^2 \exp\Big(-\tfrac12 \sum_i (x_i - x_i')^2 / l_i^2\Big),

by a subset of regressors (Quinonero-Candela & Rasmussen 2005, sec. 3): with the points U and
:math:`K_{UU} = L L^T`, :math:`h(x) = s_h\, k(x, U) L^{-T} c`, the weights c being standard normal a priori. So the
calibration is linear in its coefficients, as the others are. ln SD(B) is a full quadratic in u, v and w: a deep or
faint lump tells less than one that is shallow and hard.

For maps that keep frames a second process has the six figures of `mapping.bump_by_place` among its inputs too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.records import dataclass
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.fat_depth import ORDER, POWERS, FatTerms, Powers
from tactile_bayes.size.polynomials import monomials, powers

if TYPE_CHECKING:
    from collections.abc import Mapping

    from _typeshed import DataclassInstance

AT_ONE_DEPTH = ((0, 0), (1, 0), (0, 1))
"""Powers of u and v in the part without the process, at one depth of fat."""
LINEAR_POWERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
"""Powers of u, v and w in that part: 1, u, v and w."""
LINEAR: Powers = tuple((AT_ONE_DEPTH.index((i, j)), k) for i, j, k in LINEAR_POWERS)
SPREAD = tuple((i, j, k) for k in range(3) for i, j in powers(2 - k))
"""Powers of u, v and w in ln SD(B)."""
_SPREAD: Powers = tuple((powers(2).index((i, j)), k) for i, j, k in SPREAD)
_FEATURES: Powers = tuple((powers(ORDER).index((i, j)), k) for i, j, k in POWERS)
MOST_SCALES = 4.0
"""A figure by place further from its table's centre, in scales, counts as being there."""
UNLIKE_PLACES = 2.0
"""Figures by place beyond this multiple of the limit are as no ball's: 1.2 % of the table's maps are (record 0107)."""
_NUGGET = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """The process h as functions with standard normal weights.

    Parameters
    ----------
    points : (m, k) array
        U, in the units of x.
    lengths : (k,) array
        l.
    scale
        s_h.
    whitening : (m, m) array
        s_h L^{-T}, from k(x, U) to the functions.
    """

    points: FloatArray
    lengths: FloatArray
    scale: float
    whitening: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        m, k = self.points.shape
        if self.lengths.shape != (k,) or not (self.lengths > 0).all() or not self.scale > 0:
            raise BadDataError(f"lengths and scale of a process with {m} points of {k} values must be above 0")
        factor = np.linalg.cholesky(self.correlation(self.points) + _NUGGET * np.eye(m))
        object.__setattr__(self, "whitening", np.asarray(self.scale * np.linalg.inv(factor).T))

    def correlation(self, x: FloatArray) -> FloatArray:
        """(n, m) k(x, U) over s_h^2 for (n, k) values."""
        return squared_exponential(x, self.points, self.lengths)

    def functions(self, x: FloatArray) -> FloatArray:
        """(n, m) functions of (n, k) values."""
        return np.asarray(self.correlation(x) @ self.whitening)


def squared_exponential(x: FloatArray, points: FloatArray, lengths: FloatArray) -> FloatArray:
    """(..., m) correlations of (..., k) values with (m, k) points."""
    x, points = x / lengths, points / lengths
    exponent = np.asarray(x @ points.T)
    exponent -= 0.5 * np.sum(points**2, axis=-1)
    exponent -= 0.5 * np.sum(x**2, axis=-1, keepdims=True)
    return np.asarray(np.exp(exponent, out=exponent))


@dataclass(frozen=True, slots=True, eq=False)
class PlaceTable:
    """The figures by place, `presets.BY_PLACE`, of the maps that a process was learned from.

    Parameters
    ----------
    centre, scale : (6,) arrays
    information_inverse : (7, 7) array
        Of one and the standardised figures, for the leverage of a new map.
    most_leverage
        Of maps inside the table.
    """

    centre: FloatArray
    scale: FloatArray
    information_inverse: FloatArray
    most_leverage: float

    def standardised(self, by_place: FloatArray) -> FloatArray:
        """(..., 6) figures about the table's centre, in its scales, at most `MOST_SCALES`."""
        return np.clip((by_place - self.centre) / self.scale, -MOST_SCALES, MOST_SCALES)

    def leverage(self, by_place: FloatArray) -> FloatArray:
        """(n,) leverage of (n, 6) figures over the limit."""
        x = np.insert((by_place - self.centre) / self.scale, 0, 1.0, axis=-1)
        return np.asarray(np.einsum("ni,ij,nj->n", x, self.information_inverse, x) / self.most_leverage)

    def mean(self, by_place: Sequence[tuple[float, ...] | None]) -> tuple[FloatArray | None, str]:
        """(6,) standardised mean over the maps of a mass that resemble the table's, or the reason why there is none."""
        known = [one for one in by_place if one is not None]
        if not known:
            return (
                None,
                "no map keeps frames that feel the lump alone, over even fat (maps of earlier versions keep none)",
            )
        found = np.array(known)
        inside = self.leverage(found) <= 1.0
        if not inside.any():
            return None, "they are unlike any of the calibration's"
        return self.standardised(found[inside]).mean(axis=0), ""


@dataclass(frozen=True, slots=True, eq=False)
class FatProcess(FatTerms):
    """The calibration for maps with a profile; made by `learn_fat_process`.

    `mean` and `covariance` are of `LINEAR`, the weights c, `SPREAD` and ln SD(E). By the features of a full cubic in u,
    v and w a map is like or unlike the table's.

    Parameters
    ----------
    kernel
        Of h.
    other_sd
        SD of ln d by which a body may differ because it is none of the population's kind; adds to that of B.
    map_factor
        As in `BodyCalibration`.
    places
        The figures by place among the inputs; None where they are none.
    with_places
        The same with them, for maps that have them; None where the table had too few.
    """

    kernel: Kernel | None = None
    other_sd: float = 0.0
    map_factor: float = 1.0
    places: PlaceTable | None = None
    with_places: FatProcess | None = None

    def __post_init__(self) -> None:
        FatTerms.__post_init__(self)
        inputs = 2 + len(self.depth.centre) + (0 if self.places is None else len(self.places.centre))
        if self._kernel.points.shape[1] != inputs:
            what = f"the process has points of {self._kernel.points.shape[1]} values, not {inputs}"
            raise BadDataError(what, way_out="learn it anew")

    @property
    def file_key(self) -> str:
        """Its name in a calibration's file."""
        return "fat_process"

    @property
    def coefficient_powers(self) -> Powers:
        """The linear part; the weights of the process follow."""
        return LINEAR

    @property
    def feature_powers(self) -> Powers:
        """The terms of a full cubic."""
        return _FEATURES

    @property
    def spread_powers(self) -> Powers:
        """A full quadratic."""
        return _SPREAD

    @property
    def coefficients(self) -> int:
        """Four, and the weights of the process."""
        return len(LINEAR) + len(self._kernel.points)

    @property
    def _kernel(self) -> Kernel:
        if self.kernel is None:
            raise BadDataError("the calibration has no process", way_out="learn it anew")
        return self.kernel

    def without_places(self) -> FatProcess:
        """The process of amplitude, width and profile alone."""
        return replace(self, with_places=None)

    def contraction(self, log_depth: float) -> FloatArray:
        """Matrix that takes the coefficients to those at one depth; the weights stay."""
        linear, m = self._contracted(LINEAR, log_depth), len(self._kernel.points)
        rows, columns = linear.shape
        whole = np.eye(rows + m, columns + m, k=columns - rows)
        whole[:rows] = 0.0
        whole[:rows, :columns] = linear
        return whole

    def at(
        self, base: DataclassInstance, log_depth: float, profiles: Sequence[tuple[float, ...] | None]
    ) -> ProcessAtProfile:
        """The calibration at the mean of the profiles."""
        profile = (self.alike(profiles).mean(axis=0) - self.depth.centre) / self.depth.scale
        return self.at_figures(base, log_depth, profile)

    def at_figures(self, base: DataclassInstance, log_depth: float, figures: FloatArray) -> ProcessAtProfile:
        """The calibration at one depth for (3,) or (9,) standardised figures of the frames."""
        fields: Mapping[str, object] = {name: getattr(base, name) for name in BodyCalibration.__match_args__}
        own = {name: getattr(self, name) for name in ("kernel", "other_sd", "map_factor", "with_places")}
        found = ProcessAtProfile(**{**fields, **self.fields_at(base, log_depth), **own, "profile": figures})
        if self.places is None or found.hidden is None:
            return found
        return replace(found, hidden=found.hidden.at_places(figures[len(HEAD_PROFILE) :]))


@dataclass(frozen=True, slots=True, eq=False)
class ProcessAtProfile(BodyCalibration):
    """The calibration for one profile; made by `FatProcess.at`.

    Parameters
    ----------
    kernel
        Of h.
    profile : (3,) or (9,) array
        z of the mass, and its standardised figures by place where these are known.
    with_places
        As in `FatProcess`.
    """

    kernel: Kernel | None = None
    profile: FloatArray | None = None
    with_places: FatProcess | None = None

    @property
    def knows_places(self) -> bool:
        """Whether it is for one mass's figures by place."""
        return len(self._profile) > len(HEAD_PROFILE)

    def at_places(self, by_place: Sequence[tuple[float, ...] | None]) -> BodyCalibration:
        """The calibration that knows the figures by place, at their mean over the maps that have them."""
        process = self.with_places
        if process is None or process.places is None:
            return self
        figures, why_not = process.places.mean(by_place)
        if figures is None:
            return replace(self, with_places=None, places_note=why_not)
        found = process.at_figures(self, float(np.log(self.fat_mm or np.nan)), np.append(self._profile, figures))
        return replace(found, any_depth=self.any_depth)

    def unlike_places(self, by_place: tuple[float, ...] | None) -> bool:
        """Whether a map's figures by place are as no ball's."""
        process = self.with_places
        if by_place is None or process is None or process.places is None:
            return False
        return bool(process.places.leverage(np.array([by_place]))[0] > UNLIKE_PLACES)

    @property
    def form_name(self) -> str:
        """The form, for people."""
        return "the Gaussian process"

    @property
    def coefficients(self) -> int:
        """Three, and the weights of the process."""
        return len(AT_ONE_DEPTH) + len(self._kernel.points)

    @property
    def spread_powers(self) -> tuple[tuple[int, int], ...]:
        """At one depth a full quadratic in u and v is left."""
        return powers(2)

    def terms(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 3 + m) linear terms and functions of the process."""
        linear = monomials(self._centred(log_amplitude, log_width), AT_ONE_DEPTH)
        process = self._correlation(log_amplitude, log_width) @ self._kernel.whitening
        return np.concatenate([linear, process], axis=-1)

    def features(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., 10) terms of a full cubic in u and v."""
        return monomials(self._centred(log_amplitude, log_width), powers(ORDER))

    def log_size(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) ln d without B and E, with the mean coefficients."""
        linear = monomials(self._centred(log_amplitude, log_width), AT_ONE_DEPTH) @ self.mean[: len(AT_ONE_DEPTH)]
        return np.asarray(linear + self._correlation(log_amplitude, log_width) @ self._weights())

    def width_slope(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(...,) derivative of ln d by p: the relative growth of size with the map's width."""
        kernel, (_, v) = self._kernel, self._centred(log_amplitude, log_width)
        by_width = -(v[..., None] - kernel.points[:, 1]) / kernel.lengths[1] ** 2
        process = (self._correlation(log_amplitude, log_width) * by_width) @ self._weights()
        return np.asarray(self.mean[AT_ONE_DEPTH.index((0, 1))] + process)

    def _centred(self, log_amplitude: FloatArray, log_width: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.asarray(log_amplitude - self.centre[0]), np.asarray(log_width - self.centre[1])

    def _correlation(self, log_amplitude: FloatArray, log_width: FloatArray) -> FloatArray:
        """(..., m) k(x, U) over s_h^2: the factor of the profile is the same for all maps."""
        points, lengths = self._kernel.points, self._kernel.lengths
        by_profile = squared_exponential(self._profile, points[:, 2:], lengths[2:])
        shape = np.stack(self._centred(log_amplitude, log_width), axis=-1)
        return np.asarray(by_profile * squared_exponential(shape, points[:, :2], lengths[:2]))

    def _weights(self) -> FloatArray:
        """(m,) weights of the correlations."""
        return np.asarray(self._kernel.whitening @ self.mean[len(AT_ONE_DEPTH) : self.coefficients])

    @property
    def _kernel(self) -> Kernel:
        assert self.kernel is not None
        return self.kernel

    @property
    def _profile(self) -> FloatArray:
        assert self.profile is not None
        return self.profile
