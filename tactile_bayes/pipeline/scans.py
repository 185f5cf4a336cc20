"""Loading of scan files, with cautions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bayes.errors import BadDataError

if TYPE_CHECKING:
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
