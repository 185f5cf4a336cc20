"""`import` as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from in_process import run_here

import tactile_bayes
import tactile_bayes as tb
from tactile_bayes.commands.exam import import_command as command
from tactile_bayes.declarations import replace
from tactile_bayes.errors import UsageError
from tactile_bayes.files.arrays_layout import LAYOUT, in_words
from tactile_bayes.files.map_nc import read_map
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report

Run = Callable[..., "CompletedProcess[str]"]
DEMO = Path(tactile_bayes.__file__).parent / "demo" / "scan.mcap"


def test_arrays_become_a_scan(run_cli: Run, shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "scans" / "s01_sphere15_hd1_clean.npz"
    done = run_cli("import", source, "-o", "a.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in ("1400 frames of 16 x 26 taxels in 6.995 s, 200.0 Hz", "840 poses, 120.0 Hz", "landmarks: sternal"):
        assert words in done.stdout
    assert "Research use only" in done.stdout
    np.testing.assert_array_equal(read_scan(tmp_path / "a.mcap").frames.counts, np.load(source)["counts"])


def test_landmarks_of_a_scan_are_corrected(run_cli: Run, tmp_path: Path) -> None:
    """The caution on a lump on the other side of the body names this way, and the option was refused."""
    marks = {"sternal_notch_mm": [0, 150, 0], "xiphoid_mm": [0, -50, 0]}
    (tmp_path / "marks.json").write_text(json.dumps({"schema": "tactile-bayes/landmarks/1", **marks}))
    done = run_cli("import", DEMO, "--landmarks", "marks.json", "-o", "new.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    landmarks = read_scan(tmp_path / "new.mcap").landmarks
    assert landmarks is not None
    assert [landmarks.sternal_notch_mm.tolist(), landmarks.xiphoid_mm.tolist()] == list(marks.values())
    for subject in ("P1", "P2"):
        (tmp_path / "s.toml").write_text(f'subject = "{subject}"\n')
        words = ("-o", f"{subject}.mcap", "--session", "s.toml", "--landmarks", "P1.mcap" if subject == "P2" else DEMO)
        done = run_cli("import", DEMO, *words, cwd=tmp_path)
    assert "the landmarks of P1.mcap are of subject P1, this is P2" in done.stderr
    assert not (tmp_path / "P2.mcap").exists()


def test_python_takes_landmarks_of_the_same_patient_and_frame_only(tmp_path: Path) -> None:
    demo = tb.demo_scan()
    arrays = {"head": demo, "calibration": demo, "poses": demo.poses}
    (tmp_path / "s.toml").write_text('subject = "P2"\n')
    for fact, words in (("subject", "are of subject P1, this is P2"), ("reference", "relative to the tool 'P1'")):
        given = replace(demo, session={fact: "P1"})
        with pytest.raises(UsageError, match=f"the landmarks .*{words}"):
            tb.scan(demo.frames.counts, demo.frames.time_s, landmarks=given, session=tmp_path / "s.toml", **arrays)


def test_a_grid_becomes_a_map(run_cli: Run, tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("1,1.1,1\n1,1.3,\n")
    done = run_cli("import", "g.csv", "-o", "g.nc", "--spacing-mm", 1.5, "--normalise", "mean", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 x 3 cells of 1.5 mm, 5 with data" in done.stdout
    assert "background level 1 (normalise mean)" in done.stdout
    grid = read_map(tmp_path / "g.nc")
    np.testing.assert_array_equal(grid.mean, [[1, 1.1, 1], [1, 1.3, np.nan]])
    assert grid.recipe.source == "grid"
    assert grid.background == 1.0


def test_the_unit_of_a_grid_is_unknown_unless_told(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_text("20,22,20\n21,30,20\n")
    words = ("import", "g.csv", "--spacing-mm", 1)
    done = run_here(*words, "-o", "g.nc", cwd=tmp_path)
    assert "values 20 to 30 (unit unknown: give --units), background level unknown" in done.stdout
    told = run_here(*words, "-o", "h.nc", "--units", "camera counts", cwd=tmp_path)
    assert "values 20 to 30 camera counts, background" in told.stdout
    for name, unit in (("g.nc", "unknown"), ("h.nc", "camera counts")):
        shown = run_here("show", name, "--json", cwd=tmp_path)
        assert json.loads(shown.stdout)["units"]["mean"] == unit
    assert read_map(tmp_path / "h.nc").recipe.units == "camera counts"
    assert not read_map(tmp_path / "g.nc").few.any()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--units", "kPa", "--normalise", "mean"), "--units is for values that were not divided"),
        (("--units", "\x1b[2J"), "is not a unit"),
        (("--units", ""), "is not a unit"),
        (("--units", "kPa", "--as", "scan"), "for maps only"),
    ],
)
def test_a_unit_that_is_none_is_a_usage_error(tmp_path: Path, more: tuple[str, ...], words: str) -> None:
    (tmp_path / "g.csv").write_text("1,1\n1,1\n")
    done = run_here("import", "g.csv", "-o", "g", "--spacing-mm", 1, *more, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / "g").exists()


def test_an_unfinished_scan_is_mended_and_the_loss_told(run_cli: Run, tmp_path: Path) -> None:
    data = DEMO.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    done = run_cli("import", "cut.mcap", "-o", "mended.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "To check: cut off at byte" in done.stdout
    assert done.stdout.count("cut off at byte") == 1
    file = read_scan_report(tmp_path / "mended.mcap")
    assert file.complete
    assert "cut off" in file.provenance["settings"]["lost"][0]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["x.npz", "-o", "a.mcap", "--spacing-mm", "1"], 2, "for maps only"),
        (["g.csv", "-o", "g.nc"], 2, "--spacing-mm"),
        (["g.csv", "-o", "g.csv", "--spacing-mm", "1"], 2, "is an input"),
        (["g.csv", "-o", "no/g.nc", "--spacing-mm", "1"], 2, "not a directory"),
        (["none.npz", "-o", "a.mcap"], 3, "cannot be read"),
        (["g.csv", "-o", "a.mcap", "--as", "scan"], 3, "frames of 2 numbers"),
        (["g.npz", "-o", "a.mcap"], 3, "give --as map"),
        (["g.npz", "-o", "a.mcap"], 3, "position_mm (m, 3), quaternion_wxyz (m, 4)"),
        (["x.mat", "-o", "a.nc"], 3, "cannot be read"),
        (["g.csv", "-o", "a.nc", "--spacing-mm", "1", "--array", "P"], 2, "--array is for files of arrays"),
        (["x.xlsx", "-o", "a.nc"], 3, "save the grid as .csv"),
    ],
)
def test_mistakes_end_in_one_line_and_their_code(
    run_cli: Run, tmp_path: Path, arguments: list[str], code: int, words: str
) -> None:
    (tmp_path / "g.csv").write_text("1,2\n")
    np.savez(tmp_path / "g.npz", mean=np.ones((2, 2)))
    before = sorted(tmp_path.iterdir())
    done = run_cli("import", *arguments, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_a_grid_in_npz_becomes_a_map_where_the_output_says_so(run_cli: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "g.npz", mean=np.ones((2, 3)), spacing_mm=1.0)
    done = run_cli("import", "g.npz", "-o", "g.nc", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "g.nc: map" in done.stdout


def test_the_help_has_the_layout_that_the_reader_checks() -> None:
    said = command.help or ""
    for name, layout in LAYOUT.items():
        assert f"- {name} ({in_words(layout.shape)}" in said
    for line in ("- head_surface_mm (rows, columns, 3): ", "- pitch_mm (one number): ", "- frame_time_s (n): "):
        assert line in said


@pytest.mark.parametrize("name", ["import", "simulate"])
def test_help_imports_nothing_heavy(name: str) -> None:
    heavy = ["numpy", "mcap", "google.protobuf", "PIL", "netCDF4", "fastjsonschema"]
    code = (
        "import sys\nfrom tactile_bayes.cli import cli\n"
        f"cli.main([{name!r}, '--help'], standalone_mode=False)\n"
        f"loaded = [m for m in {heavy!r} if m in sys.modules]\nassert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=DEMO.parents[2])
