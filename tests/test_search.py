"""Which rise of a map is taken for the lump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from posterior_maps import bump_map, bump_values, grid_map

from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior import search
from tactile_bayes.posterior.estimate import Estimate, EstimateOptions, estimate_map
from tactile_bayes.posterior.fit import FitOptions

FIELD = EstimateOptions(method="laplace", fit=FitOptions("free", 20.0, "off", None, "field"))


def noise(seed: int, n: int = 81) -> np.ndarray:
    return 0.01 * np.random.default_rng(seed).standard_normal((n, n))


def look(tactile_map: TactileMap, *, rotation: str = "off") -> Estimate:
    options = replace(FIELD, fit=replace(FIELD.fit, rotation=rotation))
    return estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))


def test_a_wide_rise_at_the_edge_is_no_lump_and_the_same_rise_inside_is_one():
    edge = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    inside = look(bump_map(noise=noise(1), half_mm=40.0, amplitude=0.3, x=0.0, y=0.0, sigma_x=10.0, sigma_y=10.0))
    assert edge.status == "no_estimate"
    assert inside.status == "estimate"


@pytest.mark.parametrize(("x", "status"), [(26.0, "no_estimate"), (20.0, "estimate")])
def test_a_wide_rise_must_be_seen_on_every_side(x: float, status: str) -> None:
    """The map ends 1.4 and 2 widths from its centre: 1.6 are asked for."""
    found = look(bump_map(noise=noise(3), half_mm=40.0, amplitude=0.3, x=x, y=0.0, sigma_x=10.0, sigma_y=10.0))
    assert found.status == status, found.reason


def test_a_lower_lump_is_found_behind_a_rise_at_the_edge():
    both = bump_values(half_mm=40.0, amplitude=0.5, x=36.0, y=0.0, sigma_x=10.0, sigma_y=10.0)
    both += bump_values(half_mm=40.0, amplitude=0.3, x=-12.0, y=3.0, sigma_x=4.0, sigma_y=4.0) - 1.0
    found = look(grid_map(both + noise(2)))
    assert found.status == "estimate"
    assert found.map_posterior is not None
    assert np.median(found.map_posterior.x_mm) == pytest.approx(-12.0, abs=1.0)
    assert np.median(found.map_posterior.sigma_x_mm) == pytest.approx(4.0, rel=0.15)
    assert any("rim" in candidate.fault or "ran away" in candidate.fault for candidate in found.candidates)


def beside_a_rib(amplitude: float) -> TactileMap:
    axis = np.arange(81) - 40.0
    along = np.zeros((1, 81)) + axis[:, None] - 17.0
    lump = bump_values(half_mm=40.0, amplitude=amplitude, x=0.0, y=0.0, sigma_x=5.0, sigma_y=5.0)
    return grid_map(lump + 0.25 * np.exp(-0.5 * (along / 5.0) ** 2) + noise(3))


def test_a_lump_beside_a_rib_is_found_from_close_by(monkeypatch: pytest.MonkeyPatch) -> None:
    found = look(beside_a_rib(0.3), rotation="auto")
    assert found.status == "estimate"
    assert found.map_posterior is not None
    assert found.scene is not None
    assert [one.name for one in found.scene.structures if one.used and one.place] == ["rib"]
    for centre in (found.map_posterior.x_mm, found.map_posterior.y_mm):
        assert np.median(centre) == pytest.approx(0.0, abs=0.5)
    for width in (found.map_posterior.sigma_x_mm, found.map_posterior.sigma_y_mm):
        assert np.log(np.median(width) / 5.0) == pytest.approx(0.0, abs=3 * np.std(np.log(width)))
    assert look(beside_a_rib(0.0), rotation="auto").status == "no_estimate"
    # the control: from afar least squares grows over both
    monkeypatch.setattr(search, "_close_search", lambda *_: None)
    assert look(beside_a_rib(0.3), rotation="auto").status == "no_estimate"
