"""Is there a lump? What the collapsed posterior says: false lumps, and lumps that must be found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_scans import shared_scan
from posterior_maps import bump_map, correlated_field, grid_map

from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate

SIZE, NOISE = 51, 0.02
# "none" stops after the question: no draws are made
ONLY_ASK = SamplerSettings(scene="none", background="free", rotation="off", noise="field")
TILT = np.linspace(-0.05, 0.05, SIZE)[None, :] * np.ones((SIZE, 1))
KINDS = ("white", "tilt", "3 mm", "6 mm", "both")


def errors(kind: str, rng: np.random.Generator) -> np.ndarray:
    white = NOISE * rng.standard_normal((SIZE, SIZE))
    match kind:
        case "white":
            return white
        case "tilt":
            return white + TILT
        case "both":
            return 0.5 * white + NOISE * correlated_field(rng, SIZE, length_cells=4.0)
        case length:
            return NOISE * correlated_field(rng, SIZE, length_cells=float(length.split()[0]))


def probability(tactile_map: TactileMap) -> float:
    found: Estimate = estimate_map(tactile_map, calibration=None, options=ONLY_ASK, rng=np.random.default_rng(1))
    return 0.0 if found.detection is None else found.detection.probability


def false_lumps(kind: str, *, maps: int) -> int:
    rng = np.random.default_rng(31)
    return sum(probability(grid_map(1 + errors(kind, rng))) >= 0.95 for _ in range(maps))


@pytest.mark.long
def test_maps_without_a_lump_are_given_none() -> None:
    """10 maps: at a true rate of 2 % more than two come in 1 run of 1,000."""
    assert sum(false_lumps(kind, maps=2) for kind in KINDS) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_false_lumps_are_rarer_than_one_in_fifty(kind: str) -> None:
    """300 maps: the binomial error of 2 % is 0.8 %."""
    assert false_lumps(kind, maps=300) <= 6


def test_a_lump_on_such_maps_is_seen() -> None:
    """The negative control: with a lump of 0.2 the same errors do not come back empty."""
    rng = np.random.default_rng(32)
    assert sum(probability(bump_map(amplitude=0.2, noise=errors(kind, rng))) >= 0.95 for kind in KINDS) >= 4


def test_the_odds_rise_with_the_amplitude_and_fall_with_the_map() -> None:
    noise = errors("white", np.random.default_rng(33))
    odds = []
    for amplitude in (0.04, 0.08, 0.3):
        found = estimate_map(
            bump_map(amplitude=amplitude, noise=noise), calibration=None, options=ONLY_ASK, rng=np.random.default_rng(1)
        )
        assert found.detection is not None
        odds.append(found.detection.log_bayes_factor)
    assert odds == sorted(odds)
    values = np.ones((101, 101)) + np.pad(bump_map(amplitude=0.3, noise=noise).mean - 1, 25)
    larger = estimate_map(grid_map(values), calibration=None, options=ONLY_ASK, rng=np.random.default_rng(1))
    assert larger.detection is not None
    assert odds[-1] - larger.detection.log_bayes_factor == pytest.approx(np.log(101**2 / 51**2), abs=0.3)


def test_a_depression_is_no_lump() -> None:
    assert probability(bump_map(amplitude=-0.3, noise=errors("white", np.random.default_rng(34)))) < 0.95


@pytest.mark.long
def test_the_shared_scans_have_a_lump_or_none_as_simulated(shared_data: Path) -> None:
    found = {}
    for name in ("s08_no_mass", "s01_sphere15_hd1_clean", "s07_rib_edge"):
        found[name[:3]] = probability(build_map([shared_scan(shared_data / "scans" / f"{name}.npz")]))
    assert found["s08"] < 0.05
    assert min(found["s01"], found["s07"]) > 0.999
