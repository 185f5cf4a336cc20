"""Maps as NRRD, the format of 3D Slicer: one slice in the patient's frame."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.exports.exam import MapFile
from tactile_bayes.exports.extras import required
from tactile_bayes.exports.place import lps_from_plane, on_plane
from tactile_bayes.findings import finding_lines
from tactile_bayes.presets import RESEARCH_USE


def nrrd_bytes(source: MapFile) -> bytes:
    """A map as the bytes of a NRRD file: float32 values (nx, ny, 1), NaN where there are none.

    The axes are the plane's, in ``left-posterior-superior`` and mm; the slice is as thick as a cell is wide.

    Raises
    ------
    BadDataError
        When the map has no landmarks, and so no place in the patient.
    UsageError
        When the extra is not installed.
    """
    nrrd = required("nrrd")
    one = source.tactile_map
    transform = lps_from_plane(one)
    if transform is None:
        raise BadDataError(
            "has no landmarks, so its place in the patient is not known",
            way_out="3D Slicer takes maps of scans in which sternal notch and xiphoid were touched",
            path=str(source.path),
        )
    values = np.where(one.covered, one.mean, np.nan).T[:, :, None].astype("<f4")
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space units": ["mm", "mm", "mm"],
        "space directions": transform[:3, :3].T * one.recipe.cell_mm,
        "space origin": on_plane(transform, (float(one.x_mm[0]), float(one.y_mm[0]))),
        "encoding": "gzip",
        "content": "tactile map",
        "tactile_bayes_values": one.recipe.value_words.encode("ascii", "replace").decode(),
        "tactile_bayes_map_sha256": source.digest,
        "tactile_bayes_findings": " ".join(finding_lines(one.findings, paper=True)).encode("ascii", "replace").decode(),
        "tactile_bayes_research_use": RESEARCH_USE,
    }
    return _written(nrrd, values, header)


def _written(nrrd: Any, values: Any, header: dict[str, Any]) -> bytes:
    """Bytes of the file without the comment lines of the library, one of which has the time of day."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the library asks for the time in an old way
        nrrd.write(buffer, values, header, index_order="F", compression_level=9)
    head, _, data = buffer.getvalue().partition(b"\n\n")
    kept = [line for line in head.split(b"\n") if not line.startswith(b"#")]
    return b"\n".join(kept) + b"\n\n" + data
