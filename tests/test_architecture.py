"""The rules of the house that a reader cannot keep in mind: who imports whom, and what no module may do."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
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
ACTION = re.compile(r'"(\w+)\.(\w+_action)"')
MOST_INSIDE = 30


def name_of(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@cache
def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(text_of(path), filename=str(path))


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(path)))


def dotted(node: ast.AST) -> str:
    """``np.random.seed`` of the expression that says so; empty for one that is no name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


@cache
def calls(path: Path) -> frozenset[str]:
    return frozenset(dotted(node.func) for node in nodes_of(path) if isinstance(node, ast.Call))


@cache
def imported(path: Path) -> frozenset[str]:
    """Every module that is imported, at the top or inside a function."""

    def names() -> Iterator[str]:
        for node in nodes_of(path):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module
            elif isinstance(node, ast.Call) and dotted(node.func) in ("importlib.import_module", "__import__"):
                yield from (str(arg.value) for arg in node.args[:1] if isinstance(arg, ast.Constant))

    return frozenset(names())


def importers(package: str) -> list[str]:
    """The modules that import `package` or a part of it."""
    return [name_of(path) for path in MODULES if any(name.split(".")[0] == package for name in imported(path))]


def broken(rule: Callable[[Path], Iterator[str]], modules: list[Path] = MODULES) -> list[str]:
    """``module: fault`` of every module that breaks the rule."""
    return [f"{name_of(path)}: {fault}" for path in modules for fault in rule(path)]


def test_imports_go_one_way(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(ROOT))
    status = lint_imports(config_filename="pyproject.toml", no_cache=True)
    assert status == 0, capsys.readouterr().out


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """Modules that import themselves by way of others, one circle of them; arrows lead to those that are imported."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def for_types(path: Path) -> set[int]:
    """The nodes of `path` that only a type checker reads."""
    blocks = [node for node in nodes_of(path) if isinstance(node, ast.If) and "TYPE_CHECKING" in dotted(node.test)]
    return {id(node) for block in blocks for node in ast.walk(block)}


def arrows_of_the_package() -> dict[str, set[str]]:
    """Imports that happen when the program runs, at the top or in a function."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in MODULES}
    found: dict[str, set[str]] = {}
    for name, path in names.items():
        unread = for_types(path)
        run = [node for node in nodes_of(path) if id(node) not in unread]
        wanted = {alias.name for node in run if isinstance(node, ast.Import) for alias in node.names}
        for node in run:
            if isinstance(node, ast.ImportFrom) and node.module:
                wanted |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        found[name] = wanted & set(names) - {name}
    return found


@pytest.mark.long
def test_no_file_imports_itself_by_way_of_others():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}  # the control
    arrows = arrows_of_the_package()
    assert sum(map(len, arrows.values())) > 500
    assert circle(arrows) == []


@pytest.mark.long
def test_few_imports_stand_in_functions():
    """A reader sees at the top what a file needs; figures, devices and help texts spare their heavy ones."""
    inside = {
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        for function in nodes_of(path)
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


def test_a_module_opens_with_one_sentence():
    def rule(path: Path) -> Iterator[str]:
        first = (ast.get_docstring(tree_of(path)) or "").split("\n\n")[0].replace("\n", " ")
        if not first.endswith((".", "``.")) or not (first[0].isupper() or not first[0].isalpha()):
            yield f"no sentence: {first!r}"

    assert broken(rule) == []


def test_a_module_can_be_read_in_one_sitting():
    """A longer one is split by what it is about."""

    def rule(path: Path) -> Iterator[str]:
        lines = text_of(path).count("\n")
        if lines > MOST_LINES:
            yield f"{lines} lines"

    assert broken(rule) == []


def test_no_hidden_state_and_no_surprises():
    never = {"np.random.seed", "numpy.random.seed", "random.seed", "eval", "exec", "os.system"}

    def rule(path: Path) -> Iterator[str]:
        yield from calls(path) & never
        # a generator without a seed inside the program is a result nobody can make again
        if "np.random.default_rng()" in text_of(path):
            yield "a generator without a seed"

    assert broken(rule) == []


def test_the_core_does_not_print():
    def rule(path: Path) -> Iterator[str]:
        yield from calls(path) & {"print", "pprint", "sys.stdout.write", "click.echo"}

    assert broken(rule, CORE) == []
    assert broken(rule) != []  # the control: the shell does


def test_a_fault_with_a_message_is_an_error_of_ours():
    """`assert` vanishes under -O; a bare one, which tells the type checker something, may stay."""

    def rule(path: Path) -> Iterator[str]:
        for node in nodes_of(path):
            if isinstance(node, ast.Assert) and node.msg is not None:
                yield f"line {node.lineno}: raise an error of ours instead of an assert with a message"

    assert broken(rule) == []


def test_every_command_names_a_function_that_is_there():
    named = [one for path in MODULES if path.parent.name == "commands" for one in ACTION.findall(text_of(path))]
    assert len(named) == sum(len(actions_in(path)) for path in MODULES)
    for module, function in named:
        assert function in actions_in(PACKAGE / "actions" / f"{module}.py")


def actions_in(path: Path) -> list[str]:
    """Functions of a file of actions that a command calls."""
    functions = [node.name for node in tree_of(path).body if isinstance(node, ast.FunctionDef)]
    return [name for name in functions if name.endswith("_action")] if path.parent.name == "actions" else []


def test_public_functions_and_classes_say_what_they_do():
    def rule(path: Path) -> Iterator[str]:
        for node in tree_of(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                decorators = {dotted(getattr(one, "func", one)) for one in node.decorator_list}
                if not (ast.get_docstring(node) or "overload" in decorators):
                    yield f"{node.name} (line {node.lineno}) says nothing"

    assert broken(rule) == []
