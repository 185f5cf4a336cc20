"""Comparison of a mass's size at several visits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import door, plain, sequence_of
from tactile_bayes.api.draws import Draws
from tactile_bayes.api.estimates import SizeEstimate, estimated, of_one_mass, settings_of
from tactile_bayes.api.maps import Map
from tactile_bayes.api.paths import PathLike, path_of
from tactile_bayes.errors import UsageError
from tactile_bayes.findings import Finding, Verdict, finding_lines, verdict
from tactile_bayes.pipeline.compared import ComparedOutcome, compare_answers, drawn_maps
from tactile_bayes.pipeline.comparing import GROWN_BY, Comparing, times_of
from tactile_bayes.pipeline.settings import refuse_checkpoint
from tactile_bayes.presets import REGISTRATION_MM, RESEARCH_USE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tactile_bayes.size.visits import Change


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """The size of one mass at several visits, and its change from the first to the last.

    Parameters
    ----------
    outcome
        The comparison and its JSON object.
    visits
        The estimates of each visit's maps alone.
    probability
        Of the intervals that are shown where none is asked for.
    """

    outcome: ComparedOutcome
    visits: tuple[tuple[SizeEstimate, ...], ...]
    probability: float

    @property
    def _change(self) -> Change | None:
        joint = self.outcome.compared.joint
        return None if joint is None else joint.change(0, len(self.visits) - 1)

    @property
    def status(self) -> str:
        """``"compared"``, ``"not_one_mass"`` or ``"no_estimate"``."""
        return self.outcome.compared.status

    @property
    def why(self) -> str:
        """Why nothing is compared; empty where something is."""
        return self.outcome.compared.reason

    @property
    def change_percent(self) -> Draws | None:
        """Change of the diameter in percent; None where nothing is compared."""
        change = self._change
        if change is None:
            return None
        percent = 100.0 * np.expm1(change.log_ratio)
        return Draws(np.atleast_2d(percent), "%", self.probability, change.replicates)

    @property
    def sizes_mm(self) -> tuple[Draws, ...]:
        """Largest diameter at each visit; empty where nothing is compared."""
        joint = self.outcome.compared.joint
        if joint is None:
            return ()
        drawn = np.exp(joint.log_size)
        return tuple(Draws(np.atleast_2d(one), "mm", self.probability, joint.replicates) for one in drawn)

    def probability_grown(self, share: float = 0.0) -> float | None:
        """Probability that the diameter has grown by more than a share of it (0.2: by more than 20 %)."""
        change = self._change
        return None if change is None else change.probability_above(share)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What speaks against the comparison, cautions first."""
        return self.outcome.compared.findings

    @property
    def verdict(self) -> Verdict:
        """``"sound"``, ``"doubtful"`` where a caution stands, or ``"no_answer"`` where nothing is compared."""
        return verdict(self.findings, answered=self._change is not None)

    @property
    def growth(self) -> str | None:
        """``"grown"``, ``"shrunk"`` or ``"no_change_shown"``; None where nothing is compared."""
        changes = self.document["changes"]
        return str(changes[-1]["verdict"]) if changes else None

    @property
    def document(self) -> dict[str, Any]:
        """What ``compare --json`` prints."""
        return self.outcome.document

    @property
    def text(self) -> str:
        """What ``compare`` prints."""
        from tactile_bayes.report.compare_text import compare_summary

        return compare_summary(self.document)

    @property
    def full_text(self) -> str:
        """What ``compare -v`` prints."""
        from tactile_bayes.report.compare_text import compare_text

        return compare_text(self.document)

    @door
    def plot(self, path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the visits' maps, their difference and the change; with a path also write it."""
        from tactile_bayes.report.compare_figure import draw_comparison

        maps = [[one.outcome.tactile_map for one in visit] for visit in self.visits]
        drawn = drawn_maps(maps, [[one.answer for one in visit] for visit in self.visits])
        return draw_comparison(self.outcome.compared, self.document, drawn, path_of(path), force=force)

    def __repr__(self) -> str:
        cautions = finding_lines(self.findings, "caution", paper=True)
        words = f"not compared: {self.why}" if self.growth is None else f"{self.change_percent}, {self.growth}"
        return f"<Comparison {' '.join([*cautions, f'of {len(self.visits)} visits: {words}'])}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(self.text)}</pre><p><small>{escape(RESEARCH_USE)}</small></p>"


@door
def compare(
    first: Any,
    second: Any,
    *more: Any,
    days: Sequence[float] | None = None,
    dates: Sequence[str] | None = None,
    grown_by: Sequence[float] = GROWN_BY,
    same_mass: bool = False,
    registration_mm: float = REGISTRATION_MM,
    **settings: Any,
) -> Comparison:
    """Compare the size of a mass at two visits and more.

    Parameters
    ----------
    first, second, *more
        A visit each, in order of time: a map, a path or an estimate, or a list of them.
    days
        Days from the first visit to each later one; with them growth rates are told.
    dates
        The visits' dates in place of days, such as ``["2026-01-15", "2026-04-20"]``.
    grown_by
        Shares of the diameter (0.2 for 20 %) that the probability of a larger growth is told for.
    same_mass
        Say that the visits are of one mass where landmarks are missing, or place it too far apart.
    registration_mm
        SD each way of one mass's place between visits.
    **settings
        As of `estimate`; estimates that are given keep their own.

    Raises
    ------
    UsageError
        When a visit has no map, a map is given twice, or days do not fit.
    BadDataError
        As of `estimate`, and when the maps were normalised in several ways.
    """
    used = settings_of(settings)
    refuse_checkpoint(used)
    times = times_of(
        None
        if days is None
        else [plain(day) for day in sequence_of("days", days, "numbers, one for each later visit")],
        None if dates is None else sequence_of("dates", dates, "dates, one for each visit"),
    )
    shares = tuple(plain(one) for one in sequence_of("grown_by", grown_by, "shares, such as 0.2 for 20 %"))
    comparing = Comparing(times, shares, same_mass, plain(registration_mm))
    comparing.check_visits(2 + len(more))
    visits = tuple(_visit(one, settings) for one in (first, second, *more))
    prints = [one.outcome.tactile_map.fingerprint for visit in visits for one in visit]
    if len(set(prints)) < len(prints):
        raise UsageError("a map is given twice; give each map once, at its own visit")
    same = iter(of_one_mass([one for visit in visits for one in visit]))
    visits = tuple(tuple(next(same) for _ in visit) for visit in visits)
    names = [[one.name or f"visit {v} map {i}" for i, one in enumerate(visit, 1)] for v, visit in enumerate(visits, 1)]
    answers = [[one.answer for one in visit] for visit in visits]
    outcome = compare_answers(answers, used, comparing=comparing, names=names, inputs={})
    return Comparison(outcome, visits, used.interval)


def _visit(given: Any, settings: dict[str, Any]) -> tuple[SizeEstimate, ...]:
    """Estimates of a visit's maps."""
    several = (
        [given] if isinstance(given, str | Path | Map | SizeEstimate) or not isinstance(given, Sequence) else given
    )
    return estimated(several, settings)
