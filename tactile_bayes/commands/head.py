"""`head`: how evenly a scan head presses, and the head that presses most evenly (section 2.1 of the paper)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tactile_bayes.commands.options import FORCE, JSON, METAVAR, Decorator, FigurePath, FiniteRange, head_option

if TYPE_CHECKING:
    from tactile_bayes.studies.head_design import HomogeneousTissue

_ABOVE_0 = FiniteRange(min=0.0, min_open=True)
_RANGE = "LOW HIGH"


@click.group("head")
def command() -> None:
    """How evenly a scan head presses on tissue without a lump: the homogeneous-pressure condition of section 2.1."""


def _tissue_options(wrapped: Any) -> Any:
    """Tissue, pressures and limit, the same for both subcommands."""
    options: list[Decorator] = [
        click.option(
            "--modulus-kpa",
            type=(_ABOVE_0, _ABOVE_0),
            metavar=_RANGE,
            default=(15.0, 25.0),
            show_default=True,
            help="Young's moduli of the tissue (paper: 15 to 25).",
        ),
        click.option(
            "--pressure-kpa",
            type=(_ABOVE_0, _ABOVE_0),
            metavar=_RANGE,
            default=(5.0, 14.0),
            show_default=True,
            help="Mean pressures under the head (paper: 5 to 14).",
        ),
        click.option(
            "--thickness-mm",
            type=_ABOVE_0,
            default=70.0,
            show_default=True,
            help="Thickness of the tissue on its rigid base, mm. The paper gives none.",
        ),
        click.option(
            "--poisson",
            type=FiniteRange(0.0, 0.5, max_open=True),
            default=0.495,
            show_default=True,
            help="Poisson's ratio of the tissue.",
        ),
        click.option(
            "--limit-percent",
            type=_ABOVE_0,
            default=7.5,
            show_default=True,
            help="Largest allowed departure of a taxel from the frame's mean, % of it (paper: 7.5).",
        ),
    ]
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped


@command.command("uniformity")
@click.option("--head-radius-mm", type=_ABOVE_0, default=35.0, show_default=True, help="Radius of the head's arc, mm.")
@click.option(
    "--shoulder-mm", type=FiniteRange(min=0.0), default=3.0, show_default=True, help="Radius of the shoulders, mm."
)
@head_option("Default: shoulders-inside.")
@_tissue_options
@JSON
def uniformity_command(
    *,
    head_radius_mm: float,
    shoulder_mm: float,
    head: str | None,
    limit_percent: float,
    as_json: bool,
    **tissue: Any,
) -> None:
    """Compute how evenly one head presses on homogeneous tissue.

    For three moduli and three mean pressures: the largest departure of a taxel from the mean of its frame, and the root
    mean square departure. Only the ratio of pressure to modulus matters.

    Example: tactile-bayes head uniformity --head-radius-mm 35 --head shoulders-outside
    """
    from tactile_bayes.forward.contact import Head
    from tactile_bayes.presets import RESEARCH_USE, SHOULDERS_INSIDE
    from tactile_bayes.report.paper_head import uniformity_document, uniformity_text
    from tactile_bayes.studies.head_design import uniformity

    body, limit = _tissue(**tissue), limit_percent / 100
    section = Head(radius_mm=head_radius_mm, shoulder_mm=shoulder_mm, shoulders=head or SHOULDERS_INSIDE)
    found = uniformity(section, body)
    if as_json:
        _print_json(uniformity_document(found, body, limit=limit))
        return
    click.echo(uniformity_text(found, body, limit=limit))
    click.echo(RESEARCH_USE)


@command.command("design")
@head_option("Default: both are searched.")
@_tissue_options
@click.option("--figure", metavar=METAVAR, type=FigurePath(), help="Draw the non-uniformity over radius and shoulder.")
@JSON
@FORCE
def design_command(
    *, head: str | None, limit_percent: float, figure: Path | None, as_json: bool, force: bool, **tissue: Any
) -> None:
    """Find the head that presses evenly on homogeneous tissue (section 2.1 of the paper).

    Radii of the arc from 13 mm to a flat face and shoulders of 0 to 15 mm are tried on a sensing width of 24 mm. The
    answer is the head with the narrowest face that keeps every taxel within the limit, over all moduli and pressures.
    Ends with exit code 2 where no head does; the most even one is printed then.

    Example: tactile-bayes head design --figure head.png
    """
    from tactile_bayes.errors import UsageError
    from tactile_bayes.files.atomic import refuse_existing
    from tactile_bayes.presets import HEADS, RESEARCH_USE
    from tactile_bayes.report.paper_head import design_document, design_figure, design_text, named
    from tactile_bayes.studies.head_design import most_even, narrowest, search_heads

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
    from tactile_bayes.studies.head_design import HomogeneousTissue

    return HomogeneousTissue(modulus_kpa, pressure_kpa, thickness_mm, poisson)


def _print_json(document: dict[str, object]) -> None:
    import json

    click.echo(json.dumps(document, indent=2))
