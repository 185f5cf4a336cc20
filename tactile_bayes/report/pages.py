"""Pages from templates, and their files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tactile_bayes import __version__
from tactile_bayes.declarations import Record
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import check_suffix, refuse_existing, same_file, write_all
from tactile_bayes.findings import Finding, counted, finding_lines
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from jinja2 import Environment


# --- Pages from templates: every text is escaped, and all have one style sheet and one content policy.

TEMPLATES: Final = Path(__file__).with_name("templates")


def page(kind: str, *, title: str, images: str = "data:", script_sha256: str = "", **values: Any) -> str:
    """A page of the kind "exam", "growth", "trial" or "campaign".

    `images` is where its pictures may come from; `script_sha256` is of the one script that may run, in base 64.
    """
    scripts = f"; script-src 'sha256-{script_sha256}'" if script_sha256 else ""
    of_all = {"kind": kind, "title": title, "research_use": RESEARCH_USE, "version": __version__}
    return _environment().get_template(f"{kind}.html").render(**of_all, images=images, scripts=scripts, **values)


def cut(text: str, longest: int = 400) -> str:
    """A text in one line of at most so many letters."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def foot(scans: Iterable[Mapping[str, str]], more: str = "") -> str:
    """Last line of a page: the program, `more` of it, the first scans by their digests, and what sizes come from."""
    digests = [scan["sha256"][:12] for scan in scans if scan.get("sha256")][:6]
    named_scans = [f"scan{'s' if len(digests) > 1 else ''} {', '.join(digests)}"] if digests else []
    made = "; ".join(filter(None, [f"tactile-bayes {__version__}", more, *named_scans]))
    return f"{made}. Sizes come from simulated bodies; no scan of a person has been used. {RESEARCH_USE}"


def signed(percent: float) -> str:
    """Whole percent with its sign; none has no sign."""
    return f"{round(percent):+d}" if round(percent) else "0"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # only where a page is made

    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters |= {"cut": cut, "signed": signed}
    return made


# --- Growth of masses between visits, as `compare` told it: rows of a table and a section of a page.

_OUTCOMES: Final = ("grown", "shrunk", "no change shown", "not compared")


class Growth(Record, eq=False):
    """Change of one mass from its first visit to a later one."""

    patient: str
    mass: str
    earlier: str
    later: str
    """`patient`, `mass`, `earlier`, `later`: Codes; `later` is the last visit's where visits could not be compared."""
    status: str
    reason: str = ""
    """`status`, `reason`: As `compare` has them, or ``failed``."""
    days: float | None = None  #: Between the visits; None where it is not known.
    sizes_mm: tuple[Quantity, ...] = ()  #: Largest size at both visits; empty without a comparison.
    percent: Quantity | None = None  #: Change of the diameter, likewise; None without one.
    verdict: str = ""
    """``grown``, ``shrunk`` or ``no_change_shown``; empty without one."""
    findings: tuple[Finding, ...] = ()  #: What speaks against the comparison.
    link: str = ""  #: File of the comparison from the page's folder; empty for none.

    @property
    def outcome(self) -> str:
        """Verdict on the change with its condition, or the reason why visits were not compared."""
        words = ", ".join(filter(None, (self.verdict.replace("_", " "), self.reason)))
        return words if self.verdict else f"not compared: {self.reason}"

    @property
    def words(self) -> str:
        """`outcome` with its findings."""
        return ". ".join([self.outcome, *finding_lines(self.findings, paper=True)])


def growth_line(rows: Sequence[Growth], table: str) -> str:
    """Each mass by its last visit, in one sentence; empty without any."""
    if not rows:
        return ""
    last = {(row.patient, row.mass): row.verdict for row in rows}
    counts = Counter(verdict.replace("_", " ") or "not compared" for verdict in last.values())
    parts = ", ".join(f"{counts[words]} {words}" for words in _OUTCOMES if counts[words])
    return f"growth of {counted(len(last), 'mass')} with several visits: {parts} ({table})"


# --- A page as files: HTML, and printed to PDF.


class PageFiles(Record):
    """Files that a page is written to; names that could not be written are refused, before any work is done."""

    html: Path
    pdf: Path | None = None  #: None writes none.
    force: bool = False  #: Overwrite them.

    def __post_init__(self) -> None:
        check_suffix(self.html, "HTML")
        refuse_existing(self.html, force=self.force)
        if self.pdf is not None:
            if same_file(self.pdf, self.html):
                raise UsageError(f"{self.pdf} is page and PDF at once; choose another name for one of them")
            check_suffix(self.pdf, "PDF")
            refuse_existing(self.pdf, force=self.force)
            find_printer()

    def write(self, text: str) -> None:
        """Write the page and its print: both of them, or none."""
        files = {self.html: text.encode()}
        if self.pdf is not None:
            files[self.pdf] = find_printer()(text)
        write_all(files, force=self.force)


# --- Printing of a page to PDF, by an installed Chromium or by WeasyPrint.

BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PATIENCE_S: Final = 120
# What a browser writes of the time: noughts stand there instead, as many, for places in a PDF are counted in bytes.
_TIMES: Final = re.compile(rb"/(CreationDate|ModDate) ?\(D:[0-9+Z'-]*\)")


def find_printer() -> Callable[[str], bytes]:
    """Function that turns HTML into PDF: an installed browser's, else WeasyPrint's."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is not None:
        return lambda text: _by_browser(browser, text)
    if find_spec("weasyprint") is not None:
        return _by_weasyprint
    raise UsageError(
        "--pdf needs Chromium or WeasyPrint and finds neither; install Chromium or `pip install 'tactile-bayes[pdf]'`, "
        "or print the page from your browser"
    )


def _by_browser(browser: str, text: str) -> bytes:
    """PDF by a headless browser with a profile of its own and no network."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "page.html", Path(folder) / "page.pdf"
        source.write_text(text, encoding="utf-8")
        command = [
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
            done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise UsageError(f"{browser} did not print the page ({error}); print it from your browser") from None
        if not target.exists():
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1][:200]
            raise UsageError(f"{browser} did not print the page ({last}); print it from your browser")
        return _TIMES.sub(lambda time: re.sub(rb"[0-9]", b"0", time[0]), target.read_bytes())


def _by_weasyprint(text: str) -> bytes:
    from weasyprint import HTML

    return bytes(HTML(string=text).write_pdf())
