"""`tables` as a user runs it."""

from __future__ import annotations

import json
from collections.abc import Callable
from subprocess import CompletedProcess

import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_BAD_DATA
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.report.laboratory import heads_text, tables_document, tables_text
from tactile_bayes.studies.model_comparison import (
    NEAREST_HEADS,
    OTHER_DEFINITIONS,
    PRINTED_FRAMES,
    PRINTED_MAPS,
    TABLE_DEPTH_RATIOS,
    TABLE_DIAMETERS_MM,
    TRIED_HEADS,
    Agreement,
    phantom_scenes,
    table_distance,
    table_scenes,
)
from tactile_bayes.studies.paper import MapFit

Run = Callable[..., "CompletedProcess[str]"]


def agreement(scene) -> Agreement:
    others = ((0.2, 0.15, 0.1),) * len(OTHER_DEFINITIONS)
    return Agreement(
        scene, 0.05, 0.06, 0.01, 0.4, MapFit(0.3, (3.0, None), 0.01), MapFit(0.4, (3.5, None), 0.02), 0.03, others
    )


def test_the_tables_stand_beside_the_printed_ones_and_say_what_they_mean() -> None:
    lumps, phantoms = [agreement(s) for s in table_scenes(0.0)], [agreement(s) for s in phantom_scenes(0.0)]
    text = tables_text(lumps, phantoms, head=HeadSection())
    assert text.startswith("mean MSD: frames 5.0 % (printed 4.1), maps 1.0 % (printed 2.4)")
    assert "MSD = sum of squared differences over the sum of squares of the elastic model" in text
    assert "5.0 (4.1)" in text
    assert "1.0 (2.7)" in text
    assert "mean 5.0 (of the printed cells 4.1)" in text
    assert "40.0" in text  # the strict norm
    assert "phantom 18.75 mm" in text
    assert "RMS over the largest                20.0 (20-20)    15.0 (15-15)" in text
    assert max(map(len, text.partition("head: ")[2].partition("the empirical model")[0].splitlines())) <= 80
    beside = tables_text(lumps, phantoms, head=HeadSection(), nearest=TRIED_HEADS[0], beside=lumps)
    assert "5.0/5.0 (4.1)" in beside
    assert "the head nearest to the print: R 13 mm, shoulders-inside of 3 mm" in beside


def test_the_document_names_the_width_of_each_fit() -> None:
    rows = [agreement(scene) for scene in table_scenes(0.0)]
    (first, *_) = tables_document({HeadSection(): rows}, {HeadSection(): rows}, seat=0.0)["cases"]
    assert first["elastic"] == {"amplitude": 0.3, "sigma_mm": 3.0, "rms": 0.01, "resolved": True}
    assert (first["empirical"]["sigma_mm"], first["map_strict"]) == (3.5, 0.4)


def test_the_distance_from_the_printed_tables_is_0_for_them_and_is_what_ranks_the_heads() -> None:
    def printed(more: float) -> list[Agreement]:
        rows = []
        for scene in table_scenes(0.0):
            column = TABLE_DIAMETERS_MM.index(scene.d_mm)
            frame, of_map = PRINTED_FRAMES[scene.depth_ratio][column], PRINTED_MAPS[scene.depth_ratio][column]
            rows.append(replace(agreement(scene), centred_frame=(frame + more) / 100, map=(of_map + more) / 100))
        return rows

    assert set(PRINTED_MAPS) == set(TABLE_DEPTH_RATIOS)
    assert table_distance(printed(0.0)) == pytest.approx(0.0, abs=1e-12)
    assert table_distance(printed(1.5)) == pytest.approx(1.5)
    text = heads_text({TRIED_HEADS[0]: printed(2.0), TRIED_HEADS[1]: printed(0.5)})
    assert text.index("mm, outside of") < text.index("mm, inside of")


@pytest.mark.slow
@pytest.mark.parametrize("seat", NEAREST_HEADS)
def test_the_nearest_head_is_the_one_that_the_search_finds(seat: float, run_cli: Run) -> None:
    document = json.loads(run_cli("tables", "--seat", f"{seat:g}", "--heads", "--json").stdout)
    assert len(document["heads"]) == len(TRIED_HEADS)
    first = min(document["heads"], key=lambda head: head["distance"])
    nearest = NEAREST_HEADS[seat]
    assert (first["radius_mm"], first["shoulder_mm"], first["shoulders"]) == (
        nearest.radius_mm,
        nearest.shoulder_mm,
        nearest.shoulders,
    )


@pytest.mark.slow
def test_the_command_prints_both_forms(run_cli: Run) -> None:
    text = run_cli("tables", "--seat", "resting", "--workers", 2)
    assert text.returncode == 0, text.stderr
    assert "Research use only" in text.stdout
    document = json.loads(run_cli("tables", "--seat", "resting", "--json").stdout)
    assert document["schema"] == "tactile-bayes/tables/1"
    assert len(document["cases"]) == 10
    assert len(document["phantoms"]) == 4
    first = document["cases"][0]
    assert first["scene"]["d_mm"] == 5.0
    assert 0 < first["map"] < first["map_strict"]


def test_the_other_definitions_are_what_they_say() -> None:
    u, v = np.array([1.0, 2.0, 5.0]), np.array([1.0, 3.0, 4.0])
    found = [by(u, v) for by in OTHER_DEFINITIONS.values()]
    expected = [np.sqrt(2 / 26), 2 / 3 / 16, np.sqrt(2 / 3) / 4, 2 / 8, 2 / (26 - 64 / 3)]
    np.testing.assert_allclose(found, expected)


def test_an_unknown_seat_is_named(run_cli: Run) -> None:
    done = run_cli("tables", "--seat", "3")
    assert done.returncode == EXIT_BAD_DATA
    assert "seat is '3'" in done.stderr
