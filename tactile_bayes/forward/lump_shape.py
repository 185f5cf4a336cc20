r"""Shapes of lumps: ellipsoids, lobed and rough outlines, and two balls that touch.

A shape is star-shaped about its centre and given by its radius in every direction. Its own axes are x (the first axis
before any tilt), y, and z down into the tissue; the plane y = 0 is one of symmetry unless the outline is rough.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from tactile_bayes.geometry import FloatArray

# Degrees of a rough outline's harmonics: from an egg shape to bumps of a seventh of the circumference.
ROUGH_DEGREES: Final = (2, 3, 4, 5, 6, 7)
# Random axes per degree: with this many a sum of zonal harmonics is close to a Gaussian field.
_ROUGH_AXES: Final = 12
# Rounding of the groove between two balls, as a cosine of the angle from their common axis.
_FILLET: Final = 0.1
_POINTS: Final = 3000
_DIRECTIONS: Final = 1200
_TURNS: Final = 360


@dataclass(frozen=True, slots=True)
class LumpShape:
    r"""The boundary of a lump about its centre.

    Parameters
    ----------
    half_axes_mm
        Of the ellipsoid that the outline departs from: along x, y and z before the tilt.
    tilt_rad
        By which the first axis rises towards the skin.
    lobes, lobe_share
        The radius is multiplied by :math:`1 + c \sin^k\vartheta \cos k\varphi` about the third axis: k lobes of
        share c.
    rough_share, rough_seed
        The log radius has a random field of degrees 2 to 7 with this root mean square added.
    pair
        Two balls with the second half axis as radius, on the first axis, together twice the first half axis long; the
        groove between them is rounded. The third half axis is not used.
    """

    half_axes_mm: tuple[float, float, float]
    tilt_rad: float = 0.0
    lobes: int = 0
    lobe_share: float = 0.0
    rough_share: float = 0.0
    rough_seed: int = 1
    pair: bool = False

    @property
    def symmetric(self) -> bool:
        """Whether the plane y = 0 is one of symmetry."""
        return self.rough_share == 0

    @property
    def ellipsoid(self) -> bool:
        """Whether the outline is that of the half axes."""
        return not self.pair and self.lobe_share == 0 and self.rough_share == 0

    @property
    def upright_spheroid(self) -> bool:
        """Whether the shape is a ball or a spheroid about the vertical."""
        a, b, c = self.half_axes_mm
        return self.ellipsoid and a == b and (self.tilt_rad == 0 or a == c)

    def radius_mm(self, direction: FloatArray) -> FloatArray:
        """(...,) distance from centre to boundary along (..., 3) unit vectors."""
        along, across, down = _tilted(direction, self.tilt_rad)
        a, b, c = self.half_axes_mm
        if self.pair:
            offset = a - b
            cosine = np.sqrt((along**2 + _FILLET**2) / (1.0 + _FILLET**2))
            radius = offset * cosine + np.sqrt(b**2 - offset**2 * (1.0 - cosine**2))
        else:
            radius = 1.0 / np.sqrt((along / a) ** 2 + (across / b) ** 2 + (down / c) ** 2)
        if self.lobe_share:
            radius = radius * (1.0 + self.lobe_share * np.real((along + 1j * across) ** self.lobes))
        if self.rough_share:
            field = _rough_field(np.stack([along, across, down], axis=-1), self.rough_seed)
            radius = radius * np.exp(self.rough_share * field)
        return np.asarray(radius)

    def points_mm(self) -> FloatArray:
        """(n, 3) points spread over the boundary, the ends of the axes among them."""
        return _points(self)

    @property
    def half_height_mm(self) -> float:
        """Farthest reach of the boundary above or below the centre."""
        if self.ellipsoid:
            a, _, c = self.half_axes_mm
            return float(np.hypot(a * np.sin(self.tilt_rad), c * np.cos(self.tilt_rad)))
        return float(np.abs(self.points_mm()[:, 2]).max())

    def diameters_mm(self) -> tuple[float, float]:
        """Largest and smallest distance between two parallel planes that touch the shape (caliper diameters)."""
        if self.ellipsoid:
            return 2.0 * max(self.half_axes_mm), 2.0 * min(self.half_axes_mm)
        directions = np.concatenate([_sphere(_DIRECTIONS), _upright(np.eye(3), self.tilt_rad)])
        return _extremes(self.points_mm(), directions)

    def diameters_across_mm(self) -> tuple[float, float]:
        """Largest and smallest diameter of the outline seen from above, by calipers that stay level."""
        if self.ellipsoid:
            return self._across()
        angle = np.arange(_TURNS) * (np.pi / _TURNS)
        return _extremes(self.points_mm()[:, :2], np.stack([np.cos(angle), np.sin(angle)], axis=-1))

    def _across(self) -> tuple[float, float]:
        a, b, c = self.half_axes_mm
        along = float(np.hypot(a * np.cos(self.tilt_rad), c * np.sin(self.tilt_rad)))
        return 2.0 * max(along, b), 2.0 * min(along, b)


def _tilted(direction: FloatArray, tilt_rad: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Components of (..., 3) vectors along the three axes of the shape, whose first rises by the tilt."""
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    return c * x - s * z, y, s * x + c * z


def _upright(vector: FloatArray, tilt_rad: float) -> FloatArray:
    """(n, 3) vectors given along the shape's axes, in its frame before the tilt."""
    return np.stack(_tilted(vector, -tilt_rad), axis=-1)


@lru_cache(maxsize=32)
def _points(shape: LumpShape) -> FloatArray:
    axes = _upright(np.concatenate([np.eye(3), -np.eye(3)]), shape.tilt_rad)
    direction = np.concatenate([_sphere(_POINTS), axes])
    return np.asarray(direction * shape.radius_mm(direction)[:, None])


def _extremes(points: FloatArray, directions: FloatArray) -> tuple[float, float]:
    reach = points @ directions.T
    width = reach.max(axis=0) - reach.min(axis=0)
    return float(width.max()), float(width.min())


@lru_cache(maxsize=4)
def _sphere(count: int) -> FloatArray:
    """(count, 3) directions spread evenly over the sphere, on a spiral of golden angles (Swinbank & Purser 2006)."""
    z = (2.0 * np.arange(count) + 1.0) / count - 1.0
    angle = np.arange(count) * (np.pi * (3.0 - np.sqrt(5.0)))
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


def _rough_field(direction: FloatArray, seed: int) -> FloatArray:
    """(...,) random field of unit root mean square over the sphere; its power falls as the degree squared."""
    axes, weight = _rough_terms(seed)
    return np.asarray(_zonal_sum(direction, axes, weight))


def _zonal_sum(direction: FloatArray, axes: FloatArray, weight: FloatArray) -> FloatArray:
    """Sum over degrees and (a, 3) axes of Legendre polynomials of the angle to the axis, with (degrees, a) weights."""
    cosine = direction @ axes.T
    terms = [
        np.polynomial.legendre.legval(cosine, np.eye(degree + 1)[degree]) @ share
        for degree, share in zip(ROUGH_DEGREES, weight, strict=True)
    ]
    return np.asarray(np.sum(terms, axis=0))


@lru_cache(maxsize=32)
def _rough_terms(seed: int) -> tuple[FloatArray, FloatArray]:
    """(a, 3) random axes and (degrees, a) weights of a field with unit root mean square over the sphere."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(_ROUGH_AXES, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    degree = np.array(ROUGH_DEGREES, dtype=np.float64)
    # a zonal harmonic of degree l has a mean square of 1 / (2 l + 1) over the sphere
    weight = rng.normal(size=(len(degree), _ROUGH_AXES)) * (np.sqrt(2.0 * degree + 1.0) / degree)[:, None]
    return axes, weight / np.sqrt(np.mean(_zonal_sum(_sphere(_POINTS), axes, weight) ** 2))
