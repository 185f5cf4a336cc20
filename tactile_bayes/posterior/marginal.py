"""Scenes of a fit window, and the marginal posterior of their shape with all linear parameters integrated out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Final, Literal

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.inference.draws import Solution, SolutionCache, distinct_rows
from tactile_bayes.posterior.bump import log_normal_density
from tactile_bayes.posterior.window import (
    FieldColumns,
    Inner,
    LinearModel,
    LinearSolution,
    Problem,
    Profiles,
    Projected,
    Templates,
    Window,
    concatenated,
)

# --- Scenes: the structures that a fit window may hold, with their parameters and prior.
#
# A scene may have a ridge in the bump's place: the alternative that a lump is tested against.

Shape = Literal["round", "ellipse", "rotated", "ridge"]
Neighbour = Literal["second lump", "rib"]
Extra = Literal[Neighbour, ""]
REACH_IN_RADII = 1.5
"""Distance from the window's middle within which a second structure may lie: its flank shows from beyond the rim."""
APART = 2.0
"""Least distance of a second lump in widths: closer, two Gaussians have one maximum. A rib may run under the bump if it
is at most this many times as wide: a wider one is the curvature of the level."""
STEP = {
    "u": 0.06,
    "v": 0.06,
    "r": 0.06,
    "x": 0.3,
    "y": 0.3,
    "x2": 0.6,
    "y2": 0.6,
    "w2": 0.15,
    "angle": 0.08,
    "offset": 0.6,
    "along": 0.08,
    "across": 0.6,
}
"""Step of each parameter in the search for the mode: about one posterior SD."""

_BUMP_NAMES: Final[Mapping[Shape, tuple[str, ...]]] = {
    "round": ("u", "x", "y"),
    "ellipse": ("u", "v", "x", "y"),
    "rotated": ("u", "v", "x", "y", "r"),
    "ridge": ("u", "along", "across"),
}
_NEIGHBOUR_NAMES: Final[Mapping[Extra, tuple[str, ...]]] = {
    "": (),
    "second lump": ("x2", "y2", "w2"),
    "rib": ("angle", "offset", "w2"),
}


class Scene(Record, dict=True):
    """Structures in a model.

    The parameters are ``u, v, x, y`` (log widths of an unrotated bump, and its centre), without v for a round bump,
    with r for a rotated one; then ``x2, y2, w2`` (centre and log width of a second round lump) or ``angle, offset, w2``
    (a rib). A ridge in the bump's place has ``u, along, across``: log width, angle, offset.
    """

    shape: Shape = "ellipse"  #: Shape of the bump.
    tilt: bool = True  #: The level may slope.
    extra: Extra = ""  #: Structure beside the bump.

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the shape parameters, the most important first (see `importance`)."""
        return _BUMP_NAMES[self.shape] + _NEIGHBOUR_NAMES[self.extra]

    @cached_property
    def steps(self) -> FloatArray:
        """(p,) typical small step of each parameter."""
        return np.array([STEP[name] for name in self.names])

    @cached_property
    def bump_parameters(self) -> int:
        """Number of the bump's parameters, which are the first."""
        return len(_BUMP_NAMES[self.shape])

    def column(self, theta: FloatArray, name: str) -> FloatArray:
        """(...) values of one parameter of (..., p) vectors; of one that the scene lacks 0, but v is u."""
        if name in self.names:
            return np.asarray(theta[..., self.names.index(name)])
        return self.column(theta, "u") if name == "v" else np.zeros(theta.shape[:-1])

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r (see `covariance_from_log_widths`) of (..., p) vectors."""
        u, v = self.column(theta, "u"), self.column(theta, "v")
        return (u + v) / 2.0, (u - v) / 2.0, self.column(theta, "r")

    def converted(self, theta: FloatArray, other: Scene) -> FloatArray:
        """The vector of another scene: shared parameters keep their values, others are 0."""
        p, _, _ = self.widths(theta)
        values = {name: self.column(theta, name) for name in other.names}
        if other.shape == "round":
            values["u"] = p
        return np.array([values[name] for name in other.names])

    @property
    def separable(self) -> bool:
        """True for a lone bump along the grid's axes, which is a product of two profiles."""
        return self.shape in ("round", "ellipse") and not self.extra

    def templates(self, theta: FloatArray, window: Window) -> list[Templates]:
        """Templates of the bump, and of the second structure if there is one, for (m, p) vectors."""
        p, q, r = self.widths(theta)
        if self.shape == "ridge":
            along, across = self.column(theta, "along"), self.column(theta, "across")
            templates: list[Templates] = [window.ridges(along, across, log_width=p)]
        else:
            x, y = self.column(theta, "x"), self.column(theta, "y")
            templates = [window.bumps(x, y, p=p, q=q, r=r if self.shape == "rotated" else None)]
        if self.extra:
            beside = (self.column(theta, name) for name in _NEIGHBOUR_NAMES[self.extra])
            templates.append(neighbour_templates(window, self.extra, *beside))
        return templates

    def log_prior(self, theta: FloatArray, problem: Problem) -> FloatArray:
        """(m,) normalised log prior of the shape; -inf outside the window and where a bump is wider than it."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        p, q, r = self.widths(theta)
        ratio = np.hypot(q, r)
        if self.shape == "ridge":
            inside, volume = ridge_place(self.column(theta, "across"), radius_mm)
        else:
            x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
            inside, volume = np.hypot(x, y) <= radius_mm, np.pi * radius_mm**2
        inside = inside & (p + ratio <= np.log(problem.widest_mm))
        total = log_normal_density(p, np.log(prior.width_median_mm), prior.log_width_sd) - np.log(volume)
        if self.shape in ("ellipse", "rotated"):
            # q is half of u - v, p half of their sum: the volume of (u, v) is twice that of (p, q)
            total = total + log_normal_density(q, 0.0, prior.log_ratio_sd) - np.log(2.0)
        if self.shape == "rotated":
            total = total + log_normal_density(r, 0.0, prior.log_ratio_sd)
        if self.extra:
            beside, allowed = self._log_prior_beside(theta, problem)
            total, inside = total + beside, inside & allowed & (self.column(theta, "w2") <= np.log(problem.widest_mm))
        return np.where(inside, total, -np.inf)

    def _log_prior_beside(self, theta: FloatArray, problem: Problem) -> tuple[FloatArray, BoolArray]:
        """Log prior of the second structure without its amplitude's, and True where its place is allowed."""
        prior, middle, radius_mm = problem.prior, problem.window.middle, problem.radius_mm
        w, reach = self.column(theta, "w2"), REACH_IN_RADII * radius_mm
        total = log_normal_density(w, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.extra == "rib":
            allowed, volume = ridge_place(self.column(theta, "offset"), radius_mm)
            if self.shape != "ridge":
                allowed &= self.rib_apart(theta, middle)
            return total - np.log(volume), allowed
        x2, y2 = self.column(theta, "x2"), self.column(theta, "y2")
        allowed = np.hypot(x2 - middle[0], y2 - middle[1]) <= reach
        if self.shape != "ridge":
            away = np.hypot(x2 - self.column(theta, "x"), y2 - self.column(theta, "y"))
            p, _, _ = self.widths(theta)
            allowed &= away >= APART * np.exp(np.maximum(p, w))
        return total - np.log(np.pi * reach**2), allowed

    def rib_apart(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) True for a rib that is clear of the bump, or at most `APART` times as wide."""
        p, _, _ = self.widths(theta)
        return np.asarray(self.rib_clear(theta, middle) | (self.column(theta, "w2") - p <= np.log(APART)))

    def rib_clear(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) True for a rib at least `APART` widths, of it or the bump, from the bump's centre."""
        angle, (p, _, _) = self.column(theta, "angle"), self.widths(theta)
        x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
        away = np.abs(self.column(theta, "offset") - x * np.cos(angle) - y * np.sin(angle))
        return np.asarray(away >= APART * np.exp(np.maximum(p, self.column(theta, "w2"))))


def neighbour_templates(
    window: Window, extra: Neighbour, first: FloatArray, second: FloatArray, log_width: FloatArray
) -> Templates:
    """Templates of m second structures: lumps at ``x2, y2``, or ribs of ``angle, offset``, each an (m,) array."""
    if extra == "rib":
        return window.ridges(first, second, log_width=log_width)
    return window.bumps(first, second, p=log_width, q=np.zeros_like(log_width), r=None)


def ridge_place(offset: FloatArray, radius_mm: float) -> tuple[BoolArray, float]:
    """(m,) True for ridges that may lie this far from the window's middle, and the volume of angles and offsets."""
    reach = REACH_IN_RADII * radius_mm
    return np.abs(offset) <= reach, float(np.pi * 2.0 * reach)


# --- Low-rank basis shared by many bumps, for fast inner products.
#
# Points about one mode have nearly the same bump. Along each axis their profiles are sums of about ten, by a singular
# value decomposition, and each bump is a sum of products of two of these. The posterior needs linear and quadratic
# forms of the bump: they are computed once for the products, and combined by each point's coefficients.

DROPPED = 1e-8  #: Norm of all that is dropped from the bumps together, over that of the least bump.
LEAST_BUMPS = 256  #: For fewer bumps a basis saves no time.
MOST_PRODUCTS = 200  #: Of more products the basis costs as much as the bumps.


class LowRankBumps(Record, eq=False):
    """Bumps along the grid's axes in a shared basis: sums of products of two profiles."""

    coefficients: FloatArray  #: (m, r) array: A row per bump.
    products: Projected  #: Inner products of the r basis templates.
    gram: FloatArray  #: (r, r) array: Inner products of the basis templates with each other.
    linear: LinearModel

    @classmethod
    def of(cls, bumps: Profiles, linear: LinearModel) -> LowRankBumps | None:
        """Find the basis for products of profiles; None where it would not save time."""
        rows, columns = bumps.rows, bumps.columns
        if not (np.isfinite(rows).all() and np.isfinite(columns).all()):
            return None
        row_norm, column_norm = (np.sqrt(np.einsum("mn,mn->m", profiles, profiles)) for profiles in (rows, columns))
        along, across = _basis(rows, row_norm.min()), _basis(columns, column_norm.min())
        by_row, by_column = rows @ along.T, columns @ across.T
        power = np.square(by_row).T @ np.square(by_column)
        order = np.argsort(power, axis=None)  # what is dropped sums to `DROPPED` at most
        kept_pairs = order[np.sqrt(np.cumsum(power.ravel()[order])) > DROPPED * (row_norm * column_norm).min()]
        i, j = np.unravel_index(kept_pairs, power.shape)
        if not 0 < len(i) <= MOST_PRODUCTS:
            return None
        (products,), _ = linear.projected([Profiles(along[i], across[j])])
        by_pair = [(profiles[:, None] * profiles).reshape(len(profiles) ** 2, -1) for profiles in (along, across)]
        pair_gram = (by_pair[0] @ linear.window.weight @ by_pair[1].T).reshape(*[len(along)] * 2, *[len(across)] * 2)
        return cls(
            by_row[:, i] * by_column[:, j],
            products,
            pair_gram[i[:, None], i, j[:, None], j],
            linear,
        )

    def solution(self, fields: list[FieldColumns]) -> LinearSolution:
        """Solutions for the bumps under all noise fields."""
        solutions, c = [], self.coefficients
        for columns in fields:
            basis = Inner.of(self.products, columns)
            m, (r, h, plain) = len(c), basis.plain.shape
            shared = (basis.low[:, None, :] * columns.weight.T) @ basis.low.T
            power = self.gram - shared.transpose(1, 0, 2)
            square = np.stack([np.einsum("mr,mr->m", c @ one, c) for one in power], axis=1)
            inner = Inner((c @ basis.plain.reshape(r, -1)).reshape(m, h, plain), square, np.empty((m, 0)))
            solutions.append(self.linear.solve([inner], None, columns))
        return concatenated(solutions, axis=1)


def _basis(profiles: FloatArray, least: float) -> FloatArray:
    """(r, n) orthonormal basis of (m, n) profiles, but for `DROPPED`."""
    _, size, basis = np.linalg.svd(np.linalg.qr(profiles, mode="r"), full_matrices=False)
    left = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1])
    return np.asarray(basis[left > DROPPED * least])


# --- The marginal posterior of a scene under all noise fields.

BLOCK = 128  #: Shapes solved at a time: fewer spend their time on calls, more leave the processor's cache.
BASIS_BLOCK = 2048  #: Shapes that share a basis, see `LowRankBumps`.


class CollapsedTarget:
    """Log density of a scene's shape parameters (see `Scene`) for one window, mixed over noise fields."""

    def __init__(self, problem: Problem, scene: Scene, linear: LinearModel | None = None) -> None:
        self.problem, self.scene, self.window = problem, scene, problem.window
        self.linear = linear or LinearModel(problem, tilt=scene.tilt)
        self.amplitude_sd = self.linear.amplitude_sd
        self._fields: list[FieldColumns] | None = None
        self._left_out_evidence = 0.0

    def of_scene(self, scene: Scene) -> CollapsedTarget:
        """Target of another scene in the same window with the same priors, with all fields."""
        return CollapsedTarget(self.problem, scene, self.linear if scene.tilt == self.scene.tilt else None)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the noise scale."""
        return self.linear.dof(2 if self.scene.extra else 1)

    @property
    def fields(self) -> list[FieldColumns]:
        """Noise fields of the mixture by length, each with its shares; all of them until some are selected."""
        if self._fields is None:
            self._fields = list(self.linear.every_field())
        return self._fields

    def __call__(self, theta: FloatArray, solved: SolutionCache | None = None) -> FloatArray:
        """(m,) log density of (m, dimension) shape vectors, normalised up to a constant of the data.

        `solved` stores the solutions that `draw_linear` needs at these points.
        """
        if solved is None:
            by_field = self.by_field(theta)
        else:
            solution = self.conditional(theta)
            solved.add(theta, solution)
            by_field = solution[0] + self._left_out_evidence
        total = np.logaddexp.reduce(by_field, axis=1) + self.scene.log_prior(theta, self.problem)
        return np.where(np.isfinite(total), total, -np.inf)

    def by_field(self, theta: FloatArray) -> FloatArray:
        """(m, fields) log of each field's prior times its evidence, without the shape's prior."""
        return np.concatenate([one.evidence for one in self._solutions(theta)]) + self._left_out_evidence

    def select_fields(self, theta: FloatArray) -> bool:
        """Keep only the noise fields with evidence at one shape; True if others were kept before."""
        before = self.selected_fields()
        templates = self.scene.templates(theta[None], self.window)
        self._fields, self._left_out_evidence = self.linear.with_evidence(templates)
        return before != self.selected_fields()

    def select_lengths(self) -> None:
        """Keep only the lengths with evidence where there is no structure, each with all its shares."""
        self._fields, self._left_out_evidence = self.linear.without_structure()[0], 0.0

    def selected_fields(self) -> list[tuple[float, tuple[float, ...]]]:
        """Correlation lengths in the mixture, each with its shares."""
        return [(columns.field.length_mm, tuple(columns.shares)) for columns in self._fields or ()]

    def null_log_evidence(self) -> float:
        """Log evidence of level and tilt alone under all fields, on the scale of the log density."""
        return self.linear.without_structure()[1]

    def field_figures(self, theta: FloatArray) -> dict[str, float]:
        """Evidence-weighted correlation length (mm) and share of a cell's error variance in the field, at one shape."""
        weight = self.field_weights(theta)
        length = np.concatenate([np.full(len(field.shares), field.field.length_mm) for field in self.fields])
        share = np.concatenate([one.shares for one in self.fields])
        return {"field_length_mm": float(weight @ length), "field_share": float(weight @ (share / (1.0 + share)))}

    def conditional(self, theta: FloatArray) -> Solution:
        """Solutions at (m, p) vectors under each of h fields: log of prior times evidence (m, h), and amplitudes
        (m, h, v), their power (m, h, v, v), the level's fall with each (m, h, v) and the sum of squares (m, h)."""
        solution = concatenated(self._solutions(theta), axis=0)
        return solution._replace(level_slope=solution.level_slope[..., 0])

    def draw_linear(
        self, theta: FloatArray, rng: np.random.Generator, *, solve: Callable[[FloatArray], Solution]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Draw amplitudes (m, v), level (m,) and noise scale (m,) given the shape, exactly, after drawing the field;
        `solve` is `conditional`, or a cache of it."""
        unique, index = distinct_rows(theta)
        evidence, centre, power, slope, squares = solve(unique)
        at_zero = np.concatenate([field.level()[:, 0] for field in self.fields])
        level_variance = np.concatenate([one.inverse[:, 0, 0] for one in self.fields])
        h = choose_fields(evidence[index], rng)
        tau2 = squares[index, h] / rng.chisquare(self.dof, size=len(theta))
        amplitude = self._draw_amplitudes(centre[index, h], power[index, h], tau2, rng)
        level_noise = np.sqrt(tau2 * level_variance[h]) * rng.standard_normal(len(theta))
        level = (self.linear.mean + at_zero)[h] - np.sum(slope[index, h] * amplitude, axis=1) + level_noise
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
        (solution,) = self._solutions(theta[None])
        weight = solution.evidence[0] - np.logaddexp.reduce(solution.evidence[0])
        level = np.concatenate([one.level() for one in self.fields])
        inverse = np.concatenate([one.inverse for one in self.fields])
        slope = solution.level_slope[0][:, :, 1:3]
        mean = level[:, 1:3] - np.einsum("hv,hvc->hc", solution.amplitude[0], slope)
        spread = np.einsum("hvc,hvw,hwd->hcd", slope, np.linalg.inv(solution.power[0]), slope)
        tau2 = solution.sum_of_squares[0] / self.dof
        covariance = tau2[:, None, None] * (inverse[:, 1:3, 1:3] + spread)
        square = np.einsum("hc,hcd,hd->h", mean, np.linalg.inv(covariance), mean)
        at_zero = -0.5 * (square + np.linalg.slogdet(covariance)[1]) - np.log(2.0 * np.pi)
        prior = -np.log(2.0 * np.pi * (self.problem.prior.tilt_sd * self.problem.amplitude_scale) ** 2)
        return float(prior - np.logaddexp.reduce(weight + at_zero))

    def amplitude_at(self, theta: FloatArray) -> float:
        """Posterior mean of the bump's amplitude at one shape."""
        (solution,) = self._solutions(theta[None])
        weight = np.exp(solution.evidence[0] - np.logaddexp.reduce(solution.evidence[0]))
        return float(weight @ solution.amplitude[0, :, 0])

    def products(self, left: FloatArray, right: FloatArray, theta: FloatArray) -> FloatArray:
        """(v, w) inner products of (v, n) and (w, n) cell values under the noise field likeliest at one shape."""
        return np.asarray(self.products_by_field(left, right)[int(np.argmax(self.by_field(theta[None])[0]))])

    def products_by_field(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """(h, v, w) inner products of (v, n) and (w, n) cell values under each noise field."""
        window = self.window
        low = [window.project(window.on_grid(vectors), self.linear.weighted).low for vectors in (left, right)]
        independent, products = (left / window.variance) @ right.T, []
        for columns in self.fields:
            low_left, low_right = (vectors @ columns.field.turn for vectors in low)
            products += [independent - (low_left * weight) @ low_right.T for weight in columns.weight.T]
        return np.stack(products)

    def field_weights(self, theta: FloatArray) -> FloatArray:
        """(h,) posterior probability of each noise field at one shape."""
        evidence = self.by_field(theta[None])[0]
        return np.asarray(np.exp(evidence - np.logaddexp.reduce(evidence)))

    def gains(self, templates: Templates, theta: FloatArray) -> FloatArray:
        """(m,) log evidence gained by adding each template to the bump of one shape; -inf where it would be a dent."""
        (bump,) = self.scene.templates(theta[None], self.window)
        (bump_projected,), _ = self.linear.projected([bump])
        (projected,), _ = self.linear.projected([templates])
        product = self.window.product(bump, templates)
        base, evidence = [], []
        for columns in self.fields:
            base_inner, template_inner = Inner.of(bump_projected, columns), Inner.of(projected, columns)
            base.append(self.linear.solve([base_inner], None, columns).evidence[0])
            cross = base_inner.product(template_inner, product, columns)
            both = [base_inner.repeated(len(product)), template_inner]
            evidence.append(self.linear.solve(both, cross, columns).evidence)
        gained = np.logaddexp.reduce(np.concatenate(evidence, axis=1), axis=1)
        return np.asarray(gained - np.logaddexp.reduce(np.concatenate(base)))

    def _solutions(self, theta: FloatArray) -> Iterator[LinearSolution]:
        """Solutions of (m, p) vectors under every field, in blocks, which are large where they share a basis."""
        fields = self.fields
        size = BASIS_BLOCK if len(theta) >= LEAST_BUMPS and self.scene.separable else BLOCK
        for i in range(0, len(theta), size):
            points = theta[i : i + size]
            if len(points) >= LEAST_BUMPS:
                (bumps,) = self.scene.templates(points, self.window)
                assert isinstance(bumps, Profiles)
                spanned = LowRankBumps.of(bumps, self.linear)
                if spanned is not None:
                    yield spanned.solution(fields)
                    continue
            for j in range(0, len(points), BLOCK):
                yield self.linear.under_each(self.scene.templates(points[j : j + BLOCK], self.window), fields)


def choose_fields(evidence: FloatArray, rng: np.random.Generator) -> IndexArray:
    """(m,) random field index for each draw, by its share of the evidence; 0 where a draw has none."""
    largest = evidence.max(axis=1, keepdims=True)
    weight = np.exp(evidence - np.where(np.isfinite(largest), largest, 0.0))
    edges = np.cumsum(weight, axis=1)
    uniform = rng.uniform(size=len(evidence)) * edges[:, -1]
    return np.asarray((edges < uniform[:, None]).sum(axis=1))
