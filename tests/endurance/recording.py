"""Recordings of hours, beside busy processes, and killed: ``python tests/endurance/recording.py [memory|load|kills]``.

``memory``: resident memory and frames per CPU second while ``--frames`` frames (2 h of a head at 200 Hz) and their
poses are written as fast as they can be. ``load``: emulated head and tracker recorded while 0, 2 and 4 processes are
busy. ``kills``: SIGKILL at random times; what the file has lost.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import RecordingWriter, create_exclusive, read_scan, read_scan_report

RATE_HZ = 200.0
SCENE = """[scene]
seed = 5
duration_s = {duration}
frame_rate_hz = 200.0
pose_rate_hz = 120.0
[[lump]]
amplitude = 0.3
d_mm = 15.0
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["memory", "load", "kills"])
    parser.add_argument("--duration", type=float, default=60.0, help="of the scan in s (60)")
    parser.add_argument("--repeats", type=int, default=10, help="kills (10)")
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 2, 4], help="load: busy processes (0 2 4)")
    parser.add_argument("--frames", type=int, default=1_440_000, help="memory: frames to write (2 h at 200 Hz)")
    parser.add_argument("--live", action="store_true", help="load: with the live view")
    parser.add_argument("--size-calibration", type=Path, metavar="FILE", help="load: sizes in the live view")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scan = make_scan(folder, options.duration)
        {"memory": memory, "load": load, "kills": kills}[options.what](folder, scan, options)


def make_scan(folder: Path, duration_s: float) -> Path:
    """A simulated scan to emulate."""
    (folder / "scene.toml").write_text(SCENE.format(duration=duration_s), encoding="utf-8")
    program(["simulate", "scene.toml", "-o", "scan.mcap"], folder).wait()
    return folder / "scan.mcap"


def program(words: Sequence[str], folder: Path, **options: Any) -> subprocess.Popen[str]:
    """The program in a process of its own."""
    command = [sys.executable, "-m", "tactile_bayes", *words]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | options
    variables = dict(os.environ) | {"TERM": "dumb", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(command, cwd=folder, env=variables, text=True, **quiet)


def memory(folder: Path, scan: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Write a long recording, three poses to five frames, flushed as often as a live one; the memory in ten parts."""
    data, rows = read_scan(scan), []
    with create_exclusive(folder / "long.mcap", force=True) as stream:
        writer = RecordingWriter(
            stream,
            head=data.head,
            element_calibration=data.element_calibration,
            session={"source": "benchmark"},
            provenance=Provenance("benchmark", {}),
        )
        begun = time.process_time()
        print(f"{'frames':>10} {'hours':>6} {'RSS MB':>8} {'frames per CPU s':>17}")
        for number in range(options.frames + 1):
            if number % max(1, options.frames // 10) == 0:
                rows.append(_memory_row(number, time.process_time() - begun))
            write_moment(writer, data, number)
        writer.close({})
    return rows


def write_moment(writer: Any, data: Any, number: int) -> None:
    """The n-th frame, and the pose that comes with three frames in five."""
    time_ns = round(number / RATE_HZ * 1e9)
    counts = data.frames.counts[number % len(data.frames)]
    writer.add_frame(counts, device_ns=time_ns, host_ns=time_ns)
    if number % 5 in (0, 2, 4):
        i = number % len(data.poses)
        position, turn = data.poses.position_mm[i], data.poses.quaternion_wxyz[i]
        writer.add_pose(position, turn, device_ns=time_ns, host_ns=time_ns)
    if number % round(0.2 * RATE_HZ) == 0:
        writer.flush()


def _memory_row(number: int, cpu_s: float) -> dict[str, Any]:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    row = {
        "frames": number,
        "hours": round(number / RATE_HZ / 3600, 2),
        "rss_mb": round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1),
        "frames_per_cpu_s": round(number / cpu_s) if number else 0,
    }
    print(f"{number:>10,} {row['hours']:>6} {row['rss_mb']:>8} {row['frames_per_cpu_s']:>17,}", flush=True)
    return row


@contextlib.contextmanager
def devices(folder: Path, scan: Path) -> Iterator[tuple[list[str], dict[str, int]]]:
    """Emulated head and tracker on pseudo-terminals: words for `record`, and their process ids."""
    started = {
        kind: program(["emulate", kind, str(scan)], folder, stdout=subprocess.PIPE) for kind in ("head", "tracker")
    }
    urls = {kind: process.stdout.readline().strip() for kind, process in started.items() if process.stdout}
    words = ["--head", urls["head"], "--tracker", urls["tracker"], "--tracker-protocol", "open", "--clock", "shared"]
    try:
        yield [*words, "--like", str(scan)], {kind: process.pid for kind, process in started.items()}
    finally:
        for process in started.values():
            process.terminate()
            process.wait()


def load(folder: Path, scan: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Record the whole scan while others are busy."""
    live = ["--live"] if options.live else []
    if options.size_calibration:
        live += ["--size-calibration", str(options.size_calibration.absolute())]
    rows = []
    for busy in options.busy:
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
        try:
            with devices(folder, scan) as (words, pids):
                output = folder / f"busy{busy}.mcap"
                shown = (folder / f"busy{busy}.txt").open("w+")
                process = program(["record", "-o", output.name, *words, *live], folder, stderr=shown)
                time.sleep(options.duration * 0.9)
                used = processes_cpu({"record": process.pid, **pids})
                process.wait()
            row = {"busy": busy, "exit": process.returncode, **account_of(output), "cpu_s": used}
            with shown:
                shown.seek(0)
                row |= view_of(shown.read())
        finally:
            for other in others:
                other.kill()
                other.wait()
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def view_of(text: str) -> dict[str, Any]:
    """How far the live view was behind the recorder, and how much it did."""
    behind = sorted(int(found) for found in re.findall(r"view (\d+) ms behind", text))
    last = re.search(r"(\d+) drawings and (\d+) estimates in ([\d.]+) s", text)
    if not behind or not last:
        return {}
    seconds = float(last[3])
    return {
        "view_behind_ms": {"median": behind[len(behind) // 2], "max": behind[-1]},
        "drawings_per_s": round(int(last[1]) / seconds, 1),
        "estimates_per_s": round(int(last[2]) / seconds, 1),
    }


def account_of(path: Path) -> dict[str, Any]:
    """The account that the recording closed with."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        found = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}["recording"]
    names = ("frames", "frames_lost", "head_dropped", "poses", "overrun_bytes", "longest_wait_ms", "ended_by")
    return {name: found[name] for name in names}


def processes_cpu(pids: dict[str, int]) -> dict[str, float]:
    """CPU seconds so far of some processes and of the children of `record`."""
    tick = os.sysconf("SC_CLK_TCK")
    found = {}
    names = {pid: name for name, pid in pids.items()}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            pid, parent = int(path.parent.name), int(fields[1])
            name = names.get(pid) or (f"reader {pid}" if parent == pids["record"] else None)
            if name:
                found[name] = (int(fields[11]) + int(fields[12])) / tick
    return dict(sorted(found.items()))


def kills(folder: Path, scan: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """SIGKILL the recorder at random times: frames the head had sent, frames in the file."""
    rng, rows = random.Random(1), []
    print("killed after s   frames in file   lost s")
    for number in range(options.repeats):
        after_s = rng.uniform(1.0, 6.0)
        output = folder / f"kill{number}.mcap"
        with devices(folder, scan) as (words, _):
            process = program(["record", "-o", output.name, *words], folder)
            while not output.exists():
                time.sleep(0.001)
            begun = time.monotonic()  # the file is made just before the devices are told to start
            time.sleep(after_s)
            process.send_signal(signal.SIGKILL)
            killed_s = time.monotonic() - begun
            process.wait()
        frames = read_scan_report(output).scan.frames
        held_s = float(frames.time_s[-1]) + 1 / RATE_HZ
        row = {"killed_after_s": round(killed_s, 3), "frames": len(frames), "lost_s": round(killed_s - held_s, 3)}
        rows.append(row)
        print(f"{row['killed_after_s']:>14} {row['frames']:>16} {row['lost_s']:>8}", flush=True)
    return rows


if __name__ == "__main__":
    main()
