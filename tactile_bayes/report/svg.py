"""Drawings of the exam's page: map, dial, ruler, thumbnail."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.declarations import Record, replace
from tactile_bayes.files.reports import SmallestLump, centre_of
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import Orientation, TactileMap, orientation_of
from tactile_bayes.presets import VIRIDIS
from tactile_bayes.report.exam_words import ExamMap, ExamMass
from tactile_bayes.report.map import AMPLITUDES_SHOWN

# --- Parts of all drawings: lengths are mm, x to the right and y downwards.


def drawing(kind: str, label: str, box: tuple[float, float, float, float], parts: Iterable[str]) -> str:
    """Inline SVG of a class; `label` is for those who cannot see it, `box` its left, top, width and height."""
    left, top, width, height = (f"{one:.2f}" for one in box)
    return (
        f'<svg class="{kind}" role="img" aria-label="{html.escape(label)}" viewBox="{left} {top} {width} {height}" '
        f'width="{width}mm" height="{height}mm">{"".join(parts)}</svg>'
    )


def line(path: str, width: float) -> str:
    """A black line."""
    return f'<path d="{path}" stroke="#111" stroke-width="{width:g}" fill="none"/>'


def text(x: float, y: float, words: str, *, size: float = 2.7, anchor: str = "middle", more: str = "") -> str:
    """Text, with more attributes."""
    place = f'x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}" font-size="{size:g}"'
    return f"<text {place}{more}>{html.escape(words)}</text>"


def through(points: Iterable[tuple[float, float]]) -> str:
    """Path through points."""
    return "M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in points)


def stroked(path: str, width: float, *, kind: str, dash: str = "") -> str:
    """A white line with a black edge, visible on every colour and in grey."""
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    under = f'<path d="{path}" fill="none" stroke="#000" stroke-width="{width + min(0.5, width):g}"/>'
    return f'{under}<path class="{kind}" d="{path}" fill="none" stroke="#fff" stroke-width="{width:g}"{dashed}/>'


def outlined_text(x: float, y: float, words: str, *, size: float, anchor: str = "middle") -> str:
    """White text with a black edge."""
    edge = f' font-weight="600" fill="none" stroke="#000" stroke-width="{0.2 * size:g}" aria-hidden="true"'
    under = text(x, y, words, size=size, anchor=anchor, more=edge)
    return under + text(x, y, words, size=size, anchor=anchor, more=' font-weight="600" fill="#fff"')


# --- A clock face of the breast with the masses on it, as inline SVG: what charts of a breast exam show.

_RADIUS: Final = 13.0
_LEAST_MM: Final = 60.0  #: The face's rim is this far from the nipple, or as far as the farthest mass lies.


def breast_dial(masses: Sequence[ExamMass]) -> str:
    """Clock face as the examiner sees it who faces the patient; empty without a place about the nipple."""
    known = [(mass.number, mass.place) for mass in masses if mass.place is not None]
    if not known:
        return ""
    side, rim_mm = known[0][1].side, max(_LEAST_MM, *(1.1 * place.distance_mm for _, place in known))
    parts = [f'<circle r="{_RADIUS}" fill="none" stroke="#111" stroke-width="0.4"/>', '<circle r="0.9" fill="#111"/>']
    for hour in range(1, 13):
        x, y = _dial_point(hour * 30.0, _RADIUS)
        inner = _dial_point(hour * 30.0, _RADIUS - (2.0 if hour % 3 == 0 else 1.0))
        parts.append(line(through([(x, y), inner]), 0.3))
        if hour % 3 == 0:
            a, b = _dial_point(hour * 30.0, _RADIUS + 2.4)
            parts.append(text(a, b + 1, f"{hour}", size=2.8))
    for number, place in known:
        x, y = _dial_point(place.angle_deg, _RADIUS * place.distance_mm / rim_mm)
        parts.append(f'<circle class="lump" cx="{x:.2f}" cy="{y:.2f}" r="1.3" fill="#111"/>')
        if len(known) > 1:
            parts.append(text(x + 1.8, y + 1, f"{number}", size=2.8, anchor="start"))
    for letter, x in (("R", -19.5), ("L", 19.5)):  # the patient's right is on the viewer's left
        parts.append(text(x, 1.0, letter, size=3, more=' font-weight="600"'))
    parts.append(text(0.0, 20.6, f"{side} breast, rim at {rim_mm:.0f} mm", size=2.8))
    label = f"Clock face of the {side} breast, rim {rim_mm:.0f} mm from the nipple"
    return drawing("dial", label, (-22.0, -17.5, 44.0, 39.0), parts)


def _dial_point(angle_deg: float, radius: float) -> tuple[float, float]:
    """Point at an angle clockwise from the top, y downwards."""
    angle = math.radians(angle_deg)
    return radius * math.sin(angle), -radius * math.cos(angle)


# --- Intervals on a scale, as inline SVG.

_LENGTH_MM: Final = 70.0
_ROW_MM: Final = 7.5
_MOST_TICKS: Final = 8
STEPS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def size_ruler(
    rows: Sequence[tuple[str, Quantity]], *, unit: str = "mm", label: str = "Intervals of the largest diameter"
) -> str:
    """A bar for each interval with its median, the first the thickest, above a scale that holds 0; empty without rows.

    A row is what an interval supposes, and the interval.
    """
    if not rows:
        return ""
    start, end = min(0.0, *(1.08 * q.low for _, q in rows)), max(0.0, *(1.08 * q.high for _, q in rows))
    scale, bottom = _LENGTH_MM / (end - start), _ROW_MM * len(rows) + 1.5
    parts = [line(f"M{-scale * start:.2f} 0V{bottom:g}", 0.25)] if start < 0.0 else []
    for row, (words, q) in enumerate(rows):
        y, left, right = 4.0 + _ROW_MM * row, scale * (q.low - start), scale * (q.high - start)
        half = 0.65 * len(words)
        middle = min(max((left + right) / 2, half), _LENGTH_MM - half)
        parts.append(text(middle, y - 1.7, words, more=' stroke="#fff" stroke-width="0.8" paint-order="stroke"'))
        parts.append(line(f"M{left:.2f} {y:g}H{right:.2f}", round(1.6 / (1 + 0.6 * row), 2)))
        parts.append(line(f"M{scale * (q.median - start):.2f} {y - 1:g}v2", 0.7))
    parts += _scale(start, end, bottom, unit)
    return drawing("ruler", label, (-4.0, -1.0, _LENGTH_MM + 8, bottom + 6), parts)


def _scale(start: float, end: float, y: float, unit: str) -> Iterator[str]:
    span = end - start
    longest = int(10 ** math.ceil(math.log10(span / _MOST_TICKS))) if span > _MOST_TICKS else 1
    step = next((one for one in STEPS if span / one <= _MOST_TICKS), longest)
    yield line(f"M0 {y:g}H{_LENGTH_MM:g}", 0.25)
    for tick in range(math.ceil(start / step) * step, int(end) + 1, step):
        x = _LENGTH_MM * (tick - start) / span
        yield line(f"M{x:.2f} {y:g}v1", 0.25)
        yield text(x, y + 4, f"{tick:+d}" if start < 0 and tick else f"{tick}")
    yield text(_LENGTH_MM - 1.5, y - 0.8, unit)


# --- Colours of a map, and pixels as PNG.


def _coloured(values: FloatArray, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """(n, m, 3) colours of values; cells without data are grey."""
    low, high = limits
    covered, colours = np.isfinite(values), np.array(VIRIDIS, dtype=float)
    share = np.clip((np.where(covered, values, low) - low) / (high - low), 0.0, 1.0)
    position = np.rint(share * _COLOUR_STEPS) / _COLOUR_STEPS * (len(colours) - 1)
    mixed = np.stack([np.interp(position, np.arange(len(colours)), colours[:, i]) for i in range(3)], axis=-1)
    return np.where(covered[..., None], np.rint(mixed), np.array(_NO_DATA)).astype(np.uint8)


def ellipse_mm(axes_mm: tuple[float, float], angle_deg: float) -> FloatArray:
    """(2, n) x and y about the centre of an ellipse of these diameters, its first axis at the angle from x to y."""
    t, angle = np.linspace(0.0, 2 * np.pi, _POINTS), np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(turn @ (np.reshape(axes_mm, (2, 1)) / 2 * np.stack([np.cos(t), np.sin(t)])))


def spread_limits(values: FloatArray, most: float = np.inf) -> tuple[float, float]:
    """Values at the ends of the colours, the upper one `most` at most; noise alone does not look like a lump."""
    if not values.size:
        return 0.0, 1.0
    low, high = (float(end) for end in np.quantile(values, _ENDS))
    return low, max(min(high, most), low + _LEAST_SPAN * abs(float(np.median(values))), low + 1e-9)


# --- A map as SVG: its values, the size ellipse and its interval to scale, sides, nipple, scale bar.

MARGIN_MM: Final = 5.0  #: Round the map, for the names of its sides.
_MOST_PIXELS: Final = 1200
_CELL_PX: Final = 4
_STRIPES_PX: Final = 8
_NO_DATA: Final = (222, 222, 222)
# The colours' ends: shares of the well-read cells outside, and the least span of the level.
_ENDS: Final = (0.01, 0.995)
_LEAST_SPAN: Final = 0.35
_POINTS: Final = 73
_SCALE_BARS_MM: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
_BAR_MM: Final = 40.0
_BAR_STEPS: Final = 40
_COLOUR_STEPS: Final = 3 * (_BAR_STEPS - 1)  #: With grey and white few enough that a PNG's palette has each as it is.
_BARBS: Final = ((0.87, 0.5), (0.87, -0.5))

THUMB_SCALE: Final = 0.4  #: Of life size, of thumbnails.
THUMB_ENDS: Final = (0.85, 1.45)  #: Values at the ends of their colours, in parts of the level beside the lump.
_THUMB_ROOM_MM: Final = 48.0


class Frame(Record, eq=False):
    """Where the map's points lie on the page, in mm from the picture's upper left corner without its margin."""

    tactile_map: TactileMap  #: The map that is drawn.
    scale: float  #: Of life size.

    @classmethod
    def within(cls, tactile_map: TactileMap, *, width_mm: float, height_mm: float) -> Frame:
        """Life size, or the largest that fits with its margin."""
        width, height = cls(tactile_map, 1.0).size_mm
        return cls(tactile_map, min(1.0, (width_mm - 2 * MARGIN_MM) / width, (height_mm - 2 * MARGIN_MM) / height))

    @property
    def view(self) -> Orientation:
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


def marked_place(exam: ExamMap) -> tuple[float, float] | None:
    """Place that the reason for no size is about, where no mass is drawn there; None without one."""
    return None if exam.masses else centre_of(exam.report.about_mm)


def colour_limits(exam: ExamMap) -> tuple[float, float]:
    """Values at the ends of a map's colours: a rib beside the lump does not take them all."""
    tactile_map, report = _map_of(exam), exam.report
    well = tactile_map.covered & ~tactile_map.few
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    if report.amplitude is None or report.background is None:
        return spread_limits(values)
    return spread_limits(values, report.background.median + AMPLITUDES_SHOWN * report.amplitude.median)


def exam_picture(
    exam: ExamMap, frame: Frame, *, label: str, small: bool = False, limits: tuple[float, float] | None = None
) -> str:
    """SVG of a map, one unit a mm on the page.

    `label` is for those who cannot see it; a `small` one has only the values, the ellipse, the sides and a scale bar;
    `limits`: values at the ends of the colours, by default those of `colour_limits`.
    """
    (width, height), margin = frame.size_mm, 0.5 if small else MARGIN_MM
    parts = [_cells(frame, limits or colour_limits(exam), small=small)]
    parts += edge_names(frame.view, frame.size_mm, small=small)
    for mass in exam.masses:
        parts += _draw_mass(mass, exam, frame, small=small)
    if small:
        parts += scale_bar(height, frame.scale, least_mm=3.0, inset=1.5, size=2.2)
    else:
        parts += [*scale_bar(height, frame.scale, least_mm=8.0, inset=4.0, size=3.2), *_landmarks(exam, frame)]
    return drawing("map", label, (-margin, -margin, width + 2 * margin, height + 2 * margin), parts)


def thumbnail_svg(exam: ExamMap, *, label: str) -> str:
    """A map as a small SVG file, for a page of many: all to one scale, and in one range of colours.

    A map that has no room at that scale is drawn smaller, as its scale bar shows. Of several masses the reported one
    alone has its ellipse.
    """
    tactile_map, report = _map_of(exam), exam.report
    scale = min(THUMB_SCALE, _THUMB_ROOM_MM / max(Frame(tactile_map, 1.0).size_mm))
    level = float(np.median(tactile_map.mean[tactile_map.covered]))
    if report.background is not None and report.max_size_mm is not None:
        level = report.background.median
    low, high = sorted(level * end for end in THUMB_ENDS)
    drawn = exam_picture(
        replace(exam, masses=() if report.centre_mm is None else exam.masses[:1]),
        Frame(tactile_map, scale),
        label=label,
        small=True,
        limits=(low, max(high, low + 1e-9)),
    )
    first = '<svg xmlns="http://www.w3.org/2000/svg" font-family="sans-serif"'
    return drawn.replace("<svg", first, 1).replace("<image ", '<image style="image-rendering:pixelated" ')


def small_pictures(maps: Sequence[ExamMap], *, room_mm: tuple[float, float]) -> list[str]:
    """Small pictures of repeat maps, all to one scale, by which each has room in a width and a height."""
    sizes = [Frame(_map_of(one), 1.0).size_mm for one in maps]
    scale = min(1.0, *(room / size for one in sizes for room, size in zip(room_mm, one, strict=True)))
    return [
        exam_picture(one, Frame(_map_of(one), scale), label=f"Repeat map {number}", small=True)
        for number, one in enumerate(maps, start=1)
    ]


def colour_bar(exam: ExamMap) -> str:
    """Inline SVG of the colours with the values at their ends."""
    limits, tactile_map = colour_limits(exam), _map_of(exam)
    more = bool((tactile_map.mean[tactile_map.covered] > limits[1]).any())
    return colour_steps(limits, tactile_map.recipe.value_words, more=more)


def colour_steps(limits: tuple[float, float], words: str, *, more: bool) -> str:
    """Inline SVG of the colours, with the values at their ends and what they are of; `more`: some lie above."""
    low, high = (f"{limit:.2f}" if abs(limit) < 100 else f"{limit:.0f}" for limit in limits)
    width = _BAR_MM / _BAR_STEPS  # plain boxes: not every printer of SVG knows gradients
    parts = [
        f'<rect x="{14 + width * i:g}" y="0.5" width="{width + 0.05:g}" height="3" fill="#{bytes(colour).hex()}"/>'
        for i, colour in enumerate(_coloured(np.linspace(0.0, 1.0, _BAR_STEPS)[None], (0.0, 1.0))[0])
    ]
    parts += [
        f'<rect x="14" y="0.5" width="{_BAR_MM:g}" height="3" fill="none" stroke="#333" stroke-width="0.15"/>',
        text(13.0, 3.2, low, size=3, anchor="end"),
        text(55.0, 3.2, f"{high}{' or more' if more else ''}", size=3, anchor="start"),
        text(14.0, 7.4, words, size=3, anchor="start"),
    ]
    return drawing("bar", "Colours of the map", (0.0, 0.0, 80.0, 8.5), parts)


def _cells(frame: Frame, limits: tuple[float, float], *, small: bool) -> str:
    """The map's values as an embedded PNG; cells without readings are grey, those with few striped, or grey too."""
    tactile_map, (width, height) = frame.tactile_map, frame.size_mm
    shown = tactile_map.covered & ~tactile_map.few if small else tactile_map.covered
    values = frame.view.screen(np.where(shown, tactile_map.mean, np.nan))
    step = -(-max(values.shape) // _MOST_PIXELS)
    pixels = _coloured(values[::step, ::step], limits)
    if small:
        return _image(pixels, (width, height))
    times = max(1, min(_CELL_PX, _MOST_PIXELS // max(pixels.shape[:2])))
    pixels = pixels.repeat(times, axis=0).repeat(times, axis=1)
    few = frame.view.screen(tactile_map.few)[::step, ::step].repeat(times, axis=0).repeat(times, axis=1)
    rows, columns = np.indices(few.shape)
    pixels[few & ((rows + columns) % _STRIPES_PX < _STRIPES_PX // 4)] = 255
    return _image(pixels, (width, height))


def picture_of(values: FloatArray, limits: tuple[float, float], size_mm: tuple[float, float]) -> str:
    """Values, as the rows of a picture, in colours; places without data are grey."""
    return _image(_coloured(values, limits).repeat(_CELL_PX, axis=0).repeat(_CELL_PX, axis=1), size_mm)


def _image(pixels: NDArray[np.uint8], size_mm: tuple[float, float]) -> str:
    """Pixels as an embedded PNG of a few colours, with a frame."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).quantize(128, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    data = base64.b64encode(out.getvalue()).decode("ascii")
    box = f'x="0" y="0" width="{size_mm[0]:.2f}" height="{size_mm[1]:.2f}"'
    return (
        f'<image {box} preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
        f'<rect {box} fill="none" stroke="#333" stroke-width="0.3"/>'
    )


def edge_names(view: Orientation, size_mm: tuple[float, float], *, small: bool) -> Iterator[str]:
    """Names of a picture's sides: the patient's, or the plane's axes; within it on a small picture."""
    (width, height), out = size_mm, -1.7 if small else MARGIN_MM / 2
    places = {
        "left": (-out, height / 2),
        "right": (width + out, height / 2),
        "top": (width / 2, -out),
        "bottom": (width / 2, height + out),
    }
    for side, name in view.edges.items():
        x, y = places[side]
        if small:
            yield outlined_text(x, y + 0.9, name, size=2.5)
        else:
            size = 4.2 if len(name) == 1 else 3.2  # as wide as the margin
            yield text(x, y + 1.5, name, size=size, more=f' font-weight="600" class="edge" data-side="{side}"')


def scale_bar(height: float, scale: float, *, least_mm: float, inset: float, size: float) -> Iterator[str]:
    """A round length that is so long on the page at least, at the lower left corner of a picture, with its words."""
    length = next((one for one in _SCALE_BARS_MM if scale * one >= least_mm), _SCALE_BARS_MM[-1])
    yield stroked(f"M{inset:g} {height - inset:.2f}h{scale * length:.2f}", 0.28 * size, kind="scale")
    middle = inset + scale * length / 2
    yield outlined_text(max(middle, 1.6 * size), height - inset - 0.5 * size, f"{length:g} mm", size=size)


def _draw_mass(mass: ExamMass, exam: ExamMap, frame: Frame, *, small: bool) -> Iterator[str]:
    """The ellipse of the size, those of its interval's ends, a cross at the centre; numbers where there are several."""
    (x, y), arm = frame.at(mass.centre_mm), 0.6 if small else 1.6
    if mass.axes_mm is not None and mass.largest is not None:
        ends = {"low": mass.largest.low, "high": mass.largest.high}
        for end, size in () if small else ends.items():
            yield stroked(_ellipse(mass, size / mass.largest.median, frame), 0.3, kind=f"size-{end}", dash="1.2 0.9")
        yield stroked(_ellipse(mass, 1.0, frame), 0.3 if small else 0.55, kind="size")
    yield stroked(f"M{x - arm:.2f} {y:.2f}h{2 * arm:g}M{x:.2f} {y - arm:.2f}v{2 * arm:g}", 0.25 * arm, kind="centre")
    if not small and len(exam.masses) > 1:
        above = 0.0 if mass.largest is None else frame.scale * mass.largest.high / 2
        yield outlined_text(x, y - above - 1.5, f"{mass.number}", size=4.2)


def _ellipse(mass: ExamMass, times: float, frame: Frame) -> str:
    assert mass.axes_mm is not None
    along, across = mass.axes_mm
    around = ellipse_mm((times * along, times * across), mass.angle_deg) + np.reshape(mass.centre_mm, (2, 1))
    return through(frame.at((x, y)) for x, y in around.T.tolist()) + "Z"


def _landmarks(exam: ExamMap, frame: Frame) -> Iterator[str]:
    """Nipple, direction of the sternal notch, and the place that a reason for no size is about."""
    width, height = frame.size_mm
    place = marked_place(exam)
    if place is not None:
        x, y = frame.at(place)
        yield stroked(f"M{x - 1.5:.2f} {y - 1.5:.2f}l3 3m0 -3l-3 3", 0.4, kind="meant")
    nipple = frame.tactile_map.nipple_mm
    if nipple is not None:
        yield from _nipple((float(nipple[0]), float(nipple[1])), frame)
    if frame.view.notch is not None:
        right, up = frame.view.notch
        x, y = width - 8.0, height - 4.0
        tip = (x + 7 * right, y - 7 * up)
        head = [(tip[0] - 2.2 * (right * c - up * s), tip[1] + 2.2 * (up * c + right * s)) for c, s in _BARBS]
        yield stroked("".join(through([end, tip]) for end in [(x, y), *head]), 0.5, kind="notch")
        yield outlined_text(x, y - 9.0, "to notch", size=3.0)


def _nipple(centre_mm: tuple[float, float], frame: Frame) -> Iterator[str]:
    """A ring at the nipple; where it lies off the map, a wedge at the edge that points to it."""
    (x, y), (width, height) = frame.at(centre_mm), frame.size_mm
    if 0 <= x <= width and 0 <= y <= height:
        yield stroked(_ring(x, y, 2.6) + _ring(x, y, 0.7), 0.45, kind="nipple")
        below = 6.2 if y < height - 16.0 else -3.6  # not over the scale bar
        yield outlined_text(x, y + below, "nipple", size=3.0)
        return
    edge = (min(max(x, 2.5), width - 2.5), min(max(y, 2.5), height - 2.5))
    away = float(np.hypot(x - edge[0], y - edge[1]))
    right, down = (x - edge[0]) / away, (y - edge[1]) / away
    tip = (edge[0] + 2 * right, edge[1] + 2 * down)
    base = [(edge[0] - 1.4 * s * down, edge[1] + 1.4 * s * right) for s in (1, -1)]
    yield stroked(through([tip, *base]) + "Z", 0.45, kind="nipple-off")
    anchor = "start" if right < -0.5 else "end" if right > 0.5 else "middle"
    words = f"nipple, {away / frame.scale:.0f} mm"
    yield outlined_text(edge[0] - 3.2 * right, edge[1] - 4.2 * down + 1.0, words, size=3.0, anchor=anchor)


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
    (width, height), side = frame.size_mm, frame.scale * smallest.spacing_mm
    for number, depth in enumerate(smallest.depths_mm):
        parts = [f'<rect width="{width:.2f}" height="{height:.2f}" fill="#fff" stroke="#333" stroke-width="0.3"/>']
        for place in smallest.places:
            (x, y), d = frame.at((place.x_mm, place.y_mm)), place.d_mm[number]
            shade = next(grey for most, grey in _SHADES if (np.inf if d is None else d) <= most)
            box = f'x="{x - side / 2:.2f}" y="{y - side / 2:.2f}" width="{side:.2f}" height="{side:.2f}"'
            parts.append(f'<rect {box} fill="{shade}" stroke="#777" stroke-width="0.1"/>')
            parts.append(text(x, y + 0.9, "–" if d is None else f"{np.ceil(d):.0f}", size=2.6))
        caption = f"{depth:g} mm deep"
        label = f"Smallest lump that would have shown, {caption}"
        drawn = drawing("smallest", label, (-0.2, -0.2, width + 0.4, height + 0.4), parts)
        yield f"<figure>{drawn}<figcaption>{caption}</figcaption></figure>"
