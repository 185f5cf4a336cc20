"""Size calibrations as JSON: over a population, corrected by a site's phantoms, or Eq 6 with draws of its coefficients.

The file of each is its record with a header; numbers keep nine significant digits, the residual's covariance six.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np

from tactile_bayes.declarations import Meta, Record, field, replace, to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.documents import dump_json, load_json, parse_record
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.shipped import SHIPPED, is_shipped
from tactile_bayes.geometry import Matrix, Vector
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.bodies import BodyCalibration, BodyLaw
from tactile_bayes.size.eq6 import COEFFICIENTS, AxisCalibration, SizeCalibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import LEARN_ANEW, SiteShift

FACTOR_DIGITS: Final = 6
FORMS: Final = ("eq6", "population", "site")
_RANGES: Final = {"amplitude", "sigma_mm", "d_mm"}
Coefficients = tuple[
    Literal["m"], Literal["b_mm"], Literal["e"], Literal["f"], Literal["scatter"], Literal["scatter_slope"]
]


class PopulationFile(BodyLaw, eq=False, kw_only=True):
    """Size calibration over a population: Eq 6 by the depth of the fat, its residual, and what no map shows."""

    schema: Literal["tactile-bayes/size-calibration/4"]
    form: Literal["population"]
    provenance: dict[str, Any]
    constants: Annotated[
        Mapping[str, float], Meta(description="m, b in mm, e and f of Eq 6 at the centre; for people, not read.")
    ] = field(default_factory=dict)
    research_use: str = RESEARCH_USE

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_domain(self.domain)


class SiteFile(Record, eq=False, kw_only=True):
    """Size calibration over bodies, corrected by a site's own lumps of known size."""

    schema: Literal["tactile-bayes/site-calibration/1"]
    form: Literal["site"]
    site: Annotated[SiteShift, Meta(description="ln d = the base's + c0 + c1 (ln of the mean width - centre).")]
    base: Annotated[dict[str, Any], Meta(description="The whole calibration: size_population.schema.json.")]
    provenance: dict[str, Any]
    research_use: str = RESEARCH_USE


class AxisFile(AxisCalibration, eq=False, kw_only=True):
    """Coefficients of Eq 6 along one axis; mean and covariance are those of the draws."""

    coefficients: Coefficients
    fit: Mapping[str, float]
    mean: Vector
    covariance: Matrix

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_domain(self.domain)


class Eq6File(SizeCalibration, eq=False, kw_only=True):
    """Size calibration: posterior of the coefficients of Eq 6."""

    schema: Literal["tactile-bayes/size-calibration/1"]
    form: Annotated[
        Literal["eq6"],
        Meta(description="ln d = ln(m sigma / (e a^f) + b) + N(0, scatter (a / reference_amplitude)^-scatter_slope)"),
    ]
    x: AxisFile
    y: AxisFile
    axes: Annotated[tuple[Literal["x", "y", "both"], ...], Meta(min_length=1, max_length=2)]
    provenance: dict[str, Any]
    research_use: str = RESEARCH_USE


def write_size_calibration(
    path: Path,
    calibration: Calibration,
    *,
    provenance: Provenance,
    base: dict[str, Any] | None = None,
    force: bool = False,
) -> None:
    """Write a size calibration of any form atomically.

    With a site's correction the whole calibration that it corrects, `base`, is kept in the file.
    """
    if isinstance(calibration, SizeCalibration):
        header, body = ("tactile-bayes/size-calibration/1", "eq6"), _eq6_document(calibration)
    elif calibration.site is None:
        header, body = ("tactile-bayes/size-calibration/4", "population"), _population_document(calibration)
    else:
        header, body = ("tactile-bayes/site-calibration/1", "site"), {"site": to_plain(calibration.site), "base": base}
    document = {"schema": header[0], "research_use": RESEARCH_USE, "form": header[1], **body}
    document |= {"provenance": provenance.as_dict()}
    parse_size_calibration(document, path=path)
    write_text(path, dump_json(document), force=force)


def _population_document(calibration: BodyCalibration) -> dict[str, Any]:
    law = {name: getattr(calibration, name) for name in BodyLaw.__struct_fields__}
    document: dict[str, Any] = to_plain({**law, "constants": calibration.constants()})
    if calibration.residual is not None:
        factor = to_plain(calibration.residual.covariance_factor, digits=FACTOR_DIGITS)
        document["residual"]["covariance_factor"] = factor
    return document


def _eq6_document(calibration: SizeCalibration) -> dict[str, Any]:
    names = ("recipe", "axes", "residual_correlation", "cautions", "left_out")
    document: dict[str, Any] = to_plain({name: getattr(calibration, name) for name in names})
    for name in ("x", "y"):
        axis: AxisCalibration = getattr(calibration, name)
        k, draws = len(COEFFICIENTS), axis.draws
        covariance = np.cov(draws.T) if len(draws) > 1 else np.zeros((k, k))
        own = {part: getattr(axis, part) for part in AxisCalibration.__struct_fields__}
        moments = {"mean": draws.mean(axis=0), "covariance": covariance}
        document[name] = to_plain({"coefficients": COEFFICIENTS, **moments, **own})
    return document


def read_size_calibration(path: Path) -> Calibration:
    """Read a size calibration of any form; one that comes with the program is read once in a process.

    Raises
    ------
    BadDataError
        When the file is not one, or a field is none of what its record declares.
    """
    return _shipped(path) if is_shipped(path) else parse_size_calibration(load_json(path), path=path)


@lru_cache(maxsize=len(SHIPPED))
def _shipped(path: Path) -> Calibration:
    return parse_size_calibration(load_json(path), path=path)


def parse_size_calibration(document: Any, *, path: Path) -> Calibration:
    """Parse a calibration of any form; for the errors see `read_size_calibration`."""
    form, schema = (document.get(name) if isinstance(document, dict) else None for name in ("form", "schema"))
    if form not in FORMS and form is not None and "size-calibration" in str(schema):
        raise BadDataError(f"form is {form!r:.60}", way_out=f"give one of {', '.join(FORMS)}", path=str(path))
    if form == "population":
        file = parse_record(document, PopulationFile, path=path)
        return BodyCalibration(**{name: getattr(file, name) for name in BodyLaw.__struct_fields__})
    if form != "site":
        return parse_record(document, Eq6File, path=path)
    corrected = parse_record(document, SiteFile, path=path)
    base = parse_size_calibration(corrected.base, path=path)
    if not isinstance(base, BodyCalibration) or base.site is not None:
        what = "its base is no uncorrected calibration over bodies"
        raise BadDataError(what, way_out="learn the correction anew: `calibrate size --correct`", path=str(path))
    return replace(base, site=corrected.site)


def _check_domain(domain: Mapping[str, object]) -> None:
    missing = sorted(_RANGES - set(domain))
    if missing:
        raise BadDataError(f"domain has no {missing[0]}", way_out=LEARN_ANEW)
