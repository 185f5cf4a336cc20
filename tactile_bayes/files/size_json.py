"""Size calibrations, those that come with the program too, and sites' repeatability, as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np

from tactile_bayes.declarations import Meta, Record, field, replace, to_plain
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import sha256, write_text
from tactile_bayes.files.documents import dump_json, load_json, parse_record, read_record
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.geometry import Matrix, Vector
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.bodies import BodyCalibration, BodyLaw
from tactile_bayes.size.eq6 import COEFFICIENTS, AxisCalibration, SizeCalibration
from tactile_bayes.size.pooling import Calibration, Repeatability
from tactile_bayes.size.terms import SiteShift

# --- Size calibrations that come with the program, by name.

SHIPPED: Final = {
    "solid": "solid.json",
    "eq6": "eq6.json",
    "solid-mean": "solid_mean.json",
    "plane-strain": "plane_strain.json",
}
DEFAULT: Final = "solid"
NONE: Final = "none"
_FOLDER = Path(__file__).resolve().parents[1] / "calibrations"


def default_for(normalise: str) -> str:
    """Name of the default calibration for a way to normalise."""
    return "solid-mean" if normalise == "mean" else DEFAULT


def size_calibration_path(name: str) -> Path | None:
    """Path of a calibration by its name, or by its path (``./solid`` for a file called so); None for ``none``."""
    if name == NONE:
        return None
    if name in SHIPPED:
        return _FOLDER / SHIPPED[name]
    path = Path(name)
    if not name or (path.name == name and not path.suffix and not path.exists()):
        raise UsageError(f"no calibration or file is called {name!r}; give {', '.join(SHIPPED)} or a file")
    return path


# --- Size calibrations as JSON: over a population, corrected by a site's phantoms, or Eq 6 with its draws.
#
# The file of each is its record with a header; numbers keep nine significant digits, the residual's covariance six.

FACTOR_DIGITS: Final = 6
FORMS: Final = ("eq6", "population", "site")
Coefficients = tuple[
    Literal["m"], Literal["b_mm"], Literal["e"], Literal["f"], Literal["scatter"], Literal["scatter_slope"]
]


class PopulationFile(BodyLaw, eq=False, kw_only=True):
    """Size calibration over a population: Eq 6 by the depth of the fat, its residual, and what no map shows."""

    schema: Literal["tactile-bayes/size-calibration/4"]
    form: Literal["population"]
    provenance: dict[str, Any]
    constants: Mapping[str, float] = field(default_factory=dict)
    """m, b in mm, e and f of Eq 6 at the centre; for people, not read."""
    research_use: str = RESEARCH_USE


class SiteFile(Record, eq=False, kw_only=True):
    """Size calibration over bodies, corrected by a site's own lumps of known size."""

    schema: Literal["tactile-bayes/site-calibration/1"]
    form: Literal["site"]
    site: SiteShift  #: ln d = the base's + c0 + c1 (ln of the mean width - centre).
    base: dict[str, Any]  #: The whole calibration: size_population.schema.json.
    provenance: dict[str, Any]
    research_use: str = RESEARCH_USE


class AxisFile(AxisCalibration, eq=False, kw_only=True):
    """Coefficients of Eq 6 along one axis; mean and covariance are those of the draws."""

    coefficients: Coefficients
    fit: Mapping[str, float]
    mean: Vector
    covariance: Matrix


class Eq6File(SizeCalibration, eq=False, kw_only=True):
    """Size calibration: posterior of the coefficients of Eq 6."""

    schema: Literal["tactile-bayes/size-calibration/1"]
    form: Literal["eq6"]  #: ln d = ln(m sigma / (e a^f) + b) + N(0, scatter (a / reference_amplitude)^-scatter_slope)
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
    """Write a size calibration of any form atomically; a site's correction keeps the whole `base` that it corrects."""
    if isinstance(calibration, SizeCalibration):
        schema, form, body = "size-calibration/1", "eq6", _eq6_document(calibration)
    elif calibration.site is None:
        schema, form, body = "size-calibration/4", "population", _population_document(calibration)
    else:
        schema, form, body = "site-calibration/1", "site", {"site": to_plain(calibration.site), "base": base}
    document = {"schema": f"tactile-bayes/{schema}", "research_use": RESEARCH_USE, "form": form, **body}
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
        fields = {part: getattr(axis, part) for part in AxisCalibration.__struct_fields__}
        moments = {"mean": draws.mean(axis=0), "covariance": covariance}
        document[name] = to_plain({"coefficients": COEFFICIENTS, **moments, **fields})
    return document


def read_size_calibration(path: Path) -> Calibration:
    """Read a size calibration of any form; one that comes with the program is read once in a process."""
    return _shipped(path) if path.parent == _FOLDER else _read(path)


def _read(path: Path) -> Calibration:
    return parse_size_calibration(load_json(path), path=path)


_shipped = lru_cache(maxsize=len(SHIPPED))(_read)


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
    site_file = parse_record(document, SiteFile, path=path)
    base = parse_size_calibration(site_file.base, path=path)
    if not isinstance(base, BodyCalibration) or base.site is not None:
        what = "its base is no uncorrected calibration over bodies"
        raise BadDataError(what, way_out="learn the correction anew: `calibrate size --correct`", path=str(path))
    return replace(base, site=site_file.site)


# --- A site's repeatability as JSON.

SPREAD: Final = ("log_sd", "median", "low", "high", "masses", "maps", "outlying")
"""Fields that the file and `Repeatability` share."""
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", extra={"words": "a SHA-256, 64 digits from 0 to f"})]


class UsedCalibration(Record):
    """The size calibration that sized the exams."""

    name: str
    sha256: Sha256  #: Of the calibration's file: sizes by another one have another spread, and are refused
    normalise: str  #: How the maps' frames were normalised, as the option of `map`


class HalfWidth(Record):
    """Half width of the 95 % interval of a single exam, a share of the size: median over the exams that took part."""

    as_estimated: float  #: By the spread that the exams were estimated with
    with_it: float  #: By the learned spread


class RepeatedMass(Record):
    """A mass at a visit with repeated exams."""

    name: str  #: Of the mass at this visit, as its folder
    exams: Annotated[list[str], Meta(min_length=2)]
    log_size: Annotated[list[float], Meta(min_length=2)]  #: ln d (mm) by each exam alone, without what no map shows
    map_sd: Annotated[list[Annotated[float, Meta(ge=0)]], Meta(min_length=2)]  #: SD of each by the map's own errors
    by_chance: Annotated[float, Meta(ge=0, le=1)]
    """Probability, by the other masses, that exams of a mass lie as far apart as these"""


class RepeatabilityFile(Record, kw_only=True, omit_defaults=True):
    """A site's repeatability: how far sizes of one mass lie apart between its exams, learned from repeated exams."""

    schema: Literal["tactile-bayes/repeatability/1"]
    research_use: str
    between_map_sd: Annotated[float, Meta(gt=0, le=2)]
    """SD of ln d between exams of one mass beyond the maps' own errors: root mean square of its posterior, which adds
    to the variance of one map's size"""
    log_sd: Annotated[float, Meta(ge=0, le=3)]
    """SD of the natural log of that spread: the log-normal with this and between_map_sd as its root mean square is the
    prior that `estimate --repeatability` uses"""
    median: Annotated[float, Meta(gt=0)]  #: Median of the spread's posterior
    low: Annotated[float, Meta(gt=0)]  #: Lower end of its equal-tailed interval
    high: Annotated[float, Meta(gt=0)]  #: Upper end
    probability: Annotated[float, Meta(ge=0.95, le=0.95)]  #: Of that interval
    masses: Annotated[int, Meta(ge=3)]  #: Masses with repeated exams; visits of a mass count once
    maps: Annotated[int, Meta(ge=6)]  #: Exams that took part
    calibration: UsedCalibration
    half_width: HalfWidth | None = None
    repeats: Annotated[list[RepeatedMass], Meta(min_length=3)]  #: Masses at a visit with repeated exams
    outlying: tuple[str, ...]
    """Masses whose exams lie further apart than the other masses lead one to expect (false alarm at one site in 20);
    they took part"""
    left_out: list[str]  #: Exams of masses with repeats that took no part, and why
    provenance: dict[str, Any]
    """inputs: the size calibration, and the draws of each exam (shape.npz), in the order of repeats"""

    def __post_init__(self) -> None:
        _ = self.spread()  # checks the values

    def spread(self, digest: str = "") -> Repeatability:
        """The spread that a size uses, with the hash of the file it is from."""
        calibration = self.calibration
        return Repeatability(
            sd=self.between_map_sd,
            calibration=calibration.name,
            calibration_sha256=calibration.sha256,
            normalise=calibration.normalise,
            sha256=digest,
            **{name: getattr(self, name) for name in SPREAD},
        )

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the file that `estimate --repeatability` takes, in nine significant digits, atomically."""
        document = to_plain(self)
        parse_record(document, RepeatabilityFile, path=path)
        write_text(path, dump_json(document), force=force)


def read_repeatability(path: Path) -> Repeatability:
    """Read a file of `calibrate repeatability`."""
    file = read_record(path, RepeatabilityFile, way_out="give a file of `calibrate repeatability`")
    return file.spread(sha256(path))
