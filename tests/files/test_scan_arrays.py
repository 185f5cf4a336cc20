"""Arrays as engineers hold them: every container, axis and unit gives the one scan, or a line that says why not."""

from __future__ import annotations

import json
import struct
import unicodedata
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse
from campaign_files import arrays_of
from in_process import run_here
from scipy.spatial.transform import Rotation

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.arrays_layout import ArrayMap
from tactile_bayes.files.documents import parse_toml
from tactile_bayes.files.imports import head_source, import_arrays, pose_source, read_arrays
from tactile_bayes.files.named_arrays import array_template, read_named
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.findings import finding_lines
from tactile_bayes.forward.scene import Scene
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.scans import Scan

Arrays = dict[str, Any]


@pytest.fixture(scope="module")
def scan() -> Scan:
    return simulate(Scene(duration_s=0.3), rng=np.random.default_rng(0)).scan


@pytest.fixture
def good(scan: Scan) -> Arrays:
    return deepcopy(arrays_of(scan))


@pytest.fixture
def pressed(good: Arrays) -> Arrays:
    """The same with pressures in place of counts, gain and offset."""
    kpa = good["counts"] * good["gain_kpa_per_count"] + good["offset_kpa"]
    rest = {name: one for name, one in good.items() if name not in ("counts", "gain_kpa_per_count", "offset_kpa")}
    return {"frames": kpa, **rest}


@pytest.fixture
def head(scan: Scan, tmp_path: Path) -> Path:
    path = tmp_path / "head.json"
    document = {
        "schema": "tactile-bayes/head/1",
        "pitch_mm": 1.5,
        "surface_mm": scan.head.surface_mm.tolist(),
        "scanhead_from_tracker": scan.head.scanhead_from_tracker.tolist(),
    }
    path.write_text(json.dumps(document))
    return path


def as_mat(path: Path, arrays: Arrays) -> None:
    """As MATLAB keeps them: all doubles, vectors with two axes."""
    doubles = {name: np.asarray(one, dtype=np.float64) for name, one in arrays.items()}
    scipy.io.savemat(path, doubles, do_compression=True, oned_as="column")


def as_struct(path: Path, arrays: Arrays) -> None:
    scipy.io.savemat(path, {"exam": {name: np.asarray(one, dtype=np.float64) for name, one in arrays.items()}})


def as_mat_73(path: Path, arrays: Arrays) -> None:
    """Version 7.3 is HDF5 behind a block of 512 bytes, in which MATLAB's axes run backwards.

    MathWorks, "MAT-File Versions"; HDF5 is written in C order and MATLAB's arrays are in Fortran's.
    """
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, one in arrays.items():
            file[name] = np.atleast_2d(np.asarray(one, dtype=np.float64)).T
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124))
        stream.write(b"\x00\x02IM")


def as_hdf5(path: Path, arrays: Arrays) -> None:
    with h5py.File(path, "w") as file:
        for name, one in arrays.items():
            file.create_dataset(name, data=one, **({"compression": "gzip"} if np.ndim(one) > 1 else {}))
        file["operator's note"] = "no array"


def as_npz(path: Path, arrays: Arrays) -> None:
    np.savez(path, **arrays)


CONTAINERS = {".npz": as_npz, ".mat": as_mat, ".v73.mat": as_mat_73, ".h5": as_hdf5}


@pytest.mark.parametrize("suffix", CONTAINERS)
def test_every_container_gives_the_same_scan(good: Arrays, scan: Scan, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"exam{suffix}"
    CONTAINERS[suffix](path, good)
    same(read_arrays(path), scan)


def test_the_day_of_a_check_is_that_of_the_head_that_stands(good: Arrays, scan: Scan, tmp_path: Path) -> None:
    as_npz(tmp_path / "exam.npz", good)
    checked = replace(scan.head, checked_on="2026-03-01")
    for last in (checked, scan.head):
        heads = [head_source(checked), head_source(last)]
        assert import_arrays(tmp_path / "exam.npz", ArrayMap(), heads)[0].head.checked_on == last.checked_on


def test_fields_of_a_structure_and_members_of_a_group_are_named(good: Arrays, scan: Scan, tmp_path: Path) -> None:
    as_struct(tmp_path / "exam.mat", good)
    with h5py.File(tmp_path / "exam.hdf5", "w") as file:
        for name, one in good.items():
            file[f"exam/{name}"] = one
    names = ArrayMap(arrays={name: f"exam.{name}" for name in good})
    for path in (tmp_path / "exam.mat", tmp_path / "exam.hdf5"):
        same(import_arrays(path, names)[0], scan)


def test_the_layouts_own_names_are_found_within_groups(pressed: Arrays, scan: Scan, head: Path, tmp_path: Path) -> None:
    poses = {name: pressed.pop(name) for name in ("position_mm", "quaternion_wxyz", "pose_time_s")}
    frames = {name: pressed.pop(name) for name in ("frames", "frame_time_s")}
    scipy.io.savemat(tmp_path / "exam.mat", {"exam": {"array": frames, "tracker": poses}})
    found = tb.scan(tmp_path / "exam.mat", head=head, unit="kPa")
    np.testing.assert_array_equal(found.poses.position_mm, scan.poses.position_mm)
    with h5py.File(tmp_path / "exam.h5", "w") as file:
        for name, one in {**frames, **poses}.items():
            file.create_dataset(name, data=one, chunks=True, compression="lzf")
    with pytest.raises(BadDataError, match=r"is packed by filters .*; pack it by gzip"):
        tb.scan(tmp_path / "exam.h5", head=head, unit="kPa")


def test_plain_words_are_taken_for_arrays_and_said(pressed: Arrays, scan: Scan, tmp_path: Path) -> None:
    """Times are told apart by the group that they stand in; two that fit are none."""
    words = {"frames": "Pressure", "frame_time_s": "time", "position_mm": "position", "quaternion_wxyz": "quat"}
    rest = {name: one for name, one in pressed.items() if name not in words}
    as_mat_73(tmp_path / "a.mat", {**{word: pressed[name] for name, word in words.items()}, **rest})
    found, notes = import_arrays(tmp_path / "a.mat", ArrayMap(unit="kPa"))
    np.testing.assert_array_equal(found.frames.time_s, scan.frames.time_s)
    assert "Pressure is taken for counts" in notes
    assert "time is taken for frame_time_s" in notes
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for name in ("frames", "frame_time_s"):
            file[f"mat/{'pressure' if name == 'frames' else 'time'}"] = pressed[name]
        for name, word in {"position_mm": "pos", "quaternion_wxyz": "quat", "pose_time_s": "time"}.items():
            file[f"tracker/{word}"] = pressed[name]
        for name in ("pitch_mm", "array_from_tracker", "head_surface_mm"):
            file[name] = pressed[name]
    found, notes = import_arrays(tmp_path / "b.h5", ArrayMap(unit="kPa"))
    np.testing.assert_array_equal(found.poses.time_s, scan.poses.time_s)
    np.testing.assert_array_equal(found.frames.time_s, scan.frames.time_s)
    with h5py.File(tmp_path / "b.h5", "a") as file:
        file["mat/readings"] = pressed["frames"]
    with pytest.raises(BadDataError, match="lacks counts"):
        import_arrays(tmp_path / "b.h5", ArrayMap(unit="kPa"))


def test_npy_holds_the_frames_alone_or_named_fields(pressed: Arrays, scan: Scan, head: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "frames.npy", pressed["frames"])
    poses = (pressed["pose_time_s"], pressed["position_mm"], pressed["quaternion_wxyz"])
    found = tb.scan(tmp_path / "frames.npy", None, poses, head=head, unit="kPa", rate_hz=200.0)
    np.testing.assert_allclose(found.frames.time_s, np.arange(len(found.frames)) / 200.0)
    named = np.array(list(zip(pressed["frames"], pressed["frame_time_s"], strict=True)), dtype=fields_of(pressed))
    np.save(tmp_path / "named.npy", named)
    found = tb.scan(tmp_path / "named.npy", None, poses, head=head, unit="kPa")
    np.testing.assert_array_equal(found.frames.time_s, scan.frames.time_s)


def fields_of(pressed: Arrays) -> list[Any]:
    return [("frames", "f8", pressed["frames"].shape[1:]), ("frame_time_s", "f8")]


def same(found: Scan, scan: Scan) -> None:
    np.testing.assert_array_equal(found.frames.counts, scan.frames.counts)
    np.testing.assert_array_equal(found.frames.time_s, scan.frames.time_s)
    np.testing.assert_allclose(found.poses.position_mm, scan.poses.position_mm, atol=1e-9)
    np.testing.assert_array_equal(found.head.surface_mm, scan.head.surface_mm)
    np.testing.assert_array_equal(
        found.element_calibration.gain_kpa_per_count, scan.element_calibration.gain_kpa_per_count
    )


# kPa in one of each: BIPM, The International System of Units, 9th ed., and NIST SP 811 appendix B.
IN_KPA = {"kPa": 1.0, "Pa": 1e-3, "psi": 6.894757, "mmHg": 101.325 / 760, "N/cm2": 10.0}


@pytest.mark.parametrize("unit", IN_KPA)
def test_pressures_in_every_unit_are_the_same_scan(pressed: Arrays, tmp_path: Path, unit: str) -> None:
    kpa = pressed["frames"]
    as_npz(tmp_path / "exam.npz", pressed | {"frames": kpa / IN_KPA[unit]})
    found, notes = import_arrays(tmp_path / "exam.npz", ArrayMap(unit=unit))  # type: ignore[arg-type]
    np.testing.assert_allclose(found.element_calibration.to_kpa(found.frames.counts), kpa, atol=6e-4)
    assert found.session["frames_unit"] == unit
    assert any(f"frames in {unit}, kept to 1 Pa" in note for note in notes)
    assert not any(note.startswith("CAUTION") for note in notes)


def test_whole_pressures_keep_their_numbers_and_the_unit_is_the_gain(pressed: Arrays) -> None:
    mmhg = np.rint(np.clip(pressed["frames"], 0, None) / IN_KPA["mmHg"]).astype(np.uint16)
    found = scan_of(pressed | {"frames": mmhg}, unit="mmHg")
    np.testing.assert_array_equal(found.frames.counts, mmhg)
    assert found.element_calibration.gain_kpa_per_count[0, 0] == pytest.approx(IN_KPA["mmHg"], rel=1e-6)


def test_pressures_below_zero_are_kept_and_a_saturation_is_in_the_unit(pressed: Arrays) -> None:
    frames = pressed["frames"] - 3.0
    found = scan_of(pressed | {"frames": frames}, unit="kPa", saturation=12.0)
    kpa = found.element_calibration.to_kpa(found.frames.counts)
    np.testing.assert_array_equal(np.isnan(kpa), frames > 11.9995)
    np.testing.assert_allclose(kpa[~np.isnan(kpa)], frames[~np.isnan(kpa)], atol=6e-4)


def test_a_number_far_below_zero_is_refused_where_it_would_cut_off_the_readings(pressed: Arrays) -> None:
    """It would be the least of 65,536 steps of 1 Pa, and every taxel that works would lie above the greatest."""
    frames = pressed["frames"].copy()
    frames[:, 3, 4] = -999.0
    with pytest.raises(BadDataError, match=r"hold -999 \(first at \(0, 3, 4\)\), and an array reads no such pressure"):
        scan_of(pressed | {"frames": frames}, unit="kPa")
    with pytest.raises(BadDataError, match="are these Pa"):
        scan_of(pressed | {"frames": 1000 * pressed["frames"] - 3000}, unit="kPa")


def test_pressures_below_zero_throughout_are_refused(pressed: Arrays) -> None:
    with pytest.raises(BadDataError, match="below 0 throughout; give pressures that rise"):
        scan_of(pressed | {"frames": -pressed["frames"] - 1.0}, unit="kPa")


def scan_of(arrays: Arrays, **stated: Any) -> Scan:
    poses = (arrays["pose_time_s"], arrays["position_mm"], arrays["quaternion_wxyz"])
    head = {
        "pitch_mm": arrays["pitch_mm"],
        "surface_mm": arrays["head_surface_mm"],
        "scanhead_from_tracker": arrays["array_from_tracker"],
    }
    return tb.scan(arrays["frames"], arrays["frame_time_s"], poses, head=head, **stated)


def test_pressures_that_are_too_small_are_asked_about_by_import_and_map(pressed: Arrays) -> None:
    with pytest.warns(UserWarning, match=r"CAUTION: frames in kPa.*right --unit \(are these psi\?\)"):
        found = scan_of(pressed | {"frames": pressed["frames"] / IN_KPA["psi"]}, unit="kPa")
    with pytest.raises(BadDataError, match=r"median .*: are these psi.*right unit"):
        tb.build_map(found)


@pytest.mark.parametrize(("true", "stated"), [("kPa", "psi"), ("mmHg", "kPa"), ("Pa", "mmHg"), ("Pa", "kPa")])
def test_pressures_beyond_every_array_are_refused_with_the_question(pressed: Arrays, true: str, stated: str) -> None:
    with pytest.raises(BadDataError, match=rf"frames in {stated}: .* ends at 34 kPa; are these {true}"):
        scan_of(pressed | {"frames": pressed["frames"] / IN_KPA[true]}, unit=stated)


def test_axes_of_frames_and_poses_are_found_by_the_times(pressed: Arrays, scan: Scan, tmp_path: Path) -> None:
    turned = pressed | {
        "frames": np.moveaxis(pressed["frames"], 0, -1),
        "position_mm": pressed["position_mm"].T,
        "quaternion_wxyz": pressed["quaternion_wxyz"].T,
        "frame_time_s": pressed["frame_time_s"][None] * 1000,
    }
    as_mat(tmp_path / "exam.mat", turned)
    found, notes = import_arrays(tmp_path / "exam.mat", ArrayMap(unit="kPa", time_unit="ms", pose_time_unit="s"))
    np.testing.assert_allclose(found.frames.time_s, scan.frames.time_s)
    np.testing.assert_array_equal(found.poses.position_mm, scan.poses.position_mm)
    kpa = found.element_calibration.to_kpa(found.frames.counts)
    np.testing.assert_allclose(kpa, pressed["frames"], atol=6e-4)
    assert "read along the last axis" in " ".join(notes)


def test_frames_of_one_row_are_folded_and_it_is_said(pressed: Arrays) -> None:
    kpa = pressed["frames"]
    by_rows = scan_of(pressed | {"frames": kpa.reshape(len(kpa), -1)}, unit="kPa")
    by_columns = scan_of(
        pressed | {"frames": kpa.swapaxes(1, 2).reshape(len(kpa), -1)}, unit="kPa", frame_order="columns"
    )
    for found in (by_rows, by_columns):
        np.testing.assert_allclose(found.element_calibration.to_kpa(found.frames.counts), kpa, atol=6e-4)
    assert "each 416 numbers read as 16 x 26, along the array's rows" in by_rows.session["imported_as"]
    with pytest.raises(BadDataError, match=r"frames of 400 numbers .*16 x 26 taxels are 416"):
        scan_of(pressed | {"frames": kpa.reshape(len(kpa), -1)[:, :400]}, unit="kPa")


def test_matrices_euler_angles_and_scalar_last_are_the_same_poses(pressed: Arrays, scan: Scan) -> None:
    turned = Rotation.from_quat(pressed["quaternion_wxyz"], scalar_first=True)
    matrices = np.tile(np.eye(4), (len(turned), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turned.as_matrix(), pressed["position_mm"]
    time, place = pressed["pose_time_s"], pressed["position_mm"]
    head = scan.head
    frames, frame_time = pressed["frames"], pressed["frame_time_s"]
    given: list[tuple[Any, Arrays]] = [
        ((time, matrices), {}),
        ((time, matrices[:, :3].reshape(len(time), 12)), {}),
        ((time, np.moveaxis(matrices, 0, -1)), {}),
        ((time, place, turned.as_quat()), {"pose_layout": "xyzw"}),
        ((time, place / 25.4, turned.as_euler("ZYX", degrees=True)), {"pose_layout": "euler", "length_unit": "inch"}),
        (np.column_stack([time, place, pressed["quaternion_wxyz"]]), {}),
    ]
    for poses, stated in given:
        found = tb.scan(frames, frame_time, poses, head=head, unit="kPa", **stated).poses
        np.testing.assert_allclose(found.position_mm, place, atol=1e-9)
        apart = turned.inv() * Rotation.from_quat(found.quaternion_wxyz, scalar_first=True)
        assert apart.magnitude().max() < 1e-6
    with pytest.raises(BadDataError, match=r"pose_matrix is not rigid at index 0 \(its last row is not 0 0 0 1\)"):
        tb.scan(frames, frame_time, (time, matrices.swapaxes(1, 2)), head=head, unit="kPa")


def test_azimuth_elevation_and_roll_turn_about_z_y_and_x() -> None:
    """Polhemus, FASTRAK 3SPACE User's Manual, appendix on Euler angles: azimuth of 90 degrees takes x to y."""
    from tactile_bayes.files.imports import quaternions

    angles = np.array([[90.0, 0, 0], [0, 90.0, 0], [0, 0, 90.0], [90.0, 90.0, 0]])
    turned = Rotation.from_quat(quaternions(angles, "euler"), scalar_first=True).as_matrix()
    np.testing.assert_allclose(turned[0] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned[1] @ [1, 0, 0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(turned[2] @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turned[3] @ [1, 0, 0], [0, 0, -1], atol=1e-12)  # azimuth outermost


def nan(name: str) -> Callable[[Arrays], None]:
    return lambda a: a[name].__setitem__((3, 4), np.nan)


def meander(frames: np.ndarray, lump: float = 2.0) -> np.ndarray:
    """The frames, over a lump, with every second row backwards."""
    y, moved = np.arange(26), np.arange(len(frames))[:, None, None] / 3
    frames = frames + lump * np.exp(-((y - 4 - moved) ** 2) / 8)
    frames[:, 1::2] = frames[:, 1::2, ::-1]
    return frames


def turns_alone(a: Arrays) -> None:
    """Rotations without their positions, in place of the poses."""
    del a["position_mm"]
    a["pose_matrix"] = np.tile(np.eye(3), (len(a.pop("quaternion_wxyz")), 1, 1))


def first_frame_alone(a: Arrays) -> None:
    a.update(frames=a["frames"][:1], frame_time_s=a["frame_time_s"][:1])


FAULTS: list[tuple[str, Callable[[Arrays], Any], dict[str, Any], str]] = [
    ("NaN", nan("frames"), {"unit": "kPa"}, r"frames holds 26 values that are not finite \(first at \(3, 4, 0\)\)"),
    ("one count", lambda a: a.update(frames=3.0), {"unit": "kPa"}, "frames is a single number; give an array"),
    ("two pitches", lambda a: a.update(pitch_mm=[1.5, 1.5]), {"unit": "kPa"}, "pitch_mm has shape.* be one number"),
    ("no unit", dict.copy, {}, "lacks gain_kpa_per_count .*--unit or --array-calibration"),
    ("gain and unit", lambda a: a.update(offset_kpa=0.0), {"unit": "kPa"}, "offset_kpa is for counts.*in kPa"),
    ("no head", lambda a: a.pop("head_surface_mm"), {"unit": "kPa"}, "lacks head_surface_mm.*--head-geometry HEAD"),
    ("no times", lambda a: a.pop("frame_time_s"), {"unit": "kPa"}, r"lacks frame_time_s \(n\).*--rate-hz"),
    ("ms", lambda a: a.update(frame_time_s=a["frame_time_s"] * 1000), {"unit": "kPa"}, "milliseconds.*--time-unit ms"),
    ("us", lambda a: a.update(pose_time_s=a["pose_time_s"] * 1e6), {"unit": "kPa"}, "microsec.*--pose-time-unit us"),
    ("ns", lambda a: a.update(frame_time_s=1e18 + a["frame_time_s"] * 1e9), {"unit": "kPa"}, "nano.*--time-unit ns"),
    ("still us", lambda a: a.update(frame_time_s=a["frame_time_s"] * 1e6), {"time_unit": "ms"}, "--time-unit us"),
    ("clocks", lambda a: a.update(pose_time_s=a["pose_time_s"] + 1e6), {"unit": "kPa"}, "overlap.*--pose-offset-s"),
    ("times of the day", lambda a: a.update(frame_time_s=a["frame_time_s"].astype("M8[s]")), {}, "give s on one"),
    ("one frame", first_frame_alone, {"unit": "kPa"}, "holds one frame; join a scan's frames"),
    ("angles", lambda a: a.update(quaternion_wxyz=a["position_mm"]), {"unit": "kPa"}, "--pose-layout euler for de"),
    ("shape", dict.copy, {"unit": "kPa", "frame_shape": (26, 16)}, "16 x 26 taxels, not 26 x 16"),
    ("unknown", dict.copy, {"unit": "kPa", "arrays": {"count": "frames"}}, "'count' is no array.*mean counts"),
    ("not there", dict.copy, {"unit": "kPa", "arrays": {"counts": "P"}}, "has no array 'P' for counts; it has "),
    ("both poses", lambda a: a.update(pose_matrix=np.eye(4)), {"unit": "kPa"}, "beside position_mm.*leave one out"),
    ("turns alone", turns_alone, {"unit": "kPa"}, r"pose_matrix has shape \(\d+, 3, 3\); it must be \(m, 4, 4\)"),
    ("meander", lambda a: a.update(frames=meander(a["frames"])), {"unit": "kPa"}, "less if every second row runs back"),
    ("lever in m", lambda a: a["array_from_tracker"].__setitem__((slice(3), 3), 0.03), {"unit": "kPa"}, "like metres"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "spoil", "stated", "words"), FAULTS, ids=[row[0] for row in FAULTS])
def test_what_is_missing_or_wrong_is_one_line_with_its_way_out(
    pressed: Arrays, tmp_path: Path, fault: str, spoil: Callable[[Arrays], Any], stated: dict[str, Any], words: str
) -> None:
    del fault
    spoil(pressed)
    path = tmp_path / "exam.npz"
    as_npz(path, pressed)
    with pytest.raises(BadDataError, match=words) as caught:
        import_arrays(path, ArrayMap(**stated))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_an_order_that_is_stated_is_taken_with_a_caution(pressed: Arrays, tmp_path: Path) -> None:
    as_npz(tmp_path / "exam.npz", pressed | {"frames": meander(pressed["frames"])})
    scan, notes = import_arrays(tmp_path / "exam.npz", ArrayMap(unit="kPa", frame_order="rows"))
    assert not any("neighbours" in note for note in notes)
    (line,) = finding_lines(scan.findings)  # which maps and sizes tell, too
    assert line.startswith("CAUTION: frames have neighbours that differ by ")


def test_objects_of_every_container_are_refused_and_never_unpickled(tmp_path: Path) -> None:
    cells = np.array([[1.0, "x"]], dtype=object)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = "text"
    scipy.io.savemat(tmp_path / "a.mat", {"frames": cells})
    np.savez(tmp_path / "a.npz", frames=cells)
    np.save(tmp_path / "a.npy", cells, allow_pickle=True)
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(BadDataError, match=r"never unpickled|not an array of numbers"):
            import_arrays(path, ArrayMap(unit="kPa"))


@pytest.mark.long
def test_a_mat_that_unpacks_to_more_than_its_limit_is_not_unpacked(tmp_path: Path) -> None:
    """A variable that says it has 4 GB of zeros; MAT-File Format, "Level 5": type 15 is a compressed element."""
    packed = zlib.compress(bytes(2**28), 9)
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    (tmp_path / "bomb.mat").write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(BadDataError, match=r"its arrays unpack to 64,000,001 bytes or more, over the limit"):
        read_arrays(tmp_path / "bomb.mat")


@pytest.mark.parametrize("packed", [False, True])
def test_a_mat_is_read_as_scipy_reads_it(tmp_path: Path, packed: bool) -> None:
    rng = np.random.default_rng(3)
    kinds = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
    held: Arrays = {f"a_{kind}": rng.integers(0, 99, (2, 3, 4)).astype(kind) for kind in kinds}
    held |= {"whole": np.arange(7.0), "flag": np.array([True, False]), "one": 2.5, "none": np.zeros((0, 3))}
    inner = {"x": np.eye(3), "deeper": {"y": [1, 2]}, "text": "word"}
    odd = {
        "words": "some text",
        "cell": np.array([1, "a"], dtype=object),
        "z": 1j * np.eye(2),
        "s": scipy.sparse.eye(3),
    }
    scipy.io.savemat(tmp_path / "a.mat", {**held, "exam": inner, **odd}, do_compression=packed)
    found = read_named(tmp_path / "a.mat", list)
    by_scipy = scipy.io.loadmat(tmp_path / "a.mat", spmatrix=False)
    for name in held:
        np.testing.assert_array_equal(found[name], by_scipy[name])
    np.testing.assert_array_equal(found["exam.x"], np.eye(3))
    np.testing.assert_array_equal(found["exam.deeper.y"], [[1, 2]])
    assert {name for name, one in found.items() if one.dtype == object} == {"exam.text", *odd}


def test_a_mat_of_the_other_byte_order_is_read(tmp_path: Path) -> None:
    """As a workstation wrote it: the header ends in MI."""
    flags = struct.pack(">IIII", 6, 8, 6, 0)
    shape, name = struct.pack(">IIii", 5, 8, 2, 2), struct.pack(">II8s", 1, 1, b"a")
    values = struct.pack(">II4d", 9, 32, 1, 2, 3, 4)
    matrix = flags + shape + name + values
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI"
    (tmp_path / "a.mat").write_bytes(head + struct.pack(">II", 14, len(matrix)) + matrix)
    np.testing.assert_array_equal(read_named(tmp_path / "a.mat", list)["a"], [[1, 3], [2, 4]])


@pytest.mark.parametrize("suffix", [".mat", ".v73.mat", ".h5", ".npy"])
def test_damaged_files_end_in_one_line(good: Arrays, tmp_path: Path, suffix: str) -> None:
    whole = tmp_path / f"whole{suffix}"
    if suffix == ".npy":
        np.save(whole, good["counts"])
    else:
        CONTAINERS[suffix](whole, good)
    data, path = whole.read_bytes(), tmp_path / f"bad{suffix}"
    rng = np.random.default_rng(1)
    for share in (0.001, 0.01, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(BadDataError):
            read_arrays(path)
    for _ in range(40):
        changed = bytearray(data)
        for place in rng.integers(0, min(4096, len(data)), 3):
            changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            read_arrays(path)
        except BadDataError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_other_files_are_named_for_what_they_are(tmp_path: Path) -> None:
    (tmp_path / "old.mat").write_bytes(b"\x00" * 600)
    with pytest.raises(BadDataError, match=r"is not a \.mat of version 5 to 7\.3; save it with save\(\.\.\., '-v7'\)"):
        read_arrays(tmp_path / "old.mat")
    (tmp_path / "x.h5").write_bytes(b"hello")
    with pytest.raises(BadDataError, match=r"is not an \.npz, \.npy, \.mat or HDF5 file"):
        read_arrays(tmp_path / "x.h5")
    with zipfile.ZipFile(tmp_path / "sheet.xlsx", "w") as sheet:
        sheet.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(BadDataError, match=r"zip archive without arrays \(it has xl/workbook.xml\); save the sheet"):
        read_arrays(tmp_path / "sheet.xlsx")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("poses.npy", r"is an array of numpy \(\.npy\), and poses that stand apart are a table"),
        ("poses.npz", r"is an archive .*; save them as \.csv, or in the frames' file as pose_matrix"),
        ("npy.csv", r"is an array of numpy \(\.npy\), and poses"),
    ],
)
def test_poses_apart_in_arrays_are_named_for_what_they_are(
    pressed: Arrays, tmp_path: Path, name: str, words: str
) -> None:
    with (tmp_path / name).open("wb") as file:
        (np.savez if name.endswith("z") else np.save)(file, pressed["position_mm"])
    with pytest.raises(BadDataError, match=words):
        pose_source(tmp_path / name, ArrayMap())


def test_what_is_called_otherwise_is_listed_beside_what_is_missing(pressed: Arrays, scan: Scan, tmp_path: Path) -> None:
    """As `frames`, `t`, `T` (matrices) and `t_pose` of a notebook are."""
    pressed["t"], pressed["t_pose"] = pressed.pop("frame_time_s"), pressed.pop("pose_time_s")
    pressed["T"] = np.tile(np.eye(4), (len(pressed.pop("quaternion_wxyz")), 1, 1))
    del pressed["position_mm"]
    as_npz(tmp_path / "exam.npz", pressed)
    with pytest.raises(BadDataError, match=r"lacks position_mm .* not known: T, t_pose; .*--template"):
        import_arrays(tmp_path / "exam.npz", ArrayMap(unit="kPa"))
    as_npz(tmp_path / "other.npz", {"P": pressed["frames"]})
    with pytest.raises(BadDataError, match=r"pose_time_s \(m\); not known: P"):  # the head and the unit are there
        import_arrays(tmp_path / "other.npz", ArrayMap(unit="kPa"), [head_source(scan.head)])
    found = parse_toml(array_template(tmp_path / "exam.npz"), way_out="")["arrays"]
    assert found == {"frame_time_s": "t", "pose_time_s": "t_pose", "pose_matrix": "T"}


def test_the_template_names_what_shapes_tell_and_is_read_back(pressed: Arrays, tmp_path: Path) -> None:
    names = {"frames": "P", "frame_time_s": "t", "position_mm": "xyz", "quaternion_wxyz": "q", "pose_time_s": "tt"}
    renamed = {names.get(name, name): one for name, one in pressed.items()}
    as_mat(tmp_path / "exam.mat", renamed)
    text = array_template(tmp_path / "exam.mat")
    assert parse_toml(text, way_out="")["arrays"] == {
        "counts": "P",
        "frame_time_s": "t",
        "position_mm": "xyz",
        "quaternion_wxyz": "q",
        "pose_time_s": "tt",
    }
    assert f"#   P: {len(pressed['frames'])} x 16 x 26" in text
    assert "pitch_mm: found under this name" in text
    (tmp_path / "map.toml").write_text(text.replace('# unit = "kPa"', 'unit = "kPa"'))
    done = run_here("import", "exam.mat", "--columns", "map.toml", "-o", "exam.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "frames in kPa" in done.stdout
    assert len(read_scan(tmp_path / "exam.mcap").frames) == len(pressed["frames"])
    empty = run_here("import", "--template", cwd=tmp_path)
    assert parse_toml(empty.stdout, way_out="") == {"arrays": {}, "values": {}}


def test_the_template_of_single_numbers_names_them_too(tmp_path: Path) -> None:
    """Of frames that are one number the template took an axis that they do not have."""
    np.savez(tmp_path / "exam.npz", counts=5, position_mm=1.0, t=np.arange(3.0))
    assert "# counts: found under this name" in array_template(tmp_path / "exam.npz")


def test_a_name_is_found_however_its_letters_are_spelled(pressed: Arrays, tmp_path: Path) -> None:
    """A Mac may write an umlaut as two signs, and a TOML's editor as one."""
    pressed[unicodedata.normalize("NFD", "Größe")] = pressed.pop("frames")
    as_npz(tmp_path / "exam.npz", pressed)
    found, _ = import_arrays(tmp_path / "exam.npz", ArrayMap(arrays={"counts": "Größe"}, unit="kPa"))
    assert len(found.frames) == len(pressed["frame_time_s"])


def test_values_of_the_map_stand_for_arrays_that_no_file_has(pressed: Arrays, tmp_path: Path) -> None:
    pitch = pressed.pop("pitch_mm")
    as_npz(tmp_path / "exam.npz", pressed)
    (tmp_path / "map.toml").write_text(f'unit = "kPa"\n[values]\npitch_mm = {pitch}\n')
    done = run_here("import", "exam.npz", "--columns", "map.toml", "-o", "exam.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (tmp_path / "map.toml").write_text('units = "kPa"\n')
    done = run_here("import", "exam.npz", "--columns", "map.toml", "-o", "b.mcap", cwd=tmp_path)
    assert done.returncode == 3
    assert "map.toml: units is not known; did you mean unit?" in done.stderr


def test_many_files_fail_one_by_one(pressed: Arrays, head: Path, tmp_path: Path) -> None:
    """The head stands beside them once; the code is that of the first that failed."""
    for name in ("head_surface_mm", "pitch_mm", "array_from_tracker"):
        del pressed[name]
    as_mat(tmp_path / "a.mat", pressed)
    as_npz(tmp_path / "b.npz", pressed | {"frames": pressed["frames"][:, :8]})
    as_hdf5(tmp_path / "c.h5", pressed)
    files = ("a.mat", "b.npz", "c.h5")
    done = run_here("import", *files, "-o", "scans", "--unit", "kPa", "--head-geometry", head, cwd=tmp_path)
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1
    assert "b.npz: " in done.stderr
    assert sorted(path.name for path in (tmp_path / "scans").iterdir()) == ["a.mcap", "c.mcap"]
    assert "a.mcap: scan" in done.stdout
    again = run_here("import", *files, "-o", "scans", "--unit", "kPa", "--head-geometry", head, cwd=tmp_path)
    assert again.returncode == 2
    assert again.stderr.count("\n") == 3
    single = run_here("import", *files, "-o", "all.mcap", cwd=tmp_path)
    assert single.returncode == 2
    assert "3 files go into a folder, and all.mcap names a file" in single.stderr
    nothing = run_here("import", "b.npz", "none.mat", "-o", "more", "--unit", "kPa", cwd=tmp_path)
    assert nothing.returncode == 3
    mended = run_here("import", "scans/a.mcap", "-o", "b.mcap", "--unit", "kPa", cwd=tmp_path)
    assert mended.returncode == 2
    assert "--unit: for arrays and tables; scans/a.mcap is a scan already" in mended.stderr
    assert sorted(path.name for path in tmp_path.glob("*") if path.is_dir()) == ["scans"]
    one = run_here("import", "c.h5", "-o", "one/", "--unit", "kPa", "--head-geometry", head, cwd=tmp_path)
    assert one.stdout.startswith("one/c.mcap: scan\n")
    in_metres = json.loads(head.read_text())
    for row in in_metres["scanhead_from_tracker"][:3]:
        row[3] /= 1000
    (tmp_path / "metres.json").write_text(json.dumps(in_metres))
    wrong = run_here("import", "c.h5", "-o", "w.mcap", "--unit", "kPa", "--head-geometry", "metres.json", cwd=tmp_path)
    assert wrong.stderr.startswith("error: metres.json: the lever arm puts the tracker's sensor 0.0")
    (tmp_path / "a.npz").write_bytes(b"")
    clash = run_here("import", "a.mat", "a.npz", "-o", "more", cwd=tmp_path)
    assert clash.returncode == 2
    assert not (tmp_path / "more").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("a.npz",), "Missing option -o"),
        ((), "Missing argument SRC"),
        (("a.npz", "-o", "a.nc", "--unit", "kPa"), "--unit: for scans only"),
        (("a.npz", "-o", "a.mcap", "--unit", "bar"), "'bar' is not one of"),
    ],
)
def test_a_call_that_cannot_be_is_a_usage_error(tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    np.savez(tmp_path / "a.npz", mean=np.ones((2, 2)))
    done = run_here("import", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert told in done.stderr


def test_python_takes_records_of_another_scan_and_says_what_it_cannot_take(scan: Scan) -> None:
    counts, time = scan.frames.counts, scan.frames.time_s
    found = tb.scan(counts, time, scan.poses, head=scan, calibration=scan, landmarks=scan.landmarks)
    same(found, scan)
    assert found.landmarks is not None
    with pytest.raises(UsageError, match=r"poses is int of shape \(\)"):
        tb.scan(counts, time, 3, head=scan)
    with pytest.raises(TypeError, match="no keyword 'units'; did you mean unit"):
        tb.scan(counts, time, scan.poses, head=scan, units="kPa")
    with pytest.raises(BadDataError, match="head: pitch is not known; did you mean pitch_mm"):
        tb.scan(counts, time, scan.poses, head={"pitch": 1.5})


def test_python_takes_lists_frames_dates_and_half_floats_and_no_masked_reading(pressed: Arrays, scan: Scan) -> None:
    kpa, time, head = pressed["frames"], scan.frames.time_s, scan.head
    table = pd.DataFrame(np.column_stack([pressed[name] for name in ("pose_time_s", "position_mm", "quaternion_wxyz")]))
    same_as = tb.scan(kpa, time, scan.poses, head=head, unit="kPa").frames.counts
    for frames in (kpa.tolist(), np.ma.masked_invalid(kpa)):
        found = tb.scan(frames, pd.Series(time), table, head=head, unit="kPa")
        np.testing.assert_array_equal(found.frames.counts, same_as)
    half = tb.scan(kpa.astype(np.float16), time, scan.poses, head=head, unit="kPa")
    np.testing.assert_allclose(half.frames.counts, same_as, atol=10)
    start = np.datetime64("2026-11-26T10:00:00", "ns")
    dated = start + (1e9 * time).astype("m8[ns]")
    poses = (start + (1e9 * scan.poses.time_s).astype("m8[ns]"), scan.poses.position_mm, scan.poses.quaternion_wxyz)
    found = tb.scan(kpa, dated, poses, head=head, unit="kPa")
    np.testing.assert_allclose(np.diff(found.frames.time_s), np.diff(time), atol=1e-6)
    masked = np.ma.masked_greater(kpa, 9.9)
    with pytest.raises(BadDataError, match=r"frames holds .* values that are not finite"):
        tb.scan(masked, time, scan.poses, head=head, unit="kPa")
    with pytest.raises(BadDataError, match="frames have 26 x 16 taxels, and the head 16 x 26; swap their"):
        tb.scan(kpa.swapaxes(1, 2), time, scan.poses, head=head, unit="kPa")


def test_a_table_of_poses_with_names_is_read_as_the_same_table_in_a_file(pressed: Arrays, scan: Scan) -> None:
    kpa, time, poses = pressed["frames"], scan.frames.time_s, scan.poses
    right = {"time_ms": 1000 * poses.time_s}
    right |= {f"{axis}_cm": 0.1 * poses.position_mm[:, i] for i, axis in enumerate("xyz")}
    right |= {f"q{axis}": poses.quaternion_wxyz[:, i] for i, axis in enumerate("wxyz")}
    for names in (list(right), [*list(right)[:4], "qx", "qy", "qz", "qw"]):
        found = tb.scan(kpa, time, pd.DataFrame(right)[names], head=scan.head, unit="kPa").poses
        np.testing.assert_allclose(found.position_mm, poses.position_mm, atol=1e-9)
        np.testing.assert_allclose(found.quaternion_wxyz, poses.quaternion_wxyz, atol=1e-12)
        np.testing.assert_allclose(found.time_s, poses.time_s, atol=1e-9)
    with pytest.raises(BadDataError, match=r"poses \(DataFrame\): line 1 names no qz; name columns"):
        tb.scan(kpa, time, pd.DataFrame(right).drop(columns="qz"), head=scan.head, unit="kPa")


def test_a_scene_needs_no_file() -> None:
    made = tb.simulate({"scene": {"duration_s": 0.2}, "lump": [{"amplitude": np.float64(0.3)}]})
    assert len(made.scan.frames) == 40
    with pytest.raises(BadDataError, match=r"scene\.duration is not known; did you mean"):
        tb.simulate({"scene": {"duration": 0.2}})
