"""`validate` against a script of pandas, statsmodels and pingouin, and its growth: ``python -m benchmarks.trial``.

The peer needs ``pip install statsmodels pingouin``; without them only the growth is measured.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import tempfile
from pathlib import Path

from benchmarks.measure import Cost, measure, run_once
from benchmarks.trial_tables import write_trial

SIZES = (25, 1000, 10_000, 100_000)
PEER_SIZES = (25, 1000)


def main() -> None:
    """Print CPU seconds and memory by the number of masses, and write JSON when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=SIZES[-1], help="largest number of masses (100000)")
    parser.add_argument("--json", type=Path, metavar="OUT")
    options = parser.parse_args()
    has_peer = all(importlib.util.find_spec(name) for name in ("statsmodels", "pingouin"))
    rows = []
    print(f"{'masses':>8}  {'validate CPU s':>14}  {'MB':>6}  peer CPU s, MB, ratio")
    with tempfile.TemporaryDirectory() as name:
        for masses in (size for size in SIZES if size <= options.most):
            row = _row(masses, Path(name), peer=has_peer and masses in PEER_SIZES)
            rows.append(row)
            print(_line(row), flush=True)
    if options.json:
        document = {"schema": "tactile-bayes/benchmarks/1", "trial": rows}
        options.json.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _row(masses: int, folder: Path, *, peer: bool) -> dict[str, float | int | None]:
    trial, excision = write_trial(folder, masses)
    ours = ("-m", "tactile_bayes", "validate", str(trial), "--excision", str(excision))
    cost = measure(ours, folder=folder, runs=3) if masses <= 1000 else run_once(ours, folder=folder)
    theirs: Cost | None = None
    if peer:
        theirs = measure(("-m", "benchmarks.peer_trial", str(trial), str(excision)), folder=folder, runs=3)
    return {
        "masses": masses,
        "cpu_s": round(cost.cpu_s, 3),
        "peak_mb": round(cost.peak_mb, 1),
        "peer_cpu_s": None if theirs is None else round(theirs.cpu_s, 3),
        "peer_peak_mb": None if theirs is None else round(theirs.peak_mb, 1),
    }


def _line(row: dict[str, float | int | None]) -> str:
    line = f"{row['masses']:>8}  {row['cpu_s']:>14.2f}  {row['peak_mb']:>6.0f}"
    if row["peer_cpu_s"] and row["cpu_s"]:
        line += f"  {row['peer_cpu_s']:.2f}, {row['peer_peak_mb']:.0f}, {row['cpu_s'] / row['peer_cpu_s']:.2f} x CPU"
    return line


if __name__ == "__main__":
    main()
