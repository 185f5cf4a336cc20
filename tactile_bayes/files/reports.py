"""The reports of `estimate` and `estimate --pool`, declared as their files have them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, Self

from tactile_bayes.declarations import (
    EXACT,
    UNSET,
    Meta,
    Record,
    UnsetType,
    described,
    field,
    from_plain,
    replace,
    rounded,
    to_plain,
)
from tactile_bayes.errors import BadDataError, Code
from tactile_bayes.files.documents import dump_json
from tactile_bayes.findings import Finding, Verdict
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.clock import Position
from tactile_bayes.options import NonNegative, Positive

ESTIMATE: Final = "tactile-bayes/estimate/1"
POOLED: Final = "tactile-bayes/pooled/1"
Chance = Annotated[float, Meta(ge=0, le=1)]
Number1 = Annotated[int, Meta(ge=1)]
Length = Annotated[float, Meta(gt=0, le=500)]
Diameter = Length | None
Three = tuple[Diameter, Diameter, Diameter]
ReasonCode = Literal["", Code]
Shape = Literal["round", "ellipse", "rotated"]
Findings = Annotated[
    tuple[Finding, ...], described("What speaks against the result, cautions first; see docs/formats.md")
]
Judgement = Annotated[Verdict, described("no_answer: there is no size; doubtful: a caution stands")]


class Sized(Record):
    """Base of records with sizes; `another_exam` may hold others, for exams as far apart as those of patients."""

    @property
    def leading(self) -> Self | AnotherExam:
        """The record of the sizes to give first (record 0130): this one or `another_exam`.

        Until a site's repeatability is known these are the sizes for exams as far apart as patients' (`another_exam`);
        with it, or a stated spread, there is one interval.
        """
        another: AnotherExam | None = getattr(self, "another_exam", None)
        return self if another is None else another


class Report(Sized, kw_only=True):
    """Base of all reports."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}, {getattr(self, 'verdict', '')}>"

    @property
    def document(self) -> dict[str, Any]:
        """Plain data, as the file has them."""
        return dict(to_plain(self, digits=EXACT))

    @property
    def origin(self) -> Origin:
        """Settings and inputs of the estimate."""
        return from_plain(Origin, getattr(self, "provenance", {}))

    @property
    def known_words(self) -> str:
        """Properties of the body that the size takes as known, in words; empty without any."""
        known = self.origin.settings.get("known") or {}
        words = ", ".join(f"{name} {value:g}" for name, value in known.items())
        return f"taken as known: {words}" if known else ""

    @property
    def site_words(self) -> str:
        """The site's spread between exams, in words; empty without one."""
        words = getattr(self, "repeatability", UNSET)
        return words if isinstance(words, str) else ""

    @property
    def rounded(self) -> Self:
        """The report in nine significant digits, but for diagnostics, prior and provenance."""
        names = [name for name in ("diagnostics", "prior", "provenance") if hasattr(self, name)]
        return replace(rounded(self), **{name: getattr(self, name) for name in names})

    def checked(self) -> Self:
        """The report, checked by its declaration as a file is."""
        from_plain(type(self), self.document, where="the report")
        return self


def json_text(report: Report) -> str:
    """JSON text of a report, for ``--json`` and files."""
    return dump_json(report.document)


class Place(Record):
    """A place in mm."""

    x: float
    y: float

    @property
    def median(self) -> tuple[float, float]:
        """x and y, as a `Point` has them."""
        return self.x, self.y


class Point(Record):
    """A place whose coordinates are quantities, in mm."""

    x: Quantity
    y: Quantity

    @property
    def median(self) -> tuple[float, float]:
        """The medians of x and y."""
        return self.x.median, self.y.median


def centre_of(point: Point | Place | None) -> tuple[float, float] | None:
    """x and y in mm, medians where these are quantities; None without a place."""
    return None if point is None else point.median


class Interval(Record):
    """A median with its interval."""

    median: float
    low: float
    high: float
    probability: float


class SizeInterval(Interval):
    """A size with its interval, mm."""

    median: Positive
    low: Positive
    high: Positive
    probability: Annotated[float, Meta(gt=0, lt=1)]


class Supposed(Record):
    """The largest size if one more property of the body had this value."""

    property: str
    value: float
    max_size_mm: SizeInterval


class AnotherExam(Record):
    """Sizes for exams as far apart as those of patients, with the SD of ln size between exams."""

    between_map_sd: Annotated[float, Meta(ge=0, le=5)]
    max_size_mm: Quantity
    min_size_mm: Quantity
    variance_share: dict[str, Annotated[float, Meta(ge=0, le=100)]]


SUPPOSING: Final = described(
    "How large the lump would be if more were known of the body, by name (soft, hard, centred, resting): "
    "the property, its value, and the largest size with it; null without a size"
)
LEADING: Final = described(
    "Where it is not null, the sizes that lead (record 0130): for exams as far apart as those of "
    "patients; SD of ln size between exams, and the sizes with it"
)


# --- An estimate of one map.


class SmallestAt(Record):
    """Diameters of the smallest ball that would have shown at a place, by depth; null where not even one of 30 mm."""

    x_mm: float
    y_mm: float
    d_mm: Three


class SmallestLump(Record):
    """On a map without a lump: diameters of the smallest ball that it would have shown, by depth."""

    probability: Chance
    depths_mm: tuple[Length, Length, Length]
    best_mm: Three
    worst_mm: Three
    spacing_mm: Length
    places: Annotated[tuple[SmallestAt, ...], Meta(max_length=200)]


class StructureReport(Record):
    """A question about the scene, with its answer."""

    name: str
    odds: NonNegative | None
    odds_are_a_bound: bool
    supported: bool
    used: bool
    change_sigma_x_sd: float | None
    change_sigma_y_sd: float | None
    place: str


class SceneReport(Record):
    """The scene in the fit window."""

    supported: Shape
    shape: Shape
    tilt: bool
    beside: Literal["second lump", "rib"] | None
    structures: tuple[StructureReport, ...]


class PriorSensitivity(Record):
    """Shifts by a wider prior, in posterior SDs."""

    width_prior_times: float
    median_sd: dict[str, float]
    ends_sd: dict[str, float]


class PassedOver(Record, forbid_unknown_fields=False):
    """A place that was looked at."""

    x_mm: float
    y_mm: float
    fault: str


class OtherRise(Record):
    """A mass besides the reported one, as a rise; mm on the map."""

    x_mm: float
    y_mm: float
    distance_mm: NonNegative | None
    amplitude: float
    sigma_x_mm: Positive
    sigma_y_mm: Positive
    probability: Chance


class MassReport(Sized, kw_only=True):
    """One of the masses on a map."""

    number: Number1
    reported: bool
    centre_mm: Place
    centre_patient_mm: Place | None
    detected_probability: Chance
    amplitude: Quantity | None
    max_size_mm: Quantity | None
    min_size_mm: Quantity | None
    d_x_mm: Quantity | None
    d_y_mm: Quantity | None
    angle_deg: Quantity | None
    another_exam: AnotherExam | None
    reason: str  #: Why it has no size; empty where it has one.
    reason_code: ReasonCode
    advice: str
    position: Position | None = None


class Touching(Record):
    """Two sized masses that may be one lump: their numbers, mm between their centres, and the length over both."""

    masses: tuple[Number1, Number1]
    apart_mm: NonNegative
    together_mm: Interval


class Figures(Record, forbid_unknown_fields=False):
    """Of the diagnostics of an estimate those that readers use; there are others."""

    oval_probability: Chance | None = None
    oval_half_log_ratio: Annotated[float, Meta(ge=0, le=3)] | None = None
    irregular_outline: Chance | bool | None = None
    between_map_sd: Annotated[float, Meta(ge=0, le=2)] | None = None
    fat_mm: Annotated[float, Meta(ge=0, le=500)] | None = None
    end_error_mm: NonNegative | None = None
    end_error_sd: NonNegative | None = None
    effective_draws: NonNegative | None = None
    size_calibration: str = ""

    def __post_init__(self) -> None:
        if (self.oval_probability is None) != (self.oval_half_log_ratio is None):
            what = "has one of oval_probability and oval_half_log_ratio alone"
            raise BadDataError(what, way_out="estimate the map again")


class Input(Record, forbid_unknown_fields=False):
    """An input of a file: its role and digest."""

    role: str
    sha256: str


class Origin(Record, forbid_unknown_fields=False):
    """Of a provenance what readers use; see `files.provenance.Provenance` for all of it."""

    settings: dict[str, Any] = field(default_factory=dict)
    inputs: tuple[Input, ...] = ()


class Shares(Record, forbid_unknown_fields=False):
    """Percent of the variance of a size that every calibration tells; there are other sources."""

    map: float
    calibration: float


class EstimateReport(Report, kw_only=True):
    """Estimate of one map: size with a credible interval, or why there is none."""

    schema: Literal["tactile-bayes/estimate/1"]
    status: Literal["estimate", "no_estimate"]
    verdict: Judgement
    findings: Findings
    reason: str
    reason_code: ReasonCode = ""
    advice: str = ""
    on_paper: str = ""  #: The advice for a reader of the exam's page, who has no command line
    about_mm: Place | None = None  #: Place on the map that the reason is about
    smallest_lump: SmallestLump | None = None
    """On a map without a lump: diameters in mm of the smallest ball that it would have shown with this probability, by
    depth; null where not even a ball of 30 mm
    """
    max_size_mm: Quantity | None
    min_size_mm: Quantity | None
    d_x_mm: Quantity | None
    d_y_mm: Quantity | None
    amplitude: Quantity | None
    sigma_x_mm: Quantity | None
    sigma_y_mm: Quantity | None
    background: Quantity | None
    noise_sd: Quantity | None
    another_exam: Annotated[AnotherExam | None, LEADING] = None
    supposing: Annotated[dict[str, Supposed] | None, SUPPOSING] = None
    centre_mm: Point | None
    centre_patient_mm: Point | None = None
    """mm from the xiphoid: x to the patient's right, y towards the sternal notch"""
    position: Position | None = None
    """Place of the lump about the nipple, as the examiner sees it who faces the patient: hours on the clock, 12 towards
    the head, and mm along the map; null without a nipple, notch and xiphoid, or a side
    """
    angle_deg: Quantity | None
    detected_probability: Chance | None
    variance_share: dict[str, float] | None
    scene: SceneReport | None = None
    prior_sensitivity: PriorSensitivity | None = None
    diagnostics: dict[str, Any]
    candidates: tuple[PassedOver, ...]
    other_rises: tuple[OtherRise, ...] = ()  #: The masses besides the reported one, as rises; mm on the map.
    masses: tuple[MassReport, ...]
    """All masses of the map, the surest first. The top-level fields are those of the reported one: the surest, or that
    of the place that was given.
    """
    touching: tuple[Touching, ...] = ()
    """Pairs of sized masses that may be one lump: their numbers, mm between their centres, and the length over both."""
    left_out: tuple[str, ...]
    prior: dict[str, Any]
    research_use: str
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        from_plain(Figures, self.diagnostics, where="diagnostics")
        from_plain(Origin, self.provenance, where="provenance")
        if self.variance_share is not None:
            from_plain(Shares, self.variance_share, where="variance_share")

    @property
    def figures(self) -> Mapping[str, Any]:
        """Figures of the size: spread between exams, whether the lump is oval."""
        return self.diagnostics


# --- One size from several maps of one mass.


class PooledMap(Record, kw_only=True):
    """One of the maps of a mass, as its own estimate has it."""

    map: str
    mass: Annotated[tuple[Number1, ...], Meta(max_length=2)] = ()
    """Number of the mass that was sized, and how many the map has; empty where it is the only one."""
    status: Literal["estimate", "no_estimate"]
    reason: str
    detected_probability: float | None
    max_size_mm: Interval | None  #: largest size by this map alone, as `estimate` gives it
    outlying: bool


class PooledFigures(Record, forbid_unknown_fields=False):
    """Of the figures of a pooled size those that readers use; there are others."""

    between_map_sd: Annotated[float, Meta(ge=0, le=5)] = 0.0
    oval_probability: Chance = 0.0
    oval_half_log_ratio: Annotated[float, Meta(ge=0, le=3)] = 0.0


class PooledReport(Report, kw_only=True):
    """Size of a mass from several maps."""

    schema: Literal["tactile-bayes/pooled/1"]
    status: Literal["estimate", "no_estimate", "maps_disagree"]
    """maps_disagree: each map has its size, and they are not of one size or not at one place"""
    verdict: Judgement
    findings: Findings
    reason: str
    max_size_mm: Quantity | None
    min_size_mm: Quantity | None
    another_exam: Annotated[AnotherExam | None, LEADING] = None
    supposing: Annotated[dict[str, Supposed] | None, SUPPOSING] = None
    maps: Annotated[tuple[PooledMap, ...], Meta(min_length=1)]
    one_size_probability: Chance | None
    """that maps of one mass are as far apart in size or farther; null for a single one"""
    one_place_probability: Chance | None  #: likewise of their places by the landmarks; null without two
    variance_share: dict[str, float] | None
    figures: dict[str, float]
    left_out: tuple[str, ...] = ()
    fat_mm: Positive | None = None
    """Depth of the fat under the head by its pressure profile; null where the maps do not tell."""
    unknowns: dict[str, float]
    site: str | None = None  #: The correction of the calibration by a site's phantoms, in words; null without one.
    repeatability: str | UnsetType = UNSET
    """The site's spread between exams of one mass that the size supposes, in words; missing without one."""
    research_use: str
    provenance: dict[str, Any]

    def __post_init__(self) -> None:
        from_plain(PooledFigures, self.figures, where="figures")


REPORTS: Final[Mapping[str, type[EstimateReport | PooledReport]]] = {ESTIMATE: EstimateReport, POOLED: PooledReport}
"""What ``estimate`` prints as JSON, by the ids of its schemas."""
