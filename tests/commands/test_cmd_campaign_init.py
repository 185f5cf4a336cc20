"""`campaign init` on folders as sites have them, and `--add` to a table that somebody worked on."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_files import arrays_of, rows_of, thinned, write
from in_process import run_here


def init(folder: Path, *more: object) -> subprocess.CompletedProcess[str]:
    return run_here("campaign", "init", "Studie 1", "-o", "exams.csv", *more, cwd=folder)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of two readers in folders of their own, and what lies about beside them."""
    folder = tmp_path_factory.mktemp("site")
    one, two = (folder / "Studie 1" / name for name in ("Köhler, M.", "B"))
    one.mkdir(parents=True)
    two.mkdir()
    write(one / "P01 links – 1.mcap", thinned(0, 20, subject="P01", side="left", examiner="A"))
    write(two / "p1_li.mcap", thinned(1, 20, subject="p01", side="left", examiner="B"))
    write(two / "p2.mcap", thinned(2, 20, subject="P02", side="right", examiner="B"))
    shutil.copy(one / "P01 links – 1.mcap", one / "P01 links – 1 - Kopie.mcap")
    for name in ("._P01 links – 1.mcap", ".DS_Store", "~$liste.xlsx"):
        (one / name).write_bytes(b"\0\5\26\7")
    (two / "leer.npz").touch()
    (two / "liste.xlsx").write_bytes(b"PK\3\4")
    (folder / "Studie 1" / "README.txt").write_text("notes")
    made = run_here("map", "P01 links – 1.mcap", "-o", "P01 links – 1.nc", cwd=one)
    assert made.returncode == 0, made.stderr
    return folder


@pytest.fixture
def site(prepared: Path, tmp_path: Path) -> Path:
    return shutil.copytree(prepared, tmp_path / "site")


def test_copies_maps_of_listed_scans_and_files_of_systems_give_no_exam(site: Path) -> None:
    done = init(site)
    assert done.returncode == 0, done.stderr
    assert [row["file"] for row in rows_of(site / "exams.csv")] == [
        "Studie 1/B/p1_li.mcap",
        "Studie 1/Köhler, M./P01 links – 1.mcap",
        "Studie 1/B/p2.mcap",
    ]
    assert done.stderr.splitlines() == [
        "left out: Studie 1/B/leer.npz: is not an .npz, .npy, .mat or HDF5 file (it is empty)",
        "left out: Studie 1/Köhler, M./P01 links – 1 - Kopie.mcap: holds the same bytes as "
        "Studie 1/Köhler, M./P01 links – 1.mcap",
        "left out: Studie 1/Köhler, M./P01 links – 1.nc: was made from Studie 1/Köhler, M./P01 links – 1.mcap, "
        "which is an exam",
    ]
    assert "passed over: 2 other files (.txt, .xlsx)" in done.stdout


def test_a_map_of_a_scan_that_has_a_copy_is_of_the_one_that_is_listed(site: Path) -> None:
    """Whichever of the two names comes first in the folder."""
    one = site / "Studie 1" / "Köhler, M."
    (one / "P01 links – 1 - Kopie.mcap").rename(one / "Z Kopie von P01 links – 1.mcap")
    assert "P01 links – 1.nc: was made from Studie 1/Köhler, M./P01 links – 1.mcap, which" in init(site).stderr


def test_codes_that_differ_by_capitals_become_one_and_the_next_command_is_printed(site: Path) -> None:
    done = init(site)
    assert done.stdout.splitlines()[0] == "exams.csv: 3 exams of 2 patients"
    assert "P01 links – 1.mcap: its patient P01 is written p01, as in another row" in done.stdout
    assert "next: tactile-bayes campaign run exams.csv -o out --dry-run" in done.stdout
    assert [row["patient"] for row in rows_of(site / "exams.csv")] == ["p01", "p01", "P02"]
    planned = run_here("campaign", "run", "exams.csv", "-o", "out", "--dry-run", cwd=site)
    assert "map: 3 to do" in planned.stdout, planned.stderr


def test_a_folder_that_cannot_be_read_is_named(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The superuser may read any folder, so the system's refusal is played."""
    scandir = os.scandir

    def closed(path: str) -> Any:
        if str(path).endswith(shut):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", closed)
    shut = "B"
    inner = init(site)
    assert inner.returncode == 0, inner.stderr
    assert "left out: Studie 1/B: cannot be read (Permission denied)" in inner.stderr
    shut = "Studie 1"
    outer = init(site, "--force")
    assert (outer.returncode, outer.stderr.count("\n")) == (2, 1)
    assert "Studie 1 cannot be read (Permission denied); give a folder that can" in outer.stderr


def test_init_names_what_run_would_refuse(site: Path) -> None:
    write(site / "Studie 1" / "B" / "p2 re.mcap", thinned(3, 20, subject="P02", side="left", examiner="B"))
    done = init(site)
    assert "to correct before the run: exams.csv: line 5, column side: the side right differs from left" in done.stdout


def test_a_map_without_its_scan_is_an_exam_and_arrays_without_what_was_imported(site: Path) -> None:
    (site / "Studie 1" / "Köhler, M." / "P01 links – 1.mcap").unlink()
    (site / "Studie 1" / "Köhler, M." / "P01 links – 1 - Kopie.mcap").unlink()
    scan = thinned(4, 20)
    np.savez(site / "Studie 1" / "p3.npz", **arrays_of(scan))
    alone = init(site)
    assert "Studie 1/p3.npz" in (site / "exams.csv").read_text()
    assert run_here("import", "Studie 1/p3.npz", "-o", "Studie 1/p3.mcap", cwd=site).returncode == 0
    done = init(site, "--force")
    table = (site / "exams.csv").read_text()
    assert '"Studie 1/Köhler, M./P01 links – 1.nc",p01,1,1,2,left,A' in table
    assert "Studie 1/p3.mcap" in table
    assert "Studie 1/p3.npz" not in table
    assert "left out: Studie 1/p3.npz: was made into Studie 1/p3.mcap" in done.stderr, (alone.stderr, done.stderr)


def test_add_keeps_what_somebody_typed_and_adds_new_files(site: Path) -> None:
    """Saved by a German spreadsheet meanwhile: semicolons, a byte order mark, a column more, rows of another order."""
    init(site)
    typed = (
        "file;patient;visit;mass;replicate;known_depth_mm;reader\r\n"
        "Studie 1/B/p2.mcap;P02;baseline;1;1;12,5;B\r\n"
        "Studie 1/B/p1_li.mcap;P01;1;1;7;;B\r\n"
        "Studie 1/B/away.mcap;P09;1;1;²;;B\r\n"
    )
    (site / "exams.csv").write_bytes(b"\xef\xbb\xbf" + typed.encode())
    write(site / "Studie 1" / "P02 spät.mcap", thinned(5, 20, subject="p02", side="right"))
    refused = init(site)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "exams.csv exists; --add keeps its rows and adds other files, --force writes it anew" in refused.stderr
    done = init(site, "--add")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "exams.csv: 5 exams of 3 patients (2 added, 3 kept)"
    assert "listed, and not there any more: Studie 1/B/away.mcap" in done.stdout
    written = (site / "exams.csv").read_bytes()
    assert written.startswith(b"\xef\xbb\xbf")
    assert written.decode("utf-8-sig").splitlines() == [
        "file;patient;visit;mass;replicate;known_depth_mm;reader;side",
        "Studie 1/B/p2.mcap;P02;baseline;1;1;12,5;B;",
        "Studie 1/B/p1_li.mcap;P01;1;1;7;;B;",
        "Studie 1/B/away.mcap;P09;1;1;²;;B;",
        "Studie 1/Köhler, M./P01 links – 1.mcap;P01;1;1;8;;A;left",
        "Studie 1/P02 spät.mcap;P02;1;1;1;;;right",
    ]
    again = init(site, "--add")
    assert "(0 added, 5 kept)" in again.stdout
    assert (site / "exams.csv").read_bytes() == written


def test_add_to_no_table_writes_it_and_add_with_force_is_refused(site: Path) -> None:
    assert "exams.csv: 3 exams of 2 patients" in init(site, "--add").stdout
    both = init(site, "--add", "--force")
    assert (both.returncode, both.stderr.count("\n")) == (2, 1)


def test_add_refuses_a_table_of_something_else(site: Path) -> None:
    (site / "exams.csv").write_text("patient,mass\nP1,1\n")
    done = init(site, "--add")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "exams.csv: line 1, column file: is missing; add it" in done.stderr
    assert (site / "exams.csv").read_text() == "patient,mass\nP1,1\n"


# --- Names by pattern.


def named(folder: Path, *names: str) -> None:
    """Arrays of scans that say nothing of whose they are."""
    for number, name in enumerate(names):
        path = folder / "Studie 1" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.savez(file, **arrays_of(thinned(number, 40)))


def told(folder: Path, *columns: str) -> list[tuple[str, ...]]:
    return [tuple(row.get(name, "") for name in columns) for row in rows_of(folder / "exams.csv")]


@pytest.mark.parametrize(
    ("pattern", "names", "expected"),
    [
        ("{patient}_{visit}_{exam}.npz", ("P01_2_02.npz", "P01_2_1.npz"), [("P01", "2", "2"), ("P01", "2", "1")]),
        ("{patient}_{visit}_{exam}", ("P-1_a_7.mat",), [("P-1", "a", "7")]),
        ("{patient}_{visit}_{exam}.*", ("P-1_a_7.mat", "P2_b_1.npz"), [("P-1", "a", "7"), ("P2", "b", "1")]),
        ("{patient}/visit{visit}-{exam}.npz", ("P01/visit2-1.npz", "P02/visit1-1.npz"),
         [("P01", "2", "1"), ("P02", "1", "1")]),
        ("scan*_{patient}_{visit}", ("scan 17 neu_P01_3.npz",), [("P01", "3", "1")]),
        ("{patient}.{visit}", ("P1.2.npz",), [("P1", "2", "1")]),
    ],
)  # fmt: skip
def test_files_are_told_by_their_names(
    pattern: str, names: tuple[str, ...], expected: list[tuple[str, str, str]], tmp_path: Path
) -> None:
    named(tmp_path, *names)
    done = init(tmp_path, "--names", pattern)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert told(tmp_path, "patient", "visit", "replicate") == expected


def test_side_date_and_reader_are_told_too_and_exams_without_a_number_are_counted(tmp_path: Path) -> None:
    named(
        tmp_path,
        "P01 L 2026-03-01 Mo.npz",
        "P01 L 2026-03-02 Jo.npz",
        "P02 rechts 2026-03-01 Mo.npz",
        "P03 R 2026-02-30 Jo.npz",
    )
    done = init(tmp_path, "--names", "{patient} {side} {date} {reader}")
    columns = ("patient", "side", "date", "reader", "replicate")
    assert told(tmp_path, *columns) == [
        ("P01", "left", "2026-03-01", "Mo", "1"),
        ("P01", "left", "2026-03-02", "Jo", "2"),
    ]
    assert "has 'rechts' for the side; name it left, right, L or R" in done.stderr
    assert "has '2026-02-30' for the date; name it 2026-03-01" in done.stderr


def test_a_name_that_does_not_follow_the_pattern_or_contradicts_its_file_is_left_out(tmp_path: Path) -> None:
    named(tmp_path, "P01_1_1.npz", "P01_x_1_1.npz", "P01_2_links.npz")
    scans = tmp_path / "Studie 1"
    write(scans / "P01_3_1.mcap", thinned(5, 20, subject="P02", side="left"))
    write(scans / "p03_1_1.mcap", thinned(6, 20, subject="P03", side="left"))
    done = init(tmp_path, "--names", "{patient}_{visit}_{exam}")
    assert told(tmp_path, "patient", "visit", "side") == [("P01", "1", ""), ("P03", "1", "left")]
    assert done.stderr.splitlines() == [
        "left out: Studie 1/P01_2_links.npz: its name has 'links' for the exam; name it with a number from 1",
        "left out: Studie 1/P01_3_1.mcap: its name says patient P01, the file says P02",
        "left out: Studie 1/P01_x_1_1.npz: its name does not follow {patient}_{visit}_{exam}",
    ]


@pytest.mark.parametrize(
    "pattern",
    ["", "x", "{pat}_{visit}", "{patient}{visit}", "{patient}_{patient}", "{patient", "*{patient}", "{}_{visit}"],
)
def test_a_pattern_that_cannot_be_read_is_refused(pattern: str, tmp_path: Path) -> None:
    named(tmp_path, "P01_1_1.npz")
    done = init(tmp_path, "--names", pattern)
    assert done.returncode == 2
    assert repr(pattern) in done.stderr
    assert not (tmp_path / "exams.csv").exists()


def test_a_folder_that_is_none_or_not_below_the_table_and_names_that_tables_do_not_take_are_refused(
    tmp_path: Path,
) -> None:
    named(tmp_path, "P01_1.npz", " P01_2.npz")
    scan = "Studie 1/P01_1.npz"
    for folder, table, words in (
        (scan, "exams.csv", f"{scan} is not a directory; give the folder of the scans"),
        (".", "Studie 1/exams.csv", "is not inside Studie 1, the table's folder; write the table beside the scans"),
    ):
        done = run_here("campaign", "init", folder, "-o", table, cwd=tmp_path)
        assert done.returncode == 2
        assert words in done.stderr
    inside = run_here("campaign", "init", ".", "-o", "exams.csv", cwd=tmp_path / "Studie 1")
    assert "left out:  P01_2.npz: the table takes no such file name: rename it" in inside.stderr


def test_a_folder_where_no_name_follows_the_pattern_gives_no_table(tmp_path: Path) -> None:
    named(tmp_path, "P01-1.npz")
    done = init(tmp_path, "--names", "{patient}_{visit}")
    assert done.returncode == 3
    assert "holds no file that can be an exam; see why each was left out" in done.stderr
    assert not (tmp_path / "exams.csv").exists()
