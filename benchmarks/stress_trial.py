"""A simulated trial in which every body breaks one assumption of the calibration's, drawn at random.

    python -m benchmarks.stress_trial FOLDER [--seed 20270404] [--bodies 22]

Each body is scanned three times under one of `benchmarks.stress.STRESSES`; its maps are sized alone and pooled, as
`estimate --pool` does. Printed: error and coverage of the pooled sizes and of the single maps' ones, with what the
reports say of the scans. Scans are kept in the folder, and an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stress import BODIES, CONTROL, FRAME_RATE_HZ, STRESSES
from benchmarks.stress_frames import stressed_scan
from tactile_bayes.api.estimating import Answer, answer_of, estimate_one
from tactile_bayes.api.pooled import pool_answers
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.mapping.build import build_map
from tactile_bayes.scan import Scan
from tactile_bayes.studies.population import draw_mass

EXAMS = 3


@dataclass(frozen=True, slots=True)
class Sized:
    """A size with its interval; None without one."""

    true_mm: float
    median_mm: float
    low_mm: float
    high_mm: float

    @classmethod
    def of(cls, true_mm: float, document: dict[str, Any] | None) -> Sized | None:
        """The largest size of a report."""
        size = (document or {}).get("max_size_mm")
        return None if not size else cls(true_mm, size["median"], size["low"], size["high"])

    @property
    def covered(self) -> bool:
        """Whether the interval holds the true size."""
        return self.low_mm <= self.true_mm <= self.high_mm


def scans_of(folder: Path, body: int, *, seed: int) -> tuple[str, float, list[Scan]]:
    """Stress, diameter and scans of a body, simulated where they are not kept."""
    path = folder / f"{seed}-{body:03d}.pickle"
    if path.exists():
        kept: tuple[str, float, list[Scan]] = pickle.loads(path.read_bytes())
        return kept
    rng = np.random.default_rng([seed, body, 7])
    name = str(rng.choice([one for one in STRESSES if one != CONTROL]))
    drawn, scans, d_mm = int(rng.integers(2**31)), [], 0.0
    for scene in draw_mass(body, scans=EXAMS, seed=seed, bodies=BODIES):
        # a body's stress lies the same way in all its exams
        slow = replace(scene, frame_rate_hz=FRAME_RATE_HZ)
        changed, physics = STRESSES[name].apply(slow, np.random.default_rng(drawn))
        scans.append(stressed_scan(changed, physics))
        d_mm = changed.solid_lumps[0].d_mm
    partial = path.with_suffix(".part")
    partial.write_bytes(pickle.dumps((name, d_mm, scans)))
    partial.rename(path)
    return name, d_mm, scans


def answers_of(scans: list[Scan]) -> list[Answer]:
    """Answer of each scan that can be mapped."""
    found = []
    for scan in scans:
        try:
            found.append(answer_of(estimate_one(build_map(scan), Settings())))
        except TactileBayesError as error:
            print(f"    no map: {error}")
    return found


def figures(rows: list[Sized]) -> str:
    """Errors, coverage, standardised errors and half widths."""
    true, median = (np.array([getattr(one, name) for one in rows]) for name in ("true_mm", "median_mm"))
    low, high = (np.array([getattr(one, name) for one in rows]) for name in ("low_mm", "high_mm"))
    error = median / true - 1
    standard = np.log(median / true) / (np.log(high / low) / 3.92)
    return (
        f"{len(rows)} sizes, MAE {100 * np.abs(error).mean():.1f} %, bias {100 * error.mean():+.1f} %, "
        f"{sum(one.covered for one in rows)} covered, SD of standardised errors {standard.std():.2f}, "
        f"median half width {100 * np.median((high - low) / 2 / median):.1f} %"
    )


def main() -> None:
    """Print a line for each body and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=20270404)
    parser.add_argument("--bodies", type=int, default=22)
    parser.add_argument("--make", action="store_true", help="simulate only")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    pooled: list[Sized] = []
    single: list[Sized] = []
    for body in range(given.bodies):
        name, d_mm, scans = scans_of(given.folder, body, seed=given.seed)
        if given.make:
            continue
        answers = answers_of(scans)
        single += [found for one in answers if (found := Sized.of(d_mm, one.document)) is not None]
        names = [f"exam {i + 1}" for i in range(len(answers))]
        whole = pool_answers(answers, Settings(), names=names, inputs={}).document if answers else None
        size = Sized.of(d_mm, whole)
        warned = any(finding.severity == "caution" for one in answers for finding in one.findings)
        words = "no size" if size is None else f"{size.median_mm:.1f} ({size.low_mm:.1f} to {size.high_mm:.1f})"
        print(f"{name:20} true {d_mm:5.1f}  {words}{'  CAUTION' if warned else ''}", flush=True)
        pooled += [] if size is None else [size]
    if pooled:
        print(f"pooled: {figures(pooled)}\nsingle maps: {figures(single)}")


if __name__ == "__main__":
    main()
