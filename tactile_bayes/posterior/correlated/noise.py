r"""Correlated noise model: a Gaussian random field on a cosine basis plus white noise, whitened once for many fits.

The error of cell i is :math:`\tau\,(\epsilon_i + \sqrt{\rho}\, f(x_i))` with independent
:math:`\epsilon_i \sim N(0, D_i)` and a field f of unit variance and exponential correlation (Matern 1/2) of length l.
The field is written in cosines on a rectangle around the window, each with the variance that the spectrum gives it. So
a covariance is diagonal plus low rank, and every share :math:`\rho` comes from one eigen-decomposition a length.

References
----------
Solin & Saerkkae (2020), Statistics and Computing 30:419 (the basis); Rasmussen & Williams (2006), ch. 4 (the spectrum).
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import FIELD_COSINES, FINE_FIELD_COSINES
from tactile_bayes.records import dataclass

MARGIN = 1.3
"""Width of the rectangle in widths of the window: the field need not be flat where the window ends."""
LENGTHS_MM = (1.5, 3.0, 6.0, 12.0)
SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Variances of the field tried, over the mean independent variance of a cell."""
HALF_WAVE_IN_WIDTHS = 0.83
"""The shortest half wave that a bump's width calls for: below 3.5 mm, in a window of 20 mm, more than the fewest."""
TOUCHED = 1e-2
"""Directions in which the field's variance is a smaller part of the independent one are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """The noise field of one correlation length, prepared for every share.

    Parameters
    ----------
    length_mm
        Correlation length.
    turn : (cosines^2, k) array
        Takes inner products with the cosines, ``D^-1 Phi``, to directions in which the field's precision is diagonal.
    eigenvalues : (k,) array
        Of ``S^1/2 Phi' D^-1 Phi S^1/2``.
    """

    length_mm: float
    turn: FloatArray
    eigenvalues: FloatArray

    def shrinkage(self, share: float | FloatArray) -> FloatArray:
        """(..., k) weights of the squared projections that the field absorbs: ``rho / (1 + rho lambda)``."""
        rho = np.asarray(share)[..., None]
        return np.asarray(rho / (1.0 + rho * self.eigenvalues))

    def pruned(self, share: float) -> Whitening:
        """Copy without the directions that matter little at this share or a smaller one."""
        keep = share * self.eigenvalues > TOUCHED
        return Whitening(self.length_mm, np.ascontiguousarray(self.turn[:, keep]), self.eigenvalues[keep])

    def log_determinant(self, share: float | FloatArray) -> FloatArray:
        """(...) log determinant of the covariance over that of D."""
        return np.asarray(np.log1p(np.asarray(share)[..., None] * self.eigenvalues).sum(axis=-1))


def no_field(cosines: int) -> Whitening:
    """The share of 0, the same for every length: no directions."""
    return Whitening(float(np.mean(LENGTHS_MM)), np.zeros((cosines**2, 0)), np.zeros(0))


def cosine_profiles(axis_mm: FloatArray, *, cosines: int = FIELD_COSINES) -> tuple[FloatArray, FloatArray]:
    """Cosines along one axis, with their squared angular frequencies.

    Returns
    -------
    profiles : (n, cosines) array
        Of mean square 1 over the axis and its margins.
    frequency2 : (cosines,) array of 1/mm^2
    """
    phase, side = _phase(axis_mm)
    order = np.arange(cosines)
    profiles = np.cos(np.pi * order * phase[:, None])
    profiles[:, 1:] *= np.sqrt(2.0)
    return profiles, np.asarray((np.pi * order / side) ** 2, dtype=np.float64)


def cosines_for(width_mm: float, axis_mm: FloatArray) -> int:
    """Number of cosines along an axis for a bump's width, from `FIELD_COSINES` to `FINE_FIELD_COSINES`.

    Errors shorter than the shortest half wave count as independent. For a narrow bump they are not: they have its
    shape.
    """
    _, side = _phase(axis_mm)
    wanted = np.ceil(side / (HALF_WAVE_IN_WIDTHS * max(width_mm, 1e-6)))
    return int(np.clip(wanted, FIELD_COSINES, FINE_FIELD_COSINES))


def _phase(axis_mm: FloatArray) -> tuple[FloatArray, float]:
    middle = 0.5 * (axis_mm.max() + axis_mm.min())
    side = MARGIN * max(float(np.ptp(axis_mm)), 1e-6)
    return (axis_mm - middle) / side + 0.5, side


def gram_of_cosines(along: FloatArray, across: FloatArray, *, weight: FloatArray) -> FloatArray:
    """Inner products of the plane's cosines under (ny, nx) weights: (cosines^2, cosines^2), y's order counted first.

    Parameters
    ----------
    along, across : (ny, cosines), (nx, cosines) arrays
        As from `cosine_profiles`.
    """
    pairs = [(one[:, :, None] * one[:, None, :]).reshape(len(one), -1) for one in (along, across)]
    cosines = along.shape[1]
    # axes: y, y', x, x'
    products = (pairs[0].T @ weight @ pairs[1]).reshape(cosines, cosines, cosines, cosines)
    return np.asarray(products.transpose(0, 2, 1, 3).reshape(cosines**2, cosines**2))


def spectrum(frequency2: FloatArray, length_mm: float) -> FloatArray:
    """(k,) variances of the cosines for an exponential correlation in the plane, scaled to a mean variance of 1."""
    density = (1.0 / length_mm**2 + frequency2) ** -1.5
    return np.asarray(density / density.sum())


def whitening(gram: FloatArray, frequency2: FloatArray, *, length_mm: float) -> Whitening:
    """Prepare the noise field of one length.

    Parameters
    ----------
    gram : (k, k) array
        ``Phi' D^-1 Phi``, see `gram_of_cosines`.
    frequency2 : (k,) array of 1/mm^2
    """
    root = np.sqrt(spectrum(frequency2, length_mm))
    values, vectors = np.linalg.eigh(root[:, None] * gram * root)
    keep = values > 1e-9 * values[-1]
    return Whitening(length_mm, root[:, None] * vectors[:, keep], values[keep])
