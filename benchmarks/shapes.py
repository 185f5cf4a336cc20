"""Sizes of simulated lumps that are no balls: spheroids lying flat, standing and tilted, lobed, rough, two that touch.

    python -m benchmarks.shapes make DIR [--bodies 10] [--seed N]    # simulate, map and fit: DIR/<class>-<i>.npz
    python -m benchmarks.shapes sizes DIR [DIR ...]     # size the fits with the default calibration: one table

Bodies and exams are drawn from `forward.population`, with mean diameters across of 8 to 25 mm and depths up to 1.4
of them; one exam a body. `make` takes about 5 s of CPU a body and goes on where it stopped; `sizes` takes seconds, so
that a rule of sizing can be tried on the same fits. The sizes of a map are compared with the diameters seen from above,
and the largest also with the largest of all.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.shipped import size_calibration_path
from tactile_bayes.files.size_json import read_size_calibration
from tactile_bayes.forward.population import BodyPrior, ExamPrior, draw_body, draw_exam
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SolidLump
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.elongation import ShapePrior
from tactile_bayes.size.pooling import ShapeDraws, SizePriors, pooled_size
from tactile_bayes.size.posterior import SizePosterior

SEED: Final = 20270110
BODIES: Final = BodyPrior(d_mm=(8.0, 25.0), depth_ratio=(0.56, 1.4))
LARGEST_MM: Final = 25.0
_DRAWS: Final = ("amplitude", "sigma_x_mm", "sigma_y_mm", "angle_rad")
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
    profile = head_profile({name: v for name in HEAD_PROFILE if (v := tactile_map.quality.get(name)) is not None})
    draws = {n: getattr(posterior, n) for n in _DRAWS}
    return (
        row
        | draws
        | {
            "profile": np.array(profile if profile is not None else ()),
            "max_size_mm": estimate.size.max_size_mm,
            "min_size_mm": estimate.size.min_size_mm,
            "oval_probability": estimate.size.figures["oval_probability"],
            "replicates": estimate.size.replicates,
        }
    )


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
    oval
        Whether the report says that the lump is oval.
    """

    across: float
    any_way: float
    smallest: float
    covers: bool
    covers_any: bool
    covers_smallest: bool
    half_width: float
    oval: bool


def sized(row: Mapping[str, Any], size: SizePosterior) -> Sized:
    """Compare a size with the truth of its row."""
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
    )


def resized(row: Mapping[str, Any], prior: ShapePrior | None = None) -> SizePosterior:
    """Size of stored draws by the default calibration, with another prior of shapes if given."""
    profile = tuple(float(v) for v in row["profile"]) or None
    draws = ShapeDraws.of(*(row[n] for n in _DRAWS), profile=profile, labels=row["replicates"])
    path = size_calibration_path("solid")
    assert path is not None
    calibration = read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    priors = SizePriors() if prior is None else SizePriors(shape=prior)
    return pooled_size([draws], calibration=calibration, priors=priors, rng=np.random.default_rng(1))


def table(folders: Sequence[Path], prior: ShapePrior | None = None) -> str:
    """Errors and coverage by class."""
    found: dict[str, list[Sized]] = defaultdict(list)
    asked: dict[str, int] = defaultdict(int)
    for name in CLASSES:
        for path in (p for folder in folders for p in sorted(folder.glob(f"{name.replace(' ', '_')}-*.npz"))):
            with np.load(path) as row:
                asked[name] += 1
                if "why" not in row:
                    found[name].append(sized(row, resized(row, prior)))
    head = f"{'class':14}{'sized':>8}{'median':>8}{'mean |e|':>9}{'covers':>8}{'smallest':>9}{'covers':>8}"
    lines = [head + f"{'3D |e|':>8}{'covers':>8}{'half':>6}{'oval':>6}"]
    for name, rows in found.items():
        n = len(rows)

        def share(what: str, rows: list[Sized] = rows, n: int = n) -> str:
            return f"{sum(getattr(r, what) for r in rows)}/{n}"

        across = np.array([r.across for r in rows])
        lines.append(
            f"{name:14}{f'{n}/{asked[name]}':>8}{np.median(across):>+8.1%}{np.abs(across).mean():>9.1%}"
            f"{share('covers'):>8}{np.mean([abs(r.smallest) for r in rows]):>9.1%}{share('covers_smallest'):>8}"
            f"{np.mean([abs(r.any_way) for r in rows]):>8.1%}{share('covers_any'):>8}"
            f"{np.mean([r.half_width for r in rows]):>6.0%}{share('oval'):>6}"
        )
    return "\n".join(lines)


def main() -> None:
    """Make fits, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "sizes"))
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--classes", nargs="+", default=list(CLASSES), choices=list(CLASSES))
    parser.add_argument("--oval-probability", type=float, default=ShapePrior().oval_probability)
    parser.add_argument("--oval-sd", type=float, default=ShapePrior().oval_sd)
    arguments = parser.parse_args()
    if arguments.what == "make":
        make(arguments.folder[0], bodies=arguments.bodies, seed=arguments.seed, classes=arguments.classes)
    else:
        prior = ShapePrior(arguments.oval_probability, arguments.oval_sd)
        print(table(arguments.folder, prior))


if __name__ == "__main__":
    main()
