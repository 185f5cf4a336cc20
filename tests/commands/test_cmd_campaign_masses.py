"""`campaign run` on breasts with two masses: matched by place between exams, refused where that is ambiguous."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from campaign_files import rows_of
from few_draws import few_draws  # noqa: F401 - all tests of this file use it
from in_process import run_here
from posterior_maps import bump_values, correlated_field, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.files.map_nc import write_map
from tactile_bayes.files.provenance import Provenance

WIDE, NARROW = (-17.0, 2.0), (16.0, 2.0)
HEAD = "file,patient,visit,mass,replicate,side,centre_x_mm,centre_y_mm"
TWO_PLACES = ("a.nc,P1,1,1,1,left,-17,2", "a.nc,P1,1,2,1,left,16,2")
SHIFT = (5.0, -8.0)
"""Of the second exam's map against the first one's."""


def written(
    path: Path, *, shift: tuple[float, float] = (0.0, 0.0), landmarks: bool = True, narrow: float = 0.3
) -> None:
    """A map of both masses whose own axes are shifted; with landmarks the patient's axes are the first map's."""
    rng = np.random.default_rng(len(path.name))
    values = np.ones((71, 71))
    for (x, y), sigma, amplitude in ((WIDE, 6.0, 0.3), (NARROW, 3.5, narrow)):
        place = {"x": x + shift[0], "y": y + shift[1], "sigma_x": sigma, "sigma_y": sigma}
        values += bump_values(half_mm=35.0, amplitude=amplitude, level=0.0, **place)
    values += 0.005 * correlated_field(rng, len(values), length_cells=3.0)
    tactile_map = grid_map(values + 0.005 * rng.standard_normal(values.shape), normalise="gain")
    turn = np.eye(4)
    turn[:2, 3] = -60.0 - shift[0], 90.0 - shift[1]  # in the left breast
    write_map(
        path, replace(tactile_map, patient_from_plane=turn if landmarks else None), provenance=Provenance("import", {})
    )


def campaign(folder: Path, *rows: str, more: tuple[object, ...] = ()) -> str:
    (folder / "exams.csv").write_text("\n".join((HEAD, *rows)) + "\n")
    done = run_here("campaign", "run", "exams.csv", "-o", "out", "--method", "laplace", *more, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def centre(folder: Path, name: str) -> tuple[float, float]:
    document = json.loads((folder / f"out/exams/{name}/estimate.json").read_text())
    return tuple(round(document["centre_mm"][axis]["median"]) for axis in "xy")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    written(tmp_path / "a.nc")
    written(tmp_path / "b.nc", shift=SHIFT)
    return tmp_path


@pytest.mark.long
def test_replicates_and_visits_are_matched_by_place_in_patient_axes(folder: Path) -> None:
    told = campaign(folder, *TWO_PLACES, "b.nc,P1,1,1,2,left,,", "b.nc,P1,1,2,2,left,,")
    assert "4 exams: 4 sized" in told
    assert "no row names" not in told
    assert centre(folder, "P1.v1.m1.r2") == (-12, -6)
    assert centre(folder, "P1.v1.m2.r2") == (21, -6)
    assert not any(row.get("findings") for row in rows_of(folder / "out" / "exams_done.csv"))
    (folder / "c").mkdir()
    for name in ("a.nc", "b.nc"):
        (folder / "c" / name).write_bytes((folder / name).read_bytes())
    campaign(folder / "c", *TWO_PLACES, "b.nc,P1,2,2,1,left,,")
    assert centre(folder / "c", "P1.v2.m2.r1") == (21, -6)


@pytest.mark.long
def test_without_a_place_the_largest_is_taken_and_the_other_is_reported(folder: Path) -> None:
    """The control: no row names a place."""
    told = campaign(folder, "b.nc,P1,1,2,2,left,,")
    assert centre(folder, "P1.v1.m2.r2") == (-12, -6)
    assert "exams with a mass that no row names, see their findings: P1.v1.m2.r2" in told
    (row,) = rows_of(folder / "out" / "exams_done.csv")
    assert re.search(r"a mass at \((20.9|21.0), -6.0\) mm on the map is named by no row", row["findings"])


@pytest.mark.long
def test_a_side_that_only_the_table_says_is_held_against_the_landmarks(folder: Path) -> None:
    """The control is the first test: its rows say left, and nothing is found."""
    campaign(folder, "a.nc,P1,1,1,1,right,,")
    (row,) = rows_of(folder / "out" / "exams_done.csv")
    assert row["verdict"] == "doubtful"
    assert (
        "CAUTION: the table says right breast, and the landmarks put the lump 77 mm to the patient's left"
        in (row["findings"])
    )


@pytest.mark.long
def test_without_landmarks_the_maps_own_axes_decide_and_it_is_said(folder: Path) -> None:
    written(folder / "bare.nc", shift=SHIFT, landmarks=False)
    campaign(folder, *TWO_PLACES, "bare.nc,P1,1,2,2,left,,")
    assert centre(folder, "P1.v1.m2.r2") == (21, -6)  # 9 mm off in these axes
    row = next(row for row in rows_of(folder / "out" / "exams_done.csv") if row["replicate"] == "2")
    assert "matched by place in the maps' own axes, because a scan has no landmarks" in row["findings"]


@pytest.mark.long
def test_a_mass_that_is_not_within_the_distance_is_not_taken(folder: Path) -> None:
    written(folder / "bare.nc", shift=SHIFT, landmarks=False)
    campaign(folder, *TWO_PLACES, "bare.nc,P1,1,2,2,left,,", more=("--match-mm", "6"))
    trial = {(row["mass"], row["replicate"]): row for row in rows_of(folder / "out" / "trial.csv")}
    assert trial["2", "1"]["status"] == "detected"  # the control: the exam that names the place
    assert trial["2", "2"]["status"] == "not_detected"
    assert trial["2", "2"]["reason"] == "no lump found within 6 mm of mass 2's place, (16.0, 2.0) mm"


@pytest.mark.long
def test_exams_of_a_mass_that_lie_apart_are_reported(folder: Path) -> None:
    """The second row's place is the other mass's; the control has both rows at one."""
    campaign(folder, "a.nc,P1,1,1,1,left,-17,2", "b.nc,P1,1,1,2,left,21,-6")
    rows = {row["replicate"]: row["findings"] for row in rows_of(folder / "out" / "exams_done.csv")}
    assert "its mass lies 33 mm from that of the other maps" in rows["2"]
    assert "its mass lies" not in rows["1"]
    (folder / "c").mkdir()
    for name in ("a.nc", "b.nc"):
        (folder / "c" / name).write_bytes((folder / name).read_bytes())
    campaign(folder / "c", "a.nc,P1,1,1,1,left,-17,2", "b.nc,P1,1,1,2,left,-12,-6")
    assert not any("CAUTION" in row["findings"] for row in rows_of(folder / "c" / "out" / "exams_done.csv"))


@pytest.mark.long
def test_two_masses_near_one_place_are_refused_by_name(folder: Path) -> None:
    told = campaign(folder, "a.nc,P1,1,2,1,left,16,2", "b.nc,P1,1,2,2,left,,", more=("--match-mm", "50"))
    assert "P1.v1.m2.r2: estimate: shows masses at (" in told
    assert "within 50 mm of mass 2's place; give the row its centre_x_mm" in told
    (row,) = rows_of(folder / "out" / "failures.csv")
    assert row["step"] == "estimate"


def test_rows_of_one_scan_without_a_place_anywhere_are_still_refused(folder: Path) -> None:
    told = campaign(folder, "a.nc,P1,1,1,1,left,,", "a.nc,P1,1,2,1,left,,")
    assert "holds the same bytes as" in told


def test_a_place_on_a_map_that_could_not_be_made_names_that_exam(folder: Path) -> None:
    (folder / "a.nc").write_bytes(b"\x89HDF\r\n\x1a\n and no more")
    told = campaign(folder, *TWO_PLACES, "b.nc,P1,1,1,2,left,,", "b.nc,P1,1,2,2,left,,")
    assert "the place of its mass is on the map of P1.v1.m2.r1, which was not made" in told
