"""What a frame's readings have in common: found as it was put in, about nothing for white noise, absent at extremes."""

from __future__ import annotations

from functools import cache

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.mapping.accumulate import LEAST_SHARE, MapAccumulator
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.cells import distinct_poses, poses_at
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.report.map import map_text
from tactile_bayes.scans import Scan

NAMES = {"shared_share", "shared_length_mm", "effective_readings", "shared_frames"}
NOISE = 0.1  # of the level
FRAMES = 2000


@cache
def noisy_scan(
    *, share: float, length_mm: float = 4.0, again: int = 1, pitch_mm: float = 1.5, seed: int = 1, frames: int = FRAMES
) -> Scan:
    """An even field read with errors of which `share` is a field of its own in each frame, the rest each taxel's own.

    With `again`, so many successive frames have the same errors.
    """
    rng = np.random.default_rng(seed)
    head = scans.flat_head(rows=12, columns=16, pitch_mm=pitch_mm)
    place = head.surface_mm[..., :2].reshape(-1, 2)
    distance = np.linalg.norm(place[:, None] - place[None], axis=2)
    root = np.linalg.cholesky(np.exp(-distance / length_mm) + 1e-9 * np.eye(len(place)))
    fields = rng.standard_normal((frames // again, len(place))) @ root.T
    white = rng.standard_normal(fields.shape)
    errors = np.repeat(NOISE * (np.sqrt(share) * fields + np.sqrt(1 - share) * white), again, axis=0)
    centres = rng.uniform(-12, 12, (frames // again, 2))  # no two frames in a row near each other, but for `again`
    centres = np.repeat(centres, again, axis=0)
    # A pose told twice would be taken for a repeat, and the head for moving between.
    scan = scans.make_scan(centres + 1e-4 * rng.standard_normal(centres.shape), head=head)
    pressure = scans.LEVEL_KPA * (1 + errors.reshape(-1, *head.shape))
    return scans.with_counts(scan, np.rint(pressure / scans.GAIN_KPA).astype(np.uint16))


def shared(scan: Scan, **options) -> dict[str, float]:
    quality = build_map(scan, **({"normalise": "none"} | options)).quality
    return {name: quality[name] for name in NAMES & set(quality)}


@pytest.mark.parametrize(("share", "length_mm"), [(0.3, 4.0), (0.7, 2.5), (0.9, 6.0)])
def test_the_simulated_share_and_length_are_recovered(share, length_mm):
    found = shared(noisy_scan(share=share, length_mm=length_mm))
    assert found["shared_share"] == pytest.approx(share, abs=0.05)
    assert found["shared_length_mm"] == pytest.approx(length_mm, rel=0.15)
    assert found["shared_frames"] == 400


@pytest.mark.parametrize("normalise", ["none", "mean", "gain"])
def test_white_noise_shares_nothing(normalise):
    found = shared(noisy_scan(share=0.0), normalise=normalise)
    assert found["shared_share"] < LEAST_SHARE
    assert "shared_length_mm" not in found
    count = np.median(build_map(noisy_scan(share=0.0)).count)
    assert found["effective_readings"] == pytest.approx(count, rel=0.06)


def test_readings_that_say_the_same_again_count_once():
    count = float(np.median(build_map(noisy_scan(share=0.0)).count))
    for again in (2, 5):
        found = shared(noisy_scan(share=0.0, again=again))
        assert found["effective_readings"] == pytest.approx(count / again, rel=0.2)


def test_readings_of_one_frame_in_one_cell_share_its_error():
    """In cells of three pitches nine readings of a frame meet; what they share leaves fewer independent ones."""
    scan = noisy_scan(share=0.8, length_mm=20.0)
    tactile_map = build_map(scan, normalise="none", cell_mm=4.5)
    found = tactile_map.quality["effective_readings"]
    hit = tactile_map.count[tactile_map.count > 200]
    # With m readings a frame, each pair of correlation r: n / (1 + (m - 1) r).
    assert found == pytest.approx(float(np.median(hit)) / (1 + 8 * 0.8 * np.exp(-2.3 / 20)), rel=0.15)
    assert shared(noisy_scan(share=0.0), cell_mm=4.5)["effective_readings"] > 3 * found  # the control


def test_the_variance_of_a_cells_mean_is_that_of_the_effective_readings():
    """What the figure is for: errors of the map's cells, against the within-cell variance and either number."""
    scan = noisy_scan(share=0.0, again=4)
    tactile_map = build_map(scan, normalise="none")
    well = tactile_map.count > 60
    errors = (tactile_map.mean[well] - scans.LEVEL_KPA) ** 2 * tactile_map.count[well]
    variance = (NOISE * scans.LEVEL_KPA) ** 2
    inflation = tactile_map.quality["median_count"] / tactile_map.quality["effective_readings"]
    assert errors.mean() / variance == pytest.approx(inflation, rel=0.2)
    assert errors.mean() / variance > 2.5  # the control: the count alone would say 1


def test_the_same_scan_in_parts_gives_about_the_same():
    scan = noisy_scan(share=0.6)
    parts = [scans.part(scan, slice(start, start + 500)) for start in range(0, FRAMES, 500)]
    whole, together = shared(scan), shared(parts)
    assert together["shared_share"] == pytest.approx(whole["shared_share"], abs=0.05)
    assert together["shared_frames"] == whole["shared_frames"]
    assert shared(scan) == whole  # no chance in it


def saturated_here_and_there(scan: Scan) -> Scan:
    counts = scan.frames.counts.copy()
    counts[np.random.default_rng(0).random(counts.shape) < 0.02] = 65535
    return scans.with_counts(scan, counts)


def test_readings_at_full_scale_are_left_out():
    found = shared(saturated_here_and_there(noisy_scan(share=0.6)))
    assert found["shared_share"] == pytest.approx(0.6, abs=0.06)


UNDETERMINED = {
    "one frame": lambda: noisy_scan(share=0.5, frames=1),
    "few frames": lambda: noisy_scan(share=0.5, frames=12),
    "constant frames": lambda: scans.make_scan(scans.strokes(per_line=60)),
}


@pytest.mark.parametrize("make", UNDETERMINED.values(), ids=UNDETERMINED)
def test_unknown_figures_are_absent_and_the_text_says_so(make):
    tactile_map = build_map(make())
    assert not NAMES & set(tactile_map.quality)
    text = map_text(tactile_map)
    assert "shared errors" in text
    assert "not known" in text
    assert "nan" not in text


def test_a_live_map_has_no_figures_of_shared_errors():
    scan = noisy_scan(share=0.5)
    poses = poses_at(distinct_poses(scan.poses), scan.frames.time_s)
    grown = MapAccumulator(scan.head, scan.element_calibration, plane_from_base=np.eye(4))
    grown.add(scan.frames.counts, poses)
    assert not NAMES & set(grown.snapshot().quality)


def test_the_text_says_it_in_words():
    tactile_map: TactileMap = build_map(noisy_scan(share=0.7))
    line = next(one for one in map_text(tactile_map).splitlines() if one.startswith("shared errors"))
    for name, form in (
        ("shared_share", "{:.0f} %"),
        ("shared_length_mm", "{:.1f} mm"),
        ("effective_readings", "{:.0f}"),
    ):
        value = tactile_map.quality[name] * (100 if name == "shared_share" else 1)
        assert form.format(value) in line
    quiet = replace(tactile_map, quality={**tactile_map.quality, "shared_share": 0.01})
    assert "under 2 %" in map_text(quiet)
