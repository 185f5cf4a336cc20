"""The page and the picture of a mass over time: maps on common axes, the size at each visit, and the change."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from tactile_bayes.declarations import Record, replace
from tactile_bayes.files.reports import EstimateReport, centre_of
from tactile_bayes.findings import finding_lines
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import PATIENT_WORDS, Orientation, TactileMap, orientation_of
from tactile_bayes.report import compare, svg
from tactile_bayes.report.estimate_text import spread_percent
from tactile_bayes.report.figure_file import Axes, Figure, exam_title, figure_file
from tactile_bayes.report.map import draw_cells, draw_edges, ellipse_of
from tactile_bayes.report.pages import cut, foot, page
from tactile_bayes.size.visits import VisitComparison, straight_line

# --- The maps of each visit, averaged on common axes about the mass.

_PATIENT: Final = Orientation("-x", "+y", PATIENT_WORDS, (0.0, 1.0))
HALF_MM: Final = 30.0  #: Half the side of the square about the mass that is drawn.
STEP_MM: Final = 1.0
_MOST_VISITS: Final = 4


class DrawnMap(Record, eq=False):
    """A map with the lump of its estimate."""

    tactile_map: TactileMap
    report: EstimateReport


class LaidMap(Record, eq=False):
    """A visit's maps averaged on a common grid about its mass."""

    values: FloatArray  #: (n, n) array: Rows upwards, columns to the right on the screen; NaN without data.
    origin_mm: FloatArray  #: (2,) array: Left of and above the xiphoid, where the mass lies; (0, 0) without landmarks.
    ring_mm: FloatArray | None
    """(2, m) array: Right of and above the mass, the ellipse of its size at the visit; None without one."""


def on_common_axes(
    report: compare.CompareReport, visits: Sequence[Sequence[DrawnMap]], *, middle: bool = False
) -> tuple[list[LaidMap], Orientation]:
    """The maps of each visit, and their axes: the patient's where all maps have landmarks, else the maps' own.

    Of a visit without a lump nothing is shown, or with `middle` its first map about its own middle.
    """
    every = [one.tactile_map for maps in visits for one in maps]
    view = _PATIENT
    if any(one.patient_from_plane is None for one in every):
        view = orientation_of(replace(every[0], patient_from_plane=None))
    sizes = [visit.max_size_mm for visit in report.visits]
    laid = []
    for maps, size in zip(visits, sizes, strict=True):
        centres = [centre_of(one.report.centre_mm) for one in maps]
        if middle and not any(centres):
            first = maps[0].tactile_map
            x, y = (float(axis[0] + axis[-1]) / 2 for axis in (first.x_mm, first.y_mm))
            maps, centres = maps[:1], [(x, y)]
        laid.append(_average_visit(maps, centres, size, view))
    return laid, view


def _average_visit(
    maps: Sequence[DrawnMap], centres: Sequence[tuple[float, float] | None], size: Quantity | None, view: Orientation
) -> LaidMap:
    """Mean of a visit's maps about its mass, on the screen's axes."""
    along = np.arange(-HALF_MM, HALF_MM + STEP_MM / 2, STEP_MM)
    right, up = np.meshgrid(along, along)
    signs = np.array([1.0 if axis[0] == "+" else -1.0 for axis in (view.right, view.up)])
    about, in_patient = np.stack([signs[0] * right, signs[1] * up]), view is _PATIENT
    values, places, ring = [], [], None
    for drawn, centre in zip(maps, centres, strict=True):
        if centre is None:
            continue
        one, (axes_mm, angle_deg) = drawn.tactile_map, ellipse_of(drawn.report)
        rotation = np.eye(2)  # from the plane's x and y
        if in_patient:
            assert one.patient_from_plane is not None
            rotation = one.patient_from_plane[:2, :2]
            places.append((rotation @ centre + one.patient_from_plane[:2, 3]) * [-1.0, 1.0])
        x, y = np.tensordot(np.linalg.inv(rotation), about, axes=1) + np.reshape(centre, (2, 1, 1))
        values.append(_values_at(one, x, y))
        if ring is None and size is not None and axes_mm is not None:
            shape = svg.ellipse_mm(axes_mm, angle_deg) * size.median / max(axes_mm)  # as its map has it
            ring = signs[:, None] * (rotation @ shape)
    if not values:
        return LaidMap(np.full(right.shape, np.nan), np.zeros(2), None)
    stack = np.stack(values)
    known = np.isfinite(stack)
    total, count = np.where(known, stack, 0.0).sum(axis=0), known.sum(axis=0)
    mean = np.divide(total, count, out=np.full(right.shape, np.nan), where=count > 0)
    return LaidMap(mean, np.mean(places, axis=0) if places else np.zeros(2), ring)


def _values_at(tactile_map: TactileMap, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Values of the nearest cells; NaN outside and in cells without data or with few readings."""
    cell = tactile_map.recipe.cell_mm
    column = np.rint((x_mm - tactile_map.x_mm[0]) / cell).astype(int)
    row = np.rint((y_mm - tactile_map.y_mm[0]) / cell).astype(int)
    ny, nx = tactile_map.mean.shape
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    filled = np.where(tactile_map.covered & ~tactile_map.few, tactile_map.mean, np.nan)
    return np.where(inside, filled[np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)], np.nan)


def _drawn_visits(laid: Sequence[LaidMap]) -> list[int]:
    """Indices of the visits whose maps are drawn: the first and the last ones."""
    return [0, *range(max(1, len(laid) - _MOST_VISITS + 1), len(laid))]


def common_limits(maps: Sequence[LaidMap]) -> tuple[float, float]:
    """Values at the ends of the colours, one range for all maps."""
    return svg.spread_limits(np.concatenate([one.values[np.isfinite(one.values)] for one in maps]))


# --- The page.

TITLE: Final = "Tactile exams over time"
_SCALE: Final = 0.7  #: Of life size, of the maps.


class Course(Record):
    """Facts on the visits besides their maps; empty where unknown."""

    title: str = ""
    name: str = ""
    patient: str = ""
    side: str = ""
    mass: str = ""
    visits: tuple[str, ...] = ()  #: A code for each.
    dates: tuple[str, ...] = ()  #: Likewise.

    def of(self, visit: compare.Visit) -> str:
        """A visit in words: its number, by which sentences and findings name it, its code, and its date or its day."""
        index = visit.visit - 1
        day = "" if visit.day is None or not index else f"day {visit.day:g}"
        when = self.dates[index] if self.dates else day
        return f"Visit {self.numbers[index] if self.visits else visit.visit}{when and f', {when}'}"

    @property
    def numbers(self) -> list[str]:
        """Numbers of the visits that have codes, with the code where it is not the number."""
        return [
            f"{number}{'' if code == str(number) else f' (coded {code})'}" for number, code in enumerate(self.visits, 1)
        ]


def growth_page(
    compared: VisitComparison, report: compare.CompareReport, visits: Sequence[Sequence[DrawnMap]], course: Course
) -> str:
    """Full HTML page of a comparison; equal comparisons give equal text."""
    laid, view = on_common_axes(report, visits, middle=True)
    limits, words = common_limits(laid), visits[0][0].tactile_map.recipe.value_words
    shown = _drawn_visits(laid)
    changes = list(_changes(report, replace(course, visits=())))  # without codes, for which there is no room
    facts = (("Name", course.name), ("Patient", course.patient), ("Side", course.side), ("Mass", course.mass))
    return page(
        "growth",
        title=cut(course.title, 60) or TITLE,
        facts=[(name, text) for name, text in facts if text],
        headline=compare.verdict_sentence(replace(report, advice=compared.on_paper or report.advice)),
        findings=finding_lines(report.findings, paper=True),
        maps=[_picture(laid[i], view, limits, course, report.visits[i]) for i in shown],
        left_out=len(laid) - len(shown),
        colours=svg.colour_steps(limits, words, more=any(bool((one.values > limits[1]).any()) for one in laid)),
        view=view,
        side_mm=2 * HALF_MM,
        chart=_chart(compared, report, course),
        another=compared.another,
        spread=None if report.between_map_sd is None else spread_percent(report.between_map_sd),
        change=svg.size_ruler(changes, unit="%", label="Change of the largest diameter in percent"),
        sentences=compare.change_sentences(report),
        rates=compare.rate_sentences(report),
        report=report,
        course=course,
        foot=foot(report.provenance.get("scans", ())),
    )


def _picture(
    laid: LaidMap, view: Orientation, limits: tuple[float, float], course: Course, visit: compare.Visit
) -> tuple[str, str, str]:
    """Inline SVG of a visit's map with its ring, sides and scale bar, the visit in words, and its size."""
    side, q = _SCALE * (2 * HALF_MM + STEP_MM), visit.max_size_mm
    parts = [svg.picture_of(laid.values[::-1], limits, (side, side))]
    if laid.ring_mm is not None:
        points = side / 2 + _SCALE * laid.ring_mm * [[1.0], [-1.0]]
        parts.append(svg.stroked(svg.through(points.T.tolist()) + "Z", 0.5, kind="size"))
    parts += svg.edge_names(view, (side, side), small=True)
    parts += svg.scale_bar(side, _SCALE, least_mm=6.0, inset=2.0, size=2.4)
    drawn = svg.drawing("map", f"Map of {course.of(visit)}", (0.0, 0.0, side, side), parts)
    unsized = "not sized" if any(one.status == "estimate" for one in visit.maps) else "no lump found"
    return drawn, course.of(visit), unsized if q is None else f"{q.median:.1f} mm"


def _changes(report: compare.CompareReport, course: Course) -> Iterator[tuple[str, Quantity]]:
    """The change to the last visit, the same if exams differ as patients' do, and those to earlier ones."""
    for change in reversed(report.changes):
        yield course.of(report.visits[change.later - 1]), change.percent
        another = change.another_exam if change is report.changes[-1] else None
        if another is not None:
            yield f"the same if exams of one mass differ by {100 * another.between_map_sd:.0f} %", another.percent


# --- The size at each visit over time, as inline SVG.

_BOX_MM: Final = (82.0, 50.0)
_LEFT_MM, _RIGHT_MM, _ABOVE_MM, _BELOW_MM = 9.0, 2.0, 3.0, 12.0
_INSET_MM: Final = 8.0  #: From the axis to the first visit.
_ROOM_MM: Final = (17.0, 8.0)
"""Visits nearer than the first have their dates in two rows, nearer than the second none, and no numbers."""


def _chart(compared: VisitComparison, report: compare.CompareReport, course: Course) -> str:
    """Largest diameter with its interval at each visit, and the trend where there is one; empty without sizes."""
    joint, another, (width, height) = compared.joint, compared.another, _BOX_MM
    if joint is None:
        return ""
    days = [visit.day for visit in report.visits]
    times = [float(i if day is None or None in days else day) for i, day in enumerate(days)]
    run = (width - _LEFT_MM - _RIGHT_MM - 2 * _INSET_MM) / (times[-1] - times[0])
    places = [_LEFT_MM + _INSET_MM + run * (time - times[0]) for time in times]
    sizes = [visit.max_size_mm for visit in report.visits if visit.max_size_mm is not None]
    wide = [] if another is None else [another.size_mm(i, q.probability) for i, q in enumerate(sizes)]
    top = 1.08 * max(q.high for q in (*sizes, *wide))
    scale = (height - _ABOVE_MM - _BELOW_MM) / top
    floor, right = _up(0.0, scale), width - _RIGHT_MM
    parts = [svg.line(f"M{_LEFT_MM} {_ABOVE_MM}V{floor:.2f}H{right}", 0.25)]
    step = next((one for one in svg.STEPS if top / one <= 6), svg.STEPS[-1])
    for tick in range(0, int(top) + 1, step):
        y = _up(tick, scale)
        parts.append(svg.line(f"M{_LEFT_MM} {y:.2f}h-1", 0.25))
        parts.append(svg.text(_LEFT_MM - 1.6, y + 0.9, f"{tick}", anchor="end"))
    parts.append(svg.text(_LEFT_MM + 1, _ABOVE_MM + 1, "mm", anchor="start"))
    if report.trend is not None:
        trend = straight_line(*joint.moments, times)
        on_line = np.exp(trend.level + trend.per_day * (np.array(times) - np.mean(times)))
        path = svg.through((x, _up(size, scale)) for x, size in zip(places, on_line, strict=True))
        dash = 'stroke-width="0.4" stroke-dasharray="1.5 1"'
        parts.append(f'<path class="trend" d="{path}" fill="none" stroke="#555" {dash}/>')
    gap = float(min(np.diff(places)))
    for i, (x, visit) in enumerate(zip(places, report.visits, strict=True)):
        bars = [(one[i], thick) for one, thick in ((wide, 0.25), (sizes, 0.9)) if one]
        row = i % 2 if gap < _ROOM_MM[0] else 0
        parts += _mark(x, bars, course.of(visit), scale, row=row, named=gap >= _ROOM_MM[1])
    return svg.drawing("ruler", "Largest diameter at each visit with its intervals", (0.0, 0.0, width, height), parts)


def _up(size_mm: float, scale: float) -> float:
    """Place of a size on the chart, from its top."""
    return _BOX_MM[1] - _BELOW_MM - scale * size_mm


def _mark(
    x: float, bars: Sequence[tuple[Quantity, float]], words: str, scale: float, *, row: int, named: bool
) -> Iterator[str]:
    """Intervals of a visit, each so thick, and the last one's median, above the visit's number and its date."""
    for q, thick in bars:
        yield svg.line(f"M{x:.2f} {_up(q.low, scale):.2f}V{_up(q.high, scale):.2f}", thick)
    size_mm, floor = bars[-1][0].median, _up(0.0, scale)
    y = _up(size_mm, scale)
    yield f'<circle cx="{x:.2f}" cy="{y:.2f}" r="1.1" fill="#111"/>'
    visit, _, when = words.partition(", ")
    if named:
        edge = ' stroke="#fff" stroke-width="1" paint-order="stroke"'  # the line of the trend passes here
        yield svg.text(x + 1.4, y - 1.2, f"{size_mm:.1f}", anchor="start", more=edge)
        yield svg.text(x, floor + 7 + 3 * row, when[:14], size=2.5)
    yield svg.text(x, floor + 4, visit.split()[1])


# --- Picture of a comparison: the visits' maps on common axes and colours, their difference, and the change of size.


def draw_comparison(
    compared: VisitComparison,
    report: compare.CompareReport,
    visits: Sequence[Sequence[DrawnMap]],
    path: Path | None,
    *,
    force: bool = False,
) -> Figure:
    """Draw the visits' maps, the difference of the last and the first, and the posterior of the change.

    Maps of a visit are averaged about the mass. With landmarks on all maps the axes are the patient's, at the first
    visit's place, and later visits are moved so that the mass lies on itself. Without, they are the plane's.
    """
    laid, view = on_common_axes(report, visits)
    shown = _drawn_visits(laid)
    foot = f"{view.words}; later visits are moved so that the mass lies on itself; maps of a visit are averaged."
    with figure_file(path, size_in=(4.0 * (len(shown) + 1), 7.4), foot=foot, force=force) as figure:
        exam = exam_title("", report.provenance.get("scans", ()))
        figure.suptitle(f"Comparison: {exam}" if exam else "Comparison", x=0.01, ha="left", fontsize=11)
        grid = figure.add_gridspec(2, len(shown) + 1, height_ratios=(1.35, 1.0))
        panels = [figure.add_subplot(grid[0, i]) for i in range(len(shown) + 1)]
        words = visits[0][0].tactile_map.recipe.value_words
        _draw_maps(panels, [(Course().of(report.visits[i]), laid[i]) for i in shown], label=words, view=view)
        _draw_change(figure.add_subplot(grid[1, 0]), compared)
        words_axes = figure.add_subplot(grid[1, 1:])
        words_axes.set_axis_off()
        lines = [part for line in compare.compare_summary(report).splitlines()[:-1] for part in textwrap.wrap(line, 96)]
        text = "\n".join(line for line in lines if not line.startswith("More ("))
        words_axes.text(0.0, 1.0, text, va="top", fontsize=8.5, transform=words_axes.transAxes)
    return figure


def _draw_maps(panels: Sequence[Axes], visits: Sequence[tuple[str, LaidMap]], *, label: str, view: Orientation) -> None:
    """Draw the visits, by their names, with one colour bar, and the difference of the last and the first."""
    first, last = visits[0][1], visits[-1][1]
    low, high = common_limits([one for _, one in visits])
    difference = last.values - first.values
    most = max(0.3 * (high - low), float(np.nanmax(np.abs(difference), initial=0.0)))
    half = HALF_MM + STEP_MM / 2
    extent = tuple(middle + side for middle in first.origin_mm for side in (-half, half))
    pictures = [(name, one.values, {"cmap": "viridis", "vmin": low, "vmax": high}) for name, one in visits]
    pictures.append(("Last minus first", difference, {"cmap": "RdBu_r", "vmin": -most, "vmax": most}))
    drawn = []
    for axes, (name, values, colours) in zip(panels, pictures, strict=True):
        drawn.append(draw_cells(axes, np.ma.masked_invalid(values), extent, **colours))
        axes.set_title(name, loc="left", fontsize=11)
        _name_axes(axes, first.origin_mm, view)
    for axes, (_, one) in zip(panels, visits, strict=False):
        if one.ring_mm is not None:
            for colour, width in (("black", 3.0), ("white", 1.4)):
                axes.plot(*(one.ring_mm + first.origin_mm[:, None]), color=colour, linewidth=width)
    for image, beside, words in ((drawn[0], panels[:-1], label), (drawn[-1], panels[-1:], f"difference of {label}")):
        bar = panels[0].figure.colorbar(image, ax=list(beside), shrink=0.8, pad=0.01)
        bar.set_label(words, fontsize=8)
        bar.ax.tick_params(labelsize=7)


def _name_axes(axes: Axes, origin_mm: FloatArray, view: Orientation) -> None:
    """Name the axes and the edges; of a mass right of the xiphoid the mm are told to the patient's right."""
    words = (f"{view.right} from the mass (mm)", f"{view.up} from the mass (mm)")
    if view.notch is not None:
        side = "left"
        if origin_mm[0] < 0:
            side = "right"
            axes.xaxis.set_major_formatter(lambda value, _: f"{0.0 - value:g}")
        words = (f"to the patient's {side} of the xiphoid (mm)", "above the xiphoid (mm)")
    axes.set_xlabel(words[0], fontsize=8)
    axes.set_ylabel(words[1], fontsize=8)
    axes.tick_params(labelsize=7)
    draw_edges(axes, view)


def _draw_change(axes: Axes, compared: VisitComparison) -> None:
    axes.set_yticks([])
    joint = compared.joint
    if joint is None:
        axes.set_axis_off()
        return
    percent = 100.0 * np.expm1(joint.change(0, len(joint.log_size) - 1).log_ratio)
    low, high = np.nanquantile(percent, [0.001, 0.999])
    axes.hist(percent[(percent > low) & (percent < high)], bins=60, color="0.5")
    axes.axvline(0.0, color="black", linewidth=1.2)
    axes.set_xlabel("change of the diameter (%)", fontsize=9)
    axes.set_title("Posterior of the change", loc="left", fontsize=11)
