"""Checkpoints of `estimate --method ensemble`: plain arrays in an .npz, bound by a hash to what they belong to."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.npz import load_npz
from tactile_bayes.inference.chain_state import ChainState

SCHEMA = "tactile-bayes/checkpoint/2"
SHAPES = {"chain": 4, "log_density": 2, "accepted": 1, "twister": 2, "cursor": 2}


class CheckpointFile:
    """A checkpoint file, rewritten after each block of steps.

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
        """Read the state; None when there is no file.

        Raises
        ------
        BadDataError
            When the file is of another map, calibration or setting, or no checkpoint.
        """
        if not self.path.exists():
            return None
        try:
            found = load_npz(self.path, required=["schema", "key", "sha256", *SHAPES], optional=())
        except BadDataError as error:
            raise BadDataError(
                f"is no checkpoint: {error.what}", way_out="name another file", path=str(self.path)
            ) from None
        shaped = all(found[name].ndim == n for name, n in SHAPES.items())
        if str(found["schema"]) != SCHEMA or not shaped:
            raise BadDataError(f"is no checkpoint of schema {SCHEMA}", way_out="name another file", path=str(self.path))
        if str(found["sha256"]) != _digest(found):
            raise BadDataError("is damaged: its checksum does not match", way_out="remove it", path=str(self.path))
        if str(found["key"]) != self._bound(key):
            raise BadDataError(
                "is a checkpoint of another map, calibration or setting",
                way_out="give the same map and options (only max_steps may differ), or name another file",
                path=str(self.path),
            )
        return ChainState(**{name: found[name] for name in SHAPES})

    def save(self, key: str, state: ChainState) -> None:
        """Write the state atomically."""
        arrays = {"schema": np.array(SCHEMA), "key": np.array(self._bound(key)), **state.as_arrays()}
        buffer = io.BytesIO()
        np.savez(buffer, sha256=np.array(_digest(arrays)), **arrays)
        write_bytes(self.path, buffer.getvalue(), force=True)

    def _bound(self, key: str) -> str:
        return f"{key}:{self.context}"


def _digest(arrays: Mapping[str, np.ndarray[Any, Any]]) -> str:
    """Checksum of the state and of what it belongs to, so that no changed number is read as valid."""
    digest = hashlib.sha256()
    for name in ("key", *SHAPES):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape};".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
