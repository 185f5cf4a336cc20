"""The methods on one scene: they agree, pass on what they cannot do, stop and go on, and check each other."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, NotConvergedError
from tactile_bayes.files.npz import CheckpointFile
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.importance import ImportanceOptions, importance
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior import draw as methods
from tactile_bayes.posterior.draw import (
    SamplerSettings,
    SamplingTarget,
    disagreement,
    draw_parameters,
    importance_draws,
)
from tactile_bayes.posterior.fit import FieldFit, fit_scene
from tactile_bayes.posterior.marginal import Scene
from tactile_bayes.posterior.window import Problem
from tests.posterior.correlated.test_marginal import cells_of, fitted, noise
from tests.posterior.correlated.test_selection import bump, choose, errors, rib, second


@cache
def weak() -> FieldFit:
    return fitted(cells_of(noise(5, field=0.02), amplitude=0.12))


@cache
def strong() -> FieldFit:
    return fitted(cells_of(noise(5, white=0.005, field=0.005)))


@cache
def half_covered() -> FieldFit:
    cells = cells_of(noise(7, field=0.01))
    keep = cells.x_mm < 5.0
    names = ("x_mm", "y_mm", "value", "variance", "count", "row", "column")
    return fitted(replace(cells, **{name: getattr(cells, name)[keep] for name in names}))


@cache
def beside() -> FieldFit:
    return choose(bump() + second(x=16.0, y=8.0) + errors(2)).fit


FITS = {"strong": strong, "weak": weak, "half covered": half_covered, "beside": beside}


def ends(draws: np.ndarray) -> np.ndarray:
    return np.quantile(draws, [0.025, 0.975], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["weak", "beside", "strong", "half covered"])
def test_importance_ends_are_as_good_as_they_say(name: str) -> None:
    """Against one long run by other points: six runs, each end within four of its stated errors."""
    density = FITS[name]().sampling_target()
    many = ImportanceOptions(accuracy_sd=1.0, first=16384)
    long = importance(
        density.log_density, density.mean, density.covariance, rng=np.random.default_rng(99), options=many
    )
    sd = long.flat.std(axis=0)
    off = []
    for seed in range(6):
        draws = importance_draws(density, rng=np.random.default_rng(seed))
        assert draws.diagnostics["end_error_sd"] <= 0.02
        off.append((ends(draws.flat) - ends(long.flat)) / sd)
    assert np.sqrt(np.mean(np.square(off), axis=0)).max() <= 0.04
    assert np.sqrt(np.mean(np.square(off))) <= 0.025


def test_evidence_is_that_of_a_quadrature() -> None:
    """A round bump has three parameters: a grid of Gauss-Hermite points is a second, independent way."""
    fit = fitted(cells_of(noise(5, field=0.01)), scene=Scene("round"), start=np.array([1.6, 1.3, -0.8]))
    node, weight = np.polynomial.hermite_e.hermegauss(9)
    root = np.linalg.cholesky(fit.covariance)
    z = np.stack([v.ravel() for v in np.meshgrid(node, node, node, indexing="ij")], axis=1)
    w = np.prod(np.stack([v.ravel() for v in np.meshgrid(weight, weight, weight, indexing="ij")]), axis=0)
    log_density = fit.target(fit.mode + z @ root.T) + 0.5 * np.sum(z**2, axis=1)
    exact = np.logaddexp.reduce(log_density + np.log(w)) + np.linalg.slogdet(root)[1]
    draws = importance_draws(fit.sampling_target(), rng=np.random.default_rng(1))
    assert draws.diagnostics["log_evidence"] == pytest.approx(exact, abs=0.01)
    assert fit.log_evidence == pytest.approx(exact, abs=0.1)
    # the fields that were left out are made up for: with all of them the same
    everything = fit.target.of_scene(fit.scene)
    assert everything(fit.mode[None])[0] == pytest.approx(fit.target(fit.mode[None])[0], abs=1e-6)


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", list(FITS))
def test_gaussians_are_as_wide_as_the_density(name: str) -> None:
    fit = FITS[name]()
    k = fit.scene.bump_parameters
    exact = fit.sampling_target().with_second_structure(
        importance_draws(fit.sampling_target(), rng=np.random.default_rng(1)), np.random.default_rng(2)
    )
    drawn = fit.draw_at_mode("laplace", 4000, np.random.default_rng(3))
    np.testing.assert_allclose(drawn.flat[:, :k].std(axis=0), exact.flat[:, :k].std(axis=0), rtol=0.15)


def test_what_stands_beside_adds_its_uncertainty() -> None:
    density = beside().sampling_target()
    held = importance_draws(density, rng=np.random.default_rng(1))
    whole = density.with_second_structure(held, np.random.default_rng(2))
    assert whole.flat.shape[1] == len(beside().scene.names)
    np.testing.assert_allclose(whole.flat[:, 4:], np.broadcast_to(beside().mode[4:], whole.flat[:, 4:].shape))
    added = np.diag(density.spread @ density.spread.T)
    np.testing.assert_allclose(whole.flat[:, :4].var(axis=0), held.flat.var(axis=0) + added, rtol=0.05)


@pytest.mark.long
def test_a_method_that_fails_hands_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def heavy(_: SamplingTarget, **__: object) -> ParameterDraws:
        raise NotConvergedError("Pareto shape 0.91", diagnostics={"pareto_k": 0.91})

    judged = FieldFit.draw_at_mode

    def untrusted(fit: FieldFit, *options: Any) -> ParameterDraws:
        draws = judged(fit, *options)
        return replace(draws, diagnostics=dict(draws.diagnostics) | {"pareto_k": float("nan")})

    monkeypatch.setattr(FieldFit, "draw_at_mode", untrusted)
    draws, passed = draw_parameters(
        strong(), SamplerSettings(method="laplace", noise="field"), rng=np.random.default_rng(1)
    )
    assert draws.method == "importance"
    assert passed[0].startswith("laplace: Pareto shape nan")
    monkeypatch.setattr(methods, "importance_draws", heavy)
    with pytest.raises(NotConvergedError, match=r"laplace: .*importance: Pareto shape 0.91$"):
        draw_parameters(strong(), SamplerSettings(method="laplace", noise="field"), rng=np.random.default_rng(1))
    with pytest.raises(NotConvergedError, match=r"importance: Pareto shape 0.91; ensemble: .*max_steps"):
        draw_parameters(strong(), SamplerSettings(max_steps=150, noise="field"), rng=np.random.default_rng(1))


def test_accuracy_in_millimetres_is_accuracy_of_the_widths() -> None:
    fit = strong()
    options = SamplerSettings(accuracy_mm=0.004)
    assert methods.accuracy_in_sd(options, fit.width_sd_mm) == pytest.approx(0.004 / fit.width_sd_mm)
    assert methods.accuracy_in_sd(SamplerSettings(accuracy_sd=0.01, accuracy_mm=0.5), fit.width_sd_mm) == 0.01
    draws, _ = draw_parameters(fit, options, rng=np.random.default_rng(1))
    assert draws.diagnostics["end_error_mm"] <= 0.004
    coarse, _ = draw_parameters(fit, SamplerSettings(), rng=np.random.default_rng(1))
    assert coarse.diagnostics["end_error_mm"] > 0.0


@cache
def quick() -> FieldFit:
    """Three parameters in a small window: chains whose place is not the point."""
    start = np.array([1.6, 1.3, -0.8])
    return fitted(cells_of(noise(5, white=0.005, field=0.005), radius=12.0), scene=Scene("round"), start=start)


def run(
    path: Path | None, *, max_steps: int, seed: int = 3, fit: FieldFit | None = None, context: str = ""
) -> ParameterDraws:
    store = None if path is None else CheckpointFile(path, context=context)
    options = SamplerSettings(method="ensemble", accuracy_sd=0.08, max_steps=max_steps, store=store)
    return draw_parameters(fit or quick(), options, rng=np.random.default_rng(seed))[0]


@cache
def whole_run() -> ParameterDraws:
    return run(None, max_steps=6000)


@pytest.mark.slow
def test_a_resumed_run_is_the_run_that_was_never_stopped(tmp_path: Path) -> None:
    path = tmp_path / "chain.npz"
    with pytest.raises(NotConvergedError, match="not converged after 150 steps"):
        run(path, max_steps=150)
    resumed, whole = run(path, max_steps=6000), whole_run()
    assert resumed.diagnostics["steps"] > 150
    np.testing.assert_array_equal(resumed.theta, whole.theta)
    assert resumed.diagnostics == whole.diagnostics
    again = run(path, max_steps=6000)  # nothing is left to do
    np.testing.assert_array_equal(again.theta, whole.theta)


@pytest.mark.long
def test_another_runs_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.npz"
    with pytest.raises(NotConvergedError, match="not converged after 150 steps"):
        run(path, max_steps=150)
    for changed in ({"seed": 4}, {"fit": weak()}, {"context": "another calibration"}):
        with pytest.raises(BadDataError, match="of another map, calibration or setting"):
            run(path, max_steps=6000, **changed)  # type: ignore[arg-type]
    prior, scene = BumpPrior(log_width_sd=2.0), quick().scene
    other = fit_scene(Problem(quick().target.window, prior, 20.0), scene, quick().mode)
    with pytest.raises(BadDataError, match="of another map, calibration or setting"):
        run(path, max_steps=6000, fit=other)


@pytest.mark.parametrize("content", [b"", b"no archive at all", None])
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "chain.npz"
    if content is None:
        np.savez(path, schema=np.array("something/else"))
    else:
        path.write_bytes(content)
    with pytest.raises(BadDataError, match="is no checkpoint"):
        run(path, max_steps=6000)


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "chain.npz"
    np.savez(path, schema=np.array("tactile-bayes/checkpoint/1"), chain=np.array([{"a": 1}], dtype=object))
    with pytest.raises(BadDataError, match="is no checkpoint"):
        run(path, max_steps=6000)


@pytest.mark.slow
def test_ensemble_and_importance_check_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    assert whole_run().diagnostics["disagreement"] < methods.DISAGREEMENT

    honest = methods.importance_draws

    def narrow(density: SamplingTarget, **options: object) -> ParameterDraws:
        draws = honest(density, **options)  # type: ignore[arg-type]
        return replace(draws, theta=density.mean + 0.5 * (draws.theta - density.mean))

    monkeypatch.setattr(methods, "importance_draws", narrow)
    with pytest.raises(NotConvergedError, match="disagree"):
        run(None, max_steps=6000)


def test_disagreement_counts_joint_errors() -> None:
    rng = np.random.default_rng(1)
    one = ParameterDraws(rng.standard_normal((1, 8000, 2)), "ensemble", {"ess_tail": 8000.0, "ess_bulk": 8000.0})
    other = ParameterDraws(rng.standard_normal((1, 8000, 2)), "importance", {"end_error_sd": 0.03})
    assert disagreement(one, other) < 4.0
    assert disagreement(one, replace(other, theta=other.theta + 0.4)) > methods.DISAGREEMENT
    for end in (-1.0, 1.0):  # each end counts
        tail = np.where(end * other.theta > 1.0, 1.3 * other.theta, other.theta)
        assert disagreement(one, replace(other, theta=tail)) > methods.DISAGREEMENT


def test_a_rib_of_which_only_a_flank_shows_is_sampled_all_the_same() -> None:
    choice = choose(bump() + rib(y=22.0) + errors(8))
    assert choice.fit.scene.extra == "rib"
    draws, passed = draw_parameters(choice.fit, SamplerSettings(), rng=np.random.default_rng(1))
    assert draws.method == "importance"
    assert not passed
