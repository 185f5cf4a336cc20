"""MCMC by emcee ensembles, their checkpoints, and all uses of arviz: chain diagnostics and InferenceData."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np

from tactile_bayes.declarations import Record, field
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.draws import ParameterDraws, student_draws
from tactile_bayes.inference.modes import LogDensity
from tactile_bayes.progress import Progress

# --- The only use of arviz: chain diagnostics, and draws as InferenceData.


@cache
def _arviz() -> Any:
    """Arviz, imported on first use: that takes longer than an estimate."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # its notice of the next major version, which is pinned away
        try:
            return _import_arviz()
        except (OSError, RuntimeError):  # no home that can be written, where it keeps the day of that notice
            with TemporaryDirectory() as folder, _cache_home(folder):
                return _import_arviz()


def _import_arviz() -> Any:
    import arviz

    return arviz


@contextmanager
def _cache_home(folder: str) -> Iterator[None]:
    """Let libraries keep their caches in a folder."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = folder
    try:
        yield
    finally:
        del os.environ["XDG_CACHE_HOME"]
        if before is not None:
            os.environ["XDG_CACHE_HOME"] = before


def _agreement(draws: FloatArray) -> dict[str, float]:
    """Rank-normalised split R-hat, and bulk and tail effective draws, of (chain, draw) draws (Vehtari, Gelman, Simpson,
    Carpenter & Buerkner 2021, Bayesian Analysis 16:667)."""
    arviz = _arviz()
    figures = {"rhat": float(arviz.rhat(draws, method="rank"))}
    return figures | {f"ess_{part}": float(arviz.ess(draws, method=part)) for part in ("bulk", "tail")}


def convergence(draws: FloatArray) -> dict[str, float]:
    """R-hat, effective draws and Monte-Carlo errors (of the median and the ends of the central 95 %, in the quantity's
    unit) of (chain, draw) draws; NaN ranks as the smallest value."""
    finite_draws = np.where(np.isfinite(draws), draws, np.nanmin(draws))
    errors = {"mcse_median": 0.5, "mcse_low": 0.025, "mcse_high": 0.975}
    error_at = partial(_arviz().mcse, finite_draws, method="quantile")
    return _agreement(finite_draws) | {name: float(error_at(prob=share)) for name, share in errors.items()}


class DrawGroup(Record, eq=False):
    """Arrays of one group with the names of their axes, and notes."""

    arrays: Mapping[str, tuple[tuple[str, ...], FloatArray]]  #: Names of the axes, and values.
    notes: Mapping[str, str] = field(default_factory=dict)  #: Text by name.


def inference_data(draws: Mapping[str, FloatArray], groups: Mapping[str, DrawGroup]) -> Any:
    """Convert (chain, draw) arrays to `arviz.InferenceData`: a group ``posterior``, and further `groups`."""
    import xarray

    posterior = DrawGroup({name: (("chain", "draw"), values) for name, values in draws.items()})
    datasets = {}
    for name, group in {"posterior": posterior, **groups}.items():
        dataset = xarray.Dataset(dict(group.arrays), attrs=dict(group.notes))
        datasets[name] = dataset.assign_coords({axis: np.arange(size) for axis, size in dataset.sizes.items()})
    return _arviz().InferenceData(**datasets)


# --- State of an interrupted ensemble, from which it continues exactly.


class ChainState(Record, eq=False):
    """State of all ensembles after the same number of steps."""

    chain: FloatArray  #: (ensemble, step, walker, p) array: In standardised coordinates.
    log_density: FloatArray  #: (ensemble, walker) array: At the last step.
    accepted: FloatArray  #: (ensemble,) array: Mean accepted proposals of a walker so far.
    twister: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]
    """(ensemble, 624) uint32 array: The random generators' keys."""
    cursor: FloatArray  #: (ensemble, 3) array: Their positions, whether a normal draw is kept, and that draw.


class ChainStore(Protocol):
    """Interface of a store for the state, under a key for what it belongs to."""

    def load(self, key: str) -> ChainState | None:
        """Load the state of this key; None without one. Another key's state is an error."""

    def save(self, key: str, state: ChainState) -> None:
        """Store a state in place of the last one."""


# --- Markov chain Monte Carlo by several independent emcee ensembles, which must agree before they stop.

WALKERS_PER_PARAMETER = 4  #: Walkers of each ensemble.


class EnsembleOptions(Record):
    """Stopping rule of the ensembles."""

    ensembles: int = 4
    """Independent ensembles; walkers of one ensemble share their history, so R-hat compares ensembles."""
    block: int = 150  #: Steps between two checks of the diagnostics.
    max_steps: int = 6000  #: Largest number of steps.
    least_ess: float = 800.0  #: Bulk and tail effective draws that every parameter must reach.
    most_rhat: float = 1.01  #: R-hat that no parameter may exceed.
    keep: int = 8000  #: Draws kept, thinned evenly over all ensembles.

    def identity(self) -> str:
        """Text of the settings that a checkpoint depends on: all but the number of steps."""
        return str({"ensembles": self.ensembles, "walkers_per_parameter": WALKERS_PER_PARAMETER, "block": self.block})


def ensemble(
    log_density: LogDensity,
    centre: FloatArray,
    covariance: FloatArray,
    *,
    rng: np.random.Generator,
    options: EnsembleOptions | None = None,
    progress: Progress | None = None,
    start: FloatArray | None = None,
    store: ChainStore | None = None,
    key: str = "",
) -> ParameterDraws:
    """Draw from a log density, (m, p) to (m,), by several emcee ensembles with differential-evolution moves.

    They start from some of the (n, p) draws in `start`, or overdispersed about the (p,) mode by the (p, p) covariance;
    the first third of the steps is dropped. Diagnostics are of the worst parameter; `NotConvergedError` where they are
    not reached in ``max_steps`` says about how many steps would do. Progress is effective draws and those required.

    `store` saves the state after each block under `key`. A run continues from a stored state, on one machine with
    the draws of an uninterrupted run. ter Braak (2006); Foreman-Mackey et al. (2013).
    """
    options = options or EnsembleOptions()
    samplers = [_Ensemble(log_density, centre, covariance, rng=rng, start=start) for _ in range(options.ensembles)]
    stored = None if store is None else store.load(key)
    if stored is not None:
        for index, sampler in enumerate(samplers):
            sampler.restore(stored, index)
    figures: dict[str, float] = {}
    # a restored state is checked before it is run further: it may have converged
    for steps in range(max(options.block, samplers[0].steps), options.max_steps + 1, options.block):
        if steps > samplers[0].steps:
            for sampler in samplers:
                sampler.advance(options.block)
            if store is not None:
                state = zip(*(sampler.state() for sampler in samplers), strict=True)
                store.save(key, ChainState(*map(np.stack, state)))
        chains = np.stack([sampler.chain() for sampler in samplers])
        by_parameter = [_agreement(np.ascontiguousarray(chains[:, :, i])) for i in range(chains.shape[2])]
        figures = {
            name: (max if name == "rhat" else min)(sampler[name] for sampler in by_parameter)
            for name in by_parameter[0]
        }
        least = min(figures["ess_bulk"], figures["ess_tail"])
        if progress is not None:
            progress(int(min(least, options.least_ess)), int(options.least_ess))
        if least >= options.least_ess and figures["rhat"] <= options.most_rhat:
            walkers, accepted = samplers[0].walkers, [sampler.acceptance() for sampler in samplers]
            figures |= {"steps": float(steps), "walkers": float(walkers), "ensembles": len(samplers)}
            figures |= {"evaluations": float(steps * walkers * len(samplers)), "acceptance": float(np.mean(accepted))}
            return _thinned_draws(samplers, chains, figures, log_density=log_density, keep=options.keep)
    if not figures:
        raise NotConvergedError(f"the checkpoint has {samplers[0].steps} steps, more than max_steps allows")
    raise NotConvergedError(_advice(figures, options), diagnostics=figures)


class _Ensemble:
    """One emcee ensemble with its own random stream."""

    def __init__(
        self,
        log_density: LogDensity,
        centre: FloatArray,
        covariance: FloatArray,
        *,
        rng: np.random.Generator,
        start: FloatArray | None,
    ) -> None:
        import emcee  # loads scipy.stats, which nothing else here needs

        p = len(centre)
        self._emcee_state = emcee.State
        self._centre, self._scale = centre, np.sqrt(np.diag(covariance))
        self.walkers = WALKERS_PER_PARAMETER * p
        self._sampler = emcee.EnsembleSampler(
            self.walkers, p, self._standardised(log_density), vectorize=True, moves=[(emcee.moves.DEMove(), 1.0)]
        )
        # emcee's wrapper prints parameters and a traceback at any exception, Ctrl-C among them
        self._sampler.log_prob_fn = self._standardised(log_density)
        if start is None:
            first = _finite_start(log_density, centre, covariance, number=self.walkers, rng=rng)
        else:
            unique = np.unique(start, axis=0)
            first = unique[rng.choice(len(unique), size=self.walkers, replace=len(unique) < self.walkers)]
        # emcee takes neither a seed nor a Generator, but the state of a RandomState
        random_state = np.random.RandomState(int(rng.integers(2**32))).get_state()
        self._state = self._emcee_state((first - self._centre) / self._scale, random_state=random_state)

    def _standardised(self, log_density: LogDensity) -> LogDensity:
        """Density of ``(theta - centre) / scale``: emcee tests the walkers' independence by their condition number."""
        return lambda z: log_density(self._centre + self._scale * z)

    @property
    def steps(self) -> int:
        """Number of steps taken."""
        return int(self._sampler.backend.iteration)

    def advance(self, steps: int) -> None:
        """Take more steps."""
        self._state = self._sampler.run_mcmc(self._state, steps)

    def chain(self) -> FloatArray:
        """(draw, p) last two thirds, walker after walker, so that neighbours in the array are neighbours in time."""
        chain = self._centre + self._scale * self._sampler.get_chain(discard=self.steps // 3)
        return np.asarray(np.swapaxes(chain, 0, 1).reshape(-1, chain.shape[-1]))

    def statistics(self) -> dict[str, FloatArray]:
        """(draw,) log densities, NaN before a restored state, and 1 where the walker moved, in the order of `chain`."""
        first, chain = self.steps // 3, self._sampler.get_chain()
        accepted = np.concatenate([np.ones((1, self.walkers)), np.any(chain[1:] != chain[:-1], axis=2)])
        return {"lp": self._sampler.get_log_prob()[first:].T.ravel(), "accepted": accepted[first:].T.ravel()}

    def acceptance(self) -> float:
        """Share of accepted proposals."""
        return float(np.mean(self._sampler.backend.accepted)) / self.steps

    def state(self) -> tuple[FloatArray, FloatArray, float, FloatArray, FloatArray]:
        """Fields of `ChainState`: chain, last log densities, accepted proposals, generator's key and cursor."""
        _, key, position, has_normal, normal = self._state.random_state
        cursor = np.array([position, has_normal, normal], dtype=np.float64)
        accepted = float(np.mean(self._sampler.backend.accepted))
        return self._sampler.get_chain(), np.asarray(self._state.log_prob), accepted, key, cursor

    def restore(self, state: ChainState, index: int) -> None:
        """Continue from a stored state."""
        chain, backend = state.chain[index], self._sampler.backend
        backend.chain, backend.log_prob, backend.iteration = chain, np.full(chain.shape[:2], np.nan), len(chain)
        backend.accepted[:] = state.accepted[index]
        position, has_normal, normal = state.cursor[index]
        random_state = ("MT19937", state.twister[index], int(position), int(has_normal), float(normal))
        log_density = state.log_density[index].copy()
        self._state = self._emcee_state(chain[-1].copy(), log_prob=log_density, random_state=random_state)


def _finite_start(
    log_density: LogDensity, centre: FloatArray, covariance: FloatArray, *, number: int, rng: np.random.Generator
) -> FloatArray:
    """Overdispersed draws with finite density; those without are pulled towards the centre."""
    draws = student_draws(centre, 1.5 * covariance, dof=np.inf, number=number, rng=rng)
    for _ in range(60):
        bad = ~np.isfinite(log_density(draws))
        if not bad.any():
            return draws
        draws[bad] = centre + 0.7 * (draws[bad] - centre)
    raise NotConvergedError("the posterior is not finite near its mode; check the map")


def _thinned_draws(
    samplers: list[_Ensemble], chains: FloatArray, figures: dict[str, float], *, log_density: LogDensity, keep: int
) -> ParameterDraws:
    """Chains thinned evenly, with their statistics; log densities that a checkpoint lacks are computed anew."""
    stride = max(1, (chains.shape[0] * chains.shape[1]) // keep)
    theta = np.ascontiguousarray(chains[:, ::stride])
    by_ensemble = [sampler.statistics() for sampler in samplers]
    statistics = {
        name: np.stack([statistics_of_one[name] for statistics_of_one in by_ensemble])[:, ::stride]
        for name in by_ensemble[0]
    }
    unknown = np.isnan(statistics["lp"])
    if unknown.any():
        statistics["lp"][unknown] = log_density(theta[unknown])
    return ParameterDraws(theta, "ensemble", figures, statistics=statistics)


def _advice(figures: dict[str, float], options: EnsembleOptions) -> str:
    """Text of the diagnostics that were not reached, with the number of steps that may do."""
    least = max(min(figures["ess_bulk"], figures["ess_tail"]), 1.0)
    factor = max(options.least_ess / least, 2.0 if figures["rhat"] > options.most_rhat else 1.0)
    return (
        f"not converged after {options.max_steps} steps: R-hat {figures['rhat']:.3f} (wanted {options.most_rhat}), "
        f"effective draws {least:.0f} (wanted {options.least_ess:.0f}); "
        f"run about {factor:.1f} times as long (max_steps = {int(np.ceil(factor * options.max_steps / 100)) * 100})"
    )
