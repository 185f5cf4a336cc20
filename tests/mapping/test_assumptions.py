"""What breaks an assumption of a size shows in a map's figures: each with a known answer, and a control without it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import legendre

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.scene import Background, Lump, Noise, Scene, Strokes, Tracker, head_poses
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.convention import corrected
from tactile_bayes.mapping.map import broken_assumptions, handling_findings, skewed
from tactile_bayes.scans import PressureFrames, Scan
from validation.stress_frames import on_sphere

TRUE_POSES = Noise(element_kpa=0.1, tracker_mm=0.0, tracker_deg=0.0)
LEVEL_KPA = 9.5


def told(quality: dict[str, float], severity: str) -> list[str]:
    return [one.sentence() for one in broken_assumptions(quality) if one.severity == severity]


def scene(**changes) -> Scene:
    return Scene(**({"duration_s": 8.0, "frame_rate_hz": 60.0, "strokes": Strokes(tilt_deg=0.5)} | changes))


def scan_of(one: Scene) -> Scan:
    return simulate(one, rng=np.random.default_rng(one.seed)).scan


def figures(scan: Scan) -> dict[str, float]:
    return dict(build_map(scan).quality)


def pressed(*, change: float = 0.0, skew: float = 0.0) -> Scan:
    """A scan whose readings follow a profile: second order across by the place along x, first by the stroke."""
    scan = scan_of(scene(noise=TRUE_POSES))
    _, origin = head_poses(scene(), scan.frames.time_s)
    x, y = ((2 * np.arange(n) + 1) / n - 1 for n in (16, 26))
    way = np.sign(np.gradient(origin[:, 0]))
    readings = np.empty(scan.frames.counts.shape)
    for i in range(len(readings)):
        terms = np.zeros((3, 3))
        terms[0, 0], terms[2, 0] = 1.0, 0.05 + change * origin[i, 0] / 30.0
        terms[0, 2], terms[1, 0] = 0.03, skew * way[i]
        readings[i] = LEVEL_KPA * legendre.leggrid2d(x, y, terms)
    gain = scan.element_calibration.gain_kpa_per_count
    noise = np.random.default_rng(3).standard_normal(readings.shape) * 0.1
    counts = np.rint((readings + noise) / gain).astype(np.uint16)
    return replace(scan, frames=PressureFrames(scan.frames.time_s, counts))


@pytest.mark.parametrize("change", [0.0, 0.004, 0.03, 0.1])
def test_a_profile_that_changes_with_the_place_is_measured(change: float) -> None:
    found = figures(pressed(change=change))
    assert found["profile_change"] == pytest.approx(change, rel=0.05, abs=0.002)
    assert len(told(found, "check")) == (0.01 < change < 0.07)
    assert len(told(found, "caution")) == (change > 0.07)


@pytest.mark.parametrize("skew", [0.0, 0.02, -0.02])
def test_a_profile_skewed_along_the_strokes_is_measured(skew: float) -> None:
    found = figures(pressed(skew=skew))
    assert found["stroke_skew"] == pytest.approx(skew, abs=0.002)
    assert bool(skewed(found)) == (skew != 0)
    assert told(found, "check") == []


@pytest.mark.parametrize("radius_mm", [np.inf, 150.0, 75.0])
def test_the_curvature_is_that_of_the_sphere_the_head_moved_on(radius_mm: float) -> None:
    """The head's apex is 5 mm deep in this model, so its path is that much more curved than the skin."""
    one = scene(noise=TRUE_POSES, strokes=Strokes(tilt_deg=0.0, wander_mm=0.0))
    found = figures(on_sphere(one, scan_of(one), radius_mm) if np.isfinite(radius_mm) else scan_of(one))
    assert found["skin_curvature_per_m"] == pytest.approx(1000.0 / (radius_mm - 5.0), rel=0.05, abs=0.05)
    assert any("skin is curved outwards" in text for text in told(found, "check")) == (radius_mm < 200)


def test_few_strokes_round_a_small_breast_are_not_taken_for_rotations_of_another_convention() -> None:
    """The head sank by more than the lines lay apart: face and motion were 86 degrees apart. The control is wrong."""
    one = scene(noise=TRUE_POSES, strokes=Strokes(lines=3, spacing_mm=4.0, half_length_mm=36.0))
    scan = on_sphere(one, scan_of(one), 60.0)
    assert figures(scan)["normal_agreement"] > 0.99
    with pytest.raises(BadDataError, match="degrees apart"):
        build_map(corrected(scan, ["scalar-last"]), as_stated=True)


def dragged(lag_mm: float, **changes) -> Scan:
    """A Gaussian lump that lies `lag_mm` ahead in every stroke."""
    one = scene(noise=TRUE_POSES, **changes)
    ways = [scan_of(replace(one, lumps=(Lump(x_mm=way * lag_mm),))) for way in (1, -1)]
    _, origin = head_poses(one, ways[0].frames.time_s)
    forth = (np.gradient(origin[:, 0]) > 0)[:, None, None]
    counts = np.where(forth, ways[0].frames.counts, ways[1].frames.counts)
    return replace(ways[0], frames=PressureFrames(ways[0].frames.time_s, counts))


@pytest.mark.parametrize("lag_mm", [0.0, pytest.param(0.6, marks=pytest.mark.long), 1.8])
def test_a_lump_that_is_dragged_along_is_seen_apart(lag_mm: float) -> None:
    found = figures(dragged(lag_mm))
    assert found["stroke_lag_mm"] == pytest.approx(lag_mm, abs=0.15 + 0.35 * lag_mm)  # one linear step
    assert found["stroke_lag_sd_mm"] < 0.2
    texts = told(found, "caution")
    assert ["--register-strokes" in text for text in texts] == ([True] if lag_mm > 1.2 else [])


def test_a_latency_shows_as_a_lag_the_other_way() -> None:
    """Its reference is the path: a pose that is late by t is off by v t."""
    late_ms = 35.0
    one = scene(noise=TRUE_POSES, lumps=(Lump(),))
    found = figures(scan_of(replace(one, tracker=Tracker(latency_ms=late_ms))))
    time = np.linspace(0.0, one.duration_s, 2000)
    _, origin = head_poses(one, time)
    near = np.abs(origin[:, 0]) < 12.0
    speed = float(np.abs(np.gradient(origin[:, 0], time))[near].mean())
    assert found["stroke_lag_mm"] == pytest.approx(-speed * late_ms / 1000.0, rel=0.3)  # one linear step
    (caution,) = told(found, "caution")
    assert "as if the tracker's positions came late" in caution
    assert "--latency-ms auto" in caution
    assert told(figures(scan_of(one)), "caution") == []


@pytest.mark.parametrize("lines", [1, 3, 4, 6])
def test_strokes_are_counted_and_few_of_them_told(lines: int) -> None:
    """The reference is the scene; wandering and turns are no strokes."""
    found = figures(scan_of(scene(duration_s=1.4 * lines, strokes=Strokes(lines=lines, wander_mm=1.5, tilt_deg=2.0))))
    assert found["stroke_count"] == lines
    checks = [text for text in told(found, "check") if "stroke" in text]
    assert len(checks) == (lines < 4)
    assert all(f"has {lines} stroke{'s' if lines > 1 else ''} only" in text for text in checks)


@pytest.mark.parametrize(
    ("yaw_deg", "mean_kpa", "words"),
    [
        (90.0, 9.5, "sizes were learned from strokes across it; scan with the head turned by 90 degrees"),
        (0.0, 15.0, "the 106 frames used make 3 strokes only"),
    ],
)
def test_strokes_along_the_head_or_left_out_are_not_called_few(yaw_deg: float, mean_kpa: float, words: str) -> None:
    pressed = Background(mean_kpa, drift_kpa=1.5, ramp_s=0.0)
    one = scan_of(scene(strokes=Strokes(yaw_deg=yaw_deg), background=pressed))
    (text,) = (each.sentence() for each in build_map(one).findings if each.kind == "few_strokes")
    assert words in text


def test_a_figure_that_its_error_does_not_tell_from_0_says_nothing() -> None:
    sure = {"profile_change": 0.05, "profile_change_sd": 0.01, "stroke_lag_mm": 3.0, "stroke_lag_sd_mm": 0.2}
    sure |= {"stroke_skew": 0.03, "stroke_skew_sd": 0.002}
    assert len(told(sure, "caution")) == len(told(sure, "check")) == 1
    assert skewed(sure)
    unsure = {name: 0.5 if name.startswith("stroke_skew_sd") else value for name, value in sure.items()}
    unsure |= {"profile_change_sd": 0.05, "stroke_lag_sd_mm": 2.0}
    assert not list(broken_assumptions(unsure))
    assert not skewed(unsure)
    assert not list(broken_assumptions({}))
    few = {"stroke_lag_mm": 255.7, "stroke_lag_sd_mm": 0.001, "frames_used": 12.0}
    assert not list(broken_assumptions(few))  # strokes 511 mm apart, of which it saw one


@pytest.mark.parametrize(
    ("at_limit", "beyond", "words"),
    [
        (
            {"saturated_readings": 0.0},
            {"saturated_readings": 12.0},
            "12 readings were pressed beyond the array's range",
        ),
        ({"clipped_values": 0.0}, {"clipped_values": 3.0}, "3 values beyond the map's range were clipped"),
        ({"gain_unsettled": 0.0}, {"gain_unsettled": 1.0}, "scan with overlapping strokes"),
        ({"coverage": 0.5}, {"coverage": 0.4}, "only 40 % of the map's rectangle is covered"),
        ({"tilt_deg": 10.0}, {"tilt_deg": 11.0}, "the head's face was tilted by 11 degrees"),
        ({"yaw_sd_deg": 15.0}, {"yaw_sd_deg": 16.0}, "the head was turned by 16 degrees"),
    ],
)
def test_how_the_head_was_held_and_read_is_told_beyond_its_limit(
    at_limit: dict[str, float], beyond: dict[str, float], words: str
) -> None:
    assert not list(handling_findings(at_limit))
    (found,) = handling_findings(beyond)
    assert words in found.sentence()


def test_a_scan_without_strokes_both_ways_has_no_lag_and_no_skew() -> None:
    scan = scan_of(scene(duration_s=1.4, strokes=Strokes(lines=1, tilt_deg=0.5), lumps=(Lump(),)))
    forth = figures(scan)
    assert not {"stroke_lag_mm", "stroke_skew"} & set(forth)
