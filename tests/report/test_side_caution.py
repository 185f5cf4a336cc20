"""Side and landmarks that disagree: one function decides."""

from __future__ import annotations

import pytest

from tactile_bayes.mapping.map import side_findings

WORDS = (
    "the scan says left breast, and the landmarks put the lump 60 mm to the patient's right of the xiphoid: side or "
    "landmarks are wrong"
)


@pytest.mark.parametrize(
    ("side", "place", "told"),
    [
        ("left", (60.0, 90.0), WORDS),
        ("right", (-31.4, 90.0), WORDS.replace("left", "RIGHT").replace("right of", "left of").replace("60", "31")),
        ("left", (-60.0, 90.0), ""),
        ("right", (60.0, 90.0), ""),
        ("left", (19.9, 90.0), ""),
        ("left", (20.1, 90.0), WORDS.replace("60", "20")),
        ("", (60.0, 90.0), ""),
        ("phantom", (60.0, 90.0), ""),
        ("left", None, ""),
    ],
)
def test_it_is_told_where_both_are_known_and_disagree(side: str, place: tuple[float, float] | None, told: str) -> None:
    found = side_findings(side, place)
    assert [one.text for one in found] == ([told.replace("RIGHT", "right")] if told else [])
