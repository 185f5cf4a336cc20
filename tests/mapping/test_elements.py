"""Taxels that cannot be trusted are found, and good ones are left alone."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.mapping.select import find_faults
from tactile_bayes.scans import ElementCalibration, Scan


def noisy_scan(seed: int = 0) -> Scan:
    """A lump, changing pressure and sensor noise of 0.2 kPa."""
    rng = np.random.default_rng(seed)
    levels = 8 + 2 * np.sin(np.arange(120) / 7)
    scan = scans.make_scan(scans.strokes(), field=scans.gaussian(amplitude=1.0), levels_kpa=levels)
    noise = rng.normal(0, 0.2 / scans.GAIN_KPA, scan.frames.counts.shape)
    return scans.with_counts(scan, np.clip(scan.frames.counts + noise, 0, 65534).astype(np.uint16))


def spoilt(change) -> Scan:
    scan = noisy_scan()
    counts = scan.frames.counts.copy()
    change(counts[:, 3, 5])
    return scans.with_counts(scan, counts)


def fill(value):
    return lambda readings: readings.__setitem__(slice(None), value)


def cable_noise(readings):
    readings[:] = np.random.default_rng(1).integers(0, 300, len(readings))


def flicker(readings):
    readings[::2] = np.minimum(readings[::2] + 16000.0, 65000).astype(np.uint16)


def press_harder(readings):
    readings[:] = np.minimum(readings * 2.6, 65000).astype(np.uint16)


def stick_for_a_time(readings):
    readings[20:110] = readings[20]


def sometimes_full(readings):
    readings[:: len(readings) // 20] = 65535


FAULTS = {
    "zero": (fill(0), "dead"),
    "noise of its cable": (cable_noise, "dead"),
    "one value": (fill(16000), "stuck"),
    "one value for most of the time": (stick_for_a_time, "stuck"),
    "twice the pressure and more": (press_harder, "hot"),
    "flickering": (flicker, "hot"),
    "full scale": (fill(65535), "saturated"),
    "full scale in a sixth of the frames": (sometimes_full, "saturated"),
}


@pytest.mark.parametrize(("change", "fault"), FAULTS.values(), ids=FAULTS)
def test_a_bad_taxel_is_found_and_named(change, fault):
    found = find_faults(spoilt(change))
    assert [str(one) for one in found] == [f"row 3 column 5 {fault}"]


@pytest.mark.parametrize("seed", range(5))
def test_a_good_array_over_a_lump_has_no_fault(seed):
    assert find_faults(noisy_scan(seed)) == ()


def test_a_taxel_that_sticks_for_a_moment_is_left_alone():
    assert find_faults(spoilt(lambda readings: readings.__setitem__(slice(20, 40), readings[20]))) == ()


@pytest.mark.parametrize(("stretches", "faults"), [(1, []), (2, ["row 3 column 5 stuck"])])
def test_a_taxel_that_sticks_in_a_twentieth_of_a_long_scan_is_left_out(stretches, faults):
    """26 stretches of 32 frames: one is 4 %, two are 8 %."""
    counts = np.tile(noisy_scan().frames.counts, (7, 1, 1))
    counts[95 : 96 + 32 * stretches, 3, 5] = counts[95, 3, 5]
    long = scans.with_counts(scans.make_scan(np.zeros((len(counts), 2))), counts)
    assert [str(one) for one in find_faults(long)] == faults


def test_an_edge_that_bears_nothing_is_no_single_fault():
    scan = noisy_scan()
    counts = scan.frames.counts.copy()
    counts[:, 0, :] = counts[:, 0, :] // 20
    assert find_faults(scans.with_counts(scan, counts)) == ()


def test_a_taxel_the_bladder_gave_no_gain_is_dead():
    scan = noisy_scan()
    gain = scan.element_calibration.gain_kpa_per_count.copy()
    gain[2, 2] = 0.0
    calibration = ElementCalibration(gain, scan.element_calibration.offset_kpa, saturation_count=65535)
    assert [str(one) for one in find_faults(replace(scan, element_calibration=calibration))] == ["row 2 column 2 dead"]


def test_a_head_that_never_moved_has_no_stuck_taxel():
    scan = scans.make_scan(np.zeros((30, 2)))
    assert find_faults(scan) == ()


def test_too_few_frames_say_nothing_about_what_never_changes():
    assert find_faults(scans.part(spoilt(fill(16000)), slice(5))) == ()
    assert find_faults(scans.part(noisy_scan(), slice(0))) == ()
