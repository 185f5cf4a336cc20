"""Outlines of bumps made by formula: skewed ones and two side by side are irregular, a Gaussian and an ellipse are not.

Also the axis ratio 45 degrees from the map's axes, where the fit has none.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from posterior_maps import correlated_field, grid_map

from tactile_bayes.posterior.correlated import outline
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate

AXIS = np.arange(-26.0, 27.0)
X, Y = np.meshgrid(AXIS, AXIS)
SIGMA = 4.5
NOISE = 0.004


def gaussian(*, q: float = 0.0, r: float = 0.0) -> np.ndarray:
    """Unit Gaussian with a half log axis ratio along and 45 degrees from x."""
    half = np.hypot(q, r)
    turn = 0.5 * np.arctan2(r, q)
    along, across = X * np.cos(turn) + Y * np.sin(turn), Y * np.cos(turn) - X * np.sin(turn)
    return np.exp(-0.5 * ((along * np.exp(-half)) ** 2 + (across * np.exp(half)) ** 2) / SIGMA**2)


def skewed(share: float) -> np.ndarray:
    """A Gaussian times one plus a share of the square of the distance, times the place along x."""
    return gaussian() * (1 + share * (X**2 + Y**2) * X / SIGMA**3)


def beside(apart: float) -> np.ndarray:
    """Two Gaussians, in widths apart along x."""
    return sum(np.exp(-0.5 * ((X - side * apart * SIGMA / 2) ** 2 + Y**2) / SIGMA**2) for side in (-1, 1)) / 2


FORMS = {
    "round": gaussian(),
    "ellipse": gaussian(q=0.15),
    "oblique ellipse": gaussian(r=0.15),
    "slightly oblique": gaussian(r=0.015),
    "skewed": skewed(0.05),
    "two": beside(2.2),
}


@cache
def estimated(form: str, seed: int = 0) -> Estimate:
    rng = np.random.default_rng(seed)
    errors = NOISE * (rng.standard_normal(X.shape) + correlated_field(rng, len(AXIS), length_cells=3.0))
    # two bumps are one lump's map here, not a lump with a neighbour
    options = SamplerSettings(method="laplace", scene="ellipse", background="free", rotation="off", noise="field")
    found = estimate_map(grid_map(1 + 0.5 * FORMS[form] + errors), calibration=None, options=options, rng=rng)
    assert found.status == "estimate"
    assert found.map_posterior is not None
    return found


@pytest.mark.parametrize("form", ["skewed", "two"])
def test_what_no_ellipse_is_like_is_irregular_and_the_report_says_so(form: str) -> None:
    found = estimated(form)
    assert found.map_posterior is not None
    assert found.map_posterior.irregular
    assert "irregular" in [one.kind for one in found.findings]


@pytest.mark.long_repeats
@pytest.mark.parametrize("form", ["round", "ellipse", "slightly oblique"])
def test_an_ellipse_has_no_irregular_outline(form: str) -> None:
    """The negative control, three maps each; a false alarm in one map has a chance of a few percent at most."""
    answers = [estimated(form, seed) for seed in range(3)]
    assert not any(one.map_posterior.irregular for one in answers if one.map_posterior is not None)
    assert not any(one.findings for one in answers)


def test_skewness_is_measured_in_shares_of_the_amplitude() -> None:
    fit = estimated("skewed").scene
    assert fit is not None
    found, covariance = outline(fit.fit)
    assert found[0] == pytest.approx(0.05, abs=0.015)
    assert np.abs(found[1:]).max() < 4 * np.sqrt(np.diag(covariance)[1:]).max()


def test_an_axis_ratio_that_the_fit_left_out_is_measured_beside_it() -> None:
    for form, r in (("slightly oblique", 0.015), ("round", 0.0)):
        posterior = estimated(form).map_posterior
        assert posterior is not None
        assert not posterior.angle_rad.any()
        assert posterior.oblique is not None
        mean, sd = posterior.oblique
        assert mean == pytest.approx(r, abs=4 * sd)
        assert sd < 0.02
