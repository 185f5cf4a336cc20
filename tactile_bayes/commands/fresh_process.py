"""CPU time of this program in a process of its own: what a user who types one command waits for."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

TIMES = 2


def fresh_cpu_s(words: Sequence[str]) -> float | None:
    """Least CPU seconds of a command in a fresh process; None where the system does not tell them.

    Parameters
    ----------
    words
        Of the command, without the program's name.
    """
    spent = []
    for _ in range(TIMES):
        before = os.times()
        subprocess.run(
            [sys.executable, "-m", "tactile_bayes", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
        after = os.times()
        spent.append(after.children_user - before.children_user + after.children_system - before.children_system)
    least = min(spent)
    return least if least > 0 else None
