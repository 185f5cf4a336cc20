"""How many masses of simulated exams are listed, how many that are not there, and which comes first.

    python -m benchmarks.masses make DIR [--kind two --kind one]    # the scans: 4 s of CPU each
    python -m benchmarks.masses run DIR [--kind two --kind one]     # map and estimate those not in DIR/masses.jsonl
    python -m benchmarks.masses report DIR

Both steps go on where they were interrupted. The exams are those of `masses_scenes`: 100 with two lumps 20 to 40 mm
apart, 200 with one. Every exam goes through `build_map` and `estimate` with their defaults. A listed mass is a lump's
if it lies within 10 mm of its true place (and 2/5 of the lumps' distance); any other is false.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.masses_scenes import KINDS, Exam, exams, make
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.geometry import apply
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.pipeline.one_map import answer_of, estimate_one
from tactile_bayes.pipeline.settings import Settings

RESULTS = "masses.jsonl"
NEAR_MM, NEAR_SHARE = 10.0, 0.4
Row = dict[str, Any]
BINS: dict[str, tuple[Callable[[Row], float], tuple[float, ...]]] = {
    "diameter of the other lump, mm": (lambda row: row["other"]["d_mm"], (7, 10, 14, 24)),
    "depth of its upper side, mm": (lambda row: row["other"]["depth_mm"] - row["other"]["d_mm"] / 2, (0, 4, 8, 12, 30)),
    "distance, mm": (lambda row: row["apart_mm"], (20, 26, 33, 40)),
}


def listed(exam: Exam, tactile_map: TactileMap) -> Row:
    """The masses of an exam's map beside its true lumps, places in mm on the map."""
    document = answer_of(estimate_one(tactile_map, Settings())).document
    assert document is not None
    keys = ("reported", "centre_mm", "detected_probability", "max_size_mm", "reason", "reason_code")
    return {
        "name": exam.name,
        "kind": exam.kind,
        "status": document["status"],
        "reason": document["reason"],
        "lumps": [
            {"d_mm": lump.d_mm, "depth_mm": lump.depth_mm, "stiffness_ratio": lump.stiffness_ratio, "centre_mm": place}
            for lump, place in zip(exam.scene.solid_lumps, true_places(exam, tactile_map), strict=True)
        ],
        "masses": [{name: mass[name] for name in keys} for mass in document["masses"]],
    }


def true_places(exam: Exam, tactile_map: TactileMap) -> list[tuple[float, float]]:
    """True places of an exam's lumps on its map, by the landmarks."""
    if tactile_map.patient_from_plane is None:
        raise ValueError(f"{exam.name} has no landmarks")
    xiphoid, found = exam.scene.landmarks.xiphoid_mm, []
    plane_from_patient = np.linalg.inv(tactile_map.patient_from_plane)
    depth = float(apply(tactile_map.patient_from_plane, np.zeros(3))[2])
    for lump in exam.scene.solid_lumps:
        place = np.array([lump.x_mm - xiphoid[0], lump.y_mm - xiphoid[1], depth])
        x, y, _ = apply(plane_from_patient, place)
        found.append((float(x), float(y)))
    return found


def run(folder: Path, kinds: Sequence[Any]) -> None:
    """Estimate the exams that are not in the results yet."""
    path = folder / RESULTS
    done = {row["name"] for row in rows(folder)}
    with path.open("a") as file:
        for exam in exams(*kinds):
            scan = folder / f"{exam.name}.mcap"
            if exam.name in done or not scan.exists():
                continue
            file.write(json.dumps(listed(exam, build_map(read_scan(scan)))) + "\n")
            file.flush()


def rows(folder: Path) -> list[Row]:
    """The results so far."""
    path = folder / RESULTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def matched(row: Row) -> tuple[list[int | None], list[Row]]:
    """For each true lump the number of its mass, from 0, or None; and the masses that are nobody's."""
    places = np.array([lump["centre_mm"] for lump in row["lumps"]]).reshape(-1, 2)
    near = NEAR_MM if len(places) < 2 else min(NEAR_MM, NEAR_SHARE * float(np.hypot(*(places[0] - places[1]))))
    own: list[int | None] = [None] * len(places)
    false = []
    for number, mass in enumerate(row["masses"]):
        at = np.array([mass["centre_mm"]["x"], mass["centre_mm"]["y"]])
        away = np.hypot(*(places - at).T) if len(places) else np.array([])
        lump = int(np.argmin(away)) if len(away) and away.min() <= near else None
        if lump is None or own[lump] is not None:
            false.append(mass)
        else:
            own[lump] = number
    return own, false


def share(number: int, total: int) -> str:
    """Per cent, with the exact (Clopper-Pearson) interval of 95 %."""
    if not total:
        return "none"
    interval = binomtest(number, total).proportion_ci()
    return f"{number} of {total}, {100 * number / total:.0f} % ({100 * interval.low:.0f} to {100 * interval.high:.0f})"


def others(found: Sequence[Row]) -> Iterator[Row]:
    """Exams with two lumps of which one is listed: the other one, and whether it is listed, too."""
    for row in found:
        own, _ = matched(row)
        if row["kind"] != "two" or own == [None, None]:
            continue
        first = min((i for i in (0, 1) if own[i] is not None), key=lambda i: own[i])
        other = 1 - first
        apart = float(np.hypot(*np.subtract(row["lumps"][0]["centre_mm"], row["lumps"][1]["centre_mm"])))
        yield row | {"other": row["lumps"][other], "listed": own[other] is not None, "apart_mm": apart}


def report(folder: Path) -> None:
    """Print the shares."""
    found = rows(folder)
    two = [row for row in found if row["kind"] == "two"]
    beside = list(others(found))
    print(f"exams with two lumps: {len(two)}, one of them listed in {len(beside)}")
    print(f"the other one listed too: {share(sum(row['listed'] for row in beside), len(beside))}")
    for name, (value, edges) in BINS.items():
        for low, high in pairwise(edges):
            these = [row for row in beside if low <= value(row) < high]
            print(f"  {name}, {low:g} to {high:g}: {share(sum(row['listed'] for row in these), len(these))}")
    _first(two)
    _sizes(found)
    for kind in KINDS:
        these = [row for row in found if row["kind"] == kind]
        false = [row["name"] for row in these if matched(row)[1]]
        print(f"exams ({kind}) with a mass that is no lump: {share(len(false), len(these))} {', '.join(false)}")


def _first(two: Sequence[Row]) -> None:
    """Where both are sized: how often the truly larger one stands first."""
    right, total = 0, 0
    for row in two:
        own, _ = matched(row)
        if None in own or any(row["masses"][i]["max_size_mm"] is None for i in own):
            continue
        total += 1
        right += own[0 if row["lumps"][0]["d_mm"] > row["lumps"][1]["d_mm"] else 1] == 0
    print(f"both sized, and the larger one first: {share(right, total)}")


def _sizes(found: Sequence[Row]) -> None:
    """Errors and coverage of the reported mass and of the others, on exams with two lumps, and of single lumps."""
    errors: dict[str, list[tuple[float, bool]]] = {}
    unsized: dict[str, int] = {}
    for row in found:
        own, _ = matched(row)
        for lump, number in zip(row["lumps"], own, strict=True):
            if number is None:
                continue
            mass = row["masses"][number]
            which = f"{row['kind']}: {'reported' if mass['reported'] else 'other'}"
            size = mass["max_size_mm"]
            if size is None:
                unsized[which] = unsized.get(which, 0) + 1
                continue
            covers = size["low"] <= lump["d_mm"] <= size["high"]
            errors.setdefault(which, []).append((size["median"] / lump["d_mm"] - 1.0, covers))
    for which, these in sorted(errors.items()):
        error = np.array([one for one, _ in these])
        print(
            f"sizes ({which}): {len(these)}, and {unsized.get(which, 0)} listed without one; mean absolute error "
            f"{100 * np.abs(error).mean():.1f} %, bias {100 * error.mean():+.1f} %; 95 % intervals cover "
            f"{share(sum(inside for _, inside in these), len(these))}"
        )


def main() -> None:
    """Run one step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["make", "run", "report"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", action="append", choices=KINDS, help="of exams; may be repeated (two, one)")
    parser.add_argument("--workers", type=int, default=1, help="make: processes (1)")
    given = parser.parse_args()
    kinds = given.kind or ["two", "one"]
    if given.step == "make":
        make(given.folder, *kinds, workers=given.workers)
    elif given.step == "run":
        run(given.folder, kinds)
    else:
        report(given.folder)


if __name__ == "__main__":
    main()
