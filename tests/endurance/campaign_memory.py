"""Memory of a worker process over many exams.

    python tests/endurance/campaign_scans.py DIR --patients 75 --exams 4 --bodies 25
    python tests/endurance/campaign_memory.py DIR [--exams 300] [--dask [--profile]] [--figures]

Maps, estimates and draws the scans of DIR one after the other in one worker: a process of the program's own as
`campaign run --workers` has, or one of a dask cluster on this machine, with dask's profiler or as the guide starts
workers, without. Prints the resident set size (RSS) after so many exams and how many tracebacks' trees the profiler
holds, and last by how much the RSS after all exams exceeds that after 30.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import psutil

from tactile_bayes.api.settings import Settings
from tactile_bayes.batch import LocalWorkers, open_executor, run_batch
from tactile_bayes.campaigns.steps import Task, make_estimate, make_figures, make_map, put_in_place, run_step
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.atomic import sha256

FIRST, SHOWN = 30, (1, 10, 30, 60, 100, 150, 200, 250, 300)


def exam(path: str, *, out: str, steps: tuple[str, ...]) -> list[float]:
    """Run an exam's steps; returns the RSS of this process, MB, its CPU time, s, and how much its profiler holds."""
    source = Path(path)
    folder, settings = Path(out), Settings(method="laplace")
    make = {
        "map": partial(make_map, source, source_sha256=sha256(source), expected={}, normalise="gain"),
        "estimate": partial(make_estimate, folder, settings, None, ""),
        "figures": partial(make_figures, folder, settings, None, ""),
    }
    with contextlib.suppress(TactileBayesError):  # damaged on purpose
        for step in ("map", *steps):
            put_in_place(run_step(Task(step, source.stem, folder, "0", make[step])))
    process = psutil.Process()
    return [process.memory_info().rss / 1e6, process.cpu_times().user, float(_profiled())]


def _profiled() -> int:
    try:
        from distributed import get_worker

        return sum(count for _, tree in [*get_worker().profile_history] if (count := tree["count"]))
    except (ImportError, ValueError):
        return 0


@contextlib.contextmanager
def dask_worker(*, profile: bool) -> Iterator[Executor]:
    """One worker of a cluster on this machine."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.worker.profile.enabled": profile}),
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(cluster=cluster.scheduler_address) as executor,
    ):
        yield executor


def main(folder: Path, exams: int, *, chosen: contextlib.AbstractContextManager[Executor], figures: bool) -> None:
    """Run the exams and print memory."""
    paths = [str(path) for path in sorted((folder / "scans").glob("*.mcap"))[:exams]]
    steps = ("estimate", "figures") if figures else ("estimate",)
    with tempfile.TemporaryDirectory() as out, chosen as executor:
        began = time.monotonic()

        def tell(done: int, _total: int) -> None:
            if done % 30 == 0:
                print(f"{done} exams, {time.monotonic() - began:.0f} s", flush=True)

        work = partial(exam, out=out, steps=steps)
        found = run_batch(work, paths, key=str, executor=executor, progress=tell)
    rows = [one.value for one in found if one.value is not None]
    for number in SHOWN:
        if number <= len(rows):
            rss, cpu, profiled = rows[number - 1]
            print(
                f"after {number} exams: RSS {rss:.0f} MB, CPU {cpu:.0f} s, {profiled:.0f} samples of the profiler kept"
            )
    print(f"after {len(rows)}: {rows[-1][0] / rows[FIRST - 1][0]:.3f} times the RSS after {FIRST}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--exams", type=int, default=300)
    parser.add_argument("--dask", action="store_true")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--figures", action="store_true")
    args = parser.parse_args()
    workers = dask_worker(profile=args.profile) if args.dask else LocalWorkers(1)
    main(args.folder, args.exams, chosen=workers, figures=args.figures)
