"""The Fourier finite elements: patch tests, exact spheres, the exact layered skin, symmetry and convergence."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.sparse.linalg import splu

from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.axisymmetric import (
    CondensedLump,
    condense_lump,
    element_stiffness,
    layering_compliance,
    order_unknowns,
    orders_needed,
    skin_spline,
)
from tactile_bayes.forward.mesh import LumpGeometry, Mesh, MeshSize, PartStiffness, lump_mesh
from tactile_bayes.forward.tissue import Layers

CENTRED = LumpGeometry(7.5, 7.5, 15.0, Layers(15.0))
RESTING = LumpGeometry(7.5, 7.5, 15.0, Layers(24.0))
SHALLOW = LumpGeometry(5.0, 5.0, 6.0, Layers(6.0))
GEOMETRIES = {
    "centred": CENTRED,
    "resting": RESTING,
    "shallow": SHALLOW,
    "half seated": LumpGeometry(7.5, 7.5, 15.0, Layers(18.75)),
    "touching": LumpGeometry(7.5, 7.5, 15.0, Layers(22.5)),
    "in the gland": LumpGeometry(7.5, 7.5, 25.0, Layers(12.0)),
    "deep": LumpGeometry(12.5, 12.5, 50.0, Layers(50.0)),
    "flat": LumpGeometry(7.5, 4.0, 15.0, Layers(15.0)),
    "tall": LumpGeometry(4.0, 7.5, 12.0, Layers(14.0)),
}


@cache
def condensed(name: str) -> CondensedLump:
    return condense_lump(GEOMETRIES[name])


def point_change(lump: CondensedLump, kpa: float, r1: float, r2: float, angle: float) -> float:
    """Change of the sinking at (r1, 0) by a unit force at (r2, angle)."""
    total = 0.0
    for order, mode in enumerate(lump.perturbation(kpa)):
        row = skin_spline(lump.radius_mm, mode, order=order)(r1)
        total += float(skin_spline(lump.radius_mm, row, order=order)(r2)) * np.cos(order * angle)
    return total


@pytest.mark.parametrize("name", GEOMETRIES)
def test_a_mesh_fills_the_body_without_gap_or_overlap(name: str) -> None:
    geometry = GEOMETRIES[name]
    mesh = lump_mesh(geometry)
    area = cell_areas(mesh)
    assert (area > 0).all()
    assert area.sum() == pytest.approx(mesh.nodes[:, 0].max() * geometry.layers.thickness_mm, rel=1e-9)
    inside = area[mesh.lump].sum()
    assert inside == pytest.approx(np.pi / 2 * geometry.radius_mm * geometry.half_height_mm, rel=1e-4)
    # every edge is shared by two elements or lies on the rim: a crack would show as an edge with one
    edges = np.sort(mesh.elements[:, [[0, 2], [2, 8], [8, 6], [6, 0]]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    found, times = np.unique(edges, axis=0, return_counts=True)
    assert times.max() == 2
    alone = mesh.nodes[found[times == 1]]
    low, high = alone.min(axis=1), alone.max(axis=1)
    on_rim = (high[:, 0] == 0) | (low[:, 0] == mesh.nodes[:, 0].max())
    assert (on_rim | (high[:, 1] == 0) | (low[:, 1] == geometry.layers.thickness_mm)).all()


def cell_areas(mesh: Mesh) -> np.ndarray:
    """Areas by Green's theorem over the eight nodes of each rim, edges as parabolas (Simpson)."""
    ring = mesh.nodes[mesh.elements[:, [0, 1, 2, 5, 8, 7, 6, 3]]]
    total = np.zeros(len(ring))
    for i in range(0, 8, 2):
        a, b, c = ring[:, i], ring[:, i + 1], ring[:, (i + 2) % 8]
        # integral of x dy along the parabola through three points
        total += (
            a[:, 0] * (-3 * a[:, 1] + 4 * b[:, 1] - c[:, 1])
            + 4 * b[:, 0] * (c[:, 1] - a[:, 1])
            + c[:, 0] * (a[:, 1] - 4 * b[:, 1] + 3 * c[:, 1])
        ) / 6
    return np.abs(total)


RIGID = {
    "up": (0, lambda r, z: (0 * r, 0 * z, 1 + 0 * r)),
    "sideways": (1, lambda r, z: (1 + 0 * r, -1 + 0 * r, 0 * z)),
    "rocking": (1, lambda r, z: (z, -z, -r)),
}
STRAINED = {
    "stretch": (0, lambda r, z: (r, 0 * r, 0 * z)),
    "squeeze": (0, lambda r, z: (0 * r, 0 * r, z)),
    "pure shear": (2, lambda r, z: (r, -r, 0 * z)),
    "shear": (1, lambda r, z: (z, -z, 0 * r)),
}


@pytest.mark.parametrize("name", RIGID)
def test_moving_as_a_whole_costs_nothing(name: str) -> None:
    order, field = RIGID[name]
    mesh = lump_mesh(CENTRED)
    r, z = mesh.nodes.T
    motion = np.stack(field(r, z), axis=-1)[mesh.elements].reshape(-1, 27)
    k = element_stiffness(mesh, nu=0.495)
    stiffness = k[0] + order * k[1] + order**2 * k[2]
    forces = np.einsum("eij,ej->ei", stiffness, motion)
    assert np.abs(forces).max() <= 1e-9 * np.abs(stiffness).max() * np.abs(motion).max()


@pytest.mark.parametrize("nu", [0.3, 0.495])
@pytest.mark.parametrize("name", STRAINED)
def test_an_even_strain_costs_its_exact_energy(name: str, nu: float) -> None:
    """Patch test in energy: uniform strain over the lump, an integral known in closed form for each angular order."""
    order, field = STRAINED[name]
    mesh = lump_mesh(CENTRED)
    inside = mesh.lump
    r, z = mesh.nodes.T
    motion = np.stack(field(r, z), axis=-1)[mesh.elements[inside]].reshape(-1, 27)
    k = element_stiffness(mesh, nu=nu)[:, inside]
    energy = np.einsum("ei,eij,ej->", motion, k[0] + order * k[1] + order**2 * k[2], motion)
    shear, bulk = 0.5 / (1 + nu), nu / ((1 + nu) * (1 - 2 * nu))
    density = {
        "stretch": 4 * shear + 4 * bulk,
        "squeeze": 2 * shear + bulk,
        "pure shear": 8 * shear,
        "shear": 2 * shear,
    }[name]
    volume = 4 / 3 * np.pi * 7.5**3 / (2 * np.pi)
    assert energy == pytest.approx(density * volume, rel=1e-5)  # arcs are parabolas


def test_a_lump_of_its_own_tissue_is_no_lump() -> None:
    for mode in condensed("resting").perturbation(5.0):
        assert np.abs(mode).max() <= 1e-12 * np.abs(condensed("resting").perturbation(500.0)[0]).max()


@pytest.mark.long_repeats
@pytest.mark.parametrize("name", ["centred", "resting", "flat"])
def test_a_hard_lump_stiffens_and_a_soft_one_softens(name: str) -> None:
    lump = condensed(name)
    hard, soft = lump.perturbation(500.0), lump.perturbation(0.5)
    for order in range(len(hard)):
        scale = np.abs(hard[order]).max()
        assert np.linalg.eigvalsh(hard[order]).max() <= 1e-9 * scale
        assert np.linalg.eigvalsh(soft[order]).min() >= -1e-9 * np.abs(soft[order]).max()


def test_harder_is_never_softer_and_settles() -> None:
    """Every step in stiffness takes compliance away, down to the rigid limit; 1e-3 to 1e6 without losing digits."""
    lump = condensed("resting")
    ratios = 10.0 ** np.arange(-3, 7)
    change = [point_change(lump, 5.0 * ratio, 4.0, 4.0, 0.0) for ratio in ratios]
    assert (np.diff(change) < 0).all()
    assert abs(change[-1] - change[-2]) < 1e-4 * abs(change[-1])
    # the rigid limit is approached as 1 / ratio, so what is left falls from 0.99 to 0.09 of itself
    assert (change[-3] - change[-1]) / (change[-2] - change[-1]) == pytest.approx(11.0, rel=0.02)


def test_forces_and_sinkings_can_be_swapped() -> None:
    lump = condensed("centred")
    there, back = point_change(lump, 500.0, 3.0, 17.0, 1.0), point_change(lump, 500.0, 17.0, 3.0, 1.0)
    assert there == pytest.approx(back, rel=1e-9)


def test_without_a_lump_the_elements_sink_as_the_exact_layers() -> None:
    """A force on the axis: finite elements against the Hankel transform, through the difference of two bodies."""
    fine = MeshSize(arc=24, rings=8, core=4, grade=1.25, reach_mm=600.0)
    mesh = lump_mesh(CENTRED, fine)
    number, sign = order_unknowns(mesh, 0)
    k = element_stiffness(mesh, nu=0.495)[0]
    sinkings = []
    for gland in (50.0, 5.0):
        modulus = np.where(mesh.gland, gland, 5.0)
        part = PartStiffness.of(mesh.elements, k * modulus[:, None, None], number, sign)
        skin = np.searchsorted(part.unknowns, number[mesh.skin[:-1], 2])
        force = np.zeros(len(part.unknowns))
        force[skin[0]] = 1 / (2 * np.pi)
        sinkings.append(splu(part.matrix).solve(force)[skin])
    r = np.array([0.0, 5.0, 15.0, 40.0])
    by_elements = CubicSpline(mesh.nodes[mesh.skin[:-1], 0], sinkings[0] - sinkings[1])(r)
    stiff, even = (Layers(15.0, gland_ratio=ratio) for ratio in (10.0, 1.0))
    exact = layering_compliance(r, stiff) - layering_compliance(r, even)
    np.testing.assert_allclose(by_elements, exact, atol=0.002 * np.abs(exact).max())


@pytest.mark.long
def test_two_meshes_of_one_body_agree() -> None:
    """With one tissue throughout, where the layers "meet" moves the mesh and nothing else."""
    meshes = [LumpGeometry(7.5, 7.5, 15.0, Layers(boundary, gland_ratio=1.0)) for boundary in (15.0, 20.0, 40.0)]
    lumps = [condense_lump(geometry) for geometry in meshes]
    for angle in (0.0, 1.5):
        first, *others = (point_change(lump, 500.0, 6.0, 6.0, angle) for lump in lumps)
        np.testing.assert_allclose(others, first, rtol=0.01)


def test_a_small_sphere_is_eshelbys() -> None:
    """Far from skin and base a small stiff sphere changes an outer field's energy by its exact polarisation.

    For a rigid sphere in an incompressible body (mu) the change of compliance between two forces is
    ``-(4/3 pi a^3) 5 mu e : e'``, with the strains e, e' that each force alone makes at the centre (Eshelby 1957: the
    stress-free strain of a rigid inclusion; 5 mu is 2 mu (1 + 3/2), Einstein's factor).
    """
    radius, depth, nu = 1.0, 12.0, 0.4999
    lump = condense_lump(
        LumpGeometry(radius, radius, depth, Layers(60.0, 400.0, 5.0, 1.0, nu)),
        size=MeshSize(arc=20, rings=12, core=4, reach_mm=600.0),
    )
    shear = 5.0 / (2 * (1 + nu))
    for r in (0.0, 6.0, 12.0):
        strain = boussinesq_strain(np.array([-r, 0.0, depth]), shear)
        expected = -4 / 3 * np.pi * radius**3 * 5 * shear * np.sum(strain**2)
        assert point_change(lump, 5e5, r, r, 0.0) == pytest.approx(expected, rel=0.04), r


def boussinesq_strain(x: np.ndarray, shear: float) -> np.ndarray:
    """Strain at x under a unit force along z on an incompressible half-space (Johnson 1985, eq. 3.18 at nu = 1/2)."""

    def u(p: np.ndarray) -> np.ndarray:
        rho = np.linalg.norm(p)
        return (p * p[2] / rho**3 + np.array([0.0, 0.0, 1.0]) / rho) / (4 * np.pi * shear)

    step = 1e-4 * np.eye(3)
    gradient = np.array([(u(x + h) - u(x - h)) / 2e-4 for h in step])
    return (gradient + gradient.T) / 2


@pytest.mark.slow
@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_change_converges_with_the_mesh(name: str) -> None:
    fine = condense_lump(GEOMETRIES[name], size=MeshSize(arc=36, rings=12, core=6, grade=1.25))
    h = GEOMETRIES[name].depth_mm
    largest = abs(point_change(fine, 500.0, 0.3 * h, 0.3 * h, 0.0))
    for r1, r2, angle in ((0.3 * h, 0.3 * h, 0.0), (0.5 * h, 0.5 * h, 0.0), (h, 0.5 * h, 1.0), (2 * h, 0.3 * h, 0.0)):
        expected = point_change(fine, 500.0, r1, r2, angle)
        change = point_change(condensed(name), 500.0, r1, r2, angle)
        assert change == pytest.approx(expected, abs=0.01 * largest)


@pytest.mark.slow
def test_nearly_incompressible_does_not_lock() -> None:
    soft, hard = (
        point_change(condense_lump(replace(CENTRED, layers=Layers(15.0, poisson=nu))), 500.0, 5.0, 5.0, 0.0)
        for nu in (0.499, 0.49999)
    )
    assert hard == pytest.approx(soft, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["centred", "shallow"])
def test_two_more_fourier_orders_change_nothing(name: str) -> None:
    geometry = GEOMETRIES[name]
    more = condense_lump(geometry, orders=orders_needed(geometry) + 2)
    r = 0.7 * geometry.depth_mm
    a, b = point_change(condensed(name), 500.0, r, r, 0.0), point_change(more, 500.0, r, r, 0.0)
    assert a == pytest.approx(b, rel=3e-3)


def test_a_lump_out_of_the_body_is_refused() -> None:
    with pytest.raises(BadDataError, match=r"reaches 72\.5 mm deep, the base lies at 70 mm"):
        LumpGeometry(7.5, 7.5, 65.0, Layers(15.0))


def test_a_lump_without_stiffness_is_refused() -> None:
    with pytest.raises(BadDataError, match="modulus is 0"):
        condensed("resting").perturbation(0.0)
