"""Scans and maps that are unlike an exam's: each accident is told, and "no lump" is never said of it.

The scans are `mapping_scans.make_scan` with noise, whose truth is known by construction.
"""

from __future__ import annotations

from collections.abc import Callable

import mapping_scans as scans
import numpy as np
import pytest
from posterior_maps import grid_map

from tactile_bayes.api.estimating import estimate_one
from tactile_bayes.api.settings import Settings
from tactile_bayes.declarations import replace
from tactile_bayes.errors import CANNOT_SHOW, BadDataError
from tactile_bayes.findings import finding
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.plausibility import against_no_lump, exam_findings, map_findings
from tactile_bayes.mapping.select import Jumps, find_faults, rate_doubt, scan_findings
from tactile_bayes.posterior.verdict import no_verdict
from tactile_bayes.scans import (
    ElementCalibration,
    HeadGeometry,
    HeadShape,
    Landmarks,
    PressureFrames,
    Scan,
    TrackerPoses,
)

WINDOW = (5.0, 14.0)
KPA_PER_COUNT = 0.004


def scan(amplitude: float = 0.6) -> Scan:
    """Strokes of a noisy array over a lump, 0 for none, at 100 frames a second; the level wanders as a hand's does."""
    rng = np.random.default_rng(7)
    clean = scans.make_scan(
        scans.strokes(reach_mm=30.0, lines=5, spacing_mm=5.0, per_line=100),
        field=scans.gaussian(amplitude=amplitude, sigma_x=5.0, sigma_y=5.0),
    )
    level = 1.0 + 0.2 * np.sin(np.arange(len(clean.frames)) / 17.0)
    kpa = clean.pressure_kpa() * level[:, None, None] + 0.1 * rng.standard_normal(clean.frames.counts.shape)
    shape = clean.head.shape
    calibration = ElementCalibration(np.full(shape, KPA_PER_COUNT), np.zeros(shape), 4095)
    frames = PressureFrames(clean.frames.time_s, np.rint(kpa / KPA_PER_COUNT).astype(np.uint16))
    return replace(clean, frames=frames, element_calibration=calibration)


def counts(change: Callable[[np.ndarray], np.ndarray], **calibration: float) -> Callable[[Scan], Scan]:
    """An accident to the counts, with what the file then says of gain and saturation."""

    def made(one: Scan) -> Scan:
        values = change(one.frames.counts.astype(np.int64)).astype(np.uint16)
        held = one.element_calibration
        gain = held.gain_kpa_per_count * calibration.get("gain", 1.0)
        told = ElementCalibration(gain, held.offset_kpa, int(calibration.get("saturation", held.saturation_count)))
        return replace(one, frames=PressureFrames(one.frames.time_s, values), element_calibration=told)

    return made


def half_a_row(values: np.ndarray) -> np.ndarray:
    values[:, 3] //= 2
    return values


def half_a_column(values: np.ndarray) -> np.ndarray:
    values[:, :, 3] //= 2
    return values


def frozen(values: np.ndarray) -> np.ndarray:
    values[150:350] = values[150]
    return values


def light(values: np.ndarray) -> np.ndarray:
    return np.where((np.arange(len(values)) % 170 == 60)[:, None, None], values, values // 8)


def poses(change: Callable[[TrackerPoses], TrackerPoses]) -> Callable[[Scan], Scan]:
    return lambda one: replace(one, poses=change(one.poses))


def moved(scale: float = 1.0, *, other_mm: float = 0.0) -> Callable[[Scan], Scan]:
    """Places in another unit, or every other one of a second tool."""

    def made(given: TrackerPoses) -> TrackerPoses:
        places = scale * given.position_mm
        places[1::2] += other_mm
        return TrackerPoses(given.time_s, places, given.quaternion_wxyz)

    return poses(made)


def timed(scale: float) -> Callable[[Scan], Scan]:
    def made(one: Scan) -> Scan:
        told = TrackerPoses(scale * one.poses.time_s, one.poses.position_mm, one.poses.quaternion_wxyz)
        return replace(one, frames=PressureFrames(scale * one.frames.time_s, one.frames.counts), poses=told)

    return made


def in_inches(one: Scan) -> Scan:
    head = HeadGeometry(one.head.surface_mm / 25.4, one.head.pitch_mm / 25.4, one.head.scanhead_from_tracker)
    return replace(one, head=head)


def other_pitch(ratio: float) -> Callable[[Scan], Scan]:
    """The pitch contradicts the taxels' places, which make the map."""
    return lambda one: replace(one, head=HeadGeometry(one.head.surface_mm, one.head.pitch_mm * ratio, np.eye(4)))


UNLIKE: dict[str, tuple[Callable[[Scan], Scan], str]] = {
    "10 bits, saturation left out": (counts(lambda c: np.minimum(c, 2400)), "highest count, 2,400"),
    "cut off at the bottom": (
        counts(lambda c: np.where(c < 2200, 0, c)),
        "readings stand at the lowest",
    ),
    "8 bits, saturation left out": (counts(lambda c: np.minimum(c // 10, 240), gain=10.0), "highest count, 240"),
    "12 bits left-aligned in 16": (
        counts(lambda c: np.minimum(c, 2400) * 16, gain=1 / 16, saturation=65535),
        "highest count, 38,400",
    ),
    "each taxel has an end": (
        counts(lambda c: np.minimum(c, 2200 + 10 * np.arange(64).reshape(8, 8))),
        "highest count",
    ),
    "full scale, declared": (
        counts(lambda c: np.minimum(c, 2950), saturation=2950),
        "left out for taxels at",
    ),
    "rounded to kPa": (counts(lambda c: np.rint(c * KPA_PER_COUNT), gain=1 / KPA_PER_COUNT), "one count is"),
    "an inverting amplifier": (counts(lambda c: c.max() - c, gain=3.0), "the map dips by"),
    "noise alone": (
        counts(lambda c: np.random.default_rng(5).normal(2300, 150, c.shape)),
        "as noise does",
    ),
    "readings stand still": (counts(frozen), "readings stand still"),
    "hardly a frame in the window": (counts(light), "frames are used ("),
    "two tools side by side": (moved(other_mm=8.0), "to and fro: they lie 13.9 mm beside"),
    "places in m": (moved(1e-3), "the head stood still"),
    "places in inches": (moved(1 / 25.4), "the head stood still"),
    "places in twentieths": (moved(20.0), "the places spread over"),
    "times in ms": (timed(1000.0), "frames come at 0.1 Hz"),
    "times in ks": (timed(1e-3), "frames come at 1e+05 Hz"),
    "array in inches": (in_inches, "no scan head is"),
    "pitch in inches": (other_pitch(1 / 25.4), "times as far apart as the pitch says"),
    "another head's pitch": (other_pitch(0.8), "1.25 times as far apart as the pitch says"),
}


def test_a_rig_that_presses_evenly_is_no_noise() -> None:
    """A bench holds the mean pressure to noise; what the head feels still goes over from frame to frame."""
    right = scan()
    c = right.frames.counts.astype(float)
    even = (
        c * (2300 + np.random.default_rng(6).normal(0, 5, len(c)))[:, None, None] / c.mean(axis=(1, 2), keepdims=True)
    )
    steady = replace(right, frames=PressureFrames(right.frames.time_s, np.rint(even).astype(np.uint16)))
    assert not any("as noise does" in one.text for one in build_map(steady, as_stated=True).findings)


@pytest.mark.long_repeats
@pytest.mark.parametrize(("made", "told"), UNLIKE.values(), ids=UNLIKE)
def test_an_accident_is_told_and_is_no_map_without_a_lump(made: Callable[[Scan], Scan], told: str) -> None:
    tactile_map = build_map(made(scan()), as_stated=True, max_pose_gap_ms=1e6)
    assert any(told in one.text for one in tactile_map.findings if one.kind == "unlike_an_exam")
    why = no_verdict(tactile_map)
    assert why is not None
    assert why.code == CANNOT_SHOW


@pytest.mark.long
@pytest.mark.parametrize("name", ["readings stand still", "hardly a frame in the window"])
def test_an_estimate_from_it_says_that_it_cannot_show_a_lump(name: str) -> None:
    one, told = UNLIKE[name]
    found = estimate_one(build_map(one(scan(0.0)), as_stated=True), Settings(method="laplace")).estimate
    assert found.code == CANNOT_SHOW
    assert found.reason.startswith("the data cannot show whether there is a lump: ")
    assert told in found.reason


sixteen_bits = counts(lambda c: c * 65000 // c.max(), gain=4000 / 65000, saturation=65535)


@pytest.mark.parametrize(("amplitude", "bits"), [(0.0, 12), (0.6, 12), (0.6, 16)])
def test_a_right_scan_is_not_doubted(amplitude: float, bits: int) -> None:
    right = scan(amplitude) if bits == 12 else sixteen_bits(scan(amplitude))
    assert check_scan(right, pressure_window_kpa=WINDOW, thorough=False).doubts == ()
    assert not [one for one in build_map(right).findings if one.kind in ("unlike_an_exam", "unusual_scan")]


@pytest.mark.long
def test_a_map_without_a_lump_says_so_where_nothing_stands_against_it() -> None:
    found = estimate_one(build_map(scan(0.0)), Settings(method="laplace")).estimate
    assert found.code in ("empty", "undetected", "ridge")
    assert found.reason.startswith("no lump found")


UNUSUAL: dict[str, tuple[Callable[[Scan], Scan], str]] = {
    "a row of half the gain": (counts(half_a_row), "one of the array's rows reads 50 % of what"),
    "a column of half the gain": (counts(half_a_column), "one of the array's columns reads 50 % of what"),
    "a slow array read often": (counts(lambda c: np.repeat(c[::5], 5, axis=0)), "repeat the one before"),
    "each frame twice": (counts(lambda c: np.repeat(c[::2], 2, axis=0)), "repeat the one before"),
    "wrapped below 0": (
        counts(lambda c: np.where(c == c.min(), 65530, c), saturation=65535),
        "stand just below 65,536",
    ),
    "lever arm in cm": (
        lambda one: replace(
            one, head=HeadGeometry(one.head.surface_mm, one.head.pitch_mm, rigid(np.eye(3), np.array([0, 3.0, 4.0])))
        ),
        "the tracker's sensor lies 5 mm from the head",
    ),
    "landmarks of the head": (
        lambda one: replace(one, landmarks=Landmarks(np.array([0.0, 5, 0]), np.array([0.0, -9, 0]))),
        "14 mm apart",
    ),
    "landmarks of another base": (
        lambda one: replace(one, landmarks=Landmarks(np.array([900.0, 200, 0]), np.array([900.0, 0, 0]))),
        "no nearer to the xiphoid",
    ),
}


@pytest.mark.parametrize(("made", "told"), UNUSUAL.values(), ids=UNUSUAL)
def test_a_fault_that_hides_no_lump_is_reported_and_leaves_the_verdict(made: Callable[[Scan], Scan], told: str) -> None:
    one = made(scan(0.0))
    doubts = check_scan(one, pressure_window_kpa=WINDOW, thorough=False).doubts
    assert any(told in each.text for each in doubts if each.kind == "unusual_scan")
    why = no_verdict(build_map(one))
    assert why is None or told not in why.reason


def test_a_clock_that_stands_still_is_told_and_a_map_without_times_is_not_doubted() -> None:
    """A live map counts frames and keeps no times."""
    counted = {"frames_total": 500.0, "frames_used": 480.0}
    assert exam_findings(counted) == ()
    assert not any("clock" in one.text for one in exam_findings({"frames_total": 1.0, "frames_missing": 0.0}))
    assert "clock stands still" in exam_findings({**counted, "frames_missing": 0.0})[0].text


@pytest.mark.parametrize(
    ("figures", "told"),
    [
        ({"frames_used": 10.0, "dropped_high": 480.0}, "press less hard"),
        ({"frames_used": 10.0, "dropped_low": 480.0}, "press harder"),
        ({"frames_used": 10.0, "dropped_no_pose": 480.0}, "check the tracker and its times"),
        ({"frames_used": 10.0, "frames_total": 10.0}, "scan for longer"),
        ({"frames_used": 10.0, "frames_total": 10.0, "frames_every": 50.0, "frame_rate_hz": 2.0}, "use more frames"),
        (
            {"frames_used": 480.0, "plateau_readings": 50.0, "plateau_count": 2400.0},
            "state it at its import: --saturation",
        ),
        ({"frames_used": 480.0, "span_x_mm": 900.0}, "check that they are in mm and none jumps"),
        ({"frames_used": 300.0, "dropped_elements": 200.0}, "press less hard, or repair the array"),
        ({"frames_used": 480.0, "pose_zigzag_mm": 40.0}, "record one tool of the tracker"),
        ({"frames_used": 480.0, "cut_share": 0.3}, "press the whole head on the skin"),
        ({"frames_used": 480.0, "landmark_distance_mm": 20.0}, "check that landmarks are in the tracker's base"),
        ({"frames_used": 480.0, "frame_rate_hz": 4.9999999999}, None),
        ({"frames_used": 480.0, "frame_rate_hz": 2.0, "frames_every": 50.0}, None),
    ],
)
def test_what_is_to_be_done_follows_from_the_figures(figures: dict[str, float], told: str | None) -> None:
    findings = exam_findings({"frames_total": 500.0, **figures})
    assert [one.remedy.startswith(str(told)) for one in findings] == ([] if told is None else [True])
    for one in findings:  # on paper only what an examiner does
        theirs = one.remedy.startswith(("press ", "scan "))
        assert one.on_paper == (one.remedy if theirs else "have the sensor, the tracker and the recording checked")


def test_a_map_of_few_frames_or_of_fine_cells_is_not_of_a_head_that_stood_still() -> None:
    few = scan()
    few = replace(few, frames=PressureFrames(few.frames.time_s[:10], few.frames.counts[:10]))
    for one, cell_mm in ((few, 1.0), (scan(), 0.1)):
        assert not [each for each in build_map(one, cell_mm=cell_mm).findings if "stood still" in each.text]


# --- trackers that stand still


def still(*spans: tuple[int, int], place: bool = True, rotation: bool = False) -> Callable[[Scan], Scan]:
    """Places, rotations or both that repeat the first of each span, of a hand whose rotation always wanders."""

    def made(given: TrackerPoses) -> TrackerPoses:
        places, angle = given.position_mm.copy(), 0.1 * np.sin(7.0 * given.time_s)
        turns = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
        for start, stop in spans:
            if place:
                places[start:stop] = places[start]
            if rotation:
                turns[start:stop] = turns[start]
        return TrackerPoses(given.time_s, places, turns)

    return poses(made)


FROZEN: dict[str, tuple[Callable[[Scan], Scan], str]] = {
    "place": (still((130, 230)), "for 0.99 s from 101.30 s on"),
    "rotation": (still((130, 230), place=False, rotation=True), "for 0.99 s from 101.30 s on"),
    "both": (still((130, 230), rotation=True), "for 0.99 s from 101.30 s on"),
    "place, several times": (still((20, 60), (130, 160), (230, 260)), "for 0.39 s from 100.20 s on (longest of 3)"),
    "to the end": (still((300, 500)), "from 103.00 s on"),
}


@pytest.mark.long_repeats
@pytest.mark.parametrize(("made", "told"), FROZEN.values(), ids=FROZEN)
def test_a_tracker_that_stands_still_is_told_and_its_frames_are_left_out(
    made: Callable[[Scan], Scan], told: str
) -> None:
    one, right = made(scan()), still()(scan())
    for findings in (build_map(one).findings, check_scan(one, thorough=False).doubts):
        (remedy,) = {found.remedy for found in findings if found.kind == "times_apart" and told in found.text}
        assert remedy.startswith("if the map has a hole at the lump, record again")
    missing = build_map(one).quality["dropped_no_pose"] - build_map(right).quality["dropped_no_pose"]
    assert missing >= 90


def test_a_slow_tracker_raises_no_finding() -> None:
    """Each pose sent twice, thrice and four times: up to 40 ms old."""
    for times in (1, 2, 3, 4):
        slow = still()(scan())
        first = np.arange(len(slow.poses)) // times * times
        held = slow.poses
        slow = replace(slow, poses=TrackerPoses(held.time_s, held.position_mm[first], held.quaternion_wxyz[first]))
        assert not [one for one in build_map(slow).findings if one.kind == "times_apart"]
        assert check_scan(slow, thorough=False).doubts == ()


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_a_check_of_a_scan_without_places_tells_it(noise_mm: float) -> None:
    noise = noise_mm * np.random.default_rng(4).standard_normal((500, 3))
    one = poses(lambda given: TrackerPoses(given.time_s, noise, given.quaternion_wxyz))(still()(scan()))
    told = "the head stood still" if noise_mm else "the tracker repeated one place"
    assert any(told in doubt.text for doubt in check_scan(one, thorough=False).doubts)


# --- a map's cells, of whatever source


def grid(change: Callable[[np.ndarray], np.ndarray]) -> list[str]:
    values = 1.0 + 0.02 * np.random.default_rng(3).standard_normal((51, 51))
    y, x = np.mgrid[-25:26, -25:26]
    lump = 0.4 * np.exp(-(x**2 + y**2) / 50.0)
    return [one.text for one in map_findings(grid_map(change(values + lump), count=40))]


def dead(values: np.ndarray) -> np.ndarray:
    values[:, 40] = 0.0
    return values


def filled(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def made(values: np.ndarray) -> np.ndarray:
        values[3:6, 3:9] = value
        return values

    return made


@pytest.mark.parametrize("value", [1e20, -9999.0, 65535.0, 255.0, -1.0, 9999.0])
def test_values_that_stand_for_none_are_reported(value: float) -> None:
    assert any("18 of 2601 cells lie far outside the rest" in text for text in grid(filled(value)))


def test_a_map_that_dips_where_a_lump_would_rise_is_told_and_a_slope_is_not() -> None:
    """Readings that fall where pressure rises, as of a white that is zero or an inverting amplifier."""
    assert any("the map dips by" in text for text in grid(lambda v: 2.0 - v))
    assert any("the map dips by" in text for text in grid(lambda v: 10.0 * (2.0 - v)))
    assert any("the map dips by" in text for text in grid(lambda v: np.where(corner(5), np.nan, 2.0 - v)))
    assert grid(lambda v: v - 0.6 * np.roll(v - 1.0, 15, axis=1)) == []  # beside a higher rise
    assert grid(lambda v: v - 1.2) == []  # a level below 0, as of differences
    slope = 0.5 * np.mgrid[-25:26, -25:26][1] / 51
    assert grid(lambda v: v + slope) == grid(lambda v: v * (1.0 + slope)) == []


@pytest.mark.parametrize("kind", ["late_poses", "wrong_arrangement"])
def test_another_arrangement_hides_a_lump_where_it_is_sure(kind: str) -> None:
    """Odds from 10^4 on, below which the same finding is a caution."""
    flat = grid_map(1.0 + 0.02 * np.random.default_rng(3).standard_normal((51, 51)), count=40)
    told = finding(kind, "not as stated")
    for odds, against in ((9e3, []), (1.1e4, [told])):
        one = replace(flat, findings=(told,), quality={**flat.quality, "arrangement_log_odds": np.log(odds)})
        assert against_no_lump(one) == against


def test_a_grid_that_could_not_show_a_lump_is_reported() -> None:
    assert any("all 2601 cells hold 1: nothing was felt" in text for text in grid(np.ones_like))
    assert any("the grid covers 3.6 cm2" in text for text in grid(lambda v: np.where(corner(19), v, np.nan)))
    assert grid(lambda v: np.where(corner(30), v, np.nan)) == []


def corner(cells: int) -> np.ndarray:
    inside = np.zeros((51, 51), dtype=bool)
    inside[:cells, :cells] = True
    return inside


@pytest.mark.parametrize(("saturated", "told"), [(128.0, []), (192.0, ["3.0 % of the readings were at full scale"])])
def test_readings_left_out_at_full_scale_are_told_as_a_share_of_all(saturated: float, told: list[str]) -> None:
    """Of 100 frames of 8 x 8 taxels."""
    head, quality = HeadShape(8, 8, 2.0, None), {"saturated_readings": saturated}
    one = replace(grid_map(np.ones((51, 51)) + np.arange(51) / 500), head=head, frame_count=100, quality=quality)
    assert [found.text[:40] for found in map_findings(one)] == told


def test_a_dead_line_and_a_plateau_are_told_and_a_lump_is_not() -> None:
    assert any("51 of 2601 cells lie far outside the rest" in text for text in grid(dead))
    assert any("cells stand at the highest value" in text for text in grid(lambda v: np.minimum(v, 1.2)))
    assert grid(lambda v: v) == []
    assert grid(lambda v: np.minimum(v, np.sort(v, axis=None)[-20])) == []  # 20 cells at the top: too few to tell
    assert grid(lambda v: v + 3.0 * (np.arange(51) > 25)) == []  # two levels are no values that stand for none
    assert grid(lambda v: np.rint(100 * v)) == []  # whole numbers, as an image has them


# --- taxels and refusals


@pytest.mark.parametrize(
    ("away", "told"),
    [([False, True, True], ["once"]), ([False, True, False], ["2 times"]), ([False, False, False], [])],
)
def test_jumps_are_counted(away: list[bool], told: list[str]) -> None:
    places = np.zeros((3, 3)) + 300.0 * np.array(away)[:, None]
    jumps = Jumps.of(TrackerPoses(np.arange(3) / 100, places, np.tile([1.0, 0, 0, 0], (3, 1))))
    assert [line.split(",")[0] for line in jumps.cautions()] == [f"the poses jump {often}" for often in told]


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (moved(1000.0), "the places of the head spread over 60,000 mm"),
        (moved(other_mm=60.0), "the poses jump"),
    ],
    ids=["places in um", "two tools"],
)
def test_poses_of_no_hand_are_refused_by_their_cause(made: Callable[[Scan], Scan], told: str) -> None:
    with pytest.raises(BadDataError, match=told):
        build_map(made(scan()), as_stated=True)


@pytest.mark.parametrize(
    ("rate_hz", "unit"),
    [(0.2, "milli"), (2e-4, "micro"), (2e-7, "nano"), (12_000.0, "minutes"), (1e8, None), (5.0, ""), (2000.0, "")],
)
def test_a_rate_that_no_array_has_names_the_unit_of_times_that_would_fit(rate_hz: float, unit: str | None) -> None:
    """In s they would come at 200 Hz."""
    doubt = rate_doubt(rate_hz)
    asked = "check the frames' times" if unit is None else f"are the times in {unit}"
    assert (doubt is None) if unit == "" else doubt[1].startswith(asked)


@pytest.mark.parametrize(
    ("lever_mm", "told"), [(0.0, False), (9.0, True), (50.0, False), (290.0, False), (310.0, True)]
)
def test_a_sensor_nearer_or_farther_than_a_handle_is_told(lever_mm: float, told: bool) -> None:
    one = scan()
    head = HeadGeometry(one.head.surface_mm, one.head.pitch_mm, rigid(np.eye(3), np.array([0.0, 0.0, -lever_mm])))
    assert [found.kind for found in scan_findings(replace(one, head=head))] == ["unusual_scan"] * told


def test_what_the_recorder_told_is_told_once() -> None:
    one = moved(other_mm=60.0)(scan())
    told = scan_findings(one)
    assert [found.kind for found in told] == ["poses_jump"]
    assert scan_findings(replace(one, findings=told)) == told


@pytest.mark.parametrize("value", [0, 1700], ids=["dead", "stuck"])
def test_a_line_that_dies_on_the_way_is_left_out(value: int) -> None:
    def dies(values: np.ndarray) -> np.ndarray:
        values[350:, 3, :6] = value
        return values

    assert {(one.row, one.fault) for one in find_faults(counts(dies)(scan()))} == {(3, "stuck")}
    assert find_faults(scan()) == ()


@pytest.mark.parametrize(
    ("made", "asked"),
    [
        (counts(lambda c: c, gain=1 / 6.895), "are these psi"),
        (counts(lambda c: c, gain=1 / 0.1333, saturation=65535), "are these mmHg"),
        (counts(lambda c: c, gain=1000.0, saturation=65535), "or Pa"),
        (counts(lambda c: np.rint(c * KPA_PER_COUNT)), "are the counts kPa already"),
        (counts(lambda c: c * 16), "multiples of 16: fewer bits, left-aligned"),
    ],
    ids=["psi", "mmHg", "Pa", "counts are kPa", "left-aligned"],
)
def test_a_refusal_asks_about_the_unit_that_fits(made: Callable[[Scan], Scan], asked: str) -> None:
    for refuses in (build_map, check_scan):
        with pytest.raises(BadDataError, match=asked.removeprefix("or ")):
            refuses(made(scan()))
