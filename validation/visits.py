"""What `compare` says of lumps that grow, shrink or stay: ``python -m validation visits``.

    python -m validation visits make DIR --bodies 50 [--seed N]  # exams, resumable: a file a body
    python -m validation visits law DIR                          # `SHARED_BODY` of `size.visits`
    python -m validation visits judge DIR                        # false alarms, power, coverage, widths, same mass
    python -m validation visits amplitude validation/population.csv.gz  # `AMPLITUDE_LAW` of `size.visits`

A body has three visits of two exams each: two with a lump of the same size, one with a lump 10, 20 or 35 % larger or
20 % smaller. Its fat, gland and stiffness stay; the lump keeps its centre or the gap to the skin (drawn), so its seat
changes as it grows. Each visit has another posture: all depths by a common factor (SD 4 %), the breast against the
sternum by 3 mm (SD, each way). Each exam has another technique and landmarks touched anew (SD 2.5 mm, each way).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import pooling_shape
from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.forward.scene import Scene, SceneLandmarks
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.studies.population import BodyPrior, ExamPrior, draw_body, draw_exam
from validation.common import map_of, parser

GROWTHS = (1.10, 1.20, 1.35, 0.80)
VISITS, EXAMS = 3, 2
POSTURE_SD, SHIFT_MM, TOUCH_MM = 0.04, 3.0, 2.5
BREAST_MM = 60.0
"""Radius of the disc in which masses lie, about a point 90 mm beside and above the xiphoid."""
STERNUM_MM = 180.0


def draw_visits(index: int, *, seed: int) -> tuple[float, list[list[Scene]], FloatArray]:
    """Growth of the last visit, the scenes of each visit, and the mass's place from the xiphoid in mm (2,)."""
    rng = np.random.default_rng([seed, index])
    growth, low, high = GROWTHS[index % len(GROWTHS)], *BodyPrior().d_mm
    while True:
        body, lump = draw_body(BodyPrior(), rng)
        if low <= lump.d_mm * growth <= high:
            break
    same_gap = bool(rng.uniform() < 0.5)
    radius, angle = BREAST_MM * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    place = np.array([90.0, 90.0]) + radius * np.array([np.cos(angle), np.sin(angle)])
    visits = []
    for number, factor in enumerate((1.0, 1.0, growth)):
        at_visit = _grown(body, lump, factor, same_gap=same_gap, stretch=float(np.exp(POSTURE_SD * rng.normal())))
        moved = place + SHIFT_MM * rng.normal(size=2)
        seeds = np.random.SeedSequence([seed, index, number]).generate_state(EXAMS)
        visits.append([_exam(*at_visit, moved, int(one), rng) for one in seeds])
    return growth, visits, place


def _grown(
    body: SceneBody, lump: SolidLump, factor: float, *, same_gap: bool, stretch: float
) -> tuple[SceneBody, SolidLump]:
    """The body with the lump at another size; `stretch` multiplies every depth.

    A lump that would come out of the skin lies deeper, one below the boundary of the fat takes that with it.
    """
    d = lump.d_mm * factor
    fat = stretch * (lump.depth_mm + (lump.seat or 0.0) * lump.d_mm / 2)
    depth = max(stretch * (lump.depth_mm + (0.5 * (d - lump.d_mm) if same_gap else 0.0)), 0.54 * d)
    seat = max(fat - depth, 0.0) / (d / 2)
    thickness = max(stretch * body.thickness_mm, depth + max(0.6, 0.5 * seat + 0.05) * d + 4.0)
    return replace(body, thickness_mm=thickness), replace(lump, d_mm=d, depth_ratio=depth / d, seat=seat)


def _exam(body: SceneBody, lump: SolidLump, place: FloatArray, seed: int, rng: np.random.Generator) -> Scene:
    prior = ExamPrior()
    exam, at = draw_exam(prior, rng), rng.uniform(*prior.off_centre_mm, size=2)
    xiphoid, notch = at - place + np.array([[0.0, 0.0], [0.0, STERNUM_MM]]) + TOUCH_MM * rng.normal(size=(2, 2))
    marks = SceneLandmarks(True, (*map(float, xiphoid), 0.0), (*map(float, notch), 0.0))  # type: ignore[arg-type]
    placed = replace(lump, x_mm=float(at[0]), y_mm=float(at[1]))
    return replace(exam, seed=seed, body=body, solid_lumps=(placed,), landmarks=marks)


def make_body(index: int, *, folder: Path, seed: int) -> str:
    """Scan, map and estimate the exams of one body; keep what pooling needs."""
    path = folder / f"body_{index:04d}.npz"
    if path.exists():
        return path.name
    growth, visits, place = draw_visits(index, seed=seed)
    found: dict[str, Any] = {"growth": growth, "place": place}
    found["d_mm"] = [scenes[0].solid_lumps[0].d_mm for scenes in visits]
    for v, scenes in enumerate(visits):
        for e, scene in enumerate(scenes):
            found |= {f"v{v}e{e}_{name}": value for name, value in _measured(scene).items()}
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez_compressed(file, **found)
    part.rename(path)
    return path.name


def _measured(scene: Scene) -> dict[str, Any]:
    """Draws of the shape and place of the lump on an exam's map; nothing where none was found."""
    try:
        tactile_map = map_of(scene)
        estimate = estimate_one(tactile_map, Settings()).estimate
        shape = pooling_shape(tactile_map, estimate)
    except TactileBayesError:
        return {}
    posterior, frame = estimate.map_posterior, tactile_map.patient_from_plane
    if shape is None or posterior is None or frame is None or estimate.status != "estimate":
        return {}
    centre = apply(frame, np.stack([posterior.x_mm, posterior.y_mm, np.zeros_like(posterior.x_mm)], axis=-1))
    centre = centre.reshape(-1, 3)[:, :2]
    drawn = {name: getattr(shape, name).astype(np.float32) for name in ("log_amplitude", "log_width", "q", "r")}
    figures = {} if shape.profile is None else {"profile": shape.profile}
    return {
        **drawn,
        **figures,
        "turn_rad": shape.turn_rad,
        "labels": shape.replicates.astype(np.int16),
        "centre": centre.mean(axis=0),
        "centre_cov": np.cov(centre.T),
        "fingerprint": np.uint64(tactile_map.fingerprint),
    }


def make(folder: Path, *, bodies: int, seed: int, workers: int) -> None:
    """Make the files of bodies that are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    work = partial(make_body, folder=folder, seed=seed)
    if workers == 1:
        for index in range(bodies):
            print(work(index), flush=True)
        return
    with ProcessPoolExecutor(workers) as pool:
        for done in pool.map(work, range(bodies)):
            print(done, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the exams, or print figures of those that are made."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["make", "law", "judge", "amplitude"])
    words.add_argument("folder", type=Path)
    words.add_argument("--bodies", type=int, default=50)
    words.add_argument("--seed", type=int, default=20271115, help="make: 20271115 was learned from, 20271116 judged on")
    words.add_argument("--workers", type=int, default=1)
    given = words.parse_args(arguments)
    if given.step == "make":
        make(given.folder, bodies=given.bodies, seed=given.seed, workers=given.workers)
    else:
        # it draws the bodies of this module
        from validation import visits_figures

        getattr(visits_figures, given.step)(given.folder)
