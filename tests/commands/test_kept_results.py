"""What a command computed is printed also where the disk does not take its file."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here

import tactile_bayes as tb

DEMO = Path(__file__).resolve().parents[2] / "tactile_bayes" / "demo"


@pytest.fixture
def full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on a disk that is full, with the inputs of the commands."""
    tb.demo_map().save(tmp_path / "map.nc")
    for name in ("trial.csv", "excision.csv", "scan.mcap", "scene.toml", "phantoms.csv"):
        (tmp_path / name).symlink_to(DEMO / name)

    write = Path.write_bytes

    def refusing(path: Path, data: Any) -> int:
        if "map2" in path.name:
            return write(path, data)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", refusing)
    return tmp_path


FAST = ("--method", "laplace")
CASES = {
    "plan": (("plan", "--patients", "16", "--maps", "1", "--trials", "50", "-o", "out.json"), "16"),
    "estimate": (("estimate", "map.nc", *FAST, "--figure", "out.png"), "largest size"),
    "estimate as JSON": (("estimate", "map.nc", *FAST, "--json", "--map-figure", "out.png"), '"max_size_mm"'),
    "pooled": (("estimate", "map.nc", *FAST, "--pool", "--figure", "out.png"), "largest size"),
    "validate": (("validate", "trial.csv", "--excision", "excision.csv", "-o", "out.json"), "Sizes against excision"),
    "a page": (("validate", "trial.csv", "--excision", "excision.csv", "--html", "out.html"), "Sizes against excision"),
    "map": (("map", "scan.mcap", "--every", "4", "-o", "map2.nc", "--figure", "out.png"), "written: map2.nc"),
    "head design": (("head", "design", "--figure", "out.png"), "narrowest"),
    "compare-model": (("compare-model", "scan.mcap", "scene.toml", "--every", "40", "--figure", "out.png"), "frames"),
    "calibrate size": (("calibrate", "size", "phantoms.csv", "-o", "out.json"), "Eq 6"),
    "sbc": (("sbc", "--maps", "1", "--method", "laplace", "--figure", "out.png"), "1 map"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_a_full_disk_takes_the_file_and_not_the_result(case: str, full: Path) -> None:
    words, printed = CASES[case]
    before = {path.name for path in full.iterdir()}
    done = run_here(*words, cwd=full)
    assert (done.returncode, done.stderr.strip().count("\n")) == (2, 0), done.stderr
    assert "cannot be written (No space left on device); make room" in done.stderr
    assert printed in done.stdout
    assert {path.name for path in full.iterdir()} - before <= {"map2.nc"}
