"""Exams of bodies with and without a lump: what the probability of a lump is learned and judged on.

Half of the exams hold a lump, from clear to invisible. Twenty exams make a round, by `ROUND`: a lump under the middle
of the strokes, at their end, under uneven fat or beside a rib; or nothing but even layers, fat or a chest wall of
uneven depth, convex skin, or ribs. Nothing was chosen after seeing an answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import Rib, fat_thickness
from tactile_bayes.scans import Scan
from tactile_bayes.studies.population import BodyPrior, ExamPrior, draw_body, draw_exam
from validation.stress import STRESSES
from validation.stress_frames import stressed_scan

LEARN_SEED, JUDGE_SEED = 20261126, 20261127
BODIES: Final = BodyPrior(d_mm=(5.0, 25.0), depth_ratio=(0.56, 2.4))
ROUND: Final = (
    *("lump",) * 7, *("lump at the rim",) * 2, "lump under uneven fat",
    *("nothing",) * 5, *("uneven fat",) * 2, "uneven wall", "convex skin", "rib",
)  # fmt: skip
RIBBED_EVERY: Final = 2
"""Every so many rounds one lump lies beside a rib."""
UNEVEN: Final = ("wedge 0.05", "wedge 0.1", "wedge 0.2", "step 3", "step 6")
AT_RIM_MM: Final = (16.0, 34.0)
"""How far from the middle of the strokes a lump at the rim lies."""
FRAME_RATE_HZ, RIB_RATE_HZ = 50.0, 20.0
"""For time: ribs are rows of balls, each solved for in every frame."""


@dataclass(frozen=True, slots=True)
class Exam:
    """One exam: its kind, its scene, and where its lump lies in the scene's `plane` (None without one)."""

    index: int
    kind: str
    scene: Scene
    stress: str = ""

    @property
    def lump_mm(self) -> tuple[float, float] | None:
        """Place of the lump."""
        if not self.kind.startswith("lump"):
            return None
        lump = self.scene.solid_lumps[0]
        return lump.x_mm, lump.y_mm

    def scan(self) -> Scan:
        """Its frames and poses."""
        if self.stress:
            _, physics = STRESSES[self.stress].apply(self.scene, np.random.default_rng(self.scene.seed))
            return stressed_scan(self.scene, physics, empty=self.lump_mm is None)
        return simulate(self.scene, rng=np.random.default_rng(self.scene.seed)).scan


def draw(index: int, *, seed: int) -> Exam:
    """The exam of a number."""
    rng = np.random.default_rng([seed, index])
    turn, place = divmod(index, len(ROUND))
    kind = ROUND[place]
    if kind == "lump" and place == 0 and turn % RIBBED_EVERY == 0:
        kind = "lump beside a rib"
    body, lump = draw_body(BODIES, rng)
    scene = replace(draw_exam(ExamPrior(), rng), frame_rate_hz=FRAME_RATE_HZ, seed=int(rng.integers(1 << 30)))
    shift = rng.uniform(*ExamPrior().off_centre_mm, size=2)
    if kind == "lump at the rim":
        away, angle = rng.uniform(*AT_RIM_MM), rng.uniform(0.0, 2.0 * np.pi)
        shift = away * np.array([np.cos(angle), np.sin(angle)])
    lump = replace(lump, x_mm=float(shift[0]), y_mm=float(shift[1]))
    stress = ""
    if kind in ("uneven fat", "lump under uneven fat"):
        stress = str(rng.choice(UNEVEN))
    elif kind == "uneven wall":
        stress = "wall 50"
    elif kind == "convex skin":
        stress = str(rng.choice(["skin 150", "skin 75"]))
    if stress:
        return Exam(index, kind, replace(scene, body=body, solid_lumps=(lump,)), stress)
    fat = fat_thickness(body, (lump,))
    ribs: tuple[Rib, ...] = ()
    if "rib" in kind:
        side = rng.choice([-1.0, 1.0]) * rng.uniform(6.0, 28.0)
        ribs = (Rib(y_mm=float(side), depth_mm=float(rng.uniform(9.0, 18.0))),)
        scene = replace(scene, frame_rate_hz=RIB_RATE_HZ)
        body = replace(body, thickness_mm=max(body.thickness_mm, 34.0))
    lumps = () if not kind.startswith("lump") else (replace(lump, seat=None),) if ribs else (lump,)
    body = body if lumps and not ribs else replace(body, fat_mm=min(fat, body.thickness_mm - 5.0))
    return Exam(index, kind, replace(scene, body=body, solid_lumps=lumps, ribs=ribs))
