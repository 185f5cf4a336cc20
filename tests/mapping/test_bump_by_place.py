"""Figures by place: of frames made by the law itself, and of solid bodies of two seats."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.map_nc import read_map, write_map
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.forward.scene import Background, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.forward.tissue import SceneBody, SolidLump
from tactile_bayes.head_shape import HeadShape
from tactile_bayes.mapping import sampling
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.bump_by_place import USUAL, Bump, by_place
from tactile_bayes.mapping.frame_sample import STEP, FrameSample
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import BY_PLACE
from tactile_bayes.scan import Scan
from tactile_bayes.studies.population import measuring_options

BUMP = Bump(0.4, 1.0, -2.0, 6.0, 7.0)
STRONG = replace(BUMP, amplitude=4.0)
HEAD = HeadShape()
BLOCK_SD_MM = 0.75
"""Two taxels 1.5 mm apart: each 0.75 mm from their middle."""


def law_frames(
    coefficients: tuple[float, ...], *, bump: Bump = BUMP, frames: int = 400, noise: float = 0.0, seed: int = 1
) -> FrameSample:
    """Frames of a head whose own pressure is a bowl, with what a lump adds by the six terms."""
    rng = np.random.default_rng(seed)
    rows, columns = np.meshgrid(np.arange(8), np.arange(13), indexing="ij")
    across, along = (rows.ravel() - 3.5) * 3.0, (columns.ravel() - 6.0) * 3.0
    place = np.column_stack([across, along, -(across**2) / 70.0])
    apex = rng.uniform([-40, -40], [40, 40], (frames, 2))
    angle = np.radians(rng.uniform(-5, 5, frames))
    rotation = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    transform = np.concatenate([rotation, np.zeros((frames, 2, 1)), apex[:, :, None]], axis=2)
    sample = FrameSample(np.ones((frames, len(place))), transform, place)
    lump = sample.under_head_mm((BUMP.x_mm, BUMP.y_mm)) / (12.0, 19.5)
    sigma = np.array([BUMP.sigma_x_mm, BUMP.sigma_y_mm])
    wider = np.hypot(sigma, BLOCK_SD_MM)
    u, v = np.moveaxis((sample.places_mm() - (BUMP.x_mm, BUMP.y_mm)) / wider, -1, 0)
    g, x2 = np.exp(-0.5 * (u**2 + v**2)), np.minimum(lump[:, :1] ** 2, 2.0)
    h = g * (u**2 - 1) / np.sqrt(2)
    terms = np.stack([g, g * x2, h, h * x2, g * u * lump[:, :1], g * v * lump[:, 1:]])
    height = bump.amplitude * float(np.prod(sigma / wider))
    own = 1.1 - (across / 30) ** 2
    own /= own.mean()
    pressure = own + height * np.tensordot(coefficients, terms, axes=1) + noise * rng.normal(size=g.shape)
    return replace(sample, pressure=pressure * rng.uniform(0.8, 1.2, (frames, 1)))


def test_coefficients_of_the_law_come_out() -> None:
    """Against the coefficients that the frames were made with; a bump so strong is hardly shrunk to the usual."""
    true = np.array([1.2, -0.5, -0.1, 0.3, -0.4, -0.1])
    found = by_place(law_frames(tuple(true), bump=STRONG), HEAD, STRONG)
    # the level is fitted with the bump's height alone, which takes up a little of the rest
    np.testing.assert_allclose(found, true, atol=0.08)
    turned = true * [1, 1, 1, 1, -1, 1]
    np.testing.assert_allclose(by_place(law_frames(tuple(turned), bump=STRONG), HEAD, STRONG), turned, atol=0.08)
    # a bump ten times fainter lies between truth and usual
    weak = by_place(law_frames(tuple(turned)), HEAD, BUMP)
    assert weak is not None
    assert USUAL[4] + 0.1 < weak[4] < turned[4] - 0.1


def test_a_faint_bump_has_the_usual_figures() -> None:
    faint = replace(BUMP, amplitude=1e-4)
    found = by_place(law_frames((0.0,) * 6, noise=0.02), HEAD, faint)
    np.testing.assert_allclose(found, USUAL, atol=0.02)


@pytest.mark.parametrize("bump", [replace(BUMP, amplitude=-0.1), replace(BUMP, x_mm=500.0)])
def test_where_there_is_nothing_to_see_there_are_no_figures(bump: Bump) -> None:
    assert by_place(law_frames(USUAL), HEAD, bump) is None


@cache
def scan_of(seat: float) -> Scan:
    """A hard ball whose bump hardly differs between the seats, over the same depth of fat."""
    d_mm = 14.0
    ratio = 1.15 - seat / 2
    scene = Scene(
        duration_s=7.0,
        frame_rate_hz=100.0,
        body=SceneBody(),
        solid_lumps=(SolidLump(d_mm=d_mm, depth_ratio=ratio, stiffness_ratio=50.0, seat=seat),),
        background=Background(mean_kpa=9.0, drift_kpa=0.3),
        strokes=Strokes(lines=6, spacing_mm=6.0, half_length_mm=34.0),
        noise=Noise(element_kpa=0.05, tracker_mm=0.05, tracker_deg=0.02, gain_share=0.002),
        tracker=Tracker(),
        seed=3,
    )
    return simulate(scene, rng=np.random.default_rng(3)).scan


@cache
def map_of(seat: float) -> TactileMap:
    return build_map(scan_of(seat), normalise="gain")


def figures(tactile_map: TactileMap) -> np.ndarray:
    found = estimate_map(tactile_map, calibration=None, options=measuring_options(), rng=np.random.default_rng(1))
    assert found.by_place is not None
    return np.array(found.by_place)


def test_the_order_of_scans_leaves_no_trace() -> None:
    whole = scan_of(0.0)
    first, second = (
        replace(
            whole,
            frames=replace(whole.frames, time_s=whole.frames.time_s[part], counts=whole.frames.counts[part]),
        )
        for part in (slice(0, 350), slice(350, None))
    )
    one, other = (figures(build_map(scans, normalise="gain")) for scans in ([first, second], [second, first]))
    np.testing.assert_allclose(one, other, rtol=1e-7)


def test_a_few_frames_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = figures(map_of(0.0))
    monkeypatch.setattr(sampling, "MOST_FRAMES", 120)
    thinned = build_map(scan_of(0.0), normalise="gain")
    assert thinned.frames is not None
    assert len(thinned.frames) <= 120
    np.testing.assert_allclose(figures(thinned), whole, atol=0.15)


def test_a_file_keeps_the_frames(tmp_path: Path) -> None:
    made = map_of(0.0)
    write_map(tmp_path / "m.nc", made, provenance=Provenance("test", {}, {}))
    read = read_map(tmp_path / "m.nc")
    assert made.frames is not None
    assert read.frames is not None
    for name in ("pressure", "plane_from_head", "place_mm"):
        np.testing.assert_array_equal(getattr(read.frames, name), getattr(made.frames, name))
    write_map(tmp_path / "bare.nc", replace(made, frames=None), provenance=Provenance("test", {}, {}))
    assert read_map(tmp_path / "bare.nc").frames is None
    with pytest.raises(BadDataError, match="mean pressure is not above 0"):
        replace(made.frames, pressure=np.zeros_like(made.frames.pressure))
    with pytest.raises(BadDataError, match="place_mm is no finite array"):
        replace(made.frames, place_mm=np.full_like(made.frames.place_mm, np.nan))


def test_pressures_are_whole_steps() -> None:
    frames = map_of(0.0).frames
    assert frames is not None
    np.testing.assert_array_equal(frames.steps * STEP, frames.pressure)


def test_a_map_in_kpa_keeps_none() -> None:
    assert build_map(scan_of(0.0), normalise="none").frames is None


def test_seats_differ_in_their_figures() -> None:
    """A ball that stands out of the gland against one centred on it: further apart than exams of one body differ."""
    centred, out = figures(map_of(0.0)), figures(map_of(1.1))
    # exams of one body differ by 0.03 to 0.05 in each figure (the population of docs/decisions/0106)
    assert np.abs(centred - out).max() > 0.1
    assert len(centred) == len(BY_PLACE)


def test_over_uneven_fat_there_are_none() -> None:
    """The control: a change of the head's profile that may be its own error."""
    made = map_of(0.0)

    def found(sd: float) -> Estimate:
        quality = {**made.quality, "profile_change": 0.05, "profile_change_sd": sd}
        changed = replace(made, quality=quality)
        return estimate_map(changed, calibration=None, options=measuring_options(), rng=np.random.default_rng(1))

    assert found(0.005).by_place is None
    assert found(0.04).by_place is not None
