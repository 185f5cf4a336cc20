"""Reports of `tradeoff estimate` and `tradeoff map` as text: the table of settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import groupby

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.ladder_advice import advice
from tactile_bayes.studies.cost_ladder import Ladder, PooledRow, Priced
from tactile_bayes.studies.size_answers import SIZE, SizeAnswer

_NAME, _REASON = 42, 100


def ladder_text(ladder: Ladder) -> str:
    """The whole report; advice and the research-use line come last."""
    lines = [_head(ladder)]
    for axis, rows in groupby(ladder.rows, key=lambda one: one.axis):
        lines += [axis, *(_row(one, ladder) for one in rows)]
    if ladder.pooled:
        lines += ["maps pooled", *map(_pooled, ladder.pooled)]
    return "\n".join([*lines, "", *_notes(ladder), "", *advice(ladder), RESEARCH_USE])


def _head(ladder: Ladder) -> str:
    parts = "".join(f"{f'{name} s':>12}" for name in ladder.default.cpu_s)
    what = "size mm" if sized(ladder) else "sigma mm"
    return f"{'':<{_NAME}}{parts}{what:>10}{'95 % interval':>18}{'ends off':>10}{'widths off':>12}"


def sized(ladder: Ladder) -> bool:
    """Whether what is reported is a size; without a calibration it is a width."""
    return any(SIZE in one.answer.quantities for one in ladder.rows) or ladder.reference.answer is None


def _row(one: Priced, ladder: Ladder) -> str:
    name = f"{'*' if one.default else ' '} {one.label}"
    cost = "".join(f"{seconds:>12.3f}" for seconds in one.cpu_s.values())
    if one.answer.reported is None:
        return f"{name:<{_NAME}}{cost}  {_no_number(one.answer)}"
    off = f"{_mm(one.off.ends):>10}{_mm(one.off.width_ends):>12}"
    note = "" if SIZE in one.answer.quantities or not sized(ladder) else "  (a width: this map has no size)"
    if one.answer.method == "ensemble" and "ensemble" not in one.label:
        note += "  (by MCMC: importance sampling failed)"
    return f"{name:<{_NAME}}{cost}{_number(one.answer)}{off}{note}"


def _number(answer: SizeAnswer) -> str:
    found = answer.reported
    assert found is not None
    return f"{found.median:>10.2f}{f'{found.low:.2f} to {found.high:.2f}':>18}"


def _no_number(answer: SizeAnswer) -> str:
    """Why there is no number, with the probability of a lump where the reason does not name one."""
    reason = answer.reason if len(answer.reason) <= _REASON else f"{answer.reason[: _REASON - 3]}..."
    if answer.probability is None or "probability" in reason:
        return reason
    return f"probability of a lump {answer.probability:.2g}: {reason}"


def _mm(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def _pooled(one: PooledRow) -> str:
    name = f"  {one.maps} map{'s' if one.maps > 1 else ''}"
    if one.answer.reported is None:
        return f"{name:<{_NAME}}{one.cpu_s:>12.3f}  {_no_number(one.answer)}"
    half = f"half width {one.answer.half_width_mm:.2f} mm"
    if math.isfinite(one.another_half_mm):
        half += f", {one.another_half_mm:.2f} if exams differ as in the paper"
    return f"{name:<{_NAME}}{one.cpu_s:>12.3f}{_number(one.answer)}  {half}"


def _notes(ladder: Ladder) -> Iterator[str]:
    yield "* is the default. CPU seconds of this machine, warm, the least of the runs; the interval is of this exam."
    if any("optimise" in one.label or one.axis == "fit window" for one in ladder.rows) and sized(ladder):
        yield "Least squares and other windows: sized as if the calibration were learned so; `estimate` refuses that."
    reference = ladder.reference
    if reference.answer is not None:
        yield (
            f"Off: mm, root mean square over runs and both ends, from a reference: {reference.words}; its own "
            f"Monte-Carlo error is {reference.error_mm:.2g} mm, its cost {reference.cpu_s:.1f} s."
        )
    else:
        yield "There is no reference to compare with: what it would be made from has no size."
    for name, seconds in ladder.shared_cpu_s.items():
        yield f"{name}: {seconds:.2f} s of CPU besides."
