"""SIGKILL at random moments of a small campaign: same bytes, nothing redone, nothing left behind.

    python -m benchmarks.campaign_kills DIR [--kills 50] [--seed 114]

makes 12 exams of 6 patients in DIR, runs them once undisturbed, and then again and again with one worker or two. Each
run is killed when it and its workers have used a random CPU time, and started again in the same folder until one ends
by itself. Then the folder must hold the undisturbed run's bytes, the journal no step twice, and no temporary file may
be left; after each kill the workers must end. The exit code is 1 where any of it fails.
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
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.campaign_scale import entries
from benchmarks.campaign_scans import Faults, make
from tactile_bayes.files.campaign_names import JOURNAL

MOST_CPU_S, GRACE_S = 9.0, 10.0


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

    @property
    def sound(self) -> bool:
        """Whether all was as it must be."""
        return self.survivors == self.twice == self.different == self.stray == 0


def start(folder: Path, out: str, *, workers: int) -> subprocess.Popen[bytes]:
    """The campaign in a process of its own."""
    words = ["run", "exams.csv", "--excision", "excision.csv", "-o", out, "--method", "laplace"]
    with (folder / "client.log").open("ab") as log:
        command = [sys.executable, "-m", "tactile_bayes", "campaign", *words, "--workers", str(workers)]
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)


def killed(process: subprocess.Popen[bytes], *, after_cpu_s: float) -> tuple[bool, int]:
    """Kill a run when it and its workers used so much CPU; whether it came to that, and how many workers live on."""
    main = psutil.Process(process.pid)
    family: list[psutil.Process] = []
    while process.poll() is None:
        with contextlib.suppress(psutil.Error):
            family = [main, *main.children(recursive=True)]
        spent = 0.0
        for one in family:
            with contextlib.suppress(psutil.Error):
                spent += sum(one.cpu_times()[:2])
        if spent >= after_cpu_s:
            process.kill()
            process.wait()
            _, alive = psutil.wait_procs(family[1:], timeout=GRACE_S)
            return True, len(alive)
        time.sleep(0.003)
    return False, 0


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the journal, which holds times."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != JOURNAL)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def disturb(folder: Path, *, kills: int, seed: int) -> Tally:
    """Kill so many runs, and check every folder that came to its end."""
    rng, tally, wanted = random.Random(seed), Tally(), contents(folder / "undisturbed")
    while tally.kills < kills:
        shutil.rmtree(folder / "out", ignore_errors=True)
        ended = False
        while not ended:
            after = rng.uniform(0.05, MOST_CPU_S) if tally.kills < kills else float("inf")
            process = start(folder, "out", workers=rng.choice([1, 2]))
            was_killed, survivors = killed(process, after_cpu_s=after)
            tally.kills += was_killed
            tally.survivors += survivors
            if was_killed:
                steps = sum(1 for _ in entries_or_none(folder / "out" / JOURNAL))
                tally.left_by_kills += len([*(folder / "out").rglob("*.part")])
                print(f"kill {tally.kills}: after {after:.2f} s of CPU, {steps} lines in the journal", flush=True)
            elif process.returncode != 0:
                raise SystemExit(f"ended with {process.returncode}; see {folder / 'client.log'}")
            ended = not was_killed
        _check(folder, wanted, tally)
    return tally


def entries_or_none(journal: Path) -> list[str]:
    """Keys of the whole lines of a journal that may have been cut off."""
    lines = journal.read_bytes().split(b"\n")[1:-1] if journal.exists() else []
    return [line.split(b'"')[3].decode() for line in lines]


def _check(folder: Path, wanted: dict[str, bytes], tally: Tally) -> None:
    tally.rounds += 1
    found = contents(folder / "out")
    tally.stray += sum(name.endswith(".part") for name in found)
    tally.different += sum(found.get(name) != wanted.get(name) for name in found.keys() | wanted.keys())
    keys = Counter(key for key, _ in entries(folder / "out" / JOURNAL))
    tally.twice += sum(count > 1 for count in keys.values())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=114)
    args = parser.parse_args()
    make(args.folder, patients=6, exams=2, bodies=3, faults=Faults(cut=11, damaged=0), empty_every=3)
    time.sleep(10)  # digests of files changed a moment ago are not kept
    subprocess.run(
        [sys.executable, "-m", "tactile_bayes", "campaign", "init", "scans", "-o", "exams.csv", "--force"],
        cwd=args.folder,
        check=True,
    )
    shutil.rmtree(args.folder / "undisturbed", ignore_errors=True)
    if start(args.folder, "undisturbed", workers=1).wait() != 0:
        raise SystemExit(f"the undisturbed run failed; see {args.folder / 'client.log'}")
    done = disturb(args.folder, kills=args.kills, seed=args.seed)
    print(done)
    raise SystemExit(0 if done.sound else 1)
