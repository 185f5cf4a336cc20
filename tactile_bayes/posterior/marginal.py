r"""Marginal posterior of the shape of a window's scene: amplitudes, level, tilt and noise integrated out.

For one noise field h (length and share) the map is linear in level, tilt and amplitudes given the places and widths.
With flat priors on level and tilt, a normal one of variance s^2 on each of v amplitudes and the Jeffreys prior on the
noise scale,

.. math::
    p(y \mid \theta, h) \propto |C_h|^{-1/2}\, |X^T C_h^{-1} X|^{-1/2}\, |P|^{-1/2}\,
        \Gamma(\nu/2)\,(\pi S)^{-\nu/2}\; N(\hat a;\, 0,\, s^2 + P^{-1} S / \nu), \qquad \nu = n - c - v,

X the c columns of level and tilt, P the amplitudes' precision and S the generalised least-squares sum of squares. Only
the last factor is approximate: the prior is taken at the mean noise scale. Fields are mixed with their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from math import lgamma, log, pi

import numpy as np

from tactile_bayes.declarations import Record, names_of
from tactile_bayes.geometry import FloatArray, IndexArray
from tactile_bayes.inference.draws import Solution, Solved, distinct_rows
from tactile_bayes.posterior.window import (
    LENGTHS_MM,
    SHARES,
    Problem,
    Profiles,
    Projected,
    Scene,
    Templates,
    Whitening,
    Window,
    linear_columns,
)

# --- Solutions for the linear parameters (amplitudes, level, tilt) given the shape, for many shapes and noise fields.

FLOOR = 1e-9
"""Share of the data's sum of squares that is noise in any case: 3e-5 of the signal, less than any sensor's steps.
Without it a map free of noise leaves differences of large sums, which are rounding."""

LEAST_POWER = 1e-9
"""Power of a template, over what the prior on its amplitude is worth: less tells nothing and would only overflow."""


class LinearSolution(Record, eq=False):
    """Conditional posterior of the linear parameters for m shapes and h fields: a multivariate t."""

    evidence: FloatArray  #: (m, h) array: Log of the fields' prior times their evidence.
    amplitude: FloatArray  #: (m, h, v) array: Conditional means under a flat prior.
    power: FloatArray  #: (m, h, v, v) array: Their precision times tau^2.
    level: FloatArray
    level_covariance: FloatArray
    """`level`, `level_covariance` (h, c), (h, c, c) arrays: Level and tilt at amplitudes of 0, and their covariance
    over tau^2 given the amplitudes."""
    level_slope: FloatArray  #: (m, h, v, c) array: By how much level and tilt fall as an amplitude rises.
    sum_of_squares: FloatArray  #: (m, h) array.


class FieldColumns(Record, eq=False):
    """Fixed columns and data under the noise fields of one length: the part that does not depend on the shape."""

    field: Whitening  #: The length.
    shares: FloatArray  #: (h,) array.
    log_prior: float  #: Log prior probability of each share.
    weight: FloatArray
    """(k, h) array: Of the squared projections that the field takes away, ``rho / (1 + rho lambda)``; a column a share.
    """
    plain: FloatArray  #: (k, h * (c + 1)) array: Projections of the fixed columns and the data, so weighted.
    gram: FloatArray  #: (h, c + 1, c + 1) array: Columns and data with each other.
    inverse: FloatArray  #: (h, c, c) array: Of the columns' part.
    log_det: FloatArray  #: (h,) array: Log determinant of the covariance (over that of D) and of the columns' part.
    floor: float  #: Sum of squares that is noise in any case.

    @classmethod
    def of(
        cls, field: Whitening, shares: FloatArray, *, log_prior: float, plain_low: FloatArray, plain_gram: FloatArray
    ) -> FieldColumns:
        """Prepare from (c + 1, cosines^2) projections and (c + 1, c + 1) products of the fixed columns and the data."""
        low, power = plain_low @ field.turn, shares[:, None] * field.eigenvalues
        weight = shares[:, None] / (1.0 + power)
        weighted = low * weight[:, None, :]
        gram = plain_gram - weighted @ low.T
        c = len(plain_gram) - 1
        inverse: FloatArray = np.asarray(np.linalg.inv(gram[:, :c, :c]), dtype=np.float64)
        volume: FloatArray = np.asarray(np.linalg.slogdet(gram[:, :c, :c])[1], dtype=np.float64)
        plain = np.ascontiguousarray(weighted.reshape(len(shares) * (c + 1), low.shape[1]).T)
        log_det = np.log1p(power).sum(axis=-1) + volume
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

    plain: FloatArray  #: (m, h, c + 1) array: With the fixed columns and the data.
    square: FloatArray  #: (m, h) array: With themselves.
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
) -> LinearSolution:
    """Solutions for one or two structures, under one length.

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
    return LinearSolution(evidence, amplitude, matrix, level, columns.inverse, slope, squares)


_FIELD_AXIS = {name: int(not name.startswith("level") or name == "level_slope") for name in names_of(LinearSolution)}


def joined(solutions: list[LinearSolution]) -> LinearSolution:
    """Concatenate the fields of several lengths."""
    return LinearSolution(
        *(np.concatenate([getattr(one, name) for one in solutions], axis=axis) for name, axis in _FIELD_AXIS.items())
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

DROPPED = 1e-8  #: Norm of what is dropped of all the bumps together, over that of the least of them.
LEAST_BUMPS = 256  #: Fewer have no basis that pays.
MOST_PRODUCTS = 200  #: More cost as much as each bump by itself.


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


# --- The marginal posterior of a scene under all noise fields.

BLOCK = 128  #: Shapes solved at a time: fewer spend their time on calls, more leave the processor's cache.
NEGLIGIBLE = 1e-3
"""Fields with a smaller share of the evidence are left out of the mixture; what they add at the mode is made up for.
Once a length has as little, and less than the one before it, shorter ones are not looked at."""
SPANNED = 2048  #: As many share a basis where they can, see `Spanned`.


class CollapsedTarget:
    """Log density of a scene's shape parameters (see `Scene`) for one window, mixed over noise fields."""

    def __init__(self, problem: Problem, scene: Scene) -> None:
        self.problem, self.scene = problem, scene
        self.window = window = problem.window
        self.amplitude_sd = problem.prior.amplitude_sd * problem.amplitude_scale
        # without its mean, a large level does not cost the digits that the bump is in
        self._mean = float(np.mean(window.cells.value))
        centred = window.cells.value - self._mean
        fixed = [linear_columns(window.cells, tilt=scene.tilt)]
        fixed += [] if problem.departure is None else [problem.departure]
        self._plain = np.concatenate([*fixed, centred[None]])
        scaled = self._plain / window.variance
        self._weighted_plain = window.on_grid(scaled)
        self._plain_gram = self._plain @ scaled.T
        self._plain_low = window.project(window.on_grid(self._plain), self._weighted_plain).low
        self._lengths: dict[float, FieldColumns] = {}
        self._fields: list[FieldColumns] | None = None
        self._made_up = 0.0

    def of_scene(self, scene: Scene) -> CollapsedTarget:
        """Copy for another scene in the same window with the same priors; its fields are not settled."""
        if scene.tilt == self.scene.tilt:
            other = copy(self)
            other.scene, other._fields, other._made_up = scene, None, 0.0
            return other
        return CollapsedTarget(self.problem, scene)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the noise scale."""
        return max(len(self._plain[0]) - len(self._plain) - bool(self.scene.extra), 1)

    @property
    def fields(self) -> list[FieldColumns]:
        """Noise fields of the mixture by length, each with its shares; all of them until settled."""
        if self._fields is None:
            self._fields = list(self._from_the_longest())
        return self._fields

    def __call__(self, theta: FloatArray, solved: Solved | None = None) -> FloatArray:
        """(m,) log density of (m, dimension) shape vectors, normalised up to a constant of the data.

        `solved` keeps what `draw_linear` needs at these points.
        """
        if solved is None:
            return self._mixed(theta, self.by_field(theta))
        solution = self.conditional(theta)
        solved.add(theta, solution)
        return self._mixed(theta, solution[0] + self._made_up)

    def _mixed(self, theta: FloatArray, by_field: FloatArray) -> FloatArray:
        total = np.logaddexp.reduce(by_field, axis=1) + self.scene.log_prior(theta, self.problem)
        return np.where(np.isfinite(total), total, -np.inf)

    def by_field(self, theta: FloatArray) -> FloatArray:
        """(m, fields) log of each field's prior times its evidence, without the shape's prior."""
        parts = [np.concatenate([one.evidence for one in part], axis=1) for part in self._parts(theta)]
        return np.concatenate(parts) + self._made_up

    def settle_fields(self, theta: FloatArray) -> bool:
        """Keep only the noise fields with evidence at one shape; the others cost time and add nothing. True if that
        changed."""
        before = self.chosen_fields()
        projected, cross = self._projected(theta[None])
        walked = self._walk(lambda columns: self._under(projected, cross, columns).evidence[0])
        evidence = np.concatenate([one for _, one in walked])
        if not np.isfinite(evidence.max()):
            self._fields, self._made_up = None, 0.0
            return before != self.chosen_fields()
        total = float(np.logaddexp.reduce(evidence))
        kept = [(columns, one > total + np.log(NEGLIGIBLE)) for columns, one in walked]
        self._fields = [
            self._columns(columns.field.pruned(float(columns.shares[keep].max())), columns.shares[keep])
            for columns, keep in kept
            if keep.any()
        ]
        left = np.concatenate([self._under(projected, cross, columns).evidence[0] for columns in self._fields])
        self._made_up = total - float(np.logaddexp.reduce(left))
        return before != self.chosen_fields()

    def settle_lengths(self) -> None:
        """Keep only the lengths with evidence where there is no structure, each with all its shares."""
        walked, total = self._walk_without_structure()
        self._fields = [columns for columns, one in walked if one.max() > total + np.log(NEGLIGIBLE)]
        self._made_up = 0.0

    def chosen_fields(self) -> list[tuple[float, tuple[float, ...]]]:
        """Correlation lengths in the mixture, each with its shares."""
        return [(columns.field.length_mm, tuple(columns.shares)) for columns in self._fields or ()]

    def null_log_evidence(self) -> float:
        """Log evidence of level and tilt alone under all fields, on the scale of the log density."""
        return self._walk_without_structure()[1]

    def _walk_without_structure(self) -> tuple[list[tuple[FieldColumns, FloatArray]], float]:
        """As `_walk`, of level and tilt alone, with the whole of the log evidence."""
        dof = max(len(self._plain[0]) - len(self._plain) + 1, 1)
        walked = self._walk(lambda columns: columns.null_evidence(dof=dof))
        return walked, float(np.logaddexp.reduce(np.concatenate([one for _, one in walked])))

    def _walk(self, evidence: Callable[[FieldColumns], FloatArray]) -> list[tuple[FieldColumns, FloatArray]]:
        """Evidence without a field, then from the longest length down, until it has vanished."""
        walked: list[tuple[FieldColumns, FloatArray]] = []
        best = before = -np.inf
        for columns in self._from_the_longest():
            one = evidence(columns)
            walked.append((columns, one))
            if one.max() < min(before, best + np.log(NEGLIGIBLE)):
                break
            best = max(best, float(one.max()))
            before = float(one.max()) if columns.shares[0] > 0 else -np.inf
        return walked

    def _from_the_longest(self) -> Iterator[FieldColumns]:
        """No field, then each length with all shares, computed when reached."""
        shares = np.array(SHARES)
        for length in (0.0, *sorted(LENGTHS_MM, reverse=True)):
            chosen = shares[(shares > 0) == (length > 0)]
            if not len(chosen):
                continue
            if length not in self._lengths:
                cosines = self.window.cosines**2  # a share of 0, the same for every length, has no directions
                none = Whitening(float(np.mean(LENGTHS_MM)), np.zeros((cosines, 0)), np.zeros(0))
                self._lengths[length] = self._columns(self.window.field(length) if length else none, chosen)
            yield self._lengths[length]

    def field_summary(self, theta: FloatArray) -> dict[str, float]:
        """Evidence-weighted correlation length (mm) and share of a cell's error variance in the field, at one shape."""
        weight = self.field_weights(theta)
        length = np.concatenate([np.full(len(one.shares), one.field.length_mm) for one in self.fields])
        share = np.concatenate([one.shares for one in self.fields])
        return {"field_length_mm": float(weight @ length), "field_share": float(weight @ (share / (1.0 + share)))}

    def conditional(self, theta: FloatArray) -> Solution:
        """Linear solutions at (m, p) vectors under each of h fields.

        Log of prior times evidence (m, h), and of `LinearSolution` the amplitudes (m, h, v), their power (m, h, v, v),
        by how much the level falls with each (m, h, v), and the sum of squares (m, h).
        """
        parts = []
        for one in map(joined, self._parts(theta)):
            parts.append((one.evidence, one.amplitude, one.power, one.level_slope[..., 0], one.sum_of_squares))
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))

    def draw_linear(
        self, theta: FloatArray, rng: np.random.Generator, *, solved: Solved | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Draw amplitudes (m, v), level (m,) and noise scale (m,) given the shape: exact, field first.

        Points that `solved` knows are not solved again.
        """
        unique, back = distinct_rows(theta)
        evidence, centre, power, slope, squares = (solved or self.conditional)(unique)
        c = len(self._plain) - 1
        at_zero = np.concatenate([np.einsum("hd,hd->h", one.inverse[:, 0], one.gram[:, :c, c]) for one in self.fields])
        level_variance = np.concatenate([one.inverse[:, 0, 0] for one in self.fields])
        h = choose(evidence[back], rng)
        tau2 = squares[back, h] / rng.chisquare(self.dof, size=len(theta))
        amplitude = self._draw_amplitudes(centre[back, h], power[back, h], tau2, rng)
        about = np.sqrt(tau2 * level_variance[h]) * rng.standard_normal(len(theta))
        level = (self._mean + at_zero)[h] - np.sum(slope[back, h] * amplitude, axis=1) + about
        return amplitude, level, np.sqrt(tau2 * self.window.variance.mean())

    def _draw_amplitudes(
        self, centre: FloatArray, power: FloatArray, tau2: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """(m, v) draws given the noise scale: the normal under a flat prior times the amplitudes' prior."""
        data = power / tau2[:, None, None]
        normal = rng.standard_normal((*centre.shape, 1))
        if len(data[0]) == 1:
            precision = data[:, 0] + 1.0 / self.amplitude_sd**2
            return np.asarray(data[:, 0] * centre / precision + normal[:, 0] / np.sqrt(precision))
        covariance = np.linalg.inv(data + np.eye(2) / self.amplitude_sd**2)
        mean = (covariance @ (data @ centre[..., None]))[..., 0]
        return np.asarray(mean + (np.linalg.cholesky(covariance) @ normal)[..., 0])

    def tilt_log_odds(self, theta: FloatArray) -> float:
        """Log Bayes factor of a slope against none at one shape: the Savage-Dickey ratio of its components at 0."""
        solution = self._solve(theta[None])
        weight = solution.evidence[0] - np.logaddexp.reduce(solution.evidence[0])
        slope = solution.level_slope[0][:, :, 1:3]
        mean = solution.level[:, 1:3] - np.einsum("hv,hvc->hc", solution.amplitude[0], slope)
        spread = np.einsum("hvc,hvw,hwd->hcd", slope, np.linalg.inv(solution.power[0]), slope)
        tau2 = solution.sum_of_squares[0] / self.dof
        covariance = tau2[:, None, None] * (solution.level_covariance[:, 1:3, 1:3] + spread)
        square = np.einsum("hc,hcd,hd->h", mean, np.linalg.inv(covariance), mean)
        at_zero = -0.5 * (square + np.linalg.slogdet(covariance)[1]) - np.log(2.0 * np.pi)
        prior = -np.log(2.0 * np.pi * (self.problem.prior.tilt_sd * self.problem.amplitude_scale) ** 2)
        return float(prior - np.logaddexp.reduce(weight + at_zero))

    def amplitude_at(self, theta: FloatArray) -> float:
        """Posterior mean of the bump's amplitude at one shape."""
        solution = self._solve(theta[None])
        weight = np.exp(solution.evidence[0] - np.logaddexp.reduce(solution.evidence[0]))
        return float(weight @ solution.amplitude[0, :, 0])

    def products(self, one: FloatArray, other: FloatArray, theta: FloatArray) -> FloatArray:
        """(v, w) inner products of (v, n) and (w, n) cell values under the noise field likeliest at one shape."""
        return np.asarray(self.products_by_field(one, other)[int(np.argmax(self.by_field(theta[None])[0]))])

    def products_by_field(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(h, v, w) inner products of (v, n) and (w, n) cell values under each noise field."""
        low = [self.window.project(self.window.on_grid(vectors), self._weighted_plain).low for vectors in (one, other)]
        independent, products = (one / self.window.variance) @ other.T, []
        for columns in self.fields:
            first, second = (vectors @ columns.field.turn for vectors in low)
            products += [independent - (first * weight) @ second.T for weight in columns.weight.T]
        return np.stack(products)

    def field_weights(self, theta: FloatArray) -> FloatArray:
        """(h,) posterior probability of each noise field at one shape."""
        evidence = self.by_field(theta[None])[0]
        return np.asarray(np.exp(evidence - np.logaddexp.reduce(evidence)))

    def gains(self, templates: Templates, theta: FloatArray) -> FloatArray:
        """(m,) log evidence gained at `theta` by adding each template; -inf for a dent.

        Fields are those settled; the scene has one structure.
        """
        (bump,) = self.scene.templates(theta[None], self.window)
        alone, beside = (self.window.project(one, self._weighted_plain) for one in (bump, templates))
        product = self.window.product(bump, templates)
        base, with_it = [], []
        for columns in self.fields:
            one, other = Inner.of(alone, columns), Inner.of(beside, columns)
            base.append(self._found([one], None, columns).evidence[0])
            cross = one.product(other, product, columns)
            both = [one.repeated(len(product)), other]
            with_it.append(solve(both, cross, columns, dof=self.dof - 1, amplitude_sd=self.amplitude_sd).evidence)
        gained = np.logaddexp.reduce(np.concatenate(with_it, axis=1), axis=1)
        return np.asarray(gained - np.logaddexp.reduce(np.concatenate(base)))

    def _columns(self, field: Whitening, shares: FloatArray) -> FieldColumns:
        """Level, tilt and data under the fields of one length; without a field, all lengths are one."""
        log_prior = -float(np.log(len(LENGTHS_MM) * len(SHARES)))
        if not shares.any():
            log_prior += float(np.log(len(LENGTHS_MM)))
        return FieldColumns.of(
            field, shares, log_prior=log_prior, plain_low=self._plain_low, plain_gram=self._plain_gram
        )

    def _parts(self, theta: FloatArray) -> Iterator[list[LinearSolution]]:
        """Blocks of (m, p) vectors, each solved under every length; large where they share a basis."""
        size = SPANNED if len(theta) >= LEAST_BUMPS and self.scene.separable else BLOCK
        for i in range(0, len(theta), size):
            points = theta[i : i + size]
            if len(points) >= LEAST_BUMPS and (spanned := self._spanned(points)) is not None:
                yield [self._found([spanned.inner(columns)], None, columns) for columns in self.fields]
                continue
            for j in range(0, len(points), BLOCK):
                projected, cross = self._projected(points[j : j + BLOCK])
                yield [self._under(projected, cross, columns) for columns in self.fields]

    def _projected(self, theta: FloatArray) -> tuple[list[Projected], FloatArray | None]:
        """Inner products of each structure's templates at (m, p) vectors, and of two structures with each other."""
        return self.window.projected(self.scene.templates(theta, self.window), self._weighted_plain)

    def _spanned(self, theta: FloatArray) -> Spanned | None:
        """Basis shared by the bumps of a separable scene; None where there is none, or where it does not save time."""
        (bumps,) = self.scene.templates(theta, self.window)
        assert isinstance(bumps, Profiles)
        return Spanned.of(bumps, self.window, self._weighted_plain)

    def _under(self, projected: list[Projected], cross: FloatArray | None, columns: FieldColumns) -> LinearSolution:
        inner = [Inner.of(one, columns) for one in projected]
        return self._found(inner, None if cross is None else inner[0].product(inner[1], cross, columns), columns)

    def _found(self, inner: list[Inner], cross: FloatArray | None, columns: FieldColumns) -> LinearSolution:
        return solve(inner, cross, columns, dof=self.dof, amplitude_sd=self.amplitude_sd)

    def _solve(self, theta: FloatArray) -> LinearSolution:
        """Solutions under all fields at a few vectors."""
        (solutions,) = self._parts(theta)
        return joined(solutions)


def choose(evidence: FloatArray, rng: np.random.Generator) -> IndexArray:
    """(m,) random field for each draw by its share of the evidence; the first where a draw has none."""
    best = evidence.max(axis=1, keepdims=True)
    weight = np.exp(evidence - np.where(np.isfinite(best), best, 0.0))
    edges = np.cumsum(weight, axis=1)
    uniform = rng.uniform(size=len(evidence)) * edges[:, -1]
    return np.asarray((edges < uniform[:, None]).sum(axis=1))
