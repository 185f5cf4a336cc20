r"""Static condensation of a body with a lump onto its surface and the lump's boundary.

The skin of the layered body without a lump answers exactly (`layers.surface_compliance`). The lump adds a matrix
of low rank. With H the compliance of the body *with a hole* on the hole's boundary (and from there to the skin), and
:math:`S = FF^T` the stiffness of a disc condensed onto the same boundary, filling the hole changes the skin by

.. math:: -H_{s\Gamma} F (1 + F^T H_{\Gamma\Gamma} F)^{-1} F^T H_{\Gamma s}.

The lump's effect is that of filling the hole with the lump less that of filling it with the layers' own tissue. One
factorisation a geometry gives H; an eigenvalue problem of the size of the boundary then gives every stiffness ratio.
The body is symmetric, so all this is done twice on half of it: for loads symmetric and antisymmetric in x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.body import Body
from tactile_bayes.forward.plane.layers import surface_compliance
from tactile_bayes.forward.plane.mesh import IntArray, QuadMesh, body_mesh, disc_mesh
from tactile_bayes.forward.plane.strain import assemble, skin_average
from tactile_bayes.geometry import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

FINENESS = 2
CELL_MM = 0.25
# Modes of a disc softer than this share of its stiffest are its rigid motions, which cost no energy.
_RIGID = 1e-11
# Modes that move the skin by less than this share of the strongest are left out.
_FAINT = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceCompliance:
    """Mean vertical displacement of each surface cell per unit pressure on each cell, for one geometry.

    Parameters
    ----------
    body
        Geometry and moduli of the tissues.
    edges_mm : (n + 1,) array
        Edges of the cells along x, symmetric about the lump's axis.
    row : (n,) array
        First row of the (Toeplitz) matrix of the body without the lump, mm per kPa.
    own, own_stiffness : (n, j), (j,) arrays
        Shapes on the skin by which the layers' own tissue fills the hole, and each one's compliance relative to it.
    lump, lump_stiffness : (n, i), (i,) arrays
        The same of a lump of unit modulus.
    """

    body: Body
    edges_mm: FloatArray
    row: FloatArray
    own: FloatArray
    own_stiffness: FloatArray
    lump: FloatArray
    lump_stiffness: FloatArray

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
        """(n, n) compliance with a lump of E2/E1 = `stiffness_ratio`, symmetric and positive definite.

        Raises
        ------
        BadDataError
            When the ratio is not above 0.
        """
        if not (stiffness_ratio > 0 and np.isfinite(stiffness_ratio)):
            raise BadDataError(f"stiffness_ratio is {stiffness_ratio:g}", way_out="it must be finite and above 0")
        young = stiffness_ratio * self.body.fat_kpa
        change = (self.own / (1 + self.own_stiffness)) @ self.own.T
        change -= (self.lump * (young / (1 + young * self.lump_stiffness))) @ self.lump.T
        return np.asarray(self.without_lump() + 0.5 * (change + change.T))


def condense(
    body: Body, *, reach_mm: float = 72.0, cell_mm: float = CELL_MM, fineness: int = FINENESS
) -> SurfaceCompliance:
    """Condense a body onto the cells of its skin.

    Parameters
    ----------
    reach_mm
        The cells cover x from ``-reach_mm`` to ``reach_mm``.
    cell_mm
        Width of the cells; the reach is rounded up to a whole number of them.
    fineness
        Of the meshes, see `mesh.body_mesh`.
    """
    count = int(np.ceil(reach_mm / cell_mm - 1e-9))
    half: FloatArray = cell_mm * np.arange(count + 1.0)
    row = surface_compliance(2 * half[-1] * np.arange(2 * count) / (2 * count), cell_mm=cell_mm, layers=body.layers)
    hole = body_mesh(body, fineness=fineness)
    disc = disc_mesh(body, fineness=fineness, layered=False)
    filling = disc_mesh(body, fineness=fineness, layered=True) if _is_layered(body) else disc
    stiffness = [assemble(mesh, young_kpa=_tissue(mesh, body), poisson=body.poisson) for mesh in (hole, filling)]
    unit = assemble(disc, young_kpa=np.ones(len(disc.elements)), poisson=body.poisson)
    parts: list[list[FloatArray]] = [[], [], [], []]
    for even in (True, False):
        at_hole, to_skin = _hole_compliance(hole, stiffness[0], body, edges_mm=half, even=even)
        own = _fill(at_hole, to_skin, _boundary_stiffness(filling, stiffness[1], body, even=even))
        lump = _fill(at_hole, to_skin, _boundary_stiffness(disc, unit, body, even=even))
        for part, (shape, value) in zip((parts[0:2], parts[2:4]), (own, lump), strict=True):
            part[0].append(np.sqrt(cell_mm) * _unfold(shape, even=even))  # force is pressure times width
            part[1].append(value)
    edges = np.concatenate([-half[:0:-1], half])
    own_shapes, lump_shapes = np.hstack(parts[0]), np.hstack(parts[2])
    return SurfaceCompliance(
        body, edges, row, own_shapes, np.concatenate(parts[1]), lump_shapes, np.concatenate(parts[3])
    )


def _is_layered(body: Body) -> bool:
    """Whether the fat-gland boundary cuts the lump."""
    return body.seat < 1.0 and body.gland_ratio != 1.0


def _tissue(mesh: QuadMesh, body: Body) -> FloatArray:
    """(m,) Young's modulus of each element in kPa."""
    return np.where(mesh.gland, body.gland_ratio, 1.0) * body.fat_kpa


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
    mesh: QuadMesh, stiffness: csc_matrix, body: Body, *, edges_mm: FloatArray, even: bool
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
    load = np.zeros((len(free), len(rim)))
    load[place[rim], np.arange(len(rim))] = 1.0
    solution = _solve(stiffness[free][:, free], load)
    skin = np.flatnonzero(z < 1e-9 * body.layers.thickness_mm)
    skin = skin[np.argsort(x[skin])]
    vertical = place[2 * skin + 1]
    lowered = np.where(vertical[:, None] >= 0, solution[vertical], 0.0)
    average = skin_average(x[skin], edges_mm=edges_mm, even=even)
    at_rim = solution[place[rim]]
    return 0.5 * (at_rim + at_rim.T), average @ lowered


def _solve(matrix: csc_matrix, sides: FloatArray) -> FloatArray:
    """Solution of a symmetric positive definite system for many right-hand sides: one factorisation."""
    from scipy.sparse.linalg import splu

    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(sides))


def _rim_unknowns(mesh: QuadMesh, body: Body, held: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> IntArray:
    unknowns = (2 * _rim(mesh, body)[:, None] + np.arange(2)).reshape(-1)
    return np.asarray(unknowns[~held[unknowns]])


def _boundary_stiffness(mesh: QuadMesh, stiffness: csc_matrix, body: Body, *, even: bool) -> FloatArray:
    """(g, g) stiffness of a disc, condensed onto its rim."""
    held = _held_on_axis(mesh, even=even)
    rim = _rim_unknowns(mesh, body, held)
    inside = ~held
    inside[rim] = False
    inner = np.flatnonzero(inside)
    coupling = stiffness[inner][:, rim].toarray()
    solved = _solve(stiffness[inner][:, inner], coupling)
    condensed = stiffness[rim][:, rim].toarray() - coupling.T @ solved
    return np.asarray(0.5 * (condensed + condensed.T))


def _fill(at_hole: FloatArray, to_skin: FloatArray, disc: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shapes on the skin (c, r) and their values (r,) that a disc of unit stiffness scale adds in the hole."""
    values, vectors = np.linalg.eigh(disc)
    kept = values > _RIGID * values[-1]
    factor = vectors[:, kept] * np.sqrt(values[kept])
    eigenvalues, turn = np.linalg.eigh(factor.T @ at_hole @ factor)
    shapes = to_skin @ (factor @ turn)
    size = np.sqrt((shapes**2).sum(axis=0) / np.maximum(eigenvalues, 1e-300))
    strong = size > _FAINT * size.max()
    return shapes[:, strong], eigenvalues[strong]


def _unfold(shapes: FloatArray, *, even: bool) -> FloatArray:
    """Continue shapes on x > 0 to both sides; each half carries half of a load."""
    mirrored = shapes[::-1] if even else -shapes[::-1]
    return np.asarray(np.sqrt(0.5) * np.concatenate([mirrored, shapes]))
