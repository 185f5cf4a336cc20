"""How often a right scan is told to be unlike an exam: ``python -m validation plausibility``.

The scans are those of ``validation arrangement``: right exams of our own, or the scans of a folder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.plausibility import against_no_lump
from validation.arrangement import scans
from validation.common import Table, parser

SEED = 20281211


def main(arguments: Sequence[str] | None = None) -> None:
    """Print how many right scans have each kind of finding, and which stand against "no lump"."""
    words = parser(__name__, __doc__)
    words.add_argument("--exams", type=int, default=60)
    words.add_argument("--seed", type=int, default=SEED)
    words.add_argument("--scans", type=Path, help="folder of .npz in place of simulated exams")
    given = words.parse_args(arguments)
    told: Counter[str] = Counter()
    number = blocked = 0
    for scan in scans(given.scans, given.exams, given.seed):
        tactile_map = build_map(scan, as_stated=True)
        told.update({one.kind for one in tactile_map.findings})
        against = against_no_lump(tactile_map)
        number, blocked = number + 1, blocked + bool(against)
        for one in against:
            print(f"scan {number}: {one.kind}: {one.text}", flush=True)
    table = Table("plausibility", "finding", f"of {number} right scans")
    for kind, times in [('any against "no lump"', blocked), *told.most_common()]:
        table.add(kind, str(times))
