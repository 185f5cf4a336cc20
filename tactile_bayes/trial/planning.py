"""Planning a trial by simulation: power, widths of intervals, the value of more maps per mass, and patients needed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from scipy.special import ndtri

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.options import MOST_PATIENTS, Aim
from tactile_bayes.presets import INTERVAL
from tactile_bayes.trial.accuracy import mape_figure, mape_percent, mape_ratio, sign_flip
from tactile_bayes.trial.figures import MIN_PATIENTS, Ends, Intervals, UndefinedError, clopper_pearson, figure
from tactile_bayes.trial.readings import FloatArray, ModalitySizes
from tactile_bayes.trial.replicates import log_sd_within

# Ex-vivo sizes, log-normal: median and SD of the logarithm, near those that the paper's figures imply.
MEDIAN_MM, SIZE_LOG_SD = 16.0, 0.38
FLIPS = 999
LEVEL = 0.05


class PlanCase(Record, kw_only=True):
    """A design with its assumed errors (`PlanErrors`), numbers of trials and seed: all that its simulation takes."""

    patients: int
    maps: int
    """`patients`, `maps`: Patients with one mass each, and tactile maps per mass."""
    tactile_bias: float
    mass_sd: float
    map_sd: float
    tactile_miss: float
    other_bias: float
    other_sd: float
    other_miss: float
    trials: int
    seed: int

    @property
    def key(self) -> str:
        """Unique key among the designs of one plan."""
        return f"{self.patients} patients, {self.maps} maps"


ErrorSource = Literal["option", "pilot", "default"]


class Design(Record):
    """Results of the simulated trials of one design."""

    patients: int
    maps: int
    power: Annotated[float, Meta(ge=0, le=1)]
    """Share of trials with a smaller tactile error and a sign-flip test below 5 %."""
    power_interval: Ends  #: Exact 95 % interval of that share: the simulation's own error.
    tactile_percent: float  #: Mean tactile error over the trials.
    other_percent: float  #: Mean error of the other modality over the trials.
    tactile_width_ratio: float | None  #: Median upper over lower end of the tactile error's interval.
    ratio_width_ratio: float | None  #: Median upper over lower end of the interval of the ratio of errors.


class Gain(Record):
    """Change of power and error by more maps per mass at the same number of patients."""

    patients: int
    from_maps: int
    to_maps: int
    power_gain: float
    tactile_percent_change: float


class Needed(Record):
    """Number of patients that reach an aim."""

    aim: Aim
    target: float  #: Power, or the median factor from the lower to the upper end of the tactile error's interval.
    maps: int
    patients: Annotated[int, Meta(ge=MIN_PATIENTS)]  #: The least that reach it, one mass each.
    patients_interval: Ends | None  #: 95 % interval of that number: the simulation's own error; null where too few.


class PlanReport(Record, kw_only=True):
    """Power and widths of planned trials."""

    schema: Literal["tactile-bayes/plan/1"]
    errors: dict[str, float]  #: Assumed errors of ln size.
    errors_from: dict[str, ErrorSource]  #: Where each assumed error comes from.
    designs: Annotated[tuple[Design, ...], Meta(min_length=1)]
    gains: tuple[Gain, ...]
    needed: tuple[Needed, ...] = ()  #: Patients that --power or --precision needs, from the designs above.
    provenance: dict[str, Any]
    research_use: Annotated[str, Meta(min_length=1)]


def simulate_design(case: PlanCase) -> Design:
    """Simulate the trials of one design."""
    trials = np.array([_simulated_trial(case, trial) for trial in range(case.trials)], dtype=np.float64)
    won, tactile, other, tactile_width, ratio_width = trials.T
    wins = int(won.sum())
    return Design(
        patients=case.patients,
        maps=case.maps,
        power=wins / case.trials,
        power_interval=clopper_pearson(wins, case.trials, confidence=0.95),
        tactile_percent=float(tactile.mean()),
        other_percent=float(other.mean()),
        tactile_width_ratio=_median(tactile_width),
        ratio_width_ratio=_median(ratio_width),
    )


def map_gains(designs: Iterable[Design]) -> tuple[Gain, ...]:
    """Gain from each further map at the same number of patients: change of power and of tactile error."""
    ordered = sorted(designs, key=lambda design: (design.patients, design.maps))
    return tuple(
        Gain(b.patients, a.maps, b.maps, b.power - a.power, b.tactile_percent - a.tactile_percent)
        for a, b in pairwise(ordered)
        if a.patients == b.patients
    )


# --- The number of patients that reaches a power, or a width of the interval: a line through simulated designs.

# Numbers of patients simulated about a guess, as shares of it; and how often at most the guess is renewed.
AROUND = (0.6, 0.8, 1.0, 1.25, 1.6)
ROUNDS = 4
GUESS_MASSES = 40_000  #: Masses.


def first_guess(case: PlanCase, aim: Aim, target: float) -> int:
    r"""Patients by the normal approximation, from the errors of many simulated masses.

    For power :math:`((z_{1-\alpha/2} + z_\text{power}) / \delta)^2` with :math:`\delta` the mean of the differences of
    percent errors over their SD; for the interval of a mean error, whose ends lie :math:`z` standard errors of its
    logarithm away, :math:`(2 z\,\text{cv} / \ln \text{factor})^2`. Undefined where the
    tactile errors are not the smaller ones.
    """
    rng, n = np.random.default_rng(case.seed), GUESS_MASSES
    shared = rng.normal(case.tactile_bias, case.mass_sd, n)
    tactile = np.abs(np.exp(shared + rng.normal(0, case.map_sd, (case.maps, n))).mean(axis=0) - 1)
    other = np.abs(np.expm1(rng.normal(case.other_bias, case.other_sd, n)))
    other[rng.random(n) < case.other_miss] = 1.0
    tactile[rng.random(n) < case.tactile_miss] = 1.0
    z = float(ndtri(1 - LEVEL / 2))
    if aim == "precision":
        if tactile.std() <= 1e-9:
            raise UndefinedError("the tactile errors assumed do not scatter, so their interval has no width")
        root = 2 * z * float(tactile.std() / tactile.mean()) / math.log(target)
    else:
        gain = float((other - tactile).mean())
        if gain <= 0:
            raise UndefinedError(
                f"the tactile errors assumed are not the smaller ones ({100 * tactile.mean():.1f} % against "
                f"{100 * other.mean():.1f} %), so no number of patients has that power"
            )
        root = (z + float(ndtri(target))) * float((other - tactile).std()) / gain
    return round(min(max(root**2, MIN_PATIENTS), MOST_PATIENTS))


def patients_around(patients: int) -> list[int]:
    """Numbers of patients to simulate, `AROUND` a guess."""
    return sorted({min(max(round(share * patients), MIN_PATIENTS), MOST_PATIENTS) for share in AROUND})


def patients_needed(designs: Sequence[Design], aim: Aim, target: float, *, trials: int) -> Needed | None:
    r"""Solve a line through simulated designs of one number of maps for the number of patients.

    The power's normal quantile is linear in :math:`\sqrt N`, the logarithm of an interval's width in
    :math:`1/\sqrt N`. None where the designs have no such line; the least and the most patients that a plan may have
    stand for fewer and more.
    """
    least = min(designs, key=lambda design: design.patients)
    width = least.tactile_width_ratio or math.inf
    if least.patients == MIN_PATIENTS and (least.power >= target if aim == "power" else width <= target):
        return Needed(aim=aim, target=target, maps=least.maps, patients=MIN_PATIENTS, patients_interval=None)
    exponent = 0.5 if aim == "power" else -0.5
    points = []  # predictor, response and weight
    for design in designs:
        if aim == "power":
            share = min(max(design.power, 0.5 / trials), 1 - 0.5 / trials)
            y, slope = float(ndtri(share)), math.sqrt(2 * math.pi) * math.exp(float(ndtri(share)) ** 2 / 2)
            sd = slope * math.sqrt(share * (1 - share) / trials)
        elif design.tactile_width_ratio is None:
            continue
        else:
            y, sd = math.log(design.tactile_width_ratio), 1.0
        points.append((design.patients**exponent, y, 1 / sd))
    if len(points) < 2:
        return None
    predictor, response, weights = zip(*points, strict=True)
    (slope, start), covariance = np.polyfit(predictor, response, 1, w=weights, cov="unscaled")
    response_at_target = float(ndtri(target)) if aim == "power" else math.log(target)
    x = (response_at_target - start) / slope
    if slope <= 0 or x <= 0:
        return None
    patients = min(max(math.ceil(x ** (1 / exponent) - 1e-9), MIN_PATIENTS), MOST_PATIENTS)
    ends = None
    if aim == "power":
        sd = math.sqrt(float(np.array([x, 1.0]) @ covariance @ np.array([x, 1.0]))) / slope
        ends = (max(x - 1.96 * sd, 0.0) ** 2, (x + 1.96 * sd) ** 2)
    return Needed(aim=aim, target=target, maps=designs[0].maps, patients=patients, patients_interval=ends)


def _simulated_trial(case: PlanCase, number: int) -> tuple[float, ...]:
    """Simulate one trial: whether it is won, both mean errors, and the width ratios of the intervals of the tactile
    error and of the ratio of errors, NaN where there is none.

    Designs that differ only in maps get the same masses, for a precise difference.
    """
    n, rng = case.patients, np.random.default_rng([case.seed, case.patients, number])
    ex_vivo = MEDIAN_MM * np.exp(rng.normal(0, SIZE_LOG_SD, n))
    shared = rng.normal(case.tactile_bias, case.mass_sd, n)
    other = ex_vivo * np.exp(rng.normal(case.other_bias, case.other_sd, n))
    other[rng.random(n) < case.other_miss] = 0.0
    tactile = ex_vivo * np.exp(shared + rng.normal(0, case.map_sd, (case.maps, n))).mean(axis=0)
    tactile[rng.random(n) < case.tactile_miss] = 0.0
    tactile_sizes, other_sizes = _sizes("tactile", ex_vivo, tactile), _sizes("other", ex_vivo, other)
    difference = np.abs(tactile / ex_vivo - 1) - np.abs(other / ex_vivo - 1)
    p = sign_flip(difference, seed=number, flips=FLIPS)
    error = mape_figure(tactile_sizes, intervals=Intervals(INTERVAL, method="corrected"))
    ratio = mape_ratio(other_sizes, tactile_sizes, intervals=Intervals(INTERVAL))
    won = p is not None and p < LEVEL and float(difference.sum()) < 0
    widths = (_width_ratio(error.interval), _width_ratio(ratio.interval))
    return won, mape_percent(tactile_sizes), mape_percent(other_sizes), *widths


def _sizes(name: str, ex_vivo_mm: FloatArray, size_mm: FloatArray) -> ModalitySizes:
    """Sizes of one mass per patient."""
    n = len(ex_vivo_mm)
    return ModalitySizes(name, np.arange(n), ex_vivo_mm, size_mm, (np.zeros(0),) * n)


def _width_ratio(ends: Ends | None) -> float:
    """Upper over lower end of an interval."""
    return math.nan if ends is None or ends[0] <= 0 else ends[1] / ends[0]


def _median(values: FloatArray) -> float | None:
    """Median of the finite values; None without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def pilot_errors(
    tactile: ModalitySizes, other: ModalitySizes, *, map_sd: float | None = None
) -> dict[str, float] | None:
    """Errors of a pilot trial: bias, SDs between and within masses, shares missed.

    `map_sd`, of single maps, is estimated from the pilot's replicates if None. Without replicates it cannot be told
    from ``mass_sd``, and both are left out. None when a modality detected fewer than 3 masses.
    """
    tactile_errors, other_errors = _log_errors(tactile.only_detected()), _log_errors(other.only_detected())
    if len(tactile_errors) < 3 or len(other_errors) < 3:
        return None
    errors = {
        "tactile_bias": float(tactile_errors.mean()),
        "tactile_miss": 1 - len(tactile_errors) / len(tactile.size_mm),
        "other_bias": float(other_errors.mean()),
        "other_sd": float(other_errors.std(ddof=1)),
        "other_miss": 1 - len(other_errors) / len(other.size_mm),
    }
    if map_sd is None:
        map_sd = figure(log_sd_within, tactile.only_replicated()).value
    if map_sd is None:
        return errors
    averaged = float(np.mean([1 / len(group) for group in tactile.replicates_mm if len(group)]))
    shared = float(tactile_errors.std(ddof=1)) ** 2 - map_sd**2 * averaged
    return errors | {"mass_sd": math.sqrt(max(shared, 0.0)), "map_sd": map_sd}


def _log_errors(detected: ModalitySizes) -> FloatArray:
    """(n,) logarithms of the ratios of detected sizes to those after excision."""
    return np.log(detected.size_mm) - np.log(detected.ex_vivo_mm)
