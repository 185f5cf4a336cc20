"""JSON and TOML: safe parsing, schemas, protocols of trials and session facts."""

from __future__ import annotations

import difflib
import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from tactile_bayes.declarations import Meta, Record, field, from_plain, names_of, schema_name, short_repr
from tactile_bayes.errors import BadDataError, in_file, suggestion
from tactile_bayes.files import reading
from tactile_bayes.options import Posture, Side, TrialSettings

# --- The schemas in data_schema/, from a wheel or a checkout.

_PACKAGE = Path(__file__).resolve().parent.parent


@cache
def load_schema(name: str) -> dict[str, Any]:
    """Load the schema ``data_schema/NAME`` (``size_calibration.schema.json``, ``trial.table.json``...)."""
    for folder in (_PACKAGE / "data_schema", _PACKAGE.parent / "data_schema"):
        if (folder / name).is_file():
            return dict(json.loads((folder / name).read_text(encoding="utf-8")))
    raise FileNotFoundError(f"schema {name} is not installed with this program")


def dump_json(document: object) -> str:
    """Format as JSON with a fixed layout; refuses NaN and infinities, which JSON does not have."""
    return json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


# --- Safe reading of JSON and TOML: limited size and depth, finite numbers, no control characters or surrogates.

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
    """Read a record from its JSON file."""
    return parse_record(load_json(path, way_out=way_out), kind, path=path)


def read_toml_record(path: Path, kind: type[T], *, way_out: str) -> T:
    """Read a record from its TOML file, whatever it is called; for the errors see `read_record`."""
    return parse_record(load_toml(path, way_out=way_out), kind, path=path)


def parse_record(document: object, kind: type[T], *, path: Path) -> T:
    """Make a record of plain data; for the errors see `read_record`."""
    schema = schema_name(kind)
    if schema and isinstance(document, dict) and (stated := document.get("schema", schema)) != schema:
        kind_expected, kind_read = reading.schema_kind(schema), reading.schema_kind(stated)
        if kind_read not in ("", kind_expected):
            raise reading.of_another_kind(path, kind_read, kind_expected, way_out=f"give {kind_expected}")
        raise BadDataError(f"schema is {short_repr(stated)}", way_out=f"give {schema!r}", path=str(path))
    with in_file(path):
        return from_plain(kind, document)


def load_json(path: Path, *, way_out: str = "give a file this program wrote") -> object:
    """Read a JSON file of any content. Too large, too deep or a number that no double holds is an error."""
    try:
        return parse_json(reading.read_text(path, most=reading.JSON_BYTES, way_out=way_out), way_out=way_out)
    except BadDataError as error:
        kind = reading.kind_of(path)
        if kind and not kind.endswith("(JSON)"):
            raise BadDataError(f"is {kind}, not a JSON file", way_out=way_out, path=str(path)) from None
        raise error.with_path(path) from None


def parse_json(text: str, *, name: str = "", way_out: str = reading.COPY_AGAIN) -> object:
    """Parse a JSON text as `load_json` does; `name` is the part of a file that the text is, empty for a whole file."""
    with reading.decoding(f"{name} is not JSON".lstrip(), way_out=way_out):
        document: object = json.loads(text, object_pairs_hook=partial(_object, way_out=way_out))
    check_plain(document, way_out=way_out, name=name)
    return document


def _object(pairs: list[tuple[str, Any]], *, way_out: str) -> dict[str, Any]:
    """A JSON object; a doubled key is refused, as programs differ in which of its values they take."""
    members = dict(pairs)
    if len(members) < len(pairs):
        (twice, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise BadDataError(f"holds the key {twice[:40]!a} twice in one object", way_out=way_out)
    return members


def load_toml(path: Path, *, way_out: str) -> dict[str, Any]:
    """Read a TOML file. Too large, too deep or a number that no double holds is an error."""
    with in_file(path):
        return parse_toml(reading.read_text(path, most=reading.TOML_BYTES, way_out=way_out), way_out=way_out)


def parse_toml(text: str, *, way_out: str) -> dict[str, Any]:
    """Parse a TOML text; for the errors see `load_toml`."""
    long = _LONG_KEY.search(text)
    if long:
        line = text.count("\n", 0, long.start()) + 1
        raise BadDataError(f"line {line}: a key of more than {MOST_KEY_PARTS} parts", way_out=way_out)
    with reading.decoding("is not TOML", way_out=way_out):
        document = tomllib.loads(text)
    check_plain(document, way_out=way_out)
    return document


def check_plain(document: object, *, way_out: str, name: str = "") -> None:
    """Refuse data that no report can hold: too deep, no finite numbers, broken or control characters."""
    level = [(name, document)]
    for _ in range(MOST_LEVELS):
        level = [part for where, item in level for part in _parts(where, item, way_out=way_out)]
        if not level:
            return
    raise BadDataError(f"is nested more than {MOST_LEVELS} levels deep", way_out=way_out)


def _parts(where: str, item: object, *, way_out: str) -> Iterator[tuple[str, object]]:
    """Members of a container, each with its place; any other value is checked."""
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
        what = f"{where or 'the document'} is {value}"
        raise BadDataError(what, way_out=f"give a finite number of at most {_LARGEST:.3g}")
    elif isinstance(item, str):
        check_text(where, item, way_out=way_out)


def check_text(where: str, text: str, *, way_out: str) -> None:
    """Refuse a text with surrogates, control characters or marks of the writing direction."""
    if not text.isascii() and any("\ud800" <= letter <= "\udfff" for letter in text):
        raise BadDataError(f"{where or 'a key'} holds a broken character: {text[:40]!a}", way_out=way_out)
    if not text.isprintable() and (match := _CONTROL.search(text)):
        code = f"U+{ord(match[0]):04X}"  # a terminal obeys some, a table's reader stumbles over all
        raise BadDataError(f"{where or 'a key'} holds the character {code}: {text[:40]!a}", way_out=way_out)


class Protocol(Record, forbid_unknown_fields=False):
    """A pre-specified analysis of a trial."""

    title: str | None = None  #: Title of the report.
    analysis: TrialSettings = field(default_factory=TrialSettings)
    """Settings fixed beforehand; an option that contradicts one is refused."""


def read_protocol(path: Path) -> tuple[str | None, dict[str, Any]]:
    """Title, and the `TrialSettings` that ``[analysis]`` fixes; other keys enter only the file's hash."""
    document = load_toml(path, way_out="give the analysis as TOML")
    protocol = parse_record(document, Protocol, path=path)
    return protocol.title, {name: getattr(protocol.analysis, name) for name in document.get("analysis", {})}


# --- Session facts of a recording as TOML: side, posture, lubricant, examiner, subject and other text.

SET_BY_RECORDING: Final = (
    *("head_id", "tracker_id", "source", "clock", "rotation", "tool", "reference", "array_calibration_days"),
)
"""Keys that the recording itself writes."""
OF_A_PERSON: Final = (
    *("name", "patient", "patient_name", "examiner_name", "date_of_birth", "birth_date", "address", "phone"),
)
"""Keys that no session may have."""
Text64 = Annotated[str, Meta(max_length=64)]
_CODE: Final = "a text in quotes of up to {} letters from A to Z and a to z, digits, _ and -"
Code = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,32}$", extra={"words": _CODE.format(32)})]
Examiner = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,16}$", extra={"words": _CODE.format(16)})]
Days = Annotated[str, Meta(pattern="^-?[0-9]{1,6}$", extra={"words": "a whole number of days in quotes"})]
_FACT_NAME: Final = "^[a-z][a-z0-9_]{0,39}$"
FactName = Annotated[str, Meta(pattern=_FACT_NAME)]
Fact = Annotated[str, Meta(max_length=2000, extra={"words": "a text in quotes of up to 2000 letters"})]


class Session(Record, forbid_unknown_fields=False):
    """Session of a scan.

    Plain text facts about one scan: the metadata record `session` of a scan file. Every value is text. Codes only:
    nothing here may identify a person.
    """

    head_id: Text64 | None = None  #: Identity of the scan head.
    array_id: Text64 | None = None  #: Identity or serial number of the pressure array.
    tracker_id: Text64 | None = None  #: Identity or serial number of the tracker.
    side: Side | None = None  #: Breast that was scanned, or a phantom.
    posture: Posture | None = None  #: Posture during the scan.
    lubricant: Text64 | None = None  #: Lubricant on the skin; `none` for none.
    examiner: Examiner | None = None  #: Coded examiner, not a name.
    subject: Code | None = None  #: Coded subject, not a name.
    visit: Code | None = None  #: Code of the visit; `campaign init` takes 1 where it is left out.
    mass: Code | None = None  #: Code of the mass within the subject; `campaign init` takes 1 where it is left out.
    array_calibration_days: Days | None = None  #: Age of the array calibration at the recording, in whole days.
    source: Text64 | None = None  #: Where the scan came from: recorded, imported, simulated.


_OTHER_WORDS: Final = {
    "side": ("breast", "laterality", "brust", "seite", "cote", "sein", "lado", "seno", "lato"),
    "subject": ("patient_id", "patient_code", "participant", "patientin", "paciente", "paziente"),
    "examiner": ("operator", "untersucher", "examinateur"),
    "visit": ("besuch", "visita"),
}
"""Names under which a fact would be lost, by its own."""


def check_session(session: Mapping[str, object], *, path: Path) -> None:
    """Check the facts of a scan: those of `Session`, and others, which are texts with names in small letters."""
    for name in session:
        if name in OF_A_PERSON:
            way_out = "leave it out: nothing here may identify a person"
            raise BadDataError(f"{name} may not be given", way_out=way_out, path=str(path))
        if not re.search(_FACT_NAME, name):
            near = suggestion(name, names_of(Session))
            way_out = near if near.startswith("did") else "keys are of small letters, digits and _"
            raise BadDataError(f"{short_repr(name)} is not known", way_out=way_out, path=str(path))
    parse_record(dict(session), Session, path=path)
    parse_record(dict(session), dict[FactName, Fact], path=path)


def read_session(path: Path | None) -> dict[str, str]:
    """Read the session facts; none without a file."""
    if path is None:
        return {}
    document = load_toml(path, way_out='give facts as TOML: side = "left"')
    for key in SET_BY_RECORDING:
        if key in document:
            raise BadDataError(f"{key} is set by the recording itself", way_out=f"leave {key} out", path=str(path))
    known = set(names_of(Session)).difference(SET_BY_RECORDING)
    for key in document:
        near = [name for name, words in _OTHER_WORDS.items() if key in words]
        near = near or difflib.get_close_matches(key, known, n=1, cutoff=0.8)
        if near and near[0] not in document:
            raise BadDataError(f"{key} is not known", way_out=f"did you mean {near[0]}?", path=str(path))
    check_session(document, path=path)
    return document
