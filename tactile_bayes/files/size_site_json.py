"""Size calibrations corrected by a site's phantoms as JSON: the correction, and the whole calibration it corrects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.schema import check_document, dump_json
from tactile_bayes.files.size_parts_json import array_of, number, numbers
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.site_shift import PARAMETERS, SiteShift

SCHEMA = "tactile-bayes/site-calibration/1"
SCHEMA_FILE = "size_site.schema.json"
FORM = "site"


def write_site_calibration(
    path: Path, site: SiteShift, *, base: dict[str, Any], provenance: Provenance, force: bool = False
) -> None:
    """Write a corrected calibration atomically; numbers keep nine significant digits.

    Parameters
    ----------
    base
        Document of the calibration that is corrected: the file stays valid when the shipped one is learned anew.
    """
    document = {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "form": FORM,
        "site": site_document(site),
        "base": base,
        "provenance": provenance.as_dict(),
    }
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def site_document(site: SiteShift) -> dict[str, Any]:
    """The correction as plain data."""
    return {
        "parameters": list(PARAMETERS),
        "base": site.base,
        "centre_log_width": site.centre,
        "mean": numbers(site.mean),
        "covariance": numbers(site.covariance),
        "phantoms": site.phantoms,
        "maps": site.maps,
        "uses_fat": site.uses_fat,
        "fit": {name: number(value) for name, value in site.fit.items()},
        "cautions": list(site.cautions),
        "left_out": list(site.left_out),
    }


def parse_site_calibration(document: dict[str, Any], base: object, *, path: Path) -> BodyCalibration:
    """Parse a corrected calibration from a document that keeps the schema.

    Parameters
    ----------
    base
        The calibration parsed from the document's ``base``.

    Raises
    ------
    BadDataError
        When its numbers cannot be those of a correction, or the base is of a form that has none.
    """
    found = document["site"]
    if not isinstance(base, BodyCalibration) or base.site is not None:
        what = "its base is no uncorrected calibration over bodies"
        raise BadDataError(what, way_out="learn the correction anew: `calibrate size --correct`", path=str(path))
    try:
        site = SiteShift(
            centre=float(found["centre_log_width"]),
            mean=array_of(found, "mean"),
            covariance=array_of(found, "covariance"),
            phantoms=int(found["phantoms"]),
            maps=int(found["maps"]),
            base=found["base"],
            uses_fat=bool(found["uses_fat"]),
            fit={name: float(value) for name, value in found["fit"].items()},
            cautions=tuple(found["cautions"]),
            left_out=tuple(found["left_out"]),
        )
    except BadDataError as error:
        raise error.at(path) from None
    return replace(base, site=site)
