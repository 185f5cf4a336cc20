"""Sizes of simulated lumps that are no balls: spheroids lying flat, standing and tilted, lobed, rough, two that touch.

    python -m benchmarks.shapes make DIR [--bodies 10] [--seed N]    # simulate, map and fit: DIR/<class>-<i>.npz
    python -m benchmarks.shapes sizes DIR [DIR ...]     # size the fits with the default calibration: one table

Bodies and exams are drawn from `forward.population`, with mean diameters across of 8 to 25 mm and depths up to 1.4
of them; one exam a body. `make` takes about 15 s a body and goes on where it stopped; `sizes` takes seconds, so a rule of
sizing can be tried on the same fits. The sizes of a map are compared with the diameters seen from above, and the largest
also with the largest of all.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import TactileBayesError
from tactile_bayes.forward.population import BodyPrior, ExamPrior, draw_body, draw_exam
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SolidLump

SEED: Final = 20270110
BODIES: Final = BodyPrior(d_mm=(8.0, 25.0), depth_ratio=(0.56, 1.4))
LARGEST_MM: Final = 25.0
# A shape needs this much of its half height below the skin, and above the chest wall.
_COVER: Final = 1.12


@dataclass(frozen=True, slots=True)
class ShapeClass:
    """A kind of lump: diameters over the mean diameter across, and what else is not a ball.

    Parameters
    ----------
    along, across, down
        Diameters along the three axes.
    tilted
        Whether it is tilted by a random angle of up to 90 degrees.
    outline
        Of `SolidLump`.
    """

    along: float = 1.0
    across: float = 1.0
    down: float = 1.0
    tilted: bool = False
    outline: tuple[tuple[str, Any], ...] = ()


def _flat(ratio: float) -> ShapeClass:
    return ShapeClass(ratio**0.5, ratio**-0.5, ratio**-0.5)


CLASSES: Final = {
    "ball": ShapeClass(),
    "flat 1.2": _flat(1.2),
    "flat 1.5": _flat(1.5),
    "flat 2.0": _flat(2.0),
    "disc 1.5": ShapeClass(down=1 / 1.5),
    "standing 1.5": ShapeClass(down=1.5),
    "tilted 1.5": replace(_flat(1.5), tilted=True),
    "lobed": ShapeClass(outline=(("lobe_share", 0.2),)),
    "rough": ShapeClass(outline=(("rough_share", 0.1),)),
    "pair": ShapeClass(1.8**0.5, 1.8**-0.5, outline=(("pair", True),)),
}


def draw_scene(name: str, index: int, seed: int) -> Scene:
    """The exam of one body with a lump of a class; depends on nothing but the arguments."""
    rng = np.random.default_rng([seed, list(CLASSES).index(name), index])
    kind = CLASSES[name]
    body, ball = draw_body(BODIES, rng)
    largest = max(kind.along, kind.across)
    d = min(ball.d_mm, LARGEST_MM / largest)
    x, y = rng.uniform(*ExamPrior().off_centre_mm, size=2)
    pair = ("pair", True) in kind.outline
    lump = SolidLump(
        x_mm=float(x),
        y_mm=float(y),
        d_mm=d * kind.along,
        width_mm=d * kind.across,
        height_mm=None if pair else d * kind.down,
        stiffness_ratio=ball.stiffness_ratio,
        turn_deg=float(rng.uniform(-90.0, 90.0)),
        tilt_deg=float(rng.uniform(0.0, 90.0)) if kind.tilted else 0.0,
        rough_seed=int(rng.integers(1 << 30)),
        lobes=int(rng.integers(2, 6)),
        **dict(kind.outline),
    )
    half = lump.vertical_mm / 2
    depth = max(ball.depth_ratio * d, _COVER * half)
    fat = depth + (ball.seat or 0.0) * half
    thickness = max(body.thickness_mm, depth + _COVER * half + 4.0, fat + 4.0)
    lump = replace(lump, depth_ratio=depth / lump.d_mm)
    exam = draw_exam(ExamPrior(), rng)
    body = replace(body, thickness_mm=thickness, fat_mm=fat)
    return replace(exam, seed=int(rng.integers(1 << 30)), body=body, solid_lumps=(lump,))


def make(folder: Path, *, bodies: int, seed: int, classes: list[str]) -> None:
    """Simulate, map and fit, body by body of all classes in turn; what is there already is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(bodies):
        for name in classes:
            path = folder / f"{name.replace(' ', '_')}-{index}.npz"
            if path.exists():
                continue
            start = time.process_time()
            np.savez(path, **_measured(draw_scene(name, index, seed)))
            print(f"{path.name}: {time.process_time() - start:.0f} s CPU", flush=True)


def _measured(scene: Scene) -> dict[str, Any]:
    """Truth, and the draws of amplitude and shape by the default method; no draws without an estimate."""
    from tactile_bayes.mapping.build import build_map
    from tactile_bayes.pipeline.one_map import estimate_one
    from tactile_bayes.pipeline.settings import Settings
    from tactile_bayes.presets import HEAD_PROFILE
    from tactile_bayes.size.fat_depth import head_profile

    made = simulate(scene, rng=np.random.default_rng(scene.seed))
    truth = made.truth["lumps"][0]
    names = ("largest_mm", "smallest_mm", "largest_across_mm", "smallest_across_mm", "turn_deg", "depth_mm", "seat")
    row: dict[str, Any] = {name: truth[name] for name in (*names, "stiffness_ratio")}
    try:
        tactile_map = build_map(made.scan)
        estimate = estimate_one(tactile_map, Settings()).estimate
    except TactileBayesError as error:
        return row | {"why": str(error)}
    posterior = estimate.map_posterior
    if posterior is None or estimate.size is None:
        return row | {"why": estimate.reason}
    profile = head_profile({name: tactile_map.quality.get(name) for name in HEAD_PROFILE})
    draws = {n: getattr(posterior, n) for n in ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_rad")}
    scene_line = estimate.diagnostics.noise.scene if hasattr(estimate.diagnostics.noise, "scene") else ""
    return row | draws | {
        "profile": np.array(profile if profile is not None else ()),
        "max_size_mm": estimate.size.max_size_mm,
        "min_size_mm": estimate.size.min_size_mm,
        "oval_probability": estimate.size.figures["oval_probability"],
        "replicates": estimate.size.replicates,
        "scene": str(scene_line),
    }


def main() -> None:
    """Make fits, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "sizes"))
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--classes", nargs="+", default=list(CLASSES), choices=list(CLASSES))
    arguments = parser.parse_args()
    if arguments.what == "make":
        make(arguments.folder[0], bodies=arguments.bodies, seed=arguments.seed, classes=arguments.classes)


if __name__ == "__main__":
    main()
