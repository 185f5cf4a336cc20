"""What a map's figures say against the assumptions of a size: even layers, flat skin, a lump that stays where it is.

Bodies simulated with one of these broken decide the limits (docs/decisions/0103): a flag is silent on bodies without
stress, and a caution stands where sizes lay outside their intervals more often than they say.
"""

from __future__ import annotations

from collections.abc import Mapping

MOST_PROFILE_CHANGE = 0.01
"""Of the head profile's second order across, over 30 mm: fat that deepens by 1 mm in 20 changes it by 0.01 to 0.06."""
BROKEN_PROFILE_CHANGE = 0.07
"""From here on sizes of simulated bodies lay outside their intervals: 1 mm in 5, or a step of 6 mm in thin fat."""
MOST_SKEW = 0.01
"""First order of the head profile, to one side along strokes: a friction coefficient of 0.1 gives 0.011 to 0.035."""
MOST_CURVATURE_PER_M = 4.0
"""Curvature of the head's path, a radius of 250 mm: rocking by 4 deg imitates up to 1.5 per m."""
MOST_LAG_MM = 1.2
"""A latency of 12 ms left in the poses makes up to 0.75 mm at a hand's 60 mm/s."""
LEAST_STROKES = 4
"""Of the exams that sizes were learned from: 3 strokes, 8 mm apart, made sizes 6 % larger (record 0123)."""
_ERRORS = 2.5
"""Standard errors by which a figure must exceed 0, besides its limit."""


def broken_assumptions(quality: Mapping[str, float]) -> tuple[str, ...]:
    """What may put a size from this map outside its interval, one sentence each without its full stop.

    Parameters
    ----------
    quality
        A map's figures, see `evenness.evenness_figures` and `stroke_lag.stroke_lag_figures`; missing ones say nothing.
    """
    return tuple(text for text in (_lag(quality), *_uneven(quality, far=True)) if text)


def assumptions_to_check(quality: Mapping[str, float]) -> tuple[str, ...]:
    """What differs from the calibration's bodies and moves a size by less than its interval, most often; as above."""
    return tuple(text for text in (_curved(quality), *_uneven(quality, far=False), _few_strokes(quality)) if text)


def _few_strokes(quality: Mapping[str, float]) -> str:
    strokes = quality.get("stroke_count", LEAST_STROKES)
    if strokes >= LEAST_STROKES:
        return ""
    return (
        f"the scan has {strokes:.0f} stroke{'' if strokes == 1 else 's'} only, and sizes were learned from 4 to 7 "
        "(simulated ones from 3 came out 6 % large)"
    )


def uneven(quality: Mapping[str, float]) -> bool:
    """Whether the head's pressure profile changes over the map; parameters as above.

    Then the frames tell the layers' tilt and not only the lump's place, so that figures by place mislead.
    """
    return bool(_uneven(quality, far=True) or _uneven(quality, far=False))


def _lag(quality: Mapping[str, float]) -> str:
    lag = _beyond(quality, "stroke_lag_mm", "stroke_lag_sd_mm", MOST_LAG_MM)
    if lag is None:
        return ""
    cause = "each dragged it along" if lag > 0 else "poses came late against the frames"
    remedy = "--register-strokes" if lag > 0 else "--latency-ms auto"
    return (
        f"strokes in opposite directions see the lump some {2 * abs(lag):.0f} mm apart, as if {cause}: the size may be "
        f"off by more than its interval; map again with {remedy}"
    )


def _curved(quality: Mapping[str, float]) -> str:
    curvature = quality.get("skin_curvature_per_m", 0.0)
    if not abs(curvature) > MOST_CURVATURE_PER_M:
        return ""
    shape = "convex" if curvature > 0 else "hollow"
    return (
        f"the head turned as on {shape} skin of radius {1000 / abs(curvature):.0f} mm, and sizes are for flat skin "
        "(on radii of 75 and 150 mm simulated ones moved by 7 %)"
    )


def _uneven(quality: Mapping[str, float], *, far: bool) -> tuple[str, ...]:
    """The sentence on a profile that changes so far that sizes fail, or on one that changes less."""
    change = _beyond(quality, "profile_change", "profile_change_sd", MOST_PROFILE_CHANGE)
    if change is None or (change > BROKEN_PROFILE_CHANGE) != far:
        return ()
    end = "the size may be off by more than its interval" if far else "the size is for even fat"
    return (
        f"the head's pressure profile changes over the map (by {change:.3f} in 30 mm): the fat is of uneven depth, or "
        f"a rib or another lump lies near; {end}",
    )


def skewed(quality: Mapping[str, float]) -> str:
    """A sentence on skin that the head drags along; no size moved by it, so it is a matter of technique."""
    skew = _beyond(quality, "stroke_skew", "stroke_skew_sd", MOST_SKEW)
    if skew is None:
        return ""
    return f"pressure is skewed along the strokes (by {abs(skew):.3f}): the skin is dragged along, use more lubricant"


def _beyond(quality: Mapping[str, float], name: str, sd_name: str, limit: float) -> float | None:
    """The figure, where it exceeds its limit and its standard error by enough."""
    value, sd = quality.get(name, 0.0), quality.get(sd_name, 0.0)
    return value if abs(value) > max(limit, _ERRORS * sd) else None
