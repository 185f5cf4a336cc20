"""Masses that may be one lump are told with the length over both; those apart are not."""

from __future__ import annotations

import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.files.reports import AnotherExam, Interval, MassReport, Place
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.report.estimate_document import mass_words, sized_masses, touching_findings, touching_masses


def mass(number: int, x: float, size: float | None, *, half: float = 1.0) -> MassReport:
    """A mass on the x axis, with the ends of its interval `half` mm from its size."""
    found = None
    if size is not None:
        ends = {"low": size - half, "high": size + half}
        found = Quantity(median=size, mean=size, sd=half / 2, probability=0.95, kind="eti", **ends)
    unknown = ("centre_patient_mm", "amplitude", "min_size_mm", "d_x_mm", "d_y_mm", "angle_deg", "another_exam")
    return MassReport(
        number=number,
        reported=number == 1,
        centre_mm=Place(x, 0.0),
        max_size_mm=found,
        detected_probability=1.0,
        reason="too deep",
        reason_code="",
        advice="",
        **dict.fromkeys(unknown),
    )


def test_balls_in_a_row_are_as_long_as_their_distance_and_radii() -> None:
    """Two balls of 12 and 8 mm that touch are 20 mm long: geometry."""
    (pair,) = touching_masses(sized_masses([mass(1, 0.0, 12.0), mass(2, 10.0, 8.0)]))
    assert pair.masses == (1, 2)
    assert pair.apart_mm == 10.0
    assert pair.together_mm == Interval(20.0, 19.0, 21.0, 0.95)


def test_they_touch_where_the_upper_ends_of_the_intervals_meet() -> None:
    assert touching_masses(sized_masses([mass(1, 0.0, 12.0), mass(2, 10.9, 8.0)]))
    # the controls: farther than that, or surer
    assert not touching_masses(sized_masses([mass(1, 0.0, 12.0), mass(2, 11.1, 8.0)]))
    assert not touching_masses(sized_masses([mass(1, 0.0, 12.0, half=0.5), mass(2, 10.9, 8.0, half=0.5)]))


def test_a_small_one_within_the_outline_of_a_large_one_adds_nothing() -> None:
    (pair,) = touching_masses(sized_masses([mass(1, 0.0, 20.0), mass(2, 3.0, 6.0)]))
    assert pair.together_mm.median == 20.0


def test_a_mass_without_a_size_takes_no_part() -> None:
    assert not touching_masses(sized_masses([mass(1, 0.0, 12.0), mass(2, 9.0, None)]))


@pytest.mark.parametrize(("x", "told"), [(10.0, True), (30.0, False)])
def test_the_line_of_the_other_mass_tells_it(x: float, told: bool) -> None:
    first, second = mass(1, 0.0, 12.0), mass(2, x, 8.0)
    words = "may be one lump with mass 1, together 20.0 mm long (19.0 to 21.0)"
    assert (words in mass_words(second, first)) == told
    found = touching_findings(sized_masses([first, second]))
    assert [one.text for one in found] == (
        ["masses 1 and 2 may be one lump: together 20.0 mm long (19.0 to 21.0)"] if told else []
    )


def test_the_length_in_words_has_the_interval_that_reports_lead_with() -> None:
    """For exams that differ as patients' do: each mass had the wider interval, and both together the narrower one."""
    pair = [mass(1, 0.0, 12.0), mass(2, 10.0, 8.0)]
    wider = [mass(1, 0.0, 12.0, half=3.0).max_size_mm, mass(2, 10.0, 8.0, half=2.0).max_size_mm]
    pair = [replace(one, another_exam=AnotherExam(0.15, size, size, {})) for one, size in zip(pair, wider, strict=True)]
    assert "together 20.0 mm long (17.5 to 22.5)" in mass_words(pair[1], pair[0])
    assert [one.text for one in touching_findings(sized_masses(pair))] == [
        "masses 1 and 2 may be one lump: together 20.0 mm long (17.5 to 22.5)"
    ]
    (found,) = touching_masses(sized_masses(pair))  # the file's is of `max_size_mm`
    assert found.together_mm == Interval(20.0, 19.0, 21.0, 0.95)
