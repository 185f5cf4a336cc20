"""Side and landmarks that disagree: one function decides."""

from __future__ import annotations

import numpy as np
import pytest

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.geometry import apply, inverse
from tactile_bayes.mapping.build import build_map
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


@pytest.mark.parametrize(("x_mm", "told"), [(40.0, True), (-40.0, False)])
def test_a_nipple_on_the_other_side_of_the_body_is_told(x_mm: float, told: bool) -> None:
    """Its lump had a place by the clock 150 mm from the nipple, and no caution."""
    scan = tb.demo_scan()
    plain = build_map(scan, every=8)
    base_from_patient = inverse(plain.patient_from_plane @ plain.plane_from_base)
    nipple = apply(base_from_patient, np.array([-x_mm, 90.0, 0.0]))  # the demo's breast is the right one
    scan = replace(scan, session={"side": "right"}, landmarks=replace(scan.landmarks, nipple_mm=nipple))
    found = [one.text for one in build_map(scan, every=8).findings if one.kind == "side"]
    assert ["the landmarks put the nipple 40 mm to the patient's left" in text for text in found] == [True] * told
