r"""Correlated errors of a map: a Gaussian field of few cosines plus independent errors, whitened once for many fits.

The error of cell i is :math:`\tau\,(\epsilon_i + \sqrt{\rho}\, f(x_i))` with independent
:math:`\epsilon_i \sim N(0, D_i)` and a field f of unit variance and exponential correlation (Matern 1/2) of length l.
The field is written in cosines on a rectangle around the window, each with the variance that the spectrum gives it. So
a covariance is diagonal plus low rank, and every share :math:`\rho` comes from one eigen-decomposition a length.

References
----------
Solin & Saerkkae (2020), Statistics and Computing 30:419 (the basis); Rasmussen & Williams (2006), ch. 4 (the spectrum).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.geometry import FloatArray

COSINES = 18
MARGIN = 1.3
"""Width of the rectangle in widths of the window: the field need not be flat where the window ends."""
LENGTHS_MM = (1.5, 3.0, 6.0, 12.0)
SHARES = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Variances of the field tried, over the mean independent variance of a cell."""
TOUCHED = 1e-2
"""Directions in which the field's variance is a smaller part of the independent one are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """One length's field, ready for every share.

    Parameters
    ----------
    length_mm
        Correlation length.
    rotated : (n, k) array
        Basis turned so that the field's precision is diagonal: ``D^-1 Phi S^1/2 Q``.
    eigenvalues : (k,) array
        Of ``S^1/2 Phi' D^-1 Phi S^1/2``.
    """

    length_mm: float
    rotated: FloatArray
    eigenvalues: FloatArray

    def shrinkage(self, share: float | FloatArray) -> FloatArray:
        """(..., k) weights of the squared projections that the field takes away: ``rho / (1 + rho lambda)``."""
        rho = np.asarray(share)[..., None]
        return np.asarray(rho / (1.0 + rho * self.eigenvalues))

    def pruned(self, share: float) -> Whitening:
        """Without the directions that the field hardly touches at this share or a smaller one."""
        keep = share * self.eigenvalues > TOUCHED
        return Whitening(self.length_mm, np.ascontiguousarray(self.rotated[:, keep]), self.eigenvalues[keep])

    def log_determinant(self, share: float | FloatArray) -> FloatArray:
        """(...) log determinant of the covariance over that of D."""
        return np.asarray(np.log1p(np.asarray(share)[..., None] * self.eigenvalues).sum(axis=-1))


def cosine_basis(x_mm: FloatArray, y_mm: FloatArray, *, cosines: int = COSINES) -> tuple[FloatArray, FloatArray]:
    """Cosines on a rectangle around points, and their squared angular frequencies.

    Returns
    -------
    basis : (n, cosines^2) array
        Orthonormal on the rectangle, scaled so that equal coefficients give equal mean squares.
    frequency2 : (cosines^2,) array of 1/mm^2
    """
    columns, squares = [], []
    for values in (x_mm, y_mm):
        middle = 0.5 * (values.max() + values.min())
        side = MARGIN * max(float(np.ptp(values)), 1e-6)
        phase = (values - middle) / side + 0.5
        order = np.arange(cosines)
        one = np.cos(np.pi * order * phase[:, None])
        one[:, 1:] *= np.sqrt(2.0)
        columns.append(one)
        squares.append((np.pi * order / side) ** 2)
    basis = columns[0][:, :, None] * columns[1][:, None, :]
    return basis.reshape(len(x_mm), -1), (squares[0][:, None] + squares[1][None, :]).ravel()


def spectrum(frequency2: FloatArray, length_mm: float) -> FloatArray:
    """(k,) variances of the cosines for an exponential correlation in the plane, scaled to a mean variance of 1."""
    density = (1.0 / length_mm**2 + frequency2) ** -1.5
    return np.asarray(density / density.sum())


def whitenings(
    x_mm: FloatArray, y_mm: FloatArray, *, variance: FloatArray, lengths_mm: tuple[float, ...] = LENGTHS_MM
) -> list[Whitening]:
    """Prepare the fields of several lengths on one set of cells.

    Parameters
    ----------
    x_mm, y_mm : (n,) arrays
    variance : (n,) array
        Independent variance of each cell, up to the common factor tau^2.
    """
    basis, frequency2 = cosine_basis(x_mm, y_mm)
    scaled = basis / variance[:, None]
    gram = basis.T @ scaled
    found = []
    for length in lengths_mm:
        root = np.sqrt(spectrum(frequency2, length))
        values, vectors = np.linalg.eigh(root[:, None] * gram * root)
        keep = values > 1e-9 * values[-1]
        rotated = scaled @ (root[:, None] * vectors[:, keep])
        found.append(Whitening(length, rotated, values[keep]))
    return found
