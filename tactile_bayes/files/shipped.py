"""Size calibrations that come with the program, by name."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from tactile_bayes.errors import UsageError

SHIPPED: Final = {
    "solid": "solid.json",
    "eq6": "eq6.json",
    "solid-mean": "solid_mean.json",
    "plane-strain": "plane_strain.json",
}
DEFAULT: Final = "solid"
NONE: Final = "none"
_FOLDER = Path(__file__).resolve().parents[1] / "calibrations"


def is_shipped(path: Path) -> bool:
    """Whether a file comes with the program; the tests check those against their schemas."""
    return path.parent == _FOLDER


def default_for(normalise: str) -> str:
    """Name of the default calibration for a way to normalise."""
    return "solid-mean" if normalise == "mean" else DEFAULT


def size_calibration_path(name: str) -> Path | None:
    """Path of a calibration given by name or path; None for ``none``.

    A file of the same name in the working directory needs a ``./`` before it.

    Raises
    ------
    UsageError
        When it is no name of a calibration and no file either: most likely a name that was typed wrong.
    """
    if name == NONE:
        return None
    if name in SHIPPED:
        return _FOLDER / SHIPPED[name]
    path = Path(name)
    if path.name == name and not path.suffix and not path.exists():
        raise UsageError(f"no calibration or file is called {name!r}; give {', '.join(SHIPPED)} or a file")
    return path
