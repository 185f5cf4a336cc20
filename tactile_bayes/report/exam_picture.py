"""A map as inline SVG in mm: its values, the size ellipse and its interval to scale, sides, nipple, scale bar."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.orientation import Orientation, orientation_of
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.report.exam import ExamMap, ExamMass

# From low to high: five colours of viridis (van der Walt & Smith 2015), which also read in grey.
COLOURS: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
MARGIN_MM: Final = 5.0
"""Round the map, for the names of its sides."""
_MOST_PIXELS: Final = 1200
_CELL_PX: Final = 4
_NO_DATA: Final = (222, 222, 222)
# The colours' ends: shares of the well-read cells outside them, the least span of the level, amplitudes shown of a lump.
_ENDS: Final = (0.01, 0.995)
_LEAST_SPAN: Final = 0.35
_AMPLITUDES_SHOWN: Final = 1.25
_POINTS: Final = 72
_SCALE_BAR_MM: Final = 10.0


def size_mm(tactile_map: TactileMap) -> tuple[float, float]:
    """Width and height of the picture, with its margin."""
    rows, columns = orientation_of(tactile_map).screen(tactile_map.count).shape
    cell = tactile_map.recipe.cell_mm
    return columns * cell + 2 * MARGIN_MM, rows * cell + 2 * MARGIN_MM


def colour_limits(exam: ExamMap) -> tuple[float, float]:
    """Values at the ends of the colours: a rib beside the lump does not take them all, noise alone is no lump."""
    tactile_map, document = exam.tactile_map, exam.document
    well = tactile_map.covered & ~tactile_map.few
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    if not values.size:
        return 0.0, 1.0
    low, high = (float(end) for end in np.quantile(values, _ENDS))
    if document["amplitude"] is not None and document["background"] is not None:
        level, amplitude = document["background"]["median"], document["amplitude"]["median"]
        high = min(high, level + _AMPLITUDES_SHOWN * amplitude)
    return low, max(high, low + _LEAST_SPAN * abs(float(np.median(values))), low + 1e-9)


def exam_picture(exam: ExamMap, *, label: str, scale: float = 1.0, small: bool = False) -> str:
    """Inline SVG of a map, one unit a mm, `scale` of life size when printed.

    Parameters
    ----------
    label
        What it shows, for those who cannot see it.
    small
        Only the values, the ellipse and the sides.
    """
    tactile_map, view = exam.tactile_map, orientation_of(exam.tactile_map)
    width, height = size_mm(tactile_map)
    inner = (width - 2 * MARGIN_MM, height - 2 * MARGIN_MM)
    parts = [
        f'<svg class="map" role="img" aria-label="{html.escape(label)}" '
        f'viewBox="{-MARGIN_MM:g} {-MARGIN_MM:g} {width:.6g} {height:.6g}" '
        f'width="{scale * width:.1f}mm" height="{scale * height:.1f}mm">',
        _cells(exam, view, inner),
        *_edges(view, inner),
        *(part for mass in exam.masses for part in _mass(mass, exam, view, small=small)),
        *(() if small else _marks(exam, view, inner)),
        "</svg>",
    ]
    return "".join(parts)


def colour_bar(exam: ExamMap) -> str:
    """Inline SVG of the colours with the values at their ends."""
    low, high = colour_limits(exam)
    stops = "".join(
        f'<stop offset="{i / (len(COLOURS) - 1):g}" stop-color="#{"".join(f"{part:02x}" for part in colour)}"/>'
        for i, colour in enumerate(COLOURS)
    )
    words = html.escape(exam.tactile_map.recipe.value_words)
    return (
        '<svg class="bar" role="img" aria-label="Colours of the map" viewBox="0 0 108 6" width="108mm" height="6mm">'
        f'<defs><linearGradient id="colours">{stops}</linearGradient></defs>'
        f'<rect x="12" y="0.5" width="34" height="3" fill="url(#colours)" stroke="#333" stroke-width="0.15"/>'
        f'<text x="11" y="3.2" text-anchor="end" font-size="3">{low:.3g}</text>'
        f'<text x="47" y="3.2" font-size="3">{high:.3g}  {words}</text></svg>'
    )


def _cells(exam: ExamMap, view: Orientation, inner: tuple[float, float]) -> str:
    """The map's values as an embedded PNG; cells with few readings are striped, those without any are grey."""
    tactile_map = exam.tactile_map
    values = view.screen(np.where(tactile_map.covered, tactile_map.mean, np.nan))
    few = view.screen(tactile_map.few)
    step = -(-max(values.shape) // _MOST_PIXELS)
    pixels = _coloured(values[::step, ::step], colour_limits(exam))
    times = max(1, min(_CELL_PX, _MOST_PIXELS // max(pixels.shape[:2])))
    pixels = pixels.repeat(times, axis=0).repeat(times, axis=1)
    if times == _CELL_PX:
        rows, columns = np.indices(pixels.shape[:2])
        stripe = few.repeat(times, axis=0).repeat(times, axis=1) & ((rows + columns) % 8 < 2)
        pixels[stripe] = 255
    data = base64.b64encode(_png(pixels)).decode("ascii")
    return (
        f'<image x="0" y="0" width="{inner[0]:.6g}" height="{inner[1]:.6g}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{data}"/>'
        f'<rect x="0" y="0" width="{inner[0]:.6g}" height="{inner[1]:.6g}" fill="none" stroke="#333" stroke-width="0.3"/>'
    )


def _coloured(values: FloatArray, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """(n, m, 3) colours of values; cells without data are grey."""
    low, high = limits
    covered, colours = np.isfinite(values), np.array(COLOURS, dtype=float)
    at = np.clip((np.where(covered, values, low) - low) / (high - low), 0.0, 1.0) * (len(colours) - 1)
    mixed = np.stack([np.interp(at, np.arange(len(colours)), colours[:, i]) for i in range(3)], axis=-1)
    return np.where(covered[..., None], np.rint(mixed), np.array(_NO_DATA)).astype(np.uint8)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).quantize(128, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()


def _edges(view: Orientation, inner: tuple[float, float]) -> Iterator[str]:
    """Names of the picture's sides: the patient's, or the plane's axes."""
    width, height = inner
    places = {
        "left": (-MARGIN_MM / 2, height / 2),
        "right": (width + MARGIN_MM / 2, height / 2),
        "top": (width / 2, -MARGIN_MM / 2),
        "bottom": (width / 2, height + MARGIN_MM / 2),
    }
    for side, name in view.edges.items():
        x, y = places[side]
        yield (
            f'<text class="edge" data-side="{side}" x="{x:.4g}" y="{y + 1.5:.4g}" text-anchor="middle" '
            f'font-size="4.2" font-weight="600">{html.escape(name)}</text>'
        )


def _mass(mass: ExamMass, exam: ExamMap, view: Orientation, *, small: bool) -> Iterator[str]:
    """The ellipse of the size, those of its interval's ends, a cross at the centre, and the number of one of several."""
    tactile_map, numbered = exam.tactile_map, len(exam.masses) > 1
    cell = tactile_map.recipe.cell_mm
    x, y = (cell * value for value in view.place(tactile_map, mass.centre_mm))
    if mass.axes_mm is not None and mass.largest is not None:
        if not small:
            for end in ("low", "high"):
                outline = _ellipse(mass, mass.largest[end] / mass.largest["median"], tactile_map, view)
                yield _stroked(outline, 0.3, kind=f"size-{end}", dash="1.2 0.9")
        yield _stroked(_ellipse(mass, 1.0, tactile_map, view), 0.8 if small else 0.55, kind="size")
    arm = 1.6
    yield _stroked(f"M{x - arm:.2f} {y:.2f}h{2 * arm:g}M{x:.2f} {y - arm:.2f}v{2 * arm:g}", 0.4, kind="centre")
    if not small and numbered:
        above = 0.0 if mass.largest is None else mass.largest["high"] / 2
        yield _text(x, y - above - 1.5, f"{mass.number}", anchor="middle", size=4.2)


def _ellipse(mass: ExamMass, times: float, tactile_map: TactileMap, view: Orientation) -> str:
    """Path of the mass's ellipse, its diameters multiplied."""
    assert mass.axes_mm is not None
    t, angle = np.linspace(0.0, 2 * np.pi, _POINTS, endpoint=False), np.radians(mass.angle_deg)
    along, across = (0.5 * times * axis for axis in mass.axes_mm)
    u, v = along * np.cos(t), across * np.sin(t)
    xs = mass.centre_mm[0] + u * np.cos(angle) - v * np.sin(angle)
    ys = mass.centre_mm[1] + u * np.sin(angle) + v * np.cos(angle)
    cell = tactile_map.recipe.cell_mm
    places = [view.place(tactile_map, (float(a), float(b))) for a, b in zip(xs, ys, strict=True)]
    return "M" + "L".join(f"{cell * a:.2f} {cell * b:.2f}" for a, b in places) + "Z"


def _stroked(path: str, width: float, *, kind: str, dash: str = "") -> str:
    """A white line with a black edge, visible on every colour and in grey."""
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    under = f'<path d="{path}" fill="none" stroke="#000" stroke-width="{width + 0.5:g}"/>'
    return f'{under}<path class="{kind}" d="{path}" fill="none" stroke="#fff" stroke-width="{width:g}"{dashed}/>'


def _text(x: float, y: float, text: str, *, anchor: str, size: float) -> str:
    """White text with a black edge."""
    return (
        f'<text x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}" font-size="{size:g}" font-weight="600" fill="#fff" '
        f'stroke="#000" stroke-width="0.9" paint-order="stroke">{html.escape(text)}</text>'
    )


def _marks(exam: ExamMap, view: Orientation, inner: tuple[float, float]) -> Iterator[str]:
    """Scale bar, nipple, direction of the sternal notch, and the places looked at in vain."""
    width, height = inner
    yield _stroked(f"M4 {height - 4:.2f}h{_SCALE_BAR_MM:g}", 0.9, kind="scale")
    yield _text(4 + _SCALE_BAR_MM / 2, height - 5.6, f"{_SCALE_BAR_MM:g} mm", anchor="middle", size=3.2)
    if not exam.masses:
        yield from _looked_at(exam, view)
    nipple = exam.tactile_map.nipple_mm
    if nipple is not None:
        yield from _nipple(_inside(view, exam.tactile_map, (float(nipple[0]), float(nipple[1]))), inner)
    if view.notch is not None:
        right, up = view.notch
        x, y = width - 8.0, height - 4.0
        tip = (x + 7 * right, y - 7 * up)
        head = [(tip[0] - 2.2 * (right * c - up * s), tip[1] + 2.2 * (up * c + right * s)) for c, s in _BARBS]
        barbs = "".join(f"M{tip[0]:.2f} {tip[1]:.2f}L{a:.2f} {b:.2f}" for a, b in head)
        yield _stroked(f"M{x:.2f} {y:.2f}L{tip[0]:.2f} {tip[1]:.2f}{barbs}", 0.5, kind="notch")
        yield _text(min(x, width - 2), y - 9.0, "to notch", anchor="end" if right > 0.3 else "middle", size=3.0)


_BARBS: Final = ((0.87, 0.5), (0.87, -0.5))


def _inside(view: Orientation, tactile_map: TactileMap, centre_mm: tuple[float, float]) -> tuple[float, float]:
    cell = tactile_map.recipe.cell_mm
    across, down = view.place(tactile_map, centre_mm)
    return cell * across, cell * down


def _nipple(at: tuple[float, float], inner: tuple[float, float]) -> Iterator[str]:
    """A ring at the nipple; where it lies off the map, a wedge at the edge that points to it."""
    (x, y), (width, height) = at, inner
    inside = 0 <= x <= width and 0 <= y <= height
    if inside:
        yield _stroked(_ring(x, y, 2.6) + _ring(x, y, 0.7), 0.45, kind="nipple")
        yield _text(x, y + 6.2, "nipple", anchor="middle", size=3.0)
        return
    edge_x, edge_y = min(max(x, 2.5), width - 2.5), min(max(y, 2.5), height - 2.5)
    away = np.hypot(x - edge_x, y - edge_y) or 1.0
    right, down = (x - edge_x) / away, (y - edge_y) / away
    tip = (edge_x + 2 * right, edge_y + 2 * down)
    base = [(edge_x - 1.4 * s * down, edge_y + 1.4 * s * right) for s in (1, -1)]
    corners = "L".join(f"{a:.2f} {b:.2f}" for a, b in (tip, *base))
    yield _stroked(f"M{corners}Z", 0.45, kind="nipple-off")
    anchor = "start" if right < -0.5 else "end" if right > 0.5 else "middle"
    yield _text(edge_x - 3.2 * right, edge_y - 3.2 * down + 1.0, f"nipple, {away:.0f} mm", anchor=anchor, size=3.0)


def _ring(x: float, y: float, radius: float) -> str:
    arc = f"a{radius:g} {radius:g} 0 1 0"
    return f"M{x - radius:.2f} {y:.2f}{arc} {2 * radius:g} 0{arc} {-2 * radius:g} 0"


def _looked_at(exam: ExamMap, view: Orientation) -> Iterator[str]:
    """A cross at each place that was looked at where no lump was found."""
    for one in exam.document["candidates"]:
        x, y = _inside(view, exam.tactile_map, (one["x_mm"], one["y_mm"]))
        yield _stroked(f"M{x - 1:.2f} {y - 1:.2f}l2 2m0 -2l-2 2", 0.3, kind="looked-at")


def pictures(maps: Sequence[ExamMap], *, width_mm: float) -> list[str]:
    """Small pictures of repeat maps, all to the scale of the widest of them."""
    widest = max((size_mm(one.tactile_map)[0] for one in maps), default=width_mm)
    scale = min(1.0, width_mm / widest)
    return [exam_picture(one, label=f"Repeat map {i}", scale=scale, small=True) for i, one in enumerate(maps, start=1)]
