"""Frames measured along a head's centre line beside both models of the same lump (Fig 6a of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.plane.empirical import fit_empirical
from tactile_bayes.forward.plane.line import press, press_layers
from tactile_bayes.forward.plane.study import HARD_RATIO, StudySettings
from tactile_bayes.forward.plane.tables import mean_squared_difference
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import HEAD_PITCH_MM

LEAST_TAXELS = 4


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrame:
    """One frame along the centre line of the head.

    Parameters
    ----------
    x_c_mm
        Where the head's centre stands, from the lump's axis.
    s_mm : (n,) array
        Taxel positions from the head's centre.
    pressure_kpa : (n,) array
        What the taxels read.

    Raises
    ------
    BadDataError
        When taxels are few or no pressure is above 0.
    """

    x_c_mm: float
    s_mm: FloatArray
    pressure_kpa: FloatArray

    def __post_init__(self) -> None:
        if len(self.s_mm) < LEAST_TAXELS or not self.pressure_kpa.mean() > 0:
            raise BadDataError(
                f"the frame at x_c_mm {self.x_c_mm:g} has {len(self.s_mm)} taxels with a mean of "
                f"{self.pressure_kpa.mean():.3g} kPa",
                way_out=f"give at least {LEAST_TAXELS} taxels, some of them above 0 kPa",
            )


@dataclass(frozen=True, slots=True, eq=False)
class FrameAgreement:
    """A measured frame and both models at its place and mean pressure.

    Parameters
    ----------
    measured
        As given.
    elastic_kpa, empirical_kpa : (n,) arrays
        The models at the same taxels.
    """

    measured: MeasuredFrame
    elastic_kpa: FloatArray
    empirical_kpa: FloatArray

    @property
    def elastic_difference(self) -> float:
        """Mean squared difference from the elastic model, as a share of the model's sum of squares."""
        return mean_squared_difference(self.measured.pressure_kpa, self.elastic_kpa)

    @property
    def empirical_difference(self) -> float:
        """The same from the empirical model."""
        return mean_squared_difference(self.measured.pressure_kpa, self.empirical_kpa)


def compare_frames(
    frames: Sequence[MeasuredFrame], *, d_mm: float, depth_ratio: float, seat: float, settings: StudySettings
) -> list[FrameAgreement]:
    """Both models of a hard lump at the places and mean pressures of measured frames.

    Parameters
    ----------
    d_mm, depth_ratio, seat
        Of the lump, as in `body.Body`.
    settings
        Body and head; the empirical model is fitted at its mean pressure and scaled with the frame's.

    Raises
    ------
    BadDataError
        When a taxel lies outside the head, or the head beyond the study's positions.
    """
    half, most = settings.head.half_width_mm, max(abs(end) for end in settings.positions_mm[:2])
    for frame in frames:
        if np.abs(frame.s_mm).max() > half or abs(frame.x_c_mm) > most:
            raise BadDataError(
                f"the frame at x_c_mm {frame.x_c_mm:g} has a taxel at s_mm {np.abs(frame.s_mm).max():g}",
                way_out=f"s_mm must lie within {half:g} mm and x_c_mm within {most:g} mm",
            )
    surface = settings.surface(settings.body(d_mm, depth_ratio, seat=seat))
    head, nominal = settings.head, settings.mean_kpa
    far = press_layers(surface.body.layers, head=head, mean_kpa=nominal, cell_mm=settings.cell_mm)
    over = press(surface, HARD_RATIO, np.zeros(1), head=head, mean_kpa=nominal).as_taxels(HEAD_PITCH_MM)
    model = fit_empirical(over.s_mm, far.as_taxels(HEAD_PITCH_MM).at(0.0), over.at(0.0), d_mm=d_mm, half_width_mm=half)
    places = np.array([frame.x_c_mm for frame in frames])
    means = np.array([frame.pressure_kpa.mean() for frame in frames])
    solved = press(surface, HARD_RATIO, places, head=head, mean_kpa=means).as_taxels(HEAD_PITCH_MM)
    found = []
    for frame, elastic, mean in zip(frames, solved.pressure_kpa, means, strict=True):
        empirical = mean / nominal * model.surface_pressure(frame.s_mm, np.full(len(frame.s_mm), frame.x_c_mm))
        found.append(FrameAgreement(frame, np.interp(frame.s_mm, solved.s_mm, elastic), empirical))
    return found
