"""The report of `compare`, declared as its file has it."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from tactile_bayes.declarations import UNSET, Meta, Record, UnsetType, field, says
from tactile_bayes.files.reports import Above0, Chance, Entries, Interval, Judgement, Least0, Number1, Report
from tactile_bayes.inference.draws import Quantity

COMPARE: Final = "tactile-bayes/compare/1"


class VisitMap(Record):
    """One of the maps of a visit."""

    map: str
    status: Literal["estimate", "no_estimate"]
    reason: str
    detected_probability: float | None


class Visit(Record):
    """A visit with its size and its maps."""

    visit: Number1
    day: Annotated[float | None, says("Days from the first visit; null where not given.")]
    max_size_mm: Annotated[
        Quantity | None, says("Largest diameter; the joint posterior's, in which the lump keeps its form.")
    ]
    fat_mm: Annotated[
        float | None,
        says("Depth of the fat under the head by the visit's pressure profiles; null where not all visits tell it."),
    ]
    maps: Annotated[tuple[VisitMap, ...], Meta(min_length=1)]


class VisitPlace(Record):
    """How far the mass of a later visit lies from the first visit's."""

    visit: Annotated[int, Meta(ge=2)]
    distance_mm: Least0 | None
    sd_mm: Annotated[
        Least0 | None, says("SD by which one mass comes out apart between the visits, in the direction of the shift.")
    ]
    shift_mm: Annotated[
        tuple[float, float] | None, says("x and y in the patient's frame, from the first visit's place.")
    ]
    probability: Annotated[
        Chance | None, says("That one mass comes out as far apart or farther; below 0.02 the visits are not compared.")
    ]


class GrownBy(Record):
    """Probability of a growth by more than this many percent of the diameter."""

    percent: Annotated[float, Meta(gt=-100)]
    probability: Chance


class Detectable(Record):
    """Least growth and shrinkage of the diameter whose 95 % interval would leave out no change, percent."""

    growth: Least0
    shrinkage: Annotated[float, Meta(ge=0, le=100)]


class Rate(Interval):
    """Specific growth rate of the volume in percent per day."""

    median: float
    low: float
    high: float
    probability: Annotated[float, Meta(gt=0, lt=1)]


class Doubling(Record):
    """Doubling time of the volume in days at the rate's median and ends; null where it does not grow."""

    median: Above0 | None
    shortest: Above0 | None
    longest: Above0 | None


class GrowthRate(Record):
    """Growth between two visits so many days apart."""

    days: Above0
    percent_per_day: Rate
    doubling_days: Doubling


class TrendReport(Record):
    """Straight line of ln d over three visits and more."""

    visits: Annotated[int, Meta(ge=3)]
    days: Above0
    percent_per_day: Rate
    doubling_days: Doubling
    straight_line_probability: Annotated[
        Chance | None, says("That sizes on a straight line come out as far from one or farther.")
    ]


class AnotherChange(Record):
    """The change if exams of one mass differ as the paper's maps did."""

    between_map_sd: Least0
    percent: Quantity
    probability_grown: Chance


class ChangeReport(Record):
    """Change from the first visit to a later one."""

    earlier: Number1
    later: Annotated[int, Meta(ge=2)]
    verdict: Annotated[
        Literal["grown", "shrunk", "no_change_shown"],
        says("grown or shrunk where the 95 % interval leaves out no change."),
    ]
    log_ratio: Annotated[Quantity, says("ln of the later diameter over the earlier.")]
    percent: Annotated[Quantity, says("Change of the diameter in percent.")]
    probability_grown: Chance
    grown_by: tuple[GrownBy, ...]
    smallest_detectable_percent: Detectable
    growth_rate: GrowthRate | None
    another_exam: Annotated[
        AnotherChange | None,
        says("The same if exams of one mass differ as the paper's maps did; null where their spread is stated."),
    ]

    @property
    def for_alike_exams_only(self) -> bool:
        """True where a change is shown, but not if exams differ as patients' did."""
        another = self.another_exam
        return (
            self.verdict != "no_change_shown"
            and another is not None
            and another.percent.low <= 0 <= another.percent.high
        )


class CompareReport(Report, kw_only=True):
    """Change of a mass's size between visits."""

    schema: Literal["tactile-bayes/compare/1"]
    status: Annotated[
        Literal["compared", "not_one_mass", "no_estimate"],
        says("not_one_mass: the visits were not shown to be of one mass; no_estimate: a visit has no size."),
    ]
    verdict: Judgement
    entries: Entries = field(name="findings")
    reason: Annotated[str, says("Why nothing is compared; empty otherwise.")]
    advice: Annotated[str, says("What would help where nothing is compared.")]
    visits: Annotated[tuple[Visit, ...], Meta(min_length=2)]
    places: Annotated[
        tuple[VisitPlace, ...],
        says("How far the mass of each later visit lies from the first visit's, by the landmarks; null without."),
    ]
    changes: Annotated[
        tuple[ChangeReport, ...],
        says("Change from the first visit to each later one; empty where nothing is compared."),
    ]
    trend: Annotated[
        TrendReport | None, says("Straight line of ln d over three visits and more with days; null otherwise.")
    ]
    between_map_sd: Annotated[Least0 | None, says("SD of ln d between the exams of a visit, root mean square.")]
    repeatability: Annotated[
        str | UnsetType, says("How far exams of one mass lie apart at this site, where --repeatability told it")
    ] = UNSET
    left_out: tuple[str, ...]
    research_use: str
    provenance: dict[str, Any]
