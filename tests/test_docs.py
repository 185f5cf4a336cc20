"""The documents say what the program does: generated pages are fresh, every example parses, and pages run as printed.

`doc_pages` says what a page's blocks are, and which may be left out of a run.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
import tomllib
from pathlib import Path
from typing import get_args

import click
import h5py
import pytest
from doc_pages import PROGRAM, Command, Reader, blocks_of, check_words, commands_of, not_printed

import tactile_bayes as tb
from tactile_bayes import errors
from tactile_bayes.cli import COMMANDS, cli
from tactile_bayes.declarations import names_of
from tactile_bayes.files.arrays_layout import LAYOUT, OPTIONAL, in_words
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.map_nc import MapHeader
from tactile_bayes.presets import Background, ExportFormat, Noise, Normalise, TrackerProtocol
from tactile_bayes.report.estimate_text import SOURCES

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *(DOCS / "guides").glob("*.md"), *ROOT.glob("README.md")])
DECISIONS = sorted((DOCS / "decisions").glob("*.md"))
RUN_ELSEWHERE = (DOCS / "guides" / "python.md", DOCS / "gallery.md")
"""tests/api/test_pages.py and tests/test_gallery.py run them, and look at what they find."""

_spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
assert _spec is not None
assert _spec.loader is not None
make_reference = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make_reference)

EXAMPLES = [found for page in PAGES for found in commands_of(page)]
RUN_PAGES = sorted({found.page for found in EXAMPLES if not found.mark} - set(RUN_ELSEWHERE))


def all_commands() -> list[tuple[tuple[str, ...], click.Command]]:
    return list(make_reference.every_command(cli))


def test_the_generated_pages_are_fresh():
    for path, text in make_reference.pages().items():
        assert path.read_text(encoding="utf-8") == text, "run `make docs`"


def test_every_command_is_documented_with_every_option():
    written = (DOCS / "commands.md").read_text(encoding="utf-8")
    assert {words[0] for words, _ in all_commands()} == set(COMMANDS)
    for words, command in all_commands():
        section = written.split(f"## {PROGRAM} {' '.join(words)}\n")[1].split("\n## ")[0]
        for parameter in command.params:
            assert all(f"`{name}`" in section for name in parameter.opts if name.startswith("-")), parameter.name


def test_every_command_and_option_has_a_help():
    silent = [" ".join(words) for words, command in all_commands() if not command.help]
    silent += [
        f"{' '.join(words)} {parameter.opts[0]}"
        for words, command in all_commands()
        for parameter in command.params
        if isinstance(parameter, click.Option) and not parameter.help
    ]
    assert silent == []


@pytest.mark.parametrize("found", EXAMPLES, ids=str)
def test_an_example_parses(found: Command):
    words = found.words
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
        assert set(words[1:]) <= set(targets)
    elif words[0] == PROGRAM:
        check_words(words[1:])
    else:
        assert words[0] in ("pip", "echo", "mkdir") or PROGRAM in words, f"{found}: what is {found.text!r}?"


def test_examples_in_the_help_parse():
    for words, command in all_commands():
        for text in re.findall(rf"{PROGRAM} [^\n`]+", command.help or ""):
            try:
                check_words(tuple(shlex.split(text.strip().removesuffix("."))[1:]))
            except click.ClickException as error:
                pytest.fail(f"help of {' '.join(words)}: {text!r}: {error.format_message()}")


@pytest.mark.parametrize("words", ["nothing", "map --no-such-option", "report map.nc", "map a -o b --normalise twice"])
def test_a_wrong_example_would_be_found(words):
    with pytest.raises(click.UsageError):
        check_words(tuple(words.split()))


def test_blocks_are_read_with_their_marks_and_what_they_print(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ tactile-bayes map a.mcap \\\n    -o b.nc  # exits 3\nsome output\n```\n"
        "```sh setup\nmake demo\n```\n```toml a.toml\nx = 1\n```\n"
        "```console device\n$ cat b\n$ tactile-bayes show b.nc\n```\n```text\nno file\n```\n"
    )
    found = commands_of(page)
    assert [(one.line, one.text, one.mark, one.exit_code, one.printed) for one in found] == [
        (2, "tactile-bayes map a.mcap -o b.nc", "", 3, ("some output",)),
        (7, "make demo", "setup", 0, ()),
        (13, "cat b", "device", 0, ()),
        (14, "tactile-bayes show b.nc", "device", 0, ()),
    ]
    assert [(one.file_name, one.text) for one in blocks_of(page) if one.file_name] == [("a.toml", "x = 1\n")]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("```console\n$ tactile-bayes show nothing.nc\n```\n", "page.md:2: ended with 3"),
        ("```console\n$ tactile-bayes show f.toml  # exits 0\n```\n", "page.md:2: ended with"),
        ("```console\n$ tactile-bayes --version\nversion 77\n```\n", "does not print 'version 77'"),
        ("```console later\n$ tactile-bayes --version\n```\n", "later is none of"),
        ("```python\nassert False, 'python runs'\n```\n", "python runs"),
    ],
)
def test_a_page_that_does_not_run_is_found(text, fault, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(AssertionError, match=fault):
        Reader(tmp_path, tmp_path / "demos").follow(page)


def test_printed_lines_are_looked_for_in_their_order():
    printed = "first\nsecond  \nthird\n"
    assert not_printed(("first", "...", "third"), printed) == ""
    assert not_printed(("third", "first"), printed) == "first"


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """Where the pages keep the demo's files; one folder for all processes of a test run."""
    base = tmp_path_factory.getbasetemp()
    return (base if worker_id == "master" else base.parent) / "demos"


EXTRAS = {"export.md": ("highdicom", "fhir.resources", "nrrd")}
"""Packages without which a page cannot run."""


QUICK_PAGES = ("complete-with-tab.md", "import.md", "other-heads.md", "record.md")
"""Those that take a second or two; the others run maps and estimates that have their own tests."""


@pytest.mark.long
@pytest.mark.parametrize(
    "page",
    [pytest.param(one, marks=() if one.name in QUICK_PAGES else pytest.mark.slow) for one in RUN_PAGES],
    ids=lambda page: page.name,
)
def test_a_page_runs_as_printed(page, tmp_path, demos):
    for package in EXTRAS.get(page.name, ()):
        pytest.importorskip(package)
    Reader(tmp_path, demos).follow(page)


def test_every_settings_block_is_a_file_that_a_command_reads():
    """A block of TOML without a name would be tried by nobody."""
    for page in PAGES:
        for block in blocks_of(page):
            if block.language == "toml":
                assert block.file_name, f"{page.name}:{block.line}"
                tomllib.loads(block.text)


@pytest.mark.parametrize("page", [*PAGES, *DECISIONS], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"[a-z]+:|#", link)]
    assert [link for link in links if not (page.parent / link.split("#")[0]).exists()] == []


def test_the_files_that_a_newcomer_is_told_to_read_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    files = re.findall(r"`([\w/]+\.py)`", text)
    assert len(files) > 20
    assert [name for name in files if not any((base / name).is_file() for base in (ROOT, ROOT / "tactile_bayes"))] == []
    packages = re.findall(r"`(\w+)/`", text)
    assert {path.parent.name for path in (ROOT / "tactile_bayes").glob("*/__init__.py")} == set(packages)


def table_under(heading: str, page: Path) -> list[list[str]]:
    """The cells of the first table under a heading of a page, without its head."""
    section = re.split(r"^#+ ", page.read_text(encoding="utf-8").split(f"## {heading}\n")[1], flags=re.MULTILINE)[0]
    table = next(block for block in section.split("\n\n") if block.lstrip()[:1] == "|")
    rows = [line.strip().removeprefix("|").removesuffix("|") for line in table.strip().splitlines()]
    return [[cell.strip() for cell in row.split("|")] for row in rows[2:]]


def test_the_formats_page_has_the_arrays_of_a_scan():
    rows = table_under("Scan arrays (`.npz`)", DOCS / "formats.md")
    wanted = []
    for name, one in LAYOUT.items():
        optional = " (may be left out)" if name in OPTIONAL else ""
        wanted.append([f"`{name}`{optional}", in_words(one.shape), one.meaning])
    assert [[row[0], row[1], row[-1]] for row in rows] == wanted


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("formats.md", names_of(MapHeader)),
        ("trackers.md", get_args(TrackerProtocol)),
        ("guides/export.md", get_args(ExportFormat)),
    ],
)
def test_a_page_names_all_that_a_file_holds_or_an_option_takes(page, names):
    written = (DOCS / page).read_text(encoding="utf-8")
    assert [name for name in names if f"`{name}`" not in written] == []


def test_a_size_table_takes_the_values_of_the_options_that_state_the_same():
    columns = {one["name"]: one for one in load_schema("size_table.table.json")["fields"]}
    for name, choices in (("noise", Noise), ("normalise", Normalise), ("background", Background)):
        assert set(columns[name]["constraints"]["enum"]) == set(get_args(choices)), name


@pytest.mark.long
@pytest.mark.parametrize(
    ("heading", "file", "group"),
    [
        ("Maps (`.nc`)", "map.nc", "/"),
        ("Posteriors (`.nc`)", "posterior.nc", "posterior"),
    ],
)
def test_the_formats_page_has_the_variables_of_a_netcdf_file(heading, file, group, demos, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"```console\n$ {PROGRAM} demo -o demo\n```\n")
    Reader(tmp_path, demos).follow(page)
    rows = table_under(heading, DOCS / "formats.md")
    with h5py.File(tmp_path / "demo" / file) as whole:
        arrays = {name: values for name, values in whole[group].items() if isinstance(values, h5py.Dataset)}
        held = {name: len(values.shape) for name, values in arrays.items() if "NAME" not in values.attrs}
        scales = set(arrays) - set(held)
    if group == "/":  # the cells' centres were called x_mm and y_mm in the first maps
        held = {name.removesuffix("_mm"): length for name, length in held.items()} | dict.fromkeys(
            scales & {"x", "y"}, 1
        )
        assert {row[0].strip("`"): row[1].count(",") + 1 for row in rows} == held
    else:
        assert {name for row in rows for name in re.findall(r"`(\w+)`", row[0])} == set(held)


def test_the_shares_of_variance_are_those_of_the_demo():
    """docs/how-a-size-comes-about.md has the shares of both intervals of the demo's map."""
    document = tb.estimate(tb.demo_map()).answer.document
    first, second = document["another_exam"]["variance_share"], document["variance_share"]
    rows = table_under("What makes an interval wide", DOCS / "how-a-size-comes-about.md")
    shares = {row[0]: row[2:4] for row in rows}
    assert set(shares) == set(SOURCES.values())
    for source, name in SOURCES.items():
        percents = [one.get(source) for one in (first, second)]
        assert shares[name] == ["" if p is None else f"{p:.0f} %" if p >= 0.5 else "below 0.5 %" for p in percents]


def test_the_exit_codes_are_those_of_the_program():
    rows = re.findall(r"^\| (\d+) \|", (DOCS / "exit-codes.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    codes = {value for name, value in vars(errors).items() if name.startswith("EXIT_")}
    assert {int(row) for row in rows} == codes | {errors.TactileBayesError.exit_code}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_documented_and_prints_a_script(shell, run_cli):
    assert f"_TACTILE_BAYES_COMPLETE={shell}_source {PROGRAM}" in (DOCS / "guides" / "complete-with-tab.md").read_text(
        encoding="utf-8"
    )
    printed = run_cli(env={"_TACTILE_BAYES_COMPLETE": f"{shell}_source"})
    assert printed.returncode == 0, printed.stderr
    assert f"_TACTILE_BAYES_COMPLETE={shell}_complete" in printed.stdout


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (f"{PROGRAM} est", "estimate"),
        (f"{PROGRAM} map --norm", "--normalise"),
        (f"{PROGRAM} map --normalise ga", "gain"),
    ],
)
def test_tab_completes_commands_options_and_choices(words, wanted, run_cli):
    asked = {"_TACTILE_BAYES_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    completed = run_cli(env=asked)
    assert completed.returncode == 0, completed.stderr
    assert completed.stdout.split() == [f"plain,{wanted}"]
