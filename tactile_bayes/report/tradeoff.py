"""Trade-offs in words, documents and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from tactile_bayes.declarations import Meta, Record, says
from tactile_bayes.posterior.verdict import LIKELY, chance_text
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import SOURCES
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.studies.estimate_tradeoff import SIZE, Ladder, PooledRow, Priced, SizeAnswer

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# --- One paragraph at the end of a trade-off: which setting is enough, and what would help instead.


def advice(ladder: Ladder) -> list[str]:
    """What to choose, why more buys nothing, and what moves the answer more than any arithmetic."""
    answer, limit = ladder.reference.answer, ladder.tolerance_mm
    if answer is None:
        return [_without_number(ladder)]
    lines = [f"Advice: {_enough(ladder, answer)}"]
    far = [f"{one.label} {one.off.ends:.1f} mm" for one in ladder.rows if one.off.ends > limit]
    if far:
        lines.append(f"What moves the ends more than {limit:g} mm: {'; '.join(far)}.")
    silent = [one.label for one in ladder.rows if one.answer.reported is None]
    if silent:
        lines.append(f"No size by {', '.join(silent)}.")
    sized = [one for one in ladder.pooled if one.answer.reported is not None]
    if len(sized) > 1:
        first, last = sized[0], sized[-1]
        ends, another = (first.another_half_mm, last.another_half_mm), ""
        if all(map(math.isfinite, ends)):
            another = ", and from {:.1f} to {:.1f} mm if exams differ as in the paper".format(*ends)
        lines.append(
            f"{last.maps} maps pooled instead of {first.maps} change the half width from "
            f"{first.answer.half_width_mm:.1f} to {last.answer.half_width_mm:.1f} mm for "
            f"{last.cpu_s - first.cpu_s:.2f} s of CPU{another}."
        )
    return lines


def _enough(ladder: Ladder, reference: SizeAnswer) -> str:
    best, default, shares = ladder.enough(), ladder.default, reference.shares
    half = f"the interval's half width is {reference.half_width_mm:.1f} mm"
    if best is None:
        return (
            f"no setting has its interval ends within {ladder.tolerance_mm:g} mm of the reference; the default's are "
            f"{default.off.ends:.2g} mm off, and {half}."
        )
    took = f"{best.label}{' (the default)' if best.default else ''}: {best.seconds:.2f} s"
    text = f"{took}, interval ends within {max(best.off.ends, 0.01):.2g} mm; more buys nothing: {half}"
    if not shares:
        return f"{text}."
    source, share = max(shares.items(), key=lambda one: one[1])
    if source == "map":
        return f"{text}, and {share:.0f} % of its variance is the map's errors: scan more slowly or with more lines."
    rest = 100.0 - shares.get("map", 0.0)
    return f"{text}, and {rest:.0f} % of its variance is no error of the map ({share:.0f} % is {SOURCES[source]})."


def _without_number(ladder: Ladder) -> str:
    """Nothing to compare: what the settings say of a lump."""
    sized = [one.label for one in ladder.rows if one.answer.reported is not None]
    chances = [one.answer.probability for one in ladder.rows if one.answer.probability is not None]
    span = ""
    if chances:
        ends = (chance_text(one, 3) for one in (min(chances), max(chances)))
        span = f" (probability of one {' to '.join(dict.fromkeys(ends))})"
    if not sized:
        return f"Advice: no setting gives a size{span}; more accuracy changes no answer, another scan may."
    some = f"{len(sized)} of {len(ladder.rows)} settings do ({', '.join(sized)})"
    return (
        f"Advice: the default gives no size, {some}{span}: the map is at the limit of what can be sized. "
        "Believe none of them; scan the place again."
    )


# --- What `tradeoff estimate --json` and `tradeoff map --json` print.

DIGITS: Final = 6
Seconds = Annotated[dict[str, float], says("CPU seconds by part.")]


class QuantityFile(Record):
    """A median with its interval, mm."""

    median: float | None
    low: float | None
    high: float | None
    mc_error: float | None  #: Monte-Carlo error of the interval's ends.


class AnswerFile(Record):
    """What one estimate says."""

    reason: str  #: Why there is no number; empty where there is one.
    detected_probability: Annotated[float, Meta(ge=0, le=1)] | None
    method: str  #: The method that drew.
    quantities: dict[str, QuantityFile]  #: Medians and 95 % intervals, mm: max_size_mm, sigma_x_mm, sigma_y_mm.
    variance_share: dict[str, float]  #: Percent of the variance of ln(largest size) by source.


class ReferenceFile(Record):
    """What the settings are compared with."""

    words: str
    mc_error_mm: float | None
    half_width_mm: float | None
    cpu_s: float
    answer: AnswerFile | None


class SettingFile(Record):
    """One setting, its cost and its distance from the reference."""

    axis: str
    setting: str
    default: bool
    usable: bool  #: Whether it may be chosen to save time; other settings are another model or less data.
    runs: Annotated[int, Meta(ge=1)]
    cpu_s: Seconds
    median_off_mm: float | None
    ends_off_mm: float | None  #: Root mean square over runs and both ends of the reported interval.
    width_ends_off_mm: float | None
    answer: AnswerFile
    frontier: bool  #: No other setting is quicker and nearer at once.


class PooledFile(Record):
    """The size by the first few maps of a mass."""

    maps: Annotated[int, Meta(ge=1)]
    cpu_s: float
    answer: AnswerFile
    another_half_width_mm: float | None  #: Half width of the interval of another exam, mm.


class TradeoffFile(Record):
    """Time against accuracy of estimates or maps."""

    schema: Literal["tactile-bayes/tradeoff/1"]
    varied: Literal["estimate", "map"]
    tolerance_mm: Annotated[float, Meta(gt=0)]
    reference: ReferenceFile
    settings: Annotated[tuple[SettingFile, ...], Meta(min_length=1)]
    enough: str | None  #: The cheapest usable setting within the tolerance.
    pooled: tuple[PooledFile, ...]
    shared_cpu_s: Seconds
    advice: Annotated[tuple[str, ...], Meta(min_length=1)]
    provenance: dict[str, Any]
    research_use: Annotated[str, Meta(min_length=1)]


def ladder_file(ladder: Ladder, *, varied: Literal["estimate", "map"], provenance: Mapping[str, Any]) -> TradeoffFile:
    """A ladder as its file."""
    reference, enough, frontier = ladder.reference, ladder.enough(), set(map(id, ladder.frontier()))
    answer = reference.answer
    return TradeoffFile(
        schema="tactile-bayes/tradeoff/1",
        varied=varied,
        tolerance_mm=ladder.tolerance_mm,
        reference=ReferenceFile(
            reference.words,
            finite(reference.error_mm),
            None if answer is None else finite(answer.half_width_mm),
            reference.cpu_s,
            None if answer is None else _answer(answer),
        ),
        settings=tuple(
            SettingFile(
                axis=one.axis,
                setting=one.label,
                default=one.default,
                usable=one.usable,
                runs=len(one.answers),
                cpu_s=one.cpu_s,
                median_off_mm=finite(one.off.median),
                ends_off_mm=finite(one.off.ends),
                width_ends_off_mm=finite(one.off.width_ends),
                answer=_answer(one.answer),
                frontier=id(one) in frontier,
            )
            for one in ladder.rows
        ),
        enough=None if enough is None else enough.label,
        pooled=tuple(
            PooledFile(one.maps, one.cpu_s, _answer(one.answer), finite(one.another_half_mm)) for one in ladder.pooled
        ),
        shared_cpu_s=ladder.shared_cpu_s,
        advice=tuple(advice(ladder)),
        provenance=dict(provenance),
        research_use=RESEARCH_USE,
    )


def _answer(answer: SizeAnswer) -> AnswerFile:
    quantities = {
        name: QuantityFile(*map(finite, (one.median, one.low, one.high, one.mc_error)))
        for name, one in answer.quantities.items()
    }
    return AnswerFile(answer.reason, answer.probability, answer.method, quantities, answer.shares)


def finite(value: float) -> float | None:
    """The number; null in a file for what is none."""
    return value if math.isfinite(value) else None


# --- Reports of `tradeoff estimate` and `tradeoff map` as text: the table of settings.

_COLUMNS, _REASON = 80, 100
_COST = 7  #: Columns of a part's seconds.
_SHORT = {"estimate": "est."}
_NUMBERS = 36  #: Columns of a size with its interval and how far that is off.


def ladder_text(ladder: Ladder) -> str:
    """The whole report: what to choose, the table behind it, notes and the research-use line."""
    parts, width = [_SHORT.get(name, name) for name in ladder.default.cpu_s], _name(ladder)
    costs, units = ("".join(f"{word:>{_COST}}" for word in words) for words in (parts, ["s"] * len(parts)))
    what = "size" if sized(ladder) else "sigma"
    lines = [
        *advice(ladder),
        "",
        f"{'':<{width}}{costs}{what:>7}{'95 % interval':>15}{'ends':>7}{'widths':>7}",
        f"{'':<{width}}{units}{'mm':>7}{'mm':>15}{'off':>7}{'off':>7}",
    ]
    for axis, rows in groupby(ladder.rows, key=lambda one: one.axis):
        lines += [axis, *(line for one in rows for line in _row(one, ladder))]
    if ladder.pooled:
        lines += ["maps pooled", *(line for one in ladder.pooled for line in _pooled(one, ladder))]
    return "\n".join([*lines, "", *_notes(ladder), RESEARCH_USE])


def _name(ladder: Ladder) -> int:
    """Columns of a setting's name."""
    return _COLUMNS - _NUMBERS - _COST * len(ladder.default.cpu_s)


def sized(ladder: Ladder) -> bool:
    """Whether what is reported is a size; without a calibration it is a width."""
    return any(SIZE in one.answer.quantities for one in ladder.rows) or ladder.reference.answer is None


def _row(one: Priced, ladder: Ladder) -> list[str]:
    """The setting's name with its numbers beside it, or below where it is long, and notes."""
    name, width = f"{'*' if one.default else ' '} {one.label}", _name(ladder)
    numbers = "".join(f"{seconds:>{_COST}.3f}" for seconds in one.cpu_s.values()) + _number(one.answer)
    notes = []
    if one.answer.reported is not None:
        for off in (one.off.ends, one.off.width_ends):
            numbers += f"{f'{off:.3f}' if math.isfinite(off) else '-':>7}"
        if SIZE not in one.answer.quantities and sized(ladder):
            notes.append("    (a width: this map has no size)")
        if one.answer.method == "ensemble" and "ensemble" not in one.label:
            notes.append("    (by MCMC: importance sampling failed)")
    beside = [f"{name:<{width}}{numbers}"] if len(name) <= width else [name, f"{'':<{width}}{numbers}"]
    return [*beside, *notes]


def _number(answer: SizeAnswer) -> str:
    """The number, or why there is none, with the probability of a lump where the reason does not name one."""
    found, reason = answer.reported, answer.reason
    if found is not None:
        return f"{found.median:>7.2f}{f'{found.low:.2f} to {found.high:.2f}':>15}"
    if len(reason) > _REASON:
        reason = f"{reason[: _REASON - 3]}..."
    named = answer.probability is None or "probability" in reason
    return f"  {reason}" if named else f"  probability of a lump {answer.probability:.2g}: {reason}"


def _pooled(one: PooledRow, ladder: Ladder) -> list[str]:
    name = f"  {one.maps} map{'s' if one.maps > 1 else ''}"
    line = f"{name:<{_name(ladder)}}{one.cpu_s:>{_COST}.3f}{_number(one.answer)}"
    if one.answer.reported is None:
        return [line]
    half = f"    half width {one.answer.half_width_mm:.2f} mm"
    if math.isfinite(one.another_half_mm):
        half += f", {one.another_half_mm:.2f} if exams differ as in the paper"
    return [line, half]


def _notes(ladder: Ladder) -> Iterator[str]:
    yield "* is the default. CPU seconds of this machine, warm, the least of the runs; the interval is of this exam."
    if any("optimise" in one.label or one.axis == "fit window" for one in ladder.rows) and sized(ladder):
        yield "Least squares and other windows: sized as if the calibration were learned so; `estimate` refuses that."
    reference = ladder.reference
    if reference.answer is not None:
        yield (
            "ends, widths: mm off, root mean square over runs and both ends, from a reference: "
            f"{reference.words}; its own Monte-Carlo error is {reference.error_mm:.2g} mm, its cost "
            f"{reference.cpu_s:.1f} s."
        )
    else:
        yield "There is no reference to compare with: what it would be made from has no size."
    for name, seconds in ladder.shared_cpu_s.items():
        yield f"{name}: {seconds:.2f} s of CPU besides."


# --- The Pareto picture of a trade-off: distance of interval ends against CPU time, both logarithmic.

_MARKS = ("o", "^", "s", "D", "v", "P")
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_LETTER, _LINE = 3.95, 9.0  #: Width of a letter and height of a line of a name, points.
Box = tuple[float, float, float, float]
_LEAST_MM = 1e-3  #: Smaller distances are drawn here: below rounding of what anybody reads.


def draw_ladder(ladder: Ladder, path: Path, *, title: str, force: bool = False) -> None:
    """Draw every setting as a point, with the frontier and the lines that say what matters.

    Without a reference there is no distance: then the probability of a lump is drawn.
    """
    with figure_file(path, size_in=(10.0, 6.0), force=force) as figure:
        axes = figure.subplots()
        shown = [one for one in ladder.rows if math.isfinite(_height(one, ladder))]
        for i, axis in enumerate(dict.fromkeys(one.axis for one in shown)):
            rows = [one for one in shown if one.axis == axis]
            axes.plot(*_places(rows, ladder), _MARKS[i % 6], color=_COLOURS[i % 6], label=axis, zorder=3)
        default = [one for one in shown if one.default]
        axes.plot(*_places(default, ladder), "o", ms=15, mfc="none", mec="k", mew=1.5, label="the default", zorder=4)
        answer = ladder.reference.answer
        if answer is not None:
            frontier = _places(ladder.frontier(), ladder)
            axes.step(*frontier, where="post", color="0.3", lw=1.0, label="frontier", zorder=2)
            axes.set_ylabel("distance of the interval's ends from the reference, mm (rms)")
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            _draw_level(axes, answer.half_width_mm, "k", "-", "half width of the interval")
            _draw_level(axes, ladder.tolerance_mm, "0.5", "--", "tolerance")
            _draw_level(axes, ladder.reference.error_mm, "0.5", ":", "the reference's own error")
        else:
            axes.set_ylabel("probability of a lump (no size to compare)")
            axes.set_ylim(-0.05, 1.15)
            axes.axhline(LIKELY, color="0.5", ls="--", lw=1.0, label=f"needed for a size, {LIKELY:g}")
        if shown:
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "235" else "")
            axes.margins(x=0.12, y=0.08)
            _draw_names(axes, shown, ladder)
        axes.set_xlabel("CPU time, s")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside right upper", fontsize=8, frameon=False)


def _height(one: Priced, ladder: Ladder) -> float:
    """Distance from the reference, mm; without a reference the probability of a lump."""
    if ladder.reference.answer is not None:
        return max(one.off.ends, _LEAST_MM)
    return float("nan") if one.answer.probability is None else one.answer.probability


def _places(rows: Sequence[Priced], ladder: Ladder) -> tuple[list[float], list[float]]:
    return [max(one.seconds, 1e-4) for one in rows], [_height(one, ladder) for one in rows]


def _draw_level(axes: Axes, value: float, colour: str, style: str, name: str) -> None:
    """A level line, named at the right; none for 0."""
    if value > 0:
        place, text = (1.0, max(value, _LEAST_MM)), f"{name}, {value:.2g} mm"
        axes.axhline(place[1], color=colour, ls=style, lw=1.0, zorder=1)
        how: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        axes.annotate(text, place, xytext=(-4, 3), fontsize=8, ha="right", color=colour, **how)


def _draw_names(axes: Axes, shown: Sequence[Priced], ladder: Ladder) -> None:
    """A name beside each point, moved up or down until it covers no other name and no point."""
    figure = axes.figure
    figure.draw_without_rendering()  # type: ignore[union-attr]
    scale = 72.0 / figure.dpi
    right = axes.get_window_extent().x1 * scale
    points = zip(*_places(shown, ladder), strict=True)
    places = [[float(v) * scale for v in axes.transData.transform(point)] for point in points]
    taken: list[Box] = [(x - 4, y - 4, x + 4, y + 4) for x, y in places]
    patch = {"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 0.3}
    for one, (x, y) in sorted(zip(shown, places, strict=True), key=lambda pair: pair[1][1]):
        text, point = one.label.removeprefix("--method ").removeprefix("--"), (one.seconds, _height(one, ladder))
        taken.append(_free_place(x, y, _LETTER * len(text), taken, right=right))
        at = (taken[-1][0] - x, taken[-1][1] + 2 - y)
        axes.annotate(text, point, xytext=at, textcoords="offset points", fontsize=7, zorder=5, bbox=patch)


def _free_place(x: float, y: float, wide: float, taken: list[Box], *, right: float) -> Box:
    """Where a name of so many points of width goes: at the right of its point, or the left where the picture ends."""
    begin = x - 8 - wide if x + wide + 8 > right else x + 8
    for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6):
        low = y - 4.5 + step * _LINE
        box = (begin, low, begin + wide, low + _LINE)
        covers = ((x0 < box[2] and box[0] < x1 and y0 < box[3] and low < y1) for x0, y0, x1, y1 in taken)
        if not any(covers):
            break
    return box
