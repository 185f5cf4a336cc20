"""The report of a comparison of visits: declared as its file has it, made, and in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import UNSET, Meta, Record, UnsetType
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import Chance, EstimateReport, Findings, Interval, Judgement, Number1, Report
from tactile_bayes.findings import capitalised, finding_lines, finding_summary, first_lines
from tactile_bayes.findings import verdict as verdict_of
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.options import CompareOptions, NonNegative, Positive
from tactile_bayes.posterior.verdict import chance_text
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_document import share_words
from tactile_bayes.report.estimate_text import spread_percent
from tactile_bayes.report.pages import Growth, signed
from tactile_bayes.size.pooling import Repeatability
from tactile_bayes.size.visits import VOLUME, Change, JointSizes, VisitComparison, straight_line

# --- The report, as `compare --json` prints it.

COMPARE: Final = "tactile-bayes/compare/1"
VERDICT_PROBABILITY: Final = 0.95
"""Probability of the interval that leaves out no change where a growth, or a shrinkage, is called one."""


class VisitMap(Record):
    """One of the maps of a visit."""

    map: str
    status: Literal["estimate", "no_estimate"]
    reason: str
    detected_probability: float | None


class Visit(Record):
    """A visit with its size and its maps."""

    visit: Number1
    day: float | None  #: Days from the first visit; null where not given.
    max_size_mm: Quantity | None  #: Largest diameter; the joint posterior's, in which the lump keeps its form.
    fat_mm: float | None
    """Depth of the fat under the head by the visit's pressure profiles; null where not all visits tell it."""
    maps: Annotated[tuple[VisitMap, ...], Meta(min_length=1)]


class VisitPlace(Record):
    """How far the mass of a later visit lies from the first visit's."""

    visit: Annotated[int, Meta(ge=2)]
    distance_mm: NonNegative | None
    sd_mm: NonNegative | None
    """SD by which one mass comes out apart between the visits, in the direction of the shift."""
    shift_mm: tuple[float, float] | None  #: x and y in the patient's frame, from the first visit's place.
    probability: Chance | None
    """That one mass comes out as far apart or farther; below 0.02 the visits are not compared."""


class GrownBy(Record):
    """Probability of a growth by more than this many percent of the diameter."""

    percent: Annotated[float, Meta(gt=-100)]
    probability: Chance


class Detectable(Record):
    """Least growth and shrinkage of the diameter whose 95 % interval would leave out no change, percent."""

    growth: NonNegative
    shrinkage: Annotated[float, Meta(ge=0, le=100)]


class Rate(Interval):
    """Specific growth rate of the volume in percent per day."""

    probability: Annotated[float, Meta(gt=0, lt=1)]


class Doubling(Record):
    """Doubling time of the volume in days at the rate's median and ends; null where it does not grow."""

    median: Positive | None
    shortest: Positive | None
    longest: Positive | None


class GrowthRate(Record):
    """Growth between two visits so many days apart."""

    days: Positive
    percent_per_day: Rate
    doubling_days: Doubling


class TrendReport(Record):
    """Straight line of ln d over three visits and more."""

    visits: Annotated[int, Meta(ge=3)]
    days: Positive
    percent_per_day: Rate
    doubling_days: Doubling
    straight_line_probability: Chance | None  #: That sizes on a straight line come out as far from one or farther.


class AnotherChange(Record):
    """The change if exams of one mass differ as the paper's maps did."""

    between_map_sd: NonNegative
    percent: Quantity
    probability_grown: Chance


class ChangeReport(Record):
    """Change from the first visit to a later one."""

    earlier: Number1
    later: Annotated[int, Meta(ge=2)]
    verdict: Literal["grown", "shrunk", "no_change_shown"]
    """grown or shrunk where the 95 % interval leaves out no change."""
    log_ratio: Quantity  #: ln of the later diameter over the earlier.
    percent: Quantity  #: Change of the diameter in percent.
    probability_grown: Chance
    grown_by: tuple[GrownBy, ...]
    smallest_detectable_percent: Detectable
    growth_rate: GrowthRate | None
    another_exam: AnotherChange | None
    """The same if exams of one mass differ as the paper's maps did; null where their spread is stated."""

    @property
    def for_alike_exams_only(self) -> bool:
        """True if the change is shown only where exams repeat as simulated ones do: the verdict is by 95 %."""
        if self.verdict == "no_change_shown" or self.another_exam is None:
            return False
        q, tail = self.another_exam.percent, (1 - VERDICT_PROBABILITY) / 2
        if q.probability == VERDICT_PROBABILITY:  # its interval stands beside the words, which must not contradict it
            return q.low <= 0 <= q.high
        return tail <= self.another_exam.probability_grown <= 1 - tail


class CompareReport(Report, kw_only=True):
    """Change of a mass's size between visits."""

    schema: Literal["tactile-bayes/compare/1"]
    status: Literal["compared", "not_one_mass", "no_estimate"]
    """not_one_mass: the visits were not shown to be of one mass; no_estimate: a visit has no size."""
    verdict: Judgement
    findings: Findings
    reason: str  #: Why nothing is compared; empty otherwise.
    advice: str  #: What would help where nothing is compared.
    visits: Annotated[tuple[Visit, ...], Meta(min_length=2)]
    places: tuple[VisitPlace, ...]
    """How far the mass of each later visit lies from the first visit's, by the landmarks; null without."""
    changes: tuple[ChangeReport, ...]
    """Change from the first visit to each later one; empty where nothing is compared."""
    trend: TrendReport | None  #: Straight line of ln d over three visits and more with days; null otherwise.
    between_map_sd: NonNegative | None  #: SD of ln d between the exams of a visit, root mean square.
    repeatability: str | UnsetType = UNSET
    """How far exams of one mass lie apart at this site, where --repeatability told it"""
    left_out: tuple[str, ...]
    research_use: str
    provenance: dict[str, Any]


_IF_EXAMS_REPEAT: Final = (
    "if exams repeat as simulated ones do; if they differ as those of patients did, no change is shown"
)
"""Condition of a verdict where the site has not learned its own repeatability."""


def growths(patient: str, mass: str, visits: Sequence[str], report: CompareReport, link: str) -> list[Growth]:
    """Rows of one mass from its comparison; `visits` are codes in order of time."""
    if report.status != "compared":
        ends = visits[0], visits[-1]
        return [Growth(patient, mass, *ends, report.status, report.reason, findings=report.findings, link=link)]
    sizes = [visit.max_size_mm for visit in report.visits if visit.max_size_mm is not None]
    return [
        Growth(
            patient, mass, visits[0], visits[change.later - 1], "compared",
            _IF_EXAMS_REPEAT if change.for_alike_exams_only else "", days=report.visits[change.later - 1].day,
            sizes_mm=(sizes[0], sizes[change.later - 1]), percent=change.percent,
            verdict=change.verdict, findings=report.findings, link=link,
        )
        for change in report.changes
    ]  # fmt: skip


# --- The report of a comparison made.


def compare_report(
    compared: VisitComparison,
    visits: Sequence[Sequence[EstimateReport]],
    names: Sequence[Sequence[str]],
    comparing: CompareOptions,
    *,
    probability: float,
    provenance: Provenance,
    repeatability: Repeatability | None = None,
) -> CompareReport:
    """Report of a comparison from what `estimate` says of each visit's maps; `repeatability`: the site's, if used."""
    joint, days = compared.joint, comparing.days
    dated = [None] * len(visits) if days is None else days
    later = () if joint is None else range(1, len(visits))
    return CompareReport(
        schema=COMPARE,
        status=compared.status,
        verdict=verdict_of(compared.findings, answered=joint is not None),
        findings=compared.findings,
        reason=compared.reason,
        advice=compared.advice,
        visits=tuple(
            Visit(
                visit=i + 1,
                day=dated[i],
                max_size_mm=None if joint is None else joint.size_mm(i, probability),
                fat_mm=None if joint is None else joint.calibrations[i].fat_mm,
                maps=tuple(
                    VisitMap(name, one.status, one.reason, one.detected_probability)
                    for name, one in zip(names[i], reports, strict=True)
                ),
            )
            for i, reports in enumerate(visits)
        ),
        places=tuple(
            VisitPlace(visit, None, None, None, None)
            if one is None
            else VisitPlace(visit, one.distance_mm, one.sd_mm, one.shift_mm, one.probability)
            for visit, one in enumerate(compared.shifts, start=2)
        ),
        changes=tuple(_change_report(compared, number, comparing, probability) for number in later),
        trend=None if joint is None or days is None or len(visits) < 3 else _trend_report(joint, days, probability),
        between_map_sd=None if joint is None else joint.between_map_sd,
        repeatability=UNSET if repeatability is None else repeatability.words(),
        left_out=() if joint is None else tuple(joint.calibrations[0].omissions()),
        research_use=RESEARCH_USE,
        provenance=provenance.as_dict(),
    ).rounded


def _change_report(
    compared: VisitComparison, later: int, comparing: CompareOptions, probability: float
) -> ChangeReport:
    """Change from the first visit to a later one, and if exams of one mass differ as the paper's maps do."""
    joint, another, days = compared.joint, compared.another, comparing.days
    assert joint is not None
    change, another_change, rate = joint.change(0, later), None, None
    growth, shrinkage = change.smallest_detectable(VERDICT_PROBABILITY)
    if another is not None:
        other = another.change(0, later)
        another_change = AnotherChange(another.between_map_sd, other.percent(probability), other.probability_above(0.0))
    if days is not None:
        q, apart = change.log_summary(probability), days[later] - days[0]
        rate = GrowthRate(
            apart, *growth_rates([VOLUME * one / apart for one in (q.median, q.low, q.high)], probability)
        )
    return ChangeReport(
        earlier=1,
        later=later + 1,
        verdict=verdict(change),
        log_ratio=change.log_summary(probability),
        percent=change.percent(probability),
        probability_grown=change.probability_above(0.0),
        grown_by=tuple(GrownBy(100.0 * share, change.probability_above(share)) for share in comparing.grown_by),
        smallest_detectable_percent=Detectable(100.0 * growth, 100.0 * shrinkage),
        growth_rate=rate,
        another_exam=another_change,
    )


def verdict(change: Change) -> Literal["grown", "shrunk", "no_change_shown"]:
    """``"grown"`` or ``"shrunk"`` where the 95 % interval leaves out no change, else ``"no_change_shown"``."""
    q = change.log_summary(VERDICT_PROBABILITY)
    if q.low > 0.0:
        return "grown"
    return "shrunk" if q.high < 0.0 else "no_change_shown"


def growth_rates(growth: Sequence[float], probability: float) -> tuple[Rate, Doubling]:
    """A growth rate in percent of the volume per day, and the doubling times, at its median and its ends."""
    median, low, high = (100.0 * one for one in growth)
    times = Doubling(*(float(np.log(2.0) / growth[i]) if growth[i] > 0 else None for i in (0, 2, 1)))
    return Rate(median, low, high, probability), times


def _trend_report(joint: JointSizes, days: Sequence[float], probability: float) -> TrendReport:
    line = straight_line(*joint.moments, days)
    half = float(ndtri(0.5 + probability / 2)) * line.sd
    rates = growth_rates([VOLUME * (line.per_day + one) for one in (0.0, -half, half)], probability)
    return TrendReport(len(days), days[-1] - days[0], *rates, line.departure)


# --- A comparison of visits as text.

MORE: Final = "More (maps, every visit, growth rates, omissions): compare -v."
_MOST_VISITS: Final = 3  #: Visits that a short report names one by one.


def compare_summary(report: CompareReport) -> str:
    """Report in at most 12 lines; `compare_text` gives the rest."""
    lines = [*finding_summary(report.findings, "caution"), verdict_sentence(report)]
    more, visits = [], report.visits
    if report.status == "compared":
        shown = visits if len(visits) <= _MOST_VISITS else (visits[0], visits[-1])
        lines += [*_change_lines(report.changes[-1]), *rate_sentences(report)[:1], *_site_line(report)]
        lines += [*map(_visit_line, shown), *_place_line(report.places[-1])]
        more = [MORE]
    else:
        bare = [(visit.visit, one.reason) for visit in visits for one in visit.maps if one.status != "estimate"]
        lines += first_lines([f"Visit {number}: {reason}." for number, reason in bare], 4, ": -v.")
    return "\n".join([*lines, *finding_summary(report.findings, "check", most=2), *more, RESEARCH_USE]) + "\n"


def compare_text(report: CompareReport) -> str:
    """Full report."""
    lines = finding_lines(report.findings, "caution")
    for change in report.changes:
        lines += [_verdict_line(change), *_change_lines(change), *_rate_lines(change), ""]
    lines += [] if report.trend is None else [*_trend_lines(report.trend), ""]
    for visit in report.visits:
        lines.append(_visit_line(visit))
        for visit_map in visit.maps:
            outcome = "lump found" if visit_map.status == "estimate" else f"no estimate ({visit_map.reason})"
            lines.append(f"  {visit_map.map}: {outcome}")
    for place in report.places:
        lines += _place_line(place, name=len(report.places) > 1)
    lines += finding_lines(report.findings, "check")
    if report.status != "compared":
        return "\n".join([*lines, _refusal(report), RESEARCH_USE]) + "\n"
    known = [visit.fat_mm for visit in report.visits if visit.fat_mm is not None]
    all_known = len(known) == len(report.visits)
    depth = f"; fat under the head {', '.join(f'{one:.1f}' for one in known)} mm deep by visit" if all_known else ""
    sd = report.between_map_sd
    spread = "" if sd is None else f"exams of a visit differ by {spread_percent(sd)}"
    lines += _site_line(report)
    lines.append(f"Model: one body, whose hidden properties cancel in the change; {spread}{depth}.")
    if report.left_out:
        lines.append(f"Left out: {'; '.join(report.left_out)}.")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


# --- The same in sentences, for the page.


def verdict_sentence(report: CompareReport) -> str:
    """Verdict on the change, or the reason why visits are not compared."""
    return _verdict_line(report.changes[-1]) if report.status == "compared" else _refusal(report)


def change_sentences(report: CompareReport) -> list[str]:
    """Change to the last visit, its odds, and the spread between exams that they suppose."""
    if report.status != "compared":
        return []
    change, odds, *another = _change_lines(report.changes[-1])
    return [change, odds, *_site_line(report), *another]


def rate_sentences(report: CompareReport) -> list[str]:
    """The trend over three visits and more, or the growth rate between two; empty without days."""
    if report.trend is not None:
        return _trend_lines(report.trend)
    return _rate_lines(report.changes[-1]) if report.changes else []


def _refusal(report: CompareReport) -> str:
    """Reason why visits are not compared, with the remedy."""
    head = "Not compared: not shown to be one mass" if report.status == "not_one_mass" else "Not compared"
    advice = f" {capitalised(report.advice)}." if report.advice else ""
    return f"{head}: {report.reason}.{advice}"


def _visit_line(visit: Visit) -> str:
    estimates = sum(one.status == "estimate" for one in visit.maps)
    maps = f"{estimates} of {len(visit.maps)} maps" if len(visit.maps) > 1 else "1 map"
    day = "" if visit.day is None or visit.visit == 1 else f", day {visit.day:g}"
    head = f"Visit {visit.visit} ({maps}{day})"
    q = visit.max_size_mm
    if q is None:
        return f"{head}: no size"
    return f"{head}: largest size {q.median:.1f} mm ({q.low:.1f} to {q.high:.1f}, {share_words(q)} interval)"


def _place_line(place: VisitPlace, *, name: bool = False) -> list[str]:
    if place.distance_mm is None:
        return []
    which = f" of visit {place.visit}" if name else ""
    sd = f"one mass comes out apart with an SD of {place.sd_mm:.0f} mm each way"
    return [f"Place{which}: {place.distance_mm:.0f} mm from visit 1 by the landmarks ({sd})."]


def _change_lines(change: ChangeReport) -> list[str]:
    """Change and its odds; without a stated spread also both if exams of one mass differ as the paper's maps did."""
    q, another = change.percent, change.another_exam
    median, low, high = map(signed, (q.median, q.low, q.high))
    odds = [(one.percent, chance_text(one.probability, 3)) for one in change.grown_by]
    more = "".join(f"; that it has grown by more than {percent:g} %: {chance}" for percent, chance in odds)
    lines = [
        f"Change of the diameter, visit {change.earlier} to {change.later}: {median} % ({low} to {high} %, "
        f"{share_words(q)} interval).",
        f"Probability that it {_direction(change.probability_grown)}{more}.",
    ]
    if another is None:
        return lines
    ends = f"{signed(another.percent.low)} to {signed(another.percent.high)} %"
    chance = f"probability that it {_direction(another.probability_grown)}"
    return [*lines, f"If exams of one mass differ by {100 * another.between_map_sd:.0f} %: {ends}, {chance}."]


def _direction(grown: float) -> str:
    return f"has grown: {chance_text(grown, 3)}" if grown >= 0.5 else f"has shrunk: {chance_text(1.0 - grown, 3)}"


def _verdict_line(change: ChangeReport) -> str:
    least = change.smallest_detectable_percent
    text = f"the mass has {change.verdict}{f', {_IF_EXAMS_REPEAT}' if change.for_alike_exams_only else ''}."
    if change.verdict == "no_change_shown":
        text = (
            f"no change shown; a growth of less than {least.growth:.0f} % or a shrinkage of less than "
            f"{least.shrinkage:.0f} % can stay unseen"
        )
        text += "." if change.another_exam is None else "; larger ones too, if exams differ as those of patients did."
    asked = change.percent.probability == VERDICT_PROBABILITY
    return capitalised(text) if asked else f"By the {100 * VERDICT_PROBABILITY:g} % interval: {text}"


def _rate_lines(change: ChangeReport) -> list[str]:
    rate = change.growth_rate
    return [] if rate is None else [f"Growth rate over {rate.days:g} days: {_rate_words(rate)}."]


def _trend_lines(trend: TrendReport) -> list[str]:
    lines = [f"Trend over {trend.visits} visits in {trend.days:g} days: {_rate_words(trend)}."]
    if (p := trend.straight_line_probability) is not None and p < 0.05:
        lines.append(f"The sizes do not follow one steady growth (probability {chance_text(p, 3)}): see the changes.")
    return lines


def _rate_words(rate: GrowthRate | TrendReport) -> str:
    q, times = rate.percent_per_day, rate.doubling_days
    words = f"{q.median:+.2f} % of the volume a day ({q.low:+.2f} to {q.high:+.2f} %)"
    if times.shortest is None:
        return words
    if times.longest is None:
        return f"{words}, doubling in no less than {times.shortest:.0f} days"
    return f"{words}, doubling in {times.median:.0f} days ({times.shortest:.0f} to {times.longest:.0f})"


def _site_line(report: CompareReport) -> list[str]:
    """The site's learned spread between exams, which intervals and smallest detectable change suppose; else none."""
    words = report.site_words
    return [f"{capitalised(words)}; the figures above are for such exams."] if words else []
