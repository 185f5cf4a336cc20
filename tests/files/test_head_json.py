"""Heads from files: both descriptions give the same head, and what is no head is one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.instrument import read_head_geometry, read_landmarks, read_simulated_head
from tactile_bayes.forward.scene import FLAT_MM, Head

ARC = {"schema": "tactile-bayes/head/1", "pitch_mm": 1.5, "rows": 10, "columns": 12, "radius_mm": 20.0}
LEVER = np.eye(4).tolist()


def written(folder: Path, document: dict[str, Any]) -> Path:
    path = folder / "head.json"
    path.write_text(json.dumps(document))
    return path


def of_surface(radius_mm: float | None, *, rows: int = 10, columns: int = 12) -> dict[str, Any]:
    """Centres written out as the guide does it, with the origin at the apex."""
    x, y = ((np.arange(n) - (n - 1) / 2) * 1.5 for n in (rows, columns))
    z = np.zeros(rows) if radius_mm is None else np.sqrt(radius_mm**2 - x**2) - radius_mm
    surface = [[[xi, yi, zi] for yi in y] for xi, zi in zip(x, z, strict=True)]
    return {"schema": "tactile-bayes/head/1", "pitch_mm": 1.5, "surface_mm": surface}


def test_both_descriptions_give_the_same_head(tmp_path: Path) -> None:
    wanted = Head(10, 12, 1.5, 20.0)
    assert read_simulated_head(written(tmp_path, ARC)) == wanted
    blank = {"rows": None, "columns": None, "radius_mm": None}
    for surface in (of_surface(20.0), {**of_surface(20.0), **blank}):
        assert read_simulated_head(written(tmp_path, surface)) == wanted


@pytest.mark.parametrize("document", [{**ARC, "radius_mm": None}, of_surface(None)])
def test_a_flat_head_is_flat(tmp_path: Path, document: dict[str, Any]) -> None:
    head = read_simulated_head(written(tmp_path, document))
    assert head.radius_mm == FLAT_MM
    assert float(np.ptp(head.surface_mm()[..., 2])) < 1e-3


def test_the_edge_is_the_default_rim_unless_it_is_given(tmp_path: Path) -> None:
    assert read_simulated_head(written(tmp_path, ARC)).rim_mm == Head().rim_mm
    assert read_simulated_head(written(tmp_path, {**ARC, "rim_mm": 1})).rim_mm == 1
    found = read_simulated_head(written(tmp_path, {**ARC, "shoulder_mm": 2}))
    assert (found.shoulder_mm, found.rim_mm) == (2, 0)


def test_record_reads_the_same_file(tmp_path: Path) -> None:
    found = read_head_geometry(written(tmp_path, {**ARC, "scanhead_from_tracker": LEVER}))
    np.testing.assert_allclose(found.surface_mm, np.array(of_surface(20.0)["surface_mm"]), atol=1e-12)
    with pytest.raises(BadDataError, match="lacks scanhead_from_tracker"):
        read_head_geometry(written(tmp_path, ARC))
    contradicts = {**of_surface(20.0), "pitch_mm": 1.95, "scanhead_from_tracker": LEVER}
    with pytest.raises(BadDataError, match=r"lie 1.5\d* mm apart across the head, pitch_mm is 1.95"):
        read_head_geometry(written(tmp_path, contradicts))
    metres = [[*row[:3], row[3] or 0.055] for row in np.eye(4).tolist()]
    with pytest.raises(BadDataError, match=r"puts the tracker's sensor 0\.\d+ mm from the head; looks like metres"):
        read_head_geometry(written(tmp_path, {**ARC, "scanhead_from_tracker": metres}))
    marks = {"schema": "tactile-bayes/landmarks/1", "sternal_notch_mm": [0.0, 0.19, 0.0], "xiphoid_mm": [0.0, 0.0, 0.0]}
    with pytest.raises(BadDataError, match=r"are 0\.19 mm apart; looks like metres"):
        read_landmarks(written(tmp_path, marks))


def sphere() -> dict[str, Any]:
    document = of_surface(None)
    for row in document["surface_mm"]:
        for taxel in row:
            taxel[2] = float(np.sqrt(20.0**2 - taxel[0] ** 2 - taxel[1] ** 2) - 20.0)
    return document


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({**ARC, "raduis_mm": 20}, "raduis_mm is not known; did you mean radius_mm"),
        ({**ARC, "radius_mm": 7.0}, "it must exceed the half width of 7.5 mm"),
        ({**ARC, "radius_mm": -20}, "radius_mm"),
        ({**ARC, "rows": 0}, "rows"),
        ({**ARC, "pitch_mm": "1.5"}, "pitch_mm"),
        ({**ARC, "rim_mm": 30}, "rim_mm is 30"),
        ({**ARC, "shoulder_mm": 2, "rim_mm": 3}, "shoulder_mm is 2 and rim_mm 3"),
        ({name: ARC[name] for name in ARC if name != "columns"}, "lacks columns"),
        ({**ARC, "rows": None}, "lacks rows"),
        ({**ARC, "pitch_mm": 0.0015, "radius_mm": 0.02}, "pitch_mm is 0.0015"),
        ({**of_surface(20.0), "rows": 10}, "gives both surface_mm and rows"),
        (sphere(), "from a regular grid of 1.5 mm on an arc"),
        ({**of_surface(20.0), "pitch_mm": 2.0}, "from a regular grid of 2 mm"),
        ({**of_surface(20.0), "surface_mm": [[[0, 0, 0], [0, 1, 0]], [[1, 0, 0]]]}, "rows of different lengths"),
        (
            {**ARC, "schema": "tactile-bayes/landmarks/1"},
            "is a landmarks (JSON), not a head (JSON)",
        ),
    ],
)
def test_an_impossible_head_is_one_line(tmp_path: Path, document: dict[str, Any], words: str) -> None:
    path = written(tmp_path, document)
    with pytest.raises(BadDataError) as caught:
        read_simulated_head(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
