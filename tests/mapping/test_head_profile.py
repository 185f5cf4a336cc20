"""How pressure is spread over the head: known profiles, the layered body's own, and another program's scans."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import mapping_scans as scans
import numpy as np
import pytest
from numpy.polynomial import legendre

from tactile_bayes.declarations import replace
from tactile_bayes.files.imports import read_arrays
from tactile_bayes.files.size_json import DEFAULT, read_size_calibration, size_calibration_path
from tactile_bayes.forward.scene import Background, Noise, Scene, Strokes
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.cells import distinct_poses, poses_at
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.mapping.profile import (
    LEAST_FRAMES,
    MOST_FRAMES,
    NO_LIMIT,
    ProfileReader,
    frame_marks,
    marks_limit,
    profile_figures,
)
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.presets import HEAD_PROFILE
from tactile_bayes.scans import Scan
from tactile_bayes.size.bodies import BodyCalibration
from tactile_bayes.size.terms import head_profile

TRUE_FAT_MM = {"s01": 15.0, "s03": 20.0, "s05": 12.0, "s07": 12.0, "s11": 24.0}
"""By truth.csv: depth of the centre where centred; a tenth of a diameter below the ball where resting."""


def response(coefficients: np.ndarray, *, rows: int = 16, columns: int = 26) -> np.ndarray:
    """A profile with given Legendre coefficients, the array's ends at -1 and 1."""
    x, y = ((2 * np.arange(n) + 1) / n - 1 for n in (rows, columns))
    return legendre.leggrid2d(x, y, coefficients)


def shipped() -> BodyCalibration:
    path = size_calibration_path(DEFAULT)
    assert path is not None
    calibration = read_size_calibration(path)
    assert isinstance(calibration, BodyCalibration)
    return calibration


def fat_mm(tactile_map: TactileMap) -> float:
    found = shipped().at_fat([head_profile(tactile_map.quality)]).fat_mm
    assert found is not None
    return found


@cache
def scanned(seat: float, *, tilt_deg: float = 2.0, mean_kpa: float = 9.5) -> TactileMap:
    """A ball of 15 mm, its centre one diameter deep."""
    lump = SolidLump(d_mm=15.0, depth_ratio=1.0, stiffness_ratio=30.0, seat=seat)
    scene = Scene(
        seed=5,
        duration_s=7.0,
        frame_rate_hz=60.0,
        body=SceneBody(),
        solid_lumps=(lump,),
        background=Background(mean_kpa=mean_kpa),
        strokes=Strokes(tilt_deg=tilt_deg),
        noise=Noise(element_kpa=0.2, tracker_mm=0.3, tracker_deg=0.1, gain_share=0.01),
    )
    return build_map(simulate(scene, rng=np.random.default_rng(5)).scan)


def read(profile: np.ndarray, good: np.ndarray) -> tuple[np.ndarray, float]:
    """What is read of one frame of 9 kPa with such a profile: coefficients, and what they leave."""
    (row,) = ProfileReader.of(good).read(9.0 * profile[good][None], np.array([9.0]))
    return row[:3], float(row[-1])


def test_known_coefficients_are_found_with_taxels_missing() -> None:
    true = np.zeros((5, 5))
    true[0, 0], true[2, 0], true[4, 0], true[0, 2], true[0, 4] = 1.0, -0.12, 0.03, 0.08, -0.05
    good = np.ones((16, 26), dtype=bool)
    good[3, 4:9], good[10] = False, False
    spoilt = np.where(good, response(true), 1.0)
    found, left = read(spoilt, good)
    np.testing.assert_allclose(found, [-0.12, 0.08, -0.05], atol=1e-12)
    assert left < 1e-7
    # what is left out counts if it is said to be good
    wrong, left = read(spoilt, np.ones_like(good))
    assert np.abs(wrong - [-0.12, 0.08, -0.05]).max() > 0.005
    assert left > 0.01


def test_a_tilted_head_has_the_same_figures() -> None:
    level, tilted = np.zeros((5, 5)), np.zeros((5, 5))
    level[0, 0] = tilted[0, 0] = 1.0
    level[2, 0] = tilted[2, 0] = 0.1
    tilted[1, 0], tilted[0, 1], tilted[1, 1], tilted[2, 2] = 0.2, -0.1, 0.05, 0.02
    good = np.ones((16, 26), dtype=bool)
    flat, turned = (read(response(one), good)[0] for one in (level, tilted))
    np.testing.assert_allclose(flat, turned, atol=1e-12)


def test_lumps_are_left_out_also_where_most_frames_feel_one() -> None:
    """A rise under three frames of four: the mean over all is off, that over the smooth ones is not."""
    rng, good = np.random.default_rng(1), np.ones((16, 26), dtype=bool)
    even = np.zeros((5, 5))
    even[0, 0], even[0, 2] = 1.0, 0.1
    rows = []
    for i in range(400):
        frame = response(even) + 0.02 * rng.standard_normal((16, 26))
        if i % 4:
            frame[5:9, 6:10] += 1.0
        rows.append(ProfileReader.of(good).read(frame[good][None], np.array([1.0])))
    found = profile_figures(np.concatenate(rows))
    assert found["head_profile_frames"] == pytest.approx(100, abs=5)
    assert found["head_profile_y2"] == pytest.approx(0.1, abs=0.002)
    assert abs(np.concatenate(rows).mean(axis=0)[1] - 0.1) > 0.01
    assert profile_figures(np.concatenate(rows[::-1])) == found
    assert profile_figures(np.concatenate(rows[: LEAST_FRAMES - 1])) == {}


def test_an_array_of_few_rows_has_no_profile() -> None:
    rows = ProfileReader.of(np.ones((4, 26), dtype=bool)).read(np.ones((99, 104)), np.ones(99))
    assert profile_figures(rows) == {}


def spread_scan(frames: int) -> Scan:
    """A scan without a lump, each frame with a level of its own."""
    rng = np.random.default_rng(2)
    centres = np.tile(scans.even_centres(), (frames // len(scans.even_centres()) + 1, 1))[:frames]
    levels = rng.uniform(6.0, 12.0, frames)
    plain = scans.make_scan(centres, field=lambda u, v: 1.0 + 1e-4 * (u * u + v), levels_kpa=levels)
    rough = plain.frames.counts + rng.integers(0, 200, plain.frames.counts.shape).astype(np.uint16)
    return scans.with_counts(plain, rough)


def grown(scan: Scan, like: TactileMap, portions: Iterable[np.ndarray]) -> MapAccumulator:
    """A map that was given the frames in portions, a snapshot after each."""
    assert like.plane_from_base is not None
    found = MapAccumulator(scan.head, scan.element_calibration, plane_from_base=like.plane_from_base)
    poses = poses_at(distinct_poses(scan.poses), scan.frames.time_s)
    for portion in portions:
        found.add(scan.frames.counts[portion], poses.part(portion))
        found.snapshot()
    return found


def profile_of(quality: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in quality.items() if name.startswith("head_profile")}


def test_frames_with_a_reading_that_carries_no_pressure_are_left_out() -> None:
    scan = spread_scan(200)
    counts = scan.frames.counts.copy()
    counts[::2, 3, 4] = 65535
    half = scans.with_counts(scan, counts)
    whole = build_map(scan)
    by_hand = ProfileReader.of(np.ones((8, 8), dtype=bool)).read(
        scan.pressure_kpa()[1::2].reshape(100, -1), scan.pressure_kpa()[1::2].mean(axis=(1, 2))
    )
    live = grown(half, whole, [np.arange(200)]).snapshot().quality
    assert profile_of(live) == pytest.approx(profile_figures(by_hand), abs=1e-9)


@pytest.mark.parametrize("frames", [240, MOST_FRAMES + 700])
def test_a_live_map_has_the_profile_of_the_whole_scan(frames: int) -> None:
    """To the bit, in any portions and any order, with all frames read and with a choice of them."""
    scan = spread_scan(frames)
    whole = build_map(scan)
    expected = profile_of(whole.quality)
    assert MOST_FRAMES >= expected["head_profile_frames"] >= LEAST_FRAMES
    order = np.random.default_rng(3).permutation(frames)
    for portions in ([np.arange(frames)], np.array_split(order, frames // 40)):
        assert profile_of(grown(scan, whole, portions).snapshot().quality) == expected


def test_the_marked_frames_are_a_random_choice() -> None:
    """Shares of the levels' range and of the order are those of a simple random sample; equal levels go together."""
    level = np.sort(np.random.default_rng(1).uniform(6.0, 12.0, 20_000))
    marks = frame_marks(level)
    chosen = np.flatnonzero(marks < marks_limit(marks, 2000))
    assert len(chosen) == 2000
    shares = np.bincount(chosen * 10 // len(level), minlength=10)
    assert ((shares - 200) ** 2 / 180).sum() < 27.9  # chi-square of 9 degrees of freedom, 0.1 %
    assert marks_limit(np.array([5, 7, 7, 9], dtype=np.uint64), 2) == 7
    assert marks_limit(marks[:2000], 2000) == NO_LIMIT


def test_a_map_without_lump_free_frames_has_no_profile() -> None:
    over_the_lump = build_map(scans.make_scan(scans.strokes(), field=scans.gaussian()))
    assert not set(HEAD_PROFILE) & set(over_the_lump.quality)
    assert head_profile(over_the_lump.quality) is None


def test_an_even_field_has_a_flat_profile() -> None:
    found = build_map(scans.make_scan(scans.even_centres(), field=scans.uniform)).quality
    np.testing.assert_allclose([found[name] for name in HEAD_PROFILE], 0.0, atol=2e-3)


@pytest.mark.long
def test_the_simulated_bodys_fat_is_found() -> None:
    """Centred the boundary lies at 15 mm, clear of the gland at 15 + 1.2 * 7.5 = 24 mm."""
    assert fat_mm(scanned(0.0)) == pytest.approx(15.0, rel=0.05)
    assert fat_mm(scanned(1.2)) == pytest.approx(24.0, rel=0.05)


@pytest.mark.long
def test_the_depth_tells_seats_apart_that_the_map_does_not() -> None:
    """With the profile both sizes are within 12 %; without it the two are told apart by none, and differ by a fifth."""
    calibration = shipped()
    fit = SamplerSettings(background="free", rotation="off", noise="field")
    options = replace(fit, method="laplace")
    sizes: dict[str, list[float]] = {"with": [], "without": []}
    for seat in (0.0, 1.2):
        tactile_map = scanned(seat)
        bare = {k: v for k, v in tactile_map.quality.items() if k not in HEAD_PROFILE}
        for name, one in (("with", tactile_map), ("without", replace(tactile_map, quality=bare))):
            found = estimate_map(one, calibration=calibration, options=options, rng=np.random.default_rng(1))
            assert found.size is not None
            sizes[name].append(float(np.median(found.size.max_size_mm)))
            told = any("depth of the fat" in note for note in found.left_out)
            assert told == (name == "without")
            assert (found.diagnostics["fat_mm"] is None) == told
    assert sizes["with"] == pytest.approx([15.0, 15.0], rel=0.12)
    assert sizes["without"][1] / sizes["without"][0] > 1.2


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", sorted(TRUE_FAT_MM))
def test_the_depth_of_fat_of_another_programs_bodies_is_within_20_percent(shared_data: Path, name: str) -> None:
    """An independent program's scans: the fat within 20 %, which tells 12 mm from 20 and 24."""
    (path,) = (shared_data / "scans").glob(f"{name}_*.npz")
    found = fat_mm(build_map(read_arrays(path)))
    assert found == pytest.approx(TRUE_FAT_MM[name], rel=0.2)
