"""Options declared once: type, range, default and meaning stand at a field, and the rest comes from there.

Click options (`commands.options.takes`), keywords and checks of Python, the settings file with its schema, and the
settings of a provenance are made of these records.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from tactile_bayes import presets
from tactile_bayes.declarations import Meta, Options, says
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import Background, Method, Noise, Normalise, Rotation, SceneAsked


class BumpPrior(Options):
    """Proper, weak priors, all of them printed with the estimate."""

    amplitude_sd: Annotated[
        float, says("Normal about 0, in units of the map's scale (1 for a normalised map)", gt=0, le=1000)
    ] = 2.0
    width_median_mm: Annotated[
        float, says("Median of the geometric mean of the two widths, log-normal", gt=0, le=100)
    ] = 5.0
    log_width_sd: Annotated[float, says("SD of its natural log", gt=0, le=10)] = 1.0
    log_ratio_sd: Annotated[
        float, says("SD of half the log of the axis ratio, along and across the diagonal", gt=0, le=5)
    ] = 0.5
    tilt_sd: Annotated[
        float,
        says(
            "SD of the level's slope over half a window, in units of the map's scale; for its odds only", gt=0, le=1000
        ),
    ] = 0.1


PRIORS: Final = BumpPrior.__struct_fields__


MOST_PATIENTS: Final = 10_000  #: Of a plan.
MOST_ITEMS: Final = 1_000_000  #: Of a batch: memory holds a name and an outcome for each.
IN_FILE: Final = {"file": True}  #: Of a setting that stands in the file of `--settings`, not on the command line.


def named(metavar: str, meaning: str, *, option: str = "", also: str = "", path: bool = False, **rules: Any) -> Meta:
    """Meaning and rules of an option whose value has a name in the help.

    `option` and `also` name it on the command line, if not by its field, and a second time; a `path` is checked against
    the call's other files.
    """
    held = {"metavar": metavar, "option": option, "also": also, "path": path}
    return Meta(description=meaning, extra={name: value for name, value in held.items() if value}, **rules)


FieldCosines = Annotated[int, Meta(ge=6, le=presets.MOST_FIELD_COSINES)] | Literal["auto"]


class FitSettings(BumpPrior, kw_only=True):
    """How a map is fitted and its posterior drawn; must agree with the recipe of the size calibration."""

    method: Annotated[
        Method,
        says(
            "importance: weighted draws; ensemble: MCMC; laplace: mode, curvature; optimise: the paper's least squares."
        ),
    ] = "importance"
    background: Annotated[
        Background | None,
        says(
            "Level about the lump: fixed at 1, or fitted. Default: as for the calibration's maps; free "
            "where the level is not known (normalise none)",
            extra=IN_FILE,
        ),
    ] = None
    fit_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        says("Radius of the fitted window. Default: the calibration's, else 20", extra=IN_FILE),
    ] = None
    rotation: Annotated[
        Rotation,
        says(
            "Rotated ellipse: used where the map favours it, always, or never. Correlated noise: `--scene` decides",
            extra=IN_FILE,
        ),
    ] = "auto"
    centre_mm: Annotated[
        tuple[float, float] | None,
        named("X Y", "Place on the map to measure. Default: the highest bump that can be a lump."),
    ] = None
    noise: Annotated[
        Noise | None,
        says(
            "independent: white noise, the likelihood divided by the inflation of correlated errors; "
            "field: correlated noise in the model. Default: the calibration's",
            extra=IN_FILE,
        ),
    ] = None
    field_cosines: Annotated[
        FieldCosines,
        says(
            "Basis functions of the correlated noise along each axis: more are slower and resolve shorter "
            "correlation; `tradeoff estimate` measures the difference. auto: 18, up to 30 for a narrow lump",
            extra=IN_FILE,
        ),
    ] = "auto"
    accuracy_sd: Annotated[
        Annotated[float, Meta(ge=0.001, le=0.5)] | None,
        says(
            "Monte-Carlo error to reach in the interval ends of sizes and map widths, in posterior SDs. "
            "Default: 0.02 for importance, 0.1 for ensemble."
        ),
    ] = None
    accuracy_mm: Annotated[
        Annotated[float, Meta(ge=0.0001, le=10)] | None,
        says(
            "Wanted Monte-Carlo error of interval ends, in mm; the finer of this and --accuracy-sd holds", extra=IN_FILE
        ),
    ] = None
    scene: Annotated[
        SceneAsked, says("Structures in the fit window; auto: the simplest scene that the map supports.")
    ] = "auto"
    max_steps: Annotated[
        Annotated[int, Meta(ge=150)] | None,
        says("Longest MCMC chain (method ensemble) before it gives up", extra=IN_FILE),
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

    cell_mm: Annotated[float, says("Side of the square cells, mm.", ge=0.01, le=50)] = presets.CELL_MM
    pressure_window_kpa: Annotated[
        tuple[Annotated[float, Meta(ge=0)], Annotated[float, Meta(ge=0)]],
        named("LOW HIGH", "Leave out frames whose mean pressure lies outside."),
    ] = presets.PRESSURE_WINDOW_KPA
    normalise: Annotated[
        Normalise,
        says("gain: estimate one gain per frame; mean: divide each frame by its mean (the paper); none: keep kPa."),
    ] = presets.DEFAULT_NORMALISE
    latency_ms: Annotated[
        Annotated[float, Meta(ge=-10_000, le=10_000)] | Literal["auto"],
        named("MS|auto", "Delay of the tracker's time stamps; auto: estimate it from the scan, or refuse."),
    ] = 0.0
    plane_radius_mm: Annotated[
        Annotated[float, Meta(gt=0)] | Literal["auto", "all"],
        named(
            "MM|auto|all",
            "Fit the plane to frames within this distance of the mass; auto: those whose array can reach it.",
        ),
    ] = "all"
    flat_field: Annotated[bool, says("Remove the head's own response, measured on frames without a lump.")] = False
    register_strokes: Annotated[
        bool, says("Align the strokes with each other, for a lump that moves with the head.")
    ] = False
    as_stated: Annotated[
        bool,
        says(
            "Take array, lever arm and quaternions as stated, with a caution where frames contradict them; "
            "else such a scan is refused."
        ),
    ] = False
    every: Annotated[
        int, named("N", "Use one frame of every N: quicker, and noisier; `tradeoff map` measures both.", ge=1)
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


GROWN_BY: Final = (0.2,)
"""Shares of the diameter that a growth's probability is told for; 20 % is the step of RECIST 1.1."""


class Comparing(Options):
    """How visits are compared."""

    days: Annotated[
        tuple[float, ...] | None, says("Time of each visit in days, the first at 0; None where it is not known.")
    ] = None
    grown_by: Annotated[
        tuple[Annotated[float, Meta(gt=-1, lt=10)], ...],
        says("Shares of the diameter by which it may have grown or more."),
    ] = GROWN_BY
    same_mass: Annotated[
        bool, says("Say that the visits are of one mass where landmarks are missing, or place it too far apart.")
    ] = False
    registration_mm: Annotated[
        float, says("SD each way of one mass's place between visits, by posture and landmarks.", gt=0)
    ] = presets.REGISTRATION_MM

    def check_visits(self, visits: int) -> None:
        """Refuse days that are no times of so many visits."""
        if self.days is None:
            return
        if len(self.days) != visits:
            given, later = len(self.days) - 1, visits - 1
            raise UsageError(f"times are given for {given} later visits, and there are {later}; give one for each")
        if any(after <= before for before, after in zip(self.days, self.days[1:], strict=False)):
            listed = ", ".join(f"{day:g}" for day in self.days)
            raise UsageError(f"the visits' days are {listed}; give them in order, each later than the one before")


IntervalMethod = Literal["corrected", "jackknife", "bca"]
Seed = Annotated[int, says("Random seed.", ge=0)]
Workers = Annotated[int, says("Number of worker processes.", ge=0)]


class TrialSettings(Options):
    """Settings of a trial's analysis; each is part of the provenance."""

    intervals: Annotated[
        IntervalMethod,
        says(
            "Interval method, resampling patients. corrected: jackknife with Student's t, corrected for "
            "rare misses and few influential patients; jackknife: uncorrected; bca: bootstrap."
        ),
    ] = "corrected"
    resamples: Annotated[int, says("Number of bootstrap resamples.", ge=200, le=100_000)] = 2000
    seed: Seed = 1999
    error_ratio: Annotated[
        float, says("Ratio of the ex-vivo error's variance to the modality's, for Deming lines.", ge=1e-6, le=1e6)
    ] = 1.0
    check_intervals: Annotated[
        int, named("TRIALS", "Simulate this many trials of this size and report how often the intervals cover.", ge=0)
    ] = 0
    bayes: Annotated[bool, says("Predict the error of the next mass, by an errors-in-variables model and MCMC.")] = (
        False
    )


Aim = Literal["power", "precision"]


class PlanErrors(Options):
    """Errors of ln size that a plan assumes; an SD of 0.15 is about 15 %."""

    tactile_bias: Annotated[float, says("Mean of ln(size / ex vivo).", ge=-3, le=3)] = 0.02
    mass_sd: Annotated[float, says("SD of ln size shared by a mass's maps.", ge=0, le=3)] = 0.18
    map_sd: Annotated[float, says("SD of ln size of single maps.", ge=0, le=3)] = 0.15
    other_bias: Annotated[float, says("Mean of ln(size / ex vivo) of the modality compared with.", ge=-3, le=3)] = -0.08
    other_sd: Annotated[float, says("SD of ln size of the modality compared with.", ge=0, le=3)] = 0.40
    other_miss: Annotated[float, says("Share of masses that the modality compared with misses.", ge=0, le=1)] = 0.04


class PlanOptions(Options, kw_only=True):
    """Designs of a trial that are simulated, or what the number of patients is to reach instead of being given."""

    patients: Annotated[
        tuple[Annotated[int, Meta(ge=8, le=MOST_PATIENTS)], ...], says("Number of patients, one mass each.")
    ] = (16, 24, 32, 48)
    maps: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=1000)], ...],
        says("Number of tactile maps per mass; 3 with --power or --precision."),
    ] = (1, 3, 5)
    power: Annotated[
        Annotated[float, Meta(ge=0.5, le=0.99)] | None,
        named("SHARE", "Find the number of patients that reaches this power, such as 0.9."),
    ] = None
    precision: Annotated[
        Annotated[float, Meta(ge=1.05, le=10)] | None,
        named(
            "FACTOR",
            "Find the number of patients whose interval of the tactile error spans this factor from end to "
            "end, such as 2.",
        ),
    ] = None
    against: Annotated[str, says("Modality of the pilot to compare with.")] = "ultrasound"
    trials: Annotated[int, says("Number of simulated trials per design.", ge=50, le=MOST_ITEMS)] = 1000
    seed: Seed = 1999
    workers: Workers = 1

    @property
    def wanted(self) -> dict[Aim, float]:
        """What was given."""
        each: dict[Aim, float | None] = {"power": self.power, "precision": self.precision}
        return {aim: target for aim, target in each.items() if target is not None}


class CampaignOptions(Options, kw_only=True):
    """How the exams of a table are mapped and matched, and what is done with them."""

    excision: Annotated[
        Path | None, named("EX.csv", "Sizes measured after excision: adds the trial's report.", path=True)
    ] = None
    columns: Annotated[
        Path | None, named("MAP.toml", "Layout of a wide EX.csv: which column holds what, in which unit.", path=True)
    ] = None
    protocol: Annotated[
        Path | None, named("FILE.toml", "Pre-specified analysis of the trial, as for `validate`.", path=True)
    ] = None
    normalise: Annotated[Normalise, says("As `map`.")] = presets.DEFAULT_NORMALISE
    match_mm: Annotated[
        float,
        named("MM", "Distance within which a mass is the one that another exam of the breast names by place.", gt=0),
    ] = presets.MATCH_MM
    figures: Annotated[bool, says("Draw map and size posterior of each exam.")] = False
    dry_run: Annotated[bool, says("Print what would be done, and do nothing.")] = False
    copy_to: Annotated[
        str | None, named("s3://BUCKET/FOLDER", "Copy every file into this folder of an object store, step by step.")
    ] = None
    workers: Workers = 1
    scheduler: Annotated[str | None, named("ADDRESS", "Send the exams to a dask scheduler (extra [cluster]).")] = None


class IdentityOptions(Options):
    """Patient and study of an export.

    Who was examined and when, as options or in the file of `export --worklist`; what is left out stays empty. The file
    may also be a modality worklist item of DICOM.
    """

    patient_id: Annotated[
        str, named("ID", "Patient ID; in csv files the beginning of the record ID.", max_length=64)
    ] = ""
    patient_name: Annotated[
        str, named("FAMILY^GIVEN", "Patient's name: FAMILY^GIVEN^MIDDLE^PREFIX^SUFFIX.", max_length=194)
    ] = ""
    birth_date: Annotated[str, named("YYYY-MM-DD", "Patient's date of birth: YYYY-MM-DD.", max_length=10)] = ""
    sex: Annotated[Literal["F", "M", "O", ""], named("F|M|O", "Patient's sex: F, M or O.")] = ""
    issuer: Annotated[str, named("NAME", "Who issued the patient ID.", max_length=64)] = ""
    accession: Annotated[str, named("NUMBER", "Accession number.", max_length=16)] = ""
    referring_physician: Annotated[
        str, named("FAMILY^GIVEN", "Referring physician's name, likewise.", max_length=194)
    ] = ""
    study_id: Annotated[str, named("ID", "Study ID.", max_length=16)] = ""
    study_description: Annotated[str, named("TEXT", "Study description.", max_length=64)] = ""
    study_uid: Annotated[
        str, named("UID", "Study Instance UID. Default: one that follows from the content of the maps.", max_length=64)
    ] = ""
    study_date: Annotated[
        str, named("DATE", "Date of the exam: YYYY-MM-DD or YYYY-MM-DDTHH:MM, with +HH:MM for the zone.", max_length=25)
    ] = ""
    content_date: Annotated[
        str, named("DATE", "Date at which the content was made. Default: the exam's.", max_length=25)
    ] = ""
