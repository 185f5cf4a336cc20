"""Derivatives of a window's cells by all free parameters of a fitted scene."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.correlated.fit import FieldFit
from tactile_bayes.posterior.correlated.marginal import linear_columns

_STEP = 1e-4


def tangent_columns(fit: FieldFit) -> FloatArray:
    """(v, n) the unit bump, its derivatives by its own parameters first, then level and tilt."""
    window, scene, mode = fit.target.window, fit.scene, fit.mode
    p = len(scene.alone().names)
    steps = _STEP * np.eye(p, len(mode))
    bump = scene.templates(np.concatenate([mode[None], mode + steps, mode - steps]), window)[0]
    values = window.of_cells(bump.full())
    slopes = (values[1 : p + 1] - values[p + 1 :]) / (2 * _STEP)
    return np.concatenate([values[:1], slopes, linear_columns(window.cells, tilt=scene.tilt)])
