"""Exams of bodies with several lumps, one or none, as scans: what `masses` and `exam_time` measure.

Two lumps of different size, stiffness and depth, 20 to 40 mm apart in any direction, lie in one body and are stroked in
one exam; the solid model sums what they do. Single lumps are those of the population that calibrations are learned
over, of another seed. Nothing was chosen after seeing an estimate.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import Rib, SceneBody, SolidLump
from tactile_bayes.studies.population import BodyPrior, ExamPrior, Population, draw_body, draw_exam
from validation.common import keep_scan

Kind = Literal["two", "one", "empty", "faint", "ribbed", "near", "single"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
NUMBER: Final[dict[Kind, int]] = {
    "two": 100,
    "one": 200,
    "empty": 12,
    "faint": 12,
    "ribbed": 12,
    "near": 100,
    "single": 100,
}
"""Exams of each kind."""
SEED: Final = 20261124
JUDGED: Final[dict[Kind, int]] = {"single": 1, "near": 2}
"""Kinds of record 0126, of another seed, with their numbers in it: looked at once, when its rules were fixed."""
JUDGED_SEED: Final = 20281126
APART_MM: Final = (20.0, 40.0)
LEAST_GAP_MM: Final = 4.0
"""Tissue between the two lumps, at least."""
SECOND_MM, SECOND_DEPTH_MM = (7.0, 20.0), (6.0, 20.0)
_FIRST: Final = BodyPrior(d_mm=(8.0, 24.0), depth_ratio=(0.56, 1.4))
_FAINT: Final = BodyPrior(d_mm=(8.0, 16.0), depth_ratio=(1.4, 1.8), stiffness_ratio=(8.0, 20.0))
_EXAM: Final = ExamPrior()
_WIDE: Final = ExamPrior(lines=(6, 8), spacing_mm=(5.0, 6.5), half_length_mm=(34.0, 40.0))
"""Strokes over the whole of two lumps."""


@dataclass(frozen=True, slots=True)
class Exam:
    """One exam: its kind and number, and its scene."""

    kind: Kind
    index: int
    scene: Scene

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.kind}-{self.index:03d}"


def draw(kind: Kind, index: int) -> Exam:
    """The exam of a kind and number."""
    if kind == "one":
        return Exam(kind, index, Population(scans=1, seed=SEED).scenes(index)[0])
    rng = np.random.default_rng([SEED, KINDS.index(kind), index])
    if kind in JUDGED:
        rng = np.random.default_rng([JUDGED_SEED, JUDGED[kind], index])
    body, lumps, ribs = _DRAWN[kind](rng, index)
    wide = kind == "two" or (kind == "single" and rng.uniform() < 0.5)
    scene = draw_exam(_WIDE if wide else _EXAM, rng)
    if kind in JUDGED:
        scene = replace(scene, frame_rate_hz=50.0)
    shift = rng.uniform(*_EXAM.off_centre_mm, size=2)
    moved = tuple(replace(one, x_mm=one.x_mm + shift[0], y_mm=one.y_mm + shift[1]) for one in lumps)
    seed = int(rng.integers(1 << 30))
    return Exam(kind, index, replace(scene, seed=seed, body=body, solid_lumps=moved, ribs=ribs))


Drawn = tuple[SceneBody, tuple[SolidLump, ...], tuple[Rib, ...]]


def _two(rng: np.random.Generator, index: int) -> Drawn:
    del index
    body, first = draw_body(_FIRST, rng)
    d = float(np.exp(rng.uniform(*np.log(SECOND_MM))))
    depth = max(float(rng.uniform(*SECOND_DEPTH_MM)), 0.56 * d)
    second = SolidLump(d_mm=d, depth_ratio=depth / d, stiffness_ratio=float(np.exp(rng.uniform(*np.log([8.0, 100.0])))))
    least = (first.d_mm + d) / 2 + LEAST_GAP_MM
    away, turn = rng.uniform(max(APART_MM[0], least), APART_MM[1]), rng.uniform(0.0, 2 * np.pi)
    return _pair(body, first, second, away=away, turn=turn)


def _pair(body: SceneBody, first: SolidLump, second: SolidLump, *, away: float, turn: float) -> Drawn:
    """Two lumps so far apart, mm, on either side of the middle; the body is thick enough for the second."""
    fat = first.depth_mm + (first.seat or 0.0) * first.vertical_mm / 2
    thickness = max(body.thickness_mm, second.depth_mm + 0.6 * second.d_mm + 4.0)
    x, y = away / 2 * np.cos(turn), away / 2 * np.sin(turn)
    pair = replace(first, seat=None, x_mm=-x, y_mm=-y), replace(second, x_mm=x, y_mm=y)
    return replace(body, fat_mm=fat, thickness_mm=thickness), pair, ()


def _near(rng: np.random.Generator, index: int) -> Drawn:
    """Two lumps 16 to 40 mm apart, about as deep, the second 55 to 100 % as large."""
    del index
    body, first = draw_body(BodyPrior(d_mm=(8.0, 24.0), depth_ratio=(0.6, 1.5), stiffness_ratio=(8.0, 100.0)), rng)
    d = rng.uniform(0.55, 1.0) * first.d_mm
    depth = float(np.clip(rng.uniform(0.7, 1.3) * first.depth_mm, 0.56 * d, 1.7 * d))
    least = max(16.0, (first.d_mm + d) / 2 + 1.0)
    away, turn = rng.uniform(least, max(40.0, least)), rng.uniform(0.0, 2 * np.pi)
    alike = rng.uniform() < 0.5
    stiffness = first.stiffness_ratio if alike else float(np.exp(rng.uniform(*np.log([8.0, 100.0]))))
    second = SolidLump(d_mm=d, depth_ratio=depth / d, stiffness_ratio=stiffness)
    return _pair(body, first, second, away=away, turn=turn)


def _single(rng: np.random.Generator, index: int) -> Drawn:
    del index
    body, lump = draw_body(BodyPrior(d_mm=(9.0, 22.0), depth_ratio=(0.6, 1.3), stiffness_ratio=(8.0, 100.0)), rng)
    return body, (lump,), ()


def _empty(rng: np.random.Generator, index: int) -> Drawn:
    del index
    body, first = draw_body(BodyPrior(), rng)
    return replace(body, fat_mm=first.depth_mm), (), ()


def _faint(rng: np.random.Generator, index: int) -> Drawn:
    del index
    body, lump = draw_body(_FAINT, rng)
    return body, (lump,), ()


def _ribbed(rng: np.random.Generator, index: int) -> Drawn:
    """A rib along the head's x, with a lump beside it in every other exam."""
    body, lump = draw_body(_FIRST, rng)
    fat = lump.depth_mm + (lump.seat or 0.0) * lump.vertical_mm / 2
    ribs = (Rib(y_mm=float(rng.choice([-1.0, 1.0]) * rng.uniform(20.0, 28.0)), depth_mm=float(rng.uniform(9.0, 15.0))),)
    body = replace(body, fat_mm=fat, thickness_mm=max(body.thickness_mm, 30.0))
    return body, (replace(lump, seat=None),) if index % 2 else (), ribs


_DRAWN: Final = {"two": _two, "empty": _empty, "faint": _faint, "ribbed": _ribbed, "near": _near, "single": _single}


def exams(*kinds: Kind, most: int | None = None) -> Iterator[Exam]:
    """The exams of some kinds, at most so many of each."""
    for kind in kinds:
        for index in range(NUMBER[kind] if most is None else min(most, NUMBER[kind])):
            yield draw(kind, index)


def make(folder: Path, *kinds: Kind, workers: int = 1) -> None:
    """Write the scans that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn = list(exams(*kinds))
    paths = [folder / f"{exam.name}.mcap" for exam in drawn]
    with ProcessPoolExecutor(workers) as pool:
        for done in pool.map(keep_scan, paths, [exam.scene for exam in drawn]):
            print(done, flush=True)
