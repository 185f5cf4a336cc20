"""`estimate` under a noise field: what it gives, what it refuses, and that a recipe without one is held apart."""

from __future__ import annotations

import numpy as np
import pytest
from plain_calibration import RECIPE
from posterior_maps import TRUTH, bump_map, bump_values, correlated_field, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration

FIELD = SamplerSettings(method="importance", background="free", noise="field")


def errors(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 0.005 * rng.standard_normal((51, 51)) + 0.01 * correlated_field(rng, 51, length_cells=4.0)


def run(options: SamplerSettings = FIELD, calibration: SizeCalibration | None = None, **bump: float) -> Estimate:
    tactile_map = bump_map(noise=errors(), **bump)
    return estimate_map(tactile_map, calibration=calibration, options=options, rng=np.random.default_rng(1))


def calibration(noise: str) -> SizeCalibration:
    axis = AxisCalibration(
        np.array([[3.0, -1.0, 0.8, -0.24, 0.2, 0.3]]),
        0.3,
        {"amplitude": (0.02, 4.0), "sigma_mm": (1.4, 12.0), "d_mm": (5.0, 25.0)},
    )
    return SizeCalibration(axis, axis, 0.8, replace(RECIPE, background="free", noise=noise))


@pytest.mark.parametrize("method", ["laplace", "importance", pytest.param("ensemble", marks=pytest.mark.slow)])
def test_every_method_recovers_the_bump(method: str) -> None:
    found = run(replace(FIELD, method=method))
    assert found.status == "estimate"
    posterior = found.map_posterior
    assert posterior is not None
    for name, truth in (
        ("amplitude", TRUTH["amplitude"]),
        ("sigma_x_mm", TRUTH["sigma_x"]),
        ("sigma_y_mm", TRUTH["sigma_y"]),
        ("x_mm", TRUTH["x"]),
        ("y_mm", TRUTH["y"]),
    ):
        draws = getattr(posterior, name)
        assert abs(np.median(draws) - truth) < 4.0 * draws.std(), name
        assert draws.std() < 0.2 * max(abs(truth), 3.0), name
    assert found.diagnostics["noise"] == "field"
    assert found.diagnostics["method"] == method


@pytest.mark.long
def test_a_lifted_level_beside_the_lump_does_not_narrow_it() -> None:
    """A neighbour that lowers the level by a tenth: least squares on a fixed level loses a third of the width."""
    values = bump_values() - 0.1 + 0.3 * errors(2)
    tactile_map = grid_map(values)
    free = estimate_map(tactile_map, calibration=None, options=FIELD, rng=np.random.default_rng(1))
    fixed = estimate_map(
        tactile_map, calibration=None, options=SamplerSettings(method="laplace"), rng=np.random.default_rng(1)
    )
    assert free.map_posterior is not None
    assert fixed.map_posterior is not None
    assert np.median(free.map_posterior.sigma_x_mm) == pytest.approx(TRUTH["sigma_x"], rel=0.06)
    assert np.median(fixed.map_posterior.sigma_x_mm) < 0.85 * TRUTH["sigma_x"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (replace(FIELD, method="optimise"), "optimise is the paper's least squares"),
        (replace(FIELD, background="fixed"), 'give background = "free"'),
    ],
)
def test_what_does_not_go_with_a_field_is_refused(options: SamplerSettings, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        run(options)


def test_a_calibration_learned_under_other_errors_is_refused() -> None:
    with pytest.raises(BadDataError, match=r"noise field \(the calibration: independent\)"):
        run(calibration=calibration("independent"))
    assert run(calibration=calibration("field")).size is not None


def test_an_empty_map_gets_no_number() -> None:
    found = run(amplitude=0.0)
    assert found.status == "no_estimate"
    assert found.map_posterior is None


def test_the_same_seed_gives_the_same_draws() -> None:
    one, two = run().map_posterior, run().map_posterior
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.sigma_x_mm, two.sigma_x_mm)
    np.testing.assert_array_equal(one.amplitude, two.amplitude)
