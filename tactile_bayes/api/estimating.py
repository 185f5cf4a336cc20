"""Estimate one map with the calibration and options that fit it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tactile_bayes.api.settings import Settings
from tactile_bayes.api.sized import Answer, Failure, SizeEstimate, size_priors
from tactile_bayes.declarations import as_dict, names_of, replace
from tactile_bayes.errors import NO_LUMP, BadDataError, TactileBayesError, UsageError, in_file
from tactile_bayes.files.map_nc import read_map_and_scans
from tactile_bayes.files.npz import CheckpointFile
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.size_json import SHIPPED, default_for, read_size_calibration, size_calibration_path
from tactile_bayes.findings import by_severity, finding
from tactile_bayes.mapping.map import TactileMap, many_cells, side_findings
from tactile_bayes.options import PRIORS, FitSettings
from tactile_bayes.posterior.draw import SamplerSettings
from tactile_bayes.posterior.estimate import OTHER_HEAD, calibration_for, estimate_map, recipe_differences
from tactile_bayes.posterior.masses import with_masses
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.posterior.verdict import shows_no_lump, smallest_lumps
from tactile_bayes.posterior.white import default_errors
from tactile_bayes.presets import FIT_RADIUS_MM
from tactile_bayes.progress import Progress
from tactile_bayes.report import estimate_document
from tactile_bayes.report.calibration import calibration_line, site_words
from tactile_bayes.scans import DEFAULT_HEAD
from tactile_bayes.size.bodies import BodyCalibration, mean_width_mm
from tactile_bayes.size.pooling import Calibration

Notice = Callable[[str], None]
WhyNone = tuple[str, str]  #: Reason for widths without a size where no calibration was named, and a remedy.

_LEAST_SQUARES: WhyNone = (
    "optimise is the paper's least squares, and the shipped calibrations were learned with correlated errors "
    "and a free level, which make other widths; widths only",
    "--method laplace --size-calibration eq6 gives a size by Eq 6 as quickly; for least squares throughout, learn Eq 6 "
    "from phantoms fitted by --method optimise (`calibrate size`) and give that file",
)


def answer_file(path: Path, *, settings: Settings) -> Answer | Failure:
    """Estimate a map file in any process; return its answer, or the error as a `Failure`."""
    try:
        return estimate_file(path, settings).answer
    except TactileBayesError as error:
        text = str(error) if str(path) in str(error) else f"{path}: {error}"
        return Failure(f"error: {text}", error.exit_code)


def estimate_file(
    path: Path, settings: Settings, *, progress: Progress | None = None, notice: Notice | None = None
) -> SizeEstimate:
    """Read a map and estimate it; see `estimate_one`."""
    tactile_map, scans = read_map_and_scans(path)
    with in_file(path):
        result = estimate_one(
            tactile_map, settings, inputs={"map": path}, scans=scans, progress=progress, notice=notice
        )
    return replace(result, name=path.stem)


def input_digests(
    files: Mapping[str, Path | None], settings: Settings, calibration: Calibration | None
) -> dict[str, str]:
    """Digests of an estimate's inputs by role, with that of the site's repeatability where there is one.

    A repeatability of sizes by another calibration is refused: another slope gives another spread.
    """
    digests = hash_inputs(**{role: path for role, path in files.items() if path is not None})
    repeatability = settings.repeatability
    if repeatability is None:
        return digests
    if repeatability.sha256:
        digests["repeatability"] = repeatability.sha256
    if calibration is None or digests.get("size_calibration") == repeatability.calibration_sha256:
        return digests
    normalise = calibration.recipe.normalise
    sized_by = f"{repeatability.calibration} (frames normalised by {repeatability.normalise})"
    sizing = f"{settings.calibration_name or default_for(normalise)} (frames normalised by {normalise})"
    version = "another version of " if sizing == sized_by else ""
    raise BadDataError(
        f"the repeatability is of sizes by {sized_by}, and this size is by {version}{sizing}",
        way_out="learn one from exams that were sized so: `calibrate repeatability`; or leave --repeatability out",
    )


def estimate_one(
    tactile_map: TactileMap,
    settings: Settings,
    *,
    inputs: Mapping[str, Path | None] | None = None,
    scans: Sequence[Mapping[str, str]] = (),
    progress: Progress | None = None,
    notice: Notice | None = None,
) -> SizeEstimate:
    """Choose the calibration and the options that fit a map, and estimate.

    `inputs`: files that the map came from, by role, for the provenance; `scans`: the scans at the beginning, as
    `Provenance.scans` has them; `progress`: called with draws done and required; `notice`: called before the work with
    a line that a user may want to read while waiting.
    """
    shipped = default_for(tactile_map.recipe.normalise)
    source, calibration, why_none = choose_calibration(settings, tactile_map)
    options = _options(settings, calibration, tactile_map)
    if notice is not None and (line := many_cells(tactile_map, options.fit_radius_mm)) is not None:
        notice(line)
    files = {**(inputs or {}), "size_calibration": source, "settings": settings.settings_file}
    digests = input_digests(files, settings, calibration)
    if calibration is not None:
        calibration = calibration_for(tactile_map, calibration)
    if settings.checkpoint is not None:
        context = digests.get("size_calibration", "no calibration")
        options = replace(options, store=CheckpointFile(settings.checkpoint, context=context))

    # the map's values are part of the seed: a result depends neither on the place in a list nor on the file's history,
    # and each mass gets the random numbers that it would get alone
    def sample(a_map: TactileMap, sampler: SamplerSettings) -> Estimate:
        rng = np.random.default_rng([settings.seed, tactile_map.fingerprint])
        callback = progress if sampler is options else None
        return estimate_map(a_map, calibration=calibration, options=sampler, rng=rng, progress=callback)

    estimate = with_masses(tactile_map, sample(tactile_map, options), options, sample)
    estimate = _with_place(estimate, tactile_map, scans, probability=settings.interval)
    if why_none is not None and estimate.status == "estimate":
        reason, advice = why_none
        on_paper = "a size needs a calibration that fits this map"
        estimate = replace(estimate, reason=reason, advice=advice, on_paper=on_paper)
    if estimate.code in NO_LUMP and tactile_map.covered.any():
        fat_mm = None if calibration is None else calibration.fat_mm
        estimate = _with_smallest(estimate, tactile_map, fat_mm)
    posterior = estimate.map_posterior
    applied = None if posterior is None or calibration is None else calibration.at_depth_or_fallback(*posterior.medians)
    if posterior is not None and applied is not None and estimate.size is not None:
        name = settings.calibration_name or shipped
        by = f"{'shipped ' if name in SHIPPED else ''}calibration {name}"
        sigma_mm = mean_width_mm(*posterior.medians[1:])
        if isinstance(applied, BodyCalibration) and applied.site is not None:
            by += f" ({site_words(applied.site, math.log(sigma_mm))})"
        diagnostics = {**estimate.diagnostics, "size_calibration": calibration_line(by, applied, sigma_mm=sigma_mm)}
        if settings.repeatability is not None:
            diagnostics["repeatability"] = settings.repeatability.words()
        if "convergence" in diagnostics:  # the longest comes last
            diagnostics["convergence"] = diagnostics.pop("convergence")
        estimate = replace(estimate, diagnostics=diagnostics, sized_by=by)
    named = settings.calibration_name or (f"{shipped} (shipped)" if calibration is not None else "none")
    fit = {"background": options.background, "fit_radius_mm": options.fit_radius_mm, "noise": options.noise}
    recorded = settings.recorded(size_calibration=named, **fit)
    for name in (*PRIORS, "max_steps", "checkpoint"):  # priors stand in the report, the others say how long it takes
        del recorded[name]
    provenance = Provenance("estimate", recorded, digests, seed=settings.seed, scans=scans)
    return SizeEstimate(
        tactile_map=tactile_map, estimate=estimate, provenance=provenance, settings=settings, calibration=applied
    )


def _with_place(
    estimate: Estimate, tactile_map: TactileMap, scans: Sequence[Mapping[str, str]], *, probability: float
) -> Estimate:
    """Add the findings on the places of the masses: side, landmarks, and masses that may be one."""
    places = [estimate_document.patient_mm(tactile_map, one.x_mm, one.y_mm) for one in estimate.masses if one.reported]
    side = side_findings(estimate_document.side_of(scans), places[0] if places else None)
    others = [one for one in estimate.findings if not side or one.kind != "side"]  # the map's is of the scanned place
    sized = [
        (
            number,
            (one.x_mm, one.y_mm),
            [q.summarise("max_size_mm", probability=probability) for q in (size, size.leading)],
        )
        for number, one in enumerate(estimate.masses, start=1)
        if (size := one.estimate.size) is not None
    ]
    return replace(estimate, findings=by_severity((*side, *others, *estimate_document.touching_findings(sized))))


def named_calibration(settings: Settings, normalise: str) -> tuple[Path | None, Calibration | None]:
    """Path and calibration that the settings name or hold, else the shipped one for this normalisation."""
    choice = settings.size_calibration
    if choice is not None and not isinstance(choice, str):
        return None, choice
    path = size_calibration_path(default_for(normalise) if choice is None else choice)
    return path, None if path is None else read_size_calibration(path)


def choose_calibration(
    settings: Settings, tactile_map: TactileMap
) -> tuple[Path | None, Calibration | None, WhyNone | None]:
    """Path and calibration that the settings name, else the shipped one if it fits map and options.

    Without one, also the reason why the shipped one does not fit, unless the user asked for none.
    """
    path, calibration = named_calibration(settings, tactile_map.recipe.normalise)
    if calibration is None:
        return None, None, None
    if tactile_map.background is None and calibration.recipe.normalise != tactile_map.recipe.normalise:
        reason, advice = _level_unknown(tactile_map, _options(settings, None, tactile_map))
        if settings.size_calibration is None:
            return None, None, (f"{reason}; widths only", advice)
        raise BadDataError(f"{settings.calibration_name} does not fit: {reason}", way_out=advice)
    if settings.size_calibration is not None:
        return path, calibration, None
    fit = _options(settings, calibration, tactile_map)
    differs = recipe_differences(tactile_map, calibration, fit)
    if settings.method == "optimise":
        return None, None, _LEAST_SQUARES
    if differs:
        advice = OTHER_HEAD if calibration.recipe.head_differences(tactile_map.head) else ""
        return None, None, (f"the shipped calibration does not fit: {'; '.join(differs)}; widths only", advice)
    return path, calibration, None


def _with_smallest(estimate: Estimate, tactile_map: TactileMap, fat_mm: float | None) -> Estimate:
    """The answer "no lump" with the smallest one that the map would have shown, or that its errors hide any."""
    smallest, head = smallest_lumps(tactile_map, fat_mm=fat_mm), tactile_map.head
    if (hidden := shows_no_lump(smallest)) is not None:
        return replace(estimate, **as_dict(hidden), weighed=None)
    findings = estimate.findings
    if head is not None and DEFAULT_HEAD.differences(head):
        learned = f"from which diameters on a lump is seen was learned with another head ({DEFAULT_HEAD})"
        other = finding("unusual_scan", f"{learned}; this one ({head}) may miss larger lumps")
        findings = by_severity((other, *findings))
    return replace(estimate, smallest=smallest, findings=findings)


def _level_unknown(tactile_map: TactileMap, fit: SamplerSettings) -> WhyNone:
    """Reason for widths only where the map's level is unknown, and the commands that lead to a size."""
    recipe = f"--normalise {tactile_map.recipe.normalise} --background {fit.background} --noise {fit.noise}"
    learn = (
        "estimate maps of at least 8 lumps of known size made the same way, list their d_mm, amplitude, sigma_x_mm and "
        f"sigma_y_mm in LUMPS.csv, run `tactile-bayes calibrate size LUMPS.csv {recipe} --fit-radius-mm "
        f"{fit.fit_radius_mm:g} -o size.json` and give --size-calibration size.json"
    )
    if tactile_map.recipe.source == "scan":
        reason = "the map is in kPa, and the shipped calibrations are for maps of normalised frames"
        return reason, f"map the scan again without --normalise none; or {learn}"
    reason = "the grid's level is not known, and the shipped calibrations need the amplitude relative to it"
    declare = "if its values were divided by their level already, import it again with --normalise gain"
    return reason, f"{declare} (frames divided by their means: mean); otherwise {learn}"


def _options(settings: Settings, calibration: Calibration | None, tactile_map: TactileMap) -> SamplerSettings:
    """Options of an estimate: unset ones from the calibration's recipe, else from the paper.

    Without a calibration `default_errors` decides; a background that is given alone goes with independent errors.
    """
    background, noise = default_errors(tactile_map)
    if settings.background or settings.method == "optimise":
        noise = "independent"
    if calibration is not None:
        background, noise = calibration.recipe.background, calibration.recipe.noise
    noise = settings.noise or noise
    if calibration is None and noise == "field":
        background = "free"
    if noise == "independent" and settings.field_cosines != "auto":
        raise UsageError('field_cosines are of a noise field; leave them out, or give noise = "field"')
    background = settings.background or background
    radius = settings.fit_radius_mm or (calibration.recipe.radius_mm if calibration else FIT_RADIUS_MM)
    values = {name: getattr(settings, name) for name in names_of(FitSettings)}
    values |= {"background": background, "fit_radius_mm": radius, "noise": noise}
    return SamplerSettings(**values, size_priors=size_priors(settings))


def estimate_inputs(settings: Settings, tactile_map: TactileMap) -> tuple[Calibration | None, SamplerSettings]:
    """Calibration and options by which `estimate_one` fits a map."""
    _, calibration, _ = choose_calibration(settings, tactile_map)
    return calibration, _options(settings, calibration, tactile_map)
