"""All statistics of a trial in one call."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from tactile_bayes.declarations import UNSET, Meta, Record, UnsetType
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.trial import accuracy
from tactile_bayes.trial.calibration import Calibration, Coverage, calibration, coverage, prediction_of
from tactile_bayes.trial.figures import (
    JACKKNIFE,
    Count,
    Ends,
    Figures,
    Intervals,
    NotNegative,
    Reasons,
    Share,
    clopper_pearson,
    effective_number,
    fields_of,
)
from tactile_bayes.trial.method_comparison import MethodComparison, compare_methods
from tactile_bayes.trial.next_mass import NextMass
from tactile_bayes.trial.readings import ModalitySizes, Trial, unit_doubts
from tactile_bayes.trial.replicates import ReplicateFigures, reader_components, replicate_figures, spread_figures

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

    n: Annotated[int, Meta(ge=0)]  #: Masses looked for.
    detected: Count
    detected_interval: Ends | None
    patients: Count
    readings: Count
    readings_detected: Count
    masses_not_done: Count
    masses_without_reading: Count
    mape_percent: NotNegative | None
    """Mean absolute error in percent of the ex-vivo size; a mass not detected has size 0."""
    mape_percent_interval: Ends | None
    mape_detected_percent: NotNegative | None  #: The same over detected masses.
    mape_detected_percent_interval: Ends | None
    mae_mm: NotNegative | None  #: Mean absolute error in mm; a mass not detected has size 0.
    mae_mm_interval: Ends | None
    mae_detected_mm: NotNegative | None  #: The same over detected masses.
    mae_detected_mm_interval: Ends | None
    weighted_mape_percent: NotNegative | None  #: Sum of absolute errors over the sum of ex-vivo sizes, percent.
    weighted_mape_percent_interval: Ends | None
    median_error_percent: NotNegative | None  #: Median absolute error in percent of the ex-vivo size.
    bias_percent: Annotated[float, Meta(ge=-100)] | None
    """100 (geometric mean of size over ex-vivo size - 1), over detected masses."""
    bias_percent_interval: Ends | None
    slope_through_origin: NotNegative | None
    """Slope of sizes on ex-vivo sizes without intercept; a mass not detected has size 0."""
    slope_through_origin_interval: Ends | None
    r2_centred: AtMostOne | None  #: 1 - SSE0 / SST; a mass not detected has size 0.
    r2_uncentred: AtMostOne | None  #: 1 - SSE0 / sum of squared sizes; a mass not detected has size 0.
    r2_pearson: Share | None  #: Squared correlation coefficient; a mass not detected has size 0.
    pearson_r: Correlation | None  #: Correlation coefficient; a mass not detected has size 0.
    slope_through_origin_detected: NotNegative | None
    """Slope of sizes on ex-vivo sizes without intercept, over detected masses."""
    slope_through_origin_detected_interval: Ends | None
    r2_centred_detected: AtMostOne | None  #: 1 - SSE0 / SST, over detected masses.
    r2_uncentred_detected: AtMostOne | None  #: 1 - SSE0 / sum of squared sizes, over detected masses.
    r2_pearson_detected: Share | None  #: Squared correlation coefficient, over detected masses.
    pearson_r_detected: Correlation | None  #: Correlation coefficient, over detected masses.
    within_mass_sd_mm: NotNegative | None  #: Mean over masses of the SD of detected replicates, mm.
    within_mass_sd_mm_interval: Ends | None
    within_mass_sd_rms_mm: NotNegative | None
    """Root of the mean variance of detected replicates, by degrees of freedom, mm."""
    within_mass_sd_rms_mm_interval: Ends | None
    within_mass_cv_percent: NotNegative | None  #: Mean over masses of SD over mean of detected replicates, percent.
    within_mass_cv_percent_interval: Ends | None
    within_mass_cv_rms_percent: NotNegative | None  #: Root mean square of SD over mean, by degrees of freedom, percent.
    within_mass_cv_rms_percent_interval: Ends | None
    reasons: Reasons
    coverage: tuple[Coverage, ...]
    method_comparison: MethodComparison
    replicates: ReplicateFigures
    calibration: Calibration | None
    cautions: tuple[str, ...]  #: Conditions of this trial under which intervals hold less often than they say.


class Counts(Record):
    """How much a trial is made of."""

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
    paired_comparisons: tuple[
        accuracy.PairedComparison, ...
    ]  #: Every pair of modalities on the masses that both looked for.
    doubts: tuple[str, ...]  #: What looks like another unit than mm.
    conventions: dict[str, str]
    next_mass: NextMass | UnsetType = UNSET  #: Errors-in-variables model: what the next mass may bring.
    provenance: dict[str, Any]
    research_use: Annotated[str, Meta(min_length=1)]


def summarise(
    trial: Trial,
    *,
    intervals: Intervals = JACKKNIFE,
    error_ratio: float = 1.0,
    seed: int = 1999,
    provenance: Mapping[str, Any] | None = None,
) -> TrialReport:
    """Compare each modality's sizes with excision.

    `error_ratio` is the variance of the error of ex-vivo sizes over that of a modality's, for the Deming lines; `seed`
    is of the sign flips.
    """
    readings, ex_vivo_mm, sizes = trial.readings, trial.ex_vivo_mm, trial.sizes()
    return TrialReport(
        schema="tactile-bayes/validate/1",
        interval_probability=intervals.probability,
        counts=Counts(
            patients=len({patient for patient, _ in ex_vivo_mm}),
            masses=len(ex_vivo_mm),
            masses_without_any_reading=len(set(ex_vivo_mm) - {reading.key for reading in readings}),
            readings=len(readings),
            synthetic_readings=sum(reading.synthetic for reading in readings),
            masses_of_several_visits=trial.other_visits.masses,
            readings_of_earlier_visits=trial.other_visits.earlier,
            readings_after_excision=trial.other_visits.later,
        ),
        modalities={
            name: modality_report(one, trial, intervals=intervals, error_ratio=error_ratio)
            for name, one in sizes.items()
        },
        mape_ratio_to_tactile=accuracy.mape_ratios(sizes, intervals=intervals),
        paired_comparisons=tuple(accuracy.paired_comparisons(sizes, intervals=intervals, seed=seed)),
        doubts=tuple(unit_doubts(sizes, np.array(list(ex_vivo_mm.values()), dtype=np.float64))),
        conventions=CONVENTIONS,
        provenance=dict(provenance or {}),
        research_use=RESEARCH_USE,
    )


def modality_report(
    sizes: ModalitySizes, trial: Trial, *, intervals: Intervals, error_ratio: float = 1.0
) -> ModalityReport:
    """Report one modality: counts, all figures, coverage."""
    found, prediction = trial.found(sizes.name), prediction_of(trial, sizes.name)
    fields = fields_of({name: one for family in FAMILIES for name, one in family(sizes, intervals=intervals).items()})
    if prediction is None:
        fields["reasons"]["calibration"] = "no reading states an interval or a standard deviation"
    share, n = None, len(sizes.size_mm)
    if n:  # for the effective number of patients: masses of one are no new trials
        number = effective_number(np.ones(n), sizes.patient)
        share = clopper_pearson(float(sizes.detected.mean()) * number, number, confidence=intervals.probability)
    return ModalityReport(
        n=n,
        detected=int(sizes.detected.sum()),
        detected_interval=share,
        patients=len(sizes.patients),
        readings=sizes.readings,
        readings_detected=sum(len(group) for group in sizes.replicates_mm),
        masses_not_done=sizes.masses_not_done,
        masses_without_reading=sizes.masses_without_reading,
        **fields,
        coverage=coverage(found, trial.ex_vivo_mm, confidence=intervals.probability),
        method_comparison=compare_methods(sizes, intervals=intervals, error_ratio=error_ratio),
        replicates=ReplicateFigures(
            **fields_of(replicate_figures(sizes, intervals=intervals)),
            variance_components=reader_components(found),
        ),
        calibration=None if prediction is None else calibration(prediction, confidence=intervals.probability),
        cautions=accuracy.cautions(sizes, intervals=intervals),
    )
