"""The index of a campaign: self-contained, every text escaped, worst first, with a script that may run and no other."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from plain_reports import estimate_report
from posterior_maps import bump_map

from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import EstimateReport, Point
from tactile_bayes.findings import Finding, finding, finding_lines
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.campaign_page import (
    FAILED,
    SIZED,
    UNSIZED,
    WORST_FIRST,
    ExamEntry,
    MassEntry,
    VisitEntry,
    campaign_html,
    worst,
)
from tactile_bayes.report.exam_words import exam_map, reason_on_paper
from tactile_bayes.report.pages import Growth
from tactile_bayes.report.svg import THUMB_SCALE, thumbnail_svg

SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = "\"><img src=x onerror=alert(1)><script>alert(2)</script>'&lt; </p></article></main>"
SIZE = Quantity(median=14.0, mean=14.0, sd=1.4, low=12.0, high=17.5, probability=0.95, kind="eti")
NO_SIZE = estimate_report()


class Tags(HTMLParser):
    """Every tag with its attributes, in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.ends: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        self.ends.append(tag)

    def count(self, name: str) -> int:
        return sum(tag == name for tag, _ in self.tags)


def page_of(*rows: MassEntry) -> str:
    return campaign_html(rows, lines=["3 exams."], links={"trial.csv": "trial.csv"})


def told(text: str) -> tuple[Finding, ...]:
    return (finding("side", text, about=text), finding("few_strokes", text, on_paper=text))


def row_of(text: str) -> MassEntry:
    exam = ExamEntry(text, text, None, told(text), b"<svg/>", text, {text: text})
    grown = Growth(text, text, text, text, "failed", text, link=text)
    return MassEntry(text, text, (VisitEntry(text, (exam,), why=text),), text, grown)


def mass(name: str, *exams: ExamEntry, size: Quantity | None = None) -> MassEntry:
    return MassEntry(name, "1", (VisitEntry("1", exams, size),))


def sized(size: Quantity, *findings: Finding) -> ExamEntry:
    return ExamEntry("visit 1, exam 1", size=size, findings=findings)


def test_hostile_texts_add_no_tag_and_no_attribute() -> None:
    plain, hostile = Tags(page_of(row_of("plain"))), Tags(page_of(row_of(HOSTILE)))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert [set(attrs) for _, attrs in hostile.tags] == [set(attrs) for _, attrs in plain.tags]
    assert hostile.ends == plain.ends
    assert HOSTILE in [attrs.get("href") for _, attrs in hostile.tags]


def test_a_text_that_is_not_escaped_would_be_found() -> None:
    page = page_of(row_of("plain")).replace("plain", HOSTILE, 1)
    assert [tag for tag, _ in Tags(page).tags] != [tag for tag, _ in Tags(page_of(row_of("plain"))).tags]


def test_the_page_loads_nothing_and_runs_its_own_script_alone() -> None:
    page = page_of(row_of("one"))
    found = Tags(page)
    policy = next(attrs["content"] for tag, attrs in found.tags if attrs.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    script = re.search(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    assert policy == f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert all((attrs.get("src") or "data:").startswith("data:") for _, attrs in found.tags)
    assert found.count("link") == found.count("iframe") == 0
    assert "http://" not in page
    assert "https://" not in page
    assert RESEARCH_USE in page


def test_the_worst_come_first_as_the_page_says() -> None:
    failed, narrow = ExamEntry("visit 1, exam 2", "map failed", failed=True), replace(SIZE, low=13.5, high=14.5)
    rows = [
        mass("narrow", sized(narrow), size=narrow),
        mass("wide", sized(SIZE), size=SIZE),
        mass("checked", sized(SIZE, finding("few_strokes", "a"), finding("curved_skin", "b")), size=SIZE),
        mass("doubtful", sized(SIZE, finding("side", "a")), size=SIZE),
        mass("one lost", sized(narrow), failed, size=narrow),
        mass("empty", ExamEntry("visit 1, exam 1", "no lump")),
        mass("lost", failed),
    ]
    names = [row.patient for row in worst(rows, 10)]
    assert names == ["lost", "empty", "one lost", "doubtful", "checked", "wide", "narrow"]
    assert WORST_FIRST in page_of(*rows)


def test_a_mass_is_of_its_last_visit_and_names_the_exams_that_a_finding_is_of() -> None:
    doubt = finding("side", "words")
    visits = (
        VisitEntry("1", (sized(SIZE, doubt),), SIZE),
        VisitEntry("2", (ExamEntry("visit 2, exam 1", "no lump"),), why="no lump"),
    )
    row = MassEntry("P", "1", visits)
    assert (row.status, row.last.size) == (UNSIZED, None)
    assert [text for _, text in row.remarks] == [f"{finding_lines((doubt,), paper=True)[0]} (visit 1, exam 1)"]


def test_what_speaks_against_a_comparison_is_told_once_beside_what_speaks_against_its_exams() -> None:
    of_exam, of_pair = finding("side", "another side"), finding("taken_as_one", "two places")
    visits = tuple(VisitEntry(code, (sized(SIZE, of_exam),), SIZE) for code in "12")
    growth = Growth("P", "1", "1", "2", "compared", verdict="grown", findings=(of_exam.labelled("visit 1"), of_pair))
    row = MassEntry("P", "1", visits, growth=growth)
    assert [text for _, text in row.remarks] == finding_lines((of_exam, of_pair), paper=True)
    page = page_of(row)
    assert page.count("two places") == 1
    assert ">grown<" in page
    assert "for exams that differ as simulated ones do where this site's own are not known" in page


def test_each_mass_can_be_filtered_and_put_in_order() -> None:
    page = page_of(
        mass("a", ExamEntry("visit 1, exam 1", "x")),
        mass("b", sized(SIZE, finding("few_strokes", "look")), size=SIZE),
    )
    found = {attrs["data-status"]: attrs["data-flagged"] for tag, attrs in Tags(page).tags if "data-status" in attrs}
    assert found == {UNSIZED: "no", SIZED: "yes"}
    options = [attrs["value"] for tag, attrs in Tags(page).tags if tag == "option"]
    assert options == ["", FAILED, UNSIZED, SIZED, "worst", "patient", "size", "width"]  # no change with one visit
    keys = [key for key in options[4:] if f"data-{key}=" not in page]
    assert keys == []
    assert "<form hidden>" in page  # shown by the script: without one every mass is shown


def shown(tactile_map: TactileMap, report: EstimateReport = NO_SIZE) -> ET.Element:
    text = thumbnail_svg(exam_map(tactile_map, report, side=""), label="Map")
    assert text == thumbnail_svg(exam_map(tactile_map, report, side=""), label="Map")
    return ET.fromstring(text)


def grid(shape: tuple[int, int], values: np.ndarray | float = 1.0) -> TactileMap:
    ny, nx = shape
    x, y = np.arange(nx, dtype=float), np.arange(ny, dtype=float)
    ones = np.ones(shape)
    return TactileMap(values * ones, ones, np.full(shape, 99), x, y, MapRecipe("grid", "gain", 1.0))


@pytest.mark.parametrize(("shape", "scale"), [((40, 60), THUMB_SCALE), ((900, 300), 48 / 900)])
def test_thumbnails_are_to_one_scale_where_there_is_room_and_have_a_bar(shape: tuple[int, int], scale: float) -> None:
    picture = shown(grid(shape))
    width, height = (float(one) for one in picture.get("viewBox", "").split()[2:])
    assert (width - 1, height - 1) == pytest.approx((scale * shape[1], scale * shape[0]), abs=0.02)
    bar = next(one.get("d", "") for one in picture.iter(f"{SVG}path") if one.get("class") == "scale")
    label = next(one.text for one in picture.iter(f"{SVG}text") if (one.text or "").endswith(" mm"))
    assert float(bar.split("h")[1]) == pytest.approx(scale * float(label.split()[0]), rel=0.01)


def pixels_of(picture: ET.Element) -> np.ndarray:
    data = next(picture.iter(f"{SVG}image")).get("href", "").split(",", 1)[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)


def test_a_value_has_one_colour_on_every_thumbnail() -> None:
    """A cell 20 % above the level, on a map that is else flat and on one with a cell four times as high."""
    values = np.ones((20, 20))
    values[4, 4] = 1.2
    high = values.copy()
    high[15, 15] = 4.0
    one, other = (pixels_of(shown(grid((20, 20), v)))[4, 4] for v in (values, high))
    assert one == pytest.approx(other, abs=3)
    flat = pixels_of(shown(grid((20, 20), 1.0)))[4, 4]
    assert np.abs(one - flat).max() > 20


def test_the_ring_lies_about_the_lump() -> None:
    """The lump of `bump_map` is the brightest cell; the ring's middle is there, and it is as large as the size."""
    tactile_map = bump_map(noise=np.zeros((51, 51)), amplitude=0.3, sigma_x=4.0, sigma_y=4.0)
    row, column = np.unravel_index(np.nanargmax(tactile_map.mean), tactile_map.mean.shape)
    centre = [replace(SIZE, median=float(at), sd=0.1) for at in (tactile_map.x_mm[column], tactile_map.y_mm[row])]
    across, along = (replace(SIZE, median=value) for value in (12.0, 8.0))
    report = replace(NO_SIZE, centre_mm=Point(*centre), d_x_mm=across, d_y_mm=along, max_size_mm=SIZE, min_size_mm=SIZE)
    picture = shown(tactile_map, report)
    path = next(one.get("d", "") for one in picture.iter(f"{SVG}path") if one.get("class") == "size")
    points = np.array([[float(n) for n in pair.split()] for pair in path.strip("MZ").split("L")])
    assert np.ptp(points, axis=0) == pytest.approx(THUMB_SCALE * np.array([12.0, 8.0]), rel=0.02)
    bright = np.argwhere(pixels_of(picture)[..., 0] == pixels_of(picture)[..., 0].max()).mean(axis=0)[::-1]
    assert points.mean(axis=0) == pytest.approx(THUMB_SCALE * (bright + 0.5), abs=THUMB_SCALE)


def test_a_reason_on_paper_names_no_place_of_the_map() -> None:
    ridge = replace(NO_SIZE, reason="what rises near (-21.9, -12.5) mm is a ridge, not a lump", reason_code="ridge")
    assert reason_on_paper(ridge) == "no lump found: what rises is long like a rib, not round like a lump"
    assert reason_on_paper(replace(ridge, reason_code="undetected")) == ridge.reason
