"""Growth of masses between visits, as `compare` told it: rows of a table and a section of a page."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from tactile_bayes.findings import Finding, finding_lines, findings_in
from tactile_bayes.records import dataclass

HEADS: Final = ("mass", "visits", "days", "earlier mm", "later mm", "change", "")
_VERDICTS: Final = {"grown": "grown", "shrunk": "shrunk", "no_change_shown": "no change shown"}
_NOTE: Final = (
    "Change of the largest diameter from the first visit; intervals in brackets. What the body hides "
    "from all maps cancels in it. It is no part of the errors against excision, which are of the last visit."
)


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """Change of one mass from its first visit to a later one.

    Parameters
    ----------
    patient, mass, earlier, later
        Codes; `later` is blank where the visits could not be compared.
    status, reason
        As `compare` has them, or ``failed``.
    days
        Between the visits; None where it is not known.
    sizes_mm
        Largest size at both visits: median, ends and probability; empty without a comparison.
    percent
        Change of the diameter, likewise; None without one.
    verdict
        ``grown``, ``shrunk`` or ``no_change_shown``; empty without one.
    findings
        What speaks against the comparison.
    link
        File of the comparison from the page's folder; empty for none.
    """

    patient: str
    mass: str
    earlier: str
    later: str
    status: str
    reason: str = ""
    days: float | None = None
    sizes_mm: tuple[Mapping[str, float], ...] = ()
    percent: Mapping[str, float] | None = None
    verdict: str = ""
    findings: tuple[Finding, ...] = ()
    link: str = ""

    @property
    def words(self) -> str:
        """What became of the mass, or why nothing is known of it."""
        told = _VERDICTS.get(self.verdict, f"not compared: {self.reason}")
        return ". ".join([told, *finding_lines(self.findings, paper=True)])


def of_document(patient: str, mass: str, visits: Sequence[str], document: Mapping[str, Any], link: str) -> list[Growth]:
    """Rows of one mass from the JSON object of its comparison.

    Parameters
    ----------
    visits
        Codes in order of time.
    """
    if document["status"] != "compared":
        reason, last = str(document["reason"]), visits[-1]
        return [Growth(patient, mass, visits[0], last, str(document["status"]), reason, link=link)]
    found = document["visits"]
    return [
        Growth(
            patient, mass, visits[0], visits[change["later"] - 1], "compared", days=found[change["later"] - 1]["day"],
            sizes_mm=(found[0]["max_size_mm"], found[change["later"] - 1]["max_size_mm"]), percent=change["percent"],
            verdict=change["verdict"], findings=findings_in(document["findings"]), link=link,
        )
        for change in document["changes"]
    ]  # fmt: skip


def growth_line(rows: Sequence[Growth], table: str) -> str:
    """All rows in one sentence; empty without any."""
    if not rows:
        return ""
    counts = {words: sum(row.verdict == name for row in rows) for name, words in _VERDICTS.items()}
    counts["not compared"] = sum(not row.verdict for row in rows)
    masses = len({(row.patient, row.mass) for row in rows})
    told = ", ".join(f"{count} {words}" for words, count in counts.items() if count)
    return f"growth of {masses} mass{'es' * (masses > 1)} with several visits: {told} ({table})"


def growth_section(rows: Sequence[Growth]) -> Iterator[str]:
    """Section of a page; nothing without rows. Every text is escaped."""
    if not rows:
        return
    yield '<section class="growth"><h2>Growth between visits</h2>'
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in HEADS)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in _cells(row))}</tr>" for row in rows)
    yield f'<div class="wide" tabindex="0"><table><tr>{heads}</tr>{lines}</table></div>'
    yield f'<p class="note">{html.escape(_NOTE)}</p></section>'


def _cells(row: Growth) -> list[str]:
    name = html.escape(f"{row.patient} {row.mass}")
    sizes = [f"{q['median']:.1f} <small>[{q['low']:.1f}, {q['high']:.1f}]</small>" for q in row.sizes_mm] or ["", ""]
    q = row.percent
    change = "" if q is None else f"{q['median']:+.0f} % <small>[{q['low']:+.0f}, {q['high']:+.0f}]</small>"
    return [
        f'<a href="{html.escape(row.link)}">{name}</a>' if row.link else name,
        html.escape(f"{row.earlier} to {row.later}"),
        "" if row.days is None else f"{row.days:g}",
        *sizes,
        change,
        html.escape(row.words),
    ]
