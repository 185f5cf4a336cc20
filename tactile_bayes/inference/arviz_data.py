"""The only use of arviz: chain diagnostics, and draws as InferenceData."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from tactile_bayes.geometry import FloatArray

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)  # its notice of the next major version, which is pinned away
    import arviz


def chain_diagnostics(chains: FloatArray) -> dict[str, float]:
    """Worst rank-normalised R-hat and smallest bulk and tail effective draws over the parameters of (chain, draw, p)
    draws.

    Vehtari, Gelman, Simpson, Carpenter & Buerkner (2021), Bayesian Analysis 16:667.
    """
    columns = [np.ascontiguousarray(chains[:, :, i]) for i in range(chains.shape[2])]
    return {
        "rhat": float(max(arviz.rhat(column, method="rank") for column in columns)),
        "ess_bulk": float(min(arviz.ess(column, method="bulk") for column in columns)),
        "ess_tail": float(min(arviz.ess(column, method="tail") for column in columns)),
    }


def convergence(draws: FloatArray) -> dict[str, float]:
    """R-hat, effective draws and Monte-Carlo errors of one quantity from (chain, draw) draws.

    ``rhat`` (rank-normalised, split), ``ess_bulk``, ``ess_tail``, and ``mcse_median``, ``mcse_low``, ``mcse_high`` of
    the median and the ends of the central 95 %, in the quantity's unit. Draws without a value (NaN) count as the
    smallest, as they do among ranks.
    """
    known = np.where(np.isfinite(draws), draws, np.nanmin(draws))
    errors = {"mcse_median": 0.5, "mcse_low": 0.025, "mcse_high": 0.975}
    return {
        "rhat": float(arviz.rhat(known, method="rank")),
        "ess_bulk": float(arviz.ess(known, method="bulk")),
        "ess_tail": float(arviz.ess(known, method="tail")),
        **{name: float(arviz.mcse(known, method="quantile", prob=at)) for name, at in errors.items()},
    }


Arrays = Mapping[str, tuple[tuple[str, ...], FloatArray]]


def inference_data(
    draws: Mapping[str, FloatArray], groups: Mapping[str, tuple[Arrays, Mapping[str, str]]] | None = None
) -> Any:
    """Convert (chain, draw) arrays to `arviz.InferenceData`: a group ``posterior``, and those given.

    Each other group has the names of axes and values by variable, and its attributes.
    """
    import xarray

    posterior = {name: (("chain", "draw"), values) for name, values in draws.items()}
    datasets = {}
    for name, (arrays, notes) in {"posterior": (posterior, {}), **(groups or {})}.items():
        dataset = xarray.Dataset(dict(arrays), attrs=dict(notes))
        datasets[name] = dataset.assign_coords({axis: np.arange(size) for axis, size in dataset.sizes.items()})
    return arviz.InferenceData(**datasets)
