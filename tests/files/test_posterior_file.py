"""Posterior files: what arviz, xarray and the netCDF library read in them, and what this program reads back."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from posterior_maps import bump_map

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.posterior_nc import read_posterior
from tactile_bayes.presets import RESEARCH_USE


@pytest.fixture(scope="module")
def arviz() -> Any:
    """Imported where it is used: it takes as long as twenty tests."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz


GROUPS = ("posterior", "sample_stats", "observed_data", "prior")


def estimated(method: str) -> SizeEstimate:
    noise = 0.02 * np.random.default_rng(91).standard_normal((51, 51))
    return estimate_one(
        bump_map(noise=noise), Settings(method=method, accuracy_sd=None if method == "laplace" else 0.3)
    )


@pytest.fixture(scope="module")
def chains(tmp_path_factory: pytest.TempPathFactory) -> tuple[SizeEstimate, Path]:
    path = tmp_path_factory.mktemp("chains") / "post.nc"
    made = estimated("ensemble")
    made.write(path)
    return made, path


@pytest.mark.long
def test_arviz_opens_all_groups_and_its_figures_and_summaries_work(
    arviz: Any, chains: tuple[SizeEstimate, Path]
) -> None:
    made, path = chains
    data = arviz.from_netcdf(path)
    assert set(data.groups()) == {*GROUPS, "log_likelihood"}
    assert data.posterior.attrs["research_use"] == RESEARCH_USE
    summary = arviz.summary(data, var_names=["max_size_mm", "sigma_x_mm"])
    found = made.estimate.diagnostics["convergence"]["max_size_mm"]
    assert summary.loc["max_size_mm", "r_hat"] == pytest.approx(found["rhat"], abs=0.005)
    assert summary.loc["max_size_mm", "ess_tail"] == pytest.approx(found["ess_tail"], abs=0.6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of 400 draws some cells' shapes are above its limit; matplotlib is newer
        loo = arviz.loo(data)
        drawn = arviz.plot_trace(data, var_names=["max_size_mm"])
    cells = data.observed_data["value"].size
    assert loo.n_data_points == cells == data.log_likelihood["value"].sizes["cell"]
    # independent errors of SD 0.02 on that many cells, and a model of few parameters
    assert loo.elpd_loo / cells == pytest.approx(-np.log(0.02 * np.sqrt(2 * np.pi * np.e)), abs=0.1)
    assert 0.0 < loo.p_loo < 10.0
    assert drawn.shape == (1, 2)


@pytest.mark.long
def test_statistics_are_of_the_draws(arviz: Any, chains: tuple[SizeEstimate, Path]) -> None:
    made, path = chains
    estimate, data = made.estimate, arviz.from_netcdf(path)
    assert estimate.draws is not None
    assert estimate.scene is not None
    some = estimate.draws.theta[:, ::97]
    expected = estimate.scene.fit.target(some.reshape(-1, some.shape[-1])).reshape(some.shape[:2])
    np.testing.assert_allclose(data.sample_stats["lp"].values[:, ::97], expected, atol=1e-4)
    assert float(data.sample_stats["accepted"].mean()) == pytest.approx(
        estimate.draws.diagnostics["acceptance"], abs=0.05
    )


@pytest.mark.long
def test_python_gives_arviz_the_groups_of_the_file(arviz: Any, chains: tuple[SizeEstimate, Path]) -> None:
    made, path = chains
    held, found = arviz.from_netcdf(path), made.to_arviz()
    assert set(found.groups()) == set(held.groups())
    for group in held.groups():
        assert set(found[group].data_vars) == set(held[group].data_vars)
        for name in held[group].data_vars:
            np.testing.assert_array_equal(found[group][name], held[group][name])
            assert found[group][name].dims == held[group][name].dims


@pytest.mark.long
def test_the_prior_is_the_models(arviz: Any, chains: tuple[SizeEstimate, Path]) -> None:
    """ln of the mean width normal about ln 5 mm with SD 1, half the log ratio with SD 0.5, both below 15 mm."""
    prior = arviz.from_netcdf(chains[1]).prior
    mean_width = 0.5 * np.log(prior["sigma_x_mm"] * prior["sigma_y_mm"]).values.ravel()
    p, q = np.random.default_rng(1).normal([[np.log(5.0)], [0.0]], [[1.0], [0.5]], (2, 100_000))
    assert np.median(mean_width) == pytest.approx(np.median(p[p + np.abs(q) < np.log(15.0)]), abs=0.1)
    assert float(prior["amplitude"].std()) == pytest.approx(2.0, rel=0.1)
    assert prior["max_size_mm"].values.min() > 0


@pytest.mark.long
def test_the_netcdf_library_reads_every_group(chains: tuple[SizeEstimate, Path]) -> None:
    import netCDF4

    with netCDF4.Dataset(chains[1]) as file:
        assert file["posterior"]["max_size_mm"].dimensions == ("chain", "draw")
        assert file["log_likelihood"]["value"].dimensions == ("chain", "draw", "cell")
        assert file["observed_data"]["value"].shape == file["observed_data"]["x_mm"].shape


@pytest.mark.parametrize("method", ["importance", "laplace"])
def test_other_methods_write_the_groups_that_they_have(arviz: Any, method: str, tmp_path: Path) -> None:
    made = estimated(method)
    made.write(tmp_path / "post.nc")
    data = arviz.from_netcdf(tmp_path / "post.nc")
    assert set(data.groups()) == set(GROUPS)
    shape = float(data.sample_stats.attrs["sampler_pareto_k"])
    assert shape == pytest.approx(made.estimate.draws.diagnostics["pareto_k"], abs=1e-6)
    assert np.isfinite(data.sample_stats["log_weight"]).all()


@pytest.mark.long
def test_equal_estimates_give_equal_bytes(chains: tuple[SizeEstimate, Path], tmp_path: Path) -> None:
    chains[0].write(tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == chains[1].read_bytes()


@pytest.mark.long
def test_damage_and_other_files_are_refused(chains: tuple[SizeEstimate, Path], tmp_path: Path) -> None:
    whole = chains[1].read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadDataError, match=r"cut\.nc"):
        read_posterior(tmp_path / "cut.nc")
    from posterior_files import write_maps

    write_maps(tmp_path)
    with pytest.raises(BadDataError, match="holds no posterior"):
        read_posterior(tmp_path / "a.nc")
