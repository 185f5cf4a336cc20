"""Every page can be read by a screen reader and with the keyboard, as far as its elements tell; colours have contrast.

What an automated checker (axe-core) asks of a page, for those of its rules that a change here may break.
"""

from __future__ import annotations

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from in_process import run_here
from posterior_maps import bump_map

import tactile_bayes as tb
from tactile_bayes.api.maps import Map
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.campaign_page import FAILED, SIZED, UNSIZED, ExamEntry, MassRow, VisitEntry, campaign_html
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
        ExamEntry("visit 1, exam 1", SIZED, "", size, (), b"<svg/>", "exams/a/exam.html"),
        ExamEntry("visit 1, exam 2", UNSIZED, "no lump", thumbnail=b"<svg/>", page="exams/b/exam.html"),
        ExamEntry("visit 1, exam 3", FAILED, "map failed"),
    ]
    rows = [MassRow("P1", "1", (VisitEntry("1", tuple(exams), size, 1),))]
    found = {path.stem: path.read_text() for path in folder.glob("*.html")}
    return found | {"campaign": campaign_html(rows, lines=["1 mass."], links={"a": "a.csv"}, version="1")}


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
    scrolled = [attrs for tag, attrs in outline.tags if attrs.get("class") == "wide"]
    assert all(attrs.get("tabindex") == "0" for attrs in scrolled)
    assert "user-scalable" not in pages[kind]


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


def test_every_colour_of_a_text_has_a_contrast_of_four_and_a_half() -> None:
    style = (TEMPLATES / "style.css").read_text()
    assert contrast("#777", "#fff") == pytest.approx(4.48, abs=0.01)  # the published example of one that fails
    for colour in re.findall(r"[{;]color:(#[0-9a-f]{3,6})", style.partition("@media(prefers")[0]):
        assert contrast(colour, "#fff") >= 4.5, colour
    for scheme in re.findall(r"\{[^{}]*--ink:[^{}]*\}", style):
        named = dict(re.findall(r"--(\w+):(#[0-9a-f]{3,6})", scheme))
        assert all(contrast(named[name], named["paper"]) >= 4.5 for name in ("ink", "soft", "doubt"))
        assert contrast(named["ink"], named["mark"]) >= 4.5
