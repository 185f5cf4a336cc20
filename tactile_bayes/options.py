"""Options declared once: type, range, default and meaning stand at a field, and the rest comes from there.

Click options (`commands.options.takes`), keywords and checks of Python, the settings file with its schema, and the
settings of a provenance are made of these records.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, Literal

from tactile_bayes.declarations import Meta, Options
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import (
    CELL_MM,
    DEFAULT_NORMALISE,
    FAT_KPA,
    FIT_RADIUS_MM,
    GLAND_RATIO,
    HEAD_RADIUS_MM,
    MEAN_KPA,
    MOST_FIELD_COSINES,
    POISSON,
    PRESSURE_WINDOW_KPA,
    SHOULDER_MM,
    THICKNESS_MM,
    Background,
    Method,
    Noise,
    Normalise,
    Rotation,
    SceneAsked,
    TrackerProtocol,
)


class BumpPrior(Options):
    """Proper, weak priors, all of them printed with the estimate."""

    amplitude_sd: Annotated[
        float, Meta(gt=0, le=1000, description="Normal about 0, in units of the map's scale (1 for a normalised map)")
    ] = 2.0
    width_median_mm: Annotated[
        float, Meta(gt=0, le=100, description="Median of the geometric mean of the two widths, log-normal")
    ] = 5.0
    log_width_sd: Annotated[float, Meta(gt=0, le=10, description="SD of its natural log")] = 1.0
    log_ratio_sd: Annotated[
        float, Meta(gt=0, le=5, description="SD of half the log of the axis ratio, along and across the diagonal")
    ] = 0.5
    tilt_sd: Annotated[
        float,
        Meta(
            gt=0,
            le=1000,
            description="SD of the level's slope over half a window, in units of the map's scale; for its odds only",
        ),
    ] = 0.1


PRIORS: Final = BumpPrior.__struct_fields__


MOST_ITEMS: Final = 1_000_000
"""Of a batch: memory holds a name and an outcome for each."""
IN_FILE: Final = {"file": True}
"""Of a setting that stands in the file of `--settings`, not on the command line."""


FieldCosines = Annotated[int, Meta(ge=6, le=MOST_FIELD_COSINES)] | Literal["auto"]


class FitSettings(BumpPrior, kw_only=True):
    """How a map is fitted and its posterior drawn; must agree with the recipe of the size calibration."""

    method: Annotated[
        Method,
        Meta(
            description="importance: weighted draws; ensemble: MCMC; laplace: mode, curvature; optimise: the paper's "
            "least squares."
        ),
    ] = "importance"
    background: Annotated[
        Background | None,
        Meta(
            description="Level about the lump: fixed at 1, or fitted. Default: as for the calibration's maps; free "
            "where the level is not known (normalise none)",
            extra=IN_FILE,
        ),
    ] = None
    fit_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        Meta(description="Radius of the fitted window. Default: the calibration's, else 20", extra=IN_FILE),
    ] = None
    rotation: Annotated[
        Rotation,
        Meta(
            description="Rotated ellipse: used where the map favours it, always, or never. Correlated noise: "
            "`--scene` decides",
            extra=IN_FILE,
        ),
    ] = "auto"
    centre_mm: Annotated[
        tuple[float, float] | None,
        Meta(
            description="Place on the map to measure. Default: the highest bump that can be a lump.",
            extra={"metavar": "X Y"},
        ),
    ] = None
    noise: Annotated[
        Noise | None,
        Meta(
            description="independent: white noise, the likelihood divided by the inflation of correlated errors; "
            "field: correlated noise in the model. Default: the calibration's",
            extra=IN_FILE,
        ),
    ] = None
    field_cosines: Annotated[
        FieldCosines,
        Meta(
            description="Basis functions of the correlated noise along each axis: more are slower and resolve shorter "
            "correlation; `tradeoff estimate` measures the difference. auto: 18, up to 30 for a narrow lump",
            extra=IN_FILE,
        ),
    ] = "auto"
    accuracy_sd: Annotated[
        Annotated[float, Meta(ge=0.001, le=0.5)] | None,
        Meta(
            description="Monte-Carlo error to reach in the interval ends of sizes and map widths, in posterior SDs. "
            "Default: 0.02 for importance, 0.1 for ensemble."
        ),
    ] = None
    accuracy_mm: Annotated[
        Annotated[float, Meta(ge=0.0001, le=10)] | None,
        Meta(
            description="Wanted Monte-Carlo error of interval ends, in mm; the finer of this and --accuracy-sd holds",
            extra=IN_FILE,
        ),
    ] = None
    scene: Annotated[
        SceneAsked, Meta(description="Structures in the fit window; auto: the simplest scene that the map supports.")
    ] = "auto"
    max_steps: Annotated[
        Annotated[int, Meta(ge=150)] | None,
        Meta(description="Longest MCMC chain (method ensemble) before it gives up", extra=IN_FILE),
    ] = None

    @property
    def prior(self) -> BumpPrior:
        """The priors on the bump alone."""
        return BumpPrior(**{name: getattr(self, name) for name in PRIORS})

    @property
    def correlated(self) -> bool:
        """Whether the model has correlated errors; least squares then only finds the place."""
        return self.noise == "field"


class MapOptions(Options):
    """How a map is built of scans."""

    cell_mm: Annotated[float, Meta(ge=0.01, le=50, description="Side of the square cells, mm.")] = CELL_MM
    pressure_window_kpa: Annotated[
        tuple[Annotated[float, Meta(ge=0)], Annotated[float, Meta(ge=0)]],
        Meta(description="Leave out frames whose mean pressure lies outside.", extra={"metavar": "LOW HIGH"}),
    ] = PRESSURE_WINDOW_KPA
    normalise: Annotated[
        Normalise,
        Meta(
            description="gain: estimate one gain per frame; mean: divide each frame by its mean (the paper); none: "
            "keep kPa."
        ),
    ] = DEFAULT_NORMALISE
    latency_ms: Annotated[
        Annotated[float, Meta(ge=-10_000, le=10_000)] | Literal["auto"],
        Meta(
            description="Delay of the tracker's time stamps; auto: estimate it from the scan, or refuse.",
            extra={"metavar": "MS|auto"},
        ),
    ] = 0.0
    plane_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | Literal["auto", "all"],
        Meta(
            description="Fit the plane to frames within this distance of the mass; auto: those whose array can "
            "reach it.",
            extra={"metavar": "MM|auto|all"},
        ),
    ] = "all"
    flat_field: Annotated[
        bool, Meta(description="Remove the head's own response, measured on frames without a lump.")
    ] = False
    register_strokes: Annotated[
        bool, Meta(description="Align the strokes with each other, for a lump that moves with the head.")
    ] = False
    as_stated: Annotated[
        bool,
        Meta(
            description="Take array, lever arm and quaternions as stated, with a caution where frames contradict them; "
            "else such a scan is refused."
        ),
    ] = False
    every: Annotated[
        int,
        Meta(
            ge=1,
            description="Use one frame of every N: quicker, and noisier; `tradeoff map` measures both.",
            extra={"metavar": "N"},
        ),
    ] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.pressure_window_kpa
        if not low < high:
            raise UsageError(f"pressure_window_kpa is {(low, high)}; give two rising pressures, in kPa")
        if self.normalise != "none" and not low > 0:
            raise UsageError("pressure_window_kpa starts at 0; frames are divided by their mean, give more")
        if self.latency_ms == "auto" and self.register_strokes:
            raise UsageError(
                "a lump that follows the head mimics a latency; with register_strokes give latency_ms a number"
            )


class RecordOptions(Options, kw_only=True):
    """Options of one recording, as given."""

    output: Path
    head_url: str
    tracker_url: Annotated[
        str | None,
        Meta(
            description="Port of the tracker; without, there are no poses.",
            extra={"metavar": "URL", "option": "tracker"},
        ),
    ] = None
    tracker_protocol: Annotated[
        TrackerProtocol, Meta(description="Protocol of the tracker; a PATRIOT speaks liberty.")
    ] = "fastrak"
    head_baud: Annotated[int, Meta(ge=300, description="Baud rate of the head's port.")] = 2_000_000
    tracker_baud: Annotated[
        Annotated[int, Meta(ge=300)] | None,
        Meta(description="Baud rate of the tracker's port. Default: the protocol's."),
    ] = None
    tracker_rom: Annotated[
        tuple[Path, ...],
        Meta(description="ndi: a wireless tool's description, one for each.", extra={"metavar": "ROM", "path": True}),
    ] = ()
    tool: Annotated[
        str | None,
        Meta(
            description="Tool or station on the head, needed where the tracker has several.",
            extra={"metavar": "NAME", "also": "station"},
        ),
    ] = None
    reference: Annotated[
        str | None,
        Meta(
            description="Tool or station fixed to the body; poses relative to it are free of breathing.",
            extra={"metavar": "NAME"},
        ),
    ] = None
    every: Annotated[int, Meta(ge=1, le=255, description="Record every n-th frame only.")] = 1
    duration_s: Annotated[
        Annotated[float, Meta(gt=0.0)] | None,
        Meta(description="Stop after this time, s.", extra={"metavar": "S", "option": "duration"}),
    ] = None
    at_once: Annotated[
        bool, Meta(description="Start at once, without waiting for space. Default: only with --duration.")
    ] = False
    clock: Annotated[
        Literal["arrival", "shared"],
        Meta(description="Time the poses by their arrival, or trust one clock of both devices."),
    ] = "arrival"
    invert_rotation: Annotated[bool, Meta(description="The tracker gives the inverse rotation.")] = False
    like: Annotated[
        Path | None,
        Meta(description="Take geometry and calibration from this scan.", extra={"metavar": "SCAN.mcap", "path": True}),
    ] = None
    head_geometry: Annotated[
        Path | None,
        Meta(
            description="Positions of the taxels and of the tracker's sensor.",
            extra={"metavar": "HEAD.json", "path": True},
        ),
    ] = None
    array_calibration: Annotated[
        Path | None,
        Meta(
            description="Array calibration, made by `calibrate array`.", extra={"metavar": "ARRAY.json", "path": True}
        ),
    ] = None
    uncalibrated: Annotated[bool, Meta(description="Record with the nominal gain: for bladder steps.")] = False
    accept_calibration: Annotated[
        bool, Meta(description="Accept an array calibration that is stale or of another head.")
    ] = False
    calibration_days: Annotated[
        float, Meta(ge=0.0, description="Age from which an array calibration is stale, days.")
    ] = 1.0
    landmarks: Annotated[
        Path | None,
        Meta(description="Take landmarks from a JSON file or a scan.", extra={"metavar": "FILE", "path": True}),
    ] = None
    side: Annotated[Literal["left", "right", "phantom"] | None, Meta(description="Breast that is scanned.")] = None
    posture: Annotated[
        Literal["supine", "oblique", "sitting", "phantom"] | None, Meta(description="Posture during the scan.")
    ] = None
    lubricant: Annotated[str | None, Meta(description="Lubricant on the skin.", extra={"metavar": "TEXT"})] = None
    examiner: Annotated[str | None, Meta(description="A code, not a name.", extra={"metavar": "CODE"})] = None
    subject: Annotated[str | None, Meta(description="A code, not a name.", extra={"metavar": "CODE"})] = None
    session_file: Annotated[
        Path | None,
        Meta(
            description="Read these five, and other facts in plain text, from a file; an option overrides it.",
            extra={"metavar": "SESSION.toml", "path": True, "option": "session"},
        ),
    ] = None
    live: bool = False
    serve: str | None = None
    size_calibration: str = "solid-mean"
    force: bool = False


IntervalMethod = Literal["corrected", "jackknife", "bca"]
Seed = Annotated[int, Meta(ge=0, description="Random seed.")]


class TrialSettings(Options):
    """Settings of a trial's analysis; each is part of the provenance."""

    intervals: Annotated[
        IntervalMethod,
        Meta(
            description="Interval method, resampling patients. corrected: jackknife with Student's t, corrected for "
            "rare misses and few influential patients; jackknife: uncorrected; bca: bootstrap."
        ),
    ] = "corrected"
    resamples: Annotated[int, Meta(ge=200, le=100_000, description="Number of bootstrap resamples.")] = 2000
    seed: Seed = 1999
    error_ratio: Annotated[
        float,
        Meta(ge=1e-6, le=1e6, description="Ratio of the ex-vivo error's variance to the modality's, for Deming lines."),
    ] = 1.0
    check_intervals: Annotated[
        int,
        Meta(
            ge=0,
            description="Simulate this many trials of this size and report how often the intervals cover.",
            extra={"metavar": "TRIALS"},
        ),
    ] = 0
    bayes: Annotated[
        bool, Meta(description="Predict the error of the next mass, by an errors-in-variables model and MCMC.")
    ] = False


SeatName = Annotated[
    str,
    Meta(
        description="How far the lump stands out of the gland, if a grid does not state it.",
        extra={"metavar": "centred|resting|0..2"},
    ),
]


class SectionOptions(Options, kw_only=True):
    """Cross-section of a simulated head."""

    head_radius_mm: Annotated[float, Meta(gt=0, le=1e6, description="Radius of the head's arc, mm.")] = HEAD_RADIUS_MM
    shoulder_mm: Annotated[float, Meta(ge=0, description="Radius of the head's shoulders, mm.")] = SHOULDER_MM


class CaseOptions(Options, kw_only=True):
    """Pressure, tissue and mesh of a forward study."""

    mean_kpa: Annotated[float, Meta(gt=0, description="Mean pressure on the head.")] = MEAN_KPA
    fat_kpa: Annotated[float, Meta(gt=0, description="Young's modulus of fat.")] = FAT_KPA
    poisson: Annotated[float, Meta(description="Poisson's ratio of the tissues.")] = POISSON
    gland_ratio: Annotated[float, Meta(gt=0, description="Modulus of gland over fat.")] = GLAND_RATIO
    thickness_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        Meta(description="Depth of the chest wall, mm. Default: 70, or deeper for deep lumps."),
    ] = None
    fineness: Annotated[int, Meta(ge=1, le=8, description="Mesh fineness; doubling it halves the elements.")] = 2


class StudyOptions(CaseOptions, kw_only=True):
    """How the forward study is run."""

    model: Annotated[
        Literal["plane-strain", "solid"],
        Meta(description="The paper's two-dimensional body, or balls under the whole head in three dimensions."),
    ] = "plane-strain"
    grid: Annotated[
        str, Meta(description="The paper's 150 cases, or a table of cases.", extra={"metavar": "paper|FILE"})
    ] = "paper"
    seat: SeatName = "centred"
    head: Literal["shoulders-inside", "shoulders-outside"] | None = None
    background: Annotated[
        Background | None,
        Meta(
            description="Background of Eq 7, solid only: free (default) is fitted, fixed is 1. In two dimensions it "
            "is 1."
        ),
    ] = None
    flat_field: Annotated[
        bool | None,
        Meta(description="Remove what the head reads of the same body without the lump, solid only. Default: on."),
    ] = None


KpaRange = tuple[Annotated[float, Meta(gt=0)], Annotated[float, Meta(gt=0)]]


class TissueOptions(Options, kw_only=True):
    """Homogeneous tissue under a head, the pressures on it, and how unevenly the head may press."""

    modulus_kpa: Annotated[
        KpaRange, Meta(description="Young's moduli of the tissue (paper: 15 to 25).", extra={"metavar": "LOW HIGH"})
    ] = (15.0, 25.0)
    pressure_kpa: Annotated[
        KpaRange, Meta(description="Mean pressures under the head (paper: 5 to 14).", extra={"metavar": "LOW HIGH"})
    ] = PRESSURE_WINDOW_KPA
    thickness_mm: Annotated[
        float, Meta(gt=0, description="Thickness of the tissue on its rigid base, mm. The paper gives none.")
    ] = THICKNESS_MM
    poisson: Annotated[float, Meta(ge=0, lt=0.5, description="Poisson's ratio of the tissue.")] = POISSON
    limit_percent: Annotated[
        float,
        Meta(gt=0, description="Largest allowed departure of a taxel from the frame's mean, % of it (paper: 7.5)."),
    ] = 7.5


class PopulationOptions(Options, kw_only=True):
    """How many bodies are simulated, and how their maps are made."""

    masses: Annotated[int, Meta(ge=1, le=MOST_ITEMS, description="Number of bodies, one lump each.")] = 400
    centred: Annotated[
        int,
        Meta(
            ge=0,
            le=MOST_ITEMS,
            description="Further bodies whose lump is centred on the gland's surface, as the paper has it.",
        ),
    ] = 0
    scans: Annotated[int, Meta(ge=1, le=1000, description="Number of exams per body.")] = 2
    normalise: Annotated[
        tuple[Literal["gain", "mean"], ...],
        Meta(
            description="Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give "
            "it twice for a row by each from one scan."
        ),
    ] = ("gain",)
    seed: Seed = 7


class SbcOptions(Options, kw_only=True):
    """How simulation-based calibration is run."""

    maps: Annotated[int, Meta(ge=1, le=MOST_ITEMS, description="Maps to simulate.")] = 200
    method: Annotated[
        Literal["laplace", "importance", "ensemble"],
        Meta(description="Method of the posterior draws, as in `estimate`; ensemble takes about 20 times as long."),
    ] = "importance"
    field_cosines: Annotated[
        FieldCosines,
        Meta(
            description="Basis functions of the noise field, as field_cosines of `estimate`.",
            extra={"metavar": "N|auto"},
        ),
    ] = "auto"
    seed: Seed = 1


class LearnOptions(Options, kw_only=True):
    """How a size calibration is learned from a table."""

    form: Annotated[
        Literal["eq6", "eq6-residual"],
        Meta(
            description="eq6: as printed, from a table of lumps, or of bodies made by `population`; eq6-residual: with "
            "what Eq 6 leaves of the sizes, of bodies only."
        ),
    ] = "eq6"
    fit: Annotated[
        Literal["joint", "two-stage"],
        Meta(
            description="eq6: joint posterior of m, b, e, f from all rows, or the paper's two stages (needs "
            "depth_ratio)."
        ),
    ] = "joint"
    normalise: Annotated[
        Normalise | None,
        Meta(
            description="Normalisation of the table's maps, if the table does not state it; of a table of `population` "
            "with rows by several, which to learn from. Default: mean."
        ),
    ] = None
    background: Annotated[
        Background | None,
        Meta(
            description="Background in the table's fits, if the table does not state it. Default: fixed, or free with "
            "--normalise none."
        ),
    ] = None
    fit_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        Meta(
            description="Radius of the table's fit windows, mm, if the table does not state it. Default: "
            f"{FIT_RADIUS_MM:g}."
        ),
    ] = None
    noise: Annotated[
        Noise | None,
        Meta(
            description="Noise model of the table's fits, if the table does not state it; least squares is "
            "independent. Default: independent."
        ),
    ] = None
    least_stiffness_ratio: Annotated[
        float,
        Meta(ge=0, description="Leave out lumps softer than this: above 8 the paper's widths change by less than 5 %."),
    ] = 0.0
    seed: Seed = 1


Aim = Literal["power", "precision"]


class PlanErrors(Options):
    """Errors of ln size that a plan assumes; an SD of 0.15 is about 15 %."""

    tactile_bias: Annotated[float, Meta(ge=-3, le=3, description="Mean of ln(size / ex vivo).")] = 0.02
    mass_sd: Annotated[float, Meta(ge=0, le=3, description="SD of ln size shared by a mass's maps.")] = 0.18
    map_sd: Annotated[float, Meta(ge=0, le=3, description="SD of ln size of single maps.")] = 0.15
    other_bias: Annotated[
        float, Meta(ge=-3, le=3, description="Mean of ln(size / ex vivo) of the modality compared with.")
    ] = -0.08
    other_sd: Annotated[float, Meta(ge=0, le=3, description="SD of ln size of the modality compared with.")] = 0.40
    other_miss: Annotated[
        float, Meta(ge=0, le=1, description="Share of masses that the modality compared with misses.")
    ] = 0.04


class PlanAims(Options):
    """What the number of patients of a trial is to reach, instead of a number that is given."""

    power: Annotated[
        Annotated[float, Meta(ge=0.5, le=0.99)] | None,
        Meta(
            description="Find the number of patients that reaches this power, such as 0.9.", extra={"metavar": "SHARE"}
        ),
    ] = None
    precision: Annotated[
        Annotated[float, Meta(ge=1.05, le=10)] | None,
        Meta(
            description="Find the number of patients whose interval of the tactile error spans this factor from end to "
            "end, such as 2.",
            extra={"metavar": "FACTOR"},
        ),
    ] = None

    @property
    def wanted(self) -> dict[Aim, float]:
        """What was given."""
        each: dict[Aim, float | None] = {"power": self.power, "precision": self.precision}
        return {aim: target for aim, target in each.items() if target is not None}


def _text(longest: int, metavar: str, meaning: str) -> Meta:
    return Meta(max_length=longest, description=meaning, extra={"metavar": metavar})


class IdentityOptions(Options):
    """Patient and study of an export.

    Who was examined and when, as options or in the file of `export --worklist`; what is left out stays empty. The file
    may also be a modality worklist item of DICOM.
    """

    patient_id: Annotated[str, _text(64, "ID", "Patient ID; in csv files the beginning of the record ID.")] = ""
    patient_name: Annotated[str, _text(194, "FAMILY^GIVEN", "Patient's name: FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX.")] = ""
    birth_date: Annotated[str, _text(10, "YYYY-MM-DD", "Patient's date of birth: YYYY-MM-DD.")] = ""
    sex: Annotated[
        Literal["F", "M", "O", ""], Meta(description="Patient's sex: F, M or O.", extra={"metavar": "F|M|O"})
    ] = ""
    issuer: Annotated[str, _text(64, "NAME", "Who issued the patient ID.")] = ""
    accession: Annotated[str, _text(16, "NUMBER", "Accession number.")] = ""
    referring_physician: Annotated[str, _text(194, "FAMILY^GIVEN", "Referring physician's name, likewise.")] = ""
    study_id: Annotated[str, _text(16, "ID", "Study ID.")] = ""
    study_description: Annotated[str, _text(64, "TEXT", "Study description.")] = ""
    study_uid: Annotated[
        str, _text(64, "UID", "Study Instance UID. Default: one that follows from the content of the maps.")
    ] = ""
    study_date: Annotated[
        str, _text(25, "DATE", "Date of the exam: YYYY-MM-DD or YYYY-MM-DDTHH:MM, with +HH:MM for the zone.")
    ] = ""
    content_date: Annotated[str, _text(25, "DATE", "Date at which the content was made. Default: the exam's.")] = ""
