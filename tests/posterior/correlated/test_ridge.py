"""A ridge, as a rib makes, is no lump; a lump on or beside one is."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.posterior import correlated as neighbours
from tactile_bayes.posterior.correlated import best_ridge, bump_beside_ridge
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.fit import fit_scene
from tactile_bayes.posterior.marginal import Scene
from tactile_bayes.posterior.result import Estimate
from tests.posterior.correlated.test_selection import AXIS, bump, choose, errors, rib


def ridge(seed: int) -> np.ndarray:
    """0.1 to 0.3 high, sigma 5 mm, as long as the map, anywhere within 22 mm of its middle."""
    rng = np.random.default_rng([seed, 5])
    away, angle = rng.uniform(0.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
    distance = np.cos(angle) * AXIS + np.sin(angle) * AXIS[:, None] - away
    return rng.uniform(0.1, 0.3) * np.exp(-0.5 * (distance / 5.0) ** 2)


def estimate(values: np.ndarray) -> Estimate:
    options = SamplerSettings(method="laplace", draws=400, background="free", noise="field")
    return estimate_map(grid_map(values), calibration=None, options=options, rng=np.random.default_rng(1))


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (6, 13))])
def test_a_ridge_alone_gets_no_number(seed: int) -> None:
    found = estimate(1.0 + ridge(seed) + errors(seed))
    assert found.status == "no_estimate"
    assert found.code == "ridge"
    assert "a ridge along" in found.reason
    assert found.probability is not None
    assert found.probability < 0.5


@pytest.mark.long
def test_it_would_get_one_if_only_noise_were_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control: on these maps nothing but the ridge's own evidence stands against a number."""
    monkeypatch.setattr(neighbours, "best_ridge", lambda *_: None)
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


def test_a_ridge_clear_of_a_lump_does_not_stand_in_its_place() -> None:
    """A stripe that the strokes left, 18 mm from a faint lump, has more evidence than the lump: the map shows both."""
    choice = choose(bump(amplitude=0.15) + rib(y=17.0, amplitude=0.15, width=1.0) + errors(7))
    alone = replace(choice, fit=choice.plain)
    problem = choice.plain.target.problem
    stripe, through = (
        fit_scene(problem, Scene("ridge"), np.array([width, np.pi / 2.0, offset]))
        for width, offset in ((0.0, 18.0), (1.6, 0.0))
    )
    assert stripe.log_evidence > choice.plain.log_evidence + 3.0
    both = bump_beside_ridge(alone, stripe)
    assert both is not None
    assert both.log_evidence > stripe.log_evidence + 10.0
    assert bump_beside_ridge(alone, through) is None


def test_a_lump_is_not_held_against_itself_with_a_ridge() -> None:
    """The second lump of a ridge's scene once moved onto the lump that was asked about."""
    choice = choose(bump(amplitude=0.3) + rib(y=17.0, amplitude=0.15) + errors(7))
    problem, at = choice.plain.target.problem, np.array([[np.pi / 2.0, 18.0, np.log(5.0)]])
    moved = fit_scene(problem, Scene("ridge", extra="second lump"), np.array([1.6, np.pi / 2.0, 18.0, 2.0, 0.0, 1.6]))
    assert np.hypot(moved.mode[3] - 1.0, moved.mode[4] + 1.0) < 1.0
    found = best_ridge(replace(choice, fit=moved), at)
    assert found is not None
    assert found.log_evidence < moved.log_evidence - 20.0
