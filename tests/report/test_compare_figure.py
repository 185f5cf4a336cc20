"""The figure of a comparison shows every visit on the patient's axes, however the head was held."""

from __future__ import annotations

import numpy as np
import pytest
from plain_reports import compare_report
from posterior_maps import bump_values, grid_map

from tactile_bayes.declarations import replace
from tactile_bayes.geometry import rigid
from tactile_bayes.report.estimate_figures import DrawnMap, draw_comparison
from tactile_bayes.size.visits import Compared

PLACE = np.array([60.0, 90.0])
BESIDE = np.array([12.0, 6.0])
"""From the mass to a second bump, in the patient's frame: to the patient's right, and up."""
REFUSED = compare_report(reason="a test")


def visit(angle_rad: float, *, height: float, landmarks: bool = True) -> DrawnMap:
    """A map of the mass and of the second bump, by a head that was turned."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    patient_from_plane = np.array([[c, -s], [s, c]])
    beside = patient_from_plane.T @ BESIDE
    mass = bump_values(amplitude=height, x=0.0, y=0.0, sigma_x=3.0, sigma_y=3.0)
    second = bump_values(amplitude=0.2, x=float(beside[0]), y=float(beside[1]), sigma_x=2.0, sigma_y=2.0)
    made = grid_map(mass + second - 1.0)
    frame = np.eye(3)
    frame[:2, :2] = patient_from_plane
    transform = rigid(frame, np.array([*PLACE, 0.0])) if landmarks else None
    return DrawnMap(replace(made, patient_from_plane=transform), (0.0, 0.0))


def images(*visits: DrawnMap):
    figure = draw_comparison(Compared("not_one_mass"), REFUSED, [[one] for one in visits], None)
    return [axes.images[0] for axes in figure.axes if axes.images and axes.get_title(loc="left")]


def value_at(image, x_mm: float, y_mm: float) -> float:
    left, right, bottom, top = image.get_extent()
    rows, columns = image.get_array().shape
    column = int((x_mm - left) / (right - left) * columns)
    return float(image.get_array()[int((y_mm - bottom) / (top - bottom) * rows), column])


@pytest.mark.parametrize("angle_rad", [0.0, 0.5, -2.0])
def test_right_of_the_patient_is_on_the_viewers_left_whatever_the_heads_turn(angle_rad: float) -> None:
    """The axes give mm left of and above the xiphoid: the mass at (-60, 90), the second bump at (-72, 96)."""
    first, second, difference = images(visit(0.2, height=0.4), visit(angle_rad, height=0.6))
    for image, height in ((first, 0.4), (second, 0.6)):
        assert value_at(image, -60, 90) == pytest.approx(1 + height, abs=0.03)
        assert value_at(image, -72, 96) == pytest.approx(1.2, abs=0.05)
        assert value_at(image, -48, 96) == pytest.approx(1.0, abs=0.02)
    assert first.get_clim() == second.get_clim()
    assert value_at(difference, -60, 90) == pytest.approx(0.2, abs=0.03)
    assert value_at(difference, -72, 96) == pytest.approx(0.0, abs=0.05)


def test_without_landmarks_the_axes_are_the_planes() -> None:
    first, *_ = images(visit(0.0, height=0.4, landmarks=False), visit(0.0, height=0.4))
    assert value_at(first, 0, 0) == pytest.approx(1.4, abs=0.03)
    assert value_at(first, -12, 6) == pytest.approx(1.2, abs=0.05)


def test_a_visit_without_a_lump_is_left_empty() -> None:
    found = images(visit(0.0, height=0.4), replace(visit(0.0, height=0.4), centre_mm=None))
    assert np.ma.getmaskarray(found[1].get_array()).all()


def panels(*visits: DrawnMap, **told: object):
    figure = draw_comparison(Compared("not_one_mass"), replace(REFUSED, **told), [[one] for one in visits], None)
    figure.canvas.draw()
    return figure, [axes for axes in figure.axes if axes.images and axes.get_title(loc="left")]


def test_every_panel_names_the_patients_sides_and_counts_mm_from_the_xiphoid() -> None:
    """The mass lies 60 mm to the patient's right; moved across the xiphoid it lies as far to the left."""
    _, found = panels(visit(0.0, height=0.4), visit(0.5, height=0.6))
    assert len(found) == 3
    for axes in found:
        assert [text.get_text() for text in axes.texts] == ["R", "L", "H", "F"]
        assert axes.get_xlabel() == "to the patient's right of the xiphoid (mm)"
        ticks = {
            round(place): label.get_text()
            for place, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
        }
        assert ticks[-60] == "60"
    left = visit(0.0, height=0.4)
    moved = left.tactile_map.patient_from_plane.copy()
    moved[0, 3] = -60.0
    other = replace(left, tactile_map=replace(left.tactile_map, patient_from_plane=moved))
    _, (axes, *_) = panels(other, other)
    assert axes.get_xlabel() == "to the patient's left of the xiphoid (mm)"
    _, (plane, *_) = panels(visit(0.0, height=0.4, landmarks=False), visit(0.0, height=0.4))
    assert [text.get_text() for text in plane.texts] == ["+x", "-x", "+y", "-y"]


def test_the_figure_is_titled_by_its_scans_and_both_colour_bars_say_what_they_are_of() -> None:
    scans = [{"sha256": "ab" * 32, "subject": "P07"}, {"sha256": "cd" * 32, "subject": "P07"}]
    figure, _ = panels(visit(0.0, height=0.4), visit(0.5, height=0.6), provenance={"scans": scans})
    assert figure.get_suptitle() == "Comparison: P07, scans abababab, cdcdcdcd"
    bars = [axes.get_ylabel() for axes in figure.axes if axes.get_label() == "<colorbar>"]
    words = visit(0.0, height=0.4).tactile_map.recipe.value_words
    assert bars == [words, f"difference of {words}"]
