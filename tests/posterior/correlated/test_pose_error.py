"""Errors of the frames' places: told from the poses, taken off the widths, and added to their spread.

Truth is what the simulated tracker was given, and dense linear algebra.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from plain_reports import full_text
from posterior_maps import bump_map
from scipy.stats import chi2

from tactile_bayes.declarations import replace
from tactile_bayes.forward.scene import Lump, Noise, Scene, Strokes
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.profile import MOST_MM, _departures, _interpolation
from tactile_bayes.posterior.bump import PoseNoise, cell_mean_gaussian, window_cells
from tactile_bayes.posterior.correlated import pose_covariance
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.fit import FieldFit, tangent_columns
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.window import Window, independent_variance
from tactile_bayes.presets import POSE_NOISE
from tactile_bayes.report.map import map_text
from tactile_bayes.scans import Scan, TrackerPoses

SIGMA = (4.5, 5.5)
TOLD = {"pose_noise_x_mm": 0.4, "pose_noise_y_mm": 0.3, "frame_side_x_mm": 24.0, "frame_side_y_mm": 39.0}
TOLD |= {"frames_per_reading": 2.25}


@cache
def scan(tracker_mm: float = 0.3, *, tracker_deg: float = 0.0, seed: int = 1) -> Scan:
    """Strokes over a lump, read without any error but the tracker's."""
    rng = np.random.default_rng([seed, 5])
    x, y = rng.uniform(-3.0, 3.0, 2)
    lump = Lump(x_mm=float(x), y_mm=float(y), amplitude=0.3, sigma_x_mm=SIGMA[0], sigma_y_mm=SIGMA[1])
    noise = Noise(0.0, tracker_mm, tracker_deg, 0.0, 0.0)
    scene = Scene(seed=seed, frame_rate_hz=100.0, lumps=(lump,), noise=noise, strokes=Strokes())
    return simulate(scene, rng=np.random.default_rng(seed)).scan


@cache
def built(tracker_mm: float, tracker_deg: float = 0.0) -> TactileMap:
    return build_map(scan(tracker_mm, tracker_deg=tracker_deg))


def told(tactile_map: TactileMap) -> dict[str, float]:
    return {name: tactile_map.quality[name] for name in POSE_NOISE if name in tactile_map.quality}


def with_poses(whole: Scan, poses: TrackerPoses) -> Scan:
    return replace(whole, poses=poses)


# --- what the map tells ---


@pytest.mark.parametrize(
    ("tracker_mm", "tracker_deg"), [pytest.param(0.1, 0.0, marks=pytest.mark.long), (0.6, 0.0), (0.3, 0.3)]
)
def test_what_the_tracker_was_given_is_found(tracker_mm: float, tracker_deg: float) -> None:
    """An error of the tilt moves the head by its lever of 55 mm; two poses are averaged, on average to 2/3."""
    found = told(built(tracker_mm, tracker_deg))
    true = np.sqrt((tracker_mm**2 + (np.radians(tracker_deg) * 55.0) ** 2) * 2 / 3)
    assert found["pose_noise_x_mm"] == pytest.approx(true, rel=0.12)
    assert found["pose_noise_y_mm"] == pytest.approx(true, rel=0.12)
    assert (found["frame_side_x_mm"], found["frame_side_y_mm"]) == (24.0, 39.0)
    # five frames take 1, .8, .8, .8, .8, .8 of six poses and have .68 of a pose's variance; cells 1 mm, taxels 1.5
    assert found["frames_per_reading"] == pytest.approx(5 * 0.68 / (1 + 5 * 0.64) * 1.5**2, rel=0.01)


def test_the_motion_of_the_hand_is_not_taken_for_tracker_error() -> None:
    assert max(list(told(build_map(scan(0.0))).values())[:2]) < 0.01


def test_a_cubic_path_leaves_nothing_at_uneven_times_and_noise_is_weighed() -> None:
    rng = np.random.default_rng(3)
    time_s = np.cumsum(rng.uniform(0.005, 0.015, 4000))
    path = np.stack([3.0 * time_s**3 - time_s, 2.0 - time_s**2], axis=1)
    departure, variance = _departures(time_s, path)
    assert np.abs(departure).max() < 1e-8 * np.abs(path).max()
    noisy, _ = _departures(time_s, path + 0.2 * rng.standard_normal(path.shape))
    assert np.mean(noisy**2 / variance[:, None]) == pytest.approx(0.04, rel=0.1)


def test_a_frame_on_a_pose_has_its_noise_and_one_between_two_has_half() -> None:
    poses_s = np.arange(10.0)
    assert _interpolation(np.array([2.0, 5.0]), poses_s) == (1.0, 2.0)
    assert _interpolation(np.array([2.5, 5.5]), poses_s) == (0.5, 2.0)


def test_frames_between_the_same_poses_share_their_errors() -> None:
    """Against the variance of the mean by simulated errors; twice the same frames are no more than once."""
    rng = np.random.default_rng(6)
    poses_s, frames_s = np.arange(0.0, 1.0, 1 / 120), np.arange(0.005, 0.99, 0.01)
    factor, independent = _interpolation(frames_s, poses_s)
    errors = rng.standard_normal((20000, len(poses_s)))
    means = np.array([np.interp(frames_s, poses_s, one).mean() for one in errors])
    assert np.var(means) == pytest.approx(factor / independent, rel=0.05)
    assert independent < 0.9 * len(frames_s)
    assert _interpolation(np.repeat(frames_s, 2), poses_s) == pytest.approx((factor, independent))


@pytest.mark.long
def test_a_head_that_jumps_or_few_poses_tell_nothing() -> None:
    whole = scan()
    poses = whole.poses
    jumps = 10.0 * np.random.default_rng(1).standard_normal(poses.position_mm.shape)
    jumping = TrackerPoses(poses.time_s, poses.position_mm + jumps, poses.quaternion_wxyz)
    assert told(build_map(with_poses(whole, jumping))) == {}
    few = slice(0, None, len(poses) // 30)
    rare = TrackerPoses(poses.time_s[few], poses.position_mm[few], poses.quaternion_wxyz[few])
    assert told(build_map(with_poses(whole, rare), max_pose_gap_ms=1000.0)) == {}
    assert MOST_MM > 1.0  # the control: noise of a poor tracker, 0.6 mm, is told above


def test_two_scans_tell_the_mean_of_their_variances() -> None:
    quiet, loud = scan(0.1), scan(0.6, seed=2)
    both = told(build_map([quiet, loud]))["pose_noise_x_mm"]
    assert both == pytest.approx(np.sqrt((0.1**2 + 0.6**2) / 2 * 2 / 3), rel=0.12)


def test_the_maps_report_names_the_tracker_position_error() -> None:
    assert "frames' places" in map_text(built(0.6))


# --- what the widths make of it ---


def window_of(tactile_map: TactileMap) -> Window:
    cells = window_cells(tactile_map, (0.0, 0.0), radius_mm=20.0)
    return Window(cells, independent_variance(cells))


def with_figures(tactile_map: TactileMap, **changed: float) -> TactileMap:
    return replace(tactile_map, quality=TOLD | changed)


@pytest.mark.parametrize("r", [0.0, 0.15])
def test_a_template_is_blurred_by_the_noise(r: float) -> None:
    """Against the Gaussian of the summed covariances, which keeps its volume."""
    from tactile_bayes.posterior.bump import covariance_from_log_widths

    window = window_of(with_figures(bump_map(), pose_noise_x_mm=1.0, pose_noise_y_mm=0.5))
    p, q = np.array([1.6]), np.array([0.1])
    turned = np.array([r]) if r else None
    found = window.of_cells(window.bumps(np.zeros(1), np.zeros(1), p=p, q=q, r=turned))[0]
    covariance = covariance_from_log_widths(p, q, np.array([r]))[0]
    blurred = covariance + np.diag([1.0, 0.25])
    cells = window.cells
    plain = cell_mean_gaussian(cells.x_mm, cells.y_mm, covariance_mm2=blurred, cell_mm=1.0)
    lower = np.sqrt(np.linalg.det(covariance) / np.linalg.det(blurred))
    np.testing.assert_allclose(found, lower * plain, atol=1e-4)
    assert lower < 0.99  # the control: without the blur they would differ by a per cent and more


def estimated(tactile_map: TactileMap) -> Estimate:
    options = SamplerSettings(method="laplace", background="free", rotation="off", noise="field")
    found = estimate_map(tactile_map, calibration=None, options=options, rng=np.random.default_rng(1))
    assert found.map_posterior is not None
    return found


def fit_of(found: Estimate) -> FieldFit:
    assert found.scene is not None
    return found.scene.fit


def dense_covariance(fit: FieldFit, noise: PoseNoise) -> FloatArray:
    """Of the parameters by the whole covariance of the cells' errors: nothing of low rank."""
    cells, mode = fit.target.window.cells, fit.mode
    known = tangent_columns(fit)
    unit = np.eye(len(cells))
    inverse = fit.target.products(unit, unit, mode)
    sigma_x, sigma_y = np.exp(mode[0]), np.exp(mode[1])
    dx, dy = cells.x_mm - mode[2], cells.y_mm - mode[3]
    wide = (np.hypot(sigma_x, noise.sd_mm[0]), np.hypot(sigma_y, noise.sd_mm[1]))
    bump = known[0]
    away_x, away_y = (np.abs(np.subtract.outer(v, v)) for v in (cells.x_mm, cells.y_mm))
    shared = np.clip(1 - away_x / noise.side_mm[0], 0, None) * np.clip(1 - away_y / noise.side_mm[1], 0, None)
    frames = cells.count * noise.frames_per_reading
    errors = np.zeros_like(shared)
    for slope, sd in ((bump * dx / wide[0] ** 2, noise.sd_mm[0]), (bump * dy / wide[1] ** 2, noise.sd_mm[1])):
        scaled = sd * slope / np.sqrt(frames)
        errors += np.outer(scaled, scaled) * shared
    project = np.linalg.solve(known @ inverse @ known.T, known @ inverse)
    return np.asarray((project @ errors @ project.T)[1 : 1 + len(mode), 1 : 1 + len(mode)])


def test_the_spread_is_that_of_the_whole_covariance() -> None:
    noise = 0.005 * np.random.default_rng(4).standard_normal((51, 51))
    fit = fit_of(estimated(with_figures(bump_map(noise=noise, sigma_x=4.5, sigma_y=5.5))))
    told = fit.target.window.cells.pose_noise
    assert told is not None
    found, dense = pose_covariance(fit), dense_covariance(fit, told)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(dense)), rtol=0.03)
    assert np.corrcoef(found.ravel(), dense.ravel())[0, 1] > 0.999


def test_the_report_says_what_they_make_of_the_widths_or_that_they_are_left_out() -> None:
    tactile_map = built(0.6)
    found = estimated(tactile_map)
    share = found.diagnostics["places_share"]
    assert isinstance(share, float)
    posterior = found.map_posterior
    assert posterior is not None
    spread = np.var([np.log(posterior.sigma_x_mm), np.log(posterior.sigma_y_mm)], axis=(1, 2)).sum()
    added = np.diag(pose_covariance(fit_of(found)))[:2].sum()
    assert share == pytest.approx(added / spread, rel=0.15)
    assert f"{100 * share:.0f} % of the width variance is tracker position error" in full_text(found, tactile_map)
    untold = {name: value for name, value in tactile_map.quality.items() if name not in POSE_NOISE}
    without = replace(tactile_map, quality=untold)
    text = full_text(estimated(without), without)
    assert "Left out: tracker position error and its blur" in text
    assert "variance of the widths" not in text


def test_a_map_that_does_not_tell_adds_nothing() -> None:
    noise = 0.005 * np.random.default_rng(4).standard_normal((51, 51))
    plain = bump_map(noise=noise)
    assert not pose_covariance(fit_of(estimated(plain))).any()
    for broken in ({"pose_noise_x_mm": np.nan}, {"frame_side_x_mm": 0.0}):
        assert PoseNoise.of(with_figures(plain, **broken)) is None
    assert PoseNoise.of(with_figures(plain)) is not None


@pytest.mark.slow
def test_widths_of_scans_with_only_the_trackers_errors_scatter_as_told() -> None:
    """Twelve scans, two widths each: the sum of squares over the predicted variance is a chi-squared of about 24."""
    found = [estimated(build_map(scan(0.6, seed=seed), normalise="gain")) for seed in range(12)]
    predicted = np.array([np.diag(pose_covariance(fit_of(one)))[:2] for one in found])
    error = np.array([fit_of(one).mode[:2] - np.log(SIGMA) for one in found])
    total = float(np.sum(error**2 / predicted))
    assert chi2.ppf(0.0005, 24) < total < chi2.ppf(0.9995, 24)
    # the control: half the noise would be refused, and so would widths with the blur still in them (0.6 %)
    assert total > chi2.ppf(0.0005, 24)
    assert float(np.sum(error**2 / (predicted / 4))) > chi2.ppf(0.9995, 24)
    assert abs(np.mean(error)) < 0.002


def test_frames_that_are_there_twice_leave_the_spread() -> None:
    whole = scan(0.6)
    frames = whole.frames
    later = np.repeat(frames.time_s, 2) + np.tile([0.0, 1e-6], len(frames.time_s))
    doubled = replace(frames, time_s=later, counts=np.repeat(frames.counts, 2, axis=0))
    once, twice = built(0.6), build_map(replace(whole, frames=doubled))
    assert twice.count.sum() == pytest.approx(2 * once.count.sum(), rel=0.01)
    first, second = (np.diag(pose_covariance(fit_of(estimated(one)))) for one in (once, twice))
    np.testing.assert_allclose(np.sqrt(second), np.sqrt(first), rtol=0.05)
    # the control: by the readings alone each frame's error would count twice, and the SD would be 0.7 of it
    naive = replace(twice, quality=twice.quality | {"frames_per_reading": once.quality["frames_per_reading"]})
    assert np.sqrt(np.diag(pose_covariance(fit_of(estimated(naive)))) / first).max() < 0.75
