"""`tradeoff map`: cells, frames and strokes against the finest map, and what is said where nothing can be built."""

from __future__ import annotations

import itertools
import re
from functools import cache, partial
from pathlib import Path

import pytest
from published_schemas import check_document

import tactile_bayes
from tactile_bayes.api.estimating import estimate_inputs
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.mapping.select import first_seconds
from tactile_bayes.report.tradeoff import settings_text, tradeoff_file
from tactile_bayes.scans import Scan
from tactile_bayes.studies import estimate_tradeoff
from tactile_bayes.studies import tradeoffs as study
from tactile_bayes.studies.estimate_tradeoff import SIZE, WIDTHS, MeasuredSetting, StudyRun, Tradeoff
from tactile_bayes.studies.tradeoffs import measure_map

DEMO = Path(tactile_bayes.__file__).parent / "demo" / "scan.mcap"


@cache
def demo() -> Scan:
    return read_scan(DEMO)


@cache
def measured() -> Tradeoff:
    ticks = itertools.count()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "CELLS_MM", (0.5, 8.0))
        patch.setattr(study, "EVERY", (2, 1000))
        patch.setattr(study, "SHARES_OF_TIME", (0.01,))
        patch.setattr(estimate_tradeoff, "LONG_RUNS", (("importance", 0.01),))
        work = StudyRun(lambda: float(next(ticks)), 0.2, 1)
        return measure_map(demo(), inputs=partial(estimate_inputs, Settings()), work=work)


def row(label: str) -> MeasuredSetting:
    (found,) = (one for one in measured().rows if one.label == label)
    return found


@pytest.mark.long
def test_the_finest_map_is_the_reference():
    """The same map by the default's draws: what is left is their Monte-Carlo error."""
    finest = row("--cell-mm 0.5")
    size = finest.answer.quantities[SIZE]
    assert finest.ends_off_mm < max(4 * size.mc_error, 0.01 * (size.high - size.low))
    assert "cells of 0.5 mm" in measured().reference.words
    assert measured().reference.mc_error_mm < 0.02


@pytest.mark.long
def test_every_second_frame_changes_little():
    assert row("--every 2").ends_off_mm < 1.0


@pytest.mark.long
def test_cells_too_large_come_out_as_wrong():
    """The negative control: the lump's sigma is 5 mm, cells of 8 mm do not resolve it."""
    wrong = row("--cell-mm 8")
    assert wrong.answer.reported is None or wrong.median_off_mm > 5 * row("--cell-mm 1").median_off_mm
    assert measured().cheapest_sufficient() is not wrong


@pytest.mark.long
def test_what_cannot_be_built_or_sized_is_a_row_too():
    short = next(one for one in measured().rows if one.axis == study.TIME)
    for one in (short, row("--every 1000")):
        assert one.answer.reported is None
        assert one.answer.reason
        assert one.ends_off_mm is None
    pressure = row("--normalise none")
    assert set(pressure.answer.quantities) == set(WIDTHS)
    assert pressure.ends_off_mm is None
    text = settings_text(measured())
    assert "a width: this map has no size" in text
    assert re.search(r" map +est\. +size", text)
    check_document(to_plain(tradeoff_file(measured(), varied="map", provenance={})), "tradeoff.schema.json")


def test_a_scan_without_a_map_is_refused():
    short, inputs = first_seconds(demo(), 0.001), partial(estimate_inputs, Settings())
    with pytest.raises(BadDataError):
        measure_map(short, inputs=inputs, work=StudyRun(lambda: 0.0, 0.2, 1))
