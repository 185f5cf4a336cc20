"""Trade-offs in words, documents and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from tactile_bayes.declarations import Meta, Record
from tactile_bayes.findings import counted
from tactile_bayes.posterior.verdict import LIKELY, chance_text
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_text import SOURCES
from tactile_bayes.report.figure_file import Axes, Figure, figure_file
from tactile_bayes.studies.estimate_tradeoff import (
    SIZE,
    WIDTHS,
    MeasuredSetting,
    PooledRow,
    Reference,
    Seconds,
    SizeAnswer,
    Tradeoff,
)
from tactile_bayes.studies.tradeoffs import AMPLITUDE, ELEMENT

# --- One paragraph at the end of a trade-off: which setting is enough, and what would help instead.


def advice(tradeoff: Tradeoff) -> list[str]:
    """The cheapest sufficient setting, and settings and pooled maps that change the answer more than accuracy does."""
    answer, limit = tradeoff.reference.answer, tradeoff.tolerance_mm
    if answer is None:
        return [_advice_without_size(tradeoff), *tradeoff.notes]
    lines = [f"Advice: {_cheapest_setting(tradeoff, answer)}"]
    far = [f"{row.label} {row.ends_off_mm:.1f} mm" for row in tradeoff.rows if tradeoff.exceeds_tolerance(row)]
    if far:
        lines.append(f"What moves the ends more than {limit:g} mm: {'; '.join(far)}.")
    silent = [one.label for one in tradeoff.rows if one.answer.reported is None]
    if silent:
        lines.append(f"No size by {', '.join(silent)}.")
    sized = [one for one in tradeoff.pooled if one.answer.reported is not None]
    if len(sized) > 1:
        first, last = sized[0], sized[-1]
        ends, another = (first.another_half_width_mm, last.another_half_width_mm), ""
        if None not in ends:
            another = ", and from {:.1f} to {:.1f} mm if exams differ as in the paper".format(*ends)
        lines.append(
            f"{last.maps} maps pooled instead of {first.maps} change the half width from "
            f"{first.answer.half_width_mm:.1f} to {last.answer.half_width_mm:.1f} mm for "
            f"{last.cpu_s - first.cpu_s:.2f} s of CPU{another}."
        )
    return [*lines, *tradeoff.notes]


def _cheapest_setting(tradeoff: Tradeoff, reference: SizeAnswer) -> str:
    best, default, shares = tradeoff.cheapest_sufficient(), tradeoff.default, reference.variance_share
    half = f"the interval's half width is {reference.half_width_mm:.1f} mm"
    if best is None or best.ends_off_mm is None:
        off = math.nan if default.ends_off_mm is None else default.ends_off_mm
        return (
            f"no setting has its interval ends within {tradeoff.tolerance_mm:g} mm of the reference; the default's are "
            f"{off:.2g} mm off, and {half}."
        )
    took = f"{best.label}{' (the default)' if best.default else ''}: {best.seconds:.2f} s"
    text = f"{took}, interval ends within {max(best.ends_off_mm, 0.01):.2g} mm; more buys nothing: {half}"
    if not shares:
        return f"{text}."
    source, share = max(shares.items(), key=lambda one: one[1])
    if source == "map":
        return f"{text}, and {share:.0f} % of its variance is the map's errors: scan more slowly or with more lines."
    rest = 100.0 - shares.get("map", 0.0)
    return f"{text}, and {rest:.0f} % of its variance is no error of the map ({share:.0f} % is {SOURCES[source]})."


def _advice_without_size(tradeoff: Tradeoff) -> str:
    """Advice where the default gives no size: settings that give one, and the probabilities of a lump."""
    sized = [one.label for one in tradeoff.rows if one.answer.reported is not None]
    chances = [one for row in tradeoff.rows if (one := row.answer.detected_probability) is not None]
    span = ""
    if chances:
        ends = (chance_text(one, 3) for one in (min(chances), max(chances)))
        span = f" (probability of one {' to '.join(dict.fromkeys(ends))})"
    if not sized:
        return f"Advice: no setting gives a size{span}; more accuracy changes no answer, another scan may."
    some = f"{len(sized)} of {len(tradeoff.rows)} settings do ({', '.join(sized)})"
    return (
        f"Advice: the default gives no size, {some}{span}: the map is at the limit of what can be sized. "
        "Believe none of them; scan the place again."
    )


# --- What `tradeoff ... --json` prints.

DIGITS: Final = 6
Varied = Literal["estimate", "map", "forward"]


class TradeoffFile(Record):
    """Time against accuracy of estimates, maps or forward models."""

    schema: Literal["tactile-bayes/tradeoff/1"]
    varied: Varied
    tolerance_mm: Annotated[float, Meta(gt=0)]
    reference: Reference
    settings: Annotated[tuple[MeasuredSetting, ...], Meta(min_length=1)]
    enough: str | None  #: The cheapest usable setting within the tolerance.
    pooled: tuple[PooledRow, ...]
    shared_cpu_s: Seconds
    advice: Annotated[tuple[str, ...], Meta(min_length=1)]
    provenance: dict[str, Any]
    research_use: Annotated[str, Meta(min_length=1)]


def tradeoff_file(tradeoff: Tradeoff, *, varied: Varied, provenance: Mapping[str, Any]) -> TradeoffFile:
    """A trade-off as its file."""
    enough = tradeoff.cheapest_sufficient()
    return TradeoffFile(
        "tactile-bayes/tradeoff/1",
        varied,
        tradeoff.tolerance_mm,
        tradeoff.reference,
        tradeoff.rows,
        None if enough is None else enough.label,
        tradeoff.pooled,
        tradeoff.shared_cpu_s,
        tuple(advice(tradeoff)),
        dict(provenance),
        RESEARCH_USE,
    )


# --- The report as text: the table of settings.

_COLUMNS, _REASON = 80, 100
_COST = 7  #: Columns of a part's seconds.
_SHORT = {"estimate": "est."}
_NUMBERS = 36  #: Columns of a size with its interval and how far that is off.


def tradeoff_text(by_title: Mapping[str, Tradeoff]) -> str:
    """The whole report, ending with the research-use line; several trade-offs each under their title."""
    texts = {title: settings_text(tradeoff) for title, tradeoff in by_title.items()}
    parts = [text if len(texts) == 1 else f"{title}\n{text}\n" for title, text in texts.items()]
    return "\n".join([*parts, RESEARCH_USE])


def settings_text(tradeoff: Tradeoff) -> str:
    """Advice, the table of settings, and notes."""
    parts, width = [_SHORT.get(name, name) for name in tradeoff.default.cpu_s], _label_width(tradeoff)
    costs, units = ("".join(f"{word:>{_COST}}" for word in words) for words in (parts, ["s"] * len(parts)))
    quantity = "size" if gives_sizes(tradeoff) else "sigma"
    lines = [
        *advice(tradeoff),
        "",
        f"{'':<{width}}{costs}{quantity:>7}{'95 % interval':>15}{'ends':>7}{'widths':>7}",
        f"{'':<{width}}{units}{'mm':>7}{'mm':>15}{'off':>7}{'off':>7}",
    ]
    for axis, rows in groupby(tradeoff.rows, key=lambda one: one.axis):
        lines += [axis, *(line for row in rows for line in _row(row, tradeoff))]
    if tradeoff.pooled:
        lines += ["maps pooled", *(line for one in tradeoff.pooled for line in _pooled(one, tradeoff))]
    lines += _exact_maps(tradeoff)
    return "\n".join([*lines, "", *_notes(tradeoff)])


def _label_width(tradeoff: Tradeoff) -> int:
    return _COLUMNS - _NUMBERS - _COST * len(tradeoff.default.cpu_s)


def gives_sizes(tradeoff: Tradeoff) -> bool:
    """True if sizes are reported, False if widths, for lack of a calibration."""
    return any(SIZE in row.answer.quantities for row in tradeoff.rows) or tradeoff.reference.answer is None


def _row(one: MeasuredSetting, tradeoff: Tradeoff) -> list[str]:
    """The setting's name with its numbers beside it, or below where it is long, and notes."""
    name, width = f"{'*' if one.default else ' '} {one.label}", _label_width(tradeoff)
    numbers = "".join(f"{seconds:>{_COST}.3f}" for seconds in one.cpu_s.values()) + _number(one.answer)
    notes = []
    if one.answer.reported is not None:
        for off in (one.ends_off_mm, one.width_ends_off_mm):
            numbers += f"{'-' if off is None else f'{off:.3f}':>7}"
        if SIZE not in one.answer.quantities and gives_sizes(tradeoff):
            notes.append("    (a width: this map has no size)")
        if one.answer.method == "ensemble" and "ensemble" not in one.label:
            notes.append("    (by MCMC: importance sampling failed)")
    beside = [f"{name:<{width}}{numbers}"] if len(name) <= width else [name, f"{'':<{width}}{numbers}"]
    return [*beside, *notes]


def _number(answer: SizeAnswer) -> str:
    """Median and interval, else the reason for none, with the probability of a lump if the reason lacks it."""
    quantity, reason = answer.reported, answer.reason
    if quantity is not None:
        return f"{quantity.median:>7.2f}{f'{quantity.low:.2f} to {quantity.high:.2f}':>15}"
    if len(reason) > _REASON:
        reason = f"{reason[: _REASON - 3]}..."
    chance = answer.detected_probability
    named = chance is None or "probability" in reason
    return f"  {reason}" if named else f"  probability of a lump {chance:.2g}: {reason}"


def _pooled(one: PooledRow, tradeoff: Tradeoff) -> list[str]:
    name = f"  {counted(one.maps, 'map')}"
    line = f"{name:<{_label_width(tradeoff)}}{one.cpu_s:>{_COST}.3f}{_number(one.answer)}"
    if one.answer.reported is None:
        return [line]
    half = f"    half width {one.answer.half_width_mm:.2f} mm"
    if one.another_half_width_mm is not None:
        half += f", {one.another_half_width_mm:.2f} if exams differ as in the paper"
    return [line, half]


def _exact_maps(tradeoff: Tradeoff) -> Iterator[str]:
    """Table of a forward model's maps, which have no errors: bump, and signed deviation from the reference."""
    best = tradeoff.reference.answer
    if best is None or AMPLITUDE not in best.quantities:
        return
    columns = ((ELEMENT, 6, 2), (AMPLITUDE, 7, 4), (WIDTHS[0], 7, 3), (WIDTHS[1], 7, 3))
    yield from ("", f"{'the map':<25}{'mesh':>6}{'a':>7}{'sig. x':>7}{'sig. y':>7}   off, %")
    yield f"{'':<25}{'mm':>6}{'':>7}{'mm':>7}{'mm':>7}{'a':>7}{'x':>7}{'y':>7}{'size':>7}"
    for label, answer in (("the finest", best), *((row.label, row.answer) for row in tradeoff.rows)):
        shown, line = answer.quantities, f"{label:<25}"
        for name, width, digits in columns:
            line += f"{f'{shown[name].median:.{digits}f}' if name in shown else '':>{width}}"
        for name in (AMPLITUDE, *WIDTHS, SIZE) if answer is not best else ():
            known = name in shown and name in best.quantities
            line += f"{f'{100 * (shown[name].median / best.quantities[name].median - 1):+.2f}' if known else '':>7}"
        yield line.rstrip()


def _notes(tradeoff: Tradeoff) -> Iterator[str]:
    reference, interval, error = tradeoff.reference, "of this exam", ""
    if reference.answer is not None and AMPLITUDE in reference.answer.quantities:
        interval = "what the calibration leaves"
    elif reference.answer is not None:
        error = f"its own Monte-Carlo error is {reference.mc_error_mm:.2g} mm, "
    yield f"* is the default. CPU seconds of this machine, warm, the least of the runs; the interval is {interval}."
    if any("optimise" in row.label or row.axis == "fit window" for row in tradeoff.rows) and gives_sizes(tradeoff):
        yield "Least squares and other windows: sized as if the calibration were learned so; `estimate` refuses that."
    if reference.answer is not None:
        yield (
            "ends, widths: mm off, root mean square over runs and both ends, from a reference: "
            f"{reference.words}; {error}its cost {reference.cpu_s:.1f} s."
        )
    else:
        yield "There is no reference to compare with: what it would be made from has no size."
    for name, seconds in tradeoff.shared_cpu_s.items():
        yield f"{name}: {seconds:.2f} s of CPU besides."


# --- The Pareto picture of a trade-off: distance of interval ends against CPU time, both logarithmic.

_MARKS = ("o", "^", "s", "D", "v", "P")
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_LETTER, _LINE = 3.95, 9.0  #: Width of a letter and height of a line of a name, points.
Box = tuple[float, float, float, float]
_LEAST_MM = 1e-3  #: Smaller distances are drawn here: below rounding of what anybody reads.


def draw_tradeoffs(by_title: Mapping[str, Tradeoff], path: Path, *, force: bool = False) -> None:
    """Draw every setting as a point, with the frontier and the lines that say what matters; trade-offs by their titles.

    Without a reference there is no distance: then the probability of a lump is drawn.
    """
    with figure_file(path, size_in=(10.0, 6.0 * len(by_title)), force=force) as figure:
        parts: Any = [figure] if len(by_title) == 1 else figure.subfigures(len(by_title), 1)
        for part, (title, tradeoff) in zip(parts, by_title.items(), strict=True):
            axes = part.subplots()
            _draw_settings(figure, axes, tradeoff)
            axes.set_title(title, fontsize=10)
            part.legend(loc="outside right upper", fontsize=8, frameon=False)


def _draw_settings(figure: Figure, axes: Axes, tradeoff: Tradeoff) -> None:
    shown = [row for row in tradeoff.rows if math.isfinite(_height(row, tradeoff))]
    for i, axis in enumerate(dict.fromkeys(one.axis for one in shown)):
        rows = [one for one in shown if one.axis == axis]
        axes.plot(*_points(rows, tradeoff), _MARKS[i % 6], color=_COLOURS[i % 6], label=axis, zorder=3)
    default = [one for one in shown if one.default]
    axes.plot(*_points(default, tradeoff), "o", ms=15, mfc="none", mec="k", mew=1.5, label="the default", zorder=4)
    reference = tradeoff.reference
    if reference.answer is not None:
        frontier = _points(tradeoff.frontier(), tradeoff)
        axes.step(*frontier, where="post", color="0.3", lw=1.0, label="frontier", zorder=2)
        axes.set_ylabel("distance of the interval's ends from the reference, mm (rms)")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        _draw_level(axes, reference.half_width_mm, "k", "-", "half width of the interval")
        _draw_level(axes, tradeoff.tolerance_mm, "0.5", "--", "tolerance")
        _draw_level(axes, reference.mc_error_mm, "0.5", ":", "the reference's own error")
    else:
        axes.set_ylabel("probability of a lump (no size to compare)")
        axes.set_ylim(-0.05, 1.15)
        axes.axhline(LIKELY, color="0.5", ls="--", lw=1.0, label=f"needed for a size, {LIKELY:g}")
    if shown:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in "235" else "")
        axes.margins(x=0.12, y=0.08)
        _draw_names(figure, axes, shown, tradeoff)
    axes.set_xlabel("CPU time, s")


def _height(one: MeasuredSetting, tradeoff: Tradeoff) -> float:
    """Distance from the reference, mm; without a reference the probability of a lump."""
    if tradeoff.reference.answer is not None:
        return math.nan if one.ends_off_mm is None else max(one.ends_off_mm, _LEAST_MM)
    return math.nan if one.answer.detected_probability is None else one.answer.detected_probability


def _points(rows: Sequence[MeasuredSetting], tradeoff: Tradeoff) -> tuple[list[float], list[float]]:
    return [max(row.seconds, 1e-4) for row in rows], [_height(one, tradeoff) for one in rows]


def _draw_level(axes: Axes, value: float | None, colour: str, style: str, name: str) -> None:
    """A level line, named at the right; none for 0."""
    if value:
        place, text = (1.0, max(value, _LEAST_MM)), f"{name}, {value:.2g} mm"
        axes.axhline(place[1], color=colour, ls=style, lw=1.0, zorder=1)
        coordinates: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
        axes.annotate(text, place, xytext=(-4, 3), fontsize=8, ha="right", color=colour, **coordinates)


def _draw_names(figure: Figure, axes: Axes, shown: Sequence[MeasuredSetting], tradeoff: Tradeoff) -> None:
    """A name beside each point, moved up or down until it covers no other name and no point."""
    figure.draw_without_rendering()
    scale = 72.0 / figure.dpi
    right = axes.get_window_extent().x1 * scale
    points = zip(*_points(shown, tradeoff), strict=True)
    places = [[float(v) * scale for v in axes.transData.transform(point)] for point in points]
    occupied: list[Box] = [(x - 4, y - 4, x + 4, y + 4) for x, y in places]
    patch = {"facecolor": "w", "edgecolor": "none", "alpha": 0.7, "pad": 0.3}
    for one, (x, y) in sorted(zip(shown, places, strict=True), key=lambda pair: pair[1][1]):
        text, point = one.label.removeprefix("--method ").removeprefix("--"), (one.seconds, _height(one, tradeoff))
        occupied.append(_free_place(x, y, _LETTER * len(text), occupied, right=right))
        offset = (occupied[-1][0] - x, occupied[-1][1] + 2 - y)
        axes.annotate(text, point, xytext=offset, textcoords="offset points", fontsize=7, zorder=5, bbox=patch)


def _free_place(x: float, y: float, wide: float, occupied: list[Box], *, right: float) -> Box:
    """Where a name of so many points of width goes: at the right of its point, or the left where the picture ends."""
    begin = x - 8 - wide if x + wide + 8 > right else x + 8
    for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6):
        low = y - 4.5 + step * _LINE
        box = (begin, low, begin + wide, low + _LINE)
        if not any(x0 < box[2] and box[0] < x1 and y0 < box[3] and low < y1 for x0, y0, x1, y1 in occupied):
            break
    return box
