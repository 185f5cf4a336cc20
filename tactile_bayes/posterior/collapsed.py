r"""Posterior of a bump's place and shape with all the rest integrated out: amplitude, level, tilt, noise scale, field.

For one noise field h (length and share) the map is linear in level, tilt and amplitude given the bump's centre and
widths. With flat priors on them and the Jeffreys prior on the noise scale,

.. math::
    p(y \mid \theta, h) \propto |C_h|^{-1/2}\, |X^T C_h^{-1} X|^{-1/2}\, S_h(\theta)^{-(n-c)/2},

S the generalised least-squares sum of squares and c the number of columns of X. Fields are mixed with their evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactile_bayes.forward.gaussian import cell_mean_gaussian, covariance_from_log_widths
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.bump import BumpPrior
from tactile_bayes.posterior.cells import FitCells
from tactile_bayes.posterior.field import SHARES, Whitening, whitenings

BLOCK = 64
NEGLIGIBLE = 1e-3
"""Fields with a smaller share of the evidence are left out of the mixture."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """The linear parameters' conditional posterior for draws of the shape and fields: a multivariate t.

    Parameters
    ----------
    amplitude, level : (m,) arrays
        Conditional means.
    amplitude_variance : (m,) array
        Over tau^2.
    level_slope, level_variance : (m,) arrays
        By how much the level falls as the amplitude rises, and its variance over tau^2 given the amplitude.
    sum_of_squares : (m,) array
    """

    amplitude: FloatArray
    level: FloatArray
    amplitude_variance: FloatArray
    level_slope: FloatArray
    level_variance: FloatArray
    sum_of_squares: FloatArray


class CollapsedTarget:
    """Log density of ``(u, v, x_mm, y_mm[, r])`` for one window, mixed over noise fields.

    u = p + q and v = p - q are the logs of sigma_x and sigma_y while r is 0; they come first because they matter most
    (see `importance`). p, q, r are those of `covariance_from_log_widths`.

    Parameters
    ----------
    cells
        The window.
    prior
        On the widths; the amplitude's is flat here (detection has the proper one).
    level
        Fixed background, or None to integrate a level and a tilt out.
    rotated
        Whether r is a parameter.
    widest_mm, radius_mm
        Bounds of the widths, and of the centre about the window's middle.
    """

    def __init__(
        self,
        cells: FitCells,
        *,
        prior: BumpPrior,
        level: float | None,
        rotated: bool,
        widest_mm: float,
        radius_mm: float,
    ) -> None:
        self.cells, self.prior, self.rotated = cells, prior, rotated
        self.widest_mm, self.radius_mm = widest_mm, radius_mm
        self.middle = (float(np.mean(cells.x_mm)), float(np.mean(cells.y_mm)))
        self.variance = _independent_variance(cells)
        self.data = cells.value - (0.0 if level is None else level)
        self.design = _level_and_tilt(cells) if level is None else np.zeros((len(cells), 0))
        self._all_fields = whitenings(cells.x_mm, cells.y_mm, variance=self.variance)
        self.fields: list[Whitening] = list(self._all_fields)
        self._shares = [np.array(SHARES) for _ in self.fields]

    @property
    def dimension(self) -> int:
        """Number of shape parameters."""
        return 5 if self.rotated else 4

    @property
    def columns(self) -> int:
        """Linear parameters: level and tilt where they are free, and the amplitude."""
        return int(self.design.shape[1]) + 1

    def __call__(self, theta: FloatArray) -> FloatArray:
        """(m,) log density of (m, dimension) shape vectors."""
        parts = [self._block(theta[i : i + BLOCK]) for i in range(0, len(theta), BLOCK)]
        total = np.logaddexp.reduce(np.concatenate(parts), axis=1) + self.log_prior(theta)
        return np.where(np.isfinite(total), total, -np.inf)

    def shape(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """p, q, r of (..., dimension) parameter vectors."""
        u, v = theta[..., 0], theta[..., 1]
        r = theta[..., 4] if self.rotated else np.zeros(theta.shape[:-1])
        return (u + v) / 2.0, (u - v) / 2.0, r

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """(m,) log prior of widths and centre; -inf outside the window and where the bump is wider than it."""
        p, q, r = self.shape(theta)
        ratio = np.hypot(q, r)
        inside = np.hypot(theta[:, 2] - self.middle[0], theta[:, 3] - self.middle[1]) <= self.radius_mm
        inside &= p + ratio <= np.log(self.widest_mm)
        z = (p - np.log(self.prior.width_median_mm)) / self.prior.log_width_sd
        return np.where(inside, -0.5 * (z**2 + (ratio / self.prior.log_ratio_sd) ** 2), -np.inf)

    def settle_fields(self, theta: FloatArray) -> bool:
        """Keep, of all fields, those that carry the evidence at one shape; the others cost time and say nothing.

        Returns
        -------
        bool
            Whether the set changed.
        """
        before = [(f.length_mm, tuple(s)) for f, s in zip(self.fields, self._shares, strict=True)]
        self.fields, self._shares = list(self._all_fields), [np.array(SHARES) for _ in self._all_fields]
        evidence = self._block(theta[None])[0].reshape(len(self.fields), -1)
        kept = evidence > np.logaddexp.reduce(evidence.ravel()) + np.log(NEGLIGIBLE)
        if not kept.any():
            return False
        keep = [i for i in range(len(self.fields)) if kept[i].any()]
        self._shares = [self._shares[i][kept[i]] for i in keep]
        self.fields = [self.fields[i].pruned(float(shares.max())) for i, shares in zip(keep, self._shares, strict=True)]
        return before != [(f.length_mm, tuple(s)) for f, s in zip(self.fields, self._shares, strict=True)]

    def field_summary(self, theta: FloatArray) -> dict[str, float]:
        """Evidence-weighted correlation length (mm) and share of a cell's error variance in the field, at one shape."""
        evidence = self._block(theta[None])[0]
        weight = np.exp(evidence - np.logaddexp.reduce(evidence))
        pairs = zip(self.fields, self._shares, strict=True)
        length = np.concatenate([np.full(len(shares), field.length_mm) for field, shares in pairs])
        share = np.concatenate(self._shares)
        return {"field_length_mm": float(weight @ length), "field_share": float(weight @ (share / (1.0 + share)))}

    def draw_linear(self, theta: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Amplitude, level and noise scale for (m, dimension) draws of the shape: exact, field drawn first."""
        amplitude, level, noise = (np.empty(len(theta)) for _ in range(3))
        dof = len(self.data) - self.columns
        for i in range(0, len(theta), BLOCK):
            part = theta[i : i + BLOCK]
            evidence, solutions = self._solve(part)
            index = _choose(evidence, rng)
            solution = _pick(solutions, index)
            tau = np.sqrt(solution.sum_of_squares / rng.chisquare(dof, size=len(part)))
            z = rng.standard_normal((2, len(part)))
            off = tau * np.sqrt(solution.amplitude_variance) * z[0]
            amplitude[i : i + BLOCK] = solution.amplitude + off
            about = tau * np.sqrt(solution.level_variance) * z[1]
            level[i : i + BLOCK] = solution.level - solution.level_slope * off + about
            noise[i : i + BLOCK] = tau * np.sqrt(self.variance.mean())
        return amplitude, level, noise

    def _block(self, theta: FloatArray) -> FloatArray:
        return self._solve(theta)[0]

    def _bumps(self, theta: FloatArray) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):
            return cell_mean_gaussian(
                self.cells.x_mm - theta[:, 2, None],
                self.cells.y_mm - theta[:, 3, None],
                covariance_mm2=covariance_from_log_widths(*self.shape(theta)),
                cell_mm=self.cells.cell_mm,
            )

    def _solve(self, theta: FloatArray) -> tuple[FloatArray, list[LinearSolution]]:
        """Log evidence (m, fields x shares) and the conditional solutions, in one pass over the fields."""
        bumps = self._bumps(theta)
        plain = np.concatenate([self.design.T, self.data[None]])
        scaled = plain / self.variance
        bump_plain, bump_square = bumps @ scaled.T, np.square(bumps) @ (1.0 / self.variance)
        plain_gram = plain @ scaled.T
        evidence, solutions = [], []
        for field, shares in zip(self.fields, self._shares, strict=True):
            bump_low, plain_low = bumps @ field.rotated, plain @ field.rotated
            for share in shares:
                weight = field.shrinkage(float(share))
                cross = bump_plain - (bump_low * weight) @ plain_low.T
                square = bump_square - np.square(bump_low) @ weight
                gram = plain_gram - (plain_low * weight) @ plain_low.T
                log_det = float(field.log_determinant(float(share)))
                one, solution = _marginal(cross, square, gram, log_det, n=len(self.data))
                evidence.append(one)
                solutions.append(solution)
        return np.stack(evidence, axis=1), solutions


def _marginal(
    cross: FloatArray, square: FloatArray, gram: FloatArray, log_det: float, *, n: int
) -> tuple[FloatArray, LinearSolution]:
    """Log evidence of one field, from the whitened inner products of bumps, level, tilt and data.

    Parameters
    ----------
    cross : (m, c + 1) array
        Bumps with the c level columns and with the data.
    square : (m,) array
        Bumps with themselves.
    gram : (c + 1, c + 1) array
        Level columns and data with each other.
    """
    c = gram.shape[0] - 1
    inverse = np.linalg.inv(gram[:c, :c]) if c else np.zeros((0, 0))
    to_level = cross[:, :c] @ inverse
    power = np.maximum(square - np.einsum("mc,mc->m", to_level, cross[:, :c]), 1e-300)
    along = cross[:, c] - to_level @ gram[:c, c]
    rest = gram[c, c] - gram[c, :c] @ inverse @ gram[:c, c]
    amplitude = along / power
    sum_of_squares = np.maximum(rest - power * amplitude**2, 1e-12 * rest)
    log_gram = float(np.linalg.slogdet(gram[:c, :c])[1]) if c else 0.0
    evidence = -0.5 * (log_det + log_gram + np.log(power)) - 0.5 * (n - c - 1) * np.log(sum_of_squares)
    # a dent is no lump: only rises have density
    evidence = np.where(amplitude > 0, evidence, -np.inf)
    level = (inverse @ gram[:c, c])[0] - to_level[:, 0] * amplitude if c else np.zeros(len(amplitude))
    slope = to_level[:, 0] if c else np.zeros(len(amplitude))
    variance = np.full(len(amplitude), inverse[0, 0] if c else 0.0)
    return evidence, LinearSolution(amplitude, level, 1.0 / power, slope, variance, sum_of_squares)


def _independent_variance(cells: FitCells) -> FloatArray:
    """(n,) independent variance of the cells, mean 1: reading variance over count where readings were counted."""
    reading = float(np.sum(cells.variance * cells.count) / np.sum(cells.count))
    variance = 1.0 / cells.count if reading > 0 else np.ones(len(cells))
    return np.asarray(variance / variance.mean())


def _level_and_tilt(cells: FitCells) -> FloatArray:
    x, y = cells.x_mm - cells.x_mm.mean(), cells.y_mm - cells.y_mm.mean()
    size = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
    return np.stack([np.ones(len(cells)), x / size, y / size], axis=1)


def _choose(evidence: FloatArray, rng: np.random.Generator) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    """(m,) one field for each draw, with its share of the evidence."""
    weight = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    edges = np.cumsum(weight, axis=1)
    uniform = rng.uniform(size=len(evidence)) * edges[:, -1]
    return np.asarray((edges < uniform[:, None]).sum(axis=1))


def _pick(solutions: list[LinearSolution], index: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> LinearSolution:
    rows = np.arange(len(index))
    names = ("amplitude", "level", "amplitude_variance", "level_slope", "level_variance", "sum_of_squares")
    return LinearSolution(*(np.stack([getattr(s, name) for s in solutions], axis=1)[rows, index] for name in names))
