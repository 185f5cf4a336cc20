"""How probably a rise is a lump, and the smallest lump that a map would have shown."""

from __future__ import annotations

from math import exp, lgamma, log, log1p, pi
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.bump import covered_share, trusted, value_scale, window_cells
from tactile_bayes.posterior.detection import Detection
from tactile_bayes.posterior.draw import DETECTED, ModalBump
from tactile_bayes.posterior.field import Window
from tactile_bayes.posterior.marginal import CollapsedTarget, independent_variance
from tactile_bayes.posterior.scene import Problem, Scene
from tactile_bayes.posterior.white import Candidate
from tactile_bayes.presets import FIELD_COSINES, FIT_RADIUS_MM

# --- Probability that a rise of a map is a lump, calibrated on simulated exams with and without one.

SHARE_WITH_LUMP: Final = 0.5
"""Half of the simulated exams hold a lump: the prior probability behind the answer."""
COEFFICIENTS: Final = (1.14, 0.8, -2.36, -4.3, -2.32, -2.47)
"""Intercept and those of `Weighed.features`; printed by ``python -m validation lump_probability learn``, 0127."""
ENDS: Final = (0.05, 0.99)
"""The exams that were simulated cannot tell probabilities nearer to 0 or 1: of the 40 rises that say least in the exams
learned from, 2 lie within 10 mm of a lump that the map does not show."""
LIKELY: Final = 0.5
"""A rise with a lower probability is no lump by the verdict, whatever its evidence."""
UNPROVEN: Final = 0.49
"""Most that is told of a rise without the evidence for a size: it is not told as a lump."""
MOST_EVIDENCE: Final = 50.0
WIDE_MM: Final = 8.0
NO_EVIDENCE: Final = "no lump by the evidence"


class Weighed(Record, eq=False):
    """A rise with the odds of a bump there, and the probability that it is a lump."""

    detection: Detection
    """Evidence for a bump against smooth errors, and a ridge where one rises."""
    centre_mm: tuple[float, float]
    """Centre of the bump."""
    features: tuple[float, ...]
    """Log of 1 plus the log Bayes factor, log of the axis ratio, by how much the log of the width exceeds that of
    `WIDE_MM`, share of the bump that the map does not cover, and 1 where a fault speaks against measuring it."""
    candidate: Candidate | None = None
    """Where the search met it."""

    @property
    def axis_ratio(self) -> float:
        """Axis ratio of the bump, at most e^2."""
        return exp(self.features[1])

    @property
    def probability(self) -> float:
        """Probability of a lump, where half of the exams hold one.

        The evidence of a bump is against smooth errors. Rims, ridges, ribs, creases and uneven fat rise, too; they are
        told by the other features.
        """
        score = COEFFICIENTS[0] + float(np.dot(COEFFICIENTS[1:], self.features))
        most = ENDS[1] if self.detection.probability >= DETECTED else UNPROVEN
        return float(np.clip(1.0 / (1.0 + exp(-score)), ENDS[0], most))


def weigh(
    tactile_map: TactileMap,
    detection: Detection,
    bump: ModalBump,
    *,
    fault: str = "",
    candidate: Candidate | None = None,
) -> Weighed:
    """A rise with the bump that the odds are of; `fault` and `candidate` as the search met it."""
    centre_mm, widths_mm = (bump.x_mm, bump.y_mm), (bump.sigma_x_mm, bump.sigma_y_mm)
    wide, narrow = max(widths_mm), max(min(widths_mm), 1e-3)
    evidence = log1p(float(np.clip(detection.log_bayes_factor, 0.0, MOST_EVIDENCE)))
    too_wide = max(log(max(wide, 1e-3) / WIDE_MM), 0.0)
    open_share = 1.0 - covered_share(tactile_map, centre_mm, radius_mm=1.5 * wide)
    faulty = float(bool(fault) and not fault.startswith(NO_EVIDENCE))
    features = (evidence, min(log(wide / narrow), 2.0), min(too_wide, 2.0), open_share, faulty)
    return Weighed(detection, centre_mm, features, candidate)


# --- Smallest lump that a map without one would have shown, by place and depth.
#
# A lump of a given size and depth makes a bump whose amplitude and width are known on average, with a spread over
# stiffnesses and bodies. What amplitude a bump needs at a place follows from the map's coverage, readings and
# errors there, by the evidence that decides about a lump. Simulated lumps tell how far above it a bump must be to
# be found.

PROBABILITY: Final = 0.95
DEPTHS_IN_FAT: Final = (0.5, 0.75, 1.0)
"""Depth of the lump's middle below the skin, over that of the fat: in it, and on its lower edge. In the gland a lump
that is no stiffer does not show at all."""
SIZES_MM: Final = np.arange(4.0, 30.5, 0.5)
LEAST_DEPTH_RATIO: Final = 0.56
"""Depth of the ball's middle, over its diameter: nearer to the skin no ball was simulated."""
USUAL_FAT_MM: Final = 15.0
"""Where a map does not tell the depth of fat."""
LOG_AMPLITUDE: Final = (-2.61, 3.393, -3.27, 1.003, 0.251, -0.049, -0.983)
LOG_SIGMA: Final = (1.865, -0.168, 0.988, -0.155)
"""Coefficients of `lump_features`, and of its first four: ``python -m validation smallest_lump learn`` prints them."""
LOG_FACTOR: Final = 10.0
MARGIN: Final = 0.5
"""ln of the expected amplitude over the one that `LOG_FACTOR` needs, from which 19 of 20 simulated lumps were found:
stiffness, body and noise, and what the search misses (decision 0127)."""
MOST_PLACES: Final = 20
WIDTHS_MM: Final = np.geomspace(2.0, 12.0, 6)
AMPLITUDES: Final = np.geomspace(1e-3, 10.0, 120)
LEAST_CELLS, LEAST_SHARE, NEAR_MM = 100, 0.6, 7.5


class SmallestLumps(Record, eq=False):
    """Diameters in mm of the smallest ball that a map would have shown with `PROBABILITY`."""

    places_mm: FloatArray
    """(n, 2) array: In `plane`."""
    depths_mm: FloatArray
    """(k,) array: Of the ball's middle below the skin."""
    d_mm: FloatArray
    """(n, k) array: At each place for each depth; inf where not even the largest ball would have shown."""
    spacing_mm: float
    """Between the places."""


def smallest_lumps(tactile_map: TactileMap, *, fat_mm: float | None = None) -> SmallestLumps:
    """Smallest ball that a map would have shown at places over its covered area, on fat of `fat_mm` (None: unknown)."""
    places, spacing = _places(tactile_map)
    needed = np.array([needed_amplitudes(tactile_map, (float(x), float(y))) for x, y in places])
    fat = USUAL_FAT_MM if fat_mm is None else fat_mm
    depths = np.round(fat * np.array(DEPTHS_IN_FAT))
    columns = [_smallest(needed, float(depth), max(fat, float(depth))) for depth in depths]
    return SmallestLumps(places, depths, np.stack(columns, axis=1), spacing)


def _places(tactile_map: TactileMap) -> tuple[FloatArray, float]:
    """At most about `MOST_PLACES` covered places on a grid, and its spacing."""
    mask, cell = trusted(tactile_map), tactile_map.recipe.cell_mm
    spacing = float(np.sqrt(mask.sum() * cell**2 / MOST_PLACES))
    rows, columns = np.nonzero(mask)
    x, y = tactile_map.x_mm[columns], tactile_map.y_mm[rows]
    middle = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
    axes = []
    for axis, low, high in ((0, x.min(), x.max()), (1, y.min(), y.max())):
        number = int((high - low) / spacing / 2)
        axes.append(middle[axis] + spacing * np.arange(-number, number + 1))
    grid = [(a, b) for b in axes[1] for a in axes[0]]
    kept = [at for at in grid if covered_share(tactile_map, at, radius_mm=NEAR_MM) >= LEAST_SHARE]
    return np.array(kept or [middle]), spacing


def _smallest(needed: FloatArray, depth_mm: float, fat_mm: float) -> FloatArray:
    """(n,) least of `SIZES_MM` that shows at each place; inf where none does."""
    features = lump_features(SIZES_MM, depth_mm, fat_mm)
    log_a = features @ np.array(LOG_AMPLITUDE)
    log_sigma = np.clip(features[:, : len(LOG_SIGMA)] @ np.array(LOG_SIGMA), *np.log(WIDTHS_MM[[0, -1]]))
    fits = depth_mm >= LEAST_DEPTH_RATIO * SIZES_MM
    sizes = np.full(len(needed), np.inf)
    for i, row in enumerate(needed):
        least = np.interp(log_sigma, np.log(WIDTHS_MM), np.log(np.minimum(row, 1e9)))
        shown = (log_a - least >= MARGIN) & fits
        # from the largest down: what is larger shows, too
        hidden = np.flatnonzero(~shown & fits)
        first = 0 if not len(hidden) else int(hidden[-1]) + 1
        if first < fits.sum():
            sizes[i] = SIZES_MM[first]
    return sizes


def lump_features(d_mm: FloatArray, depth_mm: FloatArray | float, fat_mm: FloatArray | float) -> FloatArray:
    """(n, 7) features of balls in fat: size, depth, and how far they stand out of the gland, with products."""
    d, h = np.log(d_mm / 10.0), np.log(np.broadcast_to(depth_mm, d_mm.shape) / 15.0)
    seat = np.tanh(2.0 * (fat_mm - np.broadcast_to(depth_mm, d_mm.shape)) / d_mm)
    return np.stack([np.ones_like(d), d, h, seat, d * h, d**2, h**2], axis=-1)


def needed_amplitudes(tactile_map: TactileMap, centre_mm: tuple[float, float]) -> FloatArray:
    """(widths,) amplitude at which a bump of each of `WIDTHS_MM` at a place reaches `LOG_FACTOR`; inf if none.

    The log Bayes factor is of a bump of this place and width against the window's level, tilt and errors, without the
    price of the search.
    """
    cells = window_cells(tactile_map, centre_mm, radius_mm=FIT_RADIUS_MM)
    if len(cells) < LEAST_CELLS:
        return np.full(len(WIDTHS_MM), np.inf)
    window = Window(cells, independent_variance(cells), cosines=FIELD_COSINES)
    problem = Problem(window, BumpPrior(), FIT_RADIUS_MM, value_scale(tactile_map))
    target = CollapsedTarget(problem, Scene("round"))
    target.settle_lengths()
    theta = np.array([[log(width), *centre_mm] for width in WIDTHS_MM])
    _, _, power, _, _ = target.conditional(theta)
    amplitudes = AMPLITUDES * value_scale(tactile_map)
    factor = _log_factors(target, power[:, :, 0, 0], amplitudes)
    return np.array([np.interp(LOG_FACTOR, row, amplitudes, left=amplitudes[0], right=np.inf) for row in factor])


def _log_factors(target: CollapsedTarget, power: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """(widths, amplitudes) log Bayes factors of bumps put into the window, from their (widths, fields) powers."""
    null_dof, dof, sd = target.dof + 1, target.dof, target.amplitude_sd
    rest = np.concatenate([np.maximum(one.rest(), 0.0) + one.floor for one in target.fields])[:, None]
    base = np.concatenate([one.log_prior - 0.5 * one.log_det for one in target.fields])[:, None]
    p = power[:, :, None]
    null = base + lgamma(null_dof / 2) - 0.5 * null_dof * np.log(pi * (rest + p * amplitudes**2))
    variance = sd**2 + rest / dof / p
    lump = base + lgamma(dof / 2) - 0.5 * dof * np.log(pi * rest)
    lump = lump - 0.5 * (np.log(p) + np.log(2 * pi * variance) + amplitudes**2 / variance)
    return np.asarray(np.logaddexp.reduce(lump, axis=1) - np.logaddexp.reduce(null, axis=1))
