"""A command imports only what it uses: `--help` no numpy, the Laplace estimate no scipy.stats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.cli import COMMANDS
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.mapping.map import MapRecipe, TactileMap

DEMO = Path(__file__).resolve().parent.parent / "tactile_bayes" / "demo"
HEAVY = (
    "numpy",
    "scipy",
    "pandas",
    "matplotlib",
    "emcee",
    "arviz",
    "xarray",
    "netCDF4",
    "h5py",
    "mcap",
    "PIL",
    "jinja2",
    "serial",
)
NOT_FOR_LAPLACE = ("scipy.stats", "emcee", "arviz", "pandas", "matplotlib", "xarray")

# Runs the help of every command in this process, and names what had been imported before each and at the end.
HELP = """
import sys
import click
from tactile_bayes.cli import COMMANDS, cli

def ask(command, words):
    command.main([*words, "--help"], prog_name="tactile-bayes", standalone_mode=False)

def walk(command, words):
    ask(cli, words)
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            walk(command.get_command(click.Context(command), name), [*words, name])

ask(cli, [])
print("\\nimported: help", *sys.modules)
for name in COMMANDS:
    walk(cli.get_command(click.Context(cli), name), [name])
    print("\\nimported:", name, *sys.modules)
"""

RUN = """
import sys
from tactile_bayes.cli import cli
status = cli.main(sys.argv[1:], prog_name="tactile-bayes", standalone_mode=False)
assert not status, status
print("\\nimported:", *sys.modules)
"""


def imported_by(process) -> set[str]:
    assert process.returncode == 0, process.stderr
    return set(process.stdout.rpartition("imported:")[2].split())


def test_help_imports_nothing_heavy_and_no_other_command(run_python):
    """The list of commands imports none of them, and the help of each the module of its own group."""
    done = run_python("-c", HELP)
    assert done.returncode == 0, done.stderr
    lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("imported: ")]
    imported = {name: set(modules) for name, *modules in lines}
    assert list(imported) == ["help", *COMMANDS]
    assert not {name for name in imported["help"] if name.startswith("tactile_bayes.commands.")}
    for command, (home, *_) in COMMANDS.items():
        assert f"tactile_bayes.commands.{home.split('.')[0]}" in imported[command]
        assert not imported[command] & set(HEAVY), command


@pytest.fixture
def estimate_inputs(tmp_path: Path, run_cli) -> tuple[Path, Path]:
    """A small map of a plain bump, and a size calibration learned from a small table."""
    x = np.arange(-20.0, 21.0)
    bump = 1 + 0.4 * np.exp(-(x[None, :] ** 2 + x[:, None] ** 2) / (2 * 6.0**2))
    mean = bump + np.random.default_rng(1).normal(0, 0.01, bump.shape)
    count = np.full(mean.shape, 50, dtype=np.int64)
    recipe = MapRecipe("grid", "mean", 1.0)
    tactile_map = TactileMap(mean, np.full(mean.shape, 0.005), count, x, x, recipe, frame_count=2000)
    map_path, table, calibration = (tmp_path / name for name in ("map.nc", "table.csv", "size.json"))
    write_map(map_path, tactile_map, provenance=Provenance("test", {}))
    rows = [
        f"{d},{h},{0.6 * h**-2:.4f},{0.35 * d * h**0.6 * wobble:.4f}"
        for d in (10, 15, 20)
        for h, wobble in ((0.8, 1.02), (1.0, 0.99), (1.5, 1.01))
    ]
    table.write_text("d_mm,depth_ratio,amplitude,sigma_x_mm\n" + "\n".join(rows) + "\n")
    learned = run_cli("calibrate", "size", table, "-o", calibration)
    assert learned.returncode == 0, learned.stderr
    return map_path, calibration


@pytest.mark.long
def test_the_laplace_estimate_imports_only_what_it_uses(run_python, estimate_inputs):
    map_path, calibration = estimate_inputs
    options = ("--size-calibration", calibration, "--method", "laplace", "--json")
    modules = imported_by(run_python("-c", RUN, "estimate", map_path, *options))
    assert "tactile_bayes.inference.modes" in modules
    assert not modules & {*NOT_FOR_LAPLACE, "scipy.optimize"}


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("map", DEMO / "scan.mcap", "-o", "map.nc"),
        ("simulate", DEMO / "scene.toml", "-o", "scan.mcap"),
        ("import", DEMO / "scan.mcap", "-o", "scan.mcap"),
        ("show", DEMO / "scan.mcap"),
        ("validate", DEMO / "trial.csv", "--excision", DEMO / "excision.csv"),
    ],
    ids=lambda words: words[0],
)
def test_what_neither_draws_nor_samples_imports_no_plot_and_no_sampler(words, run_python, tmp_path):
    modules = imported_by(run_python("-c", RUN, *words, cwd=tmp_path))
    assert not modules & set(NOT_FOR_LAPLACE)


def test_a_map_is_made_without_scipy_and_the_posterior(run_python, tmp_path):
    modules = imported_by(run_python("-c", RUN, "map", DEMO / "scan.mcap", "-o", "map.nc", cwd=tmp_path))
    assert not {name for name in modules if name.split(".")[0] == "scipy" or name.startswith("tactile_bayes.posterior")}


def test_a_trial_without_posteriors_is_analysed_without_hdf5_and_the_estimates(run_python):
    modules = imported_by(run_python("-c", RUN, "validate", DEMO / "trial.csv", "--excision", DEMO / "excision.csv"))
    without = ("h5py", "tactile_bayes.posterior", "tactile_bayes.size", "tactile_bayes.mapping")
    assert not {name for name in modules if name.startswith(without)}


def test_a_scan_is_repaired_and_replayed_without_scipy_hdf5_and_sizes(run_python):
    modules = imported_by(run_python("-c", RUN, "repair", DEMO / "scan.mcap"))
    assert "tactile_bayes.actions.devices" in modules
    assert not {name for name in modules if name.startswith(("scipy", "h5py", "tactile_bayes.size"))}
