"""Loading of scan files, with cautions, and the provenance of their map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bayes.errors import BadDataError

if TYPE_CHECKING:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.scan import Scan


def load_scans(paths: Sequence[Path]) -> tuple[list[Scan], list[str]]:
    """Load scans, and the cautions about them: losses of unfinished files and other doubts."""
    from tactile_bayes.files.scan_mcap import read_scan_report

    scans, lost = [], []
    for number, path in enumerate(paths, start=1):
        file = read_scan_report(path)
        if file.damaged:
            raise BadDataError(f"is damaged ({file.lost[0]})", way_out="copy it again", path=str(path))
        scans.append(file.scan)
        lost += [f"scan {number}: {line}" for line in (*file.lost, *file.cautions())]
    return scans, lost


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
