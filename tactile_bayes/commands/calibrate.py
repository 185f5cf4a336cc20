"""`calibrate`: a size calibration, a scan head's gains, a site's repeatability."""

from __future__ import annotations

import click

from tactile_bayes.commands.options import FORCE, CommandGroup, FilePath, command, figure, output, path_option, takes
from tactile_bayes.laboratory_options import LearnOptions

# --- `calibrate`: learn a calibration from known objects, and a site's repeatability from its own exams.

_FILE = FilePath()


@click.group("calibrate", cls=CommandGroup)
def calibrate_command() -> None:
    """Learn a calibration from known objects."""


@command("size", "calibrate.calibrate_size_action", within=calibrate_command)
@click.argument("table", metavar="TABLE.csv", type=_FILE)
@output("SIZE.json", "JSON", "Where to write the calibration.", required=True)
@takes(LearnOptions, "form")
@click.option(
    "--correct",
    metavar="CALIBRATION",
    help="Correct this calibration (solid, solid-mean, eq6 or a file learned over bodies) by the table's lumps instead "
    "of learning one.",
)
@path_option(
    "--against",
    "TABLE.csv",
    "Lumps of another origin, with the columns of `population`: how far their sizes are off goes into intervals.",
)
@takes(LearnOptions, "fit", "normalise", "background", "fit_radius_mm", "noise", "least_stiffness_ratio")
@figure("Draw Fig 8 of the paper from the table's lumps (eq6 only).")
@takes(LearnOptions, "seed")
@FORCE
def size() -> None:
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


@command("repeatability", "calibrate.calibrate_repeatability_action", within=calibrate_command)
@click.argument("folder", metavar="OUT", type=_FILE)
@output("SITE.json", "JSON", "Where to write the spread.", required=True)
@click.option(
    "--size-calibration",
    metavar="SIZE.json",
    help="Calibration that the exams were sized by, where the name in their estimates does not lead to its file.",
)
@FORCE
def repeatability() -> None:
    """Learn how far sizes of one mass lie apart between its exams at this site.

    OUT is the folder of a `campaign run`. Masses with two exams or more at one visit take part, from 3 such masses on,
    better 10: their own size cancels, and errors that each map has anyway are taken off. What is left is the spread
    that `estimate --repeatability SITE.json` uses instead of that of simulated exams and of the paper's 15 %. Exams
    without a size, and those of a scan that another exam has, take no part.

    Example: tactile-bayes calibrate repeatability out -o site.json
    """


@command("array", "calibrate.calibrate_array_action", within=calibrate_command)
@click.option(
    "--step",
    "steps",
    type=(float, _FILE),
    metavar="KPA SCAN.mcap",
    multiple=True,
    required=True,
    help="The bladder's pressure and what the head recorded under it.",
)
@output("ARRAY.json", "JSON", "Where to write the calibration.", required=True)
@click.option("--head-id", metavar="ID", help="Identifier of the head. Default: what the scans state.")
@click.option(
    "--date", "day", type=click.DateTime(["%Y-%m-%d"]), metavar="DAY", help="Day of the measurement. Default: today."
)
@FORCE
def array() -> None:
    """Learn the gain and offset of each taxel from a pressure bladder, and how uneven they stay.

    Record each step with `record --uncalibrated`. Dead and hot taxels are found and get gain 0, which leaves them out
    of maps. A parabola is fitted as well, to tell whether a straight line is enough.

    Example: tactile-bayes calibrate array --step 0 p0.mcap --step 8 p8.mcap --step 16 p16.mcap -o array.json
    """
