"""CPU time of exams in a warm process, by what lies in the body: ``python -m benchmarks.exam_time DIR``.

DIR holds the scans of `masses_scenes` (``python -m validation masses make DIR --kind two --kind one --kind empty --kind
faint``). Twelve of each kind are read, mapped and estimated with the defaults, as a worker of a campaign does it, and
twelve maps with a rib, every other one beside a lump, are estimated: those are drawn as in `scene_rates`. One exam
before them warms the process. The results are kept in DIR/exam_time.jsonl; a second call goes on.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from validation.masses_scenes import KINDS
from validation.scene_rates import ROWS, draw_map

RESULTS, EACH, SEED = "exam_time.jsonl", 12, 20261124
RIBBED = ("round and a rib", "a rib and no lump")
Source = Callable[[], TactileMap]


def sources(folder: Path) -> Iterator[tuple[str, Source]]:
    """Names of the exams, and what makes the map of each."""
    for index in range(EACH):
        for kind in KINDS:
            scan = folder / f"{kind}-{index:03d}.mcap"
            if kind == "ribbed":
                yield f"ribbed-{index:03d}", lambda index=index: ribbed(index)
            elif scan.exists():
                yield scan.stem, lambda scan=scan: build_map(read_scan(scan))


def ribbed(index: int) -> TactileMap:
    """A map with a rib."""
    row = next(one for one in ROWS if one.name == RIBBED[index % 2])
    return draw_map(row, np.random.default_rng([SEED, index]))


def measured(name: str, source: Source) -> dict[str, Any]:
    """CPU seconds of the map, and of the estimate with its report."""
    begun = time.process_time()
    tactile_map = source()
    mapped = time.process_time()
    document = estimate_one(tactile_map, Settings()).answer.document
    done = time.process_time()
    assert document is not None
    keys = ("status", "reason_code")
    figures = {"masses": len(document["masses"]), "method": document["diagnostics"].get("method")}
    return {"name": name, "map_s": mapped - begun, "estimate_s": done - mapped, **figures} | {
        key: document[key] for key in keys
    }


def run(folder: Path) -> list[dict[str, Any]]:
    """Measure what is missing; returns all results."""
    path, warm = folder / RESULTS, False
    lines = path.read_text().splitlines() if path.exists() else []
    found = [json.loads(line) for line in lines]
    done = {one["name"] for one in found}
    for name, source in sources(folder):
        if name in done:
            continue
        if not warm:
            measured(name, source)
            warm = True
        found.append(measured(name, source))
        with path.open("a") as file:
            file.write(json.dumps(found[-1]) + "\n")
    return found


def row(name: str, seconds: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    """A row of the table."""
    figures = (np.median(seconds), np.quantile(seconds, 0.99), seconds.max())
    return f"| {name} | {len(seconds)} | " + " | ".join(f"{value:.2f}" for value in figures) + " |"


def main() -> None:
    """Print CPU seconds of scan, map and estimate together as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    found = run(parser.parse_args().folder)
    print("| exams | number | median, s | p99, s | largest, s |\n|---|---|---|---|---|")
    for kind in KINDS:
        these = [one for one in found if one["name"].startswith(f"{kind}-")]
        if these:
            print(row(kind, np.array([one["map_s"] + one["estimate_s"] for one in these])))
    print(row("all", np.array([one["map_s"] + one["estimate_s"] for one in found])))
    chains = [one["name"] for one in found if one["method"] == "ensemble"]
    print(f"answered by chains: {len(chains)} {', '.join(chains)}")


if __name__ == "__main__":
    main()
