"""A scan head's pressure and a scan's forward model, printed and drawn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.progress import progress_bar
from tactile_bayes.errors import UsageError
from tactile_bayes.files.atomic import refuse_existing
from tactile_bayes.files.documents import dump_json
from tactile_bayes.files.provenance import hash_inputs
from tactile_bayes.files.scene_toml import read_scene
from tactile_bayes.findings import finding_lines
from tactile_bayes.forward.contact import Head
from tactile_bayes.forward.line import outside_range
from tactile_bayes.mapping.select import scan_findings
from tactile_bayes.presets import HEADS, RESEARCH_USE, SHOULDERS_INSIDE
from tactile_bayes.report.paper_head import (
    comparison_document,
    comparison_figure,
    comparison_text,
    design_document,
    design_figure,
    design_text,
    named,
    uniformity_document,
    uniformity_text,
)
from tactile_bayes.studies.head_design import HomogeneousTissue, most_even, narrowest, search_heads, uniformity
from tactile_bayes.studies.model_comparison import compare_model, measured_frames

if TYPE_CHECKING:
    from tactile_bayes.studies.head_design import HomogeneousTissue


# --- `head`: how evenly a scan head presses, and the head that presses most evenly (section 2.1 of the paper).


def head_uniformity_action(
    *,
    head_radius_mm: float,
    shoulder_mm: float,
    head: str | None,
    limit_percent: float,
    as_json: bool,
    **tissue: Any,
) -> None:
    """Compute how evenly one head presses on homogeneous tissue."""
    body, limit = _tissue(**tissue), limit_percent / 100
    section = Head(radius_mm=head_radius_mm, shoulder_mm=shoulder_mm, shoulders=head or SHOULDERS_INSIDE)
    found = uniformity(section, body)
    if as_json:
        _print_json(uniformity_document(found, body, limit=limit))
        return
    click.echo(uniformity_text(found, body, limit=limit))
    click.echo(RESEARCH_USE)


def head_design_action(
    *, head: str | None, limit_percent: float, figure: Path | None, as_json: bool, force: bool, **tissue: Any
) -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper)."""
    body, limit = _tissue(**tissue), limit_percent / 100
    if figure is not None:
        refuse_existing(figure, force=force)
    found = search_heads(body, kinds=HEADS if head is None else (head,))
    if figure is not None:
        design_figure(found, body, limit=limit, path=figure, force=force)
    if as_json:
        _print_json(design_document(found, body, limit=limit))
    else:
        click.echo(design_text(found, body, limit=limit))
        click.echo(RESEARCH_USE)
    if narrowest(found, limit=limit) is None:
        best = most_even(found)
        raise UsageError(
            f"no head keeps the pressure within {limit_percent:g} % of its mean: the most even one, "
            f"{named(best.head)}, reaches {100 * best.worst:.1f} %; give a larger --limit-percent, narrower ranges or "
            "another --thickness-mm"
        )


def _tissue(
    *,
    modulus_kpa: tuple[float, float],
    pressure_kpa: tuple[float, float],
    thickness_mm: float,
    poisson: float,
) -> HomogeneousTissue:
    return HomogeneousTissue(modulus_kpa, pressure_kpa, thickness_mm, poisson)


def _print_json(document: dict[str, object]) -> None:
    click.echo(json.dumps(document, indent=2))


# --- `compare-model`: a scan's frames and map against a forward model of a scene (section 2.3 of the paper).


def compare_model_action(
    *,
    scan: Path,
    scene: Path,
    fidelities: tuple[str, ...],
    head: str | None,
    at: tuple[float, float] | None,
    every: int,
    cell_mm: float,
    pressure_window_kpa: tuple[float, float],
    latency_ms: float,
    figure: Path | None,
    as_json: bool,
    force: bool,
) -> None:
    """Compare a scan's frames and map with a forward model of SCENE (section 2.3 of the paper)."""
    from tactile_bayes.files.scan_mcap import read_scan

    if figure is not None:
        refuse_existing(figure, force=force)
    body = read_scene(scene)
    loaded = read_scan(scan)
    if at is None and not (body.solid_lumps or body.lumps):
        at = (0.0, 0.0)  # no lump to look for: the middle of the strokes
    measured = measured_frames(
        loaded,
        every=every,
        cell_mm=cell_mm,
        pressure_window_kpa=pressure_window_kpa,
        latency_ms=latency_ms,
        place_mm=at,
    )
    found = []
    for fidelity in dict.fromkeys(fidelities or (body.fidelity,)):
        warnings = [outside_range(one.d_mm, one.depth_ratio) for one in body.solid_lumps if fidelity == "empirical"]
        for warning in filter(None, warnings):
            click.echo(warning, err=True)
        with progress_bar(f"frames, {fidelity}") as progress:
            found.append(compare_model(measured, body, fidelity=fidelity, head=head, progress=progress))
    if figure is not None:
        comparison_figure(measured, found, figure, title=f"{scan.stem} against {scene.stem}", force=force)
    if as_json:
        click.echo(
            dump_json(comparison_document(measured, found, inputs=hash_inputs(scan=scan, scene=scene))), nl=False
        )
        return
    for line in finding_lines(scan_findings(loaded)):
        click.echo(line, err=True)
    click.echo(comparison_text(measured, found))
    click.echo(RESEARCH_USE)
