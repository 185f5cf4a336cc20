"""One map of `estimate`: the calibration and options that fit it, the estimate, its report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, BadDataError, TactileBayesError, UsageError
from tactile_bayes.presets import FIT_RADIUS_MM
from tactile_bayes.records import dataclass

if TYPE_CHECKING:
    from tactile_bayes.files.provenance import Provenance
    from tactile_bayes.mapping.tactile_map import TactileMap
    from tactile_bayes.posterior.estimate import Estimate, EstimateOptions
    from tactile_bayes.posterior.log_quadratic import LogQuadratic
    from tactile_bayes.posterior.pooling import ShapeDraws, SizePriors
    from tactile_bayes.posterior.size_calibration import SizeCalibration


@dataclass(frozen=True, slots=True)
class Settings:
    """The options of one call, as given; picklable, so that a worker can have them.

    `calibration` is as named on the command line, None where nothing was said: then the shipped one, if it fits.
    """

    calibration: str | None
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
    between_map_sd: float | None = None
    known: tuple[tuple[str, float], ...] = ()
    scene: str = "auto"
    accuracy_mm: float | None = None
    prior: Path | None = None
    checkpoint: Path | None = None
    field_cosines: int | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """What one map came to: its JSON object and its text, or an error with its exit code.

    `shape` holds what pooling needs of a map on which a lump was found, `normalise` how the map's frames were.
    """

    document: dict[str, Any] | None
    text: str
    exit_code: int
    shape: ShapeDraws | None = None
    normalise: str = ""


def answer_map(path: Path, *, settings: Settings) -> Answer:
    """One map of several, in whichever process; a fault of this map is its answer."""
    try:
        tactile_map, estimate, provenance = run_map(path, settings, progress=None)
    except TactileBayesError as error:
        text = str(error) if str(path) in str(error) else f"{path}: {error}"
        return Answer(None, f"error: {text}", error.exit_code)
    return answer_of(tactile_map, estimate, provenance, settings)


def run_map(path: Path, settings: Settings, *, progress: Any) -> tuple[TactileMap, Estimate, Provenance]:
    """Read a map and estimate."""
    import numpy as np

    from tactile_bayes.files.map_nc import read_map
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.shipped import default_for
    from tactile_bayes.posterior.estimate import calibration_for, estimate_map

    tactile_map = read_map(path)
    shipped = default_for(tactile_map.recipe.normalise)
    source, calibration, why_none = choose_calibration(settings, tactile_map)
    options = _options(settings, calibration)
    if calibration is not None:
        calibration = calibration_for(tactile_map, calibration)
    inputs = {"map": path} | ({"size_calibration": source} if source else {})
    inputs |= {"prior": settings.prior} if settings.prior else {}
    digests = hash_inputs(**inputs)
    if settings.checkpoint is not None:
        from tactile_bayes.files.checkpoint_npz import CheckpointFile

        context = digests.get("size_calibration", "no calibration")
        options = replace(options, store=CheckpointFile(settings.checkpoint, context=context))
    # the map's own digest is part of the seed: a map's answer does not depend on its place in a list
    rng = np.random.default_rng([settings.seed, int(digests["map"][:16], 16)])
    try:
        estimate = estimate_map(tactile_map, calibration=calibration, options=options, rng=rng, progress=progress)
    except BadDataError as error:
        raise error.at(path) from None
    if why_none and estimate.status == "estimate":
        estimate = replace(estimate, reason=why_none)
    if calibration is not None and estimate.size is not None:
        words = _calibration_words(settings.calibration or shipped, calibration)
        estimate = replace(estimate, diagnostics={**estimate.diagnostics, "size_calibration": words})
    recorded = {
        "size_calibration": settings.calibration or (f"{shipped} (shipped)" if calibration is not None else "none"),
        "method": settings.method,
        "interval": settings.interval,
        "background": options.fit.background,
        "fit_radius_mm": options.fit.radius_mm,
        "rotation": settings.rotation,
        "centre_mm": list(settings.centre_mm) if settings.centre_mm else None,
        "noise": options.fit.noise,
        "field_cosines": options.fit.field_cosines or "auto",
        "accuracy_sd": settings.accuracy_sd,
        "accuracy_mm": settings.accuracy_mm,
        "scene": settings.scene,
        "between_map_sd": settings.between_map_sd,
        "known": dict(settings.known),
    }
    return tactile_map, estimate, Provenance("estimate", recorded, digests, seed=settings.seed)


def _calibration_words(name: str, calibration: SizeCalibration | LogQuadratic) -> str:
    """Which calibration gave the size, and what it cannot know."""
    from tactile_bayes.files.shipped import SHIPPED
    from tactile_bayes.posterior.log_quadratic import LogQuadratic
    from tactile_bayes.report.quadratic_text import fat_text, unknowns_text

    words = f"Sizes by the {'shipped calibration ' if name in SHIPPED else 'calibration '}{name}"
    if isinstance(calibration, LogQuadratic):
        words += f" ({calibration.source}); {fat_text(calibration.fat_mm)}{unknowns_text(calibration.unknowns)}"
    return words


def choose_calibration(
    settings: Settings, tactile_map: TactileMap
) -> tuple[Path | None, SizeCalibration | LogQuadratic | None, str]:
    """The calibration that was named, or the shipped one where nothing was said and it fits the map and the options.

    Returns
    -------
    path, calibration
        None where there is none.
    reason
        Why the shipped one was not used; empty when it was, or when the user decided.
    """
    from tactile_bayes.files.shipped import default_for, size_calibration_path
    from tactile_bayes.files.size_json import read_size_calibration
    from tactile_bayes.posterior.estimate import recipe_differences

    path = size_calibration_path(settings.calibration or default_for(tactile_map.recipe.normalise))
    if path is None:
        return None, None, ""
    calibration = read_size_calibration(path)
    if settings.calibration is not None:
        return path, calibration, ""
    fit = _options(settings, calibration).fit
    differs = recipe_differences(tactile_map, calibration, fit)
    if differs or settings.method == "optimise":
        what = "; ".join(differs) or "method optimise knows no noise field"
        return None, None, f"the shipped calibration does not fit: {what}; widths only"
    return path, calibration, ""


def _options(settings: Settings, calibration: SizeCalibration | LogQuadratic | None) -> EstimateOptions:
    """What is not given is as the calibration's maps were fitted, else as the paper printed it."""
    from tactile_bayes.files.prior_toml import read_prior
    from tactile_bayes.posterior.estimate import EstimateOptions
    from tactile_bayes.posterior.fit import FitOptions

    noise = settings.noise or (calibration.recipe.noise if calibration else "independent")
    printed = "free" if noise == "field" else "fixed"
    background = settings.background or (calibration.recipe.background if calibration else printed)
    radius = settings.fit_radius_mm or (calibration.recipe.radius_mm if calibration else FIT_RADIUS_MM)
    fit = FitOptions(background, radius, settings.rotation, settings.centre_mm, noise, None, settings.field_cosines)
    return EstimateOptions(
        method=settings.method,
        fit=fit,
        max_steps=settings.max_steps,
        accuracy_sd=settings.accuracy_sd,
        size_priors=size_priors(settings),
        prior=read_prior(settings.prior),
        scene=settings.scene,
        accuracy_mm=settings.accuracy_mm,
    )


def size_priors(settings: Settings) -> SizePriors:
    """The spread between maps, known or to be learned."""
    from tactile_bayes.posterior.pooling import BetweenMaps, SizePriors

    for name, value in settings.known:
        if value < 0 or (value == 0 and name != "seat"):
            raise UsageError(
                f"--known {name} is {value:g}; it must {'not be below' if name == 'seat' else 'be above'} 0"
            )
    fixed = settings.between_map_sd
    between = BetweenMaps() if fixed is None else BetweenMaps(fixed, 0.0)
    return SizePriors(between_maps=between, known=dict(settings.known))


def answer_of(tactile_map: TactileMap, estimate: Estimate, provenance: Provenance, settings: Settings) -> Answer:
    """The report of one map."""
    from tactile_bayes.files.prior_toml import read_prior
    from tactile_bayes.report.estimate_document import estimate_document, estimate_quantities
    from tactile_bayes.report.estimate_text import estimate_text

    prior = read_prior(settings.prior)
    quantities = estimate_quantities(estimate, tactile_map, probability=settings.interval)
    document = estimate_document(
        estimate,
        tactile_map,
        probability=settings.interval,
        prior=prior,
        provenance=provenance,
        quantities=quantities,
    )
    text = estimate_text(estimate, tactile_map, probability=settings.interval, prior=prior, quantities=quantities)
    exit_code = EXIT_DONE if estimate.status == "estimate" else EXIT_NO_ESTIMATE
    return Answer(document, text, exit_code, _shape(tactile_map, estimate), tactile_map.recipe.normalise)


def _shape(tactile_map: TactileMap, estimate: Estimate) -> ShapeDraws | None:
    """What pooling needs of a map, with the direction of its axes in the patient where landmarks tell."""
    import math

    from tactile_bayes.posterior.fat_depth import head_profile
    from tactile_bayes.posterior.pooling import ShapeDraws

    posterior, turn = estimate.map_posterior, tactile_map.patient_from_plane
    if posterior is None:
        return None
    angle = 0.0 if turn is None else math.atan2(float(turn[1, 0]), float(turn[0, 0]))
    return ShapeDraws.of(
        posterior.amplitude,
        posterior.sigma_x_mm,
        posterior.sigma_y_mm,
        posterior.angle_rad,
        turn_rad=angle,
        profile=head_profile(tactile_map.quality),
    )
