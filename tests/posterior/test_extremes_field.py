"""Extremes under correlated errors, the default, as a table: what each method answers to a map that nobody ordered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_scans import shared_scan
from plain_reports import full_text
from posterior_maps import bump_values, grid_map

from tactile_bayes.declarations import names_of, replace
from tactile_bayes.errors import UsageError
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.scans import Scan
from tests.posterior.test_extremes import NOISE, NOTHING, few, float32, unknown_level, without_a_quadrant

FIELD = SamplerSettings(background="free", noise="field")
SLOW = [pytest.param(method, marks=pytest.mark.slow) for method in ("laplace", "ensemble")]
METHOD = pytest.mark.parametrize("method", ["importance", *SLOW])
ROUND = {"sigma_x": 5.0, "sigma_y": 5.0}


def counted(count: np.ndarray | int) -> TactileMap:
    """Errors as large as the counts make them, half from counting."""
    spread = NOISE * (0.5 + 0.5 * np.sqrt(40.0 / np.broadcast_to(count, NOISE.shape)))
    return grid_map(bump_values() + np.clip(spread, -0.1, 0.1), count=count, variance=0.04 * 0.02**2 * 40)


COUNTS = np.geomspace(1, 1e6, 51 * 51).astype(np.int64).reshape(51, 51)
# name: map, (sigma_x, sigma_y), relative tolerance
FOUND = {
    "amplitude 1e-6": (unknown_level(5 + 1e-6 * (bump_values(amplitude=1.0) + NOISE)), (6.0, 4.5), 0.05),
    "amplitude 1e6": (unknown_level(1e6 * (bump_values(amplitude=1.0) + NOISE)), (6.0, 4.5), 0.05),
    "offset 1e6": (unknown_level(1e6 + bump_values() + NOISE), (6.0, 4.5), 0.1),
    "float32": (float32(), (6.0, 4.5), 0.1),
    "no noise": (grid_map(bump_values()), (6.0, 4.5), 1e-3),
    "noise 1e-9": (grid_map(bump_values() + 1e-9 * NOISE / 0.02), (6.0, 4.5), 1e-3),
    "no noise, exactly round": (grid_map(bump_values(**ROUND)), (5.0, 5.0), 1e-3),
    "exactly round": (grid_map(bump_values(**ROUND) + NOISE), (5.0, 5.0), 0.1),
    "a quadrant missing": (without_a_quadrant(), (6.0, 4.5), 0.15),
    "one reading a cell": (counted(1), (6.0, 4.5), 0.15),
    "a million readings a cell": (counted(10**6), (6.0, 4.5), 0.1),
    "counts from 1 to a million": (counted(COUNTS), (6.0, 4.5), 0.2),
    "long but no ridge": (grid_map(bump_values(sigma_x=9.0, sigma_y=3.0) + NOISE), (9.0, 3.0), 0.1),
}


def answer(tactile_map: TactileMap, method: str, fit: SamplerSettings = FIELD) -> Estimate:
    options = replace(fit, method=method)
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert "nan" not in full_text(found, tactile_map).lower()
    return found


HELD_ELSEWHERE = ("a depression", "over the edge")  # by tests of detection and of the search


@METHOD
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name in HELD_ELSEWHERE)) for name in NOTHING]
)
def test_no_number_where_there_is_nothing_to_measure(name: str, method: str) -> None:
    found = answer(NOTHING[name][0], method)
    assert found.status == "no_estimate"
    assert found.reason
    assert found.code
    assert found.map_posterior is None


@METHOD
@pytest.mark.parametrize("name", list(FOUND))
def test_a_sane_answer_where_there_is_a_lump(name: str, method: str) -> None:
    tactile_map, widths, tolerance = FOUND[name]
    found = answer(tactile_map, method)
    assert found.status == "estimate", found.reason
    posterior = found.map_posterior
    assert posterior is not None
    for one in names_of(posterior):
        assert np.isfinite(getattr(posterior, one)).all(), one
    medians = [np.median(posterior.sigma_x_mm), np.median(posterior.sigma_y_mm)]
    np.testing.assert_allclose(medians, widths, rtol=tolerance)


@pytest.mark.long_repeats
@METHOD
@pytest.mark.parametrize("scene", ["round", "rotated"])
def test_a_round_bump_in_every_shape(scene: str, method: str) -> None:
    options = replace(FIELD, method=method, scene=scene)
    tactile_map = grid_map(bump_values(**ROUND) + NOISE)
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert found.map_posterior is not None
    np.testing.assert_allclose(np.median(found.map_posterior.sigma_x_mm), 5.0, rtol=0.1)


def test_the_papers_method_is_refused_under_a_field() -> None:
    for tactile_map in (few(3), grid_map(bump_values() + NOISE)):
        with pytest.raises(UsageError, match="optimise is the paper's least squares"):
            answer(tactile_map, "optimise")


def twice(scan: Scan) -> Scan:
    """Every frame read twice: the copies lie between the frames, at their places and with their readings."""
    frames = scan.frames
    time = np.repeat(frames.time_s, 2)
    time[1::2] += 1e-6
    names = [n for n in names_of(frames) if np.shape(getattr(frames, n))[:1] == (len(frames.time_s),) and n != "time_s"]
    doubled = {name: np.repeat(getattr(frames, name), 2, axis=0) for name in names}
    return replace(scan, frames=replace(frames, time_s=time, **doubled))


def interval_widths(tactile_map: TactileMap, *, noise: str = "field") -> np.ndarray:
    fit = FIELD if noise == "field" else SamplerSettings()
    options = replace(fit, method="importance", scene="ellipse" if noise == "field" else "auto")
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    posterior = found.map_posterior
    assert posterior is not None
    ends = [np.quantile(v, [0.025, 0.975]) for v in (posterior.sigma_x_mm, posterior.sigma_y_mm, posterior.amplitude)]
    return np.ptp(ends, axis=1)


@pytest.mark.long
def test_frames_that_are_there_twice_tell_nothing_new(shared_data: Path) -> None:
    scan = shared_scan(shared_data / "scans" / "s01_sphere15_hd1_clean.npz")
    once, doubled = build_map([scan]), build_map([twice(scan)])
    assert doubled.count.sum() == pytest.approx(2 * once.count.sum(), rel=0.01)
    np.testing.assert_allclose(interval_widths(doubled), interval_widths(once), rtol=0.05)
    # the negative control: believing each reading to be independent and its variance known halves the variance
    assert naive_sd(doubled) / naive_sd(once) < 0.75


def naive_sd(tactile_map: TactileMap) -> float:
    """SD of the mean of the cells about the lump, were readings independent."""
    inside = tactile_map.covered & np.isfinite(tactile_map.variance)
    return float(np.sqrt(np.sum(tactile_map.variance[inside] / tactile_map.count[inside]))) / int(inside.sum())
