"""The plane-strain body against exact solutions, against itself on finer meshes, and against another program."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.sparse.linalg import spsolve

from benchmarks.forward import assemble, rectangle_mesh
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.axisymmetric import skin_flexibility
from tactile_bayes.forward.mesh import Mesh, body_mesh, lagrange_points, quadrature
from tactile_bayes.forward.plane import (
    SurfaceCompliance,
    build_line,
    condense,
    skin_average,
    slide,
    surface_compliance,
)
from tactile_bayes.forward.tissue import Body, Layers, parse_seat
from tactile_bayes.studies.paper import fit_line

NEARLY_INCOMPRESSIBLE = pytest.mark.parametrize("poisson", [0.3, 0.495, 0.4999])


def lame(young, poisson: float) -> tuple:
    """Lame's lambda and the shear modulus mu, in the unit of `young`."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def on_the_edge(mesh: Mesh) -> np.ndarray:
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    return (np.isclose(mesh.nodes, low) | np.isclose(mesh.nodes, high)).any(axis=1)


def solve_held(matrix, load: np.ndarray, held: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Displacements with the unknowns `held` at `values`."""
    u = np.where(held, values, 0.0)
    free = np.flatnonzero(~held)
    u[free] = spsolve(matrix[free][:, free].tocsc(), (load - matrix @ u)[free])
    return u


@NEARLY_INCOMPRESSIBLE
def test_a_constant_strain_is_exact_on_distorted_elements(poisson: float) -> None:
    mesh = rectangle_mesh(np.linspace(0, 3, 4), np.linspace(0, 2, 4))
    edge = on_the_edge(mesh)
    moved = mesh.nodes + np.where(edge[:, None], 0.0, np.random.default_rng(1).uniform(-0.06, 0.06, mesh.nodes.shape))
    mesh = replace(mesh, nodes=moved)
    matrix = assemble(mesh, young_kpa=np.full(len(mesh.elements), 5.0), poisson=poisson)
    exact = (mesh.nodes @ np.array([[0.01, -0.02], [0.03, 0.015]])).reshape(-1)
    u = solve_held(matrix, np.zeros(len(exact)), np.repeat(edge, 2), exact)
    np.testing.assert_allclose(u, exact, atol=1e-12)


def body_force(mesh: Mesh, force: np.ndarray) -> np.ndarray:
    """(2n,) nodal forces of a force density given at the points of `quadrature_points`, (m, 9, 2)."""
    _, _, weight = quadrature(mesh.nodes[mesh.elements])
    values, _, _ = lagrange_points()
    local = np.einsum("qa,eqc,eq->eac", values, force, weight)
    load = np.zeros((len(mesh.nodes), 2))
    np.add.at(load, mesh.elements, local)
    return load.reshape(-1)


def quadrature_points(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Positions (m, 9, 2) and weights (m, 9) in mm^2 of the integration points."""
    _, place, weight = quadrature(mesh.nodes[mesh.elements])
    return place, weight


def interpolate(mesh: Mesh, values: np.ndarray) -> np.ndarray:
    """(m, 9, ...) values at the integration points of (n, ...) values at the nodes."""
    shape, _, _ = lagrange_points()
    return np.einsum("qa,ea...->eq...", shape, values[mesh.elements])


@NEARLY_INCOMPRESSIBLE
def test_a_manufactured_solution_converges_with_the_cube_of_the_element(poisson: float) -> None:
    def exact(points: np.ndarray) -> np.ndarray:  # free of divergence, so that no modulus of volume enters
        x, z = np.pi * points[..., 0], np.pi * points[..., 1]
        return np.stack([np.sin(x) * np.cos(z), -np.cos(x) * np.sin(z)], axis=-1)

    errors = []
    for n in (4, 8, 16):
        mesh = rectangle_mesh(np.linspace(0, 1, n + 1) ** 1.2, np.linspace(0, 1, n + 1))
        place, weight = quadrature_points(mesh)
        load = body_force(mesh, 2 * np.pi**2 * lame(5.0, poisson)[1] * exact(place))
        matrix = assemble(mesh, young_kpa=np.full(len(mesh.elements), 5.0), poisson=poisson)
        u = solve_held(matrix, load, np.repeat(on_the_edge(mesh), 2), exact(mesh.nodes).reshape(-1))
        error = interpolate(mesh, u.reshape(-1, 2)) - exact(place)
        errors.append(np.sqrt(np.sum(weight[..., None] * error**2)))
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (rates > 2.8).all(), (errors, rates)


def transfer_by_propagation(k: float, layers: Layers) -> float:
    """The skin's displacement by carrying displacements and stresses through the depth: another road."""
    carried = np.eye(4)
    for height, young in (
        (layers.fat_mm, layers.fat_kpa),
        (layers.thickness_mm - layers.fat_mm, layers.fat_kpa * layers.gland_ratio),
    ):
        lam, mu = (float(value) for value in lame(young, layers.poisson))
        stretch = np.array([-lam * k, 0, 0, 1]) / (lam + 2 * mu)  # u_z' from u_x, u_z, shear, normal
        across = np.array([(lam + 2 * mu) * k, 0, 0, 0]) + lam * stretch
        slope = np.stack([[0, k, 1 / mu, 0], stretch, k * across, [0, 0, -k, 0]])
        carried = expm(slope * height) @ carried
    return float(np.linalg.solve(carried[:2, :2], carried[:2, 3])[1])


@pytest.mark.parametrize("k", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("layers", [Layers(7.5), Layers(25.0, poisson=0.3), Layers(10.0, 30.0, gland_ratio=0.2)])
def test_the_layers_answer_as_propagation_through_the_depth(k: float, layers: Layers) -> None:
    assert skin_flexibility(np.array([k]), layers)[0, 1, 1] == pytest.approx(
        transfer_by_propagation(k, layers), rel=1e-7
    )


def test_the_layers_have_their_limits() -> None:
    layers = Layers(15.0)
    lam, mu = lame(np.array([5.0, 50.0]), layers.poisson)
    confined = 15.0 / (lam[0] + 2 * mu[0]) + 55.0 / (lam[1] + 2 * mu[1])
    low, high = skin_flexibility(np.array([1e-4, 20.0]), layers)[:, 1, 1]
    assert low == pytest.approx(confined, rel=1e-3)  # a wide load squeezes columns that cannot give way
    assert high == pytest.approx(2 * (1 - 0.495**2) / (5.0 * 20.0), rel=1e-9)  # a fine one sees a half-plane of fat


def test_the_compliance_of_cells_is_the_fourier_integral() -> None:
    layers, cell = Layers(6.0), 0.5
    k = np.arange(0.5, 600_000) * 2e-4
    c = 2 * (1 - layers.poisson**2) / layers.fat_kpa / k
    c[:100_000] = skin_flexibility(k[:100_000], layers)[:, 1, 1]
    for x in (0.0, 0.5, 10.0, 24.0):
        integral = cell / np.pi * 2e-4 * np.sum(c * np.sinc(k * cell / (2 * np.pi)) ** 2 * np.cos(k * x))
        assert surface_compliance(np.array([x]), cell_mm=cell, layers=layers)[0] == pytest.approx(integral, abs=2e-5)


@NEARLY_INCOMPRESSIBLE
def test_elements_find_the_surface_greens_function_of_the_layers(poisson: float) -> None:
    layers = Layers(15.0, poisson=poisson)
    x = np.concatenate([np.linspace(0, 20, 21), np.geomspace(21.5, 400, 24)])
    z = np.concatenate([np.geomspace(1, 16, 13) - 1, np.linspace(17, 70, 13)])
    mesh = rectangle_mesh(x, z)
    depth = mesh.nodes[mesh.elements[:, 4], 1]
    young = np.where(depth > layers.fat_mm, 50.0, 5.0)
    matrix = assemble(mesh, young_kpa=young, poisson=poisson)
    held = np.zeros((len(mesh.nodes), 2), dtype=bool)
    held[mesh.nodes[:, 1] > 70 - 1e-6] = True
    held[(mesh.nodes[:, 0] < 1e-9) | (mesh.nodes[:, 0] > 400 - 1e-6), 0] = True
    skin = np.flatnonzero(mesh.nodes[:, 1] < 1e-9)
    skin = skin[np.argsort(mesh.nodes[skin, 0])]
    load = np.zeros(2 * len(mesh.nodes))
    for i in range(4):  # unit pressure on the four elements nearest to the axis
        load[2 * skin[2 * i : 2 * i + 3] + 1] += np.array([1, 4, 1]) / 6
    u = solve_held(matrix, load, held.reshape(-1), np.zeros(len(load)))
    edges = np.linspace(0, 72, 73)
    found = skin_average(mesh.nodes[skin, 0], edges_mm=edges, even=True) @ u[2 * skin + 1]
    place = edges[:-1] + 0.5
    exact = sum(surface_compliance(place - at, cell_mm=1.0, layers=layers) for at in np.arange(-3.5, 4.0))
    assert np.linalg.norm(found - exact) <= 2e-3 * np.linalg.norm(exact)


@pytest.mark.parametrize("body", [Body(15, 1.0, 0.0), Body(10, 0.7, 1.0), Body(12, 1.3, 0.4), Body(12, 0.9, 1.2)])
def test_the_condensed_body_gives_the_whole_bodys_change(body: Body) -> None:
    """The change that a lump makes, by one solution of the whole body with it less one without it."""
    surface = condense(body, fineness=1)
    ratio, press = 30.0, np.zeros(len(surface.row))
    press[300:330] = np.linspace(1.0, 2.0, 30)
    change = (surface.with_lump(ratio) - surface.without_lump()) @ press
    whole = body_mesh(body, fineness=1, layered=body.seat < 1)
    tissue = np.where(whole.gland, 50.0, 5.0)
    own = skin_response(whole, tissue, body, surface, press)
    whole = body_mesh(body, fineness=1, layered=False)
    tissue = np.where(whole.lump, ratio * 5.0, np.where(whole.gland, 50.0, 5.0))
    lump = skin_response(whole, tissue, body, surface, press)
    np.testing.assert_allclose(change, lump - own, atol=1e-9 * np.abs(lump).max())


def skin_response(
    mesh: Mesh, young: np.ndarray, body: Body, surface: SurfaceCompliance, press: np.ndarray
) -> np.ndarray:
    """Mean displacements of the cells under pressures on them, from symmetric and antisymmetric halves."""
    matrix = assemble(mesh, young_kpa=young, poisson=body.poisson)
    x, z = mesh.nodes.T
    skin = np.flatnonzero(z < 1e-9)
    skin = skin[np.argsort(x[skin])]
    n = len(press) // 2
    total = np.zeros(len(press))
    for sign in (1.0, -1.0):
        held = np.zeros((len(x), 2), dtype=bool)
        held[(x > x.max() - 1e-6), 0] = True
        held[x < 1e-9, 0 if sign > 0 else 1] = True
        held[z > z.max() - 1e-6] = True
        average = skin_average(x[skin], edges_mm=surface.edges_mm[n:], even=sign > 0)
        load = np.zeros(2 * len(x))
        load[2 * skin + 1] = average.T @ (0.5 * (press[n:] + sign * press[n - 1 :: -1])) * surface.cell_mm
        u = average @ solve_held(matrix, load, held.reshape(-1), np.zeros(len(load)))[2 * skin + 1]
        total += np.concatenate([sign * u[::-1], u])
    return total


@pytest.mark.parametrize("body", [Body(15, 0.9, 1.0), Body(15, 0.9, 1.3), Body(15, 0.9, 0.3, gland_ratio=1.0)])
def test_a_lump_of_fat_in_fat_is_no_lump(body: Body) -> None:
    surface = condense(body, fineness=1)
    change = surface.with_lump(1.0) - surface.without_lump()
    assert np.abs(change).max() < 1e-11 * surface.row[0]


def test_a_centred_lump_of_fat_replaces_gland_and_so_softens() -> None:
    surface = condense(Body(15, 0.9, 0.0), fineness=1)
    assert np.linalg.eigvalsh(surface.with_lump(1.0) - surface.without_lump()).min() > -1e-9 * surface.row[0]


@pytest.mark.parametrize("seat", [0.0, 1.0])
def test_a_stiffer_lump_yields_less_and_no_ratio_upsets_it(seat: float) -> None:
    surface = condense(Body(10, 0.7, seat), fineness=1)
    ratios = [1e-3, 0.1, 1.0, 10.0, 100.0, 1e4, 1e6]
    matrices = [surface.with_lump(ratio) for ratio in ratios]
    for softer, harder in pairwise(matrices):  # stiffness 1e6 leaves 3e-8 of rounding by the oldest linear algebra
        assert np.linalg.eigvalsh(softer - harder).min() > -1e-7 * surface.row[0]
    assert np.linalg.eigvalsh(matrices[-1]).min() > 0
    assert np.abs(matrices[-1] - matrices[-2]).max() < 1e-3 * surface.row[0]  # rigid is rigid
    assert all((matrix == matrix.T).all() for matrix in matrices)


def test_the_skin_is_symmetric_about_the_lump() -> None:
    matrix = condense(Body(15, 0.9, 0.6), fineness=1).with_lump(100.0)
    np.testing.assert_allclose(matrix, matrix[::-1, ::-1], atol=1e-13)


def line_figures(body: Body, ratio: float = 100.0, **options: float) -> tuple[float, float]:
    fit = fit_line(build_line(slide(condense(body, **options), ratio)), 48.0)
    return fit.amplitude, fit.widths_mm[0]


def agrees_with_half_its_cell(body: Body) -> None:
    (a, sigma), (fine_a, fine_sigma) = line_figures(body), line_figures(body, fineness=4, cell_mm=0.125)
    assert sigma == pytest.approx(fine_sigma, rel=5e-3)
    assert a == pytest.approx(fine_a, rel=1e-2)


QUICK, OTHERS = Body(15, 0.8, 0.5, poisson=0.4999), (Body(15, 1.0, 0.0), Body(10, 0.8, 1.2))


@pytest.mark.long
@pytest.mark.parametrize("body", [QUICK, *(pytest.param(one, marks=pytest.mark.slow) for one in OTHERS)], ids=repr)
def test_half_the_cell_gives_the_same_map(body: Body) -> None:
    agrees_with_half_its_cell(body)


@pytest.mark.slow
@pytest.mark.parametrize("seat", [0.0, 1.0, 1.2])
@pytest.mark.parametrize("depth_ratio", [0.6, 0.8, 1.0, 1.2])
@pytest.mark.parametrize("d", [5.0, 10.0, 15.0, 20.0, 25.0])
def test_half_the_cell_gives_the_same_map_everywhere(d: float, depth_ratio: float, seat: float) -> None:
    agrees_with_half_its_cell(Body(d, depth_ratio, seat))


@pytest.mark.long
def test_the_limit_of_no_volume_change_is_approached_and_not_locked() -> None:
    maps = [line_figures(Body(15, 0.9, 0.0, poisson=nu)) for nu in (0.495, 0.499, 0.4999, 0.49999)]
    steps = np.abs(np.diff(maps, axis=0))
    assert (steps[1:] < steps[:-1]).all()
    assert steps[-1][1] < 1e-3 * maps[-1][1]


@pytest.mark.long
def test_seats_lead_smoothly_from_one_end_to_the_other() -> None:
    found = np.array([line_figures(Body(15, 1.0, seat)) for seat in (0.0, 0.25, 0.5, 0.75, 0.95, 0.999, 1.0)])
    assert (np.diff(found[:, 0]) > 0).all()
    np.testing.assert_allclose(found[-2], found[-1], rtol=2e-3)


@pytest.mark.long
def test_a_lump_leaves_the_gland_smoothly() -> None:
    found = np.array([line_figures(Body(15, 1.0, seat)) for seat in (1.0, 1.011, 1.02, 1.05, 1.2, 1.5)])
    assert (np.diff(found[:, 0]) > 0).all()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-2)  # a film of fat a hundredth of a radius thick
    assert Body(15, 1.0, 1.009).seat == 1.0


EXTREMES = {
    "hardly any skin": Body(25, 0.52),
    "hardly in the gland": Body(15, 1.0, 0.99985),
    "as good as resting": Body(15, 1.0, 1 - 1e-7),
    "hardly off the centre": Body(15, 1.0, 1e-9),
    "hardly above the wall": Body(25, 2.0, 0.99, 62.7),
    "hardly clear of the gland": Body(15, 1.0, 1.0101),
    "far above the gland": Body(25, 0.6, 2.0),
    "clear of the gland, the wall near": Body(25, 2.0, 1.2, 65.5),
    "larger than the head": Body(60, 0.6),
    "tiny and deep": Body(2, 10.0),
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_bodies_have_a_surface(name: str) -> None:
    surface = condense(EXTREMES[name], fineness=1)
    assert np.linalg.eigvalsh(surface.with_lump(100.0)).min() > 0
    assert np.linalg.eigvalsh(surface.with_lump(0.01)).min() > 0


@pytest.mark.parametrize("length", [0.01, 100.0])
def test_only_ratios_of_lengths_matter(length: float) -> None:
    """A body scaled in all lengths has the same compliance per length."""
    one = condense(Body(10, 0.8, 0.3, thickness_mm=50.0), reach_mm=36.0, cell_mm=0.5, fineness=1)
    other = surface_compliance(
        length * 0.5 * np.arange(5), cell_mm=0.5 * length, layers=Layers(one.body.layers.fat_mm * length, 50.0 * length)
    )
    np.testing.assert_allclose(other, length * one.row[:5], rtol=1e-9)


IMPOSSIBLE: dict[str, tuple[Callable[[], object], list[str]]] = {
    "lump out of the skin": (lambda: Body(15, 0.5), ["depth_ratio is 0.5", "at least 0.52"]),
    "no lump": (lambda: Body(0, 1), ["d_mm is 0", "at least 0.1"]),
    "lump in the wall": (lambda: Body(15, 1, thickness_mm=22.0), ["thickness_mm is 22", "above 22.5 mm"]),
    "seat": (lambda: Body(15, 1, 2.2), ["seat is 2.2", "between 0 (centred) and 2; 1 is resting"]),
    "incompressible": (lambda: Body(15, 1, poisson=0.5).layers, ["poisson is 0.5", "below 0.5"]),
    "soft gland": (lambda: Body(15, 1, gland_ratio=0.0).layers, ["gland_ratio is 0", "above 0"]),
    "not a number": (lambda: Body(float("nan"), 1), ["d_mm is nan"]),
    "ratio": (lambda: condense(Body(15, 1), fineness=1).with_lump(0.0), ["stiffness_ratio is 0", "above 0"]),
    "name of a seat": (lambda: parse_seat("sitting"), ["seat is 'sitting'", "centred, resting or a number"]),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_bodies_are_named(name: str) -> None:
    make, words = IMPOSSIBLE[name]
    with pytest.raises(BadDataError) as caught:
        make()
    assert all(word in str(caught.value) for word in words), str(caught.value)


def calculix_deck(mesh: Mesh, young: np.ndarray, held: np.ndarray, load: np.ndarray, poisson: float) -> str:
    """The same body with another program's elements: eight nodes, reduced integration; six in triangles."""
    quads, triangles = [], []
    for number, element in enumerate(mesh.elements, start=1):
        ring = element[[0, 3, 6, 7, 8, 5, 2, 1]]
        if len(set(ring)) < 8:
            ring = ring[np.sort(np.unique(ring, return_index=True)[1])]
            corners = [node for node in element[[0, 6, 8, 2]] if node in ring]
            corners = list(dict.fromkeys(corners))
            middles = [middle_of(mesh, element, corners[i], corners[(i + 1) % 3]) for i in range(3)]
            triangles.append((number, ring_order(mesh, [*corners, *middles])))
        else:
            quads.append((number, ring_order(mesh, [*ring[::2], *ring[1::2]])))
    lines = ["*NODE"]
    lines += [f"{i},{x:.12g},{-z:.12g},0" for i, (x, z) in enumerate(mesh.nodes, start=1)]
    for kind, elements in (("CPE8R", quads), ("CPE6", triangles)):
        if elements:
            lines.append(f"*ELEMENT,TYPE={kind},ELSET=E{kind}")
            lines += [f"{number}," + ",".join(str(node + 1) for node in nodes) for number, nodes in elements]
    for value in np.unique(young):
        name = f"M{value:g}".replace(".", "P")
        lines.append(f"*ELSET,ELSET=S{name}")
        lines += [str(i + 1) for i in np.flatnonzero(young == value)]
        lines += [f"*MATERIAL,NAME={name}", "*ELASTIC", f"{value:g},{poisson:g}"]
        lines += [f"*SOLID SECTION,ELSET=S{name},MATERIAL={name}", "1"]
    lines.append("*BOUNDARY")
    lines += [f"{i // 2 + 1},{i % 2 + 1},{i % 2 + 1}" for i in np.flatnonzero(held)]
    lines += ["*STEP", "*STATIC", "*CLOAD"]
    lines += [f"{i // 2 + 1},2,{-load[i]:.12g}" for i in np.flatnonzero(load)]
    return "\n".join([*lines, "*NSET,NSET=ALL,GENERATE", f"1,{len(mesh.nodes)}", *OUTPUT]) + "\n"


OUTPUT = ["*NODE PRINT,NSET=ALL", "U", "*END STEP"]


def middle_of(mesh: Mesh, element: np.ndarray, first: int, second: int) -> int:
    """The node of an element nearest to the middle of two of its corners."""
    middle = 0.5 * (mesh.nodes[first] + mesh.nodes[second])
    others = [node for node in dict.fromkeys(element[[1, 3, 5, 7]]) if node not in (first, second)]
    return int(min(others, key=lambda node: float(np.hypot(*(mesh.nodes[node] - middle)))))


def ring_order(mesh: Mesh, nodes: list[int]) -> list[int]:
    """Corners then middles, turned so that they run anticlockwise when depth is down."""
    n = len(nodes) // 2
    x, y = mesh.nodes[nodes[:n], 0], -mesh.nodes[nodes[:n], 1]
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0:
        return [int(node) for node in nodes]
    corners, middles = nodes[:n], nodes[n:]
    return [int(node) for node in [corners[0], *corners[:0:-1], *middles[::-1]]]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
@pytest.mark.parametrize("body", [Body(15, 0.9, 0.0), Body(10, 1.2, 1.0), Body(12, 0.8, 1.2)], ids=repr)
def test_another_program_finds_the_same_displacements(body: Body, tmp_path: Path) -> None:
    mesh = body_mesh(body, fineness=3, layered=False)
    young = np.where(mesh.lump, 500.0, np.where(mesh.gland, 50.0, 5.0))
    x, z = mesh.nodes.T
    held = np.zeros((len(x), 2), dtype=bool)
    held[(x < 1e-9) | (x > x.max() - 1e-6), 0] = True
    held[z > z.max() - 1e-6] = True
    skin = np.flatnonzero(z < 1e-9)
    skin = skin[np.argsort(x[skin])]
    load = np.zeros(2 * len(x))
    for i in range(int(np.searchsorted(x[skin][::2], 6.0))):  # unit pressure on the skin over the lump
        width = x[skin[2 * i + 2]] - x[skin[2 * i]]
        load[2 * skin[2 * i : 2 * i + 3] + 1] += width * np.array([1, 4, 1]) / 6
    ours = solve_held(
        assemble(mesh, young_kpa=young, poisson=body.poisson), load, held.reshape(-1), np.zeros(len(load))
    )
    (tmp_path / "body.inp").write_text(calculix_deck(mesh, young, held.reshape(-1), load, body.poisson))
    subprocess.run(["ccx", "body"], cwd=tmp_path, check=True, capture_output=True, timeout=300)
    theirs = np.zeros((len(x), 2))
    for line in (tmp_path / "body.dat").read_text().splitlines():
        words = line.split()
        if len(words) == 4 and words[0].isdigit():
            theirs[int(words[0]) - 1] = float(words[1]), -float(words[2])
    down = ours.reshape(-1, 2)[skin, 1]
    near = x[skin] <= 72.0
    assert np.linalg.norm(theirs[skin, 1] - down) <= 5e-3 * np.linalg.norm(down)
    np.testing.assert_allclose(theirs[skin, 1][near], down[near], rtol=0, atol=1e-2 * np.abs(down).max())
