"""What a map's figures say against the assumptions of a size: even layers, flat skin, a lump that stays where it is.

Bodies simulated with one of these broken decide the limits (docs/decisions/0103): a flag is silent on bodies without
stress, and a caution stands where sizes lay outside their intervals more often than they say.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from tactile_bayes.findings import Finding

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
LEAST_COVERAGE = 0.5
"""A strip of the plane narrower than the head itself shows no lump's flanks."""
MOST_TILT_DEG = 10.0
MOST_YAW_DEG = 15.0
_ERRORS = 2.5
"""Standard errors by which a figure must exceed 0, besides its limit."""


def broken_assumptions(quality: Mapping[str, float]) -> tuple[Finding, ...]:
    """What a map's figures say against the assumptions of a size.

    Parameters
    ----------
    quality
        A map's figures, see `evenness.evenness_figures` and `stroke_lag.stroke_lag_figures`; missing ones say nothing.
    """
    found = (_lag(quality), _uneven(quality), _curved(quality), _few_strokes(quality))
    return tuple(one for one in found if one is not None)


def handling_findings(quality: Mapping[str, float]) -> tuple[Finding, ...]:
    """What a map's figures say against how the head was held and the array read; parameters as above."""
    return tuple(_handling(quality))


def _handling(quality: Mapping[str, float]) -> Iterator[Finding]:
    if quality.get("saturated_readings"):
        text = f"{quality['saturated_readings']:.0f} readings at full scale were left out: the map is too low there"
        yield Finding("saturated_readings", text)
    if quality.get("clipped_values"):
        yield Finding("clipped_values", f"{quality['clipped_values']:.0f} values beyond the map's range were clipped")
    if quality.get("gain_unsettled"):
        text = "the frames' gains had not settled when the solver stopped"
        remedy = "use --normalise mean, or scan with overlapping strokes"
        yield Finding("unsettled_gains", text, remedy, "scan with overlapping strokes")
    if quality.get("coverage", 1.0) < LEAST_COVERAGE:
        text = f"only {100 * quality['coverage']:.0f} % of the map's rectangle is covered"
        add = "add strokes side by side"
        yield Finding("low_coverage", text, f"{add}, or use larger cells", add)
    if quality.get("tilt_deg", 0.0) > MOST_TILT_DEG:
        text = f"the head's face was tilted by {quality['tilt_deg']:.0f} degrees against its motion"
        check = "check the tracker's lever arm and quaternion order"
        yield Finding("tilted_head", text, check, check)
    if quality.get("yaw_sd_deg", 0.0) > MOST_YAW_DEG:
        text = f"the head was turned by {quality['yaw_sd_deg']:.0f} degrees (SD): widths across and along it are mixed"
        yield Finding("turned_head", text)


def _few_strokes(quality: Mapping[str, float]) -> Finding | None:
    strokes = quality.get("stroke_count", LEAST_STROKES)
    if strokes >= LEAST_STROKES:
        return None
    text = (
        f"the scan has {strokes:.0f} stroke{'' if strokes == 1 else 's'} only, and sizes were learned from 4 to 7 "
        "(simulated ones from 3 came out 6 % large)"
    )
    return Finding("few_strokes", text)


def _lag(quality: Mapping[str, float]) -> Finding | None:
    lag = _beyond(quality, "stroke_lag_mm", "stroke_lag_sd_mm", MOST_LAG_MM)
    if lag is None:
        return None
    ahead = lag > 0
    cause = "each dragged it along" if ahead else "poses came late against the frames"
    text = (
        f"strokes in opposite directions see the lump some {2 * abs(lag):.0f} mm apart, as if {cause}: the size may be "
        "off by more than its interval"
    )
    if ahead:
        return Finding(
            "lump_dragged",
            text,
            "map again with --register-strokes",
            "map the scan again with its strokes aligned to each other",
        )
    return Finding(
        "late_poses", text, "map again with --latency-ms auto", "map the scan again with the tracker's delay estimated"
    )


def _curved(quality: Mapping[str, float]) -> Finding | None:
    curvature = quality.get("skin_curvature_per_m", 0.0)
    if not abs(curvature) > MOST_CURVATURE_PER_M:
        return None
    shape = "convex" if curvature > 0 else "hollow"
    text = (
        f"the head turned as on {shape} skin of radius {1000 / abs(curvature):.0f} mm, and sizes are for flat skin "
        "(on radii of 75 and 150 mm simulated ones moved by 7 %)"
    )
    return Finding("curved_skin", text)


def _uneven(quality: Mapping[str, float]) -> Finding | None:
    """Of a profile that changes so far that sizes fail, or of one that changes less."""
    change = _beyond(quality, "profile_change", "profile_change_sd", MOST_PROFILE_CHANGE)
    if change is None:
        return None
    far = change > BROKEN_PROFILE_CHANGE
    end = "the size may be off by more than its interval" if far else "the size is for even fat"
    text = (
        f"the head's pressure profile changes over the map (by {change:.3f} in 30 mm): the fat is of uneven depth, or "
        f"a rib or another lump lies near; {end}"
    )
    return Finding("uneven_fat" if far else "slightly_uneven_fat", text)


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
