"""What the size of the map's cells changes: widths and sizes of the same scans at several cell sizes.

    python -m benchmarks.cell_size SCAN.mcap... [--cells 0.75 1.5 2 3 4]

Each scan is mapped at 1 mm and at every other size by the command line and estimated by default. For each cell size the
table has the scans with a size at both, the mean and the largest absolute change of sigma_x, sigma_y and the largest
size against the cells of 1 mm, and the largest change of a width in posterior SDs. `benchmarks.own_trial make` makes
scans for it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("sigma_x_mm", "sigma_y_mm", "max_size_mm")
REFERENCE_MM = 1.0


def estimate_at(scan: Path, cell_mm: float, folder: Path) -> dict[str, Any] | None:
    """The JSON estimate of a scan mapped in cells of one size; None where there is no size."""
    tactile_map = folder / "map.nc"
    done = _command("map", scan, "-o", tactile_map, "--cell-mm", cell_mm, "--force")
    if done.returncode:
        return None
    document: dict[str, Any] = json.loads(_command("estimate", tactile_map, "--json").stdout)
    return document if document["max_size_mm"] else None


def changes(reference: dict[str, Any], other: dict[str, Any]) -> list[float]:
    """Change of the logarithm of each of `NAMES`, and the larger change of a width in SDs of the reference."""
    logs = [float(np.log(other[name]["median"] / reference[name]["median"])) for name in NAMES]
    in_sd = [abs(other[name]["median"] - reference[name]["median"]) / reference[name]["sd"] for name in NAMES[:2]]
    return [*logs, max(in_sd)]


def _command(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tactile_bayes", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def main() -> None:
    """Print one row a scan and cell size, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("--cells", nargs="+", type=float, default=[0.75, 1.5, 2.0, 3.0, 4.0])
    options = parser.parse_args()
    found: dict[float, list[list[float]]] = {cell: [] for cell in options.cells}
    with tempfile.TemporaryDirectory() as name:
        for scan in options.scans:
            reference = estimate_at(scan, REFERENCE_MM, Path(name))
            if reference is None:
                continue
            for cell in options.cells:
                other = estimate_at(scan, cell, Path(name))
                if other is not None:
                    found[cell].append(changes(reference, other))
                    x, y, size, in_sd = found[cell][-1]
                    print(
                        f"{scan.stem} {cell:g} mm: sigma {100 * x:+.1f}, {100 * y:+.1f} %, size {100 * size:+.1f} %, "
                        f"{in_sd:.1f} SD",
                        flush=True,
                    )
    print("cell, mm  scans  sigma_x, mean and most  sigma_y          largest size     a width in SDs, most")
    for cell, rows in found.items():
        if rows:
            table = np.abs(np.array(rows))
            mean, most = 100 * table.mean(axis=0), 100 * table.max(axis=0)
            cells = "".join(f"{mean[i]:8.1f} {most[i]:5.1f} % " for i in range(3))
            print(f"{cell:8g}  {len(rows):5d} {cells}   {table[:, 3].max():.1f}")


if __name__ == "__main__":
    main()
