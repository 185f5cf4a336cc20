"""Provenance of a file: program version, settings, seed and hashes of its inputs, without clock times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

from tactile_bayes import __version__
from tactile_bayes.files.atomic import sha256
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of one output; equal inputs and settings give equal bytes.

    Inputs are named by their role, not by their file name: file names may hold patients' names.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, str] = field(default_factory=dict)
    seed: int | None = None
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
        }


def hash_inputs(**paths: Path) -> dict[str, str]:
    """Digests of the inputs by role, for `Provenance.inputs`."""
    return {role: sha256(path) for role, path in paths.items()}
