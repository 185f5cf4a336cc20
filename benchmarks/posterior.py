"""The posterior of a map of 2,500 cells by our methods and by their peers: ``python -m benchmarks.posterior``.

Everybody gets the same density: a bump under correlated errors, with level, tilt, amplitude, noise scale and field
integrated out, four parameters left. A peer calls the very function that the program calls; NumPyro, which needs
gradients, has it written in JAX (checked against the program's before it is timed). Peers start at the mode with its
covariance, which costs them nothing here. The cost of a method is its CPU time at one accuracy: the error of the ends
of 95 % intervals is measured over independent runs against a long reference, and time is scaled by the error's square
over the wanted one's. Only for importance sampling, whose error falls faster, nothing is scaled: it is run to accuracy.

Each runs in a process of its own with one thread. "warm" is a run after a first one in the same process, "cold" the
whole process with imports, compilation and the search for the mode.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import CommandFailedError, run_once

WANTED_SD = 0.02
RADIUS_MM = 28.25
HALF_MM = 32
ENDS = (0.025, 0.975)
Draw = Callable[[np.random.Generator], np.ndarray]


def simulated_fit() -> Any:
    """The mode of a bump of 6 by 4.5 mm with white errors of 0.01 and a field of 0.01 and 4 mm, seed 1."""
    from tactile_bayes.mapping.map import MapRecipe, TactileMap
    from tactile_bayes.options import BumpPrior
    from tactile_bayes.posterior.bump import cell_mean_gaussian, window_cells
    from tactile_bayes.posterior.fit import fit_scene
    from tactile_bayes.posterior.marginal import Scene
    from tactile_bayes.posterior.window import Problem, Window, independent_variance

    rng = np.random.default_rng(1)
    axis = np.arange(-HALF_MM, HALF_MM + 1.0)
    x, y = np.meshgrid(axis, axis)
    bump = cell_mean_gaussian(x.ravel(), y.ravel(), covariance_mm2=np.diag([36.0, 20.25]), cell_mm=1.0)
    size = len(axis) + 40
    lag = np.fft.fftfreq(size, 1 / size)
    power = np.clip(np.fft.fft2(np.exp(-np.hypot(lag[:, None], lag) / 4.0)).real, 0.0, None)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(power.shape)) * np.sqrt(power)).real
    mean = 1 + 0.3 * bump.reshape(x.shape) + 0.01 * (rng.standard_normal(x.shape) + field[: len(axis), : len(axis)])
    count = np.full(x.shape, 40)
    recipe = MapRecipe("grid", "mean", 1.0)
    tactile_map = TactileMap(mean, np.zeros(x.shape), count, axis, axis, recipe, background=1.0)
    cells = window_cells(tactile_map, (0.0, 0.0), radius_mm=RADIUS_MM)
    window = Window(cells, independent_variance(cells))
    start = np.array([np.log(6.0), np.log(4.5), 0.0, 0.0])
    return fit_scene(Problem(window, BumpPrior(), RADIUS_MM), Scene(), start)


def importance(fit: Any) -> Draw:
    """The program's default method, to the wanted accuracy."""
    from tactile_bayes.posterior.draw import importance_draws

    return lambda rng: importance_draws(fit.sampling_target(), rng=rng, accuracy_sd=WANTED_SD).flat


def laplace(fit: Any) -> Draw:
    """The program's Gaussians."""

    return lambda rng: fit.draw_at_mode("laplace", 4000, rng).flat


def ensemble(fit: Any) -> Draw:
    """The program's MCMC with its own stopping rule."""
    from tactile_bayes.posterior.draw import SamplerSettings, ensemble_draws

    return lambda rng: ensemble_draws(fit.sampling_target(), rng=rng, options=SamplerSettings(method="ensemble")).flat


def emcee_plain(fit: Any) -> Draw:
    """Emcee as its manual shows it: one call a walker, stretch moves, 32 walkers."""
    return _emcee(fit, vectorised=False, steps=1200)


def emcee_vectorised(fit: Any) -> Draw:
    """The same with all walkers of a half-step in one call."""
    return _emcee(fit, vectorised=True, steps=1200)


def _emcee(fit: Any, *, vectorised: bool, steps: int) -> Draw:
    import emcee

    def draw(rng: np.random.Generator) -> np.ndarray:
        target = fit.target if vectorised else lambda theta: float(fit.target(theta[None])[0])
        sampler = emcee.EnsembleSampler(32, 4, target, vectorize=vectorised)
        begin = rng.multivariate_normal(fit.mode, fit.covariance, size=32)
        state = np.random.RandomState(int(rng.integers(2**32))).get_state()
        sampler.run_mcmc(emcee.State(begin, random_state=state), steps)
        # begun at the posterior itself: a tenth is dropped, not half
        return sampler.get_chain(discard=steps // 10, flat=True)

    return draw


def dynesty(fit: Any) -> Draw:
    """Nested sampling with its defaults, in a box of 6 posterior SDs either way (a prior's volume, kindly small)."""
    import dynesty as package
    from dynesty.utils import resample_equal

    sd = np.sqrt(np.diag(fit.covariance))

    def draw(rng: np.random.Generator) -> np.ndarray:
        sampler = package.NestedSampler(
            lambda theta: float(fit.target(theta[None])[0]),
            lambda unit: fit.mode + sd * 12.0 * (unit - 0.5),
            4,
            nlive=400,
            rstate=rng,
        )
        sampler.run_nested(dlogz=0.05, print_progress=False)
        found = sampler.results
        return resample_equal(found.samples, found.importance_weights(), rstate=rng)

    return draw


def bumps(fit: Any) -> Draw:
    """DREAM, with as many chains as its manual advises."""
    from bumps.fitproblem import FitProblem
    from bumps.fitters import DreamFit, FitDriver
    from bumps.pdfwrapper import PDF

    sd = np.sqrt(np.diag(fit.covariance))

    def nllf(a: float, b: float, c: float, d: float) -> float:
        value = float(fit.target(fit.mode[None] + sd * np.array([[a, b, c, d]]))[0])
        return -value if np.isfinite(value) else 1e300

    def draw(rng: np.random.Generator) -> np.ndarray:
        np.random.seed(int(rng.integers(2**32)))  # noqa: NPY002 (it has no other way)
        model = PDF(nllf, a=0.0, b=0.0, c=0.0, d=0.0)
        for parameter in model.parameters().values():
            parameter.range(-8.0, 8.0)
        problem = FitProblem(model)
        driver = FitDriver(fitclass=DreamFit, problem=problem, samples=20000, burn=100, pop=10, init="lhs")
        driver.fit()
        points = driver.fitter.state.draw().points
        order = [problem.labels().index(name) for name in "abcd"]
        return fit.mode + sd * points[:, order]

    return draw


def numpyro(fit: Any) -> Draw:
    """NUTS on the density in JAX, 4 chains one after another."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    from numpyro.infer import MCMC, NUTS

    log_density = _in_jax(fit)
    sd = np.sqrt(np.diag(fit.covariance))
    rows = fit.mode + sd * np.random.default_rng(5).standard_normal((5, 4))
    ours = fit.target(rows) - fit.target(fit.mode[None])
    theirs = np.array([float(log_density(row)) - float(log_density(fit.mode)) for row in rows])
    np.testing.assert_allclose(theirs, ours, atol=1e-4)
    kernel = NUTS(potential_fn=lambda z: -log_density(fit.mode + sd * z), dense_mass=True)
    sampler = MCMC(
        kernel, num_warmup=300, num_samples=1000, num_chains=4, chain_method="sequential", progress_bar=False
    )

    def draw(rng: np.random.Generator) -> np.ndarray:
        begin = jnp.asarray(rng.standard_normal((4, 4)))
        sampler.run(jax.random.PRNGKey(int(rng.integers(2**31))), init_params=begin)
        return fit.mode + sd * np.asarray(sampler.get_samples())

    return draw


def _in_jax(fit: Any) -> Callable[[Any], Any]:
    """The collapsed density with the program's prepared matrices."""
    import jax.numpy as jnp

    target, window = fit.target, fit.target.window
    x, y, weight = jnp.asarray(window.x_mm), jnp.asarray(window.y_mm), jnp.asarray(window.weight)
    across, along = jnp.asarray(window._across), jnp.asarray(window._along)
    plain = jnp.asarray(target.linear.weighted)
    c, dof, cell = len(target.linear.plain) - 1, target.dof, window.cells.cell_mm

    def profile(distance: Any, sigma: Any) -> Any:
        wide = sigma**2 + cell**2 / 12.0
        square = distance**2 / wide
        fourth = (square * (square - 6.0) + 3.0) / wide**2
        return sigma / jnp.sqrt(wide) * jnp.exp(-0.5 * square) * (1.0 - cell**4 / 2880.0 * fourth)

    def log_density(theta: Any) -> Any:
        bump = profile(y - theta[3], jnp.exp(theta[1]))[:, None] * profile(x - theta[2], jnp.exp(theta[0]))
        low = (along.T @ (bump * weight) @ across).ravel()
        with_plain, power0 = jnp.sum(plain * bump, axis=(1, 2)), jnp.sum(weight * bump**2)
        parts = []
        for one in target.fields:
            z = low @ one.field.turn
            row = with_plain - (z @ one.plain).reshape(-1, c + 1)
            to_level = jnp.einsum("hc,hcd->hd", row[:, :c], one.inverse)
            power = power0 - z**2 @ one.weight - jnp.sum(to_level * row[:, :c], axis=1)
            along_data = row[:, c] - jnp.sum(to_level * one.gram[:, :c, c], axis=1)
            squares = one.rest() - along_data**2 / power + one.floor
            variance = target.amplitude_sd**2 + squares / dof / power
            prior = jnp.log(variance) + (along_data / power) ** 2 / variance
            parts.append(one.log_prior - 0.5 * (one.log_det + jnp.log(power) + prior + dof * jnp.log(squares)))
        p, q = 0.5 * (theta[0] + theta[1]), 0.5 * (theta[0] - theta[1])
        widths = ((p - jnp.log(target.problem.prior.width_median_mm)) / target.problem.prior.log_width_sd) ** 2
        widths += (q / target.problem.prior.log_ratio_sd) ** 2
        return jnp.logaddexp.reduce(jnp.concatenate(parts)) - 0.5 * widths

    return log_density


OURS = {"importance": importance, "laplace": laplace, "ensemble": ensemble}
PEERS = {
    "emcee": emcee_plain,
    "emcee, vectorised": emcee_vectorised,
    "numpyro": numpyro,
    "dynesty": dynesty,
    "bumps": bumps,
}
METHODS: dict[str, Callable[[Any], Draw]] = OURS | PEERS


def one(name: str, *, runs: int) -> dict[str, float]:
    """Measure one method in this process."""
    fit = simulated_fit()
    truth = _reference(fit)
    draw = METHODS[name](fit)
    draw(np.random.default_rng(0))
    spent, off = [], []
    for number in range(runs):
        begun = time.process_time()
        theta = draw(np.random.default_rng([1, number]))
        spent.append(time.process_time() - begun)
        off.append((np.quantile(theta, ENDS, axis=0) - truth[0]) / truth[1])
    warm, error = float(np.mean(spent)), float(np.sqrt(np.mean(np.square(off))))
    scaled = warm if name in ("importance", "laplace") else warm * (error / WANTED_SD) ** 2
    return {"warm_cpu_s": warm, "error_sd": error, "cpu_s_at_wanted": scaled}


def _reference(fit: Any) -> tuple[np.ndarray, np.ndarray]:
    from tactile_bayes.inference.importance import ImportanceOptions
    from tactile_bayes.inference.importance import importance as sample

    options = ImportanceOptions(accuracy_sd=1.0, first=16384)
    mean, covariance = fit.mixture.moments()
    theta = sample(fit.target, mean, covariance, rng=np.random.default_rng(99), options=options).flat
    return np.quantile(theta, ENDS, axis=0), theta.std(axis=0)


def cold(name: str) -> None:
    """One run from nothing: what a process costs."""
    METHODS[name](simulated_fit())(np.random.default_rng(0))


def main() -> int:
    """Print one row a method, and how many times dearer each is than importance sampling."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4, help="independent runs a method (4)")
    parser.add_argument("--only", action="append", choices=METHODS, help="measure this method; may be repeated")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures as JSON")
    parser.add_argument("--one", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--cold", choices=METHODS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.one, runs=options.runs)), file=options.json.open("w"))
        return 0
    if options.cold:
        cold(options.cold)
        return 0
    rows = _measured(options.only or list(METHODS), runs=options.runs)
    _print(rows)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 1 if any("error" in row for row in rows.values()) else 0


def _measured(names: list[str], *, runs: int) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for method in names:
            out = folder / "one.json"
            words = ("-m", "benchmarks.posterior", "--one", method, "--runs", str(runs), "--json", str(out))
            try:
                run_once(words, folder=folder)
                rows[method] = json.loads(out.read_text(encoding="utf-8"))
                cost = run_once(("-m", "benchmarks.posterior", "--cold", method), folder=folder)
                rows[method] |= {"cold_cpu_s": cost.cpu_s, "peak_mb": cost.peak_mb}
            except CommandFailedError as error:
                rows[method] = {"error": str(error)}
            print(f"{method} done", file=sys.stderr)
    return rows


def _print(rows: dict[str, dict[str, Any]]) -> None:
    base = rows.get("importance", {}).get("cpu_s_at_wanted")
    wanted = f"CPU s at {WANTED_SD:g} SD"
    print(
        f"{'method':<20}{'warm CPU s':>11}{'error SD':>10}{wanted:>18}{'x importance':>14}{'cold CPU s':>12}{'MB':>6}"
    )
    for name, row in rows.items():
        if "error" in row:
            print(f"{name:<20} {row['error']}")
            continue
        times = f"{row['cpu_s_at_wanted'] / base:.0f}" if base else ""
        print(
            f"{name:<20}{row['warm_cpu_s']:>11.3f}{row['error_sd']:>10.3f}{row['cpu_s_at_wanted']:>18.3f}{times:>14}"
            f"{row['cold_cpu_s']:>12.2f}{row['peak_mb']:>6.0f}"
        )


if __name__ == "__main__":
    sys.exit(main())
