"""Cost of accuracy on one map: every method and setting against a long reference of the same posterior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws
from tactile_bayes.inference.importance import ImportanceOptions, importance
from tactile_bayes.inference.optimise import optimise
from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.posterior.correlated.draw import Sampled, importance_draws
from tactile_bayes.posterior.correlated.fit import FieldFit, laplace_mixture, shape_draws
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.options import EstimateOptions, FitOptions
from tactile_bayes.posterior.search import search
from tactile_bayes.posterior.white.fit import BumpFit, fit_bump
from tactile_bayes.presets import FIELD_COSINES, FINE_FIELD_COSINES

ENDS = (0.025, 0.975)
REFERENCE_POINTS = 16384
"""Points of each of the reference's replicates."""
ACCURACIES_SD = (0.05, 0.02, 0.01, 0.005)
STEPS = (150, 600, 2400)
FIELDS = (12, FIELD_COSINES, 24, FINE_FIELD_COSINES)
FIELD_ACCURACY_SD = 0.01
Clock = Callable[[], float]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Measured:
    """One method at one setting.

    Parameters
    ----------
    method, setting
        The setting as the command line has it; empty where there is none.
    cpu_s
        Mean CPU time of a run, the search for the mode left out: all share it.
    evaluations
        Densities asked for; 0 where there is no density.
    error_sd, error_mm
        Root mean square over runs and the four ends of the 95 % intervals of the widths: of ln sigma in posterior SDs,
        of sigma in mm. Bias and Monte-Carlo error together.
    failed
        Why there is nothing; empty where there is.
    """

    method: str
    setting: str
    cpu_s: float
    evaluations: float
    error_sd: float
    error_mm: float
    failed: str = ""


@dataclass(frozen=True, slots=True)
class Tradeoff:
    """A map's ladder.

    Parameters
    ----------
    measured
        Methods and settings, from the cheapest kind up.
    reference_error_sd
        The reference's own Monte-Carlo error.
    search_cpu_s
        From the map to the mode: detection, scene.
    sd_mm
        Posterior SDs of sigma_x and sigma_y.
    runs
        Runs that errors and times are means of.
    fields
        Noise fields from coarse to fine.
    cosines
        Of the noise field under which the methods ran: what an estimate of this map takes by itself.
    """

    measured: tuple[Measured, ...]
    reference_error_sd: float
    search_cpu_s: float
    sd_mm: tuple[float, float]
    runs: int
    fields: tuple[FieldRow, ...] = ()
    cosines: int = FIELD_COSINES

    def advised(self, tolerance_sd: float) -> Measured | None:
        """The cheapest within a tolerance; None where there is none."""
        within = [one for one in self.measured if not one.failed and one.error_sd <= tolerance_sd]
        return min(within, key=lambda one: one.cpu_s) if within else None


@dataclass(frozen=True, slots=True, eq=False)
class MapCase:
    """What the methods start from.

    Parameters
    ----------
    least_squares
        The bump that `optimise` reports.
    fit
        The mode under correlated errors, with the scene that the map supports.
    """

    least_squares: BumpFit
    fit: FieldFit


def map_case(
    tactile_map: TactileMap, *, radius_mm: float, prior: BumpPrior, cosines: int | None = None
) -> MapCase | str:
    """The highest bump's fits, or why there is none."""
    fit = FitOptions("free", radius_mm, "auto", noise="field", field_cosines=cosines)
    candidates, seen = search(tactile_map, EstimateOptions(fit=fit, prior=prior))
    if not candidates:
        return "nothing rises above the background"
    found = candidates[-1]
    if seen is None or seen.scene is None or found.fit is None:
        return f"no bump can be measured: {found.fault}"
    printed = FitOptions("free" if tactile_map.background is None else "fixed", radius_mm, "off")
    judged, _ = fit_bump(tactile_map, found.centre_mm, options=printed)
    return MapCase(judged or found.fit, seen.scene.fit)


@dataclass(frozen=True, slots=True)
class FieldRow:
    """A noise field of so many cosines along each axis.

    Parameters
    ----------
    cosines
        Of `FitOptions.field_cosines`.
    cpu_s
        From the map to the draws.
    change_sd, change_mm
        Root mean square over the four ends of the 95 % intervals of the widths, against the finest field: of ln sigma
        in its posterior SDs, of sigma in mm.
    """

    cosines: int
    cpu_s: float
    change_sd: float
    change_mm: float


def field_ladder(
    tactile_map: TactileMap, *, radius_mm: float, prior: BumpPrior, clock: Clock, seed: int = 1
) -> tuple[FieldRow, ...]:
    """The same map under noise fields from coarse to fine; empty where one of them shows no bump to draw."""
    spent, widths = [], []
    for cosines in FIELDS:
        begun = clock()
        try:
            case = map_case(tactile_map, radius_mm=radius_mm, prior=prior, cosines=cosines)
            if isinstance(case, str):
                return ()
            density, rng = Sampled.of(case.fit), np.random.default_rng([seed, 3])
            draws = density.finished(importance_draws(density, rng=rng, accuracy_sd=FIELD_ACCURACY_SD), rng)
        except NotConvergedError:
            return ()
        spent.append(clock() - begun)
        widths.append(_widths(case.fit, draws))
    ends = [np.quantile(one, ENDS, axis=1) for one in widths]
    log_sd = np.log(widths[-1]).std(axis=1)
    return tuple(
        FieldRow(
            cosines,
            cpu_s,
            float(np.sqrt(np.mean(((np.log(one) - np.log(ends[-1])) / log_sd) ** 2))),
            float(np.sqrt(np.mean((one - ends[-1]) ** 2))),
        )
        for cosines, cpu_s, one in zip(FIELDS, spent, ends, strict=True)
    )


def measure(
    tactile_map: TactileMap,
    *,
    radius_mm: float,
    prior: BumpPrior,
    clock: Clock,
    seed: int = 1,
    runs: int = 4,
    progress: Progress | None = None,
) -> Tradeoff | str:
    """Run the ladder on one map.

    Parameters
    ----------
    clock
        CPU seconds so far.

    Returns
    -------
    Tradeoff, or why there is nothing to measure.
    """
    begun = clock()
    case = map_case(tactile_map, radius_mm=radius_mm, prior=prior)
    if isinstance(case, str):
        return case
    search_s = clock() - begun
    density = Sampled.of(case.fit)
    many = ImportanceOptions(accuracy_sd=1.0, first=REFERENCE_POINTS)
    rng = np.random.default_rng([seed, 0])
    long = importance(density, density.mean, density.covariance, rng=rng, options=many)
    truth = _widths(case.fit, density.finished(long, rng))
    ladder = _ladder(case, density)
    found = []
    for number, (method, setting, run) in enumerate(ladder):
        found.append(_timed(method, setting, run, truth, clock=clock, seed=seed, runs=runs))
        if progress is not None:
            progress(number + 1, len(ladder))
    sd = np.std(truth, axis=1)
    fields = field_ladder(tactile_map, radius_mm=radius_mm, prior=prior, clock=clock, seed=seed)
    error_sd, sd_mm = long.diagnostics["end_error_sd"], (float(sd[0]), float(sd[1]))
    return Tradeoff(tuple(found), error_sd, search_s, sd_mm, runs, fields, case.fit.target.window.cosines)


Run = Callable[[np.random.Generator], tuple[FloatArray, float]]


def _ladder(case: MapCase, density: Sampled) -> list[tuple[str, str, Run]]:
    """Name, setting, and a function from random numbers to (2, n) draws of the widths and the evaluations."""

    def of(make: Callable[[np.random.Generator], ParameterDraws]) -> Run:
        def run(rng: np.random.Generator) -> tuple[FloatArray, float]:
            draws = make(rng)
            return _widths(case.fit, draws), draws.diagnostics.get("evaluations", 0.0)

        return run

    def least_squares(rng: np.random.Generator) -> tuple[FloatArray, float]:
        fit = case.least_squares
        draws = optimise(fit.theta, fit.covariance, dof=fit.errors.dof, rng=rng)
        return np.array(fit.bump.widths(draws.flat)[:2]), 0.0

    def weighted(accuracy: float) -> Run:
        return of(lambda rng: density.finished(importance_draws(density, rng=rng, accuracy_sd=accuracy), rng))

    def chains(steps: int) -> Run:
        return of(lambda rng: density.finished(_fixed_length(density, steps, rng), rng))

    return [
        ("optimise", "", least_squares),
        ("laplace", "", of(lambda rng: laplace_mixture(case.fit, rng=rng))),
        *(("importance", f"--accuracy-sd {accuracy:g}", weighted(accuracy)) for accuracy in ACCURACIES_SD),
        *(("ensemble", f"{steps} steps", chains(steps)) for steps in STEPS),
    ]


def _fixed_length(density: Sampled, steps: int, rng: np.random.Generator) -> ParameterDraws:
    """An ensemble of so many steps, whatever its diagnostics say."""
    from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble

    options = EnsembleOptions(block=steps, max_steps=steps, least_ess=0.0, most_rhat=np.inf)
    return ensemble(density, density.mean, density.covariance, rng=rng, options=options)


def _timed(method: str, setting: str, run: Run, truth: FloatArray, *, clock: Clock, seed: int, runs: int) -> Measured:
    spent, evaluations, off_sd, off_mm = [], [], [], []
    exact, exact_log = np.quantile(truth, ENDS, axis=1), np.quantile(np.log(truth), ENDS, axis=1)
    sd = np.log(truth).std(axis=1)
    try:
        run(np.random.default_rng([seed, 1]))  # imports and the first call's memory cost nothing
        for number in range(runs):
            begun = clock()
            widths, used = run(np.random.default_rng([seed, 2, number]))
            spent.append(clock() - begun)
            evaluations.append(used)
            off_mm.append(np.quantile(widths, ENDS, axis=1) - exact)
            off_sd.append((np.quantile(np.log(widths), ENDS, axis=1) - exact_log) / sd)
    except NotConvergedError as error:
        return Measured(method, setting, float("nan"), float("nan"), float("nan"), float("nan"), str(error))
    return Measured(
        method,
        setting,
        float(np.mean(spent)),
        float(np.mean(evaluations)),
        float(np.sqrt(np.mean(np.square(off_sd)))),
        float(np.sqrt(np.mean(np.square(off_mm)))),
    )


def _widths(fit: FieldFit, draws: ParameterDraws) -> FloatArray:
    """(2, n) draws of sigma_x and sigma_y."""
    return np.array(shape_draws(fit, draws.flat)[:2])
