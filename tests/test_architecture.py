"""The rules of the house that a reader cannot keep in mind: who imports whom, and what no module may do."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "tactile_bayes"
MODULES = sorted(PACKAGE.rglob("*.py"))
# Everything but the shell returns data instead of printing it.
SHELL = {"cli.py", "__main__.py", "actions", "commands", "report"}
CORE = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] not in SHELL]
MOST_LINES = 600
MOST_INSIDE = 155


def name_of(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported(tree: ast.Module) -> Iterator[str]:
    """Every module that is imported, at the top or inside a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "__import__"):
            yield from (arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant))


def importers(package: str) -> list[str]:
    """The modules that import `package` or a part of it."""
    return [name_of(path) for path in MODULES if any(name.split(".")[0] == package for name in imported(tree_of(path)))]


def calls(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


def every_module(function):
    return pytest.mark.parametrize("path", MODULES, ids=name_of)(function)


def test_imports_go_one_way(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(ROOT))
    status = lint_imports(config_filename="pyproject.toml", no_cache=True)
    assert status == 0, capsys.readouterr().out


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Modules that import themselves by way of others; arrows lead from a module to those that it imports."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            for module in arrows.get(waiting.pop(), set()) - seen:
                seen.add(module)
                waiting.append(module)
        return seen

    reach = {module: reached(module) for module in arrows}
    found = {frozenset(b for b in reach[a] if a in reach.get(b, ())) for a in arrows if a in reach[a]}
    return sorted(sorted(circle) for circle in found)


def arrows_of_the_package() -> dict[str, set[str]]:
    """Imports that happen when the program runs, at the top or in a function."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in MODULES}
    found: dict[str, set[str]] = {}
    for name, path in names.items():
        for_types = {
            id(node)
            for block in ast.walk(tree_of(path))
            if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.unparse(block.test)
            for node in ast.walk(block)
        }
        run = [node for node in ast.walk(tree_of(path)) if id(node) not in for_types]
        wanted = {alias.name for node in run if isinstance(node, ast.Import) for alias in node.names}
        for node in run:
            if isinstance(node, ast.ImportFrom) and node.module:
                wanted |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        found[name] = wanted & set(names) - {name}
    return found


def test_no_file_imports_itself_by_way_of_others():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]  # the control
    arrows = arrows_of_the_package()
    assert sum(map(len, arrows.values())) > 500
    assert circles(arrows) == []


def test_few_imports_stand_in_functions():
    """A reader sees at the top what a file needs; figures, devices and help texts spare their heavy ones."""
    inside = {
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        for function in ast.walk(tree_of(path))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert len(inside) <= MOST_INSIDE


@pytest.mark.parametrize("package", ["emcee", "arviz", "msgspec"])
def test_one_module_knows_the_package(package):
    assert len(importers(package)) == 1, f"{package} is imported by {importers(package)}"


@pytest.mark.parametrize("package", ["pickle", "cPickle", "dill", "joblib", "cloudpickle", "shelve", "marshal"])
def test_nothing_is_pickled(package):
    # A pickle runs code when it is read; our files come from other people.
    assert importers(package) == []


@every_module
def test_a_module_opens_with_one_sentence(path):
    docstring = ast.get_docstring(tree_of(path))
    assert docstring, "no docstring"
    first = docstring.split("\n\n")[0].replace("\n", " ")
    assert first.endswith((".", "``.")), f"not a sentence: {first!r}"
    assert first[0].isupper() or not first[0].isalpha(), f"not a sentence: {first!r}"


@every_module
def test_a_module_can_be_read_in_one_sitting(path):
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= MOST_LINES, f"{lines} lines: split it by what it is about"


@every_module
def test_no_hidden_state_and_no_surprises(path):
    found = set(calls(tree_of(path)))
    assert not found & {"np.random.seed", "numpy.random.seed", "random.seed", "eval", "exec", "os.system"}
    # a generator without a seed inside the program is a result nobody can make again
    assert "np.random.default_rng()" not in path.read_text(encoding="utf-8")


@pytest.mark.parametrize("path", CORE, ids=name_of)
def test_the_core_does_not_print(path):
    assert not set(calls(tree_of(path))) & {"print", "pprint", "sys.stdout.write", "click.echo"}


@every_module
def test_a_fault_with_a_message_is_an_error_of_ours(path):
    # `assert` vanishes under -O; a bare one, which tells the type checker something, may stay.
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Assert):
            assert node.msg is None, f"line {node.lineno}: raise an error of ours instead of an assert with a message"


@every_module
def test_public_functions_and_classes_say_what_they_do(path):
    for node in tree_of(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            decorators = {ast.unparse(decorator).split("(")[0] for decorator in node.decorator_list}
            assert ast.get_docstring(node) or "overload" in decorators, f"{node.name} (line {node.lineno}) says nothing"
