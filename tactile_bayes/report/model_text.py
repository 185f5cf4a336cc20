"""A scan against forward models, as text and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tactile_bayes.posterior.white.fit import BumpFit
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.studies.model_comparison import NEAR_MM, MeasuredFrames, ModelComparison, line_bump, residual_slope

DEFINITION = "MSD = sum of squared differences over the sum of squares of the model (docs/decisions/0007)"
_PRINTED = {"frames_centre": "below 15", "map_centre": "below 2.6"}
_ROWS = {
    "frames_all": "frames, all taxels, MSD %",
    "frames_centre": "frames, centre line, MSD %",
    "frames_near": "frames within 12 mm of the lump, MSD %",
    "map_all": f"map within {NEAR_MM:g} mm, MSD %",
    "map_centre": "map, centre line, MSD %",
    "map_strict": "map over (map - 1), MSD %",
}


def comparison_text(measured: MeasuredFrames, found: Sequence[ModelComparison]) -> str:
    """Differences of frames and maps, and the bumps on them, a column for each model."""
    place = measured.place_mm
    lines = [
        DEFINITION,
        f"{len(measured.level_kpa)} frames, mean pressure {measured.level_kpa.mean():.2f} kPa; "
        f"lump at {place[0]:.1f}, {place[1]:.1f} mm of the map",
        f"{'':<42}{'paper':>11}" + "".join(f"{one.fidelity:>20}" for one in found),
    ]
    for name, words in _ROWS.items():
        cells = "".join(f"{100 * getattr(one, name):>20.2f}" for one in found)
        lines.append(f"{words:<42}{_PRINTED.get(name, ''):>11}{cells}")
    lines.append(f"{'taxel, root mean square difference, kPa':<42}{'':>11}" + _cells(found, "rms_kpa"))
    slopes = [residual_slope(measured, one) for one in found]
    for k, words in enumerate(("map: slope of the residual in x, per 10 mm", "the same in y", "RMS beside the slope")):
        lines.append(f"{words:<42}{'':>11}" + "".join(f"{slope[k]:>20.4f}" for slope in slopes))
    heads = "".join(f"{'':>20}" for _ in found)
    lines += ["", f"{'Eq 7 on the map, level 1':<42}{'measured':>11}{heads}"]
    for k, words in enumerate(("amplitude", "sigma across the head, mm", "sigma along it, mm")):
        lines.append(_row(words, _shape(measured.lump)[k], [_shape(one.lump)[k] for one in found]))
    lines += ["Eq 5 on its centre line across the lump, level 1"]
    ours = line_bump(measured, measured.tactile_map)
    theirs = [line_bump(measured, one.tactile_map) for one in found]
    for k, words in enumerate(("amplitude", "sigma, mm")):
        lines.append(_row(words, ours[k], [pair[k] for pair in theirs]))
    return "\n".join(line.rstrip() for line in lines)


def _row(words: str, measured: float, models: Sequence[float]) -> str:
    cells = "".join(f"{_plain(value):>20}" for value in models)
    return f"{words:<42}{_plain(measured):>11}{cells}"


def _plain(value: float) -> str:
    """A model without a bump in the map's plane, such as a cylinder, has none to show."""
    return f"{value:.3f}" if np.isfinite(value) else "none"


def comparison_document(
    measured: MeasuredFrames, found: Sequence[ModelComparison], *, inputs: dict[str, Any]
) -> dict[str, Any]:
    """The same as plain data; differences as shares, null where no bump was fitted."""
    return {
        "schema": "tactile-bayes/compare-model/1",
        "definition": DEFINITION,
        "inputs": inputs,
        "frames": len(measured.level_kpa),
        "place_mm": list(measured.place_mm),
        "measured": {
            **_shape_document(measured.lump),
            **_line_document(line_bump(measured, measured.tactile_map)),
        },
        "models": [
            {
                "fidelity": one.fidelity,
                **{name: _number(getattr(one, name)) for name in (*_ROWS, "rms_kpa")},
                **_shape_document(one.lump),
                **_line_document(line_bump(measured, one.tactile_map)),
                **_slope_document(residual_slope(measured, one)),
            }
            for one in found
        ],
        "research_use": RESEARCH_USE,
    }


def _cells(found: Sequence[ModelComparison], name: str) -> str:
    return "".join(f"{getattr(one, name):>20.3f}" for one in found)


def _shape(lump: BumpFit | None) -> tuple[float, float, float]:
    if lump is None:
        return (float("nan"),) * 3
    sigma_x, sigma_y, _ = lump.widths()
    return float(lump.theta[0]), sigma_x, sigma_y


def _shape_document(lump: BumpFit | None) -> dict[str, float | None]:
    names = ("amplitude", "sigma_x_mm", "sigma_y_mm")
    return {name: _number(value) for name, value in zip(names, _shape(lump), strict=True)}


def _line_document(bump: tuple[float, float]) -> dict[str, float]:
    return {"line_amplitude": bump[0], "line_sigma_mm": bump[1]}


def _slope_document(slope: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip(("slope_x_per_10mm", "slope_y_per_10mm", "rms_beside_slope"), slope, strict=True))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
