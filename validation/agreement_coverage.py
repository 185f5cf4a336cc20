"""How often intervals of lines, concordance and limits of agreement hold: ``python -m validation agreement_coverage``.

Prints the tables of docs/coverage.md: trials of 25 masses with log-normal errors, ex-vivo sizes drawn anew each time.
The truth is the same figure of a hundred thousand masses.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.options import IntervalMethod as Method
from tactile_bayes.trial import accuracy, method_comparison
from tactile_bayes.trial.figures import JACKKNIFE, Figure, Intervals
from tactile_bayes.trial.lines import concordance, deming, least_squares
from tactile_bayes.trial.method_comparison import compare_methods
from tactile_bayes.trial.readings import ModalitySizes
from validation.common import Table, parser
from validation.simulated_trials import ErrorModel, simulate

Ends = tuple[float, float]
ONE_EACH = np.minimum(np.arange(25), 23)
TWO_EACH = np.concatenate([np.repeat(np.arange(11), 2), [11, 12, 13]])
# Error SD of ln size and its bias, as of tactile maps and of ultrasound.
ERRORS = {"SD 0.20": (0.02, 0.20), "SD 0.40": (-0.08, 0.40)}
DESIGNS = {
    "24 patients, one with two masses": (ONE_EACH, 0.0, 0.0),
    "the same, one in 25 missed": (ONE_EACH, 0.0, 0.04),
    "14 patients, 11 with two masses": (TWO_EACH, 0.7, 0.0),
}
WANTED = {
    "mape_percent": "MAPE",
    "slope_through_origin": "slope through 0",
    "ols_slope": "least squares slope",
    "deming_slope": "Deming slope",
    "concordance": "concordance",
    "limit_low_mm": "lower limit, mm",
    "limit_high_mm": "upper limit, mm",
    "limit_low_log_ratio": "lower limit, ratio",
    "limit_high_log_ratio": "upper limit, ratio",
}
TABLES = ("agreement-one-mass", "agreement-missed", "agreement-two-masses")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for each design."""
    words = parser(__name__, __doc__)
    words.add_argument("--trials", type=int, default=400)
    words.add_argument("--seed", type=int, default=1999)
    words.add_argument("--keep", action="store_true", help="keep the tables for docs/coverage.md")
    given = words.parse_args(arguments)
    # lines that are no sums would be fitted anew without each patient, and take most of the time
    method_comparison.MOST_REFITTED = 0
    for name, design in zip(TABLES, DESIGNS, strict=True):
        heads = [f"{error}: corrected | jackknife | customary".split(" | ") for error in ERRORS]
        table = Table(name, design, *(one for three in heads for one in three))
        columns = [_held(design, error, given) for error in ERRORS]
        for figure, what in WANTED.items():
            table.add(what, *(cell for column in columns for cell in column[figure]))
        if given.keep:
            table.keep()


def _held(design: str, error: str, given: argparse.Namespace) -> dict[str, list[str]]:
    """Share of trials whose interval holds the truth, by figure: corrected, jackknife, customary."""
    rng = np.random.default_rng([given.seed, list(DESIGNS).index(design)])
    truth = _truth(_trial(design, error, rng, copies=4000))
    hits: dict[tuple[str, int], list[bool]] = {}
    for _ in range(given.trials):
        sizes = _trial(design, error, rng)
        for column, intervals in enumerate(_three(sizes)):
            for name, ends in intervals.items():
                hits.setdefault((name, column), []).append(ends[0] <= truth[name] <= ends[1])
    return {name: [_share(hits.get((name, column))) for column in range(3)] for name in WANTED}


def _share(hits: list[bool] | None) -> str:
    return "-" if hits is None else f"{np.mean(hits):.3f}"


def _trial(design: str, error: str, rng: np.random.Generator, *, copies: int = 1) -> ModalitySizes:
    """One trial, or many of them as one with patients of their own."""
    patient, shared, miss = DESIGNS[design]
    bias, sd = ERRORS[error]
    many = (np.arange(copies)[:, None] * (patient.max() + 1) + patient).ravel()
    model = ErrorModel(bias, sd * (1 - shared**2) ** 0.5, patient_sd=sd * shared, miss=miss)
    made = simulate(many, 16 * np.exp(rng.normal(0, 0.38, len(many))), model, rng=rng)
    return replace(made, replicates_mm=tuple(size[size > 0] for size in made.size_mm[:, None]))


def _truth(sizes: ModalitySizes) -> dict[str, float]:
    found = sizes.only_detected()
    x, y = found.ex_vivo_mm, found.size_mm
    limit = method_comparison.limit_figures(found, intervals=JACKKNIFE)
    return {
        "mape_percent": accuracy.mape_percent(sizes),
        "slope_through_origin": accuracy.slope(sizes),
        "ols_slope": least_squares(x, y).slope,
        "deming_slope": deming(x, y).slope,
        "concordance": concordance(x, y).coefficient,
        **{name: one.value for name, one in limit.items() if one.value is not None},
    }


def _figures(sizes: ModalitySizes, intervals: Intervals) -> dict[str, Figure]:
    found = {
        **accuracy.accuracy_figures(sizes, intervals=intervals),
        **accuracy.origin_line_figures(sizes, intervals=intervals),
    }
    methods = compare_methods(sizes, intervals=intervals)
    return {name: found[name] if name in found else methods.figure(name) for name in WANTED}


def _three(sizes: ModalitySizes) -> Iterator[Mapping[str, Ends]]:
    methods: tuple[Method, ...] = ("corrected", "jackknife")
    for method in methods:
        found = _figures(sizes, Intervals(0.95, method=method))
        yield {name: ends for name in WANTED if (ends := found[name].interval) is not None}
    yield _customary(sizes)


def _customary(sizes: ModalitySizes) -> dict[str, Ends]:
    """What other programs print: analytic intervals of lines, Fisher's z, exact limits of agreement."""
    one = compare_methods(sizes, intervals=JACKKNIFE)
    ends = {name: both for name, both in one.analytic_intervals.items() if both is not None and name in WANTED}
    found = sizes.only_detected()
    plain = {"mm": found.size_mm - found.ex_vivo_mm, "log_ratio": np.log(found.size_mm / found.ex_vivo_mm)}
    for unit, off in plain.items():
        both = method_comparison.limits(off)
        assert both.low_interval is not None
        assert both.high_interval is not None
        ends |= {f"limit_low_{unit}": both.low_interval, f"limit_high_{unit}": both.high_interval}
    return ends
