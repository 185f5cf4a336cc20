"""How many masses of simulated exams are listed, how many that are not there, and which comes first.

    python -m validation masses make DIR [--kind two --kind one]    # the scans: 4 s of CPU each
    python -m validation masses run DIR [--kind two --kind one]     # map and estimate those not in DIR/masses.jsonl
    python -m validation masses report DIR

Both steps go on where they were interrupted. The exams are those of `masses_scenes`: 100 with two lumps 20 to 40 mm
apart, 200 with one. Every exam goes through `build_map` and `estimate` with their defaults. A listed mass is a lump's
if it lies within 10 mm of its true place (and 2/5 of the lumps' distance); any other is false. `--kind drawn` estimates
150 more maps of one lump, which need no simulation: a round bump under correlated errors, as in `scene_rates`. Of
record 0126 are `--kind near`, `--kind single` and, with a low wide hump beside a `single` lump, `--kind shouldered`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from validation.common import Row, add_row, parser, percent, place_on_map, rows_in
from validation.masses_scenes import KINDS, SEED, Exam, exams, make
from validation.scene_rates import ROWS, draw_map

RESULTS = "masses.jsonl"
DRAWN = 150
DERIVED = ("drawn", "shouldered")
"""Kinds that need no scans of their own."""
SHOULDER_SEED = 20281128
NEAR_MM, NEAR_SHARE = 10.0, 0.4
BINS: dict[str, tuple[Callable[[Row], float], tuple[float, ...]]] = {
    "diameter of the other lump, mm": (lambda row: row["other"]["d_mm"], (7, 10, 14, 24)),
    "depth of its upper side, mm": (lambda row: row["other"]["depth_mm"] - row["other"]["d_mm"] / 2, (0, 4, 8, 12, 30)),
    "distance, mm": (lambda row: row["apart_mm"], (20, 26, 33, 40)),
}


def listed(exam: Exam, tactile_map: TactileMap) -> Row:
    """The masses of an exam's map beside its true lumps, places in mm on the map."""
    found = _answered(tactile_map)
    return {
        "name": exam.name,
        "kind": exam.kind,
        **found,
        "lumps": [
            {"d_mm": lump.d_mm, "depth_mm": lump.depth_mm, "stiffness_ratio": lump.stiffness_ratio, "centre_mm": place}
            for lump, place in zip(exam.scene.solid_lumps, true_places(exam, tactile_map), strict=True)
        ],
    }


def shouldered(exam: Exam, tactile_map: TactileMap) -> TactileMap:
    """The map with a hump of 0.08 to 0.2 and a sigma of 7 to 14 mm, 25 to 36 mm from the lump."""
    (place,) = true_places(exam, tactile_map)
    rng = np.random.default_rng([SHOULDER_SEED, exam.index])
    u, v = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    rng.choice(4)
    rng.uniform(size=4)
    amplitude, width = rng.uniform(0.08, 0.2), rng.uniform(7.0, 11.0)
    away, side = rng.uniform(27.0, 36.0), rng.choice([-1, 1])
    x = place[0] - np.sign(place[0]) * away * np.cos(0.4)
    y = place[1] + side * away * np.sin(0.4) * 0.5
    long = width * rng.uniform(1.0, 1.3)
    hump = amplitude * np.exp(-0.5 * (((u - x) / width) ** 2 + ((v - y) / long) ** 2))
    return replace(tactile_map, mean=tactile_map.mean + hump)


def _answered(tactile_map: TactileMap) -> Row:
    """What an estimate lists on a map."""
    document = estimate_one(tactile_map, Settings()).answer.document
    assert document is not None
    keys = ("reported", "centre_mm", "detected_probability", "max_size_mm", "reason", "reason_code")
    masses = [{name: mass[name] for name in keys} for mass in document["masses"]]
    return {"status": document["status"], "reason": document["reason"], "masses": masses}


def drawn(index: int) -> Row:
    """The masses of a map with one round bump; the lump is where the reported mass is."""
    found = _answered(draw_map(ROWS[0], np.random.default_rng([SEED, index])))
    places = [(mass["centre_mm"]["x"], mass["centre_mm"]["y"]) for mass in found["masses"] if mass["reported"]]
    lumps = [{"d_mm": float("nan"), "centre_mm": place} for place in places]
    return {"name": f"drawn-{index:03d}", "kind": "drawn", "lumps": lumps, **found}


def true_places(exam: Exam, tactile_map: TactileMap) -> list[tuple[float, float]]:
    """True places of an exam's lumps on its map."""
    return [place_on_map(exam.scene, tactile_map, (lump.x_mm, lump.y_mm)) for lump in exam.scene.solid_lumps]


def run(folder: Path, kinds: Sequence[Any]) -> None:
    """Estimate the exams that are not in the results yet."""
    path = folder / RESULTS
    done = {row["name"] for row in rows_in(path)}
    for index in range(DRAWN if "drawn" in kinds else 0):
        if f"drawn-{index:03d}" not in done:
            add_row(path, drawn(index))
    for exam in exams("single") if "shouldered" in kinds else ():
        scan, name = folder / f"{exam.name}.mcap", f"shouldered-{exam.index:03d}"
        if name not in done and scan.exists():
            row = listed(exam, shouldered(exam, build_map(read_scan(scan), as_stated=True)))
            add_row(path, row | {"name": name, "kind": "shouldered"})
    for exam in exams(*(kind for kind in kinds if kind in KINDS)):
        scan = folder / f"{exam.name}.mcap"
        if exam.name not in done and scan.exists():
            add_row(path, listed(exam, build_map(read_scan(scan), as_stated=True)))


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
    """``12 of 100, 12 % (6 to 20)``."""
    return f"{number} of {total}, {percent(number, total)}" if total else "none"


def others(found: Sequence[Row]) -> Iterator[Row]:
    """Exams with two lumps of which one is listed: the other one, and whether it is listed, too."""
    for row in found:
        own, _ = matched(row)
        if row["kind"] not in ("two", "near") or own == [None, None]:
            continue
        first = min((i for i in (0, 1) if own[i] is not None), key=lambda i: own[i])
        other = 1 - first
        apart = float(np.hypot(*np.subtract(row["lumps"][0]["centre_mm"], row["lumps"][1]["centre_mm"])))
        yield row | {"other": row["lumps"][other], "listed": own[other] is not None, "apart_mm": apart}


def report(folder: Path) -> None:
    """Print the shares."""
    found = rows_in(folder / RESULTS)
    two = [row for row in found if row["kind"] in ("two", "near")]
    beside = list(others(found))
    print(f"exams with two lumps: {len(two)}, one of them listed in {len(beside)}")
    both = sum(row["listed"] for row in beside)
    print(f"the other one listed too: {share(both, len(beside))}; of all {share(both, len(two))}")
    for name, (value, edges) in BINS.items():
        for low, high in pairwise(edges):
            these = [row for row in beside if low <= value(row) < high]
            print(f"  {name}, {low:g} to {high:g}: {share(sum(row['listed'] for row in these), len(these))}")
    _sizes(found)
    for kind in (*KINDS, *DERIVED):
        these = [row for row in found if row["kind"] == kind]
        false = [row["name"] for row in these if matched(row)[1]]
        print(f"exams ({kind}) with a mass that is no lump: {share(len(false), len(these))} {', '.join(false)}")
        wrong = [row["name"] for row in these if any(mass["reported"] for mass in matched(row)[1])]
        print(f"  reported: {share(len(wrong), len(these))} {', '.join(wrong)}")


def _sizes(found: Sequence[Row]) -> None:
    """Errors and coverage of the reported mass and of the others, on exams with two lumps, and of single lumps."""
    errors: dict[str, list[tuple[float, bool]]] = {}
    unsized: dict[str, int] = {}
    for row in found:
        own, _ = matched(row)
        for lump, number in zip(row["lumps"], own, strict=True):
            if number is None or row["kind"] == "drawn":
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one step."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["make", "run", "report"])
    words.add_argument("folder", type=Path)
    words.add_argument(
        "--kind", action="append", choices=[*KINDS, *DERIVED], help="of exams; may be repeated (two, one)"
    )
    words.add_argument("--workers", type=int, default=1, help="make: processes (1)")
    given = words.parse_args(arguments)
    kinds = given.kind or ["two", "one"]
    if given.step == "make":
        make(given.folder, *kinds, workers=given.workers)
    elif given.step == "run":
        run(given.folder, kinds)
    else:
        report(given.folder)
