"""`demo`: the main job on data that comes with the program."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import click

from tactile_bayes.commands.paths import FilePath
from tactile_bayes.errors import UsageError
from tactile_bayes.presets import METHODS, RESEARCH_USE

EMBEDDED = ("scan.mcap", "phantoms.csv", "trial.csv", "excision.csv", "scene.toml", "empty.toml")


@click.command("demo")
@click.option(
    "-o",
    "--output",
    type=FilePath(),
    default=Path("tactile-bayes-demo"),
    show_default=True,
    metavar="DIR",
    help="Where to put the files.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="importance",
    show_default=True,
    help="Of the estimate.",
)
@click.option("--force", is_flag=True, help="Overwrite the files of an earlier demo.")
@click.pass_context
def command(ctx: click.Context, output: Path, method: str, force: bool) -> None:
    """Run the main job on an embedded scan: map, calibrate, estimate, validate.

    The scan is simulated (a 15 mm lump, one diameter deep); the phantoms are simulated by another, three-dimensional
    model; the trial is synthetic. Each step is printed as the command that would do it by hand.
    """
    from tactile_bayes.commands import calibrate, estimate, map, validate

    _prepare(output, force=force)
    scan, table, trial, excision = (output / name for name in EMBEDDED[:4])
    tactile_map, size = output / "map.nc", output / "size.json"
    # as the phantoms' maps were made
    _step(ctx, map.command, "map", scans=(scan,), output=tactile_map, normalise="mean", force=force)
    _step(ctx, calibrate.size, "calibrate size", table=table, output=size, force=force)
    results = {"output": output / "posterior.nc", "figure": output / "size.png", "map_figure": output / "map.png"}
    _step(
        ctx,
        estimate.command,
        "estimate",
        maps=(tactile_map,),
        size_calibration=str(size),
        method=method,
        force=force,
        **results,
    )
    _step(ctx, validate.command, "validate", trial=trial, excision=excision, output=output / "trial.json", force=force)
    truth = _truth(scan)
    click.echo(f"The scan was simulated about a lump of {truth:g} mm.")
    click.echo(f"Written to {output}: {', '.join(sorted(path.name for path in output.iterdir()))}.")
    click.echo(RESEARCH_USE)


def _prepare(output: Path, *, force: bool) -> None:
    """The embedded inputs, copied where the user can look at them."""
    if output.exists() and not output.is_dir():
        raise UsageError(f"{output} is a file; choose another name")
    if output.exists() and any(output.iterdir()) and not force:
        raise UsageError(f"{output} is not empty; choose another name or give --force")
    output.mkdir(parents=True, exist_ok=True)
    for name in EMBEDDED:
        target = output / name
        shutil.copyfile(Path(__file__).resolve().parent.parent / "demo" / name, target)
        target.chmod(0o600)


def _step(ctx: click.Context, command: click.Command, name: str, **parameters: Any) -> None:
    click.secho(f"$ tactile-bayes {name} {_as_typed(command, parameters)}", bold=True)
    try:
        ctx.invoke(command, **parameters)
    except click.exceptions.Exit as end:  # a step that says its exit code; anything but 0 ends the demo with it
        if end.exit_code:
            raise
    click.echo()


def _as_typed(command: click.Command, parameters: dict[str, Any]) -> str:
    """The step's options as they would be typed."""
    words: list[str] = []
    for parameter in command.params:
        value = parameters.get(parameter.name or "")
        if value is None or value is False or value == parameter.get_default(click.Context(command)):
            continue
        values = [str(one) for one in value] if isinstance(value, tuple) else [str(value)]
        if isinstance(parameter, click.Option):
            words.append(parameter.opts[0])
            values = [] if parameter.is_flag else values
        words += values
    return " ".join(words)


def _truth(scan: Path) -> float:
    from tactile_bayes.files.scan_mcap import read_truth

    truth = read_truth(scan)
    if truth is None:
        raise UsageError(f"{scan} holds no truth; it is not the embedded scan")
    return float(truth["lumps"][0]["d_mm"])
