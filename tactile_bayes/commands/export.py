"""`export`: write maps and estimates as the files that other systems take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click

from tactile_bayes.commands.options import FORCE, FilePath
from tactile_bayes.presets import RESEARCH_USE

_FORMATS: Final = ("dicom", "fhir", "nrrd", "csv")
# Name of the part of an identity, metavar, help.
_IDENTITY: Final = (
    ("patient_id", "ID", "Patient ID; in csv files the beginning of the record ID."),
    ("patient_name", "FAMILY^GIVEN", "Patient's name."),
    ("birth_date", "YYYY-MM-DD", "Patient's date of birth."),
    ("sex", "F|M|O", "Patient's sex."),
    ("issuer", "NAME", "Who issued the patient ID."),
    ("accession", "NUMBER", "Accession number."),
    ("referring_physician", "FAMILY^GIVEN", "Referring physician's name."),
    ("study_id", "ID", "Study ID."),
    ("study_description", "TEXT", "Study description."),
    ("study_uid", "UID", "Study Instance UID. Default: one that follows from the maps."),
    ("study_date", "DATE", "Date of the exam: YYYY-MM-DD or YYYY-MM-DDTHH:MM, with +HH:MM for the zone."),
    ("content_date", "DATE", "Date at which the content was made. Default: the exam's."),
)


def _identity_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """One option for each part of an identity."""
    for name, metavar, text in reversed(_IDENTITY):
        command = click.option(f"--{name.replace('_', '-')}", metavar=metavar, help=text)(command)
    return command


@click.command("export")
@click.argument("files", metavar="FILE...", nargs=-1, type=FilePath())
@click.option("--to", required=True, type=click.Choice(_FORMATS), help="Format to write.")
@click.option(
    "-o", "--output", metavar="OUT", type=FilePath(), help="File to write; for dicom the folder of the files."
)
@click.option(
    "--worklist",
    metavar="ITEM",
    type=FilePath(),
    help="Patient and study from a modality worklist item (.dcm or DICOM JSON), or from JSON of plain keys.",
)
@click.option("--patient-id-from-scan", is_flag=True, help="Use the scan's subject code as the patient ID.")
@_identity_options
@click.option(
    "--dictionary", metavar="DICT.csv", type=FilePath(), help="With csv: write the data dictionary of the REDCap form."
)
@FORCE
def command(
    *,
    files: tuple[Path, ...],
    to: Any,
    output: Path | None,
    worklist: Path | None,
    patient_id_from_scan: bool,
    dictionary: Path | None,
    force: bool,
    **identity: str | None,
) -> None:
    """Export maps and estimates as DICOM, FHIR, NRRD (3D Slicer) or CSV (REDCap).

    dicom takes a map, or a map and its estimate: values, picture and report, into a folder. fhir takes an estimate
    (what `estimate --json` prints), nrrd a map, csv one or more estimates. Files are told apart by their content; an
    estimate of another map is refused. Who was examined comes from options or a worklist and is never invented.

    Example: tactile-bayes export map.nc estimate.json --to dicom --study-date 2026-11-24T10:30 -o exam
    """
    from tactile_bayes.exports.exam import read_exam
    from tactile_bayes.exports.identity import identity_of
    from tactile_bayes.exports.run import Outputs, export, refuse_untaken

    given = {name: value for name, value in identity.items() if value is not None}
    refuse_untaken(to, given)
    outputs = Outputs(output, dictionary, to=to, force=force)
    outputs.check(files=bool(files))
    exported = None
    if files:
        who = identity_of(worklist, given)
        exported = export(map(read_exam, files), to=to, identity=who, id_from_scan=patient_id_from_scan)
    for path in outputs.write(exported):
        is_dictionary = path == dictionary
        click.echo(f"{path}: {'data dictionary for REDCap' if is_dictionary else f'{path.stat().st_size} bytes'}")
    for note in () if exported is None else exported.notes:
        click.echo(f"note: {note}", err=True)
    click.echo(RESEARCH_USE)
