"""Do stated intervals hold? Coverage and calibration."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, kolmogi, ndtr, ndtri

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.trial.figures import MIN_PATIENTS, Count, Ends, Share, clopper_pearson
from tactile_bayes.trial.readings import FloatArray, MassKey, Reading, Trial, mass_numbers

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

    Replicates of a mass share its ex-vivo size, so n intervals on m masses are not n trials. The interval takes the
    share covered as found on m trials: exact where each mass has one interval, on the wide side where it has more.
    """
    stated: dict[float, list[tuple[MassKey, bool]]] = defaultdict(list)
    for one in readings:
        if (ends := one.interval) is not None:
            stated[ends.probability].append((one.key, ends.low_mm <= ex_vivo_mm[one.key] <= ends.high_mm))
    found = []
    for probability, group in sorted(stated.items()):
        n, covered, masses = len(group), sum(inside for _, inside in group), len({key for key, _ in group})
        share = clopper_pearson(covered * masses / n, masses, confidence=confidence)
        found.append(Coverage(probability, n, covered, masses, covered / n, share))
    return tuple(found)


# --- Calibration of stated uncertainties: probability integral transforms, scores, and the implied correction.
#
# A stated uncertainty becomes a predictive distribution of the size that the caliper will read: normal on the
# logarithm of size, through the stated interval (or mean and SD), widened in quadrature by the caliper's own error.

LEVELS = (0.5, 0.8, 0.9, 0.95)
BINS = 10


class Prediction(Record, eq=False):
    """Predictive distributions of log ex-vivo sizes, one per reading, with the sizes found."""

    median_log: FloatArray
    sd_log: FloatArray
    """`median_log`, `sd_log`: (n,) arrays of each prediction: the logarithm of its median in mm and its SD, caliper
    error included."""
    found_log: FloatArray  #: (n,) array: logarithm of the ex-vivo size in mm.
    mass: npt.NDArray[np.int64]  #: (n,) array of the masses' numbers.

    @property
    def z(self) -> FloatArray:
        """(n,) standardised errors: standard normal when the uncertainties are honest."""
        return (self.found_log - self.median_log) / self.sd_log


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
    """Judge predictions, of which there is one at least.

    Readings of one mass share its ex-vivo size, so n readings on m masses count as m trials wherever chance is judged.
    """
    z = prediction.z
    pit = ndtr(z)
    masses = len(np.unique(prediction.mass))
    ordered = np.sort(pit)
    steps = np.arange(len(pit) + 1) / len(pit)
    distance = float(max(np.max(steps[1:] - ordered), np.max(ordered - steps[:-1])))
    mean, tail = float(np.mean(z**2)), 0.5 - 0.5 * confidence  # chi-squared, one degree of freedom per mass
    low, high = (math.sqrt(masses * mean / float(chdtri(masses, p))) for p in (tail, 1 - tail))
    scale, ends = math.sqrt(mean), (low, high)
    shift = 100 * math.expm1(float(np.median(prediction.found_log - prediction.median_log)))
    levels = []
    for level in LEVELS:
        covered = int(np.sum(np.abs(z) <= float(ndtri(0.5 + 0.5 * level))))
        share = clopper_pearson(covered * masses / len(z), masses, confidence=confidence)
        levels.append(LevelCoverage(level, covered, len(z), share))
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
        scale_interval=ends,
        shift_percent=shift,
        advice=_advice(scale, ends, masses, distance > band),
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
    w, sd, found = prediction.z, prediction.sd_log, np.exp(prediction.found_log)
    mean = np.exp(prediction.median_log + sd**2 / 2)
    return np.asarray(found * (2 * ndtr(w) - 1) - 2 * mean * (ndtr(w - sd) + ndtr(sd / math.sqrt(2)) - 1))


def interval_score(prediction: Prediction, *, probability: float) -> FloatArray:
    """(n,) interval scores in mm: Gneiting & Raftery (2007), J. Am. Stat. Assoc. 102, 359, eq. 43."""
    reach = float(ndtri(0.5 + 0.5 * probability)) * prediction.sd_log
    low, high = np.exp(prediction.median_log - reach), np.exp(prediction.median_log + reach)
    found = np.exp(prediction.found_log)
    outside = np.maximum(low - found, 0) + np.maximum(found - high, 0)
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
    kept = [(one.key, stated) for one in trial.found(modality) if (stated := log_normal(one)) is not None]
    if not kept:
        return None
    masses = mass_numbers(trial.ex_vivo_mm)
    found = np.array([trial.ex_vivo_mm[key] for key, _ in kept], dtype=np.float64)
    caliper = np.array([trial.ex_vivo_sd_mm.get(key) or 0.0 for key, _ in kept]) / found
    medians, sds = np.array([stated for _, stated in kept], dtype=np.float64).T
    return Prediction(
        medians, np.sqrt(sds**2 + np.log1p(caliper**2)), np.log(found), np.array([masses[key] for key, _ in kept])
    )


def _advice(scale: float, ends: Ends, masses: int, refuted: bool) -> str:
    if masses < MIN_PATIENTS:
        return f"too few masses ({masses}) to judge; at least {MIN_PATIENTS} are needed"
    if ends[0] <= 1 <= ends[1]:
        return (
            "widths agree with the errors, but their shape or centre does not: look at the PIT histogram"
            if refuted
            else "no change: the widths agree with the errors found"
        )
    word = "too narrow" if scale > 1 else "too wide"
    return (
        f"stated uncertainties are {word}: multiply the SD of log size by {scale:.2f} ({ends[0]:.2f} to {ends[1]:.2f})"
    )
