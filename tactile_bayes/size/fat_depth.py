r"""Size calibration conditional on the depth of fat, which is estimated from the head's pressure profile.

Amplitude and width alone leave the lump's seat open: how far it stands out of the gland. Where no lump lies, the
pressure over the head depends on the depth F of the fat-gland boundary, so the profile tells F. ln d is then a full
cubic in :math:`u = \ln a - \alpha_0`, :math:`v = p - p_0` and :math:`w = \ln F - w_0`, which at one depth is a cubic in
u and v, or a Gaussian process in u, v and the profile (`fat_process`). F is found by a quadratic learned over the same
bodies; its error is part of what the calibration was learned with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.records import dataclass
from tactile_bayes.size.hidden import HiddenTerms, RoundLumps, RoundSpread
from tactile_bayes.size.polynomials import monomials, powers

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ORDER = 3
POWERS = tuple((i, j, k) for k in range(ORDER + 1) for i, j in powers(ORDER - k))
"""Of u, v and w in the twenty terms of the cubic."""
ROUND = tuple((i, j, k) for k in range(3) for i, j in powers(2 - k))
"""The same for what makes a ball's map oval: a full quadratic."""
Powers = tuple[tuple[int, int], ...]
_ROUND: Powers = tuple((powers(2).index((i, j)), k) for i, j, k in ROUND)
MOST_LEVERAGE = 1.0
"""A profile is unlike the table's where its leverage exceeds this multiple of the table's largest."""


def head_profile(quality: Mapping[str, float]) -> tuple[float, ...] | None:
    """Read `HEAD_PROFILE` from a map's figures; None for a map without one, such as an imported grid."""
    values = tuple(float(quality.get(name, np.nan)) for name in HEAD_PROFILE)
    return values if np.isfinite(values).all() else None


@dataclass(frozen=True, slots=True, eq=False)
class FatDepth:
    """Regression of ln F, F the depth of fat in mm: a full quadratic in the profile.

    Parameters
    ----------
    centre, scale : (3,) arrays
        Of `HEAD_PROFILE`.
    coefficients : (10,) array
        Of 1, the three, and their products.
    information_inverse : (10, 10) array
        For the leverage of a new profile.
    most_leverage
        Largest in the table.
    log_sd
        How far single exams of the table lie from the truth.
    """

    centre: FloatArray
    scale: FloatArray
    coefficients: FloatArray
    information_inverse: FloatArray
    most_leverage: float
    log_sd: float

    def terms(self, profile: FloatArray) -> FloatArray:
        """(..., 10) terms of (..., 3) profiles."""
        return profile_terms((profile - self.centre) / self.scale)

    def log_depth(self, profile: FloatArray) -> FloatArray:
        """(...) ln F, F in mm, of (..., 3) profiles."""
        return np.asarray(self.terms(profile) @ self.coefficients)

    def unlike(self, profile: FloatArray) -> FloatArray:
        """(...) leverage over the table's largest; above 1 the profile lies outside the table."""
        x = self.terms(profile)
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.information_inverse, x) / self.most_leverage)


@dataclass(frozen=True, slots=True, eq=False)
class FatTerms:
    """The calibration for maps with a profile, of a form that its subclasses name.

    Parameters
    ----------
    depth
        From profile to F.
    centre
        alpha_0, p_0 and w_0.
    mean, covariance : (k + s + 1,), (k + s + 1, k + s + 1) arrays
        Posterior of the k coefficients, the s of ln SD(B) and ln SD(E).
    round_coefficients : (10,) array
        Of `ROUND` in q0, see `RoundLumps`.
    round_spread
        About it.
    information_inverse : (c, c) array
        Of the c features by which a map is like or unlike the table's.
    most_leverage
        As in `BodyCalibration`.
    fat_mm
        Range of F in the table.
    hidden
        As in `BodyCalibration`, with `expected` over the c features.
    fit
        Figures of the fit.
    """

    depth: FatDepth
    centre: tuple[float, float, float]
    mean: FloatArray
    covariance: FloatArray
    round_coefficients: FloatArray
    round_spread: RoundSpread
    information_inverse: FloatArray
    most_leverage: float
    fat_mm: tuple[float, float]
    hidden: HiddenTerms | None = None
    fit: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        k, c = self.coefficients + len(self.spread_powers) + 1, len(self.feature_powers)
        shapes = {"mean": (k,), "covariance": (k, k)}
        shapes |= {"round_coefficients": (len(ROUND),), "information_inverse": (c, c)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise BadDataError(f"{self.file_key}.{name} is no finite {shape}", way_out="learn the calibration anew")

    @property
    def file_key(self) -> str:
        """Its name in a calibration's file."""
        raise NotImplementedError

    @property
    def coefficient_powers(self) -> Powers:
        """Which coefficient at one depth each of the k belongs to, and the power of w that multiplies it."""
        raise NotImplementedError

    @property
    def feature_powers(self) -> Powers:
        """The same of the features."""
        raise NotImplementedError

    @property
    def spread_powers(self) -> Powers:
        """The same of the coefficients of ln SD(B)."""
        return ((0, 0), (1, 0))

    @property
    def coefficients(self) -> int:
        """How many there are."""
        return len(self.coefficient_powers)

    def at(
        self,
        base: DataclassInstance,
        log_depth: float,
        profiles: Sequence[tuple[float, ...] | None],  # noqa: ARG002, for forms that depend on it
    ) -> Any:
        """The `BodyCalibration` for one depth of fat, and one profile where the form depends on it.

        Parameters
        ----------
        base
            The `BodyCalibration` for any depth.
        log_depth
            ln F of the mass.
        profiles
            Of its maps.
        """
        return replace(base, **self.fields_at(base, log_depth))

    def fields_at(self, base: DataclassInstance, log_depth: float) -> dict[str, Any]:
        """The fields in which the calibration for one depth differs from `base`."""
        whole = _block_diagonal(self.contraction(log_depth), self._contracted(self.spread_powers, log_depth), np.eye(1))
        of_features, hidden = self.feature_contraction(log_depth), self.hidden
        return {
            "centre": self.centre[:2],
            "mean": whole @ self.mean,
            "covariance": whole @ self.covariance @ whole.T,
            "round_lumps": self.round_lumps(log_depth),
            "information_inverse": of_features @ self.information_inverse @ of_features.T,
            "most_leverage": self.most_leverage,
            "hidden": None if hidden is None else hidden.at_depth(of_features),
            "fit": self.fit,
            "with_fat": None,
            "fat_mm": float(np.exp(log_depth)),
            "any_depth": replace(base, with_fat=None),
        }

    def without_places(self) -> FatTerms:
        """The calibration without the figures by place, of which only a process knows."""
        return self

    def depths_apart(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float, float] | None:
        """Least and largest depth of fat in mm, where maps differ too much to be of one body.

        None where they agree to three SDs of a difference between two exams, or where fewer than two tell a depth.
        """
        log_depth = self._log_depths(profiles)
        if len(log_depth) < 2 or np.ptp(log_depth) <= 3.0 * np.sqrt(2.0) * self.depth.log_sd:
            return None
        return float(np.exp(log_depth.min())), float(np.exp(log_depth.max()))

    def log_depth(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float | None, str]:
        """ln F of a mass from its maps' profiles, of which one is known, or the reason why there is none.

        Profiles unlike the table's are left out; those of one mass are averaged, for its exams share the body.
        """
        like = self._log_depths(profiles)
        if not len(like):
            return None, "the head's pressure profile is unlike any of the calibration's"
        log_depth = float(like.mean())
        (low, high), fat_mm = self.fat_mm, np.exp(log_depth)
        if not low <= fat_mm <= high:
            return None, f"the fat under the head is {fat_mm:.3g} mm deep (table: {low:.3g} to {high:.3g} mm)"
        return log_depth, ""

    def alike(self, profiles: Sequence[tuple[float, ...] | None]) -> FloatArray:
        """(n, 3) profiles that resemble the table's."""
        known = np.array([one for one in profiles if one is not None], dtype=np.float64)
        known = known.reshape(-1, len(self.depth.centre))
        return np.asarray(known[self.depth.unlike(known) <= MOST_LEVERAGE])

    def _log_depths(self, profiles: Sequence[tuple[float, ...] | None]) -> FloatArray:
        """(n,) ln F of the profiles that resemble the table's."""
        return self.depth.log_depth(self.alike(profiles))

    def contraction(self, log_depth: float) -> FloatArray:
        """Matrix that takes the k coefficients to those at one depth."""
        return self._contracted(self.coefficient_powers, log_depth)

    def feature_contraction(self, log_depth: float) -> FloatArray:
        """Matrix that takes what is linear in the features to the same at one depth."""
        return self._contracted(self.feature_powers, log_depth)

    def _contracted(self, columns: Powers, log_depth: float) -> FloatArray:
        w = log_depth - self.centre[2]
        found = np.zeros((1 + max(row for row, _ in columns), len(columns)))
        for column, (row, power) in enumerate(columns):
            found[row, column] = w**power
        return found

    def round_lumps(self, log_depth: float) -> RoundLumps:
        """Map of a ball at one depth of fat."""
        return RoundLumps(self._contracted(_ROUND, log_depth) @ self.round_coefficients, self.round_spread)


@dataclass(frozen=True, slots=True, eq=False)
class FatCubic(FatTerms):
    """ln d as a full cubic in u, v and w; made by `learn_fat_cubic`."""

    @property
    def file_key(self) -> str:
        """Its name in a calibration's file."""
        return "fat_cubic"

    @property
    def coefficient_powers(self) -> Powers:
        """At one depth a cubic in u and v is left, in the order of `polynomials.powers`."""
        return _CUBIC

    @property
    def feature_powers(self) -> Powers:
        """The terms themselves."""
        return _CUBIC


_CUBIC: Powers = tuple((powers(ORDER).index((i, j)), k) for i, j, k in POWERS)


def _block_diagonal(*blocks: FloatArray) -> FloatArray:
    whole = np.zeros(tuple(np.sum([one.shape for one in blocks], axis=0)))
    row = column = 0
    for one in blocks:
        whole[row : row + len(one), column : column + one.shape[1]] = one
        row, column = row + len(one), column + one.shape[1]
    return whole


def cubic_terms(u: FloatArray, v: FloatArray, w: FloatArray) -> FloatArray:
    """(n, 20) polynomial terms `POWERS`."""
    return monomials((u, v, w), POWERS)


def profile_terms(z: FloatArray) -> FloatArray:
    """(..., 10) terms of a full quadratic in (..., 3) values."""
    i, j = np.triu_indices(z.shape[-1])
    return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], axis=-1)
