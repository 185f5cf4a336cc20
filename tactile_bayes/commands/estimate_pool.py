"""`estimate --pool`: one size from several maps of one mass."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE, BadDataError, UsageError

if TYPE_CHECKING:
    from tactile_bayes.commands.estimate_run import Answer, Settings
    from tactile_bayes.size.log_quadratic import LogQuadratic
    from tactile_bayes.size.pooling import PooledEstimate


def estimate_pool(
    maps: tuple[Path, ...],
    answers: list[Answer],
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    *,
    as_json: bool,
    force: bool,
) -> int:
    """Print, and write where asked, the size of the mass; return the exit code.

    A map that could not be read stops it: its error is printed, for a mass is not sized from what is left by accident.
    """
    from tactile_bayes.commands.estimate_run import size_priors
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.schema import check_document, dump_json
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.report.pooled import pooled_document, pooled_text
    from tactile_bayes.size.pooling import pool_maps

    failed = [answer for answer in answers if answer.document is None]
    for answer in failed:
        click.echo(answer.text, err=True)
    if failed:
        return failed[0].exit_code
    path = size_calibration_path(settings.calibration or _shipped_for(answers))
    calibration = _log_quadratic(path)
    assert path is not None
    digests = hash_inputs(**{f"map_{i + 1}": one for i, one in enumerate(maps)}, size_calibration=path)
    import numpy as np

    # the maps' values in sorted order are part of the seed: their order on the command line leaves no trace
    words = sorted(answer.fingerprint for answer in answers)
    pooled = _too_far(answers) or pool_maps(
        [answer.shape for answer in answers],
        calibration=calibration,
        priors=size_priors(settings),
        rng=np.random.default_rng([settings.seed, *words]),
    )
    provenance = Provenance("estimate --pool", _plain(settings), digests, seed=settings.seed)
    documents = [answer.document for answer in answers if answer.document is not None]
    document = pooled_document(
        pooled,
        [str(one) for one in maps],
        documents,
        calibration,
        probability=settings.interval,
        provenance=provenance,
    )
    check_document(document, "pooled.schema.json", path=Path("the report"))
    if pooled.size is not None:
        _write(pooled, maps, settings, output, figure, provenance=provenance, force=force)
    click.echo(dump_json(document) if as_json else pooled_text(document), nl=False)
    return EXIT_DONE if pooled.size is not None else EXIT_NO_ESTIMATE


def _too_far(answers: list[Answer]) -> PooledEstimate | None:
    """No size where a map shows a lump too far outside the calibration's range; None where none does."""
    from tactile_bayes.size.pooling import PooledEstimate

    for i, answer in enumerate(answers):
        if answer.document is not None and answer.document["reason_code"] == "extrapolated":
            return PooledEstimate("no_estimate", f"map {i + 1}: {answer.document['reason']}")
    return None


def _shipped_for(answers: list[Answer]) -> str:
    """The shipped calibration for maps that were all normalised one way."""
    from tactile_bayes.files.shipped import default_for

    ways = sorted({answer.normalise for answer in answers})
    if len(ways) > 1:
        raise BadDataError(
            f"the maps were normalised in several ways ({', '.join(ways)})",
            way_out="pool maps made by one recipe: make the others again with `map`",
        )
    return default_for(ways[0])


def _log_quadratic(path: Path | None) -> LogQuadratic:
    from tactile_bayes.files.size_json import read_size_calibration
    from tactile_bayes.size.log_quadratic import LogQuadratic

    if path is None:
        raise UsageError("--pool needs a size calibration; leave out --size-calibration none")
    calibration = read_size_calibration(path)
    if not isinstance(calibration, LogQuadratic):
        raise UsageError(f"--pool needs a calibration of the log-quadratic form; {path} is of Eq 6: use solid")
    return calibration


def _plain(settings: Settings) -> dict[str, Any]:
    """The settings as JSON holds them."""
    plain = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(settings).items() if name != "seed"}
    return plain | {"known": dict(settings.known)}


def _write(
    pooled: PooledEstimate,
    maps: tuple[Path, ...],
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    *,
    provenance: Any,
    force: bool,
) -> None:
    size = pooled.size
    assert size is not None
    if output is not None:
        from tactile_bayes.files.posterior_nc import write_pooled

        write_pooled(output, size, provenance=provenance, force=force)
    if figure is not None:
        from tactile_bayes.commands.estimate_figures import draw_size

        draws = {"max": size.max_size_mm.ravel(), "min": size.min_size_mm.ravel()}
        draw_size(draws, figure, name=f"{len(maps)} maps pooled", probability=settings.interval, force=force)
