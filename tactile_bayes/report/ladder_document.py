"""Reports of `tradeoff estimate` and `tradeoff map` as JSON data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report.ladder_advice import advice
from tactile_bayes.studies.cost_ladder import Ladder, Priced
from tactile_bayes.studies.size_answers import SizeAnswer

SCHEMA = "tactile-bayes/tradeoff/1"
SCHEMA_FILE = "tradeoff.schema.json"


def ladder_document(ladder: Ladder, *, what: str, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The same as plain data, by data_schema/tradeoff.schema.json.

    Parameters
    ----------
    what
        ``"estimate"`` or ``"map"``: what is varied.
    """
    reference, frontier = ladder.reference, ladder.frontier()
    enough = ladder.enough()
    return {
        "schema": SCHEMA,
        "varied": what,
        "tolerance_mm": ladder.tolerance_mm,
        "reference": {
            "words": reference.words,
            "mc_error_mm": _plain(reference.error_mm),
            "half_width_mm": _plain(float("nan") if reference.answer is None else reference.answer.half_width_mm),
            "cpu_s": _plain(reference.cpu_s),
            "answer": None if reference.answer is None else _answer(reference.answer),
        },
        "settings": [_row(one) | {"frontier": any(one is other for other in frontier)} for one in ladder.rows],
        "enough": None if enough is None else enough.label,
        "pooled": [
            {
                "maps": one.maps,
                "cpu_s": _plain(one.cpu_s),
                "answer": _answer(one.answer),
                "another_half_width_mm": _plain(one.another_half_mm),
            }
            for one in ladder.pooled
        ],
        "shared_cpu_s": {name: _plain(seconds) for name, seconds in ladder.shared_cpu_s.items()},
        "advice": advice(ladder),
        "provenance": dict(provenance),
        "research_use": RESEARCH_USE,
    }


def _row(one: Priced) -> dict[str, Any]:
    return {
        "axis": one.axis,
        "setting": one.label,
        "default": one.default,
        "usable": one.usable,
        "runs": len(one.answers),
        "cpu_s": {name: _plain(seconds) for name, seconds in one.cpu_s.items()},
        "median_off_mm": _plain(one.off.median),
        "ends_off_mm": _plain(one.off.ends),
        "width_ends_off_mm": _plain(one.off.width_ends),
        "answer": _answer(one.answer),
    }


def _answer(answer: SizeAnswer) -> dict[str, Any]:
    return {
        "reason": answer.reason,
        "detected_probability": None if answer.probability is None else _plain(answer.probability),
        "method": answer.method,
        "quantities": {
            name: {part: _plain(getattr(one, part)) for part in ("median", "low", "high", "mc_error")}
            for name, one in answer.quantities.items()
        },
        "variance_share": {name: _plain(share) for name, share in answer.shares.items()},
    }


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
