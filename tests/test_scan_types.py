"""The scan types: what they refuse, in which words, and that they keep the caller's arrays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.scans import ElementCalibration, HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

Q = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
P = np.zeros((2, 3))
COUNTS = np.zeros((2, 3, 4), dtype=np.uint16)
SURFACE = np.zeros((3, 4, 3))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PressureFrames(np.array([1.0, 0.5]), COUNTS), "frame_time_s runs backwards at index 1"),
        (lambda: PressureFrames(np.array([-1.0, 0.5]), COUNTS), "starts at -1"),
        (lambda: PressureFrames(np.array([0.0, np.nan]), COUNTS), "frame_time_s has 1 values that are not finite"),
        (lambda: PressureFrames(np.array([0.0]), COUNTS), "for 1 frame times"),
        (lambda: PressureFrames(np.array([0.0, 1.0]), COUNTS.astype(float)), "counts is float64"),
        (lambda: PressureFrames(np.array([0.0, 1.0]), COUNTS[:, :0]), "counts is uint16 of shape .2, 0, "),
        (lambda: TrackerPoses(np.array([0.0, 1.0]), P, 2 * Q), "norm 2 at index 0"),
        (lambda: TrackerPoses(np.array([0.0, 1.0]), P[:1], Q), "position_mm has shape"),
        (lambda: HeadGeometry(SURFACE, 0.0, np.eye(4)), "pitch_mm is 0.0"),
        (lambda: HeadGeometry(SURFACE, 1.5, 2 * np.eye(4)), "not a rigid transform"),
        (lambda: HeadGeometry(SURFACE, 1.5, np.diag([1.0, 1.0, -1.0, 1.0])), "not a rigid transform .it mirrors"),
        (
            lambda: HeadGeometry(SURFACE, 1.5, np.eye(4) + 55 * np.eye(4, k=-1)[[0, 0, 0, 3]]),
            "its last row is not 0 0 0 1",
        ),
        (lambda: ElementCalibration(-np.ones((3, 4)), np.zeros((3, 4))), "negative at"),
        (lambda: ElementCalibration(np.ones((3, 4)), np.zeros((4, 3))), "offset_kpa has shape"),
        (lambda: Landmarks(np.zeros(2), np.zeros(3)), "sternal_notch_mm has shape"),
    ],
)
def test_a_faulty_value_is_named(make: Callable[[], object], words: str) -> None:
    with pytest.raises(BadDataError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_head_and_counts_must_have_the_same_taxels() -> None:
    frames = PressureFrames(np.array([0.0, 1.0]), COUNTS)
    poses = TrackerPoses(np.array([0.0, 1.0]), P, Q)
    calibration = ElementCalibration(np.ones((3, 4)), np.zeros((3, 4)))
    with pytest.raises(BadDataError, match=r"surface_mm is for \(4, 3\)"):
        Scan(frames, poses, HeadGeometry(np.zeros((4, 3, 3)), 1.5, np.eye(4)), calibration)


def test_the_view_is_read_only_and_the_callers_array_is_not() -> None:
    counts = COUNTS.copy()
    frames = PressureFrames(np.array([0.0, 1.0]), counts)
    with pytest.raises(ValueError, match="read-only"):
        frames.counts[0, 0, 0] = 1
    counts[0, 0, 0] = 1


@pytest.mark.parametrize(("count", "expected"), [(0, 0.5), (100, 1.5), (4094, 41.44), (4095, np.nan)])
def test_saturated_readings_carry_no_pressure(count: int, expected: float) -> None:
    calibration = ElementCalibration(np.full((1, 1), 0.01), np.full((1, 1), 0.5))
    pressure = calibration.to_kpa(np.full((1, 1, 1), count, dtype=np.uint16))
    # Beyond 34 kPa the element is at the end of its range, whatever the converter says.
    np.testing.assert_allclose(pressure[0, 0, 0], expected if expected < 34 else np.nan)


def test_a_quaternion_beyond_all_squares_is_refused_without_a_warning() -> None:
    with pytest.raises(BadDataError, match="quaternion_wxyz has norm inf at index 0"):
        TrackerPoses(np.array([0.0, 1.0]), np.zeros((2, 3)), np.full((2, 4), 1e200))
