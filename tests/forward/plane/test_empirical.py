"""Eqs 1 to 4 as the paper has them (and as it must have meant them), and their fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.plane import (
    SHARE,
    EmpiricalModel,
    build_line,
    fit_empirical,
    fit_shape,
    head_positions,
    kappa,
    lump_pressure,
    outside_range,
)
from tactile_bayes.studies.model_comparison import (
    PHANTOMS,
    PRINTED_FRAMES,
    PRINTED_MAPS,
    TableScene,
    compare,
    mean_squared_difference,
    phantom_scenes,
    scene_frames,
    table_scenes,
)
from tactile_bayes.studies.paper import StudySettings

S = 0.25 * (np.arange(96) - 47.5)
MODEL = EmpiricalModel(
    peak_kpa=9.0, curvature_per_mm2=0.003, height_kpa=4.0, width_mm=3.0, d_mm=10.0, half_width_mm=12.0
)


def test_equation_1_is_hertz_and_its_mirror() -> None:
    s = np.array([0.0, 5.0, 12.0, 12.1])
    falling = replace(MODEL, peak_kpa=10.0, curvature_per_mm2=1 / 20**2).homogeneous(s)
    np.testing.assert_allclose(falling, [10.0, 10 * np.sqrt(1 - 1 / 16), 8.0, 0.0])
    rising = replace(MODEL, peak_kpa=10.0, curvature_per_mm2=-1 / 20**2).homogeneous(s)
    np.testing.assert_allclose(rising[2], 10 * np.sqrt(1.36))
    narrow = replace(MODEL, peak_kpa=10.0, curvature_per_mm2=1 / 6**2).homogeneous(s)
    assert narrow[2] == 0.0  # beyond the contact, not an imaginary number


@given(d=st.floats(1.0, 50.0))
def test_equation_4_is_continuous(d: float) -> None:
    end = 8 * d / 3
    np.testing.assert_allclose(kappa(np.array([0.0, end, 2 * end]), d_mm=d), [0.5, 1.0, 1.0])
    below, above = kappa(np.array([end * (1 - 1e-9), end * (1 + 1e-9)]), d_mm=d)
    assert abs(above - below) < 1e-8
    x = np.linspace(-3 * end, 3 * end, 101)
    np.testing.assert_array_equal(kappa(x, d_mm=d), kappa(-x, d_mm=d))


def test_equation_2_has_sigma_squared_in_its_exponent() -> None:
    assert lump_pressure(np.array([3.0]), height_kpa=2.0, width_mm=3.0)[0] == pytest.approx(2 * np.exp(-0.5))


def test_equation_3_over_the_lump_and_far_from_it() -> None:
    p1 = MODEL.homogeneous(S)
    over = MODEL.surface_pressure(S, np.array(0.0))
    bump = lump_pressure(S, height_kpa=4.0, width_mm=3.0) * (p1 / 9.0) ** 2
    np.testing.assert_allclose(over, bump + SHARE * p1)
    np.testing.assert_allclose(MODEL.surface_pressure(S, np.array(80.0)), p1)


@given(
    peak=st.floats(1.0, 30.0), curvature=st.floats(-0.02, 0.006), height=st.floats(0.5, 20.0), width=st.floats(1.0, 8.0)
)
def test_the_fit_finds_what_it_was_made_of(peak: float, curvature: float, height: float, width: float) -> None:
    p1 = replace(MODEL, peak_kpa=peak, curvature_per_mm2=curvature).homogeneous(S)
    p0 = lump_pressure(S, height_kpa=height, width_mm=width) + SHARE * p1
    found = fit_empirical(S, p1, p0, d_mm=10.0, half_width_mm=12.0)
    assert found.peak_kpa == pytest.approx(peak, rel=1e-4)
    assert found.curvature_per_mm2 == pytest.approx(curvature, abs=2e-6)
    assert found.height_kpa == pytest.approx(height, rel=2e-3)
    assert found.width_mm == pytest.approx(width, rel=2e-3)


def test_the_map_is_the_average_of_the_curves() -> None:
    x_c = head_positions((-40.0, 40.0, 0.5))
    frames = MODEL.frames(x_c, S)
    line = build_line(frames)
    k = int(np.argmin(np.abs(line.x_mm - 2.25)))
    readings = [
        MODEL.surface_pressure(s, x) / mean
        for x, mean in zip(x_c, frames.pressure_kpa.mean(axis=1), strict=True)
        for s in S
        if line.x_mm[k] - 0.25 <= x + s + 1e-9 < line.x_mm[k] + 0.25 + 1e-9
    ]
    assert line.count[k] == len(readings) == 96
    assert line.mean[k] == pytest.approx(np.mean(readings), rel=1e-12)


def test_a_shape_is_found_at_the_lowest_minimum_also_where_it_explains_little() -> None:
    x = np.linspace(-48, 48, 193)
    trough = -0.03 * np.exp(-0.5 * (x / 25) ** 2)

    def bump(log_width: float) -> np.ndarray:
        return np.exp(-0.5 * (x / np.exp(log_width)) ** 2)

    data = trough + 0.02 * bump(np.log(4.0))
    found = fit_shape(bump, data, grid=np.linspace(np.log(0.3), np.log(40.0), 60))
    every = np.linspace(np.log(0.3), np.log(40.0), 20_001)
    left = [np.sum(data**2) - (bump(w) @ data) ** 2 / (bump(w) @ bump(w)) for w in every]
    assert found.sse == pytest.approx(min(left), rel=1e-6)
    assert found.parameter == pytest.approx(every[int(np.argmin(left))], abs=2e-3)


def test_too_short_a_frame_is_named() -> None:
    with pytest.raises(BadDataError, match="a frame of 3 cells"):
        fit_empirical(S[:3], np.ones(3), np.ones(3), d_mm=10.0, half_width_mm=12.0)


def test_the_tables_cases_are_the_papers() -> None:
    scenes = table_scenes(0.0)
    assert [(scene.d_mm, scene.depth_ratio) for scene in scenes[:5]] == [(d, 0.6) for d in (5, 10, 15, 20, 25)]
    assert len(scenes) == 10
    assert sum(map(sum, PRINTED_FRAMES.values())) / 10 == pytest.approx(4.14)
    assert sum(map(sum, PRINTED_MAPS.values())) / 10 == pytest.approx(2.44)
    assert list(PHANTOMS.values()) == [(12.5, 0.825), (15.5, 1.0), (15.5, 1.4), (18.75, 1.2)]
    assert len({scene.name for scene in [*scenes, *phantom_scenes(0.0)]}) == 14


def test_the_difference_is_what_it_is_said_to_be() -> None:
    assert mean_squared_difference(np.array([1.0, 3.0]), np.array([1.0, 2.0])) == pytest.approx(0.2)


@pytest.fixture(scope="module")
def quick() -> StudySettings:
    return StudySettings(positions_mm=(-40.0, 40.0, 0.5), fit_radius_mm=28.0, fineness=1)


def test_where_the_paper_shows_agreement_there_is_some(quick: StudySettings) -> None:
    """Its first phantom, the lump resting: curves of figure 6."""
    elastic, empirical = map(build_line, scene_frames(TableScene("first", 12.5, 0.825, 1.0), quick))
    inner = np.abs(elastic.x_mm) < 25
    ours, theirs = empirical.mean[inner], elastic.mean[inner]
    assert mean_squared_difference(ours, theirs) < 0.026
    assert ours.max() == pytest.approx(theirs.max(), rel=0.1)


def test_a_small_difference_of_squares_hides_a_wrong_bump(quick: StudySettings) -> None:
    """Decision 0007: the norm that the paper prints does not see what the strict one and the fit see."""
    found = compare(TableScene("deep", 15.5, 1.4, 0.0), settings=quick)
    assert found.map < 0.025
    assert found.map_strict > 0.5
    assert abs(found.empirical.amplitude / found.elastic.amplitude - 1) > 0.3


SEEN = {
    (15.0, 1.0): (0.184, 0.245),
    (20.0, 0.8): (0.360, 0.444),
    (20.0, 1.2): (0.075, 0.001),
    (10.0, 1.5): (0.037, 0.001),
}
"""Amplitudes of plane strain and of Eqs 1 to 4 (centred, E2/E1 = 100): the table of decision record 0098."""


@pytest.mark.parametrize("lump", SEEN)
def test_where_the_empirical_map_loses_a_lump_it_warns(lump: tuple[float, float]) -> None:
    """Against the plane-strain model; a lump inside the range is the negative control."""
    d, h = lump
    found = compare(TableScene("", d, h, 0.0), settings=StudySettings())
    assert (found.elastic.amplitude, found.empirical.amplitude) == pytest.approx(SEEN[lump], abs=2e-3)
    lost = found.empirical.amplitude < 0.5 * found.elastic.amplitude
    assert lost == (outside_range(d, h) is not None)


def test_the_warning_is_one_line_with_the_range() -> None:
    for d, h in ((20.0, 1.2), (20.0, 2.0), (5.0, 0.8)):
        warning = outside_range(d, h)
        assert warning is not None
        assert warning.startswith("warning: ")
        assert "\n" not in warning
        assert "10 mm and more down to h/d 1" in warning
    assert outside_range(10.0, 1.0) is None
