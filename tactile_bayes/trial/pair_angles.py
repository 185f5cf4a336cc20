"""Ordered angles of the lines through all pairs of points: listed, or counted when there are many."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tactile_bayes.trial.readings import FloatArray

# Up to so many points the pairs are listed (2 million of them); beyond, ranks are found by counting inversions.
MOST_LISTED = 2000
# Beyond MOST_LISTED an ordered angle is found to this many radians.
RESOLUTION = 1e-9
# Differences below this share of the mean of the two numbers are rounding, as in laboratories' programs.
_EQUAL = 1e-12


class PairAngles:
    """Ordered angles in (-pi/2, pi/2] of all pairs of points that do not coincide.

    Parameters
    ----------
    x, y : (n,) arrays
    vertical
        The angle of a pair of equal x: pi/2 or -pi/2.
    """

    def __init__(self, x: FloatArray, y: FloatArray, *, vertical: float) -> None:
        self._counted = len(x) > MOST_LISTED
        self._vertical = vertical
        if self._counted:
            order = np.lexsort((y, x))
            self._x, self._y = x[order], y[order]
            self._coincident = _pairs_of_equals(np.stack([self._x, self._y], axis=1))
            self._upright = _pairs_of_equals(self._x[:, None]) - self._coincident
            self.number = len(x) * (len(x) - 1) // 2 - self._coincident
        else:
            self._angles = _listed(x, y, vertical)
            self.number = len(self._angles)

    def below(self, angle: float, *, inclusive: bool) -> int:
        """Number of angles below `angle` (in (-pi/2, pi/2)), or not above it when inclusive."""
        if not self._counted:
            return int(np.searchsorted(self._angles, angle, side="right" if inclusive else "left"))
        slope = math.copysign(1.0, angle) if abs(angle) == math.pi / 4 else math.tan(angle)
        z = self._y - slope * self._x
        grain = _EQUAL * (np.abs(self._y).max() + abs(slope) * np.abs(self._x).max())
        z = np.rint(z / grain) if grain > 0 else z
        upright = self._upright if self._vertical < 0 else 0
        return _inversions(self._x, z, ties=inclusive) + upright - (self._coincident if inclusive else 0)

    def ranked(self, rank: int) -> float:
        """The angle of a rank, from 1."""
        if not self._counted:
            return float(self._angles[rank - 1])
        low, high = -math.pi / 2, math.pi / 2
        count_low, count_high = 0, self.number
        widths = [high - low]
        while high - low > RESOLUTION:
            share = _next_share(rank, count_low, count_high, widths)
            middle = low + share * (high - low)
            count = self.below(middle, inclusive=True)
            if count >= rank:
                high, count_high = middle, count
            else:
                low, count_low = middle, count
            widths.append(high - low)
        return high

    def shift(self, *, rising: bool) -> int:
        """Twice the shift of the median's rank: one for each angle beyond 45 degrees against the line, half at it."""
        if rising:
            return self.below(-math.pi / 4, inclusive=True) + self.below(-math.pi / 4, inclusive=False)
        on_or_above = self.number - self.below(math.pi / 4, inclusive=False)
        return -(on_or_above + self.number - self.below(math.pi / 4, inclusive=True))

    def exactly_on_the_shift(self, *, rising: bool) -> int:
        """Number of angles exactly 45 degrees against the line."""
        at = -math.pi / 4 if rising else math.pi / 4
        return self.below(at, inclusive=True) - self.below(at, inclusive=False)


def kendall_sign(x: FloatArray, y: FloatArray) -> int:
    """Sign of Kendall's tau: concordant less discordant pairs."""
    if len(x) <= MOST_LISTED:
        first, second = np.triu_indices(len(x), 1)
        return int(np.sign(np.sum(np.sign(x[second] - x[first]) * np.sign(y[second] - y[first]))))
    order = np.lexsort((y, x))
    discordant = _inversions(x[order], y[order], ties=False)
    tied = _pairs_of_equals(x[order][:, None]) + _pairs_of_equals(np.sort(y)[:, None])
    both = _pairs_of_equals(np.stack([x[order], y[order]], axis=1))
    concordant = len(x) * (len(x) - 1) // 2 - tied + both - discordant
    return (concordant > discordant) - (concordant < discordant)


def _listed(x: FloatArray, y: FloatArray, vertical: float) -> FloatArray:
    first, second = np.triu_indices(len(x), 1)
    dx, dy = _difference(x[second], x[first]), _difference(y[second], y[first])
    apart = (dx != 0) | (dy != 0)
    dx, dy = dx[apart], dy[apart]
    upright = dx == 0
    return np.sort(np.where(upright, vertical, np.arctan(dy / np.where(upright, 1.0, dx))))


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    difference = a - b
    return np.where(np.abs(difference) < _EQUAL * (np.abs(a) + np.abs(b)) / 2, 0.0, difference)


def _next_share(rank: int, count_low: int, count_high: int, widths: Sequence[float]) -> float:
    """Where to count next in the bracket: by interpolation, offset to alternate sides so that both ends close in.

    Where that does not shrink the bracket eightfold in three steps, its middle.
    """
    step = len(widths)
    if count_high == count_low or (step > 3 and widths[-1] > widths[-4] / 8):
        return 0.5
    share = (rank - 0.5 - count_low) / (count_high - count_low)
    beside = 0.98 * share if step % 2 else 1 - 0.98 * (1 - share)
    return min(0.999, max(0.001, beside))


def _pairs_of_equals(rows: FloatArray) -> int:
    """Number of pairs of equal rows in (n, k) sorted rows."""
    new = np.any(rows[1:] != rows[:-1], axis=1)
    lengths = np.diff(np.concatenate([[-1], np.flatnonzero(new), [len(rows) - 1]]))
    return int(np.sum(lengths * (lengths - 1) // 2))


def _inversions(x: FloatArray, z: FloatArray, *, ties: bool) -> int:
    """Number of pairs of ascending x whose z descends; with `ties`, also pairs of equal z, or of equal x and z."""
    order = np.lexsort((z, x))
    ordered = z[order]
    index = np.arange(len(z))
    by_value = np.lexsort((-index if ties else index, ordered))
    rank = np.empty(len(z), dtype=np.int64)
    rank[by_value] = index
    return _inversions_of_permutation(rank)


def _inversions_of_permutation(rank: npt.NDArray[np.int64]) -> int:
    """Number of inversions, counted bit by bit: within equal higher bits, every 1 before a 0."""
    total = 0
    for bit in reversed(range(max(1, int(len(rank) - 1).bit_length()))):
        group, one = rank >> (bit + 1), (rank >> bit) & 1
        ones_before = np.concatenate([[0], np.cumsum(one)])[:-1]
        start = np.concatenate([[True], group[1:] != group[:-1]])
        base = np.maximum.accumulate(np.where(start, ones_before, 0))
        total += int(np.sum((ones_before - base)[one == 0]))
        rank = rank[np.argsort(rank >> bit, kind="stable")]
    return total
