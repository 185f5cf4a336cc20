"""Checkpoints of `estimate --method ensemble`: plain arrays in an .npz, bound by a hash to what they belong to."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import atomic_path
from tactile_bayes.posterior.chain_state import ChainState

SCHEMA = "tactile-bayes/checkpoint/1"
SHAPES = {"chain": 4, "log_density": 2, "accepted": 1, "twister": 2, "cursor": 2}


class CheckpointFile:
    """One file, written anew after each block of steps.

    Parameters
    ----------
    path
        Made when it does not exist.
    context
        What else the chain depends on, for example the calibration's hash; another's checkpoint is refused.
    """

    def __init__(self, path: Path, *, context: str = "") -> None:
        self.path, self.context = path, context

    def load(self, key: str) -> ChainState | None:
        """The state in the file; None when there is no file.

        Raises
        ------
        BadDataError
            When the file is of another map, calibration or setting, or no checkpoint.
        """
        if not self.path.exists():
            return None
        try:
            with np.load(self.path, allow_pickle=False) as data:
                found = {name: data[name] for name in data.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError, KeyError):
            raise BadDataError(f"{self.path} is no checkpoint", way_out="name another file") from None
        if str(found.get("schema", "")) != SCHEMA or any(
            name not in found or found[name].ndim != n for name, n in SHAPES.items()
        ):
            raise BadDataError(f"{self.path} is no checkpoint of schema {SCHEMA}", way_out="name another file")
        if str(found["key"]) != self._bound(key):
            raise BadDataError(
                f"{self.path} is a checkpoint of another map, calibration or setting",
                way_out="give the same map and options (only --max-steps may differ), or name another file",
            )
        return ChainState(**{name: found[name] for name in SHAPES})

    def save(self, key: str, state: ChainState) -> None:
        """Write the state, whole or not at all."""
        with atomic_path(self.path, force=True) as partial, partial.open("wb") as file:
            np.savez(file, schema=np.array(SCHEMA), key=np.array(self._bound(key)), **state.as_arrays())

    def _bound(self, key: str) -> str:
        return f"{key}:{self.context}"
