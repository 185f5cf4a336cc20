"""The linear part of the model: basis and algebra."""

from __future__ import annotations

from math import lgamma, log, pi

import numpy as np

from tactile_bayes.declarations import Record, names_of
from tactile_bayes.geometry import FloatArray, IndexArray
from tactile_bayes.posterior.field import Profiles, Projected, Whitening, Window

# --- Solutions for the linear parameters (amplitudes, level, tilt) given the shape, for many shapes and noise fields.

FLOOR = 1e-9
"""Share of the data's sum of squares that is noise in any case: 3e-5 of the signal, less than any sensor's steps.
Without it a map free of noise leaves differences of large sums, which are rounding."""

LEAST_POWER = 1e-9
"""Power of a template, over what the prior on its amplitude is worth: less tells nothing and would only overflow."""


class LinearSolution(Record, eq=False):
    """Conditional posterior of the linear parameters for m shapes and h fields: a multivariate t."""

    amplitude: FloatArray
    """(m, h, v) array: Conditional means under a flat prior."""
    power: FloatArray
    """(m, h, v, v) array: Their precision times tau^2."""
    level: FloatArray
    level_covariance: FloatArray
    """`level`, `level_covariance` (h, c), (h, c, c) arrays: Level and tilt at amplitudes of 0, and their covariance
    over tau^2 given the amplitudes.
    """
    level_slope: FloatArray
    """(m, h, v, c) array: By how much level and tilt fall as an amplitude rises."""
    sum_of_squares: FloatArray
    """(m, h) array."""


class FieldColumns(Record, eq=False):
    """Fixed columns and data under the noise fields of one length: the part that does not depend on the shape."""

    field: Whitening
    """The length."""
    shares: FloatArray
    """(h,) array."""
    log_prior: float
    """Log prior probability of each share."""
    weight: FloatArray
    """(k, h) array: Of the squared projections that the field takes away, a column a share."""
    plain: FloatArray
    """(k, h * (c + 1)) array: Projections of the fixed columns and the data, so weighted."""
    gram: FloatArray
    """(h, c + 1, c + 1) array: Columns and data with each other."""
    inverse: FloatArray
    """(h, c, c) array: Of the columns' part."""
    log_det: FloatArray
    """(h,) array: Log determinant of the covariance (over that of D) and of the columns' part."""
    floor: float
    """Sum of squares that is noise in any case."""

    @classmethod
    def of(
        cls, field: Whitening, shares: FloatArray, *, log_prior: float, plain_low: FloatArray, plain_gram: FloatArray
    ) -> FieldColumns:
        """Prepare from (c + 1, cosines^2) projections and (c + 1, c + 1) products of the fixed columns and the data."""
        low = plain_low @ field.turn
        weight = field.shrinkage(shares)
        weighted = low * weight[:, None, :]
        gram = plain_gram - weighted @ low.T
        c = len(plain_gram) - 1
        inverse: FloatArray = np.asarray(np.linalg.inv(gram[:, :c, :c]), dtype=np.float64)
        volume: FloatArray = np.asarray(np.linalg.slogdet(gram[:, :c, :c])[1], dtype=np.float64)
        plain = np.ascontiguousarray(weighted.reshape(len(shares) * (c + 1), low.shape[1]).T)
        log_det = field.log_determinant(shares) + volume
        floor = FLOOR * float(plain_gram[c, c]) + 1e-300
        return cls(field, shares, log_prior, np.ascontiguousarray(weight.T), plain, gram, inverse, log_det, floor)

    def rest(self) -> FloatArray:
        """(h,) residual sum of squares of the fixed columns alone."""
        c = self.inverse.shape[1]
        right = self.gram[:, :c, c]
        return np.asarray(self.gram[:, c, c] - np.einsum("hc,hcd,hd->h", right, self.inverse, right))

    def null_evidence(self, *, dof: int) -> FloatArray:
        """(h,) log prior plus log evidence of the fixed columns alone."""
        squares = np.maximum(self.rest(), 0.0) + self.floor
        return self.log_prior - 0.5 * self.log_det + lgamma(dof / 2) - 0.5 * dof * np.log(pi * squares)


class Inner(Record, eq=False):
    """Inner products of m templates under the noise fields of one length with h shares."""

    plain: FloatArray
    """(m, h, c + 1) array: With the fixed columns and the data."""
    square: FloatArray
    """(m, h) array: With themselves."""
    low: FloatArray
    """(m, k) array: Projections on the field's directions; none where templates are never held against others."""

    @classmethod
    def of(cls, projected: Projected, columns: FieldColumns) -> Inner:
        """Inner products from those without a field."""
        low = projected.low @ columns.field.turn
        taken = (low @ columns.plain).reshape(len(low), len(columns.shares), -1)
        return cls(projected.plain[:, None, :] - taken, projected.square[:, None] - low**2 @ columns.weight, low)

    def repeated(self, number: int) -> Inner:
        """Each template's inner products, repeated."""
        return Inner(*(np.repeat(one, number, axis=0) for one in (self.plain, self.square, self.low)))

    def product(self, other: Inner, product: FloatArray, columns: FieldColumns) -> FloatArray:
        """(m, h) inner products with other templates, from their (m,) products without the field."""
        return np.asarray(product[:, None] - (self.low * other.low) @ columns.weight)


def solve(
    inner: list[Inner], cross: FloatArray | None, columns: FieldColumns, *, dof: int, amplitude_sd: float
) -> tuple[FloatArray, LinearSolution]:
    """Log of the fields' prior times evidence (m, h), and solutions for one or two structures, under one length.

    `inner` holds the inner products of each structure's (m,) templates and `cross`, (m, h), those of one with the
    other; `dof` is cells minus linear parameters, `amplitude_sd` that of the normal prior on each amplitude.
    """
    c = columns.inverse.shape[1]
    plain = [one.plain for one in inner]
    to_level = [np.matmul(one[:, :, None, :c], columns.inverse)[:, :, 0] for one in plain]
    right = columns.gram[:, :c, c]
    along = [one[:, :, c] - np.sum(t * right, axis=2) for one, t in zip(plain, to_level, strict=True)]

    def power(i: int, j: int, product: FloatArray) -> FloatArray:
        return np.asarray(product - np.sum(to_level[i] * plain[j][:, :, :c], axis=2))

    rest, floor = columns.rest(), columns.floor
    # a template with hardly any weight in the window, beyond its rim or between its cells, leaves the prior unchanged
    least = LEAST_POWER * (np.maximum(rest, 0.0) + floor) / dof / amplitude_sd**2
    diagonal = [np.maximum(power(i, i, one.square), least) for i, one in enumerate(inner)]
    if cross is None:
        structures = _one(along[0], diagonal[0], rest, floor, dof=dof, amplitude_sd=amplitude_sd)
    else:
        structures = _two(along, diagonal, power(0, 1, cross), rest, floor, dof=dof, amplitude_sd=amplitude_sd)
    log_factor, amplitude, matrix, squares = structures
    constant = columns.log_prior - 0.5 * columns.log_det + lgamma(dof / 2) - 0.5 * dof * log(pi)
    evidence = constant + log_factor - 0.5 * dof * np.log(squares)
    # a dent is no lump: only rises have density
    evidence = np.where((amplitude > 0).all(axis=2), evidence, -np.inf)
    level = np.einsum("hcd,hd->hc", columns.inverse, right)
    slope = np.stack(to_level, axis=2)
    return evidence, LinearSolution(amplitude, matrix, level, columns.inverse, slope, squares)


def joined(solutions: list[LinearSolution]) -> LinearSolution:
    """Concatenate the fields of several lengths."""
    by_field = {"level", "level_covariance"}
    return LinearSolution(
        *(
            np.concatenate([getattr(one, name) for one in solutions], axis=0 if name in by_field else 1)
            for name in names_of(LinearSolution)
        )
    )


def _one(
    along: FloatArray, power: FloatArray, rest: FloatArray, floor: float, *, dof: int, amplitude_sd: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log factor, amplitudes, precision and sum of squares for one structure."""
    amplitude = along / power
    squares = np.maximum(rest - along * amplitude, 0.0) + floor
    variance = amplitude_sd**2 + squares / dof / power
    log_factor = -0.5 * (np.log(power) + np.log(2 * pi * variance) + (amplitude / np.sqrt(variance)) ** 2)
    return log_factor, amplitude[..., None], power[..., None, None], squares


def _two(
    along: list[FloatArray],
    diagonal: list[FloatArray],
    off: FloatArray,
    rest: FloatArray,
    floor: float,
    *,
    dof: int,
    amplitude_sd: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """As `_one` for two structures, with the two by two matrices written out."""
    one, two = diagonal
    det = np.maximum(one * two - off**2, 1e-12 * one * two)
    first, second = (two * along[0] - off * along[1]) / det, (one * along[1] - off * along[0]) / det
    squares = np.maximum(rest - along[0] * first - along[1] * second, 0.0) + floor
    tau2 = squares / dof
    a, b, between = amplitude_sd**2 + tau2 * two / det, amplitude_sd**2 + tau2 * one / det, -tau2 * off / det
    volume = a * b - between**2
    square = (b * first**2 + a * second**2 - 2 * between * first * second) / volume
    log_factor = -0.5 * (np.log(det) + np.log((2 * pi) ** 2 * volume) + square)
    matrix = np.stack([np.stack([one, off], axis=-1), np.stack([off, two], axis=-1)], axis=-2)
    return log_factor, np.stack([first, second], axis=-1), matrix, squares


# --- Low-rank basis shared by many bumps, for fast inner products.
#
# Points about one mode have nearly the same bump. Along each axis their profiles are sums of about ten, told by a
# singular value decomposition of the points' own, and every bump is a sum of products of two. What a posterior
# needs of a bump is linear or quadratic in it: it is worked out once for the products that span, and for a point
# only its coefficients are left.

DROPPED = 1e-8
"""Norm of what is dropped of all the bumps together, over that of the least of them."""
LEAST_BUMPS = 256
"""Fewer have no basis that pays."""
MOST_PRODUCTS = 200
"""More cost as much as each bump by itself."""


class Spanned:
    """Bumps along the grid's axes in a shared basis: sums of products of two profiles.

    The (m, r) coefficients have a row per bump; `products` are inner products of the r templates that span them, the
    (r, r) `gram` those with each other.
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


def _kept(size: FloatArray, least: float) -> tuple[IndexArray, IndexArray]:
    """Rows and columns kept of (ry, rx) squared norms; the dropped ones sum to `DROPPED` at most."""
    order = np.argsort(size, axis=None)
    kept = order[np.sqrt(np.cumsum(size.ravel()[order])) > DROPPED * least]
    return kept // size.shape[1], kept % size.shape[1]
