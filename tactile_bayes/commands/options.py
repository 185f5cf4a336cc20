"""Options and arguments that several commands share."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args, get_origin

import click

from tactile_bayes.api.settings import Settings, read_settings
from tactile_bayes.declarations import Record, default_of, extra_of, field_types, meaning_of, range_of, value_type
from tactile_bayes.errors import BY_OPTIONS, UsageError, number_words
from tactile_bayes.files.atomic import Format, check_suffix, refuse_existing, refuse_same
from tactile_bayes.options import RecordOptions
from tactile_bayes.presets import HEADS
from tactile_bayes.report import figure_file
from tactile_bayes.shell import raise_if_interrupted

# --- Paths on the command line: an output may be neither an input nor another output of the same command.

WRITTEN: Final = frozenset(
    {"output", "figure", "map_figure", "fit_figure", "figures", "html", "pdf", "trace", "rank", "corner", "dictionary"}
)
"""Options that name a command's outputs; every other path is an input."""
_SEEN: Final = "tactile_bayes.paths"
_FOLDERS: Final = "tactile_bayes.folders"


class FilePath(click.Path):
    """Path that is checked against the other paths of the call before the command runs.

    Symbolic and hard links to one file are that file. With `addresses` the address of an object store is allowed too,
    and stays a text. `writes` is the format of an output, by which its suffix is checked; such a file is `guarded` by
    default: it is only overwritten with --force.
    """

    def __init__(
        self, *, addresses: bool = False, writes: Format | Literal["figure"] | None = None, guarded: bool | None = None
    ) -> None:
        super().__init__(path_type=Path, readable=False)  # its reader reports it in one line
        self._addresses, self.writes = addresses, writes
        self.guarded = writes is not None if guarded is None else guarded

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Record and return the path; refuse an output that another argument of the command reads or writes."""
        if self._addresses and "://" in str(value):
            return str(value)
        if str(value) in ("", "-"):
            fault = "'-' (standard input or output) is not taken" if value else "the path is empty"
            self.fail(f"{fault}; give the name of a file or folder", param, ctx)
        path = Path(os.path.expanduser(os.fsdecode(super().convert(value, param, ctx))))  # noqa: PTH111 (~x may be a file)
        if ctx is not None and param is not None:
            written = param.name in WRITTEN
            seen: list[tuple[Path, bool]] = ctx.meta.setdefault(_SEEN, [])
            for other, other_written in seen:
                if written and other_written:
                    refuse_same([path], [other], role="two outputs of this command")
                elif written or other_written:
                    refuse_same([path], [other])
            seen.append((path, written))
            if str(value).endswith(os.sep):
                ctx.meta.setdefault(_FOLDERS, []).append(path)
        if self.writes is not None and str(value).endswith(os.sep) and not path.is_dir():
            raise UsageError(f"{value} is the name of a folder; name a file, in a folder that exists")
        if self.writes == "figure":
            figure_file.check_suffix(path)
        elif self.writes is not None:
            check_suffix(path, self.writes)
        return path


def is_folder(path: Path) -> bool:
    """True for a folder, and for a path that the call wrote with a slash at its end."""
    return path.is_dir() or path in click.get_current_context().meta.get(_FOLDERS, ())


def protect_inputs(*paths: Path | None) -> None:
    """Refuse the call if it would write one of these further inputs."""
    seen: list[tuple[Path, bool]] = click.get_current_context().meta.get(_SEEN, [])
    refuse_same([path for path, written in seen if written], paths)


def typed_options() -> set[str]:
    """Names of the options on the command line, those by default left out."""
    context = click.get_current_context()
    command_line = click.core.ParameterSource.COMMANDLINE
    return {name for name in context.params if context.get_parameter_source(name) is command_line}


def command(
    name: str, action: str, *, within: click.Group | None = None, kind: type[click.Command] = click.Command
) -> Callable[[Callable[[], None]], click.Command]:
    """Make a command, alone or within a group, of its options and of an empty function whose docstring is its help.

    The `action` names a module of `tactile_bayes.actions`, imported when the command runs, and a function there that
    takes the options by their names; a number that it returns is the exit code. It is called only if the guarded
    outputs do not exist or --force is given.
    """
    module, function = action.split(".")

    def make(documented: Callable[[], None]) -> click.Command:
        @wraps(documented)
        def run(**values: Any) -> None:
            context = click.get_current_context()
            guarded = [str(param.name) for param in context.command.params if getattr(param.type, "guarded", False)]
            refuse_existing(*(values[name] for name in guarded), force=values.get("force", False))
            token = BY_OPTIONS.set(True)
            try:
                act = getattr(import_module(f"tactile_bayes.actions.{module}"), function)
                raise_if_interrupted()  # while it was imported
                code = act(**values)
            finally:
                BY_OPTIONS.reset(token)
            if code:
                context.exit(code)

        return (within or click).command(name, cls=kind)(run)

    return make


class CommandGroup(click.Group):
    """A group whose help has the whole first sentence of each of its commands."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        del ctx
        rows = [(name, made.get_short_help_str(limit=1000)) for name, made in sorted(self.commands.items())]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def head_option(default: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--head``; its help ends with a sentence about the default."""
    return click.option(
        "--head",
        type=click.Choice(HEADS),
        help="Place of the head's rounded shoulders: cut into the sensing width, or around it, where they press and "
        f"sense nothing. {default}",
    )


def make_settings(*, settings_file: Path | None = None, repeatability: Path | None = None, **options: Any) -> Settings:
    """Settings from options and from the files that they name, none of which may be an output of the call."""
    from tactile_bayes.files.size_json import read_repeatability, size_calibration_path

    if (calibration := options.get("size_calibration")) is not None:
        protect_inputs(size_calibration_path(calibration))
    if repeatability is not None:
        options["repeatability"] = read_repeatability(repeatability)
    if settings_file is None:
        return Settings(**options)
    settings = Settings(**options, **read_settings(settings_file))
    protect_inputs(settings.checkpoint)
    if settings.checkpoint is not None:
        refuse_same([settings.checkpoint], [settings_file])
    return settings


# --- Options shared by several commands, and value types: finite numbers, numbers or words.

if TYPE_CHECKING:
    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType  # takes no parameter before click 8.4


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class FiniteRange(click.FloatRange):
    """A finite number in a range; nan and infinity are refused."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        with contextlib.suppress(click.BadParameter):
            number = super().convert(value, param, ctx)
            if math.isfinite(number):
                return number
        text, share = str(value), ""
        with contextlib.suppress(ValueError, click.BadParameter):
            percent = text.removesuffix("%").strip()
            part = super().convert(float(percent) / 100, param, ctx)
            if (percent != text or part > 0.01) and self.max is not None and self.max <= 1:
                share = f"; for {percent} % give {part:g}"
        words = number_words(self.min, self.max, ("min", "max") if self.min_open or self.max_open else ())
        return self.fail(f"{text!r} is not {words}{share}", param, ctx)

    def _describe_range(self) -> str:
        """The range as help shows it; empty without ends."""
        return "" if self.min is None and self.max is None else super()._describe_range()


class WholeRange(click.IntRange):
    """A whole number in a range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        with contextlib.suppress(click.BadParameter):
            return super().convert(value, param, ctx)
        again = "; repeat the option for each of several" if param is not None and param.multiple else ""
        return self.fail(f"{str(value)!r} is not {number_words(self.min, self.max, (), whole=True)}{again}", param, ctx)


class NumberOr(_ParamType):
    """A number, whole or not, or one of some words."""

    name = "number"

    def __init__(self, *words: str, number: type[float] = float) -> None:
        self.words, self.number = words, number

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Convert to the number, or return the word."""
        if value in self.words:
            return str(value)
        try:
            return self.number(value)
        except ValueError:
            self.fail(f"{value!r} is not a number, nor {' nor '.join(map(repr, self.words))}", param, ctx)


def record_options(record: type[Record], *names: str, **attributes: Any) -> Decorator:
    """The options of a command for some fields of a record, in this order; for all where none is named.

    Type, range, default and help come from the field's declaration, `metavar` and the name from its ``extra``;
    `attributes` of `click.option` replace them.
    """
    return _chain(*(_option(record, name, attributes) for name in names or record.__struct_fields__))


def _chain(*options: Decorator) -> Decorator:
    """One decorator of several options, in the order of the command's help."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def _option(record: type[Record], name: str, attributes: Mapping[str, Any]) -> Decorator:
    kind, default = field_types(record)[name], default_of(record, name)
    bare, extra = value_type(kind), extra_of(kind)
    flag = f"--{extra.get('option', name).replace('_', '-')}"
    second_name = [f"--{extra['also']}"] if "also" in extra else []
    declared: dict[str, Any] = {"help": meaning_of(kind), "metavar": extra.get("metavar")}
    if default is False:
        declared["is_flag"] = True
    elif bare is bool:
        flag, declared["default"] = f"{flag}/--no-{flag[2:]}", None
    else:
        multiple = get_origin(bare) is tuple and get_args(bare)[1:] == (...,)
        declared["type"] = _click_type(get_args(bare)[0] if multiple else kind)
        declared |= {"multiple": True} if multiple else {}
        declared |= {"default": default, "show_default": True} if default not in (None, (), "") else {}
        if isinstance(declared["type"], NumberOr) and default is not None:
            declared["default"] = default if isinstance(default, str) else f"{default:g}"
    declared |= attributes
    choices = getattr(declared.get("type"), "choices", ())
    if not declared["metavar"] and len("|".join(choices)) > MOST_CHOICES:
        declared["help"] += f" One of {', '.join(choices)}."
        declared["metavar"] = name.rpartition("_")[2].upper()
    return click.option(flag, *second_name, name, **declared)


MOST_CHOICES: Final = 50  #: Letters of an option's choices up to which its help lists them beside its name.


def _click_type(kind: Any) -> Any:
    """The click type of a kind."""
    bare = value_type(kind)
    if words := [word for one in get_args(bare) if get_origin(one) is Literal for word in get_args(one)]:
        return NumberOr(*words, number=int if int in map(value_type, get_args(bare)) else float)
    if get_origin(bare) is Literal:
        return click.Choice([one for one in get_args(bare) if one])
    if get_origin(bare) is tuple:
        return tuple(map(_click_type, get_args(bare)))
    if bare in (Path, Any):  # an object in Python is a file on the command line
        return FilePath()
    if bare not in (int, float):
        return str
    least, most, open_ends = range_of(kind)
    if bare is int:
        return WholeRange(least, most)
    return FiniteRange(least, most, min_open="min" in open_ends, max_open="max" in open_ends)


FORCE = click.option("--force", is_flag=True, help="Overwrite existing outputs.")


def output_option(
    metavar: str, writes: Format | None, meaning: str, *, guarded: bool | None = None, **attributes: Any
) -> Decorator:
    """``-o``: a command's output, see `FilePath`; `writes` is None for a folder or a file of several formats."""
    path_type = FilePath(writes=writes, guarded=guarded)
    return click.option("-o", "--output", metavar=metavar, type=path_type, help=meaning, **attributes)


def figure_option(meaning: str, name: str = "--figure") -> Decorator:
    """``--figure``, or another option that names a figure to write."""
    return click.option(name, metavar="FIG.png|.pdf|.svg", type=FilePath(writes="figure"), help=meaning)


def number_option(name: str, kind: _ParamType, default: float, meaning: str, **attributes: Any) -> Decorator:
    """An option of a number with a default that its help shows."""
    return click.option(name, type=kind, default=default, show_default=True, help=meaning, **attributes)


def path_option(
    name: str, metavar: str, meaning: str, *, writes: Format | None = None, required: bool = False
) -> Decorator:
    """An option that names a file or a folder."""
    return click.option(name, metavar=metavar, type=FilePath(writes=writes), help=meaning, required=required)


def page_options(metavar: str, title: str) -> Decorator:
    """``--pdf``, ``--title`` and ``--name`` of a page."""
    return _chain(
        path_option("--pdf", metavar, PRINTED),
        click.option("--title", default="", help=f"Title of the page. Default: {title}."),
        click.option("--name", default="", help="Name to print on the page. Default: none."),
    )


PRINTED: Final = "Also print it to PDF, by an installed Chromium or WeasyPrint."
SESSION = record_options(
    RecordOptions,
    "session_file",
    help="Facts of the exam for the scan: subject, side, posture, examiner, visit and more, in plain text.",
)
JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
SPEED = number_option("--speed", FiniteRange(0.01, 100.0), 1.0, "Playback speed; 1 is real time.")
WORKERS = number_option("--workers", WholeRange(min=0), 1, "Number of worker processes.")


def scheduler_option(items: str) -> Decorator:
    """``--scheduler``; `items` names the work that is sent to it."""
    return click.option("--scheduler", metavar="ADDRESS", help=f"Send {items} to a dask scheduler (extra [cluster]).")
