"""How pressure is spread over the head where there is no lump: it tells how deep the soft layer under the head is.

A curved head on a thin soft layer presses hardest in its middle, on a deep one at its rim (Wellman & Howe 1999, Eq 1:
the width of the homogeneous profile goes with the thickness of the tissue).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.frames import BoolArray, SelectedFrames
from tactile_bayes.mapping.readout import Readout
from tactile_bayes.presets import HEAD_PROFILE

# Frames that are looked at, spread evenly over the scan.
MOST_FRAMES = 2048
# A frame is called lump-free when what is left of it beside a smooth profile is within this factor of the smoothest
# tenth's, and there must be this many of them.
SMOOTH_FACTOR = 1.1
LEAST_FRAMES = 50
# Orders across and along the head, those of `HEAD_PROFILE` first. Odd and mixed ones take up how the head was tilted.
# The fourth across hangs on the head's very rim: two simulations with one body differ in it by half its range.
_ORDERS = ((2, 0), (0, 2), (0, 4), (0, 0), (4, 0), (1, 0), (0, 1), (1, 1), (2, 2))
_HIGHEST = 4
_COLUMNS = len(HEAD_PROFILE) + 1


def head_profile_figures(selections: Sequence[SelectedFrames]) -> dict[str, float]:
    """The map's figures `HEAD_PROFILE`, and ``head_profile_frames``; none where too few frames are free of a lump."""
    return profile_figures([_of_scan(part) for part in selections])


def profile_figures(profiles: Sequence[FloatArray]) -> dict[str, float]:
    """The figures from what `ProfileReader` read, in any portions and any order: the mean over the lump-free frames.

    A lump, or the edge of a rib, is no smooth profile: what is left of a frame tells it, also where most frames feel
    one.
    """
    rows = np.concatenate(profiles) if profiles else np.zeros((0, _COLUMNS))
    if len(rows) < LEAST_FRAMES:
        return {}
    smooth = rows[rows[:, -1] <= SMOOTH_FACTOR * float(np.quantile(rows[:, -1], 0.1)), :-1]
    if len(smooth) < LEAST_FRAMES:
        return {}
    mean = np.sort(smooth, axis=0).mean(axis=0)  # sorted, so that the order of the frames leaves no trace
    return {
        **{name: float(value) for name, value in zip(HEAD_PROFILE, mean, strict=True)},
        "head_profile_frames": float(len(smooth)),
    }


def _of_scan(part: SelectedFrames) -> FloatArray:
    frames = np.flatnonzero(part.used)
    if not len(frames):
        return np.zeros((0, _COLUMNS))
    frames = frames[:: max(1, len(frames) // MOST_FRAMES)]
    readout = Readout.of(part.scan.element_calibration, part.good_taxels)
    pressure, valid = readout.pressure_kpa(readout.counts(part.scan.frames.counts[frames]))
    return ProfileReader.of(part.good_taxels).read(pressure, part.level_kpa[frames], valid)


@dataclass(frozen=True, slots=True, eq=False)
class ProfileReader:
    """Fits smooth profiles to frames.

    Parameters
    ----------
    solve : (taxels, 9) array
        Takes readings to coefficients of Legendre polynomials at the good taxels, by least squares; no taxel where too
        few rows or columns have one to tell the polynomials apart.
    gram : (9, 9) array
        Inner products of the polynomials.
    """

    solve: FloatArray
    gram: FloatArray

    @classmethod
    def of(cls, good: BoolArray) -> ProfileReader:
        """For the good taxels of an array, True in (rows, columns)."""
        across, along = (_legendre(n) for n in good.shape)
        terms = np.stack([np.outer(across[:, i], along[:, j])[good] for i, j in _ORDERS], axis=1)
        if min(np.count_nonzero(good.any(axis=1)), np.count_nonzero(good.any(axis=0))) <= _HIGHEST:
            terms = terms[:0]
        return cls(np.ascontiguousarray(np.linalg.pinv(terms).T), terms.T @ terms)

    def read(self, pressure_kpa: FloatArray, level_kpa: FloatArray, valid: BoolArray | None = None) -> FloatArray:
        """Coefficients and what they leave of frames.

        Parameters
        ----------
        pressure_kpa : (f, taxels) array
            Of the good taxels.
        level_kpa : (f,) array
            The frames' means.
        valid : (f, taxels) array
            Which readings carry a pressure; None where all do. Frames with one that does not are left out.

        Returns
        -------
        (n, 4) array
            `HEAD_PROFILE`, and the root mean square of what the nine terms leave.
        """
        if not len(self.solve):
            return np.zeros((0, _COLUMNS))
        whole = level_kpa > 0
        if valid is not None:
            whole &= valid.all(axis=1)
        pressure_kpa, level_kpa = pressure_kpa[whole], level_kpa[whole]
        found = pressure_kpa @ self.solve
        # what is left by Pythagoras: the residual itself would cost as much as the map
        square = np.einsum("ft,ft->f", pressure_kpa, pressure_kpa) - np.einsum("fi,ij,fj->f", found, self.gram, found)
        left = np.sqrt(np.maximum(square, 0.0) / len(self.solve))
        return np.column_stack([found[:, : len(HEAD_PROFILE)], left]) / level_kpa[:, None]


def _legendre(taxels: int) -> FloatArray:
    """(taxels, 5) Legendre polynomials at the taxels' centres, the array's ends at -1 and 1."""
    return np.asarray(legendre.legvander((2.0 * np.arange(taxels) + 1.0) / taxels - 1.0, _HIGHEST))
