"""`diagnose`: its table, its figures and its refusals."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes as tb
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import write_bytes
from tactile_bayes.files.netcdf import Contents, Variable, grouped_netcdf_bytes

MAGIC = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}


def write(path: Path, chains: int, *, off: float = 0.0) -> np.ndarray:
    """A posterior of log-normal sizes and normal widths; the last chain lies `off` SDs away."""
    rng = np.random.default_rng(4)
    axes = ("chain", "draw")
    base = rng.standard_normal((chains, 500))
    base[-1] += off
    draws = {"max_size_mm": 15.0 * np.exp(0.1 * base), "sigma_x_mm": 5.0 + 0.1 * base}
    held = {name: Variable(np.arange(n), (name,), {}) for name, n in zip(axes, base.shape, strict=True)}
    held |= {name: Variable(values, axes, {}) for name, values in draws.items()}
    attributes = {"schema": "tactile-bayes/posterior/1", "method": "ensemble", "diagnostics": '{"pareto_k": 0.25}'}
    write_bytes(path, grouped_netcdf_bytes({"posterior": Contents(held, attributes)}), force=True)
    return draws["max_size_mm"]


def test_chains_that_agree_are_told_from_those_that_do_not(tmp_path: Path) -> None:
    """R-hat by its first definition (Gelman & Rubin 1992), computed here: over 1.2 for a chain three SDs off."""
    for name, off in (("good", 0.0), ("bad", 3.0)):
        draws = np.log(write(tmp_path / f"{name}.nc", 4, off=off))
        done = run_here("diagnose", tmp_path / f"{name}.nc", "--json", cwd=tmp_path)
        found = json.loads(done.stdout)["quantities"]["max_size_mm"]
        within, between = draws.var(axis=1, ddof=1).mean(), draws.mean(axis=1).var(ddof=1)
        classical = np.sqrt((499 / 500 * within + between) / within)
        assert (found["rhat"] > 1.2) == (classical > 1.2) == (name == "bad")
        if name == "good":
            assert found["rhat"] == pytest.approx(classical, abs=0.02)
            # the error of the median of independent normal draws
            expected = 15.0 * 0.1 * np.sqrt(np.pi / 2 / draws.size)
            assert found["mcse_median"] == pytest.approx(expected, rel=0.2)


@pytest.mark.long
def test_figures_are_what_their_names_say(tmp_path: Path) -> None:
    write(tmp_path / "post.nc", 4)
    figures = {"--trace": "t.png", "--rank": "r.pdf", "--corner": "c.svg"}
    named = [word for option, name in figures.items() for word in (option, tmp_path / name)]
    done = run_here("diagnose", tmp_path / "post.nc", *named, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "max_size_mm" in done.stdout
    assert "Research use only" in done.stdout
    for name in figures.values():
        assert (tmp_path / name).read_bytes().startswith(MAGIC[Path(name).suffix])


@pytest.mark.long
def test_a_home_that_cannot_be_written_costs_no_figure(tmp_path: Path, run_python) -> None:
    write(tmp_path / "post.nc", 4)
    nowhere = {"HOME": "/proc", "XDG_CACHE_HOME": "/proc/none", "MPLCONFIGDIR": str(tmp_path)}
    done = run_python("-m", "tactile_bayes", "diagnose", "post.nc", cwd=tmp_path, env=nowhere)
    assert done.returncode == 0, done.stderr


def test_one_chain_has_a_pareto_shape_and_no_ranks(tmp_path: Path) -> None:
    write(tmp_path / "post.nc", 1)
    done = run_here("diagnose", tmp_path / "post.nc", cwd=tmp_path)
    assert "Pareto shape of the weights 0.25" in done.stdout
    assert "R-hat" not in done.stdout
    refused = run_here("diagnose", tmp_path / "post.nc", "--rank", tmp_path / "r.png", cwd=tmp_path)
    assert refused.returncode == 2
    assert "--method ensemble" in refused.stderr
    assert not (tmp_path / "r.png").exists()


def test_convergence_is_arvizs_own(tmp_path: Path) -> None:
    with warnings.catch_warnings():  # its notice of the next major version, once a day
        warnings.simplefilter("ignore", FutureWarning)
        arviz = pytest.importorskip("arviz")
    draws = write(tmp_path / "post.nc", 4)
    found = json.loads(run_here("diagnose", tmp_path / "post.nc", "--json", cwd=tmp_path).stdout)["quantities"][
        "max_size_mm"
    ]
    assert found["ess_bulk"] == pytest.approx(float(arviz.ess(draws, method="bulk")))


def test_python_diagnoses_as_the_command_does(tmp_path: Path) -> None:
    for chains in (1, 4):
        path = tmp_path / f"{chains}.nc"
        write(path, chains)
        found = tb.diagnose(path)
        assert found.text == run_here("diagnose", path, cwd=tmp_path).stdout
        assert found.document == json.loads(run_here("diagnose", path, "--json", cwd=tmp_path).stdout)
        assert f"{chains} chain" in repr(found)
    assert found.plot("rank", tmp_path / "r.svg").axes
    assert (tmp_path / "r.svg").exists()
    with pytest.raises(UsageError, match=r'rank compares chains and .* has one; estimate with method="ensemble"'):
        tb.diagnose(tmp_path / "1.nc").plot("rank")
    with pytest.raises(UsageError, match="kind is 'r'; give one of trace, rank, corner"):
        found.plot("r")
