"""Run one validation: ``python -m validation NAME ...``; ``python -m validation`` says which there are."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

NAMES = (
    "known_scans", "held_out", "site_phantoms", "own_trial", "other_head", "stress", "stress_trial", "lump_probability",
    "smallest_lump", "masses", "scene_rates", "method_agreement", "interval_coverage", "repeatability", "coverage",
    "arrangement", "plausibility", "agreement_coverage", "visits", "next_mass_coverage", "tables",
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Give the rest of the words to the module of this name; its exit code."""
    name, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if name in NAMES:
        return int(import_module(f"validation.{name}").main(rest) or 0)
    for one in NAMES:
        text = Path(__file__).with_name(f"{one}.py").read_text(encoding="utf-8")
        print(f"{one:20} {(ast.get_docstring(ast.parse(text)) or '').splitlines()[0].partition(': ``python')[0]}")
    return int(name not in ("", "-h", "--help"))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
