"""Write the pages of the Python reference, from docstrings: the public names, then each subpackage with its modules.

The pages go to docs/generated, which git ignores, so that they follow the modules wherever these move.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from pathlib import Path
from types import ModuleType

from sphinx.application import Sphinx

import tactile_bayes

LIBRARY = ("scans", "geometry", "presets", "errors", "mapping", "forward", "inference", "size", "posterior", "trial")
"""What computes. Commands, devices, files and reports are described by the command reference and the guides."""


def write_pages(app: Sphinx) -> None:
    """Write the pages that are new or have changed, and remove those of packages that are gone."""
    folder = Path(app.srcdir) / "generated" / "python"
    folder.mkdir(parents=True, exist_ok=True)
    pages = {f"{name}.rst": text for name, text in _pages().items()}
    for path in folder.iterdir():
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _pages() -> dict[str, str]:
    """A page for each subpackage, and one for the modules beside them."""
    packages = {info.name: info.ispkg for info in pkgutil.iter_modules(tactile_bayes.__path__) if info.name in LIBRARY}
    beside = [f"tactile_bayes.{name}" for name in LIBRARY if not packages.get(name)]
    pages = {name: _package_page(name) for name in LIBRARY if packages.get(name)}
    return pages | {"tb": _public_page(), "basics": _page("basics", "What every package uses.", beside)}


def _public_page() -> str:
    """What `import tactile_bayes as tb` offers: functions first, then what they return."""
    found = {name: getattr(tactile_bayes, name) for name in tactile_bayes.__all__}
    functions = [f".. autofunction:: tactile_bayes.{name}\n" for name, one in found.items() if inspect.isfunction(one)]
    # also what several results share: sizes, draws, findings
    options = "   :members:\n   :inherited-members: Record\n   :exclude-members: __init__, __new__\n"
    classes = [f".. autoclass:: tactile_bayes.{name}\n{options}" for name, one in found.items() if inspect.isclass(one)]
    title = "import tactile_bayes as tb"
    parts = [f"{title}\n{'=' * len(title)}\n", f"{_words(tactile_bayes)}\n"]
    for heading, entries in (("Functions", functions), ("Results", classes)):
        parts += [f"{heading}\n{'-' * len(heading)}\n", *entries]
    return "\n".join(parts)


def _package_page(name: str) -> str:
    package = importlib.import_module(f"tactile_bayes.{name}")
    modules = [info.name for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.") if not info.ispkg]
    return _page(name, _words(package), modules)


def _words(module: ModuleType) -> str:
    return (module.__doc__ or "").strip()


def _page(title: str, words: str, modules: list[str]) -> str:
    parts = [f"{title}\n{'=' * len(title)}\n", f"{words}\n"]
    for module in modules:
        heading = module.removeprefix("tactile_bayes.")
        parts.append(f"{heading}\n{'-' * len(heading)}\n\n.. automodule:: {module}\n   :members:\n")
    return "\n".join(parts)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
