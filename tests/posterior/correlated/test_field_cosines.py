"""How finely the noise field is resolved: by the bump's width, and what a coarser one costs a narrow bump."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from posterior_maps import bump_map, correlated_field

from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.window import cosines_for
from tactile_bayes.presets import FIELD_COSINES, FINE_FIELD_COSINES

WINDOW = np.arange(-20.0, 21.0)
NARROW_MM = 2.0


def estimate(seed: int, *, sigma: float, cosines: int | None = None) -> Estimate:
    """A bump of one width under errors of which nearly all are correlated."""
    rng = np.random.default_rng([seed, 2])
    noise = 0.004 * rng.standard_normal((51, 51)) + 0.04 * correlated_field(rng, 51, length_cells=3.0)
    options = SamplerSettings(
        method="laplace", draws=1000, background="free", rotation="off", noise="field", field_cosines=cosines or "auto"
    )
    tactile_map = bump_map(noise=noise, amplitude=0.5, sigma_x=sigma, sigma_y=sigma)
    return estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))


def width_sd(found: Estimate) -> float:
    assert found.map_posterior is not None, found.reason
    return float(np.std(np.log(found.map_posterior.sigma_x_mm)))


def test_a_narrow_bump_or_a_wide_window_calls_for_more() -> None:
    """One cosine is a half wave over 1.3 windows; the shortest is to be 0.83 widths."""
    assert cosines_for(5.0, WINDOW) == FIELD_COSINES
    assert cosines_for(2.5, WINDOW) == np.ceil(52.0 / (0.83 * 2.5))
    assert cosines_for(5.0, 2.0 * WINDOW) == np.ceil(104.0 / (0.83 * 5.0))
    assert cosines_for(0.1, WINDOW) == FINE_FIELD_COSINES


@pytest.mark.long
def test_only_a_narrow_bump_pays_for_them() -> None:
    wide, few = estimate(1, sigma=5.0), estimate(1, sigma=5.0, cosines=FIELD_COSINES)
    assert wide.diagnostics["field_cosines"] == FIELD_COSINES
    assert width_sd(wide) == width_sd(few)
    narrow, few = estimate(1, sigma=NARROW_MM), estimate(1, sigma=NARROW_MM, cosines=FIELD_COSINES)
    assert narrow.diagnostics["field_cosines"] == FINE_FIELD_COSINES
    assert width_sd(narrow) > 1.03 * width_sd(few)


@cache
def spread(cosines: int | None, maps: int = 60) -> float:
    """Root mean square of (median - truth) / SD over ln sigma_x and ln sigma_y of maps with a narrow bump."""
    z = []
    for seed in range(maps):
        found = estimate(100 + seed, sigma=NARROW_MM, cosines=cosines).map_posterior
        if found is not None:
            logs = np.log([found.sigma_x_mm.ravel(), found.sigma_y_mm.ravel()])
            z.append((np.median(logs, axis=1) - np.log(NARROW_MM)) / logs.std(axis=1))
    return float(np.sqrt(np.mean(np.square(z))))


@pytest.mark.slow
def test_intervals_of_a_narrow_bump_are_as_wide_as_they_should_be() -> None:
    """60 maps, 120 widths: the root mean square of exact ones is 1 with a standard error of 0.06 to 0.09."""
    assert spread(None) < 1.2


@pytest.mark.slow
def test_those_of_a_coarse_field_are_not() -> None:
    """The control."""
    assert spread(FIELD_COSINES) > 1.2
