"""Lump size with a credible interval from tactile maps of the breast (research use only).

``import tactile_bayes as tb`` offers what the command line does; each name is loaded when it is first used:

- `read_scan`, `read_map`, `simulate`, `demo_scan`, `demo_map`: scans and maps
- `build_map`: from scans to a map
- `estimate`, `pool`: from a map, or from several maps of one mass, to a size
- `compare`: from the maps of two visits to the change of a mass's size
- `calibrate_size`, `validate`: from tables to a size calibration, or to a trial's report
- `calibrate_repeatability`: from a campaign's folder to the spread between exams of one mass at its site
- `exam_report`: from maps and estimates to the page of an exam, HTML or PDF
- `export`: from maps and estimates to DICOM, FHIR, NRRD and CSV
- `record`: from devices to a scan
- `Map`, `SizeEstimate`, `PooledSize`, `Comparison`, `TrialResult`, `ExportedFiles`, `Draws`: what they return;
  `errors`: what they raise
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

__all__ = [
    "Comparison",
    "Draws",
    "ExportedFiles",
    "Map",
    "PooledSize",
    "SizeEstimate",
    "TrialResult",
    "build_map",
    "calibrate_repeatability",
    "calibrate_size",
    "compare",
    "demo_map",
    "demo_scan",
    "errors",
    "estimate",
    "exam_report",
    "export",
    "pool",
    "read_map",
    "read_scan",
    "record",
    "simulate",
    "validate",
]

_HOME = {
    "Comparison": "api.comparing",
    "Draws": "inference.draws",
    "ExportedFiles": "api.reports",
    "Map": "api.maps",
    "PooledSize": "api.pooled",
    "SizeEstimate": "api.sized",
    "TrialResult": "api.trials",
    "build_map": "api.maps",
    "calibrate_repeatability": "api.trials",
    "calibrate_size": "api.trials",
    "compare": "api.comparing",
    "demo_map": "api.maps",
    "demo_scan": "api.maps",
    "estimate": "api.estimates",
    "exam_report": "api.reports",
    "export": "api.reports",
    "pool": "api.estimates",
    "read_map": "api.maps",
    "read_scan": "api.maps",
    "record": "api.recording",
    "simulate": "api.maps",
    "validate": "api.trials",
}


def __getattr__(name: str) -> object:
    """Load a name's module when it is first used: `import tactile_bayes` alone loads neither numpy nor scipy."""
    if name == "errors":
        return import_module(f"{__name__}.errors")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
