"""Convergence diagnostics of a posterior's draws, as a table and as figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tactile_bayes.api.arguments import PathLike, TextResult, door, path_of, required_path
from tactile_bayes.declarations import as_dict
from tactile_bayes.errors import UsageError, check_choice
from tactile_bayes.files.posterior_nc import PosteriorDraws, read_posterior
from tactile_bayes.findings import counted, finding_lines
from tactile_bayes.inference.ensemble import convergence
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.estimate_figures import corner_figure, rank_figure, trace_figure
from tactile_bayes.report.figure_file import exam_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUANTITIES = ("max_size_mm", "min_size_mm", "d_x_mm", "d_y_mm", "amplitude", "sigma_x_mm", "sigma_y_mm")
_FIGURES = {"trace": trace_figure, "rank": rank_figure, "corner": corner_figure}


class Diagnosis(TextResult, eq=False):
    """Convergence diagnostics of a posterior's draws."""

    posterior: PosteriorDraws
    path: Path  #: Of its file.
    quantities: dict[str, dict[str, float]]
    """Median of each size and width, and of chains R-hat, effective draws and Monte-Carlo errors."""

    @property
    def chains(self) -> int:
        """Number of chains; 1 for draws that are independent."""
        return len(next(iter(self.posterior.draws.values())))

    @property
    def document(self) -> dict[str, Any]:
        """The document that ``diagnose --json`` prints."""
        return {
            "method": self.posterior.method,
            "chains": self.chains,
            "quantities": self.quantities,
            "research_use": RESEARCH_USE,
            "findings": [as_dict(finding) for finding in self.posterior.findings],
        }

    @property
    def text(self) -> str:
        """The text that ``diagnose`` prints."""
        posterior, chains = self.posterior, self.chains
        number = next(iter(posterior.draws.values())).size
        lines = [*finding_lines(posterior.findings)]
        lines.append(f"method {posterior.method}: {number} draws in {counted(chains, 'chain')}")
        if chains == 1:
            shape = posterior.diagnostics.get("pareto_k")
            lines += [] if shape is None else [f"Pareto shape of the weights {shape:.2f} (trusted up to 0.7)"]
            lines += [f"{name:14}{one['median']:>10.4g}" for name, one in self.quantities.items()]
            return "\n".join([*lines, RESEARCH_USE]) + "\n"
        head = f"{'':12}{'median':>9}{'R-hat':>7}{'bulk ESS':>10}{'tail ESS':>10}"
        lines.append(f"{head}{'MCSE of median':>16}{'of 95 % ends':>14}")
        for name, one in self.quantities.items():
            ends = max(one["mcse_low"], one["mcse_high"])
            lines.append(
                f"{name:12}{one['median']:>9.4g}{one['rhat']:>7.3f}{one['ess_bulk']:>10.0f}{one['ess_tail']:>10.0f}"
                f"{one['mcse_median']:>16.2g}{ends:>14.2g}"
            )
        return "\n".join([*lines, RESEARCH_USE]) + "\n"

    @door
    def plot(self, kind: str = "trace", path: PathLike | None = None, *, force: bool = False) -> Figure:
        """Draw the ``"trace"`` of the draws, their ``"rank"`` among all chains or the ``"corner"`` of all pairs.

        Raises
        ------
        UsageError
            When the kind is none of these, ranks are of one chain, or the file exists and `force` is false.
        """
        check_choice("kind", kind, tuple(_FIGURES))
        if kind == "rank" and self.chains < 2:
            raise UsageError(f"--rank compares chains and {self.path} has one; estimate with --method ensemble")
        title = f"{exam_title(self.path.stem, self.posterior.scans)}, method {self.posterior.method}"
        return _FIGURES[kind](self.posterior.draws, path_of(path), title=title, force=force)

    def __repr__(self) -> str:
        worst = max((quantity.get("rhat", np.nan) for quantity in self.quantities.values()), default=np.nan)
        chains = f"{self.chains} chains, R-hat up to {worst:.3f}" if self.chains > 1 else "1 chain"
        return f"<Diagnosis of {self.path.name}: method {self.posterior.method}, {chains}>"


@door
def diagnose(posterior: PathLike) -> Diagnosis:
    """Check the draws of a posterior: R-hat, effective draws and Monte-Carlo errors of every size and width.

    Parameters
    ----------
    posterior
        What ``estimate -o`` or `save` wrote.

    Raises
    ------
    BadDataError
        When the file holds no draws of this program.
    """
    path = required_path(posterior, "posterior")
    contents = read_posterior(path)
    draws_by_name = {name: contents.draws[name] for name in _QUANTITIES if name in contents.draws}
    quantities = {name: {"median": float(np.nanmedian(draws))} for name, draws in draws_by_name.items()}
    if all(len(draws) > 1 for draws in draws_by_name.values()):
        for name, draws in draws_by_name.items():
            quantities[name] |= convergence(draws)
    return Diagnosis(contents, path, quantities)
