"""The provenance of a map of scan files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.scan import Scan


def map_provenance(paths: Sequence[Path], scans: Sequence[Scan], settings: Mapping[str, Any]) -> Provenance:
    """Provenance of a map: its settings, the scans' digests, and what the scans say of their exam.

    Parameters
    ----------
    paths, scans
        The files, and what was read from each.
    settings
        By the names of the command's options.
    """
    from tactile_bayes.files.provenance import Provenance

    facts = exam_facts(paths, scans)
    inputs = {f"scan_{number}": fact["sha256"] for number, fact in enumerate(facts, start=1)}
    return Provenance("map", settings, inputs, scans=facts)


def exam_facts(paths: Sequence[Path], scans: Sequence[Scan]) -> list[dict[str, str]]:
    """Digests of each scan and what it says of its exam, for `Provenance.scans`."""
    from tactile_bayes.files.atomic import sha256
    from tactile_bayes.files.provenance import scan_facts

    return [
        scan_facts(scan.session, frames=scan.frames.sha256, file=sha256(path))
        for path, scan in zip(paths, scans, strict=True)
    ]
