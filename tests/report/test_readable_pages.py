"""Every page can be read by a screen reader and with the keyboard, as far as its elements tell; colours have contrast.

What an automated checker (axe-core) asks of a page, for those of its rules that a change here may break.
"""

from __future__ import annotations

import base64
import itertools
import re
from collections import Counter
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_map

import tactile_bayes as tb
from tactile_bayes.api.maps import Map
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.campaign_page import ExamEntry, MassEntry, VisitEntry, campaign_html
from tactile_bayes.report.pages import TEMPLATES

DEMO = Path(tb.__file__).parent / "demo"
HEARD = {"h1", "h2", "p", "img", "table", "li", "form", "figure"}  # what must lie within the main part


class Outline(HTMLParser):
    """Elements with their attributes, what lies outside the main part, and elements without a text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.outside: list[str] = []
        self.empty: list[str] = []
        self._main = False
        self._text: list[list[str]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._main |= tag == "main"
        if tag in HEARD and not self._main:
            self.outside.append(tag)
        if tag in ("th", "h1", "h2", "a"):
            self._text.append([])

    def handle_data(self, data: str) -> None:
        for text in self._text:
            text.append(data)

    def handle_endtag(self, tag: str) -> None:
        self._main &= tag != "main"
        if tag in ("th", "h1", "h2", "a") and not "".join(self._text.pop()).strip():
            self.empty.append(tag)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("pages")
    with_lump = tb.estimate(tb.demo_map(), method="laplace")
    without = tb.estimate(Map(bump_map(amplitude=0.0)), method="laplace")
    with_lump.report(folder / "exam.html")
    without.report(folder / "negative.html")
    noise = [0.01 * np.random.default_rng(seed).standard_normal((51, 51)) for seed in (1, 2)]
    visits = [Map(bump_map(noise=one, amplitude=0.3, x=0.0, y=0.0, sigma_x=4.0, sigma_y=4.0)) for one in noise]
    tb.compare(*visits, same_mass=True, days=[30], method="laplace").page(folder / "growth.html")
    given = ("--excision", DEMO / "excision.csv", "--html", "trial.html", "--methods")
    assert run_here("validate", DEMO / "trial.csv", *given, cwd=folder).returncode == 0
    size = Quantity(median=14.0, mean=14.0, sd=1.4, low=12.0, high=17.5, probability=0.95, kind="eti")
    exams = [
        ExamEntry("visit 1, exam 1", "", size, (), b"<svg/>", "exams/a/exam.html"),
        ExamEntry("visit 1, exam 2", "no lump", thumbnail=b"<svg/>", page="exams/b/exam.html"),
        ExamEntry("visit 1, exam 3", "map failed", failed=True),
    ]
    rows = [MassEntry("P1", "1", (VisitEntry("1", tuple(exams), size, 1),))]
    found = {path.stem: path.read_text() for path in folder.glob("*.html")}
    return found | {"campaign": campaign_html(rows, lines=["1 mass."], links={"a": "a.csv"})}


@pytest.mark.long
@pytest.mark.parametrize("kind", ["exam", "negative", "growth", "campaign", "trial"])
def test_a_page_is_read_from_its_elements(kind: str, pages: dict[str, str]) -> None:
    outline = Outline(pages[kind])
    count = Counter(tag for tag, _ in outline.tags)
    assert (count["main"], count["h1"], count["title"]) == (1, 1, 1)
    assert outline.outside == []
    assert outline.empty == []
    assert ("html", "en") in [(tag, attrs.get("lang")) for tag, attrs in outline.tags]
    assert all(attrs.get("alt") for tag, attrs in outline.tags if tag == "img")
    assert all(attrs.get("aria-label") and attrs.get("role") == "img" for tag, attrs in outline.tags if tag == "svg")
    assert {attrs.get("scope") for tag, attrs in outline.tags if tag == "th"} <= {"col", "row"}
    levels = [int(tag[1]) for tag, _ in outline.tags if re.fullmatch("h[1-6]", tag)]
    assert all(later <= earlier + 1 for earlier, later in itertools.pairwise([0, *levels]))
    scrolled = [attrs for tag, attrs in outline.tags if attrs.get("class") == "wide"]
    assert all(attrs.get("tabindex") == "0" for attrs in scrolled)
    assert "user-scalable" not in pages[kind]
    assert "Research use only" in pages[kind].partition("</h1>")[2][:700]  # before any result


def contrast(first: str, second: str) -> float:
    """Contrast ratio of two colours, WCAG 2.2."""

    def luminance(colour: str) -> float:
        digits = colour.lstrip("#")
        wide = digits if len(digits) == 6 else "".join(2 * one for one in digits)
        linear = [
            value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
            for value in (int(wide[i : i + 2], 16) / 255 for i in (0, 2, 4))
        ]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    bright, dark = sorted((luminance(first), luminance(second)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)


def least_contrast(colours: set[str], background: str) -> float:
    """The worst of several colours against one."""
    return min(contrast(one, background) for one in colours)


def test_every_colour_of_a_text_has_a_contrast_of_four_and_a_half() -> None:
    style = (TEMPLATES / "style.css").read_text()
    assert contrast("#777", "#fff") == pytest.approx(4.48, abs=0.01)  # the published example of one that fails
    assert (
        least_contrast(set(re.findall(r"[{;]color:(#[0-9a-f]{3,6})", style.partition("@media(prefers")[0])), "#fff")
        >= 4.5
    )
    row_marks = set(re.findall(r"border-left:4px \w+ (#[0-9a-f]{3,6})", style.partition(".campaign{")[2]))
    schemes = [
        dict(re.findall(r"--(\w+):(#[0-9a-f]{3,6})", one)) for one in re.findall(r"\{[^{}]*--ink:[^{}]*\}", style)
    ]
    links = ["#0000ee", *re.findall(r"\.campaign a\{color:(#[0-9a-f]{3,6})", style)]
    for named, link in zip(schemes, links, strict=True):
        assert least_contrast({named["ink"], named["soft"], named["doubt"], link}, named["paper"]) >= 4.5
        assert contrast(named["ink"], named["mark"]) >= 4.5
        assert least_contrast(row_marks, named["paper"]) >= 3.0


def test_the_live_page_has_contrast() -> None:
    """White on black edges for the names on the map; its bar and its words against what lies behind them."""
    page = resources.files("tactile_bayes.hardware").joinpath("live_page.html").read_text(encoding="utf-8")
    assert page.count("<h1>") == 1
    style = page.partition("<style")[2].partition("</style>")[0]
    rule = dict(re.findall(r"(\S[^{}\n]*?) \{ ([^}]*)\}", style))
    assert least_contrast({"#eee", *re.findall(r"color: (#\w+)", rule["footer"])}, "#111") >= 4.5
    assert ("color: #eee" in rule["body"], "background: #111" in rule["body"]) == (True, True)
    assert {"fill: #fff", "stroke: #000", "paint-order: stroke"} <= set(rule["svg text"].strip().split("; "))
    behind = re.findall(r"background: (#\w+)", rule["#bar"])[0]
    bars = set(re.findall(r"#level \{[^}]*background: (#\w+)", style))
    assert len(bars) == 3
    assert least_contrast(bars, behind) >= 3.0


Box = tuple[float, float, float, float]


def painted(svg: str) -> Iterator[tuple[str, dict[str, str], str]]:
    """Elements of an inline drawing with their words, in the order in which they are painted."""
    for tag, attrs, words in re.findall(r"<(path|rect|circle|image|text)\b([^>]*)>([^<]*)", svg):
        yield tag, dict(re.findall(r'([\w-]+)="([^"]*)"', attrs)), words


def box_of(attrs: dict[str, str]) -> Box:
    x, y, width, height = (float(attrs.get(name, 0)) for name in ("x", "y", "width", "height"))
    return x, y, x + width, y + height


def behind(x: float, y: float, boxes: list[tuple[Box, str]]) -> str:
    """What was painted last at a point: a colour, or "image"; the paper where nothing was."""
    return next((what for (a, b, c, d), what in reversed(boxes) if a <= x <= c and b <= y <= d), "#fff")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["exam", "negative", "growth", "campaign"])
def test_text_and_lines_of_drawings_have_contrast(kind: str, pages: dict[str, str]) -> None:
    """What axe-core cannot decide: text against the box behind it, on a picture text and lines against their edge."""
    seen = 0
    for svg in re.findall(r"<svg.*?</svg>", pages[kind], re.DOTALL):
        boxes: list[tuple[Box, str]] = []
        edges: dict[tuple[str | None, ...], str] = {}
        for tag, attrs, words in painted(svg):
            fill, stroke = attrs.get("fill", "#000"), attrs.get("stroke", "#000")
            what = (words, attrs.get("x"), attrs.get("y"), attrs.get("d"))
            if tag == "image":
                boxes.append((box_of(attrs), "image"))
            elif tag == "rect" and fill != "none":
                boxes.append((box_of(attrs), fill))
            elif tag == "text" and fill != "none":
                back = edges.get(what) or behind(float(attrs["x"]), float(attrs["y"]), boxes)
                assert contrast(fill, back) >= 4.5, (words, fill, back)
                seen += 1
            elif tag == "path":
                assert contrast(stroke, edges.get(what, "#fff")) >= 3.0, (attrs["d"], stroke)
            if tag in ("text", "path"):
                edges[what] = stroke
    assert seen > 2


Style = dict[str, str]
Drawn = tuple[ElementTree.Element, str, Style]


def figures_of(page: str) -> list[ElementTree.Element]:
    """The figures that stand in a page as images."""
    found = re.findall(r'<img[^>]*src="data:image/svg\+xml;base64,([^"]*)"', page)
    return [ElementTree.fromstring(base64.b64decode(one)) for one in found]


def drawn(element: ElementTree.Element, part: str = "", style: Style | None = None) -> Iterator[Drawn]:
    """What a figure shows, in the order in which it is painted: the element, the part it is of, and its style."""
    style = (style or {}) | dict(re.findall(r"([\w-]+): ([^;]+)", element.get("style", "")))
    part = f"{part}/{element.get('id', '')}".rstrip("/")
    name = element.tag.rpartition("}")[2]
    if name in ("path", "use"):
        yield element, part, style
    for inner in element if name not in ("defs", "clipPath") else ():
        yield from drawn(inner, part, style)


def mixed(colour: str, share: float, back: str) -> str:
    """A colour that lets through what is behind it."""
    top, under = (np.array([int(one[i : i + 2], 16) for i in (1, 3, 5)]) for one in (colour, back))
    return "#" + "".join(f"{round(value):02x}" for value in share * top + (1 - share) * under)


@pytest.mark.long
def test_text_and_lines_of_a_trials_figures_have_contrast(pages: dict[str, str]) -> None:
    """Each text against all that was painted before within the figure's own ground; lines and dots against the paper.

    Frames of legends part nothing that their text does not, and bands are told by the lines within them.
    """
    figures = figures_of(pages["trial"])
    assert len(figures) == pages["trial"].count("<img") >= 3
    for figure in figures:
        boxes: list[tuple[Box, str]] = []
        words = 0
        for element, part, style in drawn(figure):
            fill, stroke = style.get("fill", "#000000"), style.get("stroke", "none")
            if "/text_" in part:
                continue
            back = "#ffffff"
            if fill != "none" and "patch" in part:
                points = np.array(re.findall(r"-?[\d.]+", element.get("d", "")), dtype=float).reshape(-1, 2)
                box = (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())
                share = float(style.get("opacity", style.get("fill-opacity", 1)))
                under = behind((box[0] + box[2]) / 2, (box[1] + box[3]) / 2, boxes).replace("#fff", "#ffffff")[:7]
                boxes.append((box, mixed(fill, share, under)))
            elif "legend" not in part or "line2d" in part:
                seen = max(contrast(one, back) for one in (fill, stroke) if one != "none")
                assert seen >= 3.0, (part, style)
        for group in figure.iter("{http://www.w3.org/2000/svg}g"):
            if not group.get("id", "").startswith("text_"):
                continue
            place = re.search(r"translate\(([\d.-]+) ([\d.-]+)\)", ElementTree.tostring(group, encoding="unicode"))
            assert place is not None
            fills = {style.get("fill", "#000000") for _, _, style in drawn(group)}
            ground = behind(float(place[1]), float(place[2]), boxes)
            assert least_contrast(fills, ground) >= 4.5, (group.get("id"), fills, ground)
            words += 1
        assert words > 20
