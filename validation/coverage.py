"""How often each kind of interval holds the true error at the paper's size: ``python -m validation coverage``.

Prints the table of docs/coverage.md. 24 patients, of whom one has two masses; log-normal errors.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import get_args

import numpy as np

from tactile_bayes.options import IntervalMethod as Method
from tactile_bayes.trial.accuracy import mape_ratio
from tactile_bayes.trial.figures import Intervals
from tactile_bayes.trial.readings import ModalitySizes
from validation.common import Table, parser, share
from validation.simulated_trials import ErrorModel, check_intervals, simulate

METHODS = get_args(Method)
HEADS = {"corrected": "corrected (default)", "bca": "BCa"}
PATIENT = np.minimum(np.arange(25), 23)
MODELS = {
    "tactile-like, SD 0.20": ErrorModel(0.0, 0.20),
    "tactile-like, one in 25 missed": ErrorModel(0.0, 0.20, miss=0.04),
    "ultrasound-like, SD 0.40, bias -8 %": ErrorModel(-0.08, 0.40),
    "ultrasound-like, one in 25 missed": ErrorModel(-0.08, 0.40, miss=0.04),
    "CBE-like, SD 0.42, bias +16 %": ErrorModel(0.15, 0.42),
    "CBE-like, one in 25 missed": ErrorModel(0.15, 0.42, miss=0.04),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    words = parser(__name__, __doc__)
    words.add_argument("--trials", type=int, default=2000)
    words.add_argument("--seed", type=int, default=1999)
    words.add_argument("--keep", action="store_true", help="keep the tables for docs/coverage.md")
    given = words.parse_args(arguments)
    masses = _masses(given.seed)
    own = Table("error-intervals", "errors of ln size", "true MAPE %", *(HEADS.get(one, one) for one in METHODS))
    for name, model in MODELS.items():
        cells = [_share(masses, model, method, given) for method in METHODS]
        own.add(name, f"{model.true_mape_percent:.1f}", *cells)
    # the corrected interval of a ratio is the jackknife's
    both = METHODS[1:]
    ratios = Table("error-ratios", "errors of ln size", "true ratio", "jackknife (also of `corrected`)", "BCa")
    for name in list(MODELS)[2:]:
        cells = [_ratio_share(masses, MODELS[name], method, given) for method in both]
        truth = MODELS[name].true_mape_percent / MODELS["tactile-like, SD 0.20"].true_mape_percent
        ratios.add(name, f"{truth:.2f}", *cells)
    if given.keep:
        own.keep()
        ratios.keep()


def _masses(seed: int) -> ModalitySizes:
    ex_vivo = 16 * np.exp(np.random.default_rng(seed).normal(0, 0.38, 25))
    return ModalitySizes("tactile", PATIENT, ex_vivo, ex_vivo, (np.zeros(0),) * 25)


def _share(masses: ModalitySizes, model: ErrorModel, method: str, given: argparse.Namespace) -> str:
    chosen = Intervals(0.95, method=method, resamples=1000)  # type: ignore[arg-type]
    check = check_intervals(masses, model, intervals=chosen, trials=given.trials, seed=given.seed)
    assert check is not None
    missing = f", {check.undefined} none" if check.undefined else ""
    return f"{check.share:.3f} [{check.share_interval[0]:.3f}, {check.share_interval[1]:.3f}]{missing}"


def _ratio_share(masses: ModalitySizes, model: ErrorModel, method: str, given: argparse.Namespace) -> str:
    chosen = Intervals(0.95, method=method, resamples=1000)  # type: ignore[arg-type]
    tactile = MODELS["tactile-like, SD 0.20"]
    truth = math.log(model.true_mape_percent / tactile.true_mape_percent)
    rng, hits = np.random.default_rng([given.seed, 1]), []
    for _ in range(given.trials):
        one = simulate(masses.patient, masses.ex_vivo_mm, tactile, rng=rng)
        other = simulate(masses.patient, masses.ex_vivo_mm, model, rng=rng)
        ends = mape_ratio(other, one, intervals=chosen).interval
        if ends is not None:
            hits.append(math.log(ends[0]) <= truth <= math.log(ends[1]))
    return share(hits)
