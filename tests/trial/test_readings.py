"""Readings: rules between cells, gathering by mass, and what reordering or rescaling must not change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.declarations import to_plain
from tactile_bayes.errors import BadDataError
from tactile_bayes.files.tables import Table
from tactile_bayes.trial.figures import JACKKNIFE
from tactile_bayes.trial.readings import ModalitySizes, Reading, Trial, readings_from_columns
from tactile_bayes.trial.summary import FAMILIES, TrialReport, summarise

COLUMNS = ("patient", "mass", "modality", "replicate", "size_mm", "status", "low_mm", "high_mm", "probability")


def table(*cells: Any) -> Table:
    columns = {name: [cell] for name, cell in zip(COLUMNS, cells, strict=True)} | {"synthetic": [None]}
    return Table(path=Path("trial.csv"), columns=columns, line_numbers=[7])


ROWS = {
    "size without status": ((9.5, None, None, None, None), ["status", "is blank beside size_mm 9.5"]),
    "no size": ((None, "detected", None, None, None), ["size_mm", "is blank while status is detected"]),
    "size not found": ((9.5, "not_detected", None, None, None), ["size_mm", "is 9.5 while status is not_detected"]),
    "size not done": ((9.5, "not_done", None, None, None), ["size_mm", "not_done"]),
    "half an interval": ((9.5, "detected", 8.0, None, 0.9), ["high_mm", "is blank"]),
    "no probability": ((9.5, "detected", 8.0, 11.0, None), ["probability", "is blank"]),
    "upside down": ((9.5, "detected", 12.0, 11.0, 0.9), ["low_mm", "is 12, above high_mm 11"]),
    "interval not found": ((None, "not_detected", 8.0, 11.0, 0.9), ["low_mm", "while status is not_detected"]),
}


def test_a_row_blank_in_size_and_status_was_not_done() -> None:
    blank = table("P1", "1", "cbe", 1, None, None, None, None, None)
    (reading,) = readings_from_columns(blank.columns, fault=blank.error)
    assert (reading.status, reading.size_mm) == ("not_done", None)


@pytest.mark.parametrize("name", ROWS)
def test_cells_that_contradict_each_other_are_refused_where_they_stand(name: str) -> None:
    cells, words = ROWS[name]
    bad = table("P1", "1", "tactile", 1, *cells)
    with pytest.raises(BadDataError) as caught:
        readings_from_columns(bad.columns, fault=bad.error)
    message = str(caught.value)
    assert message.startswith("trial.csv: line 7, column ")
    assert caught.value.way_out
    for word in words:
        assert word in message


def test_a_whole_row_becomes_a_reading() -> None:
    good = table("P1", "1", "tactile", 1, 9.5, "detected", 8.0, 11.0, 0.9)
    (reading,) = readings_from_columns(good.columns, fault=good.error)
    assert reading.key == ("P1", "1")
    assert reading.interval is not None
    assert (reading.interval.low_mm, reading.interval.probability) == (8.0, 0.9)
    assert not reading.synthetic


def test_gather_averages_found_replicates_and_counts_the_rest() -> None:
    ex_vivo = {("A", "1"): 10.0, ("A", "2"): 20.0, ("B", "1"): 30.0, ("C", "1"): 40.0}
    readings = [
        Reading(("B", "1"), "tactile", 1, "not_detected"),
        Reading(("A", "1"), "tactile", 3, "detected", 12.0),
        Reading(("A", "1"), "tactile", 1, "detected", 8.0),
        Reading(("A", "1"), "tactile", 2, "not_detected"),
        Reading(("A", "2"), "tactile", 1, "not_done"),
        Reading(("A", "1"), "cbe", 1, "detected", 9.0),
    ]
    gathered = Trial(readings, ex_vivo).sizes()
    assert list(gathered) == ["tactile", "cbe"]
    tactile = gathered["tactile"]
    assert tactile.size_mm.tolist() == [10.0, 0.0]
    assert tactile.replicates_mm[0].tolist() == [8.0, 12.0]
    assert tactile.patient.tolist() == [0, 1]
    assert (tactile.readings, tactile.masses_not_done, tactile.masses_without_reading) == (4, 1, 1)


SIZE = st.one_of(st.just(0.0), st.floats(min_value=1, max_value=60))
TRIALS = st.lists(
    st.tuples(st.floats(min_value=5, max_value=45), st.lists(SIZE, min_size=1, max_size=4), SIZE),
    min_size=1,
    max_size=12,
)
Rows = list[tuple[float, list[float], float]]
NOTHING = ModalitySizes("cbe", np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), ())
FIGURES = [name for family in FAMILIES for name in family(NOTHING, intervals=JACKKNIFE)]


def report_of(rows: Rows, *, scale: float = 1.0, shuffle: Any = None) -> TrialReport:
    """Three masses to two patients; size 0 stands for not found."""
    ex_vivo = {(f"P{2 * i // 3}", f"{i}"): scale * e for i, (e, _, _) in enumerate(rows)}
    readings = []
    for key, (_, tactile, cbe) in zip(ex_vivo, rows, strict=True):
        for modality, group in (("tactile", tactile), ("cbe", [cbe])):
            for replicate, y in enumerate(group, start=1):
                status = "detected" if y else "not_detected"
                readings.append(Reading(key, modality, replicate, status, scale * y if y else None))
    return summarise(Trial(shuffle(readings) if shuffle else readings, ex_vivo))


@pytest.mark.long
@given(rows=TRIALS, data=st.data())
def test_the_order_of_rows_changes_nothing(rows: Rows, data: st.DataObject) -> None:
    shuffled = report_of(rows, shuffle=lambda readings: data.draw(st.permutations(readings)))
    assert to_plain(shuffled, digits=12) == to_plain(report_of(rows), digits=12)


@pytest.mark.long
@pytest.mark.parametrize("scale", [1e-6, 2.0, 1e12])
@given(rows=TRIALS)
def test_other_units_change_millimetres_and_nothing_else(scale: float, rows: Rows) -> None:
    before, after = report_of(rows), report_of(rows, scale=scale)
    for name, one in before.modalities.items():
        for key in FIGURES:
            value, other = one.figure(key), after.modalities[name].figure(key)
            unit = scale if key.endswith("_mm") else 1.0
            assert (value.value is None) == (other.value is None), key
            assert value.reason == other.reason
            if value.value is not None:
                assert other.value == pytest.approx(unit * value.value, rel=1e-6, abs=1e-9 * unit), key


@given(rows=TRIALS, factor=st.floats(min_value=0.2, max_value=5))
def test_sizes_times_a_factor_scale_the_slope_and_leave_every_r_squared(rows: Rows, factor: float) -> None:
    grown = [(e, [factor * y for y in tactile], factor * cbe) for e, tactile, cbe in rows]
    before, after = report_of(rows).modalities["cbe"], report_of(grown).modalities["cbe"]
    for key in ("r2_centred", "r2_uncentred", "r2_pearson"):
        assert after.figure(key).value == (
            None if (r2 := before.figure(key).value) is None else pytest.approx(r2, rel=1e-6, abs=1e-6)
        )
    slope = before.slope_through_origin
    assert slope is not None
    assert after.slope_through_origin == pytest.approx(factor * slope)


@given(rows=TRIALS)
def test_a_missed_mass_counts_as_an_error_of_100_percent(rows: Rows) -> None:
    cbe_report = report_of(rows).modalities["cbe"]
    n, found = len(rows), sum(cbe > 0 for _, _, cbe in rows)
    counted = 100 * (n - found) + found * (cbe_report.mape_detected_percent or 0.0)
    assert cbe_report.mape_percent == pytest.approx(counted / n)
