"""The contact sheet: self-contained, every text escaped, worst first, with a script that may run and no other."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from plain_reports import estimate_report
from posterior_maps import bump_map

from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import Point
from tactile_bayes.findings import Finding
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.pages import FAILED, SIZED, UNSIZED, Card, campaign_html, worst
from tactile_bayes.report.svg import LONGEST_PX, thumbnail_png

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


def page_of(*cards: Card) -> str:
    return campaign_html(cards, lines=["3 exams."], links={"trial.csv": "trial.csv"}, version="1")


def told(text: str) -> tuple[Finding, ...]:
    return (Finding("side", text, about=text), Finding("few_strokes", text, on_paper=text))


def card_of(text: str) -> Card:
    return Card(text, UNSIZED, (text,), text, None, told(text), b"png", {text: text})


def test_hostile_texts_add_no_tag_and_no_attribute() -> None:
    plain, hostile = Tags(page_of(card_of("plain"))), Tags(page_of(card_of(HOSTILE)))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert [set(attrs) for _, attrs in hostile.tags] == [set(attrs) for _, attrs in plain.tags]
    assert hostile.ends == plain.ends
    assert HOSTILE in [attrs.get("href") for _, attrs in hostile.tags]


def test_a_text_that_is_not_escaped_would_be_found() -> None:
    page = page_of(card_of("plain")).replace("plain", HOSTILE, 1)
    assert [tag for tag, _ in Tags(page).tags] != [tag for tag, _ in Tags(page_of(card_of("plain"))).tags]


def test_the_page_loads_nothing_and_runs_its_own_script_alone() -> None:
    page = page_of(card_of("one"))
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


def test_the_worst_come_first() -> None:
    cards = [
        Card("narrow", SIZED, size=replace(SIZE, low=13.5, high=14.5)),
        Card("wide", SIZED, size=SIZE),
        Card("checked", SIZED, size=SIZE, findings=(Finding("few_strokes", "a"), Finding("curved_skin", "b"))),
        Card("doubtful", SIZED, size=SIZE, findings=(Finding("side", "a"),)),
        Card("empty", UNSIZED, reason="no lump"),
        Card("lost", FAILED, reason="map failed: damaged"),
    ]
    names = [card.name for card in worst(cards, 10)]
    assert names == ["lost", "empty", "doubtful", "checked", "wide", "narrow"]


def test_each_exam_can_be_filtered_by_its_status_and_its_flags() -> None:
    page = page_of(
        Card("a", FAILED, reason="x"), Card("b", SIZED, size=SIZE, findings=(Finding("few_strokes", "look"),))
    )
    found = {attrs["data-status"]: attrs["data-flagged"] for tag, attrs in Tags(page).tags if tag == "article"}
    assert found == {FAILED: "no", SIZED: "yes"}
    options = [attrs["value"] for tag, attrs in Tags(page).tags if tag == "option"]
    assert options == ["", FAILED, UNSIZED, SIZED]
    assert "<form hidden>" in page  # shown by the script: without one every exam is shown


@pytest.mark.parametrize("shape", [(40, 60), (900, 300)])
def test_a_thumbnail_is_small_whatever_the_map(shape: tuple[int, int]) -> None:
    import io

    from PIL import Image

    from tactile_bayes.mapping.map import MapRecipe, TactileMap

    ny, nx = shape
    values = 1.0 + 0.01 * np.random.default_rng(1).standard_normal(shape)
    tactile_map = TactileMap(
        values,
        np.ones(shape),
        np.full(shape, 9),
        np.arange(nx, dtype=float),
        np.arange(ny, dtype=float),
        MapRecipe("grid", "gain", 1.0),
    )
    png = thumbnail_png(tactile_map, NO_SIZE)
    assert png is not None
    width, height = Image.open(io.BytesIO(png)).size
    assert LONGEST_PX / 2 < max(width, height) <= LONGEST_PX
    assert png == thumbnail_png(tactile_map, NO_SIZE)


def test_the_ring_lies_about_the_lump() -> None:
    """The lump of `bump_map` is the brightest cell; the ring is white and its middle is there."""
    import io

    from PIL import Image

    tactile_map = bump_map(noise=np.zeros((51, 51)), amplitude=0.3, sigma_x=4.0, sigma_y=4.0)
    row, column = np.unravel_index(np.nanargmax(tactile_map.mean), tactile_map.mean.shape)
    centre = [replace(SIZE, median=float(at)) for at in (tactile_map.x_mm[column], tactile_map.y_mm[row])]
    across, along = (replace(SIZE, median=value) for value in (12.0, 8.0))
    png = thumbnail_png(tactile_map, replace(NO_SIZE, centre_mm=Point(*centre), d_x_mm=across, d_y_mm=along))
    assert png is not None
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    scale = pixels.shape[0] / tactile_map.mean.shape[0]
    ring = np.argwhere((pixels == 255).all(axis=-1))
    brightest = np.argwhere((pixels[..., 0] > 240) & (pixels[..., 2] < 60)).mean(axis=0)
    assert np.abs(ring.mean(axis=0) - brightest).max() < scale
    assert np.ptp(ring[:, 1]) / scale == pytest.approx(12.0 / tactile_map.recipe.cell_mm, abs=1.0)
    assert np.ptp(ring[:, 0]) / scale == pytest.approx(8.0 / tactile_map.recipe.cell_mm, abs=1.0)
