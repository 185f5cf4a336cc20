"""A ridge, as a rib makes, is no lump; a lump on or beside one is."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import grid_map

from tactile_bayes.posterior import correlated as field_estimate
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.options import SamplerSettings
from tactile_bayes.posterior.result import Estimate
from tests.posterior.correlated.test_selection import AXIS, bump, errors


def ridge(seed: int) -> np.ndarray:
    """0.1 to 0.3 high, sigma 5 mm, as long as the map, anywhere within 22 mm of its middle."""
    rng = np.random.default_rng([seed, 5])
    away, angle = rng.uniform(0.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
    distance = np.cos(angle) * AXIS + np.sin(angle) * AXIS[:, None] - away
    return rng.uniform(0.1, 0.3) * np.exp(-0.5 * (distance / 5.0) ** 2)


def estimate(values: np.ndarray) -> Estimate:
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    return estimate_map(grid_map(values), calibration=None, options=options, rng=np.random.default_rng(1))


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (6, 13))])
def test_a_ridge_alone_gets_no_number(seed: int) -> None:
    found = estimate(1.0 + ridge(seed) + errors(seed))
    assert found.status == "no_estimate"
    assert found.code == "ridge"
    assert "a ridge along" in found.reason
    assert found.probability is not None
    assert found.probability < 0.5


def test_it_would_get_one_if_only_noise_were_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control: on these maps nothing but the ridge's own evidence stands against a number."""
    monkeypatch.setattr(field_estimate, "ridge_instead", lambda *_: None)
    assert [estimate(1.0 + ridge(seed) + errors(seed)).status for seed in (6, 13)] == ["estimate", "estimate"]


def test_a_lump_on_a_ridge_is_found() -> None:
    """Half as high as the lump, through its centre."""
    crest = 0.15 * np.exp(-0.5 * ((AXIS[:, None] + 1.0) / 5.0) ** 2) * np.ones((1, len(AXIS)))
    found = estimate(bump() + crest + errors(5))
    assert found.status == "estimate", found.reason
    assert found.map_posterior is not None
    assert np.median(found.map_posterior.sigma_x_mm) == pytest.approx(5.0, rel=0.1)


def test_a_lump_beside_two_ridges_is_found() -> None:
    """14 mm from one and 10 mm from the other's foot: the model has one of them, the other is the noise field's."""
    rows = AXIS[:, None]
    ribs = 0.15 * (np.exp(-0.5 * ((rows - 20.0) / 4.0) ** 2) + np.exp(-0.5 * ((rows + 22.0) / 4.0) ** 2))
    found = estimate(bump() + ribs * np.ones((1, len(AXIS))) + errors(6))
    assert found.status == "estimate", found.reason
