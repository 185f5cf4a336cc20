r"""Nearly incompressible plane strain: stiffness of nine-node quadrilaterals without volumetric locking.

The volume change of an element is represented by a linear function of position (the Q2/P1 pair, discontinuous), which
is stable up to the incompressible limit and of optimal order. The pressure is eliminated in the element, so that only
displacements remain and the matrix is symmetric and positive definite.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tactile_bayes.forward.plane.mesh import QuadMesh
from tactile_bayes.geometry import FloatArray

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def lame(young: FloatArray | float, poisson: float) -> tuple[FloatArray, FloatArray]:
    """Lame's lambda and the shear modulus mu, in the unit of `young`."""
    young = np.asarray(young, dtype=np.float64)
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def assemble(mesh: QuadMesh, *, young_kpa: FloatArray, poisson: float) -> csc_matrix:
    """Assemble the stiffness matrix of a mesh of unit thickness.

    Parameters
    ----------
    young_kpa : (m,) array
        Young's modulus of each element.

    Returns
    -------
    (2n, 2n) sparse matrix of kPa
        Unknowns are ordered ``x0, z0, x1, z1, ...``; times displacement in mm it gives force in N/m.
    """
    from scipy.sparse import coo_matrix

    blocks = element_stiffness(mesh.nodes[mesh.elements], poisson=poisson) * young_kpa[:, None, None]
    unknowns = (2 * mesh.elements[:, :, None] + np.arange(2)).reshape(len(mesh.elements), 18)
    rows = np.repeat(unknowns, 18, axis=1).reshape(-1)
    columns = np.tile(unknowns, (1, 18)).reshape(-1)
    size = 2 * len(mesh.nodes)
    return coo_matrix((blocks.reshape(-1), (rows, columns)), shape=(size, size)).tocsc()


def element_stiffness(corners: FloatArray, *, poisson: float) -> FloatArray:
    r"""Stiffness of elements with Young's modulus 1.

    Parameters
    ----------
    corners : (m, 9, 2) array
        Positions of the nodes in the order of `QuadMesh`.

    Returns
    -------
    (m, 18, 18) array

    Notes
    -----
    .. math:: K = \int 2\mu\,\varepsilon(v):\varepsilon(u) + \lambda\,\Pi(\nabla\cdot v)\,\Pi(\nabla\cdot u)

    with :math:`\Pi` the projection onto linear functions of x and z on the element (Boffi, Brezzi & Fortin, *Mixed
    Finite Element Methods*, section 8.6), by Gauss's rule of 3 x 3 points.
    """
    lam, mu = lame(1.0, poisson)
    gradient, weight, place = _shape_gradients(corners)
    gx, gz = gradient[..., 0], gradient[..., 1]
    parts = np.zeros((len(corners), 9, 2, 9, 2))
    xx = np.einsum("eqa,eqb,eq->eab", gx, gx, weight)
    zz = np.einsum("eqa,eqb,eq->eab", gz, gz, weight)
    xz = np.einsum("eqa,eqb,eq->eab", gx, gz, weight)
    parts[:, :, 0, :, 0] = mu * (2 * xx + zz)
    parts[:, :, 1, :, 1] = mu * (2 * zz + xx)
    parts[:, :, 0, :, 1] = mu * xz.transpose(0, 2, 1)
    parts[:, :, 1, :, 0] = mu * xz
    linear = _linear_functions(place, weight)
    divergence = gradient.reshape(*gradient.shape[:2], 18)
    mixed = np.einsum("eqp,eqa,eq->epa", linear, divergence, weight)
    mass = np.einsum("eqp,eqr,eq->epr", linear, linear, weight)
    return np.asarray(parts.reshape(-1, 18, 18) + lam * mixed.transpose(0, 2, 1) @ np.linalg.solve(mass, mixed))


def skin_average(x_mm: FloatArray, *, edges_mm: FloatArray, even: bool) -> FloatArray:
    """Matrix that takes displacements of the skin's nodes to their averages over surface cells.

    Parameters
    ----------
    x_mm : (k,) array
        Places of the nodes, increasing from 0.
    edges_mm : (c + 1,) array
        Edges of the cells, within the nodes.
    even
        Whether the displacement continues to x < 0 with the same sign, or with the other.

    Returns
    -------
    (c, k) array

    Notes
    -----
    A cubic spline through the nodes, not the elements' own quadratics: their slopes jump from element to element, and a
    contact pressure answers a jump of slope with a spike. Frames are up to seven times closer to converged ones.
    """
    from scipy.interpolate import CubicSpline

    k = len(x_mm)
    both = np.concatenate([-x_mm[:0:-1], x_mm])
    centre, half = 0.5 * (edges_mm[1:] + edges_mm[:-1]), 0.5 * np.diff(edges_mm)
    values = CubicSpline(both, np.eye(2 * k - 1))(centre[:, None] + half[:, None] * _POINTS)
    average = np.einsum("cpk,p->ck", values, 0.5 * _WEIGHTS)
    right: FloatArray = average[:, k - 1 :].copy()
    right[:, 1:] += (1.0 if even else -1.0) * average[:, k - 2 :: -1]
    return right


def _quadratics(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(..., 3) Lagrange quadratics on -1, 0, 1, and their derivatives."""
    values = np.stack([0.5 * t * (t - 1), 1 - t * t, 0.5 * t * (t + 1)], axis=-1)
    return values, np.stack([t - 0.5, -2 * t, t + 0.5], axis=-1)


def _shape_functions() -> tuple[FloatArray, FloatArray]:
    """Values (9 points, 9 nodes) and local gradients (9, 9, 2)."""
    value, slope = _quadratics(_POINTS)
    values = np.einsum("pi,qj->pqij", value, value).reshape(9, 9)
    first = np.einsum("pi,qj->pqij", slope, value).reshape(9, 9)
    second = np.einsum("pi,qj->pqij", value, slope).reshape(9, 9)
    return values, np.stack([first, second], axis=-1)


def _shape_gradients(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gradients (m, 9 points, 9 nodes, 2), weights (m, 9) and places (m, 9, 2) at the integration points."""
    values, local = _shape_functions()
    jacobian = np.einsum("qal,eac->eqlc", local, corners)
    determinant = np.linalg.det(jacobian)
    gradient = np.einsum("eqcl,qal->eqac", np.linalg.inv(jacobian), local)
    weight = np.abs(determinant) * np.outer(_WEIGHTS, _WEIGHTS).reshape(-1)
    return gradient, weight, np.einsum("qa,eac->eqc", values, corners)


def _linear_functions(place: FloatArray, weight: FloatArray) -> FloatArray:
    """(m, 9, 3) the functions 1, x, z at the integration points, centred and scaled to the element."""
    total = weight.sum(axis=1)[:, None, None]
    middle = np.sum(weight[..., None] * place, axis=1, keepdims=True) / total
    spread = np.sqrt(np.sum(weight[..., None] * (place - middle) ** 2, axis=1, keepdims=True) / total)
    return np.concatenate([np.ones((*weight.shape, 1)), (place - middle) / spread], axis=2)
