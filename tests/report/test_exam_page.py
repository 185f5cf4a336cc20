"""The page of an exam: self-contained, every text escaped, drawn as the examiner sees it, honest without a lump."""

from __future__ import annotations

import base64
import io
import re
import shutil
from collections.abc import Mapping
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_scans import gaussian, make_scan, strokes
from plain_reports import estimate_report, pooled_report
from posterior_maps import grid_map

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import (
    EstimateReport,
    MassReport,
    Place,
    Point,
    PooledMap,
    PooledReport,
    SmallestAt,
    SmallestLump,
)
from tactile_bayes.findings import finding
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.exam_page import exam_page
from tactile_bayes.report.exam_words import PageLabels, ShownExam, exam_map, headline, reach_text
from tactile_bayes.report.pages import BROWSERS, find_printer
from tactile_bayes.report.svg import MARGIN_MM, Frame, exam_picture, thumbnail_svg
from tactile_bayes.scans import Landmarks

HOSTILE = "\"><img src=x onerror=alert(1)><script>alert(2)</script>'&lt; </p></svg></body>"
VOID = {"meta", "img", "br", "image", "rect", "circle", "path", "stop"}
SCANS = ({"sha256": "ab" * 32, "subject": "P07", "side": "left", "posture": "supine"},)


class Page(HTMLParser):
    """Tags, attributes and text of a page; every element must be closed in its turn."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert [tag for tag in self._open if tag != "p"] == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self._open:
            self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    def named(self, tag: str, **wanted: str) -> list[dict[str, str | None]]:
        return [a for name, a in self.tags if name == tag and all(a.get(k) == v for k, v in wanted.items())]


@cache
def demo() -> tuple[TactileMap, EstimateReport]:
    """The demo's map with a nipple 30 mm below and 25 mm to the patient's right of its lump, and its estimate."""
    found = tb.estimate(tb.demo_map())
    report = found.answer.report
    assert report is not None
    assert report.centre_mm is not None
    tactile_map = found.tactile_map
    patient = tactile_map.patient_from_plane
    assert patient is not None
    lump = np.array([*report.centre_mm.median, 0.0])
    nipple = lump + patient[:3, :3].T @ np.array([25.0, -30.0, 0.0])
    return replace(tactile_map, nipple_mm=nipple), report


def exam(scans: tuple[Mapping[str, str], ...] = SCANS, **more: Any) -> ShownExam:
    tactile_map, report = demo()
    side = scans[0].get("side", "") if scans else ""
    return ShownExam((exam_map(tactile_map, report, side=side),), None, scans, PageLabels(**more))


SMALLEST = SmallestLump(
    0.95,
    depths_mm=(8.0, 15.0),
    best_mm=(5.5, 13.0),
    worst_mm=(7.0, None),
    spacing_mm=20.0,
    places=(SmallestAt(-10.0, 0.0, (5.5, 13.0)), SmallestAt(10.0, 0.0, (7.0, None))),
)


def without_lump(reason_code: Any = "undetected", **more: Any) -> ShownExam:
    tactile_map, _ = demo()
    gone = estimate_report(
        reason="no lump found on the 50 cm2 that the map covers",
        reason_code=reason_code,
        detected_probability=0.03,
        smallest_lump=SMALLEST,
        on_paper="scan the place again",
        **more,
    )
    return ShownExam((exam_map(tactile_map, gone, side="left"),), None, SCANS)


def test_the_page_says_size_both_intervals_place_and_use() -> None:
    _, report = demo()
    alike, size = report.max_size_mm, report.another_exam.max_size_mm
    page = Page(exam_page(exam()))
    for text in (
        f"Lump of about {size.median:.1f} mm, 95 % interval {size.low:.1f} to {size.high:.1f} mm",
        f"it lies between {size.low:.1f} and {size.high:.1f} mm, if exams of a lump differ by",
        f"as those of simulated bodies do, it would lie between {alike.low:.1f} and {alike.high:.1f} mm",
        "What would narrow it:",
        "Left breast, 1:30 o'clock, 39 mm from the nipple (upper outer)",
        "Subject P07",
        "abababababab",
        "age not stated in the scan",
        RESEARCH_USE,
    ):
        assert text in page.words, text
    assert "--" not in page.words  # no option of the program


def test_nothing_is_loaded_and_no_script_may_run() -> None:
    text = exam_page(exam())
    page = Page(text)
    policy = page.named("meta", **{"http-equiv": "Content-Security-Policy"})
    assert policy[0]["content"] == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    assert page.named("script") == page.named("link") == page.named("iframe") == []
    targets = [value for _, attrs in page.tags for name, value in attrs.items() if name in ("src", "href", "srcset")]
    assert targets
    assert all(str(value).startswith("data:image/png;base64,") for value in targets)
    assert "http:" not in text
    assert "https:" not in text
    assert "@import" not in text
    assert "url(" not in text


def test_equal_exams_give_equal_pages_and_nothing_of_today() -> None:
    assert exam_page(exam()) == exam_page(exam())
    assert "Date" not in Page(exam_page(exam())).words
    assert "Date 2026-03-01" in Page(exam_page(exam(day="2026-03-01"))).words


def test_a_name_is_there_only_if_given() -> None:
    assert "Name" not in Page(exam_page(exam())).words
    assert "Name A. B." in Page(exam_page(exam(name="A. B."))).words


def test_hostile_and_endless_texts_add_no_tag_and_stay_short() -> None:
    plain = Page(exam_page(exam(title="t", name="n")))
    for text in (HOSTILE, HOSTILE * 120, "a" * 10_000):
        facts = dict.fromkeys(("subject", "posture", "examiner", "visit", "mass", "sha256"), text)
        given = "".join(filter(str.isprintable, text))[:50]  # a longer one, and one that is not printable, is refused
        page = exam_page(exam(({**facts, "side": "left"},), title=given, name=given))
        found = Page(page)
        assert found.named("script") == found.named("img") == []
        names = {name for _, attrs in found.tags for name in attrs}
        assert not {name for name in names if name.startswith("on")}
        assert len(found.words) < len(plain.words) + 1500
        if text is HOSTILE:
            assert any(one.startswith(HOSTILE[:45]) for one in found.text)  # as text, and cut to its room


def centre_of(path: str) -> tuple[float, float]:
    points = np.array([[float(n) for n in pair.split()] for pair in path.strip("MZ").split("L")])
    return tuple(points.mean(axis=0))


@pytest.mark.parametrize("head_deg", [70, 270, 0, 180])
def test_a_lump_at_the_upper_outer_left_is_drawn_at_the_upper_right_and_told_so(head_deg: float) -> None:
    """The nipple lies at the scan's middle, the lump 8 mm up and 10 mm to the patient's left of it."""
    angle = np.radians(head_deg)
    up = np.array([np.cos(angle), np.sin(angle), 0.0])
    left = np.cross([0.0, 0.0, 1.0], up)  # z into the body: posterior cross superior is the patient's left
    lump = 8.0 * up + 10.0 * left
    marks = Landmarks(200 * up, -100 * up, nipple_mm=np.zeros(3))
    field = gaussian(x=lump[0], y=lump[1], sigma_x=3.0, sigma_y=3.0)
    tactile_map = build_map([make_scan(strokes(lines=7), field=field, landmarks=marks)], normalise="mean")
    _, report = demo()
    row, column = np.unravel_index(np.nanargmax(tactile_map.mean), tactile_map.mean.shape)
    x, y = float(tactile_map.x_mm[column]), float(tactile_map.y_mm[row])
    there = report.centre_mm
    placed = replace(report, centre_mm=Point(replace(there.x, median=x, sd=0.1), replace(there.y, median=y, sd=0.1)))
    text = exam_page(ShownExam((exam_map(tactile_map, placed, side="left"),), None, SCANS))
    page = Page(text)
    (drawn,) = page.named("svg", **{"class": "map"})
    width, height = (float(n) for n in drawn["viewbox"].split()[2:])
    across, down = centre_of(page.named("path", **{"class": "size"})[0]["d"])
    assert across > 0.55 * (width - 10)
    assert down < 0.45 * (height - 10)
    corner = {one["data-side"]: one for one in page.named("text", **{"class": "edge"})}
    assert float(corner["right"]["x"]) > float(corner["left"]["x"])
    letters = re.findall(r'data-side="(\w+)"[^>]*>(\w)<', text)
    assert dict(letters) == {"left": "R", "right": "L", "top": "H", "bottom": "F"}
    assert _brightest(page) == ("upper", "right")
    assert "Left breast, 1:30 o'clock, 13 mm from the nipple (upper outer)" in page.words
    (dot,) = page.named("circle", **{"class": "lump"})
    assert float(dot["cx"]) > 0 > float(dot["cy"])


def _brightest(page: Page) -> tuple[str, str]:
    """Where the embedded picture is brightest; a control that a mirrored picture would fail the test."""
    from PIL import Image

    data = base64.b64decode(page.named("image")[0]["href"].split(",", 1)[1])
    pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=float)
    yellow = (pixels[..., 0] > 180) & (pixels[..., 1] > 180) & (pixels[..., 2] < 100)
    rows, columns = np.nonzero(yellow)
    across = "left" if columns.mean() < pixels.shape[1] / 2 else "right"
    mirrored = "left" if np.nonzero(yellow[:, ::-1])[1].mean() < pixels.shape[1] / 2 else "right"
    assert across != mirrored
    return ("upper" if rows.mean() < pixels.shape[0] / 2 else "lower"), across


def test_the_ellipses_are_drawn_to_scale() -> None:
    _, report = demo()
    page = Page(exam_page(exam()))
    (drawn,) = page.named("svg", **{"class": "map"})
    tactile_map = demo()[0]
    scale = (float(drawn["viewbox"].split()[2]) - 10) / (tactile_map.mean.shape[1] * tactile_map.recipe.cell_mm)

    def width(kind: str) -> float:
        (one,) = page.named("path", **{"class": kind})
        points = np.array([[float(n) for n in pair.split()] for pair in one["d"].strip("MZ").split("L")])
        return float(np.ptp(points[:, 0]))

    largest = report.another_exam.max_size_mm  # the interval that leads
    assert width("size") == pytest.approx(scale * report.d_x_mm.median, rel=0.01)
    assert width("size-high") / width("size") == pytest.approx(largest.high / largest.median, rel=0.01)
    assert width("size-low") / width("size") == pytest.approx(largest.low / largest.median, rel=0.01)
    (bar,) = page.named("path", **{"class": "scale"})
    assert float(bar["d"].split("h")[1]) == pytest.approx(10 * scale, rel=0.01)


def test_no_lump_found_is_told_with_what_was_covered_and_what_would_have_shown() -> None:
    page = Page(exam_page(without_lump()))
    for text in (
        "No lump found in the area covered",
        "No lump was found in the area that was covered: ",
        "cm² read 10 times or more",
        "5.5 to 7 mm at a depth of 8 mm; 13 to more than 26.5 mm at a depth of 15 mm",
        "A lump may be smaller, deeper or softer than these, or lie outside the area that was covered.",
        "What would help: scan the place again.",
        "8 mm deep",
        RESEARCH_USE,
    ):
        assert text in page.words, text
    assert page.words.index("No lump was found") < page.words.index("What would help")  # the reason first
    assert "robability" not in page.words.replace("Probability that", "")
    assert page.named("path", **{"class": "meant"}) == []  # no cross: the reason is about no one place
    assert page.named("path", **{"class": "size"}) == []
    assert "about" not in headline(without_lump())
    assert headline(without_lump("window")) == "No size"  # a rise that cannot be measured is not "no lump"
    assert headline(without_lump("ridge")) == "No lump found in the area covered"
    assert headline(without_lump("cannot_show")) == "No answer: the data cannot show whether there is a lump"


def test_one_cross_marks_the_rise_that_the_reason_is_about() -> None:
    page = Page(exam_page(without_lump("ridge", about_mm=Place(3.0, 2.0))))
    assert len(page.named("path", **{"class": "meant"})) == 1
    assert "What rises at the cross on the picture is long like a rib, not round like a lump." in page.words
    assert "Cross: the place that is meant." in page.words
    assert "--" not in page.words


def unsized(reason: str, **more: Any) -> MassReport:
    """A second mass without a size."""
    names = ("centre_patient_mm", "amplitude", "max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm", "angle_deg")
    nothing = dict.fromkeys((*names, "another_exam"))
    told = {"detected_probability": 0.99, "reason": reason, "reason_code": "window", "advice": ""}
    return MassReport(**nothing | {"number": 2, "reported": False, "centre_mm": Place(15.0, 8.0)} | told | more)


def test_several_masses_are_numbered_with_a_place_each() -> None:
    tactile_map, report = demo()
    second = unsized("its window reaches beyond the map")
    first = replace(second, number=1, reported=True, reason="")
    both = replace(report, masses=(first, second))
    scans = ({**SCANS[0], "mass": "B"},)
    page = Page(exam_page(ShownExam((exam_map(tactile_map, both, side="left"),), None, scans)))
    assert "Mass B (number 1 on the map)" in page.words
    assert "2 masses, mass 1 about" in page.words
    assert "Size of mass 1" in page.words
    assert "no size (probability of a lump 0.99): its window reaches beyond the map" in page.words
    assert len(page.named("path", **{"class": "centre"})) == 2


def test_a_mass_elsewhere_is_not_taken_for_the_one_that_was_looked_for() -> None:
    shown = without_lump(masses=(unsized("its window reaches beyond the map"),))
    page = Page(exam_page(replace(shown, scans=({**SCANS[0], "mass": "2"},))))
    assert "Mass 2 (none of those on the map)" in page.words
    assert page.named("path", **{"class": "centre"}) != []
    assert 'class="centre"' not in thumbnail_svg(shown.main, label="of another mass's row")
    assert "No lump found at the place looked at" in page.words
    assert "No lump was found at the place looked at; the masses below lie elsewhere." in page.words
    assert "Place of mass 2" in page.words
    assert "2 no size (probability of a lump 0.99): its window reaches beyond the map" in page.words
    assert "Lump seen" not in page.words


def test_a_second_mass_is_drawn_as_its_ellipse() -> None:
    tactile_map, report = demo()
    size = report.max_size_mm
    axes = {"d_x_mm": size, "d_y_mm": replace(size, median=size.median / 2), "angle_deg": replace(size, median=90.0)}
    first = unsized("", number=1, reported=True)
    second = unsized("", centre_mm=Place(0.0, 0.0), max_size_mm=size, min_size_mm=size)

    def extents(mass: MassReport) -> tuple[float, float]:
        both = replace(report, masses=(first, mass))
        page = Page(exam_page(ShownExam((exam_map(tactile_map, both, side="left"),), None, SCANS)))
        path = page.named("path", **{"class": "size"})[1]["d"]
        points = np.array([[float(n) for n in pair.split()] for pair in path.strip("MZ").split("L")])
        return float(np.ptp(points[:, 0])), float(np.ptp(points[:, 1]))

    (frame,) = Page(exam_page(exam())).named("svg", **{"class": "map"})
    scale = (float(frame["viewbox"].split()[2]) - 10) / (tactile_map.mean.shape[1] * tactile_map.recipe.cell_mm)
    long = scale * size.median
    assert extents(replace(second, **axes)) == pytest.approx((long / 2, long), rel=0.01)


def pooled_as(report: EstimateReport, maps: int, **more: Any) -> PooledReport:
    """One size from several maps, that of an estimate."""
    names = ("max_size_mm", "min_size_mm", "another_exam", "variance_share", "provenance")
    shown = tuple(
        PooledMap(
            map=f"map {n}", status="estimate", reason="", detected_probability=1.0, max_size_mm=None, outlying=False
        )
        for n in range(1, maps + 1)
    )
    told = {name: getattr(report, name) for name in names} | {"status": "estimate", "maps": shown}
    return pooled_report(**told, figures=report.diagnostics, **more)


def test_of_several_maps_the_first_that_shows_a_lump_is_drawn() -> None:
    with_lump, without = exam().maps[0], without_lump().maps[0]
    pooled = pooled_as(with_lump.report, 2)
    both = ShownExam((without, with_lump), pooled, SCANS)
    assert both.main is with_lump
    page = Page(exam_page(both))
    assert "How good the exam was (map 2)" in page.words
    assert "1: no size" in page.words
    assert "Map 2 of 2. Full line: the estimated size of all maps; dashed: the ends of its interval." in page.words
    assert "Probability that it is a lump, by map 2: 0.9" in page.words
    assert len(page.named("path", **{"class": "size-high"})) == 1
    alone = Page(exam_page(ShownExam((with_lump,), None, SCANS))).words
    assert "Map 1 of" not in alone
    assert "Full line: the estimated size; dashed" in alone
    assert "by this map: 0.9" in alone


def test_the_interval_of_each_map_is_the_one_that_leads_on_a_page_of_its_own() -> None:
    one = exam().maps[0]
    assert one.report.another_exam is not None
    size = one.report.another_exam.max_size_mm
    ends = f"{size.low:.1f} to {size.high:.1f}"
    pooled = pooled_as(one.report, 2)
    page = Page(exam_page(ShownExam((one, one), pooled, SCANS)))
    assert f"1: {size.median:.1f} mm ({ends})" in page.words
    apart = replace(pooled, status="maps_disagree", max_size_mm=None, another_exam=None, reason="apart")
    page = Page(exam_page(ShownExam((one, one), apart, SCANS)))
    assert f"By map 2 alone the largest diameter is about {size.median:.1f} mm (95 %: {ends} mm)" in page.words


def test_what_was_reached_is_told_by_the_patients_left_and_right() -> None:
    """The demo's map about the xiphoid, moved so that it lies on one side, on the other, and across the middle."""
    tactile_map, _ = demo()
    assert tactile_map.patient_from_plane is not None
    told = {}
    for shift in (0.0, -60.0, -120.0):
        moved = tactile_map.patient_from_plane.copy()
        moved[0, 3] += shift
        told[shift] = reach_text(replace(tactile_map, patient_from_plane=moved))
    assert re.fullmatch(r"\d+ to \d+ mm to the patient's right of the xiphoid, \d+ to \d+ mm above it", told[0.0])
    across = r"\d+ mm to the patient's left to \d+ mm to the patient's right of the xiphoid, .*"
    assert re.fullmatch(across, told[-60.0])
    assert re.fullmatch(r"\d+ to \d+ mm to the patient's left of the xiphoid, .*", told[-120.0])


def test_without_a_nipple_the_xiphoid_tells_the_place_and_the_page_says_why() -> None:
    tactile_map, report = demo()
    page = Page(exam_page(ShownExam((exam_map(replace(tactile_map, nipple_mm=None), report, side=""),), None, ())))
    assert "of the xiphoid and" in page.words
    assert "No clock position: the scan names no nipple and no side." in page.words
    assert page.named("svg", **{"class": "dial"}) == []
    dead = replace(tactile_map, masked_taxels=("row 3 column 7 dead",))
    page = Page(exam_page(ShownExam((exam_map(dead, report, side=""),), None, ({"side": "left"}, {}))))  # of two scans
    assert "No clock position: the scan names no side." in page.words
    assert "sensor points 1 left out as faulty" in page.words


def test_a_nipple_off_the_map_is_pointed_to() -> None:
    tactile_map, report = demo()
    far = replace(tactile_map, nipple_mm=tactile_map.nipple_mm + np.array([200.0, 0.0, 0.0]))
    page = Page(exam_page(ShownExam((exam_map(far, report, side="left"),), None, SCANS)))
    assert len(page.named("path", **{"class": "nipple-off"})) == 1
    assert page.named("path", **{"class": "nipple"}) == []


def test_the_nipples_name_keeps_off_the_scale_bar_at_the_foot() -> None:
    tactile_map, report = demo()
    frame = Frame(tactile_map, 1.0)
    y_mm = max(tactile_map.y_mm[[3, -4]], key=lambda y: frame.at((0.0, y))[1])
    low = replace(tactile_map, nipple_mm=np.array([0.0, y_mm, 0.0]))
    drawn = exam_picture(exam_map(low, report, side="left"), replace(frame, tactile_map=low), label="")
    name_y = float(re.findall(r'y="([0-9.]+)"[^>]*>nipple<', drawn)[0])
    assert name_y < frame.at((0.0, y_mm))[1]


def test_a_grid_of_half_a_square_centimetre_is_told_and_its_axes_fit_into_the_margin() -> None:
    small = replace(without_lump().maps[0], tactile_map=grid_map(np.ones((6, 8)), count=1))
    page = Page(exam_page(ShownExam((small,), None, ())))
    assert "covered 0.48 cm² (how often each place was read is not known)" in page.words
    sizes = [float(one["font-size"]) for one in page.named("text", **{"class": "edge"})]
    assert len(sizes) == 4
    assert 1.5 * max(sizes) <= MARGIN_MM  # two bold letters


def test_codes_stand_on_the_page_to_their_last_letter() -> None:
    subject, mass = (f"{name}{'0' * 29}7" for name in ("P1", "M1"))
    page = Page(exam_page(exam(({"subject": subject, "mass": mass}, {"subject": subject, "mass": f"{mass[:-1]}8"}))))
    for text in (subject, f"{mass}, {mass[:-1]}8"):
        assert text in page.words


def test_the_age_of_the_array_calibration_is_reported() -> None:
    aged = ({**SCANS[0], "array_calibration_days": "12"},)
    assert "12 days old at the exam" in Page(exam_page(exam(aged))).words
    assert "age not stated" in Page(exam_page(exam(({**SCANS[0], "array_calibration_days": "<b>"},)))).words


def test_a_page_from_python_is_the_same_and_private(tmp_path: Path) -> None:
    found = tb.estimate(tb.demo_map())
    found.report(tmp_path / "a.html")
    found.report(tmp_path / "b.html", title="Demo")
    assert (tmp_path / "a.html").stat().st_mode & 0o777 == 0o600
    assert "<h1>Demo</h1>" in (tmp_path / "b.html").read_text()
    assert (tmp_path / "a.html").read_text().replace("Tactile exam", "Demo") == (tmp_path / "b.html").read_text()
    with pytest.raises(tb.errors.UsageError, match="exists"):
        found.report(tmp_path / "a.html")


def full() -> ShownExam:
    """As much as one sheet can hold: repeats, masses, a caution, checks, long texts, a tall map."""
    tactile_map, report = demo()
    reason = "a reason that is long " * 20
    masses = tuple(unsized(reason, number=n, reported=n == 1) for n in range(1, 12))
    told = replace(report, masses=masses)
    entries = tuple(finding("few_strokes" if n else "side", f"finding {n} " * 80) for n in range(9))
    tall = replace(tactile_map, patient_from_plane=np.eye(4)[[1, 0, 2, 3]] * np.array([1, 1, -1, 1])[:, None])
    pooled = pooled_as(report, 12, findings=entries)
    facts = dict.fromkeys(("subject", "posture", "examiner", "visit", "mass"), "W" * 99)
    scans = tuple({**facts, "side": "left", "sha256": f"{n}" * 64, "subject": f"{n}" + "W" * 99} for n in range(12))
    maps = (exam_map(tall, told, side="left"),) * 12
    return ShownExam(maps, pooled, scans, PageLabels("W" * 60, "W" * 50, "2026-03-01"))


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no Chromium is installed")
@pytest.mark.parametrize("made", [exam, without_lump, full])
def test_a_page_prints_to_one_side_and_to_the_same_bytes(made: Any) -> None:
    page = exam_page(made())
    first, second = (find_printer()(page) for _ in range(2))
    assert first.startswith(b"%PDF")
    assert len(re.findall(rb"/Type ?/Page\b", first)) == 1
    assert first == second
