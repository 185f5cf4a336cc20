"""All statistics of a trial in one call."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.trial import accuracy, replicates
from tactile_bayes.trial import accuracy as origin_line
from tactile_bayes.trial import replicates as spread
from tactile_bayes.trial.accuracy import ModalityRatio, PairedComparison, cautions, mape_ratios, paired_comparisons
from tactile_bayes.trial.calibration import (
    Calibration,
    Coverage,
    Prediction,
    calibration,
    coverage,
    log_normal,
    predictions,
)
from tactile_bayes.trial.figures import SEED, Figure, clopper_pearson, effective_number
from tactile_bayes.trial.method_comparison import MethodComparison, compare_methods
from tactile_bayes.trial.readings import (
    MassKey,
    ModalitySizes,
    OtherVisits,
    Reading,
    gather,
    mass_numbers,
    patient_numbers,
    unit_doubts,
)
from tactile_bayes.trial.replicates import Components, reader_components

FAMILIES: tuple[Callable[..., dict[str, Figure]], ...] = (
    accuracy.accuracy_figures,
    origin_line.origin_line_figures,
    spread.spread_figures,
)


class ModalityReport(Record):
    """Counts, figures and coverage of one modality on its `n` masses."""

    name: str
    n: int
    detected: int
    detected_interval: tuple[float, float] | None
    patients: int
    readings: int
    readings_detected: int
    masses_not_done: int
    masses_without_reading: int
    figures: Mapping[str, Figure]
    coverage: tuple[Coverage, ...]
    methods: MethodComparison
    replicates: Mapping[str, Figure]
    components: Components | None = None
    calibration: Calibration | None = None
    prediction: Prediction | None = None
    cautions: tuple[str, ...] = ()


class TrialReport(Record):
    """Reports of all modalities, ratios to the tactile one, paired comparisons, and counts.

    `sizes` are those that the figures were made from; `ex_vivo_sd_mm` is by the number of the mass. `doubts` says what
    looks like another unit than mm. `other_visits` counts the readings that are not of the last visit before excision.
    """

    modalities: Mapping[str, ModalityReport]
    ratios: Mapping[str, ModalityRatio]
    patients: int
    masses: int
    masses_without_any_reading: int
    synthetic_readings: int
    readings: int
    confidence: float
    paired: tuple[PairedComparison, ...] = ()
    sizes: Mapping[str, ModalitySizes] = field(default_factory=dict)
    ex_vivo_sd_mm: Mapping[int, float | None] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    other_visits: OtherVisits = field(default_factory=OtherVisits)


def summarise(
    readings: Iterable[Reading],
    ex_vivo_mm: Mapping[MassKey, float],
    *,
    confidence: float = 0.95,
    error_ratio: float = 1.0,
    ex_vivo_sd_mm: Mapping[MassKey, float | None] | None = None,
    seed: int = SEED,
    other_visits: OtherVisits | None = None,
) -> TrialReport:
    """Summarise a trial: compare each modality's sizes with excision.

    Parameters
    ----------
    readings
        In any order.
    ex_vivo_mm
        Size after excision in mm, by patient and mass; every mass of `readings` must be there.
    confidence
        Probability of the intervals; `Intervals` to choose how they are made.
    error_ratio
        Variance of the error of ex-vivo sizes over that of a modality's, for the Deming lines.
    ex_vivo_sd_mm
        Standard deviation of each ex-vivo size where it is known; enters the calibration in quadrature.
    seed
        Of the sign flips, where there are too many to try all.
    other_visits
        What was left out of the readings before, for the report.
    """
    # one order for every order of the rows: an iteration's last digits depend on it
    readings = sorted(readings, key=lambda r: (r.key, r.modality, r.replicate))
    sizes = gather(readings, ex_vivo_mm)
    beside = _Beside(readings, ex_vivo_mm, ex_vivo_sd_mm or {})
    return TrialReport(
        modalities={
            name: modality_report(one, confidence=confidence, error_ratio=error_ratio, beside=beside)
            for name, one in sizes.items()
        },
        ratios=mape_ratios(sizes, confidence=confidence),
        patients=len({patient for patient, _ in ex_vivo_mm}),
        masses=len(ex_vivo_mm),
        masses_without_any_reading=len(set(ex_vivo_mm) - {reading.key for reading in readings}),
        synthetic_readings=sum(reading.synthetic for reading in readings),
        readings=len(readings),
        confidence=float(confidence),
        paired=tuple(paired_comparisons(sizes, confidence=confidence, seed=seed)),
        sizes=sizes,
        doubts=tuple(unit_doubts(sizes, np.array(list(ex_vivo_mm.values()), dtype=np.float64))),
        other_visits=other_visits or OtherVisits(),
        ex_vivo_sd_mm={number: (ex_vivo_sd_mm or {}).get(key) for key, number in mass_numbers(ex_vivo_mm).items()},
    )


class _Beside:
    """Readers and stated uncertainties of the single readings, by modality."""

    def __init__(
        self,
        readings: Iterable[Reading],
        ex_vivo_mm: Mapping[MassKey, float],
        ex_vivo_sd_mm: Mapping[MassKey, float | None],
    ) -> None:
        self._found: dict[str, list[Reading]] = {}
        for reading in readings:
            if reading.size_mm is not None:
                self._found.setdefault(reading.modality, []).append(reading)
        self._ex_vivo_mm, self._ex_vivo_sd_mm = ex_vivo_mm, ex_vivo_sd_mm
        self._masses, self._patients = mass_numbers(ex_vivo_mm), patient_numbers(ex_vivo_mm)

    def components(self, modality: str) -> Components | None:
        """Variances of log size between masses, readers and maps."""
        found = self._found.get(modality, [])
        logs = [math.log(one.size_mm) for one in found if one.size_mm is not None]
        return reader_components(logs, [one.key for one in found], [one.reader for one in found])

    def prediction(self, modality: str) -> Prediction | None:
        """Stated uncertainties as predictive distributions; None where no reading states one."""
        stated = [(one, _stated(one)) for one in self._found.get(modality, [])]
        kept = [(one, distribution) for one, distribution in stated if distribution is not None]
        if not kept:
            return None
        keys = [one.key for one, _ in kept]
        return predictions(
            [distribution for _, distribution in kept],
            [self._ex_vivo_mm[key] for key in keys],
            [self._ex_vivo_sd_mm.get(key) for key in keys],
            masses=[self._masses[key] for key in keys],
            patients=[self._patients[patient] for patient, _ in keys],
        )


def _stated(reading: Reading) -> tuple[float, float] | None:
    assert reading.size_mm is not None
    ends = reading.interval
    if ends is None:
        return log_normal(None, None, None, reading.size_mm, reading.sd_mm)
    return log_normal(ends.low_mm, ends.high_mm, ends.probability, reading.size_mm, reading.sd_mm)


def _detected_interval(sizes: ModalitySizes, *, confidence: float) -> tuple[float, float] | None:
    """Interval of the share of masses found, for the effective number of patients: masses of one are no new trials."""
    n = len(sizes.size_mm)
    if n == 0:
        return None
    number = effective_number(np.ones(n), sizes.patient)
    return clopper_pearson(float(sizes.detected.mean()) * number, number, confidence=confidence)


def modality_report(
    sizes: ModalitySizes, *, confidence: float, error_ratio: float = 1.0, beside: _Beside | None = None
) -> ModalityReport:
    """Report one modality: counts, all figures, coverage."""
    prediction = None if beside is None else beside.prediction(sizes.name)
    n, detected = len(sizes.size_mm), int(sizes.detected.sum())
    return ModalityReport(
        name=sizes.name,
        n=n,
        detected=detected,
        detected_interval=_detected_interval(sizes, confidence=float(confidence)),
        patients=len(sizes.patients),
        readings=sizes.readings,
        readings_detected=sum(len(group) for group in sizes.replicates_mm),
        masses_not_done=sizes.masses_not_done,
        masses_without_reading=sizes.masses_without_reading,
        figures={name: one for family in FAMILIES for name, one in family(sizes, confidence=confidence).items()},
        coverage=tuple(coverage(sizes.intervals, confidence=float(confidence))),
        methods=compare_methods(sizes, confidence=confidence, error_ratio=error_ratio),
        replicates=replicates.replicate_figures(sizes, confidence=confidence),
        components=None if beside is None else beside.components(sizes.name),
        calibration=None if prediction is None else calibration(prediction, confidence=float(confidence)),
        prediction=prediction,
        cautions=cautions(sizes, confidence=confidence),
    )
