"""The wheel holds all the program needs away from its checkout, and little more."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCHEMAS = sorted(path.name for path in (ROOT / "data_schema").glob("*.json"))
DEMO_FILES = sorted(path.relative_to(ROOT) for path in (ROOT / "tactile_bayes" / "demo").rglob("*") if path.is_file())
MOST_BYTES = 3_000_000

LOAD = """
import sys, tactile_bayes
from tactile_bayes.files.documents import load_schema
for name in sys.argv[1:]:
    assert load_schema(name)
print(tactile_bayes.__file__)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's content on a path of its own."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_the_wheel_is_small(wheel):
    assert wheel.stat().st_size <= MOST_BYTES


def test_the_wheel_holds_every_schema(installed):
    assert SCHEMAS
    assert sorted(path.name for path in (installed / "tactile_bayes" / "data_schema").glob("*.json")) == SCHEMAS


def test_the_wheel_holds_the_demo(installed):
    data = [path for path in DEMO_FILES if path.suffix not in (".py", ".pyc")]
    assert data, "there is nothing to demonstrate"
    assert [path for path in data if not (installed / path).is_file()] == []


def test_the_wheel_holds_the_templates_of_pages(installed):
    templates = Path("tactile_bayes", "report", "templates")
    ours = sorted(path.name for path in (ROOT / templates).iterdir())
    assert {"page.html", "style.css"} <= set(ours)
    assert sorted(path.name for path in (installed / templates).iterdir()) == ours


def test_the_wheel_holds_every_module_and_no_tests(installed):
    ours = {path.relative_to(ROOT) for path in (ROOT / "tactile_bayes").rglob("*.py")}
    theirs = {path.relative_to(installed) for path in installed.rglob("*.py")}
    assert theirs == ours


def test_the_wheel_installs_the_program(installed):
    (entry_points,) = installed.glob("*.dist-info/entry_points.txt")
    assert "tactile-bayes = tactile_bayes.__main__:main" in entry_points.read_text()


@pytest.mark.parametrize("layout", ["checkout", "wheel"])
def test_schemas_are_found_in_both_layouts(layout, installed, run_python, tmp_path):
    root = ROOT if layout == "checkout" else installed
    loaded = run_python("-c", LOAD, *SCHEMAS, cwd=tmp_path, env={"PYTHONPATH": str(root)})
    assert loaded.returncode == 0, loaded.stderr
    assert Path(loaded.stdout.strip()).is_relative_to(root)


def test_a_missing_schema_is_named(run_python):
    asked = run_python("-c", LOAD, "no_such.schema.json")
    assert "no_such.schema.json is not installed" in asked.stderr
