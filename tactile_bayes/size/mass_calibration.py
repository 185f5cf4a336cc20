r"""The calibration for a mass and for each of its maps, and what the maps say of the lump by it.

All maps of a mass lie over one body, so the depth of fat is one. Figures by place (`mapping.bump_by_place`) are each
map's own: they are taken at the bump that it shows, so a bump that noise made wider has others, and the size by
both moves less than by either. At the mean of all maps' figures exams of faint lumps would differ by twice as much
(record 0124).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactile_bayes.geometry import FloatArray
from tactile_bayes.records import dataclass
from tactile_bayes.size.body_calibration import BodyCalibration
from tactile_bayes.size.elongation import Elongation, ShapePrior, elongation, shown_share, turn_matrix
from tactile_bayes.size.shape_draws import ShapeDraws
from tactile_bayes.size.site_shift import site_log_shift


@dataclass(frozen=True, slots=True, eq=False)
class MassCalibration:
    """A calibration at the depth of fat under one mass.

    Parameters
    ----------
    mass
        At the mean of the maps' figures by place: for what is common to the maps.
    maps
        For each map.
    """

    mass: BodyCalibration
    maps: tuple[BodyCalibration, ...]

    @classmethod
    def of(cls, calibration: BodyCalibration, by_place: Sequence[tuple[float, ...] | None]) -> MassCalibration:
        """From the calibration at the depth of fat, and the figures by place of each map.

        A map without figures by place is given the others' mean, which does not move with its bump, so its noise
        counts as much as without any figures.
        """
        mass = calibration.at_places(by_place)
        if not mass.knows_places:
            return cls(mass, (mass,) * len(by_place))
        own = [calibration.at_places([one]) for one in by_place]
        others = replace(mass, map_factor=calibration.map_factor)
        return cls(mass, tuple(one if one.knows_places else others for one in own))

    def log_sizes(self, maps: Sequence[ShapeDraws]) -> list[FloatArray]:
        """(n,) ln d of each map's draws without B and E, with the site's correction where there is one."""
        return [corrected_log_size(at, one) for at, one in zip(self.maps, maps, strict=True)]

    def terms(self, maps: Sequence[ShapeDraws]) -> FloatArray:
        """(k, n, t) terms of each map's draws."""
        both = zip(self.maps, maps, strict=True)
        return np.stack([at.terms(one.log_amplitude, one.log_width) for at, one in both])

    def elongation(
        self, maps: Sequence[ShapeDraws], log_sizes: Sequence[FloatArray], prior: ShapePrior
    ) -> tuple[Elongation, float]:
        """Posterior of the lump's shape in the axes the maps share, and the share of it that they show."""
        excess, covariance, shown = np.zeros(2), np.zeros((2, 2)), 0.0
        k = len(maps)
        for one, size in zip(maps, log_sizes, strict=True):
            mean, spread = _axis_ratio(one)
            mean[0] -= float(np.nanmean(self.mass.round_excess(one.log_amplitude, one.log_width)))
            turn = turn_matrix(-one.turn_rad)
            excess += mean @ turn / k
            covariance += turn.T @ spread @ turn / k**2
            shown += shown_share(size, one.log_width) / k
        balls = self.mass.round_lumps.spread
        whole = balls.map_factor * covariance + (balls.variance(np.zeros(()), maps=k) + 1e-12) * np.eye(2)
        return elongation(excess, whole, shown=shown, prior=prior), shown


def corrected_log_size(calibration: BodyCalibration, shape: ShapeDraws) -> FloatArray:
    """(n,) ln d of a map's draws without B and E, their variance counted by the calibration's factor."""
    size = calibration.log_size(shape.log_amplitude, shape.log_width)
    if calibration.map_factor != 1.0:
        middle = np.nanmean(size)
        size = middle + np.sqrt(calibration.map_factor) * (size - middle)
    return np.asarray(size + site_log_shift(calibration.site, shape.log_width))


def _axis_ratio(one: ShapeDraws) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of q and r; where nobody measured r, it is within twice the SD of q about 0.

    It was left out because the map does not speak for it.
    """
    both = np.stack([one.q, one.r], axis=-1)
    both = both[np.isfinite(both).all(axis=1)]
    mean, covariance = both.mean(axis=0), np.cov(both.T)
    if not covariance[1, 1] > 0:
        mean[1], sd = one.oblique or (0.0, 2.0 * float(np.sqrt(covariance[0, 0])))
        covariance[1, 1] = sd**2
    return mean, covariance
