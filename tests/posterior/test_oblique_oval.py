"""An oval near 45 degrees: all draws call the same axis x, so that angle, widths and diameters have one middle."""

from __future__ import annotations

import numpy as np
import pytest
from posterior_maps import covariance, grid_map

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.files.reports import EstimateReport
from tactile_bayes.inference.ensemble import convergence
from tactile_bayes.mapping.clock import ClockPosition
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.bump import cell_mean_gaussian, covariance_from_log_widths, drawn_widths, principal_widths

WIDE, NARROW = 7.0, 4.0


def draws(angle_deg: float, ratio: float = WIDE / NARROW, sd: float = 0.01) -> tuple[np.ndarray, ...]:
    """(4, 500) draws of log width and half log axis ratio about an oval."""
    rng, half = np.random.default_rng(2), 0.5 * np.log(ratio)
    turn = np.radians(2 * angle_deg)
    p, q, r = (
        middle + sd * rng.standard_normal((4, 500))
        for middle in (np.log(np.sqrt(WIDE * NARROW)), half * np.cos(turn), half * np.sin(turn))
    )
    return p, q, r


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 44.5, 45.0, 45.5, 60.0, 89.0, -45.0, -44.0])
def test_draws_of_an_oval_name_one_axis_and_are_the_same_ellipses(angle_deg: float) -> None:
    p, q, r = draws(angle_deg)
    sigma_x, sigma_y, angle = drawn_widths(p, q, r)
    longer = sigma_x > sigma_y
    assert longer.all() or not longer.any()
    assert np.degrees(angle.std()) < 1.5
    for width in (sigma_x, sigma_y, angle):
        assert convergence(width)["rhat"] < 1.02
    c, s = np.cos(angle), np.sin(angle)
    same = covariance_from_log_widths(p, q, r)
    np.testing.assert_allclose((c * sigma_x) ** 2 + (s * sigma_y) ** 2, same[..., 0, 0])
    np.testing.assert_allclose(c * s * (sigma_x**2 - sigma_y**2), same[..., 0, 1], atol=1e-9)
    np.testing.assert_array_equal(
        np.sort([sigma_x, sigma_y], axis=0), np.sort(principal_widths(p, q, r)[:2], axis=0)
    )  # no size moves


def test_each_draws_own_axis_was_a_switch() -> None:
    """The negative control."""
    sigma_x, sigma_y, _ = principal_widths(*draws(45.0))
    assert 0.3 < (sigma_x > sigma_y).mean() < 0.7


def test_draws_that_do_not_tell_an_axis_keep_the_one_nearest_x() -> None:
    p, q, r = draws(45.0, ratio=1.001)
    for drawn, own in zip(drawn_widths(p, q, r), principal_widths(p, q, r), strict=True):
        np.testing.assert_array_equal(drawn, own)


def oval(angle_deg: float) -> TactileMap:
    y, x = np.mgrid[-30:31, -30:31].astype(float)
    turned = covariance(WIDE, NARROW, angle_deg)
    bump = cell_mean_gaussian(x.ravel(), y.ravel(), covariance_mm2=turned, cell_mm=1.0).reshape(x.shape)
    return grid_map(1.0 + 0.4 * bump + 0.02 * np.random.default_rng(1).standard_normal(x.shape), normalise="gain")


@pytest.mark.long_repeats
@pytest.mark.parametrize("angle_deg", [45.0, -45.0])
def test_an_oval_at_45_degrees_has_one_angle_and_its_diameters_lie_along_it(angle_deg: float) -> None:
    report = estimate_one(oval(angle_deg), Settings(method="laplace")).answer.report
    assert isinstance(report, EstimateReport)
    angle, across, along = report.angle_deg, report.sigma_x_mm, report.sigma_y_mm
    assert angle is not None
    assert across is not None
    assert along is not None
    assert angle.high - angle.low < 5.0
    longer, shorter = (across, along) if across.median > along.median else (along, across)
    assert (longer.median, shorter.median) == pytest.approx((WIDE, NARROW), rel=0.02)
    assert shorter.high < 4.3 < 6.7 < longer.low
    turn = angle.median if longer is across else angle.median + 90.0
    assert (turn - angle_deg + 90.0) % 180.0 - 90.0 == pytest.approx(0.0, abs=2.0)
    diameters = report.d_x_mm, report.d_y_mm
    assert report.max_size_mm is not None
    named = diameters[0 if longer is across else 1]
    assert named is not None
    assert named.median == pytest.approx(report.max_size_mm.median, rel=0.02)


def test_the_clock_goes_round() -> None:
    """Half an hour before and after 12 have the middle 12, and an interval about it."""
    at = ClockPosition("left", 30.0, 2.0, angle_deg=359.0, angle_sd_deg=5.0)
    low, high = at.hours_between(0.95) or (0.0, 0.0)
    assert 11.5 < low < 12.0
    assert 0.0 < high < 0.5
    assert at.quadrant == "upper"
