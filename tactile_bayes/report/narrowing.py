"""Sources of a size interval's width, remedies, and the pieces of short reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tactile_bayes.report.size_text import SOURCES

MOST_LINES = 12
"""Of a short report."""
MORE = "More (all quantities, places looked at, odds, priors, omissions): estimate -v."
"""The end of a short report's last line but one."""
NARROWED_BY = {
    "map": "a slower scan with more strokes over the lump",
    "between_maps": "more exams of this mass, pooled (estimate --pool); the site's spread (calibrate repeatability)",
    "calibration": "a size calibration learned from more lumps",
    "residual": "a size calibration learned with this head and bodies like this one",
    "site": "more phantoms of known size, depth, seat and stiffness (calibrate size --correct)",
    "body": "knowing the lump's depth, seat or stiffness (estimate --known)",
}
WORTH_NARROWING = 10.0
"""Percent of the variance from which a source is worth a way to narrow it."""


def width_lines(variance_share: Mapping[str, float]) -> list[str]:
    """Sources of a size's variance, largest first, and ways to narrow the interval.

    Parameters
    ----------
    variance_share
        Percent of the variance of the largest size, by source.
    """
    ranked = sorted(variance_share.items(), key=lambda pair: -pair[1])
    parts = [f"{share:.0f} % {SOURCES.get(name, name)}" for name, share in ranked if share >= 0.5]
    ways = [NARROWED_BY[name] for name, share in ranked if share >= WORTH_NARROWING and name in NARROWED_BY]
    lines = [f"What makes the interval wide: {', '.join(parts)}."] if parts else []
    return [*lines, f"What would narrow it: {'; '.join(ways)}."] if ways else lines


def joined(texts: Sequence[str], *, most: int, lead: str) -> list[str]:
    """Join the first texts in one line after `lead`, and count the others; empty for no text."""
    if not texts:
        return []
    more = f" (and {len(texts) - most} more)" if len(texts) > most else ""
    return [f"{lead}{'; '.join(texts[:most])}{more}."]
