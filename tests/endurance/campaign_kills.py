"""SIGKILL at random moments of a small campaign: same bytes, nothing redone, nothing left behind.

    python tests/endurance/campaign_kills.py DIR [--what local|pool|repeats|client|worker|scheduler]
        [--kills 50] [--seed 114]

makes a small campaign in DIR, runs it once undisturbed, and then again and again, kills it, and starts it again in the
same folder until it ends by itself. Then the folder must hold the undisturbed run's bytes, the journal no step twice,
and no temporary file may be left. The exit code is 1 where any of it fails.

local
    12 exams of 6 patients with one worker or two, killed when they have used a random CPU time. The workers must end.
pool
    The exams of ``local`` with two workers, of which one is killed at a random step. Another takes its place and the
    run goes on; an exam over which two ended has failed, and the next run makes it.
repeats
    6 masses with 3 exams each, 5 of which are found, so that the campaign learns the site's repeatability. Each folder
    begins where all exams are estimated; half of the kills come while the spread is learned, the others while sizes and
    pooled sizes are made by it.
client, worker, scheduler
    8 exams of 4 patients on a dask scheduler with two workers (``--port``). The kill comes at a random step. A
    worker's nanny starts another and the client goes on; with the scheduler the client must end with one line and code
    1 (2 before it was connected), and scheduler and workers are started again.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import psutil
from campaign_cluster import Cluster
from campaign_scale import entries
from campaign_scans import Faults, make

from tactile_bayes.batch import DIED_TWICE
from tactile_bayes.files.manifest_csv import JOURNAL

WHAT: Final = ("local", "pool", "repeats", "client", "worker", "scheduler")
MASSES, REPEATS = 6, 3
MOST_CPU_S, GRACE_S, SETTLED_S = 9.0, 10.0, 10.0
MOST_KILLS_IN_A_FOLDER = 3
"""So that many folders come to their end, and no more, for dask gives a task up after its worker ended four times."""
LEARNING_CPU_S = 0.2
"""Before the learned spread is in the journal: the exams' draws are read and its posterior computed."""


@dataclass
class Tally:
    """What happened."""

    kills: int = 0
    rounds: int = 0
    survivors: int = 0
    twice: int = 0
    different: int = 0
    stray: int = 0
    left_by_kills: int = 0
    failed: int = 0
    """Runs with an exam over which two workers ended."""
    untold: int = 0
    """Losses of the scheduler that the client did not tell in one line with code 1."""
    during: Counter[str] = field(default_factory=Counter)
    """Kills by the latest step in the journal."""

    @property
    def sound(self) -> bool:
        """Whether all was as it must be."""
        return self.survivors == self.twice == self.different == self.stray == self.untold == 0


def start(folder: Path, out: str, *more: str) -> subprocess.Popen[bytes]:
    """The campaign in a process of its own."""
    words = ["run", "exams.csv", "--excision", "excision.csv", "-o", out, "--method", "laplace", *more]
    with (folder / "client.log").open("ab") as log:
        command = [sys.executable, "-m", "tactile_bayes", "campaign", *words]
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)


class Family:
    """A run and its workers.

    Parameters
    ----------
    process
        The run.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process, self._main = process, psutil.Process(process.pid)
        self._all = [self._main]

    def cpu_s(self) -> float:
        """CPU time that all of them have used."""
        with contextlib.suppress(psutil.Error):
            self._all = [self._main, *self._main.children(recursive=True)]
        spent = 0.0
        for one in self._all:
            with contextlib.suppress(psutil.Error):
                spent += sum(one.cpu_times()[:2])
        return spent

    def killed(self, *, after_cpu_s: float) -> tuple[bool, int]:
        """Kill the run when all used so much CPU; whether it came to that, and how many workers live on."""
        while self._process.poll() is None:
            if self.cpu_s() >= after_cpu_s:
                self._process.kill()
                self._process.wait()
                _, alive = psutil.wait_procs(self._all[1:], timeout=GRACE_S)
                return True, len(alive)
            time.sleep(0.003)
        return False, 0


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the journal, which holds times."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != JOURNAL)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


class Study:
    """A campaign in a folder that is killed and run again.

    Parameters
    ----------
    folder
        With the table of exams and the undisturbed run.
    kills
        How many there shall be.
    seed
        Of their moments.
    """

    def __init__(self, folder: Path, *, kills: int, seed: int) -> None:
        self._folder, self._out = folder, folder / "out"
        self._wanted = contents(folder / "undisturbed")
        self._steps = len(_steps_in(folder / "undisturbed"))
        self._kills, self._rng = kills, random.Random(seed)
        self.tally = Tally()

    def disturb(self, moment: Callable[[random.Random, str], float], *, begun: Path | None = None) -> Tally:
        """Kill runs in processes of this computer, and check every folder that came to its end.

        Parameters
        ----------
        moment
            Draws, for a number of workers, after how much CPU time to kill.
        begun
            Folder that each round begins with; None for an empty one.
        """
        while self._more():
            self._begin(begun)
            ended, most = False, self.tally.kills + self._rng.randint(1, MOST_KILLS_IN_A_FOLDER)
            while not ended:
                workers = self._rng.choice("12")
                after = moment(self._rng, workers) if self._more(most) else float("inf")
                process = start(self._folder, "out", "--workers", workers)
                was_killed, survivors = Family(process).killed(after_cpu_s=after)
                self.tally.survivors += survivors
                if was_killed:
                    self._note(f"after {after:.2f} s of CPU")
                else:
                    self._must_end_well(process)
                ended = not was_killed
            self._check()
        return self.tally

    def disturb_pool(self) -> Tally:
        """Kill workers of runs that go on, and check as `disturb`."""
        while self._more():
            self._begin(None)
            again, most = True, self.tally.kills + self._rng.randint(1, MOST_KILLS_IN_A_FOLDER)
            while again:
                process = start(self._folder, "out", "--workers", "2")
                while self._more(most) and self._wait_for_a_moment(process):
                    if workers := _pool_of(process):
                        self._rng.choice(workers).kill()
                        self._note("a worker of two")
                process.wait()
                self._must_end_well(process)
                again = DIED_TWICE in (self._out / "failures.csv").read_text()
                self.tally.failed += again
            self._check()
        return self.tally

    def disturb_cluster(self, cluster: Cluster, victim: str) -> Tally:
        """Kill the client, a worker or the scheduler of a dask cluster, and check as `disturb`."""
        cluster.start()
        while self._more():
            self._begin(None)
            ended, most = False, self.tally.kills + self._rng.randint(1, MOST_KILLS_IN_A_FOLDER)
            while not ended:
                cluster.wait()
                process = start(self._folder, "out", "--scheduler", cluster.address)
                ended = self._until_it_ends(process, cluster, victim, most=most)
            self._check()
        return self.tally

    def _until_it_ends(self, process: subprocess.Popen[bytes], cluster: Cluster, victim: str, *, most: int) -> bool:
        """Run the client once, with kills; whether it came to its end by itself."""
        while self._more(most) and self._wait_for_a_moment(process):
            if victim == "client":
                process.kill()
                process.wait()
                self._note("client")
                return False
            name = "scheduler" if victim == "scheduler" else self._rng.choice(_running_workers(cluster))
            cluster.kill(name)
            self._note(name)
            if victim == "scheduler":
                self._client_tells(process)
                cluster.stop()
                cluster.start()
                return False
        process.wait()
        self._must_end_well(process)
        return True

    def _wait_for_a_moment(self, process: subprocess.Popen[bytes]) -> bool:
        """Wait for a step drawn of those that are missing, and for a random moment more; whether the run goes on."""
        last = self._steps - 1
        target = self._rng.randint(min(len(_steps_in(self._out)), last), last)
        while process.poll() is None and len(_steps_in(self._out)) < target:
            time.sleep(0.003)
        time.sleep(self._rng.uniform(0.0, 0.5))
        return process.poll() is None

    def _client_tells(self, process: subprocess.Popen[bytes]) -> None:
        """Wait for the client's end after the loss of the scheduler; it may have been done in the same moment."""
        code = process.wait()
        last = (self._folder / "client.log").read_text(errors="replace").splitlines()[-1:]
        words = {1: "the dask scheduler was lost before an answer came", 2: "no dask scheduler answers at"}
        told = words.get(code, "-") in "".join(last)  # 2 where it had not connected yet
        if not told and code != 0:
            print(f"  the client ended with {code}: {last}", flush=True)
        self.tally.untold += not told and code != 0

    def _more(self, most: int | None = None) -> bool:
        return self.tally.kills < (self._kills if most is None else min(self._kills, most))

    def _begin(self, begun: Path | None) -> None:
        shutil.rmtree(self._out, ignore_errors=True)
        if begun is not None:
            shutil.copytree(begun, self._out)

    def _note(self, what: str) -> None:
        done = _steps_in(self._out)
        step = done[-1].split(" ")[0] if done else "nothing"
        self.tally.kills += 1
        self.tally.during[step] += 1
        self.tally.left_by_kills += len([*self._out.rglob("*.part")])
        print(f"kill {self.tally.kills}: {what}, {len(done)} steps in the journal, the last {step}", flush=True)

    def _must_end_well(self, process: subprocess.Popen[bytes]) -> None:
        if process.returncode != 0:
            raise SystemExit(f"ended with {process.returncode}; see {self._folder / 'client.log'}")

    def _check(self) -> None:
        tally, found = self.tally, contents(self._out)
        tally.rounds += 1
        tally.stray += sum(name.endswith(".part") for name in found)
        differ = [name for name in found.keys() | self._wanted.keys() if found.get(name) != self._wanted.get(name)]
        keys = Counter(key for key, _ in entries(self._out / JOURNAL))
        twice = [key for key, count in keys.items() if count > 1]
        tally.different += len(differ)
        tally.twice += len(twice)
        for what, names in (("other bytes", differ), ("done twice", twice)):
            if names:
                print(f"  {what}: {', '.join(names)}", flush=True)


def _running_workers(cluster: Cluster) -> list[str]:
    while not (names := cluster.find_workers()):
        time.sleep(0.05)
    return names


def _pool_of(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    """The worker processes of a run."""
    with contextlib.suppress(psutil.Error):
        return [one for one in psutil.Process(process.pid).children() if "spawn_main" in " ".join(one.cmdline())]
    return []


def entries_or_none(journal: Path) -> list[str]:
    """Keys of the whole lines of a journal that may have been cut off."""
    lines = journal.read_bytes().split(b"\n")[1:-1] if journal.exists() else []
    return [line.split(b'"')[3].decode() for line in lines]


def _steps_in(out: Path) -> list[str]:
    return [key for key in entries_or_none(out / JOURNAL) if not key.startswith("read ")]


def prepare(folder: Path, what: str) -> None:
    """Scans, table of exams and the undisturbed run."""
    if what in ("local", "pool"):
        make(folder, patients=6, exams=2, bodies=3, faults=Faults(cut=11, damaged=0), empty_every=3)
    elif what == "repeats":
        make(folder, patients=MASSES, exams=REPEATS, bodies=MASSES, faults=Faults(0, 0), empty_every=0)
    else:
        make(folder, patients=4, exams=2, bodies=2, faults=Faults(0, 0), empty_every=0)
    time.sleep(SETTLED_S)  # digests of files changed a moment ago are not kept
    words = ["campaign", "init", "scans", "-o", "exams.csv", "--force"]
    subprocess.run([sys.executable, "-m", "tactile_bayes", *words], cwd=folder, check=True)
    shutil.rmtree(folder / "undisturbed", ignore_errors=True)
    if start(folder, "undisturbed").wait() != 0:
        raise SystemExit(f"the undisturbed run failed; see {folder / 'client.log'}")
    if what == "repeats" and not (folder / "undisturbed" / "repeatability.json").exists():
        raise SystemExit(f"the undisturbed run did not learn the spread; see {folder / 'client.log'}")


def all_estimated(folder: Path) -> Path:
    """Folder of a campaign with repeats that was killed after the last estimate."""
    begun = folder / "begun"
    shutil.rmtree(begun, ignore_errors=True)
    process = start(folder, "begun")
    while process.poll() is None:
        if _count(begun, "estimate") == MASSES * REPEATS:
            process.kill()
        time.sleep(0.001)
    return begun


def _count(out: Path, step: str) -> int:
    return sum(key.startswith(f"{step} ") for key in entries_or_none(out / JOURNAL))


def moments_of_learning(folder: Path, begun: Path) -> Callable[[random.Random, str], float]:
    """Moments while the spread is learned and afterwards, by what one run takes from here on with so many workers."""
    learned, ended = {}, {}
    for workers in "12":
        shutil.rmtree(folder / "out", ignore_errors=True)
        shutil.copytree(begun, folder / "out")
        process = start(folder, "out", "--workers", workers)
        family = Family(process)
        while process.poll() is None:
            ended[workers] = family.cpu_s()
            if workers not in learned and _count(folder / "out", "repeatability"):
                learned[workers] = ended[workers]
            time.sleep(0.003)

    def moment(rng: random.Random, workers: str) -> float:
        before = rng.random() < 0.5
        least = learned[workers] - LEARNING_CPU_S if before else learned[workers]
        return rng.uniform(least, learned[workers] if before else ended[workers])

    return moment


@contextlib.contextmanager
def cluster_in(folder: Path, port: int) -> Iterator[Cluster]:
    """A cluster that is not started, and killed at the end."""
    notes = folder / "cluster"
    notes.mkdir(exist_ok=True)
    cluster = Cluster(notes, port=port)
    try:
        yield cluster
    finally:
        cluster.stop()


def main(folder: Path, *, what: str, kills: int, seed: int, port: int) -> Tally:
    """Prepare and disturb."""
    prepare(folder, what)
    study = Study(folder, kills=kills, seed=seed)
    if what == "local":
        return study.disturb(lambda rng, _: rng.uniform(0.05, MOST_CPU_S))
    if what == "pool":
        return study.disturb_pool()
    if what == "repeats":
        begun = all_estimated(folder)
        return study.disturb(moments_of_learning(folder, begun), begun=begun)
    with cluster_in(folder, port) as cluster:
        return study.disturb_cluster(cluster, what)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--what", choices=WHAT, default="local")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=114)
    parser.add_argument("--port", type=int, default=18797, help="of the dask scheduler")
    args = parser.parse_args()
    done = main(args.folder, what=args.what, kills=args.kills, seed=args.seed, port=args.port)
    print(done)
    raise SystemExit(0 if done.sound else 1)
