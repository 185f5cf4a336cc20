"""Options of the commands on forward models, from `simulate` to `compare-model`."""

from __future__ import annotations

import click

from tactile_bayes.commands.options import (
    FORCE,
    JSON,
    SESSION,
    WORKERS,
    CommandGroup,
    FilePath,
    FiniteRange,
    command,
    figure,
    head_option,
    output,
    path_option,
    scheduler_option,
    takes,
)
from tactile_bayes.declarations import names_of
from tactile_bayes.laboratory_options import (
    CaseOptions,
    PopulationOptions,
    SbcOptions,
    SectionOptions,
    StudyOptions,
    TissueOptions,
)
from tactile_bayes.options import MapOptions

# --- `simulate`: make a scan with known truth from a scene.


@command("simulate", "simulation.simulate_action")
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
def simulate_command() -> None:
    """Make a scan with known truth from SCENE, a TOML file.

    Lumps given as bumps (amplitude, sigma) take the empirical-gaussian model; lumps of tissue (d_mm, depth_ratio,
    stiffness_ratio, seat) and ribs in a [body] take the solid one: every frame is a contact problem in three
    dimensions. Cheaper for one lump: plane-strain solves the contact in two dimensions, empirical takes Eqs 1 to 4 of
    the paper, which hold for lumps of 10 mm and more down to h/d 1 (deeper, a warning: the map loses the lump). To
    both a lump is a cylinder along y, and a frame's profile across the head is repeated along it.

    The truth goes into the scan file beside the data; no other command reads it. On one machine and its libraries
    the same scene and seed give the same bytes.
    """


# --- `population`: simulate, map and fit exams of varied bodies: the table for a size calibration.

_FILE = FilePath()


@command("population", "simulation.population_action")
@output("TABLE.csv", "CSV", "Where to write the table.", required=True)
@takes(PopulationOptions, "masses", "centred", "scans", "normalise")
@path_option(
    "--head",
    "HEAD.json",
    "The head, as for `record`: its taxels or their grid and arc. Default: 16 by 26 taxels 1.5 mm apart, arc of 35 mm.",
)
@click.option(
    "--bodies",
    "bodies_file",
    metavar="BODIES.toml",
    type=_FILE,
    help="Ranges of lumps, bodies and exams, in the tables [bodies] and [exams]. Default: those of the shipped "
    "calibrations.",
)
@takes(PopulationOptions, "seed")
@WORKERS
@scheduler_option("the masses")
@FORCE
def population_command() -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from.

    Each body has a ball of its own size, depth, stiffness and seat, its own moduli and thickness; each exam its own
    pressure, strokes, head yaw, tilt, noise, tracker errors and latency. The solid model makes the scans; maps are
    built and fitted as `map` and `estimate` do it. A mass takes about two seconds. An interrupted run goes on where it
    stopped. `calibrate size` learns Eq 6 from the table, or with --form eq6-residual a calibration of the default's
    kind. The table names its head: a calibration learned from it sizes maps of such a head only.

    Example: tactile-bayes population --head head.json --masses 100 --workers 4 -o population.csv
    """


# --- `sbc`: simulation-based calibration of a map's posterior.


@command("sbc", "study.sbc_action")
@takes(SbcOptions, *names_of(SbcOptions))
@WORKERS
@scheduler_option("the maps")
@output("TABLE.csv", "CSV", "Write truths and ranks; an interrupted run resumes from it.")
@figure("Draw the ECDFs of the ranks with their bands.")
@JSON
@FORCE
def sbc_command() -> None:
    """Check the posterior against itself: simulation-based calibration and coverage.

    Maps are drawn from the model's own prior (bump, level, slope, correlated errors) and estimated under correlated
    errors, without rotation. Where the posterior is right, the rank of each true value among the draws is uniform and
    an interval covers it as often as it states. This tests the program, not whether breasts are like its model. Maps
    without an estimate are counted and left out, and so are those on which another rise than the drawn one was
    measured; their number is compared with what the estimates' probabilities predict. The size is that of a round
    lump by the shipped calibration. With -o an interrupted run goes on where it stopped.

    Example: tactile-bayes sbc --maps 300 --workers 2 -o sbc.csv --figure sbc.png
    """


# --- `study`: amplitude and width of the maps of simulated lumps.


@command("study", "study.study_action")
@takes(StudyOptions, "model", "grid", "seat")
@output("TABLE.csv", "CSV", "Write the table. Default: print it.")
@path_option(
    "--figures",
    "DIR",
    "Draw figures 5 to 8 of the paper into this directory, and in two dimensions the frames of four lumps. "
    "The empirical model in them holds for lumps of 10 mm and more down to h/d 1.",
)
@path_option(
    "--measured-frames",
    "FRAMES.csv",
    "Your own frames, drawn into figure 6 beside both models: columns s_mm, pressure_kpa and optionally x_c_mm.",
)
@click.option(
    "--phantom",
    type=(FiniteRange(min=0.0, min_open=True),) * 2,
    metavar="D H/D",
    help="Lump of figure 6: diameter in mm, and depth over diameter. Default: 12.5 0.825, the paper's.",
)
@takes(SectionOptions, *names_of(SectionOptions))
@head_option("Default: shoulders-inside for plane-strain, shoulders-outside for solid.")
@takes(StudyOptions, *names_of(CaseOptions), "background", "flat_field")
@WORKERS
@scheduler_option("the geometries")
@FORCE
def study_command() -> None:
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


# --- `tables`: recompute Tables 1 and 2 of the paper.


@command("tables", "study.tables_action")
@takes(StudyOptions, "seat", help="How far the lump stands out of the gland.")
@takes(SectionOptions, *names_of(SectionOptions))
@head_option("Default: shoulders-inside.")
@click.option("--heads", "search", is_flag=True, help="Compute the tables for many heads, and name the nearest one.")
@WORKERS
@JSON
def tables_command() -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures.

    The empirical model (Eqs 1 to 4) is fitted to frames of the elastic plane-strain model and compared with it: on the
    frame centred on the lump, on all frames, and on the map; for ten lumps, and for the four phantoms of section 2.3.
    The paper does not give its head. Beside the head that is asked for stands the one that comes nearest to the
    printed tables, of those that --heads computes.

    Example: tactile-bayes tables --seat resting --heads
    """


# --- `head`: how evenly a scan head presses, and the head that presses most evenly (section 2.1 of the paper).


@click.group("head", cls=CommandGroup)
def head_command() -> None:
    """How evenly a scan head presses on tissue without a lump: the homogeneous-pressure condition of section 2.1."""


@command("uniformity", "study.head_uniformity_action", within=head_command)
@takes(SectionOptions, *names_of(SectionOptions))
@head_option("Default: shoulders-inside.")
@takes(TissueOptions, *names_of(TissueOptions))
@JSON
def head_uniformity_command() -> None:
    """Compute how evenly one head presses on homogeneous tissue.

    For three moduli and three mean pressures: the largest departure of a taxel from the mean of its frame, and the root
    mean square departure. Only the ratio of pressure to modulus matters.

    Example: tactile-bayes head uniformity --head-radius-mm 35
    """


@command("design", "study.head_design_action", within=head_command)
@head_option("Default: both are searched.")
@takes(TissueOptions, *names_of(TissueOptions))
@figure("Draw the non-uniformity over radius and shoulder.")
@JSON
@FORCE
def head_design_command() -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper).

    Radii of the arc from 13 mm to a flat face and shoulders of 0 to 15 mm are tried on a sensing width of 24 mm. The
    answer is the head with the narrowest face that keeps every taxel within the limit, over all moduli and pressures.
    Ends with exit code 2 where no head does; the most even one is printed then.

    Example: tactile-bayes head design --figure head.png
    """


# --- `compare-model`: a scan's frames and map against a forward model of a scene (section 2.3 of the paper).

_FIDELITIES = ("solid", "plane-strain", "empirical", "empirical-gaussian")


@command("compare-model", "study.compare_model_action")
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
@takes(MapOptions, "every", help="Compare one frame in so many.")
@takes(MapOptions, "cell_mm", "pressure_window_kpa")
@click.option("--latency-ms", type=float, default=0.0, show_default=True, help="Delay of the tracker's time stamps.")
@figure("Draw frames, maps and what the model leaves.")
@JSON
@FORCE
def compare_model_command() -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper).

    The model's head stands where the scan's did and presses with the same mean, frame by frame; the scene's first lump
    is put where the scan's map has one, and its strokes, noise and tracker are not used. Printed are the mean squared
    differences of frames and maps, as shares of the model's sum of squares, and the bump of Eq 7 on both maps: the
    first kind hides a bump under the level it stands on. The empirical model holds for lumps of 10 mm and more down to
    h/d 1, and warns outside.

    Example: tactile-bayes compare-model scan.mcap scene.toml --fidelity empirical
    """
