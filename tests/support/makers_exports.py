"""Exports of makers' programs: small samples of our own in the layouts that their users describe in public.

Each holds the frames, or the poses, of one short scan, and names where its layout is described.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from engineers_arrays import pressures, short_scan
from scipy.spatial.transform import Rotation

from tactile_bayes.presets import KPA_PER_UNIT

SCAN = short_scan()
KPA = pressures(SCAN)[:20]
TIME = SCAN.frames.time_s[:20]
POSES = SCAN.poses
TURNED = Rotation.from_quat(POSES.quaternion_wxyz, scalar_first=True)
HIDDEN = (7, 8, 20)
"""Poses of a tool that was not seen."""
KPA_PER_COUNT = 15 * KPA_PER_UNIT["psi"] / 511
"""Of a SingleTact of 15 psi."""


class Export(NamedTuple):
    """A sample and the command that imports it."""

    described: str  #: Where the layout is described.
    text: str | bytes
    options: tuple[str, ...] = ()  #: Of `import`, beside the head and what the sample does not hold.
    told: str = ""  #: A line that it prints.
    poses: bool = False  #: It holds poses, else frames.
    kept: tuple[int, ...] = tuple(range(len(POSES.time_s)))  #: Poses that are read.
    within: float = 2e-3  #: kPa, to which the frames are written.
    suffix: str = ".csv"


def rows(values: Any, separator: str = ",", digits: int = 4) -> list[str]:
    line = separator.join([f"%.{digits}f"] * np.shape(values)[-1])
    return [line % tuple(row) for row in values]


def timed(unit: str, separator: str = ",") -> list[tuple[float, str]]:
    """Time of each frame, and its readings in a row."""
    return list(zip(TIME, rows(KPA.reshape(len(KPA), -1) / KPA_PER_UNIT[unit], separator, 5), strict=True))


def clock(time_s: float) -> str:
    return f"10:15:{time_s:06.3f}"


def tekscan(frames: Any, unit: str, *, padded: bool = False) -> str:
    """``KEY value`` lines up to ``ASCII_DATA @@``, then titled blocks of rows; in a .csv all lines have one width."""
    head = [
        "DATA_TYPE MOVIE", "VERSION I-Scan 7.60", "HARDWARE 1", "MAP_VERSION 1", "HW_TYPE 2", "FILENAME exam.fsx",
        "SENSOR_TYPE 5051", "ROWS 16", "COLS 26", "ROW_SPACING 1.5 mm", "COL_SPACING 1.5 mm", "SENSEL_AREA 2.25 mm2",
        "NOISE_THRESHOLD 3", "SECONDS_PER_FRAME 0.005", "MICRO_SECOND 0", "TIME Thu Nov 26 10:15:30 2026",
        "SCALE_FACTOR 1.0", "EXPONENT 1", f"SATURATION_PRESSURE 4000.0 {unit}", "CALIBRATION_POINT_1 60.0",
        "SENSITIVITY S-25", "START_FRAME 1", "END_FRAME 60", f"UNITS {unit}", "MIRROR_ROW 0", "MIRROR_COL 0",
        "COMMENTS: left", "ASCII_DATA @@", "",
    ]  # fmt: skip
    lines = [*head, *blocks(frames, "Frame {}"), "@@", ""]
    return "\n".join(line if "," in line else line + 25 * "," for line in lines) if padded else "\n".join(lines)


def blocks(frames: Any, title: str) -> list[str]:
    return [line for i, frame in enumerate(frames) for line in (title.format(i + 1), *rows(frame), "")]


def xsensor_blocks() -> str:
    """PRO 7: what is known of a frame as ``Key:,"value"``, then its rows, with decimal commas between quotes."""
    lines = ['File name:,"exam.xsn"', 'Rows:,"16"', 'Columns:,"26"', 'Units:,"mmHg"', ""]
    for i, (t, frame) in enumerate(zip(TIME, KPA / KPA_PER_UNIT["mmHg"], strict=True)):
        told = [f'Frame:,"{i + 1}"', 'Date:,"26-11-2026"', f'Time:,"{clock(t)}"', 'Sensor:,"PX100:16.26"']
        told += ['Average pressure (mmHg):,"68,3"', 'Contact area (cm²):,"9,4"', 'COP Row:,"8,5"', 'COP Column:,"13,1"']
        quoted = ['"' + row.replace(",", '","').replace(".", ",") + '"' for row in rows(frame)]
        lines += [*told, *quoted, ""]
    return "\n".join(lines)


def xsensor_rows() -> str:
    """PRO 8: one row a frame; sensels are called by their row and column, and sums stand before them."""
    before = "Frame,Date,Time,Units,Sensor,Average Pressure (psi),Peak Pressure (psi),Contact Area (in²),"
    names = [before + "Est. Load (lbf),Std Dev (psi),COP Row,COP Column"]
    names += [f"S_{i + 1}_{j + 1}" for i in range(16) for j in range(26)]
    each = "{},2026-11-26, {},psi,PX100,1.35,1.52,1.44,1.95,0.11,8.5,13.1,{}"
    return "\n".join([",".join(names), *(each.format(i, clock(t), row) for i, (t, row) in enumerate(timed("psi")))])


def pps() -> str:
    """TVN and Chameleon: one row a frame, ``elem1 [psi.]`` onwards, behind figures of each region."""
    names = ["Time [s]", "Tip Average Pressure [psi.]", "Tip Total Force [lbs.]", "Tip Contact Area [sq in.]"]
    names += ["Tip Centroid X", "Tip Centroid Y", "Tip Peak Location X"]
    names += [f"elem{i + 1} [psi.]" for i in range(416)]
    return "\n".join([",".join(names), *(f"{t:.4f},1.4,2.0,1.4,0.1,0.2,0.3,{row}" for t, row in timed("psi"))])


def novel() -> str:
    """pedar and pliance: facts of the file, the unit of pressures, then a time and a column a sensor, between tabs."""
    head = ["\tfile name: exam.asc\tdate/time 26.11.26 10.15", "sensor type: S2073-200KPa"]
    head += ["total time [secs]: 0.300\ttime per frame [secs]: 0.005\tscanning rate [Hz]:  200"]
    head += ["pressure values in kPa", "", "electrical:", "time[secs]"]
    return "\n".join([*head, *(f"{t:.3f}\t{row}" for t, row in timed("kPa", "\t"))])


def singletact(separator: str = ",") -> str:
    """Demo program: a time and a column a sensor, called PSI; numbers are counts, of which 511 are the full scale."""
    note = "NB (0 = 0 PSI;  511 = Full Scale Range)"
    names = separator.join(["Time(s)", *(f"COM{i + 3} (PSI)" for i in range(416)), note])
    counts = np.rint(KPA.reshape(len(KPA), -1) / KPA_PER_COUNT).astype(int)
    lines = [separator.join([f"{t:.3f}", *map(str, row), ""]) for t, row in zip(TIME, counts, strict=True)]
    return "\n".join([names, *(line.replace(".", ",") if separator == ";" else line for line in lines)])


def reskin() -> str:
    """Five magnetometers: a temperature and three components of the field of each."""
    names = ",".join(f"{name}{i}" for i in range(5) for name in ("T", "Bx", "By", "Bz"))
    field = np.random.default_rng(0).normal(0, 90, (len(TIME), 20))
    return "\n".join([names, *rows(field, digits=2)])


def numbers(*values: Any) -> str:
    return ",".join(f"{value:.6f}" for value in np.concatenate([np.ravel(one) for one in values]))


def toolbox(tools: int = 1, *, markers: bool = True) -> str:
    """NDI ToolBox: each tool with its frame, time, state, pose and markers beside the others'."""
    known = "Frame,Time [sec],Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    known += ",Markers" + ",State,Tx,Ty,Tz" * 3 if markers else ""
    names = [f"Port 0x0{i + 1}: Probe {i + 1}  s/n:3E4C880{i}" for i in range(tools)]
    lines = [",".join(["Tools", *(f"{name},{known}" for name in names)])]
    stray = ",3" + ",OK,1.0,2.0,3.0" * 3 if markers else ""
    for i, (t, place, turn) in enumerate(zip(POSES.time_s, POSES.position_mm, POSES.quaternion_wxyz, strict=True)):
        told = [str(tools)]
        for k, name in enumerate(names):
            pose = numbers(turn, place + 100 * (tools - 1 - k))
            state = f"OK,{pose},0.21"
            if i in HIDDEN:
                state = f"Too Few Markers,{','.join(['-3.697314E28'] * 7)},0.0000000"
            told.append(f"{name},{650512279 + i},{1778067471 + t:.9f},1,{state}{stray}")
        lines.append(",".join(told))
    return "\n".join(lines)


def combined_api() -> str:
    """NDI's Combined API sample: a row a tool and frame, of which one without the tool has empty fields."""
    lines = ["Time (s),Frame#,ToolHandle,Face#,TransformStatus,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,#Markers"]
    for i, (t, place, turn) in enumerate(zip(POSES.time_s, POSES.position_mm, POSES.quaternion_wxyz, strict=True)):
        seen = f"Enabled,{numbers(turn, place)},0.12,4"
        lines.append(f"{t:.4f},{600 + i},Port:1,0,{'Missing,,,,,,,,,' if i in HIDDEN else seen}")
    return "\n".join(lines)


def logger() -> str:
    """Loggers on NDI's Python library: the nine numbers of the rotation matrix by name."""
    names = "Tool ID,Timestamp,Frame #,Tx,Ty,Tz,R00,R01,R02,R10,R11,R12,R20,R21,R22,Tracking Quality"
    each = zip(POSES.time_s, POSES.position_mm, TURNED.as_matrix(), strict=True)
    return "\n".join([names, *(f"0,{t:.6f},{i},{numbers(p, turn)},0.97" for i, (t, p, turn) in enumerate(each))])


def polhemus(stations: Iterable[int]) -> str:
    """What a FASTRAK sends as text: station, x, y, z in cm, azimuth, elevation and roll in degrees."""
    angles = TURNED.as_euler("ZYX", degrees=True)
    return "\n".join(
        f"0{s} " + "".join(f"{value:9.4f}" for value in (*(place / 10 + 5 * (s - 1)), *turn))
        for place, turn in zip(POSES.position_mm, angles, strict=True)
        for s in stations
    )


def matrices() -> str:
    """A time and the 16 numbers of a homogeneous matrix, row by row."""
    full = np.tile(np.eye(4), (len(POSES.time_s), 1, 1))
    full[:, :3, :3], full[:, :3, 3] = TURNED.as_matrix(), POSES.position_mm
    return "\n".join(f"{t:.4f},{numbers(one)}" for t, one in zip(POSES.time_s, full, strict=True))


def plus(*, axes: str = "26 16 {n}") -> bytes:
    """PLUS: transforms, their status and a time of each frame in the header of an image of three axes, or of four."""
    n = len(TIME)
    at = np.searchsorted(POSES.time_s, TIME).clip(0, len(POSES.time_s) - 1)
    size = axes.format(n=n)
    head = ["ObjectType = Image", f"NDims = {len(size.split())}", "BinaryData = True", "BinaryDataByteOrderMSB = False"]
    head += ["CompressedData = False", "Offset = 0 0 0", f"DimSize = {size}", "ElementType = MET_FLOAT"]
    head += ["ElementByteOrderMSB = False", "UltrasoundImageOrientation = MF", "UltrasoundImageType = BRIGHTNESS"]
    for i in range(n):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = TURNED[at[i]].as_matrix(), POSES.position_mm[at[i]]
        for tool, matrix in (("Probe", pose), ("ImageToProbe", np.diag([0.3, 0.3, 0.3, 1.0]))):
            name = f"Seq_Frame{i:04d}_{tool if 'To' in tool else tool + 'ToReference'}Transform"
            head += [f"{name} = {numbers(matrix).replace(',', ' ')}", f"{name}Status = OK"]
        head += [f"Seq_Frame{i:04d}_FrameNumber = {i + 1}", f"Seq_Frame{i:04d}_UnfilteredTimestamp = {TIME[i]:.6f}"]
        head += [f"Seq_Frame{i:04d}_Timestamp = {TIME[i]:.6f}", f"Seq_Frame{i:04d}_ImageStatus = OK"]
    return "\n".join([*head, "ElementDataFile = LOCAL\n"]).encode() + KPA.astype("<f4").tobytes()


SEEN = tuple(i for i in range(len(POSES.time_s)) if i not in HIDDEN)
HUB = "https://github.com/"
TEKSCAN = HUB + "jiwooba/HSS-TAP (onfly_tekscan_2mat.m)"
NOVEL = HUB + "DrDanParker/Biomechanical-Pandas (BiomechPressure.py)"
PPS = HUB + "BOA-PFL/XSENSOR (PerformanceTest_TactileHead_Analysis.py)"
SINGLETACT = HUB + "SingleTact/NETInterface (GUI.cs)"
PLUS = HUB + "PlusToolkit/PlusLib (vtkPlusMetaImageSequenceIO.cxx)"
FASTRAK = ("--pose-layout", "euler", "--length-unit", "cm", "--pose-rate-hz", "120")
CLOCK = ("--pose-offset-s", "36900")
SINCE_1970 = ("--pose-offset-s", "-1778067471")
COUNTS = ("--array-calibration", "singletact.json")
EXPORTS: dict[str, Export] = {
    "Tekscan, ASCII": Export(
        TEKSCAN, tekscan(KPA / KPA_PER_UNIT["psi"], "PSI"), told="unit psi by line 24", suffix=".asf"
    ),
    "Tekscan, CSV": Export(TEKSCAN, tekscan(KPA, "KPA", padded=True), told="saturation 4000 by line 19"),
    "XSENSOR, a block a frame": Export(
        HUB + "nickkluft/XSensorPressureMat", xsensor_blocks(), CLOCK, "unit mmHg by line 4"
    ),
    "XSENSOR, a row a frame": Export(
        HUB + "BOA-PFL/XSENSOR (XSENSORFunctions.py)", xsensor_rows(), CLOCK, "unit psi by line 1"
    ),
    "PPS": Export(PPS, pps(), told="416 of 423 columns are readings, from column 8 on"),
    "novel": Export(NOVEL, novel(), told="unit kPa by line 4", suffix=".asc"),
    "SingleTact": Export(SINGLETACT, singletact(), COUNTS, "unit counts by line 1", within=0.11),
    "SingleTact, decimal commas": Export(SINGLETACT, singletact(";"), COUNTS, within=0.11),
    "NDI ToolBox": Export("NDI ToolBox, User Guide", toolbox(), SINCE_1970, poses=True, kept=SEEN),
    "NDI ToolBox, the second tool": Export(
        "NDI ToolBox, User Guide", toolbox(2), (*SINCE_1970, "--tool", "2"), poses=True, kept=SEEN
    ),
    "NDI Combined API": Export("NDI, Combined API sample (main.cpp)", combined_api(), poses=True, kept=SEEN),
    "NDI, a rotation matrix by names": Export("loggers on scikit-surgerynditracker", logger(), poses=True),
    "Polhemus": Export("Polhemus, FASTRAK User Manual, F and P", polhemus([1]), FASTRAK, poses=True),
    "Polhemus, two receivers": Export(
        "Polhemus, FASTRAK User Manual, F and P", polhemus([1, 2]), (*FASTRAK, "--tool", "1"), poses=True
    ),
    "PLUS": Export(PLUS, plus(), ("--unit", "kPa", "--tool", "Probe"), suffix=".igs.mha"),
    "PLUS, four axes": Export(PLUS, plus(axes="26 16 1 {n}"), ("--unit", "kPa", "--tool", "Probe"), suffix=".mha"),
    "matrices": Export("a time and 16 numbers", matrices(), poses=True),
}
"""Each sample by the program that writes such files."""
