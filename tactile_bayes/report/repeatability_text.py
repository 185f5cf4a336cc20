"""A site's repeatability as text for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.spread import PAPER_SPREAD

_MOST_NAMED: Final = 5
FEW: Final = 5
"""Masses below which the report says that they are few."""


def repeatability_text(document: Mapping[str, Any]) -> str:
    """Report of what repeated exams say of a site, see data_schema/repeatability.schema.json."""
    calibration = document["calibration"]
    median, low, high = (100 * document[name] for name in ("median", "low", "high"))
    lines = [
        *_cautions(document),
        f"Exams of one mass differ by {median:.1f} % at this site (95 %: {low:.1f} to {high:.1f}): SD of ln d beyond "
        "the errors that each map has anyway.",
        f"Learned from {document['masses']} masses and {document['maps']} exams, sized by {calibration['name']} "
        f"(frames normalised by {calibration['normalise']}). Maps of one mass in the paper differed by "
        f"{100 * PAPER_SPREAD:.0f} %.",
        *_half_width(document),
        *_names("Took no part", document["left_out"]),
        "Use it: tactile-bayes estimate MAP.nc --repeatability SITE.json",
    ]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _cautions(document: Mapping[str, Any]) -> list[str]:
    """What to look at before the figure: masses that lie apart, and few masses."""
    apart = [
        f"{one['name']} (probability by chance {_chance(one['by_chance'])})"
        for one in document["repeats"]
        if one["name"] in document["outlying"]
    ]
    lead = "CAUTION: exams lie further apart than the other masses lead one to expect; look at the maps of"
    lines = _names(lead, apart)
    if document["masses"] < FEW:
        lines.append(f"CAUTION: {document['masses']} masses are few; the interval of the spread is wide.")
    return lines


def _chance(probability: float) -> str:
    return "below 0.0001" if probability < 1e-4 else f"{probability:.2g}"


def _half_width(document: Mapping[str, Any]) -> list[str]:
    found = document.get("half_width")
    if found is None:
        return []
    before, after = 100 * found["as_estimated"], 100 * found["with_it"]
    return [f"The 95 % interval of one exam: about +-{after:.0f} % of the size with it, +-{before:.0f} % as estimated."]


def _names(lead: str, texts: Sequence[str]) -> list[str]:
    if not texts:
        return []
    more = f" and {len(texts) - _MOST_NAMED} more" if len(texts) > _MOST_NAMED else ""
    return [f"{lead}: {'; '.join(texts[:_MOST_NAMED])}{more}."]
