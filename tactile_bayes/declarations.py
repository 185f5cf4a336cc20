"""Records: the fields of a file, an option or a result are declared once; reader, writer and schema follow from that.

A declaration gives a field its type, range and meaning; a `kind` below is such a type with its rules::

    class Head(Record):
        "Grid and curvature of a scan head's taxels."

        rows: Annotated[int, Meta(ge=1)]  #: Taxels across the head.
        radius_mm: Annotated[float, Meta(gt=0)] | None = None  #: Of the arc across the head.

Schemas take the meaning from there. The meaning of an option, printed in a command's help, is a text among its rules:
``every: Annotated[int, Meta(ge=1), "Use one frame of every N."] = 1``; `described` gives a kind its meaning.
`from_plain` makes a record of JSON or TOML data, `to_plain` the reverse; docs/record_schema.py makes the schemas in
data_schema/. Files go through `files.documents.read_record`, which first refuses doubled keys, huge numbers and depth.
Arrays are nested lists in files; `geometry.Vector` and `geometry.Matrix` declare them. A range belongs to its own
member of a union: ``Annotated[int, Meta(ge=1)] | None``. A key that a file may lack is `UNSET`, with `UnsetType` in its
union. A rule between fields stands in ``__post_init__``, which raises `BadDataError`.
No other module imports msgspec.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import date, time
from functools import cache
from operator import methodcaller
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import UNSET as UNSET
from msgspec import Meta as Meta
from msgspec import UnsetType as UnsetType
from msgspec import field as field

from tactile_bayes.errors import BadDataError, UsageError, number_words, suggestion

T = TypeVar("T")
_CONVERSION: Final = RLock()
EXACT: Final = 17  #: Significant digits that give a float back as it was.
MOST_SHOWN: Final = 100  #: A record's repr shows values of up to so many characters, and the type of longer ones.

if TYPE_CHECKING:  # to a type checker each record is frozen, as the class below makes them

    @typing.dataclass_transform(frozen_default=True, field_specifiers=(msgspec.field,))
    class _Struct:
        __struct_fields__: typing.ClassVar[tuple[str, ...]]

        def __init_subclass__(cls, **options: Any) -> None: ...

    S = TypeVar("S", bound=_Struct)

    def replace(record: S, **changes: Any) -> S:
        """A copy of a record with some fields changed."""
else:
    _Struct = msgspec.Struct
    replace = msgspec.structs.replace


class Record(_Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all records: nothing is set later, and a file may hold no other keys.

    Options of a class are those of `msgspec.Struct`: ``eq=False`` where a record holds arrays, ``omit_defaults=True``
    where its files leave defaults out.
    """

    def __repr__(self) -> str:
        values = (f"{name}={_value_repr(getattr(self, name))}" for name in self.__struct_fields__)
        return f"{type(self).__qualname__}({', '.join(values)})"


def described(meaning: str, **rules: Any) -> Meta:
    """`Meta` with a meaning, a range and other rules."""
    return Meta(description=meaning, **rules)


class Options(Record):
    """Options of a command or function: a value that its declaration does not allow is a `UsageError`, also in Python.

    A field's ``extra`` holds what only the command line needs, see `commands.options.record_options`.
    """

    def __post_init__(self) -> None:
        for name, kind in field_types(type(self)).items():
            value = getattr(self, name)
            if _refusal(kind, value, exact=True) is not None:
                fault = _fault(kind, value, name)
                raise UsageError(f"{fault.what}; {fault.way_out}")


def field_types(record: Any) -> Mapping[str, Any]:
    """Declared types of a record's fields, by name."""
    return {info.name: info.type for info in _fields(record)}


@cache
def _fields(record: Any) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Fields of a record, cached: Python evaluates the declarations anew at each call."""
    return msgspec.structs.fields(record)


def default_of(record: Any, name: str) -> Any:
    """The default of a field of options, all of which have one."""
    return next(info.default for info in _fields(record) if info.name == name)


def value_type(kind: Any) -> Any:
    """The bare type of a kind: without None, range and meaning."""
    members = [member for member in _members(kind) if member is not type(None)]
    return _bare(members[0] if len(members) == 1 else kind)


def range_of(kind: Any) -> tuple[Any, Any, tuple[str, ...]]:
    """Least and largest value, None for no end, and the open ends, of "min" and "max"."""
    rules = _rules(next(member for member in _members(kind) if member is not type(None)))
    ends = tuple(end for end, rule in (("min", "gt"), ("max", "lt")) if rule in rules)
    return rules.get("gt", rules.get("ge")), rules.get("lt", rules.get("le")), ends


def meaning_of(kind: Any) -> str:
    """Meaning of a kind: a text among its rules, or that of `described`."""
    texts = [one for one in getattr(kind, "__metadata__", ()) if isinstance(one, str)]
    return texts[0] if texts else str(_rules(kind).get("description", ""))


def extra_of(kind: Any) -> Mapping[str, Any]:
    """The dictionary of a kind's ``Meta(extra=...)``; empty without one."""
    return dict(_rules(kind).get("extra", {}))


def subrecord(record: Any, names: Sequence[str], meaning: str) -> Any:
    """A record of some fields of another, for a file that holds only these; `meaning` is its docstring."""
    fields = [(info.name, info.type, info.default) for info in _fields(record) if info.name in names]
    fields.sort(key=lambda field: names.index(field[0]))
    name = f"{record.__name__}Part"
    return msgspec.defstruct(name, fields, bases=(Record,), namespace={"__doc__": meaning}, frozen=True, kw_only=True)


def set_fields(record: Any, **values: Any) -> None:
    """Set fields of a record in its ``__post_init__``, such as an array that was checked; never later."""
    for name, value in values.items():
        msgspec.structs.force_setattr(record, name, value)


def names_of(kind: Any) -> tuple[str, ...]:
    """Names of the fields of a record, or of a data class."""
    return tuple(getattr(kind, "__struct_fields__", None) or kind.__dataclass_fields__)


def as_dict(record: Any) -> dict[str, Any]:
    """A record's values by name, nested records and data classes as dictionaries too; for JSON see `to_plain`."""

    def plain(value: Any) -> Any:
        return as_dict(value) if isinstance(value, msgspec.Struct) or dataclasses.is_dataclass(value) else value

    return {name: _map_values(getattr(record, name), plain) for name in names_of(record)}


def _map_values(value: Any, function: Callable[[Any], Any], *, lists: bool = False) -> Any:
    """Apply `function` to each value in nested dictionaries, lists and tuples; with `lists` tuples become lists."""
    if isinstance(value, dict):
        return {key: _map_values(one, function, lists=lists) for key, one in value.items()}
    if type(value) in (list, tuple):
        return (list if lists else type(value))(_map_values(one, function, lists=lists) for one in value)
    return function(value)


def from_plain(kind: type[T], document: object, *, where: str = "") -> T:
    """A record of plain data: dictionaries, lists, texts and numbers.

    A `BadDataError` names the field at fault by its path below `where`, its value, and the values that are allowed.
    """
    try:
        return _converted(kind, document)
    except msgspec.ValidationError:
        raise _fault(kind, document, where) from None


def _converted(kind: type[T], document: object) -> T:
    """A record of plain data, in which 200.0 is a whole number, as it is to a schema."""
    try:
        return _convert(kind, document)
    except msgspec.ValidationError:
        return _convert(kind, _map_values(document, _whole))


def _convert(kind: type[T], document: object) -> T:
    """A record of plain data, in one thread at a time: two that use a record type first at once end the process."""
    with _CONVERSION:
        return msgspec.convert(document, kind, dec_hook=_decode_value)


def _whole(value: object) -> object:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def check_record(record: Record, where: str = "") -> None:
    """Check a record that was made in Python against its declaration; for the errors see `from_plain`."""
    from_plain(type(record), to_plain(record, digits=17), where=where)


def to_plain(record: object, *, digits: int = 9) -> Any:
    """Plain data of a record for JSON: arrays as nested lists, floats with this many significant digits."""
    return rounded(msgspec.to_builtins(record, enc_hook=methodcaller("tolist"), str_keys=True), digits, lists=True)


def rounded(value: T, digits: int = 9, *, lists: bool = False) -> T:
    """A record, or plain data, whose floats have so many significant digits; with `lists` tuples become lists."""

    def short(one: Any) -> Any:
        if isinstance(one, msgspec.Struct):
            return type(one)(**{name: rounded(getattr(one, name), digits) for name in one.__struct_fields__})
        return float(f"{one:.{digits}g}") if isinstance(one, float) else one

    result: T = _map_values(value, short, lists=lists)
    return result


def schema_name(kind: Any) -> str | None:
    """The value that the key ``schema`` of a record's files has; None where they have none."""
    declared = _bare(field_types(kind).get("schema")) if _is_record(kind) else None
    return str(get_args(declared)[0]) if get_origin(declared) is Literal else None


def _value_repr(value: Any) -> str:
    """A value's repr; for arrays and long values the type with shape or length: no draws are printed."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return repr(value) if value.shape == () else f"<array {'x'.join(map(str, value.shape))}>"
    text, kind = repr(value), type(value).__qualname__
    if len(text) <= MOST_SHOWN and "\n" not in text:
        return text
    return f"<{kind} of {len(value)}>" if hasattr(value, "__len__") else f"<{kind}>"


def _decode_value(kind: Any, value: object) -> object:
    """Decode a text to a path, or nested lists of numbers to an array, for a field declared as one."""
    if kind is Path:
        if value and isinstance(value, str | Path):
            return Path(value)
        raise BadDataError("", way_out="give the name of a file")
    import numpy as np  # a record without arrays is made without it: `--help` stays quick

    nested, first = float, value  # type: tuple[Any, Any]
    while isinstance(first, list):
        nested, first = list[nested], first[0] if first else 0.0
    if nested is float:
        raise BadDataError("", way_out="give a list of numbers")
    try:
        return np.asarray(msgspec.convert(value, nested), dtype=np.float64)
    except ValueError as error:  # msgspec's is one
        uneven = not isinstance(error, msgspec.ValidationError)
        what = "has rows of different lengths" if uneven else ""
        raise BadDataError(what, way_out="give numbers, the same count in each row") from None


# Errors


def _fault(kind: Any, value: Any, where: str) -> BadDataError:
    """The error of a value that does not fit its kind; it names the innermost part at fault."""
    record = next(filter(_is_record, map(_bare, _members(kind))), None)
    if record is not None and isinstance(value, dict) and (fault := _key_fault(record, value, where)):
        return fault
    for part_path, part_kind, part in _parts_of(kind if record is None else record, value, where):
        if _refusal(part_kind, part) is not None:
            return _fault(part_kind, part, part_path)
    refusal = _refusal(kind, value)
    name = where or "the document"
    if isinstance(refusal, BadDataError):  # of a record's own rules, or of an array
        what = _rule_text(where, refusal.what, record) if refusal.what else f"{name} is {short_repr(value)}"
        return BadDataError(what, way_out=refusal.way_out)
    return BadDataError(f"{name} is {short_repr(value)}", way_out=_way_out(kind, value))


def _rule_text(where: str, what: str, record: Any) -> str:
    """The fault by a record's own rule, or by an array's form, with its path in the file."""
    if not where or record is None:
        return f"{where} {what}".strip()
    return f"{where}.{what}" if what.split(" ")[0] in record.__struct_fields__ else f"{where}: {what}"


def _refusal(kind: Any, value: Any, *, exact: bool = False) -> Exception | None:
    """The error that a kind raises on a value, or None; with `exact` 3.0 is no whole number."""
    try:
        _convert(kind, value) if exact else _converted(kind, value)
    except msgspec.ValidationError as error:
        return error.__cause__ if isinstance(error.__cause__, BadDataError) else error
    return None if _finite(value) else ValueError("no finite number")


def _finite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _key_fault(record: Any, value: Mapping[str, Any], where: str) -> BadDataError | None:
    """The error of the first key that is unknown or missing; None without any."""
    fields = {info.encode_name: info for info in _fields(record)}
    for key in value if record.__struct_config__.forbid_unknown_fields else ():
        if key not in fields:
            return BadDataError(f"{_joined(where, _key_repr(key))} is not known", way_out=suggestion(str(key), fields))
    missing = [name for name, info in fields.items() if info.required and name not in value]
    return BadDataError(f"{where or 'the document'} has no {missing[0]}", way_out="add it") if missing else None


def _parts_of(kind: Any, value: Any, where: str) -> Iterator[tuple[str, Any, Any]]:
    """Path, declared kind and value of each part of a value."""
    if isinstance(value, dict):
        if _is_record(kind):
            fields = {info.encode_name: info.type for info in _fields(kind)}
            yield from ((_joined(where, key), fields[key], one) for key, one in value.items() if key in fields)
            return
        for key_kind, value_kind in (
            get_args(one) for one in map(_bare, _members(kind)) if get_origin(one) in (dict, Mapping)
        ):
            yield from ((_joined(where, f"key {short_repr(key)}"), key_kind, key) for key in value)
            yield from ((_joined(where, _key_repr(key)), value_kind, one) for key, one in value.items())
    if isinstance(value, list | tuple):
        for one in map(_bare, _members(kind)):
            args = get_args(one)
            if _is_array(one):
                args = tuple(one if isinstance(part, list) else float for part in value)
            elif get_origin(one) is list or args[-1:] == (...,):
                args = args[:1] * len(value)
            elif get_origin(one) is not tuple:
                continue
            pairs = zip(args, value, strict=False)
            yield from ((f"{where}[{i}]", part_kind, part) for i, (part_kind, part) in enumerate(pairs))


def _members(kind: Any) -> tuple[Any, ...]:
    """Members of a union, each with its rules; a kind that is no union alone."""
    bare = _bare(kind)
    return get_args(bare) if get_origin(bare) in (typing.Union, types.UnionType) else (kind,)


def _bare(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _is_array(kind: Any) -> bool:
    return getattr(get_origin(kind) or kind, "__name__", "") in ("ndarray", "NDArray")  # an alias from numpy 2.5 on


def _way_out(kind: Any, value: Any) -> str:
    """The advice on a refused value, such as "give a number above 0"."""
    members = [member for member in _members(kind) if member not in (type(None), UnsetType)]
    choices = [str(one) for form in map(_bare, members) if get_origin(form) is Literal for one in get_args(form)]
    if isinstance(value, str) and len(choices) > 1 and (near := suggestion(value, choices)).startswith("did"):
        return f"{near} Give one of {', '.join(choices)}"
    return f"give {' or '.join(dict.fromkeys(_kind_words(one) for one in members))}"


_KINDS: Final[Mapping[Any, str]] = {
    bool: "true or false",
    dict: "a table of keys",
    Mapping: "a table of keys",
    list: "a list",
    tuple: "a list",
    date: "a date such as 2026-01-31",
    type(None): "null",
}


def _kind_words(kind: Any) -> str:
    """A single kind with its range, in words."""
    bare, rules = _bare(kind), _rules(kind)
    origin, args = get_origin(bare) or bare, get_args(bare)
    if origin is Literal:
        return repr(args[0]) if len(args) == 1 else f"one of {', '.join(filter(None, map(str, args)))}"
    if origin in (int, float):
        return number_words(*range_of(kind), whole=origin is int)
    if origin is str:
        return _text_words(rules)
    if origin is tuple and args[-1] is not Ellipsis:
        items = " numbers" if {_bare(one) for one in args} <= {int, float} else ""
        return f"a list of {len(args)}{items}"
    if origin in (list, tuple):
        least, most = rules.get("min_length"), rules.get("max_length")
        length = "" if least is None else f" of {least} or more" if most is None else f" of {least} to {most}"
        return f"a list{length or ('' if most is None else f' of at most {most}')}"
    return "a table of keys" if _is_record(bare) else _KINDS.get(origin, "a list of numbers")


def _text_words(rules: Mapping[str, Any]) -> str:
    """A text's rule: its own words (``extra={"words": ...}``), or its length."""
    if "words" in rules.get("extra", {}):
        return str(rules["extra"]["words"])
    if "min_length" in rules or "max_length" in rules:
        least, most = rules.get("min_length", 0), rules.get("max_length")
        return f"a text of at least {least} letters" if most is None else f"a text of {least} to {most} letters"
    return "a text, in quotes"


_RULES: Final = ("gt", "ge", "lt", "le", "min_length", "max_length", "pattern", "description", "extra")


def _rules(kind: Any) -> dict[str, Any]:
    """Rules of a kind by name; of several `Meta` the later ones stand."""
    rules: dict[str, Any] = {}
    for meta in getattr(kind, "__metadata__", ()):
        rules |= {name: getattr(meta, name) for name in _RULES if getattr(meta, name, None) is not None}
    return rules


def _joined(where: str, key: object) -> str:
    return f"{where}.{key}" if where else str(key)


def _key_repr(key: object) -> str:
    text = str(key)
    return text if text.isidentifier() and len(text) <= 60 else short_repr(key)


def short_repr(value: object) -> str:
    """A value's repr for an error, in up to 60 characters."""
    text = str(value) if isinstance(value, date | time) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
