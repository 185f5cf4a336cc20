"""The live page in a headless Chromium: what it shows and what it sounds."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, Page, opened
from emulated_devices import short_scan
from PIL import Image
from test_live import seen_of
from test_orientation import UPPER_RIGHT, corner, live_state, lump_in_base

from tactile_bayes.declarations import replace
from tactile_bayes.hardware.live import LiveMap, LiveServer, page_state

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed"),
]


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with opened(tmp_path / "profile", width=900, height=900) as tab:
        yield tab


def test_the_page_shows_the_map_and_its_tone_tells_low_in_range_and_high(page, tmp_path):
    scan = short_scan(1.0)
    live = LiveMap(scan.head, scan.element_calibration)
    live.take(seen_of(scan))
    state = live.state(size="largest size 15.0 mm (13.1 to 17.2, 95 % equal-tailed)")
    server = LiveServer("127.0.0.1", 0)
    try:
        page.call("Page.navigate", url=server.url)
        page.until("document.readyState === 'complete' && socket.readyState === 1")
        page.value("element('sound').click()")
        for kpa, tone, hz in ((3.0, "low", 220), (9.5, "in", 440), (17.0, "high", 880), (8.0, "in", 440)):
            server.show(replace(state, pressure_kpa=kpa))
            page.until(f"document.body.dataset.tone === '{tone}'")
            page.until(f"window.tone().running && Math.abs(window.tone().hz - {hz}) < 1")
        server.show(replace(state, pressure_kpa=float("nan")))
        page.until("document.body.dataset.tone === 'off'")
        server.show(state)
        page.until("document.body.dataset.tone === 'in'")
        rows, columns = state.tactile_map.mean.shape
        assert page.value("[element('map').height, element('map').width]") == [rows, columns]
        assert page.value("element('size').textContent") == state.size
        bright = page.value(
            "(() => { const c = element('map').getContext('2d'); const d = c.getImageData(0, 0, "
            f"{columns}, {rows}).data; let n = 0; for (let i = 0; i < d.length; i += 4) "
            "if (d[i] > 200 && d[i + 1] > 200 && d[i + 3] === 255) n++; return n; })()"
        )
        assert 0 < bright < np.isfinite(state.tactile_map.mean).sum() / 4
        sent = page_state(state)["map"]
        drawn = page.value(f"Array.from(element('map').getContext('2d').getImageData(0, 0, {columns}, {rows}).data)")
        shown = np.array(drawn).reshape(rows, columns, 4)
        known = np.array([one is not None for one in sent["levels"]]).reshape(rows, columns)
        np.testing.assert_array_equal(shown[..., 3] == 255, known)
        texts = page.value("Array.from(document.querySelectorAll('#over text')).map((one) => one.textContent)")
        assert texts[:5] == [*(sent["edges"][side] for side in ("left", "right", "top", "bottom")), "10 mm"]
        assert page.value("element('words').textContent") == sent["words"]
        shot = base64.b64decode(page.call("Page.captureScreenshot")["data"])
        (tmp_path / "page.png").write_bytes(shot)
        assert len(shot) > 5000
    finally:
        server.close()
    page.until("document.body.dataset.tone === 'off'")


@pytest.mark.parametrize("head_deg", [270, 0, None])
def test_the_page_draws_the_lump_on_the_upper_right(page, head_deg):
    state = live_state(head_deg)
    state = replace(state, lump_base_mm=lump_in_base(head_deg))
    server = LiveServer("127.0.0.1", 0)
    try:
        page.call("Page.navigate", url=server.url)
        page.until("document.readyState === 'complete' && socket.readyState === 1")
        server.show(state)
        page.until("document.querySelectorAll('#over text').length > 0")
        shot = base64.b64decode(page.call("Page.captureScreenshot")["data"])
        box = page.value(
            "(() => { const b = element('map').getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
        )
    finally:
        server.close()
    left, top, width, height = (round(one) for one in box)
    pixels = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)[
        top : top + height, left : left + width
    ]
    rows, columns = np.nonzero(pixels.max(axis=2) > 10)
    drawn = pixels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    yellow = (drawn[..., 0] > 180) & (drawn[..., 1] > 180) & (drawn[..., 2] < 100)
    assert yellow.sum() > 50
    assert corner(np.where(yellow, 1.0, 0.0)) == UPPER_RIGHT
