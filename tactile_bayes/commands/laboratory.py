"""Options of the commands on forward models, from `simulate` to `compare-model`."""

from __future__ import annotations

from typing import Any

import click

from tactile_bayes.commands.options import (
    FORCE,
    JSON,
    METAVAR,
    MOST_ITEMS,
    PRESSURE_WINDOW,
    SESSION,
    WORKERS,
    Decorator,
    FigurePath,
    FilePath,
    FiniteRange,
    WholeOrAuto,
    head_option,
    scheduler_option,
    seed_option,
)
from tactile_bayes.presets import CELL_MM, DEFAULT_NORMALISE, MOST_FIELD_COSINES

# --- `simulate`: make a scan with known truth from a scene.


@click.command("simulate")
@click.argument("scene", type=FilePath())
@click.option("-o", "--output", required=True, type=FilePath(writes="MCAP"), help="Scan file to write (.mcap).")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of the random numbers, in place of the scene's.")
@click.option(
    "--fidelity",
    type=click.Choice(["empirical-gaussian", "empirical", "plane-strain", "solid"]),
    help="Model of the tissue. Default: the one the scene is written for.",
)
@head_option(
    "Default: as the scene's [head] gives them for solid, shoulders-inside for plane-strain and empirical. "
    "empirical-gaussian has none."
)
@SESSION
@FORCE
def simulate_command(**given: Any) -> None:
    """Make a scan with known truth from SCENE, a TOML file.

    Lumps given as bumps (amplitude, sigma) take the empirical-gaussian model; lumps of tissue (d_mm, depth_ratio,
    stiffness_ratio, seat) and ribs in a [body] take the solid one: every frame is a contact problem in three
    dimensions. Cheaper for one lump: plane-strain solves the contact in two dimensions, empirical takes Eqs 1 to 4 of
    the paper, which hold for lumps of 10 mm and more down to h/d 1 (deeper, a warning: the map loses the lump). To
    both a lump is a cylinder along y, and a frame's profile across the head is repeated along it.

    The truth goes into the scan file beside the data; no other command reads it. On one machine and its libraries
    the same scene and seed give the same bytes.
    """
    from tactile_bayes.actions.simulation import simulate_action

    simulate_action(**given)


# --- `population`: simulate, map and fit exams of varied bodies: the table for a size calibration.

_FILE = FilePath()


@click.command("population")
@click.option(
    "-o", "--output", required=True, metavar="TABLE.csv", type=FilePath(writes="CSV"), help="Where to write the table."
)
@click.option(
    "--masses",
    type=click.IntRange(1, MOST_ITEMS),
    default=400,
    show_default=True,
    help="Number of bodies, one lump each.",
)
@click.option(
    "--centred",
    type=click.IntRange(0, MOST_ITEMS),
    default=0,
    show_default=True,
    help="Further bodies whose lump is centred on the gland's surface, as the paper has it.",
)
@click.option("--scans", type=click.IntRange(1, 1000), default=2, show_default=True, help="Number of exams per body.")
@click.option(
    "--normalise",
    type=click.Choice(["gain", "mean"]),
    multiple=True,
    default=[DEFAULT_NORMALISE],
    show_default=True,
    help="Normalisation of the maps, as in `map`; the calibration is for maps made the same way. Give it twice for a "
    "row by each from one scan.",
)
@click.option(
    "--head",
    metavar="HEAD.json",
    type=_FILE,
    help="The head, as for `record`: its taxels or their grid and arc. Default: 16 by 26 taxels 1.5 mm apart, arc of "
    "35 mm.",
)
@click.option(
    "--bodies",
    "bodies_file",
    metavar="BODIES.toml",
    type=_FILE,
    help="Ranges of lumps, bodies and exams, in the tables [bodies] and [exams]. Default: those of the shipped "
    "calibrations.",
)
@seed_option(7)
@WORKERS
@scheduler_option("the masses")
@FORCE
def population_command(**given: Any) -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from.

    Each body has a ball of its own size, depth, stiffness and seat, its own moduli and thickness; each exam its own
    pressure, strokes, head yaw, tilt, noise, tracker errors and latency. The solid model makes the scans; maps are
    built and fitted as `map` and `estimate` do it. A mass takes about two seconds. An interrupted run goes on where it
    stopped. `calibrate size` learns Eq 6 from the table, or with --form eq6-residual a calibration of the default's
    kind. The table names its head: a calibration learned from it sizes maps of such a head only.

    Example: tactile-bayes population --head head.json --masses 100 --workers 4 -o population.csv
    """
    from tactile_bayes.actions.simulation import population_action

    population_action(**given)


# --- `sbc`: simulation-based calibration of a map's posterior.


@click.command("sbc")
@click.option("--maps", type=click.IntRange(1, MOST_ITEMS), default=200, show_default=True, help="Maps to simulate.")
@click.option(
    "--method",
    type=click.Choice(["laplace", "importance", "ensemble"]),
    default="importance",
    show_default=True,
    help="Method of the posterior draws, as in `estimate`; ensemble takes about 20 times as long.",
)
@click.option(
    "--field-cosines",
    type=WholeOrAuto(min=6, max=MOST_FIELD_COSINES),
    metavar="N|auto",
    default="auto",
    show_default=True,
    help="Basis functions of the noise field, as field_cosines of `estimate`.",
)
@seed_option(1)
@WORKERS
@scheduler_option("the maps")
@click.option(
    "-o",
    "--output",
    metavar="TABLE.csv",
    type=FilePath(writes="CSV"),
    help="Write truths and ranks; an interrupted run resumes from it.",
)
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the ECDFs of the ranks with their bands.")
@JSON
@FORCE
def sbc_command(**given: Any) -> None:
    """Check the posterior against itself: simulation-based calibration and coverage.

    Maps are drawn from the model's own prior (bump, level, slope, correlated errors) and estimated under correlated
    errors, without rotation. Where the posterior is right, the rank of each true value among the draws is uniform and
    an interval covers it as often as it states. This tests the program, not whether breasts are like its model. Maps
    without an estimate are counted and left out, and so are those on which another rise than the drawn one was
    measured; their number is compared with what the estimates' probabilities predict. The size is that of a round
    lump by the shipped calibration. With -o an interrupted run goes on where it stopped.

    Example: tactile-bayes sbc --maps 300 --workers 2 -o sbc.csv --figure sbc.png
    """
    from tactile_bayes.actions.simulation import sbc_action

    sbc_action(**given)


# --- `study`: amplitude and width of the maps of simulated lumps.


_ABOVE_0 = FiniteRange(min=0.0, min_open=True)
_RADIUS = FiniteRange(min=0.0, max=1e6, min_open=True)
MODELS = ("plane-strain", "solid")


@click.command("study")
@click.option(
    "--model",
    type=click.Choice(MODELS),
    default="plane-strain",
    show_default=True,
    help="The paper's two-dimensional body, or balls under the whole head in three dimensions.",
)
@click.option(
    "--grid",
    default="paper",
    show_default=True,
    metavar="paper|FILE",
    help="The paper's 150 cases, or a table of cases.",
)
@click.option(
    "--seat",
    default="centred",
    show_default=True,
    metavar="centred|resting|0..2",
    help="How far the lump stands out of the gland, if the grid does not state it.",
)
@click.option(
    "-o", "--output", metavar="TABLE.csv", type=FilePath(writes="CSV"), help="Write the table. Default: print it."
)
@click.option(
    "--figures",
    metavar="DIR",
    type=_FILE,
    help="Draw figures 5 to 8 of the paper into this directory, and in two dimensions the frames of four lumps. "
    "The empirical model in them holds for lumps of 10 mm and more down to h/d 1.",
)
@click.option(
    "--measured-frames",
    metavar="FRAMES.csv",
    type=_FILE,
    help="Your own frames, drawn into figure 6 beside both models: columns s_mm, pressure_kpa and optionally x_c_mm.",
)
@click.option(
    "--phantom",
    type=(_ABOVE_0, _ABOVE_0),
    metavar="D H/D",
    help="Lump of figure 6: diameter in mm, and depth over diameter. Default: 12.5 0.825, the paper's.",
)
@click.option("--head-radius-mm", type=_RADIUS, default=35.0, show_default=True, help="Radius of the head's arc.")
@click.option(
    "--shoulder-mm",
    type=float,
    default=3.0,
    show_default=True,
    help="Radius of the head's shoulders.",
)
@head_option("Default: shoulders-inside for plane-strain, shoulders-outside for solid.")
@click.option("--mean-kpa", type=_ABOVE_0, default=9.5, show_default=True, help="Mean pressure on the head.")
@click.option("--fat-kpa", type=_ABOVE_0, default=5.0, show_default=True, help="Young's modulus of fat.")
@click.option("--poisson", type=float, default=0.495, show_default=True, help="Poisson's ratio of the tissues.")
@click.option("--gland-ratio", type=_ABOVE_0, default=10.0, show_default=True, help="Modulus of gland over fat.")
@click.option(
    "--thickness-mm", type=_ABOVE_0, help="Depth of the chest wall, mm. Default: 70, or deeper for deep lumps."
)
@click.option(
    "--fineness",
    type=click.IntRange(1, 8),
    default=2,
    show_default=True,
    help="Mesh fineness; doubling it halves the elements.",
)
@click.option(
    "--background",
    type=click.Choice(["fixed", "free"]),
    help="Background of Eq 7, solid only: free (default) is fitted, fixed is 1. In two dimensions it is 1.",
)
@click.option(
    "--flat-field/--no-flat-field",
    default=None,
    help="Remove what the head reads of the same body without the lump, solid only. Default: on.",
)
@WORKERS
@scheduler_option("the geometries")
@FORCE
def study_command(**given: Any) -> None:
    """Run the forward study of section 2.4: amplitude and width of the map over sizes, depths and stiffnesses.

    A head slides over each lump in a layered body; its frames become a map, and a Gaussian is fitted to it: Eq 5 across
    a cylinder in two dimensions, with the background at 1, Eq 7 over a ball in three. There the head's few lines leave
    stripes and the lump a trough, which a flat field and a free background take off. Cases with an amplitude below
    0.02 or a width that is not resolved are marked as not detectable. With -o an interrupted study goes on where it
    stopped. `calibrate size` learns from either table as it is: the table says how its maps were made and fitted. A
    calibration from the solid model is for maps made with `map --normalise mean --flat-field`. From the joined tables
    of several seats, thicknesses or heads `calibrate size` also tells what each would change.

    A grid file has the columns d_mm, depth_ratio, stiffness_ratio and optionally seat. Seat 0 (centred) puts the
    lump's centre on the fat-gland boundary, 1 (resting) its lowest point; above 1 the lump stands clear of the gland.

    Example: tactile-bayes study --model solid --seat resting -o study.csv
    """
    from tactile_bayes.actions.study import study_action

    study_action(**given)


# --- `tables`: recompute Tables 1 and 2 of the paper.


@click.command("tables")
@click.option(
    "--seat",
    default="centred",
    show_default=True,
    metavar="centred|resting|0..2",
    help="How far the lump stands out of the gland.",
)
@click.option("--head-radius-mm", type=_ABOVE_0, default=35.0, show_default=True, help="Radius of the head's arc, mm.")
@click.option(
    "--shoulder-mm", type=FiniteRange(min=0.0), default=3.0, show_default=True, help="Radius of the shoulders, mm."
)
@head_option("Default: shoulders-inside.")
@click.option("--heads", "search", is_flag=True, help="Compute the tables for many heads, and name the nearest one.")
@WORKERS
@JSON
def tables_command(**given: Any) -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures.

    The empirical model (Eqs 1 to 4) is fitted to frames of the elastic plane-strain model and compared with it: on the
    frame centred on the lump, on all frames, and on the map; for ten lumps, and for the four phantoms of section 2.3.
    The paper does not give its head. Beside the head that is asked for stands the one that comes nearest to the
    printed tables, of those that --heads computes.

    Example: tactile-bayes tables --seat resting --heads
    """
    from tactile_bayes.actions.study import tables_action

    tables_action(**given)


# --- `head`: how evenly a scan head presses, and the head that presses most evenly (section 2.1 of the paper).

_RANGE = "LOW HIGH"


@click.group("head")
def head_command() -> None:
    """How evenly a scan head presses on tissue without a lump: the homogeneous-pressure condition of section 2.1."""


def _tissue_options(wrapped: Any) -> Any:
    """Tissue, pressures and limit, the same for both subcommands."""
    options: list[Decorator] = [
        click.option(
            "--modulus-kpa",
            type=(_ABOVE_0, _ABOVE_0),
            metavar=_RANGE,
            default=(15.0, 25.0),
            show_default=True,
            help="Young's moduli of the tissue (paper: 15 to 25).",
        ),
        click.option(
            "--pressure-kpa",
            type=(_ABOVE_0, _ABOVE_0),
            metavar=_RANGE,
            default=(5.0, 14.0),
            show_default=True,
            help="Mean pressures under the head (paper: 5 to 14).",
        ),
        click.option(
            "--thickness-mm",
            type=_ABOVE_0,
            default=70.0,
            show_default=True,
            help="Thickness of the tissue on its rigid base, mm. The paper gives none.",
        ),
        click.option(
            "--poisson",
            type=FiniteRange(0.0, 0.5, max_open=True),
            default=0.495,
            show_default=True,
            help="Poisson's ratio of the tissue.",
        ),
        click.option(
            "--limit-percent",
            type=_ABOVE_0,
            default=7.5,
            show_default=True,
            help="Largest allowed departure of a taxel from the frame's mean, % of it (paper: 7.5).",
        ),
    ]
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped


@head_command.command("uniformity")
@click.option("--head-radius-mm", type=_ABOVE_0, default=35.0, show_default=True, help="Radius of the head's arc, mm.")
@click.option(
    "--shoulder-mm", type=FiniteRange(min=0.0), default=3.0, show_default=True, help="Radius of the shoulders, mm."
)
@head_option("Default: shoulders-inside.")
@_tissue_options
@JSON
def head_uniformity_command(**given: Any) -> None:
    """Compute how evenly one head presses on homogeneous tissue.

    For three moduli and three mean pressures: the largest departure of a taxel from the mean of its frame, and the root
    mean square departure. Only the ratio of pressure to modulus matters.

    Example: tactile-bayes head uniformity --head-radius-mm 35 --head shoulders-outside
    """
    from tactile_bayes.actions.study import head_uniformity_action

    head_uniformity_action(**given)


@head_command.command("design")
@head_option("Default: both are searched.")
@_tissue_options
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the non-uniformity over radius and shoulder.")
@JSON
@FORCE
def head_design_command(**given: Any) -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper).

    Radii of the arc from 13 mm to a flat face and shoulders of 0 to 15 mm are tried on a sensing width of 24 mm. The
    answer is the head with the narrowest face that keeps every taxel within the limit, over all moduli and pressures.
    Ends with exit code 2 where no head does; the most even one is printed then.

    Example: tactile-bayes head design --figure head.png
    """
    from tactile_bayes.actions.study import head_design_action

    head_design_action(**given)


# --- `compare-model`: a scan's frames and map against a forward model of a scene (section 2.3 of the paper).

_FIDELITIES = ("solid", "plane-strain", "empirical", "empirical-gaussian")


@click.command("compare-model")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@click.argument("scene", metavar="SCENE.toml", type=_FILE)
@click.option(
    "--fidelity",
    "fidelities",
    type=click.Choice(_FIDELITIES),
    multiple=True,
    help="Model of the tissue; may be repeated. Default: the one the scene is written for.",
)
@head_option("Default: as for `simulate`.")
@click.option(
    "--at",
    type=(float, float),
    metavar="X Y",
    help="The lump's place on the scan's map, mm. Default: the highest bump that can be one; 0 0 for a scene of none.",
)
@click.option("--every", type=click.IntRange(min=1), default=1, show_default=True, help="Compare one frame in so many.")
@click.option("--cell-mm", type=float, default=CELL_MM, show_default=True, help="Side of the map's cells, mm.")
@PRESSURE_WINDOW
@click.option("--latency-ms", type=float, default=0.0, show_default=True, help="Delay of the tracker's time stamps.")
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw frames, maps and what the model leaves.")
@JSON
@FORCE
def compare_model_command(**given: Any) -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper).

    The model's head stands where the scan's did and presses with the same mean, frame by frame; the scene's first lump
    is put where the scan's map has one, and its strokes, noise and tracker are not used. Printed are the mean squared
    differences of frames and maps, as shares of the model's sum of squares, and the bump of Eq 7 on both maps: the
    first kind hides a bump under the level it stands on. The empirical model holds for lumps of 10 mm and more down to
    h/d 1, and warns outside.

    Example: tactile-bayes compare-model scan.mcap scene.toml --fidelity plane-strain --fidelity empirical
    """
    from tactile_bayes.actions.study import compare_model_action

    compare_model_action(**given)
