"""Tables 1 and 2 of the paper as text and as plain data: ours, the nearest head's and the printed figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap

from tactile_bayes.declarations import as_dict
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.line import RANGE, outside_range
from tactile_bayes.report.paper_head import named
from tactile_bayes.studies.paper_tables import (
    DEFINITION,
    OTHER_DEFINITIONS,
    PRINTED_FRAMES,
    PRINTED_MAPS,
    TABLE_DIAMETERS_MM,
    Agreement,
    table_distance,
)

ByHead = Mapping[Head, Sequence[Agreement]]


def tables_text(
    found: Sequence[Agreement],
    phantoms: Sequence[Agreement],
    *,
    head: Head,
    nearest: Head | None = None,
    beside: Sequence[Agreement] | None = None,
) -> str:
    """Both tables, the widths and amplitudes, and the phantoms.

    Parameters
    ----------
    found, phantoms
        Of the ten lumps and of the phantoms, under `head`.
    nearest, beside
        The head nearest to the printed tables, and its ten lumps; None where there is none, or it is `head`.
    """
    lines = [DEFINITION, "", f"head: {named(head)}"]
    if nearest is not None and beside is not None:
        lines.append(f"after the slash the head nearest to the print: {named(nearest)}")
    lines += ["in brackets the printed figure", ""]
    lines += _table("Table 1: frame centred on the lump, MSD %", found, "centred_frame", PRINTED_FRAMES, beside)
    lines += _table("The same of frames divided by their means, MSD %", found, "normalised_frame", None, beside)
    lines += _table("All frames of the map, MSD % (printed average 4.3)", found, "all_frames", None, beside)
    lines += _table("Table 2: map, MSD %", found, "map", PRINTED_MAPS, beside)
    lines += _table("Map, strict MSD %", found, "map_strict", None, beside)
    lines += _others(found)
    lines += ["Eq 5 fitted to both maps (background 1); the elastic model first:"]
    lines += [f"{'lump':<24}{'a':>16}{'sigma, mm':>18}{'frame %':>10}{'map %':>8}{'strict %':>10}"]
    for one in [*found, *phantoms]:
        amplitudes = f"{one.elastic.amplitude:.3f} {one.empirical.amplitude:.3f}"
        widths = f"{one.elastic.sigma_mm:.2f} {one.empirical.sigma_mm:.2f}"
        shares = f"{100 * one.centred_frame:>10.1f}{100 * one.map:>8.1f}{100 * one.map_strict:>10.1f}"
        lines.append(f"{one.scene.name:<24}{amplitudes:>16}{widths:>18}{shares}")
    outside = [one.scene.name for one in [*found, *phantoms] if outside_range(one.scene.d_mm, one.scene.depth_ratio)]
    lines.append(f"the empirical model: {RANGE}; outside:")
    lines += wrap("; ".join(outside), width=100)
    return "\n".join(lines)


def heads_text(found: ByHead) -> str:
    """The tables' means and ranges under each head, nearest first."""
    lines = [
        "",
        "Tables under each head: mean (least to largest), %; distance from the 20 printed cells, percentage points",
        f"{'head':<38}{'Table 1 (4.1)':>20}{'all (4.3)':>11}{'Table 2 (2.4)':>20}{'distance':>10}",
    ]
    for head, rows in sorted(found.items(), key=lambda item: table_distance(item[1])):
        frames, maps = _span(rows, "centred_frame"), _span(rows, "map")
        every = f"{100 * sum(one.all_frames for one in rows) / len(rows):.1f}"
        lines.append(f"{named(head):<38}{frames:>20}{every:>11}{maps:>20}{table_distance(rows):>10.2f}")
    return "\n".join(lines)


def _span(rows: Sequence[Agreement], name: str) -> str:
    shares = [100 * getattr(one, name) for one in rows]
    return f"{sum(shares) / len(shares):.1f} ({min(shares):.1f} to {max(shares):.1f})"


def _others(found: Sequence[Agreement]) -> list[str]:
    """What other definitions would give: means over the cases with the least and the largest."""
    lines = [
        "Other definitions, %: mean over the cases (least to largest); printed 4.0 to 4.3 and 2.2 to 2.7",
        f"{'':<37}{'frame':>21}{'frame over its mean':>21}{'map':>21}",
    ]
    for i, name in enumerate(OTHER_DEFINITIONS):
        cells = []
        for of in range(3):
            shares = [100 * one.others[i][of] for one in found]
            cells.append(f"{sum(shares) / len(shares):.1f} ({min(shares):.1f} to {max(shares):.1f})")
        lines.append(f"{name:<37}" + "".join(f"{cell:>21}" for cell in cells))
    return [*lines, ""]


def _table(
    title: str,
    found: Sequence[Agreement],
    name: str,
    printed: Mapping[float, Sequence[float]] | None,
    beside: Sequence[Agreement] | None,
) -> list[str]:
    """One table with diameters across: this head / the nearest head (printed)."""
    lines = [title, f"{'h/d':>5}" + "".join(f"{f'd {d:g} mm':>18}" for d in TABLE_DIAMETERS_MM)]
    for depth in dict.fromkeys(one.scene.depth_ratio for one in found):
        cells = [f"{value:.1f}" for value in _row(found, name, depth)]
        if beside is not None:
            cells = [f"{cell} / {value:.1f}" for cell, value in zip(cells, _row(beside, name, depth), strict=True)]
        if printed is not None:
            cells = [f"{cell} ({value:.1f})" for cell, value in zip(cells, printed[depth], strict=True)]
        lines.append(f"{depth:>5g}" + "".join(f"{cell:>18}" for cell in cells))
    mean = f"mean {_mean(found, name):.1f}" + ("" if beside is None else f" / {_mean(beside, name):.1f}")
    if printed is None:
        return [*lines, mean, ""]
    values = [value for row in printed.values() for value in row]
    return [*lines, f"{mean} (of the printed cells {sum(values) / len(values):.1f})", ""]


def _row(found: Sequence[Agreement], name: str, depth_ratio: float) -> list[float]:
    return [100 * getattr(one, name) for one in found if one.scene.depth_ratio == depth_ratio]


def _mean(found: Sequence[Agreement], name: str) -> float:
    return float(sum(100 * getattr(one, name) for one in found) / len(found))


def tables_document(found: ByHead, phantoms: ByHead, *, seat: float) -> dict[str, object]:
    """The same as plain data, shares instead of percent; the head that was asked for first."""
    first = next(iter(found))
    return {
        "schema": "tactile-bayes/tables/1",
        "definition": DEFINITION,
        "other_definitions": list(OTHER_DEFINITIONS),
        "seat": seat,
        "head": first.shoulders,
        "printed_percent": {
            "frames": {f"{h:g}": list(row) for h, row in PRINTED_FRAMES.items()},
            "maps": {f"{h:g}": list(row) for h, row in PRINTED_MAPS.items()},
        },
        "cases": [as_dict(one) for one in found[first]],
        "phantoms": [as_dict(one) for one in phantoms[first]],
        "heads": [
            {
                **as_dict(head),
                "distance": table_distance(rows),
                "frames": [one.centred_frame for one in rows],
                "all_frames": [one.all_frames for one in rows],
                "maps": [one.map for one in rows],
            }
            for head, rows in found.items()
        ],
    }
