"""Visits of a trial: the readings of the last one before excision are analysed, and an unknown order is refused."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import pytest
from in_process import run_here

from tactile_bayes.errors import BadDataError
from tactile_bayes.trial.readings import OtherVisits, Reading, at_excision, visits_in_order

MASS = ("P1", "1")
JAN, MARCH, MAY = date(2026, 1, 10), date(2026, 3, 10), date(2026, 5, 10)


def fault(row: int, column: str, what: str, /, *, way_out: str) -> BadDataError:
    return BadDataError(f"row {row}, column {column}: {what}", way_out=way_out)


def reading(visit: str | None, size: float, day: date | None = None, modality: str = "tactile") -> Reading:
    return Reading(MASS, modality, 1, "detected", size, visit=visit, day=day)


def kept(*readings: Reading, excised: date | None = None) -> tuple[list[float | None], OtherVisits]:
    analysed, other = at_excision(readings, {MASS: excised}, fault=fault)
    return [one.size_mm for one in analysed], other


def test_the_last_numbered_visit_is_analysed_and_the_rest_counted() -> None:
    sizes, other = kept(reading("10", 22.0), reading("9", 16.0), reading("9", 17.0))
    assert sizes == [22.0]
    assert (other.masses, other.earlier, other.later) == (1, 2, 0)
    assert other.lines()[0].endswith("readings left out: 2 of earlier visits")


def test_a_table_without_visits_or_with_one_is_left_as_it_is() -> None:
    for visits in ((None, None), ("1", "1"), ("first", "first")):
        sizes, other = kept(*(reading(visit, size) for visit, size in zip(visits, (16.0, 22.0), strict=True)))
        assert sizes == [16.0, 22.0]
        assert other.lines() == []


def test_dates_give_the_order_of_visits_that_are_names_and_leave_out_those_after_excision() -> None:
    rows = (reading("early", 16.0, JAN), reading("late", 22.0, MARCH), reading("control", 3.0, MAY))
    assert kept(*rows)[0] == [3.0]
    sizes, other = kept(*rows, excised=date(2026, 4, 1))
    assert sizes == [22.0]
    assert (other.earlier, other.later) == (1, 1)


def test_a_visit_at_which_nothing_was_done_is_none() -> None:
    missed = Reading(MASS, "tactile", 2, "not_done", visit="2")
    sizes, other = kept(reading("1", 16.0), missed)
    assert sizes == [16.0, None]
    assert other.lines() == []


def test_a_reading_on_the_day_of_excision_is_before_it() -> None:
    assert kept(reading(None, 16.0, JAN), reading(None, 22.0, MARCH), excised=MARCH)[0] == [22.0]


def test_other_modalities_without_a_visit_stay_and_those_of_earlier_visits_alone_are_reported() -> None:
    rows = (
        reading("1", 16.0), reading("2", 22.0), reading(None, 20.0, modality="cbe"),
        reading("1", 15.0, modality="ultrasound"),
    )  # fmt: skip
    sizes, other = kept(*rows)
    assert sizes == [22.0, 20.0]
    assert other.lines()[1] == "ultrasound: 1 mass left out, read at other visits alone"


REFUSED = {
    "names": ((reading("pre", 16.0), reading("post", 22.0)), "row 1, column visit: pre and post of one mass"),
    "stems": ((reading("a1", 16.0), reading("b2", 22.0)), "a1 and b2 of one mass"),
    "one day": ((reading("x", 16.0, JAN), reading("y", 22.0, JAN)), "x and y of one mass do not say which was first"),
    "a blank": ((reading("1", 16.0), reading("2", 22.0), reading(None, 20.0)), "row 2, column visit: is blank"),
    "a date alone": ((reading("1", 16.0), reading("2", 22.0), reading(None, 20.0, MAY)), "row 2, column visit: is bl"),
    "contradicted": ((reading("1", 16.0, MARCH), reading("2", 22.0, JAN)), "visit 2 is of 2026-01-10, before visit 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_an_order_that_is_not_known_is_refused_at_its_row(name: str) -> None:
    rows, told = REFUSED[name]
    with pytest.raises(BadDataError) as caught:
        kept(*rows)
    assert told in str(caught.value)
    assert caught.value.way_out


def test_an_excision_before_every_visit_is_refused() -> None:
    with pytest.raises(BadDataError, match="row 0, column date: visit 1 is after excision on"):
        kept(reading("1", 16.0, MARCH), reading("2", 22.0, MAY), excised=JAN)


def test_a_visit_numbered_after_one_that_follows_excision_follows_it_too() -> None:
    rows = (reading("1", 16.0, JAN), reading("2", 5.0, MAY), reading("3", 4.0))
    sizes, other = kept(*rows, excised=MARCH)
    assert sizes == [16.0]
    assert (other.earlier, other.later) == (0, 2)
    assert kept(*rows, excised=None)[0] == [4.0]  # control: where nothing is known to follow it, the last is analysed


def test_a_visit_with_readings_on_both_sides_of_excision_is_refused_at_the_later_one() -> None:
    rows = (reading("1", 18.0, JAN), reading("2", 16.0, JAN), reading("2", 5.0, MAY))
    for some in (rows, rows[1:]):
        with pytest.raises(BadDataError, match=f"row {len(some) - 1}, column date: is 2026-05-10, after excision on"):
            kept(*some, excised=MARCH)
    assert kept(*rows, excised=MAY)[0] == [16.0, 5.0]


def test_a_date_after_excision_that_contradicts_the_visits_numbers_is_refused() -> None:
    with pytest.raises(BadDataError, match="visit 2 is of 2026-01-10, before visit 1 of 2026-05-10"):
        kept(reading("1", 16.0, MAY), reading("2", 22.0, JAN), excised=MARCH)


def test_visits_are_ordered_by_dates_numbers_or_codes_that_are_dates() -> None:
    assert visits_in_order({"V10": None, "V9": None}) == ["V9", "V10"]
    assert visits_in_order({"2026-03-01": None, "2025-12-31": None}) == ["2025-12-31", "2026-03-01"]
    assert visits_in_order({"b": JAN, "a": MARCH}) == ["b", "a"]
    assert visits_in_order({"b": JAN, "a": None}) is None


TRIAL = """patient,mass,modality,replicate,visit,date,size_mm,status
P1,1,tactile,1,1,2026-01-10,16.0,detected
P1,1,tactile,2,1,2026-01-10,16.4,detected
P1,1,tactile,3,2,2026-03-10,22.0,detected
P1,1,tactile,4,2,2026-03-10,22.4,detected
P2,1,tactile,1,1,2026-01-10,10.0,detected
P2,1,tactile,2,1,2026-01-10,10.3,detected
P1,1,cbe,1,,,25.0,detected
"""
EXCISION = "patient,mass,ex_vivo_mm,date\nP1,1,22,2026-03-12\nP2,1,10,2026-02-01\n"


def written(folder: Path, trial: str = TRIAL, excision: str = EXCISION) -> tuple[str, ...]:
    (folder / "trial.csv").write_text(trial)
    (folder / "ex.csv").write_text(excision)
    return "validate", "trial.csv", "--excision", "ex.csv"


def test_validate_says_on_its_second_line_what_it_left_out_and_holds_no_growth(tmp_path: Path) -> None:
    """Both visits pooled would differ by 22 % within the mass; the control leaves the visits blank."""
    done = run_here(*written(tmp_path), "-v", cwd=tmp_path)
    first = done.stdout.splitlines()[:2]
    assert "5 readings" in first[0]
    assert first[1] == (
        "1 mass was read at several visits: the last one before excision is analysed, readings left out: "
        "2 of earlier visits"
    )
    assert "tactile: within one mass, by 4 readings of 2 masses: mean SD 0.25 mm" in done.stdout
    blind = "\n".join(
        ",".join(cell for i, cell in enumerate(line.split(",")) if i not in (4, 5)) for line in TRIAL.split()
    )
    control = run_here(*written(tmp_path, blind), "-v", cwd=tmp_path)
    assert "left out: 2 of earlier visits" not in control.stdout
    assert "by 6 readings of 2 masses: mean SD 1.8 mm" in control.stdout


def test_validate_refuses_a_date_that_is_none(tmp_path: Path) -> None:
    done = run_here(*written(tmp_path, TRIAL.replace("2026-03-10", "10.3.2026")), cwd=tmp_path)
    assert done.returncode == 3
    assert "line 4, column date: '10.3.2026' is no date; write it as 2026-03-01" in done.stderr


def test_a_wide_table_says_the_visits_in_its_mapping(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(
        'patient = "id"\n[excision]\nsize = "path"\ndate = "op"\n'
        '[[reading]]\nmodality = "tactile"\nreplicate = 1\nsize = "first"\nvisit = "1"\ndate = "on_1"\n'
        '[[reading]]\nmodality = "tactile"\nreplicate = 2\nsize = "second"\nvisit = "2"\ndate = "on_2"\n'
    )
    (tmp_path / "wide.csv").write_text(
        "id,path,op,first,on_1,second,on_2\nP1,22,2026-03-12,16,2026-01-10,22,2026-03-10\n"
        "P2,10,2026-02-01,10,2026-01-10,2,2026-03-10\n"
    )
    done = run_here("validate", "wide.csv", "--excision", "wide.csv", "--columns", "map.toml", cwd=tmp_path)
    assert "2 masses were read at several visits" in done.stdout
    assert "readings left out: 1 of earlier visits, 1 after excision" in done.stdout
