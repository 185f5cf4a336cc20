"""Lump size with a credible interval from tactile maps of the breast (research use only).

``import tactile_bayes as tb`` offers what the command line does; each name is loaded when it is first used:

- `read_scan`, `read_map`, `simulate`, `demo_scan`, `demo_map`: scans and maps
- `scan`: from arrays, or a file of them, to a scan
- `map_of`: from values in rows and columns, or a file of them, to a map
- `check`: whether array, lever arm and quaternions of a scan are as they are stated
- `build_map`: from scans to a map
- `estimate`, `pool`: from a map, or from several maps of one mass, to a size
- `compare`: from the maps of two visits to the change of a mass's size
- `calibrate_size`, `validate`: from tables to a size calibration, or to a trial's report
- `campaign`: from a table of exams to their maps and sizes, and to the trial's report
- `plan`: from assumed errors, or a pilot's tables, to the power of a trial
- `diagnose`: from a posterior's file to how far its draws can be trusted
- `calibrate_repeatability`: from a campaign's folder to the spread between exams of one mass at its site
- `exam_report`: from maps and estimates to the page of an exam, HTML or PDF
- `export`: from maps and estimates to DICOM, FHIR, NRRD and CSV
- `record`: from devices to a scan
- `Map`, `SizeEstimate`, `PooledSize`, `Comparison`, `TrialResult`, `CampaignResult`, `TrialPlan`, `Diagnosis`,
  `ExportedFiles`, `Draws`: what they return; `errors`: what they raise
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

with open(f"{__path__[0]}/__init__.pyi", encoding="utf-8") as _stub:  # noqa: PTH123 (pathlib is not loaded here)
    _HOME = {words[-1]: words[1] for words in map(str.split, _stub) if words[:1] == ["from"]}
"""What the package offers, and the modules that have it: both stand in the stub, for type checkers too."""

__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    """Load a name's module when it is first used: `import tactile_bayes` alone loads neither numpy nor scipy."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOME[name] == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
