"""Latency and mobility from the scan itself, each with what it must refuse and a control that it would show."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.forward.scene import Lump, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.simulate import head_poses, simulate
from tactile_bayes.mapping.build import build_map, stroke_figures
from tactile_bayes.mapping.convention import stroke_starts
from tactile_bayes.mapping.latency import StrokeShift
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.white import fit_bump
from tactile_bayes.scans import HeadGeometry, Landmarks, PressureFrames, Scan, TrackerPoses

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
    scene = Scene(duration_s=11.2, strokes=Strokes(lines=8, spacing_mm=3.5))
    ways = [
        simulate(
            replace(scene, lumps=tuple(replace(one, x_mm=way * delta_mm) for one in lumps)),
            rng=np.random.default_rng(1),
        ).scan
        for way in ((1, -1) if delta_mm else (1,))
    ]
    _, origin = head_poses(scene, ways[0].frames.time_s)
    forth = (np.gradient(origin[:, 0]) > 0)[:, None, None]
    counts = np.where(forth, ways[0].frames.counts, ways[-1].frames.counts)
    return replace(ways[0], frames=PressureFrames(ways[0].frames.time_s, counts))


def sigma_x(tactile_map: TactileMap) -> float:
    row, column = np.unravel_index(
        int(np.nanargmax(np.where(tactile_map.count > 30, tactile_map.mean, np.nan))), tactile_map.mean.shape
    )
    centre = (float(tactile_map.x_mm[column]), float(tactile_map.y_mm[row]))
    fit, _ = fit_bump(tactile_map, centre, options=SamplerSettings(background="free"))
    assert fit is not None
    return fit.widths()[0]


@pytest.mark.long
def test_the_latency_is_found_and_used():
    late = scanned(duration_s=14.0, lines=10, tracker=Tracker(latency_ms=LATE_MS), noise=TRUE_POSES)
    found = build_map(late, latency_ms="auto")
    sd = found.quality["latency_sd_ms"]
    assert found.recipe.latency_ms == pytest.approx(LATE_MS, abs=max(3 * sd, 0.1))
    assert sd < 1.0
    assert np.nanmedian(found.variance) < np.nanmedian(build_map(late).variance)


@pytest.mark.parametrize("way", [1, -1])
def test_strokes_are_told_whichever_way_the_first_one_goes(way):
    x = way * (40.0 - np.abs(np.mod(np.arange(160.0), 80.0) - 40.0))  # 0 to 40 mm and back, twice
    assert stroke_starts(x) == [0, 40, 80, 120, 160]


def backwards(scan: Scan) -> Scan:
    """The same scan with time running the other way: what was late is early."""
    end = scan.frames.time_s[-1] + 1.0
    frames = PressureFrames(end - scan.frames.time_s[::-1], scan.frames.counts[::-1])
    poses = TrackerPoses(end - scan.poses.time_s[::-1], scan.poses.position_mm[::-1], scan.poses.quaternion_wxyz[::-1])
    return replace(scan, frames=frames, poses=poses)


@pytest.mark.long
def test_a_scan_played_backwards_is_as_early_as_it_was_late():
    """The sign of the latency: a control, since a wrong sign would be right about one of the two."""
    late = scanned(duration_s=10.0, lines=7, tracker=Tracker(latency_ms=LATE_MS))
    forth, back = (build_map(scan, latency_ms="auto") for scan in (late, backwards(late)))
    assert forth.recipe.latency_ms == pytest.approx(LATE_MS, abs=3 * forth.quality["latency_sd_ms"])
    assert back.recipe.latency_ms == pytest.approx(-LATE_MS, abs=3 * back.quality["latency_sd_ms"])
    assert forth.quality["latency_bound_ms"] <= forth.quality["latency_sd_ms"] < 2.0


def flipped(scan: Scan, axis: int, *, geometry: bool = True) -> Scan:
    """The head with its rows (axis 0) or columns (axis 1) counted from the other side."""
    counts = PressureFrames(scan.frames.time_s, np.flip(scan.frames.counts, axis + 1))
    if not geometry:
        return replace(scan, frames=counts)
    head = replace(scan.head, surface_mm=np.flip(scan.head.surface_mm, axis))
    array = scan.element_calibration
    gain, offset = (np.flip(one, axis) for one in (array.gain_kpa_per_count, array.offset_kpa))
    array = replace(array, gain_kpa_per_count=gain, offset_kpa=offset)
    return replace(scan, frames=counts, head=head, element_calibration=array)


def mirrored(scan: Scan, axis: int) -> Scan:
    """The whole scene in a mirror: the other breast, stroked the other way about."""
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    mirror = np.diag([*sign, 1.0])
    time, position, turn = scan.poses.time_s, scan.poses.position_mm, scan.poses.quaternion_wxyz
    head = HeadGeometry(
        scan.head.surface_mm * sign, scan.head.pitch_mm, mirror @ scan.head.scanhead_from_tracker @ mirror
    )
    poses = TrackerPoses(time, position * sign, turn * np.array([1.0, *-sign]))  # an axis of rotation is a pseudovector
    assert scan.landmarks is not None
    marks = Landmarks(scan.landmarks.sternal_notch_mm * sign, scan.landmarks.xiphoid_mm * sign)
    return flipped(replace(scan, head=head, poses=poses, landmarks=marks), axis)


@pytest.mark.long
@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow)], ids=["rows", "columns"])
def test_a_mirrored_head_gives_the_same_latency(axis):
    """Counting taxels from the other side changes nothing; a mirrored scene changes only where cells begin.

    The control: readings whose order is not the described head's have no latency.
    """
    late = scanned(duration_s=7.0, lines=5, tracker=Tracker(latency_ms=LATE_MS))
    plain, turned, mirror = (
        build_map(one, latency_ms="auto") for one in (late, flipped(late, axis), mirrored(late, axis))
    )
    assert turned.recipe.latency_ms == pytest.approx(plain.recipe.latency_ms, abs=1e-6)
    assert mirror.recipe.latency_ms == pytest.approx(plain.recipe.latency_ms, abs=plain.quality["latency_sd_ms"])
    with pytest.raises(BadDataError, match="does not determine the tracker's latency"):
        build_map(flipped(late, axis, geometry=False), latency_ms="auto", as_stated=True)


def test_strokes_one_way_do_not_tell_the_latency():
    """The negative control: a map shifted by v tau looks the same."""
    late = scanned(duration_s=7.0, lines=5, tracker=Tracker(latency_ms=LATE_MS))
    way = np.floor(late.frames.time_s / (7.0 / 5)).astype(int) % 2 == 0
    one_way = replace(late, frames=PressureFrames(late.frames.time_s[way], late.frames.counts[way]))
    with pytest.raises(BadDataError, match="does not determine the tracker's latency"):
        build_map(one_way, latency_ms="auto")


@pytest.mark.long_repeats
@pytest.mark.parametrize(("name", "true_ms"), [("s01", 0.0), ("s03", 4.0), ("s05", 8.0), ("s11", 11.0)])
def test_the_latency_of_scans_by_an_independent_model_is_found(shared_data, name, true_ms):
    """Truth from truth.csv; the scans tilt and press as a hand does, unlike a map of bumps."""
    (path,) = (shared_data / "scans").glob(f"{name}_*.npz")
    found = build_map(scans.shared_scan(path), latency_ms="auto")
    sd = found.quality["latency_sd_ms"]
    assert abs(found.recipe.latency_ms - true_ms) < 2.5 * sd
    assert sd < 2.0


def test_an_empty_scan_by_an_independent_model_has_no_latency(shared_data):
    with pytest.raises(BadDataError, match="does not determine the tracker's latency"):
        build_map(scans.shared_scan(shared_data / "scans" / "s08_no_mass.npz"), latency_ms="auto")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_minute_gives_the_latency_to_a_tenth_of_a_millisecond(seed):
    late = scanned(duration_s=60.0, lines=40, seed=seed, tracker=Tracker(latency_ms=LATE_MS), noise=TRUE_POSES)
    assert build_map(late, latency_ms="auto").recipe.latency_ms == pytest.approx(LATE_MS, abs=0.1)


def test_a_scan_shorter_than_the_delays_that_are_tried_has_no_latency():
    """150 ms from the earliest to the latest: at one end or the other no frame has a pose."""
    short = scans.make_scan(scans.strokes(), field=scans.gaussian(), interval_s=0.001)
    with pytest.raises(BadDataError, match="no frame has a pose at every delay"):
        build_map(short, latency_ms="auto", as_stated=True)


def test_mobility_is_half_of_what_lies_between_strokes_forth_and_back():
    """Strokes whose shift is not known count for nothing, and strokes one way have no mobility."""
    forth, back = StrokeShift(0, 9, 0, 1, 2.0, 0.3, True), StrokeShift(20, 29, 0, -1, -1.0, 0.4, True)
    unknown = StrokeShift(10, 19, 0, -1)
    one_way = {
        "strokes": 2.0,
        "strokes_known": 1.0,
        "stroke_1_shift_x_mm": 2.0,
        "stroke_1_sd_x_mm": 0.3,
    }
    assert stroke_figures([forth, unknown]) == one_way
    both = {"strokes": 3.0, "strokes_known": 2.0, "stroke_3_shift_x_mm": -1.0, "stroke_3_sd_x_mm": 0.4}
    figures = one_way | both | {"mobility_mm": 1.5, "mobility_sd_mm": 0.25}
    assert stroke_figures([forth, unknown, back]) == pytest.approx(figures)


def test_without_a_lump_every_latency_fits_and_none_is_given():
    plain = scanned(duration_s=7.0, lines=5, lumps=(), tracker=Tracker(latency_ms=LATE_MS))
    with pytest.raises(
        BadDataError,
        match=r"does not determine the tracker's latency .*\+-\d+ ms only.*scan back and forth over a lump",
    ):
        build_map(plain, latency_ms="auto")


@pytest.mark.long
def test_a_lump_that_follows_the_head_is_measured_and_sharpened():
    scan = follows(2.0)
    blurred, sharp = build_map(scan), build_map(scan, register_strokes=True)
    assert sharp.quality["mobility_mm"] == pytest.approx(2.0, abs=0.1)
    assert sharp.quality["mobility_sd_mm"] < 0.1
    assert sharp.quality["strokes"] == sharp.quality["strokes_known"] == 8
    assert sharp.recipe.registered
    still = sigma_x(build_map(follows(0.0)))
    assert sigma_x(sharp) == pytest.approx(still, rel=0.01)
    assert sigma_x(blurred) > 1.03 * still  # the control: unregistered, it is too wide


@pytest.mark.long
def test_a_lump_that_stays_has_no_mobility():
    scan = follows(0.0)
    found = build_map(scan, register_strokes=True)
    assert abs(found.quality["mobility_mm"]) < 0.1
    assert found.count.sum() == build_map(scan).count.sum()


@pytest.mark.long
def test_a_latency_mimics_mobility():
    """Why the two are not found together: v tau is all that shows."""
    late = scanned(duration_s=14.0, lines=10, tracker=Tracker(latency_ms=20.0), noise=TRUE_POSES)
    found = build_map(late, register_strokes=True).quality["mobility_mm"]
    speed = 68.0 * 10 / 14.0
    assert abs(found) == pytest.approx(speed * 0.020, rel=0.3)
    with pytest.raises(UsageError, match="mimics a latency"):
        build_map(late, register_strokes=True, latency_ms="auto")


@pytest.mark.long
@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (lambda: follows(0.0, lumps=()), "0 of 8 strokes crossed a lump or an edge that fixes a shift"),
        (lambda: scanned(duration_s=1.4, lines=1), "1 stroke over 10 mm; scan back and forth"),
    ],
    ids=["no lump", "one stroke"],
)
def test_strokes_that_fix_nothing_are_refused(scan, message):
    with pytest.raises(BadDataError, match=message):
        build_map(scan(), register_strokes=True)
