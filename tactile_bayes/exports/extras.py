"""Packages that only exports need, each imported when its format is asked for."""

from __future__ import annotations

import importlib
from typing import Any, Final

from tactile_bayes.errors import UsageError

EXTRAS: Final = {"pydicom": "dicom", "highdicom": "dicom", "fhir.resources": "fhir", "nrrd": "slicer"}
"""Package -> the extra of this program that installs it."""


def required(module: str) -> Any:
    """Import a module of an optional package, for example ``highdicom.sr``.

    Raises
    ------
    UsageError
        When its package is not installed, with the command that installs it.
    """
    package = next(name for name in EXTRAS if module == name or module.startswith(f"{name}."))
    try:
        return importlib.import_module(module)
    except ImportError:
        extra = EXTRAS[package]
        raise UsageError(
            f"this needs the package {package}; install it with pip install 'tactile-bayes[{extra}]'"
        ) from None
