"""Bumps solved by what spans them: against each of them by itself."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.posterior import marginal as collapsed
from tactile_bayes.posterior.marginal import CollapsedTarget, LowRankBumps, Scene
from tests.posterior.correlated.test_marginal import START, TURNED, cells_of, noise, target_of

NEAR = 0.03
AROUND = {
    "a strong map's posterior": (NEAR, {}),
    "a weak map's posterior": (0.3, {}),
    "all that the prior allows": (1.5, {}),
    "much narrower than a cell": (NEAR, {"u": np.log(0.03), "v": np.log(0.02)}),
    "wider than the window": (NEAR, {"u": np.log(200.0), "v": np.log(90.0)}),
    "beyond the window's rim": (NEAR, {"x": 55.0, "u": 0.5}),
    "nowhere near it": (NEAR, {"x": 1e4}),
    "as wide as numbers go": (NEAR, {"u": 600.0}),
}


def points(scene: Scene, spread: float, at: dict[str, float], number: int = 600) -> np.ndarray:
    start = TURNED.converted(START, scene)
    for name, value in at.items():
        if name in scene.names:
            start[scene.names.index(name)] = value
    return start + spread * np.random.default_rng(5).standard_normal((number, len(start)))


def each_by_itself(
    target: CollapsedTarget, theta: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> tuple[np.ndarray, ...]:
    with monkeypatch.context() as patch:
        patch.setattr(collapsed, "LEAST_BUMPS", len(theta) + 1)
        return target.conditional(theta)


@pytest.mark.long_repeats
@pytest.mark.parametrize("scene", [Scene("round"), Scene("ellipse"), Scene("ellipse", tilt=False)])
@pytest.mark.parametrize(("spread", "at"), AROUND.values(), ids=AROUND)
@pytest.mark.parametrize("settled", [True, False])
def test_many_at_once_are_each_by_itself(
    scene: Scene, spread: float, at: dict[str, float], settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = target_of(cells_of(noise(0, field=0.01)), scene=scene)
    if settled:
        target.select_fields(TURNED.converted(START, scene))
    theta = points(scene, spread, at)
    exact = each_by_itself(target, theta, monkeypatch)
    held = np.isfinite(exact[0])
    found = target.conditional(theta)
    np.testing.assert_array_equal(np.isfinite(found[0]), held)
    np.testing.assert_allclose(found[0][held], exact[0][held], atol=2e-5)
    # a bump much wider than the window is a level and a tilt but for a part in ten thousand
    for one, other in zip(found[1:4], exact[1:4], strict=True):
        np.testing.assert_allclose(one[held], other[held], rtol=1e-4, atol=1e-7 * np.abs(other[held]).max(initial=0.0))


def test_a_strong_maps_bumps_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """600 bumps are sums of 25 to 90; where nothing spans them there is no basis."""
    target = target_of(cells_of(noise(0)), scene=Scene("ellipse"))

    def basis(spread: float, at: dict[str, float]) -> LowRankBumps | None:
        (bumps,) = target.scene.templates(points(target.scene, spread, at), target.window)
        return LowRankBumps.of(bumps, target.linear)

    few = basis(NEAR, {})
    assert few is not None
    assert 25 <= few.coefficients.shape[1] <= 90
    assert basis(1.5, {}) is None
    assert basis(NEAR, {"x": 1e4}) is None
    monkeypatch.setattr(collapsed, "MOST_PRODUCTS", 10)
    assert basis(NEAR, {}) is None


def test_a_coarser_basis_changes_the_density(monkeypatch: pytest.MonkeyPatch) -> None:
    """The negative control: a basis of what is above a thousandth is another density."""
    target = target_of(cells_of(noise(0, white=0.001)), scene=Scene("ellipse"))
    theta = points(target.scene, NEAR, {})
    exact = each_by_itself(target, theta, monkeypatch)[0]
    monkeypatch.setattr(collapsed, "DROPPED", 1e-3)
    assert np.nanmax(np.abs(target.conditional(theta)[0] - exact)[np.isfinite(exact)]) > 1e-3
