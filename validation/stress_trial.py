"""A simulated trial in which every body breaks one assumption of the calibration's, drawn at random.

    python -m validation stress_trial FOLDER [--seed 20270404] [--bodies 22]

Each body is scanned three times under one of `validation.stress.STRESSES`; its maps are sized alone and pooled, as
`estimate --pool` does. Printed: error and coverage of the pooled sizes and of the single maps' ones, with what the
reports say of the scans. Scans are kept in the folder, and an interrupted run goes on where it stopped.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.pooled import pool_answers
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import Answer
from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.mapping.build import build_map
from tactile_bayes.scans import Scan
from tactile_bayes.studies.population import Population
from validation.common import errors_of, parser, pickled
from validation.stress import BODIES, CONTROL, FRAME_RATE_HZ, STRESSES
from validation.stress_frames import stressed_scan

EXAMS = 3


def scans_of(body: int, seed: int) -> tuple[str, float, list[Scan]]:
    """Stress, diameter and scans of a body."""
    rng = np.random.default_rng([seed, body, 7])
    name = str(rng.choice([one for one in STRESSES if one != CONTROL]))
    drawn, scans, d_mm = int(rng.integers(2**31)), [], 0.0
    for scene in Population(scans=EXAMS, seed=seed, bodies=BODIES).scenes(body):
        # a body's stress lies the same way in all its exams
        slow = replace(scene, frame_rate_hz=FRAME_RATE_HZ)
        changed, physics = STRESSES[name].apply(slow, np.random.default_rng(drawn))
        scans.append(stressed_scan(changed, physics))
        d_mm = changed.solid_lumps[0].d_mm
    return name, d_mm, scans


def sized(true_mm: float, document: dict[str, Any] | None) -> list[tuple[float, float, float, float]]:
    """True size, median and interval of a report; nothing where it has none."""
    size = (document or {}).get("max_size_mm")
    return [(true_mm, size["median"], size["low"], size["high"])] if size else []


def answers_of(scans: list[Scan]) -> list[Answer]:
    """Answer of each scan that can be mapped."""
    found = []
    for scan in scans:
        try:
            found.append(estimate_one(build_map(scan, as_stated=True), Settings()).answer)
        except TactileBayesError as error:
            print(f"    no map: {error}")
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line for each body and the figures."""
    words = parser(__name__, __doc__)
    words.add_argument("folder", type=Path)
    words.add_argument("--seed", type=int, default=20270404)
    words.add_argument("--bodies", type=int, default=22)
    words.add_argument("--make", action="store_true", help="simulate only")
    given = words.parse_args(arguments)
    pooled: list[tuple[float, float, float, float]] = []
    single: list[tuple[float, float, float, float]] = []
    for body in range(given.bodies):
        path = given.folder / f"{given.seed}-{body:03d}.pickle"
        name, d_mm, scans = pickled(path, partial(scans_of, body, given.seed))
        if given.make:
            continue
        answers = answers_of(scans)
        single += [one for answer in answers for one in sized(d_mm, answer.document)]
        names = [f"exam {i + 1}" for i in range(len(answers))]
        whole = pool_answers(answers, Settings(), names=names).document if answers else None
        warned = any(finding.severity == "caution" for one in answers for finding in one.report.findings)
        told = "".join(f"{median:.1f} ({low:.1f} to {high:.1f})" for _, median, low, high in sized(d_mm, whole))
        print(f"{name:20} true {d_mm:5.1f}  {told or 'no size'}{'  CAUTION' if warned else ''}", flush=True)
        pooled += sized(d_mm, whole)
    if pooled:
        print(f"pooled: {errors_of(pooled)}\nsingle maps: {errors_of(single)}")
