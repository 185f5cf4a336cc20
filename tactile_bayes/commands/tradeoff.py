"""Options of `tradeoff`: what more accuracy costs, here and now."""

from __future__ import annotations

import click

from tactile_bayes.api.settings import Settings
from tactile_bayes.commands.options import (
    FORCE,
    JSON,
    CommandGroup,
    FilePath,
    FiniteRange,
    command,
    figure,
    head_option,
    takes,
)

# --- What `tradeoff estimate` and `tradeoff map` share: options, the forecast on stderr, and the output.

TOLERANCE = click.option(
    "--tolerance-mm",
    type=FiniteRange(min=0.0, min_open=True),
    default=0.2,
    show_default=True,
    help="Error of the size interval's ends below which more accuracy is not worth its cost.",
)
RUNS = click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    help="Number of runs of each setting: the least time counts, errors are averaged.",
)
CALIBRATION = click.option(
    "--size-calibration",
    metavar="solid|solid-mean|plane-strain|none|SIZE.json",
    help="Calibration from widths to sizes, as in `estimate`.",
)


@click.group("tradeoff", cls=CommandGroup)
def tradeoff_command() -> None:
    """Measure what more accuracy costs on this machine, and which of it a case does not need."""


# --- `tradeoff forward`: error in amplitude, width and size against CPU time, for one lump and every forward model.

_FILE = FilePath()


@command("forward", "tradeoff.tradeoff_forward_action")
@click.argument("scene", required=False, metavar="[SCENE.toml]", type=_FILE)
@click.option(
    "--size-calibration",
    metavar="solid-mean|plane-strain|learned|SIZE.json",
    help="Calibration for the sizes: a shipped one, your own file, or Eq 6 learned in this run. Default: each "
    "model's own.",
)
@head_option(
    "Default: shoulders-inside for plane-strain and the empirical model, as the scene's [head] gives them for solid."
)
@figure("Draw error in size against time.")
@click.option(
    "--tolerance-percent",
    type=FiniteRange(min=0.0, min_open=True),
    default=0.5,
    show_default=True,
    help="Error in size below which more accuracy is not worth its cost.",
)
@click.option(
    "--runs",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Number of runs; the shortest time counts.",
)
@JSON
@FORCE
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


# --- `tradeoff estimate`: every setting of `estimate` on the user's own map, against a long reference.


@command("estimate", "tradeoff.tradeoff_estimate_action")
@click.argument("maps", metavar="MAP.nc...", nargs=-1, required=True, type=_FILE)
@CALIBRATION
@takes(Settings, "centre_mm")
@takes(Settings, "settings_file", help="Settings, as in `estimate`.")
@TOLERANCE
@RUNS
@figure("Draw error against time.")
@takes(Settings, "seed")
@JSON
@FORCE
def tradeoff_estimate_command() -> None:
    """Measure what each setting of `estimate` costs on a map, and how far its size interval is off.

    Whole estimates, from the map to the size, by every method, at several accuracies, noise fields and fit windows, are
    compared with a long run of the default's posterior, by importance sampling or, where that cannot be trusted, MCMC.
    With several maps, all of one mass, the settings are tried on the first, and the sizes by one map, two and so on are
    shown. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where the map has no size by default there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff estimate map.nc --figure methods.png
    """


# --- `tradeoff map`: every setting of `map` on the user's own scan, up to the size.


@command("map", "tradeoff.tradeoff_map_action")
@click.argument("scan", metavar="SCAN.mcap", type=_FILE)
@TOLERANCE
@RUNS
@figure("Draw error against time.")
@takes(Settings, "seed")
@JSON
@FORCE
def tradeoff_map_command() -> None:
    """Measure what each setting of `map` costs on a scan, and how far it moves the size interval.

    The map is built with several sizes of cells, from a part of the frames, from the first part of the scan, by every
    way to normalise, and estimated by default. Sizes are compared with a long run on the map of all
    frames in cells of 0.5 mm. Times are CPU seconds of this machine; about how long it takes is printed on stderr.

    Where that map has no size there is no reference: what each setting says is printed, exit code 6.

    Example: tactile-bayes tradeoff map scan.mcap --figure cells.png
    """


for _one in (tradeoff_forward_command, tradeoff_estimate_command, tradeoff_map_command):
    tradeoff_command.add_command(_one)
