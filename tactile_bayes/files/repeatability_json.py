"""A site's repeatability as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tactile_bayes.declarations import Meta, Record, to_plain
from tactile_bayes.files.atomic import sha256, write_text
from tactile_bayes.files.documents import dump_json, parse_record, read_record
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.site import PROBABILITY, Repeatability

Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", extra={"words": "a SHA-256, 64 digits from 0 to f"})]


class UsedCalibration(Record):
    """The size calibration that sized the exams."""

    name: str
    sha256: Annotated[
        Sha256,
        Meta(description="Of the calibration's file: sizes by another one have another spread, and are refused"),
    ]
    normalise: Annotated[str, Meta(description="How the maps' frames were normalised, as the option of `map`")]


class HalfWidth(Record):
    """Half width of the 95 % interval of a single exam, a share of the size: median over the exams that took part."""

    as_estimated: Annotated[float, Meta(description="By the spread that the exams were estimated with")]
    with_it: Annotated[float, Meta(description="By the learned spread")]


class RepeatedMass(Record):
    """A mass at a visit with repeated exams."""

    name: Annotated[str, Meta(description="Of the mass at this visit, as its folder")]
    exams: Annotated[list[str], Meta(min_length=2)]
    log_size: Annotated[
        list[float], Meta(min_length=2, description="ln d (mm) by each exam alone, without what no map shows")
    ]
    map_sd: Annotated[
        list[Annotated[float, Meta(ge=0)]], Meta(min_length=2, description="SD of each by the map's own errors")
    ]
    by_chance: Annotated[
        float,
        Meta(
            ge=0, le=1, description="Probability, by the other masses, that exams of a mass lie as far apart as these"
        ),
    ]


class RepeatabilityFile(Record, kw_only=True, omit_defaults=True):
    """A site's repeatability: how far sizes of one mass lie apart between its exams, learned from repeated exams."""

    schema: Literal["tactile-bayes/repeatability/1"]
    research_use: str
    between_map_sd: Annotated[
        float,
        Meta(
            gt=0,
            le=2,
            description="SD of ln d between exams of one mass beyond the maps' own errors: root mean square of its "
            "posterior, which adds to the variance of one map's size",
        ),
    ]
    log_sd: Annotated[
        float,
        Meta(
            ge=0,
            le=3,
            description="SD of the natural log of that spread: the log-normal with this and between_map_sd as its root "
            "mean square is the prior that `estimate --repeatability` uses",
        ),
    ]
    median: Annotated[float, Meta(gt=0, description="Median of the spread's posterior")]
    low: Annotated[float, Meta(gt=0, description="Lower end of its equal-tailed interval")]
    high: Annotated[float, Meta(gt=0, description="Upper end")]
    probability: Annotated[float, Meta(ge=0.95, le=0.95, description="Of that interval")]
    masses: Annotated[int, Meta(ge=3, description="Masses with repeated exams; visits of a mass count once")]
    maps: Annotated[int, Meta(ge=6, description="Exams that took part")]
    calibration: UsedCalibration
    half_width: HalfWidth | None = None
    repeats: Annotated[list[RepeatedMass], Meta(min_length=3, description="Masses at a visit with repeated exams")]
    outlying: Annotated[
        tuple[str, ...],
        Meta(
            description="Masses whose exams lie further apart than the other masses lead one to expect (false alarm at "
            "one site in 20); they took part"
        ),
    ]
    left_out: Annotated[list[str], Meta(description="Exams of masses with repeats that took no part, and why")]
    provenance: Annotated[
        dict[str, Any],
        Meta(
            description="inputs: the size calibration, and the draws of each exam (shape.npz), in the order of repeats"
        ),
    ]

    def __post_init__(self) -> None:
        _ = self.repeatability()  # refuses what is none

    def repeatability(self, digest: str = "") -> Repeatability:
        """The spread that a size uses, with the hash of the file it is from."""
        return Repeatability(
            sd=self.between_map_sd,
            log_sd=self.log_sd,
            median=self.median,
            low=self.low,
            high=self.high,
            masses=self.masses,
            maps=self.maps,
            calibration=self.calibration.name,
            calibration_sha256=self.calibration.sha256,
            normalise=self.calibration.normalise,
            outlying=self.outlying,
            sha256=digest,
        )


def repeatability_document(
    found: Repeatability,
    *,
    repeats: Sequence[RepeatedMass],
    left_out: Sequence[str],
    half_width: HalfWidth | None,
    provenance: Provenance,
) -> dict[str, Any]:
    """The JSON object; numbers keep nine significant digits.

    Parameters
    ----------
    repeats, half_width
        As `RepeatabilityFile` has them.
    left_out
        Exams that took no part, with the reason.
    """
    file = RepeatabilityFile(
        schema="tactile-bayes/repeatability/1",
        research_use=RESEARCH_USE,
        between_map_sd=found.sd,
        log_sd=found.log_sd,
        median=found.median,
        low=found.low,
        high=found.high,
        probability=PROBABILITY,
        masses=found.masses,
        maps=found.maps,
        calibration=UsedCalibration(found.calibration, found.calibration_sha256, found.normalise),
        half_width=half_width,
        repeats=list(repeats),
        outlying=found.outlying,
        left_out=list(left_out),
        provenance=provenance.as_dict(),
    )
    document: dict[str, Any] = to_plain(file)
    return document


def write_repeatability(path: Path, document: dict[str, Any], *, force: bool = False) -> None:
    """Write the JSON object atomically, held against its declaration."""
    parse_record(document, RepeatabilityFile, path=path)
    write_text(path, dump_json(document), force=force)


def read_repeatability(path: Path) -> Repeatability:
    """Read what `write_repeatability` wrote.

    Raises
    ------
    BadDataError
        When the file is none, or a field is none of what `RepeatabilityFile` declares.
    """
    found = read_record(path, RepeatabilityFile, way_out="give a file of `calibrate repeatability`")
    return found.repeatability(sha256(path))
