"""Cross-validation of a size calibration's form over the geometries of a study."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import LEAST_HARD_RATIO
from tactile_bayes.size.eq6 import AxisCalibration, LeftOutErrors
from tactile_bayes.size.learn.eq6 import AxisRows, SizeTable, StudyCases, axis_at_mode, width_changes
from tactile_bayes.size.learn.regression import rows_of
from tactile_bayes.size.terms import monomials, powers

LEAST_GEOMETRIES = 8
"""A quadratic has six coefficients, and one geometry is missing from each fit."""

FitAxis = Callable[[AxisRows], AxisCalibration]
"""Eq 6 from the rows of one axis: `axis_at_mode` or `axis_in_two_stages`."""
_Rows = np.ndarray[tuple[int], np.dtype[np.bool_]]
_Predict = Callable[[_Rows], FloatArray]


def left_out_of_study(
    table: SizeTable, *, least_stiffness_ratio: float = 0.0, fit: FitAxis | None = None
) -> LeftOutErrors | None:
    """Cross-validated errors of Eq 6 and of a log-quadratic, leaving out each geometry in turn.

    None unless the table has `StudyCases` in at least eight geometries. Softer lumps take no part; a least ratio of 0
    is `LEAST_HARD_RATIO`. `fit` is the joint posterior's mode when left out.

    Raises
    ------
    NotConvergedError
        When Eq 6 has no mode without one of the geometries.
    BadDataError
        When the two-stage fit has too few diameters without one.

    Notes
    -----
    A geometry is one seat, diameter and h/d. All stiffnesses of it go out together: they differ so little that one
    would tell the others' size. Where a lump's case at one diameter depth is out, so are the width changes against it.
    By both widths the size of Eq 6 is the geometric mean of those by each; the quadratic, of least squares, takes the
    geometric mean of the widths.
    """
    if table.cases is None:
        return None
    least = least_stiffness_ratio or LEAST_HARD_RATIO
    table = rows_of(table, (table.cases.stiffness_ratio >= least) & (table.amplitude > 0))
    assert table.cases is not None
    geometry = geometry_numbers(table.d_mm, table.cases)
    if len(geometry) == 0 or geometry.max() + 1 < LEAST_GEOMETRIES:
        return None
    widths = {"x": table.sigma_x_mm} if table.sigma_y_mm is None else {"x": table.sigma_x_mm, "y": table.sigma_y_mm}
    both = np.exp(np.mean([np.log(sigma) for sigma in widths.values()], axis=0))
    eq6 = {name: _left_out(geometry, _eq6(table, sigma, fit or axis_at_mode)) for name, sigma in widths.items()}
    eq6["both"] = np.exp(np.mean([np.log(np.maximum(size, 1e-3)) for size in eq6.values()], axis=0))
    quadratic = {name: _left_out(geometry, _quadratic(table, sigma)) for name, sigma in widths.items()}
    quadratic["both"] = _left_out(geometry, _quadratic(table, both))
    if len(widths) == 1:
        del eq6["x"], quadratic["x"]

    def errors(sizes: dict[str, FloatArray]) -> dict[str, float]:
        return {name: float(np.mean(np.abs(size / table.d_mm - 1.0))) for name, size in sizes.items()}

    return LeftOutErrors(len(geometry), int(geometry.max()) + 1, least, errors(eq6), errors(quadratic))


def geometry_numbers(d_mm: FloatArray, cases: StudyCases) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """(n,) index of each row's geometry: one seat, diameter and h/d."""
    names = list(zip(cases.seat, d_mm.tolist(), cases.depth_ratio.tolist(), strict=True))
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([number[name] for name in names], dtype=np.intp)


def _left_out(geometry: np.ndarray[tuple[int], np.dtype[np.intp]], predict: _Predict) -> FloatArray:
    """(n,) sizes in mm, each predicted from the other geometries."""
    sizes = np.empty(len(geometry))
    for number in range(int(geometry.max()) + 1):
        kept = geometry != number
        sizes[~kept] = predict(kept)[~kept]
    return sizes


def _eq6(table: SizeTable, sigma_mm: FloatArray, fit: FitAxis) -> _Predict:
    cases = table.cases
    assert cases is not None
    lump = cases.lumps(table.d_mm)

    def predict(kept: _Rows) -> FloatArray:
        group = [key for key, is_kept in zip(lump, kept, strict=True) if is_kept]
        change = width_changes(sigma_mm[kept], depth_ratio=cases.depth_ratio[kept], group=group)
        try:
            depth = cases.depth_ratio[kept]
            axis = fit(AxisRows(table.d_mm[kept], table.amplitude[kept], sigma_mm[kept], change, depth))
        except NotConvergedError:
            out = int(np.flatnonzero(~kept)[0])
            where = f"{cases.seat[out]}, d {table.d_mm[out]:g} mm, h/d {cases.depth_ratio[out]:g}"
            raise NotConvergedError(f"Eq 6 has no mode without the geometry {where}") from None
        return axis.size_mm(sigma_mm, table.amplitude)

    return predict


def _quadratic(table: SizeTable, sigma_mm: FloatArray) -> _Predict:
    u, v = np.log(table.amplitude), np.log(sigma_mm)
    terms = monomials((u - u.mean(), v - v.mean()), powers(2))

    def predict(kept: _Rows) -> FloatArray:
        coefficients = np.linalg.lstsq(terms[kept], np.log(table.d_mm[kept]), rcond=None)[0]
        return np.asarray(np.exp(terms @ coefficients))

    return predict
