r"""Low-rank basis shared by many bumps, for fast inner products.

Points about one mode have nearly the same bump. Along each axis their profiles are sums of about ten, told by a
singular value decomposition of the points' own, and every bump is a sum of products of two. What a posterior needs of a
bump is linear or quadratic in it: it is worked out once for the products that span, and for a point only its
coefficients are left.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.linear import FieldColumns, Inner
from tactile_bayes.posterior.correlated.window import Profiles, Projected, Window

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
DROPPED = 1e-8
"""Norm of what is dropped of all the bumps together, over that of the least of them."""
LEAST_BUMPS = 256
"""Fewer have no basis that pays."""
MOST_PRODUCTS = 200
"""More cost as much as each bump by itself."""


class Spanned:
    """Bumps along the grid's axes in a shared basis: sums of products of two profiles.

    Parameters
    ----------
    coefficients : (m, r) array
        A row a bump.
    products
        Inner products of the r templates that span them.
    gram : (r, r) array
        Those with each other.
    """

    def __init__(self, coefficients: FloatArray, products: Projected, gram: FloatArray) -> None:
        self._coefficients, self._products, self._gram = coefficients, products, gram

    @classmethod
    def of(cls, bumps: Profiles, window: Window, weighted_plain: FloatArray) -> Spanned | None:
        """Find the basis for products of profiles; None where it would not save time."""
        rows, columns = bumps.rows, bumps.columns
        assert rows is not None
        assert columns is not None
        if not (np.isfinite(rows).all() and np.isfinite(columns).all()):
            return None
        high, wide = _norms(rows), _norms(columns)
        along, across = _basis(rows, high.min()), _basis(columns, wide.min())
        by_row, by_column = rows @ along.T, columns @ across.T
        size = np.square(by_row).T @ np.square(by_column)
        i, j = _kept(size, (high * wide).min())
        if not 0 < len(i) <= MOST_PRODUCTS:
            return None
        products = window.project(Profiles(along[i], across[j]), weighted_plain)
        return cls(by_row[:, i] * by_column[:, j], products, _gram(window, along, across)[i[:, None], i, j[:, None], j])

    def inner(self, columns: FieldColumns) -> Inner:
        """Inner products under the noise fields of one length."""
        basis = Inner.of(self._products, columns)
        c = self._coefficients
        m, (r, h, plain) = len(c), basis.plain.shape
        shared = (basis.low[:, None, :] * columns.weight.T) @ basis.low.T
        power = self._gram - shared.transpose(1, 0, 2)
        square = np.stack([np.einsum("mr,mr->m", c @ one, c) for one in power], axis=1)
        return Inner((c @ basis.plain.reshape(r, -1)).reshape(m, h, plain), square, np.empty((m, 0)))


def _norms(profiles: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("mn,mn->m", profiles, profiles)))


def _basis(profiles: FloatArray, least: float) -> FloatArray:
    """(r, n) orthonormal profiles that span (m, n) ones."""
    _, size, basis = np.linalg.svd(np.linalg.qr(profiles, mode="r"), full_matrices=False)
    left = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1])
    return np.asarray(basis[left > DROPPED * least])


def _gram(window: Window, along: FloatArray, across: FloatArray) -> FloatArray:
    """(ry, ry, rx, rx) weighted inner products of pairs of profile products."""
    rows, columns = ((one[:, None] * one).reshape(len(one) ** 2, -1) for one in (along, across))
    return np.asarray(rows @ window.weight @ columns.T).reshape(len(along), len(along), len(across), len(across))


def _kept(size: FloatArray, least: float) -> tuple[IntArray, IntArray]:
    """Rows and columns kept of (ry, rx) squared norms; the dropped ones sum to `DROPPED` at most."""
    order = np.argsort(size, axis=None)
    kept = order[np.sqrt(np.cumsum(size.ravel()[order])) > DROPPED * least]
    return kept // size.shape[1], kept % size.shape[1]
