"""Sums of readings in cells: those of a loop over the readings, whatever comes with a reading in one call."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.mapping.accumulate import FrameSource, frame_sources
from tactile_bayes.mapping.cells import PRESSURE_STEP_KPA, CellSums, Readout, add_frames, chunk_frames
from tactile_bayes.mapping.select import select_frames
from tactile_bayes.scans import ElementCalibration, Scan


def rough_scan(seed: int, *, frames: int = 40) -> Scan:
    """Awkward gains, some saturated readings, a dead taxel, a head that is turned: nothing is a round number."""
    rng = np.random.default_rng(seed)
    head = scans.flat_head(rows=5, columns=4, lever_mm=(3.3, -7.1, 41.0))
    scan = scans.make_scan(
        rng.normal(0, 8, (frames, 2)), field=scans.gaussian(), head=head, yaw_deg=rng.normal(0, 9, frames)
    )
    counts = scan.frames.counts.copy()
    counts[rng.random(counts.shape) < 0.003] = 65535
    counts[:, 2, 1] = 0
    spread = scans.GAIN_KPA * (1 + 0.03 * rng.standard_normal((5, 4)))
    calibration = ElementCalibration(spread, 0.05 * rng.standard_normal((5, 4)), saturation_count=65535)
    return Scan(scans.with_counts(scan, counts).frames, scan.poses, head, calibration)


def source_of(seed: int, cell_mm: float) -> FrameSource:
    selected = select_frames(rough_scan(seed), pressure_window_kpa=(2.0, 30.0))
    (source,) = frame_sources([selected], plane_from_base=np.eye(4), cell_mm=cell_mm)
    return source


def summed(source: FrameSource, level: np.ndarray, cell_mm: float, *, size: int) -> CellSums:
    sums = CellSums(cell_mm)
    for part, counts in source.parts(size):
        pressure, valid = source.selection.readout.pressure_kpa(counts)
        add_frames(sums, pressure, valid, projection=source.projection.part(part), level=level[part])
    return sums.trimmed()


def by_loop(source: FrameSource, level: np.ndarray, limit: float) -> tuple[dict[tuple[int, int], list[int]], int]:
    """Count, sum and sum of squares in steps of 2^-12 by cell, and how many were clipped, reading by reading."""
    cells: dict[tuple[int, int], list[int]] = {}
    clipped = 0
    ((_, counts),) = source.parts(10_000)
    place = source.projection.taxels[:3]
    for f, frame in enumerate(counts.tolist()):
        matrix = source.projection.matrix[f]
        for k, count in enumerate(frame):
            pressure = count * source.selection.readout.gain_kpa[k] + source.selection.readout.offset_kpa[k]
            if count >= source.selection.readout.full_count or pressure >= 34.0:
                continue
            step = round(pressure * (4096 / level[f]))
            clipped += abs(step) > limit
            step = round(min(max(step, -limit), limit))
            column, row = (int(np.floor(matrix[axis, :3] @ place[:, k] + matrix[axis, 3])) for axis in (0, 1))
            held = cells.setdefault((row, column), [0, 0, 0])
            cells[row, column] = [held[0] + 1, held[1] + step, held[2] + step * step]
    return cells, clipped


@pytest.mark.parametrize("limit", [2.0**18, 4200.0])
@pytest.mark.parametrize("cell_mm", [0.7, 2.0])
@pytest.mark.parametrize("seed", range(2))
def test_sums_are_those_of_a_loop_over_the_readings(seed, cell_mm, limit, monkeypatch):
    monkeypatch.setattr("tactile_bayes.mapping.cells.LIMIT_STEPS", limit)
    source = source_of(seed, cell_mm)
    level = source.selection.level_kpa[source.selection.used]
    expected, clipped = by_loop(source, level, limit)
    assert clipped > 0 or limit > 4200.0
    for size in (1, 7, chunk_frames(20)):
        sums = summed(source, level, cell_mm, size=size)
        held = {
            (row + sums.first[0], column + sums.first[1]): [int(sums.count[row, column]), total, square]
            for row, column in np.argwhere(sums.count > 0).tolist()
            for total, square in [(int(sums.total[row, column]), int(sums.square[row, column]))]
        }
        assert (held, sums.clipped) == (expected, clipped)


@given(seed=st.integers(0, 99), frames=st.integers(1, 7))
def test_a_level_does_not_depend_on_its_neighbours(seed, frames):
    scan = rough_scan(seed, frames=20)
    readout = Readout.of(scan.element_calibration, np.ones((5, 4), dtype=bool))
    counts = readout.counts(scan.frames.counts)

    def levels(some: np.ndarray) -> np.ndarray:
        return readout.levels(*readout.pressure_kpa(some))[0]

    parts = [levels(counts[start : start + frames]) for start in range(0, 20, frames)]
    assert np.array_equal(np.concatenate(parts), levels(counts), equal_nan=True)


def test_a_level_of_rounded_pressures_would_depend_on_the_order():
    """The control to the test above: gains off the grid make the order of adding show."""
    rng = np.random.default_rng(0)
    pressure = rng.integers(0, 4096, (50, 416)) * (rng.random(416) * 0.01)
    assert not np.array_equal(pressure.sum(axis=1), pressure[:, ::-1].sum(axis=1))
    whole = np.rint(pressure / PRESSURE_STEP_KPA) * PRESSURE_STEP_KPA
    assert np.array_equal(whole.sum(axis=1), whole[:, ::-1].sum(axis=1))
