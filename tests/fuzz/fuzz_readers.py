"""Feed damaged files to every reader: ``python tests/fuzz/fuzz_readers.py [FORMAT...] [--inputs N] [--keep DIR]``.

Each format's valid files are damaged N times (`fuzz_mutations`) and read in a process of its own that may take 1 GB
more memory than it has at the start and 10 s of CPU a file. A reader accepts the file or refuses it with one of the
program's own errors; anything else is a fault: another exception, memory, time, or the end of the process. DIR gets the
faults.
"""

from __future__ import annotations

import argparse
import collections
import random
import resource
import select
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path

from fuzz_mutations import mutate
from fuzz_seeds import FORMATS, Format

MEMORY_BYTES = 10**9
SECONDS = 10
OUTCOMES = ("accepted", "refused", "traceback", "memory", "time", "crash")
_GRACE_S = 60.0


class _OverTimeError(BaseException):
    """Not an `Exception`: no reader may catch it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the workers and print one row a format; 1 when there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("formats", nargs="*")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-faults"))
    parser.add_argument("--seeds", type=Path, help="For a worker: where the valid files are.")
    options = parser.parse_args(arguments)
    if options.seeds:
        work(options.formats[0], options.seeds, first=options.first, inputs=options.inputs, keep=options.keep)
        return 0
    print(f"{'format':18}" + "".join(f"{outcome:>11}" for outcome in OUTCOMES), flush=True)
    faults = 0
    for name in options.formats or FORMATS:
        found = fuzz(name, first=options.first, inputs=options.inputs, keep=options.keep)
        faults += sum(found[outcome] for outcome in OUTCOMES[2:])
        print(f"{name:18}" + "".join(f"{found[outcome]:11d}" for outcome in OUTCOMES), flush=True)
    return int(faults > 0)


def fuzz(name: str, *, first: int, inputs: int, keep: Path) -> collections.Counter[str]:
    """Outcomes of the inputs `first` to ``first + inputs``; a worker that ends is begun again after its input."""
    found: collections.Counter[str] = collections.Counter()
    last = first + inputs
    with tempfile.TemporaryDirectory() as folder:
        seeds = Path(folder)
        for number, seed in enumerate(FORMATS[name].seeds(seeds)):
            (seeds / f"{number}.seed").write_bytes(seed)
        while first < last:
            outcomes = _run_worker(name, seeds, first=first, inputs=last - first, keep=keep)
            found.update(outcomes)
            first += len(outcomes)
            if outcomes[-1] in ("crash", "time"):
                _keep(name, first - 1, keep, outcomes[-1], _seeds(seeds))
    return found


def _run_worker(name: str, seeds: Path, *, first: int, inputs: int, keep: Path) -> list[str]:
    """The outcomes that one worker comes to; the last is of the input it ended with."""
    words = [name, "--seeds", str(seeds), "--first", str(first), "--inputs", str(inputs), "--keep", str(keep)]
    command = [sys.executable, str(Path(__file__)), *words]
    outcomes: list[str] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        while len(outcomes) < inputs:
            ready, _, _ = select.select([process.stdout], [], [], SECONDS + _GRACE_S)
            line = process.stdout.readline() if ready else b""
            outcomes.append(line.decode().strip() if line else "crash" if ready else "time")
            if not line:
                process.kill()
                break
    return outcomes


def _seeds(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(folder.glob("*.seed"))]


def _keep(name: str, number: int, keep: Path, outcome: str, seeds: Sequence[bytes], trace: str = "") -> None:
    """Write the input that made a fault, and the traceback."""
    keep.mkdir(parents=True, exist_ok=True)
    stem = f"{name.replace(' ', '-')}-{number}-{outcome}"
    (keep / (stem + FORMATS[name].suffix)).write_bytes(_input(name, seeds, number))
    if trace:
        (keep / f"{stem}.txt").write_text(trace)


def _input(name: str, seeds: Sequence[bytes], number: int) -> bytes:
    return mutate(random.Random(f"{name} {number}"), seeds, name)


def work(name: str, folder: Path, *, first: int, inputs: int, keep: Path) -> None:
    """Read the inputs one after the other in this process and print the outcome of each."""
    warnings.simplefilter("error")
    signal.signal(signal.SIGPROF, _stop)
    form, seeds = FORMATS[name], _seeds(folder)
    path = folder / f"input{form.suffix}"
    _read(form, path, seeds[0])  # whatever is imported on the way is not the input's memory
    _limit_memory()
    for number in range(first, first + inputs):
        outcome, trace = _read(form, path, _input(name, seeds, number))
        if trace:
            _keep(name, number, keep, outcome, seeds, trace)
        print(outcome, flush=True)


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _stop(number: int, frame: object) -> None:
    del number, frame
    raise _OverTimeError


def _read(form: Format, path: Path, data: bytes) -> tuple[str, str]:
    """The worst outcome over the readers, with the traceback of a fault."""
    from tactile_bayes.errors import TactileBayesError

    path.write_bytes(data)
    outcome = "accepted"
    for reader in form.readers:
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            reader(path)
        except TactileBayesError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                return "traceback", f"not one line: {str(error)[:5000]!r}"
            outcome = "refused"
        except MemoryError:
            return "memory", traceback.format_exc()
        except _OverTimeError:
            return "time", traceback.format_exc()
        except Exception:
            return "traceback", traceback.format_exc()
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    return outcome, ""


if __name__ == "__main__":
    sys.exit(main())
