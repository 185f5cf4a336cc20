"""Reports of simulation-based calibration: text, data, table and figure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bayes.declarations import as_dict, names_of
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.figure_file import figure_file
from tactile_bayes.studies.sbc import (
    BAND,
    DRAWS,
    RANKED,
    MapRanks,
    RankTest,
    Truth,
    ecdf_band,
    ecdf_counts,
    other_rises,
    rank_tests,
)

SCHEMA = "tactile-bayes/sbc/1"
_COLOURS = ("#1f3b73", "#c8641e")
NARROW = 1.05
"""A larger spread of the ranks is called too narrow a posterior, and too wide below its inverse."""
SHIFT = 3.0
"""Standard errors of the mean rank beyond which a posterior is called too low or too high."""


def sbc_document(
    maps: Sequence[MapRanks], *, method: str, seed: int, maps_per_s: float | None, cosines: int | None = None
) -> dict[str, Any]:
    """All results as plain data.

    Parameters
    ----------
    maps_per_s
        Of the maps that this run made; None where it made none.
    """
    ranked = [one for one in maps if one.ranks is not None]
    tests, others = rank_tests(list(maps)), other_rises(list(maps))
    return {
        "schema": SCHEMA,
        "method": method,
        "field_cosines": cosines or "auto",
        "seed": seed,
        "maps": len(maps),
        "ranked": len(ranked),
        "abstained": dict(
            sorted(Counter(one.outcome for one in maps if one.ranks is None and one.probability is None).items())
        ),
        "drawn_by": dict(sorted(Counter(one.outcome for one in ranked).items())),
        "elsewhere": as_dict(others) | {"too_many": others.too_many},
        "draws": DRAWS,
        "maps_per_s": maps_per_s,
        "parameters": [_as_dict(one) for one in tests],
        "p_together": min(1.0, len(tests) * min(one.ecdf_p for one in tests)) if tests else None,
        "research_use": RESEARCH_USE,
    }


def _as_dict(test: RankTest) -> dict[str, Any]:
    return as_dict(test) | {"inside_band": test.inside, "verdict": verdict(test)}


def verdict(test: RankTest) -> str:
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
    return "\n".join(_lines(document)) + "\n"


def _lines(document: dict[str, Any]) -> Iterator[str]:
    speed = document["maps_per_s"]
    rate = "" if speed is None else f", {speed:.3g} maps/s"
    made = f"method {document['method']}, {document['field_cosines']} cosines, seed {document['seed']}"
    yield f"{document['maps']} maps from the model's own prior, {made}{rate}"
    others = document["elsewhere"]
    abstained = document["maps"] - document["ranked"] - others["number"]
    why = ", ".join(f"{code} {number}" for code, number in document["abstained"].items())
    yield f"no estimate on {abstained}{f' ({why})' if why else ''}: left out, ranks are conditional on detection"
    told = f"another rise was measured on {others['number']}, announced {others['announced']:.1f}"
    sure = f"FAILS, the draws keep to one place (p = {others['chance']:.1g})" if others["too_many"] else "ok"
    yield f"{told}: {sure}; left out"
    drawn = ", ".join(f"{name} {number}" for name, number in document["drawn_by"].items())
    if not document["parameters"]:
        yield "No map gave an estimate: there is nothing to rank; give more --maps"
        yield RESEARCH_USE
        return
    yield f"ranks among {DRAWS} draws, drawn by: {drawn}"
    yield ""
    yield f"{'parameter':<12}{'chi2 p':>8}{'ECDF p':>8}  {'in band':<8}{'50 % holds':<17}{'90 % holds':<17}verdict"
    for one in document["parameters"]:
        yield _row(one)
    yield ""
    yield from _conclusion(document["parameters"], document["p_together"])
    yield RESEARCH_USE


def _row(one: dict[str, Any]) -> str:
    held = [f"{100 * c['covered']:.1f} +- {100 * c['error']:.1f} %" for c in one["coverage"]]
    inside = "yes" if one["inside_band"] else "NO"
    return (
        f"{one['name']:<12}{one['chi2_p']:>8.3f}{one['ecdf_p']:>8.3f}  {inside:<8}"
        f"{held[0]:<17}{held[1]:<17}{one['verdict']}"
    )


def _conclusion(parameters: list[dict[str, Any]], together: float) -> Iterator[str]:
    failed = [one["name"] for one in parameters if not one["inside_band"]]
    band, number = f"{100 * BAND:g} % band", len(parameters)
    if failed:
        yield f"FAILS for {', '.join(failed)}: the ranks leave their simultaneous {band}."
        seldom = (
            f"of {number} calibrated parameters one or more leave theirs in {100 * (1 - BAND**number):.0f} % of runs"
        )
        advice = "run again with another --seed" if together > 1 - BAND else "that is no chance"
        yield f"All {number} together: p = {together:.2g} ({seldom}); {advice}."
    else:
        yield f"All ranks stay in their simultaneous {band}s."
    yield "+- is one binomial standard error of a calibrated interval."


def table_text(maps: Sequence[MapRanks]) -> str:
    """CSV with one row per map: truth, ranks (empty without an estimate) and outcome."""
    header = [
        "map",
        *names_of(Truth),
        *(f"rank_{name}" for name in RANKED),
        "outcome",
        "probability",
    ]
    return "\n".join([",".join(header), *(_table_row(one) for one in maps)]) + "\n"


def _table_row(one: MapRanks) -> str:
    ranks = [str(rank) for rank in one.ranks or ()]
    ranks += [""] * (len(RANKED) - len(ranks))
    probability = "" if one.probability is None else f"{one.probability:.8g}"
    truth = (f"{value:.8g}" for value in as_dict(one.truth).values())
    return ",".join([str(one.index), *truth, *ranks, one.outcome, probability])


def sbc_figure(maps: Sequence[MapRanks], path: Path, *, force: bool = False) -> None:
    """Draw the ECDF of each parameter's ranks minus the uniform one, with the simultaneous band, as PNG.

    Raises
    ------
    UsageError
        When `path` exists and `force` is false.
    """
    found = [one.ranks for one in maps if one.ranks is not None]
    names = RANKED[: len(found[0])] if found else RANKED
    ranks = np.array(found).reshape(-1, len(names))
    n, at = len(ranks), np.arange(1, DRAWS + 1) / (DRAWS + 1)
    inside = {test.name: test.inside for test in rank_tests(list(maps))}
    with figure_file(path, size_in=(2.2 * len(names), 2.9), force=force) as figure:
        all_axes = figure.subplots(1, len(names), sharey=True)
        for axes, name, column in zip(all_axes, names, ranks.T, strict=True):
            if n:
                low, high = ecdf_band(n, DRAWS)
                share = ecdf_counts(column[None], DRAWS)[0] / n
                axes.fill_between(at, low - at, high - at, step="mid", color="0.85", linewidth=0)
                axes.step(at, share - at, where="mid", color=_COLOURS[0 if inside[name] else 1], linewidth=1.2)
            axes.axhline(0.0, color="0.5", linewidth=0.6)
            axes.set_title(name, loc="left", fontsize=10)
            axes.set_xticks([0.0, 0.5, 1.0])
            axes.set_xlabel("rank / (draws + 1)", fontsize=9)
            axes.tick_params(labelsize=8)
            axes.spines[["top", "right"]].set_visible(False)
        all_axes[0].set_ylabel("ECDF of ranks - uniform", fontsize=9)
        caption = (
            f"{n} maps with an estimate of {len(maps)}; grey: {100 * BAND:g} % band of the whole path. {RESEARCH_USE}"
        )
        figure.text(0.01, 0.01, caption, fontsize=7.5, color="0.3")
