"""Posteriors as netCDF that arviz opens: every draw of a map's parameters and of the sizes, and what goes with them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.documents import parse_json
from tactile_bayes.files.estimate_json import check_estimate
from tactile_bayes.files.netcdf import Contents, Variable, grouped_netcdf_bytes, open_netcdf
from tactile_bayes.files.provenance import Provenance, scans_of
from tactile_bayes.findings import Finding, findings_in
from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.arviz_groups import DrawGroup
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.draws import SizePosterior

SCHEMA = "tactile-bayes/posterior/1"


def write_posterior(
    path: Path,
    estimate: Estimate,
    *,
    provenance: Provenance,
    groups: Mapping[str, DrawGroup],
    document: Mapping[str, Any],
    force: bool = False,
) -> None:
    """Write the draws of an estimate atomically; equal draws give equal bytes, see `grouped_netcdf_bytes`.

    Parameters
    ----------
    groups
        What goes beside the draws, see `inference_groups`.
    document
        The estimate's JSON object, which `read_estimate` gives back.

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
        "estimate": json.dumps(document),
    }
    write_bytes(path, _posterior_bytes(variables, attributes, groups), force=force)


def write_pooled(
    path: Path, size: SizePosterior, *, provenance: Provenance, document: Mapping[str, Any], force: bool = False
) -> None:
    """Write the draws of a mass's size from several maps, with its JSON object, atomically."""
    names = ("d_x_mm", "d_y_mm", "max_size_mm", "min_size_mm")
    variables = {name: np.atleast_2d(getattr(size, name)) for name in names}
    attributes = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "method": "pooled",
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps({k: v for k, v in size.figures.items() if _plain(v)}),
        "estimate": json.dumps(document),
    }
    write_bytes(path, _posterior_bytes(variables, attributes, {}), force=force)


def _posterior_bytes(
    variables: Mapping[str, Any], attributes: Mapping[str, str], groups: Mapping[str, DrawGroup]
) -> bytes:
    """A file with groups as InferenceData has them: the (chain, draw) variables of the posterior, then the others."""
    axes = ("chain", "draw")
    draws = {name: (axes, np.asarray(values, dtype=np.float64)) for name, values in variables.items()}
    held = {"posterior": Contents(_with_coordinates(draws), attributes)}
    held |= {name: Contents(_with_coordinates(group.arrays), group.notes) for name, group in groups.items()}
    return grouped_netcdf_bytes(held)


def _with_coordinates(arrays: Mapping[str, tuple[tuple[str, ...], FloatArray]]) -> dict[str, Variable]:
    """The variables after a coordinate of whole numbers for each of their axes."""
    lengths: dict[str, int] = {}
    for axes, values in arrays.values():
        lengths |= dict(zip(axes, np.shape(values), strict=True))
    held = {name: Variable(np.arange(length), (name,), {}) for name, length in lengths.items()}
    return held | {name: Variable(values, axes, {}) for name, (axes, values) in arrays.items()}


class PosteriorDraws(Record, eq=False):
    """What a posterior file says."""

    method: str
    """That gave the draws."""
    draws: dict[str, FloatArray]
    """(chain, draw) arrays by name."""
    diagnostics: dict[str, Any]
    """As the estimate's JSON has them."""
    scans: tuple[dict[str, str], ...] = ()
    """The scans at the beginning, as `Provenance.scans` has them."""
    findings: tuple[Finding, ...] = ()
    """What speaks against the estimate."""


def read_posterior(path: Path) -> PosteriorDraws:
    """Read what `write_posterior` or `write_pooled` wrote.

    Raises
    ------
    BadDataError
        When the file is no posterior, holds no draws, or is damaged.
    """
    way_out = "give what `estimate` wrote with -o"
    with open_netcdf(path, way_out=way_out) as file:
        group = file.group("posterior")
        attributes = {} if group is None else group.attributes()
        if group is None or attributes.get("schema") != SCHEMA:
            raise BadDataError("holds no posterior of this program", way_out=way_out)
        names = [name for name in group.variables() if name not in ("chain", "draw")]
        draws = {name: group.array(name, kind="f8", dimensions=("chain", "draw")) for name in names}
    if not draws or not all(values.size > 1 for values in draws.values()):
        raise BadDataError("holds no draws", way_out=way_out, path=str(path))
    for name, values in draws.items():
        if np.isinf(values).any() or np.isnan(values).all():  # single draws may have no value
            raise BadDataError(f"variable {name} holds infinity, or no number", way_out=way_out, path=str(path))
    diagnostics = parse_json(attributes.get("diagnostics", "{}"))
    figures = diagnostics if isinstance(diagnostics, dict) else {}
    scans = scans_of(parse_json(attributes.get("provenance", "{}")))
    document = parse_json(attributes.get("estimate", "{}"))
    findings = findings_in(document.get("findings", []) if isinstance(document, dict) else [])
    return PosteriorDraws(attributes.get("method", ""), draws, figures, scans, findings)


def read_estimate(path: Path) -> dict[str, Any]:
    """The estimate's JSON object, as ``estimate --json`` prints it, from its posterior's file.

    Raises
    ------
    BadDataError
        When the file is no posterior, is of several maps, or is damaged.
    """
    with open_netcdf(path, way_out="give what `estimate` wrote with -o") as file:
        group = file.group("posterior")
        attributes = {} if group is None else group.attributes()
    if attributes.get("method") == "pooled":
        raise BadDataError("holds a size pooled from several maps", way_out="give the maps", path=str(path))
    if "estimate" not in attributes:
        what = "holds draws without their estimate"
        raise BadDataError(what, way_out="give its map, or write it again with `estimate -o`", path=str(path))
    document: Any = parse_json(attributes["estimate"])
    check_estimate(document, "estimate.schema.json", path=path)
    found: dict[str, Any] = document
    return found


def is_posterior(path: Path) -> bool:
    """Whether a netCDF file holds a posterior, of this program or another, and no map."""
    with open_netcdf(path, way_out="give a map, or what `estimate` wrote with -o") as file:
        return file.group("posterior") is not None


def _plain(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)
