"""Text on a terminal: lines break between words at its width, the size and the verdict are bold, cautions coloured."""

from __future__ import annotations

import os
import re
import textwrap
import unicodedata
from collections.abc import Mapping
from typing import Final, TextIO

BOLD, RED, YELLOW, CYAN = "1", "31", "33", "36"
# How a line begins -> its style; the first that fits. A pipe, a file and NO_COLOR get none of them.
STYLES: Final = {
    "error: ": RED,
    "failed: ": RED,
    "CAUTION: ": YELLOW,
    "caution: ": YELLOW,
    "doubtful: ": f"{BOLD};{YELLOW}",
    "Doubtful: ": YELLOW,
    "To check: ": CYAN,
    "note: ": CYAN,
    "$ ": BOLD,
    "sound: ": BOLD,
    "needed: ": BOLD,
    "tactile errs ": BOLD,
    "The mass has ": BOLD,
    "No change shown": BOLD,
    "Not compared": BOLD,
    "No common size": BOLD,
    "largest size ": BOLD,
    "No estimate: ": BOLD,
    "No lump found": BOLD,
    "No size: ": BOLD,
}
LEAST_COLUMNS: Final = 20  #: Below it nothing is wrapped: a terminal without a size says 0.
MOST_NAME: Final = 40  #: Columns of a row's name up to which the text beside it stays in its own column.
COMMAND_END: Final = " \\"  #: Of a line of a command that goes on in the next one, as shells read it.
_UNIT: Final = r"(?<=\d) (?=(?:%|mm|cm2?|kPa|ms|s|Hz|deg)(?![\w-]))"  #: The blank before it, where no line breaks.
_JOINED: Final = "\x1f"  #: Stands for that blank, as it is printable in no text here.
_WIDE: Final = "\x1e"  #: Stands behind a letter of two columns while a line is broken, and is printable in no text.
_HANGING: Final = 2  #: Columns by which the further lines of a sentence are indented.


def shown_columns(text: str) -> int:
    """Columns that a text takes: two for each wide letter (East Asian), none for what stands on another."""
    return sum(0 if unicodedata.combining(letter) else 1 + _is_wide(letter) for letter in text)


def padded(text: str, columns: int) -> str:
    """The text with blanks behind it to so many columns."""
    return text + " " * (columns - shown_columns(text))


def _is_wide(letter: str) -> bool:
    return unicodedata.east_asian_width(letter) in ("W", "F")


def columns_of(stream: TextIO) -> int:
    """Columns of the terminal that the stream writes to, or as COLUMNS states them; 0 where it is none."""
    try:
        if not stream.isatty():
            return 0
        stated = os.environ.get("COLUMNS", "")
        return int(stated) if stated.isdecimal() else os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError):  # closed, or without a file descriptor
        return 0


def has_styles(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether terminals get bold and colours: not with NO_COLOR (no-color.org), nor on one that cannot."""
    can = os.name == "posix" or "WT_SESSION" in environment
    return can and not environment.get("NO_COLOR") and environment.get("TERM", "dumb") not in ("dumb", "")


def dressed(text: str, *, columns: int, styles: bool) -> str:
    """The text for a terminal of that width, in lines that break between words.

    A document (JSON) is left as it is: it is read by programs.
    """
    if columns < LEAST_COLUMNS or text.lstrip()[:1] in ("{", "["):
        return text
    return "\n".join(_dressed_line(line, columns, styles=styles) for line in text.split("\n"))


def _dressed_line(line: str, columns: int, *, styles: bool) -> str:
    if shown_columns(line) > columns:
        end = COMMAND_END if line.startswith("$ ") else ""
        wrapper = textwrap.TextWrapper(
            width=columns - len(end),
            subsequent_indent=" " * _indent(line),
            break_long_words=False,
            break_on_hyphens=False,
            replace_whitespace=False,
            expand_tabs=False,
        )
        filled = "".join(letter + _WIDE * _is_wide(letter) for letter in line)
        whole = wrapper.wrap(re.sub(_UNIT, _JOINED, filled))
        line = f"{end}\n".join(whole).replace(_JOINED, " ").replace(_WIDE, "")
    style = next((style for lead, style in STYLES.items() if line.startswith(lead)), "") if styles else ""
    return "\n".join(f"\x1b[{style}m{part}\x1b[0m" for part in line.split("\n")) if style else line


def _indent(line: str) -> int:
    """Columns to the text of a row beside its name, or a little more than those before a sentence."""
    margin = len(line) - len(line.lstrip())
    name, gap, rest = line[margin:].partition("  ")
    beside = margin + shown_columns(name) + len(gap) + len(rest) - len(rest.lstrip())
    return beside if gap and beside <= MOST_NAME else margin + _HANGING if margin <= _HANGING else margin
