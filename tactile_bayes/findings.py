"""Findings: cautions and checks on a result, as one list that every output reads, and the verdict they lead to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, Literal, get_args

from tactile_bayes.declarations import Record, from_plain, replace, set_fields
from tactile_bayes.errors import BadDataError

Severity = Literal["caution", "check"]
Verdict = Literal["sound", "doubtful", "no_answer"]

KINDS: Final[Mapping[str, Severity]] = {
    # of a scan
    "data_lost": "check",
    "recorder_noted": "check",
    "times_apart": "check",
    "poses_jump": "caution",
    "wrong_arrangement": "caution",
    "frames_contradict": "caution",
    "arrangement_unknown": "check",
    "unlike_an_exam": "caution",
    "unusual_scan": "check",
    # of a map
    "wrong_rotations": "caution",
    "rotations_unknown": "check",
    "tilted_head": "check",
    "turned_head": "check",
    "saturated_readings": "check",
    "clipped_values": "check",
    "unsettled_gains": "check",
    "low_coverage": "check",
    "lump_dragged": "caution",
    "late_poses": "caution",
    "uneven_fat": "caution",
    "slightly_uneven_fat": "check",
    "curved_skin": "check",
    "few_strokes": "check",
    "level_fitted": "check",
    # of a mass
    "side": "caution",
    "outside_calibration": "caution",
    "own_settings": "caution",
    "irregular": "check",
    "coarse_cells": "check",
    "uneven_level": "check",
    "touching": "check",
    # of several maps or visits
    "maps_disagree": "caution",
    "another_mass": "caution",
    "same_scan": "caution",
    "fat_apart": "caution",
    "outlying": "check",
    "several_masses": "check",
    "taken_as_one": "caution",
    # of a campaign
    "unnamed_mass": "check",
    "own_axes": "check",
    "after_excision": "caution",
}
"""Severity by kind. Caution: the result may be off by more than its interval. Check: to be looked at first."""
SEVERITIES: Final[tuple[Severity, ...]] = get_args(Severity)
LEADS: Final[Mapping[Severity, str]] = {"caution": "CAUTION: ", "check": "To check: "}
"""First words of a finding's line, in every output."""


class Finding(Record):
    """Something that speaks against a result."""

    severity: Severity  #: How much it weighs, by its kind.
    kind: str  #: Which finding it is.
    text: str  #: One sentence in a clinician's words, without capital and full stop, and without a name of an option.
    remedy: str
    """The laboratory's terms where `text` leaves them out, and what to do at the command line; may be empty."""
    on_paper: str  #: The same for a reader of the page, who has no command line.
    about: str  #: What it is about, where a result is of several: "map 2", "visit 1"; else empty.

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise BadDataError(f"finding of unknown kind {self.kind!r}", way_out=f"one of {', '.join(KINDS)}")
        set_fields(self, severity=KINDS[self.kind])

    def labelled(self, about: str) -> Finding:
        """The finding with the map or visit that it is about, of several."""
        return replace(self, about=f"{about}, {self.about}" if self.about else about)

    def sentence(self, *, paper: bool = False) -> str:
        """The finding with its remedy: for the command line, or for paper."""
        remedy = self.on_paper if paper else self.remedy
        subject = f"{self.about}: " if self.about else ""
        return f"{subject}{self.text}{f'; {remedy}' if remedy else ''}"


def finding(kind: str, text: str, remedy: str = "", on_paper: str = "", about: str = "") -> Finding:
    """A `Finding` with the severity of its kind, a key of `KINDS`."""
    return Finding(KINDS.get(kind, "check"), kind, text, remedy, on_paper, about)


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Cautions before checks, otherwise in their order, each once."""
    return tuple(sorted(dict.fromkeys(findings), key=lambda finding: finding.severity != "caution"))


def verdict(findings: Iterable[Finding], *, answered: bool) -> Verdict:
    """Sound, doubtful (a caution stands) or no answer."""
    if not answered:
        return "no_answer"
    return "doubtful" if any(one.severity == "caution" for one in findings) else "sound"


def finding_lines(findings: Iterable[Finding], severity: Severity | None = None, *, paper: bool = False) -> list[str]:
    """A line for each finding, cautions first; with `severity` those of one severity alone."""
    return [f"{LEADS[one.severity]}{one.sentence(paper=paper)}." for one in _said_once(findings, severity)]


def finding_summary(findings: Iterable[Finding], severity: Severity, *, most: int | None = None) -> list[str]:
    """One line of the findings of one severity, or of the first and the number of the others; empty without any."""
    texts = [one.sentence() for one in _said_once(findings, severity)]
    return [f"{LEADS[severity]}{first_of(texts, most or len(texts), '; ')}."] if texts else []


def _said_once(findings: Iterable[Finding], severity: Severity | None) -> Iterator[Finding]:
    """Findings of a severity, cautions first; those that differ only in what they are about as one about all of it."""
    about: dict[tuple[Finding, bool], list[str]] = {}
    for one in by_severity(findings):
        if severity in (None, one.severity):
            about.setdefault((replace(one, about=""), bool(one.about)), []).append(one.about)
    for (one, _), (*others, last) in about.items():
        yield replace(one, about=f"{', '.join(others)} and {last}" if others else last)


def findings_in(document: object) -> tuple[Finding, ...]:
    """Findings of a file's plain data; `BadDataError` for anything else."""
    return from_plain(tuple[Finding, ...], document, where="findings")


def counted(count: int, noun: str) -> str:
    """The number with its noun, in the plural where it is not one."""
    return f"{count} {noun if count == 1 else f'{noun}es' if noun.endswith('s') else f'{noun}s'}"


def first_of(texts: Sequence[str], most: int, separator: str = ", ") -> str:
    """The first texts in a line, and the number of the others."""
    more = f" (and {len(texts) - most} more)" if len(texts) > most else ""
    return f"{separator.join(texts[:most])}{more}"


def first_lines(lines: Sequence[str], most: int, rest: str) -> list[str]:
    """The first lines, and one with the number of the others and what to say of the `rest`."""
    return [*lines[:most], *([f"And {len(lines) - most} more{rest}"] if len(lines) > most else [])]


def capitalised(text: str) -> str:
    """The text with a capital letter, to begin a sentence."""
    return f"{text[0].upper()}{text[1:]}"
