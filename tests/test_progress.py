"""The progress bar keeps out of pipes and out of short work."""

from __future__ import annotations

import io

import pytest

from tactile_bayes.batch import run_batch
from tactile_bayes.shell import QUIET_S, progress_bar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_nothing_is_drawn_into_a_pipe():
    stream, clock = io.StringIO(), Clock()
    with progress_bar("cases", stream=stream, clock=clock) as progress:
        clock.now += 60
        progress(1, 2)
    assert stream.getvalue() == ""


@pytest.mark.parametrize("time_left", [True, False])
def test_a_log_gets_a_line_now_and_then_with_the_hours_left_where_these_are_known(time_left):
    stream, clock = io.StringIO(), Clock()
    with progress_bar("steps", stream=stream, clock=clock, log_every_s=60.0, time_left=time_left) as progress:
        for done in range(0, 121, 10):
            progress(done, 20_000)
            clock.now += 10.0
        progress(130, 20_000)
        clock.now += 60.0
        progress(20_000, 20_000)
    assert stream.getvalue().splitlines() == [
        "steps: 60 of 20000 done" + ", 5:32:20 left" * time_left,
        "steps: 120 of 20000 done" + ", 5:31:20 left" * time_left,
        "steps: 20000 of 20000 done",
    ]


def test_work_of_a_moment_draws_no_progress():
    stream, clock = Terminal(), Clock()
    with progress_bar("cases", stream=stream, clock=clock) as progress:
        for done in range(3):
            progress(done, 3)
            clock.now += QUIET_S / 4
    assert stream.getvalue() == ""


def test_long_work_is_counted_with_the_time_left_and_the_line_is_cleared():
    stream, clock = Terminal(), Clock()
    with progress_bar("cases", stream=stream, clock=clock) as progress:
        progress(0, 3)
        clock.now += 50.0
        progress(1, 3)
        drawn = stream.getvalue()
        progress(2, 3)  # too soon to draw again
        assert stream.getvalue() == drawn
    assert drawn == "\rcases [##########--------------------] 1/3 1:40 left"
    assert stream.getvalue().endswith("\r" + " " * (len(drawn) - 1) + "\r")


def test_what_an_earlier_run_did_is_not_counted_as_speed():
    stream, clock = Terminal(), Clock()
    with progress_bar("cases", stream=stream, clock=clock) as progress:
        progress(90, 100)
        clock.now += 10.0
        progress(91, 100)
        assert stream.getvalue().endswith("91/100 1:30 left")


def test_a_shorter_line_covers_a_longer_one():
    stream, clock = Terminal(), Clock()
    with progress_bar("cases", stream=stream, clock=clock) as progress:
        progress(0, 3)
        clock.now += 50.0
        progress(1, 3)
        first = len(stream.getvalue())
        clock.now += 50.0
        progress(3, 3)
        second = stream.getvalue()[first:]
    assert len(second) == first
    assert second.rstrip() == "\rcases [##############################] 3/3"


def test_the_line_is_cleared_when_the_work_fails():
    stream, clock = Terminal(), Clock()

    def interrupted() -> None:
        with progress_bar("cases", stream=stream, clock=clock) as progress:
            clock.now += 50.0
            progress(1, 3)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert stream.getvalue().endswith("\r")


def test_a_batch_draws_its_progress():
    stream, clock = Terminal(), Clock()
    with progress_bar("items", stream=stream, clock=clock) as progress:
        clock.now += 50.0
        run_batch(str, [1, 2], key=str, progress=progress)
    assert "items [" in stream.getvalue()


def test_work_without_items_draws_nothing():
    stream, clock = Terminal(), Clock()
    with progress_bar("items", stream=stream, clock=clock) as progress:
        clock.now += 50.0
        progress(0, 0)
    assert stream.getvalue() == ""
