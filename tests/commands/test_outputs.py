"""Outputs that the system does not take, or that must not be overwritten: one line, and everything as before."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from map_files import read_grid

from tactile_bayes.cli import cli
from tactile_bayes.commands.options import WRITTEN, FilePath
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import write_text
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance

DEMO = Path(__file__).resolve().parents[2] / "tactile_bayes" / "demo"
Run = Callable[..., "subprocess.CompletedProcess[str]"]

# Runs the program with files of up to 900 bytes: the system refuses the rest, as a full disk does.
FULL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))
from tactile_bayes.cli import main
main()
"""


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a map of a bump and the inputs of other commands."""
    folder = tmp_path_factory.mktemp("outputs")
    x = np.arange(-20.0, 21.0)
    bump = 1 + 0.4 * np.exp(-(x[None, :] ** 2 + x[:, None] ** 2) / 72)
    mean = bump + np.random.default_rng(1).normal(0, 0.01, bump.shape)
    np.savez(folder / "g.npz", mean=mean, spacing_mm=np.array(1.0))
    write_map(folder / "map.nc", read_grid(folder / "g.npz", normalise="mean"), provenance=Provenance("test", {}))
    for name in ("scan.mcap", "trial.csv", "excision.csv"):
        shutil.copy(DEMO / name, folder / name)
    return folder


WRITERS = {
    "estimate -o": ("estimate", "map.nc", "--method", "laplace", "--size-calibration", "none", "-o"),
    "import a grid": ("import", "g.npz", "--as", "map", "-o"),
    "import a scan": ("import", "scan.mcap", "-o"),
    "map": ("map", "scan.mcap", "-o"),
    "validate": ("validate", "trial.csv", "--excision", "excision.csv", "-o"),
}
SUFFIX = {"estimate -o": ".nc", "import a grid": ".nc", "import a scan": ".mcap", "map": ".nc", "validate": ".json"}


@pytest.mark.parametrize("words", [WRITERS["map"], WRITERS["estimate -o"], ("map", "scan.mcap", "--figure")])
def test_the_name_of_a_new_folder_is_no_file(words, plain, run_cli):
    """``map scan.mcap -o maps/`` wrote a file called maps."""
    done = run_cli(*words, "maps/", cwd=plain)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: maps/ is the name of a folder; name a file, in a folder that exists\n"
    assert not (plain / "maps").exists()


@pytest.mark.long
@pytest.mark.parametrize("case", WRITERS)
def test_a_disk_that_is_full_leaves_what_was_there(case: str, plain: Path, run_python: Run) -> None:
    folder = plain / f"full {case}"
    folder.mkdir()
    output = folder / f"out{SUFFIX[case]}"
    output.write_text("of an earlier run")
    done = run_python("-c", FULL, *WRITERS[case], output, "--force", cwd=plain)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert output.read_text() == "of an earlier run"
    assert list(folder.iterdir()) == [output]


def test_a_full_standard_output_is_one_line(plain: Path, child_environment: dict[str, str]) -> None:
    words = [sys.executable, "-m", "tactile_bayes", "show", str(plain / "map.nc")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, env=child_environment)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "the standard output cannot be written (No space left on device)" in done.stderr


def test_a_reader_that_has_gone_is_no_fault(plain: Path, child_environment: dict[str, str]) -> None:
    words = [sys.executable, "-m", "tactile_bayes", "show", str(plain / "map.nc")]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True, env=child_environment)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


TARGETS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a FIFO": (os.mkfifo, "is a FIFO; give the name of a regular file"),
    "a directory": (Path.mkdir, "is a directory; give the name of a regular file"),
    "a link to a device": (lambda path: path.symlink_to("/dev/null"), "is a device; give"),
}


@pytest.mark.parametrize("case", TARGETS)
def test_force_replaces_regular_files_only(case: str, tmp_path: Path) -> None:
    make, message = TARGETS[case]
    path = tmp_path / "out"
    make(path)
    before = path.lstat()
    with pytest.raises(UsageError, match=message):
        write_text(path, "new", force=True)
    assert path.lstat().st_mode == before.st_mode
    assert [one.name for one in tmp_path.iterdir()] == ["out"]


def test_a_link_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "target"
    target.write_text("old")
    (tmp_path / "link").symlink_to(target)
    write_text(tmp_path / "link", "new", force=True)
    assert (tmp_path / "link").is_symlink()
    assert target.read_text() == "new"
    assert [one.name for one in target.parent.iterdir()] == ["target"]


def test_a_long_name_is_one_line_and_a_nearly_too_long_one_is_written(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot be written \(File name too long\); choose a shorter name"):
        write_text(tmp_path / ("x" * 300), "new")
    write_text(tmp_path / ("x" * 255), "new")
    assert [one.name for one in tmp_path.iterdir()] == ["x" * 255]


INPUTS = {
    "settings": ("estimate", "map.nc", "--settings", "p", "-o", "p", "--force"),
    "settings by a link": ("estimate", "map.nc", "--settings", "p", "--figure", "link.png", "--force"),
    "settings by a hard link": ("estimate", "map.nc", "--settings", "p", "-o", "hard", "--force"),
    "a scene": ("simulate", "p", "-o", "p", "--force"),
    "a table": ("calibrate", "size", "p", "-o", "./p", "--force"),
    "a protocol": ("validate", "t.csv", "--excision", "e.csv", "--protocol", "p", "--html", "p", "--force"),
    "a scan": ("repair", "p", "-o", "p", "--force"),
}


@pytest.mark.parametrize("case", INPUTS)
def test_an_output_is_never_an_input(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "p"
    path.write_text("amplitude_sd = 0.5\n")
    (tmp_path / "link.png").symlink_to(path)
    (tmp_path / "hard").hardlink_to(path)
    with pytest.raises(UsageError, match="is an input of this command; choose another name for the output"):
        cli.main([*INPUTS[case]], standalone_mode=False)
    assert path.read_text() == "amplitude_sd = 0.5\n"


CALIBRATIONS = {
    "record": ("record", "-o", "s", "--head", "/dev/nothing", "--size-calibration", "s", "--force"),
    "replay": ("replay", "scan.mcap", "-o", "s", "--size-calibration", "s", "--force"),
    "estimate": ("estimate", "map.nc", "--size-calibration", "s", "-o", "s", "--force"),
    "tradeoff map": ("tradeoff", "estimate", "m.nc", "--size-calibration", "s", "--figure", "link.png", "--force"),
    "tradeoff": ("tradeoff", "forward", "--size-calibration", "s", "--figure", "link.png", "--force"),
}


@pytest.mark.parametrize("case", CALIBRATIONS)
def test_an_output_is_never_the_size_calibration(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(DEMO / "scan.mcap", tmp_path)
    (tmp_path / "s").write_text("{}")
    (tmp_path / "link.png").symlink_to(tmp_path / "s")
    with pytest.raises(UsageError, match="is an input of this command; choose another name for the output"):
        cli.main([*CALIBRATIONS[case]], standalone_mode=False)
    assert (tmp_path / "s").read_text() == "{}"


@pytest.mark.parametrize("name", ["sold", ""])
def test_a_recording_without_a_view_refuses_a_size_calibration_that_is_none(name: str, tmp_path: Path) -> None:
    words = ["record", "-o", str(tmp_path / "s.mcap"), "--head", "/dev/nothing", "--size-calibration", name]
    with pytest.raises(UsageError, match=f"no calibration or file is called '{name}'"):
        cli.main(words, standalone_mode=False)


@pytest.mark.parametrize("option", ["-o", "--html"])
def test_an_output_is_never_a_posterior_that_a_trial_table_names(option: str, plain: Path, tmp_path: Path) -> None:
    for name in ("trial.csv", "excision.csv"):
        shutil.copy(plain / name, tmp_path)
    stated = tmp_path / "one"
    stated.write_text(
        CliRunner().invoke(cli, ["estimate", str(plain / "map.nc"), "--method", "laplace", "--json"]).stdout
    )
    before = stated.read_text()
    found = json.loads(before)["max_size_mm"] is not None
    lines = (tmp_path / "trial.csv").read_text().splitlines()
    first = dict(zip(lines[0].split(","), lines[1].split(","), strict=False))
    row = {name: value if name in ("patient", "mass", "modality", "replicate") else "" for name, value in first.items()}
    row |= {"status": "detected" if found else "not_detected", "posterior": "one"}
    header = list(dict.fromkeys([*lines[0].split(","), "posterior"]))
    (tmp_path / "trial.csv").write_text(",".join(header) + "\n" + ",".join(row.get(name, "") for name in header) + "\n")
    words = ["validate", tmp_path / "trial.csv", "--excision", tmp_path / "excision.csv", option, stated, "--force"]
    with pytest.raises(UsageError, match="is an input of this command"):
        cli.main([str(word) for word in words], standalone_mode=False)
    assert stated.read_text() == before


def test_two_outputs_of_one_name_are_refused() -> None:
    with pytest.raises(UsageError, match="two outputs"):
        cli.main(["validate", "t.csv", "--excision", "e.csv", "-o", "m", "--html", "m"], standalone_mode=False)


def _leaves(command: click.Command, context: click.Context) -> list[click.Command]:
    if not isinstance(command, click.Group):
        return [command]
    below = [command.get_command(context, name) for name in command.list_commands(context)]
    return [leaf for one in below if one is not None for leaf in _leaves(one, context)]


def test_every_option_that_writes_is_among_those_that_are_compared() -> None:
    """By the first words of its help; and every path is of the type that compares."""
    begins = ("write", "draw", "where to write", "scan file to write", "file to write")
    for command in _leaves(cli, click.Context(cli)):
        for parameter in command.params:
            assert type(parameter.type) is not click.Path, f"{command.name}: {parameter.name}"
            if isinstance(parameter.type, FilePath) and isinstance(parameter, click.Option):
                writes = (parameter.help or "").lower().startswith(begins)
                assert not writes or parameter.name in WRITTEN, f"{command.name}: {parameter.name}"
