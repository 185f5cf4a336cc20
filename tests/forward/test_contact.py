"""The head on the surface: Hertz, a punch, complementarity at any profile, and what frames and maps must keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward import contact
from tactile_bayes.forward.contact import Contact, FactoredCompliance, solve_contact
from tactile_bayes.forward.plane import (
    SurfaceCompliance,
    build_line,
    condense,
    head_positions,
    press,
    press_layers,
    slide,
    surface_compliance,
)
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.forward.tissue import Body, Layers

DEEP = Layers(2000.0, 6000.0, gland_ratio=1.0)  # as good as a half-plane for loads of millimetres
PLANE_KPA = DEEP.fat_kpa / (1 - DEEP.poisson**2)


@pytest.fixture(scope="module")
def surface() -> SurfaceCompliance:
    return condense(Body(15, 0.8, 0.5), fineness=1)


def toeplitz(count: int, cell_mm: float, layers: Layers = DEEP) -> np.ndarray:
    row = surface_compliance(cell_mm * np.arange(count), cell_mm=cell_mm, layers=layers)
    index = np.arange(count)
    return row[np.abs(index[:, None] - index[None, :])]


def pressed(compliance: np.ndarray, profile: np.ndarray, total_kpa: float) -> Contact:
    """The head under a sum of its cells' pressures."""
    return solve_contact(FactoredCompliance.of(compliance), profile, mean_kpa=total_kpa / len(profile))


def test_a_cylinder_presses_as_hertz_says() -> None:
    """Line contact, Johnson (1985) section 4.2(c): half width and peak pressure of a half-ellipse."""
    cell, radius, half_width = 0.1, 200.0, 4.0
    head = HeadSection(width_mm=12.0, radius_mm=radius, shoulder_mm=0.0)
    force = np.pi * PLANE_KPA * half_width**2 / (4 * radius)
    pressure = pressed(toeplitz(120, cell), head.cell_profile_mm(cell), force / cell).pressure_kpa
    assert pressure.max() == pytest.approx(2 * force / (np.pi * half_width), rel=3e-3)
    assert np.count_nonzero(pressure) * cell == pytest.approx(2 * half_width, abs=2 * cell)
    s = cell * (np.arange(120) - 59.5)
    ellipse = pressure.max() * np.sqrt(np.maximum(1 - (s / half_width) ** 2, 0))
    np.testing.assert_allclose(pressure[np.abs(s) < 3.8], ellipse[np.abs(s) < 3.8], rtol=6e-3)


def test_the_peak_converges_to_hertz() -> None:
    errors = []
    for cell in (0.4, 0.2, 0.1):
        head = HeadSection(width_mm=12.0, radius_mm=400.0, shoulder_mm=0.0)
        force = np.pi * PLANE_KPA * 4.1**2 / 1600.0
        found = pressed(toeplitz(round(12 / cell), cell), head.cell_profile_mm(cell), force / cell)
        errors.append(abs(found.pressure_kpa.max() / (2 * force / (np.pi * 4.1)) - 1))
    assert errors[-1] < errors[0] / 3


def test_a_flat_punch_presses_hardest_at_its_edges() -> None:
    """p = F / (pi sqrt(w^2 - s^2)), Johnson (1985) section 2.8; compared as means over the cells."""
    cell, half = 0.25, 12.0
    flat = HeadSection(width_mm=24.0, radius_mm=np.inf, shoulder_mm=0.0)
    assert (flat.cell_profile_mm(cell) == 0).all()
    found = pressed(toeplitz(96, cell), flat.cell_profile_mm(cell), 96.0)
    edges = np.linspace(-half, half, 97)
    exact = 96 * np.diff(np.arcsin(edges / half)) / np.pi
    np.testing.assert_allclose(found.pressure_kpa[12:-12], exact[12:-12], rtol=5e-3)
    np.testing.assert_allclose(found.pressure_kpa[4:-4], exact[4:-4], rtol=1e-2)
    np.testing.assert_allclose(found.pressure_kpa, exact, rtol=0.16)  # the edge itself is singular


def complementarity_holds(found: Contact, compliance: np.ndarray, profile: np.ndarray, total: float) -> None:
    p, w = found.pressure_kpa, found.gap_mm
    assert p.min() >= -1e-11 * total
    assert w.min() >= -1e-11 * found.depth_mm
    assert np.abs(p * w).max() <= 1e-10
    assert p.sum() == pytest.approx(total, rel=1e-10)
    np.testing.assert_allclose(compliance @ p + profile - found.depth_mm, w, rtol=0, atol=1e-9 * found.depth_mm)


@given(seed=st.integers(0, 2**31), rough=st.floats(0.0, 1.0), total=st.floats(0.1, 1e4))
def test_whatever_the_profile_each_cell_touches_or_is_free(seed: int, rough: float, total: float) -> None:
    rng = np.random.default_rng(seed)
    profile = HeadSection().cell_profile_mm(0.5) + rough * rng.normal(size=48)
    profile -= profile.min()
    compliance = toeplitz(48, 0.5, Layers(12.0))
    found = pressed(compliance, profile, total)
    complementarity_holds(found, compliance, profile, total)


def test_one_cell_at_a_time_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    profile = HeadSection().cell_profile_mm(0.5) + 0.3 * np.sin(np.arange(48.0))
    compliance = toeplitz(48, 0.5, Layers(12.0))
    together = pressed(compliance, profile, 30.0)
    monkeypatch.setattr(contact, "_PATIENCE", 0)
    singly = pressed(compliance, profile, 30.0)
    assert (singly.pressure_kpa > 0).sum() < 48
    np.testing.assert_allclose(singly.pressure_kpa, together.pressure_kpa, rtol=0, atol=1e-9)
    complementarity_holds(singly, compliance, profile, 30.0)


def test_contact_on_a_lump_is_complementary_too(surface: SurfaceCompliance) -> None:
    matrix = surface.with_lump(100.0)
    profile = HeadSection().cell_profile_mm(0.25)
    for window in (matrix[i : i + 96, i : i + 96] for i in range(0, 480, 16)):
        for total in (5.0, 96 * 9.5):
            complementarity_holds(pressed(window, profile, total), window, profile, total)


def test_the_shape_of_the_head() -> None:
    head = HeadSection()
    s = np.linspace(-12, 12, 24001)
    z = head.profile_mm(s)
    slope = np.diff(z) / np.diff(s)
    assert head.profile_mm(np.array([0.0]))[0] == 0
    np.testing.assert_allclose(z, z[::-1], atol=1e-12)
    assert (np.diff(slope) > -1e-6).all()  # convex, so arc and shoulder meet without a corner
    near = np.abs(s) < 9.8
    np.testing.assert_allclose(z[near], 35 - np.sqrt(35**2 - s[near] ** 2), atol=1e-12)
    assert slope[-1] > 20  # the shoulder ends upright


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"width_mm": 0.0}, ["width_mm", "above 0"]),
        ({"radius_mm": 12.0}, ["radius_mm of the head is 12", "above 12 mm"]),
        ({"shoulder_mm": 13.0}, ["shoulder_mm of the head is 13", "between 0 and 12 mm"]),
        ({"shoulder_mm": -1.0}, ["shoulder_mm"]),
    ],
)
def test_impossible_heads_are_named(options: dict[str, float], words: list[str]) -> None:
    with pytest.raises(BadDataError) as caught:
        HeadSection(**options)
    assert all(word in str(caught.value) for word in words)


def test_a_head_off_the_surface_is_refused(surface: SurfaceCompliance) -> None:
    with pytest.raises(BadDataError, match="must divide the head's width"):
        HeadSection().cell_profile_mm(0.7)
    with pytest.raises(BadDataError, match=r"the head at 60.5 mm leaves the surface, which ends at 72 mm"):
        press(surface, None, np.array([60.5]))
    with pytest.raises(BadDataError, match=r"pitch_mm is 0\.4"):
        press_layers(Layers(15.0)).as_taxels(0.4)


def test_frames_keep_the_force_and_the_symmetry(surface: SurfaceCompliance) -> None:
    frames = press(surface, 100.0, np.array([-20.0, -3.5, 3.5, 20.0]))
    np.testing.assert_allclose(frames.pressure_kpa.mean(axis=1), 9.5, rtol=1e-12)
    np.testing.assert_allclose(frames.pressure_kpa, frames.pressure_kpa[::-1, ::-1], atol=1e-9)
    np.testing.assert_allclose(frames.as_taxels(1.5).pressure_kpa.mean(axis=1), 9.5, rtol=1e-12)
    assert frames.as_taxels(1.5).s_mm[0] == -11.25


def test_the_half_that_is_solved_is_mirrored_to_the_whole(surface: SurfaceCompliance) -> None:
    whole = slide(surface, 10.0, positions_mm=(-8.0, 8.0, 2.0))
    singly = press(surface, 10.0, head_positions((-8.0, 8.0, 2.0)))
    np.testing.assert_allclose(whole.pressure_kpa, singly.pressure_kpa, atol=1e-9)
    assert slide(surface, 10.0, positions_mm=(-8.0, 6.0, 2.0)).pressure_kpa.shape == (8, 96)


def test_frames_between_two_cells_are_interpolated(surface: SurfaceCompliance) -> None:
    """Between two cells the surface is interpolated; frames then lie between their neighbours'."""
    frames = press(surface, 100.0, np.array([4.0, 4.1, 4.25])).pressure_kpa[:, 12:-12]
    np.testing.assert_allclose(frames[1], frames[0] + 0.4 * (frames[2] - frames[0]), atol=0.02)


def test_twice_the_force_on_a_flat_head_is_twice_the_pressure(surface: SurfaceCompliance) -> None:
    flat = HeadSection(radius_mm=np.inf, shoulder_mm=0.0)
    once, twice = (press(surface, 100.0, np.array([2.0]), head=flat, mean_kpa=p).pressure_kpa for p in (5.0, 10.0))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-9)


def test_without_a_lump_every_frame_is_p1_and_the_map_is_1(surface: SurfaceCompliance) -> None:
    frames = slide(surface, None, positions_mm=(-30.0, 30.0, 0.5))
    alone = press_layers(surface.body.layers).pressure_kpa
    np.testing.assert_allclose(frames.pressure_kpa, np.broadcast_to(alone, frames.pressure_kpa.shape), rtol=1e-8)
    line = build_line(frames)
    inner = np.abs(line.x_mm) < 18
    np.testing.assert_allclose(line.mean[inner], 1.0, atol=1e-9)
    assert set(line.count[inner]) == {96}


def test_the_map_takes_every_reading_once(surface: SurfaceCompliance) -> None:
    frames = slide(surface, 100.0, positions_mm=(-30.0, 30.0, 0.5))
    line = build_line(frames)
    assert line.count.sum() == frames.pressure_kpa.size
    np.testing.assert_allclose(np.nansum(line.mean * line.count), frames.pressure_kpa.sum() / 9.5, rtol=1e-9)


def test_what_the_lump_adds_it_takes_away_beside(surface: SurfaceCompliance) -> None:
    """Under constant force the map's excess integrates to zero: a bump has its trough."""
    line = build_line(slide(surface, 100.0))
    whole = line.count == line.count.max()
    excess = (line.mean - 1)[whole]
    assert excess.max() > 0.1
    assert abs(excess.sum()) < 0.03 * excess[excess > 0].sum()
