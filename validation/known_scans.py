"""Sizes estimated from scans of known lumps, through the commands a user would type.

    python -m validation known_scans DIRECTORY [--method NAME] [--phantoms | --size-calibration NAME] [--known-seat]

DIRECTORY holds ``phantoms.csv`` and ``scans/`` with ``*.npz`` and ``truth.csv`` (one row a lump). Nothing is tuned to
them: every option has its default, and the calibration is the one that comes with the program. ``--phantoms`` learns
Eq 6 from the table instead; ``--known-seat`` tells `estimate` how the lump sits.
"""

from __future__ import annotations

import csv
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from validation.common import parser, run


def truths(path: Path) -> dict[str, list[float]]:
    """Diameters of each scan's lumps, in mm; an empty list for a scan without a lump."""
    found: dict[str, list[float]] = defaultdict(list)
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            found[row["scan"]] += [float(row["d_mm"])] if row["lump"] else []
    return found


def seats(path: Path) -> dict[str, str]:
    """Seat of each scan's first lump, as `estimate --known seat` takes it: centred 0, resting 1.2."""
    with path.open(encoding="utf-8") as file:
        return {row["scan"]: "1.2" if row["seat"] == "resting" else "0" for row in csv.DictReader(file)}


def estimates(
    data: Path, method: str, *, phantoms: bool, known_seat: bool, calibration: str | None
) -> Iterator[tuple[str, list[float], dict[str, Any]]]:
    """Name, true diameters and JSON estimate of each scan."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        size: tuple[object, ...] = ("--size-calibration", calibration) if calibration else ()
        if phantoms:
            size = ("--size-calibration", work / "size.json")
            run("calibrate", "size", data / "phantoms.csv", "-o", size[1])
        sat = seats(data / "scans" / "truth.csv")
        for name, sizes in truths(data / "scans" / "truth.csv").items():
            scan, tactile_map = work / f"{name}.mcap", work / f"{name}.nc"
            run("import", data / "scans" / f"{name}.npz", "-o", scan)
            run("map", scan, "-o", tactile_map, *(("--normalise", "mean") if phantoms else ()))  # as theirs were
            known = ("--known", "seat", sat[name]) if known_seat else ()
            words = ("estimate", tactile_map, *size, *known, "--method", method, "--json")
            yield name, sizes, json.loads(run(*words, codes=(0, 6)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one row a scan, and the mean absolute error over the scans with a lump."""
    words = parser(__name__, __doc__)
    words.add_argument("data", type=Path)
    words.add_argument("--method", default="importance")
    words.add_argument("--phantoms", action="store_true")
    words.add_argument("--size-calibration")
    words.add_argument("--known-seat", action="store_true")
    given = words.parse_args(arguments)
    print(f"{'scan':28}{'true, mm':>12}{'max size, mm':>14}{'95 % interval':>18}{'error':>8}  covered")
    errors, covered = [], 0
    for name, sizes, found in estimates(
        given.data,
        given.method,
        phantoms=given.phantoms,
        known_seat=given.known_seat,
        calibration=given.size_calibration,
    ):
        true = " and ".join(f"{d:g}" for d in sizes) or "no lump"
        if found["status"] == "no_estimate":
            print(f"{name:28}{true:>12}  no estimate: {found['reason']}")
            continue
        q = found["max_size_mm"]
        error = q["median"] / max(sizes) - 1.0 if sizes else float("nan")
        inside = bool(sizes) and q["low"] <= max(sizes) <= q["high"]
        errors.append(abs(error))
        covered += inside
        interval = f"{q['low']:.1f} to {q['high']:.1f}"
        print(
            f"{name:28}{true:>12}{q['median']:>14.1f}{interval:>18}{100 * error:>+7.0f}%  {'yes' if inside else 'NO'}"
        )
    print(f"mean absolute error {100 * sum(errors) / len(errors):.1f} %, {covered} of {len(errors)} intervals cover")
