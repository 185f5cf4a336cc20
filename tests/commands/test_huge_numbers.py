"""Numbers without measure: each is one line before any work, in bounded memory and time."""

from __future__ import annotations

import codecs
from pathlib import Path

import pytest
from in_process import run_here

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.documents import load_toml

HUGE = "1000000000"
CASES = {
    "masses": (("population", "--masses", HUGE, "-o", "out.csv"), 2, "--masses"),
    "centred": (("population", "--centred", HUGE, "-o", "out.csv"), 2, "--centred"),
    "exams": (("population", "--scans", HUGE, "-o", "out.csv"), 2, "--scans"),
    "trials": (("plan", "--trials", HUGE), 2, "--trials"),
    "maps": (("sbc", "--maps", HUGE), 2, "--maps"),
    "runs": (("tradeoff", "forward", "--runs", HUGE), 2, "--runs"),
    "an endless recording": (("record", "--head", "x", "--duration", "inf", "-o", "o.mcap"), 2, "--duration"),
    "a recording of no length": (("record", "--head", "x", "--duration", "nan", "-o", "o.mcap"), 2, "--duration"),
    "an age": (("record", "--head", "x", "--calibration-days", "nan", "-o", "o.mcap"), 2, "--calibration-days"),
    "a distance": (("campaign", "run", "exams.csv", "-o", "out", "--match-mm", "nan"), 2, "--match-mm"),
    "a stall": (("emulate", "head", "scan.mcap", "--stall", "nan", "1"), 2, "--stall"),
    "a speed": (("replay", "scan.mcap", "--speed", "nan"), 2, "--speed"),
    "a search": (("devices", "--duration", "nan"), 2, "--duration"),
    "a chest wall": (("study", "--thickness-mm", "1e12"), 3, "thickness_mm is 1e+12; it must be below 10000"),
    "a head": (("study", "--head-radius-mm", "1e300"), 2, "--head-radius-mm"),
    "a tiny lump": (("study", "--grid", "tiny.csv"), 3, "d_mm is 1e-300; it must be at least 0.1 and below 10000"),
    "a huge lump": (("study", "--grid", "huge.csv"), 3, "d_mm is 1e+300; it must be at least 0.1 and below 10000"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_number_without_measure_is_refused_before_any_work(case: str, tmp_path: Path) -> None:
    """A thousand million masses filled the memory with their names; a mesh of a lump of 1e-300 mm had no end."""
    words, code, named = CASES[case]
    for name, d in (("tiny", "1e-300"), ("huge", "1e300")):
        (tmp_path / f"{name}.csv").write_text(f"d_mm,depth_ratio,stiffness_ratio\n{d},1,10\n")
    done = run_here(*words, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert named in done.stderr.splitlines()[-1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["huge.csv", "tiny.csv"]


def test_the_mark_that_windows_editors_begin_a_file_with_is_no_fault_of_toml(tmp_path: Path) -> None:
    """It was: not TOML (Invalid statement (at line 1, column 1))."""
    (tmp_path / "a.toml").write_bytes(codecs.BOM_UTF8 + b"a = 1\r\n")
    assert load_toml(tmp_path / "a.toml", way_out="") == {"a": 1}


def test_a_file_in_another_encoding_says_how_to_save_it(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("a = 1", encoding="utf-16")
    with pytest.raises(BadDataError, match="is UTF-16 text; save it as UTF-8"):
        load_toml(tmp_path / "a.toml", way_out="")
