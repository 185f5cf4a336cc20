"""Draws that pooling needs of a map, as plain arrays in an .npz; equal draws give equal bytes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.npz import load_npz
from tactile_bayes.size.draws import ShapeDraws

_DRAWS: Final = ("log_amplitude", "log_width", "q", "r")


def write_shape(path: Path, shape: ShapeDraws, *, force: bool = False) -> None:
    """Write the draws atomically; fields that are None are left out."""
    values: dict[str, Any] = {name: getattr(shape, name) for name in shape.__struct_fields__}
    out = io.BytesIO()
    np.savez_compressed(out, **{name: value for name, value in values.items() if value is not None})
    write_bytes(path, out.getvalue(), force=force)


def read_shape(path: Path) -> ShapeDraws:
    """Read what `write_shape` wrote.

    Raises
    ------
    BadDataError
        When the file is damaged, or its draws are not of one length.
    """
    try:
        optional = [name for name in ShapeDraws.__struct_fields__ if name not in _DRAWS]
        arrays = load_npz(path, required=_DRAWS, optional=optional)
        if len({arrays[name].shape for name in _DRAWS}) > 1:
            raise BadDataError("holds draws of several lengths", way_out="estimate the map again")
        return ShapeDraws(**{name: _value(name, array) for name, array in arrays.items()})
    except BadDataError as error:
        raise error.at(path) from None


def _value(name: str, array: np.ndarray[Any, Any]) -> Any:
    """An array of draws or labels as it is, a number as a float, a few numbers as a tuple."""
    if name in (*_DRAWS, "labels"):
        return array
    return float(array) if array.ndim == 0 else tuple(array.tolist())
