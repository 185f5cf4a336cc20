"""The live view as text: a heat map in half blocks, a pressure bar, and the figures that matter while scanning."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from tactile_bayes.hardware.live import grey_levels
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tactile_bayes.geometry import FloatArray
    from tactile_bayes.hardware.live import LiveState

# Dark blue over green to yellow, even in lightness (viridis by five of its colours).
_COLOURS: Final = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64
)
_SHADES: Final = " .:-=+*#%@"
_FULL_BAR_KPA: Final = 20.0
_SAID: Final = {"low": "press harder", "in": "in range", "high": "press less", "off": "waiting for the head"}
_TINT: Final = {"low": "94", "in": "92", "high": "91", "off": "90"}
_TEXT_LINES: Final = 6
_STEPS: Final = 256


def colours_wanted(environment: Mapping[str, str]) -> bool:
    """Whether a terminal should get colours: not when NO_COLOR is set, nor on a dumb one."""
    return not environment.get("NO_COLOR") and environment.get("TERM", "dumb") not in ("dumb", "")


def live_text(state: LiveState, *, columns: int, lines: int, colour: bool) -> str:
    """One screen, its lines joined by newlines, none longer than `columns`."""
    rows = [_pressure(state, columns, colour=colour), _figures(state)[:columns], _size(state)[:columns]]
    room = max(2, lines - _TEXT_LINES)
    picture = _picture(state, columns, room, colour=colour)
    return "\n".join([*rows, "", *picture, RESEARCH_USE[:columns]])


def live_line(state: LiveState) -> str:
    """The same in one line, for a terminal that cannot be drawn on."""
    pressure = f"{state.pressure_kpa:.1f} kPa {_SAID[state.tone]}"
    behind = f"view {state.latency_ms:.0f} ms behind"
    return f"{state.duration_s:.1f} s, {pressure}; {_figures(state)}; {_size(state)}; {behind}"


def _pressure(state: LiveState, columns: int, *, colour: bool) -> str:
    low, high = state.window_kpa
    words = f" {state.pressure_kpa:4.1f} kPa  {_SAID[state.tone]}"
    width = max(10, min(40, columns - len(words) - 2))
    level = 0.0 if not np.isfinite(state.pressure_kpa) else state.pressure_kpa
    cells = ["#" if (i + 0.5) * _FULL_BAR_KPA / width <= level else "-" for i in range(width)]
    for limit in (low, high):
        cells[min(width - 1, int(limit / _FULL_BAR_KPA * width))] = "|"
    text = f"[{''.join(cells)}]{words}"[:columns]
    return f"\x1b[{_TINT[state.tone]}m{text}\x1b[0m" if colour else text


def _figures(state: LiveState) -> str:
    return (
        f"{state.frames} frames, {state.frames_lost} lost, {state.poses} poses, {state.covered_mm2 / 100:.1f} cm2 "
        f"covered, {100 * state.used_share:.0f} % used"
    )


def _size(state: LiveState) -> str:
    return state.size or "no size estimate yet"


def _picture(state: LiveState, columns: int, lines: int, *, colour: bool) -> list[str]:
    if state.tactile_map is None:
        return ["no map yet: move the head over the lump within the pressure window"[:columns]]
    # Row 0 of a map is its lowest y; a screen begins at the top.
    values = grey_levels(state.tactile_map.mean)[::-1]
    # A character is twice as high as wide: two cells of the map share one, one above the other.
    step = max(1, -(-values.shape[1] // columns), -(-values.shape[0] // (2 * lines)))
    small = _shrunk(values, step)
    return _blocks(small) if colour else _shades(small)


def _shrunk(values: FloatArray, step: int) -> FloatArray:
    """Means over squares of `step` cells; NaN where all are."""
    rows, columns = (-(-n // step) for n in values.shape)
    padded = np.full((rows * step, columns * step), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    squares = padded.reshape(rows, step, columns, step)
    known = np.isfinite(squares)
    number = known.sum(axis=(1, 3))
    total = np.where(known, squares, 0.0).sum(axis=(1, 3))
    small: FloatArray = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return small


def _blocks(values: FloatArray) -> list[str]:
    """Half blocks: the upper cell is the ink, the lower one the paper."""
    if len(values) % 2:
        values = np.vstack([values, np.full((1, values.shape[1]), np.nan)])
    colours, shown = _colours(values), np.isfinite(values)
    pairs = zip(colours[::2], colours[1::2], shown[::2], shown[1::2], strict=True)
    return ["".join(map(_cell, *(one.tolist() for one in pair))) + "\x1b[0m" for pair in pairs]


def _cell(top: str, bottom: str, shown_top: bool, shown_bottom: bool) -> str:
    if shown_top and shown_bottom:
        return f"\x1b[38;2;{top};48;2;{bottom}m▀"
    if shown_top:
        return f"\x1b[0;38;2;{top}m▀"
    return f"\x1b[0;38;2;{bottom}m▄" if shown_bottom else "\x1b[0m "


def _colours(values: FloatArray) -> NDArray[np.object_]:
    """Of values from 0 to 1, in the terminal's words."""
    return np.asarray(_palette()[np.rint(np.nan_to_num(values) * (_STEPS - 1)).astype(int)])


@cache
def _palette() -> NDArray[np.object_]:
    place = np.linspace(0.0, len(_COLOURS) - 1, _STEPS)
    channels = [np.interp(place, np.arange(len(_COLOURS)), channel).astype(int) for channel in _COLOURS.T]
    return np.array([";".join(map(str, colour)) for colour in zip(*channels, strict=True)], dtype=object)


def _shades(values: FloatArray) -> list[str]:
    """Plain characters, every second row left out because characters are high."""
    index = np.nan_to_num(np.rint(values[::2] * (len(_SHADES) - 2)) + 1).astype(int)
    index[~np.isfinite(values[::2])] = 0
    return ["".join(_SHADES[i] for i in row).rstrip() for row in index]
