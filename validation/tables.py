"""Write the kept tables into docs/accuracy.md and docs/coverage.md: ``python -m validation tables``.

A table stands between ``<!-- table NAME -->`` and ``<!-- end -->``; validation/results/NAME.csv has its cells.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

from validation.common import RESULTS, markdown, parser

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = (DOCS / "accuracy.md", DOCS / "coverage.md")
_PLACE = re.compile(r"(<!-- table ([a-z0-9-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def names_in(page: Path) -> list[str]:
    """Names of the tables of a page."""
    return [found[2] for found in _PLACE.finditer(page.read_text(encoding="utf-8"))]


def written(page: Path) -> str:
    """The page with its tables as they are kept."""

    def table(found: re.Match[str]) -> str:
        with (RESULTS / f"{found[2]}.csv").open(newline="", encoding="utf-8") as file:
            return f"{found[1]}{markdown(list(csv.reader(file)))}\n{found[3]}"

    return _PLACE.sub(table, page.read_text(encoding="utf-8"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write both pages."""
    parser(__name__, __doc__).parse_args(arguments)
    for page in PAGES:
        page.write_text(written(page), encoding="utf-8")
