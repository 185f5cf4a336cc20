"""`campaign`: from a folder of exams to the trial's report; faults stay with their exam, and runs go on."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from campaign_files import (
    FAST,
    JOURNAL,
    ROWS,
    arrays_of,
    contents,
    rows_of,
    steps,
    thinned,
    write,
    write_study,
    write_table,
)
from in_process import run_here
from plain_reports import estimate_report, pooled_report
from scipy.io import savemat

import tactile_bayes as tb
from tactile_bayes.campaigns.exams import masses_with_visits
from tactile_bayes.campaigns.inputs import open_campaign
from tactile_bayes.campaigns.report import ExamRow, done_line, grown_line, growth_rows, index_html, trial_lines
from tactile_bayes.campaigns.run import Fault
from tactile_bayes.campaigns.steps import Task, make_map, run_step
from tactile_bayes.errors import UsageError
from tactile_bayes.files.documents import load_schema
from tactile_bayes.files.manifest_csv import Exam as Listed
from tactile_bayes.files.manifest_csv import columns_of
from tactile_bayes.files.tables import read_table
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.pages import Growth

Run = Callable[..., "subprocess.CompletedProcess[str]"]
SIZED = ("07.v1.m1.r1", "07.v1.m1.r2", "09.v1.m1.r1")
STEPS_OF_ALL = 4 + 4 + 4 + 3
"""Maps and estimates of the exams that are sound, and masses."""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    write_study(folder)
    write_table(folder / "exams.csv")
    return folder


@pytest.fixture(scope="module")
def undisturbed(study: Path) -> Path:
    """The output of one run that nothing interrupted."""
    done = campaign(study)
    assert done.returncode == 0, done.stderr
    return study / "out"


@pytest.fixture
def own(study: Path, tmp_path: Path) -> Path:
    """A copy of the study's inputs, to be changed."""
    shutil.copytree(study / "scans", tmp_path / "scans")
    for name in ("exams.csv", "excision.csv"):
        shutil.copy(study / name, tmp_path)
    return tmp_path


@pytest.fixture
def finished(own: Path, undisturbed: Path) -> Path:
    """A copy of the study with the output of the undisturbed run."""
    shutil.copytree(undisturbed, own / "out")
    return own


def campaign(folder: Path, *more: object) -> subprocess.CompletedProcess[str]:
    return run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, *more, cwd=folder)


# --- the table


@pytest.mark.long
def test_init_writes_what_the_scans_carry_and_names_what_it_leaves_out(study: Path, tmp_path: Path) -> None:
    shutil.copytree(study / "scans", tmp_path / "scans")
    (tmp_path / "scans" / "cut.mcap").write_bytes(b"\x89MCAP0\r\n and no more")
    write(tmp_path / "scans" / "later.mcap", thinned(1, 4, subject="07", side="left", visit="2", mass="b"))
    done = run_here("campaign", "init", "scans", "-o", "exams.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "exams.csv: 7 exams of 4 patients"
    assert "left out: scans/cut.mcap: is cut off in its header" in done.stderr
    rows = {row["file"]: row for row in rows_of(tmp_path / "exams.csv")}
    assert rows["scans/07-b.mcap"] == {
        "file": "scans/07-b.mcap",
        "patient": "07",
        "visit": "1",
        "mass": "1",
        "replicate": "2",
        "side": "left",
        "reader": "R2",
    }
    assert [rows["scans/later.mcap"][name] for name in ("visit", "mass", "replicate")] == ["2", "b", "1"]
    assert rows["scans/swapped.mcap"]["patient"] == "09"


def test_init_leaves_blank_what_no_scan_says_and_run_asks_for_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", thinned(0, 3))
    done = run_here("campaign", "init", ".", "-o", "exams.csv", cwd=tmp_path)
    assert "1 exam without a patient: fill in the column patient, or take it from the files' names" in done.stdout
    assert (tmp_path / "exams.csv").read_text().splitlines()[0] == "file,patient,visit,mass,replicate,side"
    refused = run_here("campaign", "run", "exams.csv", "-o", "out", cwd=tmp_path)
    assert (refused.returncode, refused.stderr.count("\n")) == (3, 1)
    assert not (tmp_path / "out").exists()


def test_a_folder_or_a_scan_instead_of_the_table_is_told_how_to_make_one(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", thinned(0, 3))
    for name, kind in ((".", "a folder"), ("a.mcap", "a scan")):
        done = run_here("campaign", "run", name, "-o", "out", cwd=tmp_path)
        assert (done.returncode, done.stderr.count("\n")) == (3, 1)
        assert f"{name}: is {kind}, not a table; give the table of exams: `tactile-bayes campaign init" in done.stderr


FAULTS = {
    "a path that leaves": ("../x.mcap,1,1,1,1", "'../x.mcap' leaves the table's folder"),
    "a path that leaves inside": ("scans/../../x.mcap,1,1,1,1", "leaves the table's folder"),
    "an absolute path": ("/etc/passwd,1,1,1,1", "'/etc/passwd' leaves the table's folder"),
    "a link that leaves": ("link.mcap,1,1,1,1", "'link.mcap' leaves the table's folder"),
    "backslashes": (
        "scans\\x.mcap,1,1,1,1",
        "'scans\\x.mcap' has backslashes, and no file is called so; write the path",
    ),
    "a drive": ("C:\\data\\x.mcap,1,1,1,1", "write the path from the table's folder with / between folders"),
    "a patient in capitals": ("a.mcap,p1,1,1,1\nb.mcap,P1,1,1,1", "'P1' differs from 'p1' on line 2 by capitals alone"),
    "zeros lost": ("a.mcap,007,1,1,1\nb.mcap,7,1,1,1", "'7' differs from '007' on line 2 by leading zeros alone"),
    "a mass in capitals": ("a.mcap,1,1,a,1\nb.mcap,1,1,A,2", "column mass: 'A' differs from 'a' on line 2"),
    "semicolons and quotes": ('"a.mcap";1;1;1;0', "'0' is not at least 1"),
    "a formula": ("=cmd.mcap,1,1,1,1", "it may not begin with = + @ or -"),
    "a path for a patient": ("a.mcap,../p,1,1,1", "up to 32 letters from A to Z, digits, _ and -"),
    "no replicate": ("a.mcap,1,1,1,0", "'0' is not at least 1"),
    "an escape": ('"a\x1b[2J.mcap",1,1,1,1', "unprintable"),
    "a cell too many": ("a.mcap,1,1,1,1,left,7", "cells under"),
    "the same exam twice": ("a.mcap,1,1,1,1\nb.mcap,1,1,1,1", "stands on line 2 already"),
    "two sides of one mass": (
        "a.mcap,1,1,1,1,left\nb.mcap,1,2,1,1,right",
        "the side right differs from left on line 2",
    ),
    "an endless cell": ("a.mcap,1,1,1,1," + "x" * 200_000, "not CSV"),
    "an open quote": ('"a.mcap,1,1,1,1', "not CSV"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_of_the_table_is_one_line_and_no_work(case: str, tmp_path: Path) -> None:
    body, fault = FAULTS[case]
    (tmp_path / "link.mcap").symlink_to(tmp_path.parent / "elsewhere.mcap")
    sides = body.count(",") > 4 * (body.count("\n") + 1)
    head = f"file,patient,visit,mass,replicate{',side' if sides else ''}"
    (tmp_path / "exams.csv").write_text(f"{head.replace(',', ';') if ';' in body else head}\n{body}\n")
    done = run_here("campaign", "run", "exams.csv", "-o", "out", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert fault in done.stderr
    assert len(done.stderr) < 1000
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_file_whose_name_has_a_backslash_is_an_exam(own: Path) -> None:
    (own / "scans" / "07-a.mcap").rename(own / "scans" / "07\\a.mcap")
    write_table(own / "exams.csv", [("scans/07\\a.mcap", "07", 1, "left")])
    assert "1 exam: 1 sized" in campaign(own).stdout


@pytest.mark.long
def test_capitals_do_not_make_a_scan_another_patients(own: Path) -> None:
    write(own / "scans" / "07-a.mcap", thinned(0, 2, subject="p07", side="left"))
    write_table(own / "exams.csv", [("scans/07-a.mcap", "P07", 1, "left")])
    assert "1 exam: 1 sized" in campaign(own).stdout


@pytest.mark.long
@pytest.mark.parametrize(("listed", "excised"), [("P09", "p09"), ("009", "9")])
def test_an_excision_table_that_writes_a_code_another_way_is_refused_before_any_work(
    listed: str, excised: str, own: Path
) -> None:
    write_table(own / "exams.csv", [("scans/09-a.mcap", listed, 1, "right")])
    (own / "excision.csv").write_text(f"patient,mass,ex_vivo_mm\nP10,1,12\n{excised},1,14\n")
    done = campaign(own, "--excision", "excision.csv")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    told = f"line 3, column patient: '{excised}' is '{listed}' in the table of exams (line 2); write it one way"
    assert told in done.stderr
    assert not (own / "out").exists()


@pytest.mark.long
def test_a_table_from_windows_is_read(finished: Path) -> None:
    before = contents(finished / "out")
    table = finished / "exams.csv"
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes().replace(b"\n", b"\r\n") + b",,,,,\r\n\r\n")
    assert f"2 steps run, {STEPS_OF_ALL} kept" in campaign(finished).stdout
    assert contents(finished / "out") == before


@pytest.mark.long
def test_an_excision_sheet_of_a_german_spreadsheet_is_read_by_its_mapping(finished: Path) -> None:
    """Semicolons, decimal commas, cm, other names and columns: the report is that of the tidy table in mm."""
    tidy = campaign(finished, "--excision", "excision.csv").stdout
    rows = ("Pat.-Nr.;Alter;größter Durchmesser (cm, Patho)", "07;54;1,5", "09;61;1,4", "11;70;0,9", "12;48;1")
    sheet = "".join(f"{row};;\r\n" for row in rows)
    (finished / "patho.csv").write_bytes(b"\xef\xbb\xbf" + sheet.encode())
    mapping = 'patient = "Pat.-Nr."\n[excision]\nsize = "größter Durchmesser (cm, Patho)"\nunit = "cm"\n'
    (finished / "patho.toml").write_text(mapping, encoding="utf-8")
    done = campaign(finished, "--excision", "patho.csv", "--columns", "patho.toml")
    assert done.returncode == 0, done.stderr
    assert "Sizes against excision: 4 masses of 4 patients" in done.stdout
    assert done.stdout == tidy
    by_hand = run_here("validate", "out/trial.csv", "--excision", "patho.csv", "--columns", "patho.toml", cwd=finished)
    assert by_hand.stdout in done.stdout, by_hand.stderr


@pytest.mark.long
def test_an_excision_sheet_with_two_rows_of_one_mass_is_refused(finished: Path) -> None:
    (finished / "patho.csv").write_text("id;cm\n07;1,5\n09;1,4\n07;2,4\n")
    (finished / "patho.toml").write_text('patient = "id"\n[excision]\nsize = "cm"\nunit = "cm"\n')
    done = campaign(finished, "--excision", "patho.csv", "--columns", "patho.toml")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "line 4, column id: '07' + '1' stands on line 2 already; remove one row, or name the column" in done.stderr


@pytest.mark.long
def test_a_mapping_needs_its_excision_table(finished: Path) -> None:
    (finished / "patho.toml").write_text('patient = "id"\n[excision]\nsize = "cm"\nunit = "cm"\n')
    alone = campaign(finished, "--columns", "patho.toml")
    assert (alone.returncode, alone.stderr.count("\n")) == (2, 1)
    assert "--columns is the layout of the excision table; give --excision too" in alone.stderr
    missing = campaign(finished, "--excision", "excision.csv", "--columns", "patho.toml")
    assert "line 1, column id: is missing; correct the mapping; the table has 'patient', 'mass'" in missing.stderr


@pytest.mark.long
def test_a_step_that_ends_after_its_command_was_killed_changes_nothing_that_is_read(finished: Path) -> None:
    """On a cluster a worker goes on; here its step is run after the folder's last run, with another normalisation."""
    out, exam = finished / "out", "07.v1.m1.r1"
    before, done = contents(out), steps(out)
    source = finished / "scans" / "07-a.mcap"
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    make = partial(make_map, source, source_sha256=digest, expected={}, normalise="mean")
    late = run_step(Task("map", exam, out / "exams" / exam, "late", make))
    assert set(late["files"]) == {"map.nc"}
    now = contents(out)
    assert {name: now[name] for name in before} == before
    assert campaign(finished).returncode == 0
    assert contents(out) == before
    assert steps(out) == done


@pytest.mark.long
def test_python_runs_what_the_command_runs(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command has nothing left to do."""
    monkeypatch.chdir(own)
    write_table(own / "exams.csv", [ROWS[3], ROWS[5]])
    words = ("campaign", "run", "exams.csv", "-o", "out", "--method", "laplace")
    planned = tb.campaign("exams.csv", "out", method="laplace", dry_run=True)
    assert planned.text == run_here(*words, "--dry-run", cwd=own).stdout
    assert repr(planned) == "<CampaignResult of 2 exams: nothing was run>"
    tb.campaign("exams.csv", "out", method="laplace")
    done = run_here(*words, "--excision", "excision.csv", cwd=own)
    found = tb.campaign("exams.csv", Path("out"), excision="excision.csv", method="laplace")
    assert "1 step run, 3 kept" in found.text
    assert found.text == done.stdout
    assert [f"failed: {line}" for line in found.failed] == done.stderr.splitlines()
    assert repr(found) == "<CampaignResult of 2 exams: 1 sized, 0 without a size, 1 failed>"
    with pytest.raises(UsageError, match="protocol is for the trial's report; give excision too"):
        tb.campaign("exams.csv", "out", protocol="p.toml")
    with pytest.raises(UsageError, match="normalise is 'twice'; give one of"):
        tb.campaign("exams.csv", "out", normalise="twice")


@pytest.mark.long
def test_an_output_that_is_an_input_is_refused(finished: Path) -> None:
    shutil.copy(finished / "excision.csv", finished / "out" / "trial.csv")
    done = campaign(finished, "--excision", "out/trial.csv")
    assert "out/trial.csv is an input of this command; choose another name for the output" in done.stderr


@pytest.mark.parametrize(
    ("campaign_fault", "own_fault", "reason"),
    [
        ("", None, "exams of fewer than two visits came through"),
        ("", Fault("compare", "the masses lie 30 mm apart"), "the masses lie 30 mm apart"),
        ("no dates", Fault("compare", "the masses lie 30 mm apart"), "no dates"),
    ],
)
def test_a_mass_that_was_not_compared_has_the_reason_in_its_row(
    campaign_fault: str, own_fault: Any, reason: str
) -> None:
    exams = [Listed("a.mcap", Path("a.mcap"), "01", visit, "m1", 1) for visit in ("v1", "v2", "v3")]
    (name,) = masses_with_visits(exams, {})
    faults = {} if own_fault is None else {name: own_fault}
    made: Any = SimpleNamespace(exams=exams, days={}, keys={"compare": {}}, faults=faults, not_compared=campaign_fault)
    (row,) = growth_rows(made)
    assert (row.patient, row.mass, row.earlier, row.later) == ("01", "m1", "v1", "v3")
    assert (row.status, row.reason) == ("failed", reason)


def test_a_table_has_a_column_for_each_value_of_its_rows() -> None:
    exam = Listed("a.mcap", Path("a.mcap"), "01", "v1", "m1", 1)
    size = Quantity(median=2, mean=2, sd=1, low=1, high=3, probability=0.95, kind="eti")
    grown = Growth("01", "m1", "v1", "v2", "compared", sizes_mm=(size, size), percent=size)
    assert list(done_line(ExamRow(exam, "detected", size=size))) == columns_of("exams_done")
    assert list(grown_line(grown)) == columns_of("growth")


@pytest.mark.long
@pytest.mark.parametrize("name", ["exams_done", "failures"])
def test_tables_have_every_column_of_their_schema_in_its_order(undisturbed: Path, name: str) -> None:
    """Also those that no exam fills: a script must not break on a trial without cautions."""
    table = read_table(undisturbed / f"{name}.csv", f"{name}.table.json")
    assert len(table) == {"exams_done": 4, "failures": 2}[name]
    header = (undisturbed / f"{name}.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header == ",".join(one["name"] for one in load_schema(f"{name}.table.json")["fields"])


@pytest.mark.long
def test_the_trial_table_has_its_columns_where_no_exam_has_a_size(own: Path) -> None:
    write_table(own / "exams.csv", [("scans/11-a.mcap", "11", 1, "left")])
    done = campaign(own, "--excision", "excision.csv")
    assert done.returncode == 0, done.stderr
    table = read_table(own / "out" / "trial.csv", "trial.table.json")
    assert (table.columns["size_mm"], table.columns["status"]) == ([None], ["not_detected"])
    assert "Sizes against excision" in done.stdout


@pytest.mark.long
def test_a_pooled_size_is_synthetic_also_where_the_last_exam_failed(undisturbed: Path) -> None:
    rows = [row for row in rows_of(undisturbed / "trial.csv") if row["modality"] == "tactile-pooled"]
    assert {row["patient"]: row["synthetic"] for row in rows} == {"07": "true", "09": "true", "11": "true", "12": ""}


@pytest.mark.long
def test_a_plan_and_a_run_name_the_few_exams_they_do_again(finished: Path) -> None:
    write(finished / "scans" / "09-a.mcap", thinned(1, 5, subject="09", side="right"))
    planned = campaign(finished, "--dry-run").stdout.splitlines()
    assert "map: 3 to do (07.v1.m1.r3, 09.v1.m1.r1, 12.v1.m1.r1), 3 done" in planned
    done = campaign(finished).stdout.splitlines()
    assert "map run: 07.v1.m1.r3, 09.v1.m1.r1, 12.v1.m1.r1" in done
    assert "estimate run: 09.v1.m1.r1" in done
    assert "pool run: 09.v1.m1" in done


def test_workers_that_do_not_see_the_commands_folder_end_the_run_with_the_question(tmp_path: Path) -> None:
    """As on a cluster whose machines have an output folder each: the worker wrote, and nothing is here."""
    staged = {"folder": str(tmp_path / "exams" / "P1.v1.m1.r1" / ".new-map-0"), "without": []}
    result = {"files": {"map.nc": "0"}, "staged": staged, "seconds": 1.0, "cpu_seconds": 1.0}
    with open_campaign(tmp_path / "out") as store:
        assert store is not None
        with pytest.raises(UsageError, match="do all machines see this folder"):
            store.add("map P1.v1.m1.r1 0", result)


def test_one_coordinate_of_a_place_alone_is_refused(tmp_path: Path) -> None:
    (tmp_path / "exams.csv").write_text("file,patient,visit,mass,replicate,centre_x_mm\na.mcap,1,1,1,1,4\n")
    done = run_here("campaign", "run", "exams.csv", "-o", "out", cwd=tmp_path)
    assert done.returncode == 3
    assert "column centre_y_mm: is blank while the other coordinate is not" in done.stderr


# --- one run


@pytest.mark.parametrize(("code", "status"), [("cannot_show", "not_done"), ("undetected", "not_detected")])
def test_an_exam_that_cannot_show_a_lump_was_not_done(code: str, status: str) -> None:
    """Not held against the modality; the control is a map that could have shown a lump."""
    row = ExamRow.of(Listed("a.nc", Path("a.nc"), "P", "1", "1", 1), estimate_report(reason_code=code))
    assert row.status == status
    by_another_exam = date(2026, 1, 10)
    run: Any = SimpleNamespace(faults={}, days={row.exam.of_mass: by_another_exam})
    together = {row.exam.of_mass: pooled_report(reason="no size", maps=())}
    readings = trial_lines(run, [row], together, None)
    assert [(one["status"], one["date"]) for one in readings] == [(status, None), (status, by_another_exam)]


def test_the_index_gives_the_reason_of_a_visits_one_exam_not_a_count_of_maps() -> None:
    exam = Listed("a.nc", Path("a.nc"), "P", "1", "1", 1)
    row = ExamRow.of(exam, estimate_report(reason="no lump found within 20 mm of the place", reason_code="undetected"))
    pooled = {exam.of_mass: pooled_report(reason="a lump was found on 0 of 1 maps", maps=())}
    run: Any = SimpleNamespace(exams=[exam], files=lambda *_: {}, repeatability=None, folder=Path("out"), days={})
    page = index_html(run, [row], pooled, (), counts="0 sized", links={})
    assert "no lump found within 20 mm" in page
    assert "0 of 1 maps" not in page
    run.exams *= 2  # of several exams it gives both
    page = index_html(run, [row], pooled, (), counts="0 sized", links={})
    assert "0 of 1 maps; no lump found within 20 mm" in page


@pytest.mark.long
def test_every_exam_has_its_row_and_its_status(undisturbed: Path) -> None:
    trial = {(row["patient"], row["modality"], row["replicate"]): row for row in rows_of(undisturbed / "trial.csv")}
    status = {key: row["status"] for key, row in trial.items() if key[1] == "tactile"}
    assert status == {
        ("07", "tactile", "1"): "detected",
        ("07", "tactile", "2"): "detected",
        ("07", "tactile", "3"): "not_done",
        ("09", "tactile", "1"): "detected",
        ("11", "tactile", "1"): "not_detected",
        ("12", "tactile", "1"): "not_done",
    }
    assert trial["11", "tactile", "1"]["reason"].startswith("no lump found")
    assert trial["12", "tactile-pooled", "1"]["reason"] == "every exam failed"
    pooled = json.loads((undisturbed / "masses" / "07.v1.m1" / "pooled.json").read_text())
    assert float(trial["07", "tactile-pooled", "1"]["size_mm"]) == pooled["max_size_mm"]["median"]
    assert [row["patient"] for row in rows_of(undisturbed / "exams_done.csv")] == ["07", "07", "09", "11"]


@pytest.mark.long
def test_a_swapped_and_a_damaged_file_are_failures_that_say_why(undisturbed: Path) -> None:
    failures = {row["file"]: row for row in rows_of(undisturbed / "failures.csv")}
    assert set(failures) == {"scans/swapped.mcap", "scans/12-a.mcap"}
    told = failures["scans/swapped.mcap"]["reason"]
    assert told.startswith("the table says patient 07, side left; the file says patient 09, side right;")
    assert failures["scans/12-a.mcap"]["reason"].startswith("is damaged (")
    for name in ("07.v1.m1.r3", "12.v1.m1.r1"):
        assert not (undisturbed / "exams" / name).exists()


@pytest.mark.long
def test_an_exam_has_what_the_single_commands_give(undisturbed: Path, study: Path, tmp_path: Path) -> None:
    for name, scan in (("07.v1.m1.r1", "07-a"), ("07.v1.m1.r2", "07-b")):
        made = undisturbed / "exams" / name
        run_here("map", study / "scans" / f"{scan}.mcap", "-o", f"{scan}.nc", cwd=tmp_path)
        told = run_here("estimate", f"{scan}.nc", *FAST, "--json", "-o", f"{scan}-post.nc", cwd=tmp_path)
        assert (made / "map.nc").read_bytes() == (tmp_path / f"{scan}.nc").read_bytes()
        assert (made / "posterior.nc").read_bytes() == (tmp_path / f"{scan}-post.nc").read_bytes()
        assert (made / "estimate.json").read_text() == told.stdout
    told = run_here("estimate", "07-a.nc", "07-b.nc", "--pool", *FAST, "--json", cwd=tmp_path)
    wanted = told.stdout.replace("07-a.nc", "07.v1.m1.r1").replace("07-b.nc", "07.v1.m1.r2")
    assert (undisturbed / "masses" / "07.v1.m1" / "pooled.json").read_text() == wanted


@pytest.mark.long
def test_an_estimate_names_the_scan_it_comes_from(undisturbed: Path, study: Path) -> None:
    from tactile_bayes.files.atomic import sha256

    document = json.loads((undisturbed / "exams" / "07.v1.m1.r1" / "estimate.json").read_text())
    digest = sha256(study / "scans" / "07-a.mcap")
    facts = {"subject": "07", "side": "left", "posture": "phantom", "examiner": "R1"}
    frames = thinned(0, 2).frames.sha256
    assert document["provenance"]["scans"] == [{"sha256": digest, **facts, "frames_sha256": frames}]


@pytest.mark.long
def test_validate_takes_the_trial_table_as_it_is(finished: Path) -> None:
    done = campaign(finished, "--excision", "excision.csv")
    assert done.returncode == 0, done.stderr
    told = run_here("validate", "out/trial.csv", "--excision", "excision.csv", cwd=finished)
    assert told.returncode == 0, told.stderr
    assert done.stdout.endswith(told.stdout)
    as_json = run_here("validate", "out/trial.csv", "--excision", "excision.csv", "--json", cwd=finished)
    assert as_json.stdout == (finished / "out" / "report.json").read_text()
    counts = json.loads(as_json.stdout)["modalities"]["tactile"]
    assert (counts["n"], counts["detected"], counts["masses_not_done"]) == (3, 2, 1)
    assert 'href="report.html"' in (finished / "out" / "index.html").read_text()
    campaign(finished)
    assert not (finished / "out" / "report.json").exists()


@pytest.mark.long
def test_a_protocol_fixes_the_analysis(finished: Path) -> None:
    (finished / "p.toml").write_text('title = "Agreed"\n[analysis]\nintervals = "jackknife"\nseed = 7\n')
    campaign(finished, "--excision", "excision.csv", "--protocol", "p.toml")
    document = json.loads((finished / "out" / "report.json").read_text())
    assert (document["title"], document["provenance"]["seed"]) == ("Agreed", 7)
    alone = campaign(finished, "--protocol", "p.toml")
    assert alone.returncode == 2
    assert "--protocol is for the trial's report; give --excision too" in alone.stderr


@pytest.mark.long
def test_files_are_for_their_owner_alone(undisturbed: Path) -> None:
    for path in (undisturbed, *undisturbed.rglob("*.*")):
        assert path.is_dir() or path.stat().st_mode & 0o777 == 0o600, path
    assert undisturbed.stat().st_mode & 0o777 == 0o700


@pytest.mark.long
def test_two_workers_give_the_same_bytes(undisturbed: Path, own: Path, run_cli: Run) -> None:
    words = ("campaign", "run", "exams.csv", "-o", "out", *FAST, "--workers", 2)
    done = run_cli(*words, cwd=own)
    assert done.returncode == 0, done.stderr
    assert contents(own / "out") == contents(undisturbed)


@pytest.mark.long
def test_the_order_of_the_rows_changes_nothing(finished: Path, undisturbed: Path) -> None:
    write_table(finished / "exams.csv", reversed(ROWS))
    campaign(finished)
    assert contents(finished / "out") == contents(undisturbed)


@pytest.mark.long
def test_without_excision_sizes_there_is_a_trial_table_and_no_report(own: Path) -> None:
    write_table(own / "exams.csv", [ROWS[3]])
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=own)
    assert done.returncode == 0, done.stderr
    assert "no mass pooled: no mass has several exams at one visit" in done.stdout
    assert not (own / "out" / "report.json").exists()
    assert [row["modality"] for row in rows_of(own / "out" / "trial.csv")] == ["tactile"]


@pytest.mark.long
def test_masses_that_were_not_excised_are_left_out_of_the_trial_by_name(finished: Path) -> None:
    own = finished
    (own / "excision.csv").write_text("patient,mass,ex_vivo_mm\n07,1,15\n99,1,15\n")
    done = campaign(own, "--excision", "excision.csv")
    assert "sizes after excision of masses without an exam: 99 1" in done.stdout
    assert "no size after excision, left out of trial.csv: 09 1, 11 1, 12 1" in done.stdout
    assert {row["patient"] for row in rows_of(own / "out" / "trial.csv")} == {"07"}
    assert (own / "out" / "report.html").exists()


@pytest.mark.long
def test_arrays_and_maps_are_exams_too(undisturbed: Path, own: Path) -> None:
    scan = thinned(1, 4)
    np.savez(own / "arrays.npz", **arrays_of(scan))
    savemat(own / "arrays.mat", arrays_of(thinned(2, 4)))
    with h5py.File(own / "short.h5", "w") as file:
        file["counts"] = scan.frames.counts
    shutil.copy(undisturbed / "exams" / "09.v1.m1.r1" / "map.nc", own / "map.nc")
    shutil.copy(own / "map.nc", own / "map2.nc")
    rows = [("arrays.npz", "20", 1, "left"), ("map.nc", "09", 1, "right"), ("arrays.mat", "21", 1, "left")]
    write_table(own / "exams.csv", [*rows, ("short.h5", "22", 1, "left")])
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=own)
    assert "4 exams: 3 sized, 0 without a size, 1 failed" in done.stdout, done.stdout + done.stderr
    told = run_here("import", "short.h5", "-o", "short.mcap", cwd=own).stderr
    assert rows_of(own / "out" / "failures.csv")[0]["reason"].partition(";")[0] in told  # the same words
    assert (own / "out/exams/09.v1.m1.r1/map.nc").read_bytes() == (own / "map.nc").read_bytes()
    run_here("import", "arrays.npz", "-o", "arrays.mcap", cwd=own)
    assert (own / "out/exams/20.v1.m1.r1/scan.mcap").read_bytes() == (own / "arrays.mcap").read_bytes()
    write_table(own / "exams.csv", [("map.nc", "20", 2, "right")])
    run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=own)
    assert "the file says patient 09" in rows_of(own / "out" / "failures.csv")[0]["reason"]


@pytest.mark.long
def test_a_file_in_two_rows_is_a_fault_unless_each_mass_has_its_place(own: Path) -> None:
    shutil.copy(own / "scans" / "07-a.mcap", own / "scans" / "copy.mcap")
    write_table(own / "exams.csv", [("scans/07-a.mcap", "07", 1, "left"), ("scans/copy.mcap", "07", 2, "left")])
    campaign(own)
    told = [row["reason"] for row in rows_of(own / "out" / "failures.csv")]
    assert told[0].startswith("holds the same bytes as 07.v1.m1.r2 (scans/copy.mcap);")
    assert told[1].startswith("holds the same bytes as 07.v1.m1.r1 (scans/07-a.mcap);")
    head = "file,patient,visit,mass,replicate,side,centre_x_mm,centre_y_mm\n"
    (own / "exams.csv").write_text(f"{head}scans/07-a.mcap,07,1,1,1,left,0,0\nscans/07-a.mcap,07,1,2,1,left,18,9\n")
    done = run_here("campaign", "run", "exams.csv", "-o", "out", *FAST, cwd=own)
    assert "1 sized, 1 without a size, 0 failed" in done.stdout
    first, second = (json.loads((own / f"out/exams/07.v1.m{m}.r1/estimate.json").read_text()) for m in (1, 2))
    assert first["provenance"]["settings"]["centre_mm"] == [0.0, 0.0]
    assert second["provenance"]["settings"]["centre_mm"] == [18.0, 9.0]


# --- going on


@pytest.mark.long
def test_a_second_run_does_nothing_again_but_what_failed(undisturbed: Path, study: Path) -> None:
    before, done_before = contents(undisturbed), steps(undisturbed)
    done = campaign(study)
    assert f"2 steps run, {STEPS_OF_ALL} kept from earlier runs" in done.stdout
    assert contents(undisturbed) == before
    assert steps(undisturbed) == done_before


@pytest.mark.long
def test_a_changed_scan_redoes_what_depends_on_it(finished: Path) -> None:
    count = len(steps(finished / "out"))
    write(finished / "scans" / "09-a.mcap", thinned(1, 4, subject="09", side="right"))
    campaign(finished)
    assert steps(finished / "out")[count:] == [
        "map 09.v1.m1.r1",
        "estimate 09.v1.m1.r1",
        "page 09.v1.m1.r1",
        "pool 09.v1.m1",
    ]


@pytest.mark.long
def test_a_changed_setting_redoes_estimates_and_no_map(finished: Path) -> None:
    write_table(finished / "exams.csv", ROWS[:2])
    count = len(steps(finished / "out"))
    campaign(finished, "--seed", 2)
    redone = [f"{step} 07.v1.m1.r{exam}" for step in ("estimate", "page") for exam in (1, 2)]
    assert steps(finished / "out")[count:] == [*redone, "pool 07.v1.m1"]
    run_here("campaign", "run", "exams.csv", "-o", "fresh", *FAST, "--seed", 2, cwd=finished)
    there = {
        name: data for name, data in contents(finished / "out").items() if "/09." not in name and "/11." not in name
    }
    assert there == contents(finished / "fresh")


@pytest.mark.long
def test_a_file_that_was_changed_or_removed_is_made_again(undisturbed: Path, finished: Path) -> None:
    (finished / "out/exams/07.v1.m1.r1/map.nc").write_bytes(b"changed")
    (finished / "out/exams/09.v1.m1.r1/posterior.nc").unlink()
    (finished / "out/index.html").unlink()
    count = len(steps(finished / "out"))
    campaign(finished)
    assert steps(finished / "out")[count:] == ["map 07.v1.m1.r1", "estimate 09.v1.m1.r1"]
    assert contents(finished / "out") == contents(undisturbed)


@pytest.mark.long
def test_files_of_an_exam_that_fails_now_are_removed_and_unlisted_exams_stay(finished: Path) -> None:
    scan = finished / "scans" / "07-a.mcap"
    scan.write_bytes(scan.read_bytes()[:1000])
    write_table(finished / "exams.csv", [*ROWS[:2], ROWS[4]])
    done = campaign(finished)
    assert "1 sized, 1 without a size, 1 failed" in done.stdout
    assert "folders of exams that the table does not list: exams/09.v1.m1.r1, masses/09.v1.m1" in done.stdout
    assert not (finished / "out/exams/07.v1.m1.r1").exists()
    assert (finished / "out/exams/09.v1.m1.r1/map.nc").exists()
    assert "09" not in {row["patient"] for row in rows_of(finished / "out/exams_done.csv")}


@pytest.mark.long
def test_figures_are_drawn_on_demand_and_estimates_stay(finished: Path) -> None:
    write_table(finished / "exams.csv", [ROWS[3], ROWS[4]])
    count = len(steps(finished / "out"))
    campaign(finished, "--figures")
    out = finished / "out"
    assert steps(out)[count:] == ["figures 09.v1.m1.r1", "figures 11.v1.m1.r1"]
    assert (out / "exams/09.v1.m1.r1/size.png").read_bytes().startswith(b"\x89PNG")
    assert not (out / "exams/11.v1.m1.r1/size.png").exists()
    assert 'href="exams/11.v1.m1.r1/map.png"' in (out / "index.html").read_text()


@pytest.mark.long
def test_a_dry_run_says_what_it_would_do_and_writes_nothing(finished: Path) -> None:
    before = contents(finished / "out")
    done = campaign(finished, "--seed", 2, "--dry-run")
    failed = "(07.v1.m1.r3, 12.v1.m1.r1)"
    assert f"map: 2 to do {failed}, 4 done\nestimate: 6 to do, 0 done\npage: 6 to do, 0 done\npool: 4" in done.stdout
    assert contents(finished / "out") == before
    fresh = run_here("campaign", "run", "exams.csv", "-o", "new", "--dry-run", cwd=finished)
    assert "map: 6 to do, 0 done" in fresh.stdout
    assert not (finished / "new").exists()


def start(folder: Path, environment: dict[str, str], *more: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "tactile_bayes", "campaign", "run", "exams.csv"]
    return subprocess.Popen(
        [*words, "-o", "out", *FAST, *more],
        cwd=folder,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background job is born with Ctrl-C ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for_steps(folder: Path, wanted: int, process: subprocess.Popen[str]) -> None:
    """Wait until the journal holds so many steps; a process that ended earlier is a fault."""
    journal = folder / "out" / JOURNAL
    ended = False
    while not ended:
        ended = process.poll() is not None  # before the journal is looked at: the process may have been quicker
        if journal.exists() and journal.read_bytes().count(b"\n") > wanted:
            return
        time.sleep(0.002)
    pytest.fail(f"ended with {process.returncode} before step {wanted}: {process.communicate()[1]}")


def check_resumed(folder: Path, undisturbed: Path) -> None:
    """Finish a campaign that was ended; the same bytes, and nothing that was done is done again."""
    finished = campaign(folder)
    assert finished.returncode == 0, finished.stderr
    assert contents(folder / "out") == contents(undisturbed)
    done = steps(folder / "out")
    assert len(done) == len(set(done)) == STEPS_OF_ALL


@pytest.mark.long
@pytest.mark.parametrize("after", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 7))])
def test_a_killed_run_ends_in_the_same_bytes(
    after: int, undisturbed: Path, own: Path, child_environment: dict[str, str]
) -> None:
    process = start(own, child_environment)
    wait_for_steps(own, after, process)
    time.sleep(random.Random(after).uniform(0.0, 0.15))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    check_resumed(own, undisturbed)


@pytest.mark.slow
def test_fifty_kills_at_any_moment_end_in_the_same_bytes(
    undisturbed: Path, own: Path, child_environment: dict[str, str]
) -> None:
    rng = random.Random(110)
    for number in range(50):
        shutil.rmtree(own / "out", ignore_errors=True)
        workers = "2" if number % 2 else "1"
        for _ in range(rng.randint(1, 3)):
            process = start(own, child_environment, "--workers", workers)
            try:
                process.wait(rng.uniform(0.1, 6.0))
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
            process.communicate()
        check_resumed(own, undisturbed)


@pytest.mark.long
def test_ctrl_c_keeps_what_is_done_and_says_so(undisturbed: Path, own: Path, child_environment: dict[str, str]) -> None:
    told, code = "", 0
    for _ in range(5):  # on a busy machine a run may come to its end before the signal does
        shutil.rmtree(own / "out", ignore_errors=True)
        process = start(own, child_environment)
        wait_for_steps(own, 1, process)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate()
        code = process.returncode
        if code != 0:
            break
    assert code == 130, told
    assert re.search(r"^interrupted: \d+ of \d+ done; .*campaign\.journal keeps them, run again to go on$", told, re.M)
    check_resumed(own, undisturbed)


FULL = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
from tactile_bayes.cli import main
main()
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("limit", "workers"),
    [(300, 1), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((100_000, 1), (400_000, 2)))],
)
def test_a_full_disk_is_one_line_and_loses_nothing(
    limit: int, workers: int, undisturbed: Path, own: Path, run_python: Run
) -> None:
    """A limit on the size of files stands for the disk: maps do not fit, then draws, then the journal."""
    words = ("campaign", "run", "exams.csv", "-o", "out", *FAST, "--workers", workers)
    done = run_python("-c", FULL, limit, *words, cwd=own)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert "run again" in done.stderr
    if limit == 400_000:
        assert sum(step.startswith("map") for step in steps(own / "out")) == 4
    assert not list((own / "out").rglob("*.part"))
    check_resumed(own, undisturbed)


@pytest.mark.long
def test_two_runs_at_once_are_refused(undisturbed: Path, study: Path) -> None:
    import fcntl

    with (undisturbed / JOURNAL).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        done = campaign(study)
    assert done.returncode == 2
    assert "is in use by another run" in done.stderr


@pytest.mark.long
def test_an_output_that_holds_something_else_is_refused(own: Path) -> None:
    (own / "out").mkdir()
    (own / "out" / "thesis.tex").write_text("x")
    done = campaign(own)
    assert done.returncode == 2
    assert "holds files, and no campaign; choose a new folder" in done.stderr
    assert os.listdir(own / "out") == ["thesis.tex"]  # noqa: PTH208


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("-o", "scans"), "scans/gone.mcap lies in the output folder scans; choose another folder"),
        (("-o", "notes.txt"), "notes.txt is a file; give the name of a folder"),
        (("-o", "out", "--settings", "fit.toml"), "a checkpoint is for one map; leave it out of the settings file"),
    ],
)
def test_an_output_that_holds_exams_or_is_a_file_and_a_checkpoint_are_refused(
    more: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    write_table(tmp_path / "exams.csv", [("scans/gone.mcap", "07", 1, "left")])
    (tmp_path / "fit.toml").write_text('checkpoint = "fit.npz"\n')
    (tmp_path / "notes.txt").write_text("notes")
    done = run_here("campaign", "run", "exams.csv", *more, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr


@pytest.mark.long
def test_a_missing_file_is_its_own_row(own: Path) -> None:
    write_table(own / "exams.csv", [("scans/gone.mcap", "07", 1, "left"), ROWS[1]])
    done = campaign(own)
    assert "1 sized, 0 without a size, 1 failed" in done.stdout
    (row,) = rows_of(own / "out" / "failures.csv")
    assert (row["step"], row["reason"]) == ("read", "cannot be read (No such file or directory); check the path")


@pytest.mark.long
def test_a_trial_without_a_reading_has_no_report_and_the_reason(finished: Path) -> None:
    (finished / "excision.csv").write_text("patient,mass,ex_vivo_mm\nother,1,15\n")
    done = campaign(finished, "--excision", "excision.csv")
    assert done.returncode == 0, done.stderr
    assert "no trial report: no exam is of a mass with a size after excision" in done.stdout
