"""Fitted values of an estimate's window beside its data: level, tilt, bump and what lies beside it, without noise."""

from __future__ import annotations

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class FittedCells:
    """Cells of a fit window.

    Parameters
    ----------
    x_mm, y_mm : (n,) arrays
        Their centres in `plane`.
    value, fit : (n,) arrays
        The map's values, and the model's at the posterior's middle.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    value: FloatArray
    fit: FloatArray

    @property
    def residual(self) -> FloatArray:
        """(n,) values less the fit: the map's noise, correlated between cells, and what the model lacks."""
        return self.value - self.fit


def fitted_cells(estimate: Estimate) -> FittedCells | None:
    """Data and fit of an estimate's window; None without an estimate.

    Under a noise field the shape is the median of the draws, and what is linear (level, tilt, amplitudes) the
    generalised least-squares solution under the likeliest field; under independent errors it is the least-squares fit.
    """
    if estimate.fit is None or estimate.draws is None:
        return None
    if estimate.scene is None:
        cells = estimate.fit.cells
        fit = np.asarray(estimate.fit.bump.predict(estimate.fit.theta[None], cells)[0], dtype=np.float64)
        return FittedCells(cells.x_mm, cells.y_mm, cells.value, fit)
    from tactile_bayes.posterior.correlated.pointwise import fitted_values

    target = estimate.scene.fit.target
    cells = target.window.cells
    return FittedCells(
        cells.x_mm, cells.y_mm, cells.value, fitted_values(target, np.median(estimate.draws.flat, axis=0))
    )
