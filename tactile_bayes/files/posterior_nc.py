"""Posteriors as netCDF that arviz opens: every draw of the map's parameters and of the sizes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.netcdf import Variable, netcdf_bytes
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.posterior import SizePosterior

SCHEMA = "tactile-bayes/posterior/1"


def write_posterior(path: Path, estimate: Estimate, *, provenance: Provenance, force: bool = False) -> None:
    """Write the draws of an estimate atomically; equal draws give equal bytes, see `netcdf_bytes`.

    Raises
    ------
    ValueError
        When there is no estimate: there are no draws to write.
    """
    if estimate.map_posterior is None or estimate.draws is None:
        raise ValueError("no estimate, so no posterior to write")
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
    figures = {} if estimate.diagnostics is None else estimate.diagnostics.as_dict()
    attributes = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "method": estimate.draws.method,
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps({k: v for k, v in figures.items() if _plain(v)}),
    }
    write_bytes(path, _posterior_bytes(variables, attributes), force=force)


def write_pooled(path: Path, size: SizePosterior, *, provenance: Provenance, force: bool = False) -> None:
    """Write the draws of a mass's size, pooled over its maps, atomically."""
    names = ("d_x_mm", "d_y_mm", "max_size_mm", "min_size_mm")
    variables = {name: np.atleast_2d(getattr(size, name)) for name in names}
    attributes = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "method": "pooled",
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps({k: v for k, v in size.figures.items() if _plain(v)}),
    }
    write_bytes(path, _posterior_bytes(variables, attributes), force=force)


def _posterior_bytes(variables: Mapping[str, Any], attributes: Mapping[str, str]) -> bytes:
    """A file with one group of (chain, draw) variables, as InferenceData has it."""
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in variables.items()}
    axes = ("chain", "draw")
    lengths = next(iter(arrays.values())).shape
    held = {name: Variable(np.arange(n), (name,), {}) for name, n in zip(axes, lengths, strict=True)}
    held |= {name: Variable(values, axes, {}) for name, values in arrays.items()}
    return netcdf_bytes(held, attributes=attributes, group="posterior")


def _plain(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)
