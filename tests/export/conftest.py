"""The exam whose exports are tested, made once for a process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from export_files import write_exam
from searched_once import searched_once

__all__ = ["estimate", "exam", "searched_once"]


@pytest.fixture(scope="session")
def exam(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of maps and estimates, see `write_exam`."""
    folder = tmp_path_factory.mktemp("exam")
    write_exam(folder)
    return folder


@pytest.fixture(scope="session")
def estimate(exam: Path) -> dict[str, Any]:
    """The estimate of ``map.nc``."""
    document: dict[str, Any] = json.loads((exam / "map.json").read_text(encoding="utf-8"))
    assert document["max_size_mm"] is not None, document["reason"]
    return document
