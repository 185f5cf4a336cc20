"""Point estimates of size from one map's Gaussian, by either form of the size calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.forward.plane.study import StudyRow, learn_as_printed
from tactile_bayes.size.bodies import BodyCalibration, mean_width_mm
from tactile_bayes.size.eq6 import SizeCalibration
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.size.terms import outside_domain
from tactile_bayes.studies.forward_tradeoff import Measured

Sizes = Callable[[float, float, float | None], list[float]]
"""Diameters in mm from an amplitude and the widths across and along the head."""
Outside = Callable[[float, float, float | None], list[str]]
"""In what the same lie outside the table that a calibration was learned from, in words."""


@dataclass(frozen=True, slots=True, eq=False)
class SizeRule:
    """Rule that converts amplitude and widths to a size.

    Parameters
    ----------
    sizes
        Diameters; the largest is the size.
    scatter
        Standard deviation of ln d that it leaves: of what Eq 6 was learned from, or of bodies left out.
    source
        In words.
    outside_of
        What of a map is none of the calibration's.
    """

    sizes: Sizes
    scatter: float
    source: str
    outside_of: Outside | None = None

    def size_mm(self, one: Measured) -> float:
        """Size of a measured map; NaN where its amplitude allows none."""
        if not one.amplitude > 0:
            return float("nan")
        return max(self.sizes(one.amplitude, one.sigma_x_mm, one.sigma_y_mm))

    def outside(self, one: Measured) -> list[str]:
        """Quantities of a measured map that lie outside the calibration's table, in words."""
        if self.outside_of is None:
            return []
        return self.outside_of(one.amplitude, one.sigma_x_mm, one.sigma_y_mm)


def learned_rule(rows: Sequence[StudyRow]) -> SizeRule:
    """Learn Eq 6 in two stages from a study's rows, for each axis of the head, and its scatter over the rows."""
    axes = ["x", "y"] if rows[0].sigma_y_mm is not None else ["x"]
    learned = [learn_as_printed(rows, axis=axis) for axis in axes]

    def sizes(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[float]:
        widths = (sigma_x_mm, sigma_y_mm)
        return [
            one.m * width / (one.e * amplitude**one.f) + one.b_mm
            for one, width in zip(learned, widths, strict=False)
            if one is not None and width is not None
        ] or [float("nan")]

    shown = [row for row in rows if row.detectable]
    left = [max(sizes(row.amplitude, row.sigma_x_mm, row.sigma_y_mm)) / row.d_mm for row in shown]
    scatter = float(np.sqrt(np.mean(np.log(np.maximum(left, 1e-3)) ** 2))) if shown else float("nan")
    kind = "balls" if len(axes) == 2 else "cylinders"
    return SizeRule(sizes, scatter, f"Eq 6 in two stages from {len(shown)} hard {kind} of 10 to 25 mm in this body")


def calibrated_rule(calibration: Calibration, *, name: str) -> SizeRule:
    """The point estimate of a calibration of either form; `name` is for people."""
    if isinstance(calibration, BodyCalibration):
        return _body_rule(calibration, name)
    return _eq6_rule(calibration, name)


def _eq6_rule(calibration: SizeCalibration, name: str) -> SizeRule:
    """Eq 6 with its mean coefficients for each axis of the head."""

    def sizes(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[float]:
        a = np.array([amplitude])
        found = [float(calibration.x.size_mm(np.array([sigma_x_mm]), a)[0])]
        if sigma_y_mm is not None:
            found.append(float(calibration.y.size_mm(np.array([sigma_y_mm]), a)[0]))
        return found

    def outside(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[str]:
        along = [] if sigma_y_mm is None else outside_domain(calibration.y.domain, amplitude, sigma_y_mm)
        return list(dict.fromkeys([*outside_domain(calibration.x.domain, amplitude, sigma_x_mm), *along]))

    return SizeRule(sizes, float(calibration.x.draws.mean(axis=0)[4]), f"Eq 6 of {name}", outside)


def _body_rule(calibration: BodyCalibration, name: str) -> SizeRule:
    """A calibration over a population with its mean coefficients, for a round lump in a body of which nothing is known.

    Notes
    -----
    It is the median of what `pooled_size` draws where the map says a and the widths exactly. A map in two dimensions
    has one width, which stands for both.
    """

    def sizes(amplitude: float, sigma_x_mm: float, sigma_y_mm: float | None) -> list[float]:
        width = mean_width_mm(sigma_x_mm, sigma_y_mm)
        log_a, log_width = np.log(np.array(amplitude)), np.log(np.array(width))
        return [float(np.exp(calibration.corrected_log_size(log_a, log_width)))]

    scatter = calibration.fit.get("left_out_sd", float(np.exp(calibration.spread.mean[0])))
    return SizeRule(sizes, float(scatter), f"{calibration.form_name} of {name}", calibration.outside)
