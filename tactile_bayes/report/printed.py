"""Printing of a page to PDF, by an installed Chromium or by WeasyPrint."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from tactile_bayes.errors import UsageError

Printer = Callable[[str], bytes]
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PATIENCE_S: Final = 120
# What a browser writes of the time, and what stands there instead, of the same length.
_TIMES: Final = re.compile(rb"/(CreationDate|ModDate) ?\(D:[0-9+Z'-]*\)")


def find_printer() -> Printer:
    """What prints a page here.

    Raises
    ------
    UsageError
        When neither Chromium nor WeasyPrint is installed.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is not None:
        return lambda page: _by_browser(browser, page)
    if find_spec("weasyprint") is not None:
        return _by_weasyprint
    raise UsageError(
        "--pdf needs Chromium or WeasyPrint and finds neither; install Chromium or `pip install 'tactile-bayes[pdf]'`, "
        "or print the page from your browser"
    )


def _by_browser(browser: str, page: str) -> bytes:
    """PDF by a headless browser with a profile of its own and no network."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.html", Path(folder) / "page.pdf"
        source.write_text(page, encoding="utf-8")
        words = [
            browser,
            "--headless",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--no-pdf-header-footer",
            f"--user-data-dir={Path(folder) / 'profile'}",
            f"--print-to-pdf={target}",
            *(["--no-sandbox"] if os.geteuid() == 0 else []),  # Chromium refuses root with its sandbox
            source.as_uri(),
        ]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UsageError(f"{browser} did not print the page ({error}); print it from your browser") from None
        if not target.exists():
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1][:200]
            raise UsageError(f"{browser} did not print the page ({last}); print it from your browser")
        return _TIMES.sub(_timeless, target.read_bytes())


def _timeless(found: re.Match[bytes]) -> bytes:
    """The same entry with a fixed time, as long as it was: places in a PDF are counted in bytes."""
    start, time = found[0].split(b"(D:")
    return start + b"(D:" + re.sub(rb"[0-9]", b"0", time)


def _by_weasyprint(page: str) -> bytes:
    from weasyprint import HTML

    document: bytes = HTML(string=page).write_pdf()
    return document
