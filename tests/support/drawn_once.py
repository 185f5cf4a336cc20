"""The pictures of a trial's page, drawn once for a number of panels: for tests of what leads to the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from tactile_bayes.report import trial_html

_drawn: dict[int, bytes] = {}
_draw = trial_html._svg


def _svg(panels: Sequence[Any], *, alike: bool = False) -> bytes:
    number = len(panels)
    if number not in _drawn:
        _drawn[number] = _draw(panels, alike=alike)
    return _drawn[number]


@pytest.fixture(scope="module", autouse=True)
def drawn_once() -> Iterator[None]:
    """Give back a picture that was drawn before, whatever it shows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trial_html, "_svg", _svg)
        yield
