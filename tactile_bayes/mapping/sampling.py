"""Choice and averaging of the frames that are kept with a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray, Plane, apply, inverse
from tactile_bayes.mapping.coarse_frames import CoarseFrames, block_means, every_stretch, thinning
from tactile_bayes.mapping.frame_sample import MOST_STEPS, STEP, FrameSample
from tactile_bayes.mapping.frames import SelectedFrames

MOST_FRAMES = 768
"""Averaged frames that are kept, spread evenly over the time of the scans."""
_PLACE_DIGITS = 6


def sample_frames(selections: Sequence[SelectedFrames], plane: Plane) -> FrameSample | None:
    """Average the used frames of a map's scans; None where they share no block of taxels.

    The scans are of one head. Only blocks that have a good taxel in all of them are kept.
    """
    used = [part for part in selections if part.used.any()]
    every = thinning((part.scan.frames.time_s[part.used] for part in used), most=MOST_FRAMES)
    parts = [_averaged(part, plane, every) for part in used]
    if not parts:
        return None
    shared = set.intersection(*(set(part.block.tolist()) for part, _, _ in parts))
    if not shared:
        return None
    chosen = [np.isin(part.block, sorted(shared)) for part, _, _ in parts]
    pressure = np.concatenate([part.pressure[:, keep] for (part, _, _), keep in zip(parts, chosen, strict=True)])
    steps = np.clip(np.rint(pressure / STEP), 0, MOST_STEPS)
    turns = np.concatenate([rows for _, rows, _ in parts])
    return FrameSample(steps * STEP, np.round(turns, _PLACE_DIGITS), np.round(parts[0][2][chosen[0]], _PLACE_DIGITS))


def _averaged(part: SelectedFrames, plane: Plane, every: int) -> tuple[CoarseFrames, FloatArray, FloatArray]:
    """A scan's averaged frames, their rows of the transform to the plane, and the blocks' (k, 3) places."""
    frames = np.flatnonzero(part.used)
    frames = frames[every_stretch(part.scan.frames.time_s[frames], every)]
    coarse = CoarseFrames.of(part, frames)
    rotation, lever = part.poses.rotation[frames], inverse(part.scan.head.scanhead_from_tracker)
    turn = plane.plane_from_base[:3, :3] @ rotation @ lever[:3, :3]
    apex = apply(plane.plane_from_base, part.poses.position_mm[frames] + rotation @ lever[:3, 3])
    rows = np.concatenate([turn, apex[:, :, None]], axis=2)[:, :2]
    mean = block_means(rows.reshape(len(frames), -1), coarse.first).reshape(-1, 2, 4)
    return coarse, mean, coarse.weight.T @ part.scan.head.surface_mm[part.good_taxels]
