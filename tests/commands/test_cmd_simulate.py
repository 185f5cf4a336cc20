"""`simulate` as a user runs it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from tactile_bayes.actions import simulation
from tactile_bayes.files.atomic import sha256
from tactile_bayes.files.scan_mcap import read_scan_report
from tactile_bayes.forward.simulate import simulate

Run = Callable[..., "CompletedProcess[str]"]
SCENE = "[scene]\nseed = 4\nduration_s = 0.2\n[[lump]]\namplitude = 0.3\nd_mm = 15\n"


def test_a_scene_becomes_a_scan_with_its_seed(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SCENE)
    done = run_cli("simulate", "s.toml", "-o", "a.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "a.mcap: scan, seed 4" in done.stdout
    assert "40 frames of 16 x 26" in done.stdout
    assert "d 15 mm" in done.stdout
    assert "Research use only" in done.stdout
    file = read_scan_report(tmp_path / "a.mcap")
    assert file.provenance["seed"] == 4
    assert file.provenance["inputs"][0]["role"] == "scene"


def test_the_same_seed_gives_the_same_bytes(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SCENE)
    for name, seed in (("a", 9), ("b", 9), ("c", 10)):
        done = run_cli("simulate", "s.toml", "-o", f"{name}.mcap", "--seed", seed, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    a, b, c = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_mistakes_end_in_one_line_and_their_code(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[scene]\nduration_ms = 5\n")
    done = run_cli("simulate", "bad.toml", "-o", "a.mcap", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr == "error: bad.toml: scene.duration_ms is not known; give duration_s, in the unit it names\n"
    (tmp_path / "a.mcap").write_text("mine")
    done = run_cli("simulate", "bad.toml", "-o", "a.mcap", cwd=tmp_path)
    assert done.returncode == 2
    assert "--force" in done.stderr
    assert (tmp_path / "a.mcap").read_text() == "mine"


def test_inputs_are_read_and_told_by_their_digest_before_the_work(
    run_cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong session was refused after minutes, and a scene edited meanwhile was told by the new digest."""
    scene, session = tmp_path / "s.toml", tmp_path / "x.toml"
    scene.write_text(SCENE)
    session.write_text("side = 3\n")
    works = []

    def edited(*arguments: Any, **options: Any) -> Any:
        works.append(scene.write_text("edited"))
        return simulate(*arguments, **options)

    monkeypatch.setattr(simulation, "simulate", edited)
    call = ("simulate", "s.toml", "--session", "x.toml", "-o", "a.mcap")
    assert run_cli(*call, cwd=tmp_path).returncode == 3
    assert not works
    session.write_text('side = "left"\n')
    digest = sha256(scene)
    assert run_cli(*call, cwd=tmp_path).returncode == 0
    assert read_scan_report(tmp_path / "a.mcap").provenance["inputs"][0] == {"role": "scene", "sha256": digest}
    assert works


@pytest.mark.parametrize(("depth_ratio", "warns"), [(1.5, True), (0.8, False)])
def test_a_lump_outside_the_empirical_models_range_is_warned_of(
    run_cli: Run, tmp_path: Path, depth_ratio: float, warns: bool
) -> None:
    text = f"[scene]\nseed = 4\nduration_s = 0.2\n[body]\n[[lump]]\nd_mm = 20\ndepth_ratio = {depth_ratio}\n"
    (tmp_path / "scene.toml").write_text(text)
    done = run_cli("simulate", "scene.toml", "-o", "scan.mcap", "--fidelity", "empirical", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ("warning: h/d 1.5: the empirical model" in done.stderr) == warns
    assert ("warning" in done.stderr) == warns
