"""Calibrating an array: exact answers, what must not matter, and every odd taxel."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from emulated_devices import serving, short_scan

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.instrument import read_array_calibration
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.scan_mcap import read_scan, write_scan
from tactile_bayes.hardware.emulated import EmulatedHead, PtyLink
from tactile_bayes.hardware.head import BladderStep, fit_array
from tactile_bayes.scans import PressureFrames, Scan, TrackerPoses

RNG = np.random.default_rng(11)
GAIN = 0.0083 * (1 + 0.08 * RNG.standard_normal((16, 26)))
OFFSET = 0.2 * RNG.standard_normal((16, 26)) - 0.5
PRESSURES = (0.0, 4.0, 8.0, 12.0, 16.0)


def counts_at(kpa: float, *, bend: float = 0.0, frames: int = 50, noise: float = 0.0) -> np.ndarray:
    exact = (kpa + bend * kpa**2 - OFFSET) / GAIN
    noisy = exact + noise * np.random.default_rng(int(kpa)).standard_normal((frames, 16, 26))
    return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)


def fitted(change=lambda _, counts: counts, **options):
    steps = [
        BladderStep.from_frames(kpa, change(kpa, counts_at(kpa, **options)), saturation_count=4095) for kpa in PRESSURES
    ]
    return fit_array(steps, saturation_count=4095)


def test_gains_and_offsets_come_back():
    fit = fitted()
    np.testing.assert_allclose(fit.calibration.gain_kpa_per_count, GAIN, rtol=1e-3)
    np.testing.assert_allclose(fit.calibration.offset_kpa, OFFSET, atol=0.02)
    assert (fit.dead, fit.hot) == ((), ())
    assert np.isnan(fit.nonuniformity[0])
    assert fit.nonuniformity[1:].max() < 2e-3


def test_noise_averages_out_with_frames():
    errors = [np.abs(fitted(noise=20.0, frames=n).calibration.gain_kpa_per_count / GAIN - 1).mean() for n in (20, 320)]
    assert 2.5 < errors[0] / errors[1] < 6.5


def test_a_bent_response_shows_as_curvature_and_in_what_the_line_leaves():
    fit = fitted(bend=0.02)
    # counts rise faster than the pressure: the pressure's curve against counts bends down
    assert (fit.curvature_kpa_per_count2 < 0).all()
    assert (
        np.nanmax(fit.curved_nonuniformity) < 0.2 * np.nanmax(fit.nonuniformity) or np.nanmax(fit.nonuniformity) < 0.01
    )


def test_dead_hot_and_saturated_taxels_are_told_and_left_out():
    def spoil(kpa, counts):
        counts = counts.copy()
        counts[:, 2, 3] = 7
        counts[:, 4, 5] = np.minimum(4095, 4.0 * counts[:, 4, 5])
        if kpa == PRESSURES[-1]:
            counts[:, 6, 7] = 4095
        counts[:, 8, 9] = 4095
        return counts

    fit = fitted(spoil)
    assert fit.dead == ((2, 3),)
    assert set(fit.hot) == {(4, 5), (8, 9)}
    gain = fit.calibration.gain_kpa_per_count
    assert gain[2, 3] == gain[4, 5] == gain[8, 9] == 0
    assert gain[6, 7] == pytest.approx(GAIN[6, 7], rel=1e-2)


def test_the_order_of_the_steps_does_not_matter():
    steps = [BladderStep.from_frames(kpa, counts_at(kpa), saturation_count=4095) for kpa in PRESSURES]
    one, other = fit_array(steps, saturation_count=4095), fit_array(steps[::-1], saturation_count=4095)
    np.testing.assert_array_equal(one.calibration.gain_kpa_per_count, other.calibration.gain_kpa_per_count)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: fit_array(
                [BladderStep.from_frames(5, counts_at(5), saturation_count=4095)] * 2, saturation_count=4095
            ),
            "two",
        ),
        (lambda: BladderStep.from_frames(-1, counts_at(5), saturation_count=4095), "-1"),
        (lambda: BladderStep.from_frames(1, counts_at(5)[:3], saturation_count=4095), "3 frames"),
        (
            lambda: fit_array(
                [BladderStep.from_frames(kpa, counts_at(0), saturation_count=4095) for kpa in PRESSURES],
                saturation_count=4095,
            ),
            "does not answer",
        ),
        (
            lambda: fit_array(
                [BladderStep.from_frames(kpa, counts_at(20 - kpa), saturation_count=4095) for kpa in PRESSURES],
                saturation_count=4095,
            ),
            "does not answer",
        ),
        (lambda: fitted(lambda kpa, _: counts_at({0.0: 8.0, 8.0: 0.0}.get(kpa, kpa))), "less at 4 kPa than at 0;"),
    ],
)
def test_steps_that_say_nothing_are_refused(make, words):
    with pytest.raises(BadDataError, match=words):
        make()


@pytest.fixture(scope="module")
def steps(tmp_path_factory) -> list[Path]:
    """Scans of the bladder's steps, as `record --uncalibrated` makes them."""
    folder, like = tmp_path_factory.mktemp("steps"), short_scan()
    paths = []
    for kpa in PRESSURES:
        frames = PressureFrames(np.arange(50) / 200, counts_at(kpa))
        poses = TrackerPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)))
        scan = Scan(frames, poses, like.head, like.element_calibration, session={"head_id": "emulated"})
        paths.append(folder / f"{kpa:g}.mcap")
        write_scan(paths[-1], scan, provenance=Provenance("test", {}))
    return paths


def words_of(steps: list[Path]) -> list[str]:
    return [word for kpa, path in zip(PRESSURES, steps, strict=True) for word in ("--step", str(kpa), str(path))]


def test_the_command_writes_what_record_attaches(run_cli, tmp_path, steps):
    done = run_cli("calibrate", "array", *words_of(steps), "-o", "array.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "416 taxels of head emulated" in done.stdout
    assert "non-uniformity" in done.stdout
    found = read_array_calibration(tmp_path / "array.json")
    assert (date.today() - found.day).days in (0, 1)
    like = tmp_path / "like.mcap"
    write_scan(like, short_scan(), provenance=Provenance("test", {}))
    with serving(EmulatedHead(short_scan(0.3)), PtyLink()) as emulator:
        words = ["--head", emulator.link.url, "--like", like, "--array-calibration", "array.json"]
        done = run_cli("record", "-o", "a.mcap", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    recorded = read_scan(tmp_path / "a.mcap")
    np.testing.assert_array_equal(recorded.element_calibration.gain_kpa_per_count, found.calibration.gain_kpa_per_count)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"head_id": "another"}, "was measured on head 'another'"),
        pytest.param({"date": "2020-02-29"}, "is of 2020-02-29", marks=pytest.mark.slow),
    ],
)
def test_record_refuses_a_calibration_that_is_stale_or_another_heads(run_cli, tmp_path, steps, change, words):
    made = run_cli("calibrate", "array", *words_of(steps), "-o", "array.json", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    document = json.loads((tmp_path / "array.json").read_text()) | change
    (tmp_path / "array.json").write_text(json.dumps(document))
    with serving(EmulatedHead(short_scan(0.3)), PtyLink()) as emulator:
        given = ["--head", emulator.link.url, "--like", steps[0], "--array-calibration", "array.json"]
        refused = run_cli("record", "-o", "a.mcap", *given, cwd=tmp_path)
        taken = run_cli("record", "-o", "b.mcap", *given, "--accept-calibration", cwd=tmp_path)
    assert refused.returncode == 2
    assert words in refused.stderr
    assert not (tmp_path / "a.mcap").exists()
    assert taken.returncode == 0, taken.stderr


def test_steps_of_two_heads_are_refused(run_cli, tmp_path, steps):
    scan = read_scan(steps[1])
    other = Scan(scan.frames, scan.poses, scan.head, scan.element_calibration, session={"head_id": "other"})
    write_scan(tmp_path / "other.mcap", other, provenance=Provenance("test", {}))
    words = ["--step", "0", str(steps[0]), "--step", "4", "other.mcap"]
    done = run_cli("calibrate", "array", *words, "-o", "array.json", cwd=tmp_path)
    assert done.returncode == 3
    assert "two heads" in done.stderr
    twice = run_cli("calibrate", "array", *words, "--step", "8", "other.mcap", "-o", "array.json", cwd=tmp_path)
    assert (twice.returncode, "two steps are of one recording" in twice.stderr) == (2, True)
