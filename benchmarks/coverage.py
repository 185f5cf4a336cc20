"""How often each kind of interval holds the true error at the paper's size: ``python -m benchmarks.coverage``.

Prints the table of docs/coverage.md. 24 patients, of whom one has two masses; log-normal errors.
"""

from __future__ import annotations

import argparse
import math
from typing import get_args

import numpy as np

from tactile_bayes.trial.accuracy import mape_ratio
from tactile_bayes.trial.figures import Intervals, Method, clopper_pearson
from tactile_bayes.trial.planning import ErrorModel, check_intervals, simulate
from tactile_bayes.trial.readings import ModalitySizes

METHODS = get_args(Method)
PATIENT = np.minimum(np.arange(25), 23)
MODELS = {
    "tactile-like, SD 0.20": ErrorModel(0.0, 0.20),
    "tactile-like, one in 25 missed": ErrorModel(0.0, 0.20, miss=0.04),
    "ultrasound-like, SD 0.40": ErrorModel(-0.08, 0.40),
    "ultrasound-like, one in 25 missed": ErrorModel(-0.08, 0.40, miss=0.04),
    "CBE-like, SD 0.42, bias +16 %": ErrorModel(0.15, 0.42),
    "CBE-like, one in 25 missed": ErrorModel(0.15, 0.42, miss=0.04),
}


def main() -> None:
    """Print both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1999)
    options = parser.parse_args()
    masses = _masses(options.seed)
    print("| errors | true MAPE % |" + "".join(f" {method} |" for method in METHODS))
    print("|---|---|" + "---|" * len(METHODS))
    for name, model in MODELS.items():
        cells = [_share(masses, model, method, options) for method in METHODS]
        print(f"| {name} | {model.true_mape_percent:.1f} | {' | '.join(cells)} |", flush=True)
    print("\n| ratio to the tactile-like error | true ratio |" + "".join(f" {method} |" for method in METHODS))
    print("|---|---|" + "---|" * len(METHODS))
    for name in list(MODELS)[2:]:
        cells = [_ratio_share(masses, MODELS[name], method, options) for method in METHODS]
        truth = MODELS[name].true_mape_percent / MODELS["tactile-like, SD 0.20"].true_mape_percent
        print(f"| {name} | {truth:.2f} | {' | '.join(cells)} |", flush=True)


def _masses(seed: int) -> ModalitySizes:
    ex_vivo = 16 * np.exp(np.random.default_rng(seed).normal(0, 0.38, 25))
    return ModalitySizes("tactile", PATIENT, ex_vivo, ex_vivo, (np.zeros(0),) * 25)


def _share(masses: ModalitySizes, model: ErrorModel, method: str, options: argparse.Namespace) -> str:
    chosen = Intervals(0.95, method=method, resamples=1000)  # type: ignore[arg-type]
    check = check_intervals(masses, model, confidence=chosen, trials=options.trials, seed=options.seed)
    assert check is not None
    missing = f", {check.undefined} none" if check.undefined else ""
    return f"{check.share:.3f} [{check.share_interval[0]:.3f}, {check.share_interval[1]:.3f}]{missing}"


def _ratio_share(masses: ModalitySizes, model: ErrorModel, method: str, options: argparse.Namespace) -> str:
    chosen = Intervals(0.95, method=method, resamples=1000)  # type: ignore[arg-type]
    tactile = MODELS["tactile-like, SD 0.20"]
    truth = math.log(model.true_mape_percent / tactile.true_mape_percent)
    rng, hits, defined = np.random.default_rng([options.seed, 1]), 0, 0
    for _ in range(options.trials):
        one = simulate(masses.patient, masses.ex_vivo_mm, tactile, rng=rng)
        other = simulate(masses.patient, masses.ex_vivo_mm, model, rng=rng, name="other")
        ends = mape_ratio(other, one, confidence=chosen).interval
        defined += ends is not None
        hits += ends is not None and math.log(ends[0]) <= truth <= math.log(ends[1])
    low, high = clopper_pearson(hits, defined, confidence=0.95)
    return f"{hits / defined:.3f} [{low:.3f}, {high:.3f}]"


if __name__ == "__main__":
    main()
