"""Pages from templates, and the contact sheet of a campaign."""

from __future__ import annotations

import base64
import hashlib
import heapq
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from tactile_bayes.declarations import Record, field
from tactile_bayes.findings import SEVERITIES, Finding, finding_lines
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import Growth

if TYPE_CHECKING:
    from jinja2 import Environment


# --- Pages from templates: every text is escaped, and all have one style sheet and one content policy.

TEMPLATES: Final = Path(__file__).with_name("templates")


def page(kind: str, *, title: str, images: str = "data:", script_sha256: str = "", **values: Any) -> str:
    """A page of the kind "exam", "trial" or "campaign".

    `images` is where its pictures may come from; `script_sha256` is of the one script that may run, in base 64.
    """
    scripts = f"; script-src 'sha256-{script_sha256}'" if script_sha256 else ""
    template = _environment().get_template(f"{kind}.html")
    return template.render(kind=kind, title=title, images=images, scripts=scripts, **values)


def cut(text: str, longest: int = 400) -> str:
    """A text in one line of at most so many letters."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


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
    made.filters["cut"] = cut
    return made


# --- Contact sheet of a campaign: every exam on one self-contained page, worst first, with filters that need no server.

FAILED, UNSIZED, SIZED = "failed", "without a size", "sized"
_CLASSES: Final = {FAILED: "failed", UNSIZED: "without", SIZED: "sized"}


class Card(Record, eq=False):
    """One exam on the page."""

    name: str
    status: str
    """`FAILED`, `UNSIZED` or `SIZED`."""
    facts: tuple[str, ...] = ()  #: What else the table says of the exam.
    reason: str = ""  #: Why there is no size; empty where there is one.
    size: Quantity | None = None  #: Largest size, mm; None without one.
    findings: tuple[Finding, ...] = ()  #: What speaks against the exam.
    thumbnail: bytes | str | None = None
    """PNG of the map, or the name of its file from the page's folder; None without one."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Files in the exam's folder, by the words of their links."""

    @property
    def kind(self) -> str:
        """Class of the card in the style sheet."""
        return _CLASSES[self.status]

    @property
    def why(self) -> str:
        """Why there is no size; a failure's reason says so itself."""
        return self.reason if self.status == FAILED else f"{self.status}: {self.reason}"

    @property
    def told(self) -> list[tuple[str, str]]:
        """Severity and text of each finding."""
        return [(one, text) for one in SEVERITIES for text in finding_lines(self.findings, one, paper=True)]

    @property
    def alt(self) -> str:
        """What the picture shows, for those who do not see it."""
        ring = "no lump ringed" if self.size is None else f"a ring around the lump of {self.size.median:.1f} mm"
        return f"Map of {self.name}, {ring}"

    @property
    def source(self) -> str:
        """Address of the picture; empty without one."""
        if self.thumbnail is None or isinstance(self.thumbnail, str):
            return quote(self.thumbnail or "")
        return f"data:image/png;base64,{base64.b64encode(self.thumbnail).decode('ascii')}"

    @property
    def badness(self) -> tuple[int, int, float]:
        """Sort key: failures, exams without a size, cautions, checks, and wide intervals come first."""
        wide = 0.0 if self.size is None else (self.size.high - self.size.low) / self.size.median
        order = (FAILED, UNSIZED, SIZED).index(self.status)
        return order, -sum(10 if one.severity == "caution" else 1 for one in self.findings), -wide


def worst(cards: Iterable[Card], most: int) -> list[Card]:
    """Up to `most` cards, those to be looked at first before the others."""
    return heapq.nsmallest(most, cards, key=lambda card: (card.badness, card.name))


def campaign_html(
    cards: Sequence[Card],
    *,
    lines: Sequence[str],
    links: Mapping[str, str],
    version: str,
    growth: Sequence[Growth] = (),
) -> str:
    """Full page; nothing is loaded but thumbnails beside it, and the only script is its filter.

    `cards` are in the order in which they are shown, `lines` the summary in sentences, `links` the files beside the
    page by the words of their links, `growth` that of masses with several visits.
    """
    script = "\n" + (TEMPLATES / "campaign.js").read_text(encoding="utf-8")
    return page(
        "campaign",
        title="Exams of a campaign",
        images="'self' file:" if any(isinstance(card.thumbnail, str) for card in cards) else "data:",
        script_sha256=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        script=script,
        research_use=RESEARCH_USE,
        lines=lines,
        beside=links,
        growth=growth,
        counts={status: sum(card.status == status for card in cards) for status in _CLASSES},
        cards=cards,
        version=version,
    )
