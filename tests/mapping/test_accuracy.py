"""Widths and heights of maps against simulated truth, what must not change them, and the table of extremes."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.scene import Background, Lump, Noise, Scene, Strokes
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import apply, rigid
from tactile_bayes.mapping.accumulate import MapAccumulator
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.cells import FramePoses, head_moments
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import fit_bump
from tactile_bayes.scans import Scan

TRUE_POSES = Noise(tracker_mm=0.0, tracker_deg=0.0)
MOST_BIAS = 0.005


def scene_of(lump: Lump, *, load_sharing: bool = False) -> Scene:
    return Scene(
        duration_s=14.0,
        lumps=(lump,),
        background=Background(load_sharing=load_sharing),
        strokes=Strokes(lines=10, spacing_mm=4.0, tilt_deg=0.5),
        noise=TRUE_POSES,
    )


def fitted(tactile_map: TactileMap, base_mm) -> np.ndarray:
    """Amplitude, sigma_x and sigma_y of the bump at a known place."""
    place = apply(tactile_map.plane_from_base, np.array(base_mm))
    fit, fault = fit_bump(tactile_map, (float(place[0]), float(place[1])), options=SamplerSettings(background="free"))
    assert fit is not None, fault
    return np.array([fit.theta[0], *fit.widths()[:2]])


def bias(cell_mm: float, *, seed: int, load_sharing: bool = False, normalise: str = "gain", whole: bool = True):
    """Errors of amplitude, sigma_x and sigma_y as shares; `whole` false fits points, not means over cells."""
    lump = Lump(amplitude=0.3, sigma_x_mm=5.0, sigma_y_mm=4.0)
    made = simulate(scene_of(lump, load_sharing=load_sharing), rng=np.random.default_rng(seed))
    tactile_map = build_map(made.scan, cell_mm=cell_mm, normalise=normalise)
    if not whole:
        tactile_map = replace(tactile_map, recipe=replace(tactile_map.recipe, cell_mm=1e-3))
    return fitted(tactile_map, made.truth["lumps"][0]["base_mm"]) / [0.3, 5.0, 4.0] - 1


def test_widths_and_height_are_unbiased():
    assert np.abs(bias(1.0, seed=0)).max() < 2 * MOST_BIAS  # one scan: its noise is in it


@pytest.mark.slow
@pytest.mark.parametrize("load_sharing", [False, True])
@pytest.mark.parametrize("cell_mm", [0.5, 1.0, 1.5])
def test_the_bias_is_below_half_a_per_cent_up_to_cells_of_1_5_mm(cell_mm, load_sharing):
    found = np.mean([bias(cell_mm, seed=seed, load_sharing=load_sharing) for seed in range(4)], axis=0)
    assert np.abs(found).max() <= MOST_BIAS


@pytest.mark.slow
def test_a_model_at_points_or_a_division_by_the_mean_would_show():
    """The controls: without averaging over cells, and with the lump in the divisor, the bias is there."""
    assert np.mean([bias(2.0, seed=seed, whole=False)[2] for seed in range(4)]) > MOST_BIAS
    assert np.mean([bias(1.0, seed=seed, normalise="mean")[0] for seed in range(2)]) < -5 * MOST_BIAS


@pytest.mark.long
@pytest.mark.parametrize("normalise", ["mean", "gain"])
def test_moving_the_whole_scan_does_not_change_the_sizes(normalise):
    made = simulate(scene_of(Lump(sigma_x_mm=5.0, sigma_y_mm=4.0)), rng=np.random.default_rng(1))
    base = np.array(made.truth["lumps"][0]["base_mm"])
    still = fitted(build_map(made.scan, normalise=normalise), base)
    for angle, shift in ((37.0, (0.0, 0.0, 0.0)), (180.0, (1e5, -1e5, 1e5))):
        motion = rigid(scans.rotation(angle, about=(1, 2, 3)), np.array(shift))
        moved = fitted(build_map(scans.moved(made.scan, motion), normalise=normalise), apply(motion, base))
        assert moved == pytest.approx(still, rel=1e-3)
    half = scans.part(made.scan, slice(0, 1800))
    assert fitted(build_map(half, normalise=normalise), base) != pytest.approx(still, rel=1e-3)  # the control


def stroke_scan(**options) -> Scan:
    options.setdefault("field", scans.gaussian(amplitude=0.5, sigma_x=5, sigma_y=5))
    return scans.make_scan(options.pop("centres", scans.strokes(per_line=60)), **options)


def coarse_head() -> Scan:
    """Taxels 6 mm apart over a bump of sigma 2 mm: strokes closer than the pitch still resolve it."""
    head = scans.flat_head(rows=6, columns=6, pitch_mm=6.0)
    centres = scans.strokes(reach_mm=15, lines=13, spacing_mm=0.5, per_line=60)
    levels = 8 + np.sin(np.arange(len(centres)))  # taxels that read one count throughout would be called stuck
    field = scans.gaussian(amplitude=0.5, sigma_x=2, sigma_y=2)
    return scans.make_scan(centres, head=head, field=field, levels_kpa=levels)


def saturated() -> Scan:
    scan = stroke_scan()
    return scans.with_counts(scan, np.full_like(scan.frames.counts, 65535))


def dead() -> Scan:
    scan = stroke_scan()
    return scans.with_counts(scan, np.zeros_like(scan.frames.counts))


def far() -> Scan:
    return scans.moved(stroke_scan(), rigid(np.eye(3), np.array([1e5, -1e5, 1e5])))


def upside_down() -> Scan:
    return scans.moved(stroke_scan(), rigid(scans.rotation(180, about=(1, 0, 0)), np.zeros(3)))


MAPS = {
    "one frame": (lambda: stroke_scan(centres=np.zeros((1, 2))), {"frames_used": 1, "coverage": 0}),
    "one stroke": (lambda: stroke_scan(centres=scans.strokes(lines=1, per_line=60)), {"frames_used": 60}),
    "head upside down": (upside_down, {"frames_used": 240, "tilt_deg": 0}),
    "1e5 mm away": (far, {"frames_used": 240, "plane_rms_mm": 0}),
    "pitch larger than the lump": (coarse_head, {"frames_used": 780, "masked_taxels": 0}),
}


@pytest.mark.parametrize(("make", "expected"), MAPS.values(), ids=MAPS)
def test_extreme_scans_that_have_a_map(make, expected):
    tactile_map = build_map(make())
    for name, value in expected.items():
        assert tactile_map.quality[name] == pytest.approx(value, abs=1e-3), name
    assert np.isfinite(tactile_map.mean[tactile_map.covered]).all()


def test_a_pitch_larger_than_the_lump_keeps_its_width():
    assert fitted(build_map(coarse_head(), normalise="gain"), (0.0, 0.0, 0.0))[1:] == pytest.approx(2.0, rel=0.02)


NO_MAPS = {
    "all frames gated out": (
        lambda: stroke_scan(levels_kpa=np.linspace(1, 3, 240)),
        r"no frame's mean lies within 5 to 14 kPa .* would keep nine in ten",
    ),
    "every taxel dead": (dead, r"none of the 64 taxels works \(dead\); check the array's cable"),
    "34 kPa everywhere": (saturated, r"none of the 64 taxels works \(saturated\); press less hard"),
}


@pytest.mark.parametrize(("make", "message"), NO_MAPS.values(), ids=NO_MAPS)
def test_extreme_scans_that_are_refused(make, message):
    with pytest.raises(BadDataError, match=message):
        build_map(make())


@pytest.mark.slow
def test_two_hours_do_not_overflow_or_grow():
    """1.44 million frames at the highest pressure in the window: sums stay exact, the map stays as large."""
    scan = stroke_scan(field=scans.uniform, levels_kpa=14.0, centres=scans.strokes(per_line=250))
    poses = FramePoses(scan.poses.position_mm, np.broadcast_to(np.eye(3), (1000, 3, 3)), np.ones(1000, dtype=bool))
    plane = head_moments(scan.head, poses).plane().plane_from_base
    once, long = (MapAccumulator(scan.head, scan.element_calibration, plane_from_base=plane) for _ in range(2))
    once.add(scan.frames.counts, poses)
    for _ in range(1440):
        long.add(scan.frames.counts, poses)
    one, many = once.snapshot(), long.snapshot()
    assert np.array_equal(many.count, 1440 * one.count)
    assert np.array_equal(many.mean, one.mean, equal_nan=True)
    assert many.variance == pytest.approx(one.variance, abs=1e-6, nan_ok=True)
