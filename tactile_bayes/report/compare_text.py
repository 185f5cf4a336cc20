"""A comparison of visits as text: the change of size in words that its odds carry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from tactile_bayes.findings import finding_lines, finding_summary, findings_in
from tactile_bayes.presets import RESEARCH_USE

MORE: Final = "More (maps, every visit, growth rates, omissions): compare -v."
_MOST_VISITS: Final = 3
"""Visits that a short report names one by one."""


def compare_summary(document: Mapping[str, Any]) -> str:
    """Report in at most 12 lines; `compare_text` gives the rest."""
    findings = findings_in(document["findings"])
    lines = finding_summary(findings, "caution", most=2)
    if document["status"] != "compared":
        checks = finding_summary(findings, "check", most=2)
        return "\n".join([*lines, *_refusal(document), *checks, RESEARCH_USE]) + "\n"
    last = document["changes"][-1]
    visits = document["visits"]
    shown = visits if len(visits) <= _MOST_VISITS else [visits[0], visits[-1]]
    lines += [_visit_line(one) for one in shown]
    lines += _place_line(document["places"][-1])
    lines += [_change_line(last), _odds_line(last), _verdict_line(last)]
    lines += _rate_lines(document, last)[:1] + _site_line(document) + _another_line(last)
    lines += finding_summary(findings, "check", most=2)
    return "\n".join([*lines, MORE, RESEARCH_USE]) + "\n"


def compare_text(document: Mapping[str, Any]) -> str:
    """Full report."""
    findings = findings_in(document["findings"])
    lines = finding_lines(findings, "caution")
    for one in document["visits"]:
        lines += [_visit_line(one), *(f"  {_map_line(found)}" for found in one["maps"])]
    for place in document["places"]:
        lines += _place_line(place, name=len(document["places"]) > 1)
    lines += finding_lines(findings, "check")
    if document["status"] != "compared":
        return "\n".join([*lines, *_refusal(document), RESEARCH_USE]) + "\n"
    for change in document["changes"]:
        lines += ["", _change_line(change), _odds_line(change), _verdict_line(change)]
        lines += _rate_lines({"trend": None}, change) + _another_line(change)
    lines += [""] if document["trend"] is not None else []
    lines += _trend_lines(document["trend"])
    lines += [*_site_line(document), _model_line(document)]
    if document["left_out"]:
        lines.append(f"Left out: {'; '.join(document['left_out'])}.")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _refusal(document: Mapping[str, Any]) -> list[str]:
    """Why nothing is compared, and what would help."""
    head = "Not compared: not shown to be one mass" if document["status"] == "not_one_mass" else "Not compared"
    advice = f" {document['advice'][0].upper()}{document['advice'][1:]}." if document["advice"] else ""
    return [f"{head}: {document['reason']}.{advice}"]


def _visit_line(visit: Mapping[str, Any]) -> str:
    found = sum(one["status"] == "estimate" for one in visit["maps"])
    maps = f"{found} of {len(visit['maps'])} maps" if len(visit["maps"]) > 1 else "1 map"
    day = "" if visit["day"] is None or visit["visit"] == 1 else f", day {visit['day']:g}"
    head = f"Visit {visit['visit']} ({maps}{day})"
    q = visit["max_size_mm"]
    if q is None:
        return f"{head}: no size"
    return f"{head}: largest size {q['median']:.1f} mm ({q['low']:.1f} to {q['high']:.1f}, {_share(q)} interval)"


def _map_line(one: Mapping[str, Any]) -> str:
    found = one["status"] == "estimate"
    return f"{one['map']}: lump found" if found else f"{one['map']}: no estimate ({one['reason']})"


def _place_line(place: Mapping[str, Any], *, name: bool = False) -> list[str]:
    if place["distance_mm"] is None:
        return []
    which = f" of visit {place['visit']}" if name else ""
    sd = f"one mass comes out apart with an SD of {place['sd_mm']:.0f} mm each way"
    return [f"Place{which}: {place['distance_mm']:.0f} mm from visit 1 by the landmarks ({sd})."]


def _change_line(change: Mapping[str, Any]) -> str:
    q, pair = change["percent"], f"Change of the diameter, visit {change['earlier']} to {change['later']}"
    median, low, high = (_signed(q[name]) for name in ("median", "low", "high"))
    return f"{pair}: {median} % ({low} to {high} %, {_share(q)} interval)."


def _odds_line(change: Mapping[str, Any]) -> str:
    more = "".join(
        f"; that it has grown by more than {one['percent']:g} %: {_odds(one['probability'])}"
        for one in change["grown_by"]
    )
    return f"Probability that it {_direction(change)}{more}."


def _direction(figures: Mapping[str, Any]) -> str:
    """The likelier direction with its probability, worded alike for both."""
    grown = figures["probability_grown"]
    return f"has grown: {_odds(grown)}" if grown >= 0.5 else f"has shrunk: {_odds(1.0 - grown)}"


def _verdict_line(change: Mapping[str, Any]) -> str:
    if change["verdict"] != "no_change_shown":
        return f"The mass has {change['verdict']}."
    growth, shrinkage = (f"{change['smallest_detectable_percent'][name]:.0f} %" for name in ("growth", "shrinkage"))
    return f"No change shown; a growth of less than {growth} or a shrinkage of less than {shrinkage} can stay unseen."


def _rate_lines(document: Mapping[str, Any], change: Mapping[str, Any]) -> list[str]:
    """Growth rate: by the straight line through all visits where there is one, else between two."""
    if document["trend"] is not None:
        return _trend_lines(document["trend"])
    rate = change["growth_rate"]
    return [] if rate is None else [f"Growth rate over {rate['days']:g} days: {_rate_words(rate)}."]


def _trend_lines(trend: Mapping[str, Any] | None) -> list[str]:
    if trend is None:
        return []
    lines = [f"Trend over {trend['visits']} visits in {trend['days']:g} days: {_rate_words(trend)}."]
    chance = trend["straight_line_probability"]
    if chance is not None and chance < 0.05:
        lines.append(f"The sizes are no straight line of ln d over time (probability {chance:.3f}): see the changes.")
    return lines


def _rate_words(rate: Mapping[str, Any]) -> str:
    q, times = rate["percent_per_day"], rate["doubling_days"]
    words = f"{q['median']:+.2f} % of the volume a day ({q['low']:+.2f} to {q['high']:+.2f} %)"
    if times["shortest"] is None:
        return words
    if times["longest"] is None:
        return f"{words}, doubling in no less than {times['shortest']:.0f} days"
    return f"{words}, doubling in {times['median']:.0f} days ({times['shortest']:.0f} to {times['longest']:.0f})"


def _another_line(change: Mapping[str, Any]) -> list[str]:
    another = change["another_exam"]
    if another is None:
        return []
    q, spread = another["percent"], 100 * another["between_map_sd"]
    odds = f"{_signed(q['low'])} to {_signed(q['high'])} %, probability that it {_direction(another)}"
    return [f"If exams of one mass differ by {spread:.0f} %: {odds}."]


def _site_line(document: Mapping[str, Any]) -> list[str]:
    """Whose spread between exams the intervals and the smallest detectable change suppose, where it was learned."""
    words = document.get("repeatability", "")
    return [f"{words[0].upper()}{words[1:]}; the figures above are for such exams."] if words else []


def _model_line(document: Mapping[str, Any]) -> str:
    spread = f"exams of a visit differ by {100 * document['between_map_sd']:.0f} %"
    told = [one["fat_mm"] for one in document["visits"]]
    depth = "" if None in told else f"; fat under the head {', '.join(f'{one:.1f}' for one in told)} mm deep by visit"
    return f"Model: one body, whose hidden properties cancel in the change; {spread}{depth}."


def _signed(percent: float) -> str:
    """Whole percent with its sign; none has no sign."""
    return f"{round(percent):+d}" if round(percent) else "0"


def _odds(probability: float) -> str:
    if probability > 0.999:
        return ">0.999"
    return "<0.001" if probability < 0.001 else f"{probability:.3f}"


def _share(q: Mapping[str, Any]) -> str:
    return f"{100 * q['probability']:g} %"
