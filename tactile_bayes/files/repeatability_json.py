"""A site's repeatability as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from tactile_bayes.declarations import to_plain
from tactile_bayes.files.atomic import sha256, write_text
from tactile_bayes.files.documents import check_document, dump_json, load_json
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.size.site import PROBABILITY, Repeatability

SCHEMA: Final = "tactile-bayes/repeatability/1"
SCHEMA_FILE: Final = "repeatability.schema.json"
_SPREAD: Final = ("median", "low", "high")


def repeatability_document(
    found: Repeatability,
    *,
    repeats: Sequence[dict[str, Any]],
    left_out: Sequence[str],
    half_width: dict[str, float] | None,
    provenance: Provenance,
) -> dict[str, Any]:
    """The JSON object; numbers keep nine significant digits.

    Parameters
    ----------
    repeats, half_width
        As the schema has them.
    left_out
        Exams that took no part, with the reason.
    """
    return {
        "schema": SCHEMA,
        "research_use": RESEARCH_USE,
        "between_map_sd": to_plain(found.sd),
        "log_sd": to_plain(found.log_sd),
        **{name: to_plain(getattr(found, name)) for name in _SPREAD},
        "probability": PROBABILITY,
        "masses": found.masses,
        "maps": found.maps,
        "calibration": {
            "name": found.calibration,
            "sha256": found.calibration_sha256,
            "normalise": found.normalise,
        },
        **({} if half_width is None else {"half_width": {name: to_plain(v) for name, v in half_width.items()}}),
        "repeats": list(repeats),
        "outlying": list(found.outlying),
        "left_out": list(left_out),
        "provenance": provenance.as_dict(),
    }


def write_repeatability(path: Path, document: dict[str, Any], *, force: bool = False) -> None:
    """Write the JSON object atomically, held against its schema."""
    check_document(document, SCHEMA_FILE, path=path)
    write_text(path, dump_json(document), force=force)


def read_repeatability(path: Path) -> Repeatability:
    """Read what `write_repeatability` wrote.

    Raises
    ------
    BadDataError
        When the file is none, or a field breaks the schema.
    """
    document: Any = load_json(path, way_out="give a file of `calibrate repeatability`")
    check_document(document, SCHEMA_FILE, path=path)
    used = document["calibration"]
    return Repeatability(
        sd=float(document["between_map_sd"]),
        log_sd=float(document["log_sd"]),
        **{name: float(document[name]) for name in _SPREAD},
        masses=int(document["masses"]),
        maps=int(document["maps"]),
        calibration=used["name"],
        calibration_sha256=used["sha256"],
        normalise=used["normalise"],
        outlying=tuple(document["outlying"]),
        sha256=sha256(path),
    )
