"""Drawings of the exam's page: map, dial, ruler, thumbnail."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record
from tactile_bayes.files.reports import EstimateReport, SmallestLump, centre_of
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.places import Orientation, orientation_of
from tactile_bayes.report.exam_words import ExamMap, ExamMass

# --- A clock face of the breast with the masses on it, as inline SVG: what charts of a breast exam show.

_RADIUS: Final = 13.0
_LEAST_MM: Final = 60.0  #: The face's rim is this far from the nipple, or as far as the farthest mass lies.


def breast_dial(masses: Sequence[ExamMass]) -> str:
    """Clock face as the examiner sees it who faces the patient; empty without a place about the nipple."""
    known = [(mass.number, mass.place) for mass in masses if mass.place is not None]
    if not known:
        return ""
    side, rim_mm = known[0][1].side, max(_LEAST_MM, *(1.1 * place.distance_mm for _, place in known))
    outer = ("R", "L")  # the patient's right is on the viewer's left
    parts = [f'<circle r="{_RADIUS}" fill="none" stroke="#111" stroke-width="0.4"/>', '<circle r="0.9" fill="#111"/>']
    for hour in range(1, 13):
        x, y = _on(hour * 30.0, _RADIUS)
        inner = _on(hour * 30.0, _RADIUS - (2.0 if hour % 3 == 0 else 1.0))
        parts.append(f'<path d="M{x:.2f} {y:.2f}L{inner[0]:.2f} {inner[1]:.2f}" stroke="#111" stroke-width="0.3"/>')
        if hour % 3 == 0:
            a, b = _on(hour * 30.0, _RADIUS + 2.4)
            parts.append(f'<text x="{a:.2f}" y="{b + 1:.2f}" text-anchor="middle" font-size="2.8">{hour}</text>')
    for number, place in known:
        x, y = _on(place.angle_deg, _RADIUS * place.distance_mm / rim_mm)
        parts.append(f'<circle class="lump" cx="{x:.2f}" cy="{y:.2f}" r="1.3" fill="#111"/>')
        if len(known) > 1:
            parts.append(f'<text x="{x + 1.8:.2f}" y="{y + 1:.2f}" font-size="2.8">{number}</text>')
    for letter, x in zip(outer, (-19.5, 19.5), strict=True):
        parts.append(f'<text x="{x}" y="1" text-anchor="middle" font-size="3" font-weight="600">{letter}</text>')
    label = f"Clock face of the {side} breast, rim {rim_mm:.0f} mm from the nipple"
    return (
        f'<svg class="dial" role="img" aria-label="{html.escape(label)}" viewBox="-22 -17.5 44 39" width="44mm" '
        f'height="39mm">{"".join(parts)}<text x="0" y="20.6" text-anchor="middle" font-size="2.8">'
        f"{html.escape(side)} breast, rim at {rim_mm:.0f} mm</text></svg>"
    )


def _on(angle_deg: float, radius: float) -> tuple[float, float]:
    """Point at an angle clockwise from the top, y downwards."""
    angle = math.radians(angle_deg)
    return radius * math.sin(angle), -radius * math.cos(angle)


# --- Intervals of a size on a scale in mm, as inline SVG.

_LENGTH_MM: Final = 70.0
_ROW_MM: Final = 7.5
_MOST_TICKS: Final = 8
_STEPS_MM: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def size_ruler(rows: Sequence[tuple[str, Quantity]]) -> str:
    """A bar for each interval with its median, the first the thickest, above a scale from 0 mm.

    A row is what an interval supposes, and the interval.
    """
    end = max(q.high for _, q in rows) * 1.08
    bottom = _ROW_MM * len(rows) + 1.5
    parts = [
        *(part for i, (words, q) in enumerate(rows) for part in _bar(i, words, q, _LENGTH_MM / end)),
        *_scale(end, bottom),
    ]
    box = f'viewBox="-2 -1 {_LENGTH_MM + 4:g} {bottom + 6:g}" width="{_LENGTH_MM + 4:g}mm" height="{bottom + 6:g}mm"'
    label = "Intervals of the largest diameter"
    return f'<svg class="ruler" role="img" aria-label="{label}" {box}>{"".join(parts)}</svg>'


def _bar(row: int, words: str, q: Quantity, scale: float) -> Iterator[str]:
    y, left, right = 4.0 + _ROW_MM * row, scale * q.low, scale * q.high
    middle = min(max((left + right) / 2, 12.0), _LENGTH_MM - 12.0)
    yield _ruler_text(middle, y - 1.7, words)
    yield f'<path d="M{left:.2f} {y:g}H{right:.2f}" stroke="#111" stroke-width="{1.6 / (1 + 0.6 * row):.2f}"/>'
    yield f'<path d="M{scale * q.median:.2f} {y - 1:g}v2" stroke="#111" stroke-width="0.7"/>'


def _scale(end_mm: float, y: float) -> Iterator[str]:
    longest = int(10 ** math.ceil(math.log10(end_mm / _MOST_TICKS))) if end_mm > _MOST_TICKS else 1
    step = next((one for one in _STEPS_MM if end_mm / one <= _MOST_TICKS), longest)
    yield f'<path d="M0 {y:g}H{_LENGTH_MM:g}" stroke="#111" stroke-width="0.25"/>'
    for tick in range(0, int(end_mm) + 1, step):
        x = _LENGTH_MM * tick / end_mm
        yield f'<path d="M{x:.2f} {y:g}v1" stroke="#111" stroke-width="0.25"/>'
        yield _ruler_text(x, y + 4, f"{tick}")
    yield _ruler_text(_LENGTH_MM - 1.5, y - 0.8, "mm")


def _ruler_text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.2f}" y="{y:g}" text-anchor="middle" font-size="2.7">{html.escape(text)}</text>'


# --- Colours of a map, and pixels as PNG.

# From low to high: five colours of viridis (van der Walt & Smith 2015), which also read in grey.
COLOURS: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))


def _coloured(values: FloatArray, limits: tuple[float, float], no_data: tuple[int, int, int]) -> NDArray[np.uint8]:
    """(n, m, 3) colours of values; cells without data are grey."""
    low, high = limits
    covered, colours = np.isfinite(values), np.array(COLOURS, dtype=float)
    at = np.clip((np.where(covered, values, low) - low) / (high - low), 0.0, 1.0) * (len(colours) - 1)
    mixed = np.stack([np.interp(at, np.arange(len(colours)), colours[:, i]) for i in range(3)], axis=-1)
    return np.where(covered[..., None], np.rint(mixed), np.array(no_data)).astype(np.uint8)


def _png(pixels: NDArray[np.uint8], *, colours: int) -> bytes:
    """PNG of pixels in a palette of so many colours."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).quantize(colours, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()


# --- A map as a small picture for a page of many: its values, and a ring where the lump was sized.

LONGEST_PX: Final = 300
_WIDEST_CELL_PX: Final = 3
_THUMB_NO_DATA: Final = (235, 235, 235)
_RING: Final = (255, 255, 255)
# Shares of the cells that the colours' ends leave outside, and the least span between the ends, of the middle value.
_ENDS: Final = (0.01, 0.995)
_THUMB_LEAST_SPAN: Final = 0.2


def thumbnail_png(tactile_map: TactileMap, report: EstimateReport) -> bytes | None:
    """PNG of a map of up to `LONGEST_PX` pixels a side, oriented as every picture of a map; None without data.

    Where its estimate has a size, an ellipse of that size is drawn.
    """
    if not tactile_map.covered.any():
        return None
    view = orientation_of(tactile_map)
    values = view.screen(np.where(tactile_map.covered, tactile_map.mean, np.nan))
    step = -(-max(values.shape) // LONGEST_PX)
    values = values[::step, ::step]
    scale = min(_WIDEST_CELL_PX, max(1, LONGEST_PX // max(values.shape)))
    low, high = np.quantile(values[np.isfinite(values)], _ENDS) if np.isfinite(values).any() else (0.0, 1.0)
    high = max(high, low + _THUMB_LEAST_SPAN * abs(low), low + 1e-12)
    pixels = _coloured(values, (low, high), _THUMB_NO_DATA).repeat(scale, axis=0).repeat(scale, axis=1)
    _draw_ring(pixels, tactile_map, view, report, px_per_cell=scale / step)
    return _png(pixels, colours=64)


def _draw_ring(
    pixels: NDArray[np.uint8], tactile_map: TactileMap, view: Orientation, report: EstimateReport, *, px_per_cell: float
) -> None:
    """Draw the ellipse of the estimated size at the estimated place."""
    if report.d_x_mm is None or report.d_y_mm is None or report.centre_mm is None:
        return
    angle_deg = 0.0 if report.angle_deg is None else report.angle_deg.median
    axes_mm = report.d_x_mm.median, report.d_y_mm.median
    outline = _outline(report.centre_mm.median, axes_mm, angle_deg, np.linspace(0.0, 2 * np.pi, 720))
    places = np.array([view.place(tactile_map, place) for place in outline])
    columns, rows = np.floor(places * px_per_cell).astype(int).T
    inside = (rows >= 0) & (rows < pixels.shape[0]) & (columns >= 0) & (columns < pixels.shape[1])
    pixels[rows[inside], columns[inside]] = _RING


def _outline(
    centre_mm: tuple[float, float], axes_mm: tuple[float, float], angle_deg: float, t: FloatArray
) -> list[tuple[float, float]]:
    """Points of an ellipse of these diameters, at angles `t` from its first axis."""
    angle, (u, v) = np.radians(angle_deg), (axes_mm[0] / 2 * np.cos(t), axes_mm[1] / 2 * np.sin(t))
    xs = centre_mm[0] + u * np.cos(angle) - v * np.sin(angle)
    ys = centre_mm[1] + u * np.sin(angle) + v * np.cos(angle)
    return list(zip(xs.tolist(), ys.tolist(), strict=True))


# --- A map as inline SVG: its values, the size ellipse and its interval to scale, sides, nipple, scale bar.

MARGIN_MM: Final = 5.0  #: Round the map, for the names of its sides.
_MOST_PIXELS: Final = 1200
_CELL_PX: Final = 4
_STRIPES_PX: Final = 8
_NO_DATA: Final = (222, 222, 222)
# The colours' ends: shares of the well-read cells outside, the least span of the level, amplitudes shown of a lump.

_LEAST_SPAN: Final = 0.35
_AMPLITUDES_SHOWN: Final = 1.25
_POINTS: Final = 72
_SCALE_BARS_MM: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
_LEAST_BAR_MM: Final = 8.0
_BAR_MM: Final = 40.0
_BAR_STEPS: Final = 40
_BARBS: Final = ((0.87, 0.5), (0.87, -0.5))


class Frame(Record, eq=False):
    """Where the map's points lie on the page, in mm from the picture's upper left corner without its margin."""

    tactile_map: TactileMap  #: The map that is drawn.
    scale: float  #: Of life size.

    @classmethod
    def within(cls, tactile_map: TactileMap, *, width_mm: float, height_mm: float) -> Frame:
        """Life size, or the largest that fits with its margin."""
        rows, columns = orientation_of(tactile_map).screen(tactile_map.count).shape
        cell = tactile_map.recipe.cell_mm
        room = (width_mm - 2 * MARGIN_MM) / (columns * cell), (height_mm - 2 * MARGIN_MM) / (rows * cell)
        return cls(tactile_map, min(1.0, *room))

    @property
    def view(self) -> Orientation:
        """Which way up the map is drawn."""
        return orientation_of(self.tactile_map)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the map on the page."""
        rows, columns = self.view.screen(self.tactile_map.count).shape
        cell = self.scale * self.tactile_map.recipe.cell_mm
        return columns * cell, rows * cell

    def at(self, centre_mm: tuple[float, float]) -> tuple[float, float]:
        """Place on the page of a point of the map's plane."""
        across, down = self.view.place(self.tactile_map, centre_mm)
        cell = self.scale * self.tactile_map.recipe.cell_mm
        return cell * across, cell * down


def _map_of(exam: ExamMap) -> TactileMap:
    """The map that a picture is of; what is drawn has one."""
    assert exam.tactile_map is not None
    return exam.tactile_map


def marked(exam: ExamMap) -> tuple[float, float] | None:
    """Place that the reason for no size is about, where no mass is drawn there; None without one."""
    return None if exam.masses else centre_of(exam.report.about_mm)


def colour_limits(exam: ExamMap) -> tuple[float, float]:
    """Values at the ends of the colours: a rib beside the lump does not take them all, noise alone is no lump."""
    tactile_map, report = _map_of(exam), exam.report
    well = tactile_map.covered & ~tactile_map.few
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    if not values.size:
        return 0.0, 1.0
    low, high = (float(end) for end in np.quantile(values, _ENDS))
    if report.amplitude is not None and report.background is not None:
        high = min(high, report.background.median + _AMPLITUDES_SHOWN * report.amplitude.median)
    return low, max(high, low + _LEAST_SPAN * abs(float(np.median(values))), low + 1e-9)


def exam_picture(exam: ExamMap, frame: Frame, *, label: str, small: bool = False) -> str:
    """Inline SVG of a map, one unit a mm on the page.

    `label` is for those who cannot see it; a `small` one has only the values, the ellipse and the sides.
    """
    (width, height), margin = frame.size_mm, 0.5 if small else MARGIN_MM
    whole = f"{width + 2 * margin:.2f}", f"{height + 2 * margin:.2f}"
    parts = [
        f'<svg class="map" role="img" aria-label="{html.escape(label)}" viewBox="{-margin:g} {-margin:g} {whole[0]} '
        f'{whole[1]}" width="{whole[0]}mm" height="{whole[1]}mm">',
        _cells(exam, frame),
        *_edges(frame, small=small),
        *(part for mass in exam.masses for part in _mass(mass, exam, frame, small=small)),
        *(() if small else _marks(exam, frame)),
        "</svg>",
    ]
    return "".join(parts)


def small_pictures(maps: Sequence[ExamMap], *, room_mm: tuple[float, float]) -> list[str]:
    """Small pictures of repeat maps, all to one scale, by which each has room in a width and a height."""
    sizes = [Frame(_map_of(one), 1.0).size_mm for one in maps]
    scale = min(1.0, *(room / size for one in sizes for room, size in zip(room_mm, one, strict=True)))
    frames = [Frame(_map_of(one), scale) for one in maps]
    return [
        exam_picture(one, frame, label=f"Repeat map {number}", small=True)
        for number, (one, frame) in enumerate(zip(maps, frames, strict=True), start=1)
    ]


def colour_bar(exam: ExamMap) -> str:
    """Inline SVG of the colours with the values at their ends."""
    low, high = colour_limits(exam)
    tactile_map = _map_of(exam)
    covered = tactile_map.covered
    more = " or more" if covered.any() and float(tactile_map.mean[covered].max()) > high else ""
    steps = _coloured(np.linspace(0.0, 1.0, _BAR_STEPS)[None], (0.0, 1.0), _NO_DATA)[0]
    width = _BAR_MM / _BAR_STEPS  # plain boxes: not every printer of SVG knows gradients
    boxes = "".join(
        f'<rect x="{14 + width * i:g}" y="0.5" width="{width + 0.05:g}" height="3" fill="#{bytes(colour).hex()}"/>'
        for i, colour in enumerate(steps)
    )
    words = html.escape(tactile_map.recipe.value_words)
    return (
        '<svg class="bar" role="img" aria-label="Colours of the map" viewBox="0 0 80 8.5" width="80mm" height="8.5mm">'
        f'{boxes}<rect x="14" y="0.5" width="{_BAR_MM:g}" height="3" fill="none" stroke="#333" stroke-width="0.15"/>'
        f'<text x="13" y="3.2" text-anchor="end" font-size="3">{_value(low)}</text>'
        f'<text x="55" y="3.2" font-size="3">{_value(high)}{more}</text>'
        f'<text x="14" y="7.4" font-size="3">{words}</text></svg>'
    )


def _value(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.0f}"


def _cells(exam: ExamMap, frame: Frame) -> str:
    """The map's values as an embedded PNG; cells with few readings are striped, those without any are grey."""
    tactile_map, (width, height) = frame.tactile_map, frame.size_mm
    values = frame.view.screen(np.where(tactile_map.covered, tactile_map.mean, np.nan))
    step = -(-max(values.shape) // _MOST_PIXELS)
    pixels = _coloured(values[::step, ::step], colour_limits(exam), _NO_DATA)
    times = max(1, min(_CELL_PX, _MOST_PIXELS // max(pixels.shape[:2])))
    pixels = pixels.repeat(times, axis=0).repeat(times, axis=1)
    few = frame.view.screen(tactile_map.few)[::step, ::step].repeat(times, axis=0).repeat(times, axis=1)
    rows, columns = np.indices(few.shape)
    pixels[few & ((rows + columns) % _STRIPES_PX < _STRIPES_PX // 4)] = 255
    data = base64.b64encode(_png(pixels, colours=128)).decode("ascii")
    box = f'x="0" y="0" width="{width:.2f}" height="{height:.2f}"'
    return (
        f'<image {box} preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
        f'<rect {box} fill="none" stroke="#333" stroke-width="0.3"/>'
    )


def _edges(frame: Frame, *, small: bool) -> Iterator[str]:
    """Names of the picture's sides: the patient's, or the plane's axes; within it on a small picture."""
    (width, height), out = frame.size_mm, -1.7 if small else MARGIN_MM / 2
    places = {
        "left": (-out, height / 2),
        "right": (width + out, height / 2),
        "top": (width / 2, -out),
        "bottom": (width / 2, height + out),
    }
    for side, name in frame.view.edges.items():
        x, y = places[side]
        if small:
            yield _text(x, y + 0.9, name, size=2.5)
            continue
        yield (
            f'<text class="edge" data-side="{side}" x="{x:.2f}" y="{y + 1.5:.2f}" text-anchor="middle" '
            f'font-size="4.2" font-weight="600">{html.escape(name)}</text>'
        )


def _mass(mass: ExamMass, exam: ExamMap, frame: Frame, *, small: bool) -> Iterator[str]:
    """The ellipse of the size, those of its interval's ends, a cross at the centre; numbers where there are several."""
    (x, y), arm = frame.at(mass.centre_mm), 0.6 if small else 1.6
    if mass.axes_mm is not None and mass.largest is not None:
        ends = {"low": mass.largest.low, "high": mass.largest.high}
        for end, size in () if small else ends.items():
            outline = _ellipse(mass, size / mass.largest.median, frame)
            yield _stroked(outline, 0.3, kind=f"size-{end}", dash="1.2 0.9")
        yield _stroked(_ellipse(mass, 1.0, frame), 0.3 if small else 0.55, kind="size")
    yield _stroked(f"M{x - arm:.2f} {y:.2f}h{2 * arm:g}M{x:.2f} {y - arm:.2f}v{2 * arm:g}", 0.25 * arm, kind="centre")
    if not small and len(exam.masses) > 1:
        above = 0.0 if mass.largest is None else frame.scale * mass.largest.high / 2
        yield _text(x, y - above - 1.5, f"{mass.number}", size=4.2)


def _ellipse(mass: ExamMass, times: float, frame: Frame) -> str:
    """Path of the mass's ellipse, its diameters multiplied."""
    assert mass.axes_mm is not None
    t = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False)
    along, across = (times * axis for axis in mass.axes_mm)
    places = [frame.at(place) for place in _outline(mass.centre_mm, (along, across), mass.angle_deg, t)]
    return "M" + "L".join(f"{a:.2f} {b:.2f}" for a, b in places) + "Z"


def _stroked(path: str, width: float, *, kind: str, dash: str = "") -> str:
    """A white line with a black edge, visible on every colour and in grey."""
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    under = f'<path d="{path}" fill="none" stroke="#000" stroke-width="{width + min(0.5, width):g}"/>'
    return f'{under}<path class="{kind}" d="{path}" fill="none" stroke="#fff" stroke-width="{width:g}"{dashed}/>'


def _text(x: float, y: float, text: str, *, size: float, anchor: str = "middle") -> str:
    """White text with a black edge."""
    place = f'x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}" font-size="{size:g}" font-weight="600"'
    words = html.escape(text)
    under = f'<text {place} fill="none" stroke="#000" stroke-width="{0.2 * size:g}" aria-hidden="true">{words}</text>'
    return f'{under}<text {place} fill="#fff">{words}</text>'


def _marks(exam: ExamMap, frame: Frame) -> Iterator[str]:
    """Scale bar, nipple, direction of the sternal notch, and the place that a reason for no size is about."""
    width, height = frame.size_mm
    length = next((one for one in _SCALE_BARS_MM if frame.scale * one >= _LEAST_BAR_MM), _SCALE_BARS_MM[-1])
    yield _stroked(f"M4 {height - 4:.2f}h{frame.scale * length:.2f}", 0.9, kind="scale")
    yield _text(4 + frame.scale * length / 2, height - 5.6, f"{length:g} mm", size=3.2)
    place = marked(exam)
    if place is not None:
        x, y = frame.at(place)
        yield _stroked(f"M{x - 1.5:.2f} {y - 1.5:.2f}l3 3m0 -3l-3 3", 0.4, kind="meant")
    nipple = frame.tactile_map.nipple_mm
    if nipple is not None:
        yield from _nipple((float(nipple[0]), float(nipple[1])), frame)
    if frame.view.notch is not None:
        right, up = frame.view.notch
        x, y = width - 8.0, height - 4.0
        tip = (x + 7 * right, y - 7 * up)
        head = [(tip[0] - 2.2 * (right * c - up * s), tip[1] + 2.2 * (up * c + right * s)) for c, s in _BARBS]
        barbs = "".join(f"M{tip[0]:.2f} {tip[1]:.2f}L{a:.2f} {b:.2f}" for a, b in head)
        yield _stroked(f"M{x:.2f} {y:.2f}L{tip[0]:.2f} {tip[1]:.2f}{barbs}", 0.5, kind="notch")
        yield _text(x, y - 9.0, "to notch", size=3.0)


def _nipple(centre_mm: tuple[float, float], frame: Frame) -> Iterator[str]:
    """A ring at the nipple; where it lies off the map, a wedge at the edge that points to it."""
    (x, y), (width, height) = frame.at(centre_mm), frame.size_mm
    if 0 <= x <= width and 0 <= y <= height:
        yield _stroked(_ring(x, y, 2.6) + _ring(x, y, 0.7), 0.45, kind="nipple")
        yield _text(x, y + 6.2, "nipple", size=3.0)
        return
    edge = (min(max(x, 2.5), width - 2.5), min(max(y, 2.5), height - 2.5))
    away = float(np.hypot(x - edge[0], y - edge[1]))
    right, down = (x - edge[0]) / away, (y - edge[1]) / away
    tip = (edge[0] + 2 * right, edge[1] + 2 * down)
    base = [(edge[0] - 1.4 * s * down, edge[1] + 1.4 * s * right) for s in (1, -1)]
    corners = "L".join(f"{a:.2f} {b:.2f}" for a, b in (tip, *base))
    yield _stroked(f"M{corners}Z", 0.45, kind="nipple-off")
    anchor = "start" if right < -0.5 else "end" if right > 0.5 else "middle"
    words = f"nipple, {away / frame.scale:.0f} mm"
    yield _text(edge[0] - 3.2 * right, edge[1] - 4.2 * down + 1.0, words, size=3.0, anchor=anchor)


def _ring(x: float, y: float, radius: float) -> str:
    arc = f"a{radius:g} {radius:g} 0 1 0"
    return f"M{x - radius:.2f} {y:.2f}{arc} {2 * radius:g} 0{arc} {-2 * radius:g} 0"


# --- The smallest lump that a map would have shown, as small inline SVG maps: one a depth, a number at each place.

_ROOM_MM: Final = (34.0, 30.0)
_SHADES: Final = ((10.0, "#ffffff"), (15.0, "#e0e0e0"), (20.0, "#bdbdbd"), (np.inf, "#8f8f8f"))
"""Grey of a place by the diameter in mm below which it lies: darker where only larger lumps show."""


def smallest_pictures(tactile_map: TactileMap, smallest: SmallestLump) -> Iterator[str]:
    """One picture a depth, with its caption."""
    frame = Frame.within(tactile_map, width_mm=_ROOM_MM[0], height_mm=_ROOM_MM[1])
    for number, depth in enumerate(smallest.depths_mm):
        caption = f"{depth:g} mm deep"
        yield f"<figure>{_picture(frame, smallest, number, caption)}<figcaption>{caption}</figcaption></figure>"


def _picture(frame: Frame, smallest: SmallestLump, number: int, caption: str) -> str:
    (width, height), side = frame.size_mm, frame.scale * smallest.spacing_mm
    label = html.escape(f"Smallest lump that would have shown, {caption}")
    parts = [
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {width:.2f} {height:.2f}" width="{width:.2f}mm" '
        f'height="{height:.2f}mm"><rect width="{width:.2f}" height="{height:.2f}" fill="#fff" stroke="#333" '
        'stroke-width="0.3"/>'
    ]
    for one in smallest.places:
        (x, y), d = frame.at((one.x_mm, one.y_mm)), one.d_mm[number]
        shade = next(grey for most, grey in _SHADES if (np.inf if d is None else d) <= most)
        box = f'x="{x - side / 2:.2f}" y="{y - side / 2:.2f}" width="{side:.2f}" height="{side:.2f}"'
        text = "–" if d is None else f"{np.ceil(d):.0f}"
        parts.append(f'<rect {box} fill="{shade}" stroke="#777" stroke-width="0.1"/>')
        parts.append(f'<text x="{x:.2f}" y="{y + 0.9:.2f}" text-anchor="middle" font-size="2.6">{text}</text>')
    return "".join([*parts, "</svg>"])
