"""Which rise of a map is taken for the lump."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import bump_map, bump_values, grid_map

from tactile_bayes.posterior.estimate import EstimateOptions, estimate_map
from tactile_bayes.posterior.fit import FitOptions

FIELD = EstimateOptions(method="laplace", fit=FitOptions("free", 20.0, "off", None, "field"))


def noise(seed: int, n: int = 81) -> np.ndarray:
    return 0.01 * np.random.default_rng(seed).standard_normal((n, n))


def look(tactile_map):
    return estimate_map(tactile_map, calibration=None, options=FIELD, rng=np.random.default_rng(1))


def test_a_wide_rise_at_the_edge_is_no_lump_and_the_same_rise_inside_is_one():
    edge = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    inside = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=0.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    assert edge.status == "no_estimate"
    assert inside.status == "estimate"


def test_a_lower_lump_is_found_behind_a_rise_at_the_edge():
    both = bump_values(half_mm=40.0, amplitude=0.5, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0)
    both += bump_values(half_mm=40.0, amplitude=0.3, x=-12.0, y=3.0, sigma_x=4.0, sigma_y=4.0) - 1.0
    found = look(grid_map(both + noise(2)))
    assert found.status == "estimate"
    assert found.map_posterior is not None
    assert np.median(found.map_posterior.x_mm) == pytest.approx(-12.0, abs=1.0)
    assert np.median(found.map_posterior.sigma_x_mm) == pytest.approx(4.0, rel=0.15)
    assert any("rim" in candidate.fault or "ran away" in candidate.fault for candidate in found.candidates)
