"""Posteriors as netCDF that arviz opens: every draw of the map's parameters and of the sizes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from tactile_bayes.files.atomic import atomic_path
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.posterior.estimate import Estimate
from tactile_bayes.posterior.size import SizePosterior
from tactile_bayes.presets import RESEARCH_USE

SCHEMA = "tactile-bayes/posterior/1"


def write_posterior(path: Path, estimate: Estimate, *, provenance: Provenance, force: bool = False) -> None:
    """Write the draws of an estimate atomically; equal inputs give equal bytes.

    Raises
    ------
    ValueError
        When there is no estimate: there are no draws to write.
    """
    if estimate.map_posterior is None or estimate.draws is None:
        raise ValueError("no estimate, so no posterior to write")
    from tactile_bayes.posterior.inference_data import to_inference_data

    posterior = estimate.map_posterior
    variables = {
        "amplitude": posterior.amplitude,
        "sigma_x_mm": posterior.sigma_x_mm,
        "sigma_y_mm": posterior.sigma_y_mm,
        "x_mm": posterior.x_mm,
        "y_mm": posterior.y_mm,
        "angle_rad": posterior.angle_rad,
        "background": posterior.background,
        "noise_sd": posterior.noise_sd,
    }
    if estimate.size is not None:
        variables |= {
            "d_x_mm": estimate.size.d_x_mm,
            "d_y_mm": estimate.size.d_y_mm,
            "max_size_mm": estimate.size.max_size_mm,
            "min_size_mm": estimate.size.min_size_mm,
        }
    attributes = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "method": estimate.draws.method,
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps({k: v for k, v in estimate.diagnostics.items() if _plain(v)}),
    }
    data = to_inference_data({k: np.asarray(v) for k, v in variables.items()}, attributes=attributes)
    with atomic_path(path, force=force) as partial:
        data.to_netcdf(str(partial), engine="h5netcdf")


def write_pooled(path: Path, size: SizePosterior, *, provenance: Provenance, force: bool = False) -> None:
    """Write the draws of a mass's size, pooled over its maps, atomically."""
    from tactile_bayes.posterior.inference_data import to_inference_data

    names = ("d_x_mm", "d_y_mm", "max_size_mm", "min_size_mm")
    variables = {name: np.atleast_2d(getattr(size, name)) for name in names}
    attributes = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "method": "pooled",
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps({k: v for k, v in size.figures.items() if _plain(v)}),
    }
    data = to_inference_data(variables, attributes=attributes)
    with atomic_path(path, force=force) as partial:
        data.to_netcdf(str(partial), engine="h5netcdf")


def _plain(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)
