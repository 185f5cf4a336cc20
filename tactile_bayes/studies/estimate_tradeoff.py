"""Cost of accuracy on one map: whole estimates at many settings against a long run of the default's posterior."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.estimate import estimate_map
from tactile_bayes.posterior.options import EstimateOptions
from tactile_bayes.presets import INTERVAL, MOST_FIELD_COSINES
from tactile_bayes.size.pooling import Calibration
from tactile_bayes.studies.cost_ladder import Clock, Ladder, Reference, Run, Work, climbed, default_run
from tactile_bayes.studies.size_answers import SizeAnswer, answer_of

LONG_RUNS = (("importance", 0.003), ("importance", 0.01), ("ensemble", 0.05), ("ensemble", 0.1))
"""Methods and accuracies (SD) of the reference: the first that converges."""
ACCURACIES_SD = (0.05, 0.01, 0.005)
CHAIN_ACCURACIES_SD = (0.05,)
LAPLACE_DRAWS = (400, 16000)
FIELDS = (8, 12, 18, 24, 30, MOST_FIELD_COSINES)
RADII_MM = (8.0, 12.0, 16.0, 20.0, 25.0, 30.0)
METHOD, ACCURACY, FIELD, WINDOW = "method", "draws", "noise field", "fit window"


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to estimate.

    Parameters
    ----------
    axis, label, default, usable
        As of `Priced`.
    options
        Of the estimate.
    weight
        About how many times the default's CPU time it takes, for a forecast.
    """

    axis: str
    label: str
    options: EstimateOptions
    weight: float = 1.0
    default: bool = False
    usable: bool = True


def settings_of(options: EstimateOptions, *, level_known: bool) -> list[Setting]:
    """Everything that is tried, the default first.

    Parameters
    ----------
    options
        What `estimate` takes by itself for this map.
    level_known
        Whether the map has a background that the paper's least squares can be fixed at.
    """
    return [
        Setting(METHOD, f"--method {options.method}", options, default=True),
        *_methods(options, level_known=level_known),
        *_draws(options),
        *(_fields(options) if options.fit.correlated else ()),
        *_windows(options),
    ]


def worth_trying(settings: list[Setting], answer: SizeAnswer) -> list[Setting]:
    """The settings that can make a difference where the default gives this answer.

    Without draws their number plays no part. Where the default has fallen through to chains, noise fields and windows
    are tried by laplace: chains for each would take minutes.
    """
    if answer.reported is None and answer.code != "method":
        kept = [one for one in settings if one.axis != ACCURACY]
        return [replace(one, weight=min(one.weight, 1.0)) if one.axis == METHOD else one for one in kept]
    default = settings[0].options
    if answer.method != "ensemble" or default.method == "ensemble":
        return settings
    return [settings[0], *map(_beside_chains, settings[1:])]


def _beside_chains(one: Setting) -> Setting:
    """A setting with a weight against chains; by laplace if it is another model."""
    if one.options.method == "ensemble":
        return replace(one, weight=one.weight / 8.0)
    if one.axis in (FIELD, WINDOW):
        return replace(
            one, label=f"{one.label}, laplace", options=_by(one.options, "laplace"), weight=0.05 * one.weight
        )
    return replace(one, weight=0.2 * one.weight)


def _methods(options: EstimateOptions, *, level_known: bool) -> Iterator[Setting]:
    printed = replace(options.fit, noise="independent", background="fixed" if level_known else "free")
    if options.method != "optimise":
        # another model: no noise field, no prior
        plain = replace(options, method="optimise", fit=printed, scene="auto", accuracy_mm=None)
        yield Setting(METHOD, "--method optimise", plain, 0.5, usable=False)
    for method, weight in (("laplace", 1.0), ("importance", 1.0), ("ensemble", 8.0)):
        if method != options.method:
            yield Setting(METHOD, f"--method {method}", _by(options, method), weight)


def _draws(options: EstimateOptions) -> Iterator[Setting]:
    for number in LAPLACE_DRAWS:
        drawn = replace(_by(options, "laplace"), draws=number)
        if options.fit.correlated:
            yield Setting(ACCURACY, f"laplace, {number} draws", drawn, usable=False)
    for accuracy in ACCURACIES_SD:
        label = f"--accuracy-sd {accuracy:g}"
        yield Setting(ACCURACY, label, _by(options, "importance", accuracy), 1.0 + 0.005 / accuracy)
    for accuracy in CHAIN_ACCURACIES_SD if options.fit.correlated else ():
        label = f"--method ensemble --accuracy-sd {accuracy:g}"
        yield Setting(ACCURACY, label, _by(options, "ensemble", accuracy), 25.0)


def _fields(options: EstimateOptions) -> Iterator[Setting]:
    for number in FIELDS:
        finer = replace(options, fit=replace(options.fit, field_cosines=number))
        yield Setting(FIELD, f"field_cosines {number}", finer, max(0.7, (number / 18.0) ** 3.2), usable=False)


def _windows(options: EstimateOptions) -> Iterator[Setting]:
    for radius in RADII_MM:
        if radius != options.fit.radius_mm:
            other = replace(options, fit=replace(options.fit, radius_mm=radius))
            yield Setting(WINDOW, f"fit_radius_mm {radius:g}", other, usable=False)


def _by(options: EstimateOptions, method: Any, accuracy_sd: float | None = None) -> EstimateOptions:
    """The options with another method, which stands for itself: where it fails no other one is tried."""
    return replace(options, method=method, accuracy_sd=accuracy_sd, accuracy_mm=None, step_up=False)


@dataclass(frozen=True, slots=True)
class Estimator:
    """Estimates of one map, seeded by the map and the number of the run.

    Parameters
    ----------
    calibration
        From widths to sizes; None stops at widths.
    seed
        Of the random numbers.
    clock
        CPU seconds so far.
    probability
        Of the intervals.
    """

    tactile_map: TactileMap
    calibration: Calibration | None
    seed: int
    clock: Clock
    probability: float = INTERVAL

    def run(self, options: EstimateOptions) -> Run:
        """A whole estimate, from the map to the size, as a function of the number of the run."""
        calibration = fitted_as(self.calibration, options)

        def once(number: int) -> tuple[dict[str, float], SizeAnswer]:
            rng = np.random.default_rng([self.seed, number, self.tactile_map.fingerprint])
            begun = self.clock()
            try:
                found = estimate_map(self.tactile_map, calibration=calibration, options=options, rng=rng)
                answer = answer_of(found, probability=self.probability)
            except NotConvergedError as error:
                answer = SizeAnswer(str(error), code="method")
            return {"estimate": self.clock() - begun}, answer

        return once

    def reference(self, options: EstimateOptions) -> Reference:
        """The same posterior by the first long run that converges; without one, or without a lump, no answer."""
        spent, answer = 0.0, SizeAnswer("")
        for method, accuracy in LONG_RUNS:
            seconds, answer = self.run(_by(options, method, accuracy))(-1 % 2**32)
            spent += seconds["estimate"]
            if answer.reported is not None:
                name = "importance sampling" if method == "importance" else "MCMC (four ensembles)"
                return Reference(f"{name} of the default's posterior, asked for {accuracy:g} SD", answer, spent)
            if answer.code != "method":  # no draws are made, so none can be more exact
                break
        return Reference(f"none: {answer.reason}", None, spent)


def fitted_as(calibration: Calibration | None, options: EstimateOptions) -> Calibration | None:
    """The calibration as if it had been learned from maps fitted as the options say.

    `estimate` refuses a size from a map fitted in another way; here it is wanted, to see how far off it would be.
    """
    if calibration is None:
        return None
    fit = options.fit
    recipe = replace(calibration.recipe, background=fit.background, radius_mm=fit.radius_mm, noise=fit.noise)
    return replace(calibration, recipe=recipe)


def measure(
    tactile_map: TactileMap, *, calibration: Calibration | None, options: EstimateOptions, work: Work
) -> Ladder:
    """Run every setting on one map.

    Parameters
    ----------
    calibration, options
        What `estimate` takes by itself for this map.
    """
    estimator = Estimator(tactile_map, calibration, work.seed, work.clock, work.probability)
    seconds, answer = default_run(estimator.run(options))
    settings = worth_trying(settings_of(options, level_known=tactile_map.background is not None), answer)
    return climbed(
        settings,
        lambda one: estimator.run(one.options),
        lambda: estimator.reference(options),
        default_s=seconds,
        work=work,
    )
