"""A simulated trial, from scans to the report, with bodies unlike those that the shipped calibration was learned over.

    python -m validation own_trial make DIR [--seed N]    # scans of 24 masses, three exams each, and truth.csv
    python -m validation own_trial run DIR     # map, estimate each map and all (--pool), validate, by the command line

Making it takes 6 to 15 min of CPU. The trials of the seeds 20261121 (default) and 20261122 were looked at while the
program was made; those of 20261205 (record 0068) and 20261123 (docs/accuracy.md) once, when all was fixed; another
seed's was not.

What differs from `forward.population`: seats are centred or resting, seldom between; fat, gland and thickness follow
normal distributions about other means; Poisson's ratio is 0.49; some lumps are spheroids, some bodies hold a second
lump or a rib; the array has dead taxels and more gain error; frames come at 200 Hz. Two bodies hold no lump at all.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.forward.scene import Background, Noise, Scene, Strokes, Taxels, Tracker
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from validation.common import errors_of, keep_scan, parser, program, run

MASSES, EMPTY, EXAMS, SEED = 22, 2, 3, 20261121
Size = tuple[float, float, float, float]
"""True size, median and interval, mm."""


@dataclass(frozen=True, slots=True)
class Mass:
    """One body with what lies in it, and its exams."""

    name: str
    scenes: tuple[Scene, ...]
    note: str

    @property
    def lump(self) -> SolidLump | None:
        """The mass that is sized; None in an empty body."""
        lumps = self.scenes[0].solid_lumps
        return lumps[0] if lumps else None


def draw_trial(seed: int = SEED) -> list[Mass]:
    """The masses of the trial; nothing in it was chosen after seeing an estimate."""
    return [_draw(i, np.random.default_rng([seed, i])) for i in range(MASSES + EMPTY)]


def draw_mass_like_trial(index: int, *, seed: int) -> list[Scene]:
    """The exams of one more mass of this kind, never an empty body."""
    return list(_draw(index % MASSES, np.random.default_rng([seed, index])).scenes)


def _draw(index: int, rng: np.random.Generator) -> Mass:
    d = float(np.clip(rng.lognormal(np.log(14.0), 0.35), 6.0, 28.0))
    ratio = float(rng.triangular(0.6, 0.85, 1.6))
    seat = float(rng.choice([0.0, 1.2, rng.uniform(0.0, 1.2)], p=[0.4, 0.4, 0.2]))
    height = d * float(rng.uniform(0.75, 1.0)) if rng.uniform() < 0.3 else None
    stiffness = float(rng.choice([8.0, 15.0, 30.0, 100.0]))
    half = (height or d) / 2
    fat = ratio * d + seat * half
    thickness = max(float(rng.normal(60.0, 12.0)), fat + 6.0, ratio * d + half + 6.0)
    body = SceneBody(
        fat_kpa=float(np.clip(rng.normal(5.5, 1.0), 3.0, 9.0)),
        gland_ratio=float(np.clip(rng.normal(9.0, 2.5), 4.0, 18.0)),
        thickness_mm=thickness,
        nu=0.49,
        fat_mm=fat,
    )
    lump = SolidLump(d_mm=d, depth_ratio=ratio, stiffness_ratio=stiffness, height_mm=height)
    lumps, note = [lump], "spheroid" if height else ""
    if index >= MASSES:
        lumps, note = [], "no mass"
    elif rng.uniform() < 0.15:
        # a second lump at the same depth, a rib's edge in effect
        lumps.append(replace(lump, d_mm=0.7 * d, depth_ratio=ratio / 0.7, y_mm=1.2 * d + 14.0, height_mm=None))
        note = "second lump"
    scenes = tuple(_exam(body, lumps, rng) for _ in range(EXAMS))
    return Mass(f"m{index + 1:02d}", scenes, note)


def _exam(body: SceneBody, lumps: list[SolidLump], rng: np.random.Generator) -> Scene:
    shift = rng.normal(0.0, 3.0, 2)
    turn = rng.uniform(0, 2 * np.pi)  # where the second lump lies about the first
    placed = []
    for lump in lumps:
        x, y = lump.y_mm * np.cos(turn), lump.y_mm * np.sin(turn)
        placed.append(replace(lump, x_mm=float(shift[0] + x), y_mm=float(shift[1] + y)))
    dead = tuple((int(rng.integers(16)), int(rng.integers(26))) for _ in range(int(rng.integers(0, 4))))
    return Scene(
        seed=int(rng.integers(1 << 30)),
        duration_s=float(rng.uniform(6.0, 9.0)),
        body=body,
        solid_lumps=tuple(placed),
        background=Background(mean_kpa=float(rng.normal(9.5, 1.0)), drift_kpa=float(rng.uniform(0.3, 2.0))),
        strokes=Strokes(
            lines=int(rng.integers(5, 8)),
            spacing_mm=float(rng.uniform(4.5, 6.5)),
            wander_mm=float(rng.uniform(0.3, 2.0)),
            tilt_deg=float(rng.uniform(1.0, 5.0)),
            yaw_deg=float(rng.normal(0.0, 12.0)),
        ),
        noise=Noise(element_kpa=0.25, tracker_mm=float(rng.uniform(0.2, 0.7)), gain_spread=0.05, gain_share=0.025),
        tracker=Tracker(latency_ms=float(rng.uniform(2.0, 14.0))),
        taxels=Taxels(dead=tuple(set(dead))),
    )


def make(folder: Path, workers: int, seed: int) -> None:
    """Write the scans and the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    trial = draw_trial(seed)
    with (folder / "truth.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["mass", "d_mm", "height_mm", "depth_ratio", "stiffness_ratio", "fat_mm", "note"])
        for mass in trial:
            lump, body = mass.lump, mass.scenes[0].body
            what = ["", "", "", ""] if lump is None else [
                lump.d_mm, lump.vertical_mm, lump.depth_ratio, lump.stiffness_ratio
            ]  # fmt: skip
            writer.writerow([mass.name, *what, body.fat_mm if body else "", mass.note])
    with ProcessPoolExecutor(workers) as pool:
        paths, scenes = zip(
            *[(folder / f"{mass.name}-{i + 1}.mcap", scene) for mass in trial for i, scene in enumerate(mass.scenes)],
            strict=True,
        )
        for done in pool.map(keep_scan, paths, scenes):
            print(done, flush=True)


def run_trial(folder: Path, options: list[str]) -> None:
    """Size every mass by the command line and print the trial's report."""
    truth = {row["mass"]: row for row in csv.DictReader((folder / "truth.csv").open())}
    rows, false_sizes = [], 0
    sizes: dict[str, list[Size]] = {}
    for name, what in truth.items():
        maps = []
        for i in range(EXAMS):
            path = folder / f"{name}-{i + 1}.nc"
            if program("map", path.with_suffix(".mcap"), "-o", path, "--force").returncode == 0:
                maps.append(path)
        told = run("estimate", *maps, "--pool", "--json", *options, codes=(0, 6))
        document = json.loads(told)
        (folder / f"{name}.json").write_text(told)
        size = document["max_size_mm"]
        if not what["d_mm"]:
            false_sizes += size is not None
            print(f"{name} no mass: {document['status']}")
            continue
        true = max(float(what["d_mm"]), float(what["height_mm"]))
        rows.append((name, true, size, what["note"], document["reason"]))
        alone = [json.loads(run("estimate", one, "--json", *options, codes=(0, 6))) for one in maps]
        for label, answers in (("pooled", [document]), ("each map alone", alone)):
            _add_sizes(sizes, label, true, answers)
    _report(rows, false_sizes, folder)
    for label, found in sizes.items():
        print(f"{label}: {errors_of(found)}")


def _add_sizes(sizes: dict[str, list[Size]], label: str, true: float, answers: Sequence[dict[str, Any]]) -> None:
    """Add the sizes of answers with both of their intervals, where they have them."""
    for one in answers:
        another = (one.get("another_exam") or {}).get("max_size_mm")
        for name, size in ((label, one["max_size_mm"]), (f"{label}, if exams differ more", another)):
            if size:
                sizes.setdefault(name, []).append((true, size["median"], size["low"], size["high"]))


def _report(rows: list[tuple[str, float, dict[str, float] | None, str, str]], false_sizes: int, folder: Path) -> None:
    sized = []
    for name, true, size, note, reason in rows:
        if size is None:
            print(f"{name} true {true:5.1f}  no estimate: {reason} {note}")
            continue
        low, median, high = (size[one] for one in ("low", "median", "high"))
        sized.append((true, median, low, high))
        outside = "" if low <= true <= high else "OUTSIDE"
        print(
            f"{name} true {true:5.1f}  {median:5.1f} ({low:.1f} to {high:.1f}) {100 * (median / true - 1):+5.1f} % "
            f"{outside} {note}"
        )
    print(f"{len(rows)} masses: {errors_of(sized)}; sizes given to {EMPTY} empty bodies: {false_sizes}")
    with (folder / "trial.csv").open("w", newline="") as trial, (folder / "excision.csv").open("w", newline="") as cut:
        readings, excisions = csv.writer(trial), csv.writer(cut)
        readings.writerow(["patient", "mass", "modality", "replicate", "status", "posterior", "size_mm", "synthetic"])
        excisions.writerow(["patient", "mass", "ex_vivo_mm", "synthetic"])
        for name, true, size, *_ in rows:
            found = ["not_detected", ""] if size is None else ["detected", f"{name}.json"]
            readings.writerow([name, name, "tactile", 1, *found, "", "true"])
            excisions.writerow([name, name, f"{true:.3f}", "true"])
    print(run("validate", folder / "trial.csv", "--excision", folder / "excision.csv"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the trial, or run it with more options of `estimate`."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["make", "run"])
    words.add_argument("folder", type=Path)
    words.add_argument("--workers", type=int, default=1)
    words.add_argument("--seed", type=int, default=SEED, help="make: of another trial")
    given, more = words.parse_known_args(arguments)
    if given.step == "make":
        make(given.folder, given.workers, given.seed)
    else:
        run_trial(given.folder, more)
