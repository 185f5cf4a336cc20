"""The page of an exam."""

from __future__ import annotations

import html
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from tactile_bayes import __version__
from tactile_bayes.declarations import Record
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import check_suffix, refuse_existing, same_file, write_all
from tactile_bayes.mapping.places import orientation_of
from tactile_bayes.posterior.abstention import chance_text
from tactile_bayes.posterior.lump_probability import SHARE_WITH_LUMP
from tactile_bayes.presets import INTERVAL, RESEARCH_USE
from tactile_bayes.report.exam_words import (
    Exam,
    Quantity,
    facts,
    finding_sentences,
    headline,
    largest,
    mass_row,
    narrowing_sentences,
    nothing_sentences,
    place_sentence,
    quality_rows,
    size_sentences,
    why_no_clock,
)
from tactile_bayes.report.svg import (
    Frame,
    breast_dial,
    colour_bar,
    exam_picture,
    marked,
    size_ruler,
    small_pictures,
    smallest_pictures,
)

# --- The page of an exam as files: HTML, and printed to PDF.


class PageFiles(Record):
    """Where the page of an exam goes."""

    html: Path
    pdf: Path | None = None
    """`html`, `pdf`: Files to write; no PDF where it is None."""
    force: bool = False
    """Overwrite them."""

    def check(self) -> None:
        """Refuse, before any work is done, what could not be written.

        Raises
        ------
        UsageError
            When a file exists and `force` is false, both are one file, one has the suffix of another format, or nothing
            is installed that prints.
        """
        check_suffix(self.html, "HTML")
        refuse_existing(self.html, force=self.force)
        if self.pdf is not None:
            if same_file(self.pdf, self.html):
                raise UsageError(f"{self.pdf} is page and PDF at once; choose another name for one of them")
            check_suffix(self.pdf, "PDF")
            refuse_existing(self.pdf, force=self.force)
            find_printer()

    def write(self, exam: Exam) -> None:
        """Write the page and its print: both of them, or none.

        Raises
        ------
        UsageError
            As of `check`, and when the page could not be printed.
        """
        page = exam_page(exam)
        files = {self.html: page.encode()}
        if self.pdf is not None:
            files[self.pdf] = find_printer()(page)
        write_all(files, force=self.force)


# --- Printing of a page to PDF, by an installed Chromium or by WeasyPrint.

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


# --- An exam as one self-contained page that prints to one side of A4: no script, nothing loaded, every text escaped.

TITLE: Final = "Tactile exam"
NO_MAP: Final = (
    "The map is not at hand: this page shows no picture of it, and does not say what was covered nor how hard was "
    "pressed. Given the map too, it does."
)
MOST_REPEATS: Final = 5
MOST_MASSES: Final = 4
_LONGEST: Final = 400
_FINDINGS: Final = ((2, 320), (1, 220))
"""Findings and letters of each, and on a crowded page."""
_PICTURE_MM: Final = (108.0, 96.0)
_LOWER_MM: Final = 54.0
"""Height of the picture on a crowded page: one that has both repeats and several masses below it."""
_REPEAT_MM: Final = (30.0, 19.0)
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_STYLE: Final = """
@page{size:A4 portrait;margin:10mm}
*{box-sizing:border-box}
body{font:15px/1.4 system-ui,"Liberation Sans",Arial,sans-serif;color:#111;background:#fff;margin:1rem auto;
max-width:56rem;padding:0 1rem;overflow-wrap:anywhere}
h1{font-size:1.05rem;font-weight:600;margin:0}h2{font-size:.95rem;margin:.7rem 0 .2rem;border-bottom:1px solid #bbb}
p{margin:.2rem 0}.finding{font-size:1.5rem;font-weight:700;line-height:1.25;
margin:.4rem 0 .3rem}.place{display:flex;flex-wrap:wrap;gap:0 1rem;align-items:center}.place>div{flex:1 1 12rem}
.facts{display:flex;flex-wrap:wrap;gap:0 1.1rem;margin:.1rem 0}.facts span b{font-weight:600}
.mark{border:1.5px solid #111;padding:.2rem .5rem;font-weight:600;display:inline-block;margin:.3rem 0}
.caution{border-left:4px solid #111;padding:.15rem .5rem;margin:.25rem 0;background:#eee}
.columns{display:flex;flex-wrap:wrap;gap:0 1.2rem}.columns>div{flex:1 1 20rem;min-width:0}
.picture{text-align:center}.picture svg.map{max-width:100%;height:auto}.small{font-size:.8rem;color:#333}
table{border-collapse:collapse;width:100%;font-size:.87rem}th{text-align:left;font-weight:600;padding-right:.7rem;
vertical-align:top;white-space:nowrap}td,th{border-bottom:1px solid #ddd;padding-top:.08rem;padding-bottom:.08rem}
.masses td{padding-right:.7rem;vertical-align:top}.masses td:last-child{width:42%}
.repeats{display:flex;flex-wrap:wrap;gap:.4rem .8rem}.repeats figure{margin:0;font-size:.8rem;text-align:center}
.ruler,.bar,.dial{max-width:100%}svg text{font-family:system-ui,"Liberation Sans",Arial,sans-serif}
svg image{image-rendering:pixelated}
@media print{html{font-size:9.2pt}body{font-size:1rem;line-height:1.28;margin:0;padding:0;max-width:none}
.crowded{font-size:.85rem;line-height:1.2}.crowded h2{margin:.25rem 0 .05rem}.crowded p{margin:.1rem 0}
.crowded .dial{height:27mm}.crowded .small{font-size:.72rem}
.columns{flex-wrap:nowrap;gap:0 4mm}.columns>div.figure{flex:0 0 108mm}h2{margin:.45rem 0 .1rem}
.caution,.mark{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""


def exam_page(exam: Exam) -> str:
    """Full HTML page of an exam; equal exams give equal text."""
    title = _cut(exam.title, 60) or TITLE
    most, longest = _FINDINGS[_crowded(exam)]
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>",
        '<body class="crowded">' if _crowded(exam) else "<body>",
        f"<h1>{html.escape(title)}</h1>",
        *_facts(exam),
        f'<p class="mark">{html.escape(RESEARCH_USE)}</p>',
        f'<p class="finding">{html.escape(headline(exam))}</p>',
        *_paragraphs([_cut(text, longest) for text in finding_sentences(exam, most)], kind="caution"),
        '<div class="columns"><div class="figure">',
        *_picture(exam),
        *_smallest(exam),
        *_place(exam),
        "</div><div>",
        *_findings(exam),
        "</div></div>",
        *_several_masses(exam),
        *_repeats(exam),
        *_quality(exam),
        *_foot(exam),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _cut(text: str, longest: int = _LONGEST) -> str:
    """A text in one line of at most so many letters."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def _paragraphs(sentences: list[str], *, kind: str = "") -> Iterator[str]:
    named = f' class="{kind}"' if kind else ""
    for text in sentences:
        yield f"<p{named}>{html.escape(_cut(text))}</p>"


def _facts(exam: Exam) -> Iterator[str]:
    found = [f"<span><b>{name}</b> {html.escape(_cut(text, 50))}</span>" for name, text in facts(exam)]
    if found:
        yield f'<p class="facts">{"".join(found)}</p>'


def _crowded(exam: Exam) -> bool:
    return len(exam.maps) > 1 and len(exam.main.masses) > 1


def _picture(exam: Exam) -> Iterator[str]:
    """The map, as large as it is where the page has room, with its colours and what the lines are."""
    tactile_map = exam.main.tactile_map
    if tactile_map is None:
        yield f'<p class="caution">{html.escape(NO_MAP)}</p>'
        return
    height_mm = _LOWER_MM if _crowded(exam) else _PICTURE_MM[1]
    frame = Frame.within(tactile_map, width_mm=_PICTURE_MM[0], height_mm=height_mm)
    yield f'<div class="picture">{exam_picture(exam.drawn, frame, label=f"Map: {headline(exam)}")}</div>'
    yield colour_bar(exam.main)
    lines = [f"Map {exam.main_number} of {len(exam.maps)}."] if len(exam.maps) > 1 else []
    if largest(exam) is not None:
        of_all = " of all maps" if len(exam.maps) > 1 else ""
        lines.append(f"Full line: the estimated size{of_all}; dashed: the ends of its interval.")
    elif exam.disagrees:
        lines.append("Full line: the size by this map alone; dashed: the ends of its interval.")
    if marked(exam.main) is not None:
        lines.append("Cross: the rise that the reason is about.")
    view = orientation_of(tactile_map)
    sides = "; R, L: the patient's right and left; H: head, F: feet" if view.notch is not None else ""
    lines.append(f"{view.words[0].upper()}{view.words[1:]}{sides}.")
    lines += ["Striped: few readings; grey: none."] if tactile_map.counts_known else []
    size = "Life size" if frame.scale == 1.0 else f"{frame.scale:.2f} of life size"
    lines.append(f"{size} when printed at 100 %.")
    yield f'<p class="small">{html.escape(" ".join(lines))}</p>'


def _findings(exam: Exam) -> Iterator[str]:
    size = largest(exam)
    if size is None:
        yield from _paragraphs(list(nothing_sentences(exam)))
    else:
        yield f"<h2>Size{_of_mass(exam)}</h2>"
        yield size_ruler(_intervals(exam, size))
        yield from _paragraphs(list(size_sentences(exam)))
    narrowing = narrowing_sentences(exam)
    if narrowing:
        yield "<h2>How sure</h2>"
        yield from _paragraphs(narrowing)


def _smallest(exam: Exam) -> Iterator[str]:
    """What the map would have shown, by place and depth."""
    smallest, tactile_map = exam.main.document.get("smallest_lump"), exam.main.tactile_map
    if smallest is None or tactile_map is None:
        return
    yield "<h2>Smallest ball that would have shown: diameter in mm</h2>"
    yield f'<div class="repeats">{"".join(smallest_pictures(tactile_map, smallest))}</div>'


def _of_mass(exam: Exam) -> str:
    """Which of several masses a section is about."""
    masses = exam.main.masses
    return f" of mass {masses[0].number}" if len(masses) > 1 else ""


def _place(exam: Exam) -> Iterator[str]:
    """Where the lump lies, beside a clock face of the breast."""
    if not exam.main.masses:
        return
    mass, size = exam.main.masses[0], largest(exam)
    yield f'<h2>Place{_of_mass(exam)}</h2><div class="place">{breast_dial(exam.main.masses)}<div>'
    yield from _paragraphs([place_sentence(mass, INTERVAL if size is None else size["probability"])])
    if mass.probability is not None:
        which = f"map {exam.main_number}" if len(exam.maps) > 1 else "this map"
        told = f"Probability that it is a lump, by {which}: {chance_text(mass.probability)}"
        yield from _paragraphs([f"{told}, where one such exam in {1 / SHARE_WITH_LUMP:g} holds one."])
    yield from (f'<p class="small">{html.escape(text)}</p>' for text in [why_no_clock(exam)] if text)
    yield "</div></div>"


def _intervals(exam: Exam, size: Quantity) -> list[tuple[str, Quantity]]:
    """Both intervals of the largest size, with what they suppose."""
    another, alike = exam.document.get("another_exam"), exam.figures.get("between_map_sd")
    if another is None:
        return [("this exam" if exam.pooled is None else "these exams", size)]
    narrow = "exams alike" if alike is None else f"if exams differ by {100 * alike:.0f} %"
    patients = f"as exams of patients differ, {100 * another['between_map_sd']:.0f} %"
    return [(patients, size), (narrow, exam.document["max_size_mm"])]


def _several_masses(exam: Exam) -> Iterator[str]:
    masses = sorted(exam.main.masses, key=lambda one: one.number)
    if len(masses) < 2:
        return
    yield '<h2>All masses on the map</h2><table class="masses">'
    yield "<tr><th>No.</th><th>Largest diameter (interval)</th><th>Place</th></tr>"
    for mass in masses[:MOST_MASSES]:
        longest = 62 if _crowded(exam) else 160
        cells = "".join(f"<td>{html.escape(_cut(text, longest))}</td>" for text in mass_row(mass))
        yield f"<tr>{cells}</tr>"
    yield "</table>"
    if len(masses) > MOST_MASSES:
        yield from _paragraphs([f"And {len(masses) - MOST_MASSES} more."])


def _repeats(exam: Exam) -> Iterator[str]:
    """Repeat maps, small, each with its own size."""
    if len(exam.maps) < 2:
        return
    assert exam.pooled is not None
    yield f"<h2>The {len(exam.maps)} maps{'' if exam.disagrees else ' of this mass'}</h2>"
    shown = exam.maps[:MOST_REPEATS]
    yield '<div class="repeats">'
    small = small_pictures(shown, room_mm=_REPEAT_MM)
    for number, (one, picture) in enumerate(zip(shown, small, strict=True), start=1):
        size = one.document["max_size_mm"]
        alone = "no size" if size is None else f"{size['median']:.1f} mm ({size['low']:.1f} to {size['high']:.1f})"
        yield f"<figure>{picture}<figcaption>{number}: {alone}</figcaption></figure>"
    yield "</div>"
    if len(exam.maps) > MOST_REPEATS:
        yield from _paragraphs(
            [f"And {len(exam.maps) - MOST_REPEATS} more maps{'' if exam.disagrees else ', pooled too'}."]
        )


def _quality(exam: Exam) -> Iterator[str]:
    which = f" (map {exam.main_number})" if len(exam.maps) > 1 else ""
    yield f"<h2>How good the exam was{which}</h2><table>"
    for name, text in quality_rows(exam):
        yield f"<tr><th>{html.escape(name)}</th><td>{html.escape(_cut(text, 240))}</td></tr>"
    yield "</table>"


def _foot(exam: Exam) -> Iterator[str]:
    digests = [scan["sha256"][:12] for scan in exam.scans if scan.get("sha256")][:MOST_REPEATS]
    settings = exam.main.document["provenance"]
    parts = [f"tactile-bayes {__version__}", f"method {settings['settings'].get('method', 'unknown')}"]
    parts += [f"seed {settings['seed']}"] if settings.get("seed") is not None else []
    parts += [f"scan{'s' if len(digests) > 1 else ''} {', '.join(digests)}"] if digests else []
    text = f"{'; '.join(parts)}. Sizes come from simulated bodies; no scan of a person has been used. {RESEARCH_USE}"
    yield f'<p class="small">{html.escape(text)}</p>'
