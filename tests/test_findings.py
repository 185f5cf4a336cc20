"""Findings: their weight, their sentence for each audience, and the verdict that they lead to."""

from __future__ import annotations

import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import by_severity, counted, finding, finding_lines, finding_summary, first_of, verdict

CAUTION = finding("late_poses", "poses came late", remedy="--latency-ms auto", on_paper="map the scan again")
CHECK = finding("few_strokes", "the scan has 2 strokes only")


def test_a_caution_makes_a_result_doubtful_and_a_check_does_not():
    assert verdict([CHECK], answered=True) == "sound"
    assert verdict([CHECK, CAUTION], answered=True) == "doubtful"
    assert verdict([], answered=False) == "no_answer"


def test_cautions_come_first_and_each_finding_once():
    assert by_severity([CHECK, CAUTION, CHECK]) == (CAUTION, CHECK)


def test_what_is_found_on_several_maps_is_said_once():
    found = [CAUTION, *(one.labelled(f"map {number}") for number in (1, 2, 4) for one in (CHECK, CAUTION))]
    _, caution, check = finding_lines(found)
    assert caution == "CAUTION: map 1, map 2 and map 4: poses came late; --latency-ms auto."
    assert [check] == finding_summary(found, "check", most=2) == finding_lines(found, "check")


def test_paper_never_reads_an_option():
    assert CAUTION.sentence() == "poses came late; --latency-ms auto"
    assert CAUTION.labelled("map 2").sentence(paper=True) == "map 2: poses came late; map the scan again"


def test_an_unknown_kind_is_refused_with_the_kinds():
    with pytest.raises(BadDataError, match="finding of unknown kind 'nothing'"):
        finding("nothing", "text")


def test_a_number_has_its_noun_and_a_list_counts_what_it_leaves_out():
    assert [counted(1, "mass"), counted(0, "mass"), counted(2, "exam")] == ["1 mass", "0 masses", "2 exams"]
    assert [first_of("ab", 2), first_of("abcd", 2, "; ")] == ["a, b", "a; b (and 2 more)"]
