"""Provenance of a file: program version, settings, seed and hashes of its inputs, without clock times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from tactile_bayes import __version__
from tactile_bayes.files.atomic import sha256
from tactile_bayes.records import dataclass

EXAM_FACTS: Final = ("subject", "side", "posture", "examiner", "visit", "mass", "array_calibration_days")
"""What a scan's session says of its exam and array calibration; codes only, see ``scan_session.schema.json``."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of one output; equal inputs and settings give equal bytes.

    Inputs are named by their role, not by their file name: file names may hold patients' names. `scans` are the scans
    at the beginning, through whatever files they came: the digest of each and the `EXAM_FACTS` that it carries.
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


def hash_inputs(**paths: Path) -> dict[str, str]:
    """Digests of the inputs by role, for `Provenance.inputs`."""
    return {role: sha256(path) for role, path in paths.items()}


def scan_facts(digest: str, session: Mapping[str, str]) -> dict[str, str]:
    """Digest of a scan file and what its session says of the exam, for `Provenance.scans`."""
    return {"sha256": digest, **{name: session[name] for name in EXAM_FACTS if session.get(name)}}


def scans_of(document: object) -> tuple[dict[str, str], ...]:
    """The scans that a file's provenance names, as `Provenance.as_dict` wrote it; what is not text is left out."""
    scans = document.get("scans") if isinstance(document, dict) else None
    if not isinstance(scans, list):
        return ()
    known = ("sha256", *EXAM_FACTS)
    return tuple(
        {name: one[name] for name in known if isinstance(one.get(name), str)} for one in scans if isinstance(one, dict)
    )


def repeated_scans(exams: Sequence[Sequence[Mapping[str, str]]]) -> dict[int, int]:
    """Which exams are of a scan that an earlier one is of, by its digest: index of the exam, and of the earlier one."""
    seen: dict[str, int] = {}
    found: dict[int, int] = {}
    for index, scans in enumerate(exams):
        for digest in (scan["sha256"] for scan in scans if scan.get("sha256")):
            if seen.setdefault(digest, index) != index:
                found.setdefault(index, seen[digest])
    return found
