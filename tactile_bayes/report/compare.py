"""A comparison of visits in words and as a document."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.findings import Finding, finding_lines, finding_summary, findings_in
from tactile_bayes.findings import verdict as verdict_of
from tactile_bayes.inference.draws import nine_digits
from tactile_bayes.inference.points import normal_quantile
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.visits import VOLUME, Trend, doubling_days, straight_line

if TYPE_CHECKING:
    from tactile_bayes.size.pooling import Repeatability
    from tactile_bayes.size.visits import Apart, Change, Compared, JointSizes


# --- Growth of masses between visits, as `compare` told it: rows of a table and a section of a page.

HEADS: Final = ("mass", "visits", "days", "earlier mm", "later mm", "change", "")
_VERDICTS: Final = {"grown": "grown", "shrunk": "shrunk", "no_change_shown": "no change shown"}
_NOTE: Final = (
    "Change of the largest diameter from the first visit; intervals in brackets. What the body hides "
    "from all maps cancels in it. It is no part of the errors against excision, which are of the last visit."
)


class Growth(Record, eq=False):
    """Change of one mass from its first visit to a later one."""

    patient: str
    mass: str
    earlier: str
    later: str
    """`patient`, `mass`, `earlier`, `later`: Codes; `later` is blank where the visits could not be compared."""
    status: str
    reason: str = ""
    """`status`, `reason`: As `compare` has them, or ``failed``."""
    days: float | None = None
    """Between the visits; None where it is not known."""
    sizes_mm: tuple[Mapping[str, float], ...] = ()
    """Largest size at both visits: median, ends and probability; empty without a comparison."""
    percent: Mapping[str, float] | None = None
    """Change of the diameter, likewise; None without one."""
    verdict: str = ""
    """``grown``, ``shrunk`` or ``no_change_shown``; empty without one."""
    findings: tuple[Finding, ...] = ()
    """What speaks against the comparison."""
    link: str = ""
    """File of the comparison from the page's folder; empty for none."""

    @property
    def words(self) -> str:
        """What became of the mass, or why nothing is known of it."""
        told = _VERDICTS.get(self.verdict, f"not compared: {self.reason}")
        return ". ".join([told, *finding_lines(self.findings, paper=True)])


def of_document(patient: str, mass: str, visits: Sequence[str], document: Mapping[str, Any], link: str) -> list[Growth]:
    """Rows of one mass from the JSON object of its comparison.

    Parameters
    ----------
    visits
        Codes in order of time.
    """
    if document["status"] != "compared":
        reason, last = str(document["reason"]), visits[-1]
        return [Growth(patient, mass, visits[0], last, str(document["status"]), reason, link=link)]
    found = document["visits"]
    return [
        Growth(
            patient, mass, visits[0], visits[change["later"] - 1], "compared", days=found[change["later"] - 1]["day"],
            sizes_mm=(found[0]["max_size_mm"], found[change["later"] - 1]["max_size_mm"]), percent=change["percent"],
            verdict=change["verdict"], findings=findings_in(document["findings"]), link=link,
        )
        for change in document["changes"]
    ]  # fmt: skip


def growth_line(rows: Sequence[Growth], table: str) -> str:
    """All rows in one sentence; empty without any."""
    if not rows:
        return ""
    counts = {words: sum(row.verdict == name for row in rows) for name, words in _VERDICTS.items()}
    counts["not compared"] = sum(not row.verdict for row in rows)
    masses = len({(row.patient, row.mass) for row in rows})
    told = ", ".join(f"{count} {words}" for words, count in counts.items() if count)
    return f"growth of {masses} mass{'es' * (masses > 1)} with several visits: {told} ({table})"


def growth_section(rows: Sequence[Growth]) -> Iterator[str]:
    """Section of a page; nothing without rows. Every text is escaped."""
    if not rows:
        return
    yield '<section class="growth"><h2>Growth between visits</h2>'
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in HEADS)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in _cells(row))}</tr>" for row in rows)
    yield f'<div class="wide" tabindex="0"><table><tr>{heads}</tr>{lines}</table></div>'
    yield f'<p class="note">{html.escape(_NOTE)}</p></section>'


def _cells(row: Growth) -> list[str]:
    name = html.escape(f"{row.patient} {row.mass}")
    sizes = [f"{q['median']:.1f} <small>[{q['low']:.1f}, {q['high']:.1f}]</small>" for q in row.sizes_mm] or ["", ""]
    q = row.percent
    change = "" if q is None else f"{q['median']:+.0f} % <small>[{q['low']:+.0f}, {q['high']:+.0f}]</small>"
    return [
        f'<a href="{html.escape(row.link)}">{name}</a>' if row.link else name,
        html.escape(f"{row.earlier} to {row.later}"),
        "" if row.days is None else f"{row.days:g}",
        *sizes,
        change,
        html.escape(row.words),
    ]


# --- A comparison of visits as plain data: the object that `compare --json` prints.

SCHEMA: Final = "tactile-bayes/compare/1"
SHOWN: Final = 0.95
"""Probability of the interval that leaves out no change where a growth, or a shrinkage, is called one."""


def compare_document(
    compared: Compared,
    visits: Sequence[Sequence[Mapping[str, Any]]],
    names: Sequence[Sequence[str]],
    *,
    days: Sequence[float] | None,
    grown_by: Sequence[float],
    probability: float,
    provenance: Provenance,
    repeatability: Repeatability | None = None,
) -> dict[str, Any]:
    """JSON object of a comparison, see data_schema/compare.schema.json.

    Parameters
    ----------
    visits, names
        What `estimate` says of each visit's maps, and the maps' names.
    days
        Time of each visit; None where it is not known.
    grown_by
        Shares of the diameter.
    repeatability
        Of the site, where the comparison used one.
    """
    joint = compared.joint
    changes: list[dict[str, Any]] = []
    if joint is not None:
        changes = [
            _change(joint, compared.another, later, days=days, grown_by=grown_by, probability=probability)
            for later in range(1, len(visits))
        ]
    used = None if joint is None else joint.calibrations[0]
    return {
        "schema": SCHEMA,
        "status": compared.status,
        "verdict": verdict_of(compared.findings, answered=joint is not None),
        "findings": [one.as_dict() for one in compared.findings],
        "reason": compared.reason,
        "advice": compared.advice,
        "visits": [
            _visit(i, visits[i], names[i], joint, day=None if days is None else days[i], probability=probability)
            for i in range(len(visits))
        ],
        "places": [_apart(number, one) for number, one in enumerate(compared.apart, start=2)],
        "changes": changes,
        "trend": None if joint is None or days is None or len(visits) < 3 else _trend(joint, days, probability),
        "between_map_sd": None if joint is None else nine_digits(joint.between_map_sd),
        **({} if repeatability is None else {"repeatability": repeatability.words()}),
        "left_out": [] if used is None else used.omissions(),
        "research_use": RESEARCH_USE,
        "provenance": provenance.as_dict(),
    }


def _visit(
    index: int,
    documents: Sequence[Mapping[str, Any]],
    names: Sequence[str],
    joint: JointSizes | None,
    *,
    day: float | None,
    probability: float,
) -> dict[str, Any]:
    fat_mm = None if joint is None else joint.calibrations[index].fat_mm
    return {
        "visit": index + 1,
        "day": day,
        "max_size_mm": None if joint is None else joint.size_mm(index, probability).as_dict(),
        "fat_mm": None if fat_mm is None else nine_digits(fat_mm),
        "maps": [
            {"map": name, **{key: one.get(key) for key in ("status", "reason", "detected_probability")}}
            for name, one in zip(names, documents, strict=True)
        ],
    }


def _apart(visit: int, found: Apart | None) -> dict[str, Any]:
    """How far a visit's mass lies from the first's."""
    if found is None:
        return {"visit": visit, "distance_mm": None, "sd_mm": None, "shift_mm": None, "probability": None}
    return {
        "visit": visit,
        "distance_mm": nine_digits(found.distance_mm),
        "sd_mm": nine_digits(found.sd_mm),
        "shift_mm": [nine_digits(value) for value in found.shift_mm],
        "probability": nine_digits(found.probability),
    }


def _change(
    joint: JointSizes,
    another: JointSizes | None,
    later: int,
    *,
    days: Sequence[float] | None,
    grown_by: Sequence[float],
    probability: float,
) -> dict[str, Any]:
    """Change from the first visit to a later one."""
    change = joint.change(0, later)
    growth, shrinkage = (nine_digits(100.0 * share) for share in change.smallest_detectable(SHOWN))
    return {
        "earlier": 1,
        "later": later + 1,
        "verdict": verdict(change),
        "log_ratio": change.log_summary(probability).as_dict(),
        "percent": change.percent(probability).as_dict(),
        "probability_grown": nine_digits(change.probability_above(0.0)),
        "grown_by": [
            {"percent": nine_digits(100.0 * share), "probability": nine_digits(change.probability_above(share))}
            for share in grown_by
        ],
        "smallest_detectable_percent": {"growth": growth, "shrinkage": shrinkage},
        "growth_rate": None if days is None else _rate(change, days[later] - days[0], probability),
        "another_exam": None if another is None else _another(another, later, probability),
    }


def verdict(change: Change) -> str:
    """``"grown"`` or ``"shrunk"`` where the 95 % interval leaves out no change, else ``"no_change_shown"``."""
    q = change.log_summary(SHOWN)
    if q.low > 0.0:
        return "grown"
    return "shrunk" if q.high < 0.0 else "no_change_shown"


def _another(another: JointSizes, later: int, probability: float) -> dict[str, Any]:
    """The change if exams of one mass differ as the paper's maps do."""
    change = another.change(0, later)
    return {
        "between_map_sd": nine_digits(another.between_map_sd),
        "percent": change.percent(probability).as_dict(),
        "probability_grown": nine_digits(change.probability_above(0.0)),
    }


def _rate(change: Change, days: float, probability: float) -> dict[str, Any]:
    """Specific growth rate of the volume between two visits."""
    q = change.log_summary(probability)
    median, low, high = (VOLUME * one / days for one in (q.median, q.low, q.high))
    return _rates(days, median, (low, high), probability=probability)


def _rates(days: float, median: float, ends: tuple[float, float], *, probability: float) -> dict[str, Any]:
    """A growth rate in percent of the volume per day, and the doubling times at its median and its ends."""
    low, high = ends
    times = {"median": doubling_days(median), "shortest": doubling_days(high), "longest": doubling_days(low)}
    return {
        "days": days,
        "percent_per_day": {
            "median": nine_digits(100.0 * median),
            "low": nine_digits(100.0 * low),
            "high": nine_digits(100.0 * high),
            "probability": probability,
        },
        "doubling_days": {name: None if one is None else nine_digits(one) for name, one in times.items()},
    }


def _trend(joint: JointSizes, days: Sequence[float], probability: float) -> dict[str, Any]:
    """Straight line of ln d over all visits."""
    line: Trend = straight_line(*joint.moments, days)
    half = float(normal_quantile(np.array(0.5 + probability / 2))) * line.sd
    ends = VOLUME * (line.per_day - half), VOLUME * (line.per_day + half)
    departure = None if line.departure is None else nine_digits(line.departure)
    rates = _rates(days[-1] - days[0], VOLUME * line.per_day, ends, probability=probability)
    return {"visits": len(days), **rates, "straight_line_probability": departure}


# --- A comparison of visits as text: the change of size in words that its odds carry.

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
