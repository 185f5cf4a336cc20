"""What the validations share: options, scans and maps of scenes, the command line, exact shares, and what is kept."""

from __future__ import annotations

import argparse
import csv
import json
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import apply
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.scans import Scan

RESULTS = Path(__file__).with_name("results")
Row = dict[str, Any]


def parser(name: str, doc: str | None) -> argparse.ArgumentParser:
    """Options of one validation, from the name of its module and its docstring."""
    prog = f"python -m validation {name.rpartition('.')[2]}"
    return argparse.ArgumentParser(prog, description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def scan_of(scene: Scene) -> Scan:
    """The scan that a scene's own seed gives."""
    return simulate(scene, rng=np.random.default_rng(scene.seed)).scan


def map_of(scene: Scene) -> TactileMap:
    """Its map."""
    return build_map(scan_of(scene), as_stated=True)


def keep_scan(path: Path, scene: Scene) -> str:
    """Write the scan of a scene unless it is there; the file's name."""
    if not path.exists():
        write_scan(path, scan_of(scene), provenance=Provenance("validation", {}, {}, seed=scene.seed))
    return path.name


def place_on_map(scene: Scene, tactile_map: TactileMap, at: tuple[float, float]) -> tuple[float, float]:
    """A place of the scene's `plane` on a map of it, by the landmarks."""
    if tactile_map.patient_from_plane is None:
        raise ValueError("the map has no landmarks")
    xiphoid = scene.landmarks.xiphoid_mm
    depth = float(apply(tactile_map.patient_from_plane, np.zeros(3))[2])
    point = np.array([at[0] - xiphoid[0], at[1] - xiphoid[1], depth])
    x, y, _ = apply(np.linalg.inv(tactile_map.patient_from_plane), point)
    return float(x), float(y)


def program(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, whatever its exit code."""
    command = [sys.executable, "-m", "tactile_bayes", *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def run(*words: object, codes: tuple[int, ...] = (0,)) -> str:
    """What the command line prints; any other exit code ends the validation with what it said."""
    done = program(*words)
    if done.returncode not in codes:
        raise SystemExit(f"tactile-bayes {' '.join(map(str, words))}: exit {done.returncode}\n{done.stderr}")
    return done.stdout


# --- shares and errors


def exact(hits: int, of: int) -> tuple[float, float]:
    """The exact (Clopper-Pearson) 95 % interval of a share."""
    found = binomtest(hits, of).proportion_ci()
    return float(found.low), float(found.high)


def share(inside: Sequence[bool]) -> str:
    """``0.943 [0.902, 0.970]``."""
    if not inside:
        return "-"
    low, high = exact(sum(inside), len(inside))
    return f"{np.mean(inside):.3f} [{low:.3f}, {high:.3f}]"


def percent(hits: int, of: int, digits: int = 0) -> str:
    """``36 % (24 to 50)``."""
    low, high = exact(hits, of)
    return f"{100 * hits / of:.{digits}f} % ({100 * low:.{digits}f} to {100 * high:.{digits}f})"


def errors_of(rows: Sequence[tuple[float, float, float, float]]) -> str:
    """Error, bias, coverage and width of sizes; each is true, median, low and high."""
    true, median, low, high = np.array(rows, dtype=float).reshape(-1, 4).T
    error, held = median / true - 1, (low <= true) & (true <= high)
    standard = np.log(median / true) / (np.log(high / low) / 3.92)
    return (
        f"{len(error)} sizes, mean absolute error {100 * np.abs(error).mean():.1f} %, "
        f"bias {100 * error.mean():+.1f} %, {held.sum()} of {len(held)} intervals of 95 % hold, "
        f"SD of standardised errors {standard.std():.2f}, "
        f"median half width {100 * np.median((high - low) / 2 / median):.0f} %"
    )


# --- what is kept, so that an interrupted run goes on


def pickled(path: Path, make: Callable[[], Any]) -> Any:
    """What is kept in a file, made and kept where it is not there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".part")
        partial.write_bytes(pickle.dumps(make()))
        partial.rename(path)
    return pickle.loads(path.read_bytes())


def rows_in(path: Path) -> list[Row]:
    """Rows of a file with a line of JSON each; none where it is not there."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def add_row(path: Path, row: Row) -> None:
    """Add a row to such a file."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


class Table:
    """A table that is printed row by row, as Markdown, and can be kept for the documents.

    Parameters
    ----------
    name
        Of its file in `RESULTS`, and of its place in a document.
    heads
        Of its columns.
    """

    def __init__(self, name: str, *heads: str) -> None:
        self.name, self._rows = name, [heads]
        print("\n" + markdown(self._rows), flush=True)

    def add(self, *cells: str) -> None:
        """Print and remember a row."""
        self._rows.append(cells)
        print(line(cells), flush=True)

    def keep(self) -> None:
        """Write it for `python -m validation tables`."""
        with (RESULTS / f"{self.name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(self._rows)


def line(cells: Iterable[str]) -> str:
    """One row as Markdown."""
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown, the first row its heads."""
    return "\n".join([line(rows[0]), "|" + "---|" * len(rows[0]), *map(line, rows[1:])])
