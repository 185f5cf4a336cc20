"""The plane-strain model: elements, condensed stiffness, layers (Eqs 1 to 4)."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import csc_array

from tactile_bayes.declarations import Record
from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.axisymmetric import LayeredBody, surface_flexibility
from tactile_bayes.forward.mesh import (
    CondensedHole,
    QuadMesh,
    body_mesh,
    condensed,
    disc_mesh,
    gathered,
    moved,
    quadrature,
    stiffness_factor,
)
from tactile_bayes.forward.mesh import IndexArray as IntArray
from tactile_bayes.forward.tissue import Body, Layers
from tactile_bayes.geometry import FloatArray

# --- Nearly incompressible plane strain: stiffness of nine-node quadrilaterals.

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def assemble(mesh: QuadMesh, *, young_kpa: FloatArray, poisson: float) -> csc_array:
    """Assemble the stiffness matrix (kPa, (2n, 2n)) of a mesh of unit thickness from each element's Young's modulus.

    Unknowns are ordered ``x0, z0, x1, z1, ...``; times displacement in mm it gives force in N/m.
    """
    blocks = element_stiffness(mesh.nodes[mesh.elements], poisson=poisson) * young_kpa[:, None, None]
    unknowns = (2 * mesh.elements[:, :, None] + np.arange(2)).reshape(len(mesh.elements), 18)
    return gathered(blocks, unknowns, 2 * len(mesh.nodes))


def element_stiffness(corners: FloatArray, *, poisson: float) -> FloatArray:
    """(m, 18, 18) stiffness of elements with Young's modulus 1 from the (m, 9, 2) places of their nodes."""
    gradient, place, weight = quadrature(corners)
    strain = np.zeros((*weight.shape, 3, 9, 2))  # xx, zz, xz
    strain[..., 0, :, 0], strain[..., 1, :, 1] = gradient[..., 0], gradient[..., 1]
    strain[..., 2, :, 0], strain[..., 2, :, 1] = gradient[..., 1], gradient[..., 0]
    factor = stiffness_factor(strain.reshape(*weight.shape, 3, 18), place, weight, normal=2, poisson=poisson)
    return np.asarray(factor.transpose(0, 2, 1) @ factor)


def skin_average(x_mm: FloatArray, *, edges_mm: FloatArray, even: bool) -> FloatArray:
    """Matrix (c, k) that takes displacements of the skin's k nodes, from 0 on, to their averages over c cells.

    `even`: the displacement continues to x < 0 with the same sign, or else with the other.

    A cubic spline through the nodes, not the elements' own quadratics: their slopes jump from element to element, and a
    contact pressure answers a jump of slope with a spike. Frames are up to seven times closer to converged ones.
    """
    k = len(x_mm)
    both = np.concatenate([-x_mm[:0:-1], x_mm])
    centre, half = 0.5 * (edges_mm[1:] + edges_mm[:-1]), 0.5 * np.diff(edges_mm)
    values = CubicSpline(both, np.eye(2 * k - 1))(centre[:, None] + half[:, None] * _POINTS)
    average = np.einsum("cpk,p->ck", values, 0.5 * _WEIGHTS)
    right: FloatArray = average[:, k - 1 :].copy()
    right[:, 1:] += (1.0 if even else -1.0) * average[:, k - 2 :: -1]
    return right


# --- Exact surface response of the layered body without a lump, by Fourier transform along the skin.
#
# A pressure :math:`\cos kx` on the skin pushes it down by :math:`c(k) \cos kx`, with the :math:`c` of a pressure
# :math:`J_0(kr)`. For large k, :math:`c \to 2(1-\nu^2)/(Ek)`, the half-plane of fat.


def surface_transfer(k_per_mm: FloatArray, layers: Layers) -> FloatArray:
    """Downward displacement of the skin per unit of pressure that varies as cos kx, k above 0 in 1/mm; mm per kPa."""
    return surface_flexibility(k_per_mm, LayeredBody.of(layers))


def surface_compliance(offset_mm: FloatArray, *, cell_mm: float, layers: Layers) -> FloatArray:
    r"""Mean displacement, mm per kPa downwards, of a surface cell under unit pressure on another cell of the same
    width.

    .. math:: C(x) = \frac{\delta}{\pi}\int_0^\infty c(k)\,\mathrm{sinc}^2(k\delta/2) \cos kx \, dk

    The part of :math:`c` that falls off slowly, :math:`A(1-e^{-kb})/k`, is integrated in closed form (the half-plane's
    logarithm, averaged over both cells); the rest falls off as :math:`e^{-2kb}` and takes Gauss's rule.
    """
    layers_tail = 2 * (1 - layers.poisson**2) / layers.fat_kpa
    depth = layers.fat_mm
    offset = np.abs(np.asarray(offset_mm, dtype=np.float64))
    k, weight = _wave_numbers(depth, layers.thickness_mm, reach_mm=float(offset.max(initial=0.0)) + cell_mm)
    rest = surface_transfer(k, layers) + layers_tail * np.expm1(-k * depth) / k
    rest *= weight * np.sinc(k * cell_mm / (2 * np.pi)) ** 2
    smooth = cell_mm / np.pi * np.cos(np.outer(offset, k)) @ rest
    return np.asarray(smooth + layers_tail * _log_average(offset, cell_mm, depth) / np.pi)


def _wave_numbers(depth_mm: float, thickness_mm: float, *, reach_mm: float) -> tuple[FloatArray, FloatArray]:
    """Gauss points and weights on (0, 40 / depth), in panels that follow 1/thickness and the cosine's period."""
    end = 40.0 / depth_mm
    panels = [0.0]
    while panels[-1] < end:
        panels.append(min(end, panels[-1] + min(max(0.5 / thickness_mm, 0.5 * panels[-1]), 6.0 / reach_mm)))
    points, weights = np.polynomial.legendre.leggauss(8)
    low, high = np.array(panels[:-1])[:, None], np.array(panels[1:])[:, None]
    return (0.5 * (low + high + (high - low) * points)).reshape(-1), (0.5 * (high - low) * weights).reshape(-1)


def _log_average(offset_mm: FloatArray, cell_mm: float, depth_mm: float) -> FloatArray:
    """Integral of (1 - e^-kb)/k cos kx over k, i.e. 0.5 ln(1 + b^2/x^2), averaged over both cells, times the width."""
    steps = offset_mm[:, None] + cell_mm * np.array([-1.0, 0.0, 1.0])
    difference = _log_primitive(steps, depth_mm) - _log_primitive(steps, 0.0)
    return np.asarray(0.5 * difference @ np.array([1.0, -2.0, 1.0]) / cell_mm)


def _log_primitive(x: FloatArray, b: float) -> FloatArray:
    """Second antiderivative of ln(x^2 + b^2)."""
    square = x**2 + b**2
    log = np.log(np.where(square > 0, square, 1.0))
    angle = np.arctan(x / b) if b > 0 else 0.0
    return np.asarray(0.5 * (x**2 - b**2) * log + 2 * b * x * angle - 1.5 * x**2)


# --- Static condensation of a body with a lump onto its surface and the lump's boundary.
#
# The skin of the layered body without a lump answers exactly (`surface_compliance`). What the lump changes is that a
# hole in the body is filled with the lump and not with the layers' own tissue (`mesh.CondensedHole`). One
# factorisation a geometry then gives every stiffness ratio. The body is symmetric, so all this is done twice on half of
# it: for loads symmetric and antisymmetric in x.

FINENESS = 2
CELL_MM = 0.25


class SurfaceCompliance(Record, eq=False):
    """Mean vertical displacement of each surface cell per unit pressure on each cell, for one geometry."""

    body: Body
    edges_mm: FloatArray  #: (n + 1,) array, symmetric about the lump's axis.
    row: FloatArray
    """(n,) array: first row of the (Toeplitz) matrix of the body without the lump, mm per kPa."""
    even: CondensedHole
    odd: CondensedHole
    """`even`, `odd`: The body on x > 0, for loads symmetric and antisymmetric in x."""

    @property
    def x_mm(self) -> FloatArray:
        """(n,) centres of the cells."""
        return 0.5 * (self.edges_mm[1:] + self.edges_mm[:-1])

    @property
    def cell_mm(self) -> float:
        """Width of the cells."""
        return float(self.edges_mm[1] - self.edges_mm[0])

    def without_lump(self) -> FloatArray:
        """(n, n) compliance of the layers alone."""
        index = np.arange(len(self.row))
        return np.asarray(self.row[np.abs(index[:, None] - index[None, :])])

    def with_lump(self, stiffness_ratio: float) -> FloatArray:
        """(n, n) compliance with a lump of E2/E1 = `stiffness_ratio`, symmetric and positive definite."""
        if not (stiffness_ratio > 0 and np.isfinite(stiffness_ratio)):
            raise BadDataError(f"stiffness_ratio is {stiffness_ratio:g}", way_out="it must be finite and above 0")
        even, odd = (hole.change(stiffness_ratio * self.body.fat_kpa) for hole in (self.even, self.odd))
        alike, across = even + odd, even - odd
        change = np.block([[alike[::-1, ::-1], across[::-1]], [across[:, ::-1], alike]])
        # each half carries half of a load, and force is pressure times width
        return np.asarray(self.without_lump() + 0.5 * self.cell_mm * change)


def condense(
    body: Body, *, reach_mm: float = 72.0, cell_mm: float = CELL_MM, fineness: int = FINENESS
) -> SurfaceCompliance:
    """Condense a body onto cells of its skin from ``-reach_mm`` to ``reach_mm``, rounded up to a whole number
    of cells."""
    count = int(np.ceil(reach_mm / cell_mm - 1e-9))
    half: FloatArray = cell_mm * np.arange(count + 1.0)
    row = surface_compliance(2 * half[-1] * np.arange(2 * count) / (2 * count), cell_mm=cell_mm, layers=body.layers)
    hole = body_mesh(body, fineness=fineness)
    disc = disc_mesh(body, fineness=fineness, layered=False)
    cut = body.seat < 1.0 and body.gland_ratio != 1.0  # the lump, by the fat-gland boundary
    filling = disc_mesh(body, fineness=fineness, layered=True) if cut else disc
    stiffness = [
        assemble(mesh, young_kpa=np.where(mesh.gland, body.gland_ratio, 1.0) * body.fat_kpa, poisson=body.poisson)
        for mesh in (hole, filling)
    ]
    unit = assemble(disc, young_kpa=np.ones(len(disc.elements)), poisson=body.poisson)
    even, odd = (
        CondensedHole(
            *_hole_compliance(hole, stiffness[0], body, edges_mm=half, even=even),
            _boundary_stiffness(disc, unit, body, even=even),
            _boundary_stiffness(filling, stiffness[1], body, even=even),
        )
        for even in (True, False)
    )
    return SurfaceCompliance(body, np.concatenate([-half[:0:-1], half]), row, even, odd)


def rim_nodes(body: Body, *, fineness: int) -> int:
    """Number of nodes on the lump's half circle, mid-side nodes included."""
    return len(_rim(disc_mesh(body, fineness=fineness, layered=False), body))


def _rim(mesh: QuadMesh, body: Body) -> IntArray:
    """Nodes on the lump's circle, from its highest point to its lowest: the same order in every mesh of a body."""
    x, z = mesh.nodes[:, 0], mesh.nodes[:, 1] - body.centre_mm
    rim = np.flatnonzero(np.abs(np.hypot(x, z) - body.radius_mm) < 1e-6 * body.d_mm)
    return rim[np.argsort(np.arctan2(x[rim], -z[rim]))]


def _held_on_axis(mesh: QuadMesh, *, even: bool) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(2n,) True for the unknowns that symmetry fixes at 0: u_x on the axis when even, u_z when odd."""
    axis = mesh.nodes[:, 0] < 1e-9 * np.abs(mesh.nodes).max()
    held = np.zeros((len(mesh.nodes), 2), dtype=bool)
    held[axis, 0 if even else 1] = True
    return held.reshape(-1)


def _hole_compliance(
    mesh: QuadMesh, stiffness: csc_array, body: Body, *, edges_mm: FloatArray, even: bool
) -> tuple[FloatArray, FloatArray]:
    """Displacements of rim (g, g) and of skin cells (c, g) per unit force on the rim's free unknowns."""
    held = _held_on_axis(mesh, even=even)
    x, z = mesh.nodes[:, 0], mesh.nodes[:, 1]
    held[0::2] |= x > x.max() * (1 - 1e-9)
    base = z > body.layers.thickness_mm * (1 - 1e-9)
    held |= np.repeat(base, 2)
    free = np.flatnonzero(~held)
    place = np.full(len(held), -1)
    place[free] = np.arange(len(free))
    rim = _rim_unknowns(mesh, body, held)
    solution = moved(stiffness[free][:, free], place[rim])
    skin = np.flatnonzero(z < 1e-9 * body.layers.thickness_mm)
    skin = skin[np.argsort(x[skin])]
    vertical = place[2 * skin + 1]
    lowered = np.where(vertical[:, None] >= 0, solution[vertical], 0.0)
    average = skin_average(x[skin], edges_mm=edges_mm, even=even)
    at_rim = solution[place[rim]]
    return at_rim, average @ lowered


def _rim_unknowns(mesh: QuadMesh, body: Body, held: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> IntArray:
    unknowns = (2 * _rim(mesh, body)[:, None] + np.arange(2)).reshape(-1)
    return np.asarray(unknowns[~held[unknowns]])


def _boundary_stiffness(mesh: QuadMesh, stiffness: csc_array, body: Body, *, even: bool) -> FloatArray:
    """(g, g) stiffness of a disc, condensed onto its rim."""
    held = _held_on_axis(mesh, even=even)
    rim = _rim_unknowns(mesh, body, held)
    inside = ~held
    inside[rim] = False
    return condensed(stiffness, rim, np.flatnonzero(inside))
