"""All statistics of a trial in one call, with coverage and calibration of the intervals that its readings state."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, kolmogi, ndtr, ndtri

from tactile_bayes.declarations import UNSET, Meta, Record, UnsetType
from tactile_bayes.options import NonNegative, Share
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.trial import accuracy
from tactile_bayes.trial.figures import (
    JACKKNIFE,
    MIN_PATIENTS,
    Count,
    Ends,
    Figures,
    Intervals,
    Reasons,
    clopper_pearson,
    effective_number,
    fields_of,
)
from tactile_bayes.trial.method_comparison import MethodComparison, compare_methods
from tactile_bayes.trial.next_mass import NextMass
from tactile_bayes.trial.readings import FloatArray, MassKey, ModalitySizes, Reading, Trial, mass_numbers
from tactile_bayes.trial.replicates import ReplicateFigures, reader_components, replicate_figures, spread_figures

# --- Coverage of stated intervals against the size after excision.


class Coverage(Record):
    """Coverage of the ex-vivo size by intervals of one nominal probability: `covered` of `n`, on `masses` masses.

    The ex-vivo size is itself a measurement (+-5 % in the paper), so even honest intervals of the true size cover it a
    little less often than they say.
    """

    probability: Annotated[float, Meta(gt=0, lt=1)]
    n: Annotated[int, Meta(ge=1)]
    covered: Count
    masses: Annotated[int, Meta(ge=1)]
    fraction: Share
    fraction_interval: Ends


def coverage(
    readings: Sequence[Reading], ex_vivo_mm: Mapping[MassKey, float], *, confidence: float
) -> tuple[Coverage, ...]:
    """Coverage at each nominal probability by the readings that state an interval, its ends included.

    Replicates of a mass share its ex-vivo size, so n intervals on m masses are not n trials. `fraction_interval` is
    that of m trials: exact where each mass has one interval, on the wide side where it has more.
    """
    by_probability: dict[float, list[tuple[MassKey, bool]]] = defaultdict(list)
    for one in readings:
        if (ends := one.interval) is not None:
            by_probability[ends.probability].append((one.key, ends.low_mm <= ex_vivo_mm[one.key] <= ends.high_mm))
    levels = []
    for probability, group in sorted(by_probability.items()):
        n, covered, masses = len(group), sum(inside for _, inside in group), len({key for key, _ in group})
        share = clopper_pearson(covered * masses / n, masses, confidence=confidence)
        levels.append(Coverage(probability, n, covered, masses, covered / n, share))
    return tuple(levels)


# --- Calibration of stated uncertainties: probability integral transforms, scores, and the implied correction.
#
# A stated uncertainty becomes a predictive distribution of the size that the caliper will read: normal on the
# logarithm of size, through the stated interval (or mean and SD), widened in quadrature by the caliper's own error.

LEVELS = (0.5, 0.8, 0.9, 0.95)
BINS = 10


class Prediction(Record, eq=False):
    """Predictive distributions of log ex-vivo sizes, one per reading, and the ex-vivo sizes."""

    median_log: FloatArray
    sd_log: FloatArray
    """`median_log`, `sd_log`: (n,) arrays of each prediction: the logarithm of its median in mm and its SD, caliper
    error included."""
    ex_vivo_log: FloatArray  #: (n,) array: logarithm of the ex-vivo size in mm.
    mass: npt.NDArray[np.int64]  #: (n,) array of the masses' numbers.

    @property
    def z(self) -> FloatArray:
        """(n,) standardised errors: standard normal when the uncertainties are honest."""
        return (self.ex_vivo_log - self.median_log) / self.sd_log


class LevelCoverage(Record):
    """Central intervals of one nominal probability: `covered` of the readings, with an exact interval by masses."""

    probability: float
    covered: Count
    n: Count
    interval: Ends


class Calibration(Record):
    """Figures that show how well the stated uncertainties are calibrated."""

    n: Count
    masses: Count
    levels: tuple[LevelCoverage, ...]
    pit: tuple[Count, ...]  #: Integral transforms: counts in ten equal bins.
    ecdf_band: float  #: Half-width of the band about the transforms' distribution function (Kolmogorov).
    ecdf_distance: float  #: Largest distance from the diagonal; above the band, the uncertainties are refuted.
    crps_mm: float | None  #: Mean continuous ranked probability score of the size.
    interval_score_mm: float | None  #: Mean interval score at 95 %: width, and 40 mm for each mm outside.
    scale: float  #: Factor by which SDs should be multiplied to be honest in the mean square.
    scale_interval: Ends
    shift_percent: float  #: Median of the found sizes over the predicted, less 100 %.
    advice: str


def calibration(prediction: Prediction, *, confidence: float) -> Calibration:
    """Calibration of at least one prediction.

    Readings of one mass share its ex-vivo size, so intervals and the band take n readings on m masses as m trials.
    """
    z = prediction.z
    pit = ndtr(z)
    masses = len(np.unique(prediction.mass))
    ordered = np.sort(pit)
    steps = np.arange(len(pit) + 1) / len(pit)
    distance = float(max(np.max(steps[1:] - ordered), np.max(ordered - steps[:-1])))
    mean, tail = float(np.mean(z**2)), 0.5 - 0.5 * confidence
    # chi-squared, one degree of freedom per mass
    low, high = (math.sqrt(masses * mean / float(chdtri(masses, p))) for p in (tail, 1 - tail))
    scale = math.sqrt(mean)
    levels = []
    for level in LEVELS:
        covered = int(np.sum(np.abs(z) <= float(ndtri(0.5 + 0.5 * level))))
        interval = clopper_pearson(covered * masses / len(z), masses, confidence=confidence)
        levels.append(LevelCoverage(level, covered, len(z), interval))
    band = float(kolmogi(1 - confidence)) / math.sqrt(masses)
    return Calibration(
        n=len(z),
        masses=masses,
        levels=tuple(levels),
        pit=tuple(int(count) for count in np.histogram(pit, bins=BINS, range=(0, 1))[0]),
        ecdf_band=band,
        ecdf_distance=distance,
        crps_mm=_finite_mean(crps_log_normal(prediction)),
        interval_score_mm=_finite_mean(interval_score(prediction, probability=0.95)),
        scale=scale,
        scale_interval=(low, high),
        shift_percent=100 * math.expm1(float(np.median(prediction.ex_vivo_log - prediction.median_log))),
        advice=_advice(scale, (low, high), masses, distance > band),
    )


def _finite_mean(values: FloatArray) -> float | None:
    """Mean; None where a stated uncertainty is too wide for double precision."""
    mean = float(np.mean(values))
    return mean if math.isfinite(mean) else None


def crps_log_normal(prediction: Prediction) -> FloatArray:
    r"""(n,) continuous ranked probability scores in mm of log-normal predictions.

    With :math:`\omega = (\ln y - \mu)/\sigma`,

    .. math:: y(2\Phi(\omega) - 1) - 2e^{\mu + \sigma^2/2}(\Phi(\omega - \sigma) + \Phi(\sigma/\sqrt 2) - 1)

    Baran & Lerch (2015), Q. J. R. Meteorol. Soc. 141, 2289.
    """
    w, sd, ex_vivo = prediction.z, prediction.sd_log, np.exp(prediction.ex_vivo_log)
    mean = np.exp(prediction.median_log + sd**2 / 2)
    return np.asarray(ex_vivo * (2 * ndtr(w) - 1) - 2 * mean * (ndtr(w - sd) + ndtr(sd / math.sqrt(2)) - 1))


def interval_score(prediction: Prediction, *, probability: float) -> FloatArray:
    """(n,) interval scores in mm: Gneiting & Raftery (2007), J. Am. Stat. Assoc. 102, 359, eq. 43."""
    reach = float(ndtri(0.5 + 0.5 * probability)) * prediction.sd_log
    low, high = np.exp(prediction.median_log - reach), np.exp(prediction.median_log + reach)
    ex_vivo = np.exp(prediction.ex_vivo_log)
    outside = np.maximum(low - ex_vivo, 0) + np.maximum(ex_vivo - high, 0)
    return np.asarray(high - low + 2 / (1 - probability) * outside)


def log_normal(reading: Reading) -> tuple[float, float] | None:
    """Median (log of mm) and SD of the log of a reading: from its interval, else from size and SD."""
    ends = reading.interval
    if ends is not None and 0 < ends.low_mm < ends.high_mm:
        low, high, reach = math.log(ends.low_mm), math.log(ends.high_mm), float(ndtri(0.5 + 0.5 * ends.probability))
        return (low + high) / 2, (high - low) / (2 * reach)
    if reading.sd_mm and reading.size_mm is not None:
        variance = math.log1p((reading.sd_mm / reading.size_mm) ** 2)
        return math.log(reading.size_mm) - variance / 2, math.sqrt(variance)
    return None


def prediction_of(trial: Trial, modality: str) -> Prediction | None:
    """Stated uncertainties of a modality's readings as predictive distributions; None where no reading states one.

    The caliper's relative error is added in quadrature.
    """
    sized = trial.sized_readings(modality)
    stated = [(one.key, uncertainty) for one in sized if (uncertainty := log_normal(one)) is not None]
    if not stated:
        return None
    masses = mass_numbers(trial.ex_vivo_mm)
    ex_vivo = np.array([trial.ex_vivo_mm[key] for key, _ in stated], dtype=np.float64)
    caliper = np.array([trial.ex_vivo_sd_mm.get(key) or 0.0 for key, _ in stated]) / ex_vivo
    medians, sds = np.array([uncertainty for _, uncertainty in stated], dtype=np.float64).T
    numbers = np.array([masses[key] for key, _ in stated])
    return Prediction(medians, np.sqrt(sds**2 + np.log1p(caliper**2)), np.log(ex_vivo), numbers)


def _advice(scale: float, ends: Ends, masses: int, refuted: bool) -> str:
    """Sentence on the stated uncertainties: adequate, too narrow or too wide by `scale`, or too few masses to judge."""
    if masses < MIN_PATIENTS:
        return f"too few masses ({masses}) to judge; at least {MIN_PATIENTS} are needed"
    if ends[0] <= 1 <= ends[1]:
        if refuted:
            return "widths agree with the errors, but their shape or centre does not: look at the PIT histogram"
        return "no change: the widths agree with the errors found"
    word, factor = "too narrow" if scale > 1 else "too wide", f"{scale:.2f} ({ends[0]:.2f} to {ends[1]:.2f})"
    return f"stated uncertainties are {word}: multiply the SD of log size by {factor}"


# --- The report: counts, figures, coverage and calibration of each modality, and modalities compared.

FAMILIES = (accuracy.accuracy_figures, accuracy.origin_line_figures, spread_figures)
AtMostOne = Annotated[float, Meta(le=1)]
Correlation = Annotated[float, Meta(ge=-1, le=1)]
CONVENTIONS: dict[str, str] = {
    "masses": "sizes are averaged over the detected replicates of a mass first; a mass counts once",
    "detected": "a mass found in at least one replicate",
    "not_detected": "counted as size 0 (100 % error) in figures without '_detected', as in Wellman & Howe (1999)",
    "not_done": "left out and counted",
    "bias_percent": "100 (geometric mean of size / ex vivo - 1), over detected masses only",
    "slope_through_origin": "sizes on ex-vivo sizes without an intercept",
    "r2_centred": "1 - SSE0 / SST, the headline; below 0 when the mean would do better",
    "r2_uncentred": "1 - SSE0 / sum of squared sizes",
    "r2_pearson": "squared correlation",
    "within_mass": "mean over masses of the SD of replicates; '_rms': root of the mean variance by degrees of freedom",
    "weighted_mape_percent": "sum of absolute errors over the sum of ex-vivo sizes, in percent",
    "median_error_percent": "median absolute error in percent of the ex-vivo size",
    "method_comparison": "detected masses only; x is the ex-vivo size, differences are size - ex vivo; "
    "'analytic_intervals' take masses as independent, the others are over patients",
    "error_ratio": "variance of the ex-vivo error over that of the modality's, for the two Deming lines",
    "passing_bablok": "shifted median of slopes, middle slopes averaged as angles",
    "limits": "of agreement, for single readings, 95 % of differences; 'log_ratio' as ln(size / ex vivo); their "
    "intervals take masses as independent and differences as normal, those of 'limit_low_mm' etc. are over patients",
    "mape_ratio_to_tactile": "on the masses that both looked for, or that both found",
    "repeatability": "change between two readings of one mass in 95 % of pairs, by the within-mass SD of ln size",
    "calibration": "stated intervals as normal on ln size, the caliper's error added in quadrature",
    "paired_comparisons": "masses that both modalities looked for; not detected counts as size 0; sign-flip test by "
    "patient, p_holm corrected for all pairs",
    "intervals": "over patients, as the setting 'intervals' says: 'corrected' and 'jackknife' leave one patient out "
    "and take Student's t, 'corrected' allowing for misses not seen and few influential patients; shares: "
    "Clopper-Pearson",
}


class ModalityReport(Figures):
    """Counts, figures and coverage of one modality on its `n` masses."""

    n: Count  #: Masses looked for.
    detected: Count
    detected_interval: Ends | None
    patients: Count
    readings: Count
    readings_detected: Count
    masses_not_done: Count
    masses_without_reading: Count
    mape_percent: NonNegative | None
    """Mean absolute error in percent of the ex-vivo size; a mass not detected has size 0."""
    mape_percent_interval: Ends | None
    mape_detected_percent: NonNegative | None  #: The same over detected masses.
    mape_detected_percent_interval: Ends | None
    mae_mm: NonNegative | None  #: Mean absolute error in mm; a mass not detected has size 0.
    mae_mm_interval: Ends | None
    mae_detected_mm: NonNegative | None  #: The same over detected masses.
    mae_detected_mm_interval: Ends | None
    weighted_mape_percent: NonNegative | None  #: Sum of absolute errors over the sum of ex-vivo sizes, percent.
    weighted_mape_percent_interval: Ends | None
    median_error_percent: NonNegative | None  #: Median absolute error in percent of the ex-vivo size.
    bias_percent: Annotated[float, Meta(ge=-100)] | None
    """100 (geometric mean of size over ex-vivo size - 1), over detected masses."""
    bias_percent_interval: Ends | None
    slope_through_origin: NonNegative | None
    """Slope of sizes on ex-vivo sizes without intercept; a mass not detected has size 0."""
    slope_through_origin_interval: Ends | None
    r2_centred: AtMostOne | None  #: 1 - SSE0 / SST; a mass not detected has size 0.
    r2_uncentred: AtMostOne | None  #: 1 - SSE0 / sum of squared sizes; a mass not detected has size 0.
    r2_pearson: Share | None  #: Squared correlation coefficient; a mass not detected has size 0.
    pearson_r: Correlation | None  #: Correlation coefficient; a mass not detected has size 0.
    slope_through_origin_detected: NonNegative | None
    """Slope of sizes on ex-vivo sizes without intercept, over detected masses."""
    slope_through_origin_detected_interval: Ends | None
    r2_centred_detected: AtMostOne | None  #: 1 - SSE0 / SST, over detected masses.
    r2_uncentred_detected: AtMostOne | None  #: 1 - SSE0 / sum of squared sizes, over detected masses.
    r2_pearson_detected: Share | None  #: Squared correlation coefficient, over detected masses.
    pearson_r_detected: Correlation | None  #: Correlation coefficient, over detected masses.
    within_mass_sd_mm: NonNegative | None  #: Mean over masses of the SD of detected replicates, mm.
    within_mass_sd_mm_interval: Ends | None
    within_mass_sd_rms_mm: NonNegative | None
    """Root of the mean variance of detected replicates, by degrees of freedom, mm."""
    within_mass_sd_rms_mm_interval: Ends | None
    within_mass_cv_percent: NonNegative | None  #: Mean over masses of SD over mean of detected replicates, percent.
    within_mass_cv_percent_interval: Ends | None
    within_mass_cv_rms_percent: NonNegative | None  #: Root mean square of SD over mean, by degrees of freedom, percent.
    within_mass_cv_rms_percent_interval: Ends | None
    reasons: Reasons
    coverage: tuple[Coverage, ...]
    method_comparison: MethodComparison
    replicates: ReplicateFigures
    calibration: Calibration | None
    cautions: tuple[str, ...]  #: Conditions of this trial under which intervals hold less often than they say.


class Counts(Record):
    """Numbers of patients, masses and readings of a trial."""

    patients: Count
    masses: Count
    masses_without_any_reading: Count
    readings: Count
    synthetic_readings: Count
    masses_of_several_visits: Count
    readings_of_earlier_visits: Count
    readings_after_excision: Count


class TrialReport(Record, kw_only=True):
    """Accuracy of each modality against excision."""

    schema: Literal["tactile-bayes/validate/1"]
    title: str | UnsetType = UNSET  #: Of the protocol.
    interval_probability: Annotated[float, Meta(gt=0, lt=1)]  #: Of every interval in this document.
    counts: Counts
    modalities: Annotated[dict[str, ModalityReport], Meta(min_length=1)]
    mape_ratio_to_tactile: dict[str, accuracy.ModalityRatio]
    """Percent error of each other modality over the tactile one's, on common masses; empty without a tactile one."""
    paired_comparisons: tuple[accuracy.PairedComparison, ...]
    """Every pair of modalities on the masses that both looked for."""
    doubts: tuple[str, ...]
    """Columns whose sizes seem to be in another unit than mm, or copied; codes that may be of one patient or mass."""
    conventions: dict[str, str]
    next_mass: NextMass | UnsetType = UNSET  #: Errors-in-variables model: what the next mass may bring.
    provenance: dict[str, Any]
    research_use: Annotated[str, Meta(min_length=1)]


def summarise(
    trial: Trial, *, intervals: Intervals = JACKKNIFE, error_ratio: float = 1.0, provenance: Mapping[str, Any] = {}
) -> TrialReport:
    """Compare each modality's sizes with excision.

    `error_ratio` is the variance of the error of ex-vivo sizes over that of a modality's, for the Deming lines.
    """
    ex_vivo_mm, sizes = trial.ex_vivo_mm, trial.sizes()
    done = [reading for reading in trial.readings if reading.status != "not_done"]
    return TrialReport(
        schema="tactile-bayes/validate/1",
        interval_probability=intervals.probability,
        counts=Counts(
            patients=len({patient for patient, _ in ex_vivo_mm}),
            masses=len(ex_vivo_mm),
            masses_without_any_reading=len(set(ex_vivo_mm) - {reading.key for reading in trial.readings}),
            readings=len(done),
            synthetic_readings=sum(reading.synthetic for reading in done),
            masses_of_several_visits=trial.other_visits.masses,
            readings_of_earlier_visits=trial.other_visits.earlier,
            readings_after_excision=trial.other_visits.later,
        ),
        modalities={
            name: modality_report(modality_sizes, trial, intervals=intervals, error_ratio=error_ratio)
            for name, modality_sizes in sizes.items()
        },
        mape_ratio_to_tactile=accuracy.mape_ratios(sizes, intervals=intervals),
        paired_comparisons=tuple(accuracy.paired_comparisons(sizes, intervals=intervals)),
        doubts=tuple(trial.doubts()),
        conventions=CONVENTIONS,
        provenance=dict(provenance),
        research_use=RESEARCH_USE,
    )


def modality_report(
    sizes: ModalitySizes, trial: Trial, *, intervals: Intervals, error_ratio: float = 1.0
) -> ModalityReport:
    """Report one modality: counts, all figures, coverage."""
    readings, prediction = trial.sized_readings(sizes.name), prediction_of(trial, sizes.name)
    families = (family(sizes, intervals=intervals).items() for family in FAMILIES)
    fields = fields_of(dict(chain.from_iterable(families)))
    if prediction is None:
        fields["reasons"]["calibration"] = (
            "no reading states an interval with a width and ends above 0, or a standard deviation"
        )
    detected_interval, n = None, len(sizes.size_mm)
    if n:  # masses of one patient are not independent: the effective number of patients takes the place of n
        trials = effective_number(np.ones(n), sizes.patient)
        share = float(sizes.detected.mean())
        detected_interval = clopper_pearson(share * trials, trials, confidence=intervals.probability)
    return ModalityReport(
        n=n,
        detected=int(sizes.detected.sum()),
        detected_interval=detected_interval,
        patients=len(sizes.patients),
        readings=sizes.readings,
        readings_detected=sum(len(group) for group in sizes.replicates_mm),
        masses_not_done=sizes.masses_not_done,
        masses_without_reading=sizes.masses_without_reading,
        **fields,
        coverage=coverage(readings, trial.ex_vivo_mm, confidence=intervals.probability),
        method_comparison=compare_methods(sizes, intervals=intervals, error_ratio=error_ratio),
        replicates=ReplicateFigures(
            **fields_of(replicate_figures(sizes, intervals=intervals)), variance_components=reader_components(readings)
        ),
        calibration=None if prediction is None else calibration(prediction, confidence=intervals.probability),
        cautions=accuracy.cautions(sizes, intervals=intervals),
    )
