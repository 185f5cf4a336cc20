"""`estimate --pool`: one size from several maps of one mass."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tactile_bayes.declarations import replace
from tactile_bayes.errors import EXIT_DONE, EXIT_NO_ESTIMATE

if TYPE_CHECKING:
    from tactile_bayes.api.estimating import Answer
    from tactile_bayes.api.pooled import PooledOutcome
    from tactile_bayes.api.settings import Settings


def estimate_pool(
    maps: tuple[Path, ...],
    answers: list[Answer],
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    *,
    as_json: bool,
    verbose: bool,
    force: bool,
) -> int:
    """Pool the maps, print and write the result; return the exit code.

    A map that could not be read stops it: its error is printed, for a mass is not sized from what is left by accident.
    """
    from tactile_bayes.api.estimating import answer_file
    from tactile_bayes.api.pooled import of_one_mass, pool_answers
    from tactile_bayes.files.documents import check_document, dump_json
    from tactile_bayes.report.pooled import pooled_summary, pooled_text

    if settings.centre_mm is None:
        answers = of_one_mass(
            answers, lambda i, place: answer_file(maps[i], settings=replace(settings, centre_mm=place))
        )
    failed = [answer for answer in answers if answer.document is None]
    for answer in failed:
        click.echo(answer.text, err=True)
    if failed:
        return failed[0].exit_code
    inputs = {f"map_{i + 1}": one for i, one in enumerate(maps)}
    found = pool_answers(answers, settings, names=[str(one) for one in maps], inputs=inputs)
    check_document(found.document, "pooled.schema.json", path=Path("the report"))
    text_of = dump_json if as_json else pooled_text if verbose else pooled_summary
    try:
        if found.pooled.size is not None:
            _write(found, maps, settings, output, figure, force=force)
    finally:  # what was computed is not lost with a file
        click.echo(text_of(found.document), nl=False)
    return EXIT_DONE if found.pooled.size is not None else EXIT_NO_ESTIMATE


def _write(
    found: PooledOutcome,
    maps: tuple[Path, ...],
    settings: Settings,
    output: Path | None,
    figure: Path | None,
    *,
    force: bool,
) -> None:
    size, provenance = found.pooled.size, found.provenance
    assert size is not None
    if output is not None:
        from tactile_bayes.files.posterior_nc import write_pooled

        write_pooled(output, size, provenance=provenance, document=found.document, force=force)
    if figure is not None:
        from tactile_bayes.findings import findings_in
        from tactile_bayes.report.estimate_figures import draw_size
        from tactile_bayes.report.figure_file import named_exam

        name = named_exam(f"{len(maps)} maps pooled", provenance.scans)
        findings = findings_in(found.document["findings"])
        draw_size(size, figure, name=name, probability=settings.interval, findings=findings, force=force)
