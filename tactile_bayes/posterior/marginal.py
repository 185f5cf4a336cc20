r"""Scenes of a fit window, and the marginal posterior of their shape: amplitudes, level, tilt and noise integrated out.

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

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from typing import Final, Literal

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.geometry import BoolArray, FloatArray, IndexArray
from tactile_bayes.inference.draws import Solution, Solved, distinct_rows
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import FitCells
from tactile_bayes.posterior.field import (
    LEAST_BUMPS,
    LENGTHS_MM,
    SHARES,
    FieldColumns,
    Inner,
    LinearSolution,
    Profiles,
    Projected,
    Spanned,
    Templates,
    Whitening,
    Window,
    joined,
    solve,
)
from tactile_bayes.posterior.white import WIDEST_IN_RADII

# --- The fit problem that all scenes of one window share: cells, prior and bounds.


class Problem(Record, eq=False):
    """A window with its cells, and the assumptions about a bump in it."""

    window: Window  #: The cells; scenes share one, and with it the noise fields.
    prior: BumpPrior  #: On widths and amplitudes.
    radius_mm: float  #: Radius of the window; bounds the centre about the window's middle.
    amplitude_scale: float = 1.0  #: Unit of the amplitudes' prior, see `bump.value_scale`.
    departure: FloatArray | None = None
    """(k, n) array: Further fixed columns, see `selection.ask_departure`; None for none."""

    @property
    def widest_mm(self) -> float:
        """Upper bound of the widths."""
        return WIDEST_IN_RADII * self.radius_mm


# --- Scenes: the structures that a fit window may hold, with their parameters and prior.
#
# Or a ridge in the bump's place: what a lump's evidence is held against where a ridge is to be feared.

Shape = Literal["round", "ellipse", "rotated", "ridge"]
Neighbour = Literal["second lump", "rib"]
Extra = Literal[Neighbour, ""]
REACH_IN_RADII = 1.5
"""How far from the window's middle a second structure is looked for: beyond its rim a flank still shows."""
APART = 2.0
"""A second lump lies at least this many widths from the first: closer, two Gaussians have one top. A rib may run under
the bump if it is no more than this many times as wide: a wider one is the level's own curve."""
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
"""About one posterior standard deviation of each parameter: steps of the search for the mode."""

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


class Scene(Record):
    """Structures in a model.

    The parameters are ``u, v, x, y`` (logs of the widths while nothing is turned, and the centre), without v for a
    round bump, with r for a turned one; then ``x2, y2, w2`` (centre and log width of a second round lump) or
    ``angle, offset, w2`` (a ridge). A ridge in the bump's place has ``u, along, across``: log width, angle, offset.
    """

    shape: Shape = "ellipse"  #: Shape of the bump.
    tilt: bool = True  #: The level may slope.
    extra: Extra = ""  #: Structure beside the bump.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shape parameters, the most important first (see `importance`)."""
        return _BUMP_NAMES[self.shape] + _NEIGHBOUR_NAMES[self.extra]

    @property
    def steps(self) -> FloatArray:
        """(p,) typical small step of each parameter."""
        return np.array([STEP[name] for name in self.names])

    def alone(self) -> Scene:
        """Copy without the second structure."""
        return replace(self, extra="")

    def column(self, theta: FloatArray, name: str) -> FloatArray:
        """(...) values of one parameter of (..., p) vectors; those that the scene does not have are 0, v is u."""
        if name in self.names:
            return np.asarray(theta[..., self.names.index(name)])
        return self.column(theta, "u") if name == "v" else np.zeros(theta.shape[:-1])

    def widths(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r (see `covariance_from_log_widths`) of (..., p) vectors."""
        u, v = self.column(theta, "u"), self.column(theta, "v")
        return (u + v) / 2.0, (u - v) / 2.0, self.column(theta, "r")

    def carried(self, theta: FloatArray, other: Scene) -> FloatArray:
        """Convert a vector to another scene: shared parameters keep their values, others are 0."""
        p, _, _ = self.widths(theta)
        values = {name: self.column(theta, name) for name in other.names}
        if other.shape == "round":
            values["u"] = p
        return np.array([values[name] for name in other.names])

    @property
    def separable(self) -> bool:
        """True for a scene that is only a bump along the grid's axes: the product of a profile along each."""
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
        total = log_normal_density(p, np.log(prior.width_median_mm), prior.log_width_sd)
        if self.shape == "ridge":
            inside, volume = ridge_place(self.column(theta, "across"), radius_mm)
        else:
            x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
            inside, volume = np.hypot(x, y) <= radius_mm, np.pi * radius_mm**2
        inside, total = inside & (p + ratio <= np.log(problem.widest_mm)), total - np.log(volume)
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
        """Log prior of the second structure (its amplitude's is in the target), and whether its place is allowed."""
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
        """(m,) whether a rib is clear of the bump, or at most `APART` times as wide."""
        p, _, _ = self.widths(theta)
        return np.asarray(self.rib_clear(theta, middle) | (self.column(theta, "w2") - p <= np.log(APART)))

    def rib_clear(self, theta: FloatArray, middle: tuple[float, float]) -> BoolArray:
        """(m,) whether a rib lies `APART` widths, of it or the bump, from the bump's centre."""
        angle, (p, _, _) = self.column(theta, "angle"), self.widths(theta)
        x, y = self.column(theta, "x") - middle[0], self.column(theta, "y") - middle[1]
        away = np.abs(self.column(theta, "offset") - x * np.cos(angle) - y * np.sin(angle))
        return np.asarray(away >= APART * np.exp(np.maximum(p, self.column(theta, "w2"))))


def neighbour_templates(
    window: Window, extra: Neighbour, one: FloatArray, two: FloatArray, log_width: FloatArray
) -> Templates:
    """Templates of m second structures: lumps at ``x2, y2``, or ribs of ``angle, offset``, each an (m,) array."""
    if extra == "rib":
        return window.ridges(one, two, log_width=log_width)
    return window.bumps(one, two, p=log_width, q=np.zeros_like(log_width), r=None)


def ridge_place(offset: FloatArray, radius_mm: float) -> tuple[BoolArray, float]:
    """(m,) whether ridges may lie this far from the window's middle, and the volume of angles and offsets."""
    reach = REACH_IN_RADII * radius_mm
    return np.abs(offset) <= reach, float(np.pi * 2.0 * reach)


def log_normal_density(value: FloatArray, mean: float, sd: float) -> FloatArray:
    """(...) log density of a normal distribution."""
    return np.asarray(-0.5 * ((value - mean) / sd) ** 2 - np.log(sd * np.sqrt(2.0 * np.pi)))


# --- The marginal posterior of a scene under all noise fields.

BLOCK = 128  #: Shapes solved at a time: fewer spend their time on calls, more leave the processor's cache.
NEGLIGIBLE = 1e-3
"""Fields with a smaller share of the evidence are left out of the mixture; what they add at the mode is made up for.
Once a length has as little, and less than the one before it, shorter ones are not looked at."""
SPANNED = 2048  #: As many share a basis where they can, see `field.Spanned`.


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
        return max(len(self.window.cells) - len(self._plain) + (-1 if self.scene.extra else 0), 1)

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
        total = np.logaddexp.reduce(by_field, axis=1) + self.log_prior(theta)
        return np.where(np.isfinite(total), total, -np.inf)

    def by_field(self, theta: FloatArray) -> FloatArray:
        """(m, fields) log of each field's prior times its evidence, without the shape's prior."""
        parts = [np.concatenate([one.evidence for one in part], axis=1) for part in self._parts(theta)]
        return np.concatenate(parts) + self._made_up

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """(m,) log prior of the shape; -inf outside the window and where the bump is wider than it."""
        return self.scene.log_prior(theta, self.problem)

    def settle_fields(self, theta: FloatArray) -> bool:
        """Keep only the noise fields with evidence at one shape; the others cost time and add nothing. True if that
        changed."""
        before = self.chosen_fields()
        projected, cross = self._project(self.scene.templates(theta[None], self.window))
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
        dof = max(len(self.window.cells) - len(self._plain) + 1, 1)
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
        (alone,), _ = self._project([bump])
        (beside,), _ = self._project([templates])
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

    def _project(self, templates: list[Templates]) -> tuple[list[Projected], FloatArray | None]:
        projected = [self.window.project(one, self._weighted_plain) for one in templates]
        return projected, self.window.product(*templates) if len(templates) == 2 else None

    def _parts(self, theta: FloatArray) -> Iterator[list[LinearSolution]]:
        """Blocks of (m, p) vectors, each solved under every length; large where they share a basis."""
        size = SPANNED if self.scene.separable else BLOCK
        for i in range(0, len(theta), size):
            points = theta[i : i + size]
            spanned = self._spanned(points)
            if spanned is not None:
                yield [self._found([spanned.inner(columns)], None, columns) for columns in self.fields]
                continue
            for j in range(0, len(points), BLOCK):
                projected, cross = self._project(self.scene.templates(points[j : j + BLOCK], self.window))
                yield [self._under(projected, cross, columns) for columns in self.fields]

    def _spanned(self, theta: FloatArray) -> Spanned | None:
        """Basis shared by the points' bumps; None where there is none, or where it does not save time."""
        if not self.scene.separable or len(theta) < LEAST_BUMPS:
            return None
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
        projected, cross = self._project(self.scene.templates(theta, self.window))
        return joined([self._under(projected, cross, columns) for columns in self.fields])


def independent_variance(cells: FitCells) -> FloatArray:
    """(n,) independent variance of the cells, mean 1: reading variance over count where readings were counted."""
    variance = 1.0 / cells.count if cells.reading_variance > 0 else np.ones(len(cells))
    return np.asarray(variance / variance.mean())


def linear_columns(cells: FitCells, *, tilt: bool) -> FloatArray:
    """(c, n) columns of level and tilt across the window, in units of its half width."""
    ones = np.ones((1, len(cells)))
    if not tilt:
        return ones
    x, y = cells.x_mm - cells.x_mm.mean(), cells.y_mm - cells.y_mm.mean()
    size = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
    return np.concatenate([ones, np.stack([x, y]) / size])


def choose(evidence: FloatArray, rng: np.random.Generator) -> IndexArray:
    """(m,) random field for each draw by its share of the evidence; the first where a draw has none."""
    best = evidence.max(axis=1, keepdims=True)
    weight = np.exp(evidence - np.where(np.isfinite(best), best, 0.0))
    edges = np.cumsum(weight, axis=1)
    uniform = rng.uniform(size=len(evidence)) * edges[:, -1]
    return np.asarray((edges < uniform[:, None]).sum(axis=1))
