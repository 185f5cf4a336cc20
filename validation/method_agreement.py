"""Whether chains and weighted draws find the same posterior: ``python -m validation method_agreement [--maps NAME]``.

Twenty maps that differ as maps do. On each, `importance` at its default of 0.02 SD is held against emcee ensembles that
start from an overdispersed normal and know nothing of it. Differences of medians and of the ends of 95 % intervals are
in joint Monte-Carlo errors: 0.02 SD, and that of the chains' quantiles by arviz. Were the posteriors equal and the
errors right, their root mean square would be at most 1, and one in 370 beyond 3. The negative control is importance
sampling under another prior, of widths close to 8 mm: its column must not look like the first.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import arviz
import numpy as np

from tactile_bayes.declarations import replace
from tactile_bayes.errors import NotConvergedError
from tactile_bayes.forward.scene import Lump
from tactile_bayes.forward.simulate import simulate
from tactile_bayes.geometry import FloatArray
from tactile_bayes.inference.ensemble import EnsembleOptions, ensemble
from tactile_bayes.mapping.build import build_map
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.draw import SamplerSettings, SamplingTarget, importance_draws
from tactile_bayes.posterior.estimate import search
from tactile_bayes.posterior.fit import FieldFit, fit_scene
from tactile_bayes.studies.population import ExamPrior, draw_exam
from tactile_bayes.studies.sbc import draw_field
from validation.common import parser
from validation.scene_rates import AXIS, gaussian, ridge

PROBABILITIES = (0.025, 0.5, 0.975)
ACCURACY_SD = 0.02
CHAINS = EnsembleOptions(block=450, least_ess=600.0, max_steps=3600)
OTHER_PRIOR = BumpPrior(width_median_mm=8.0, log_width_sd=0.05)
Make = Callable[[], TactileMap]


def grid(
    values: FloatArray, *, noise: float = 0.01, field: float = 0.01, length_mm: float = 3.0, seed: int = 1
) -> Make:
    """A map of values above a level of 1, with independent errors and a field."""

    def make() -> TactileMap:
        rng = np.random.default_rng([19, seed])
        errors = noise * rng.standard_normal(values.shape) + field * draw_field(AXIS, rng, length_mm=length_mm)
        return TactileMap(
            mean=1.0 + values + errors,
            variance=np.full(values.shape, 40 * noise**2),
            count=np.full(values.shape, 40),
            x_mm=AXIS,
            y_mm=AXIS,
            recipe=MapRecipe("grid", "gain", 1.0),
            background=1.0,
        )

    return make


def scan(lump: Lump, *, seed: int, normalise: str = "gain", duration_s: float | None = None) -> Make:
    """The map of a simulated exam, drawn as the population's are."""

    def make() -> TactileMap:
        scene = replace(draw_exam(ExamPrior(), np.random.default_rng([20, seed])), seed=seed, lumps=(lump,))
        scene = scene if duration_s is None else replace(scene, duration_s=duration_s)
        return build_map(simulate(scene, rng=np.random.default_rng([21, seed])).scan, normalise=normalise)

    return make


def lump(
    amplitude: float = 0.3, sigmas: tuple[float, float] = (5.0, 5.0), at: tuple[float, float] = (1.0, -2.0)
) -> FloatArray:
    """(n, n) cell means of a Gaussian."""
    return amplitude * gaussian(*at, sigmas=np.array(sigmas))


def half_covered() -> TactileMap:
    """A lump at the edge of the strokes."""
    whole = grid(lump(at=(12.0, 0.0)), seed=15)()
    count = np.where(AXIS <= 14.0, whole.count, 0)
    return replace(whole, count=count, mean=np.where(count > 0, whole.mean, np.nan))


MAPS: dict[str, Make] = {
    "sharp": grid(lump(0.5), noise=0.003, field=0.003),
    "elongated 1.8:1": grid(lump(sigmas=(3.7, 6.7)), seed=3),
    "small, sigma 2.5 mm": grid(lump(sigmas=(2.5, 2.5)), seed=4),
    "wide, sigma 8 mm": grid(lump(sigmas=(8.0, 8.0)), seed=5),
    "second lump": grid(lump() + lump(0.2, (4.0, 4.0), (17.0, 6.0)), seed=6),
    "rib": grid(lump() + 0.2 * ridge(18.0, 0.4), seed=7),
    "high noise": grid(lump(), noise=0.08, field=0.02, seed=8),
    "field of 12 mm": grid(lump(), field=0.03, length_mm=12.0, seed=9),
    "field of 1.5 mm": grid(lump(), field=0.03, length_mm=1.5, seed=10),
    "independent errors": grid(lump(), field=0.0, seed=11),
    "sloping level": grid(lump() + 0.002 * (AXIS + AXIS[:, None]), seed=12),
    "half covered": half_covered,
    "scan, round": scan(Lump(2.0, 1.0, 0.3, 5.0, 5.0), seed=1),
    "scan, rotated": scan(Lump(-3.0, 2.0, 0.25, 7.0, 4.5, 40.0), seed=2),
    "scan, wide and strong": scan(Lump(-5.4, 4.0, 0.5, 9.5, 8.3, 10.0), seed=3),
    "scan, faint": scan(Lump(0.0, 0.0, 0.06, 5.0, 5.0), seed=4),
    "scan, few frames": scan(Lump(0.0, 3.0, 0.3, 5.0, 6.0), seed=5, duration_s=2.5),
    "scan, frame means": scan(Lump(2.0, -2.0, 0.3, 5.0, 5.0), seed=6, normalise="mean"),
    "scan, small": scan(Lump(1.0, 1.0, 0.3, 3.0, 3.0), seed=7),
    "faint": grid(lump(0.05), seed=2),
    "less faint": grid(lump(0.08), seed=2),
}


def fit_of(tactile_map: TactileMap) -> FieldFit:
    """The scene that `estimate` would draw from."""
    _, seen = search(tactile_map, SamplerSettings(background="free", noise="field"))
    if seen is None or seen.scene is None:
        raise NotConvergedError("no lump found")
    return seen.scene.fit


def under_other_prior(fit: FieldFit) -> FieldFit:
    """The same window and scene under `OTHER_PRIOR`."""
    return fit_scene(replace(fit.target.problem, prior=OTHER_PRIOR), fit.scene, fit.mode)


def differences(density: SamplingTarget, weighted: Sequence[SamplingTarget], *, seed: int) -> list[FloatArray]:
    """(p, 3) differences of quantiles from the chains', in joint errors, for each density drawn by weights."""
    rng = np.random.default_rng([22, seed])
    chains = ensemble(density.log_density, density.mean, density.covariance, rng=rng, options=CHAINS).theta
    names = range(chains.shape[2])
    error = np.array(
        [[float(arviz.mcse(chains[..., i], method="quantile", prob=q)) for q in PROBABILITIES] for i in names]
    )
    own, sd = np.quantile(chains, PROBABILITIES, axis=(0, 1)).T, chains.std(axis=(0, 1))
    found = []
    for one in weighted:
        draws = importance_draws(one, rng=rng, accuracy_sd=ACCURACY_SD).flat
        off = np.quantile(draws, PROBABILITIES, axis=0).T - own
        found.append(off / np.hypot(error, ACCURACY_SD * sd[:, None]))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table as Markdown, a row as soon as it is known; exit code 1 if no map could be compared."""
    words = parser(__name__, __doc__)
    words.add_argument("--maps", action="append", choices=tuple(MAPS), help="this map; may be repeated")
    names = words.parse_args(arguments).maps or tuple(MAPS)
    print("| map | scene | medians, largest | ends, largest | RMS | control, RMS | CPU s |")
    print("|---|---|---|---|---|---|---|", flush=True)
    everything: list[FloatArray] = []
    for name in names:
        begun = time.process_time()
        fit = fit_of(MAPS[name]())
        try:
            own, other = differences(
                fit.sampling_target(),
                [fit.sampling_target(), under_other_prior(fit).sampling_target()],
                seed=tuple(MAPS).index(name),
            )
        except NotConvergedError as error:
            print(f"| {name} | {error} | | | | | {time.process_time() - begun:.0f} |", flush=True)
            continue
        everything.append(own.ravel())
        scene = f"{fit.scene.shape}{', ' + fit.scene.extra if fit.scene.extra else ''}"
        largest = f"{np.abs(own[:, 1]).max():.1f} | {np.abs(own[:, ::2]).max():.1f}"
        print(
            f"| {name} | {scene} | {largest} | {rms(own):.2f} | {rms(other):.1f} | {time.process_time() - begun:.0f} |",
            flush=True,
        )
    if not everything:
        return 1
    all_of = np.concatenate(everything)
    print(f"\n{len(all_of)} differences: RMS {rms(all_of):.2f}, beyond 2: {np.mean(np.abs(all_of) > 2):.1%}, ", end="")
    print(f"beyond 3: {np.mean(np.abs(all_of) > 3):.1%}, largest {np.abs(all_of).max():.1f}")
    return 0


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
