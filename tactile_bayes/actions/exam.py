"""`check`, `diagnose` and `demo`: a scan's arrangement, a posterior's draws, and the main steps on embedded data."""

from __future__ import annotations

import shlex
import shutil
import sys
from datetime import date
from pathlib import Path
from typing import Final

import click

from tactile_bayes.api.diagnosing import diagnose
from tactile_bayes.commands import estimate
from tactile_bayes.commands import trial as validate
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.atomic import refuse_existing, unwritable, write_bytes
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.estimate_json import StatedSize, read_stated_size
from tactile_bayes.files.instrument import write_head
from tactile_bayes.files.scan_mcap import read_scan, read_scan_report
from tactile_bayes.mapping.arrangement import check_scan
from tactile_bayes.options import FitSettings
from tactile_bayes.presets import RESEARCH_USE

_RECORDING_FINDINGS: Final = ("data_lost", "recorder_noted", "times_apart")
"""Findings of a phantom's scan that do not speak against its head."""


def check_action(
    *, scans: tuple[Path, ...], pressure_window_kpa: tuple[float, float], output: Path | None, force: bool
) -> None:
    """Check that scans can be exams, and that array, lever arm and quaternions are as stated."""
    wrong = 0
    if output is not None:
        if len(scans) > 1:
            raise UsageError("-o takes the head of one scan; check the phantom's alone")
        refuse_existing(output, force=force)
    for path in scans:
        scan = read_scan(path)
        check = check_scan(scan, pressure_window_kpa=pressure_window_kpa)
        click.echo(f"{path}:")
        for line in check.lines():
            click.echo(f"  {line}")
        wrong += check.refused
        if output is not None:
            if check.too_short or check.findings or any(one.kind not in _RECORDING_FINDINGS for one in check.doubts):
                fault = "the scan does not show that its head is right"
                raise BadDataError(fault, way_out="scan a phantom with a lump")
            day = date.today().isoformat()
            write_head(output, replace(scan.head, checked_on=day), force=force)
            click.echo(f"{output}: the head, checked on {day}")
    click.echo(RESEARCH_USE)
    if wrong:
        subject = f"{wrong} of {len(scans)} scans are" if len(scans) > 1 else "the scan is"
        raise BadDataError(f"{subject} not arranged as stated", way_out="correct what is named above")


def diagnose_action(
    posterior: Path, trace: Path | None, rank: Path | None, corner: Path | None, as_json: bool, force: bool
) -> None:
    """Check the draws of a posterior: R-hat, effective draws and Monte-Carlo errors of every size and width."""
    figures = {"rank": rank, "trace": trace, "corner": corner}  # ranks first: they may be refused
    diagnosis = diagnose(posterior)
    for kind, path in figures.items():
        if path is not None:
            diagnosis.plot(kind, path, force=force)
    click.echo(dump_json(diagnosis.document) if as_json else diagnosis.text, nl=False)


EMBEDDED = ("scan.mcap", "phantoms.csv", "trial.csv", "excision.csv", "scene.toml", "empty.toml")
PROGRAM = "tactile-bayes"


def demo_action(output: Path, method: str, force: bool) -> None:
    """Run the main job on an embedded scan: map, estimate, and the report of a trial."""

    def step(title: str, command: click.Command, *words: str) -> None:
        """Run a step and print its command; with --force, as the demo's own files exist when it is typed again."""
        typed = [str(Path(word.format(output))) for word in words]  # ./map.nc is map.nc
        click.echo(f"\n{title}\n\n$ {PROGRAM} {shlex.join([str(command.name), *typed, '--force'])}")
        with command.make_context(command.name, typed + ["--force"] * force) as context:
            command.invoke(context)
        click.echo()

    _prepare(output, force=force)
    truth = read_scan_report(output / "scan.mcap").truth
    assert truth is not None  # the embedded scan is simulated
    true_mm = float(truth["lumps"][0]["d_mm"])
    scene = output / "scene.toml"
    click.echo(f"The scan is simulated: a ball of {true_mm:g} mm in a breast of fat and gland ({scene}).")
    click.echo(f"Each step is printed as the command that repeats it by hand.{_how_to_type()}")
    step(
        "1. Build the tactile map: all readings of the scan, averaged in cells of 1 mm.",
        estimate.map_command, "{}/scan.mcap", "-o", "{}/map.nc",
    )  # fmt: skip
    step(
        "2. Estimate the size of the lump, with the calibration that comes with the program.",
        estimate.estimate_command, "{}/map.nc", *(() if method == FitSettings().method else ("--method", method)),
        "-o", "{}/posterior.nc", "--figure", "{}/size.png", "--map-figure", "{}/map.png",
    )  # fmt: skip
    step(
        "3. The same map by the paper's own method: Markov chains over the bump, each draw through Eq 6.",
        estimate.estimate_command, "{}/map.nc", "--size-calibration", "eq6", "--method", "ensemble",
        "-o", "{}/posterior_eq6.nc",
    )  # fmt: skip
    step(
        "4. Compare sizes with excision, in a synthetic trial of the paper's size.",
        validate.validate_command, "{}/trial.csv", "--excision", "{}/excision.csv",
        "-o", "{}/trial.json", "--html", "{}/trial.html",
    )  # fmt: skip
    default, paper = (read_stated_size(output / f"{name}.nc") for name in ("posterior", "posterior_eq6"))
    click.echo(_sizes_table(true_mm, {"estimate, the default": default, "the paper's Eq 6": paper}))
    click.echo(_difference_words(default, paper))
    click.echo(f"Written to {output}: {', '.join(sorted(path.name for path in output.iterdir()))}.")
    click.echo(f"Your own data: `{PROGRAM} import --help` says how arrays, grids and images come in.")
    click.echo(RESEARCH_USE)


def _prepare(output: Path, *, force: bool) -> None:
    """Copy the embedded inputs to the output folder, which must be new or empty unless `force`."""
    if output.exists() and not output.is_dir():
        raise UsageError(f"{output} is a file; choose another name")
    if output.exists() and any(output.iterdir()) and not force:
        raise UsageError(f"{output} is not empty; choose another name or give --force")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(output, error) from None
    for name in EMBEDDED:
        write_bytes(output / name, (Path(__file__).resolve().parent.parent / "demo" / name).read_bytes(), force=True)


def _how_to_type() -> str:
    """The command to type where the program is not on the PATH, as after `make demo`; else empty."""
    if shutil.which(PROGRAM):
        return ""
    started = Path(sys.argv[0])
    typed = str(started) if started.name == PROGRAM else f"{shlex.quote(sys.executable)} -m tactile_bayes"
    return f" {PROGRAM} is not on your PATH: type {typed} for it."


def _difference_words(default: StatedSize | None, paper: StatedSize | None) -> str:
    """The difference of the paper's size from the default's in percent, and the use of either."""
    if default is None or paper is None:
        return "One of the two roads has no size; its reason is above."
    share = 100 * (paper.median / default.median - 1.0)
    return (
        f"Eq 6 lies {share:+.0f} % from the default here. The default follows the bodies it was learned over more "
        "closely; Eq 6 has four constants, which -v prints for each map and the paper explains."
    )


def _sizes_table(true_mm: float, results: dict[str, StatedSize | None]) -> str:
    lines = [
        f"{'Largest size of the lump':28}{'mm':>9}   95 % interval for exams of simulated bodies",
        f"{'true':28}{true_mm:>9.1f}",
    ]
    for name, size in results.items():
        if size is None:
            lines.append(f"{name:28}{'none':>9}")
            continue
        covered = "covers the true size" if size.low <= true_mm <= size.high else "misses the true size"
        lines.append(f"{name:28}{size.median:>9.1f}   {size.low:.1f} to {size.high:.1f} mm, {covered}")
    return "\n".join(lines)
