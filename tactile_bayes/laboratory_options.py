"""Options of the commands on devices and in the laboratory, declared as those in `options`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tactile_bayes import presets
from tactile_bayes.declarations import Meta, Options, says
from tactile_bayes.options import MOST_ITEMS, FieldCosines, Seed, named
from tactile_bayes.presets import Background, Noise, Normalise, TrackerProtocol


class RecordOptions(Options, kw_only=True):
    """Options of one recording, as given."""

    output: Path
    head_url: str
    tracker_url: Annotated[
        str | None, named("URL", "Port of the tracker; without, there are no poses.", option="tracker")
    ] = None
    tracker_protocol: Annotated[TrackerProtocol, says("Protocol of the tracker; a PATRIOT speaks liberty.")] = "fastrak"
    head_baud: Annotated[int, says("Baud rate of the head's port.", ge=300)] = 2_000_000
    tracker_baud: Annotated[
        Annotated[int, Meta(ge=300)] | None, says("Baud rate of the tracker's port. Default: the protocol's.")
    ] = None
    tracker_rom: Annotated[
        tuple[Path, ...], named("ROM", "ndi: a wireless tool's description, one for each.", path=True)
    ] = ()
    tool: Annotated[
        str | None, named("NAME", "Tool or station on the head, needed where the tracker has several.", also="station")
    ] = None
    reference: Annotated[
        str | None, named("NAME", "Tool or station fixed to the body; poses relative to it are free of breathing.")
    ] = None
    every: Annotated[int, says("Record every n-th frame only.", ge=1, le=255)] = 1
    duration_s: Annotated[
        Annotated[float, Meta(gt=0)] | None, named("S", "Stop after this time, s.", option="duration")
    ] = None
    at_once: Annotated[bool, says("Start at once, without waiting for space. Default: only with --duration.")] = False
    clock: Annotated[
        Literal["arrival", "shared"], says("Time the poses by their arrival, or trust one clock of both devices.")
    ] = "arrival"
    invert_rotation: Annotated[bool, says("The tracker gives the inverse rotation.")] = False
    like: Annotated[Path | None, named("SCAN.mcap", "Take geometry and calibration from this scan.", path=True)] = None
    head_geometry: Annotated[
        Path | None, named("HEAD.json", "Positions of the taxels and of the tracker's sensor.", path=True)
    ] = None
    array_calibration: Annotated[
        Path | None, named("ARRAY.json", "Array calibration, made by `calibrate array`.", path=True)
    ] = None
    uncalibrated: Annotated[bool, says("Record with the nominal gain: for bladder steps.")] = False
    accept_calibration: Annotated[bool, says("Accept an array calibration that is stale or of another head.")] = False
    calibration_days: Annotated[float, says("Age from which an array calibration is stale, days.", ge=0)] = 1.0
    landmarks: Annotated[Path | None, named("FILE", "Take landmarks from a JSON file or a scan.", path=True)] = None
    side: Annotated[Literal["left", "right", "phantom"] | None, says("Breast that is scanned.")] = None
    posture: Annotated[Literal["supine", "oblique", "sitting", "phantom"] | None, says("Posture during the scan.")] = (
        None
    )
    lubricant: Annotated[str | None, named("TEXT", "Lubricant on the skin.")] = None
    examiner: Annotated[str | None, named("CODE", "A code, not a name.")] = None
    subject: Annotated[str | None, named("CODE", "A code, not a name.")] = None
    session_file: Annotated[
        Path | None,
        named(
            "SESSION.toml",
            "Read these five, and other facts in plain text, from a file; an option overrides it.",
            path=True,
            option="session",
        ),
    ] = None
    live: bool = False
    serve: str | None = None
    size_calibration: str = "solid-mean"
    force: bool = False


Span = tuple[Annotated[float, Meta(ge=0)], Annotated[float, Meta(ge=0)]]  #: Begin and length, s.
Share = Annotated[float, Meta(ge=0, le=1)]


class FaultOptions(Options):
    """Faults of an emulated device, at times of the scan."""

    drop: Annotated[Share, says("Share of the records that are not sent.")] = 0.0
    corrupt: Annotated[Share, says("Share of the records with one bit changed.")] = 0.0
    stall: Annotated[Span | None, named("AT FOR", "Send nothing for FOR s from AT s on; those records are lost.")] = (
        None
    )
    disconnect_s: Annotated[
        Annotated[float, Meta(ge=0)] | None, named("AT", "Disconnect at AT s.", option="disconnect")
    ] = None
    hold: Annotated[int, says("Tracker: measure only every n-th pose.", ge=1)] = 1
    hide: Annotated[Span | None, named("AT FOR", "Tracker: its tool is out of sight for FOR s from AT s on.")] = None
    breathe_mm: Annotated[
        float,
        named(
            "MM",
            "Tracker: a second tool, Reference (or station 2), fixed to a body that breathes by MM; the "
            "first is Probe (or 1).",
            option="breathe",
            ge=0,
            le=100,
        ),
    ] = 0.0


SeatName = Annotated[
    str, named("centred|resting|0..2", "How far the lump stands out of the gland, if a grid does not state it.")
]


class SectionOptions(Options, kw_only=True):
    """Cross-section of a simulated head."""

    head_radius_mm: Annotated[float, says("Radius of the head's arc, mm.", gt=0, le=1e6)] = presets.HEAD_RADIUS_MM
    shoulder_mm: Annotated[float, says("Radius of the head's shoulders, mm.", ge=0)] = presets.SHOULDER_MM


class CaseOptions(Options, kw_only=True):
    """Pressure, tissue and mesh of a forward study."""

    mean_kpa: Annotated[float, says("Mean pressure on the head.", gt=0)] = presets.MEAN_KPA
    fat_kpa: Annotated[float, says("Young's modulus of fat.", gt=0)] = presets.FAT_KPA
    poisson: Annotated[float, says("Poisson's ratio of the tissues.")] = presets.POISSON
    gland_ratio: Annotated[float, says("Modulus of gland over fat.", gt=0)] = presets.GLAND_RATIO
    thickness_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None, says("Depth of the chest wall, mm. Default: 70, or deeper for deep lumps.")
    ] = None
    fineness: Annotated[int, says("Mesh fineness; doubling it halves the elements.", ge=1, le=8)] = 2


class StudyOptions(CaseOptions, kw_only=True):
    """How the forward study is run."""

    model: Annotated[
        Literal["plane-strain", "solid"],
        says("The paper's two-dimensional body, or balls under the whole head in three dimensions."),
    ] = "plane-strain"
    grid: Annotated[str, named("paper|FILE", "The paper's 150 cases, or a table of cases.")] = "paper"
    seat: SeatName = "centred"
    head: Literal["shoulders-inside", "shoulders-outside"] | None = None
    background: Annotated[
        Background | None,
        says("Background of Eq 7, solid only: free (default) is fitted, fixed is 1. In two dimensions it is 1."),
    ] = None
    flat_field: Annotated[
        bool | None, says("Remove what the head reads of the same body without the lump, solid only. Default: on.")
    ] = None


KpaRange = tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]]


class TissueOptions(Options, kw_only=True):
    """Homogeneous tissue under a head, the pressures on it, and how unevenly the head may press."""

    modulus_kpa: Annotated[KpaRange, named("LOW HIGH", "Young's moduli of the tissue (paper: 15 to 25).")] = (
        15.0,
        25.0,
    )
    pressure_kpa: Annotated[KpaRange, named("LOW HIGH", "Mean pressures under the head (paper: 5 to 14).")] = (
        presets.PRESSURE_WINDOW_KPA
    )
    thickness_mm: Annotated[
        float, says("Thickness of the tissue on its rigid base, mm. The paper gives none.", gt=0)
    ] = presets.THICKNESS_MM
    poisson: Annotated[float, says("Poisson's ratio of the tissue.", ge=0, lt=0.5)] = presets.POISSON
    limit_percent: Annotated[
        float, says("Largest allowed departure of a taxel from the frame's mean, % of it (paper: 7.5).", gt=0)
    ] = 7.5


class PopulationOptions(Options, kw_only=True):
    """How many bodies are simulated, and how their maps are made."""

    masses: Annotated[int, says("Number of bodies, one lump each.", ge=1, le=MOST_ITEMS)] = 400
    centred: Annotated[
        int,
        says("Further bodies whose lump is centred on the gland's surface, as the paper has it.", ge=0, le=MOST_ITEMS),
    ] = 0
    scans: Annotated[int, says("Number of exams per body.", ge=1, le=1000)] = 2
    normalise: Annotated[
        tuple[Literal["gain", "mean"], ...],
        says(
            "Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give "
            "it twice for a row by each from one scan."
        ),
    ] = ("gain",)
    seed: Seed = 7


class SbcOptions(Options, kw_only=True):
    """How simulation-based calibration is run."""

    maps: Annotated[int, says("Maps to simulate.", ge=1, le=MOST_ITEMS)] = 200
    method: Annotated[
        Literal["laplace", "importance", "ensemble"],
        says("Method of the posterior draws, as in `estimate`; ensemble takes about 20 times as long."),
    ] = "importance"
    field_cosines: Annotated[
        FieldCosines, named("N|auto", "Basis functions of the noise field, as field_cosines of `estimate`.")
    ] = "auto"
    seed: Seed = 1


class LearnOptions(Options, kw_only=True):
    """How a size calibration is learned from a table."""

    form: Annotated[
        Literal["eq6", "eq6-residual"],
        says(
            "eq6: as printed, from a table of lumps, or of bodies made by `population`; eq6-residual: with "
            "what Eq 6 leaves of the sizes, of bodies only."
        ),
    ] = "eq6"
    fit: Annotated[
        Literal["joint", "two-stage"],
        says("eq6: joint posterior of m, b, e, f from all rows, or the paper's two stages (needs depth_ratio)."),
    ] = "joint"
    normalise: Annotated[
        Normalise | None,
        says(
            "Normalisation of the table's maps, if the table does not state it; of a table of `population` "
            "with rows by several, which to learn from. Default: mean."
        ),
    ] = None
    background: Annotated[
        Background | None,
        says(
            "Background in the table's fits, if the table does not state it. Default: fixed, or free with "
            "--normalise none."
        ),
    ] = None
    fit_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        says(
            "Radius of the table's fit windows, mm, if the table does not state it. Default: "
            f"{presets.FIT_RADIUS_MM:g}."
        ),
    ] = None
    noise: Annotated[
        Noise | None,
        says(
            "Noise model of the table's fits, if the table does not state it; least squares is "
            "independent. Default: independent."
        ),
    ] = None
    least_stiffness_ratio: Annotated[
        float, says("Leave out lumps softer than this: above 8 the paper's widths change by less than 5 %.", ge=0)
    ] = 0.0
    seed: Seed = 1
