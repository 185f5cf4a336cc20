"""The last kept ratios, and which of today's are worse: ``benchmarks/last.csv``, written with ``--keep``.

Only ratios are kept: over a peer that was measured in the same run, so that they hardly depend on the machine.
"""

from __future__ import annotations

import csv
import datetime
import platform
from dataclasses import dataclass, field, fields
from pathlib import Path

from tactile_bayes.declarations import as_dict

LAST = Path(__file__).resolve().parent / "last.csv"
MARGIN = 0.2
"""A ratio that grew by a larger share than this is flagged; runs on one quiet machine differ by half of it."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One kept ratio.

    Parameters
    ----------
    bench, name
        The benchmark, and what of it.
    ratio
        Cost over that of the peer: less is better.
    date, kernel, python
        When, and under which operating system's kernel and Python.
    """

    bench: str
    name: str
    ratio: float
    date: str
    kernel: str
    python: str


@dataclass(slots=True)
class Comparison:
    """Ratios of one benchmark's run against the last kept ones.

    Parameters
    ----------
    bench
        The benchmark.
    path
        The table.
    now
        Ratios of this run, by name.
    """

    bench: str
    path: Path = LAST
    now: dict[str, float] = field(default_factory=dict)
    _kept: dict[tuple[str, str], Figure] = field(init=False)

    def __post_init__(self) -> None:
        self._kept = {(one.bench, one.name): one for one in read_figures(self.path)}

    def add(self, name: str, ratio: float) -> str:
        """Take a ratio in and return what the last one was, to print behind it; "" without one."""
        self.now[name] = ratio
        last = self._kept.get((self.bench, name))
        if last is None:
            return ""
        return f" (last {last.ratio:.2f}{', WORSE' if self._is_worse(name) else ''})"

    def worse(self) -> list[str]:
        """Names of the ratios that are worse than the last by more than `MARGIN`."""
        return [name for name in self.now if self._is_worse(name)]

    def report(self) -> str:
        """One line: how many got worse, and by how much they would have to."""
        known = [name for name in self.now if (self.bench, name) in self._kept]
        if not known:
            return f"no figure to compare with in {self.path.name}; keep these with --keep"
        worse = self.worse()
        found = f"{len(worse)} of {len(known)} ratios are more than {100 * MARGIN:.0f} % above the last kept ones"
        return f"{found}: {'; '.join(worse)}" if worse else found

    def keep(self) -> None:
        """Write this run's ratios into the table, in place of those of the same names."""
        made = (
            datetime.date.today().isoformat(),
            f"{platform.system()} {platform.release()}",
            platform.python_version(),
        )
        for name, ratio in self.now.items():
            self._kept[self.bench, name] = Figure(self.bench, name, round(ratio, 3), *made)
        with self.path.open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, [one.name for one in fields(Figure)], lineterminator="\n")
            table.writeheader()
            table.writerows(as_dict(self._kept[key]) for key in sorted(self._kept))

    def _is_worse(self, name: str) -> bool:
        last = self._kept.get((self.bench, name))
        return last is not None and self.now[name] > (1 + MARGIN) * last.ratio


def read_figures(path: Path = LAST) -> list[Figure]:
    """The kept ratios; none where there is no table yet."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [Figure(**row | {"ratio": float(row["ratio"])}) for row in csv.DictReader(file)]
