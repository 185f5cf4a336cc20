"""Options declared once: type, range, meaning and default stand at a field, and the rest comes from there.

Click options (`commands.options.record_options`), keywords and checks of Python, the settings file with its schema, and
the settings of a provenance are made of these records.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from tactile_bayes import presets
from tactile_bayes.declarations import Meta, Options
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import Background, Method, Noise, Normalise, Rotation, SceneName, TrackerProtocol


class BumpPrior(Options):
    """Proper, weak priors, all of them printed with the estimate."""

    amplitude_sd: Annotated[
        float, Meta(gt=0, le=1000), "Normal about 0, in units of the map's scale (1 for a normalised map)"
    ] = 2.0
    width_median_mm: Annotated[
        float, Meta(gt=0, le=100), "Median of the geometric mean of the two widths, log-normal"
    ] = 5.0
    log_width_sd: Annotated[float, Meta(gt=0, le=10), "SD of its natural log"] = 1.0
    log_ratio_sd: Annotated[
        float, Meta(gt=0, le=5), "SD of half the log of the axis ratio, along and across the diagonal"
    ] = 0.5
    tilt_sd: Annotated[
        float,
        Meta(gt=0, le=1000),
        "SD of the level's slope over half a window, in units of the map's scale; for its odds only",
    ] = 0.1


PRIORS: Final = BumpPrior.__struct_fields__

MOST_PATIENTS: Final = 10_000  #: Of a plan.
MOST_ITEMS: Final = 1_000_000  #: Of a batch: memory holds a name and an outcome for each.
IN_FILE: Final = Meta(extra={"file": True})  #: Marks a setting of the file of `--settings` that is no option.


def cli_meta(metavar: str, *, option: str = "", also: str = "", **rules: Any) -> Meta:
    """Rules of an option with the name of its value in the help.

    `option` names it on the command line, by default its field's name; `also` is a second name.
    """
    names = {"metavar": metavar, "option": option, "also": also}
    return Meta(extra={key: name for key, name in names.items() if name}, **rules)


Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
FieldCosines = Annotated[int, Meta(ge=6, le=presets.MOST_FIELD_COSINES)] | Literal["auto"]


class FitSettings(BumpPrior, kw_only=True):
    """How a map is fitted and its posterior drawn; must agree with the recipe of the size calibration."""

    method: Annotated[
        Method,
        "importance: weighted draws; ensemble: MCMC; laplace: mode, curvature; optimise: the paper's least squares.",
    ] = "importance"
    background: Annotated[
        Background | None,
        IN_FILE,
        "Level about the lump: fixed at 1, or fitted. Default: as for the calibration's maps; free where the level is "
        "not known (normalise none)",
    ] = None
    fit_radius_mm: Annotated[
        Positive | None, IN_FILE, "Radius of the fitted window. Default: the calibration's, else 20"
    ] = None
    rotation: Annotated[
        Rotation,
        IN_FILE,
        "Rotated ellipse: used where the map favours it, always, or never. Correlated noise: `--scene` decides",
    ] = "auto"
    centre_mm: Annotated[
        tuple[float, float] | None,
        cli_meta("X Y"),
        "Place on the map to measure. Default: the highest bump that can be a lump.",
    ] = None
    noise: Annotated[
        Noise | None,
        IN_FILE,
        "independent: white noise, the likelihood divided by the inflation of correlated errors; field: correlated "
        "noise in the model. Default: the calibration's",
    ] = None
    field_cosines: Annotated[
        FieldCosines,
        IN_FILE,
        "Basis functions of the correlated noise along each axis: more are slower and resolve shorter correlation; "
        "`tradeoff estimate` measures the difference. auto: 18, up to 30 for a narrow lump",
    ] = "auto"
    accuracy_sd: Annotated[
        Annotated[float, Meta(ge=0.001, le=0.5)] | None,
        "Monte-Carlo error to reach in the interval ends of sizes and map widths, in posterior SDs. Default: 0.02 for "
        "importance, 0.1 for ensemble.",
    ] = None
    accuracy_mm: Annotated[
        Annotated[float, Meta(ge=0.0001, le=10)] | None,
        IN_FILE,
        "Wanted Monte-Carlo error of interval ends, in mm; the finer of this and --accuracy-sd holds",
    ] = None
    scene: Annotated[SceneName, "Structures in the fit window; auto: the simplest scene that the map supports."] = (
        "auto"
    )
    max_steps: Annotated[
        Annotated[int, Meta(ge=150)] | None, IN_FILE, "Longest MCMC chain (method ensemble) before it gives up"
    ] = None

    @property
    def prior(self) -> BumpPrior:
        """The priors on the bump alone."""
        return BumpPrior(**{name: getattr(self, name) for name in PRIORS})

    @property
    def correlated(self) -> bool:
        """True if the model has correlated errors; least squares then only finds the place."""
        return self.noise == "field"


class MapOptions(Options):
    """Options of building a map from scans."""

    cell_mm: Annotated[float, Meta(ge=0.01, le=50), "Side of the square cells, mm."] = presets.CELL_MM
    pressure_window_kpa: Annotated[
        tuple[NonNegative, NonNegative], cli_meta("LOW HIGH"), "Leave out frames whose mean pressure lies outside."
    ] = presets.PRESSURE_WINDOW_KPA
    normalise: Annotated[
        Normalise, "gain: estimate one gain per frame; mean: divide each frame by its mean (the paper); none: keep kPa."
    ] = presets.DEFAULT_NORMALISE
    latency_ms: Annotated[
        Annotated[float, Meta(ge=-10_000, le=10_000)] | Literal["auto"],
        cli_meta("MS|auto"),
        "Delay of the tracker's time stamps; auto: estimate it from the scan, or refuse.",
    ] = 0.0
    plane_radius_mm: Annotated[
        Positive | Literal["auto", "all"],
        cli_meta("MM|auto|all"),
        "Fit the plane to frames within this distance of the mass; auto: those whose array can reach it.",
    ] = "all"
    flat_field: Annotated[bool, "Remove the head's own response, measured on frames without a lump."] = False
    register_strokes: Annotated[bool, "Align the strokes with each other, for a lump that moves with the head."] = False
    as_stated: Annotated[
        bool,
        "Take array, lever arm and quaternions as stated, with a caution where frames contradict them; else such a "
        "scan is refused.",
    ] = False
    every: Annotated[
        int, cli_meta("N", ge=1), "Use one frame of every N: quicker, and noisier; `tradeoff map` measures both."
    ] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.pressure_window_kpa
        if not low < high:
            raise UsageError(f"pressure_window_kpa is {(low, high)}; give two rising pressures, in kPa")
        if self.normalise != "none" and not low > 0:
            raise UsageError("pressure_window_kpa starts at 0; frames are divided by their mean, give more")
        if self.latency_ms == "auto" and self.register_strokes:
            fault = "a lump that follows the head mimics a latency; with register_strokes give latency_ms a number"
            raise UsageError(fault)


GROWTH_SHARES: Final = (0.2,)
"""Growth of the diameter, as shares, whose probability is reported; 20 % is the step of RECIST 1.1."""


MOST_DAYS: Final = 36_525  #: Between visits; more are a date written as a number.


class CompareOptions(Options):
    """Options of comparing visits."""

    days: Annotated[
        tuple[float, ...] | None, "Time of each visit in days, the first at 0; None where it is not known."
    ] = None
    grown_by: Annotated[
        tuple[Annotated[float, Meta(gt=-1, lt=10)], ...], "Shares of the diameter by which it may have grown or more."
    ] = GROWTH_SHARES
    same_mass: Annotated[
        bool, "Say that the visits are of one mass where landmarks are missing, or place it too far apart."
    ] = False
    registration_mm: Annotated[
        float, Meta(gt=0), "SD along each axis of one mass's place between visits, by posture and landmarks."
    ] = presets.REGISTRATION_MM

    def check_visits(self, visits: int) -> None:
        """Refuse too many visits, and days that are not one for each, or do not rise."""
        if visits > presets.MOST_VISITS:
            raise UsageError(f"{visits} visits are given; compare 2 to {presets.MOST_VISITS}")
        if self.days is None:
            return
        if len(self.days) != visits:
            times, later = len(self.days) - 1, visits - 1
            fault = f"times are given for {times} later visits, and there are {later}"
            raise UsageError(f"{fault}; give one for each, and of dates the first visit's, too")
        listed = ", ".join(f"{day:.9g}" for day in self.days)
        if any(after <= before for before, after in zip(self.days, self.days[1:], strict=False)):
            raise UsageError(f"the visits' days are {listed}; give them in order, each later than the one before")
        if self.days[-1] - self.days[0] > MOST_DAYS:
            raise UsageError(f"the visits' days are {listed}, a century and more; give days since the first visit")


IntervalMethod = Literal["corrected", "jackknife", "bca"]
Seed = Annotated[int, Meta(ge=0), "Random seed."]
Workers = Annotated[int, Meta(ge=0), "Number of worker processes."]


class TrialSettings(Options):
    """Settings of a trial's analysis; each is part of the provenance."""

    intervals: Annotated[
        IntervalMethod,
        "Interval method, resampling patients. corrected: jackknife with Student's t, corrected for rare misses and "
        "few influential patients; jackknife: uncorrected; bca: bootstrap.",
    ] = "corrected"
    resamples: Annotated[int, Meta(ge=200, le=100_000), "Number of bootstrap resamples."] = 2000
    seed: Seed = 1999
    error_ratio: Annotated[
        float,
        Meta(ge=1e-6, le=1e6),
        "Ratio of the ex-vivo error's variance to the modality's, for Deming lines.",
    ] = 1.0
    bayes: Annotated[bool, "Predict the error of the next mass, by an errors-in-variables model and MCMC."] = False


Aim = Literal["power", "precision"]


class PlanErrors(Options):
    """Errors of ln size that a plan assumes; an SD of 0.15 is about 15 %."""

    tactile_bias: Annotated[float, Meta(ge=-3, le=3), "Mean of ln(size / ex vivo)."] = 0.02
    mass_sd: Annotated[float, Meta(ge=0, le=3), "SD of ln size shared by a mass's maps."] = 0.18
    map_sd: Annotated[float, Meta(ge=0, le=3), "SD of ln size of single maps."] = 0.15
    tactile_miss: Annotated[float, Meta(ge=0, le=1), "Share of masses that the tactile maps miss."] = 0.0
    other_bias: Annotated[float, Meta(ge=-3, le=3), "Mean of ln(size / ex vivo) of the modality compared with."] = -0.08
    other_sd: Annotated[float, Meta(ge=0, le=3), "SD of ln size of the modality compared with."] = 0.40
    other_miss: Annotated[float, Meta(ge=0, le=1), "Share of masses that the modality compared with misses."] = 0.04


class PlanOptions(Options, kw_only=True):
    """Designs of a trial to simulate, or a power or precision that sets the number of patients."""

    patients: Annotated[
        tuple[Annotated[int, Meta(ge=8, le=MOST_PATIENTS)], ...], "Number of patients, one mass each."
    ] = (16, 24, 32, 48)
    maps: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=1000)], ...],
        "Number of tactile maps per mass; 3 with --power or --precision.",
    ] = (1, 3, 5)
    power: Annotated[
        Annotated[float, Meta(ge=0.5, le=0.99)] | None,
        cli_meta("SHARE"),
        "Find the number of patients that reaches this power, such as 0.9.",
    ] = None
    precision: Annotated[
        Annotated[float, Meta(ge=1.05, le=10)] | None,
        cli_meta("FACTOR"),
        "Find the number of patients whose interval of the tactile error spans this factor from end to end, such as 2.",
    ] = None
    against: Annotated[str, "Modality of the pilot to compare with."] = "ultrasound"
    trials: Annotated[int, Meta(ge=50, le=MOST_ITEMS), "Number of simulated trials per design."] = 1000
    seed: Seed = 1999
    workers: Workers = 1

    @property
    def targets(self) -> dict[Aim, float]:
        """The power and precision to reach, those that are set."""
        each: dict[Aim, float | None] = {"power": self.power, "precision": self.precision}
        return {aim: target for aim, target in each.items() if target is not None}


class CampaignOptions(Options, kw_only=True):
    """Options of a campaign: how the exams of a table are mapped and matched, and what is written."""

    excision: Annotated[Path | None, cli_meta("EX.csv"), "Sizes measured after excision: adds the trial's report."] = (
        None
    )
    columns: Annotated[
        Path | None, cli_meta("MAP.toml"), "Layout of a wide EX.csv: which column holds what, in which unit."
    ] = None
    protocol: Annotated[
        Path | None, cli_meta("FILE.toml"), "Pre-specified analysis of the trial, as for `validate`."
    ] = None
    normalise: Annotated[Normalise, "Normalisation of the frames, as in `map`."] = presets.DEFAULT_NORMALISE
    match_mm: Annotated[
        float,
        cli_meta("MM", gt=0),
        "Largest distance at which a mass is taken for the one that another exam of the breast names by place.",
    ] = presets.MATCH_MM
    figures: Annotated[bool, "Draw map and size posterior of each exam."] = False
    dry_run: Annotated[bool, "Print what would be done, and do nothing."] = False
    copy_to: Annotated[
        str | None, cli_meta("s3://BUCKET/FOLDER"), "Copy every file into this folder of an object store, step by step."
    ] = None
    workers: Workers = 1
    scheduler: Annotated[str | None, cli_meta("ADDRESS"), "Send the exams to a dask scheduler (extra [cluster])."] = (
        None
    )


PersonName = Annotated[str, cli_meta("FAMILY^GIVEN", max_length=194)]
DayText = Annotated[str, cli_meta("DATE", max_length=25)]


class IdentityOptions(Options):
    """Patient and study of an export.

    Who was examined and when, as options or in the file of `export --worklist`; what is left out stays empty. The file
    may also be a modality worklist item of DICOM.
    """

    patient_id: Annotated[
        str, cli_meta("ID", max_length=64), "Patient ID; in csv files the beginning of the record ID."
    ] = ""
    patient_name: Annotated[PersonName, "Patient's name: FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX."] = ""
    birth_date: Annotated[str, cli_meta("YYYY-MM-DD", max_length=10), "Patient's date of birth: YYYY-MM-DD."] = ""
    sex: Annotated[Literal["F", "M", "O", ""], cli_meta("F|M|O"), "Patient's sex: F, M or O."] = ""
    issuer: Annotated[str, cli_meta("NAME", max_length=64), "Issuer of the patient ID."] = ""
    accession: Annotated[str, cli_meta("NUMBER", max_length=16), "Accession number."] = ""
    referring_physician: Annotated[PersonName, "Referring physician's name, likewise."] = ""
    study_id: Annotated[str, cli_meta("ID", max_length=16), "Study ID."] = ""
    study_description: Annotated[str, cli_meta("TEXT", max_length=64), "Study description."] = ""
    study_uid: Annotated[
        str,
        cli_meta("UID", max_length=64),
        "Study Instance UID. Default: one that follows from the content of the maps.",
    ] = ""
    study_date: Annotated[DayText, "Date of the exam: YYYY-MM-DD or YYYY-MM-DDTHH:MM, with +HH:MM for the zone."] = ""
    content_date: Annotated[DayText, "Date at which the content was made. Default: the exam's."] = ""


# --- Options of the commands on devices and in the laboratory.

Baud = Annotated[int, Meta(ge=300)]
Side = Literal["left", "right", "phantom"]
Posture = Literal["supine", "oblique", "sitting", "phantom"]


class RecordOptions(Options, kw_only=True):
    """Options of one recording."""

    output: Path
    head_url: str
    tracker_url: Annotated[
        str | None, cli_meta("URL", option="tracker"), "Port of the tracker; without, there are no poses."
    ] = None
    tracker_protocol: Annotated[TrackerProtocol, "Protocol of the tracker; a PATRIOT speaks liberty."] = "fastrak"
    head_baud: Annotated[Baud, "Baud rate of the head's port."] = 2_000_000
    tracker_baud: Annotated[Baud | None, "Baud rate of the tracker's port. Default: the protocol's."] = None
    tracker_rom: Annotated[tuple[Path, ...], cli_meta("ROM"), "ndi: a wireless tool's description, one for each."] = ()
    tool: Annotated[
        str | None,
        cli_meta("NAME", also="station"),
        "Tool or station on the head, needed where the tracker has several.",
    ] = None
    reference: Annotated[
        str | None, cli_meta("NAME"), "Tool or station fixed to the body; poses relative to it are free of breathing."
    ] = None
    every: Annotated[int, Meta(ge=1, le=255), "Record every n-th frame only."] = 1
    duration_s: Annotated[Positive | None, cli_meta("S", option="duration"), "Stop after this time, s."] = None
    at_once: Annotated[bool, "Start at once, without waiting for space. Default: only with --duration."] = False
    clock: Annotated[
        Literal["arrival", "shared"], "Time the poses by their arrival, or trust one clock of both devices."
    ] = "arrival"
    invert_rotation: Annotated[bool, "The tracker gives the inverse rotation."] = False
    like: Annotated[Path | None, cli_meta("SCAN.mcap"), "Take geometry and calibration from this scan."] = None
    head_geometry: Annotated[
        Path | None, cli_meta("HEAD.json"), "Positions of the taxels and of the tracker's sensor."
    ] = None
    array_calibration: Annotated[
        Path | None, cli_meta("ARRAY.json"), "Array calibration, made by `calibrate array`."
    ] = None
    uncalibrated: Annotated[bool, "Record with the nominal gain: for bladder steps."] = False
    accept_calibration: Annotated[bool, "Accept an array calibration that is stale or of another head."] = False
    calibration_days: Annotated[float, Meta(ge=0), "Age from which an array calibration is stale, days."] = 1.0
    landmarks: Annotated[Path | None, cli_meta("FILE"), "Take landmarks from a JSON file or a scan."] = None
    side: Annotated[Side | None, "Breast that is scanned."] = None
    posture: Annotated[Posture | None, "Posture during the scan."] = None
    lubricant: Annotated[str | None, cli_meta("TEXT"), "Lubricant on the skin."] = None
    examiner: Annotated[str | None, cli_meta("CODE"), "Code of the examiner, not a name."] = None
    subject: Annotated[str | None, cli_meta("CODE"), "Code of the patient, not a name."] = None
    session_file: Annotated[
        Path | None,
        cli_meta("SESSION.toml", option="session"),
        "Read these five, and other facts in plain text, from a file; an option overrides it.",
    ] = None
    live: Annotated[bool, "Draw the map on the terminal while it grows."] = False
    serve: Annotated[
        str | None, cli_meta("HOST:PORT"), "Show the map in a browser on this computer, with a tone for the pressure."
    ] = None
    size_calibration: Annotated[
        str,
        cli_meta("solid-mean|plane-strain|none|SIZE.json"),
        "Size calibration of the live view, whose frames are divided by their means.",
    ] = "solid-mean"
    force: bool = False


Span = tuple[NonNegative, NonNegative]  #: Begin and length, s.
Share = Annotated[float, Meta(ge=0, le=1)]


class FaultOptions(Options):
    """Faults of an emulated device, at times of the scan."""

    drop: Annotated[Share, "Share of the records that are not sent."] = 0.0
    corrupt: Annotated[Share, "Share of the records with one bit changed."] = 0.0
    stall: Annotated[
        Span | None, cli_meta("AT FOR"), "Send nothing for FOR s from AT s on; those records are lost."
    ] = None
    disconnect_s: Annotated[NonNegative | None, cli_meta("AT", option="disconnect"), "Disconnect at AT s."] = None
    hold: Annotated[int, Meta(ge=1), "Tracker: measure only every n-th pose."] = 1
    hide: Annotated[Span | None, cli_meta("AT FOR"), "Tracker: its tool is out of sight for FOR s from AT s on."] = None
    breathe_mm: Annotated[
        float,
        cli_meta("MM", option="breathe", ge=0, le=100),
        "Tracker: a second tool, Reference (or station 2), fixed to a body that breathes by MM; the first is Probe (or "
        "1).",
    ] = 0.0


class SectionOptions(Options, kw_only=True):
    """Cross-section of a simulated head."""

    head_radius_mm: Annotated[float, Meta(gt=0, le=1e6), "Radius of the head's arc, mm."] = presets.HEAD_RADIUS_MM
    shoulder_mm: Annotated[float, Meta(ge=0), "Radius of the head's shoulders, mm."] = presets.SHOULDER_MM


class CaseOptions(Options, kw_only=True):
    """Pressure, tissue and mesh of a forward study."""

    mean_kpa: Annotated[float, Meta(gt=0), "Mean pressure on the head."] = presets.MEAN_KPA
    fat_kpa: Annotated[float, Meta(gt=0), "Young's modulus of fat."] = presets.FAT_KPA
    poisson: Annotated[float, "Poisson's ratio of the tissues."] = presets.POISSON
    gland_ratio: Annotated[float, Meta(gt=0), "Modulus of gland over fat."] = presets.GLAND_RATIO
    thickness_mm: Annotated[Positive | None, "Depth of the chest wall, mm. Default: 70, or deeper for deep lumps."] = (
        None
    )
    fineness: Annotated[int, Meta(ge=1, le=8), "Mesh fineness; doubling it halves the elements."] = 2


class StudyOptions(CaseOptions, kw_only=True):
    """Options of the forward study."""

    model: Annotated[
        Literal["plane-strain", "solid"],
        "The paper's two-dimensional body, or balls under the whole head in three dimensions.",
    ] = "plane-strain"
    grid: Annotated[str, cli_meta("paper|FILE"), "The paper's 150 cases, or a table of cases."] = "paper"
    seat: Annotated[
        str,
        cli_meta("centred|resting|0..2"),
        "Seat of the lump, if a grid does not state it: 0 centred on the gland's surface, 1 resting on it.",
    ] = "centred"
    head: Literal["shoulders-inside", "shoulders-outside"] | None = None
    background: Annotated[
        Background | None,
        "Background of Eq 7, solid only: free (default) is fitted, fixed is 1. In two dimensions it is 1.",
    ] = None
    flat_field: Annotated[
        bool | None, "Remove what the head reads of the same body without the lump, solid only. Default: on."
    ] = None


KpaRange = tuple[Positive, Positive]


class TissueOptions(Options, kw_only=True):
    """Homogeneous tissue under a head, the pressures on it, and how unevenly the head may press."""

    modulus_kpa: Annotated[KpaRange, cli_meta("LOW HIGH"), "Young's moduli of the tissue (paper: 15 to 25)."] = (
        15.0,
        25.0,
    )
    pressure_kpa: Annotated[KpaRange, cli_meta("LOW HIGH"), "Mean pressures under the head (paper: 5 to 14)."] = (
        presets.PRESSURE_WINDOW_KPA
    )
    thickness_mm: Annotated[
        float, Meta(gt=0), "Thickness of the tissue on its rigid base, mm. The paper gives none."
    ] = presets.THICKNESS_MM
    poisson: Annotated[float, Meta(ge=0, lt=0.5), "Poisson's ratio of the tissue."] = presets.POISSON
    limit_percent: Annotated[
        float, Meta(gt=0), "Largest allowed departure of a taxel from the frame's mean, % of it (paper: 7.5)."
    ] = 7.5


class PopulationOptions(Options, kw_only=True):
    """Number of simulated bodies and exams, and how their maps are made."""

    masses: Annotated[int, Meta(ge=1, le=MOST_ITEMS), "Number of bodies, one lump each."] = 400
    centred: Annotated[
        int,
        Meta(ge=0, le=MOST_ITEMS),
        "Further bodies whose lump is centred on the gland's surface, as the paper has it.",
    ] = 0
    scans: Annotated[int, Meta(ge=1, le=1000), "Number of exams per body."] = 2
    normalise: Annotated[
        tuple[Literal["gain", "mean"], ...],
        "Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give it twice for a "
        "row by each from one scan.",
    ] = ("gain",)
    seed: Seed = 7


class SbcOptions(Options, kw_only=True):
    """Options of simulation-based calibration."""

    maps: Annotated[int, Meta(ge=1, le=MOST_ITEMS), "Maps to simulate."] = 200
    method: Annotated[
        Literal["laplace", "importance", "ensemble"],
        "Method of the posterior draws, as in `estimate`; ensemble takes 6 to 10 times as long.",
    ] = "importance"
    field_cosines: Annotated[
        FieldCosines, cli_meta("N|auto"), "Basis functions of the noise field, as field_cosines of `estimate`."
    ] = "auto"
    seed: Seed = 1


class LearnOptions(Options, kw_only=True):
    """Options of learning a size calibration from a table."""

    form: Annotated[
        Literal["eq6", "eq6-residual"],
        "eq6: as printed, from a table of lumps, or of bodies made by `population`; eq6-residual: with what Eq 6 "
        "leaves of the sizes, of bodies only.",
    ] = "eq6"
    fit: Annotated[
        Literal["joint", "two-stage"],
        "eq6: joint posterior of m, b, e, f from all rows, or the paper's two stages (needs depth_ratio).",
    ] = "joint"
    normalise: Annotated[
        Normalise | None,
        "Normalisation of the table's maps, if the table does not state it; of a table of `population` with rows by "
        "several, which to learn from. Default: mean.",
    ] = None
    background: Annotated[
        Background | None,
        "Background in the table's fits, if the table does not state it. Default: fixed, or free with --normalise "
        "none.",
    ] = None
    fit_radius_mm: Annotated[
        Positive | None,
        f"Radius of the table's fit windows, mm, if the table does not state it. Default: {presets.FIT_RADIUS_MM:g}.",
    ] = None
    noise: Annotated[
        Noise | None,
        "Noise model of the table's fits, if the table does not state it; least squares is independent. Default: "
        "independent.",
    ] = None
    least_stiffness_ratio: Annotated[
        float, Meta(ge=0), "Leave out lumps softer than this: above 8 the paper's widths change by less than 5 %."
    ] = 0.0
    seed: Seed = 1
