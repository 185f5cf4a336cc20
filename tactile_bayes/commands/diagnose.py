"""`diagnose`: how far the draws of a posterior can be trusted, as a table and as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, JSON, METAVAR, FigurePath, FilePath
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from tactile_bayes.files.posterior_nc import PosteriorDraws

_QUANTITIES = ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm", "amplitude", "sigma_x_mm", "sigma_y_mm")


@click.command("diagnose")
@click.argument("posterior", metavar="POST.nc", type=FilePath())
@click.option("--trace", metavar=METAVAR, type=FigurePath(), help="Draw densities and traces.")
@click.option("--rank", metavar=METAVAR, type=FigurePath(), help="Draw the ranks of each chain's draws among all.")
@click.option("--corner", metavar=METAVAR, type=FigurePath(), help="Draw the pairs of sizes, amplitude and widths.")
@JSON
@FORCE
def command(
    posterior: Path, trace: Path | None, rank: Path | None, corner: Path | None, as_json: bool, force: bool
) -> None:
    """Check the draws of a posterior: R-hat, effective draws and Monte-Carlo errors of every size and width.

    POST.nc is what `estimate -o` wrote. R-hat and effective draws compare chains, so they are of `--method ensemble`;
    weighted and independent draws are one chain, and their Pareto shape is shown instead.

    Example: tactile-bayes diagnose post.nc --trace trace.png --rank rank.png --corner corner.png
    """
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.files.documents import dump_json
    from tactile_bayes.files.posterior_nc import read_posterior
    from tactile_bayes.findings import finding_lines

    for path in (trace, rank, corner):
        if path is not None:
            refuse_existing(path, force=force)
    found = read_posterior(posterior)
    chains = len(next(iter(found.draws.values())))
    if rank is not None and chains < 2:
        raise UsageError(f"--rank compares chains and {posterior} has one; estimate with --method ensemble")
    quantities = _figures(found)
    _draw(found, posterior.stem, trace, rank, corner, force=force)
    if as_json:
        document = {"method": found.method, "chains": chains, "quantities": quantities, "research_use": RESEARCH_USE}
        document["findings"] = [one.as_dict() for one in found.findings]
        click.echo(dump_json(document), nl=False)
        return
    click.echo("\n".join([*finding_lines(found.findings), *_table(found, chains, quantities), RESEARCH_USE]))


def _figures(found: PosteriorDraws) -> dict[str, dict[str, Any]]:
    """Median of each quantity, and of chains how far they agree on it."""
    import numpy as np

    shown = {name: found.draws[name] for name in _QUANTITIES if name in found.draws}
    figures: dict[str, dict[str, Any]] = {name: {"median": float(np.nanmedian(d))} for name, d in shown.items()}
    if all(len(draws) > 1 for draws in shown.values()):
        from tactile_bayes.inference.arviz_data import convergence

        for name, draws in shown.items():
            figures[name] |= convergence(draws)
    return figures


def _draw(
    found: PosteriorDraws, name: str, trace: Path | None, rank: Path | None, corner: Path | None, *, force: bool
) -> None:
    if not (trace or rank or corner):
        return
    from tactile_bayes.report.figure_file import named_exam
    from tactile_bayes.report.posterior_figures import corner_figure, rank_figure, trace_figure

    title = f"{named_exam(name, found.scans)}, method {found.method}"
    for path, figure in ((trace, trace_figure), (rank, rank_figure), (corner, corner_figure)):
        if path is not None:
            figure(found.draws, path, title=title, force=force)


def _table(found: PosteriorDraws, chains: int, quantities: dict[str, dict[str, Any]]) -> list[str]:
    number = next(iter(found.draws.values())).size
    lines = [f"method {found.method}: {number} draws in {chains} chain{'s' if chains > 1 else ''}"]
    if chains == 1:
        shape = found.diagnostics.get("pareto_k")
        lines += [] if shape is None else [f"Pareto shape of the weights {shape:.2f} (trusted up to 0.7)"]
        return [*lines, *(f"{name:14}{one['median']:>10.4g}" for name, one in quantities.items())]
    lines.append(
        f"{'':14}{'median':>10}{'R-hat':>8}{'bulk ESS':>10}{'tail ESS':>10}{'MCSE of median':>16}{'of 95 % ends':>16}"
    )
    for name, one in quantities.items():
        ends = max(one["mcse_low"], one["mcse_high"])
        lines.append(
            f"{name:14}{one['median']:>10.4g}{one['rhat']:>8.3f}{one['ess_bulk']:>10.0f}{one['ess_tail']:>10.0f}"
            f"{one['mcse_median']:>16.2g}{ends:>16.2g}"
        )
    return lines
