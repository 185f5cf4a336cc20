"""Process of the live view: follows a recording, keeps and draws a map, with estimates from another process.

It is started by `record` and never makes it wait; if it dies, the recording goes on.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_bayes.batch import LocalWorkers
from tactile_bayes.declarations import from_plain, replace
from tactile_bayes.errors import TactileBayesError
from tactile_bayes.files.instrument import calibration_document, head_document
from tactile_bayes.files.size_json import read_size_calibration, size_calibration_path
from tactile_bayes.findings import finding_summary
from tactile_bayes.geometry import FloatArray, apply, inverse
from tactile_bayes.hardware import live
from tactile_bayes.hardware.reading import ENDING
from tactile_bayes.mapping.map import Orientation, TactileMap, block_sums, orientation_of
from tactile_bayes.posterior.bump import candidate_centres
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.presets import FIELD_COSINES, INTERVAL, PRESSURE_WINDOW_KPA, RECORDING_KEYS, RESEARCH_USE, VIRIDIS
from tactile_bayes.scans import ElementCalibration, HeadGeometry
from tactile_bayes.shell import can_redraw, has_styles, own_process

DRAWINGS_PER_S = 10.0
BATCH_S = 1 / DRAWINGS_PER_S / 2  #: Frames are added to the map in batches, two for each drawing.
_SHOW, _HIDE = "\x1b[?25h\x1b[?1049l", "\x1b[?1049h\x1b[?25l"


@contextlib.contextmanager
def live_view(
    head: HeadGeometry, calibration: ElementCalibration, *, terminal: bool, serve: str | None, size_calibration: str
) -> Iterator[Any]:
    """Start the view's process; yields an observer for the recorder."""
    address = live.parse_address(serve) if serve else None  # an error before anything is recorded
    calibration_file = size_calibration_path(size_calibration)
    if calibration_file is not None:
        read_size_calibration(calibration_file)  # likewise
    setup = {
        "head": head_document(head),
        "calibration": calibration_document(calibration),
        "terminal": terminal,
        "keys": sys.stdin.isatty(),
        "serve": address,
        "size_calibration": calibration_file and str(calibration_file),
    }
    theirs, ours = os.pipe()
    command = own_process("tactile_bayes.actions.live_view", str(theirs))
    process = subprocess.Popen(command, pass_fds=(theirs,), stdin=subprocess.PIPE, text=True)
    os.close(theirs)
    assert process.stdin is not None
    with process.stdin as start:
        start.write(json.dumps(setup))
    feed = live.Feed(ours)
    try:
        yield feed
    finally:
        feed.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


_calibration_of = cache(read_size_calibration)


class LiveAnswer(NamedTuple):
    """Result of one live estimate; without a text the previous one stays."""

    text: str = ""  #: The size in a line, or why there is none.
    lump_base_mm: FloatArray | None = None  #: Centre of the lump in `base`.


class LiveEstimator:
    """Estimates the newest map's size again and again, in a process that starts before there is a map."""

    def __init__(self, calibration: str | None) -> None:
        self._calibration = calibration
        self._process = LocalWorkers(1)
        self._running: Future[LiveAnswer] | None = self._process.submit(LiveAnswer)
        self.answer = LiveAnswer()
        self.done = 0

    def poll(self, tactile_map: TactileMap | None) -> None:
        """Take the answer of a finished estimate, and start the next one."""
        if self._running is not None and self._running.done():
            with contextlib.suppress(Exception):  # the process died: the next estimate starts another
                answer = self._running.result()
                self.answer, self.done = answer if answer.text else self.answer, self.done + 1
            self._running = None
        if self._running is None and tactile_map is not None:
            self._running = self._process.submit(live_estimate, tactile_map, self._calibration)

    def close(self) -> None:
        """End the process, also during an estimate."""
        self._process.stop()


class RiseRotation:
    """Choice of the next rise to estimate, one at a time: most are no lump and each costs as much as a lump.

    It is the rise that was last a lump, or else the next lower one; every `HIGHEST_EVERY` estimates it is the highest,
    which may be new. The next fit of a lump starts from its last width.
    """

    HIGHEST_EVERY = 8

    def __init__(self) -> None:
        self._lump = self._current = self._estimates = 0
        self._width_mm: float | None = None

    def next_of(self, number: int) -> int:
        """Index of the next of `number` rises; 0 is the highest."""
        self._estimates += 1
        self._lump %= number
        self._current = 0 if self._estimates % self.HIGHEST_EVERY == 0 else self._lump
        return self._current

    @property
    def width_mm(self) -> float | None:
        """Last width of the lump if it is the current rise; else None."""
        return self._width_mm if self._current == self._lump else None

    def record(self, *, lump: bool, width_mm: float | None = None) -> bool:
        """Record an estimate's result; False if it is not to be shown: another rise was tried and is no lump."""
        tried = self._current != self._lump
        if lump:
            self._lump, self._width_mm = self._current, width_mm
        elif not tried:
            self._lump, self._width_mm = self._lump + 1, None
        return lump or not tried


_RISES = RiseRotation()
LIVE_DRAWS = 400


def live_estimate(tactile_map: TactileMap, calibration_path: str | None, rises: RiseRotation = _RISES) -> LiveAnswer:
    """Size by the fast method with the lump's place, or the reason for no size."""
    try:
        centres = candidate_centres(tactile_map)
        if not centres:
            return LiveAnswer("no estimate: nothing rises above the background")
        centre = centres[rises.next_of(len(centres))]
        calibration = _calibration_of(Path(calibration_path)) if calibration_path else None
        # no test for rotation: it takes a third of the time and can be made afterwards
        options = SamplerSettings(
            method="laplace",
            rotation="off",
            centre_mm=centre,
            start_width_mm=rises.width_mm,
            field_cosines=FIELD_COSINES,
            draws=LIVE_DRAWS,
        )
        if calibration is not None:
            recipe = calibration.recipe
            options = replace(options, background=recipe.background, fit_radius_mm=recipe.radius_mm, noise=recipe.noise)
        estimate = estimate_map(tactile_map, calibration=calibration, options=options, rng=np.random.default_rng(1))
    except TactileBayesError as error:
        return LiveAnswer(f"no estimate: {error}" if rises.record(lump=False) else "")
    width = None if estimate.fit is None else float(np.sqrt(np.prod(estimate.fit.widths()[:2])))
    if not rises.record(lump=estimate.status == "estimate", width_mm=width):
        return LiveAnswer()
    if estimate.status != "estimate" or estimate.map_posterior is None:
        reason = f"the rise near {centre[0]:.0f}, {centre[1]:.0f} mm is no lump that can be measured"
        return LiveAnswer(f"no estimate: {estimate.reason if estimate.code == 'extrapolated' else reason}")
    lump = None
    if tactile_map.plane_from_base is not None:  # stays valid in `base` when the map's plane changes
        centre_mm = [np.median(estimate.map_posterior.x_mm), np.median(estimate.map_posterior.y_mm), 0.0]
        lump = apply(inverse(tactile_map.plane_from_base), np.array(centre_mm))
    if estimate.size is not None:
        cautions = finding_summary(estimate.findings, "caution", most=1)
        return LiveAnswer(" ".join([*cautions, _interval("largest size", estimate.size.max_size_mm)]), lump)
    widths = np.maximum(estimate.map_posterior.sigma_x_mm, estimate.map_posterior.sigma_y_mm)
    return LiveAnswer(_interval("map width sigma", widths), lump)


def _interval(name: str, draws: FloatArray) -> str:
    tail = (1 - INTERVAL) / 2
    low, middle, high = np.nanquantile(draws, [tail, 0.5, 1 - tail])
    return f"{name} {middle:.1f} mm ({low:.1f} to {high:.1f}, {100 * INTERVAL:g} % equal-tailed)"


def run(pipe: int, setup: dict[str, Any]) -> None:
    """Follow a recording until it ends."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)  # the signal ends the recording, and that ends the view
    grown = live.LiveMap(from_plain(HeadGeometry, setup["head"]), from_plain(ElementCalibration, setup["calibration"]))
    estimator = LiveEstimator(setup["size_calibration"])
    with contextlib.ExitStack() as stack:
        stack.callback(estimator.close)
        displays: list[Callable[[live.LiveState], None]] = []
        if setup["serve"]:
            server = live.LiveServer(*setup["serve"])
            stack.callback(server.close)
            print(f"live view: {server.url}", file=sys.stderr, flush=True)
            displays.append(server.show)
        if setup["terminal"]:
            displays.append(stack.enter_context(terminal_view(keys=setup["keys"])))
        began = time.monotonic()
        drawn, drawings, newest = 0.0, 0, None
        for batch in live.read_feed(pipe, BATCH_S):
            grown.take(batch)
            estimator.poll(newest)
            now = time.monotonic()
            if now - drawn < 1 / DRAWINGS_PER_S:
                continue
            drawn, drawings = now, drawings + 1
            state = grown.state(size=estimator.answer.text, lump_base_mm=estimator.answer.lump_base_mm)
            newest = state.tactile_map
            for display in displays:
                display(state)
        if not sys.stderr.isatty():
            seconds = time.monotonic() - began
            print(f"live view: {drawings} drawings and {estimator.done} estimates in {seconds:.1f} s", file=sys.stderr)


@contextlib.contextmanager
def terminal_view(*, keys: bool = False) -> Iterator[Callable[[live.LiveState], None]]:
    """Draw on a terminal; one line per second where it cannot be redrawn."""
    out = sys.stderr
    if not can_redraw():
        last = 0.0

        def print_line(state: live.LiveState) -> None:
            nonlocal last
            if time.monotonic() - last >= 1.0:
                last = time.monotonic()
                print(live_line(state), file=out, flush=True)

        yield print_line
        return
    colour = has_styles()

    def draw(state: live.LiveState) -> None:
        columns, lines = shutil.get_terminal_size()
        text = live_text(state, columns=columns - 1, lines=lines - 1, colour=colour, keys=keys)
        out.write("\x1b[H" + text.replace("\n", "\x1b[K\r\n") + "\x1b[J")
        out.flush()

    out.write(_HIDE)
    try:
        yield draw
    finally:
        out.write(_SHOW)
        out.flush()


# --- The live view as text: a heat map in half blocks, a pressure bar, and figures for the examiner.

_COLOURS: Final = np.array(VIRIDIS, dtype=np.float64)
_SHADES: Final = " .:-=+*#%@"
_FULL_BAR_KPA: Final = 20.0
_ADVICE: Final = {"low": "press harder", "in": "in range", "high": "press less", "off": "waiting for the head"}
_TONE_COLOUR: Final = {"low": "94", "in": "92", "high": "91", "off": "90"}
_EDGE_WORDS: Final = {"H": "H (head)", "F": "F (feet)"}
_LEGEND_LINES: Final = 3
_LEAST_ROWS: Final = 6
_MARGIN: Final = 4
_MARK: Final = "X"
_STEPS: Final = 256


def live_text(state: live.LiveState, *, columns: int, lines: int, colour: bool, keys: bool = False) -> str:
    """One screen of lines, none longer than `columns`; `keys`: the recording's keys can be pressed on this terminal."""
    above = [_pressure(state, columns, colour=colour), _figures(state)[:columns], state.size_words[:columns]]
    below = [*textwrap.wrap(state.landmark_words, columns), RESEARCH_USE[:columns]]
    if keys:
        below.insert(0, RECORDING_KEYS[:columns])
    room = max(2, lines - len(above) - len(below) - 1)
    return "\n".join([*above, "", *_picture(state, columns, room, colour=colour), *below])


def live_line(state: live.LiveState) -> str:
    """The live view in one line, for terminals that cannot be redrawn."""
    pressure = f"{state.pressure_words} {_ADVICE[state.tone]}".strip()
    behind = f"view {state.latency_ms:.0f} ms behind"
    return f"{pressure}; {_figures(state)}; {state.size_words}; {behind}"


def _pressure(state: live.LiveState, columns: int, *, colour: bool) -> str:
    words = f" {state.pressure_words:>8}  {_ADVICE[state.tone]}"
    width = max(10, min(40, columns - len(words) - 2))
    level = 0.0 if not np.isfinite(state.pressure_kpa) else state.pressure_kpa
    cells = ["#" if (i + 0.5) * _FULL_BAR_KPA / width <= level else "-" for i in range(width)]
    for limit in PRESSURE_WINDOW_KPA:
        cells[min(width - 1, int(limit / _FULL_BAR_KPA * width))] = "|"
    text = f"[{''.join(cells)}]{words}"[:columns]
    return f"\x1b[{_TONE_COLOUR[state.tone]}m{text}\x1b[0m" if colour else text


def _figures(state: live.LiveState) -> str:
    return f"{state.account_words.replace('²', '2')}, {100 * state.used_share:.0f} % used"


def _picture(state: live.LiveState, columns: int, lines: int, *, colour: bool) -> list[str]:
    """The map between the labels of its edges, oriented by `orientation_of`, with a legend below."""
    if state.tactile_map is None:
        return ["no map yet: move the head over the lump within the pressure window"[:columns]]
    view, values = orientation_of(state.tactile_map), live.grey_levels(state.tactile_map.mean)
    legend_lines = _LEGEND_LINES if lines >= _LEGEND_LINES + _LEAST_ROWS else 0
    wide, high = columns - 2 * _MARGIN, max(1, lines - 2 - legend_lines)
    pixels = view.screen(values)
    # A character is twice as high as wide: two cells of the map share one, one above the other.
    step = max(1, -(-pixels.shape[1] // wide), -(-pixels.shape[0] // (2 * high)))
    known = np.isfinite(pixels)  # means over squares of `step` cells; NaN where all cells are NaN
    number, total = block_sums(known.astype(float), step), block_sums(np.where(known, pixels, 0.0), step)
    small = np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))
    rows = _blocks(small) if colour else _shades(small)
    if state.lump_mm is not None:
        across, down = view.place(state.tactile_map, state.lump_mm)
        row, column = int(down / step / 2), int(across / step)
        if 0 <= row < len(rows) and 0 <= column < len(rows[row]):
            rows[row][column] = f"\x1b[0;1;97m{_MARK}" if colour else _MARK
    dark, bright = live.colour_limits(state.tactile_map.mean) or (np.nan, np.nan)
    recipe, marked = state.tactile_map.recipe, "" if state.lump_mm is None else f"; {_MARK} the lump"
    scale = f"a character is {step * recipe.cell_mm:g} mm wide{marked}"
    legend = [view.words, f"{recipe.value_words}: dark {dark:.3g} to bright {bright:.3g}", scale][:legend_lines]
    return [*_framed(rows, view, columns, colour=colour), *(line[:columns] for line in legend)]


def _framed(rows: list[list[str]], view: Orientation, columns: int, *, colour: bool) -> list[str]:
    """The picture with labels at its edges."""
    edges, width = view.edges, len(rows[0])
    top, bottom = (_EDGE_WORDS.get(edges[side], edges[side]).center(width).rstrip() for side in ("top", "bottom"))
    end = "\x1b[0m" if colour else ""
    lines = [" " * _MARGIN + "".join(row) + end for row in rows]
    middle = len(rows) // 2
    lines[middle] = f"{edges['left']:>{_MARGIN - 1}} {lines[middle][_MARGIN:]} {edges['right']}"
    return [(" " * _MARGIN + top)[:columns], *lines, (" " * _MARGIN + bottom)[:columns]]


def _blocks(values: FloatArray) -> list[list[str]]:
    """Half blocks, one string per character: the upper cell is the foreground, the lower the background."""
    if len(values) % 2:
        values = np.vstack([values, np.full((1, values.shape[1]), np.nan)])
    shown = np.isfinite(values)
    colours = _palette()[np.rint(np.nan_to_num(values) * (_STEPS - 1)).astype(int)]
    pairs = zip(colours[::2], colours[1::2], shown[::2], shown[1::2], strict=True)
    return [list(map(_cell, *(one.tolist() for one in pair))) for pair in pairs]


def _cell(top: str, bottom: str, shown_top: bool, shown_bottom: bool) -> str:
    if shown_top and shown_bottom:
        return f"\x1b[38;2;{top};48;2;{bottom}m▀"
    if shown_top:
        return f"\x1b[0;38;2;{top}m▀"
    return f"\x1b[0;38;2;{bottom}m▄" if shown_bottom else "\x1b[0m "


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


if __name__ == "__main__":
    run(int(sys.argv[1]), json.load(sys.stdin))
