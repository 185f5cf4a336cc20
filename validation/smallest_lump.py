"""The smallest lump that a map without one would have shown: its constants, and a check on one scan.

    python -m validation smallest_lump make DIR     # 110 exams with a lump and without it; 2 s of CPU each
    python -m validation smallest_lump learn DIR    # LOG_AMPLITUDE, LOG_SIGMA, and what was found by its margin
    python -m validation smallest_lump check DIR    # 225 lumps in the packaged empty scan, each as large as it says

`make` simulates each exam twice with equal random numbers, with and without its lump, in fat or on its lower edge: the
difference of the maps is what the lump adds. `check` puts balls of 6 to 100 times the stiffness of fat at the places
and depths that `smallest_lumps` names for the packaged empty scan (50 frames a second), of the diameter that it gives
there (at every fourth place also 0.7 times that), and counts those that the search of
`estimate` takes for lumps, within 10 mm.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from tactile_bayes.api.estimating import estimate_inputs, estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.tissue import SolidLump
from tactile_bayes.geometry import FloatArray, apply
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior import verdict as model
from tactile_bayes.posterior.draw import DETECTED
from tactile_bayes.posterior.estimate import search
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.studies.population import BodyPrior, ExamPrior, draw_body, draw_exam
from validation.common import Row, add_row, map_of, parser, pickled, place_on_map, rows_in

SEED, CHECK_SEED, EXAMS = 20261128, 20261129, 110
FRAME_RATE_HZ = 50.0
NEAR_MM, FIT_MM = 10.0, 20.0
LEAST_AMPLITUDE, MOST_SIGMA_MM = 0.004, 15.0
"""Below and above them the difference of two maps is noise."""
STIFFNESS = (6.0, 100.0)
REPEATS = 5


def drawn(index: int) -> Scene:
    """An exam with its lump, anywhere within 24 mm of the strokes' middle."""
    rng = np.random.default_rng([SEED, index])
    body, lump = draw_body(BodyPrior(), rng)
    depth = float(rng.uniform(7, 28))
    d = min(depth * float(np.exp(rng.uniform(*np.log([0.3, 1.2])))), 25.0)
    fat = float(np.clip(depth + rng.uniform(-1.0, 1.5) * d / 2, 5.0, 40.0))
    body = replace(body, fat_mm=fat, thickness_mm=max(body.thickness_mm, depth + d / 2 + 6, fat + 8))
    scene = replace(
        draw_exam(ExamPrior(), rng), frame_rate_hz=FRAME_RATE_HZ, seed=int(rng.integers(1 << 30)), body=body
    )
    away, turn = 24 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    return replace(
        scene, solid_lumps=(_ball(d, depth, lump.stiffness_ratio, (away * np.cos(turn), away * np.sin(turn))),)
    )


def _ball(d_mm: float, depth_mm: float, stiffness: float, at: tuple[float, float]) -> SolidLump:
    return SolidLump(
        d_mm=d_mm, depth_ratio=depth_mm / d_mm, stiffness_ratio=stiffness, x_mm=float(at[0]), y_mm=float(at[1])
    )


def listed_near(estimate: Estimate, at: tuple[float, float]) -> bool:
    """Whether an estimate lists a mass at a place."""
    return any(np.hypot(one.x_mm - at[0], one.y_mm - at[1]) < NEAR_MM for one in estimate.masses)


def shown(tactile_map: TactileMap, at: tuple[float, float]) -> bool:
    """Whether the search of `estimate` takes a rise at a place for a lump."""
    _, options = estimate_inputs(Settings(), tactile_map)
    _, seen = search(tactile_map, options)
    if seen is None or seen.detection.probability < DETECTED:
        return False
    bump = seen.bump()
    return bool(np.hypot(bump.x_mm - at[0], bump.y_mm - at[1]) < NEAR_MM)


def make(folder: Path) -> None:
    """Simulate what is missing."""
    for index in range(EXAMS):
        pickled(folder / f"{index:04d}.pickle", partial(_pair, index))


def _pair(index: int) -> Row:
    scene = drawn(index)
    return {"scene": scene, "empty": map_of(replace(scene, solid_lumps=())), "map": map_of(scene)}


def added_bump(with_lump: TactileMap, empty: TactileMap, at: tuple[float, float]) -> FloatArray | None:
    """Amplitude and widths of the Gaussian that a lump adds to a map at a known place; None where little is covered."""
    assert with_lump.patient_from_plane is not None
    assert empty.patient_from_plane is not None
    x, y = np.meshgrid(with_lump.x_mm, with_lump.y_mm)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    there = apply(np.linalg.inv(empty.patient_from_plane) @ with_lump.patient_from_plane, points)
    column, row = (
        np.rint((there[:, i] - axis[0]) / empty.recipe.cell_mm).astype(int)
        for i, axis in enumerate((empty.x_mm, empty.y_mm))
    )
    inside = (column >= 0) & (column < len(empty.x_mm)) & (row >= 0) & (row < len(empty.y_mm))
    before = np.full(x.size, np.nan)
    before[inside] = np.where(empty.covered, empty.mean, np.nan)[row[inside], column[inside]]
    added = np.where(with_lump.covered, with_lump.mean, np.nan) - before.reshape(x.shape)
    used = (np.hypot(x - at[0], y - at[1]) < FIT_MM) & np.isfinite(added)
    if used.sum() < 150:
        return None
    u, v, value = x[used] - at[0], y[used] - at[1], added[used]
    weight = np.sqrt(np.minimum(with_lump.count[used], 20))

    def residual(t: FloatArray) -> FloatArray:
        bump = np.exp(-0.5 * ((u - t[1]) ** 2 / np.exp(2 * t[2]) + (v - t[4]) ** 2 / np.exp(2 * t[3])))
        return np.asarray((t[0] * bump + t[5] - value) * weight)

    widest = np.log(16.0)
    bounds = ([0, -4, 0, 0, -4, -1], [50, 4, widest, widest, 4, 1])
    fits = [
        least_squares(residual, [max(value.max(), 0.01), 0, np.log(s), np.log(s), 0, 0], bounds=bounds)
        for s in (3.0, 6.0, 10.0)
    ]
    best = min(fits, key=lambda fit: float(fit.cost)).x
    return np.array([best[0], np.exp(best[2]), np.exp(best[3])])


def learn(folder: Path) -> Iterator[str]:
    """Coefficients of ln amplitude and ln sigma, and the margins of lumps found and not found."""
    rows = []
    for path in sorted(folder.glob("*.pickle")):
        kept = pickle.loads(path.read_bytes())
        scene = kept["scene"]
        lump = scene.solid_lumps[0]
        if scene.body.fat_mm < lump.depth_mm:
            continue
        at = place_on_map(scene, kept["map"], (lump.x_mm, lump.y_mm))
        bump = added_bump(kept["map"], kept["empty"], at)
        needed = model.needed_amplitudes(kept["empty"], place_on_map(scene, kept["empty"], (lump.x_mm, lump.y_mm)))
        found = listed_near(estimate_one(kept["map"], Settings()).estimate, at)
        rows.append((lump.d_mm, lump.depth_mm, scene.body.fat_mm, bump, needed, found))
    d, depth, fat = (np.array([row[i] for row in rows]) for i in range(3))
    features = model.lump_features(d, depth, fat)
    seen = [
        i
        for i, row in enumerate(rows)
        if row[3] is not None and row[3][0] > LEAST_AMPLITUDE and row[3][1] < MOST_SIGMA_MM
    ]
    log_a = np.log([rows[i][3][0] for i in seen])
    log_sigma = np.log([np.sqrt(rows[i][3][1] * rows[i][3][2]) for i in seen])
    of_a, of_sigma = (
        np.linalg.lstsq(features[seen][:, :n], values, rcond=None)[0] for n, values in ((7, log_a), (4, log_sigma))
    )
    yield f"LOG_AMPLITUDE {of_a.round(3).tolist()}, SD {np.std(log_a - features[seen] @ of_a):.3f} of {len(seen)}"
    yield f"LOG_SIGMA {of_sigma.round(3).tolist()}, SD {np.std(log_sigma - features[seen][:, :4] @ of_sigma):.3f}"
    widths = np.log(model.WIDTHS_MM)
    sigma = np.clip(features[:, :4] @ of_sigma, widths[0], widths[-1])
    margin = np.array(
        [a - np.interp(s, widths, np.log(row[4])) for a, s, row in zip(features @ of_a, sigma, rows, strict=True)]
    )
    found = np.array([row[5] for row in rows])
    for low, high in ((-np.inf, 0.0), (0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.25), (1.25, np.inf)):
        these = (margin >= low) & (margin < high)
        yield f"margin {low:g} to {high:g}: {found[these].sum()} of {these.sum()} found"


def check(folder: Path) -> Iterator[str]:
    """Share of lumps of the stated size that are listed, and of others, in the packaged empty scan."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "check.jsonl"
    scene = replace(read_scene(Path("tactile_bayes/demo/empty.toml")), frame_rate_hz=FRAME_RATE_HZ)
    empty = map_of(scene)
    answer = estimate_one(empty, Settings()).estimate.smallest
    assert answer is not None
    done = {row["key"] for row in rows_in(path)}
    for key, times, ball, at in _balls(scene, empty, answer):
        if key not in done:
            exam = replace(scene, solid_lumps=(ball,))
            with_lump = map_of(exam)
            found = shown(with_lump, place_on_map(exam, with_lump, at))
            row = {"key": key, "times": times, "d_mm": ball.d_mm, "depth_mm": ball.depth_mm, "found": found}
            add_row(path, row | {"at": at, "stiffness_ratio": ball.stiffness_ratio})
    rows = rows_in(path)
    for times in sorted({row["times"] for row in rows}):
        these = [row for row in rows if row["times"] == times]
        yield f"{times:g} times the stated diameter: {sum(row['found'] for row in these)} of {len(these)} listed"
        for depth in sorted({row["depth_mm"] for row in these}):
            own = [row for row in these if row["depth_mm"] == depth]
            yield f"  {depth:g} mm deep: {sum(row['found'] for row in own)} of {len(own)}"


def _balls(
    scene: Scene, empty: TactileMap, answer: model.SmallestLumps
) -> Iterator[tuple[str, float, SolidLump, tuple[float, float]]]:
    """Balls at the answer's places and depths, with their place in the scene."""
    assert empty.patient_from_plane is not None
    xiphoid = scene.landmarks.xiphoid_mm
    for repeat in range(REPEATS):
        for i, place in enumerate(answer.places_mm):
            x, y, _ = apply(empty.patient_from_plane, np.array([*place, 0.0]))
            at = (float(x) + xiphoid[0], float(y) + xiphoid[1])
            for j, depth in enumerate(answer.depths_mm):
                rng = np.random.default_rng([CHECK_SEED, repeat, i, j])
                stiffness = float(np.exp(rng.uniform(*np.log(STIFFNESS))))
                d = float(answer.d_mm[i, j])
                for times in (1.0, 0.7) if repeat == 0 and i % 4 == 0 else (1.0,):
                    if np.isfinite(d):
                        key = f"{repeat}-{i}-{j}-{times}"
                        yield key, times, _ball(times * d, float(depth), stiffness, at), at


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one step."""
    words = parser(__name__, __doc__)
    words.add_argument("step", choices=["make", "learn", "check"])
    words.add_argument("folder", type=Path)
    given = words.parse_args(arguments)
    if given.step == "make":
        make(given.folder)
    else:
        print("\n".join(learn(given.folder) if given.step == "learn" else check(given.folder)))
