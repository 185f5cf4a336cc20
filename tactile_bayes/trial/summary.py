"""Everything a trial says about its modalities, in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from tactile_bayes.trial import accuracy, origin_line, spread
from tactile_bayes.trial.comparison import mape_ratios
from tactile_bayes.trial.coverage import Coverage, coverage
from tactile_bayes.trial.figures import Figure
from tactile_bayes.trial.proportion import clopper_pearson
from tactile_bayes.trial.readings import MassKey, ModalitySizes, Reading, gather

FAMILIES: tuple[Callable[..., dict[str, Figure]], ...] = (accuracy.figures, origin_line.figures, spread.figures)


@dataclass(frozen=True, slots=True)
class ModalityReport:
    """Counts, figures and coverage of one modality; `n` masses were looked for."""

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


@dataclass(frozen=True, slots=True)
class TrialReport:
    """All modalities, their percent errors over the tactile one's, and what was counted."""

    modalities: Mapping[str, ModalityReport]
    ratios: Mapping[str, Mapping[str, Figure]]
    patients: int
    masses: int
    masses_without_any_reading: int
    synthetic_readings: int
    readings: int
    confidence: float


def summarise(
    readings: Iterable[Reading], ex_vivo_mm: Mapping[MassKey, float], *, confidence: float = 0.95
) -> TrialReport:
    """Compare each modality's sizes with excision.

    Parameters
    ----------
    readings
        In any order.
    ex_vivo_mm
        Size after excision in mm, by patient and mass; every mass of `readings` must be there.
    confidence
        Probability of the intervals.
    """
    readings = list(readings)
    sizes = gather(readings, ex_vivo_mm)
    return TrialReport(
        modalities={name: modality_report(one, confidence=confidence) for name, one in sizes.items()},
        ratios=mape_ratios(sizes, confidence=confidence),
        patients=len({patient for patient, _ in ex_vivo_mm}),
        masses=len(ex_vivo_mm),
        masses_without_any_reading=len(set(ex_vivo_mm) - {reading.key for reading in readings}),
        synthetic_readings=sum(reading.synthetic for reading in readings),
        readings=len(readings),
        confidence=confidence,
    )


def modality_report(sizes: ModalitySizes, *, confidence: float) -> ModalityReport:
    """Counts, all families' figures and the coverage of one modality."""
    n, detected = len(sizes.size_mm), int(sizes.detected.sum())
    return ModalityReport(
        name=sizes.name,
        n=n,
        detected=detected,
        detected_interval=clopper_pearson(detected, n, confidence=confidence) if n else None,
        patients=len(sizes.patients),
        readings=sizes.readings,
        readings_detected=sum(len(group) for group in sizes.replicates_mm),
        masses_not_done=sizes.masses_not_done,
        masses_without_reading=sizes.masses_without_reading,
        figures={name: one for family in FAMILIES for name, one in family(sizes, confidence=confidence).items()},
        coverage=tuple(coverage(sizes.intervals, confidence=confidence)),
    )
