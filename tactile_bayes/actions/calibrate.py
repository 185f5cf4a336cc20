"""`calibrate`: a size calibration, a scan head's gains, a site's repeatability."""

from __future__ import annotations

from datetime import date, datetime
from pathlib import Path
from typing import Any

import click

from tactile_bayes.api.repeatability import exams_of_campaign, learn_from_exams
from tactile_bayes.api.size_calibration import learn
from tactile_bayes.commands.options import protect_inputs, typed_options
from tactile_bayes.declarations import as_dict
from tactile_bayes.errors import BadDataError, UsageError, in_file
from tactile_bayes.files.instrument import ArrayCalibrationFile, write_array_calibration
from tactile_bayes.files.provenance import Provenance, hash_inputs
from tactile_bayes.files.scan_mcap import read_scan
from tactile_bayes.files.size_json import size_calibration_path
from tactile_bayes.hardware.head import ArrayFit, BladderStep, fit_array
from tactile_bayes.options import LearnOptions
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.calibration import (
    body_calibration_text,
    calibration_text,
    repeatability_text,
    site_calibration_text,
)
from tactile_bayes.report.study import eq6_figure
from tactile_bayes.scans import Scan
from tactile_bayes.shell import progress_bar
from tactile_bayes.size.bodies import BodyCalibration


def calibrate_array_action(
    steps: tuple[tuple[float, Path], ...], output: Path, head_id: str | None, day: datetime | None, force: bool
) -> None:
    """Learn the gain and offset of each taxel from a pressure bladder, and how uneven they stay."""
    measured = day.date() if day else date.today()
    if len({path for _, path in steps}) < len(steps):
        raise UsageError("two steps are of one recording; give each pressure its own")
    scans = [read_scan(path) for _, path in steps]
    head = head_id or _one_head(scans)
    saturation = scans[0].element_calibration.saturation_count
    levels = []
    for (kpa, path), scan in zip(steps, scans, strict=True):
        with in_file(path):
            levels.append(BladderStep.from_frames(kpa, scan.frames.counts, saturation_count=saturation))
    fit = fit_array(levels, saturation_count=saturation)
    inputs = hash_inputs(**{f"step_{number}": path for number, (_, path) in enumerate(steps, start=1)})
    provenance = Provenance("calibrate array", {"pressure_kpa": [kpa for kpa, _ in steps]}, inputs)
    content = ArrayCalibrationFile(
        head_id=head, day=measured, quality=_quality(fit), provenance=provenance.as_dict(), **as_dict(fit.calibration)
    )
    write_array_calibration(output, content, force=force)
    click.echo(_fit_text(fit, head, output), nl=False)


def _one_head(scans: list[Scan]) -> str:
    heads = {scan.session.get("head_id", "") for scan in scans}
    shapes = {scan.head.shape for scan in scans}
    if len(heads) > 1 or len(shapes) > 1:
        raise BadDataError("the steps are of two heads or more", way_out="give steps of one head, or --head-id")
    (head,) = heads
    if not head:
        raise BadDataError("the steps do not say which head they are of", way_out="give --head-id")
    return head


def _quality(fit: ArrayFit) -> dict[str, Any]:
    def shares(values: Any) -> list[float | None]:
        return [None if value != value else float(value) for value in values]

    return {
        "pressure_kpa": fit.pressure_kpa.tolist(),
        "nonuniformity": shares(fit.nonuniformity),
        "nonuniformity_with_curvature": shares(fit.curved_nonuniformity),
        "curvature_kpa_per_count2": fit.curvature_kpa_per_count2.tolist(),
        "dead": [list(taxel) for taxel in fit.dead],
        "hot": [list(taxel) for taxel in fit.hot],
    }


def _fit_text(fit: ArrayFit, head: str, output: Path) -> str:
    gain = fit.calibration.gain_kpa_per_count
    lines = [f"{output}: {gain.size} taxels of head {head}, {len(fit.pressure_kpa)} steps"]
    for name, taxels in (("dead", fit.dead), ("hot", fit.hot)):
        positions = ", ".join(f"row {row} column {column}" for row, column in taxels)
        lines.append(f"{name} taxels: {positions or 'none'}")
    for kpa, line, curve in zip(fit.pressure_kpa, fit.nonuniformity, fit.curved_nonuniformity, strict=True):
        if line == line:
            lines.append(f"{kpa:g} kPa: residual non-uniformity {100 * line:.2f} %, with curvature {100 * curve:.2f} %")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def calibrate_size_action(
    table: Path,
    output: Path,
    correct: str | None,
    against: Path | None,
    figure: Path | None,
    force: bool,
    **options: Any,
) -> None:
    """Learn Eq 6, d = m sigma / (e a^f) + b, from a study or a set of phantoms, or over a population of bodies."""
    typed = typed_options()
    with progress_bar("maps" if correct is not None else "effective draws") as progress:
        learned = learn(table, LearnOptions(**options), typed, correct=correct, against=against, progress=progress)
    if correct is not None:
        protect_inputs(*learned.inputs.values())
    calibration = learned.calibration
    if isinstance(calibration, BodyCalibration):
        text_of = body_calibration_text if calibration.site is None else site_calibration_text
        text = text_of(calibration)
    else:
        text = calibration_text(
            calibration,
            not_left_out=learned.not_left_out,
            other_fit=learned.other_fit,
            table_rows=learned.table_rows,
        )
    click.echo(text, nl=False)  # first: a file that cannot be written loses no result
    learned.write(output, force=force)
    if figure is not None and not isinstance(calibration, BodyCalibration) and learned.lumps is not None:
        eq6_figure(calibration, learned.lumps, figure, title=table.name, force=force)


def calibrate_repeatability_action(folder: Path, output: Path, size_calibration: str | None, force: bool) -> None:
    """Learn how far sizes of one mass lie apart between its exams at this site."""
    if size_calibration is not None:
        protect_inputs(size_calibration_path(size_calibration))
    learned = learn_from_exams(exams_of_campaign(folder), size_calibration=size_calibration)
    learned.write(output, force=force)
    click.echo(repeatability_text(learned), nl=False)
