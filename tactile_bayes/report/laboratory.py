"""Checks, tables and trade-offs of forward models in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import numpy as np

from tactile_bayes.declarations import as_dict, names_of
from tactile_bayes.files.tables import csv_text
from tactile_bayes.forward.plane import RANGE, outside_range
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.options import FieldCosines
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file, finish
from tactile_bayes.report.paper_head import head_words
from tactile_bayes.report.study import COLOURS
from tactile_bayes.studies import model_comparison, sbc

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
    tests, others = sbc.rank_tests(list(maps)), sbc.count_other_rises(list(maps))
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
        "parameters": [as_dict(test) | {"inside_band": test.inside, "verdict": verdict(test)} for test in tests],
        "p_together": min(1.0, len(tests) * min(one.ecdf_p for one in tests)) if tests else None,
        "research_use": RESEARCH_USE,
    }


def verdict(test: sbc.RankTest) -> str:
    """``"ok"``, or the way in which a parameter's posterior fails."""
    if test.inside:
        return "ok"
    off = (test.mean_rank - 0.5) * np.sqrt(12.0 * test.n)
    narrow, wide = test.spread > NARROW, test.spread < 1.0 / NARROW
    faults = {"too narrow": narrow, "too wide": wide, "too low": off > SHIFT, "too high": off < -SHIFT}
    return "FAILS: " + (", ".join(words for words, found in faults.items() if found) or "ranks are not uniform")


def sbc_text(document: dict[str, Any]) -> str:
    """Full text report, ending with the research-use line."""
    speed, others, tests = document["maps_per_s"], document["elsewhere"], document["parameters"]
    lines = ["No map gave an estimate: there is nothing to rank; give more --maps"]
    if tests:
        lines = [*_conclusion(tests, document["p_together"])]
    made = f"method {document['method']}, {document['field_cosines']} cosines, seed {document['seed']}"
    rate = "" if speed is None else f", {speed:.3g} maps/s"
    why = ", ".join(f"{code} {number}" for code, number in document["abstained"].items())
    abstained = f"{document['maps'] - document['ranked'] - others['number']}{f' ({why})' if why else ''}"
    sure = f"FAILS, the draws keep to one place (p = {others['chance']:.1g})" if others["too_many"] else "ok"
    lines += [
        f"{document['maps']} maps from the model's own prior, {made}{rate}",
        f"no estimate on {abstained}: left out, ranks are conditional on detection",
        f"another rise was measured on {others['number']}, announced {others['announced']:.1f}: {sure}; left out",
    ]
    if tests:
        drawn = ", ".join(f"{name} {number}" for name, number in document["drawn_by"].items())
        head = f"{'parameter':<11}{'chi2 p':>7}{'ECDF p':>8}  {'50 % holds':<16}{'90 % holds':<16}verdict"
        lines += [f"ranks among {sbc.DRAWS} draws, drawn by: {drawn}", "", head]
        for test in tests:
            held = "".join(f"{100 * c['covered']:.1f} +- {100 * c['error']:.1f} %".ljust(16) for c in test["coverage"])
            fault = test["verdict"].removeprefix("FAILS: ").removeprefix("ranks are ")
            lines.append(f"{test['name']:<11}{test['chi2_p']:>7.3f}{test['ecdf_p']:>8.3f}  {held}{fault}")
        lines.append("+- is one binomial standard error of a calibrated interval.")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


_FEW: Final = 50  #: Maps below which the conclusion says that they are few.


def _conclusion(tests: Sequence[dict[str, Any]], together: float) -> Iterator[str]:
    failed, band = [test["name"] for test in tests if not test["inside_band"]], f"{100 * sbc.BAND:g} % band"
    if failed:
        yield f"FAILS for {', '.join(failed)}: the ranks leave their simultaneous {band}."
        chance = f"{100 * (1 - sbc.BAND ** len(tests)):.0f} % of runs"
        seldom = f"of {len(tests)} calibrated parameters one or more leave theirs in {chance}"
        advice = "run again with another --seed" if together > 1 - sbc.BAND else "that is no chance"
        yield f"All {len(tests)} together: p = {together:.2g} ({seldom}); {advice}."
    else:
        number = tests[0]["n"]
        few = "" if number >= _FEW else f" So few maps ({number}) show gross faults alone; give more --maps."
        yield f"All ranks stay in their simultaneous {band}s.{few}"


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
    ranked = [one.ranks for one in maps if one.ranks is not None]
    names = sbc.RANKED[: len(ranked[0])] if ranked else sbc.RANKED
    ranks = np.array(ranked).reshape(-1, len(names))
    n, uniform = len(ranks), np.arange(1, sbc.DRAWS + 1) / (sbc.DRAWS + 1)
    inside = {test.name: test.inside for test in sbc.rank_tests(list(maps))}
    foot = f"{n} maps with an estimate of {len(maps)}; grey: {100 * sbc.BAND:g} % band of the whole path."
    with figure_file(path, size_in=(2.2 * len(names), 2.9), foot=foot, force=force) as figure:
        for i, (axes, name) in enumerate(zip(figure.subplots(1, len(names), sharey=True), names, strict=True)):
            if n:
                low, high = sbc.ecdf_band(n, sbc.DRAWS)
                share = sbc.ecdf_counts(ranks[None, :, i], sbc.DRAWS)[0] / n
                axes.fill_between(uniform, low - uniform, high - uniform, step="mid", color="0.85", linewidth=0)
                axes.step(uniform, share - uniform, where="mid", color=COLOURS[0 if inside[name] else 1], linewidth=1.2)
            axes.axhline(0.0, color="0.5", linewidth=0.6)
            axes.set_xticks([0.0, 0.5, 1.0])
            finish(axes, name, "rank / (draws + 1)", "" if i else "ECDF of ranks - uniform")


# --- Tables 1 and 2 of the paper as text and as plain data: ours, the nearest head's and the printed figures.

Rows = Sequence[model_comparison.Agreement]
ByHead = Mapping[HeadSection, Rows]
_PRINTED = {"centred_frame": model_comparison.PRINTED_FRAMES, "map": model_comparison.PRINTED_MAPS}


def tables_text(
    cases: Rows, phantoms: Rows, *, head: HeadSection, nearest: HeadSection | None = None, beside: Rows | None = None
) -> str:
    """Both tables, the widths and amplitudes of the ten lumps, and the phantoms, under `head`.

    `nearest` is the head nearest to the printed tables, `beside` its ten lumps; None where there is none, or it is
    `head`.
    """
    heads = [cases] if beside is None else [cases, beside]
    lines = [f"mean MSD: {_mean_msd_words(heads)}", "", model_comparison.DEFINITION, "", f"head: {head_words(head)}"]
    if nearest is not None and beside is not None:
        lines.append(f"after the slash the head nearest to the print: {head_words(nearest)}")
    lines += ["in brackets the printed figure", ""]
    lines += _table("Table 1: frame centred on the lump, MSD %", "centred_frame", heads)
    lines += _table("The same of frames divided by their means, MSD %", "normalised_frame", heads)
    lines += _table("All frames of the map, MSD % (printed average 4.3)", "all_frames", heads)
    lines += _table("Table 2: map, MSD %", "map", heads)
    lines += _table("Map, strict MSD %", "map_strict", heads)
    lines += _other_definitions(cases)
    lines += ["Eq 5 fitted to both maps (background 1); the elastic model first:"]
    lines += [f"{'lump':<22}{'a':>13}{'sigma, mm':>14}{'frame %':>11}{'map %':>9}{'strict %':>11}"]
    for one in [*cases, *phantoms]:
        amplitudes = f"{one.elastic.amplitude:.3f} {one.empirical.amplitude:.3f}"
        widths = f"{one.elastic.widths_mm[0]:.2f} {one.empirical.widths_mm[0]:.2f}"
        shares = f"{100 * one.centred_frame:>11.1f}{100 * one.map:>9.1f}{100 * one.map_strict:>11.1f}"
        lines.append(f"{one.scene.name:<22}{amplitudes:>13}{widths:>14}{shares}")
    outside = [one.scene.name for one in [*cases, *phantoms] if outside_range(one.scene.d_mm, one.scene.depth_ratio)]
    lines.append(f"the empirical model: {RANGE}; outside:")
    lines += wrap("; ".join(outside), width=78, initial_indent="  ", subsequent_indent="  ")
    return "\n".join(lines)


def heads_text(by_head: ByHead) -> str:
    """The tables' means and ranges under each head, nearest first."""
    lines = [
        "",
        "Tables under each head: mean (least to largest), %, nearest to the print first",
        "off: distance from the 20 printed cells, percentage points; shoulders outside or inside",
        f"{'head':<26}{'Table 1 (4.1)':>18}{'all (4.3)':>11}{'Table 2 (2.4)':>18}{'off':>7}",
    ]
    for head, rows in sorted(by_head.items(), key=lambda item: model_comparison.table_distance(item[1])):
        frames, maps = (_span([getattr(row, name) for row in rows]) for name in ("centred_frame", "map"))
        every, name = f"{_mean(rows, 'all_frames'):.1f}", head_words(head).replace("shoulders-", "")
        lines.append(f"{name:<26}{frames:>18}{every:>11}{maps:>18}{model_comparison.table_distance(rows):>7.2f}")
    return "\n".join(lines)


def _span(shares: Sequence[float], to: str = " to ") -> str:
    percent = [100 * share for share in shares]
    low, high = (f"{one:.1f}" if one < 10 else f"{one:.0f}" for one in (min(percent), max(percent)))
    return f"{sum(percent) / len(percent):.1f} ({low}{to}{high})"


def _mean(cases: Rows, name: str) -> float:
    """In percent."""
    return float(sum(100 * getattr(case, name) for case in cases) / len(cases))


def _mean_msd_words(heads: Sequence[Rows]) -> str:
    """Mean MSD of frames and of maps, beside the nearest head's and the printed ones."""
    parts = []
    for words, name in (("frames", "centred_frame"), ("maps", "map")):
        nearest = "".join(f"nearest head {_mean(beside, name):.1f}, " for beside in heads[1:])
        printed = np.mean([*_PRINTED[name].values()])
        parts.append(f"{words} {_mean(heads[0], name):.1f} % ({nearest}printed {printed:.1f})")
    return ", ".join(parts)


def _other_definitions(cases: Rows) -> list[str]:
    """Table of MSD by other definitions: mean over the cases, least and largest."""
    lines = [
        "Other definitions, %: mean (least-largest); printed 4.0-4.3, 2.2-2.7",
        f"{'':<32}{'frame':>16}{'frame / mean':>16}{'map':>16}",
    ]
    for i, name in enumerate(model_comparison.OTHER_DEFINITIONS):
        cells = (_span(shares, "-") for shares in zip(*(case.others[i] for case in cases), strict=True))
        lines.append(f"{name.replace('root mean square', 'RMS'):<32}" + "".join(f"{cell:>16}" for cell in cells))
    return [*lines, ""]


def _table(title: str, name: str, heads: Sequence[Rows]) -> list[str]:
    """One table with diameters across: this head / the nearest head (printed)."""
    lines = [title, f"{'h/d':>5}" + "".join(f"{f'd {d:g} mm':>15}" for d in model_comparison.TABLE_DIAMETERS_MM)]
    printed = _PRINTED.get(name)
    for depth in dict.fromkeys(head.scene.depth_ratio for head in heads[0]):
        of_depth = ([getattr(row, name) for row in rows if row.scene.depth_ratio == depth] for rows in heads)
        cells = ["/".join(f"{100 * share:.1f}" for share in shares) for shares in zip(*of_depth, strict=True)]
        if printed is not None:
            cells = [f"{cell} ({value:.1f})" for cell, value in zip(cells, printed[depth], strict=True)]
        lines.append(f"{depth:>5g}" + "".join(f"{cell:>15}" for cell in cells))
    print_mean = "" if printed is None else f" (of the printed cells {np.mean([*printed.values()]):.1f})"
    return [*lines, f"mean {' / '.join(f'{_mean(rows, name):.1f}' for rows in heads)}{print_mean}", ""]


def tables_document(by_head: ByHead, phantoms: ByHead, *, seat: float) -> dict[str, Any]:
    """Both tables as plain data, shares instead of percent; the chosen head comes first."""
    first = next(iter(by_head))
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
        "cases": list(map(_case_document, by_head[first])),
        "phantoms": list(map(_case_document, phantoms[first])),
        "heads": [
            {
                **as_dict(head),
                "distance": model_comparison.table_distance(rows),
                "frames": [one.centred_frame for one in rows],
                "all_frames": [one.all_frames for one in rows],
                "maps": [one.map for one in rows],
            }
            for head, rows in by_head.items()
        ],
    }


def _case_document(one: model_comparison.Agreement) -> dict[str, Any]:
    """Figures of a lump, with the bumps fitted to both models' lines."""
    bumps = {
        name: {"amplitude": fit.amplitude, "sigma_mm": fit.widths_mm[0], "rms": fit.rms, "resolved": fit.resolved}
        for name, fit in {"elastic": one.elastic, "empirical": one.empirical}.items()
    }
    return as_dict(one) | bumps
