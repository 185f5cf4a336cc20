"""The map command, as a person runs it."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

import mapping_scans as scans
import numpy as np
import pytest
from in_process import run_here

from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import read_map, read_map_and_header
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import write_scan
from tactile_bayes.findings import finding
from tactile_bayes.mapping.build import build_map
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.map import map_summary
from tactile_bayes.scans import Landmarks, Scan


def small_scan(*, level_kpa: float = 8.0) -> Scan:
    levels = level_kpa + np.sin(np.arange(120))
    levels[:5] = 2.0
    marks = Landmarks(np.array([60.0, 200.0, -40.0]), np.array([60.0, 20.0, -35.0]))
    return scans.make_scan(scans.strokes(), field=scans.gaussian(), levels_kpa=levels, landmarks=marks)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two scans of one examination and one pressed too lightly."""
    for name, scan in {
        "one.mcap": scans.part(small_scan(), slice(70)),
        "two.mcap": scans.part(small_scan(), slice(70, None)),
        "light.mcap": small_scan(level_kpa=2.0),
    }.items():
        write_scan(tmp_path / name, scan, provenance=Provenance("test", {}))
    return tmp_path


def test_scans_become_the_map_the_function_builds(folder, run_cli):
    done = run_cli("map", "one.mcap", "two.mcap", "-o", "map.nc", "--figure", "map.png", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    written, built = read_map(folder / "map.nc"), build_map(small_scan())
    assert np.array_equal(written.mean, built.mean, equal_nan=True)
    assert np.array_equal(written.count, built.count)
    _, header = read_map_and_header(folder / "map.nc")
    assert header.provenance["settings"] == {
        "cell_mm": 1.0,
        "pressure_window_kpa": [5.0, 14.0],
        "normalise": "gain",
        "latency_ms": 0.0,
        "plane_radius_mm": "all",
        "flat_field": False,
        "register_strokes": False,
        "as_stated": False,
        "every": 1,
    }
    assert [one["role"] for one in header.provenance["inputs"]] == ["scan_1", "scan_2"]
    for name in ("map.nc", "map.png"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600


def test_the_table_says_what_was_used_and_what_was_left_out(folder, run_cli):
    lines = run_cli("map", "one.mcap", "two.mcap", "-o", "map.nc", "-v", cwd=folder).stdout.splitlines()
    table = {line[:15].strip(): line[15:].strip() for line in lines if line}
    assert table["frames used"] == "115 of 120, 2 scans"
    assert table["left out"] == "5 pressed below 5 kPa"
    assert re.fullmatch(r"rms 0\.0 mm, 0\.0 deg from the head's face", table["plane"])
    assert table["resolves"] == "lumps of map width sigma 1.3 mm or more"
    assert table["patient axes"] == "from the landmarks, repeats within 0.0 mm"
    assert lines[-1] == RESEARCH_USE


def test_a_verdict_leads_and_laboratory_figures_are_for_v(folder, run_cli):
    done = run_cli("map", "one.mcap", "two.mcap", "-o", "map.nc", cwd=folder)
    lines = [line for line in done.stdout.splitlines() if not line.startswith("To check: ")]
    written = read_map(folder / "map.nc")
    assert re.fullmatch(r"sound: 115 of 120 frames, 2 scans, \d+ % covered.*", lines[0]), lines[0]
    assert f"{100 * written.quality['coverage']:.0f} % covered" in lines[0]
    assert lines[1] == "left out: 5 pressed below 5 kPa"
    assert lines[2].startswith("written: map.nc, ")
    assert (len(lines), lines[-1]) == (5, RESEARCH_USE)


def test_a_caution_makes_the_verdict_doubtful():
    sound = build_map(small_scan())
    late = replace(sound, findings=(*sound.findings, finding("late_poses", "poses came late")))
    assert [map_summary(one, written="a.nc").split(":")[0] for one in (sound, late)] == ["sound", "CAUTION"]
    assert "\ndoubtful: 115 of 120" in map_summary(late, written="a.nc")


def test_a_map_without_a_name_is_beside_its_scan_and_named(folder, run_cli):
    (folder / "exams").mkdir()
    (folder / "one.mcap").rename(folder / "exams" / "one.mcap")
    (folder / "two.mcap").rename(folder / "exams" / "scan.mcap")
    for scan, name in (("one", "one"), ("scan", "map")):
        done = run_cli("map", f"exams/{scan}.mcap", cwd=folder)
        assert done.returncode == 0, done.stderr
        assert f"written: exams/{name}.nc," in done.stdout
        read_map(folder / "exams" / f"{name}.nc")
    done = run_cli("map", "exams/one.mcap", cwd=folder)
    assert (done.returncode, done.stderr) == (2, "error: exams/one.nc exists; name another with -o, or give --force\n")
    assert run_cli("map", "exams/one.mcap", "--force", cwd=folder).returncode == 0


def test_a_map_without_a_name_never_replaces_its_scan(folder, run_cli):
    scan = (folder / "one.mcap").read_bytes()
    (folder / "exam.nc").write_bytes(scan)
    (folder / "one.nc").symlink_to("one.mcap")
    for name, output in (("exam.nc", "exam.nc"), ("one.mcap", "one.nc")):
        done = run_cli("map", name, "--force", cwd=folder)
        said = f"error: {output} is an input of this command; choose another name for the output\n"
        assert (done.returncode, done.stderr) == (2, said)
        assert (folder / name).read_bytes() == scan
    assert run_cli("map", "two.mcap", cwd=folder).returncode == 0
    done = run_cli("map", "two.nc", cwd=folder)
    assert done.returncode == 3
    assert "two.nc: is a map or posterior (netCDF), not a scan" in done.stderr


@pytest.mark.parametrize("words", [".", "..", "/", "folder", "none.mcap"])
def test_what_is_no_scan_has_no_map_beside_it(words, tmp_path):
    (tmp_path / "folder").mkdir()
    done = run_here("map", words, cwd=tmp_path)
    assert done.returncode in (2, 3)
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_equal_inputs_give_equal_bytes_and_no_names(folder, run_cli):
    (folder / "Jane_Doe.mcap").write_bytes((folder / "one.mcap").read_bytes())
    for scan, out in (("one.mcap", "a.nc"), ("Jane_Doe.mcap", "b.nc")):
        assert run_cli("map", scan, "-o", out, cwd=folder).returncode == 0
    assert (folder / "a.nc").read_bytes() == (folder / "b.nc").read_bytes()
    assert b"Jane" not in (folder / "b.nc").read_bytes()


def test_options_reach_the_map(folder, run_cli):
    options = ["--cell-mm", 2, "--pressure-window-kpa", 6, 12, "--normalise", "none", "--latency-ms", 4.5, "-v"]
    done = run_cli("map", "one.mcap", "-o", "map.nc", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    recipe = read_map(folder / "map.nc").recipe
    assert (recipe.cell_mm, recipe.pressure_window_kpa, recipe.normalise, recipe.latency_ms) == (
        2,
        (6, 12),
        "none",
        4.5,
    )
    assert "kPa (normalise none)" in done.stdout


def test_gain_says_how_it_settled(folder, run_cli):
    done = run_cli("map", "two.mcap", "-o", "map.nc", "--normalise", "gain", "-v", cwd=folder)
    assert re.search(r"gain solve +\d+ passes, last change \d\.\de-\d+", done.stdout)


def test_timings_go_to_stderr_when_asked_for(folder, run_cli):
    done = run_cli("map", "one.mcap", "-o", "map.nc", "-v", cwd=folder)
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == ["read", "map", "write"]


REFUSED = {
    "pressed too lightly": (["light.mcap"], 3, "would keep nine in ten"),
    "no such scan": (["none.mcap"], 3, "none.mcap: cannot be read"),
    "no scan": ([], 2, "Missing argument"),
    "a scan twice": (["one.mcap", "one.mcap"], 2, "given twice"),
    "an unknown way": (["one.mcap", "--normalise", "median"], 2, "'mean', 'gain', 'none'"),
    "no window": (["one.mcap", "--pressure-window-kpa", "9", "3"], 2, "two rising pressures"),
    "no cell": (["one.mcap", "--cell-mm", "0"], 2, "'--cell-mm': '0' is not a number from 0.01 to 50"),
    "figure over the map": (["one.mcap", "--figure", "map.nc"], 2, "written as one of .png, .pdf, .svg"),
    "no directory": (["one.mcap", "--figure", "nowhere/map.png"], 2, "nowhere is not a directory"),
}


@pytest.mark.parametrize(("words", "code", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_mapped_ends_in_one_line_and_no_file(folder, run_cli, words, code, message):
    before = sorted(path.name for path in folder.iterdir())
    done = run_cli("map", *words, "-o", "map.nc", cwd=folder)
    assert done.returncode == code
    assert message in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.parametrize("kind", ["symbolic link", "hard link", "copy"])
def test_a_recording_counts_once_under_any_name(kind, folder):
    """Its frames counted twice, and the map's errors came out too small."""
    again = folder / "again.mcap"
    if kind == "symbolic link":
        again.symlink_to("one.mcap")
    elif kind == "hard link":
        again.hardlink_to(folder / "one.mcap")
    else:
        again.write_bytes((folder / "one.mcap").read_bytes())
    done = run_here("map", "one.mcap", "two.mcap", "again.mcap", "-o", "map.nc", cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    said = "holds the recording of one.mcap; give each" if kind == "copy" else "is given twice; its frames would count"
    assert f"again.mcap {said}" in done.stderr
    assert not (folder / "map.nc").exists()


def test_outputs_and_inputs_are_not_overwritten(folder, run_cli):
    (folder / "map.nc").write_text("mine")
    assert run_cli("map", "one.mcap", "-o", "map.nc", cwd=folder).returncode == 2
    assert (folder / "map.nc").read_text() == "mine"
    assert run_cli("map", "one.mcap", "-o", "map.nc", "--force", cwd=folder).returncode == 0
    os.link(folder / "one.mcap", folder / "alias.nc")
    before = (folder / "one.mcap").read_bytes()
    done = run_cli("map", "one.mcap", "-o", "alias.nc", "--force", cwd=folder)
    assert (done.returncode, (folder / "one.mcap").read_bytes()) == (2, before)
    assert "is an input of this command" in done.stderr


def test_an_unfinished_recording_is_mapped_and_its_loss_told(folder, run_cli):
    (folder / "cut.mcap").write_bytes((folder / "one.mcap").read_bytes()[:-200])
    done = run_cli("map", "cut.mcap", "-o", "map.nc", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "To check: the end of the file is missing" in done.stdout
