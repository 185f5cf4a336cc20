"""The forward model's trade-off in words and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record
from tactile_bayes.forward.line import outside_range
from tactile_bayes.geometry import FloatArray
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.report.study import COLOURS, MARKS, finish
from tactile_bayes.studies.paper import seat_name
from tactile_bayes.studies.tradeoffs import EMPIRICAL, PLANE, SOLID, LumpCase, Measured, SizeRule, change, cheapest

# --- Text and data of the forward models' trade-off, with the settings that a case does not need.

# Settings that differ in how finely the same thing is computed.
_MESHES = ("mesh", "default", "contact cell", "reference")
_NAME = 52


class TradeoffReport(Record, eq=False):
    """All measurements of a trade-off."""

    case: LumpCase
    """The lump."""
    found: tuple[Measured, ...]
    """Every setting."""
    rules: Mapping[str, SizeRule]
    """From widths to sizes, for plane strain and for the solid model."""
    tolerance: float
    """Error in size, as a share, below which nothing is gained."""

    def of(self, model: str) -> list[Measured]:
        """Measurements of one model."""
        return [one for one in self.found if one.setting.model == model]

    def reference(self, model: str) -> Measured:
        """Finest setting of the model; for the empirical model, that of plane strain."""
        family = PLANE if model == EMPIRICAL else model
        (found,) = (one for one in self.of(family) if one.setting.kind == "reference")
        return found

    def size_mm(self, one: Measured) -> float:
        """Size by the model's own rule; for the empirical model, by that of plane strain."""
        return self.rules[SOLID if one.setting.model == SOLID else PLANE].size_mm(one)

    def size_error(self, one: Measured) -> float:
        """Error of the size against the model's reference, as a share."""
        return change(self.size_mm(one), self.size_mm(self.reference(one.setting.model)))

    def size_change_mm(self, one: Measured) -> float:
        """Difference of the size from the model's reference, in mm."""
        return self.size_mm(one) - self.size_mm(self.reference(one.setting.model))


def tradeoff_text(report: TradeoffReport) -> str:
    """Table of all settings, and accuracy that the case does not need."""
    case = report.case
    lines = [
        f"ball of {case.d_mm:g} mm, h/d {case.depth_ratio:g}, {case.stiffness_ratio:g} times as stiff as fat, "
        f"{seat_name(case.seat)}",
        f"head: {', '.join(f'{where} ({model})' for model, where in case.heads.items())}",
        "",
        f"{'':<{_NAME}}{'element':>8}{'a lump':>8}{'a map':>8}{'':>8}{'sigma_x':>8}{'sigma_y':>8}{'size':>7}"
        f"   off from the model's finest, %       mm",
        f"{'model and setting':<{_NAME}}{'mm':>8}{'s CPU':>8}{'s CPU':>8}{'a':>8}{'mm':>8}{'mm':>8}{'mm':>7}"
        f"{'a':>8}{'sigma_x':>8}{'sigma_y':>8}{'size':>7}{'size':>8}",
    ]
    lines += [_line(one, report) for one in report.found]
    return "\n".join([*lines, "", *advice(report)])


def _line(one: Measured, report: TradeoffReport) -> str:
    best = report.reference(one.setting.model)
    mark = {"default": " (default)", "reference": " (finest)"}.get(one.setting.kind, "")
    name = f"{one.setting.model}, {one.setting.label}{mark}"
    along = "" if one.sigma_y_mm is None else f"{one.sigma_y_mm:.3f}"
    off = (
        change(one.amplitude, best.amplitude),
        change(one.sigma_x_mm, best.sigma_x_mm),
        change(one.sigma_y_mm, best.sigma_y_mm),
        report.size_error(one),
    )
    shares = [f"{100 * value:+.2f}" if np.isfinite(value) else "" for value in off]
    in_mm = report.size_change_mm(one)
    return (
        f"{name:<{_NAME}}{one.element_mm:>8.2f}{one.lump_s:>8.2f}{one.map_s:>8.2f}{one.amplitude:>8.4f}"
        f"{one.sigma_x_mm:>8.3f}{along:>8}{report.size_mm(one):>7.2f}"
        f"{shares[0]:>8}{shares[1]:>8}{shares[2]:>8}{shares[3]:>7}{f'{in_mm:+.3f}' if np.isfinite(in_mm) else '':>8}"
    )


def advice(report: TradeoffReport) -> list[str]:
    """The setting that is enough, wasted accuracy, and the error of the models themselves."""
    lines = [_enough(report, SOLID), _enough(report, PLANE)]
    solid, plane, empirical = report.reference(SOLID), report.reference(PLANE), report.of(EMPIRICAL)[0]
    if report.rules[PLANE].source == report.rules[SOLID].source:
        mistaken = f"a cylinder's map read by the same calibration gives {report.size_mm(plane):.1f} mm"
    else:
        mistaken = f"a ball's map read by the cylinder's calibration gives {report.rules[PLANE].size_mm(solid):.1f} mm"
    lines.append(
        f"two dimensions: a cylinder shows {_percent(change(plane.amplitude, solid.amplitude))} in amplitude and "
        f"{_percent(change(plane.sigma_x_mm, solid.sigma_x_mm))} in width against a ball; {mistaken} for "
        f"{report.case.d_mm:g}: no mesh mends that"
    )
    lines.append(f"Eqs 1 to 4 stand in for plane strain with {_percent(report.size_error(empirical))} in size")
    if warning := outside_range(report.case.d_mm, report.case.depth_ratio):
        lines.append(warning)
    for model in (SOLID, PLANE):
        rule = report.rules[model]
        default = _default(report, model)
        lines.append(
            f"{model}: sizes by {rule.source}, which itself leaves {100 * rule.scatter:.0f} % (SD of ln d); "
            f"the default mesh leaves {_percent(report.size_error(default))} ({report.size_change_mm(default):+.3f} mm)"
        )
        if outside := rule.outside(report.reference(model)):
            lines.append(f"{model}: the map is none of the calibration's: {', '.join(outside)}")
    return lines


def _enough(report: TradeoffReport, model: str) -> str:
    """The cheapest sufficient setting of a model, compared with its default and its reference."""
    found = [one for one in report.of(model) if one.setting.kind in _MESHES]
    errors: FloatArray = np.array([report.size_error(one) for one in found])
    least = cheapest(found, errors, tolerance=report.tolerance)
    limit = f"{100 * report.tolerance:g} %"
    if least is None or least.setting.kind == "reference":
        return f"{model}: only the finest setting keeps the size within {limit}"
    finest, default = report.reference(model), _default(report, model)
    text = (
        f"{model}: {least.setting.label} (elements of {least.element_mm:.1f} mm) keeps the size within {limit} at "
        f"{least.seconds:.2f} s CPU; a mesh finer than {least.element_mm:.1f} mm is wasted below that, "
        f"the finest costs {finest.seconds / least.seconds:.0f} times as much"
    )
    return text if default is least else f"{text}, the default {default.seconds / least.seconds:.1f} times"


def _default(report: TradeoffReport, model: str) -> Measured:
    return next(one for one in report.of(model) if one.setting.kind == "default")


def _percent(share: float) -> str:
    return f"{100 * share:+.1f} %"


def tradeoff_document(report: TradeoffReport) -> dict[str, Any]:
    """The trade-off as plain data; errors as shares."""
    case = report.case
    return {
        "schema": "tactile-bayes/tradeoff-forward/1",
        "lump": {
            "d_mm": case.d_mm,
            "depth_ratio": case.depth_ratio,
            "stiffness_ratio": case.stiffness_ratio,
            "seat": case.seat,
        },
        "head": case.heads,
        "tolerance": report.tolerance,
        "sizes": {model: {"source": rule.source, "sd_ln_d": rule.scatter} for model, rule in report.rules.items()},
        "settings": [_row(one, report) for one in report.found],
        "advice": advice(report),
    }


def _row(one: Measured, report: TradeoffReport) -> dict[str, Any]:
    best = report.reference(one.setting.model)
    return {
        "model": one.setting.model,
        "setting": one.setting.label,
        "kind": one.setting.kind,
        "element_mm": one.element_mm,
        "lump_cpu_s": one.lump_s,
        "map_cpu_s": one.map_s,
        "amplitude": one.amplitude,
        "sigma_x_mm": one.sigma_x_mm,
        "sigma_y_mm": one.sigma_y_mm,
        "size_mm": report.size_mm(one),
        "amplitude_error": change(one.amplitude, best.amplitude),
        "sigma_x_error": change(one.sigma_x_mm, best.sigma_x_mm),
        "size_error": report.size_error(one),
        "size_change_mm": report.size_change_mm(one),
    }


# --- Figure of the forward models' trade-off: error in size against CPU time.

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
