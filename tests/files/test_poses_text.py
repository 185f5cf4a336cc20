"""A tracker's poses in a file of their own: each layout gives the one path, and rows without the tool are gaps."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from engineers_arrays import pressures, short_scan
from scipy.spatial.transform import Rotation

import tactile_bayes as tb
from tactile_bayes.errors import BadDataError
from tactile_bayes.scans import Scan

SCAN = short_scan()
POSES = SCAN.poses
PLACE, TIME = POSES.position_mm, POSES.time_s
TURNED = Rotation.from_quat(POSES.quaternion_wxyz, scalar_first=True)
MATRICES = np.tile(np.eye(4), (len(TIME), 1, 1))
MATRICES[:, :3, :3], MATRICES[:, :3, 3] = TURNED.as_matrix(), PLACE
LOST = {7: "Missing", 8: "Missing", 9: "Missing", 20: "OutOfVolume"}
"""Rows in which the tool is not seen, with NDI's word for it."""
KEPT = [i for i in range(len(TIME)) if i not in LOST]


def brought_in(path: Path, **stated: Any) -> Scan:
    return tb.scan(pressures(SCAN), SCAN.frames.time_s, path, head=SCAN.head, unit="kPa", **stated)


def same(found: Scan, kept: list[int] | None = None) -> None:
    kept = list(range(len(TIME))) if kept is None else kept
    np.testing.assert_allclose(found.poses.time_s, TIME[kept], atol=2e-4)
    np.testing.assert_allclose(found.poses.position_mm, PLACE[kept], atol=2e-3)
    apart = TURNED[kept].inv() * Rotation.from_quat(found.poses.quaternion_wxyz, scalar_first=True)
    assert apart.magnitude().max() < 1e-4


def numbers(*values: Any) -> str:
    return ",".join(f"{value:.6f}" for value in np.concatenate([np.ravel(one) for one in values]))


def ndi(*, tool: str = "Port:1", shift: float = 0.0) -> list[str]:
    """Rows of NDI's Combined API sample: Frame#, ToolHandle, Face, TransformStatus, q0 to qz, tx to tz, error;
    a tool that is not seen is ``Missing`` and its fields are empty.
    """
    lines = []
    for i, (place, turn) in enumerate(zip(PLACE + shift, POSES.quaternion_wxyz, strict=True)):
        start = f"{600 + i},{tool},0,{LOST.get(i, 'Enabled')},"
        seen = LOST.get(i) != "Missing"
        lines.append(start + (f"{numbers(turn, place)},0.12,4" if seen else ",,,,,,,,"))
    return lines


NDI = "Frame#,ToolHandle,Face#,TransformStatus,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,#Markers"


def with_times(lines: list[str], made: Callable[[float], str] = "{:.4f}".format) -> list[str]:
    return [f"{made(t)},{line}" for t, line in zip(TIME, lines, strict=True)]


def polhemus(stations: int = 1, unit: float = 1.0) -> list[str]:
    """Azimuth, elevation and roll in degrees: about z, the new y, the new x (Polhemus, FASTRAK User's Manual)."""
    angles = unit * TURNED.as_euler("ZYX", degrees=True)
    return [
        f"{t:.4f},{s},{numbers(place / 10 + 5 * (s - 1), turn)}"
        for t, place, turn in zip(TIME, PLACE, angles, strict=True)
        for s in range(1, stations + 1)
    ]


def motive(bodies: int = 1) -> list[str]:
    """OptiTrack's Motive (format 1.2x): what it exports, then kind, name and part of each column; the quaternion with
    its scalar last stands before the place, and cells are blank where a body is not seen.
    """
    head = [
        "Format Version,1.23,Take Name,exam,Export Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,Meters",
        "",
        ",".join([",Type", *["Rigid Body"] * 8 * bodies]),
        ",".join([",Name", *(f"Body {i + 1}" for i in range(bodies) for _ in range(8))]),
        ",".join([",", *["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error"]),
        ",".join(["Frame,Time (Seconds)", *["X,Y,Z,W,X,Y,Z,"] * bodies]),
    ]
    rows = []
    for i, (t, place, turn) in enumerate(zip(TIME, PLACE / 1000, TURNED.as_quat(), strict=True)):
        cells = [numbers(turn, place + 9 * (bodies - 1 - body)) + ",0.0001" for body in range(bodies)]
        rows.append(f"{i},{t:.6f}," + ",".join([","] * 7 * bodies if i in LOST else cells))
    return [*head, *rows]


EULER = "time,station,x (cm),y (cm),z (cm),azimuth,elevation,roll"
QUATERNIONS = [numbers(place, turn) for place, turn in zip(PLACE, POSES.quaternion_wxyz, strict=True)]
SCALAR_LAST = [numbers(place, turn) for place, turn in zip(PLACE, TURNED.as_quat(), strict=True)]
IN_METRES = [numbers(place / 1000, turn) for place, turn in zip(PLACE, POSES.quaternion_wxyz, strict=True)]


def german(lines: list[str]) -> list[str]:
    return [one.replace(",", ";").replace(".", ",") for one in with_times(lines)]


ROWS_OF_16 = [numbers(one) for one in MATRICES]
LAYOUTS: dict[str, tuple[list[str], dict[str, Any], list[int] | None]] = {
    "NDI with times": (["Time (s)," + NDI, *with_times(ndi())], {}, KEPT),
    "NDI with ms": (["timestamp_ms," + NDI, *with_times(ndi(), lambda t: f"{1000 * t:.2f}")], {}, KEPT),
    "NDI with timespec": (
        ["timespec_s,timespec_ns," + NDI, *with_times(ndi(), lambda t: f"{int(t)},{round(1e9 * (t % 1))}")],
        {},
        KEPT,
    ),
    "NDI by frames": ([NDI, *ndi()], {"pose_rate_hz": 120.0}, KEPT),
    "NDI, another tool": (
        ["Time," + NDI, *with_times(ndi()), *with_times(ndi(tool="Port:2", shift=99))],
        {"tool": "Port:1"},
        KEPT,
    ),
    "NDI, tools beside": (
        ["Time," + NDI + "," + NDI, *with_times([f"{a},{b}" for a, b in zip(ndi(shift=99), ndi(), strict=True)])],
        {"tool": "2"},
        KEPT,
    ),
    "Polhemus": ([EULER, *polhemus()], {}, None),
    "Polhemus, inches": (
        [EULER.replace("cm", "in"), *(line for line in polhemus())],
        {"length_unit": "cm"},
        None,
    ),
    "Polhemus, two receivers": ([EULER, *polhemus(2)], {"tool": "1"}, None),
    "Polhemus without names": (polhemus(2), {"pose_layout": "euler", "length_unit": "cm", "tool": "1"}, None),
    "Polhemus, counted": (
        [f"{i} {line.partition(',')[2].partition(',')[2].replace(',', ' ')}" for i, line in enumerate(polhemus())],
        {"pose_layout": "euler", "length_unit": "cm", "pose_rate_hz": 120.0},
        None,
    ),
    "azimuth in radians": (
        [EULER.replace("azimuth", "azimuth (rad)"), *polhemus(unit=np.pi / 180)],
        {},
        None,
    ),
    "OptiTrack": (motive(), {}, KEPT),
    "OptiTrack, the second body": (motive(2), {"tool": "2"}, KEPT),
    "quaternions": (with_times(QUATERNIONS), {"pose_layout": "wxyz"}, None),
    "scalar last": (with_times(SCALAR_LAST), {"pose_layout": "xyzw"}, None),
    "scalar last by names": (["t,px,py,pz,qx,qy,qz,qw", *with_times(SCALAR_LAST)], {}, None),
    "in metres": (
        ["t,x (m),y (m),z (m),qw,qx,qy,qz", *with_times(IN_METRES)],
        {},
        None,
    ),
    "in metres by German names": (["Zeit;px_m;py_m;pz_m;qw;qx;qy;qz", *german(IN_METRES)], {}, None),
    "names behind #": (
        ["# t x y z qw qx qy qz", *(one.replace(",", " ") for one in with_times(QUATERNIONS))],
        {},
        None,
    ),
    "matrices": (with_times(ROWS_OF_16), {}, None),
    "matrices of 12": (with_times([numbers(one[:3]) for one in MATRICES]), {}, None),
    "matrices by rate": (ROWS_OF_16, {"pose_rate_hz": 120.0}, None),
    "blanks": ([line.replace(",", "  ") for line in with_times(ROWS_OF_16)], {}, None),
    "decimal commas": ([line.replace(",", ";").replace(".", ",") for line in with_times(ROWS_OF_16)], {}, None),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_each_layout_gives_the_one_path(tmp_path: Path, name: str) -> None:
    lines, stated, kept = LAYOUTS[name]
    (tmp_path / "poses.csv").write_text("\n".join([*lines, ""]))
    found = brought_in(tmp_path / "poses.csv", **stated)
    same(found, kept)
    if kept is not None:
        why = "4 without numbers" if "OptiTrack" in name else "3 with status Missing, 1 with status OutOfVolume"
        assert f"4 of 36 poses left out as gaps: {why}" in found.session["imported_as"]


def test_rows_that_mean_no_pose_are_gaps_whatever_marks_them(tmp_path: Path) -> None:
    """A server goes on sending the identity, or NDI's -3.697314E28, or nothing, while the tool is hidden."""
    lines = with_times(ROWS_OF_16)
    lines[5] = f"{TIME[5]:.4f},{numbers(np.eye(4))}"
    lines[6] = f"{TIME[6]:.4f},{','.join(['nan'] * 16)}"
    lines[11] = f"{TIME[11]:.4f},{','.join(['-3.697314e28'] * 16)}"
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    found = brought_in(tmp_path / "poses.csv")
    same(found, [i for i in range(len(TIME)) if i not in (5, 6, 11)])
    told = found.session["imported_as"]
    assert "3 of 36 poses left out as gaps" in told
    for why in ("1 with the identity", "1 without numbers", "1 with numbers that mean none"):
        assert why in told
    turned = ["t,x,y,z,qw,qx,qy,qz", *with_times(QUATERNIONS)]
    turned[4] = f"{TIME[3]:.4f},0,0,0,0,0,0,0"
    turned[7] = f"{TIME[6]:.4f},0,0,0,1,0,0,0"
    (tmp_path / "poses.csv").write_text("\n".join(turned))
    same(brought_in(tmp_path / "poses.csv"), [i for i in range(len(TIME)) if i not in (3, 6)])


@pytest.mark.parametrize("hidden", [np.nan, 1.0], ids=["NaN", "identity"])
@pytest.mark.parametrize("as_matrices", [True, False])
def test_gaps_of_arrays_are_gaps_too(hidden: float, as_matrices: bool) -> None:
    """MATLAB and Python leave NaN or the identity where the tool is not seen."""
    matrices, place, turn = MATRICES.copy(), PLACE.copy(), POSES.quaternion_wxyz.copy()
    matrices[4:7], place[4:7], turn[4:7] = hidden * np.eye(4), 0.0, hidden * np.array([1.0, 0, 0, 0])
    poses = (TIME, matrices) if as_matrices else (TIME, place, turn)
    found = tb.scan(pressures(SCAN), SCAN.frames.time_s, poses, head=SCAN.head, unit="kPa")
    same(found, [i for i in range(len(TIME)) if i not in (4, 5, 6)])
    assert "3 of 36 poses left out as gaps" in found.session["imported_as"]


def test_angles_that_may_be_radians_are_asked_about() -> None:
    angles = TURNED.as_euler("ZYX")
    poses = TIME, PLACE, angles
    with pytest.warns(
        UserWarning, match="CAUTION: angles lie within 6.3 and are read as degrees; multiply radians by 57.296"
    ):
        tb.scan(pressures(SCAN), SCAN.frames.time_s, poses, head=SCAN.head, unit="kPa", pose_layout="euler")


def test_columns_of_a_dataframe_are_not_taken_for_others(tmp_path: Path) -> None:
    """Quaternions with the scalar last were read as scalar first, and times beside a file of frames were dropped."""
    quaternion = TURNED.as_quat()
    poses = pd.DataFrame(
        np.column_stack([TIME, PLACE, quaternion]), columns=["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
    )
    stated = {"head": SCAN.head, "unit": "kPa"}
    found = tb.scan(pressures(SCAN), SCAN.frames.time_s, poses, **stated)
    np.testing.assert_allclose(found.poses.quaternion_wxyz, np.roll(quaternion, 1, axis=1))
    rows = np.column_stack([1000 * SCAN.frames.time_s + 7, pressures(SCAN).reshape(len(SCAN.frames), -1)])
    names = ["time_ms", *(f"S{i}" for i in range(rows.shape[1] - 1))]
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(names), comments="")
    found = tb.scan(tmp_path / "a.csv", SCAN.frames.time_s, poses, **stated)
    np.testing.assert_allclose(found.poses.quaternion_wxyz, np.roll(quaternion, 1, axis=1))
    np.testing.assert_array_equal(found.frames.time_s, SCAN.frames.time_s)


def test_a_status_in_numbers_has_to_be_stated(tmp_path: Path) -> None:
    lines = [f"{i % 2 * 2},{line}" for i, line in enumerate(with_times(QUATERNIONS))]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(["status,t,x,y,z,qw,qx,qy,qz", *lines]))
    with pytest.raises(BadDataError, match=r"its status is 0 \(18 rows\), 2 \(18 rows\).*pose_good"):
        brought_in(path)
    same(brought_in(path, pose_good="2"), list(range(1, len(TIME), 2)))


FAULTS: dict[str, tuple[list[str], dict[str, Any], str]] = {
    "two tools": (
        ["Time," + NDI, *with_times(ndi()), *with_times(ndi(tool="Port:2"))],
        {},
        "has 2 tools in its rows: Port:1, Port:2; choose one",
    ),
    "no such tool": (["Time," + NDI, *with_times(ndi())], {"tool": "Port:9"}, "has no one tool 'Port:9'.*Port:1"),
    "a tool without a name": (
        ["Time," + NDI, *with_times(ndi()), *with_times(ndi(tool=""))],
        {"tool": "Port:9"},
        "has no one tool 'Port:9'",
    ),
    "no times": ([NDI, *ndi()], {}, "has frame numbers but no times; .*pose_rate_hz"),
    "no unit": ([EULER.replace(" (cm)", ""), *polhemus()], {}, "does not say the unit of x, y and z.*length_unit"),
    "no unit and no names": (polhemus(), {"pose_layout": "euler"}, "does not say the unit of x, y and z.*length_unit"),
    "a layout too long": (polhemus(), {"pose_layout": "matrix"}, "has 8 numbers a row, and a pose as matrix has 16"),
    "no frame numbers": (
        ["frame,x,y,z,qw,qx,qy,qz", *(f",{line}" for line in QUATERNIONS)],
        {"pose_rate_hz": 60.0},
        "its column of times or frame numbers has no number; leave it out, and give pose_rate_hz",
    ),
    "no layout": (with_times(QUATERNIONS), {}, "has 8 numbers a row and no names; give pose_layout"),
    "another clock": (
        ["time,x,y,z,qw,qx,qy,qz", *with_times(QUATERNIONS, lambda t: f"10:15:{t:06.3f} AM")],
        {},
        r"its column of times holds '10:15:00\.000 AM', which is no time that is known; write s",
    ),
    "metres": (
        ["t,x,y,z,qw,qx,qy,qz", *with_times(IN_METRES)],
        {},
        "looks like metres .* or their unit, .*length_unit=.m",
    ),
    "no qz": (["t,x,y,z,qw,qx,qy", *with_times(QUATERNIONS)], {}, "line 1 names no qz"),
    "no row": (["5,2,3,1,0,0,0,9", "t,x,y,z,qw,qx,qy,qz"], {}, "line 2 names columns, and no row stands below it"),
    "numbered from 1": (["t,x,y,z,q1,q2,q3,q4", *with_times(QUATERNIONS)], {}, "line 1 names no qw"),
    "both": (["t,x,y,z,qw,qx,qy,qz", *with_times(QUATERNIONS)], {"pose_layout": "xyzw"}, "leave pose_layout out"),
    "never seen": (
        [NDI, *(line.replace("Enabled", "Missing") for line in ndi())],
        {"pose_rate_hz": 60.0},
        "its status is",
    ),
    "in columns": (with_times([numbers(one.T) for one in MATRICES]), {}, "pose_matrix is not rigid at index 0"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_poses_with_a_fault_are_one_line(tmp_path: Path, fault: str) -> None:
    lines, stated, words = FAULTS[fault]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(BadDataError, match=words) as caught:
        brought_in(path, **stated)
    assert "\n" not in str(caught.value)


def test_an_error_names_the_file_that_it_is_about(tmp_path: Path) -> None:
    (tmp_path / "frames.npz").write_bytes(b"")
    np.savez(tmp_path / "frames.npz", frames=pressures(SCAN), frame_time_s=SCAN.frames.time_s)
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(with_times(ROWS_OF_16, lambda t: f"{1000 * t:.2f}")))
    with pytest.raises(BadDataError, match=r"poses\.csv: pose_time_s steps by 8.*pose_time_unit=.ms"):
        tb.scan(tmp_path / "frames.npz", None, path, head=SCAN.head, unit="kPa")
    lines = with_times(ROWS_OF_16)
    lines[5] = lines[5].rpartition(",")[0]
    path.write_text("\n".join(lines))
    found = brought_in(path)
    same(found, [i for i in range(len(TIME)) if i != 5])
    assert "1 lines of other than 17 numbers left out as gaps" in found.session["imported_as"]


def sequence(path: Path, *, packed: bool, tools: tuple[str, ...] = ("Probe",)) -> None:
    """A sequence metafile as PLUS writes it (plustoolkit.org, Sequence file format; MetaIO's header)."""
    poses = np.searchsorted(TIME, SCAN.frames.time_s).clip(0, len(TIME) - 1)
    n = len(poses)
    head = ["ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False"]
    head += [f"CompressedData = {packed}", f"DimSize = 26 16 {n}", "ElementType = MET_FLOAT"]
    for i, pose in enumerate(poses):
        for tool in tools:
            hidden = i in (3, 4)
            matrix = np.eye(4) if hidden else MATRICES[pose]
            told = " ".join(f"{value:.6f}" for value in matrix.ravel())
            head.append(f"Seq_Frame{i:04d}_{tool}ToTrackerTransform = {told}")
            head.append(f"Seq_Frame{i:04d}_{tool}ToTrackerTransformStatus = {'INVALID' if hidden else 'OK'}")
        head.append(f"Seq_Frame{i:04d}_Timestamp = {SCAN.frames.time_s[i]:.6f}")
        head.append(f"Seq_Frame{i:04d}_ImageStatus = OK")
    data = pressures(SCAN).astype("<f4").tobytes()
    path.write_bytes(
        "\n".join([*head, "ElementDataFile = LOCAL\n"]).encode() + (zlib.compress(data) if packed else data)
    )


@pytest.mark.parametrize("packed", [False, True])
def test_a_sequence_metafile_has_frames_and_poses(tmp_path: Path, packed: bool) -> None:
    sequence(tmp_path / "exam.igs.mha", packed=packed)
    found = tb.scan(tmp_path / "exam.igs.mha", head=SCAN.head, unit="kPa")
    kpa = found.element_calibration.to_kpa(found.frames.counts)
    np.testing.assert_allclose(kpa, pressures(SCAN), atol=1e-3)
    assert len(found.poses) == len(found.frames) - 2
    assert "2 of 60 poses left out as gaps: 2 with status INVALID" in found.session["imported_as"]
    assert len(brought_in(tmp_path / "exam.igs.mha").poses) == 58


def test_a_sequence_metafile_with_two_tools_or_damage_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "exam.mha"
    sequence(path, packed=True, tools=("Probe", "Reference"))
    with pytest.raises(BadDataError, match="2 tools in its transforms: ProbeToTracker, ReferenceToTracker"):
        brought_in(path)
    assert len(brought_in(path, tool="ProbeToTracker").poses) == 58
    data = path.read_bytes()
    for bad in (
        data[:100],
        data[: len(data) // 2],
        data.replace(b"26 16", b"99 99"),
        data.replace(b"MET_FLOAT", b"MET_X"),
    ):
        path.write_bytes(bad)
        with pytest.raises(BadDataError) as caught:
            tb.scan(path, head=SCAN.head, unit="kPa", tool="ProbeToTracker")
        assert "\n" not in str(caught.value)
    path.write_bytes(data.replace(b"_Timestamp", b"_Timeshift"))
    with pytest.raises(BadDataError, match="has frames without a time"):
        brought_in(path, tool="ProbeToTracker")
