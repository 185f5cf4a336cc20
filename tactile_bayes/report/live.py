"""A recording in words, while it runs and after."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.hardware.live import colour_limits, grey_levels
from tactile_bayes.mapping.places import Orientation, orientation_of
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.hardware.live import LiveState
    from tactile_bayes.hardware.recorder import Report
    from tactile_bayes.mapping.map import TactileMap


# --- Text of a recording's account.


def record_text(report: Report, *, output: str) -> str:
    """Summary of a recording and its losses in a few lines."""
    rate = (report.frames - 1) / report.duration_s if report.frames > 1 and report.duration_s > 0 else 0.0
    dropped = f" (the head dropped {report.head_dropped})" if report.head_dropped else ""
    lines = [
        f"{output}: scan, ended by {report.ended_by}",
        f"{report.frames} frames in {report.duration_s:.3f} s, {rate:.1f} Hz; {report.poses} poses",
        f"frames lost {report.frames_lost}{dropped}",
        f"poses repeated {report.poses_repeated}, flagged {report.poses_flagged}",
        *report.landmarks,
    ]
    odd = {
        "times the head's counter of time wrapped": report.head_clock_wraps,
        "times the tracker's counter of time wrapped": report.tracker_clock_wraps,
        "poses without a time, left out": report.poses_without_time,
        "bytes from the head that made no sense": report.head_garbage_bytes,
        "bytes from the tracker that made no sense": report.tracker_garbage_bytes,
        "bytes this computer came too late for": report.overrun_bytes,
    }
    lines += [f"{words}: {number}" for words, number in odd.items() if number]
    lines += [f"caution: {text}" for text in report.cautions]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


# --- The live view as text: a heat map in half blocks, a pressure bar, and figures for the examiner.

# Dark blue over green to yellow, even in lightness (viridis by five of its colours).
_COLOURS: Final = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64
)
_SHADES: Final = " .:-=+*#%@"
_FULL_BAR_KPA: Final = 20.0
_SAID: Final = {"low": "press harder", "in": "in range", "high": "press less", "off": "waiting for the head"}
_TINT: Final = {"low": "94", "in": "92", "high": "91", "off": "90"}
KEYS: Final = "keys: n sternal notch, x xiphoid, p nipple, space start, q stop"
_EDGE_WORDS: Final = {"H": "H (head)", "F": "F (feet)"}
_LEGEND_LINES: Final = 3
_LEAST_ROWS: Final = 6
_MARGIN: Final = 4
_MARK: Final = "X"
_STEPS: Final = 256


def colours_wanted(environment: Mapping[str, str]) -> bool:
    """Whether to use colours: not when NO_COLOR is set, nor on a dumb terminal."""
    return not environment.get("NO_COLOR") and environment.get("TERM", "dumb") not in ("dumb", "")


def live_text(state: LiveState, *, columns: int, lines: int, colour: bool, keys: bool = False) -> str:
    """One screen, its lines joined by newlines, none longer than `columns`.

    `keys` says whether the recording's keys can be pressed on this terminal.
    """
    above = [_pressure(state, columns, colour=colour), _figures(state)[:columns], state.size_words[:columns]]
    below = [RESEARCH_USE[:columns]]
    if keys:
        below.insert(0, KEYS[:columns])
    room = max(2, lines - len(above) - len(below) - 1)
    return "\n".join([*above, "", *_picture(state, columns, room, colour=colour), *below])


def live_line(state: LiveState) -> str:
    """The live view in one line, for terminals that cannot be redrawn."""
    pressure = f"{state.pressure_words} {_SAID[state.tone]}".strip()
    behind = f"view {state.latency_ms:.0f} ms behind"
    return f"{pressure}; {_figures(state)}; {state.size_words}; {behind}"


def _pressure(state: LiveState, columns: int, *, colour: bool) -> str:
    low, high = state.window_kpa
    words = f" {state.pressure_words:>8}  {_SAID[state.tone]}"
    width = max(10, min(40, columns - len(words) - 2))
    level = 0.0 if not np.isfinite(state.pressure_kpa) else state.pressure_kpa
    cells = ["#" if (i + 0.5) * _FULL_BAR_KPA / width <= level else "-" for i in range(width)]
    for limit in (low, high):
        cells[min(width - 1, int(limit / _FULL_BAR_KPA * width))] = "|"
    text = f"[{''.join(cells)}]{words}"[:columns]
    return f"\x1b[{_TINT[state.tone]}m{text}\x1b[0m" if colour else text


def _figures(state: LiveState) -> str:
    return (
        f"{state.duration_s:.1f} s, {state.frames} frames, {state.frames_lost} lost, {state.poses} poses, "
        f"{state.covered_mm2 / 100:.1f} cm2 covered, {100 * state.used_share:.0f} % used"
    )


def _picture(state: LiveState, columns: int, lines: int, *, colour: bool) -> list[str]:
    """The map between labels of its edges, oriented by `orientation_of`, with a legend below."""
    if state.tactile_map is None:
        return ["no map yet: move the head over the lump within the pressure window"[:columns]]
    view, values = orientation_of(state.tactile_map), grey_levels(state.tactile_map.mean)
    legend_lines = _LEGEND_LINES if lines >= _LEGEND_LINES + _LEAST_ROWS else 0
    wide, high = columns - 2 * _MARGIN, max(1, lines - 2 - legend_lines)
    pixels = view.screen(values)
    # A character is twice as high as wide: two cells of the map share one, one above the other.
    step = max(1, -(-pixels.shape[1] // wide), -(-pixels.shape[0] // (2 * high)))
    small = _shrunk(pixels, step)
    rows = _blocks(small) if colour else _shades(small)
    if state.lump_mm is not None:
        across, down = view.place(state.tactile_map, state.lump_mm)
        _mark(rows, int(down / step / 2), int(across / step), colour=colour)
    legend = _legend(state.tactile_map, view, step, marked=state.lump_mm is not None)[:legend_lines]
    return [*_framed(rows, view, columns, colour=colour), *(line[:columns] for line in legend)]


def _mark(rows: list[list[str]], row: int, column: int, *, colour: bool) -> None:
    """Mark the lump's centre."""
    if 0 <= row < len(rows) and 0 <= column < len(rows[row]):
        rows[row][column] = f"\x1b[0;1;97m{_MARK}" if colour else _MARK


def _framed(rows: list[list[str]], view: Orientation, columns: int, *, colour: bool) -> list[str]:
    """The picture with labels at its edges."""
    edges, width = view.edges, len(rows[0])
    top, bottom = (_EDGE_WORDS.get(edges[side], edges[side]).center(width).rstrip() for side in ("top", "bottom"))
    end = "\x1b[0m" if colour else ""
    lines = [" " * _MARGIN + "".join(row) + end for row in rows]
    middle = len(rows) // 2
    lines[middle] = f"{edges['left']:>{_MARGIN - 1}} {lines[middle][_MARGIN:]} {edges['right']}"
    return [(" " * _MARGIN + top)[:columns], *lines, (" " * _MARGIN + bottom)[:columns]]


def _legend(tactile_map: TactileMap, view: Orientation, step: int, *, marked: bool) -> list[str]:
    """Legend: orientation, meaning of the colours, length of a character."""
    limits = colour_limits(tactile_map.mean)
    low, high = limits if limits is not None else (np.nan, np.nan)
    scale = f"a character is {step * tactile_map.recipe.cell_mm:g} mm wide" + (f"; {_MARK} the lump" if marked else "")
    return [view.words, f"{tactile_map.recipe.value_words}: dark {low:.3g} to bright {high:.3g}", scale]


def _shrunk(values: FloatArray, step: int) -> FloatArray:
    """Means over squares of `step` cells; NaN where all cells are NaN."""
    rows, columns = (-(-n // step) for n in values.shape)
    padded = np.full((rows * step, columns * step), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    squares = padded.reshape(rows, step, columns, step)
    known = np.isfinite(squares)
    number = known.sum(axis=(1, 3))
    total = np.where(known, squares, 0.0).sum(axis=(1, 3))
    small: FloatArray = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return small


def _blocks(values: FloatArray) -> list[list[str]]:
    """Half blocks, one string per character: the upper cell is the foreground, the lower the background."""
    if len(values) % 2:
        values = np.vstack([values, np.full((1, values.shape[1]), np.nan)])
    colours, shown = _colours(values), np.isfinite(values)
    pairs = zip(colours[::2], colours[1::2], shown[::2], shown[1::2], strict=True)
    return [list(map(_cell, *(one.tolist() for one in pair))) for pair in pairs]


def _cell(top: str, bottom: str, shown_top: bool, shown_bottom: bool) -> str:
    if shown_top and shown_bottom:
        return f"\x1b[38;2;{top};48;2;{bottom}m▀"
    if shown_top:
        return f"\x1b[0;38;2;{top}m▀"
    return f"\x1b[0;38;2;{bottom}m▄" if shown_bottom else "\x1b[0m "


def _colours(values: FloatArray) -> NDArray[np.object_]:
    """Terminal colours of values from 0 to 1."""
    return np.asarray(_palette()[np.rint(np.nan_to_num(values) * (_STEPS - 1)).astype(int)])


@cache
def _palette() -> NDArray[np.object_]:
    place = np.linspace(0.0, len(_COLOURS) - 1, _STEPS)
    channels = [np.interp(place, np.arange(len(_COLOURS)), channel).astype(int) for channel in _COLOURS.T]
    return np.array([";".join(map(str, colour)) for colour in zip(*channels, strict=True)], dtype=object)


def _shades(values: FloatArray) -> list[list[str]]:
    """Shades in plain characters, without every second row because characters are tall."""
    index = np.nan_to_num(np.rint(values[::2] * (len(_SHADES) - 2)) + 1).astype(int)
    index[~np.isfinite(values[::2])] = 0
    return [[_SHADES[i] for i in row] for row in index]
