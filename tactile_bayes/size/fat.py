r"""The depth F of the fat-gland boundary under the head: from the head's pressure profile, or what a map leaves of it.

Amplitude and width alone leave the lump's seat open: how far it stands out of the gland. Where no lump lies, the
pressure over the head depends on F, so the profile tells it, by a quadratic learned over the same bodies; its error is
part of what the calibration was learned with. Without a profile ln F is normal about what amplitude and width lead one
to expect of it, and sizes are averaged over that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import numpy as np

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import FloatArray, Matrix, Vector
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.size.terms import LEARN_ANEW, Above0, Range, Share, check_shapes, monomials, powers

MOST_LEVERAGE: Final = 1.0
"""A profile is unlike the table's where its leverage exceeds this multiple of the table's largest."""
NODES = np.sqrt(2.0) * np.array([-2.0201828704560856, -0.9585724646138185, 0.0, 0.9585724646138185, 2.0201828704560856])
WEIGHTS = np.array([0.011257411327720688, 0.22207592200561263, 8.0 / 15.0, 0.22207592200561263, 0.011257411327720688])
"""Gauss-Hermite rule of five points for a standard normal (Abramowitz & Stegun 1964, table 25.10)."""


def head_profile(quality: Mapping[str, float]) -> tuple[float, ...] | None:
    """Read `HEAD_PROFILE` from a map's figures; None for a map without one, such as an imported grid."""
    values = tuple(float(quality.get(name, np.nan)) for name in HEAD_PROFILE)
    return values if np.isfinite(values).all() else None


class FatDepth(Record, eq=False):
    """Regression of the ln of the depth of the fat-gland boundary in mm on the head's pressure profile."""

    centre: Annotated[Vector, Meta(description="Of the profile.")]
    scale: Annotated[Vector, Meta(description="Of the profile.")]
    coefficients: Annotated[Vector, Meta(description="Of 1, the scaled profile, and its products.")]
    information_inverse: Annotated[Matrix, Meta(description="For the leverage of a new profile.")]
    most_leverage: Annotated[Above0, Meta(description="Largest in the table.")]
    log_sd: Annotated[Share, Meta(description="How far single exams of the table lie from the truth.")]
    fat_mm: Annotated[Range, Meta(description="Range of the depth in the table.")]
    expected: Annotated[Vector, Meta(description="Of a full quadratic in u and v: w without a profile.")]
    expected_sd: Annotated[Share, Meta(description="Of w about that.")]
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

    def unlike(self, profile: FloatArray) -> FloatArray:
        """(...) leverage over the table's largest; above 1 the profile lies outside the table."""
        x = self.terms(profile)
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.information_inverse, x) / self.most_leverage)

    def without_profile(self, u: FloatArray, v: FloatArray, *, centre: float) -> FloatArray:
        """(5, ...) w at the rule's `NODES`, within the table's range, for w_0 in `centre`."""
        low, high = np.log(self.fat_mm) - centre
        expected = np.clip(monomials((u, v), powers(2)) @ self.expected, low, high)
        return np.asarray(expected + self.expected_sd * NODES.reshape(-1, *([1] * expected.ndim)))

    def of_mass(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float | None, str]:
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

    def apart(self, profiles: Sequence[tuple[float, ...] | None]) -> tuple[float, float] | None:
        """Least and largest F in mm, where maps differ too much to be of one body.

        None where they agree to three SDs of a difference between two exams, or where fewer than two tell it.
        """
        log_depth = self._log_depths(profiles)
        if len(log_depth) < 2 or np.ptp(log_depth) <= 3.0 * np.sqrt(2.0) * self.log_sd:
            return None
        return float(np.exp(log_depth.min())), float(np.exp(log_depth.max()))

    def _log_depths(self, profiles: Sequence[tuple[float, ...] | None]) -> FloatArray:
        """(n,) ln F of the profiles that resemble the table's."""
        known = np.array([one for one in profiles if one is not None], dtype=np.float64)
        known = known.reshape(-1, len(self.centre))
        return self.log_depth(known[self.unlike(known) <= MOST_LEVERAGE])


def profile_terms(z: FloatArray) -> FloatArray:
    """(..., 10) terms of a full quadratic in (..., 3) values."""
    i, j = np.triu_indices(z.shape[-1])
    return np.concatenate([np.ones((*z.shape[:-1], 1)), z, z[..., i] * z[..., j]], axis=-1)
