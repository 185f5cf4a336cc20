r"""Contribution of tracker position error to the posterior of a bump's shape.

A frame that is off by :math:`\delta` maps the bump shifted by it, so a cell's error is :math:`-\nabla g \cdot
\bar\delta`, the mean over the frames that felt the cell. Cells less than the array's side apart share frames:
:math:`\bar\delta` is a smooth field of variance :math:`s^2 / n` with the overlap of two arrays, a triangle along each
axis, as its correlation. Such errors look like another shape of the bump, so no noise found beside it tells of them;
what they do to the estimate is added to its draws.
"""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.tangent import tangent_columns
from tactile_bayes.posterior.correlated.window import Window
from tactile_bayes.posterior.lump.cells import PoseNoise, overlap

LEAST_EIGENVALUE = 3e-3
"""Of the overlap of two arrays, over its largest: less is left out."""


def pose_covariance(fit: FieldFit) -> FloatArray:
    """(p, p) covariance of the scene's parameters from tracker position error; zeros where it is not known.

    What lies beside the bump is taken as it is.
    """
    noise = fit.target.window.cells.pose_noise
    p = len(fit.scene.alone().names)
    found = np.zeros((len(fit.mode), len(fit.mode)))
    if noise is None or fit.scene.shape == "ridge":
        return found
    known = tangent_columns(fit)
    slopes = [known[1 + fit.scene.names.index(name)] for name in ("x", "y")]
    errors = _error_columns(fit.target.window, noise, slopes)
    products = fit.target.products(known, np.concatenate([known, errors]), fit.mode)
    v = len(known)
    moved = np.linalg.solve(products[:, :v], products[:, v:])[1 : p + 1]
    found[:p, :p] = moved @ moved.T
    return found


def _error_columns(window: Window, noise: PoseNoise, slopes: list[FloatArray]) -> FloatArray:
    """(k, n) independent parts of the cells' errors, from slopes of a unit bump along x and y."""
    frames = np.maximum(window.cells.count * noise.frames_per_reading, 1.0)
    shared = _shared_frames(window, noise) / np.sqrt(frames)
    return np.concatenate([sd * slope * shared for sd, slope in zip(noise.sd_mm, slopes, strict=True)])


def _shared_frames(window: Window, noise: PoseNoise) -> FloatArray:
    """(k, n) columns whose products sum to the share of frames that two cells share."""
    across, along = (_roots(axis, side) for axis, side in zip((window.x_mm, window.y_mm), noise.side_mm, strict=True))
    power = np.outer(np.sum(along**2, axis=1), np.sum(across**2, axis=1))
    i, j = np.nonzero(power > LEAST_EIGENVALUE * power.max())
    return window.of_cells(along[i][:, :, None] * across[j][:, None, :])


def _roots(axis_mm: FloatArray, side_mm: float) -> FloatArray:
    """(n, n) rows whose products sum to the overlap of two equal intervals about points of an axis."""
    values, vectors = np.linalg.eigh(overlap(axis_mm, side_mm))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)
