"""Sizes of simulated lumps that are no balls: spheroids lying flat, standing and tilted, lobed, rough, two that touch.

    python -m benchmarks.shapes make DIR [--bodies 10] [--seed N]    # simulate and map: DIR/<class>-<i>.nc and .json
    python -m benchmarks.shapes sizes DIR [DIR ...]    # estimate the maps with the defaults: one table

Bodies and exams are drawn from `forward.population`, with mean diameters across of 8 to 25 mm and depths up to 1.4
of them; one exam a body. `make` takes about 5 s of CPU a body and goes on where it stopped; `sizes` takes half a second
a body. The sizes of a map are compared with the diameters seen from above, the largest also with the largest of all.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.forward.population import BodyPrior, ExamPrior, draw_body, draw_exam
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SolidLump
from tactile_bayes.size.posterior import SizePosterior

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
    "flat 1.5": _flat(1.5),
    "pair": ShapeClass(1.8**0.5, 1.8**-0.5, outline=(("pair", True),)),
    "disc 1.5": ShapeClass(down=1 / 1.5),
    "standing 1.5": ShapeClass(down=1.5),
    "ball": ShapeClass(),
    "flat 2.0": _flat(2.0),
    "flat 1.2": _flat(1.2),
    "lobed": ShapeClass(outline=(("lobe_share", 0.2),)),
    "tilted 1.5": replace(_flat(1.5), tilted=True),
    "rough": ShapeClass(outline=(("rough_share", 0.1),)),
    "standing 2.0": ShapeClass(down=2.0),
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
    """Simulate and map, body by body of all classes in turn; what is there already is kept."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(bodies):
        for name in classes:
            path = folder / f"{name.replace(' ', '_')}-{index}.nc"
            if path.with_suffix(".json").exists():
                continue
            start = time.process_time()
            _simulated(draw_scene(name, index, seed), path)
            print(f"{path.name}: {time.process_time() - start:.0f} s CPU", flush=True)


def _simulated(scene: Scene, path: Path) -> None:
    """Write the map of a scene, and the truth beside it."""
    from tactile_bayes.files.map_nc import write_map
    from tactile_bayes.mapping.build import build_map

    made = simulate(scene, rng=np.random.default_rng(scene.seed))
    truth = dict(made.truth["lumps"][0])
    try:
        write_map(path, build_map(made.scan), provenance=Provenance("benchmarks.shapes", {}, {}), force=True)
    except TactileBayesError as error:
        truth["why"] = str(error)
    path.with_suffix(".json").write_text(json.dumps(truth))


@dataclass(frozen=True, slots=True)
class Sized:
    """One sized exam: errors as shares of the truth, and whether the intervals cover it.

    Parameters
    ----------
    across
        Error of the largest size against the largest diameter seen from above.
    any_way
        The same against the largest diameter of all.
    smallest
        Error of the smallest size against the smallest diameter seen from above.
    covers, covers_any, covers_smallest
        Whether the 95 % intervals hold these diameters.
    half_width
        Half the interval of the largest size over its median.
    oval, irregular
        Whether the report says that the lump is oval, and that its outline is irregular.
    in_two, covers_in_two
        Whether it lists two masses that may be one lump, and whether the interval of their length holds the largest
        diameter seen from above.
    """

    across: float
    any_way: float
    smallest: float
    covers: bool
    covers_any: bool
    covers_smallest: bool
    half_width: float
    oval: bool
    irregular: bool
    in_two: bool
    covers_in_two: bool


def sized(row: Mapping[str, Any], size: SizePosterior, touching: Sequence[Mapping[str, Any]]) -> Sized:
    """Compare a size, and the lengths of masses that touch, with the truth of its row."""
    largest, smallest = (size.summarise(name, probability=0.95) for name in ("max_size_mm", "min_size_mm"))
    true, least, any_way = (float(row[n]) for n in ("largest_across_mm", "smallest_across_mm", "largest_mm"))
    return Sized(
        largest.median / true - 1.0,
        largest.median / any_way - 1.0,
        smallest.median / least - 1.0,
        largest.low <= true <= largest.high,
        largest.low <= any_way <= largest.high,
        smallest.low <= least <= smallest.high,
        (largest.high - largest.low) / 2 / largest.median,
        size.figures["oval_probability"] >= 0.5,
        size.figures["irregular_outline"] > 0.0,
        bool(touching),
        any(one["together_mm"]["low"] <= true <= one["together_mm"]["high"] for one in touching),
    )


def measured(row: Mapping[str, Any], path: Path) -> Sized | None:
    """A map by `estimate` with its defaults; None without an estimate."""
    from tactile_bayes.pipeline.one_map import answer_of, estimate_file
    from tactile_bayes.pipeline.settings import Settings

    if not path.exists():
        return None
    outcome = estimate_file(path, Settings())
    size, document = outcome.estimate.size, answer_of(outcome).document or {}
    return None if size is None else sized(row, size, document["touching"])


def table(folders: Sequence[Path]) -> str:
    """Errors and coverage by class."""
    found: dict[str, list[Sized]] = defaultdict(list)
    asked: dict[str, int] = defaultdict(int)
    for name in CLASSES:
        for path in (p for folder in folders for p in sorted(folder.glob(f"{name.replace(' ', '_')}-*.json"))):
            asked[name] += 1
            one = measured(json.loads(path.read_text()), path.with_suffix(".nc"))
            if one is not None:
                found[name].append(one)
    head = f"{'class':14}{'sized':>8}{'median':>8}{'mean |e|':>9}{'covers':>8}{'smallest':>9}{'covers':>8}"
    lines = [head + f"{'3D |e|':>8}{'covers':>8}{'half':>6}{'oval':>6}{'irregular':>11}{'in two':>8}{'covers':>8}"]
    for name, rows in found.items():
        n = len(rows)

        def share(what: str, rows: list[Sized] = rows, n: int = n) -> str:
            return f"{sum(getattr(r, what) for r in rows)}/{n}"

        across = np.array([r.across for r in rows])
        lines.append(
            f"{name:14}{f'{n}/{asked[name]}':>8}{np.median(across):>+8.1%}{np.abs(across).mean():>9.1%}"
            f"{share('covers'):>8}{np.mean([abs(r.smallest) for r in rows]):>9.1%}{share('covers_smallest'):>8}"
            f"{np.mean([abs(r.any_way) for r in rows]):>8.1%}{share('covers_any'):>8}"
            f"{np.mean([r.half_width for r in rows]):>6.0%}{share('oval'):>6}{share('irregular'):>11}"
            f"{share('in_two'):>8}{share('covers_in_two'):>8}"
        )
    return "\n".join(lines)


def main() -> None:
    """Make maps, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "sizes"))
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--classes", nargs="+", default=list(CLASSES), choices=list(CLASSES))
    arguments = parser.parse_args()
    if arguments.what == "make":
        make(arguments.folder[0], bodies=arguments.bodies, seed=arguments.seed, classes=arguments.classes)
    else:
        print(table(arguments.folder))


if __name__ == "__main__":
    main()
