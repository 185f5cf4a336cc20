"""Findings: what speaks against a result, as one list that every output reads, and the verdict that it leads to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final, Literal

from tactile_bayes.errors import BadDataError
from tactile_bayes.records import dataclass

Severity = Literal["caution", "check"]
Verdict = Literal["sound", "doubtful", "no_answer"]

KINDS: Final[Mapping[str, Severity]] = {
    # of a scan and its map
    "uneven_fat": "caution",
    "slightly_uneven_fat": "check",
    "lump_dragged": "caution",
    "late_poses": "caution",
    "curved_skin": "check",
    "few_strokes": "check",
    # of a mass
    "side": "caution",
    "outside_calibration": "caution",
    "irregular": "check",
}
"""Severity by kind. Caution: the result may be off by more than its interval. Check: look at it first."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that speaks against a result.

    Parameters
    ----------
    kind
        A key of `KINDS`.
    text
        One plain sentence with its figures, without capital and full stop, and without a name of an option.
    remedy
        What to do about it at the command line; may name options and commands. Empty where nothing helps.
    on_paper
        The same for a reader of the page, who has no command line.
    about
        What it is about, where a result is of several: "map 2", "visit 1"; else empty.
    """

    kind: str
    text: str
    remedy: str = ""
    on_paper: str = ""
    about: str = ""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise BadDataError(f"finding of unknown kind {self.kind!r}", way_out=f"one of {', '.join(KINDS)}")

    @property
    def severity(self) -> Severity:
        """How much it weighs, by its kind."""
        return KINDS[self.kind]

    def at(self, about: str) -> Finding:
        """The same finding, about one of several maps or visits."""
        return replace(self, about=about)

    def sentence(self, *, paper: bool = False) -> str:
        """The finding with its remedy: for the command line, or for paper."""
        remedy = self.on_paper if paper else self.remedy
        subject = f"{self.about}: " if self.about else ""
        return f"{subject}{self.text}{f'; {remedy}' if remedy else ''}"


def by_weight(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Cautions before checks, otherwise in their order, each once."""
    each = list(dict.fromkeys(findings))
    return tuple(sorted(each, key=lambda one: one.severity != "caution"))


def verdict(findings: Iterable[Finding], *, answered: bool) -> Verdict:
    """Sound, doubtful (a caution stands) or no answer."""
    if not answered:
        return "no_answer"
    return "doubtful" if any(one.severity == "caution" for one in findings) else "sound"
