"""Frames in texts: each layout, as a sample of our own after what its program writes, is the one scan."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engineers_arrays import pressures, short_scan, write_head
from in_process import run_here
from makers_exports import blocks, rows, tekscan

import tactile_bayes as tb
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.scans import Scan

SCAN = short_scan()
KPA = pressures(SCAN)
TIME = SCAN.frames.time_s
FLAT = KPA.reshape(len(KPA), -1)


def brought_in(path: Path, **stated: Any) -> Scan:
    return tb.scan(path, None, SCAN.poses, head=SCAN.head, **stated)


def same(found: Scan, *, atol: float = 1e-3) -> None:
    kpa = found.element_calibration.to_kpa(found.frames.counts)
    np.testing.assert_allclose(kpa, KPA, atol=atol)
    np.testing.assert_allclose(found.frames.time_s, TIME, atol=1e-4)


@cache
def timed(scale: float, separator: str = ",") -> list[str]:
    return [f"{scale * t:.4f}{separator}{row}" for t, row in zip(TIME, rows(FLAT, separator), strict=True)]


NAMES = ",".join(f"S{i}" for i in range(416))
NUMBERED = [f"{i},{row}" for i, row in enumerate(timed(1))]
SUMMED = [f"{row},{i}" for i, row in enumerate(timed(1))]
NAMED_ROWS = [f'"{row}'.replace(",", '" ', 1).replace(",", " ") for row in NUMBERED]
PLAIN = [f"{t:.3f},{row}" for t, row in zip(TIME, rows(FLAT, digits=3), strict=True)]
UTF_8, MARKED, UTF_16 = "utf-8", "utf-8-sig", "utf-16"
PREAMBLE = ["Pressure mat 7", "Units: kPa", "Operator, code 12", ""]
ONE_ROW_A_FRAME: dict[str, tuple[Sequence[str], str, dict[str, Any]]] = {
    "bare": (rows(FLAT), UTF_8, {"rate_hz": 200.0}),
    "time before": (timed(1), UTF_8, {}),
    "blanks": (timed(1, " "), UTF_8, {}),
    "aligned": (["  " + row.replace(" ", "   ") for row in timed(1, " ")], UTF_8, {}),
    "header": (["time," + NAMES, *timed(1)], UTF_8, {}),
    "ms by header": (["Time (ms)," + NAMES, *timed(1000)], MARKED, {}),
    "ms stated": (["t," + NAMES, *timed(1000)], UTF_8, {"time_unit": "ms"}),
    "semicolons": ([row.replace(",", ";").replace(".", ",") for row in ["time_s," + NAMES, *timed(1)]], MARKED, {}),
    "tabs": ([row.replace(".", ",") for row in timed(1, "\t")], UTF_16, {}),
    "commas after": ([row + "," for row in timed(1)], UTF_8, {}),
    "counter": (NUMBERED, UTF_8, {}),
    "named counter": (["frame,time_s," + NAMES, *NUMBERED], UTF_8, {}),
    "pandas": (["," + ",".join(map(str, range(417))), *NUMBERED], UTF_8, {}),
    "sums after": (["time," + NAMES + ",Total Force (N)", *SUMMED], UTF_8, {}),
    "skipped": (SUMMED, UTF_8, {"skip_columns": 1}),
    "preamble": ([*PREAMBLE, "time," + NAMES, *timed(1)], UTF_8, {"unit": None}),
    "blank lines": ([*timed(1)[:20], "", *timed(1)[20:]], UTF_8, {}),
    "lists of Python": (["[" + row + "]" for row in timed(1)], UTF_8, {}),
    "rows named by R": (
        ['"time" "V1"', *(f'"{row}'.replace(",", '" ', 1).replace(",", " ") for row in NUMBERED)],
        UTF_8,
        {},
    ),
    "taxels in rows": (rows(FLAT.T), UTF_8, {"rate_hz": 200.0}),
    "rows without a break": (rows(KPA.reshape(-1, 26)), UTF_8, {"rate_hz": 200.0}),
    "quoted": (['"' + row.replace(",", '","').replace(".", ",") + '"' for row in timed(1)], UTF_8, {}),
    "minus signs": ([row.replace(",0.0000", ",\u22120.0000", 1) for row in timed(1)], UTF_8, {}),
    "thousands before": (['Mat,"1,024"', *timed(1)], UTF_8, {}),
    "three decimals": ([row.replace(",", ";").replace(".", ",") for row in PLAIN], UTF_8, {"decimal": "comma"}),
    "clock": ([f"10:00:{t:06.3f},{row}" for t, row in zip(TIME, rows(FLAT), strict=True)], UTF_8, {}),
}


@pytest.mark.parametrize("name", ONE_ROW_A_FRAME)
def test_a_table_of_one_row_per_frame_is_read(tmp_path: Path, name: str) -> None:
    lines, encoding, stated = ONE_ROW_A_FRAME[name]
    path = tmp_path / "frames.csv"
    path.write_bytes("\r\n".join([*lines, ""]).encode(encoding))
    if name == "clock":
        stated = {"pose_offset_s": 36000.0}
    found = brought_in(path, **{"unit": "kPa", **stated})
    if name == "clock":
        np.testing.assert_allclose(found.frames.time_s - 36000, TIME, atol=1e-3)
        return
    same(found)
    how = "416 rows of 60 numbers: rows are read as taxels" if name == "taxels in rows" else "read as"
    assert how in found.session["imported_as"]


def test_blocks_between_blank_lines(tmp_path: Path) -> None:
    (tmp_path / "exam.asc").write_text("\n".join(blocks(KPA, "")))
    found = brought_in(tmp_path / "exam.asc", rate_hz=200.0, unit="kPa")
    same(found, atol=2e-3)
    assert "60 frames, each a block of 16 rows" in found.session["imported_as"]


def test_frames_and_poses_in_one_table(tmp_path: Path) -> None:
    """A log with a row a frame: time, a word, the pose of that moment, and the readings."""
    pose = SCAN.poses.position_mm[0], SCAN.poses.quaternion_wxyz[0]
    told = ",".join(f"{one:.6f}" for one in np.concatenate(pose))
    lines = [f"{row.partition(',')[0]},OK,{told},{row.partition(',')[2]}" for row in timed(1)]
    lines[7] = lines[7].replace("OK", "Missing")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["epoch_s,status,x,y,z,qw,qx,qy,qz," + NAMES, *lines]))
    found = tb.scan(path, None, path, head=SCAN.head, unit="kPa")
    same(found)
    assert len(found.poses) == len(found.frames) - 1
    np.testing.assert_allclose(found.poses.position_mm[0], pose[0], atol=1e-5)


def test_raw_counts_in_a_text_take_a_calibration(tmp_path: Path) -> None:
    (tmp_path / "raw.asf").write_text(tekscan(SCAN.frames.counts, "RAW"))
    found = brought_in(tmp_path / "raw.asf", calibration=SCAN)
    np.testing.assert_array_equal(found.frames.counts, SCAN.frames.counts)
    assert found.element_calibration.saturation_count == SCAN.element_calibration.saturation_count


def changed(line: int, text: str) -> str:
    lines = timed(1)
    return "\n".join([*lines[:line], text, *lines[line + 1 :]])


ROW = timed(1)[30]
CELL = ROW.split(",")[7]
FAULTS: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "cut row": (changed(30, ROW.rpartition(",")[0]), {}, "line 31 holds 416 numbers, the others 417"),
    "word": (changed(30, ROW.replace(CELL, "x12", 1)), {}, "line 31 holds 'x12'"),
    "no value": (
        changed(30, ROW.replace(CELL, "", 1)),
        {},
        "frames holds 1 values that are not fin.*leave such frames",
    ),
    "cut frame": ("\n".join(tekscan(KPA, "KPA").splitlines()[:-6]), {}, "has frames of 16 rows and, at line .* one of"),
    "beside": (tekscan(KPA, "KPA").replace("\n0.0000,", "\nB,"), {}, "has 10 cells 'B' from line 31 on, which Tekscan"),
    "no number": ("hello\nworld\n", {}, "holds no table of numbers"),
    "empty": ("", {}, "holds no table of numbers"),
    "bytes": (b"\x00\x01\x02" * 99, {}, "is not text|holds no table"),
    "latin": ("Größe\n".encode("latin-1"), {}, "line 1: byte 0xf6 is not UTF-8 text"),
    "thousands": ("1,234\t2,345\t3,456\n" * 9, {}, r"'1,234', which is 1234 or 1\.234"),
    "no rate": ("\n".join(rows(FLAT)), {}, r"lacks frame_time_s \(n\).*rate_hz"),
    "taxels": (
        "\n".join(rows(FLAT[:, :100])),
        {"rate_hz": 200.0},
        "100 columns, and the head 416 taxels",
    ),
    "time falls": ("\n".join([*timed(1)[30:], *timed(1)[:30]]), {}, "frame_time_s runs backwards at index 30"),
    "time stands": ("\n".join(f"1.5,{row}" for row in rows(FLAT)), {}, "frame_time_s is 1.5 throughout"),
    "another clock": (
        "\n".join(["time," + NAMES, *(f"27.11.2026 10:15,{row}" for row in rows(FLAT))]),
        {},
        "its column of times holds '27.11.2026 10:15', which is no time that is known.*rate_hz",
    ),
    "only counted": ("\n".join(f"{i},{row}" for i, row in enumerate(rows(FLAT))), {}, "lacks frame_time_s .*rate_hz"),
    "epoch in ms": ("\n".join(f"{1.7e12 + 5 * i},{row}" for i, row in enumerate(rows(FLAT))), {}, 'time_unit="ms"'),
    "poses": ("t,x,y,z,qw,qx,qy,qz\n" + "0.1,1,2,3,1,0,0,0\n" * 9, {}, "is a table of poses by line 1; .*poses"),
    "NaN alone": ("nan,nan,nan\n" * 5, {}, "holds no number other than NaN or infinity; give the array's readings"),
    "a list": ("frame,row,col,kPa\n" + "0,1,2,3.5\n" * 99, {}, "names 4 columns .*give one row a frame"),
    "other columns": ("\n".join(["time," + NAMES + ",S416", *SUMMED]), {}, "418 columns .* 417 of which.*skip_columns"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_no_table_of_frames_is_one_line(tmp_path: Path, fault: str) -> None:
    text, stated, words = FAULTS[fault]
    path = tmp_path / "frames.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(BadDataError, match=words) as caught:
        brought_in(path, unit="kPa", **stated)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_the_command_says_what_it_guessed_and_takes_it_stated(tmp_path: Path) -> None:
    write_head(SCAN, tmp_path / "head.json")
    (tmp_path / "exam.csv").write_text("\n".join(timed(1)))
    poses = np.column_stack([SCAN.poses.time_s, SCAN.poses.position_mm, SCAN.poses.quaternion_wxyz])
    np.savetxt(tmp_path / "poses.txt", poses)
    words = ("import", "exam.csv", "--poses", "poses.txt", "--pose-layout", "wxyz", "--head-geometry", "head.json")
    done = run_here(*words, "--unit", "kPa", "-o", "exam.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for told in (
        "frames: fields between commas",
        "416 of 417 columns are readings, from column 2 on",
        "times in column 1",
        "poses: fields between blanks",
        "poses as wxyz from column 2 on, times in column 1",
        "each 416 numbers read as 16 x 26, along the array's rows",
    ):
        assert told in done.stdout
    same(read_scan(tmp_path / "exam.mcap"))
    (tmp_path / "turned.csv").write_text("\n".join(rows(KPA.swapaxes(1, 2).reshape(len(KPA), -1))))
    more = ("--frame-order", "columns", "--frame-shape", "16", "26", "--rate-hz", "200", "--unit", "kPa", "--force")
    done = run_here("import", "turned.csv", *words[2:], *more, "-o", "exam.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    same(read_scan(tmp_path / "exam.mcap"))


def test_what_is_stated_stands_above_what_the_file_says(tmp_path: Path) -> None:
    text = tekscan(KPA, "PSI").replace("SATURATION_PRESSURE 4000.0", "SATURATION_PRESSURE 2.0")
    (tmp_path / "exam.asf").write_text(text)
    found = brought_in(tmp_path / "exam.asf", unit="kPa", rate_hz=200.0)
    same(found)
    assert "unit kPa as stated, where the file says psi" in found.session["imported_as"]
