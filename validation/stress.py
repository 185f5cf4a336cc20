"""How wrong sizes are where bodies break the assumptions of the calibration's, and what would show it.

    python -m validation stress simulate FOLDER [--bodies 16]
    python -m validation stress table FOLDER

`simulate` scans each body once without stress and once under every one of `STRESSES`, by `validation.stress_frames`;
two more bodies without stress for each serve to set the flags' limits. Scans are kept in the folder, and an interrupted
run goes on where it stopped; `table` maps and sizes them by the present program. A body takes about 40 s.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, TactileBayesError
from tactile_bayes.forward.scene import Scene
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import broken_assumptions, skewed
from tactile_bayes.scans import Scan
from tactile_bayes.studies.population import BodyPrior, Population
from validation.common import Row, parser, pickled
from validation.stress_frames import Physics, VaryingLayers, stressed_scan

SEED = 31
BODIES = replace(BodyPrior(), d_mm=(8.0, 25.0), depth_ratio=(0.56, 1.2))
"""Clear lumps: where the control shows none, a body says nothing of the stress."""
FRAME_RATE_HZ = 40.0
"""For time: what is asked about is not the readings' noise."""
CONTROL = "none"
STEP_AT_MM, STEP_OVER_MM = 10.0, 4.0
Stressed = Callable[[Scene, np.random.Generator], tuple[Scene, Physics]]


@dataclass(frozen=True, slots=True)
class Stress:
    """One broken assumption at one strength.

    Parameters
    ----------
    words
        What it is, in plain terms.
    apply
        Takes a scene and random numbers of its body's to the changed scene and physics.
    """

    words: str
    apply: Stressed


def _body(**changes: float) -> Stressed:
    return lambda scene, _: (replace(scene, body=replace(scene.body, **changes)), Physics())


def _physics(**changes: float) -> Stressed:
    return lambda scene, _: (scene, Physics(**changes))


def _wedge(slope: float) -> Stressed:
    def apply(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Physics]:
        return scene, Physics(VaryingLayers("fat", lambda u, own: own + slope * u, rng.uniform(0, 2 * np.pi)))

    return apply


def _step(jump_mm: float) -> Stressed:
    def apply(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Physics]:
        jump = jump_mm * rng.choice([-1.0, 1.0])

        def depth(u: FloatArray, own: float) -> FloatArray:
            return own + jump * 0.5 * (1.0 + np.tanh((u - STEP_AT_MM) / (STEP_OVER_MM / 2)))

        return scene, Physics(VaryingLayers("fat", depth, rng.uniform(0, 2 * np.pi)))

    return apply


def _wall(radius_mm: float) -> Stressed:
    def apply(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Physics]:
        return scene, Physics(
            VaryingLayers("wall", lambda u, own: own + u**2 / (2 * radius_mm), rng.uniform(0, 2 * np.pi))
        )

    return apply


def _soft_lump(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Physics]:
    lump = replace(scene.solid_lumps[0], stiffness_ratio=float(np.exp(rng.uniform(np.log(3.0), np.log(6.0)))))
    return replace(scene, solid_lumps=(lump,)), Physics()


STRESSES: dict[str, Stress] = {
    CONTROL: Stress("as the calibration's bodies", _physics()),
    "wedge 0.05": Stress("fat 3 mm deeper from one end of 60 mm to the other", _wedge(0.05)),
    "wedge 0.1": Stress("fat 6 mm deeper over 60 mm", _wedge(0.1)),
    "wedge 0.2": Stress("fat 12 mm deeper over 60 mm", _wedge(0.2)),
    "step 3": Stress("fat 3 mm deeper or thinner from 10 mm beside the lump on", _step(3.0)),
    "step 6": Stress("fat 6 mm deeper or thinner from there on", _step(6.0)),
    "wall 50": Stress("chest wall curved by 50 mm", _wall(50.0)),
    "skin 150": Stress("convex skin of radius 150 mm", _physics(skin_radius_mm=150.0)),
    "skin 75": Stress("convex skin of radius 75 mm", _physics(skin_radius_mm=75.0)),
    "fat 1.75 kPa": Stress("fat half as stiff as the softest", _body(fat_kpa=1.75)),
    "fat 15 kPa": Stress("fat twice as stiff as the stiffest", _body(fat_kpa=15.0)),
    "gland 2.5": Stress("gland 2.5 times fat, half the least", _body(gland_ratio=2.5)),
    "gland 32": Stress("gland 32 times fat, twice the most", _body(gland_ratio=32.0)),
    "soft lump": Stress("lump 3 to 6 times fat", _soft_lump),
    "lag 2": Stress("lump dragged 2 mm", _physics(lag_mm=2.0)),
    "lag 4": Stress("lump dragged 4 mm", _physics(lag_mm=4.0)),
    "friction 0.1": Stress("friction as on lubricated skin", _physics(friction=0.1)),
    "friction 0.3": Stress("friction as on moist skin", _physics(friction=0.3)),
    "stiffening 0.1": Stress("modulus 1.1 times at twice 9.5 kPa, square by square", _physics(local_stiffening=0.1)),
    "stiffening 0.25": Stress("modulus 1.25 times at twice 9.5 kPa", _physics(local_stiffening=0.25)),
    "gland stiffening 1": Stress("gland and lump stiffen as the pressure", _physics(gland_stiffening=1.0)),
}


def jobs(bodies: int) -> Iterator[tuple[str, int]]:
    """Stress and number of the body, body by body; numbers from 1000 on have no stress."""
    for body in range(bodies):
        yield from ((name, body) for name in STRESSES)
        yield from ((CONTROL, 1000 + 2 * body + more) for more in range(2))


def scene_of(body: int) -> Scene:
    """The exam of a body without stress."""
    (scene,) = Population(scans=1, seed=SEED, bodies=BODIES).scenes(body)
    return replace(scene, frame_rate_hz=FRAME_RATE_HZ)


def scan_of(name: str, body: int) -> tuple[Scene, Scan]:
    """The scan of a body under a stress."""
    scene, physics = STRESSES[name].apply(scene_of(body), np.random.default_rng([SEED, body, 7]))
    return scene, stressed_scan(scene, physics)


def document_of(scan: Scan) -> dict[str, Any]:
    """What `map` and `estimate` make of a scan, as `estimate --json` prints it, with the map's figures."""
    tactile_map = build_map(scan, as_stated=True)
    outcome = estimate_one(tactile_map, Settings())
    return {**outcome.answer.document, "quality": dict(tactile_map.quality)}


def simulate(folder: Path, bodies: int) -> None:
    """Make what is missing of the scans."""
    for name, body in jobs(bodies):
        pickled(folder / f"{body:04d}-{name.replace(' ', '_')}.pickle", partial(_kept, name, body))


def _kept(name: str, body: int) -> Row:
    try:
        scene, scan = scan_of(name, body)
    except TactileBayesError as error:
        return {"name": name, "body": body, "error": str(error)}
    return {"name": name, "body": body, "d_mm": scene.solid_lumps[0].d_mm, "scene": scene, "scan": scan}


@dataclass(frozen=True, slots=True)
class Exam:
    """What one exam gave.

    Parameters
    ----------
    name, body
        Its stress, and the number of its body.
    log_error
        ln of the largest size over the true one; NaN without a size.
    covered, another_covered
        Whether the intervals hold the true size.
    half_width
        Of the interval of this exam, as a share of the size.
    flags
        Which of `FLAGS` spoke.
    """

    name: str
    body: int
    log_error: float
    covered: bool
    another_covered: bool
    half_width: float
    flags: frozenset[str]


FLAGS = ("lag", "curved", "uneven", "UNEVEN", "skewed", "range", "no depth")
"""Those of `mapping.assumptions`, a change of the profile by whether the report asks to check it or cautions; the map
outside the calibration's range; a head profile that gives no depth of fat."""


def exam_of(kept: dict[str, Any]) -> Exam:
    """Figures of a kept scan, mapped and sized anew: by the present program and its calibrations."""
    if "error" in kept:
        raise BadDataError(kept["error"])
    document = document_of(kept["scan"])
    quality = document["quality"]
    diagnostics, true = document.get("diagnostics") or {}, kept["d_mm"]
    kinds = {one.kind for one in broken_assumptions(quality)}
    spoken = {
        "lag": bool(kinds & {"late_poses", "lump_dragged"}),
        "curved": "curved_skin" in kinds,
        "uneven": "slightly_uneven_fat" in kinds,
        "UNEVEN": "uneven_fat" in kinds,
        "skewed": bool(skewed(quality)),
        "range": any(one["kind"] == "outside_calibration" for one in document.get("findings") or ()),
        "no depth": diagnostics.get("fat_mm") is None,
    }
    flags = frozenset(name for name in FLAGS if spoken[name])
    size = document.get("max_size_mm")
    if not size:
        return Exam(kept["name"], kept["body"], np.nan, False, False, np.nan, flags)
    another = document["another_exam"]["max_size_mm"]
    return Exam(
        kept["name"],
        kept["body"],
        float(np.log(size["median"] / true)),
        size["low"] <= true <= size["high"],
        another["low"] <= true <= another["high"],
        (size["high"] - size["low"]) / 2 / size["median"],
        flags,
    )


def exams_of_campaign(folder: Path) -> list[Exam]:
    """All exams of a folder that could be mapped; the others are named on standard output."""
    found = []
    for path in sorted(folder.glob("*.pickle")):
        kept = pickle.loads(path.read_bytes())
        try:
            found.append(exam_of(kept))
        except TactileBayesError as error:
            print(f"{kept['name']}, body {kept['body']}: {error}")
    return found


def table(exams: list[Exam]) -> Iterator[str]:
    """A line for each stress: errors, coverage, and how often each flag speaks."""
    control = {one.body: one.log_error for one in exams if one.name == CONTROL}
    heads = f"{'n':>4}{'sized':>6}{'MAE %':>7}{'bias %':>8}{'moved %':>8}{'half %':>7}{'cover':>7}{'another':>8}  "
    flags = " ".join(f"{flag:>8}" for flag in FLAGS)
    yield f"{'stress':22}{heads}{flags}"
    for name in STRESSES:
        own = [one for one in exams if one.name == name]
        sized = [one for one in own if np.isfinite(one.log_error)]
        if not sized:
            continue
        error = np.expm1([one.log_error for one in sized])
        moved = np.expm1([abs(one.log_error - control[one.body]) for one in sized if one.body in control])
        half = np.median([one.half_width for one in sized])
        covered, another = (sum(getattr(one, key) for one in sized) for key in ("covered", "another_covered"))
        shares = " ".join(f"{sum(flag in one.flags for one in own):>8}" for flag in FLAGS)
        yield (
            f"{name:22}{len(own):>4}{len(sized):>6}{100 * np.abs(error).mean():>7.1f}{100 * error.mean():>+8.1f}"
            f"{100 * np.nanmean(moved):>8.1f}{100 * half:>7.1f}{covered:>7}{another:>8}  {shares}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one step."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["simulate", "table"])
    words.add_argument("folder", type=Path)
    words.add_argument("--bodies", type=int, default=16)
    given = words.parse_args(arguments)
    if given.step == "simulate":
        simulate(given.folder, given.bodies)
    else:
        print("\n".join(table(exams_of_campaign(given.folder))))
