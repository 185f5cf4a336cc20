"""How evenly heads press, as text and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.plane.head_design import HomogeneousTissue, Uniformity, most_even, narrowest
from tactile_bayes.presets import RESEARCH_USE, SHOULDERS_INSIDE


def named(head: Head) -> str:
    """A head in a few words."""
    arc = "flat" if np.isinf(head.radius_mm) else f"R {head.radius_mm:g} mm"
    return f"{arc}, {head.shoulders} of {head.shoulder_mm:g} mm"


def uniformity_text(found: Uniformity, tissue: HomogeneousTissue, *, limit: float) -> str:
    """One head: a table of moduli and pressures, and whether it meets the limit."""
    words = "within" if found.worst <= limit else "beyond"
    return "\n".join(
        [
            _tissue_line(tissue),
            f"head: {named(found.head)}, face {found.face_mm:.1f} mm wide",
            *_pressure_table(found, tissue),
            f"largest departure {100 * found.worst:.1f} %, {words} {100 * limit:g} %",
        ]
    )


def design_text(found: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float) -> str:
    """The whole search: a table for each place of the shoulders, and the answer with its own table."""
    lines = [_tissue_line(tissue), ""]
    for kind in dict.fromkeys(one.head.shoulders for one in found):
        lines += [*_grid(kind, [one for one in found if one.head.shoulders == kind], limit=limit), ""]
    count = sum(one.worst <= limit for one in found)
    lines.append(f"{count} of {len(found)} heads stay within {100 * limit:g} % of the mean")
    best, answer = most_even(found), narrowest(found, limit=limit)
    lines.append(f"most even: {named(best.head)}, {100 * best.worst:.1f} %, face {best.face_mm:.1f} mm wide")
    if answer is not None:
        words = f"{100 * answer.worst:.1f} %, face {answer.face_mm:.1f} mm wide"
        lines += [f"narrowest within the limit: {named(answer.head)}, {words}", *_pressure_table(answer, tissue)]
    by_rms = narrowest(found, limit=limit, by_rms=True)
    if by_rms is not None:
        words = f"{100 * by_rms.worst_rms:.1f} %, face {by_rms.face_mm:.1f} mm wide"
        lines.append(f"narrowest whose root mean square is within it: {named(by_rms.head)}, {words}")
    return "\n".join(lines)


def uniformity_document(found: Uniformity, tissue: HomogeneousTissue, *, limit: float) -> dict[str, object]:
    """One head as plain data; departures as shares of the mean."""
    return {
        "schema": "tactile-bayes/head-uniformity/1",
        **_tissue_document(tissue, limit),
        **_head_document(found),
        "largest": found.largest.tolist(),
        "rms": found.rms.tolist(),
        "within_limit": found.worst <= limit,
        "research_use": RESEARCH_USE,
    }


def design_document(found: Sequence[Uniformity], tissue: HomogeneousTissue, *, limit: float) -> dict[str, object]:
    """The whole search as plain data; `answer` is None where no head meets the limit."""
    answer, by_rms = narrowest(found, limit=limit), narrowest(found, limit=limit, by_rms=True)
    return {
        "schema": "tactile-bayes/head-design/1",
        **_tissue_document(tissue, limit),
        "heads": [_head_document(one) for one in found],
        "most_even": _head_document(most_even(found)),
        "answer": None if answer is None else _head_document(answer),
        "answer_by_rms": None if by_rms is None else _head_document(by_rms),
        "research_use": RESEARCH_USE,
    }


def _tissue_line(tissue: HomogeneousTissue) -> str:
    moduli, pressures = tissue.young_kpa, tissue.mean_kpa
    return (
        f"homogeneous tissue of {moduli[0]:g} to {moduli[1]:g} kPa, {tissue.thickness_mm:g} mm thick on a rigid base, "
        f"nu {tissue.poisson:g}; mean pressures of {pressures[0]:g} to {pressures[1]:g} kPa"
    )


def _pressure_table(found: Uniformity, tissue: HomogeneousTissue) -> list[str]:
    columns = "".join(f"{f'{value:g} kPa':>16}" for value in tissue.pressures_kpa)
    lines = ["largest departure of a taxel from its frame's mean, % (root mean square)", f"{'modulus':>9}{columns}"]
    for modulus, largest, rms in zip(tissue.moduli_kpa, found.largest, found.rms, strict=True):
        cells = "".join(f"{f'{100 * a:.1f} ({100 * b:.1f})':>16}" for a, b in zip(largest, rms, strict=True))
        lines.append(f"{f'{modulus:g} kPa':>9}{cells}")
    return lines


def _grid(kind: str, found: Sequence[Uniformity], *, limit: float) -> list[str]:
    """Radii down, shoulders across; a star marks what meets the limit."""
    where = "cut into the sensing width" if kind == SHOULDERS_INSIDE else "around the sensing width"
    shoulders = sorted({one.head.shoulder_mm for one in found})
    cells = {(one.head.radius_mm, one.head.shoulder_mm): one.worst for one in found}
    lines = [
        f"{kind} ({where}): largest departure over all moduli and pressures, %; * within {100 * limit:g} %",
        f"{'R, mm':>8}" + "".join(f"{f'r {value:g}':>8}" for value in shoulders),
    ]
    for radius in sorted({one.head.radius_mm for one in found}):
        name = "flat" if np.isinf(radius) else f"{radius:g}"
        row = [_marked(cells.get((radius, shoulder)), limit) for shoulder in shoulders]
        lines.append(f"{name:>8}" + "".join(f"{cell:>8}" for cell in row))
    return lines


def _marked(value: float | None, limit: float) -> str:
    if value is None:
        return "-"
    return f"{100 * value:.1f}{'*' if value <= limit else ' '}"


def _tissue_document(tissue: HomogeneousTissue, limit: float) -> dict[str, object]:
    return {
        "modulus_kpa": tissue.moduli_kpa.tolist(),
        "mean_kpa": tissue.pressures_kpa.tolist(),
        "thickness_mm": tissue.thickness_mm,
        "poisson": tissue.poisson,
        "limit": limit,
    }


def _head_document(found: Uniformity) -> dict[str, Any]:
    """JSON has no infinity: a flat head's radius is null."""
    head = found.head
    return {
        "radius_mm": None if np.isinf(head.radius_mm) else head.radius_mm,
        "shoulder_mm": head.shoulder_mm,
        "shoulders": head.shoulders,
        "face_mm": found.face_mm,
        "worst": found.worst,
        "worst_rms": found.worst_rms,
    }
