"""A trial's page and figures."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

from tactile_bayes.findings import counted
from tactile_bayes.options import Aim
from tactile_bayes.report import trial as trial_words
from tactile_bayes.report.figure_file import FORMATS, Axes, figure_file, finish, plain_matplotlib
from tactile_bayes.report.pages import Growth, page
from tactile_bayes.trial.figures import Figures
from tactile_bayes.trial.method_comparison import MethodComparison
from tactile_bayes.trial.planning import PlanReport
from tactile_bayes.trial.readings import FloatArray, ModalitySizes, Trial, mass_numbers
from tactile_bayes.trial.summary import BINS, Calibration, ModalityReport, Prediction, TrialReport, prediction_of

# --- Figures of a trial as SVG, equal for equal input: sizes, differences, integral transforms, coverage.

_DOTS, _LINE, _SECOND, _GREY = "#1f3b73", "#c8641e", "#2a7f62", "0.45"
_COLOURS = (_DOTS, _LINE, _SECOND)
_PANEL_IN = 4.1
_LEGEND: dict[str, Any] = {"frameon": True, "framealpha": 0.85}


def _svg(panels: Sequence[Callable[[Axes], None]], *, alike: bool = False) -> str:
    """Draw panels side by side, `alike` with one range, as SVG in base 64, whatever the user's matplotlib settings."""
    with plain_matplotlib() as library:
        figure = library.figure.Figure(figsize=(_PANEL_IN * len(panels), _PANEL_IN), layout="constrained")
        every = figure.subplots(1, len(panels), squeeze=False)[0]
        for axes, draw in zip(every, panels, strict=True):
            draw(axes)
        if alike:  # the widest range of any
            across, up = (np.array(ends) for ends in zip(*((a.get_xlim(), a.get_ylim()) for a in every), strict=True))
            for axes in every:
                axes.set(xlim=(across[:, 0].min(), across[:, 1].max()), ylim=(up[:, 0].min(), up[:, 1].max()))
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata=FORMATS[".svg"])
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _replicate_sds(sizes: ModalitySizes) -> FloatArray:
    return np.array([group.std(ddof=1) if len(group) > 1 else 0.0 for group in sizes.replicates_mm])


def _draw_sizes(sizes: ModalitySizes, sds: Mapping[int, float], slope: float | None, reach: float, axes: Axes) -> None:
    """Size against ex-vivo size, as figure 10 of Wellman & Howe (1999).

    Error bars: +- 1 SD of the ex-vivo size where the table gives it, +- 1 SD of a mass's replicates. Dashed: identity;
    solid: line through zero. Hollow: not found, at size 0.
    """
    detected = sizes.only_detected()
    axes.plot([0, reach], [0, reach], linestyle="--", color=_GREY, linewidth=1, label="identity")
    if slope is not None:
        end = min(reach, reach / slope) if slope > 0 else reach
        axes.plot([0, end], [0, slope * end], color=_LINE, linewidth=1.5, label=f"through zero, slope {slope:.2f}")
    across, along = np.array([sds[int(mass)] for mass in detected.mass]), _replicate_sds(detected)
    bars: dict[str, Any] = {"elinewidth": 0.8, "capsize": 1.5, "ecolor": "0.5"}
    bars |= {"xerr": across if across.any() else None, "yerr": along if along.any() else None}
    points: dict[str, Any] = {"fmt": "o", "markersize": 4, "color": _DOTS, "label": f"{len(detected.size_mm)} masses"}
    axes.errorbar(detected.ex_vivo_mm, detected.size_mm, **points, **bars)
    missed = sizes.ex_vivo_mm[~sizes.detected]
    if len(missed):
        label = f"{len(missed)} not found"
        axes.plot(missed, np.zeros(len(missed)), "o", mfc="white", mec=_DOTS, markersize=5, clip_on=False, label=label)
    axes.set(xlim=(0, reach), ylim=(0, reach))
    finish(axes, sizes.name, "ex-vivo size (mm)", "size (mm)", loc="lower right", **_LEGEND)


def _draw_differences(detected: ModalitySizes, methods: MethodComparison, axes: Axes) -> None:
    """Bland-Altman plot: difference from the ex-vivo size against the mean, with limits and intervals."""
    mean, off = (detected.ex_vivo_mm + detected.size_mm) / 2, detected.size_mm - detected.ex_vivo_mm
    axes.plot(mean, off, "o", markersize=4, color=_DOTS)
    axes.axhline(0, color=_GREY, linestyle="--", linewidth=1)
    one = methods.limits.get("mm")
    if one is not None:
        axes.axhline(one.bias, color=_LINE, linewidth=1.5, label=f"bias {one.bias:.1f}")
        for value, ends in ((one.low, methods.limit_low_mm_interval), (one.high, methods.limit_high_mm_interval)):
            axes.axhline(value, color=_SECOND, linewidth=1.2, label=f"limit {value:.1f}")
            if ends is not None:
                axes.axhspan(*ends, color=_SECOND, alpha=0.13, linewidth=0)
    finish(axes, detected.name, "mean of both (mm)", "size - ex vivo (mm)", loc="upper left", **_LEGEND)


def _draw_pit(calibration: Calibration, axes: Axes) -> None:
    edges = np.linspace(0, 1, BINS + 1)
    axes.bar(edges[:-1], calibration.pit, width=1 / BINS, align="edge", color=_DOTS, edgecolor="white", alpha=0.85)
    axes.axhline(calibration.n / BINS, color=_LINE, linewidth=1.2, label="if calibrated")
    axes.set_xlim(0, 1)
    across = "share of the stated distribution below excision"
    finish(axes, "Integral transforms", across, "readings", loc="upper left", **_LEGEND)


def _draw_ecdf(calibration: Calibration, prediction: Prediction, axes: Axes) -> None:
    pit = np.sort(ndtr(prediction.z))
    share = np.arange(1, len(pit) + 1) / len(pit)
    line = np.array([0.0, 1.0])
    band = calibration.ecdf_band
    axes.fill_between(line, line - band, line + band, color=_LINE, alpha=0.15, linewidth=0)
    axes.plot(line, line, color=_LINE, linewidth=1.2, label=f"if calibrated, band for {calibration.masses} masses")
    axes.step(np.concatenate([[0], pit, [1]]), np.concatenate([[0], share, [1]]), where="post", color=_DOTS)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    finish(axes, "Their distribution", "integral transform", "share of readings", loc="upper left", **_LEGEND)


def _draw_coverage(calibration: Calibration, axes: Axes) -> None:
    nominal = np.array([level.probability for level in calibration.levels])
    share = np.array([one.covered / one.n for one in calibration.levels])
    low, high = (np.array([one.interval[i] for one in calibration.levels]) for i in (0, 1))
    axes.plot([0, 1], [0, 1], color=_LINE, linewidth=1.2, label="if calibrated")
    reach = np.stack([np.maximum(share - low, 0), np.maximum(high - share, 0)])
    points: dict[str, Any] = {"fmt": "o", "color": _DOTS, "markersize": 5, "label": "found, exact interval"}
    axes.errorbar(nominal, share, yerr=reach, capsize=3, **points)
    axes.set(xlim=(0.4, 1), ylim=(0, 1.02))
    finish(axes, "Coverage", "nominal probability of the interval", "share covered", loc="lower right", **_LEGEND)


# --- Figure of a plan: power against the number of patients, or the width of the interval.


def plan_figure(plan: PlanReport, path: Path, *, force: bool = False) -> None:
    """Draw the designs of a plan by their number of maps, and the patients that reach each target."""
    aims: list[Aim] = list(dict.fromkeys(one.aim for one in plan.needed)) or ["power"]
    with figure_file(path, size_in=(_PANEL_IN * 1.4 * len(aims), _PANEL_IN), foot=None, force=force) as figure:
        for aim, axes in zip(aims, figure.subplots(1, len(aims), squeeze=False)[0], strict=True):
            _draw_plan(axes, plan, aim)


def _draw_plan(axes: Axes, plan: PlanReport, aim: Aim) -> None:
    for maps, mark, colour in zip(sorted({one.maps for one in plan.designs}), cycle("os^Dv"), cycle(_COLOURS)):
        designs = [design for design in plan.designs if design.maps == maps]
        patients, label = [one.patients for one in designs], f"{counted(maps, 'map')} of each mass"
        if aim == "power":
            level = np.array([one.power for one in designs])
            reach = np.abs(np.array([one.power_interval for one in designs]) - level[:, None]).T
            axes.errorbar(patients, level, yerr=reach, marker=mark, color=colour, markersize=4, capsize=2, label=label)
        else:
            widths = [one.tactile_width_ratio or np.nan for one in designs]
            axes.plot(patients, widths, marker=mark, color=colour, markersize=4, label=label)
    for one in (one for one in plan.needed if one.aim == aim):
        axes.axhline(one.target, color=_GREY, linestyle="--", linewidth=1)
        axes.annotate(f"{one.patients}", (one.patients, one.target), xytext=(4, -12), textcoords="offset points")
        axes.plot([one.patients], [one.target], marker="x", color="black", markersize=8)
    up = "power" if aim == "power" else "interval of the tactile error, upper over lower end"
    finish(axes, "", "patients, one mass each", up, loc="lower right" if aim == "power" else "upper right", **_LEGEND)


# --- Trial report as one self-contained page: tables, figures, settings, hashes; no script, no network.


def trial_html(report: TrialReport, trial: Trial, *, text: str, growth: Sequence[Growth] = ()) -> str:
    """Full HTML page of a trial's report, with the text report at its end for those who copy from it.

    `growth` is of masses with several visits, beside the trial. The template puts figures into words by `report.trial`.
    """
    sizes = [(one, report.modalities[one.name]) for one in trial.sizes().values()]
    sds = {number: trial.ex_vivo_sd_mm.get(key) or 0.0 for key, number in mass_numbers(trial.ex_vivo_mm).items()}
    ends = [end for one, _ in sizes for end in (*one.ex_vivo_mm, *(one.size_mm + _replicate_sds(one)))]
    reach = 1.06 * float(max(ends, default=1.0))
    differences = [partial(_draw_differences, one.only_detected(), of.method_comparison) for one, of in sizes]
    return page(
        "trial",
        title="Sizes against excision",
        report=report,
        trial=trial,
        say=trial_words,
        masses=_masses(trial),
        sizes_svg=_svg([partial(_draw_sizes, one, sds, of.slope_through_origin, reach) for one, of in sizes]),
        differences_svg=_svg(differences, alike=True),
        calibrations=list(_calibrations(report, trial)),
        growth=growth,
        text=text,
        cells=_cells,
        of_variances=_variance_cells,
        dumps=json.dumps,
    )


def _masses(trial: Trial) -> tuple[list[str], list[list[str]]]:
    """Heads and rows: size and residual of each mass by each modality, in the order of the excision table."""
    sizes, numbers = trial.sizes(), mass_numbers(trial.ex_vivo_mm)
    cells: dict[tuple[int, str], str] = {}
    for name, one in sizes.items():
        for mass, ex_vivo, size, detected in zip(one.mass, one.ex_vivo_mm, one.size_mm, one.detected, strict=True):
            residual = f"{size:.1f} [{size - ex_vivo:+z.1f} mm, {100 * (size / ex_vivo - 1):+z.0f} %]"
            cells[int(mass), name] = residual if detected else "not found"
    rows = [
        [str(place), f"{ex_vivo:.1f}", *(cells.get((numbers[key], name), "-") for name in sizes)]
        for place, (key, ex_vivo) in enumerate(trial.ex_vivo_mm.items(), start=1)
    ]
    return ["mass", "after excision, mm", *(f"{name}, mm" for name in sizes)], rows


def _calibrations(report: TrialReport, trial: Trial) -> Iterator[tuple[str, Calibration, str]]:
    """Name, figures and picture of each modality that states its uncertainty.

    The picture: integral transforms as a histogram and a distribution function with its band, and coverage by level.
    """
    for name, one in report.modalities.items():
        calibration, prediction = one.calibration, prediction_of(trial, name)
        if calibration is not None and prediction is not None:
            panels = [
                partial(_draw_pit, calibration),
                partial(_draw_ecdf, calibration, prediction),
                partial(_draw_coverage, calibration),
            ]
            yield name, calibration, _svg(panels)


def _cells(figures: Figures, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    """Figures with their intervals; `columns`: head and format of each by name."""
    return [trial_words.shown(figures.figure(key), spec) for key, (_, spec) in columns.items()]


def _variance_cells(report: ModalityReport) -> list[str]:
    """SDs of masses, readers and maps, percent."""
    parts = report.replicates.variance_components
    variances = (None, None, None) if parts is None else (parts.mass, parts.reader, parts.map)
    return [trial_words.number(None if variance is None else 100 * variance**0.5, ".0f") for variance in variances]
