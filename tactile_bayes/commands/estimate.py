"""`estimate`: from tactile maps to sizes."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.errors import (
    EXIT_DONE,
    EXIT_NO_ESTIMATE,
    BadDataError,
    TactileBayesError,
    UsageError,
)
from tactile_bayes.presets import FIT_RADIUS_MM, INTERVAL, METHODS, NOISE

if TYPE_CHECKING:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.posterior.estimate import Estimate, EstimateOptions
    from tactile_bayes.posterior.size_calibration import SizeCalibration

_FILE = click.Path(path_type=Path)
_PROBABILITY = click.FloatRange(min=0.0, max=1.0, min_open=True, max_open=True)


@dataclass(frozen=True, slots=True)
class Settings:
    """The options of one call, as given; picklable, so that a worker can have them."""

    calibration: Path | None
    method: str
    seed: int
    interval: float
    background: str | None
    fit_radius_mm: float | None
    rotation: str
    centre_mm: tuple[float, float] | None
    max_steps: int | None
    noise: str | None
    accuracy_sd: float | None


@dataclass(frozen=True, slots=True)
class Answer:
    """What one map came to: its JSON object and its text, or an error with its exit code."""

    document: dict[str, Any] | None
    text: str
    exit_code: int


@click.command("estimate")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@click.option("--size-calibration", metavar="SIZE.json", type=_FILE, help="Eq 6; without it, widths only.")
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="ensemble",
    show_default=True,
    help="ensemble: MCMC; importance: weighted draws; laplace: mode, curvature; optimise: the paper's least squares.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the random numbers.")
@click.option(
    "--interval", type=_PROBABILITY, default=INTERVAL, show_default=True, help="Probability of the intervals."
)
@click.option("-o", "--output", metavar="POST.nc", type=_FILE, help="Write all draws (netCDF that arviz opens).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: one object, or a list for several maps.")
@click.option("--figure", metavar="FIG.png", type=_FILE, help="Draw the size posterior.")
@click.option("--map-figure", metavar="FIG.png", type=_FILE, help="Draw the map with the fitted ellipse.")
@click.option(
    "--background", type=click.Choice(["fixed", "free"]), help="As the calibration's maps were fitted, if not given."
)
@click.option(
    "--fit-radius-mm", type=click.FloatRange(min=0.0, min_open=True), help="As the calibration's, if not given."
)
@click.option(
    "--rotation",
    type=click.Choice(["auto", "on", "off"]),
    default="auto",
    show_default=True,
    help="auto: turn the ellipse only where the map asks for it.",
)
@click.option(
    "--centre-mm", type=(float, float), metavar="X Y", help="Where on the map to look; else the highest bump."
)
@click.option("--max-steps", type=click.IntRange(min=150), help="Of the ensemble, before it gives up.")
@click.option(
    "--noise",
    type=click.Choice(NOISE),
    help="independent: least squares, correlation judged after; field: correlated errors in the model. "
    "As the calibration's, if not given.",
)
@click.option(
    "--accuracy-sd",
    type=click.FloatRange(min=0.001, max=0.5),
    help="Of importance: error of interval ends, in posterior SDs; 0.02 if not given.",
)
@click.option(
    "--workers", type=click.IntRange(min=1), default=1, show_default=True, help="Processes, for several maps."
)
@click.option("--scheduler", metavar="ADDRESS", help="Send several maps to a dask scheduler (extra [cluster]).")
@click.option("--force", is_flag=True, help="Overwrite existing outputs.")
@click.option("-v", "--verbose", is_flag=True, help="Say on stderr how long it took.")
@click.pass_context
def command(
    ctx: click.Context,
    /,
    maps: tuple[Path, ...],
    size_calibration: Path | None,
    method: str,
    seed: int,
    interval: float,
    output: Path | None,
    as_json: bool,
    figure: Path | None,
    map_figure: Path | None,
    background: str | None,
    fit_radius_mm: float | None,
    rotation: str,
    centre_mm: tuple[float, float] | None,
    max_steps: int | None,
    noise: str | None,
    accuracy_sd: float | None,
    workers: int,
    scheduler: str | None,
    force: bool,
    verbose: bool,
) -> None:
    """Estimate a lump's size from tactile maps, with a credible interval.

    Every posterior draw of the map's Gaussian (Eq 7) goes through Eq 6 with a draw of its coefficients and of its
    residual scatter. Where the map shows no lump that can be measured there is no number: the reason is printed and
    the exit code is 6.

    Example: tactile-bayes estimate map.nc --size-calibration size.json --figure size.png
    """
    settings = Settings(
        size_calibration,
        method,
        seed,
        interval,
        background,
        fit_radius_mm,
        rotation,
        centre_mm,
        max_steps,
        noise,
        accuracy_sd,
    )
    outputs = {"output": output, "figure": figure, "map figure": map_figure}
    _check_outputs([path for path in outputs.values() if path], maps, size_calibration, force=force)
    begun = time.perf_counter()
    if len(maps) == 1:
        answers = [_one_map(maps[0], settings, output, figure, map_figure, force=force)]
    else:
        answers = _many_maps(maps, settings, workers=workers, scheduler=scheduler)
    if verbose:
        print(f"estimate: {time.perf_counter() - begun:.3f} s", file=sys.stderr)
    _print(maps, answers, as_json=as_json)
    ctx.exit(_exit_code(answers))


def _check_outputs(outputs: list[Path], maps: tuple[Path, ...], calibration: Path | None, *, force: bool) -> None:
    """Stop before any work is done if an output cannot be written or would destroy an input."""
    from tactile_bayes.files.atomic import refuse_existing

    twice = [path for index, path in enumerate(maps) if path in maps[:index]]
    if twice:
        raise UsageError(f"{twice[0]} is given twice; give each map once")
    if outputs and len(maps) > 1:
        raise UsageError("--output and the figures take one map at a time; use --json for several")
    if len({path.absolute() for path in outputs}) < len(outputs):
        raise UsageError("two outputs have one name; choose another for one of them")
    inputs = [path for path in (*maps, calibration) if path is not None and path.exists()]
    for path in outputs:
        if any(path.exists() and path.samefile(one) for one in inputs):
            raise UsageError(f"{path} is an input of this command; choose another name for the output")
        refuse_existing(path, force=force)


def _one_map(
    path: Path,
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    map_figure: Path | None,
    *,
    force: bool,
) -> Answer:
    from tactile_bayes.commands.progress import progress_bar

    with progress_bar("effective draws") as progress:
        tactile_map, estimate, provenance = _run(path, settings, progress=progress)
    if estimate.status == "estimate":
        if output:
            from tactile_bayes.files.posterior_nc import write_posterior

            write_posterior(output, estimate, provenance=provenance, force=force)
        if figure:
            _draw_size(estimate, figure, settings.interval, force=force)
        if map_figure:
            _draw_map(tactile_map, estimate, map_figure, force=force)
    return _answer(tactile_map, estimate, provenance, settings)


def _many_maps(maps: tuple[Path, ...], settings: Settings, *, workers: int, scheduler: str | None) -> list[Answer]:
    from functools import partial

    from tactile_bayes.batch import cluster_executor, local_executor, run_batch
    from tactile_bayes.commands.progress import progress_bar

    chosen = cluster_executor(scheduler) if scheduler else local_executor(min(workers, len(maps)))
    with chosen as executor, progress_bar("maps") as progress:
        outcomes = run_batch(
            partial(answer_map, settings=settings), maps, key=str, executor=executor, progress=progress
        )
    return [o.value if o.value is not None else Answer(None, f"error: {o.key}: {o.error}", 1) for o in outcomes]


def answer_map(path: Path, *, settings: Settings) -> Answer:
    """One map of several, in whichever process; a fault of this map is its answer."""
    try:
        tactile_map, estimate, provenance = _run(path, settings, progress=None)
    except TactileBayesError as error:
        text = str(error) if str(path) in str(error) else f"{path}: {error}"
        return Answer(None, f"error: {text}", error.exit_code)
    return _answer(tactile_map, estimate, provenance, settings)


def _run(path: Path, settings: Settings, *, progress: Any) -> tuple[TactileMap, Estimate, Provenance]:
    import numpy as np

    from tactile_bayes.files.map_nc import read_map
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.size_json import read_size_calibration
    from tactile_bayes.posterior.estimate import estimate_map

    tactile_map = read_map(path)
    calibration = read_size_calibration(settings.calibration) if settings.calibration else None
    options = _options(settings, calibration)
    inputs = {"map": path} | ({"size_calibration": settings.calibration} if settings.calibration else {})
    digests = hash_inputs(**inputs)
    # the map's own digest is part of the seed: a map's answer does not depend on its place in a list
    rng = np.random.default_rng([settings.seed, int(digests["map"][:16], 16)])
    try:
        estimate = estimate_map(tactile_map, calibration=calibration, options=options, rng=rng, progress=progress)
    except BadDataError as error:
        raise error.at(path) from None
    recorded = {
        "method": settings.method,
        "interval": settings.interval,
        "background": options.fit.background,
        "fit_radius_mm": options.fit.radius_mm,
        "rotation": settings.rotation,
        "centre_mm": list(settings.centre_mm) if settings.centre_mm else None,
        "noise": options.fit.noise,
        "accuracy_sd": settings.accuracy_sd,
    }
    return tactile_map, estimate, Provenance("estimate", recorded, digests, seed=settings.seed)


def _options(settings: Settings, calibration: SizeCalibration | None) -> EstimateOptions:
    """What is not given is as the calibration's maps were fitted, else as the paper printed it."""
    from tactile_bayes.posterior.estimate import EstimateOptions
    from tactile_bayes.posterior.fit import FitOptions

    noise = settings.noise or (calibration.recipe.noise if calibration else "independent")
    printed = "free" if noise == "field" else "fixed"
    background = settings.background or (calibration.recipe.background if calibration else printed)
    radius = settings.fit_radius_mm or (calibration.recipe.radius_mm if calibration else FIT_RADIUS_MM)
    fit = FitOptions(background, radius, settings.rotation, settings.centre_mm, noise)
    return EstimateOptions(
        method=settings.method, fit=fit, max_steps=settings.max_steps, accuracy_sd=settings.accuracy_sd
    )


def _answer(tactile_map: TactileMap, estimate: Estimate, provenance: Provenance, settings: Settings) -> Answer:
    from tactile_bayes.posterior.bump import BumpPrior
    from tactile_bayes.report.estimate_document import estimate_document
    from tactile_bayes.report.estimate_text import estimate_text

    document = estimate_document(
        estimate, tactile_map, probability=settings.interval, prior=BumpPrior(), provenance=provenance
    )
    text = estimate_text(estimate, tactile_map, probability=settings.interval)
    return Answer(document, text, EXIT_DONE if estimate.status == "estimate" else EXIT_NO_ESTIMATE)


def _draw_size(estimate: Estimate, path: Path, probability: float, *, force: bool) -> None:
    from tactile_bayes.posterior.quantity import summarise
    from tactile_bayes.report.figures import SizeInterval, size_figure

    if estimate.size is None or estimate.draws is None:
        raise UsageError("the size figure needs --size-calibration; --map-figure draws the fit")
    draws = {"max": estimate.size.max_size_mm.ravel(), "min": estimate.size.min_size_mm.ravel()}
    worth = estimate.draws.effective_draws
    quantities = {n: summarise(d, probability=probability, effective_draws=worth) for n, d in draws.items()}
    intervals = {n: SizeInterval(q.low, q.high, q.probability, q.kind) for n, q in quantities.items()}
    size_figure(draws["max"], draws["min"], path, intervals=intervals, force=force)


def _draw_map(tactile_map: TactileMap, estimate: Estimate, path: Path, *, force: bool) -> None:
    import numpy as np

    from tactile_bayes.report.figures import FitContour, map_figure

    posterior = estimate.map_posterior
    if posterior is None:
        return
    names = ("x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "angle_rad")
    x, y, sigma_x, sigma_y, angle = (float(np.median(getattr(posterior, name))) for name in names)
    contour = FitContour((x, y), sigma_x, sigma_y, float(np.degrees(angle)))
    map_figure(tactile_map, path, fit=contour, force=force)


def _print(maps: tuple[Path, ...], answers: list[Answer], *, as_json: bool) -> None:
    from tactile_bayes.files.schema import check_document, dump_json

    for answer in answers:
        if answer.document is None:
            click.echo(answer.text, err=True)
    if as_json:
        documents = [answer.document for answer in answers if answer.document is not None]
        for document in documents:
            check_document(document, "estimate.schema.json", path=Path("the report"))
        click.echo(dump_json(documents[0] if len(maps) == 1 else documents), nl=False)
        return
    for path, answer in zip(maps, answers, strict=True):
        if answer.document is not None:
            click.echo((f"{path}\n" if len(maps) > 1 else "") + answer.text, nl=len(maps) > 1)


def _exit_code(answers: list[Answer]) -> int:
    """The first error's code, else 6 when a map gave no estimate, else 0."""
    failed = [answer.exit_code for answer in answers if answer.document is None]
    if failed:
        return failed[0]
    return EXIT_NO_ESTIMATE if any(answer.exit_code for answer in answers) else EXIT_DONE
