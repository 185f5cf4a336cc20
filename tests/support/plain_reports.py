"""Reports that say nothing, to which a test adds what it is about."""

from __future__ import annotations

from typing import Any

from tactile_bayes.declarations import names_of
from tactile_bayes.files.provenance import Provenance
from tactile_bayes.files.reports import ESTIMATE, POOLED, EstimateReport, PooledReport
from tactile_bayes.mapping.map import TactileMap
from tactile_bayes.options import BumpPrior
from tactile_bayes.posterior.result import Estimate
from tactile_bayes.presets import RESEARCH_USE
from tactile_bayes.report import estimate_document
from tactile_bayes.report.compare import COMPARE, CompareReport
from tactile_bayes.report.estimate_text import estimate_text

_HEAD: dict[str, Any] = {"status": "no_estimate", "verdict": "no_answer", "findings": (), "reason": "", "left_out": ()}
_FOOT: dict[str, Any] = {"research_use": RESEARCH_USE, "provenance": {"settings": {}, "inputs": []}}


def report_of(estimate: Estimate, tactile_map: TactileMap, *, probability: float = 0.95) -> EstimateReport:
    """The report of an estimate, of no file."""
    told: Any = {"probability": probability, "prior": BumpPrior(), "provenance": Provenance("estimate", {})}
    return estimate_document.estimate_report(estimate, tactile_map, **told)


def full_text(estimate: Estimate, tactile_map: TactileMap) -> str:
    """All that the report of an estimate says."""
    return estimate_text(estimate, report_of(estimate, tactile_map))


def estimate_report(**more: Any) -> EstimateReport:
    """The report of a map without a lump."""
    own = {"diagnostics": {}, "candidates": (), "masses": (), "prior": {}, "schema": ESTIMATE}
    return EstimateReport(**_nothing(EstimateReport) | _HEAD | own | _FOOT | more)


def pooled_report(**more: Any) -> PooledReport:
    """The report of a mass without a size."""
    return PooledReport(
        **_nothing(PooledReport) | _HEAD | {"figures": {}, "unknowns": {}, "schema": POOLED} | _FOOT | more
    )


def compare_report(**more: Any) -> CompareReport:
    """The report of a comparison that was refused."""
    own = {"advice": "", "visits": (), "places": (), "changes": (), "schema": COMPARE, "status": "not_one_mass"}
    return CompareReport(**_nothing(CompareReport) | _HEAD | own | _FOOT | more)


def _nothing(kind: Any) -> dict[str, Any]:
    """None for each field that may hold it."""
    return {name: None for name in names_of(kind) if "None" in str(kind.__annotations__.get(name, ""))}
