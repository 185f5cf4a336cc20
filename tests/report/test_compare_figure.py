"""The figure and the page of a comparison show every visit on the patient's axes, however the head was held."""

from __future__ import annotations

import base64
import html
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plain_reports import compare_report, estimate_report
from posterior_maps import bump_map, bump_values, grid_map

import tactile_bayes as tb
from tactile_bayes.api.maps import Map
from tactile_bayes.api.sized import SizeEstimate
from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import Place
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.map import MapRecipe
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.compare import Visit
from tactile_bayes.report.growth_page import Course, DrawnMap, draw_comparison, growth_page
from tactile_bayes.report.svg import picture_of
from tactile_bayes.size.visits import VisitComparison

PLACE = np.array([60.0, 90.0])
BESIDE = np.array([12.0, 6.0])
"""From the mass to a second bump, in the patient's frame: to the patient's right, and up."""
VISITS = tuple(Visit(number, day, None, None, ()) for number, day in ((1, None), (2, 90.0)))
FOUND = estimate_report(centre_mm=Place(0.0, 0.0))
REFUSED = compare_report(reason="a test", visits=VISITS)


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
    return DrawnMap(replace(made, patient_from_plane=transform, plane_from_base=np.eye(4)), FOUND)


def images(*visits: DrawnMap):
    figure = draw_comparison(VisitComparison("not_one_mass"), REFUSED, [[one] for one in visits], None)
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
    found = images(visit(0.0, height=0.4), replace(visit(0.0, height=0.4), report=estimate_report()))
    assert np.ma.getmaskarray(found[1].get_array()).all()


def panels(*visits: DrawnMap, **told: object):
    figure = draw_comparison(VisitComparison("not_one_mass"), replace(REFUSED, **told), [[one] for one in visits], None)
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


def test_the_figure_is_titled_by_what_its_scans_say_and_both_colour_bars_say_what_they_are_of() -> None:
    scans = [
        {"sha256": "ab" * 32, "subject": "P07", "visit": "a"},
        {"sha256": "cd" * 32, "subject": "P07", "visit": "b"},
    ]
    figure, found = panels(visit(0.0, height=0.4), visit(0.5, height=0.6), provenance={"scans": scans})
    assert figure.get_suptitle() == "Comparison: P07, visits a and b"
    assert [axes.get_title(loc="left") for axes in found] == ["Visit 1", "Visit 2, day 90", "Last minus first"]
    bars = [axes.get_ylabel() for axes in figure.axes if axes.get_label() == "<colorbar>"]
    words = visit(0.0, height=0.4).tactile_map.recipe.value_words
    assert bars == [words, f"difference of {words}"]


# --- The page.


def grown(times: float) -> tuple[SizeEstimate, SizeEstimate, SizeEstimate]:
    """Estimates of three visits of a lump that grows so much each time, the head turned at the later ones."""
    found = []
    for number, angle in enumerate((0.0, 0.6, -0.4)):
        c, s = np.cos(angle), np.sin(angle)
        frame = np.eye(3)
        frame[:2, :2] = [[c, -s], [s, c]]
        noise = 0.01 * np.random.default_rng(number).standard_normal((51, 51))
        sigma = 3.5 * times**number
        made = bump_map(noise=noise, amplitude=0.3, x=0.0, y=0.0, sigma_x=sigma, sigma_y=sigma)
        there = replace(made, patient_from_plane=rigid(frame, np.array([*PLACE, 0.0])))
        scans = ({"subject": "P07", "side": "right", "visit": f"v{number + 1}", "sha256": f"{number:064x}"},)
        found.append(tb.estimate(Map(there, scans=scans), method="laplace"))
    return found[0], found[1], found[2]


@pytest.fixture(scope="module")
def three() -> tb.Comparison:
    return tb.compare(*grown(1.25), dates=["2026-01-10", "2026-04-12", "2026-07-20"], method="laplace")


def paths_of(page: str, kind: str) -> list[np.ndarray]:
    found = re.findall(rf'<path class="{kind}" d="M([^"]*?)Z?"', page)
    return [np.array([[float(n) for n in pair.split()] for pair in one.split("L")]) for one in found]


def test_the_page_has_a_ring_as_large_as_each_size_and_the_texts_verdict(three: tb.Comparison, tmp_path: Path) -> None:
    three.page(tmp_path / "growth.html")
    page = (tmp_path / "growth.html").read_text()
    words = html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL))
    words = " ".join(words.split())
    assert three.growth == "grown"
    assert "The mass has grown, if exams repeat as simulated ones do;" in three.text
    assert "The mass has grown, if exams repeat as simulated ones do;" in words
    for told in (
        "Patient P07",
        "Side right",
        "Visit 1 (coded v1), 2026-01-10",
        "Visit 3 (coded v3), 2026-07-20",
        RESEARCH_USE,
    ):
        assert told in words
    for line in three.text.splitlines():
        if line.startswith(("Change", "Probability", "Trend", "If exams")):
            assert line in words
    rings = [2.0 * float(np.hypot(*(one - one.mean(axis=0)).T).max()) for one in paths_of(page, "size")]
    sizes = [one.max_size_mm.median for one in three.report.visits]
    assert rings == pytest.approx([0.7 * size for size in sizes], rel=0.03)
    assert len(re.findall("<image ", page)) == 3
    digests = [one["sha256"] for one in three.report.provenance["scans"]]
    assert not any(digest[:8] in page.partition("<h2>")[0] for digest in digests)


def test_the_trend_is_drawn_through_the_sizes(three: tb.Comparison) -> None:
    page = three.page_text(title="", name="")
    (line,) = paths_of(page, "trend")
    dots = np.array([[float(x), float(y)] for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', page)])
    assert line[:, 0] == pytest.approx(dots[:, 0])
    assert np.abs(line[:, 1] - dots[:, 1]).max() < 2.0  # of 46 mm: the three sizes grow evenly
    assert line[0, 1] > line[-1, 1]


def test_both_spreads_between_exams_are_drawn_and_near_visits_write_nothing_over_another(three: tb.Comparison) -> None:
    page = three.page_text(title="", name="")
    chart = page[page.index('aria-label="Largest diameter at each visit') :].partition("</svg>")[0]
    bars = re.findall(r'M([\d.]+) ([\d.]+)V([\d.]+)" stroke="#111" stroke-width="(0.25|0.9)"', chart)
    wide, narrow = ([float(b) - float(a) for _, a, b, thick in bars if thick == one] for one in ("0.25", "0.9"))
    assert len(wide) == len(narrow) == 3
    assert all(length > -one > 0 for length, one in zip(map(abs, wide), narrow, strict=True))
    assert "2026-04-12" in chart
    near = replace(three, report=replace(three.report, visits=tuple(
        replace(one, day=day) for one, day in zip(three.report.visits, (0.0, 3.0, 190.0), strict=True)
    )))  # fmt: skip
    page = near.page_text(title="", name="")
    chart = page[page.index('aria-label="Largest diameter at each visit') :].partition("</svg>")[0]
    assert "2026-04-12" not in chart
    assert "2026-04-12" in page  # in the table and below its map


def test_one_value_has_one_colour_at_all_visits_of_the_page() -> None:
    """Two visits alike but for the lump's height: what lies beside it has the same pixels."""
    report = replace(REFUSED, visits=VISITS)
    maps = [[visit(0.0, height=0.4)], [visit(0.0, height=0.8)]]
    page = growth_page(VisitComparison("not_one_mass"), report, maps, Course())
    pixels = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)
        for data in re.findall(r'<image [^>]*base64,([^"]*)"', page)
    ]
    first, second = (one[20, 20] for one in pixels)
    assert first.tolist() == second.tolist()


def test_one_cell_without_readings_is_grey_whatever_the_others_are() -> None:
    """A palette of the most frequent colours gave it that of the highest value."""
    values = np.random.default_rng(1).normal(1.0, 0.1, (60, 60))
    values[7, 50] = np.nan
    data = re.findall(r'base64,([^"]*)"', picture_of(values, (0.9, 1.3), (60.0, 60.0)))[0]
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))[::4, ::4]
    grey = (pixels == 222).all(axis=-1)
    assert np.argwhere(grey).tolist() == [[7, 50]]


def test_grids_lie_as_their_files_read_and_scans_without_landmarks_as_every_picture_of_them() -> None:
    """A second bump 10 mm along x and 6 along y from the mass: right below it of a grid, left above it of a scan."""
    away = (10.0, 6.0)
    values = bump_values(amplitude=0.4, x=0.0, y=0.0, sigma_x=3.0, sigma_y=3.0) - 1.0
    made = grid_map(bump_values(amplitude=0.3, x=away[0], y=away[1], sigma_x=2.0, sigma_y=2.0) + values)
    scan = DrawnMap(replace(made, recipe=MapRecipe("scan", "gain", 1.0), plane_from_base=np.eye(4)), FOUND)
    grid = DrawnMap(replace(made, recipe=MapRecipe("grid", "gain", 1.0), plane_from_base=None), FOUND)
    for drawn, place, edges in (
        (scan, (-10.0, 6.0), ["+x", "-x", "+y", "-y"]),
        (grid, (10.0, -6.0), ["-x", "+x", "-y", "+y"]),
    ):
        first, *_ = images(drawn, drawn)
        assert value_at(first, *place) == pytest.approx(1.3, abs=0.03)
        page = growth_page(VisitComparison("not_one_mass"), REFUSED, [[drawn]] * 2, Course())
        told = re.findall(r'fill="#fff">([+-][xy])<', page)
        assert told[:4] == edges


def test_hostile_texts_stay_texts_on_the_page() -> None:
    hostile = '"><script>alert(1)</script>'
    course = Course(hostile, hostile, hostile, hostile, hostile, (hostile, hostile), (hostile, hostile))
    page = growth_page(VisitComparison("not_one_mass"), REFUSED, [[visit(0.0, height=0.4)]] * 2, course)
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_visits_that_are_not_compared_have_a_page_that_says_so(tmp_path: Path) -> None:
    first, second, _ = grown(1.0)
    off = second.tactile_map.patient_from_plane.copy()
    off[0, 3] -= 120.0
    other = Map(replace(second.tactile_map, patient_from_plane=off), scans=second.provenance.scans)
    refused = tb.compare(first, tb.estimate(other, method="laplace"), method="laplace")
    refused.page(tmp_path / "growth.html")
    page = (tmp_path / "growth.html").read_text()
    assert "Not compared: not shown to be one mass" in page
    assert "Look whether they are of one mass." in page
    body = page.partition("</style>")[2]
    assert "--" not in body  # no option of the program
    assert "moved so that" not in body
    assert len(re.findall("<image ", page)) == 2
    assert 'class="trend"' not in page
