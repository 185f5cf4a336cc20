"""Measure the commands against their peers, and the ratios against the last kept ones: ``python -m benchmarks.run``."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.cold_start import CASES, PEERS, Case
from benchmarks.last import LAST, Comparison
from benchmarks.measure import CommandFailedError, Cost, measure, run_once

SCHEMA = "tactile-bayes/benchmarks/1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table, write JSON when asked; 1 when a command failed."""
    options = _parse(arguments)
    last = Comparison("commands", options.last)
    chosen = [case for case in CASES if not options.only or case.name in options.only]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        used = sorted({case.peer for case in chosen}, key=list(PEERS).index)
        peers = {peer: measure(PEERS[peer], folder=folder, runs=options.runs) for peer in used}
        print(f"{'what':<20}{'CPU s':>8}{'MB':>7}  over its peer")
        for peer, cost in peers.items():
            print(f"{peer:<20}{cost.cpu_s:>8.3f}{cost.peak_mb:>7.0f}")
        rows = [_row(case, peers[case.peer], folder=folder, runs=options.runs, last=last) for case in chosen]
    print(last.report())
    if options.keep:
        last.keep()
    if options.json:
        document = {
            "schema": SCHEMA,
            "machine": _machine(),
            "runs": options.runs,
            "peers": _plain(peers),
            "cases": rows,
        }
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return 1 if any("error" in row for row in rows) else 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    names = [case.name for case in CASES]
    parser.add_argument("--only", action="append", choices=names, help="measure this case; may be repeated")
    parser.add_argument("--runs", type=int, default=5, help="runs a case after one to warm up (5)")
    parser.add_argument("--keep", action="store_true", help="keep these ratios: later runs are compared with them")
    parser.add_argument("--last", type=Path, default=LAST, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    options = parser.parse_args(arguments)
    if options.runs < 1:
        parser.error(f"--runs is {options.runs}; give 1 or more")
    return options


def _row(case: Case, peer: Cost, *, folder: Path, runs: int, last: Comparison) -> dict[str, Any]:
    """Measure one case and print its line."""
    row: dict[str, Any] = {"name": case.name, "words": _public(case), "peer": case.peer}
    try:
        _make_inputs(case, folder=folder)
        cost = measure(case.arguments, folder=folder, runs=runs)
    except CommandFailedError as error:
        print(f"{case.name:<20} {error}")
        return row | {"error": str(error)}
    cpu, memory = cost.cpu_s / peer.cpu_s, cost.peak_mb / peer.peak_mb
    before = last.add(f"{case.name}, CPU", cpu), last.add(f"{case.name}, memory", memory)
    text = f"{cpu:.2f} x CPU{before[0]}, {memory:.2f} x memory{before[1]} of {case.peer}"
    print(f"{case.name:<20}{cost.cpu_s:>8.3f}{cost.peak_mb:>7.0f}  {text}", flush=True)
    return row | {
        "cpu_s": round(cost.cpu_s, 4),
        "peak_mb": round(cost.peak_mb, 1),
        "cpu_ratio": round(cpu, 3),
        "memory_ratio": round(memory, 3),
    }


def _make_inputs(case: Case, *, folder: Path) -> None:
    for name in case.needs:
        (needed,) = (other for other in CASES if other.name == name)
        _make_inputs(needed, folder=folder)
        run_once(needed.arguments, folder=folder)


def _public(case: Case) -> list[str]:
    """The words without this machine's folders."""
    return [Path(word).name if Path(word).is_absolute() else word for word in case.words]


def _machine() -> dict[str, Any]:
    return {
        "python": platform.python_version(),
        "system": platform.system(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
    }


def _plain(peers: dict[str, Cost]) -> dict[str, dict[str, float]]:
    return {name: {"cpu_s": round(c.cpu_s, 4), "peak_mb": round(c.peak_mb, 1)} for name, c in peers.items()}


if __name__ == "__main__":
    sys.exit(main())
