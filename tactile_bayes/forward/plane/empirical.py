r"""The empirical model of section 2.2: frames as a weighted sum of two pressure distributions (Eqs 1 to 4).

Symbols as in the paper, except that its three meanings of *a* have names of their own: `SHARE` (alpha, 0.5), the
curvature :math:`1/a(t)^2` of the homogeneous profile, and the map's amplitude, which is not part of this model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.plane.line import LineFrames
from tactile_bayes.geometry import FloatArray

SHARE = 0.5
"""alpha: share of the homogeneous profile that is taken off the frame over the lump (P2 = P0 - alpha P1)."""

DEEPEST_RATIO, LEAST_D_MM = 1.0, 10.0
"""h/d up to which, and diameter in mm from which, the map of Eqs 1 to 4 has a lump about as high and wide as plane
strain: amplitude -33 to +56 %, width -31 to +59 %, by record 0098."""
LOST_RATIO = 1.5
"""h/d from which the map of Eqs 1 to 4 has lost most lumps (record 0098)."""
RANGE = f"it holds for cylinders of {LEAST_D_MM:g} mm and more down to h/d {DEEPEST_RATIO:g}"


def outside_range(d_mm: float, depth_ratio: float) -> str | None:
    """Warn in one line of a lump that the empirical model does not stand for; None inside its range.

    Notes
    -----
    Below, the frame over the lump has no bump of its own: least squares of Eq 2 makes it as flat as the homogeneous
    profile, and Eq 3's map has no lump, or too low a one. Smaller lumps get a bump two to three times too wide.
    """
    if depth_ratio > DEEPEST_RATIO:
        what = "loses most lumps" if depth_ratio >= LOST_RATIO else "makes lumps too low and wide, or loses them"
        return f"warning: h/d {depth_ratio:g}: the empirical model {what} at this depth; {RANGE} (use plane-strain)"
    if d_mm < LEAST_D_MM:
        return f"warning: d {d_mm:g} mm: the empirical model makes it too wide; {RANGE} (use plane-strain)"
    return None


def homogeneous_pressure(
    s_mm: FloatArray, *, peak_kpa: float, curvature_per_mm2: float, half_width_mm: float
) -> FloatArray:
    r"""Pressure across the head far from the lump, P1 (Eq 1).

    Parameters
    ----------
    s_mm : (n,) array
        Position on the head from its centre.
    peak_kpa
        :math:`P_o(t)`, the pressure at the centre.
    curvature_per_mm2
        :math:`1/a(t)^2`. Positive for a profile that falls off to the sides, negative for one that rises.
    half_width_mm
        w, half the head's width.

    Returns
    -------
    (n,) array of kPa; 0 outside the head and where the root would be imaginary.

    Notes
    -----
    .. math:: P_1(s) = P_o \sqrt{1 - s^2 / a^2}

    Wellman & Howe (1999) eq. 1, after Hertz (Johnson 1985, section 4.2). On thick tissue the pressure under this head
    rises to its sides, which no real a describes: the square may have either sign.
    """
    s = np.asarray(s_mm, dtype=np.float64)
    inside = np.maximum(1.0 - curvature_per_mm2 * s**2, 0.0)
    return np.where(np.abs(s) <= half_width_mm, peak_kpa * np.sqrt(inside), 0.0)


def lump_pressure(x_mm: FloatArray, *, height_kpa: float, width_mm: float) -> FloatArray:
    r"""Pressure that the lump adds at a point of the skin, P2 (Eq 2).

    Notes
    -----
    .. math:: P_2(x) = g \exp(-x^2 / (2 \sigma^2))

    Wellman & Howe (1999) eq. 2; the printed s is sigma.
    """
    return np.asarray(height_kpa * np.exp(-0.5 * (np.asarray(x_mm) / width_mm) ** 2))


def kappa(x_c_mm: FloatArray, *, d_mm: float) -> FloatArray:
    r"""Share of the homogeneous profile that stays under the head at a distance from the lump.

    Notes
    -----
    .. math:: \kappa(x_c, d) = \min\left(1, \tfrac12 \left(1 + \tfrac{3}{8d} |x_c|\right)\right)

    Wellman & Howe (1999) eq. 4 with the slope turned over, so that it is continuous: decision record 0004.
    """
    return np.minimum(1.0, 0.5 * (1.0 + 3.0 / (8.0 * d_mm) * np.abs(np.asarray(x_c_mm, dtype=np.float64))))


@dataclass(frozen=True, slots=True)
class EmpiricalModel:
    """The fitted parameters of one case.

    Parameters
    ----------
    peak_kpa, curvature_per_mm2
        Of the homogeneous profile (Eq 1).
    height_kpa, width_mm
        g and sigma of Eq 2.
    d_mm
        Diameter of the lump.
    half_width_mm
        Of the head.
    """

    peak_kpa: float
    curvature_per_mm2: float
    height_kpa: float
    width_mm: float
    d_mm: float
    half_width_mm: float

    def homogeneous(self, s_mm: FloatArray) -> FloatArray:
        """P1 of this case."""
        return homogeneous_pressure(
            s_mm,
            peak_kpa=self.peak_kpa,
            curvature_per_mm2=self.curvature_per_mm2,
            half_width_mm=self.half_width_mm,
        )

    def surface_pressure(self, s_mm: FloatArray, x_c_mm: FloatArray) -> FloatArray:
        r"""Pressure at position s on the head whose centre is at x_c; the arguments broadcast.

        Notes
        -----
        .. math:: P(x, s) = P_2(x) (P_1(s) / \max P_1)^2 + \kappa(x_c, d) P_1(s), \quad x = s + x_c

        Wellman & Howe (1999) eq. 3.
        """
        p1 = self.homogeneous(s_mm)
        # The largest P1 is at the centre, or at the sides where it rises to them.
        share = p1 / float(self.homogeneous(np.array([0.0, self.half_width_mm])).max())
        bump = lump_pressure(s_mm + x_c_mm, height_kpa=self.height_kpa, width_mm=self.width_mm)
        return np.asarray(bump * share**2 + kappa(x_c_mm, d_mm=self.d_mm) * p1)

    def frames(self, x_c_mm: FloatArray, s_mm: FloatArray) -> LineFrames:
        """Frames at the given positions; `plane.line.build_line` averages their curves to the map."""
        return LineFrames(x_c_mm, s_mm, self.surface_pressure(s_mm[None, :], x_c_mm[:, None]))


def fit_empirical(
    s_mm: FloatArray, far_kpa: FloatArray, centred_kpa: FloatArray, *, d_mm: float, half_width_mm: float
) -> EmpiricalModel:
    """Fit Eqs 1 and 2 to two frames, as section 2.2 does.

    Parameters
    ----------
    s_mm : (n,) array
        Positions across the head.
    far_kpa : (n,) array
        Frame far from the lump (Fig 5a).
    centred_kpa : (n,) array
        Frame with the head's centre over the lump, P0 (Fig 5b).
    d_mm
        Diameter of the lump, for Eq 4.
    half_width_mm
        Of the head.

    Raises
    ------
    BadDataError
        When the frames are too short or empty.
    """
    if len(s_mm) < 4 or not (far_kpa > 0).any():
        raise BadDataError(f"a frame of {len(s_mm)} cells", way_out="give at least 4, some of them above 0 kPa")
    peak, curvature = _fit_homogeneous(s_mm, far_kpa, half_width_mm)
    fitted = homogeneous_pressure(s_mm, peak_kpa=peak, curvature_per_mm2=curvature, half_width_mm=half_width_mm)
    height, width = _fit_lump(s_mm, centred_kpa - SHARE * fitted)
    return EmpiricalModel(peak, curvature, height, width, d_mm, half_width_mm)


def _fit_homogeneous(s_mm: FloatArray, pressure: FloatArray, half_width_mm: float) -> tuple[float, float]:
    """Least squares of Eq 1."""

    def shape(scaled: float) -> FloatArray:
        curvature = scaled / half_width_mm**2
        return homogeneous_pressure(s_mm, peak_kpa=1.0, curvature_per_mm2=curvature, half_width_mm=half_width_mm)

    # 1 is the profile that falls to 0 at the sides; far below -8 the middle would be a small part of the sides.
    fit = fit_shape(shape, pressure, grid=np.linspace(-8.0, 1.0, 31))
    return fit.height, fit.parameter / half_width_mm**2


def _fit_lump(x_mm: FloatArray, pressure: FloatArray) -> tuple[float, float]:
    """Least squares of Eq 2 over all widths that a frame can show."""

    def shape(log_width: float) -> FloatArray:
        return lump_pressure(x_mm, height_kpa=1.0, width_mm=float(np.exp(log_width)))

    cell, reach = float(x_mm[1] - x_mm[0]), float(np.abs(x_mm).max())
    fit = fit_shape(shape, pressure, grid=np.linspace(np.log(0.5 * cell), np.log(10.0 * reach), 60))
    return fit.height, float(np.exp(fit.parameter))


@dataclass(frozen=True, slots=True)
class ShapeFit:
    """The multiple of a shape that fits best: its height, the shape's parameter and the sum of squares left."""

    height: float
    parameter: float
    sse: float


def fit_shape(shape: Callable[[float], FloatArray], data: FloatArray, *, grid: FloatArray) -> ShapeFit:
    """Least squares of ``height * shape(parameter)``: the lowest minimum between the ends of a grid.

    Parameters
    ----------
    shape
        (n,) values for one parameter.
    data : (n,) array
    grid : (k,) array
        Where the parameter is looked for first, increasing; about the best place it is then refined.

    Notes
    -----
    The height is linear and leaves one unknown (variable projection; Golub & Pereyra 1973). Steps of Gauss and Newton
    do not settle here where the shape leaves more of the data than it explains, as a faint bump in its trough does.
    """
    from scipy.optimize import minimize_scalar

    def left(parameter: float) -> float:
        return _fit_height(shape(parameter), data)[1]

    k = int(np.argmin([left(value) for value in grid]))
    bounds = (grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])
    refined = float(minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-11}).x)
    best = min((refined, float(grid[k])), key=left)
    height, sse = _fit_height(shape(best), data)
    return ShapeFit(height, best, sse)


def _fit_height(shape: FloatArray, data: FloatArray) -> tuple[float, float]:
    """The best multiple of `shape` and the sum of squares it leaves of `data`."""
    height = float(shape @ data / (shape @ shape))
    return height, float(np.sum((data - height * shape) ** 2))
