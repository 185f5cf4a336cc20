"""The two ways through the inner loops: one map, bit for bit, from either."""

from __future__ import annotations

import builtins

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.errors import UsageError
from tactile_bayes.mapping import build_map, engine, loops
from tactile_bayes.mapping.engine import LoopEngine, NumpyEngine, choose_engine, fast_is_installed
from tactile_bayes.mapping.frames import select_frames
from tactile_bayes.mapping.readout import PRESSURE_STEP_KPA, Readout
from tactile_bayes.scan import ElementCalibration, Scan

PLAIN = LoopEngine(loops.levels_loop, loops.scatter_loop)
needs_fast = pytest.mark.skipif(not fast_is_installed(), reason="the extra [fast] is not installed")


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


def mapped(scan: Scan, way: object, monkeypatch, **options):
    monkeypatch.setattr("tactile_bayes.mapping.build.choose_engine", lambda *_, **__: way)
    return build_map(scan, pressure_window_kpa=(2.0, 30.0), **options)


def same(one, two) -> bool:
    names = ("mean", "variance", "count", "x_mm", "y_mm")
    return all(np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True) for name in names)


@pytest.mark.parametrize("normalise", ["mean", "none"])
@pytest.mark.parametrize("cell_mm", [0.7, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_loops_give_the_bits_of_numpy(seed, cell_mm, normalise, monkeypatch):
    scan = rough_scan(seed)
    by_numpy = mapped(scan, NumpyEngine(), monkeypatch, cell_mm=cell_mm, normalise=normalise)
    by_loops = mapped(scan, PLAIN, monkeypatch, cell_mm=cell_mm, normalise=normalise)
    assert same(by_numpy, by_loops)
    assert by_numpy.quality == by_loops.quality


@needs_fast
@pytest.mark.parametrize("normalise", ["mean", "none", "gain"])
def test_compiled_loops_give_the_bits_of_numpy(normalise):
    scan = rough_scan(5, frames=300)
    options = {"pressure_window_kpa": (2.0, 30.0), "normalise": normalise}
    assert same(build_map(scan, engine="numpy", **options), build_map(scan, engine="fast", **options))


@given(seed=st.integers(0, 99), frames=st.integers(1, 7))
def test_a_level_does_not_depend_on_its_neighbours(seed, frames):
    scan = rough_scan(seed, frames=20)
    levels = NumpyEngine().levels
    readout = Readout.of(scan.element_calibration, np.ones((5, 4), dtype=bool))
    counts = readout.counts(scan.frames.counts)
    whole = levels(readout, counts)[0]
    parts = [levels(readout, counts[start : start + frames])[0] for start in range(0, 20, frames)]
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)
    assert np.array_equal(PLAIN.levels(readout, counts)[0], whole, equal_nan=True)


def test_a_level_of_rounded_pressures_would_depend_on_the_order():
    """The control to the test above: gains off the grid make the order of adding show."""
    rng = np.random.default_rng(0)
    pressure = rng.integers(0, 4096, (50, 416)) * (rng.random(416) * 0.01)
    assert not np.array_equal(pressure.sum(axis=1), pressure[:, ::-1].sum(axis=1))
    whole = np.rint(pressure / PRESSURE_STEP_KPA) * PRESSURE_STEP_KPA
    assert np.array_equal(whole.sum(axis=1), whole[:, ::-1].sum(axis=1))


def test_a_long_job_is_compiled_and_a_short_one_is_not(monkeypatch):
    monkeypatch.setattr(engine, "compiled_engine", lambda: PLAIN)
    monkeypatch.setattr(engine, "fast_is_installed", lambda: True)
    assert isinstance(choose_engine("auto", readings=12_000 * 416), NumpyEngine)
    assert choose_engine("auto", readings=1_440_000 * 416) is PLAIN
    assert choose_engine("fast", readings=1) is PLAIN
    monkeypatch.setattr(engine, "fast_is_installed", lambda: False)
    assert isinstance(choose_engine("auto", readings=1_440_000 * 416), NumpyEngine)
    with pytest.raises(UsageError, match="pip install 'tactile-bayes"):
        choose_engine("fast", readings=1)
    with pytest.raises(UsageError, match="'gpu'; give one of auto, numpy, fast"):
        choose_engine("gpu", readings=1)


def test_a_short_job_never_imports_the_compiler(monkeypatch):
    real = builtins.__import__

    def guarded(name, *arguments, **options):
        assert not name.startswith("numba")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", guarded)
    assert build_map(rough_scan(1), pressure_window_kpa=(2.0, 30.0)).frame_count > 0


def test_clipped_readings_are_counted_alike(monkeypatch):
    scan = rough_scan(2)
    monkeypatch.setattr("tactile_bayes.mapping.cells.LIMIT_STEPS", 4200.0)
    monkeypatch.setattr("tactile_bayes.mapping.engine.LIMIT_STEPS", 4200.0)
    one, two = mapped(scan, NumpyEngine(), monkeypatch), mapped(scan, PLAIN, monkeypatch)
    assert one.quality["clipped_values"] == two.quality["clipped_values"] > 0
    assert same(one, two)


def test_selected_frames_have_the_same_levels_either_way():
    scan = rough_scan(3)
    one, two = (select_frames(scan, pressure_window_kpa=(2.0, 30.0), engine=way) for way in (NumpyEngine(), PLAIN))
    assert np.array_equal(one.level_kpa, two.level_kpa, equal_nan=True)
    assert np.array_equal(one.used, two.used)
