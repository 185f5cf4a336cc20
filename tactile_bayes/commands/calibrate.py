"""`calibrate`: a size calibration, a scan head's gains, a site's repeatability."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, METAVAR, FigurePath, FilePath, FiniteRange, also_read, seed_option
from tactile_bayes.errors import BadDataError
from tactile_bayes.presets import FIT_RADIUS_MM, NOISE, NORMALISE, RESEARCH_USE

if TYPE_CHECKING:
    from datetime import date, datetime

    from tactile_bayes.api.size_calibration import EqSixFit, PopulationForm
    from tactile_bayes.hardware.bladder import ArrayFit
    from tactile_bayes.scan import Scan


# --- `calibrate array`: learn an array's calibration from recorded bladder steps, for `record` to attach.


def calibrate_array(
    steps: tuple[tuple[float, Path], ...], output: Path, *, head_id: str | None, day: date, force: bool
) -> str:
    """Fit the calibration, write it, and print the result."""
    from tactile_bayes.declarations import as_dict
    from tactile_bayes.files.instrument_json import ArrayCalibrationFile, write_array_calibration
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.hardware.bladder import BladderStep, fit_array

    scans = [read_scan(path) for _, path in steps]
    head = head_id or _one_head(scans)
    full = scans[0].element_calibration.saturation_count
    levels = []
    for (kpa, path), scan in zip(steps, scans, strict=True):
        try:
            levels.append(BladderStep.of(kpa, scan.frames.counts, saturation_count=full))
        except BadDataError as error:
            raise error.at(path) from None
    fit = fit_array(levels, saturation_count=full)
    inputs = hash_inputs(**{f"step_{number}": path for number, (_, path) in enumerate(steps, start=1)})
    made = Provenance("calibrate array", {"pressure_kpa": [kpa for kpa, _ in steps]}, inputs)
    content = ArrayCalibrationFile(
        head_id=head, day=day, quality=_quality(fit), provenance=made.as_dict(), **as_dict(fit.calibration)
    )
    write_array_calibration(output, content, force=force)
    return _text(fit, head, output)


def _one_head(scans: list[Scan]) -> str:
    found = {scan.session.get("head_id", "") for scan in scans}
    shapes = {scan.head.shape for scan in scans}
    if len(found) > 1 or len(shapes) > 1:
        raise BadDataError("the steps are of two heads or more", way_out="give steps of one head, or --head-id")
    (head,) = found
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


def _text(fit: ArrayFit, head: str, output: Path) -> str:
    gain = fit.calibration.gain_kpa_per_count
    lines = [f"{output}: {gain.size} taxels of head {head}, {len(fit.pressure_kpa)} steps"]
    for name, taxels in (("dead", fit.dead), ("hot", fit.hot)):
        places = ", ".join(f"row {row} column {column}" for row, column in taxels)
        lines.append(f"{name} taxels: {places or 'none'}")
    for kpa, line, curve in zip(fit.pressure_kpa, fit.nonuniformity, fit.curved_nonuniformity, strict=True):
        if line == line:
            lines.append(f"{kpa:g} kPa: residual non-uniformity {100 * line:.2f} %, with curvature {100 * curve:.2f} %")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


# --- `calibrate`: learn a calibration from known objects, and a site's repeatability from its own exams.

_FILE = FilePath()


@click.group("calibrate")
def command() -> None:
    """Learn a calibration from known objects."""


@command.command("size")
@click.argument("table", metavar="TABLE.csv", type=_FILE)
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="SIZE.json",
    type=FilePath(writes="JSON"),
    help="Where to write the calibration.",
)
@click.option(
    "--form",
    type=click.Choice(["eq6", "eq6-residual"]),
    default="eq6",
    show_default=True,
    help="eq6: as printed, from a table of lumps, or of bodies made by `population`; eq6-residual: with what Eq 6 "
    "leaves of the sizes, of bodies only.",
)
@click.option(
    "--correct",
    metavar="CALIBRATION",
    help="Correct this calibration (solid, solid-mean, eq6 or a file learned over bodies) by the table's lumps instead "
    "of learning one.",
)
@click.option(
    "--against",
    metavar="TABLE.csv",
    type=_FILE,
    help="Lumps of another origin, with the columns of `population`: how far their sizes are off goes into intervals.",
)
@click.option(
    "--fit",
    type=click.Choice(["joint", "two-stage"]),
    default="joint",
    show_default=True,
    help="eq6: joint posterior of m, b, e, f from all rows, or the paper's two stages (needs depth_ratio).",
)
@click.option(
    "--normalise",
    type=click.Choice(NORMALISE),
    help="Normalisation of the table's maps, if the table does not state it; of a table of `population` with rows by "
    "several, which to learn from. Default: mean.",
)
@click.option(
    "--background",
    type=click.Choice(["fixed", "free"]),
    help="Background in the table's fits, if the table does not state it. Default: fixed, or free with "
    "--normalise none.",
)
@click.option(
    "--fit-radius-mm",
    type=FiniteRange(min=0.0, min_open=True),
    help=f"Radius of the table's fit windows, mm, if the table does not state it. Default: {FIT_RADIUS_MM:g}.",
)
@click.option(
    "--noise",
    type=click.Choice(NOISE),
    help="Noise model of the table's fits, if the table does not state it; least squares is independent. "
    "Default: independent.",
)
@click.option(
    "--least-stiffness-ratio",
    type=FiniteRange(min=0.0),
    default=0.0,
    show_default=True,
    help="Leave out lumps softer than this: above 8 the paper's widths change by less than 5 %.",
)
@click.option(
    "--figure",
    metavar=METAVAR,
    type=FigurePath(),
    help="Draw Fig 8 of the paper from the table's lumps (eq6 only).",
)
@seed_option(1)
@FORCE
@click.pass_context
def size(
    ctx: click.Context,
    /,
    table: Path,
    output: Path,
    form: PopulationForm,
    correct: str | None,
    against: Path | None,
    fit: EqSixFit,
    normalise: str | None,
    background: str | None,
    fit_radius_mm: float | None,
    noise: str | None,
    least_stiffness_ratio: float,
    figure: Path | None,
    seed: int,
    force: bool,
) -> None:
    """Learn Eq 6, d = m sigma / (e a^f) + b, from a study or a set of phantoms, or over a population of bodies.

    TABLE.csv has a row for each lump: d_mm, amplitude, sigma_x_mm, and optionally sigma_y_mm, depth_ratio,
    stiffness_ratio and seat. With depth_ratio the rows at one diameter depth define Delta sigma as a ratio. How the
    table's maps were made and fitted stands in its columns normalise, background, fit_radius_mm, noise and flat_field,
    as in a table of `study`, or is declared by the options; an option that contradicts the table is refused, and
    `estimate` refuses a map made otherwise.

    --fit joint takes m, b, e and f from all rows at once, on the scale of ln d. --fit two-stage is the paper's: d on
    sigma in the rows at depth_ratio 1, then ln Delta sigma on ln a; its spread is a bootstrap over diameters. The
    report tells how far the other fit lies.

    With depth_ratio and stiffness_ratio the table is a study: each geometry
    (seat, d_mm, depth_ratio) is also left out of the learning in turn, and the report tells how far Eq 6 and a
    quadratic in logarithms then miss the hard lumps' sizes.

    From a table of `population`, which has a row for each exam of a body, every form tells apart what differs between
    bodies and between exams of one body. `population` made the maps: nothing is declared, and --normalise chooses among
    a table's rows. From the pressure over the head where it felt no lump it also learns how deep the fat is: the
    constants of Eq 6 depend on that, and for a map without that pressure sizes are averaged over the depths that go
    with it. eq6-residual adds what Eq 6 leaves, a Gaussian process in ln a, ln sigma and the depth; it is the form of
    the shipped `solid`. The spread between bodies is wide for deep, faint and soft lumps.

    --correct keeps a calibration and learns from 3 lumps or more, better 5 to 20, by how much sizes at this site
    differ from it: few lumps change it little, and the uncertainty of the correction goes into every size. TABLE.csv
    has the columns above, with depth_ratio, seat and stiffness_ratio where they are known, and phantom where a lump has
    several maps; or it lists map files: file, d_mm and the same. The maps must be made as the calibration's.

    Example: tactile-bayes calibrate size phantoms.csv -o size.json
    """
    from tactile_bayes.api.size_calibration import is_population, learn_eq6
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.size_json import write_size_calibration
    from tactile_bayes.files.tables import read_table
    from tactile_bayes.report.calibration_text import calibration_text

    for path in filter(None, (output, figure)):
        refuse_existing(path, force=force)
    declared = {"normalise": normalise, "background": background, "fit_radius_mm": fit_radius_mm, "noise": noise}
    if correct is not None:
        _refuse_with_correct(ctx)
        click.echo(_corrected(table, output, correct, declared, seed=seed, force=force), nl=False)
        return
    if form != "eq6" or is_population(table):
        _refuse_declared(ctx)
        click.echo(_over_bodies(table, output, form, normalise, against=against, force=force), nl=False)
        return
    if against is not None:
        raise UsageError("--against is for a table of `population`; leave it out")
    rows = read_table(table, "size_table.table.json")
    with progress_bar("effective draws") as progress:
        learned = learn_eq6(
            rows, declared, fit=fit, least_stiffness_ratio=least_stiffness_ratio, seed=seed, progress=progress
        )
    provenance = Provenance("calibrate size", learned.settings, hash_inputs(table=table), seed=seed)
    write_size_calibration(output, learned.calibration, provenance=provenance, force=force)
    if figure is not None:
        from tactile_bayes.report.study import eq6_figure

        eq6_figure(learned.calibration, learned.lumps, figure, title=table.name, force=force)
    words = calibration_text(
        learned.calibration,
        not_left_out=learned.not_left_out,
        other_fit=learned.other_fit,
    )
    click.echo(words, nl=False)


def _refuse_with_correct(ctx: click.Context) -> None:
    from tactile_bayes.errors import UsageError

    for name in ("form", "against", "fit", "least_stiffness_ratio", "figure"):
        if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            option = name.replace("_", "-")
            raise UsageError(f"--{option} is for learning a calibration; leave it out with --correct")


def _corrected(
    table: Path, output: Path, base: str, declared: dict[str, str | float | None], *, seed: int, force: bool
) -> str:
    from tactile_bayes.api.site_correction import correct_size
    from tactile_bayes.commands.progress import progress_bar
    from tactile_bayes.report.calibration import site_calibration_text

    with progress_bar("maps") as progress:
        found = correct_size(table, base, declared, seed=seed, progress=progress)
    also_read(*found.inputs.values())
    found.write(output, force=force)
    return site_calibration_text(found.calibration)


def _refuse_declared(ctx: click.Context) -> None:
    from tactile_bayes.errors import UsageError

    for name in ("fit", "background", "fit_radius_mm", "noise", "least_stiffness_ratio", "figure", "seed"):
        if ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            option = name.replace("_", "-")
            raise UsageError(f"--{option} is for tables of lumps: a table of `population` fixes how its maps were made")


def _over_bodies(
    table: Path, output: Path, form: PopulationForm, normalise: str | None, *, against: Path | None, force: bool
) -> str:
    from tactile_bayes.api.size_calibration import learn_population
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.size_json import write_size_calibration
    from tactile_bayes.files.tables import read_table
    from tactile_bayes.report.calibration import body_calibration_text

    others = None if against is None else read_table(against, "population.table.json")
    calibration, settings = learn_population(
        read_table(table, "population.table.json"), form, normalise, against=others
    )
    inputs = hash_inputs(table=table) if against is None else hash_inputs(table=table, against=against)
    provenance = Provenance("calibrate size", settings, inputs)
    write_size_calibration(output, calibration, provenance=provenance, force=force)
    return body_calibration_text(calibration)


@command.command("repeatability")
@click.argument("folder", metavar="OUT", type=_FILE)
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="SITE.json",
    type=FilePath(writes="JSON"),
    help="Where to write the spread.",
)
@click.option(
    "--size-calibration",
    metavar="SIZE.json",
    help="Calibration that the exams were sized by, where the name in their estimates does not lead to its file.",
)
@FORCE
def repeatability(folder: Path, output: Path, size_calibration: str | None, force: bool) -> None:
    """Learn how far sizes of one mass lie apart between its exams at this site.

    OUT is the folder of a `campaign run`. Masses with two exams or more at one visit take part, from 3 such masses on,
    better 10: their own size cancels, and errors that each map has anyway are taken off. What is left is the spread
    that `estimate --repeatability SITE.json` uses instead of that of simulated exams and of the paper's 15 %. Exams
    without a size, and those of a scan that another exam has, take no part.

    Example: tactile-bayes calibrate repeatability out -o site.json
    """
    from tactile_bayes.api.repeatability import exams_in, learn_from_exams
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.shipped import size_calibration_path
    from tactile_bayes.report.calibration import repeatability_text

    also_read(None if size_calibration is None else size_calibration_path(size_calibration))
    refuse_existing(output, force=force)
    learned = learn_from_exams(exams_in(folder), size_calibration=size_calibration)
    learned.write(output, force=force)
    click.echo(repeatability_text(learned.document), nl=False)


@command.command("array")
@click.option(
    "--step",
    "steps",
    type=(float, _FILE),
    metavar="KPA SCAN.mcap",
    multiple=True,
    required=True,
    help="The bladder's pressure and what the head recorded under it.",
)
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="ARRAY.json",
    type=FilePath(writes="JSON"),
    help="Where to write the calibration.",
)
@click.option("--head-id", metavar="ID", help="Identifier of the head. Default: what the scans state.")
@click.option(
    "--date", "day", type=click.DateTime(["%Y-%m-%d"]), metavar="DAY", help="Day of the measurement. Default: today."
)
@FORCE
def array(
    steps: tuple[tuple[float, Path], ...], output: Path, head_id: str | None, day: datetime | None, force: bool
) -> None:
    """Learn the gain and offset of each taxel from a pressure bladder, and how uneven they stay.

    Record each step with `record --uncalibrated`. Dead and hot taxels are found and get gain 0, which leaves them out
    of maps. A parabola is fitted as well, to tell whether a straight line is enough.

    Example: tactile-bayes calibrate array --step 0 p0.mcap --step 8 p8.mcap --step 16 p16.mcap -o array.json
    """
    from datetime import date

    from tactile_bayes.files.atomic import refuse_existing

    refuse_existing(output, force=force)
    measured = day.date() if day else date.today()
    click.echo(calibrate_array(steps, output, head_id=head_id, day=measured, force=force), nl=False)
