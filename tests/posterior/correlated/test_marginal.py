"""The collapsed posterior under correlated errors: against dense linear algebra, and how often its intervals cover."""

from __future__ import annotations

from math import lgamma

import numpy as np
import pytest
from posterior_maps import TRUTH, bump_map, correlated_field

from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import marginal as collapsed
from tactile_bayes.posterior.bump import (
    FitCells,
    cell_mean_gaussian,
    covariance_from_log_widths,
    drawn_widths,
    window_cells,
)
from tactile_bayes.posterior.draw import SamplerSettings, draw_parameters
from tactile_bayes.posterior.fit import FieldFit, fit_scene
from tactile_bayes.posterior.marginal import CollapsedTarget, Scene
from tactile_bayes.posterior.window import (
    Problem,
    Window,
    _one_structure,
    cosine_profiles,
    gram_of_cosines,
    independent_variance,
    spectrum,
)

RADIUS = 20.0
START = np.array([np.log(6.0), np.log(4.5), 1.3, -0.8, 0.0])
Z90 = 1.6448536
STRAIGHT, TURNED = Scene("ellipse"), Scene("rotated")


def cells_of(noise: np.ndarray | float, radius: float = RADIUS, **bump: float) -> FitCells:
    return window_cells(bump_map(noise=noise, **bump), (1.0, -1.0), radius_mm=radius)


def target_of(cells: FitCells, *, scene: Scene = TURNED) -> CollapsedTarget:
    window = Window(cells, independent_variance(cells))
    return CollapsedTarget(Problem(window, BumpPrior(), RADIUS), scene)


def fitted(cells: FitCells, *, scene: Scene = STRAIGHT, start: np.ndarray | None = None) -> FieldFit:
    window = Window(cells, independent_variance(cells))
    begin = TURNED.converted(START, scene) if start is None else start
    return fit_scene(Problem(window, BumpPrior(), RADIUS), scene, begin)


def bumps_of(target: CollapsedTarget, theta: np.ndarray) -> np.ndarray:
    """(v, m, n) templates on the cells."""
    window = target.window
    return np.array([window.of_cells(one) for one in target.scene.templates(theta, window)])


def noise(seed: int, *, white: float = 0.01, field: float = 0.0, length: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = white * rng.standard_normal((51, 51))
    return values + field * correlated_field(rng, 51, length_cells=length) if field else values


def dense_basis(window: Window) -> tuple[np.ndarray, np.ndarray]:
    along, across = cosine_profiles(window.y_mm), cosine_profiles(window.x_mm)
    basis = along[0][window._row][:, :, None] * across[0][window._column][:, None, :]
    return basis.reshape(len(window.cells), -1), (along[1][:, None] + across[1][None, :]).ravel()


def test_the_cosines_are_orthonormal_and_their_spectrum_falls() -> None:
    axis = np.linspace(-10, 10, 1301)
    profiles, frequency2 = cosine_profiles(axis, cosines=4)
    assert profiles.shape == (1301, 4)
    assert frequency2[0] == 0.0
    np.testing.assert_allclose(np.mean(profiles[:, 0] ** 2), 1.0)
    assert spectrum(frequency2, 3.0).sum() == pytest.approx(1.0)
    assert (np.diff(spectrum(np.sort(frequency2), 3.0)) <= 0).all()


def test_products_of_cosines_are_their_dense_products() -> None:
    cells = cells_of(noise(0), radius=8.0)
    window = Window(cells, independent_variance(cells))
    basis, _ = dense_basis(window)
    exact = basis.T @ (basis / window.variance[:, None])
    found = gram_of_cosines(window._along, window._across, weight=window.weight)
    np.testing.assert_allclose(found, exact, atol=1e-9 * np.abs(exact).max())


def test_bumps_on_the_grid_are_the_forward_models() -> None:
    cells = cells_of(noise(0), radius=8.0)
    window = Window(cells, independent_variance(cells))
    for log_width, tolerance in ((0.2, 1e-5), (1.5, 4e-5)):
        p, q, r = np.array([log_width]), np.array([0.15]), np.array([0.1])
        for turn in (None, r):
            covariance = covariance_from_log_widths(p, q, r if turn is not None else 0.0 * r)
            exact = cell_mean_gaussian(cells.x_mm - 1.0, cells.y_mm, covariance_mm2=covariance, cell_mm=1.0)
            found = window.bumps(np.array([1.0]), np.array([0.0]), p=p, q=q, r=turn)
            np.testing.assert_allclose(window.of_cells(found), exact, atol=tolerance)


@pytest.mark.long_repeats
@pytest.mark.parametrize(
    "scene",
    [
        STRAIGHT,
        TURNED,
        Scene("round"),
        Scene("ellipse", extra="second lump"),
        Scene("rotated", extra="rib"),
        Scene("ellipse", tilt=False),
    ],
)
def test_low_rank_algebra_is_dense_algebra(scene: Scene) -> None:
    cells = cells_of(noise(0, field=0.01), radius=8.0)
    target = target_of(cells, scene=scene)
    begin = TURNED.converted(START, scene)
    beside = {"second lump": [7.0, 6.0, 1.2], "rib": [0.7, 5.0, 1.0], "": []}[scene.extra]
    begin[len(begin) - len(beside) :] = beside
    theta = np.array([begin, begin + 0.1])
    (solution,) = target._solutions(theta)
    evidence = solution.evidence
    basis, frequency2 = dense_basis(target.window)
    templates = bumps_of(target, theta)
    level = target.linear.plain[:-1].T
    data = cells.value - cells.value.mean()
    n, c, v = len(cells), level.shape[1], len(templates)
    column, at_zero = 0, np.concatenate([one.level() for one in target.fields])
    for field in target.fields:
        for share in field.shares:
            low = share * spectrum(frequency2, field.field.length_mm)
            cov = np.diag(target.window.variance) + (basis * low) @ basis.T
            inverse = np.linalg.inv(cov)
            log_det = np.linalg.slogdet(cov)[1] - np.log(target.window.variance).sum()
            for row in range(len(theta)):
                design = np.column_stack([level, *templates[:, row]])
                information = design.T @ inverse @ design
                beta = np.linalg.solve(information, design.T @ inverse @ data)
                rest = data - design @ beta
                square, dof = rest @ inverse @ rest, n - c - v
                spread = np.linalg.inv(information)[c:, c:] * square / dof + 4.0 * np.eye(v)
                prior = -0.5 * (np.linalg.slogdet(2 * np.pi * spread)[1] + beta[c:] @ np.linalg.inv(spread) @ beta[c:])
                exact = -0.5 * (log_det + np.linalg.slogdet(information)[1]) + prior
                exact += lgamma(dof / 2) - 0.5 * dof * np.log(np.pi * square)
                # 4 lengths, 10 shares of which one, 0, is the same for every length
                exact += np.log(1 / 10 if share == 0 else 1 / 40)
                if (beta[c:] > 0).all():
                    assert evidence[row, column] == pytest.approx(exact, abs=2e-3)
                else:
                    assert evidence[row, column] == -np.inf
                np.testing.assert_allclose(solution.amplitude[row, column], beta[c:], rtol=1e-5, atol=1e-9)
                level_only = at_zero[column] - beta[c:] @ solution.level_slope[row, column]
                np.testing.assert_allclose(level_only, beta[:c], rtol=1e-5, atol=1e-7)
                np.testing.assert_allclose(
                    np.linalg.inv(solution.power[row, column]),
                    np.linalg.inv(information)[c:, c:],
                    rtol=1e-4,
                    atol=1e-12,
                )
            column += 1


def test_dropping_idle_directions_changes_nothing_that_matters() -> None:
    cells = cells_of(noise(1, field=0.01))
    target = target_of(cells, scene=STRAIGHT)
    near = START[:4] + 0.02 * np.random.default_rng(1).standard_normal((6, 4))
    whole, directions = target(near), sum(len(one.weight) for one in target.fields)
    target.select_fields(START[:4])
    np.testing.assert_allclose(target(near), whole, atol=5e-3)
    assert sum(len(one.weight) for one in target.fields) < 0.8 * directions


@pytest.mark.parametrize("scene", [TURNED, Scene("ellipse", tilt=False), Scene("ellipse", extra="rib")])
def test_another_scene_of_the_same_window_is_as_made_anew(scene: Scene) -> None:
    cells = cells_of(noise(2, field=0.01))
    settled = target_of(cells, scene=STRAIGHT)
    settled.select_fields(START[:4])
    theta = np.concatenate([TURNED.converted(START, scene), [0.7, 5.0, 1.0]])[None, : len(scene.names)]
    derived, anew = settled.of_scene(scene), target_of(cells, scene=scene)
    np.testing.assert_array_equal(derived.by_field(theta), anew.by_field(theta))
    assert derived.select_fields(theta[0])
    anew.select_fields(theta[0])
    np.testing.assert_array_equal(derived(theta), anew(theta))
    assert settled.selected_fields() != []


def test_independent_errors_are_one_hypothesis() -> None:
    """Four lengths with the share 0 are the same errors: one field of the mixture, with the prior of four."""
    target = target_of(cells_of(noise(3)), scene=STRAIGHT)
    target.select_fields(START[:4])
    assert [shares for _, shares in target.selected_fields()].count((0.0,)) == 1
    summary = target.field_figures(START[:4])
    assert summary["field_share"] < 0.05
    correlated = target_of(cells_of(noise(3, white=0.002, field=0.02)), scene=STRAIGHT)
    correlated.select_fields(START[:4])
    assert (0.0,) not in [shares for _, shares in correlated.selected_fields()]


def test_a_level_and_a_tilt_do_not_matter() -> None:
    cells = cells_of(noise(2))
    plain = fitted(cells)
    tilted = cells_of(noise(2) + 0.02 * np.linspace(-1, 1, 51)[None, :] + 5.0)
    np.testing.assert_allclose(fitted(tilted).mode, plain.mode, atol=1e-3)


def test_a_bump_that_no_cell_shows_overflows_nothing() -> None:
    """Its power is next to nothing and its amplitude next to anything: the prior decides, without a warning."""
    along, power = np.array([1e-30, 0.0, -1e-150]), np.array([1e-200, 1e-300, 1e-310])
    factor, *_ = _one_structure(along, power, np.ones(3), 1e-12, dof=100, amplitude_sd=2.0)
    assert np.isfinite(factor[1:]).all()
    assert factor[0] < factor[1]


@pytest.mark.parametrize(
    ("width", "offset", "clear", "apart"),
    [
        (4.0, 9.0, True, True),  # two widths of the bump and of the rib are 8 mm
        (4.0, 7.0, False, True),  # it runs under the bump, as wide as it
        (10.0, 9.0, False, False),  # the bump lies in the flank of so wide a rib: the curvature of the level
        (10.0, 21.0, True, True),
        (2.0, 7.0, False, True),  # of a narrow rib the bump's width counts
    ],
)
def test_a_rib_is_clear_of_a_bump_by_the_larger_of_their_widths(
    width: float, offset: float, clear: bool, apart: bool
) -> None:
    scene = Scene("round", extra="rib")
    at = {"u": np.log(4.0), "x": 13.0, "y": -7.0, "angle": np.pi, "offset": -3.0 - offset, "w2": np.log(width)}
    theta = np.array([[at[name] for name in scene.names]])
    assert scene.rib_clear(theta, (10.0, 5.0)) == clear
    assert scene.rib_apart(theta, (10.0, 5.0)) == apart


def test_a_negative_amplitude_has_density_zero() -> None:
    target = target_of(cells_of(noise(3), amplitude=-0.3))
    assert target(START[None])[0] == -np.inf


def test_amplitude_and_noise_come_back() -> None:
    fit = fitted(cells_of(noise(4, white=0.01)))
    theta = np.repeat(fit.mode[None], 4000, axis=0)
    amplitude, level, noise_sd = fit.target.draw_linear(theta, np.random.default_rng(0), solve=fit.target.conditional)
    assert amplitude.mean() == pytest.approx(TRUTH["amplitude"], abs=4 * amplitude.std())
    assert level.mean() == pytest.approx(1.0, abs=0.005)
    # against dense algebra without a field: the spread of the level, and that it falls as the amplitude rises
    variance = fit.target.window.variance
    design = np.column_stack([*fit.target.linear.plain[:-1], bumps_of(fit.target, fit.mode[None])[0, 0]])
    joint = np.linalg.inv(design.T @ (design / variance[:, None]))
    white = np.sqrt(joint[0, 0]) * 0.01 / np.sqrt(variance.mean())
    assert 0.9 * white < level.std() < 3.0 * white
    assert np.corrcoef(level, amplitude[:, 0])[0, 1] < 0.0
    assert noise_sd.mean() == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize(
    "methods", [("laplace", "importance"), pytest.param(("ensemble", "importance"), marks=pytest.mark.slow)]
)
def test_the_methods_agree(methods: tuple[str, ...]) -> None:
    fit = fitted(cells_of(noise(5, field=0.01)))
    drawn = {
        method: draw_parameters(fit, SamplerSettings(method=method), rng=np.random.default_rng(1))[0].flat
        for method in methods
    }
    sd = drawn["importance"].std(axis=0)
    for name, draws in drawn.items():
        assert (np.abs(draws.mean(axis=0) - drawn["importance"].mean(axis=0)) < 0.2 * sd).all(), name
        np.testing.assert_allclose(draws.std(axis=0), sd, rtol=0.12, err_msg=name)
    sigma_x, sigma_y, _ = drawn_widths(*fit.scene.widths(drawn["importance"]))
    assert np.median(sigma_x) == pytest.approx(TRUTH["sigma_x"], rel=0.1)
    assert np.median(sigma_y) == pytest.approx(TRUTH["sigma_y"], rel=0.1)


def coverage(maps: int, **errors: float) -> np.ndarray:
    """Share of 90 % intervals of ln sigma_x and ln sigma_y that hold the truth."""
    inside = np.zeros(2)
    for seed in range(maps):
        fit = fitted(cells_of(noise(1000 + seed, **errors)))
        z = (fit.mode[:2] - np.log([TRUTH["sigma_x"], TRUTH["sigma_y"]])) / np.sqrt(np.diag(fit.covariance)[:2])
        inside += np.abs(z) <= Z90
    return inside / maps


@pytest.mark.slow
@pytest.mark.parametrize("errors", [{"white": 0.01}, {"white": 0.01, "field": 0.01, "length": 6.0}])
def test_intervals_cover(errors: dict[str, float]) -> None:
    # 30 maps: 0.73 is 3.1 binomial SDs below 0.90
    assert coverage(30, **errors).min() >= 0.73


def test_independent_errors_would_not_cover(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactile_bayes.posterior.window.SHARES", (0.0, 1e-9))
    assert coverage(15, white=0.003, field=0.02, length=4.0).max() < 0.73


@pytest.mark.slow
@pytest.mark.parametrize(
    "errors",
    [
        {"white": 0.01},
        {"white": 0.01, "field": 0.01, "length": 3.0},
        {"white": 0.01, "field": 0.01, "length": 6.0},
        {"white": 0.002, "field": 0.02, "length": 4.0},
    ],
)
def test_intervals_cover_within_85_to_95_percent(errors: dict[str, float]) -> None:
    found = coverage(400, **errors)
    # the goal with three binomial SDs of 400 maps (0.015 each)
    assert found.min() >= 0.85 - 0.045
    assert found.max() <= 0.95 + 0.045


def test_a_template_that_the_window_hardly_has_changes_nothing_and_overflows_nothing() -> None:
    """Its amplitude keeps its prior, so the evidence is as without it; wholly beyond the window it is no rise."""
    target = target_of(cells_of(noise(2)), scene=STRAIGHT)
    offsets = np.array([20.0, 30.0, 35.0, *np.arange(40.0, 130.0, 0.25), 5000.0])
    templates = target.window.ridges(0.0 * offsets, offsets, log_width=np.full(len(offsets), np.log(3.0)))
    with np.errstate(all="raise", under="ignore"):
        gains = target.gains(templates, TURNED.converted(START, STRAIGHT))
    assert gains[0] < -1.0  # a ridge on the window that is not there costs evidence
    assert np.all((np.abs(gains[1:]) < 0.5) | (gains[1:] == -np.inf))
    assert abs(gains[2]) < 0.1
    assert gains[-1] == -np.inf


def test_a_draw_without_evidence_takes_the_first_field_quietly() -> None:
    evidence = np.array([[-np.inf, -np.inf], [-1e300, 0.0]])
    with np.errstate(all="raise", under="ignore"):
        assert collapsed.choose_fields(evidence, np.random.default_rng(1)).tolist() == [0, 1]
