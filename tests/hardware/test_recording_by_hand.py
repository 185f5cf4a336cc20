"""docs/guides/record.md followed word by word, with a pause before space: the map is that of the scan."""

from __future__ import annotations

import os
import pty
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from emulated_devices import short_scan

from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.select import scan_findings
from tactile_bayes.scans import Scan, TrackerPoses

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "record.md"
DURATION_S = 3.0
PAUSE_S = 1.5


@pytest.fixture(scope="module")
def scan() -> Scan:
    return short_scan(DURATION_S)


@pytest.fixture
def folder(tmp_path, scan) -> Path:
    write_scan(tmp_path / "scan.mcap", scan, provenance=Provenance("test", {}))
    return tmp_path


def commands() -> list[list[str]]:
    """The commands of the blocks that are marked so: emulate, record, map."""
    blocks = re.findall(r"```console by-hand\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    lines = [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]
    return [shlex.split(line) for line in lines]


@contextmanager
def running(words: Sequence[str], folder: Path, environment: dict[str, str], **streams) -> Iterator[subprocess.Popen]:
    """``tactile-bayes WORDS`` in the background, ended with the block."""
    command = [sys.executable, "-m", "tactile_bayes", *words]
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        text=True,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=20)


def record_by_hand(words: Sequence[str], folder: Path, environment: dict[str, str]) -> str:
    """Wait for the prompt and a while longer, press space, let the head end it; what was printed."""
    near, far = pty.openpty()
    with running(words, folder, environment, stdin=far) as process:
        assert "space start" in process.stderr.readline()
        time.sleep(PAUSE_S)
        os.write(near, b" ")
        out, err = process.communicate(timeout=60)
    os.close(near)
    os.close(far)
    assert process.returncode == 0, err
    return out


def peak(found: TactileMap) -> tuple[float, float, float]:
    """Where the map is highest, mm, and how high."""
    row, column = np.unravel_index(np.nanargmax(found.mean), found.mean.shape)
    return float(found.x_mm[column]), float(found.y_mm[row]), float(found.mean[row, column])


def agrees(found: TactileMap, scan: Scan) -> bool:
    """Whether the lump is where the scan's own map has it, as high."""
    here, there = peak(found), peak(build_map([scan]))
    return np.hypot(here[0] - there[0], here[1] - there[1]) < 4.0 and abs(here[2] / there[2] - 1) < 0.03


def later_poses(scan: Scan, late_s: float) -> Scan:
    """The scan as it was recorded when the tracker began to play so long before the head."""
    poses, keep = scan.poses, scan.poses.time_s >= late_s
    shifted = TrackerPoses(poses.time_s[keep] - late_s, poses.position_mm[keep], poses.quaternion_wxyz[keep])
    return Scan(scan.frames, shifted, scan.head, scan.element_calibration, session=scan.session)


@pytest.mark.long
def test_the_page_followed_word_by_word_gives_a_true_map(folder, scan, child_environment):
    emulate, record, build = [words[1:] for words in commands()]
    with running(emulate, folder, child_environment) as devices:
        ports = dict(devices.stdout.readline().split() for _ in range(2))
        record = [{"/dev/pts/3": ports["head"], "/dev/pts/4": ports["tracker"]}.get(word, word) for word in record]
        out = record_by_hand(record, folder, child_environment)
    assert not re.search(r"poses (start|end) [1-9]", out)  # a busy computer may cost a few of the first
    assert len(read_scan(folder / "again.mcap").poses) >= 0.6 * len(scan.poses)
    done = subprocess.run(
        [sys.executable, "-m", "tactile_bayes", *build],
        cwd=folder,
        env=child_environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert agrees(read_map(folder / "again.nc"), scan)
    assert not agrees(build_map([later_poses(scan, PAUSE_S)]), scan)  # what came of it before


@pytest.mark.long
def test_devices_emulated_one_by_one_play_together_too(folder, scan, child_environment):
    with ExitStack() as stack:
        words = [["emulate", "head", "scan.mcap"], ["emulate", "tracker", "scan.mcap", "--protocol", "liberty"]]
        both = [stack.enter_context(running(one, folder, child_environment)) for one in words]
        head, tracker = (one.stdout.readline().strip() for one in both)
        record = ["record", "-o", "again.mcap", "--head", head, "--tracker", tracker, "--tracker-protocol", "liberty"]
        record_by_hand([*record, "--like", "scan.mcap"], folder, child_environment)
    assert agrees(build_map([read_scan(folder / "again.mcap")]), scan)


def test_poses_of_other_times_are_told_by_map_and_show(folder, scan, run_cli):
    write_scan(folder / "late.mcap", later_poses(scan, PAUSE_S), provenance=Provenance("test", {}))
    for words in (["show", "late.mcap"], ["map", "late.mcap", "-o", "late.nc"]):
        done = run_cli(*words, cwd=folder)
        assert "poses end 1.5 s before the frames" in done.stdout, done.stderr
    assert scan_findings(read_scan(folder / "scan.mcap")) == ()
