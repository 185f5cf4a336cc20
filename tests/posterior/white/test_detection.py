"""Is there a lump? False lumps on lump-free maps, and lumps that must be found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_scans import shared_scan
from posterior_maps import bump_map, correlated_field, find_bump, grid_map

import tactile_bayes
from tactile_bayes.declarations import replace
from tactile_bayes.files.instrument import read_scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.white import detect, fitted_candidates

SIZE = 51
NOISE = 0.02
FAST = SamplerSettings(method="optimise", rotation="off")
TILT = np.linspace(-0.05, 0.05, SIZE)[None, :] * np.ones((SIZE, 1))


def lump_free(kind: str, rng: np.random.Generator) -> np.ndarray:
    white = rng.standard_normal((SIZE, SIZE))
    match kind:
        case "white":
            return NOISE * white
        case "tilt":
            return NOISE * white + TILT
        case "3 mm":
            return NOISE * correlated_field(rng, SIZE, length_cells=3.0)
        case _:
            return NOISE * correlated_field(rng, SIZE, length_cells=6.0)


def run(values: np.ndarray) -> Estimate:
    return estimate_map(grid_map(values), calibration=None, options=FAST, rng=np.random.default_rng(1))


def false_lumps(kind: str, *, maps: int) -> int:
    rng = np.random.default_rng(21)
    return sum(run(1 + lump_free(kind, rng)).status == "estimate" for _ in range(maps))


KINDS = ("white", "tilt", "3 mm", "6 mm")


@pytest.mark.long
def test_maps_without_a_lump_are_given_none() -> None:
    """A map of each kind: a true rate of 2 % gives one in 1 run of 12. Hundreds are below."""
    assert sum(false_lumps(kind, maps=1) for kind in KINDS) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_false_lumps_are_rarer_than_one_in_fifty(kind: str) -> None:
    assert false_lumps(kind, maps=300) <= 6


def few_at_the_rim(rng: np.random.Generator) -> TactileMap:
    """Lump-free, with a tenth of the readings near two edges and errors that go with the root of their number.

    As where the strokes end: few frames reach the rim, and what a frame's readings share does not average out there.
    """
    size, edge = 41, np.minimum(np.arange(41), np.arange(41)[::-1])[:, None]
    count = np.where(edge >= 9, 100, 10) * np.ones((size, size), dtype=np.int64)
    errors = correlated_field(rng, size, length_cells=12.0) + 0.5 * rng.standard_normal((size, size))
    return replace(grid_map(1 + 0.003 * errors * np.sqrt(100 / count)), count=count)


@pytest.mark.long
def test_few_readings_at_the_rim_make_no_lump() -> None:
    """A negative control: the same maps, whose counts say that the rim was read as often, do show lumps."""
    rng = np.random.default_rng(31)
    maps = [few_at_the_rim(rng) for _ in range(4)]
    free = SamplerSettings(background="free", rotation="off")

    def most(tactile_map: TactileMap) -> float:
        places = [
            one.fit for one in list(fitted_candidates(tactile_map, free))[:4] if not one.fault and one.fit is not None
        ]
        found = [detect(tactile_map, fit) for fit in places]
        return max((one.probability for one in found), default=0.0)

    assert max(map(most, maps)) < 0.95
    assert max(most(replace(one, count=np.full_like(one.count, 100))) for one in maps) >= 0.95


@pytest.mark.long
@pytest.mark.parametrize("scan", ["empty.toml", "s08_no_mass.npz"])
def test_an_empty_scan_gets_no_size_by_a_solid_study(scan: str, request: pytest.FixtureRequest) -> None:
    """With the recipe of `study --model solid`: a flat field, frame means, a free level and independent errors."""
    if scan == "empty.toml":
        scene = read_scene(Path(tactile_bayes.__file__).parent / "demo" / scan)
        empty = simulate(scene, rng=np.random.default_rng(scene.seed)).scan
    else:
        empty = shared_scan(request.getfixturevalue("shared_data") / "scans" / scan)
    tactile_map = build_map([empty], normalise="mean", flat_field=True)
    options = SamplerSettings(method="laplace", background="free")
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert found.status == "no_estimate"


@pytest.mark.long
def test_a_lump_on_each_of_those_maps_is_seen() -> None:
    """The negative control: the same maps with a lump of 0.2 do not come back empty."""
    rng = np.random.default_rng(22)
    kinds = ["white", "tilt", "3 mm", "6 mm"] * 5
    seen = [run(bump_map(amplitude=0.2).mean + lump_free(kind, rng)).status == "estimate" for kind in kinds]
    assert sum(seen) >= 19


def test_the_probability_rises_with_the_amplitude() -> None:
    noise = lump_free("white", np.random.default_rng(23))
    factors = []
    for amplitude in (0.01, 0.02, 0.04, 0.3):
        tactile_map = bump_map(amplitude=amplitude, noise=noise)
        found = find_bump(tactile_map, SamplerSettings(rotation="off", centre_mm=(1.0, -1.0)))[-1].fit
        assert found is not None
        factors.append(detect(tactile_map, found).log_bayes_factor)
    assert factors == sorted(factors)
    assert factors[0] < np.log(0.95 / 0.05) < factors[2]


def test_a_larger_map_asks_for_stronger_evidence() -> None:
    """A search over more places finds more chance bumps: the odds fall with the area, all else alike."""
    rng = np.random.default_rng(24)
    noise = NOISE * rng.standard_normal((201, 201))
    wide = bump_map(half_mm=100, amplitude=0.1, x=0.0, y=0.0, noise=noise)
    cut = slice(48, 153)  # wider than the disc of blocks that the evidence looks at
    small = replace(
        wide,
        mean=wide.mean[cut, cut],
        variance=wide.variance[cut, cut],
        count=wide.count[cut, cut],
        x_mm=wide.x_mm[cut],
        y_mm=wide.y_mm[cut],
    )
    factor = []
    for tactile_map in (wide, small):
        found = find_bump(tactile_map, SamplerSettings(rotation="off", centre_mm=(1.0, -1.0), fit_radius_mm=15.0))[
            -1
        ].fit
        assert found is not None
        answer = detect(tactile_map, found)
        factor.append(answer.log_bayes_factor)
    assert factor[1] - factor[0] == pytest.approx(np.log(201**2 / 105**2), abs=0.2)


def test_a_depression_is_no_lump() -> None:
    tactile_map = bump_map(amplitude=-0.3)
    found = find_bump(tactile_map, SamplerSettings(rotation="off", centre_mm=(1.0, -1.0)))[-1].fit
    assert found is not None
    answer = detect(tactile_map, found)
    assert answer.probability == 0.0


@pytest.mark.long
def test_the_simulated_scan_without_a_mass_has_no_lump_and_those_with_one_do(shared_data: Path) -> None:
    statuses = {}
    for name in ("s08_no_mass", "s01_sphere15_hd1_clean", "s11_resting15_hd1"):
        tactile_map = build_map([shared_scan(shared_data / "scans" / f"{name}.npz")])
        found = estimate_map(tactile_map, calibration=None, options=FAST, rng=np.random.default_rng(1))
        statuses[name[:3]] = (found.status, bool(found.reason))
    assert statuses["s08"] == ("no_estimate", True)
    assert statuses["s01"][0] == statuses["s11"][0] == "estimate"
