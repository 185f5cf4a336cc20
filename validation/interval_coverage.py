"""How often the intervals of `estimate` hold, on maps that its own model did not make.

    python -m validation interval_coverage widths [--maps 400] [--workers 2]
    python -m validation interval_coverage sizes [--masses 140] [--bodies population|trial] [--workers 2] [-o ROWS]

`widths`: sigma_x and sigma_y of maps with a known bump under independent errors, under fields with exponential
correlation (drawn by the covariance's Cholesky factor, not by the model's cosines), of a bump that is no Gaussian (the
truth is the nearest Gaussian, under the row's errors or by plain squares), and of scans by a simulated head, whose
truth is the bump's own. Where frames were divided by their means, a map's bump has other widths than the field's, and
the truth is what the same estimate says of the same scan without sensor and tracker errors. A narrow bump under strong
correlated errors calls for a finer field than others. The negative controls: the model of independent errors without
its inflation, on maps with a field; the coarse field for the narrow bump; the head's maps without their figures of
the frames' places; and maps whose level is not known, with that level held at the map's median. Such maps are grids in
another unit and scans mapped without normalising, fitted as `estimate` does where nothing is said.

`sizes`: the whole path. Each mass is scanned three times by the solid model, each scan mapped and sized, alone and
pooled, with the shipped calibration. `population` draws bodies from the prior that the calibration was learned over,
with another seed; `trial` draws those of `validation.own_trial`, which differ from it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from tactile_bayes.declarations import replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.forward.scene import Lump, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.posterior.bump import cell_mean_gaussian
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.white import default_errors, fit_bump
from tactile_bayes.presets import FIELD_COSINES, POSE_NOISE
from tactile_bayes.size.draws import SizePosterior
from tactile_bayes.studies.population import Population
from validation.common import Row, Table, add_row, parser, rows_in, share
from validation.own_trial import draw_mass_like_trial

NOMINAL = 0.9
AXIS = np.arange(-28.0, 28.5)
AMPLITUDE, SIGMA = 0.3, (4.5, 5.5)
COUNT = 40
SEED = 20261122
FIELD_3, FLATTER = "and a field of 0.01, 3 mm", "a super-Gaussian bump, exponent 2.5, field of 3 mm"
KINDS: dict[str, dict[str, float]] = {
    "independent, 0.01": {"white": 0.01},
    FIELD_3: {"white": 0.01, "field": 0.01, "length_mm": 3.0},
    "and a field of 0.01, 6 mm": {"white": 0.01, "field": 0.01, "length_mm": 6.0},
    "0.002 and a field of 0.02, 4 mm": {"white": 0.002, "field": 0.02, "length_mm": 4.0},
    FLATTER: {"white": 0.01, "field": 0.01, "length_mm": 3.0, "exponent": 1.25},
    "the same, exponent 3": {"white": 0.01, "field": 0.01, "length_mm": 3.0, "exponent": 1.5},
}
BY_SQUARES = "exponent 2.5, truth by plain squares"
CONTROL = "control: independent errors assumed, field of 3 mm"
UNTOLD = "control: simulated head, tracker positions taken for exact"
MEANS = "simulated head, frames divided by their means (`--normalise mean`)"
HEADS = {
    "simulated head, frames shared": AMPLITUDE,
    "simulated head, lump of 0.05": 0.05,
    UNTOLD: AMPLITUDE,
    MEANS: AMPLITUDE,
}
NARROW = {
    "a narrow bump, 2 by 2.4 mm; 0.002 and a field of 0.03, 3 mm": None,
    "control: the same with the coarse noise field, 18 basis functions": FIELD_COSINES,
}
NARROW_SIGMA = (2.0, 2.4)
NARROW_KIND = {"white": 0.002, "field": 0.03, "length_mm": 3.0}
GRID_LEVELLESS = "a grid in another unit, level unknown (45 mm square), field of 3 mm"
SINGLE_LEVELLESS = "the same without counts and variances"
HEAD_LEVELLESS = "simulated head in kPa (`map --normalise none`)"
HELD = {
    "control: the grid's level fixed at its median": GRID_LEVELLESS,
    "control: the kPa map's level fixed at its median": HEAD_LEVELLESS,
}
LEVELLESS = (GRID_LEVELLESS, SINGLE_LEVELLESS, HEAD_LEVELLESS, *HELD)
UNIT, GRID_HALF_MM = 37.0, 22.0
"""What a value of 1 becomes in a grid of an unknown level, and how far it reaches."""
ROWS = (*KINDS, BY_SQUARES, *HEADS, CONTROL, *NARROW, *LEVELLESS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    words = parser(__name__, __doc__)
    words.add_argument("what", choices=["widths", "sizes"])
    words.add_argument("--maps", type=int, default=400, help="a row")
    words.add_argument("--only", type=int, action="append", choices=range(len(ROWS)), help="widths: this row")
    words.add_argument("--masses", type=int, default=140, help="three maps each")
    words.add_argument("--bodies", choices=["population", "trial"], default="population")
    words.add_argument("--workers", type=int, default=1)
    words.add_argument("-o", "--output", type=Path, help="sizes: keep the rows; an interrupted run goes on")
    words.add_argument("--keep", action="store_true", help="widths: keep the table for docs/coverage.md")
    given = words.parse_args(arguments)
    with ProcessPoolExecutor(given.workers) as pool:
        if given.what == "widths":
            table = widths(partial(pool.map, chunksize=4), given.maps, given.only or range(len(ROWS)))
            if given.keep:
                table.keep()
        else:
            sizes(pool.map, given.masses, given.bodies, given.output)
    return 0


# --- widths ---


def widths(run: Callable[..., Iterable[Any]], maps: int, rows: Iterable[int]) -> Table:
    """A row for each kind of error: the share of intervals of 90 % that hold."""
    table = Table("widths", "errors", "maps with an estimate", "sigma_x", "sigma_y")
    for kind in (ROWS[i] for i in rows):
        held = [one for one in run(partial(_one_map, kind), range(maps)) if one is not None]
        table.add(kind, str(len(held)), *(share([one[i] for one in held]) for i in (0, 1)))
    return table


def _one_map(kind: str, index: int) -> tuple[bool, bool] | None:
    rng = np.random.default_rng([SEED, index])
    options = SamplerSettings(
        background="free", rotation="off", noise="field", field_cosines=NARROW.get(kind) or "auto"
    )
    if kind in LEVELLESS:
        tactile_map, truth, options = _levelless(kind, index, rng)
        # independent errors with many of them shared leave importance sampling to chains of minutes
        options = replace(options, method="laplace") if options.noise == "independent" else options
    elif kind in HEADS:
        tactile_map, truth = _head_map(index, kind)
    elif kind in NARROW:
        tactile_map, truth = _grid_map(NARROW_KIND, rng, sigma=NARROW_SIGMA)
    else:
        same = {CONTROL: FIELD_3, BY_SQUARES: FLATTER}
        tactile_map, truth = _grid_map(KINDS[same.get(kind, kind)], rng, by_squares=kind == BY_SQUARES)
    if kind == CONTROL:
        return _held_by_independent(tactile_map, truth)
    found = estimate_map(tactile_map, calibration=None, options=options, rng=rng)
    if found.map_posterior is None:
        return None
    tail = (1 - NOMINAL) / 2
    x, y = (
        np.quantile(draws, [tail, 1 - tail])
        for draws in (found.map_posterior.sigma_x_mm, found.map_posterior.sigma_y_mm)
    )
    return bool(x[0] <= truth[0] <= x[1]), bool(y[0] <= truth[1] <= y[1])


def _levelless(
    kind: str, index: int, rng: np.random.Generator
) -> tuple[TactileMap, tuple[float, float], SamplerSettings]:
    """A map whose level is not known, its truth, and the fit that `estimate` takes by default, or took before."""
    row = HELD.get(kind, kind)
    if row == HEAD_LEVELLESS:
        tactile_map, truth = _head_map(index, row)
    else:
        known, truth = _grid_map(KINDS[FIELD_3], rng)
        recipe = replace(known.recipe, normalise="none")
        told = {"variance": UNIT**2 * known.variance}
        if row == SINGLE_LEVELLESS:
            told = {"variance": np.zeros_like(known.variance), "count": np.ones_like(known.count)}
        tactile_map = _cropped(replace(known, mean=UNIT * known.mean, recipe=recipe, background=None, **told))
    if kind in HELD:
        level = float(np.median(tactile_map.mean[tactile_map.covered]))
        divided = {"mean": tactile_map.mean / level, "variance": tactile_map.variance / level**2}
        return replace(tactile_map, background=1.0, **divided), truth, SamplerSettings(rotation="off")
    background, noise = default_errors(tactile_map)
    return tactile_map, truth, SamplerSettings(background=background, rotation="off", noise=noise)


def _cropped(tactile_map: TactileMap) -> TactileMap:
    """The middle of a map, `GRID_HALF_MM` on every side."""
    keep = np.abs(tactile_map.x_mm) <= GRID_HALF_MM
    cells = {name: getattr(tactile_map, name)[np.ix_(keep, keep)] for name in ("mean", "variance", "count")}
    return replace(tactile_map, x_mm=tactile_map.x_mm[keep], y_mm=tactile_map.y_mm[keep], **cells)


def _held_by_independent(tactile_map: TactileMap, truth: tuple[float, float]) -> tuple[bool, bool] | None:
    """Least squares with independent errors, as a textbook has it."""
    fit, _ = fit_bump(tactile_map, (0.0, 0.0), options=SamplerSettings(background="free", rotation="off"))
    if fit is None:
        return None
    p, q = (fit.bump.names.index(name) for name in ("p", "q"))
    covariance = fit.covariance / fit.errors.inflation
    held = []
    for sign, true in ((1.0, truth[0]), (-1.0, truth[1])):
        mean = fit.theta[p] + sign * fit.theta[q]
        sd = np.sqrt(covariance[p, p] + covariance[q, q] + 2 * sign * covariance[p, q])
        held.append(bool(abs(mean - np.log(true)) <= 1.645 * sd))
    return held[0], held[1]


def _grid_map(
    kind: dict[str, float],
    rng: np.random.Generator,
    *,
    by_squares: bool = False,
    sigma: tuple[float, float] = SIGMA,
) -> tuple[TactileMap, tuple[float, float]]:
    centre = rng.uniform(-2.0, 2.0, 2)
    exponent = kind.get("exponent", 1.0)
    bump = AMPLITUDE * _cell_means(centre, exponent, sigma)
    slope = 0.002 * rng.standard_normal(2)
    level = 1.0 + slope[0] * AXIS + slope[1] * AXIS[:, None]
    errors = kind["white"] * rng.standard_normal(bump.shape)
    if "field" in kind:
        errors = errors + kind["field"] * _field(kind["length_mm"], rng)
    variance = np.full(bump.shape, COUNT * kind["white"] ** 2)
    count = np.full(bump.shape, COUNT, dtype=np.int64)
    recipe = MapRecipe("grid", "mean", 1.0)
    tactile_map = TactileMap(level + bump + errors, variance, count, AXIS, AXIS, recipe=recipe, background=1.0)
    if exponent == 1.0:
        return tactile_map, sigma
    field, length_mm = (0.0, 1.0) if by_squares else (kind["field"], kind["length_mm"])
    return tactile_map, _nearest_widths(exponent, kind["white"], field, length_mm)


def _cell_means(centre: FloatArray, exponent: float, sigma: tuple[float, float] = SIGMA) -> FloatArray:
    """Of a bump exp(-(r^2/2)^exponent) of unit height, r in widths; 5 by 5 points a cell."""
    fine = (AXIS[:, None] + np.linspace(-0.4, 0.4, 5)).ravel()
    square = ((fine - centre[0]) / sigma[0]) ** 2 + ((fine[:, None] - centre[1]) / sigma[1]) ** 2
    n = len(AXIS)
    return np.asarray(np.exp(-((square / 2) ** exponent)).reshape(n, 5, n, 5).mean(axis=(1, 3)))


@cache
def _nearest_widths(exponent: float, white: float, field: float, length_mm: float) -> tuple[float, float]:
    """Widths of the Gaussian nearest to the bump under these errors: what the widths of a wrong model tend to.

    Nearest is by squares under the errors' own covariance, level and slope free (White 1982, Econometrica 50:1).
    """
    x, y = (one.ravel() for one in np.meshgrid(AXIS, AXIS))
    inside = np.hypot(x, y) <= 20.0
    x, y = x[inside], y[inside]
    away = np.hypot(x[:, None] - x, y[:, None] - y)
    factor = np.linalg.cholesky(field**2 * np.exp(-away / length_mm) + white**2 * np.eye(len(x)))
    bump = _cell_means(np.zeros(2), exponent).ravel()[inside]
    rest = np.linalg.solve(factor, np.stack([np.ones_like(x), x, y, bump], axis=1))

    def residual(log_widths: FloatArray) -> FloatArray:
        gaussian = cell_mean_gaussian(x, y, covariance_mm2=np.diag(np.exp(2 * log_widths)), cell_mm=1.0)
        columns = np.concatenate([rest[:, :3], np.linalg.solve(factor, gaussian)[:, None]], axis=1)
        return np.asarray(columns @ np.linalg.lstsq(columns, rest[:, 3], rcond=None)[0] - rest[:, 3])

    found = np.exp(least_squares(residual, np.log(SIGMA)).x)
    return float(found[0]), float(found[1])


def _field(length_mm: float, rng: np.random.Generator) -> FloatArray:
    factor = _factor(length_mm)
    return np.asarray(factor @ rng.standard_normal(len(factor))).reshape(len(AXIS), len(AXIS))


@cache
def _factor(length_mm: float) -> FloatArray:
    x, y = (one.ravel() for one in np.meshgrid(AXIS, AXIS))
    away = np.hypot(x[:, None] - x, y[:, None] - y)
    return np.linalg.cholesky(np.exp(-away / length_mm) + 1e-10 * np.eye(len(x)))


def _head_map(index: int, kind: str) -> tuple[TactileMap, tuple[float, float]]:
    """A scan's map, and the bump's widths, or those that the same scan's map shows without errors."""
    rng = np.random.default_rng([SEED, index, 1])
    noise = Noise(
        element_kpa=float(rng.uniform(0.05, 0.3)),
        tracker_mm=float(rng.uniform(0.1, 0.6)),
        tracker_deg=float(rng.uniform(0.05, 0.3)),
        gain_share=float(rng.uniform(0.002, 0.02)),
    )
    x, y = rng.uniform(-3.0, 3.0, 2)
    lump = Lump(
        x_mm=float(x), y_mm=float(y), amplitude=HEADS.get(kind, AMPLITUDE), sigma_x_mm=SIGMA[0], sigma_y_mm=SIGMA[1]
    )
    scene = Scene(seed=index, frame_rate_hz=100.0, lumps=(lump,), noise=noise, strokes=Strokes(yaw_deg=0.0))
    clean = replace(scene, noise=Noise(0.0, 0.0, 0.0, 0.0, 0.0), tracker=Tracker())

    def mapped(scene: Scene, normalise: str) -> TactileMap:
        return build_map(
            simulate(scene, rng=np.random.default_rng([SEED, index, 2])).scan, normalise=normalise, as_stated=True
        )

    if kind != MEANS:
        found = mapped(scene, "none" if kind == HEAD_LEVELLESS else "gain")
        told = {name: value for name, value in found.quality.items() if name not in POSE_NOISE}
        return (replace(found, quality=told) if kind == UNTOLD else found), SIGMA
    noisy, exact = mapped(scene, "mean"), mapped(clean, "mean")
    options = SamplerSettings(method="laplace", background="free", rotation="off", noise="field")
    truth = estimate_map(exact, calibration=None, options=options, rng=rng).map_posterior
    assert truth is not None
    return noisy, (float(np.median(truth.sigma_x_mm)), float(np.median(truth.sigma_y_mm)))


# --- sizes ---


def sizes(run: Callable[..., Iterable[Row]], masses: int, bodies: str, output: Path | None) -> None:
    """Draw, scan, map, size, pool, count."""
    kept = rows_in(output) if output else []
    rows = {row["index"]: row for row in kept if row["bodies"] == bodies}
    for row in run(partial(_size_mass, bodies), [i for i in range(masses) if i not in rows]):
        rows[row["index"]] = row
        if output:
            add_row(output, row)
        if sys.stderr.isatty():
            print(f"\r{len(rows)} of {masses}", end="", file=sys.stderr)
    report_sizes([rows[i] for i in sorted(rows)])


def report_sizes(rows: list[Row]) -> None:
    """Coverage and errors of single maps and of pooled masses."""
    single = [(row["d_mm"], one) for row in rows for one in row["single"] if one]
    pooled = [(row["d_mm"], row["pooled"]) for row in rows if row["pooled"]]
    maps = sum(len(row["single"]) for row in rows)
    print(f"{len(rows)} masses, {maps} maps; sized: {len(single)} maps, {len(pooled)} masses")
    for name, sized in (
        ("one map", single),
        ("one map, if exams differ by 15 %", [(true, one["another_exam"]) for true, one in single]),
        ("three maps pooled", pooled),
        ("three maps pooled, if exams may differ more", [(true, one["another_exam"]) for true, one in pooled]),
    ):
        if not sized:
            continue
        error = np.array([one["median"] / true - 1 for true, one in sized])
        score = [(np.log(true) - one["log_mean"]) / one["log_sd"] for true, one in sized]
        half = [(one["95"][1] - one["95"][0]) / 2 / one["median"] for _, one in sized]
        print(
            f"{name}: MAE {100 * np.mean(np.abs(error)):.1f} %, bias {100 * np.mean(error):+.1f} %, SD of standardised "
            f"errors {np.std(score):.2f}, median half width of 95 % intervals {100 * np.median(half):.0f} %"
        )
        for level in ("50", "90", "95"):
            inside = [one[level][0] <= true <= one[level][1] for true, one in sized]
            print(f"  nominal {level} %: {share(inside)}")


def _size_mass(bodies: str, index: int) -> Row:
    from tactile_bayes.files.size_json import DEFAULT, read_size_calibration, size_calibration_path
    from tactile_bayes.size.bodies import BodyCalibration
    from tactile_bayes.size.draws import ShapeDraws
    from tactile_bayes.size.pooling import SizePriors, pool_maps
    from tactile_bayes.size.terms import head_profile

    path = size_calibration_path(DEFAULT)
    assert path is not None
    calibration = read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    scenes = (
        Population(scans=3, seed=SEED).scenes(index)
        if bodies == "population"
        else draw_mass_like_trial(index, seed=SEED)
    )
    lump, shapes, single = scenes[0].solid_lumps[0], [], []
    for tactile_map, found in _estimates(scenes, calibration):
        if tactile_map is None or found is None or found.map_posterior is None or found.size is None:
            shapes.append(None)
            single.append(None)
            continue
        one = found.map_posterior
        shapes.append(ShapeDraws.of(one, profile=head_profile(tactile_map.quality)))
        single.append(_both(found.size))
    pooled = pool_maps(shapes, calibration=calibration, priors=SizePriors(), rng=np.random.default_rng([SEED, index]))
    return {
        "index": index,
        "bodies": bodies,
        "d_mm": max(lump.d_mm, lump.vertical_mm),
        "single": single,
        "pooled": None if pooled.size is None else _both(pooled.size),
    }


def _estimates(scenes: Sequence[Scene], calibration: Any) -> Iterator[tuple[TactileMap | None, Estimate | None]]:
    recipe = calibration.recipe
    options = SamplerSettings(background=recipe.background, fit_radius_mm=recipe.radius_mm, noise=recipe.noise)
    for scene in scenes:
        rng = np.random.default_rng([SEED, scene.seed])
        try:
            tactile_map = build_map(simulate(scene, rng=rng).scan, as_stated=True)
            yield tactile_map, estimate_map(tactile_map, calibration=calibration, options=options, rng=rng)
        except TactileBayesError:
            yield None, None


def _both(size: SizePosterior) -> dict[str, Any]:
    """What both intervals of the largest size say."""
    assert size.another_exam is not None
    return _intervals(size.max_size_mm) | {"another_exam": _intervals(size.another_exam.max_size_mm)}


def _intervals(draws: FloatArray) -> dict[str, Any]:
    ends = {f"{level}": list(np.nanquantile(draws, [0.5 - level / 200, 0.5 + level / 200])) for level in (50, 90, 95)}
    log = np.log(draws)
    moments = {"log_mean": float(np.nanmean(log)), "log_sd": float(np.nanstd(log))}
    return {"median": float(np.nanmedian(draws)), **moments, **ends}
