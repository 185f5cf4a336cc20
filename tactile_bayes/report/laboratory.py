"""Checks, tables and trade-offs of forward models in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from tactile_bayes.declarations import Record, as_dict, names_of
from tactile_bayes.files.tables import csv_text
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.plane import RANGE, outside_range
from tactile_bayes.options import FieldCosines
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file, finish
from tactile_bayes.report.paper_head import named
from tactile_bayes.report.study import COLOURS, MARKS
from tactile_bayes.studies import model_comparison, sbc
from tactile_bayes.studies.paper import seat_name
from tactile_bayes.studies.tradeoffs import EMPIRICAL, PLANE, SOLID, LumpCase, Measured, SizeRule, change

# --- Reports of simulation-based calibration: text, data, table and figure.

SCHEMA = "tactile-bayes/sbc/1"
NARROW = 1.05  #: A larger spread of the ranks is called too narrow a posterior, and too wide below its inverse.
SHIFT = 3.0  #: Standard errors of the mean rank beyond which a posterior is called too low or too high.


def sbc_document(
    maps: Sequence[sbc.MapRanks], *, method: str, seed: int, maps_per_s: float | None, cosines: FieldCosines = "auto"
) -> dict[str, Any]:
    """All results as plain data; `maps_per_s` is of the maps that this run made, None where it made none."""
    ranked = [one.outcome for one in maps if one.ranks is not None]
    silent = [one.outcome for one in maps if one.ranks is None and one.probability is None]
    tests, others = sbc.rank_tests(list(maps)), sbc.other_rises(list(maps))
    return {
        "schema": SCHEMA,
        "method": method,
        "field_cosines": cosines,
        "seed": seed,
        "maps": len(maps),
        "ranked": len(ranked),
        "abstained": dict(sorted(Counter(silent).items())),
        "drawn_by": dict(sorted(Counter(ranked).items())),
        "elsewhere": as_dict(others) | {"too_many": others.too_many},
        "draws": sbc.DRAWS,
        "maps_per_s": maps_per_s,
        "parameters": [as_dict(one) | {"inside_band": one.inside, "verdict": verdict(one)} for one in tests],
        "p_together": min(1.0, len(tests) * min(one.ecdf_p for one in tests)) if tests else None,
        "research_use": RESEARCH_USE,
    }


def verdict(test: sbc.RankTest) -> str:
    """``"ok"``, or the way in which a parameter's posterior fails."""
    if test.inside:
        return "ok"
    off = (test.mean_rank - 0.5) * np.sqrt(12.0 * test.n)
    found = ["too narrow"] * (test.spread > NARROW) + ["too wide"] * (test.spread < 1.0 / NARROW)
    if abs(off) > SHIFT:
        found.append("too low" if off > 0 else "too high")
    return "FAILS: " + (", ".join(found) or "ranks are not uniform")


def sbc_text(document: dict[str, Any]) -> str:
    """Full text report, ending with the research-use line."""
    return "\n".join([*_lines(document), RESEARCH_USE]) + "\n"


def _lines(document: dict[str, Any]) -> Iterator[str]:
    speed, others, tests = document["maps_per_s"], document["elsewhere"], document["parameters"]
    if tests:
        yield from _conclusion(tests, document["p_together"])
    else:
        yield "No map gave an estimate: there is nothing to rank; give more --maps"
    made = f"method {document['method']}, {document['field_cosines']} cosines, seed {document['seed']}"
    rate = "" if speed is None else f", {speed:.3g} maps/s"
    yield f"{document['maps']} maps from the model's own prior, {made}{rate}"
    why = ", ".join(f"{code} {number}" for code, number in document["abstained"].items())
    abstained = f"{document['maps'] - document['ranked'] - others['number']}{f' ({why})' if why else ''}"
    yield f"no estimate on {abstained}: left out, ranks are conditional on detection"
    sure = f"FAILS, the draws keep to one place (p = {others['chance']:.1g})" if others["too_many"] else "ok"
    yield f"another rise was measured on {others['number']}, announced {others['announced']:.1f}: {sure}; left out"
    if not tests:
        return
    drawn = ", ".join(f"{name} {number}" for name, number in document["drawn_by"].items())
    yield f"ranks among {sbc.DRAWS} draws, drawn by: {drawn}"
    yield ""
    yield f"{'parameter':<11}{'chi2 p':>7}{'ECDF p':>8}  {'50 % holds':<16}{'90 % holds':<16}verdict"
    for one in tests:
        held = "".join(f"{100 * c['covered']:.1f} +- {100 * c['error']:.1f} %".ljust(16) for c in one["coverage"])
        told = one["verdict"].removeprefix("FAILS: ").removeprefix("ranks are ")
        yield f"{one['name']:<11}{one['chi2_p']:>7.3f}{one['ecdf_p']:>8.3f}  {held}{told}"
    yield "+- is one binomial standard error of a calibrated interval."


def _conclusion(tests: Sequence[dict[str, Any]], together: float) -> Iterator[str]:
    failed, band = [one["name"] for one in tests if not one["inside_band"]], f"{100 * sbc.BAND:g} % band"
    if failed:
        yield f"FAILS for {', '.join(failed)}: the ranks leave their simultaneous {band}."
        chance = f"{100 * (1 - sbc.BAND ** len(tests)):.0f} % of runs"
        seldom = f"of {len(tests)} calibrated parameters one or more leave theirs in {chance}"
        advice = "run again with another --seed" if together > 1 - sbc.BAND else "that is no chance"
        yield f"All {len(tests)} together: p = {together:.2g} ({seldom}); {advice}."
    else:
        yield f"All ranks stay in their simultaneous {band}s."


def table_text(maps: Sequence[sbc.MapRanks]) -> str:
    """CSV with one row per map: truth, ranks (empty without an estimate) and outcome."""
    header = ["map", *names_of(sbc.Truth), *(f"rank_{name}" for name in sbc.RANKED), "outcome", "probability"]
    rows = []
    for one in maps:
        ranks = [*(one.ranks or ()), *[None] * len(sbc.RANKED)][: len(sbc.RANKED)]
        rows.append([one.index, *as_dict(one.truth).values(), *ranks, one.outcome, one.probability])
    return csv_text(header, rows, digits=8)


def sbc_figure(maps: Sequence[sbc.MapRanks], path: Path, *, force: bool = False) -> None:
    """Draw the ECDF of each parameter's ranks minus the uniform one, with the simultaneous band, as PNG."""
    found = [one.ranks for one in maps if one.ranks is not None]
    names = sbc.RANKED[: len(found[0])] if found else sbc.RANKED
    ranks = np.array(found).reshape(-1, len(names))
    n, at = len(ranks), np.arange(1, sbc.DRAWS + 1) / (sbc.DRAWS + 1)
    inside = {test.name: test.inside for test in sbc.rank_tests(list(maps))}
    foot = f"{n} maps with an estimate of {len(maps)}; grey: {100 * sbc.BAND:g} % band of the whole path."
    with figure_file(path, size_in=(2.2 * len(names), 2.9), foot=foot, force=force) as figure:
        for i, (axes, name) in enumerate(zip(figure.subplots(1, len(names), sharey=True), names, strict=True)):
            if n:
                low, high = sbc.ecdf_band(n, sbc.DRAWS)
                share = sbc.ecdf_counts(ranks[None, :, i], sbc.DRAWS)[0] / n
                axes.fill_between(at, low - at, high - at, step="mid", color="0.85", linewidth=0)
                axes.step(at, share - at, where="mid", color=COLOURS[0 if inside[name] else 1], linewidth=1.2)
            axes.axhline(0.0, color="0.5", linewidth=0.6)
            axes.set_xticks([0.0, 0.5, 1.0])
            finish(axes, name, "rank / (draws + 1)", "" if i else "ECDF of ranks - uniform")


# --- Tables 1 and 2 of the paper as text and as plain data: ours, the nearest head's and the printed figures.

Rows = Sequence[model_comparison.Agreement]
ByHead = Mapping[Head, Rows]
_PRINTED = {"centred_frame": model_comparison.PRINTED_FRAMES, "map": model_comparison.PRINTED_MAPS}


def tables_text(
    found: Rows, phantoms: Rows, *, head: Head, nearest: Head | None = None, beside: Rows | None = None
) -> str:
    """Both tables, the widths and amplitudes of the ten lumps, and the phantoms, under `head`.

    `nearest` is the head nearest to the printed tables, `beside` its ten lumps; None where there is none, or it is
    `head`.
    """
    heads = [found] if beside is None else [found, beside]
    lines = [f"mean MSD: {_answer(heads)}", "", model_comparison.DEFINITION, "", f"head: {named(head)}"]
    if nearest is not None and beside is not None:
        lines.append(f"after the slash the head nearest to the print: {named(nearest)}")
    lines += ["in brackets the printed figure", ""]
    lines += _table("Table 1: frame centred on the lump, MSD %", "centred_frame", heads)
    lines += _table("The same of frames divided by their means, MSD %", "normalised_frame", heads)
    lines += _table("All frames of the map, MSD % (printed average 4.3)", "all_frames", heads)
    lines += _table("Table 2: map, MSD %", "map", heads)
    lines += _table("Map, strict MSD %", "map_strict", heads)
    lines += _others(found)
    lines += ["Eq 5 fitted to both maps (background 1); the elastic model first:"]
    lines += [f"{'lump':<22}{'a':>13}{'sigma, mm':>14}{'frame %':>11}{'map %':>9}{'strict %':>11}"]
    for one in [*found, *phantoms]:
        amplitudes = f"{one.elastic.amplitude:.3f} {one.empirical.amplitude:.3f}"
        widths = f"{one.elastic.widths_mm[0]:.2f} {one.empirical.widths_mm[0]:.2f}"
        shares = f"{100 * one.centred_frame:>11.1f}{100 * one.map:>9.1f}{100 * one.map_strict:>11.1f}"
        lines.append(f"{one.scene.name:<22}{amplitudes:>13}{widths:>14}{shares}")
    outside = [one.scene.name for one in [*found, *phantoms] if outside_range(one.scene.d_mm, one.scene.depth_ratio)]
    lines.append(f"the empirical model: {RANGE}; outside:")
    lines += wrap("; ".join(outside), width=78, initial_indent="  ", subsequent_indent="  ")
    return "\n".join(lines)


def heads_text(found: ByHead) -> str:
    """The tables' means and ranges under each head, nearest first."""
    lines = [
        "",
        "Tables under each head: mean (least to largest), %, nearest to the print first",
        "off: distance from the 20 printed cells, percentage points; shoulders outside or inside",
        f"{'head':<26}{'Table 1 (4.1)':>18}{'all (4.3)':>11}{'Table 2 (2.4)':>18}{'off':>7}",
    ]
    for head, rows in sorted(found.items(), key=lambda item: model_comparison.table_distance(item[1])):
        frames, maps = (_span([getattr(one, name) for one in rows]) for name in ("centred_frame", "map"))
        every, name = f"{_mean(rows, 'all_frames'):.1f}", named(head).replace("shoulders-", "")
        lines.append(f"{name:<26}{frames:>18}{every:>11}{maps:>18}{model_comparison.table_distance(rows):>7.2f}")
    return "\n".join(lines)


def _span(shares: Sequence[float], to: str = " to ") -> str:
    percent = [100 * share for share in shares]
    low, high = (f"{one:.1f}" if one < 10 else f"{one:.0f}" for one in (min(percent), max(percent)))
    return f"{sum(percent) / len(percent):.1f} ({low}{to}{high})"


def _mean(found: Rows, name: str) -> float:
    """In percent."""
    return float(sum(100 * getattr(one, name) for one in found) / len(found))


def _answer(heads: Sequence[Rows]) -> str:
    """How near both tables come to the print."""
    told = []
    for words, name in (("frames", "centred_frame"), ("maps", "map")):
        nearest = "".join(f"nearest head {_mean(beside, name):.1f}, " for beside in heads[1:])
        printed = np.mean([*_PRINTED[name].values()])
        told.append(f"{words} {_mean(heads[0], name):.1f} % ({nearest}printed {printed:.1f})")
    return ", ".join(told)


def _others(found: Rows) -> list[str]:
    """Results of other definitions: means over the cases with the least and the largest."""
    lines = [
        "Other definitions, %: mean (least-largest); printed 4.0-4.3, 2.2-2.7",
        f"{'':<32}{'frame':>16}{'frame / mean':>16}{'map':>16}",
    ]
    for i, name in enumerate(model_comparison.OTHER_DEFINITIONS):
        cells = (_span(shares, "-") for shares in zip(*(one.others[i] for one in found), strict=True))
        lines.append(f"{name.replace('root mean square', 'RMS'):<32}" + "".join(f"{cell:>16}" for cell in cells))
    return [*lines, ""]


def _table(title: str, name: str, heads: Sequence[Rows]) -> list[str]:
    """One table with diameters across: this head / the nearest head (printed)."""
    lines = [title, f"{'h/d':>5}" + "".join(f"{f'd {d:g} mm':>15}" for d in model_comparison.TABLE_DIAMETERS_MM)]
    printed = _PRINTED.get(name)
    for depth in dict.fromkeys(one.scene.depth_ratio for one in heads[0]):
        of_depth = ([getattr(one, name) for one in rows if one.scene.depth_ratio == depth] for rows in heads)
        cells = ["/".join(f"{100 * share:.1f}" for share in shares) for shares in zip(*of_depth, strict=True)]
        if printed is not None:
            cells = [f"{cell} ({value:.1f})" for cell, value in zip(cells, printed[depth], strict=True)]
        lines.append(f"{depth:>5g}" + "".join(f"{cell:>15}" for cell in cells))
    print_mean = "" if printed is None else f" (of the printed cells {np.mean([*printed.values()]):.1f})"
    return [*lines, f"mean {' / '.join(f'{_mean(rows, name):.1f}' for rows in heads)}{print_mean}", ""]


def tables_document(found: ByHead, phantoms: ByHead, *, seat: float) -> dict[str, object]:
    """The same as plain data, shares instead of percent; the head that was asked for first."""
    first = next(iter(found))
    return {
        "schema": "tactile-bayes/tables/1",
        "definition": model_comparison.DEFINITION,
        "other_definitions": list(model_comparison.OTHER_DEFINITIONS),
        "seat": seat,
        "head": first.shoulders,
        "printed_percent": {
            "frames": {f"{h:g}": list(row) for h, row in model_comparison.PRINTED_FRAMES.items()},
            "maps": {f"{h:g}": list(row) for h, row in model_comparison.PRINTED_MAPS.items()},
        },
        "cases": [as_dict(one) for one in found[first]],
        "phantoms": [as_dict(one) for one in phantoms[first]],
        "heads": [
            {
                **as_dict(head),
                "distance": model_comparison.table_distance(rows),
                "frames": [one.centred_frame for one in rows],
                "all_frames": [one.all_frames for one in rows],
                "maps": [one.map for one in rows],
            }
            for head, rows in found.items()
        ],
    }


# --- Text and data of the forward models' trade-off, with the settings that a case does not need.

# Settings that differ in how finely the same thing is computed.
_MESHES = ("mesh", "default", "contact cell", "reference")
_NAME = 36


class TradeoffReport(Record, eq=False):
    """All measurements of a trade-off."""

    case: LumpCase  #: The lump.
    found: tuple[Measured, ...]  #: Every setting.
    rules: Mapping[str, SizeRule]  #: From widths to sizes, for plane strain and for the solid model.
    tolerance: float  #: Error in size, as a share, below which nothing is gained.

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

    def default(self, model: str) -> Measured:
        """What the program does by itself with the model."""
        return next(one for one in self.of(model) if one.setting.kind == "default")


def tradeoff_text(report: TradeoffReport) -> str:
    """Accuracy that the case does not need, then two tables of all settings: cost and size, and the map."""
    case = report.case
    lines = [
        f"ball of {case.d_mm:g} mm, h/d {case.depth_ratio:g}, {case.stiffness_ratio:g} times as stiff as fat, "
        f"{seat_name(case.seat)}",
        f"head: {', '.join(f'{where} ({model})' for model, where in case.heads.items())}",
        "",
        *advice(report),
        "",
        f"{'CPU seconds, and the size':<{_NAME}}{'element':>7}{'lump':>7}{'map':>7}{'size':>7}  off the finest",
        f"{'':<{_NAME}}{'mm':>7}{'s':>7}{'s':>7}{'mm':>7}{'%':>7}{'mm':>8}",
    ]
    for one in report.found:
        cost = f"{one.element_mm:>7.2f}{one.lump_s:>7.2f}{one.map_s:>7.2f}{report.size_mm(one):>7.2f}"
        in_mm = report.size_change_mm(one)
        off = f"{_signed(report.size_error(one)):>7}{f'{in_mm:+.3f}' if np.isfinite(in_mm) else '':>8}"
        lines += [_setting(one, cost + off)]
    lines += [
        "",
        f"{'The map':<{_NAME}}{'a':>7}{'sigma_x':>8}{'sigma_y':>8}  off the finest, %",
        f"{'':<{_NAME}}{'':>7}{'mm':>8}{'mm':>8}{'a':>7}{'x':>7}{'y':>7}",
    ]
    for one in report.found:
        best = report.reference(one.setting.model)
        along = "" if one.sigma_y_mm is None else f"{one.sigma_y_mm:.3f}"
        pairs = ((getattr(one, name), getattr(best, name)) for name in ("amplitude", "sigma_x_mm", "sigma_y_mm"))
        off = "".join(f"{_signed(change(*pair)):>7}" for pair in pairs)
        lines.append(_setting(one, f"{one.amplitude:>7.4f}{one.sigma_x_mm:>8.3f}{along:>8}{off}"))
    return "\n".join(lines)


def _setting(one: Measured, figures: str) -> str:
    """A row: the setting's name with its figures, on a line of their own where the name is long."""
    mark = {"default": " (default)", "reference": " (finest)"}.get(one.setting.kind, "")
    name = f"{one.setting.model}, {one.setting.label}{mark}"
    return f"{name:<{_NAME}}{figures}" if len(name) <= _NAME else f"{name}\n{'':<{_NAME}}{figures}"


def _signed(share: float) -> str:
    return f"{100 * share:+.2f}" if np.isfinite(share) else ""


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
        rule, default = report.rules[model], report.default(model)
        lines.append(
            f"{model}: sizes by {rule.source}, which itself leaves {100 * rule.scatter:.0f} % (SD of ln d); "
            f"the default mesh leaves {_percent(report.size_error(default))} ({report.size_change_mm(default):+.3f} mm)"
        )
        if outside := rule.outside(report.reference(model)):
            lines.append(f"{model}: the map is none of the calibration's: {', '.join(outside)}")
    return lines


def _enough(report: TradeoffReport, model: str) -> str:
    """The cheapest sufficient setting of a model, compared with its default and its reference."""
    meshes = [one for one in report.of(model) if one.setting.kind in _MESHES]
    within = [one for one in meshes if abs(report.size_error(one)) <= report.tolerance]
    least = min(within, key=lambda one: one.seconds, default=None)
    limit = f"{100 * report.tolerance:g} %"
    if least is None or least.setting.kind == "reference":
        return f"{model}: only the finest setting keeps the size within {limit}"
    finest, default = report.reference(model), report.default(model)
    text = (
        f"{model}: {least.setting.label} (elements of {least.element_mm:.1f} mm) keeps the size within {limit} at "
        f"{least.seconds:.2f} s CPU; a mesh finer than {least.element_mm:.1f} mm is wasted below that, "
        f"the finest costs {finest.seconds / least.seconds:.0f} times as much"
    )
    return text if default is least else f"{text}, the default {default.seconds / least.seconds:.1f} times"


def _percent(share: float) -> str:
    return f"{100 * share:+.1f} %"


def tradeoff_document(report: TradeoffReport) -> dict[str, Any]:
    """The trade-off as plain data; errors as shares."""
    case = report.case
    return {
        "schema": "tactile-bayes/tradeoff-forward/1",
        "lump": {name: getattr(case, name) for name in ("d_mm", "depth_ratio", "stiffness_ratio", "seat")},
        "head": case.heads,
        "tolerance": report.tolerance,
        "sizes": {model: {"source": rule.source, "sd_ln_d": rule.scatter} for model, rule in report.rules.items()},
        "settings": [_row_of_setting(one, report) for one in report.found],
        "advice": advice(report),
    }


def _row_of_setting(one: Measured, report: TradeoffReport) -> dict[str, Any]:
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

_LEAST_PERCENT = 0.003  #: Smaller errors are drawn here: below rounding of what anybody reads.


def draw_tradeoff(report: TradeoffReport, path: Path, *, force: bool = False) -> None:
    """Draw all settings except the references, whose error is 0 by definition."""
    with figure_file(path, size_in=(8.5, 5.0), force=force) as figure:
        axes = figure.subplots()
        taken: Counter[tuple[int, int]] = Counter()
        for i, model in enumerate((EMPIRICAL, PLANE, SOLID)):
            shown = [one for one in report.of(model) if one.setting.kind != "reference"]
            seconds = [one.seconds for one in shown]
            error = [max(100 * abs(report.size_error(one)), _LEAST_PERCENT) for one in shown]
            axes.plot(seconds, error, MARKS[i], color=COLOURS[i], label=model)
            beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7}
            for one, x, y in zip(shown, seconds, error, strict=True):
                name = one.setting.label + (" (default)" if one.setting.kind == "default" else "")
                place = (round(2 * np.log10(x)), round(4 * np.log10(y)))
                axes.annotate(name, (x, y), xytext=(7, 3 + 9 * taken[place]), **beside)
                taken[place] += 1
            if model == EMPIRICAL:
                continue
            finest, scatter = report.reference(model).seconds, 100 * report.rules[model].scatter
            axes.axvline(finest, color=COLOURS[i], lw=0.8, ls=":")
            axes.annotate(f"{model}, finest", (finest, _LEAST_PERCENT), xytext=(2, 2), rotation=90, **beside)
            if np.isfinite(scatter):
                axes.axhline(scatter, color=COLOURS[i], lw=0.8, ls="--")
        axes.axhline(100 * report.tolerance, color="0.5", lw=0.8)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(x=0.2, y=0.1)
        case = report.case
        title = f"one lump, d {case.d_mm:g} mm, h/d {case.depth_ratio:g}; "
        title += "grey: not worth paying for; dashed: the calibration itself"
        finish(axes, title, "CPU for one map (s)", "error in size (%)")
