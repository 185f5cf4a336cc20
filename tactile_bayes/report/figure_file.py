"""Figure files: PNG, PDF or SVG by suffix; with the same libraries, equal input gives equal bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Final

from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import refuse_existing, write_bytes
from tactile_bayes.findings import Finding, finding_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI: Final = 150
# Suffix -> what would be written about the program and the time, each None: left out.
FORMATS: Final[dict[str, dict[str, None]]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Creator": None, "Date": None, "Format": None, "Type": None},
}


def check_suffix(path: Path) -> None:
    """Refuse a file name without a known suffix: PNG, PDF or SVG.

    Raises
    ------
    UsageError
        Naming the suffix and those that are known.
    """
    if path.suffix.lower() not in FORMATS:
        known = ", ".join(FORMATS)
        if not path.suffix:
            raise UsageError(f"{path} does not say which kind of figure it is; name it {path}.png ({known})")
        raise UsageError(f"{path} has the suffix {path.suffix!r}; a figure is written as one of {known}")


@contextmanager
def figure_file(
    path: Path | None, *, size_in: tuple[float, float], force: bool, findings: Sequence[Finding] = ()
) -> Iterator[Figure]:
    """Give a figure that is written when the block ends, independent of the user's matplotlib settings.

    Parameters
    ----------
    path
        Its suffix says the format; None writes nothing, the figure is for a notebook.
    size_in
        Width and height in inches.
    force
        Overwrite an existing file.
    findings
        What speaks against what is shown, told above it.

    Raises
    ------
    UsageError
        When the suffix is unknown, or `path` exists and `force` is false.
    """
    import matplotlib
    from matplotlib.figure import Figure

    if path is not None:
        check_suffix(path)
        refuse_existing(path, force=force)
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams["svg.hashsalt"] = "tactile-bayes"  # else the names inside an SVG are random
        width_in, height_in = size_in
        told = [part for line in finding_lines(findings, paper=True) for part in wrap(line, round(13 * width_in))]
        figure = Figure(figsize=(width_in, height_in + 0.17 * len(told)), dpi=DPI, layout="constrained")
        figure.get_layout_engine().set(rect=(0.0, 0.04, 1.0, 0.96))  # type: ignore[union-attr,call-arg]
        yield figure
        if told:
            title = figure.get_suptitle()
            figure.suptitle("\n".join([*told, *([title] if title else [])]), x=0.01, ha="left", fontsize=9.5)
        if path is None:
            return
        suffix = path.suffix.lower()
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix.removeprefix("."), dpi=DPI, metadata=FORMATS[suffix])
    write_bytes(path, buffer.getvalue(), force=force)
