"""How wrong sizes are outside the range that the shipped calibration was learned in.

    python -m benchmarks.outside_range simulate ROWS.csv [--bodies 8] [--workers 2]
    python -m benchmarks.outside_range table ROWS.csv
    python -m benchmarks.outside_range eq6 PHANTOMS.csv

`simulate` draws bodies with one property (or all) beyond the ranges of `forward.population.BodyPrior`, scans each once
with the solid model, maps it as `map` does and sizes it as `estimate` does, also where the calibration's range does not
hold the map. An interrupted run goes on where it stopped. Rows of the kind `bump` are no body: a Gaussian with the
amplitude and widths that a body inside the range showed, on an even pressure, with that body's diameter as the truth.

`table` prints error and coverage of the 95 % intervals by how far the map lies outside the range, and by kind; then the
maps that are unlike any body at the depth of fat that the head's pressure told, sized with that depth and without.
`eq6` learns Eq 6 from the phantoms in the middle of the range of amplitudes, and of sigma_x, and sizes the others.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.size_calibration import size_table
from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.files.tables import read_table
from tactile_bayes.forward.scene import Lump, Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.estimate import calibration_for, estimate_map
from tactile_bayes.posterior.options import EstimateOptions, FitOptions
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.eq6 import SizeCalibration, push_sizes
from tactile_bayes.size.learn.eq6 import SizeTable, learn_size_calibration
from tactile_bayes.size.pooling import SizePriors, pooled_size
from tactile_bayes.size.terms import Recipe
from tactile_bayes.studies.population import BodyPrior, draw_mass

SEED = 20261123
FRAME_RATE_HZ = 40.0
"""For time: what limits these sizes is not the readings' noise."""
INSIDE = BodyPrior()


@dataclass(frozen=True, slots=True)
class Kind:
    """Bodies of one kind.

    Parameters
    ----------
    bodies
        Their ranges.
    share
        How many of them, as a multiple of ``--bodies``.
    flat
        Height over diameter is drawn from 0.35 to 0.75 where True.
    """

    bodies: BodyPrior
    share: float = 1.0
    flat: bool = False


KINDS = {
    "inside": Kind(INSIDE, 2.0),
    "small": Kind(replace(INSIDE, d_mm=(1.5, 4.0)), 2.0),
    "large": Kind(replace(INSIDE, d_mm=(30.0, 55.0), depth_ratio=(0.52, 1.1)), 3.0),
    "soft": Kind(replace(INSIDE, stiffness_ratio=(1.5, 8.0))),
    "deep": Kind(replace(INSIDE, depth_ratio=(1.8, 2.6))),
    "shallow": Kind(replace(INSIDE, depth_ratio=(0.515, 0.56)), 2.0),
    "far above the gland": Kind(replace(INSIDE, seat=(1.2, 3.0))),
    "soft fat": Kind(replace(INSIDE, fat_kpa=(1.0, 3.5))),
    "stiff fat": Kind(replace(INSIDE, fat_kpa=(7.5, 20.0))),
    "soft gland": Kind(replace(INSIDE, gland_ratio=(1.2, 5.0))),
    "stiff gland": Kind(replace(INSIDE, gland_ratio=(16.0, 50.0))),
    "thin breast": Kind(replace(INSIDE, thickness_mm=(18.0, 40.0), d_mm=(5.0, 15.0))),
    "flat lump": Kind(INSIDE, 1.0, flat=True),
    "everything": Kind(
        BodyPrior((3.0, 50.0), (0.515, 2.4), (2.0, 200.0), (0.0, 2.4), (1.75, 15.0), (2.5, 32.0), (25.0, 120.0)), 3.0
    ),
}
COLUMNS = (
    "kind",
    "number",
    "d_mm",
    "depth_ratio",
    "stiffness_ratio",
    "seat",
    "fat_kpa",
    "gland_ratio",
    "thickness_mm",
    "code",
    "amplitude",
    "sigma_mm",
    "sigma_x_mm",
    "sigma_y_mm",
    "median",
    "low",
    "high",
    "log_amplitude_beyond",
    "log_sigma_beyond",
    "leverage",
    "fat_mm",
    "outside",
)
Row = dict[str, Any]


def draw_scene(kind: str, number: int) -> Scene:
    """The one exam of a body."""
    chosen = KINDS[kind]
    seed = SEED + list(KINDS).index(kind)
    (exam,) = draw_mass(number, scans=1, seed=seed, bodies=chosen.bodies)
    scene = replace(exam, frame_rate_hz=FRAME_RATE_HZ)
    if chosen.flat:
        lump = scene.solid_lumps[0]
        height = lump.d_mm * float(np.random.default_rng([seed, number, 1]).uniform(0.35, 0.75))
        scene = replace(scene, solid_lumps=(replace(lump, height_mm=height),))
    return scene


def as_bump(scene: Scene, shown: Row) -> Scene:
    """The same exam of a Gaussian on an even pressure, as the body's map showed it."""
    lump = scene.solid_lumps[0]
    bump = Lump(lump.x_mm, lump.y_mm, shown["amplitude"], shown["sigma_x_mm"], shown["sigma_y_mm"], 0.0, lump.d_mm)
    return replace(scene, body=None, solid_lumps=(), lumps=(bump,))


@cache
def shipped() -> BodyCalibration:
    """The calibration that `estimate` takes if nothing is said."""
    path = size_calibration_path("solid")
    assert path is not None
    calibration = read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    return calibration


def measure(scene: Scene) -> Row:
    """What a patient's path makes of a scene, with a size wherever a lump is found."""
    try:
        tactile_map = build_map(simulate(scene, rng=np.random.default_rng(scene.seed)).scan)
        return sized(tactile_map, scene.seed)
    except TactileBayesError as error:
        return {"code": f"error: {error}"}


def sized(tactile_map: TactileMap, seed: int) -> Row:
    """Amplitude, widths and size of a map, and how far it lies outside the calibration's range."""
    rng = np.random.default_rng([seed, 1])
    options = EstimateOptions(method="laplace", fit=FitOptions("free", 20.0, "auto", None, "field"))
    found = estimate_map(tactile_map, calibration=None, options=options, rng=rng)
    posterior = found.map_posterior
    if posterior is None:
        return {"code": found.code}
    calibration = calibration_for(tactile_map, shipped())
    assert isinstance(calibration, BodyCalibration)
    draws = ShapeDraws.of(posterior.amplitude, posterior.sigma_x_mm, posterior.sigma_y_mm, posterior.angle_rad)
    size = pooled_size([draws], calibration=calibration, priors=SizePriors(), rng=rng)
    low, median, high = np.nanquantile(size.max_size_mm, [0.025, 0.5, 0.975])
    amplitude, sigma_x, sigma_y = (
        float(np.median(v)) for v in (posterior.amplitude, posterior.sigma_x_mm, posterior.sigma_y_mm)
    )
    sigma = float(np.sqrt(sigma_x * sigma_y))
    terms = calibration.terms(np.log(np.array(amplitude)), np.log(np.array(sigma)))
    return {
        "code": "size",
        "amplitude": amplitude,
        "sigma_mm": sigma,
        "sigma_x_mm": sigma_x,
        "sigma_y_mm": sigma_y,
        "median": float(median),
        "low": float(low),
        "high": float(high),
        "log_amplitude_beyond": beyond(amplitude, calibration.domain["amplitude"]),
        "log_sigma_beyond": beyond(sigma, calibration.domain["sigma_mm"]),
        "leverage": float(terms @ calibration.information_inverse @ terms) / calibration.most_leverage,
        "fat_mm": calibration.fat_mm,
        "outside": " and ".join(calibration.outside(amplitude, sigma)),
    }


def beyond(value: float, ends: tuple[float, float]) -> float:
    """By how much ln(value) lies above (positive) or below (negative) a range; 0 inside it."""
    return float(np.log(value / np.clip(value, *ends)))


def rows_of(job: tuple[str, int]) -> list[Row]:
    """The row of one body; a body inside the range has a second one, of the bump that looks like it."""
    kind, number = job
    scene = draw_scene(kind, number)
    lump, body = scene.solid_lumps[0], scene.body
    assert body is not None
    what: Row = {
        "number": number,
        "d_mm": lump.d_mm,
        "depth_ratio": lump.depth_ratio,
        "stiffness_ratio": lump.stiffness_ratio,
        "seat": lump.seat,
        "fat_kpa": body.fat_kpa,
        "gland_ratio": body.gland_ratio,
        "thickness_mm": body.thickness_mm,
    }
    found = measure(scene)
    rows = [{"kind": kind, **what, **found}]
    if kind == "inside" and found["code"] == "size":
        rows.append({"kind": "bump", **what, **measure(as_bump(scene, found))})
    return rows


def run(path: Path, *, bodies: int, workers: int) -> None:
    """Simulate what `path` does not hold yet."""
    done = {(row["kind"], int(row["number"])) for row in read(path)} if path.exists() else set()
    jobs = [(kind, number) for kind, how in KINDS.items() for number in range(round(bodies * how.share))]
    jobs = sorted((job for job in jobs if job not in done), key=lambda job: job[1])
    with path.open("a", newline="") as file, ProcessPoolExecutor(workers) as pool:
        writer = csv.DictWriter(file, COLUMNS)
        if not done:
            writer.writeheader()
        for rows in pool.map(rows_of, jobs):
            writer.writerows(rows)
            file.flush()


def read(path: Path) -> list[Row]:
    """The rows as text."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def table(path: Path) -> list[str]:
    """Lines of the report."""
    rows = read(path)
    sizes = [row for row in rows if row["code"] == "size"]
    groups: list[tuple[str, Callable[[Row], bool]]] = [
        ("inside the range", lambda row: not row["outside"]),
        ("outside the range", lambda row: bool(row["outside"])),
        ("  amplitude too low", lambda row: float(row["log_amplitude_beyond"]) < 0),
        ("  amplitude too high", lambda row: float(row["log_amplitude_beyond"]) > 0),
        ("  width too small", lambda row: float(row["log_sigma_beyond"]) < 0),
        ("  width too large", lambda row: float(row["log_sigma_beyond"]) > 0),
        *((f"  pair, leverage {low:g} to {high:g}", _leverage(low, high)) for low, high in LEVERAGES),
    ]
    lines = [f"{'':28}{'maps':>6}{'MAE %':>8}{'bias %':>8}{'worst %':>9}{'covered':>12}"]
    lines += [_line(name, [row for row in sizes if fits(row) and row["kind"] != "bump"]) for name, fits in groups]
    for kind in (*KINDS, "bump"):
        of_kind = [row for row in sizes if row["kind"] == kind]
        sound = [row for row in of_kind if not row["outside"]]
        none = sum(row["kind"] == kind and row["code"] != "size" for row in rows)
        lines.append(_line(f"{kind}, inside", sound) + f"   ({none} maps without a lump)")
        lines.append(_line(f"{kind}, outside", [row for row in of_kind if row["outside"]]))
    return lines


def unlike_depths(path: Path) -> list[str]:
    """Lines on the maps that no body of the table looks like at the depth of fat that was told."""
    rows = [row for row in read(path) if row["code"] == "size" and row["fat_mm"] and float(row["leverage"]) > 1]
    anew = [row | without_depth(row) for row in rows]
    lines = [_line("depth used", rows), _line("depth not used, as stated", anew)]
    return lines + [_line(f"  {row['kind']}, {float(row['d_mm']):.1f} mm", [row]) for row in anew]


def without_depth(row: Row) -> Row:
    """The size of a row's amplitude and widths, known to 2 %, by the calibration for any depth."""
    rng = np.random.default_rng(1)
    names = ("amplitude", "sigma_x_mm", "sigma_y_mm")
    draws = (float(row[name]) * np.exp(0.02 * rng.standard_normal(DRAWS)) for name in names)
    maps = [ShapeDraws.of(*draws, np.zeros(DRAWS))]
    size = pooled_size(maps, calibration=shipped().at_fat([None]), priors=SizePriors(), rng=rng)
    low, median, high = np.nanquantile(size.max_size_mm, [0.025, 0.5, 0.975])
    return {"median": median, "low": low, "high": high}


def eq6(path: Path) -> list[str]:
    """Lines on Eq 6 beyond the table it was learned from, one a phantom, and how many are covered."""
    whole = size_table(read_table(path, "size_table.table.json"))
    lines = []
    for name, (low, high) in {"amplitude": (0.06, 1.0), "sigma_x_mm": (2.5, 6.0)}.items():
        values = np.asarray(getattr(whole, name))
        inside = (values >= low) & (values <= high)
        columns = {name: getattr(whole, name) for name in whole.__struct_fields__ if name != "cases"}
        kept = SizeTable(**{column: None if v is None else v[inside] for column, v in columns.items()})
        learned = learn_size_calibration(
            kept, recipe=Recipe("mean", "fixed", 20.0, declared=True), rng=np.random.default_rng(3)
        )
        for i in np.flatnonzero(~inside):
            times = values[i] / (high if values[i] > high else low)
            lines.append(_beyond_eq6(learned, whole, int(i), f"{name} {times:.2f}"))
    return lines


def _beyond_eq6(learned: SizeCalibration, table: SizeTable, row: int, name: str) -> str:
    shown = (table.amplitude[row], table.sigma_x_mm[row], np.asarray(table.sigma_y_mm)[row], 0.0)
    draws = (np.full((1, DRAWS), value) for value in shown)
    size = push_sizes(*draws, calibration=learned, rng=np.random.default_rng(row))
    low, median, high = np.nanquantile(size.max_size_mm, [0.025, 0.5, 0.975])
    return _line(f"{name} times the end", [{"d_mm": table.d_mm[row], "median": median, "low": low, "high": high}])


DRAWS = 4000
LEVERAGES = ((1.0, 1.5), (1.5, 3.0), (3.0, 10.0), (10.0, 1e9))


def _leverage(low: float, high: float) -> Callable[[Row], bool]:
    """Of maps whose amplitude and width lie inside their own ranges."""

    def fits(row: Row) -> bool:
        boxed = float(row["log_amplitude_beyond"]) == 0 == float(row["log_sigma_beyond"])
        return boxed and low < float(row["leverage"]) <= high

    return fits


def _line(name: str, rows: Sequence[Row]) -> str:
    if not rows:
        return f"{name:28}{0:>6}"
    true, median, low, high = (np.array([float(row[n]) for row in rows]) for n in ("d_mm", "median", "low", "high"))
    error = 100 * (median / true - 1)
    held = int(((low <= true) & (true <= high)).sum())
    covered = f"{held} of {len(rows)}"
    figures = f"{np.abs(error).mean():>8.1f}{error.mean():>+8.1f}{error[np.abs(error).argmax()]:>+9.0f}"
    return f"{name:28}{len(rows):>6}{figures}{covered:>12}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["simulate", "table", "eq6"])
    parser.add_argument("rows", type=Path)
    parser.add_argument("--bodies", type=int, default=8)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    if given.step == "simulate":
        run(given.rows, bodies=given.bodies, workers=given.workers)
    print("\n".join(eq6(given.rows) if given.step == "eq6" else [*table(given.rows), "", *unlike_depths(given.rows)]))
