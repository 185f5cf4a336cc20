"""A short simulated scan as arrays that an engineer holds, with the head in a file beside them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.scans import Scan


@cache
def short_scan() -> Scan:
    """60 frames of 16 x 26 taxels and 36 poses in 0.3 s."""
    return simulate(Scene(duration_s=0.3), rng=np.random.default_rng(0)).scan


def pressures(scan: Scan) -> Any:
    """(n, rows, columns) kPa."""
    calibration = scan.element_calibration
    return scan.frames.counts * calibration.gain_kpa_per_count + calibration.offset_kpa


def head_document(scan: Scan) -> dict[str, Any]:
    """What stands in the HEAD.json of the scan's head."""
    return {
        "schema": "tactile-bayes/head/1",
        "pitch_mm": scan.head.pitch_mm,
        "surface_mm": scan.head.surface_mm.tolist(),
        "scanhead_from_tracker": scan.head.scanhead_from_tracker.tolist(),
    }


def write_head(scan: Scan, path: Path) -> Path:
    """Write the HEAD.json."""
    path.write_text(json.dumps(head_document(scan)))
    return path
