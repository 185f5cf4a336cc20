"""Size posterior by Eq 6, draw by draw, with its sources of variance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import Labels, even_replicates
from tactile_bayes.inference.normal import normal_quantile
from tactile_bayes.inference.paired import paired_points
from tactile_bayes.inference.summary import Quantity, summarise
from tactile_bayes.records import dataclass
from tactile_bayes.size.between_maps import BetweenMaps
from tactile_bayes.size.eq6 import AxisCalibration, SizeCalibration
from tactile_bayes.size.supposed import Supposition

EXTREMES = ("max_size_mm", "min_size_mm")
SIZES = (*EXTREMES, "d_x_mm", "d_y_mm")
"""Names of the sizes that a posterior has, in the order of reports."""


@dataclass(frozen=True, slots=True, eq=False)
class SizePosterior:
    """Draws of the lump's size.

    Parameters
    ----------
    d_x_mm, d_y_mm : (chain, draw) arrays
        Diameters along the ellipse's axes nearest to the head's x and y; NaN in an invalid draw.
    variance_share
        Percent of the variance of ln(max size) that goes with the map, the coefficients of Eq 6 and their residual
        scatter; the three sum to 100.
    invalid
        Draws without a size: amplitude or diameter not positive.
    replicates : (chain * draw,) array
        Label of the independent replicate of each draw: their spread is the Monte-Carlo error.
    figures
        What else the calibration found: the probability of a lump that is not round, the spread between maps...
    outliers
        Of several maps, those that lie apart from the rest, by their place in the list.
    another_exam
        The same if another exam of the mass may come out as far apart as in the paper's trial; None where that is
        not told.
    supposing
        What the size would be if something more were known of the body, by the names of `supposed.SUPPOSED`.
    """

    d_x_mm: FloatArray
    d_y_mm: FloatArray
    variance_share: dict[str, float]
    invalid: int
    replicates: Labels
    figures: Mapping[str, float] = field(default_factory=dict)
    outliers: tuple[int, ...] = ()
    another_exam: SizePosterior | None = None
    supposing: Mapping[str, Supposition] = field(default_factory=dict)

    @property
    def max_size_mm(self) -> FloatArray:
        """(chain, draw) larger diameter of each draw. For a round lump its median lies above the true diameter."""
        return np.maximum(self.d_x_mm, self.d_y_mm)

    @property
    def min_size_mm(self) -> FloatArray:
        """(chain, draw) smaller diameter of each draw."""
        return np.minimum(self.d_x_mm, self.d_y_mm)

    @property
    def median_mm(self) -> float:
        """Median of the largest diameter over the draws that gave one; NaN where none did."""
        given = self.max_size_mm[np.isfinite(self.max_size_mm)]
        return float(np.median(given)) if given.size else float("nan")

    def reshaped(self, shape: tuple[int, ...]) -> SizePosterior:
        """The same draws as arrays of another shape, (chain, draw)."""
        another = None if self.another_exam is None else self.another_exam.reshaped(shape)
        d_x_mm, d_y_mm = self.d_x_mm.reshape(shape), self.d_y_mm.reshape(shape)
        return replace(self, d_x_mm=d_x_mm, d_y_mm=d_y_mm, another_exam=another)

    def summarise(self, name: str, *, probability: float) -> Quantity:
        """Summary of one of `SIZES`, with the Monte-Carlo error of its interval."""
        return summarise(getattr(self, name), probability=probability, replicates=self.replicates)


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    amplitude: FloatArray
    sigma_x_mm: FloatArray
    sigma_y_mm: FloatArray
    angle_rad: FloatArray


def push_sizes(
    amplitude: FloatArray,
    sigma_x_mm: FloatArray,
    sigma_y_mm: FloatArray,
    angle_rad: FloatArray,
    *,
    calibration: SizeCalibration,
    rng: np.random.Generator,
    replicates: Labels | None = None,
    another_exam: BetweenMaps | None = None,
) -> SizePosterior:
    """Convert each map draw by Eq 6, with a draw of its coefficients and one of its residual scatter.

    Parameters
    ----------
    amplitude, sigma_x_mm, sigma_y_mm, angle_rad : (chain, draw) arrays
        Joint draws: amplitude and width go together (a stronger bump is a narrower one), which must not be lost.
    rng
        Of the points that pair map draws with calibration draws and scatter, see `paired_points`.
    replicates : (chain * draw,) array
        Label of the independent replicate of each draw. Default: the draws are independent.
    another_exam
        Spread between exams of a mass, for `SizePosterior.another_exam`.

    Notes
    -----
    Wellman & Howe (1999) eq. 6, once for each axis. An ellipse turned by an angle takes, along each of its own axes,
    the two head axes' calibrations in the proportion cos^2 to sin^2.
    """
    shape = amplitude.shape
    inputs = _Inputs(amplitude.ravel(), sigma_x_mm.ravel(), sigma_y_mm.ravel(), angle_rad.ravel())
    replicates = even_replicates(amplitude.size) if replicates is None else replicates
    key = np.maximum(*_sizes(inputs, calibration, calibration.x.draws.mean(axis=0), calibration.y.draws.mean(axis=0)))
    points = paired_points(key, replicates, 4, rng)
    coefficients_x = _coefficients_at(points[:, 0], calibration.x, inputs.sigma_x_mm, inputs.amplitude)
    coefficients_y = _coefficients_at(points[:, 1], calibration.y, inputs.sigma_y_mm, inputs.amplitude)
    d_x, d_y = _sizes(inputs, calibration, coefficients_x, coefficients_y)
    z = normal_quantile(points[:, 2:].T)
    rho = calibration.residual_correlation
    z[1] = rho * z[0] + np.sqrt(1.0 - rho**2) * z[1]
    scattered_x = d_x * np.exp(calibration.x.scatter(inputs.amplitude, draws=coefficients_x) * z[0])
    scattered_y = d_y * np.exp(calibration.y.scatter(inputs.amplitude, draws=coefficients_y) * z[1])
    valid = (d_x > 0) & (d_y > 0)
    parts = _variances(inputs, calibration, coefficients_x, coefficients_y)
    d_x, d_y = np.where(valid, scattered_x, np.nan), np.where(valid, scattered_y, np.nan)
    size = SizePosterior(d_x, d_y, shares(parts), int((~valid).sum()), replicates)
    if another_exam is not None:
        size = replace(size, another_exam=_another(size, parts, another_exam, rng))
    return size.reshaped(shape)


def _another(
    size: SizePosterior, parts: Mapping[str, float], between: BetweenMaps, rng: np.random.Generator
) -> SizePosterior:
    """The sizes with a spread between exams beside what one exam has, a factor that both axes share."""
    points = paired_points(size.max_size_mm, size.replicates, 2, rng)
    tau = between.at(points[:, 0], np.zeros(1), np.zeros(1))
    factor = np.exp(tau * normal_quantile(points[:, 1]))
    return replace(
        size,
        d_x_mm=size.d_x_mm * factor,
        d_y_mm=size.d_y_mm * factor,
        variance_share=shares({**parts, "between_maps": float(np.mean(tau**2))}),
        figures={"between_map_sd": float(np.sqrt(np.mean(tau**2)))},
    )


def _coefficients_at(
    points: FloatArray, axis: AxisCalibration, sigma_mm: FloatArray, amplitude: FloatArray
) -> FloatArray:
    """(n, 6) draws of the coefficients at uniform points, ordered by the size that they give a median map."""
    middle = np.full(len(axis.draws), np.nanmedian(sigma_mm)), np.full(len(axis.draws), np.nanmedian(amplitude))
    in_order = axis.draws[np.argsort(axis.size_mm(*middle, draws=axis.draws), kind="stable")]
    return np.asarray(in_order[(points * len(in_order)).astype(np.intp)])


def _sizes(
    inputs: _Inputs, calibration: SizeCalibration, coefficients_x: FloatArray, coefficients_y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Diameters along the ellipse's own axes, without scatter."""
    along = np.cos(inputs.angle_rad) ** 2

    def blend(sigma: FloatArray, share_x: FloatArray) -> FloatArray:
        across = calibration.x.size_mm(sigma, inputs.amplitude, draws=coefficients_x)
        along_head = calibration.y.size_mm(sigma, inputs.amplitude, draws=coefficients_y)
        return share_x * across + (1.0 - share_x) * along_head

    return blend(inputs.sigma_x_mm, along), blend(inputs.sigma_y_mm, 1.0 - along)


def _variances(
    inputs: _Inputs, calibration: SizeCalibration, coefficients_x: FloatArray, coefficients_y: FloatArray
) -> dict[str, float]:
    """Variance of ln(max size) with all but one source held at its centre."""
    middle = _Inputs(*(np.full(1, np.median(values)) for values in (
        inputs.amplitude, inputs.sigma_x_mm, inputs.sigma_y_mm, inputs.angle_rad
    )))  # fmt: skip
    by_map = _sizes(inputs, calibration, calibration.x.draws.mean(axis=0), calibration.y.draws.mean(axis=0))
    by_coefficients = _sizes(middle, calibration, coefficients_x, coefficients_y)
    larger: AxisCalibration = calibration.x if np.nanmedian(by_map[0] - by_map[1]) >= 0 else calibration.y
    return {
        "map": _log_variance(np.maximum(*by_map)),
        "calibration": _log_variance(np.maximum(*by_coefficients)),
        "residual": float(larger.scatter(middle.amplitude)[0] ** 2),
    }


def shares(variances: Mapping[str, float]) -> dict[str, float]:
    """Percent of the sum of some variances."""
    total = float(sum(variances.values()))
    return {name: float(100.0 * value / total) if total > 0 else 0.0 for name, value in variances.items()}


def _log_variance(size_mm: FloatArray) -> float:
    valid = size_mm[size_mm > 0]
    return float(np.var(np.log(valid))) if len(valid) > 1 else 0.0
