"""Latency and mobility from the scan itself, each with what it must refuse and a control that it would show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.forward.scene import Lump, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.simulate import head_positions, simulate
from tactile_bayes.mapping import TactileMap, build_map
from tactile_bayes.posterior.options import FitOptions
from tactile_bayes.posterior.white.fit import fit_bump
from tactile_bayes.scan import PressureFrames, Scan

TRUE_POSES = Noise(tracker_mm=0.0, tracker_deg=0.0)
LUMP = Lump(amplitude=0.3, sigma_x_mm=5.0, sigma_y_mm=5.0)
LATE_MS = 13.7


def scanned(*, duration_s: float, lines: int, seed: int = 1, **options) -> Scan:
    options.setdefault("lumps", (LUMP,))
    spacing = 24.0 / lines
    scene = Scene(duration_s=duration_s, strokes=Strokes(lines=lines, spacing_mm=spacing), **options)
    return simulate(scene, rng=np.random.default_rng(seed)).scan


def follows(delta_mm: float, *, lumps: tuple[Lump, ...] = (LUMP,)) -> Scan:
    """A lump that the head drags along by `delta_mm`, forth and back."""
    scene = Scene(duration_s=14.0, strokes=Strokes(lines=10, spacing_mm=3.0))
    ways = [
        simulate(
            replace(scene, lumps=tuple(replace(one, x_mm=way * delta_mm) for one in lumps)),
            rng=np.random.default_rng(1),
        ).scan
        for way in (1, -1)
    ]
    _, origin = head_positions(scene, ways[0].frames.time_s)
    forth = (np.gradient(origin[:, 0]) > 0)[:, None, None]
    counts = np.where(forth, ways[0].frames.counts, ways[1].frames.counts)
    return replace(ways[0], frames=PressureFrames(ways[0].frames.time_s, counts))


def sigma_x(tactile_map: TactileMap) -> float:
    row, column = np.unravel_index(
        int(np.nanargmax(np.where(tactile_map.count > 30, tactile_map.mean, np.nan))), tactile_map.mean.shape
    )
    centre = (float(tactile_map.x_mm[column]), float(tactile_map.y_mm[row]))
    fit, _ = fit_bump(tactile_map, centre, options=FitOptions(background="free"))
    assert fit is not None
    return fit.widths()[0]


def test_the_latency_is_found_and_used():
    late = scanned(duration_s=14.0, lines=10, tracker=Tracker(latency_ms=LATE_MS), noise=TRUE_POSES)
    found = build_map(late, latency_ms="auto")
    sd = found.quality["latency_sd_ms"]
    assert found.recipe.latency_ms == pytest.approx(LATE_MS, abs=max(3 * sd, 0.1))
    assert sd < 1.0
    assert np.nanmedian(found.variance) < np.nanmedian(build_map(late).variance)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_minute_gives_the_latency_to_a_tenth_of_a_millisecond(seed):
    late = scanned(duration_s=60.0, lines=40, seed=seed, tracker=Tracker(latency_ms=LATE_MS), noise=TRUE_POSES)
    assert build_map(late, latency_ms="auto").recipe.latency_ms == pytest.approx(LATE_MS, abs=0.1)


def test_without_a_lump_every_latency_fits_and_none_is_given():
    plain = scanned(duration_s=7.0, lines=5, lumps=(), tracker=Tracker(latency_ms=LATE_MS))
    with pytest.raises(BadDataError, match=r"does not determine the tracker's latency .*scan a phantom"):
        build_map(plain, latency_ms="auto")


def test_a_lump_that_follows_the_head_is_measured_and_sharpened():
    scan = follows(2.0)
    blurred, sharp = build_map(scan), build_map(scan, register_strokes=True)
    assert sharp.quality["mobility_mm"] == pytest.approx(2.0, abs=0.1)
    assert sharp.quality["mobility_sd_mm"] < 0.1
    assert sharp.quality["strokes"] == sharp.quality["strokes_known"] == 10
    assert sharp.recipe.registered
    still = sigma_x(build_map(follows(0.0)))
    assert sigma_x(sharp) == pytest.approx(still, rel=0.01)
    assert sigma_x(blurred) > 1.03 * still  # the control: unregistered, it is too wide


def test_a_lump_that_stays_has_no_mobility():
    found = build_map(follows(0.0), register_strokes=True)
    assert abs(found.quality["mobility_mm"]) < 0.1
    assert np.array_equal(found.count.sum(), build_map(follows(0.0)).count.sum())


def test_a_latency_mimics_mobility():
    """Why the two are not found together: v tau is all that shows."""
    late = scanned(duration_s=14.0, lines=10, tracker=Tracker(latency_ms=20.0), noise=TRUE_POSES)
    found = build_map(late, register_strokes=True).quality["mobility_mm"]
    speed = 68.0 * 10 / 14.0
    assert abs(found) == pytest.approx(speed * 0.020, rel=0.3)
    with pytest.raises(UsageError, match="mimics a latency"):
        build_map(late, register_strokes=True, latency_ms="auto")


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (lambda: follows(0.0, lumps=()), "no stroke crossed anything"),
        (lambda: scanned(duration_s=1.4, lines=1), "1 stroke over 10 mm; scan back and forth"),
    ],
    ids=["no lump", "one stroke"],
)
def test_strokes_that_fix_nothing_are_refused(scan, message):
    with pytest.raises(BadDataError, match=message):
        build_map(scan(), register_strokes=True)
