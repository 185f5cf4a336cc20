"""Make the pictures of docs/gallery.md: `python docs/make_gallery.py [FOLDER]`. It needs Chromium.

The page's own commands are run, in its order, in a folder of their own; what they write is photographed.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "support"))

from browser import opened  # noqa: E402
from doc_pages import Reader, commands_of  # noqa: E402

PAGE = ROOT / "docs" / "gallery.md"
IMAGES = ROOT / "docs" / "images"
SIZED = (
    "parseFloat(document.getElementById('figures')?.textContent) > 6"
    " && document.getElementById('size').textContent.includes('largest size')"
)
"""When the live view has a size near the end of its scan."""
LIVE = ("gallery-live.png", 900, 710)
# Picture -> the page that the commands write, and in pixels the width of the window and the height at which it is cut.
PICTURES = {
    "gallery-exam.png": ("out/exams/P02.v1.m1.r1/exam.html", 900, 1200),
    "gallery-growth.png": ("out/growth/P01.m1/growth.html", 900, 1200),
    "gallery-campaign.png": ("out/index.html", 1100, 1200),
    "gallery-trial.png": ("trial.html", 1000, 780),
}

FIGURES = {"demo_map.png": "demo/map.png", "demo_size.png": "demo/size.png"}
"""Pictures of other pages -> the figures that the commands write."""


def make(folder: Path) -> None:
    """Run the page's commands and write the pictures into a folder."""
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch) / "work"
        work.mkdir()
        Reader(work, Path(scratch) / "demos").follow(PAGE)
        for name, (written, width, most) in PICTURES.items():
            (folder / name).write_bytes(_page(work / written, width, most, Path(scratch) / name))
        for name, written in FIGURES.items():
            (folder / name).write_bytes(_small((work / written).read_bytes()))
        (folder / LIVE[0]).write_bytes(_live(work, Path(scratch) / "live"))


def _page(path: Path, width: int, most: int, profile: Path) -> bytes:
    with opened(profile, width=width, height=most) as tab:
        tab.photograph(path.as_uri())
        high = min(tab.value("Math.ceil(document.body.getBoundingClientRect().bottom) + 12"), most)
        size = {"width": width, "height": high, "deviceScaleFactor": 1, "mobile": False}
        tab.call("Emulation.setDeviceMetricsOverride", **size)
        return _small(tab.photograph())


def _live(work: Path, profile: Path) -> bytes:
    """The live view near the end of the scan that the page replays."""
    replay = next(one for one in commands_of(PAGE) if "replay" in one.words)
    words = [sys.executable, "-m", "tactile_bayes", *replay.words[1:], "--force"]
    process = subprocess.Popen(words, cwd=work, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    url = next(found[0] for line in process.stderr if (found := re.search(r"http://\S+", line)))
    with opened(profile, width=LIVE[1], height=LIVE[2]) as tab:
        png = tab.photograph(url, until=SIZED)
    process.communicate()
    return _small(png)


def _small(png: bytes) -> bytes:
    """The picture in 256 colours."""
    buffer = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else IMAGES)
