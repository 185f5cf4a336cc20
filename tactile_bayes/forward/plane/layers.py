r"""Exact surface response of the layered body without a lump, by Fourier transform along the skin.

A pressure :math:`\cos kx` on the skin pushes it down by :math:`c(k) \cos kx`; :math:`c` comes from eight exponential
solutions of plane strain (four a layer) and the conditions on skin, boundary and wall.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.forward.body import Layers
from tactile_bayes.geometry import FloatArray


def surface_transfer(k_per_mm: FloatArray, layers: Layers) -> FloatArray:
    r"""Downward displacement of the skin per unit of pressure that varies as cos kx; mm per kPa.

    Parameters
    ----------
    k_per_mm : (n,) array
        Wave numbers, above 0.

    Notes
    -----
    In each layer of depth range 0..H the displacements are combinations of :math:`e^{-kz}, z e^{-kz}` and of the same
    measured from the layer's floor, which no thickness makes overflow (Johnson 1985, section 2.2 gives one such pair).
    For large k, :math:`c \to 2(1-\nu^2)/(Ek)`, the half-plane of fat.
    """
    k = np.asarray(k_per_mm, dtype=np.float64)
    nu, fat = layers.poisson, layers.fat_mm
    gland = layers.thickness_mm - fat
    # Depths are scaled by 1/k: one matrix for each wave number.
    top0, top1 = _fields(k, 0.0, fat, nu, 1.0), _fields(k, fat, fat, nu, 1.0)
    low0 = _fields(k, 0.0, gland, nu, layers.gland_ratio)
    low1 = _fields(k, gland, gland, nu, layers.gland_ratio)
    system = np.zeros((len(k), 8, 8))
    system[:, 0:2, :4] = top0[:, 2:4]
    system[:, 2:6, :4] = top1
    system[:, 2:6, 4:] = -low0
    system[:, 6:8, 4:] = low1[:, 0:2]
    load = np.zeros((len(k), 8, 1))
    load[:, 1, 0] = -1.0 / layers.fat_kpa
    solution = np.linalg.solve(system, load)[..., 0]
    return np.asarray(np.einsum("nj,nj->n", top0[:, 1], solution[:, :4]) / k)


def _fields(k: FloatArray, z_mm: float, height_mm: float, nu: float, young: float) -> FloatArray:
    """(n, 4, 4) rows u_x k, u_z k, shear and normal stress of the four solutions of a layer at depth `z_mm` in it.

    u_x goes with sin kx, the other displacement and sigma_zz with cos kx; stresses per unit of fat modulus.
    """
    mu = young / (2 * (1 + nu))
    up, down = np.exp(-k * z_mm), np.exp(-k * (height_mm - z_mm))
    z, rest = k * z_mm, k * (height_mm - z_mm)
    bulk = 3 - 4 * nu
    one = np.ones_like(k)
    shear, normal = 2 - 4 * nu, 4 - 4 * nu
    first = np.stack([one, one, -2 * mu * one, -2 * mu * one], axis=1)
    second = np.stack([z, z + bulk, -mu * (2 * z + shear), -mu * (2 * z + normal)], axis=1)
    # Turned upside down, u_z and the shear change sign.
    third = np.stack([one, -one, 2 * mu * one, -2 * mu * one], axis=1)
    fourth = np.stack([rest, -(rest + bulk), mu * (2 * rest + shear), -mu * (2 * rest + normal)], axis=1)
    columns = (first * up[:, None], second * up[:, None], third * down[:, None], fourth * down[:, None])
    return np.stack(columns, axis=2)


def surface_compliance(offset_mm: FloatArray, *, cell_mm: float, layers: Layers) -> FloatArray:
    r"""Mean displacement of a surface cell under unit pressure on another cell of the same width.

    Parameters
    ----------
    offset_mm : (n,) array
        Distances between the cells' centres.
    cell_mm
        Width of the cells.

    Returns
    -------
    (n,) array of mm per kPa, positive downwards

    Notes
    -----
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
