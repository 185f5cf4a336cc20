"""Figures as files, with a title and a date that do not vary."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import refuse_existing, write_bytes
from tactile_bayes.findings import Finding, finding_lines
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes = Figure = Any  # which take long to load


# --- Names for the titles of figures: what the scans say of the exam, else the file's name; never digests.

_CODE: Final = re.compile(r"[A-Za-z0-9_.-]{1,32}")


def exam_title(name: str, scans: Sequence[Mapping[str, str]]) -> str:
    """Such as ``"P07, left, mass 1, visit 2 (exam)"``; what is no code is left out, and `$` starts no formula.

    `name`: of the map; may be empty; `scans`: as `Provenance.scans` has them. Of a fact on which they differ each value
    is named.
    """
    facts = []
    for fact in ("subject", "side", "mass", "visit"):
        codes = dict.fromkeys(code for scan in scans if _CODE.fullmatch(code := scan.get(fact, "")))
        words = f"{fact}{'s' if len(codes) > 1 else ''} " if fact in ("mass", "visit") else ""
        facts += [words + " and ".join(codes)] if codes else []
    plain = name.replace("$", r"\$")
    if not facts:
        return plain
    return f"{', '.join(facts)} ({plain})" if plain else ", ".join(facts)


# --- Figure files: PNG, PDF or SVG by suffix; with the same libraries, equal input gives equal bytes.

DPI: Final = 150
_FOOT_IN: Final = 0.4  #: Room for a caption below what is drawn.
# Suffix -> what would be written about the program and the time, each None: left out.
FORMATS: Final[dict[str, dict[str, None]]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Creator": None, "Date": None, "Format": None, "Type": None},
}


def check_suffix(path: Path) -> None:
    """Refuse a file name without a known suffix: PNG, PDF or SVG."""
    if path.suffix.lower() not in FORMATS:
        known = ", ".join(FORMATS)
        if not path.suffix:
            raise UsageError(f"{path} does not say which kind of figure it is; name it {path}.png ({known})")
        raise UsageError(f"{path} has the suffix {path.suffix!r}; a figure is written as one of {known}")


def load_matplotlib() -> Any:
    """Matplotlib with the parts that figures are made of; loaded here alone, for it takes long."""
    import matplotlib.backends.backend_agg
    import matplotlib.figure
    import matplotlib.patheffects

    return matplotlib


@contextmanager
def plain_matplotlib() -> Iterator[Any]:
    """Matplotlib without the user's own settings."""
    library = load_matplotlib()
    with library.rc_context():
        library.rcdefaults()
        library.rcParams["svg.hashsalt"] = "tactile-bayes"  # else the names inside an SVG are random
        yield library


@contextmanager
def figure_file(
    path: Path | None,
    *,
    size_in: tuple[float, float],
    force: bool,
    foot: str | None = "",
    findings: Sequence[Finding] = (),
    trim: bool = False,
) -> Iterator[Figure]:
    """Give a figure that is written when the block ends, independent of the user's matplotlib settings.

    `path`: its suffix says the format; None writes nothing, the figure is for a notebook; an unknown suffix, and a file
    that exists without `force`, are refused. `foot`: words at its foot, before those on its use; None for neither;
    `findings`: what speaks against what is shown, told above it; `trim`: let the figure end below what is drawn, where
    that needs less than its height.
    """
    if path is not None:
        check_suffix(path)
        refuse_existing(path, force=force)
    with plain_matplotlib() as library:
        width_in, height_in = size_in
        above = [part for line in finding_lines(findings, paper=True) for part in wrap(line, round(13 * width_in))]
        figure = library.figure.Figure(figsize=(width_in, height_in + 0.17 * len(above)), dpi=DPI, layout="constrained")
        figure.get_layout_engine().set(rect=(0.0, 0.04, 1.0, 0.96))
        yield figure
        if foot is not None:
            figure.text(0.01, 0.01, f"{foot}  {RESEARCH_USE}".strip(), fontsize=7.5, color="0.3")
        if above:
            title = figure.get_suptitle()
            figure.suptitle("\n".join([*above, *([title] if title else [])]), x=0.01, ha="left", fontsize=9.5)
        if trim:
            figure.draw_without_rendering()
            lowest = min(axes.get_tightbbox().y0 for axes in figure.axes) / figure.dpi
            figure.set_figheight(figure.get_figheight() - max(0.0, lowest - _FOOT_IN))
        if path is None:
            return
        suffix = path.suffix.lower()
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix.removeprefix("."), dpi=DPI, metadata=FORMATS[suffix])
    write_bytes(path, buffer.getvalue(), force=force)


def label(axes: Axes, title: str, across: str, up: str) -> None:
    """Title and labels."""
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel(across, fontsize=9)
    axes.set_ylabel(up, fontsize=9)


def finish(axes: Axes, title: str, across: str, up: str, *, headroom: float = 0.0, **looks: Any) -> None:
    """Title, labels, and a legend where something is named.

    `headroom`: space above the curves for the legend, as a share of their height; `looks`: of the legend.
    """
    if headroom:
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + headroom * (high - low))
    label(axes, title, across, up)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**{"fontsize": 7.5, "frameon": False} | looks)
