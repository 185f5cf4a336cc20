"""Contact sheet of a campaign: every exam on one self-contained page, worst first, with filters that need no server."""

from __future__ import annotations

import base64
import hashlib
import heapq
import html
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final
from urllib.parse import quote

from tactile_bayes.declarations import Record, field
from tactile_bayes.findings import SEVERITIES, Finding, finding_lines
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import Growth, growth_section

FAILED, UNSIZED, SIZED = "failed", "without a size", "sized"
_STYLE = """
:root{color-scheme:light dark;--ink:#1b1b1b;--paper:#fff;--soft:#5a5a5a;--line:#d5d5d5;--mark:#fff3d6;--doubt:#8f3d0c}
@media(prefers-color-scheme:dark){:root{--ink:#e6e6e6;--paper:#181a1b;--soft:#a8a8a8;--line:#444;--mark:#40331a;
--doubt:#f0a878}a{color:#8ab4f8}}
body{font:15px/1.45 system-ui,sans-serif;color:var(--ink);background:var(--paper);margin:1.5rem auto;padding:0 1.2rem;
max-width:90rem}
h1{font-size:1.5rem;margin:0 0 .2rem}h2{font-size:1rem;margin:0;overflow-wrap:anywhere}p{margin:.25rem 0}
.mark{background:var(--mark);padding:.35rem .7rem;border-left:4px solid #c8641e}
.note{color:var(--soft);font-size:.84rem;overflow-wrap:anywhere}
form{display:flex;flex-wrap:wrap;gap:.4rem 1.2rem;margin:.8rem 0;align-items:center}form[hidden]{display:none}
input[type=search]{width:16rem;max-width:100%}
main{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(19rem,100%),1fr));gap:.8rem}
article{border:1px solid var(--line);border-top:4px solid #4a7d4f;padding:.6rem .7rem;break-inside:avoid;
content-visibility:auto;contain-intrinsic-size:auto 20rem}
article.failed{border-top-color:#c33}article.without{border-top-color:#c8641e}article[hidden]{display:none}
img{display:block;margin:.35rem 0;max-width:100%;image-rendering:pixelated}ul{margin:.25rem 0;padding-left:1.1rem}
li,.why{font-size:.86rem;overflow-wrap:anywhere}.caution{color:var(--doubt)}.size{font-size:1.12rem;font-weight:600}
.growth{margin:.8rem 0}.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.86rem;margin:.4rem 0}
th,td{padding:.2rem .9rem .2rem 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--line)}
td small{color:var(--soft);white-space:nowrap}
@media print{form{display:none}}
"""
_SCRIPT = """
const form = document.querySelector("form"), cards = [...document.querySelectorAll("article")];
const shown = document.getElementById("shown");
let texts = null;
function filter() {
  const words = form.words.value.toLowerCase().split(/\\s+/).filter(Boolean);
  texts ??= cards.map(card => card.textContent.toLowerCase());
  let count = 0;
  for (const [i, card] of cards.entries()) {
    card.hidden = !(words.every(word => texts[i].includes(word)) &&
      (!form.status.value || card.dataset.status === form.status.value) &&
      (!form.flagged.checked || card.dataset.flagged === "yes"));
    count += !card.hidden;
  }
  shown.textContent = count + " of " + cards.length + " shown";
}
form.hidden = false;
form.addEventListener("input", filter);
form.addEventListener("submit", event => event.preventDefault());
shown.textContent = cards.length + " of " + cards.length + " shown";
"""
_LEGEND: Final = (
    "Sizes: median of the largest diameter and, in brackets, its credible interval. Ring: the ellipse of the estimated "
    "size. Colours of each map span its own values. Maps with landmarks are seen facing the patient, head up, the "
    "patient's left on the right; others from outside, y up, x to the left; imported grids as their file reads."
)
_CLASSES: Final = {FAILED: "failed", UNSIZED: "without", SIZED: "sized"}


class Card(Record, eq=False):
    """One exam on the page.

    Parameters
    ----------
    name, facts
        Of the exam: its name, and what else the table says of it.
    status
        `FAILED`, `UNSIZED` or `SIZED`.
    reason
        Why there is no size; empty where there is one.
    size
        Median, ends, probability and SD of the largest size, mm; None without one.
    findings
        What speaks against the exam.
    thumbnail
        PNG of the map, or the name of its file from the page's folder; None without one.
    links
        Files in the exam's folder, by the words of their links.
    """

    name: str
    status: str
    facts: tuple[str, ...] = ()
    reason: str = ""
    size: Mapping[str, float] | None = None
    findings: tuple[Finding, ...] = ()
    thumbnail: bytes | str | None = None
    links: Mapping[str, str] = field(default_factory=dict)

    @property
    def badness(self) -> tuple[int, int, float]:
        """Sort key: failures, exams without a size, cautions, checks, and wide intervals come first."""
        wide = 0.0 if self.size is None else (self.size["high"] - self.size["low"]) / self.size["median"]
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
    """Full page; every text is escaped, nothing is loaded but thumbnails beside it, and the only script is its filter.

    Parameters
    ----------
    cards
        In the order in which they are shown.
    lines
        Summary, in sentences.
    links
        Files beside the page, by the words of their links.
    version
        Of the program.
    growth
        Of masses with several visits.
    """
    script_hash = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
    images = "'self' file:" if any(isinstance(card.thumbnail, str) for card in cards) else "data:"
    policy = f"default-src 'none'; img-src {images}; style-src 'unsafe-inline'; script-src 'sha256-{script_hash}'"
    title = "Exams of a campaign"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{title}</h1>",
        f'<p class="mark">{html.escape(RESEARCH_USE)}</p>',
        *(f"<p>{html.escape(line)}</p>" for line in lines),
        f"<p>{_links(links)}</p>",
        *growth_section(growth),
        f'<p class="note">{html.escape(_LEGEND)}</p>',
        *_filters(cards),
        "<main>",
        *(part for card in cards for part in _card(card)),
        "</main>",
        f'<p class="note">tactile-bayes {html.escape(version)}. {html.escape(RESEARCH_USE)}</p>',
        f"<script>{_SCRIPT}</script></body></html>",
    ]
    return "\n".join(parts) + "\n"


def _filters(cards: Sequence[Card]) -> Iterator[str]:
    """The form that the script shows; without scripts the page shows every exam."""
    counts = {status: sum(card.status == status for card in cards) for status in _CLASSES}
    options = "".join(f'<option value="{name}">{name} ({count})</option>' for name, count in counts.items())
    yield (
        '<form hidden><label>Find <input type="search" name="words" placeholder="patient, visit, reason..."></label>'
        f'<label>Show <select name="status"><option value="">all ({len(cards)})</option>{options}</select></label>'
        '<label><input type="checkbox" name="flagged"> with cautions or checks</label>'
        '<span id="shown" role="status"></span></form>'
    )


def _card(card: Card) -> Iterator[str]:
    flagged = "yes" if card.findings else "no"
    yield f'<article class="{_CLASSES[card.status]}" data-status="{card.status}" data-flagged="{flagged}">'
    yield f"<h2>{html.escape(card.name)}</h2>"
    yield f'<p class="note">{html.escape(", ".join(card.facts))}</p>'
    if card.thumbnail is not None:
        yield f'<img loading="lazy" alt="{html.escape(_alt(card))}" src="{_source(card.thumbnail)}">'
    yield _size(card)
    if card.findings:
        told = [(one, text) for one in SEVERITIES for text in finding_lines(card.findings, one, paper=True)]
        yield "<ul>" + "".join(f'<li class="{kind}">{html.escape(text)}</li>' for kind, text in told) + "</ul>"
    if card.links:
        yield f'<p class="note">{_links(card.links)}</p>'
    yield "</article>"


def _alt(card: Card) -> str:
    """What the picture shows, for those who do not see it."""
    ring = "no lump ringed" if card.size is None else f"a ring around the lump of {card.size['median']:.1f} mm"
    return f"Map of {card.name}, {ring}"


def _source(thumbnail: bytes | str) -> str:
    if isinstance(thumbnail, str):
        return html.escape(quote(thumbnail))
    return f"data:image/png;base64,{base64.b64encode(thumbnail).decode('ascii')}"


def _size(card: Card) -> str:
    if card.size is None:
        why = card.reason if card.status == FAILED else f"{card.status}: {card.reason}"  # a failure's reason says so
        return f'<p class="why">{html.escape(why)}</p>'
    q = card.size
    interval = f"{100 * q['probability']:g} %: {q['low']:.1f} to {q['high']:.1f} mm"
    return f'<p><span class="size">{q["median"]:.1f} mm</span> ({html.escape(interval)})</p>'


def _links(links: Mapping[str, str]) -> str:
    return " · ".join(f'<a href="{html.escape(target)}">{html.escape(words)}</a>' for words, target in links.items())
