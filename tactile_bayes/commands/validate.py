"""`validate`: accuracy of each modality against excision."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.errors import UsageError

if TYPE_CHECKING:
    from tactile_bayes.trial.summary import TrialReport

SCHEMA = "tactile-bayes/validate/1"
_FILE = click.Path(path_type=Path)


@click.command("validate")
@click.argument("trial", metavar="TRIAL.csv", type=_FILE)
@click.option("--excision", required=True, metavar="EX.csv", type=_FILE, help="Sizes measured after excision.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("-o", "--output", metavar="REPORT.json", type=_FILE, help="Write the report as JSON to this file.")
@click.option("--force", is_flag=True, help="Overwrite an existing output.")
def command(trial: Path, excision: Path, as_json: bool, output: Path | None, force: bool) -> None:
    """Compare sizes with excision: errors, slope, r2, spread and coverage of each modality.

    TRIAL.csv has the columns patient, mass, modality, replicate, size_mm, status (detected, not_detected or not_done)
    and optionally sd_mm, low_mm, high_mm, probability, reader, synthetic. EX.csv has patient, mass, ex_vivo_mm and
    optionally ex_vivo_second_mm, sd_mm, synthetic. Sizes are in mm.

    Example: tactile-bayes validate trial.csv --excision excision.csv -o report.json
    """
    from tactile_bayes.files.atomic import refuse_existing, write_text
    from tactile_bayes.files.schema import check_document, dump_json
    from tactile_bayes.report.trial_text import trial_text

    if output:
        _refuse_inputs(output, trial, excision)
        refuse_existing(output, force=force)
    report, document = _compare(trial, excision)
    if output or as_json:
        check_document(document, "validate.schema.json", path=output or Path("the report"))
    if output:
        write_text(output, dump_json(document), force=force)
    click.echo(dump_json(document) if as_json else trial_text(report), nl=False)


def _compare(trial: Path, excision: Path) -> tuple[TrialReport, dict[str, Any]]:
    """The report and its JSON document."""
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.tables import check_references, read_table
    from tactile_bayes.presets import INTERVAL, RESEARCH_USE
    from tactile_bayes.trial.document import as_document
    from tactile_bayes.trial.readings import readings_from_columns
    from tactile_bayes.trial.summary import summarise

    sizes = read_table(excision, "excision.table.json")
    table = read_table(trial, "trial.table.json")
    check_references(table, "trial.table.json", targets={"excision": sizes})
    keys = zip(sizes.columns["patient"], sizes.columns["mass"], strict=True)
    report = summarise(
        readings_from_columns(table.columns, fault=table.error),
        dict(zip(keys, sizes.columns["ex_vivo_mm"], strict=True)),
        confidence=INTERVAL,
    )
    provenance = Provenance(
        command="validate",
        settings={"interval_probability": INTERVAL},
        inputs=hash_inputs(trial=trial, excision=excision),
    )
    document = {"schema": SCHEMA, **as_document(report), "provenance": provenance.as_dict()}
    return report, {**document, "research_use": RESEARCH_USE}


def _refuse_inputs(output: Path, *inputs: Path) -> None:
    """An output over an input would destroy what it was made from, --force or not."""
    for one in inputs:
        if output.exists() and one.exists() and output.samefile(one):
            raise UsageError(f"{output} is an input of this command; choose another name for the output")
