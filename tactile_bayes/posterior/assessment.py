"""Common interface of both noise models: assess a place on a map, then draw from its posterior."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.abstention import rim_fault
from tactile_bayes.posterior.lump.diagnostics import NoiseFigures
from tactile_bayes.posterior.lump.posterior import MapPosterior
from tactile_bayes.posterior.options import DETECTED, EstimateOptions, scene_asked
from tactile_bayes.posterior.result import ModalBump
from tactile_bayes.posterior.white.detection import Detection, detect
from tactile_bayes.posterior.white.estimate import chosen_rotation, draw_independent, judged_noise
from tactile_bayes.posterior.white.fit import BumpFit
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.posterior.correlated.estimate import FieldAnswer
    from tactile_bayes.posterior.correlated.selection import SceneChoice

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class MapDraws:
    """Posterior draws of one lump under a noise model.

    Parameters
    ----------
    detection
        The odds of a lump, as the draws left them.
    fit
        The least-squares fit that the draws started from.
    draws
        Of the model's own parameters.
    posterior
        The joint draws by name.
    figures
        Of the fit and the noise, for the report.
    scene
        What the window holds, under correlated errors.
    """

    detection: Detection
    fit: BumpFit
    draws: ParameterDraws
    posterior: MapPosterior
    figures: NoiseFigures
    scene: SceneChoice | None = None


class Assessment(Protocol):
    """A place on a map under one noise model."""

    @property
    def fit(self) -> BumpFit:
        """The least-squares fit."""

    @property
    def detection(self) -> Detection:
        """The odds of a lump against none."""

    @property
    def fault(self) -> str:
        """Reason why the bump cannot be a lump, whatever the odds; empty without one."""

    @property
    def scene(self) -> SceneChoice | None:
        """Structures in the window; None under independent errors, and where the density has no mode."""

    def bump(self) -> ModalBump:
        """Amplitude, centre and widths of the bump at the mode."""

    def widths_mm(self) -> tuple[float, float]:
        """Widths of the bump at the mode, along the ellipse's axes; cheaper than `bump`."""

    def draw(self, options: EstimateOptions, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        """Draw from the posterior of this place.

        Raises
        ------
        NotConvergedError
            When no method converges.
        """


def bump_of(fit: BumpFit) -> ModalBump:
    """The bump of a least-squares fit."""
    amplitude, x, y = (float(value) for value in fit.theta[:3])
    return ModalBump(amplitude, x, y, *fit.widths()[:2])


def assess(tactile_map: TactileMap, fit: BumpFit, options: EstimateOptions) -> Assessment:
    """Assess whether there is a lump at a fitted place, under the noise model of the options."""
    if not options.fit.correlated:
        detection = detect(tactile_map, fit.bump, theta=fit.theta, covariance=fit.covariance, prior=options.prior)
        return _White(tactile_map, fit, detection)
    return _correlated(tactile_map, fit, options)


@dataclass(frozen=True, slots=True, eq=False)
class _White:
    """An assessment under independent errors."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    fault: str = ""
    scene: None = None

    def bump(self) -> ModalBump:
        return bump_of(self.fit)

    def widths_mm(self) -> tuple[float, float]:
        return self.fit.widths()[:2]

    def draw(self, options: EstimateOptions, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        fit, odds = chosen_rotation(self.tactile_map, self.fit, options=options.fit, prior=options.prior)
        draws, posterior = draw_independent(fit, options, rng=rng, progress=progress)
        return MapDraws(self.detection, fit, draws, posterior, judged_noise(fit, odds))


@dataclass(frozen=True, slots=True, eq=False)
class _Correlated:
    """An assessment under correlated errors; `answer` is None where the density has no mode."""

    tactile_map: TactileMap
    fit: BumpFit
    detection: Detection
    answer: FieldAnswer | None
    fault: str = ""

    @property
    def scene(self) -> SceneChoice | None:
        return None if self.answer is None else self.answer.choice

    def bump(self) -> ModalBump:
        fit = self._answer.choice.fit
        x, y = (float(fit.scene.column(fit.mode, name)) for name in "xy")
        return ModalBump(fit.target.amplitude_at(fit.mode), x, y, *self.widths_mm())

    def widths_mm(self) -> tuple[float, float]:
        from tactile_bayes.posterior.correlated.fit import modal_widths

        return modal_widths(self._answer.choice.fit)

    def draw(self, options: EstimateOptions, *, rng: np.random.Generator, progress: Progress | None) -> MapDraws:
        from tactile_bayes.posterior.correlated.estimate import draw

        found = draw(self._answer, self.tactile_map, options, rng=rng, progress=progress)
        return MapDraws(found.detection, self.fit, found.draws, found.posterior, found.figures, self.scene)

    @property
    def _answer(self) -> FieldAnswer:
        if self.answer is None:
            raise NotConvergedError(
                "no bump at this place stands out from the correlated noise, so nothing can be drawn"
            )
        return self.answer


def _correlated(tactile_map: TactileMap, fit: BumpFit, options: EstimateOptions) -> _Correlated:
    """Assess under correlated errors, with neighbouring structures where there is a lump by the evidence."""
    from tactile_bayes.posterior.correlated.estimate import look, with_neighbours

    try:
        seen = look(tactile_map, fit, options)
    except NotConvergedError:
        # no mode: no bump stands out from the correlated noise
        return _Correlated(tactile_map, fit, Detection(0.0, -np.inf), None)
    fault = _field_fault(tactile_map, seen)
    if not fault and seen.detection.probability >= DETECTED:
        seen = with_neighbours(seen, tactile_map, scene=scene_asked(options))
    return _Correlated(tactile_map, fit, seen.detection, seen, fault)


def _field_fault(tactile_map: TactileMap, seen: FieldAnswer) -> str:
    """Fault of a fit under correlated errors: beyond the map's rim, or shrunk to a single cell; empty if none."""
    from tactile_bayes.posterior.correlated.fit import modal_widths

    plain = seen.choice.plain
    x, y = (float(plain.scene.column(plain.mode[None], name)[0]) for name in ("x", "y"))
    return rim_fault(tactile_map, (x, y), modal_widths(plain), radius_mm=plain.target.problem.radius_mm)
