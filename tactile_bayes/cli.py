"""The command line: one table of commands, each loaded only when it is called."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import re
import signal
import sys
from collections.abc import Iterable

import click

from tactile_bayes import __version__, shell
from tactile_bayes.errors import EXIT_FAULT, EXIT_INTERRUPTED, EXIT_READER_GONE, EXIT_USAGE, TactileBayesError

_HYPHEN = "\ue000"  # Replaces a hyphen while lines are wrapped: "--array-calibration" is a word to copy.


class UnbrokenHelp(click.HelpFormatter):
    """Help whose lines fit narrow terminals too and do not break at hyphens."""

    def __init__(self, indent_increment: int = 2, width: int | None = None, max_width: int | None = None) -> None:
        super().__init__(indent_increment, width, max_width)  # never below 50 columns
        if columns := shell.terminal_columns(shell.raw_stream(sys.stdout)):
            self.width = min(self.width, max(columns, shell.LEAST_COLUMNS) - 2)

    def write(self, string: str) -> None:
        super().write(string.replace(_HYPHEN, "-"))

    def write_text(self, text: str) -> None:
        super().write_text(_unbroken(text))

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        col_max = col_max if self.width >= 48 else 16  # else no room is left for the texts
        super().write_dl([(_unbroken(term), _unbroken(text)) for term, text in rows], col_max, col_spacing)


def _unbroken(text: str) -> str:
    """The text with `_HYPHEN` for the hyphens of words and options."""
    return re.sub(r"(?<=[\w-])-(?=\w)|(?<!\S)-(?=[\w-])", _HYPHEN, text)


click.Context.formatter_class = UnbrokenHelp

# group -> name -> (function in a module under tactile_bayes.commands, imported when it runs; one line of help)
GROUPS: dict[str, dict[str, tuple[str, str]]] = {
    "An exam, from scan to size": {
        "demo": ("exam.demo_command", "Run the main job on an embedded scan, and a trial's report."),
        "import": ("exam.import_command", "Bring other people's arrays, grids and images in."),
        "check": ("exam.check_command", "Check how the array, sensor and rotations of a scan lie."),
        "map": ("estimate.map_command", "Build a tactile map from one or more scans."),
        "estimate": ("estimate.estimate_command", "Lump size with a credible interval from tactile maps."),
        "report": ("estimate.report_command", "Write one page of an exam to read and to print."),
        "compare": ("estimate.compare_command", "Compare a mass's size at two visits and more: has it grown?"),
        "show": ("exam.show_command", "Say what any of our files is and how good it is."),
        "export": ("exam.export_command", "Write DICOM, FHIR, NRRD (3D Slicer) or CSV (REDCap)."),
    },
    "A trial": {
        "campaign": ("trial.campaign_command", "From a folder of exams to the trial's report."),
        "validate": ("trial.validate_command", "Compare sizes with excision: accuracy of each modality."),
        "plan": ("trial.plan_command", "Plan a trial: how many patients, how many maps of a mass."),
    },
    "Devices": {
        "record": ("devices.record_command", "Record a scan head and a tracker into a scan file."),
        "repair": ("devices.repair_command", "Close a scan file that was cut off: what is intact is kept."),
        "replay": ("devices.replay_command", "Play a scan as if it were recorded, with the live view."),
        "devices": ("devices.devices_command", "List the serial ports with a guess at what is on them."),
        "emulate": ("devices.emulate_command", "Serve a scan as a scan head or a tracker would send it."),
    },
    "The laboratory": {
        "calibrate": ("laboratory.calibrate_command", "Learn a calibration of sizes or of an array."),
        "diagnose": ("exam.diagnose_command", "Check a posterior's draws: convergence and figures."),
        "simulate": ("laboratory.simulate_command", "Make a scan with known truth from a scene."),
        "study": ("laboratory.study_command", "Amplitude and width over sizes, depths and stiffnesses."),
        "tables": ("laboratory.tables_command", "Compute Tables 1 and 2 of the paper again."),
        "head": ("laboratory.head_command", "How evenly a scan head presses, and the best head."),
        "population": ("laboratory.population_command", "Simulate exams of varied bodies, to calibrate with."),
        "sbc": ("laboratory.sbc_command", "Check the posterior of a map against simulated maps."),
        "compare-model": ("laboratory.compare_model_command", "Compare a scan and its map with a forward model."),
        "tradeoff": ("laboratory.tradeoff_command", "Measure what more accuracy costs, here and now."),
    },
}
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}


class LazyGroup(click.Group):
    """A group that lists its commands from a table and imports one when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        del ctx
        return list(COMMANDS)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            import difflib

            near = difflib.get_close_matches(name, COMMANDS, n=1)
            advice = f"; did you mean {near[0]}?" if near else ""
            if not near and (os.path.exists(name) or "." in name):  # noqa: PTH110 (no pathlib is loaded here)
                advice = "; the command stands first: `tactile-bayes show FILE` says what a file is"
            ctx.fail(f"No such command {name!r}{advice}")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        del ctx
        if cmd_name not in COMMANDS:
            return None
        module, name = COMMANDS[cmd_name][0].split(".")
        command = getattr(importlib.import_module(f"tactile_bayes.commands.{module}"), name)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        del ctx
        width = max(map(len, COMMANDS))
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), text) for name, (_, text) in group.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="tactile-bayes")
def cli() -> None:
    """Lump size with an honest credible interval from tactile maps. Research use only.

    Start with `tactile-bayes demo`; the way through is import, map, estimate, report.
    """


COLLECT_AFTER = 100_000
"""New objects between two searches for cycles. With Python's own 700 a command's start has 65, which free nothing."""


def main() -> None:
    """Run the program; every known error becomes one line on stderr and its documented exit code."""
    if sys.platform == "win32":
        sys.exit("error: Windows is not supported; install and run tactile-bayes in WSL (Linux on Windows)")
    gc.set_threshold(COLLECT_AFTER)
    atexit.register(gc.freeze)  # the process ends: a last search for cycles gains nothing
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C would change the exit code
    # The matrices here are small: more threads cost CPU and gain nothing, and workers would fight over the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.pop("MPLBACKEND", None)  # a notebook's, which may not be installed here; figures are drawn without one
    shell.protect_streams()
    try:
        with shell.interrupt_on_signals():
            status = _run()
    except KeyboardInterrupt:  # a second one, while the first was handled
        status = EXIT_INTERRUPTED
    shell.release_streams()
    sys.exit(status)


def _run() -> int:
    """Run the command of the command line; return its exit code."""
    try:
        status = cli.main(prog_name="tactile-bayes", standalone_mode=False)
        sys.stdout.flush()
    except click.Abort as error:
        progress = str(error.__cause__ or "")  # of a batch: how many items are done
        click.echo(f"interrupted: {progress}" if progress else "interrupted", err=True)
        return EXIT_INTERRUPTED
    except click.UsageError as error:  # click has others for editors and files of its own, which are not used
        _print_error(error)
        return error.exit_code
    except TactileBayesError as error:
        click.echo(f"error: {error}", err=True)
        return error.exit_code
    except shell.ReaderGoneError:
        return EXIT_READER_GONE
    except (OSError, MemoryError) as error:
        if _folder_gone():
            click.echo("error: the current folder is no longer there; change to one that is (cd)", err=True)
            return EXIT_USAGE
        click.echo(f"error: {_system_fault(error)}", err=True)
        return EXIT_FAULT
    return status if isinstance(status, int) else 0


def _print_error(error: click.UsageError) -> None:
    """Print an error of click's in one line, as all others; the help where no command or argument was given."""
    if type(error).__name__ == "NoArgsIsHelpError":  # of click 8.2 and later
        error.show()
        return
    message = " ".join(error.format_message().split()).rstrip(".")
    message = message.replace("is not a valid float", "is not a number")
    path = "" if error.ctx is None else error.ctx.command_path
    if not path and sys.argv[1:2] and sys.argv[1] in COMMANDS:
        path = f"tactile-bayes {sys.argv[1]}"  # the parser's own errors have no context
    joint = " See" if message.endswith("?") else "; see"
    advice = f"{joint} `{path} --help`" if path else ""
    click.echo(f"error: {message}{advice}", err=True)


def _folder_gone() -> bool:
    """True if the current folder was removed since the program started."""
    try:
        os.getcwd()  # noqa: PTH109 (no pathlib is loaded here)
    except FileNotFoundError:
        return True
    return False


def _system_fault(error: OSError | MemoryError) -> str:
    """Describe an error of the operating system that no command handled, in one line."""
    if isinstance(error, MemoryError):
        return "the memory did not suffice; give a smaller file, or a machine with more"
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"
