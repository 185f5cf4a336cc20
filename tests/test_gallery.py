"""docs/gallery.md: its commands run as printed, and its pictures are of what they write today."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER
from doc_pages import Reader
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs"))

import make_gallery  # noqa: E402

NAMES = [*make_gallery.PICTURES, make_gallery.LIVE[0]]
"""Of the gallery's own; `FIGURES` are of other pages."""
MOST_BYTES = 150_000


def grey(path: Path) -> np.ndarray:
    """The picture in 40 columns and 40 rows of grey."""
    small = Image.open(io.BytesIO(path.read_bytes())).convert("L").resize((40, 40))
    return np.asarray(small, dtype=np.float64).ravel()


def test_figures_of_other_pages_are_small():
    assert all((make_gallery.IMAGES / name).stat().st_size < MOST_BYTES for name in make_gallery.FIGURES)


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_is_small_and_shown_on_the_first_page_and_in_the_gallery(name):
    assert (make_gallery.IMAGES / name).stat().st_size < MOST_BYTES
    for page in ("index.md", "gallery.md"):
        assert re.search(rf"!\[[^\]]{{20,}}\]\(images/{name}\)", (ROOT / "docs" / page).read_text(encoding="utf-8")), (
            page
        )


def test_the_readme_has_three_small_pictures():
    shown = re.findall(r"!\[[^\]]{20,}\]\((\S+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(shown) == 3
    assert all((ROOT / one).stat().st_size < MOST_BYTES for one in shown)


@pytest.mark.slow
def test_the_pictures_are_of_what_the_commands_write(tmp_path):
    if BROWSER is None:
        work = tmp_path / "work"
        work.mkdir()
        Reader(work, tmp_path / "demos").follow(make_gallery.PAGE)
        pytest.skip("the page runs; no Chromium is installed to photograph with")
    make_gallery.make(tmp_path)
    for name in [*NAMES, *make_gallery.FIGURES]:
        # fonts and the moment of the live view differ; another page or an empty one would not be alike
        alike = np.corrcoef(grey(tmp_path / name), grey(make_gallery.IMAGES / name))[0, 1]
        assert alike > 0.6, (name, alike)
