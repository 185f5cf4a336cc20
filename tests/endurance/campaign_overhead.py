"""What a campaign costs besides its exams: the client per exam, and a dask scheduler per task.

    python tests/endurance/campaign_overhead.py client OUT --exams 100000   # OUT: of a finished campaign, as a sample
    python tests/endurance/campaign_overhead.py tasks --tasks 5000

`client` runs a campaign of so many listed exams whose steps do nothing but return what a real step returned, then
goes on from its journal, then writes tables and pages from one real estimate: CPU time, memory and bytes per exam.
`tasks` hands tasks that do nothing to a scheduler with two workers on this machine: CPU time of client, scheduler and
workers per task. One core's worth of the busiest of them is where a cluster saturates.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import psutil
from campaign_scale import PORT, Cluster, entries

from tactile_bayes.batch import open_executor, run_batch
from tactile_bayes.campaigns import report as campaign_report
from tactile_bayes.campaigns import run as campaigns
from tactile_bayes.campaigns.inputs import open_campaign
from tactile_bayes.campaigns.steps import CampaignSettings, Task
from tactile_bayes.files.documents import read_record
from tactile_bayes.files.manifest_csv import ESTIMATE, EXAMS, JOURNAL, Exam


@contextmanager
def measured(what: str, count: int) -> Iterator[None]:
    """Print the CPU time of the block, for each of so many."""
    began, rss = time.process_time(), psutil.Process().memory_info().rss
    yield
    spent, grown = time.process_time() - began, psutil.Process().memory_info().rss - rss
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{what}: {spent:.1f} s CPU, {1e6 * spent / count:.0f} us each; RSS {grown / 1e6:+.0f} MB, "
          f"{grown / count:+.0f} bytes each; peak {peak:.0f} MB", flush=True)  # fmt: skip


def client(out: Path, exams: int) -> None:
    """Measure the client."""
    sample = {key.split(" ")[0]: value for key, value in entries(out / JOURNAL)}
    estimate = next((out / EXAMS).glob(f"*/{ESTIMATE}"))

    def step(task: Task) -> dict[str, Any]:
        return dict(sample[task.step])

    def sources(listed: list[Exam], **_options: Any) -> tuple[dict[Path, str], dict[Path, str]]:
        return {exam.path: f"{number:064x}" for number, exam in enumerate(listed)}, {}

    with measured("table of exams", exams):
        table = [_exam(number) for number in range(exams)]
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        for module, name, fake in (
            (campaigns.steps, "run_step", step),
            (campaigns, "read_sources", sources),
            (campaigns, "unchanged", lambda *_: True),
            (campaign_report, "read_record", lambda _path, kind: read_record(estimate, kind)),
            (campaign_report, "pooled_reports", lambda _campaign: {}),
        ):
            stack.enter_context(mock.patch.object(module, name, fake))
        folder = Path(place) / "out"
        for what in ("steps that do nothing", "going on from the journal"):
            with measured(what, exams), open_campaign(folder) as store:
                run = campaigns.Campaign(table, folder, CampaignSettings(own_repeatability=False), store=store)
                run.run()
        size = (folder / JOURNAL).stat().st_size
        print(f"journal: {size / 1e6:.1f} MB, {size / exams:.0f} bytes each")
        with measured("tables and index", exams), open_campaign(folder) as store:
            run = campaigns.Campaign(table, folder, CampaignSettings(own_repeatability=False), store=store)
            run.run()
            stack.enter_context(mock.patch.object(campaign_report, "_MOST_INLINE", 0))
            campaign_report.write_outputs(run)
        for name in campaign_report.WRITTEN:
            if (folder / name).exists():
                print(f"{name}: {(folder / name).stat().st_size / 1e6:.1f} MB")


def _exam(number: int) -> Exam:
    patient = f"P{number // 4:06d}"
    file = f"scans/{patient}-{number % 4}.mcap"
    return Exam(file, Path("/study") / file, patient, "1", "1", number % 4 + 1, "left", "R1", line=number + 2)


def nothing(item: int) -> int:
    """A task that does nothing."""
    return item


def tasks(count: int) -> None:
    """Measure client, scheduler and workers."""
    with tempfile.TemporaryDirectory() as place:
        cluster = Cluster(Path(place), port=PORT)
        cluster.start()
        try:
            cluster.wait()
            cluster.find_workers()
            with open_executor(cluster=f"tcp://127.0.0.1:{PORT}") as executor:
                run_batch(nothing, range(500), key=str, executor=executor)
                before = _cpu(cluster)
                began = time.monotonic()
                run_batch(nothing, range(count), key=str, executor=executor)
                wall, after = time.monotonic() - began, _cpu(cluster)
        finally:
            cluster.stop()
    print(f"{count} tasks in {wall:.1f} s wall, {count / wall:.0f} a second")
    for name, spent in after.items():
        each = (spent - before[name]) / count
        print(f"{name}: {1e3 * each:.2f} ms CPU per task, {1 / each:.0f} tasks a second of one core")


def _cpu(cluster: Cluster) -> dict[str, float]:
    processes = {"client": psutil.Process(), **cluster.processes}
    return {name: sum(one.cpu_times()[:2]) for name, one in processes.items() if "nanny" not in name}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    one = commands.add_parser("client")
    one.add_argument("out", type=Path)
    one.add_argument("--exams", type=int, default=100_000)
    other = commands.add_parser("tasks")
    other.add_argument("--tasks", type=int, default=5000)
    args = parser.parse_args()
    if args.what == "client":
        client(args.out, args.exams)
    else:
        tasks(args.tasks)
