"""The page and the notebook on Python run as they stand."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

import tactile_bayes as tb

DOCS = Path(__file__).resolve().parents[2] / "docs" / "guides"


def blocks_of_page() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (DOCS / "python.md").read_text(), re.MULTILINE | re.DOTALL)


def cells_of_notebook() -> list[str]:
    cells = json.loads((DOCS / "python.ipynb").read_text())["cells"]
    return ["".join(one["source"]) for one in cells if one["cell_type"] == "code"]


def run(blocks: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"block {number}", "exec"), names)
    return names


@pytest.mark.long
def test_the_python_guide_runs_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = run(blocks_of_page(), tmp_path, monkeypatch)
    said = capsys.readouterr().out
    assert names["low"] < 15.0 < names["high"]
    assert (tmp_path / "size.png").read_bytes()[:4] == b"\x89PNG"
    assert repr(names["estimate"]) in (DOCS / "python.md").read_text()
    assert "as stated" in said
    assert names["own"].session["imported_as"].startswith("frames in kPa")
    assert names["empty"].max_size_mm is None
    assert names["empty"].why in said
    assert "mape_percent" in said


def test_the_first_block_is_ten_lines() -> None:
    assert len([line for line in blocks_of_page()[0].splitlines() if line]) <= 10


@pytest.mark.long
def test_the_notebook_runs_and_holds_no_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run(cells_of_notebook(), tmp_path, monkeypatch)
    assert isinstance(names["estimate"], tb.SizeEstimate)
    own = tb.estimate(tb.build_map(names["own"])).max_size_mm
    assert own is not None
    assert own.median == pytest.approx(names["estimate"].max_size_mm.median, rel=0.01)
    cells = json.loads((DOCS / "python.ipynb").read_text())["cells"]
    assert not any(one.get("outputs") for one in cells)
