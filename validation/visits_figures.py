"""Figures of simulated visits: the law by which the body is shared, and how `compare` does on fresh ones."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement
from pathlib import Path

import numpy as np

from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.forward.scene import Scene
from tactile_bayes.geometry import FloatArray, apply, patient_from_base
from tactile_bayes.presets import DEFAULT_NORMALISE
from tactile_bayes.report.compare import verdict
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.draws import ShapeDraws
from tactile_bayes.size.pooling import SizePriors, pool_maps
from tactile_bayes.size.visits import (
    AMPLITUDE_LAW,
    SHARED_BODY,
    STRANGERS,
    AmplitudeLaw,
    JointSizes,
    PatientPlace,
    SharedBody,
    joint_sizes,
    place_shift,
)
from validation.visits import draw_visits

WHOLE = SharedBody(0.0, 1e6)
"""Everything shared: the body is the same whatever the growth."""
PRIORS = SizePriors(another_exam=None)
DRAWS = 2048
"""Means and variances are those of normals given the draws, so few draws will do."""
PLACES, PLACES_SEED = 4000, 20271117


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One body's visits.

    Parameters
    ----------
    log_d : (3,) array
        True ln d at the visits.
    place : (2,) array
        True place of the mass from the xiphoid, mm.
    maps
        Of each visit on which the lump was found.
    places
        Of each visit by the landmarks; None where no lump was found.
    """

    name: str
    log_d: FloatArray
    place: FloatArray
    maps: tuple[tuple[ShapeDraws, ...], ...]
    places: tuple[PatientPlace | None, ...]


def bodies_in(folder: Path) -> Iterator[Body]:
    """Bodies of a folder in the order of their numbers."""
    for path in sorted(folder.glob("body_*.npz")):
        with np.load(path) as file:
            found = {name: file[name] for name in file.files}
        visits = range(len(found["d_mm"]))
        exams = [[_exam(found, f"v{v}e{e}_") for e in range(2) if f"v{v}e{e}_q" in found] for v in visits]
        maps = tuple(tuple(shape for shape, _ in one) for one in exams)
        places = tuple(PatientPlace.mean_of([place for _, place in one]) for one in exams)
        yield Body(path.stem, np.log(found["d_mm"]), found["place"], maps, places)


def _exam(found: dict[str, FloatArray], head: str) -> tuple[ShapeDraws, PatientPlace]:
    drawn = [found[head + name].astype(np.float64) for name in ("log_amplitude", "log_width", "q", "r")]
    figures = {name: tuple(map(float, found[head + name])) for name in ("profile",) if head + name in found}
    labels = found[head + "labels"].astype(np.intp)
    shape = ShapeDraws(*drawn, turn_rad=float(found[head + "turn_rad"]), labels=labels, **figures)
    return shape, PatientPlace(found[head + "centre"], found[head + "centre_cov"])


def _calibration() -> BodyCalibration:
    path = size_calibration_path("solid")
    assert path is not None
    found = read_size_calibration(path)
    assert isinstance(found, BodyCalibration)
    return found


def _joint(
    maps: Sequence[Sequence[ShapeDraws]],
    calibration: BodyCalibration,
    law: SharedBody,
    amplitudes: AmplitudeLaw | None = None,
) -> JointSizes:
    rng = np.random.default_rng(1)
    return joint_sizes(
        maps, calibration=calibration, priors=PRIORS, rng=rng, law=law, amplitudes=amplitudes, number=DRAWS
    )


def law(folder: Path) -> None:
    """Print the law that makes the true changes most probable, and how far the errors depend on the growth."""
    calibration, rows = _calibration(), []
    for body in bodies_in(folder):
        felt = [v for v, maps in enumerate(body.maps) if maps]
        if len(felt) > 1:
            maps = [body.maps[v] for v in felt]
            mean, strangers = _joint(maps, calibration, STRANGERS).moments
            rows.append((body.log_d[felt], mean, strangers, _joint(maps, calibration, WHOLE).moments[1]))
    pairs = [(d, m, i, j) for d, m, *_ in rows for i, j in combinations(range(len(d)), 2)]
    print(f"{len(rows)} bodies, {len(pairs)} pairs of visits")
    grid = [(f, length) for f in np.linspace(0.0, 0.6, 31) for length in np.geomspace(0.1, 20.0, 30)]
    scores = np.array([sum(_log_density(row, SharedBody(f, length)) for row in rows) for f, length in grid])
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    best = grid[int(np.argmax(scores))]
    f_mean = float(sum(w * f for w, (f, _) in zip(weights, grid, strict=True)))
    l_mean = float(np.exp(sum(w * np.log(length) for w, (_, length) in zip(weights, grid, strict=True))))
    print(f"most probable: redrawn {best[0]:.3f}, length {best[1]:.2f}; posterior mean {f_mean:.3f}, {l_mean:.2f}")
    for name, one in (("strangers", STRANGERS), ("wholly shared", WHOLE), ("product", SHARED_BODY)):
        print(
            f"  ln likelihood of {name}: {sum(_log_density(row, one) for row in rows) - scores.max():.1f} to the best"
        )
    true = np.array([d[j] - d[i] for d, _, i, j in pairs])
    by_maps = np.array([m[j] - m[i] for _, m, i, j in pairs])
    slope = float(true @ by_maps / (by_maps @ by_maps))
    print(f"slope of the true change on that by the maps {slope:.3f}")
    still = np.abs(true) < 0.01
    for name, some in (("none", still), ("10 %", (np.abs(true) < 0.12) & ~still), ("more", np.abs(true) >= 0.12)):
        print(f"  growth {name}: SD of the error of the change {np.std(true[some] - by_maps[some]):.4f} ({some.sum()})")


def _log_density(row: tuple[FloatArray, FloatArray, FloatArray, FloatArray], one: SharedBody) -> float:
    """Log density of a body's true changes from the first visit under a law."""
    true, mean, strangers, whole = row
    correlation = one.correlation(mean) - np.eye(len(mean))
    covariance = strangers + correlation * (whole - strangers)
    contrasts = np.diff(np.eye(len(mean)), axis=0)
    spread, error = contrasts @ covariance @ contrasts.T, contrasts @ (true - mean)
    return float(-0.5 * (np.linalg.slogdet(spread)[1] + error @ np.linalg.solve(spread, error)))


@dataclass(frozen=True, slots=True)
class Judged:
    """One pair of visits, compared."""

    maps: int
    growth: float
    error: float
    sd: float
    held: bool
    verdict: str
    apart_sd: float


def judge(folder: Path) -> None:
    """Print false alarms, power, coverage and widths on pairs of visits, and how masses are told apart by place."""
    calibration, bodies = _calibration(), list(bodies_in(folder))
    for name, one, amplitudes in (
        ("product", SHARED_BODY, AMPLITUDE_LAW),
        ("sizes alone", SHARED_BODY, None),
        ("strangers", STRANGERS, None),
        ("wholly shared", WHOLE, None),
    ):
        rows = [row for body in bodies for row in _judged(body, calibration, one, amplitudes)]
        print(f"\n{name}: {len(bodies)} bodies, {sum(r.maps == 2 for r in rows)} pairs of two maps a visit")
        _print_pairs(rows, in_full=one is SHARED_BODY)
    _print_places(bodies)


def _judged(
    body: Body, calibration: BodyCalibration, one: SharedBody, amplitudes: AmplitudeLaw | None
) -> Iterator[Judged]:
    """Comparisons of a body's pairs of visits, with one map a visit and with two."""
    for count in (1, 2):
        alone = [_log_variance(maps[:count], calibration) if one is SHARED_BODY else np.nan for maps in body.maps]
        for i, j in combinations(range(len(body.maps)), 2):
            pair = [body.maps[i][:count], body.maps[j][:count]]
            if min(map(len, pair)) < count:
                continue
            change = _joint(pair, calibration, one, amplitudes).change(0, 1)
            q, true = change.log_summary(0.95), float(body.log_d[j] - body.log_d[i])
            held, separate = q.low <= true <= q.high, float(np.sqrt(alone[i] + alone[j]))
            yield Judged(count, true, q.median - true, change.log_sd, held, verdict(change), separate)


def _log_variance(maps: Sequence[ShapeDraws], calibration: BodyCalibration) -> float:
    """Variance of ln of the largest size by a visit's maps alone; NaN where they give no size."""
    if not maps:
        return np.nan
    pooled = pool_maps(maps, calibration=calibration, priors=PRIORS, rng=np.random.default_rng(1))
    return np.nan if pooled.size is None else float(np.nanvar(np.log(pooled.size.max_size_mm)))


def _print_pairs(rows: Sequence[Judged], *, in_full: bool) -> None:
    for count in (1, 2):
        some = [r for r in rows if r.maps == count]
        still = [r for r in some if abs(r.growth) < 0.01]
        alarms = [r.verdict != "no_change_shown" for r in still]
        rms, stated = (np.sqrt(np.mean(np.square(one))) for one in ([r.error for r in some], [r.sd for r in some]))
        held, scores = [r.held for r in some], [r.error / r.sd for r in some]
        print(
            f"  {count} map(s) a visit: false alarms {_share(alarms)}; 95 % intervals hold {_share(held)}; "
            f"standardised errors SD {np.std(scores):.2f}; errors rms {rms:.3f}, stated {stated:.3f}"
        )
        if in_full:
            ratio = np.array([r.sd / r.apart_sd for r in some])
            ratio = ratio[np.isfinite(ratio)]
            print(
                f"    width over that of two separate estimates: median {np.median(ratio):.2f}, mean {ratio.mean():.2f}"
            )
            _print_power(some)


def _print_power(rows: Sequence[Judged]) -> None:
    """Share of changes of each size that are called one, in the right direction."""
    for percent in (-20, 10, 20, 35):
        wanted = np.log1p(percent / 100)
        some = [r for r in rows if abs(r.growth - wanted) < 0.01]
        right = ["grown" if percent > 0 else "shrunk"] * len(some)
        found = [r.verdict for r in some]
        detected = [a == b for a, b in zip(found, right, strict=True)]
        wrong = sum(a not in (b, "no_change_shown") for a, b in zip(found, right, strict=True))
        held = _share([r.held for r in some])
        print(f"    {percent:+d} %: shown {_share(detected)}, in the wrong direction {wrong}; intervals hold {held}")


def amplitude(table: Path) -> None:
    """Print how ln a goes with a lump's size and a posture's depths over a population's bodies, and with its exams.

    By a regression on a full quadratic in the logs of size, depth of the lump and of the fat, moduli and thickness,
    and a full cubic in the first three.
    """
    with gzip.open(table, "rt", encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["normalise"] == DEFAULT_NORMALISE and r["detected"] == "true"]
    bodies: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        bodies.setdefault(row["body"], []).append(row)
    log_a = [np.log([float(r["amplitude"]) for r in exams]) for exams in bodies.values()]

    def of_body(name: str) -> FloatArray:
        return np.array([float(exams[0][name]) for exams in bodies.values()])

    d = of_body("d_mm")
    depth, moduli = of_body("depth_ratio") * d, [np.log(of_body(name)) for name in ("fat_kpa", "gland_ratio")]
    lengths = [np.log(one) for one in (d, depth, depth + of_body("seat") * d / 2)]
    x = np.column_stack([*lengths, 1.0 / of_body("stiffness_ratio"), *moduli, np.log(of_body("thickness_mm"))])
    centre, scale = x.mean(axis=0), x.std(axis=0)

    def terms(at: FloatArray) -> FloatArray:
        z = (at - centre) / scale
        pairs = combinations_with_replacement(range(z.shape[1]), 2)
        products = [*pairs, *combinations_with_replacement(range(3), 3)]
        return np.column_stack([np.ones(len(z)), z, *(np.prod(z[:, list(one)], axis=1) for one in products)])

    fitted = np.linalg.lstsq(terms(x), np.array([one.mean() for one in log_a]), rcond=None)[0]

    def slope(*per_log: FloatArray | float) -> FloatArray:
        step = 0.05 * np.column_stack([np.broadcast_to(one, len(x)) for one in per_log])
        return np.asarray((terms(x + step) - terms(x - step)) @ fitted / 0.1)

    half = 0.5 * d / depth
    for name, found in (
        ("size, the near face keeps its depth", slope(1, half, 0, 0, 0, 0, 0)),
        ("size, the centre does", slope(1, 0, 0, 0, 0, 0, 0)),
        ("size, the far face does", slope(1, -half, 0, 0, 0, 0, 0)),
        ("all depths", slope(0, 1, 1, 0, 0, 0, 1)),
    ):
        print(f"d ln a / d ln of {name}: {found.mean():.2f}, SD over {len(found)} bodies {found.std():.2f}")
    clear = [one for one in log_a if len(one) > 1 and one.mean() > np.log(0.4)]
    print(
        f"SD between exams of a body with a > 0.4: {np.sqrt(np.mean([one.var(ddof=1) for one in clear])):.3f} of ln a"
    )


def _print_places(bodies: Sequence[Body]) -> None:
    """Refusals by place: of pairs of visits of one mass, and of two masses of one breast."""
    right = [
        place_shift(one, other).doubtful
        for body in bodies
        for one, other in combinations(body.places, 2)
        if one is not None and other is not None
    ]
    print(f"\nplace, on the maps: of one mass refused {_share(right)}")
    drawn = [draw_visits(index, seed=PLACES_SEED) for index in range(PLACES)]
    places = [[_touched(scenes) for scenes in visits[:2]] for _, visits, _ in drawn]
    sizes = np.array([visits[0][0].solid_lumps[0].d_mm for _, visits, _ in drawn])
    true = np.array([place for *_, place in drawn])
    right = [place_shift(*pair).doubtful for pair in places]
    print(f"place, {PLACES} further bodies without their maps: of one mass refused {_share(right)}")
    wrong = np.array([place_shift(places[i - 1][0], places[i][1]).doubtful for i in range(PLACES)])
    beside = np.hypot(*(np.roll(true, 1, axis=0) - true).T) > (np.roll(sizes, 1) + sizes) / 2
    print(f"  of two masses anywhere in one breast refused {_share(wrong)}")
    print(f"  of those that do not overlap refused {_share(wrong[beside])}")


def _touched(scenes: Sequence[Scene]) -> PatientPlace:
    """Where a visit's landmarks put its mass; the error of the maps' centres, below 0.3 mm, is left out."""
    found = []
    for scene in scenes:
        marks, lump = scene.landmarks, scene.solid_lumps[0]
        notch, xiphoid = np.array(marks.sternal_notch_mm), np.array(marks.xiphoid_mm)
        frame = patient_from_base(notch, xiphoid, normal=np.array([0.0, 0.0, 1.0]))
        found.append(PatientPlace(apply(frame, np.array([lump.x_mm, lump.y_mm, 0.0]))[:2], 0.1**2 * np.eye(2)))
    place = PatientPlace.mean_of(found)
    assert place is not None
    return place


def _share(found: Sequence[bool] | FloatArray) -> str:
    return f"{sum(found)} of {len(found)} ({100 * np.mean(found):.1f} %)" if len(found) else "0 of 0"
