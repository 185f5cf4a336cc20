"""How far apart strokes in opposite directions see the lump: one that is dragged along, or poses that come late.

Either puts the lump's image ahead in one direction and behind in the other, and the map, which holds both, is too wide.
One unknown of the regression in `tactile_bayes.mapping.shift_fit`, in one round: enough for a warning.
`tactile_bayes.mapping.strokes.register_strokes` finds each stroke's shift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.coarse_frames import CoarseFrames, every_stretch, thinning
from tactile_bayes.mapping.shift_fit import ShiftFit
from tactile_bayes.mapping.source import Source
from tactile_bayes.mapping.strokes import find_strokes

# Averaged frames that are used, spread evenly: more would cost as much as the map itself.
MOST_FRAMES = 160


def stroke_lag_figures(sources: Sequence[Source]) -> dict[str, float]:
    """Figures ``stroke_lag_mm`` and ``stroke_lag_sd_mm``: half the way between what strokes to +x and to -x see.

    Above 0 the lump is ahead of its mean place in the direction of the stroke, as if dragged along; a pose that is
    late by t against the frames gives -v t. Empty where strokes went one way only, or nothing in the map has a slope.

    Notes
    -----
    One linear step from no shift, so a figure above 1 mm is rough. The standard error holds errors that frames share
    over 0.2 s.
    """
    every = thinning((source.selection.scan.frames.time_s[source.frames] for source in sources), most=MOST_FRAMES)
    parts, places, moves, blocks = [], [], [], []
    for number, source in enumerate(sources):
        way = np.ones(len(source.frames))
        for stroke in find_strokes(source, number):
            way[stroke.start : stroke.stop] = stroke.direction
        time_s = source.selection.scan.frames.time_s
        kept = every_stretch(time_s[source.frames], every)
        if not len(kept):
            continue
        coarse = CoarseFrames.of(source.selection, source.frames[kept])
        place = coarse.places_mm(source.projection.part(kept))
        move = np.zeros_like(place)
        move[:, :, 0] = way[kept[coarse.first], None]
        parts.append(coarse)
        places.append(place)
        moves.append(move)
        blocks.append(coarse.blocks(time_s))
    if not parts:
        return {}
    ways = np.concatenate([move[:, 0, 0] for move in moves])
    if not (np.any(ways > 0) and np.any(ways < 0)):
        return {}
    return _step(ShiftFit.of(parts, places), moves, blocks)


def _step(
    fit: ShiftFit, moves: Sequence[FloatArray], blocks: Sequence[np.ndarray[tuple[int, ...], np.dtype[np.intp]]]
) -> dict[str, float]:
    design = fit.design(moves)
    whole = float(design @ design)
    if not whole > 0:
        return {}
    # a lump that is ahead of its place is seen at places that are behind theirs
    lag = -float(design @ fit.data) / whole
    starts = np.cumsum([0, *(int(one.max()) + 1 for one in blocks)])
    block = np.concatenate([one + start for one, start in zip(blocks, starts, strict=False)])[fit.frame_numbers()]
    scores = np.bincount(block, design * (fit.data + lag * design))
    return {"stroke_lag_mm": lag, "stroke_lag_sd_mm": float(np.sqrt(np.sum(scores**2))) / whole}
