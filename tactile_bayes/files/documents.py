"""Safe reading of JSON and TOML: limited size and depth, finite numbers, no control characters or surrogates."""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from tactile_bayes.declarations import from_plain, schema_name
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.kinds import kind_of, schema_kind
from tactile_bayes.files.reading import JSON_BYTES, TOML_BYTES, decoding, read_text

MOST_LEVELS: Final = 64
MOST_KEY_PARTS: Final = 16
T = TypeVar("T")
_LARGEST: Final = sys.float_info.max
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")  # and turned text
# the parser's time grows with the square of a key's parts
_LONG_KEY: Final = re.compile(
    rf"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*(?:\.[ \t]*(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*){{{MOST_KEY_PARTS}}}"""
)


def read_record(path: Path, kind: type[T], *, way_out: str = "give a file this program wrote") -> T:
    """Read a record from its JSON or TOML file.

    Raises
    ------
    BadDataError
        When the file cannot be read, is of another kind, or a field is none of what the record declares.
    """
    document = load_toml(path, way_out=way_out) if path.suffix == ".toml" else load_json(path, way_out=way_out)
    return parse_record(document, kind, path=path)


def parse_record(document: object, kind: type[T], *, path: Path) -> T:
    """A record from a document that was read; for the errors see `read_record`."""
    wanted = schema_kind(schema_name(kind))
    found = schema_kind(document.get("schema")) if isinstance(document, dict) else ""
    if wanted and found and found != wanted:
        raise BadDataError(f"is {found}, not {wanted}", way_out=f"give {wanted}", path=str(path))
    try:
        return from_plain(kind, document)
    except BadDataError as error:
        raise error.at(path) from None


def load_json(path: Path, *, way_out: str = "give a file this program wrote") -> object:
    """Read a JSON file of any content.

    Raises
    ------
    BadDataError
        When it cannot be read or is not JSON, is too large or too deep, or holds a number that no double holds.
    """
    try:
        return parse_json(read_text(path, most=JSON_BYTES, way_out=way_out), way_out=way_out)
    except BadDataError as error:
        kind = kind_of(path)
        if kind and not kind.endswith("(JSON)"):
            raise BadDataError(f"is {kind}, not a JSON file", way_out=way_out, path=str(path)) from None
        raise error.at(path) from None


def parse_json(text: str, *, name: str = "", way_out: str = "copy the file again") -> object:
    """Parse a JSON text; for the errors see `load_json`.

    Parameters
    ----------
    name
        Of the part of a file that the text is, for the error; empty for a whole file.
    """
    with decoding(f"{name} is not JSON".lstrip(), way_out=way_out):
        document: object = json.loads(text, object_pairs_hook=partial(_object, way_out=way_out))
    check_plain(document, way_out=way_out, name=name)
    return document


def _object(pairs: list[tuple[str, Any]], *, way_out: str) -> dict[str, Any]:
    """A JSON object, in which no key may stand twice: programs differ in which of the values they take."""
    found = dict(pairs)
    if len(found) < len(pairs):
        (twice, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise BadDataError(f"holds the key {twice[:40]!a} twice in one object", way_out=way_out)
    return found


def load_toml(path: Path, *, way_out: str) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    BadDataError
        When it cannot be read or is not TOML, is too large or too deep, or holds a number that no double holds.
    """
    try:
        text = read_text(path, most=TOML_BYTES, way_out=way_out)
        return parse_toml(text.removeprefix("\ufeff"), way_out=way_out)  # the mark that some editors begin a file with
    except BadDataError as error:
        raise error.at(path) from None


def parse_toml(text: str, *, way_out: str) -> dict[str, Any]:
    """Parse a TOML text; for the errors see `load_toml`."""
    import tomllib

    long = _LONG_KEY.search(text)
    if long:
        line = text.count("\n", 0, long.start()) + 1
        raise BadDataError(f"line {line}: a key of more than {MOST_KEY_PARTS} parts", way_out=way_out)
    with decoding("is not TOML", way_out=way_out):
        document = tomllib.loads(text)
    check_plain(document, way_out=way_out)
    return document


def check_plain(document: object, *, way_out: str, name: str = "") -> None:
    """Refuse data that no report can hold: too deep, no finite numbers, broken or control characters.

    Raises
    ------
    BadDataError
        Naming the first such value.
    """
    level = [(name, document)]
    for _ in range(MOST_LEVELS):
        level = [part for where, item in level for part in _parts(where, item, way_out=way_out)]
        if not level:
            return
    raise BadDataError(f"is nested more than {MOST_LEVELS} levels deep", way_out=way_out)


def _parts(where: str, item: object, *, way_out: str) -> Iterator[tuple[str, object]]:
    """Members of a container with their places in it; a single value is checked."""
    if isinstance(item, dict):
        for key, value in item.items():
            yield "", key
            yield (f"{where}.{key}" if where else str(key)), value
    elif isinstance(item, list):
        if all(type(value) is float and -_LARGEST <= value <= _LARGEST for value in item):
            return  # a calibration has tens of thousands of them: no place is spelled that no error names
        yield from ((f"{where}[{i}]", value) for i, value in enumerate(item))
    elif isinstance(item, int | float) and not -_LARGEST <= item <= _LARGEST:
        value = str(item) if isinstance(item, float) else f"a whole number of {len(str(abs(item)))} digits"
        raise BadDataError(
            f"{where or 'the document'} is {value}", way_out=f"give a finite number of at most {_LARGEST:.3g}"
        )
    elif isinstance(item, str):
        check_text(where, item, way_out=way_out)


def check_text(where: str, text: str, *, way_out: str) -> None:
    """Refuse a text with surrogates, control characters or marks that turn what follows.

    Raises
    ------
    BadDataError
        Naming the place and the character.
    """
    if not text.isascii() and any("\ud800" <= letter <= "\udfff" for letter in text):
        raise BadDataError(f"{where or 'a key'} holds a broken character: {text[:40]!a}", way_out=way_out)
    if not text.isprintable() and (found := _CONTROL.search(text)):
        code = f"U+{ord(found[0]):04X}"  # a terminal obeys some, a table's reader stumbles over all
        raise BadDataError(f"{where or 'a key'} holds the character {code}: {text[:40]!a}", way_out=way_out)
