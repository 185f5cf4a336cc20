"""The one door to arviz: chain diagnostics, and draws as arviz has them."""

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
    """Worst rank-normalised R-hat and smallest bulk and tail effective draws over the parameters.

    Parameters
    ----------
    chains : (chain, draw, p) array

    References
    ----------
    Vehtari, Gelman, Simpson, Carpenter & Buerkner (2021), Bayesian Analysis 16:667.
    """
    columns = [np.ascontiguousarray(chains[:, :, i]) for i in range(chains.shape[2])]
    return {
        "rhat": float(max(arviz.rhat(column, method="rank") for column in columns)),
        "ess_bulk": float(min(arviz.ess(column, method="bulk") for column in columns)),
        "ess_tail": float(min(arviz.ess(column, method="tail") for column in columns)),
    }


def inference_data(draws: Mapping[str, FloatArray]) -> Any:
    """Draws as `arviz.InferenceData` with one group, ``posterior``.

    Parameters
    ----------
    draws
        (chain, draw) arrays by name.
    """
    return arviz.from_dict(posterior=dict(draws))
