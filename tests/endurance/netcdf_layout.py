"""Bytes of one map written many times while threads hold the writer's frames, as a profiler does.

    python tests/endurance/netcdf_layout.py [--times 200] [--threads 1] [--unflushed]

Prints how many different files came. ``--unflushed`` writes as the program did before record 0114's mend.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import h5py

import tactile_bayes as tb
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.mapping.build import build_map


@contextlib.contextmanager
def frames_held(threads: int) -> Iterator[None]:
    """Hold the frames of all threads for 0 to 3 ms at a time."""
    done = threading.Event()

    def hold(seed: int) -> None:
        rng = random.Random(seed)
        while not done.is_set():
            frames = sys._current_frames()
            time.sleep(rng.uniform(0.0, 3e-3))
            del frames
            time.sleep(1e-3)

    running = [threading.Thread(target=hold, args=(seed,)) for seed in range(threads)]
    for one in running:
        one.start()
    yield
    done.set()
    for one in running:
        one.join()


def layouts(times: int, *, threads: int, unflushed: bool = False) -> Counter[str]:
    """Write the demo's map so many times; how often each digest came."""
    tactile_map = build_map(tb.demo_scan())
    found = Counter[str]()
    without = mock.patch.object(h5py.Dataset, "flush", return_value=None) if unflushed else contextlib.nullcontext()
    with tempfile.TemporaryDirectory() as folder, without, frames_held(threads):
        path = Path(folder) / "map.nc"
        for _ in range(times):
            write_map(path, tactile_map, provenance=Provenance("map", {}, {}), force=True)
            found[hashlib.sha256(path.read_bytes()).hexdigest()] += 1
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--unflushed", action="store_true")
    args = parser.parse_args()
    found = layouts(args.times, threads=args.threads, unflushed=args.unflushed)
    print(f"{args.times} files, {len(found)} different ones; the most frequent {found.most_common(1)[0][1]} times")
