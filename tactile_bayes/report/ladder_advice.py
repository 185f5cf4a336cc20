"""One paragraph at the end of a trade-off: which setting is enough, and what would help instead."""

from __future__ import annotations

import math
from collections.abc import Iterator

from tactile_bayes.report.size_text import SOURCES
from tactile_bayes.studies.cost_ladder import Ladder, PooledRow


def advice(ladder: Ladder) -> list[str]:
    """What to choose, why more buys nothing, and what moves the answer more than any arithmetic."""
    if ladder.reference.answer is None:
        return [_without_number(ladder)]
    lines = [f"Advice: {_enough(ladder)}", *_moving(ladder), *_disagreeing(ladder), *_pooled(ladder)]
    return list(lines)


def _enough(ladder: Ladder) -> str:
    best, default = ladder.enough(), ladder.default
    half = f"the interval's half width is {_reference_half(ladder):.1f} mm"
    if best is None:
        return (
            f"no setting has its interval ends within {ladder.tolerance_mm:g} mm of the reference; the default's are "
            f"{default.off.ends:.2g} mm off, and {half}."
        )
    took = f"{best.label}{' (the default)' if best.default else ''}: {best.seconds:.2f} s"
    text = f"{took}, interval ends within {max(best.off.ends, 0.01):.2g} mm; more buys nothing: {half}"
    shares = ladder.reference.answer.shares if ladder.reference.answer else {}
    if not shares:
        return f"{text}."
    source, share = max(shares.items(), key=lambda one: one[1])
    if source == "map":
        return f"{text}, and {share:.0f} % of its variance is the map's errors: scan more slowly or with more lines."
    rest = 100.0 - shares.get("map", 0.0)
    return f"{text}, and {rest:.0f} % of its variance is no error of the map ({share:.0f} % is {SOURCES[source]})."


def _reference_half(ladder: Ladder) -> float:
    return float("nan") if ladder.reference.answer is None else ladder.reference.answer.half_width_mm


def _moving(ladder: Ladder) -> Iterator[str]:
    """The settings whose ends lie further off than the tolerance."""
    found = [one for one in ladder.rows if one.off.ends > ladder.tolerance_mm]
    if found:
        moved = "; ".join(f"{one.label} {one.off.ends:.1f} mm" for one in found)
        yield f"What moves the ends more than {ladder.tolerance_mm:g} mm: {moved}."


def _disagreeing(ladder: Ladder) -> Iterator[str]:
    """Settings that find nothing on a map that has a size by default."""
    silent = [one.label for one in ladder.rows if one.answer.reported is None]
    if silent:
        yield f"No size by {', '.join(silent)}."


def _pooled(ladder: Ladder) -> Iterator[str]:
    sized = [one for one in ladder.pooled if one.answer.reported is not None]
    if len(sized) > 1:
        first, last = sized[0], sized[-1]
        yield (
            f"{last.maps} maps pooled instead of {first.maps} change the half width from "
            f"{first.answer.half_width_mm:.1f} to {last.answer.half_width_mm:.1f} mm for "
            f"{last.cpu_s - first.cpu_s:.2f} s of CPU{_another(first, last)}."
        )


def _another(first: PooledRow, last: PooledRow) -> str:
    if not math.isfinite(first.another_half_mm + last.another_half_mm):
        return ""
    return f", and from {first.another_half_mm:.1f} to {last.another_half_mm:.1f} mm if exams differ as in the paper"


def _without_number(ladder: Ladder) -> str:
    """Nothing to compare: what the settings say of a lump."""
    sized = [one for one in ladder.rows if one.answer.reported is not None]
    chances = [one.answer.probability for one in ladder.rows if one.answer.probability is not None]
    span = f" (probability of one {_span(min(chances), max(chances))})" if chances else ""
    if not sized:
        return f"Advice: no setting gives a size{span}; more accuracy changes no answer, another scan may."
    some = ", ".join(one.label for one in sized)
    return (
        f"Advice: the default gives no size, {len(sized)} of {len(ladder.rows)} settings do ({some}){span}: "
        "the map is at the limit of what can be sized. Believe none of them; scan the place again."
    )


def _span(low: float, high: float) -> str:
    one, other = (f"{value:.2g}" if value >= 0.001 else "below 0.001" for value in (low, high))
    return one if one == other else f"{one} to {other}"
