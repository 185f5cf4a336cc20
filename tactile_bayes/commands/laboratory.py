"""Options of the commands of the laboratory, from `calibrate` to `tradeoff`."""

from __future__ import annotations

import click

from tactile_bayes import options as declared
from tactile_bayes.api.settings import Settings
from tactile_bayes.commands import options
from tactile_bayes.declarations import names_of

_FILE = options.FilePath()
_ABOVE_0 = options.FiniteRange(min=0.0, min_open=True)


@click.group("calibrate", cls=options.CommandGroup)
def calibrate_command() -> None:
    """Learn a calibration from known objects."""


@options.command("size", "calibrate.calibrate_size_action", within=calibrate_command)
@click.argument("table", metavar="TABLE.csv", type=_FILE)
@options.output_option("SIZE.json", "JSON", "Where to write the calibration.", required=True)
@options.record_options(declared.LearnOptions, "form")
@click.option(
    "--correct",
    metavar="CALIBRATION",
    help="Correct this calibration (solid, solid-mean, eq6 or a file learned over bodies) by the table's lumps instead "
    "of learning one.",
)
@options.path_option(
    "--against",
    "TABLE.csv",
    "Lumps of another origin, with the columns of `population`: the errors of their sizes widen intervals.",
)
@options.record_options(declared.LearnOptions, "fit", "normalise", "background", "fit_radius_mm", "noise")
@options.record_options(declared.LearnOptions, "least_stiffness_ratio")
@options.figure_option("Draw Fig 8 of the paper from the table's lumps (eq6 only).")
@options.record_options(declared.LearnOptions, "seed")
@options.FORCE
def size() -> None:
    """Learn Eq 6, d = m sigma / (e a^f) + b, from a study or a set of phantoms, or over a population of bodies.

    TABLE.csv has a row for each lump: d_mm, amplitude, sigma_x_mm, and optionally sigma_y_mm, depth_ratio,
    stiffness_ratio and seat. With depth_ratio the rows at one diameter depth define Delta sigma as a ratio. How the
    table's maps were made and fitted stands in its columns normalise, background, fit_radius_mm, noise and flat_field,
    as in a table of `study`, or is declared by the options; an option that contradicts the table is refused, and
    `estimate` refuses a map made otherwise.

    --fit joint takes m, b, e and f from all rows at once, on the scale of ln d. --fit two-stage is the paper's: d on
    sigma in the rows at depth_ratio 1, then ln Delta sigma on ln a; its spread is a bootstrap over diameters. The
    report says how far the other fit differs.

    With depth_ratio and stiffness_ratio the table is a study: each geometry
    (seat, d_mm, depth_ratio) is also left out of the learning in turn, and the report tells how far Eq 6 and a
    quadratic in logarithms then miss the hard lumps' sizes.

    From a table of `population`, which has a row for each exam of a body, every form separates what differs between
    bodies from what differs between exams of one body. `population` made the maps: nothing is declared, and --normalise
    chooses among a table's rows. The depth of the fat is learned from the head's pressure profile on frames without a
    lump. The constants of Eq 6 depend on it; for a map without a profile sizes are averaged over the likely depths.
    eq6-residual adds what Eq 6 leaves, a Gaussian process in ln a, ln sigma and the depth; it is the form of the
    shipped `solid`. The spread between bodies is wide for deep, faint and soft lumps.

    --correct keeps a calibration and learns from 3 lumps or more, better 5 to 20, by how much sizes at this site
    differ from it: few lumps change it little, and the uncertainty of the correction goes into every size. TABLE.csv
    has the columns above, with depth_ratio, seat and stiffness_ratio where they are known, and phantom where a lump has
    several maps; or it lists map files: file, d_mm and the same. The maps must be made as the calibration's.

    Example: tactile-bayes calibrate size phantoms.csv -o size.json
    """


@options.command("repeatability", "calibrate.calibrate_repeatability_action", within=calibrate_command)
@click.argument("folder", metavar="OUT", type=_FILE)
@options.output_option("SITE.json", "JSON", "Where to write the spread.", required=True)
@click.option(
    "--size-calibration",
    metavar="SIZE.json",
    help="Calibration that the exams were sized by, where the name in their estimates does not lead to its file.",
)
@options.FORCE
def repeatability() -> None:
    """Learn how far sizes of one mass lie apart between its exams at this site.

    OUT is the folder of a `campaign run`. Masses with two exams or more at one visit take part, from 3 such masses on,
    better 10: a mass's own size cancels, and each map's own errors are subtracted. What is left is the spread that
    `estimate --repeatability SITE.json` uses instead of that of simulated exams and of the paper's 15 %. Exams without
    a size, and further exams of the same scan, take no part.

    Example: tactile-bayes calibrate repeatability out -o site.json
    """


@options.command("array", "calibrate.calibrate_array_action", within=calibrate_command)
@click.option(
    "--step",
    "steps",
    type=(float, _FILE),
    metavar="KPA SCAN.mcap",
    multiple=True,
    required=True,
    help="The bladder's pressure and what the head recorded under it.",
)
@options.output_option("ARRAY.json", "JSON", "Where to write the calibration.", required=True)
@click.option("--head-id", metavar="ID", help="Identifier of the head. Default: what the scans state.")
@click.option(
    "--date", "day", type=click.DateTime(["%Y-%m-%d"]), metavar="DAY", help="Day of the measurement. Default: today."
)
@options.FORCE
def array() -> None:
    """Learn the gain and offset of each taxel from a pressure bladder, and how uneven they stay.

    Record each step with `record --uncalibrated`. Dead and hot taxels are found and get gain 0, which leaves them out
    of maps. A parabola is fitted as well, to tell whether a straight line is enough.

    Example: tactile-bayes calibrate array --step 0 p0.mcap --step 8 p8.mcap --step 16 p16.mcap -o array.json
    """


@options.command("simulate", "simulation.simulate_action")
@click.argument("scene", type=options.FilePath())
@click.option("-o", "--output", required=True, type=options.FilePath(writes="MCAP"), help="Scan file to write (.mcap).")
@click.option("--seed", type=options.WholeRange(min=0), help="Seed of the random numbers, in place of the scene's.")
@click.option(
    "--fidelity",
    type=click.Choice(["empirical-gaussian", "empirical", "plane-strain", "solid"]),
    help="Model of the tissue. Default: the one the scene is written for.",
)
@options.head_option(
    "Default: as the scene's [head] gives them for solid, shoulders-inside for plane-strain and empirical. "
    "empirical-gaussian has none."
)
@options.SESSION
@options.FORCE
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


@options.command("population", "simulation.population_action")
@options.output_option("TABLE.csv", "CSV", "Where to write the table.", required=True)
@options.record_options(declared.PopulationOptions, "masses", "centred", "scans", "normalise")
@options.path_option(
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
@options.record_options(declared.PopulationOptions, "seed")
@options.WORKERS
@options.scheduler_option("the masses")
@options.FORCE
def population_command() -> None:
    """Simulate exams of varied bodies and fit their maps: the table that a size calibration is learned from.

    Each body has a ball of its own size, depth, stiffness and seat, its own moduli and thickness; each exam its own
    pressure, strokes, head yaw, tilt, noise, tracker errors and latency. The solid model makes the scans; maps are
    built and fitted as `map` and `estimate` do it. A mass takes 3 to 5 s of CPU. An interrupted run goes on where it
    stopped. `calibrate size` learns Eq 6 from the table, or with --form eq6-residual a calibration of the default's
    kind. The table names its head: a calibration learned from it sizes maps of such a head only.

    Example: tactile-bayes population --head head.json --masses 100 --workers 4 -o population.csv
    """


@options.command("sbc", "study.sbc_action")
@options.record_options(declared.SbcOptions)
@options.WORKERS
@options.scheduler_option("the maps")
@options.output_option("TABLE.csv", "CSV", "Write truths and ranks; an interrupted run resumes from it.")
@options.figure_option("Draw the ECDFs of the ranks with their bands.")
@options.JSON
@options.FORCE
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


@options.command("study", "study.study_action")
@options.record_options(declared.StudyOptions, "model", "grid", "seat")
@options.output_option("TABLE.csv", "CSV", "Write the table. Default: print it.")
@options.path_option(
    "--figures",
    "DIR",
    "Draw figures 5 to 8 of the paper into this directory, and in two dimensions the frames of four lumps. "
    "The empirical model in them holds for lumps of 10 mm and more down to h/d 1.",
)
@options.path_option(
    "--measured-frames",
    "FRAMES.csv",
    "Your own frames, drawn into figure 6 beside both models: columns s_mm, pressure_kpa and optionally x_c_mm.",
)
@click.option(
    "--phantom",
    type=(_ABOVE_0,) * 2,
    metavar="D H/D",
    help="Lump of figure 6: diameter in mm, and depth over diameter. Default: 12.5 0.825, the paper's.",
)
@options.record_options(declared.SectionOptions)
@options.head_option("Default: shoulders-inside for plane-strain, shoulders-outside for solid.")
@options.record_options(declared.StudyOptions, *names_of(declared.CaseOptions), "background", "flat_field")
@options.WORKERS
@options.scheduler_option("the geometries")
@options.FORCE
def study_command() -> None:
    """Run the forward study of section 2.4: amplitude and width of the map over sizes, depths and stiffnesses.

    A head slides over each lump in a layered body; its frames become a map, and a Gaussian is fitted to it: Eq 5 across
    a cylinder in two dimensions, with the background at 1, Eq 7 over a ball in three. There the head's few lines leave
    stripes and the lump a trough, which a flat field and a free background take off. Cases with an amplitude below 0.02
    or a width that is not resolved are marked as not detectable. With -o an interrupted study goes on where it stopped.
    `calibrate size` learns from either table as it is: the table says how its maps were made and fitted. A calibration
    from the solid model is for maps made with `map --normalise mean --flat-field`. Tables of several seats may be
    joined for it.

    A grid file has the columns d_mm, depth_ratio, stiffness_ratio and optionally seat. Seat 0 (centred) puts the
    lump's centre on the fat-gland boundary, 1 (resting) its lowest point; above 1 the lump stands clear of the gland.

    Example: tactile-bayes study --model solid --seat resting -o study.csv
    """


@options.command("tables", "study.tables_action")
@options.record_options(
    declared.StudyOptions,
    "seat",
    help="Seat of the lump: 0 centred on the gland's surface, 1 resting on it.",
)
@options.record_options(declared.SectionOptions)
@options.head_option("Default: shoulders-inside.")
@click.option("--heads", "search", is_flag=True, help="Compute the tables for many heads, and name the nearest one.")
@options.WORKERS
@options.JSON
def tables_command() -> None:
    """Recompute Tables 1 and 2 of the paper beside the printed figures.

    The empirical model (Eqs 1 to 4) is fitted to frames of the elastic plane-strain model and compared with it: on the
    frame centred on the lump, on all frames, and on the map; for ten lumps, and for the four phantoms of section 2.3.
    The paper does not give its head. Beside the head that is asked for stands the one that comes nearest to the
    printed tables, of those that --heads computes.

    Example: tactile-bayes tables --seat resting --heads
    """


@click.group("head", cls=options.CommandGroup)
def head_command() -> None:
    """How evenly a scan head presses on tissue without a lump: the homogeneous-pressure condition of section 2.1."""


@options.command("uniformity", "study.head_uniformity_action", within=head_command)
@options.record_options(declared.SectionOptions)
@options.head_option("Default: shoulders-inside.")
@options.record_options(declared.TissueOptions)
@options.JSON
def head_uniformity_command() -> None:
    """Compute how evenly one head presses on homogeneous tissue.

    For three moduli and three mean pressures: the largest departure of a taxel from the mean of its frame, and the root
    mean square departure. Only the ratio of pressure to modulus matters.

    Example: tactile-bayes head uniformity --head-radius-mm 35
    """


@options.command("design", "study.head_design_action", within=head_command)
@options.head_option("Default: both are searched.")
@options.record_options(declared.TissueOptions)
@options.figure_option("Draw the non-uniformity over radius and shoulder.")
@options.JSON
@options.FORCE
def head_design_command() -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper).

    Radii of the arc from 13 mm to a flat face and shoulders of 0 to 15 mm are tried on a sensing width of 24 mm. The
    answer is the head with the narrowest face that keeps every taxel within the limit, over all moduli and pressures.
    Ends with exit code 2 where no head does; the most even one is printed then.

    Example: tactile-bayes head design --figure head.png
    """


_FIDELITIES = ("solid", "plane-strain", "empirical", "empirical-gaussian")


@options.command("compare-model", "study.compare_model_action")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@click.argument("scene", metavar="SCENE.toml", type=_FILE)
@click.option(
    "--fidelity",
    "fidelities",
    type=click.Choice(_FIDELITIES),
    multiple=True,
    help="Model of the tissue; may be repeated. Default: the one the scene is written for.",
)
@options.head_option("Default: as for `simulate`.")
@click.option(
    "--at",
    type=(float, float),
    metavar="X Y",
    help="The lump's place on the scan's map, mm. Default: the highest bump that can be one; 0 0 for a scene of none.",
)
@options.record_options(declared.MapOptions, "every", help="Compare one frame in so many.")
@options.record_options(declared.MapOptions, "cell_mm", "pressure_window_kpa")
@options.number_option("--latency-ms", click.FLOAT, 0.0, "Delay of the tracker's time stamps.")
@options.figure_option("Draw frames, maps and what the model leaves.")
@options.JSON
@options.FORCE
def compare_model_command() -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper).

    The model's head stands where the scan's did and presses with the same mean, frame by frame; the scene's first lump
    is put where the scan's map has one, and its strokes, noise and tracker are not used. Printed are the mean squared
    differences of frames and maps, as shares of the model's sum of squares, and the bump of Eq 7 on both maps: the
    first kind hides a bump under the level it stands on. The empirical model holds for lumps of 10 mm and more down to
    h/d 1, and warns outside.

    Example: tactile-bayes compare-model scan.mcap scene.toml --fidelity empirical
    """


# --- Options that the trade-off commands share.

_RUN_COUNT = options.WholeRange(1, 1000)
_TOLERANCE = options.number_option(
    "--tolerance-mm",
    _ABOVE_0,
    0.2,
    "Error of the size interval's ends below which more accuracy is not worth its cost.",
)
_RUNS = options.number_option(
    "--runs", _RUN_COUNT, 3, "Number of runs of each setting: the least time counts, errors are averaged."
)


@click.group("tradeoff", cls=options.CommandGroup)
def tradeoff_command() -> None:
    """Measure what more accuracy costs on this machine, and where it buys nothing."""


@options.command("forward", "tradeoff.tradeoff_forward_action", within=tradeoff_command)
@click.argument("scene", required=False, metavar="[SCENE.toml]", type=_FILE)
@click.option(
    "--size-calibration",
    metavar="solid-mean|plane-strain|learned|SIZE.json",
    help="Calibration for the sizes: a shipped one, your own file, or Eq 6 learned in this run. Default: each "
    "model's own.",
)
@options.head_option(
    "Default: shoulders-inside for plane-strain and the empirical model, as the scene's [head] gives them for solid."
)
@options.figure_option("Draw error in size against time.")
@options.number_option(
    "--tolerance-percent", _ABOVE_0, 0.5, "Error in size below which more accuracy is not worth its cost."
)
@options.number_option("--runs", _RUN_COUNT, 1, "Number of runs; the shortest time counts.")
@options.JSON
@options.FORCE
def tradeoff_forward_command() -> None:
    """Measure error in amplitude, width and size against CPU time, for the lump of a scene.

    The empirical model (which holds for lumps of 10 mm and more down to h/d 1, and warns outside), plane strain at
    several cells and the solid model at several meshes, ranks and rims compute the
    map of one lump, here and now; each model's finest setting is the reference of its others. Without SCENE.toml: a
    hard ball of 15 mm at h/d 1, its centre on the gland.

    Sizes come from the calibration that `estimate` uses, and the cylinder's from `plane-strain`. These maps have no
    noise and a background of 1, so a size may be off; what counts is how it changes, which is given in mm and percent.
    With --size-calibration learned Eq 6 is learned, in most of a minute, from each model's own lumps in the same body
    and under the same head; the calibrations that come with the program are of the default heads.

    Example: tactile-bayes tradeoff forward --figure tradeoff.png
    """


@options.command("estimate", "tradeoff.tradeoff_estimate_action", within=tradeoff_command)
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@click.option(
    "--size-calibration",
    metavar="solid|solid-mean|plane-strain|none|SIZE.json",
    help="Calibration from widths to sizes, as in `estimate`.",
)
@options.record_options(Settings, "centre_mm")
@options.record_options(Settings, "settings_file", help="Settings, as in `estimate`.")
@_TOLERANCE
@_RUNS
@options.figure_option("Draw error against time.")
@options.record_options(Settings, "seed")
@options.JSON
@options.FORCE
def tradeoff_estimate_command() -> None:
    """Measure what each setting of `estimate` costs on a map, and how far its size interval is off.

    Whole estimates, from the map to the size, by every method, at several accuracies, noise fields and fit windows, are
    compared with a long run of the default's posterior, by importance sampling or, where that cannot be trusted, MCMC.
    With several maps, all of one mass, the settings are tried on the first, and the sizes by one map, two and so on are
    shown. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where the map has no size by default there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff estimate map.nc --figure methods.png
    """


@options.command("map", "tradeoff.tradeoff_map_action", within=tradeoff_command)
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@_TOLERANCE
@_RUNS
@options.figure_option("Draw error against time.")
@options.record_options(Settings, "seed")
@options.JSON
@options.FORCE
def tradeoff_map_command() -> None:
    """Measure what each setting of `map` costs on a scan, and how far it moves the size interval.

    The map is built with several sizes of cells, from a part of the frames, from the first part of the scan, by every
    way to normalise, and estimated by default. Sizes are compared with a long run on the map of all
    frames in cells of 0.5 mm. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where that map has no size there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff map scan.mcap --figure cells.png
    """
