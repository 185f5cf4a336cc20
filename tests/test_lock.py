"""The lock of what the program says tells a changed number, word or file from the last digits of a sum."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from lock import Job, compare, do, keep, main, make, plain

import tactile_bayes as tb

DEMO = Path(tb.__file__).parent / "demo"
SAID = "largest size  14.25 mm\nframes used   687 of 700\n"
VALUES = np.array([[1.0, np.nan], [0.0, 14.25]])
PAGE = """```toml scene.toml
[[lump]]
diameter_mm = 15.0
```
```sh
tactile-bayes --version
tactile-bayes simulate scene.toml -o scan.mcap
```
```python
print("seen")
```
"""


def two(folder: Path, *, said: str = SAID, values: np.ndarray = VALUES) -> tuple[Path, Path]:
    """The same outputs twice; the second with what is given."""
    for name, text, array in (("old", SAID, VALUES), ("new", said, values)):
        keep(folder / name / "job" / "printed", text, {"mean": array})
    return folder / "old", folder / "new"


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"said": SAID.replace("14.25", "14.250000000001")},
        {"values": VALUES + 1e-13},
        {"values": VALUES * (1 + 1e-12)},
    ],
)
def test_the_last_digits_are_no_difference(given, tmp_path):
    assert list(compare(*two(tmp_path, **given))) == []


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"said": SAID.replace("14.25", "14.25001425")}, "+ largest size  14.25001425 mm"),
        ({"said": SAID.replace("14.25", "14.250")[:-1] + " \n"}, "+ frames used   687 of 700 "),
        ({"said": SAID.replace("687", "688")}, "+ frames used   688 of 700"),
        ({"said": SAID.replace("size", "width")}, "+ largest width  14.25 mm"),
        ({"said": SAID + "more\n"}, "+more"),
        ({"values": VALUES * (1 + 1e-6)}, "mean: 2 of 4 differ: 1.0 was, 1.000001 is"),
        ({"values": np.nan_to_num(VALUES)}, "mean: 1 of 4 differ: nan was, 0.0 is"),
        ({"values": VALUES[:1]}, "mean: float64 (2, 2) was, float64 (1, 2) is"),
    ],
)
def test_a_change_is_reported_where_it_is(given, told, tmp_path):
    assert told in [line.partition(": ")[2] for line in compare(*two(tmp_path, **given))]


def test_a_file_that_is_missing_is_told_and_the_exit_code_says_so(tmp_path, monkeypatch, capsys):
    old, new = two(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lock.py", "compare", str(old), str(new)])
    assert main() == 0
    (new / "job" / "printed.npz").unlink()
    assert main() == 1
    assert "job/printed.npz: only in" in capsys.readouterr().out


def test_times_places_and_hashes_are_taken_out(tmp_path):
    first, second = "0" * 63 + "a", "0" * 63 + "b"
    said = f"estimate: 1.348 s\nseed 1, 0.273 maps/s\nsize: 14.3 mm\n{tmp_path}/map.nc {first} {second} {first}"
    wanted = "estimate: <time>\nseed 1, <rate>\nsize: 14.3 mm\n<folder>/map.nc <digest 1> <digest 2> <digest 1>"
    assert plain(said, tmp_path) == wanted


def test_a_page_is_followed_and_written_down(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    for name in ("old", "new"):
        do(Job("page", (page,)), tmp_path / name, tmp_path / "demos")
    assert list(compare(tmp_path / "old", tmp_path / "new")) == []
    said = (tmp_path / "new" / "page" / "printed.txt").read_text()
    assert "tactile-bayes, version <version>" in said
    assert "[exit 3]" in said
    assert "diameter_mm" in said
    assert "seen" in said
    assert (tmp_path / "new" / "page" / "files" / "scene.toml.txt").exists()


@pytest.mark.long
def test_files_of_every_form_are_read(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"""```sh
tactile-bayes map {DEMO / "scan.mcap"} -o map.nc --figure map.png
tactile-bayes import {DEMO / "scan.mcap"} -o scan.mcap
tactile-bayes export map.nc --to nrrd -o map.nrrd
```
""")
    do(Job("page", (page,)), tmp_path / "old", tmp_path / "demos")
    files = tmp_path / "old" / "page" / "files"
    texts = {path.name: path.read_text() for path in files.glob("*.txt")}
    assert set(texts) == {"map.nc.txt", "map.png.txt", "scan.mcap.txt", "map.nrrd.txt"}
    assert not [name for name, text in texts.items() if text.startswith("not readable")]
    assert "/mean float64 ('y', 'x') (71, 95)" in texts["map.nc.txt"]
    with np.load(files / "map.nc.npz") as arrays:
        assert arrays["|mean"].shape == (71, 95)


@pytest.mark.slow
def test_the_program_says_the_same_twice(tmp_path, monkeypatch):
    for name in ("COLUMNS", "PYTHONUTF8", "OPENBLAS_NUM_THREADS", "MPLBACKEND"):
        monkeypatch.setenv(name, os.environ.get(name, ""))  # `make` sets them
    for name in ("old", "new"):
        make(tmp_path / name, tmp_path, ["scan-packaged", "exams", "demo", "faults", "help", "schemas"])
    assert list(compare(tmp_path / "old", tmp_path / "new")) == []
