"""The process and its terminal: lines and colours that fit it, pipes closed early, Ctrl-C, progress."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import signal
import sys
import textwrap
import time
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, TextIO

from tactile_bayes.errors import UsageError
from tactile_bayes.progress import Progress, no_progress

# --- Text on a terminal: lines break between words at its width, the size and the verdict are bold, cautions coloured.

BOLD, RED, YELLOW, CYAN = "1", "31", "33", "36"
# Style -> how its lines begin. A pipe, a file and NO_COLOR get none of them.
STYLES: Final = {
    RED: ("error: ", "failed: "),
    YELLOW: ("CAUTION: ", "caution: ", "Doubtful: "),
    f"{BOLD};{YELLOW}": ("doubtful: ",),
    CYAN: ("To check: ", "note: "),
    BOLD: (
        *("$ ", "sound: ", "needed: ", "tactile errs ", "The mass has ", "No change shown", "Not compared"),
        *("No common size", "largest size ", "No estimate: ", "No lump found", "No size: "),
    ),
}
LEAST_COLUMNS: Final = 20  #: No line is wrapped on a narrower terminal: one without a size says 0.
MOST_NAME: Final = 40  #: The text beside a row's name is wrapped within its own column if that begins by here.
COMMAND_END: Final = " \\"  #: Ends a line of a command that goes on in the next one, as shells read it.
_UNIT: Final = r"(?<=\d) (?=(?:%|mm|cm2?|kPa|ms|s|Hz|deg)(?![\w-]))|(?<=\bp) (?=[<.\d])"
"""The blank before a unit, or of a p value, where no line breaks."""
_JOINED: Final = "\x1f"  #: Replaces that blank while a line is wrapped; no printed text holds it.
_WIDE: Final = "\x1e"  #: Follows a letter of two columns while a line is wrapped; no printed text holds it.
_HANGING: Final = 2  #: Columns by which the further lines of a sentence are indented.


def text_width(text: str) -> int:
    """Columns that a text takes: two for a wide letter (East Asian), none for a combining one."""
    return sum(0 if unicodedata.combining(letter) else 1 + _is_wide(letter) for letter in text)


def padded(text: str, columns: int) -> str:
    """The text padded with blanks to so many columns."""
    return text + " " * (columns - text_width(text))


def _is_wide(letter: str) -> bool:
    return unicodedata.east_asian_width(letter) in ("W", "F")


def terminal_columns(stream: TextIO) -> int:
    """Columns of the stream's terminal, or as COLUMNS states them; 0 where it is no terminal."""
    try:
        if not stream.isatty():
            return 0
        stated = os.environ.get("COLUMNS", "")
        return int(stated) if stated.isdecimal() else os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError):  # closed, or without a file descriptor
        return 0


def can_redraw() -> bool:
    """True if stderr is a terminal whose lines can be redrawn; other output there is then overwritten."""
    return sys.stderr.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "")


def has_styles(environment: Mapping[str, str] = os.environ) -> bool:
    """True if terminals get bold and colours: not with NO_COLOR (no-color.org), nor on a dumb one."""
    capable = os.name == "posix" or "WT_SESSION" in environment
    return capable and not environment.get("NO_COLOR") and environment.get("TERM", "dumb") not in ("dumb", "")


def fit_terminal(text: str, *, columns: int, styles: bool) -> str:
    """Wrap a text between words for a terminal of that width, and style its lines; JSON is left as it is."""
    if columns < LEAST_COLUMNS or text.lstrip()[:1] in ("{", "["):
        return text
    return "\n".join(_fit_line(line, columns, styles=styles) for line in text.split("\n"))


def _fit_line(line: str, columns: int, *, styles: bool) -> str:
    if text_width(line) > columns:
        end = COMMAND_END if line.startswith("$ ") else ""
        wrapper = textwrap.TextWrapper(
            width=columns - len(end),
            subsequent_indent=" " * _indent(line),
            break_long_words=False,
            break_on_hyphens=False,
            replace_whitespace=False,
            expand_tabs=False,
        )
        marked = "".join(letter + _WIDE * _is_wide(letter) for letter in line)
        parts = wrapper.wrap(re.sub(_UNIT, _JOINED, marked))
        line = f"{end}\n".join(parts).replace(_JOINED, " ").replace(_WIDE, "")
    style = next((style for style, leads in STYLES.items() if line.startswith(leads)), "") if styles else ""
    return "\n".join(f"\x1b[{style}m{part}\x1b[0m" for part in line.split("\n")) if style else line


def _indent(line: str) -> int:
    """Columns by which a line's wrapped parts are indented: to the text beside a row's name, or a hanging indent."""
    margin = len(line) - len(line.lstrip())
    name, gap, rest = line[margin:].partition("  ")
    beside = margin + text_width(name) + len(gap) + len(rest) - len(rest.lstrip())
    return beside if gap and beside <= MOST_NAME else margin + _HANGING if margin <= _HANGING else margin


# --- All printing: control characters are escaped, and a full disk is one error line.

# C0 but tab and newline, delete, C1, line and direction marks, halves of surrogate pairs
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")


class ReaderGoneError(Exception):
    """The reader of the standard output stopped: ``tactile-bayes show scan.mcap | head -1``."""


def printable(text: str) -> str:
    r"""The text with each control character as its escape, for example ``\x1b``; tabs and newlines stay.

    Text from a file is printed only in this form: control characters can move a terminal's cursor, rename its window
    or hide earlier output.
    """
    return _CONTROL.sub(lambda control: ascii(control[0])[1:-1], text)


class PrintableStream:
    """A text stream that escapes control characters and, on a terminal, wraps lines; otherwise as the one underneath.

    A failed write is an error where `required` (standard output), else ignored (standard error: nowhere to report it).
    """

    def __init__(self, stream: TextIO, *, required: bool) -> None:
        self._stream = stream
        self._required = required
        self._failure: Exception | None = None  # raised again at the next call: the caller may have caught it

    @property
    def encoding(self) -> str:
        """UTF-8 in any locale: click would write past a stream that says it is ASCII, and so past the escapes."""
        return "utf-8"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        safe = printable(text)
        if columns := terminal_columns(self._stream):
            safe = fit_terminal(safe, columns=columns, styles=has_styles())
        self._try(self._stream.write, safe)
        return len(text)

    def flush(self) -> None:
        """Flush the stream underneath: `UsageError` if that fails, `ReaderGoneError` if its reader has gone."""
        self._try(self._stream.flush)

    def _try(self, action: Callable[..., object], *arguments: object) -> None:
        try:
            action(*arguments)
        except OSError as error:
            null = os.open(os.devnull, os.O_WRONLY)  # else Python tries again at exit and prints a traceback
            os.dup2(null, self._stream.fileno())
            os.close(null)
            full = f"the standard output cannot be written ({error.strerror}); make room, or send it elsewhere"
            failure = ReaderGoneError() if error.errno == errno.EPIPE else UsageError(full)
            self._failure = failure if self._required else None
        if self._failure is not None:
            raise self._failure


def protect_streams() -> None:
    """Make the standard streams of this process printable in any locale; a closed one becomes the null device."""
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: PTH123, SIM115 (it stays open)
    for name, required in (("stdout", True), ("stderr", False)):
        stream = getattr(sys, name)
        if stream is None:  # what is printed to None goes to the standard output
            stream = open(os.devnull, "w")  # noqa: PTH123, SIM115
        if not isinstance(stream, PrintableStream):
            if isinstance(stream, io.TextIOWrapper):
                stream = _buffered(stream)
            setattr(sys, name, PrintableStream(stream, required=required))


def _buffered(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    """The stream with a buffer and with escapes in place of encoding errors.

    Without a buffer (``PYTHONUNBUFFERED=1``, as in many containers) Python drops text that a full disk does not take.
    """
    if isinstance(stream.buffer, io.RawIOBase):
        raw = io.FileIO(stream.fileno(), "w", closefd=False)
        stream = io.TextIOWrapper(io.BufferedWriter(raw), encoding=stream.encoding, line_buffering=True)
    stream.reconfigure(errors="backslashreplace")
    return stream


def release_streams() -> None:
    """Restore the original streams."""
    sys.stdout, sys.stderr = raw_stream(sys.stdout), raw_stream(sys.stderr)


def raw_stream(stream: Any) -> TextIO:
    """The stream underneath, for code that draws with control characters."""
    raw: TextIO = stream._stream if isinstance(stream, PrintableStream) else stream
    return raw


# --- Other processes of the program, and signals that end a command in order, as Ctrl-C does.


def own_process(module: str, *words: str) -> list[str]:
    """Command line of a module of the program; -P: else Python files of the current folder would be run."""
    return [sys.executable, "-P", "-m", module, *words]


_interrupted = False


@contextlib.contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Let SIGTERM (`kill`) and SIGHUP (a closed terminal) interrupt as Ctrl-C, unless ignored, as by `nohup`."""
    global _interrupted
    _interrupted = False
    before: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # called in a thread, which gets no signals
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.signal(number, _interrupt)
    try:
        yield
    finally:
        _interrupted = False
        for changed, handler in before.items():
            signal.signal(changed, handler)


def raise_if_interrupted() -> None:
    """Raise `KeyboardInterrupt` again where other code swallowed it, as compiled modules do while being imported."""
    if _interrupted:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: object) -> None:
    del number, frame
    global _interrupted
    _interrupted = True
    raise KeyboardInterrupt


# --- Progress on stderr: a bar on a terminal for work that takes a while, lines in a log where a command asks for them.

QUIET_S = 2.0  #: Work that ends sooner draws nothing.
# Seconds between two drawings.
REDRAW_S = 0.1
_WIDTH = 30


@contextlib.contextmanager
def progress_bar(
    label: str,
    *,
    stream: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
    log_every_s: float | None = None,
    time_left: bool = True,
) -> Iterator[Progress]:
    """Give a ``progress(done, total)`` callback; the bar is erased when the block ends.

    The `label` names the items counted. The bar is drawn on stderr by default, so that output can be piped. A stream
    that is no terminal gets a line every `log_every_s`, or nothing. `time_left` is for items that take equally long.
    """
    out = raw_stream(sys.stderr) if stream is None else stream
    bar = out.isatty()
    every_s = REDRAW_S if bar else log_every_s
    if every_s is None:
        yield no_progress
        return
    begun, drawn = clock(), 0
    due = begun + (QUIET_S if bar else every_s)
    first: int | None = None  # items that a resumed run had before it began

    def update(done: int, total: int) -> None:
        nonlocal first, due, drawn
        now, first = clock(), done if first is None else first
        if now < due or total <= 0:
            return
        due, left = now + every_s, ""
        if time_left and first < done < total:
            left = f" {duration(round((now - begun) * (total - done) / (done - first)))} left"
        if bar:
            filled = _WIDTH * done // total
            line = f"{label} [{'#' * filled}{'-' * (_WIDTH - filled)}] {done}/{total}{left}"
            out.write("\r" + line.ljust(drawn))
            drawn = len(line)
        else:
            out.write(f"{label}: {done} of {total} done{',' if left else ''}{left}\n")
        out.flush()

    try:
        yield update
    finally:
        if drawn:
            out.write("\r" + " " * drawn + "\r")
            out.flush()


def duration(seconds: int) -> str:
    """Minutes and seconds, with hours where there are any: 4:07, 2:42:05."""
    hours, rest = divmod(seconds, 3600)
    short = f"{rest // 60:02d}:{rest % 60:02d}"
    return f"{hours}:{short}" if hours else short.removeprefix("0")
