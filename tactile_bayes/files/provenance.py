"""Provenance of a file: program version, settings, seed and hashes of its inputs, without clock times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from tactile_bayes import __version__
from tactile_bayes.declarations import Record, field
from tactile_bayes.files.atomic import sha256
from tactile_bayes.scans import Scan

EXAM_FACTS: Final = ("subject", "side", "posture", "examiner", "visit", "mass", "array_calibration_days")
"""Facts of a scan's session about its exam and array calibration; codes only, see ``scan_session.schema.json``."""
_DIGESTS: Final = ("sha256", "frames_sha256")
"""Digests of a scan's file, and of its frames, which stays when the scan is written with another session."""


class Provenance(Record):
    """The origin of one output; equal inputs and settings give equal bytes.

    Inputs are named by their role, not by their file name: file names may hold patients' names. `scans` are the scans
    that the output comes from, through any number of files: the digests and `EXAM_FACTS` of each.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None
    scans: Sequence[Mapping[str, str]] = ()
    version: str = __version__

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, with keys in a fixed order."""
        return {
            "program": "tactile-bayes",
            "version": self.version,
            "command": self.command,
            "settings": dict(self.settings),
            "seed": self.seed,
            "inputs": [{"role": role, "sha256": digest} for role, digest in self.inputs.items()],
            **({"scans": [dict(scan) for scan in self.scans]} if self.scans else {}),
        }


def hash_inputs(**paths: Path | None) -> dict[str, str]:
    """Digests of the inputs by role, for `Provenance.inputs`; None is no file."""
    return {role: sha256(path) for role, path in paths.items() if path is not None}


def scan_facts(scan: Scan, file_sha256: str = "") -> dict[str, str]:
    """Digests and `EXAM_FACTS` of a scan, for `Provenance.scans`; `file_sha256` is empty without a file."""
    facts = {name: scan.session[name] for name in EXAM_FACTS if scan.session.get(name)}
    return {**({"sha256": file_sha256} if file_sha256 else {}), **facts, "frames_sha256": scan.frames.sha256}


def scans_of(document: object) -> tuple[dict[str, str], ...]:
    """`Provenance.scans` of a file's provenance; values that are not text are left out."""
    scans = document.get("scans") if isinstance(document, dict) else None
    if not isinstance(scans, list):
        return ()
    known, tables = (*_DIGESTS, *EXAM_FACTS), (one for one in scans if isinstance(one, dict))
    return tuple({name: one[name] for name in known if isinstance(one.get(name), str)} for one in tables)


def recordings(scans: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Digests of scans' frames and files: two exams are of one recording where they share any of them."""
    for scan in scans:
        yield from (f"{name} {scan[name]}" for name in _DIGESTS if scan.get(name))


def exam_with_any(marks: Sequence[str], name: str, of: dict[str, str]) -> str | None:
    """Name of an earlier exam that has any of the marks, such as `recordings`; without one they are kept in `of`."""
    earlier = next((of[mark] for mark in marks if mark in of), None)
    if earlier is None:
        of.update(dict.fromkeys(marks, name))
    return earlier


def repeated_scans(exams: Sequence[Sequence[Mapping[str, str]]]) -> dict[int, int]:
    """Exams that share a recording with an earlier one: index of the exam -> index of the earlier one."""
    first_exam: dict[str, int] = {}
    repeats: dict[int, int] = {}
    for index, scans in enumerate(exams):
        for recording in recordings(scans):
            if first_exam.setdefault(recording, index) != index:
                repeats.setdefault(index, first_exam[recording])
    return repeats
