"""Map building against tuned peers, over time, and frame by frame: ``python -m benchmarks.map_speed [--json OUT]``.

CPU time of this thread, the least of several runs: it hardly depends on what else runs. Every way of the same run
reads the same frames. "path" does what the peers do; "accumulator" also gates, turns poses into projections and keeps
the moments of the plane. `make bench-map` keeps BLAS on one thread.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.last import Comparison
from benchmarks.map_peers import BINCOUNT_FRAMES, BOOST, BOOST_FRAMES, Job, bincount
from tactile_bayes.forward.scene import Head, Scene, Strokes
from tactile_bayes.forward.simulate import head_poses
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.cells import (
    CellSums,
    FramePoses,
    Projection,
    Projector,
    Readout,
    add_frames,
    chunk_frames,
    head_moments,
)
from tactile_bayes.mapping.select import chunks
from tactile_bayes.presets import CELL_MM
from tactile_bayes.scans import ElementCalibration, HeadGeometry

RATE_HZ = 200
_POOL = 2000
_STEP = 10
"""Frames that the live view takes at once, 20 times a second."""


class Frames:
    """Readings and poses of an endless scan, made piece by piece: the same counts come round, the motion goes on."""

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.scene = Scene(duration_s=7.0, strokes=Strokes(), head=Head())
        self.head = HeadGeometry(self.scene.head.surface_mm(), self.scene.head.pitch_mm, np.eye(4))
        gain = 34 / 4095 * (1 + 0.03 * rng.standard_normal(self.head.shape))
        self.calibration = ElementCalibration(gain, np.zeros(self.head.shape))
        self.pool = rng.normal(1144, 40, (_POOL, *self.head.shape)).astype(np.uint16)

    def poses(self, start: int, stop: int) -> FramePoses:
        """Poses of frames `start` to `stop`: the strokes of 7 s again and again."""
        rotation, position = head_poses(self.scene, np.arange(start, stop) / RATE_HZ % self.scene.duration_s)
        return FramePoses(position, rotation, np.ones(stop - start, dtype=bool))

    def counts(self, start: int, stop: int) -> Any:
        """Counts of frames `start` to `stop`, at most `_POOL` of them."""
        first = start % _POOL
        if first + stop - start <= _POOL:
            return self.pool[first : first + stop - start]
        return self.pool[np.arange(start, stop) % _POOL]

    def plane(self) -> FloatArray:
        """The plane under the strokes."""
        return head_moments(self.head, self.poses(0, 1400)).plane().plane_from_base

    def accumulator(self) -> MapAccumulator:
        """An empty map under the strokes."""
        return MapAccumulator(self.head, self.calibration, plane_from_base=self.plane())

    def job(self, frames: int) -> Job:
        """What the peers get: everything per frame prepared beforehand, which our own way does inside its time."""
        good = np.ones(self.head.shape, dtype=bool)
        projector = Projector(self.head, plane_from_base=self.plane(), taxels=good, cell_mm=CELL_MM)
        projection = projector.at(self.poses(0, frames))
        first, shape = projection.block()
        counts = np.concatenate([self.counts(a, min(a + 1000, frames)) for a in range(0, frames, 1000)])
        return Job(
            counts.reshape(frames, -1),
            self.calibration.gain_kpa_per_count.ravel(),
            self.calibration.offset_kpa.ravel(),
            np.ascontiguousarray(projection.matrix[:, :, :3]),
            projection.shift - np.array([first[1], first[0]]),
            projection.taxels[:3],
            shape,
        )


def cpu_s(actions: dict[str, Callable[[], object]], *, runs: int) -> dict[str, float]:
    """Least CPU time of each action over several rounds after one to warm up; each round runs all, one after another.

    What else the machine does then slows all of them alike.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(runs + 1):
        for name, action in actions.items():
            gc.collect()
            start = time.thread_time()
            action()
            if turn:
                times[name].append(time.thread_time() - start)
    return {name: min(values) for name, values in times.items()}


def same_work(source: Frames, job: Job) -> CellSums:
    """What the peers do, our way: levels, projection and scatter, with the frames' numbers prepared beforehand."""
    good = np.ones(source.head.shape, dtype=bool)
    readout, sums = Readout.of(source.calibration, good), CellSums(1.0)
    matrix = np.concatenate([job.turn, job.shift[:, :, None]], axis=2)
    projection = Projection(np.vstack([job.taxels, np.ones(job.taxels.shape[1])]), matrix, 1.0)
    for part in chunks(len(job.counts), chunk_frames(readout.size)):
        pressure, valid = readout.pressure_kpa(job.counts[part])
        level, _ = readout.levels(pressure, valid)
        add_frames(sums, pressure, valid, projection=projection.part(part), level=level)
    return sums


def against_peers(frames: int, *, runs: int) -> dict[str, float]:
    """CPU seconds of each way through the same frames."""
    source = Frames()
    job = source.job(frames)
    poses = source.poses(0, frames)
    counts = job.counts.reshape(frames, *source.head.shape)

    actions: dict[str, Callable[[], object]] = {
        "numpy path": lambda: same_work(source, job),
        "numpy accumulator, all it does": lambda: source.accumulator().add(counts, poses),
    }
    for size in BINCOUNT_FRAMES:
        actions[f"bincount/{size}"] = lambda n=size: bincount(job, frames=n)
    if find_spec("boost_histogram"):
        for name, fill in BOOST.items():
            for size in BOOST_FRAMES:
                actions[f"boost-histogram {name}/{size}"] = lambda n=size, f=fill: f(job, frames=n)
    else:
        print("boost-histogram is not installed: no ratio against it")
    best: dict[str, float] = {}
    for name, value in cpu_s(actions, runs=runs).items():  # each peer at its best chunk
        title = name.split("/")[0]
        best[title] = min(value, best.get(title, value))
    return best


def streamed(minutes: float) -> tuple[float, float]:
    """CPU seconds in `MapAccumulator.add` for a scan made as it goes, and peak memory in MB of this process."""
    source = Frames()
    grown, spent, total = source.accumulator(), 0.0, int(minutes * 60 * RATE_HZ)
    for start in range(0, total, 1000):
        stop = min(start + 1000, total)
        poses, counts = source.poses(start, stop), source.counts(start, stop)
        begin = time.thread_time()
        grown.add(counts, poses)
        spent += time.thread_time() - begin
    if grown.figures["frames_used"] != total:
        raise SystemExit(f"only {grown.figures['frames_used']:.0f} of {total} frames were used")
    return spent, _peak_mb()


def _peak_mb() -> float:
    """Largest resident memory since this program began; the kernel's ru_maxrss would count the parent's too."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(line.split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def live_steps(seconds: float, *, every: int) -> dict[str, FloatArray]:
    """Work of a frame in microseconds, in steps of the live view: `_STEP` frames added, a snapshot every so often."""
    source = Frames()
    grown = source.accumulator()
    grown.add(source.counts(0, _STEP), source.poses(0, _STEP))
    gc.collect()
    gc.freeze()
    gc.disable()  # as a live reader does: one full collection took 613 ms
    steps = np.zeros((int(seconds * RATE_HZ / _STEP), 2))
    for step in range(len(steps)):
        start, stop = step * _STEP, (step + 1) * _STEP
        counts, poses = source.counts(start, stop), source.poses(start, stop)
        wall, cpu = time.perf_counter(), time.thread_time()
        grown.add(counts, poses)
        if step % every == 0:
            grown.snapshot()
        steps[step] = time.perf_counter() - wall, time.thread_time() - cpu
    gc.enable()
    return {name: 1e6 / _STEP * values for name, values in zip(("wall", "work"), steps.T, strict=True)}


def _bincount_us(frames: int = 1400) -> float:
    """Microseconds a frame of the peer: what a live step is compared with."""
    job = Frames().job(frames)
    least = cpu_s({str(size): lambda n=size: bincount(job, frames=n) for size in BINCOUNT_FRAMES}, runs=9)
    return 1e6 * min(least.values()) / frames


def _live_report(seconds: float, *, every: int, last: Comparison) -> dict[str, Any]:
    rows: dict[str, Any] = {}
    peer_us = _bincount_us()
    for busy in (0, 2):
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
        try:
            steps = live_steps(seconds, every=every)
        finally:
            for process in others:
                process.kill()
                process.wait()
        for kind, values in steps.items():
            p50, p99 = np.percentile(values, [50, 99])
            rows[f"numpy, {busy} busy processes beside it, {kind}"] = {"p50_us": round(p50), "p99_us": round(p99)}
            beside = f"numpy, {busy} busy beside it, {kind:<5}"
            text = ""
            if kind == "work" and not busy:
                ratio = float(p50) / peer_us
                before = last.add("live p50, a frame of ten, over bincount", ratio)
                text = f"   p50 {ratio:.1f} x a frame of bincount{before}"
            print(f"{beside} p50 {p50:6.0f} us   p99 {p99:6.0f} us{text}", flush=True)
    return rows


def _compare(minutes: Sequence[float], *, runs: int, last: Comparison) -> dict[str, Any]:
    rows = {}
    for length in minutes:
        times = against_peers(int(length * 60 * RATE_HZ), runs=runs if length < 5 else max(2, runs // 3))
        boost = min((value for name, value in times.items() if name.startswith("boost")), default=float("nan"))
        print(f"{length:g} min of {RATE_HZ} Hz frames")
        for name, value in times.items():
            ratio = value / times["bincount"]
            before = last.add(f"{name}, {length:g} min", ratio)
            against = f"{ratio:.2f} x bincount{before}, {value / boost:.2f} x boost-histogram"
            print(f"  {name:<36}{value:8.3f} s CPU   {against}", flush=True)
        rows[f"{length:g} min"] = {name: round(value, 4) for name, value in times.items()}
    return rows


def _growth(minutes: Sequence[float], *, last: Comparison) -> dict[str, Any]:
    """Each length in a process of its own, so that its peak memory is its own."""
    rows = {}
    for length in minutes:
        words = [sys.executable, "-m", "benchmarks.map_speed", "--stream", str(length)]
        done = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ)
        cpu, peak = json.loads(done.stdout)
        each_us = 1e6 * cpu / (length * 60 * RATE_HZ)
        print(f"  numpy {length:6g} min{cpu:9.3f} s CPU{each_us:7.2f} us a frame{peak:7.0f} MB", flush=True)
        rows[f"{length:g} min"] = {"cpu_s": round(cpu, 3), "peak_mb": round(peak, 1)}
    if len(minutes) > 1:
        longest, shortest = (rows[f"{length:g} min"]["peak_mb"] for length in (max(minutes), min(minutes)))
        before = last.add(f"numpy peak memory, {max(minutes):g} over {min(minutes):g} min", longest / shortest)
        print(f"  numpy  peak memory of the longest over the shortest {longest / shortest:.2f}{before}", flush=True)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Print tables; write JSON when asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.map_speed", description=__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 30], help="lengths compared with the peers")
    parser.add_argument("--growth", type=float, nargs="*", default=[1, 10, 30, 120], help="lengths streamed")
    parser.add_argument("--live-s", type=float, default=60.0, help="length of the live run")
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--keep", action="store_true", help="keep these ratios: later runs are compared with them")
    parser.add_argument("--json", type=Path, metavar="OUT")
    parser.add_argument("--stream", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.stream:
        print(json.dumps(streamed(options.stream)))
        return 0
    document = {"schema": "tactile-bayes/benchmarks-map/1", "load": os.getloadavg()[0]}
    last = Comparison("map")
    print(f"load average {document['load']:.2f} on {os.cpu_count()} cores")
    document["peers"] = _compare(options.minutes, runs=options.runs, last=last)
    print("cost against length")
    document["growth"] = {"numpy": _growth(options.growth, last=last)}
    print(f"live step, of a frame: {_STEP} frames added, a snapshot every second time (10 Hz)")
    document["live"] = _live_report(options.live_s, every=2, last=last)
    print(last.report())
    if options.keep:
        last.keep()
    if options.json:
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
