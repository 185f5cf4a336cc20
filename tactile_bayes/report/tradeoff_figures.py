"""Figure of the forward models' trade-off: error in size against CPU time."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.study_figures import COLOURS, MARKS, finish
from tactile_bayes.report.tradeoff_text import TradeoffReport
from tactile_bayes.studies.forward_tradeoff import EMPIRICAL, PLANE, SOLID

# Smaller errors are drawn here: below rounding of what anybody reads.
_LEAST_PERCENT = 0.003
_SIZE_IN = (8.5, 5.0)


def draw_tradeoff(report: TradeoffReport, path: Path, *, force: bool = False) -> None:
    """Draw all settings except the references, whose error is 0 by definition.

    Raises
    ------
    UsageError
        When the file exists and `force` is false.
    """
    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        axes = figure.subplots()
        taken: Counter[tuple[int, int]] = Counter()
        for i, model in enumerate((EMPIRICAL, PLANE, SOLID)):
            shown = [one for one in report.of(model) if one.setting.kind != "reference"]
            seconds = [one.seconds for one in shown]
            error = [max(100 * abs(report.size_error(one)), _LEAST_PERCENT) for one in shown]
            axes.plot(seconds, error, MARKS[i], color=COLOURS[i], label=model)
            for one, x, y in zip(shown, seconds, error, strict=True):
                name = one.setting.label + (" (default)" if one.setting.kind == "default" else "")
                place = (round(2 * np.log10(x)), round(4 * np.log10(y)))
                axes.annotate(name, (x, y), xytext=(7, 3 + 9 * taken[place]), textcoords="offset points", fontsize=7)
                taken[place] += 1
            if model != EMPIRICAL:
                finest = report.reference(model).seconds
                axes.axvline(finest, color=COLOURS[i], lw=0.8, ls=":")
                axes.annotate(
                    f"{model}, finest",
                    (finest, _LEAST_PERCENT),
                    xytext=(2, 2),
                    textcoords="offset points",
                    fontsize=7,
                    rotation=90,
                )
        axes.axhline(100 * report.tolerance, color="0.6", lw=0.8)
        for model in (PLANE, SOLID):
            scatter = 100 * report.rules[model].scatter
            if np.isfinite(scatter):
                axes.axhline(scatter, color=COLOURS[1 if model == PLANE else 2], lw=0.8, ls="--")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(x=0.2, y=0.1)
        case = report.case
        title = (
            f"one lump, d {case.d_mm:g} mm, h/d {case.depth_ratio:g}; "
            "grey: not worth paying for; dashed: the calibration itself"
        )
        finish(axes, title, "CPU for one map (s)", "error in size (%)")
        figure.text(0.01, 0.01, RESEARCH_USE, fontsize=7.5, color="0.3")
