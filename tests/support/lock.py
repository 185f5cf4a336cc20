"""Lock what the program says: run it in many ways, keep every output in a readable form, and compare two such folders.

`make` follows the pages of the documents and those of ``lock_pages``, each in a fresh folder, and writes what the
commands print and make; `compare` prints what differs.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import io
import json
import math
import os
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from doc_pages import PROGRAM, Block, Command, Reader, blocks_of
from readable_files import Arrays, readable

import tactile_bayes

ROOT = Path(__file__).resolve().parents[2]
PAGES = Path(__file__).with_name("lock_pages")
RELATIVE, ABSOLUTE = 1e-9, 1e-12

VARYING = (
    # CPU times: `-v` on stderr, the forecasts of long commands, and what `tradeoff` measures
    (re.compile(r"^([a-z ]+: )\d+\.\d+ s$", re.MULTILINE), r"\1<time>"),
    (re.compile(r"about \d.* to go"), "about <time> to go"),
    (re.compile(r'("\w*cpu_s": )(\{[^}]*\}|[\d.e+-]+)'), r"\1<time>"),
    (re.compile(r'[\d.]+ maps/s|(?<="maps_per_s": )[\d.e+-]+'), "<rate>"),  # of `sbc`
    # what `tradeoff` concludes from the times
    (re.compile(r'"(frontier|enough)": [^\n]*'), r'"\1": <by time>'),
    (re.compile(r'"[^"\n]*(Advice: | s CPU)[^"\n]*"'), '"<by time>"'),
    # the version, wherever it stands: a release changes no result
    (re.compile(rf"(?<![\w.]){re.escape(tactile_bayes.__version__)}(?![\w.])"), "<version>"),
)
# Hashes of inputs, and UIDs, which follow from them: told apart, not kept. The files are compared anyway.
DIGESTS = re.compile(r"\b[0-9a-f]{64}\b|\b2\.25\.\d{20,}|\b[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}\b")
NUMBER = re.compile(r"(?<![\w.])([-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)(?!\w)")


def plain(text: str, folder: Path) -> str:
    """The text without what changes from run to run."""
    text = text.replace(str(folder), "<folder>").replace(str(ROOT), "<root>")
    for pattern, word in VARYING:
        text = pattern.sub(word, text)
    seen: dict[str, str] = {}
    return DIGESTS.sub(lambda found: seen.setdefault(found[0], f"<digest {len(seen) + 1}>"), text)


@dataclass
class Recorder(Reader):
    """A reader who writes down what every command says, and believes none."""

    said: list[str] = field(default_factory=list)

    def run(self, command: Command) -> tuple[int, str, str]:
        """Run a command line; one that breaks down has said so."""
        try:
            return super().run(command)
        except Exception as fault:
            return -1, "", f"breaks down: {type(fault).__name__}: {fault}\n"

    def look_at(self, command: Command, code: int, out: str, err: str) -> None:
        """Write down what a command said."""
        self.said.append(f"$ {command.text}\n[exit {code}]\n{out}[stderr]\n{err}\n")

    def run_python(self, block: Block) -> None:
        """Write down what a block of Python prints."""
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                super().run_python(block)
        except Exception as fault:
            printed.write(f"breaks down: {type(fault).__name__}: {fault}\n")
        self.said.append(f"python, line {block.line} of {block.page.name}\n{printed.getvalue()}\n")

    def read_help(self, *words: str) -> None:
        """Write down the help of a command and of all below it."""
        command = Command(Path("help"), 0, " ".join([PROGRAM, *words, "--help"]), 0, "")
        code, out, err = self.run(command)
        self.look_at(command, code, out, err)
        for name in re.findall(r"^  (\S+)", out.partition("\nCommands:\n")[2], re.MULTILINE):
            self.read_help(*words, name)


@dataclass(frozen=True)
class Job:
    """Pages that are followed one after the other in one folder, after a scan was put there."""

    name: str
    pages: tuple[Path, ...] = ()
    scan: Path | None = None


LEFT_OUT = {
    "scan.npz": "an input",
    "demo": "in the job of this name",
    "campaign.journal": "how long each step took",
    "replayed.mcap": "recorded at this machine's pace",
    ".cache": "matplotlib's, in the reader's home",
    ".config": "matplotlib's",
}


def all_jobs(shared: Path) -> list[Job]:
    """The jobs, those that take longest first."""
    documents = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "guides").glob("*.md"), ROOT / "README.md"]
    run = {"console", "sh", "python"}
    followed = [page for page in sorted(documents) if any(block.language in run for block in blocks_of(page))]
    jobs = [Job(f"docs-{page.stem}", (page,)) for page in followed]
    own = [Job(name, (PAGES / f"{name}.md",)) for name in ("exams", "studies", "trial", "faults", "demo")]
    packaged = Job("scan-packaged", (PAGES / "packaged.md", PAGES / "exam.md"))
    scans = sorted((shared / "data" / "scans").glob("*.npz"))
    if not scans:
        print(f"no scans in {shared / 'data' / 'scans'}: those of independent simulators are left out")
    exams = [Job(f"scan-{path.stem}", (PAGES / "shared.md", PAGES / "exam.md"), path) for path in scans]
    first = [job for job in jobs if job.name == "docs-campaign"]
    return [*first, packaged, *own, *(job for job in jobs if job not in first), *exams, Job("help"), Job("schemas")]


def do(job: Job, out: Path, demos: Path) -> str:
    """Do a job and write all that it says and makes; returns its name and time."""
    warnings.simplefilter("error")  # as in the tests
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        if job.scan:
            shutil.copyfile(job.scan, folder / "scan.npz")
        reader = Recorder(folder, demos)
        if job.name == "help":
            reader.read_help()
        elif job.name == "schemas":
            for path in sorted((ROOT / "data_schema").glob("*.json")):
                held = json.dumps(json.loads(path.read_text(encoding="utf-8")), sort_keys=True, indent=1)
                reader.said.append(f"{path.name} {held}\n")
        for page in job.pages:
            reader.follow(page)
        keep(out / job.name / "printed", plain("".join(reader.said), folder), {})
        left_out = set(LEFT_OUT) - {job.name}
        for path in sorted(folder.rglob("*")):
            place = path.relative_to(folder)
            if path.is_file() and left_out.isdisjoint(place.parts):
                text, arrays = readable(path)
                keep(out / job.name / "files" / place, plain(text, folder), arrays)
    return f"{job.name}: {time.monotonic() - start:.0f} s"


def keep(path: Path, text: str, arrays: Arrays) -> None:
    """Write text and arrays as two files beside each other."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_name(f"{path.name}.txt").write_text(text, encoding="utf-8")
    if arrays:
        with path.with_name(f"{path.name}.npz").open("wb") as file:
            np.savez(file, **{name.replace("/", "|"): values for name, values in arrays.items()})


def make(out: Path, shared: Path, only: list[str]) -> None:
    """Do all jobs, two at a time, each in a process of its own."""
    os.environ |= {"COLUMNS": "100", "PYTHONUTF8": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    out.mkdir(parents=True)
    jobs = [job for job in all_jobs(shared) if not only or job.name in only]
    pool = ProcessPoolExecutor(2, mp_context=get_context("spawn"), max_tasks_per_child=1)
    with tempfile.TemporaryDirectory() as demos, pool:
        for job in [pool.submit(do, job, out, Path(demos)) for job in jobs]:
            print(job.result(), flush=True)


def same_number(old: str, new: str) -> bool:
    """Whether two numbers as they are written are equal; the last digits of a float may differ."""
    if any(set(one).isdisjoint(".eE") for one in (old, new)):
        return old == new
    return math.isclose(float(old), float(new), rel_tol=RELATIVE, abs_tol=ABSOLUTE)


def same_text(old: str, new: str) -> bool:
    """Whether two texts are equal, but for the last digits of their numbers."""
    ones, twos = NUMBER.split(old), NUMBER.split(new)  # in turn what is no number, and a number
    return ones[::2] == twos[::2] and all(map(same_number, ones[1::2], twos[1::2]))


def text_differences(old: str, new: str) -> Iterator[str]:
    """The lines that differ, each cut to where it does."""
    ones, twos = old.splitlines(), new.splitlines()
    if len(ones) != len(twos):
        lines = list(difflib.unified_diff(ones, twos, lineterm="", n=0))[2:]
        yield from (line[:200] for line in lines if line[0] in "+-")
        return
    for one, two in zip(ones, twos, strict=True):
        if not same_text(one, two):
            first = next((at for at, (a, b) in enumerate(zip(one, two, strict=False)) if a != b), 0)
            yield from (f"{sign} {line[max(first - 60, 0) : first + 140]}" for sign, line in (("-", one), ("+", two)))


def array_differences(old: Path, new: Path) -> Iterator[str]:
    """The arrays that differ, and the first values that do."""
    with np.load(old) as ones, np.load(new) as twos:
        for name in sorted({*ones, *twos}):
            one, two = (arrays[name] if name in arrays else np.array([]) for arrays in (ones, twos))
            if one.shape != two.shape or one.dtype != two.dtype:
                yield f"{name}: {one.dtype} {one.shape} was, {two.dtype} {two.shape} is"
                continue
            close = one == two if one.dtype.kind != "f" else np.isclose(two, one, RELATIVE, ABSOLUTE, equal_nan=True)
            if not close.all():
                yield f"{name}: {(~close).sum()} of {close.size} differ: {one[~close][0]} was, {two[~close][0]} is"


def compare(old: Path, new: Path, most: int = 20) -> Iterator[str]:
    """What differs between two folders that `make` wrote, at most so many lines of a file."""
    ones, twos = ({str(path.relative_to(top)) for path in top.rglob("*") if path.is_file()} for top in (old, new))
    for name in sorted(ones | twos):
        if name not in ones or name not in twos:
            yield f"{name}: only in {old if name in ones else new}"
            continue
        if name.endswith(".npz"):
            found = list(array_differences(old / name, new / name))
        else:
            a, b = ((top / name).read_text(encoding="utf-8") for top in (old, new))
            found = [] if a == b or same_text(a, b) else list(text_differences(a, b))
        yield from (f"{name}: {line}" for line in found[:most])
        if len(found) > most:
            yield f"{name}: and {len(found) - most} lines more"


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make", help="run everything and write what it says into a new folder")
    making.add_argument("out", type=Path)
    making.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="folder of the shared data")
    making.add_argument("--only", nargs="+", default=[], metavar="JOB", help="do these jobs only")
    comparing = commands.add_parser("compare", help="print what differs; exit code 1 if anything does")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    given = parser.parse_args()
    if not Path(tactile_bayes.__file__).is_relative_to(ROOT):
        parser.error(f"this would run {tactile_bayes.__file__}: set PYTHONPATH={ROOT}")
    if given.command == "make":
        make(given.out.resolve(), given.shared.resolve(), given.only)
        return 0
    differences = list(compare(given.old, given.new))
    print("\n".join(differences) or "no difference")
    return int(bool(differences))


if __name__ == "__main__":
    sys.exit(main())
