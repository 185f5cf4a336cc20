"""One orientation in every picture: a lump in the upper outer part of the left breast is on the upper right of all."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from mapping_scans import gaussian, make_scan, strokes

from tactile_bayes.actions.live_view import live_text
from tactile_bayes.declarations import replace
from tactile_bayes.hardware.live import LiveMap, LiveState, page_state
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import MapRecipe, TactileMap, orientation_of
from tactile_bayes.posterior.verdict import coverage_shortfall
from tactile_bayes.report.map import map_figure
from tactile_bayes.scans import Landmarks, Scan

INTO_BODY = np.array([0.0, 0.0, 1.0])  # of `make_scan`: its head's z axis is the base's
OUTWARDS_MM, UPWARDS_MM = 10.0, 8.0
# Directions of the patient's head in the base, in degrees from x towards y; the scan head's y axis stays at 90.
HEADS = (70, 270, 0, 180)


def scan_of(head_deg: float | None) -> Scan:
    """A lump up and to the patient's left of the scan's middle; without landmarks the patient's head is where y is."""
    up = direction(90 if head_deg is None else head_deg)
    left = np.cross(INTO_BODY, up)  # posterior cross superior is the patient's left
    lump = UPWARDS_MM * up + OUTWARDS_MM * left
    marks = None if head_deg is None else Landmarks(200 * up, -100 * up)
    field = gaussian(x=lump[0], y=lump[1], sigma_x=3.0, sigma_y=3.0)
    return make_scan(strokes(lines=7), field=field, landmarks=marks)


@cache
def map_of(head_deg: float | None) -> TactileMap:
    return build_map([scan_of(head_deg)], normalise="mean")


def direction(angle_deg: float) -> np.ndarray:
    angle = np.radians(angle_deg)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


@cache
def live_state(head_deg: float | None) -> LiveState:
    """What a view shows of a recording of the scan."""
    scan = scan_of(head_deg)
    live = LiveMap(scan.head, scan.element_calibration)
    if scan.landmarks is not None:
        for name in ("sternal_notch", "xiphoid"):
            live.take([("landmark", name, tuple(getattr(scan.landmarks, f"{name}_mm")))])
    seen: list = []
    for i, (counts, time) in enumerate(zip(scan.frames.counts, scan.frames.time_s, strict=True)):
        turn, place = scan.poses.quaternion_wxyz[i], scan.poses.position_mm[i]
        seen += [("pose", round(time * 1e9), place, turn), ("frame", round(time * 1e9), 1, counts)]
    live.take(seen)
    return live.state()


def corner(picture: np.ndarray) -> tuple[str, str]:
    """Where the brightest part of a picture is, row 0 on top."""
    rows, columns = np.nonzero(picture >= np.nanmax(picture))
    height, width = picture.shape
    return ("upper" if rows.mean() < height / 2 else "lower", "left" if columns.mean() < width / 2 else "right")


UPPER_RIGHT = ("upper", "right")


@pytest.mark.parametrize("head_deg", [*HEADS, None])
def test_the_rule_shows_the_lump_on_the_upper_right(head_deg):
    tactile_map = map_of(head_deg)
    view = orientation_of(tactile_map)
    assert corner(view.screen(tactile_map.mean)) == UPPER_RIGHT
    named = ("H", "L") if head_deg is not None else ("+y", "-x")
    assert (view.edges["top"], view.edges["right"]) == named


@pytest.mark.long
@pytest.mark.parametrize("head_deg", [*HEADS, None])
def test_the_map_figure_shows_the_lump_on_the_upper_right(tmp_path, head_deg):
    from PIL import Image

    tactile_map = map_of(head_deg)
    map_figure(tactile_map, tmp_path / "map.png")
    pixels = np.asarray(Image.open(tmp_path / "map.png").convert("RGB"), dtype=float)
    panel = pixels[:, : int(0.52 * pixels.shape[1])]  # the map, without its colour bar
    coloured = np.ptp(panel, axis=2) > 30  # neither grey axes nor white paper
    rows, columns = np.nonzero(coloured)
    part = panel[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    yellow = (part[..., 0] > 180) & (part[..., 1] > 180) & (part[..., 2] < 100)
    assert yellow.sum() > 20
    assert corner(np.where(yellow, 1.0, 0.0)) == UPPER_RIGHT


@pytest.mark.parametrize("head_deg", [*HEADS, None])
def test_the_live_terminal_shows_the_lump_on_the_upper_right(head_deg):
    text = live_text(live_state(head_deg), columns=90, lines=40, colour=False)
    lines = text.splitlines()
    top = next(i for i, line in enumerate(lines) if line.strip() in ("H (head)", "+y"))
    bottom = next(i for i, line in enumerate(lines) if line.strip() in ("F (feet)", "-y"))
    middle = next(line for line in lines[top:bottom] if re.match(r" *(R|\+x) .*(L|-x)$", line))
    rows = [line[4 : 4 + len(middle) - 6].ljust(len(middle) - 6) for line in lines[top + 1 : bottom]]
    picture = np.array([[" .:-=+*#%@".find(c) for c in row] for row in rows])
    assert corner(picture) == UPPER_RIGHT


@pytest.mark.parametrize("head_deg", [*HEADS, None])
def test_the_live_page_is_sent_the_lump_on_the_upper_right(head_deg):
    state = live_state(head_deg)
    sent = page_state(replace(state, lump_base_mm=lump_in_base(head_deg)))["map"]
    levels = np.array([np.nan if one is None else one for one in sent["levels"]], dtype=float)
    assert corner(levels.reshape(sent["rows"], sent["columns"])) == UPPER_RIGHT
    across, down = sent["lump"]
    assert across > 0.5 * sent["columns"]
    assert down < 0.5 * sent["rows"]
    assert sent["edges"]["right"] == ("L" if head_deg is not None else "-x")


def lump_in_base(head_deg: float | None) -> np.ndarray:
    up = direction(90 if head_deg is None else head_deg)
    return UPWARDS_MM * up + OUTWARDS_MM * np.cross(INTO_BODY, up)


def test_a_lumps_place_in_the_picture_is_its_cell_of_the_picture():
    for head_deg in (*HEADS, None):
        tactile_map = map_of(head_deg)
        view = orientation_of(tactile_map)
        row, column = np.unravel_index(np.nanargmax(tactile_map.mean), tactile_map.mean.shape)
        across, down = view.place(tactile_map, (tactile_map.x_mm[column], tactile_map.y_mm[row]))
        shown = view.screen(tactile_map.mean)
        assert shown[int(down), int(across)] == np.nanmax(tactile_map.mean)


@pytest.mark.parametrize("head_deg", HEADS)
def test_the_notch_is_never_more_than_an_eighth_of_a_turn_from_straight_up(head_deg):
    across, up = orientation_of(map_of(head_deg)).notch
    assert up >= np.cos(np.pi / 4) - 1e-9
    assert np.hypot(across, up) == pytest.approx(1.0)


@pytest.mark.parametrize(("head_deg", "left"), [(70, "-x"), (270, "+x"), (0, "+y"), (180, "-y")])
def test_the_sides_where_strokes_are_missing_are_the_patients(head_deg, left):
    """The advice named the plane's axes: with the patient's head along x it sent the examiner to "the feet"."""
    names = ("left", "right", "head", "feet")
    up = direction(head_deg)
    towards = dict(zip(names, (np.cross(INTO_BODY, up), -np.cross(INTO_BODY, up), up, -up), strict=True))
    tactile_map = map_of(head_deg)
    x, y = np.meshgrid(tactile_map.x_mm, tactile_map.y_mm)
    for name in names:
        cut = x * towards[name][0] + y * towards[name][1] > 4.0
        short = coverage_shortfall(replace(tactile_map, count=np.where(cut, 0, 40)), (0.0, 0.0), reach_mm=8.0)
        assert [words.split(" (")[0] for words in short] == [f"the patient's {name}"]
        if name == "left":
            assert list(short) == [f"the patient's left ({left})"]


def test_without_landmarks_missing_strokes_are_on_sides_of_the_picture():
    tactile_map = map_of(None)  # its picture has x to the left
    count = np.where(tactile_map.x_mm[None, :] > 4.0, 0, np.full(tactile_map.count.shape, 40))
    assert list(coverage_shortfall(replace(tactile_map, count=count), (0.0, 0.0), reach_mm=8.0)) == [
        "the picture's left (+x)"
    ]


def test_an_imported_grid_is_shown_as_its_file_reads():
    values = np.ones((20, 30))
    values[2, 3] = 2.0
    recipe = MapRecipe("grid", "mean", 1.0)
    grid = TactileMap(values, values * 0, np.ones((20, 30), dtype=int), np.arange(30.0), np.arange(20.0), recipe)
    view = orientation_of(grid)
    np.testing.assert_array_equal(view.screen(values), values)
    assert view.edges == {"left": "-x", "right": "+x", "top": "-y", "bottom": "+y"}
    assert "first row on top" in view.words


def test_two_views_that_differ_by_a_mirror_would_be_seen():
    """The control of the tests above: mirrored, the lump is on the upper left."""
    tactile_map = map_of(270)
    assert corner(orientation_of(tactile_map).screen(tactile_map.mean)[:, ::-1]) == ("upper", "left")
