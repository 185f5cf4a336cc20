"""Report of `tradeoff estimate`: text, plain data and figure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.studies.estimate_tradeoff import FIELD_ACCURACY_SD, Measured, Tradeoff

SCHEMA = "tactile-bayes/tradeoff-estimate/1"
_MARKS = {"optimise": "s", "laplace": "^", "importance": "o", "ensemble": "D"}
_COLOURS = {"optimise": "0.4", "laplace": "#d55e00", "importance": "#0072b2", "ensemble": "#009e73"}
_SIZE_IN = (7.5, 4.5)


def tradeoff_text(found: Tradeoff, *, tolerance_sd: float) -> str:
    """The table and one line of advice."""
    head = f"{'method':<12}{'setting':<20}{'CPU s':>8}{'evaluations':>13}{'error, SD':>11}{'error, mm':>11}"
    rows = [_row(one) for one in found.measured]
    rows += ["", *_field_rows(found)] if found.fields else []
    notes = [
        f"Errors of the ends of 95 % intervals of the widths, root mean square of {found.runs} runs, against a "
        f"reference good to {found.reference_error_sd:.3f} SD.",
        f"From the map to the mode, which all share: {found.search_cpu_s:.2f} s. Posterior SD of sigma_x "
        f"{found.sd_mm[0]:.2g} mm, of sigma_y {found.sd_mm[1]:.2g} mm.",
        advice(found, tolerance_sd=tolerance_sd),
        RESEARCH_USE,
    ]
    return "\n".join([head, *rows, "", *notes])


def _row(one: Measured) -> str:
    if one.failed:
        return f"{one.method:<12}{one.setting:<20}  {one.failed}"
    count = f"{one.evaluations:.0f}" if one.evaluations else "-"
    return f"{one.method:<12}{one.setting:<20}{one.cpu_s:>8.3f}{count:>13}{one.error_sd:>11.3f}{one.error_mm:>11.4f}"


def _field_rows(found: Tradeoff) -> list[str]:
    """What a finer noise field costs, and what it moves."""
    finest = found.fields[-1].cosines
    head = f"{'noise field':<32}{'CPU s':>8}{'':>13}{'moved, SD':>11}{'moved, mm':>11}"
    rows = [
        f"{f'field_cosines {one.cosines}':<32}{one.cpu_s:>8.3f}{'':>13}{one.change_sd:>11.3f}{one.change_mm:>11.4f}"
        for one in found.fields
    ]
    note = (
        f"Whole estimates by importance; the same ends, against those of {finest} cosines (Monte-Carlo error "
        f"{FIELD_ACCURACY_SD:g} SD). Of itself an estimate of this map takes {found.cosines}."
    )
    return [head, *rows, note]


def advice(found: Tradeoff, *, tolerance_sd: float) -> str:
    """What to use on maps like this one."""
    best = found.advised(tolerance_sd)
    if best is None:
        return f"Advice: nothing here is within {tolerance_sd:g} SD; give --method importance a finer --accuracy-sd."
    setting = f" {best.setting}" if best.setting.startswith("--") else f" ({best.setting})" if best.setting else ""
    return (
        f"Advice: --method {best.method}{setting}: the cheapest within {tolerance_sd:g} SD of the exact ends, "
        f"{best.cpu_s:.3f} s a map."
    )


def tradeoff_document(found: Tradeoff, *, tolerance_sd: float) -> dict[str, Any]:
    """The same as plain data."""
    return {
        "schema": SCHEMA,
        "runs": found.runs,
        "reference_error_sd": _plain(found.reference_error_sd),
        "search_cpu_s": _plain(found.search_cpu_s),
        "sigma_sd_mm": {"x": _plain(found.sd_mm[0]), "y": _plain(found.sd_mm[1])},
        "measured": [
            {
                "method": one.method,
                "setting": one.setting,
                "cpu_s": _plain(one.cpu_s),
                "evaluations": _plain(one.evaluations),
                "error_sd": _plain(one.error_sd),
                "error_mm": _plain(one.error_mm),
                "failed": one.failed,
            }
            for one in found.measured
        ],
        "fields": [
            {
                "cosines": one.cosines,
                "cpu_s": _plain(one.cpu_s),
                "change_sd": _plain(one.change_sd),
                "change_mm": _plain(one.change_mm),
            }
            for one in found.fields
        ],
        "advice": advice(found, tolerance_sd=tolerance_sd),
        "research_use": RESEARCH_USE,
    }


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def draw_tradeoff(found: Tradeoff, path: Path, *, tolerance_sd: float, force: bool = False) -> None:
    """Error against CPU time, both logarithmic.

    Raises
    ------
    UsageError
        When the file exists and `force` is false.
    """
    from tactile_bayes.report.figure_file import figure_file

    with figure_file(path, size_in=_SIZE_IN, force=force) as figure:
        axes = figure.subplots()
        for method, mark in _MARKS.items():
            shown = [one for one in found.measured if one.method == method and not one.failed]
            if not shown:
                continue
            seconds = [max(one.cpu_s, 1e-4) for one in shown]
            axes.plot(seconds, [one.error_sd for one in shown], f"{mark}-", color=_COLOURS[method], label=method)
            for one, x in zip(shown, seconds, strict=True):
                axes.annotate(one.setting, (x, one.error_sd), xytext=(6, 3), textcoords="offset points", fontsize=7)
        axes.axhline(tolerance_sd, color="0.6", lw=0.8, label=f"tolerance, {tolerance_sd:g} SD")
        axes.axhline(found.reference_error_sd, color="0.6", lw=0.8, ls=":", label="the reference's own error")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(x=0.15)
        axes.set_xlabel("CPU time of a map beyond the mode, s")
        axes.set_ylabel("error of interval ends, posterior SD")
        axes.legend(fontsize=8)
        figure.text(0.01, 0.01, RESEARCH_USE, fontsize=6)
