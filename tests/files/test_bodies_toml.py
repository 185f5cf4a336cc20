"""Ranges of bodies and exams from a file: what is given is used, what is not known or not possible is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import read_toml_record
from tactile_bayes.studies.population import BodiesFile, BodyPrior, Population


def written(folder: Path, text: str) -> Path:
    path = folder / "bodies.toml"
    path.write_text(text)
    return path


def test_stated_ranges_replace_the_defaults(tmp_path: Path) -> None:
    text = "[bodies]\nd_mm = [8, 9]\nseat = [0, 0]\n[exams]\nlines = [3, 3]\n"
    found = read_toml_record(written(tmp_path, text), BodiesFile, way_out="see the schema")
    bodies, exams = found.bodies, found.exams
    assert bodies.d_mm == (8, 9)
    assert bodies.fat_kpa == BodyPrior().fat_kpa
    for i in range(20):
        (scene,) = Population(scans=1, seed=3, bodies=bodies, exams=exams).scenes(i)
        assert 8 <= scene.solid_lumps[0].d_mm <= 9
        assert scene.solid_lumps[0].seat == 0
        assert scene.strokes.lines == 3
    assert read_toml_record(written(tmp_path, ""), BodiesFile, way_out="see the schema") == BodiesFile()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[bodies]\nd_mm = [30, 5]\n", "bodies.d_mm runs backwards, from 30 to 5; give the lower end first"),
        ("[bodies]\nd_cm = [1, 2]\n", "bodies.d_cm is not known"),
        ("[body]\nd_mm = [1, 2]\n", "body is not known; did you mean bodies"),
        ("d_mm = [1, 2]\n", "d_mm is not known"),
        ("[bodies]\nd_mm = [0, 5]\n", "d_mm"),
        ("[bodies]\nd_mm = 5\n", "d_mm"),
        ("[bodies]\nd_mm = [5]\n", "d_mm"),
        ("[bodies]\nseat = ['a', 'b']\n", "seat"),
        ("[bodies]\ndepth_ratio = [0.2, 1]\n", "depth_ratio"),
        ("bodies = 3\n", "bodies"),
        ("[exams]\nlines = [4.5, 5]\n", "lines"),
        ("[exams]\ndrift_kpa = [1, 8]\n", "keep the drift below the mean pressure"),
    ],
)
def test_an_impossible_range_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(BadDataError) as caught:
        read_toml_record(path, BodiesFile, way_out="see the schema")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
