"""NRRD of a map: SimpleITK, which reads it as 3D Slicer does, finds every cell at its place in the patient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_files import exported, scan_map, turned

from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance

nrrd = pytest.importorskip("nrrd")
sitk = pytest.importorskip("SimpleITK")


def image_of(folder: Path, name: str, output: Path) -> Any:
    exported(folder, f"{name}.nc", "--to", "nrrd", "-o", output)
    return sitk.ReadImage(str(output))


def test_axes_and_origin_worked_by_hand(tmp_path: Path) -> None:
    """The plane's x runs to the patient's right, y to the head, z into the body; its middle is at (60, 90, 20) mm.

    The first cell is at (-25, -25) in the plane, so at 35 mm to the right, 65 mm up and 20 mm deep: L -35, P 20, S 65.
    """
    transform = np.eye(4)
    transform[:3, 3] = (60.0, 90.0, 20.0)
    write_map(tmp_path / "m.nc", scan_map(patient_from_plane=transform), provenance=Provenance("test", {}))
    image = image_of(tmp_path, "m", tmp_path / "m.nrrd")
    assert image.GetSize() == (51, 51, 1)
    assert image.GetSpacing() == pytest.approx((1.0, 1.0, 1.0))
    assert image.GetOrigin() == pytest.approx((-35.0, 20.0, 65.0))
    assert np.array(image.GetDirection()).reshape(3, 3) == pytest.approx(np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]))


def test_the_lumps_centre_is_where_the_estimate_has_it_in_the_patient(
    exam: Path, estimate: Any, tmp_path: Path
) -> None:
    one = read_map(exam / "map.nc")
    image = image_of(exam, "map", tmp_path / "map.nrrd")
    x, y = (estimate["centre_mm"][axis]["median"] for axis in "xy")
    index = ((x - one.x_mm[0]) / one.recipe.cell_mm, (y - one.y_mm[0]) / one.recipe.cell_mm, 0.0)
    left, _, superior = image.TransformContinuousIndexToPhysicalPoint(index)
    patient = estimate["centre_patient_mm"]
    assert left == pytest.approx(-patient["x"]["median"], abs=0.02)  # medians of two turns of the draws
    assert superior == pytest.approx(patient["y"]["median"], abs=0.02)


def test_every_value_is_kept_and_gaps_stay_gaps(exam: Path, tmp_path: Path) -> None:
    one = read_map(exam / "map.nc")
    values = sitk.GetArrayFromImage(image_of(exam, "map", tmp_path / "map.nrrd"))
    assert values.dtype == np.float32
    wanted = np.where(one.covered, one.mean, np.nan).astype(np.float32)
    assert np.array_equal(values[0], wanted, equal_nan=True)
    assert np.isnan(values).sum() == 12
    again, header = nrrd.read(str(tmp_path / "map.nrrd"))
    assert np.array_equal(again[:, :, 0].T, wanted, equal_nan=True)
    assert header["space"] == "left-posterior-superior"


def test_the_axes_are_right_handed_for_every_turn(tmp_path: Path) -> None:
    for degrees in (0.0, 90.0, 200.0, 305.0):
        name = f"m{degrees:.0f}"
        one = scan_map(patient_from_plane=turned(degrees))
        write_map(tmp_path / f"{name}.nc", one, provenance=Provenance("test", {}))
        direction = np.array(image_of(tmp_path, name, tmp_path / f"{name}.nrrd").GetDirection()).reshape(3, 3)
        assert np.linalg.det(direction) == pytest.approx(1.0)


def test_equal_maps_give_equal_bytes_without_a_date(exam: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        exported(exam, "map.nc", "--to", "nrrd", "-o", tmp_path / f"{name}.nrrd")
    assert (tmp_path / "a.nrrd").read_bytes() == (tmp_path / "b.nrrd").read_bytes()
    assert b"#" not in (tmp_path / "a.nrrd").read_bytes().split(b"\n\n")[0]
