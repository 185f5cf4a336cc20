"""Files for the exports: maps of a person and of a phantom with their estimates, and who was examined."""

from __future__ import annotations

from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
from in_process import run_here
from posterior_files import write_calibration
from posterior_maps import bump_map

from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.mapping.map import MapRecipe, TactileMap

PERSON = {"subject": "S01", "side": "left", "posture": "supine", "examiner": "E1", "visit": "2", "mass": "1"}
PHANTOM = {"side": "phantom", "posture": "phantom"}
WHEN = "2026-11-24T10:30"
WHO = (
    *("--patient-id", "P-77", "--patient-name", "Doe^Jane", "--birth-date", "1970-02-03", "--sex", "F"),
    *("--accession", "A123", "--study-date", WHEN),
)


def turned(degrees: float, place_mm: tuple[float, float, float] = (60.0, 90.0, 20.0)) -> np.ndarray:
    """(4, 4) transform to the patient's frame: the plane turned about its normal and 10 degrees about the body."""
    a, b = np.radians(degrees), np.radians(10.0)
    about_normal = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_body = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    transform = np.eye(4)
    transform[:3, :3] = about_body @ about_normal
    transform[:3, 3] = place_mm
    return transform


def scan_map(
    *, patient_from_plane: np.ndarray | None, amplitude: float = 0.3, seed: int = 91, hole: bool = True
) -> TactileMap:
    """A map of 51 by 51 cells as of a scan, with a lump at (1.5, -2) mm and some cells without data."""
    noise = 0.02 * np.random.default_rng(seed).standard_normal((51, 51))
    one = bump_map(noise=noise, amplitude=amplitude, x=1.5, y=-2.0)
    count = one.count.copy()
    if hole:
        count[:3, :4] = 0
    recipe = MapRecipe("scan", "mean", 1.0, (5.0, 14.0))
    return replace(one, count=count, recipe=recipe, plane_from_base=np.eye(4), patient_from_plane=patient_from_plane)


def write_exam(folder: Path) -> None:
    """``map.nc`` of a person, ``empty.nc`` without a lump, ``phantom.nc``, ``bare.nc`` without landmarks.

    ``size.json`` is a calibration, and ``map.json``, ``empty.json`` and ``phantom.json`` are the estimates.
    """
    maps = {
        "map": (scan_map(patient_from_plane=turned(200.0)), PERSON),
        "empty": (scan_map(patient_from_plane=turned(0.0), amplitude=0.0, hole=False), PERSON),
        "phantom": (scan_map(patient_from_plane=turned(0.0), seed=92), PHANTOM),
        "bare": (scan_map(patient_from_plane=None, seed=93), PERSON),
    }
    for name, (one, facts) in maps.items():
        scans = ({"sha256": name[0] * 64, **facts},)
        write_map(folder / f"{name}.nc", one, provenance=Provenance("test", {}, scans=scans))
    write_calibration(folder / "size.json")
    for name in ("map", "empty", "phantom"):
        words = ("--size-calibration", "size.json", "--method", "laplace", "--json")
        posterior = () if name == "empty" else ("-o", f"{name}_post.nc")
        done = run_here("estimate", f"{name}.nc", *words, *posterior, cwd=folder)
        assert done.returncode in (0, 6), done.stderr
        (folder / f"{name}.json").write_text(done.stdout, encoding="utf-8")


def exported(folder: Path, *words: object) -> CompletedProcess[str]:
    """Run ``tactile-bayes export`` and expect it to succeed."""
    done = run_here("export", *words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done
