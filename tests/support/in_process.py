"""The program inside the tests' own process: what `run_cli` does, without half a second of imports each time."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

from tactile_bayes.cli import main


@contextlib.contextmanager
def _called(arguments: list[str]) -> Iterator[None]:
    before, sys.argv = sys.argv, ["tactile-bayes", *arguments]
    try:
        yield
    finally:
        sys.argv = before


def run_here(*arguments: object, cwd: Path) -> CompletedProcess[str]:
    """Run ``tactile-bayes ARGUMENTS`` in `cwd`; its warnings are this process's, and so errors."""
    words = [str(word) for word in arguments]
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with contextlib.chdir(cwd), _called(words), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code
    return CompletedProcess(
        words, code if isinstance(code, int) else int(code is not None), out.getvalue(), err.getvalue()
    )
