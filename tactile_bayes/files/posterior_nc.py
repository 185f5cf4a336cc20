"""Posteriors as netCDF that arviz opens: the draws of a map's parameters and sizes, with the estimate's report."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.documents import parse_json
from tactile_bayes.files.estimate_json import checked_report
from tactile_bayes.files.netcdf import Contents, Variable, grouped_netcdf_bytes, open_netcdf
from tactile_bayes.files.provenance import Provenance, scans_of
from tactile_bayes.files.reports import EstimateReport, PooledReport
from tactile_bayes.findings import Finding, findings_in
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.ensemble import DrawGroup
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.draws import SizePosterior

POSTERIOR_SCHEMA = "tactile-bayes/posterior/1"
OF_A_MAP: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "x_mm", "y_mm", "angle_rad", "background", "noise_sd")
_OF_A_SIZE: Final = ("d_x_mm", "d_y_mm", "max_size_mm", "min_size_mm")


def write_posterior(
    path: Path,
    result: Estimate | SizePosterior,
    *,
    provenance: Provenance,
    report: EstimateReport | PooledReport,
    groups: Mapping[str, DrawGroup] | None = None,
    force: bool = False,
) -> None:
    """Write the draws of an estimate, or of a mass's size from several maps, atomically; equal draws give equal bytes.

    The file has groups as InferenceData has them: the (chain, draw) variables of the posterior, then `groups`, see
    `inference_groups`; `report` is the estimate's, which `read_estimate` gives back. A map without an estimate has no
    draws: a ValueError.
    """
    method, draws, figures = _draws_of(result)
    finite = {name: v for name, v in figures.items() if not isinstance(v, float) or math.isfinite(v)}
    attributes = {
        "schema": POSTERIOR_SCHEMA,
        "research_use": RESEARCH_USE,
        "method": method,
        "provenance": json.dumps(provenance.as_dict()),
        "diagnostics": json.dumps(finite),
        "estimate": json.dumps(report.document),
    }
    variables = {name: (("chain", "draw"), np.asarray(values, dtype=np.float64)) for name, values in draws.items()}
    contents = {"posterior": Contents(_with_coordinates(variables), attributes)}
    contents |= {name: Contents(_with_coordinates(group.arrays), group.notes) for name, group in (groups or {}).items()}
    write_bytes(path, grouped_netcdf_bytes(contents), force=force)


def _draws_of(result: Estimate | SizePosterior) -> tuple[str, dict[str, FloatArray], Mapping[str, Any]]:
    """Name of the method, its (chain, draw) arrays by name, and its diagnostics."""
    if isinstance(result, SizePosterior):
        return "pooled", {name: np.atleast_2d(getattr(result, name)) for name in _OF_A_SIZE}, result.figures
    assert result.map_posterior is not None
    assert result.draws is not None
    draws = {name: getattr(result.map_posterior, name) for name in OF_A_MAP}
    if result.size is not None:
        draws |= {name: getattr(result.size, name) for name in _OF_A_SIZE}
    return result.draws.method, draws, result.diagnostics


def _with_coordinates(arrays: Mapping[str, tuple[tuple[str, ...], FloatArray]]) -> dict[str, Variable]:
    """The variables, after a coordinate 0, 1, 2... for each of their axes."""
    lengths: dict[str, int] = {}
    for axes, values in arrays.values():
        lengths |= dict(zip(axes, np.shape(values), strict=True))
    coordinates = {name: Variable(np.arange(length), (name,), {}) for name, length in lengths.items()}
    return coordinates | {name: Variable(values, axes, {}) for name, (axes, values) in arrays.items()}


class PosteriorDraws(Record, eq=False):
    """Contents of a posterior file."""

    method: str  #: Name of the sampler.
    draws: dict[str, FloatArray]  #: (chain, draw) arrays by name.
    diagnostics: dict[str, Any]  #: As the estimate's JSON has them.
    scans: tuple[dict[str, str], ...] = ()  #: `Provenance.scans` of the map.
    findings: tuple[Finding, ...] = ()  #: Cautions and checks of the estimate.


def read_posterior(path: Path) -> PosteriorDraws:
    """Read what `write_posterior` wrote."""
    way_out = "give what `estimate` wrote with -o"
    with open_netcdf(path, way_out=way_out) as file:
        group = file.group("posterior")
        attributes = {} if group is None else group.attributes()
        if group is None or attributes.get("schema") != POSTERIOR_SCHEMA:
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


def read_estimate(path: Path) -> EstimateReport:
    """The estimate's report, as ``estimate --json`` prints it, from its posterior's file; a pooled one is refused."""
    attributes = posterior_attributes(path, way_out="give what `estimate` wrote with -o") or {}
    if attributes.get("method") == "pooled":
        raise BadDataError("holds a size pooled from several maps", way_out="give the maps", path=str(path))
    if "estimate" not in attributes:
        what = "holds draws without their estimate"
        raise BadDataError(what, way_out="give its map, or write it again with `estimate -o`", path=str(path))
    return checked_report(parse_json(attributes["estimate"]), EstimateReport, path=path)


def is_posterior(path: Path) -> bool:
    """True when a netCDF file holds a posterior, of this program or another, and no map."""
    return posterior_attributes(path, way_out="give a map, or what `estimate` wrote with -o") is not None


def posterior_attributes(path: Path, *, way_out: str) -> dict[str, str] | None:
    """Attributes of the posterior in a netCDF file; None where it holds none."""
    with open_netcdf(path, way_out=way_out) as file:
        group = file.group("posterior")
        return None if group is None else group.attributes()
