"""Pages from templates: every text is escaped, and all have one style sheet and one content policy."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES: Final = Path(__file__).with_name("templates")


def page(kind: str, *, title: str, images: str = "data:", script_sha256: str = "", **values: Any) -> str:
    """A page of the kind "exam", "trial" or "campaign".

    `images` is where its pictures may come from; `script_sha256` is of the one script that may run, in base 64.
    """
    scripts = f"; script-src 'sha256-{script_sha256}'" if script_sha256 else ""
    template = _environment().get_template(f"{kind}.html")
    return template.render(kind=kind, title=title, images=images, scripts=scripts, **values)


def cut(text: str, longest: int = 400) -> str:
    """A text in one line of at most so many letters."""
    line = " ".join(text.split())
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # only where a page is made

    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["cut"] = cut
    return made
