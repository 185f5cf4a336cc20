"""Text of a trial plan: one line per design, then the benefit of more maps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any


def plan_text(document: Mapping[str, Any]) -> str:
    """Full text of a plan, ending with the research-use line."""
    lines = [
        f"Assumed errors of ln size: {_errors(document, document['errors'])}",
        *_origins(document),
        "",
        "patients  maps  power                tactile MAPE %  other MAPE %  tactile interval  ratio interval",
        *(_design_line(one) for one in document["designs"]),
        "",
        *_gain_lines(document),
        "power: tactile error smaller and p < 0.05, in brackets the simulation's own 95 % interval.",
        "intervals: median factor from lower to upper end.",
        str(document["research_use"]),
    ]
    return "\n".join(lines) + "\n"


def _errors(document: Mapping[str, Any], names: Iterable[str]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {document['errors'][name]:.3g}" for name in names)


def _origins(document: Mapping[str, Any]) -> Iterator[str]:
    """Source of each assumed error when there is a pilot: the pilot or an option."""
    sources: Mapping[str, str] = document["errors_from"]
    given = [name for name, source in sources.items() if source == "option"]
    if "pilot" in sources.values() and given:
        yield f"Given by options: {_errors(document, given)}; the others are the pilot's."


def _design_line(one: Mapping[str, Any]) -> str:
    low, high = one["power_interval"]
    power = f"{one['power']:.3f} [{low:.3f}, {high:.3f}]"
    widths = [f"x {one[key]:.2f}" if one[key] else "-" for key in ("tactile_width_ratio", "ratio_width_ratio")]
    return (
        f"{one['patients']:>8}  {one['maps']:>4}  {power:<19}  {one['tactile_percent']:>14.1f}  "
        f"{one['other_percent']:>12.1f}  {widths[0]:>16}  {widths[1]:>14}"
    )


def _gain_lines(document: Mapping[str, Any]) -> Iterator[str]:
    for one in document["gains"]:
        yield (
            f"{one['patients']} patients, from {one['from_maps']} to {one['to_maps']} maps: power "
            f"{one['power_gain']:+.3f}, tactile MAPE {one['tactile_percent_change']:+.1f} points"
        )
