"""Probability of a lump: learned and judged on simulated exams with and without one.

    python -m validation lump_probability make DIR [--judge]     # 160 exams, or 146 others; 1.3 s of CPU each
    python -m validation lump_probability learn DIR              # COEFFICIENTS of posterior/verdict.py
    python -m validation lump_probability report DIR... [--figure reliability.png]

A rise counts as a lump where its centre lies within 10 mm of the true lump's. `learn` fits a logistic regression with a
ridge penalty to the rise that the program weighs on each map; `report` estimates the maps by the present program and
compares what it says with the truth. It also takes the pairs of maps of `smallest_lump`, with a lump and without it.
"""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.errors import NO_LUMP
from tactile_bayes.forward.scene import Scene
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.result import Estimate
from validation.common import exact, parser, percent, pickled, place_on_map
from validation.lump_probability_scenes import JUDGE_SEED, LEARN_SEED, Exam, draw

LEARN, JUDGE = 160, 146
NEAR_MM = 10.0
PENALTY = 0.05
EDGES = (0.0, 0.0501, 0.2, 0.5, 0.95, 1.0)
"""The first bin holds the least that is said, which is nearly all that says so little."""


@dataclass(frozen=True, slots=True)
class Row:
    """An exam with its answer; `is_lump` says whether the weighed rise is a lump (None without one)."""

    kind: str
    lump: bool
    estimate: Estimate
    is_lump: bool | None

    @property
    def sized(self) -> bool:
        """Whether it has a size."""
        return self.estimate.size is not None


def make(folder: Path, *, judge: bool) -> None:
    """Simulate and map what is missing."""
    for index in range(JUDGE if judge else LEARN):
        exam = draw(index, seed=JUDGE_SEED if judge else LEARN_SEED)
        pickled(folder / f"{index:04d}.pickle", partial(_with_map, exam))


def _with_map(exam: Exam) -> tuple[Exam, TactileMap]:
    return exam, build_map(exam.scan(), as_stated=True)


def rows(folder: Path) -> Iterator[Row]:
    """The exams of a folder, of this module or of `smallest_lump`, estimated by the present program."""
    for path in sorted(folder.glob("*.pickle")):
        kept = pickle.loads(path.read_bytes())
        if isinstance(kept, dict):
            lump = kept["scene"].solid_lumps[0]
            yield _row("no lump of a pair", kept["scene"], kept["empty"], None)
            yield _row("lump of a pair", kept["scene"], kept["map"], (lump.x_mm, lump.y_mm))
        else:
            exam, tactile_map = kept
            yield _row(exam.kind, exam.scene, tactile_map, exam.lump_mm)


def _row(kind: str, scene: Scene, tactile_map: TactileMap, lump_mm: tuple[float, float] | None) -> Row:
    estimate = estimate_one(tactile_map, Settings()).estimate
    weighed, is_lump = estimate.weighed, None
    if weighed is not None:
        true = None if lump_mm is None else place_on_map(scene, tactile_map, lump_mm)
        is_lump = true is not None and bool(np.hypot(*np.subtract(weighed.centre_mm, true)) < NEAR_MM)
    return Row(kind, lump_mm is not None, estimate, is_lump)


def learn(found: list[Row]) -> Iterator[str]:
    """Coefficients of the logistic regression."""
    weighed = [(one.estimate.weighed.features, one.is_lump) for one in found if one.estimate.weighed is not None]
    features = np.array([np.append(1.0, one) for one, _ in weighed])
    is_lump = np.array([lump for _, lump in weighed], dtype=float)

    def loss(b: FloatArray) -> float:
        score = features @ b
        return float(np.sum(np.logaddexp(0.0, score) - is_lump * score) + PENALTY / 2 * b[1:] @ b[1:])

    best = minimize(loss, np.zeros(features.shape[1])).x
    yield f"{len(weighed)} weighed rises, {is_lump.sum():.0f} of them lumps"
    yield f"COEFFICIENTS {best.round(2).tolist()}"


def report(found: list[Row]) -> Iterator[str]:
    """Verdicts by kind, and what was said against what was so."""
    for kind, number in sorted(Counter(one.kind for one in found).items()):
        codes = Counter(one.estimate.code or "sized" for one in found if one.kind == kind)
        yield f"{kind} ({number}): {', '.join(f'{code} {n}' for code, n in sorted(codes.items()))}"
    for what, own in (
        ("with", [one for one in found if one.lump]),
        ("without", [one for one in found if not one.lump]),
    ):
        yield f"sized {what} a lump: {sum(one.sized for one in own)} of {len(own)}"
    probability, is_lump = stated(found)
    yield f"maps without a weighed rise: {len(found) - len(is_lump)}"
    yield f"Brier score of {len(is_lump)} rises: {np.mean((probability - is_lump) ** 2):.4f}"
    for low, high, mean, number, true in bins(probability, is_lump):
        yield f"{low:g} to {high:g}: {number} rises, said {mean:.3f}, {true} lumps, {percent(true, number)}"
    beside = [one.estimate.probability for one in found if one.estimate.code in NO_LUMP]
    yield f"highest beside 'no lump found': {max((one for one in beside if one is not None), default=0.0):.3f}"
    sized = [one.estimate.probability or 0.0 for one in found if one.sized]
    yield f"lowest beside a size: {min(sized, default=1.0):.3f}"


def stated(found: list[Row]) -> tuple[FloatArray, FloatArray]:
    """Probability of each weighed rise, and whether it is a lump."""
    pairs = [(one.estimate.probability, one.is_lump) for one in found if one.is_lump is not None]
    return np.array([p for p, _ in pairs], dtype=float), np.array([lump for _, lump in pairs], dtype=float)


def bins(probability: FloatArray, is_lump: FloatArray) -> Iterator[tuple[float, float, float, int, int]]:
    """Ends, mean, number and lumps of each bin that holds a rise."""
    for i, (low, high) in enumerate(pairwise(EDGES)):
        these = (probability >= low) & ((probability < high) | (i == len(EDGES) - 2))
        if these.any():
            yield low, high, float(probability[these].mean()), int(these.sum()), int(is_lump[these].sum())


def figure(found: list[Row], path: Path) -> None:
    """Reliability diagram: share of lumps by what was said, with exact 95 % intervals, and how often it was said."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(5.2, 5.2), layout="constrained")
    axes = drawn.subplots()
    axes.plot([0, 1], [0, 1], color="0.6", lw=1)
    for i, (_, _, mean, number, lumps) in enumerate(bins(*stated(found))):
        axes.plot([mean, mean], exact(lumps, number), color="C0", lw=1.5)
        axes.plot(mean, lumps / number, "o", color="C0")
        at = (7, -4 - 14 * (i % 2))
        axes.annotate(f"{lumps} of {number}", (mean, lumps / number), xytext=at, textcoords="offset points")
    axes.set(xlim=(-0.03, 1.16), ylim=(-0.03, 1.03))
    axes.set(xlabel="probability of a lump, as printed", ylabel="share that are lumps")
    axes.set_title(f"{len(found)} simulated exams, half with a lump", fontsize=10)
    drawn.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one step."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["make", "learn", "report"])
    words.add_argument("folders", type=Path, nargs="+")
    words.add_argument("--judge", action="store_true", help="make: the 146 exams that judge")
    words.add_argument("--figure", type=Path)
    given = words.parse_args(arguments)
    if given.step == "make":
        make(given.folders[0], judge=given.judge)
        return
    found = [row for folder in given.folders for row in rows(folder)]
    print("\n".join(learn(found) if given.step == "learn" else report(found)))
    if given.figure is not None:
        figure(found, given.figure)
