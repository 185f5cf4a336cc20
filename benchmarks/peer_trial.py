"""The table of `validate` as far as pandas, statsmodels and pingouin make it: the peer of the benchmark.

Run as ``python -m benchmarks.peer_trial TRIAL.csv EXCISION.csv``. Per modality: percent errors with BCa intervals, line
through zero, least squares, concordance by hand, limits of agreement, ICC, mixed model of the replicates. What
it has no function for (Deming, Passing-Bablok, limits with replicates, calibration, sign flips) it leaves out.
"""

from __future__ import annotations

import sys
import warnings

import numpy as np
import pandas as pd
import pingouin
import statsmodels.api as sm
import statsmodels.formula.api as smf
from scipy import stats


def main(trial: str, excision: str) -> None:
    """Print one line a modality."""
    readings = pd.read_csv(trial).merge(pd.read_csv(excision)[["patient", "mass", "ex_vivo_mm"]])
    readings["size_mm"] = readings["size_mm"].where(readings["status"] == "detected", 0.0)
    for name, rows in readings.groupby("modality"):
        means = rows.groupby(["patient", "mass"])[["size_mm", "ex_vivo_mm"]].mean()
        print(name, *(f"{value:.3f}" for value in _modality(means["ex_vivo_mm"], means["size_mm"])), *_replicates(rows))


def _modality(x: pd.Series, y: pd.Series) -> list[float]:
    errors = 100 * (y / x - 1).abs().to_numpy()
    rng = np.random.default_rng(0)
    ends = stats.bootstrap((errors,), np.mean, n_resamples=2000, method="BCa", rng=rng, batch=50).confidence_interval
    origin, line = sm.OLS(y, x).fit(), sm.OLS(y, sm.add_constant(x)).fit()
    off = y - x
    limits = off.mean() + 1.96 * off.std() * np.array([-1, 1])
    ccc = 2 * np.cov(x, y)[0, 1] / (x.var() + y.var() + (x.mean() - y.mean()) ** 2)
    return [errors.mean(), ends.low, ends.high, origin.params.iloc[0], origin.rsquared, *line.params, ccc, *limits]


def _replicates(rows: pd.DataFrame) -> list[str]:
    found = rows[rows["size_mm"] > 0].copy()
    found["log"], found["key"] = np.log(found["size_mm"]), found["patient"] + "/" + found["mass"].astype(str)
    if found["replicate"].nunique() < 2:
        return []
    balanced = found[found.groupby("key")["replicate"].transform("count") >= 3]
    balanced = balanced[balanced["replicate"] <= 3]
    icc = pingouin.intraclass_corr(balanced, targets="key", raters="replicate", ratings="log")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mixed = smf.mixedlm("log ~ 1", found, groups="key").fit()
    return [f"ICC {icc['ICC'].iloc[0]:.3f}", f"residual {mixed.scale:.4f}"]


if __name__ == "__main__":
    main(*sys.argv[1:])
