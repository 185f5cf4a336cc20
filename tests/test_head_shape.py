"""Shape of a head from its taxels: reference places are those of planes, cylinders and spheres, written out here."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.declarations import as_dict, from_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.scene import Head
from tactile_bayes.geometry import FloatArray
from tactile_bayes.scans import DEFAULT_HEAD, HeadShape


def grid(rows: int = 16, columns: int = 26, pitch_mm: float = 1.5) -> tuple[FloatArray, FloatArray]:
    x = (np.arange(rows) - (rows - 1) / 2) * pitch_mm
    y = (np.arange(columns) - (columns - 1) / 2) * pitch_mm
    across, along = np.meshgrid(x, y, indexing="ij")
    return across, along


def surface(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    return np.stack([x, y, z], axis=-1)


@pytest.mark.parametrize("radius_mm", [13.0, 20.0, 35.0, 400.0])
def test_a_cylinder_has_its_radius_across_and_none_along(radius_mm: float) -> None:
    x, y = grid()
    shape = HeadShape.of(surface(x, y, np.sqrt(radius_mm**2 - x**2) - radius_mm), 1.5)
    assert (shape.rows, shape.columns, shape.pitch_mm) == (16, 26, 1.5)
    assert shape.radius_mm == pytest.approx(radius_mm)
    assert shape.radius_along_mm is None
    assert shape.uneven_mm == 0


def test_a_sphere_has_one_radius_both_ways() -> None:
    x, y = grid(10, 10)
    shape = HeadShape.of(surface(x, y, np.sqrt(20.0**2 - x**2 - y**2) - 20.0), 1.5)
    assert (shape.radius_mm, shape.radius_along_mm) == pytest.approx((20.0, 20.0))
    assert shape.uneven_mm == 0


def test_a_plane_is_flat_also_when_it_is_tilted_and_shifted() -> None:
    x, y = grid(12, 12, 2.0)
    shape = HeadShape.of(surface(x, y, 3.0 + 0.1 * x - 0.05 * y), 2.0)
    assert (shape.radius_mm, shape.radius_along_mm, shape.uneven_mm) == (None, None, 0)
    assert str(shape) == "12 x 12 taxels, 2 mm apart, flat"


def test_a_hollow_face_has_a_negative_radius() -> None:
    x, y = grid()
    shape = HeadShape.of(surface(x, y, 35.0 - np.sqrt(35.0**2 - x**2)), 1.5)
    assert shape.radius_mm == pytest.approx(-35.0)
    assert DEFAULT_HEAD.differences(shape)


def test_the_papers_head_is_the_default() -> None:
    head = Head()
    assert HeadShape.of(head.surface_mm(), head.pitch_mm) == DEFAULT_HEAD


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (Head(), []),
        (Head(pitch_mm=1.53), []),
        (Head(radius_mm=33.0), []),
        (Head(radius_mm=40.0), []),
        (Head(columns=25), []),
        (Head(pitch_mm=1.6), ["pitch 1.6 mm (the calibration: 1.5 mm)"]),
        (Head(radius_mm=28.0), ["face across the head on an arc of 28 mm (the calibration: on an arc of 35 mm)"]),
        (Head(radius_mm=100_000.0), ["face across the head flat (the calibration: on an arc of 35 mm)"]),
        (Head(rows=13), ["array 13 x 26 taxels (19.5 x 39 mm) (the calibration: 16 x 26 taxels (24 x 39 mm))"]),
    ],
)
def test_small_departures_are_borne_and_others_are_named(head: Head, words: list[str]) -> None:
    assert DEFAULT_HEAD.differences(HeadShape.of(head.surface_mm(), head.pitch_mm)) == words


def test_shoulders_in_the_array_are_another_head() -> None:
    head = Head(shoulder_mm=3.0, rim_mm=0.0)
    found = DEFAULT_HEAD.differences(HeadShape.of(head.surface_mm(), head.pitch_mm))
    assert any(text.startswith("taxels") for text in found)


def test_a_head_survives_its_file_and_nonsense_does_not() -> None:
    shape = HeadShape(12, 12, 2.0, None, rim_mm=3.0)
    assert from_plain(HeadShape, as_dict(shape)) == shape
    for name, value in (
        ("rows", 0),
        ("rows", 1.5),
        ("pitch_mm", 0.0),
        ("radius_mm", 0),
        ("rim_mm", -1),
        ("radius_mm", "x"),
    ):
        with pytest.raises(BadDataError, match=f"head.{name} is"):
            from_plain(HeadShape, {**as_dict(shape), name: value}, where="head")
    with pytest.raises(BadDataError, match=r"head\.raduis is not known"):
        from_plain(HeadShape, {**as_dict(shape), "raduis": 3}, where="head")
