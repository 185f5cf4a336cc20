"""Lumps of different size whose frames look alike (Fig 5b of the paper), sought over sizes and depths.

The paper says that some combinations of size and depth lead to identical pressure distributions over the lump. How
alike two frames are is measured against what the lump itself adds: frames of two faint lumps are alike because both are
those of no lump.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.plane.condense import condense
from tactile_bayes.forward.plane.line import press, press_layers
from tactile_bayes.forward.plane.study import HARD_RATIO, StudySettings
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM

DIAMETERS_MM = (5.0, 10.0, 15.0, 20.0, 25.0)
DEPTH_RATIOS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5)
LEAST_RISE = 0.1
"""A lump takes part when it raises the middle of the head by this share of the frame's mean: five times the noise."""
LEAST_SIZE_RATIO = 1.5
"""Of the larger lump's diameter to the smaller one's."""
ALIKE = 0.05
"""Frames that differ by less than this share of what the lump adds are called indistinguishable."""
# Of the depths in diameters that are tried by interpolation between those solved.
_STEP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class CentredFrame:
    """The frame with the head's centre over a lump, as taxels see it.

    Parameters
    ----------
    d_mm, depth_ratio
        Size and depth of the lump.
    s_mm : (n,) array
        Taxel positions across the head.
    share : (n,) array
        Pressure over the frame's mean.
    added : (n,) array
        `share` less that of the same layers without the lump.
    """

    d_mm: float
    depth_ratio: float
    s_mm: FloatArray
    share: FloatArray
    added: FloatArray

    @property
    def rise(self) -> float:
        """What the lump adds in the middle of the head."""
        return float(_middle(self.added))


@dataclass(frozen=True, slots=True, eq=False)
class Lookalikes:
    """Two lumps of different size with the most alike frames.

    Parameters
    ----------
    small, large
        Their frames.
    difference
        Root mean square difference of the frames over the root mean square of what the smaller lump adds.
    """

    small: CentredFrame
    large: CentredFrame
    difference: float

    @property
    def of_mean(self) -> float:
        """Root mean square difference as a share of the frames' mean."""
        return _rms(self.large.share - self.small.share)


def centred_frame(d_mm: float, depth_ratio: float, *, settings: StudySettings, seat: float) -> CentredFrame:
    """The frame over a hard lump of one size and depth."""
    body = settings.body(d_mm, depth_ratio, seat=seat)
    head: Head = settings.head
    reach = 0.5 * settings.cell_mm * len(head.sensing_cells(settings.cell_mm))
    surface = condense(body, reach_mm=reach, cell_mm=settings.cell_mm, fineness=settings.fineness)
    over = press(surface, HARD_RATIO, np.zeros(1), head=head, mean_kpa=settings.mean_kpa).as_taxels(HEAD_PITCH_MM)
    far = press_layers(body.layers, head=head, mean_kpa=settings.mean_kpa, cell_mm=settings.cell_mm)
    share, plain = _share(over.at(0.0)), _share(far.as_taxels(HEAD_PITCH_MM).at(0.0))
    return CentredFrame(d_mm, depth_ratio, over.s_mm, share, share - plain)


def find_lookalikes(
    settings: StudySettings,
    *,
    seat: float,
    diameters_mm: Sequence[float] = DIAMETERS_MM,
    depth_ratios: Sequence[float] = DEPTH_RATIOS,
    least_size_ratio: float = LEAST_SIZE_RATIO,
) -> Lookalikes | None:
    """The pair of visible lumps of different size whose frames are most alike; None where no two are visible.

    Parameters
    ----------
    settings
        Body, head and pressure; hard lumps (E2/E1 = 100).
    seat
        As in `body.Body`.
    diameters_mm, depth_ratios
        Rising; depths between the first and the last are tried in steps of 0.01.
    least_size_ratio
        Diameter of the larger lump over that of the smaller, at least.

    Notes
    -----
    Frames are interpolated between the depths solved (cubic splines in h/d); the best depth of the larger lump of the
    best pair is then sought with the model itself.
    """
    from scipy.optimize import minimize_scalar

    coarse = replace(settings, fineness=1)
    tried = np.round(np.arange(depth_ratios[0], depth_ratios[-1] + 1e-9, _STEP), 6)
    shares, added = {}, {}
    for d in diameters_mm:
        frames = [centred_frame(d, h, settings=coarse, seat=seat) for h in depth_ratios]
        shares[d], added[d] = _interpolated(frames, depth_ratios, tried)
    best: tuple[float, float, float, float, float] | None = None
    for d, e in itertools.combinations(sorted(diameters_mm), 2):
        if least_size_ratio * d > e:
            continue
        gaps = np.sqrt(np.mean((shares[d][:, None] - shares[e]) ** 2, axis=2))
        gaps /= np.sqrt(np.mean(added[d] ** 2, axis=1))[:, None]
        gaps[(_middle(added[d]) < LEAST_RISE)[:, None] | (_middle(added[e]) < LEAST_RISE)] = np.inf
        i, j = np.unravel_index(np.argmin(gaps), gaps.shape)
        if np.isfinite(gaps[i, j]) and (best is None or gaps[i, j] < best[0]):
            best = (float(gaps[i, j]), d, float(tried[i]), e, float(tried[j]))
    if best is None:
        return None
    _, small_mm, small_depth, d_mm, depth = best
    small = centred_frame(small_mm, small_depth, settings=settings, seat=seat)

    def gap(depth_ratio: float) -> float:
        return _difference(small, centred_frame(d_mm, depth_ratio, settings=settings, seat=seat))

    ends = max(depth - 2 * _STEP, depth_ratios[0]), min(depth + 2 * _STEP, depth_ratios[-1])
    found = float(minimize_scalar(gap, bounds=ends, method="bounded", options={"xatol": 1e-3}).x)
    large_frame = centred_frame(d_mm, found, settings=settings, seat=seat)
    return Lookalikes(small, large_frame, _difference(small, large_frame))


def _interpolated(
    frames: Sequence[CentredFrame], depth_ratios: Sequence[float], tried: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Frames (k, n) of one size of lump at the depths tried, and what the lump adds to them."""
    from scipy.interpolate import CubicSpline

    knots = np.asarray(depth_ratios)
    shares = CubicSpline(knots, np.stack([frame.share for frame in frames]))(tried)
    return shares, CubicSpline(knots, np.stack([frame.added for frame in frames]))(tried)


def _difference(small: CentredFrame, large: CentredFrame) -> float:
    return _rms(large.share - small.share) / _rms(small.added)


def _share(frame_kpa: FloatArray) -> FloatArray:
    return np.asarray(frame_kpa / frame_kpa.mean())


def _middle(across: FloatArray) -> FloatArray:
    """Mean over the two middle taxels of (..., n) values."""
    half = across.shape[-1] // 2
    return np.asarray(across[..., half - 1 : half + 1].mean(axis=-1))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
