"""A large campaign on a dask cluster of this machine, with a worker killed and the scheduler killed on the way.

    python tests/endurance/campaign_scans.py DIR --patients 2500 --exams 4 --bodies 250
    python tests/endurance/campaign_scale.py run DIR -o out [--undisturbed]
    python tests/endurance/campaign_scale.py report DIR -o out [--compare OTHER]

`run` starts a scheduler and two workers, writes the table of exams and runs the campaign with `--method laplace`. At
10 % of the exams it kills a worker's process, which its nanny replaces; at 18 % a worker and its nanny, and starts
another; at 25 % the scheduler. Then the client must end with one line; scheduler, workers and the same client command
are started again. Memory of each process is sampled every 5 s into `memory.csv`, what was done when goes to
`events.txt`. `report` prints CPU times of an exam, memory, and whether a step was done twice, and compares the trial's
rows with those of another run, which may have had fewer exams.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import hashlib
import json
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
from campaign_cluster import Cluster

from tactile_bayes.files.manifest_csv import JOURNAL

PORT, SAMPLE_S = 18786, 5.0


class Watch:
    """The processes of the run, sampled, with a log of events."""

    def __init__(self, folder: Path, journal: Path, processes: dict[str, psutil.Process]) -> None:
        self.began = time.monotonic()
        self.processes = processes
        self._journal, self._read, self.steps = journal, 0, Counter[str]()
        self._memory = (folder / "memory.csv").open("a", buffering=1)
        self._events = (folder / "events.txt").open("a", buffering=1)
        self._memory.write("seconds,process,rss_mb,cpu_s,maps,estimates,pooled\n")

    def tell(self, what: str) -> None:
        """Log an event."""
        line = f"{time.monotonic() - self.began:8.1f} s  {what}"
        print(line, flush=True)
        self._events.write(line + "\n")

    def sample(self) -> None:
        """Note the memory of every process and how far the journal is."""
        self._count()
        done = [self.steps[step] for step in ("map", "estimate", "pool")]
        now = f"{time.monotonic() - self.began:.1f}"
        for name, process in [*self.processes.items()]:
            with contextlib.suppress(psutil.Error):
                spent = process.cpu_times()
                row = [now, name, f"{process.memory_info().rss / 1e6:.1f}", f"{spent.user + spent.system:.1f}", *done]
                self._memory.write(",".join(map(str, row)) + "\n")

    def _count(self) -> None:
        if not self._journal.exists():
            return
        with self._journal.open("rb") as file:
            file.seek(self._read)
            new = file.read()
        new = new[: new.rfind(b"\n") + 1]
        self._read += len(new)
        self.steps.update(line[9:].split(b" ")[0].decode() for line in new.splitlines() if line.startswith(b'{"key"'))


def run(folder: Path, out: str, *, scheduler_dies_at: float | None) -> None:
    """Run the campaign, with the accidents on the way to this share of the exams; None for none."""
    notes = folder / f"{out}.notes"
    notes.mkdir(exist_ok=True)
    cluster = Cluster(notes, port=PORT)
    watch = Watch(notes, folder / out / JOURNAL, cluster.processes)
    if not (folder / "exams.csv").exists():
        client(folder, notes, "init", "scans", "-o", "exams.csv").wait()
        watch.tell("table of exams written")
    exams = len((folder / "exams.csv").read_text().splitlines()) - 1
    cluster.start()
    try:
        for accident in (None,) if scheduler_dies_at is None else (scheduler_dies_at, None):
            _until_the_end(folder, out, watch, cluster, exams=exams, scheduler_dies_at=accident)
    finally:
        cluster.stop()


def _until_the_end(
    folder: Path, out: str, watch: Watch, cluster: Cluster, *, exams: int, scheduler_dies_at: float | None
) -> None:
    """Run the client once; where the scheduler dies on the way, start the cluster again after it."""
    time.sleep(10)
    words = ("run", "exams.csv", "--excision", "excision.csv", "-o", out, "--method", "laplace")
    process = client(folder, folder / f"{out}.notes", *words, "--scheduler", cluster.address)
    watch.processes["client"] = psutil.Process(process.pid)
    watch.tell("client started")
    accidents = [] if scheduler_dies_at is None else _accidents(watch, cluster, scheduler_dies_at)
    while process.poll() is None:
        cluster.find_workers()
        watch.sample()
        if accidents and watch.steps["estimate"] >= accidents[0][0] * exams:
            accidents.pop(0)[1]()
        time.sleep(SAMPLE_S)
    watch.sample()
    watch.tell(f"client ended with {process.returncode}, {watch.steps['estimate']} of {exams} estimates in the journal")
    if scheduler_dies_at is not None:
        cluster.stop()
        cluster.start()
        watch.tell("scheduler and workers started again")


def _accidents(watch: Watch, cluster: Cluster, scheduler: float) -> list[tuple[float, object]]:
    def worker_dies() -> None:
        cluster.kill("worker 1")
        watch.tell("worker 1 killed; its nanny starts another")

    def nanny_dies() -> None:
        cluster.kill("nanny of worker 2")
        cluster.kill("worker 2")
        watch.tell("worker 2 and its nanny killed")

    def another() -> None:
        cluster.start_worker("worker 2")
        watch.tell("worker 2 started again")

    def scheduler_dies() -> None:
        cluster.kill("scheduler")
        watch.tell("scheduler killed")

    return [(0.4 * scheduler, worker_dies), (0.7 * scheduler, nanny_dies), (0.74 * scheduler, another),
            (scheduler, scheduler_dies)]  # fmt: skip


def client(folder: Path, notes: Path, *words: str) -> subprocess.Popen[bytes]:
    """The program's command line in the folder of the study."""
    with (notes / "client.log").open("ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "tactile_bayes", "campaign", *words], cwd=folder, stdout=file, stderr=file
        )


def report(folder: Path, out: str, compare: Path | None) -> None:
    """Print what the run cost and whether it is whole."""
    keys, cpu, seconds = Counter[str](), defaultdict(float), defaultdict(list)
    for key, value in entries(folder / out / JOURNAL):
        step, name, _ = key.rsplit(" ", 2) if key.startswith("read ") else key.split(" ")
        keys[key] += 1
        if "cpu_seconds" in value:
            seconds[step].append(value["cpu_seconds"])
            if step != "pool":
                cpu[name] += value["cpu_seconds"]
    times = np.array([*cpu.values()])
    print(f"exams {len(times)}: CPU median {np.median(times):.3f} s, p99 {np.quantile(times, 0.99):.3f}, "
          f"max {times.max():.3f}, sum {times.sum():.0f} s")  # fmt: skip
    for step, spent in seconds.items():
        print(f"{step}: {len(spent)} steps, CPU median {np.median(spent):.3f} s, sum {sum(spent):.0f} s")
    print(f"steps in the journal more than once: {sum(count > 1 for count in keys.values())}")
    print(f"journal {(folder / out / JOURNAL).stat().st_size / 1e6:.1f} MB")
    _report_memory(folder / f"{out}.notes" / "memory.csv")
    for name in ("trial.csv", "exams_done.csv", "failures.csv", "index.html"):
        data = (folder / out / name).read_bytes()
        print(f"{name}: {len(data)} bytes, sha256 {hashlib.sha256(data).hexdigest()}")
    if compare is not None:
        here, there = (set((one / "trial.csv").read_text().splitlines()) for one in (folder / out, compare))
        print(f"rows of {compare / 'trial.csv'}: {len(there)}, of which here byte for byte: {len(there & here)}")


def entries(journal: Path) -> Iterator[tuple[str, dict[str, object]]]:
    """Keys and values of a journal."""
    with journal.open() as file:
        next(file)
        for line in file:
            record = json.loads(line.rpartition(" ")[0])
            yield record["key"], record["value"]


def _report_memory(path: Path) -> None:
    rss = defaultdict(list)
    with path.open() as file:
        for row in csv.DictReader(line for i, line in enumerate(file) if i == 0 or not line.startswith("seconds")):
            rss[row["process"]].append((float(row["seconds"]), float(row["rss_mb"])))
    for name, values in rss.items():
        mb = np.array([one for _, one in values])
        tenths = [f"{part.mean():.0f}" for part in np.array_split(mb, 10) if len(part)]
        print(f"{name}: RSS in MB over ten parts of the run {' '.join(tenths)}, most {mb.max():.0f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["run", "report"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", default="out")
    parser.add_argument("--undisturbed", action="store_true")
    parser.add_argument("--scheduler-dies-at", type=float, default=0.25, help="share of the exams")
    parser.add_argument("--compare", type=Path)
    args = parser.parse_args()
    if args.what == "run":
        run(args.folder, args.output, scheduler_dies_at=None if args.undisturbed else args.scheduler_dies_at)
    else:
        report(args.folder, args.output, args.compare)
